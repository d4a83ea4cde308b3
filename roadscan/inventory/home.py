"""What a home of the inventory is: it shows a state, and is read again with what people changed in it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

import pyarrow as pa

from roadscan.core.errors import RoadscanError


class HomeError(RoadscanError):
    """A home that cannot be read or written as it is."""


class EditFault(NamedTuple):
    """A row of a home that cannot be taken in as it is."""

    table: str
    record: str
    """Its id, or `fid` and the number of a row without one."""
    reason: str
    is_question: bool = False
    """True where it may be right: it is taken in once a person confirms it."""

    def __str__(self) -> str:
        return f"{self.table}, {self.record}: {self.reason}"


class FaultyEditsError(HomeError):
    """Edits that are not taken in, each with its table, row and reason."""

    faults: Sequence[EditFault] = ()


class Mark(NamedTuple):
    """What a home carries to be known again."""

    inventory: str
    """Name of the inventory."""
    token: str
    """Name of the rows that it held when it was published or last read."""
    pending: str
    """Token that it gets once what was read from it is in the truth; empty otherwise."""
    commit: int
    """Commit whose state was published."""
    at: str
    """Instant (UTC) of the commit."""


class Author(NamedTuple):
    """Who changed a row, when (UTC) and why, as far as the home tells; empty where it does not."""

    who: str
    at: str
    why: str = ""


class Decision(NamedTuple):
    """What a person chose of a conflict."""

    asset_id: str
    attribute: str
    edit: str
    choice: str
    """`edit`: it holds; `evidence`: what was found counts; `other`: the edit that waits."""


CHOICES: Final = ("edit", "evidence", "other")
FID: Final = "fid"
"""Number of a row in its home; it may be given again."""


@dataclass(frozen=True)
class Content:
    """What a home holds."""

    rows: Mapping[str, pa.Table]
    """By kind: `fid` (int64), then the columns of `asset_table(kind)`."""
    decisions: Sequence[Decision] = ()
    authors: Mapping[tuple[str, str, str], Author] = field(default_factory=dict)
    """Who changed values last since they were read, by kind, id (or `fid N`) and attribute; without one, of the row."""
    faults: Sequence[EditFault] = ()
    """What people wrote that no row can hold."""
    confirmed: Collection[str] = ()
    """Records whose unlikely places or sizes a person confirmed in the home."""


class Sheet(NamedTuple):
    """A table beside those of the kinds, for people to look at."""

    name: str
    title: str
    rows: pa.Table
    """With a column `geometry` (WKB) where it is a layer."""


class Home(ABC):
    """A place that people edit the inventory in."""

    made_of: Mapping[str, pa.Table] | None = None
    """Rows by kind that it was made of, where it has them itself; otherwise they are kept under its token."""

    @property
    @abstractmethod
    def name(self) -> str:
        """How errors and edits name it; without a password."""

    @abstractmethod
    def mark(self) -> Mark | None:
        """What it carries; None where nothing was published there yet.

        Raises
        ------
        HomeError
            where something else stands there.
        """

    @abstractmethod
    def read(self) -> Content:
        """All its rows.

        Raises
        ------
        HomeError
            where a table or column is missing, or holds values of another type.
        """

    @abstractmethod
    def write(self, content: Content, sheets: Sequence[Sheet], mark: Mark) -> None:
        """Show another state, wholly or not at all.

        Raises
        ------
        HomeError
            where it cannot be written.
        """

    @property
    def project_file(self) -> Path | None:
        """Where the project file of QGIS stands; None where the home has no folder of its own."""
        return None

    def layer_address(self, table: str) -> tuple[str, str]:
        """Provider and address by which QGIS finds a table."""
        raise NotImplementedError

    @abstractmethod
    def note(self, mark: Mark) -> None:
        """Carry another mark beside the same rows."""
