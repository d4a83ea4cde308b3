"""What is left in pictures after the adjustment: residuals, and where the rays to control points meet.

Lenses and clocks of cameras held against pictures and poses as if nothing had been stated of them.

What the rig file states of a lens and what the stamps say of time are believed by the adjustment to their σ, and poses
take up what is wrong with them: a focal length is a scale of the scene, a late clock a way along the drive. Where the
vehicle turns, though, the turn in the pictures is that of the poses times the error of the focal length, and comes when
it comes. So both are estimated once more with σ that leave them free; the errors of poses keep the size that they have.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from roadscan.adjust.adjustment import Adjustment, CameraErrors, adjust
from roadscan.adjust.bundle.edge_boresight import EdgeBoresight
from roadscan.adjust.bundle.measurements import Measurements, State, Surfaces, depth_rows, met_at, residuals_px, seen
from roadscan.adjust.bundle.solve import Approached, PictureEvidence, entering, places, sharing, state_of
from roadscan.adjust.control import ControlPoint
from roadscan.adjust.observations import CAMERA, COMPONENTS, KINDS, CameraPrior, MountingPrior, Observations
from roadscan.adjust.settings import AdjustmentSettings
from roadscan.compute.array_types import Float64
from roadscan.core.canvas import empty_figure
from roadscan.core.gpstime import NS_PER_S
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


_FREE_FOCAL: Final = 0.2
"""1 σ of a focal length, as a share of it, of which nothing is known: a lens of another zoom or another camera."""
_FREE_K1: Final = 0.2
"""1 σ of k1 of which nothing is known: barrel distortion of a wide lens is −0.1 to −0.4."""
_FREE_CLOCK_S: Final = 0.5
"""1 σ (s) of a clock of which nothing is known: some pictures."""
_BEYOND: Final = 4.0
"""An error of so many σ is told: focal lengths and clocks of six draws of `drive_left` had up to 2.3, k1 up to 6.9."""
_BEYOND_STATED: Final = 3.0  # It is also so many σ of what is stated, which the adjustment would find by itself.
_ROUNDS: Final = 4
"""Solutions, each about the one before: a focal length that is 10 % off is found to 0.1 % in three."""
_LAGS: Final = 3  # Stamps are tried that are late or early by up to so many pictures.
_LEAST_TURNS: Final = 10  # Turns from picture to picture that are compared, at least.
_LESS: Final = 0.8
"""Stamps are those of other pictures where these leave less than this share of the squares. Of three disturbed drives
with right stamps the share was 2.1 or more, with stamps that were shifted by a picture (five cases) 0.32 to 0.48."""
_SURE: Final = 2.0  # … and where the mean gain is this many times its σ.
_LEAST_PICTURES: Final = 3  # Pictures of a camera whose motion is taken from one to the other.
_NEAR_S: Final = 1.0
"""Pictures before and after one tell its motion if they are so near in time (s): a vehicle sways once in a second."""
_MOST: Final = 20_000
"""Measurements that are used, about; of more, points are left out evenly. Some thousands determine a lens."""


@dataclass(frozen=True)
class FreeCameras:
    """What pictures and poses say of cameras by themselves."""

    stated: tuple[CameraPrior, ...]
    focal_px: Float64
    """(k,) focal length, along rows, as stated."""
    free: CameraErrors
    """Errors and σ where nothing is stated."""
    lag: tuple[int, ...]
    """(k,) by how many pictures stamps are late (negative: early), where the turns say so; else 0."""

    def off(self, k: int, name: str) -> tuple[float, float]:
        """Returns what a value (`CAMERA`) of a camera is off, 0 within its bounds, and 1 σ of that.

        The bounds are four σ of what pictures and poses say, and three of what is stated.
        """
        column = CAMERA.index(name)
        error, sigma = float(self.free.error[k, column]), float(self.free.sigma[k, column])
        within = max(_BEYOND * sigma, _BEYOND_STATED * float(self.stated[k].sigma[column]))
        return (error if abs(error) > within else 0.0), sigma

    def seen_from(self, k: int) -> float:
        """Returns the share of the focal length of a camera from which on an error of it would be told."""
        return _BEYOND * float(self.free.sigma[k, CAMERA.index("focal_x_px")] / self.focal_px[k])


def free_cameras(
    approach: Approached, adjusted: Adjustment, settings: AdjustmentSettings, mountings: Sequence[MountingPrior]
) -> FreeCameras | None:
    """Returns errors of lenses and clocks that are estimated without what is stated of them; None without pictures.

    Parameters
    ----------
    adjusted : the solution with what is stated; its measurements count as they do there, and its poses err as much.
    mountings : as the adjustment estimates them.
    """
    pictures, (others, first) = approach.pictures, approach.others
    if not approach.rows.measurement.size:
        return None
    stated = pictures.cameras
    focal = np.zeros(len(stated))
    for number, camera in zip(pictures.numbers.camera.tolist(), pictures.measured.exposures.cameras, strict=True):
        focal[number] = camera.interior.focal_px[0]
    cameras = [CameraPrior(one.sensor, _free_sigma(one.sigma, float(f))) for one, f in zip(stated, focal, strict=True)]
    quiet = settings.model_copy(update={"estimate_variance_components": False, "max_rounds": 2})
    factors = np.sqrt([adjusted.variance_factors[c] for c in COMPONENTS])
    runs = np.sqrt(adjusted.run_factors)
    priors = [one.wider(factors * own) for one, own in zip(adjusted.priors, runs, strict=True)]
    thinned = -(-approach.rows.measurement.size // 2 // _MOST)
    tie = pictures.measured.is_tie & (pictures.measured.point % thinned != 0)
    weight = np.where(tie, 0.0, approach.weight)
    heavy = np.sqrt(adjusted.variance_factors[KINDS[int(approach.rows.observations.kind[0])]])
    numbers, found = places(pictures, first), adjusted
    pictures = replace(pictures, measured=_moved_as(pictures.measured, state_of(adjusted)))
    for _ in range(_ROUNDS):
        state = _on_stamps(state_of(found))
        where = seen(pictures.measured, state, pictures.numbers)
        rows = entering(pictures, where, (met_at(pictures.measured, where, weight), numbers), weight, heavy)
        rows = sharing(rows, pictures, weight)
        found = adjust(Observations.joined([others, rows.observations]), priors, quiet, mountings, cameras)
    lags = [_lag(approach.pictures, state_of(adjusted), number) for number in range(len(stated))]
    return FreeCameras(stated, focal, found.cameras, tuple(lags))


def _lag(pictures: PictureEvidence, state: State, number: int) -> int:
    """Returns by how many pictures the stamps of a camera are late.

    Turns from picture to picture by the solution, which follows the pictures, are held against those of the recorded
    poses some pictures before or after.
    """
    from scipy.spatial.transform import Rotation

    exposures, every = pictures.measured.exposures, list[Float64]()
    for k, camera in enumerate(exposures.cameras):
        rows = np.flatnonzero(exposures.camera == k)
        known = state.corrections.get(camera.run)
        if int(pictures.numbers.camera[k]) != number or rows.size <= _LEAST_TURNS + 2 * _LAGS or known is None:
            continue
        recorded = exposures.world_from_body[rows]
        adjusted = recorded @ Rotation.from_rotvec(known.at(exposures.epoch_gps_ns[rows])[1]).as_matrix()
        found, stated = _turns(adjusted)[_LAGS:-_LAGS], _turns(recorded)
        ends = range(2 * _LAGS + 1)
        every.append(np.array([((found - stated[s : s + len(found)]) ** 2).sum(axis=1) for s in ends]))
    if not every:
        return 0
    squares = np.concatenate(every, axis=1)
    best = int(squares.sum(axis=1).argmin())
    better = squares[_LAGS] - squares[best]
    sigma = float(better.std()) / np.sqrt(better.size)
    told = squares[best].sum() < _LESS * squares[_LAGS].sum() and better.mean() > _SURE * sigma
    return _LAGS - best if told else 0


def _turns(turned: Float64) -> Float64:
    """Returns turns (n − 1, 3) from each of n attitudes to the next one."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(turned[:-1].transpose(0, 2, 1) @ turned[1:]).as_rotvec())


def _on_stamps(state: State) -> State:
    """Returns a state without what is added to stamps, about which clocks are linear here.

    Between two poses, and between two knots, errors are averaged, which would draw every clock there.
    """
    kept = np.array([0.0 if name == "clock_s" else 1.0 for name in CAMERA])
    return replace(state, cameras={number: kept * own for number, own in state.cameras.items()})


def _moved_as(measured: Measurements, state: State) -> Measurements:
    """Returns measurements whose pictures move as the solution has it, from the one before to the one after.

    The motion that poses themselves show from one to the next holds their noise, and a clock that is off would seem to
    take that away. Pictures that are farther apart keep it.
    """
    from scipy.spatial.transform import Rotation

    exposures = measured.exposures
    velocity, rate = exposures.velocity_world_m_s.copy(), exposures.rate_body_rad_s.copy()
    for number, camera in enumerate(exposures.cameras):
        rows = np.flatnonzero(exposures.camera == number)
        known = state.corrections.get(camera.run)
        if rows.size < _LEAST_PICTURES or known is None:
            continue
        epochs, body = exposures.epoch_gps_ns[rows], exposures.body_world_m[rows]
        shift, turn = known.at(epochs)
        body = body + np.einsum("nij,nj->ni", world_from_ned(camera.world, body), shift)
        turned = exposures.world_from_body[rows] @ Rotation.from_rotvec(turn).as_matrix()
        time_s = (epochs[2:] - epochs[:-2]) / NS_PER_S
        near = time_s <= _NEAR_S
        inner = rows[1:-1][near]
        velocity[inner] = ((body[2:] - body[:-2]) / time_s[:, None])[near]
        step = turned[:-2].transpose(0, 2, 1) @ turned[2:]
        rate[inner] = (Rotation.from_matrix(step).as_rotvec() / time_s[:, None])[near]
    return replace(measured, exposures=replace(exposures, velocity_world_m_s=velocity, rate_body_rad_s=rate))


def _free_sigma(stated: Float64, focal_px: float) -> Float64:
    """Returns 1 σ (11,) of a camera that is free in focal length, k1 and clock; of the rest it is as stated."""
    wide = dict.fromkeys(("focal_x_px", "focal_y_px"), _FREE_FOCAL * focal_px) | {"k1": _FREE_K1}
    wide = {name: one if stated[CAMERA.index(name)] else 0.0 for name, one in wide.items()} | {"clock_s": _FREE_CLOCK_S}
    return np.array([max(wide.get(name, 0.0), own) for name, own in zip(CAMERA, stated.tolist(), strict=True)])


_CELLS: Final = (16, 10)  # Columns and rows of the map.
_LEAST: Final = 4  # Measurements of a cell whose mean is shown.
_BEFORE: Final = "#d1495b"
_AFTER: Final = "#1f5fa8"


@dataclass(frozen=True)
class CameraResiduals:
    """Residuals of one camera's tie points that count."""

    camera: str
    size_px: tuple[int, int]
    pixel: Float64
    """(m, 2)"""
    before_px: Float64
    """(m, 2)"""
    after_px: Float64
    """(m, 2)"""


def residuals_of(found: PictureOutcome) -> Iterator[CameraResiduals]:
    """Yields the residuals of each camera, by name."""
    measured = found.measured
    cameras = measured.exposures.cameras
    of = np.array([cameras[k].sensor for k in measured.exposures.camera[measured.picture].tolist()])
    sound = np.isfinite(found.before_px).all(axis=1) & np.isfinite(found.after_px).all(axis=1)
    sound &= measured.is_tie & (found.weight > 0.0)
    for name in sorted(set(of.tolist())):
        rows = sound & (of == name)
        interior = next(camera.rig.interior for camera in cameras if camera.sensor == name)
        if rows.any() and interior is not None:
            size = interior.width_px, interior.height_px
            yield CameraResiduals(name, size, measured.pixel[rows], found.before_px[rows], found.after_px[rows])


def draw_residuals(shown: CameraResiduals, path: Path) -> None:
    """Draw the map of mean residuals and the histograms. Equal input gives equal bytes."""
    figure = empty_figure(11.0, 4.2, 120)
    figure.suptitle(f"tie points of {shown.camera}: {len(shown.pixel):,} measurements")
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    place, mean = _means(shown)
    longest = float(np.hypot(*mean.T).max(initial=0.0))
    if len(place):
        left.quiver(*place.T, *mean.T, angles="xy", color=_AFTER)
    left.set_xlim(0, shown.size_px[0])
    left.set_ylim(shown.size_px[1], 0)
    left.set_aspect("equal")
    left.set_title(f"mean of each part after the adjustment; longest {longest:.2f} px")
    limit = max(float(np.percentile(np.abs(shown.before_px), 95)), 0.5)
    edges = np.linspace(-limit, limit, 41)
    for values, colour, word in ((shown.before_px, _BEFORE, "before"), (shown.after_px, _AFTER, "after")):
        rms = float(np.sqrt(np.mean(values**2)))
        inside = np.clip(values.ravel(), -limit, limit)
        right.hist(inside, edges.tolist(), color=colour, alpha=0.6, label=f"{word}: RMS {rms:.2f} px")
    right.set_xlabel("measured minus computed (px)")
    right.legend(fontsize="small")
    figure.savefig(path, metadata={"Software": None})


def _means(shown: CameraResiduals) -> tuple[Float64, Float64]:
    """Returns middles (k, 2) of the cells with enough measurements, and their mean residuals (k, 2)."""
    columns, rows = _CELLS
    step = np.array(shown.size_px) / np.array([columns, rows])
    cell = np.clip((shown.pixel / step).astype(np.int64), 0, [columns - 1, rows - 1])
    number = cell[:, 1] * columns + cell[:, 0]
    count = np.bincount(number, minlength=columns * rows)
    sums = np.stack([np.bincount(number, v, minlength=columns * rows) for v in shown.after_px.T], axis=-1)
    kept = np.flatnonzero(count >= _LEAST)
    middle = np.stack([kept % columns + 0.5, kept // columns + 0.5], axis=-1) * step
    return middle, sums[kept] / count[kept][:, None]
