"""The scene of an asset tile: bare earth, heights above it, and the class of each return."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets import classes
from roadscan.assets.cubes import cubes_of
from roadscan.assets.ground.bare_earth import bare_earth
from roadscan.assets.ground.surface import Place
from roadscan.assets.moving import road_users
from roadscan.assets.returns import Returns
from roadscan.assets.scene import Box, Scene
from roadscan.model.asset_ground import GroundSettings

_ABOVE_M: Final = 0.1
"""Returns are looked at that do not lie on the ground and stand higher above it."""


def make_scene(
    returns: Returns,
    tile: Box,
    window: Box,
    drive_xyh_m: npt.NDArray[np.float64],
    settings: GroundSettings | None = None,
) -> Scene:
    """Scene of an asset tile, a pure function of its arguments.

    Parameters
    ----------
    returns : those of the window, in canonical order.
    tile, window : the tile without and with its halo (m, from the corner that returns count from).
    drive_xyh_m : (p, 4) x, y and height of the sensor (m) and the pass, in the order of time.
    settings : of bare earth; its defaults where left out.
    """
    drive = np.asarray(drive_xyh_m, np.float64).reshape(-1, 4)
    ground = bare_earth(Place(returns, window, drive, settings if settings is not None else GroundSettings()))
    found = np.full(len(returns), classes.UNCLASSIFIED, np.uint8)
    found[ground.on_ground] = classes.GROUND
    found[ground.below] = classes.LOW_NOISE
    above = ~ground.on_ground & (ground.above_m > _ABOVE_M)
    cubes = cubes_of(returns, ground.above_m, above, window)
    users = road_users(returns, ground.above_m, ground.on_ground, cubes, window)
    found[users.vehicle] = classes.VEHICLE
    found[users.person] = classes.PERSON
    return Scene(returns, tile, window, ground.model, ground.above_m, found, drive)
