"""Writes trajectories in arrays as `trajectory_table`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
import pyarrow as pa

from roadscan.compute.array_types import Float64
from roadscan.core.crs import (
    LOCAL_WORLD,
    HeightKind,
    crs_from_text,
    geodetic_from_world,
    geographic_of,
    world_frame_of,
)
from roadscan.core.errors import ConfigError
from roadscan.core.frames import (
    ENU_FROM_NED,
    body_from_axes,
    ecef_from_ned,
    rotation_from_quaternion,
    rph_from_rotation,
)
from roadscan.formats.trajectories.trajectory_table import (
    ANGLE_SIGMAS,
    ATTITUDE,
    BATCH_ROWS,
    FRAME_KEY,
    SIGMAS,
    position_of,
)
from roadscan.ingest.array_files import ClockLike, WrittenLog, epochs_gps_ns, float_array, parquet_file
from roadscan.ingest.reading.columns import ColumnOption, Found, Quantity, find_columns
from roadscan.ingest.reading.poses import ANGLE_MAX_RAD, North
from roadscan.ingest.reading.stamps import EPOCH, TIME

ECEF: Final = tuple(Quantity(a, "length", (f"ecef_{a}", f"{a}_ecef")) for a in "xyz")
QUATERNION: Final = tuple(Quantity(f"q{a}", "count") for a in "wxyz")

_LENGTH_TOLERANCE: Final = 1e-3  # largest deviation of a quaternion's length from 1

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Quaternions:
    """Meaning of the columns qw, qx, qy, qz: they rotate vectors of the vehicle's axes into those of a frame."""

    frame: Literal["level", "world"]
    """level: north, east, down at the position (north as `heading` says); world: the axes of the CRS itself, for
    geocentric and local positions."""
    axes: str
    """Where x, y, z of the vehicle's axes point: "frd" (forward, right, down), flu, rfu or bru."""


def write_trajectory(
    table: Mapping[str, Any] | pd.DataFrame,
    path: str | Path,
    crs: str,
    *,
    height: HeightKind = "ellipsoidal",
    heading: North | None = None,
    clock: ClockLike = None,
    columns: Mapping[str, Any] | None = None,
    quaternions: Quaternions | None = None,
) -> WrittenLog:
    """Write poses as a Parquet log that `roadscan` reads as `trajectory_table`; return what was written.

    Parameters
    ----------
    table : arrays (n,) by column name: a DataFrame, or a mapping. Columns carry their units in their names, as
        ``longitude_deg``, ``easting_m``, ``roll_rad``. Needed are

        - time: ``epoch_gps_ns`` (int64), or ``time`` (``time_s``, ``time_ns`` …) with a `clock`, or calendar times;
        - position: longitude, latitude, height; easting, northing, height; or x, y, z for a geocentric CRS
          (a local frame has easting, northing, height, also called x, y, z);
        - attitude: roll (positive right side down), pitch (positive nose up), heading (clockwise from north); or
          qw, qx, qy, qz with `quaternions`.

        1 σ is taken where it is there: sigma_north, sigma_east, sigma_down, sigma_roll, sigma_pitch, sigma_heading.
    crs : of the positions: geographic, projected, geocentric, or "local".
    height : kind of the heights; of orthometric ones the survey file names the geoid.
    heading : north that headings count from, "true" or "grid"; needed for a projected CRS.
    clock : time system of the stamps, keys as in the survey file; None for GPS nanoseconds.
    columns : columns whose name does not say what they hold, such as {"latitude": {"name": "Lat", "unit": "deg"}}.
    quaternions : what qw, qx, qy, qz turn; then roll, pitch and heading are not looked at.

    Raises
    ------
    ConfigError, FormatError, CrsError, TimeSystemError
        if a column is missing or says no unit, if a value is missing, or if nothing states what the numbers are.
    """
    target = Path(path)
    names = tuple(str(name) for name in table.keys())  # noqa: SIM118 — a DataFrame's iteration differs by version
    stated = {key: ColumnOption.parse(dict(option)) for key, option in (columns or {}).items()}
    position = ECEF if _is_geocentric(crs) else position_of(crs)
    attitude = ATTITUDE if quaternions is None else QUATERNION
    time = () if EPOCH in names else (TIME,)
    wanted = (*time, *position, *attitude, *SIGMAS, *ANGLE_SIGMAS)
    found = find_columns(wanted, names, stated, target, dict.fromkeys(("time",), 1.0))
    column = found[TIME.name].column if time else EPOCH
    epochs = epochs_gps_ns(table[column], clock if time else None, f"column '{column}'")
    values = {q.name: _numbers(table, found[q.name], epochs.size) for q in wanted if q.name in found and q is not TIME}
    for q in (*position, *attitude):
        _need_all(values[q.name], found[q.name].column)
    own_crs = _geographic_text(crs) if position is ECEF else crs
    placed = _geodetic(values, crs) if position is ECEF else {q.name: values[q.name] for q in position}
    turned = (
        {q.name: values[q.name] for q in ATTITUDE} if quaternions is None else _rph(values, quaternions, crs, placed)
    )
    _check_heading(own_crs, heading)
    sigmas = {q.name: values[q.name] for q in (*SIGMAS, *ANGLE_SIGMAS) if q.name in values}
    frame = {"crs": own_crs, "height": height} | ({} if heading is None else {"heading": heading})
    _write(target, epochs, {**placed, **turned, **sigmas}, frame)
    return WrittenLog(target, epochs.size, int(epochs.min()), int(epochs.max()))


def _is_geocentric(crs: str) -> bool:
    return crs != LOCAL_WORLD and crs_from_text(crs).is_geocentric


def _geographic_text(crs: str) -> str:
    """Return the geographic CRS of a geocentric one, which `trajectory_table` can state."""
    geographic = geographic_of(world_frame_of(crs))
    authority = geographic.to_authority(min_confidence=90)
    return ":".join(authority) if authority else str(geographic.to_wkt())


def _numbers(table: Mapping[str, Any] | pd.DataFrame, found: Found, rows: int) -> Float64:
    return float_array(table[found.column], (rows,), f"column '{found.column}'") * found.scale


def _need_all(values: Float64, column: str) -> None:
    missing = ~np.isfinite(values)
    if missing.any():
        raise ConfigError(
            f"column '{column}' holds no number in row {int(np.argmax(missing))} ({int(missing.sum()):,} in all)",
            expected="a whole pose a row",
            change="leave rows without a pose out",
        )


def _geodetic(values: Mapping[str, Float64], crs: str) -> dict[str, Float64]:
    """Return longitude, latitude (rad) and height (m) of geocentric positions."""
    degrees = geodetic_from_world(world_frame_of(crs), np.stack([values[q.name] for q in ECEF], axis=-1))
    longitude, latitude = np.radians(degrees[:, :2].T)
    return {"longitude": longitude, "latitude": latitude, "height": degrees[:, 2]}


def _rph(
    values: Mapping[str, Float64], about: Quaternions, crs: str, placed: Mapping[str, Float64]
) -> dict[str, Float64]:
    """Return roll, pitch and heading (rad) of quaternions."""
    quaternion = np.stack([values[q.name] for q in QUATERNION], axis=-1)
    wrong = np.abs(np.linalg.norm(quaternion, axis=-1) - 1) > _LENGTH_TOLERANCE
    if wrong.any():
        raise ConfigError(
            f"the quaternion of row {int(np.argmax(wrong))} is not of length 1 (by over {_LENGTH_TOLERANCE:g})",
            expected="unit quaternions, qw the scalar part",
        )
    turned = rotation_from_quaternion(quaternion) @ body_from_axes(about.axes).T
    if about.frame == "world":
        turned = _level_from_world(crs, placed) @ turned
    roll, pitch, heading = rph_from_rotation(turned)
    return {"roll": roll, "pitch": pitch, "heading": heading}


def _level_from_world(crs: str, placed: Mapping[str, Float64]) -> Float64:
    """Return (n, 3, 3) or (3, 3) north-east-down from the axes of the CRS."""
    if crs == LOCAL_WORLD:
        return ENU_FROM_NED.T
    if "longitude" not in placed or not _is_geocentric(crs):
        raise ConfigError(
            f"quaternions turn into the axes of the CRS, and '{crs}' has no three straight ones",
            expected='a geocentric CRS or "local", or quaternions of frame "level"',
        )
    return np.swapaxes(ecef_from_ned(placed["latitude"], placed["longitude"]), -1, -2)


def _check_heading(crs: str, heading: North | None) -> None:
    projected = crs != LOCAL_WORLD and crs_from_text(crs).is_projected
    if projected and heading is None:
        raise ConfigError(
            f"the north that headings count from is not stated, and '{crs}' is projected",
            expected='heading="true" or heading="grid"',
            change="they differ by the meridian convergence, up to some degrees",
        )
    wrong = {"local": "true"}.get(crs, "" if projected else "grid")
    if heading is not None and heading == wrong:
        raise ConfigError(f'heading="{heading}" with crs "{crs[:80]}", which has no such north', expected="the other")


def _write(target: Path, epochs: Any, values: Mapping[str, Float64], frame: Mapping[str, str]) -> None:
    angles = {"longitude", "latitude", *(q.name for q in (*ATTITUDE, *ANGLE_SIGMAS))}
    columns: dict[str, Any] = {EPOCH: epochs}
    for name, numbers in values.items():
        if name in {q.name for q in ATTITUDE} and (np.abs(numbers) > ANGLE_MAX_RAD).any():
            raise ConfigError(f"{name} goes beyond two turns", expected="radians or degrees, as the column's name says")
        columns[f"{name}_rad" if name in angles else f"{name}_m"] = numbers
    table = pa.table(columns)
    table = table.replace_schema_metadata({FRAME_KEY: json.dumps(dict(frame), sort_keys=True)})
    with parquet_file(target, table.schema) as writer:
        writer.write_table(table, row_group_size=BATCH_ROWS)
