"""Writes a run's figures as a file that Prometheus' node exporter collects (its textfile collector)."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from prometheus_client import CollectorRegistry, Gauge, write_to_textfile

from roadscan.core.errors import ConfigError
from roadscan.run.telling.events import DONE, Event, Listener, Progressed, RunBegan, RunEnded, StageEnded

_SUFFIX: Final = ".prom"
"""The collector reads files with this ending alone."""


class PrometheusFile(Listener):
    """Replaces the file at the begin and the end of the run and of each stage, so that nobody reads half of it."""

    def __init__(self, file: Path) -> None:
        """Check that the file can be written; ConfigError where not."""
        super().__init__()
        self.title, self._file = f"the file of metrics {file}", file
        self._registry = CollectorRegistry()
        self._gauges: dict[str, Gauge] = {}
        try:
            if file.suffix != _SUFFIX:
                raise OSError(f"its name does not end in {_SUFFIX}")
            write_to_textfile(str(file), self._registry)
        except OSError as error:
            raise ConfigError(
                f"the file of metrics cannot be written: {error.strerror or error}",
                expected=f"a file whose name ends in {_SUFFIX}, in a folder that exists",
                change="see to --metrics or ROADSCAN_METRICS",
                file=file,
            ) from error

    def hear(self, event: Event) -> None:
        """Take the figures of an event."""
        if isinstance(event, RunBegan):
            self._set("run_started_timestamp_seconds", "When the last run began (Unix s).", event, event.at_ns / 1e9)
            self._set("run_running", "1 while a run is at work.", event, 1)
        elif isinstance(event, Progressed):
            self._set("stage_done", "Units of a stage that are done.", event, event.done, event.stage)
            self._set("stage_total", "Units of a stage.", event, event.total, event.stage)
        elif isinstance(event, StageEnded):
            self._stage_ended(event)
        elif isinstance(event, RunEnded):
            self._set("run_running", "1 while a run is at work.", event, 0)
            self._set("run_ended_timestamp_seconds", "When the last run ended (Unix s).", event, event.at_ns / 1e9)
            self._set("run_seconds", "How long the last run took (s).", event, event.seconds)
            self._set("run_ok", "1 where the last run ended without a fault.", event, event.outcome == DONE)
        else:
            return
        write_to_textfile(str(self._file), self._registry)

    def _stage_ended(self, event: StageEnded) -> None:
        stage = event.stage
        self._set("stage_seconds", "How long a stage of the last run took (s).", event, event.seconds, stage)
        self._set("stage_tasks", "Tasks of a stage of the last run.", event, event.tasks, stage)
        self._set("stage_failed", "Units of a stage that failed in the last run.", event, event.failed, stage)
        self._set("stage_written_bytes", "Bytes that a stage put into the store.", event, event.bytes_written, stage)
        if event.bytes_read is not None:
            self._set("stage_read_bytes", "Bytes that a stage read from files.", event, event.bytes_read, stage)
        if event.peak_memory_bytes is not None:
            most = "Most memory that a process of a stage has held since it began."
            self._set("stage_peak_memory_bytes", most, event, event.peak_memory_bytes, stage)

    def _set(self, name: str, meaning: str, event: Event, value: float, stage: str | None = None) -> None:
        labels = {"survey": event.survey} | ({} if stage is None else {"stage": stage})
        if name not in self._gauges:
            self._gauges[name] = Gauge(f"roadscan_{name}", meaning, list(labels), registry=self._registry)
        self._gauges[name].labels(**labels).set(value)
