"""What follows from roadscan's sources alone: computed once, and kept on the disk until one of them changes."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import secrets
import sys
from collections.abc import Callable
from pathlib import Path

from roadscan.core.private_folder import UnsafeFolderError, cache_place, check_private, make_private


def kept(name: str, make: Callable[[], str]) -> str:
    """The text that `make` returns, from the disk where the same sources gave it before.

    Parameters
    ----------
    name : what the text is of; one name stands for one text, whatever process asks.
    """
    folder = _folder()
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
def _folder() -> Path | None:
    """Folder of what was kept; None where it cannot be written, or others could write to it."""
    folder = cache_place() / "of-sources"
    try:
        make_private(folder)
        check_private(folder)
    except (OSError, UnsafeFolderError):
        return None
    return folder
