"""A folder of raw logs becomes a published survey, through a real Prefect server."""

from __future__ import annotations

import csv
import hashlib
import json
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import fsspec
import laspy
import pytest
from prefect import flow
from prefect.blocks.notifications import CustomWebhookNotificationBlock
from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterDeploymentId
from prefect.client.schemas.objects import FlowRun

from roadscan.core.errors import ConfigError, RoadscanError
from roadscan.flows.arrival import arrival, retried
from roadscan.flows.watch import watch
from roadscan.simulate import SimulatedSurvey
from roadscan.survey.arrival.template import FleetTemplate
from roadscan.survey.arrival.watched import Watched
from tests.conftest import REPOSITORY
from tests.flows.prefect_server import PrefectApi

FLEET = """
rig = "RIG.toml"
quiet_min = {quiet_min}

[queues]
"urgent-*" = "urgent"

[survey.map]
crs = "EPSG:32632"

[logs.sbet]
crs = "EPSG:4979"
clock = {{ system = "gps_week_seconds", week = "overlap" }}
"""
"""Answers all that `roadscan init` asks of the simulated logs; the week follows from the profilers' stamps."""


class Fleet:
    """A watched folder, a folder of surveys and a template."""

    def __init__(self, folder: Path, simulated: SimulatedSurvey) -> None:
        self.incoming, self.surveys, self.file = folder / "incoming", folder / "surveys", folder / "FLEET.toml"
        self.simulated = simulated
        self.incoming.mkdir()
        self.surveys.mkdir()
        shutil.copy(simulated.folder / "RIG.toml", folder)
        self.state(quiet_min=0)

    def state(self, quiet_min: float) -> None:
        self.file.write_text(FLEET.format(quiet_min=quiet_min))

    def upload(self, name: str) -> Path:
        return Path(shutil.copytree(self.simulated.folder / "raw", self.incoming / name))

    def watch(self) -> dict[str, list[str]]:
        found: dict[str, list[str]] = watch(str(self.incoming), str(self.file), str(self.surveys))
        return found

    def arrive(self, name: str, *after_s: float) -> None:
        arrival(str(self.incoming), str(self.file), name, str(self.surveys), workers=0, retry_after_s=after_s)


def write_manifest(folder: Path) -> Path:
    """List the files as an upload's last step does."""
    files = [file for file in sorted(folder.rglob("*")) if file.is_file()]
    with (folder / "MANIFEST.csv").open("w", newline="") as out:
        rows = csv.writer(out)
        rows.writerow(("name", "bytes", "sha256"))
        for file in files:
            content = file.read_bytes()
            rows.writerow((file.relative_to(folder).as_posix(), len(content), hashlib.sha256(content).hexdigest()))
    return folder / "MANIFEST.csv"


@pytest.fixture(scope="module")
def deployed(prefect_api: PrefectApi) -> PrefectApi:
    """The server with pools, queue and deployments, made by the commands of docs/arrival.md."""
    for command in (
        "work-pool create --type process roadscan --overwrite",
        "work-pool create --type process roadscan-watch",
        "work-queue create urgent --pool roadscan --priority 1",
        "deploy --all --prefect-file deploy/arrival.yaml",
    ):
        prefect_api.call(*command.split(), cwd=REPOSITORY)
    return prefect_api


@pytest.fixture
def client(deployed: PrefectApi) -> Iterator[SyncPrefectClient]:
    with get_client(sync_client=True) as opened:
        yield opened


@pytest.fixture
def fleet(deployed: PrefectApi, tmp_path: Path, simulated: SimulatedSurvey) -> Fleet:
    return Fleet(tmp_path, simulated)


def started(client: SyncPrefectClient, fleet: Fleet) -> list[FlowRun]:
    """Runs of the deployment for this test's folder, in any state."""
    deployment = client.read_deployment_by_name("arrival/fleet")
    own = FlowRunFilter(deployment_id=FlowRunFilterDeploymentId(any_=[deployment.id]))
    runs = client.read_flow_runs(flow_run_filter=own)
    return [run for run in runs if run.parameters["surveys"] == str(fleet.surveys)]


def test_a_quiet_folder_is_started_once(fleet: Fleet, client: SyncPrefectClient) -> None:
    fleet.upload("drive-1")
    fleet.upload("urgent-2")
    assert fleet.watch() == {"started": ["drive-1", "urgent-2"], "refused": [], "changed": []}
    assert fleet.watch() == {"started": [], "refused": [], "changed": []}
    for record in (fleet.surveys / ".arrivals").iterdir():
        record.unlink()
    fleet.watch()  # the server remembers as well
    runs = {run.name: run for run in started(client, fleet)}
    assert len(started(client, fleet)) == 2
    assert (runs["drive-1"].work_queue_name, runs["urgent-2"].work_queue_name) == ("default", "urgent")
    urgent, usual = (client.read_work_queue_by_name(name, work_pool_name="roadscan") for name in ("urgent", "default"))
    assert urgent.priority is not None
    assert usual.priority is not None
    assert urgent.priority < usual.priority  # 1 comes first


def test_an_upload_that_goes_on_is_waited_for(fleet: Fleet) -> None:
    fleet.state(quiet_min=0.05)
    folder = fleet.upload("drive-1")
    for more in range(3):
        (folder / "late.bin").write_bytes(bytes(more))
        assert fleet.watch()["started"] == []
        time.sleep(1.6)
    time.sleep(1.6)
    assert fleet.watch()["started"] == ["drive-1"]
    (folder / "late.bin").write_bytes(bytes(99))
    assert fleet.watch() == {"started": [], "refused": [], "changed": ["drive-1"]}
    assert fleet.watch()["changed"] == []


def test_a_manifest_tells_completeness(fleet: Fleet) -> None:
    fleet.state(quiet_min=60)
    folder = fleet.upload("drive-1")
    write_manifest(folder)
    late = folder / "run-1" / "trajectory.sbet"
    content = late.read_bytes()
    late.write_bytes(content[:1000])
    assert fleet.watch()["started"] == []
    fleet.state(quiet_min=0)
    assert fleet.watch()["refused"] == ["drive-1"]
    reason = json.loads((fleet.surveys / ".arrivals" / "drive-1.json").read_text())["reason"]
    assert reason == f"incomplete by MANIFEST.csv: run-1/trajectory.sbet (1,000 of {len(content):,} bytes)"
    assert fleet.watch()["refused"] == []  # named once
    fleet.state(quiet_min=60)
    late.write_bytes(content)
    assert fleet.watch()["started"] == ["drive-1"]  # at once: the manifest says that all is there


def test_a_folder_without_logs_is_refused(fleet: Fleet, client: SyncPrefectClient) -> None:
    (fleet.incoming / "photos").mkdir()
    (fleet.incoming / "photos" / "notes.txt").write_text("nothing of a road")
    (fleet.incoming / "a name").mkdir()
    shutil.copytree(fleet.simulated.folder / "raw", fleet.incoming / "a name", dirs_exist_ok=True)
    assert fleet.watch() == {"started": [], "refused": ["a name", "photos"], "changed": []}
    assert started(client, fleet) == []
    assert fleet.watch()["refused"] == []


def test_from_raw_logs_to_a_page(fleet: Fleet) -> None:
    write_manifest(fleet.upload("drive-1"))
    fleet.arrive("drive-1")
    home = fleet.surveys / "drive-1"
    clouds = (home / "store" / "survey=drive-1" / "tiles" / "las").glob("*.laz")
    assert sum(laspy.read(cloud).header.point_count for cloud in clouds) == fleet.simulated.readings
    assert json.loads((home / "site" / "survey.json").read_text())["id"] == "drive-1"
    assert (home / "inventory.gpkg").is_file()


def test_what_the_template_leaves_open_is_named(fleet: Fleet) -> None:
    fleet.upload("drive-1")
    fleet.file.write_text(fleet.file.read_text().replace('crs = "EPSG:4979"', ""))
    fleet.watch()
    with pytest.raises(RoadscanError, match=r"leaves open: crs of run-1/trajectory.sbet \(sbet\)"):
        fleet.arrive("drive-1", 0.1)
    assert not (fleet.surveys / "drive-1" / "SURVEY.toml").exists()
    assert json.loads((fleet.surveys / ".arrivals" / "drive-1.json").read_text())["state"] == "refused"
    assert fleet.watch() == {"started": [], "refused": [], "changed": []}


def test_a_flipped_bit_is_refused(fleet: Fleet) -> None:
    folder = fleet.upload("drive-1")
    write_manifest(folder)
    log = folder / "run-1" / "profiler_left.parquet"
    log.write_bytes(bytes([log.read_bytes()[0] ^ 1]) + log.read_bytes()[1:])
    with pytest.raises(RoadscanError, match=r"profiler_left.parquet: not the content of MANIFEST.csv"):
        fleet.arrive("drive-1")


def test_a_bucket_that_does_not_answer_is_tried_again(
    fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server is not there when the flow begins; the raw logs are copied as soon as it answers."""
    moto = pytest.importorskip("moto.server")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    for key, value in {
        "FSSPEC_S3_ENDPOINT_URL": f"http://127.0.0.1:{port}", "AWS_ACCESS_KEY_ID": "x", "AWS_SECRET_ACCESS_KEY": "x",
        "AWS_DEFAULT_REGION": "us-east-1", "AWS_MAX_ATTEMPTS": "1",
    }.items():  # fmt: skip
        monkeypatch.setenv(key, value)
    monkeypatch.setitem(fsspec.config.conf, "s3", {"endpoint_url": f"http://127.0.0.1:{port}"})
    write_manifest(fleet.upload("drive-1"))
    place, homes = Watched("s3://roads/incoming", fleet.surveys), tmp_path / "surveys" / "drive-1"
    template = FleetTemplate.load(fleet.file)

    tries: list[str] = []

    @flow(name="try a bucket", persist_result=False)
    def fetched() -> Path:
        def once() -> Path:
            tries.append("")
            return place.fetch("drive-1", template, homes)

        return retried("fetch", once, (1.0,) * 5)

    before, server = (moto.ThreadedMotoServer(ip_address="127.0.0.1", port=port) for _ in range(2))
    before.start()
    fs = fsspec.filesystem("s3", skip_instance_cache=True)
    fs.mkdir("roads")
    fs.put(str(fleet.incoming), "roads/incoming", recursive=True)
    before.stop()  # what the bucket holds stays in this process

    def begin() -> None:
        while not tries:
            time.sleep(0.05)
        time.sleep(1.0)
        server.start()

    helper = threading.Thread(target=begin)
    helper.start()
    try:
        logs = fetched()
    finally:
        helper.join()
        server.stop()
    assert len(tries) >= 2
    for raw in (fleet.incoming / "drive-1").rglob("*.*"):
        assert (logs / raw.relative_to(fleet.incoming / "drive-1")).read_bytes() == raw.read_bytes()


def test_a_wrong_setting_is_not_tried_again(fleet: Fleet) -> None:
    tries: list[str] = []

    @flow(name="try a setting", persist_result=False)
    def loaded() -> object:
        def once() -> object:
            tries.append("")
            return FleetTemplate.load(fleet.file)

        return retried("load", once, (1.0,) * 5)

    fleet.file.write_text("rigg = 1")
    with pytest.raises(ConfigError, match="rigg"):
        loaded()
    assert len(tries) == 1


class Mailbox:
    """A web server that keeps what is posted to it."""

    def __init__(self) -> None:
        self.letters: list[dict[str, Any]] = []
        letters = self.letters

        class Door(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                letters.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
                self.send_response(200)
                self.end_headers()

            def log_message(self, *_: object) -> None:
                """Say nothing."""

        self.server = HTTPServer(("127.0.0.1", 0), Door)
        self.url = f"http://127.0.0.1:{self.server.server_port}/"


@pytest.fixture
def mailbox() -> Iterator[Mailbox]:
    box = Mailbox()
    thread = threading.Thread(target=box.server.serve_forever)
    thread.start()
    yield box
    box.server.shutdown()
    thread.join()
    box.server.server_close()


def test_a_refused_folder_is_told_by_message(fleet: Fleet, deployed: PrefectApi, mailbox: Mailbox) -> None:
    block = CustomWebhookNotificationBlock(
        name="roadscan", url=mailbox.url, json_data={"subject": "{{subject}}", "body": "{{body}}"}
    )
    block.save("roadscan", overwrite=True)
    command = [sys.executable, "-m", "roadscan.flows.automations", "deploy/automations.yaml"]
    command += ["--notify", "custom-webhook/roadscan"]
    for _ in range(2):  # once more changes nothing
        said = subprocess.run(command, cwd=REPOSITORY, env=deployed.environment, check=True, capture_output=True)
        assert said.stdout.count(b"installed: ") == 4
    assert deployed.call("automation", "ls", cwd=REPOSITORY).count("roadscan zombies end") == 1
    (fleet.incoming / "photos").mkdir()
    fleet.watch()
    end = time.monotonic() + 30.0
    while not mailbox.letters and time.monotonic() < end:
        time.sleep(0.1)
    assert mailbox.letters == [{"subject": "roadscan: photos: roadscan.survey.refused", "body": "it holds no file"}]
