"""Readings of an inertial measurement unit as text with named columns and units."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Final

import numpy as np
import pyarrow as pa
from pydantic import Field

from roadscan.compute.array_types import Float64
from roadscan.core.errors import ConfigError, Missing, nearest
from roadscan.ingest.reading.columns import (
    UNITS,
    ColumnOption,
    Dimension,
    Found,
    Quantity,
    check_keys,
    find_columns,
    fits,
    unit_in_name,
)
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject, Rows
from roadscan.ingest.reading.records import EpochReader, Sieve, options_of
from roadscan.ingest.reading.stamps import TIME, StampColumn
from roadscan.ingest.reading.text_table import (
    Kind,
    TextBlock,
    TextLayout,
    TextOptions,
    sniff_layout,
    text_blocks,
    text_layout,
)

_AXES: Final = ("x", "y", "z")


def _on_axes(stem: str, dimension: Dimension, *also: str) -> tuple[Quantity, ...]:
    """Return a quantity on the three axes, with the usual names of its columns."""
    return tuple(Quantity(f"{stem}_{a}", dimension, tuple(f"{name}{a}" for name in also)) for a in _AXES)


RATES: Final = _on_axes(
    "angular_rate", "rate", "gyro_", "gyr_", "g", "omega_", "w", "w_", "w_rs_s_", "angular_velocity_"
)
ANGLES: Final = _on_axes("delta_angle", "angle", "delta_theta_", "dtheta_", "dangle_")
FORCES: Final = _on_axes(
    "specific_force",
    "acceleration",
    "acceleration_",
    "accel_",
    "acc_",
    "a",
    "a_",
    "f",
    "f_",
    "a_rs_s_",
    "linear_acceleration_",
)
VELOCITIES: Final = _on_axes("delta_velocity", "speed", "delta_v_", "dvel_", "dv_")
TEMPERATURE: Final = Quantity("temperature", "temperature", ("temp",), optional=True)

RATE_MAX_RAD_PER_S: Final = 200.0  # larger rates count as damage
FORCE_MAX_M_PER_S2: Final = 5_000.0  # larger forces count as damage
TEMPERATURE_MIN_DEG_C: Final = -100.0  # lower temperatures count as damage
TEMPERATURE_MAX_DEG_C: Final = 200.0  # higher temperatures count as damage
_NOT_IMU: Final = ("latitude", "longitude", "easting", "northing", "roll", "heading", "qw", "r11")
"""Stems of columns that identify a table of poses, whatever else it contains."""


class ImuCsvOptions(TextOptions):
    """Settings of `imu_csv`."""

    columns: dict[str, ColumnOption] = {}
    """Which column holds which quantity, where its name does not say so: time; angular_rate_x, _y, _z or
    delta_angle_x, _y, _z; specific_force_x, _y, _z or delta_velocity_x, _y, _z; temperature.
    For example { angular_rate_x = { name = "Gyr1", unit = "deg_per_s" } }."""
    rate_unit: str | None = None
    """Unit of the three columns of angular rate whose names carry none: rad_per_s, deg_per_s or deg_per_h;
    of angle increments: rad, deg, arcmin or arcsec."""
    force_unit: str | None = None
    """Unit of the three columns of specific force whose names carry none: m_per_s2, g or mg (g is
    9.80665 m/s²); of velocity increments: m_per_s, km_per_h or mph."""
    interval_s: float | None = Field(default=None, gt=0.0, allow_inf_nan=False)
    """Interval over which the sensor sums up one increment (s), as its maker states it. Needed for
    increments, which are divided by it."""
    reads_gravity: bool = False
    """True where the maker writes gravity instead of specific force, so that at rest an axis that points
    *down* reads +g; the sign is then turned."""


@dataclass(frozen=True)
class _Plan:
    """How a file is read."""

    layout: TextLayout
    columns: dict[str, Found]
    rates: tuple[Quantity, ...]
    forces: tuple[Quantity, ...]
    rate_scale: float
    """Factor of a rate in radians (per second): 1, or 1 / interval."""
    force_scale: float
    stamps: StampColumn
    kinds: dict[str, Kind]


class ImuCsv(LogFormat):
    """A line a sample: time, angular rate and specific force on the sensor's three axes, in named columns.

    Columns whose names carry the unit are found by themselves (``angular_rate_x_rad_per_s``,
    ``gyro_x_deg_s``, ``acc_x_g``, ``accel_x_m_per_s2``, ``delta_angle_x_rad``, ``delta_velocity_x_m_per_s``);
    a name without a unit (``gyro_x``, ``wx``, ``acc_x``) needs `rate_unit` or `force_unit`, any other name
    `columns`. Readings stay in the sensor's axes, which the rig file places on the vehicle. Specific
    force is what an accelerometer feels: +g upwards at rest. Increments (delta angle, delta velocity)
    become rates through `interval_s`.
    """

    name = "imu_csv"
    title = "IMU readings as CSV: time, angular rate and specific force (or increments) in named columns with units"
    yields = ("imu",)
    column_sets: ClassVar[tuple[tuple[Quantity, ...], ...]] = ((TIME, *RATES, *FORCES), (TIME, *ANGLES, *VELOCITIES))
    axes_on_sensor: ClassVar[str] = "they are the axes printed on the case"
    time = (
        "numbers: state clock.system and clock.unit; ISO 8601 text with a zone (…Z) is UTC, "
        "without one state unix_utc, unix_gps or unix_tai, the scale it is written in"
    )
    options = ImuCsvOptions

    def sniff(self, path: Path) -> bool:
        """True if there are a time and three axes of rate and force, and no pose."""
        layout = sniff_layout(path)
        if layout is None or any(name.lower().startswith(_NOT_IMU) for name in layout.names):
            return False
        plain = [q.name for q in (*RATES, *FORCES, *ANGLES, *VELOCITIES)]
        has_time = fits((TIME,), layout.names, (TIME.name,))
        return has_time and all(
            any(fits(group, layout.names, plain) for group in groups)
            for groups in ((RATES, ANGLES), (FORCES, VELOCITIES))
        )

    def header(self, source: LogSource) -> LogHeader:
        """Find the columns and check sensor, clock and units."""
        source.need_sensor("imu")
        plan = _plan(source)
        columns = {q: {"name": found.column, "unit": found.unit} for q, found in plan.columns.items()}
        return LogHeader({"columns": columns})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream samples; a line that is none is rejected."""
        plan = _plan(source)
        epochs = EpochReader(plan.stamps.clock, source.path)
        for block in text_blocks(source.path, plan.layout, plan.kinds):
            if isinstance(block, Reject):
                yield block
                continue
            yield from _items(block, plan, epochs)


def _items(block: TextBlock, plan: _Plan, reader: EpochReader) -> Iterator[Item]:
    """Yield rows of the sound samples of a block, then its rejects."""
    sieve = Sieve(block.records.size)
    epochs = reader.epochs(plan.stamps.stamps(block, sieve), sieve, block.records)
    columns: dict[str, Float64] = {}
    for axis, rate, force in zip(_AXES, plan.rates, plan.forces, strict=True):
        columns[f"angular_rate_{axis}_rad_per_s"] = _values(block, plan.columns[rate.name], plan.rate_scale)
        columns[f"specific_force_{axis}_m_per_s2"] = _values(block, plan.columns[force.name], plan.force_scale)
    for name, values in columns.items():
        if name.startswith("angular"):
            sieve.require(name.removesuffix("_rad_per_s"), values, -RATE_MAX_RAD_PER_S, RATE_MAX_RAD_PER_S, "rad/s")
        else:
            sieve.require(name.removesuffix("_m_per_s2"), values, -FORCE_MAX_M_PER_S2, FORCE_MAX_M_PER_S2, "m/s²")
    if TEMPERATURE.name in plan.columns:
        temperature = _values(block, plan.columns[TEMPERATURE.name], 1.0)
        inside = (temperature >= TEMPERATURE_MIN_DEG_C) & (temperature <= TEMPERATURE_MAX_DEG_C)
        sieve.drop(~(np.isnan(temperature) | inside), "temperature is outside -100 to 200 °C")
        columns["temperature_deg_c"] = temperature
    if sieve.good.any():
        good = sieve.kept
        arrays = {name: pa.array(values[good], from_pandas=True) for name, values in columns.items()}
        batch = pa.record_batch({"epoch_gps_ns": pa.array(epochs[good]), **arrays})
        yield Rows("imu", batch, "", int(block.records[good][0]), int(block.offsets[good][0]))
    yield from sieve.rejects(block.records, block.offsets)


def _values(block: TextBlock, found: Found, scale: float) -> Float64:
    with np.errstate(over="ignore"):
        return block.number(found.column) * (found.scale * scale)


def _plan(source: LogSource) -> _Plan:
    options = options_of(source, ImuCsvOptions)
    layout = text_layout(source.path, options)
    known = (TIME, *RATES, *ANGLES, *FORCES, *VELOCITIES, TEMPERATURE)
    check_keys(options.columns, [q.name for q in known], source.path)
    rates = _held(RATES, ANGLES, layout.names, options.columns)
    forces = _held(FORCES, VELOCITIES, layout.names, options.columns)
    used = (TIME, *rates, *forces, TEMPERATURE)
    columns = _find(used, layout.names, options, source.path)
    stamps = StampColumn.of(source, source.path, layout, columns[TIME.name])
    kinds: dict[str, Kind] = {found.column: "number" for found in columns.values()}
    kinds |= stamps.kinds
    sign = -1.0 if options.reads_gravity else 1.0
    return _Plan(
        layout,
        columns,
        rates,
        forces,
        1.0 if rates is RATES else 1 / _interval_s(options, "delta_angle", source.path),
        sign if forces is FORCES else sign / _interval_s(options, "delta_velocity", source.path),
        stamps,
        kinds,
    )


def _held(
    plain: tuple[Quantity, ...],
    increments: tuple[Quantity, ...],
    names: tuple[str, ...],
    stated: Mapping[str, ColumnOption],
) -> tuple[Quantity, ...]:
    """Return which of the two the file has: `increments` where only they are there, or options name them."""
    if any(q.name in stated for q in increments):
        return increments
    everything = [q.name for q in (*plain, *increments)]
    only = fits(increments, names, everything) and not fits(plain, names, everything)
    return increments if only and not any(q.name in stated for q in plain) else plain


def _find(
    quantities: tuple[Quantity, ...], names: tuple[str, ...], options: ImuCsvOptions, file: Path
) -> dict[str, Found]:
    """Return the columns of the quantities, with the units that names or options state."""
    stated = dict(options.columns)
    plain_units: dict[str, float] = {TIME.name: 1.0}  # the clock states it
    groups = {"rate_unit": options.rate_unit, "force_unit": options.force_unit}
    for quantity in quantities:
        option = "rate_unit" if quantity in (*RATES, *ANGLES) else "force_unit"
        if quantity is TIME or quantity is TEMPERATURE:
            continue
        unit = groups[option]
        if unit is None:
            _need_unit(quantity, option, names, stated, file)
            continue
        plain_units[quantity.name] = _size(unit, quantity, option, file)
        column = stated.get(quantity.name)
        if column is not None and column.unit is None and not unit_in_name(column.name, quantity.dimension):
            stated[quantity.name] = ColumnOption(name=column.name, unit=unit)
    columns = find_columns(quantities, names, stated, file, plain_units)
    for name, size in plain_units.items():
        if name != TIME.name:
            _check_unit(name, columns[name], size, file)
    return columns


def _size(unit: str, quantity: Quantity, option: str, file: Path) -> float:
    """Return the size of a unit that an option states."""
    units = UNITS[quantity.dimension]
    if unit not in units:
        raise ConfigError(
            f"options.{option} = '{unit}'{nearest(unit, units)} is no unit of {quantity.name}",
            expected="one of: " + ", ".join(units),
            file=file,
        )
    return units[unit]


def _need_unit(
    quantity: Quantity, option: str, names: tuple[str, ...], stated: Mapping[str, ColumnOption], file: Path
) -> None:
    """Refuse a column whose unit neither its name nor an option says."""
    if quantity.name in stated or fits((quantity,), names) or not fits((quantity,), names, (quantity.name,)):
        return
    column = next(n for n in names if n.lower() in (quantity.name, *quantity.also))
    raise ConfigError(
        f"column '{column}' ({quantity.name}) says no unit",
        change="or a unit at the end of the columns' names",
        file=file,
        missing=Missing(f"options.{option}", choices=tuple(UNITS[quantity.dimension])),
    )


def _check_unit(quantity: str, found: Found, size: float, file: Path) -> None:
    """Refuse a unit for all three axes that the name of one, or its option, contradicts."""
    if found.scale != size:
        raise ConfigError(
            f"column '{found.column}' ({quantity}) is in {found.unit}, the unit stated for all axes is another",
            expected="one unit",
            change="leave rate_unit or force_unit out, or map the column with its unit",
            file=file,
        )


def _interval_s(options: ImuCsvOptions, quantity: str, file: Path) -> float:
    if options.interval_s is None:
        raise ConfigError(
            f"the log holds increments ({quantity}), and the interval they sum up is not stated",
            expected="options.interval_s, such as 0.005 for a sensor of 200 Hz",
            file=file,
            missing=Missing("options.interval_s"),
        )
    return options.interval_s
