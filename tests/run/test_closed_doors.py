"""The embedded cluster lets nobody in who does not hold its key, and leaves that key nowhere."""

from __future__ import annotations

import asyncio
import logging
import os
import stat
import subprocess
import sys
import tempfile
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from distributed import Security
from distributed.comm import connect

from roadscan.core.errors import ConfigError, RunError
from roadscan.core.private_folder import UnsafeFolderError
from roadscan.run.engine import compute_on as embedded_module
from roadscan.run.engine.compute_on import compute_on, embedded
from roadscan.run.engine.on_dask import OnDask

PATIENCE_S = 3.0


def listening() -> set[tuple[str, int]]:
    """Addresses at which this process and those that it started listen."""
    own = psutil.Process()
    found = [c for one in (own, *own.children(recursive=True)) for c in one.net_connections(kind="inet")]
    return {(c.laddr.ip, c.laddr.port) for c in found if c.status == psutil.CONN_LISTEN}


class Opened:
    """A cluster, where it listens, and what was logged."""

    def __init__(self, on_dask: OnDask, ports: set[tuple[str, int]]) -> None:
        self.on_dask, self.cluster, self.ports = on_dask, on_dask._client.cluster, ports


@pytest.fixture(scope="module")
def opened() -> Iterator[Opened]:
    before = listening()
    with embedded(2) as on_dask:
        yield Opened(on_dask, listening() - before)


def accepted(address: str, security: Security | None) -> bool:
    """Whether a server there answers who comes with these credentials."""

    async def ask() -> bool:
        more = {} if security is None else security.get_connection_args("client")
        comm = await connect(address, timeout=PATIENCE_S, **more)
        try:
            await comm.write({"op": "identity", "reply": True})
            return bool(await asyncio.wait_for(comm.read(), PATIENCE_S))
        finally:
            comm.abort()

    try:
        return asyncio.run(ask())
    except (OSError, TimeoutError):
        return False


@pytest.mark.slow
def test_all_of_it_listens_on_loopback_alone(opened: Opened) -> None:
    """A port each for the scheduler, two nannies and two workers, and none that serves pages."""
    assert {ip for ip, _ in opened.ports} == {"127.0.0.1"}
    assert len(opened.ports) == 5


@pytest.mark.slow
def test_only_the_clusters_own_key_is_let_in(opened: Opened) -> None:
    own, another = opened.cluster.security, Security.temporary()
    half = Security(require_encryption=True, tls_ca_file=own.tls_ca_file, tls_client_cert=another.tls_client_cert,
                    tls_client_key=another.tls_client_key)  # fmt: skip
    for ip, port in opened.ports:
        assert accepted(f"tls://{ip}:{port}", own)
    for ip, port in opened.ports:
        assert not accepted(f"tcp://{ip}:{port}", None)
        assert not accepted(f"tls://{ip}:{port}", half)


@pytest.mark.slow
def test_the_key_lies_nowhere(opened: Opened, capfd: pytest.CaptureFixture[str]) -> None:
    """Neither on a command line nor in an environment, a file or a log."""
    lines = opened.cluster.security.tls_worker_key.splitlines()
    secret = lines[len(lines) // 2]
    assert len(secret) == 64
    root = logging.getLogger()
    level, logs = root.level, logging.StreamHandler()
    root.addHandler(logs)
    root.setLevel(logging.DEBUG)
    try:
        list(opened.on_dask.map(len, ["abc"]))
    finally:
        root.removeHandler(logs)
        root.setLevel(level)
    own = psutil.Process()
    for one in (own, *own.children(recursive=True)):
        assert secret not in " ".join(one.cmdline())
        assert secret not in "".join(one.environ().values())
    place = scratch(opened)
    assert stat.S_IMODE(place.stat().st_mode) == 0o700
    for file in (f for f in place.rglob("*") if f.is_file()):
        assert secret.encode() not in file.read_bytes(), file
    said = capfd.readouterr()
    assert secret not in said.out + said.err + repr(opened.cluster.security) + repr(opened.cluster)


def scratch(opened: Opened) -> Path:
    """The cluster's folder for temporary files."""
    return Path(opened.cluster.scheduler.local_directory).parents[1]


@pytest.mark.slow
def test_code_that_waits_in_dasks_usual_folder_is_not_loaded(tmp_path: Path) -> None:
    """Another user may have made that folder first, with modules in it that the run or its libraries ask for."""
    usual = tmp_path / "dask-scratch-space"
    usual.mkdir(mode=0o777)
    (usual / "planted.py").write_text("")
    ask = (
        "from tests.run.test_closed_doors import has_planted\n"
        "from roadscan.run.engine.compute_on import embedded\n"
        "if __name__ == '__main__':\n"
        "    with embedded(1) as opened:\n"
        "        assert not next(iter(opened.map(has_planted, [0]))).result\n"
        "        assert not has_planted(0)\n"
        "    import sys\n"
        "    assert not [p for p in sys.path if 'roadscan-' in p], sys.path\n"
    )
    script = tmp_path / "script.py"
    script.write_text(ask)
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    subprocess.run([sys.executable, script], env=environment, check=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["dask-scratch-space", "script.py"]


def has_planted(_: int) -> bool:
    from importlib.util import find_spec

    return find_spec("planted") is not None


def test_a_temporary_folder_that_others_can_change_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tmp_path.chmod(0o777)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    refused = pytest.raises(UnsafeFolderError, match=r"the folder for temporary files can be written .*TMPDIR")
    with refused, embedded(1):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.nightly
def test_a_dashboard_is_served_where_one_is_asked_for() -> None:
    pytest.importorskip("bokeh", reason="Bokeh draws the dashboard: pip install bokeh")
    heard: list[str] = []
    before = listening()
    with embedded(1, heard.append):
        (address,) = heard
        assert address.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(address, timeout=30) as page:
            assert b"Bokeh" in page.read()
        assert {ip for ip, _ in listening() - before} == {"127.0.0.1"}


def test_workers_that_die_while_they_start_are_started_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    start, tries = embedded_module.closed_cluster, []

    def dying(*rest: Any, **named: Any) -> Any:
        tries.append(rest)
        if len(tries) == 1:
            raise RuntimeError("Nanny failed to start worker process")
        return start(*rest, **named)

    monkeypatch.setattr(embedded_module, "closed_cluster", dying)
    with embedded(1) as cluster:
        assert [done.result for done in cluster.map(abs, [-3])] == [3]
    assert len(tries) == 2


def test_workers_that_never_start_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def dying(*_: Any, **__: Any) -> Any:
        raise RuntimeError("Nanny failed to start worker process")

    monkeypatch.setattr(embedded_module, "closed_cluster", dying)
    with pytest.raises(RunError, match="could not be started"), embedded(2):
        pass


@pytest.mark.parametrize(("where", "words"), [({"workers": 0}, "this process"), ({"scheduler": "tls://h:1"}, "h:1")])
def test_a_dashboard_needs_an_embedded_cluster(where: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words), compute_on(**where, dashboard=print):  # type: ignore[arg-type]
        pass
