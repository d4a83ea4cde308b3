"""Builds a first survey from a folder of logs: which logs there are, which form a drive, which sensors wrote them.

Every file is identified by its content and inspected as `roadscan inspect` does. What the logs say is filled in; what
they do not say becomes a question of the written file (:mod:`roadscan.ingest.inspect.first_survey_text`), never a
guess.
"""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Iterator, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from roadscan.compute.array_types import Int64
from roadscan.core.errors import ConfigError
from roadscan.core.gpstime import NS_PER_S, WEEK_S, TimeSystem
from roadscan.core.rig import SensorKind
from roadscan.ingest.inspect.diagnosis import formats_of, specific_fault
from roadscan.ingest.inspect.file_kinds import FileKind, kind_of
from roadscan.ingest.inspect.inspect import Inspection, LogReport, Progress, inspect
from roadscan.ingest.inspect.provisional import Need, Stated, raw_stamps_ns, sensor_kind
from roadscan.ingest.reading.format import Contents, LogFormat, Part

WHOLE_BYTES: Final = 1 << 28
"""Logs up to this size are read to their end, so that their time span is known; of others only the beginning."""

_SAMPLED: Final = 40  # files of a folder that are checked for being logs by themselves
_MOSTLY: Final = 0.5
"""Least share of common time of companions of one mission; missions one after another have less."""
_DIGITS: Final = re.compile(r"\d+")
_NOT_IN_A_NAME: Final = re.compile(r"[^A-Za-z0-9_.-]+")
_OWN_FRAME_M: Final = 50_000.0
"""Poses that stay this near their origin are in a frame of their own (m): coordinates of the Earth, and eastings of
projections for whole countries, are larger."""
_NAME_LENGTH: Final = 64  # longest sensor name that is proposed (characters)


@dataclass
class FoundLog:
    """A log that roadscan can read once everything it needs is stated."""

    path: Path
    """Absolute path of the file or folder."""
    inspection: Inspection
    sensor: str = ""
    """Name of the sensor of the rig that wrote it; "" for none."""
    part: Part | None = None
    """Part of the file that it is, where the file is a container of several logs."""
    companions: dict[str, FoundLog] = field(default_factory=dict)
    """Logs that belong to this one, by the setting of its format that names them."""

    @property
    def report(self) -> LogReport:
        """What was read of it."""
        if self.inspection.log is None:
            raise ConfigError("the log was not read", file=self.path)
        return self.inspection.log

    @property
    def format(self) -> LogFormat:
        """Format of the log."""
        return self.report.opened.format

    @property
    def needs(self) -> list[Need]:
        """Return what the survey file has to state, except the sensor, whose name is known."""
        needs = [need for need in self.report.opened.needs if need.key != "sensor"]
        keys = {need.key for need in needs}
        if self.is_control:
            said = (("crs", "CRS of its coordinates"), ("height", "kind of its heights"))
            needs += [Need(key, f'{key} = "????"', what) for key, what in said if key not in keys]
        return needs

    @property
    def is_assumed(self) -> bool:
        """Return True if settings other than its time were assumed: what is known of the log may change."""
        return any(need.key.startswith("options.") and not need.is_of_time for need in self.report.opened.needs)

    @property
    def sensor_kind(self) -> SensorKind | None:
        """Return the kind of the sensor that wrote it."""
        return sensor_kind(self.format)

    @property
    def is_control(self) -> bool:
        """True for ground control."""
        return "control_points" in self.format.yields

    @property
    def is_road_lines(self) -> bool:
        """True for lines of roads."""
        return "road_lines" in self.format.yields

    @property
    def is_trajectory(self) -> bool:
        """True for poses."""
        return "trajectory" in self.format.yields

    @property
    def is_reference(self) -> bool:
        """Return True for a cloud without times, such as a scan of a place instead of a drive."""
        return "cloud" in self.format.yields and self.report.is_time_assumed and self.report.time is None

    @property
    def stem(self) -> str:
        """Name without suffixes; of a part, its own."""
        if self.part is not None:
            return self.part.name.strip("/")
        return self.path.name if self.path.is_dir() else self.path.name.split(".")[0]


@dataclass
class FoundRun:
    """Logs of one drive."""

    id: str
    logs: list[FoundLog] = field(default_factory=list)


@dataclass
class FoundFolder:
    """Contents of a folder of logs."""

    folder: Path
    runs: list[FoundRun] = field(default_factory=list)
    control: list[FoundLog] = field(default_factory=list)
    references: list[FoundLog] = field(default_factory=list)
    odometries: list[FoundLog] = field(default_factory=list)
    """Poses in a frame of their own beside what makes a trajectory on the Earth: no logs of a run."""
    lines: list[Path] = field(default_factory=list)
    """Vector layers with lines: perhaps centre lines."""
    settings: list[tuple[Path, FileKind]] = field(default_factory=list)
    """Existing survey, rig and scene files."""
    unknown: list[tuple[Path, str]] = field(default_factory=list)
    """Files that were not identified, and what they seem to be."""

    @property
    def logs(self) -> list[FoundLog]:
        """Return the logs of all runs."""
        return [log for run in self.runs for log in run.logs]

    @property
    def only_lidar(self) -> str | None:
        """Return the first lidar with sweeps of logs without any positions; None where a log has some."""
        tables = {table for log in self.logs for table in log.format.yields}
        if tables & {"trajectory", "gnss", "cloud"}:
            return None
        return next((log.sensor for log in self.logs if "returns" in log.format.yields and log.sensor), None)

    @property
    def pairs(self) -> list[tuple[FoundLog, FoundLog, str]]:
        """Return logs that belong to another one: the other, the log, and the setting of the other that names it."""
        return [(log, one, setting) for log in self.logs for setting, one in log.companions.items()]

    @property
    def further(self) -> list[FoundRun]:
        """Return what belongs to no run, grouped by kind."""
        groups = (FoundRun("(control)", self.control), FoundRun("(reference)", self.references))
        return [group for group in groups if group.logs]

    @property
    def sensors(self) -> dict[str, FoundLog]:
        """Return one log of each sensor, by the sensor's name."""
        return {log.sensor: log for log in reversed(self.logs) if log.sensor}


def need_folder(folder: Path) -> None:
    """Raise ConfigError unless `folder` is a folder."""
    if not folder.is_dir():
        raise ConfigError("there is no such folder", expected="a folder of logs", file=folder)


def find_logs(folder: Path, progress: Progress = lambda rows, share: None) -> FoundFolder:
    """Search a folder recursively for logs, and group them into runs.

    Parameters
    ----------
    progress : receives how far each log is read.

    Raises
    ------
    ConfigError
        if `folder` is none.
    """
    need_folder(folder)
    found = FoundFolder(folder.resolve())
    logs: list[FoundLog] = []
    for path in candidates(found.folder):
        _sort_in(path, found, logs, progress)
    found.odometries = [log for log in logs if _is_odometry(log, logs)]
    logs = [log for log in logs if log not in found.odometries]
    found.runs = _runs(_pair(logs, found.folder), found.folder)
    for run in found.runs:
        _name_sensors(run)
    return found


def _pair(logs: list[FoundLog], folder: Path) -> list[FoundLog]:
    """Assign each companion log to the log it fits best; return the other logs, in their order."""
    pairs = [
        (score, log, main, log.format.accompanies[main.format.name])
        for log in logs
        for main in logs
        if main.format.name in log.format.accompanies and (score := _closeness(log, main, folder)) is not None
    ]
    paired: set[Path] = set()
    for _, log, main, setting in sorted(pairs, key=lambda pair: pair[0], reverse=True):
        if log.path not in paired and setting not in main.companions:
            main.companions[setting] = log
            paired.add(log.path)
    return [log for log in logs if log.path not in paired]


def _closeness(log: FoundLog, main: FoundLog, folder: Path) -> tuple[bool, int, int, float] | None:
    """Return how well a companion fits a log: mostly common time, folders, words of the names, share of time.

    None where their times are apart, or cannot be compared.
    """
    share = shared_time(log.report, main.report)
    if share == 0:
        return None
    _, _, depth, words = _fit(log, main, folder)
    return share > _MOSTLY, depth, words, share


# --- what is a log --------------------------------------------------------------------------------


def candidates(folder: Path, taken: frozenset[Path] = frozenset()) -> Iterator[Path]:
    """Yield folder logs and files in order of name, without stores, folders of products and hidden ones.

    Parameters
    ----------
    taken : files that belong to a folder log further up.
    """
    of_folder = _taken_by_folder_log(folder) - taken
    if of_folder:
        yield folder
    taken |= of_folder
    for entry in _entries(folder):
        if entry.name.startswith("."):
            continue
        if entry.is_file():
            if entry not in taken:
                yield entry
        elif entry.is_dir() and not entry.is_symlink() and not _is_store(entry):
            yield from candidates(entry, taken)


def _entries(folder: Path) -> list[Path]:
    """Return what a folder contains, by name; nothing where it may not be read."""
    try:
        return sorted(folder.iterdir())
    except OSError:
        return []


def _is_store(folder: Path) -> bool:
    return folder.name.startswith("survey=") or any(child.name.startswith("survey=") for child in _entries(folder))


def _taken_by_folder_log(folder: Path) -> frozenset[Path]:
    """Return the files of the folder log that the folder is; empty if it is none.

    A folder is a log if a format claims it and its files are no separate logs, or are parts of one: of the
    same format, in one folder, with names that differ in digits only.
    """
    for log_format in formats_of(folder):
        files = log_format.files(folder)
        if log_format.contents(folder) is not None:
            return frozenset(files)
        singly = {path: {f.name for f in formats_of(path)} for path in files[:_SAMPLED]}
        others = {path for path, names in singly.items() if names and log_format.name not in names}
        parts = [path for path, names in singly.items() if log_format.name in names]
        is_one = not parts or (len(parts) > 1 and len({_pattern(path) for path in parts}) == 1)
        if is_one and len(others) < len(singly) and (parts or not _holds_logs(folder, set(files) - others)):
            return frozenset(files) - others
    return frozenset()


def _holds_logs(folder: Path, files: Set[Path]) -> bool:
    """Return True if a deeper folder also claims to be a log and contains all files of this one: then it is the log."""
    below = [child for child in _entries(folder) if child.is_dir() and not child.is_symlink()]
    return any(formats_of(child) and all(child in path.parents for path in files) for child in below)


def _pattern(path: Path) -> tuple[Path, str]:
    return path.parent, _DIGITS.sub("#", path.name)


def _sort_in(path: Path, found: FoundFolder, logs: list[FoundLog], progress: Progress) -> None:
    size = path.stat().st_size if path.is_file() else 0
    inspection = inspect(path, quick=size > WHOLE_BYTES, progress=progress) if formats_of(path) else None
    if inspection is not None and inspection.contents is not None:
        _sort_in_parts(inspection, inspection.contents, found, logs, progress)
        return
    if inspection is not None and inspection.readable:
        log = FoundLog(path, inspection)
        if log.is_control:
            found.control.append(log)
        elif log.is_road_lines:
            found.lines.append(path)
        elif log.is_reference:
            found.references.append(log)
        else:
            logs.append(log)
        return
    kind = kind_of(path)
    if kind.role in {"survey", "rig", "scene"}:
        found.settings.append((path, kind))
    elif kind.role == "lines":
        found.lines.append(path)
    elif inspection is not None:
        found.unknown.append((path, f"{inspection.what}, which cannot be read: {inspection.error}"))
    elif kind.role != "product":
        fault = None if kind.role == "archive" else specific_fault(path)
        words = kind.words if fault is None else f"{fault.arrived}; {fault.change}".removesuffix("; ")
        found.unknown.append((path, words + (" (unpack it first)" if kind.role == "archive" else "")))


def _sort_in_parts(
    container: Inspection, contents: Contents, found: FoundFolder, logs: list[FoundLog], progress: Progress
) -> None:
    """Sort in each part of a container as a separate log."""
    for part in contents.parts:
        if not part.format:
            continue
        stated, quick = Stated(options=dict(part.options)), container.bytes > WHOLE_BYTES
        one = inspect(container.path, stated, part.format, quick=quick, progress=progress)
        if one.readable:
            logs.append(FoundLog(container.path, one, part=part))
        else:
            found.unknown.append((container.path, f"{part.name} ({part.words}), which cannot be read: {one.error}"))


# --- which logs belong together -------------------------------------------------------------------


def _is_odometry(log: FoundLog, logs: list[FoundLog]) -> bool:
    """Return whether poses of a recording begin at an origin of their own, while its IMU and GNSS make a trajectory."""
    made_of = {table for one in logs if one.path == log.path for table in one.format.yields}
    if not log.is_trajectory or log.part is None or not {"imu", "gnss"} <= made_of:
        return False
    figures = log.report.figures.tables["trajectory"].columns
    ends = [end for axis in "xyz" for end in (figures[f"{axis}_world_m"].min, figures[f"{axis}_world_m"].max)]
    is_unstated = any(need.key == "crs" for need in log.needs)
    return is_unstated and all(end is not None and abs(end) < _OWN_FRAME_M for end in ends)


def _runs(logs: list[FoundLog], folder: Path) -> list[FoundRun]:
    """Return the runs: one for each trajectory, or else for each folder; every other log joins the run it fits best.

    A log that has neither time, folder nor a word of its name in common with any trajectory makes a separate run.
    """
    seeds = [log for log in logs if log.is_trajectory]
    if not seeds:
        return _runs_by_folder(logs, folder)
    ids = _run_ids(seeds, folder)
    runs = [FoundRun(name, [seed]) for name, seed in zip(ids, seeds, strict=True)]
    lonely: list[FoundLog] = []
    for log in logs:
        if log.is_trajectory:
            continue
        scores = [_fit(log, seed, folder) for seed in seeds]
        best = max(range(len(seeds)), key=lambda i: scores[i])
        (runs[best].logs if any(scores[best][1:]) or len(seeds) == 1 else lonely).append(log)
    known = {run.id for run in runs}
    for run in _runs_by_folder(lonely, folder):
        run.id = _fresh(run.id, known)
        runs.append(run)
    return runs


def _runs_by_folder(logs: list[FoundLog], folder: Path) -> list[FoundRun]:
    known: set[str] = set()
    groups = itertools.groupby(sorted(logs, key=lambda log: log.path.parent), key=lambda log: log.path.parent)
    return [
        FoundRun(_fresh(parent.name if parent != folder else "run", known), list(group)) for parent, group in groups
    ]


def _run_ids(seeds: list[FoundLog], folder: Path) -> list[str]:
    parents = [seed.path.parent for seed in seeds]
    known: set[str] = set()
    return [
        _fresh(parent.name if parents.count(parent) == 1 and parent != folder else seed.stem, known)
        for seed, parent in zip(seeds, parents, strict=True)
    ]


def _fit(log: FoundLog, seed: FoundLog, folder: Path) -> tuple[int, int, int, int]:
    """Return how well a log fits a trajectory: time apart (−1), unknown (0) or overlapping; common folders and words.

    A log whose time is apart fits nothing: the rest counts 0 then.
    """
    overlap = overlaps(log.report, seed.report)
    if overlap is False:
        return -1, 0, 0, 0
    home, there = _home(log, folder), _home(seed, folder)
    shared = Path(os.path.commonpath([home, there]))
    words = set(_words(log.stem)) & set(_words(seed.stem))
    depth = len(shared.relative_to(folder).parts) + (home in {folder, there})
    return int(bool(overlap)), int(bool(overlap)), depth, len(words)


def _home(log: FoundLog, folder: Path) -> Path:
    """Return the folder that contains the log; the searched folder where it is the log itself."""
    return folder if log.path == folder else log.path.parent


def overlaps(one: LogReport, other: LogReport) -> bool | None:
    """Return whether two logs overlap in time; None where their times cannot be compared."""
    spans = _common_scale(one, other)
    if spans is None:
        return None
    kind, a, b = spans
    meets = a[0] <= b[1] and b[0] <= a[1]
    return meets if kind != "free" or meets else None


def weeks_of_overlap(log: FoundLog, run: FoundRun) -> set[int]:
    """Return the GPS weeks of the run's logs of known time with which a log in seconds of the week overlaps."""
    week_ns = WEEK_S * NS_PER_S
    known = [one.report.time for one in run.logs if overlaps(log.report, one.report)]
    spans = [(t.first_gps_ns, t.last_gps_ns) for t in known if t is not None and t.assumed is None]
    return {ns // week_ns for span in spans for ns in span}


def shared_time(one: LogReport, other: LogReport) -> float:
    """Return the share of common time in two logs' time, from the first to the last epoch of both; 0 if unknown."""
    spans = _common_scale(one, other)
    if spans is None:
        return 0.0
    _, a, b = spans
    both, either = min(a[1], b[1]) - max(a[0], b[0]), max(a[1], b[1]) - min(a[0], b[0])
    return max(both, 0) / either if either else 1.0


def _common_scale(one: LogReport, other: LogReport) -> tuple[str, list[int], list[int]] | None:
    """Return the common time scale of two logs and their spans on it; None where they have none.

    Seconds of the week are compared with GPS time by its seconds of the week.
    """
    spans = [_comparable(one), _comparable(other)]
    if any(span is None for span in spans):
        return None
    (kind_a, *a), (kind_b, *b) = (span for span in spans if span is not None)
    if {kind_a, kind_b} == {"gps", "week"}:
        week_ns = WEEK_S * NS_PER_S
        a = [t % week_ns for t in a]
        b = [t % week_ns for t in b]
        if a[1] < a[0] or b[1] < b[0]:
            return None  # a week ends within the span
    elif kind_a != kind_b:
        return None
    return kind_a, a, b


def _comparable(report: LogReport) -> tuple[str, int, int] | None:
    time = report.time
    if time is None:
        return None
    if time.assumed is None:
        return "gps", time.first_gps_ns, time.last_gps_ns
    if time.is_past_the_hour:
        return None
    first, last = (int(ns) for ns in raw_stamps_ns(time.assumed, _stamps(time.first_gps_ns, time.last_gps_ns)))
    return ("week" if time.assumed.system is TimeSystem.GPS_WEEK else "free"), first, last


def _stamps(first: int, last: int) -> Int64:
    return np.array([first, last], dtype=np.int64)


# --- names ----------------------------------------------------------------------------------------


def _name_sensors(run: FoundRun) -> None:
    """Name the sensors of a run by its files, without parts that are only a number or name the drive."""
    of_drive = {word for log in run.logs if log.is_trajectory for word in _words(log.stem)} | set(_words(run.id))
    named: dict[str, list[FoundLog]] = {}
    for log in run.logs:
        if log.sensor_kind is None:
            continue
        words = [w for w in _words(log.stem) if not w.isdigit() and w not in of_drive]
        named.setdefault(_sound_name("_".join(words)) or str(log.sensor_kind), []).append(log)
    for name, logs in named.items():
        for number, group in enumerate(_one_sensor_each(logs), 1):
            for log in group:
                log.sensor = name if number == 1 else f"{name}_{number}"


def _one_sensor_each(logs: list[FoundLog]) -> list[list[FoundLog]]:
    """Return logs of one name, split where they overlap or differ in format: a sensor writes one log at a time."""
    groups: list[list[FoundLog]] = []
    for log in logs:
        for group in groups:
            if all(log.format is one.format and not overlaps(log.report, one.report) for one in group):
                group.append(log)
                break
        else:
            groups.append([log])
    return groups


def _words(stem: str) -> list[str]:
    return [word for word in re.split(r"[^A-Za-z0-9]+", stem) if word]


def _sound_name(text: str) -> str:
    return _NOT_IN_A_NAME.sub("-", text).strip("-._")[:_NAME_LENGTH]


def _fresh(text: str, known: set[str]) -> str:
    """Return an unused name made of `text`, and mark it as used."""
    name = _sound_name(text) or "run"
    numbers = itertools.count(2)
    fresh = name
    while fresh in known:
        fresh = f"{name[: _NAME_LENGTH - 5]}-{next(numbers)}"
    known.add(fresh)
    return fresh
