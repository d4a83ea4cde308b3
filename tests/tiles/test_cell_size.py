"""Cell sizes that are proposed: by `init` from the sensors' rates, and after a run from what the cells hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from roadscan.arrays import write_profiles, write_returns, write_trajectory
from roadscan.cli import app
from roadscan.ingest.inspect.first_cell_size import EDGES_M, cell_edge_m

FIRST_NS = 1_461_922_218_000_000_000
SURVEY = """
id = "sparse"
map = {{ crs = "EPSG:25832" }}
rig.sensors.profiler = {{ kind = "profiler" }}
products.make = ["tile_table"]
{tiles}
[[runs]]
id = "drive"
logs = [{{ path = "poses.parquet" }}, {{ path = "scans.parquet", sensor = "profiler" }}]
"""


def write_poses(folder: Path, speed: float, seconds: float) -> None:
    """Northwards on the map."""
    t = np.arange(round(seconds * 20) + 1) / 20
    poses = {"epoch_gps_ns": FIRST_NS + np.rint(t * 1e9).astype(np.int64), "easting_m": np.full(t.size, 500_005.0)}
    poses |= {"northing_m": 5_300_000 + speed * t, "height_m": np.full(t.size, 102.0)}
    poses |= dict.fromkeys(("roll_deg", "pitch_deg", "heading_deg"), np.zeros(t.size))
    write_trajectory(poses, folder / "poses.parquet", "EPSG:25832", heading="grid")


def said(*arguments: str) -> str:
    outcome = CliRunner().invoke(app, [*arguments])
    assert outcome.exit_code == 0, (outcome.output, outcome.exception)
    return " ".join((outcome.output + outcome.stderr).split())


def test_cells_of_one_reading_are_told_and_the_size_that_is_proposed_holds_enough(tmp_path: Path) -> None:
    """Readings on a lattice of 0.1 m: a cell of 0.1 m holds one, one of 0.2 m four."""
    write_poses(tmp_path, 1.0, 9.0)
    at = np.arange(0.53, 8.5, 0.1)
    epochs = FIRST_NS + np.rint(at * 1e9).astype(np.int64)
    heights = np.full((at.size, 31), -2.0) + 0.001 * np.arange(31)
    write_profiles(tmp_path / "scans.parquet", epochs, heights, np.arange(31) * 0.1 - 1.47, quantum=1e-4)
    survey = tmp_path / "SURVEY.toml"

    survey.write_text(SURVEY.format(tiles=""))
    told = "cells of 0.05 m hold 1 reading each where half of all readings lie (median); cell_m = 0.2 in [tiles], which"
    assert told in said("run", str(survey), "--workers", "0")
    assert "would hold 4" in said("status", str(survey))

    survey.write_text(SURVEY.format(tiles="tiles = { cell_m = 0.1 }"))
    assert "cells of 0.1 m hold 1 reading each" in said("run", str(survey), "--workers", "0")

    survey.write_text(SURVEY.format(tiles="tiles = { cell_m = 0.2 }"))
    assert "would hold" not in said("run", str(survey), "--workers", "0")
    assert "would hold" not in said("status", str(survey))


def vlp16(seconds: float, speed: float) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (n,) in s and returns (n, 3) of a VLP-16 (16 lasers, −15° to 15°, 10 Hz, 0.2°), 2 m over flat ground."""
    turns, columns = 10, 1800
    column = np.repeat(np.arange(round(seconds * turns * columns)), 16)
    elevation = np.radians(np.tile(np.arange(-15.0, 16.0, 2.0), column.size // 16))
    azimuth = 2 * np.pi * column / columns
    distance = np.where(elevation < 0, np.minimum(2.0 / np.sin(np.maximum(-elevation, 1e-3)), 100.0), 60.0)
    flat = distance * np.cos(elevation)
    xyz = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)], axis=-1)
    return column / (turns * columns), xyz


def median_readings(stamps: np.ndarray, xyz: np.ndarray, speed: float, edge: float) -> float:
    """Of the cells with a reading of a stretch of the road, 20 m wide."""
    ground = xyz[:, 2] < -1.9
    place = xyz[ground, :2] + np.outer(speed * stamps[ground], [1.0, 0.0])
    middle = speed * stamps.max() / 2
    road = place[(np.abs(place[:, 0] - middle) < 5) & (np.abs(place[:, 1]) < 10)]
    return float(np.median(np.unique(np.floor(road / edge), axis=0, return_counts=True)[1]))


@pytest.mark.slow
def test_init_proposes_a_size_whose_cells_hold_enough_returns_of_a_lidar(tmp_path: Path) -> None:
    speed, (stamps, xyz) = 10.0, vlp16(12.0, 10.0)
    begun = stamps < 1.0
    (tmp_path / "logs").mkdir()
    write_poses(tmp_path / "logs", speed, 12.0)
    epochs = FIRST_NS + np.rint(stamps * 1e9).astype(np.int64)
    write_returns(tmp_path / "logs" / "roof.parquet", epochs[begun], xyz[begun])
    said("init", str(tmp_path / "logs"), "--out", str(tmp_path / "logs" / "SURVEY.toml"))
    text = (tmp_path / "logs" / "SURVEY.toml").read_text()
    assert "# Cells of 0.1 m would hold some 4 readings of roof.parquet" in text
    assert "# [tiles]\n# cell_m = 0.1\n" in text
    # Counted on the ground, not estimated from the rate.
    assert median_readings(stamps, xyz, speed, 0.1) >= 4 > median_readings(stamps, xyz, speed, 0.05)


def test_init_proposes_fine_cells_for_a_fine_profiler(tmp_path: Path) -> None:
    """Profiles of 1 mm, 2 mm apart: 5 mm hold more than four."""
    write_poses(tmp_path, 10.0, 2.0)
    epochs = FIRST_NS + np.arange(2000) * 200_000
    write_profiles(tmp_path / "scans.parquet", epochs, np.full((2000, 100), -2.0), np.arange(100) / 1000)
    said("init", str(tmp_path), "--out", str(tmp_path / "SURVEY.toml"))
    text = (tmp_path / "SURVEY.toml").read_text()
    assert "# [tiles]\n# cell_m = 0.005\n" in text


@pytest.mark.parametrize(
    ("across_m", "along_m", "edge"),
    [(0.001, 0.002, 0.005), (0.05, 0.05, 0.1), (0.001, 0.2, 0.2), (0.3, 0.001, 0.5), (3.0, 3.0, 1.0)],
)
def test_the_rule(across_m: float, along_m: float, edge: float) -> None:
    assert cell_edge_m(across_m, along_m) == edge
    assert all(abs(10 / e / 2 - round(10 / e / 2)) < 1e-9 for e in EDGES_M)
