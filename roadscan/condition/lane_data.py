"""Input of the indices of condition: profiles and cross-sections of a lane, and its sections."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Final, Literal

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.compute.array_types import Float64
from roadscan.compute.edges import painted_line, without_lines
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
from roadscan.condition.kernels.sampling import CellTable, mean_intensities
from roadscan.condition.road_line import STATION_M, Lane, RoadLine
from roadscan.condition.settings import SectionConfig

PIECE_M: Final = 0.05
"""Cracks are divided into pieces of at most this length (m)."""
_ROUNDS: Final = 4  # Newton steps to a station.


@dataclass(frozen=True, eq=False)
class CrackOnLane:
    """A crack near a lane, divided into short pieces."""

    kind: str
    """Longitudinal, transverse, diagonal, alligator or unknown."""
    width_m: float
    """Mean width."""
    station_m: Float64
    """(k,) of the pieces' middles."""
    own_m: Float64
    """(k,) their offset from the lane's middle, positive to the right in the direction of travel."""
    length_m: Float64
    """(k,) lengths of the pieces."""


def located(line: RoadLine, lane: Lane, places_m: Float64, guess_m: float) -> tuple[Float64, Float64]:
    """Return stations, and offsets from the lane's middle (n,), of places (n, 2), from a station near all of them."""
    station = np.full(len(places_m), guess_m)
    for _ in range(_ROUNDS):
        at = line.places(station, 0.0)
        station = station + np.einsum("na,na->n", places_m - at[:, :2], at[:, 2:])
    at = line.places(station, 0.0)
    beside = places_m - at[:, :2]
    offset = beside[:, 0] * at[:, 3] - beside[:, 1] * at[:, 2]
    return station, lane.sign * (offset - lane.offsets(station))


SPACING_M: Final = 0.5
"""Distance between the places along the lane at which lines are sought; intensities are means over it."""
LINE_REACH_M: Final = 1.2
"""Distance beyond the border of a lane up to which intensities are used."""
_STEP_M: Final = 0.025  # Spacing of intensities across the lane.
_BESIDE_M: Final = 0.8
"""Largest distance of a line from the border, inside and outside."""
_SIDES: Final = {"left": -1.0, "right": 1.0}  # Signs of offsets.


@dataclass(frozen=True, eq=False)
class LaneLines:
    """Painted lines beside a lane, one row for each place where one was seen."""

    station_m: Float64
    """(n,)"""
    side: tuple[str, ...]
    """(n,) left or right in the direction of travel."""
    own_m: Float64
    """(n,) offset of the line's middle from the lane's middle, positive to the right in the direction of travel."""
    width_m: Float64
    """(n,) of the line."""
    contrast: Float64
    """(n,) by how much it is brighter than the road beside it (share of its intensity)."""


def lane_lines(table: CellTable, line: RoadLine, lane: Lane, between_m: tuple[float, float]) -> LaneLines:
    """Return painted lines beside a lane at multiples of 0.5 m of station in [from, to)."""
    first, end = (math.ceil(one / SPACING_M - 1e-9) for one in between_m)
    station: Float64 = SPACING_M * np.arange(first, end, dtype=np.float64)
    half = 0.5 * lane.width_m
    away: Float64 = np.arange(max(half - LINE_REACH_M, 0.1), half + LINE_REACH_M, _STEP_M)
    half_across = 0.5 * max(_STEP_M, float(table.cell.max()))
    rows: list[tuple[float, str, float, float, float]] = []
    for name, side in _SIDES.items():
        every = np.repeat(station, away.size)
        places = line.places(every, lane.offsets(every, np.tile(side * away, station.size)))
        grey = np.empty(every.size)
        mean_intensities(table, places, 0.5 * SPACING_M, half_across, grey)
        across = grey.reshape(station.size, away.size)
        surface = without_lines(across, _STEP_M)
        for at, own, under in zip(station.tolist(), across, surface, strict=True):
            found = painted_line(own, under, away)
            if found is not None and abs(found.middle_m - half) <= _BESIDE_M:
                rows.append((at, name, side * found.middle_m, found.width_m, found.contrast))
    rows.sort()
    held = [np.array([row[k] for row in rows], np.float64) for k in (0, 2, 3, 4)]
    return LaneLines(held[0], tuple(row[1] for row in rows), *held[1:])


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


@dataclass(frozen=True, eq=False)
class LaneEdge:
    """The edge of the road on one side of a lane, a value a station; NaN where unknown."""

    away_m: Float64
    """(n,) distance from the lane's middle, positive outward."""
    sigma_m: Float64
    """(n,)"""
    drop_m: Float64
    """(n,) height of the road's surface at the edge above the ground beside it; negative where a kerb rises."""
    sigma_drop_m: Float64
    """(n,)"""
    beside: bool
    """True where no other lane lies between."""


@dataclass(frozen=True, eq=False)
class EdgesOnLane:
    """Both edges beside a lane."""

    station_m: Float64
    """(n,) ascending, :data:`STATION_M` apart."""
    sides: Mapping[str, LaneEdge]
    """By side in the direction of travel: left and right."""

    def inside(self, station_m: Float64, own_m: Float64) -> npt.NDArray[np.bool_]:
        """Return whether places (n,) lie between the edges, by station and offset from the lane's middle.

        Offsets are positive to the right in the direction of travel. Where an edge is not known, it bounds nothing.
        """
        at = np.rint((station_m - self.station_m[0]) / STATION_M).astype(np.int64)
        at = np.clip(at, 0, self.station_m.size - 1)
        left, right = (self.sides[side].away_m[at] for side in ("left", "right"))
        found: npt.NDArray[np.bool_] = ~(own_m < -left) & ~(own_m > right)
        return found


@dataclass(frozen=True, eq=False)
class EdgeRows:
    """Rows of the table of edges on one side of a reference line."""

    station_m: Float64
    offset_m: Float64
    sigma_m: Float64
    drop_m: Float64
    sigma_drop_m: Float64


def edges_on_lane(
    rows: Mapping[str, EdgeRows], lane: Lane, between_m: tuple[float, float], beside: Mapping[str, bool]
) -> EdgesOnLane:
    """Return the edges beside a lane between two stations.

    Parameters
    ----------
    rows : by side of the reference line.
    beside : by side in the direction of travel, whether no other lane lies between.
    """
    first, last = (round(end / STATION_M) for end in between_m)
    station: Float64 = STATION_M * np.arange(first, last + 1, dtype=np.float64)
    sides = {}
    for name, sign in (("left", -1.0), ("right", 1.0)):
        own = rows[name if lane.sign > 0 else ("right" if name == "left" else "left")]
        at = np.rint(own.station_m / STATION_M).astype(np.int64) - first
        good = (at >= 0) & (at < station.size)
        away = sign * lane.sign * (own.offset_m - lane.offsets(own.station_m))
        columns = np.full((4, station.size), np.nan)
        columns[:, at[good]] = np.stack([away, own.sigma_m, own.drop_m, own.sigma_drop_m])[:, good]
        sides[name] = LaneEdge(columns[0], columns[1], columns[2], columns[3], beside[name])
    return EdgesOnLane(station, sides)


@dataclass(frozen=True, eq=False)
class Profile:
    """Heights along a wheel path, in the direction of travel."""

    station_m: Float64
    """(n,) station along the reference line."""
    place_m: Float64
    """(n, 2) easting and northing."""
    height_m: Float64
    """(n,) height, NaN where it is not known."""
    sigma_m: Float64
    """(n,) standard deviation from the noise of the readings, NaN where it is not known."""

    @cached_property
    def distance_m(self) -> Float64:
        """(n,) distance along the path from its first height."""
        steps = np.hypot(*np.diff(self.place_m, axis=0).T)
        way: Float64 = np.concatenate([np.zeros(min(len(self.station_m), 1)), np.cumsum(steps)])
        return way

    @property
    def known_sigma_m(self) -> Float64:
        """(n,) `sigma_m`, and its median where it is not known; NaN where it is known nowhere."""
        known = np.isfinite(self.sigma_m)
        return np.where(known, self.sigma_m, np.median(self.sigma_m[known]) if known.any() else np.nan)

    def between(self, from_m: float, to_m: float) -> Profile:
        """Return heights whose station lies in [from, to]; their distance starts at 0."""
        own = (self.station_m >= from_m - 1e-6) & (self.station_m <= to_m + 1e-6)
        return Profile(self.station_m[own], self.place_m[own], self.height_m[own], self.sigma_m[own])


@dataclass(frozen=True, eq=False)
class CrossSections:
    """Heights across a lane, from left to right in the direction of travel."""

    station_m: Float64
    """(n,) ascending."""
    offset_m: Float64
    """(m,) offset from the lane's middle, positive to the right in the direction of travel."""
    height_m: npt.NDArray[np.float64]
    """(n, m) heights, each cross-section's from its `base_m`; NaN where not known."""
    sigma_m: npt.NDArray[np.float64]
    """(n, m) standard deviations from the noise of the readings, NaN where not known."""
    base_m: Float64
    """(n,) height from which `height_m` counts."""

    def between(self, from_m: float, to_m: float) -> CrossSections:
        """Return cross-sections whose station lies in [from, to)."""
        own = (self.station_m >= from_m - 1e-6) & (self.station_m < to_m - 1e-6)
        return replace(
            self, station_m=self.station_m[own], height_m=self.height_m[own], sigma_m=self.sigma_m[own],
            base_m=self.base_m[own],
        )  # fmt: skip

    @property
    def share(self) -> Float64:
        """(n,) known share of the heights of each."""
        shares: Float64 = np.mean(~np.isnan(self.height_m), axis=1)
        return shares


@dataclass(frozen=True, eq=False)
class LaneData:
    """A lane along some sections, with the parts before and after them."""

    sign: int
    """1 where the lane is driven along the reference line, −1 against it."""
    width_m: float
    width_from: str
    """Origin of the width: stated, or default."""
    cell_m: float
    """Edge of the cells from which the heights come."""
    sections_m: tuple[tuple[float, float], ...]
    """Begin and end station of each section."""
    profiles: Mapping[str, Profile]
    """By wheel path: left and right."""
    cross_sections: CrossSections
    texture: TextureSquares
    lines: LaneLines
    """Painted lines beside it."""
    config: SectionConfig
    curvature_per_m: Float64
    """(n,) curvature of the reference line at the cross-sections (1/m), positive to the right."""
    cracks: tuple[CrackOnLane, ...] | None = None
    """Cracks near the lane; None where the survey has no table of cracks."""
    sigma_roll_rad: float = 0.0
    """Standard deviation of the vehicle's roll as stated with the poses."""
    sigma_pose_height_m: float = 0.0
    """Standard deviation of its height as stated with the poses."""
    wander_m2_per_m: float = 0.0
    """Variance of the random walk of the poses' heights per metre of travel."""
    edges: EdgesOnLane | None = None
    """Edges of the road beside the lane; None where none are requested."""
    window_m2: float = 0.0
    """Variance of the window along the road over which a profile's height is a mean; 0 for heights of points."""

    def paths_share(self, from_m: float, to_m: float) -> float:
        """Return the measured share of the wheel paths between two stations, of the one with less."""
        due = max((to_m - from_m) / self.config.profile_spacing_m, 1.0)
        parts = [profile.between(from_m, to_m) for profile in self.profiles.values()]
        return min(1.0, *(np.count_nonzero(~np.isnan(part.height_m)) / due for part in parts))
