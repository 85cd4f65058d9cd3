"""The city: a town of a seed, and its traversals."""

from functools import cached_property

from openvocab_occ.datasets.city.render import Rendering
from openvocab_occ.datasets.city.town import Town, build_town
from openvocab_occ.datasets.city.traversal import Attributes as Attributes
from openvocab_occ.datasets.city.traversal import Traversal
from openvocab_occ.datasets.city.weather import CONDITIONS
from openvocab_occ.errors import ConfigError
from openvocab_occ.geometry import Camera


class City:
    """A town drawn from a seed, and the drives through it. It is built when first needed, in about two seconds."""

    def __init__(self, seed: int = 0) -> None:
        if seed < 0:
            raise ConfigError("a city's seed is not usable", expected="0 or more", got=seed)
        self.seed = seed
        self._traversals: dict[tuple[int, int, str], Traversal] = {}

    @cached_property
    def town(self) -> Town:
        """Streets, lanes, and all that stands still."""
        return build_town(self.seed)

    def traversal(self, route: int = 0, number: int = 0, condition: str = "clear") -> Traversal:
        """Return a drive along a route.

        Args:
            route: Any number; each begins elsewhere. Route 0 leads along Main Street.
            number: Of the traversal. Between traversals parked vehicles come and go, and houses and fences are built
                or torn down.
            condition: One of `CONDITIONS`. Traffic differs between conditions, all else is the same.

        Raises:
            ConfigError: A number is negative, or the condition is not known.
        """
        if condition not in CONDITIONS:
            raise ConfigError("condition is not known", expected=" or ".join(CONDITIONS), got=repr(condition))
        if route < 0 or number < 0:
            raise ConfigError("route or traversal is not usable", expected="0 or more", got=(route, number))
        key = (route, number, condition)
        if key not in self._traversals:
            self._traversals[key] = Traversal(self.town, route, number, condition)
        return self._traversals[key]

    def render(
        self, camera: Camera, time: float, condition: str = "clear", *, route: int = 0, traversal: int = 0,
        smooth: bool = True,
    ) -> Rendering:  # fmt: skip
        """Take a picture with a camera anywhere in the world, so many seconds into a traversal."""
        return self.traversal(route, traversal, condition).render(camera, float(time), smooth=smooth)
