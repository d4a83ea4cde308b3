"""A read-only file system for SQL: one survey's files of a store.

DuckDB can confine statements to folders, but not to reading: what may be read may be written (``COPY … TO``, which
may stand inside a ``WITH``, ``ATTACH``, ``EXPORT DATABASE``). So statements access files only through this file system,
which has no way to write, and DuckDB's is switched off.
"""

from __future__ import annotations

import datetime as dt
import io
import os
import stat
import threading
from typing import Any, Final, Protocol

from fsspec import AbstractFileSystem

from roadscan.store.stamp import Stamp, stamp_of_info, stamp_of_stat
from roadscan.store.store import Store

PROTOCOL: Final = "store"


def url(store: Store, path: str) -> str:
    """Return the name of a file of the store in statements."""
    return f"{PROTOCOL}://survey={store.survey_id}/{path}"


class OpenedFiles(Protocol):
    """What a connection opens and what it was denied."""

    @property
    def refused(self) -> list[str]:
        """Denied requests, in words."""
        ...

    def last(self) -> str | None:
        """Return the file that was opened last."""
        ...

    def forget(self) -> None:
        """Count no file as opened by now."""
        ...


class StoreFiles(AbstractFileSystem):  # type: ignore[misc]
    """One survey's files as ``store://survey=<id>/…``; it records which of them are opened.

    Anything else is refused: other modes than reading, ``..``, and links that lead out of the survey's folder.
    """

    protocol = PROTOCOL
    cachable = False
    root_marker = ""

    def __init__(self, store: Store) -> None:
        super().__init__()
        self._store = store
        self._top = f"survey={store.survey_id}"
        self._root = os.path.realpath(store.root) if store.is_folder else None
        self._inside: set[str] = set()
        """Folders whose links were followed and lead inside."""
        self._alone = threading.Lock()  # DuckDB opens files from several threads
        self.opened: dict[str, Stamp] = {}
        """Opened files, relative to the survey's root, with their stamps at that time."""
        self._refused: list[str] = []

    @property
    def refused(self) -> list[str]:
        """Denied requests, in words."""
        return self._refused

    def last(self) -> str | None:
        """Return the file that was opened last."""
        return next(reversed(self.opened), None)

    def forget(self) -> None:
        """Count no file as opened by now."""
        self.opened.clear()

    def open(self, path: str, mode: str = "rb", **_: Any) -> Any:
        """Return a file's bytes; PermissionError for any other mode and for files outside."""
        if mode != "rb":
            self._refuse(f"{path} cannot be written: SQL only reads the store")
        place = self._place(path)
        stream: _LocalFile
        if self._root is not None:
            stream = _LocalFile(place)
            stamp = stream.stamp()
        else:
            stamp = stamp_of_info(self._store.fs.info(place))
            stream = _RemoteFile(self._store.fs.open(place, "rb"), stamp.bytes)
        with self._alone:
            self.opened.setdefault(self._relative(path), stamp)
        return stream

    def info(self, path: str, **_: Any) -> dict[str, Any]:
        """Return name, size and kind of a file or folder; FileNotFoundError where there is none."""
        place = self._place(path)
        if self._root is not None:
            local = os.stat(place)  # noqa: PTH116 — thousands of them
            kind = "directory" if stat.S_ISDIR(local.st_mode) else "file"
            return {"name": self._strip_protocol(path), "size": local.st_size, "type": kind}
        found = self._store.fs.info(place)
        return {"name": self._strip_protocol(path), "size": found["size"], "type": found["type"]}

    def modified(self, path: str) -> Any:
        """Return the time of the last change."""
        place = self._place(path)
        if self._root is not None:
            return dt.datetime.fromtimestamp(os.stat(place).st_mtime, dt.UTC)  # noqa: PTH116 — thousands of them
        return self._store.fs.modified(place)

    def ls(self, path: str, detail: bool = True, **_: Any) -> list[Any]:
        """Return the entries of a folder, without links that lead outside."""
        found = []
        for entry in self._store.fs.ls(self._place(path), detail=True):
            name = f"{self._strip_protocol(path).rstrip('/')}/{str(entry['name']).rstrip('/').rsplit('/', 1)[1]}"
            found.append({"name": name, "size": entry["size"], "type": entry["type"]})
        return found if detail else [one["name"] for one in found]

    def glob(self, path: str, maxdepth: int | None = None, **more: Any) -> list[Any]:
        """Return the files that match a pattern; a name without one matches itself."""
        if not any(sign in path for sign in "*?["):
            self._relative(path)
            return [path.removeprefix(f"{PROTOCOL}://")]
        return list(super().glob(path, maxdepth=maxdepth, **more))

    def _relative(self, path: str) -> str:
        """Return the path below the survey's root."""
        top, _, relative = path.removeprefix(f"{PROTOCOL}://").partition("/")
        if top != self._top or ".." in relative.split("/"):
            self._refuse(f"{path} is no file of the store: its files are {PROTOCOL}://{self._top}/…")
        return relative

    def _place(self, path: str) -> str:
        """Return the path in the store's file system; PermissionError outside of the survey's folder."""
        place = self._store.path(self._relative(path))
        if self._root is not None:
            folder = place.rsplit("/", 1)[0]
            known = folder in self._inside or place == self._store.root or self._leads_inside(folder)
            if not known or (os.path.islink(place) and not self._leads_inside(place)):  # noqa: PTH114 — thousands
                self._refuse(f"{path} is a link that leads out of the store")
            self._inside.add(folder)
        return place

    def _leads_inside(self, place: str) -> bool:
        real = os.path.realpath(place)
        return real == self._root or real.startswith(f"{self._root}/")

    def _refuse(self, words: str) -> None:
        self._refused.append(words)
        raise PermissionError(words)


class _LocalFile(io.RawIOBase):
    """A file with a position for each thread: DuckDB's threads share it, and seek and read in two calls."""

    def __init__(self, place: str) -> None:
        self._file = os.open(place, os.O_RDONLY | getattr(os, "O_BINARY", 0))
        self._at = threading.local()

    def stamp(self) -> Stamp:
        """Return size and time of the open file."""
        return stamp_of_stat(os.fstat(self._file))

    def readable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True."""
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move this thread's position."""
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self.tell(), os.SEEK_END: self._bytes()}[whence]
        self._at.position = start + offset
        return start + offset

    def tell(self) -> int:
        """Return the position of this thread."""
        return int(getattr(self._at, "position", 0))

    def read(self, size: int | None = -1) -> bytes:
        """Return bytes from this thread's position."""
        position = self.tell()
        wanted = self._bytes() - position if size is None or size < 0 else size
        content = self._take(position, max(wanted, 0))
        self._at.position = position + len(content)
        return content

    def close(self) -> None:
        """Close the file; DuckDB may drop it without calling this."""
        if not self.closed:
            super().close()
            self._release()

    def _bytes(self) -> int:
        return os.fstat(self._file).st_size

    def _take(self, position: int, size: int) -> bytes:
        return os.pread(self._file, size, position)

    def _release(self) -> None:
        os.close(self._file)


class _RemoteFile(_LocalFile):
    """The same for an object store, whose library has one position per file."""

    def __init__(self, stream: Any, size: int) -> None:
        self._stream, self._size = stream, size
        self._at = threading.local()
        self._alone = threading.Lock()

    def _bytes(self) -> int:
        return self._size

    def _take(self, position: int, size: int) -> bytes:
        with self._alone:
            self._stream.seek(position)
            return bytes(self._stream.read(size))

    def _release(self) -> None:
        self._stream.close()
