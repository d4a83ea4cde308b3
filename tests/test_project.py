"""The project's own machinery: pinned versions, make targets, import contracts."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

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


REQUIREMENTS = [*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["dev"]]


@pytest.mark.parametrize("text", REQUIREMENTS)
def test_every_dependency_is_pinned_within_its_range(text: str) -> None:
    requirement = Requirement(text)
    assert requirement.specifier.contains(PINNED[canonicalize_name(requirement.name)])


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
