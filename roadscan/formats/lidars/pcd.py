"""Lidar sweeps as PCD files with a time of each point."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any, ClassVar, Final, Literal

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import ConfigError, FormatError, Missing, TimeSystemError
from roadscan.core.gpstime import UNIT_NS, Clock
from roadscan.core.strict import Strict
from roadscan.formats.clouds.pcd_cloud import (
    TIMES,
    PcdHeader,
    Points,
    is_pcd,
    points,
    read_header,
    scale_of,
    sixteen_bits,
)
from roadscan.formats.clouds.reference_scan import Brightness
from roadscan.formats.lidars.packet_returns import returns_batch
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject, Rows
from roadscan.ingest.reading.records import (
    AXES,
    INTENSITIES,
    LASERS,
    EpochReader,
    Sieve,
    few_rejects,
    field_named,
    options_of,
)

_FARTHEST_M: Final = 10_000.0  # farther positions count as damage
_MOST_LASERS: Final = 255  # greatest number of a laser
_LATEST_NS: Final = 10_000_000_000  # points measured longer before or after a sweep's stamp count as damage
_MOST_COMMON: Final = 0.5  # share of a sweep's time that the next one may have in common
_LOOKED_AT: Final = 2  # files whose times are compared
_MOST_LOOKED: Final = 20  # files among which they are looked for

Unit = Literal["s", "ms", "us", "ns"]


class PcdOptions(Strict):
    """Settings of sweeps as PCD."""

    time_field: str | None = None
    """Field with the time of each point; found by itself under the usual names: t, time, timestamp, time_stamp,
    offset_time, gps_time."""
    time_from: Literal["clock", "file_name"] = "clock"
    """What the times count from: the origin of the log's clock, in whose unit they then are; or the file's stamp,
    which is its name."""
    time_unit: Unit | None = None
    """Unit of the times where they count from the file's name."""
    name_unit: Unit | None = None
    """Unit of the number that is the file's name, in the log's clock."""
    intensity_field: str | None = None
    """Field with the intensity; found by itself as intensity, reflectivity or signal."""
    intensity: bool = True
    """Read the intensities; otherwise they are 0."""
    intensity_range: tuple[float, float] | None = None
    """Recorded intensities that become 0 and 65,535; needed for other numbers than whole ones of 8 or 16 bits."""
    laser_field: str | None = None
    """Field with the laser's number; found by itself as ring, channel, line or laser_id, 0 without one."""


class Pcd(LogFormat):
    """A PCD file (text, binary, or compressed), or a folder of them, a sweep each in the order of their names.

    x, y, z (m, in the sensor's axes) and the time of each point are needed; points whose position is not a number, or
    0, 0, 0, are no returns. Whole intensities of 8 bits are scaled to 16 (255 becomes 65,535), those of 16 bits stay as
    recorded. Other fields are passed over. VIEWPOINT is not applied: the rig file states the mounting. A file
    without times is a cloud (`pcd_cloud`).
    """

    name: ClassVar[str] = "pcd"
    title: ClassVar[str] = "Lidar sweeps as PCD files (Point Cloud Library) with a time of each point"
    yields: ClassVar[tuple[str, ...]] = ("returns",)
    axes_on_sensor: ClassVar[str] = "they are those of the program that wrote the files"
    usual_axes: ClassVar[Mapping[str, str]] = {"flu": "x points ahead, y left, z up, as most programs write"}
    time: ClassVar[str] = (
        "a field of each point: in the clock that the survey file states, or from the stamp that is the file's name "
        '(options.time_from = "file_name")'
    )
    options: ClassVar[type[Strict]] = PcdOptions

    def sniff(self, path: Path) -> bool:
        """True for a PCD file, or a folder whose first one is one, with a field named like a time."""
        return any(name in kinds_of(path) for name in TIMES)

    def files(self, path: Path) -> list[Path]:
        """Return the file, or the folder's PCD files by name."""
        return pcd_files(path)

    def header(self, source: LogSource) -> LogHeader:
        """Check fields, clock and units; the times of a folder's files have to follow one another."""
        files = self.files(source.path)
        if not files:
            raise FormatError("the folder holds no PCD file", expected="files *.pcd", file=source.path)
        plan = _Plan.of(source, next((head for _, head in _readable(files)), None) or read_header(files[0]))
        _check_order(files, plan, source)
        said = {"frame": "sensor", "fields": list(plan.fields), "time_field": plan.time}
        return LogHeader(said | {"time_from": plan.options.time_from, "files": len(files)})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream sweep by sweep."""
        epochs: EpochReader | None = None
        for number, file in enumerate(self.files(source.path)):
            name = file.name if source.path.is_dir() else ""
            try:
                head = read_header(file)
                plan = _Plan.of(source, head)
                stamp_ns = plan.stamp_ns(file)
            except (FormatError, ConfigError) as error:
                if not name:
                    raise
                yield Reject(error.arrived, 0, -1, 1, name)
                continue
            epochs = epochs or EpochReader(plan.clock, source.path)
            for item in points(file, head, plan.names):
                rows = _items(item, plan, stamp_ns, number, epochs) if isinstance(item, Points) else [item]
                yield from _named(rows, name)


def kinds_of(path: Path) -> Mapping[str, str]:
    """Return the fields of a PCD file, or of a folder's first one, with their types; none for anything else."""
    try:
        files = pcd_files(path)
        kinds = read_header(files[0]).kinds if files and is_pcd(files[0]) else {}
    except (FormatError, OSError):
        return {}
    return kinds if set(AXES) <= kinds.keys() else {}


def pcd_files(path: Path) -> list[Path]:
    """Return the file, or a folder's PCD files in the order of their names' numbers."""
    if not path.is_dir():
        return [path]
    found = [p for p in path.iterdir() if p.suffix.lower() == ".pcd" and p.is_file()]
    return sorted(found, key=lambda p: (len(p.stem), p.stem) if p.stem.isdigit() else (0, p.stem))


@dataclass(frozen=True)
class _Plan:
    """How the fields of a sweep are read."""

    fields: tuple[str, ...]
    time: str
    laser: str | None
    intensity: str | None
    brightness: Brightness | None
    """Scale of the intensity; None where it stays as recorded."""
    options: PcdOptions
    clock: Clock
    """Of the points' times, or of the files' names."""

    @classmethod
    def of(cls, source: LogSource, head: PcdHeader) -> _Plan:
        """Return the plan for a file's fields.

        Raises
        ------
        FormatError, ConfigError, TimeSystemError
            where a field is missing, or what it means is not stated.
        """
        options = options_of(source, PcdOptions)
        kinds, file = head.kinds, source.path
        if lacking := [axis for axis in AXES if axis not in kinds]:
            raise FormatError(f"the points have no field '{lacking[0]}'", expected="x, y, z in metres", file=file)
        time = field_named(options.time_field, "time_field", TIMES, kinds, file)
        if time is None:
            raise FormatError(
                "the points have no time, among their fields " + ", ".join(kinds),
                expected="a field with the time of each point",
                change='without one they are a cloud: format = "pcd_cloud"',
                file=file,
                missing=Missing("options.time_field", choices=tuple(kinds)),
            )
        intensity = field_named(options.intensity_field, "intensity_field", INTENSITIES, kinds, file)
        used = intensity if options.intensity else None
        scale = None if used is None else scale_of(used, kinds[used], options.intensity_range, file)
        clock = source.need_clock("unix_utc", unit="s")
        if options.time_from == "file_name":
            units = [("time_unit", options.time_unit), ("name_unit", options.name_unit)]
            if absent := [Missing(f"options.{key}", choices=tuple(UNIT_NS)) for key, unit in units if unit is None]:
                raise TimeSystemError(
                    "the unit of the points' times, or of the files' names, is not stated", file=file, missing=[absent]
                )
            clock = dataclasses.replace(clock, unit="ns")
        elif kinds[time] == "<f4" and clock.system != "free":
            raise TimeSystemError(
                f"the field '{time}' is of single precision, which holds no time from 1970 (steps of 128 s)",
                expected='times from the file\'s name (options.time_from = "file_name"), or a free clock',
                file=file,
                missing=Missing("options.time_from", "file_name", ("file_name",)),
            )
        laser = field_named(options.laser_field, "laser_field", LASERS, kinds, file)
        return cls(tuple(kinds), time, laser, used, scale, options, clock)

    @property
    def names(self) -> list[str]:
        """Return the fields that are read."""
        return [*AXES, self.time, *(name for name in (self.laser, self.intensity) if name is not None)]

    def stamp_ns(self, file: Path) -> int:
        """Return the stamp (ns of the clock's count) that is the file's name; 0 where times do not count from it.

        Raises
        ------
        FormatError
            if the name is no number.
        """
        if self.options.time_from == "clock":
            return 0
        try:
            value = Decimal(file.stem) * UNIT_NS[self.options.name_unit or "ns"]
        except InvalidOperation:
            value = Decimal("NaN")
        if not value.is_finite() or abs(value) >= 2**62:
            raise FormatError(
                "the file's name is no stamp", expected="a number, such as 1673400149711850138", file=file
            )
        return round(value)

    def counted(self, values: npt.NDArray[Any], stamp_ns: int, sieve: Sieve) -> npt.NDArray[Any]:
        """Return the points' times (n,) in the clock's count; those far from their file's stamp are dropped."""
        if self.options.time_from == "clock":
            return values if values.dtype.kind == "f" else values.astype(np.int64)
        with np.errstate(invalid="ignore", over="ignore"):  # numbers of damaged points
            offsets_ns = values.astype(np.float64) * UNIT_NS[self.options.time_unit or "ns"]
        near = np.abs(offsets_ns) <= _LATEST_NS  # False with a NaN
        sieve.drop(~near, "its time is more than 10 s from its file's, or not a number")
        return stamp_ns + np.rint(np.where(near, offsets_ns, 0.0)).astype(np.int64)


def _items(part: Points, plan: _Plan, stamp_ns: int, sweep: int, epochs: EpochReader) -> Iterator[Item]:
    """Yield rejects, then rows of the sound points that are returns."""
    with np.errstate(invalid="ignore", over="ignore"):
        xyz = [part.columns[axis].astype(np.float32) for axis in AXES]
        farthest = np.max(np.abs(xyz), axis=0)  # NaN where one of them is
    returned = np.flatnonzero(farthest > 0.0)  # neither 0, 0, 0 nor NaN
    if not returned.size:
        return
    own = {name: values[returned] for name, values in part.columns.items()}
    records, offsets = part.records[returned], part.offsets[returned]
    sieve = Sieve(returned.size)
    sieve.drop(~(farthest[returned] <= _FARTHEST_M), "the position is beyond 10 km")
    with np.errstate(invalid="ignore"):
        laser = np.zeros(returned.size) if plan.laser is None else own[plan.laser].astype(np.float64)
    sieve.drop(~((laser >= 0) & (laser <= _MOST_LASERS)), "the laser's number is outside 0 to 255")
    stamps = plan.counted(own[plan.time], stamp_ns, sieve)
    epoch = epochs.epochs(stamps, sieve, records) if sieve.good.any() else np.zeros(returned.size, np.int64)
    yield from few_rejects(list(sieve.rejects(records, offsets)))
    good = np.flatnonzero(sieve.good)
    if not good.size:
        return
    bright = np.zeros(good.size, np.uint16)
    if plan.intensity is not None:
        bright = sixteen_bits(own[plan.intensity][good], plan.brightness)
    batch = returns_batch(
        epoch[good],
        [one[returned][good] for one in xyz],
        bright,
        laser[good].astype(np.uint8),
        np.full(good.size, sweep, np.int32),
    )
    yield Rows("returns", batch, first_record=int(records[good][0]), records=records[good])


def _named(items: Iterable[Item], name: str) -> Iterator[Item]:
    """Yield rows and rejects with the name of their file."""
    return (dataclasses.replace(item, file=name) if isinstance(item, Rows | Reject) else item for item in items)


def _readable(files: Sequence[Path]) -> list[tuple[Path, PcdHeader]]:
    """Return the first files whose headers can be read, with these."""
    found = []
    for file in files[:_MOST_LOOKED]:
        try:
            found.append((file, read_header(file)))
        except FormatError:
            continue
        if len(found) == _LOOKED_AT:
            break
    return found


def _check_order(files: Sequence[Path], plan: _Plan, source: LogSource) -> None:
    """Refuse times that start anew in each file where they are stated to count from the clock's origin."""
    if plan.options.time_from == "file_name" or len(files) < _LOOKED_AT:
        return
    spans = []
    known = [(file, head) for file, head in _readable(files) if plan.time in head.kinds]
    for file, head in known[:_LOOKED_AT]:
        first = next(points(file, head, [plan.time]), None)
        values = first.columns[plan.time] if isinstance(first, Points) else np.empty(0)
        values = values[np.isfinite(values)].astype(np.float64)
        if values.size:
            spans.append((float(values.min()), float(values.max())))
    if len(spans) < _LOOKED_AT:
        return
    (low, high), (later_low, later_high) = spans
    common = min(high, later_high) - max(low, later_low)
    if high > low and common > _MOST_COMMON * (high - low):
        raise TimeSystemError(
            f"the times of {known[0][0].name} run from {low:.10g} to {high:.10g}, those of {known[1][0].name} from "
            f"{later_low:.10g} to {later_high:.10g}: they start anew in each file",
            expected="times that go on, or files named by their stamps",
            file=source.path,
            missing=Missing("options.time_from", "file_name", ("file_name",)),
        )
