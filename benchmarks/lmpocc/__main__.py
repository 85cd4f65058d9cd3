"""Run the experiments, or go on with them, and report.

python -m benchmarks.lmpocc core --out out/lmpocc           # within three hours on two cores
python -m benchmarks.lmpocc full --out out/full --device cuda
python -m benchmarks.lmpocc core --out out/lmpocc --docs docs/lmpocc.md    # and renew the tables there
"""

import datetime
import os
import platform
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro

from benchmarks.lmpocc.experiments import run
from benchmarks.lmpocc.report import report
from benchmarks.lmpocc.scales import SCALES


def main(
    scale: Annotated[Literal["smoke", "reduced", "core", "full"], tyro.conf.Positional] = "core",
    *,
    out: Path = Path("out/lmpocc"),
    device: str = "cpu",
    threads: int | None = None,
    seeds: tuple[int, ...] = (),
    docs: Path | None = None,
    report_only: bool = False,
) -> None:
    """Do what is not done yet, and write OUT/results.json, OUT/tables.md and OUT/*.png.

    Args:
        scale: How large.
        out: Folder; stopped, the same command goes on there.
        device: Of the networks.
        threads: Of torch and of kernels.
        seeds: Only these, once the latents are there: several processes may share the work. All by default.
        docs: A page whose results between two marks are renewed.
        report_only: Only report what is there.
    """
    from openvocab_occ._jit import limit_threads

    if threads:
        torch.set_num_threads(threads)
    count = threads or os.cpu_count() or 1
    with limit_threads(count):
        if not report_only:
            run(SCALES[scale], out, device=device, seeds=seeds, tell=lambda text: print(text, flush=True))
    where = f"{platform.machine()}, {count} threads, {device}, {datetime.date.today()}"
    if seeds:
        return
    report(SCALES[scale], out, command=f"python -m benchmarks.lmpocc {scale}", where=where, docs=docs)


if __name__ == "__main__":
    tyro.cli(main)
