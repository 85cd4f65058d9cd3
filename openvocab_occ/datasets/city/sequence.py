"""The city as a kind of drive."""

from functools import lru_cache

from openvocab_occ.datasets.city.city import City
from openvocab_occ.datasets.city.keyframes import frame
from openvocab_occ.datasets.city.traversal import MAX_FRAMES
from openvocab_occ.datasets.frame import FrameSequence
from openvocab_occ.errors import ConfigError
from openvocab_occ.io.files import PathLike


@lru_cache(maxsize=2)
def _city(seed: int) -> City:
    return City(seed)


def load_city(
    root: PathLike | None = None, *, scene: str | None = None, seed: int = 0, route: int = 0, traversal: int = 0,
    condition: str = "clear", frames: int = MAX_FRAMES, size: tuple[int, int] = (704, 256), quick: bool = False,
) -> FrameSequence:  # fmt: skip
    """Drive through the demo city, two frames a second; see `City.traversal`. Frames are rendered when asked for.

    `quick` frames, for training small models, have no masks, no LiDAR and no smooth edges; see `keyframes.frame`.

    Raises:
        ConfigError: A root or a scene is given, a number is out of range, or the condition is not known.
    """
    if root is not None or scene is not None:
        raise ConfigError("city is made up from a seed", expected="no root and no scene", got=root or scene)
    if not 1 <= frames <= MAX_FRAMES:
        raise ConfigError("a traversal is too short", expected=f"1 to {MAX_FRAMES} frames", got=frames)
    if len(size) != 2 or min(size) < 8:
        raise ConfigError("image size is not usable", expected="width and height of at least 8", got=size)
    drive = _city(seed).traversal(route, traversal, condition)
    width, height = size
    return FrameSequence(
        drive.name,
        range(frames),
        lambda index: frame(drive, index, size=(width, height), quick=quick),
        source="city",
        synthetic=True,
    )
