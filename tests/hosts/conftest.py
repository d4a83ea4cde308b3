"""A survey, its store on an S3 server, and a Dask cluster: each on a host of its own."""

from __future__ import annotations

import contextlib
import re
import sys
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import fsspec
import pytest

from roadscan.core.survey import Survey
from roadscan.store.store import Store
from tests.conftest import REPOSITORY
from tests.hosts.host import Host, Network, Running, copy_of_kernels, missing, network
from tests.hosts.switch import Link
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
_PAGE = (REPOSITORY / "docs" / "deployment.md").read_text()
_BLOCKS = re.findall(r"^```bash (?:scheduler|workers)\n(.*?)^```", _PAGE, flags=re.M | re.DOTALL)
DASK = dict(re.findall(r"^export (DASK_\w+__\w+)=(\w+)", "".join(_BLOCKS), flags=re.M))
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
        self.driver.give("/srv/roadscan/city", self.driver.copied(self.survey.survey_file.parent, "city"))

    def fresh(self, name: str) -> Store:
        """An empty store for the next runs; its cluster is whole, and its links are as new."""
        self.stop(self.driver)
        for host in self.net.hosts:
            assert host.link is not None
            host.link.is_cut, host.link.delay_s, host.link.lost = False, 0.0, 0.0
        if "scheduler" not in self.processes or self.processes["scheduler"].process.poll() is not None:
            self.start_scheduler()
            for host in self.workers:
                self.stop(host)
        for host in self.workers:
            if host.name not in self.processes or self.processes[host.name].process.poll() is not None:
                self.start_worker(host).wait_for("Registered to")
        file = self.driver.folder / "city" / self.survey.survey_file.name
        lines = [line for line in self.survey.survey_file.read_text().splitlines() if not line.startswith("store =")]
        url = f"s3://{BUCKET}/{name}"
        file.write_text("\n".join([f'store = "{url}"', *lines]))
        return Store(url, Survey.load(file).config.id)

    def link(self, name: str) -> Link:
        """The link of a host by its name."""
        (link,) = (host.link for host in self.net.hosts if host.name == name)
        assert link is not None
        return link

    @contextlib.contextmanager
    def cut(self, name: str) -> Iterator[None]:
        """Cut the link of a host."""
        self.link(name).is_cut = True
        yield
        self.link(name).is_cut = False

    def restart(self) -> None:
        """Start scheduler and workers anew."""
        self.start_scheduler("again")
        for host in self.workers:
            self.stop(host)
            self.start_worker(host, log="again").wait_for("Registered to")

    def moved_clock(self, host: Host, minutes: int) -> dict[str, str]:
        """Environment in which a host's Python takes the time to be some minutes later."""
        place = host.folder / "clock"
        place.mkdir(exist_ok=True)
        (place / "sitecustomize.py").write_text(
            "import time\n"
            "s, ns = time.time, time.time_ns\n"
            f"time.time, time.time_ns = lambda: s() + {60 * minutes}, lambda: ns() + {60 * minutes} * 10**9\n"
        )
        host.give("/srv/clock", place)
        return {"PYTHONPATH": f"/srv/clock:{REPOSITORY}"}

    def give_version(self, host: Host, version: str, log: str = "other") -> Running:
        """Start a worker whose roadscan says that it is of another version, as its installation does."""
        self.stop(host)
        place = host.folder / f"version-{version}"
        (place / f"roadscan-{version}.dist-info").mkdir(parents=True)
        (place / f"roadscan-{version}.dist-info" / "METADATA").write_text(f"Name: roadscan\nVersion: {version}\n")
        (place / "sitecustomize.py").write_text(f"import roadscan\nroadscan.__version__ = '{version}'\n")
        host.give("/srv/version", place)
        running = self.start_worker(host, {"PYTHONPATH": f"/srv/version:{REPOSITORY}"}, log)
        if log == "other":
            running.wait_for("Registered to")
        return running

    def stop(self, host: Host) -> None:
        """End all processes of a host at once."""
        if host.name in self.processes:
            self.processes[host.name].kill()

    @property
    def endpoint(self) -> str:
        return f"http://{self.store.address}:{S3_PORT}"

    @property
    def address(self) -> str:
        return f"tcp://{self.scheduler.address}:{SCHEDULER_PORT}"

    def start(
        self, host: Host, command: list[str], environment: Mapping[str, str] | None = None, log: str = "log"
    ) -> Running:
        own = ENVIRONMENT | {"FSSPEC_S3_ENDPOINT_URL": self.endpoint} | (environment or {})
        running = self.stack.enter_context(host.running(command, own, log))
        self.processes[host.name] = running
        return running

    def start_store(self) -> None:
        running = self.start(self.store, ["python", "-m", "moto.server", "-H", "0.0.0.0", "-p", str(S3_PORT)])
        running.wait_until(self._store_answers, "the store does not answer")
        request = urllib.request.Request(
            f"{self.endpoint}/{BUCKET}", method="PUT", headers={"Host": self.store.address}
        )
        urllib.request.urlopen(request, timeout=10.0).close()

    def _store_answers(self) -> bool:
        try:
            urllib.request.urlopen(f"{self.endpoint}/moto-api/", timeout=1.0).close()
        except OSError:
            return False
        return True

    def start_scheduler(self, log: str = "log") -> None:
        command = [
            "dask",
            "scheduler",
            "--host",
            self.scheduler.address,
            "--port",
            str(SCHEDULER_PORT),
            "--no-dashboard",
        ]
        self.start(self.scheduler, command, DASK, log).wait_for("Scheduler at")

    def start_worker(self, host: Host, environment: Mapping[str, str] | None = None, log: str = "log") -> Running:
        command = [
            "dask",
            "worker",
            self.address,
            "--host",
            host.address,
            "--nworkers",
            "1",
            "--nthreads",
            "1",
            "--no-dashboard",
        ]
        return self.start(host, command, DASK | dict(environment or {}), log)

    def run(self, log: str, environment: Mapping[str, str] | None = None) -> Running:
        command = ["roadscan", "run", "/srv/roadscan/city/SURVEY.toml", "--scheduler", self.address]
        return self.start(self.driver, ["python", "-m", *command], environment, log)


@pytest.fixture(scope="session")
def kernels(alone: object, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compiled kernels of a run on this machine: no host compiles them anew."""
    return copy_of_kernels(tmp_path_factory.mktemp("kernels") / "roadscan")


@pytest.fixture(scope="module")
def cluster(
    hosts_possible: None, kernels: Path, simulated: Simulated, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Cluster]:
    """All of it, with nothing run."""
    with pytest.MonkeyPatch.context() as patch, ExitStack() as stack:
        made = Cluster(stack.enter_context(network(tmp_path_factory.mktemp("hosts"))), simulated, kernels, stack)
        patch.setitem(fsspec.config.conf, "s3", {"endpoint_url": made.endpoint, "key": "tests", "secret": "tests"})
        made.start_store()
        yield made


@pytest.fixture(scope="session")
def alone(finished: Simulated) -> dict[str, bytes]:
    """Tables, tiles and products of a run on this machine alone."""
    return contents(finished.store())


def contents(store: Store) -> dict[str, bytes]:
    """All that a store holds but records, by name."""
    found = outputs(store)
    return found | {path: store.read_bytes(path) for path in store.files("tables")}


def assert_same(found: dict[str, bytes], alone: dict[str, bytes]) -> None:
    """The names of what differs are told: no difference of bytes, which would take minutes."""
    assert sorted(found) == sorted(alone)
    differing = [name for name in alone if found[name] != alone[name]]
    assert differing == []
