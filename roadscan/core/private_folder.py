"""Checks folders whose content is executed as the user: the cache of compiled kernels, and code that workers load.

Beside the kernels, what follows from roadscan's sources alone is computed once, and kept until one of them changes.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import secrets
import stat
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, NoReturn

try:
    import grp
    import pwd
except ImportError:  # systems without user ids
    pass


class UnsafeFolderError(RuntimeError):
    """Other users could write code to a folder, which this process would execute."""


class Code(NamedTuple):
    """What a folder contains, and the variable that selects another folder."""

    what: str
    """Name of the content, for errors."""
    variable: str
    """Environment variable that selects another folder."""


KERNELS = Code("the cache of compiled code", "NUMBA_CACHE_DIR")


def check_private(folder: Path, code: Code = KERNELS) -> None:
    """Refuse a folder that others may write to, as OpenSSH does with keys.

    The folder, all above it and the files in it have to belong to this user or to root, and nobody else may write to
    them. Above it, a folder like /tmp will do, where everyone may write and nobody may move another user's files.

    Raises
    ------
    UnsafeFolderError
        says which of them it is, and what to change.
    """
    if not hasattr(os, "getuid") or not folder.exists():
        return
    real = folder.resolve()
    _check_place(real, real.stat(), code, sticky=False)
    _check_above(real.parent, code)
    with os.scandir(real) as entries:
        for entry in entries:
            with contextlib.suppress(FileNotFoundError):  # Numba replaces files by renaming
                _check_place(Path(entry.path), entry.stat(follow_symlinks=False), code, sticky=False)


@functools.cache
def _check_above(folder: Path, code: Code) -> None:
    for place in (folder, *folder.parents):
        _check_place(place, place.stat(), code, sticky=True)


def _check_place(place: Path, found: os.stat_result, code: Code, *, sticky: bool) -> None:
    if found.st_uid not in (0, os.getuid()):
        _refuse(place, code, f"belongs to another user (number {found.st_uid})")
    if stat.S_ISLNK(found.st_mode) or (sticky and found.st_mode & stat.S_ISVTX):
        return
    if found.st_mode & stat.S_IWOTH:
        _refuse(place, code, "can be written by every user")
    if found.st_mode & stat.S_IWGRP and not _is_private(found.st_gid):
        _refuse(place, code, f"can be written by others of its group (number {found.st_gid})")


def _refuse(place: Path, code: Code, reason: str) -> NoReturn:
    raise UnsafeFolderError(
        f"{place}: {code.what} {reason}; expected a place where you alone can write, since what lies "
        f"there is run as you; `chmod go-w {place}` if it is yours, remove what is not, or set {code.variable} to a "
        "folder of your own"
    )


def _is_private(group: int) -> bool:
    """Return True for root's group, and for a group of the user's name without other members."""
    if group == 0:
        return True
    try:
        user, found = pwd.getpwuid(os.getuid()).pw_name, grp.getgrgid(group)
    except KeyError:
        return False
    return found.gr_name == user and set(found.gr_mem) <= {user}


def cache_place() -> Path:
    """Return the folder for roadscan's compiled kernels and code digests; it may not exist yet."""
    base = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "roadscan"


def make_private(folder: Path) -> None:
    """Create a folder and its missing parents, accessible to this user only."""
    for place in reversed([one for one in (folder, *folder.parents) if not one.exists()]):
        place.mkdir(mode=0o700, exist_ok=True)


def kept(name: str, make: Callable[[], str]) -> str:
    """The text that `make` returns, from the disk where the same sources gave it before.

    Parameters
    ----------
    name : what the text is of; one name stands for one text, whatever process asks.
    """
    folder = _checked(cache_place() / "of-sources")
    if folder is None:
        return make()
    file = folder / hashlib.blake2b(name.encode(), digest_size=12).hexdigest()
    with contextlib.suppress(OSError):
        sources, _, text = file.read_text(encoding="utf-8").partition("\n")
        if sources == sources_digest():
            return text
    text = make()
    scratch = file.with_suffix(f".{secrets.token_hex(4)}")
    with contextlib.suppress(OSError):
        scratch.write_text(f"{sources_digest()}\n{text}", encoding="utf-8")
        scratch.replace(file)
    return text


@functools.cache
def sources_digest() -> str:
    """Return the digest of the sources, and of Python's version."""
    library = Path(__file__).parents[1]
    digest = hashlib.blake2b(sys.version.encode(), digest_size=8)
    for file in sorted(library.rglob("*.py")):
        content = file.read_bytes()
        digest.update(f"{file.relative_to(library).as_posix()}\0{len(content)}\0".encode() + content)
    return digest.hexdigest()


@functools.cache
def _checked(folder: Path) -> Path | None:
    """The folder, made where it is missing; None where it cannot be written, or others could write to it."""
    try:
        make_private(folder)
        check_private(folder)
    except (OSError, UnsafeFolderError):
        return None
    return folder
