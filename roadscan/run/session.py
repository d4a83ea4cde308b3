"""A session: a survey, its store, and what is known of both, each found once and renewed by what changes it."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self, TypeVar, cast

from roadscan.core.errors import StoreError
from roadscan.core.survey import Survey
from roadscan.run.engine.compute import Compute, Inline
from roadscan.run.selection import Selection
from roadscan.store.manifest import Manifest
from roadscan.store.store import Store

T = TypeVar("T")


class Reporter:
    """Hears what a run does; the command line shows it as bars or lines."""

    def line(self, text: str) -> None:
        """One thing that happened."""

    def progress(self, stage: str, done: int, total: int) -> None:
        """So many units of a stage are done."""


@dataclass
class Session:
    """A survey and its store; the stages of a run share one."""

    survey: Survey
    store: Store
    compute: Compute = field(default_factory=Inline)
    selection: Selection | None = None
    """Only these tiles, and these whether stale or not."""
    reporter: Reporter = field(default_factory=Reporter)
    failures: list[tuple[str, str, str]] = field(default_factory=list)
    """Stage, unit and reason of everything that failed."""
    raw_bytes_read: int = 0
    """Compressed bytes of readings that the tiles stage asked for."""
    stage: str = ""
    """The stage at work, or the last one that was."""
    places_nothing: bool = False
    """True once a stage found that the survey has no log of readings."""
    goes_on: bool | None = None
    """True where a run before this one did not come to its end; None before the first stage."""
    began_ns: int = 0
    """When the first stage began (Unix ns)."""
    only_looks: bool = False
    """True where no log is read through to fingerprint it, and nothing is written."""
    damaged: list[StoreError] | None = None
    """Hears of damaged records; what is sound counts then. None where damage is an error."""
    _found: dict[Callable[[Session], Any], Any] = field(default_factory=dict)
    _followers: dict[Callable[[Session], Any], set[Callable[[Session], Any]]] = field(default_factory=dict)
    """What asked for what a function found, while it was looking itself."""
    _finding: list[Callable[[Session], Any]] = field(default_factory=list)
    """What is looking now, the innermost last."""

    @classmethod
    def open(cls, survey_file: str | Path) -> Self:
        """The session of a survey file, which computes in this process.

        Raises
        ------
        ConfigError
            where the survey file or its rig file is wrong.
        """
        survey = Survey.load(survey_file)
        return cls(survey, Store(survey.store_url, survey.config.id))

    def found(self, find: Callable[[Session], T], make: Callable[[Session], T]) -> T:
        """What `make` returns, kept under the name `find` (:func:`found_once`)."""
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
        """Forget what a function found, and all that followed from it: it has changed."""
        self._found.pop(find, None)
        for follower in self._followers.pop(find, ()):
            self.forget(follower)

    def take(self, find: Callable[[Session], T], value: T) -> None:
        """Take a value in place of what a function found, and forget what followed from that."""
        self.forget(find)
        self._found[find] = value

    @property
    def manifest(self) -> Manifest:
        """Records of all outputs."""
        return manifest_of(self)

    def hear_of_damage(self) -> list[StoreError]:
        """Let damaged records be no error; returns the list that hears of them."""
        if self.damaged is None:
            self.damaged = []
            self._found.pop(manifest_of, None)
        return self.damaged

    def failed(self, stage: str, found: Sequence[tuple[str, object]]) -> None:
        """Keep failures of a stage."""
        known = {(unit, reason) for _, unit, reason in self.failures}
        for unit, reason in found:
            if (unit, str(reason)) not in known:  # what an earlier stage found holds for all after it
                self.failures.append((stage, unit, str(reason)))
                self.reporter.line(f"failed: {stage} {unit}: {reason}")

    def bar(self, what: str) -> Callable[[int, int], None]:
        """A function that tells how much of something is done."""
        return lambda done, total: self.reporter.progress(what, done, total)

    def note(self, text: str) -> None:
        """Tell what the user should know."""
        self.reporter.line(f"note: {text}")


def found_once(make: Callable[[Session], T]) -> Callable[[Session], T]:
    """A function of a session that looks once, until what it found, or what that came from, is forgotten."""

    @functools.wraps(make)
    def find(session: Session) -> T:
        return session.found(find, make)

    return find


@found_once
def manifest_of(session: Session) -> Manifest:
    """Records of all outputs."""
    return Manifest(session.store, session.damaged)
