"""What a check says."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

Level = Literal["ok", "note", "warning", "error"]
LEVELS: tuple[Level, ...] = get_args(Level)
"""From good to bad. A note is worth knowing, a warning is likely wrong, an error surely spoils a map."""


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at."""

    level: Level
    check: str
    """Name of the check, such as `poses`."""
    what: str
    """What was found, with numbers."""
    why: str = ""
    """How one can tell, or why it matters."""
    advice: str = ""
    """What to try."""

    def to_dict(self) -> dict[str, str]:
        """Return it for JSON."""
        return {"level": self.level, "check": self.check, "what": self.what, "why": self.why, "try": self.advice}


def worst(findings: Sequence[Finding]) -> Level:
    """Return the worst level of all, `ok` where there is nothing."""
    return LEVELS[max((LEVELS.index(finding.level) for finding in findings), default=0)]


def best_other(shares: Mapping[str, float], given: str, *, gain: float, least: float) -> str | None:
    """Return the explanation that fits the data clearly better than the given one, or None.

    Clearly: by at least `least` in share, and by the factor `gain`.
    """
    name = max((other for other in shares if other != given), key=lambda other: shares[other], default=None)
    if name is None or shares[name] < max(gain * shares[given], shares[given] + least):
        return None
    return name
