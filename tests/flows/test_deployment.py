"""deploy/prefect.yaml for real: a Prefect server, `prefect deploy`, and a worker that does what is due."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import TypeVar
from uuid import UUID
from zoneinfo import ZoneInfo

import laspy
import pytest
import yaml
from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.client.schemas.filters import (
    DeploymentFilter,
    DeploymentFilterId,
    FlowRunFilter,
    FlowRunFilterState,
    FlowRunFilterStateType,
    LogFilter,
    LogFilterFlowRunId,
)
from prefect.client.schemas.objects import FlowRun, StateType
from prefect.states import Scheduled

from roadscan.simulate import SimulatedSurvey
from tests.conftest import REPOSITORY
from tests.flows.prefect_server import PrefectApi, background

T = TypeVar("T")

POOL = "roadscan"
TILE = "69100_533500"
WAIT_S = 240.0


@pytest.fixture(scope="module")
def deployed(prefect_api: PrefectApi) -> PrefectApi:
    """The server with the work pool and the deployments, made by the commands of docs/deployment.md."""
    prefect_api.call("work-pool", "create", "--type", "process", POOL, cwd=REPOSITORY)
    prefect_api.call("deploy", "--all", "--prefect-file", "deploy/prefect.yaml", cwd=REPOSITORY)
    return prefect_api


@pytest.fixture(scope="module")
def client(prefect_api: PrefectApi) -> Iterator[SyncPrefectClient]:
    with get_client(sync_client=True) as opened:
        yield opened


@pytest.fixture
def worker(deployed: PrefectApi, survey_file: Path, tmp_path: Path) -> Iterator[None]:
    """A worker on the folder of surveys."""
    environment = deployed.environment | {
        "ROADSCAN_SURVEYS": str(survey_file.parent.parent),
        "PREFECT_WORKER_QUERY_SECONDS": "1",
    }
    command = deployed.command("worker", "start", "--pool", POOL, "--limit", "1", "--name", "tests")
    with background(command, environment, tmp_path, tmp_path / "worker.log"):
        yield


@pytest.mark.nightly
def test_the_schedule_plans_a_run_each_night(deployed: PrefectApi, client: SyncPrefectClient) -> None:
    nightly = client.read_deployment_by_name("survey/city")
    assert nightly.work_pool_name == POOL
    assert [schedule.active for schedule in nightly.schedules] == [True]
    nights = [run.expected_start_time.astimezone(ZoneInfo("Europe/Berlin")) for run in planned_runs(client)]
    assert {f"{night:%H:%M}" for night in nights} == {"01:00"}
    assert {(later.date() - earlier.date()).days for earlier, later in pairwise(nights)} == {1}
    assert client.read_deployment_by_name("reprocess/city").schedules == []


def test_nothing_is_fetched() -> None:
    steps = yaml.safe_load((REPOSITORY / "deploy" / "prefect.yaml").read_text())
    assert not steps["build"]
    assert not steps["push"]
    assert [list(step) for step in steps["pull"]] == [["prefect.deployments.steps.set_working_directory"]]


@pytest.mark.nightly
@pytest.mark.usefixtures("worker")
def test_a_worker_runs_the_deployments(
    deployed: PrefectApi, client: SyncPrefectClient, survey_file: Path, simulated: SimulatedSurvey
) -> None:
    store = survey_file.parent / "store" / "survey=city"

    # The night comes early for the first run that the schedule planned.
    tonight = planned_runs(client)[0]
    assert tonight.auto_scheduled
    client.set_flow_run_state(tonight.id, Scheduled(), force=True)
    run = ended(client, tonight.id, survey_file)
    assert run.state_type is StateType.COMPLETED, run.state
    clouds = sorted((store / "tiles" / "las").glob("*.laz"))
    assert sum(laspy.read(cloud).header.point_count for cloud in clouds) == simulated.readings
    assert (store / "products" / "hillshade" / "hillshade.png").is_file()
    log = eventually(lambda: log_of(client, run.id), "the log has no end")
    assert f"tiles: {len(clouds)} of {len(clouds)}" in log

    for damaged in (store / "tables" / "scans").rglob("*.parquet"):
        damaged.write_bytes(bytes(damaged.stat().st_size))
    run = asked_for(deployed, client, "reprocess/city", survey_file, "--param", f"tiles={json.dumps([TILE])}")
    assert run.state_type is StateType.FAILED
    assert run.state is not None
    assert f"tiles {TILE}: " in run.state.message
    assert "roadscan.core.errors" not in (survey_file.parent.parent / "worker.log").read_text()  # no traceback


def planned_runs(client: SyncPrefectClient) -> list[FlowRun]:
    """The coming runs that the server itself put on its list for the deployment's schedule, by time."""
    deployment = client.read_deployment_by_name("survey/city")
    due = FlowRunFilter(state=FlowRunFilterState(type=FlowRunFilterStateType(any_=[StateType.SCHEDULED])))
    own = DeploymentFilter(id=DeploymentFilterId(any_=[deployment.id]))
    runs = eventually(lambda: client.read_flow_runs(flow_run_filter=due, deployment_filter=own), "no run is planned")
    return sorted(runs, key=lambda run: run.expected_start_time)


def asked_for(
    api: PrefectApi, client: SyncPrefectClient, deployment: str, survey_file: Path, *arguments: str
) -> FlowRun:
    """Ask for a run of a deployment, and wait for its end."""
    said = api.call("deployment", "run", deployment, *arguments, cwd=survey_file.parent)
    found = re.search(r"UUID: ([0-9a-f-]{36})", said)
    assert found is not None, said
    return ended(client, UUID(found[1]), survey_file)


def ended(client: SyncPrefectClient, run_id: UUID, survey_file: Path) -> FlowRun:
    """A flow run when it has ended."""

    def final() -> FlowRun | None:
        run = client.read_flow_run(run_id)
        return run if run.state is not None and run.state.is_final() else None

    return eventually(final, "the run does not end", survey_file.parent.parent / "worker.log")


def log_of(client: SyncPrefectClient, run_id: UUID) -> list[str] | None:
    """Lines of a flow run's log, when all have reached the server: the flow's own last line, not that of a task."""
    own = LogFilter(flow_run_id=LogFilterFlowRunId(any_=[run_id]))
    lines = client.read_logs(own, limit=200)
    ended = any(line.task_run_id is None and line.message.startswith("Finished in state") for line in lines)
    return [line.message for line in lines] if ended else None


def eventually(look: Callable[[], T | None], complaint: str, log: Path | None = None) -> T:
    """What `look` sees as soon as it sees anything."""
    end = time.monotonic() + WAIT_S
    while time.monotonic() < end:
        if seen := look():
            return seen
        time.sleep(0.3)
    pytest.fail(f"{complaint} ({WAIT_S:g} s)" + (f":\n{log.read_text()}" if log is not None else ""))
