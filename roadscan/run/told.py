"""A run that is told: who listens is opened, hears of the run and is closed; what each of them writes.

A run goes to a collector of OpenTelemetry (OTLP over HTTP) as a trace, and its figures as metrics. The environment says
where to, as OpenTelemetry defines it (`OTEL_EXPORTER_OTLP_ENDPOINT`, `OTEL_SERVICE_NAME` …).
"""

from __future__ import annotations

import contextlib
import datetime as dt
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from prometheus_client import CollectorRegistry, Gauge, write_to_textfile

from roadscan import __version__
from roadscan.core.errors import ConfigError
from roadscan.core.extras import need
from roadscan.core.gpstime import gps_ns_from_utc
from roadscan.run.progress import ToldReporter
from roadscan.run.session import Session
from roadscan.run.telling import (
    DONE,
    Event,
    Listener,
    Progressed,
    RunBegan,
    RunEnded,
    StageBegan,
    StageEnded,
    Teller,
    ToldCompute,
    UnitEnded,
)
from roadscan.store.history import write_history
from roadscan.store.store import Store

if TYPE_CHECKING:
    from opentelemetry.trace import Span


class History(Listener):
    """Writes a row a stage when the run ends; a run that was refused before its first stage leaves none."""

    def __init__(self, store: Store) -> None:
        super().__init__()
        self.title = "the run's history"
        self._store = store
        self._began: RunBegan | None = None
        self._ended: list[StageEnded] = []

    def hear(self, event: Event) -> None:
        """Collect the stages; at the run's end, write them."""
        if isinstance(event, RunBegan):
            self._began = event
        elif isinstance(event, StageEnded):
            self._ended.append(event)
        elif isinstance(event, RunEnded) and self._began is not None and self._ended:
            self._write(self._began, event)

    def _write(self, began: RunBegan, ended: RunEnded) -> None:
        run = {
            "run": ended.run,
            "began_gps_ns": _gps_ns(ended.began_ns),
            "seconds": ended.seconds,
            "version": began.version,
            "host": began.host,
            "outcome": ended.outcome,
            "reason": ended.reason,
            "resumed": int(ended.resumed),
        }
        stages = [
            {
                "number": number,
                "stage": one.stage,
                "stage_began_gps_ns": _gps_ns(one.began_ns),
                "stage_seconds": one.seconds,
                "stage_outcome": one.outcome,
                "tasks": one.tasks,
                "failed": one.failed,
                "bytes_read": one.bytes_read,
                "bytes_written": one.bytes_written,
                "peak_memory_bytes": one.peak_memory_bytes,
                "hosts": ",".join(one.hosts),
            }
            for number, one in enumerate(self._ended, 1)
        ]
        name = f"{dt.datetime.fromtimestamp(ended.began_ns / 1e9, dt.UTC):%Y%m%dT%H%M%SZ}-{ended.run}"
        write_history(self._store, name, [run | stage for stage in stages])


def _gps_ns(unix_ns: int) -> int:
    return gps_ns_from_utc(dt.datetime.fromtimestamp(unix_ns // 1000 / 1e6, dt.UTC))


class JsonLines(Listener):
    """Appends a line an event to a file, and hands each to the system at once."""

    def __init__(self, file: Path) -> None:
        """Open the file; ConfigError where it cannot be written."""
        super().__init__()
        self.title = f"the file of events {file}"
        try:
            self._stream = file.open("a", encoding="utf-8")
        except OSError as error:
            raise ConfigError(
                f"the file of events cannot be written: {error.strerror}",
                expected="a file in a folder that exists",
                change="see to --events or ROADSCAN_EVENTS",
                file=file,
            ) from error

    def hear(self, event: Event) -> None:
        """Write the event."""
        self._stream.write(json.dumps(event.as_json(), ensure_ascii=False) + "\n")
        self._stream.flush()

    def close(self) -> None:
        """Close the file."""
        self._stream.close()


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


ENDPOINTS: Final = (
    "OTEL_EXPORTER_OTLP_ENDPOINT",
    "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT",
    "OTEL_EXPORTER_OTLP_METRICS_ENDPOINT",
)
"""Variables of the environment of which one, at least, names a collector."""


def is_wanted() -> bool:
    """Return whether the environment names a collector."""
    return any(map(os.environ.get, ENDPOINTS)) and os.environ.get("OTEL_SDK_DISABLED", "").lower() != "true"


class Telemetry(Listener):
    """A span for the run, one below it for each stage, and one below that for each task with the clock of its host."""

    def __init__(self) -> None:
        """Start the exporters; ConfigError where the extra `otel` is not installed."""
        super().__init__()
        self.title = "telemetry"
        need("opentelemetry.sdk.trace", "telemetry (OTEL_EXPORTER_OTLP_ENDPOINT)")
        from opentelemetry.exporter.otlp.proto.http.metric_exporter import OTLPMetricExporter
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.metrics import MeterProvider
        from opentelemetry.sdk.metrics.export import PeriodicExportingMetricReader
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor

        named = {"service.version": __version__}
        if "OTEL_SERVICE_NAME" not in os.environ:
            named["service.name"] = "roadscan"
        resource = Resource.create(named)
        self._traces = TracerProvider(resource=resource)
        self._traces.add_span_processor(BatchSpanProcessor(OTLPSpanExporter()))
        self._metrics = MeterProvider([PeriodicExportingMetricReader(OTLPMetricExporter())], resource)
        self._tracer = self._traces.get_tracer("roadscan", __version__)
        meter = self._metrics.get_meter("roadscan", __version__)
        self._tasks = meter.create_counter("roadscan.tasks", "{task}", "Tasks that ended.")
        self._failed = meter.create_counter("roadscan.failed", "{unit}", "Units that failed.")
        self._written = meter.create_counter("roadscan.written", "By", "Bytes of files put into the store.")
        self._read = meter.create_counter("roadscan.read", "By", "Bytes read from files.")
        self._seconds = meter.create_histogram("roadscan.stage.duration", "s", "How long a stage took.")
        self._memory = meter.create_gauge("roadscan.stage.peak_memory", "By", "Most memory that a process has held.")
        self._run: Span | None = None
        self._stage: Span | None = None

    def hear(self, event: Event) -> None:
        """Begin and end spans, and count."""
        if isinstance(event, RunBegan):
            of_run = {"roadscan.survey": event.survey, "roadscan.run": event.run, "host.name": event.host}
            self._run = self._tracer.start_span(f"run {event.survey}", attributes=of_run, start_time=event.at_ns)
        elif isinstance(event, StageBegan):
            self._stage = self._begun(event.stage, self._run, event.at_ns)
        elif isinstance(event, UnitEnded):
            self._unit(event)
        elif isinstance(event, StageEnded):
            self._end_stage(event)
        elif isinstance(event, RunEnded):
            _end(self._run, event.at_ns, event.outcome, event.reason)

    def close(self) -> None:
        """Send what is not sent yet, which waits for the collector (`OTEL_EXPORTER_OTLP_TIMEOUT`, 10 s by default)."""
        self._traces.shutdown()
        self._metrics.shutdown()

    def _begun(self, name: str, parent: Span | None, at_ns: int, **attributes: Any) -> Span:
        from opentelemetry.trace import set_span_in_context

        context = None if parent is None else set_span_in_context(parent)
        given = {key: value for key, value in attributes.items() if value is not None}
        return self._tracer.start_span(name, context, attributes=given, start_time=at_ns)

    def _unit(self, event: UnitEnded) -> None:
        of_unit = {
            "roadscan.unit": event.unit,
            "roadscan.units": event.units,
            "host.name": event.host,
            "process.pid": event.process,
            "roadscan.read_bytes": event.bytes_read,
            "roadscan.written_bytes": event.bytes_written,
            "roadscan.peak_memory_bytes": event.peak_memory_bytes,
        }
        began_ns = event.at_ns if event.began_ns is None else event.began_ns
        span = self._begun(event.task, self._stage, began_ns, **of_unit)
        _end(span, began_ns + int(1e9 * (event.seconds or 0.0)), event.outcome, event.reason)
        self._tasks.add(1, {"survey": event.survey, "stage": event.stage, "outcome": event.outcome})

    def _end_stage(self, event: StageEnded) -> None:
        of_stage = {"survey": event.survey, "stage": event.stage}
        self._failed.add(event.failed, of_stage)
        self._written.add(event.bytes_written, of_stage)
        self._read.add(event.bytes_read or 0, of_stage)
        self._seconds.record(event.seconds, of_stage)
        if event.peak_memory_bytes is not None:
            self._memory.set(event.peak_memory_bytes, of_stage)
        _end(self._stage, event.at_ns, event.outcome, event.reason)
        self._stage = None


def _end(span: Span | None, at_ns: int, outcome: str, reason: str) -> None:
    from opentelemetry.trace import Status, StatusCode

    if span is not None:
        span.set_status(Status(StatusCode.OK) if outcome == DONE else Status(StatusCode.ERROR, reason))
        span.end(at_ns)


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
def reported_run(session: Session, stages: Sequence[str], asked: Asked | None = None) -> Iterator[None]:
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
def reported_stage(session: Session, stage: str) -> Iterator[None]:
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
