"""The scene: road, roadside, vehicle, sensors and errors of a simulated survey (``SCENE.toml``).

Lengths are metres of the map; *station* runs along the reference line, *offset* is positive to its right.
"""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any, Self

from pydantic import BaseModel, Field, model_validator

from roadscan.core.errors import ConfigError, nearest
from roadscan.core.strict import NAME_PATTERN, Strict, load_toml
from roadscan.simulate.lidar_model import lidar_model
from roadscan.simulate.scene.camera import Camera, FurtherCamera, SurfaceAlbedo
from roadscan.simulate.scene.rig import (
    Bag,
    ClockError,
    Control,
    Encoder,
    Gnss,
    Imu,
    Lidar,
    Mount,
    MountError,
    Noise,
    PassScene,
    Profilers,
    Route,
    Sick,
    Trajectory,
    Vehicle,
)
from roadscan.simulate.scene.road import Element, Road
from roadscan.simulate.scene.roadside import Barrier, Roadside

__all__ = [
    "Bag",
    "Camera",
    "ClockError",
    "Control",
    "Element",
    "Encoder",
    "FurtherCamera",
    "Gnss",
    "Imu",
    "Lidar",
    "MapScene",
    "Mount",
    "MountError",
    "Noise",
    "PassScene",
    "Profilers",
    "Road",
    "Roadside",
    "Route",
    "Scene",
    "Sick",
    "SurfaceAlbedo",
    "Trajectory",
    "Vehicle",
    "shipped_scenes",
]

_EARLIEST, _LATEST = dt.datetime(1981, 1, 1, tzinfo=dt.UTC), dt.datetime(2080, 1, 1, tzinfo=dt.UTC)  # of starts


class MapScene(Strict):
    """Where on the Earth the road lies."""

    crs: str = "EPSG:32632"
    """Projected CRS of the map; heights are ellipsoidal. The logs' datum is the CRS's own. "local": a local frame
    of metres, x to the right of y, z up, that is not tied to the Earth; logs that need the Earth cannot be written."""
    easting_m: float = 691_000.0
    """Easting of station 0 on the reference line (m)."""
    northing_m: float = 5_335_000.0
    """Northing of station 0 on the reference line (m)."""
    height_m: float = 560.0
    """Ellipsoidal height of station 0 on the reference line, waves left out (m)."""
    azimuth_deg: float = 57.0
    """Direction of the reference line at station 0, clockwise from grid north (degrees)."""


class Scene(Strict):
    """A simulated survey, whole. Every field has a default; ``Scene()`` is a straight road without defects."""

    id: str = Field(default="simulated", pattern=NAME_PATTERN)
    """Name of the survey."""
    title: str = "Simulated survey"
    """One line about it."""
    seed: int = Field(default=1, ge=0)
    """Same seed, same bytes."""
    start: dt.datetime = dt.datetime(2026, 5, 4, 9, 30, tzinfo=dt.UTC)
    """First profile of the first pass, with zone (2026-05-04T09:30:00Z), in the years 1981 to 2079."""
    pause_s: float = Field(default=600.0, ge=10.0)
    """From the start of one pass to the start of the next (s)."""
    length_m: float = Field(default=100.0, ge=1.0, le=100_000.0)
    """Length of road that each pass drives, from station 0 (m)."""
    map: MapScene = MapScene()
    """Where the road lies."""
    road: Road = Road()
    """Its surface."""
    roadside: Roadside = Roadside()
    """What stands and moves beside and on it."""
    albedo: SurfaceAlbedo = SurfaceAlbedo()
    """Random brightness of surfaces in pictures."""
    passes: list[PassScene] = Field(default=[PassScene(lane=2)], min_length=1)
    """Traverses, in the order driven."""
    vehicle: Vehicle = Vehicle()
    """How the vehicle moves."""
    trajectory: Trajectory = Trajectory()
    """Post-processed trajectory."""
    profilers: Profilers = Profilers()
    """Triangulation pair."""
    lidar: Lidar = Lidar()
    """Spinning lidar."""
    sick: Sick = Sick()
    """Line scanner with a turning mirror."""
    imu: Imu = Imu()
    """Inertial measurement unit."""
    gnss: Gnss = Gnss()
    """GNSS receiver."""
    encoder: Encoder = Encoder()
    """Wheel encoder."""
    camera: Camera = Camera()
    """Camera."""
    further_cameras: list[FurtherCamera] = []
    """Further cameras of the rig."""
    bag: Bag = Bag()
    """Recording in one ROS bag."""
    noise: Noise = Noise()
    """Errors; all 0 where left out."""
    control: Control = Control()
    """Control points."""

    @property
    def cameras(self) -> dict[str, Camera]:
        """Cameras that the rig carries, by name."""
        named = {"camera": self.camera} | {one.name: one for one in self.further_cameras}
        return {name: one for name, one in named.items() if one.on}

    @property
    def stations_m(self) -> tuple[float, float]:
        """First and last station of the road (m)."""
        return -self.road.lead_m, self.length_m + self.road.lead_m

    @model_validator(mode="after")
    def _numbers(self) -> Self:
        for where, value in _floats(self, ""):
            if math.isnan(value) or (math.isinf(value) and not _is_open_end(where, value)):
                raise ValueError(f"'{where}' is {value:g}, expected a finite number")
        return self

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.lidar.on and not self.bag.on:
            self._check_capture()
        if len({one.name for one in self.further_cameras}) < len(self.further_cameras):
            raise ValueError("two of further_cameras have one name")
        for one in self.passes:
            if one.route is None and one.lane > self.road.lanes:
                raise ValueError(f"a pass drives lane {one.lane} of a road with {self.road.lanes}")
            fastest = max([one.speed_m_per_s or self.vehicle.speed_m_per_s, *(c.speed_m_per_s for c in one.speeds)])
            rate = fastest * (1.0 + self.vehicle.speed_variation) / self.profilers.spacing_m
            if self.profilers.on and rate > self.profilers.profiles_per_s_max:
                raise ValueError(
                    f"{fastest:g} m/s at a spacing of {self.profilers.spacing_m:g} m needs {rate:,.0f} profiles/s, "
                    f"and the heads give {self.profilers.profiles_per_s_max:,.0f}"
                )
            lead = 1.3 * (one.speed_m_per_s or self.vehicle.speed_m_per_s) + 8.0
            if one.route is None and self.road.lead_m < lead:
                raise ValueError(
                    f"road.lead_m {self.road.lead_m:g} leaves no run-up at this speed; give {lead:.0f} or more"
                )
        if self.start.tzinfo is None:
            raise ValueError("start has no time zone; write it as 2026-05-04T09:30:00Z")
        if not _EARLIEST <= self.start < _LATEST:
            raise ValueError(f"start {self.start.isoformat()} is not in the years 1981 to 2079")
        for i, target in enumerate(self.road.targets):
            self._refuse_beyond(f"road.targets.{i}.station_m", target.station_m)
        return self

    def _check_capture(self) -> None:
        """Refuse what no capture records: models whose packets are not written, and turns that columns do not fit."""
        name, figures = self.lidar.model, lidar_model(self.lidar.model).figures
        if figures.capture is None:
            raise ValueError(f"lidar.model '{name}' is recorded in a bag: set bag.on = true")
        turns_per_s = round(1e9 / (figures.cycle_ns * (figures.columns or 1)), 2)
        if figures.columns is not None and self.lidar.turns_per_s != turns_per_s:
            raise ValueError(f"a capture of an {name} has {figures.columns:,} columns a turn: lidar.turns_per_s is "
                             f"{self.lidar.turns_per_s:g}, expected {turns_per_s:g}")  # fmt: skip

    def _refuse_beyond(self, where: str, station_m: float) -> None:
        first, last = self.stations_m
        if not first <= station_m <= last:
            raise ValueError(
                f"'{where}' {station_m:g} lies beyond the road, which goes from {first:g} to {last:g} "
                "(road.lead_m before station 0 and after length_m)"
            )

    def _check_roadside(self) -> None:
        """Refuse objects off the road; a scene that `changed` shortens leaves them out instead."""
        for kind, listed in self.roadside:
            for i, one in enumerate(listed):
                for key in ("start_m", "end_m") if isinstance(one, Barrier) else ("station_m",):
                    self._refuse_beyond(f"roadside.{kind}.{i}.{key}", getattr(one, key))

    @classmethod
    def load(cls, source: str | Path) -> Self:
        """Read a scene: a TOML file, or the name of one that ships with roadscan (:func:`shipped_scenes`)."""
        shipped = shipped_scenes()
        if isinstance(source, str) and source in shipped:
            with resources.as_file(shipped[source]) as file:
                return cls._read(file, f"scene {source}")
        if not Path(source).is_file():
            raise ConfigError(
                f"there is no scene '{source}'{nearest(str(source), shipped)}",
                expected="a TOML file, or one of: " + ", ".join(shipped),
            )
        return cls._read(Path(source), source)

    @classmethod
    def _read(cls, file: Path, name: str | Path) -> Self:
        scene = cls.parse(load_toml(file), file=name)
        try:
            scene._check_roadside()
        except ValueError as error:
            raise ConfigError(str(error), file=name) from error
        return scene

    def changed(self, **values: Any) -> Self:
        """Return the scene with some values replaced; dictionaries are merged, key by key.

        ``scene.changed(length_m=20.0, lidar={"on": False})`` keeps all other settings of the lidar.
        """
        return self.parse(_merged(self.model_dump(), values))

    def noiseless(self) -> Self:
        """Return the scene without any error except the rounding of the logs.

        No noise, true mountings stated, right clocks, perfect IMUs, beams without width.
        """
        values: dict[str, Any] = self.model_dump() | {"noise": Noise()}
        right = {"offset_s": 0.0, "drift_ppm": 0.0}
        for name in ("profilers", "lidar", "sick", "imu", "encoder"):
            values[name]["clock"] |= right
        for mount in (values["profilers"]["left"], values["profilers"]["right"]):
            mount["error"] = {}
        for name in ("lidar", "sick"):
            values[name]["mount"]["error"] = {}
        for name in ("lidar", "sick"):
            values[name]["divergence_deg"] = 0.0
        values["lidar"] |= {"errors": "noise", "laser_range_m": 0.0, "laser_gain": 0.0, "dark_m": None}
        values["lidar"]["false_returns"] = 0.0
        values["imu"] |= {"grade": "perfect", "errors": None}
        if self.profilers.head_imus is not None:
            values["profilers"]["head_imus"] = "perfect"
        values["gnss"] |= {"sigma_horizontal_m": 0.0, "sigma_vertical_m": 0.0, "float_sigma_m": 0.0}
        values["gnss"] |= {"jumps_per_minute": 0.0, "lever_arm_error_m": (0.0, 0.0, 0.0)}
        values["encoder"]["scale_error"] = 0.0
        for camera in (values["camera"], *values["further_cameras"]):
            camera["clock"] |= right
            camera["mount"]["error"], camera["lens_error"], camera["faults"] = {}, {}, {}
            camera["noise"], camera["exposure"] = 0.0, None
        return self.parse(values)


def shipped_scenes() -> dict[str, Any]:
    """Return the scenes that come with roadscan: name → resource."""
    folder = resources.files("roadscan.simulate") / "scenes"
    return {f.name.removesuffix(".toml"): f for f in sorted(folder.iterdir(), key=lambda f: f.name)}


def _floats(value: object, where: str) -> Iterator[tuple[str, float]]:
    """Yield all floats of a model, with the keys that lead to them."""
    if isinstance(value, float):
        yield where, value
    elif isinstance(value, BaseModel):
        for key, part in value:
            yield from _floats(part, f"{where}.{key}" if where else key)
    elif isinstance(value, list | tuple):
        for i, part in enumerate(value):
            yield from _floats(part, f"{where}.{i}")


def _is_open_end(where: str, value: float) -> bool:
    """Return whether an infinity means that markings or joints go as far as the road."""
    is_open = where.startswith(("road.markings.", "road.joints."))
    return is_open and where.endswith(".start_m" if value < 0.0 else ".end_m")


def _merged(old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    out = dict(old)
    for key, value in new.items():
        both = isinstance(value, dict) and isinstance(old.get(key), dict)
        out[key] = _merged(old[key], value) if both else value
    return out
