"""Observations of an adjustment, each a number that corrections of poses explain, and the processes of poses' errors.

A correction is that of `schemas/corrections.toml`: north, east, down (m, local level) and a small turn about the axes
of the body (rad). A point of the body, `arm_body_m` from its origin, moves in local level by

    d = position + R · (turn × arm),    R = level from body.

An observation with direction n (unit, local level) sees n · d of each of its ends, so its partial derivatives by the
six corrections are n and arm × (Rᵀ n) (Skaloud & Lichti 2006, linearised). Its second end counts negatively: after the
correction, the two ends agree along n.

The mounting of the sensor that saw an end moves the point as well: by a change of the lever arm, by a small turn about
the axes of the body at the sensor's origin, and by a scale of its ranges. Those derivatives are Rᵀ n,
(arm − lever arm) × (Rᵀ n), and that along the direction of the point's way from the sensor, of which a head with
parallel beams lengthens the part along its beams alone.

Errors of a run's poses are stochastic processes, sampled at knots. An error is b(t) u(t) + e(t) v(t). Here u is a
first-order Gauss–Markov process of unit variance, with the covariance e^(−|Δt|/τ) (Gelb 1974, 3.8), and b(t) is the σ
that the logs state of each pose. In an outage, where σ is much larger than usual, b stays at the usual one and e(t) =
√(σ² − b²): the rest is another process, independent in each outage, because the error in an outage is independent of
those before and after it. It drifts: what is added while e grows does not follow from what was there, nor does what is
left when e has shrunk tell what there was. So its covariance is min(e, e')² e^(−|Δt|/τ), that of a random walk (Gelb
1974, 3.8) while e grows. Were it e e' e^(−|Δt|/τ), the first centimetres of a drift of metres would be known to a
hundredth of what they grow to, and with it the poses beside the outage.

At knots u is the sequence u(k+1) = φ u(k) + w, φ = e^(−h/τ), var w = 1 − φ², without any approximation; of an outage φ
is smaller by the ratio of e at both knots. Between knots the adjustment is linear; the variance of the process about
the line has a closed form (`line_variance`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Final, Self

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int32, Int64, UInt8
from roadscan.compute.arrays import runs_of
from roadscan.core.errors import ConfigError
from roadscan.core.gpstime import NS_PER_S
from roadscan.pictures.lens import COLUMNS
from roadscan.poses.trajectory import Seat

KINDS: Final = (
    "height_tie", "shift_tie", "plane_tie", "control_height", "control_position", "head_tie", "hand_tie",
    "picture_tie", "picture_control", "picture_depth", "picture_edge",
)  # fmt: skip
"""Height of one pass against another's; shift of one image or relief against another's; distance of two planes;
height, or a component of the place, of a control point; height of one head against that of another of the same pass;
what a person found in two passes; column or row of a tie point, or of a control point, in a picture; distance of a
tie point from a surface that a lidar saw; turn of a camera that range edges of a lidar show (rad)."""

COMPONENTS: Final = ("north_m", "east_m", "down_m", "roll_rad", "pitch_rad", "heading_rad")
"""The unknowns of a pose, in the order of the partial derivatives."""

MOUNTED: Final = ("forward_m", "right_m", "down_m", "roll_rad", "pitch_rad", "heading_rad", "range_scale")
"""The unknowns of a mounting: lever arm and a turn that follows the boresight, both along the axes of the body, and the
share by which ranges are longer."""

TURNS: Final = {name: MOUNTED.index(name) for name in COMPONENTS[3:]}
"""Components of a pose that a turn of a mounting looks like, and the number of that turn in `MOUNTED`."""

CAMERA: Final = COLUMNS
"""The unknowns of a camera beside its mounting: its lens (OpenCV's parameters), what is added to the stamps of its
pictures, and to the time between the exposures of two rows."""

COMMON: Final = ("first_laser", "second_laser", "roll")
"""Errors that ties of a lidar have in common: of the ranges of the lasers that saw their ends, and a roll that
all ties of one drive seem to show."""

FIXED: Final = -1
"""Run of an end that no correction moves: a control point, or a tie point of pictures."""


@dataclass(frozen=True)
class Observations:
    """n observations; `observed_m` = Σ over ends of partials · correction, plus noise of `sigma_m`."""

    kind: UInt8
    """(n,) index into `KINDS`."""
    run: Int32
    """(n, 2) index of the run of each end; `FIXED` for control."""
    epoch_gps_ns: Int64
    """(n, 2) epoch of the pose of each end; 0 for control."""
    partials: Float64
    """(n, 2, 6) derivatives by `COMPONENTS`, the sign of the end included; 0 for control."""
    observed_m: Float64
    """(n,) second end minus first along the direction, as the recorded poses place them; of control: surveyed minus
    measured."""
    sigma_m: Float64
    """(n,) 1 σ, without that of the poses."""
    group: Int64
    """(n,) observations of one group stand or fall together: the two components of one shift."""
    place: Int64
    """(n,) number of the place, or control point."""
    survey_sigma_m: Float64 = field(default_factory=lambda: np.zeros(0))
    """(n,) of control: 1 σ of the surveyed coordinate along the direction, apart from `sigma_m`, which is that of the
    measurement alone. All observations of a control point share the error of its survey. 0 for ties; zeros where none
    are given."""
    sensor: Int32 = field(default_factory=lambda: np.zeros((0, 2), np.int32))
    """(n, 2) number of the sensor that saw each end; −1 where its mounting is not estimated."""
    mount_partials: Float64 = field(default_factory=lambda: np.zeros((0, 2, len(MOUNTED))))
    """(n, 2, 7) derivatives by `MOUNTED` of that sensor, the sign of the end included."""
    camera: Int32 = field(default_factory=lambda: np.zeros(0, np.int32))
    """(n,) number of the camera whose lens and clock are estimated, −1: none."""
    camera_partials: Float64 = field(default_factory=lambda: np.zeros((0, len(CAMERA))))
    """(n, 11) derivatives by `CAMERA` of that camera."""
    common: Int32 = field(default_factory=lambda: np.zeros((0, len(COMMON)), np.int32))
    """(n, 3) numbers of errors that ties have in common, `COMMON`; −1: none."""
    common_partials: Float64 = field(default_factory=lambda: np.zeros((0, len(COMMON))))
    """(n, 3) derivatives by each of them, in units of its prior σ."""

    def __post_init__(self) -> None:
        if len(self.camera) != self.kind.size or len(self.camera_partials) != self.kind.size:
            object.__setattr__(self, "camera", np.full(self.kind.size, -1, np.int32))
            object.__setattr__(self, "camera_partials", np.zeros((self.kind.size, len(CAMERA))))
        if len(self.sensor) != self.kind.size or len(self.mount_partials) != self.kind.size:
            object.__setattr__(self, "sensor", np.full((self.kind.size, 2), -1, np.int32))
            object.__setattr__(self, "mount_partials", np.zeros((self.kind.size, 2, len(MOUNTED))))
        if len(self.common) != self.kind.size:
            object.__setattr__(self, "common", np.full((self.kind.size, len(COMMON)), -1, np.int32))
            object.__setattr__(self, "common_partials", np.zeros((self.kind.size, len(COMMON))))
        if self.survey_sigma_m.size != self.kind.size:
            if self.survey_sigma_m.size:
                raise ValueError(f"{self.survey_sigma_m.size} σ of a survey for {self.kind.size} observations")
            object.__setattr__(self, "survey_sigma_m", np.zeros(self.kind.size))

    @property
    def size(self) -> int:
        """Returns the number of observations."""
        return self.kind.size

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Returns all of them, in order; groups are numbered anew."""
        if not parts:
            return cls.none()
        columns = {f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)}
        groups, last = [], 0
        for part in parts:
            _, own = np.unique(part.group, return_inverse=True)
            groups.append(own.astype(np.int64) + last)
            last += int(own.max()) + 1 if own.size else 0
        columns["group"] = np.concatenate(groups)
        return cls(**columns)

    @classmethod
    def none(cls) -> Self:
        """Returns an empty set."""
        return cls(
            np.zeros(0, np.uint8), np.zeros((0, 2), np.int32), np.zeros((0, 2), np.int64), np.zeros((0, 2, 6)),
            np.zeros(0), np.zeros(0), np.zeros(0, np.int64), np.zeros(0, np.int64),
        )  # fmt: skip

    def chosen(self, which: npt.NDArray[np.bool_] | Int64) -> Self:
        """Returns a subset."""
        return type(self)(**{f.name: getattr(self, f.name)[which] for f in fields(self)})


def mount_partials(in_body: Float64, arm_turns: Float64, arm_along_m: Float64, seat: Seat) -> tuple[Float64, Float64]:
    """Returns derivatives of the movement along a direction by the mounting of a sensor (n, 7), and by a range (n,).

    Parameters
    ----------
    in_body : (n, 3) the direction in body axes.
    arm_turns : (n, 3) derivatives by a turn of the pose: arm × direction.
    arm_along_m : (n,) arm · direction.
    seat : of the sensor, rows (n, 3).
    """
    arm = arm_along_m[:, None] * in_body + np.cross(in_body, arm_turns)
    way = seat.by_scale(arm)
    by_scale = np.einsum("ni,ni->n", in_body, way)
    by_mounting = np.column_stack([in_body, arm_turns - np.cross(seat.lever_body_m, in_body), by_scale])
    return by_mounting, by_scale / np.maximum(np.linalg.norm(way, axis=-1), 1e-3)


def partials(direction_level: Float64, level_from_body: Float64, arm_body_m: Float64) -> Float64:
    """Returns derivatives (n, 6) of the movement along a direction by the corrections of a pose.

    Parameters
    ----------
    direction_level : (n, 3) unit vectors, north-east-down.
    level_from_body : (n, 3, 3) rotation of the recorded pose.
    arm_body_m : (n, 3) from the body's origin to the point, body axes (m).
    """
    in_body = np.einsum("nji,nj->ni", level_from_body, direction_level)
    return np.concatenate([direction_level, np.cross(arm_body_m, in_body)], axis=-1)


_OUTAGE: Final = float(np.sqrt(2.0))
"""Factor of σ above the usual one that marks an outage: at least half of its variance is not of the usual kind."""
_BUDGET: Final = 4.0
"""Knots added to a run, at most, as a multiple of the evenly spaced ones."""
_MOST_MORE: Final = 15
"""Most knots added within an interval of even knots: they are 6 ms apart where the others are 0.1 s."""


@dataclass(frozen=True)
class GaussMarkov:
    """First-order Gauss–Markov process of one component."""

    sigma: float
    """Usual 1 σ (m or rad), also at all times where a run's logs state none; 0: the component is not corrected."""
    tau_s: float
    """Correlation time (s)."""


@dataclass(frozen=True)
class StatedSigma:
    """Stated 1 σ of a run's poses over time, from its logs."""

    epochs_gps_ns: Int64
    """(k,) ascending, one or more."""
    sigma: Float64
    """(k, 6) m and rad, in the order of `COMPONENTS`; columns of NaN where the logs state none of a component."""

    def __post_init__(self) -> None:
        known = np.isfinite(self.sigma)
        if self.sigma.shape != (self.epochs_gps_ns.size, len(COMPONENTS)) or not self.epochs_gps_ns.size:
            raise ConfigError(
                f"σ of the shape {self.sigma.shape} at {self.epochs_gps_ns.size} epochs", expected="(k, 6)"
            )
        if (known.any(axis=0) & ~known.all(axis=0)).any() or (self.sigma[known] <= 0.0).any():
            raise ConfigError(
                "σ of poses that are not positive numbers throughout", expected="σ above 0, or none at all"
            )

    def at(self, epochs_gps_ns: Int64) -> Float64:
        """Returns σ (n, 6), linear between the stated epochs, and the end values beyond them."""
        since, known = ((e - self.epochs_gps_ns[0]).astype(np.float64) for e in (epochs_gps_ns, self.epochs_gps_ns))
        return np.stack([np.interp(since, known, column) for column in self.sigma.T], axis=-1)

    def beside_outages(self, usual: Float64, epochs_gps_ns: Int64) -> Float64:
        """Returns the part (n, 6) of σ that an outage leaves as it is; `usual` (6,) while one lasts, else σ.

        An outage lasts as long as σ is above the usual one. Were only what is far above it left to the drift, the error
        beside the outage would seem to grow in proportion where it begins, and its size would follow from how it grows.
        """
        held = self.sigma.copy()
        for column, most in zip(held.T, usual.tolist(), strict=True):
            for first, end in runs_of(column > most).tolist():
                if column[first:end].max() > _OUTAGE * most:
                    column[first:end] = most
        return StatedSigma(self.epochs_gps_ns, held).at(epochs_gps_ns)


@dataclass(frozen=True)
class RunPrior:
    """Prior knowledge of the errors of a run's poses."""

    run: str
    first_gps_ns: int
    last_gps_ns: int
    processes: tuple[GaussMarkov, GaussMarkov, GaussMarkov, GaussMarkov, GaussMarkov, GaussMarkov]
    """In the order of `COMPONENTS`; independent of one another."""
    stated: StatedSigma | None = None
    """σ over time, which replaces the usual one in the corrected components that it states."""
    fixed: bool = False
    """True where the recorded poses are final, and those of other runs are adjusted to them."""
    exposures_gps_ns: Int64 = field(default_factory=lambda: np.zeros(0, np.int64))
    """(e,) ascending, when pictures were taken: many measurements share the pose of one instant, so that a line between
    knots would be off for all of them at once."""

    def __post_init__(self) -> None:
        if self.last_gps_ns < self.first_gps_ns:
            raise ConfigError(
                f"run '{self.run}' ends at {self.last_gps_ns} ns, before it begins at {self.first_gps_ns} ns",
                expected="first_gps_ns ≤ last_gps_ns",
            )
        for name, process in zip(COMPONENTS, self.processes, strict=True):
            usable = np.isfinite([process.sigma, process.tau_s]).all() and process.sigma >= 0.0 and process.tau_s > 0.0
            if not usable:
                raise ConfigError(
                    f"process of {name} of run '{self.run}' with σ {process.sigma:g} and τ {process.tau_s:g} s",
                    expected="σ of 0 or more and a positive τ",
                )

    @property
    def sigmas(self) -> Float64:
        """Returns (6,) usual 1 σ."""
        return np.array([p.sigma for p in self.processes])

    def sigma_at(self, epochs_gps_ns: Int64) -> Float64:
        """Returns 1 σ (n, 6) of the poses' errors at epochs (n,)."""
        usual = np.broadcast_to(self.sigmas, (epochs_gps_ns.size, len(COMPONENTS)))
        if self.stated is None:
            return usual.copy()
        stated = self.stated.at(epochs_gps_ns)
        return np.where(np.isfinite(stated) & (usual > 0.0), stated, usual)

    def parts_at(self, epochs_gps_ns: Int64) -> Float64:
        """Parts b and e of that σ at epochs (n,): (n, 6), or (n, 12) with e where there is an outage among them."""
        sigma = self.sigma_at(epochs_gps_ns)
        usual = sigma if self.stated is None else np.fmin(sigma, self.stated.beside_outages(self.sigmas, epochs_gps_ns))
        extra = np.sqrt(np.maximum(sigma**2 - usual**2, 0.0))
        return np.concatenate([usual, extra], axis=1) if extra.any() else usual

    def widened(self, more_m: Float64) -> RunPrior:
        """Returns the same with this much added 1 σ (3,; north, east, down) of the position, at all times."""
        more = np.concatenate([more_m, np.zeros(3)])
        n, e, d, r, p, h = (
            replace(o, sigma=float(np.hypot(o.sigma, m))) for o, m in zip(self.processes, more, strict=True)
        )
        stated = self.stated and StatedSigma(self.stated.epochs_gps_ns, np.hypot(self.stated.sigma, more))
        return replace(self, processes=(n, e, d, r, p, h), stated=stated)

    def faster(self, position: float, attitude: float) -> RunPrior:
        """Returns the same with correlation times that are so many times shorter."""
        times = (position,) * 3 + (attitude,) * 3
        n, e, d, r, p, h = (replace(o, tau_s=o.tau_s / t) for o, t in zip(self.processes, times, strict=True))
        return replace(self, processes=(n, e, d, r, p, h))

    def wider(self, factors: Float64) -> RunPrior:
        """Returns the same with σ that are (6,) times as large."""
        pairs = zip(self.processes, factors.tolist(), strict=True)
        n, e, d, r, p, h = (replace(o, sigma=o.sigma * factor) for o, factor in pairs)
        stated = None if self.stated is None else replace(self.stated, sigma=self.stated.sigma * factors)
        return replace(self, processes=(n, e, d, r, p, h), stated=stated)

    @property
    def taus_s(self) -> Float64:
        """Returns (6,) correlation times (s)."""
        return np.array([p.tau_s for p in self.processes])


@dataclass(frozen=True)
class MountingPrior:
    """Prior knowledge of the mounting of a sensor."""

    sensor: str
    sigma: Float64
    """(7,) 1 σ of its errors (m, rad, share), in the order of `MOUNTED`; 0: not estimated."""
    run: str = "*"
    """Run with this mounting; "*": all runs without a separate one."""

    @property
    def key(self) -> tuple[str, str]:
        """Returns run and sensor."""
        return self.run, self.sensor


@dataclass(frozen=True)
class CameraPrior:
    """Prior knowledge of a camera's lens and clock."""

    sensor: str
    sigma: Float64
    """(11,) 1 σ of their errors, in the order of `CAMERA`; 0: not estimated."""


def knots_of(prior: RunPrior, spacing_s: float) -> Int64:
    """Returns epochs (k,) of a run's knots from its first epoch to its last, at most `spacing_s` apart.

    They are evenly spaced but where σ is larger than usual: there they are closer, as the variance by which the process
    leaves a line between knots, about σ² h / (3 τ), would grow with σ². How many there are has a bound. Where a picture
    was taken, its epoch stands in for even knots that are nearer than half the spacing.
    """
    span = prior.last_gps_ns - prior.first_gps_ns
    intervals = max(1, -(-span // max(1, round(spacing_s * NS_PER_S))))
    if span == 0:
        return np.array([prior.first_gps_ns], np.int64)
    steps = np.arange(intervals + 1, dtype=np.int64)
    even = np.asarray(prior.first_gps_ns + (span // intervals) * steps + (span % intervals) * steps // intervals)
    if prior.exposures_gps_ns.size:
        even = _at_exposures(even, prior.exposures_gps_ns, round(0.5 * spacing_s * NS_PER_S))
    if prior.stated is None:
        return even
    more = _more_knots(prior, even)
    parts = [even]
    for k in range(1, int(more.max(initial=0)) + 1):
        own = more >= k
        parts.append(even[:-1][own] + np.diff(even)[own] * k // (more[own] + 1))
    return np.unique(np.concatenate(parts))


def _at_exposures(even: Int64, exposures_gps_ns: Int64, near_ns: int) -> Int64:
    """Returns knots (k,) with the epochs of exposures in place of those near them; the first and the last one stay."""
    own = exposures_gps_ns[(exposures_gps_ns > even[0]) & (exposures_gps_ns < even[-1])]
    own = own[np.diff(own, prepend=even[0]) > near_ns // 10] if own.size else own
    if not own.size:
        return even
    after = np.clip(np.searchsorted(own, even), 0, own.size - 1)
    before = np.maximum(after - 1, 0)
    away = np.minimum(np.abs(own[after] - even), np.abs(own[before] - even))
    away[[0, -1]] = near_ns + 1
    return np.union1d(even[away > near_ns], own)


def _more_knots(prior: RunPrior, even: Int64) -> Int64:
    """Returns the number of knots (k − 1,) added within each even interval."""
    usual = np.where(prior.sigmas > 0.0, prior.sigmas, np.inf)
    within = np.concatenate([even, (even[:-1] + even[1:]) // 2])
    ratio = (prior.sigma_at(within) / usual).max(axis=1)
    largest = np.maximum(np.maximum(ratio[: even.size - 1], ratio[1 : even.size]), ratio[even.size :])
    wanted = np.clip(0.5 * largest**2 - 1.0, 0.0, _MOST_MORE)
    fits = min(1.0, _BUDGET * largest.size / max(float(wanted.sum()), 1.0))
    return np.asarray(np.floor(wanted * fits), np.int64)


def precision_of(epochs_gps_ns: Int64, tau_s: float, drift: Float64 | None = None) -> tuple[Float64, Float64]:
    """Returns the inverse covariance of a process, in its σ, at knots: its diagonal (k,) and that beside it (k − 1,).

    Rue & Held (2005, 1.1): a Markov process has a tridiagonal one.

    drift : (k,) σ of the error in an outage.
    """
    step = np.diff(epochs_gps_ns) / NS_PER_S / tau_s
    if drift is not None:
        step = step + np.abs(np.diff(np.log(drift)))
    keep, gain = np.exp(-step), -1.0 / np.expm1(-2.0 * step)
    diagonal = np.ones(epochs_gps_ns.size)
    diagonal[1:] = gain
    diagonal[:-1] += keep**2 * gain
    return diagonal, -keep * gain


def stretches(there: npt.NDArray[np.bool_]) -> list[slice]:
    """Returns runs of neighbours that are True."""
    return [slice(first, end) for first, end in runs_of(there).tolist()]


def line_variance(
    share: Float64,
    step_s: Float64,
    tau_s: float | Float64,
    sigma: tuple[float | Float64, float | Float64] = (1.0, 1.0),
    drifts: bool | npt.NDArray[np.bool_] = False,
) -> Float64:
    """Returns the variance of a process about the straight line between two knots.

    Parameters
    ----------
    share : where between the knots, 0 to 1.
    step_s : from knot to knot (s).
    tau_s : correlation time (s).
    sigma : of the process at the first and at the second knot, between which it is linear.
    drifts : whether it is that of an outage. All broadcast.

    Notes
    -----
    Var[x(t) − (1 − λ) x(0) − λ x(h)] of the covariance σ(t) σ(t') e^(−|Δt|/τ); for h ≪ τ and an even σ it is
    2 σ² λ (1 − λ) h / τ. In an outage the covariance is min(σ(t), σ(t'))² e^(−|Δt|/τ).
    """
    left, right = (1.0 - share) * sigma[0], share * sigma[1]
    middle, least = left + right, np.minimum(sigma[0], sigma[1])
    # Written with e^x − 1: the terms of order one cancel.
    whole, to_left, to_right = (np.expm1(-d / tau_s) for d in (step_s, share * step_s, (1.0 - share) * step_s))
    even = left * right * whole - middle * (left * to_left + right * to_right)
    drift = share * (1.0 - share) * (least**2 * whole + np.abs(np.subtract(*sigma)) * middle)
    drift -= (1.0 - share) * np.minimum(sigma[0], middle) ** 2 * to_left
    drift -= share * np.minimum(sigma[1], middle) ** 2 * to_right
    return np.maximum(2.0 * np.where(drifts, drift, even), 0.0)
