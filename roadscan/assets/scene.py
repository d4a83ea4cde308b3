"""Scenes, the input of the detection of assets: returns with height above the ground and class."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.assets.kernels.beams import ground_heights
from roadscan.assets.returns import Returns
from roadscan.assets.statistics import Statistics
from roadscan.compute.array_types import Float32, Float64
from roadscan.compute.kernel_options import read_only

_AROUND_M, _STEP_M = 2.0, 3.0  # Margin around the returns, and step of the extent (m).


class Box(NamedTuple):
    """A rectangle, coordinates as those of returns (m); it includes its least edges and excludes the greatest."""

    x_min_m: float
    y_min_m: float
    x_max_m: float
    y_max_m: float

    def holds(self, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Returns a mask of the points (any shape) in the rectangle."""
        x, y = np.asarray(x_m), np.asarray(y_m)
        return (x >= self.x_min_m) & (x < self.x_max_m) & (y >= self.y_min_m) & (y < self.y_max_m)

    def comes_near(self, places_m: Float64, reach_m: float) -> bool:
        """Returns whether the box around places (n, 2), grown by a reach on all sides, intersects the rectangle."""
        (west, south), (east, north) = places_m.min(axis=0) - reach_m, places_m.max(axis=0) + reach_m
        return bool(west < self.x_max_m and east >= self.x_min_m and south < self.y_max_m and north >= self.y_min_m)


def extent_of(window: Box, returns: Returns) -> Box:
    """Returns the part of a window with returns, 2 m wider and in steps of 3 m from its south-western corner.

    3 m is a whole number of the cells of all rasters, so these have the same cells as over the whole window.
    """
    if not len(returns):
        return window
    sides = []
    for least, greatest, values in zip(window[:2], window[2:], (returns.x_m, returns.y_m), strict=True):
        first = math.floor((float(values.min()) - _AROUND_M - least) / _STEP_M)
        last = math.floor((float(values.max()) + _AROUND_M - least) / _STEP_M) + 1
        sides.append((least + _STEP_M * max(first, 0), min(least + _STEP_M * last, greatest)))
    (west, east), (south, north) = sides
    return Box(west, south, east, north)


@dataclass(frozen=True, eq=False)
class GroundModel:
    """Bare earth as a raster: row 0 is the southern one, column 0 the western one."""

    x_min_m: float
    y_min_m: float
    cell_m: float
    height_m: Float32
    """(rows, columns) height at the middle of each cell; NaN where none is known near."""
    seen: npt.NDArray[np.bool_]
    """(rows, columns) True where ground was seen; elsewhere the height is interpolated between seen cells."""
    sigma_m: Float32 | None = None
    """(rows, columns) 1 σ of the heights (m): the noise of returns where ground was seen, more with the distance from
    there elsewhere; NaN where the height is."""

    def height_at(self, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> Float64:
        """Returns the height (as the points) of bare earth, bilinear between cells; NaN where it is not known."""
        x, y = np.broadcast_arrays(np.asarray(x_m, np.float64), np.asarray(y_m, np.float64))
        out, places = np.empty(x.size), (np.ascontiguousarray(v).reshape(-1) for v in (x, y))
        grid = (float(self.x_min_m), float(self.y_min_m), float(self.cell_m))
        ground_heights(*map(read_only, places), grid, self.height_m, out)
        return out.reshape(x.shape)


@dataclass(frozen=True, eq=False)
class Scene:
    """An asset tile with its halo. Evidence found in it is a pure function of it."""

    returns: Returns
    tile: Box
    """The tile itself: a piece belongs to the tile that contains its reference point, lines and areas are cut at it."""
    window: Box
    """The tile with its halo."""
    ground: GroundModel
    above_ground_m: Float32
    """(n,) height of each return above bare earth; NaN where that is not known."""
    classes: npt.NDArray[np.uint8]
    """(n,) class of each return (:mod:`roadscan.assets.classes`): ground, vegetation, building, vehicle, person …"""
    drive_xyh_m: Float64
    """(p, 4) the drives through the window: x, y, height of the sensor, and the pass, in the order of time."""
    statistics: Statistics = field(default_factory=Statistics)
    whole: Scene | None = None
    """The scene of several tiles together that this one is a view of, with its own tile; None: it is none."""

    def of_tile(self, tile: Box) -> Scene:
        """Returns the same scene for one of its tiles: what does not depend on the tile is computed once for all."""
        return replace(self, tile=tile, whole=self)

    @cached_property
    def extent(self) -> Box:
        """Returns the part of the window with returns, 2 m wider and in steps of 3 m.

        Rasters are made over it; a window without returns is its own extent.
        """
        return extent_of(self.window, self.returns)
