"""Who holds a store: processes, and what is seen of a lease from beside.

What the one writer of an object store knows of it: names, sizes and small contents, so that it asks for none twice.

It is valid while the store's lease is held: nobody else writes then but the workers of this run. What they write is
told here by its record. Between the start of tasks and the next listing, a name that is not known may be new, and the
store is asked for it. A command that only looks sees the store as it was when it began.
"""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import functools
import hashlib
import os
import re
import shutil
import socket
import uuid
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

_CONTENT_BYTES: Final = 1 << 20
"""Largest content (bytes) that is kept: that of records and small tables …"""
_ALL_BYTES: Final = 128 << 20
"""… and of all that are kept: those of a network's records are let go, the oldest first."""

_RECORDS: Final = "manifest/"
"""Folder of records: this process alone writes over one, and workers add those of new logs."""


class Look:
    """One store's names, as listed when the first question came."""

    def __init__(self, fs: Any, root: str, before: Look | None = None) -> None:
        """Reuse what an earlier look (`before`) read of the same store, where names of content (ETag) are equal."""
        self._fs, self._root = fs, root
        self._before = {} if before is None else before._named_contents()
        """Contents that were read before the listing, by path and ETag."""
        self._states: dict[str, str] = {}
        """The store's name of each content as it was listed."""
        self._sizes: dict[str, int] | None = None
        self._folders: Counter[str] = Counter()
        """Number of files below each folder."""
        self._contents: dict[str, bytes] = {}
        self._held_bytes = 0
        self.is_whole = True
        """False where workers may have written files that are not known here."""

    def size(self, path: str) -> int | None:
        """Return the bytes of a file, None where it is not known."""
        return self._listed().get(path)

    def state(self, path: str) -> tuple[int, str] | None:
        """Return bytes and ETag of a file that is as it was listed, None where only the store can tell."""
        size, state = self._listed().get(path), self._states.get(path)
        return None if size is None or state is None else (size, state)

    def exists(self, path: str) -> bool | None:
        """Return True if the file or folder exists; None where only the store can tell."""
        if path in self._listed() or path in self._folders:
            return True
        return False if self.is_whole else None

    def files(self, folder: str) -> list[str] | None:
        """Return the files below a folder (or the file itself), None where only the store can tell."""
        listed = self._listed()
        if not self.is_whole:
            return None
        return [folder] if folder in listed else [path for path in listed if path.startswith(f"{folder}/")]

    def content(self, path: str) -> bytes | None:
        """Return the content of a small file that was read or written before."""
        known = path in self._listed() and (self.is_whole or path.startswith(_RECORDS))
        return self._contents.get(path) if known else None

    def keep(self, path: str, content: bytes) -> None:
        """Keep the content of a file that was read."""
        if len(content) > _CONTENT_BYTES:
            return
        self._held_bytes += len(content) - len(self._contents.pop(path, b""))
        self._contents[path] = content
        while self._held_bytes > _ALL_BYTES:
            self._held_bytes -= len(self._contents.pop(next(iter(self._contents))))

    def wrote(self, path: str, size: int, content: bytes | None = None) -> None:
        """Note a file that was written, by this process or by a worker."""
        self._held_bytes -= len(self._contents.pop(path, b""))
        self._states.pop(path, None)
        if content is not None:
            self.keep(path, content)
        if self._sizes is not None:
            if path not in self._sizes:
                self._folders.update(_folders_of(path))
            self._sizes[path] = size

    def removed(self, path: str) -> None:
        """Note that a file or folder is gone."""
        if self._sizes is None:
            return
        if self._sizes.pop(path, None) is not None:
            self._held_bytes -= len(self._contents.pop(path, b""))
            for folder in _folders_of(path):
                self._folders[folder] -= 1
                if not self._folders[folder]:
                    del self._folders[folder]
        elif path in self._folders:
            self.forget()

    def forget(self) -> None:
        """List the store again when the next question comes."""
        self._before = self._named_contents()
        self._sizes, self.is_whole = None, True
        self._folders.clear()
        self._contents.clear()
        self._held_bytes = 0

    def _named_contents(self) -> dict[tuple[str, str], bytes]:
        """Return what was read of files whose state the store has named."""
        return {(path, self._states[path]): c for path, c in self._contents.items() if path in self._states}

    def _take_over(self) -> None:
        """Keep what was read before the listing of files that are still the same."""
        before, self._before = self._before, {}
        for (path, state), content in before.items():
            if self._states.get(path) == state:
                self.keep(path, content)

    def _listed(self) -> dict[str, int]:
        if self._sizes is None:
            try:
                found = self._fs.find(self._root, detail=True)
            except FileNotFoundError:
                found = {}
            start = len(self._fs._strip_protocol(self._root)) + 1
            self._sizes = {path[start:]: int(info["size"]) for path, info in found.items()}
            self._folders = Counter(folder for path in self._sizes for folder in _folders_of(path))
            self._states = {path[start:]: state for path, info in found.items() if (state := str(info.get("ETag", "")))}
            self._take_over()
        return self._sizes


def _folders_of(path: str) -> Iterator[str]:
    """Yield the folders that a file lies in."""
    at = path.find("/")
    while at >= 0:
        yield path[:at]
        at = path.find("/", at + 1)


_LOOKS: Final[dict[tuple[str, str], Look]] = {}
"""The looks of the stores whose lease this process holds, by URL and survey: all its `Store` objects share them."""


@contextlib.contextmanager
def looking(key: tuple[str, str], fs: Any, root: str, *, anew: bool = False) -> Iterator[None]:
    """Remember what an object store holds, from now on, or go on with what is remembered; `anew` lists it again."""
    is_inner = key in _LOOKS
    if anew or not is_inner:
        _LOOKS[key] = Look(fs, root, _LOOKS.get(key))
    try:
        yield
    finally:
        if not is_inner:
            del _LOOKS[key]


def look_of(key: tuple[str, str]) -> Look | None:
    """Return what this process remembers of a store, None where it asks for everything."""
    return _LOOKS.get(key)


def at_once(fs: Any) -> dict[str, int]:
    """Return the options with which a file system reads a small object by one request: s3fs asks for its size first."""
    return {"max_concurrency": 1} if "s3" in fs.protocol else {}


def others_write() -> None:
    """Note that from now on workers may write files of which this process learns later."""
    for look in _LOOKS.values():
        look.is_whole = False


def look_again() -> None:
    """List stores again that workers may have written to."""
    for look in _LOOKS.values():
        if not look.is_whole:
            look.forget()


_START_FIELD: Final = 19
"""Place of the start time in `/proc/PID/stat` behind the program's name: the 22nd field of proc(5)."""


@dataclass(frozen=True)
class Process:
    """A process, distinguished from all others: hosts and containers may have one name, and numbers are given anew."""

    host: str
    """Name of its machine, for words alone."""
    kernel: str
    """Identity of the running system: another one after each boot."""
    numbers: str
    """Namespace of process numbers (containers have their own), empty where the system has none."""
    pid: int
    started: str
    """When it started, in the system's count; empty where that is not known."""

    @classmethod
    def this(cls) -> Self:
        """Return this process."""
        kernel, numbers = _system()
        return cls(socket.gethostname(), kernel, numbers, os.getpid(), _start_of(os.getpid()))

    @classmethod
    def parse(cls, raw: Mapping[str, Any]) -> Self:
        """Return a process from its fields; KeyError or ValueError where they name none."""
        host, kernel, numbers, started = (str(raw[name]) for name in ("host", "kernel", "numbers", "started"))
        return cls(host, kernel, numbers, int(raw["pid"]), started)

    def fields(self) -> dict[str, Any]:
        """Return its fields as JSON has them."""
        return dataclasses.asdict(self)

    @property
    def tag(self) -> str:
        """Return it as part of a file's name; :func:`tag_lives` reads that again."""
        system = hashlib.blake2b(f"{self.kernel} {self.numbers}".encode(), digest_size=4).hexdigest()
        return f"{system}-{self.pid}-{self.started or 0}"

    @property
    def is_seen(self) -> bool:
        """True if this process sees that one's number, and can tell whether it lives."""
        return (self.kernel, self.numbers) == _system()

    @property
    def lives(self) -> bool | None:
        """Whether the process lives; None where that cannot be seen from here."""
        if not self.is_seen:
            return None
        return process_lives(self.pid) and self.started in ("", _start_of(self.pid))

    def __str__(self) -> str:
        """Return its words in messages."""
        return f"process {self.pid} on {self.host}"


def own_tag() -> str:
    """Return the tag of this process."""
    return _tag_of(os.getpid())


def tag_lives(name: str) -> bool | None:
    """Return whether the process lives that a file's name begins with; None where that cannot be seen from here.

    A name that begins with a number alone is one of an older version, on one machine. Other names have no maker.
    """
    parts = name.split("-")
    if parts[0].isdigit() and len(parts) == 2:
        return process_lives(int(parts[0]))
    if len(parts) < 4 or not parts[1].isdigit():
        return False
    if parts[0] != own_tag().partition("-")[0]:
        return None
    return process_lives(int(parts[1])) and parts[2] in ("0", _start_of(int(parts[1])))


def process_lives(pid: int) -> bool:
    """Return True if a process that is seen from here has that number."""
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


@functools.cache
def _tag_of(_pid: int) -> str:
    return Process.this().tag


@functools.cache
def _system() -> tuple[str, str]:
    """Return the identities of the running system and of its process numbers."""
    with contextlib.suppress(OSError):
        kernel = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return kernel, str(Path("/proc/self/ns/pid").readlink())
    return f"host {socket.gethostname()}", ""  # systems without /proc: their name, as the next best


def _start_of(pid: int) -> str:
    """Return when a process started, empty where that cannot be read."""
    with contextlib.suppress(OSError, IndexError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[_START_FIELD]
    return ""


_MADE: Final = re.compile(r"[0-9a-f]{8}-\d+-\d+-[0-9a-f]{32}")
"""What :func:`beside` adds to a name: the tag of a process, and a random number."""
_HERE: Final = -100
"""`AT_FDCWD` of Linux: paths count from the current folder."""
_EXCHANGE: Final = 2
"""`RENAME_EXCHANGE` of Linux's renameat2(2)."""


def beside(place: Path) -> Path:
    """Return a new name beside a file or folder; remove what dead processes left under such names."""
    start = f".{place.name}-"
    for left in place.parent.iterdir() if place.parent.is_dir() else ():
        tag = left.name.removeprefix(start)
        if left.name.startswith(start) and _MADE.fullmatch(tag) and tag_lives(tag) is False:
            shutil.rmtree(left, ignore_errors=True) if left.is_dir() else left.unlink(missing_ok=True)
    return place.parent / f"{start}{own_tag()}-{uuid.uuid4().hex}"


def put_folder(made: Path, place: Path) -> None:
    """Put a folder into its place, and remove the one that was there.

    Linux exchanges the two at once. Other systems, and some file servers, cannot: the place is empty for a moment.
    """
    if not place.exists():
        made.rename(place)
        return
    if not _exchanged(made, place):
        old = beside(place)
        place.rename(old)
        try:
            made.rename(place)
        except OSError:
            with contextlib.suppress(OSError):
                old.rename(place)
            raise
        made = old
    made.unlink() if made.is_symlink() else shutil.rmtree(made, ignore_errors=True)


def _exchanged(one: Path, other: Path) -> bool:
    """Return whether the system exchanged two names."""
    try:
        rename = ctypes.CDLL(None).renameat2
    except (AttributeError, OSError, TypeError):
        return False
    return bool(rename(_HERE, os.fsencode(one), _HERE, os.fsencode(other), _EXCHANGE) == 0)
