"""What runs tasks, and how they end; in this process, or on a cluster (:mod:`roadscan.run.engine.on_dask`)."""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from roadscan.core.errors import DamagedError, RoadscanError
from roadscan.core.stopping import stop_if_asked

T = TypeVar("T")
R = TypeVar("R")

_OBJECTS = 100_000
"""New objects that Python's collector waits for."""


@dataclass(frozen=True)
class Done(Generic[T, R]):
    """A task that ended: with a result, or with the error that stopped it."""

    task: T
    result: R | None
    error: Exception | None


def reason_of(error: Exception | None) -> str:
    """Why a task gave nothing, for the list of failures.

    Raises
    ------
    Stopped
        where the program was asked to end, and a library made an error of its own of that.
    """
    stop_if_asked()
    if error is None:
        return "the worker gave no result"
    return str(error) if isinstance(error, RoadscanError) else f"{type(error).__name__}: {error}"


def damaged_file(error: Exception | None) -> str:
    """File of the store that a task found damaged, empty where it failed for another reason."""
    return (error.file or "") if isinstance(error, DamagedError) else ""


class LazyTasks(Sequence[T]):
    """Tasks that are made when they are handed out: while workers are at the first, and not all in memory."""

    def __init__(self, pieces: Sequence[Any], make: Callable[[Any], T]) -> None:
        self._pieces, self._make = pieces, make

    def __len__(self) -> int:
        return len(self._pieces)

    def __getitem__(self, place: Any) -> Any:
        """One task, or some."""
        return [*map(self._make, self._pieces[place])] if isinstance(place, slice) else self._make(self._pieces[place])

    def __iter__(self) -> Iterator[T]:
        return map(self._make, self._pieces)


class Compute(Protocol):
    """Runs a function over tasks; results come in any order."""

    @property
    def workers(self) -> int:
        """How many tasks run at the same time."""
        ...

    def map(self, function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[Done[T, R]]:
        """Run all tasks; an error of one does not stop the others."""
        ...


@contextlib.contextmanager
def rare_collections() -> Iterator[None]:
    """Let Python look for cycles among its objects less often.

    A run keeps hundreds of thousands of records and makes no cycles: looking for them takes a third of its time.
    """
    before = gc.get_threshold()
    gc.set_threshold(_OBJECTS, before[1], before[2])
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
