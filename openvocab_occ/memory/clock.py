"""Times as records keep them."""

import math
import time

from openvocab_occ.errors import ConfigError

CLOCK_TOLERANCE = 300.0
"""Seconds; a stamp further ahead would keep later writes of everyone out until then."""


def ticks_of(stamp: float) -> int:
    """Return Unix seconds as records keep them: milliseconds plus 1.

    Raises:
        ConfigError: It is no time, before 1970, or further in the future than clocks differ.
    """
    latest = time.time() + CLOCK_TOLERANCE
    if not (math.isfinite(stamp) and 0 <= stamp <= latest):
        raise ConfigError(
            "stamp is not a time at which something was seen",
            expected=f"Unix seconds from 0 to {latest:.0f}, five minutes from now", got=stamp,
            fix="set the vehicle's clock",
        )  # fmt: skip
    return round(stamp * 1000) + 1


def fading_rate(half_life: float | None, now: float | None) -> tuple[float, float]:
    """Return now in ticks and the rate per tick, 0 for none."""
    if half_life is None:
        return 0.0, 0.0
    if not half_life > 0:
        raise ConfigError("half_life is not usable", expected="seconds above 0", got=half_life)
    return (time.time() if now is None else now) * 1000.0 + 1, math.log(2) / (half_life * 1000.0)
