"""Model cards: what an ONNX file does not say about itself."""

import re
from collections.abc import Mapping
from math import isfinite
from pathlib import Path
from typing import Any, Literal

import msgspec
import yaml

from openvocab_occ.errors import CardError
from openvocab_occ.io.files import PathLike, existing, sha256
from openvocab_occ.segmentation.encoder import Contract

SHIPPED = Path(__file__).parent / "cards"
"""Cards of public models, found by the sha256 of the model."""
TEMPLATE = """\
schema: 1
name: my model
contract: logits                # or dense, with a text section
input: {layout: NCHW, color: RGB, range: [0, 1], mean: [0, 0, 0], std: [1, 1, 1], size: [height, width]}
output: {layout: NCHW, kind: logits}   # logits, probabilities, classes; features for dense
labels: [background, road, ...]"""


class _Strict(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    pass


class InputCard(_Strict, frozen=True, kw_only=True):
    """How an image becomes the model's input."""

    layout: Literal["NCHW", "NHWC"]
    color: Literal["RGB", "BGR"]
    range: tuple[float, float]
    """What 0 and 255 become, before mean and std."""
    name: str | None = None
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """In the model's own order of colours, after `range`."""
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    size: tuple[int, int] | None = None
    """Height and width the model wants."""
    multiple_of: int | None = None
    """Instead of a size: height and width are rounded to a multiple of this."""
    resize: Literal["squash"] = "squash"
    """The image is stretched to the size; letterbox, crops and tiles are not supported."""
    interpolation: Literal["bilinear", "area", "nearest"] = "bilinear"

    def __post_init__(self) -> None:
        if (self.size is None) == (self.multiple_of is None):
            raise ValueError("`input` needs either `size` or `multiple_of`")
        if min(self.size or (self.multiple_of or 0,)) < 1:
            raise ValueError("`input.size` and `input.multiple_of` are at least 1")
        numbers = (*self.range, *self.mean, *self.std)
        if not isfinite(sum(numbers)) or self.range[0] >= self.range[1] or min(self.std) <= 0:
            raise ValueError("`input.range` is [low, high] with low < high, `input.std` above 0, all of them finite")


class OutputCard(_Strict, frozen=True, kw_only=True):
    """What comes out."""

    layout: Literal["NCHW", "NHWC", "NHW"]
    """NHW is for class numbers only."""
    kind: Literal["features", "logits", "probabilities", "classes"]
    name: str | None = None
    normalized: bool = False
    """The model says its features are of unit length; checked. They are normalised in any case."""

    def __post_init__(self) -> None:
        if self.layout == "NHW" and self.kind != "classes":
            raise ValueError("`output.layout` NHW is for kind `classes`")


class TextInputs(_Strict, frozen=True, kw_only=True):
    """Names of the text model's inputs."""

    ids: str = "input_ids"
    mask: str | None = None


class TextCard(_Strict, frozen=True, kw_only=True):
    """The text side of a dense model: one vector a text, of the same space as the features."""

    onnx: str
    """File beside the card."""
    tokenizer: str
    """A tokenizer.json beside the card."""
    context_length: int
    pad_id: int
    padding: Literal["max", "longest"] = "max"
    lowercase: bool = False
    inputs: TextInputs = TextInputs()
    output: str | None = None

    def __post_init__(self) -> None:
        for name in (self.onnx, self.tokenizer):
            if not name or Path(name).is_absolute() or ".." in Path(name).parts or "\\" in name:
                raise ValueError(f"`text` files lie beside the card, got {name!r}")
        if self.context_length < 1:
            raise ValueError("`text.context_length` is at least 1")


class ScoreCard(_Strict, frozen=True, kw_only=True):
    """How similarities become scores, where the model's makers say."""

    scale: float | None = None
    threshold: float | None = None


class Card(_Strict, frozen=True, kw_only=True):
    """The contract of one model."""

    schema: Literal[1]
    name: str
    contract: Contract
    input: InputCard
    output: OutputCard
    labels: tuple[str, ...] = ()
    """Channels of a `logits` model, in order."""
    text: TextCard | None = None
    score: ScoreCard = ScoreCard()
    license: str = "unstated"
    source: str = ""
    sha256: str | None = None
    """Of the model file; checked where given."""

    def __post_init__(self) -> None:
        if (self.contract == "dense") != (self.output.kind == "features"):
            raise ValueError("`output.kind` is features for contract dense, and only then")
        if self.contract == "dense" and self.text is None:
            raise ValueError("contract dense needs `text`: without words nothing can be asked")
        if self.contract == "logits" and (len(set(self.labels)) != len(self.labels) or len(self.labels) < 2):
            raise ValueError("contract logits needs `labels`: at least two, each once")
        if self.contract == "dense" and self.labels:
            raise ValueError("`labels` are for contract logits")

    def behaviour(self) -> bytes:
        """Return, as bytes, all that changes what the model puts out; names and licences do not."""
        mute = {"name", "license", "source", "sha256", "score"}
        facts = {k: v for k, v in msgspec.to_builtins(self).items() if k not in mute}
        return msgspec.json.encode(facts, order="deterministic")


def read_card(path: PathLike) -> Card:
    """Read a card from YAML or JSON.

    Raises:
        CardError: A key is missing, misspelt or of the wrong type; the message names it.
    """
    file = existing(path, "model card")
    try:
        content = yaml.safe_load(file.read_bytes())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise CardError(f"card {file} is not YAML", got=" ".join(str(error).split())) from error
    if not isinstance(content, Mapping):
        raise CardError(f"card {file} is not usable", expected="a mapping of fields", got=type(content).__name__)
    try:
        return msgspec.convert(dict(content), Card)
    except msgspec.ValidationError as error:
        raise _explain(file, str(error), content) from None


def find_card(model: Path) -> tuple[Card, Path]:
    """Return the card beside a model (`name.card.yaml` for `name.onnx`), or the shipped one for this very file.

    The second value is the folder that files named in the card lie in.
    """
    beside = model.with_suffix(".card.yaml")
    if beside.is_file():
        return read_card(beside), beside.parent
    digest = sha256(model)
    for file in sorted(SHIPPED.glob("*.card.yaml")):
        card = read_card(file)
        if card.sha256 == digest:
            return card, file.parent
    raise CardError(
        f"model {model.name} has no card: how to feed it and what its output means is not told",
        expected=f"{beside}, or a card passed by name",
        fix=f"write one with these fields:\n{TEMPLATE}",
    )


def _explain(file: Path, message: str, content: Mapping[Any, Any]) -> CardError:
    """Turn a message such as ``Expected `int`, got `str` - at `$.input.size` `` into ours."""
    what, _, place = message.partition(" - at `$")
    place = place.strip("`").lstrip(".").removesuffix("[...]")
    if found := re.fullmatch(r"Object contains unknown field `(.*)`", what):
        key = f"{place}.{found[1]}".lstrip(".")
        known = ", ".join(_fields(place))
        return CardError(f"card {file} has the unknown key {key!r}", expected=f"one of {known}", fix="is it misspelt?")
    if found := re.fullmatch(r"Object missing required field `(.*)`", what):
        key = f"{place}.{found[1]}".lstrip(".")
        return CardError(f"card {file} lacks the key {key!r}", expected=_describe(place, found[1]))
    if found := re.fullmatch(r"Expected `(.*)`, got `(.*)`", what):
        return CardError(f"card {file} has a wrong value at {place!r}", expected=found[1], got=found[2])
    what = what.removeprefix("Invalid enum value ")
    if place and not what.startswith("`"):
        wanted = _describe(*place.rpartition(".")[::2])
        return CardError(f"card {file} has a wrong value at {place!r}", expected=wanted, got=what)
    return CardError(f"card {file} contradicts itself: {what}")


def _struct(place: str) -> type[msgspec.Struct]:
    parts = {"": Card, "input": InputCard, "output": OutputCard, "text": TextCard, "text.inputs": TextInputs}
    return {**parts, "score": ScoreCard}.get(place, Card)


def _fields(place: str) -> list[str]:
    return [field.name for field in msgspec.structs.fields(_struct(place))]


def _describe(place: str, key: str) -> str:
    """Say what a field wants, from its type."""
    kinds = {field.name: field.type for field in msgspec.structs.fields(_struct(place))}
    kind = kinds.get(key.split("[")[0])
    options = getattr(kind, "__args__", ())
    if options and all(isinstance(option, str | int) for option in options):
        return " or ".join(map(str, options))
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return "a section with " + ", ".join(f.name for f in msgspec.structs.fields(kind))
    return str(kind).replace("typing.", "").replace("<class '", "").replace("'>", "")
