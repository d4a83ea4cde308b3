"""Poses as quaternions: CSV, Feather (Arrow IPC), Parquet, and the TUM text form."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.crs import LOCAL_WORLD, crs_from_text
from roadscan.core.errors import FormatError
from roadscan.core.frames import ENU_FROM_NED, quaternion_from_rotation
from roadscan.core.gpstime import UNIT_NS, Clock
from roadscan.ingest.reading.column_table import Lost, is_number, need_table
from roadscan.ingest.reading.columns import Found, check_keys, named_column, need_stamp_unit, stamp_column
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject
from roadscan.ingest.reading.poses import (
    North,
    Placement,
    PoseReader,
    RawPoses,
    WorldPlacement,
    body_quaternion,
    level_placement,
    quaternion_product,
    unit_quaternions,
)
from roadscan.ingest.reading.records import Sieve, options_of
from roadscan.ingest.reading.stamps import first_unit, likely_unit
from roadscan.ingest.reading.text_table import (
    Kind,
    TextOptions,
    first_fields,
    first_record,
    first_words,
    number_stamp_kind,
    text_blocks,
    text_layout,
)

QUATERNION: Final = ("qw", "qx", "qy", "qz")
TRANSLATION: Final = ("tx", "ty", "tz")
STAMPS: Final = ("timestamp_ns", "timestamp_us", "timestamp_s", "timestamp", "time_s", "time", "stamp")
"""Names by which the column of time stamps is found."""

TUM_NAMES: Final = ("time", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
AV2_NAME: Final = "city_SE3_egovehicle.feather"
AV2_COLUMNS: Final = ("timestamp_ns", *QUATERNION, "tx_m", "ty_m", "tz_m")
AV2_AXES: Final = "flu"
"""Argoverse 2 documents its ego-vehicle frame as x forward, y left, z up."""

_GRID_NAMES: Final = {
    "tx": ("easting", "utm_x"),
    "ty": ("northing", "utm_y"),
    "tz": ("height", "altitude", "elevation"),
}
"""Further names of a position's columns, for poses in a projected CRS."""
_BRACKETS: Final = re.compile(r"\s*[(\[]([^)\]]*)[)\]]$")
_EUROC: Final = re.compile(r"([pq])_RS(?:_R)?_([wxyz])")
_NED_FROM_ENU: Final = quaternion_from_rotation(ENU_FROM_NED.T)

BATCH_ROWS: Final = 65_536  # rows of a batch


class PoseQuaternionsOptions(TextOptions):
    """Settings of `pose_quaternions`."""

    later: ClassVar[frozenset[str]] = TextOptions.later | {"heading"}

    axes: str | None = None
    """Where x, y, z of the posed frame point on the vehicle, such as frd, flu or rfu. Has to be stated;
    known only for Argoverse 2's city_SE3_egovehicle.feather (flu)."""
    columns: dict[str, str] = {}
    """Names of columns that are called otherwise: stamp, qw, qx, qy, qz, tx, ty, tz. For example
    { stamp = "t", tx = "px" }. Found by themselves: the quaternion under these names, the translation
    also as tx_m or x_m or x …, the stamp as timestamp_ns, timestamp, time_s, time, stamp …"""
    heading: North | None = None
    """For a projected CRS, as SLAM with RTK writes: whether y of the quaternion's frame points to grid north ("grid")
    or true north ("true"); x points east, z up. Has to be stated."""


class PoseQuaternions(LogFormat):
    """A record a pose: a stamp, a quaternion world-from-sensor and a translation in metres.

    Text (CSV; EuRoC: ``#timestamp [ns], p_RS_R_x [m], …, q_RS_w [], …``; or TUM: ``time tx ty tz qx qy qz qw`` between
    blanks, without column names), Feather or Parquet. The world is a local frame (``crs = "local"``), geocentric, or
    projected: then tx, ty, tz are easting, northing and height, and the quaternion counts from east, north and up. The
    posed frame becomes the body; `axes` says where its axes point.
    """

    name = "pose_quaternions"
    title = "Poses as quaternions (CSV, TUM, EuRoC, Feather, Parquet; Argoverse 2): local, geocentric or projected"
    yields = ("trajectory",)
    time = "numbers: state clock.system and clock.unit"
    options = PoseQuaternionsOptions

    def sniff(self, path: Path) -> bool:
        """True if stamp, quaternion and translation are there and no column holds words."""
        try:
            table = _open(path, TextOptions())
            _columns(table.names, PoseQuaternionsOptions(), path)
            return table.looks_like_poses()
        except FormatError:
            return False

    def header(self, source: LogSource) -> LogHeader:
        """Check columns, clock, CRS and axes."""
        plan = _plan(source)
        return LogHeader({"world_frame": plan.placement.world, "stamp": plan.columns["stamp"], "axes": plan.axes})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream poses; a record that is no pose is rejected."""
        plan = _plan(source)
        reader = PoseReader(source, plan.clock, plan.placement)
        for block in plan.table.blocks(plan.columns, plan.clock.unit):
            if isinstance(block, Reject):
                yield block
                continue
            sieve = Sieve(block.records.size)
            sieve.drop(block.without_stamp, "time stamp is missing")
            attitude = quaternion_product(unit_quaternions(block.quaternion, sieve), plan.sensor_from_body)
            if plan.is_level:
                attitude = quaternion_product(_NED_FROM_ENU, attitude)
            raw = RawPoses(block.records, block.offsets, block.stamps, block.translation, attitude, {})
            yield from reader.items(raw, sieve)


@dataclass(frozen=True)
class _Plan:
    """How a file is read."""

    table: _Table
    columns: dict[str, str]
    clock: Clock
    placement: Placement
    is_level: bool
    """The placement wants north-east-down from body."""
    axes: str
    sensor_from_body: Float64


def _plan(source: LogSource) -> _Plan:
    options = options_of(source, PoseQuaternionsOptions)
    table = _open(source.path, options)
    columns, stamp = _columns(table.names, options, source.path)
    axes = options.axes
    if axes is None and source.path.name == AV2_NAME and set(table.names) == set(AV2_COLUMNS):
        axes = AV2_AXES
    clock = source.need_clock("unix_utc", unit=table.stamp_unit(stamp))
    need_stamp_unit(stamp, clock, source.path)
    crs = source.need_crs("local")
    is_level = crs != LOCAL_WORLD and crs_from_text(crs).is_projected
    return _Plan(
        table=table,
        columns=columns,
        clock=clock,
        placement=level_placement(source, options.heading) if is_level else WorldPlacement(crs, source.path),
        is_level=is_level,
        axes=axes or "",
        sensor_from_body=body_quaternion(axes, source.path),
    )


def _columns(names: tuple[str, ...], options: PoseQuaternionsOptions, file: Path) -> tuple[dict[str, str], Found]:
    """Return the column of each part of a pose, and the stamp's with the unit in its name."""
    check_keys(options.columns, ("stamp", *QUATERNION, *TRANSLATION), file)
    written = {_plain(name): name for name in names}
    stated = {part: _plain(name) for part, name in options.columns.items()}
    stamp = stamp_column(stated.get("stamp"), tuple(written), STAMPS, file)
    found = {"stamp": written[stamp.column]}
    for part in (*QUATERNION, *TRANSLATION):
        stems = (part, part[1:], *_GRID_NAMES[part]) if part in TRANSLATION else (part,)
        known = (name for stem in stems for name in ((stem, f"{stem}_m") if part in TRANSLATION else (stem,)))
        found[part] = written[named_column(part, stated.get(part), known, tuple(written), file)]
    return found, replace(stamp, column=found["stamp"])


def _plain(name: str) -> str:
    """Return a column's name with its bracketed unit as an ending (timestamp [ns]: timestamp_ns), EuRoC's as TUM's."""
    unit = _BRACKETS.search(name)
    stem = name if unit is None else name[: unit.start()]
    euroc = _EUROC.fullmatch(stem)
    if euroc is not None:
        return f"{'t' if euroc[1] == 'p' else 'q'}{euroc[2]}"
    return stem if unit is None or not unit[1] else f"{stem}_{unit[1]}"


# --- the three containers ---------------------------------------------------------------------------


@dataclass(frozen=True)
class _Block:
    """Poses of consecutive records."""

    records: Int64
    offsets: Int64
    stamps: npt.NDArray[np.generic]
    without_stamp: npt.NDArray[np.bool_]
    quaternion: Float64
    """(4, n), scalar first."""
    translation: Float64
    """(3, n) metres."""


class _Table(ABC):
    """A file with named columns in any of the containers."""

    names: tuple[str, ...]

    @abstractmethod
    def looks_like_poses(self) -> bool:
        """Return True if no column contains words, and numbers without names look like poses."""

    @abstractmethod
    def stamp_unit(self, stamp: Found) -> str:
        """Return the likely unit of the stamps, for a proposal."""

    @abstractmethod
    def blocks(self, columns: Mapping[str, str], unit: str) -> Iterator[_Block | Reject]:
        """Yield the columns of stamp (in `unit`), quaternion and translation."""


class _Text(_Table):
    """CSV with column names, or TUM without."""

    def __init__(self, path: Path, options: TextOptions) -> None:
        self._path = path
        delimiter, words = first_words(path, options)
        is_named = set(QUATERNION) <= {_plain(word) for word in words}
        words = words if is_named else first_record(path, options)
        self._tum = options.names is None and delimiter == " " and len(words) == len(TUM_NAMES) and _are_numbers(words)
        named = options.model_copy(update={"names": list(TUM_NAMES)}) if self._tum else options
        self._layout = text_layout(path, named)
        self.names = self._layout.names

    def looks_like_poses(self) -> bool:
        lines = first_fields(self._path, self._layout, 5)
        if not all(_are_numbers(fields) for fields in lines):
            return False
        if not self._tum:
            return True
        values = np.array(lines, dtype=np.float64).reshape(-1, len(TUM_NAMES))
        with np.errstate(over="ignore"):
            length = np.linalg.norm(values[:, 4:], axis=1)
        return len(lines) > 0 and bool(np.all(np.abs(length - 1) < 1e-3))

    def stamp_unit(self, stamp: Found) -> str:
        return first_unit(self._path, self._layout, stamp)

    def blocks(self, columns: Mapping[str, str], unit: str) -> Iterator[_Block | Reject]:
        kinds: dict[str, Kind] = {columns[part]: "number" for part in (*QUATERNION, *TRANSLATION)}
        stamp = columns["stamp"]
        kinds[stamp] = number_stamp_kind(self._path, self._layout, stamp, unit)
        for block in text_blocks(self._path, self._layout, kinds):
            if isinstance(block, Reject):
                yield block
                continue
            yield _Block(
                records=block.records,
                offsets=block.offsets,
                stamps=block.stamps(stamp),
                without_stamp=np.zeros(block.records.size, dtype=bool),  # NaN, or rejected with its line
                quaternion=np.stack([block.number(columns[part]) for part in QUATERNION]),
                translation=np.stack([block.number(columns[part]) for part in TRANSLATION]),
            )


class _Columnar(_Table):
    """Arrow IPC (Feather) or Parquet."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._table = need_table(path)
        self.names = tuple(self._table.schema.names)

    def looks_like_poses(self) -> bool:
        return all(is_number(field.type) for field in self._table.schema)

    def stamp_unit(self, stamp: Found) -> str:
        if stamp.unit in UNIT_NS:
            return stamp.unit
        first = next((part for _, part in self._table.parts(BATCH_ROWS, [stamp.column])), None)
        if first is None or isinstance(first, Lost) or not is_number(first.schema.field(0).type):
            return "s"
        return likely_unit(np.asarray(first.column(0).cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False)))

    def blocks(self, columns: Mapping[str, str], unit: str) -> Iterator[_Block | Reject]:
        for name in columns.values():
            kind = self._table.schema.field(name).type
            if not is_number(kind):
                raise FormatError(f"column '{name}' is {kind}", expected="numbers", file=self._path)
        for first, part in self._table.parts(BATCH_ROWS, list(columns.values())):
            if isinstance(part, Lost):
                yield Reject(part.reason, first, records=max(part.records, 1))
            else:
                yield _columnar_block(part, columns, first)


def _open(path: Path, options: TextOptions) -> _Table:
    """Open a file of any of the three containers."""
    try:
        with path.open("rb") as stream:
            magic = stream.read(6)
    except OSError as error:
        raise FormatError(f"the file cannot be read: {error}", file=path) from error
    if magic == b"ARROW1" or magic.startswith(b"PAR1"):
        return _Columnar(path)
    return _Text(path, options)


def _columnar_block(batch: pa.RecordBatch, columns: Mapping[str, str], first: int) -> _Block:
    def number(part: str) -> Float64:
        return np.asarray(batch.column(columns[part]).cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False))

    stamps = batch.column(columns["stamp"])
    kind = pa.float64() if pa.types.is_floating(stamps.type) else pa.int64()
    without = np.asarray(stamps.is_null())
    return _Block(
        records=np.arange(first, first + batch.num_rows, dtype=np.int64),
        offsets=np.full(batch.num_rows, -1, dtype=np.int64),
        stamps=np.asarray(stamps.cast(kind, safe=False).fill_null(0).to_numpy(zero_copy_only=False)),
        without_stamp=without,
        quaternion=np.stack([number(part) for part in QUATERNION]),
        translation=np.stack([number(part) for part in TRANSLATION]),
    )


def _are_numbers(words: Iterable[str]) -> bool:
    try:
        return bool(np.all(np.isfinite([float(word) for word in words])))
    except ValueError:
        return False
