"""The estimated error of a sensor's clock, and the correction of epochs by it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roadscan.compute.array_types import Bool, Float64, Int64
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
