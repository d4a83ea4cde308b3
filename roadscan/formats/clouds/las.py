"""LAS and LAZ with GPS time: points that a vendor's program has already georeferenced.

LAS 1.0–1.4 (ASPRS LAS 1.4 R15) with point formats 1, 3–10, LAZ through lazrs.
``scan_angle`` of the newer formats is brought to degrees (0.006° a unit); `flags` gathers the bits of
both generations; extra bytes, near infrared and waveforms are left out and named in the header.

**Time** is what bit 0 of the global encoding says: set, adjusted standard GPS time; clear, seconds of the
GPS week. Many programs leave the bit clear and write adjusted time; a bit and stamps that disagree are
refused, and the clock stated in the survey file decides. Stamps outside the run's trajectory (± 1 s) are
rejected; a log without any inside is refused.

**Marks.** Points that the file marks as withheld ("should not be included in processing", LAS 1.4 R15) or as noise are
rejected unless `options.keep_marked` says otherwise. Synthetic ones are used, and named.

**Coordinates** are in the file's CRS (WKT or GeoTIFF keys) or in the one stated; x, y, z become
metres. A vertical unit that nothing states is taken as the metre only beside horizontal metres.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, Self

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.errors import Missing, TimeSystemError
from roadscan.core.gpstime import NS_PER_S, WEEK_S, Clock, TimeSystem, iso_from_gps_ns
from roadscan.core.strict import Strict
from roadscan.core.witness import Witness
from roadscan.formats.clouds.las_crs import CloudUnits, LengthUnit
from roadscan.formats.clouds.las_file import Cloud, Head
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject, Rows
from roadscan.ingest.reading.records import Sieve, UnorderedStamps, few_rejects, options_of

if TYPE_CHECKING:
    import laspy


_OVERFLOW: Final = "a coordinate overflowed to the least or largest whole number: outside the area of the survey"
_LEAST_RAW: Final = -(2**31)  # least raw coordinate
_MOST_RAW: Final = 2**31 - 1
"""Greatest raw coordinate; an overflow leaves one of these two."""
_TOLERANCE_NS: Final = NS_PER_S
_ADJUSTED_BIT: Final = 0x01  # bit 0 of the global encoding (LAS 1.4 R15)
_STORED: Final = frozenset(
    {
        "X", "Y", "Z", "intensity", "return_number", "number_of_returns", "synthetic", "key_point", "withheld",
        "overlap", "scan_direction_flag", "edge_of_flight_line", "classification", "user_data", "scan_angle",
        "scan_angle_rank", "point_source_id", "gps_time", "red", "green", "blue",
    }
)  # fmt: skip
_FLAG_BITS: Final = (  # bits of the column `flags`
    ("scan_direction_flag", 1),
    ("edge_of_flight_line", 2),
    ("synthetic", 4),
    ("key_point", 8),
    ("withheld", 16),
    ("overlap", 32),
)
_SCAN_ANGLE_DEG: Final = np.float32(0.006)  # unit of the newer formats (LAS 1.4 R15)

_WITHHELD: Final = "the file marks the point as withheld"
_NOISE: Final = "the file classifies the point as noise"
_NOISE_CLASSES: Final = (7,)  # low noise
_NOISE_CLASSES_NEW: Final = (7, 18)
"""Low noise; and high noise, which only point formats 6 to 10 define (LAS 1.4 R15, tables 9 and 17)."""
_FIRST_NEW_FORMAT: Final = 6  # newer formats begin here

MARKED_POINTS: Final = Witness(
    "marked_points",
    input="cloud",
    fault="A point is none of the road: the program that wrote the file took it for noise, withheld it, or made it up.",
    asks="the file's own withheld and synthetic flags, and its classes 7 and 18",
    does="withheld points and noise are left out unless options.keep_marked says otherwise; synthetic points are used, "
    "and named",
    told=("rejects", "findings"),
)

_WEEK: Final = Missing("clock", {"system": "gps_week_seconds", "date": dt.date(2026, 5, 4)})  # a proposal


class LasOptions(Strict):
    """Settings of a LAS or LAZ log."""

    vertical_unit: LengthUnit | None = None
    """Unit of z, where neither a vertical CRS nor GeoTIFF keys state it and the CRS is not in metres."""
    ignore_file_crs: bool = False
    """Take the CRS stated in the survey file although the LAS file names another one, known to be wrong."""
    keep_marked: bool = False
    """Use points, too, that the file marks as withheld or classifies as noise (7; of point formats 6–10 also 18)."""


class Las(LogFormat):
    """Georeferenced clouds."""

    name: ClassVar[str] = "las"
    title: ClassVar[str] = "LAS or LAZ with gps_time: a cloud that a vendor's program has georeferenced"
    yields: ClassVar[tuple[str, ...]] = ("cloud",)
    suffixes: ClassVar[tuple[str, ...]] = (
        ".las",
        ".laz",
    )
    time: ClassVar[str] = (
        "adjusted standard GPS time or seconds of the GPS week by the file's own bit; week seconds need the week or "
        "date in the clock, and a stated clock decides where bit and stamps disagree"
    )
    options: ClassVar[type[Strict]] = LasOptions
    version: ClassVar[int] = 2

    def sniff(self, path: Path) -> bool:
        """True for a file that begins with LASF."""
        try:
            with path.open("rb") as stream:
                return stream.read(4) == b"LASF"
        except OSError:
            return False

    def header(self, source: LogSource) -> LogHeader:
        """Return CRS, kind of heights and time system."""
        source.need_file()
        with Cloud.open(source.path) as cloud:
            units = _units(source, cloud)
            times = _Times.of(source, cloud)
            dropped = sorted(set(cloud.names) - _STORED)
        return LogHeader(
            {
                "crs": units.crs,
                "height": units.height,
                "vertical_crs": units.vertical_crs,
                "geoid": source.geoid.grid if source.geoid and units.height == "orthometric" else None,
                "horizontal_unit_m": units.horizontal_unit_m,
                "vertical_unit_m": units.vertical_unit_m,
                "time_system": str(times.stamps.clock.system),
                "left_out": dropped,
            }
        )

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream points in file order."""
        with Cloud.open(source.path) as cloud:
            times = _Times.of(source, cloud)
            units = np.array([header.attributes["horizontal_unit_m"]] * 2 + [header.attributes["vertical_unit_m"]])
            keep_marked = options_of(source, LasOptions).keep_marked
            synthetic = 0
            for item in cloud.batches():
                if isinstance(item, Reject):
                    yield item
                else:
                    synthetic += int(np.count_nonzero(np.asarray(item[1]["synthetic"])))
                    yield from _points(*item, cloud, times, units, keep_marked)
            times.finish()
        if synthetic:
            yield MARKED_POINTS.finds(
                "", f"{synthetic:,} of its points are marked synthetic, which no scanner measured; they are used"
            )


def _units(source: LogSource, cloud: Cloud) -> CloudUnits:
    options = options_of(source, LasOptions)
    return CloudUnits.of(source, cloud, ignore_file=options.ignore_file_crs, vertical_unit=options.vertical_unit)


def _points(
    first: int,
    points: laspy.ScaleAwarePointRecord,
    cloud: Cloud,
    times: _Times,
    units: Float64,
    keep_marked: bool,
) -> Iterator[Item]:
    count = len(points)
    records = first + np.arange(count)
    sieve = Sieve(count)
    if not keep_marked:
        sieve.drop(np.asarray(points["withheld"]) != 0, _WITHHELD)
        noise = _NOISE_CLASSES_NEW if cloud.head.point_format >= _FIRST_NEW_FORMAT else _NOISE_CLASSES
        sieve.drop(np.isin(np.asarray(points["classification"]), noise), _NOISE)
    epochs = times.epochs(np.asarray(points["gps_time"]), sieve)
    columns = {"epoch_gps_ns": epochs} | _columns(points, cloud.names, units)
    for axis in "xyz":
        sieve.drop(~np.isfinite(columns[f"{axis}_m"]), "a coordinate is no number")
        raw = np.asarray(points[axis.upper()])
        sieve.drop((raw == _LEAST_RAW) | (raw == _MOST_RAW), _OVERFLOW)
    yield from few_rejects(list(sieve.rejects(records, cloud.offsets(records))))
    kept = sieve.kept
    if not sieve.good.any():
        return
    batch = pa.RecordBatch.from_pydict({k: pa.array(np.ascontiguousarray(v[kept])) for k, v in columns.items()})
    start = int(records[np.argmax(sieve.good)])
    at, step = int(cloud.offsets(np.array([start]))[0]), cloud.head.record_bytes_in_file
    yield Rows("cloud", batch, "", start, at, step, None if sieve.good.all() else records[kept])


def _columns(points: laspy.ScaleAwarePointRecord, names: frozenset[str], units: Float64) -> dict[str, npt.NDArray[Any]]:
    """Return columns of the table ``cloud`` without the epoch, (n,) each."""

    def field(name: str) -> npt.NDArray[Any]:
        return np.asarray(points[name])

    columns: dict[str, npt.NDArray[Any]] = {}
    for axis, unit_m in zip("xyz", units, strict=True):
        with np.errstate(over="ignore"):  # a damaged scale: such points are dropped
            own = np.asarray(points[axis].scaled_array(), dtype=np.float64)
        columns[f"{axis}_m"] = own if unit_m == 1.0 else own * unit_m
    for name in ("intensity", "point_source_id"):
        columns[name] = field(name).astype(np.uint16)
    for name in ("classification", "return_number", "number_of_returns", "user_data"):
        columns[name] = field(name).astype(np.uint8)
    if "scan_angle" in names:
        columns["scan_angle_deg"] = field("scan_angle").astype(np.float32) * _SCAN_ANGLE_DEG
    else:
        columns["scan_angle_deg"] = field("scan_angle_rank").astype(np.float32)
    flags = np.zeros(len(points), dtype=np.uint8)
    for name, bit in _FLAG_BITS:
        if name in names:
            flags |= field(name).astype(np.uint8) * np.uint8(bit)
    columns["flags"] = flags
    if "red" in names:
        columns |= {name: field(name).astype(np.uint16) for name in ("red", "green", "blue")}
    return columns


@dataclass
class _Times:
    """Converts gps_time to epochs and checks them against the trajectory."""

    stamps: UnorderedStamps
    source: LogSource
    _inside: int = 0
    _outside: int = 0
    _seen_gps_ns: tuple[int, int] | None = None

    @classmethod
    def of(cls, source: LogSource, cloud: Cloud) -> Self:
        """Find the time system from the header's bit, the first points and the survey file."""
        sample = np.empty(0)
        for item in cloud.batches():
            if not isinstance(item, Reject):
                stamps = np.asarray(item[1]["gps_time"])
                sample = stamps[np.isfinite(stamps)]
                if sample.size:
                    break
        clock = _clock(source, cloud.head, sample)
        return cls(UnorderedStamps.of(clock, sample, source.path), source)

    def epochs(self, stamps: Float64, sieve: Sieve) -> Int64:
        """Return epochs (n,) of stamps (n,); points without a usable stamp are dropped from the sieve."""
        out = self.stamps.epochs(stamps, sieve)
        self._drop_outside(out, sieve)
        return out

    def _drop_outside(self, epochs: Int64, sieve: Sieve) -> None:
        span = self.source.trajectory_span_gps_ns
        seen = epochs[sieve.kept]
        if span is None or not seen.size:
            return
        before = self._seen_gps_ns or (int(seen[0]), int(seen[0]))
        self._seen_gps_ns = (min(before[0], int(seen.min())), max(before[1], int(seen.max())))
        outside = (epochs < span[0] - _TOLERANCE_NS) | (epochs > span[1] + _TOLERANCE_NS)
        self._outside += int((outside & sieve.good).sum())
        sieve.drop(outside, "the point's time lies outside the run's trajectory")
        self._inside += int(sieve.good.sum())

    def finish(self) -> None:
        """Refuse a log without a single point within the run's trajectory."""
        span = self.source.trajectory_span_gps_ns
        if span is None or self._inside or not self._outside or self._seen_gps_ns is None:
            return
        raise TimeSystemError(
            f"all {self._outside:,} points, read as '{self.stamps.clock.system}', lie outside the run's trajectory: "
            f"{_span(self._seen_gps_ns)} against {_span(span)}",
            expected="points and trajectory of the same drive",
            change="check clock.system and week or date of this log, and that it belongs to this run",
            file=self.source.path,
        )


def _span(span_gps_ns: tuple[int, int]) -> str:
    return "–".join(iso_from_gps_ns(t)[:19] + "Z" for t in span_gps_ns)


def _clock(source: LogSource, head: Head, sample: Float64) -> Clock:
    """Return the time system of gps_time: as stated, or by the bit where the stamps agree with it.

    Parameters
    ----------
    sample : (n,) finite stamps of the log's start.
    """
    adjusted = bool(head.encoding & _ADJUSTED_BIT)
    weekly = bool(((sample >= 0) & (sample <= WEEK_S)).all())
    if source.clock is not None:
        _check_statement(source, weekly, sample)
        return source.clock
    says = "adjusted standard GPS time" if adjusted else "seconds of the GPS week"
    if sample.size and not sample.any():
        raise TimeSystemError(
            "gps_time is 0 throughout: no times were recorded",
            expected="a time for every point",
            change="export the cloud with GPS time",
            file=source.path,
        )
    if adjusted and weekly and sample.size:
        raise TimeSystemError(
            f"the header's bit says {says}, and all stamps lie in 0…{WEEK_S} like seconds of a week "
            f"({sample.min():.3f}–{sample.max():.3f})",
            expected="bit and stamps that agree",
            change='state clock = { system = "gps_week_seconds", date = 2026-05-04 }, or system = "gps_adjusted" '
            "if the drive was in the week from 2011-09-14",
            file=source.path,
            missing=[_WEEK, Missing("clock", {"system": "gps_adjusted"})],
        )
    if adjusted:
        return Clock(TimeSystem.GPS_ADJUSTED)
    if not weekly:
        raise _no_seconds_of_week(f"the header's bit says {says}", "bit and stamps that agree", sample, source)
    if source.defaults.week is not None:
        return source.defaults.week
    raise TimeSystemError(
        f"gps_time is {says}, and the week is not known",
        expected="the GPS week or the UTC date of the log",
        file=source.path,
        missing=_WEEK,
    )


def _check_statement(source: LogSource, weekly: bool, sample: Float64) -> None:
    if source.clock is None or source.clock.system is not TimeSystem.GPS_WEEK:
        return
    source.clock.first_week()
    if source.clock.unit == "s" and not weekly:
        raise _no_seconds_of_week("clock.system is 'gps_week_seconds'", "seconds of the GPS week", sample, source)


def _no_seconds_of_week(said: str, expected: str, sample: Float64, source: LogSource) -> TimeSystemError:
    """Return the error for stamps that cannot be seconds of a week, with their dates as adjusted time."""
    arrived = f"{said}, and stamps such as {float(sample[0]):.3f} lie outside 0…{WEEK_S}"
    try:
        epoch = int(Clock(TimeSystem.GPS_ADJUSTED).to_epoch_gps_ns(sample[:1])[0])
    except TimeSystemError:
        change = "state the log's clock: they are neither seconds of a week nor adjusted standard GPS time"
        return TimeSystemError(arrived, expected=expected, change=change, file=source.path, missing=Missing("clock"))
    adjusted = Missing("clock", {"system": "gps_adjusted"})
    change = (
        f"as adjusted standard GPS time they would be {iso_from_gps_ns(epoch)[:19]}Z: if that is when it was driven, "
        f"state {adjusted}"
    )
    return TimeSystemError(arrived, expected=expected, change=change, file=source.path, missing=adjusted)
