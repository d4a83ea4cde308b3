"""All ties of a place, as observations of the adjustment and as rows of the table `ties`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt

from roadscan.adjust.observations import KINDS, Observations, partials
from roadscan.adjust.places import PassReadings, Place, patch_of
from roadscan.adjust.settings import TieSettings
from roadscan.adjust.ties.plane import height_tie, plane_ties
from roadscan.adjust.ties.shift import KINDS_OF_PICTURES, Pictures, shift_ties
from roadscan.adjust.ties.tie import SAME_PASS, Tie
from roadscan.compute.array_types import Float64
from roadscan.core.gpstime import NS_PER_S

_PARTNERS: Final = 2
"""Number of traverses to which each one is tied: all pairs of many passes would be redundant."""
_GROUPS: Final = 1 + KINDS_OF_PICTURES
"""Groups of a pair: its height, and the shift of each kind of image."""


@dataclass(frozen=True)
class Ties:
    """Ties of one or many places, including those that do not count."""

    observations: Observations
    """(n) of all ties; `observed_m` NaN where nothing could be measured."""
    columns: dict[str, npt.NDArray[Any]]
    """(n,) columns of the table `ties`; runs are indices here, and unmeasured values are NaN or infinite."""

    @property
    def accepted(self) -> npt.NDArray[np.bool_]:
        """Returns a mask (n,) of the ties that count."""
        return np.asarray(self.columns["accepted"] == 1)

    def counted(self) -> Observations:
        """Returns observations of the ties that count, for the adjustment."""
        return self.observations.chosen(self.accepted)

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Returns all of them, in order; groups are numbered anew."""
        if not parts:
            return cls(Observations.none(), _columns([], Observations.none(), np.zeros((0, 2, 3)), np.zeros((0, 2))))
        observations = Observations.joined([p.observations for p in parts])
        columns = {name: np.concatenate([p.columns[name] for p in parts]) for name in parts[0].columns}
        return cls(observations, columns | {"group": observations.group})


def ties_at(place: Place, readings: Sequence[PassReadings], settings: TieSettings) -> Ties:
    """Returns ties between the traverses of a place.

    Parameters
    ----------
    place : with a number that no other place has.
    readings : of each traverse, in the order of the place's; one without a reading there makes no tie.
    settings : cells, tests, what the σ are made of.

    Returns
    -------
    One row a tie, also for those that do not count.
    """
    dense = [one for one in readings if not one.returns]
    patches = [patch_of(place, one, settings.cell_m, settings.least_readings) for one in dense]
    pictures = Pictures([p for p in patches if p is not None], settings)
    found: list[Tie] = []
    for number, (a, b) in enumerate(pairs_of(len(pictures.patches))):
        found += [replace(tie, group=_GROUPS * number + tie.group) for tie in _of_pair(pictures, a, b)]
    planes = plane_ties(place, [one for one in readings if one.returns], settings)
    if not found:
        return as_ties(place, planes)
    above = 1 + max(tie.group for tie in found)
    return as_ties(place, [*shared(found), *(replace(tie, group=above + tie.group) for tie in planes)])


def pairs_of(count: int) -> list[tuple[int, int]]:
    """Pairs in a ring of so many traverses, first before second: each is tied to two others, and loops close."""
    ring = [(k, (k + 1) % count) for k in range(count)] if count > _PARTNERS else [(0, 1)] * (count == _PARTNERS)
    return sorted((min(pair), max(pair)) for pair in ring)


def _of_pair(pictures: Pictures, a: int, b: int) -> list[Tie]:
    """Returns ties of two patches; those of heads that passed together do not count for the poses."""
    first, second = pictures.patches[a], pictures.patches[b]
    height = height_tie(first, second, pictures.settings)
    # Where not even the heights agree, a match would not be of the road.
    found = [height, *(shift_ties(pictures, a, b) if height.counts else ())]
    apart_s = abs(first.epoch_gps_ns - second.epoch_gps_ns) / NS_PER_S
    if first.readings.run == second.readings.run and apart_s < pictures.settings.return_s:
        return [replace(tie, why_not=tie.why_not or SAME_PASS) for tie in found]
    return found


def shared(ties: Sequence[Tie]) -> list[Tie]:
    """Ties, with larger σ where there are more than needed: q ties of m traverses have m − 1 independent values."""
    out = list(ties)
    for kind in KINDS:
        counting = [k for k, tie in enumerate(out) if tie.kind == kind and tie.counts]
        traverses = {id(end.readings) for k in counting for end in out[k].ends}
        pairs = {(id(out[k].ends[0].readings), id(out[k].ends[1].readings)) for k in counting}
        weaker = math.sqrt(max(len(pairs) / max(len(traverses) - 1, 1), 1.0))
        for k in counting:
            out[k] = replace(out[k], sigma_m=out[k].sigma_m * weaker)
    return out


def as_ties(place: Place, found: Sequence[Tie]) -> Ties:
    """Returns observations and columns of ties of one place."""
    if not found:
        return Ties.joined([])
    n = len(found)
    direction = np.array([tie.direction_level for tie in found])
    derivatives, in_body, along = np.zeros((n, 2, 6)), np.zeros((n, 2, 3)), np.zeros((n, 2))
    for side in (0, 1):
        ends = [tie.ends[side] for tie in found]
        point, pose = np.array([end.point_m for end in ends]), np.array([end.pose for end in ends])
        seen = np.array([id(end.readings) for end in ends])
        for readings in {id(end.readings): end.readings for end in ends}.values():
            own = np.flatnonzero(seen == id(readings))
            arm = readings.arm_body_m(point[own], pose[own])
            derivatives[own, side] = partials(direction[own], readings.level_from_body[pose[own]], arm)
            in_body[own, side] = np.einsum("nji,nj->ni", readings.level_from_body[pose[own]], direction[own])
            along[own, side] = np.einsum("ni,ni->n", arm, in_body[own, side])
    derivatives[:, 1] *= -1.0
    in_body[:, 1] *= -1.0
    along[:, 1] *= -1.0
    observations = Observations(
        np.array([KINDS.index(t.kind) for t in found], np.uint8),
        np.array([[e.readings.run for e in t.ends] for t in found], np.int32),
        np.array([[e.readings.epoch_gps_ns[e.pose] for e in t.ends] for t in found], np.int64),
        derivatives,
        np.array([t.value_m for t in found]),
        np.array([t.sigma_m for t in found]),
        np.array([t.group for t in found], np.int64),
        np.full(n, place.number, np.int64),
    )
    return Ties(observations, _columns(found, observations, in_body, along))


def _columns(
    found: Sequence[Tie], observations: Observations, in_body: Float64, along_m: Float64
) -> dict[str, npt.NDArray[Any]]:
    """Returns columns of the table, with runs as indices."""
    point = np.array([t.ends[0].point_m for t in found]).reshape(-1, 3)
    direction = np.array([t.direction_level for t in found]).reshape(-1, 3)
    sensors = [[e.readings.sensor for e in t.ends] for t in found]
    axes = [(end, axis) for end in ("first", "second") for axis in ("forward", "right", "down")]
    return {
        **{f"{end}_by_{axis}": column for (end, axis), column in zip(axes, in_body.reshape(-1, 6).T, strict=True)},
        **{f"{end}_arm_along_m": column for end, column in zip(("first", "second"), along_m.T, strict=True)},
        "place": observations.place,
        "group": observations.group,
        "kind": np.array([t.kind for t in found], dtype=object),
        "first_run": observations.run[:, 0],
        "first_sensor": np.array([s[0] for s in sensors], dtype=object),
        "first_epoch_gps_ns": observations.epoch_gps_ns[:, 0],
        "second_run": observations.run[:, 1],
        "second_sensor": np.array([s[1] for s in sensors], dtype=object),
        "second_epoch_gps_ns": observations.epoch_gps_ns[:, 1],
        "easting_m": point[:, 0],
        "northing_m": point[:, 1],
        "height_m": point[:, 2],
        "direction_north": direction[:, 0],
        "direction_east": direction[:, 1],
        "direction_down": direction[:, 2],
        "value_m": observations.observed_m,
        "sigma_m": observations.sigma_m,
        **{f"{end}_laser": np.array([t.ends[k].laser for t in found]) for k, end in enumerate(("first", "second"))},
        "count": np.array([t.count for t in found], np.int32),
        "correlation": np.array([t.correlation for t in found], np.float64),
        "accepted": np.array([t.counts for t in found], np.uint8),
        "why_not": np.array([t.why_not for t in found], dtype=object),
    }
