"""Vehicles in other hues, so that what a thing is does not hang on its colour.

The hue of the paint of each kind and colour in a picture is turned by a random angle, never to one near a pair of
colour and thing that the lexicon keeps out: no training picture holds those. What colour a repainted thing has is
unsure; what it is stays. Some pictures lose all their colour, for the same reason.
"""

import cv2
import numpy as np
from phrases import REPAINTED, State, kinds_of

SHARE = 0.7
"""Of kinds and colours in a crop that are repainted."""
PALE = 0.3
"""Of those, the ones that lose their hue instead."""
GREY = 0.15
"""Of crops without colour."""
_HUES = {"red": 0, "orange": 22, "yellow": 50, "green": 120, "blue": 225}  # degrees
_CHROMATIC = (*_HUES, "brown", "beige")
_NEAR = 35.0  # degrees: about what a hue covers
_SATURATED = 0.2
_BLOCK = 4  # pixels a state stands for


class Repainter:
    """Knows which states may be repainted; `states` grows by their repainted copies."""

    def __init__(self, lexicon: dict, states: list[State]) -> None:
        number = {state: n for n, state in enumerate(states)}
        self.groups = np.full(len(states), -1)
        self.repainted = np.arange(len(states))
        groups: dict[tuple[str, str], int] = {}
        colored = {
            k for name, entry in lexicon["things"].items() if entry.get("colored") for k in kinds_of(lexicon, name)
        }
        for n, state in enumerate(list(states)):
            if not state.color:
                continue
            if state.color in _CHROMATIC and state.kind in colored:
                self.groups[n] = groups.setdefault((state.kind, state.color), len(groups))
            copy = state._replace(color=REPAINTED)
            if copy not in number:
                number[copy] = len(states)
                states.append(copy)
            self.repainted[n] = number[copy]
        kept_out = [(_HUES[color], kinds_of(lexicon, thing)) for color, thing in lexicon["never_rendered"]]
        self._banned = {g: [hue for hue, kinds in kept_out if kind in kinds] for (kind, _), g in groups.items()}

    def __call__(
        self, image: np.ndarray, states: np.ndarray, random: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return an image, uint8 [4 h, 4 w, 3], and its states, [h, w]: some vehicles in other hues, or all grey."""
        if random.random() < GREY:
            grey = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
            return np.repeat(grey[:, :, None], 3, axis=2), self.repainted[states]
        groups = np.where(states < len(self.groups), self.groups[np.minimum(states, len(self.groups) - 1)], -1)
        chosen = [int(g) for g in np.unique(groups) if g >= 0 and random.random() < SHARE]
        if not chosen:
            return image, states
        hsv = cv2.cvtColor(image.astype(np.float32) / 255, cv2.COLOR_RGB2HSV)  # degrees, 0..1, 0..1
        states = states.copy()
        for group in chosen:
            of = groups == group
            pixels = np.repeat(np.repeat(of, _BLOCK, axis=0), _BLOCK, axis=1) & (hsv[..., 1] > _SATURATED)
            if not pixels.any():
                continue
            usual = _mean_angle(hsv[pixels, 0])
            pixels &= _apart(hsv[..., 0], usual) < _NEAR
            if random.random() < PALE:
                hsv[pixels, 1] *= random.uniform(0, 0.3)
                states[of] = self.repainted[states[of]]
                continue
            turn = random.uniform(0, 360)
            if any(_apart(usual + turn, hue) < 2 * _NEAR for hue in self._banned[group]):
                continue
            hsv[pixels, 0] = (hsv[pixels, 0] + turn) % 360
            states[of] = self.repainted[states[of]]
        return (cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB) * 255 + 0.5).astype(np.uint8), states


def _apart(a: np.ndarray | float, b: float) -> np.ndarray:
    """Return the angle between hues, degrees."""
    return np.abs((np.asarray(a) - b + 180) % 360 - 180)


def _mean_angle(degrees: np.ndarray) -> float:
    turned = np.exp(1j * np.deg2rad(degrees.astype(np.float64))).mean()
    return float(np.rad2deg(np.angle(turned)) % 360)
