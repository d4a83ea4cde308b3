"""A survey, its store on an S3 server, and a Dask cluster: each on a host of its own."""

from __future__ import annotations

import re
import sys
import time
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from roadscan.store.store import Store
from tests.conftest import REPOSITORY
from tests.hosts.host import Host, Network, Running, copy_of_kernels, missing, network
from tests.surveys import Simulated, outputs

SCHEDULER_PORT = 8786
S3_PORT = 9000
BUCKET = "roads"
ENVIRONMENT = {
    "PATH": f"{Path(sys.executable).parent}:/usr/bin:/bin",
    "PYTHONPATH": str(REPOSITORY),
    "HOME": "/var/lib/roadscan",
    "DASK_TEMPORARY_DIRECTORY": "/var/lib/roadscan",
    "OPENBLAS_NUM_THREADS": "1",
    "PYTHONDONTWRITEBYTECODE": "1",
    "AWS_ACCESS_KEY_ID": "tests",
    "AWS_SECRET_ACCESS_KEY": "tests",
    "AWS_DEFAULT_REGION": "us-east-1",
    "LANG": "C.UTF-8",
}
DASK = dict(
    re.findall(
        r"^export (DASK_\w+__\w+)=(\w+)",
        "".join(re.findall(r"^```bash (?:scheduler|workers)\n(.*?)^```", (REPOSITORY / "docs/deployment.md").read_text(),
                           flags=re.M | re.DOTALL)),
        flags=re.M,
    )
)  # fmt: skip
"""Settings of scheduler and workers as docs/deployment.md states them."""


@pytest.fixture(scope="session")
def hosts_possible() -> None:
    """The test is skipped where hosts cannot be made."""
    if reason := missing():
        pytest.skip(f"no hosts: {reason}")


@dataclass
class Cluster:
    """Hosts of one run: a store, a scheduler, two workers and a driver."""

    net: Network
    survey: Simulated
    kernels: Path
    stack: ExitStack
    store: Host = field(init=False)
    scheduler: Host = field(init=False)
    driver: Host = field(init=False)
    workers: list[Host] = field(init=False)
    processes: dict[str, Running] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.store, self.scheduler, self.driver = map(self.net.host, ("store", "scheduler", "driver"))
        self.workers = [self.net.host(name) for name in ("one", "two")]
        for host in (self.driver, *self.workers):
            host.give_kernels(self.kernels)
        folder = self.driver.copied(self.survey.survey_file.parent, "city")
        self.driver.give("/srv/roadscan/city", folder)
        (folder / "store").exists()
        file = folder / self.survey.survey_file.name
        file.write_text(re.sub(r'^store = .*\n', "", file.read_text(), flags=re.M))
        file.write_text(f'store = "s3://{BUCKET}/store"\n' + file.read_text())

    @property
    def endpoint(self) -> str:
        return f"http://{self.store.address}:{S3_PORT}"

    @property
    def address(self) -> str:
        return f"tcp://{self.scheduler.address}:{SCHEDULER_PORT}"

    def start(self, host: Host, command: list[str], environment: Mapping[str, str] | None = None, log: str = "log") -> Running:
        own = ENVIRONMENT | {"FSSPEC_S3_ENDPOINT_URL": self.endpoint} | (environment or {})
        running = self.stack.enter_context(host.running(command, own, log))
        self.processes[host.name] = running
        return running

    def start_store(self) -> None:
        running = self.start(self.store, ["python", "-m", "moto.server", "-H", "0.0.0.0", "-p", str(S3_PORT)])
        running.wait_until(self._store_answers, "the store does not answer")
        request = urllib.request.Request(f"{self.endpoint}/{BUCKET}", method="PUT", headers={"Host": self.store.address})
        urllib.request.urlopen(request, timeout=10.0).close()

    def _store_answers(self) -> bool:
        try:
            urllib.request.urlopen(f"{self.endpoint}/moto-api/", timeout=1.0).close()
        except OSError:
            return False
        return True

    def start_scheduler(self, log: str = "log") -> None:
        command = ["dask", "scheduler", "--host", self.scheduler.address, "--port", str(SCHEDULER_PORT), "--no-dashboard"]
        self.start(self.scheduler, command, DASK, log).wait_for("Scheduler at")

    def start_worker(self, host: Host, environment: Mapping[str, str] | None = None, log: str = "log") -> Running:
        command = ["dask", "worker", self.address, "--host", host.address, "--nworkers", "1", "--nthreads", "1", "--no-dashboard"]
        return self.start(host, command, DASK | dict(environment or {}), log)

    def run(self, log: str, environment: Mapping[str, str] | None = None) -> Running:
        command = ["roadscan", "run", "/srv/roadscan/city/SURVEY.toml", "--scheduler", self.address]
        return self.start(self.driver, ["python", "-m", *command], environment, log)


@pytest.fixture(scope="session")
def kernels(alone: object, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compiled kernels of a run on this machine: no host compiles them anew."""
    return copy_of_kernels(tmp_path_factory.mktemp("kernels") / "roadscan")


@pytest.fixture
def cluster(hosts_possible: None, kernels: Path, simulated: Simulated, tmp_path: Path) -> Iterator[Cluster]:
    """All of it, with nothing run."""
    with network(tmp_path) as net, ExitStack() as stack:
        made = Cluster(net, simulated, kernels, stack)
        made.start_store()
        made.start_scheduler()
        for host in made.workers:
            made.start_worker(host)
        for host in made.workers:
            made.processes[host.name].wait_for("Registered to")
        yield made


@pytest.fixture(scope="session")
def alone(finished: Simulated) -> dict[str, bytes]:
    """Tiles and products of a run on this machine alone."""
    return outputs(finished.store())
