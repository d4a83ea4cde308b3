"""Estimates a log's clock from pairs of (stamp, GPS time), or from arrivals at a host, which are never early."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.clock_evidence import USUAL_DRIFT, Drift
from roadscan.core.gpstime import NS_PER_S
from roadscan.ingest.clocks.correction import ClockCorrection, Residuals
from roadscan.ingest.clocks.lines import Line, robust_line

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
