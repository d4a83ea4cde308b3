"""Runs tasks in this process; the cluster is in :mod:`roadscan.run.engine.on_dask`."""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from roadscan.core.errors import DamagedError, RoadscanError, may_pass
from roadscan.core.stopping import stop_if_asked

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
