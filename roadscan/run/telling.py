"""Tells what a run does: events, those who listen, and the one place that tells them."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime as dt
import os
import socket
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeVar

from roadscan import __version__
from roadscan.core.errors import RoadscanError
from roadscan.core.stopping import Stopped
from roadscan.run.engine.compute import Compute, Done, Inline
from roadscan.run.engine.measured import Cost, Measured, Meter, cost_of_error

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


T = TypeVar("T")
R = TypeVar("R")


class Teller:
    """Tells a run's events to all who listen."""

    def __init__(self, survey: str, listeners: Sequence[Listener], note: Callable[[str], None]) -> None:
        """`note` receives what is wrong with a listener, in words for the user."""
        self.run, self._survey = uuid.uuid4().hex[:16], survey
        self._listeners, self._note = list(listeners), note
        self.resumed = False
        """Whether the run before it had not finished."""
        self._stage = ""
        self._costs: list[Cost] = []
        self._failed = 0

    def tell(self, kind: type[Event], **values: Any) -> None:
        """Tell an event."""
        event = kind(at_ns=time.time_ns(), run=self.run, survey=self._survey, **values)
        for one in list(self._listeners):
            self._let(one, one.hear, event)

    def close(self) -> None:
        """End the listeners."""
        for one in list(self._listeners):
            self._let(one, one.close)
        self._listeners.clear()

    def _let(self, listener: Listener, do: Callable[..., None], *values: Any) -> None:
        try:
            do(*values)
        except Exception as error:  # noqa: BLE001  who listens must not stop a run
            self._listeners.remove(listener)
            with contextlib.suppress(Exception):
                listener.close()
            self._note(f"{listener.title} is not written any more: {error}")

    @contextlib.contextmanager
    def whole_run(self, stages: Sequence[str]) -> Iterator[None]:
        """Tell begin and end of a run."""
        began_ns, began_s = time.time_ns(), time.perf_counter()
        host, process = socket.gethostname(), os.getpid()
        self.tell(RunBegan, version=__version__, host=host, process=process, stages=tuple(stages))
        outcome, reason = DONE, ""
        try:
            yield
        except BaseException as error:
            outcome, reason = _outcome_of(error)
            raise
        finally:
            seconds = time.perf_counter() - began_s
            ended = {"outcome": outcome, "reason": reason, "began_ns": began_ns, "seconds": seconds}
            self.tell(RunEnded, **ended, resumed=self.resumed)

    @contextlib.contextmanager
    def stage(self, name: str, failures: Callable[[], Sequence[str]]) -> Iterator[None]:
        """Tell begin and end of a stage; `failures` returns the reasons of all units that failed in the run so far."""
        self._stage, self._failed, before = name, 0, len(failures())
        self._costs.clear()
        meter = Meter()
        self.tell(StageBegan, stage=name)
        outcome, reason = DONE, ""
        try:
            yield
        except BaseException as error:
            outcome, reason = _outcome_of(error)
            raise
        finally:
            new = failures()[before:]
            if new and outcome == DONE:
                outcome, reason = FAILED, new[0]
            self.tell(
                StageEnded, stage=name, outcome=outcome, reason=reason, failed=len(new), **self._total(meter.cost())
            )

    def _total(self, own: Cost) -> dict[str, Any]:
        """Return the cost of the stage; that of the run's process (`own`) contains the tasks that ran in it."""
        me = (own.host, own.process)
        all_costs = [own, *(one for one in self._costs if (one.host, one.process) != me)]
        read = [one.bytes_read for one in all_costs]
        peaks = [one.peak_memory_bytes for one in all_costs if one.peak_memory_bytes is not None]
        return {
            "began_ns": own.began_ns,
            "seconds": own.seconds,
            "tasks": len(self._costs),
            "bytes_read": None if None in read else sum(n for n in read if n is not None),
            "bytes_written": sum(one.bytes_written for one in all_costs),
            "peak_memory_bytes": max(peaks, default=None),
            "hosts": tuple(dict.fromkeys(one.host for one in all_costs)),
        }

    def unit_ended(self, task: str, done: Done[Any, Any], cost: Cost | None) -> None:
        """Tell that a task of the running stage ended."""
        if cost is not None:
            self._costs.append(cost)
        names, reasons = _names(done), _reasons(done)
        self.tell(
            UnitEnded,
            stage=self._stage,
            task=task,
            unit=names[0] if names else "",
            last=names[-1] if names else "",
            units=max(len(names), 1),
            failed=len(reasons),
            outcome=FAILED if reasons else DONE,
            reason=reasons[0] if reasons else "",
            host=None if cost is None else cost.host,
            process=None if cost is None else cost.process,
            began_ns=None if cost is None else cost.began_ns,
            seconds=None if cost is None else cost.seconds,
            bytes_read=None if cost is None else cost.bytes_read,
            bytes_written=None if cost is None else cost.bytes_written,
            peak_memory_bytes=None if cost is None else cost.peak_memory_bytes,
        )


class ToldCompute:
    """Computes as another does, and tells of each task as it ends."""

    def __init__(self, compute: Compute, teller: Teller) -> None:
        self.own, self.teller = compute, teller

    @property
    def workers(self) -> int:
        """Number of tasks that run at the same time."""
        return self.own.workers

    def map(self, function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[Done[T, R]]:
        """Run all tasks."""
        for done in self.own.map(Measured(function), tasks):
            costly = done.result
            cost = cost_of_error(done.error) if costly is None else costly.cost
            plain: Done[T, R] = Done(done.task, None if costly is None else costly.result, done.error)
            self.teller.unit_ended(getattr(done.task, "function", function).__name__.lstrip("_"), plain, cost)
            yield plain


def in_this_process(compute: Compute) -> Compute:
    """Return what computes in this process, and tells of it where `compute` does."""
    return ToldCompute(Inline(), compute.teller) if isinstance(compute, ToldCompute) else Inline()


def _outcome_of(error: BaseException) -> tuple[str, str]:
    if isinstance(error, (Stopped, KeyboardInterrupt, GeneratorExit)):
        return STOPPED, "asked to end"
    return FAILED, str(error) if isinstance(error, RoadscanError) else f"{type(error).__name__}: {error}"


def _names(done: Done[Any, Any]) -> list[str]:
    """Return the names of what a task was done to: its own `units`, its tiles, its pieces, or its log."""
    task = done.task
    if hasattr(task, "units"):
        return list(map(str, task.units))
    if hasattr(task, "block"):
        return list(map(str, task.block.tiles))
    if hasattr(task, "pieces"):
        records = [one.record for one in done.result or ()] or [None] * len(task.pieces)
        return [
            str(getattr(piece, "unit", "")) if record is None else record.unit
            for piece, record in zip(task.pieces, records, strict=True)
        ]
    return []


def _reasons(done: Done[Any, Any]) -> list[str]:
    """Return why some of a task's units failed."""
    if done.error is not None:
        return [str(done.error) or type(done.error).__name__] * max(len(_names(done)), 1)
    if isinstance(done.result, list):
        return [one.reason for one in done.result if getattr(one, "reason", "")]
    return [reason for _, reason in getattr(done.result, "failures", ())]
