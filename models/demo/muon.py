"""Muon for the weights of convolutions: steps of momentum whose matrix is made orthogonal.

From Jordan et al. (2024), https://kellerjordan.github.io/posts/muon; a kernel [o, i, h, w] is the matrix [o, i h w].
After 1,500 steps on names of classes alone, a network of this kind was at a mean IoU of 0.54 where AdamW was at 0.42.
"""

from collections.abc import Iterable

import torch
from torch import Tensor

_QUINTIC = (3.4445, -4.7750, 2.0315)  # drives singular values to about 1
_ROUNDS = 5


def orthogonal(matrices: Tensor) -> Tensor:
    """Return about U V' of matrices U S V', [..., m, n]: Newton-Schulz iteration on Gram matrices; they are smaller."""
    a, b, c = _QUINTIC
    tall = matrices.shape[-2] > matrices.shape[-1]
    x = matrices.mT if tall else matrices
    x = x / (x.norm(dim=(-2, -1), keepdim=True) + 1e-7)
    gram = x @ x.mT
    product = None
    for step in range(_ROUNDS):
        factor = (gram @ gram).mul_(c).add_(gram, alpha=b)
        factor.diagonal(dim1=-2, dim2=-1).add_(a)
        product = factor if product is None else factor @ product
        if step < _ROUNDS - 1:
            gram = factor @ gram @ factor
    x = product @ x
    return x.mT if tall else x


class Muon(torch.optim.Optimizer):
    """For weights of two and more axes."""

    def __init__(self, params: Iterable[Tensor], lr: float, momentum: float = 0.95, weight_decay: float = 0.02) -> None:
        super().__init__(params, {"lr": lr, "momentum": momentum, "weight_decay": weight_decay})

    @torch.no_grad()
    def step(self) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Take a step along the gradients."""
        for group in self.param_groups:
            alike: dict[torch.Size, list[Tensor]] = {}  # matrices of one shape go through at once
            for weight in group["params"]:
                if weight.grad is not None:
                    alike.setdefault(weight.shape, []).append(weight)
            for weights in alike.values():
                along = [self._along(weight, group["momentum"]).flatten(1) for weight in weights]
                gain = max(1.0, along[0].shape[0] / along[0].shape[1]) ** 0.5
                for weight, step in zip(weights, orthogonal(torch.stack(along)), strict=True):
                    weight.mul_(1 - group["lr"] * group["weight_decay"])
                    weight.add_(step.view_as(weight), alpha=-group["lr"] * gain)

    def _along(self, weight: Tensor, momentum: float) -> Tensor:
        """Return the gradient with Nesterov's momentum."""
        mean = self.state[weight].setdefault("mean", torch.zeros_like(weight))
        mean.lerp_(weight.grad, 1 - momentum)
        return weight.grad.lerp(mean, momentum)
