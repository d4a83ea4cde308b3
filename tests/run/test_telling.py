"""What a run tells of itself: events, its history, figures for Prometheus, and OpenTelemetry."""

from __future__ import annotations

import datetime as dt
import gzip
import json
import os
import pickle
import re
import shutil
import socket
from collections import Counter
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from opentelemetry.proto.collector.metrics.v1.metrics_service_pb2 import ExportMetricsServiceRequest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
from prometheus_client.parser import text_string_to_metric_families
from typer.testing import CliRunner, Result

from roadscan.cli import app
from roadscan.core.errors import StoreError
from roadscan.run.engine.measured import Cost, Measured, cost_of_error
from roadscan.run.progress import LineReporter
from roadscan.store.history import history_faults
from roadscan.store.query.sql import query
from roadscan.store.store import Store
from tests.conftest import REPOSITORY
from tests.serving import serving
from tests.surveys import Simulated, outputs

ALL_STAGES = [
    "ingest", "navigate", "footprints", "strips", "video_frames", "picture_ties", "adjust", "tiles", "pictures",
    "surfaces", "products", "condition", "assets", "colours",
]  # fmt: skip


def run(survey: Simulated, *options: str) -> Result:
    return CliRunner().invoke(app, ["run", str(survey.survey_file), "--workers", "0", *options])


def heard(file: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]


def history(store: Store) -> list[dict[str, Any]]:
    """The table, also of a store of which other tables are damaged."""
    asked = query(store, "SELECT * FROM run_history ORDER BY began_gps_ns, number", damaged=[])
    rows: list[dict[str, Any]] = asked.to_pylist()
    return rows


@pytest.fixture(scope="module")
def told(simulated: Simulated, tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    """A survey that the command ran from raw logs, with its events and figures beside the survey file."""
    survey = simulated.copy_to(tmp_path_factory.mktemp("told") / "survey")
    folder = survey.survey_file.parent
    done = run(survey, "--events", str(folder / "events.jsonl"), "--metrics", str(folder / "run.prom"))
    assert done.exit_code == 0, done.output
    return survey


@pytest.fixture(scope="module")
def events(told: Simulated) -> list[dict[str, Any]]:
    return heard(told.survey_file.parent / "events.jsonl")


def of(events: list[dict[str, Any]], kind: str, stage: str | None = None) -> list[dict[str, Any]]:
    return [one for one in events if one["event"] == kind and stage in (None, one["stage"])]


@pytest.mark.slow
def test_every_stage_begins_and_ends_once_within_the_run(events: list[dict[str, Any]]) -> None:
    assert (events[0]["event"], events[-1]["event"]) == ("run_began", "run_ended")
    assert events[0]["stages"] == ALL_STAGES
    order = [(one["event"], one["stage"]) for one in events if one["event"].startswith("stage_")]
    assert order == [(kind, stage) for stage in ALL_STAGES for kind in ("stage_began", "stage_ended")]
    assert {one["run"] for one in events} == {events[0]["run"]} and {one["survey"] for one in events} == {"demo"}
    assert (events[0]["host"], events[0]["process"]) == (socket.gethostname(), os.getpid())
    instants = [dt.datetime.fromisoformat(one["at_utc"]) for one in events]
    assert instants == sorted(instants) and instants[0].utcoffset() == dt.timedelta(0)
    taken_s = sum(one["seconds"] for one in of(events, "stage_ended"))
    assert taken_s <= events[-1]["seconds"] <= (instants[-1] - instants[0]).total_seconds() + 0.01


@pytest.mark.slow
def test_units_are_the_logs_and_the_tiles(told: Simulated, events: list[dict[str, Any]]) -> None:
    raw = [file for file in told.survey_file.parent.rglob("*") if file.suffix in {".parquet", ".sbet", ".csv", ".pcap"}]
    logs = Counter(file.name for file in raw if "store" not in file.parts and "truth" not in file.parts)
    assert Counter(one["unit"] for one in of(events, "unit_ended", "ingest")) == logs
    tiles = of(events, "unit_ended", "tiles")
    known = query(told.store(), "SELECT unit FROM outputs WHERE product = 'tile'").column("unit").to_pylist()
    assert {name for one in tiles for name in (one["unit"], one["last"])} <= set(known)
    assert sum(one["units"] for one in tiles) == len(known) > len(told.store().files("tiles/las")) > 0
    assert {one["outcome"] for one in of(events, "unit_ended")} == {"done"}


@pytest.mark.slow
def test_bytes_written_are_those_of_the_files(told: Simulated, events: list[dict[str, Any]]) -> None:
    """Sizes as the file system states them; a stage writes records of the manifest beside its files, too."""
    store = told.store()
    ingested = tuple(f"tables/{name}" for name in ("packed_returns", "scans", "trajectory"))
    for stage, folders in (("ingest", ingested), ("tiles", ("tiles",))):
        size = sum(Path(store.path(path)).stat().st_size for folder in folders for path in store.files(folder))
        (ended,) = of(events, "stage_ended", stage)
        assert size <= ended["bytes_written"] < size + 300_000, stage
    tasks = of(events, "unit_ended", "tiles")
    assert sum(one["bytes_written"] for one in tasks) == sum(
        Path(store.path(path)).stat().st_size for path in store.files("tiles")
    )
    (ended,) = of(events, "stage_ended", "tiles")
    assert ended["bytes_read"] >= sum(one["bytes_read"] for one in tasks) > 0


def test_what_a_task_costs() -> None:
    """Against blocks of known size that it reads and holds."""

    def holds(file: Path) -> int:
        held = bytearray(64 << 20)
        held[:: 1 << 12] = b"x" * len(held[:: 1 << 12])  # each page is touched
        return len(file.read_bytes())

    before = _resident_bytes()
    file = Path(__file__)
    done = Measured(holds)(file)
    assert done.result == file.stat().st_size
    assert done.cost.bytes_read is not None and done.result <= done.cost.bytes_read < done.result + 100_000
    assert done.cost.peak_memory_bytes is not None and done.cost.peak_memory_bytes >= before + (60 << 20)


def _resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")


def test_an_error_brings_its_cost_from_a_worker() -> None:
    def fails(_: int) -> int:
        raise StoreError("no", change="nothing", file="x")

    with pytest.raises(StoreError) as caught:
        Measured(fails)(1)
    sent = pickle.loads(pickle.dumps(caught.value))
    cost = cost_of_error(sent)
    assert isinstance(cost, Cost) and cost.process == os.getpid() and str(sent) == str(caught.value)


@pytest.mark.slow
def test_history_says_what_the_events_say(told: Simulated, events: list[dict[str, Any]]) -> None:
    rows = history(told.store())
    mine = [row for row in rows if row["run"] == events[0]["run"]]
    for row, event in zip(mine, of(events, "stage_ended"), strict=True):
        assert row["stage"] == event["stage"] and row["stage_seconds"] == event["seconds"]
        assert [row[n] for n in ("tasks", "bytes_read", "bytes_written", "peak_memory_bytes")] == [
            event[n] for n in ("tasks", "bytes_read", "bytes_written", "peak_memory_bytes")
        ]
    assert {(row["outcome"], row["version"], row["host"]) for row in mine} == {
        ("done", events[0]["version"], socket.gethostname())
    }
    (began,) = query(told.store(), "SELECT DISTINCT utc(began_gps_ns) AS t FROM run_history").column("t").to_pylist()
    assert abs((began - dt.datetime.fromisoformat(events[0]["at_utc"])).total_seconds()) < 1.0


@pytest.mark.slow
def test_prometheus_reads_the_figures(told: Simulated, events: list[dict[str, Any]]) -> None:
    text = (told.survey_file.parent / "run.prom").read_text()
    found = {
        (sample.name, sample.labels.get("stage", "")): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
        if sample.labels["survey"] == "demo"
    }
    for event in of(events, "stage_ended"):
        assert found["roadscan_stage_seconds", event["stage"]] == event["seconds"]
        assert found["roadscan_stage_written_bytes", event["stage"]] == event["bytes_written"]
    assert (found["roadscan_run_ok", ""], found["roadscan_run_running", ""]) == (1.0, 0.0)
    assert found["roadscan_run_seconds", ""] == events[-1]["seconds"]


@pytest.mark.slow
def test_the_board_asks_for_what_a_run_writes(told: Simulated) -> None:
    written = {f.name for f in text_string_to_metric_families((told.survey_file.parent / "run.prom").read_text())}
    asked = set(re.findall(r"roadscan_\w+", (REPOSITORY / "deploy" / "grafana.json").read_text()))
    assert asked <= written and len(asked) > 8
    assert written - asked == {"roadscan_run_seconds", "roadscan_stage_tasks"}


@pytest.mark.slow
def test_who_listens_changes_no_output(told: Simulated, finished: Simulated, tmp_path: Path) -> None:
    """The run that told nobody made the same bytes, and after both a further run finds nothing to do."""
    assert outputs(told.store()) == outputs(finished.store())
    again = told.copy_with_store_to(tmp_path / "again")
    (tmp_path / "node").mkdir()
    stamps = {path: Path(again.store().path(path)).stat().st_mtime_ns for path in outputs(again.store())}
    assert run(again, "--events", str(tmp_path / "idle.jsonl"), "--metrics", str(tmp_path / "node")).exit_code == 0
    assert [file.name for file in (tmp_path / "node").iterdir()] == ["roadscan-demo.prom"]
    assert {path: Path(again.store().path(path)).stat().st_mtime_ns for path in outputs(again.store())} == stamps
    assert of(heard(tmp_path / "idle.jsonl"), "unit_ended") == []
    again.store().write_bytes("manifest/changing", b"")  # as a run leaves it whose process is killed
    assert run(again).exit_code == 0
    rows = history(again.store())
    assert [row["resumed"] for row in rows if row["stage"] == "tiles"] == [0, 0, 1]
    runs = {row["run"]: row["tasks"] for row in rows if row["stage"] == "tiles"}
    assert len(runs) == 3 and min(runs.values()) == 0 < max(runs.values())


@pytest.mark.slow
def test_a_failure_is_told_with_its_reason(told: Simulated, tmp_path: Path) -> None:
    broken = told.copy_with_store_to(tmp_path / "broken")
    scans = next(p for p in broken.store().files("tables/scans") if "profiler_left" in p)
    Path(broken.store().path(scans)).write_bytes(bytes(Path(broken.store().path(scans)).stat().st_size))
    broken.store().remove("manifest/outputs")
    assert run(broken, "--events", str(tmp_path / "e.jsonl"), "--metrics", str(tmp_path / "m.prom")).exit_code != 0
    events = heard(tmp_path / "e.jsonl")
    assert events[-1]["outcome"] == "failed" and "profiler_left" in events[-1]["reason"]
    failed = [one for one in of(events, "stage_ended") if one["failed"]]
    assert failed and all("profiler_left" in one["reason"] for one in failed)
    assert 'roadscan_run_ok{survey="demo"} 0.0' in (tmp_path / "m.prom").read_text()
    rows = [row for row in history(broken.store()) if row["run"] == events[0]["run"]]
    assert {row["outcome"] for row in rows} == {"failed"}
    assert {row["stage"] for row in rows if row["stage_outcome"] == "failed"} == {one["stage"] for one in failed}


@pytest.mark.slow
def test_no_flipped_bit_of_the_history_is_silent(told: Simulated, tmp_path: Path) -> None:
    copy = told.copy_with_store_to(tmp_path / "copy")
    store = copy.store()
    (path,) = store.files("manifest/history")
    whole = store.read_bytes(path)
    assert history_faults(store) == {}
    missed = []
    for bit in range(0, 8 * len(whole), 97):
        flipped = bytearray(whole)
        flipped[bit // 8] ^= 1 << bit % 8
        Path(store.path(path)).write_bytes(flipped)
        missed += [] if path in history_faults(store) else [bit]
    assert missed == [] and len(whole) > 3000
    flipped = bytearray(whole)  # in the footer the name of a column
    flipped[whole.rindex(b"stage_seconds")] ^= 1
    Path(store.path(path)).write_bytes(flipped)
    asked = CliRunner().invoke(app, ["sql", "SELECT * FROM run_history", "--survey", str(copy.survey_file)])
    assert asked.exit_code == 1 and path in asked.output
    verified = CliRunner().invoke(app, ["verify", str(copy.survey_file)])
    assert verified.exit_code == 1 and path in verified.output and "remove the file" in verified.output
    Path(store.path(path)).unlink()
    assert CliRunner().invoke(app, ["verify", str(copy.survey_file)]).exit_code == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "told_of"),
    [
        (("--events", "/nowhere/e.jsonl"), "/nowhere/e.jsonl: the file of events cannot be written"),
        (("--metrics", "figures.txt"), "does not end in .prom"),
    ],
)
def test_a_file_that_cannot_be_written_is_refused_before_the_run(
    told: Simulated, options: tuple[str, ...], told_of: str
) -> None:
    refused = run(told, *options)
    assert refused.exit_code != 0 and told_of in str(refused.exception)


@pytest.mark.slow
def test_a_full_disk_of_the_events_stops_no_run(told: Simulated, tmp_path: Path) -> None:
    copy = told.copy_with_store_to(tmp_path / "copy")
    done = run(copy, "--events", "/dev/full")
    assert done.exit_code == 0 and "/dev/full is not written any more" in done.output
    assert len({row["run"] for row in history(copy.store())}) == 2


def test_the_end_is_estimated(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """500 of 1,000 are there before, 50 take 10 min (workers start), 50 more 1 min: the other 400 take 8 min."""
    clock = [1000.0]
    monkeypatch.setattr("time.monotonic", lambda: clock[0])
    reporter = LineReporter()
    for done, seconds in ((500, 600.0), (550, 60.0), (600, 0.0)):
        reporter.progress("tiles", done, 1000)
        clock[0] += seconds
    assert capsys.readouterr().err.splitlines() == [
        "tiles: 500 of 1000",
        "tiles: 550 of 1000, about 1 h 30 min left",
        "tiles: 600 of 1000, about 8 min left",
    ]


class Collector(HTTPServer):
    """Takes what an exporter of OpenTelemetry sends, and reads it with the messages of its protocol."""

    def __init__(self) -> None:
        self.traces, self.metrics = ExportTraceServiceRequest(), ExportMetricsServiceRequest()
        super().__init__(("127.0.0.1", 0), _Taken)


class _Taken(BaseHTTPRequestHandler):
    def do_POST(self) -> None:
        content = self.rfile.read(int(self.headers["Content-Length"]))
        content = gzip.decompress(content) if self.headers.get("Content-Encoding") == "gzip" else content
        assert isinstance(self.server, Collector)
        (self.server.traces if self.path == "/v1/traces" else self.server.metrics).MergeFromString(content)
        self.send_response(200)
        self.end_headers()

    def log_message(self, *_: Any) -> None:
        """Say nothing."""


@pytest.fixture
def collector(monkeypatch: pytest.MonkeyPatch) -> Iterator[Collector]:
    with serving(Collector()) as server:
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", f"http://127.0.0.1:{server.server_port}")
        yield server


@pytest.mark.slow
def test_a_collector_gets_the_run_as_a_trace_and_its_figures(
    collector: Collector, told: Simulated, tmp_path: Path
) -> None:
    copy = told.copy_to(tmp_path / "copy")
    assert run(copy, "--events", str(tmp_path / "e.jsonl")).exit_code == 0
    events = heard(tmp_path / "e.jsonl")
    spans = [s for r in collector.traces.resource_spans for scope in r.scope_spans for s in scope.spans]
    by_id = {span.span_id: span for span in spans}
    (root,) = (span for span in spans if not span.parent_span_id)
    stages = [span.name for span in spans if span.parent_span_id == root.span_id]
    assert root.name == "run demo" and sorted(stages) == sorted(ALL_STAGES)
    units = Counter(by_id[s.parent_span_id].name for s in spans if s.parent_span_id not in (b"", root.span_id))
    assert units == Counter(one["stage"] for one in of(events, "unit_ended"))
    assert all(s.end_time_unix_nano - s.start_time_unix_nano >= 0 for s in spans)
    metrics = {
        m.name: m for r in collector.metrics.resource_metrics for scope in r.scope_metrics for m in scope.metrics
    }
    counted = sum(point.as_int for point in metrics["roadscan.tasks"].sum.data_points)
    assert counted == units.total()
    written = sum(point.as_int for point in metrics["roadscan.written"].sum.data_points)
    assert written == sum(one["bytes_written"] for one in of(events, "stage_ended"))


@pytest.mark.slow
def test_a_collector_that_is_gone_stops_no_run(
    told: Simulated, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", "http://127.0.0.1:9")
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_TIMEOUT", "1")
    copy = told.copy_with_store_to(tmp_path / "copy")
    assert run(copy).exit_code == 0


@pytest.mark.slow
def test_no_run_before_its_first_stage_is_in_the_history(told: Simulated, tmp_path: Path) -> None:
    """It is in its events, though: a service has to hear of it."""
    copy = told.copy_with_store_to(tmp_path / "copy")
    shutil.rmtree(copy.survey_file.parent / "raw")
    copy.store().remove("manifest/logs")
    refused = run(copy, "--events", str(tmp_path / "e.jsonl"))
    assert refused.exit_code != 0
    events = heard(tmp_path / "e.jsonl")
    assert [one["event"] for one in events if one["event"] != "line"][-1] == "run_ended"
    assert events[-1]["outcome"] == "failed" and events[-1]["reason"]


@pytest.mark.slow
def test_the_table_is_as_its_schema_says(told: Simulated) -> None:
    from roadscan.store.schema import table_schema

    (path,) = told.store().files("manifest/history")
    table = pq.read_table(told.store().path(path))
    batch = table.combine_chunks().to_batches()[0]
    assert table_schema("run_history").faults(table_schema("run_history").conform(batch)) == []
