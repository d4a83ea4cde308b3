"""What is left in pictures after the adjustment: residuals, and where the rays to control points meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.adjust.adjustment import Adjustment
from roadscan.adjust.bundle.depths import Surfaces, depth_rows
from roadscan.adjust.bundle.edge_boresight import EdgeBoresight
from roadscan.adjust.bundle.measurements import Measurements, State, met_at, residuals_px, seen
from roadscan.adjust.bundle.solve import Approached, PictureEvidence, state_of
from roadscan.adjust.control.control import ControlPoint
from roadscan.adjust.observations import KINDS
from roadscan.compute.array_types import Float64
from roadscan.pictures.ties.tracks import places_of
from roadscan.poses.trajectory import world_from_ned

_BOUNDS: Final = (0.025, 0.975)
"""Chances below and above which χ² is out of its bounds: 95 % of right solutions lie between."""


_SINGULAR: Final = 1e12
"""Condition from which on a place is not determined: σ along the rays is then a million times that across them."""


@dataclass(frozen=True)
class ControlOfPictures:
    """A control point as the rays of its pictures meet: easting-like axes are north, east, down of the level."""

    point: ControlPoint
    pictures: int
    before_m: Float64
    """(3,) met minus surveyed, north, east, down, by the recorded poses; NaN where fewer than two pictures see it."""
    after_m: Float64
    """(3,) the same by the adjusted poses."""
    sigma_m: Float64
    """(3,) 1 σ of where the rays meet, without that of the poses."""


@dataclass(frozen=True)
class DepthOutcome:
    """Distances of tie points from k surfaces of lidars."""

    surfaces: Surfaces
    before_m: Float64
    """(k,) with the recorded poses and stated mountings."""
    after_m: Float64
    """(k,) with what was adjusted."""
    sigma_m: Float64
    """(k,)"""
    weight: Float64
    """(k,) 1 = counts fully, 0 = rejected."""


@dataclass(frozen=True)
class PictureOutcome:
    """Residuals of m measurements, and control points."""

    measured: Measurements
    before_px: Float64
    """(m, 2) observed minus computed, with the recorded poses and the points where their rays meet."""
    after_px: Float64
    """(m, 2) the same with what was adjusted."""
    weight: Float64
    """(m,) 1 = counts fully, 0 = rejected; NaN of check points."""
    control: tuple[ControlOfPictures, ...]
    names: tuple[str, ...]
    """(p,) name of each point's control point, "" of tie points."""
    sigma_px: float
    """1 σ of a tie point, as measured."""
    chi_square: float
    """Weighted squares over redundancy of all rows of pictures; 1 where all is as stated."""
    bounds: tuple[float, float]
    """Between which it lies with a chance of 95 %."""
    notes: tuple[str, ...]
    depths: DepthOutcome | None = None
    """Distances from surfaces of lidars; None where there are none."""
    moving: int = 0
    """Tie points that lidars saw elsewhere."""
    edges: tuple[EdgeBoresight, ...] = ()
    """What range edges say of boresights."""
    against_edges: float = 0.0
    """By how many σ they contradicted tie points, until these counted less; 0 where they agree."""
    shared_px: float = 0.0
    """1 σ of what the tie points of a picture are off in common (px), as they entered."""

    def rms_px(self, *, after: bool) -> float:
        """Returns the root mean square of each coordinate of tie points, each counting by its weight."""
        values = self.after_px if after else self.before_px
        used = (self.weight > 0.0) & self.measured.is_tie & np.isfinite(values).all(axis=1)
        weight = self.weight[used]
        if not weight.size:
            return float("nan")
        return float(np.sqrt((weight[:, None] * values[used] ** 2).sum() / (2.0 * weight.sum())))


def outcome_of(approach: Approached, adjusted: Adjustment, points: Sequence[ControlPoint]) -> PictureOutcome:
    """Returns what is left by an adjustment; the rows of the pictures are the last ones of its observations."""
    from scipy.special import chdtri

    pictures, rows = approach.pictures, approach.rows
    measured, own = pictures.measured, slice(adjusted.weight.size - rows.measurement.size, None)
    weight = approach.weight
    counted = np.where(pictures.enters, weight, 0.0)
    state = state_of(adjusted)
    before, after = (_residuals(pictures, one, counted) for one in (State(), state))
    left = adjusted.residual_m[own] / rows.alone_sigma_m
    factor = adjusted.variance_factors[KINDS[int(rows.observations.kind[0])]] if rows.observations.size else 1.0
    squares = float((adjusted.weight[own] * left**2).sum()) / factor
    redundancy = float(np.where(adjusted.weight[own] > 0.0, np.nan_to_num(adjusted.redundancy[own]), 0.0).sum())
    degrees = max(redundancy, 1.0)
    low, high = (float(chdtri(degrees, 1.0 - chance)) / degrees for chance in _BOUNDS)
    named = {one.number: one for one in points}
    control = [
        _control(pictures, number, named[int(pictures.control[number])], (State(), state))
        for number in np.flatnonzero(pictures.control >= 0).tolist()
    ]
    names = tuple(named[k].name if k >= 0 else "" for k in pictures.control.tolist())
    return PictureOutcome(
        measured, before, after, np.where(pictures.enters, weight, np.nan), tuple(control), names, approach.sigma_px,
        squares / degrees, (low, high), pictures.notes, _depths(approach, adjusted, state), int(approach.moving.size),
        pictures.edges, approach.against_edges, pictures.shared_px,
    )  # fmt: skip


def _depths(approach: Approached, adjusted: Adjustment, state: State) -> DepthOutcome | None:
    """Returns distances from surfaces; their rows come right before those of the pictures."""
    surfaces, depths, pictures = approach.surfaces, approach.depths, approach.pictures
    if surfaces is None or depths is None or not depths.surface.size:
        return None
    values, stated = [], (pictures.depth_sigma_m, approach.depth_weight)
    for one in (State(), state):
        where = seen(pictures.measured, one, pictures.numbers)
        place = met_at(pictures.measured, where, np.where(pictures.enters, approach.weight, 0.0))
        first = np.arange(len(place))
        rows = depth_rows(pictures.measured, surfaces, one, pictures.numbers, (place, first), *stated)
        values.append(rows.value_m[depths.surface])
    last = adjusted.weight.size - approach.rows.measurement.size
    weight = adjusted.weight[last - depths.surface.size : last]
    weight = weight * approach.depth_weight[surfaces.measurement[depths.surface]]
    before, after = values
    return DepthOutcome(surfaces.at(depths.surface), before, after, depths.observations.sigma_m, weight)


def _residuals(pictures: PictureEvidence, state: State, weight: Float64) -> Float64:
    measured = pictures.measured
    where = seen(measured, state, pictures.numbers)
    return residuals_px(measured, where, met_at(measured, where, weight))


def _control(
    pictures: PictureEvidence, number: int, point: ControlPoint, states: tuple[State, State]
) -> ControlOfPictures:
    """Returns where the rays of one control point meet, by the recorded poses and by the adjusted ones."""
    measured = pictures.measured.at(np.flatnonzero(pictures.measured.point == number))
    surveyed = measured.surveyed_world_m[number]
    nowhere = np.full(3, np.nan)
    if measured.point.size < 2:
        return ControlOfPictures(point, int(measured.point.size), nowhere, nowhere, nowhere)
    cameras = [measured.exposures.cameras[k] for k in measured.exposures.camera[measured.picture].tolist()]
    weight = (np.array([np.mean(camera.interior.focal_px) for camera in cameras]) / measured.sigma_px) ** 2
    axes = world_from_ned(cameras[0].world, surveyed[None])[0]
    met = []
    for state in states:
        where, alone = seen(measured, state, pictures.numbers), np.zeros(measured.point.size, np.int64)
        met.append(places_of(alone, where.eye_world_m, where.rays_world(measured.pixel), weight))
    before, after = (axes.T @ (own.place_m[0] - surveyed) for own in met)
    return ControlOfPictures(point, int(measured.point.size), before, after, _sigma_of(met[1].precision[0], axes))


def _sigma_of(precision: Float64, axes: Float64) -> Float64:
    """Returns 1 σ (3,; north, east, down) of a place; NaN where its inverse covariance has no inverse."""
    if not np.isfinite(precision).all() or np.linalg.cond(precision) > _SINGULAR:
        return np.full(3, np.nan)
    return np.asarray(np.sqrt(np.diag(axes.T @ np.linalg.inv(precision) @ axes)))
