"""Nothing that is read is unpickled or executed: the sources hold no call that would, and pickles are not opened."""

from __future__ import annotations

import ast
import pickle
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import roadscan
from roadscan import flows
from roadscan.cli import app

FORBIDDEN_NAMES = {"eval", "exec", "execfile", "__import__"}
FORBIDDEN_MODULES = {
    "pickle", "cPickle", "cloudpickle", "dill", "joblib", "marshal", "shelve", "torch", "code", "runpy",
}  # fmt: skip
FORBIDDEN_CALLS = {
    "unsafe_load", "full_load", "read_pickle", "to_pickle", "unpickle", "load_module", "exec_module", "fromfile_pickle",
}  # fmt: skip
SOURCES = [file for package in (roadscan, flows) for file in sorted(Path(str(package.__file__)).parent.rglob("*.py"))]


def executes(tree: ast.AST) -> list[str]:
    """What in a module would execute data."""
    found: list[str] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [one.name for one in node.names if one.name.split(".")[0] in FORBIDDEN_MODULES]
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in FORBIDDEN_MODULES:
            found.append(str(node.module))
        elif isinstance(node, ast.Call):
            name = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
            if (isinstance(node.func, ast.Name) and name in FORBIDDEN_NAMES) or name in FORBIDDEN_CALLS:
                found.append(name)
            shells = [k for k in node.keywords if k.arg == "shell"]
            pickles = [k for k in node.keywords if k.arg == "allow_pickle"]
            found += [f"{k.arg} at line {node.lineno}" for k in shells + pickles if getattr(k.value, "value", 1)]
            base = node.func.value if isinstance(node.func, ast.Attribute) else None
            if isinstance(base, ast.Name) and base.id == "yaml" and name != "safe_load":
                found.append(f"yaml.{name}")
            if name == "system" and isinstance(base, ast.Name) and base.id == "os":
                found.append("os.system")
    return found


@pytest.mark.slow
def test_no_source_unpickles_or_executes_data() -> None:
    assert len(SOURCES) > 300
    found = {str(file): executes(ast.parse(file.read_text(encoding="utf-8"))) for file in SOURCES}
    assert {file: names for file, names in found.items() if names} == {}


@pytest.mark.parametrize(
    "line",
    ["import pickle", "from torch import load", "eval(text)", "np.load(f, allow_pickle=True)", "pd.read_pickle(f)",
     "subprocess.run(text, shell=True)", "os.system(text)",
     "yaml.load(text)"],
)  # fmt: skip
def test_the_search_finds_such_calls(line: str) -> None:
    assert executes(ast.parse(line))


class Bomb:
    """Writes a file where it is unpickled."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple[object, ...]:
        return (Path.touch, (self.target,))


@pytest.mark.parametrize("name", ["log.pkl", "log.npy", "log.npz", "log.parquet", "log.csv", "log.laz", "SURVEY.toml"])
def test_pickles_under_any_name_are_not_opened(tmp_path: Path, name: str) -> None:
    target, logs = tmp_path / "exploded", tmp_path / "logs"
    logs.mkdir()
    bomb = np.empty(1, object)
    bomb[0] = Bomb(target)
    file = logs / name
    if name.endswith(".npy"):
        np.save(file, bomb, allow_pickle=True)
    elif name.endswith(".npz"):
        np.savez(file, positions=bomb)
    else:
        file.write_bytes(pickle.dumps(Bomb(target)))
    for command in (
        ["inspect", str(file)],
        ["init", str(logs), "--out", str(tmp_path / "S.toml")],
        ["status", str(file)],
    ):
        CliRunner().invoke(app, command)
    assert not target.exists()
    pickle.loads(pickle.dumps(Bomb(target)))  # it would
    assert target.exists()
