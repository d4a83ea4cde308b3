"""Classes of colours of a plate in cut-outs: by hue, which shade and sun change little."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.pictures.reader import CutOut
from roadscan.compute.array_types import Float64, UInt8
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


def _inside(one: CutOut) -> npt.NDArray[np.bool_]:
    """Returns a mask (h, w) of the pixels of a cut-out within the outline, shrunk a little."""
    middle = one.outline_px.mean(axis=0)
    shrunk = middle + _INSIDE * (one.outline_px - middle)
    drawn = np.zeros(one.pixels.shape[:2], np.uint8)
    cv2.fillPoly(drawn, [np.rint(shrunk * 16).astype(np.int32)], 1, shift=4)
    return drawn.astype(np.bool_)


def _shares(pixels: UInt8, inside: npt.NDArray[np.bool_]) -> dict[str, float]:
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


def _within(hue: Float64, first: float, last: float) -> npt.NDArray[np.bool_]:
    if first <= last:
        return (hue >= first) & (hue < last)
    return (hue >= first) | (hue < last)
