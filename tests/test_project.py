"""The project's own machinery: pinned versions, make targets, import contracts."""

from __future__ import annotations

import importlib.metadata
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.house.figures import private_names

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PINNED = {
    canonicalize_name(name): version
    for name, _, version in (
        line.partition("==") for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")
    )
}


def test_constraints_are_names_and_versions_only() -> None:
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    assert len(lines) > 100
    assert [line for line in lines if not re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.!+]+", line)] == []


EXTRAS = PROJECT["optional-dependencies"]
REQUIREMENTS = [
    text
    for text in dict.fromkeys(
        [*PROJECT["dependencies"], *(one for name in EXTRAS if name != "s3" for one in EXTRAS[name])]
    )
    if Requirement(text).name != PROJECT["name"]
]


@pytest.mark.parametrize("text", REQUIREMENTS)
def test_every_dependency_is_pinned_within_its_range(text: str) -> None:
    requirement = Requirement(text)
    assert requirement.specifier.contains(PINNED[canonicalize_name(requirement.name)])


REQUIRED = {
    "blake3", "cryptography", "dask", "distributed", "duckdb", "fsspec", "isal", "jinja2", "laspy", "numba", "numpy",
    "pandas", "pillow", "prefect", "prometheus-client", "psutil", "pyarrow", "pydantic", "pyogrio", "pyproj", "pyyaml",
    "qdldl", "rasterio", "rich", "scipy", "shapely", "typer",
}  # fmt: skip
"""What every installation has. Whatever only some surveys need belongs to an extra (`roadscan/core/extras.py`)."""
MOST_DISTRIBUTIONS = 140
"""Beside roadscan in an installation without extras, required directly or not; Prefect and Dask alone are 119."""
OF_OLD_PYTHON = {"async-timeout"}
"""What Python before 3.11.3 needs beside these."""


def test_required_packages_are_these() -> None:
    assert {Requirement(text).name for text in PROJECT["dependencies"]} == REQUIRED


def test_an_installation_has_few_distributions() -> None:
    waiting = [
        (canonicalize_name(r.name), extra)
        for r in map(Requirement, PROJECT["dependencies"])
        for extra in ("", *r.extras)
    ]
    found: set[tuple[str, str]] = set()
    while waiting:
        one = waiting.pop()
        if one not in found:
            found.add(one)
            for required in map(Requirement, importlib.metadata.requires(one[0]) or ()):
                if required.marker is None or required.marker.evaluate({"extra": one[1]}):
                    waiting += [(canonicalize_name(required.name), extra) for extra in ("", *required.extras)]
    assert len({name for name, _ in found} - OF_OLD_PYTHON) <= MOST_DISTRIBUTIONS


def test_nothing_has_an_upper_bound() -> None:
    """A newer Numba too: one file imports its internals, and changes nothing of a Numba that was not read."""
    assert [text for text in REQUIREMENTS if re.search(r"<|==|~=", text)] == []
    assert private_names()["files with private names of Numba"] == 1


def test_prefect_still_holds_fastapi_back() -> None:
    """Fails when Prefect allows FastAPI 0.165: then the sentence beside `prefect` in pyproject.toml is to go."""
    bounds = [Requirement(text) for text in importlib.metadata.requires("prefect") or ()]
    (bound,) = (one for one in bounds if canonicalize_name(one.name) == "fastapi")
    assert not bound.specifier.contains("0.165.0")
    assert "holds FastAPI below 0.151" in (ROOT / "pyproject.toml").read_text()
    assert bound.specifier.contains("0.150.0") and not bound.specifier.contains("0.151.0")


def test_the_wheel_installs_roadscan_and_nothing_beside_it() -> None:
    """What hatchling is told; `make nightly` builds one."""
    target = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert target["packages"] == ["roadscan"]
    assert all(inside.startswith("roadscan/") for inside in target["force-include"].values())
    assert (ROOT / "roadscan" / "flows").resolve() == ROOT / "flows"


@pytest.mark.nightly
def test_a_wheel_works_without_the_repository(tmp_path: Path) -> None:
    """Built by pip, unpacked into a folder of its own: one package, and the flows in it."""
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(tmp_path), str(ROOT)]
    subprocess.run(command, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as files:
        assert {name.partition("/")[0].partition("-")[0] for name in files.namelist()} == {"roadscan"}
        files.extractall(tmp_path / "installed")
    program = (
        "import importlib.util, roadscan.flows.survey, roadscan.flows.reprocess, roadscan.flows.compare\n"
        "from roadscan.store.schema import table_schema\n"
        "table_schema('scans')\n"
        "print(importlib.util.find_spec('flows'), roadscan.flows.survey.__file__)"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", _WITHOUT_CHECKOUT + program], env={"PYTHONPATH": str(tmp_path / "installed")},
        cwd=tmp_path, check=True, capture_output=True, text=True,
    )  # fmt: skip
    assert done.stdout.split() == ["None", str(tmp_path / "installed" / "roadscan" / "flows" / "survey.py")]


_WITHOUT_CHECKOUT = f"import sys\nsys.path = [p for p in sys.path if p != {str(ROOT)!r}]\n"
"""An editable installation puts the checkout on the path."""


def test_hooks_call_make_targets_that_exist() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE))
    assert {"demo", "test", "bench", "lint", "docs", "clean"} <= targets
    config = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())
    (repository,) = config["repos"]
    assert repository["repo"] == "local"
    called = {hook["entry"].removeprefix("make ") for hook in repository["hooks"]}
    assert called <= targets
    # Together the hooks are what CI runs.
    checks = re.search(r"^check: (.*?)  ##", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)
    assert checks is not None
    assert called == {*checks[1].split(), "pytest"}


VIOLATIONS = {
    "a feature after it": ("roadscan/formats/zz.py", "from roadscan.tiles import cells", "Order of the features"),
    "upward": ("roadscan/navigation/zz.py", "from roadscan.georeference import cloud", "Order of the features"),
    "dask in a feature": ("roadscan/tiles/zz.py", "import dask.array", "Only flows and the engine know Dask"),
    "prefect in a feature": ("roadscan/survey/zz.py", "import prefect", "Only flows and the command line know Prefect"),
    "files in kernels": ("roadscan/tiles/kernels/zz.py", "import pyarrow as pa", "Kernels see arrays only"),
    "bytes in a feature": ("roadscan/site/zz.py", "import zlib", "Codecs alone know the bytes"),
    "shared rotations": (
        "roadscan/simulate/zz.py",
        "from roadscan.core import frames",
        "The simulator turns with SciPy",
    ),
    "shared geometry": (
        "roadscan/simulate/zz.py",
        "from roadscan.georeference import place",
        "The simulator knows values alone",
    ),
}


def contracts(folder: Path) -> subprocess.CompletedProcess[str]:
    command = [str(Path(sys.executable).parent / "lint-imports"), "--no-logo", "--no-cache"]
    return subprocess.run(
        command, cwd=folder, env={"PYTHONPATH": str(folder), "PATH": ""}, capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="module")
def copied(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("house")
    shutil.copy(ROOT / "pyproject.toml", folder)
    shutil.copytree(ROOT / "roadscan", folder / "roadscan", ignore=shutil.ignore_patterns("__pycache__"))
    return folder


def test_import_contracts_are_kept(copied: Path) -> None:
    outcome = contracts(copied)
    assert outcome.returncode == 0, outcome.stdout + outcome.stderr


def test_import_contracts_catch_what_they_forbid(copied: Path) -> None:
    """All at once: reading the imports takes longest. Each contract has to name its own file."""
    for number, (file, line, _) in enumerate(VIOLATIONS.values()):
        (copied / file).with_name(f"zz{number}.py").write_text(f'"""Violation."""\n\n{line}\n')
    outcome = contracts(copied)
    assert outcome.returncode == 1, outcome.stdout + outcome.stderr
    told = dict(
        re.findall(r"^(\S[^\n]*)\n-+\n(.*?)(?=^\S[^\n]*\n-+\n|\Z)", outcome.stdout, flags=re.MULTILINE | re.DOTALL)
    )
    for number, (file, _, contract) in enumerate(VIOLATIONS.values()):
        assert re.search(rf"^{contract}.* BROKEN", outcome.stdout, flags=re.MULTILINE), outcome.stdout
        (named,) = (text for title, text in told.items() if title.startswith(contract))
        assert f"{Path(file).with_name(f'zz{number}').as_posix().replace('/', '.')} -> " in named, outcome.stdout
