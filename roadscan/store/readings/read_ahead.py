"""Starts reads before their results are needed, so that waiting for a disk or a network overlaps with computing."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

T = TypeVar("T")


class ReadAhead(Generic[T]):
    """Results by key. Each read has a temporary thread; its exceptions are raised where its result is taken.

    Nothing is read twice, and memory holds what was begun and not taken: who begins reads bounds it. Objects are used
    by one thread.
    """

    def __init__(self) -> None:
        self._begun: dict[Hashable, Future[T]] = {}

    def begin(self, key: Hashable, read: Callable[[], T]) -> None:
        """Start a read, unless one with this key is pending."""
        if key not in self._begun:
            thread = ThreadPoolExecutor(1, thread_name_prefix="read ahead")
            self._begun[key] = thread.submit(read)
            thread.shutdown(wait=False)

    def take(self, key: Hashable) -> T:
        """Wait for a started read and return its result."""
        return self._begun.pop(key).result()
