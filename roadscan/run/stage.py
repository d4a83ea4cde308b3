"""What a stage is, and which there are: the modules `stage` of the features, and entry points of other packages."""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Final, Self

from roadscan.core.errors import ConfigError, RoadscanError, nearest
from roadscan.core.plugins import found_kinds
from roadscan.core.survey import Survey
from roadscan.core.witness import Finding
from roadscan.run.session import Session
from roadscan.store.logs import LogRecord
from roadscan.store.manifest import Manifest

ENTRY_POINT_GROUP: Final = "roadscan.stages"
PLACE: Final = "**/stage.py"
"""Where the stages of roadscan stand: a file a feature."""


@dataclass
class StageState:
    """What there is of a stage's outputs, and what the next run would do."""

    current: int = 0
    """Units that are finished and up to date."""
    stale: int = 0
    """Units that are missing or out of date."""
    empty: int = 0
    """Units that were looked at and hold nothing: a run's progress counts these, too."""
    why: Counter[str] = field(default_factory=Counter)
    """How many of the stale units are due for which reason, as far as the manifest tells."""
    keys: Collection[str] = ()
    """Keys of the units that should be there, where they are known before the stage has run."""
    tasks: int | None = None
    """Tasks of the next run on the session's workers; None where that is not known."""
    raw_bytes: int | None = None
    """Bytes of logs or of ingested rows that the next run would read; None where that is not known."""
    worker_memory_bytes: int | None = None
    """Memory that a worker of the next run needs at most, about; None where that is not known."""
    notes: list[str] = field(default_factory=list)
    """What the user should know."""
    lines: list[str] = field(default_factory=list)
    """A line for each of the things it made, where these are few."""
    faults: list[tuple[str, str]] = field(default_factory=list)
    """Units that the next run cannot do, with the reason, as far as that is known before it."""
    hides_rest: bool = False
    """True where nothing can be said of later stages before this one has run."""

    @classmethod
    def of(cls, manifest: Manifest, units: Iterable[tuple[str, str, str]]) -> Self:
        """The state of units by their product, name and key."""
        asked = list(units)
        why = Counter(filter(None, (manifest.why_due(*one) for one in asked)))
        return cls(len(asked) - why.total(), why.total(), why=why, keys=[key for _, _, key in asked])

    def join(self, other: StageState) -> None:
        """Count the units of another state, and their tasks, with these."""
        self.current += other.current
        self.stale += other.stale
        self.why += other.why
        self.keys = [*self.keys, *other.keys]
        self.tasks = (self.tasks or 0) + (other.tasks or 0)


class Stage(ABC):
    """One stage of a run. It does what is missing or stale, and nothing else."""

    name: ClassVar[str]
    """Its name, and the command that runs it alone, unless `command` says another."""
    title: ClassVar[str]
    """What it makes, in a line."""
    after: ClassVar[tuple[str, ...]] = ()
    """Stages that have to be done before."""
    command: ClassVar[str] = ""
    """Name on the command line where it is not `name`."""
    uses_workers: ClassVar[bool] = True
    """False for a stage that computes in the run's own process."""
    section: ClassVar[str] = ""
    """Section of the survey file without which a run passes over it."""
    units: ClassVar[str] = "units"
    """What its state counts, in the plural."""
    reads: ClassVar[tuple[str | type, ...]] = ()
    """Tables and products of other stages that it reads. A class of plugins stands for those that the survey asks for:
    products, and the tables of formats or kinds of assets."""
    writes: ClassVar[tuple[str | type, ...]] = ()
    """Tables and products that it writes, in the same way; pictures beside them are left out."""

    @abstractmethod
    def run(self, session: Session) -> None:
        """Bring the stage's outputs up to date; failures of single units join ``session.failures``."""

    def check(self, survey: Survey) -> list[RoadscanError]:
        """All that is wrong with the survey file as far as it concerns this stage; called before a run reads a log."""
        return []

    def check_ahead(self, session: Session, *, files: bool) -> None:  # noqa: B027 — most stages ask nothing ahead
        """Raise where it could not do its work once it is its turn; stages before it ask, when the survey is planned.

        files : whether the files that it needs are looked at too, which takes longer.
        """

    def state(self, session: Session) -> StageState:
        """What there is and what is to do; reads no readings.

        Raises
        ------
        RoadscanError
            where that cannot be said: `status` shows the reason.
        """
        return StageState()

    def is_asked(self, survey: Survey) -> bool:
        """True unless the survey file has no section for it, or switches that off."""
        if not self.section:
            return True
        return survey.has(self.section) and getattr(getattr(survey.config, self.section), "on", True)

    def why_not_asked(self, survey: Survey) -> str:
        """Why a run passes over it, where :meth:`is_asked` is false."""
        return f"[{self.section}] {'is off' if survey.has(self.section) else 'is not in the survey file'}"

    def findings(self, survey: Survey, records: Sequence[LogRecord], manifest: Manifest) -> Sequence[Finding]:
        """What the witnesses of its inputs said: told during a run, in the summary, by `status` and in the report.

        It comes from the records of the survey's logs and computed trajectories, and from the manifest, in no time.
        """
        return ()

    def folders(self) -> Sequence[str]:
        """Folders of the store that hold nothing but files that the manifest names: other files in them are removed."""
        return ()

    @property
    def word(self) -> str:
        """Its name on the command line."""
        return self.command or self.name


def check_stages_ahead(session: Session, *, files: bool) -> None:
    """Raise where a stage could not do its work once it is its turn, see :meth:`Stage.check_ahead`."""
    for one in stages():
        one.check_ahead(session, files=files)


def findings_of(
    survey: Survey, records: Sequence[LogRecord], manifest: Manifest, chosen: Sequence[Stage] | None = None
) -> list[Finding]:
    """What the witnesses of stages (of all, where none are chosen) said, each finding once."""
    said = (one for s in (stages() if chosen is None else chosen) for one in s.findings(survey, records, manifest))
    return list(dict.fromkeys(said))


@functools.cache
def stages() -> tuple[Stage, ...]:
    """All stages, each after those that it needs; neighbours by name."""
    known = found_kinds(PLACE, Stage, ENTRY_POINT_GROUP)
    waiting = {name: kind() for name, kind in known.items()}
    ordered: list[Stage] = []
    while waiting:
        done = {stage.name for stage in ordered}
        ready = [stage for _, stage in sorted(waiting.items()) if done.issuperset(stage.after)]
        if not ready:
            needs = "; ".join(f"'{s.name}' after {', '.join(s.after)}" for s in waiting.values())
            raise ConfigError(f"these stages can never run: {needs}", expected="stages that exist, in no circle")
        ordered.append(ready[0])
        del waiting[ready[0].name]
    return tuple(ordered)


def stage_named(name: str) -> Stage:
    """Stage by name, or an error that names the nearest known one."""
    known = {stage.name: stage for stage in stages()}
    if name not in known:
        raise ConfigError(f"unknown stage '{name}'{nearest(name, known)}", expected="one of: " + ", ".join(known))
    return known[name]


BYTES_PER_READING: Final = 100
"""Measured memory of a worker per reading of its block (bytes): points, sorting and one tile's products."""


WORKER_BASE_BYTES: Final = 400 << 20
"""Memory of a worker before its first block (bytes): Python and its libraries."""
