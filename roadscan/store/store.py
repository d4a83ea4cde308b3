"""The store: one survey's tables, tiles, products and manifest below one root.

    <store>/survey=<id>/tables/<table>/run=<run>/sensor=<sensor>/log=<key>/gps_bin_s=<start>/part-<k>.parquet
    <store>/survey=<id>/tiles/<product>/<column>_<row><suffix>
    <store>/survey=<id>/products/<product>/<file>
    <store>/survey=<id>/manifest/…

A store is a folder or an object-store URL (fsspec). A file is written under a temporary name, then
published by rename (folder) or by one upload (object store); readers never see half of it.

In a folder, what other files are judged by (records, small tables) and what cannot be made again (ingested rows) is on
the disk before its name is seen: a power loss leaves it whole or absent. Files of products are not waited for.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import tempfile
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

import fsspec
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.core.errors import DamagedError, FullDiskError, RoadscanError, StoreError
from roadscan.core.extras import need
from roadscan.store.digest import UNREADABLE, check_seal, without_seal
from roadscan.store.holders import Look, at_once, look_of, looking, own_tag, tag_lives
from roadscan.store.lease import FolderPlace, Lease, ObjectPlace, changed_s
from roadscan.store.written_by import VERSION_FILE, refuse_newer, version_of

try:
    import fcntl
except ImportError:  # systems without such locks
    fcntl = None  # type: ignore[assignment]

_STAGING: Final = ".staging"
_LOCK: Final = "manifest/lock"
_STRAY_S: Final = 6 * 3600.0
"""Age (s) at which a temporary file of another machine is removed: no single task takes that long."""

_NO_ROOM_BYTES: Final = 8 << 20
"""A writer that fails without a reason while less is free (bytes) is taken to have filled the disk: GDAL and others
write blocks of some megabytes."""
_MAKE_ROOM: Final = (
    "see to more room, and run again: what is finished stays, and the next run goes on where this one stopped"
)

_AT_ONCE_BYTES: Final = 16 << 20
"""Largest object (bytes) that is copied by one request and through memory."""

MADE_AGAIN: Final = "run `roadscan verify`, which finds all such files; the next run then makes them again"
"""How a damaged product is repaired."""

_T = TypeVar("_T")

_PUT: Final = [0]
"""Bytes of the files that this process has published."""


def count_put(size: int) -> None:
    """Count bytes that this process has published."""
    _PUT[0] += size


def bytes_put() -> int:
    """Return the bytes of all files that this process has published in stores so far."""
    return _PUT[0]


class Store:
    """Location of one survey's store; cheap to create, and safe to send to a worker."""

    def __init__(self, url: str, survey_id: str) -> None:
        self.url = url
        self.survey_id = survey_id
        self.fs, base = opened_url(url)
        self.root = f"{base.rstrip('/')}/survey={survey_id}"
        self.is_folder = "file" in self.fs.protocol or "local" in self.fs.protocol
        self._lease: Lease | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle without the file system, which workers open themselves."""
        return (Store, (self.url, self.survey_id))

    def path(self, relative: str) -> str:
        """Return the full path in the file system `fs` of a path below the root."""
        return f"{self.root}/{relative}"

    def exists(self, relative: str) -> bool:
        """Return True if the file or folder exists; StoreError where the store does not answer."""
        with self._reached():
            known = None if (look := self._look()) is None else look.exists(relative)
            return bool(self.fs.exists(self.path(relative))) if known is None else known

    @contextlib.contextmanager
    def _reached(self) -> Iterator[None]:
        try:
            yield
        except RoadscanError:
            raise
        except Exception as error:  # each library of an object store has different ones
            raise StoreError(
                f"the store {self.url} cannot be reached: {error}",
                change="see to its address, the network and your keys",
            ) from error

    def size(self, relative: str) -> int | None:
        """Return the bytes of a file, None where it is missing."""
        if self.is_folder:
            return _bytes_of(self.path(relative))
        if (look := self._look()) is not None:
            with self._reached():
                size = look.size(relative)
            if size is not None or look.is_whole:
                return size
        try:
            return int(self.fs.size(self.path(relative)))
        except FileNotFoundError:
            return None

    def sizes(self, paths: Iterable[str]) -> Iterator[int | None]:
        """Yield the same of many files."""
        return (_bytes_of(f"{self.root}/{path}") for path in paths) if self.is_folder else map(self.size, paths)

    def files(self, relative: str, suffix: str = "") -> list[str]:
        """Return the files below a folder, relative to the root, sorted."""
        if (look := self._look()) is not None:
            with self._reached():
                known = look.files(relative)
            if known is not None:
                return sorted(f for f in known if f.endswith(suffix))
        if not self.exists(relative):
            return []
        found = self.fs.find(self.path(relative))
        start = len(self.fs._strip_protocol(self.root)) + 1
        return sorted(f[start:] for f in found if f.endswith(suffix))

    def state(self, relative: str) -> tuple[int, str] | None:
        """Return bytes and ETag of an object, None where only the store can tell."""
        return None if (look := self._look()) is None else look.state(relative)

    def changed_s(self, relative: str) -> float:
        """Return when a file was written (Unix s), by the store's clock."""
        return changed_s(self.fs.info(self.path(relative)))

    def now_s(self) -> float:
        """Return what the store's clock says (Unix s): that of the file server, or of the object store."""
        return self._lease_place().now_s()

    def read_bytes(self, relative: str) -> bytes:
        """Return the content of a small file."""
        look = self._look()
        if look is not None and (known := look.content(relative)) is not None:
            return known
        try:
            content = bytes(self.fs.cat_file(self.path(relative), **at_once(self.fs)))
        except FileNotFoundError as error:
            raise StoreError("the file is missing from the store", file=self.path(relative)) from error
        except IsADirectoryError as error:
            raise StoreError("a folder stands where a file belongs", change="remove it", file=error.filename) from error
        except OSError as error:
            raise StoreError(
                f"the file cannot be read: {error.strerror or error}",
                change="see to its rights and to the disk",
                file=self.path(relative),
            ) from error
        if look is not None:
            look.keep(relative, content)
        return content

    def is_small(self, relative: str) -> bool:
        """Return whether an object is known to be small enough for one request and for memory."""
        look = self._look()
        size = None if look is None else look.size(relative)
        return size is not None and size <= _AT_ONCE_BYTES

    def read_table(self, relative: str, columns: Sequence[str] | None = None, change: str = MADE_AGAIN) -> pa.Table:
        """Return a small Parquet file, its seal and its page checksums verified; `change` says how to repair it.

        Read by this thread alone: a thread of Arrow's that still releases the bytes when the interpreter ends would
        end the process with SIGABRT (`pq.read_table` hands them to such threads).
        """
        return self.parse_table(self.read_bytes(relative), relative, columns, change)

    def parse_table(
        self, content: bytes, relative: str, columns: Sequence[str] | None = None, change: str = MADE_AGAIN
    ) -> pa.Table:
        """Return the same of content that was read from there."""
        try:
            check_seal(content)
            file = pq.ParquetFile(pa.BufferReader(content), page_checksum_verification=True)
            return without_seal(file.read(None if columns is None else list(columns), use_threads=False))
        except UNREADABLE as error:
            raise DamagedError(f"the file is damaged: {error}", change=change, file=self.path(relative)) from error

    def write_bytes(self, relative: str, content: bytes, *, lasting: bool = True) -> None:
        """Write a small file atomically; StoreError where the store cannot be written.

        One that is `lasting` is on the disk when this returns, with its name.
        """
        self._check_lease()
        with _in_words(self.path(relative)):
            self._write_bytes(relative, content, lasting)

    def _write_bytes(self, relative: str, content: bytes, lasting: bool) -> None:
        if not self.is_folder:
            self.fs.pipe_file(self.path(relative), content)
            self._wrote(relative, len(content), content)
            return
        temporary = self._temporary()
        try:
            with _made(temporary.parent, lambda: temporary.open("wb"), lasting=True) as stream:
                stream.write(content)
                if lasting:
                    stream.flush()
                    os.fsync(stream.fileno())
            self.publish(temporary, relative, lasting=lasting)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise

    @contextlib.contextmanager
    def scratch(self) -> Iterator[Path]:
        """Return a temporary local folder, on the store's disk where it is a folder."""
        if self.is_folder:
            folder = self._temporary()
            with _in_words(str(folder)):
                _made(folder.parent, folder.mkdir, lasting=True)
        else:
            folder = Path(tempfile.mkdtemp(prefix="roadscan-"))
        try:
            with naming_full_disk(folder):
                yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def publish(self, local: Path, relative: str, *, lasting: bool = False) -> None:
        """Move a finished local file into the store under its final name, durably if it is `lasting`."""
        self._check_lease()
        target = self.path(relative)
        count_put(local.stat().st_size)
        if self.is_folder:
            try:
                _made(Path(target).parent, lambda: local.replace(target), lasting)
            except IsADirectoryError:
                self.set_aside(relative)
                local.replace(target)
            if lasting:
                _sync_folder(Path(target).parent)
        else:
            size = local.stat().st_size
            self.fs.put_file(str(local), target)
            local.unlink()
            self._wrote(relative, size)

    def publish_folder(self, local: Path, relative: str) -> None:
        """Move a finished local folder durably into the store, replacing one of that name.

        An object store shows its files one by one, and removes those that are not of it last: only the record that is
        written afterwards tells that they are there.
        """
        self._check_lease()
        if self.is_folder:
            for path in (local, *local.rglob("*")):
                sync = _sync_folder if path.is_dir() else _sync_file
                sync(path)
            target = Path(self.path(relative))
            _make_folder(target.parent, lasting=True)
            if target.exists():
                self.remove(relative)
            local.rename(target)
            _sync_folder(target.parent)
            return
        files = {f"{relative}/{p.relative_to(local).as_posix()}": p for p in local.rglob("*") if p.is_file()}
        for name, file in sorted(files.items()):
            self.fs.put_file(str(file), self.path(name))
            self._wrote(name, file.stat().st_size)
        for name in self.files(relative):
            if name not in files:
                self.remove(name)

    def remove(self, relative: str) -> None:
        """Remove a file or folder if it exists; a folder disappears at once."""
        self._check_lease()
        if not self.is_folder:
            if self.exists(relative):
                self.fs.rm(self.path(relative), recursive=True)
                if (look := self._look()) is not None:
                    look.removed(relative)
            return
        path = Path(self.path(relative))
        if not path.is_dir():
            path.unlink(missing_ok=True)
            return
        doomed = self._temporary()
        _made(doomed.parent, lambda: path.rename(doomed))
        shutil.rmtree(doomed, ignore_errors=True)

    def set_aside(self, relative: str, *, keep: bool = False) -> str:
        """Move a damaged file below ``damaged/`` for later examination; return its name there.

        With `keep` it stays under its old name too, until another takes its place at once.
        """
        self._check_lease()
        aside, number = f"damaged/{relative}", 1
        while self.exists(aside):
            number += 1
            aside = f"damaged/{relative}.{number}"
        with _in_words(self.path(aside)):
            if self.is_folder:
                Path(self.path(aside)).parent.mkdir(parents=True, exist_ok=True)
                _move_aside(Path(self.path(relative)), Path(self.path(aside)), keep)
            elif keep:
                self.fs.copy(self.path(relative), self.path(aside))
            else:
                self.fs.mv(self.path(relative), self.path(aside))
        if (look := self._look()) is not None:
            look.forget()
        return aside

    def local_copy(self, relative: str, folder: Path) -> Path:
        """Return the path of a local file with the content of a stored one (itself, where the store is a folder)."""
        if self.is_folder:
            return Path(self.path(relative))
        target, size = folder / Path(relative).name, self.size(relative)
        if size is None or size > _AT_ONCE_BYTES:
            self.fs.get_file(self.path(relative), str(target))
        else:
            target.write_bytes(self.fs.cat_file(self.path(relative), **at_once(self.fs)))
        return target

    @contextlib.contextmanager
    def copied(self, relative: str, folder: Path) -> Iterator[Path]:
        """Return the same; a copy is removed afterwards."""
        local = self.local_copy(relative, folder)
        try:
            yield local
        finally:
            if not self.is_folder:
                local.unlink(missing_ok=True)

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Lock out a second run, also one on another machine; leftovers of dead runs are cleared.

        Raises
        ------
        StoreError
            where another run has the store; and at a later change, where this one has lost it.
        """
        file, lease = self.path(_LOCK), self._new_lease()
        with _in_words(file):
            if self.is_folder:
                _make_folder(Path(file).parent, lasting=True)
        with _in_words(file), contextlib.nullcontext() if self.is_folder else self._reached():
            lease.take()
        try:
            self._lease = lease
            if self.is_folder:
                self.clear_staging()
            with self.looked(anew=True):  # somebody else may have written before
                self.check_version()
                yield
        finally:
            self._lease = None
            lease.give_back()

    def last_version(self) -> str:
        """Return the version of roadscan that wrote last, empty where that is not known."""
        if not self.exists(VERSION_FILE):
            return ""
        try:
            return version_of(self.read_bytes(VERSION_FILE))
        except ValueError:
            return ""

    def check_version(self) -> None:
        """Raise StoreError where a newer version of roadscan than this one wrote to the store."""
        if version := self.last_version():
            refuse_newer(version, self.root)

    def check_free(self) -> None:
        """Raise StoreError where another run has the store now: before long work, since :meth:`lock` asks again."""
        with contextlib.nullcontext() if self.is_folder else self._reached():
            self._new_lease().check_free()

    def _new_lease(self) -> Lease:
        return Lease(self._lease_place())

    def _lease_place(self) -> FolderPlace | ObjectPlace:
        file = self.path(_LOCK)
        return FolderPlace(Path(file), self._new_temporary, alone_in) if self.is_folder else ObjectPlace(self.fs, file)

    @contextlib.contextmanager
    def looked(self, *, anew: bool = False) -> Iterator[None]:
        """Ask an object store for nothing twice, as long as nobody else writes to it (a folder is asked each time).

        What is known already holds, unless it is asked for `anew`.
        """
        with contextlib.ExitStack() as stack:
            if not self.is_folder:
                stack.enter_context(looking((self.url, self.survey_id), self.fs, self.root, anew=anew))
            yield

    def told(self, written: Iterable[tuple[str, int]]) -> None:
        """Note the paths and bytes of files that workers wrote, so that nobody asks an object store for them."""
        if (look := self._look()) is not None:
            for path, size in written:
                look.wrote(path, size)

    def _look(self) -> Look | None:
        return None if self.is_folder else look_of((self.url, self.survey_id))

    def _wrote(self, relative: str, size: int, content: bytes | None = None) -> None:
        if (look := self._look()) is not None:
            look.wrote(relative, size, content)

    def _check_lease(self) -> None:
        if self._lease is not None:
            self._lease.check()

    def _temporary(self) -> Path:
        """Return a new name on the store's disk, which tells who made it."""
        return Path(self.path(_STAGING)) / f"{own_tag()}-{uuid.uuid4().hex}"

    def _new_temporary(self) -> Path:
        """Return the same in a folder that is there."""
        named = self._temporary()
        _make_folder(named.parent, lasting=True)
        return named

    def clear_staging(self) -> None:
        """Remove temporary files of dead processes, and of other machines' after some hours."""
        parent = Path(self.path(_STAGING))
        for left in parent.iterdir() if parent.is_dir() else ():
            lives = tag_lives(left.name)
            if lives or (lives is None and not _is_stray(left)):
                continue
            shutil.rmtree(left, ignore_errors=True)
            left.unlink(missing_ok=True) if left.is_file() else None


def _bytes_of(file: str) -> int | None:
    """Return the bytes of a file, None where it is missing; of 400,000, `pathlib` takes twice the time."""
    try:
        return os.stat(file).st_size  # noqa: PTH116
    except (FileNotFoundError, NotADirectoryError):
        return None


def _is_stray(left: Path) -> bool:
    """Return True if nothing in a temporary file or folder has changed for hours."""
    with contextlib.suppress(OSError):
        return time.time() - max(p.stat().st_mtime for p in (left, *left.rglob("*"))) > _STRAY_S
    return False


def _move_aside(file: Path, aside: Path, keep: bool) -> None:
    if keep:
        with contextlib.suppress(OSError):  # file systems without links
            aside.hardlink_to(file)
            return
    file.rename(aside)


def _made(folder: Path, write: Callable[[], _T], lasting: bool = False) -> _T:
    """Return the result of `write`, creating its folder where it is missing."""
    try:
        return write()
    except FileNotFoundError:
        _make_folder(folder, lasting)
        return write()


def _make_folder(folder: Path, lasting: bool) -> None:
    """Create a folder and its missing parents, durably if they are `lasting`."""
    missing = [one for one in (folder, *folder.parents) if not one.exists()] if lasting else []
    folder.mkdir(parents=True, exist_ok=True)
    for one in missing:
        _sync_folder(one.parent)


def _sync_folder(folder: Path) -> None:
    """Flush the names in a folder to the disk, where the system can do that."""
    with contextlib.suppress(OSError):
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)


def _sync_file(path: Path) -> None:
    """Flush a file's bytes to the disk; OSError where that fails."""
    with path.open("rb+") as stream:
        os.fsync(stream.fileno())


def opened_url(url: str) -> tuple[Any, str]:
    """Return file system and path of a store; a folder's name may contain the URL separator ``::`` of fsspec.

    Lists of what an object store holds are not kept: workers write to it at the same time.
    """
    if "://" in url:
        if url.startswith(("s3://", "s3a://")):
            need("s3fs", f"the store {url}")
        try:
            opened: tuple[Any, str] = fsspec.core.url_to_fs(url, use_listings_cache=False)
        except (ImportError, ValueError) as error:
            raise StoreError(
                f"the store {url} cannot be opened: {error}",
                expected="a folder, or the URL of an object store",
                change="install the package of fsspec for such stores",
            ) from error
        return opened
    folders = fsspec.filesystem("file")
    return folders, folders._strip_protocol(url)


def put_file(fs: Any, path: str, content: bytes) -> None:
    """Write a small file that belongs to no survey, whole or not at all; one that has this content stays as it is."""
    with _in_words(path):
        if fs.exists(path) and bytes(fs.cat_file(path)) == content:
            return
        if "file" not in fs.protocol and "local" not in fs.protocol:
            fs.pipe_file(path, content)
            return
        target = Path(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = target.with_name(f".{os.getpid()}-{uuid.uuid4().hex}")
        try:
            temporary.write_bytes(content)
            temporary.replace(target)
        finally:
            temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def naming_full_disk(folder: Path) -> Iterator[None]:
    """Report which disk is full where a writer fails for want of room, whatever its library's message.

    Raises
    ------
    FullDiskError
        in place of what the writer raised.
    """
    try:
        yield
    except RoadscanError:
        raise
    except Exception as error:
        if not (_names_want_of_room(error) or _has_no_room(folder)):
            raise
        raise full_disk(folder, error) from error


def full_disk(folder: Path, error: Exception) -> FullDiskError:
    """Return the error for a writer that failed in a folder for want of room."""
    there = next((one for one in (folder, *folder.parents) if one.exists()), folder)
    if _STAGING in folder.parts:  # name the store, not a temporary folder
        folder = Path(*folder.parts[: folder.parts.index(_STAGING)])
    with contextlib.suppress(OSError):
        room = shutil.disk_usage(there)
        arrived = f"the disk is full: {room.free / 1e6:,.1f} MB are free of {room.total / 1e6:,.0f} MB ({error})"
        return FullDiskError(arrived, change=_MAKE_ROOM, file=folder)
    return FullDiskError(f"the disk is full ({error})", change=_MAKE_ROOM, file=folder)


def _names_want_of_room(error: BaseException) -> bool:
    """Return True if an error, or one of its causes, is that of a full disk or an exhausted quota."""
    found: BaseException | None = error
    while found is not None:
        if isinstance(found, OSError) and found.errno in (errno.ENOSPC, errno.EDQUOT):
            return True
        if any(os.strerror(code) in str(found) for code in (errno.ENOSPC, errno.EDQUOT)):
            return True
        found = found.__cause__ or found.__context__
    return False


def _has_no_room(folder: Path) -> bool:
    """Return True if almost nothing is free where a writer failed without a reason, as GDAL does."""
    try:
        return shutil.disk_usage(folder).free < _NO_ROOM_BYTES
    except OSError:
        return False


@contextlib.contextmanager
def _in_words(file: str) -> Iterator[None]:
    """Convert the errors of a full or read-only disk to errors of roadscan."""
    try:
        yield
    except OSError as error:
        if _names_want_of_room(error):
            raise full_disk(Path(file).parent, error) from error
        raise StoreError(
            f"the store cannot be written: {error.strerror or error}",
            change="see to room, rights and the disk itself, and run again: what is finished stays",
            file=file,
        ) from error


@contextlib.contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Lock out other processes of this machine: of several that find the lock of a dead run, one takes it."""
    with contextlib.ExitStack() as stack:
        if fcntl is not None:
            opened = os.open(folder, os.O_RDONLY)
            stack.callback(os.close, opened)
            with contextlib.suppress(OSError):  # file systems without such locks
                fcntl.flock(opened, fcntl.LOCK_EX)
        yield
