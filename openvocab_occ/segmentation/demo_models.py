"""Where the shipped models are: in the checkout for an editable install, inside the package for an installed wheel."""

from pathlib import Path

from openvocab_occ.errors import NotFoundError

_PACKAGE = Path(__file__).resolve().parent


def demo_model() -> Path:
    """Return the segmenter of the synthetic city, whose words lie beside it."""
    return _shipped("demo")


def street_model() -> Path:
    """Return the classifier of flat colours of the small synthetic street."""
    return _shipped("street")


def _shipped(name: str) -> Path:
    places = [_PACKAGE / name / "segmenter.onnx", _PACKAGE.parents[1] / "models" / name / "segmenter.onnx"]
    for place in places:
        if place.is_file():
            return place
    raise NotFoundError(
        f"the {name} model is not there", expected=" or ".join(map(str, places)), fix="install the package again"
    )
