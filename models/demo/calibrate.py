"""Turn the demo pair's scores into probabilities, and write that into its card.

Maps drives through cities that neither training nor evaluation sees, and fits how likely an object is what a word
names. `THRESHOLD` was chosen on the same cities: above it, lists of what is there lose more than absent nouns gain.

    python models/demo/calibrate.py            # seeds 3100-3103
"""

from datetime import UTC, datetime
from pathlib import Path

from msgspec import structs

from openvocab_occ.evaluation.grounding_drive import drive_city
from openvocab_occ.evaluation.object_calibration import fit_objects, object_pairs
from openvocab_occ.evaluation.segmenter import lexicon_of
from openvocab_occ.segmentation.card_files import read_card, write_card
from openvocab_occ.segmentation.onnx import load_encoder

SEEDS = (3100, 3101, 3102, 3103)
THRESHOLD = 0.2
MODEL = Path(__file__).parent / "segmenter.onnx"


def main() -> None:
    """Fit and write."""
    encoder, words = load_encoder(MODEL), dict(lexicon_of(MODEL) or {})
    pairs = [object_pairs(drive_city(seed, encoder), encoder, seed, words) for seed in SEEDS]
    fitted = fit_objects(
        pairs,
        dataset=f"synthetic city, seeds {SEEDS[0]}-{SEEDS[-1]}",
        date=datetime.now(UTC).date().isoformat(),
    )
    path = MODEL.with_suffix(".card.yaml")
    card, lines = read_card(path), path.read_text().splitlines(keepends=True)
    write_card(structs.replace(card, score=structs.replace(card.score, calibration=fitted, threshold=THRESHOLD)), path)
    path.write_text("".join(line for line in lines if line.startswith("#")) + path.read_text())
    print(fitted)


if __name__ == "__main__":
    main()
