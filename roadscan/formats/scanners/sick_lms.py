"""SICK LMS 2xx: a byte log of the scanner's serial line.

Telegrams are found by their CRC (`sick_telegrams.py`), so a log may begin anywhere and be damaged
anywhere: what lies between two sound telegrams is one entry of `rejects`, and counts as as many telegrams as would
fit into it. Measured values are read from 0xB0 (all values), 0xB7 (a part of them) and 0xC4 (with remission, which
becomes the intensity); means over several scans (0xB6, 0xBF) and all that holds no measured values are listed in
`rejects` by their command. A scanner's ACK or NAK and a host's requests are no damage.

**When.** The telegrams hold no time. Either the log's options name a CSV of stamps, or they state the first stamp and
the rate, or each telegram stands behind an 8-byte stamp (little-endian int64, in the clock's unit), which is a
layout of roadscan's own: no logger's layout is common enough to be called usual. A stamp means the first reading of
its scan; where a host stamped telegrams as they arrived, `clock.offset_s` takes back the scan and its transmission
(a scan of 361 values takes 14.6 ms at 500 kBd, and 190 ms at 38.4 kBd).

**Where.** A scanner counts its readings from its right to its left, seen from behind it with its lid up. In the
frame that roadscan gives it, z points along the middle reading, y towards the first reading, x out of the lid, and
reading i lies at the angle field / 2 − i · resolution from z towards y. So a scanner that looks down at the road, lid
forward, first reading to the right, has the axes of the body, ``axes = "frd"``; lid backward, the same with
``boresight = { heading_deg = 180 }``. One that stands upright and looks forward has
``body_from_sensor = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]``.

**Turns.** The mirror turns 75 times a second, and the laser fires once a degree. A scan at 1° is half a turn, 6.67 ms.
One at 0.5° takes two turns and one at 0.25° four, each turn beginning one step later; at 100 km/h the vehicle drives
0.37 m from one turn to the next. So every turn becomes a separate row, with its epoch, and 0 (no return) where
the other turns measured. That the turns of a complete scan come in the order of their angles is an assumption; partial
scans state their angle themselves. The mirror's variation of speed is not modelled.

The values' codes for "no range" become 0. Their flag bits (fields, dazzle, reflectors) and the scans' status bytes are
not kept; scans whose status says error or implausible are listed in `rejects`.
"""

from __future__ import annotations

import csv
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from typing import Any, ClassVar, Final, Literal

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from pydantic import Field

from roadscan.compute.array_types import Bool, Int64, UInt8, UInt16
from roadscan.core.errors import ConfigError, FormatError, Missing, nearest
from roadscan.core.gpstime import NS_PER_S, UNIT_NS, Clock, TimeSystem
from roadscan.core.rig import ScanGeometry
from roadscan.core.strict import Strict
from roadscan.formats.scanners.sick_telegrams import (
    ACKNOWLEDGES,
    ALL_VALUES,
    COUNT_MASK,
    FROM_SCANNER,
    MEAN_SUBRANGE,
    MEAN_VALUES,
    MEASURED,
    OVERHEAD_BYTES,
    PARTIAL_BIT,
    QUARTER_BIT,
    STAMP_BYTES,
    SUBRANGE,
    UNITS,
    VALUES_AND_REMISSION,
    Piece,
    find_telegrams,
    read_pieces,
)
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Provisional, Reject, Rows, beside
from roadscan.ingest.reading.records import EpochReader, Sieve, options_of

READ: Final = (ALL_VALUES, SUBRANGE, VALUES_AND_REMISSION)
"""Commands whose values are read."""
FIELDS_DEG: Final = {181: (180, 1.0), 361: (180, 0.5), 721: (180, 0.25), 101: (100, 1.0), 201: (100, 0.5),
                     401: (100, 0.25)}  # fmt: skip
"""Field and resolution (degrees) by readings of a complete scan: the settings that the family offers."""
STEP_M: Final = {"cm": 0.01, "mm": 0.001}  # metres in each unit

_CODES: Final = 9
"""Highest values that are no ranges: too far, channel, noise, overflow, dazzled, invalid (listing, page 124)."""
_ERROR_LEVEL: Final = 3  # status levels from this on are errors
_IMPLAUSIBLE: Final = 0x40  # status bit of implausible values
_SNIFFED_BYTES: Final = 1 << 16  # bytes from which the format is recognised
_SEARCHED_BYTES: Final = 16 << 20
"""A log without a telegram of measured values in its first bytes, this many, is refused."""
_MOST_LAYOUTS: Final = 32  # usual layouts of a piece that are read
_BATCH_READINGS: Final = 1 << 21  # readings of a batch
_LARGEST_STAMPS_BYTES: Final = 1 << 28  # larger CSV files of stamps are refused
_ACK_BYTES: Final = 8  # shorter gaps may be a scanner's answer

_BY_RATE: Final = (Missing("options.first_stamp_s"), Missing("options.scans_per_s"))


class SickLmsOptions(Strict):
    """Settings of a SICK LMS 2xx log."""

    stamps: Path | None = None
    """CSV with the stamps of the scans in the log's clock, relative to the log's folder: line by line in the log's
    order, damaged scans included, or found by `offset_column`."""
    stamp_column: str = "stamp"
    """Column of that CSV with the stamp."""
    offset_column: str | None = None
    """Column of that CSV with the byte of the log at which the scan's telegram starts, where it has one: stamps
    then cannot slip, whatever is lost."""
    first_stamp_s: float | None = Field(default=None, allow_inf_nan=False)
    """Stamp of the first scan in the log's clock (s), where there are no others."""
    scans_per_s: float | None = Field(default=None, gt=0, le=10_000, allow_inf_nan=False)
    """Scans a second that follow `first_stamp_s`: 75 at 1°, 37.5 at 0.5°, 18.75 at 0.25°, 75 for partial scans."""
    stamped: bool = False
    """Each telegram stands behind its stamp: 8 bytes, little-endian int64, in the clock's unit."""
    field_deg: float | None = Field(default=None, gt=0, le=360)
    """Field of view (degrees). Without it 181, 361 and 721 readings mean 180°, and 101, 201 and 401 mean 100°; a
    variant of 90° has to state it. Needed with `resolution_deg` where a log holds parts of scans (0xB7) only."""
    resolution_deg: float | None = Field(default=None, gt=0, le=10)
    """Step from reading to reading of the complete field (degrees), where it does not follow from their count."""
    turns: int | None = Field(default=None, ge=1, le=8)
    """Turns of the mirror that a complete scan takes; 1° over the resolution where left out. A variant that
    measures every 0.5° in one turn (-S14) has 1."""
    mirror_hz: float = Field(default=75.0, gt=0, allow_inf_nan=False)
    """Turns of the mirror a second."""
    range_bits: Literal[13, 14, 15, 16] | None = None
    """Bits of a value that are its range, by the scanner's measuring mode: 13 in the 8 m and 80 m modes, whose other
    three bits are flags, 14 in the 16 m modes, 15 in the 32 m modes, 16 in "32 m immediate". The telegrams do not
    say; where left out it is 13, and a value with one of the other bits set is refused."""


class SickLms(LogFormat):
    """The serial line of a SICK LMS 200, 211, 220, 221 or 291, byte by byte."""

    name: ClassVar[str] = "sick_lms"
    title: ClassVar[str] = "SICK LMS 2xx telegrams: a byte log of the scanner's serial line"
    yields: ClassVar[tuple[str, ...]] = ("scans",)
    axes_on_sensor: ClassVar[str] = "z points along the middle reading, y to the first reading's side, x out of the lid"
    usual_axes: ClassVar[Mapping[str, str]] = {
        "frd": "it looks down at the road, lid forward, first reading to the right",
        "bld": "it looks down at the road, lid backward, first reading to the left",
        "urf": "it stands upright, lid up, and looks ahead",
    }
    time: ClassVar[str] = (
        "none in the telegrams: options.stamps (a CSV), options.first_stamp_s with options.scans_per_s, or "
        "options.stamped, in the clock that the survey file states"
    )
    options: ClassVar[type[Strict]] = SickLmsOptions
    provisional: ClassVar[tuple[Provisional, ...]] = (
        Provisional(Clock(TimeSystem.FREE), options={"first_stamp_s": 0.0, "scans_per_s": 75.0}),
        Provisional(Clock(TimeSystem.FREE, unit="ns"), options={"stamped": True}),
    )

    def sniff(self, path: Path) -> bool:
        """True for a file that holds a telegram with measured values and a valid CRC near its beginning."""
        try:
            if not path.is_file():
                return False
            with path.open("rb") as stream:
                data = np.frombuffer(stream.read(_SNIFFED_BYTES), dtype=np.uint8)
        except OSError:
            return False
        starts, ends, _ = find_telegrams(data, is_end=True)
        return bool(_Fields.of(Piece(data, 0, starts, ends)).fit().any())

    def companions(self, path: Path, options: Strict) -> list[Path]:
        """Return the CSV of stamps."""
        stamps = options.stamps if isinstance(options, SickLmsOptions) else None
        return [] if stamps is None else [beside(path, stamps)]

    def header(self, source: LogSource) -> LogHeader:
        """Return field, resolution, unit and framing, from the first telegrams with measured values."""
        options = options_of(source, SickLmsOptions)
        _check_time(source, options)
        for piece in read_pieces(source.path):
            fields = _Fields.of(piece)
            fitting = fields.fit()
            if fitting.any():
                return _header(source, options, piece, fields, fitting)
            if piece.offset > _SEARCHED_BYTES:
                break
        raise FormatError(
            f"the file's first {_SEARCHED_BYTES >> 20} MB hold no telegram with measured values",
            expected="telegrams 0xB0, 0xB7 or 0xC4 with a valid CRC",
            file=source.path,
        )

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Yield scans, one row for each turn of the mirror."""
        options = options_of(source, SickLmsOptions)
        reader = _Reader(source, options, _Layout(**header.attributes["layout"]))
        for piece in read_pieces(source.path):
            yield from reader.items(piece)
        yield from reader.rest(source.path.stat().st_size)


# --- what the telegrams say ------------------------------------------------------------------------


@dataclass(frozen=True)
class _Fields:
    """Fields of a piece's telegrams, (n,) each."""

    command: Int64
    payload: Int64
    """Bytes from the command to the status byte."""
    count: Int64
    unit: Int64
    quarter: Int64
    """First angle of a partial scan in quarters of a degree, −1 for complete ones."""
    first: Int64
    """Index of the first value in the complete scan."""
    values_at: Int64
    """Byte of the piece at which the values start."""
    remissions: Int64
    """Number of remissions; 0 for commands without."""
    first_remission: Int64
    status: Int64

    @classmethod
    def of(cls, piece: Piece) -> _Fields:
        """Read the fields from the bytes; :meth:`fit` checks them."""
        command = piece.commands().astype(np.int64)
        is_part, is_bright = command == SUBRANGE, command == VALUES_AND_REMISSION
        word_at = piece.starts + np.where(is_part, 9, 5)
        word = piece.words(word_at)
        count = word & COUNT_MASK
        behind = word_at + 2 + 2 * count
        partial = (word >> PARTIAL_BIT) & 1
        return cls(
            command=np.where(piece.data[piece.starts + 1] == FROM_SCANNER, command, -1),
            payload=piece.ends - piece.starts - OVERHEAD_BYTES,
            count=count,
            unit=word >> 14,
            quarter=np.where(partial == 1, (word >> QUARTER_BIT) & 3, -1),
            first=np.where(is_part, piece.words(piece.starts + 5) - 1, 0),
            values_at=word_at + 2,
            remissions=np.where(is_bright, piece.words(behind) & COUNT_MASK, 0),
            first_remission=np.where(is_bright, piece.words(behind + 2) - 1, 0),
            status=piece.data[piece.ends - 3].astype(np.int64),
        )

    def fit(self) -> Bool:
        """Return (n,) True for telegrams of measured values whose counts agree with their length."""
        is_part, is_bright = self.command == SUBRANGE, self.command == VALUES_AND_REMISSION
        needed = 4 + 2 * self.count + np.where(is_part, 4, 0) + np.where(is_bright, 6 + self.remissions, 0)
        known = np.isin(self.command, READ) & (self.count > 0) & (self.unit < len(UNITS))
        # One more byte, between values and status, where the scanner counts its scans.
        whole = (self.payload == needed) | (self.payload == needed + 1)
        placed = (self.first >= 0) & (self.first_remission >= 0) & ~(is_part & (self.quarter >= 0))
        return np.asarray(known & whole & placed)


@dataclass(frozen=True)
class _Layout:
    """How the scans of a log are converted to rows."""

    unit: str
    readings: int
    """Readings of the complete field."""
    resolution_deg: float
    turns: int
    turn_ns: int
    telegram_bytes: int
    """Length of the log's usual telegram."""

    def entries(self, command: int, count: int, first: int, quarter: int) -> Int64 | None:
        """Return the places (count,) of a telegram's values in the complete field; None where they do not fit."""
        start, step = first, 1
        if quarter >= 0:
            begin, stride = quarter * 0.25 / self.resolution_deg, 1.0 / self.resolution_deg
            if not (begin.is_integer() and stride.is_integer() and begin < stride):
                return None
            start, step = int(begin), int(stride)
        places = np.arange(start, self.readings, step)
        fits = count <= places.size if command == SUBRANGE else count == places.size
        return places[:count] if fits else None


def _header(
    source: LogSource, options: SickLmsOptions, piece: Piece, fields: _Fields, fitting: Bool
) -> LogHeader:  # fmt: skip
    rows = np.flatnonzero(fitting)
    pairs = np.stack([fields.unit, fields.count, fields.command, fields.quarter >= 0], axis=-1)[rows]
    usual, number = np.unique(pairs, axis=0, return_counts=True)
    unit, count, command, is_partial = (int(v) for v in usual[np.argmax(number)])
    quarters = fields.quarter[rows]
    field_deg, resolution_deg = _field(source, options, count, command, quarters[quarters >= 0] if is_partial else None)
    readings = round(field_deg / resolution_deg) + 1
    turns = options.turns or max(1, round(1.0 / resolution_deg))
    turn_ns = round(NS_PER_S / options.mirror_hz)
    lengths = (piece.ends - piece.starts)[rows]
    _check_framing(source, options, piece)
    geometry = ScanGeometry(
        kind="polar",
        readings=readings,
        first=np.radians(field_deg / 2),
        step=-np.radians(resolution_deg),
        range_step_m=STEP_M[UNITS[unit]],
        reading_period_ns=NS_PER_S / options.mirror_hz * resolution_deg / 360.0,
    )
    layout = _Layout(UNITS[unit], readings, resolution_deg, turns, turn_ns, int(np.median(lengths)))
    attributes = {"scan_geometry": geometry.model_dump(mode="json"), "layout": dict(vars(layout))}
    return LogHeader(attributes, list_size=readings)


def _field(
    source: LogSource, options: SickLmsOptions, count: int, command: int, quarters: Int64 | None
) -> tuple[float, float]:
    """Return field and resolution (degrees): as stated, or by the count of readings."""
    field_deg, resolution_deg = options.field_deg, options.resolution_deg
    if command != SUBRANGE:
        known = FIELDS_DEG.get(count)
        if quarters is not None:  # every turn measures each degree; its quarter shows which turns exist
            whole = {181: 180, 180: 180, 101: 100, 100: 100}.get(count)
            step = 0.25 if (quarters % 2 == 1).any() else 0.5
            known = None if whole is None else (whole, step)
        if field_deg is not None and resolution_deg is None and quarters is None and count > 1:
            resolution_deg = field_deg / (count - 1)
        if known is not None:
            field_deg = known[0] if field_deg is None else field_deg
            resolution_deg = known[1] if resolution_deg is None else resolution_deg
    if field_deg is None or resolution_deg is None:
        raise ConfigError(
            f"the field of view does not follow from {count} readings of telegrams 0x{command:02X}",
            change="state both, as the scanner was set",
            file=source.path,
            missing=[[Missing("options.field_deg"), Missing("options.resolution_deg")]],
        )
    steps = field_deg / resolution_deg
    if abs(steps - round(steps)) > 1e-6 or (quarters is None and command != SUBRANGE and round(steps) + 1 != count):
        raise ConfigError(
            f"a field of {field_deg:g}° at {resolution_deg:g}°, and scans of {count} readings",
            expected=f"{steps + 1:g} readings",
            change="correct options.field_deg and options.resolution_deg",
            file=source.path,
        )
    return field_deg, resolution_deg


def _check_time(source: LogSource, options: SickLmsOptions) -> None:
    """Check that exactly one source of stamps is stated, and a clock."""
    by_rate = options.first_stamp_s is not None or options.scans_per_s is not None
    sources = {"stamps": options.stamps is not None, "stamped": options.stamped, "first_stamp_s, scans_per_s": by_rate}
    stated = [name for name, is_stated in sources.items() if is_stated]
    if len(stated) != 1:
        count = {0: "no source", 2: "two sources", 3: "three sources"}[len(stated)]
        raise ConfigError(
            f"the telegrams hold no time, and the options state {count} of it"
            + (f" ({', '.join(stated)})" if stated else ""),
            file=source.path,
            missing=[Missing("options.stamps"), _BY_RATE, Missing("options.stamped", True)],
        )
    if by_rate and (options.first_stamp_s is None or options.scans_per_s is None):
        raise ConfigError(
            "options.first_stamp_s and options.scans_per_s belong together", expected="both", file=source.path
        )
    source.need_clock("unix_utc")


def _check_framing(source: LogSource, options: SickLmsOptions, piece: Piece) -> None:
    """Refuse bare telegrams that are read as stamped, and the reverse."""
    gaps = piece.starts[1:] - piece.ends[:-1]
    if gaps.size == 0:
        return
    if options.stamped and np.median(gaps) == 0:
        raise ConfigError(
            "options.stamped = true, and telegrams follow each other without a byte between",
            expected=f"{STAMP_BYTES} bytes of stamp before each telegram",
            change="state options.stamps, or options.first_stamp_s with options.scans_per_s",
            file=source.path,
            missing=[Missing("options.stamps"), _BY_RATE],
        )
    if not options.stamped and 2 * np.count_nonzero(gaps == STAMP_BYTES) > gaps.size:
        raise ConfigError(
            f"{STAMP_BYTES} bytes stand before each telegram",
            expected="bare telegrams, or options.stamped = true, if they are stamps",
            file=source.path,
            missing=Missing("options.stamped", True),
        )


# --- stamps ----------------------------------------------------------------------------------------


class _Stamps(ABC):
    """Source of the scans' stamps."""

    @abstractmethod
    def of(self, piece: Piece, scans: Int64, gaps: Int64) -> tuple[Int64, Bool]:
        """Return stamps (n,) of a piece's telegrams in the clock's unit, and which are missing.

        Parameters
        ----------
        scans : (n,) number of each telegram among the log's scans.
        gaps : (n,) bytes between each telegram and the one before.
        """

    def finish(self, scans: int) -> None:  # noqa: B027 — most have nothing to check
        """Check that the log's number of `scans` matches the stamps."""


class _Rate(_Stamps):
    """A first stamp and a rate; the clock counts nanoseconds."""

    def __init__(self, first_s: float, per_s: float) -> None:
        self._first_ns = round(Decimal(repr(first_s)) * NS_PER_S)
        self._period_ns = NS_PER_S / per_s

    def of(self, piece: Piece, scans: Int64, gaps: Int64) -> tuple[Int64, Bool]:
        return self._first_ns + np.rint(scans * self._period_ns).astype(np.int64), np.zeros(scans.size, dtype=bool)


class _InLog(_Stamps):
    """Eight bytes before each telegram."""

    def of(self, piece: Piece, scans: Int64, gaps: Int64) -> tuple[Int64, Bool]:
        missing = (gaps < STAMP_BYTES) | (piece.starts < STAMP_BYTES)
        at = np.where(missing, 0, piece.starts - STAMP_BYTES)
        return _gathered(piece.data, at, STAMP_BYTES).view("<i8")[:, 0].astype(np.int64), missing


class _Csv(_Stamps):
    """A CSV beside the log, by the scans' order or their telegrams' first byte; ns of the clock's count."""

    def __init__(self, file: Path, options: SickLmsOptions, unit_ns: int) -> None:
        self._file = file
        self._offsets, self._stamps = _read_stamps(file, options, unit_ns)

    def of(self, piece: Piece, scans: Int64, gaps: Int64) -> tuple[Int64, Bool]:
        if self._offsets is None:
            at = np.minimum(scans, self._stamps.size - 1)
            return self._stamps[at], scans >= self._stamps.size
        wanted = piece.offset + piece.starts
        at = np.minimum(np.searchsorted(self._offsets, wanted), self._offsets.size - 1)
        return self._stamps[at], self._offsets[at] != wanted

    def finish(self, scans: int) -> None:
        if self._offsets is None and scans != self._stamps.size:
            raise FormatError(
                f"{self._stamps.size} stamps for {scans} scans",
                expected="a stamp for each scan; otherwise all those behind the first lost one would be wrong",
                change="give the CSV a column with the byte at which each telegram starts, and name it as "
                "options.offset_column",
                file=self._file,
            )


def _read_stamps(file: Path, options: SickLmsOptions, unit_ns: int) -> tuple[Int64 | None, Int64]:
    """Return offsets (n,), ascending, if there are any, and stamps (n,) in ns."""
    wanted = [options.stamp_column] + ([] if options.offset_column is None else [options.offset_column])
    stamps: list[int] = []
    offsets: list[int] = []
    try:
        if file.stat().st_size > _LARGEST_STAMPS_BYTES:
            raise FormatError("the file is far larger than stamps of scans", expected="options.stamps", file=file)
        with file.open(encoding="utf-8-sig", errors="replace", newline="") as stream:
            rows = csv.reader(line.replace("\0", "") for line in stream)
            names = [name.strip() for name in next(rows, [])]
            for name in wanted:
                if name not in names:
                    raise ConfigError(
                        f"there is no column '{name}'{nearest(name, names)}",
                        expected="one of: " + ", ".join(names)[:500],
                        change="set options.stamp_column and options.offset_column",
                        file=file,
                    )
            places = [names.index(name) for name in wanted]
            for number, row in enumerate(filter(None, rows)):
                stamps.append(_stamp_ns(row, places[0], unit_ns, file, number))
                if len(places) > 1:
                    offsets.append(_stamp_ns(row, places[1], 1, file, number))
    except (OSError, csv.Error) as error:
        raise FormatError(f"the stamps cannot be read: {error}", expected="options.stamps, a CSV", file=file) from error
    if not stamps:
        raise FormatError("the file holds no stamp", expected="a stamp a scan", file=file)
    if not offsets:
        return None, np.array(stamps, dtype=np.int64)
    order = np.argsort(np.array(offsets, dtype=np.int64), kind="stable")
    return np.array(offsets, dtype=np.int64)[order], np.array(stamps, dtype=np.int64)[order]


def _stamp_ns(row: list[str], place: int, unit_ns: int, file: Path, number: int) -> int:
    """Return a number of a CSV; an invalid one would shift all that follow, so it is a fault of the file."""
    try:
        value = Decimal(row[place].strip()) * unit_ns
        if abs(value) < 2**62:
            return round(value)
    except (IndexError, ValueError, ArithmeticError):
        pass
    raise FormatError(
        f"'{','.join(row)[:60]}' holds no stamp", expected="a number in each line", file=file, record=number
    )


# --- telegrams to rows -----------------------------------------------------------------------------


class _Reader:
    """Converts telegrams to rows; counts the log's telegrams from piece to piece."""

    def __init__(self, source: LogSource, options: SickLmsOptions, layout: _Layout) -> None:
        clock = source.need_clock("unix_utc")
        self._file = source.path
        self._layout = layout
        self._bits = options.range_bits
        self._stamped = options.stamped
        if options.stamped:
            self._stamps: _Stamps = _InLog()
        elif options.stamps is not None:
            self._stamps = _Csv(beside(source.path, options.stamps), options, UNIT_NS[clock.unit])
        else:
            self._stamps = _Rate(options.first_stamp_s or 0.0, options.scans_per_s or 1.0)
        self._epochs = EpochReader(clock if options.stamped else replace(clock, unit="ns"), source.path)
        self._end = 0
        self._records = 0
        self._scans = 0

    def items(self, piece: Piece) -> Iterator[Item]:
        """Yield rows of a piece's sound scans, and rejects of other telegrams and of damage between them."""
        n = piece.starts.size
        if n == 0:
            return
        starts = piece.offset + piece.starts
        gaps = starts - np.concatenate([[self._end], piece.offset + piece.ends[:-1]])
        lost = self._lost(piece, gaps)
        first = self._records + np.arange(n) + np.cumsum(lost) - lost
        for k in np.flatnonzero(lost).tolist():
            yield self._damage(int(starts[k] - gaps[k]), self._between(int(gaps[k])), int(first[k]))
        fields = _Fields.of(piece)
        is_scan = np.isin(fields.command, MEASURED)
        records = self._records + np.arange(n) + np.cumsum(lost)
        scans = self._scans + np.cumsum(lost + is_scan) - is_scan
        self._end = piece.offset + int(piece.ends[-1])
        self._records, self._scans = int(records[-1]) + 1, int(scans[-1]) + int(is_scan[-1])
        yield from self._read(piece, fields, scans, records, gaps)

    def rest(self, size: int) -> Iterator[Item]:
        """Yield the damage at the log's end, `size` bytes from its start."""
        left = self._between(size - self._end)
        if left > 0:
            lost = self._damage(self._end, left, self._records)
            self._scans += lost.records
            yield lost
        self._stamps.finish(self._scans)

    def _between(self, gap: int) -> int:
        """Return the bytes of a gap that are no stamp."""
        return gap - STAMP_BYTES if self._stamped and gap >= STAMP_BYTES else gap

    def _lost(self, piece: Piece, gaps: Int64) -> Int64:
        """Return (n,) telegrams that may be lost in the damage before each one."""
        stretch = gaps - np.where((gaps >= STAMP_BYTES) & self._stamped, STAMP_BYTES, 0)
        others = np.concatenate([[0], np.cumsum(~np.isin(piece.data, ACKNOWLEDGES))])
        begins = np.maximum(piece.starts - gaps, 0)
        stretch[(gaps <= _ACK_BYTES) & (others[piece.starts] == others[begins])] = 0
        likely = np.rint(stretch / self._layout.telegram_bytes).astype(np.int64)
        return np.where(stretch > 0, np.maximum(likely, 1), 0)

    def _damage(self, offset: int, size: int, record: int) -> Reject:
        lost = max(1, round(size / self._layout.telegram_bytes))
        return Reject(f"{size} bytes are no telegram with a valid CRC", record, offset, lost)

    def _read(self, piece: Piece, fields: _Fields, scans: Int64, records: Int64, gaps: Int64) -> Iterator[Item]:
        sieve = Sieve(records.size)
        sieve.good &= fields.command >= 0  # a host's requests are no loss
        self._drop_others(fields, sieve)
        layouts = self._layouts(fields, sieve)
        stamps, missing = self._stamps.of(piece, scans, gaps)
        sieve.drop(missing, "the telegram has no stamp")
        epochs = self._epochs.epochs(stamps, sieve, records) if sieve.good.any() else stamps
        yield from sieve.rejects(records, piece.offset + piece.starts)
        for rows, entries in layouts:
            kept = rows[sieve.good[rows]]
            step = max(1, _BATCH_READINGS // (self._layout.readings * self._layout.turns))
            for first in range(0, kept.size, step):
                part = kept[first : first + step]
                batch = self._batch(piece, fields, part, entries, epochs[part])
                yield Rows("scans", batch, first_record=int(records[part[0]]),
                           first_offset=piece.offset + int(piece.starts[part[0]]))  # fmt: skip

    def _drop_others(self, fields: _Fields, sieve: Sieve) -> None:
        """Drop telegrams without measured values of one scan, and those that the scanner marks as faulty."""
        for command in np.unique(fields.command[sieve.good]).tolist():
            if command in (MEAN_VALUES, MEAN_SUBRANGE):
                sieve.drop(fields.command == command, f"telegram 0x{command:02X}: means over several scans")
            elif command not in READ:
                sieve.drop(fields.command == command, f"telegram 0x{command:02X}: no measured values")
        sieve.drop(~fields.fit(), "the telegram's counts do not agree with its length")
        other = np.array([unit != self._layout.unit for unit in (*UNITS, "", "")])
        sieve.drop(other[fields.unit], f"the values are not in {self._layout.unit}, as the log's first are")
        sieve.drop((fields.status & 7) >= _ERROR_LEVEL, "the scanner reports an error")
        sieve.drop((fields.status & _IMPLAUSIBLE) != 0, "the scanner calls the values implausible")

    def _layouts(self, fields: _Fields, sieve: Sieve) -> list[tuple[Int64, Int64]]:
        """Return sound telegrams by layout: rows, and places of their values in the complete field."""
        rows = np.flatnonzero(sieve.good)
        if rows.size == 0:
            return []
        named = (fields.command, fields.count, fields.first, fields.quarter, fields.remissions, fields.first_remission)
        kinds, of_row, number = np.unique(
            np.stack(named, axis=-1)[rows], axis=0, return_inverse=True, return_counts=True
        )
        of_row = of_row.reshape(-1)
        found: list[tuple[Int64, Int64]] = []
        usual = np.argsort(-number, kind="stable")[:_MOST_LAYOUTS]
        is_rare = _mask(sieve.good.size, rows[~np.isin(of_row, usual)])
        sieve.drop(is_rare, "the extent of the scans changes too often")
        for kind in usual.tolist():
            command, count, first, quarter, remissions, first_remission = kinds[kind].tolist()
            own = rows[of_row == kind]
            entries = self._layout.entries(command, count, first, quarter)
            if entries is None or first_remission + remissions > self._layout.readings:
                sieve.drop(_mask(sieve.good.size, own), f"{count} values do not fit the field of the log's first scans")
            else:
                found.append((own, entries))
        return found

    def _batch(self, piece: Piece, fields: _Fields, rows: Int64, entries: Int64, epochs: Int64) -> pa.RecordBatch:
        """Return the rows of telegrams (k,) of one layout: one for each turn in which their values were measured."""
        readings, turns = self._layout.readings, self._layout.turns
        values = _gathered(piece.data, fields.values_at[rows], 2 * entries.size).view("<u2")
        kept = self._ranges(values)
        is_partial = fields.quarter[rows[0]] >= 0
        turn_of = np.zeros_like(entries) if is_partial else entries % turns
        used = np.unique(turn_of)
        ranges = np.zeros((rows.size, used.size, readings), dtype=np.uint16)
        for k, turn in enumerate(used.tolist()):
            ranges[:, k, entries[turn_of == turn]] = kept[:, turn_of == turn]
        columns = {
            "epoch_gps_ns": pa.array((epochs[:, None] + used * self._layout.turn_ns).reshape(-1)),
            "range": _lists(ranges.reshape(-1, readings)),
        }
        bright = int(fields.remissions[rows[0]])
        if bright:
            first = int(fields.first_remission[rows[0]])
            at = fields.values_at[rows] + 2 * entries.size + 6
            remission = np.zeros((rows.size, used.size, readings), dtype=np.uint8)
            remission[:, :, first : first + bright] = _gathered(piece.data, at, bright)[:, None, :]
            remission[ranges == 0] = 0
            columns["intensity"] = _lists(remission.reshape(-1, readings))
        return pa.RecordBatch.from_pydict(columns)

    def _ranges(self, values: UInt16) -> UInt16:
        """Return the ranges of values, 0 where a code means none."""
        bits = self._bits or 13
        if self._bits is None and (values >> np.uint16(bits)).any():
            odd = int(values[(values >> np.uint16(bits)) != 0][0])
            raise ConfigError(
                f"a value is 0x{odd:04X}: its highest bits are flags in the 8 m and 80 m measuring modes, and range "
                "in the 16 m and 32 m modes",
                expected="options.range_bits: 13 (8 m, 80 m), 14 (16 m), 15 (32 m) or 16 (32 m immediate)",
                file=self._file,
                missing=Missing("options.range_bits", choices=(13, 14, 15, 16)),
            )
        ranges = values & np.uint16((1 << bits) - 1)
        ranges[ranges >= (1 << bits) - _CODES] = 0
        return ranges


def _gathered(data: UInt8, at: Int64, size: int) -> UInt8:
    """Return (k, size) bytes from each of the places `at` (k,) on; they have to lie inside."""
    if size == 0 or data.size < size:
        return np.zeros((at.size, size), dtype=np.uint8)
    return np.ascontiguousarray(np.lib.stride_tricks.sliding_window_view(data, size)[at])


def _lists(values: npt.NDArray[Any]) -> pa.FixedSizeListArray:
    return pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])


def _mask(size: int, rows: Int64) -> Bool:
    out = np.zeros(size, dtype=bool)
    out[rows] = True
    return out
