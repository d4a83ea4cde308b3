"""The interface of a raw format, and the registry that finds all formats.

A format is one file of `roadscan/formats/` (or one entry point of the group ``roadscan.formats``) with one
subclass of :class:`LogFormat`. It streams :class:`Rows`, :class:`Reject` for each damaged record, and a
:class:`~roadscan.core.witness.Finding` for what is doubtful of the log; everything else (schemas, partitions,
fingerprints, rejects table, where findings are reported) is done for it.
"""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.core.crs import LOCAL_WORLD, Geoid, HeightKind, MapFrame, crs_from_text, heights_of
from roadscan.core.errors import ConfigError, CrsError, FormatError, Missing, RoadscanError, TimeSystemError, nearest
from roadscan.core.gpstime import Clock
from roadscan.core.plugins import found_kinds, kind_named
from roadscan.core.rig import Sensor, SensorKind
from roadscan.core.strict import Strict
from roadscan.core.witness import Finding, Witness
from roadscan.ingest.reading.columns import Quantity
from roadscan.store.readings.packed_returns import PACKED, returns_of

if TYPE_CHECKING:
    from roadscan.core.survey import Survey

NO_LEVER_ARM: Final = [0.0, 0.0, 0.0]  # body axes, for mountings at the reference point (m)

ENTRY_POINT_GROUP: Final = "roadscan.formats"
"""Entry-point group through which another package adds a format."""


class NoOptions(Strict):
    """Settings of a format without settings."""


_HEIGHT_ASKED: Final = Missing("height", choices=("ellipsoidal", "orthometric"))

HEIGHT_NOT_STATED: Final = Witness(
    name="height_not_stated",
    input="heights",
    fault="Nothing says whether a log's heights are ellipsoidal or orthometric: they differ by up to 106 m.",
    asks="the log's header, its CRS or the definition of its format, then the survey file",
    does="a log of which none of them says the kind is refused, with the line that states it",
    told=("error",),
)
HEIGHT_CONTRADICTED: Final = Witness(
    name="height_contradicted",
    input="heights",
    fault="The survey file states another kind or unit of heights than the log itself.",
    asks="vertical CRS, GeoTIFF keys, axes of the CRS, header, or the definition of the format",
    does="the log is refused; the message names both",
    told=("error",),
)

_CARTESIAN: Final = 'crs = "local", or a geocentric one such as "EPSG:4978"'


@dataclass(frozen=True)
class SourceDefaults:
    """Defaults of the survey file, for logs that do not state a setting themselves."""

    clock: Clock | None = None
    """Time system of stamps for which neither the log nor its entry in the survey file states one."""
    week: Clock | None = None
    """Clock of seconds of the GPS week, where the survey file gives a week or date for all logs."""
    crs: str | None = None
    """CRS of positions for which neither the log nor its entry in the survey file states one."""
    height: HeightKind | None = None
    """Kind of heights for which neither the log nor its entry in the survey file states one."""


@dataclass(frozen=True)
class LogSource:
    """One log as the survey file describes it."""

    path: Path
    """File or folder, absolute."""
    options: Strict
    """Checked settings of the format (an instance of its `options`)."""
    clock: Clock | None = None
    """Time system as stated; None where the survey file states none."""
    sensor: Sensor | None = None
    """Sensor of the rig that wrote the log."""
    crs: str | None = None
    """CRS of the log's positions as stated ("local" for a local frame)."""
    height: HeightKind | None = None
    """Kind of the log's heights as stated; None where the survey file states none."""
    geoid: Geoid | None = None
    """Geoid that brings orthometric heights to the ellipsoid."""
    map: MapFrame | None = None
    """The survey's map, for control points and for formats that need it (`LogFormat.needs_map`)."""
    trajectory_span_gps_ns: tuple[int, int] | None = None
    """Span of the run's trajectory, where it is already ingested."""
    defaults: SourceDefaults = SourceDefaults()
    """Defaults of the survey file; a reader uses them where the log says nothing, and never against it."""

    @property
    def any_clock(self) -> Clock | None:
        """Stated clock, or the survey's default: for stamps whose time system the log does not say."""
        return self.defaults.clock if self.clock is None else self.clock

    def need_clock(self, system: str, **more: object) -> Clock:
        """Return the stated clock or the survey's default, or raise an error that asks for one: time is never guessed.

        Parameters
        ----------
        system, more : a clock that such logs often have, as the survey file states it.
        """
        clock = self.any_clock
        if clock is None:
            raise TimeSystemError(
                "the log's time system is not stated",
                expected="clock.system: gps, gps_week_seconds, gps_adjusted, unix_gps, unix_utc, unix_tai, "
                "utc_hour or free",
                file=self.path,
                missing=Missing("clock", {"system": system, **more}, is_example=True),
            )
        return clock

    def need_crs(self, example: str = "EPSG:4979") -> str:
        """Return the stated CRS or the survey's default, or raise an error that asks for one: it is never guessed."""
        crs = self.defaults.crs if self.crs is None else self.crs
        if crs is None:
            raise ConfigError(
                "the CRS of the log's positions is not stated",
                expected=f'crs, such as "{example}", or "local"' if example != LOCAL_WORLD else _CARTESIAN,
                file=self.path,
                missing=Missing("crs"),
            )
        return crs

    @property
    def any_height(self) -> HeightKind | None:
        """Stated kind of heights, or the survey's default."""
        return self.defaults.height if self.height is None else self.height

    def need_height(self, known: HeightKind | None = None, by: str = "", way_out: str = "") -> HeightKind:
        """Return the kind of the log's heights: as the log, or the survey file, states; an error where neither does.

        Parameters
        ----------
        known : kind that the log itself says, by its header, its CRS or the definition of its format.
        by : what says it, in words.
        way_out : what to state where the log is wrong.

        Raises
        ------
        ConfigError
            where nothing says the kind: it is never guessed.
        CrsError
            where log and survey file say different kinds.
        """
        said = self.any_height
        if known is None:
            if said is not None:
                return said
            raise ConfigError(
                "the kind of the log's heights is not stated",
                expected=f"{_HEIGHT_ASKED}, with geoid where heights change their kind on the way into the map",
                file=self.path,
                missing=_HEIGHT_ASKED,
            )
        if said is None or said == known:
            return known
        whose = "defaults.height" if self.height is None else "height"
        also = " (and geoid, to change them into another kind)" if known == "orthometric" else ""
        raise CrsError(
            f"heights are {known} by {by}, {whose} in the survey file says {said}",
            expected="one kind of height",
            change=f'set height = "{known}" for this log{also}{f", or {way_out}" if way_out else ""}',
            file=self.path,
            missing=Missing("height", known),
        )

    def need_file(self) -> None:
        """Refuse a log that is no file or cannot be opened, for formats of single files."""
        try:
            if self.path.is_dir():
                raise FormatError("the log is a folder", expected="a file", file=self.path)
            self.path.open("rb").close()
        except OSError as error:
            raise FormatError(f"the log cannot be opened: {error.strerror}", file=self.path) from error

    def need_sensor(self, *kinds: SensorKind) -> Sensor:
        """Return the rig's sensor that wrote the log; an error where none is named, or it is of another kind."""
        wanted = " or ".join(kinds)
        if self.sensor is None:
            raise ConfigError(
                "the log names no sensor",
                expected=f"a sensor of the rig, of kind {wanted}",
                change='add sensor = "…" to this log',
                file=self.path,
                missing=Missing("sensor"),
            )
        if self.sensor.kind not in kinds:
            raise ConfigError(
                f"the log's sensor is of kind {self.sensor.kind}",
                expected=f"a sensor of kind {wanted}",
                change="name another sensor, or correct its kind in the rig file",
                file=self.path,
            )
        return self.sensor


@dataclass(frozen=True)
class Rows:
    """A chunk of rows for one table (at most some 10 MB: readers stream)."""

    table: str
    """Name of the table in `schemas/`."""
    batch: pa.RecordBatch
    """Columns of the schema (nullable ones may be left out)."""
    file: str = ""
    """File the rows come from, relative to the log; '' for the log itself."""
    first_record: int = 0
    """Record number of the first row in that file, as the format counts records."""
    first_offset: int = -1
    """Byte offset of the first row, −1 where there is none."""
    record_bytes: int = 0
    """Bytes from one row to the next, 0 where it varies."""
    records: npt.NDArray[np.int64] | None = None
    """(n,) record number of each row, where they do not follow one another."""
    velocity_level_m_per_s: npt.NDArray[np.float32] | None = None
    """(n, 3) stated velocity of each row, north, east, down: evidence about its position, which no table stores."""

    @property
    def stored(self) -> tuple[str, pa.RecordBatch]:
        """Return the table and the batch that are stored; its epochs are those of `batch`."""
        return self.table, self.batch

    @property
    def numbers(self) -> npt.NDArray[np.int64]:
        """Return the record number (n,) of each row."""
        return self.first_record + np.arange(self.batch.num_rows) if self.records is None else self.records

    @property
    def offsets(self) -> npt.NDArray[np.int64]:
        """Return the byte offset (n,) of each row, −1 where unknown."""
        if self.first_offset < 0 or not self.record_bytes:
            return np.full(self.batch.num_rows, -1, np.int64)
        return self.first_offset + (self.numbers - self.first_record) * self.record_bytes

    def places(self, rows: npt.NDArray[np.int64]) -> list[tuple[int, int, int]]:
        """Return record number, byte offset and count of each run of adjacent records among rows (m,), ascending."""
        numbers, offsets = self.numbers[rows], self.offsets[rows]
        runs = np.split(np.arange(rows.size), np.flatnonzero(np.diff(numbers) != 1) + 1)
        return [(int(numbers[run[0]]), int(offsets[run[0]]), run.size) for run in runs if run.size]


class PackedRows(Rows):
    """Packed returns: the rows of ``returns`` are computed where they are asked for."""

    def __init__(self, packed: pa.RecordBatch, first_record: int = 0) -> None:
        super().__init__("returns", packed, first_record=first_record)
        self.__dict__["_packed"] = self.__dict__.pop("batch")

    @functools.cached_property
    def batch(self) -> pa.RecordBatch:
        """Return them as rows of ``returns``."""
        return returns_of(self.__dict__["_packed"])

    @property
    def stored(self) -> tuple[str, pa.RecordBatch]:
        """Return the table and the batch that are stored."""
        return PACKED, self.__dict__["_packed"]


@dataclass(frozen=True)
class Reject:
    """A record (or a run of records) that could not be read."""

    reason: str
    """Reason."""
    record: int = -1
    """Number of the first record, −1 where it has none."""
    offset: int = -1
    """Byte offset in the file, −1 where there is none."""
    records: int = 1
    """How many records, one after another."""
    file: str = ""
    """File, relative to the log; '' for the log itself."""


@dataclass(frozen=True)
class LogHeader:
    """What is known of a log before its records are read; stored in the log record."""

    attributes: dict[str, Any] = field(default_factory=dict)
    """JSON values that readings need to be understood.

    ``world_frame`` (trajectory): world frame of the poses.
    ``scan_geometry`` (scans): fields of :class:`roadscan.core.rig.ScanGeometry`.
    ``frame`` (returns): ``"sensor"``, or ``"body"`` where the maker already applied the mounting.
    ``mounting`` (scans, returns): what the log says of its sensor's mounting, by keys of
    :class:`roadscan.core.rig.Sensor` (`axes`, `lever_arm_body_m`, `boresight`); it holds where the rig states none.
    ``crs``, ``height``, ``geoid`` (cloud): what the coordinates are; the unit is metres.
    Further entries are kept for the reader of the log record.
    """
    list_size: int | None = None
    """Readings a profile, for tables with fixed-size lists."""


Item: TypeAlias = Rows | Reject | Finding


@dataclass(frozen=True)
class Provisional:
    """Settings that may be assumed to inspect a log of which nothing is stated; ingest never uses them."""

    clock: Clock | None = None
    """Clock that shows the stamps as they are: `free` for a count of seconds, week 0 for seconds of the week."""
    crs: str | None = None
    """CRS that fits the kind of coordinates (degrees, metres, Cartesian)."""
    options: dict[str, Any] = field(default_factory=dict)
    """Settings of the format that have no default."""


@dataclass(frozen=True)
class Part:
    """One of the streams of a container, such as a topic of a ROS bag: a log each, by the settings that select it."""

    name: str
    """What the container calls it."""
    words: str
    """Its type, number of messages, rate and span, in words."""
    format: str = ""
    """Format that reads it; "" where none does."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Settings by which the format reads this part."""
    frame: str = ""
    """Name of the frame of its readings, "" where it has none."""
    parent: str = ""
    """Frame from which the container counts that frame's mounting; "" where it says nothing of it."""
    mounting: Mapping[str, Any] = field(default_factory=dict)
    """Mounting of the frame by keys of :class:`roadscan.core.rig.Sensor`, if the parent is x ahead, y left, z up."""
    unmounted: str = ""
    """Why no mounting follows from what the container states of that frame; "" where it states nothing."""


@dataclass(frozen=True)
class Contents:
    """What a container holds."""

    what: str
    """What it is, in words."""
    parts: tuple[Part, ...]
    faults: tuple[str, ...] = ()
    """What is damaged of the container as a whole."""


def beside(log: Path, named: Path) -> Path:
    """Return the absolute path of a file that a log's settings name, relative to the log's folder."""
    return (log if log.is_dir() else log.parent) / named


class LogFormat(ABC):
    """One raw format."""

    name: ClassVar[str]
    """Name used in survey files, lower case."""
    title: ClassVar[str]
    """One line: whose format it is and what it holds."""
    yields: ClassVar[tuple[str, ...]]
    """Tables it fills."""
    version: ClassVar[int] = 1
    """Raised when the reader's output changes, so that logs are read again."""
    time: ClassVar[str]
    """What the format says about its time system and what the survey file has to state."""
    options: ClassVar[type[Strict]] = NoOptions
    """Model of the format's settings; the docstrings of its fields are the manual."""
    needs_map: ClassVar[bool] = False
    """Its rows are in the survey's map, as those of control points are: `LogSource.map` is given."""
    axes_on_sensor: ClassVar[str] = ""
    """Where x, y, z of its readings point on the sensor itself, in words, for whoever has to state `axes`."""
    usual_axes: ClassVar[Mapping[str, str]] = {}
    """`axes` of usual mountings, each with the words "if …"; `roadscan init` proposes the first."""
    vehicle_axes: ClassVar[str] = ""
    """Axes of the vehicle's frame, where its readings are in that frame already: the sensor then has no lever arm
    and no axes of its own, and a rig file that states some is refused."""
    suffixes: ClassVar[tuple[str, ...]] = ()
    """Endings of file names, lower case, by which such logs are known: for saying what is wrong, never for reading."""
    column_sets: ClassVar[tuple[tuple[Quantity, ...], ...]] = ()
    """Columns of a text of this format, one of these sets whole: for saying what one lacks that comes near."""
    accompanies: ClassVar[Mapping[str, str]] = {}
    """Formats whose logs name one of this format, each with the setting that does; `roadscan init` pairs them."""
    provisional: ClassVar[tuple[Provisional, ...]] = ()
    """Readings that `roadscan inspect` tries first where statements are missing. Needed only where the usual
    clocks, frames and settings, which it then tries one after another, do not open the log."""

    @abstractmethod
    def sniff(self, path: Path) -> bool:
        """Return True if the file or folder is of this format, judged by content (cheap, never raises)."""

    def files(self, path: Path) -> list[Path]:
        """Return all files of the log, sorted; their content is its fingerprint."""
        if path.is_dir():
            return sorted(p for p in path.rglob("*") if p.is_file())
        return [path]

    def companions(self, path: Path, options: Strict) -> list[Path]:
        """Return files beside the log that its settings name; their content is part of the log's fingerprint too.

        A relative path counts from the log's folder (:func:`beside`).
        """
        return []

    def contents(self, path: Path) -> Contents | None:
        """Return all streams of a container, those of other formats too; None for a separate log."""
        return None

    def shared_options(self, survey: Survey) -> dict[str, Any]:
        """Return settings that the survey file states once for all logs of the format; a log may state others."""
        return {}

    @abstractmethod
    def header(self, source: LogSource) -> LogHeader:
        """Read what is known before the records.

        Raises
        ------
        FormatError, TimeSystemError, CrsError, ConfigError
            where the log as a whole cannot be read as stated.
        """

    @abstractmethod
    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream the log's records in bounded chunks.

        A damaged record becomes a :class:`Reject`, what is doubtful a :class:`Finding`; only a fault of the whole
        log raises.
        """

    def lacks(self) -> RoadscanError | None:
        """Return the error of a program that computes the rows and is not installed; rows computed before are kept.

        Settings of such a format have a hash of the program in their `shaping`, and log records in their attributes, as
        `programs`.
        """
        return None

    def beginning(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream the first positions, for a check before the run; a format that computes them says about where."""
        return self.read(source, header)

    def ending(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream the log's last records, where they can be found in a moment; nothing where they cannot."""
        return iter(())


@functools.cache
def log_formats() -> dict[str, LogFormat]:
    """Return all formats by name: those of roadscan, and installed entry points."""
    found = found_kinds("formats/**/*.py", LogFormat, ENTRY_POINT_GROUP)
    return {name: kind() for name, kind in found.items()}


def known_format(name: str) -> LogFormat | None:
    """Return a format by name, without importing the others; None where there is none of that name."""
    kind = kind_named(name, "formats/**/*.py", LogFormat, ENTRY_POINT_GROUP)
    return None if kind is None else kind()


def format_named(name: str) -> LogFormat:
    """Return a format by name, or raise an error that names the nearest known one; only then are all imported."""
    if found := known_format(name):
        return found
    formats = log_formats()
    raise ConfigError(f"unknown format '{name}'{nearest(name, formats)}", expected="one of: " + ", ".join(formats))


def format_of(path: Path) -> LogFormat:
    """Return the one format whose content test the file or folder passes."""
    if not path.exists():
        raise FormatError("the log does not exist", change="check the path in the survey file", file=path)
    fitting = [f for f in log_formats().values() if f.sniff(path)]
    if len(fitting) == 1:
        return fitting[0]
    if not fitting:
        raise FormatError(
            "the content is of no known format",
            change='state format = "…" for this log; `roadscan formats` lists them',
            file=path,
        )
    raise FormatError(
        "the content fits " + " and ".join(f.name for f in fitting),
        expected="one format",
        change='state format = "…" for this log',
        file=path,
    )


def height_in(source: LogSource, crs: str) -> HeightKind:
    """Return the kind of heights in a geographic or projected CRS, where the log's entry states none.

    Three axes say it, two do not.

    Raises
    ------
    ConfigError, CrsError
        see :meth:`LogSource.need_height`.
    """
    if source.height is not None:
        return source.height
    return source.need_height(heights_of(crs_from_text(crs)).kind, f"the three axes of their CRS, {crs[:80]}")
