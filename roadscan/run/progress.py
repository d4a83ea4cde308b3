"""Shows progress: bars on a terminal, plain lines in a log, events for those who listen; and estimates its end."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Iterator
from typing import Final

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from roadscan.core.counted import counted, time_in_words
from roadscan.core.private_folder import cache_place
from roadscan.run.session import Reporter
from roadscan.run.telling import Progressed, Said, Teller

_EVERY_S = 5.0
"""Least time between two lines, or two events, of a stage's progress (s): a person reads each."""


_MOST_POINTS = 64
"""Most points of a stage's progress that are kept; more would tell its pace no better."""


class Pace:
    """How fast a stage goes: the time that the later half of what was done took.

    What was done before a stage is first heard of counts for nothing, and the first half holds the start of workers.
    """

    def __init__(self) -> None:
        self._points: dict[str, tuple[int, list[tuple[float, int]]]] = {}

    def left_s(self, stage: str, done: int, total: int) -> float | None:
        """Return the seconds until all are done; None before any was."""
        of, points = self._points.get(stage, (total, []))
        if of != total or (points and done < points[-1][1]):  # a stage counts something else under the same name
            points = []
        if not points or done > points[-1][1]:
            points.append((time.monotonic(), done))
        if len(points) > _MOST_POINTS:
            del points[1:-1:2]
        self._points[stage] = total, points
        if len(points) == 1:
            return None
        half = (points[0][1] + done) / 2
        began, before = [point for point in points[:-1] if point[1] <= half][-1]
        return (time.monotonic() - began) * (total - done) / (done - before)


_LOOK_S: Final = 3.0
"""How often it is looked for kernels that were compiled (s)."""


class Shown(Reporter):
    """Common base: stores the progress of each stage."""

    def __init__(self) -> None:
        self._done: dict[str, tuple[int, int]] = {}

    def progress(self, stage: str, done: int, total: int) -> None:
        """Store the progress of a stage."""
        self._done[stage] = (done, total)

    def where(self, stage: str) -> str:
        """Return the progress of a stage in words."""
        if stage not in self._done:
            return f"in the stage {stage}" if stage else "before the first stage"
        done, total = self._done[stage]
        return f"in the stage {stage}, {done:,} of {total:,} done"


class LineReporter(Shown):
    """Plain lines on standard error; at most one every few seconds per stage."""

    def __init__(self, every_s: float = _EVERY_S) -> None:
        super().__init__()
        self._every_s = every_s
        self._last: dict[str, float] = {}
        self._pace = Pace()

    def line(self, text: str) -> None:
        """Print a line."""
        sys.stderr.write(text + "\n")
        sys.stderr.flush()

    def progress(self, stage: str, done: int, total: int) -> None:
        """Print the progress of a stage, and when it ends if it goes on as before."""
        super().progress(stage, done, total)
        now, left_s = time.monotonic(), self._pace.left_s(stage, done, total)
        if total and (done == total or now - self._last.get(stage, 0.0) >= self._every_s):
            self._last[stage] = now
            left = f", about {time_in_words(left_s)} left" if left_s and done < total else ""
            self.line(f"{stage}: {done} of {total}{left}")

    def close(self) -> None:
        """Do nothing: there is nothing to close."""


class TerminalReporter(Shown):
    """Bars on standard error."""

    def __init__(self) -> None:
        super().__init__()
        self._bars = Progress(
            TextColumn("{task.description:>10}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True),
        )
        self._ids: dict[str, TaskID] = {}
        self._bars.start()

    def line(self, text: str) -> None:
        """Print a line above the bars."""
        self._bars.console.print(text, highlight=False, markup=False)

    def progress(self, stage: str, done: int, total: int) -> None:
        """Move a stage's bar."""
        super().progress(stage, done, total)
        if stage not in self._ids:
            self._ids[stage] = self._bars.add_task(stage, total=total)
        self._bars.update(self._ids[stage], completed=done, total=total)

    def close(self) -> None:
        """Close the bars as they are."""
        self._bars.stop()


@contextlib.contextmanager
def reporting_compilation(reporter: Reporter) -> Iterator[None]:
    """Tell every few seconds which kernels this machine compiles meanwhile: a first run does so for a minute.

    Whatever process compiles one, it puts it into the cache that all share.
    """
    over, began_s = threading.Event(), time.time()

    def look() -> None:
        known = 0
        while not over.wait(_LOOK_S):
            made: list[tuple[float, str]] = []
            with contextlib.suppress(OSError):  # another process puts a file in the place of one
                files = [(file.stat().st_mtime, file.name) for file in cache_place().glob("*/*/*.nbc")]
                made = sorted(one for one in files if one[0] >= began_s)
            if len(made) > known:
                known = len(made)
                name = made[-1][1].partition("-")[0]
                reporter.line(f"compiled, once for this machine: {counted(known, 'kernel')}, the last is {name}")

    watch = threading.Thread(target=look, daemon=True)
    watch.start()
    try:
        yield
    finally:
        over.set()
        watch.join()


class ToldReporter(Reporter):
    """Shows a run's messages as another reporter does, and tells them as events."""

    def __init__(self, shown: Reporter, teller: Teller) -> None:
        self._shown, self._teller = shown, teller
        self._pace, self._last = Pace(), dict[str, float]()

    def line(self, text: str) -> None:
        """Show and tell a line."""
        self._shown.line(text)
        self._teller.tell(Said, text=text)

    def progress(self, stage: str, done: int, total: int) -> None:
        """Show the progress of a stage, and tell it every few seconds."""
        self._shown.progress(stage, done, total)
        now, left_s = time.monotonic(), self._pace.left_s(stage, done, total)
        if total and (done == total or now - self._last.get(stage, 0.0) >= _EVERY_S):
            self._last[stage] = now
            ends_ns = None if left_s is None else time.time_ns() + int(1e9 * left_s)
            self._teller.tell(Progressed, stage=stage, done=done, total=total, ends_ns=ends_ns)
