"""Feature sums on a GPU."""

import numpy as np
import torch
from jaxtyping import Float32, Int

from openvocab_occ.mapping.records import BLOCK, FeatureSums


class TorchFeatureSums(FeatureSums):
    """Feature sums by row, in blocks that torch keeps on a device such as `cuda`; what comes out is numpy's."""

    def __init__(self, dim: int, device: str) -> None:
        super().__init__(dim)
        self._device = device
        self._tensors: list[torch.Tensor] = []

    def reserve(self, count: int) -> None:
        """Make room for rows up to `count`; new ones are zero."""
        while len(self._tensors) * BLOCK < count:
            self._tensors.append(torch.zeros((BLOCK, self.dim), device=self._device))
        self._count = max(self._count, count)

    def add(
        self,
        rows: Int[np.ndarray, " p"],
        source: Int[np.ndarray, " p"],
        share: Float32[np.ndarray, " p"],
        sums: Float32[np.ndarray, "m c"],
    ) -> None:
        """Add share[i] sums[source[i]] to each row[i]."""
        there = torch.from_numpy(np.ascontiguousarray(sums)).to(self._device)
        block = rows // BLOCK
        for number in np.unique(block).tolist():
            part = np.flatnonzero(block == number)
            at, from_, scale = (torch.from_numpy(a[part]).to(self._device) for a in (rows % BLOCK, source, share))
            self._tensors[number].index_add_(0, at.long(), there[from_.long()] * scale.float()[:, None])

    def rows(self, order: Int[np.ndarray, " n"]) -> Float32[np.ndarray, "n c"]:
        """Return the rows in this order."""
        result = np.empty((len(order), self.dim), dtype=np.float32)
        for number in np.unique(order // BLOCK).tolist():
            part = np.flatnonzero(order // BLOCK == number)
            at = torch.from_numpy(order[part] % BLOCK).to(self._device)
            result[part] = self._tensors[number][at.long()].cpu().numpy()
        return result
