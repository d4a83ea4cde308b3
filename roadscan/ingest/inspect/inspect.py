"""Inspects any file: what it is, what it contains, its time span and extent, and what is wrong with it.

A file that a raw format claims is read through that format's reader, as ingest would, and its figures are taken
while it streams by. What the file does not say and nobody stated (a GPS week, a CRS) is assumed for looking only,
and listed. Other files are identified by their first bytes. Hostile files end in a message, never in a crash.
"""

from __future__ import annotations

import dataclasses
import os
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from roadscan.core.counted import counted
from roadscan.core.errors import FormatError, RoadscanError
from roadscan.core.gpstime import NS_PER_S, UNIT_NS, WEEK_S, Clock, TimeSystem, iso_from_gps_ns
from roadscan.core.witness import Finding
from roadscan.ingest.inspect.diagnosis import cannot_be_opened, diagnose, formats_of, is_there, try_open, unpack
from roadscan.ingest.inspect.file_kinds import FileKind, is_cut_off, kind_of, wrapper_of
from roadscan.ingest.inspect.log_figures import Fault, LogFigures, TableFigures
from roadscan.ingest.inspect.provisional import OpenedLog, Stated, raw_stamps_ns
from roadscan.ingest.reading.format import Contents, Item, LogFormat, Rows, format_named, log_formats
from roadscan.ingest.reading.stamps import FutureTimes

QUICK_VALUES: Final = 1_000_000
"""Readings after which a quick inspection stops."""
QUICK_ITEMS: Final = 2_000  # items after which a quick inspection stops
UNPACKED_BYTES_MAX: Final = 4 << 30
"""Most bytes that a compressed file is unpacked to."""
QUICK_UNPACKED_BYTES: Final = 64 << 20  # most bytes that a quick inspection unpacks

_MOST_WRAPPERS: Final = 3  # most nested compressions
_EARLIEST_S: Final = 475_000_000  # 1995
_LATEST_S: Final = 2_524_000_000  # 2060

_EMPTY: Final[tuple[Any, ...]] = (None, "", [], {})

Progress = Callable[[int, float | None], None]
"""Receives the rows read so far, and the share of the file where it is known."""


@dataclass(frozen=True)
class TimeSpan:
    """First and last epoch of a log."""

    first_gps_ns: int
    last_gps_ns: int
    assumed: Clock | None = None
    """Clock that was assumed: then only the raw stamps are known."""
    is_past_the_hour: bool = False
    """The reader asks for `utc_hour`: stamps count from an unknown hour."""

    @property
    def duration_s(self) -> float:
        """Time from first to last epoch (s)."""
        return (self.last_gps_ns - self.first_gps_ns) / NS_PER_S

    @property
    def raw(self) -> tuple[float, ...] | None:
        """Return the first and last stamp in the assumed unit; None where the time is known."""
        if self.assumed is None:
            return None
        stamps_ns = raw_stamps_ns(self.assumed, np.array([self.first_gps_ns, self.last_gps_ns])).tolist()
        unit_ns = UNIT_NS[self.assumed.unit]
        return tuple(ns / unit_ns if ns % unit_ns else ns // unit_ns for ns in stamps_ns)

    def would_be(self) -> dict[str, str]:
        """Return the first stamp in each time system that gives a date between 1995 and 2060."""
        if self.assumed is None or self.is_past_the_hour:
            return {}
        seconds = raw_stamps_ns(self.assumed, np.array([self.first_gps_ns])) / NS_PER_S
        found: dict[str, str] = {}
        for system in (TimeSystem.GPS, TimeSystem.GPS_ADJUSTED, TimeSystem.UNIX_GPS, TimeSystem.UNIX_UTC):
            if system is TimeSystem.GPS_ADJUSTED and 0 <= seconds[0] < 2 * WEEK_S:
                continue  # a counter that starts at 0, or seconds of a week, rather than September 2011
            try:
                epoch = int(Clock(system).to_epoch_gps_ns(seconds)[0])
            except RoadscanError:
                continue
            if _EARLIEST_S <= epoch / NS_PER_S <= _LATEST_S:
                found[str(system)] = iso_from_gps_ns(epoch)[:19] + "Z"
        if 0 <= seconds[0] < WEEK_S:
            day, rest = divmod(int(seconds[0]), 86_400)
            days = ("Sunday", "Monday", "Tuesday", "Wednesday", "Thursday", "Friday", "Saturday")
            hour, minute = rest // 3600, rest % 3600 // 60
            found[str(TimeSystem.GPS_WEEK)] = f"{days[day]} {hour:02d}:{minute:02d}:{rest % 60:02d} GPS time"
        return found


@dataclass
class LogReport:
    """A log that was read, with stated or assumed settings."""

    opened: OpenedLog
    figures: LogFigures
    complete: bool = False
    """True if it was read to its end."""

    @property
    def is_time_assumed(self) -> bool:
        """True if its time depends on something that is not stated."""
        return any(need.is_of_time for need in self.opened.needs)

    @property
    def time(self) -> TimeSpan | None:
        """Its time span; None where it has no epochs."""
        span = self.figures.span_gps_ns
        if span is None:
            return None
        need = next((need for need in self.opened.needs if need.key == "clock"), None)
        if need is None:
            return None if self.is_time_assumed else TimeSpan(*span)
        return TimeSpan(*span, self.opened.source.clock, "utc_hour" in need.line)

    @property
    def header(self) -> dict[str, Any]:
        """Attributes that the log, or the user, states, without assumed ones."""
        assumed = {need.key.removeprefix("options.") for need in self.opened.needs}
        hidden = {
            "clock": {"time_system"},
            "crs": {"world_frame", "crs", "height", "horizontal_unit_m", "vertical_unit_m"},
            "height": {"height"},
            "unit": {"unit_m"},
        }
        dropped = assumed.union(*(hidden.get(key, set()) for key in assumed))
        return {k: v for k, v in self.opened.header.attributes.items() if k not in dropped and v not in _EMPTY}


@dataclass
class Inspection:
    """Everything known about a file or folder."""

    path: Path
    what: str = ""
    bytes: int = 0
    files: int = 1
    wrappers: tuple[str, ...] = ()
    """Nested compressions, the outermost first."""
    formats: tuple[str, ...] = ()
    """Raw formats whose content test it passes."""
    nearest: tuple[str, ...] = ()
    """Raw formats that could read it although its content does not announce them."""
    kind: FileKind | None = None
    """Kind of the file by its bytes, where no raw format claims it."""
    log: LogReport | None = None
    contents: Contents | None = None
    """Logs that it contains, where it is a container of several."""
    error: str = ""
    """Why it cannot be read."""
    refusals: dict[str, str] = field(default_factory=dict)
    """Errors of the other candidates' readers."""

    @property
    def readable(self) -> bool:
        """True if roadscan can read it: a log (once everything is stated), a product, or a settings file."""
        of_parts = self.contents is not None and any(part.format for part in self.contents.parts)
        return not self.error and (of_parts or self.log is not None or bool(self.kind and self.kind.readable))

    @property
    def faults(self) -> list[Fault]:
        """Return all faults."""
        found = [] if self.kind is None else [Fault(text, 1) for text in self.kind.faults]
        found += [] if self.contents is None else [Fault(text, 1) for text in self.contents.faults]
        return found + (self.log.figures.faults if self.log is not None else [])

    def as_json(self) -> dict[str, Any]:
        """Return the same as JSON values."""
        return {
            "path": str(self.path),
            "what": self.what,
            "bytes": self.bytes,
            "files": self.files,
            "wrappers": list(self.wrappers),
            "formats": list(self.formats),
            "nearest": list(self.nearest),
            "readable": self.readable,
            "error": self.error or None,
            "details": self.kind.details if self.kind is not None else {},
            "log": None if self.log is None else _log_json(self.log),
            "parts": [] if self.contents is None else [dataclasses.asdict(part) for part in self.contents.parts],
            "faults": [dataclasses.asdict(fault) for fault in self.faults],
        }


def inspect(
    path: Path,
    stated: Stated | None = None,
    format_name: str | None = None,
    *,
    quick: bool = False,
    progress: Progress = lambda rows, share: None,
) -> Inspection:
    """Inspect a file or folder.

    Parameters
    ----------
    path : what to look into.
    stated : clock, CRS and settings, as far as the user states them.
    format_name : format to read it as, in place of the one its content announces.
    quick : read only a prefix.

    Raises
    ------
    ConfigError
        where there is no format of that name. All that is wrong with the file stands in the result.
    """
    wanted = [format_named(format_name)] if format_name else None
    with tempfile.TemporaryDirectory(prefix="roadscan-inspect-") as scratch:
        return _inspect(path, stated or Stated(), wanted, quick, progress, Path(scratch))


def read_figures(
    opened: OpenedLog, *, quick: bool = False, progress: Progress = lambda rows, share: None
) -> tuple[LogReport, str]:
    """Read an opened log and its figures; return the report, and why reading ended early ("" if it did not)."""
    source = opened.source
    future = FutureTimes.of(source, opened.header)
    report = LogReport(opened, LogFigures(opened.header, source.map, source.crs, future))
    size = max(_size(opened.format, source.path)[0], 1)
    try:
        for item in opened.format.read(source, opened.header):
            report.figures.take(item)
            progress(report.figures.rows, _share_read(item, size))
            if quick and (report.figures.values >= QUICK_VALUES or report.figures.items >= QUICK_ITEMS):
                return report, ""
    except RoadscanError as error:
        return report, str(error)
    except Exception as error:  # noqa: BLE001 — a reader, perhaps of somebody else's package, that breaks its promise
        return report, f"the reader of {opened.format.name} failed: {type(error).__name__}: {error}"
    report.complete = True
    return report, ""


def _share_read(item: Item, size: int) -> float | None:
    """Return the share of a log of `size` bytes that was read with an item; None where its place is unknown."""
    if isinstance(item, Finding) or item.file:
        return None
    offset = item.first_offset if isinstance(item, Rows) else item.offset
    return min(1.0, offset / size) if offset >= 0 else None


def _inspect(
    path: Path, stated: Stated, wanted: list[LogFormat] | None, quick: bool, progress: Progress, scratch: Path
) -> Inspection:
    found = Inspection(path)
    if not is_there(path):
        found.what, found.error = "nothing", f"{path}: there is no such file or folder"
        return found
    cannot = cannot_be_opened(path)
    if cannot is not None:
        is_folder = os.path.isdir(path)  # noqa: PTH112 — does not raise where a folder above may not be entered
        found.what = "an empty folder" if is_folder else kind_of(path).words
        found.error = str(cannot)
        return found
    if not (path.is_file() or path.is_dir()):
        found.what, found.error = "a device or a pipe", f"{path}: neither a file nor a folder"
        return found
    try:
        return _look(found, stated, wanted, quick, progress, scratch)
    except OSError as error:
        found.error = f"{path}: {error.strerror or error}"
        return found
    except FormatError as error:  # a container that cannot be opened
        found.what, found.error = found.what or kind_of(path).words, str(error)
        return found


def _look(
    found: Inspection,
    stated: Stated,
    wanted: list[LogFormat] | None,
    quick: bool,
    progress: Progress,
    scratch: Path,
) -> Inspection:
    path = found.path
    candidates = formats_of(path) if wanted is None else wanted
    wrapper = wrapper_of(path) if path.is_file() else ""
    if wrapper and not candidates:
        return _look_inside(found, wrapper, stated, quick, progress, scratch)
    found.formats = tuple(f.name for f in candidates) if wanted is None else ()
    found.bytes, found.files = _size(candidates[0] if candidates else None, path)
    if wrapper:
        found.wrappers = (wrapper,)
    contents = contents_of(path) if wanted is None else None
    if not candidates and contents is None:
        return _look_at_unknown(found, stated)
    if contents is not None:
        chosen = [part for part in contents.parts if part.format and part.options.items() <= stated.options.items()]
        if not chosen:
            found.what, found.contents = contents.what, contents
            if not candidates:
                found.error = f"{path}: {contents.what}, of which no raw format reads one"
            return found
        candidates = [format_named(chosen[0].format)]
        found.formats = (chosen[0].format,)
    for candidate in candidates:
        found.what = found.what or candidate.title
        opened, refusal = try_open(candidate, path, stated)
        if opened is None:
            found.refusals[candidate.name] = refusal
            continue
        found.what = candidate.title
        found.log, found.error = read_figures(opened, quick=quick, progress=progress)
        return found
    found.error = next(iter(found.refusals.values()))
    return found


def contents_of(path: Path) -> Contents | None:
    """Return what a container of several logs holds; None for anything else."""
    return next((one for one in (log_format.contents(path) for log_format in log_formats().values()) if one), None)


def _look_inside(
    found: Inspection, wrapper: str, stated: Stated, quick: bool, progress: Progress, scratch: Path
) -> Inspection:
    """Unpack a compressed file as far as an inspection needs it, and inspect its content."""
    depth = len(list(scratch.iterdir()))
    inside = scratch / str(depth) / (found.path.stem or "unpacked")
    inside.parent.mkdir()
    limit = QUICK_UNPACKED_BYTES if quick else UNPACKED_BYTES_MAX
    fault = unpack(found.path, wrapper, inside, limit)
    if depth + 1 >= _MOST_WRAPPERS:
        inner = Inspection(inside, kind=kind_of(inside), what=kind_of(inside).words)
    else:
        inner = _inspect(inside, stated, None, quick, progress, scratch)
    inner.path, inner.bytes = found.path, found.path.stat().st_size
    inner.error = inner.error.replace(str(inside), str(found.path))
    inner.refusals = {name: text.replace(str(inside), str(found.path)) for name, text in inner.refusals.items()}
    inner.wrappers = (wrapper, *inner.wrappers)
    if inner.log is not None and not fault:
        fault = f"a run reads such a log unpacked only: unpack the {wrapper} file first"
    if fault and not inside.stat().st_size:
        return dataclasses.replace(inner, what=f"a {wrapper} file", kind=None, error=f"{found.path}: {fault}")
    if fault:
        inner.kind = FileKind(inner.what, faults=(fault,)) if inner.kind is None else dataclasses.replace(
            inner.kind, faults=(*inner.kind.faults, fault)
        )  # fmt: skip
    return inner


def _look_at_unknown(found: Inspection, stated: Stated) -> Inspection:
    path = found.path
    if path.is_dir():
        found.what = _folder_words(path)
        found.error = str(diagnose(path))
        return found
    found.kind = kind_of(path)
    found.what = found.kind.words
    if found.kind.readable:
        return found
    if found.kind.role == "archive" and not is_cut_off(path):
        found.error = f"{path}: an archive: unpack it to look at what it holds"
        return found
    if found.kind.role and found.kind.faults:
        first, *rest = found.kind.faults
        found.error, found.kind = first, dataclasses.replace(found.kind, faults=tuple(rest))
        return found
    if is_cut_off(path):
        found.kind = dataclasses.replace(found.kind, faults=())  # the message is the library's
    error = diagnose(path, stated)
    found.error = str(error)
    found.nearest = tuple(name for one in error.asks_for("format") for name in one.choices or (one.proposed,))
    return found


def _size(log_format: LogFormat | None, path: Path) -> tuple[int, int]:
    """Return bytes and number of the log's files."""
    if log_format is None:
        files = [path] if path.is_file() else [p for p in path.rglob("*") if p.is_file()]
    else:
        files = log_format.files(path)
    return sum(f.stat().st_size for f in files if f.exists()), len(files)


def _folder_words(path: Path) -> str:
    kinds = Counter(p.suffix.lower() or "without suffix" for p in path.rglob("*") if p.is_file())
    listed = ", ".join(f"{count:,} {suffix}" for suffix, count in kinds.most_common(8))
    return f"a folder of {counted(kinds.total(), 'file')}" + (f" ({listed})" if listed else "")


# --- JSON -------------------------------------------------------------------------------------------


def _log_json(log: LogReport) -> dict[str, Any]:
    return {
        "format": log.opened.format.name,
        "complete": log.complete,
        "to_state": [dataclasses.asdict(need) for need in log.opened.needs],
        "header": log.header,
        "time": None if log.time is None else _time_json(log.time),
        "rejected": log.figures.rejected,
        "tables": {name: _table_json(table) for name, table in log.figures.tables.items()},
    }


def _time_json(time: TimeSpan) -> dict[str, Any]:
    if time.raw is not None and time.assumed is not None:
        return {
            "known": False,
            "first_stamp": time.raw[0],
            "last_stamp": time.raw[1],
            "read_in": time.assumed.unit,
            "duration_s": time.duration_s,
            "would_be": time.would_be(),
        }
    return {
        "known": True,
        "first_gps_ns": time.first_gps_ns,
        "last_gps_ns": time.last_gps_ns,
        "first_utc": iso_from_gps_ns(time.first_gps_ns),
        "last_utc": iso_from_gps_ns(time.last_gps_ns),
        "duration_s": time.duration_s,
    }


def _table_json(table: TableFigures) -> dict[str, Any]:
    out: dict[str, Any] = {"rows": table.rows}
    if table.epochs is not None and table.epochs.count:
        epochs = table.epochs
        out |= {"rate_hz": epochs.rate_hz, "gaps": epochs.gap_count}
        out["longest_gaps_s"] = [length for length, _ in epochs.gaps]
    if table.extent is not None:
        out["extent"] = {
            name: None if value is None else value.tolist()
            for name, value in vars(table.extent).items()
            if name != "frame"
        } | {"frame": table.extent.frame}
        out["path_m"] = table.path_m
    if table.readings is not None:
        out["readings"] = vars(table.readings)
    out["columns"] = {name: dataclasses.asdict(column) for name, column in table.columns.items()}
    return out
