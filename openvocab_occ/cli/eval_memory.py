"""`openvocab-occ eval memory`: what the global map is good for."""

import json as text
import tempfile
from pathlib import Path
from typing import Any, Literal

from openvocab_occ.cli.output import console, print_json, progress
from openvocab_occ.errors import AlreadyExistsError

Showing = Literal["passes", "pose_noise", "fence"]


def memory(
    *,
    showings: tuple[Showing, ...] = ("passes", "pose_noise", "fence"),
    trajectories: tuple[Path, ...] = (),
    out: Path | None = None,
    json: bool = False,
) -> None:
    """Show what the global map is good for, in the demo city with a stand-in for perception. All of it is synthetic.

    Args:
        showings: `passes`: mIoU of the map by number of passes, and of a prior of the day at night; `pose_noise`: the
            prior of a vehicle that is not where it believes; `fence`: in how many looks each policy forgets.
        trajectories: KITTI odometry files: who comes again finds what was there, in made-up streets.
        out: A new folder for a chart and the numbers of each.
        json: Print one JSON object.
    """
    from openvocab_occ.evaluation.memory_plots import PLOTS, draw_revisits
    from openvocab_occ.evaluation.memory_routes import revisits
    from openvocab_occ.evaluation.memory_showings import SHOWINGS

    if out is not None:
        if out.exists():
            raise AlreadyExistsError(f"{out} exists", fix="choose a new folder")
        out.mkdir(parents=True)
    reports: dict[str, Any] = {}
    total = len(showings) + len(trajectories)
    with progress("showing", unit="showings") as advance:
        for name in showings:
            with tempfile.TemporaryDirectory(prefix="openvocab_occ-") as folder:
                reports[name] = SHOWINGS[name](Path(folder))
            if out is not None:
                PLOTS[name](reports[name], out / f"{name}.png")
            advance(len(reports), total)
        routes: list[dict[str, Any]] = []
        for path in trajectories:
            with tempfile.TemporaryDirectory(prefix="openvocab_occ-") as folder:
                routes.append(revisits(path, Path(folder)))
            advance(len(reports) + len(routes), total)
    if routes:
        reports["revisits"] = routes
        if out is not None:
            draw_revisits(routes, out / "revisits.png")
    if out is not None:
        (out / "report.json").write_text(text.dumps(reports, indent=1))
    print_json(reports) if json else console().print("\n".join(_lines(reports)), markup=False)


def _lines(reports: dict[str, Any]) -> list[str]:
    lines = ["(synthetic data)"]
    if "passes" in reports:
        found = reports["passes"]
        for row in found["by_pass"]:
            scores = ", ".join(f"{policy} {row[policy]['mIoU']:.1f}" for policy in ("newest", "bayes", "ema"))
            lines.append(f"{row['passes']} passes    mIoU of the map: {scores}")
        for condition in ("clear", "night"):
            scores = ", ".join(f"{way} {score['mIoU']:.1f}" for way, score in found[condition].items())
            lines.append(f"{condition:<11} mIoU: {scores}")
    if "pose_noise" in reports:
        for row in reports["pose_noise"]["sweep"]:
            made = f", map written so {row['written']:.1f}" if "written" in row else ""
            lines.append(f"off by {row['metres']:.1f} m, {row['degrees']:.1f}°   mIoU: prior {row['prior']:.1f}, "
                         f"with what is seen {row['fused']:.1f}{made}")  # fmt: skip
    if "fence" in reports:
        for name, looks in reports["fence"]["frames"].items():
            lines.append(f"fence       {name}: forgotten after {looks if looks is not None else 'more than were made'}")
    for found in reports.get("revisits", []):
        again, new = found["again"], found["new"]
        lines.append(f"{found['route']:<14} {again['windows']} places again: {again['found']:.1%} found, "
                     f"{again['right']:.1%} of it right; {new['windows']} new places: at most {new['most_found']:.1%}; "
                     f"{found['gb_per_km2']:.2f} GB/km² (dense {found['dense_gb_per_km2']:.2f})")  # fmt: skip
    return lines
