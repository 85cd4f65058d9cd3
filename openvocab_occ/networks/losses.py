"""Losses of the baselines."""

import torch
from jaxtyping import Bool, Float, Int, Integer
from torch import Tensor, nn

FREQUENCIES = (944004, 1897170, 152386, 2391677, 16957802, 724139, 189027, 2074468, 413451, 2384460, 5916653, 175883646,
               4275424, 51393615, 61411620, 105975596, 116424404, 1892500630)  # fmt: skip
"""Voxels of each Occ3D-nuScenes class in the training set, as DHD counts them."""


def class_weights(frequencies: tuple[int, ...] = FREQUENCIES) -> Float[Tensor, " classes"]:
    """Return 1 / ln(frequency + 0.001)."""
    return 1.0 / (torch.tensor(frequencies, dtype=torch.float64) + 0.001).log().float()


def masked_cross_entropy(
    logits: Float[Tensor, "b x y z classes"],
    labels: Int[Tensor, "b x y z"],
    mask: Bool[Tensor, "b x y z"],
    *,
    weights: Float[Tensor, " classes"] | None = None,
) -> Float[Tensor, ""]:
    """Return the cross entropy averaged over the voxels of the mask; 0 where it is empty (FlashOcc's only loss)."""
    if not mask.any():
        return logits.sum() * 0.0
    return nn.functional.cross_entropy(logits[mask], labels[mask].long(), weight=weights)


def geometric_scal(
    logits: Float[Tensor, "b x y z classes"],
    labels: Int[Tensor, "b x y z"],
    mask: Bool[Tensor, "b x y z"],
    *,
    free: int = 17,
) -> Float[Tensor, ""]:
    """Scene-class affinity of occupied against free: -log precision - log recall - log specificity (MonoScene)."""
    probability = logits[mask].float().softmax(dim=-1)
    occupied = (labels[mask] != free).float()
    p = 1 - probability[:, free]
    return _affinity(p, occupied)


def semantic_scal(
    logits: Float[Tensor, "b x y z classes"], labels: Int[Tensor, "b x y z"], mask: Bool[Tensor, "b x y z"]
) -> Float[Tensor, ""]:
    """Scene-class affinity averaged over the classes that are there (MonoScene)."""
    probability = logits[mask].float().softmax(dim=-1)
    target = labels[mask]
    terms = [
        _affinity(probability[:, c], (target == c).float())
        for c in range(logits.shape[-1])
        if bool((target == c).any())
    ]
    return torch.stack(terms).mean() if terms else logits.sum() * 0.0


def height_loss(
    predicted: Float[Tensor, "b n bins h w"], bins: Integer[Tensor, "b n h w"], *, none: int = 255
) -> Float[Tensor, ""]:
    """Return the binary cross entropy of a height distribution, summed over bins, averaged over pixels with a height.

    DHD's, after BEVDepth's loss on depths; 0 where no pixel has one.
    """
    there = bins != none
    if not there.any():
        return predicted.sum() * 0.0
    p = predicted.movedim(2, -1)[there].float().clamp(1e-6, 1 - 1e-6)
    target = nn.functional.one_hot(bins[there].long(), p.shape[-1]).float()
    return nn.functional.binary_cross_entropy(p, target, reduction="sum") / there.sum()


def _affinity(p: Float[Tensor, " n"], target: Float[Tensor, " n"]) -> Float[Tensor, ""]:
    """Sum -log of soft precision, recall and specificity, each left out where it is undefined."""
    tiny = torch.finfo(p.dtype).tiny
    loss = p.sum() * 0.0
    hit = (p * target).sum()
    if p.sum() > 0:
        loss = loss - (hit / p.sum()).clamp(min=tiny).log()
    if target.sum() > 0:
        loss = loss - (hit / target.sum()).clamp(min=tiny).log()
    away = 1 - target
    if away.sum() > 0:
        loss = loss - (((1 - p) * away).sum() / away.sum()).clamp(min=tiny).log()
    return loss
