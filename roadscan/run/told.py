"""A run that is told: who listens is opened, hears of the run and is closed."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from roadscan.core.errors import ConfigError
from roadscan.run.progress import ToldReporter
from roadscan.run.session import Session
from roadscan.run.telling.events import Listener
from roadscan.run.telling.history import History
from roadscan.run.telling.json_lines import JsonLines
from roadscan.run.telling.prometheus import PrometheusFile
from roadscan.run.telling.telemetry import ENDPOINTS, Telemetry, is_wanted
from roadscan.run.telling.teller import Teller, ToldCompute

EVENTS_VARIABLE: Final = "ROADSCAN_EVENTS"
"""Variable of the environment that names the file of events, where no option does."""
METRICS_VARIABLE: Final = "ROADSCAN_METRICS"
"""The same for the file of metrics."""


class Asked(NamedTuple):
    """Files that a run is asked to write about itself."""

    events: Path | None = None
    """Events as JSON lines, appended."""
    metrics: Path | None = None
    """Figures for Prometheus, replaced; in a folder, a file of the survey's name."""

    @classmethod
    def of(cls, events: str | Path | None = None, metrics: str | Path | None = None) -> Asked:
        """Return the files that are named, or those that the environment names in their place."""
        named = events or os.environ.get(EVENTS_VARIABLE), metrics or os.environ.get(METRICS_VARIABLE)
        return cls(*(Path(one) if one else None for one in named))

    def listeners(self, survey: str) -> list[Listener]:
        """Open what was asked for, and telemetry where the environment names a collector.

        Raises
        ------
        ConfigError
            A file cannot be written, or telemetry needs an extra that is not installed.
        """
        found: list[Listener] = [] if self.events is None else [JsonLines(self.events)]
        if self.metrics is not None:
            named = self.metrics / f"roadscan-{survey}.prom" if self.metrics.is_dir() else self.metrics
            found.append(PrometheusFile(named))
        if is_wanted():
            try:
                found.append(Telemetry())
            except ConfigError as error:
                variable = next(name for name in ENDPOINTS if os.environ.get(name))
                raise ConfigError(error.arrived, change=f"{error.change}, or unset {variable}") from error
        return found


@contextlib.contextmanager
def told_run(session: Session, stages: Sequence[str], asked: Asked | None = None) -> Iterator[None]:
    """Tell of a run to its history and to those that are asked for; within a run that is told, do nothing more."""
    if session.teller is not None:
        yield
        return
    shown = session.reporter
    listeners = [] if asked is None else asked.listeners(session.survey.config.id)
    teller = Teller(
        session.survey.config.id, [*listeners, History(session.store)], lambda text: shown.line(f"note: {text}")
    )
    session.teller, session.reporter = teller, ToldReporter(shown, teller)
    try:
        with teller.whole_run(stages):
            yield
    finally:
        session.teller, session.reporter = None, shown
        teller.close()


@contextlib.contextmanager
def told_stage(session: Session, stage: str) -> Iterator[None]:
    """Tell of a stage and of its tasks, where the run is told."""
    if session.teller is None:
        yield
        return
    session.teller.resumed = bool(session.goes_on)
    compute = session.compute
    session.compute = ToldCompute(compute, session.teller)
    try:
        with session.teller.stage(stage, lambda: [f"{unit}: {reason}" for _, unit, reason in session.failures]):
            yield
    finally:
        session.compute = compute
