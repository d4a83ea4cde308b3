"""Errors of a run's poses as stochastic processes, sampled at knots.

A first-order Gauss–Markov process has the covariance σ² e^(−|Δt|/τ) (Gelb 1974, 3.8). At knots it is the sequence
x(k+1) = φ x(k) + w, φ = e^(−h/τ), var w = σ² (1 − φ²), without any approximation. Between knots the adjustment puts a
straight line; by how much the process leaves it has a variance in closed form (`line_variance`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roadscan.adjust.observations import COMPONENTS
from roadscan.model.errors import ConfigError
from roadscan.model.gpstime import NS_PER_S

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]


@dataclass(frozen=True)
class GaussMarkov:
    """First-order Gauss–Markov process of one component."""

    sigma: float
    """Stationary 1 σ (m or rad); 0: the component is not corrected."""
    tau_s: float
    """Correlation time (s)."""


@dataclass(frozen=True)
class RunPrior:
    """What is known of the errors of a run's poses before the adjustment."""

    run: str
    first_gps_ns: int
    last_gps_ns: int
    processes: tuple[GaussMarkov, GaussMarkov, GaussMarkov, GaussMarkov, GaussMarkov, GaussMarkov]
    """In the order of `COMPONENTS`; independent of one another."""

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
        """(6,) stationary 1 σ."""
        return np.array([p.sigma for p in self.processes])

    @property
    def taus_s(self) -> Float64:
        """(6,) correlation times (s)."""
        return np.array([p.tau_s for p in self.processes])


def knots_of(prior: RunPrior, spacing_s: float) -> Int64:
    """Epochs (k,) of a run's knots: evenly spaced from its first epoch to its last, at most `spacing_s` apart."""
    span = prior.last_gps_ns - prior.first_gps_ns
    intervals = max(1, -(-span // max(1, round(spacing_s * NS_PER_S))))
    if span == 0:
        return np.array([prior.first_gps_ns], np.int64)
    steps = np.arange(intervals + 1, dtype=np.int64)
    return np.asarray(prior.first_gps_ns + (span // intervals) * steps + (span % intervals) * steps // intervals)


def precision_of(epochs_gps_ns: Int64, tau_s: float) -> tuple[Float64, Float64]:
    """Inverse covariance of a process of σ = 1 at knots: its diagonal (k,) and the one beside it (k − 1,).

    Rue & Held (2005, 1.1): a Markov process has a tridiagonal one.
    """
    step = np.diff(epochs_gps_ns) / NS_PER_S / tau_s
    keep, gain = np.exp(-step), -1.0 / np.expm1(-2.0 * step)
    diagonal = np.ones(epochs_gps_ns.size)
    diagonal[1:] = gain
    diagonal[:-1] += keep**2 * gain
    return diagonal, -keep * gain


def line_variance(share: Float64, step_s: Float64, tau_s: float | Float64) -> Float64:
    """Variance by which a process of σ = 1 leaves the straight line between two knots.

    Parameters
    ----------
    share : where between the knots, 0 to 1.
    step_s : from knot to knot (s).
    tau_s : correlation time (s). All three broadcast.

    Notes
    -----
    Var[x(t) − (1 − λ) x(0) − λ x(h)] of the covariance e^(−|Δt|/τ); for h ≪ τ it is 2 λ (1 − λ) h / τ.
    """
    left, right = 1.0 - share, share
    # Written with e^x − 1: the terms of order one cancel.
    whole, to_left, to_right = (np.expm1(-d / tau_s) for d in (step_s, share * step_s, left * step_s))
    return np.maximum(2.0 * (left * right * whole - left * to_left - right * to_right), 0.0)
