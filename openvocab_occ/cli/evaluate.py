"""`openvocab-occ eval ...`."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import tyro
from rich.table import Table

from openvocab_occ.cli.output import console, print_json, progress
from openvocab_occ.cli.source import Source


def keyframe(
    source: Annotated[Source, tyro.conf.OmitArgPrefixes],
    *,
    encoder: Path,
    card: Path | None = None,
    word: str = "road",
    index: int = 0,
    held_out: float = 0.2,
    seed: int = 0,
    json: bool = False,
) -> None:
    """Judge depth and answers by the LiDAR of a real keyframe.

    Args:
        source: The drive; its frames need LiDAR points.
        encoder: A 2D model with label names, an ONNX file.
        card: The model's card, if it does not lie beside it.
        word: What to ask for.
        index: Which frame.
        held_out: Share of the LiDAR returns that the depth grid does not see.
        seed: Chooses them.
        json: Print one JSON object.
    """
    from openvocab_occ.evaluation.keyframe import judge_keyframe
    from openvocab_occ.segmentation.onnx import load_encoder

    report = judge_keyframe(source.load()[index], load_encoder(encoder, card), word, held_out=held_out, seed=seed)
    if json:
        print_json(asdict(report))
        return
    out = console()
    depth = report.depth
    out.print(
        f"[bold]depth[/bold]  grid of {1 - held_out:.0%} of the returns against the other {depth.points:,} on images: "
        f"median {depth.median_m:.2f} m, 90 % within {depth.p90_m:.2f} m, bias {depth.bias_m:+.2f} m, "
        f"depth at {depth.hit:.0%}"
    )
    table = Table("map", f'under "{word}" pixels', "under other pixels", "gap", box=None, pad_edge=False)
    for name, words in (("true cameras", report.words), ("mirrored (control)", report.control)):
        table.add_row(name, f"{words.share_under:.1%} of {words.points_under:,}",
                      f"{words.share_elsewhere:.1%} of {words.points_elsewhere:,}", f"{words.gap:+.1%}")  # fmt: skip
    out.print(f'\n[bold]words[/bold]  share of LiDAR returns in voxels that answer "{word}"')
    out.print(table)


def segmenter(
    *,
    encoder: Path | None = None,
    card: Path | None = None,
    seeds: tuple[int, ...] = (),
    condition: str = "clear",
    json: bool = False,
) -> None:
    """Judge a dense model by pixels and words on the synthetic city.

    Args:
        encoder: An ONNX file; the shipped model by default.
        card: The model's card, if it does not lie beside it.
        seeds: Of cities; by default those that nothing was trained or chosen on.
        condition: Weather: clear, rain, night, fog, heavy traffic.
        json: Print one JSON object.
    """
    from openvocab_occ.evaluation.segmenter import EVALUATION_SEEDS, evaluate, lexicon_of
    from openvocab_occ.segmentation.demo_models import demo_model
    from openvocab_occ.segmentation.onnx import load_encoder

    path = encoder or demo_model()
    with progress("pictures of synthetic streets", unit="pictures") as advance:
        report = evaluate(
            load_encoder(path, card),
            seeds=seeds or EVALUATION_SEEDS,
            condition=condition,
            lexicon=lexicon_of(path),
            progress=advance,
        )
    if json:
        print_json(report)
        return
    say = console().print
    say(f"[bold]{report['model']}[/bold]  {report['pictures']} pictures of synthetic streets, seeds "
        f"{', '.join(map(str, report['seeds']))}, {report['condition']}")  # fmt: skip
    say(f"  class mIoU {report['class_miou']:.3f}, {report['ms_per_image']:.1f} ms an image")
    table = Table("class", "IoU", box=None, pad_edge=False)
    table.columns[1].justify = "right"
    for name, value in sorted(report["class_iou"].items(), key=lambda item: -item[1]):
        table.add_row(name, f"{value:.2f}")
    say(table)
    pairs = ", ".join(f"{k} {'not seen' if v is None else f'{v:.2f}'}" for k, v in report["never_rendered_iou"].items())
    say(f"  colour and class never seen together, IoU: {pairs}")
    if "lexicon_top1" in report:
        say(f"  words of the lexicon nearest to their class: {report['lexicon_top1']:.0%}")
    wrong = ", ".join(f"{word} ({near})" for word, near in report["unseen_synonyms_wrong"].items())
    say(f"  other words nearest to their class: {report['unseen_synonyms_top1']:.0%}; not: {wrong}")
    say(f"  things that are not there fire on {report['absent_fired_median']:.1%} of cells in the median, "
        f"{report['absent_fired_worst']:.1%} at worst")  # fmt: skip
