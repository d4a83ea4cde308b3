"""SBET, the smoothed best estimate of trajectory of Applanix POSPac."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, ClassVar, Final

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.core.crs import LOCAL_WORLD
from roadscan.core.errors import ConfigError, FormatError, Missing
from roadscan.core.gpstime import NS_PER_S, UNIT_NS, WEEK_S, Clock
from roadscan.core.strict import Strict
from roadscan.formats.trajectories.smrmsg import CLOCK_EXAMPLE, CarriedAccuracy, Smrmsg
from roadscan.formats.trajectories.smrmsg import RECORD_BYTES as ACCURACY_BYTES
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject, beside
from roadscan.ingest.reading.poses import (
    HEIGHT_MAX_M,
    HEIGHT_MIN_M,
    GeodeticPlacement,
    PoseReader,
    RawPoses,
    check_rph,
    ned_from_rph,
)
from roadscan.ingest.reading.records import Sieve, options_of
from roadscan.ingest.reading.text_table import head_of

FIELDS: Final = 17  # doubles of a record
RECORD_BYTES: Final = 8 * FIELDS  # bytes of a record
CHUNK_RECORDS: Final = 16_384
"""Records read at once, whose columns fit into the processor's cache."""

# Field numbers of a record. Accelerations (11–13) and rates (14–16) are not used.
TIME, LATITUDE, LONGITUDE, HEIGHT, ROLL, PITCH, PLATFORM_HEADING, WANDER = 0, 1, 2, 3, 7, 8, 9, 10
VELOCITY: Final = (4, 5, 6)  # x, y, z in the wander frame
_USED: Final = [TIME, LATITUDE, LONGITUDE, HEIGHT, ROLL, PITCH, PLATFORM_HEADING, WANDER, *VELOCITY]

_LIMITS: Final = np.array(
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
                head = stream.read(8 * RECORD_BYTES)
        except OSError:
            return False
        records = np.frombuffer(head[: len(head) // RECORD_BYTES * RECORD_BYTES], dtype="<f8").reshape(-1, FIELDS)
        if records.size == 0:
            return False
        size = np.abs(records)
        # Other binary data read as doubles has many numbers next to zero, or not finite.
        ordinary = np.all(np.isfinite(size)) and np.all((size == 0) | (size > 1e-30)) and np.all(size <= _LIMITS)
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
        if source.path.stat().st_size < RECORD_BYTES:
            raise FormatError(
                f"the file has {source.path.stat().st_size} bytes",
                expected=f"records of {RECORD_BYTES} bytes",
                file=source.path,
            )
        return LogHeader({"world_frame": _placement(source).world})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream poses; a truncated last record is rejected."""
        yield from _items(source, _accuracy(source), _chunks(source.path))

    def ending(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Yield poses of the first chunk of records, from which the GPS week is counted, and of the last."""
        records = source.path.stat().st_size // RECORD_BYTES
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
            offsets=records * RECORD_BYTES,
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
    return PoseReader(source, clock, _placement(source), RECORD_BYTES, None if accuracy is None else accuracy.at)


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
        expected = f"the SMRMSG file of the same mission, with records of {ACCURACY_BYTES} bytes"
        raise FormatError("the accuracy file is an SBET trajectory itself", expected=expected, change=change, file=file)
    poses, accuracy = _ends(source.path, RECORD_BYTES), _ends(file, ACCURACY_BYTES)
    weeks = (-WEEK_S, 0, WEEK_S)  # either may count on past the week's end
    if poses and accuracy and not any(poses[0] <= accuracy[1] + w and accuracy[0] + w <= poses[1] for w in weeks):
        count = source.path.stat().st_size // RECORD_BYTES
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
    buffer = np.empty((CHUNK_RECORDS, FIELDS), dtype="<f8")  # reused, because fresh pages cost time
    with path.open("rb") as stream:
        stream.seek(first * RECORD_BYTES)
        while size := stream.readinto(buffer.data.cast("B")):
            whole, rest = divmod(size, RECORD_BYTES)
            if whole:
                yield first, np.ascontiguousarray(buffer[:whole].T[_USED], dtype=np.float64)
            first += whole
            if rest:
                reason = f"the file ends inside a record: {rest} bytes of {RECORD_BYTES}"
                yield first, Reject(reason, first, first * RECORD_BYTES)
