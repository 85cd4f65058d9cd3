"""What the colours of the voxels say, and the legend that says so."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32, UInt8

from openvocab_occ.errors import ConfigError
from openvocab_occ.export.palette import UNLABELLED, grey, label_colors, paint_labels, paint_numbers
from openvocab_occ.export.render import owners
from openvocab_occ.export.semantics import name_voxels
from openvocab_occ.mapping.voxel_map import VoxelMap
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.viewer.markup import escape, ramp, swatches

ColorMode = Literal["rgb", "semantic", "instance", "relevance", "height", "age", "uncertainty", "occupancy"]
COLOR_MODES: tuple[str, ...] = get_args(ColorMode)
_WALL_SHADE = 0.82
_LEGEND_ROWS = 14
_STOPS = 9  # colours by which a legend's bar is drawn
_CYCLE = np.array(  # Okabe and Ito 2008: told apart by colour-blind eyes; black and grey are for other things
    [(0, 114, 178), (230, 159, 0), (0, 158, 115), (213, 94, 0), (86, 180, 233), (204, 121, 167), (240, 228, 66)],
    dtype=np.float64,
)


@dataclass(frozen=True, eq=False)
class Painted:
    """Colours of all voxels, and what they mean."""

    colors: UInt8[np.ndarray, "n 3"]
    legend: str
    """HTML."""


def paint_voxels(
    scene: SceneMap, mode: str, scores: Float32[np.ndarray, " n"] | None = None, *, stretched: bool = False
) -> Painted:
    """Colour the voxels of a map.

    `rgb` is the mean colour that cameras saw, `semantic` that of the label, `instance` one for each object, `relevance`
    the score of a query from 0 to 1 or, `stretched`, from the least to the greatest; `height` runs from the 1st to the
    99th percentile, `age` back from the latest sighting, `uncertainty` from what all views agree on to what none does,
    `occupancy` is the probability of being occupied by the hits and misses of all frames.

    Raises:
        ConfigError: The mode is not known, or `relevance` without scores.
    """
    voxels = scene.voxels
    match mode:
        case "rgb":
            return Painted(voxels.colors, "Mean colour that the cameras saw; black where none did.")
        case "semantic":
            semantics = name_voxels(scene)
            colors = shade_walls(voxels, paint_labels(semantics.labels, semantics.names))
            return Painted(colors, _label_legend(semantics.labels, semantics.names))
        case "instance":
            return _instances(scene)
        case "relevance":
            if scores is None:
                raise ConfigError("relevance needs a query", expected="a score for each voxel")
            return _relevance(voxels, scores, stretched=stretched)
        case "height":
            z = voxels.centers[:, 2]
            low, high = np.percentile(z, (1, 99)) if len(z) else (0.0, 1.0)
            return _numbers(z, (float(low), float(high)), "viridis", "height, m", ".1f")
        case "age":
            age = voxels.last_seen.max(initial=0.0) - voxels.last_seen
            return _numbers(age, (0.0, max(float(age.max(initial=0.0)), 1e-9)), "cividis", "last seen, s ago", ".1f")
        case "uncertainty":
            return _numbers(uncertainty(voxels), (0.0, 1.0), "cividis", _UNCERTAINTY[voxels.contract], ".1f")
        case "occupancy":
            p = 1 / (1 + np.exp(-voxels.log_odds))
            return _numbers(p, (0.5, 1.0), "cividis", "probability of being occupied", ".2f")
    raise ConfigError("colour mode is not known", expected=" or ".join(COLOR_MODES), got=mode)


_UNCERTAINTY = {"logits": "1 - probability of the best label", "dense": "1 - agreement of the views"}


def uncertainty(voxels: VoxelMap) -> Float64[np.ndarray, " n"]:
    """Return how unsure each voxel is, 0 to 1: of its label, or by how far the views disagree."""
    sure = voxels.features.max(axis=1, initial=0.0) if voxels.contract == "logits" else voxels.agreement
    return 1.0 - np.clip(sure.astype(np.float64), 0.0, 1.0)


def object_colors(ids: Int32[np.ndarray, " n"]) -> UInt8[np.ndarray, "n 3"]:
    """Return the colour of each object id; seven hues, and shades of them further on."""
    ids = np.asarray(ids, np.int64)
    shade = 1.0 - 0.18 * (ids // len(_CYCLE) % 4)
    colors = (_CYCLE[ids % len(_CYCLE)] * shade[:, None]).astype(np.uint8)
    colors[ids <= 0] = UNLABELLED
    return colors


def shade_walls(voxels: VoxelMap, colors: UInt8[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n 3"]:
    """Darken voxels that have another above them, so that flat colours still show shapes."""
    covered = voxels.index(voxels.keys + np.array([0, 0, 1], np.int32)) >= 0
    return np.where(covered[:, None], (colors * _WALL_SHADE).astype(np.uint8), colors)


def grey_but(
    voxels: VoxelMap, colors: UInt8[np.ndarray, "n 3"], kept: Bool[np.ndarray, " n"]
) -> UInt8[np.ndarray, "n 3"]:
    """Return the colours with every voxel greyed that is not kept."""
    return np.where(kept[:, None], colors, shade_walls(voxels, grey(colors)))


def score_range(scores: Float32[np.ndarray, " n"]) -> tuple[float, float]:
    """Return the least and the greatest finite score."""
    finite = scores[np.isfinite(scores)]
    return (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)


def _relevance(voxels: VoxelMap, scores: Float32[np.ndarray, " n"], *, stretched: bool) -> Painted:
    low, high = score_range(scores) if stretched else (0.0, 1.0)
    level = (scores.astype(np.float64) - low) / max(high - low, 1e-12)
    weight = np.clip(3 * level, 0, 1)[:, None]  # grey below, pure from a third on
    heat = paint_numbers(scores.astype(np.float64), low, high, "plasma")
    ground = shade_walls(voxels, grey(voxels.colors))
    colors = (weight * heat + (1 - weight) * ground).astype(np.uint8)
    scale = "stretched to this query" if stretched else "fixed scale"
    stops = np.linspace(0, 1, _STOPS)[:, None]
    bar = paint_numbers(stops[:, 0], 0.0, 1.0, "plasma") * np.clip(3 * stops, 0, 1)
    bar = bar + (1 - np.clip(3 * stops, 0, 1)) * 150
    return Painted(colors, ramp(bar, _ends(low, high, ".2f"), f"score, {scale}"))


def _instances(scene: SceneMap) -> Painted:
    owner = owners(scene)
    colors = shade_walls(scene.voxels, object_colors(owner))
    share = float((owner > 0).mean()) if len(owner) else 0.0
    words = f"{len(scene.objects)} objects, a colour each that may repeat; click one for its number."
    return Painted(colors, f"{escape(words)} {swatches([(UNLABELLED, 'in no object', f'{1 - share:.0%}')])}")


def _numbers(values: Float[np.ndarray, " n"], span: tuple[float, float], scale: str, title: str, form: str) -> Painted:
    bar = paint_numbers(np.linspace(0, 1, _STOPS), 0.0, 1.0, scale)
    return Painted(paint_numbers(values, *span, scale), ramp(bar, _ends(*span, form), title))


def _ends(low: float, high: float, form: str) -> tuple[str, str, str]:
    return format(low, form), format((low + high) / 2, form), format(high, form)


def _label_legend(labels: Int32[np.ndarray, " n"], names: tuple[str, ...]) -> str:
    counts = np.bincount(labels[labels >= 0], minlength=len(names))
    colors = label_colors(names)
    order = [int(i) for i in np.argsort(-counts, kind="stable") if counts[i]]
    entries = [(colors[i].tolist(), names[i], f"{counts[i] / len(labels):.1%}") for i in order[:_LEGEND_ROWS]]
    rest = int((labels < 0).sum())
    if rest:
        entries.append((UNLABELLED, "no label", f"{rest / len(labels):.1%}"))
    more = len(order) - _LEGEND_ROWS
    return swatches(entries) + (f"and {more} more" if more > 0 else "")
