"""Settings of the adaptive regularised smoothing of a gridded surface."""

from __future__ import annotations

from pydantic import Field

from roadscan.core.strict import Strict


class SmoothingWeights(Strict):
    """Weights and thresholds of ``surface/smoothing.py``; the weights are those of Yu et al. (2007), section 4."""

    curvature_weight: float = Field(default=50.0, ge=0.0, le=10_000.0)
    """λ_C, weight of the directional high-pass filters against the weight 1 of the measured heights."""
    median_weight: float = Field(default=30.0, gt=0.0, le=10_000.0)
    """λ_M, weight of the detail-preserving median against the weight 1 of the measured heights."""
    tolerance: float = Field(default=0.001, gt=0.0, lt=1.0)
    """The iteration ends where at most this share of the start's distance from the minimum can be left."""
    detail_sigmas: float = Field(default=4.0, gt=0.0)
    """A crack, edge or stone begins where medians along a line differ from the ground by this many of their σ …"""
    edge_sigmas: float = Field(default=2.5, gt=0.0)
    """… and goes on as long as they differ by this many."""
    outlier_sigmas: float = Field(default=4.0, gt=0.0)
    """A height farther than this many σ from the median has no weight of its own; "inf": all have (the paper)."""
    filter_sigmas: float = Field(default=0.5, gt=0.0)
    """A filter is off at a cell where it finds more than this many σ in the median: it would flatten a form."""


class SurfaceSmoothing(SmoothingWeights):
    """Weights and thresholds, and the noise that they are measured by."""

    sigma_m: float = Field(default=0.0005, gt=0.0, le=1.0)
    """1 σ of the noise of one cell's height (m): 0.0005 for a triangulation profiler, 0.006 for a SICK LMS."""
    independent: bool = True
    """Whether cells have noise of their own. Interpolated between readings they share it, so that lines of it pass for
    cracks: then no crack is looked for that single cells do not show."""
