"""The channel-to-height head: a ground feature becomes logits of every voxel (FlashOcc)."""

from jaxtyping import Float
from torch import Tensor, nn

from openvocab_occ.networks.necks import NamedConv


class OccHead(nn.Module):
    """3x3 convolution, then at each cell two linear layers that spread the channels over height and class."""

    def __init__(self, inputs: int, *, heights: int = 16, classes: int = 18) -> None:
        super().__init__()
        self.heights, self.classes = heights, classes
        self.final_conv = NamedConv(inputs, inputs, 3)
        # the name is the public checkpoints' own
        self.predicter = nn.Sequential(
            nn.Linear(inputs, 2 * inputs), nn.Softplus(), nn.Linear(2 * inputs, heights * classes)
        )

    def forward(self, latent: Float[Tensor, "b c y x"]) -> Float[Tensor, "b x y z classes"]:
        """Return logits in the order of occupancy labels, [x, y, z]."""
        cells = self.final_conv(latent).relu().permute(0, 3, 2, 1)
        return self.predicter(cells).unflatten(-1, (self.heights, self.classes))
