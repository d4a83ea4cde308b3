"""Findings on angles of the poses that the tilt of the road contradicts: wrong signs and units, mirrored profiles."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.core.witness import Finding, Witness
from roadscan.strips.tilt import Angle, Tilt
from roadscan.strips.work import SeenBy

ATTITUDE_SEEN: Final = Witness(
    "attitude_seen",
    input="trajectory, profiler, lidar",
    fault="Roll or pitch has the wrong sign or unit, is smoothed or late, or a sensor's profiles are mirrored.",
    asks="on stretches of each run: how much of the vehicle's sway, and how late, shows in the tilt of the road that "
    "each of its sensors saw",
    does="all readings are placed by the recorded angles; the poses, or the sensor that alone says so, are named",
    told=("findings",),
)

_SIGMAS: Final = 4.0
"""A share of the sway counts as wrong from this many σ on."""
_LEAST_AGAINST: Final = 0.15
"""A road that the vehicle follows fully leaves a share of 0; a wrong sign gives less than minus this."""
_MOST: Final = 1.4
"""Readings of sound poses confirm the sway once at most; more than this many times is another unit, or a filter."""
_LATE_SIGMAS: Final = 5.0
"""Lateness counts from this many σ on."""
_LEAST_LATE_S: Final = 0.025
"""Smaller lateness (s) is told by no tilt: the vehicle answers the road with as much delay."""
_EVEN: Final = 0.8
"""Lateness is asked of roads so even that this share of the sway shows: elsewhere the road itself leads the vehicle."""


@dataclass(frozen=True)
class _Seen:
    """What a sensor's stretches say of an angle of its run."""

    share: float
    sigma: float
    late_s: float
    sigma_late_s: float
    sway_deg: float

    @property
    def confirms(self) -> bool:
        """Returns True where the readings show that the sign is right."""
        return self.share - _SIGMAS * self.sigma > 0.0

    @property
    def against(self) -> bool:
        """Returns True where the readings tilt against the angle."""
        return self.share < -_LEAST_AGAINST and self.share + _SIGMAS * self.sigma < 0.0

    @property
    def small(self) -> bool:
        """Returns True where the vehicle swayed more than the angle says."""
        return self.share - _SIGMAS * self.sigma > _MOST

    @property
    def late(self) -> bool:
        """Returns True where the angle comes before or after the readings."""
        return (
            abs(self.late_s) > max(_LEAST_LATE_S, _LATE_SIGMAS * self.sigma_late_s)
            and self.share - self.sigma > 0.0
            and self.share + 2.0 * self.sigma > _EVEN
        )


def tilt_findings(
    seen: dict[tuple[str, str], list[SeenBy]], poses_of: Callable[[str], str], log_of: Callable[[str, str], str]
) -> Iterator[Finding]:
    """Yields the findings; `seen` by run and sensor; names of the poses of a run, and of a log of a run and sensor."""
    by_angle: dict[tuple[str, Angle], dict[str, list[Tilt]]] = defaultdict(lambda: defaultdict(list))
    for (run, sensor), own in seen.items():
        for tilt in (tilt for one in own for tilt in one.tilts):
            by_angle[run, tilt.angle][sensor].append(tilt)
    for (run, angle), sensors in by_angle.items():
        together = {sensor: _together(tilts) for sensor, tilts in sensors.items()}
        for verdict, words in _WORDS.items():
            named = {sensor: one for sensor, one in together.items() if getattr(one, verdict)}
            if not named:
                continue
            alone = any(one.confirms for sensor, one in together.items() if sensor not in named)
            who = " and ".join(named)
            subject = log_of(run, next(iter(named))) if alone else poses_of(run)
            text = words(angle, who, min(named.values(), key=lambda one: one.sigma), alone)
            yield ATTITUDE_SEEN.finds(subject, text)


def _together(tilts: Sequence[Tilt]) -> _Seen:
    share, sigma = _mean([t.share for t in tilts], [t.sigma for t in tilts])
    late, sigma_late = _mean([t.late_s for t in tilts], [t.sigma_late_s for t in tilts])
    return _Seen(share, sigma, late, sigma_late, float(np.median([t.sway_deg for t in tilts])))


def _mean(values: Sequence[float], sigmas: Sequence[float]) -> tuple[float, float]:
    """Returns the mean weighted by σ⁻², and its σ: from theirs, or from the scatter about it where that is larger."""
    value, sigma = np.array(values), np.maximum(sigmas, 1e-9)
    weight = sigma**-2.0
    mean = float((weight * value).sum() / weight.sum())
    scatter = float((weight * (value - mean) ** 2).sum()) / max(value.size - 1, 1)
    return mean, float(np.sqrt(max(scatter, 1.0) / weight.sum()))


def _against_words(angle: Angle, who: str, one: _Seen, alone: bool) -> str:
    why = (
        "its axes or mounting are stated wrong, or its readings are mirrored; the other sensors of the run confirm it"
        if alone
        else f"the sign of {angle} is wrong, or the readings are mirrored"
    )
    return (
        f"the road that {who} saw tilts with the {angle} of the poses instead of standing still: it confirms "
        f"{one.share:+.2f} (σ {one.sigma:.2f}) of a sway of {one.sway_deg:.2f}°, where +1 is right and 0 the least of "
        f"sound poses; {why}; all readings are placed by it"
    )


def _small_words(angle: Angle, who: str, one: _Seen, alone: bool) -> str:
    why = "its axes or mounting are stated wrong" if alone else "the angle has another unit, or is smoothed"
    return (
        f"the road that {who} saw sways {one.share:.2f} (σ {one.sigma:.2f}) times as much as the {angle} of the poses "
        f"({one.sway_deg:.2f}°); {why}; all readings are placed by it"
    )


def _late_words(angle: Angle, who: str, one: _Seen, alone: bool) -> str:
    why = "the clock of the sensor is off" if alone else "the angles are filtered, or the clock of either is off"
    return (
        f"the {angle} of the poses is {1e3 * abs(one.late_s):.0f} ms (σ {1e3 * one.sigma_late_s:.0f} ms) "
        f"{'late' if one.late_s > 0.0 else 'early'} against the tilt of the road that {who} saw (sway "
        f"{one.sway_deg:.2f}°): {why}; all readings are placed by it"
    )


_WORDS: Final[dict[str, Callable[[Angle, str, _Seen, bool], str]]] = {
    "against": _against_words, "small": _small_words, "late": _late_words,
}  # fmt: skip
"""The words of each verdict of `_Seen`."""
