"""Estimates noise from the run itself, before the smoother relies on it.

Constraints of a vehicle do not fit every carrier of the sensors equally, receivers state σ by different rules, and an
IMU errs by more than its data sheet says. Stated too small, each of them makes the σ of a trajectory too small, and
good measurements outliers. So a run is first solved with stretches of GNSS withheld, where three things are measured:

Constraints
    The innovations of each (velocity to the side and upwards, of the odometer, standing) must not scatter more than
    stated. Correlated errors count more than independent ones: the variance of a mean of n
    correlated values is C₀ + 2 Σ Cₖ over n (Geyer 1992, "Practical Markov chain Monte Carlo", section 3.3, whose
    initial positive sequence ends the sum). A constraint that fails is measured once more with almost no weight, so
    that it does not affect the solution by which it is measured, and then gets the measured σ.
GNSS
    The median of the normalised innovations against that of χ²/ν: a robust variance component (compare Mehra 1970, "On
    the identification of variances and adaptive Kalman filtering"). Multipath in a tenth of the time hardly moves it.
IMU
    Positions that the solution did not see against those that it predicts, over the σ that it states
    (cross-validation). Innovations over a fifth of a second do not show the noise that matters in an outage: that of
    biases that vibration shifts within seconds. The ratio, horizontal and vertical, becomes a factor of the IMU's
    noise.

Nothing is taken to be better than stated; but the share of vibration in the IMU's noise, which nobody states, may be.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.arrays import scatter_about
from roadscan.core.errors import NavigationError
from roadscan.core.frames import rotation_from_quaternion
from roadscan.core.settings.navigation import SmootherConfig
from roadscan.navigation.inertial.alignment import ecef_from_level
from roadscan.navigation.inertial.noise import fixes_of, usable
from roadscan.navigation.inertial.readings import (
    GnssSolutions,
    ImuReadings,
    Innovations,
    OdometerReadings,
    Solution,
    VehicleSensors,
)
from roadscan.navigation.inertial.smoother import solve
from roadscan.navigation.inertial.timeline import chosen

WITHHELD_S: Final = 10.0
"""Length of a stretch of GNSS that is withheld, where the run has no outages."""
_LENGTHS_S: Final = (5.0, 20.0)
"""Shortest and longest withheld stretch."""
_BETWEEN_S: Final = 5.0
"""GNSS is used for at least this long before and after a stretch."""
_FIRST_S: Final = 30.0
"""Nothing is withheld this soon after the first solution, which the alignment needs."""
_SILENCE_S: Final = 2.0
"""A longer silence of GNSS is an outage."""
_SETTLED_S: Final = 2.0
"""Constraints are judged from this long after GNSS came back."""
_MOST_STRETCHES: Final = 60  # Most withheld stretches of a run.
_CHI2_MEDIAN: Final = 2.365974 / 3.0
"""Median of χ² of three degrees of freedom, per component."""
_PRIOR: Final = 2.0
"""Weight of the stated noise, in stretches."""
_LEAST_STRETCHES: Final = 3  # With fewer stretches the IMU's noise is not estimated.
_LEAST_UPDATES: Final = 20  # With fewer updates a kind is not judged.
_MOST_PASSES: Final = 4  # Most passes that measure noise.
_FAILS: Final = 2.0
"""A constraint that scatters by more than this many times its σ fails; errors of springs and tyres last for a
while, too."""
_LOOSE: Final = 10.0
"""The σ of a constraint that failed is multiplied by this while it is measured."""
_LONGEST_LAG: Final = 10
"""Largest lag of correlated updates: two seconds."""
_TOLERANCE: Final = 1.35
"""Ratios of errors to σ up to it, and down to its inverse, are taken as right: ten stretches, with about two degrees of
freedom each, exceed it by chance in 1 % of all cases (square root of χ² over 20)."""
_GNSS_TOLERANCE: Final = 1.15
"""The same for innovations, of which there are hundreds."""
_SOUND: Final = 4.0
"""A withheld position counts where its stated variance is at most this many times the usual one: σ of solutions
that are not fixed are unreliable."""
_ANSWER: Final = 0.1
"""Least ratio of the change in errors over σ to a change of the IMU's noise, on logarithmic scales."""
_LEAST_FACTOR: Final = 0.5
"""Least factor on the IMU's noise: the share of vibration is a rule of thumb and may be smaller."""
_POSES_PER_S: Final = 20.0
"""Poses per second in the passes that measure noise."""
_FAR_SQUARED: Final = 9.0
"""Largest squared ratio of a stretch that counts: GNSS may err for a while."""
_LEAST_SQUARED: Final = 1e-6
"""Least squared ratio: simulated positions may be met exactly."""


@dataclass(frozen=True)
class _Constraint:
    """One component of the innovations of a kind, and the setting that states its σ."""

    kind: str
    components: tuple[int, ...]
    setting: str
    unit: float
    """Factor from the residual's unit to that of the setting."""
    said: str
    """Name of the quantity, for the user."""


_CONSTRAINTS: Final = (  # Constraints whose σ is measured; 1.0 is the factor from residual to setting.
    _Constraint("non-holonomic", (1,), "sideways_m_per_s", 1.0, "velocity to the side"),
    _Constraint("non-holonomic", (2,), "upwards_m_per_s", 1.0, "velocity upwards"),
    _Constraint("odometer", (0,), "odometer_sigma_m_per_s", 1.0, "speed of the odometer"),
    _Constraint("zero velocity", (0, 1, 2), "standing_m_per_s", 1.0, "velocity standing"),
    _Constraint("zero rotation", (0, 1, 2), "standing_deg_per_s", float(np.degrees(1.0)), "rotation standing"),
)


@dataclass(frozen=True)
class Adapted:
    """A solution, and the noise that it was computed with."""

    solution: Solution
    config: SmootherConfig
    """Settings with measured in place of stated noise."""
    measured: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Stated and measured value by setting that was wrong."""
    unmeasured: str = ""
    """Why the noise could not be measured."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Return the notes for the user."""
        said = [f"measured noise: {name} = {b:.3g} instead of {a:.3g}" for name, (a, b) in self.measured.items()]
        if self.unmeasured:
            said.append(f"the noise is taken as stated, it could not be measured: {self.unmeasured}")
        return tuple(said)


def solve_adaptively(
    imu: ImuReadings,
    gnss: GnssSolutions,
    odometer: OdometerReadings | None,
    vehicle: VehicleSensors,
    config: SmootherConfig,
) -> Adapted:
    """Compute the trajectory as :func:`~roadscan.navigation.inertial.smoother.solve`, with noise measured on the run.

    Parameters are those of `solve`; with `measure_noise` off the result is that of `solve`.

    Raises
    ------
    NavigationError
        as `solve`.
    """
    found, why_not = config, ""
    if config.measure_noise:
        try:
            found = _measured(imu, gnss, odometer, vehicle, config)
        except NavigationError as error:
            why_not = str(error)
    names = [name for name in type(config).model_fields if getattr(found, name) != getattr(config, name)]
    raised = {name: (getattr(config, name), getattr(found, name)) for name in names}
    return Adapted(solve(imu, gnss, odometer, vehicle, found), found, raised, why_not)


def _measured(
    imu: ImuReadings,
    gnss: GnssSolutions,
    odometer: OdometerReadings | None,
    vehicle: VehicleSensors,
    config: SmootherConfig,
) -> SmootherConfig:
    """Return settings whose noise agrees with the run."""
    gnss = chosen(gnss, usable(gnss))
    stretch = withheld(gnss.epochs_gps_ns)
    kept = chosen(gnss, stretch < 0)
    trial, failed, judged = config, frozenset[str](), False
    tried: list[dict[str, _Tried]] = []
    for _ in range(_MOST_PASSES):
        passed = trial.model_copy(update={"poses_per_s": min(config.poses_per_s, _POSES_PER_S)})
        solution = solve(imu, kept, odometer, vehicle, passed)
        innovations, before = solution.innovations, trial
        if innovations is None:
            break
        if not judged:
            trial, failed = _with_constraints(trial, config, innovations, kept, failed)
            judged = not failed
        if judged:
            trial = _with_gnss(trial, innovations)
            tried.append(_try(solution, gnss, stretch, trial))
            trial = trial.model_copy(update={name: _next_factor([t[name] for t in tried]) for name in tried[0]})
        if trial == before:
            break
    return trial


def withheld(epochs: Int64) -> Int64:
    """Return the number (m,) of the stretch in which a solution is withheld, −1 for those that are used.

    Stretches have the usual length of the run's outages, for which the noise has to be right.

    Parameters
    ----------
    epochs : (m,) of solutions, GPS ns.
    """
    number = np.full(epochs.size, -1)
    if epochs.size == 0:
        return number
    seconds = (epochs - epochs[0]) * 1e-9
    cuts = np.flatnonzero(np.diff(seconds) > _SILENCE_S) + 1
    edges = [0, *cuts.tolist(), epochs.size]
    length = float(np.clip(np.median(seconds[cuts] - seconds[cuts - 1]), *_LENGTHS_S)) if cuts.size else WITHHELD_S
    begins: list[float] = []
    for a, b in itertools.pairwise(edges):
        first, last = max(float(seconds[a]), _FIRST_S), float(seconds[b - 1])
        count = int((last - first - _BETWEEN_S) // (length + _BETWEEN_S))
        if count > 0:
            spare = (last - first - count * length) / (count + 1)
            begins += [first + spare + i * (length + spare) for i in range(count)]
    if len(begins) > _MOST_STRETCHES:
        begins = [begins[i] for i in np.linspace(0, len(begins) - 1, _MOST_STRETCHES).round().astype(int)]
    for i, begin in enumerate(begins):
        number[(seconds >= begin) & (seconds < begin + length)] = i
    return number


def _with_constraints(
    trial: SmootherConfig,
    config: SmootherConfig,
    innovations: Innovations,
    kept: GnssSolutions,
    failed: frozenset[str],
) -> tuple[SmootherConfig, frozenset[str]]:
    """Return settings with the σ of constraints from this run, and those that fail and are measured by the next pass.

    Parameters
    ----------
    trial : settings of the pass; config : as stated; innovations : of the pass, from the GNSS that is `kept`.
    failed : settings whose constraints failed before: this pass measured them.
    """
    settled = _settled(innovations.epochs_gps_ns, kept.epochs_gps_ns)
    values: dict[str, float] = {}
    fails: set[str] = set()
    for one in _CONSTRAINTS:
        rows = settled & (innovations.kind == one.kind)
        if np.count_nonzero(rows) < _LEAST_UPDATES:
            continue
        stated = getattr(config, one.setting)
        found = one.unit * lasting_sigma(innovations.residual[rows][:, one.components])
        if found > _FAILS * stated:
            fails.add(one.kind)
        values[one.setting] = found if found > _FAILS * stated else stated
    if failed:
        return trial.model_copy(update=values), frozenset()
    # A constraint pulls the solution and so hides its error: with one component, all of its kind are measured.
    loose = {one.setting: _LOOSE * values[one.setting] for one in _CONSTRAINTS if one.kind in fails}
    return trial.model_copy(update=loose), frozenset(loose)


def _settled(epochs: Int64, gnss: Int64) -> Bool:
    """Return True (u,) for epochs where GNSS has not been silent for the last seconds."""
    silent = np.diff(gnss) > _SILENCE_S * 1e9
    begins, ends = gnss[:-1][silent], gnss[1:][silent] + round(_SETTLED_S * 1e9)
    if not begins.size:
        return np.ones(epochs.size, bool)
    at = np.searchsorted(begins, epochs, side="left") - 1
    return np.asarray((at < 0) | (epochs > ends[np.maximum(at, 0)]))


def lasting_sigma(residuals: Float64) -> float:
    """Return the σ of white noise with the same variance of long means as residuals (n, c), of the worst column.

    Outlying values are clipped.
    """
    worst = 0.0
    for column in residuals.T:
        scale = scatter_about(column, 0.0)
        values = np.clip(column, -3.0 * scale, 3.0 * scale)
        lags = 2 * max(1, min(_LONGEST_LAG, values.size // 4) // 2)
        covariance = np.array([float((values[k:] * values[: values.size - k]).mean()) for k in range(lags)])
        # Sums of neighbouring autocovariances are positive as long as they exceed noise.
        pairs = covariance[0::2] + covariance[1::2]
        ends = np.flatnonzero(pairs <= 0.0)
        together = 2.0 * float(pairs[: ends[0] if ends.size else pairs.size].sum()) - covariance[0]
        worst = max(worst, together, covariance[0])
    return float(np.sqrt(worst))


def _with_gnss(trial: SmootherConfig, innovations: Innovations) -> SmootherConfig:
    """Return settings with the σ of GNSS raised to what its innovations show."""
    values: dict[str, float] = {}
    for kind, setting in (("gnss position", "gnss_position_factor"), ("gnss velocity", "gnss_velocity_factor")):
        ratio = _typical(innovations, kind)
        if ratio > _GNSS_TOLERANCE:
            values[setting] = getattr(trial, setting) * ratio
    return trial.model_copy(update=values)


def _typical(innovations: Innovations, kind: str) -> float:
    """Return the typical size of the innovations of GNSS in units of their σ."""
    rows = innovations.kind == kind
    if np.count_nonzero(rows) < _LEAST_UPDATES:
        return 1.0
    return float(np.sqrt(np.median(innovations.normalised[rows]) / _CHI2_MEDIAN))


@dataclass(frozen=True)
class _Tried:
    """A factor on the IMU's noise that was tried."""

    factor: float
    ratio: float
    """Ratio of the errors of withheld positions to their σ."""
    stretches: int

    @property
    def cautious(self) -> float:
        """Return the ratio, shrunk to 1 where few stretches determine it."""
        return float(np.sqrt((_PRIOR + self.stretches * self.ratio**2) / (_PRIOR + self.stretches)))


def _try(solution: Solution, gnss: GnssSolutions, stretch: Int64, trial: SmootherConfig) -> dict[str, _Tried]:
    """Compare withheld positions with the prediction for each factor on the IMU's noise."""
    squares = _missed(solution, gnss, stretch, trial)
    ratios = np.sqrt(np.maximum(squares.mean(axis=0), _LEAST_SQUARED)) if len(squares) else np.ones(2)
    names = ("imu_factor_horizontal", "imu_factor_vertical")
    return {n: _Tried(getattr(trial, n), r, len(squares)) for n, r in zip(names, ratios.tolist(), strict=True)}


def _next_factor(tried: Sequence[_Tried]) -> float:
    """Return the next factor on the IMU's noise to try.

    Where the ratio did not respond to the last change, the IMU's noise is not the cause, and the first factor is
    returned.
    """
    for before, after in itertools.pairwise(tried):
        change = np.log(after.factor / before.factor)
        if change != 0.0 and np.log(before.ratio / after.ratio) / change < _ANSWER:
            return tried[0].factor
    last = tried[-1]
    if 1.0 / _TOLERANCE <= last.cautious <= _TOLERANCE:
        return last.factor
    return max(last.factor * last.cautious, _LEAST_FACTOR)


def _missed(solution: Solution, gnss: GnssSolutions, stretch: Int64, config: SmootherConfig) -> Float64:
    """Squared error over variance of withheld positions, (s, 2): horizontal and vertical, mean of each stretch."""
    fixes = fixes_of(gnss, config)
    own = np.einsum("nii->ni", fixes.white) + fixes.coloured**2
    sound = own.sum(axis=1) <= _SOUND * np.median(own.sum(axis=1))
    epochs, ends = gnss.epochs_gps_ns, solution.epochs_gps_ns[[0, -1]]
    rows = np.flatnonzero((stretch >= 0) & sound & (epochs >= ends[0]) & (epochs <= ends[1]))
    if np.unique(stretch[rows]).size < _LEAST_STRETCHES:
        return np.zeros((0, 2))
    arm = solution.states["antenna_lever_arm_body_m"][0][-1]
    antenna = solution.position_world_m + rotation_from_quaternion(solution.quaternion_world_from_body) @ arm
    at = _interpolated(solution.epochs_gps_ns, gnss.epochs_gps_ns[rows], antenna - antenna[0])
    error = (at - (gnss.position_world_m[rows] - antenna[0])) @ ecef_from_level(antenna[:1])[0]
    stated = np.einsum("nii->ni", solution.covariance_position_ned_m2)
    variance = own[rows] + _interpolated(solution.epochs_gps_ns, gnss.epochs_gps_ns[rows], stated)
    number = stretch[rows]
    found = []
    for k in np.unique(number).tolist():
        e, v = error[number == k] ** 2, variance[number == k]
        found.append((e[:, :2].sum() / v[:, :2].sum(), e[:, 2].sum() / v[:, 2].sum()))
    return np.minimum(np.array(found), _FAR_SQUARED)


def _interpolated(known: Int64, wanted: Int64, values: Float64) -> Float64:
    """Return values (k, c) at epochs `known`, interpolated linearly at `wanted`."""
    since, at = (known - known[0]).astype(np.float64), (wanted - known[0]).astype(np.float64)
    columns: Sequence[Float64] = [np.interp(at, since, column) for column in values.T]
    return np.stack(columns, axis=-1)
