"""Clusters that SLURM and dask-gateway start, where these are on this machine: the bytes are those of a run alone."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY
from tests.flows.prefect_server import background
from tests.hosts.conftest import contents
from tests.run.test_tls_scheduler import BLOCKS
from tests.surveys import Simulated

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(600)]
START_S = 120.0


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """Certificates, and Dask's configuration that names them, by the commands of docs/deployment.md."""
    places = {"/etc/roadscan/tls": tmp_path / "tls", "/var/lib/roadscan/dask": tmp_path / "dask"}

    def said(*names: str) -> str:
        text = "set -e\n" + "".join(BLOCKS[name] for name in names)
        for there, here in places.items():
            text = text.replace(there, str(here))
        return text

    path = {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "PYTHONPATH": str(REPOSITORY)}
    subprocess.run(["bash", "-c", said("certificates")], env=os.environ | path, check=True, capture_output=True)
    asked = ["bash", "-c", said("configuration", "folder") + "env -0"]
    found = subprocess.run(asked, env=path, check=True, capture_output=True, text=True).stdout
    return {name: value for name, _, value in (line.partition("=") for line in found.split("\0")) if name} | {
        "HOME": os.environ["HOME"]
    }


def written(file: Path, log: Path) -> str:
    """What a program writes into a file when it is ready."""
    end = time.monotonic() + START_S
    while not (file.is_file() and file.read_text()):
        assert time.monotonic() < end, log.read_text()
        time.sleep(0.2)
    return file.read_text()


def run(survey: Simulated, scheduler: str, environment: dict[str, str]) -> None:
    command = [sys.executable, "-m", "roadscan", "run", str(survey.survey_file), "--scheduler", scheduler]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=START_S * 2)
    assert done.returncode == 0, done.stderr


def test_slurm(simulated: Simulated, alone: dict[str, bytes], environment: dict[str, str], tmp_path: Path) -> None:
    pytest.importorskip("dask_jobqueue")
    try:
        subprocess.run(["sinfo"], check=True, capture_output=True, timeout=20)
    except (OSError, subprocess.SubprocessError):
        pytest.skip("no SLURM answers here")
    survey = simulated.copy_to(tmp_path / "survey")
    command = [sys.executable, str(REPOSITORY / "deploy" / "slurm" / "cluster.py"), "--jobs", "2", "--processes", "1",
               "--memory", "2GiB", "--walltime", "00:20:00", "--port", "0", "--out", "scheduler"]  # fmt: skip
    with background(command, environment, tmp_path, tmp_path / "cluster.log"):
        run(survey, written(tmp_path / "scheduler", tmp_path / "cluster.log"), environment)
        listed = subprocess.run(["squeue", "--noheader", "--format=%j"], check=True, capture_output=True, text=True)
        assert listed.stdout.split() == ["dask-worker"] * 2
    assert contents(survey.store()) == alone
    end = time.monotonic() + START_S
    while subprocess.run(["squeue", "--noheader"], check=True, capture_output=True).stdout.strip():
        assert time.monotonic() < end, "jobs are left behind"
        time.sleep(0.5)


SERVER = """
from dask_gateway_server.backends.local import UnsafeLocalBackend
c.DaskGateway.backend_class = UnsafeLocalBackend
c.DaskGateway.authenticator_class = "dask_gateway_server.auth.SimpleAuthenticator"
c.DaskGateway.address = "127.0.0.1:{api}"
c.Proxy.address = "127.0.0.1:{port}"
c.UnsafeLocalBackend.clusters_directory = "{folder}"
c.ClusterConfig.scheduler_cmd = ["{bin}/dask", "scheduler"]
c.ClusterConfig.worker_cmd = ["{bin}/dask", "worker"]
c.ClusterConfig.environment = {environment}
"""
"""Settings of a gateway whose clusters are processes of this machine."""


@pytest.fixture
def gateway(tmp_path: Path, environment: dict[str, str]) -> Iterator[str]:
    """Address of a gateway's server."""
    pytest.importorskip("dask_gateway_server.app")
    from tests.flows.prefect_server import _free_port

    ports = [_free_port() for _ in range(2)]
    file = tmp_path / "gateway.py"
    file.write_text(
        SERVER.format(
            api=ports[0], port=ports[1], folder=tmp_path, bin=Path(sys.executable).parent,
            environment={k: environment[k] for k in ("PATH", "PYTHONPATH", "HOME")},
        )
    )  # fmt: skip
    command = [sys.executable, "-m", "dask_gateway_server", "--config", str(file)]
    with background(command, environment, tmp_path, tmp_path / "gateway.log"):
        end = time.monotonic() + START_S
        while not re.search(r"Dask-Gateway server started", (tmp_path / "gateway.log").read_text()):
            assert time.monotonic() < end, (tmp_path / "gateway.log").read_text()
            time.sleep(0.2)
        yield f"http://127.0.0.1:{ports[1]}"


def test_gateway(
    gateway: str, simulated: Simulated, alone: dict[str, bytes], environment: dict[str, str], tmp_path: Path
) -> None:
    survey = simulated.copy_to(tmp_path / "survey")
    own = {k: v for k, v in environment.items() if not k.startswith("DASK_DISTRIBUTED")} | {
        "DASK_GATEWAY__ADDRESS": gateway
    }
    program = (
        "from dask_gateway import Gateway; made = Gateway().new_cluster(shutdown_on_close=False); made.scale(2); "
        "print(made.name)"
    )
    made = subprocess.run([sys.executable, "-c", program], env=own, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr + (tmp_path / "gateway.log").read_text()
    run(survey, f"gateway:{made.stdout.strip()}", own)
    assert contents(survey.store()) == alone
