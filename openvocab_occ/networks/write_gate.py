"""What to write into a map, and how fast to forget: learned, where the paper replaces (its future work)."""

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn

from openvocab_occ.errors import ModelError
from openvocab_occ.io.files import PathLike
from openvocab_occ.networks.checkpoint import fill, read_checkpoint
from openvocab_occ.networks.lmop import limited

_LOGIT_SCALE = 0.2
_FACTS = 4  # written before or not, how often, how long ago, how far away


class WriteGate(nn.Module):
    """Two shares for each voxel: what is stored becomes keep x old + write x new.

    Replacing is (0, 1), a running mean (1 - w, w), adding up evidence (1, 1); 1 - keep is how fast a voxel forgets. It
    begins at (0.5, 0.5). Voxels do not see each other, so that a gate learned on one lattice fits every other, and
    stands in the way of no policy of a `StreamMap`: an instance is its `Gate`.
    """

    def __init__(self, classes: int = 18, *, width: int = 32) -> None:
        super().__init__()
        self.classes = classes
        self.shares = nn.Sequential(nn.Linear(2 * classes + 1 + _FACTS, width), nn.ReLU(), nn.Linear(width, 2))
        for parameter in self.shares[-1].parameters():
            nn.init.zeros_(parameter)

    def forward(
        self, new: Float[Tensor, "n classes"], old: Float[Tensor, "n classes"], facts: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n 2"]:
        """Return the shares of old and new.

        Args:
            new: Centred logits of a prediction.
            old: Of the map, 0 where it knew nothing.
            facts: How often the voxel was written, days since the last time, metres from the ego.
        """
        agreement = (new.softmax(dim=-1) * old.softmax(dim=-1)).sum(dim=-1, keepdim=True)
        told = [(facts[:, :1] > 0).to(facts.dtype), facts[:, :2].log1p(), facts[:, 2:] / 40]
        both = [limited(x) * _LOGIT_SCALE for x in (new, old)]
        return self.shares(torch.cat([*both, agreement, *told], dim=-1)).sigmoid()

    @torch.no_grad()
    def choose(
        self, new: Float32[np.ndarray, "n classes"], old: Float32[np.ndarray, "n classes"],
        facts: Float32[np.ndarray, "n 3"],
    ) -> Float32[np.ndarray, "n 2"]:  # fmt: skip
        """Return the shares of arrays: the `gate` of `StreamMap.write`."""
        device = next(self.parameters()).device
        return self(*(torch.from_numpy(np.ascontiguousarray(a)).to(device) for a in (new, old, facts))).cpu().numpy()


def load_write_gate(weights: PathLike) -> WriteGate:
    """Open the weights of `train_write_gate`.

    Raises:
        ModelError: They are damaged, or of something else.
    """
    state = read_checkpoint(weights).state
    first = state.get("shares.0.weight")
    if first is None or first.ndim != 2 or (first.shape[1] - 1 - _FACTS) % 2:
        raise ModelError("the checkpoint is no write gate", expected="shares.0.weight", got=", ".join(list(state)[:3]),
                         fix="give weights of train_write_gate")  # fmt: skip
    gate = WriteGate((first.shape[1] - 1 - _FACTS) // 2, width=first.shape[0])
    report = fill(gate, state)
    if not report.complete:
        raise ModelError("the write gate's weights are not whole", got=report.summary())
    return gate.eval()
