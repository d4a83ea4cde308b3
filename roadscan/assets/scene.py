"""Scenes, the input of the detection of assets: returns with height above the ground and class; statistics, cache."""

from __future__ import annotations

import functools
import math
import weakref
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Final, NamedTuple, Self, TypeVar, cast

import numpy as np
import numpy.typing as npt

from roadscan.assets.kernels.beams import ground_heights
from roadscan.assets.quantiles import weighted_quantile
from roadscan.compute.array_types import Bool, Float32, Float64
from roadscan.compute.kernel_options import read_only

LINES_M: Final = 30.0
"""Sight lines that end farther from a thing than this (m) do not tell what stands there: squares are searched with what
lies so far around them, since bare earth reads farther."""
SAME_LEVEL_M: Final = 1.5
"""Heights of one road differ by less in one place (m): roads over one another are 3 m or more apart."""


@dataclass(frozen=True, eq=False)
class Returns:
    """Returns (n,) of an asset tile and its halo, in canonical order, so that equal readings give equal bytes.

    Coordinates count from `corner_m`, a corner of the tile in the map: x to the east, y to the north (m). Heights are
    those of the map frame.
    """

    corner_m: tuple[float, float]
    """Easting and northing of the corner from which x and y count (m)."""
    x_m: Float64
    y_m: Float64
    height_m: Float64
    intensity: Float32
    """As recorded, or calibrated where the survey has gains (`calibrated`); digital numbers of 16 bits."""
    epoch_gps_ns: npt.NDArray[np.int64]
    pass_id: npt.NDArray[np.uint16]
    """Number of the pass of the survey that saw it: a drive of a lane."""
    sensor: npt.NDArray[np.uint8]
    """Number of the sensor, an index of `sensors`."""
    laser: npt.NDArray[np.uint16]
    """Laser of the sensor (ring), 0 for scanners with one."""
    return_number: npt.NDArray[np.uint8]
    """1 for the first return of a pulse."""
    number_of_returns: npt.NDArray[np.uint8]
    sensor_x_m: Float64
    """Position of the sensor when it saw the return: x, y from `corner_m` and height, like those of the return."""
    sensor_y_m: Float64
    sensor_height_m: Float64
    sensors: tuple[str, ...] = ()
    """Names of the sensors."""
    divergence_deg: tuple[float, ...] = ()
    """Full angle of the beam of each sensor (degrees), NaN where it is not known; empty: of none."""
    calibrated: bool = False
    evened: Float32 | None = None
    """(n,) intensity with the gains of lasers alone; None: as `intensity`."""

    def __len__(self) -> int:
        return int(self.x_m.size)

    @property
    def range_m(self) -> Float64:
        """Returns the distance (n,) from the sensor to the return (m)."""
        return self.ranges_m(slice(None))

    def ranges_m(self, rows: npt.NDArray[np.integer[Any]] | slice) -> Float64:
        """Returns the distance (k,) from the sensor to some returns (m)."""
        away = self.x_m[rows] - self.sensor_x_m[rows], self.y_m[rows] - self.sensor_y_m[rows]
        return np.sqrt(away[0] ** 2 + away[1] ** 2 + (self.height_m[rows] - self.sensor_height_m[rows]) ** 2)

    @property
    def light(self) -> Float32:
        """Returns the light (n,) that came back, lasers made alike; it still falls with range and incidence."""
        return self.intensity if self.evened is None else self.evened

    def half_beam_rad(self, rows: npt.NDArray[np.integer[Any]]) -> Float64:
        """Returns half the angle (n,) of the beams of some returns (rad); NaN where it is not known."""
        known = np.full(256, np.nan)
        known[: len(self.divergence_deg)] = np.radians(self.divergence_deg) / 2.0
        return np.asarray(known[self.sensor[rows]])

    def at(self, rows: Bool | npt.NDArray[np.integer[Any]]) -> Self:
        """Returns the returns at `rows`, a mask (n,) or indices."""
        chosen = np.flatnonzero(rows) if rows.dtype == np.bool_ else rows  # of a mask each column would seek them anew
        arrays: dict[str, Any] = {
            f.name: v[chosen] for f in fields(self) if isinstance(v := getattr(self, f.name), np.ndarray)
        }
        return replace(self, **arrays)


Values = npt.NDArray[np.floating[Any]]

_NODES: Final = 65
"""A sample stores its values as so many quantiles, from which those of all samples follow to about a hundredth."""


class Measured(NamedTuple):
    """Values of a statistic in one scene."""

    share: float
    """The statistic is the quantile of this share."""
    quantiles: tuple[float, ...]
    """Quantiles of the values at even shares."""
    number: int


class Statistics:
    """Statistics by name. One that the survey does not give is measured in the scene that asks for it.

    A scene's own noise or brightness would make its results depend on how squares are cut: so samples of the survey are
    measured, and every square is searched by what all of them tell together.
    """

    def __init__(self, known: Mapping[str, float] | None = None) -> None:
        self._known: dict[str, float] = dict(known or {})
        self.measured: dict[str, Measured] = {}
        """What scenes measured since."""
        self._own: dict[str, float] = {}

    def known(self, name: str) -> float | None:
        """Returns a statistic of the survey; None where it gives none."""
        return self._known.get(name)

    def of(self, name: str, share: float, values: Callable[[], Values]) -> float | None:
        """Returns a statistic: a quantile of values (n,), which are asked for where the survey does not give it."""
        if name in self._known:
            return self._known[name]
        if name not in self._own:
            found = values()
            if not found.size:
                return None
            nodes = np.quantile(found, np.linspace(0.0, 1.0, _NODES)).tolist()
            self.measured[name] = Measured(share, tuple(nodes), int(found.size))
            self._own[name] = float(np.quantile(found, share))
        return self._own[name]


def together(measured: Iterable[Mapping[str, Measured]]) -> dict[str, tuple[float, int]]:
    """Returns each statistic over all values of the samples, and how many samples tell it."""
    found: dict[str, list[Measured]] = {}
    for one in measured:
        for name, value in one.items():
            found.setdefault(name, []).append(value)
    return {name: (_quantile(some), len(some)) for name, some in sorted(found.items())}


def _quantile(some: list[Measured]) -> float:
    values = np.concatenate([one.quantiles for one in some])
    weights = np.repeat([one.number for one in some], _NODES)
    return weighted_quantile(values, weights, some[0].share)


_AROUND_M, _STEP_M = 2.0, 3.0  # Margin around the returns, and step of the extent (m).


class Box(NamedTuple):
    """A rectangle, coordinates as those of returns (m); it includes its least edges and excludes the greatest."""

    x_min_m: float
    y_min_m: float
    x_max_m: float
    y_max_m: float

    def holds(self, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> Bool:
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
    seen: Bool
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
    """(p, 4) the drives through the window on the ground: x, y, height of the sensor, and the pass, in the order of
    time."""
    statistics: Statistics = field(default_factory=Statistics)
    whole: Scene | None = None
    """The scene of several tiles together that this one is a view of, with its own tile; None: it is none."""
    beyond_m: Float64 = field(default_factory=lambda: np.zeros((6, 0)))
    """(6, k) sight lines that end up to :data:`LINES_M` outside of the window: x, y, height of the sensor and of the
    return."""
    hidden_xyh_m: Float64 = field(default_factory=lambda: np.zeros((0, 4)))
    """(l, 4) places of the drives where the ground is another level: x, y, height of their road (NaN where it is not
    known), and the pass."""

    def of_tile(self, tile: Box) -> Scene:
        """Returns the same scene for one of its tiles: what does not depend on the tile is computed once for all."""
        return replace(self, tile=tile, whole=self)

    @cached_property
    def extent(self) -> Box:
        """Returns the part of the window with returns, 2 m wider and in steps of 3 m.

        Rasters are made over it; a window without returns is its own extent.
        """
        return extent_of(self.window, self.returns)


Find = TypeVar("Find", bound=Callable[..., Any])


def once_a_tile(find: Find) -> Find:
    """Returns the same function of a scene and options, which is computed once while the scene is in memory."""
    known: weakref.WeakKeyDictionary[Scene, dict[object, Any]] = weakref.WeakKeyDictionary()

    @functools.wraps(find)
    def remembered(scene: Scene, *options: object) -> Any:
        found = known.setdefault(scene, {})
        if options not in found:
            found[options] = find(scene, *options)
        return found[options]

    return cast(Find, remembered)


def once_a_scene(find: Find) -> Find:
    """Returns the same function, which is computed once for all tiles of a scene together."""
    remembered = once_a_tile(find)

    @functools.wraps(find)
    def of_whole(scene: Scene, *options: object) -> Any:
        return remembered(scene if scene.whole is None else scene.whole, *options)

    return cast(Find, of_whole)
