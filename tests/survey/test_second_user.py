"""Another user of the machine: no port lets him in, a private survey stays private, and his code is not loaded.

An account is made and removed, so this runs as root alone. Each thing that has to fail is first seen to succeed where
the door stands open, so that the test can fail.
"""

from __future__ import annotations

import json
import os
import pwd
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest

from roadscan.simulate import simulate
from tests.conftest import REPOSITORY
from tests.surveys import small_scene

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(900)]
WAIT_S = 120.0

CLUSTERS = {
    "roadscan": "from roadscan.run.engine.compute_on import embedded as cluster",
    "Dask": "from functools import partial\nfrom distributed import LocalCluster\n"
    "cluster = partial(LocalCluster, threads_per_worker=1, dashboard_address=':0')",
}
NUMBER = {"roadscan": "workers", "Dask": "n_workers"}
SCRIPT = """
{cluster}
if __name__ == "__main__":
    with cluster(**{arguments}):
        print("open", flush=True)
        input()
"""
PLANTED = "from pathlib import Path\nPath({marker!r}).write_text(__name__)\n"
"""Code of another user: it leaves a mark, and would do anything else."""
MODULES = ("pandas", "scipy", "rasterio", "laspy", "shapely", "planted")


@pytest.fixture(scope="module")
def guest() -> Iterator[pwd.struct_passwd]:
    """A second account."""
    if os.geteuid() != 0 or shutil.which("useradd") is None:
        pytest.skip("a second user account is made by root alone, with useradd")
    name = f"rs-guest-{os.getpid()}"
    make = ["useradd", "--system", "--no-create-home", "--shell", "/usr/sbin/nologin", name]
    made = subprocess.run(make, capture_output=True, text=True, check=False)
    if made.returncode:
        pytest.skip(f"no user account can be made here: {made.stderr.strip()}")
    try:
        yield pwd.getpwnam(name)
    finally:
        subprocess.run(["userdel", name], check=True, capture_output=True)


@pytest.fixture
def shared() -> Iterator[Path]:
    """A folder that everyone can enter, as a server's data folder is."""
    folder = Path(tempfile.mkdtemp(prefix="rs-shared-", dir="/tmp"))
    folder.chmod(0o755)
    yield folder
    shutil.rmtree(folder)


def tried(guest: pwd.struct_passwd, folder: Path, ports: list[int], processes: list[int]) -> dict[str, Any]:
    """What the other user gets."""
    asked = {"ports": ports, "folder": str(folder), "processes": processes, "user": guest.pw_uid, "group": guest.pw_gid}
    command = [sys.executable, Path(__file__).with_name("guest.py")]
    done = subprocess.run(command, input=json.dumps(asked), capture_output=True, text=True, check=False, cwd="/")
    assert done.returncode == 0, done.stderr
    got: dict[str, Any] = json.loads(done.stdout)
    assert got["user"] == guest.pw_uid
    return got


@contextmanager
def running(kind: str, folder: Path) -> Iterator[tuple[list[int], list[int]]]:
    """Ports and processes of a cluster of two workers."""
    script = folder / f"cluster_of_{kind}.py"
    script.write_text(SCRIPT.format(cluster=CLUSTERS[kind], arguments={NUMBER[kind]: 2}))
    with subprocess.Popen(
        [sys.executable, script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
    ) as run:  # fmt: skip
        assert run.stdin is not None and run.stdout is not None
        assert run.stdout.readline() == "open\n"
        first = psutil.Process(run.pid)
        tree = [first, *first.children(recursive=True)]
        found = [c for one in tree for c in one.net_connections(kind="inet") if c.status == psutil.CONN_LISTEN]
        yield sorted({c.laddr.port for c in found}), [one.pid for one in tree]
        run.stdin.write("\n")
        run.stdin.flush()
        run.wait(WAIT_S)


def test_no_port_accepts_another_user(guest: pwd.struct_passwd, shared: Path) -> None:
    with running("Dask", shared) as (ports, processes):
        got = tried(guest, shared, ports, processes)
    in_the_clear = [port for port, answers in got["answers"].items() if "in_the_clear" in answers]
    assert len(in_the_clear) == 5, "a cluster as Dask makes it lets everybody in"
    assert len(ports) > 5 and any("web_page" in answers for answers in got["answers"].values())

    with running("roadscan", shared) as (ports, processes):
        got = tried(guest, shared, ports, processes)
    assert len(ports) == 5
    assert got["answers"] == {str(port): {} for port in ports}
    assert got["secrets"] == []


def test_a_survey_made_in_private_stays_private(guest: pwd.struct_passwd, shared: Path) -> None:
    """As docs/security.md says: by `umask 077`, whatever folder it lies in."""
    scene = small_scene(length_m=4.0, lidar={"on": False})
    names = {"public": 0o022, "private": 0o077}
    for name, mask in names.items():
        before = os.umask(mask)
        try:
            made = simulate(scene, shared / name / "survey")
            command = [sys.executable, "-m", "roadscan", "run", str(made.survey_file), "--workers", "2"]
            subprocess.run(command, check=True, capture_output=True, cwd=REPOSITORY)
        finally:
            os.umask(before)
    read = {Path(path).relative_to(shared).parts[0] for path in tried(guest, shared, [], [])["readable"]}
    assert "public" in read and "private" not in read
    (shared / "private").chmod(0o755)  # also where somebody opens the folders above
    (shared / "private" / "survey").chmod(0o755)
    open_to_all = [p for p in (shared / "private").rglob("*") if p.stat().st_mode & 0o077 and p.name != "survey"]
    assert open_to_all == []
    assert not [p for p in tried(guest, shared, [], [])["readable"] if Path(p).is_relative_to(shared / "private")]


def test_code_of_another_user_is_not_loaded(guest: pwd.struct_passwd, shared: Path) -> None:
    """It waits where Dask keeps its temporary files, and in a cache of compiled kernels."""
    temporary, marker = shared / "tmp", shared / "loaded"
    temporary.mkdir()
    temporary.chmod(0o1777)
    usual = temporary / "dask-scratch-space"
    usual.mkdir()
    for module in MODULES:
        (usual / f"{module}.py").write_text(PLANTED.format(marker=str(marker)))
    for place in (usual, *usual.iterdir()):
        os.chown(place, guest.pw_uid, guest.pw_gid)
    usual.chmod(0o777)
    made = simulate(small_scene(length_m=4.0, lidar={"on": False}), shared / "survey")
    command = [sys.executable, "-m", "roadscan", "run", str(made.survey_file), "--workers", "2"]
    environment = os.environ | {"TMPDIR": str(temporary)}
    subprocess.run(command, check=True, capture_output=True, cwd=REPOSITORY, env=environment)
    assert not marker.exists()

    for module in set(MODULES) - {"planted"}:  # Dask itself would stumble over them
        (usual / f"{module}.py").unlink()
    asks = f"{CLUSTERS['Dask']}\nif __name__ == '__main__':\n    with cluster(n_workers=1):\n        import planted\n"
    (shared / "control.py").write_text(asks)
    subprocess.run([sys.executable, shared / "control.py"], check=True, capture_output=True, env=environment)
    assert marker.read_text() == "planted", "a cluster as Dask makes it loads what another user put there"

    cache = shared / "cache"
    cache.mkdir()
    os.chown(cache, guest.pw_uid, guest.pw_gid)
    shutil.rmtree(made.survey_file.parent / "store")  # a run that has nothing to do loads no kernel
    done = subprocess.run(
        command, check=False, capture_output=True, text=True, cwd=REPOSITORY,
        env=os.environ | {"NUMBA_CACHE_DIR": str(cache)},
    )  # fmt: skip
    assert done.returncode == 2 and f"{cache}" in done.stderr and "belongs to another user" in done.stderr
