"""Green ground from several pictures: fine cells that are planted, and where the edge lies."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.assets.green.cells import CELL_M
from roadscan.assets.green.colours import FINE, FINE_M, Look
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.core.extras import cv2

MARGIN_CELLS: Final = 32
"""Cells around a square that change what is found in it (8 m): openings, means around an edge, symbols of paint."""
_GREEN: Final = 0.045
"""Greenness from which ground is planted; the edge lies midway between both sides."""
_LEAST: Final = 2
"""Pictures that must show a fine cell."""
_SAME: Final = 0.7
"""Share of the pictures' weight that must say the same."""
_NARROW: Final = 7
"""Strips narrower than this (fine cells) are none; gaps narrower than the half are closed."""
_AROUND: Final = 15
"""Edge of the square (fine cells) in which both sides of an edge are compared: 0.75 m."""
_OFF_PX: Final = 1.0
"""1 σ of an edge in pixels, common to all pictures: a mounting or a pose that is off by 0.1° does that."""
_DRIVEN_M: Final = 1.3
"""Ground this near to a drive (m) is not planted."""


class Mosaic(NamedTuple):
    """Rasters (rows, columns) of fine cells."""

    told: Bool
    """Two pictures or more show it, and agree."""
    green: Bool
    greenness: Float64
    sigma_m: Float64
    """1 σ of the place of an edge there (m): the size of a pixel, and by how much two sets of pictures differ."""


class Sums:
    """Sums over pictures of n cells with 25 fine ones each; two sets of pictures are held apart."""

    def __init__(self, cells: int) -> None:
        shape = (2, cells, FINE * FINE)
        self.weight, self.greenness = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        self.green = np.zeros(shape, np.float32)
        self.number = np.zeros(shape, np.uint8)
        self.pixel = np.zeros((2, cells), np.float32)
        self.looks = np.zeros((2, cells), np.float32)

    def at(self, cells: Int64) -> Sums:
        """Returns those of some cells."""
        out = Sums(0)
        for name in ("weight", "greenness", "green", "number", "pixel", "looks"):
            setattr(out, name, getattr(self, name)[:, cells])
        return out

    def add(self, look: Look, half: int) -> None:
        """Add a picture to one of both sets."""
        told = np.isfinite(look.index)
        weight = np.where(told, 1.0 / np.square(np.maximum(look.pixel_m, 0.02))[:, None], 0.0)
        index = np.nan_to_num(look.index)
        self.weight[half, look.cells] += weight
        self.greenness[half, look.cells] += weight * index
        self.green[half, look.cells] += weight * (index >= _GREEN)
        number = self.number[half, look.cells]
        self.number[half, look.cells] = np.where(told & (number < 255), number + 1, number)
        own = weight.max(axis=1)
        self.pixel[half, look.cells] += own * look.pixel_m
        self.looks[half, look.cells] += own


def in_raster(values: npt.NDArray[Any], at: tuple[Int64, Int64], shape: tuple[int, int]) -> Any:
    """Returns a raster of fine cells from values (n, 25) of cells at rows and columns of a window of `shape` cells."""
    out = np.zeros((*shape, FINE, FINE), values.dtype)
    out[at] = values.reshape(-1, FINE, FINE)
    return np.ascontiguousarray(out.transpose(0, 2, 1, 3).reshape(shape[0] * FINE, shape[1] * FINE))


def mosaic_of(sums: Sums, own: Int64, at: tuple[Int64, Int64], shape: tuple[int, int], drive_m: Float64) -> Mosaic:
    """Returns fine cells of a window from the sums of its cells.

    own : (n,) the cells that lie in the window, `at` their row and column in it, of `shape` cells; drive_m : (n,)
    distance from a drive.
    """
    sums = sums.at(own)

    raster = functools.partial(in_raster, at=at, shape=shape)
    weight = raster(sums.weight.sum(axis=0))
    some = np.maximum(weight, 1e-9)
    index, share = raster(sums.greenness.sum(axis=0)) / some, raster(sums.green.sum(axis=0)) / some
    shown = raster(sums.number.astype(np.int32).sum(axis=0)) >= _LEAST
    near_drive = raster(np.repeat((drive_m <= _DRIVEN_M)[:, None], FINE * FINE, axis=1).astype(np.uint8)) > 0
    agree = (share >= _SAME) | (share <= 1.0 - _SAME)
    # Along an edge pixels hold some of both sides, so that pictures may differ there and agree around it.
    kernel = np.ones((5, 5), np.uint8)
    near_agreed = cv2.dilate((agree & shown).view(np.uint8), kernel) > 0
    told = shown & near_agreed & ~near_drive
    green = told & (index >= _midway(index, told))
    green = _without_strips(green, told)
    pixel = (sums.pixel.sum(axis=0) / np.maximum(sums.looks.sum(axis=0), 1e-9))[:, None]
    pixel_m = raster(np.repeat(pixel, FINE * FINE, axis=1))
    return Mosaic(told, green, index, _sigma_m(sums, raster, pixel_m, told))


def _midway(index: Float64, told: Bool) -> Float64:
    """Returns the index that parts both sides of an edge, each pixel by what is around it."""
    is_green = told & (index >= _GREEN)
    means, weights = [], []
    for side in (is_green, told & ~is_green):
        own = side.astype(np.float64)
        count = cv2.blur(own, (_AROUND, _AROUND))
        means.append(
            cv2.blur(np.where(side, index, 0.0).astype(np.float64), (_AROUND, _AROUND)) / np.maximum(count, 1e-6)
        )
        weights.append(count)
    both = (weights[0] > 0.1) & (weights[1] > 0.1)
    return np.where(both, 0.5 * (means[0] + means[1]), _GREEN)


def _without_strips(green: Bool, told: Bool) -> Bool:
    """Returns green ground without narrow strips, and with narrow gaps closed."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_NARROW, _NARROW))
    small = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
    closed = cv2.morphologyEx(green.astype(np.uint8), cv2.MORPH_CLOSE, small)
    return np.asarray((cv2.morphologyEx(closed, cv2.MORPH_OPEN, disc) > 0) & told)


def _sigma_m(sums: Sums, raster: Callable[[Any], Any], pixel_m: Float64, told: Bool) -> Float64:
    """Returns 1 σ (m) of an edge at each fine cell: a pixel's, and the distance between the edges of both sets."""
    halves = []
    for half in (0, 1):
        weight = raster(sums.weight[half])
        mean = raster(sums.greenness[half]) / np.maximum(weight, 1e-9)
        halves.append((mean >= _GREEN, weight > 0.0))
    both = told & halves[0][1] & halves[1][1]
    edge = np.zeros(told.shape, np.uint8)
    for is_green, _ in halves:
        edge |= cv2.morphologyEx((is_green & both).view(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
    differ = both & (halves[0][0] != halves[1][0])
    box = (2 * _AROUND + 1, 2 * _AROUND + 1)
    length = cv2.blur(edge.astype(np.float64), box)
    between = cv2.blur(differ.astype(np.float64), box) / np.maximum(length / 3.0, 1e-6) * FINE_M
    between = np.where(length > 0.0, np.minimum(between, 0.5), 0.0)
    return np.asarray(np.sqrt((_OFF_PX * pixel_m) ** 2 + (0.5 * between) ** 2 + FINE_M**2 / 12.0))


GREEN_CELLS: Final = pa.schema(
    [
        ("column", pa.int64()), ("row", pa.int64()), ("height_m", pa.float64()), ("probability", pa.float64()),
        ("returns", pa.int64()), ("passes", pa.list_(pa.int32())), ("first_epoch_gps_ns", pa.int64()),
        ("last_epoch_gps_ns", pa.int64()), ("mask", pa.int32()), ("sigma_m", pa.float64()),
    ]
)  # fmt: skip
"""A row a cell at green ground: the columns of landscape areas; a bit of the mask for each fine cell that is planted
(the first in the south-west, row by row), 0 where none is; and σ of an edge there."""
BESIDE_CELLS: Final = 2
"""Cells so near to green ground say that they are none."""
_TOLD: Final = 20
"""Fine cells that must be told, so that a cell is."""


def green_rows(
    mosaic: Mosaic, first: tuple[int, int], cells: pa.Table, box: tuple[float, float, float, float]
) -> pa.Table:
    """Returns rows of `GREEN_CELLS`: cells of a box of the map that are green, and told ones beside them.

    first : row and column of the first cell of the mosaic. cells : rows of the ground. box : west, south, east, north.
    """

    def cellwise(values: Any) -> Any:
        rows, columns = (n // FINE for n in values.shape)
        return values.reshape(rows, FINE, columns, FINE).transpose(0, 2, 1, 3).reshape(rows, columns, FINE * FINE)

    bits = (1 << np.arange(FINE * FINE)).astype(np.int64)
    green = cellwise(mosaic.green)
    mask = green @ bits
    told = cellwise(mosaic.told).sum(axis=2) >= _TOLD
    size = 2 * BESIDE_CELLS + 1
    beside = cv2.dilate((mask > 0).astype(np.uint8), np.ones((size, size), np.uint8)) > 0
    wanted = (mask > 0) | (told & beside)
    ratio = np.where(green, cellwise(mosaic.greenness), 0.0).sum(axis=2) / np.maximum(green.sum(axis=2), 1) / _GREEN
    probability = ratio**2 / (1.0 + ratio**2)
    sigma = cellwise(mosaic.sigma_m).mean(axis=2)
    column, row = (cells[name].to_numpy() for name in ("column", "row"))
    east, north = (column + 0.5) * CELL_M, (row + 0.5) * CELL_M
    own = np.flatnonzero((east > box[0]) & (east < box[2]) & (north > box[1]) & (north < box[3]))
    own = own[wanted[row[own] - first[0], column[own] - first[1]]]
    at = row[own] - first[0], column[own] - first[1]
    held = cells.take(pa.array(own))
    columns = {name: held[name] for name in GREEN_CELLS.names if name in held.column_names}
    columns |= {"probability": probability[at], "mask": mask[at].astype(np.int32), "sigma_m": sigma[at]}
    return pa.table([columns[name] for name in GREEN_CELLS.names], names=GREEN_CELLS.names).cast(GREEN_CELLS)
