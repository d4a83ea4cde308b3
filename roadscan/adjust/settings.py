"""Settings of the adjustment (section ``[adjust]`` of the survey file): stitching of passes, and control."""

from __future__ import annotations

import math
from pathlib import Path
from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from roadscan.core.errors import nearest
from roadscan.core.strict import Strict
from roadscan.core.survey import SurveyConfig, SurveySection


class CameraPriors(Strict):
    """How well cameras are known whose pictures have tie points.

    σ that the rig file states (`lever_arm_sigma_m`, `boresight_sigma_deg`, `sigma_focal_px` and those beside it) stand
    in place of these. What has a σ of 0 is not estimated.
    """

    sigma_lever_m: float = Field(default=0.02, ge=0.0, le=1.0)
    """1 σ of the lever arm on each axis (m)."""
    sigma_boresight_deg: float = Field(default=0.5, ge=0.0, le=10.0)
    """1 σ of the boresight about each axis (degrees); where range edges show a larger turn, that turn."""
    sigma_focal: float = Field(default=0.003, ge=0.0, le=0.1)
    """1 σ of the focal length, as a share of it."""
    sigma_principal: float = Field(default=0.001, ge=0.0, le=0.1)
    """1 σ of each coordinate of the principal point, as a share of the focal length. On a straight drive it can hardly
    be told from the boresight; were it not estimated, its error would be in the boresight, whose σ would not say so."""
    sigma_k1: float = Field(default=0.002, ge=0.0, le=1.0)
    """1 σ of the radial distortion k1. The other parameters of the distortion are estimated only where the rig file
    states their σ."""
    sigma_clock_s: float = Field(default=0.0, ge=0.0, le=1.0)
    """1 σ of what the stamps of the pictures are off (s). 0: the stage `clocks` is to find it."""
    sigma_line_time_us: float = Field(default=0.0, ge=0.0, le=100.0)
    """1 σ of the time between two rows (µs), of cameras whose rig file states such a time."""
    sigma_shared_px: float = Field(default=0.01, ge=0.0, le=10.0)
    """1 σ of what all measurements of a picture are off in common (px): what the lens model leaves, and features that
    look different from nearer. Without it, thousands of tie points would believe their mean to hundredths of a pixel,
    and bend mountings, lens and control by what they share."""
    depths: bool = True
    """Whether tie points that lie on a surface which a lidar of the same run saw at the moment of the picture are held
    to it."""
    depth_every_m: float = Field(default=2.0, gt=0.0, le=100.0)
    """Pictures of a camera that far apart (m) are looked at for that."""
    depth_reach_m: float = Field(default=40.0, gt=1.0, le=200.0)
    """Returns of the lidar farther from the camera (m) are not used."""
    sigma_depth_m: float = Field(default=0.03, gt=0.0, le=1.0)
    """1 σ of the distance of a tie point from such a surface, beside the scatter of the returns (m)."""
    sigma_shared_depth_m: float = Field(default=0.01, ge=0.0, le=1.0)
    """1 σ of what all of them in a picture are off in common (m): ranges that depend on brightness, and beams."""
    edges: bool = True
    """Whether range edges of a lidar of the same run, held against edges of pictures, are an observation of the
    boresight."""
    sigma_shared_edge_deg: float = Field(default=0.05, gt=0.0, le=5.0)
    """1 σ of what all range edges are off in common (degrees), about each axis: beams are 0.1 to 0.2° wide."""
    sigma_control_px: float = Field(default=0.3, gt=0.0, le=10.0)
    """1 σ of each pixel coordinate of a control point, where the measurement states none (px)."""


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


class PlaceSettings(Strict):
    """Where passes are tied to one another."""

    per_km: float = Field(default=200.0, gt=0.0, le=2000.0)
    """Places per kilometre of road and overlapping strip."""
    radius_m: float = Field(default=0.5, gt=0.0, le=20.0)
    """Half the edge of the patch of road that is compared (m)."""
    lidar_per_km: float = Field(default=50.0, gt=0.0, le=2000.0)
    """Places per kilometre for sensors that see ahead, whose planes are compared."""
    lidar_radius_m: float = Field(default=8.0, gt=0.0, le=100.0)
    """Half the edge of the square that their planes are taken from (m)."""
    seams_per_km: float = Field(default=50.0, gt=0.0, le=2000.0)
    """Places per kilometre where heads of one pass that overlap by a few centimetres are compared."""
    seam_radius_m: float = Field(default=2.0, gt=0.0, le=20.0)
    """Half the length of road that is compared at each of them (m): a narrow strip has to be long."""
    margin_m: float = Field(default=0.3, ge=0.0)
    """Readings are taken from so much farther ahead and behind: passes lie apart by what their poses are off (m)."""
    least_overlap_m: float = Field(default=0.2, gt=0.0)
    """Narrowest strip that two passes have to share (m)."""
    return_s: float = Field(default=30.0, gt=0.0)
    """A run that is back at a place after this time or more passes it anew (s)."""
    height_apart_m: float = Field(default=2.0, gt=0.0)
    """Tracks farther apart in height do not meet: one crosses above the other (m)."""
    gap_s: float = Field(default=2.0, gt=0.0)
    """Between positions of a trajectory farther apart in time there is no place (s)."""
    longest_s: float = Field(default=10.0, gt=0.0)
    """Readings of a place are taken for so long at most, where a vehicle stands there (s)."""


class AgainSettings(Strict):
    """When ties are observed again, and how passes that lie far apart are brought together first."""

    share: float = Field(default=0.05, gt=0.0, le=1.0)
    """A place is observed again where the solution moves its passes against one another by more than this share of the
    patch's edge: 5 cm of a patch of 1 m. What moved by less was matched where it lies."""
    rounds: int = Field(default=3, ge=0, le=10)
    """Times that ties are observed again, at most: one brings passes to centimetres, the next ones to the σ of the
    ties, and what moves after three does not settle. 0: never."""
    search_m: float = Field(default=1.0, gt=0.0, le=5.0)
    """How far apart (m), along, across and in height, two passes are sought with larger patches."""
    radius_m: float = Field(default=2.0, gt=0.0, le=20.0)
    """Half the edge of the larger patch (m)."""
    cell_m: float = Field(default=0.02, gt=0.0, le=1.0)
    """Edge of its cells (m): cracks are to be seen."""
    each_m: float = Field(default=100.0, gt=0.0)
    """Distance of larger patches along the road (m): errors of poses vary over minutes."""
    least: int = Field(default=20, ge=3)
    """Larger patches of two runs, at least, where they have so many places."""
    alike_m: float = Field(default=0.1, gt=0.0)
    """Larger patches count that agree with most of the others to this; passes lie no farther above one another (m)."""


class TieSettings(Strict):
    """How two passes are compared at a place, and what a tie has to pass to count."""

    return_s: float = Field(default=30.0, gt=0.0)
    """Readings of one run nearer in time than this are no other pass: what ties them says how well heads agree, and is
    not used for the poses (s)."""
    cell_m: float = Field(default=0.025, gt=0.0)
    """Edge of the cells that heights are compared in (m)."""
    least_readings: int = Field(default=3, ge=1)
    """A cell holds a height from so many readings on."""
    least_cells: int = Field(default=100, ge=16)
    """Two patches are compared where both saw so many cells."""
    least_share: float = Field(default=0.3, gt=0.0, le=1.0)
    """Of the cells that both saw, this share has to agree."""
    most_apart_m: float = Field(default=0.3, gt=0.0)
    """Surfaces farther apart in height than this are not the same one (m)."""
    most_scatter_m: float = Field(default=0.01, gt=0.0)
    """Height differences of the cells of a tie scatter no more than this (m, robust 1 σ)."""
    steepest: float = Field(default=0.2, gt=0.0)
    """A patch that is steeper than this is no road (m/m)."""
    misplaced_m: float = Field(default=0.03, ge=0.0)
    """1 σ of how far two passes may lie apart horizontally (m): with the unevenness of the patch it adds to the σ of a
    height tie."""
    sigma_floor_m: float = Field(default=2e-5, gt=0.0)
    """No tie is better than this (m, 1 σ): rounding, what a pose changes within a patch."""
    outlying: float = Field(default=4.0, gt=1.0)
    """Cells that differ from the rest by more than so many σ are left out."""
    shift_cell_m: float = Field(default=0.01, gt=0.0)
    """Edge of the cells of the pictures and reliefs that horizontal shifts are found in (m)."""
    search_m: float = Field(default=0.15, gt=0.0)
    """Shifts are sought up to so far along and across (m)."""
    least_correlation: float = Field(default=0.3, gt=0.0, lt=1.0)
    """Correlation of two pictures or reliefs from which on they may show the same place."""
    rival_share: float = Field(default=0.75, gt=0.0, lt=1.0)
    """A shift is ambiguous where another one correlates with this share of the best correlation."""
    coherence: float = Field(default=0.4, gt=0.0, lt=1.0)
    """A direction counts where this share of the slopes' energy is common to both; the rest is noise."""
    most_shift_sigma_m: float = Field(default=0.01, gt=0.0)
    """A direction that is known worse than this makes no tie (m, 1 σ)."""
    shift_floor_m: float = Field(default=2e-4, gt=0.0)
    """No shift is known better than this (m, 1 σ): spacing of readings, what a pose changes within a patch."""
    window_s: float = Field(default=0.2, gt=0.0)
    """Returns of a lidar that are taken together as seen from one pose (s)."""
    one_return_in: int = Field(default=3, ge=1, le=100)
    """Of so many returns of a lidar that follow one another one is looked at. A number that shares no divisor with that
    of the lasers takes from all of them."""
    plane_cell_m: float = Field(default=1.0, gt=0.0)
    """Edge of the cubes in which planes are sought (m)."""
    least_returns: int = Field(default=6, ge=3)
    """A window sees a plane where it has so many returns on it."""
    thickest_m: float = Field(default=0.05, gt=0.0)
    """Returns of a plane scatter about it no more than this (m, 1 σ)."""
    uneven_m: float = Field(default=0.003, ge=0.0)
    """1 σ of how far the means of returns on different spots of a plane differ because it is uneven (m)."""
    most_planes: int = Field(default=30, ge=1)
    """Planes of a place that make ties: those with the most returns, a sixth of them for each direction (along the
    road, across and up) where there are so many."""


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


class TargetSettings(Strict):
    """How control targets are found, and what a find has to show."""

    search_radius_m: float = Field(default=0.75, gt=0.0, le=5.0)
    """Targets are looked for within this of their stated place (m)."""
    least_likeness: float = Field(default=0.35, gt=0.0, lt=1.0)
    """Normalised correlation of a place with the shape, from which on it is a candidate."""
    most_candidates: int = Field(default=8, ge=2, le=32)
    """Candidates that are looked at, the likeliest first."""
    least_contrast: float = Field(default=3.0, gt=0.0)
    """Least contrast of paint against road, in standard deviations of single readings."""
    size_tolerance: float = Field(default=0.08, gt=0.0, le=0.5)
    """A shape larger or smaller than stated by more than this share is none."""
    least_paint: float = Field(default=0.5, gt=0.0, le=1.0)
    """Least share of the painted area that shows paint."""
    least_outline: float = Field(default=0.45, gt=0.0, le=1.0)
    """Least share of the outline that lies where the shape has it."""
    least_clear: float = Field(default=0.6, gt=0.0, le=1.0)
    """Least share of what is unpainted, around the shape and within it, that shows none."""
    moved_sigmas: float = Field(default=4.0, gt=0.0)
    """A target farther from its stated place than this many standard deviations is said to have moved."""
    sigma_paint_m: float = Field(default=0.0003, ge=0.0)
    """Standard deviation (m, each axis) by which a painted shape's middle misses the surveyed mark: stencil, edges."""
    height_radius_m: float = Field(default=0.15, gt=0.0, le=2.0)
    """Readings within this of a control point make the surface that its height is taken from (m)."""
    sigma_plane_m: float = Field(default=0.0002, ge=0.0)
    """Standard deviation (m) by which the road departs from that surface, which bends evenly."""
