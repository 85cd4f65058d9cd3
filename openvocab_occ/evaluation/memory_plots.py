"""Charts of what `eval memory` measured."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from openvocab_occ.io.files import written_file

_COLORS = {"newest": "#d64550", "bayes": "#2e86de", "ema": "#26a65b"}


def draw_passes(report: dict[str, Any], path: Path) -> None:
    """Write mIoU by passes, and by day and night with and without the prior."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.6), dpi=150, layout="constrained")
    left, right = figure.subplots(1, 2)
    rows = report["by_pass"]
    for policy, color in _COLORS.items():
        left.plot([r["passes"] for r in rows], [r[policy]["mIoU"] for r in rows], "o-", color=color, label=policy)
    left.set(xlabel="passes over the street", ylabel="mIoU of the map, %", ylim=(0, None))
    left.set_xticks([r["passes"] for r in rows])
    left.legend(frameon=False)
    ways = ("seen", "prior", "seen and prior")
    for at, (condition, color) in enumerate((("clear", "#f0a01e"), ("night", "#34495e"))):
        values = [report[condition][way]["mIoU"] for way in ways]
        bars = right.bar([n + 0.4 * at for n in range(3)], values, 0.38, color=color, label=condition)
        right.bar_label(bars, fmt="%.0f", fontsize=8)
    right.set_xticks([n + 0.2 for n in range(3)], ways)
    right.set(ylabel="mIoU, %", ylim=(0, 80))
    right.legend(frameon=False, title="seen now by", fontsize=8, title_fontsize=8, ncols=2, loc="upper right")
    figure.suptitle("Synthetic city, stand-in for perception", fontsize=9)
    _save(figure, path)


def draw_fence(report: dict[str, Any], path: Path) -> None:
    """Write how much of a demolished fence is left after each look."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3.6), dpi=150, layout="constrained")
    axis = figure.subplots()
    for name, left in report["left"].items():
        looks = report["frames"][name]
        axis.plot(range(len(left)), [100 * share for share in left], "o-", markersize=3,
                  label=f"{name}: {f'more than {len(left) - 1}' if looks is None else looks}")  # fmt: skip
    axis.set(xlabel="looks since it is gone", ylabel="of the fence that the map holds, %")
    axis.set_title("Synthetic fence, stand-in for perception", fontsize=9)
    figure.legend(frameon=False, fontsize=8, title="looks to forget", title_fontsize=8, loc="outside right center")
    _save(figure, path)


def draw_pose_noise(report: dict[str, Any], path: Path) -> None:
    """Write the mIoU of a prior that is read where the vehicle is not."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.6), dpi=150, layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    turns = sorted({row["degrees"] for row in report["sweep"]})
    for axis, what, title in zip(axes, ("prior", "fused"), ("prior alone", "seen and prior"), strict=True):
        for n, turn in enumerate(turns):
            rows = [row for row in report["sweep"] if row["degrees"] == turn]
            axis.plot([row["metres"] for row in rows], [row[what] for row in rows], "o-",
                      color=(0.1 + 0.2 * n, 0.45, 0.9 - 0.2 * n), label=f"{turn:g}°")  # fmt: skip
        axis.axhline(report["seen"], color="grey", linestyle=":", label="seen alone")
        axis.set(xlabel="pose off by, metres", title=title)
    axes[0].set(ylabel="mIoU, %", ylim=(0, None))
    axes[1].legend(frameon=False, fontsize=8, ncols=2)
    figure.suptitle("Synthetic city, stand-in for perception", fontsize=9)
    _save(figure, path)


def draw_revisits(reports: list[dict[str, Any]], path: Path) -> None:
    """Write routes, each place in the colour of how much of a prior was found when it was reached."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2 * len(reports), 4.2), dpi=150, layout="constrained")
    axes = figure.subplots(1, len(reports), squeeze=False)[0]
    points = None
    for axis, report in zip(axes, reports, strict=True):
        p = report["places"]
        points = axis.scatter(p["x"], p["y"], c=p["found"], s=9, cmap="viridis", vmin=0, vmax=1)
        axis.set_title(report["route"], fontsize=9)
        axis.set_aspect("equal", adjustable="datalim")
        axis.set_xlabel("m")
    if points is not None:
        figure.colorbar(points, ax=[*axes], label="of what is seen, with a prior", shrink=0.8)
    _save(figure, path)


PLOTS: dict[str, Callable[[dict[str, Any], Path], None]] = {
    "passes": draw_passes,
    "pose_noise": draw_pose_noise,
    "fence": draw_fence,
}


def _save(figure: Any, path: Path) -> None:
    with written_file(path) as scratch:
        figure.savefig(scratch, format="png")
