"""Kernels as plain Python: what coverage, debuggers and other compilers see must say the same."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parents[2]


FEW = (
    "tests/tiles/test_statistics.py::test_robust_height_ignores_loose_stone_and_crack",
    "tests/kernels/test_delta_packing.py",
    "tests/kernels/test_simd.py",
    "tests/kernels/test_cells.py",
    "tests/kernels/test_slot_statistics.py",
)
"""Those that have a twin of their own in plain Python, and a few more."""
ALL = (
    *FEW,
    "tests/core/test_grid.py",
    "tests/poses/test_trajectory.py",
    "tests/georeference/test_place.py",
    "tests/kernels/test_small_kernels.py",
    "tests/kernels/test_cell_figures.py",
    "tests/kernels/test_profile_kernels.py",
    "tests/kernels/test_adjust_kernels.py",
    "tests/kernels/test_asset_kernels.py",
    "tests/kernels/test_natural_neighbour.py",
    "tests/kernels/test_packet_kernels.py",
    "tests/kernels/test_upright_kernels.py",
)


@pytest.mark.parametrize("places", [FEW, pytest.param(ALL, marks=pytest.mark.nightly)], ids=["few", "all"])
def test_kernels_pass_their_tests_without_the_compiler(places: tuple[str, ...]) -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-n0"]
    command += ["-W", "ignore:overflow encountered:RuntimeWarning"]  # of unsigned numbers, as it is meant
    command += [*places, "-k", "not profiles_lie"]
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    found = subprocess.run(command, cwd=HERE, env=environment, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout[-3000:]
