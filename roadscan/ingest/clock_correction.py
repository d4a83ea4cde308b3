"""The estimated error of a sensor's clock, and the correction of epochs by it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.arrays import SIGMA_OF_MAD
from roadscan.core.clock_evidence import USUAL_DRIFT, Drift
from roadscan.core.gpstime import NS_PER_S


@dataclass(frozen=True)
class ClockCorrection:
    """epoch' = epoch + offset_s + drift · (epoch − reference_gps_ns): a correction of ingested epochs."""

    offset_s: float
    """Added at the reference (s)."""
    drift: float
    """Rate of the correction (s/s)."""
    reference_gps_ns: int
    """Uncorrected epoch of the sensor's clock at which the offset applies."""
    sigma_offset_s: float = 0.0
    """1 σ of the offset (s)."""
    sigma_drift: float = 0.0
    """1 σ of the drift (s/s)."""
    correlation: float = 0.0
    """Correlation of offset and drift."""
    first_gps_ns: int = 0
    """First epoch (uncorrected) of the data behind the estimate; the correction is applied outside, too."""
    last_gps_ns: int = 0
    """Last epoch of these data."""

    def applied(self, epochs_gps_ns: Int64) -> Int64:
        """Return the corrected epochs (n,) of epochs (n,), GPS ns."""
        if self.drift == 0.0:
            return epochs_gps_ns + round(self.offset_s * NS_PER_S)
        elapsed_ns = (epochs_gps_ns - self.reference_gps_ns).astype(np.float64)
        corrected: Int64 = epochs_gps_ns + np.rint(self.offset_s * NS_PER_S + self.drift * elapsed_ns).astype(np.int64)
        return corrected

    def sigma_s(self, epochs_gps_ns: Int64) -> Float64:
        """Return 1 σ (n,) of the corrected epochs (s): it grows with the distance from the reference."""
        elapsed_s = (epochs_gps_ns - self.reference_gps_ns).astype(np.float64) / NS_PER_S
        covariance = self.correlation * self.sigma_offset_s * self.sigma_drift
        variance = self.sigma_offset_s**2 + 2 * covariance * elapsed_s + (self.sigma_drift * elapsed_s) ** 2
        sigma: Float64 = np.sqrt(np.maximum(variance, 0.0))
        return sigma


@dataclass(frozen=True)
class Residuals:
    """Residuals of an estimate: one for each pair of stamps, or window of motion."""

    epochs_gps_ns: Int64
    """(m,) uncorrected epoch of the pair, or of the middle of the window, on the sensor's clock."""
    residual_s: Float64
    """(m,) observed − fitted correction (s)."""
    sigma_s: Float64
    """(m,) 1 σ of the residual, from the noise of the pair or window (s)."""
    used: Bool
    """(m,) False for outliers, and for windows without motion."""

    @property
    def weights(self) -> Float64:
        """Return each residual's share (m,) of the information 1/σ² of all used ones; 0 where not used."""
        information = np.where(self.used, 1.0 / np.square(self.sigma_s), 0.0)
        total = information.sum()
        return information / total if total > 0.0 else information

    @property
    def rms_s(self) -> float:
        """Return the weighted RMS of the used residuals (s)."""
        return float(np.sqrt(np.sum(self.weights * np.square(np.where(self.used, self.residual_s, 0.0)))))


_OUTLIER: Final = 4.0
"""Differences beyond this many σ are outliers."""
_FEW: Final = 4
"""With at most this many differences no outlier can be identified."""
_SLOPES_OF: Final = 400
"""Differences used for the first estimate of the rate, which compares all pairs of them."""
_ROUNDS: Final = 30  # most iterations of outlier rejection


@dataclass(frozen=True)
class Line:
    """y = offset_s + drift · (x − reference_s); offset and drift are not correlated at the reference."""

    offset_s: float
    drift: float
    reference_s: float
    sigma_offset_s: float
    sigma_drift: float
    used: Bool
    """(m,) False for outliers."""
    scale: float
    """Factor applied to the stated σ, at least 1, because of the scatter about the line."""

    def at(self, x_s: Float64) -> Float64:
        """Return the difference (n,) of the line at times (n,)."""
        return self.offset_s + self.drift * (x_s - self.reference_s)


def robust_line(x_s: Float64, y_s: Float64, sigma_s: Float64, drift: Drift) -> Line:
    """Fit a line by weighted least squares without outliers.

    Parameters
    ----------
    x_s, y_s, sigma_s : (m,) m ≥ 1, time, difference of two clocks, and its 1 σ (s).
    drift : "none": the line is level; "estimate": free; "auto": free within a prior of 100 ppm (1 σ).

    The start is Siegel's repeated median of slopes (Biometrika 1982, 69), which half of the differences cannot
    spoil; then differences beyond 4 σ of the line are left out, and σ is raised where those that stay scatter by more
    than they should.
    """
    level = drift == "none"
    slope = 0.0 if level else _first_slope(x_s, y_s, sigma_s, drift)
    used = _near(y_s - slope * x_s, sigma_s) if x_s.size >= _FEW else np.ones(x_s.size, dtype=bool)
    for _ in range(_ROUNDS):
        line = _fitted(x_s, y_s, sigma_s, used, drift)
        if x_s.size < _FEW:
            break
        normalised = np.abs(y_s - line.at(x_s)) / sigma_s
        again = normalised <= _OUTLIER * max(1.0, SIGMA_OF_MAD * float(np.median(normalised[used])))
        if np.array_equal(again, used) or np.count_nonzero(again) < _FEW - 1:
            break
        used = again
    return line


def _first_slope(x_s: Float64, y_s: Float64, sigma_s: Float64, drift: Drift) -> float:
    """Return the repeated median of the slopes between the better differences."""
    better = np.flatnonzero(sigma_s <= 3.0 * np.median(sigma_s))
    chosen = better[np.linspace(0, better.size - 1, min(better.size, _SLOPES_OF)).astype(np.int64)]
    x, y = x_s[chosen], y_s[chosen]
    if x.size < _FEW or np.ptp(x) == 0.0:
        return 0.0
    apart = x[:, None] - x[None, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = np.where(apart != 0.0, (y[:, None] - y[None, :]) / apart, np.nan)
    slope = float(np.median(np.nanmedian(slopes[np.isfinite(slopes).any(axis=1)], axis=1)))
    return float(np.clip(slope, -5 * USUAL_DRIFT, 5 * USUAL_DRIFT)) if drift == "auto" else slope


def _near(level_s: Float64, sigma_s: Float64) -> Bool:
    """Return which differences (m,) are near the median of all."""
    away = np.abs(level_s - np.median(level_s))
    spread = SIGMA_OF_MAD * float(np.median(away))
    return np.asarray(away <= np.maximum(_OUTLIER * sigma_s, _OUTLIER * spread))


def _fitted(x_s: Float64, y_s: Float64, sigma_s: Float64, used: Bool, drift: Drift) -> Line:
    weight = np.where(used, 1.0 / np.square(sigma_s), 0.0)
    total = weight.sum()
    reference = float(weight @ x_s / total)
    offset = float(weight @ y_s / total)
    information = float(weight @ np.square(x_s - reference))
    prior = 1.0 / USUAL_DRIFT**2 if drift == "auto" else 0.0
    free = drift != "none" and information + prior > 0.0
    scale, slope = 1.0, 0.0
    for _ in range(2):  # the scatter sets the weight of the data against the prior
        held = information / scale**2 + prior
        slope = float(weight @ ((x_s - reference) * (y_s - offset)) / scale**2 / held) if free else 0.0
        left = y_s - offset - slope * (x_s - reference)
        over = np.count_nonzero(used) - (2 if free else 1)
        scale = max(1.0, float(np.sqrt(weight @ np.square(left) / over))) if over > 0 else 1.0
    sigma_drift = float(1.0 / np.sqrt(information / scale**2 + prior)) if free else 0.0
    return Line(offset, slope, reference, scale / float(np.sqrt(total)), sigma_drift, used, scale)
