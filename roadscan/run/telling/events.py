"""Events of a run, and what it takes to listen to them."""

from __future__ import annotations

import dataclasses
import datetime as dt
from dataclasses import dataclass, field
from typing import Any, ClassVar

DONE = "done"
"""Outcome of what has no fault."""
FAILED = "failed"
"""Outcome of what has a fault: a unit that failed, or an error that ended it."""
STOPPED = "stopped"
"""Outcome of a run that was asked to end (Ctrl-C, a signal)."""


@dataclass(frozen=True)
class Event:
    """Something that happened in a run, told by the run's own process."""

    name: ClassVar[str]
    at_ns: int
    """When it was told (Unix ns)."""
    run: str
    """Id of the run, drawn anew for each."""
    survey: str
    """Id of the survey."""

    def as_json(self) -> dict[str, Any]:
        """Return its values, with instants as text (UTC)."""
        values: dict[str, Any] = {"event": self.name, "at_utc": iso(self.at_ns)}
        for one in dataclasses.fields(self)[1:]:
            value = getattr(self, one.name)
            if one.name.endswith("_ns"):
                values[one.name.removesuffix("_ns") + "_utc"] = None if value is None else iso(value)
            else:
                values[one.name] = value
        return values


@dataclass(frozen=True)
class RunBegan(Event):
    """A run begins."""

    name = "run_began"
    version: str
    """Of roadscan."""
    host: str
    process: int
    """Id of the run's process on that host."""
    stages: tuple[str, ...]
    """Those that are asked for, in their order."""


@dataclass(frozen=True)
class StageBegan(Event):
    """A stage begins."""

    name = "stage_began"
    stage: str


@dataclass(frozen=True)
class UnitEnded(Event):
    """A task of a stage ended: the work that one worker does in one go."""

    name = "unit_ended"
    stage: str
    task: str
    """What was done."""
    unit: str
    """Name of the first thing that it was done to; empty where it has no name."""
    last: str
    """Name of the last one."""
    units: int
    """How many there are."""
    failed: int
    """How many of them failed."""
    outcome: str
    reason: str
    """Why the first of them failed; empty where none did."""
    host: str | None
    """Where it ran; None, as all that follows, where its worker could not say it (it died)."""
    process: int | None
    began_ns: int | None
    """When it began, by the clock of its host (Unix ns)."""
    seconds: float | None
    bytes_read: int | None
    bytes_written: int | None
    peak_memory_bytes: int | None
    """Most memory that its process has held since it began."""


@dataclass(frozen=True)
class Progressed(Event):
    """Some more units of a stage are done; told every few seconds."""

    name = "progress"
    stage: str
    done: int
    total: int
    ends_ns: int | None
    """When the stage ends if it goes on as it did so far (Unix ns); None while that is not known."""


@dataclass(frozen=True)
class Said(Event):
    """A line that the run tells its user."""

    name = "line"
    text: str


@dataclass(frozen=True)
class StageEnded(Event):
    """A stage ended. Its figures count its units, and what the run's own process did."""

    name = "stage_ended"
    stage: str
    outcome: str
    reason: str
    began_ns: int
    seconds: float
    tasks: int
    """Tasks that it had done."""
    failed: int
    """Units of it that failed."""
    bytes_read: int | None
    bytes_written: int
    peak_memory_bytes: int | None
    """Most memory that one of its processes has held since that began."""
    hosts: tuple[str, ...]
    """Where its tasks ran, and that of the run."""


@dataclass(frozen=True)
class RunEnded(Event):
    """A run ended."""

    name = "run_ended"
    outcome: str
    reason: str
    began_ns: int
    seconds: float
    resumed: bool
    """Whether the run before it had not finished."""


@dataclass
class Listener:
    """Hears a run's events. An error of its own does not stop the run, which says that it listens no more."""

    title: str = field(default="", init=False)
    """What it is, in the words of an error."""

    def hear(self, event: Event) -> None:
        """Take an event; a long wait here delays the run."""

    def close(self) -> None:
        """Finish what was begun; called once, after the last event."""


def iso(unix_ns: int) -> str:
    """Return an instant as text (UTC, truncated to microseconds)."""
    return dt.datetime.fromtimestamp(unix_ns // 1000 / 1e6, dt.UTC).isoformat(timespec="microseconds")
