"""Smooths trajectories in GNSS outages by piecewise cubic polynomials in time.

"The trajectory appears rugged mostly at places where there is a GPS signal outage. We smooth the trajectory by creating
a piecewise polynomial function": a cubic B-spline with time as its parameter (the mobile-mapping paper, 3.2, 3.2.1).
A trajectory is rugged for three reasons, and each is corrected by a different cubic:

- **Steps**: through an outage the solution drifts, and leaps back when GNSS returns. Value and slope of the leap fix a
  cubic c(t) with c = c' = 0 where the outage begins, which is added to the poses before the leap. Errors that grow with
  t² and t³ (biases of accelerometers and gyroscopes) are of this form, so they vanish.
- **Jitter**: positions scatter. A cubic B-spline of least squares, weighted by σ, takes their place.
- **Gaps**: no poses at all. The cubic of Hermite between the poses at both ends is the most likely path of a body whose
  acceleration is white noise; its variance q s³ (T − s)³ / (3 T³) gives the filled poses their σ, with q from gaps as
  long that are tried where the same trajectory has poses.

Attitude is treated alike in the tangent of a pose beside (rotation vectors, body axes). Outside the spans nothing
changes, to the bit; at their ends position and velocity are continuous.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
import scipy
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation, RotationSpline

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.arrays import runs_of, without_holes
from roadscan.core.errors import NavigationError
from roadscan.core.gpstime import NS_PER_S, iso_from_gps_ns
from roadscan.core.settings.navigation import SplineConfig
from roadscan.navigation.inertial.motion import ned_from_world
from roadscan.poses.trajectory import Trajectory

SIDE_S: Final = 0.5
"""Poses over this long beside a step or a gap determine the motion there."""
RECOVERY_S: Final = 1.0
"""Steps up to this long after an outage's end belong to it: a filter returns with more than one."""
_SIDE_POSES: Final = 4  # Least number of poses beside a step.
_TRIALS: Final = 200  # Most places at which the error of filled gaps is tried.
_TRUSTED: Final = 3.0
"""A change of velocity at a step counts only beyond this many σ."""

Kind = Literal["step", "jitter", "gap"]


@dataclass(frozen=True)
class Mended:
    """The correction of a span of a trajectory."""

    kind: Kind
    begin_gps_ns: int
    end_gps_ns: int
    """First and last epoch whose pose changed or is new."""
    poses: int
    greatest_shift_m: float
    """Largest shift; NaN for a gap, which had no poses."""
    rms_shift_m: float
    greatest_turn_rad: float
    sigma_m: float
    """Step: 1 σ of its size; jitter: scatter that was removed; gap: largest 1 σ of a filled position."""

    def __str__(self) -> str:
        span = f"{iso_from_gps_ns(self.begin_gps_ns)}, {(self.end_gps_ns - self.begin_gps_ns) / NS_PER_S:.2f} s"
        if self.kind == "gap":
            return f"gap ({span}): {self.poses} poses filled in, 1 σ up to {self.sigma_m:.3f} m"
        return (
            f"{self.kind} ({span}): {self.poses} poses moved by up to {self.greatest_shift_m:.3f} m "
            f"({self.rms_shift_m:.3f} m RMS) and turned by up to {np.degrees(self.greatest_turn_rad):.3f}°"
        )


@dataclass(frozen=True)
class Smoothed:
    """A smoothed trajectory and its changes."""

    trajectory: Trajectory
    changes: list[Mended]
    touched: Bool
    """(n,) poses of the result that changed or are new."""


@dataclass(frozen=True)
class _Side:
    """The motion beside a gap, at its end."""

    velocity_m_per_s: Float64
    """(3,) world."""
    rate_rad_per_s: Float64
    """(3,) body."""


@dataclass(frozen=True)
class _Leap:
    """A step between two poses: after less before."""

    shift_m: Float64
    """(3,) world."""
    sigma_m: float
    slope_m_per_s: Float64
    """(3,) change of the velocity."""
    sigma_slope_m_per_s: float
    turn_rad: Float64
    """(3,) body."""
    sigma_rad: float


def smoothed(
    trajectory: Trajectory, config: SplineConfig, outages_gps_ns: Sequence[tuple[int, int]] | None = None
) -> Smoothed:
    """Smooth a trajectory in GNSS outages.

    Parameters
    ----------
    trajectory : with σ where it is known.
    config : what counts as rugged, and how it is smoothed.
    outages_gps_ns : begin and end of each outage; found from σ where left out. Steps and jitter outside all outages
        are mended, too.

    Raises
    ------
    NavigationError
        where an outage ends before it begins.
    """
    if outages_gps_ns is None:
        outages_gps_ns = outages_by_sigma(trajectory, config)
    for begin, end in outages_gps_ns:
        if end <= begin:
            raise NavigationError(
                f"an outage ends at {iso_from_gps_ns(end)} and begins at {iso_from_gps_ns(begin)}",
                expected="an end after the begin",
            )
    if trajectory.epochs_gps_ns.size < 2 * _SIDE_POSES:
        return Smoothed(trajectory, [], np.zeros(trajectory.epochs_gps_ns.size, dtype=bool))
    changes: list[Mended] = []
    touched = np.zeros(trajectory.epochs_gps_ns.size, dtype=bool)
    for span in rugged_spans(trajectory, config):
        trajectory = _without_jitter(trajectory, span, config, changes, touched)
    for at, begin, beside in _leaps(trajectory, config, outages_gps_ns):
        trajectory = _without_step(trajectory, (begin, at, beside), config, changes, touched)
    return _filled(trajectory, config, changes, touched)


def outages_by_sigma(trajectory: Trajectory, config: SplineConfig) -> list[tuple[int, int]]:
    """Return spans in which the stated horizontal σ is far above its median; none where the trajectory states none."""
    if trajectory.sigma_ned_m is None:
        return []
    sigma = np.hypot(trajectory.sigma_ned_m[:, 0], trajectory.sigma_ned_m[:, 1])
    usual = float(np.nanmedian(sigma)) if np.isfinite(sigma).any() else 0.0
    high = sigma > max(config.outage_sigma_factor * usual, config.outage_sigma_m)
    spans = []
    for a, b in runs_of(high):
        # The drift begins where σ begins to grow, before it is far above the median.
        first = int(a)
        while first > 0 and sigma[first - 1] < sigma[first] and sigma[first - 1] > 1.05 * usual:
            first -= 1
        spans.append((int(trajectory.epochs_gps_ns[first]), int(trajectory.epochs_gps_ns[min(b, high.size - 1)])))
    return spans


def rugged_spans(trajectory: Trajectory, config: SplineConfig) -> list[tuple[int, int]]:
    """Return the first and last pose of spans in which increments scatter far more than usual."""
    surprise = np.linalg.norm(_surprises(trajectory), axis=1)
    usual = float(np.median(surprise[np.isfinite(surprise)])) if np.isfinite(surprise).any() else 0.0
    width = max(_SIDE_POSES, round(2 * SIDE_S / _step_s(trajectory)))
    scatter = _moving_median(np.nan_to_num(surprise), width)
    rugged = scatter > max(config.rugged_factor * usual, config.rugged_m)
    spans = []
    for a, b in runs_of(without_holes(rugged, width - 1)):
        first, last = max(a - width, 0), min(b + width, surprise.size)
        if _seconds(trajectory, int(first), int(last)) <= config.longest_s:
            spans.append((int(first), int(last)))
    return spans


def _surprises(trajectory: Trajectory) -> Float64:
    """Return increments (n − 1, 3) less those predicted from the neighbours; NaN beside a gap and at the ends."""
    seconds = np.diff(trajectory.epochs_gps_ns) / NS_PER_S
    steps = np.diff(trajectory.position_world_m, axis=0)
    speed = steps / seconds[:, None]
    out = np.full_like(steps, np.nan)
    out[1:-1] = steps[1:-1] - (speed[2:] + speed[:-2]) / 2 * seconds[1:-1, None]
    wide = seconds > trajectory.max_gap_s
    beside = wide.copy()
    beside[1:] |= wide[:-1]
    beside[:-1] |= wide[1:]
    out[beside] = np.nan
    return out


def _leaps(
    trajectory: Trajectory, config: SplineConfig, outages: Sequence[tuple[int, int]]
) -> list[tuple[int, int, slice]]:
    """Return steps in time: the pose before each, the pose at which its drift began, and undisturbed poses beside it.

    Within an outage every step (a standstill, a constraint) corrects the drift since the outage began; elsewhere it
    corrects only the drift since the step before.
    """
    surprise = np.linalg.norm(np.nan_to_num(_surprises(trajectory)), axis=1)
    usual = float(np.median(surprise))
    large = surprise > max(config.step_m, 8 * usual)
    # A step also changes the neighbouring residuals by half its size: only the largest counts.
    peak = large & (surprise >= np.maximum(np.append(surprise[1:], 0.0), np.append(0.0, surprise[:-1])))
    steps = np.flatnonzero(peak)
    bounds = [0, *(steps + 1).tolist(), trajectory.epochs_gps_ns.size]
    found = []
    for k, at in enumerate(steps.tolist()):
        begin, in_outage = _begin_of(trajectory, at, config, outages)
        begin = begin if in_outage else max(begin, bounds[k])
        if at - begin >= _SIDE_POSES and _seconds(trajectory, begin, at) <= config.longest_s:
            found.append((at, begin, slice(bounds[k], bounds[k + 2])))
    return found


def _begin_of(
    trajectory: Trajectory, at: int, config: SplineConfig, outages: Sequence[tuple[int, int]]
) -> tuple[int, bool]:
    """Pose at which the drift before a step began, after the last gap; and whether an outage determines it."""
    epochs = trajectory.epochs_gps_ns
    after_ns = round(RECOVERY_S * NS_PER_S)
    around = [b for b, e in outages if b < epochs[at] and epochs[at] <= e + after_ns]
    began = min(around) if around else int(epochs[at]) - round(config.step_reach_s * NS_PER_S)
    wide = np.flatnonzero(np.diff(epochs[: at + 1]) > trajectory.max_gap_s * NS_PER_S)
    after_gap = int(wide[-1]) + 1 if wide.size else 0
    return max(int(np.searchsorted(epochs, began)), after_gap), bool(around)


def _without_step(
    trajectory: Trajectory, step: tuple[int, int, slice], config: SplineConfig, changes: list[Mended], touched: Bool
) -> Trajectory:
    """Move the poses from the begin of the drift to the step by a cubic, so that they join those after it."""
    begin, at, beside = step
    epochs = trajectory.epochs_gps_ns
    middle = int(epochs[at]) + (int(epochs[at + 1]) - int(epochs[at])) // 2
    length = (middle - int(epochs[begin])) / NS_PER_S
    leap = _leap_at(trajectory, at, middle, beside)
    if np.linalg.norm(leap.shift_m) < max(config.step_m, _TRUSTED * leap.sigma_m):
        return trajectory
    rows = np.arange(begin + 1, at + 1)
    seconds = (epochs[rows] - epochs[begin]) / NS_PER_S
    shift = _cubic(seconds, length, leap.shift_m, _likely_slope(leap, length))
    turned = _trusted(leap.turn_rad, leap.sigma_rad)
    turn = _cubic(seconds, length, turned, turned / length)
    changes.append(_change("step", trajectory, rows, shift, turn, leap.sigma_m))
    touched[rows] = True
    return _moved(trajectory, rows, shift, turn)


def _leap_at(trajectory: Trajectory, at: int, middle: int, beside: slice) -> _Leap:
    """Return size and slope of a step, from one polynomial of degree 5 on both sides with a step and a bend.

    Motion that both sides share, such as that of the springs, does not count as a step.
    """
    epochs = trajectory.epochs_gps_ns
    count = max(_SIDE_POSES, round(SIDE_S / _step_s(trajectory)))
    rows = np.arange(max(at - count + 1, beside.start), min(at + 1 + count, beside.stop))
    seconds = (epochs[rows] - middle) / NS_PER_S
    near = np.abs(seconds) < 2 * SIDE_S + _step_s(trajectory)
    rows, seconds = rows[near], seconds[near]
    later = (seconds > 0).astype(np.float64)
    reference = Rotation.from_quat(trajectory.quaternion_world_from_body[at], scalar_first=True)
    turns = Rotation.from_quat(trajectory.quaternion_world_from_body[rows], scalar_first=True)
    degree = min(5, rows.size // 4)
    scale = SIDE_S
    smooth = np.vander(seconds / scale, degree + 1, increasing=True)
    columns = np.column_stack([smooth, later, later * seconds / scale])
    place, moved_m2 = _fitted(columns, trajectory.position_world_m[rows] - trajectory.position_world_m[at])
    angle, turned_rad2 = _fitted(columns[:, :-1], (reference.inv() * turns).as_rotvec())
    return _Leap(
        place[-2],
        float(np.sqrt(moved_m2[-2])),
        place[-1] / scale,
        float(np.sqrt(moved_m2[-1])) / scale,
        angle[-1],
        float(np.sqrt(turned_rad2[-1])),
    )


def _fitted(columns: Float64, values: Float64) -> tuple[Float64, Float64]:
    """Return coefficients (c, 3) of least squares and their variances (c,), of the axis that fits worst."""
    found: Float64 = np.asarray(np.linalg.lstsq(columns, values, rcond=None)[0], dtype=np.float64)
    rest = ((values - columns @ found) ** 2).sum(axis=0).max() / max(len(columns) - columns.shape[1], 1)
    variance: Float64 = rest * np.diag(np.linalg.pinv(columns.T @ columns))
    return found, variance


def _likely_slope(leap: _Leap, length: float) -> Float64:
    """Return the likely slope (3,) at the end of the drift, from the measurement and from the known growth of drift.

    An error of velocity grows with t, of acceleration with t², of rotation with t³: its slope at the end is one to
    three times its size over the length of the outage. The mean of both, weighted by their variances.
    """
    usual = 2.0 * leap.shift_m / length
    spread = 0.7 * float(np.linalg.norm(leap.shift_m)) / length
    part = spread**2 / (spread**2 + leap.sigma_slope_m_per_s**2)
    likely: Float64 = usual + part * (leap.slope_m_per_s - usual)
    return likely


def _cubic(seconds: Float64, length: float, value: Float64, slope: Float64) -> Float64:
    """Return (n, 3) at seconds since the begin: 0 with slope 0 there, a value and a slope (per second) at the end."""
    ends = scipy.interpolate.CubicHermiteSpline(
        [0.0, length], np.stack([np.zeros(3), value]), np.stack([np.zeros(3), slope])
    )
    values: Float64 = ends(seconds)
    return values


def _trusted(change: Float64, sigma: float) -> Float64:
    """Shrink a change by its noise (positive-part James–Stein)."""
    size2 = float(change @ change)
    return change * max(0.0, 1.0 - (_TRUSTED * sigma) ** 2 / size2) if size2 > 0 else change


def _side(trajectory: Trajectory, at: int, epoch: int, reference: Rotation, sign: int) -> _Side:
    """Return the motion at an epoch from the poses up to `at` (sign −1) or after it (1), by cubics in time."""
    epochs = trajectory.epochs_gps_ns
    count = max(_SIDE_POSES, round(SIDE_S / _step_s(trajectory)))
    rows = (
        np.arange(max(at - count + 1, 0), at + 1) if sign < 0 else np.arange(at + 1, min(at + 1 + count, epochs.size))
    )
    seconds = (epochs[rows] - epoch) / NS_PER_S
    near = np.abs(seconds) < SIDE_S + trajectory.max_gap_s
    rows, seconds = rows[near], seconds[near]
    turns = Rotation.from_quat(trajectory.quaternion_world_from_body[rows], scalar_first=True)
    moved = trajectory.position_world_m[rows] - trajectory.position_world_m[rows[0]]
    values = np.concatenate([moved, (reference.inv() * turns).as_rotvec()], axis=1)
    columns = np.vander(seconds, min(4, rows.size), increasing=True)
    slope = np.linalg.lstsq(columns, values, rcond=None)[0][1] if rows.size > 1 else np.zeros(6)
    return _Side(slope[:3], slope[3:])


def _without_jitter(
    trajectory: Trajectory, span: tuple[int, int], config: SplineConfig, changes: list[Mended], touched: Bool
) -> Trajectory:
    """Replace the poses of a span by a weighted cubic B-spline, with smooth transitions at both ends."""
    first, last = span
    rows = np.arange(first, last + 1)
    seconds = (trajectory.epochs_gps_ns[rows] - trajectory.epochs_gps_ns[first]) / NS_PER_S
    if np.diff(seconds).max(initial=0.0) > trajectory.max_gap_s or seconds[-1] < 2 * config.knot_s:
        return trajectory
    weights = np.ones(rows.size)
    if trajectory.sigma_ned_m is not None:
        sigma = np.linalg.norm(trajectory.sigma_ned_m[rows], axis=1)
        weights = np.where(sigma > 0, 1.0 / np.maximum(sigma, 1e-4), 1.0) if np.isfinite(sigma).all() else weights
    turns = Rotation.from_quat(trajectory.quaternion_world_from_body[rows], scalar_first=True)
    position = trajectory.position_world_m[rows] - trajectory.position_world_m[first]
    ease = _ease(seconds, min(config.ease_s, seconds[-1] / 2), first > 0, last < trajectory.epochs_gps_ns.size - 1)
    shift = ease[:, None] * (_spline(seconds, position, weights, config.knot_s) - position)
    turn = np.zeros((rows.size, 3))
    if _turns_are_rugged(trajectory, rows, config):
        turn = ease[:, None] * _smoothed_turns(seconds, turns, weights, config.knot_s)
    moved = np.flatnonzero(ease > 0.0)
    scatter = float(np.sqrt((shift[moved] ** 2).sum(axis=1).mean()))
    changes.append(_change("jitter", trajectory, rows[moved], shift[moved], turn[moved], scatter))
    touched[rows[moved]] = True
    return _moved(trajectory, rows[moved], shift[moved], turn[moved])


def _turns_are_rugged(trajectory: Trajectory, rows: Int64, config: SplineConfig) -> bool:
    """Return whether attitudes of a span scatter far more than the trajectory's usually do."""
    turns = Rotation.from_quat(trajectory.quaternion_world_from_body, scalar_first=True)
    steps = (turns[:-1].inv() * turns[1:]).as_rotvec()
    bends = np.linalg.norm(np.diff(steps, n=2, axis=0), axis=1)
    inside = bends[max(rows[0] - 1, 0) : rows[-1] - 1]
    return bool(np.median(inside) > config.rugged_factor * np.median(bends))


def _spline(seconds: Float64, values: Float64, weights: Float64, knot_s: float) -> Float64:
    """Return values (n, k) of the cubic B-spline of least squares, its knots about `knot_s` apart."""
    pieces = max(1, min(round(seconds[-1] / knot_s), seconds.size // _SIDE_POSES))
    # Knots follow the poses, so each piece has equally many.
    inner = np.quantile(seconds, np.arange(1, pieces) / pieces)
    knots = np.concatenate([np.repeat(seconds[0], 4), inner, np.repeat(seconds[-1], 4)])
    spline: Float64 = scipy.interpolate.make_lsq_spline(seconds, values, knots, k=3, w=weights)(seconds)
    return spline


def _smoothed_turns(seconds: Float64, turns: Rotation, weights: Float64, knot_s: float) -> Float64:
    """Return rotation vectors (n, 3), body axes, from attitudes to smoothed ones.

    In the tangent of a rotation spline through every tenth of a knot's poses or so, which carries the tangent through
    bends of any angle.
    """
    stride = max(1, round(seconds.size * knot_s / seconds[-1]))
    ends = np.unique(np.append(np.arange(0, seconds.size, stride), seconds.size - 1))
    carried = RotationSpline(seconds[ends], turns[ends])(seconds)
    tangent = _spline(seconds, (carried.inv() * turns).as_rotvec(), weights, knot_s)
    vectors: Float64 = (turns.inv() * carried * Rotation.from_rotvec(tangent)).as_rotvec()
    return vectors


def _filled(trajectory: Trajectory, config: SplineConfig, changes: list[Mended], touched: Bool) -> Smoothed:
    """Fill gaps up to `fill_gap_s` by Hermite's cubic, at the trajectory's usual rate."""
    epochs = trajectory.epochs_gps_ns
    steps = np.diff(epochs)
    usual = round(_step_s(trajectory) * NS_PER_S)
    gaps = np.flatnonzero((steps > 2.5 * usual) & (steps <= config.fill_gap_s * NS_PER_S))
    whole = trajectory
    for at in gaps:
        if min(at + 1, epochs.size - 1 - at) < _SIDE_POSES:
            continue
        pieces = round(int(steps[at]) / usual)
        new = epochs[at] + np.arange(1, pieces) * int(steps[at]) // pieces
        part = _bridge(trajectory, int(at), new)
        begin, end = int(new[0]), int(new[-1])
        sigma = part.sigma_ned_m if part.sigma_ned_m is not None else np.full((new.size, 3), np.nan)
        greatest = float(np.linalg.norm(sigma, axis=1).max())
        changes.append(Mended("gap", begin, end, new.size, np.nan, np.nan, np.nan, greatest))
        place = int(np.searchsorted(whole.epochs_gps_ns, begin))
        whole = _joined(whole, part, place)
        touched = np.insert(touched, np.full(new.size, place), True)
    return Smoothed(whole, sorted(changes, key=lambda c: c.begin_gps_ns), touched)


def _bridge(trajectory: Trajectory, at: int, new: Int64) -> Trajectory:
    """Return poses at new epochs between pose `at` and the next one, with their σ."""
    epochs = trajectory.epochs_gps_ns
    first, last = int(epochs[at]), int(epochs[at + 1])
    length, seconds = (last - first) / NS_PER_S, (new - first) / NS_PER_S
    reference = [Rotation.from_quat(trajectory.quaternion_world_from_body[k], scalar_first=True) for k in (at, at + 1)]
    before = _side(trajectory, at, first, reference[0], -1)
    after = _side(trajectory, at, last, reference[1], 1)
    position = _hermite(before, after, trajectory.position_world_m[at : at + 2], length, seconds)
    turn = (reference[0].inv() * reference[1]).as_rotvec()
    ends = scipy.interpolate.CubicHermiteSpline(
        [0.0, length],
        np.stack([np.zeros(3), turn]),
        np.stack([before.rate_rad_per_s, _tangent_rate(turn, after.rate_rad_per_s)]),
    )
    attitude = reference[0] * Rotation.from_rotvec(ends(seconds))
    sigma = _bridge_sigma(trajectory, at, seconds, length)
    return Trajectory(trajectory.world, new, position, attitude.as_quat(scalar_first=True), trajectory.max_gap_s, sigma)


def _hermite(before: _Side, after: _Side, ends_m: Float64, length: float, seconds: Float64) -> Float64:
    """Return positions (n, 3) between two poses (2, 3) with the velocities beside them."""
    origin = ends_m[0]
    curve = scipy.interpolate.CubicHermiteSpline(
        [0.0, length], ends_m - origin, np.stack([before.velocity_m_per_s, after.velocity_m_per_s])
    )
    positions: Float64 = curve(seconds) + origin
    return positions


def _tangent_rate(turn: Float64, rate: Float64) -> Float64:
    """Rate of a rotation vector from a body rate: the inverse right Jacobian (Chirikjian 2012, eq. 10.86)."""
    angle = float(np.linalg.norm(turn))
    crossed = np.cross(turn, rate)
    if angle < 1e-6:
        return rate + crossed / 2
    factor = 1 / angle**2 - (1 + np.cos(angle)) / (2 * angle * np.sin(angle))
    tangent: Float64 = rate + crossed / 2 + factor * np.cross(turn, crossed)
    return tangent


def _bridge_sigma(trajectory: Trajectory, at: int, seconds: Float64, length: float) -> Float64:
    """Return 1 σ (n, 3), north, east, down, of positions in a gap: of its ends, and of white acceleration noise."""
    ned = ned_from_world(trajectory.world, trajectory.position_world_m[at])
    push = 192.0 * _missed_m2(trajectory, length, ned) / length**3
    variance = push * (seconds * (length - seconds))[:, None] ** 3 / (3 * length**3)
    if trajectory.sigma_ned_m is not None:
        part = (seconds / length)[:, None]
        ends = trajectory.sigma_ned_m[at : at + 2] ** 2
        variance = variance + (1 - part) * ends[0] + part * ends[1]
    return np.sqrt(variance)


def _missed_m2(trajectory: Trajectory, length: float, ned: Float64) -> Float64:
    """Mean square error (3,), north, east, down, of Hermite's cubic in the middle of as long a gap elsewhere.

    NaN where the trajectory has no unbroken piece of that length.
    """
    epochs = trajectory.epochs_gps_ns
    step = _step_s(trajectory)
    inside = max(2, round(length / step))
    beside = max(_SIDE_POSES, round(SIDE_S / step))
    starts = np.arange(beside, epochs.size - inside - beside)
    span = (epochs[starts + inside + beside] - epochs[starts - beside]) / NS_PER_S
    starts = starts[span < 1.02 * (inside + 2 * beside) * step + 2 * step]
    if starts.size == 0:
        return np.full(3, np.nan)
    still = Rotation.identity()
    missed = []
    for start in starts[np.linspace(0, starts.size - 1, min(_TRIALS, starts.size)).astype(np.int64)]:
        end = int(start) + inside
        middle = int(start) + inside // 2
        before = _side(trajectory, int(start), int(epochs[start]), still, -1)
        after = _side(trajectory, end - 1, int(epochs[end]), still, 1)
        over = (epochs[end] - epochs[start]) / NS_PER_S
        at = np.array([(epochs[middle] - epochs[start]) / NS_PER_S])
        guess = _hermite(before, after, trajectory.position_world_m[[start, end]], over, at)[0]
        missed.append(ned @ (guess - trajectory.position_world_m[middle]))
    mean: Float64 = np.mean(np.square(missed), axis=0)
    return mean


def _joined(whole: Trajectory, part: Trajectory, place: int) -> Trajectory:
    at = np.full(part.epochs_gps_ns.size, place)
    sigma = whole.sigma_ned_m
    if sigma is None:
        sigma = np.full((whole.epochs_gps_ns.size, 3), np.nan)
    filled = part.sigma_ned_m if part.sigma_ned_m is not None else np.full((at.size, 3), np.nan)
    return replace(
        whole,
        epochs_gps_ns=np.insert(whole.epochs_gps_ns, at, part.epochs_gps_ns),
        position_world_m=np.insert(whole.position_world_m, at, part.position_world_m, axis=0),
        quaternion_world_from_body=np.insert(
            whole.quaternion_world_from_body, at, part.quaternion_world_from_body, axis=0
        ),
        sigma_ned_m=np.insert(sigma, at, filled, axis=0),
    )


def _moved(trajectory: Trajectory, rows: Int64, shift: Float64, turn: Float64) -> Trajectory:
    """Return the trajectory with some poses shifted (world axes) and turned (body axes)."""
    position = trajectory.position_world_m.copy()
    quaternion = trajectory.quaternion_world_from_body.copy()
    position[rows] += shift
    attitude = Rotation.from_quat(quaternion[rows], scalar_first=True) * Rotation.from_rotvec(turn)
    quaternion[rows] = attitude.as_quat(scalar_first=True)
    return replace(trajectory, position_world_m=position, quaternion_world_from_body=quaternion)


def _change(kind: Kind, trajectory: Trajectory, rows: Int64, shift: Float64, turn: Float64, sigma: float) -> Mended:
    epochs = trajectory.epochs_gps_ns[rows]
    size = np.linalg.norm(shift, axis=1)
    return Mended(
        kind,
        int(epochs[0]),
        int(epochs[-1]),
        rows.size,
        float(size.max()),
        float(np.sqrt((size**2).mean())),
        float(np.linalg.norm(turn, axis=1).max()),
        sigma,
    )


def _ease(seconds: Float64, over_s: float, begin: bool, end: bool) -> Float64:
    """Return weights (n,) that rise from 0 to 1 at the begin and fall to 0 at the end, with slopes of 0."""
    u = np.ones(seconds.size)
    if begin:
        u = np.minimum(u, seconds / over_s)
    if end:
        u = np.minimum(u, (seconds[-1] - seconds) / over_s)
    weights: Float64 = u * u * (3 - 2 * u)
    return weights


def _step_s(trajectory: Trajectory) -> float:
    """Return the usual time between poses."""
    return float(np.median(np.diff(trajectory.epochs_gps_ns))) / NS_PER_S


def _seconds(trajectory: Trajectory, first: int, last: int) -> float:
    last = min(last, trajectory.epochs_gps_ns.size - 1)
    return float(trajectory.epochs_gps_ns[last] - trajectory.epochs_gps_ns[first]) / NS_PER_S


def _moving_median(values: Float64, width: int) -> Float64:
    """Return the median (n,) of `width` values around each."""
    medians: Float64 = median_filter(values, size=width, mode="nearest")
    return medians
