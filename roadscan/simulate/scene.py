"""The scene: road, vehicle, sensors and noise of a simulated survey (``SCENE.toml``).

Lengths are metres of the map; *station* runs along the reference line, *offset* is positive to its right.
"""

from __future__ import annotations

import datetime as dt
from importlib import resources
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import Field, model_validator

from roadscan.model.errors import ConfigError, nearest
from roadscan.model.strict import Strict, load_toml

_NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$"


class MapScene(Strict):
    """Where on the Earth the road lies."""

    crs: str = "EPSG:32632"
    """Projected CRS of the map; heights are ellipsoidal. The logs' datum is the CRS's own."""
    easting_m: float = 691_000.0
    """Easting of station 0 on the reference line (m)."""
    northing_m: float = 5_335_000.0
    """Northing of station 0 on the reference line (m)."""
    height_m: float = 560.0
    """Ellipsoidal height of station 0 on the reference line, waves left out (m)."""
    azimuth_deg: float = 57.0
    """Direction of the reference line at station 0, clockwise from grid north (degrees)."""


class Element(Strict):
    """A piece of the alignment."""

    kind: Literal["straight", "spiral", "arc"]
    """straight; arc of `radius_m`; spiral: a clothoid from the curvature of the piece before to that of
    the piece after it."""
    length_m: float = Field(gt=0)
    """Length along the reference line (m)."""
    radius_m: float | None = None
    """Radius of an arc, positive when it turns right (m)."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.kind == "arc") != (self.radius_m is not None):
            raise ValueError("an arc needs radius_m, and nothing else has one")
        if self.radius_m is not None and abs(self.radius_m) < 20.0:
            raise ValueError(f"radius_m {self.radius_m:g} is tighter than 20 m")
        return self


class Wave(Strict):
    """One sine of the longitudinal profile."""

    wavelength_m: float = Field(ge=2.0)
    """Length of the wave along the reference line (m)."""
    amplitude_m: float = Field(ge=0.0)
    """Half the height between trough and crest (m)."""
    phase_deg: float = 0.0
    """Phase at station 0 (degrees)."""


class Rut(Strict):
    """A wheel path worn down over the whole length of the road."""

    offset_m: float
    """Offset of its deepest line (m)."""
    width_m: float = Field(default=0.7, gt=0.05)
    """Width from edge to edge (m)."""
    depth_m: float = Field(default=0.012, ge=0.0, le=0.2)
    """Depth below the unworn surface (m)."""


class Pothole(Strict):
    """A round hole: depth · (1 − (ρ / radius)⁴)² below the worn surface."""

    station_m: float
    """Station of its centre (m)."""
    offset_m: float
    """Offset of its centre (m)."""
    radius_m: float = Field(gt=0.02, le=3.0)
    """Radius of its rim (m)."""
    depth_m: float = Field(gt=0.0, le=0.3)
    """Depth of its centre (m)."""


class Crack(Strict):
    """An open crack along a broken line: depth · (1 − (distance / half width)²)² below the worn surface."""

    points_m: list[tuple[float, float]] = Field(min_length=2)
    """Corners of the line, each a station and an offset (m)."""
    width_m: float = Field(default=0.006, ge=0.001, le=0.1)
    """Width at the surface (m)."""
    depth_m: float = Field(default=0.01, gt=0.0, le=0.1)
    """Depth in the middle (m)."""


class Marking(Strict):
    """A painted line along the road: intensity only."""

    offset_m: float
    """Offset of its middle (m)."""
    width_m: float = Field(default=0.12, gt=0.0)
    """Width (m)."""
    dash_m: float = Field(default=0.0, ge=0.0)
    """Length of a dash (m); 0: a solid line."""
    gap_m: float = Field(default=0.0, ge=0.0)
    """Length of the gap between dashes (m)."""


class Brightness(Strict):
    """Intensity of each material, in digital numbers of a profiler (0–255)."""

    asphalt: float = Field(default=70.0, ge=0, le=255)
    """Asphalt of the lanes."""
    marking: float = Field(default=190.0, ge=0, le=255)
    """Lane markings."""
    defect: float = Field(default=38.0, ge=0, le=255)
    """Inside potholes and cracks."""
    verge: float = Field(default=105.0, ge=0, le=255)
    """Verge beside the lanes."""


class Road(Strict):
    """The road's surface: a function of station and offset, known everywhere up to the verge's edge."""

    alignment: list[Element] = [Element(kind="straight", length_m=100.0)]
    """Pieces of the reference line from station 0 on, repeated in both directions as far as the road goes."""
    lead_m: float = Field(default=45.0, ge=20.0)
    """Length of road before station 0 and after the last one (m)."""
    lanes: int = Field(default=2, ge=1, le=12)
    """Number of lanes; the reference line is the middle of them. Lane 1 is the leftmost."""
    lane_width_m: float = Field(default=3.5, ge=2.5, le=6.0)
    """Width of a lane (m)."""
    cross_slope: float = Field(default=0.025, ge=-0.12, le=0.12)
    """Fall from the crown to both sides (m/m)."""
    crown_rounding_m: float = Field(default=0.2, gt=0.0)
    """Within this distance of the crown the two sides pass into each other (m)."""
    verge_width_m: float = Field(default=7.0, ge=0.5)
    """Width of the verge beside the lanes; beyond it there is no surface (m)."""
    verge_slope: float = Field(default=0.07, ge=-0.2, le=0.2)
    """Fall of the verge away from the road (m/m)."""
    grade: float = Field(default=0.018, ge=-0.15, le=0.15)
    """Rise along the reference line (m/m)."""
    waves: list[Wave] = []
    """Waves on top of the grade."""
    ruts: list[Rut] = []
    """Wheel paths."""
    potholes: list[Pothole] = []
    """Potholes; where any of potholes and cracks overlap, the deepest counts."""
    cracks: list[Crack] = []
    """Cracks."""
    repeat_m: float = Field(default=0.0, ge=0.0)
    """Potholes and cracks come again each this many metres of station; 0: they do not."""
    markings: list[Marking] = []
    """Lane markings."""
    brightness: Brightness = Brightness()
    """Intensities."""

    @property
    def half_width_m(self) -> float:
        """From the reference line to the lanes' edge (m)."""
        return self.lanes * self.lane_width_m / 2

    @property
    def edge_m(self) -> float:
        """From the reference line to the outer edge of the verge (m)."""
        return self.half_width_m + self.verge_width_m

    def lane_offset_m(self, lane: int) -> float:
        """Offset of the middle of lane `lane`, counted from 1 at the left (m)."""
        return (lane - (self.lanes + 1) / 2) * self.lane_width_m

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.alignment:
            raise ValueError("alignment is empty: give at least one straight, arc or spiral")
        tightest = min((abs(e.radius_m) for e in self.alignment if e.radius_m is not None), default=float("inf"))
        if tightest < 1.5 * self.edge_m:
            raise ValueError(
                f"an arc of {tightest:g} m is too tight for a road that reaches {self.edge_m:g} m from its reference "
                "line (1.5 times that is the limit)"
            )
        if self.crown_rounding_m > self.half_width_m / 2:
            raise ValueError("crown_rounding_m is more than half of the lanes' half width")
        return self


class PassScene(Strict):
    """One traverse of a lane, recorded as one run."""

    lane: int = Field(ge=1)
    """Lane that is driven, counted from 1 at the left."""
    direction: Literal["forward", "backward"] = "forward"
    """forward: towards growing stations."""


class Vehicle(Strict):
    """How the vehicle moves."""

    speed_m_per_s: float = Field(default=13.9, gt=0.5, le=50.0)
    """Mean speed (m/s)."""
    speed_variation: float = Field(default=0.06, ge=0.0, le=0.3)
    """Relative variation of the speed."""
    imu_height_m: float = Field(default=0.95, gt=0.0)
    """IMU reference point above the road, along the body's down axis (m)."""
    wander_m: float = Field(default=0.10, ge=0.0, le=0.5)
    """The driver's wander about the middle of the lane (m)."""
    heave_m: float = Field(default=0.004, ge=0.0, le=0.05)
    """Amplitude of the suspension's vertical motion (m)."""
    sway_deg: float = Field(default=0.25, ge=0.0, le=3.0)
    """Amplitude of the suspension's roll and pitch (degrees)."""
    poses_per_s: int = Field(default=200, ge=20, le=1000)
    """Poses of the trajectory a second."""
    ticks_per_m: float = Field(default=1000.0, gt=0)
    """Ticks of the wheel encoder per metre driven."""


class Mount(Strict):
    """Lever arm and boresight of a sensor (the true ones; the rig file states the same)."""

    lever_arm_body_m: tuple[float, float, float]
    """IMU reference point to sensor origin: forward, right, down (m)."""
    roll_deg: float = 0.0
    """Boresight about body x (degrees); the order is Z-Y-X."""
    pitch_deg: float = 0.0
    """Boresight about body y (degrees)."""
    heading_deg: float = 0.0
    """Boresight about body z (degrees)."""


class Profilers(Strict):
    """The laser-triangulation pair at the vehicle's rear, looking down."""

    on: bool = True
    """Whether the rig carries them."""
    spacing_m: float = Field(default=0.02, gt=0.0005)
    """Distance driven from profile to profile (m)."""
    readings: int = Field(default=1000, ge=2, le=20_000)
    """Readings a profile and head."""
    width_m: float = Field(default=2.04, gt=0.1, le=5.0)
    """From the first to the last reading of a head (m)."""
    range_offset_m: float = Field(default=0.8, ge=0.0)
    """Range that a raw value of 0 would stand for (m)."""
    range_step_m: float = Field(default=0.00005, ge=0.000001, le=0.01)
    """Range of one raw unit (m); rounding errors are half of it."""
    left: Mount = Mount(lever_arm_body_m=(-2.35, -0.98, -1.08), roll_deg=0.4, pitch_deg=-0.3, heading_deg=0.6)
    """Mounting of the left head (axes frd)."""
    right: Mount = Mount(lever_arm_body_m=(-2.28, 0.99, -1.11), roll_deg=-0.35, pitch_deg=0.25, heading_deg=-0.5)
    """Mounting of the right head (axes frd)."""


class Lidar(Strict):
    """The spinning lidar, a Velodyne HDL-32E."""

    on: bool = True
    """Whether the rig carries it."""
    turns_per_s: float = Field(default=10.0, ge=5.0, le=20.0)
    """Turns of the head a second."""
    range_max_m: float = Field(default=20.0, gt=2.0, le=100.0)
    """Returns farther than this are not measured (m)."""
    on_azimuth_grid: bool = False
    """Fire on the hundredths of a degree that the packets state, at a whole number of them a cycle. The
    directions of a decoder are then exact; otherwise they are rounded by up to 0.01 degrees."""
    mount: Mount = Mount(lever_arm_body_m=(-1.72, 0.06, -1.36), roll_deg=1.2, pitch_deg=18.0, heading_deg=-2.5)
    """Mounting of the head (axes flu); it leans back, so that the road behind is seen."""


class Noise(Strict):
    """Errors of the sensors and of the stated trajectory, 1 σ."""

    profiler_range_m: float = Field(default=0.0, ge=0.0)
    """Range noise of the profilers (m)."""
    lidar_range_m: float = Field(default=0.0, ge=0.0)
    """Range noise of the lidar (m)."""
    intensity: float = Field(default=0.0, ge=0.0, le=60.0)
    """Intensity noise (digital numbers)."""
    dropout: float = Field(default=0.0, ge=0.0, le=0.5)
    """Share of readings and returns that are lost."""
    position_m: float = Field(default=0.0, ge=0.0)
    """Position error of the stated trajectory, a Gauss–Markov process on each of north, east, down (m)."""
    attitude_deg: float = Field(default=0.0, ge=0.0)
    """Error of the stated roll and pitch, likewise; that of heading is twice this (degrees)."""
    time_constant_s: float = Field(default=30.0, gt=0.0)
    """Time constant of the trajectory's errors (s)."""
    control_m: float = Field(default=0.0, ge=0.0)
    """Error of the control points, on each coordinate (m)."""


class Control(Strict):
    """Control and check points, surveyed along both edges of the lanes."""

    spacing_m: float = Field(default=40.0, gt=0.0)
    """Distance from pair to pair (m)."""
    inset_m: float = Field(default=0.45, ge=0.0)
    """Distance from the lanes' edge inwards (m)."""


class Scene(Strict):
    """A simulated survey, whole. Every field has a default; ``Scene()`` is a straight road without defects."""

    id: str = Field(default="simulated", pattern=_NAME)
    """Name of the survey."""
    title: str = "Simulated survey"
    """One line about it."""
    seed: int = Field(default=1, ge=0)
    """Same seed, same bytes."""
    start: dt.datetime = dt.datetime(2026, 5, 4, 9, 30, tzinfo=dt.UTC)
    """First profile of the first pass, with zone (2026-05-04T09:30:00Z)."""
    pause_s: float = Field(default=600.0, ge=10.0)
    """From the start of one pass to the start of the next (s)."""
    length_m: float = Field(default=100.0, ge=1.0, le=100_000.0)
    """Length of road that each pass drives, from station 0 (m)."""
    map: MapScene = MapScene()
    """Where the road lies."""
    road: Road = Road()
    """Its surface."""
    passes: list[PassScene] = Field(default=[PassScene(lane=2)], min_length=1)
    """Traverses, in the order driven."""
    vehicle: Vehicle = Vehicle()
    """How the vehicle moves."""
    profilers: Profilers = Profilers()
    """Triangulation pair."""
    lidar: Lidar = Lidar()
    """Spinning lidar."""
    noise: Noise = Noise()
    """Errors; all 0 where left out."""
    control: Control = Control()
    """Control points."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        for one in self.passes:
            if one.lane > self.road.lanes:
                raise ValueError(f"a pass drives lane {one.lane} of a road with {self.road.lanes}")
        if self.start.tzinfo is None:
            raise ValueError("start has no time zone; write it as 2026-05-04T09:30:00Z")
        duration = self.length_m / self.vehicle.speed_m_per_s + 5.0
        if len(self.passes) > 1 and self.pause_s < duration:
            raise ValueError(f"pause_s {self.pause_s:g} is shorter than a pass ({duration:.0f} s with its lead)")
        lead = 1.3 * self.vehicle.speed_m_per_s + 8.0
        if self.road.lead_m < lead:
            raise ValueError(
                f"road.lead_m {self.road.lead_m:g} leaves no run-up at this speed; give {lead:.0f} or more"
            )
        return self

    @classmethod
    def load(cls, source: str | Path) -> Self:
        """Read a scene: a TOML file, or the name of one that ships with roadscan (:func:`shipped_scenes`)."""
        shipped = shipped_scenes()
        if isinstance(source, str) and source in shipped:
            with resources.as_file(shipped[source]) as file:
                return cls.parse(load_toml(file), file=f"scene {source}")
        if not Path(source).is_file():
            raise ConfigError(
                f"there is no scene '{source}'{nearest(str(source), shipped)}",
                expected="a TOML file, or one of: " + ", ".join(shipped),
            )
        return cls.parse(load_toml(source), file=source)

    def changed(self, **values: Any) -> Self:
        """The scene with some values replaced; dictionaries are merged, key by key.

        ``scene.changed(length_m=20.0, lidar={"on": False})`` keeps all other settings of the lidar.
        """
        return self.parse(_merged(self.model_dump(), values))

    def noiseless(self) -> Self:
        """The scene without any error but the rounding of the logs."""
        return self.parse(self.model_dump() | {"noise": Noise()})


def shipped_scenes() -> dict[str, Any]:
    """Scenes that come with roadscan: name → resource."""
    folder = resources.files("roadscan.simulate") / "scenes"
    return {f.name.removesuffix(".toml"): f for f in sorted(folder.iterdir(), key=lambda f: f.name)}


def _merged(old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    out = dict(old)
    for key, value in new.items():
        both = isinstance(value, dict) and isinstance(old.get(key), dict)
        out[key] = _merged(old[key], value) if both else value
    return out
