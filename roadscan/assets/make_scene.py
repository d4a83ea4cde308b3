"""Scenes of asset tiles: bare earth, heights above it, and the class of each return."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets import classes
from roadscan.assets.ground.bare_earth import bare_earth, road_cells
from roadscan.assets.ground.surface import Place
from roadscan.assets.kernels.columns import marked
from roadscan.assets.moving import REACH_M as ROAD_USERS_M
from roadscan.assets.road_users import road_users
from roadscan.assets.scene import LINES_M, Box, GroundModel, Returns, Scene, Statistics, extent_of
from roadscan.assets.settings import GroundSettings
from roadscan.assets.surroundings import REACH_M as SURROUNDINGS_M
from roadscan.assets.surroundings import cubes_of, surroundings
from roadscan.compute.array_types import Bool, Float64

CLASSES_REACH_M: Final = max(ROAD_USERS_M, SURROUNDINGS_M)
"""What lies farther away (m) does not change the class of a return that does not lie on the ground."""
_ABOVE_M: Final = 0.1
"""Returns are classified that do not lie on the ground and stand higher above it than this (m)."""


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
    if around is not None:
        rows = np.flatnonzero(window.holds(returns.x_m, returns.y_m))
        returns, ground, found = returns.at(rows), ground.within(rows, window), found[rows]
    return Scene(returns, tile, window, ground.model, ground.above_m, found, drive, statistics, beyond_m=beyond)


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
