"""Attribution of disagreements: the fewest sensors or runs whose errors explain all differences between pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

import numpy as np

from roadscan.compute.array_types import Bool, Float64

MOST_FAULTS: Final = 3
"""At most this many errors are sought, the largest first."""
_MOST_SIGMAS: Final = 10.0
"""Larger differences count as this many σ: single ones may be wrong by far."""
_LEAST_GAIN: Final = 40.0
"""An error explains at least this much of the sum of squares (in σ²), and at least two differences."""
_LEAST_SUPPORT: Final = 2  # A reported error explains at least this many differences.
_SAME_GAIN: Final = 10.0
"""Explanations whose gains differ by less (σ²) are equally good."""
_POSE_SIGMAS: Final = 5.0  # An error common to poses of two runs counts from this many σ on.
_WITHIN: Final = 3.0
"""A difference within this many σ is explained."""


class End(NamedTuple):
    """One of the two ends of a comparison."""

    run: str
    sensor: str
    epoch_gps_ns: int
    """Time at which it saw the place."""
    sign: int
    """Sign with which its error enters the difference: −1 where its direction opposes that of the difference."""


class Difference(NamedTuple):
    """The second end minus the first."""

    ends: tuple[End, End]
    value: float
    sigma: float
    pose_sigma: float
    """σ of the poses of two runs, shared by all differences between them; 0 within a run."""


@dataclass(frozen=True)
class Suspect:
    """A sensor in a run, a sensor in all runs, or all sensors of a run (its poses)."""

    kind: Literal["log", "sensor", "run"]
    run: str
    sensor: str
    since_gps_ns: int
    """Time from which it is wrong; 0: all the time."""

    def factor(self, end: End) -> int:
        """Returns the factor with which its error enters the value at an end."""
        own = self.run in ("", end.run) and self.sensor in ("", end.sensor) and end.epoch_gps_ns >= self.since_gps_ns
        return end.sign if own else 0


@dataclass(frozen=True)
class Blamed:
    """An error that explains differences, and the sensors or runs of which one has it."""

    suspects: tuple[Suspect, ...]
    value: float
    """Error of the first suspect; that of another may have the other sign."""
    sigma: float
    support: int
    """Mask of the differences that it explains."""


class _Fit(NamedTuple):
    suspect: Suspect
    value: float
    sigma: float
    gain: float
    near: Bool
    """Mask of the differences that it explains."""
    factors: Float64

    @property
    def support(self) -> int:
        """Returns how many differences it explains."""
        return int(np.count_nonzero(self.near))

    @property
    def is_held(self) -> bool:
        """Returns True if it explains two differences, and most of those that it enters."""
        return self.support >= _LEAST_SUPPORT and 2 * self.support > int(np.count_nonzero(self.factors))


def whose(differences: Sequence[Difference], least: float) -> list[Blamed]:
    """Returns errors of at least `least` that explain the differences, the one that explains most first."""
    values = np.array([one.value for one in differences])
    of_poses = np.array([one.pose_sigma for one in differences])
    sigmas = np.hypot([one.sigma for one in differences], of_poses)
    suspects = _suspects(differences)
    factors = {one: np.array([one.factor(d.ends[1]) - one.factor(d.ends[0]) for d in differences]) for one in suspects}
    found: list[Blamed] = []
    for _ in range(MOST_FAULTS if differences else 0):
        fits = [_fit(one, factors[one].astype(np.float64), values, sigmas) for one in suspects if factors[one].any()]
        good = [f for f in fits if f.gain > _LEAST_GAIN and f.is_held and abs(f.value) > _bound(f, least, of_poses)]
        if not good:
            break
        most = max(one.gain for one in good)
        equal = sorted((f for f in good if f.gain > most - _SAME_GAIN), key=_plain)
        whole = [one for one in equal if not one.suspect.since_gps_ns] or equal[:1]
        best = whole[0]
        found.append(Blamed(tuple(f.suspect for f in _apart(whole)), best.value, best.sigma, best.support))
        values = values - best.factors * best.value
    return found


def _bound(fit: _Fit, least: float, of_poses: Float64) -> float:
    """Returns the least error that counts: poses of two runs may differ by some σ if nothing within a run shows it."""
    shared = float(of_poses[fit.near].min())
    return max(least, _POSE_SIGMAS * shared)


def _plain(fit: _Fit) -> tuple[int, int, float]:
    """Returns a sort key: errors that last all the time first, then those of single logs."""
    order = ("log", "run", "sensor").index(fit.suspect.kind)
    return int(fit.suspect.since_gps_ns > 0), order, -fit.gain


def _apart(fits: Sequence[_Fit]) -> list[_Fit]:
    """Returns the suspects that differ in more than their name."""
    kept: list[_Fit] = []
    for one in fits:
        same = (np.array_equal(one.factors, other.factors) for other in kept if one.suspect.kind == "sensor")
        if not any(same):
            kept.append(one)
    return kept


def _suspects(differences: Sequence[Difference]) -> list[Suspect]:
    ends = [end for one in differences for end in one.ends]
    logs = sorted({(end.run, end.sensor) for end in ends})
    groups = [("log", run, sensor) for run, sensor in logs]
    groups += [("run", run, "") for run in sorted({run for run, _ in logs})]
    groups += [("sensor", "", sensor) for sensor in sorted({sensor for _, sensor in logs})]
    found: list[Suspect] = []
    for kind, run, sensor in groups:
        whole = Suspect(kind, run, sensor, 0)  # type: ignore[arg-type]
        epochs = sorted({end.epoch_gps_ns for end in ends if whole.factor(end)}) if kind != "sensor" else []
        found += [whole, *(Suspect(whole.kind, run, sensor, epoch) for epoch in epochs[1:])]
    return found


def _fit(suspect: Suspect, factors: Float64, values: Float64, sigmas: Float64) -> _Fit:
    """Returns the error of a suspect that explains most, with the differences that it explains."""
    own = factors != 0.0
    tried = np.unique(values[own] / factors[own])
    best = min(tried.tolist(), key=lambda value: _cost(values - factors * value, sigmas))
    near = own & (np.abs(values - factors * best) < _WITHIN * sigmas)
    weight = np.where(near, 1.0 / sigmas**2, 0.0)
    normal = float((weight * factors**2).sum())
    value = float((weight * factors * values).sum() / normal) if normal else best
    gain = _cost(values, sigmas) - _cost(values - factors * value, sigmas)
    return _Fit(suspect, value, normal**-0.5 if normal else float("inf"), gain, near, factors)


def _cost(left: Float64, sigmas: Float64) -> float:
    return float(np.minimum((left / sigmas) ** 2, _MOST_SIGMAS**2).sum())
