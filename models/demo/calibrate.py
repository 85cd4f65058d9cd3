"""Fit the probability of a hit on maps of drives through cities of seeds 3100-3103, and write it into the card.

A pair of an object and a class's name is right where most of the object's voxels are of a thing of that class. The
cities are used for nothing else but choosing thresholds; evaluation has others.

    python models/demo/calibrate.py       # ten minutes on two cores
"""

import sys
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from msgspec import structs

from openvocab_occ.evaluation.grounding_drive import ALSO, STUFF, drive_city
from openvocab_occ.evaluation.words import CLASSES
from openvocab_occ.segmentation.card_files import read_card, write_card
from openvocab_occ.segmentation.onnx import load_encoder
from openvocab_occ.segmentation.scoring import fit_platt

HERE = Path(__file__).parent
SEEDS = (3100, 3101, 3102, 3103)
SAME = 0.25  # IoU from which an object is a true thing


def main() -> None:
    """Write the calibration of segmenter.onnx."""
    path = HERE / "segmenter.onnx"
    encoder = load_encoder(path)
    assert encoder.text is not None
    names = [name for name in CLASSES if name not in STUFF]
    words = encoder.text.encode(names)
    cosines: list[float] = []
    right: list[bool] = []
    for seed in SEEDS:
        drive = drive_city(seed, encoder)
        overlap, kinds = drive.overlap(), {thing.id: thing.kind for thing in drive.truth.things}
        for item in drive.scene.objects:
            ious = {id: overlap(item, id) for id in kinds}
            best = max(ious, key=lambda id: ious[id])
            kind = kinds[best] if ious[best] >= SAME else ""
            doubtful = {other for name, others in ALSO.items() if kind in others for other in (name,)}
            for name, cosine in zip(names, words @ item.embedding, strict=True):
                if name not in doubtful:
                    cosines.append(float(cosine))
                    right.append(name == kind)
        print(f"city {seed}: {len(cosines):,} pairs, {sum(right)} right", file=sys.stderr)
    found = fit_platt(np.array(cosines), np.array(right), dataset=f"objects of synthetic cities {SEEDS[0]}-{SEEDS[-1]}",
                      date=datetime.now(UTC).date().isoformat())  # fmt: skip
    file = path.with_suffix(".card.yaml")
    card = read_card(file)
    comment = "\n".join(line.lstrip("# ") for line in file.read_text().splitlines() if line.startswith("#"))
    write_card(
        structs.replace(card, score=structs.replace(card.score, calibration=found, threshold=None)),
        file,
        comment=comment,
    )
    print(found)


if __name__ == "__main__":
    main()
