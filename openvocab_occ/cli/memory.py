"""`openvocab-occ memory ...`: the global occupancy map from the command line."""

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from openvocab_occ.cli.output import console, print_json, progress
from openvocab_occ.cli.source import Source
from openvocab_occ.errors import ConfigError, DataError, MapError, NotFoundError
from openvocab_occ.geometry import GridSpec, pose
from openvocab_occ.memory import TileMap

Map = Annotated[str, tyro.conf.Positional]
DType = Literal["uint8", "float16", "float32"]
Policy = Literal["newest", "bayes", "ema"]


def build(
    source: Annotated[Source, tyro.conf.OmitArgPrefixes],
    *,
    out: str,
    agent: str = "car",
    log: str | None = None,
    dtype: DType = "uint8",
    start: float | None = None,
    json: bool = False,
) -> None:
    """Write the occupancy of a drive into a map, which is made if there is none.

    Args:
        source: The drive; its frames need occupancy.
        out: The map, a folder called NAME.tiles or s3://bucket/prefix.
        agent: Who drove.
        log: Name of the drive; the sequence's own by default.
        dtype: How a new map keeps logits.
        start: Unix seconds of the first frame, for sources without a clock.
        json: Print one JSON object.
    """
    from openvocab_occ.memory.observe import observe

    sequence = source.load()
    city: TileMap | None = None
    voxels = 0
    with progress("writing") as advance:
        for done, frame in enumerate(sequence):
            seen = observe(frame)
            grid = frame.occupancy
            if city is None and grid is not None:
                city = _open_or_create(out, grid.class_names, grid.spec, dtype)
            if city is not None:
                stamp = seen.time + (start or 0.0)
                where = (seen.T_world_grid, seen.spec)
                name = log or sequence.name
                voxels += city.write(seen.logits, seen.mask, *where, stamp=stamp, agent=agent, log=name).voxels
            advance(done + 1, len(sequence))
    if city is None:
        raise DataError("the drive has no frames", expected="at least one")
    report = {"map": out, "frames": len(sequence), "voxels": voxels, "synthetic": sequence.synthetic}
    _show(report, f"{out}  {len(sequence)} frames, {voxels:,} voxels written", json)


def read(
    map: Map, *, at: tuple[float, float, float] = (0.0, 0.0, 0.0), yaw_deg: float = 0.0, exclude: tuple[str, ...] = (),
    interpolation: Literal["nearest", "bilinear"] = "nearest", out: Path | None = None, json: bool = False,
) -> None:  # fmt: skip
    """Read the prior around a place: 80 x 80 x 6.4 m in voxels of 0.4 m, as Occ3D.

    Args:
        map: The map.
        at: Where the vehicle stands in the world, metres.
        yaw_deg: Where it looks, degrees from x to y.
        exclude: Logs to leave out.
        interpolation: How the window is read.
        out: Write `logits`, `known` and the pose here, as .npz.
        json: Print one JSON object.
    """
    from openvocab_occ.io.files import written_file
    from openvocab_occ.occupancy import OCC3D_SPEC

    city = TileMap.open(map, writable=False)
    half = np.deg2rad(yaw_deg) / 2
    T = pose(at, (np.cos(half), 0.0, 0.0, np.sin(half)))
    prior = city.read(T, OCC3D_SPEC, exclude_logs=exclude, interpolation=interpolation)
    counts = np.bincount(prior.logits[prior.known].argmax(axis=-1), minlength=city.schema.num_classes)
    names = city.schema.class_names
    labels = {n: int(c) for n, c in zip(names, counts, strict=True) if c}
    if out is not None:
        with written_file(out) as scratch, scratch.open("wb") as stream:
            np.savez_compressed(stream, logits=prior.logits, known=prior.known, T_world_ego=T)
    report = {"map": map, "known": float(prior.known.mean()), "labels": labels}
    _show(report, f"known {prior.known.mean():.1%}  " + ", ".join(f"{n} {c:,}" for n, c in labels.items()), json)


def write(map: Map, file: Annotated[Path, tyro.conf.Positional], *, stamp: float, agent: str, log: str,
          policy: Literal["newest", "replace"] = "newest", json: bool = False) -> None:  # fmt: skip
    """Write one window from an .npz with `logits`, `mask`, `T_world_ego`, `origin` and `voxel_size`.

    Args:
        map: The map.
        file: The .npz.
        stamp: When it was seen, Unix seconds.
        agent: Who saw it.
        log: The drive.
        policy: `newest`, or `replace` whatever is there.
        json: Print one JSON object.
    """
    from openvocab_occ.io.files import existing

    try:
        with np.load(existing(file, "window"), allow_pickle=False) as data:
            logits, mask, T = data["logits"], data["mask"], data["T_world_ego"]
            origin, size = tuple(map_float(data["origin"])), float(data["voxel_size"])
    except (KeyError, ValueError, EOFError, OSError) as error:
        if isinstance(error, NotFoundError):
            raise
        raise DataError(
            f"{file} is no window", expected="logits, mask, T_world_ego, origin, voxel_size", got=error
        ) from error
    spec = GridSpec(origin, size, mask.shape)  # pyright: ignore[reportArgumentType]
    done = TileMap.open(map).write(
        logits.astype(np.float32), mask.astype(np.bool_), T, spec, stamp=stamp, agent=agent, log=log, policy=policy
    )
    report = {"map": map, "voxels": done.voxels, "changed": done.changed, "tiles": done.tiles}
    _show(report, f"{done.changed:,} of {done.voxels:,} voxels changed in {done.tiles} tiles", json)


def merge(map: Map, others: Annotated[tuple[str, ...], tyro.conf.Positional], *, json: bool = False) -> None:
    """Put other maps of the same lattice into a map; the order does not matter.

    Args:
        map: The map that gets them.
        others: The maps that are put in.
        json: Print one JSON object.
    """
    from openvocab_occ.memory.merge import merge as put

    city, tiles = TileMap.open(map), 0
    with progress("merging", unit="maps") as advance:
        for done, other in enumerate(others):
            tiles += put(city, TileMap.open(other, writable=False))
            advance(done + 1, len(others))
    _show({"map": map, "merged": [*others], "tiles": tiles}, f"{tiles} tiles of {len(others)} maps merged", json)


def diff(map: Map, other: Annotated[str | None, tyro.conf.Positional] = None, *, before: float | None = None,
         after: float | None = None, json: bool = False) -> None:  # fmt: skip
    """Tell what appeared, vanished and changed: between two maps, or between two times of one.

    Args:
        map: The earlier map, or the only one.
        other: The later map.
        before: Unix seconds, for one map with a journal.
        after: Unix seconds.
        json: Print one JSON object.
    """
    from openvocab_occ.memory import changes

    city = TileMap.open(map, writable=False)
    if other is not None:
        found = changes.diff(city, TileMap.open(other, writable=False))
    elif before is not None and after is not None:
        found = changes.diff_times(city, before, after)
    else:
        raise ConfigError("there is nothing to compare with", fix="give a second map, or --before and --after")
    report: dict[str, Any] = found.summary()
    lines = [f"{report['compared']:,} voxels known in both, {report['learnt']:,} learnt, {report['forgotten']:,} lost"]
    for kind in ("appeared", "vanished", "changed"):
        labels = ", ".join(f"{name} {count:,}" for name, count in report[kind]["labels"].items())
        lines.append(f"{kind:9} {report[kind]['voxels']:>9,}  {labels}")
    _show(report, "\n".join(lines), json)


def info(map: Map, *, json: bool = False) -> None:
    """Describe a map: classes, tiles, size, agents, logs.

    Args:
        map: The map.
        json: Print one JSON object.
    """
    from openvocab_occ.memory.health import describe

    report = describe(TileMap.open(map, writable=False))
    agents = ", ".join(n + (f" (quarantined: {why})" if why else "") for n, why in report["agents"].items())
    _show(report, f"{map}  {len(report['classes'])} classes, {report['heights']} heights, {report['dtype']}, "
          f"{report['cell_m']:g} m\n{report['tiles']} tiles, {report['tile_area_km2']:.4f} km², "
          f"{report['tile_bytes'] / 1e6:.1f} MB ({report['gb_per_km2'] or 0:.3f} GB/km², dense float32 "
          f"{report['dense_float32_gb_per_km2']:.2f})\nagents: {agents or 'none'}\nlogs: "
          + (", ".join(n + (" (merged)" if m else "") for n, m in report["logs"].items()) or "none"), json)  # fmt: skip


def verify(map: Map, *, repair: bool = False, json: bool = False) -> None:
    """Read every tile and journal entry; say which are damaged.

    Args:
        map: The map.
        repair: Make damaged tiles anew from the journal.
        json: Print one JSON object.
    """
    from openvocab_occ.memory import fold, health

    city = TileMap.open(map, writable=repair)
    with progress("reading", unit="tiles") as advance:
        found = health.verify(city, progress=advance)
    bad = sum(map_len(found.damaged))
    mended = fold.repair(city, found.damaged) if repair and bad else 0
    report = {"map": map, "tiles": found.tiles, "damaged": {k: [*v] for k, v in found.damaged.items()},
              "entries": found.entries, "damaged_entries": found.damaged_entries, "repaired": mended}  # fmt: skip
    _show(report, f"{found.tiles} tiles, {bad} damaged, {mended} made anew; {found.entries} journal entries, "
          f"{len(found.damaged_entries)} damaged", json)  # fmt: skip
    if (bad and not mended) or found.damaged_entries:
        raise MapError(f"{map} is damaged", got=f"{bad - mended} tiles, {len(found.damaged_entries)} journal entries",
                       fix="--repair makes tiles anew from the journal")  # fmt: skip


def rebuild(map: Map, *, without: tuple[str, ...] = (), out: str | None = None, until: float | None = None,
            policy: Policy = "newest", audit: bool = False, json: bool = False) -> None:  # fmt: skip
    """Make the tiles anew from the journal.

    Args:
        map: The map.
        without: Agents whose writes are left out, and refused from now on.
        out: Make a new map here instead; needed for --until and policies other than newest.
        until: Only writes up to this time, Unix seconds.
        policy: How the writes of a voxel become one.
        audit: First quarantine agents that most others contradict.
        json: Print one JSON object.
    """
    from openvocab_occ.memory import fold, trust

    city = TileMap.open(map)
    guilty = [w.agent for w in trust.quarantine_contradicting(city)] if audit else []
    tiles = fold.rebuild(city, without=without, out=out, until=until, policy=policy)
    left_out = sorted({*without, *guilty})
    report = {"map": out or map, "tiles": tiles, "without": left_out, "policy": policy}
    text = f"{tiles} tiles made anew" + (f" without {', '.join(left_out)}" if left_out else "")
    _show(report, text, json)


def prune(map: Map, *, before: float | None = None, json: bool = False) -> None:
    """Drop journal entries that are folded into the base; the map stays as it is.

    It can still be rebuilt, but not any more without the agents whose entries were dropped, nor folded otherwise.

    Args:
        map: The map; logs of it that are not merged keep their entries.
        before: Only entries of before this time, Unix seconds.
        json: Print one JSON object.
    """
    from openvocab_occ.memory.prune import prune as drop

    city = TileMap.open(map)
    with progress("pruning", unit="entries") as advance:
        dropped = drop(city, before=before, progress=advance)
    report = {"map": map, "entries": dropped.entries, "bytes": dropped.size, "agents": [*dropped.agents]}
    text = f"{dropped.entries} journal entries, {dropped.size / 1e6:.1f} MB dropped"
    bound = f"; part of the map for good: {', '.join(dropped.agents)}" if dropped.agents else ""
    _show(report, text + bound, json)


def consolidate(map: Map, *, logs: tuple[str, ...] = (), json: bool = False) -> None:
    """Merge logs into the base, where reads are cheaper and they cannot be left out any more.

    Args:
        map: The map.
        logs: Those to merge; all by default. Nobody should be writing them.
        json: Print one JSON object.
    """
    city = TileMap.open(map)
    chosen = logs or tuple(log for log, merged in city.logs().items() if not merged)
    tiles = 0
    with progress("merging", unit="logs") as advance:
        for done, log in enumerate(chosen, start=1):
            tiles += city.consolidate(log)
            advance(done, len(chosen))
    _show({"map": map, "logs": [*chosen], "tiles": tiles}, f"{tiles} tiles of {len(chosen)} logs merged", json)


def export(map: Map, *, out: Path, by: Literal["class", "agent"] = "class", exclude: tuple[str, ...] = (),
           json: bool = False) -> None:  # fmt: skip
    """Write the occupied voxels as a picture (.png: from above and from the front), as .npz or as .ply.

    Args:
        map: The map.
        out: The file; its ending tells the format.
        by: Colour by class or by agent.
        exclude: Logs to leave out.
        json: Print one JSON object.
    """
    from openvocab_occ.export import tile_pictures
    from openvocab_occ.export.palette import label_colors
    from openvocab_occ.io.files import written_file
    from openvocab_occ.memory.merge import surface

    city = TileMap.open(map, writable=False)
    shown = surface(city, exclude_logs=exclude)
    s = city.schema
    if out.suffix == ".png":
        tile_pictures.draw_map(out, shown, s.class_names, s.cell, by=by)
    elif out.suffix == ".npz":
        with written_file(out) as scratch, scratch.open("wb") as stream:
            np.savez_compressed(
                stream,
                points=shown.points,
                labels=shown.labels,
                agents=shown.agents,
                stamps=shown.stamps,
                class_names=s.class_names,
                agent_names=shown.agent_names,
            )
    elif out.suffix == ".ply":
        colors = label_colors(s.class_names)[shown.labels] if by == "class" else (
            tile_pictures.agent_colors(len(shown.agent_names))[shown.agents])  # fmt: skip
        _write_ply(out, shown.points, colors)
    else:
        raise ConfigError("ending is not known", expected=".png, .npz or .ply", got=out.name)
    _show({"map": map, "file": str(out), "voxels": len(shown.points)}, f"{out}  {len(shown.points):,} voxels", json)


def _open_or_create(path: str, names: tuple[str, ...], spec: GridSpec, dtype: DType) -> TileMap:
    try:
        return TileMap.open(path)
    except NotFoundError:
        cell, z0 = float(spec.size[2]), float(spec.origin[2])
        return TileMap.create(path, names, heights=spec.shape[2], cell=cell, z0=z0, dtype=dtype)


def _write_ply(path: Path, points: np.ndarray, colors: np.ndarray) -> None:
    from openvocab_occ.io.files import written_file

    rows = np.empty(len(points), dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3)])
    rows["xyz"], rows["rgb"] = points, colors
    axes = "".join(f"property float {a}\n" for a in "xyz")
    channels = "".join(f"property uchar {c}\n" for c in ("red", "green", "blue"))
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{axes}{channels}end_header\n"
    with written_file(path) as scratch:
        scratch.write_bytes(head.encode() + rows.tobytes())


def map_float(values: np.ndarray) -> list[float]:
    """Return plain numbers."""
    return [float(v) for v in np.ravel(values)]


def map_len(groups: dict[str, list[Any]]) -> list[int]:
    """Return the length of each group."""
    return [len(group) for group in groups.values()]


def _show(report: dict[str, Any], text: str, json: bool) -> None:
    print_json(report) if json else console().print(text, markup=False)
