"""Shared parts of exports: the readings of one sensor in one run, and atomic output folders."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from roadscan.core.errors import ConfigError, nearest
from roadscan.georeference.plan.plan import SurveyPlan
from roadscan.georeference.sources import ReadingSource
from roadscan.store.holders import beside
from roadscan.store.logs import DataFile


@dataclass(frozen=True)
class Exported:
    """Result of an export."""

    files: tuple[Path, ...]
    notes: tuple[str, ...]
    """Notes for the user."""


def source_in(plan: SurveyPlan, run: str, sensor: str) -> tuple[ReadingSource, list[DataFile]]:
    """Return the readings of a sensor in a run, and their files in the order of time."""
    found = [(s, f) for s, f in plan.sources if (s.run, s.sensor) == (run, sensor)]
    if not found:
        known = sorted({f"{s.run}/{s.sensor}" for s, _ in plan.sources})
        raise ConfigError(
            f"there are no readings of '{sensor}' in run '{run}'{nearest(f'{run}/{sensor}', known)}",
            expected="run and sensor of: " + ", ".join(known),
        )
    if len({(s.table, s.key) for s, _ in found}) > 1:
        raise ConfigError(
            f"the logs of '{sensor}' in run '{run}' are placed in different ways", expected="one geometry"
        )
    files = sorted((f for _, files_of_log in found for f in files_of_log), key=lambda f: (f.span or (0, 0), f.path))
    return found[0][0], files


@contextlib.contextmanager
def published(out: Path) -> Iterator[Path]:
    """Return a scratch folder beside `out` that is renamed to it at the end; `out` must not contain anything yet."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(f"{out} is there already", expected="a new or empty folder", change="choose another --out")
    out.parent.mkdir(parents=True, exist_ok=True)
    scratch = beside(out)
    scratch.mkdir()
    try:
        yield scratch
        if out.exists():
            out.rmdir()
        scratch.rename(out)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
