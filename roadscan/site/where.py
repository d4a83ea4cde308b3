"""Finds pictures that see a place of the map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import ConfigError
from roadscan.core.grid import Bounds, TileId
from roadscan.georeference.plan.plan import plan_of, poses_plan_of
from roadscan.measuring.measure import pixel_covariance, posed_pictures
from roadscan.pictures.views import PictureRule, sights
from roadscan.run.session import Session
from roadscan.tiles.cells import read_cells
from roadscan.tiles.tasks.tile_plan import TILE

REACH_M: Final = 60.0
"""Default of the largest distance of a picture (m)."""
_NEAR_M: Final = 1.0
"""Distance within which cells give the height of a place (m)."""
_BORDER_PX: Final = 1  # least distance of the place from a picture's border
_WIDEST_SCALE: Final = 2.0  # upper bound on the scale of a map: Web Mercator reaches it at 60° latitude
_ANY_ANGLE_DEG: Final = -90.0  # accepts any angle between view and surface


@dataclass(frozen=True)
class PictureOfPlace:
    """A picture that sees a place, if nothing is between."""

    run: str
    camera: str
    file: Path
    u_px: float
    """From the centre of the upper left pixel to the right."""
    v_px: float
    """Downwards."""
    distance_m: float
    resolution_m: float
    """Size of a pixel at the place (m)."""
    sigma_u_px: float
    """1 σ of `u_px`, from those of pose, mounting, lens and the place itself."""
    sigma_v_px: float
    name: str
    """RUN/CAMERA/FILE."""


def pictures_of_place(
    session: Session, easting_m: float, northing_m: float, height_m: float | None = None, reach_m: float = REACH_M,
    sigma_m: npt.ArrayLike = (0.0, 0.0, 0.0),
) -> list[PictureOfPlace]:  # fmt: skip
    """Return the pictures that see a place of the map, the one with the finest resolution first.

    Parameters
    ----------
    easting_m, northing_m, height_m : place on the map (m); without a height that of the surveyed ground there.
    reach_m : farthest distance from a camera.
    sigma_m : 1 σ of easting, northing and height, where the place is known so.

    Raises
    ------
    ConfigError
        where no cell gives the height of the place; where no camera has an interior orientation.
    RunError
        where the survey has no pictures, or none has a pose.
    """
    if height_m is None:
        height_m = ground_height_m(session, easting_m, northing_m)
    rule = PictureRule((), reach_m, _ANY_ANGLE_DEG, _BORDER_PX)
    poses = posed_pictures(session)
    pictures, frame = poses.pictures, poses_plan_of(session).ground.map
    place = np.array([easting_m, northing_m, height_m])
    worlds = [frame.world_from_map(world, place[None])[None] for world in pictures.worlds]
    no_front = [np.full((1, 3), np.nan)] * len(worlds)
    widest = _WIDEST_SCALE * reach_m
    within = np.flatnonzero(np.hypot(*(poses.place_m[:, :2] - place[:2]).T) <= widest)
    near = ((number, np.zeros(1, np.int64)) for number in within.tolist())
    seen = sights(worlds, no_front, pictures.views, rule, near)
    covariance = np.diag(np.square(np.asarray(sigma_m, np.float64)))
    found = []
    for view, (u, v), distance, resolution in zip(
        seen.view.tolist(), seen.pixel.tolist(), seen.distance_m.tolist(), seen.resolution_m.tolist(), strict=True
    ):
        log = pictures.logs[pictures.log[view]]
        point = pictures.views.opencv_from_world[view] @ (
            worlds[pictures.views.world[view]][0, 0] - pictures.views.eye_world_m[view]
        )
        across, down = np.sqrt(np.diag(pixel_covariance(poses, view, point, covariance))).tolist()
        file, name = pictures.path(view), pictures.name(view)
        found.append(PictureOfPlace(log.run, log.sensor, file, u, v, distance, resolution, across, down, name))
    return found


def ground_height_m(session: Session, easting_m: float, northing_m: float) -> float:
    """Return the median height of the cells within a metre of a place (m).

    Raises
    ------
    ConfigError
        where there is none.
    """
    grid = plan_of(session).ground.grid
    box = Bounds(easting_m - _NEAR_M, northing_m - _NEAR_M, easting_m + _NEAR_M, northing_m + _NEAR_M)
    heights = [np.empty(0, np.float32)]
    for record in session.manifest.of(TILE).values():
        if not record.path or not grid.bounds(TileId.parse(record.unit)).meets(box):
            continue
        cells = read_cells(session.store, record, grid.cells_per_edge)
        corner = grid.bounds(cells.tile)
        east = corner.easting_min_m + (cells.column + 0.5) * grid.cell_m - easting_m
        north = corner.northing_min_m + (cells.row + 0.5) * grid.cell_m - northing_m
        heights.append(cells.height_robust_m[np.hypot(east, north) <= _NEAR_M])
    known = np.concatenate(heights)
    known = known[np.isfinite(known)]
    if not known.size:
        raise ConfigError(
            f"no cell lies within {_NEAR_M:g} m of {easting_m:.3f} {northing_m:.3f}",
            expected="a place on the surveyed ground", change="state its height as well",
        )  # fmt: skip
    return float(np.median(known))
