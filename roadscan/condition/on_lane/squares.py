"""Texture of a lane from cells, by squares of 0.2 m, and the patches of lost stones that are found in them."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Final, Literal

import numpy as np
import shapely

from roadscan.compute.array_types import Float64
from roadscan.condition.kernels.lane_texture import (
    FIGURES,
    INTENSITY,
    LINE,
    LOSS,
    PEAKS,
    SHARE,
    SHARED,
    TEXTURE,
    WITHIN,
    texture_of_squares,
)
from roadscan.condition.kernels.sampling import CellTable
from roadscan.condition.road_line import Lane, RoadLine

SQUARE_M: Final = 0.2
"""Edge of a square (m): two segments of a texture profile."""
LEAST_SHARE: Final = 0.5
"""Least share of a square that is covered by cells."""
_MM: Final = 1e3  # Millimetres in a metre.


@dataclass(frozen=True, eq=False)
class TextureSquares:
    """Squares of a lane, rows along it and columns from left to right in the direction of travel."""

    station_m: Float64
    """(n,) of the squares' middles, ascending."""
    offset_m: Float64
    """(m,) offsets of the squares' middles from the lane's middle, positive to the right in the direction of travel."""
    texture_mm: Float64
    """(n, m) root mean square of the heights within 50 mm about their plane; NaN where it is not known, as below."""
    loss_mm: Float64
    """(n, m) mean depth below the level of the undamaged surface."""
    mpd_mm: Float64
    """(n, m) mean profile depth, computed from cells by :func:`texture_squares`."""
    intensity: Float64
    """(n, m) mean intensity."""
    passes_share: Float64
    """(n, m) share of the cells measured by several drives."""

    def between(self, from_m: float, to_m: float) -> TextureSquares:
        """Return squares whose middle lies in [from, to)."""
        own = (self.station_m >= from_m) & (self.station_m < to_m)
        held = {one.name: getattr(self, one.name)[own] for one in fields(self) if one.name != "offset_m"}
        return replace(self, **held)


@dataclass(frozen=True, eq=False)
class RavelledPatch:
    """A patch that has lost stones."""

    outline: shapely.Geometry
    """Of its squares: station along the reference line, and offset from the lane's middle (m), positive to the right in
    the direction of travel."""
    area_m2: float
    sigma_area_m2: float
    """1 σ: the border may lie anywhere within a square's width; errors along it are taken as fully correlated."""
    texture_mm: float
    """Root mean square texture, median of its squares."""
    ratio: float
    """Ratio of that to the texture of the section."""
    sigma_ratio: float
    """1 σ from the spread of its squares."""
    loss_mm: float
    """Mean depth of lost material over its area, above that of the section; NaN where unknown."""
    contrast: float
    """Share by which its intensity is higher than that of the section; NaN without intensities."""
    severity: str
    evidence: Literal["texture", "texture and intensity"]


@dataclass(frozen=True, eq=False)
class RavelledSection:
    """A section of a lane that was searched for patches."""

    patches: tuple[RavelledPatch, ...]
    measured_m2: float
    """Area of its squares whose texture was judged."""
    share: float
    """Share of that in the area of all squares."""
    background_mm: float
    """Texture of its undamaged squares: the median of all, or that of the lane."""
    reason: str = ""
    """Reason why it was not judged."""
    remark: str = ""
    """Remark on the result."""


def columns_of(lane: Lane) -> Float64:
    """Return (m,) offsets of the middles of the squares of a lane from its middle (m)."""
    count = int(lane.width_m / SQUARE_M + 1e-6)
    return SQUARE_M * (np.arange(count, dtype=np.float64) - 0.5 * (count - 1))


def texture_squares(table: CellTable, line: RoadLine, lane: Lane, between_m: tuple[float, float]) -> TextureSquares:
    """Return the texture of the squares of a lane whose middles lie between two stations.

    The mean profile depth is that of lines along the lane with a height a cell, cut into segments of 100 mm as in
    ISO 13473-1, without its low-pass: waves shorter than two cells do not show, and the means of cells dampen others.
    It is multiplied by how much larger the scatter of all readings is than that of these heights, so that it stands for
    all waves wherever cells hold several readings. Noise of the readings is texture to it.
    """
    own = columns_of(lane)
    first, end = (round(one / SQUARE_M) for one in between_m)
    station: Float64 = SQUARE_M * (np.arange(first, end, dtype=np.float64) + 0.5)
    every = np.repeat(station, own.size)
    places = line.places(every, lane.offsets(every, np.tile(own, station.size)))
    found = np.empty((every.size, FIGURES))
    texture_of_squares(table, places, SQUARE_M, found)
    found[found[:, SHARE] < LEAST_SHARE] = np.nan
    with np.errstate(invalid="ignore", divide="ignore"):
        grown = np.sqrt((found[:, LINE] + found[:, WITHIN]) / found[:, LINE])
    shape = (station.size, own.size)
    return TextureSquares(
        station, own, _MM * found[:, TEXTURE].reshape(shape), _MM * found[:, LOSS].reshape(shape),
        _MM * (found[:, PEAKS] * grown).reshape(shape), found[:, INTENSITY].reshape(shape),
        found[:, SHARED].reshape(shape),
    )  # fmt: skip
