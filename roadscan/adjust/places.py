"""Places where passes overlap, the patch of road there as each pass saw it, and the tie between two patches.

Passes overlap as lanes side by side, a lane driven again, opposite directions, crossings and loops. Each track is
sampled evenly along its path. Beside each lead sample, each `per_km`-th part of a kilometre, the part of
its cross-line that other tracks (or the same one, later) see is an interval, and the fewest places that meet all
intervals are taken. Where passes only abut, the place lies in the strip that both see. The first track in the given
order leads; the others lead where it does not come.

A patch has cells along and across, and the pose that saw them. A tie is the difference of two traverses along one
direction at one place, and why it does not count, if so.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Final, TypeAlias

import numpy as np
import numpy.typing as npt

from roadscan.adjust.kernels.places import (
    Bins,
    Cells,
    Frame,
    Limits,
    Meetings,
    Samples,
    Spread,
    Visits,
    cell_numbers,
    feet,
    fill_cells,
    local_axes,
    meetings,
    visits,
)
from roadscan.adjust.settings import PlaceSettings
from roadscan.compute.array_types import Bool, Float64, Int32, Int64, UInt16
from roadscan.core.errors import NavigationError
from roadscan.core.gpstime import NS_PER_S

_STEP_M: Final = 2.0
"""Greatest spacing of samples (m); the chord of a bend of 10 m leaves it by 5 cm."""
_ASIDE: Final = (0.0, -0.8, 0.8, -0.4, 0.4)
"""Positions of places in a wide strip, in turns: roll shows at its edges."""


@dataclass(frozen=True)
class Track:
    """The path of a sensor in one run, and its reach to both sides."""

    run: int
    """Index of the run."""
    sensor: str
    epoch_gps_ns: Int64
    """(n,) ascending."""
    easting_m: Float64
    """(n,) map, of the road below the sensor's view: of a line scanner, a point on its line."""
    northing_m: Float64
    height_m: Float64
    heading_rad: Float64
    """(n,) of the vehicle, clockwise from grid north."""
    left_m: float | Float64
    """Reach on the ground to the left of the position, (n,) or the same for all; negative where the sensor sees only
    the right."""
    right_m: float | Float64
    ahead_m: float = 0.0
    """Reach of a lidar ahead and behind; 0 for sensors that see a line across. A place of such a sensor
    may have one traverse: it is seen for a while."""

    def __post_init__(self) -> None:
        sizes = {a.shape for a in (self.epoch_gps_ns, self.easting_m, self.northing_m, self.height_m, self.heading_rad)}
        if sizes != {(self.epoch_gps_ns.size,)}:
            raise NavigationError(
                f"track of '{self.sensor}': columns of the shapes {sorted(sizes)}", expected="one value an epoch"
            )
        if (np.diff(self.epoch_gps_ns) <= 0).any():
            raise NavigationError(f"track of '{self.sensor}': epochs do not ascend", expected="ascending epochs")


@dataclass(frozen=True)
class Traverse:
    """One pass of one sensor by a place."""

    run: int
    """Index of the run."""
    sensor: str
    first_gps_ns: int
    """Between these epochs the sensor saw the place."""
    last_gps_ns: int


@dataclass(frozen=True)
class Place:
    """A square of road at which passes are compared."""

    number: int
    """From 0, in the order of the leading track, then along it."""
    easting_m: float
    """Centre, map."""
    northing_m: float
    heading_rad: float
    """Of the leading track, clockwise from grid north: the axis along the patch."""
    radius_m: float
    """Half the edge of the square."""
    traverses: tuple[Traverse, ...]
    """Two or more, in the order of tracks and time; one where a lidar sees the place for a while."""
    seam: bool = False
    """Whether heads of one pass meet there, in a strip too narrow for other ties."""

    def quality_only(self, return_s: float) -> bool:
        """Returns whether the traverses are heads of one run at one time: one correction moves them all."""
        first, last = self.traverses[0], self.traverses[-1]
        apart_s = (max(t.first_gps_ns for t in self.traverses) - min(t.last_gps_ns for t in self.traverses)) / NS_PER_S
        return len(self.traverses) > 1 and first.run == last.run and apart_s < return_s


def places_of_overlap(tracks: Sequence[Track], settings: PlaceSettings) -> list[Place]:
    """Places where passes overlap, evenly spread along the road; the same for the same tracks in the same order.

    Parameters
    ----------
    tracks : of all runs and sensors, by run; those of one run beside one another.
    settings : number and size of places, and the criteria of another pass.
    """
    spacing_m = 1000.0 / settings.per_km
    every = max(1, math.ceil(spacing_m / _STEP_M))
    origin = min((int(t.epoch_gps_ns[0]) for t in tracks if t.epoch_gps_ns.size), default=0)
    parts = [_sampled(t, k, spacing_m / every, origin, settings.gap_s) for k, t in enumerate(tracks)]
    if not any(p.track.size for p in parts):
        return []
    samples = Samples._make(np.concatenate(column) for column in zip(*parts, strict=True))
    starts = np.searchsorted(samples.track, np.arange(len(tracks) + 1))
    number = np.arange(samples.track.size) - starts[samples.track]
    found = _visits(samples, Limits(settings.return_s, settings.height_apart_m), spacing_m / every)
    leads = np.flatnonzero((number % every == 0) | _between(samples, found, number, every, settings.return_s))
    found = _of_leads(found, leads, samples.track.size)
    ahead = np.where(number % every == 0, np.array([t.ahead_m for t in tracks])[samples.track], 0.0)[leads]
    met = _meetings(samples, found, leads, ahead, settings)
    return _places(tracks, samples, found, leads, met, origin, settings)


def _sampled(track: Track, number: int, step_m: float, origin_gps_ns: int, gap_s: float) -> Samples:
    """Returns samples of one track, one each `step_m` of its path."""
    moved = np.hypot(np.diff(track.easting_m), np.diff(track.northing_m))
    station = np.concatenate([[0.0], np.cumsum(moved)])[: track.epoch_gps_ns.size]
    since = (track.epoch_gps_ns - origin_gps_ns) / NS_PER_S
    at = step_m * np.arange(math.floor(station[-1] / step_m) + 1) if station.size > 1 else np.zeros(0)
    goes_on = np.append(True, moved > 0)
    column = [
        np.interp(at, station[goes_on], np.broadcast_to(v, station.shape)[goes_on]) if at.size else at
        for v in (track.easting_m, track.northing_m, track.height_m, np.unwrap(track.heading_rad), since,
                  np.asarray(track.left_m, dtype=np.float64), np.asarray(track.right_m, dtype=np.float64))
    ]  # fmt: skip
    gap = np.flatnonzero(np.diff(since) > gap_s)
    joined = np.append(np.ones(max(at.size - 1, 0), np.bool_), False)[: at.size]
    for low, high in zip(station[gap], station[gap + 1], strict=True):
        joined[max(math.floor(low / step_m), 0) : math.ceil(high / step_m)] = False
    return Samples._make([*column, np.full(at.size, number, np.int32), joined])


def _visits(samples: Samples, limits: Limits, step_m: float) -> Visits:
    """Returns visits of the cross-lines of all samples."""
    reach = np.maximum(np.abs(samples.left_m), np.abs(samples.right_m)).max()
    edge = 2.0 * float(reach) + 2.0 * step_m
    west, south = float(samples.easting_m.min()), float(samples.northing_m.min())
    column, row = (
        np.floor((v - low) / edge).astype(np.int64)
        for v, low in ((samples.easting_m, west), (samples.northing_m, south))
    )
    rows = int(row.max()) + 1
    key = column * rows + row
    order = np.argsort(key, kind="stable")
    bins = Bins(order, key[order], edge, rows, west, south)
    leads = np.arange(samples.track.size)
    size = 4 * leads.size + 16
    while True:
        out = Visits._make(np.empty(size, t) for t in (np.int64, np.int64, np.int64, np.float64, np.float64))
        count = visits(samples, bins, leads, limits, out)
        if count <= size:
            return Visits._make(a[:count] for a in out)
        size = count


def _between(samples: Samples, found: Visits, number: Int64, every: int, return_s: float) -> Bool:
    """Returns a mask (n,) of samples that lead in addition: a visit, such as a crossing, lies between the even leads.

    A visit goes on from sample to sample of the lead. Of one that no even lead within `every` samples meets, the middle
    sample leads.
    """
    out = np.zeros(samples.track.size, np.bool_)
    tracks = np.int64(samples.track.max()) + 1
    pair = samples.track[found.lead] * tracks + samples.track[found.first]
    since = samples.since_s[found.first]
    # Passes of the other track beside this one are labelled separately.
    order = np.lexsort((since, pair))
    begins = np.append(True, (np.diff(pair[order]) != 0) | (np.diff(since[order]) >= return_s))[: order.size]
    label = np.empty(order.size, np.int64)
    label[order] = np.cumsum(begins)
    order = np.lexsort((found.lead, label))
    label, lead = label[order], found.lead[order]
    even = np.flatnonzero(number[lead] % every == 0)
    far = np.iinfo(np.int64).max // 4
    key = np.concatenate([[-far], label[even] * (4 * out.size) + lead[even], [far]])
    own = label * (4 * out.size) + lead
    at = np.searchsorted(key, own)
    orphan = np.flatnonzero(np.minimum(key[np.minimum(at, key.size - 1)] - own, own - key[at - 1]) >= every)
    ends = np.flatnonzero(np.append((np.diff(own[orphan]) > every), True)) if orphan.size else orphan
    starts = np.append(0, ends[:-1] + 1)
    out[lead[orphan[(starts[: ends.size] + ends) // 2]]] = True
    return out


def _of_leads(found: Visits, leads: Int64, size: int) -> Visits:
    """Returns the visits of some samples, numbered by their index among them."""
    rank = np.full(size, -1, dtype=np.int64)
    rank[leads] = np.arange(leads.size)
    kept = rank[found.lead] >= 0
    return Visits._make([rank[found.lead[kept]], *(a[kept] for a in found[1:])])


def _meetings(samples: Samples, found: Visits, leads: Int64, ahead_m: Float64, settings: PlaceSettings) -> Meetings:
    turn = np.array(_ASIDE)[np.arange(leads.size) % len(_ASIDE)]
    aside = np.where(ahead_m > 0, np.nan, turn)
    of_lead = np.bincount(found.lead, minlength=leads.size)
    places, members = found.lead.size + leads.size, int((of_lead**2).sum()) + leads.size
    sizes = ((places, np.int64), (places, np.float64), (members, np.int64), (members, np.int64))
    out = Meetings._make(np.empty(size, t) for size, t in sizes)
    spread = Spread(settings.least_overlap_m, settings.radius_m)
    p, q = meetings(samples, found, leads, spread, aside, ahead_m > 0, out)
    return Meetings(out.lead[:p], out.offset_m[:p], out.place[:q], out.visit[:q])


def _places(
    tracks: Sequence[Track], samples: Samples, found: Visits, leads: Int64, met: Meetings, origin: int,
    settings: PlaceSettings,
) -> list[Place]:  # fmt: skip
    lead = leads[met.lead]
    heading = samples.heading_rad[lead]
    easting = samples.easting_m[lead] + met.offset_m * np.cos(heading)
    northing = samples.northing_m[lead] - met.offset_m * np.sin(heading)
    ahead = np.array([t.ahead_m for t in tracks])
    radius = np.where(ahead[samples.track[lead]] > 0, settings.lidar_radius_m, settings.radius_m)
    foot = np.empty(met.visit.size)
    feet(samples, easting[met.place], northing[met.place], found.first[met.visit], found.last[met.visit], foot)
    # The lead itself comes first of its place.
    place = np.concatenate([np.arange(lead.size), met.place])
    foot = np.concatenate([lead.astype(np.float64), foot])
    order = np.argsort(place, kind="stable")
    place, foot = place[order], foot[order]
    track = samples.track[np.floor(foot + 1e-9).astype(np.int64)]
    first, last = _windows(samples, foot, track, radius[place] + settings.margin_m + ahead[track], settings.longest_s)
    ends = np.searchsorted(place, np.arange(lead.size + 1))
    first_ns, last_ns = ((origin + np.rint(s * NS_PER_S).astype(np.int64)).tolist() for s in (first, last))
    seen = [
        Traverse(tracks[t].run, tracks[t].sensor, a, b)
        for t, a, b in zip(track.tolist(), first_ns, last_ns, strict=True)
    ]
    columns = np.stack([easting, northing, np.mod(heading, 2 * math.pi), radius], axis=-1).tolist()
    return [
        Place(k, e, n, turned, half, tuple(seen[a:b]))
        for k, ((e, n, turned, half), (a, b)) in enumerate(zip(columns, pairwise(ends.tolist()), strict=True))
    ]


def _windows(
    samples: Samples, foot: Float64, track: npt.NDArray[np.int32], reach_m: Float64, longest_s: float
) -> tuple[Float64, Float64]:
    """Returns first and last time (q,) since the origin at which tracks are within `reach_m` (q,) of their foot."""
    number = np.arange(samples.track.size, dtype=np.float64)
    first_of = np.searchsorted(samples.track, track, side="left").astype(np.float64)
    last_of = np.searchsorted(samples.track, track, side="right") - 1.0
    # Samples are even: a distance along a track is a number of samples.
    step = np.hypot(np.diff(samples.easting_m), np.diff(samples.northing_m))
    even = np.median(step[samples.joined[:-1]]) if samples.joined.any() else 1.0
    at = np.interp(foot, number, samples.since_s)
    first = np.interp(np.clip(foot - reach_m / even, first_of, last_of), number, samples.since_s)
    last = np.interp(np.clip(foot + reach_m / even, first_of, last_of), number, samples.since_s)
    return np.maximum(first, at - longest_s / 2), np.minimum(last, at + longest_s / 2)


Shift: TypeAlias = tuple[float, float, float]
"""Shift of a whole traverse: north, east, down (m, local level)."""


@dataclass(frozen=True)
class PassReadings:
    """Readings of one traverse near a place, georeferenced with the recorded or the corrected poses."""

    run: int
    """Index of the run."""
    sensor: str
    easting_m: Float64
    """(n,) map."""
    northing_m: Float64
    height_m: Float64
    """(n,) NaN where the reading does not count."""
    intensity: UInt16
    """(n,)"""
    pose: Int32
    """(n,) row of each reading's pose."""
    epoch_gps_ns: Int64
    """(p,) epochs of the poses, ascending."""
    body_m: Float64
    """(p, 3) easting, northing and height of the body's origin."""
    level_from_body: Float64
    """(p, 3, 3) north, east, down from body axes."""
    convergence_rad: float = 0.0
    """Angle of grid north, clockwise from true north."""
    laser: npt.NDArray[np.uint8] | None = None
    """(n,) of the sparse returns of a lidar, of which planes are compared instead of cells; 0 where it is not known."""

    @property
    def returns(self) -> bool:
        """Returns whether they are those of a lidar."""
        return self.laser is not None

    def __post_init__(self) -> None:
        n, p = self.pose.size, self.epoch_gps_ns.size
        shapes = [a.shape for a in (self.easting_m, self.northing_m, self.height_m, self.intensity)]
        if shapes != [(n,)] * 4 or self.body_m.shape != (p, 3) or self.level_from_body.shape != (p, 3, 3):
            raise NavigationError(
                f"readings of '{self.sensor}': columns of shapes {shapes}, poses {self.body_m.shape} and "
                f"{self.level_from_body.shape}",
                expected=f"({n},), and ({p}, 3) and ({p}, 3, 3), one for each of its epochs",
            )

    def pose_at(self, epoch_gps_ns: int) -> int:
        """Returns the row of the pose nearest to an epoch."""
        after = int(np.searchsorted(self.epoch_gps_ns, epoch_gps_ns))
        if after in (0, self.epoch_gps_ns.size):
            return min(after, self.epoch_gps_ns.size - 1)
        before, behind = self.epoch_gps_ns[after - 1], self.epoch_gps_ns[after]
        return after if behind - epoch_gps_ns < epoch_gps_ns - before else after - 1

    def arm_body_m(self, point_m: Float64, pose: Int64) -> Float64:
        """Vectors (k, 3) from the body's origin to points (k, 3; easting, northing, height), axes of bodies (k,)."""
        away = level_from_map(point_m - self.body_m[pose], self.convergence_rad)
        return np.asarray(np.einsum("nji,nj->ni", self.level_from_body[pose], away))


def shifted(readings: PassReadings, shift_level_m: Float64) -> PassReadings:
    """Returns the readings of a traverse and its poses, shifted together (3,; north, east, down)."""
    if not np.any(shift_level_m):
        return readings
    away = map_from_level(np.asarray(shift_level_m, np.float64)[None], readings.convergence_rad)[0]
    return replace(
        readings, easting_m=readings.easting_m + away[0], northing_m=readings.northing_m + away[1],
        height_m=readings.height_m + away[2], body_m=readings.body_m + away,
    )  # fmt: skip


def level_from_map(vector_m: Float64, convergence_rad: float) -> Float64:
    """Returns vectors (n, 3) of the map (easting, northing, height) as north, east, down of the local level."""
    e, n, h = np.asarray(vector_m).T
    c, s = math.cos(convergence_rad), math.sin(convergence_rad)
    return np.stack([c * n - s * e, s * n + c * e, -h], axis=-1)


def map_from_level(vector_m: Float64, convergence_rad: float) -> Float64:
    """Returns vectors (n, 3) of the local level (north, east, down) as easting, northing, height of the map."""
    n, e, d = np.asarray(vector_m).T
    c, s = math.cos(convergence_rad), math.sin(convergence_rad)
    return np.stack([c * e - s * n, c * n + s * e, -d], axis=-1)


@dataclass(frozen=True)
class Inside:
    """The readings of a traverse that lie inside a patch."""

    along_m: Float64
    """(n,) from the middle of the patch."""
    across_m: Float64
    """(n,) to the right."""
    height_m: Float64
    intensity: UInt16
    pose: Int32
    number: Int32
    """(n,) cell, row · edge + column."""


@dataclass(frozen=True)
class Patch:
    """A square of road, centred at a place, as cells (along, across); the axis across is positive to the right."""

    place: Place
    readings: PassReadings
    inside: Inside
    cell_m: float
    height_m: Float64
    """(k, k); NaN where there are too few readings."""
    sigma_m: Float64
    """(k, k) 1 σ of the height from the spread of the cell's readings, noise and texture alike."""
    used: Int32
    """(k, k) number of readings in the height."""
    intensity: Float64
    """(k, k) mean."""
    pose: int
    """Row of the pose in the middle of the readings."""

    @property
    def seen(self) -> npt.NDArray[np.bool_]:
        """Returns a mask (k, k) of the cells with a height."""
        return np.isfinite(self.height_m)

    @property
    def epoch_gps_ns(self) -> int:
        """Returns the epoch of the pose in the middle of the readings."""
        return int(self.readings.epoch_gps_ns[self.pose])

    @cached_property
    def middle_m(self) -> Float64:
        """Returns coordinates (k,) of the middles of rows along, and of columns across."""
        edge = len(self.height_m)
        return np.asarray((np.arange(edge) + 0.5 - 0.5 * edge) * self.cell_m)


def patch_of(place: Place, readings: PassReadings, cell_m: float, least_readings: int) -> Patch | None:
    """Returns the cells of a traverse at a place; None where it saw nothing of it.

    cell_m : edge of a cell. least_readings : a cell with fewer has no height.
    """
    edge = max(round(2.0 * place.radius_m / cell_m), 4)
    count = np.zeros(edge * edge, np.int64)
    inside = _inside(place, readings, cell_m, edge, count)
    if inside.pose.size == 0:
        return None
    cells = Cells._make(np.empty(edge * edge, t) for t in (np.float64, np.float64, np.int32, np.float64))
    fill_cells(inside.number, inside.height_m, inside.intensity, count, least_readings, cells)
    usual = np.nanmedian(cells.spread_m) if np.isfinite(cells.spread_m).any() else math.nan
    # Quartiles of a handful of readings are unreliable.
    spread = np.sqrt((cells.spread_m**2 + usual**2) / 2.0)
    sigma = np.where(np.isfinite(spread), spread, usual) / np.sqrt(np.maximum(cells.used, 1))
    shape = (edge, edge)
    return Patch(
        place, readings, inside, cell_m, cells.height_m.reshape(shape), sigma.reshape(shape), cells.used.reshape(shape),
        cells.intensity.reshape(shape), int(np.median(inside.pose)),
    )  # fmt: skip


def _inside(place: Place, readings: PassReadings, cell_m: float, edge: int, count: Int64) -> Inside:
    """Returns the readings inside the cells of a place, and counts them into `count`."""
    along, across = np.empty(readings.pose.size), np.empty(readings.pose.size)
    local_axes(readings.easting_m, readings.northing_m, frame_of(place), along, across)
    number = np.empty(along.size, np.int32)
    cell_numbers(along, across, 0.5 * edge * cell_m, cell_m, edge, number, count)
    which = np.flatnonzero(number >= 0)
    return Inside(
        along[which], across[which], readings.height_m[which], readings.intensity[which], readings.pose[which],
        number[which],
    )  # fmt: skip


def frame_of(place: Place) -> Frame:
    """Returns the axes of a place, as kernels take them."""
    return Frame(place.easting_m, place.northing_m, math.sin(place.heading_rad), math.cos(place.heading_rad))


def map_from_axes(place: Place, along_m: Float64, across_m: Float64, height_m: Float64) -> Float64:
    """Returns points (n, 3) of the map from coordinates (n,) along and across a place, and heights."""
    sine, cosine = math.sin(place.heading_rad), math.cos(place.heading_rad)
    easting = place.easting_m + along_m * sine + across_m * cosine
    northing = place.northing_m + along_m * cosine - across_m * sine
    return np.stack([easting, northing, height_m], axis=-1)


HEIGHT: Final = "height_tie"
SHIFT: Final = "shift_tie"
PLANE: Final = "plane_tie"

LASERS: Final = 256
"""Lasers of a sensor are numbered by bytes."""

COUNTS: Final = ""
FEW_CELLS: Final = "too few cells in common"
TOO_FAR: Final = "farther apart than the bound"
TWO_SURFACES: Final = "too few cells agree"
SCATTERED: Final = "cells scatter"
STEEP: Final = "too steep"
SAME_PASS: Final = "heads of one pass"


@dataclass(frozen=True)
class End:
    """One end of a tie: a point of the road and the pose that saw it."""

    readings: PassReadings
    pose: int
    """Row of the pose."""
    point_m: Float64
    """(3,) easting, northing, height as the recorded pose places it."""
    laser: float = math.nan
    """Laser that saw it; NaN of a sensor that has none."""


@dataclass(frozen=True)
class Tie:
    """A measurement along one direction: the second end minus the first."""

    kind: str
    ends: tuple[End, End]
    direction_level: Float64
    """(3,) unit vector, north, east, down."""
    value_m: float
    sigma_m: float
    count: int
    """Number of cells or returns used."""
    correlation: float
    """Correlation of the two images; NaN where none was compared."""
    why_not: str = COUNTS
    """Empty if it counts."""
    group: int = 0
    """Ties of one group of a place stand or fall together."""

    @property
    def counts(self) -> bool:
        """Returns whether the adjustment uses it."""
        return self.why_not == COUNTS
