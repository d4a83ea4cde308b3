"""The lease of a store: one run at a time, on one machine or on many, in a folder or in an object store.

The lease is one small file with the holder's random name and process. It is created only where none stands: a folder
and an object store can both do that. The holder renews it, and the time of each renewal is the store's own. Who finds a
lease asks, in this order:

1. Does its process live? If it can be seen from here (same boot, same process numbers), that decides.
2. Was it renewed in the last `LEASE_S`, by the store's clock? A probe that is written now tells what that clock says.

A lease whose holder is gone is taken. A holder that slept, and finds another's lease, writes nothing more.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import threading
import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Final, Protocol

from roadscan.core.errors import BusyStoreError, StoreError
from roadscan.store.holders import Process, at_once, process_lives

LEASE_S: Final = 40.0
"""A lease (s) that was not renewed for this long is over: a run on another machine can go on within a minute."""
_RENEW_S: Final = 10.0
"""Time between renewals (s): three may fail before the lease is over."""
_TRIES: Final = 5
"""Most times that a lease is looked at which vanishes, or changes hands, meanwhile."""


@dataclass(frozen=True)
class Held:
    """A lease as it stands in the store."""

    content: bytes
    renewed_s: float
    """When it was last renewed, by the store's clock."""
    version: str = ""
    """The object store's name of this state (ETag)."""

    @property
    def name(self) -> str:
        """The holder's random name, empty where the content names none."""
        return str(self._fields().get("name", ""))

    @property
    def process(self) -> Process | None:
        """The holder's process, None where the content names none."""
        try:
            return Process.parse(self._fields())
        except (KeyError, ValueError):
            return None

    @property
    def older_holder(self) -> tuple[str, int] | None:
        """Host and process of a lock that an older version wrote, which is not renewed."""
        words = self.content.decode(errors="replace").split()
        return (words[0], int(words[1])) if len(words) == 2 and words[1].isdigit() else None

    def _fields(self) -> dict[str, Any]:
        try:
            found = json.loads(self.content)
        except ValueError:
            return {}
        return found if isinstance(found, dict) else {}


class Place(Protocol):
    """Where a lease stands: what a folder and an object store do in ways of their own."""

    @property
    def path(self) -> str:
        """Where it stands, in words."""

    def create(self, content: bytes) -> bool:
        """Write the lease where none stands; return False where one does."""

    def read(self) -> Held | None:
        """Return the lease that stands there, None where none does."""

    def renew(self, lease: Held) -> None:
        """Let the store's clock say that the lease was renewed now."""

    def replace(self, lease: Held, content: bytes) -> bool:
        """Put another lease in the place of this one if it still stands; return whether it did."""

    def drop(self, lease: Held) -> None:
        """Free the store if the lease is still this one."""

    def now_s(self) -> float:
        """Return what the store's clock says."""


class Lease:
    """A store's lease, held from :meth:`take` to :meth:`give_back`."""

    def __init__(self, place: Place) -> None:
        self._place = place
        self._name = uuid.uuid4().hex
        self._ended = threading.Event()
        self._renewal = threading.Thread(target=self._keep, name="roadscan-lease", daemon=True)
        self._renewed_s = 0.0
        self._lost = ""

    def check_free(self) -> None:
        """Raise StoreError where another process holds the lease now."""
        if (lease := self._place.read()) is not None:
            _check_over(lease, self._place)

    def take(self) -> None:
        """Take the lease, and renew it from now on.

        Raises
        ------
        BusyStoreError
            where another process holds it.
        """
        self._take()
        self._renewal.start()

    def give_back(self) -> None:
        """Give the lease back; one that cannot be given back ends by itself."""
        self._ended.set()
        self._renewal.join()
        with contextlib.suppress(Exception):
            if (lease := self._place.read()) is not None and lease.name == self._name:
                self._place.drop(lease)

    def check(self) -> None:
        """Raise StoreError where the lease is another's: this process slept, or did not reach the store."""
        if not self._lost and _awake_s() - self._renewed_s > LEASE_S - _RENEW_S:
            self._renew()
        silent_s = _awake_s() - self._renewed_s
        if not self._lost and silent_s > LEASE_S:
            self._lost = f"its lock could not be renewed for {silent_s:.0f} s"
        if self._lost:
            raise BusyStoreError(
                f"this run lost the store: {self._lost}",
                expected="a run that renews its lease, and reaches the store, all the time",
                change="run again when the other run has ended: what is finished stays",
                file=self._place.path,
            )

    def _take(self) -> None:
        content = json.dumps({"name": self._name, **Process.this().fields()}).encode()
        for _ in range(_TRIES):
            self._renewed_s = _awake_s()
            if self._place.create(content):
                return
            lease = self._place.read()
            if lease is None:
                continue
            if lease.name == self._name:  # the answer to the first request was lost, and it was sent again
                return
            _check_over(lease, self._place)
            if self._place.replace(lease, content):
                return
        raise BusyStoreError("the store's lock changes hands all the time", change="run again", file=self._place.path)

    def _keep(self) -> None:
        while not self._lost and not self._ended.wait(_RENEW_S):
            self._renew()

    def _renew(self) -> None:
        """Renew the lease if it is still this one's; a store that does not answer is asked again later."""
        with contextlib.suppress(Exception):
            at = _awake_s()
            lease = self._place.read()
            if lease is None:
                self._lost = "its lock was removed"
            elif lease.name != self._name:
                self._lost = f"{lease.process or 'another process'} has taken it"
            else:
                self._place.renew(lease)
                self._renewed_s = at


def _check_over(lease: Held, place: Place) -> None:
    """Raise StoreError where the holder of a lease may be at work."""
    process, older = lease.process, lease.older_holder
    lives = None if process is None else process.lives
    if lives:
        raise _in_use(str(process), "wait for it")
    if lives is not None:
        return
    if older is not None:
        if older[0] == socket.gethostname() and not process_lives(older[1]):
            return
        raise _in_use(f"process {older[1]} on {older[0]}", f"wait for it, or remove {place.path} if it is gone")
    if process is None:
        return  # text that no run writes
    silent_s = place.now_s() - lease.renewed_s
    if silent_s <= LEASE_S:
        raise _in_use(
            f"{process} (seen {max(silent_s, 0.0):.0f} s ago)",
            f"wait for it; if it has died, the store is free {LEASE_S:.0f} s after it was last seen",
        )


def _in_use(who: str, change: str) -> BusyStoreError:
    return BusyStoreError(f"{who} is working on this store", expected="one run at a time", change=change)


def _awake_s() -> float:
    """Return a clock (s) that also runs while the machine sleeps, and that nobody sets."""
    clock = getattr(time, "CLOCK_BOOTTIME", None)
    return time.monotonic() if clock is None else time.clock_gettime(clock)


class FolderPlace:
    """A lease in a folder, which several machines may have mounted."""

    def __init__(self, file: Path, probe: Callable[[], Path], alone: Callable[[Path], Any]) -> None:
        """`probe` names a new temporary file on the same disk; `alone` locks others of this machine out."""
        self._file, self._probe, self._alone = file, probe, alone

    @property
    def path(self) -> str:
        """Where it stands."""
        return str(self._file)

    def create(self, content: bytes) -> bool:
        """Write the lease where none stands, whole or not at all."""
        made = self._probe()
        made.write_bytes(content)
        try:
            with self._alone(self._file.parent):
                return _given(made, self._file)
        finally:
            made.unlink(missing_ok=True)

    def read(self) -> Held | None:
        """Return the lease; its time comes from the opened file, so that a server's is not remembered from before."""
        try:
            with self._file.open("rb") as stream:
                return Held(stream.read(), os.fstat(stream.fileno()).st_mtime)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise StoreError(
                f"the store's lock cannot be read: {error}", change="remove it if no run is at work", file=self._file
            ) from error

    def renew(self, lease: Held) -> None:
        """Set the file's time to the server's own now."""
        os.utime(self._file)

    def replace(self, lease: Held, content: bytes) -> bool:
        """Take the lease away under another name, look whether it is the one, and give its name to the new one."""
        made = self._probe()
        made.write_bytes(content)
        try:
            with self._alone(self._file.parent):
                return self._taken_away(lease) and _given(made, self._file)
        finally:
            made.unlink(missing_ok=True)

    def drop(self, lease: Held) -> None:
        """Remove the file if it still names the holder."""
        with self._alone(self._file.parent):
            self._taken_away(lease)

    def _taken_away(self, lease: Held) -> bool:
        """Remove the lease; put it back, and return False, where it is another one by now."""
        aside = self._probe()
        try:
            self._file.rename(aside)
        except FileNotFoundError:
            return False
        try:
            if aside.read_bytes() == lease.content:
                return True
            _given(aside, self._file)
            return False
        finally:
            aside.unlink(missing_ok=True)

    def now_s(self) -> float:
        """Return the time of a file that is written now."""
        made = self._probe()
        try:
            made.write_bytes(b"")
            return made.stat().st_mtime
        finally:
            made.unlink(missing_ok=True)


def _given(made: Path, name: Path) -> bool:
    """Give a file a second name that no other has; return False where one has it."""
    try:
        name.hardlink_to(made)
    except FileExistsError:
        return False
    except OSError:  # file systems without links: the name first, then the content
        try:
            with name.open("xb") as stream:
                stream.write(made.read_bytes())
        except FileExistsError:
            return False
    return True


class ObjectPlace:
    """A lease in an object store, by its conditional requests (S3: `If-None-Match` and `If-Match`)."""

    def __init__(self, fs: Any, path: str) -> None:
        self._fs, self._path = fs, path
        self._is_s3 = "s3" in fs.protocol

    @property
    def path(self) -> str:
        """Where it stands."""
        return self._path

    def create(self, content: bytes) -> bool:
        """Write the lease where none stands, by the condition of the store."""
        try:
            self._fs.pipe_file(self._path, content, mode="create")
        except FileExistsError:
            return False
        except OSError:
            if self.read() is None:  # not two at once: the store cannot be written
                raise
            return False
        return True

    def read(self) -> Held | None:
        """Return the lease and the store's time of it."""
        try:
            info = self._fs.info(self._path)
            content = bytes(self._fs.cat_file(self._path, **at_once(self._fs)))
            return Held(content, changed_s(info), str(info.get("ETag", "")))
        except FileNotFoundError:
            return None

    def renew(self, lease: Held) -> None:
        """Write it again, where the store can do so only if it is still this one."""
        self._fs.pipe_file(self._path, lease.content, **self._only_if(lease))

    def replace(self, lease: Held, content: bytes) -> bool:
        """Write another lease over it, where the store can do so only if it is still this one; read it again."""
        try:
            self._fs.pipe_file(self._path, content, **self._only_if(lease))
        except OSError:
            found = self.read()
            if found is not None and found.version == lease.version:
                raise  # since nobody else was faster: the store cannot be written
            return False
        found = self.read()
        return found is not None and found.content == content

    def drop(self, lease: Held) -> None:
        """Empty the object: a removal has no condition, and could take away the lease of the next run."""
        self.replace(lease, b"")

    def now_s(self) -> float:
        """Return the store's time of an object that is written now."""
        made = f"{self._path}-{uuid.uuid4().hex}"
        try:
            self._fs.pipe_file(made, b"")
            return changed_s(self._fs.info(made))
        finally:
            with contextlib.suppress(OSError):
                self._fs.rm_file(made)

    def _only_if(self, lease: Held) -> dict[str, str]:
        return {"IfMatch": lease.version} if self._is_s3 and lease.version else {}


def changed_s(info: dict[str, Any]) -> float:
    """Return when a file or object was written (Unix s), as its store says; each library has its own name for it."""
    for name in ("LastModified", "last_modified", "updated", "mtime", "created"):
        found = info.get(name)
        if isinstance(found, datetime):
            return found.timestamp()
        if isinstance(found, str):
            return datetime.fromisoformat(found).timestamp()
        if isinstance(found, (int, float)):
            return float(found)
    raise StoreError(
        "the object store does not say when an object was written", change="name a store that does, such as S3"
    )
