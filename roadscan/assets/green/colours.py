"""Greenness of ground cells in one picture, and whether the picture may be believed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import pyarrow as pa

from roadscan.assets.green.cells import CELL_M
from roadscan.compute.array_types import Bool, Float64, Int64, UInt8
from roadscan.core.grid import Bounds
from roadscan.pictures.colours import world_places
from roadscan.pictures.placed import Pictures
from roadscan.pictures.views import NO_VIEW, best_views, sampled

FINE: Final = 5
"""A cell has so many fine cells along each side."""
FINE_M: Final = CELL_M / FINE
REACH_M: Final = 20.0
"""Ground farther from the camera (m) is not looked at."""
_WIDEST_M: Final = 0.4
"""Nor is ground of which a pixel spans more than this along the ray (m)."""
_DRIVEN_M: Final = 1.5
"""Ground this near to a drive (m) is paved: its colour is that of grey things in the picture's light."""
_LEAST_PAVED: Final = 40  # Least number of such cells in a picture.
_DARK, _BRIGHT = 14, 250  # Values that are too noisy, and those that saturate (digital numbers).
_DIM: Final = 30.0  # Paved ground darker than this (digital numbers) is that of a picture by night.
_GREY: Final = 2  # Largest difference of channels in a picture without colours (digital numbers).
_PAINT: Final = 0.4
"""Red over green, relative to paved ground: grass is 0.5 to 1, green paint below 0.3."""
_SHIFTS_M: Final = (0.75, 1.5, 3.0)
"""How far a picture of a wrong time or pose is sought from its place (m)."""
_BETTER: Final = 0.25
"""Correlation with the intensity of the lidar that another place must have more, to disprove a picture."""
_CORRELATED: Final = 0.4  # Least correlation that tells a place.
_LEAST_CELLS: Final = 150  # Cells with returns for that.
_BOX_CELLS: Final = 9
"""Edge of the squares of cells whose mean is taken from brightness and intensity: slow changes tell no place."""


@dataclass(frozen=True, eq=False)
class Ground:
    """Cells (n,) of the ground around a square, by row and column."""

    column: Int64
    row: Int64
    height_m: Float64
    intensity: Float64
    """Mean of the low returns; NaN without any."""
    drive_m: Float64
    stands: Bool
    slope: Float64
    """(n, 2) rise to the east and to the north (m/m)."""

    @property
    def places_m(self) -> Float64:
        """Returns easting, northing and height (n, 3) of the cells' middles."""
        return np.column_stack([(self.column + 0.5) * CELL_M, (self.row + 0.5) * CELL_M, self.height_m])

    def fine_steps_m(self, cells: Int64) -> Float64:
        """Returns the steps (k, 25, 3) from the middles of some cells to those of their fine cells, row by row."""
        at = (np.arange(FINE) - FINE // 2) * FINE_M
        north, east = (a.ravel() for a in np.meshgrid(at, at, indexing="ij"))
        slope = self.slope[cells]
        level = np.broadcast_to(np.column_stack([east, north]), (len(cells), FINE * FINE, 2))
        return np.concatenate([level, (slope[:, :1] * east + slope[:, 1:] * north)[..., None]], axis=2)


@dataclass(frozen=True, eq=False)
class PlacedGround:
    """Cells of the ground, and their places (n, 3) in the world frames of the pictures."""

    cells: Ground
    worlds_m: tuple[Float64, ...]
    steps: tuple[Float64, ...]
    """(3, 3) a step on the map as one in each world: over a few metres they are the same everywhere in a square."""

    @classmethod
    def of(cls, cells: Ground, pictures: Pictures) -> PlacedGround:
        """Returns cells as pictures count them."""
        places = cells.places_m
        ends = places.mean(axis=0) + np.vstack([np.zeros(3), np.eye(3)]) if len(places) else np.zeros((4, 3))
        corners = [world_places(pictures, world, ends) for world in pictures.worlds]
        worlds = tuple(world_places(pictures, world, places) for world in pictures.worlds)
        return cls(cells, worlds, tuple(one[1:] - one[0] for one in corners))

    def stepped(self, cells: Int64, steps_m: Float64) -> list[Float64]:
        """Returns places (k, …, 3) in each world: of some cells, after steps on the map (…, 3)."""
        return [
            np.ascontiguousarray(world[cells].reshape(-1, *(1,) * (steps_m.ndim - 2), 3) + steps_m @ turn)
            for world, turn in zip(self.worlds_m, self.steps, strict=True)
        ]


def ground_of(rows: pa.Table, box: Bounds) -> tuple[Ground, pa.Table]:
    """Returns the cells in a box of rows of `GROUND_CELLS`, by row and column, and their rows."""
    column, row = (rows[name].to_numpy() for name in ("column", "row"))
    least, most = (
        (round(e / CELL_M), round(n / CELL_M))
        for e, n in ((box.easting_min_m, box.northing_min_m), (box.easting_max_m, box.northing_max_m))
    )
    inside = (column >= least[0]) & (column < most[0]) & (row >= least[1]) & (row < most[1])
    held = np.flatnonzero(inside)
    held = held[np.lexsort((column[held], row[held]))]
    own = rows.take(pa.array(held)).combine_chunks()
    column, row, height = column[held], row[held], own["height_m"].to_numpy()
    raster = np.full((most[1] - least[1] + 2, most[0] - least[0] + 2), np.nan)
    at = row - least[1] + 1, column - least[0] + 1
    raster[at] = height
    slope = np.zeros((held.size, 2))
    for axis, (r, c) in enumerate(((0, 1), (1, 0))):
        rise = (raster[at[0] + r, at[1] + c] - raster[at[0] - r, at[1] - c]) / (2.0 * CELL_M)
        slope[:, axis] = np.nan_to_num(rise)
    ground = Ground(
        column, row, height, own["intensity"].to_numpy().astype(np.float64),
        own["drive_m"].to_numpy().astype(np.float64), own["stands"].to_numpy(zero_copy_only=False), slope,
    )  # fmt: skip
    return ground, own


class Elsewhere:
    """A picture that does not lie where its time and pose say."""


@dataclass(frozen=True, eq=False)
class Look:
    """What one picture tells of k cells."""

    cells: Int64
    index: Float64
    """(k, 25) greenness of the fine cells; NaN where it is not told."""
    pixel_m: Float64
    """(k,) how much of the ground a pixel spans along the ray (m)."""
    colour: UInt8
    """(k · 25, 3) red, green, blue of the fine cells."""
    shown: Bool
    """(k · 25,) where the picture shows them."""


def linear(colours: UInt8) -> Float64:
    """Returns linear light (IEC 61966-2-1) of colours (…, 3)."""
    c = np.arange(256) / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)[colours]


def greenness(colours: UInt8, paved: Float64) -> Float64:
    """Returns by how much the share of green exceeds the greater of the others (n,); NaN where a colour tells nothing.

    Shares are those of linear light over that of paved ground (3,), so that exposure, light and white balance fall
    out. Grey is 0, grass 0.05 to 0.3. Saturated green, as of paint, counts as grey.
    """
    light = linear(colours) / paved
    total = light.sum(axis=-1)
    share = light / np.maximum(total, 1e-9)[..., None]
    index = share[..., 1] - np.maximum(share[..., 0], share[..., 2])
    index = np.where((index > 0.0) & (light[..., 0] < _PAINT * light[..., 1]), 0.0, index)
    useless = (colours.max(axis=-1) < _DARK) | (colours.max(axis=-1) >= _BRIGHT)
    return np.where(useless, np.nan, index)


def looked_at(
    picture: UInt8, pictures: Pictures, number: int, placed: PlacedGround, hidden: Callable[[Float64], Bool]
) -> Look | Elsewhere | None:
    """Returns what a picture tells of the ground; None where it tells nothing.

    hidden : says of places (n, 3) which of them something hides from it.
    """
    one = pictures.chosen(np.array([number]))
    ground = placed.cells
    places = ground.places_m
    eye = one.map.map_from_world(one.worlds[int(one.views.world[0])], one.views.eye_world_m)[0]
    away = np.sqrt(((places - eye) ** 2).sum(axis=1))
    lens = one.views.lens_of(0).parameters
    pixel_m = away**2 / (np.maximum(eye[2] - places[:, 2], 0.1) * float(np.sqrt(lens[0] * lens[1])))
    near = np.flatnonzero((away <= REACH_M) & (pixel_m <= _WIDEST_M) & ~ground.stands)
    near = near[~hidden(places[near])]
    if near.size < _LEAST_PAVED:
        return None
    middle, seen = _colours(picture, one, placed.stepped(near, np.zeros((1, 3))))
    paved = seen & (ground.drive_m[near] <= _DRIVEN_M)
    if np.count_nonzero(paved) < _LEAST_PAVED:
        return None
    own = middle[paved]
    if np.median(own) < _DIM or np.quantile(np.ptp(middle[seen].astype(np.int16), axis=1), 0.98) <= _GREY:
        return None
    reference = np.maximum(np.median(linear(own), axis=0), 1e-4)
    if _lies_elsewhere(picture, one, placed, near[seen]):
        return Elsewhere()
    cells = near[seen]
    colour, shown = _colours(picture, one, placed.stepped(cells, ground.fine_steps_m(cells)))
    index = np.where(shown, greenness(colour, reference), np.nan).reshape(-1, FINE * FINE)
    return Look(cells, index, pixel_m[cells], colour, shown)


def _colours(picture: UInt8, one: Pictures, worlds_m: list[Float64]) -> tuple[UInt8, Bool]:
    """Returns the colours (n, 3) of places (…, 3) in the world frames, and whether a picture shows them."""
    shown = best_views([world.reshape(-1, 3) for world in worlds_m], one.views, one.rule)
    seen = shown.view != NO_VIEW
    colour = np.zeros((len(seen), 3), np.uint8)
    if seen.any():
        colour[seen] = sampled(picture, shown.pixel[seen])
    return colour, seen


def _lies_elsewhere(picture: UInt8, one: Pictures, placed: PlacedGround, cells: Int64) -> bool:
    """Returns whether brightness and intensity of cells agree much better where the picture is moved on the ground."""
    ground = placed.cells
    known = cells[np.isfinite(ground.intensity[cells])]
    if known.size < _LEAST_CELLS:
        return False
    intensity = np.log(np.maximum(ground.intensity[known], 1.0))
    here = 0.0
    elsewhere = -1.0
    for step in (0.0, *_SHIFTS_M):
        for angle in np.arange(8) * np.pi / 4 if step else (0.0,):
            moved = np.array([[step * np.cos(angle), step * np.sin(angle), 0.0]])
            colour, seen = _colours(picture, one, placed.stepped(known, moved))
            if np.count_nonzero(seen) < _LEAST_CELLS:
                continue
            bright = np.log(linear(colour[seen]).mean(axis=1) + 1e-3)
            found = _correlation(bright, intensity[seen], ground.column[known[seen]], ground.row[known[seen]])
            if step:
                elsewhere = max(elsewhere, found)
            else:
                here = found
    return elsewhere >= _CORRELATED and elsewhere - here >= _BETTER


def _correlation(first: Float64, second: Float64, column: Int64, row: Int64) -> float:
    """Returns the correlation of values of cells (n,), each without its mean over squares of cells."""
    box = (row // _BOX_CELLS) * 1_000_003 + column // _BOX_CELLS
    _, number = np.unique(box, return_inverse=True)
    count = np.bincount(number)
    a, b = (v - (np.bincount(number, v) / count)[number] for v in (first, second))
    norm = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / norm if norm > 0.0 else 0.0
