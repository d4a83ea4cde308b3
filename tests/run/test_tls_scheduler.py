"""A scheduler of one's own with certificates, made and started by the commands of docs/deployment.md."""

from __future__ import annotations

import os
import re
import shutil
import socket
import stat
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import dask
import pytest
from distributed import Security

from roadscan.core.errors import RoadscanError
from roadscan.run.engine.on_dask import connected
from tests.conftest import REPOSITORY
from tests.flows.prefect_server import background

pytestmark = pytest.mark.nightly

BLOCKS = dict(
    re.findall(r"^```bash (\w+)\n(.*?)^```", (REPOSITORY / "docs/deployment.md").read_text(), flags=re.M | re.DOTALL)
)


class Started(NamedTuple):
    """A scheduler with a worker."""

    address: str
    certificates: Path
    configuration: dict[str, str]
    """Of Dask, as the page sets it."""


@pytest.fixture(scope="module")
def started(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Started]:
    if shutil.which("openssl") is None:
        pytest.skip("certificates are made with the program openssl")
    folder = tmp_path_factory.mktemp("tls")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    places = {"/etc/roadscan/tls": folder / "tls", "/var/lib/roadscan/dask": folder / "dask", "8786": port, "8787": 0,
              "--nworkers -1": "--nworkers 1"}  # fmt: skip
    environment = {k: v for k, v in os.environ.items() if not k.startswith("DASK_")}
    environment |= {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "PYTHONPATH": str(REPOSITORY)}

    def block(*names: str) -> list[str]:
        text = "set -e\n" + "".join(BLOCKS[name] for name in names)
        for said, here in places.items():
            text = text.replace(said, str(here))
        return ["bash", "-c", text]

    subprocess.run(block("certificates"), env=environment, check=True, capture_output=True)
    asked = [*block("configuration")[:2], block("configuration")[2] + "env -0"]
    found = subprocess.run(asked, env=environment, check=True, capture_output=True, text=True).stdout
    settings = {
        name.removeprefix("DASK_").lower().replace("__", "."): value
        for name, _, value in (line.partition("=") for line in found.split("\0"))
        if name.startswith("DASK_DISTRIBUTED__COMM__TLS")
    }
    with ExitStack() as stack:
        for name in ("scheduler", "workers"):
            command = block("configuration", "folder", name)
            stack.enter_context(background(command, environment, folder, folder / f"{name}.log"))
        yield Started(f"tls://127.0.0.1:{port}", folder / "tls", settings)


def test_certificates_let_in(started: Started) -> None:
    with dask.config.set(started.configuration), connected(started.address) as cluster:
        (done,) = cluster.map(len, ["abc"])
    assert done.result == 3


def test_keys_are_for_the_user_alone(started: Started) -> None:
    for key in started.certificates.glob("*.key"):
        assert stat.S_IMODE(key.stat().st_mode) == 0o600


def test_no_certificate_lets_nobody_in(started: Started) -> None:
    with pytest.raises(RoadscanError, match=r"reached by TLS, and no certificate.*ca-file"), connected(started.address):
        pass
    with (
        pytest.raises(RoadscanError, match="no Dask scheduler answers"),
        connected(started.address.replace("tls", "tcp")),
    ):
        pass


def test_a_certificate_of_another_authority_lets_nobody_in(started: Started, tmp_path: Path) -> None:
    other = Security.temporary()
    (tmp_path / "cert").write_text(other.tls_client_cert)
    (tmp_path / "key").write_text(other.tls_client_key)
    client = {"cert": str(tmp_path / "cert"), "key": str(tmp_path / "key")}
    tls = {"distributed.comm.tls.ca-file": str(started.certificates / "ca.pem"), "distributed.comm.tls.client": client}
    with (
        dask.config.set(tls),
        pytest.raises(RoadscanError, match="no Dask scheduler answers"),
        connected(started.address),
    ):
        pass
