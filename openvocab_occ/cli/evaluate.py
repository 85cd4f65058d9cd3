"""`openvocab-occ eval ...`."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import tyro
from rich.table import Table

from openvocab_occ.cli.output import console, print_json
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
