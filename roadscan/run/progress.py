"""Shows progress: bars on a terminal, plain lines in a log."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Iterator
from typing import Final

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from roadscan.core.counted import counted
from roadscan.core.private_folder import cache_place
from roadscan.run.session import Reporter

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

    def __init__(self, every_s: float = 5.0) -> None:
        super().__init__()
        self._every_s = every_s
        self._last: dict[str, float] = {}

    def line(self, text: str) -> None:
        """Print a line."""
        sys.stderr.write(text + "\n")
        sys.stderr.flush()

    def progress(self, stage: str, done: int, total: int) -> None:
        """Print the progress of a stage."""
        super().progress(stage, done, total)
        now = time.monotonic()
        if total and (done == total or now - self._last.get(stage, 0.0) >= self._every_s):
            self._last[stage] = now
            self.line(f"{stage}: {done} of {total}")

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
def compiling_told(reporter: Reporter) -> Iterator[None]:
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
