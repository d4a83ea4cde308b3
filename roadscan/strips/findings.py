"""Findings from strips: sensors that see no road, contradict the others, or are shifted along the travel."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from roadscan.core.gpstime import iso_from_gps_ns
from roadscan.core.witness import Finding, Witness
from roadscan.store.logs import LogRecord, log_of
from roadscan.store.manifest import Manifest
from roadscan.strips.strip import Lag
from roadscan.strips.tilt import Angle, Tilt
from roadscan.strips.whose import Blamed, Difference, End, Suspect, whose
from roadscan.strips.work import PRODUCT, Pair, SeenBy

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


SEES_ROAD: Final = Witness(
    "sees_road",
    input="lidar, profiler",
    fault="A sensor's readings lie where there is no road: its axes or mounting are stated wrong, or it is covered.",
    asks="on stretches of each run: the height of the sensor's readings below the vehicle, against the other sensors "
    "and runs",
    does="all readings are used where they lie; the sensor is named",
    told=("findings",),
)
READINGS_AGREE: Final = Witness(
    "readings_agree",
    input="lidar, profiler",
    fault="Readings contradict one another or those of the other sensors: wrong ranges, mounting, poses or clock.",
    asks="on stretches of each run: the median height of each cell of 0.1 m by 0.5 m, of the same sensor and of the "
    "others that saw it",
    does="heights of cells come from a robust estimate of all readings; the sensor, or those of which one is wrong, "
    "are named",
    told=("findings",),
)
ALONG_TRAVEL: Final = Witness(
    "along_travel",
    input="lidar, profiler, trajectory",
    fault="The clock of a sensor or of the poses is off, or a lever arm along the travel: at one speed these are one.",
    asks="on stretches of each run: likeness of heights and of intensities to those of the other sensors, and of other "
    "runs, shifted along the travel",
    does="all readings are used where they lie; the shift is named with its σ, and whose it is, or may be",
    told=("findings",),
)

_LEAST_READINGS: Final = 1000
"""With fewer readings nothing is reported."""
_LEAST_PLACED: Final = 0.05
"""A profiler with a smaller share of readings that have a return within range looks elsewhere, or is covered."""
_LEAST_ON_ROAD: Final = 0.05
"""If a smaller share of the readings beside the way lies at heights of a road, the sensor sees no road."""
_LEVEL_M: Final = 0.3
"""Road levels of sensors on one vehicle differ by less than this (m): crowns, kerbs, springs."""
_LEVEL_SHARE: Final = 0.2
"""A lidar with a smaller share of its readings beside the way at one level sees no ground at all."""
_ASTRAY: Final = 0.02
"""Greatest share of a profiler's readings more than 0.1 m off their cell: spray and dust are fewer. A lidar also sees
parts of the vehicle, and people beside it."""
_HEIGHT_M: Final = 0.1
"""Median heights of two sound sensors differ by less than this (m)."""
_HEIGHT_SIGMA_M: Final = 0.02  # Standard deviation of a difference of heights, before its spread is added (m).
_SPREAD_M: Final = 0.05
"""Heights of two sound sensors scatter by less than this (m) about their median difference, cell by cell."""
_SHIFT_M: Final = 0.06
"""Smaller shifts along the travel (m) cannot be distinguished from an error of a hand-measured lever arm."""


@dataclass(frozen=True)
class _Stretch:
    run: str
    sigma_m: tuple[float, float]
    speed_m_per_s: float
    sensors: tuple[SeenBy, ...]
    pairs: tuple[Pair, ...]


class _Names:
    """Names of logs as findings print them."""

    def __init__(self, records: Sequence[LogRecord], stretches: Sequence[_Stretch]) -> None:
        by_key = {record.key: record.path for record in records}
        self._poses = {r.run: r.path for r in records if r.tables.get("trajectory")}
        self._logs = {(s.run, s.sensor): by_key.get(log_of(s.file), "") for one in stretches for s in one.sensors}

    def log(self, run: str, sensor: str) -> str:
        return self._logs.get((run, sensor)) or f"{sensor} of {run}"

    def poses(self, run: str) -> str:
        return self._poses.get(run, f"poses of run '{run}'")

    def suspect(self, one: Suspect) -> str:
        if one.kind == "log":
            return self.log(one.run, one.sensor)
        if one.kind == "run":
            return self.poses(one.run)
        return f"{one.sensor} in all runs"


def strip_findings(records: Sequence[LogRecord], manifest: Manifest) -> list[Finding]:
    """Returns the findings on sensors that see no road, and on those that contradict the others."""
    stretches = [_stretch(record.figures()) for _, record in sorted(manifest.of(PRODUCT).items())]
    names = _Names(records, stretches)
    seen: dict[tuple[str, str], list[SeenBy]] = defaultdict(list)
    for one in stretches:
        for own in one.sensors:
            seen[own.run, own.sensor].append(own)
    blind = dict(_blind(seen))
    found = [SEES_ROAD.finds(names.log(*log), text) for log, text in blind.items()]
    found += [READINGS_AGREE.finds(names.log(*log), text) for log, text in _astray(seen) if log not in blind]
    heights = whose(list(_heights(stretches, set(blind))), _HEIGHT_M)
    found += [_finding(READINGS_AGREE, one, names, _height_words) for one in heights]
    if not heights:
        found += _scattered(stretches, set(blind), names)
    speed = float(np.median([one.speed_m_per_s for one in stretches])) if stretches else 0.0
    shifts = whose(list(_shifts(stretches, set(blind))), _SHIFT_M)
    far = [lag for one in stretches for pair in one.pairs for lag in pair.lags if abs(lag.lag_m) > _SHIFT_M]
    repeats = any(lag.repeats for lag in far)
    return [
        *found,
        *tilt_findings(seen, names.poses, names.log),
        *(
            _finding(ALONG_TRAVEL, one, names, lambda blamed: _shift_words(blamed, speed, repeats=repeats))
            for one in shifts
        ),
    ]


def _stretch(figures: Mapping[str, Any]) -> _Stretch:
    sensors = tuple(SeenBy(**{**one, "tilts": tuple(Tilt(*t) for t in one["tilts"])}) for one in figures["sensors"])
    return _Stretch(
        figures["run"],
        tuple(figures["sigma_m"]),
        figures["speed_m_per_s"],
        sensors,
        tuple(map(_pair, figures["pairs"])),
    )


def _pair(figures: Mapping[str, Any]) -> Pair:
    return Pair(**{**figures, "lags": tuple(Lag(*lag) for lag in figures["lags"])})


# --- no road --------------------------------------------------------------------------------------------


def _blind(seen: Mapping[tuple[str, str], Sequence[SeenBy]]) -> Iterator[tuple[tuple[str, str], str]]:
    levels = {log: [s.below_m for s in own if s.below_m is not None and s.readings] for log, own in seen.items()}
    for log, own in seen.items():
        others = [level for other in levels if other != log for level in levels[other]]
        sees = sum(other != log and bool(levels[other]) for other in levels)
        if text := _no_road(own, levels[log], others if sees > 1 else [], _road_of(others)):
            yield log, text


def _road_of(levels_m: Sequence[float]) -> str:
    return f"; the other sensors see it {np.median(levels_m):.2f} m below" if levels_m else ""


def _no_road(own: Sequence[SeenBy], levels_m: Sequence[float], others_m: Sequence[float], road: str) -> str:
    """Returns why a sensor sees no road, "" if it does; `others_m` : levels of several others, which agree."""
    given, placed = sum(s.given for s in own), sum(s.placed for s in own)
    beside, readings = sum(s.beside for s in own), sum(s.readings for s in own)
    is_profiler = own[0].is_profiler
    if given < _LEAST_READINGS or not (is_profiler or max(s.level_share for s in own) > _LEVEL_SHARE):
        return ""  # a lidar may be there to see façades
    if is_profiler and placed < _LEAST_PLACED * given:
        return (
            f"{placed:,} of {given:,} readings on stretches of the run have a return in the sensor's range: it looks "
            "elsewhere, is covered, or range_min_m and range_max_m are wrong"
        )
    if readings < _LEAST_ON_ROAD * beside or (is_profiler and beside < _LEAST_READINGS):
        above = [-s.below_m for s in own if s.below_m is not None]
        where = f"most of them {np.median(above):+.2f} m above the body's origin" if above else "none beside the way"
        return (
            f"{readings:,} of {placed:,} readings lie where a road can be, {where}{road}: axes, boresight or lever arm "
            "of the sensor are stated wrong, or it looks elsewhere"
        )
    if levels_m and others_m and abs(np.median(levels_m) - np.median(others_m)) > _LEVEL_M:
        return (
            f"its readings lie {np.median(levels_m):.2f} m below the body's origin, those of the other sensors and "
            f"runs {np.median(others_m):.2f} m: its mounting is stated wrong, or it sees something else than road"
        )
    return ""


# --- contradictions -------------------------------------------------------------------------------------


def _astray(seen: Mapping[tuple[str, str], Sequence[SeenBy]]) -> Iterator[tuple[tuple[str, str], str]]:
    for log, own in seen.items():
        astray, lane = sum(s.astray for s in own), sum(s.own_lane for s in own)
        if own[0].is_profiler and lane > _LEAST_READINGS and astray > _ASTRAY * lane:
            text = (
                f"{astray / lane:.1%} of the readings below and close to the vehicle lie more than 0.1 m off the "
                "others of their cell: ranges or poses are wrong, or parts of the vehicle are in sight"
            )
            yield log, text


def _ends(stretch: _Stretch, pair: Pair, *, by_way: bool) -> tuple[End, End]:
    one, other = (
        End(s.run, s.sensor, s.epoch_gps_ns, s.way if by_way else 1)
        for s in (stretch.sensors[pair.first], stretch.sensors[pair.second])
    )
    return one, other


def _of_poses(stretches: Sequence[_Stretch], ends: tuple[End, End], component: int) -> float:
    """Returns σ (m) of the difference of the poses of two runs, horizontal (0) or down (1); 0 within a run."""
    if ends[0].run == ends[1].run:
        return 0.0
    known = {one.run: one.sigma_m[component] for one in stretches}
    one, other = (known.get(end.run, max(known.values())) for end in ends)
    return float(np.hypot(one, other))


def _of_seeing(
    stretches: Sequence[_Stretch], blind: set[tuple[str, str]]
) -> Iterator[tuple[_Stretch, Pair]]:  # fmt: skip
    for one in stretches:
        for pair in one.pairs:
            if blind.isdisjoint((one.sensors[k].run, one.sensors[k].sensor) for k in (pair.first, pair.second)):
                yield one, pair


def _heights(stretches: Sequence[_Stretch], blind: set[tuple[str, str]]) -> Iterator[Difference]:
    for one, pair in _of_seeing(stretches, blind):
        sigma = float(np.hypot(_HEIGHT_SIGMA_M, pair.spread_m))
        ends = _ends(one, pair, by_way=False)
        yield Difference(ends, pair.away_m, sigma, _of_poses(stretches, ends, 1))


def _scattered(stretches: Sequence[_Stretch], blind: set[tuple[str, str]], names: _Names) -> list[Finding]:
    """Returns sensors whose heights scatter against most others, or pairs that scatter against one another."""
    pairs: dict[frozenset[tuple[str, str]], list[float]] = defaultdict(list)
    for one, pair in _of_seeing(stretches, blind):
        ends = _ends(one, pair, by_way=False)
        pairs[frozenset((end.run, end.sensor) for end in ends)].append(pair.spread_m)
    wide = {ends: spread for ends, own in pairs.items() if (spread := float(np.median(own))) > _SPREAD_M}
    found: list[Finding] = []
    while wide:
        logs = sorted({log for ends in wide for log in ends})
        share = {
            log: sum(log in ends for ends in wide) - sum(log in ends for ends in pairs if ends not in wide)
            for log in logs
        }
        most = max(share.values())
        worst = [log for log in logs if share[log] == most]
        spread = max(wide[ends] for ends in wide if worst[0] in ends)
        told = (
            f"heights scatter by {1e3 * spread:.0f} mm about those of the other sensors, cell by cell, where the same "
            "road was seen: mounting, poses or clock are wrong, or the ranges"
        )
        others = "" if len(worst) == 1 else f"; or those of {', '.join(names.log(*log) for log in worst[1:])} do"
        found.append(READINGS_AGREE.finds(names.log(*worst[0]), told + others))
        wide = {ends: spread for ends, spread in wide.items() if ends.isdisjoint(worst)}
    return found


def _height_words(one: Blamed) -> str:
    return (
        f"readings lie {one.value:+.3f} m (σ {one.sigma:.3f} m) above those of the other sensors and runs at the same "
        "places: ranges, mounting or the heights of poses are wrong"
    )


# --- along the travel -----------------------------------------------------------------------------------


def _shifts(stretches: Sequence[_Stretch], blind: set[tuple[str, str]]) -> Iterator[Difference]:
    for one, pair in _of_seeing(stretches, blind):
        for lag in pair.lags:
            ends = _ends(one, pair, by_way=True)
            yield Difference(ends, lag.lag_m, lag.sigma_m, _of_poses(stretches, ends, 0))


def _shift_words(one: Blamed, speed_m_per_s: float, *, repeats: bool) -> str:
    more = "; marks repeat there, and the least shift is told" if repeats else ""
    return (
        f"readings lie {one.value:+.3f} m (σ {one.sigma:.3f} m) along the travel from where the other sensors and runs "
        f"have the same road, by {one.support} comparisons of heights and intensities: their stamps are "
        f"{1e3 * one.value / speed_m_per_s:+.1f} ms late against the poses at {speed_m_per_s:.1f} m/s, or their place "
        f"along the travel is off (lever arm, boresight pitch){more}"
    )


def _finding(witness: Witness, one: Blamed, names: _Names, words: Callable[[Blamed], str]) -> Finding:
    first = one.suspects[0]
    since = f"from {iso_from_gps_ns(first.since_gps_ns)} on " if first.since_gps_ns else ""
    others = [names.suspect(other) for other in one.suspects[1:]]
    more = f"; nothing tells it from an error of {' or of '.join(others)}" if others else ""
    return witness.finds(names.suspect(first), f"{since}{words(one)}; all of them are used where they lie{more}")
