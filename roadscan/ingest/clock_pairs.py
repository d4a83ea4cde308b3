"""Reads the survey file's pairs of stamps, fits them, and applies them to the clock of their log."""

from __future__ import annotations

import csv
import datetime as dt
import functools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Final

import numpy as np

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.clock_evidence import USUAL_DRIFT, Drift, PairEvidence
from roadscan.core.errors import ConfigError, FormatError, RoadscanError, TimeSystemError
from roadscan.core.gpstime import NS_PER_S, UNIT_NS, WEEK_S, Clock, TimeSystem
from roadscan.core.survey import ClockConfig, LogConfig, Survey
from roadscan.ingest.clock_correction import ClockCorrection, Line, Residuals, robust_line
from roadscan.ingest.reading.stamps import CALENDAR_SCALES, parse_calendar
from roadscan.store.digest import file_digest

_WINDOWS: Final = (8, 64)  # fewest and most windows into which arrivals are divided
_IN_A_WINDOW: Final = 20  # arrivals per window within these limits
_REPLICATES: Final = 200  # simulated delay series from which σ is estimated
_SEED: Final = 1999  # fixed seed, so that equal input gives equal σ


@dataclass(frozen=True)
class Pairs:
    """Instants on two clocks."""

    stamp_ns: Int64
    """(m,) stamp of the log's clock, in nanoseconds of its count."""
    nominal_gps_ns: Int64
    """(m,) GPS time of the stamp by the log's time system alone."""
    time_gps_ns: Int64
    """(m,) GPS time; for arrivals, minus the least latency."""
    sigma_s: Float64
    """(m,) 1 σ; for arrivals, the smallest error that is assumed."""


@dataclass(frozen=True)
class PairFit:
    """Estimate of a log's clock from pairs."""

    offset_s: float
    """Added to the stamp (s); whole nanoseconds where a double holds them."""
    drift: float
    """s/s"""
    reference_s: float
    """Stamp at which the offset holds (s of the log's count)."""
    correction: ClockCorrection
    """The same as a correction of epochs that the time system alone gives for the stamps."""
    residuals: Residuals
    scale: float
    """Factor applied to the stated σ."""


def clock_from_pairs(pairs: Pairs, drift: Drift) -> PairFit:
    """Return the offset from one pair, or a robust line through several."""
    x_s, y_s, zero_ns = _differences(pairs)
    line = robust_line(x_s, y_s, pairs.sigma_s, drift)
    residuals = Residuals(pairs.nominal_gps_ns, y_s - line.at(x_s), pairs.sigma_s, line.used)
    return _fit(pairs, line, zero_ns, residuals)


def clock_from_arrivals(pairs: Pairs, drift: Drift) -> PairFit:
    """Return the highest line below all differences: arrivals have varying delays, but are never early.

    Of all lines below them it is the one with the least sum of differences, an edge of the lower convex hull (Moon,
    Skelly and Towsley 1999, "Estimation and removal of clock skew from network delay measurements"; for exponential
    delays it is the maximum likelihood). σ is that of the same line through simulated delays as long as the least of
    each window are here. The residuals are those least delays.
    """
    x_s, y_s, zero_ns = _differences(pairs)
    windows = int(np.clip(x_s.size // _IN_A_WINDOW, *_WINDOWS))
    level = drift == "none" or np.ptp(x_s) == 0.0
    offset, slope, sigma_offset, sigma_drift, least = _below(x_s, y_s, windows, level)
    if drift == "auto" and not level and sigma_drift > USUAL_DRIFT:
        offset, slope, sigma_offset, _, least = _below(x_s, y_s, windows, level=True)
        sigma_drift = USUAL_DRIFT
    reference = float(x_s.mean())
    floor = float(np.median(pairs.sigma_s))
    sigma_offset = float(np.hypot(sigma_offset, floor))
    line = Line(offset, slope, reference, sigma_offset, sigma_drift, np.ones(least.size, dtype=bool), 1.0)
    delay_s = np.maximum(y_s[least] - line.at(x_s[least]), 0.0)
    spread = max(floor, float(delay_s.mean()))
    residuals = Residuals(pairs.nominal_gps_ns[least], delay_s, np.full(least.size, spread), line.used)
    return _fit(pairs, line, zero_ns, residuals)


def lower_hull(x: Float64, y: Float64) -> Int64:
    """Return the points of the lower convex hull, by increasing x.

    A point above the chord of its neighbours is on no lower hull: all such points are taken away at once, again and
    again until none is left.
    """
    order = np.lexsort((y, x))
    first = np.concatenate([[True], np.diff(x[order]) > 0])
    kept: Int64 = order[first]
    while kept.size > 2:
        px, py = x[kept], y[kept]
        left, right = px[1:-1] - px[:-2], px[2:] - px[1:-1]
        above = (py[1:-1] - py[:-2]) * right >= (py[2:] - py[1:-1]) * left
        if not above.any():
            break
        kept = np.delete(kept, np.flatnonzero(above) + 1)
    return kept


def _differences(pairs: Pairs) -> tuple[Float64, Float64, int]:
    """Return stamps since the first (s), GPS minus nominal time relative to the first (s), and the first one's (ns)."""
    x_s = (pairs.stamp_ns - pairs.stamp_ns[0]).astype(np.float64) / NS_PER_S
    apart = pairs.time_gps_ns - pairs.nominal_gps_ns
    zero_ns = int(np.median(apart))
    return x_s, (apart - zero_ns).astype(np.float64) / NS_PER_S, zero_ns


def _below(x_s: Float64, y_s: Float64, windows: int, level: bool) -> tuple[float, float, float, float, Int64]:
    """Return the line below all points at their mean x: offset, slope, their σ, and each window's lowest point."""
    middle = float(x_s.mean())
    offset, slope = _supporting(x_s, y_s, middle, level)
    delay = y_s - offset - slope * (x_s - middle)
    width = np.ptp(x_s) / windows or 1.0
    window = np.minimum(((x_s - x_s.min()) / width).astype(np.int64), windows - 1)
    order = np.lexsort((delay, window))
    least = order[np.concatenate([[True], np.diff(window[order]) > 0])]
    free = 1 if level else 2
    mean = float(delay[least].sum()) / max(least.size - free, 1)
    chance = np.random.default_rng(_SEED)
    errors = np.array(
        [
            _supporting(x_s[least], mean * chance.standard_exponential(least.size), middle, level)
            for _ in range(_REPLICATES)
        ]
    )
    sigma_offset, sigma_slope = np.sqrt((errors**2).mean(axis=0))
    return offset, slope, float(sigma_offset), float(sigma_slope), least


def _supporting(x_s: Float64, y_s: Float64, middle_s: float, level: bool) -> tuple[float, float]:
    """Return the value at `middle_s` and the slope of the highest line that lies below all points."""
    if level:
        return float(y_s.min()), 0.0
    hull = lower_hull(x_s, y_s)
    if hull.size == 1:
        return float(y_s[hull[0]]), 0.0
    edge = int(np.clip(np.searchsorted(x_s[hull], middle_s, side="right") - 1, 0, hull.size - 2))
    (x1, x2), (y1, y2) = x_s[hull[edge : edge + 2]], y_s[hull[edge : edge + 2]]
    slope = float((y2 - y1) / (x2 - x1))
    return float(y1) + slope * (middle_s - float(x1)), slope


def _fit(pairs: Pairs, line: Line, zero_ns: int, residuals: Residuals) -> PairFit:
    since_ns = round(line.reference_s * NS_PER_S)
    order = np.argsort(pairs.nominal_gps_ns)
    correction = ClockCorrection(
        offset_s=(zero_ns + round(line.offset_s * NS_PER_S)) / NS_PER_S,
        drift=line.drift,
        reference_gps_ns=int(pairs.nominal_gps_ns[0]) + since_ns,
        sigma_offset_s=line.sigma_offset_s,
        sigma_drift=line.sigma_drift,
        first_gps_ns=int(pairs.nominal_gps_ns[order[0]]),
        last_gps_ns=int(pairs.nominal_gps_ns[order[-1]]),
    )
    reference_s = (int(pairs.stamp_ns[0]) + since_ns) / NS_PER_S
    return PairFit(correction.offset_s, line.drift, reference_s, correction, residuals, line.scale)


_WEEK_NS: Final = WEEK_S * NS_PER_S
_MOST_NS: Final = 1 << 61  # larger values are refused: sums of two such still fit into 64 bits
_DELIMITERS: Final = ",;\t"

Written = int | float | str | dt.datetime


@dataclass(frozen=True)
class LogPairs:
    """Pairs of one log, with the fitted clock."""

    fit: PairFit
    faults: tuple[str, ...]
    """Records of the table that cannot be read, with the reason."""


def log_clock(survey: Survey, log: LogConfig) -> Clock | None:
    """Return a log's clock as stated, corrected by its pairs of stamps; None where none is stated.

    Raises
    ------
    RoadscanError
        where the pairs cannot be read.
    """
    if log.clock is None:
        return None
    found = log_pairs(survey, log)
    if found is None:
        return log.clock.clock()
    fit = found.fit
    return replace(log.clock.clock(), offset_s=fit.offset_s, drift_ppm=fit.drift * 1e6, reference_s=fit.reference_s)


def log_pairs(survey: Survey, log: LogConfig) -> LogPairs | None:
    """Return the pairs of a log and the line through them; None where the survey file gives none."""
    if log.clock is None or log.clock.pairs is None:
        return None
    table = log.clock.pairs.table
    if table is None:
        return _fitted(log.clock.model_dump_json(), None, "")
    path = survey.resolve(table)
    try:
        content = file_digest(path)
    except OSError as error:
        raise FormatError(f"the table of pairs cannot be opened: {error.strerror}", file=path) from error
    return _fitted(log.clock.model_dump_json(), path, content)


@functools.lru_cache(maxsize=64)
def _fitted(clock_json: str, path: Path | None, _content: str) -> LogPairs:
    """Return the fit of a clock's pairs, cached while the table's content is unchanged."""
    clock = ClockConfig.model_validate_json(clock_json)
    if clock.pairs is None:
        raise ConfigError("the clock has no pairs")
    rows = _typed(clock.pairs) if path is None else _listed(path)
    pairs, faults = _pairs(clock, clock.pairs, rows, path)
    fit = clock_from_arrivals if clock.pairs.arrivals else clock_from_pairs
    return LogPairs(fit(pairs, clock.pairs.drift), tuple(faults))


def _typed(evidence: PairEvidence) -> Iterator[tuple[int, Written, Written, float | None]]:
    for number, pair in enumerate(evidence.typed, 1):
        yield number, pair.stamp, pair.time, pair.sigma_s


def _listed(path: Path) -> Iterator[tuple[int, Written, Written, float | None]]:
    """Yield the records of a text table with a header: stamp, time and, if present, sigma_s."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(f"the table of pairs cannot be read as text: {error}", file=path) from error
    lines = text.splitlines()
    delimiter = max(_DELIMITERS, key=lines[0].count) if lines else ","
    try:
        records = list(csv.reader(lines, delimiter=delimiter))
    except csv.Error as error:
        raise FormatError(f"the table of pairs is no text table: {error}", file=path) from error
    names = [name.strip().lower() for name in (records[0] if records else [])]
    missing = [name for name in ("stamp", "time") if name not in names]
    if missing:
        raise FormatError(
            f"the table of pairs has no column '{missing[0]}' (it has: {', '.join(names) or 'none'})",
            expected="a first line with the names stamp and time, and sigma_s if the pairs differ",
            file=path,
        )
    stamp, time = names.index("stamp"), names.index("time")
    sigma = names.index("sigma_s") if "sigma_s" in names else None
    for number, fields in enumerate(records[1:], 1):
        if not any(field.strip() for field in fields):
            continue
        full = [*fields, *[""] * (len(names) - len(fields))]
        yield number, full[stamp].strip(), full[time].strip(), _sigma(full[sigma]) if sigma is not None else None


def _sigma(word: str) -> float | None:
    try:
        return float(word) if word.strip() else None
    except ValueError:
        return -1.0


def _pairs(
    clock: ClockConfig,
    evidence: PairEvidence,
    rows: Iterator[tuple[int, Written, Written, float | None]],
    path: Path | None,
) -> tuple[Pairs, list[str]]:
    """Return pairs on GPS time, and a message for each record that cannot be read."""
    stamps, times, sigmas, faults = [], [], [], []
    first_error: RoadscanError | None = None
    stated = clock.clock()
    for number, stamp, time, sigma in rows:
        try:
            if sigma is not None and not 0.0 < sigma < float("inf"):
                raise FormatError("sigma_s is no positive number", file=path, record=number)
            nanoseconds = _stamp_ns(stated, stamp)
            times.append(_time_ns(evidence, time))
        except RoadscanError as error:
            error.file, error.record = None if path is None else str(path), number
            first_error = first_error or error
            faults.append(str(error))
            continue
        stamps.append(nanoseconds)
        sigmas.append(sigma or evidence.sigma_s)
    if first_error is not None and (path is None or not stamps):
        raise first_error  # typed values have to be corrected; a damaged line of a file only loses that line
    if not stamps:
        raise FormatError("the table holds no pair", expected="at least one", file=path)
    time_gps = _whole_weeks(np.array(times, dtype=np.int64), evidence)
    stamp_ns = np.array(stamps, dtype=np.int64)
    own, nominal = replace(stated, unit="ns").counted_ns(stamp_ns)
    if stated.system is TimeSystem.GPS_WEEK:  # the nearest week is taken: a log may have begun in the week before
        weeks = np.rint((time_gps - nominal) / _WEEK_NS).astype(np.int64)
        own, nominal = own + weeks * _WEEK_NS, nominal + weeks * _WEEK_NS
    latency_ns = round(evidence.least_latency_s * NS_PER_S)
    return Pairs(own, nominal, time_gps - latency_ns, np.array(sigmas)), faults


def _stamp_ns(clock: Clock, written: Written) -> int:
    """Return a stamp in nanoseconds of the clock's count."""
    number = _number_ns(written, UNIT_NS[clock.unit])
    if number is not None:
        return number
    word = written.isoformat() if isinstance(written, dt.datetime) else str(written)
    zoned = parse_calendar([word], zoned=True)
    if zoned is not None and clock.system is TimeSystem.UNIX_UTC:
        return int(zoned[0])
    plain = parse_calendar([word], zoned=False)
    if zoned is None and plain is not None and clock.system in CALENDAR_SCALES:
        return int(plain[0])
    raise TimeSystemError(
        f"stamp '{word[:40]}' of a pair does not fit the clock, which is {clock.system}",
        expected=f"a number in {clock.unit}, or for unix_utc, unix_gps, unix_tai a calendar time (a zone: UTC only)",
    )


def _time_ns(evidence: PairEvidence, written: Written) -> int:
    """Return GPS time in nanoseconds; seconds of the week count in the stated week, or on the stated date."""
    word = written.isoformat() if isinstance(written, dt.datetime) else str(written)
    number = _number_ns(written, UNIT_NS[evidence.unit])
    if number is not None:
        if evidence.system is None:
            raise TimeSystemError(
                f"time '{word[:40]}' of a pair is a number, and its system is not stated",
                expected='pairs.system, such as "gps_week_seconds" or "gps"',
            )
        return _gps_ns(Clock(evidence.system, "ns", evidence.week, evidence.date), number)
    zoned = parse_calendar([word], zoned=True)
    if zoned is not None:
        return _gps_ns(Clock(TimeSystem.UNIX_UTC, "ns"), int(zoned[0]))
    plain = parse_calendar([word], zoned=False)
    if plain is not None and evidence.system in CALENDAR_SCALES:
        return _gps_ns(Clock(evidence.system, "ns"), int(plain[0]))
    raise TimeSystemError(
        f"time '{word[:40]}' of a pair is "
        + ("without a zone" if plain is not None else "neither number nor ISO 8601"),
        expected="such as 2026-05-04T09:30:00.2Z, or a number with pairs.system",
        change='state pairs.system = "unix_utc" (or unix_gps, unix_tai) if it is written in that scale',
    )


def _gps_ns(clock: Clock, nanoseconds: int) -> int:
    if clock.system is TimeSystem.GPS_WEEK and not 0 <= nanoseconds <= _WEEK_NS:
        raise TimeSystemError(
            f"time {nanoseconds / NS_PER_S:.3f} s is not seconds of the GPS week", expected="0 to 604800"
        )
    return int(clock.to_epoch_gps_ns(np.array([nanoseconds], dtype=np.int64))[0])


def _whole_weeks(times: Int64, evidence: PairEvidence) -> Int64:
    """Return seconds of the week unrolled over the week's end: each less than half a week from the one before."""
    if evidence.system is not TimeSystem.GPS_WEEK:
        return times
    back = np.concatenate([[0], np.cumsum(np.rint(np.diff(times) / _WEEK_NS))]).astype(np.int64)
    return times - back * _WEEK_NS


def _number_ns(written: Written, unit_ns: int) -> int | None:
    """Return a number in nanoseconds, exactly as written; None for text that is no number."""
    if isinstance(written, dt.datetime):
        return None
    try:
        value = Decimal(str(written)) * unit_ns
    except InvalidOperation:
        return None
    if not value.is_finite() or abs(value) > _MOST_NS:
        raise TimeSystemError(f"'{str(written)[:40]}' is no possible stamp", expected="a finite number")
    return round(value)
