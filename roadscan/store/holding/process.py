"""Identifies processes, and finds whether they live, also where machines share a name and containers share numbers."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import os
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

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
