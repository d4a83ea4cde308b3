"""Signs in pictures: colour, shape, text and type of the plate from cut-outs of the best views."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.kind import AssetObject, reference_point
from roadscan.assets.pictures.reader import CutOut, CutOutReader, Recognition, Sight
from roadscan.assets.probabilities import Curve
from roadscan.compute.array_types import Bool, Float64, UInt8
from roadscan.compute.arrays import way_along
from roadscan.core.extras import cv2

HUES: Final = {"red": (340.0, 14.0), "orange": (14.0, 40.0), "yellow": (40.0, 70.0), "green": (70.0, 178.0),
               "blue": (178.0, 275.0), "purple": (275.0, 340.0)}  # fmt: skip
"""Hue (degrees of the colour circle) from which and up to which a class reaches."""
_LEAST_SATURATION: Final = 0.28  # Least saturation of a pixel with a hue.
_LEAST_VALUE: Final = 0.08  # Least value (0 … 1) of a pixel with a hue.
_COLOURED: Final = 0.15
"""Least share of a plate that has a hue; a red rim is a quarter of a round plate or more."""
_BROWN_BELOW: Final = 0.55
"""Orange that is darker than this share of the brightest parts around is brown."""
_WHITE_FROM, _BLACK_BELOW = 0.5, 0.22  # Brightness relative to the brightest parts around.
_INSIDE: Final = 0.92
"""The outline is shrunk by this factor, to exclude what is behind the plate."""
_PRIOR_PIXELS: Final = 12.0  # Number of pixels with which the probability is halfway to even odds.


def colour_of(cut_outs: Sequence[CutOut]) -> tuple[str, float] | None:
    """Returns the main colour of a plate and its probability, from cut-outs with colours; None where there are none.

    A hue that covers at least 15 % of the plate is its colour, that which covers most of it; else it is white, grey or
    black, by its brightness against the brightest parts of the picture around. The probability is the mean share of
    the pixels that say so, drawn towards even odds where they are few.
    """
    shares: dict[str, float] = {}
    pixels = 0
    for one in cut_outs:
        if one.is_grey:
            continue
        inside = _inside(one)
        if not inside.any():
            continue
        pixels += int(inside.sum())
        for name, share in _shares(one.pixels, inside).items():
            shares[name] = shares.get(name, 0.0) + share
    if not shares:
        return None
    total = sum(shares.values())
    best = min(shares, key=lambda name: (-shares[name], name))
    weight = pixels / (pixels + _PRIOR_PIXELS)
    return best, weight * shares[best] / total + (1.0 - weight) / (len(HUES) + 4)


def _inside(one: CutOut) -> Bool:
    """Returns a mask (h, w) of the pixels of a cut-out within the outline, shrunk a little."""
    middle = one.outline_px.mean(axis=0)
    shrunk = middle + _INSIDE * (one.outline_px - middle)
    drawn = np.zeros(one.pixels.shape[:2], np.uint8)
    cv2.fillPoly(drawn, [np.rint(shrunk * 16).astype(np.int32)], 1, shift=4)
    return drawn.astype(np.bool_)


def _shares(pixels: UInt8, inside: Bool) -> dict[str, float]:
    """Returns the shares of the classes among the pixels that decide: those with a hue, or all where few have one."""
    hue, saturation, value = hue_saturation_value(pixels[inside])
    brightest = float(np.quantile(hue_saturation_value(pixels.reshape(-1, 3))[2], 0.95))
    has_hue = (saturation >= _LEAST_SATURATION) & (value >= _LEAST_VALUE)
    if has_hue.mean() >= _COLOURED:
        own, dark = hue[has_hue], value[has_hue] < _BROWN_BELOW * brightest
        found = {name: float(_within(own, *limits).mean()) for name, limits in HUES.items()}
        brown = float((_within(own, *HUES["orange"]) & dark).mean())
        return {**found, "orange": found["orange"] - brown, "brown": brown}
    level = value / max(brightest, 1e-9)
    white, black = float((level >= _WHITE_FROM).mean()), float((level < _BLACK_BELOW).mean())
    return {"white": white, "black": black, "grey": 1.0 - white - black}


def hue_saturation_value(rgb: UInt8) -> tuple[Float64, Float64, Float64]:
    """Hue (n,) in degrees, saturation and value (0 … 1) of colours (n, 3), as A. R. Smith (1978) defines them."""
    c = rgb.astype(np.float64) / 255.0
    value, low = c.max(axis=-1), c.min(axis=-1)
    span = value - low
    r, g, b = c[..., 0], c[..., 1], c[..., 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        sector = np.where(value == r, (g - b) / span, np.where(value == g, 2.0 + (b - r) / span, 4.0 + (r - g) / span))
        saturation = np.where(value > 0.0, span / value, 0.0)
    return np.where(span > 0.0, 60.0 * sector % 360.0, 0.0), saturation, value


def _within(hue: Float64, first: float, last: float) -> Bool:
    if first <= last:
        return (hue >= first) & (hue < last)
    return (hue >= first) | (hue < last)


_POINTS: Final = 48  # Points of an outline.


def plate_outline(shape: str, width_m: float, height_m: float) -> Float64:
    """Returns points (48, 2: right, up) around the outline of a plate about the middle of its bounding box (m).

    A shape that is not known is taken for a rectangle.
    """
    corners = _CORNERS.get(shape, _CORNERS["rectangle"]) * [width_m, height_m]
    if shape == "round":
        return corners
    closed = np.vstack([corners, corners[:1]])
    along = way_along(closed)
    at = np.arange(_POINTS) * along[-1] / _POINTS
    return np.column_stack([np.interp(at, along, closed[:, k]) for k in (0, 1)])


def on_plate(plane: Float64, middle_m: Float64, facing_deg: float, tilt_deg: float) -> Float64:
    """Places (n, 3: easting, northing, height) of points (n, 2: right as seen from the front, up) on a plate."""
    right, up, _ = plate_axes(facing_deg, tilt_deg)
    return np.asarray(middle_m + plane[:, :1] * right + plane[:, 1:] * up)


def plate_axes(facing_deg: float, tilt_deg: float) -> tuple[Float64, Float64, Float64]:
    """Returns unit vectors to the right as seen from the front, upwards on the plate, and out of its front."""
    a, t = math.radians(facing_deg), math.radians(tilt_deg)
    normal = np.array([math.sin(a) * math.cos(t), math.cos(a) * math.cos(t), math.sin(t)])
    right = np.array([-math.cos(a), math.sin(a), 0.0])
    return right, np.cross(normal, right), normal


def _polygon(count: int, first_deg: float) -> Float64:
    """Returns the corners of a regular polygon in a bounding box of 1 by 1."""
    angle = np.deg2rad(first_deg + 360.0 / count * np.arange(count))
    corners = np.column_stack([np.cos(angle), np.sin(angle)])
    low, high = corners.min(axis=0), corners.max(axis=0)
    return np.asarray((corners - (low + high) / 2) / (high - low))


# Corners of plates, in shares of their width and height from the middle.
_CORNERS: Final[Mapping[str, Float64]] = {
    "rectangle": np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]),
    "round": _polygon(_POINTS, 0.0),
    "octagon": _polygon(8, 22.5),
    "diamond": _polygon(4, 0.0),
    "triangle": _polygon(3, 90.0),
    "triangle down": _polygon(3, 270.0),
}
SHAPES: Final[Sequence[str]] = tuple(_CORNERS)
"""Shapes that pictures are compared with."""


_NEAR: Final = 0.07
"""Colours are compared this far within and beyond an outline, as a share of the plate."""
_FULL_STEP: Final = 60.0
"""Difference of colours (CIE 1976 L*a*b*, 8 bits) at which an edge has full weight."""
_WEIGHT: Final = 14.0  # Weight of a mean edge in the logarithm of a shape's weight.
_FROM_RETURNS: Final = 0.7
"""Probability that the outline of the returns alone has the right shape."""
_UNKNOWN: Final = 0.02
"""Weight of shapes that nobody lists, as a share of that of the best one: no shape is certain."""
_NO_EDGE, _MOST_ODDS = 0.25, 1.5
"""Mean step of colours at which a picture says neither that a plate is there nor that there is none, and the greatest
logarithm of the odds that pictures add or take: a grey plate before a grey wall shows no edge either."""
_LEAST_PX: Final = 12.0  # Smaller cut-outs (pixels) are not used.


def shape_of(cut_outs: Sequence[CutOut], shape: str, width_m: float, height_m: float) -> tuple[str, float]:
    """Returns the shape of a plate and its probability.

    Every shape in the plate's bounding box is compared with the cut-outs. For the right one, colours differ all
    along its outline from just within to just beyond it. A shape's weight grows exponentially with the mean of these
    steps; the shape of the returns starts with 0.7. Without a cut-out of 12 pixels or more only that is reported.

    Parameters
    ----------
    cut_outs : with the corners of the plate's bounding box among their outlines: lower left, lower right, upper right,
        upper left are the first four.
    shape : as the returns have it.
    width_m, height_m : of the bounding box.
    """
    if not any(map(_is_large, cut_outs)):
        return shape, _FROM_RETURNS
    own = "rectangle" if shape == "square" else shape
    names = [n for n in SHAPES if _fits(n, width_m, height_m)]
    if own not in names:
        names.append(own)
    score = {n: np.log(_FROM_RETURNS if n == own else (1.0 - _FROM_RETURNS) / max(len(names) - 1, 1)) for n in names}
    for one in cut_outs:
        if _is_large(one):
            for name in names:
                score[name] += _WEIGHT / len(cut_outs) * _edges(one, name)
    joined: dict[str, float] = {}
    top = max(score.values())
    for name, value in score.items():
        key = name.split()[0]
        joined[key] = joined.get(key, 0.0) + float(np.exp(value - top))
    best = min(joined, key=lambda n: (-joined[n], n))
    name = shape if (best, shape) == ("rectangle", "square") else best
    return name, joined[best] / (sum(joined.values()) + _UNKNOWN * joined[best])


def plate_odds(cut_outs: Sequence[CutOut], shape: str) -> float:
    """Returns the logarithm of the odds that cut-outs add to those of a plate of a shape: negative ones veto it.

    Colours differ across the whole outline of a plate; where they do not, a picture sees the place and no plate there.
    """
    name = "rectangle" if shape in ("square", "other") else shape
    names = [n for n in SHAPES if n.split()[0] == name]
    seen = [max(_edges(one, n) for n in names) for one in cut_outs if _is_large(one)]
    if not seen:
        return 0.0
    return float(np.clip(_WEIGHT * (np.mean(seen) - _NO_EDGE), -_MOST_ODDS, _MOST_ODDS))


def _is_large(one: CutOut) -> bool:
    return float(np.ptp(one.outline_px, axis=0).min()) >= _LEAST_PX


def _fits(name: str, width_m: float, height_m: float) -> bool:
    """Returns whether a plate of this size may have the shape: all but rectangles are as high as wide, or nearly."""
    ratio = height_m / width_m
    if name.startswith("triangle"):
        return 0.75 <= ratio <= 1.05
    return name == "rectangle" or 0.88 <= ratio <= 1.14


def _edges(one: CutOut, name: str) -> float:
    """Returns the mean step of the colours (0 … 1) across the outline of a shape in the plate's box."""
    lab = cv2.cvtColor(one.pixels, cv2.COLOR_RGB2LAB).astype(np.float32)
    turn = cv2.getPerspectiveTransform(_PIXEL_BOX, one.outline_px[:4].astype(np.float32))
    outline = plate_outline(name, 1.0, 1.0)
    inner, outer = (_sampled(lab, turn, (1.0 + sign * 2.0 * _NEAR) * outline) for sign in (-1.0, 1.0))
    step = np.linalg.norm(inner - outer, axis=1)
    return float(np.mean(np.minimum(step / _FULL_STEP, 1.0)))


def _sampled(lab: npt.NDArray[np.float32], turn: Float64, plane: Float64) -> Float64:
    """Returns colours (n, 3) at points (n, 2) of the plate's box."""
    at = cv2.perspectiveTransform(plane[None].astype(np.float32), turn.astype(np.float32))[0]
    found = cv2.remap(lab, at[None, :, 0], at[None, :, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found[0], np.float64)


_PIXEL_BOX: Final = np.array(
    [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]], np.float32
)  # Corners of a box of 1 by 1.


_MOST: Final = 0.999  # Greatest probability that is stated.
_PLATE_BOX: Final = np.array(
    [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]
)  # Corners of a plate of 1 by 1: right, up.


class SignReader(CutOutReader):
    """Reader of signs: the outline of a plate follows from its middle, size, shape, facing and tilt."""

    name = "sign"

    def sight(self, one: AssetObject) -> Sight:
        """Returns the middle and the corners of the plate, from the front."""
        middle, (facing_deg, tilt_deg) = np.array(reference_point(one.geometry)), _turn(one)
        if one.attributes.get("facing_deg") is None:
            return Sight(np.repeat(middle[None], 5, axis=0))
        corners = on_plate(_PLATE_BOX * _size(one), middle, facing_deg, tilt_deg)
        return Sight(np.vstack([middle, corners]), plate_axes(facing_deg, tilt_deg)[2])

    def outline_m(self, one: AssetObject) -> Float64 | None:
        """Returns corners of the bounding box, then the outline of the shape; None for a plate of unknown facing."""
        if one.attributes.get("facing_deg") is None or not _size(one).all():
            return None
        middle, turn = np.array(reference_point(one.geometry)), _turn(one)
        shape = plate_outline(one.attributes.get("shape") or "rectangle", *_size(one).tolist())
        return np.vstack([on_plate(_PLATE_BOX * _size(one), middle, *turn), on_plate(shape, middle, *turn)])

    def read(self, one: AssetObject, cut_outs: Sequence[CutOut], recognition: Recognition) -> Mapping[str, Any]:
        """Returns columns colour, shape, message and type, each with its probability where it is known, and that of the
        plate itself: a picture that sees the place confirms it or not.
        """
        told: dict[str, Any] = {}
        shape, probability = shape_of(cut_outs, one.attributes.get("shape") or "other", *_size(one).tolist())
        told |= {"shape": shape, "shape_probability": probability}
        confirmed = Curve(plate_odds(cut_outs, shape), 1.0).stated(one.probability)
        told["probability"] = min(confirmed, _MOST)
        colour = colour_of([_within_shape(c) for c in cut_outs])
        if colour is not None:
            told |= {"colour": colour[0], "colour_probability": colour[1]}
        read = [r for r in map(recognition.text, cut_outs) if r is not None]
        if read:
            words, probability = max(read, key=lambda r: r[1])
            told |= {"message": words, "message_probability": probability}
        kind = recognition.label(cut_outs)
        if kind is not None:
            told |= {"type": kind[0], "type_probability": kind[1]}
        return told


def _within_shape(one: CutOut) -> CutOut:
    """Returns a cut-out with the outline of the shape alone."""
    return CutOut(one.pixels, one.outline_px[4:], one.resolution_m, one.is_grey)


def _size(one: AssetObject) -> Float64:
    """Returns width and height (m); 0 where they are not known."""
    return np.array([one.attributes.get("width_m") or 0.0, one.attributes.get("plate_height_m") or 0.0])


def _turn(one: AssetObject) -> tuple[float, float]:
    """Returns facing and tilt (degrees)."""
    return one.attributes.get("facing_deg") or 0.0, one.attributes.get("tilt_deg") or 0.0
