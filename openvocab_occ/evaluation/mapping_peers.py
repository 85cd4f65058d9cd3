"""Other ways to do what mapping does, to be timed beside it: dense lifts in torch, and objects kept as point clouds."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Float32, Int32

from openvocab_occ.geometry import Camera, transform

_CHUNK = 1 << 14  # pixels at once


def upsample_and_scatter(
    cells: Float32[np.ndarray, "a b c"], rows: Int32[np.ndarray, "h w"], num_rows: int
) -> Float32[np.ndarray, "m c"]:
    """Lift as peers do: bilinear upsampling to the image, gather the pixels that see something, index_add."""
    import torch

    maps = torch.from_numpy(cells).permute(2, 0, 1)[None].contiguous()
    dense = torch.nn.functional.interpolate(maps, size=rows.shape, mode="bilinear", align_corners=False)[0]
    seen = torch.from_numpy(rows >= 0)
    pixels = dense.permute(1, 2, 0)[seen]
    sums = torch.zeros((num_rows, cells.shape[2]))
    sums.index_add_(0, torch.from_numpy(rows.astype(np.int64))[seen], pixels)
    return sums.numpy()


def gather_valid(
    cells: Float32[np.ndarray, "a b c"], rows: Int32[np.ndarray, "h w"], num_rows: int
) -> Float32[np.ndarray, "m c"]:
    """Lift densely, laid out well: channels last, only pixels that see something, in chunks that fit the cache."""
    import torch

    a, b, c = cells.shape
    h, w = rows.shape
    v, u = np.nonzero(rows >= 0)
    x, y = np.clip((u + 0.5) * b / w - 0.5, 0, b - 1), np.clip((v + 0.5) * a / h - 0.5, 0, a - 1)
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = (x - left).astype(np.float32), (y - top).astype(np.float32)
    right, below = np.minimum(left + 1, b - 1), np.minimum(top + 1, a - 1)
    flat = torch.from_numpy(np.ascontiguousarray(cells)).reshape(-1, c)
    corners = [top * b + left, top * b + right, below * b + left, below * b + right]
    weights = [(1 - fy) * (1 - fx), (1 - fy) * fx, fy * (1 - fx), fy * fx]
    row = torch.from_numpy(rows[v, u].astype(np.int64))
    sums = torch.zeros((num_rows, c))
    for start in range(0, len(u), _CHUNK):
        part = slice(start, start + _CHUNK)
        pixels = torch.zeros((len(u[part]), c))
        for at, weight in zip(corners, weights, strict=True):
            pixels.addcmul_(flat[torch.from_numpy(at[part])], torch.from_numpy(weight[part])[:, None])
        sums.index_add_(0, row[part], pixels)
    return sums.numpy()


@dataclass
class ObjectClouds:
    """A plain mapper of the kind ConceptGraphs is: an object is a cloud and a feature, matched to each frame's masks.

    Each frame: points of every mask, one a voxel, the largest DBSCAN cluster of them; overlap with each object whose
    box it meets (share of points with a neighbour within a voxel, by a KD-tree); greedy merge where overlap + cosine
    passes.
    """

    voxel_size: float = 0.025
    eps: float = 0.1
    min_points: int = 10
    threshold: float = 1.2
    objects: list[tuple[np.ndarray, np.ndarray, int]] = field(default_factory=list)
    """Points, unit feature, detections of each object."""

    def integrate(
        self,
        depth: Float32[np.ndarray, "h w"],
        ids: Int32[np.ndarray, "h w"],
        features: Float32[np.ndarray, "k c"],
        camera: Camera,
    ) -> None:
        """Add one frame."""
        rays = camera.rays()
        for mask in range(len(features)):
            chosen = (ids == mask) & (depth > 0)
            points = transform(camera.T_world_cam, rays[chosen] * depth[chosen, None].astype(np.float64))
            points = self._cleaned(points)
            if len(points) >= 16:
                self._place(points, features[mask])

    def _thin(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
        import open3d as o3d

        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        return np.asarray(cloud.voxel_down_sample(self.voxel_size).points)

    def _cleaned(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
        """Return one point a voxel, of the largest cluster."""
        import open3d as o3d

        if len(points) < 25:
            return points[:0]
        points = self._thin(points)
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        label = np.asarray(cloud.cluster_dbscan(self.eps, self.min_points))
        if label.max(initial=-1) < 0:
            return points
        return points[label == np.bincount(label[label >= 0]).argmax()]

    def _place(self, points: Float[np.ndarray, "n 3"], feature: Float32[np.ndarray, " c"]) -> None:
        from scipy.spatial import KDTree

        low, high = points.min(axis=0), points.max(axis=0)
        best, at = self.threshold, -1
        for number, (cloud, known, _) in enumerate(self.objects):
            if (cloud.min(axis=0) > high).any() or (cloud.max(axis=0) < low).any():
                continue
            near, _ = KDTree(cloud).query(points, distance_upper_bound=self.voxel_size)
            score = float(np.isfinite(near).mean() + feature @ known)
            if score > best:
                best, at = score, number
        if at < 0:
            self.objects.append((points, feature, 1))
            return
        cloud, known, count = self.objects[at]
        mean = known * count + feature
        self.objects[at] = (self._thin(np.concatenate([cloud, points])), mean / np.linalg.norm(mean), count + 1)
