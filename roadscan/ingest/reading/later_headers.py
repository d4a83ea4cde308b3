"""Detects headers in the middle of a text file, as in files that were appended to one another.

What follows it is read by the first header only where it says the same; other columns, units, time systems or kinds of
height would be taken for those of the first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from roadscan.core.witness import Witness

SECOND_HEADER: Final = Witness(
    "second_header",
    input="any log of text lines",
    fault="Files were appended to one another, and the second one's header says other columns, units, time system or "
    "kind of height.",
    asks="every header line of the file, against the first",
    does="rows behind a header that says the same are read; those behind another are left out",
    told=("rejects",),
)

AGAIN: Final = "the line of column names stands again (files that were appended to one another)"
OTHER: Final = "a second line of column names stands before it, which differs from the first"

_WORD_STARTS: Final = "_%$\"'\ufeff"


class Headers(Protocol):
    """Recognises the headers of a format."""

    @property
    def other(self) -> str:
        """Return the reason to leave out a row that follows a header which differs from the first."""

    def comment(self, line: str) -> bool | None:
        """Return whether rows after this comment have the first header's layout; None if it says nothing about it."""

    def row(self, fields: Sequence[str]) -> bool | None:
        """Return the same for a line that is no comment."""


@dataclass(frozen=True)
class NameLines:
    """Lines of column names, like the one at a file's start."""

    names: tuple[str, ...]
    numbers: tuple[int, ...]
    """Columns of numbers."""
    first: tuple[str, ...] = ()
    """Fields of the file's first header, where `names` are stated instead."""
    other: str = OTHER

    def comment(self, line: str) -> bool | None:
        """Return False for a comment with the same names in another order: it is the header of another file."""
        words = [_plain(word) for word in line.lstrip("#%/; ").replace(",", " ").split()]
        if len(words) < 2 or sorted(words) != sorted(map(_plain, self.names)):
            return None
        return words == [_plain(name) for name in self.names]

    def row(self, fields: Sequence[str]) -> bool | None:
        """Check a line of words in columns of numbers; a last line without a line end may precede the words."""
        words = [_plain(field) for field in fields]
        for own in (self.names, self.first):
            plain = [_plain(name) for name in own]
            if plain and (words == plain or _is_behind_a_row(words, plain)):
                return True
        if sorted(words) == sorted(_plain(name) for name in self.names):
            return False
        extra = len(words) - len(self.names)
        held = [words[k] for k in self.numbers if k < len(words)] if extra <= 0 else words[-len(self.names) + 1 :]
        return False if len(held) > 1 and all(map(_is_word, held)) else None


def _is_behind_a_row(words: Sequence[str], names: Sequence[str]) -> bool:
    """Return True where a row without a line end precedes the names."""
    many = len(names)
    return (
        many > 1
        and len(words) == 2 * many - 1
        and list(words[many:]) == list(names[1:])
        and words[many - 1].endswith(names[0])
    )


def _plain(word: str) -> str:
    return word.strip().strip("\ufeff\"'").lower()


def _is_word(word: str) -> bool:
    """Return True for a name; numbers, empty fields and words for missing values are none."""
    return (
        len(word) > 1
        and (word[0].isalpha() or word[0] in _WORD_STARTS)
        and word not in ("nan", "inf", "infinity", "none", "null", "na", "n/a")
        and all(c.isprintable() for c in word)
    )
