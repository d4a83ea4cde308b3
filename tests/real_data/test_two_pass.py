"""The Boreas passes: a lever arm out of interpolated poses, and stamps in a unit that was not stated."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import lever_arm
import numpy as np
import pytest

from roadscan.core.errors import RunError
from tests.real_data.conftest import Place


def test_the_lever_arm_is_one_length(two_pass: Path) -> None:
    lidar, radar = (lever_arm.trajectory_of(run, two_pass) for run in ("pass1_lidar", "pass1_radar"))
    arms = lever_arm.lever_arms(lidar, radar)
    assert len(arms) > 4_400
    assert arms.length_m.mean() == pytest.approx(0.2100, abs=5e-5)
    assert arms.length_m.std() <= 0.15e-3
    assert (arms.length_m - 0.21).abs().max() <= 1.2e-3
    # T_radar_lidar.txt: the radar sits straight above the lidar.
    assert arms[["forward_m", "right_m", "down_m"]].mean().to_numpy() == pytest.approx([0, 0, -0.21], abs=2e-5)


def test_the_heights_of_the_passes(two_pass: Path) -> None:
    first, second = (lever_arm.trajectory_of(run, two_pass) for run in ("pass1_lidar", "pass2_lidar"))
    dz = lever_arm.height_differences(first, second, two_pass)
    assert len(dz) == 8_218
    assert np.median(dz) == pytest.approx(-0.044, abs=5e-4)
    assert dz.std() == pytest.approx(0.027, abs=5e-4)


def test_nanoseconds_read_as_microseconds_are_refused(place: Place) -> None:
    other_store = {'store = "store"': 'store = "store-trap"'}
    wrong = place.file("two_pass.toml", {'unit = "ns"': 'unit = "us"'} | other_store, "wrong.toml")
    command = [sys.executable, "-m", "roadscan", "ingest", wrong.name]
    done = subprocess.run(command, cwd=place.folder, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 2
    last = done.stderr.strip().splitlines()[-1]
    assert "pass1_radar_poses.csv.gz, record 0: stamp 16281848865515" in last
    assert "read as us of 'unix_utc' falls outside 1980–2080" in last
    assert "as 'ns' it would fit: set clock.unit = \"ns\" if that is so" in last
    assert "Traceback" not in done.stderr
    assert place.records(wrong) == []  # before a log is read
    right = place.file("two_pass.toml", other_store, "right.toml")
    said = place.run(right, "ingest")
    assert [line.split()[:2] for line in said[:3]] == [
        ["read:", "pass1_lidar/trajectory"],
        ["read:", "pass1_radar/trajectory"],
        ["read:", "pass2_lidar/trajectory"],
    ]


def test_the_other_way_round_is_refused_too(place: Place) -> None:
    """Microseconds read as nanoseconds would lie in 1970."""
    changed = {'unit = "us"': 'unit = "ns"', 'store = "store"': 'store = "store-us"'}
    wrong = place.file("two_pass.toml", changed, "wrong-us.toml")
    with pytest.raises(RunError, match=r"2 of 3 logs .* read as ns of 'unix_utc' falls outside 1980–2080"):
        place.run(wrong, "ingest")
