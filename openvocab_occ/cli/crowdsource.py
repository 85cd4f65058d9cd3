"""`openvocab-occ crowdsource`: several agents write one map at the same time (LMPOcc Fig. 5)."""

import multiprocessing
import tempfile
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Annotated

import tyro

from openvocab_occ.cli.output import console, print_json, progress
from openvocab_occ.cli.source import Source
from openvocab_occ.errors import AlreadyExistsError, ConfigError
from openvocab_occ.memory import TileMap

_APART = 0.001  # s between the clocks of agents, so that simultaneous frames differ


def crowdsource(
    source: Annotated[Source, tyro.conf.OmitArgPrefixes], *, out: Path, agents: int = 3, json: bool = False
) -> None:
    """Share a drive among agents that write one map at once, and compare with one that writes all of it alone.

    Writes `OUT/city.tiles`, `stages.png` (top and front view in the agents' colours after each third of the time),
    `classes.png` and `coverage.png`.

    Args:
        source: The drive; its frames need occupancy.
        out: A new folder.
        agents: How many processes; each takes a stretch of the drive and a part of the next one's.
        json: Print one JSON object.
    """
    from openvocab_occ.export import tile_pictures
    from openvocab_occ.memory.fold import rebuild
    from openvocab_occ.memory.merge import coverage, surface

    if out.exists():
        raise AlreadyExistsError(f"{out} exists", fix="choose a new folder")
    sequence = source.load()
    if not 1 <= agents <= len(sequence):
        raise ConfigError("agents do not share the drive", expected=f"1 to {len(sequence)} agents", got=agents)
    grid = sequence[0].occupancy
    if grid is None:
        raise ConfigError("the drive has no occupancy", fix="give --occupancy PATTERN of your own grids")
    s = grid.spec

    def new(path: Path) -> TileMap:
        cell, z0 = float(s.size[2]), float(s.origin[2])
        return TileMap.create(path, grid.class_names, heights=s.shape[2], cell=cell, z0=z0)

    city = new(out / "city.tiles")
    shares = _shares(len(sequence), agents)
    context = multiprocessing.get_context("spawn")
    with progress("driving") as advance, ProcessPoolExecutor(agents, mp_context=context) as pool:
        jobs = [pool.submit(drive, source, str(out / "city.tiles"), n, share) for n, share in enumerate(shares)]
        done = 0
        for job in as_completed(jobs):
            done += job.result()
            advance(done, sum(map(len, shares)))
    with tempfile.TemporaryDirectory(prefix="openvocab_occ-") as folder:
        alone = new(Path(folder) / "alone.tiles")
        for n, share in enumerate(shares):
            drive(source, str(Path(folder) / "alone.tiles"), n, share)
        equal = _records(city) == _records(alone)
        grown = coverage(city)
        stages = []
        for third in (1, 2):
            until = float(grown.times[0] + (grown.times[-1] - grown.times[0]) * third / 3)
            rebuild(city, out=Path(folder) / str(third), until=until)
            shown = surface(TileMap.open(Path(folder) / str(third)))
            stages.append((f"({'ab'[third - 1]}) {until - grown.times[0]:.1f} s", shown))
    stages.append((f"(c) {grown.times[-1] - grown.times[0]:.1f} s", surface(city)))
    names, cell = city.schema.class_names, city.schema.cell
    tile_pictures.draw_stages(out / "stages.png", stages, names, cell, by="agent")
    tile_pictures.draw_map(out / "classes.png", stages[-1][1], names, cell, by="class")
    tile_pictures.draw_coverage(out / "coverage.png", grown)
    area = {name: round(float(a), 1) for name, a in zip(grown.agent_names, grown.area[-1], strict=True)}
    report = {
        "map": str(out / "city.tiles"), "agents": agents, "writes": sum(map(len, shares)), "equal_to_serial": equal,
        "ground_m2_by_first_agent": area, "synthetic": sequence.synthetic,
    }  # fmt: skip
    if json:
        print_json(report)
        return
    console().print(
        f"{out}/city.tiles  {agents} agents, {report['writes']} writes; the map is "
        + ("equal to" if equal else "NOT EQUAL TO")
        + f" the serial one\nground: {sum(area.values()):,.0f} m² "
        + ", ".join(f"{n} {a:,.0f}" for n, a in area.items())
        + ("  (synthetic data)" if sequence.synthetic else ""),
        markup=False,
    )


def drive(source: Source, path: str, number: int, frames: list[int]) -> int:
    """Write some frames of a drive as one agent; return how many."""
    from openvocab_occ.memory.observe import observe

    city, sequence = TileMap.open(path), source.load()
    agent, first = f"agent-{number + 1}", sequence[frames[0]].timestamp
    for index in frames:
        seen = observe(sequence[index])
        stamp = seen.time - first + _APART * number  # all start together
        city.write(seen.logits, seen.mask, seen.T_world_grid, seen.spec, stamp=stamp, agent=agent, log=agent)
    return len(frames)


def _shares(count: int, agents: int) -> list[list[int]]:
    """Return the frames of each agent: a stretch, and a third of the next one's so that they overlap."""
    edges = [count * n // agents for n in range(agents + 1)]
    overlap = max(1, count // agents // 3)
    return [[*range(edges[n], min(count, edges[n + 1] + overlap))] for n in range(agents)]


def _records(city: TileMap) -> dict[object, bytes]:
    return {key: tile.record.tobytes() for key, tile in city.tiles() if tile.stamps.any()}
