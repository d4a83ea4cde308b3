"""Colours and shapes of drawn plates under light of many strengths and tints, and colours of paint."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from roadscan.assets.pictures.reader import CutOut
from roadscan.assets.pictures.readers.paint import paint_colour
from roadscan.assets.pictures.readers.sign import colour_of, hue_saturation_value, plate_odds, plate_outline, shape_of

PAINTS = {
    "red": (190, 30, 36), "blue": (20, 66, 160), "yellow": (248, 200, 24), "green": (12, 118, 62),
          "brown": (104, 62, 32), "white": (244, 244, 240), "black": (18, 18, 20), "orange": (244, 120, 20),
}  # fmt: skip
BOX = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])


def plate(
    shape: str, colour: str, light: float = 1.0, rim: str | None = None, *, size_px: float = 40.0, ratio: float = 1.0,
    turn_deg: float = 0.0, seed: int = 0,
) -> CutOut:  # fmt: skip
    """A plate before a sky and a dark roof, seen from aside, with noise and blur."""
    rng = np.random.default_rng(seed)
    edge = int(size_px * 1.6)
    picture = np.full((edge, edge, 3), (170, 186, 205), np.float64)
    picture[edge // 2 :] = (70, 72, 68)
    a = np.radians(turn_deg)
    skew = np.array([[np.cos(a), 0.0], [0.25 * np.sin(a), 1.0]])
    size = size_px * np.array([1.0, ratio])

    def to_px(plane: np.ndarray) -> np.ndarray:
        return edge / 2 + (plane * size) @ skew.T * [1.0, -1.0]

    drawn = picture.copy()
    for scale, name in ((1.0, rim or colour), (0.72 if rim else 1.0, colour)):
        outline = np.rint(to_px(scale * plate_outline(shape, 1.0, 1.0)) * 16).astype(np.int32)
        cv2.fillPoly(drawn, [outline], [light * c for c in PAINTS[name]], cv2.LINE_AA, 4)
    blurred = cv2.GaussianBlur(drawn, (0, 0), 0.6) + rng.normal(0.0, 3.0, drawn.shape)
    pixels = np.clip(np.rint(blurred), 0, 255).astype(np.uint8)
    return CutOut(pixels, np.vstack([to_px(BOX), to_px(plate_outline(shape, 1.0, 1.0))]), 0.01, False)


def inner(cut: CutOut) -> CutOut:
    return CutOut(cut.pixels, cut.outline_px[4:], cut.resolution_m, cut.is_grey)


def test_hue_is_that_of_opencv():
    rgb = np.random.default_rng(5).integers(0, 256, (500, 3)).astype(np.uint8)
    hue, saturation, value = hue_saturation_value(rgb)
    theirs = cv2.cvtColor((rgb[None] / 255.0).astype(np.float32), cv2.COLOR_RGB2HSV)[0]
    away = np.abs((hue - theirs[:, 0] + 180.0) % 360.0 - 180.0)
    assert away.max() < 0.01
    assert np.abs(saturation - theirs[:, 1]).max() < 1e-5 and np.abs(value - theirs[:, 2]).max() < 1e-5


@pytest.mark.parametrize("colour", ["red", "blue", "yellow", "green", "brown"])
@pytest.mark.parametrize("light", [0.35, 0.6, 1.0])
def test_colours_hold_in_shade_and_sun(colour: str, light: float):
    found = colour_of([inner(plate("round", colour, light, seed=k)) for k in range(3)])
    assert found is not None and found[0] == colour and found[1] > 0.8


@pytest.mark.parametrize(("shape", "rim"), [("round", "red"), ("triangle", "red"), ("rectangle", None)])
def test_a_rim_is_the_colour_of_a_white_sign(shape: str, rim: str | None):
    found = colour_of([inner(plate(shape, "white", 0.9, rim))])
    assert found is not None and found[0] == (rim or "white")


def test_grey_pictures_tell_no_colour():
    one = plate("round", "red")
    assert colour_of([CutOut(one.pixels, one.outline_px, 0.01, True)]) is None
    assert colour_of([]) is None


def test_probabilities_of_colours_are_as_often_right():
    right, stated = [], []
    rng = np.random.default_rng(3)
    for number in range(150):
        colour = ["red", "blue", "yellow", "green", "brown", "white", "orange"][number % 7]
        cut = plate("round", colour, rng.uniform(0.2, 1.0), size_px=rng.uniform(6.0, 40.0), seed=number)
        found = colour_of([inner(cut)])
        assert found is not None
        right.append(found[0] == colour)
        stated.append(found[1])
    assert np.mean(right) >= 0.85
    assert abs(np.mean(right) - np.mean(stated)) < 0.12


@pytest.mark.parametrize("shape", ["rectangle", "round", "octagon", "diamond", "triangle"])
@pytest.mark.parametrize("said", ["same", "other"])
def test_edges_tell_the_shape(shape: str, said: str):
    ratio = np.sqrt(3.0) / 2.0 if shape == "triangle" else 1.0
    cuts = [plate(shape, "yellow", light, ratio=ratio, turn_deg=20.0, size_px=60.0) for light in (0.6, 0.9)]
    returns = shape if said == "same" else ("round" if shape == "octagon" else "octagon")
    found, probability = shape_of(cuts, returns, 0.8, 0.8 * ratio)
    if said == "same" or {shape, returns} != {"octagon", "round"}:  # these differ by 2 % of their width
        assert found == shape and probability > 0.5


def test_no_shape_is_certain():
    cuts = [plate("round", "yellow", size_px=120.0, seed=k) for k in range(3)]
    assert 0.9 < shape_of(cuts, "round", 0.8, 0.8)[1] <= 1.0 / 1.02


@pytest.mark.parametrize("shape", ["rectangle", "round", "triangle"])
def test_a_picture_confirms_a_plate_and_vetoes_one_that_is_not_there(shape: str):
    there, wall = plate(shape, "yellow", size_px=60.0), plate(shape, "yellow", size_px=60.0)
    noise = np.random.default_rng(1).normal(128.0, 4.0, wall.pixels.shape)
    nothing = CutOut(noise.astype(np.uint8), wall.outline_px, wall.resolution_m, False)
    assert plate_odds([there], shape) > 1.0
    assert plate_odds([nothing], shape) < -1.0
    assert plate_odds([plate(shape, "yellow", size_px=8.0)], shape) == 0.0


def test_a_plate_that_is_too_small_keeps_the_shape_of_the_returns():
    found, probability = shape_of([plate("round", "blue", size_px=8.0)], "octagon", 0.6, 0.6)
    assert found == "octagon" and probability == pytest.approx(0.7)
    assert shape_of([], "square", 0.6, 0.6)[0] == "square"


def test_a_plate_that_can_only_be_a_rectangle_is_no_certain_one_without_a_picture_of_it():
    small = plate("rectangle", "blue", ratio=0.6, size_px=8.0)
    assert shape_of([small], "rectangle", 0.9, 0.54) == ("rectangle", 0.7)


@pytest.mark.parametrize("light", [(1.0, 1.0, 1.0), (1.0, 0.85, 0.6), (0.7, 0.85, 1.0), (0.3, 0.33, 0.4)])
@pytest.mark.parametrize(("name", "paint"), [("white", (0.72, 0.72, 0.70)), ("yellow", (0.70, 0.50, 0.10))])
def test_white_and_yellow_paint_are_told_apart_in_any_light(name: str, paint: tuple[float, ...], light: tuple):
    rng = np.random.default_rng(1)

    def taken(share: tuple[float, ...], count: int) -> np.ndarray:
        linear = np.array(share) * light * rng.uniform(0.85, 1.0, (count, 1))
        encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        return np.clip(np.rint(255 * encoded + rng.normal(0.0, 2.0, encoded.shape)), 0, 255).astype(np.uint8)

    told = paint_colour(taken(paint, 40), taken((0.12, 0.12, 0.115), 60))
    assert told["colour"] == name and told["colour_probability"] > 0.9


def test_paint_that_is_not_seen_has_no_colour():
    grey = np.full((50, 3), 90, np.uint8)
    assert paint_colour(grey, grey) == {}
    warm = np.full((50, 3), (90, 86, 80), np.uint8)
    assert paint_colour(warm, warm) == {}
    assert paint_colour(warm[:2], warm) == {}
