"""A session: a survey, its store, and cached results about both, which are invalidated on change."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self, TypeVar, cast

from roadscan.core.errors import ConfigError, StoreError, may_pass
from roadscan.core.grid import Bounds, TileId
from roadscan.core.survey import Survey
from roadscan.run.engine.compute import Compute, Inline
from roadscan.run.telling import Teller
from roadscan.store.manifest import Manifest
from roadscan.store.store import Store


class SelectionError(ConfigError):
    """The selection names something that the survey does not have; the store is unchanged."""


@dataclass(frozen=True)
class Selection:
    """A selection of tiles; its parts are combined."""

    named: tuple[TileId, ...] = ()
    box: Bounds | None = None
    """Box on the map (m)."""
    span_gps_ns: tuple[int, int] | None = None
    """Selects tiles that readings of this span may have touched."""


T = TypeVar("T")


class Reporter:
    """Receives a run's messages; the command line shows them as bars or lines."""

    def line(self, text: str) -> None:
        """Report an event."""

    def progress(self, stage: str, done: int, total: int) -> None:
        """Report that this many units of a stage are done."""


@dataclass
class Session:
    """A survey and its store; the stages of a run share one session."""

    survey: Survey
    store: Store
    compute: Compute = field(default_factory=Inline)
    selection: Selection | None = None
    """If given, only these tiles are computed, even if they are current."""
    reporter: Reporter = field(default_factory=Reporter)
    teller: Teller | None = None
    """Tells those who listen what the run does, while it is at work."""
    failures: list[tuple[str, str, str]] = field(default_factory=list)
    """Stage, unit and reason of everything that failed."""
    passes: str = ""
    """Why one of them may pass by itself, empty where nothing says so."""
    raw_bytes_read: int = 0
    """Compressed bytes of readings that the tiles stage requested."""
    stage: str = ""
    """The running stage, or the last one."""
    places_nothing: bool = False
    """True once a stage found that the survey has no log of readings."""
    goes_on: bool | None = None
    """True where the run before this one did not finish; None before the first stage."""
    began_ns: int = 0
    """When the first stage began (Unix ns)."""
    only_looks: bool = False
    """True where no log is read through to fingerprint it, and nothing is written."""
    damaged: list[StoreError] | None = None
    """List to which damaged records are added, while sound ones are used. None where damage is an error."""
    _found: dict[Callable[[Session], Any], Any] = field(default_factory=dict)
    _followers: dict[Callable[[Session], Any], set[Callable[[Session], Any]]] = field(default_factory=dict)
    """Functions whose results depend on a function's result."""
    _finding: list[Callable[[Session], Any]] = field(default_factory=list)
    """Functions that are running now, the innermost last."""

    @classmethod
    def open(cls, survey_file: str | Path) -> Self:
        """Open the session of a survey file, which computes in this process.

        Raises
        ------
        ConfigError
            where the survey file or its rig file is wrong.
        """
        survey = Survey.load(survey_file)
        return cls(survey, Store(survey.store_url, survey.config.id))

    def found(self, find: Callable[[Session], T], make: Callable[[Session], T]) -> T:
        """Return the result of `make`, cached under the name `find` (:func:`found_once`)."""
        if self._finding:
            self._followers.setdefault(find, set()).add(self._finding[-1])
        if find not in self._found:
            self._finding.append(find)
            try:
                self._found[find] = make(self)
            finally:
                self._finding.pop()
        return cast("T", self._found[find])

    def forget(self, find: Callable[[Session], Any]) -> None:
        """Discard a function's cached result, and all results that depend on it, because it has changed."""
        self._found.pop(find, None)
        for follower in self._followers.pop(find, ()):
            self.forget(follower)

    def take(self, find: Callable[[Session], T], value: T) -> None:
        """Replace a function's cached result, and discard the results that depend on it."""
        self.forget(find)
        self._found[find] = value

    @property
    def manifest(self) -> Manifest:
        """Records of all outputs."""
        return manifest_of(self)

    def hear_of_damage(self) -> list[StoreError]:
        """Collect damaged records instead of raising errors; return the list that receives them."""
        if self.damaged is None:
            self.damaged = []
            self._found.pop(manifest_of, None)
        return self.damaged

    def failed(self, stage: str, found: Sequence[tuple[str, object]]) -> None:
        """Store failures of a stage."""
        known = {(unit, reason) for _, unit, reason in self.failures}
        for unit, reason in found:
            if (unit, str(reason)) not in known:  # what an earlier stage found applies to all later stages
                self.failures.append((stage, unit, str(reason)))
                why = may_pass(reason) if isinstance(reason, BaseException) else getattr(reason, "passes", "")
                self.passes = self.passes or why
                self.reporter.line(f"failed: {stage} {unit}: {reason}")

    def bar(self, what: str) -> Callable[[int, int], None]:
        """Return a function that reports the progress of something."""
        return lambda done, total: self.reporter.progress(what, done, total)

    def note(self, text: str) -> None:
        """Report a note to the user."""
        self.reporter.line(f"note: {text}")


def found_once(make: Callable[[Session], T]) -> Callable[[Session], T]:
    """Return a function of a session that caches its result until that, or a result it depends on, is discarded."""

    @functools.wraps(make)
    def find(session: Session) -> T:
        return session.found(find, make)

    return find


@found_once
def manifest_of(session: Session) -> Manifest:
    """Return the records of all outputs."""
    return Manifest(session.store, session.damaged)
