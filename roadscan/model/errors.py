"""Errors that say what arrived, what was expected and what to change.

Every error a user can meet derives from :class:`RoadscanError`. The message is
one sentence a part; file and record are added where they are known.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from pathlib import Path


class RoadscanError(Exception):
    """Base of all errors raised on purpose.

    Parameters
    ----------
    arrived : what was found.
    expected : what should have been there.
    change : what the user can do about it.
    file, record : where it was found (record number or byte offset).
    """

    def __init__(
        self,
        arrived: str,
        *,
        expected: str = "",
        change: str = "",
        file: str | Path | None = None,
        record: int | str | None = None,
    ) -> None:
        self.arrived = arrived
        self.expected = expected
        self.change = change
        self.file = None if file is None else str(file)
        self.record = record
        super().__init__(arrived, expected, change, self.file, record)

    def __str__(self) -> str:
        place = ""
        if self.file is not None:
            place = self.file
            if self.record is not None:
                place += f", record {self.record}"
            place += ": "
        parts = [self.arrived]
        if self.expected:
            parts.append(f"expected {self.expected}")
        if self.change:
            parts.append(self.change)
        return place + "; ".join(parts)

    def __reduce__(self) -> tuple[object, ...]:
        """Keep the keyword parts when a worker sends the error to the scheduler."""
        state = (self.arrived, self.expected, self.change, self.file, self.record)
        return (_rebuild, (type(self), state))


def _rebuild(kind: type[RoadscanError], state: tuple[str, str, str, str | None, int | str | None]) -> RoadscanError:
    arrived, expected, change, file, record = state
    return kind(arrived, expected=expected, change=change, file=file, record=record)


class ConfigError(RoadscanError):
    """A survey file, rig file or option is wrong."""


class FormatError(RoadscanError):
    """A log cannot be read as the format it is said to be."""


class TimeSystemError(RoadscanError):
    """A time stamp has no, or an impossible, time system."""


class CrsError(RoadscanError):
    """A coordinate reference system, datum or geoid is missing or does not fit."""


class SchemaError(RoadscanError):
    """Rows do not fit the table's schema."""


class NavigationError(RoadscanError):
    """A pose was asked for where the trajectory has none."""


class StoreError(RoadscanError):
    """The store is damaged, locked or not a roadscan store."""


class DamagedError(StoreError):
    """A file of the store can be read, and does not hold what was written."""


class RunError(RoadscanError):
    """Some units of a run failed; the rest is finished and kept."""


def nearest(word: str, known: Iterable[str]) -> str:
    """Return `` (did you mean 'x'?)`` for the closest of `known`, or an empty string."""
    found = difflib.get_close_matches(word, list(known), n=1, cutoff=0.5)
    return f" (did you mean '{found[0]}'?)" if found else ""
