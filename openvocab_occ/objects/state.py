"""States from observed motion: what moved, what stopped, what stood, and what nobody can tell.

A thing is seen in pieces: passing a parked bus shows its rear, its side, then its front, and the middle of what is seen
wanders by metres. So motion is not read off middles. Along each axis the lower and the upper bound of the seen part are
compared: a thing that moved moved both, a thing seen better moved one. The lesser of the two shifts, where their signs
agree, is the least motion that explains both sightings.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64

from openvocab_occ.errors import ConfigError

State = Literal["moving", "stopped", "parked", "fixed", "unknown"]
STATES: tuple[State, ...] = ("moving", "stopped", "parked", "fixed", "unknown")


@dataclass(frozen=True, kw_only=True)
class StateConfig:
    """When a thing counts as moved, and as parked."""

    extent: float = 3.0
    """Metres: a thing whose positions span less did not move (the `stationary` of RefAV)."""
    clear_extent: float = 1.0
    """Metres: a lesser span still counts as motion when it is a steady way at `speed` or more."""
    speed: float = 0.5
    """Metres a second below which a thing stands: the jitter of boxes that people draw."""
    left: float = 0.3
    """Least share of its places that other frames must have seen through before a thing counts as moved."""
    surely: float = 12.0
    """Metres: more than this no thing seen in pieces seems to move; what was seen through is not asked then."""
    min_time: float = 1.5
    """Seconds a thing must be observed before anything but motion is said of it."""
    recent: float = 1.2
    """Seconds at the end of the observation that tell moving from stopped."""
    position_sigma: float = 0.5
    """Voxels: standard deviation of a bound."""

    def __post_init__(self) -> None:
        for name in ("extent", "clear_extent", "speed", "left", "surely", "min_time", "recent", "position_sigma"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ConfigError(f"state option {name} is not usable", expected=">= 0", got=getattr(self, name))


@dataclass(frozen=True, kw_only=True)
class Motion:
    """What was seen of a thing's motion."""

    extent: float
    """Metres between the two sightings furthest apart, by their bounds."""
    sigma: float
    """Standard deviation of `extent` and of positions, metres."""
    speed: float
    """Metres a second over the last moments; 0 where that lies within the uncertainty."""
    velocity: Float64[np.ndarray, " 2"]
    """Metres a second along x and y of the world, over the last moments."""
    mean_speed: float
    """Metres a second between the two sightings furthest apart."""
    time_observed: float
    """Seconds from the first to the last sighting."""
    sightings: int
    """Frames it was seen in."""
    left: float = 1.0
    """Share of the voxels of its first and latest sighting that other frames saw through: what moved left its place,
    and its new place was empty before. 1 where nobody looked."""


def shift(
    low_a: Float64[np.ndarray, "*_ 2"],
    high_a: Float64[np.ndarray, "*_ 2"],
    low_b: Float64[np.ndarray, "*_ 2"],
    high_b: Float64[np.ndarray, "*_ 2"],
) -> Float64[np.ndarray, "*_ 2"]:
    """Return the least motion from bounds a to bounds b, metres along x and y; see the top of the file."""
    lower, upper = low_b - low_a, high_b - high_a
    least = np.where(np.abs(lower) < np.abs(upper), lower, upper)
    return np.where(lower * upper > 0, least, 0.0)


def observe_motion(
    times: Float64[np.ndarray, " n"],
    low: Float64[np.ndarray, "n 2"],
    high: Float64[np.ndarray, "n 2"],
    *,
    sightings: int,
    time_observed: float,
    voxel_size: float,
    config: StateConfig | None = None,
) -> Motion:
    """Sum up sightings in order of time: bounds along x and y in metres, of whole views of the thing.

    `sightings` and `time_observed` also count sightings whose bounds say nothing, such as at the edge of the grid.
    """
    config = config or StateConfig()
    sigma = config.position_sigma * voxel_size * 2**0.5
    if len(times) < 2:
        return Motion(extent=0.0, sigma=sigma, speed=0.0, velocity=np.zeros(2), mean_speed=0.0,
                      time_observed=time_observed, sightings=sightings)  # fmt: skip
    way = shift(low[:, None], high[:, None], low[None], high[None])  # from, to
    distance = np.linalg.norm(way, axis=2)
    a, b = np.unravel_index(int(distance.argmax()), distance.shape)
    between = abs(float(times[a] - times[b]))
    end = len(times) - 1
    start = min(int(np.searchsorted(times, times[-1] - config.recent - 1e-6)), end - 1)
    lasted = max(float(times[-1] - times[start]), 1e-6)
    velocity = way[start, end] / lasted
    moved = float(np.linalg.norm(way[start, end]))
    return Motion(
        extent=float(distance[a, b]),
        sigma=sigma,
        speed=moved / lasted if moved > 2 * sigma else 0.0,
        velocity=velocity if moved > 2 * sigma else np.zeros(2),
        mean_speed=float(distance[a, b]) / between if between > 0 else 0.0,
        time_observed=time_observed,
        sightings=sightings,
    )


def judge(
    motion: Motion, *, movable: float, longest: float | None = None, config: StateConfig | None = None
) -> tuple[State, float, str]:
    """Return the state, how sure it is (0 to 1, not a probability), and what speaks for it.

    Args:
        motion: What was seen of it.
        movable: The share of the class evidence that speaks for a thing that can move: NaN where there is none.
        longest: Metres, of the longest thing of its kind: seen in pieces, none seems to move further than that. None
            where its kind tells no length.
        config: When a thing counts as moved, and as parked.
    """
    config = config or StateConfig()
    seen = f"{motion.sightings} sightings in {motion.time_observed:.1f} s"
    if motion.sightings < 2:
        return "unknown", 0.0, "seen once"
    fixed = movable < 0.5  # false for NaN
    span = f"moved {motion.extent:.1f} +- {motion.sigma:.1f} m"
    far = motion.extent >= config.extent
    clear = motion.extent >= max(config.clear_extent, 3 * motion.sigma) and motion.mean_speed >= config.speed
    surely = config.surely if longest is None else min(config.surely, longest + 3 * motion.sigma)
    gone = motion.left >= config.left or motion.extent >= surely
    if (far or clear) and gone and not fixed:
        sure = 1 - float(np.exp(-motion.extent / max(3 * motion.sigma, 1e-9)))
        state = "moving" if motion.speed >= config.speed else "stopped"
        return state, sure, f"{span}, last at {motion.speed:.1f} m/s; {seen}"
    if motion.time_observed < config.min_time:
        return "unknown", 0.0, f"{span}, not observed for {config.min_time:g} s; {seen}"
    sure = 1 - float(np.exp(-motion.time_observed / config.min_time))
    if np.isnan(movable):
        return "unknown", 0.0, f"{span}, of a kind that nothing names; {seen}"
    if fixed:
        return "fixed", sure * (1 - movable), f"of a kind that does not move; {seen}"
    return "parked", sure * movable, f"{span}, less than {config.extent:g} m; {seen}"
