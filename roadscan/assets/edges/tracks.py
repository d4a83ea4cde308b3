"""Stations along the drives of a scene: the same for every scene that holds what lies around them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

import numpy as np
import scipy.ndimage
import scipy.spatial

from roadscan.assets.edges.profiles import stops
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.arrays import runs_of, way_along, without_holes

STATION_M: Final = 0.5  # Distance of stations along the drive (m).
_LATTICE_M: Final = 3.0
"""Stations lie where the drive crosses a lattice of this edge (m), and evenly between: wherever it enters a scene."""
SAME_ROAD_M: Final = 8.0
"""A drive this near (m) to an earlier one is on the same road: its edges are found from the earlier …"""
_SAME_LEVEL_M: Final = 2.5
"""… where it is as high: sensors of two vehicles differ by less (m), roads over one another by 3 m or more."""
_BESIDE_M: Final = 0.6
"""What a pass drove earlier lies beside a station, not before or behind it, if it is this near along (m) …"""
_PARALLEL: Final = 0.7
"""… and runs within 45° of its heading, or against it (cosine)."""
_STANDS_M, _STRAIGHT = 0.5, 0.5
"""A drive moves where this way (m) before and behind a place leads away by this share of it: jitter does not."""
_POSTS_M: Final = 5.0
"""What parts two drives may have gaps of this length (m): posts of a wire rope are 2 to 4 m apart."""
_FEWEST_STATIONS: Final = 4  # Stations of a track.


class Track(NamedTuple):
    """Stations of a drive: places (n, 2) and unit vectors (n, 2) along it."""

    places: Float64
    heading: Float64
    pass_id: int


Parted = Callable[[Float64, Float64], Bool]


def tracks_of(drive_xyh_m: Float64, parted: Parted | None = None) -> Iterator[Track]:
    """Yields stations each half metre of each pass, where nothing drove beside it earlier, neither it nor another.

    parted : whether something lies between places (n, 2) and (n, 2), so that they are on two roads; None: never.
    """
    earlier = np.zeros((0, 3))
    for number in np.unique(drive_xyh_m[:, 3]):
        driven = drive_xyh_m[drive_xyh_m[:, 3] == number, :3]
        parts = [part for one in unbroken(driven) if way_along(part := _moving(one))[-1] >= 2.0 * STATION_M]
        if parts:
            yield from _stations(parts, earlier, int(number), parted)
            earlier = np.concatenate([earlier, *parts])


def unbroken(driven: Float64) -> list[Float64]:
    """Returns the parts of a drive (k, …) between jumps: there it left the window, or nobody knows where it was."""
    return np.split(driven, np.flatnonzero(np.hypot(*np.diff(driven[:, :2], axis=0).T) > 5.0) + 1)


def bridged(parts: Bool) -> Bool:
    """Returns a mask (n,) of stations where something parts drives, with the gaps between its posts."""
    return without_holes(parts, round(_POSTS_M / STATION_M))


def _moving(places: Float64) -> Float64:
    """Returns the places (k, 3) of a drive without those where it stands: there it does not come away."""
    places = places[np.append(True, np.hypot(*np.diff(places[:, :2], axis=0).T) > 0.0)]
    way = way_along(places)
    ends = np.clip(way + np.array([[-_STANDS_M], [_STANDS_M]]), 0.0, way[-1])
    first, last = (np.column_stack([np.interp(at, way, places[:, k]) for k in range(2)]) for at in ends)
    return np.asarray(places[np.hypot(*(last - first).T) >= _STRAIGHT * (ends[1] - ends[0])])


def _stations(parts: list[Float64], earlier: Float64, number: int, parted: Parted | None) -> Iterator[Track]:
    found = [stops(part, STATION_M, _LATTICE_M) for part in parts]
    headings = []
    for one in found:
        smooth = scipy.ndimage.gaussian_filter1d(one[:, :2], 4.0, axis=0, mode="nearest", truncate=2.0)
        heading = np.gradient(smooth, axis=0)
        headings.append(heading / np.maximum(np.hypot(*heading.T), 1e-9)[:, None])
    (places, level), heading = np.split(np.concatenate(found), [2], axis=1), np.concatenate(headings)
    part = np.repeat(np.arange(len(found)), [len(one) for one in found])
    before = _came_from(places, heading, part, level[:, 0])
    if len(earlier):
        near = _nearest(np.hstack([places, level]), earlier)
        before = np.where(np.isfinite(near), near, before)
    free = np.isnan(before[:, 0])
    if parted is not None:
        apart = np.zeros(free.size, np.bool_)
        apart[~free] = parted(places[~free], before[~free])
        free |= bridged(apart)
    for first, end in runs_of(free):
        for rows in np.split(np.arange(first, end), np.flatnonzero(np.diff(part[first:end])) + 1):
            if len(rows) >= _FEWEST_STATIONS:
                yield Track(places[rows], heading[rows], number)


def _nearest(places: Float64, earlier: Float64) -> Float64:
    """Returns the nearest (n, 2) of earlier places (m, 3) on the road of places (n, 3); NaN where there is none."""
    tree = scipy.spatial.cKDTree(earlier[:, :2])
    away, at = tree.query(places[:, :2])
    found = np.where((away <= SAME_ROAD_M)[:, None], earlier[at, :2], np.nan)
    for k in np.flatnonzero((away <= SAME_ROAD_M) & (np.abs(earlier[at, 2] - places[:, 2]) > _SAME_LEVEL_M)).tolist():
        about = earlier[tree.query_ball_point(places[k, :2], SAME_ROAD_M)]
        same = about[np.abs(about[:, 2] - places[k, 2]) <= _SAME_LEVEL_M, :2]
        found[k] = same[np.argmin(np.hypot(*(same - places[k, :2]).T))] if len(same) else np.nan
    return found


def _came_from(places: Float64, heading: Float64, part: Int64, level_m: Float64) -> Float64:
    """Returns the places (n, 2) beside stations that the same pass drove before, there or back; NaN where it did not.

    Before is what it drove until it last was out of reach of the station, or turned away from its heading. So neither
    a bend nor what is just behind counts, and nothing farther away does.
    """
    found = np.full((len(places), 2), np.nan)
    for k, some in enumerate(scipy.spatial.cKDTree(places).query_ball_point(places, SAME_ROAD_M, return_sorted=True)):
        near = np.array(some[: some.index(k)], np.int64)
        cosine = heading[near] @ heading[k]
        onward = near[(cosine >= 0.0) & (part[near] == part[k])][::-1]
        begun = k - np.count_nonzero(onward == k - 1 - np.arange(len(onward)))
        beside = np.abs((places[near] - places[k]) @ heading[k]) <= _BESIDE_M
        beside &= np.abs(level_m[near] - level_m[k]) <= _SAME_LEVEL_M
        same = near[(near < begun) & beside & (np.abs(cosine) >= _PARALLEL)]
        if same.size:
            found[k] = places[same[np.argmin(np.hypot(*(places[same] - places[k]).T))]]
    return found
