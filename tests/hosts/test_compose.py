"""deploy/compose.yaml and deploy/kubernetes: their form; and the services of the first, run on hosts of their own."""

from __future__ import annotations

import http.server
import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from uuid import UUID

import compose_spec
import fsspec
import kubernetes_validate
import pytest
import yaml
from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.client.schemas.objects import State, StateType
from prefect.settings import PREFECT_API_AUTH_STRING, PREFECT_API_URL, temporary_settings
from prefect.states import Scheduled

from roadscan.core.survey import Survey
from roadscan.store.store import Store
from tests.conftest import REPOSITORY
from tests.flows.test_deployment import log_of, planned_runs
from tests.hosts.composed import Composed, eventually, interpolated
from tests.hosts.conftest import assert_same, contents
from tests.hosts.host import NETWORK, network
from tests.serving import serving
from tests.surveys import Simulated

SETTINGS = {
    "ROADSCAN_PREFECT_AUTH": "roadscan:of-the-tests",
    "ROADSCAN_S3_KEY": "tests",
    "ROADSCAN_S3_SECRET": "tests",
    "ROADSCAN_POSTGRES_PASSWORD": "tests",
}
RUN_S = 600.0
"""Longest that a run may take."""
ALERT_S = 60.0
"""Longest that an alert may take: Prefect's worker looks after its processes twice a minute."""


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


def test_compose_and_kubernetes_state_the_same_of_dask() -> None:
    compose = yaml.safe_load(interpolated(SETTINGS))["services"]
    (file,) = (REPOSITORY / "deploy" / "kubernetes").glob("*.yaml")
    manifests = yaml.safe_load(file.read_text())["items"]
    (settings,) = (one["data"] for one in manifests if one["kind"] == "ConfigMap")
    stated = compose["scheduler"]["environment"] | compose["dask-worker"]["environment"]
    same = {name: value for name, value in stated.items() if name.startswith(("DASK", "MALLOC", "GLIBC"))}
    assert same == {name: value for name, value in settings.items() if name.startswith(("DASK", "MALLOC", "GLIBC"))}


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


@pytest.mark.nightly
@pytest.mark.timeout(2400)
def test_the_services_run_a_survey_through_kills(
    hosts_possible: None, kernels: Path, surveys: Path, alone: dict[str, bytes], tmp_path: Path
) -> None:
    """A scheduled run, of which a Dask worker is killed and started again: the bytes of a run alone, and no alert."""
    given = {"store": ["python", "-m", "moto.server", "-H", "0.0.0.0", "-p", "7070"]}
    with network(tmp_path / "hosts") as net, alerts() as url, ExitStack() as stack:
        settings = SETTINGS | {"ROADSCAN_ALERT_URL": url, "ROADSCAN_SURVEYS": str(surveys)}
        path = f"{Path(sys.executable).parent}:/usr/bin:/bin"
        services = Composed(net, stack, settings, kernels, given, path)
        services.up(["certificates", "prefect", "store", "set-up", "worker", "scheduler", "dask-worker"])
        api = f"http://{services.hosts['prefect'].address}:4200/api"
        stack.enter_context(
            temporary_settings({PREFECT_API_URL: api, PREFECT_API_AUTH_STRING: SETTINGS["ROADSCAN_PREFECT_AUTH"]})
        )
        client = stack.enter_context(get_client(sync_client=True))
        patch = stack.enter_context(pytest.MonkeyPatch.context())
        endpoint = f"http://{services.hosts['store'].address}:7070"
        patch.setitem(fsspec.config.conf, "s3", {"endpoint_url": endpoint, "key": "tests", "secret": "tests"})
        name = Survey.load(surveys / "city" / "SURVEY.toml").config.id
        said = services.running["worker"].said
        tonight = planned_runs(client)[0]
        assert tonight.auto_scheduled

        client.set_flow_run_state(tonight.id, Scheduled(), force=True)
        services.running["worker"].wait_for("footprints: 0 of", RUN_S)
        services.running["dask-worker"].kill()
        services.start("dask-worker")  # restart: unless-stopped
        assert final(client, tonight.id, said).type is StateType.COMPLETED, said()
        eventually(
            lambda: any("a worker died: tls://" in line for line in log_of(client, tonight.id) or ()),
            "the server's log of the run does not tell of the death", ALERT_S,
        )  # fmt: skip
        assert_same(contents(Store("s3://roadscan/city", name)), alone)
        assert Alerts.came == []


def final(client: SyncPrefectClient, run: UUID, said: Callable[[], str]) -> State[Any]:
    """State of a flow run when it has ended."""

    def state() -> State[Any]:
        found = client.read_flow_run(run).state
        assert found is not None
        return found

    end = time.monotonic() + RUN_S
    while not state().is_final():
        assert time.monotonic() < end, said()
        time.sleep(0.5)
    return state()
