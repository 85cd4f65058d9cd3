"""Models that put out masks and one vector each."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float32

from openvocab_occ.segmentation.card import OutputCard
from openvocab_occ.segmentation.encoder import FeatureMap, MaskMap
from openvocab_occ.segmentation.outputs import Reader, sigmoid, softmax
from openvocab_occ.segmentation.picture import Placed
from openvocab_occ.segmentation.session import Session

_LEAST = 0.5  # probability of a cell to belong to a mask


def read_masks(
    session: Session, card: OutputCard, feeds: dict[str, np.ndarray], count: int, reader: Reader
) -> list[tuple[Float32[np.ndarray, "h w q"], Float32[np.ndarray, "q c"], Float32[np.ndarray, " q"]]]:
    """Run a mask model; return, for each image, each cell's share in each mask, unit vectors, and scores 0 to 1.

    A model without vectors (proposals for crops) gets none of length: q x 0.
    """
    names = [session.output(card.name).name]
    optional = {key: getattr(card, key) for key in ("embeddings", "scores", "void") if getattr(card, key)}
    names += [session.output(name).name for name in optional.values()]
    found = dict(zip(("masks", *optional), session.run_many(names, feeds), strict=True))
    masks = found["masks"]
    if masks.ndim != 4 or len(masks) != count or masks.dtype.kind != "f":
        raise reader.misfit(f"masks ({count}, masks, height, width)", f"{masks.dtype} {masks.shape}")
    queries = masks.shape[1]
    for key in optional:
        wanted = (count, queries) + ((None,) if key == "embeddings" else ())
        if len(found[key].shape) != len(wanted) or found[key].shape[:2] != (count, queries):
            raise reader.misfit(f"{key} ({count}, {queries}{', channels' * (len(wanted) == 3)})", str(found[key].shape))
    result = []
    for image in range(count):
        shares = np.ascontiguousarray(masks[image].transpose(1, 2, 0), dtype=np.float32)
        if card.mask_activation != "none":
            shares = softmax(shares) if card.mask_activation == "softmax" else sigmoid(shares)
        scores = np.ones(queries, dtype=np.float32)
        for key in ("scores", "void"):
            if key in found:
                value = found[key][image].astype(np.float32)
                value = sigmoid(value) if card.score_activation == "sigmoid" else np.clip(value, 0, 1)
                scores = scores * (value if key == "scores" else 1 - value)
        vectors = np.zeros((queries, 0), dtype=np.float32)
        if "embeddings" in found:
            vectors = reader.unit(found["embeddings"][image])
        result.append((shares, vectors, scores))
    return result


def mixed(
    shares: Float32[np.ndarray, "h w q"],
    vectors: Float32[np.ndarray, "q c"],
    scores: Float32[np.ndarray, " q"],
    scale_offset: tuple[tuple[float, float], tuple[float, float]],
) -> FeatureMap:
    """Return each cell's vector: those of all masks, weighed by share and score, made unit."""
    cells = shares * scores @ vectors
    lengths = np.linalg.norm(cells, axis=2, keepdims=True)
    return FeatureMap(cells / np.where(lengths > 0, lengths, 1), *scale_offset)


def parted(
    shares: Float32[np.ndarray, "h w q"],
    vectors: Float32[np.ndarray, "q c"],
    scores: Float32[np.ndarray, " q"],
    scale_offset: tuple[tuple[float, float], tuple[float, float]],
) -> MaskMap:
    """Return the mask each cell most belongs to, by share times score; none where its share is below a half."""
    best = (shares * scores).argmax(axis=2)
    share = np.take_along_axis(shares, best[:, :, None], axis=2)[:, :, 0]
    rows = np.where(share >= min(_LEAST, float(shares.max(initial=0))), best, -1)
    used, ids = np.unique(rows, return_inverse=True)
    ids = ids.reshape(rows.shape).astype(np.int32) - int(used[0] == -1)
    kept = used[used >= 0]
    return MaskMap(ids, vectors[kept], scores[kept], *scale_offset)


def cell_place(
    placed: Placed, cells: Sequence[int], *, shape: tuple[int, int] | None = None
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return scale and offset of a FeatureMap of `cells` rows and columns spread over what the model was fed.

    `shape` is the height and width that the cells span, where it is more than what was fed (tiles).
    """
    height, width = shape or placed.fed.shape[:2]
    across, down = cells[1] / width, cells[0] / height
    scale = (placed.scale[0] * across, placed.scale[1] * down)
    offset = ((placed.offset[0] + 0.5) * across - 0.5, (placed.offset[1] + 0.5) * down - 0.5)
    return scale, offset


def box_of(mask: Float[np.ndarray, "h w"]) -> tuple[int, int, int, int] | None:
    """Return top, left, bottom, right (exclusive) of what is above a half; None for an empty mask."""
    rows, columns = np.flatnonzero((mask > _LEAST).any(axis=1)), np.flatnonzero((mask > _LEAST).any(axis=0))
    if not len(rows):
        return None
    return int(rows[0]), int(columns[0]), int(rows[-1]) + 1, int(columns[-1]) + 1
