"""Settings of an adjustment: what is estimated, how finely, and how much of a contradiction counts."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from roadscan.model.strict import Strict


class SolverSettings(Strict):
    """How corrections of poses are computed from ties and control, whatever is adjusted."""

    knot_spacing_s: float = Field(default=0.1, gt=0.0)
    """Corrections change linearly between knots so far apart in time (s), at most. Where a process of σ 15 mm and
    τ 120 s is true, it leaves a line between knots 0.1 s apart by 0.25 mm (RMS)."""
    full_weight_within: float = Field(default=2.5, gt=0.0)
    """A residual up to so many σ counts fully; beyond it counts less (IGG III, Yang 1994)."""
    reject_beyond: float = Field(default=5.0, gt=0.0)
    """A residual of so many σ or more does not count."""
    max_rounds: int = Field(default=60, ge=1)
    """Rounds of re-weighting, at most."""
    estimate_variance_components: bool = False
    """Estimate a factor of the stated variances of each kind of observation and of each component's process."""

    @model_validator(mode="after")
    def _limits_are_in_order(self) -> Self:
        if self.reject_beyond <= self.full_weight_within:
            raise ValueError("reject_beyond has to be larger than full_weight_within")
        return self


class AdjustmentSettings(SolverSettings):
    """What is adjusted, and how."""

    mode: Literal["joint", "each_pass", "vertical"] = "joint"
    """What is adjusted: all runs together ("joint"), each run alone by its control without ties ("each_pass"), or all
    runs together but in height alone ("vertical")."""
