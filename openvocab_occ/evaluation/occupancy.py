"""Metrics of occupancy: mIoU with the camera's mask, geometric IoU, RayIoU."""

import math
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int64, UInt8

from openvocab_occ.arrays import check_shape
from openvocab_occ.errors import DataError
from openvocab_occ.geometry import invert, transform
from openvocab_occ.occupancy import OCC3D_CLASSES, OCC3D_FREE, OccupancyGrid
from openvocab_occ.occupancy.rays import cast_rays

DYNAMIC = tuple(range(11))
"""Occ3D classes that the paper counts as dynamic: others to truck."""
STATIC = tuple(range(11, 17))
RAY_THRESHOLDS = (1.0, 2.0, 4.0)  # metres


@dataclass
class OccupancyScore:
    """A confusion matrix over voxels, added up over frames."""

    num_classes: int = len(OCC3D_CLASSES)
    free_label: int = OCC3D_FREE
    confusion: Int64[np.ndarray, "truth predicted"] = field(init=False)

    def __post_init__(self) -> None:
        self.confusion = np.zeros((self.num_classes, self.num_classes), np.int64)

    def add(
        self,
        predicted: UInt8[np.ndarray, "x y z"],
        truth: UInt8[np.ndarray, "x y z"],
        mask: Bool[np.ndarray, "x y z"] | None = None,
    ) -> None:
        """Count one frame; voxels outside `mask` (Occ3D's mask_camera) do not count."""
        check_shape(predicted, truth.shape, "predicted labels")
        p, t = (predicted.ravel(), truth.ravel()) if mask is None else (predicted[mask], truth[mask])
        if p.size and max(int(p.max()), int(t.max())) >= self.num_classes:
            raise DataError("labels are out of range", expected=f"0..{self.num_classes - 1}", got=max(p.max(), t.max()))
        counts = np.bincount(t.astype(np.int64) * self.num_classes + p, minlength=self.num_classes**2)
        self.confusion += counts.reshape(self.num_classes, self.num_classes)

    @property
    def iou(self) -> Float[np.ndarray, " classes"]:
        """IoU of each class over all frames together; NaN for a class that is in neither."""
        hit = np.diag(self.confusion)
        union = self.confusion.sum(0) + self.confusion.sum(1) - hit
        return np.where(union > 0, hit / np.maximum(union, 1), np.nan)

    def mean(self, classes: tuple[int, ...] | None = None) -> float:
        """Return the mean IoU of classes, by default all but free; NaN classes are left out."""
        chosen = [c for c in range(self.num_classes) if c != self.free_label] if classes is None else list(classes)
        values = self.iou[chosen]
        return float(np.nanmean(values)) if np.isfinite(values).any() else math.nan

    @property
    def geometric(self) -> float:
        """IoU of occupied against free."""
        keep = np.arange(self.num_classes) != self.free_label
        hit = self.confusion[np.ix_(keep, keep)].sum()
        union = self.confusion.sum() - self.confusion[self.free_label, self.free_label]
        return float(hit / union) if union else math.nan

    def to_dict(self) -> dict[str, float]:
        """Return the rows of the paper's tables, in percent."""
        rows = {
            "mIoU": self.mean(),
            "dynamic": self.mean(DYNAMIC),
            "static": self.mean(STATIC),
            "geometric": self.geometric,
        }
        return {name: round(100 * value, 2) for name, value in rows.items()}


def ray_directions() -> Float[np.ndarray, "14040 3"]:
    """Return the rays of RayIoU (SparseOcc): 39 pitches from -45 to 12.5 degrees, 360 azimuths."""
    pitches = [-math.atan(1 / (k + 1)) for k in range(10)]
    step = pitches[-1] - pitches[-2]
    while pitches[-1] < 0.21:
        pitches.append(pitches[-1] + step)
    pitch = np.array(pitches)[:, None]
    azimuth = np.deg2rad(np.arange(360.0))[None, :]
    rays = np.stack(
        np.broadcast_arrays(np.cos(pitch) * np.cos(azimuth), np.cos(pitch) * np.sin(azimuth), np.sin(pitch)), -1
    )
    return rays.reshape(-1, 3)


@dataclass
class RayScore:
    """RayIoU, added up over frames: do rays from where the LiDAR was meet the right class at the right distance?"""

    num_classes: int = len(OCC3D_CLASSES)
    free_label: int = OCC3D_FREE
    hits: Int64[np.ndarray, "thresholds classes"] = field(init=False)
    truths: Int64[np.ndarray, " classes"] = field(init=False)
    predictions: Int64[np.ndarray, " classes"] = field(init=False)

    def __post_init__(self) -> None:
        self.hits = np.zeros((len(RAY_THRESHOLDS), self.num_classes), np.int64)
        self.truths = np.zeros(self.num_classes, np.int64)
        self.predictions = np.zeros(self.num_classes, np.int64)

    def add(self, predicted: OccupancyGrid, truth: OccupancyGrid, origins: Float[np.ndarray, "n 3"]) -> None:
        """Cast every ray from every origin, metres in the world, through both grids, which share their lattice."""
        rays = ray_directions()
        for origin in origins:
            label_t, distance_t = _exits(truth, origin, rays)
            label_p, distance_p = _exits(predicted, origin, rays)
            asked = label_t != self.free_label
            t, p, gap = label_t[asked], label_p[asked], np.abs(distance_t - distance_p)[asked]
            self.truths += np.bincount(t, minlength=self.num_classes)
            self.predictions += np.bincount(p, minlength=self.num_classes)
            for k, limit in enumerate(RAY_THRESHOLDS):
                self.hits[k] += np.bincount(t[(t == p) & (gap < limit)], minlength=self.num_classes)

    @property
    def value(self) -> float:
        """Mean over thresholds and classes but free; classes that are in neither are left out."""
        return float(np.nanmean([self.at(k) for k in range(len(RAY_THRESHOLDS))]))

    def at(self, threshold_index: int) -> float:
        """Return the mean over classes at one threshold."""
        hit = self.hits[threshold_index]
        union = self.truths + self.predictions - hit
        iou = np.where(union > 0, hit / np.maximum(union, 1), np.nan)
        keep = np.arange(self.num_classes) != self.free_label
        return float(np.nanmean(iou[keep])) if np.isfinite(iou[keep]).any() else math.nan


def _exits(
    grid: OccupancyGrid, origin: Float[np.ndarray, " 3"], rays: Float[np.ndarray, "n 3"]
) -> tuple[Int64[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the class that each ray of the grid's frame meets, free for none, and where it leaves it, metres."""
    reach = float(np.linalg.norm(grid.spec.size * grid.spec.shape)) + 1.0
    directions = rays @ grid.T_world_grid[:3, :3].T
    hits = cast_rays(grid, origin, directions, reach)
    found = hits.voxel >= 0
    labels = np.full(len(rays), grid.free_label, np.int64)
    labels[found] = grid.labels.ravel()[hits.voxel[found]]
    lower = np.asarray(grid.spec.origin) + grid.spec.unflat(np.maximum(hits.voxel, 0)) * grid.spec.size
    local = transform(invert(grid.T_world_grid), origin[None])
    with np.errstate(divide="ignore", invalid="ignore"):
        far = np.where(rays > 0, (lower + grid.spec.size - local) / rays, (lower - local) / rays)
    leave = np.where(rays == 0, np.inf, far).min(axis=1)
    return labels, np.where(found, leave, reach)
