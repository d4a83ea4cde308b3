"""Each benchmark starts and gives figures; those of whole runs to the end, on surveys of some metres."""

from __future__ import annotations

import json
import math
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import benchmarks
from tests.conftest import REPOSITORY

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(1800)]

WHOLE = {
    "line_rate": "pair_m=2 hdl_s=2 sick_s=30 repeats=1 sample_m=0 las_points=100000",
    "network": "network_km=40 network_region_km=20 status_km=1 objects_km=0.3 fleet_surveys=2",
    "parts": "pair_m=2 hdl_s=2 repeats=1",
    "reference_logs": "reference_m=120 reference_runs=2 workers=0",
    "scaling": "scaling_km=0.05,0.1 scaling_spacing_mm=500 repeats=1",
}
"""Settings with which they end soon."""
NAMES = sorted(m.name.removeprefix("bench_") for m in pkgutil.iter_modules(benchmarks.__path__) if "bench_" in m.name)
FIRST = """
import importlib, sys, tempfile
from pathlib import Path
with tempfile.TemporaryDirectory() as folder:
    figure = next(iter(importlib.import_module("benchmarks.bench_" + sys.argv[1]).figures(Path(folder))))
print(figure.value)
"""


@pytest.mark.parametrize("name", WHOLE)
def test_whole_runs_give_all_their_figures(name: str, tmp_path: Path) -> None:
    file, settings = tmp_path / "figures.json", [f"--set={one}" for one in WHOLE[name].split()]
    command = [sys.executable, "-m", "benchmarks", name, "--json", str(file), *settings]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    figures = json.loads(file.read_text())["figures"][name]
    assert figures and all(math.isfinite(one["value"]) for one in figures)


@pytest.mark.parametrize("name", [name for name in NAMES if name not in WHOLE])
def test_the_others_give_their_first(name: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", FIRST, name], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    float(done.stdout.splitlines()[-1])
