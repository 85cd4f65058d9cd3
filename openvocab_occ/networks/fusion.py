"""Fusing the current latent feature with what memory remembers of the place (LMPOcc, section III-C), and its rivals."""

from typing import Literal, cast, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from openvocab_occ.errors import ConfigError

FusionKind = Literal["cp", "concat_branch", "add_branch", "concat", "add", "nmp"]
"""`cp` is Current-Prior Fusion; the next four are the rows of Table III; `nmp` is Neural Map Prior's (Table IV)."""


class CurrentPriorFusion(nn.Module):
    """CPFusion, Eq. 1-4, and its ablations.

        F_cat = W1 [F_c, F_p]        F_add = W2 (F_c + F_p)        alpha = sigmoid(W3 [F_cat, F_add])
        F_agg = alpha F_c + (1 - alpha) F_p

    Kernel sizes are not stated; 3x3 at 256 channels has the published latency's order. One branch alone feeds W3 with
    what it has; `concat` and `add` return F_cat and F_add themselves.
    """

    def __init__(self, channels: int, kind: FusionKind = "cp", *, kernel: int = 3) -> None:
        super().__init__()
        self.kind: FusionKind = kind
        pad = kernel // 2
        if kind in ("cp", "concat_branch", "concat"):
            self.w1 = nn.Conv2d(2 * channels, channels, kernel, padding=pad)
        if kind in ("cp", "add_branch", "add"):
            self.w2 = nn.Conv2d(channels, channels, kernel, padding=pad)
        if kind in ("cp", "concat_branch", "add_branch"):
            self.w3 = nn.Conv2d(channels * (2 if kind == "cp" else 1), channels, kernel, padding=pad)
            if self.w3.bias is not None:
                nn.init.constant_(self.w3.bias, 2.0)  # begin by trusting what is seen now: alpha near 0.9

    def alpha(self, current: Float[Tensor, "b c y x"], prior: Float[Tensor, "b c y x"]) -> Float[Tensor, "b c y x"]:
        """Return the share of the current feature, in (0, 1)."""
        branches: list[Tensor] = []
        if self.kind in ("cp", "concat_branch"):
            branches.append(self.w1(torch.cat([current, prior], dim=1)))
        if self.kind in ("cp", "add_branch"):
            branches.append(self.w2(current + prior))
        return self.w3(torch.cat(branches, dim=1)).sigmoid()

    def forward(self, current: Float[Tensor, "b c y x"], prior: Float[Tensor, "b c y x"]) -> Float[Tensor, "b c y x"]:
        """Return the refined latent feature."""
        if self.kind == "concat":
            return self.w1(torch.cat([current, prior], dim=1))
        if self.kind == "add":
            return self.w2(current + prior)
        alpha = self.alpha(current, prior)
        return alpha * current + (1 - alpha) * prior


class WindowCrossAttention(nn.Module):
    """Each window of the current feature asks the same window of the prior (Neural Map Prior's, after Swin v2)."""

    def __init__(self, channels: int, *, window: int = 10, heads: int = 8) -> None:
        super().__init__()
        self.window, self.heads = window, heads
        self.query, self.key_value = nn.Linear(channels, channels), nn.Linear(channels, 2 * channels)
        self.out, self.norm = nn.Linear(channels, channels), nn.LayerNorm(channels)
        self.temperature = nn.Parameter(torch.full((heads, 1, 1), 0.1))
        self.bias = nn.Sequential(nn.Linear(2, 256), nn.ReLU(), nn.Linear(256, heads, bias=False))
        steps = torch.arange(window)
        place = torch.stack(torch.meshgrid(steps, steps, indexing="ij"), dim=-1).reshape(-1, 2).float()
        apart = place[:, None] - place[None]
        self.register_buffer("apart", apart.sign() * (apart.abs() + 1).log2() / 3.0, persistent=False)

    def forward(self, current: Float[Tensor, "b c y x"], prior: Float[Tensor, "b c y x"]) -> Float[Tensor, "b c y x"]:
        """Return current + norm(attention); places without prior are masked out. Sizes are multiples of the window."""
        b, c, height, width = current.shape
        w, h = self.window, self.heads
        if height % w or width % w:
            raise ConfigError("feature does not split into windows", expected=f"multiples of {w}", got=(height, width))

        def windows(x: Tensor) -> Tensor:  # (b windows, w w, c)
            x = x.reshape(b, c, height // w, w, width // w, w)
            return x.permute(0, 2, 4, 3, 5, 1).reshape(-1, w * w, c)

        asked, told = windows(current), windows(prior)
        q = self.query(asked).unflatten(-1, (h, -1)).transpose(1, 2)
        k, v = self.key_value(told).chunk(2, dim=-1)
        k, v = (x.unflatten(-1, (h, -1)).transpose(1, 2) for x in (k, v))
        cosine = nn.functional.normalize(q, dim=-1) @ nn.functional.normalize(k, dim=-1).transpose(-1, -2)
        score = cosine / self.temperature.clamp(min=0.01) + self.bias(self.apart).permute(2, 0, 1)
        empty = (told == 0).all(dim=-1)[:, None, None, :]
        score = score.masked_fill(empty, -100.0)
        mixed = self.out((score.softmax(dim=-1) @ v).transpose(1, 2).flatten(2))
        back = self.norm(mixed).reshape(b, height // w, width // w, w, w, c)
        return current + back.permute(0, 5, 1, 3, 2, 4).reshape(b, c, height, width)


class ConvGru(nn.Module):
    """3x3 convolutional gated recurrent unit without bias; the prior is the state, the current feature the input."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.update, self.reset, self.candidate = (
            nn.Conv2d(2 * channels, channels, 3, padding=1, bias=False) for _ in range(3)
        )

    def forward(self, current: Float[Tensor, "b c y x"], prior: Float[Tensor, "b c y x"]) -> Float[Tensor, "b c y x"]:
        """Return (1 - z) h + z q."""
        both = torch.cat([prior, current], dim=1)
        z, r = self.update(both).sigmoid(), self.reset(both).sigmoid()
        q = self.candidate(torch.cat([r * prior, current], dim=1)).tanh()
        return (1 - z) * prior + z * q


class NeuralMapPriorFusion(nn.Module):
    """Window cross-attention, then ConvGRU (Xiong et al. 2023), as LMPOcc's Table IV compares with."""

    def __init__(self, channels: int, *, window: int = 10) -> None:
        super().__init__()
        self.attention, self.gru = WindowCrossAttention(channels, window=window), ConvGru(channels)

    def forward(self, current: Float[Tensor, "b c y x"], prior: Float[Tensor, "b c y x"]) -> Float[Tensor, "b c y x"]:
        """Return the refined latent feature."""
        return self.gru(self.attention(current, prior), prior)


def make_fusion(kind: str, channels: int) -> CurrentPriorFusion | NeuralMapPriorFusion:
    """Build a fusion by its FusionKind."""
    if kind not in get_args(FusionKind):
        raise ConfigError("fusion is not known", expected=" or ".join(get_args(FusionKind)), got=kind)
    return NeuralMapPriorFusion(channels) if kind == "nmp" else CurrentPriorFusion(channels, cast(FusionKind, kind))


def where_known(
    fused: Float[Tensor, "b c y x"], current: Float[Tensor, "b c y x"], known: Bool[Tensor, "b y x"]
) -> Float[Tensor, "b c y x"]:
    """Keep the current feature in cells of which memory knows nothing, so that an empty map changes nothing."""
    return torch.where(known[:, None], fused, current)
