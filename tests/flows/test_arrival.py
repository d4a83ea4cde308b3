"""A folder of raw logs becomes a published survey: each step in this process, beside a real Prefect server.

`test_arrival_deployed.py` has the same done by workers.
"""

from __future__ import annotations

import json
import shutil
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import fsspec
import laspy
import pytest
from prefect import flow
from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.client.schemas.actions import WorkPoolCreate
from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterDeploymentId
from prefect.client.schemas.objects import FlowRun

from roadscan.core.errors import ConfigError, RoadscanError, StoreError
from roadscan.core.survey import Survey
from roadscan.flows.arrival import arrival, retried
from roadscan.simulate import SimulatedSurvey
from roadscan.store.store import Store
from roadscan.survey.arrival.watched import FleetTemplate, Watched
from tests.flows.arriving import Fleet, manifest_of
from tests.flows.prefect_server import PrefectApi
from tests.object_store import served

pytestmark = pytest.mark.slow

LATE = "run-1/trajectory.sbet"
"""The log that is uploaded last."""


@pytest.fixture
def fleet(tmp_path: Path, simulated: SimulatedSurvey) -> Fleet:
    return Fleet(tmp_path, simulated)


# --- complete, by a manifest or by quiet -------------------------------------------------------------


class Place:
    """A watched folder or bucket, looked at a given time (minutes after the first)."""

    def __init__(self, fleet: Fleet, url: str) -> None:
        self.watched, self.url, self.fleet = Watched(url, fleet.surveys), url, fleet
        self.fs = fsspec.filesystem(url.partition("://")[0] if "://" in url else "file", skip_instance_cache=True)

    def put(self, file: str, content: bytes) -> None:
        self.fs.pipe_file(f"{self.url}/drive-1/{file}", content) if "://" in self.url else self._put(file, content)

    def _put(self, file: str, content: bytes) -> None:
        path = Path(self.url) / "drive-1" / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)

    def look(self, minute: float, name: str = "drive-1") -> tuple[str, str, bool]:
        """State, reason, and whether it is new."""
        template = FleetTemplate.load(self.fleet.file)
        record, is_new = self.watched.look(name, template, 1.7e9 + 60.0 * minute)
        self.watched.keep(name, record)
        return record.state, record.reason, is_new


@pytest.fixture(params=["folder", "bucket"])
def place(fleet: Fleet, request: pytest.FixtureRequest) -> Iterator[Place]:
    fleet.state(quiet_min=10)
    if request.param == "folder":
        yield Place(fleet, str(fleet.incoming))
        return
    pytest.importorskip("moto.server")
    with served() as objects:
        yield Place(fleet, f"{objects.url}/incoming")


def test_a_place_that_is_quiet_is_complete(place: Place, fleet: Fleet) -> None:
    assert place.watched.names() == []
    files = {file.relative_to(fleet.raw).as_posix(): file for file in sorted(fleet.raw.rglob("*.*"))}
    for minute, (file, source) in enumerate(files.items()):
        place.put(file, source.read_bytes())
        assert place.watched.names() == ["drive-1"]
        assert place.look(9.0 * minute)[0] == "coming"
    last = 9.0 * (len(files) - 1)
    assert place.look(last + 9.9) == ("coming", "", False)
    place.put(LATE, files[LATE].read_bytes()[:-1])  # the same names
    assert place.look(last + 10.1)[0] == "coming"
    place.put(LATE, files[LATE].read_bytes()[:-1] + b"x")  # the same names and sizes
    assert place.look(last + 20.2)[0] == "coming"
    assert place.look(last + 30.2) == ("started", "", True)
    assert place.look(last + 40.2) == ("started", "", False)
    place.put("more.las", b"")
    assert place.look(last + 41.0) == (
        "started", "its files changed after it had arrived; they are not looked at again", True
    )  # fmt: skip
    assert not place.look(last + 60.0)[2]


def test_a_manifest_tells_completeness(place: Place, fleet: Fleet) -> None:
    place.put("MANIFEST.csv", manifest_of(fleet.raw))
    for file in sorted(fleet.raw.rglob("*.*")):
        if (name := file.relative_to(fleet.raw).as_posix()) != LATE:
            place.put(name, file.read_bytes())
    assert place.look(0.0)[0] == "coming"
    content = (fleet.raw / LATE).read_bytes()
    place.put(LATE, content[:1000])
    assert place.look(1.0)[0] == "coming"
    state, reason, _ = place.look(11.0)
    assert (state, reason) == ("refused", f"incomplete by MANIFEST.csv: {LATE} (1,000 of {len(content):,} bytes)")
    assert not place.look(30.0)[2]  # named once
    place.put(LATE, content)
    assert place.look(31.0) == ("started", "", True)  # at once: the manifest says that all is there
    logs = place.watched.fetch("drive-1", FleetTemplate.load(fleet.file), fleet.surveys / "drive-1")
    assert (logs / LATE).read_bytes() == content


def test_a_bucket_that_is_not_there_is_named(place: Place, fleet: Fleet) -> None:
    wrong = "s3://road" if "://" in place.url else str(fleet.incoming / "road")
    with pytest.raises(StoreError, match=r"the watched folder \S*road cannot be read"):
        Watched(wrong, fleet.surveys).names()


def test_a_folder_without_logs_is_refused(fleet: Fleet) -> None:
    place = Place(fleet, str(fleet.incoming))
    (fleet.incoming / "photos").mkdir()
    assert place.look(0.0, "photos") == ("refused", "it holds no file", True)
    (fleet.incoming / "photos" / "notes.txt").write_text("nothing of a road")
    assert place.look(1.0, "photos") == ("refused", "no log of a format that `roadscan formats` lists", True)
    fleet.upload("a name")
    assert place.look(0.0, "a name")[1].startswith("its name cannot be a survey's id")


# --- started, and resumed ----------------------------------------------------------------------------


@pytest.fixture
def client(prefect_api: PrefectApi) -> Iterator[SyncPrefectClient]:
    """Of a server that has the deployment, as `prefect deploy` makes it in `test_arrival_deployed.py`."""
    with get_client(sync_client=True) as opened:
        if not any(pool.name == "roadscan" for pool in opened.read_work_pools()):
            opened.create_work_pool(WorkPoolCreate(name="roadscan", type="process"))
        if not any(queue.name == "urgent" for queue in opened.read_work_queues(work_pool_name="roadscan")):
            opened.create_work_queue("urgent", priority=1, work_pool_name="roadscan")
        flow_id = opened.create_flow(arrival)
        opened.create_deployment(
            flow_id, "fleet", work_pool_name="roadscan", entrypoint="roadscan.flows.arrival.arrival"
        )
        yield opened


def runs(client: SyncPrefectClient, fleet: Fleet) -> dict[str, FlowRun]:
    """Runs of the deployment for this test's folder, in any state."""
    deployment = client.read_deployment_by_name("arrival/fleet")
    of_deployment = FlowRunFilter(deployment_id=FlowRunFilterDeploymentId(any_=[deployment.id]))
    found = client.read_flow_runs(flow_run_filter=of_deployment)
    mine = [run for run in found if run.parameters["surveys"] == str(fleet.surveys)]
    assert len({run.name for run in mine}) == len(mine)
    return {run.name: run for run in mine}


def test_a_complete_folder_is_started_once(fleet: Fleet, client: SyncPrefectClient) -> None:
    fleet.upload("drive-1")
    fleet.upload("urgent-2")
    (fleet.incoming / "photos").mkdir()
    assert fleet.watch() == {"started": ["drive-1", "urgent-2"], "refused": ["photos"]}
    assert fleet.watch() == {}
    shutil.rmtree(fleet.surveys / ".arrivals")
    fleet.watch()  # the server remembers as well
    assert {name: run.work_queue_name for name, run in runs(client, fleet).items()} == {
        "drive-1": "default", "urgent-2": "urgent"
    }  # fmt: skip


# --- from raw logs to a page --------------------------------------------------------------------------


@pytest.mark.usefixtures("prefect_api")
def test_from_raw_logs_to_a_page(fleet: Fleet) -> None:
    (fleet.upload("drive-1") / "MANIFEST.csv").write_bytes(manifest_of(fleet.raw))
    fleet.arrive("drive-1")
    home = fleet.surveys / "drive-1"
    clouds = (home / "store" / "survey=drive-1" / "tiles" / "las").glob("*.laz")
    assert sum(laspy.read(cloud).header.point_count for cloud in clouds) == fleet.simulated.readings
    assert json.loads((home / "site" / "survey.json").read_text())["id"] == "drive-1"
    assert (home / "inventory.gpkg").is_file()


@pytest.mark.usefixtures("client")
def test_what_the_template_leaves_open_is_named(fleet: Fleet) -> None:
    fleet.upload("drive-1")
    fleet.file.write_text(fleet.file.read_text().replace('crs = "EPSG:4979"', ""))
    fleet.watch()
    with pytest.raises(RoadscanError, match=r"leaves open: crs of run-1/trajectory.sbet \(sbet\)"):
        fleet.arrive("drive-1", 0.1)
    assert not (fleet.surveys / "drive-1" / "SURVEY.toml").exists()
    assert fleet.record("drive-1")["state"] == "refused"
    assert fleet.watch() == {}


@pytest.mark.usefixtures("prefect_api")
def test_a_flipped_bit_is_refused(fleet: Fleet) -> None:
    folder = fleet.upload("drive-1")
    (folder / "MANIFEST.csv").write_bytes(manifest_of(fleet.raw))
    log = folder / "run-1" / "profiler_left.parquet"
    log.write_bytes(bytes([log.read_bytes()[0] ^ 1]) + log.read_bytes()[1:])
    with pytest.raises(RoadscanError, match=r"profiler_left.parquet: not the content of MANIFEST.csv"):
        fleet.arrive("drive-1")


# --- what is tried again ------------------------------------------------------------------------------


def tried(work: Callable[[], Any], times: int, between: Callable[[int], None] = lambda _: None) -> int:
    """Do work as a step of the flow; return how often it was tried. `between` is called before each."""
    tries = []

    @flow(name="try", persist_result=False)
    def once() -> None:
        def step() -> None:
            tries.append("")
            between(len(tries))
            work()

        retried("step", step, (0.2,) * (times - 1))

    try:
        once()
    except RoadscanError as error:
        raise TriedError(len(tries)) from error
    return len(tries)


class TriedError(Exception):
    """The last try failed as well."""


def test_a_bucket_that_does_not_answer_is_tried_again(
    fleet: Fleet, prefect_api: PrefectApi, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing listens at the server's port when the step begins; the raw logs are copied as soon as it does."""
    pytest.importorskip("moto.server")
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    with served() as objects, socket.socket() as probe:
        fs = fsspec.filesystem("s3", skip_instance_cache=True)
        fs.put(str(fleet.upload("drive-1").parent), "roads/incoming", recursive=True)
        probe.bind(("127.0.0.1", 0))
        silent = f"http://127.0.0.1:{probe.getsockname()[1]}"

        def fetched() -> None:
            Watched(f"{objects.url}/incoming", fleet.surveys).fetch(
                "drive-1", FleetTemplate.load(fleet.file), fleet.surveys / "drive-1"
            )

        def answer(tries: int) -> None:
            fsspec.config.conf["s3"] = {"endpoint_url": silent if tries < 3 else objects.endpoint}

        assert tried(fetched, 5, answer) == 3
    (copy,) = (fleet.surveys / "drive-1").glob("raw-*")
    for raw in fleet.raw.rglob("*.*"):
        assert (copy / raw.relative_to(fleet.raw)).read_bytes() == raw.read_bytes()


def test_a_store_that_another_run_has_is_tried_again(survey_file: Path, prefect_api: PrefectApi) -> None:
    """The other is a process of this machine that lives; it ends before the third try."""
    survey = Survey.load(survey_file)
    other = Store(survey.store_url, survey.config.id).lock()

    def check() -> None:
        with Store(survey.store_url, survey.config.id).lock():
            pass

    other.__enter__()
    assert tried(check, 5, lambda tries: other.__exit__(None, None, None) if tries == 3 else None) == 3


def test_what_stays_wrong_is_not_tried_again(fleet: Fleet, survey_file: Path, prefect_api: PrefectApi) -> None:
    survey = Survey.load(survey_file)
    store = Store(survey.store_url, survey.config.id)
    store.write_bytes("manifest/version.json", b'{"roadscan": "99.0.0"}')
    fleet.file.write_text("rigg = 1")
    damaged = "tables/x.parquet"
    store.write_bytes(damaged, b"PAR1 and no more")

    def newer() -> None:
        with store.lock():
            pass

    for work in (lambda: FleetTemplate.load(fleet.file), newer, lambda: store.read_table(damaged)):
        with pytest.raises(TriedError) as told:
            tried(work, 3)
        assert told.value.args == (1,)
        assert isinstance(told.value.__cause__, ConfigError | StoreError)
