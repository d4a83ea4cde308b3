"""Settings of an adjustment: what is estimated, how finely, and how much of a contradiction counts."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from roadscan.core.strict import Strict


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
    estimate_variance_components: bool | None = None
    """Estimate a factor of the stated variances of each kind of observation and of each component's process. Left out:
    where a stated σ turns out to be 1.7 times too small or more; `false`: never."""

    @model_validator(mode="after")
    def _limits_are_in_order(self) -> Self:
        if self.reject_beyond <= self.full_weight_within:
            raise ValueError("reject_beyond has to be larger than full_weight_within")
        return self


DatumOffset = Literal["judge", "follow", "estimate", "leave_out"]
"""What becomes of control that is off as a whole."""


class ControlRules(Strict):
    """How the surveys of control points are judged."""

    false_alarm: float = Field(default=0.01, ge=0.0, le=0.2)
    """Chance that a point of right control is found wrong, of all points together. A point whose leave-one-out residual
    exceeds the quantile of the normal distribution that follows (3.3 σ for ten heights) is named, and its height or
    place does not count. 0: no point is found wrong."""
    datum_false_alarm: float = Field(default=0.05, ge=0.0, le=0.2)
    """Chance that right control is doubted as a whole: 2.2 σ of its common offset in height. A doubt costs no more than
    a wider σ. 0: it is never doubted."""
    datum_offset: DatumOffset = "judge"
    """What is done where all points are off together, in height or in place, by more than σ and correlation time of the
    poses explain. `judge`: up to `adjust.solver.reject_beyond` σ the control is followed and the σ that is published
    holds the offset; beyond it, the offset is estimated. `follow`: the control is followed, and σ holds the offset.
    `estimate`: the offset is always estimated: poses say where the survey lies, and control says its shape.
    `leave_out`: control that is off does not count."""
    sigma_datum_m: float = Field(default=0.0, ge=0.0, le=10.0)
    """1 σ of an offset that all points have in common, on each axis (m): of the datum that the control was surveyed in
    against that of the poses."""


class AdjustmentSettings(SolverSettings, ControlRules):
    """What is adjusted, and how."""

    mode: Literal["joint", "each_pass", "vertical"] = "joint"
    """What is adjusted: all runs together ("joint"), each run alone by its control without ties ("each_pass"), or all
    runs together but in height alone ("vertical")."""
