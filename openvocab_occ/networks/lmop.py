"""Long-term memory occupancy priors around any baseline (LMPOcc, section III-B)."""

import copy

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from openvocab_occ.errors import ShapeError
from openvocab_occ.networks.flashocc import FlashOcc
from openvocab_occ.networks.fusion import FusionKind, make_fusion, where_known
from openvocab_occ.networks.lift_splat import Rig

LOGIT_REACH = 9.0
"""No class counts as further below the likeliest than this: a loud writer does not drown the others. It is what a tile
map of uint8 holds. Clamping centred logits instead makes classes equal at the top as soon as a network is sure."""
_LOGIT_SCALE = 0.2  # brings them to the scale of activations


class Lmop(nn.Module):
    """A frozen baseline whose latent feature is fused with the prior of a global map, and a head of its own.

    The baseline is held, not changed: its weights get no gradient and its head stays as it is; the head here begins as
    its copy. Where the prior knows nothing the latent feature passes unchanged.
    """

    def __init__(self, baseline: FlashOcc, *, fusion: FusionKind = "cp") -> None:
        super().__init__()
        config = baseline.config
        self.baseline = baseline.requires_grad_(False)
        self.align = nn.Sequential(
            nn.Conv2d(config.shape[2] * config.classes, config.latent, 1), nn.ReLU(),
            nn.Conv2d(config.latent, config.latent, 3, padding=1),
        )  # fmt: skip
        self.fusion = make_fusion(fusion, config.latent)
        self.occ_head = copy.deepcopy(baseline.occ_head).requires_grad_(True)

    def train(self, mode: bool = True) -> "Lmop":
        """Train what is ours; the baseline's batch norms keep their statistics."""
        super().train(mode)
        self.baseline.eval()
        return self

    def forward(
        self,
        images: Float[Tensor, "b n 3 h w"],
        rig: Rig,
        prior: Float[Tensor, "b x y z classes"],
        known: Bool[Tensor, "b x y z"],
    ) -> Float[Tensor, "b x y z classes"]:
        """Return refined logits.

        Args:
            images: Normalised.
            rig: Of the images. BEV augmentation is refused: the prior is not turned with it.
            prior: Class-centred log-probabilities of the map's window, 0 where unknown.
            known: Which voxels the map has seen.
        """
        eye = torch.eye(3, device=rig.T_bev_ego.device)
        if not torch.equal(rig.T_bev_ego, eye.expand_as(rig.T_bev_ego)):
            raise ShapeError("bird's-eye-view augmentation cannot be used with memory", expected="T_bev_ego = I",
                             fix="train the memory without it, as the paper does")  # fmt: skip
        with torch.no_grad():
            current = self.baseline.latent(images, rig)
        return self.refine(current, prior, known)

    def refine(
        self,
        current: Float[Tensor, "b c y x"],
        prior: Float[Tensor, "b x y z classes"],
        known: Bool[Tensor, "b x y z"],
    ) -> Float[Tensor, "b x y z classes"]:
        """Return refined logits from a latent feature, which may have been cached."""
        config = self.baseline.config
        expected = (len(current), *config.shape, config.classes)
        if tuple(prior.shape) != expected:
            raise ShapeError("prior does not fit the network", expected=expected, got=tuple(prior.shape),
                             fix="read it with the network's GridSpec and class names")  # fmt: skip
        remembered = self.align(bev_of(prior))
        # the feature is indexed [y, x], the grid [x, y]
        seen = known.any(dim=3).transpose(1, 2)
        return self.occ_head(where_known(self.fusion(current, remembered), current, seen))


def bev_of(prior: Float[Tensor, "b x y z classes"]) -> Float[Tensor, "b zc y x"]:
    """Put height and class into channels (z first), limited and scaled: the local prior of Fig. 2."""
    return (limited(prior) * _LOGIT_SCALE).flatten(3).permute(0, 3, 2, 1)


def limited(logits: Float[Tensor, "*n classes"], reach: float = LOGIT_REACH) -> Float[Tensor, "*n classes"]:
    """Return logits about their mean, none further than `reach` below the largest; zeros stay zeros."""
    below = (logits - logits.amax(dim=-1, keepdim=True)).clamp(min=-reach)
    return below - below.mean(dim=-1, keepdim=True)
