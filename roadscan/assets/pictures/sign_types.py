"""Types of signs: a small net on features of faces, which ships with roadscan and says what it does not know.

It was fitted to rendered drawings of common signs of the Vienna Convention and of the MUTCD, beside plates that are
none of these (`benchmarks/fit_sign_types.py`). Its weights, and all that they are multiplied with, are whole numbers,
whose sums are exact in any order: the same cut-outs give the same bits on each processor.

Features of a sign's face in a cut-out are whole numbers as well. The plate's box is laid over a square of 48 by 48
pixels with a tenth around it. All sums are of whole numbers, and what is not whole is computed value by value in the
order that is written here, so no library's order of adding matters.
"""

from __future__ import annotations

import base64
import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.judgement.judge import stated_by
from roadscan.assets.pictures.reader import CutOut
from roadscan.compute.array_types import Float64, Int64, UInt8

SIDE: Final = 48  # Edge of the square (pixels).
_AROUND: Final = 0.1  # Share of the box that is shown beyond it on each side.
_CELL: Final = 6  # Edge of a cell of gradients and colours (pixels of the square).
_FINE: Final = 3  # Edge of a cell of brightness (pixels of the square).
_SHARPEST: Final = 4  # A pixel of the square is the mean of this many samples in each direction at most.
_LEAST_SPAN: Final = 20
"""Brightness (digital numbers) between dark and light parts of a plate from which on it is stretched in full."""
_DIRECTIONS: Final = np.array([[1024, 0], [724, 724], [0, 1024], [-724, 724], [-1024, 0], [-724, -724], [0, -1024],
                               [724, -724]], np.int64)  # fmt: skip
"""Eight directions, times 1024: a gradient counts for those within 45 degrees, by the cosine beyond that of 45."""
_NORM: Final = 300.0
"""A cell with the mean of its neighbourhood's gradients in one direction gets this value of 255 over the root of 8."""
COUNT: Final = (SIDE // _CELL) ** 2 * 10 + (SIDE // _FINE) ** 2 + 3
"""Number of features."""


def box_px(cut_out: CutOut) -> tuple[float, float]:
    """Returns width and height (pixels) of the plate's box in a cut-out: the means of its opposite sides."""
    left_low, right_low, right_up, left_up = cut_out.outline_px[:4]
    width, height = (right_low - left_low + right_up - left_up) / 2, (left_low - left_up + right_low - right_up) / 2
    return float(np.sqrt(width[0] ** 2 + width[1] ** 2)), float(np.sqrt(height[0] ** 2 + height[1] ** 2))


def features_of(cut_out: CutOut) -> UInt8:
    """Returns features (COUNT,) of a plate: gradients by cell and direction, brightness, colours, proportions, size."""
    seen = _square(cut_out)
    light = (2 * seen[:, :, 0] + 5 * seen[:, :, 1] + seen[:, :, 2]) >> 3
    inside = np.sort(light[SIDE // 6 : -SIDE // 6, SIDE // 6 : -SIDE // 6], axis=None)
    dark, bright = int(inside[inside.size // 20]), int(inside[inside.size - 1 - inside.size // 20])
    stretched = np.clip((light - dark) * 255 // max(bright - dark, 16 * _LEAST_SPAN), -64, 319)
    width, height = box_px(cut_out)
    shape = [min(int(100.0 * width / max(height, 1e-6)), 255), min(int(100.0 * height / max(width, 1e-6)), 255),
             min(int(min(width, height)), 255)]  # fmt: skip
    parts = (_gradients(stretched), _colours(seen, max(bright, 16 * _LEAST_SPAN)), _brightness(stretched), shape)
    return np.concatenate([np.asarray(part, np.int64).reshape(-1) for part in parts]).astype(np.uint8)


def _gradients(light: Int64) -> Int64:
    """Returns a value (8, 8, 8) for each cell and direction, relative to the cells around."""
    wide = np.pad(light, 1, mode="edge")
    right, down = wide[1:-1, 2:] - wide[1:-1, :-2], wide[2:, 1:-1] - wide[:-2, 1:-1]
    size = np.rint(724.0 * np.sqrt((right * right + down * down).astype(np.float64))).astype(np.int64)
    towards = right[:, :, None] * _DIRECTIONS[:, 0] + down[:, :, None] * _DIRECTIONS[:, 1]
    cells = _sums(np.maximum(towards - size[:, :, None], 0), _CELL) >> 10
    energy = np.pad((cells * cells).sum(axis=2), 1)
    count = SIDE // _CELL
    around = sum(energy[i : i + count, k : k + count] for i in range(3) for k in range(3))
    own = np.asarray(around, np.float64) / 9.0 + float((_CELL * _CELL * 3) ** 2)
    return np.asarray(np.minimum(np.rint(cells * (_NORM / 3.0) / np.sqrt(own)[:, :, None]), 255.0), np.int64)


def _colours(seen: Int64, bright: int) -> Int64:
    """Returns two differences of colours (8, 8, 2) of each cell, relative to the plate's light parts."""
    red_green = seen[:, :, 0] - seen[:, :, 1]
    blue_others = seen[:, :, 2] - ((seen[:, :, 0] + seen[:, :, 1]) >> 1)
    sums = _sums(np.stack([red_green, blue_others], axis=2), _CELL) // (_CELL * _CELL)
    return np.asarray(np.clip(128 + sums * 160 // bright, 0, 255))


def _brightness(light: Int64) -> Int64:
    """Returns the mean brightness (16, 16) of small cells."""
    return np.asarray(np.clip(_sums(light[:, :, None], _FINE) // (_FINE * _FINE), 0, 255))


def _sums(values: Int64, edge: int) -> Int64:
    count = SIDE // edge
    return np.asarray(values.reshape(count, edge, count, edge, values.shape[2]).sum(axis=(1, 3)))


def _square(cut_out: CutOut) -> Int64:
    """Returns colours (48, 48, 3) of the plate's box and a tenth around it, in sixteenths of a digital number."""
    per = min(max(int(max(box_px(cut_out)) / SIDE + 0.5), 1), _SHARPEST)
    at = ((np.arange(SIDE * per) + 0.5) / (SIDE * per)) * (1.0 + 2.0 * _AROUND) - _AROUND
    left_low, right_low, right_up, left_up = (tuple(map(float, p)) for p in cut_out.outline_px[:4])
    u, v = _mapped((left_up, right_up, right_low, left_low), at[None, :], at[:, None])
    sampled = _sampled(cut_out.pixels, u, v)
    return np.asarray(sampled.reshape(SIDE, per, SIDE, per, 3).sum(axis=(1, 3)) // (per * per))


def _mapped(corners: tuple[tuple[float, ...], ...], x: Float64, y: Float64) -> tuple[Float64, Float64]:
    """Returns where points of the unit square lie in a quadrilateral (Heckbert 1989, section 2.2.3)."""
    (x0, y0), (x1, y1), (x2, y2), (x3, y3) = corners
    dx1, dx2, sx = x1 - x2, x3 - x2, x0 - x1 + x2 - x3
    dy1, dy2, sy = y1 - y2, y3 - y2, y0 - y1 + y2 - y3
    area = dx1 * dy2 - dx2 * dy1
    area = area if abs(area) > 1e-9 else 1e-9
    g, h = (sx * dy2 - dx2 * sy) / area, (dx1 * sy - sx * dy1) / area
    below = g * x + h * y + 1.0
    below = np.where(np.abs(below) < 1e-6, 1e-6, below)
    a, b, d, e = x1 - x0 + g * x1, x3 - x0 + h * x3, y1 - y0 + g * y1, y3 - y0 + h * y3
    return (a * x + b * y + x0) / below, (d * x + e * y + y0) / below


def _sampled(pixels: UInt8, u: Float64, v: Float64) -> Int64:
    """Returns colours (h, w, 3) between pixels, in sixteenths; beyond the picture those of its edge."""
    rows, columns = pixels.shape[:2]
    u, v = np.clip(u, 0.0, columns - 1.0), np.clip(v, 0.0, rows - 1.0)
    left, top = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
    right, low = np.minimum(left + 1, columns - 1), np.minimum(top + 1, rows - 1)
    fu, fv = (np.rint((a - b) * 64.0).astype(np.int64)[..., None] for a, b in ((u, left), (v, top)))
    p = pixels.astype(np.int64)
    upper = p[top, left] * (64 - fu) + p[top, right] * fu
    lower = p[low, left] * (64 - fu) + p[low, right] * fu
    return np.asarray((upper * (64 - fv) + lower * fv) >> 8)


UNKNOWN: Final = "unknown"
"""Type of a plate that pictures show and that is no listed type for sure."""
FILE: Final = Path(__file__).parent / "models" / "sign_types.json"
DIGEST: Final = "8d24234ead81adba"
"""First 16 hexadecimal digits of the SHA-256 of the file."""
MOST_HIDDEN: Final = 4095  # Greatest value of a unit of the hidden layer.
LEAST_PX: Final = 10.0  # Smaller plates (pixels) are not looked at; the fit saw none below 12.
_OTHER_SET: Final = math.log(50.0)
"""Where a survey names its set of signs, those of the other set are this much (logarithm of the odds) less probable."""


@dataclass(frozen=True, eq=False)
class Layer:
    """A layer of whole weights (inputs, outputs), with a factor and an offset for each output."""

    weights: Float64
    factor: Float64
    offset: Float64

    def of(self, values: Float64) -> Float64:
        """Returns its outputs for whole numbers (n, inputs)."""
        return np.asarray((values @ self.weights) * self.factor + self.offset)


@dataclass(frozen=True, eq=False)
class SignTypes:
    """What the file of the recogniser states."""

    codes: tuple[tuple[str, ...], ...]
    """Codes of each type: a face that both sets show alike has one of each."""
    layers: tuple[Layer, Layer]
    threshold: float
    """Least probability of a type that is stated."""
    record: Mapping[str, Any]
    """Of the fit: seeds, versions, and how well it did on plates that it had not seen."""

    def odds(self, features: npt.NDArray[np.uint8]) -> Float64:
        """Returns logarithms of weights (k, types + 1) of the types of k plates; the last is of no listed type.

        features : (k, COUNT), of :func:`roadscan.assets.pictures.sign_types.features_of`.
        """
        hidden = np.clip(np.rint(self.layers[0].of(features.astype(np.float64))), 0.0, MOST_HIDDEN)
        return self.layers[1].of(hidden)

    def type_of(self, cut_outs: Sequence[CutOut], signs: str) -> tuple[str, float | None]:
        """Returns the code of a plate's type and its probability; `unknown` without one where none is probable enough.

        Cut-outs vote: the logarithms of their weights are averaged, each by the size of the plate in it.

        signs : "vienna" or "mutcd", the set that the country has, or "both".
        """
        large = [one for one in cut_outs if min(box_px(one)) >= LEAST_PX]
        if not large:
            return UNKNOWN, None
        sizes_px = [min(box_px(one)) for one in large]
        return self.voted(self.odds(np.array([features_of(one) for one in large])), sizes_px, signs)

    def voted(self, odds: Float64, sizes_px: Sequence[float], signs: str) -> tuple[str, float | None]:
        """Returns the answer of :meth:`type_of` from odds (k, types + 1) of plates of these sizes (pixels)."""
        whole = math.fsum(sizes_px)
        own = [self._code(codes, signs) for codes in self.codes]
        joined = [math.fsum(size * value for size, value in zip(sizes_px, column, strict=True)) / whole
                  for column in odds.T.tolist()]  # fmt: skip
        joined = [value - (_OTHER_SET if k < len(own) and not own[k] else 0.0) for k, value in enumerate(joined)]
        top = max(joined)
        weights = [math.exp(value - top) for value in joined]
        best = max(range(len(own)), key=lambda k: weights[k])
        probability = weights[best] / math.fsum(weights)
        return (own[best], probability) if own[best] and probability >= self.threshold else (UNKNOWN, None)

    @staticmethod
    def _code(codes: Sequence[str], signs: str) -> str:
        return " ".join(code for code in codes if signs == "both" or code.startswith(f"{signs}:"))


@functools.cache
def sign_types() -> SignTypes:
    """Returns the recogniser; raises as :func:`roadscan.assets.judgement.judge.stated_by`."""
    return made_of(stated_by(FILE, DIGEST, "the recogniser of signs"))


def made_of(stated: Mapping[str, Any]) -> SignTypes:
    """Returns the recogniser that the content of a file states."""
    codes = tuple(tuple(one["codes"]) for one in stated["types"])
    layers = layer_of(stated["hidden"]), layer_of(stated["out"])
    return SignTypes(codes, layers, stated["threshold"], stated["record"])


def listed_types() -> Sequence[Mapping[str, Any]]:
    """Returns the list of types: codes, name, shape and colours of each."""
    return tuple(stated_by(FILE, DIGEST, "the recogniser of signs")["types"])


def layer_of(stated: Mapping[str, Any]) -> Layer:
    """Returns a layer as the file states it: weights of eight bits in base64, by input then output."""
    factor, offset = (np.array(stated[name], np.float64) for name in ("factor", "offset"))
    weights = np.frombuffer(base64.b64decode(stated["weights"]), np.int8).reshape(-1, factor.size)
    return Layer(weights.astype(np.float64), factor, offset)
