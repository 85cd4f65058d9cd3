"""`openvocab-occ bench ...`."""

import datetime
import platform
from dataclasses import asdict
from pathlib import Path
from typing import Literal

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
