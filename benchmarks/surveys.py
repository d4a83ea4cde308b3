"""Surveys on disk for the benchmarks of whole runs: raw logs in formats that roadscan reads, and their survey files.

A survey is made once below a folder and found there again. The same parameters give the same bytes. What lies under
the sensors repeats itself, so that making a survey takes about as long as writing it.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.course import CRS, GEODETIC, HOUR_UTC, IMU_HEIGHT_M, WEEK, Course, heave_m
from benchmarks.lidar_drive import SPEED_M_PER_S, write_drive
from benchmarks.pavement import RANGE_STEP_M, Patch, UInt8, UInt16, even_epochs, patch, paved, write_scans

LINE_SPEED_M_PER_S = 27.8
"""100 km/h."""
LINE_SPACING_M = LINE_SPEED_M_PER_S / 28_000
"""From profile to profile at 28,000 profiles/s: a millimetre."""

_HEAD_READINGS = 2000
_OVERLAP = 40
"""Readings that both heads see."""
_HEAD_HEIGHT_M = 1.2
_RANGE_OFFSET_M = 0.2
_SICK_HZ, _SICK_READINGS = 75, 181
_SICK_STEP_M = 0.01
_CANYON_M = 8.0
"""From the vehicle to the house fronts on both sides."""


@dataclass(frozen=True)
class BenchSurvey:
    """A survey on disk."""

    name: str
    file: Path
    """Its survey file."""
    readings: int
    """Readings recorded; those without a return are counted."""
    recorded_s: float
    """Time that the drive took; of a thinned-out drive, the time in which its sensors record as many readings."""
    length_m: float
    raw_bytes: int


def short_pair(folder: Path, spacing_m: float) -> BenchSurvey:
    """A drive of the pair that compiles and loads what a longer one needs."""
    return pair(folder, max(20.0, 20 * spacing_m), spacing_m)


def pair(folder: Path, length_m: float = 250.0, spacing_m: float = LINE_SPACING_M) -> BenchSurvey:
    """Two laser-triangulation heads over a lane of 4 m: together 28,000 profiles/s of 4,000 readings at 100 km/h.

    Paper: Laurent et al., two 3D profilers that acquire 4,000-point transverse profiles 1 mm apart. Tiles of 10 m,
    cells of 5 mm (about 25 readings each). A larger `spacing_m` thins the profiles out.
    """
    profiles = math.floor(length_m / spacing_m)
    period_s = spacing_m / LINE_SPEED_M_PER_S

    def make(place: Path) -> int:
        Course(LINE_SPEED_M_PER_S, length_m).write_sbet(place / "poses.sbet")
        middle = round((_HEAD_HEIGHT_M - _RANGE_OFFSET_M) / RANGE_STEP_M)
        lane = patch(2 * _HEAD_READINGS - _OVERLAP, profiles, middle)

        def shift(numbers: np.ndarray) -> np.ndarray:
            return np.round(heave_m(numbers * period_s) / RANGE_STEP_M).astype(np.int64)

        readings = 0
        for head, first in (("left", 0), ("right", _HEAD_READINGS - _OVERLAP)):
            seen = slice(first, first + _HEAD_READINGS)
            own = Patch(np.ascontiguousarray(lane.ranges[:, seen]), np.ascontiguousarray(lane.intensity[:, seen]))
            scans = paved(own, profiles, shift, seed=7)  # one seed: in the overlap both see the same road
            file = place / f"{head}.arrow"
            readings += write_scans(file, _head_geometry(), even_epochs(period_s), scans)
        side = (_HEAD_READINGS - _OVERLAP) / 2 * 1e-3
        _survey_files(
            place,
            [_Sensor(n, "profiler", (-2.0, y, IMU_HEIGHT_M - _HEAD_HEIGHT_M)) for n, y in _sides(side)],
            [f'path = "{n}.arrow"\nformat = "scans"\nsensor = "{n}"' for n, _ in _sides(side)],
            tile_m=10.0,
            cell_m=0.005,
        )
        return readings

    recorded_s = profiles * LINE_SPACING_M / LINE_SPEED_M_PER_S
    return _kept(folder / f"pair_{length_m:g}m_{spacing_m * 1e3:g}mm", "pair", recorded_s, length_m, make)


def hdl32e(folder: Path, seconds: float = 60.0) -> BenchSurvey:
    """A Velodyne HDL-32E in a simulated street at 10 m/s, returns within 30 m; tiles of 50 m, cells of 5 cm."""

    def make(place: Path) -> int:
        readings, mount = write_drive(place, seconds)
        stated = f'clock = {{ system = "utc_hour", date = 2026-02-09 }}\noptions = {{ hour = {HOUR_UTC} }}'
        _survey_files(
            place,
            [_Sensor("lidar", "lidar", *mount, limits=(0.9, 30.0))],
            [f'path = "lidar.pcap"\nformat = "velodyne_pcap"\nsensor = "lidar"\n{stated}'],
            tile_m=50.0,
            cell_m=0.05,
            of_poses='options = { accuracy = "poses.smrmsg" }\n',
        )
        return readings

    return _kept(folder / f"hdl32e_street_{seconds:g}s", "hdl32e", seconds, seconds * SPEED_M_PER_S, make)


def sick(folder: Path, seconds: float = 3600.0) -> BenchSurvey:
    """A SICK scanner across the street: 75 scans/s of 181 readings, at 10 mph; tiles of 50 m, cells of 5 cm."""
    speed = 4.4704
    scans = round(seconds * _SICK_HZ)

    def make(place: Path) -> int:
        Course(speed, seconds * speed).write_sbet(place / "poses.sbet")
        street = _street()
        no_shift = lambda numbers: np.zeros(numbers.size, np.int64)  # noqa: E731
        geometry = _geometry("polar", _SICK_READINGS, -math.pi / 2, math.radians(1.0), 0.0, _SICK_STEP_M)
        geometry["reading_period_ns"] = 1e9 / _SICK_HZ / 360  # half a turn of the mirror sees 180 degrees
        batches = paved(street, scans, no_shift, seed=9)
        readings = write_scans(place / "sick.arrow", geometry, even_epochs(1 / _SICK_HZ), batches)
        _survey_files(
            place,
            [_Sensor("sick", "lidar", (-1.0, 0.0, -0.6), limits=(0.5, 30.0))],
            ['path = "sick.arrow"\nformat = "scans"\nsensor = "sick"'],
            tile_m=50.0,
            cell_m=0.05,
        )
        return readings

    return _kept(folder / f"sick_{seconds:g}s", "sick", seconds, seconds * speed, make)


@dataclass(frozen=True)
class _Sensor:
    name: str
    kind: str
    lever_arm_body_m: tuple[float, float, float]
    boresight: str = "{}"
    axes: str = "frd"
    limits: tuple[float, float] | None = None


def _sides(side_m: float) -> list[tuple[str, float]]:
    return [("left", -side_m), ("right", side_m)]


def _head_geometry() -> dict[str, object]:
    first = -(_HEAD_READINGS - 1) / 2 * 1e-3
    return _geometry("cartesian", _HEAD_READINGS, first, 1e-3, _RANGE_OFFSET_M, RANGE_STEP_M)


def _geometry(kind: str, readings: int, first: float, step: float, offset_m: float, unit_m: float) -> dict[str, object]:
    values = {"first": first, "step": step, "range_offset_m": offset_m, "range_step_m": unit_m}
    return {"kind": kind, "readings": readings, **values}


def _street() -> Patch:
    """Scans of a street between house fronts, ranges with a noise of 1 cm."""
    rng = np.random.default_rng(11)
    angle = np.radians(np.arange(_SICK_READINGS) - 90.0)
    above_m = IMU_HEIGHT_M + 0.6
    with np.errstate(divide="ignore"):
        range_m = np.minimum(above_m / np.maximum(np.cos(angle), 1e-9), _CANYON_M / np.abs(np.sin(angle)))
    seen = range_m + rng.normal(0, 0.01, (1024, _SICK_READINGS))
    ranges: UInt16 = np.round(seen / _SICK_STEP_M).astype(np.uint16)
    ranges[rng.random(ranges.shape) < 0.02] = 0
    intensity: UInt8 = rng.integers(20, 200, ranges.shape).astype(np.uint8)
    return Patch(ranges, intensity)


def _survey_files(
    place: Path, sensors: list[_Sensor], logs: list[str], *, tile_m: float, cell_m: float, of_poses: str = ""
) -> None:
    """Write ``SURVEY.toml`` and ``RIG.toml``; of_poses : further lines on the log of poses."""
    rig = []
    for one in sensors:
        rig += [f"[sensors.{one.name}]", f'kind = "{one.kind}"', f'axes = "{one.axes}"']
        rig += [f"lever_arm_body_m = {list(one.lever_arm_body_m)}", f"boresight = {one.boresight}"]
        if one.limits is not None:
            rig += [f"range_min_m = {one.limits[0]}", f"range_max_m = {one.limits[1]}"]
    (place / "RIG.toml").write_text("\n".join(rig) + "\n")
    poses = f'path = "poses.sbet"\nformat = "sbet"\ncrs = "{GEODETIC}"\n' + (
        f'clock = {{ system = "gps_week_seconds", week = {WEEK} }}\n{of_poses}'
    )
    lines = ['id = "bench"', 'rig = "RIG.toml"', "[map]", f'crs = "{CRS}"', 'height = "ellipsoidal"']
    lines += ["[tiles]", f"size_m = {tile_m}", f"cell_m = {cell_m}", "[[runs]]", 'id = "drive"']
    lines += [line for log in (poses, *logs) for line in ("[[runs.logs]]", log)]
    (place / "SURVEY.toml").write_text("\n".join(lines) + "\n")


def _kept(place: Path, name: str, recorded_s: float, length_m: float, make: Callable[[Path], int]) -> BenchSurvey:
    """The survey at `place`, made if it is not there whole."""
    facts = place / "survey.json"
    if not facts.exists():
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir(parents=True)
        readings = make(place)
        raw = sum(f.stat().st_size for f in place.iterdir())
        made = BenchSurvey(name, place / "SURVEY.toml", readings, recorded_s, length_m, raw)
        facts.write_text(json.dumps(asdict(made) | {"file": "SURVEY.toml"}))
    found = json.loads(facts.read_text())
    return BenchSurvey(**(found | {"file": place / found["file"]}))
