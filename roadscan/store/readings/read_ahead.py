"""Reads begun before their results are asked for, so that waiting for a disk or a network overlaps with computing."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

T = TypeVar("T")


class ReadAhead(Generic[T]):
    """Results by key. Each read has a thread that ends with it; what a read raises is raised where it is taken.

    Nothing is read twice, and memory holds what was begun and not taken: who begins reads bounds it. Objects are used
    by one thread.
    """

    def __init__(self) -> None:
        self._begun: dict[Hashable, Future[T]] = {}

    def begin(self, key: Hashable, read: Callable[[], T]) -> None:
        """Begin a read, unless one of this key is begun and not taken."""
        if key not in self._begun:
            thread = ThreadPoolExecutor(1, thread_name_prefix="read ahead")
            self._begun[key] = thread.submit(read)
            thread.shutdown(wait=False)

    def take(self, key: Hashable) -> T:
        """Result of a read that is begun, once it is there."""
        return self._begun.pop(key).result()
