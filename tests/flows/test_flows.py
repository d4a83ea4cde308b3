"""The flows, run through a real Prefect server on a tiny simulated survey."""

from __future__ import annotations

import json
import logging
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import laspy
import pytest
import rasterio
from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterId
from prefect.client.schemas.objects import FlowRun, State, StateType
from prefect.flow_engine import run_flow
from prefect.logging.loggers import flow_run_logger

from roadscan.core.errors import ConfigError, RoadscanError, RunError, StoreError
from roadscan.flows import conduct
from roadscan.flows.reprocess import reprocess
from roadscan.flows.survey import survey
from roadscan.simulate import SimulatedSurvey

pytestmark = pytest.mark.usefixtures("prefect_api")

TILE = "69100_533500"
"""The tile with the road's start at (691000, 5335000), where both profilers pass."""
LEFT_ONLY = "69099_533500"
"""A tile of which the right profiler saw nothing."""


@pytest.fixture(scope="module")
def finished(simulated: SimulatedSurvey, tmp_path_factory: pytest.TempPathFactory, prefect_api: object) -> Path:
    """Survey file of a survey that the flow has run once."""
    folder = tmp_path_factory.mktemp("finished") / "city"
    shutil.copytree(simulated.folder, folder)
    survey(str(folder / simulated.survey_file.name), workers=0)
    return folder / simulated.survey_file.name


@pytest.fixture
def rerun(finished: Path, tmp_path: Path) -> Path:
    """Survey file of a copy of the finished survey."""
    shutil.copytree(finished.parent, tmp_path / "city")
    return tmp_path / "city" / finished.name


@pytest.fixture
def client() -> Iterator[SyncPrefectClient]:
    with get_client(sync_client=True) as opened:
        yield opened


def files(survey_file: Path, folder: str) -> dict[str, Path]:
    root = survey_file.parent / "store" / "survey=city"
    return {p.relative_to(root).as_posix(): p for p in sorted((root / folder).rglob("*")) if p.is_file()}


def contents(survey_file: Path) -> dict[str, bytes]:
    """All tables, tiles and products."""
    return {n: p.read_bytes() for f in ("tables", "tiles", "products") for n, p in files(survey_file, f).items()}


def written(survey_file: Path, folder: str) -> dict[str, tuple[int, int]]:
    """Which file each is: it changes where a file is written anew, even with the same bytes."""
    return {n: (p.stat().st_ino, p.stat().st_mtime_ns) for n, p in files(survey_file, folder).items()}


def recorded(client: SyncPrefectClient, state: State[Any]) -> FlowRun:
    """The flow run as the server knows it."""
    assert state.state_details.flow_run_id is not None
    return client.read_flow_run(state.state_details.flow_run_id)


@pytest.mark.slow
def test_survey_makes_every_product(survey_file: Path, simulated: SimulatedSurvey, client: SyncPrefectClient) -> None:
    state = survey(str(survey_file), workers=0, return_state=True)
    run = recorded(client, state)
    assert run.state is not None
    assert run.state.type is StateType.COMPLETED
    assert run.name == "city/SURVEY.toml"
    ids = FlowRunFilter(id=FlowRunFilterId(any_=[run.id]))
    tasks = sorted(client.read_task_runs(flow_run_filter=ids), key=lambda t: t.expected_start_time)
    assert [t.name for t in tasks] == [
        "ingest", "navigate", "footprints", "strips", "video_frames", "picture_ties", "adjust", "tiles", "pictures",
        "surfaces", "products", "condition", "assets", "colours",
    ]  # fmt: skip

    clouds = files(survey_file, "tiles/las").values()
    assert sum(laspy.read(cloud).header.point_count for cloud in clouds) == simulated.readings
    assert TILE in {cloud.stem for cloud in clouds}
    with rasterio.open(files(survey_file, "products/mosaic")["products/mosaic/count.tif"]) as count:
        assert count.read(1, masked=True).sum() == simulated.readings


@pytest.mark.slow
def test_second_run_does_nothing(rerun: Path) -> None:
    before = {f: written(rerun, f) for f in ("tables", "tiles", "products")}
    assert all(before.values())
    events, metrics = rerun.parent / "events.jsonl", rerun.parent / "run.prom"
    assert survey(str(rerun), workers=0, events=str(events), metrics=str(metrics)) == {"raw_bytes_read": 0.0}
    assert {f: written(rerun, f) for f in before} == before
    told = [json.loads(line) for line in events.read_text().splitlines()]
    assert [one["event"] for one in told].count("stage_ended") == len(told[0]["stages"]) > 10
    assert (told[-1]["event"], told[-1]["outcome"]) == ("run_ended", "done")
    assert f'roadscan_run_ok{{survey="{told[0]["survey"]}"}} 1.0' in metrics.read_text()
    assert len(files(rerun, "manifest/history")) == 2


DAY = {"start": "2026-05-04T00:00:00Z", "end": "2026-05-05T00:00:00Z"}
OTHER_DAY = {"start": "2026-05-05T00:00:00Z", "end": "2026-05-06T00:00:00Z"}


@pytest.mark.slow
@pytest.mark.parametrize(
    "choice",
    [{"tiles": [TILE]}, {"box_m": (691002.0, 5335002.0, 691003.0, 5335003.0)}, DAY],
    ids=["tile", "box", "time"],
)
def test_reprocess_writes_the_same_bytes_again(rerun: Path, choice: dict[str, Any]) -> None:
    bytes_before, before = contents(rerun), written(rerun, "tiles")
    assert reprocess(str(rerun), **choice)["raw_bytes_read"] > 0
    assert contents(rerun) == bytes_before
    after = written(rerun, "tiles")
    chosen = {n for n in before if choice is DAY or Path(n).stem == TILE}
    assert {n for n in before if after[n] != before[n]} == chosen


@pytest.mark.slow
def test_damaged_data_fails_the_run_and_names_the_tiles(rerun: Path, client: SyncPrefectClient) -> None:
    (damaged,) = (p for n, p in files(rerun, "tables/scans").items() if "profiler_right" in n)
    damaged.write_bytes(bytes(damaged.stat().st_size))
    before = written(rerun, "tiles")
    state = reprocess(str(rerun), **DAY, return_state=True)
    run = recorded(client, state)
    assert run.state is not None
    assert run.state.type is StateType.FAILED
    # The tile that only the other profiler touches is finished all the same; the run names all others.
    after = written(rerun, "tiles")
    assert {Path(n).stem for n in before if after[n] != before[n]} == {LEFT_ONLY}
    failed = {Path(n).stem for n in before} - {LEFT_ONLY}
    assert TILE in failed
    assert all(f"tiles {tile}: " in run.state.message for tile in failed)
    assert "profiler_right" in run.state.message
    with pytest.raises(RunError, match=TILE):
        state.result()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("choice", "error", "words"),
    [
        ({"start": DAY["start"]}, ConfigError, "expected start and end"),
        ({"tiles": ["here"]}, ConfigError, "COLUMN_ROW"),
        ({"tiles": ["1_1"]}, ConfigError, "no reading touches tile 1_1"),
        (OTHER_DAY, ConfigError, "no tile with readings"),
    ],
)
def test_a_choice_that_cannot_be_met_fails(
    rerun: Path, choice: dict[str, Any], error: type[RoadscanError], words: str
) -> None:
    before = written(rerun, "tiles")
    with pytest.raises(error, match=words):
        reprocess(str(rerun), **choice)
    assert written(rerun, "tiles") == before


@pytest.mark.slow
def test_an_upload_without_one_log_fails_and_names_it(survey_file: Path) -> None:
    missing = survey_file.parent / "raw" / "run-1" / "profiler_left.parquet"
    log = missing.read_bytes()
    missing.unlink()
    with pytest.raises(RoadscanError, match=r"profiler_left\.parquet: the log does not exist"):
        survey(str(survey_file), workers=0)
    missing.write_bytes(log)  # the upload goes on, and the next run succeeds
    assert survey(str(survey_file), workers=0)["raw_bytes_read"] > 0


@pytest.mark.slow
def test_an_api_that_does_not_answer(survey_file: Path) -> None:
    with socket.socket() as silent:  # bound, but nobody listens
        silent.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{silent.getsockname()[1]}/api"
        command = [sys.executable, "-m", "roadscan", "run", str(survey_file)]
        environment = os.environ | {"PREFECT_API_URL": url}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 2
    assert done.stderr.startswith(f"roadscan: no Prefect API answers at {url}")
    assert not (survey_file.parent / "store").exists()


class Heard(logging.Handler):
    """What Prefect's loggers of runs print."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []
        self.setFormatter(logging.Formatter("%(message)s"))

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a line, with its traceback."""
        self.lines.append(self.format(record))


def log_of_worker(client: SyncPrefectClient, survey_file: Path) -> str:
    """What the process that a worker starts logs of a flow run: it runs the flow with Prefect's logger of errors."""
    parameters = {"survey_file": str(survey_file), "workers": 0}
    flow_run = client.create_flow_run(survey, parameters=parameters)
    heard = Heard()
    loggers = [logging.getLogger(f"prefect.{name}") for name in ("flow_runs", "task_runs", "engine")]
    for logger in loggers:
        logger.addHandler(heard)
    try:
        with pytest.raises((RoadscanError, ZeroDivisionError)):
            run_flow(survey, flow_run=flow_run, parameters=parameters, error_logger=flow_run_logger(flow_run))
    finally:
        for logger in loggers:
            logger.removeHandler(heard)
    return "\n".join(heard.lines)


def told_once(log: str, words: str) -> None:
    assert log.count(words) == 1
    assert "Traceback" not in log
    assert "NoneType" not in log


def test_an_expected_error_is_logged_once_and_without_traceback(survey_file: Path, client: SyncPrefectClient) -> None:
    (survey_file.parent / "raw" / "run-1" / "profiler_left.parquet").unlink()
    told_once(log_of_worker(client, survey_file), "profiler_left.parquet: the log does not exist")


def test_an_expected_error_of_a_stage_likewise(
    survey_file: Path, client: SyncPrefectClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object) -> None:
        raise StoreError("the store is not to be written")

    monkeypatch.setattr(conduct, "run_stage", stopped)
    told_once(log_of_worker(client, survey_file), "the store is not to be written")


def test_an_unexpected_error_keeps_its_traceback(
    survey_file: Path, client: SyncPrefectClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(conduct, "run_stage", lambda *_: 1 // 0)
    assert "ZeroDivisionError: integer division" in log_of_worker(client, survey_file).partition("Traceback")[2]
