"""A user's 2D model as an ONNX file and a card that says how to use it."""

import hashlib
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from openvocab_occ.errors import ModelError
from openvocab_occ.io.files import PathLike, existing, sha256
from openvocab_occ.segmentation.card import Card, InputCard, find_card, read_card
from openvocab_occ.segmentation.encoder import Contract, FeatureMap, PixelEncoder, TextEncoder
from openvocab_occ.segmentation.session import Port, Session
from openvocab_occ.segmentation.text import OnnxTextEncoder

_BATCH = 8  # images a run, so that many large images do not fill the memory
_PROBABILITY_TOLERANCE = 0.02  # quantised models round their softmax
_NORM_TOLERANCE = 0.01


def load_encoder(
    onnx: PathLike,
    card: PathLike | Card | None = None,
    *,
    providers: Sequence[str] = ("CPUExecutionProvider",),
    threads: int | None = None,
) -> PixelEncoder:
    """Open a model: its structure is inspected, then checked against its card.

    Args:
        onnx: The model file.
        card: Its card. By default `name.card.yaml` beside `name.onnx`, else the shipped card for this very file.
        providers: Of onnxruntime, best first.
        threads: For onnxruntime; by default all cores.

    Raises:
        CardError: There is no card, or it is not right in itself.
        ModelError: The file is no model, or not the one its card describes.
        UnsafeFileError: It reaches outside its folder, or needs foreign operators.
    """
    path = existing(onnx, "ONNX model")
    session = Session(path, providers=providers, threads=threads)
    if card is None:
        card, folder = find_card(path)
    elif isinstance(card, Card):
        folder = path.parent
    else:
        card, folder = read_card(card), Path(card).parent
    text = None
    if card.text is not None:
        text = OnnxTextEncoder(card.text, folder, providers=providers, threads=threads)
    return OnnxEncoder(card, session, text)


class OnnxEncoder:
    """Images to cells by an ONNX model; see PixelEncoder."""

    def __init__(self, card: Card, session: Session, text: OnnxTextEncoder | None) -> None:
        self.card = card
        self.name = card.name
        self.contract: Contract = card.contract
        self.labels = card.labels
        self.text: TextEncoder | None = text
        self.dim = len(card.labels) if text is None else text.dim
        self._session = session
        self._input = session.input(card.input.name)
        self._output = session.output(card.output.name)
        self._check_declared()
        self.fingerprint = _fingerprint(card, (*session.files, *(text.files if text is not None else ())))

    def encode(self, images: Sequence[UInt8[np.ndarray, "_ _ 3"]]) -> list[FeatureMap]:
        """Run the model on RGB images of any sizes."""
        batch = self._input.shape[0] or _BATCH
        maps: list[FeatureMap] = []
        for _, group in groupby(images, key=lambda image: image.shape):
            same = list(group)
            for start in range(0, len(same), batch):
                maps += self._encode_same_size(same[start : start + batch])
        return maps

    def _encode_same_size(self, images: Sequence[UInt8[np.ndarray, "h w 3"]]) -> list[FeatureMap]:
        height, width = images[0].shape[:2]
        fed = np.stack([prepare(image, self.card.input) for image in images])
        raw = self._session.run(self._output.name, {self._input.name: self._as_input(fed)})
        cells = self._cells(raw, len(images))
        scale = (cells.shape[2] / width, cells.shape[1] / height)
        offset = (0.5 * scale[0] - 0.5, 0.5 * scale[1] - 0.5)  # cell = (u + 0.5) scale - 0.5
        return [FeatureMap(one, scale, offset) for one in cells]

    def _as_input(self, fed: Float32[np.ndarray, "n h w 3"]) -> np.ndarray:
        if self.card.input.layout == "NCHW":
            fed = np.ascontiguousarray(fed.transpose(0, 3, 1, 2))
        if self._input.numpy is np.uint8:
            fed = np.clip(np.rint(fed), 0, 255)
        return fed.astype(self._input.numpy or np.float32)

    def _cells(self, raw: np.ndarray, count: int) -> Float32[np.ndarray, "n h w c"]:
        """Check what came out and turn it into unit features or probabilities."""
        kind, layout = self.card.output.kind, self.card.output.layout
        if kind == "classes":
            return self._one_hot(raw, count)
        if raw.ndim != 4 or len(raw) != count or raw.dtype.kind != "f":
            raise self._misfit(f"floats ({count}, ...) of 4 axes in layout {layout}", f"{raw.dtype} {raw.shape}")
        cells = np.ascontiguousarray(raw.transpose(0, 2, 3, 1) if layout == "NCHW" else raw, dtype=np.float32)
        if cells.shape[3] != self.dim:
            raise self._misfit(f"{self.dim} channels, {self._channel_source()}", f"{cells.shape[3]} in {raw.shape}")
        if kind == "features":
            return self._unit(cells)
        if kind == "logits":
            cells = np.exp(cells - cells.max(axis=3, keepdims=True))
            return cells / cells.sum(axis=3, keepdims=True)
        off = float(np.abs(cells.sum(axis=3) - 1).max())
        if off > _PROBABILITY_TOLERANCE or cells.min() < -_PROBABILITY_TOLERANCE:
            raise self._misfit(
                "probabilities that sum to 1", f"sums off by {off:.3g}, lowest {cells.min():.3g}", "is it kind: logits?"
            )
        return np.clip(cells, 0, 1)

    def _unit(self, cells: Float32[np.ndarray, "n h w c"]) -> Float32[np.ndarray, "n h w c"]:
        """Normalise each cell; one without any feature stays zero."""
        lengths = np.linalg.norm(cells, axis=3, keepdims=True)
        off = float(np.abs(lengths - 1).max())
        if self.card.output.normalized and off > _NORM_TOLERANCE:
            raise self._misfit("features of length 1", f"lengths off by {off:.3g}", "write normalized: false")
        return cells / np.where(lengths > 0, lengths, 1)

    def _one_hot(self, raw: np.ndarray, count: int) -> Float32[np.ndarray, "n h w c"]:
        channel = {"NCHW": 1, "NHWC": 3}.get(self.card.output.layout)
        numbers = raw
        if channel is not None and raw.ndim == 4 and raw.shape[channel] == 1:
            numbers = raw.squeeze(channel)
        if numbers.ndim != 3 or len(numbers) != count or (numbers != np.rint(numbers)).any():
            raise self._misfit(f"class numbers ({count}, height, width)", f"{raw.dtype} {raw.shape}")
        if numbers.min() < 0 or numbers.max() >= self.dim:
            raise self._misfit(f"classes 0..{self.dim - 1}, one a label", f"{numbers.min()}..{numbers.max()}")
        return np.eye(self.dim, dtype=np.float32)[numbers.astype(np.intp)]

    def _check_declared(self) -> None:
        """Compare what the file declares with the card, before anything runs."""
        card, port = self.card, self._input
        if card.sha256 is not None and card.sha256 != sha256(self._session.path):
            raise ModelError(
                f"the card {card.name!r} is for another file than {self._session.path.name}",
                expected=f"sha256 {card.sha256[:16]}...",
                got=f"{sha256(self._session.path)[:16]}...",
            )
        if len(self._session.inputs) != 1:
            raise self._misfit("one input, an image", "; ".join(map(str, self._session.inputs)))
        if port.numpy not in (np.float32, np.float16, np.uint8) or len(port.shape) != 4:
            raise self._misfit("images of 4 axes, float or uint8", str(port))
        batch, *rest = port.shape
        height, width, channels = rest if card.input.layout == "NHWC" else (*rest[1:], rest[0])
        swapped = channels is None and rest[0 if card.input.layout == "NHWC" else 2] == 3
        if channels not in (None, 3) or swapped:
            raise self._misfit(f"3 colours in layout {card.input.layout}", str(port), "check input.layout")
        if batch not in (None, 1):
            raise self._misfit("a batch of 1 or of any size", str(port), "export it so")
        wanted = card.input.size or (None, None)
        for name, has, asked in (("height", height, wanted[0]), ("width", width, wanted[1])):
            if has is not None and has != asked:
                raise self._misfit(f"{name} {asked or 'free'} as in the card", str(port), "write input.size")
        self._check_declared_output(self._output)

    def _check_declared_output(self, port: Port) -> None:
        kind, layout = self.card.output.kind, self.card.output.layout
        if kind == "classes":
            return
        if port.shape and len(port.shape) != 4:
            raise self._misfit(f"an output of 4 axes in layout {layout}", str(port))
        channels = port.shape[1 if layout == "NCHW" else 3] if port.shape else None
        if channels not in (None, self.dim):
            raise self._misfit(
                f"{self.dim} channels in layout {layout}, {self._channel_source()}",
                f"{channels} in {port}",
                "check output.layout and labels",
            )

    def _channel_source(self) -> str:
        return "one a label" if self.contract == "logits" else "as many as the text model's vectors have"

    def _misfit(self, expected: str, got: str, fix: str | None = None) -> ModelError:
        return ModelError(f"{self._session.path.name} does not fit its card", expected=expected, got=got, fix=fix)


def prepare(image: UInt8[np.ndarray, "h w 3"], card: InputCard) -> Float32[np.ndarray, "h2 w2 3"]:
    """Resize an RGB image and bring its colours to what a model wants."""
    import cv2

    height, width = card.size or _rounded(image.shape[:2], card.multiple_of or 1)
    # the exact ones: OpenCV 5 cuts off fractions of grey levels in INTER_LINEAR; INTER_NEAREST is off by half a pixel
    how = {"bilinear": cv2.INTER_LINEAR_EXACT, "area": cv2.INTER_AREA, "nearest": cv2.INTER_NEAREST_EXACT}
    if image.shape[:2] != (height, width):
        image = cv2.resize(image, (width, height), interpolation=how[card.interpolation])  # pyright: ignore
    colors = image[:, :, ::-1] if card.color == "BGR" else image
    low, high = card.range
    gain = (high - low) / 255.0 / np.asarray(card.std)
    shift = (low - np.asarray(card.mean)) / np.asarray(card.std)
    return colors.astype(np.float32) * gain.astype(np.float32) + shift.astype(np.float32)


def _rounded(size: Sequence[int], multiple: int) -> tuple[int, int]:
    height, width = (max(1, round(n / multiple)) * multiple for n in size)
    return height, width


def _fingerprint(card: Card, files: Sequence[Path]) -> str:
    digest = hashlib.sha256(card.behaviour())
    for file in files:
        digest.update(bytes.fromhex(sha256(file)))
    return digest.hexdigest()
