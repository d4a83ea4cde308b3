"""A session: a survey, its store, and what is known of both, each found once and renewed by what changes it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Final, Self

from roadscan.core.errors import StoreError
from roadscan.core.survey import Survey
from roadscan.ingest.planned_logs import PlannedLog, UnplannedLog, plan_logs
from roadscan.navigation.tasks.navigate import records_with_trajectories
from roadscan.run.engine.compute import Compute, Inline
from roadscan.store.logs import LogRecord
from roadscan.store.manifest import Manifest
from roadscan.store.store import Store
from roadscan.tiles.footprints.footprints import FootprintRanges, load_ranges
from roadscan.tiles.plan.plan import SurveyPlan, plan_survey
from roadscan.tiles.tasks.selection import Selection
from roadscan.tiles.tasks.tile_plan import PlannedTiles, plan_tiles

_IN_ORDER: Final = ("logs", "records", "plan", "footprints", "tiles")
"""What a session finds, each from those before it."""


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
    damaged: list[StoreError] | None = None
    """Hears of damaged records; what is sound counts then. None where damage is an error."""

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

    @cached_property
    def logs(self) -> tuple[list[PlannedLog], list[UnplannedLog]]:
        """Logs of the survey file with their keys, trajectories first; and those that cannot be planned."""
        return plan_logs(self.survey, self.store)

    @cached_property
    def records(self) -> tuple[LogRecord, ...]:
        """Records of the survey file's logs and of the trajectories computed from them.

        Raises
        ------
        RunError
            where one is missing.
        """
        return tuple(records_with_trajectories(self.survey, self.store, self.logs))

    @cached_property
    def plan(self) -> SurveyPlan:
        """What places the readings: sources, ground, passes."""
        return plan_survey(self.survey, self.store, records=self.records)

    @cached_property
    def footprints(self) -> FootprintRanges:
        """Which row group touches which tile."""
        return load_ranges(self.plan, self.manifest)

    @cached_property
    def tiles(self) -> PlannedTiles:
        """Tiles that a reading may touch, with their keys."""
        return plan_tiles(self.footprints, self.plan)

    @cached_property
    def manifest(self) -> Manifest:
        """Records of all outputs."""
        return Manifest(self.store, self.damaged)

    def renew(self, name: str) -> None:
        """Forget what was found under a name, and all that follows from it: it has changed."""
        if name == "manifest":
            self.__dict__.pop(name, None)
            name = "footprints"
        for known in _IN_ORDER[_IN_ORDER.index(name) :]:
            self.__dict__.pop(known, None)

    def replan(self, plan: SurveyPlan) -> None:
        """Take a plan in place of the one that was found, and forget what follows from that."""
        self.renew("plan")
        self.__dict__["plan"] = plan

    def hear_of_damage(self) -> list[StoreError]:
        """Let damaged records be no error; returns the list that hears of them."""
        if self.damaged is None:
            self.damaged = []
            self.__dict__.pop("manifest", None)
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
