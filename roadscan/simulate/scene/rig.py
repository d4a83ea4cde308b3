"""The sensors of a scene's rig: how they are mounted, what they measure, how far they err, and their clocks."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from roadscan.core.gpstime import TimeSystem
from roadscan.core.rig import ImuErrors, ImuGrade
from roadscan.core.strict import Strict
from roadscan.simulate.lidar_model import lidar_model_names


class ClockError(Strict):
    """A sensor's clock: stamp = true epoch + offset_s + drift_ppm · 10⁻⁶ · (time since the first pass's start)."""

    offset_s: float = 0.0
    """How far the clock is ahead at the first profile of the first pass (s)."""
    drift_ppm: float = 0.0
    """How much too fast it runs (parts per million)."""
    known: bool = False
    """Whether the survey file states the correction, as if it had been measured."""
    system: TimeSystem | None = None
    """Time system of the log's stamps, where its format leaves the choice: the format's usual one otherwise."""

    @property
    def is_right(self) -> bool:
        """True for a clock without error."""
        return self.offset_s == 0.0 and self.drift_ppm == 0.0


class MountError(Strict):
    """How far the nominal mounting of the rig file lies from the true one: nominal = true + error."""

    lever_arm_body_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Error of the lever arm: forward, right, down (m)."""
    roll_deg: float = 0.0
    """Error of the boresight's roll (degrees)."""
    pitch_deg: float = 0.0
    """Error of its pitch (degrees)."""
    heading_deg: float = 0.0
    """Error of its heading (degrees)."""


class Mount(Strict):
    """True lever arm and boresight of a sensor; the rig file states the nominal ones."""

    lever_arm_body_m: tuple[float, float, float]
    """IMU reference point to sensor origin: forward, right, down (m)."""
    roll_deg: float = 0.0
    """Boresight about body x (degrees); the order is Z-Y-X."""
    pitch_deg: float = 0.0
    """Boresight about body y (degrees)."""
    heading_deg: float = 0.0
    """Boresight about body z (degrees)."""
    error: MountError = MountError()
    """What the rig file has wrong."""

    def nominal(self) -> Mount:
        """Return the mounting that the rig file states."""
        e = self.error
        forward, right, down = (a + b for a, b in zip(self.lever_arm_body_m, e.lever_arm_body_m, strict=True))
        return Mount(
            lever_arm_body_m=(forward, right, down),
            roll_deg=self.roll_deg + e.roll_deg,
            pitch_deg=self.pitch_deg + e.pitch_deg,
            heading_deg=self.heading_deg + e.heading_deg,
        )


class Profilers(Strict):
    """The laser-triangulation pair at the vehicle's rear, looking down."""

    on: bool = True
    """Whether the rig carries them."""
    spacing_m: float = Field(default=0.02, gt=0.0005)
    """Distance driven from profile to profile (m)."""
    profiles_per_s_max: float = Field(default=28_000.0, gt=0.0)
    """Fastest rate of the heads (1/s); a scene that drives faster than that at its spacing is refused."""
    readings: int = Field(default=1000, ge=2, le=20_000)
    """Readings a profile and head: 2,000 make the pair's 4,000."""
    width_m: float = Field(default=2.04, gt=0.1, le=5.0)
    """From the first to the last reading of a head (m)."""
    range_offset_m: float = Field(default=0.8, ge=0.0)
    """Range that a raw value of 0 would stand for (m)."""
    range_step_m: float = Field(default=0.00005, ge=0.000001, le=0.01)
    """Range of one raw unit (m); rounding errors are half of it."""
    spot_along_m: float = Field(default=0.0, ge=0.0, le=0.02)
    """Thickness of the laser's line, along the road (m): a reading in a pothole, crack or joint is the mean of what its
    spot lights up. 0: as `spot_across_m`, and where both are 0 a beam has no width."""
    spot_across_m: float = Field(default=0.0, ge=0.0, le=0.02)
    """Width of the piece of the line that makes a reading (m)."""
    camera_deg: float = Field(default=0.0, ge=0.0, lt=60.0)
    """Angle between the beams and the line of sight of the head's camera, which stands ahead of the laser (degrees):
    what the walls of potholes, cracks and joints hide from it is not seen; it asks for a spot. 0: it sees all."""
    left: Mount = Mount(lever_arm_body_m=(-2.35, -0.98, -1.08), roll_deg=0.4, pitch_deg=-0.3, heading_deg=0.6)
    """Mounting of the left head (axes frd)."""
    right: Mount = Mount(lever_arm_body_m=(-2.28, 0.99, -1.11), roll_deg=-0.35, pitch_deg=0.25, heading_deg=-0.5)
    """Mounting of the right head (axes frd)."""
    clock: ClockError = ClockError()
    """Clock of both heads; GPS time by default."""
    head_imus: ImuGrade | None = None
    """Grade of the IMU inside each head (axes frd of the head); none where left out."""


class Lidar(Strict):
    """The spinning lidar."""

    on: bool = True
    """Whether the rig carries it."""
    model: str = "HDL-32E"
    """Its model (HDL-32E, HDL-64E, Mid-360, OS1-128, VLP-16, XT32): a file of figures with elevations, firing times,
    unit of ranges, width of the beams and errors. HDL-32E, OS1-128 and XT32 are recorded as captures of their packets,
    or in a bag (`bag.on`), as the others always are."""
    turns_per_s: float = Field(default=10.0, ge=5.0, le=20.0)
    """Turns of the head a second; frames a second of a Mid-360."""
    range_max_m: float = Field(default=20.0, gt=2.0, le=100.0)
    """Returns farther than this are not measured (m)."""
    on_azimuth_grid: bool = False
    """Turn a whole number of hundredths of a degree a cycle, so that the azimuths which the packets state are exact;
    otherwise they are rounded by up to 0.005 degrees."""
    divergence_deg: Annotated[float, Field(ge=0.0, le=0.5)] | Literal["data sheet"] = 0.0
    """Width of a beam (degrees): where two of its edges meet things at different ranges, the range is a mixture.
    "data sheet": that of the model."""
    errors: Literal["noise", "model"] = "noise"
    """How it errs: by `noise` alone, or also as its model's file says: noise of ranges and of directions, lost returns,
    drops of rain before the rest, jitter of stamps."""
    laser_range_m: float = Field(default=0.0, ge=0.0, le=0.1)
    """How far the ranges of each laser are off for good (m, 1 σ over the lasers)."""
    laser_gain: float = Field(default=0.0, ge=0.0, le=0.6)
    """How much the intensities of lasers differ (logarithm, 1 σ over the lasers)."""
    dark_m: float | None = Field(default=None, gt=1.0)
    """Distance at which one in e returns of a black surface (10 digital numbers) is lost (m): of intensity I at a range
    r one in exp(I / 10 · (dark_m / r)²) is. None is where left out."""
    false_returns: float = Field(default=0.0, ge=0.0, le=0.05)
    """Share of the firings that meet nothing, but return a range: the sun's light."""
    mount: Mount = Mount(lever_arm_body_m=(-1.72, 0.06, -1.36), roll_deg=1.2, pitch_deg=18.0, heading_deg=-2.5)
    """Mounting of the head (axes flu); it leans back, so that the road behind is seen."""
    clock: ClockError = ClockError()
    """Its clock; the packets count microseconds past the hour of UTC, and nothing else."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.clock.system not in {None, TimeSystem.UTC_HOUR}:
            raise ValueError(f"clock.system '{self.clock.system}', but its packets count from the full UTC hour")
        if self.model not in lidar_model_names():
            raise ValueError(f"model '{self.model}', expected one of: {', '.join(lidar_model_names())}")
        return self


class Sick(Strict):
    """A line scanner with a turning mirror, a SICK LMS 200 that looks down behind the vehicle: 180°, 361 readings."""

    on: bool = False
    """Whether the rig carries it."""
    scans_per_s: float = Field(default=75.0, gt=1.0, le=75.0)
    """Scans a second."""
    resolution_deg: float = 0.5
    """From reading to reading: 0.5 or 1 (degrees)."""
    interlaced: bool = False
    """Whether a scan takes two turns of the mirror, whole degrees in the first and half degrees in the second, as an
    LMS 200 does; 37.5 scans a second are then the most. Otherwise all is measured in one turn (LMS …-S14)."""
    range_max_m: float = Field(default=30.0, gt=1.0, le=32.0)
    """Readings farther than this are none (m); in millimetres the scanner reaches 32 m."""
    divergence_deg: float = Field(default=0.0, ge=0.0, le=1.0)
    """Width of a beam (degrees), as for the lidar."""
    mount: Mount = Mount(lever_arm_body_m=(-2.9, 0.0, -1.45), roll_deg=0.5, pitch_deg=12.0, heading_deg=-0.8)
    """Mounting (axes frd: the middle reading looks along z, down; readings run from right to left)."""
    clock: ClockError = ClockError()
    """Clock of the computer that stamps the telegrams: Unix UTC."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.resolution_deg not in {0.5, 1.0}:
            raise ValueError(f"resolution_deg {self.resolution_deg:g}, expected 0.5 or 1")
        if self.interlaced and (self.scans_per_s > 37.5 or self.resolution_deg != 0.5):
            raise ValueError("interlaced scans are scans of 0.5 degrees, and at most 37.5 a second")
        return self


class Imu(Strict):
    """The inertial measurement unit at the IMU reference point."""

    on: bool = False
    """Whether its raw data are logged."""
    grade: ImuGrade = "tactical"
    """Grade."""
    errors: ImuErrors | None = None
    """Errors, in place of the grade's."""
    rate_hz: float = Field(default=200.0, ge=10.0, le=2000.0)
    """Records a second."""
    clock: ClockError = ClockError()
    """Its clock; GPS time by default."""


class GnssGap(Strict):
    """A time without a GNSS solution (a tunnel, a bridge)."""

    start_s: float = 0.0
    """Begin, from the first profile of the pass (s)."""
    duration_s: float = Field(gt=0.0)
    """Length (s)."""
    passes: list[int] = []
    """Passes with this gap, counted from 1; all of them where empty."""


class Gnss(Strict):
    """A GNSS receiver with real-time kinematic corrections: its solution, without the IMU."""

    on: bool = False
    """Whether its solutions are logged (RTKLIB .pos and NMEA)."""
    rate_hz: float = Field(default=5.0, ge=0.1, le=100.0)
    """Solutions a second."""
    lever_arm_body_m: tuple[float, float, float] = (-0.4, 0.1, -1.9)
    """IMU reference point to antenna: forward, right, down (m)."""
    lever_arm_error_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """How far the rig file's lever arm lies from the true one (m)."""
    sigma_horizontal_m: float = Field(default=0.010, ge=0.0)
    """Error of fixed solutions, north and east each (m)."""
    sigma_vertical_m: float = Field(default=0.018, ge=0.0)
    """Error of fixed solutions, up (m)."""
    time_constant_s: float = Field(default=20.0, gt=0.0)
    """Time constant of the correlated half of these errors (s)."""
    gaps: list[GnssGap] = []
    """Times without a solution; float solutions for some seconds after each."""
    float_after_gap_s: float = Field(default=6.0, ge=0.0)
    """How long solutions stay float after a gap (s)."""
    float_sigma_m: float = Field(default=0.35, ge=0.0)
    """Error of float solutions (m)."""
    jumps_per_minute: float = Field(default=0.0, ge=0.0)
    """Multipath jumps: the solution is off by `jump_m` for one to five seconds and says nothing of it."""
    jump_m: float = Field(default=0.5, ge=0.0)
    """Size of a multipath jump (m, 1 σ)."""


class Encoder(Strict):
    """A wheel encoder: counts the path that a rear wheel drives."""

    on: bool = False
    """Whether a separate log is written; profiles carry its count in any case."""
    rate_hz: float = Field(default=50.0, ge=1.0, le=1000.0)
    """Records a second."""
    ticks_per_m: float = Field(default=1000.0, gt=0)
    """Nominal ticks a metre driven."""
    scale_error: float = Field(default=0.0, ge=-0.1, le=0.1)
    """The wheel really gives ticks_per_m · (1 + scale_error)."""
    side_m: float = Field(default=0.0, ge=-2.0, le=2.0)
    """The wheel's offset from the middle of the vehicle, right positive (m): in turns it drives another path."""
    clock: ClockError = ClockError()
    """Its clock; GPS time by default."""


class Outage(Strict):
    """A time in which the stated trajectory drifts, as one without GNSS that was smoothed from both ends.

    The error of each axis is a random wave, of σ `position_m` or `attitude_deg` in the middle, that fades to 0 at both
    ends as 4 s (1 − s) does, s being the share of the time that has passed. The accuracy file states that σ.
    """

    start_s: float
    """Begin, from the first profile of the pass (s)."""
    duration_s: float = Field(gt=0.0, le=3600.0)
    """Length (s)."""
    position_m: float = Field(default=1.0, ge=0.0, le=100.0)
    """1 σ of north, east and down in its middle (m)."""
    attitude_deg: float = Field(default=0.0, ge=0.0, le=5.0)
    """1 σ of roll, pitch and heading in its middle (degrees)."""
    passes: list[int] = []
    """Passes in which it occurs, counted from 1; all of them where empty."""


class Noise(Strict):
    """Errors of the sensors and of the stated trajectory, 1 σ."""

    profiler_range_m: float = Field(default=0.0, ge=0.0)
    """Range noise of the profilers (m)."""
    lidar_range_m: float = Field(default=0.0, ge=0.0)
    """Range noise of the lidar (m)."""
    sick_range_m: float = Field(default=0.0, ge=0.0)
    """Range noise of the line scanner (m)."""
    intensity: float = Field(default=0.0, ge=0.0, le=60.0)
    """Intensity noise (digital numbers)."""
    dropout: float = Field(default=0.0, ge=0.0, le=0.5)
    """Share of readings and returns that are lost."""
    impulse: float = Field(default=0.0, ge=0.0, le=0.1)
    """Share of profiler readings that are wrong …"""
    impulse_m: float = Field(default=0.03, ge=0.0, le=0.3)
    """… anywhere within this distance of the road (m)."""
    position_m: float = Field(default=0.0, ge=0.0)
    """Position error of the stated trajectory, a Gauss–Markov process on each of north, east, down (m)."""
    down_m: float | None = Field(default=None, ge=0.0)
    """The same of down, where it differs from that of north and east (m)."""
    attitude_deg: float = Field(default=0.0, ge=0.0)
    """Error of the stated roll and pitch, likewise (degrees)."""
    heading_deg: float | None = Field(default=None, ge=0.0)
    """Error of the stated heading, likewise; twice that of roll and pitch where left out (degrees)."""
    time_constant_s: float = Field(default=30.0, gt=0.0)
    """Time constant of the trajectory's errors (s)."""
    attitude_time_constant_s: float | None = Field(default=None, gt=0.0)
    """The same of roll, pitch and heading, where it differs from that of the position (s)."""
    pass_step_m: float = Field(default=0.0, ge=0.0)
    """How far the stated trajectory of a whole pass is off, on each of north, east, down (m)."""
    step_m: float = Field(default=0.0, ge=0.0)
    """Steps of the stated position within a pass, on each axis (m) …"""
    steps_per_minute: float = Field(default=0.0, ge=0.0, le=60.0)
    """… and how often they come."""
    outages: list[Outage] = []
    """Times in which the stated trajectory drifts."""
    control_m: float = Field(default=0.0, ge=0.0)
    """Error of the control points, on each coordinate (m)."""

    def pose_sigma(self) -> tuple[float, float, float, float, float, float]:
        """Return 1 σ of the stated north, east, down (m), roll, pitch, heading (degrees)."""
        down = self.position_m if self.down_m is None else self.down_m
        heading = 2.0 * self.attitude_deg if self.heading_deg is None else self.heading_deg
        return self.position_m, self.position_m, down, self.attitude_deg, self.attitude_deg, heading

    def pose_time_constants_s(self) -> tuple[float, float, float, float, float, float]:
        """Return time constants of the same (s)."""
        turned = self.attitude_time_constant_s or self.time_constant_s
        return *(self.time_constant_s,) * 3, *(turned,) * 3


class Trajectory(Strict):
    """The post-processed trajectory: an SBET, with its accuracy file beside it."""

    poses_per_s: int = Field(default=200, ge=20, le=1000)
    """Poses a second."""
    accuracy: bool = True
    """Write the companion SMRMSG (σ of position, velocity, attitude, once a second) and name it in the survey file."""


class Odometry(Strict):
    """The poses of an odometry in a bag: in a separate frame (`odom`) that begins at the first of them, so that it is
    no trajectory in the map. Its σ are not stated, as most odometries leave them.
    """

    on: bool = False
    """Whether the bag has it."""
    rate_hz: float = Field(default=20.0, ge=1.0, le=200.0)
    """Poses a second."""
    scale: float = Field(default=0.005, ge=-0.1, le=0.1)
    """Share by which its ways are too long."""
    turn_deg_per_m: float = Field(default=0.01, ge=-1.0, le=1.0)
    """How far its heading drifts to the left (degrees per metre driven)."""


class Bag(Strict):
    """The recording of a low-cost rig: one ROS bag with the lidar's clouds, the IMU and the receiver's positions."""

    on: bool = False
    """Whether lidar, IMU and receiver are recorded in a bag, in place of separate logs."""
    container: Literal["mcap", "sqlite", "ros1"] = "mcap"
    """A ROS 2 bag of MCAP or SQLite, or a bag of ROS 1."""
    livox: Literal["CustomMsg", "PointCloud2"] = "CustomMsg"
    """Messages of a Mid-360: those of Livox's driver, or clouds like the other lidars'."""
    odometry: Odometry = Odometry()
    """Poses of an odometry."""
    trajectory: bool = False
    """Whether the office's trajectory lies beside the bag."""
    delay_s: float = Field(default=0.01, ge=0.0)
    """Mean time from when a message is whole to its arrival at the recording computer; single ones vary by half (s)."""


class Control(Strict):
    """Control and check points, surveyed along both edges of the lanes, where the road has no painted targets."""

    spacing_m: float = Field(default=40.0, gt=0.0)
    """Distance from pair to pair (m)."""
    inset_m: float = Field(default=0.45, ge=0.0)
    """Distance from the lanes' edge inwards (m)."""


class Stop(Strict):
    """The vehicle brakes to a standstill, waits, and drives on."""

    at_m: float = Field(ge=0.0)
    """Where, as metres driven since the first profile (m)."""
    duration_s: float = Field(gt=0.0, le=3600.0)
    """How long it stands (s)."""


class SpeedChange(Strict):
    """Another mean speed from here on."""

    at_m: float = Field(ge=0.0)
    """Where, as metres driven since the first profile (m)."""
    speed_m_per_s: float = Field(gt=0.5, le=50.0)
    """Mean speed from there on (m/s)."""


class RoutePiece(Strict):
    """A piece of a route: a straight, or an arc."""

    length_m: float = Field(gt=0)
    """Length (m)."""
    radius_m: float | None = None
    """Radius of an arc, positive when it turns right (m); left out for a straight."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.radius_m is not None and abs(self.radius_m) < 5.0:
            raise ValueError(f"radius_m {self.radius_m:g} is tighter than a car can turn (5 m)")
        return self


class Route(Strict):
    """A free path over the surface, in place of a lane: loops of a calibration yard, turns, reversing.

    The curvature passes from piece to piece over `ease_m`, as a driver turns the wheel.
    """

    station_m: float
    """Station at the start (m)."""
    offset_m: float
    """Offset at the start (m)."""
    heading_deg: float = 0.0
    """Direction of travel at the start, from that of the road, clockwise (degrees)."""
    pieces: list[RoutePiece] = Field(min_length=1)
    """Pieces of the path, one after another."""
    ease_m: float = Field(default=6.0, ge=1.0)
    """Length over which the curvature changes from piece to piece (m)."""
    reverse: bool = False
    """Drive it backwards: the body looks against the direction of travel."""


class PassScene(Strict):
    """One traverse of a lane, or of a free route, recorded as one run."""

    lane: int = Field(default=1, ge=1)
    """Lane that is driven, counted from 1 at the left."""
    direction: Literal["forward", "backward"] = "forward"
    """forward: towards growing stations."""
    offset_m: float = Field(default=0.0, ge=-5.0, le=5.0)
    """Shift of the path from the middle of the lane, right positive along growing stations (m)."""
    route: Route | None = None
    """A free path, in place of the lane."""
    speed_m_per_s: float | None = Field(default=None, gt=0.5, le=50.0)
    """Mean speed; the vehicle's own where left out (m/s)."""
    speeds: list[SpeedChange] = []
    """Changes of the mean speed, in the order driven."""
    stops: list[Stop] = []
    """Stops, in the order driven."""


class Vehicle(Strict):
    """How the vehicle moves."""

    speed_m_per_s: float = Field(default=13.9, gt=0.5, le=50.0)
    """Mean speed (m/s)."""
    speed_variation: float = Field(default=0.06, ge=0.0, le=0.3)
    """Relative variation of the speed."""
    acceleration_m_per_s2: float = Field(default=1.5, ge=0.3, le=5.0)
    """Acceleration and braking at stops and changes of speed (m/s²)."""
    imu_height_m: float = Field(default=0.95, gt=0.0)
    """IMU reference point above the road, along the body's down axis (m)."""
    wander_m: float = Field(default=0.10, ge=0.0, le=0.5)
    """The driver's wander about the middle of the lane (m)."""
    heave_m: float = Field(default=0.004, ge=0.0, le=0.05)
    """Amplitude of the suspension's vertical motion (m)."""
    sway_deg: float = Field(default=0.25, ge=0.0, le=10.0)
    """Amplitude of the suspension's roll and pitch (degrees)."""
    lean_deg_per_m_per_s2: float = Field(default=0.0, ge=0.0, le=3.0)
    """Roll to the outside of a turn, and pitch when braking, for each m/s² (degrees)."""
    standstill_s: float = Field(default=0.0, ge=0.0, le=600.0)
    """Standing still, engine on, before the run-up and after the run-out of each pass (s); the trajectory, IMU, GNSS
    and encoder record it."""
