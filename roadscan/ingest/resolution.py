"""Measures the resolution of a log's values from its rows: 32-bit columns, too few decimals.

A column is rounded where all its values lie on a grid, and neighbours jump about on it: an even motion that happens to
lie on the grid does not.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyproj

from roadscan.compute.array_types import Float64
from roadscan.core.crs import LOCAL_WORLD, crs_from_text, geodetic_from_world, geographic_of
from roadscan.core.frames import ENU_FROM_NED, ecef_from_ned, rotation_from_quaternion, rph_from_rotation
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.witness import Finding, Witness
from roadscan.ingest.reading.format import LogHeader, LogSource
from roadscan.store.writer import LogWriter

COARSE_VALUES: Final = Witness(
    "coarse_values",
    input="trajectory, gnss, cloud",
    fault="Values are coarser than what is made of them: degrees of 32 bits, few decimals, rounded stamps.",
    asks="the values of neighbouring rows: the grid on which all of them lie, and whether they jump about on it",
    does="the log is used, and the coarse columns are named with their step",
    told=("findings",),
)

POSITION_M: Final = 0.02
"""Coarser steps of positions (m) are reported: a fifth of the usual cell of 0.1 m."""
_ANGLE_DEG: Final = 0.05
"""Coarser steps of angles (degrees) are reported: 1 cm at 10 m."""
_WAY_M: Final = 0.05
"""Stamps are reported if the vehicle drives farther than this (m) in one step; errors are a third of a step."""

_ROWS: Final = 20_000
"""Rows that are examined, from the start of the log."""
_LEAST_ROWS: Final = 20  # least rows and values for a verdict
_JUMPING: Final = 0.3
"""Second differences of rounded values exceed this share of the step …"""
_SHARE: Final = 0.1
"""… in more than this share of the rows."""
_METRES_PER_DEG: Final = 111_320.0  # length of a degree of latitude
_TABLES: Final = ("trajectory", "gnss", "cloud")


class _Column(NamedTuple):
    """Values in the unit that the log may have stored."""

    name: str
    values: Float64
    unit: str
    to_tolerance: float
    """Size of the column's unit in that of the tolerance (m, °)."""
    most: float
    """Largest acceptable step, in the unit of the tolerance."""


def resolution_findings(writer: LogWriter, header: LogHeader, source: LogSource) -> list[Finding]:
    """Return one finding on the coarse values of a finished log, or none."""
    words = [
        words
        for table in _TABLES
        if writer.rows[table] >= _LEAST_ROWS
        for words in _coarse(table, _first_rows(writer, table), header, source)
    ]
    if not words:
        return []
    text = (
        "; ".join(words) + ": what is measured with it is no better; export the log with more decimals, or in 64 bits"
    )
    return [COARSE_VALUES.finds("", text)]


def _coarse(table: str, rows: pa.Table, header: LogHeader, source: LogSource) -> Iterator[str]:
    """Yield a description of each coarse column of a table."""
    world = str(header.attributes.get("world_frame", LOCAL_WORLD))
    columns = list(_cloud_columns(rows) if table == "cloud" else _place_columns(rows, world, source))
    yield from _coarse_columns(columns, _sigma_m(rows) if table == "gnss" else 0.0)
    if table == "trajectory":
        yield from _coarse_columns(list(_angle_columns(rows, world)), 0.0)
    if table != "cloud":
        yield from _coarse_stamps(rows)


def _coarse_columns(columns: Sequence[_Column], sigma: float) -> Iterator[str]:
    """Yield descriptions of columns coarser than tolerance and σ; none if no column jumps on its grid."""
    found = [(column, *_grid_of(column)) for column in columns]
    if not any(jumps and step * column.to_tolerance > max(column.most, sigma) for column, step, jumps in found):
        return
    for column, step, _ in found:
        reach = step * column.to_tolerance
        if reach > max(column.most, sigma):
            metres = f" ({reach:.2g} m)" if column.unit == "°" and column.most == POSITION_M else ""
            yield f"{column.name} is held in steps of {step:.2g} {column.unit}{metres}"


def _grid_of(column: _Column) -> tuple[float, bool]:
    """Return the grid of a column in its unit; degrees may have been stored as radians."""
    step, jumps = grid_of(column.values)
    if step == 0.0 and column.unit == "°":
        step, jumps = grid_of(np.radians(column.values))
        step = float(np.degrees(step))
    return step, jumps


def _coarse_stamps(rows: pa.Table) -> Iterator[str]:
    """Yield descriptions of stamps that are rounded to more than the vehicle's motion allows."""
    epochs = rows.column("epoch_gps_ns").to_numpy()
    step_s, jumps = grid_of((epochs - epochs[0]).astype(np.float64) / NS_PER_S)
    xyz = _values(rows, "x_world_m", "y_world_m", "z_world_m")
    elapsed, way = np.diff(epochs) / NS_PER_S, np.linalg.norm(np.diff(xyz, axis=0), axis=1)
    moving = (elapsed > 0) & np.isfinite(way)
    if not moving.any():
        return
    speed = float(np.median(way[moving] / elapsed[moving]))
    if jumps and step_s * speed > _WAY_M:
        yield f"the stamps are held in steps of {step_s * 1000:.3g} ms ({step_s * speed:.2g} m of the way)"


def grid_of(values: Float64) -> tuple[float, bool]:
    """Return the step of the grid of values (n,) in order of time (0 for none), and whether they jump on it.

    Looked for are tens and parts of ten, these of a minute of 60 to the unit, halves of halves, and 32-bit numbers.
    """
    known = values[np.isfinite(values)]
    if known.size < _LEAST_ROWS or np.ptp(known) == 0:
        return 0.0, False
    bent = np.abs(known[2:] - 2 * known[1:-1] + known[:-2])
    for step in _steps(known):
        on_grid = np.abs(known / step - np.rint(known / step)) < 1e-6 + 4 * np.spacing(np.abs(known / step).max())
        if on_grid.all():
            return step, float((bent > _JUMPING * step).mean()) > _SHARE
    narrow = known.astype(np.float32).astype(np.float64)
    step = float(np.median(np.spacing(np.abs(known).astype(np.float32))))
    if (np.abs(known - narrow) <= 1e-4 * step).all():
        return step, float((bent > _JUMPING * step).mean()) > _SHARE
    return 0.0, False


def _steps(values: Float64) -> list[float]:
    """Return the candidate steps, the largest first, down to a millionth of the range."""
    least = max(float(np.ptp(values)) * 1e-6, 1e-9)
    tens = [10.0**k for k in range(1, -10, -1)]
    every = tens + [one / 60.0 for one in tens] + [2.0**-k for k in range(1, 12)]
    return sorted((one for one in every if one >= least), reverse=True)


def _first_rows(writer: LogWriter, table: str) -> pa.Table:
    return next(iter(writer.tables(table))).slice(0, _ROWS)


def _values(rows: pa.Table, *names: str) -> Float64:
    return np.stack([rows.column(n).to_numpy(zero_copy_only=False) for n in names], axis=-1).astype(np.float64)


def _cloud_columns(rows: pa.Table) -> Iterator[_Column]:
    for name, values in zip("xyz", _values(rows, "x_m", "y_m", "z_m").T, strict=True):
        yield _Column(name, values, "m", 1.0, POSITION_M)


def _place_columns(rows: pa.Table, world: str, source: LogSource) -> Iterator[_Column]:
    """Yield the positions in the log's stated CRS."""
    xyz = _values(rows, "x_world_m", "y_world_m", "z_world_m")
    xyz = xyz[np.isfinite(xyz).all(axis=1)]
    stated = source.defaults.crs if source.crs is None else source.crs
    crs = None if stated in (None, LOCAL_WORLD) or world == LOCAL_WORLD else crs_from_text(str(stated))
    if not len(xyz) or crs is None or crs.is_geocentric:
        names, values, units, sizes = ("x", "y", "z"), xyz, "mmm", (1.0, 1.0, 1.0)
    else:
        geodetic = geodetic_from_world(world, xyz)
        if crs.is_projected:
            unit_m = float(crs.axis_info[0].unit_conversion_factor)
            to_grid = pyproj.Transformer.from_crs(geographic_of(world), crs.to_2d(), always_xy=True)
            grid = np.stack(to_grid.transform(geodetic[:, 0], geodetic[:, 1]), axis=-1)
            values = np.column_stack([grid, geodetic[:, 2]])
            names, units, sizes = ("easting", "northing", "height"), "mmm", (unit_m, unit_m, 1.0)
        else:
            across = _METRES_PER_DEG * float(np.cos(np.radians(geodetic[0, 1])))
            names, values, units = ("longitude", "latitude", "height"), geodetic, "°°m"
            sizes = (across, _METRES_PER_DEG, 1.0)
    for name, column, unit, size in zip(names, values.T, units, sizes, strict=True):
        yield _Column(f"the {name}", column, unit, size, POSITION_M)


def _angle_columns(rows: pa.Table, world: str) -> Iterator[_Column]:
    """Yield roll, pitch and heading relative to the local level."""
    quaternion = _values(rows, "qw", "qx", "qy", "qz")
    xyz = _values(rows, "x_world_m", "y_world_m", "z_world_m")
    if world == LOCAL_WORLD:
        level = np.broadcast_to(ENU_FROM_NED.T, (len(xyz), 3, 3))
    else:
        degrees = np.radians(geodetic_from_world(world, xyz)[:, :2])
        level = ecef_from_ned(degrees[:, 1], degrees[:, 0]).transpose(0, 2, 1)
    angles = np.degrees(np.stack(rph_from_rotation(level @ rotation_from_quaternion(quaternion)), axis=-1))
    for name, values in zip(("roll", "pitch", "heading"), angles.T, strict=True):
        yield _Column(f"the {name}", values, "°", 1.0, _ANGLE_DEG)


def _sigma_m(rows: pa.Table) -> float:
    """Return the usual stated σ of positions (m); 0 where none is stated."""
    if "sigma_north_m" not in rows.column_names:
        return 0.0
    sigma = _values(rows, "sigma_north_m")[:, 0]
    return float(np.median(sigma[np.isfinite(sigma)])) if np.isfinite(sigma).any() else 0.0
