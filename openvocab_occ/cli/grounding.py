"""`openvocab-occ eval grounding` and `openvocab-occ bench query`."""

from dataclasses import asdict

from rich.table import Table

from openvocab_occ.cli.output import console, print_json, progress


def grounding(*, seeds: tuple[int, ...] = (100, 101), json: bool = False) -> None:
    """Judge answers about the demo city against its truth.

    Maps are made of the truth itself, so what is below 100 % is the fault of the queries alone. Synthetic.

    Args:
        seeds: Of the towns, and of the questions about them.
        json: Print one JSON object.
    """
    from openvocab_occ.evaluation.grounding import calibration_of, judge_truth, summarize

    outcomes = []
    with progress("asking", unit="towns") as advance:
        for done, seed in enumerate(seeds, start=1):
            outcomes += judge_truth([seed])
            advance(done, len(seeds))
    scores = summarize(outcomes)
    if json:
        report = {name: asdict(score) for name, score in scores.items()}
        facts = {"seeds": list(seeds), "synthetic": True, "map": "truth", "ece": calibration_of(outcomes)}
        print_json({**facts, "scores": report})
        return
    table = Table("category", "questions", "Acc@.25", "mAP", "verdict", "count", "within one", "false found", box=None)
    for name, score in scores.items():
        counts = (score.count_exact, score.count_within_one, score.false_found)
        shares = (score.accuracy["0.25"], score.mean_precision, score.verdicts, *counts)
        table.add_row(name, str(score.questions), *(f"{share:.1%}" for share in shares))
    console().print(f"maps of the truth of the synthetic city, seeds {', '.join(map(str, seeds))}")
    console().print(table)


def bench_query(*, voxels: int = 1_000_000, dim: int = 512, objects: int = 100_000, json: bool = False) -> None:
    """Time queries against plain matrix products.

    Args:
        voxels: Rows of the feature table.
        dim: Its columns.
        objects: Of the made-up map that is asked.
        json: Print one JSON object.
    """
    from openvocab_occ.evaluation.grounding_bench import time_queries

    times = time_queries(voxels=voxels, dim=dim, objects=objects)
    if json:
        print_json(asdict(times) | {"ratio": times.ratio})
        return
    out = console()
    took = f"{times.score * 1e3:.0f} ms, {times.ratio:.2f} x torch ({times.threads} threads)"
    out.print(f"scoring {voxels:,} voxels of {dim}: {took}")
    for name in ("find_noun", "find_parked", "find_relation"):
        out.print(f"{name.replace('_', ' ')} among {objects:,} objects: {getattr(times, name) * 1e3:.1f} ms")
