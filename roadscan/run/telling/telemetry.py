"""Sends a run as a trace, and its figures as metrics, to a collector of OpenTelemetry (OTLP over HTTP).

Where to is said by the environment that OpenTelemetry defines (`OTEL_EXPORTER_OTLP_ENDPOINT`, `OTEL_SERVICE_NAME` …).
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any, Final

from roadscan import __version__
from roadscan.core.extras import need
from roadscan.run.telling.events import DONE, Event, Listener, RunBegan, RunEnded, StageBegan, StageEnded, UnitEnded

if TYPE_CHECKING:
    from opentelemetry.trace import Span

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
