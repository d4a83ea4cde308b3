"""Settings of navigation: odometry, the smoother and post-processed fixes."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final, Literal, Self

from pydantic import Field, model_validator

from roadscan.core.strict import Strict, pattern_in_words


class OdometryConfig(Strict):
    """Poses from the sweeps of a lidar, for runs with neither a trajectory nor GNSS: a local map without a position on
    Earth.
    """

    lidar: str | None = None
    """The lidar of the rig whose sweeps are matched; the only one at hand where left out."""
    imu: str | None = None
    """The IMU of the rig that says where up is, and watches the turns; the only one at hand where left out. "none": it
    is not used, and the rig stands level at the beginning."""
    range_max_m: float = Field(default=100.0, gt=1.0, le=500.0)
    """Returns farther than this, or than the sensor's limit, are not matched (m)."""
    voxel_m: float = Field(default=0.5, gt=0.05, le=5.0)
    """Edge of the cubes of the map that sweeps are matched with (m); half of it, one return of a cube is kept. 1 m
    takes a third of the time; poses then drift two to three times as much."""
    drift_share: float = Field(default=0.02, gt=0.0, le=0.5)
    """1 σ of the position along each axis, as a share of the way since the beginning (1). 0.02 is that
    of a street whose fronts repeat themselves; among buildings and trees of all kinds it is 0.01 and less."""
    drift_deg_per_100m: float = Field(default=1.0, gt=0.0, le=45.0)
    """1 σ of the heading, and without an IMU of roll and pitch, after 100 m (degrees); it grows with the way."""
    speed_max_m_per_s: float = Field(default=60.0, gt=0.0)
    """A pose that the rig can reach only faster than this is reported (m/s)."""


class SmootherConfig(Strict):
    """Loosely coupled smoothing of GNSS solutions, IMU and odometer."""

    imu: str | None = None
    """The IMU of the rig that navigates; the only one at hand where left out."""
    gnss: str | None = None
    """The GNSS receiver or antenna of the rig; the only one at hand where left out."""
    encoder: str | None = None
    """The odometer of the rig; the only one where left out, none where the run has none. "none": it is not used,
    so that its clock can be found from the trajectory."""
    reversed_runs: list[str] = []
    """Runs driven backwards for the most part; elsewhere accelerations that say so mean an IMU turned by 180°."""
    poses_per_s: float = Field(default=100.0, gt=0.0, le=2000.0)
    """Poses of the trajectory a second; at most the IMU's rate."""
    land_vehicle: bool = True
    """The body moves neither sideways nor up with respect to itself (non-holonomic constraint), and stands still
    now and then (zero-velocity and zero-rotation updates)."""

    imu_samples: Literal["mean", "instant"] = "mean"
    """What a sample of the IMU is: the mean over the interval that ends at its stamp (IMUs that integrate), or the
    value at the stamp itself. The wrong one shifts the IMU by half a sample: 5 ms at 100 Hz."""
    vibration_share: float = Field(default=0.2, ge=0.0, le=10.0)
    """Share of the vibration at the upper end of the IMU's band that adds to its noise: aliases of what is above half
    its rate, samples that are polled rather than timed (1)."""
    imu_clock_sigma_s: float = Field(default=0.0, ge=0.0, le=0.5)
    """1 σ of what remains of the IMU's clock error after its clock's correction: a constant delay against GNSS is
    estimated where this is above zero (s)."""
    imu_clock_wander_ms_per_sqrt_s: float = Field(default=0.0, ge=0.0, le=100.0)
    """How the IMU's clock wanders against GNSS where it is not disciplined: change of that delay over a second, 1 σ,
    as a random walk (ms)."""
    max_imu_gap_s: float = Field(default=1.0, gt=0.0, le=10.0)
    """A longer silence of the IMU ends the trajectory; it begins anew behind it (s)."""

    gnss_velocity_lag_s: float = Field(default=0.0, ge=-1.0, le=1.0)
    """How far the velocities of GNSS lag behind its positions: half an interval where they are means over the interval
    that ends there (s)."""
    gnss_velocity_lag_sigma_s: float = Field(default=0.0, ge=0.0, le=1.0)
    """1 σ of that lag; it is estimated where this is above zero (s)."""
    gnss_sigma_factor: float = Field(default=1.0, gt=0.0, le=100.0)
    """Multiplies all σ that receivers state; they are often optimistic."""
    gnss_floor_horizontal_m: float = Field(default=0.005, ge=0.0)
    """Least σ of a horizontal position component, whatever the log states (m)."""
    gnss_floor_vertical_m: float = Field(default=0.008, ge=0.0)
    """Least σ of a height (m)."""
    gnss_floor_velocity_m_per_s: float = Field(default=0.01, ge=0.0)
    """Least σ of a velocity component (m/s)."""
    gnss_correlated_share: float = Field(default=0.5, ge=0.0, lt=1.0)
    """Share of the variance of a fixed position that does not change from epoch to epoch but slowly (ionosphere,
    multipath); of all other solutions it is nearly everything."""
    gnss_correlation_s: float = Field(default=20.0, gt=0.0)
    """Time constant of that part (s)."""

    constraints_per_s: float = Field(default=5.0, ge=0.5, le=50.0)
    """Updates by odometer, non-holonomic constraint and standstill a second; the σ below hold for one of them."""
    odometer_sigma_m_per_s: float = Field(default=0.02, gt=0.0)
    """1 σ of the odometer's speed (m/s)."""
    odometer_slip: float = Field(default=0.002, ge=0.0, le=0.2)
    """1 σ of the part that grows with speed: slip and unevenness (1)."""
    odometer_scale_sigma: float = Field(default=0.02, ge=0.0, le=0.2)
    """1 σ of the odometer's scale before it is estimated (1)."""
    sideways_m_per_s: float = Field(default=0.05, gt=0.0)
    """1 σ of the velocity to the side of the point that moves only forwards (m/s)."""
    side_slip_deg_per_m_per_s2: float = Field(default=0.15, ge=0.0, le=5.0)
    """1 σ of the side-slip angle of that point for each m/s² of acceleration to the side (degrees)."""
    upwards_m_per_s: float = Field(default=0.10, gt=0.0)
    """1 σ of the velocity upwards, by the springs (m/s)."""
    axle_body_m: tuple[float, float, float] | None = None
    """From the IMU reference point to the point that moves only forwards, on the ground under the middle of the
    unsteered axle: forward, right, down (m). Where left out, the wheel of the odometer, if it has a lever arm."""
    axle_sigma_m: tuple[float, float, float] = (0.1, 0.1, 0.1)
    """1 σ of it (m); where nothing says where the axle is, 1.5, 0.5 and 1 m about the reference point."""
    travel_sigma_deg: float = Field(default=2.0, ge=0.0, le=20.0)
    """1 σ of the angles between the body's forward axis and the direction of travel: pitch, heading (degrees)."""
    standing_m_per_s: float = Field(default=0.01, gt=0.0)
    """1 σ of a standing vehicle's velocity (m/s)."""
    standing_deg_per_s: float = Field(default=0.02, gt=0.0)
    """1 σ of a standing vehicle's rotation (°/s)."""

    measure_noise: bool = True
    """Noise is measured on the run before it is used: the σ of constraints above, and factors of the σ of GNSS and of
    the noise of the IMU. None is taken smaller than stated, but for the share of vibration."""
    gnss_position_factor: float = Field(default=1.0, gt=0.0, le=100.0)
    """Multiplies the σ of positions of GNSS, beside `gnss_sigma_factor` and above the floor (1)."""
    gnss_velocity_factor: float = Field(default=1.0, gt=0.0, le=100.0)
    """Multiplies the σ of velocities of GNSS in the same way (1)."""
    imu_factor_horizontal: float = Field(default=1.0, gt=0.0, le=100.0)
    """Multiplies the noise (1 σ) of the gyroscopes, and of the accelerometers along the level axes of the body (1);
    below 1 only what vibration adds to the data sheet's."""
    imu_factor_vertical: float = Field(default=1.0, gt=0.0, le=100.0)
    """Multiplies the noise (1 σ) of the accelerometers along the vertical axis of the body (1)."""

    outlier_probability: float = Field(default=0.001, gt=0.0, lt=0.5)
    """Updates whose innovation would be exceeded with less than this probability count less."""
    outlier_patience_s: float = Field(default=15.0, gt=0.0)
    """After this long without a position that counts in full they all do again: then the filter is wrong, and not
    the receiver (s)."""


class SplineConfig(Strict):
    """Spline smoothing of a trajectory where GNSS dropped out (``navigation/spline.py``)."""

    on: bool = False
    """Smooth the trajectory of the run; poses outside the rugged spans stay as they are, to the bit."""
    outage_sigma_factor: float = Field(default=4.0, gt=1.0)
    """GNSS dropped out where the stated horizontal σ exceeds its median this many times …"""
    outage_sigma_m: float = Field(default=0.05, gt=0.0)
    """… and this (m)."""
    step_m: float = Field(default=0.03, gt=0.0)
    """Smallest step between two poses that neighbouring motion does not explain (m): the end of an outage."""
    step_reach_s: float = Field(default=15.0, gt=0.0)
    """Drift before a step is taken back over this long, where nothing says when the outage began (s)."""
    rugged_factor: float = Field(default=5.0, gt=1.0)
    """A span is rugged where its increments scatter this many times more than the trajectory's usually do …"""
    rugged_m: float = Field(default=0.005, gt=0.0)
    """… and by more than this (m)."""
    knot_s: float = Field(default=0.5, gt=0.0, le=60.0)
    """Distance of the knots of the cubic B-spline that replaces a rugged span (s): faster motion is taken as noise."""
    ease_s: float = Field(default=0.5, gt=0.0)
    """At the ends of a rugged span the trajectory passes into the spline over this long (s)."""
    longest_s: float = Field(default=180.0, gt=0.0)
    """Longer spans are left as they are (s)."""
    fill_gap_s: float = Field(default=0.0, ge=0.0, le=60.0)
    """Gaps without poses up to this long are filled (s); their σ is what filling as long a gap elsewhere in the same
    trajectory misses."""


ANTENNA_HEIGHT_MAX_M: Final = 100.0
"""No antenna stands higher above its mark (m): a larger number is in another unit."""

_SYSTEMS: Final = pattern_in_words(
    "^[GREJC]+$", "letters of satellite systems: G GPS, R GLONASS, E Galileo, J QZSS, C BeiDou"
)
_GEOCENTRIC: Final = ("x_m", "y_m", "z_m")
_GEODETIC: Final = ("latitude_deg", "longitude_deg", "height_m")


class PpkBase(Strict):
    """The base station."""

    files: list[Path] = Field(min_length=1)
    """Its observations (RINEX 2 or 3, or UBX), several where it changes its file: paths relative to the survey file in
    `[navigation.ppk]`, to the rover's folder in a log's options."""
    crs: str
    """CRS of its position, geocentric (such as "EPSG:7930", ETRF2000) or geographic with ellipsoidal heights
    ("EPSG:7931"); the solution is in its datum."""
    epoch: float | None = Field(default=None, ge=1980.0, le=2200.0)
    """Epoch of its position (decimal year); required where the datum's coordinates move with time, as those of ITRF and
    WGS 84 do."""
    x_m: float | None = None
    """Geocentric X of the mark (m)."""
    y_m: float | None = None
    """Geocentric Y (m)."""
    z_m: float | None = None
    """Geocentric Z (m)."""
    latitude_deg: float | None = Field(default=None, ge=-90, le=90)
    """Geodetic latitude of the mark (degrees)."""
    longitude_deg: float | None = Field(default=None, ge=-180, le=360)
    """Longitude (degrees)."""
    height_m: float | None = None
    """Ellipsoidal height of the mark (m), without the antenna's."""
    antenna_height_m: float | None = Field(default=None, ge=-ANTENNA_HEIGHT_MAX_M, le=ANTENNA_HEIGHT_MAX_M)
    """Height of the antenna's reference point above the mark, vertically (m); 0 where the position is the antenna's.
    Always required."""
    antenna: str = ""
    """Type of the antenna as `antenna_calibration` names it, such as "TRM29659.00     NONE"."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        given = {name for name in (*_GEOCENTRIC, *_GEODETIC) if getattr(self, name) is not None}
        if given not in ({*_GEOCENTRIC}, {*_GEODETIC}):
            raise ValueError(
                f"the base's position is {', '.join(_GEOCENTRIC)} or {', '.join(_GEODETIC)}, all three of one kind"
            )
        return self

    @property
    def is_geocentric(self) -> bool:
        """Whether the position is X, Y, Z."""
        return self.x_m is not None

    @property
    def position(self) -> tuple[float, ...]:
        """X, Y, Z (m), or latitude (degrees), longitude (degrees), height (m)."""
        return tuple(getattr(self, name) for name in (_GEOCENTRIC if self.is_geocentric else _GEODETIC))


class PpkSettings(Strict):
    """Post-processing of a rover's observations against those of a base station, by RTKLIB."""

    base: PpkBase | None = None
    """The base station: files, position with its CRS and epoch, height of its antenna."""
    navigation: list[Path] = []
    """Navigation files (broadcast orbits) of the day; not needed where rover or base is UBX and recorded them."""
    precise: list[Path] = []
    """Precise orbits and clocks (SP3, CLK), used in place of the broadcast ones."""
    mode: Literal["kinematic", "static"] = "kinematic"
    """How the rover moves: on a vehicle, or not at all."""
    direction: Literal["combined", "forward", "backward"] = "combined"
    """Direction in which the observations are processed: combined takes both and is best. A combined solution is float
    where both directions are fixed and contradict each other."""
    antenna_height_m: float | None = Field(default=None, ge=-ANTENNA_HEIGHT_MAX_M, le=ANTENNA_HEIGHT_MAX_M)
    """Height of the rover's antenna above the point whose position is wanted (m): 0 for the antenna itself, from which
    the rig's lever arm counts. It may be left out, for 0, where the rover's file states none."""
    antenna: str = ""
    """Type of the rover's antenna as `antenna_calibration` names it."""
    antenna_calibration: Path | None = None
    """Phase centres of antennas (ANTEX, or NGS with the ending .pcv), for different antennas on rover and base."""
    systems: str = Field(default="GREJC", pattern=_SYSTEMS)
    """Satellite systems: G GPS, R GLONASS, E Galileo, J QZSS, C BeiDou."""
    frequencies: int = Field(default=2, ge=1, le=3)
    """Number of frequencies: 1 is L1/E1/B1, 2 adds L2/E5b/B2, 3 adds L5/E5a."""
    elevation_mask_deg: float = Field(default=15.0, ge=0.0, lt=90.0)
    """Satellites below this elevation are not used (degrees)."""
    ambiguities: Literal["off", "continuous", "instantaneous", "fix-and-hold"] = "continuous"
    """How whole numbers are found for the carrier phase's ambiguities; fix-and-hold keeps a wrong one longer."""
    ratio: float = Field(default=3.0, ge=1.0)
    """Least ratio of the second-best to the best set of ambiguities, for a position that is called fixed."""
    max_age_s: float = Field(default=30.0, gt=0.0)
    """Oldest base observation that is used for an epoch of the rover (s)."""

    def shaping(self) -> dict[str, Any]:
        """Return the settings for keys, with files by their names: their content is in the log's fingerprint."""
        return {name: _names(value) for name, value in self.model_dump().items()}


def _names(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _names(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_names(one) for one in value]
    return value.name if isinstance(value, Path) else value
