"""Where the shipped demo models are."""

from pathlib import Path

from openvocab_occ.errors import NotFoundError

_PACKAGE = Path(__file__).resolve().parent


def demo_model() -> Path:
    """Return the synthetic segmenter of the synthetic street; an installed wheel carries it, a checkout has models/."""
    places = [_PACKAGE / "demo" / "segmenter.onnx", _PACKAGE.parents[1] / "models" / "demo" / "segmenter.onnx"]
    for place in places:
        if place.is_file():
            return place
    raise NotFoundError(
        "the demo model is not there", expected=" or ".join(map(str, places)), fix="install the package again"
    )
