"""A camera's picture of the city, and the truth of every pixel."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Float32, Int32, UInt8

from openvocab_occ._jit import in_slices
from openvocab_occ.datasets.city import _shade_kernels as kernels
from openvocab_occ.datasets.city.scene import Hits, Moment, Triangles
from openvocab_occ.datasets.city.surfaces import SKY, Material
from openvocab_occ.datasets.city.weather import Condition, develop, finish, tone_curve
from openvocab_occ.geometry import Camera

_WET = (Material.ASPHALT, Material.MARKING, Material.PAVING)
_OFFSETS = np.array([(-0.33, 0.25), (0.33, -0.25)])  # of the extra samples on edges, pixels


@dataclass(frozen=True, eq=False)
class Rendering:
    """What a camera sees."""

    image: UInt8[np.ndarray, "h w 3"]
    """RGB."""
    depth: Float32[np.ndarray, "h w"]
    """True z-depth in metres, 0 for the sky."""
    semantic: UInt8[np.ndarray, "h w"]
    """Occ3D class, 255 for the sky."""
    instance: Int32[np.ndarray, "h w"]
    """Number of the thing, 0 for the sky."""
    part: UInt8[np.ndarray, "h w"]
    """Part of the thing (`PART_NAMES`), 255 for the sky."""


@dataclass(frozen=True, eq=False)
class Lighting:
    """All that colours depend on besides the triangles. Coordinates are those of the triangles."""

    condition: Condition
    light: Float[np.ndarray, " n"]
    lamps: Float[np.ndarray, "lamps 11"]
    ground: Float32[np.ndarray, "x y"]
    """How much stands on each cell of the ground, 0 to 1."""
    origin: Float[np.ndarray, " 2"]
    """Lower corner of that map."""
    cell: float
    anchor: Float[np.ndarray, " 2"]
    """World coordinates of the origin of the triangles."""


def render(
    triangles: Triangles, moment: Moment, camera: Camera, lighting: Lighting, *, rng: np.random.Generator,
    smooth: bool = True,
) -> Rendering:  # fmt: skip
    """Take a picture.

    Args:
        triangles: Still and moving ones.
        moment: Casts rays at them.
        camera: Its pose is in the coordinates of the triangles.
        lighting: Weather and lamps.
        rng: Of the sensor.
        smooth: Take two more samples where a pixel borders on another surface.
    """
    shape = (camera.height, camera.width)
    rays = _camera_rays(camera)
    hits = moment.cast(rays)
    painter = _Painter(triangles, moment, lighting, camera.K[0, 0])
    image = painter.picture(rays, hits)
    seen = np.isfinite(hits.t)
    semantic = np.where(seen, triangles.label[hits.face], np.uint8(SKY)).reshape(shape)
    part = np.where(seen, triangles.part[hits.face], np.uint8(SKY)).reshape(shape)
    instance = np.where(seen, triangles.instance[hits.face], np.int32(0)).reshape(shape)
    depth = np.where(seen, hits.t, np.float32(0)).reshape(shape)
    if smooth:
        material = np.where(seen, triangles.material[hits.face], np.uint8(SKY)).reshape(shape)
        edge = np.flatnonzero(_edges(instance, part, material, hits.normal.reshape(*shape, 3)))
        image = _smoothed(painter, camera, rays, edge, image)
    finished = finish(image.reshape(*shape, 3), lighting.condition, rng)
    return Rendering(finished, depth, semantic, instance, part)


def _camera_rays(camera: Camera) -> Float32[np.ndarray, "n 6"]:
    """Return origins and directions with z = 1 in the camera, so that the length along them is the z-depth."""
    directions = _pixel_directions(camera.K.tobytes(), camera.width, camera.height) @ camera.T_world_cam[
        :3, :3
    ].T.astype(np.float32)
    rays = np.empty((len(directions), 6), dtype=np.float32)
    rays[:, :3], rays[:, 3:] = camera.position, directions
    return rays


@lru_cache(maxsize=16)
def _pixel_directions(K: bytes, width: int, height: int) -> Float32[np.ndarray, "n 3"]:
    camera = Camera(np.frombuffer(K).reshape(3, 3), width, height)
    return camera.rays().reshape(-1, 3).astype(np.float32)


def _edges(instance: np.ndarray, part: np.ndarray, material: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Tell which pixels border on another surface, bool[h w]."""
    key = instance.astype(np.int64) * 65536 + part.astype(np.int64) * 256 + material
    edge = np.zeros(key.shape, dtype=np.bool_)
    for a, b in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        differ = (key[a] != key[b]) | (np.einsum("ijk,ijk->ij", normal[a], normal[b]) < 0.85)
        edge[a] |= differ
        edge[b] |= differ
    return edge


def _smoothed(painter: "_Painter", camera: Camera, rays: np.ndarray, edge: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Average pixels on edges with more samples of them."""
    if not len(edge):
        return image
    right, down = (camera.T_world_cam[:3, i] / camera.K[i, i] for i in (0, 1))
    more = np.repeat(rays[edge][None], len(_OFFSETS), axis=0)
    for sample, (u, v) in zip(more, _OFFSETS, strict=True):
        sample[:, 3:] += (u * right + v * down).astype(np.float32)
    more = more.reshape(-1, 6)
    extra = painter.picture(more, painter.moment.cast(more)).reshape(len(_OFFSETS), -1, 3)
    total = extra.sum(axis=0, dtype=np.uint16) + image[edge]
    image[edge] = ((total + (len(_OFFSETS) + 1) // 2) // (len(_OFFSETS) + 1)).astype(np.uint8)
    return image


class _Painter:
    """Colours rays of one scene."""

    def __init__(self, triangles: Triangles, moment: Moment, lighting: Lighting, focal: float) -> None:
        self._triangles, self.moment, self._lighting, self._focal = triangles, moment, lighting, float(focal)
        self._curve = tone_curve(lighting.condition.exposure)

    def picture(self, rays: np.ndarray, hits: Hits) -> UInt8[np.ndarray, "n 3"]:
        """Return grey levels of rays."""
        linear = self._linear(rays, hits)
        if self._lighting.condition.wet == 1.0:
            self._mirror(rays, hits, linear)
        return develop(linear, self._curve)

    def _linear(self, rays: np.ndarray, hits: Hits, *, shadows: bool = True) -> Float32[np.ndarray, "n 3"]:
        lit = self._sunlit(rays, hits) if shadows and self._lighting.light[kernels.SUN_COLOR] > 0.1 else None
        lit = np.ones(len(rays), np.uint8) if lit is None else lit
        out = np.empty((len(rays), 3), np.float32)
        a, w = self._triangles, self._lighting
        in_slices(
            lambda start, stop: kernels.shade(
                rays, hits.t, hits.face, hits.corners, hits.normal, lit, a.uv, a.color, a.material, a.instance,
                w.ground, w.origin, w.cell, w.anchor, w.light, w.lamps, self._focal, start, stop, out,
            ),
            len(rays), grain=4096,
        )  # fmt: skip
        return out

    def _sunlit(self, rays: np.ndarray, hits: Hits) -> UInt8[np.ndarray, " n"]:
        towards, needed = np.empty_like(rays), np.empty(len(rays), np.uint8)
        sun = self._lighting.light[kernels.SUN : kernels.SUN + 3].astype(np.float32)
        material = self._triangles.material
        in_slices(
            lambda start, stop: kernels.sun_rays(
                rays, hits.t, hits.face, hits.normal, material, sun, start, stop, towards, needed
            ),
            len(rays), grain=16384,
        )  # fmt: skip
        some = np.flatnonzero(needed)
        lit = np.ones(len(rays), np.uint8)
        lit[some] = ~self.moment.blocked(towards[some])
        return lit

    def _mirror(self, rays: np.ndarray, hits: Hits, linear: np.ndarray) -> None:
        """Blend in what wet ground reflects, by Fresnel and a map of puddles; changes `linear`."""
        material = self._triangles.material[hits.face]
        some = np.flatnonzero(np.isfinite(hits.t) & np.isin(material, _WET) & (np.abs(hits.normal[:, 2]) > 0.9))
        if not len(some):
            return
        out = rays[some]
        out[:, :3] += out[:, 3:] * hits.t[some, None]
        x, y = (out[:, i] + self._lighting.anchor[i] for i in (0, 1))
        out[:, 2] += 0.02
        d = out[:, 3:] / np.linalg.norm(out[:, 3:], axis=1, keepdims=True)
        ripple = np.stack([np.sin(x * 9 + 3 * np.sin(y * 7)), np.sin(y * 11 + 2 * np.sin(x * 8))], axis=1)
        out[:, 3:] = d * np.array([1, 1, -1], np.float32)
        out[:, 3:5] += np.float32(0.012) * ripple
        seen = self._linear(out, self.moment.cast(out), shadows=False)
        puddle = np.clip(
            0.5 + 1.2 * np.sin(x * 0.31 + 2 * np.sin(y * 0.5)) * np.sin(y * 0.83 + 1.5 * np.sin(x * 0.21)), 0.25, 1
        )
        share = ((0.05 + 0.85 * (1 + np.clip(d[:, 2], -1, 0)) ** 4) * puddle)[:, None].astype(np.float32)
        linear[some] = linear[some] * (1 - share) + seen * share
