"""Values coarser than what is made of them are named, by column and step; fine ones and even motions are not."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from roadscan.cli import app
from roadscan.ingest.resolution import grid_of

Float64 = npt.NDArray[np.float64]
POSES = 300
T = np.arange(POSES) / 50.0
WAY_M = 12.3456 * T + 0.1 * np.sin(2 * T)
FINE: dict[str, Float64] = {
    "x": 500_000.123456 + WAY_M * np.cos(0.7),
    "y": 5_316_302.654321 + WAY_M * np.sin(0.7),
    "z": 300.0 + 0.01234567 * WAY_M + 0.0312 * np.sin(T),
    "roll": 0.5123 * np.sin(3 * T), "pitch": 0.2456 * np.cos(2.1 * T), "heading": 45.678 + np.sin(T),
}  # fmt: skip


def coarse(folder: Path, crs: str, options: str, columns: dict[str, npt.NDArray[Any]]) -> list[str]:
    """What is said of a trajectory table with these columns."""
    folder.mkdir()
    pq.write_table(pa.table({name: pa.array(values) for name, values in columns.items()}), folder / "t.parquet")
    (folder / "SURVEY.toml").write_text(
        'id = "s"\nstore = "store"\n[map]\ncrs = "EPSG:32632"\n[rig.sensors.roof]\nkind = "lidar"\n[[runs]]\nid = "r"\n'
        f'[[runs.logs]]\npath = "t.parquet"\ncrs = "{crs}"\n{options}\n'
    )
    return findings(folder)


def findings(folder: Path) -> list[str]:
    """Texts of the witness."""
    done = CliRunner().invoke(app, ["ingest", str(folder / "SURVEY.toml"), "--json"], catch_exceptions=False)
    return [one["text"] for one in json.loads(done.stdout)["findings"] if one["witness"] == "coarse_values"]


def of(**changed: npt.NDArray[Any]) -> dict[str, npt.NDArray[Any]]:
    """Columns of a table on the grid of UTM."""
    every: dict[str, npt.NDArray[Any]] = FINE | changed
    names = {"x": "easting_m", "y": "northing_m", "z": "height_m"}
    epochs = np.round(1_461_922_218e9 + T * 1e9).astype(np.int64)
    return {"epoch_gps_ns": every.pop("epoch_gps_ns", epochs)} | {
        names.get(name, f"{name}_deg"): values for name, values in every.items()
    }


GRID = 'height = "ellipsoidal"\noptions = { heading = "grid" }'


def test_fine_values_are_not_named(tmp_path: Path) -> None:
    assert coarse(tmp_path / "a", "EPSG:32632", GRID, of()) == []


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"y": FINE["y"].astype(np.float32)}, "the northing is held in steps of 0.5 m"),
        ({"x": np.round(FINE["x"], 1)}, "the easting is held in steps of 0.1 m"),
        ({"roll": np.round(FINE["roll"], 1)}, "the roll is held in steps of 0.1 °"),
        (
            {"epoch_gps_ns": np.round((1_461_922_218 + T * 0.97) * 100).astype(np.int64) * 10_000_000},
            "the stamps are held in steps of 10 ms",
        ),
    ],
)
def test_coarse_columns_of_a_table_are_named(tmp_path: Path, changed: dict[str, Any], words: str) -> None:
    (text,) = coarse(tmp_path / "a", "EPSG:32632", GRID, of(**changed))
    assert words in text and text.count("held in steps") == 1


@pytest.mark.parametrize(
    ("decimals", "step"), [(None, "3.8e-06 ° (0.42 m)"), (5, "1e-05 ° (1.1 m)"), (6, "1e-06 ° (0.11 m)"), (8, "")]
)
def test_degrees(tmp_path: Path, decimals: int | None, step: str) -> None:
    """Latitudes of 32 bits, and with few decimals; eight decimals are a millimetre."""
    degrees = {"latitude_deg": 48.0 + WAY_M / 111_200.0, "longitude_deg": 9.0 + WAY_M / 74_000.0}
    rounded = {n: v.astype(np.float32) if decimals is None else np.round(v, decimals) for n, v in degrees.items()}
    columns = of() | rounded
    del columns["easting_m"], columns["northing_m"]
    found = coarse(tmp_path / "a", "EPSG:4979", "", columns)
    assert bool(found) == bool(step)
    assert all(f"the latitude is held in steps of {step}" in one and "the longitude" in one for one in found)


@pytest.mark.witness("coarse_values")
def test_the_table_of_degrees_with_32_bits(faults: Path, tmp_path: Path) -> None:
    for file in (faults / "float32_degrees").iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    (text,) = findings(tmp_path)
    assert "the latitude is held in steps of 3.8e-06 ° (0.42 m)" in text


@pytest.mark.parametrize(("scale", "words"), [(0.1, "0.1 m"), (0.001, "")])
def test_the_scale_of_a_cloud(faults: Path, tmp_path: Path, scale: float, words: str) -> None:
    for file in (faults / "las_far_point").iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    stated = (tmp_path / "SURVEY.toml").read_text().replace('path = "c.las"', 'path = "c.las"\nheight = "ellipsoidal"')
    (tmp_path / "SURVEY.toml").write_text(stated)
    cloud = laspy.read(tmp_path / "c.las")
    places = np.array(cloud.xyz)
    places[np.abs(places - np.median(places, axis=0)) > 1e5] = 300.0
    cloud.header.scales, cloud.header.offsets = np.full(3, scale), np.array([500_000.0, 5_316_000.0, 0.0])
    cloud.xyz = places
    cloud.write(tmp_path / "c.las")
    assert [words in one for one in findings(tmp_path)] == ([True] if words else [])


def test_an_even_motion_on_a_grid_is_not_rounded() -> None:
    assert grid_of(np.arange(100) * 0.5) == (10.0, False) or grid_of(np.arange(100) * 0.5)[1] is False
    assert grid_of(np.full(100, 9.0)) == (0.0, False)
    rng = np.random.default_rng(1)
    assert grid_of(rng.uniform(0, 10, 500)) == (0.0, False)
    step, jumps = grid_of(np.round(rng.uniform(0, 10, 500), 2))
    assert step == pytest.approx(0.01) and jumps
