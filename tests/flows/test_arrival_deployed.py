"""Surveys that arrive, by the commands of docs/arrival.md: a Prefect server, its automations, and workers that die."""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TypeVar

import fsspec
import laspy
import psutil
import pytest
from prefect.blocks.notifications import CustomWebhookNotificationBlock
from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.client.schemas.filters import (
    FlowFilter,
    FlowFilterName,
    FlowRunFilter,
    FlowRunFilterParentFlowRunId,
)
from prefect.client.schemas.objects import FlowRun, StateType
from prefect.states import Scheduled

from roadscan.core.survey import Survey
from roadscan.simulate import SimulatedSurvey
from roadscan.store.store import Store
from tests.conftest import REPOSITORY
from tests.flows.arriving import Fleet, Mailbox, manifest_of, open_mailbox
from tests.flows.prefect_server import PrefectApi, background
from tests.object_store import ObjectStore, served

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(1200)]

T = TypeVar("T")

WAIT_S = 300.0
"""Longest wait for what a worker does: a look each minute, and a run."""
ZOMBIE_S = 300.0
"""Longest wait for the end of a dead run, which is due 100 s after its last heartbeat."""


@pytest.fixture(scope="module")
def deployed(prefect_api: PrefectApi) -> Iterator[PrefectApi]:
    """The server with pools, queue and deployments, made by the commands of docs/arrival.md."""
    for command in (
        "work-pool create --type process roadscan --overwrite",
        "work-pool create --type process roadscan-watch",
        "work-queue create urgent --pool roadscan --priority 1",
        "deploy --all --prefect-file deploy/arrival.yaml",
    ):
        prefect_api.call(*command.split(), cwd=REPOSITORY)
    yield prefect_api
    prefect_api.call("work-pool", "delete", "roadscan", cwd=REPOSITORY)  # other tests make it anew


@pytest.fixture(scope="module")
def client(deployed: PrefectApi) -> Iterator[SyncPrefectClient]:
    with get_client(sync_client=True) as opened:
        yield opened


@pytest.fixture(scope="module")
def mailbox(deployed: PrefectApi) -> Iterator[Mailbox]:
    """Gets the messages of deploy/automations.yaml."""
    with open_mailbox() as box:
        block = CustomWebhookNotificationBlock(
            name="roadscan", url=box.url, json_data={"subject": "{{subject}}", "body": "{{body}}"}
        )
        block.save("roadscan", overwrite=True)
        command = [sys.executable, "-m", "roadscan.flows.automations", "deploy/automations.yaml"]
        command += ["--notify", "custom-webhook/roadscan"]
        for _ in range(2):  # once more changes nothing
            said = subprocess.run(command, cwd=REPOSITORY, env=deployed.environment, check=True, capture_output=True)
            assert said.stdout.count(b"installed: ") == 9
        assert deployed.call("automation", "ls", cwd=REPOSITORY).count("roadscan zombies end") == 1
        yield box


class Service:
    """The workers of docs/arrival.md on a folder of surveys, as deploy/arrival.yaml names it."""

    def __init__(self, api: PrefectApi, client: SyncPrefectClient, fleet: Fleet, environment: dict[str, str]) -> None:
        self.api, self.client, self.fleet, self.home = api, client, fleet, fleet.surveys
        self._environment = api.environment | environment | {
            "ROADSCAN_SURVEYS": str(self.home),
            "PREFECT_FLOWS_HEARTBEAT_FREQUENCY": "30",
            "PREFECT_WORKER_QUERY_SECONDS": "1",
        }  # fmt: skip

    @contextlib.contextmanager
    def worker(self, pool: str, limit: int = 1) -> Iterator[psutil.Process]:
        command = self.api.command("worker", "start", "--pool", pool, "--limit", str(limit))
        with background(command, self._environment, self.home, self.home / f"{pool}.log") as process:
            yield psutil.Process(process.pid)

    def eventually(self, look: Callable[[], T | None], complaint: str, most_s: float = WAIT_S) -> T:
        """What `look` sees as soon as it sees anything."""
        end = time.monotonic() + most_s
        while time.monotonic() < end:
            if seen := look():
                return seen
            time.sleep(0.3)
        logs = "\n".join(f"{log.name}:\n{log.read_text()[-6000:]}" for log in self.home.glob("*.log"))
        pytest.fail(f"{complaint} ({most_s:g} s):\n{logs}")

    def run_of(self, name: str) -> FlowRun | None:
        """The run of `arrival` for a folder, where one was started."""
        found = self.client.read_flow_runs(flow_filter=FlowFilter(name=FlowFilterName(any_=["arrival"])))
        mine = [run for run in found if run.name == name]
        assert len(mine) <= 1
        return mine[0] if mine else None

    def reached(self, name: str, state: StateType, most_s: float = WAIT_S) -> FlowRun:
        """The run of a folder in a state."""

        def there() -> FlowRun | None:
            run = self.run_of(name)
            return run if run is not None and run.state_type is state else None

        return self.eventually(there, f"{name} is not {state}", most_s)

    def crashed(self, name: str) -> list[str]:
        """Messages of the states in which the run of a folder crashed; a look resumes it at any moment."""
        run = self.run_of(name)
        states = [] if run is None else self.client.read_flow_run_states(run.id)
        return [state.message or "" for state in states if state.type is StateType.CRASHED]

    def stage_ended(self, name: str, stage: str) -> None:
        """Wait until the run of a folder has ended a stage."""

        def there() -> bool:
            run = self.run_of(name)
            if run is None:
                return False
            below = FlowRunFilter(parent_flow_run_id=FlowRunFilterParentFlowRunId(any_=[run.id]))
            tasks = self.client.read_task_runs(flow_run_filter=below)
            return any(task.name == stage and task.state_type is StateType.COMPLETED for task in tasks)

        self.eventually(there, f"{name} does not end {stage}")

    def store(self, name: str) -> Store:
        survey = Survey.load(self.home / name / "SURVEY.toml")
        return Store(survey.store_url, survey.config.id)

    def files(self, name: str) -> dict[str, tuple[int, int]]:
        """Which file each of the store's tables, tiles and products is."""
        root = Path(self.store(name).root)
        found = (p for part in ("tables", "tiles", "products") for p in (root / part).rglob("*") if p.is_file())
        return {p.relative_to(root).as_posix(): (p.stat().st_ino, p.stat().st_mtime_ns) for p in found}

    def check_published(self, name: str) -> None:
        """The page, and every reading that the simulator wrote."""
        clouds = (self.home / name / "store" / f"survey={name}" / "tiles" / "las").glob("*.laz")
        assert sum(laspy.read(cloud).header.point_count for cloud in clouds) == self.fleet.simulated.readings
        assert (self.home / name / "site" / "survey.json").is_file()
        assert (self.home / name / "inventory.gpkg").is_file()


@pytest.fixture(scope="module")
def objects() -> Iterator[ObjectStore]:
    with served() as store:
        yield store


@pytest.fixture(scope="module")
def service(
    deployed: PrefectApi, client: SyncPrefectClient, tmp_path_factory: pytest.TempPathFactory, objects: ObjectStore,
    simulated: SimulatedSurvey,
) -> Iterator[Service]:  # fmt: skip
    """With a worker that looks each minute, and none yet for runs."""
    fleet = Fleet(tmp_path_factory.mktemp("service"), simulated, together=True)
    fleet.state(quiet_min=0.3)
    found = Service(deployed, client, fleet, objects.environment)
    with found.worker("roadscan-watch"):
        yield found
    kill([one for one in psutil.process_iter() if surveys_of(one) == str(found.home)])


def surveys_of(process: psutil.Process) -> str | None:
    """The folder of surveys of which a process knows by its environment."""
    with contextlib.suppress(psutil.Error):
        return process.environ().get("ROADSCAN_SURVEYS")
    return None


def kill(processes: list[psutil.Process]) -> None:
    for one in processes:
        with contextlib.suppress(psutil.NoSuchProcess):
            one.kill()
    psutil.wait_procs(processes, timeout=10.0)
    for one in processes:
        assert not one.is_running() or one.status() == psutil.STATUS_ZOMBIE


@pytest.mark.usefixtures("mailbox")
def test_looks_that_nobody_took_are_dropped(client: SyncPrefectClient) -> None:
    """Else those of a night without a worker would all be done one after another."""
    missed = client.create_flow_run_from_deployment(
        client.read_deployment_by_name("watch/fleet").id,
        state=Scheduled(scheduled_time=datetime.now(UTC) - timedelta(hours=1)),
    )
    end = time.monotonic() + WAIT_S
    while client.read_flow_run(missed.id).state_type is not StateType.CANCELLED:
        assert time.monotonic() < end
        time.sleep(0.3)


def test_surveys_that_arrive_file_by_file(service: Service, mailbox: Mailbox) -> None:
    """Two that are quiet and one with a manifest; none is run before all is there; the urgent one begins at once."""
    fleet = service.fleet
    (fleet.incoming / "photos").mkdir()
    *first, last = sorted(fleet.raw.rglob("*.*"))

    def put(name: str, file: Path) -> None:
        copy = fleet.incoming / name / file.relative_to(fleet.raw)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, copy)

    (fleet.incoming / "urgent-3").mkdir()
    (fleet.incoming / "urgent-3" / "MANIFEST.csv").write_bytes(manifest_of(fleet.raw))
    names = ("drive-1", "drive-2", "urgent-3")
    for file in first:
        for name in names:
            put(name, file)
        time.sleep(1.0)
    for name in names:
        service.eventually(lambda name=name: fleet.knows(name), f"{name} is not seen")
    assert service.run_of("urgent-3") is None
    for name in names:
        put(name, last)
    for name in names:
        service.reached(name, StateType.SCHEDULED)
    with service.worker("roadscan", limit=2):
        runs = {name: service.reached(name, StateType.COMPLETED) for name in names}
        for name in names:
            service.check_published(name)
            service.eventually(lambda name=name: mailbox.about(f"{name} is published"), f"no message of {name}")
    starts = sorted((run.start_time, name) for name, run in runs.items() if run.start_time is not None)
    ends = sorted(run.end_time for run in runs.values() if run.end_time is not None)
    assert runs["urgent-3"].work_queue_name == "urgent"
    assert "urgent-3" in {name for _, name in starts[:2]}
    assert starts[1][0] < ends[0] < starts[2][0]  # two at once, and the third when one has ended
    (letter,) = mailbox.about("photos")
    assert letter == {"subject": "roadscan: photos: roadscan.survey.refused", "body": "it holds no file"}


def test_a_survey_arrives_in_a_bucket(service: Service, objects: ObjectStore) -> None:
    fs = fsspec.filesystem("s3", skip_instance_cache=True)
    watched = f"{objects.url}/incoming"
    *first, last = sorted(service.fleet.raw.rglob("*.*"))
    key = f"{watched}/bucket-1/{{}}"
    fs.pipe_file(key.format("MANIFEST.csv"), manifest_of(service.fleet.raw))
    for file in first:
        fs.put_file(str(file), key.format(file.relative_to(service.fleet.raw).as_posix()))
    look = ("deployment", "run", "watch/fleet", "--param", f'watched="{watched}"', "--watch")
    service.api.call(*look, cwd=service.home)
    assert service.fleet.record("bucket-1")["state"] == "coming"
    fs.put_file(str(last), key.format(last.relative_to(service.fleet.raw).as_posix()))
    service.api.call(*look, cwd=service.home)
    with service.worker("roadscan"):
        service.reached("bucket-1", StateType.COMPLETED)
    service.check_published("bucket-1")


def test_a_run_is_cancelled_and_resumed(service: Service) -> None:
    service.fleet.upload("cancelled-1")
    with service.worker("roadscan") as worker:
        service.stage_ended("cancelled-1", "ingest")
        run = service.run_of("cancelled-1")
        assert run is not None
        service.api.call("flow-run", "cancel", str(run.id), cwd=service.home)
        service.reached("cancelled-1", StateType.CANCELLED)
        service.eventually(lambda: not worker.children(recursive=True), "processes of the run are left")
        service.store("cancelled-1").check_free()
        before = service.files("cancelled-1")
        assert any(name.startswith("tables/scans") for name in before)
        assert not (service.home / "cancelled-1" / "site").exists()
        service.api.call("flow-run", "retry", str(run.id), cwd=service.home)
        run = service.reached("cancelled-1", StateType.COMPLETED)
    assert run.run_count == 2
    after = service.files("cancelled-1")
    assert {name: after.get(name) for name in before} == before
    service.check_published("cancelled-1")


def test_a_zombie_ends_and_is_resumed(service: Service, mailbox: Mailbox) -> None:
    """The worker is killed; its run, and the run's processes, end with it."""
    service.fleet.upload("zombie-1")
    with service.worker("roadscan") as worker:
        service.stage_ended("zombie-1", "ingest")
        family = worker.children(recursive=True)
        assert family
        worker.kill()
        assert psutil.wait_procs(family, timeout=30.0)[1] == []
    before = service.files("zombie-1")
    assert service.reached("zombie-1", StateType.RUNNING).run_count == 1
    service.eventually(lambda: service.crashed("zombie-1"), "the dead run does not end", ZOMBIE_S)
    assert service.crashed("zombie-1") == ["No heartbeat for 100 s, so its process is dead."]
    service.eventually(lambda: mailbox.about("zombie-1 crashed"), "no message of the crash")
    with service.worker("roadscan"):
        run = service.reached("zombie-1", StateType.COMPLETED)
    assert run.run_count == 2
    after = service.files("zombie-1")
    assert {name: after.get(name) for name in before} == before
    service.check_published("zombie-1")
    service.eventually(lambda: mailbox.about("zombie-1 is published"), "no message of the end")
