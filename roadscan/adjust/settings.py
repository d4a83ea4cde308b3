"""Settings of the adjustment (section ``[adjust]`` of the survey file): stitching of passes, and control."""

from __future__ import annotations

import math
from pathlib import Path
from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from roadscan.adjust.bundle.settings import CameraPriors
from roadscan.adjust.solver_settings import ControlRules, SolverSettings
from roadscan.adjust.tie_settings import AgainSettings, PlaceSettings, TieSettings
from roadscan.core.errors import nearest
from roadscan.core.strict import Strict
from roadscan.core.survey import SurveyConfig, SurveySection

AdjustMode = Literal["joint", "each_pass", "vertical", "helmert"]
"""What is adjusted."""
TargetShape = Literal["none", "circle", "chequered", "pictures"]
"""What is painted at a control point."""


class PosePriors(Strict):
    """What is known of the errors of the recorded poses: of each component a first-order Gauss–Markov process."""

    source: Literal["sigma", "stated"] = "sigma"
    """`sigma`: the 1 σ that a run's logs state of each pose (SMRMSG, σ columns, a computed trajectory); where they
    state none, and with `stated`, those below."""
    sigma_horizontal_m: float = Field(default=0.02, ge=0.0, le=100.0)
    """1 σ of north and of east (m); 0: they are not corrected."""
    sigma_down_m: float = Field(default=0.03, ge=0.0, le=100.0)
    """1 σ of the height (m)."""
    sigma_roll_pitch_deg: float = Field(default=0.01, ge=0.0, le=10.0)
    """1 σ of roll and of pitch (degrees)."""
    sigma_heading_deg: float = Field(default=0.02, ge=0.0, le=30.0)
    """1 σ of the heading (degrees)."""
    position_time_s: float = Field(default=120.0, gt=0.0)
    """Correlation time of the position's errors (s)."""
    attitude_time_s: float = Field(default=60.0, gt=0.0)
    """Correlation time of the attitude's errors (s)."""


class MountingPriors(Strict):
    """How well the mountings of sensors are known; the adjustment estimates what is wrong with them.

    They are of sensors whose σ neither the rig file (`lever_arm_sigma_m`, `boresight_sigma_deg`, `range_scale_sigma`)
    nor a calibration states. A component of σ 0 is not estimated, whatever these state; nor is any in other modes than
    `joint`.

    Heads stand on one beam, and where they stand on it is measured to a millimetre. How the beam stands beside the
    positions' reference is known less well, but in the plane no evidence tells that from the error of the poses.
    """

    sigma_forward_m: float = Field(default=0.001, ge=0.0, le=1.0)
    """1 σ of the lever arm, forward (m)."""
    sigma_right_m: float = Field(default=0.001, ge=0.0, le=1.0)
    """1 σ of the lever arm, to the right (m)."""
    sigma_down_m: float = Field(default=0.002, ge=0.0, le=1.0)
    """1 σ of the lever arm, down (m)."""
    sigma_roll_deg: float = Field(default=0.01, ge=0.0, le=10.0)
    """1 σ of the boresight about the body's x axis (degrees)."""
    sigma_pitch_deg: float = Field(default=0.01, ge=0.0, le=10.0)
    """1 σ of the boresight about the body's y axis (degrees)."""
    sigma_heading_deg: float = Field(default=0.02, ge=0.0, le=10.0)
    """1 σ of the boresight about the body's z axis (degrees)."""
    sigma_range_scale: float = Field(default=0.0005, ge=0.0, le=0.1)
    """1 σ of the scale of ranges, as a share: makers state 0.01 to 0.1 % of the measuring range for the linearity of
    profilers."""
    sigma_laser_m: float = Field(default=0.01, ge=0.0, le=0.1)
    """1 σ of how far the ranges of a single laser of a lidar are off for good (m): it is the same in all ties."""
    sigma_seeming_roll_deg: float = Field(default=0.1, ge=0.0, le=1.0)
    """1 σ of a lasting roll that the ties of one drive of a lidar seem to show (degrees). A turn about the direction of
    driving hardly changes how they fit, so that small errors which all of them have in common look like one. Poses are
    not corrected by it."""

    @property
    def common_sigma(self) -> tuple[float, float]:
        """Returns both, m and rad."""
        return self.sigma_laser_m, math.radians(self.sigma_seeming_roll_deg)


class TargetConfig(Strict):
    """A painted target: what it looks like."""

    shape: TargetShape = "none"
    """`circle`: a bright disc with a dark centre; `chequered`: four fields, bright and dark in turn; `none`: nothing is
    looked for, the point is used for its height only; `pictures`: the point is no place on the road (a plate on a
    wall), and only pictures see it."""
    size_m: float = Field(default=0.30, gt=0.0, le=5.0)
    """Diameter of the disc, or edge of the four fields together (m)."""
    centre_m: float = Field(default=0.06, ge=0.0, le=5.0)
    """Diameter of a disc's dark centre (m), at most 0.8 of the disc's; 0: it has none."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.shape == "circle" and self.centre_m > 0.8 * self.size_m:
            raise ValueError("centre_m is more than 0.8 of the disc's diameter size_m")
        return self


class TargetsConfig(TargetConfig):
    """Targets of the control points: one kind for all, or by the points' codes."""

    codes: dict[str, TargetConfig] = {}
    """Targets of points with a surveyor's code of their own, by the code; in place of the kind above."""
    search_m: float = Field(default=0.5, gt=0.0, le=5.0)
    """How far from its surveyed place a target is looked for (m): the poses' error, and that of the stated place."""
    picked: Path | None = None
    """CSV of targets that were picked by hand, relative to the survey file: columns run, name, easting_m, northing_m
    (where the recorded poses show the target; map frame, m). They stand in for what would be found."""
    picked_sigma_m: float = Field(default=0.01, gt=0.0)
    """1 σ of a picked place on each axis (m)."""

    def of_code(self, code: str | None) -> TargetConfig:
        """Returns the target of points with a code."""
        return self.codes.get(code or "", self)


class ControlUse(ControlRules):
    """How control points count."""

    on: bool = True
    """Ground control enters the adjustment. Check points never do."""
    sigma_horizontal_m: float = Field(default=0.01, gt=0.0)
    """1 σ of easting and of northing of points that state none (m)."""
    sigma_height_m: float = Field(default=0.01, gt=0.0)
    """1 σ of the height of points that state none (m)."""
    radius_m: float = Field(default=0.15, gt=0.0, le=2.0)
    """Readings so near a point (m) give the height there, by a plane through them."""
    largest_m: float = Field(default=0.5, gt=0.0)
    """Where the median of all points differs in height from what was measured by more than this (m), they are in
    another CRS or height datum: none of them is used. A single point that does so is not used either."""


class LineUse(Strict):
    """How surveyed lines count: paint and kerbs of a [[control]] of the format `control_lines`."""

    each_m: float = Field(default=10.0, gt=0.0)
    """Distance of the points along a line that are looked at (m)."""
    sigma_across_m: float = Field(default=0.02, gt=0.0)
    """1 σ across the line of lines that state none (m)."""
    sigma_height_m: float = Field(default=0.02, gt=0.0)
    """1 σ of the heights of lines that state none (m)."""


class HandTies(Strict):
    """Ties by hand: things that a person found in two passes, as the recorded poses show them."""

    path: Path | None = None
    """CSV relative to the survey file, a tie a row: first_run, first_easting_m, first_northing_m, second_run,
    second_easting_m, second_northing_m (map, m). What may be left out: name; kind (`place`, `height` or `both`);
    first_time, second_time (ISO 8601 with time zone: which time the run came by); sigma_m, sigma_height_m."""
    kind: Literal["place", "height", "both"] = "both"
    """What ties without a stated kind say."""
    sigma_m: float = Field(default=0.02, gt=0.0, le=10.0)
    """1 σ of the difference of two places, on each axis, where a tie states none (m)."""
    sigma_height_m: float = Field(default=0.01, gt=0.0, le=10.0)
    """1 σ of the difference of two heights, beside that of their measurement, where a tie states none (m)."""


class AdjustConfig(SurveySection):
    """The adjustment of the recorded poses: passes are tied to one another where they overlap, and to ground control.

    It is on where a survey has either, and does nothing where it has neither.
    """

    table: ClassVar[str] = "adjust"
    meaning: ClassVar[str] = "Adjustment of the poses where passes overlap, and to ground control."

    on: bool = True
    """`false`: the poses hold as they were recorded."""
    mode: AdjustMode = "joint"
    """`joint`: all runs at once, with ties and control; `each_pass`: each run by itself, to control alone; `vertical`:
    as joint, and heights alone are corrected; `helmert`: the survey as a whole is shifted and turned onto its control
    points with targets, nothing else."""
    fixed: list[str] = []
    """Runs that are fixed, an earlier survey or a reference: their recorded poses hold to the bit, and those of
    other runs are adjusted to them. How well their poses are known is taken from their σ. Mountings of their sensors
    are not estimated."""
    priors: PosePriors = PosePriors()
    """Errors of the recorded poses."""
    mountings: MountingPriors = MountingPriors()
    """Errors of the sensors' mountings."""
    cameras: CameraPriors = CameraPriors()
    """Errors of cameras whose pictures have tie points (`[picture_ties]`)."""
    places: PlaceSettings = PlaceSettings()
    """Where passes are compared."""
    ties: TieSettings = TieSettings()
    """How they are compared."""
    again: AgainSettings = AgainSettings()
    """When they are compared again."""
    hand_ties: HandTies = HandTies()
    """Ties by hand."""
    control: ControlUse = ControlUse()
    """Control points."""
    targets: TargetsConfig = TargetsConfig()
    """Painted targets at control points."""
    lines: LineUse = LineUse()
    """Surveyed lines."""
    solver: SolverSettings = SolverSettings()
    """How the corrections are computed."""
    moved_m: float = Field(default=0.0001, ge=0.0, le=0.1)
    """A solution replaces the published corrections only where it moves a pose by more than this (m): tiles elsewhere
    stay current."""
    moved_arm_m: float = Field(default=5.0, ge=0.0)
    """A turn counts as the movement of a point so far from the vehicle (m)."""

    @model_validator(mode="after")
    def _holds_runs(self) -> Self:
        if self.fixed and self.mode == "helmert":
            raise ValueError(
                "adjust.fixed holds runs, and mode 'helmert' moves the survey as a whole: state another mode, or no "
                "fixed run"
            )
        return self

    def check_survey(self, config: SurveyConfig) -> None:
        """Raise :class:`ValueError` where runs are fixed that the survey has not, or all of them."""
        fixed, runs = self.fixed if self.on else [], [run.id for run in config.runs]
        for run in fixed:
            if run not in runs:
                raise ValueError(f"adjust.fixed names the unknown run '{run}'{nearest(run, runs)}")
        if set(fixed) == set(runs):
            raise ValueError("adjust.fixed names all runs: none is left to adjust; adjust.on = false switches it off")
