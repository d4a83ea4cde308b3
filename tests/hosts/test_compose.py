"""deploy/compose.yaml and deploy/kubernetes: their form; and the services of the first, run on hosts of their own."""

from __future__ import annotations

import http.server
import json
import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from uuid import UUID

import compose_spec
import fsspec
import kubernetes_validate
import psutil
import pytest
import yaml
from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.client.schemas.objects import State, StateType
from prefect.settings import PREFECT_API_AUTH_STRING, PREFECT_API_URL, temporary_settings

from roadscan.core.survey import Survey
from roadscan.store.store import Store
from tests.conftest import REPOSITORY
from tests.flows.test_deployment import planned_runs
from tests.hosts.composed import Composed, eventually, interpolated
from tests.hosts.conftest import assert_same, contents
from tests.hosts.host import NETWORK, Running, network
from tests.inventory.postgres import WANTED, programs
from tests.serving import serving
from tests.surveys import Simulated

SETTINGS = {
    "ROADSCAN_PREFECT_AUTH": "roadscan:of-the-tests",
    "ROADSCAN_S3_KEY": "tests",
    "ROADSCAN_S3_SECRET": "tests",
    "ROADSCAN_POSTGRES_PASSWORD": "tests",
}
OF_OTHERS = {
    "store": ["python", "-m", "moto.server", "-H", "0.0.0.0", "-p", "7070"],
    "postgis": [
        "sh",
        "-euc",
        """umask 077
        echo "$POSTGRES_PASSWORD" > /tmp/password
        cd /var/lib/postgresql/data
        initdb -D . -U "$POSTGRES_USER" --auth=scram-sha-256 --pwfile=/tmp/password -E UTF8
        echo host all all all scram-sha-256 >> pg_hba.conf
        echo "CREATE DATABASE $POSTGRES_DB; " | postgres --single -D . postgres
        exec postgres -D . -c listen_addresses=* -c unix_socket_directories=
        """,
    ],
}
"""What stands here for the images of others: moto's server, and Debian's PostgreSQL begun as that image begins it."""
SET_UP_S = 120.0
"""Longest that the services may take until the deployments are there."""
RUN_S = 600.0
"""Longest that a run may take."""
TOLD_S = 120.0
"""Longest until a death is told (docs/arrival.md)."""
AGAIN_S = 180.0
"""Longest from there until the run is at work again: a minute, a look of the worker, the start of a process."""
AGAIN = "It is started again in a minute, three times at most. By hand: prefect flow-run retry"


def test_the_file_is_one_of_compose() -> None:
    """Read by the parser of the compose specification: unknown keys and wrong values are refused."""
    text = interpolated(SETTINGS)
    file = compose_spec.PyOptions(apply_merge=True).from_yaml(text)
    file.validate()
    assert len(file.services) == 8
    with pytest.raises(ValueError, match="read_onyl"):
        compose_spec.PyOptions(apply_merge=True).from_yaml(text.replace("read_only", "read_onyl"))


def test_our_containers_may_write_little_and_do_less() -> None:
    for name, service in yaml.safe_load(interpolated(SETTINGS))["services"].items():
        if service["image"] == "roadscan":
            assert service["user"] == "10001:10001", name
            assert service["read_only"] is True, name
            assert service["cap_drop"] == ["ALL"], name
        for port in service.get("ports", ()):
            assert port.startswith("127.0.0.1:"), name


def test_secrets_have_to_be_stated() -> None:
    with pytest.raises(AssertionError, match="ROADSCAN_S3_KEY: set a key"):
        interpolated(SETTINGS | {"ROADSCAN_S3_KEY": ""})


def test_manifests_are_those_of_kubernetes() -> None:
    (file,) = (REPOSITORY / "deploy" / "kubernetes").glob("*.yaml")
    items = yaml.safe_load(file.read_text())["items"]
    for one in items:
        kubernetes_validate.validate(one, "1.37", strict=True)
        if one["kind"] in ("Deployment", "Job"):
            pod = one["spec"]["template"]["spec"]
            assert pod["securityContext"]["runAsNonRoot"] is True
            assert [c["securityContext"]["readOnlyRootFilesystem"] for c in pod["containers"]] == [True]
    wrong = items[-1] | {"spec": items[-1]["spec"] | {"replcas": 3}}
    with pytest.raises(kubernetes_validate.ValidationError, match="replcas"):
        kubernetes_validate.validate(wrong, "1.37", strict=True)


def stated_in_manifests() -> dict[str, str]:
    """Environment that deploy/kubernetes states for any of its containers."""
    (file,) = (REPOSITORY / "deploy" / "kubernetes").glob("*.yaml")
    manifests = yaml.safe_load(file.read_text())["items"]
    (found,) = (dict(one["data"]) for one in manifests if one["kind"] == "ConfigMap")
    for pod in (one["spec"]["template"]["spec"] for one in manifests if one["kind"] in ("Deployment", "Job")):
        for container in pod["containers"]:
            found |= {one["name"]: one["value"] for one in container.get("env", ()) if "value" in one}
    return found


def test_compose_kubernetes_and_systemd_state_the_same() -> None:
    """Of Dask and of memory, and of what tells a death."""
    compose: dict[str, str] = {}
    for service in yaml.safe_load(interpolated(SETTINGS))["services"].values():
        compose |= service.get("environment", {})

    def chosen(stated: dict[str, str], *beginnings: str) -> dict[str, str]:
        found = {name: value for name, value in stated.items() if name.startswith(beginnings)}
        assert len(found) >= 3
        return found

    events = ("PREFECT_SERVER_EVENTS", "PREFECT_FLOWS")
    dask = ("DASK", "MALLOC", "GLIBC")
    assert chosen(compose, *events, *dask) == chosen(stated_in_manifests(), *events, *dask)
    units = (REPOSITORY / "deploy" / "systemd" / "roadscan.env").read_text()
    assert chosen(compose, *events) == chosen(dict(re.findall(r"^(\w+)=(.*)$", units, flags=re.M)), *events)


class Alerts(http.server.BaseHTTPRequestHandler):
    """Keeps what is posted."""

    came: list[dict[str, str]] = []

    def do_POST(self) -> None:
        self.came.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
        self.send_response(200)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        pass


@contextmanager
def alerts() -> Iterator[str]:
    """Where alerts are taken, on the address of this process in the network of the tests."""
    with serving(http.server.ThreadingHTTPServer((f"{NETWORK}.1", 0), Alerts)) as server:
        yield f"http://{NETWORK}.1:{server.server_port}/"


@pytest.fixture
def surveys(simulated: Simulated, tmp_path: Path) -> Path:
    """The folder of surveys: one, with its store in the bucket."""
    copy = simulated.copy_to(tmp_path / "surveys" / "city").survey_file
    lines = [line for line in copy.read_text().splitlines() if not line.startswith("store =")]
    copy.write_text("\n".join(['store = "s3://roadscan/city"', *lines]))
    for folder in (tmp_path, tmp_path / "surveys"):
        folder.chmod(0o755)
    return tmp_path / "surveys"


@pytest.fixture
def deployments(tmp_path: Path) -> Path:
    """deploy/prefect.yaml with the hour at which the user wants the nightly run: in a few minutes."""
    begins = datetime.now(UTC) + timedelta(seconds=SET_UP_S + 60)
    text, lines = re.subn(
        r'cron: ".*"\n( *)timezone: .*',
        f'cron: "{begins.minute} {begins.hour} * * *"\n\\1timezone: UTC',
        (REPOSITORY / "deploy" / "prefect.yaml").read_text(),
    )
    assert lines == 1
    (tmp_path / "prefect.yaml").write_text(text)
    return tmp_path / "prefect.yaml"


@pytest.mark.nightly
@pytest.mark.timeout(2400)
def test_the_services_run_a_survey_through_kills(
    hosts_possible: None, kernels: Path, surveys: Path, deployments: Path, alone: dict[str, bytes], tmp_path: Path
) -> None:
    """A scheduled run loses a Dask worker, its host, and its process: each death is told, its bytes are the same."""
    with network(tmp_path / "hosts") as net, alerts() as url, ExitStack() as stack:
        settings = SETTINGS | {"ROADSCAN_ALERT_URL": url, "ROADSCAN_SURVEYS": str(surveys)}
        path = f"{Path(sys.executable).parent}:{postgres_programs()}:/usr/bin:/bin"
        services = Composed(net, stack, settings, kernels, OF_OTHERS, path, {"./prefect.yaml": deployments})
        order = ["certificates", "prefect", "store", "postgis", "set-up", "worker", "scheduler", "dask-worker"]
        assert set(order) == set(services.services)
        services.up(order)
        client = talking_to(services, stack)
        (tonight, *_) = planned_runs(client)
        assert tonight.auto_scheduled

        first = services.running["worker"]
        first.wait_for("footprints: 0 of", SET_UP_S + 60 + RUN_S)
        services.running["dask-worker"].kill()
        services.start("dask-worker")  # restart: unless-stopped
        first.wait_for("a worker died: tls://", RUN_S)

        first.wait_for("tiles: 0 of", RUN_S)
        first.kill()
        services.start("worker")
        with timed("the death of a run's host", TOLD_S):
            assert alert(0) == {
                "subject": "roadscan: the run city/SURVEY.toml crashed",
                "body": f"No heartbeat for 100 s, so its process is dead. {AGAIN} {tonight.id}",
            }
        second = services.running["worker"]
        with timed("it runs again", AGAIN_S):
            second.wait_for("tiles: 0 of", AGAIN_S)

        process_of_run(second).kill()
        with timed("the death of a run's process", TOLD_S):
            assert alert(1)["subject"] == "roadscan: the run city/SURVEY.toml crashed"
        assert re.match(r"Process exited with status code: -9\..*", Alerts.came[1]["body"])
        with timed("it ends", AGAIN_S + RUN_S):
            state = final(client, tonight.id, second.said)
        assert state.type is StateType.COMPLETED, second.said()
        assert client.read_flow_run(tonight.id).run_count == 3
        name = Survey.load(surveys / "city" / "SURVEY.toml").config.id
        assert_same(contents(Store("s3://roadscan/city", name)), alone)

        broken = client.create_flow_run_from_deployment(
            client.read_deployment_by_name("survey/city").id, parameters={"survey_file": "town/SURVEY.toml"}
        )
        assert final(client, broken.id, second.said).type is StateType.FAILED
        told = alert(2)
        assert told["subject"] == "roadscan: the run town/SURVEY.toml failed"
        assert "SURVEY.toml" in told["body"]
        assert len(Alerts.came) == 3
        database = services.hosts["postgis"].address
        assert [is_let_in(database, word) for word in (SETTINGS["ROADSCAN_POSTGRES_PASSWORD"], "other")] == [
            True,
            False,
        ]


def is_let_in(address: str, password: str) -> bool:
    """Whether the database that the file names takes its user with a password."""
    import psycopg

    try:
        with psycopg.connect(host=address, user="roadscan", password=password, dbname="roadscan") as connection:
            return connection.execute("SELECT 1").fetchone() == (1,)
    except psycopg.OperationalError as error:
        assert "password authentication failed" in str(error)
        return False


def postgres_programs() -> Path:
    """Folder of PostgreSQL's programs."""
    found = programs()
    if found is None:
        pytest.skip(WANTED)
    return found


def talking_to(services: Composed, stack: ExitStack) -> SyncPrefectClient:
    """A client of the services' Prefect; this process uses their object store, too."""
    api = f"http://{services.hosts['prefect'].address}:4200/api"
    stack.enter_context(
        temporary_settings({PREFECT_API_URL: api, PREFECT_API_AUTH_STRING: SETTINGS["ROADSCAN_PREFECT_AUTH"]})
    )
    patch = stack.enter_context(pytest.MonkeyPatch.context())
    endpoint = f"http://{services.hosts['store'].address}:7070"
    patch.setitem(fsspec.config.conf, "s3", {"endpoint_url": endpoint, "key": "tests", "secret": "tests"})
    return stack.enter_context(get_client(sync_client=True))


@contextmanager
def timed(what: str, within_s: float) -> Iterator[None]:
    """What it takes, told by `pytest -rP`."""
    began = time.monotonic()
    yield
    took_s = time.monotonic() - began
    sys.stdout.write(f"{what}: after {took_s:.0f} s\n")
    assert took_s < within_s, what


def alert(number: int) -> dict[str, str]:
    """An alert when it has come."""
    eventually(lambda: len(Alerts.came) > number, f"no alert came: {Alerts.came}", 2 * TOLD_S)
    return Alerts.came[number]


def process_of_run(worker: Running) -> psutil.Process:
    """The process of the flow run that a worker has started."""
    family = psutil.Process(worker.process.pid).children(recursive=True)
    (found,) = (one for one in family if "prefect.engine" in one.cmdline())
    return found


def final(client: SyncPrefectClient, run: UUID, said: Callable[[], str]) -> State[Any]:
    """State of a flow run when it has ended."""

    def state() -> State[Any]:
        found = client.read_flow_run(run).state
        assert found is not None
        return found

    end = time.monotonic() + RUN_S
    while not state().is_final() or state().is_crashed():
        assert time.monotonic() < end, said()
        time.sleep(0.5)
    return state()
