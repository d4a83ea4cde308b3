"""Readings of wheel encoders and odometers as text with named columns and units."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Final, Literal

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.errors import ConfigError, FormatError, Missing, nearest
from roadscan.core.strict import Strict
from roadscan.ingest.reading.columns import (
    UNITS,
    ColumnOption,
    Found,
    Quantity,
    check_keys,
    find_columns,
    fits,
    named_column,
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

TICKS: Final = Quantity("ticks", "count", ("encoder_ticks", "wheel_ticks", "pulses"), optional=True)
DISTANCE: Final = Quantity("distance", "length", ("odometer", "wheel_distance"), optional=True)
SPEED: Final = Quantity("speed", "speed", ("wheel_speed",), optional=True)
WHAT: Final = (TICKS, DISTANCE, SPEED)
WHEEL_COLUMN: Final = "wheel"

SPEED_MAX_M_PER_S: Final = 200.0  # faster readings count as damage
DISTANCE_MAX_M: Final = 1e10  # larger distances count as damage
TICKS_MAX: Final = float(1 << 53)
"""Largest count that float64 represents exactly."""
MOST_WHEELS: Final = 64  # wheels of one log
_WHEEL: Final = re.compile(r"(?:front|rear|f|r)?_?(?:left|right|l|r|inner|outer)|front|rear|wheel_?\d{1,2}|\d{1,2}")
"""Words in a column's name that identify a wheel; others are mapped by `wheels`."""
_NOT_ENCODER: Final = (
    "latitude", "longitude", "lat_", "lon_", "easting", "northing", "roll", "heading", "qw", "r11", "gyro", "acc",
    "angular_rate", "specific_force", "delta_angle",
)  # fmt: skip
"""Stems of columns that identify a table of poses or of an IMU, whatever else it contains."""


class DirectionOption(Strict):
    """A column that says which way the wheel turns."""

    column: str
    """Name of the column."""
    forwards: list[str]
    """Words in it that mean forwards, such as ["1", "F"]."""
    backwards: list[str]
    """Words in it that mean backwards."""


class EncoderCsvOptions(TextOptions):
    """Settings of `encoder_csv`."""

    columns: dict[str, ColumnOption] = {}
    """Which column holds which quantity, where its name does not say so: time, wheel, ticks, distance, speed.
    For example { speed = { name = "v", unit = "km_per_h" } }."""
    wheels: dict[str, dict[str, ColumnOption]] = {}
    """For a file with columns of its own for each wheel: ticks, distance and speed by the wheel's name.
    For example { front_left = { speed = { name = "FL", unit = "km_per_h" } } }."""
    record: Literal["total", "increment"] | None = None
    """What ticks and distances are: "total", a counter that runs on, or "increment", what came since the last
    record. Needed where the log holds either."""
    counter_bits: Literal[8, 16, 24, 32] | None = None
    """Bits of a counter that rolls over to zero (or from its largest to its most negative value);
    without it, totals are taken as they are."""
    counts_backwards: bool | list[str] = False
    """True where the numbers grow when the vehicle moves backwards (an encoder mounted the other way
    round), or the names of the wheels for which it is so."""
    direction: DirectionOption | None = None
    """Column that gives the direction of increments and speeds which themselves carry no sign."""


@dataclass(frozen=True)
class _Wheel:
    """Columns of one wheel, or of all where a column names the wheel."""

    name: str
    columns: dict[str, Found]


@dataclass(frozen=True)
class _Plan:
    """How a file is read."""

    layout: TextLayout
    options: EncoderCsvOptions
    wheels: tuple[_Wheel, ...]
    wheel_column: str | None
    stamps: StampColumn
    kinds: dict[str, Kind]


@dataclass
class _Total:
    """Running total of one quantity of one wheel, carried from block to block."""

    record: Literal["total", "increment"]
    counter_bits: int | None = None
    last_raw: float | None = None
    total: float = 0.0
    """Total at the last record."""
    seen: bool = False

    def add(self, raw: Float64) -> Float64:
        """Return totals (n,) after each of the finite raw numbers (n,)."""
        if self.record == "increment":
            totals = self.total + np.cumsum(raw)
        elif self.counter_bits is None:
            return raw
        else:
            before = raw[0] if self.last_raw is None else self.last_raw
            start = raw[0] if self.last_raw is None else self.total
            totals = start + np.cumsum(self._steps(np.concatenate([[before], raw])))
            self.last_raw = float(raw[-1])
        self.total = float(totals[-1])
        return totals

    def leaps(self, raw: Float64) -> npt.NDArray[np.bool_]:
        """Return which raw counts (n,) leap by over a quarter of the counter's range and back: damage.

        Taken as a count, it would put a whole turn of the counter into all later totals.
        """
        out = np.zeros(raw.size, dtype=bool)
        if self.counter_bits is None or self.record == "increment" or raw.size == 0:
            return out
        known = [] if self.last_raw is None else [self.last_raw]
        series = np.concatenate([known, raw])
        steps, quarter = self._steps(series), 2.0 ** (self.counter_bits - 2)
        across = self._steps_between(series[:-2], series[2:])
        far = (np.abs(steps[:-1]) > quarter) & (np.abs(steps[1:]) > quarter) & (np.abs(across) <= quarter)
        out[np.flatnonzero(far) + 1 - len(known)] = True
        if raw.size > 2 and not out[-2]:
            out[-1] = abs(steps[-1]) > quarter  # whether it comes back is not known yet
        return out

    def _steps(self, counts: Float64) -> Float64:
        return self._steps_between(counts[:-1], counts[1:])

    def _steps_between(self, before: Float64, after: Float64) -> Float64:
        """Return the shortest differences (n,) from one count to the other on the counter's circle."""
        turn = 2.0 ** (self.counter_bits or 0)
        step: Float64 = np.mod(after - before + turn / 2, turn) - turn / 2
        return step


class EncoderCsv(LogFormat):
    """A line a reading: time, and ticks, distance or speed of one wheel or of several.

    A single wheel's columns, or those of a file with a column `wheel`, are called ``ticks``,
    ``distance_m``, ``speed_km_per_h`` and the like; a file with columns for each wheel has the wheel in their
    names (``speed_front_left_m_per_s``, ``ticks_rl``), or maps them through `wheels`. Counters that roll
    over are unrolled by the shortest way between two records. Totals and speeds are stored positive
    forwards. An increment that is lost with a damaged record is missing from all later totals. What a tick
    is worth is the sensor's `metres_per_tick` in the rig file, and is not applied here.
    """

    name = "encoder_csv"
    title = "Wheel encoders and odometers as CSV: ticks, distance or speed of one wheel or several"
    yields = ("encoder",)
    column_sets: ClassVar[tuple[tuple[Quantity, ...], ...]] = tuple((TIME, quantity) for quantity in WHAT)
    time = (
        "numbers: state clock.system and clock.unit; ISO 8601 text with a zone (…Z) is UTC, "
        "without one state unix_utc, unix_gps or unix_tai, the scale it is written in"
    )
    options = EncoderCsvOptions

    def sniff(self, path: Path) -> bool:
        """True if there are a time and ticks, distances or speeds of wheels, and no pose or IMU."""
        layout = sniff_layout(path)
        if layout is None or any(name.lower().startswith(_NOT_ENCODER) for name in layout.names):
            return False
        if not fits((TIME,), layout.names, (TIME.name,)):
            return False
        names = [name.lower() for name in layout.names]
        single = any(fits((replace(q, optional=False),), names) for q in WHAT)
        return single or any(_wheel_of(q, name) is not None for q in WHAT for name in names)

    def header(self, source: LogSource) -> LogHeader:
        """Find the columns and check sensor, clock, units and what is counted."""
        source.need_sensor("encoder")
        plan = _plan(source)
        wheels = {w.name: {q: {"name": f.column, "unit": f.unit} for q, f in w.columns.items()} for w in plan.wheels}
        return LogHeader({"wheels": wheels, "wheel_column": plan.wheel_column})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream readings, wheel by wheel within a block; a line or wheel that cannot be read is rejected."""
        plan = _plan(source)
        reader = _Reader(plan, EpochReader(plan.stamps.clock, source.path))
        for block in text_blocks(source.path, plan.layout, plan.kinds):
            if isinstance(block, Reject):
                yield block
                continue
            yield from reader.items(block)


@dataclass
class _Reader:
    """Converts the blocks of one log to rows, with each wheel's running totals."""

    plan: _Plan
    epochs: EpochReader
    totals: dict[tuple[str, str], _Total] = field(default_factory=dict)

    def items(self, block: TextBlock) -> Iterator[Item]:
        """Yield rows and rejects of a block."""
        lines = Sieve(block.records.size)
        epochs = self.epochs.epochs(self.plan.stamps.stamps(block, lines), lines, block.records)
        signs = self._signs(block, lines)
        parts = self._parts(block, lines)
        yield from lines.rejects(block.records, block.offsets)
        for wheel, rows in parts:
            yield from self._wheel(block, wheel, rows, epochs, signs)

    def _parts(self, block: TextBlock, lines: Sieve) -> list[tuple[_Wheel, Int64]]:
        """Return each wheel of the block, with the sound lines that contain it."""
        if self.plan.wheel_column is None:
            rows = np.flatnonzero(lines.good)
            return [(wheel, rows) for wheel in self.plan.wheels] if rows.size else []
        names = np.array(block.text(self.plan.wheel_column))
        known = {wheel for wheel, _ in self.totals}
        for name in np.unique(names[lines.good]).tolist():
            if name not in known and len(known) < MOST_WHEELS:
                known.add(name)
                self.totals |= {(name, q.name): _total(self.plan.options, q) for q in WHAT}
        lines.drop(~np.isin(names, list(known)), f"the log names more than {MOST_WHEELS} wheels")
        columns = self.plan.wheels[0].columns
        found = [(name, np.flatnonzero(lines.good & (names == name))) for name in sorted(known)]
        return [(_Wheel(name, columns), rows) for name, rows in found if rows.size]

    def _signs(self, block: TextBlock, lines: Sieve) -> Float64 | None:
        """Return +1 forwards, −1 backwards (n,), where a column says so."""
        option = self.plan.options.direction
        if option is None:
            return None
        words = np.array(block.text(option.column))
        forwards, backwards = np.isin(words, option.forwards), np.isin(words, option.backwards)
        lines.drop(~(forwards | backwards), "the direction is neither forwards nor backwards")
        return np.where(backwards, -1.0, 1.0)

    def _wheel(
        self, block: TextBlock, wheel: _Wheel, rows: Int64, epochs: Int64, signs: Float64 | None
    ) -> Iterator[Item]:
        """Yield rows and rejects of one wheel in the lines `rows` of a block."""
        sieve = Sieve(rows.size)
        raw = {q.name: _raw(block, wheel, q, rows) for q in WHAT if q.name in wheel.columns}
        for name, values in raw.items():
            _check(name, values, self.plan.options.counter_bits, sieve)
        sieve.drop(np.all([np.isnan(v) for v in raw.values()], axis=0), "no value")
        for name, values in raw.items():
            leaps = np.zeros(rows.size, dtype=bool)
            here = np.flatnonzero(sieve.good & ~np.isnan(values))
            leaps[here] = self._total(wheel.name, name).leaps(values[here])
            sieve.drop(leaps, "the counter leaps and comes back")
        turn = -1.0 if _is_backwards(self.plan.options, wheel.name) else 1.0
        columns: dict[str, pa.Array] = {}
        good = np.flatnonzero(sieve.good)
        for name, values in raw.items():
            column, kind = _COLUMNS[name]
            ways = turn if signs is None else turn * signs[rows[good]]
            columns[column] = pa.array(self._finished(wheel.name, name, values[good], ways), from_pandas=True).cast(
                kind
            )
        records, offsets = block.records[rows], block.offsets[rows]
        if good.size:
            columns["epoch_gps_ns"] = pa.array(epochs[rows[good]])
            columns["wheel"] = pa.array([wheel.name] * good.size, pa.string())
            yield Rows("encoder", pa.record_batch(columns), "", int(records[good[0]]), int(offsets[good[0]]))
        for reject in sieve.rejects(records, offsets):
            named = f"wheel {wheel.name}: {reject.reason}" if wheel.name else reject.reason
            yield replace(reject, reason=named)

    def _total(self, wheel: str, quantity: str) -> _Total:
        key = (wheel, quantity)
        if key not in self.totals:
            self.totals[key] = _total(self.plan.options, next(q for q in WHAT if q.name == quantity))
        return self.totals[key]

    def _finished(self, wheel: str, quantity: str, values: Float64, ways: Float64 | float) -> Float64:
        """Return running totals or speeds (n,), forwards positive, of raw values (n,); NaN where there is none."""
        if quantity == SPEED.name:
            return values * ways
        total = self._total(wheel, quantity)
        out = np.full(values.size, np.nan)
        here = np.flatnonzero(~np.isnan(values))
        if here.size:
            signed = values * ways
            # A counter is unrolled as it is written, and its sign is changed afterwards.
            out[here] = total.add(signed[here]) if total.record == "increment" else total.add(values[here]) * ways
        return out


_COLUMNS: Final[dict[str, tuple[str, pa.DataType]]] = {
    "ticks": ("ticks", pa.int64()),
    "distance": ("distance_m", pa.float64()),
    "speed": ("speed_m_per_s", pa.float64()),
}


def _total(options: EncoderCsvOptions, quantity: Quantity) -> _Total:
    return _Total(options.record or "total", options.counter_bits if quantity is TICKS else None)


def _is_backwards(options: EncoderCsvOptions, wheel: str) -> bool:
    stated = options.counts_backwards
    return stated if isinstance(stated, bool) else wheel in stated


def _raw(block: TextBlock, wheel: _Wheel, quantity: Quantity, rows: Int64) -> Float64:
    found = wheel.columns[quantity.name]
    with np.errstate(over="ignore"):
        return block.number(found.column)[rows] * found.scale


def _check(name: str, values: Float64, counter_bits: int | None, sieve: Sieve) -> None:
    """Drop records with impossible values (n,); a missing one (NaN) is left to the other quantities."""
    limit, unit = {
        "ticks": (TICKS_MAX, "ticks"),
        "distance": (DISTANCE_MAX_M, "m"),
        "speed": (SPEED_MAX_M_PER_S, "m/s"),
    }[name]
    missing = np.isnan(values)
    sieve.drop(~(missing | (np.abs(values) <= limit)), f"{name} is outside ±{limit:g} {unit}")
    if name == "ticks":
        with np.errstate(invalid="ignore"):  # infinities are dropped already
            sieve.drop(~missing & (values != np.rint(values)), "ticks are no whole number")
    if name == "ticks" and counter_bits is not None:
        inside = (values >= -(2.0 ** (counter_bits - 1))) & (values < 2.0**counter_bits)
        sieve.drop(~(missing | inside), f"ticks are more than a counter of {counter_bits} bits can show")


def _plan(source: LogSource) -> _Plan:
    options = options_of(source, EncoderCsvOptions)
    layout = text_layout(source.path, options)
    time, wheel_column, wheels = _columns(layout.names, options, source.path)
    stamps = StampColumn.of(source, source.path, layout, time)
    kinds: dict[str, Kind] = {found.column: "number" for wheel in wheels for found in wheel.columns.values()}
    kinds |= stamps.kinds
    words = [] if wheel_column is None else [wheel_column]
    if options.direction is not None:
        words.append(named_column("the direction", options.direction.column, (), layout.names, source.path))
    kinds |= dict.fromkeys(words, "text")
    _check_options(options, wheels, wheel_column, source.path)
    return _Plan(layout, options, wheels, wheel_column, stamps, kinds)


def _columns(
    names: tuple[str, ...], options: EncoderCsvOptions, file: Path
) -> tuple[Found, str | None, tuple[_Wheel, ...]]:
    """Return the columns of time and of the wheel's name, if any, and each wheel's columns."""
    check_keys(options.columns, [TIME.name, WHEEL_COLUMN, *(q.name for q in WHAT)], file)
    stated = {name: option for name, option in options.columns.items() if name != WHEEL_COLUMN}
    plain = {TIME.name: 1.0}  # the clock states its unit
    if options.wheels:
        time = find_columns((TIME,), names, {k: v for k, v in stated.items() if k == TIME.name}, file, plain)
        wheels = tuple(_Wheel(wheel, _stated(wheel, columns, names, file)) for wheel, columns in options.wheels.items())
        return time[TIME.name], None, wheels
    found = find_columns((TIME, *WHAT), names, stated, file, plain)
    time_column = found.pop(TIME.name)
    wheel_option = options.columns.get(WHEEL_COLUMN)
    wheel_column = None
    if wheel_option is not None or WHEEL_COLUMN in names:
        wheel_column = named_column(
            "the wheel", wheel_option.name if wheel_option else None, (WHEEL_COLUMN,), names, file
        )
    wheels = (_Wheel("", found),) if found else ()
    if wheel_column is None and not any(q.name in stated for q in WHAT):
        wheels += tuple(_Wheel(wheel, columns) for wheel, columns in _by_wheel(names).items())
    if not wheels:
        raise _nothing(names, file)
    return time_column, wheel_column, wheels


def _stated(wheel: str, columns: dict[str, ColumnOption], names: tuple[str, ...], file: Path) -> dict[str, Found]:
    """Return the columns of a wheel as `wheels` states them."""
    check_keys(columns, [q.name for q in WHAT], file)
    found = find_columns([q for q in WHAT if q.name in columns], names, columns, file)
    if not found:
        raise ConfigError(
            f"options.wheels.{wheel} names no column", expected="ticks, distance or speed = { name = … }", file=file
        )
    return found


def _by_wheel(names: tuple[str, ...]) -> dict[str, dict[str, Found]]:
    """Return the columns of each wheel whose names say the quantity, the wheel and the unit."""
    wheels: dict[str, dict[str, Found]] = {}
    for column in names:
        for quantity in WHAT:
            fitting = _wheel_of(quantity, column.lower())
            if fitting is not None:
                wheel, unit = fitting
                scale = UNITS[quantity.dimension][unit]
                wheels.setdefault(wheel, {}).setdefault(quantity.name, Found(column, scale, unit))
    return wheels


def _wheel_of(quantity: Quantity, column: str) -> tuple[str, str] | None:
    """Return wheel and unit of a column called ``speed_front_left_m_per_s`` or ``front_left_speed_m_per_s``."""
    for unit in sorted(UNITS[quantity.dimension], key=len, reverse=True):
        bare = column.removesuffix(f"_{unit}") if unit else column
        if unit and bare == column:
            continue
        for stem in (quantity.name, *quantity.also):
            for wheel in (bare.removeprefix(f"{stem}_"), bare.removesuffix(f"_{stem}")):
                if wheel != bare and _WHEEL.fullmatch(wheel):
                    return wheel, unit
    return None


def _nothing(names: tuple[str, ...], file: Path) -> FormatError:
    plain = [name for name in names if name.lower() in {w for q in WHAT for w in (q.name, *q.also)}]
    units = ", ".join(unit for unit in (*UNITS["length"], *UNITS["speed"]))
    return FormatError(
        f"column '{plain[0]}' says no unit" if plain else "no column holds ticks, distance or speed",
        expected=f"columns called ticks, distance_… or speed_… with one of the units {units}",
        change='or state it: columns = { speed = { name = "…", unit = "…" } }, or wheels',
        file=file,
        missing=Missing("options.columns"),
    )


def _check_options(
    options: EncoderCsvOptions, wheels: tuple[_Wheel, ...], wheel_column: str | None, file: Path
) -> None:
    """Refuse options that leave the meaning of the numbers open, or contradict it."""
    counted = any(q.name in wheel.columns for wheel in wheels for q in (TICKS, DISTANCE))
    if counted and options.record is None:
        raise ConfigError(
            "the log holds ticks or distances, and whether they run on is not stated",
            expected='options.record = "total" (a counter that runs on) or "increment" (since the last record)',
            file=file,
            missing=Missing("options.record", choices=("total", "increment")),
        )
    if options.direction is not None and counted and options.record == "total":
        raise ConfigError(
            "a running total has its direction in itself",
            expected="options.direction with increments or speeds only",
            file=file,
        )
    if options.counter_bits is not None and options.record == "increment":
        raise ConfigError("increments do not roll over", expected='counter_bits with record = "total" only', file=file)
    names = [wheel.name for wheel in wheels]
    if isinstance(options.counts_backwards, list) and wheel_column is None:
        for name in options.counts_backwards:
            if name not in names:
                raise ConfigError(
                    f"options.counts_backwards names the unknown wheel '{name}'{nearest(name, names)}",
                    expected="one of: " + ", ".join(names),
                    file=file,
                )
