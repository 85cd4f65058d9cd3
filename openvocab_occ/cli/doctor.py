"""`openvocab-occ doctor`."""

from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape
from rich.table import Table

from openvocab_occ.cli.output import console, print_json, progress
from openvocab_occ.cli.source import Source

_COLORS = {"ok": "green", "note": "blue", "warning": "yellow", "error": "red"}


def doctor(
    source: Annotated[Source, tyro.conf.OmitArgPrefixes],
    *,
    look: int = 8,
    report: Path | None = None,
    json: bool = False,
) -> int:
    """Look at a drive before it is mapped: poses, scale, intrinsics, grids, times, files. Says what to try.

    Ends with 0 when nothing is likely wrong, and with 1 when something is.

    Args:
        source: The drive.
        look: How many frames to read, in pairs of neighbours.
        report: Folder to write a page with pictures to (index.html).
        json: Print one JSON object.
    """
    from openvocab_occ.pipeline.doctor.examine import examine
    from openvocab_occ.pipeline.doctor.finding import LEVELS
    from openvocab_occ.pipeline.doctor.report import summary

    with progress("reading") as advance:
        diagnosis = examine(source.load(), frames=look, progress=advance)
    if report is not None:
        diagnosis.write_report(report)
    if json:
        print_json({**diagnosis.to_dict(), "report": None if report is None else str(report)})
    else:
        out = console()
        table = Table(box=None, pad_edge=False, show_header=False)
        for finding in sorted(diagnosis.findings, key=lambda f: -LEVELS.index(f.level)):
            more = (f"\n[dim]{escape(finding.why)}[/dim]" if finding.why else "") + (
                f"\n[bold]try:[/bold] {escape(finding.advice)}" if finding.advice else ""
            )
            color = _COLORS[finding.level]
            table.add_row(f"[{color}]{finding.level}[/{color}]", finding.check, escape(finding.what) + more)
        out.print(f"[bold]{escape(diagnosis.name)}[/bold]  {escape(summary(diagnosis))}")
        out.print(table)
        if report is not None:
            out.print(f"[bold]{report / 'index.html'}[/bold]  the same with pictures")
    return 0 if diagnosis.clean else 1
