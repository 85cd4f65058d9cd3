"""From evaluations to numbers with intervals, tables and plots."""

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.lmpocc.experiments import read_rows
from benchmarks.lmpocc.scales import Scale
from openvocab_occ.io.files import written_file
from openvocab_occ.training.statistics import GROUPS, Interval, Outcome, Row, chosen, gain, outcome_of

BEGIN, END = "<!-- results: written by python -m benchmarks.lmpocc -->", "<!-- end of results -->"
NAMES = {
    "base": "frozen baseline",
    "head": "control: its head trained on, as many steps",
    "empty": "LMOP, empty prior",
    "other_logs": "LMOP, prior from other logs",
    "all": "LMOP, prior from all frames before (the paper's protocol)",
    "elsewhere": "LMOP, prior from the wrong place",
    "own_log": "LMOP, prior from its own drive alone",
    "other_scenes": "LMOP, prior from other scenes",
    "write-gate": "LMOP, a learned gate writes",
    "policy-overwrite": "LMOP, written: what is hidden is forgotten",
    "policy-ema": "LMOP, written: mean of old and new",
    "policy-bayes": "LMOP, written: sum of old and new",
    "removed-v1": "LMOP, dynamic things not written (v1)",
    "removed-v2": "LMOP, dynamic things replaced by free (v2)",
    "mask-truth": "LMOP, written: what the data set's mask has",
    "mask-none": "LMOP, written: everything",
    "noise-0.2m": "LMOP, read 0.2 m and 0.4 degrees off",
    "noise-0.5m": "LMOP, read 0.5 m and 1 degree off",
    "noise-1m": "LMOP, read 1 m and 2 degrees off",
    "written-by-base": "LMOP, map written by the frozen baseline",
    "written-by-truth": "LMOP, map written from the labels (no network could do better)",
}
WRITING = ("write-gate", "policy-overwrite", "policy-ema", "policy-bayes", "removed-v1", "removed-v2", "mask-truth",
           "mask-none", "written-by-base", "written-by-truth")  # fmt: skip
"""Ways that differ from `other_logs` in what is written alone."""
Seeds = list[list[Row]]
_SAID = {True: "yes", False: "no", None: "says nothing: the control knows no dynamic class"}


def report(scale: Scale, out: Path, *, command: str, where: str, docs: Path | None = None) -> dict[str, Any]:
    """Write `results.json`, `tables.md` and plots into a folder, and tables into a page."""
    found: dict[str, Any] = {"command": command, "where": where, "synthetic": True, "scale": asdict(scale)}
    text: list[str] = []
    for name in scale.networks:
        rows = _read(scale, out / name / "results")
        found[name] = numbers(rows)
        text += [f"### {name}", "", *tables(rows, found[name])]
        _plots(found[name], out, name)
        _writing_plot(found[name], out, name)
        if docs is not None:
            text += _pictures(out, docs, name)
    base, memory, seeds = scale.base, scale.memory, ", ".join(map(str, scale.seeds))
    size = (
        f"{len(scale.train.cities)} cities to train and {len(scale.test.cities)} others to test, {scale.train.visits} "
        f"visits of {scale.train.frames} frames each; baseline {base.steps} steps of {base.batch}, memory and control "
        f"{memory.steps} of {memory.batch}; gates {scale.gate_training.steps} steps on {len(scale.gate.cities)} more "
        f"cities; seeds {seeds} of memory and control on one baseline. `{command}`, {where}. "
        "Synthetic."
    )
    text = [size, "", *text]
    with written_file(out / "results.json") as scratch:
        scratch.write_text(json.dumps(found, indent=1))
    with written_file(out / "tables.md") as scratch:
        scratch.write_text("\n".join(text))
    if docs is not None:
        page = docs.read_text()
        before, rest = page.split(BEGIN)
        after = rest.split(END)[1]
        with written_file(docs) as scratch:
            scratch.write_text(before + BEGIN + "\n\n" + "\n".join(text).rstrip() + "\n\n" + END + after)
    return found


def numbers(rows: dict[str, Seeds]) -> dict[str, Any]:
    """Return mIoU of every way, and gains with 95 % intervals, on all visits but the first."""
    later = {int(str(row["visit"])) for row in rows["base"][0]} - {0}
    conditions = sorted({str(row["condition"]) for row in rows["base"][0]})
    outcome = {way: outcome_of(seeds, visits=later) for way, seeds in rows.items()}
    found: dict[str, Any] = {"ways": {}, "gains": {}, "by_visit": {}, "by_condition": {}}
    for way, seeds in rows.items():
        values = {g: _mean(outcome[way], g, outcome["base"]) for g in GROUPS}
        regions = {r: outcome_of(seeds, r, visits=later) for r in ("covered", "uncovered", "hidden_covered")}
        parts = {r: _mean(o, "all", o) for r, o in regions.items()}
        remembered = outcome_of(seeds, "map", visits=later)
        parts["map"] = _mean(remembered, "all", remembered)
        found["ways"][way] = {**values, "geometric": outcome[way].geometric, **parts}
    pairs = [("head", "base"), ("empty", "head"), ("other_logs", "head"), ("other_logs", "empty"), ("all", "head"),
             ("all", "other_logs"), ("elsewhere", "head")]  # fmt: skip
    pairs += [(way, "other_logs") for way in list(rows)[list(rows).index("elsewhere") + 1 :]]
    for a, b in pairs:
        if a in rows and b in rows:
            found["gains"][f"{a} - {b}"] = {g: asdict(gain(outcome[a], outcome[b], g)) for g in GROUPS}
    for visit in sorted({0, *later}):
        a, b = (outcome_of(rows[w], visits={visit}) for w in ("other_logs", "head"))
        found["by_visit"][visit] = {g: asdict(gain(a, b, g)) for g in GROUPS}
    for condition in conditions:
        a, b = (outcome_of(rows[w], visits=later, conditions={condition}) for w in ("other_logs", "empty"))
        found["by_condition"][condition] = {g: asdict(gain(a, b, g)) for g in GROUPS}
    for region, what in (("covered", "where a prior is"), ("hidden_covered", "hidden now, seen before")):
        a, b = (outcome_of(rows[w], region, visits=later) for w in ("other_logs", "empty"))
        found["gains"][f"other_logs - empty, {what}"] = {g: asdict(gain(a, b, g)) for g in GROUPS}
    if "other_logs" in rows:
        replaced = outcome_of(rows["other_logs"], "map", visits=later)
        found["map_gains"] = {
            way: {g: asdict(gain(outcome_of(rows[way], "map", visits=later), replaced, g)) for g in GROUPS}
            for way in WRITING if way in rows
        }  # fmt: skip
    found["bars"] = _bars(found["gains"], found["ways"]["head"]["dynamic"])
    return found


def tables(rows: dict[str, Seeds], found: dict[str, Any]) -> list[str]:
    """Return Markdown."""
    text = [
        "mIoU in percent, camera mask, visits after the first, mean of seeds; where the prior knows something and "
        "where not; and the mIoU of the map itself, of what it knows where the frame's truth can tell:",
        "",
        "| | all | dynamic | static | geometric | with prior | without | map |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for way, v in found["ways"].items():
        cells = [v[k] for k in ("all", "dynamic", "static", "geometric", "covered", "uncovered", "map")]
        text.append(
            f"| {NAMES.get(way, way)} | " + " | ".join("" if math.isnan(c) else f"{c:.2f}" for c in cells) + " |"
        )
    text += ["", "Differences in points of mIoU, 95 % intervals of a bootstrap over seeds and cities:", "",
             "| | all | dynamic | static |", "|---|---|---|---|"]  # fmt: skip
    text += [_line(pair, values) for pair, values in found["gains"].items()]
    if found.get("map_gains"):
        text += ["", "What is written, against the paper's replacing; mIoU of the map itself:", "",
                 "| | all | dynamic | static |", "|---|---|---|---|"]  # fmt: skip
        text += [_line(NAMES[way], values) for way, values in found["map_gains"].items()]
    text += ["", "other logs against the head-only control, by the number of earlier visits:", "",
             "| earlier visits | all | dynamic | static |", "|---|---|---|---|"]  # fmt: skip
    text += [_line(str(visit), values) for visit, values in found["by_visit"].items()]
    text += [
        "",
        "other logs against the empty prior, by condition:",
        "",
        "| | all | dynamic | static |",
        "|---|---|---|---|",
    ]
    text += [_line(condition, values) for condition, values in found["by_condition"].items()]
    text += ["", "| bar | measured | reached |", "|---|---|---|"]
    text += [f"| {bar['bar']} | {bar['measured']} | {_SAID[bar['reached']]} |" for bar in found["bars"]]
    return [*text, ""]


def _bars(gains: dict[str, Any], dynamic_of_control: float) -> list[dict[str, Any]]:
    def at(pair: str, group: str) -> Interval:
        return Interval(**gains[pair][group])

    found = []
    for other in ("head", "empty"):
        value = at(f"other_logs - {other}", "static")
        found.append({"bar": f"static gain of other logs over {other} has its interval above 0", "measured": str(value),
                      "reached": value.low > 0})  # fmt: skip
    dynamic, wrong = at("other_logs - head", "dynamic"), at("elsewhere - head", "all")
    found.append({"bar": "dynamic classes not more than 0.5 below the control", "measured": str(dynamic),
                  "reached": dynamic.mean >= -0.5 if dynamic_of_control > 1 else None})  # fmt: skip
    found.append({"bar": "a prior from the wrong place not more than 0.5 below the control", "measured": str(wrong),
                  "reached": wrong.mean >= -0.5})  # fmt: skip
    return found


def _mean(outcome: Outcome, group: str, classes_of: Outcome) -> float:
    classes = chosen(group, classes_of)
    return float(outcome.values(classes).mean()) if classes else math.nan


def _line(name: str, values: dict[str, Any]) -> str:
    return f"| {name} | " + " | ".join(str(Interval(**values[g])) for g in GROUPS) + " |"


def _read(scale: Scale, folder: Path) -> dict[str, Seeds]:
    found: dict[str, Seeds] = {"base": [read_rows(folder / "base.json.gz")]}
    names = sorted({p.name.removesuffix(".json.gz").rsplit("-", 1)[0] for p in folder.glob("*-[0-9]*.json.gz")})
    order = [n for n in NAMES if n in names] + [n for n in names if n not in NAMES]
    for name in order:
        paths = [folder / f"{name}-{seed}.json.gz" for seed in scale.seeds]
        if all(path.exists() for path in paths):  # a way that is not done for every seed is not compared
            found[name] = [read_rows(path) for path in paths]
    return found


def _plots(found: dict[str, Any], out: Path, name: str) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    for group, color in (("static", "tab:blue"), ("dynamic", "tab:orange")):
        visits = sorted(found["by_visit"])
        points = [found["by_visit"][v][group] for v in visits]
        _errors(left, visits, points, color, group)
        names = sorted(found["by_condition"])
        shift = -0.08 if group == "static" else 0.08
        _errors(
            right,
            [i + shift for i in range(len(names))],
            [found["by_condition"][n][group] for n in names],
            color,
            group,
            line=False,
        )
        right.set_xticks(range(len(names)), names)
    left.set_xticks(sorted(found["by_visit"]))
    left.set_xlabel("earlier visits of the place by other logs")
    left.set_title("against the head-only control", fontsize=10)
    right.set_title("against an empty prior, by condition", fontsize=10)
    for axis in (left, right):
        axis.axhline(0, color="0.6", linewidth=0.8)
        axis.set_ylabel("gain, points of mIoU")
        axis.spines[["top", "right"]].set_visible(False)
        axis.legend(frameon=False)
    figure.suptitle(f"{name}: prior from other logs, geo-disjoint cities (synthetic), 95 % intervals", fontsize=10)
    figure.savefig(out / f"{name}.png", dpi=120)
    plt.close(figure)


def _writing_plot(found: dict[str, Any], out: Path, name: str) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    ways = [way for way in WRITING if way in found.get("map_gains", {}) and way != "written-by-truth"]
    if not ways:
        return
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.5, 1.2 + 0.36 * len(ways)), layout="constrained", sharey=True)
    for axis, color, what, values in (
        (left, "tab:blue", "the map itself", [found["map_gains"][w]["all"] for w in ways]),
        (
            right,
            "tab:orange",
            "the next visit's prediction",
            [found["gains"][f"{w} - other_logs"]["all"] for w in ways],
        ),
    ):
        mean = [v["mean"] for v in values]
        sides = [[max(v["mean"] - v["low"], 0) for v in values], [max(v["high"] - v["mean"], 0) for v in values]]
        axis.errorbar(mean, range(len(ways)), xerr=sides, fmt="o", color=color, capsize=3, markersize=4)
        axis.axvline(0, color="0.6", linewidth=0.8)
        axis.set_title(what, fontsize=10)
        axis.set_xlabel("points of mIoU")
        axis.spines[["top", "right"]].set_visible(False)
    left.set_yticks(range(len(ways)), [NAMES[w].removeprefix("LMOP, ") for w in ways])
    left.invert_yaxis()
    figure.suptitle(f"{name}: ways to write against replacing what is seen (synthetic), 95 % intervals", fontsize=10)
    figure.savefig(out / f"{name}-writing.png", dpi=120)
    plt.close(figure)


def _pictures(out: Path, docs: Path, name: str) -> list[str]:
    """Copy plots beside a page, and return what shows them."""
    shown: list[str] = []
    for file, what in ((f"{name}.png", "gains by visit and by condition"),
                       (f"{name}-writing.png", "ways to write the map")):  # fmt: skip
        if (out / file).exists():
            with written_file(docs.parent / "images" / f"lmpocc-{file}") as scratch:
                scratch.write_bytes((out / file).read_bytes())
            shown += [f"![{what}](images/lmpocc-{file})", ""]
    return shown


def _errors(
    axis: Any, x: list[float], points: list[dict[str, float]], color: str, label: str, *, line: bool = True
) -> None:
    mean = [p["mean"] for p in points]
    low = [max(p["mean"] - p["low"], 0) for p in points]
    high = [max(p["high"] - p["mean"], 0) for p in points]
    axis.errorbar(x, mean, [low, high], marker="o", color=color, label=label, capsize=3, linewidth=1.2,
                  linestyle="-" if line else "none", elinewidth=1.2)  # fmt: skip
