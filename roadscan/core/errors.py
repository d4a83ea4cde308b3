"""Errors that say what arrived, what was expected and what to change.

Every error a user can meet derives from :class:`RoadscanError`. The message is
one sentence a part; file and record are added where they are known.
"""

from __future__ import annotations

import difflib
import errno
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, TypeAlias

from roadscan.core.toml_text import toml


@dataclass(frozen=True)
class Missing:
    """A setting of a log that the user has to state, or change, before the log can be read."""

    key: str
    """clock, crs, height, geoid, sensor, or options.NAME, as in the survey file."""
    proposed: Any = None
    """A proposed value; None where nothing is known."""
    choices: tuple[Any, ...] = ()
    """All values that it may take, where there are few."""
    is_example: bool = False
    """`proposed` only shows the form: the log does not say the value."""

    def __str__(self) -> str:
        """Return the setting as an error asks for it."""
        if self.choices:
            words = [toml(value) for value in self.choices]
            return f"{self.key} = " + " or ".join([", ".join(words[:-1]), words[-1]] if words[1:] else words)
        return self.key if self.proposed is None else f"{self.key} = {toml(self.proposed)}"


Alternatives: TypeAlias = tuple[tuple[Missing, ...], ...]
"""Groups of settings; any one group, stated whole, is enough."""


class RoadscanError(Exception):
    """Base of all errors raised on purpose.

    Parameters
    ----------
    arrived : what was found.
    expected : what should have been there.
    change : what the user can do about it.
    file, record : where it was found (record number or byte offset).
    missing : settings of the log that would resolve it: one, or alternatives, each a setting or several together.
        `expected` and `change` follow from them where they are not given.
    """

    def __init__(
        self,
        arrived: str,
        *,
        expected: str = "",
        change: str = "",
        file: str | Path | None = None,
        record: int | str | None = None,
        missing: Missing | Sequence[Missing | Sequence[Missing]] = (),
    ) -> None:
        alternatives = [missing] if isinstance(missing, Missing) else missing
        self.missing: Alternatives = tuple((one,) if isinstance(one, Missing) else tuple(one) for one in alternatives)
        self.arrived = arrived
        self.expected = expected or _wanted(self.missing)
        self.change = change or self.advice
        self.file = None if file is None else str(file)
        self.record = record
        self.passes = ""
        """What :func:`may_pass` said where its cause was known: a worker need not send it."""
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

    @property
    def advice(self) -> str:
        """Return the line to add where everything missing has a proposal; empty otherwise."""
        if len(self.missing) != 1 or any(one.proposed is None for one in self.missing[0]):
            return ""
        lines = [f"{one.key} = {toml(one.proposed)}" for one in self.missing[0]]
        return f"add {' and '.join(lines)} to this log"

    def asks_for(self, key: str) -> Iterator[Missing]:
        """Yield the settings of this key (of all options where it ends in a dot) that would resolve the error."""
        for one in (one for group in self.missing for one in group):
            if one.key == key or (key.endswith(".") and one.key.startswith(key)):
                yield one

    def at(self, file: str | Path | None = None, record: int | str | None = None) -> Self:
        """Return the same error with another file and record."""
        return type(self)(
            self.arrived, expected=self.expected, change=self.change, file=file, record=record, missing=self.missing
        )

    def __reduce__(self) -> tuple[object, ...]:
        """Keep the keyword parts, and what was noted on it, when a worker pickles the error for the scheduler."""
        state = (self.arrived, self.expected, self.change, self.file, self.record, self.missing)
        return (_rebuild, (type(self), state), self.__dict__ | {"passes": may_pass(self)})


def _rebuild(kind: type[RoadscanError], state: tuple[Any, ...]) -> RoadscanError:
    arrived, expected, change, file, record, missing = state
    return kind(arrived, expected=expected, change=change, file=file, record=record, missing=missing)


def _wanted(missing: Alternatives) -> str:
    groups = [" with ".join(map(str, group)) for group in missing]
    return ("one of " if groups[1:] else "") + ", ".join(groups)


class ConfigError(RoadscanError):
    """A survey file, rig file or option is wrong."""


class FormatError(RoadscanError):
    """A log cannot be read as the format it is said to be."""


class ChangingLogError(FormatError):
    """A log changes while it is read: its upload has not ended."""


class TimeSystemError(RoadscanError):
    """A time stamp has no, or an impossible, time system."""


class CrsError(RoadscanError):
    """A coordinate reference system, datum or geoid is missing or does not fit."""


class SchemaError(RoadscanError):
    """Rows do not fit the table's schema."""


class NavigationError(RoadscanError):
    """A pose was asked for where the trajectory has none."""


class ProfileError(RoadscanError):
    """A road profile does not allow the requested index."""


class StoreError(RoadscanError):
    """The store is damaged, locked or not a roadscan store."""


class BusyStoreError(StoreError):
    """Another run has the store, or has taken it from this one."""


class DamagedError(StoreError):
    """A file of the store can be read, but its content is not what was written."""


class FullDiskError(StoreError):
    """A file could not be written because the disk is full."""


class AnswerError(DamagedError):
    """A file from which an answer is computed is damaged."""


class RunError(RoadscanError):
    """Some units of a run failed; the other outputs are complete and kept."""


_OF_NETWORKS = frozenset(
    {
        "ConnectionError", "TimeoutError", "EndpointConnectionError", "ConnectTimeoutError", "ConnectionClosedError",
        "ReadTimeoutError", "ClientConnectionError", "ClientPayloadError", "gaierror",
    }
)  # fmt: skip
"""Classes of errors for a place that does not answer, by name: those of Python, and of botocore and aiohttp, which do
not derive from them."""
_NETWORK_CODES = frozenset(
    {errno.ENETUNREACH, errno.ENETDOWN, errno.EHOSTUNREACH, errno.EHOSTDOWN, errno.ESTALE, errno.ETIMEDOUT}
)
"""Codes of the system for the same, a file server that was started anew (`ESTALE`) among them."""
_LEAST_PASSING_STATUS = 500
"""Least status of HTTP by which a server says that the fault is not in the request."""
_OTHER_PASSING_STATUS = frozenset({408, 429})
"""Those below it by which it asks to be asked later."""


def may_pass(error: BaseException) -> str:
    """Return why the same may succeed later; "" where nothing says so.

    A log still changes, another run has the store, or a place does not answer. Causes of an error count as well.
    """
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, ChangingLogError):
            return "a log still changes"
        if isinstance(cause, BusyStoreError):
            return "another run has the store"
        if _is_of_networks(cause):
            return "a place does not answer"
        if isinstance(cause, RoadscanError) and cause.passes:
            return cause.passes
        cause = cause.__cause__ or cause.__context__
    return ""


def _is_of_networks(error: BaseException) -> bool:
    response = getattr(error, "response", None)  # of botocore
    status = response.get("ResponseMetadata", {}).get("HTTPStatusCode", 0) if isinstance(response, dict) else 0
    return (
        status >= _LEAST_PASSING_STATUS
        or status in _OTHER_PASSING_STATUS
        or (isinstance(error, OSError) and error.errno in _NETWORK_CODES)
        or not _OF_NETWORKS.isdisjoint(one.__name__ for one in type(error).__mro__)
    )


def brief(error: BaseException) -> str:
    """Return the first line of an error's text."""
    text = str(error).strip().splitlines()
    return text[0][:200] if text else type(error).__name__


def in_words(error: OSError) -> RoadscanError:
    """Return a file error as one that a user can act on: which file, what is wrong with it, and what to change."""
    if error.filename is None:  # libraries name the file in their own words
        return RoadscanError(error.strerror or str(error) or type(error).__name__)
    arrived, change = _OF_FILES.get(error.errno or 0, (error.strerror or str(error), ""))
    return RoadscanError(arrived, change=change, file=error.filename)


_OF_FILES = {
    errno.EACCES: ("permission denied", "name another place, or change its rights"),
    errno.EPERM: ("permission denied", "name another place, or change its rights"),
    errno.EROFS: ("the file system is read-only", "name another place"),
    errno.ENOENT: ("no such file or folder", "see to its name"),
    errno.EISDIR: ("a folder stands where a file was expected", "name a file"),
    errno.ENOTDIR: ("a file stands where a folder was expected", "name another place"),
    errno.EEXIST: ("it is there already", "name another place"),
    errno.ENOSPC: ("no room is left on the disk", "make room, or name a place on another disk"),
    errno.EDQUOT: ("no room is left in your quota", "make room, or name a place on another disk"),
    errno.EMFILE: ("too many files are open", "raise the limit (`ulimit -n`)"),
    errno.ENAMETOOLONG: ("the name is too long", "shorten it"),
    errno.ELOOP: ("links lead in a circle", "see to its name"),
}


def nearest(word: str, known: Iterable[str]) -> str:
    """Return `` (did you mean 'x'?)`` for the closest of `known`, or an empty string."""
    found = difflib.get_close_matches(word, list(known), n=1, cutoff=0.5)
    return f" (did you mean '{found[0]}'?)" if found else ""
