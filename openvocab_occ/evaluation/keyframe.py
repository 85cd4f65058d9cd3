"""How well depth and answers of one real frame agree with its own LiDAR, without any label.

Two questions. Does depth rendered from a grid made of some returns predict the others? And do the returns that fall
under road pixels lie in voxels that answer "road", more often than the returns under other pixels do? A map built with
mirrored camera poses is the control: whatever it also scores is not owed to right geometry.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32

from openvocab_occ.datasets.frame import Frame, FrameSequence
from openvocab_occ.depth.render import render_depth
from openvocab_occ.errors import ConfigError, DataError
from openvocab_occ.geometry import invert, transform
from openvocab_occ.mapping import keys_of
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.occupancy import OccupancyGrid
from openvocab_occ.pipeline.build import build_map, grid_from_frame
from openvocab_occ.query.find import score_voxels
from openvocab_occ.query.words import match_names
from openvocab_occ.segmentation.encoder import FeatureMap, PixelEncoder


@dataclass(frozen=True)
class DepthAgreement:
    """How far rendered depth lies from the z-depth of returns that the grid has not seen."""

    points: int
    """Held-out returns inside the grid and on an image, counted once a view."""
    hit: float
    """Share of them whose pixel has depth."""
    median_m: float
    """Median of |rendered - measured| where there is depth, metres."""
    p90_m: float
    """Its 90th percentile."""
    bias_m: float
    """Median of rendered - measured: below 0 when depth is read too short."""


@dataclass(frozen=True)
class WordAgreement:
    """Of the returns that a word's pixels cover, and of the others: the share that lies in voxels answering it."""

    word: str
    points_under: int
    share_under: float
    points_elsewhere: int
    share_elsewhere: float

    @property
    def gap(self) -> float:
        """How much more often the word is answered where the image shows it."""
        return self.share_under - self.share_elsewhere


@dataclass(frozen=True)
class KeyframeReport:
    """Both agreements, and the control."""

    depth: DepthAgreement
    words: WordAgreement
    control: WordAgreement
    """The same question to a map built with mirrored camera poses, judged with the true ones."""


def judge_keyframe(
    frame: Frame, encoder: PixelEncoder, word: str, *, held_out: float = 0.2, seed: int = 0
) -> KeyframeReport:
    """Judge one frame that has LiDAR returns.

    Args:
        frame: With `points` and at least one view.
        encoder: A *logits* model that knows `word`.
        word: What to ask for, such as "road".
        held_out: Share of the returns that the depth grid does not see.
        seed: Chooses them.
    """
    if frame.points is None or not frame.views:
        raise DataError(
            f"frame {frame.index} cannot be judged",
            expected="LiDAR points and views",
            got=f"{0 if frame.points is None else len(frame.points)} points, {len(frame.views)} views",
        )
    if encoder.contract != "logits":
        raise ConfigError(
            "the word test needs a model with label names", expected="a logits model", got=encoder.contract
        )
    scene = build_map(FrameSequence("true", [0], lambda _: frame), encoder)
    mirrored = build_map(FrameSequence("mirrored", [0], lambda _: mirror_cameras(frame)), encoder)
    return KeyframeReport(
        depth=held_out_depth(frame, held_out=held_out, seed=seed),
        words=word_agreement(frame, scene, encoder, word),
        control=word_agreement(frame, mirrored, encoder, word),
    )


def held_out_depth(frame: Frame, *, held_out: float = 0.2, seed: int = 0) -> DepthAgreement:
    """Make a grid of some of the returns and compare its depth, at each other return's pixel, with that return's."""
    assert frame.points is not None
    test = np.random.default_rng(seed).random(len(frame.points)) < held_out
    grid = grid_from_frame(replace(frame, points=frame.points[~test], occupancy=None))
    points = _inside(transform(frame.T_world_ego, frame.points[test]), grid)
    errors: list[np.ndarray] = []
    asked = 0
    for image, view in zip(render_depth(grid, [v.camera for v in frame.views]), frame.views, strict=True):
        pixels, depth = view.camera.project(points)
        seen = view.camera.inside(pixels)
        u, v = np.rint(pixels[seen]).astype(int).T
        hit = image.voxel[v, u] >= 0
        asked += len(hit)
        errors.append((image.depth[v, u] - depth[seen])[hit])
    error = np.concatenate(errors)
    if not len(error):
        raise DataError(
            "no held-out return falls on a pixel with depth",
            got=f"{asked} returns on images",
            fix="check the extrinsics of the cameras",
        )
    return DepthAgreement(
        points=asked, hit=len(error) / asked, median_m=float(np.median(np.abs(error))),
        p90_m=float(np.percentile(np.abs(error), 90)), bias_m=float(np.median(error)),
    )  # fmt: skip


def word_agreement(frame: Frame, scene: SceneMap, encoder: PixelEncoder, word: str) -> WordAgreement:
    """Count returns in voxels that answer `word`, apart for those the word's pixels cover and those they do not."""
    assert frame.points is not None
    world = _inside(transform(frame.T_world_ego, frame.points), grid_from_frame(frame))
    scores = score_voxels(scene, word)
    position = scene.voxels.index(keys_of(world, scene.voxels.voxel_size))
    answers = (position >= 0) & (scores[position] >= 0.5)
    channels = _channels(scene, word)
    under: list[np.ndarray] = []
    elsewhere: list[np.ndarray] = []
    for view, features in zip(frame.views, encoder.encode([v.image for v in frame.views]), strict=True):
        pixels, _ = view.camera.project(world)
        seen = view.camera.inside(pixels)
        says = _probability(features, pixels[seen].astype(np.float32), channels) >= 0.5
        under.append(answers[seen][says])
        elsewhere.append(answers[seen][~says])
    yes, no = np.concatenate(under), np.concatenate(elsewhere)
    return WordAgreement(
        word, len(yes), float(yes.mean()) if len(yes) else 0.0, len(no), float(no.mean()) if len(no) else 0.0
    )


def mirror_cameras(frame: Frame) -> Frame:
    """Return the frame with its cameras reflected about the ego's x axis: a calibration that is wrong but rigid."""
    flip_ego, flip_cam = np.diag([1.0, -1.0, 1.0, 1.0]), np.diag([-1.0, 1.0, 1.0, 1.0])
    T_ego_world = invert(frame.T_world_ego)

    def mirrored(T_world_cam: np.ndarray) -> np.ndarray:
        return frame.T_world_ego @ flip_ego @ T_ego_world @ T_world_cam @ flip_cam

    views = tuple(replace(v, camera=v.camera.at(mirrored(v.camera.T_world_cam))) for v in frame.views)
    return replace(frame, views=views)


def _inside(points: Float[np.ndarray, "n 3"], grid: OccupancyGrid) -> Float[np.ndarray, "m 3"]:
    """Keep the points of the world that lie in the grid."""
    return points[grid.spec.contains(grid.spec.index(transform(invert(grid.T_world_grid), points)))]


def _channels(scene: SceneMap, word: str) -> Bool[np.ndarray, " c"]:
    """Tell which labels of a logits map answer the word."""
    channels = np.zeros(len(scene.encoder.labels), dtype=bool)
    channels[list(match_names(word, scene.encoder.labels).labels)] = True
    if not channels.any():
        raise ConfigError("the model has no label for the word", expected=", ".join(scene.encoder.labels), got=word)
    return channels


def _probability(
    features: FeatureMap, pixels: Float32[np.ndarray, "n 2"], channels: Bool[np.ndarray, " c"]
) -> Float32[np.ndarray, " n"]:
    """Return the probability mass of the channels at pixels, from the nearest cell."""
    height, width = features.cells.shape[:2]
    u = np.clip(np.rint(pixels[:, 0] * features.scale[0] + features.offset[0]).astype(int), 0, width - 1)
    v = np.clip(np.rint(pixels[:, 1] * features.scale[1] + features.offset[1]).astype(int), 0, height - 1)
    return features.cells[v, u][:, channels].sum(axis=1)
