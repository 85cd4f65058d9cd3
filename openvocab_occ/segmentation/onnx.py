"""A user's 2D model as an ONNX file and a card that says how to use it."""

import hashlib
from collections.abc import Sequence
from functools import cached_property
from itertools import groupby
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from openvocab_occ.errors import ConfigError, ModelError
from openvocab_occ.io.files import PathLike, existing, sha256
from openvocab_occ.segmentation import crops
from openvocab_occ.segmentation.card import Card, CropCard, FilesCard
from openvocab_occ.segmentation.card_files import AnyCard, find_card, read_card
from openvocab_occ.segmentation.declared import check_declared
from openvocab_occ.segmentation.encoder import Contract, FeatureMap, MaskMap, PixelEncoder, TextEncoder
from openvocab_occ.segmentation.feature_files import FeatureFileEncoder, MaskFiles
from openvocab_occ.segmentation.masks import cell_place, mixed, parted, read_masks
from openvocab_occ.segmentation.outputs import Reader
from openvocab_occ.segmentation.picture import Placed, colour, place
from openvocab_occ.segmentation.picture import prepare as prepare
from openvocab_occ.segmentation.scoring import Scoring, scoring_of
from openvocab_occ.segmentation.session import CPU, Limits, Session
from openvocab_occ.segmentation.text import OnnxTextEncoder
from openvocab_occ.segmentation.tiles import run_in_tiles

_BATCH = 8  # images a run, so that many large images do not fill the memory
_CARDS = (".yaml", ".yml", ".json")


def load_encoder(
    onnx: PathLike,
    card: PathLike | AnyCard | None = None,
    *,
    providers: Sequence[str] = (CPU,),
    threads: int | None = None,
    limits: Limits | None = None,
    sandbox: bool = False,
) -> PixelEncoder:
    """Open a model: its structure is inspected, then checked against its card.

    Args:
        onnx: The model file; or, for features computed elsewhere, their card (contract `files`).
        card: Its card. By default `name.card.yaml` beside `name.onnx`, else the one inside it, else the shipped card
            for this very file.
        providers: Of onnxruntime, best first: `cpu`, `cuda`, `tensorrt`, or its own names. What is not there is left
            out with a warning.
        threads: For onnxruntime; by default all cores.
        limits: On size and time.
        sandbox: Run the model in a child process with limited memory, which can write no file.

    Raises:
        CardError: There is no card, or it is not right in itself.
        ModelError: The file is no model, or not the one its card describes.
        UnsafeFileError: It reaches outside its folder, or needs foreign operators.
    """
    path = existing(onnx, "ONNX model")
    if sandbox:
        from openvocab_occ.segmentation.sandbox import SandboxedEncoder

        if card is not None and not isinstance(card, str | Path):
            raise ConfigError("a sandboxed model needs its card as a file", got=type(card).__name__)
        return SandboxedEncoder(path, None if card is None else Path(card), threads=threads)
    if path.suffix in _CARDS:
        files = read_card(path)
        if not isinstance(files, FilesCard):
            raise ModelError(
                f"{path.name} is a card of a model", expected="its ONNX file", fix="pass the model; the card by card="
            )
        text = _text(files, path.parent, providers, threads, limits)
        return FeatureFileEncoder(files, path.parent, text, source=path)
    session = Session(path, providers=providers, threads=threads, limits=limits)
    found, folder = _card(card, session)
    return OnnxEncoder(found, session, _text(found, folder, providers, threads, limits), folder=folder)


def _card(card: PathLike | AnyCard | None, session: Session) -> tuple[Card, Path]:
    folder = session.path.parent
    if card is None:
        found, folder = find_card(session.path, session.embedded_card)
    elif isinstance(card, Card | FilesCard):
        found = card
    else:
        found, folder = read_card(card), Path(card).parent
    if isinstance(found, FilesCard):
        raise ModelError(f"card {found.name!r} is for feature files, not for {session.path.name}", fix="pass the card")
    return found, folder


def _text(
    card: AnyCard, folder: Path, providers: Sequence[str], threads: int | None, limits: Limits | None
) -> OnnxTextEncoder | None:
    if card.text is None:
        return None
    options = {"providers": providers, "threads": threads, "limits": limits}
    return OnnxTextEncoder(card.text, folder, prompts=card.prompts, **options)


class OnnxEncoder:
    """Images to cells by an ONNX model; see PixelEncoder."""

    def __init__(self, card: Card, session: Session, text: OnnxTextEncoder | None, *, folder: Path) -> None:
        self.card = card
        self.name = card.name
        self.contract: Contract = "logits" if card.contract == "logits" else "dense"
        self.labels = card.labels
        self.text: TextEncoder | None = text
        self.dim = len(card.labels) if text is None else text.dim
        self.session = session
        self._input = session.input(card.input.name)
        self._reader = Reader(card=card.output, dim=self.dim, model=session.path.name, from_text=text is not None)
        check_declared(card, session, self._reader)
        self._proposals = _Proposals.of(card.crops, folder, session) if card.contract == "crops" else None
        files = (*session.files, *(text.files if text is not None else ()))
        self.fingerprint = _fingerprint(card, (*files, *(self._proposals.files if self._proposals else ())))

    @cached_property
    def scoring(self) -> Scoring | None:
        """How cosines become scores; None for a `logits` model, whose cells are scores."""
        return None if self.text is None else scoring_of(self.card.score, self.text)

    def encode(self, images: Sequence[UInt8[np.ndarray, "_ _ 3"]]) -> list[FeatureMap]:
        """Run the model on RGB images of any sizes."""
        if self.card.contract == "crops":
            if self._proposals is not None and self._proposals.given:
                return [found.densify() for found in self.encode_masks(images)]
            return [crops.encode_windows(image, self.card.crops or CropCard(), self._embed) for image in images]
        if self.card.input.tile is not None:
            return [self._in_tiles(place(image, self.card.input)) for image in images]
        return [found for part in self._batches(images) for found in self._encode_same_size(part)]

    @property
    def has_masks(self) -> bool:
        """Whether `encode_masks` has an answer: for a `masks` model, and for crops of given masks."""
        return self.card.contract == "masks" or (self._proposals is not None and self._proposals.given)

    def encode_masks(self, images: Sequence[UInt8[np.ndarray, "_ _ 3"]]) -> list[MaskMap]:
        """Return masks and one vector each, of a `masks` model or of crops around given masks; else ModelError."""
        if self.card.contract == "masks":
            runs = ((part, self._masks(part)) for part in self._batches(images))
            return [
                parted(*found, cell_place(placed, found[0].shape[:2]))
                for part, results in runs
                for placed, found in zip(part, results, strict=True)
            ]
        if not self.has_masks or self._proposals is None:
            raise ModelError(f"model {self.name} puts out no masks", expected="contract masks, or crops of given masks")
        card = self.card.crops or CropCard()
        found = zip(images, self._proposals(images), strict=True)
        return [crops.encode_masks(image, proposals, card, self._embed) for image, proposals in found]

    def _batches(self, images: Sequence[UInt8[np.ndarray, "_ _ 3"]]) -> list[list[Placed]]:
        """Return the images as the model wants them, in runs of one size."""
        size = self._input.shape[0] or _BATCH
        groups = (list(g) for _, g in groupby((place(i, self.card.input) for i in images), key=lambda p: p.fed.shape))
        return [group[at : at + size] for group in groups for at in range(0, len(group), size)]

    def _encode_same_size(self, part: Sequence[Placed]) -> list[FeatureMap]:
        if self.card.contract == "masks":
            found = zip(part, self._masks(part), strict=True)
            return [mixed(*one, cell_place(placed, one[0].shape[:2])) for placed, one in found]
        cells = self._cells(np.stack([placed.fed for placed in part]))
        return [FeatureMap(one, *cell_place(placed, one.shape[:2])) for placed, one in zip(part, cells, strict=True)]

    def _in_tiles(self, placed: Placed) -> FeatureMap:
        assert self.card.input.tile is not None, "only called then"
        unit = self.contract == "dense"
        cells, span = run_in_tiles(placed.fed, self.card.input.tile, self._cells, unit=unit)
        return FeatureMap(cells, *cell_place(placed, cells.shape[:2], shape=span))

    def _cells(self, fed: UInt8[np.ndarray, "n h w 3"]) -> Float32[np.ndarray, "n r s c"]:
        raw = self.session.run(self.session.output(self.card.output.name).name, self._feeds(fed))
        return self._reader.cells(raw, len(fed), fed.shape[1:3])

    def _masks(self, part: Sequence[Placed]) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        fed = np.stack([placed.fed for placed in part])
        return read_masks(self.session, self.card.output, self._feeds(fed), len(part), self._reader)

    def _embed(self, images: Sequence[UInt8[np.ndarray, "_ _ 3"]]) -> Float32[np.ndarray, "n c"]:
        size, output = self._input.shape[0] or _BATCH, self.session.output(self.card.output.name).name
        vectors = [np.zeros((0, self.dim), dtype=np.float32)]
        for at in range(0, len(images), size):
            fed = np.stack([place(image, self.card.input).fed for image in images[at : at + size]])
            raw = self.session.run(output, self._feeds(fed))
            if raw.ndim != 2 or len(raw) != len(fed) or raw.dtype.kind != "f":
                raise self._reader.misfit(f"one vector an image ({len(fed)}, channels)", f"{raw.dtype} {raw.shape}")
            vectors.append(self._reader.unit(raw))
        return np.concatenate(vectors)

    def _feeds(self, images: UInt8[np.ndarray, "n h w 3"]) -> dict[str, np.ndarray]:
        fed = colour(images, self.card.input)
        if self.card.input.layout == "NCHW":
            fed = np.ascontiguousarray(fed.transpose(0, 3, 1, 2))
        if self._input.numpy is np.uint8:
            fed = np.clip(np.rint(fed), 0, 255)
        return {self._input.name: fed.astype(self._input.numpy or np.float32)}


class _Proposals:
    """Masks for crops, from a second model or from images; the cells of their MaskMaps have no vectors."""

    def __init__(self, model: OnnxEncoder | None, images: MaskFiles | None, files: tuple[Path, ...]) -> None:
        self._model, self._images, self.files = model, images, files
        self.given = model is not None or images is not None

    @classmethod
    def of(cls, card: CropCard | None, folder: Path, like: Session) -> "_Proposals":
        """Open what the card names; nothing where it names no masks."""
        if card is not None and card.masks_onnx is not None:
            # runs where, and within the limits, that the image tower does
            providers = [name for name in like.providers if name != CPU]
            session = Session(folder / card.masks_onnx, providers=[*providers, CPU], limits=like.limits)
            found, home = _card(None, session)
            if found.contract != "masks":
                raise ModelError(f"{card.masks_onnx} makes no masks", expected="contract masks", got=found.contract)
            alone = _without_words(found)
            return cls(OnnxEncoder(alone, session, None, folder=home), None, session.files)
        if card is not None and card.mask_images is not None and card.images is not None:
            return cls(None, MaskFiles(folder / card.mask_images, folder / card.images), ())
        return cls(None, None, ())

    def __call__(self, images: Sequence[UInt8[np.ndarray, "_ _ 3"]]) -> list[MaskMap]:
        if self._model is not None:
            return self._model.encode_masks(images)
        assert self._images is not None, "only called where masks are given"
        found = []
        for image in images:
            ids = self._images.ids(image)
            scale = (ids.shape[1] / image.shape[1], ids.shape[0] / image.shape[0])
            count = int(ids.max(initial=-1)) + 1
            empty, sure = np.zeros((count, 0), np.float32), np.ones(count, np.float32)
            found.append(MaskMap(ids, empty, sure, scale, (0.5 * scale[0] - 0.5, 0.5 * scale[1] - 0.5)))
        return found


def _without_words(card: Card) -> Card:
    """Return the card of a mask model without vectors and words."""
    from msgspec import structs

    return structs.replace(card, output=structs.replace(card.output, embeddings=None), text=None)


def _fingerprint(card: Card, files: Sequence[Path]) -> str:
    digest = hashlib.sha256(card.behaviour())
    for file in files:
        digest.update(bytes.fromhex(sha256(file)))
    return digest.hexdigest()
