"""Fingerprints raw logs, which identify them whatever their path."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import itertools
import json
import math
import os
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final, TypeAlias

from roadscan.core.errors import FormatError, StoreError
from roadscan.core.plugins import added
from roadscan.core.private_folder import sources_digest
from roadscan.core.survey import LogConfig, Survey
from roadscan.core.witness import Finding, Witness
from roadscan.ingest.inspect.diagnosis import cannot_be_opened, claimed_format, is_there
from roadscan.ingest.reading.format import ENTRY_POINT_GROUP, LogFormat, format_named
from roadscan.store.digest import checked_json, digest_holds, file_digest, parse_checked
from roadscan.store.logs import LogRecord
from roadscan.store.store import Store

_SOURCES: Final = "manifest/sources.json"
_COPY: Final = "manifest/sources_copy.json"

_NEAR: Final = 2
"""Most folders above the survey file's in which a log is named by a relative path."""

Known = list[Any]
"""Size (bytes), time of the last change (ns) and digest of a file."""


class Sources:
    """Fingerprints of raw logs; unchanged files (by size and time) are not read again, and moved logs are remembered.

    Logs are known by their paths from the survey file's folder, where they lie below it or near it: survey, store and
    logs may move together.
    """

    def __init__(self, store: Store, folder: Path, threads: ThreadPoolExecutor, only_looks: bool = False) -> None:
        self._fingerprint = _unread if only_looks else _fingerprint
        self._store = store
        self._folder = folder
        self._threads = threads
        known, self._is_whole = _remembered(store)
        self._kept, self._forgotten = known or {}, known is None
        self._before = _renamed(self._kept, folder)
        self._now: dict[str, Any] = {}
        self._begun: dict[Path, Future[Known]] = {}
        self._claims: dict[str, str] = {}

    def format(self, path: Path, stated: str | None) -> LogFormat:
        """Return the format of a log: as stated, as remembered, or found from its bytes."""
        if self._forgotten and not is_there(path):
            raise FormatError(
                "the log does not exist",
                change="check its path in the survey file; if it was moved away, put it back for one run: "
                "the store's list of logs was damaged",
                file=path,
            )
        cannot = cannot_be_opened(path)
        if cannot is not None:
            if is_there(path) or self._name(path) not in self._before:
                raise cannot
            stated = stated or str(self._before[self._name(path)]["format"])
        if stated:
            return format_named(stated)
        claimed = claimed_before(path, self._before.get(self._name(path)))
        found = format_named(claimed) if claimed else claimed_format(path)
        self._claims[self._name(path)] = claims_digest()
        return found

    def begin(self, path: Path, format_: LogFormat, companions: list[Path]) -> dict[str, Future[Known]]:
        """Start to fingerprint a log's files and companions in threads; return the results by file name."""
        before = self._before.get(self._name(path), {"files": {}})["files"]
        if path.exists():
            named = _named(path, format_, companions)
            missing = next((file for file in named.values() if not file.exists()), None)
            if missing is not None:
                raise FormatError("a file that the log's options name does not exist", file=missing)
            return {name: self._once(file, before.get(name)) for name, file in named.items()}
        if before:
            return {name: _done(known) for name, known in before.items()}
        raise FormatError("the log does not exist", change="check its path in the survey file", file=path)

    def _once(self, file: Path, before: Known | None) -> Future[Known]:
        """Start to fingerprint a file, unless another log has: topics of a bag are logs of the same files."""
        if file not in self._begun:
            self._begun[file] = self._threads.submit(self._fingerprint, file, before)
        return self._begun[file]

    def end(self, path: Path, format_: LogFormat, begun: dict[str, Future[Known]]) -> tuple[str, int, str]:
        """Return the fingerprint over names and contents of a log's files and companions, their total bytes, and their
        stamp as of :func:`stamp_of`.
        """
        files = {name: future.result() for name, future in begun.items()}
        name = self._name(path)
        self._now[name] = {"format": format_.name, "files": files, "claims": self._claims.get(name, "")}
        combined = hashlib.blake2b(digest_size=16)
        for name, (_, _, digest) in files.items():
            combined.update(f"{name}\0{digest}\n".encode())
        stamp = _stamp({name: (size, changed_ns) for name, (size, changed_ns, _) in files.items()})
        return combined.hexdigest(), sum(size for size, _, _ in files.values()), stamp

    def save(self) -> None:
        """Store the fingerprints; logs that are no longer listed are kept.

        Who may only read the store can ask it all the same, and learns it each time.
        """
        known = {**self._before, **self._now}
        if known and (known != self._kept or not self._is_whole):
            with contextlib.suppress(StoreError):
                self._store.write_bytes(_COPY, checked_json(known), lasting=False)
                self._store.write_bytes(_SOURCES, checked_json(known))

    def _name(self, path: Path) -> str:
        return listed_name(path, self._folder)


@contextlib.contextmanager
def open_sources(store: Store, folder: Path, *, only_looks: bool = False) -> Iterator[Sources]:
    """Fingerprints of a store's logs, hashed on all cores; what was learnt is kept at the end.

    Parameters
    ----------
    only_looks : no log is hashed and nothing is kept; files of another size or time get a fingerprint that no log has.
    """
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        sources = Sources(store, folder, threads, only_looks)
        try:
            yield sources
        except BaseException:
            threads.shutdown(cancel_futures=True)
            raise
        if not only_looks:
            sources.save()


def listed_name(path: Path, folder: Path) -> str:
    """Return a log's name in the list: its path from the survey file's folder if near, else its absolute path."""
    try:
        name = Path(os.path.relpath(path, folder))
    except ValueError:  # on another drive
        return str(path)
    return str(path) if name.parts[: _NEAR + 1] == ("..",) * (_NEAR + 1) else name.as_posix()


def _renamed(known: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return what is known of logs by their present names: older lists only have absolute paths."""
    named = {listed_name(Path(path), folder): of for path, of in known.items() if Path(path).is_absolute()}
    return named | {path: of for path, of in known.items() if not Path(path).is_absolute()}


def remembered_logs(store: Store, folder: Path) -> dict[str, Any]:
    """Return what the store knows of logs, by :func:`listed_name`: such a log may have moved away."""
    known, _ = _remembered(store)
    return _renamed(known or {}, folder)


def claimed_before(path: Path, known: Mapping[str, Any] | None) -> str | None:
    """Return the one format that claimed the content of a file, where neither it nor any format has changed since.

    All formats are imported to ask them, which takes as long as a short command.
    """
    if known is None or known["claims"] != claims_digest() or known["files"].keys() != {""}:
        return None
    try:
        stat = path.stat()
    except OSError:
        return None
    return str(known["format"]) if [stat.st_size, stat.st_mtime_ns] == list(known["files"][""][:2]) else None


@functools.cache
def claims_digest() -> str:
    """Return the digest of all code that claims logs: roadscan's own, and the formats of other packages."""
    others = sorted(f"{one.dist and one.dist.version}\0{one.value}" for one in added(ENTRY_POINT_GROUP))
    return hashlib.blake2b("\n".join([sources_digest(), *others]).encode(), digest_size=8).hexdigest()


def stamp_of(path: Path, format_: LogFormat, companions: list[Path]) -> str:
    """Return a hash of the sizes and times of a log's files and companions; it changes while a log is being uploaded.

    Raises
    ------
    OSError
        A file is gone.
    """
    stats = {name: file.stat() for name, file in _named(path, format_, companions).items()}
    return _stamp({name: (stat.st_size, stat.st_mtime_ns) for name, stat in stats.items()})


def _stamp(files: dict[str, tuple[int, int]]) -> str:
    return hashlib.blake2b(json.dumps(files, sort_keys=True).encode(), digest_size=8).hexdigest()


def _named(path: Path, format_: LogFormat, companions: list[Path]) -> dict[str, Path]:
    """Return files of a log and its companions by their names in its fingerprint."""
    named = {_name(file, path): file for file in format_.files(path)}
    return named | {f"beside:{file.name}": file for file in companions if file not in named.values()}


def is_unchanged(store: Store, folder: Path, path: Path, format_: LogFormat, companions: list[Path]) -> bool:
    """Return True if a log's files still have the fingerprinted bytes; reads all of them.

    Raises
    ------
    OSError
        A file cannot be read.
    """
    files = _fingerprinted(store, folder, path)
    named = _named(path, format_, companions)
    return named.keys() == files.keys() and all(digest_holds(file, files[name][2]) for name, file in named.items())


def damaged_sources(store: Store) -> list[str]:
    """Return in words whether the list of fingerprints is damaged; the next run repairs it."""
    known, is_whole = _remembered(store)
    if is_whole:
        return []
    cost = "its copy is used" if known is not None else "logs that were moved away have to be put back for one run"
    return [f"{_SOURCES}: the list of logs is damaged; {cost}, and the next run writes it anew"]


def _remembered(store: Store) -> tuple[dict[str, Any] | None, bool]:
    """Return what is known of logs by path, and whether that is undamaged. It may be from the copy, or None: then their
    files are read again.
    """
    if not store.exists(_SOURCES):
        return {}, True
    for path in (_SOURCES, _COPY):
        try:
            known = parse_checked(store.read_bytes(path))
            logs = {
                log: {"format": of["format"], "files": dict(of["files"]), "claims": of.get("claims", "")}
                for log, of in known.items()
            }
        except (StoreError, ValueError, KeyError, TypeError, AttributeError):
            continue
        return logs, path == _SOURCES
    return None, False


def files_of(store: Store, folder: Path, path: Path, format_: LogFormat, companions: list[Path]) -> dict[Path, str]:
    """Return the files of a log that is there, and their digests as fingerprinted (empty where they were not).

    Those of a log that was moved away are not known by their places: none is returned.
    """
    files = _fingerprinted(store, folder, path)
    named = _named(path, format_, companions) if path.exists() else {}
    return {file: str(files[name][2]) if name in files else "" for name, file in named.items()}


def _fingerprinted(store: Store, folder: Path, path: Path) -> dict[str, Known]:
    """Return what is known of a log's files, by their names in its fingerprint."""
    known, _ = _remembered(store)
    files: dict[str, Known] = _renamed(known or {}, folder).get(listed_name(path, folder), {"files": {}})["files"]
    return files


def _name(file: Path, log: Path) -> str:
    return file.relative_to(log).as_posix() if file != log and log in file.parents else ""


def _fingerprint(file: Path, known: Known | None) -> Known:
    try:
        stat = file.stat()
        if known is not None and known[:2] == [stat.st_size, stat.st_mtime_ns]:
            return known
        old = known is not None and known[0] == stat.st_size and ":" not in known[2]
        if known is not None and old and digest_holds(file, known[2]):
            return [stat.st_size, stat.st_mtime_ns, known[2]]  # of an older algorithm: the log's key depends on it
        return [stat.st_size, stat.st_mtime_ns, file_digest(file)]
    except OSError as error:
        raise FormatError(f"the log cannot be read: {error.strerror}", file=file) from error


def _unread(file: Path, known: Known | None) -> Known:
    """The fingerprint that is known of a file, or one that only its size and time make."""
    try:
        stat = file.stat()
    except OSError as error:
        raise FormatError(f"the log cannot be read: {error.strerror}", file=file) from error
    size_and_time = [stat.st_size, stat.st_mtime_ns]
    return known if known is not None and known[:2] == size_and_time else [*size_and_time, "not read yet"]


def _done(known: Known) -> Future[Known]:
    future: Future[Known] = Future()
    future.set_result(known)
    return future


SAME_CONTENT: Final = Witness(
    "same_content",
    input="any log",
    fault="The same log is listed under two names: a copy, or one drive listed as two.",
    asks="the content of the logs of the survey file, byte by byte; of clouds also their number of points, their times "
    "and their middle; of the logs of one sensor also their number of readings and the times of all row groups",
    does="a copy in the same run and with the same settings counts once; readings that count twice otherwise are used, "
    "and named",
    told=("findings",),
)

_Listed: TypeAlias = dict[tuple[str, str, str | None], LogConfig]
"""Logs of the survey file by run, path and sensor."""
_READINGS: Final = ("scans", "returns", "cloud", "images")
"""Tables of which no two runs share a log. One trajectory may cover several runs."""
_OF_SENSORS: Final = ("scans", "returns", "images")
"""Tables of which no sensor has two rows of one time in two logs."""
_FRAME: Final = ("crs", "height", "geoid", "vertical_crs")
"""Attributes of the coordinates that two clouds must share for their means to be compared."""
_SAME_MIDDLE_M: Final = 0.005
"""Two clouds with equal counts and times are one if their means differ by less (m): the coarsest usual scale is 0.01 m,
and two scanners of one vehicle are farther apart."""
_COMPARED_BYTES: Final = 1 << 20
"""Bytes at either end that are compared between files of equal size."""


def same_content_findings(survey: Survey, records: Sequence[LogRecord]) -> list[Finding]:
    """Return findings on copies among the survey file's logs, and on readings that count twice."""
    listed = {(run.id, str(log.path), log.sensor): log for run in survey.config.runs for log in run.logs}
    return [
        *_copies(survey, listed, records), *_twice(listed, records), *_same_points(records), *_same_times(records),
    ]  # fmt: skip


def _copies(survey: Survey, listed: _Listed, records: Sequence[LogRecord]) -> Iterator[Finding]:
    """Yield findings on logs without a record whose bytes and settings are those of another."""
    known = {(r.run, r.path) for r in records}
    for (run, path, _), config in listed.items():
        file = survey.resolve(config.path)
        if (run, path) in known or not file.is_file():
            continue
        for record in records:
            other = _entry(listed, record)
            same = other is not None and record.run == run and _settings(other) == _settings(config)
            if same and _is_copy(file, survey.resolve(Path(record.path))):
                yield SAME_CONTENT.finds(
                    path, f"it holds the same bytes as {record.path} of the same run {run}, and counts once"
                )
                break


def _twice(listed: _Listed, records: Sequence[LogRecord]) -> Iterator[Finding]:
    """Yield findings on readings of the same bytes in two runs, or of two sensors with the same settings."""
    groups: dict[str, list[LogRecord]] = defaultdict(list)
    for record in records:
        if any(table in record.tables for table in _READINGS):
            groups[record.content].append(record)
    for group in groups.values():
        for first, later in itertools.pairwise(sorted(group, key=lambda r: (r.run, r.path, r.sensor))):
            one, other = _entry(listed, first), _entry(listed, later)
            if one is None or other is None or one.options != other.options:
                continue
            yield SAME_CONTENT.finds(
                later.path,
                f"its bytes are those of {first.path} ({first.run}/{first.sensor}): its readings count a second time "
                f"as {later.run}/{later.sensor}; they are used",
            )


def same_points(records: Sequence[LogRecord]) -> Iterator[tuple[LogRecord, LogRecord]]:
    """Clouds of other bytes with the same points, the second of each pair the later in the order of paths: a cloud
    that was written anew at another scale, in another order, or as LAZ.
    """
    groups: dict[object, list[LogRecord]] = defaultdict(list)
    for record in records:
        files = record.tables.get("cloud", ())
        if files and "middle_m" in record.attributes:
            groups[sum(file.rows for file in files), tuple(file.group_spans for file in files)].append(record)
    for group in groups.values():
        for first, later in itertools.pairwise(sorted(group, key=lambda r: (r.run, r.path, r.sensor))):
            same = all(first.attributes.get(name) == later.attributes.get(name) for name in _FRAME)
            off_m = math.dist(first.attributes["middle_m"], later.attributes["middle_m"])
            if first.content != later.content and same and off_m < _SAME_MIDDLE_M:
                yield first, later


def _same_points(records: Sequence[LogRecord]) -> Iterator[Finding]:
    """Yield findings on such clouds."""
    for first, later in same_points(records):
        text = f"its {later.rows:,} points have the times and the middle of those of {first.path}"
        if first.run == later.run:
            yield SAME_CONTENT.finds(later.path, f"{text} of the same run {first.run}, and count once", later.rows)
        else:
            yield SAME_CONTENT.finds(
                later.path,
                f"{text} ({first.run}/{first.sensor}): they count a second time as {later.run}/{later.sensor}; they "
                "are used",
            )


def _same_times(records: Sequence[LogRecord]) -> Iterator[Finding]:
    """Yield findings on logs of one sensor with the same times and other bytes: one log that was encoded anew."""
    groups: dict[object, list[LogRecord]] = defaultdict(list)
    for record in records:
        for table in _OF_SENSORS:
            if spans := tuple(file.group_spans for file in record.tables.get(table, ())):
                groups[record.sensor, table, record.rows, spans].append(record)
    for group in groups.values():
        for first, later in itertools.pairwise(sorted(group, key=lambda r: (r.run, r.path))):
            if first.content != later.content:
                yield SAME_CONTENT.finds(
                    later.path,
                    f"its {later.rows:,} rows have the times of those of {first.path} ({first.run}/{first.sensor}) to "
                    f"the nanosecond: they count a second time as {later.run}/{later.sensor}; they are used",
                )


def _entry(listed: _Listed, record: LogRecord) -> LogConfig | None:
    """Return the entry of a log; of several with one path, such as topics of a bag, that of its sensor."""
    own = listed.get((record.run, record.path, record.sensor))
    return own or listed.get((record.run, record.path, None))


def _settings(config: LogConfig) -> dict[str, object]:
    return config.model_dump(exclude={"path"})


def _is_copy(file: Path, other: Path) -> bool:
    """Return whether two files have the same size and the same ends."""
    try:
        size = file.stat().st_size
        if size != other.stat().st_size:
            return False
        return all(_part(file, at) == _part(other, at) for at in (0, max(0, size - _COMPARED_BYTES)))
    except OSError:
        return False


def _part(file: Path, start: int) -> bytes:
    with file.open("rb") as stream:
        stream.seek(start)
        return stream.read(_COMPARED_BYTES)
