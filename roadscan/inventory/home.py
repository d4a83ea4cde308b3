"""A home of the inventory: a place that shows a state, and from which people's changes are read back."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

import pyarrow as pa

from roadscan.core.errors import RoadscanError


class HomeError(RoadscanError):
    """Raised for a home that cannot be read or written as it is."""


class EditFault(NamedTuple):
    """A row of a home that cannot be accepted as it is."""

    table: str
    record: str
    """Its id, or `fid` and the number of a row without one."""
    reason: str
    is_question: bool = False
    """True where it may be right: it is accepted once a person confirms it."""

    def __str__(self) -> str:
        return f"{self.table}, {self.record}: {self.reason}"


class FaultyEditsError(HomeError):
    """Raised for edits that are not accepted, each with its table, row and reason."""

    faults: Sequence[EditFault] = ()


class Mark(NamedTuple):
    """The mark by which a home is recognised."""

    inventory: str
    """Name of the inventory."""
    token: str
    """Name of the rows that it had when it was published or last read."""
    pending: str
    """The token that it gets once the truth has taken in what was read from it; empty otherwise."""
    commit: int
    """Commit whose state was published."""
    at: str
    """Instant (UTC) of the commit."""


class Author(NamedTuple):
    """Who changed a row, when (UTC) and why, as far as the home records it; empty elsewhere."""

    who: str
    at: str
    why: str = ""


class Decision(NamedTuple):
    """A person's decision on a conflict."""

    asset_id: str
    attribute: str
    edit: str
    choice: str
    """`edit`: it holds; `evidence`: what was found counts; `other`: the waiting edit counts."""


CHOICES: Final = ("edit", "evidence", "other")
FID: Final = "fid"
"""Number of a row in its home; numbers may be reused."""


@dataclass(frozen=True)
class Content:
    """The content of a home."""

    rows: Mapping[str, pa.Table]
    """By kind: `fid` (int64), then the columns of `asset_table(kind)`."""
    decisions: Sequence[Decision] = ()
    authors: Mapping[tuple[str, str, str], Author] = field(default_factory=dict)
    """Last author of each value since the last read, by kind, id (or `fid N`) and attribute; else of the row."""
    faults: Sequence[EditFault] = ()
    """Entries by people that no row can store."""
    confirmed: Collection[str] = ()
    """Records whose unlikely places or sizes a person has confirmed in the home."""


class Sheet(NamedTuple):
    """A table beside those of the kinds, for people to look at."""

    name: str
    title: str
    rows: pa.Table
    """With a column `geometry` (WKB) where it is a layer."""


class Home(ABC):
    """A place in which people edit the inventory."""

    made_of: Mapping[str, pa.Table] | None = None
    """Rows by kind from which it was made, if it stores them itself; otherwise they are stored under its token."""

    @property
    @abstractmethod
    def name(self) -> str:
        """Returns its name in errors and edits; without a password."""

    @abstractmethod
    def mark(self) -> Mark | None:
        """Returns its mark; None where nothing was published there yet.

        Raises
        ------
        HomeError
            where something else stands there.
        """

    @abstractmethod
    def read(self) -> Content:
        """Returns all its rows.

        Raises
        ------
        HomeError
            where a table or column is missing, or holds values of another type.
        """

    @abstractmethod
    def write(self, content: Content, sheets: Sequence[Sheet], mark: Mark) -> None:
        """Show another state, completely or not at all.

        Raises
        ------
        HomeError
            where it cannot be written.
        """

    @property
    def project_file(self) -> Path | None:
        """Returns the path of the QGIS project file; None where the home has no folder."""
        return None

    def layer_address(self, table: str) -> tuple[str, str]:
        """Returns the provider and address by which QGIS finds a table."""
        raise NotImplementedError

    @abstractmethod
    def note(self, mark: Mark) -> None:
        """Store another mark beside the same rows."""
