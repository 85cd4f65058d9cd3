"""`openvocab-occ bench ...`."""

import datetime
import platform
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

from rich.table import Table

from openvocab_occ.cli.output import console, print_json

_REAL = Path("../shared/data/occ3d/labels.npz")  # beside a checkout


def depth(
    *,
    labels: Path | None = None,
    rounds: int = 5,
    threads: tuple[int, ...] = (1, 2),
    peers: tuple[Literal["open3d", "embreex", "walk", "sampling"], ...] = ("open3d", "embreex", "walk"),
    width: int = 1600,
    height: int = 900,
    json: bool = False,
) -> None:
    """Time depth images of six cameras beside other ways to them, in one run on one grid.

    The peer `sampling`, the paper's in torch, takes minutes.

    Args:
        labels: `labels.npz` of Occ3D; by default the one beside the checkout, else the synthetic street.
        rounds: Runs of each way.
        threads: Numbers of threads to try.
        peers: What to compare with.
        width: Pixels of an image.
        height: Pixels of an image.
        json: Print one JSON object.
    """
    from openvocab_occ.evaluation.bench_depth import bench_depth

    found = labels or (_REAL if _REAL.exists() else None)
    report = bench_depth(found, rounds=rounds, threads=threads, peers=peers, width=width, height=height)
    machine = f"{platform.machine()}, {platform.system()}, {datetime.datetime.now(datetime.UTC).date()}"
    if json:
        print_json({**asdict(report), "machine": machine})
        return
    out = console()
    out.print(f"{report.grid}, {report.cameras} cameras of {width} x {height}, median of {rounds}, {machine}\n")
    table = Table("way", "threads", "seconds", "CPU seconds", "million rays/s", "ratio", "off by 1 cm", box=None)
    for t in report.timings:
        table.add_row(
            t.name, str(t.threads), f"{t.seconds:.3f}", f"{t.cpu_seconds:.3f}", f"{t.rays_per_second / 1e6:.1f}",
            f"{t.ratio:.1f}", f"{t.differ:.1e}",
        )  # fmt: skip
    out.print(table)
    out.print(
        f"\nours, one thread: again on the same grid {report.seconds_again:.3f} s, sampled at 0.1 m "
        f"{report.seconds_sampled:.3f} s (reads more than 0.2 m too far on {report.samples_late:.2%} of the pixels), "
        f"`pixel` visibility {report.seconds_visible:.3f} s; half the voxel size in x and y takes "
        f"{report.half_voxel_ratio:.2f} times as long; peak memory {report.memory_over_output:.2f} times the output"
    )


def surface(*, city: int | None = None, json: bool = False) -> None:
    """Judge depth from voxels, and from the smooth surface of labels and of logits, by synthetic meshes.

    Args:
        city: Seed of a synthetic city to judge by as well, besides three small scenes.
        json: Print one JSON object.
    """
    from openvocab_occ.evaluation.mesh_scenes import city_errors, surface_errors

    errors = surface_errors() + (() if city is None else city_errors(city))
    if json:
        print_json({"errors": [asdict(error) for error in errors]})
        return
    table = Table("mesh", "surface", "median", "90 % within", "bias", "seen by one only", box=None, pad_edge=False)
    for e in errors:
        table.add_row(
            e.scene, e.surface, f"{e.median_m:.3f} m", f"{e.p90_m:.3f} m", f"{e.bias_m:+.3f} m", f"{e.misses:.1%}"
        )
    console().print(table)


def lift(*, labels: Path | None = None, rounds: int = 5, json: bool = False) -> None:
    """Time the lift of one 1600 x 900 view with 512 features beside dense ways, on one thread.

    Args:
        labels: `labels.npz` of Occ3D; by default the one beside the checkout, else the synthetic street.
        rounds: Runs of each way.
        json: Print one JSON object.
    """
    from openvocab_occ.evaluation.bench_mapping import bench_lift

    _report(bench_lift(labels or (_REAL if _REAL.exists() else None), rounds=rounds), json=json)


def fuse(*, frames: int = 500, json: bool = False) -> None:
    """Time fusing a loop that is driven twice: does a frame's cost, or the memory, grow with the drive?

    Args:
        frames: Keyframes in all.
        json: Print one JSON object.
    """
    from openvocab_occ.evaluation.bench_mapping import bench_fuse

    _report(bench_fuse(frames=frames), json=json)


def map(*, labels: Path | None = None, rounds: int = 5, frames: int = 40, json: bool = False) -> None:
    """Time whole keyframes without the network, RGB-D frames beside object clouds, and the size of a file.

    Args:
        labels: `labels.npz` of Occ3D; by default the one beside the checkout, else the synthetic street.
        rounds: Keyframes of six views.
        frames: RGB-D frames of a synthetic room.
        json: Print one JSON object.
    """
    from openvocab_occ.evaluation.bench_mapping import bench_map

    found = labels or (_REAL if _REAL.exists() else None)
    _report(bench_map(found, rounds=rounds, frames=frames), json=json)


def _report(report: dict[str, Any], *, json: bool) -> None:
    machine = f"{platform.machine()}, {platform.system()}, {datetime.datetime.now(datetime.UTC).date()}"
    if json:
        print_json({**report, "machine": machine})
        return
    out = console()
    out.print(machine)
    for name, value in report.items():
        if isinstance(value, dict):
            out.print(f"\n[bold]{name}[/bold]")
            for inner, number in value.items():
                out.print(f"  {inner:<28} {_short(number)}", markup=False)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            table = Table(*value[0], box=None)
            for row in value:
                table.add_row(*(_short(cell) for cell in row.values()))
            out.print(table)
        else:
            out.print(f"{name:<30} {_short(value)}", markup=False)


def _short(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return ", ".join(f"{k} {_short(v)}" for k, v in value.items()) if isinstance(value, dict) else str(value)
