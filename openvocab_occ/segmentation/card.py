"""Model cards: what an ONNX file does not say about itself. Files of them: card_files.py."""

from math import isfinite
from pathlib import Path
from typing import Annotated, Literal

import msgspec

CardContract = Literal["dense", "tokens", "masks", "crops", "logits"]
"""What a graph puts out: features a cell, features a token, masks and a vector each, one vector an image, labels."""
Count = Annotated[int, msgspec.Meta(ge=1)]
KINDS = {
    "dense": (("features",), ("NCHW", "NHWC")),
    "tokens": (("features",), ("NTC",)),
    "masks": (("masks",), ("NCHW",)),
    "crops": (("embedding",), ("NC",)),
    "logits": (("logits", "probabilities", "classes"), ("NCHW", "NHWC", "NHW")),
}
"""Of each contract, what `output.kind` and `output.layout` may be."""


class _Strict(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    pass


class Tile(_Strict, frozen=True, kw_only=True):
    """Large images go through the model in overlapping pieces, joined with weights that fade to the edges."""

    size: tuple[Count, Count]
    """Height and width of a piece, pixels of the resized image."""
    overlap: Annotated[int, msgspec.Meta(ge=0)] = 0

    def __post_init__(self) -> None:
        if self.overlap * 2 > min(self.size):
            raise ValueError("`input.tile.overlap` is at most half a tile")


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
    """Instead of a size: height and width are brought to a multiple of this."""
    short_side: Count | None = None
    """With `multiple_of`: the image is first scaled so that its shorter side has this many pixels."""
    max_side: Count | None = None
    """With `multiple_of`: larger images are scaled down to this longer side."""
    resize: Literal["squash", "letterbox", "pad"] = "squash"
    """squash: stretched to the size. letterbox: scaled to fit, middle. pad: scaled to fit, upper left corner; with
    `multiple_of` not scaled at all."""
    pad_value: Annotated[int, msgspec.Meta(ge=0, le=255)] = 0
    """Grey level of what letterbox and pad add."""
    interpolation: Literal["bilinear", "area", "nearest"] = "bilinear"
    tile: Tile | None = None

    def __post_init__(self) -> None:
        if (self.size is None) == (self.multiple_of is None):
            raise ValueError("`input` needs either `size` or `multiple_of`")
        if min(self.size or (self.multiple_of or 0,)) < 1:
            raise ValueError("`input.size` and `input.multiple_of` are at least 1")
        if self.size is not None and (self.short_side or self.max_side):
            raise ValueError("`input.short_side` and `input.max_side` go with `multiple_of`, not with `size`")
        if self.resize == "letterbox" and self.size is None:
            raise ValueError("`input.resize` letterbox needs `size`; with `multiple_of` write pad")
        if self.tile is not None and (
            self.size is not None or any(n % (self.multiple_of or 1) for n in self.tile.size)
        ):
            raise ValueError("`input.tile` goes with `multiple_of`, and its size is a multiple of that")
        numbers = (*self.range, *self.mean, *self.std)
        if not isfinite(sum(numbers)) or self.range[0] >= self.range[1] or min(self.std) <= 0:
            raise ValueError("`input.range` is [low, high] with low < high, `input.std` above 0, all of them finite")


class OutputCard(_Strict, frozen=True, kw_only=True):
    """What comes out."""

    layout: Literal["NCHW", "NHWC", "NHW", "NTC", "NC"]
    """NHW is for class numbers only, NTC for tokens, NC for one vector an image."""
    kind: Literal["features", "logits", "probabilities", "classes", "masks", "embedding"]
    name: str | None = None
    normalized: bool = False
    """The model says its features are of unit length; checked. They are normalised in any case."""
    stride: float | None = None
    """Pixels of the input a cell; checked where given."""
    prefix_tokens: Annotated[int, msgspec.Meta(ge=0)] = 0
    """tokens: how many come before the patches (class token, registers)."""
    patch: Count | None = None
    """tokens: edge of a patch in pixels of the input."""
    embeddings: str | None = None
    """masks: the output of one vector a mask, [N, masks, channels]."""
    scores: str | None = None
    """masks: the output [N, masks] of how sure the model is, through `score_activation`."""
    void: str | None = None
    """masks: the output [N, masks] of how likely a mask is nothing; same activation."""
    mask_activation: Literal["sigmoid", "softmax", "none"] = "sigmoid"
    """softmax: over the masks of a pixel."""
    score_activation: Literal["sigmoid", "none"] = "sigmoid"

    def __post_init__(self) -> None:
        if self.layout == "NHW" and self.kind != "classes":
            raise ValueError("`output.layout` NHW is for kind `classes`")


def _beside(section: str, *names: str) -> None:
    for name in names:
        if not name or Path(name).is_absolute() or ".." in Path(name).parts or "\\" in name:
            raise ValueError(f"`{section}` files lie beside the card, got {name!r}")


class TextInputs(_Strict, frozen=True, kw_only=True):
    """Names of the text model's inputs."""

    ids: str = "input_ids"
    mask: str | None = None


class TextCard(_Strict, frozen=True, kw_only=True):
    """The text side of a model with features: one vector a text, of the same space."""

    onnx: str
    """File beside the card."""
    tokenizer: str
    """Beside the card: a tokenizer.json (BPE, Unigram, WordPiece), or a vocabulary of words (.txt, one a line)."""
    context_length: int
    pad_id: int
    padding: Literal["max", "longest"] = "max"
    lowercase: bool = False
    strip_punctuation: bool = False
    eos_id: int | None = None
    """Put at the end of every text that does not end with it, also of one cut off."""
    inputs: TextInputs = TextInputs()
    output: str | None = None
    pooling: Literal["none", "mean", "cls", "eos", "last"] = "none"
    """How [N, tokens, channels] becomes one vector: none when the graph does it itself, mean over the text's own
    tokens, its first token, its first `eos_id`, its last token."""
    slice: tuple[int, int] | None = None
    """Channels from, to: of vectors of which only a part is aligned to cells."""

    def __post_init__(self) -> None:
        _beside("text", self.onnx, self.tokenizer)
        if self.context_length < 1:
            raise ValueError("`text.context_length` is at least 1")
        if self.pooling == "eos" and self.eos_id is None:
            raise ValueError("`text.pooling` eos needs `text.eos_id`")
        if self.slice is not None and not 0 <= self.slice[0] < self.slice[1]:
            raise ValueError("`text.slice` is [from, to] with from < to")


class PromptCard(_Strict, frozen=True, kw_only=True):
    """Sentences that a word is put into; the unit vectors of all are averaged and made unit again."""

    templates: tuple[str, ...] = ("{}",)

    def __post_init__(self) -> None:
        if not self.templates or any(t.count("{}") != 1 for t in self.templates):
            raise ValueError("each of `prompts.templates` holds {} once")


class Calibration(_Strict, frozen=True, kw_only=True):
    """Platt scaling: probability = sigmoid(a cosine + b), fitted on labelled voxels or objects."""

    a: float
    b: float
    dataset: str
    date: str
    count: Annotated[int, msgspec.Meta(ge=0)]
    """Labelled voxels it was fitted on, or pairs of an object and a word."""
    classes: float = 0.0
    """What the class that occupancy names is worth: where its name is nearer to the text than `neutral`, classes x
    (their cosine - neutral) is added before the sigmoid."""
    others: float = 0.0
    """What it is worth against a text that surely means another class: others x s x (n - own), with n the greatest
    cosine - neutral of any class, own that of this one, and s = n / (1 - neutral), is taken away before the sigmoid."""
    neutral: float = 0.0


class ScoreCard(_Strict, frozen=True, kw_only=True):
    """How a cosine becomes a score, where the model's makers say."""

    kind: Literal["cosine", "sigmoid", "relevancy"] = "cosine"
    """sigmoid: of scale x cosine + bias. relevancy: the least softmax(scale x cosine) of the text against each negative
    (LERF, arXiv 2303.09553)."""
    scale: float | None = None
    bias: float = 0.0
    negatives: tuple[str, ...] = ()
    threshold: float | None = None
    """Least score of a hit."""
    calibration: Calibration | None = None

    def __post_init__(self) -> None:
        if self.kind != "cosine" and not (self.scale or 0) > 0:
            raise ValueError(f"`score.kind` {self.kind} needs `score.scale` above 0")
        if (self.kind == "relevancy") != bool(self.negatives):
            raise ValueError("`score.negatives` are for kind relevancy, which needs some")


class CropCard(_Strict, frozen=True, kw_only=True):
    """Where crops of a whole-image model come from: masks of another model, mask images, or sliding windows."""

    windows: tuple[float, ...] = (1.0, 0.5, 0.25)
    """Edges of the windows, parts of the image's shorter side."""
    overlap: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.5
    """Of neighbouring windows, part of their edge."""
    masks_onnx: str | None = None
    """A mask model with a card of its own, beside this card; then windows are not used."""
    mask_images: str | None = None
    """A folder beside this card with a 16-bit or 8-bit PNG an image, 0 for none, else the number of a mask; `images`
    holds the images themselves, same names."""
    images: str | None = None
    margin: Annotated[float, msgspec.Meta(ge=0)] = 0.1
    """How far a crop reaches beyond its mask, part of its edges."""
    blank: bool = False
    """Paint what is not the mask in the middle grey of the mean."""

    def __post_init__(self) -> None:
        _beside("crops", *filter(None, (self.masks_onnx, self.mask_images, self.images)))
        if not self.windows or not all(0 < part <= 1 for part in self.windows):
            raise ValueError("`crops.windows` are parts of the shorter side, above 0 and at most 1")
        if (self.mask_images is None) != (self.images is None):
            raise ValueError("`crops.mask_images` and `crops.images` go together")


class TextTest(_Strict, frozen=True, kw_only=True):
    """A text and the first numbers of its vector."""

    text: str
    vector: tuple[float, ...]


class SelfTest(_Strict, frozen=True, kw_only=True):
    """What the maker of the card got, so that a wrong mean, order of colours, padding or case shows at once."""

    size: tuple[Count, Count] = (256, 256)
    """Height and width of the test image, which `selftest.picture` draws from `seed`."""
    seed: int = 0
    cell: tuple[float, ...] = ()
    """First channels of the middle cell."""
    texts: tuple[TextTest, ...] = ()
    tolerance: float = 0.01


class _Common(_Strict, frozen=True, kw_only=True):
    schema: Literal[1]
    name: str
    labels: tuple[str, ...] = ()
    """Channels of a `logits` model, in order."""
    text: TextCard | None = None
    prompts: PromptCard = PromptCard()
    score: ScoreCard = ScoreCard()
    license: str = "unstated"
    source: str = ""

    def behaviour(self) -> bytes:
        """Return, as bytes, all that changes what the model puts out; names, licences and scores do not."""
        mute = {"name", "license", "source", "sha256", "score", "prompts", "selftest"}
        facts = {k: v for k, v in msgspec.to_builtins(self).items() if k not in mute}
        return msgspec.json.encode(facts, order="deterministic")

    def _check(self, contract: str) -> None:
        if contract == "logits" and (len(set(self.labels)) != len(self.labels) or len(self.labels) < 2):
            raise ValueError("contract logits needs `labels`: at least two, each once")
        if contract != "logits" and self.labels:
            raise ValueError("`labels` are for contract logits")
        if contract != "logits" and self.text is None:
            raise ValueError(f"contract {contract} needs `text`: without words nothing can be asked")


class Card(_Common, frozen=True, kw_only=True):
    """The contract of one ONNX model."""

    contract: CardContract
    input: InputCard
    output: OutputCard
    crops: CropCard | None = None
    sha256: str | None = None
    """Of the model file; checked where given."""
    selftest: SelfTest | None = None

    def __post_init__(self) -> None:
        kinds, layouts = KINDS[self.contract]
        if self.output.kind not in kinds or self.output.layout not in layouts:
            raise ValueError(
                f"`output.kind` is {' or '.join(kinds)} for contract {self.contract}, and only then; "
                f"its `output.layout` is {' or '.join(layouts)}"
            )
        if self.contract == "tokens" and self.output.patch is None:
            raise ValueError("contract tokens needs `output.patch`")
        if self.contract == "crops" and self.input.size is None:
            raise ValueError("contract crops needs `input.size`")
        if self.crops is not None and self.contract != "crops":
            raise ValueError("`crops` is for contract crops")
        if self.input.tile is not None and self.contract not in ("dense", "tokens", "logits"):
            raise ValueError("`input.tile` is for contracts dense, tokens and logits")
        proposals = self.contract == "masks" and self.output.embeddings is None
        if not (proposals and self.text is None):
            self._check(self.contract)


class FilesCard(_Common, frozen=True, kw_only=True):
    """The contract of features computed elsewhere: one file an image, found by what the image shows."""

    contract: Literal["files"]
    images: str
    """Folder beside the card; an image is known again by its pixels."""
    features: str
    """Folder beside the card with NAME.npy or NAME.safetensors for image NAME."""
    kind: Literal["features", "logits", "probabilities"]
    layout: Literal["HWC", "CHW"]

    def __post_init__(self) -> None:
        _beside("files", self.images, self.features)
        self._check("dense" if self.kind == "features" else "logits")
