"""Calibrates cameras: reads pictures and tables, and writes the rig file."""

from __future__ import annotations

import datetime as dt
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.csv as pa_csv

from roadscan.calibrate.chessboard import (
    Board,
    InteriorOptions,
    InteriorReport,
    interior_from_pictures,
)
from roadscan.calibrate.estimator import Prior
from roadscan.calibrate.evidence import Traverse
from roadscan.calibrate.resection import Exposure, Measured, Resection, Target, project, resect
from roadscan.compute.array_types import Float64
from roadscan.core.errors import ConfigError, FormatError, RunError, nearest
from roadscan.core.extras import cv2
from roadscan.core.frames import body_from_axes, rph_from_rotation
from roadscan.core.rig import Interior, Mounting, Rig, Sensor
from roadscan.core.rig_text import update_rig_file
from roadscan.core.settings.calibration import CalibrationSettings
from roadscan.core.survey import Survey
from roadscan.georeference.plan.plan import trajectory_source
from roadscan.navigation.tasks.navigate import records_with_trajectories
from roadscan.navigation.tasks.recorded_pictures import taken_pictures
from roadscan.navigation.tasks.trajectories import load_trajectory, pose_sigma
from roadscan.store.logs import LogRecord
from roadscan.store.readings.row_groups import read_groups
from roadscan.store.store import Store

Grey = npt.NDArray[np.uint8]

PICTURES: Final = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")
_MEASURED: Final = {"picture": pa.string(), "point": pa.string(), "u_px": pa.float64(), "v_px": pa.float64()}
_LEAST_SIGMA_M: Final = 0.001  # Least σ of a control point that is assumed.
_DIFFERENCE_M: Final = 10.0  # Step of the numerical derivative of the map.
_STEEP_DEG: Final = 80.0
"""For a mounting steeper than this, roll and heading are one angle, so the whole rotation is written."""


@dataclass(frozen=True)
class CheckResidual:
    """A check point measured in a picture and not used in the resection."""

    measured: Measured
    du_px: float
    """Observed − computed."""
    dv_px: float


@dataclass(frozen=True)
class CameraResection:
    """Result of a resection, and the file it was written to."""

    resection: Resection
    checks: tuple[CheckResidual, ...]
    values: dict[str, Any]
    """Keys of the sensor in the rig file, with their values."""
    rig_file: Path | None
    """None where nothing was written."""


def calibrate_interior(
    pictures: Path | Sequence[Path],
    board: Board,
    rig_file: Path,
    sensor: str,
    options: InteriorOptions | None = None,
    *,
    date: dt.date | None = None,
    write: bool = True,
) -> InteriorReport:
    """Estimate the interior orientation from pictures of a chessboard, and write it into the rig file.

    Parameters
    ----------
    pictures : a folder of pictures, or the pictures.
    board : the chessboard.
    rig_file : ``RIG.toml``; its table ``[sensors.NAME.interior]`` is replaced or added, all else stays.
    sensor : the camera's name in it.
    options : limits.
    date : day of the calibration; today where left out.
    write : False leaves the rig file as it is.

    Raises
    ------
    ConfigError
        where the sensor is no camera, the pictures do not suffice, or the rig file cannot be changed safely.
    """
    _camera(Rig.load(rig_file), sensor, rig_file)
    files = _picture_files(pictures)
    report = interior_from_pictures(_read(files), board, options, date or dt.datetime.now(dt.UTC).date())
    if write:
        update_rig_file(rig_file, sensor, {"interior": _interior_values(report.interior)})
    return report


def resect_camera(
    survey: Survey,
    store: Store,
    sensor: str,
    measurements: Path,
    sigma_px: float = 0.5,
    settings: CalibrationSettings | None = None,
    *,
    write: bool = True,
) -> CameraResection:
    """Estimate a camera's mounting from control points in its pictures, and write it into the rig file.

    Parameters
    ----------
    survey, store : with pictures, trajectory and control points ingested.
    sensor : the camera's name in the rig.
    measurements : CSV with the columns picture, point, u_px, v_px; and run, where two runs have pictures of one name.
    sigma_px : 1 σ of a measured coordinate.
    settings : of the estimator: how far the rig file's mounting may be wrong (σ that the rig file states is not used),
        and σ of poses where the trajectory states none.
    write : False leaves the rig file as it is.

    Raises
    ------
    ConfigError
        where rig, measurements or control points do not fit together.
    RunError
        where logs are not ingested.
    """
    settings = settings or CalibrationSettings()
    stated = _camera(survey.rig, sensor, None)
    if stated.interior is None:
        raise ConfigError(
            f"the camera '{sensor}' has no interior orientation in the rig file",
            expected=f"[sensors.{sensor}.interior]",
            change="find it from chessboard pictures first: `roadscan camera interior`",
        )
    if stated.interior.model != "perspective":
        raise ConfigError(
            f"the camera '{sensor}' takes pictures of 360°", expected="a perspective camera",
            change="state its mounting in the rig file as its maker or a survey of the vehicle gives it",
        )  # fmt: skip
    rig_file = _rig_file(survey) if write else None
    records = records_with_trajectories(survey, store)
    pictures = _pictures(store, records, sensor)
    measured, runs = _measurements(measurements, pictures)
    exposures, world = _exposures(survey, store, records, {k: v for k, v in pictures.items() if k in runs}, settings)
    targets, checks = _targets(survey, store, records, world)
    known = {t.name for t in checks}
    held_back = [m for m in measured if m.point in known]
    entering = [m for m in measured if m.point not in known]
    # σ in the rig file may come from these very measurements, which would then count twice.
    unsure = stated.model_copy(update={"lever_arm_sigma_m": None, "boresight_sigma_deg": None})
    prior = Prior.of(unsure, settings)
    found = resect(sensor, stated.interior, prior, exposures, targets, entering, sigma_px, settings)
    values = _mounting_values(stated, found)
    if rig_file is not None:
        update_rig_file(rig_file, sensor, values)
    return CameraResection(
        found, _check_residuals(stated.interior, found.mounting, exposures, checks, held_back), values, rig_file
    )


def _camera(rig: Rig, sensor: str, file: Path | None) -> Sensor:
    if sensor not in rig.sensors:
        raise ConfigError(
            f"the rig has no sensor '{sensor}'{nearest(sensor, rig.sensors)}",
            expected=", ".join(rig.sensors) or "a rig file with sensors",
            file=file,
        )
    found = rig.sensors[sensor]
    if found.kind != "camera":
        raise ConfigError(f"the sensor '{sensor}' is of kind {found.kind}", expected="a camera", file=file)
    return found


def _rig_file(survey: Survey) -> Path:
    if isinstance(survey.config.rig, Rig):
        raise ConfigError(
            "the rig stands in the survey file", expected='a rig file of its own: rig = "RIG.toml"', file=survey.folder
        )
    return survey.resolve(survey.config.rig)


def _picture_files(pictures: Path | Sequence[Path]) -> list[Path]:
    if not isinstance(pictures, Path):
        listed = list(pictures)
    elif pictures.is_dir():
        listed = sorted(p for p in pictures.iterdir() if p.suffix.lower() in PICTURES)
    else:
        listed = [pictures]
    missing = [p for p in listed if not p.is_file()]
    if missing or not listed:
        raise ConfigError(
            "there are no pictures" if not missing else "the picture does not exist",
            expected="pictures of a chessboard: " + ", ".join(PICTURES),
            file=missing[0] if missing else (pictures if isinstance(pictures, Path) else None),
        )
    return listed


def _read(files: Sequence[Path]) -> Iterator[tuple[str, Grey | None]]:
    """Yield names and grey values as recorded, without the rotation that a viewer would apply."""
    for file in files:
        content = np.frombuffer(file.read_bytes(), np.uint8)
        flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
        yield file.name, cv2.imdecode(content, flags) if content.size else None


def _interior_values(interior: Interior) -> dict[str, Any]:
    """Return the values for the rig file, rounded to a hundredth of a camera's attainable accuracy."""
    stated = interior.model_dump(exclude_none=True)
    digits = {"focal_px": 4, "principal_px": 4, "distortion": 8, "rms_px": 4}
    for key, value in stated.items():
        places = digits.get(key.removeprefix("sigma_"))
        if places is not None:
            stated[key] = [round(v, places) for v in value] if isinstance(value, tuple) else round(value, places)
    return stated


@dataclass(frozen=True)
class _Taken:
    """A picture of the table ``images``."""

    run: str
    file: str
    epoch_gps_ns: int


def _pictures(store: Store, records: Sequence[LogRecord], sensor: str) -> dict[str, _Taken]:
    """Return a camera's pictures by the name that measurements use, with corrected epochs."""
    taken = [
        _Taken(log.record.run, name, int(epoch))
        for log in taken_pictures(store, records, sensor)
        for name, epoch in zip(log.files, log.epochs_gps_ns, strict=True)
    ]
    if not taken:
        raise RunError(
            f"the camera '{sensor}' has no pictures in the store",
            expected="a log of pictures (images) with that sensor",
        )
    count = Counter(one.file for one in taken)
    return {one.file if count[one.file] == 1 else f"{one.run}/{one.file}": one for one in taken}


def _measurements(file: Path, pictures: dict[str, _Taken]) -> tuple[list[Measured], set[str]]:
    """Read measurements from a CSV file, and the pictures that they are in."""
    try:
        convert = pa_csv.ConvertOptions(column_types=_MEASURED | {"run": pa.string()}, strings_can_be_null=False)
        rows = pa_csv.read_csv(file, convert_options=convert)
    except (OSError, pa.ArrowInvalid) as error:
        raise FormatError(f"the measurements cannot be read ({error})", expected=_columns(), file=file) from error
    missing = [name for name in _MEASURED if name not in rows.column_names]
    if missing:
        raise FormatError(f"there is no column {missing[0]}", expected=_columns(), file=file)
    found = []
    for record, row in enumerate(rows.to_pylist(), 1):
        if row["u_px"] is None or row["v_px"] is None or not np.isfinite([row["u_px"], row["v_px"]]).all():
            raise FormatError("a coordinate is missing", expected=_columns(), file=file, record=record)
        picture = f"{row['run']}/{row['picture']}" if row.get("run") else row["picture"]
        picture = row["picture"] if picture not in pictures else picture
        if picture not in pictures:
            several = [k for k in pictures if k.endswith(f"/{picture}")]
            raise FormatError(
                f"'{picture}' is the name of {len(several)} pictures"
                if several
                else f"the camera has no picture '{picture}'{nearest(picture, pictures)}",
                change="add a column run" if several else "name pictures as the table images does",
                file=file,
                record=record,
            )
        found.append(Measured(picture, row["point"], row["u_px"], row["v_px"]))
    return found, {m.picture for m in found}


def _columns() -> str:
    return "a CSV file with the columns " + ", ".join(_MEASURED) + " (and run, where names of pictures repeat)"


def _exposures(
    survey: Survey,
    store: Store,
    records: Sequence[LogRecord],
    pictures: dict[str, _Taken],
    settings: CalibrationSettings,
) -> tuple[list[Exposure], str]:
    """Return pictures with the body's poses and their σ, and the world frame of the poses."""
    found: list[Exposure] = []
    worlds: set[str] = set()
    for run in sorted({one.run for one in pictures.values()}):
        of_run = {name: one for name, one in pictures.items() if one.run == run}
        epochs = np.array([one.epoch_gps_ns for one in of_run.values()], np.int64)
        source = trajectory_source(run, records)
        worlds.add(source.world)
        spans = [(int(epochs.min()), int(epochs.max()))]
        poses = load_trajectory(store, source, spans, survey.config.navigation.max_gap_s).poses(epochs, strict=True)
        sigma = pose_sigma(store, records, source, epochs, settings)
        level = [_world_from_ned(survey, source.world, place) for place in poses.position_world_m]
        for k, name in enumerate(of_run):
            error = Traverse(
                run,
                int(epochs[k]),
                (float(sigma[k, 0]), float(sigma[k, 1]), float(sigma[k, 2])),
                (float(sigma[k, 3]), float(sigma[k, 4]), float(sigma[k, 5])),
                level[k],
                settings.traverse_time_constant_s,
            )
            found.append(Exposure(name, poses.position_world_m[k], poses.world_from_body[k], error))
    if len(worlds) > 1:
        raise ConfigError(
            f"the runs' trajectories are in different world frames: {', '.join(sorted(worlds))}",
            expected="measurements of runs in one frame",
            change="resect the runs one by one",
        )
    return found, worlds.pop()


def _world_from_ned(survey: Survey, world: str, place_m: Float64) -> Float64:
    """Return the axes (3, 3) of the map at a place of the world: north, east, down."""
    frame = survey.frame()
    middle = frame.map_from_world(world, place_m[None])
    steps = _DIFFERENCE_M * np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    ways = frame.world_from_map(world, middle + steps) - frame.world_from_map(world, middle - steps)
    # The nearest rotation, since the map's scale differs from the world's.
    u, _, vt = np.linalg.svd(ways.T)
    return np.asarray(u @ vt)


def _targets(
    survey: Survey, store: Store, records: Sequence[LogRecord], world: str
) -> tuple[list[Target], list[Target]]:
    """Return control points and check points in the world frame of the poses."""
    files = [f for r in records for f in r.tables.get("control_points", ())]
    if not files:
        raise ConfigError("the survey has no control points", expected="[[control]] in the survey file")
    rows = pa.concat_tables([read_groups(store, f.path, range(len(f.group_rows))) for f in files]).to_pylist()
    names = [name for name, n in Counter(row["name"] for row in rows).items() if n > 1]
    if names:
        raise ConfigError(f"two control points are called '{names[0]}'", expected="a name of its own for each")
    enh = np.array([[row["easting_m"], row["northing_m"], row["height_m"]] for row in rows])
    places = survey.frame().world_from_map(world, enh)
    targets: dict[str, list[Target]] = {"gcp": [], "check": []}
    for row, place in zip(rows, places, strict=True):
        horizontal = max(row["sigma_horizontal_m"] or 0.0, _LEAST_SIGMA_M)
        vertical = max(row["sigma_height_m"] or 0.0, _LEAST_SIGMA_M)
        axes = _world_from_ned(survey, world, place)
        covariance = axes @ np.diag([horizontal**2, horizontal**2, vertical**2]) @ axes.T
        targets[row["role"]].append(Target(row["name"], place, covariance))
    return targets["gcp"], targets["check"]


def _mounting_values(stated: Sensor, found: Resection) -> dict[str, Any]:
    """Return lever arm and boresight, or the whole rotation where the rig file states it so, with their σ."""
    rotation, lever = found.mounting.arrays()
    sigma = found.found.sigma
    values: dict[str, Any] = {"lever_arm_body_m": [round(v, 6) for v in lever.tolist()]}
    roll, pitch, heading = rph_from_rotation(rotation @ body_from_axes(stated.axes).T)
    angles = np.degrees([float(roll), float(pitch), float(heading)])
    if stated.body_from_sensor is not None or abs(angles[1]) > _STEEP_DEG:
        values["body_from_sensor"] = [[round(v, 12) for v in row] for row in rotation.tolist()]
    else:
        around = (angles + 180.0) % 360.0 - 180.0
        names = ("roll_deg", "pitch_deg", "heading_deg")
        values["boresight"] = dict(zip(names, (round(v, 8) for v in around.tolist()), strict=True))
    values["lever_arm_sigma_m"] = [round(v, 6) for v in sigma[:3].tolist()]
    values["boresight_sigma_deg"] = [round(v, 6) for v in np.degrees(sigma[3:]).tolist()]
    return values


def _check_residuals(
    interior: Interior,
    mounting: Mounting,
    exposures: Sequence[Exposure],
    checks: Sequence[Target],
    measured: Sequence[Measured],
) -> tuple[CheckResidual, ...]:
    """Return observed − computed of check points, with the poses as stated."""
    pictures, points = {e.name: e for e in exposures}, {t.name: t for t in checks}
    rotation, lever = mounting.arrays()
    found = []
    for m in measured:
        exposure = pictures[m.picture]
        body = exposure.world_from_body.T @ (points[m.point].point_world_m - exposure.position_world_m)
        (pixel,) = project(interior, ((body - lever) @ rotation)[None])
        found.append(CheckResidual(m, float(m.u_px - pixel[0]), float(m.v_px - pixel[1])))
    return tuple(found)
