"""Looking at an unknown model: what it declares, what a run shows, and a draft of its card.

Shapes propose, they never decide: what cannot be known from the file is written as CONFIRM, which no card may keep.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from openvocab_occ.errors import CardError, ModelError
from openvocab_occ.io.files import PathLike, existing, sha256
from openvocab_occ.segmentation.card_files import CONFIRM, find_card
from openvocab_occ.segmentation.session import Limits, Port, Session

_MULTIPLES = (1, 2, 4, 8, 14, 16, 28, 32, 64)
_FEW = 3  # colours
_LABELS_AT_MOST = 400  # more channels than this are features
_FEATURES = (32, 64, 128, 256, 384, 512, 640, 768, 1024, 1152, 1280, 1536)


@dataclass(frozen=True, kw_only=True)
class Finding:
    """What a probe found."""

    path: Path
    sha256: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    card: str | None
    """Name of the card that is found for this file, if any."""
    notes: tuple[str, ...] = ()
    """What the runs showed, as sentences."""
    draft: str = ""
    """A card with CONFIRM where nobody can know; empty where the file takes no image."""
    shapes: dict[str, tuple[int, ...]] = field(default_factory=dict)
    """Of each output, from a run."""


def probe(model: PathLike) -> Finding:
    """Inspect a model, run it on grey noise of fitting sizes, and draft its card.

    Raises ModelError or UnsafeFileError like `load_encoder`; a model that merely fails to run is a note.
    """
    path = existing(model, "ONNX model")
    session = Session(path, limits=Limits(seconds=60.0))
    try:
        card = find_card(path, session.embedded_card)[0].name
    except CardError as error:
        card = None if "has no card" in str(error) else f"not usable: {error}"
    found = {
        "path": path, "sha256": sha256(path), "inputs": tuple(map(str, session.inputs)),
        "outputs": tuple(map(str, session.outputs)), "card": card,
    }  # fmt: skip
    images = [port for port in session.inputs if len(port.shape) == 4 and _layout(port) is not None]
    if len(session.inputs) != 1 or not images:
        words = [port for port in session.inputs if port.numpy in (np.int64, np.int32) and len(port.shape) == 2]
        note = "takes token ids: a text side, named under `text` in the card of its image side" if words else (
            "takes no single image: if words are among its inputs, fix their list and export it as `logits`"
        )  # fmt: skip
        return Finding(**found, notes=(note,))
    (port,) = images
    notes, shapes, size, multiple = _try(session, port)
    draft = _draft(path, port, session.outputs, shapes, size, multiple)
    return Finding(**found, notes=tuple(notes), draft=draft, shapes=shapes)


def _layout(port: Port) -> str | None:
    if port.shape[1] == _FEW:
        return "NCHW"
    return "NHWC" if port.shape[3] == _FEW else None


def _try(
    session: Session, port: Port
) -> tuple[list[str], dict[str, tuple[int, ...]], tuple[int, int] | None, int | None]:
    """Run at the declared size, or find the least multiple that runs; return notes, shapes, size, multiple."""
    rows, columns = port.shape[2:] if _layout(port) == "NCHW" else port.shape[1:3]
    if rows is not None and columns is not None:
        shapes = _run(session, port, rows, columns)
        note = f"a run at {columns} x {rows} " + ("worked" if isinstance(shapes, dict) else f"failed: {shapes}")
        return [note], shapes if isinstance(shapes, dict) else {}, (rows, columns), None
    refused = ""
    for multiple in _MULTIPLES:
        odd = -(-100 // multiple) | 1  # an odd number of multiples, so that twice the multiple would not pass
        shapes = _run(session, port, odd * multiple, (odd + 2) * multiple)
        if isinstance(shapes, dict):
            return [f"height and width are free; the least multiple that ran is {multiple}"], shapes, None, multiple
        refused = refused or shapes
    note = f"height and width are free, but a run at 103 x 101 failed: {refused}"
    shapes = _run(session, port, 224, 224)
    if isinstance(shapes, dict):
        return [f"{note}; one at 224 x 224 worked"], shapes, (224, 224), None
    return [note], {}, None, None


def _run(session: Session, port: Port, height: int, width: int) -> dict[str, tuple[int, ...]] | str:
    shape = (1, _FEW, height, width) if _layout(port) == "NCHW" else (1, height, width, _FEW)
    noise = np.random.default_rng(0).uniform(0, 1, shape)
    fed = (noise * (255 if port.numpy is np.uint8 else 1)).astype(port.numpy or np.float32)
    try:
        found = session.run_many([out.name for out in session.outputs], {port.name: fed})
    except ModelError as error:
        return str(error.got or error)[:160]
    named = dict(zip((out.name for out in session.outputs), found, strict=True))
    sums = {name for name, array in named.items() if array.ndim == 4 and _sums_to_one(array)}
    return _Shapes({name: array.shape for name, array in named.items()}, sums, (height, width))


class _Shapes(dict[str, tuple[int, ...]]):
    """Shapes of outputs, which of them hold probabilities, and the height and width that was fed."""

    def __init__(self, shapes: dict[str, tuple[int, ...]], probabilities: set[str], fed: tuple[int, int]) -> None:
        super().__init__(shapes)
        self.probabilities, self.fed = probabilities, fed


def _sums_to_one(array: np.ndarray) -> bool:
    return bool(array.min() >= 0 and any(np.abs(array.sum(axis=axis) - 1).max() < 0.02 for axis in (1, 3)))


def _draft(
    path: Path,
    port: Port,
    outputs: tuple[Port, ...],
    shapes: dict[str, tuple[int, ...]],
    size: tuple[int, int] | None,
    multiple: int | None,
) -> str:
    """Write the card as far as shapes tell."""
    layout = _layout(port)
    guess = "[0, 255]" if port.numpy is np.uint8 else f'"{CONFIRM}: [0, 1], [-1, 1] or [0, 255]"'
    place = f"size: [{size[0]}, {size[1]}]" if size else f"multiple_of: {multiple or 32}"
    name, contract, output, more = _propose(outputs, shapes, size)
    lines = [
        f"# Drafted by `openvocab-occ model probe {path.name}` from shapes. Replace every {CONFIRM}.",
        "schema: 1",
        f"name: {path.stem}",
        f"contract: {contract}",
        "input:",
        f"  name: {port.name}",
        f"  layout: {layout}",
        f'  color: "{CONFIRM}: RGB or BGR"',
        f"  range: {guess}    # what 0 and 255 become; then mean and std, in the model's order of colours",
        f'  mean: ["{CONFIRM}", 0, 0]    # ImageNet: 0.485, 0.456, 0.406; CLIP: 0.481, 0.458, 0.408; none: 0, 0, 0',
        f'  std: ["{CONFIRM}", 1, 1]     # ImageNet: 0.229, 0.224, 0.225; CLIP: 0.269, 0.261, 0.276; none: 1, 1, 1',
        f"  {place}",
        "output:",
        f"  name: {name}",
        *(f"  {line}" for line in output),
        *more,
        f'license: "{CONFIRM}"',
        f"sha256: {sha256(path)}",
    ]
    return "\n".join(lines) + "\n"


def _propose(
    outputs: tuple[Port, ...], shapes: dict[str, tuple[int, ...]], size: tuple[int, int] | None
) -> tuple[str, str, list[str], list[str]]:
    """Return the output to use, its contract, the lines of `output`, and the sections that follow."""
    text = ["text:", f'  onnx: "{CONFIRM}: text encoder beside this card"', "  tokenizer: tokenizer.json",
            f'  context_length: "{CONFIRM}"', "  pad_id: 0"]  # fmt: skip
    ranked = sorted(outputs, key=lambda out: -len(shapes.get(out.name, out.shape)))
    masks = [o for o in ranked if len(shapes.get(o.name, ())) == 4]
    vectors = [o for o in ranked if len(shapes.get(o.name, ())) == 3]
    if masks and vectors and shapes[masks[0].name][1] == shapes[vectors[0].name][1]:
        lines = ["layout: NCHW", "kind: masks", f"embeddings: {vectors[0].name}",
                 f'mask_activation: "{CONFIRM}: sigmoid, softmax or none"']  # fmt: skip
        return masks[0].name, "masks", lines, text
    best, fed = ranked[0], getattr(shapes, "fed", size or (224, 224))
    shape = shapes.get(best.name, tuple(n or 0 for n in best.shape))
    if len(shape) == 4:
        layout = "NCHW" if _channels_first(shape, fed) else "NHWC"
        channels = shape[1] if layout == "NCHW" else shape[3]
        if channels in _FEATURES or channels > _LABELS_AT_MOST:
            return best.name, "dense", [f"layout: {layout}", f"kind: features    # {channels} channels"], text
        if channels == 1:
            return best.name, "logits", [f"layout: {layout}", "kind: classes"], [f'labels: ["{CONFIRM}"]']
        sure = best.name in getattr(shapes, "probabilities", ())
        kind = "kind: probabilities    # they add up to 1" if sure else "kind: logits    # they do not add up to 1"
        return best.name, "logits", [f"layout: {layout}", kind], [f'labels: ["{CONFIRM}: {channels} names, in order"]']
    if len(shape) == 3:
        if best.numpy in (np.int64, np.int32, np.uint8):
            return best.name, "logits", ["layout: NHW", "kind: classes"], [f'labels: ["{CONFIRM}"]']
        prefix, patch = _patches(shape[1], fed)
        lines = ["layout: NTC", "kind: features", f"prefix_tokens: {prefix}", f"patch: {patch}"]
        return best.name, "tokens", lines, text
    return best.name, "crops", ["layout: NC", "kind: embedding"], text


def _channels_first(shape: tuple[int, ...], fed: tuple[int, int]) -> bool:
    """Tell which axes are shaped as the image was; where both are, the fewer numbers are the channels."""
    first = abs(shape[2] * fed[1] - shape[3] * fed[0]) / max(1, shape[3] * fed[0])
    last = abs(shape[1] * fed[1] - shape[2] * fed[0]) / max(1, shape[2] * fed[0])
    return shape[1] <= shape[3] if abs(first - last) < 0.05 else first < last


def _patches(tokens: int, fed: tuple[int, int]) -> tuple[int | str, int | str]:
    for patch in (14, 16, 8, 32):
        spare = tokens - (fed[0] // patch) * (fed[1] // patch)
        if 0 <= spare <= 9:
            return spare, patch
    return f'"{CONFIRM}"', f'"{CONFIRM}"'
