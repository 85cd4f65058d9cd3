"""Whom the fusion believes: alpha of Eq. 3 on cells of dynamic, static and free columns, and a picture of it.

    python -m benchmarks.lmpocc.alpha --out out/lmpocc --picture docs/images/lmpocc-alpha.png

Reads what `python -m benchmarks.lmpocc core` left in OUT. Alpha is the share of the current feature, mean over
channels, where the map of other logs knows something, on visits after the first.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
import tyro

from benchmarks.lmpocc.scales import CORE
from openvocab_occ.evaluation.occupancy import DYNAMIC, STATIC
from openvocab_occ.networks.fusion import CurrentPriorFusion
from openvocab_occ.networks.lmop import Lmop, bev_of
from openvocab_occ.networks.predictor import load_network
from openvocab_occ.training.drives import by_place, city_drives
from openvocab_occ.training.latents import cache_latents
from openvocab_occ.training.loop import FINAL
from openvocab_occ.training.memory import evaluate_memory
from openvocab_occ.training.streams import MemoryConfig, Visit

GROUPS: tuple[str, ...] = ("dynamic", "static", "free", "standing")
"""A column is dynamic where cameras see a dynamic class in it, else static where they see a static one; of these
standing are those with a building, a wall or a plant."""
_FLAT = (11, 12, 13, 14)  # driveable surface, other flat, sidewalk, terrain
_STANDING = tuple(c for c in STATIC if c not in _FLAT)


def main(out: Path, *, picture: Path | None = None, cities: int = 3, seeds: Sequence[int] = CORE.seeds) -> None:
    """Print mean alpha by group and seed; draw the frame with most dynamic columns.

    Args:
        out: Folder of the experiments.
        picture: File of the picture, of the first seed.
        cities: So many of the test cities.
        seeds: Of the memories.
    """
    (name,) = CORE.networks
    home = out / name
    base = load_network(name, home / "base" / FINAL)
    plan = city_drives(CORE.test, base.config, out / "drives")
    places = dict(list(by_place(plan).items())[:cities])
    latents = cache_latents(base.module, [d for found in places.values() for d in found], home / "latents")  # pyright: ignore[reportArgumentType]
    for seed in seeds:
        network = load_network(name, home / f"lmop-{seed}" / FINAL, memory=True)
        seen = _Alphas(network.module)
        evaluate_memory(network, places, latents, MemoryConfig(prior_from="other_logs", misplaced=0.0), observer=seen)
        print(f"seed {seed}: " + ", ".join(f"{g} {seen.mean(g):.3f} ({seen.count[g]:,} cells)" for g in seen.count))
        if picture is not None and seed == seeds[0]:
            seen.draw(picture)


class _Alphas:
    """Listens to a memory's fusion while it predicts."""

    def __init__(self, module: torch.nn.Module) -> None:
        assert isinstance(module, Lmop)
        assert isinstance(module.fusion, CurrentPriorFusion)
        self._module, self._refine = module, module.refine
        module.refine = self._listen  # pyright: ignore[reportAttributeAccessIssue]
        self._waiting: list[tuple[np.ndarray, np.ndarray]] = []
        self.total: dict[str, float] = dict.fromkeys(GROUPS, 0.0)
        self.count: dict[str, int] = dict.fromkeys(self.total, 0)
        self._best: tuple[int, np.ndarray, np.ndarray] | None = None

    def _listen(self, current: torch.Tensor, prior: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
        fusion = self._module.fusion
        alpha = fusion.alpha(current, self._module.align(bev_of(prior))).float().mean(1)  # pyright: ignore
        self._waiting += zip(alpha.transpose(1, 2).numpy(), known.any(3).numpy(), strict=True)
        return self._refine(current, prior, known)

    def __call__(self, visit: Visit, _logits: np.ndarray) -> None:
        """Count a frame."""
        alpha, known = self._waiting.pop(0)
        if visit.stream.drives.index(visit.drive) == 0:
            return
        labels, mask = visit.drive.labels[visit.frame], visit.drive.mask[visit.frame]

        def there(classes: tuple[int, ...]) -> np.ndarray:
            return (np.isin(labels, classes) & mask).any(2)

        dynamic, static = there(DYNAMIC), there(STATIC)
        groups = {"dynamic": dynamic, "static": static & ~dynamic, "free": mask.any(2) & ~dynamic & ~static,
                  "standing": there(_STANDING) & ~dynamic}  # fmt: skip
        for group, cells in groups.items():
            self.total[group] += float(alpha[cells & known].sum())
            self.count[group] += int((cells & known).sum())
        seen = int((dynamic & known).sum())
        if self._best is None or seen > self._best[0]:
            shown = np.where(dynamic, 3, np.where(groups["standing"], 2, np.where(static, 1, 0)))
            self._best = seen, np.where(known, alpha, np.nan), shown

    def mean(self, group: str) -> float:
        """Return the mean alpha of a group."""
        return self.total[group] / max(self.count[group], 1)

    def draw(self, path: Path) -> None:
        """Draw alpha from above beside what is there."""
        from matplotlib import pyplot as plt
        from matplotlib.colors import ListedColormap
        from matplotlib.patches import Patch

        assert self._best is not None, "no frame was seen"
        _, alpha, shown = self._best
        reach = (-40, 40, -40, 40)
        figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4.2), layout="constrained")
        colors = ("0.92", "0.7", "tab:blue", "tab:orange")
        left.imshow(shown.T, cmap=ListedColormap(colors), vmin=0, vmax=3, origin="lower", extent=reach)
        names = ("not seen", "ground", "standing", "dynamic")
        patches = [Patch(color=color, label=name) for color, name in zip(colors, names, strict=True)]
        left.legend(handles=patches, loc="upper center", ncol=4, fontsize=7, frameon=False, bbox_to_anchor=(0.5, -0.15))
        left.set_title("what cameras see", fontsize=10)
        image = right.imshow(alpha.T, cmap="viridis", origin="lower", extent=reach)
        right.set_title("alpha, where the map knows something", fontsize=10)
        figure.colorbar(image, ax=right, label="share of the current feature", shrink=0.85)
        for axis in (left, right):
            axis.set_xlabel("x ahead, m")
            axis.set_ylabel("y left, m")
        figure.suptitle("Whom the fusion believes (synthetic city)", fontsize=10)
        figure.savefig(path, dpi=120)
        plt.close(figure)


if __name__ == "__main__":
    tyro.cli(main)
