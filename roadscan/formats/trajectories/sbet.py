"""SBET, the smoothed best estimate of trajectory of Applanix POSPac."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, Final

import numpy as np
import pyarrow as pa

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.core.crs import LOCAL_WORLD
from roadscan.core.errors import ConfigError, FormatError, Missing
from roadscan.core.gpstime import NS_PER_S, UNIT_NS, WEEK_S, Clock
from roadscan.core.strict import Strict
from roadscan.core.toml_text import toml
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject, beside
from roadscan.ingest.reading.poses import (
    SIGMA_MAX_DEG,
    SIGMA_MAX_M,
    GeodeticPlacement,
    PoseReader,
    RawPoses,
    block_rows,
    check_rph,
    check_sigmas,
    ned_from_rph,
)
from roadscan.ingest.reading.records import HEIGHT_MAX_M, HEIGHT_MIN_M, LEAP_NS, EpochReader, Sieve, options_of
from roadscan.ingest.reading.text_table import byte_pieces, head_of

FIELDS: Final = 10  # doubles of a record
RECORD_BYTES: Final = 8 * FIELDS  # bytes of a record
CLOCK_EXAMPLE: Final[dict[str, Any]] = {"system": "gps_week_seconds", "week": 2405}  # in errors

SIGMAS: Final = {
    "sigma_north_m": 1.0,
    "sigma_east_m": 1.0,
    "sigma_down_m": 1.0,
    "sigma_velocity_north_m_per_s": 1.0,
    "sigma_velocity_east_m_per_s": 1.0,
    "sigma_velocity_down_m_per_s": 1.0,
    "sigma_roll_deg": 1 / 60,
    "sigma_pitch_deg": 1 / 60,
    "sigma_heading_deg": 1 / 60,
}
"""Columns in the order of a record's fields after the time, with their size in the column's unit: arc minutes become
degrees."""
CARRIED: Final = tuple(name for name in SIGMAS if "velocity" not in name)
"""The σ for which a pose has a column."""

GAP_INTERVALS: Final = 2.5
"""σ is unknown between records more than this many usual intervals apart: one lost record is bridged, two are not."""
USUAL_RECORDS: Final = 1_000
"""First records whose median interval is the usual one."""

_LIMITS: Final = np.array([SIGMA_MAX_M] * 6 + [SIGMA_MAX_DEG * 60] * 3)  # largest σ in the file's units (m, m/s, ′)


class Smrmsg(LogFormat):
    """Little-endian records of 10 doubles without a header.

    Time (s), 1 σ of the position north, east, down (m), of the velocity north, east, down (m/s), of
    roll, pitch, heading (arc minutes; roadscan keeps degrees). Read as a separate log it fills
    `trajectory_accuracy`. To carry its σ with the poses, name it in the SBET log instead: options =
    { accuracy = "smrmsg_mission.out" }. A file packed with gzip, bzip2 or xz is read as it is.
    """

    name = "smrmsg"
    title = "Applanix SMRMSG accuracy (POSPac): σ of a trajectory, 10 doubles a record"
    yields = ("trajectory_accuracy",)
    suffixes: ClassVar[tuple[str, ...]] = (".smrmsg",)
    accompanies: ClassVar[Mapping[str, str]] = {"sbet": "accuracy"}
    time = (
        "as SBET: seconds of the GPS week; the week is not in the file: "
        f"state clock = {toml(CLOCK_EXAMPLE)} or date = …"
    )

    def sniff(self, path: Path) -> bool:
        """True if the first records are plausible σ and their times grow."""
        if not path.is_file():
            return False
        head = head_of(path, 8 * RECORD_BYTES)
        records = np.frombuffer(head[: len(head) // RECORD_BYTES * RECORD_BYTES], dtype="<f8").reshape(-1, FIELDS)
        if records.size == 0 or not np.all(np.isfinite(records)):
            return False
        time, sigmas = records[:, 0], records[:, 1:]
        # Other binary data read as doubles has many numbers next to zero.
        ordinary = np.all((sigmas == 0) | (sigmas > 1e-9)) and np.all(sigmas <= _LIMITS) and np.all(sigmas >= 0)
        known = np.all(sigmas[:, :3] > 0)  # no solution is without error
        growing = np.all(time[1:] > time[:-1]) and time[0] >= 0 and time[-1] <= 2 * WEEK_S
        return bool(ordinary and known and growing and np.all((time == 0) | (time > 1e-6)))

    def header(self, source: LogSource) -> LogHeader:
        """Check the clock."""
        source.need_file()
        EpochReader(source.need_clock(**CLOCK_EXAMPLE), source.path)
        return LogHeader()

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream σ; a damaged record is rejected, and so is a truncated last one."""
        for block in accuracy_blocks(source.path, source.need_clock(**CLOCK_EXAMPLE)):
            if isinstance(block, Reject):
                yield block
                continue
            columns = {"epoch_gps_ns": pa.array(block.epochs)}
            columns |= {name: pa.array(v.astype(np.float32)) for name, v in zip(SIGMAS, block.sigmas, strict=True)}
            yield block_rows("trajectory_accuracy", columns, block.records, block.records * RECORD_BYTES, RECORD_BYTES)


@dataclass(frozen=True)
class AccuracyBlock:
    """Consecutive sound records."""

    records: Int64
    """(n,) record numbers."""
    epochs: Int64
    """(n,) GPS nanoseconds."""
    sigmas: Float64
    """(9, n) in the order and units of :data:`SIGMAS`."""


def accuracy_blocks(path: Path, clock: Clock, near_s: float | None = None) -> Iterator[AccuracyBlock | Reject]:
    """Yield the records of an SMRMSG file in blocks.

    Parameters
    ----------
    near_s : a stamp of the trajectory it belongs to, see :class:`EpochReader`.

    Raises
    ------
    FormatError
        if there is no whole record.
    TimeSystemError
        if the clock fits no stamp of the file's first block.
    """
    reader = EpochReader(clock, path, near_s)
    first, carry = 0, b""
    for piece in byte_pieces(path):
        if isinstance(piece, Reject):
            yield replace(piece, record=first, offset=first * RECORD_BYTES)
            carry = b""
            break
        data = carry + piece
        whole = len(data) // RECORD_BYTES
        if whole:
            fields = np.frombuffer(data, dtype="<f8", count=whole * FIELDS).reshape(-1, FIELDS).T
            yield from _block(np.ascontiguousarray(fields, dtype=np.float64), first, reader)
        first, carry = first + whole, data[whole * RECORD_BYTES :]
    if first == 0:
        raise FormatError(f"the file has {len(carry)} bytes", expected=f"records of {RECORD_BYTES} bytes", file=path)
    if carry:
        reason = f"the file ends inside a record: {len(carry)} bytes of {RECORD_BYTES}"
        yield Reject(reason, first, first * RECORD_BYTES)


def _block(fields: Float64, first: int, reader: EpochReader) -> Iterator[AccuracyBlock | Reject]:
    """Yield the sound records of the fields (10, n), then the rejects."""
    records = np.arange(first, first + fields.shape[1], dtype=np.int64)
    sieve = Sieve(records.size)
    with np.errstate(over="ignore", invalid="ignore"):  # damaged records, dropped below
        sigmas = fields[1:] * np.array(list(SIGMAS.values()))[:, None]
    for name, values in zip(SIGMAS, sigmas, strict=True):
        sieve.drop(~np.isfinite(values), f"{name} is missing or not a number")
    check_sigmas(dict(zip(SIGMAS, sigmas, strict=True)), sieve)
    epochs = reader.epochs(fields[0], sieve, records)
    if sieve.good.any():
        good = sieve.kept
        yield AccuracyBlock(records[good], epochs[good], sigmas[:, good])
    yield from sieve.rejects(records, records * RECORD_BYTES)


class CarriedAccuracy:
    """The σ of an SMRMSG file at the epochs of the poses it belongs to.

    Both files are read side by side, in order of time: only the records about the current poses are
    in memory. Between two records σ is linear in time; there is none beyond the file's span, and in a gap,
    where two records are more than 2.5 usual intervals apart (:data:`GAP_INTERVALS`; the usual interval is the
    median of the file's first 1,000).

    Parameters
    ----------
    path : the SMRMSG file.
    name : how rejects name it.
    clock, near_s : of the trajectory, see :func:`accuracy_blocks`.
    """

    def __init__(self, path: Path, name: str, clock: Clock, near_s: float | None) -> None:
        if not path.is_file():
            raise FormatError("the accuracy file does not exist", change="check options.accuracy", file=path)
        self._path = path
        self._name = name
        self._blocks = accuracy_blocks(path, clock, near_s)
        self._ended = False
        self._rejects: list[Reject] = []
        self._epochs = np.empty(0, dtype=np.int64)
        self._sigmas = np.empty((len(SIGMAS), 0))
        self._gap_ns: float | None = None
        self._asked = self._answered = self._held = 0
        self._first_reject = ""

    def at(self, epochs: Int64) -> dict[str, Float64]:
        """Return σ by column name (:data:`CARRIED`), (n,), NaN outside the file's span and in gaps, at epochs (n,)."""
        if self._gap_ns is None:
            self._gap_ns = self._measured_gap_ns()
        self._advance(int(epochs.min()), int(epochs.max()))
        unknown = self._in_gap(epochs, self._gap_ns)
        origin = self._epochs[0] if self._epochs.size else 0
        known, wanted = (self._epochs - origin).astype(np.float64), (epochs - origin).astype(np.float64)
        out: dict[str, Float64] = {}
        for name, sigma in zip(SIGMAS, self._sigmas, strict=True):
            if name in CARRIED:
                out[name] = (
                    np.where(unknown, np.nan, np.interp(wanted, known, sigma, left=np.nan, right=np.nan))
                    if known.size
                    else np.full(epochs.size, np.nan)
                )
        self._asked += epochs.size
        self._answered += int(np.isfinite(out["sigma_north_m"]).sum())
        return out

    def rejects(self) -> Iterator[Reject]:
        """Yield the damaged records read since the last call."""
        yield from self._rejects
        self._rejects = []

    def finish(self) -> Iterator[Reject]:
        """Read the file to its end, for its damaged records.

        Raises
        ------
        FormatError
            if the file holds no σ for any of the poses.
        """
        while self._next() is not None:
            yield from self.rejects()
        yield from self.rejects()
        if self._asked and not self._held and self._first_reject:
            raise FormatError(
                f"no record of it is sound: {self._first_reject}",
                expected="σ of positions and angles, none of them negative",
                change="export the accuracy file anew, or leave out options.accuracy of the SBET log",
                file=self._path,
            )
        if self._asked and not self._answered:
            raise FormatError(
                f"no record lies within the time of the trajectory's {self._asked} poses",
                expected="the accuracy file of the same mission",
                change="check options.accuracy of the SBET log",
                file=self._path,
            )

    def _next(self) -> AccuracyBlock | None:
        """Return the next sound records, None at the file's end; rejects are stored."""
        while not self._ended:
            block = next(self._blocks, None)
            if isinstance(block, Reject):
                self._rejects.append(replace(block, file=self._name))
                self._first_reject = self._first_reject or block.reason
                continue
            self._ended = block is None
            return block
        return None

    def _advance(self, first: int, last: int) -> None:
        """Read the records about the span of epochs, with one on either side."""
        while (not self._epochs.size or self._epochs[-1] < last) and (block := self._next()) is not None:
            self._hold(block)
            self._forget(first)
        self._forget(first)

    def _hold(self, block: AccuracyBlock) -> None:
        self._held += block.epochs.size
        self._epochs = np.concatenate([self._epochs, block.epochs])
        self._sigmas = np.concatenate([self._sigmas, block.sigmas], axis=1)
        if np.any(np.diff(self._epochs) < 0):
            order = np.argsort(self._epochs, kind="stable")
            self._epochs, self._sigmas = self._epochs[order], self._sigmas[:, order]

    def _measured_gap_ns(self) -> float:
        """Return the time between two records from which they have a gap between them, by the file's first records."""
        while self._epochs.size < USUAL_RECORDS and (block := self._next()) is not None:
            self._hold(block)
        intervals = np.diff(self._epochs[:USUAL_RECORDS])
        intervals = intervals[intervals > 0]
        return GAP_INTERVALS * float(np.median(intervals)) if intervals.size else np.inf

    def _in_gap(self, epochs: Int64, gap_ns: float) -> Bool:
        """Return which epochs (n,) lie in a gap, and on no record."""
        if self._epochs.size < 2:
            return np.zeros(epochs.size, dtype=bool)
        behind = np.clip(np.searchsorted(self._epochs, epochs), 1, self._epochs.size - 1)
        after, before = self._epochs[behind], self._epochs[behind - 1]
        return np.asarray((after - before > gap_ns) & (epochs != after) & (epochs != before))

    def _forget(self, first: int) -> None:
        """Discard the records long before `first`; poses may be a little out of order."""
        start = max(int(np.searchsorted(self._epochs, first - LEAP_NS)) - 1, 0)
        self._epochs, self._sigmas = self._epochs[start:], self._sigmas[:, start:]


SBET_FIELDS: Final = 17  # doubles of a record
SBET_RECORD_BYTES: Final = 8 * SBET_FIELDS  # bytes of a record
CHUNK_RECORDS: Final = 16_384
"""Records read at once, whose columns fit into the processor's cache."""

# Field numbers of a record. Accelerations (11–13) and rates (14–16) are not used.
TIME, LATITUDE, LONGITUDE, HEIGHT, ROLL, PITCH, PLATFORM_HEADING, WANDER = 0, 1, 2, 3, 7, 8, 9, 10
VELOCITY: Final = (4, 5, 6)  # x, y, z in the wander frame
_USED: Final = [TIME, LATITUDE, LONGITUDE, HEIGHT, ROLL, PITCH, PLATFORM_HEADING, WANDER, *VELOCITY]

_SBET_LIMITS: Final = np.array(
    [2 * WEEK_S, math.pi / 2, 2 * math.pi, HEIGHT_MAX_M]  # time, latitude, longitude, height
    + [500.0] * 3  # velocity, m/s
    + [math.pi + 1e-6] * 2  # roll, pitch
    + [2 * math.pi + 1e-6] * 2  # platform heading, wander angle
    + [1000.0] * 3  # acceleration, m/s²
    + [100.0] * 3  # angular rate, rad/s
)


class SbetOptions(Strict):
    """Settings of `sbet`."""

    accuracy: Path | None = None
    """SMRMSG file of the same mission, relative to the log's folder: its σ of position and attitude are
    carried with the poses, linear in time; poses beyond its span have none, and none in a gap: between records
    more than 2.5 usual intervals apart (the median of the first 1,000 records)."""


class Sbet(LogFormat):
    """Little-endian records of 17 doubles without a header.

    Time (s), latitude, longitude (rad), ellipsoidal height (m), velocity in the wander frame (x north,
    y west, z up at wander angle 0), roll, pitch, platform heading, wander angle (rad), acceleration, angular
    rate. True heading = platform heading − wander angle. Body axes are forward, right, down.
    """

    name = "sbet"
    title = "Applanix SBET trajectory (POSPac): position and attitude, 17 doubles a record"
    yields = ("trajectory",)
    suffixes: ClassVar[tuple[str, ...]] = (".sbet",)
    time = (
        "seconds of the GPS week; the week is not in the file: state "
        'clock = { system = "gps_week_seconds", week = … } or date = …; other systems can be stated'
    )
    options = SbetOptions

    def sniff(self, path: Path) -> bool:
        """True if the first records are plausible and their times grow."""
        try:
            with path.open("rb") as stream:
                head = stream.read(8 * SBET_RECORD_BYTES)
        except OSError:
            return False
        records = np.frombuffer(head[: len(head) // SBET_RECORD_BYTES * SBET_RECORD_BYTES], dtype="<f8").reshape(
            -1, SBET_FIELDS
        )
        if records.size == 0:
            return False
        size = np.abs(records)
        # Other binary data read as doubles has many numbers next to zero, or not finite.
        ordinary = np.all(np.isfinite(size)) and np.all((size == 0) | (size > 1e-30)) and np.all(size <= _SBET_LIMITS)
        somewhere = np.all(np.any(size[:, [LATITUDE, LONGITUDE]] > 0, axis=1))
        time = records[:, TIME]
        growing = np.all(time[1:] > time[:-1]) and time[0] >= 0
        return bool(ordinary and somewhere and growing and records[0, HEIGHT] > HEIGHT_MIN_M)

    def companions(self, path: Path, options: Strict) -> list[Path]:
        """Return the SMRMSG file, where one is named."""
        named = options.accuracy if isinstance(options, SbetOptions) else None
        return [] if named is None else [beside(path, named)]

    def header(self, source: LogSource) -> LogHeader:
        """Check clock, CRS, heights and the accuracy file's name, and that there is a record."""
        source.need_file()
        _reader(source, _accuracy(source))
        _check_accuracy(source)
        if source.path.stat().st_size < SBET_RECORD_BYTES:
            raise FormatError(
                f"the file has {source.path.stat().st_size} bytes",
                expected=f"records of {SBET_RECORD_BYTES} bytes",
                file=source.path,
            )
        return LogHeader({"world_frame": _placement(source).world})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream poses; a truncated last record is rejected."""
        yield from _items(source, _accuracy(source), _chunks(source.path))

    def ending(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Yield poses of the first chunk of records, from which the GPS week is counted, and of the last."""
        records = source.path.stat().st_size // SBET_RECORD_BYTES
        last = _chunks(source.path, max(0, records - CHUNK_RECORDS))
        return _items(source, None, itertools.chain(itertools.islice(_chunks(source.path), 1), last))


def _items(
    source: LogSource, accuracy: CarriedAccuracy | None, chunks: Iterator[tuple[int, Float64 | Reject]]
) -> Iterator[Item]:
    reader = _reader(source, accuracy)
    for first, fields in chunks:
        if isinstance(fields, Reject):
            yield fields
            continue
        time, latitude, longitude, height, roll, pitch, platform_heading, wander, *velocity = fields
        with np.errstate(invalid="ignore", over="ignore"):
            heading = platform_heading - wander
        sieve = Sieve(time.size)
        check_rph(roll, pitch, heading, sieve)
        with np.errstate(invalid="ignore"):  # infinities of damaged records, dropped above
            attitude = ned_from_rph(roll, pitch, heading)
        records = np.arange(first, first + time.size, dtype=np.int64)
        raw = RawPoses(
            records=records,
            offsets=records * SBET_RECORD_BYTES,
            stamps=time,
            position=np.stack([longitude, latitude, height]),
            attitude=attitude,
            sigmas={},
            velocity=_level_velocity(wander, *velocity),
        )
        yield from reader.items(raw, sieve)
        if accuracy is not None:
            yield from accuracy.rejects()
    if accuracy is not None:
        yield from accuracy.finish()


def _level_velocity(wander_rad: Float64, x: Float64, y: Float64, z: Float64) -> Float64:
    """Return (3, n) north, east, down of velocities in the wander frame: x forward, y to its left, z up."""
    with np.errstate(invalid="ignore", over="ignore"):  # infinities of damaged records
        cosine, sine = np.cos(wander_rad), np.sin(wander_rad)
        return np.stack([cosine * x - sine * y, -sine * x - cosine * y, -z])


def _reader(source: LogSource, accuracy: CarriedAccuracy | None) -> PoseReader:
    clock = source.need_clock(**CLOCK_EXAMPLE)
    return PoseReader(source, clock, _placement(source), SBET_RECORD_BYTES, None if accuracy is None else accuracy.at)


def _accuracy(source: LogSource) -> CarriedAccuracy | None:
    named = options_of(source, SbetOptions).accuracy
    if named is None:
        return None
    clock = source.need_clock(**CLOCK_EXAMPLE)
    return CarriedAccuracy(beside(source.path, named), named.as_posix(), clock, _first_second(source.path, clock))


def _check_accuracy(source: LogSource) -> None:
    """Refuse a file that is no accuracy file, or that is of another time than the poses."""
    named = options_of(source, SbetOptions).accuracy
    if named is None:
        return
    file, change = beside(source.path, named), "check options.accuracy of the SBET log"
    if Sbet().sniff(file) and not Smrmsg().sniff(file):
        expected = f"the SMRMSG file of the same mission, with records of {RECORD_BYTES} bytes"
        raise FormatError("the accuracy file is an SBET trajectory itself", expected=expected, change=change, file=file)
    poses, accuracy = _ends(source.path, SBET_RECORD_BYTES), _ends(file, RECORD_BYTES)
    weeks = (-WEEK_S, 0, WEEK_S)  # either may count on past the week's end
    if poses and accuracy and not any(poses[0] <= accuracy[1] + w and accuracy[0] + w <= poses[1] for w in weeks):
        count = source.path.stat().st_size // SBET_RECORD_BYTES
        raise FormatError(
            f"no record lies within the time of the trajectory's {count} poses: they last from second {poses[0]:.0f} "
            f"to {poses[1]:.0f} of the week, the accuracy file from {accuracy[0]:.0f} to {accuracy[1]:.0f}",
            expected="the SMRMSG file of the same mission",
            change=change,
            file=file,
        )


def _ends(path: Path, record_bytes: int) -> tuple[float, float] | None:
    """Return the first and last stamp (s) of a file of records, None where it is compressed or damaged."""
    if not path.is_file() or path.stat().st_size < record_bytes:
        return None  # the reader reports it
    with path.open("rb") as stream:
        if stream.read(8) != head_of(path, 8):
            return None
        last = path.stat().st_size // record_bytes - 1
        found = [_stamp(stream, number * record_bytes) for number in (0, last)]
    first, last_s = found[0], found[1] + WEEK_S if found[1] < found[0] else found[1]
    return (first, last_s) if all(0 <= stamp < 2 * WEEK_S for stamp in (first, last_s)) else None


def _stamp(stream: BinaryIO, offset: int) -> float:
    stream.seek(offset)
    return float(np.frombuffer(stream.read(8), dtype="<f8")[0])


def _first_second(path: Path, clock: Clock) -> float | None:
    """Return the first stamp (s), None where it cannot be seconds of a week."""
    with path.open("rb") as stream:
        head = stream.read(8)
    if len(head) < 8:
        return None
    seconds = float(np.frombuffer(head, dtype="<f8")[0]) * UNIT_NS[clock.unit] / NS_PER_S
    return seconds if 0 <= seconds < 2 * WEEK_S else None


def _placement(source: LogSource) -> GeodeticPlacement:
    crs = source.need_crs()
    if crs == LOCAL_WORLD:
        raise ConfigError(
            'crs = "local", but SBET positions are latitude and longitude',
            expected='a geographic CRS, such as "EPSG:4979"',
            file=source.path,
            missing=Missing("crs", "EPSG:4979"),
        )
    # The format's heights are ellipsoidal; an export of others has to be stated.
    height = source.height or source.need_height("ellipsoidal", "the definition of SBET")
    return GeodeticPlacement(crs, height, source.geoid, source.path)


def _chunks(path: Path, first: int = 0) -> Iterator[tuple[int, Float64 | Reject]]:
    """Yield used fields (8, n) of chunks of records from record `first` on, with the number of the first record."""
    buffer = np.empty((CHUNK_RECORDS, SBET_FIELDS), dtype="<f8")  # reused, because fresh pages cost time
    with path.open("rb") as stream:
        stream.seek(first * SBET_RECORD_BYTES)
        while size := stream.readinto(buffer.data.cast("B")):
            whole, rest = divmod(size, SBET_RECORD_BYTES)
            if whole:
                yield first, np.ascontiguousarray(buffer[:whole].T[_USED], dtype=np.float64)
            first += whole
            if rest:
                reason = f"the file ends inside a record: {rest} bytes of {SBET_RECORD_BYTES}"
                yield first, Reject(reason, first, first * SBET_RECORD_BYTES)
