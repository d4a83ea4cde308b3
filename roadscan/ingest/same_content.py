"""Finds logs with the same bytes under two names: a copy, or one drive that would count twice."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, TypeAlias

from roadscan.core.survey import LogConfig, Survey
from roadscan.core.witness import Finding, Witness
from roadscan.store.logs import LogRecord

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
