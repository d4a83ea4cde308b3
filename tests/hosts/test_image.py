"""The image of deploy/Containerfile, and a root with this machine's Python and the wheel, which needs no builder.

Both are entered as a user without rights, with a read-only root. The image is skipped in words without a builder, or
where its base cannot be had. `ROADSCAN_PYTHON_IMAGE` names another base, and `ROADSCAN_BUILD_ARGUMENTS` goes to the
builder (such as `--secret id=pip,src=/etc/pip.conf`).
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from packaging.utils import canonicalize_name

from tests.conftest import REPOSITORY
from tests.hosts.host import Host, network
from tests.test_project import PINNED

CONTAINERFILE = (REPOSITORY / "deploy" / "Containerfile").read_text()
MOST_BYTES = 2_000_000_000
"""Of the image, with its base: pyarrow, LLVM, OpenCV, SciPy, DuckDB and GDAL are two thirds of it."""


def test_no_address_of_a_package_host_is_in_the_file() -> None:
    assert re.findall(r"https?://|index-url|docker\.io|ghcr\.io|quay\.io", CONTAINERFILE) == []


class Entered(NamedTuple):
    """A host with the root of an image, or with a root made of this machine's Python."""

    host: Host
    environment: dict[str, str]
    built: Path | None

    def __call__(self, *command: str, code: int = 0) -> str:
        with self.host.running(command, self.environment, "command") as running:
            assert running.ended(900.0) == code, running.said()
        return running.said()


def builder_with_base() -> tuple[str, str] | str:
    """A program that builds images and a base that it has or can fetch; else what is missing."""
    named = re.search(r"^ARG PYTHON=(\S+)", CONTAINERFILE, flags=re.M)
    assert named is not None
    base = os.environ.get("ROADSCAN_PYTHON_IMAGE", named[1])
    program = shutil.which("podman")
    if program is None:
        return "there is no podman"
    for tried in (["image", "exists", base], ["pull", "--quiet", base]):
        if subprocess.run([program, *tried], capture_output=True, check=False, timeout=600).returncode == 0:
            return program, base
    return f"{base} cannot be fetched"


def built_image(program: str, base: str) -> Path:
    """Root of the image, built now (layers that stand are taken)."""
    further = shlex.split(os.environ.get("ROADSCAN_BUILD_ARGUMENTS", ""))
    command = [
        program,
        "build",
        "--isolation",
        "chroot",
        "--network",
        "host",
        "--build-arg",
        f"PYTHON={base}",
        *further,
    ]
    command += ["--ignorefile", ".containerignore", "--tag", "roadscan-of-tests", "--file", "deploy/Containerfile", "."]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    mounted = subprocess.run(
        [program, "image", "mount", "roadscan-of-tests"], capture_output=True, text=True, check=True
    )
    return Path(mounted.stdout.strip())


@pytest.fixture(scope="module", params=["image", "chroot"])
def entered(
    request: pytest.FixtureRequest, hosts_possible: None, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Entered]:
    """The image's root; and one that needs no builder, which holds Python and the wheel."""
    folder = tmp_path_factory.mktemp(request.param)
    image = None
    stated = re.search(r"^ENV (.*?)^USER", CONTAINERFILE, flags=re.M | re.DOTALL)
    assert stated is not None
    environment = dict(re.findall(r"(\w+)=(\S+)", stated[1])) | {"LANG": "C.UTF-8"}
    if request.param == "image":
        found = builder_with_base()
        if isinstance(found, str):
            pytest.skip(f"no image is built: {found}")
        image = built_image(*found)
        environment["PATH"] = "/opt/roadscan/bin:/usr/local/bin:/usr/bin:/bin"
    else:
        command = [
            sys.executable,
            "-m",
            "pip",
            "wheel",
            "--quiet",
            "--no-deps",
            "--wheel-dir",
            str(folder),
            str(REPOSITORY),
        ]
        subprocess.run(command, check=True, capture_output=True)
        with zipfile.ZipFile(next(folder.glob("*.whl"))) as wheel:
            wheel.extractall(folder / "wheel")
        environment |= {"PATH": f"{Path(sys.executable).parent}:/usr/bin:/bin", "PYTHONPATH": "/opt/wheel"}
    with network(folder / "hosts") as net:
        host = net.host("alone", image)
        host.give("/srv/roadscan", host.made("surveys"))
        if image is None:
            host.only_read.add("/opt/wheel")
            host.give("/opt/wheel", folder / "wheel")
        yield Entered(host, environment, image)
        if image is not None:
            subprocess.run(["podman", "image", "unmount", "roadscan-of-tests"], check=False, capture_output=True)


@pytest.mark.nightly
@pytest.mark.timeout(1800)
def test_it_runs_the_demo_without_rights_and_on_a_read_only_root(entered: Entered) -> None:
    assert entered("id", "-u").strip() == "10001"
    assert "Read-only file system" in entered("touch", "/usr/x", code=1)
    program = "import roadscan.flows.survey; print(roadscan.flows.survey.__file__)"
    where = entered("python", "-c", program).strip()
    assert where.startswith("/opt/"), where
    said = entered("python", "-m", "roadscan", "demo", "--out", "/srv/roadscan/demo")
    assert re.search(r"^failed +nothing$", said, flags=re.M), said
    made = list((entered.host.folder / "surveys" / "demo").rglob("*.laz"))
    assert made


@pytest.mark.nightly
def test_the_image_is_small_and_holds_pinned_versions_alone(entered: Entered) -> None:
    if entered.built is None:
        pytest.skip("of the image alone")
    program = "import importlib.metadata as m, json; print(json.dumps({d.name: d.version for d in m.distributions()}))"
    found = {canonicalize_name(name): version for name, version in json.loads(entered("python", "-c", program)).items()}
    found.pop("roadscan")
    assert {name: version for name, version in found.items() if PINNED.get(name) != version} == {}
    listed = subprocess.run(
        ["podman", "image", "inspect", "--format", "{{.Size}} {{.User}}", "roadscan-of-tests"],
        capture_output=True, text=True, check=True,
    ).stdout.split()  # fmt: skip
    assert int(listed[0]) < MOST_BYTES
    assert listed[1] == "10001:10001"
