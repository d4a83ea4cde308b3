"""Runs tasks in this process, singly or in bundles; the cluster is in :mod:`roadscan.run.engine.on_dask`.

A bundle holds small pieces of work for one worker. Each piece ends independently: with a record or a reason.
"""

from __future__ import annotations

import contextlib
import gc
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from roadscan.core.errors import DamagedError, RoadscanError, may_pass
from roadscan.core.stopping import stop_if_asked
from roadscan.store.manifest import Manifest, OutputRecord

T = TypeVar("T")
R = TypeVar("R")

_OBJECTS = 100_000
"""New objects after which Python's garbage collector runs."""


@dataclass(frozen=True)
class Done(Generic[T, R]):
    """A finished task with its result, or with the error that stopped it."""

    task: T
    result: R | None
    error: Exception | None


class Reason(str):
    """Why a task failed, in words; it keeps what `may_pass` says of the error, which itself stays with the worker."""

    passes: str = ""
    """Why the same may succeed later, empty where nothing says so."""


def reason_of(error: Exception | None) -> Reason:
    """Return why a task failed, for the list of failures.

    Raises
    ------
    Stopped
        where the program was asked to end, and a library raised another error instead.
    """
    stop_if_asked()
    if error is None:
        return Reason("the worker gave no result")
    reason = Reason(error if isinstance(error, RoadscanError) else f"{type(error).__name__}: {error}")
    reason.passes = may_pass(error)
    return reason


def damaged_file(error: Exception | None) -> str:
    """Return the file of the store that a task found damaged, empty where it failed for another reason."""
    return (error.file or "") if isinstance(error, DamagedError) else ""


class LazyTasks(Sequence[T]):
    """Tasks that are created when they are accessed, while workers run the first ones, so that memory holds few."""

    def __init__(self, pieces: Sequence[Any], make: Callable[[Any], T]) -> None:
        self._pieces, self._make = pieces, make

    def __len__(self) -> int:
        return len(self._pieces)

    def __getitem__(self, place: Any) -> Any:
        """Return one task, or some."""
        return [*map(self._make, self._pieces[place])] if isinstance(place, slice) else self._make(self._pieces[place])

    def __iter__(self) -> Iterator[T]:
        return map(self._make, self._pieces)


class Compute(Protocol):
    """Applies a function to tasks; results come in any order."""

    @property
    def workers(self) -> int:
        """Number of tasks that run at the same time."""
        ...

    def map(self, function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[Done[T, R]]:
        """Run all tasks; an error in one does not stop the others."""
        ...


@contextlib.contextmanager
def rare_collections() -> Iterator[None]:
    """Run Python's cyclic garbage collector less often.

    A run keeps hundreds of thousands of records and makes no cycles: looking for them takes a third of its time.
    """
    before = gc.get_threshold()
    gc.set_threshold(max(_OBJECTS, before[0]), before[1], before[2])
    try:
        yield
    finally:
        gc.set_threshold(*before)


class Inline:
    """Runs tasks one after another in this process (tests, debugging, one tile)."""

    workers = 1

    def map(self, function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[Done[T, R]]:
        """Run all tasks in order."""
        for task in tasks:
            try:
                yield Done(task, function(task), None)
            except Exception as error:  # noqa: BLE001  one unit's fault must not stop the others
                stop_if_asked()
                yield Done(task, None, error)


@dataclass(frozen=True)
class Bundle(Generic[T]):
    """A task of several pieces, with the function that makes one file from each."""

    function: Callable[[T], OutputRecord]
    pieces: tuple[T, ...]


@dataclass(frozen=True)
class Ended:
    """Result of a piece."""

    record: OutputRecord | None
    reason: str = ""
    """Why there is no record."""
    damaged: str = ""
    """File of the store that the piece found damaged."""


def cut_bundles(work: Sequence[float], most: float, workers: int) -> list[range]:
    """Return consecutive pieces as bundles of at most `most` work, or less, to give each worker four.

    A piece with more work is a separate bundle.
    """
    limit = min(most, sum(work) / (4 * max(workers, 1)))
    ends: list[int] = []
    held = 0.0
    for number, one in enumerate(work):
        if held and held + one > limit:
            ends.append(number)
            held = 0.0
        held += one
    return [range(a, b) for a, b in itertools.pairwise([0, *ends, len(work)]) if a < b]


def run_bundles(
    function: Callable[[T], OutputRecord],
    pieces: Sequence[T],
    work: Callable[[T], float],
    most: float,
    manifest: Manifest,
    compute: Compute,
    report: Callable[[int, int], None],
) -> list[tuple[T, str]]:
    """Process all pieces, some at a time, and store their records; return the failed ones with the reason.

    A bundle that fails as a whole (its worker died) is done again piece by piece, so that only the piece at fault is
    lost.

    Parameters
    ----------
    work : estimate of a piece's work.
    most : work of a bundle, in the same unit; a run that is killed loses no more of each worker's.
    report : receives the number of pieces done, and of all.
    """
    tasks = [
        Bundle(function, tuple(pieces[n] for n in numbers))
        for numbers in cut_bundles([work(p) for p in pieces], most, compute.workers if pieces else 1)
    ]
    failures: list[tuple[T, str]] = []
    again: list[T] = []
    finished = 0
    report(0, len(pieces))

    def rounds() -> Iterator[list[Bundle[T]]]:
        yield tasks
        if again:
            yield [Bundle(function, (piece,)) for piece in again]

    for bundles in rounds():
        for done in compute.map(do_bundle, bundles):
            own = done.task.pieces
            if done.result is None and len(own) > 1:
                again += own
                continue
            ended = done.result or [_failed(done.error)]
            manifest.add([e.record for e in ended if e.record is not None])
            manifest.doubt_files({e.damaged for e in ended if e.damaged})
            failures += [(piece, e.reason) for piece, e in zip(own, ended, strict=True) if e.record is None]
            finished += len(own)
            report(finished, len(pieces))
    return failures


def do_bundle(bundle: Bundle[T]) -> list[Ended]:
    """Process the pieces of a bundle one after another (runs on a worker)."""
    return [_ended(bundle.function, piece) for piece in bundle.pieces]


def _ended(function: Callable[[T], OutputRecord], piece: T) -> Ended:
    try:
        return Ended(function(piece))
    except Exception as error:  # noqa: BLE001  one piece's fault must not stop the others
        return _failed(error)


def _failed(error: Exception | None) -> Ended:
    return Ended(None, reason_of(error), damaged_file(error))
