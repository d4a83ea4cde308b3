"""Computes figures of a log while it streams: counts, epochs, ranges of columns, extent. Memory stays constant.

What can be wrong is judged here too: epochs that go back, epochs twice, gaps, rates that change, positions that
leap. Records are counted from 0 among the rows that were read; where the format numbers its records, the number
in the file is given.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyproj

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.crs import LOCAL_WORLD, MapFrame, crs_from_text, geodetic_from_world
from roadscan.core.errors import RoadscanError, SchemaError
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.witness import Finding
from roadscan.ingest.reading.format import Item, LogHeader, Reject, Rows
from roadscan.ingest.reading.stamps import FutureTimes
from roadscan.poses.leaps import FASTEST_M_PER_S
from roadscan.store.readings.row_groups import distances_m
from roadscan.store.schema import TableSchema, table_schema

LEAP_SPEED_M_PER_S: Final = FASTEST_M_PER_S
"""A position leaps where a survey vehicle would have to drive faster than this (m/s)."""
LEAP_M: Final = 1.0
"""Shorter steps count as noise at any speed (m)."""
GAP_PERIODS: Final = 2.5
"""Steps longer than this many usual ones are gaps."""
COVERAGE_GAP_S: Final = 1
"""In tables with many readings per instant, whole seconds without one, at least this many, are a gap."""

_WINDOW: Final = 64  # steps whose median gives one value of the rate
_RATE_CHANGE: Final = 1.3  # ratio of two rates from which a change is reported
_MOST_REASONS: Final = 200  # reject reasons that are counted separately
_MOST_SECONDS: Final = 2_000_000  # seconds with readings that are remembered, to find gaps
_SAMPLE: Final = 2_000  # positions of a block that are transformed for the extent
_STEP_BINS: Final = 4_000  # bins of the histogram of steps, logarithmic from 1 ns
_BINS_PER_DECADE: Final = 200  # bins for each factor of ten in the step


@dataclass
class Fault:
    """Counted fault of a log."""

    what: str
    count: int
    record: int = -1
    """First record, −1 where it has no number."""
    offset: int = -1
    """Byte offset of the first, −1 where there is none."""
    file: str = ""
    """File of the first fault, relative to the log."""


@dataclass
class ColumnFigures:
    """Range of one column."""

    unit: str
    frame: str
    min: float | None = None
    max: float | None = None
    missing: int = 0

    def take(self, array: pa.Array) -> None:
        """Extend the range by an array of numbers."""
        self.missing += array.null_count
        values = array.drop_null().to_numpy(zero_copy_only=False)
        if values.dtype.kind == "f":
            finite = np.isfinite(values)
            if not finite.all():
                self.missing += int((~finite).sum())
                values = values[finite]
        if values.size:
            low, high = values.min().item(), values.max().item()
            self.min = low if self.min is None else min(self.min, low)
            self.max = high if self.max is None else max(self.max, high)


class Epochs:
    """Span, order, usual step and gaps of a table's epochs."""

    def __init__(self, *, unique: bool) -> None:
        self.unique = unique
        """Each epoch occurs once (poses, profiles), as the table's order says; else many readings share an instant."""
        self.count = 0
        self.min_ns = self.max_ns = self._last_ns = 0
        self.back = Fault("epochs go back", 0)
        self.twice = Fault("epochs stand twice, one after another", 0)
        self.gaps: list[tuple[float, int]] = []
        """Longest gaps: (length in s, epoch at which it starts)."""
        self.gap_count = 0
        self.rates: list[tuple[int, float]] = []
        """Record and rate (1/s) where the rate changes, including the first."""
        self._steps = np.zeros(_STEP_BINS, dtype=np.int64)
        self._seconds: set[int] | None = set()
        self._carried: Int64 = np.empty(0, dtype=np.int64)

    def take(self, epochs: Int64, first_record: int, place: tuple[str, int]) -> None:
        """Add a block of epochs (n,), n > 0.

        Parameters
        ----------
        first_record : number of the first.
        place : file and byte offset of the block.
        """
        series = epochs if not self.count else np.concatenate([[self._last_ns], epochs])
        steps = np.diff(series)
        skipped = epochs.size - steps.size
        low, high = int(epochs.min()), int(epochs.max())
        self.min_ns, self.max_ns = (low, high) if not self.count else (min(self.min_ns, low), max(self.max_ns, high))
        if self.unique:
            self._note(self.back, steps < 0, first_record + skipped, place)
            self._note(self.twice, steps == 0, first_record + skipped, place)
            self._note_gaps(series, steps)
            self._note_rates(steps, first_record + skipped)
        elif self._seconds is not None:
            self._seconds.update(np.unique(epochs // NS_PER_S).tolist())
            if len(self._seconds) > _MOST_SECONDS:
                self._seconds = None
        self._last_ns = int(epochs[-1])
        self.count += epochs.size

    @property
    def span_s(self) -> float:
        """Time from the first to the last epoch (s)."""
        return (self.max_ns - self.min_ns) / NS_PER_S

    @property
    def period_s(self) -> float | None:
        """Usual step: the median of the forward steps (s)."""
        total = int(self._steps.sum())
        if not total:
            return None
        index = int(np.searchsorted(np.cumsum(self._steps), (total + 1) // 2))
        return float(10 ** ((index + 0.5) / _BINS_PER_DECADE) / NS_PER_S)

    @property
    def rate_hz(self) -> float | None:
        """Records per second over the whole span."""
        return (self.count - 1) / self.span_s if self.span_s > 0 else None

    def finish(self) -> None:
        """Find the gaps that show only at the end."""
        if self.unique or not self._seconds:
            return
        seconds = np.sort(np.fromiter(self._seconds, dtype=np.int64))
        empty = np.diff(seconds) - 1
        self.gap_count = int((empty >= COVERAGE_GAP_S).sum())
        longest = np.argsort(-empty, kind="stable")[:5]
        self.gaps = [(float(empty[i]), int(seconds[i] + 1) * NS_PER_S) for i in longest if empty[i] >= COVERAGE_GAP_S]

    def _note(self, fault: Fault, bad: npt.NDArray[np.bool_], first: int, place: tuple[str, int]) -> None:
        where = np.flatnonzero(bad)
        if where.size and not fault.count:
            fault.record, fault.file = first + int(where[0]), place[0]
        fault.count += where.size

    def _note_gaps(self, series: Int64, steps: Int64) -> None:
        onward = steps[steps > 0]
        bins = np.clip(np.log10(np.maximum(onward, 1)) * _BINS_PER_DECADE, 0, _STEP_BINS - 1).astype(np.int64)
        self._steps += np.bincount(bins, minlength=_STEP_BINS)
        period = self.period_s
        if period is None:
            return
        wide = np.flatnonzero(steps > GAP_PERIODS * period * NS_PER_S)
        self.gap_count += wide.size
        longest = wide[np.argsort(-steps[wide], kind="stable")[:5]]
        self.gaps += [(float(steps[i] / NS_PER_S), int(series[i])) for i in longest]
        self.gaps = sorted(self.gaps, reverse=True)[:5]

    def _note_rates(self, steps: Int64, first: int) -> None:
        joined = np.concatenate([self._carried, steps])
        start = first - self._carried.size
        whole = joined.size // _WINDOW * _WINDOW
        self._carried = joined[whole:]
        medians = np.median(joined[:whole].reshape(-1, _WINDOW), axis=1)
        for number, step in enumerate(medians.tolist()):
            if step <= 0 or len(self.rates) > 20:
                continue
            rate = NS_PER_S / step
            before = self.rates[-1][1] if self.rates else None
            if before is None or max(rate / before, before / rate) > _RATE_CHANGE:
                self.rates.append((start + number * _WINDOW, rate))


class Extent:
    """Extent of positions: a box in the log's coordinates (m), and longitude and latitude where its CRS is known."""

    def __init__(self, frame: str) -> None:
        self.frame = frame
        self.low: Float64 | None = None
        self.high: Float64 | None = None
        self.degrees_low: Float64 | None = None
        self.degrees_high: Float64 | None = None

    def take(self, own_m: Float64, degrees: Float64 | None) -> None:
        """Extend by positions (n, 3) in metres and longitude, latitude (k, 2) of some of them."""
        finite = own_m[np.isfinite(own_m).all(axis=1)]
        if finite.size:
            self.low = _least(self.low, finite.min(axis=0))
            self.high = _most(self.high, finite.max(axis=0))
        if degrees is not None:
            sound = degrees[np.isfinite(degrees).all(axis=1)]
            if sound.size:
                self.degrees_low = _least(self.degrees_low, sound.min(axis=0))
                self.degrees_high = _most(self.degrees_high, sound.max(axis=0))


@dataclass
class Readings:
    """Readings in the sensor's frame."""

    total: int = 0
    no_return: int = 0
    range_min_m: float | None = None
    range_max_m: float | None = None

    def take(self, ranges_m: Float64, total: int) -> None:
        """Add a block: ranges (k,) of the readings that are returns, out of `total` readings."""
        self.total += total
        self.no_return += total - ranges_m.size
        if ranges_m.size:
            low, high = float(ranges_m.min()), float(ranges_m.max())
            self.range_min_m = low if self.range_min_m is None else min(self.range_min_m, low)
            self.range_max_m = high if self.range_max_m is None else max(self.range_max_m, high)


class TableFigures:
    """Figures of a log's rows for one table."""

    def __init__(self, schema: TableSchema, header: LogHeader, map_frame: MapFrame | None, crs: str | None) -> None:
        self.name = schema.name
        self.meaning = schema.meaning
        self.rows = 0
        self.columns: dict[str, ColumnFigures] = {}
        self.epochs: Epochs | None = None
        if any(c.name == "epoch_gps_ns" for c in schema.columns):
            self.epochs = Epochs(unique=schema.sort == ("epoch_gps_ns",))
        self.extent: Extent | None = None
        self.readings: Readings | None = None
        self.path_m = 0.0
        """Length of the path through the positions (m)."""
        self.leaps = Fault(f"positions leap (more than {LEAP_SPEED_M_PER_S:g} m/s and {LEAP_M:g} m at once)", 0)
        self._schema = schema
        self._header = header
        self._to_degrees = _DegreesOf(header, map_frame, crs)
        self._last: tuple[int, Float64] | None = None

    def take(self, item: Rows, batch: pa.RecordBatch) -> None:
        """Add rows that fit the schema."""
        if not batch.num_rows:
            return
        place = (item.file, item.first_offset)
        first = item.first_record or self.rows
        for column in self._schema.columns:
            if column.type != "string":
                self._take_column(column.name, batch.column(column.name))
        epochs = None
        if self.epochs is not None:
            epochs = batch.column("epoch_gps_ns").to_numpy()
            self.epochs.take(epochs, first, place)
        self._take_positions(batch, epochs, first, place)
        self._take_readings(batch)
        self.rows += batch.num_rows

    def faults(self) -> list[Fault]:
        """Return what is wrong with these rows."""
        found = [self.leaps]
        if self.epochs is not None:
            self.epochs.finish()
            found = [self.epochs.back, self.epochs.twice, *self._gap_faults(), *self._rate_faults(), *found]
        return [fault for fault in found if fault.count]

    def _gap_faults(self) -> Iterator[Fault]:
        if self.epochs is not None and self.epochs.gap_count:
            longest = max(length for length, _ in self.epochs.gaps)
            usual = self.epochs.period_s if self.epochs.unique else None
            against = f", usual step {usual:.3g} s" if usual else ""
            yield Fault(f"gaps in time, the longest {longest:.4g} s{against}", self.epochs.gap_count)

    def _rate_faults(self) -> Iterator[Fault]:
        rates = self.epochs.rates if self.epochs is not None else []
        if len(rates) > 1:
            shown = ", ".join(f"{rate:.4g}" for _, rate in rates[:6]) + (" …" if len(rates) > 6 else "")
            yield Fault(f"the rate changes: {shown} Hz", len(rates) - 1, rates[1][0])

    def _take_column(self, name: str, array: pa.Array) -> None:
        if name == "epoch_gps_ns" or array.null_count == len(array):
            return
        values = array
        while pa.types.is_list(values.type) or pa.types.is_fixed_size_list(values.type):
            values = values.flatten()
        if not (pa.types.is_integer(values.type) or pa.types.is_floating(values.type)):
            return
        if name not in self.columns:
            known = self._schema.column(name)
            self.columns[name] = ColumnFigures(known.unit, known.frame)
        self.columns[name].take(values)

    def _take_positions(self, batch: pa.RecordBatch, epochs: Int64 | None, first: int, place: tuple[str, int]) -> None:
        names = next((n for n in _POSITION_COLUMNS if set(n) <= set(batch.schema.names)), None)
        if names is None:
            return
        own = np.stack([batch.column(n).to_numpy(zero_copy_only=False) for n in names], axis=-1).astype(np.float64)
        if self.extent is None:
            self.extent = Extent(self._to_degrees.frame(names))
        self.extent.take(own, self._to_degrees.of(names, own[_telling(own)]))
        if epochs is not None and self.epochs is not None and self.epochs.unique:
            self._take_way(own, epochs, first, place)

    def _take_way(self, own: Float64, epochs: Int64, first: int, place: tuple[str, int]) -> None:
        skipped = 1
        if self._last is not None:
            own = np.concatenate([self._last[1][None], own])
            epochs = np.concatenate([[self._last[0]], epochs])
            skipped = 0
        steps_m = np.linalg.norm(np.diff(own, axis=0), axis=1)
        elapsed_s = np.abs(np.diff(epochs)) / NS_PER_S
        leaps = np.flatnonzero((steps_m > LEAP_M) & (steps_m > LEAP_SPEED_M_PER_S * elapsed_s))
        if leaps.size and not self.leaps.count:
            self.leaps.record, self.leaps.file = first + skipped + int(leaps[0]), place[0]
        self.leaps.count += leaps.size
        self.path_m += float(np.nansum(steps_m) - steps_m[leaps].sum())
        self._last = (int(epochs[-1]), own[-1])

    def _take_readings(self, batch: pa.RecordBatch) -> None:
        geometry = self._header.attributes.get("scan_geometry")
        if "range" in batch.schema.names and isinstance(geometry, dict):
            raw = batch.column("range").flatten().to_numpy(zero_copy_only=False)
            got = raw[raw > 0]
            self.readings = self.readings or Readings()
            ends = np.array([got.min(), got.max()]) if got.size else np.empty(0)
            ranges = geometry["range_offset_m"] + geometry["range_step_m"] * ends
            self.readings.take(ranges.astype(np.float64), ends.size)
            self.readings.total += raw.size - ends.size
            self.readings.no_return += raw.size - got.size
        elif "x_sensor_m" in batch.schema.names:
            self.readings = self.readings or Readings()
            self.readings.take(distances_m(batch), batch.num_rows)


class LogFigures:
    """Figures of a whole log: its tables, and the records that were lost."""

    def __init__(
        self,
        header: LogHeader,
        map_frame: MapFrame | None = None,
        crs: str | None = None,
        future: FutureTimes | None = None,
    ) -> None:
        self.tables: dict[str, TableFigures] = {}
        self.rejects: dict[str, Fault] = {}
        """Lost records by reason."""
        self.findings: list[Finding] = []
        """The reader's findings."""
        self.rows = 0
        self.items = 0
        self._header = header
        self._map = map_frame
        self._crs = crs
        self._future = future

    def take(self, item: Item) -> None:
        """Add an item of the reader."""
        self.items += 1
        if isinstance(item, Reject):
            self._lose(item.reason, item.records, item.record, item.offset, item.file)
            return
        if isinstance(item, Finding):
            self.findings.append(item)
            return
        schema = table_schema(item.table)
        if item.table not in self.tables:
            self.tables[item.table] = TableFigures(schema, self._header, self._map, self._crs)
        try:
            batch = schema.conform(item.batch, self._header.list_size)
        except SchemaError as error:
            self._lose(str(error), item.batch.num_rows, item.first_record, item.first_offset, item.file)
            return
        faults = [*schema.faults(batch), *(self._future.refused(item) if self._future else [])]
        for rows, reason in faults:
            first = int(rows[0])
            offset = item.first_offset + first * item.record_bytes if item.record_bytes else -1
            self._lose(reason, rows.size, item.first_record + first, offset, item.file)
        if faults:
            good = np.ones(batch.num_rows, dtype=bool)
            good[np.concatenate([rows for rows, _ in faults])] = False
            batch = batch.filter(pa.array(good))
        self.tables[item.table].take(item, batch)
        self.rows += batch.num_rows

    @property
    def values(self) -> int:
        """Return the number of single values so far, which limits a quick inspection."""
        return sum(max(t.rows, t.readings.total if t.readings else 0) for t in self.tables.values())

    @property
    def rejected(self) -> int:
        """Return the number of lost records."""
        return sum(fault.count for fault in self.rejects.values())

    @property
    def faults(self) -> list[Fault]:
        """Return all faults: lost records first, the most frequent reason first."""
        lost = sorted(self.rejects.values(), key=lambda f: -f.count)
        doubts = [Fault(one.text, max(one.left_out, 1)) for one in self.findings]
        return lost + doubts + [f for table in self.tables.values() for f in table.faults()]

    @property
    def span_gps_ns(self) -> tuple[int, int] | None:
        """Return the first and last epoch of all tables."""
        spans = [t.epochs for t in self.tables.values() if t.epochs is not None and t.epochs.count]
        return (min(e.min_ns for e in spans), max(e.max_ns for e in spans)) if spans else None

    def _lose(self, reason: str, count: int, record: int, offset: int, file: str) -> None:
        name = reason if reason in self.rejects or len(self.rejects) < _MOST_REASONS else "other reasons"
        if name not in self.rejects:
            self.rejects[name] = Fault(name, 0, record, offset, file)
        self.rejects[name].count += count


_POSITION_COLUMNS: Final = (
    ("x_world_m", "y_world_m", "z_world_m"),
    ("x_m", "y_m", "z_m"),
    ("easting_m", "northing_m", "height_m"),
)
"""Columns of positions: in a world frame, in the cloud's CRS, in the map."""


@dataclass
class _DegreesOf:
    """Converts positions to longitude and latitude, where their frame is tied to the Earth."""

    header: LogHeader
    map: MapFrame | None
    crs: str | None
    _failed: bool = field(default=False, init=False)

    def frame(self, names: tuple[str, ...]) -> str:
        """Return the frame of the positions in these columns."""
        if names[0] == "x_world_m":
            return str(self.header.attributes.get("world_frame", LOCAL_WORLD))
        if names[0] == "x_m":
            return str(self.header.attributes.get("crs") or self.crs or LOCAL_WORLD)
        return LOCAL_WORLD if self.map is None or self.map.crs is None else self.map.crs

    def of(self, names: tuple[str, ...], own_m: Float64) -> Float64 | None:
        """Return longitude and latitude (k, 2) of positions (k, 3); None in a local frame."""
        frame = self.frame(names)
        if frame == LOCAL_WORLD or self._failed:
            return None
        try:
            if names[0] == "x_world_m":
                return geodetic_from_world(frame, own_m)[:, :2]
            crs = crs_from_text(frame)
            unit_m = float(crs.axis_info[0].unit_conversion_factor) if crs.is_projected else 1.0
            to_degrees = pyproj.Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True)
            return np.stack(to_degrees.transform(*(own_m[:, :2] / unit_m).T), axis=-1)
        except (RoadscanError, pyproj.exceptions.ProjError):
            self._failed = True  # the extent in metres remains valid
            return None


def _telling(positions: Float64) -> Int64:
    """Return rows that determine the extent of positions (n, 3): the outermost ones, and a sample."""
    step = max(1, len(positions) // _SAMPLE)
    outermost = [positions.argmin(axis=0), positions.argmax(axis=0), np.arange(0, len(positions), step)]
    return np.unique(np.concatenate(outermost))


def _least(before: Float64 | None, now: Float64) -> Float64:
    return now if before is None else np.minimum(before, now)


def _most(before: Float64 | None, now: Float64) -> Float64:
    return now if before is None else np.maximum(before, now)
