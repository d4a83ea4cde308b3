"""First and last epochs of the row groups of a data file, and their rows: of a survey there are millions.

As tuples of Python the epochs took 136 bytes a row group, and 147 in the record of a log: a day's drive of two
profilers, 200 km with 1.6 million row groups, 220 MB and 240 MB.
"""

from __future__ import annotations

import base64
import functools
import itertools
import zlib
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Self, overload

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Int64


class GroupSpans(Sequence[tuple[int, int]]):
    """Pairs of first and last epoch (GPS ns), held deflated in four bytes each; equal to a tuple of the same pairs."""

    __slots__ = ("_packed", "_size", "span")

    span: tuple[int, int] | None
    """First and last epoch of all; None where there are none."""

    def __init__(self, pairs: Sequence[tuple[int, int]] | Int64 = ()) -> None:
        first, last = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
        steps = np.concatenate([np.diff(first, prepend=0), last - first]).astype("<i8")
        self._hold(zlib.compress(np.ascontiguousarray(steps.view(np.uint8).reshape(-1, 8).T).tobytes(), 6))

    def _hold(self, packed: bytes) -> Self:
        first, last = _ends(packed)
        self._packed, self._size = packed, int(first.size)
        self.span = (int(first.min()), int(last.max())) if first.size else None
        return self

    @property
    def _pairs(self) -> Int64:
        return np.column_stack(_ends(self._packed))

    @classmethod
    def of_text(cls, text: str) -> Self:
        """Return what :meth:`text` wrote; ValueError where it is none."""
        try:
            return cls.of_packed(base64.b64decode(text, validate=True))
        except zlib.error as error:
            raise ValueError(str(error)) from error

    @classmethod
    def of_packed(cls, packed: bytes) -> Self:
        """Return the same from its bytes."""
        return cls.__new__(cls)._hold(packed)

    def text(self) -> str:
        """Return them as Base64 of deflated bytes: steps from first to first epoch, then from first to last, as 64-bit
        little-endian numbers, of all the lowest bytes first.
        """
        return base64.b64encode(self._packed).decode()

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> npt.NDArray[Any]:
        """Return (n, 2) epochs."""
        return self._pairs.astype(np.int64 if dtype is None else dtype, copy=False)

    def __len__(self) -> int:
        return self._size

    @overload
    def __getitem__(self, place: int) -> tuple[int, int]: ...

    @overload
    def __getitem__(self, place: slice) -> GroupSpans: ...

    def __getitem__(self, place: int | slice) -> tuple[int, int] | GroupSpans:
        first, last = _ends(self._packed)
        if isinstance(place, slice):
            return GroupSpans(np.column_stack([first[place], last[place]]))
        return int(first[place]), int(last[place])

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return iter([(first, last) for first, last in self._pairs.tolist()])

    def __eq__(self, other: object) -> bool:
        if isinstance(other, GroupSpans):
            return self._packed == other._packed or np.array_equal(self._pairs, other._pairs)
        return isinstance(other, tuple) and tuple(self) == other

    def __hash__(self) -> int:
        return hash((self._size, self.span))  # not the bytes, which depend on the compressor

    def __reduce__(self) -> tuple[Any, ...]:
        return GroupSpans.of_packed, (self._packed,)

    def __repr__(self) -> str:
        return f"GroupSpans({list(self)!r})"


@functools.lru_cache(maxsize=4)
def _ends(packed: bytes) -> tuple[Int64, Int64]:
    """Return first and last epochs (n,); kept for those who ask for one pair after another."""
    planes = np.frombuffer(zlib.decompress(packed), np.uint8)
    steps = np.ascontiguousarray(planes.reshape(8, -1).T).view("<i8").reshape(2, -1)
    first = np.cumsum(steps[0])
    return first, first + steps[1]


class GroupRows(Sequence[int]):
    """Rows of row groups, stored as runs of equal ones; equal to a tuple of the same numbers."""

    __slots__ = ("_ends", "runs")

    runs: tuple[tuple[int, int], ...]
    """Number of neighbouring row groups, and the rows of each."""

    def __init__(self, rows: Iterable[int] = ()) -> None:
        self._hold((len(list(equal)), count) for count, equal in itertools.groupby(rows))

    def _hold(self, runs: Iterable[tuple[int, int]]) -> Self:
        self.runs = tuple((groups, rows) for groups, rows in runs)
        self._ends = tuple(itertools.accumulate(groups for groups, _ in self.runs))
        return self

    @classmethod
    def of_runs(cls, runs: Iterable[tuple[int, int]]) -> Self:
        """Return the row groups of such runs."""
        return cls.__new__(cls)._hold(runs)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> npt.NDArray[Any]:
        """Return (n,) rows."""
        return np.repeat(*np.array(self.runs, np.int64).reshape(-1, 2).T[::-1]).astype(dtype or np.int64, copy=False)

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    @overload
    def __getitem__(self, place: int) -> int: ...

    @overload
    def __getitem__(self, place: slice) -> tuple[int, ...]: ...

    def __getitem__(self, place: int | slice) -> int | tuple[int, ...]:
        if isinstance(place, slice):
            return tuple(self)[place]
        return self.runs[bisect_right(self._ends, range(len(self))[place])][1]

    def __iter__(self) -> Iterator[int]:
        return itertools.chain.from_iterable(itertools.repeat(rows, groups) for groups, rows in self.runs)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, GroupRows | tuple) and tuple(self) == tuple(other)

    def __hash__(self) -> int:
        return hash(self.runs)

    def __reduce__(self) -> tuple[Any, ...]:
        return GroupRows.of_runs, (self.runs,)

    def __repr__(self) -> str:
        return f"GroupRows({list(self)!r})"
