import colorsys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from openvocab_occ.query.colors import NAMES, agreed, degrees, names_of

PAINTS = {"red": (184, 40, 31), "orange": (211, 101, 29), "yellow": (217, 174, 37), "green": (47, 111, 76),
          "blue": (38, 82, 154), "brown": (106, 70, 48), "white": (235, 235, 230), "black": (32, 34, 38),
          "grey": (130, 134, 138), "purple": (110, 50, 150), "pink": (240, 140, 175)}  # fmt: skip
GLASS, TYRE = (45, 58, 77), (16, 18, 22)


def fits(*parts):
    """Names that fit a thing of shares and colours."""
    degree = degrees(np.array([(share, *rgb) for share, rgb in parts], np.float32))
    return {name for name, d in zip(NAMES, degree, strict=True) if d >= 0.5}


@pytest.mark.parametrize("name", PAINTS)
def test_a_paint_has_its_name_also_among_glass_and_tyres(name):
    assert NAMES[names_of(np.array([PAINTS[name]], np.uint8))[0]] == name
    assert fits((0.5, PAINTS[name]), (0.35, GLASS), (0.15, TYRE)) == {name}


@pytest.mark.parametrize("name", ["red", "orange", "yellow", "green", "blue"])
@pytest.mark.parametrize("shade", [0.5, 0.7, 0.9])
def test_a_hue_stays_as_a_surface_falls_into_shade(name, shade):
    """Light scales linear values, which sRGB encodes by about the power 1 / 2.2."""
    rgb = np.array(PAINTS[name]) * shade ** (1 / 2.2)
    assert NAMES[names_of(rgb[None].astype(np.uint8))[0]] == name


def test_saturated_hues_are_named_as_a_colour_wheel_names_them():
    wheel = {0: "red", 55: "yellow", 120: "green", 235: "blue", 275: "purple"}
    for angle, name in wheel.items():
        rgb = np.array(colorsys.hsv_to_rgb(angle / 360, 0.9, 0.85)) * 255
        assert NAMES[names_of(rgb[None].astype(np.uint8))[0]] == name


def test_a_lamp_of_another_hue_does_not_colour_a_thing():
    assert fits((0.9, PAINTS["grey"]), (0.1, PAINTS["red"])) == {"grey"}
    assert fits((0.6, PAINTS["red"]), (0.4, PAINTS["blue"])) == {"red", "blue"}


def test_grey_and_white_are_told_by_the_light_of_the_whole_picture():
    thing = np.array([(1.0, 120, 121, 122)], np.float32)
    assert degrees(thing)[NAMES.index("grey")] == 1
    assert degrees(thing, middle=0.35)[NAMES.index("white")] == 1
    assert degrees(thing, middle=0.95)[NAMES.index("black")] > 0.5


SHARES = arrays(np.float64, (3, len(NAMES)), elements=st.floats(0, 1))


@given(SHARES, SHARES, st.permutations(range(len(NAMES))))
def test_measurement_and_model_agree_on_a_best_colour_by_whatever_order_of_names(measured, told, order):
    both = agreed(measured, told)
    np.testing.assert_allclose(both.max(axis=1), 1.0)
    assert (both > 0).all()
    np.testing.assert_allclose(agreed(measured[:, order], told[:, order]), both[:, order])
    even = agreed(measured, np.full_like(told, 1 / len(NAMES)))
    np.testing.assert_array_equal(np.argsort(-even, kind="stable"), np.argsort(-(measured + 0.05), kind="stable"))


def test_a_model_that_is_sure_settles_what_light_leaves_open_but_a_slight_leaning_changes_nothing():
    measured, told = np.zeros((1, len(NAMES))), np.full((1, len(NAMES)), 0.02)
    white, grey, red = (NAMES.index(name) for name in ("white", "grey", "red"))
    measured[0, [white, grey]] = 0.4, 0.6
    told[0, white] = 0.8
    assert agreed(measured, told)[0, grey] < 0.5 < agreed(measured, told)[0, white]
    measured[0] = 0
    measured[0, red], told[0, white] = 1.0, 0.2
    assert agreed(measured, told)[0].argmax() == red
