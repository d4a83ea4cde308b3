"""Copies of a survey's raw logs in another place, with proof that they are the bytes which were ingested.

The place is a folder or an object store. It has the survey file, the rig file and the logs under their paths from the
survey file's folder, and `archive.json`, which names each file with its bytes and its BLAKE3-128. A file is there when
it is whole: it is written under another name first (folder), or by one upload (object store). It is read back before it
counts.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import hashlib
import io
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import IO, Any, Final, Self

from roadscan.core.errors import DamagedError, RunError, StoreError
from roadscan.ingest.planned_logs import logs_of
from roadscan.ingest.sources import files_of, listed_name
from roadscan.run.session import Session
from roadscan.store.digest import checked_json, file_digest, parse_checked, stream_digest
from roadscan.store.logs import has_log
from roadscan.store.store import opened_url
from roadscan.survey.forgotten import forgotten_pictures

LIST: Final = "archive.json"
"""List of an archive's files, in its root."""
_CHUNK: Final = 8 << 20
"""Bytes that are copied at a time: large enough for an object store's requests."""


@dataclass
class Archived:
    """What an archive has after a command, or lacks."""

    copied: list[str] = field(default_factory=list)
    there: list[str] = field(default_factory=list)
    """Files that it had before."""
    faults: list[str] = field(default_factory=list)
    """What is wrong, in words that name the file."""
    not_ingested: list[str] = field(default_factory=list)
    """Logs that were copied and that the store does not have (yet)."""
    restored: list[str] = field(default_factory=list)


class Archive:
    """An archive at a folder or URL."""

    def __init__(self, url: str) -> None:
        self.url = url
        self._fs, base = opened_url(url)
        self._root = base.rstrip("/")
        self._is_folder = "file" in self._fs.protocol or "local" in self._fs.protocol

    @classmethod
    def of(cls, url: str, session: Session) -> Self:
        """Return the archive; a relative folder counts from the survey file's."""
        return cls(url if "://" in url else str(session.survey.resolve(Path(url))))

    def files(self) -> dict[str, dict[str, Any]]:
        """Return the listed files by their places: bytes, digest, path from the survey file's folder.

        Raises
        ------
        DamagedError
            where the list is damaged.
        """
        path = f"{self._root}/{LIST}"
        if not self._fs.exists(path):
            return {}
        try:
            return {place: dict(of) for place, of in parse_checked(self._fs.cat_file(path))["files"].items()}
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise DamagedError(
                f"the archive's list is damaged: {error}", change="archive again: files that are whole stay", file=path
            ) from error

    def write_list(self, survey: str, files: Mapping[str, Mapping[str, Any]]) -> None:
        """Write the list, atomically."""
        made = dt.datetime.now(dt.UTC).isoformat(timespec="seconds")
        self._put(io.BytesIO(checked_json({"survey": survey, "made_utc": made, "files": files})), LIST)

    def copy(self, file: Path, place: str) -> None:
        """Copy a file."""
        with file.open("rb") as stream:
            self._put(stream, place)

    def digest(self, place: str) -> str:
        """Return the digest of a file of the archive, empty where it is not there; reads all of it."""
        try:
            with self._fs.open(f"{self._root}/{place}", "rb") as stream:
                return stream_digest(stream)
        except FileNotFoundError:
            return ""

    def size(self, place: str) -> int | None:
        """Return the bytes of a file of the archive, None where it is not there."""
        try:
            return int(self._fs.size(f"{self._root}/{place}"))
        except FileNotFoundError:
            return None

    def remove(self, place: str) -> None:
        """Remove a file if it is there, with what a stopped command had written of it."""
        path = f"{self._root}/{place}"
        for one in (path, str(_part_of(Path(path)))) if self._is_folder else (path,):
            with contextlib.suppress(FileNotFoundError):
                self._fs.rm_file(one)

    def fetch(self, place: str, file: Path) -> None:
        """Copy a file of the archive to a local place."""
        with self._fs.open(f"{self._root}/{place}", "rb") as stream:
            _copy_whole(stream, file)

    def _put(self, stream: IO[bytes], place: str) -> None:
        path = f"{self._root}/{place}"
        if self._is_folder:
            _copy_whole(stream, Path(path))
            return
        with self._fs.open(path, "wb") as target:
            shutil.copyfileobj(stream, target, _CHUNK)


def _copy_whole(stream: IO[bytes], file: Path) -> None:
    """Write a local file under another name first, so that it is there whole or not at all."""
    file.parent.mkdir(parents=True, exist_ok=True)
    part = _part_of(file)
    with part.open("wb") as target:
        shutil.copyfileobj(stream, target, _CHUNK)
    part.replace(file)


def _part_of(file: Path) -> Path:
    """Return the name under which a local file is written first."""
    return file.with_name(f".{file.name}.part")


def archive(
    session: Session, survey_file: Path, url: str, report: Callable[[int, int], None] = lambda _a, _b: None
) -> Archived:
    """Copy the raw logs, the survey file and the rig file to an archive, and read each copy back.

    A file that the archive lists with the same digest, and has in its size, is not copied again.

    Raises
    ------
    RunError
        where a log of the survey file cannot be read.
    """
    planned, unplanned = logs_of(session)
    if unplanned:
        raise RunError(f"a log cannot be archived: {unplanned[0].error}", change="put it right, and archive again")
    store, folder, kept = session.store, session.survey.folder, Archive.of(url, session)
    wanted = {survey_file.resolve(): ""}
    if isinstance(session.survey.config.rig, Path):
        wanted[session.survey.resolve(session.survey.config.rig)] = ""
    done = Archived()
    for log in planned:
        companions = log.format.companions(log.source.path, log.source.options)
        wanted |= files_of(store, folder, log.source.path, log.format, companions)
        if not has_log(store, log.key):
            done.not_ingested.append(str(log.config.path))
    listed = _listed(kept)
    for number, (file, ingested) in enumerate(wanted.items(), 1):
        name, digest = listed_name(file, folder), ingested or file_digest(file)
        place = archive_place(name)
        known, size = listed.get(place), file.stat().st_size
        if known and known["digest"] == digest and kept.size(place) == known["bytes"] == size:
            done.there.append(name)
        elif fault := _copied(kept, file, place, digest):
            kept.remove(place)
            done.faults.append(f"{name}: {fault}")
            listed.pop(place, None)
        else:
            done.copied.append(name)
            listed[place] = {"path": name, "bytes": size, "digest": digest}
        report(number, len(wanted))
    kept.write_list(session.survey.config.id, dict(sorted(listed.items())))
    return done


def check_archive(session: Session, url: str, report: Callable[[int, int], None] = lambda _a, _b: None) -> Archived:
    """Read every file of an archive, and compare it with the list."""
    kept, done = Archive.of(url, session), Archived()
    gone = {one.path for one in forgotten_pictures(session.store)}
    files = kept.files()
    if not files:
        raise StoreError(
            "there is no archive", expected=f"a file {LIST}", change="name its folder or URL", file=kept.url
        )
    for number, (place, of) in enumerate(files.items(), 1):
        found = kept.digest(place)
        if of["path"] in gone and found:
            done.faults.append(
                f"{place}: it is among the forgotten pictures; `roadscan forget --archive` removes it here"
            )
        elif found == of["digest"]:
            done.there.append(of["path"])
        else:
            done.faults.append(f"{place}: {'its bytes are others' if found else 'it is not there'}")
        report(number, len(files))
    return done


def restore(session: Session, url: str, report: Callable[[int, int], None] = lambda _a, _b: None) -> Archived:
    """Copy files that are not at their places back from an archive; those that are there stay as they are.

    Pictures that were forgotten stay where they are, and count as faults of the archive.
    """
    kept, done = Archive.of(url, session), Archived()
    gone = {one.path for one in forgotten_pictures(session.store)}
    files = kept.files()
    for number, (place, of) in enumerate(files.items(), 1):
        file = session.survey.resolve(Path(of["path"]))
        if of["path"] in gone:
            done.faults.append(f"{place}: it is among the forgotten pictures; nothing was restored of it")
        elif file.exists():
            done.there.append(of["path"])
        elif kept.digest(place) != of["digest"]:
            done.faults.append(
                f"{place}: its bytes are others than those that were archived; nothing was restored of it"
            )
        else:
            kept.fetch(place, file)
            done.restored.append(of["path"])
        report(number, len(files))
    return done


def _copied(kept: Archive, file: Path, place: str, digest: str) -> str:
    """Copy a file and read the copy; return what is wrong with it, empty where it has the digest."""
    kept.copy(file, place)
    if kept.digest(place) == digest:
        return ""
    if file_digest(file) == digest:
        return "the copy holds other bytes than were written; archive again"
    return "its bytes are others than those that were ingested; `roadscan run` reads it again"


def _listed(kept: Archive) -> dict[str, dict[str, Any]]:
    """Return what an archive lists; nothing where the list is damaged, so that all files are looked at anew."""
    try:
        return kept.files()
    except DamagedError:
        return {}


def archive_place(name: str) -> str:
    """Return where a file lies in an archive: files outside of the survey's folder are distinguished by their paths."""
    path = PurePosixPath(name)
    if not path.is_absolute() and ".." not in path.parts:
        return name
    return f"outside/{hashlib.blake2b(name.encode(), digest_size=4).hexdigest()}/{path.name}"
