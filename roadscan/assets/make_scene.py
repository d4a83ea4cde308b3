"""Scenes of asset tiles: bare earth, heights above it, and the class of each return."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets import classes
from roadscan.assets.bins import cells_of
from roadscan.assets.ground.bare_earth import ROAD_REACH_M, bare_earth, road_cells
from roadscan.assets.ground.surface import Place
from roadscan.assets.kernels.columns import marked
from roadscan.assets.moving import REACH_M as ROAD_USERS_M
from roadscan.assets.road_users import road_users
from roadscan.assets.scene import LINES_M, SAME_LEVEL_M, Box, GroundModel, Returns, Scene, Statistics, extent_of
from roadscan.assets.settings import GroundSettings
from roadscan.assets.surroundings import REACH_M as SURROUNDINGS_M
from roadscan.assets.surroundings import cubes_of, surroundings
from roadscan.compute.array_types import Bool, Float64

CLASSES_REACH_M: Final = max(ROAD_USERS_M, SURROUNDINGS_M)
"""What lies farther away (m) does not change the class of a return that does not lie on the ground."""
_ABOVE_M: Final = 0.1
"""Returns are classified that do not lie on the ground and stand higher above it than this (m)."""
_SENSOR_UP_M: Final = (-1.0, 4.5)
"""Sensors, and origins of vehicles, are so high above the road (m, from and to): road vehicles are 4 m high at most;
a sensor 1.5 m above a bridge over a path with 2.5 m of room is 4.5 m or more above that path."""
_DECK_M: Final = 0.25
"""Ground of a deck is as high as its drive within this (m): the fall of a carriageway, and a sidewalk."""
_ON_DECK: Final = (
    classes.UNCLASSIFIED, classes.HIGH_VEGETATION, classes.BUILDING, classes.BRIDGE_DECK, classes.HIGH_NOISE,
    classes.OVERHEAD_STRUCTURE,
)  # fmt: skip
"""What ground of a deck is called, seen from the ground below it."""


def make_scene(
    returns: Returns,
    tile: Box,
    window: Box,
    drive_xyh_m: npt.NDArray[np.float64],
    settings: GroundSettings | None = None,
    around: tuple[Box, Box] | None = None,
    statistics: Statistics | None = None,
) -> Scene:
    """Returns the scene of an asset tile, a pure function of its arguments.

    Parameters
    ----------
    returns : those of the window, or of the last of `around`, in canonical order.
    tile, window : the tile without and with its halo (m, from the corner that returns count from).
    drive_xyh_m : (p, 4) x, y and height of the sensor (m) and the pass, in the order of time.
    settings : of bare earth; its defaults where left out.
    around : the windows in which returns are classified, and whose returns tell of bare earth, each as wide as the one
        before or wider; `window` where left out.
    statistics : those of the survey; what is left out is measured in the scene.
    """
    drive = np.asarray(drive_xyh_m, np.float64).reshape(-1, 4)
    settings = settings if settings is not None else GroundSettings()
    statistics = statistics if statistics is not None else Statistics()
    wider, widest = (window, window) if around is None else around
    ground = bare_earth(Place(returns, widest, settings, statistics))
    drive, hidden = by_level(drive, ground.model)
    beyond = lines_beyond(returns, window)
    if around is not None:
        rows = np.flatnonzero(wider.holds(returns.x_m, returns.y_m))
        returns, ground = returns.at(rows), ground.within(rows, wider)
    found = np.full(len(returns), classes.UNCLASSIFIED, np.uint8)
    found[ground.on_ground] = classes.GROUND
    found[ground.below] = classes.LOW_NOISE
    above = ~ground.on_ground & (ground.above_m > _ABOVE_M)
    extent = extent_of(wider, returns)
    cubes = cubes_of(returns, ground.above_m, above, extent)
    users = road_users(returns, ground.above_m, ground.on_ground, cubes, extent, drive)
    found[users.vehicle] = classes.VEHICLE
    found[users.person] = classes.PERSON
    found = surroundings(returns, ground.above_m, found, cubes, extent, drive)
    found[ground.on_ground & on_road(returns, ground.model, drive)] = classes.ROAD
    mark_decks(found, returns, ground.model, hidden)
    if around is not None:
        rows = np.flatnonzero(window.holds(returns.x_m, returns.y_m))
        returns, ground, found = returns.at(rows), ground.within(rows, window), found[rows]
    return Scene(returns, tile, window, ground.model, ground.above_m, found, drive, statistics, None, beyond, hidden)


def by_level(drive_xyh_m: Float64, model: GroundModel) -> tuple[Float64, Float64]:
    """Returns the places (k, 4) of drives on the ground of the raster, and those (l, 4) on a road above or below it.

    The latter have the height of their road: that of the sensor less what it usually is above the raster in the pass;
    NaN where it never is as high above it as that of a vehicle. If that is so of all passes, nothing tells of levels.
    """
    up = drive_xyh_m[:, 2] - model.height_at(drive_xyh_m[:, 0], drive_xyh_m[:, 1])
    likely = (up >= _SENSOR_UP_M[0]) & (up <= _SENSOR_UP_M[1])
    usual = np.full(up.size, np.nan)
    for number in np.unique(drive_xyh_m[likely, 3]).tolist():
        of_pass = drive_xyh_m[:, 3] == number
        usual[of_pass] = np.median(up[of_pass & likely])
    other = np.isfinite(up) & ~(np.abs(up - usual) <= SAME_LEVEL_M) & likely.any()
    hidden = drive_xyh_m[other]
    hidden[:, 2] -= usual[other]
    return drive_xyh_m[~other], hidden


def mark_decks(found: npt.NDArray[np.uint8], returns: Returns, model: GroundModel, hidden_xyh_m: Float64) -> None:
    """Set the classes (n,) of returns on roads above the raster of bare earth to ground and road.

    hidden_xyh_m : (l, 4) drives on them, as :func:`by_level` gives them.
    """
    drive = hidden_xyh_m[hidden_xyh_m[:, 2] > model.height_at(hidden_xyh_m[:, 0], hidden_xyh_m[:, 1])]
    if not len(drive):
        return
    from scipy.spatial import cKDTree

    least, most = drive[:, :2].min(axis=0) - ROAD_REACH_M, drive[:, :2].max(axis=0) + ROAD_REACH_M
    from_above = returns.sensor_height_m > returns.height_m
    rows = np.flatnonzero(Box(*least, *most).holds(returns.x_m, returns.y_m) & from_above)
    places = np.column_stack([returns.x_m[rows], returns.y_m[rows]])
    at = cKDTree(drive[:, :2]).query(places, distance_upper_bound=ROAD_REACH_M)[1]
    level = np.append(drive[:, 2], np.nan)[at]
    rows = rows[(np.abs(returns.height_m[rows] - level) <= _DECK_M) & np.isin(found[rows], _ON_DECK)]
    grid, shape = (model.x_min_m, model.y_min_m, model.cell_m), model.height_m.shape
    cell = cells_of(returns.x_m[rows], returns.y_m[rows], grid, shape)
    number = np.bincount(cell[cell >= 0], minlength=model.seen.size)
    total = np.bincount(cell[cell >= 0], returns.height_m[rows[cell >= 0]], model.seen.size)
    height = np.divide(total, number, out=np.full(number.size, np.nan), where=number > 0)
    deck = GroundModel(*grid, height.reshape(shape).astype(np.float32), (number > 0).reshape(shape))
    found[rows] = np.where(on_road(returns.at(rows), deck, drive), classes.ROAD, classes.GROUND)


def lines_beyond(returns: Returns, window: Box) -> Float64:
    """Returns the sight lines (6, k) that end outside of a window, not farther than those of shafts are followed."""
    wider = Box(*(side - LINES_M for side in window[:2]), *(side + LINES_M for side in window[2:]))
    rows = np.flatnonzero(wider.holds(returns.x_m, returns.y_m) & ~window.holds(returns.x_m, returns.y_m))
    return np.stack([
        returns.sensor_x_m[rows], returns.sensor_y_m[rows], returns.sensor_height_m[rows], returns.x_m[rows],
        returns.y_m[rows], returns.height_m[rows],
    ])  # fmt: skip


def on_road(returns: Returns, model: GroundModel, drive_xyh_m: npt.NDArray[np.float64]) -> Bool:
    """Returns a mask (n,) of the returns above cells that are known to be road."""
    cells = road_cells(model, drive_xyh_m).astype(np.int32)
    at = np.empty(len(returns), np.int32)
    corner, always = np.array([model.x_min_m, model.y_min_m]), np.array([-np.inf, -np.inf])
    flat = np.zeros(len(returns), np.float32)
    marked(returns.x_m, returns.y_m, flat, corner, 1.0 / model.cell_m, cells, always, -always, at)
    return np.asarray(at > 0)
