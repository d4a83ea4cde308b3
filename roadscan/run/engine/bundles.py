"""Bundles of small pieces of work for one worker. Each piece ends independently: with a record or a reason."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from roadscan.run.engine.compute import Compute, damaged_file, reason_of
from roadscan.store.manifest import Manifest, OutputRecord

T = TypeVar("T")


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
