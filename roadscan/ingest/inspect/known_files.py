"""Files of makers' formats that are recognised and not read, each with the program that exports what is read.

A file is recognised by bytes that its maker has published, or else by the ending of its name. The table is
``known_files.toml``.
"""

from __future__ import annotations

import functools
import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Final

_TABLE: Final = Path(__file__).with_suffix(".toml")


@dataclass(frozen=True)
class KnownFile:
    """A kind of file that is not read."""

    words: str
    """Its kind in a person's words, with the article."""
    way_out: str
    """Which program exports what that roadscan reads."""
    suffixes: tuple[str, ...] = ()
    """Endings of its names, lower case."""
    magic: re.Pattern[bytes] | None = None
    """Pattern of its first bytes."""

    @property
    def sentence(self) -> str:
        """Return what it is, and that it is not read."""
        return f"{self.words}, which roadscan does not read"


@functools.cache
def known_files() -> tuple[KnownFile, ...]:
    """Return all of them, in the order of the table."""
    table = tomllib.loads(_TABLE.read_text(encoding="utf-8"))
    return tuple(
        KnownFile(
            row["words"],
            row["way_out"].format(**table["phrases"]),
            tuple(row.get("suffixes", ())),
            re.compile(row["magic"].encode("ascii"), re.DOTALL) if "magic" in row else None,
        )
        for row in table["files"]
    )


def known_file(path: Path, head: bytes) -> KnownFile | None:
    """Return the kind of a file with the first bytes `head`; None for any other."""
    by_bytes = (one for one in known_files() if one.magic is not None and one.magic.match(head))
    by_name = (one for one in known_files() if path.suffix.lower() in one.suffixes)
    return next(by_bytes, None) or next(by_name, None)
