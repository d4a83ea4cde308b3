"""Pictures that must go, for people's privacy: their files, their copies in archives, and a record that they went.

What was made of them is made anew by the next run, because their logs are others then. Rows that named them are among
what `roadscan clean` removes.
"""

from __future__ import annotations

import getpass
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from roadscan.core.errors import ConfigError, DamagedError, RoadscanError, nearest
from roadscan.core.gpstime import now_utc
from roadscan.ingest.planned_logs import PlannedLog, logs_of
from roadscan.ingest.sources import listed_name
from roadscan.navigation.tasks.recorded_pictures import taken_pictures
from roadscan.run.session import Session
from roadscan.store.codecs.image_files import SUFFIXES
from roadscan.store.logs import read_log_records
from roadscan.survey.archive import Archive, archive_place
from roadscan.survey.forgotten import Forgotten, forgotten_pictures, record_forgotten

_LOG: Final = "images"
"""Format of the logs that hold pictures as files."""


@dataclass(frozen=True)
class Chosen:
    """A picture that is to go."""

    run: str
    camera: str
    file: str
    """Relative to its log's folder."""
    log: Path
    """Folder of its log."""

    @property
    def name(self) -> str:
        """Return it as other commands name it: RUN/CAMERA/FILE."""
        return f"{self.run}/{self.camera}/{self.file}"

    @property
    def path(self) -> Path:
        """Return where its file is."""
        return self.log / self.file


@dataclass(frozen=True)
class Outcome:
    """What became of a choice."""

    removed: int
    """Files that were removed."""
    archived: int
    """Copies that were removed from archives."""
    left: tuple[str, ...]
    """Why some are still there, in words."""


def choose_named(session: Session, names: Sequence[str]) -> list[Chosen]:
    """Return pictures by their names RUN/CAMERA/FILE, also those that went: a command that was stopped is called again.

    Raises
    ------
    ConfigError
        where one is no picture of the survey, or a frame of a video.
    """
    logs = list(_folders(session))
    there = {one.name: one for log in logs for one in _pictures_of(log)}
    there = {one.name: one for one in _gone(session, logs)} | there
    chosen = []
    for name in dict.fromkeys(names):
        if name not in there:
            raise ConfigError(
                f"there is no picture '{name}'{nearest(name, there)}",
                expected="RUN/CAMERA/FILE of a file in the folder of a camera's log",
                change="`roadscan where` names the pictures that see a place; a video is one file: cut it with a "
                "program for videos, and run again",
            )
        chosen.append(there[name])
    return chosen


def choose_taken(session: Session, camera: str, first_gps_ns: int | None, last_gps_ns: int | None) -> list[Chosen]:
    """Return the pictures that a camera took in a span of GPS time (both ends count; None is open).

    camera : RUN/CAMERA.

    Raises
    ------
    ConfigError
        where the survey has no folder of pictures of this camera, or it was not ingested.
    """
    logs = [log for log in _folders(session) if f"{log.run}/{log.sensor}" == camera]
    if not logs:
        known = sorted({f"{log.run}/{log.sensor}" for log in _folders(session)})
        raise ConfigError(f"there are no picture files of '{camera}'", expected=f"one of {', '.join(known) or 'none'}")
    records = {record.key: record for record in read_log_records(session.store)}
    chosen = []
    for log in logs:
        if log.key not in records:
            raise ConfigError(
                "the times of pictures are known when they are ingested", change="`roadscan run`, or name the pictures",
                file=log.source.path,
            )  # fmt: skip
        for taken in taken_pictures(session.store, [records[log.key]], log.sensor):
            for file, epoch in zip(taken.files, taken.epochs_gps_ns.tolist(), strict=True):
                if (first_gps_ns is None or epoch >= first_gps_ns) and (last_gps_ns is None or epoch <= last_gps_ns):
                    chosen.append(Chosen(log.run, log.sensor, file, log.source.path))
    return [one for one in chosen if one.path.exists()]


def forget(session: Session, chosen: Collection[Chosen], why: str, archives: Sequence[str] = ()) -> Outcome:
    """Remove pictures, and their copies in archives, and record it (requires the store's lock).

    The record comes first, so that nothing goes without one; what a kill left is removed by the same command again.

    why : the reason, for the record; archives : folders or URLs of archives.
    """
    folder = session.survey.folder
    at, who, known = now_utc(), getpass.getuser(), forgotten_pictures(session.store)
    paths = {one: listed_name(one.path, folder) for one in chosen}
    new = [Forgotten(one.run, one.camera, path, at, who, why) for one, path in paths.items()]
    opened = [(archive, archive.files()) for archive in (Archive.of(url, session) for url in archives)]
    record_forgotten(session.store, {one.path: one for one in (*new, *known)}.values())  # the first time counts
    left, archived = [], 0
    for archive, files in opened:
        for path in set(paths.values()) | {one.path for one in known}:
            place = archive_place(path)
            archived += archive.size(place) is not None
            archive.remove(place)
            files.pop(place, None)
        archive.write_list(session.survey.config.id, files)
    removed = 0
    for one in chosen:
        try:
            is_there = one.path.exists()
            one.path.unlink(missing_ok=True)
            removed += is_there
        except OSError as error:
            left.append(f"{one.path}: {error.strerror}")
    return Outcome(removed, archived, tuple(left))


def still_there(session: Session) -> list[str]:
    """Return the forgotten pictures that are at their places all the same, in words: the command was stopped.

    Where the record is damaged, there are none: `verify` says that by itself.
    """
    try:
        known = forgotten_pictures(session.store)
    except DamagedError:
        return []
    return [
        f"{one.path}: it is among the forgotten pictures and is still there; call the same `roadscan forget` again"
        for one in known
        if session.survey.resolve(Path(one.path)).exists()
    ]


def _folders(session: Session) -> Iterator[PlannedLog]:
    """Yield the survey's folders of pictures."""
    planned, unplanned = logs_of(session)
    if unplanned:
        raise RoadscanError(f"a log cannot be read: {unplanned[0].error}", change="put it right first")
    yield from (log for log in planned if log.format.name == _LOG and log.source.path.is_dir())


def _gone(session: Session, logs: Sequence[PlannedLog]) -> Iterator[Chosen]:
    """Yield pictures that were forgotten, of folders that are there."""
    for one in forgotten_pictures(session.store):
        path = session.survey.resolve(Path(one.path))
        for log in logs:
            if (log.run, log.sensor) == (one.run, one.camera) and path.is_relative_to(log.source.path):
                yield Chosen(log.run, log.sensor, path.relative_to(log.source.path).as_posix(), log.source.path)


def _pictures_of(log: PlannedLog) -> Iterator[Chosen]:
    folder = log.source.path
    for file in log.format.files(folder):
        if file.suffix.lower() in SUFFIXES:
            yield Chosen(log.run, log.sensor, file.relative_to(folder).as_posix(), folder)
