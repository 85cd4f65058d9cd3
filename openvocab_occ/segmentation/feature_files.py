"""Features and masks computed elsewhere, one file an image, found again by what the image shows."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int32, UInt8

from openvocab_occ.errors import DataError, NotFoundError, UnsafeFileError
from openvocab_occ.io.files import existing, sha256
from openvocab_occ.io.images import read_image
from openvocab_occ.segmentation.card import FilesCard, OutputCard
from openvocab_occ.segmentation.encoder import Contract, FeatureMap, TextEncoder
from openvocab_occ.segmentation.outputs import Reader
from openvocab_occ.segmentation.text import OnnxTextEncoder

_IMAGES = (".jpg", ".jpeg", ".png", ".bmp", ".webp")
_FILES = (".npy", ".safetensors")


class ImageIndex:
    """Images of a folder by their pixels, so that an array finds its file. Each image is read once, at first use."""

    def __init__(self, folder: Path) -> None:
        self.folder = existing(folder, "folder of images")
        self._names: dict[str, str] | None = None

    def name(self, image: UInt8[np.ndarray, "h w 3"]) -> str:
        """Return the file name, without suffix, of the image with exactly these pixels."""
        if self._names is None:
            files = sorted(p for p in self.folder.iterdir() if p.suffix.lower() in _IMAGES)
            self._names = {_pixels_hash(read_image(file)): file.stem for file in files}
        found = self._names.get(_pixels_hash(image))
        if found is None:
            raise NotFoundError(
                "an image of the drive is not among those that features were computed for",
                expected=f"the same pixels as one of {len(self._names)} images in {self.folder}",
                got=f"an image of {image.shape[1]} x {image.shape[0]}",
                fix="compute features from the images as the reader gives them, not resized or saved again as JPEG",
            )
        return found


class FeatureFileEncoder:
    """Cells read from files; see PixelEncoder."""

    def __init__(self, card: FilesCard, folder: Path, text: OnnxTextEncoder | None, *, source: Path) -> None:
        self.card = card
        self.name = card.name
        self.contract: Contract = "dense" if card.kind == "features" else "logits"
        self.labels = card.labels
        self.text: TextEncoder | None = text
        self.dim = len(card.labels) if text is None else text.dim
        self._index = ImageIndex(folder / card.images)
        self._features = existing(folder / card.features, "folder of features")
        layout = "NCHW" if card.layout == "CHW" else "NHWC"
        self._output = OutputCard(layout=layout, kind=card.kind)
        digest = hashlib.sha256(card.behaviour() + bytes.fromhex(sha256(source)))
        for file in text.files if text is not None else ():
            digest.update(bytes.fromhex(sha256(file)))
        for file in sorted(
            self._features.iterdir()
        ):  # contents would take minutes; a changed file changes its size or time
            if file.suffix in _FILES:
                digest.update(f"{file.name} {file.stat().st_size} {file.stat().st_mtime_ns}".encode())
        self.fingerprint: str = digest.hexdigest()

    def encode(self, images: Sequence[UInt8[np.ndarray, "_ _ 3"]]) -> list[FeatureMap]:
        """Look the images up."""
        return [self._read(image) for image in images]

    def _read(self, image: UInt8[np.ndarray, "h w 3"]) -> FeatureMap:
        name = self._index.name(image)
        found = [file for suffix in _FILES if (file := self._features / (name + suffix)).is_file()]
        if not found:
            raise NotFoundError(
                f"image {name} has no features", expected=f"{name}.npy or {name}.safetensors in {self._features}"
            )
        reader = Reader(card=self._output, dim=self.dim, model=found[0].name, from_text=self.text is not None)
        raw = read_array(found[0])
        if raw.ndim == 3:
            raw = raw[None]
        cells = reader.cells(raw.astype(np.float32), 1, image.shape[:2])[0]
        scale = (cells.shape[1] / image.shape[1], cells.shape[0] / image.shape[0])
        return FeatureMap(cells, scale, (0.5 * scale[0] - 0.5, 0.5 * scale[1] - 0.5))


def read_array(file: Path) -> np.ndarray:
    """Return the finite array of a .npy file, or the only tensor of a .safetensors file; never a pickle."""
    if file.suffix == ".safetensors":
        array = _only_tensor(file)
    else:
        try:
            array = np.load(file, allow_pickle=False)
        except ValueError as error:
            if "allow_pickle" in str(error) or "pickled" in str(error):
                raise UnsafeFileError(f"{file.name} holds a pickle", expected="an array of numbers") from error
            raise DataError(f"{file.name} cannot be read", got=str(error).partition("\n")[0]) from error
        except (OSError, EOFError) as error:
            raise DataError(f"{file.name} cannot be read", got=str(error).partition("\n")[0]) from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        raise DataError(f"{file.name} holds no array of numbers", got=type(array).__name__)
    if not np.isfinite(array).all():
        raise DataError(f"{file.name} is not finite", expected="numbers", got="NaN or infinite values")
    return array


def _only_tensor(file: Path) -> np.ndarray:
    """Read a .safetensors file: 8 bytes of length, a JSON header, plain data."""
    import msgspec

    kinds = {"F64": "<f8", "F32": "<f4", "F16": "<f2", "I64": "<i8", "I32": "<i4", "U8": "u1"}
    content = file.read_bytes()
    try:
        length = int.from_bytes(content[:8], "little")
        header = {k: v for k, v in msgspec.json.decode(content[8 : 8 + length]).items() if k != "__metadata__"}
        ((_, facts),) = header.items()
        start, end = facts["data_offsets"]
        data = np.frombuffer(content[8 + length + start : 8 + length + end], dtype=kinds[facts["dtype"]])
        return data.reshape(facts["shape"])
    except (msgspec.DecodeError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(
            f"{file.name} cannot be read",
            expected="one tensor of F64, F32, F16, I64, I32 or U8",
            got=" ".join(str(error).split())[:200],
        ) from error


class MaskFiles:
    """Masks from PNG images: 0 is none, other grey levels are numbers of masks."""

    def __init__(self, masks: Path, images: Path) -> None:
        self._index = ImageIndex(images)
        self._folder = existing(masks, "folder of mask images")

    def ids(self, image: UInt8[np.ndarray, "h w 3"]) -> Int32[np.ndarray, "a b"]:
        """Return the number of the mask of each pixel of the mask image, from 0, -1 for none."""
        import cv2

        file = existing(self._folder / f"{self._index.name(image)}.png", "mask image")
        found = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        if found is None or found.ndim != 2 or found.dtype not in (np.uint8, np.uint16):
            raise DataError(
                f"mask image {file.name} is not usable",
                expected="a grey PNG of 8 or 16 bits",
                got="no image" if found is None else f"{found.dtype} {found.shape}",
            )
        used, ids = np.unique(found, return_inverse=True)
        return ids.reshape(found.shape).astype(np.int32) - int(used[0] == 0)


def _pixels_hash(image: UInt8[np.ndarray, "h w 3"]) -> str:
    digest = hashlib.sha256(str(image.shape).encode())
    digest.update(np.ascontiguousarray(image).data)
    return digest.hexdigest()
