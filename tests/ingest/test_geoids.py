"""Geoid grids of one file name: each survey and each log counts its heights from its own, whatever ran before."""

from __future__ import annotations

import gzip
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest
from distributed import LocalCluster
from typer.testing import CliRunner

from roadscan.cli import app

pytestmark = pytest.mark.slow

UNDULATION_M = {"a": 45.0, "b": 40.0}
"""Of the grid `region.gtx` of each survey."""
EAST_M, NORTH_M, HEIGHT_M = 500_000.0, 5_316_000.0, 300.0


@pytest.fixture
def two(faults: Path, tmp_path: Path) -> Path:
    """Folder of two surveys of one road, whose grids have one name and different undulations."""
    for name in UNDULATION_M:
        source, target = faults / "geoid_same_name" / name, tmp_path / name
        (target / "g").mkdir(parents=True)
        for file in ("SURVEY.toml", "t.csv", "r.parquet"):
            shutil.copyfile(source / file, target / file)
        (target / "g/region.gtx").write_bytes(gzip.decompress((source / "g/region.gtx.gz").read_bytes()))
    return tmp_path


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    """Address of a Dask cluster with one worker, which outlives the runs."""
    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        yield str(cluster.scheduler_address)


def run(folder: Path, *more: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["run", str(folder / "SURVEY.toml"), "--json", *(more or ("--workers", "0"))])
    return result.exit_code, f"{result.output}{result.stderr}{result.exception or ''}"


def las_height_m(folder: Path) -> float:
    """Median height of the LAS products."""
    files = sorted((folder / "store").rglob("*.la[sz]"))
    return float(np.median(np.concatenate([laspy.read(file).z for file in files])))


def of_a_b(folder: Path, *more: str) -> list[float]:
    found = []
    for name in UNDULATION_M:
        code, output = run(folder / name, *more)
        assert code == 0, output
        found.append(las_height_m(folder / name))
    return found


def test_two_surveys_of_one_process_have_their_own_grids(two: Path) -> None:
    a, b = of_a_b(two)
    assert b - a == pytest.approx(5.0, abs=2e-3)


def test_two_surveys_on_one_worker_have_their_own_grids(two: Path, scheduler: str) -> None:
    a, b = of_a_b(two, "--scheduler", scheduler)
    assert b - a == pytest.approx(5.0, abs=2e-3)


@pytest.mark.witness("geoid_grid")
def test_a_missing_grid_is_not_another_surveys(two: Path) -> None:
    assert run(two / "a")[0] == 0
    (two / "b/g/region.gtx").unlink()
    code, output = run(two / "b")
    assert code != 0
    assert "geoid grid 'region.gtx' was not found" in output
    assert str((two / "b/g").resolve()) in output


def test_a_grid_of_elsewhere_is_refused_whatever_ran_before(two: Path) -> None:
    assert run(two / "a")[0] == 0
    constant_grid(two / "b/g/region.gtx", 40.0, south_deg=-40.0)
    code, output = run(two / "b")
    assert code != 0
    assert "geoid grid 'region.gtx' does not cover longitude 9.000" in output


def test_a_replaced_grid_is_another_grid(two: Path) -> None:
    assert run(two / "a")[0] == 0
    before = las_height_m(two / "a")
    grid = two / "a/g/region.gtx"
    stat = grid.stat()
    constant_grid(grid, 40.0, south_deg=47.5)
    assert grid.stat().st_size == stat.st_size
    assert run(two / "a")[0] == 0
    assert las_height_m(two / "a") - before == pytest.approx(5.0, abs=2e-3)


def test_grids_of_one_name_within_a_survey(tmp_path: Path) -> None:
    """A cloud's heights above one `region.gtx` go to the map's `region.gtx` by way of the ellipsoid."""
    for folder, undulation_m in (("old", 45.0), ("new", 40.0)):
        (tmp_path / folder).mkdir()
        constant_grid(tmp_path / folder / "region.gtx", undulation_m, south_deg=47.5)
    cloud(tmp_path / "cloud.las")
    (tmp_path / "SURVEY.toml").write_text(
        f"""id = "s"
[map]
crs = "EPSG:32632"
height = "orthometric"
geoid = "region.gtx"
grids = "new"
[products]
make = ["las"]
[[runs]]
id = "r"
[[runs.logs]]
path = "cloud.las"
crs = "EPSG:32632"
height = "orthometric"
geoid = {json.dumps(str(tmp_path / "old/region.gtx"))}
""",
        encoding="utf-8",
    )
    code, output = run(tmp_path)
    assert code == 0, output
    assert las_height_m(tmp_path) == pytest.approx(HEIGHT_M + 45.0 - 40.0, abs=1e-3)


def constant_grid(file: Path, undulation_m: float, south_deg: float) -> None:
    """GTX of one undulation, 1° from `south_deg` and 8.5° on: of the size and layout of the surveys' own grids."""
    with file.open("wb") as stream:
        np.array([south_deg, 8.5, 0.01, 0.01], dtype=">f8").tofile(stream)
        np.array([101, 101], dtype=">i4").tofile(stream)
        np.full(101 * 101, undulation_m, dtype=">f4").tofile(stream)


def cloud(file: Path) -> None:
    """A LAS file of some flat points that says its horizontal CRS only."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 1e-3), np.array([EAST_M, NORTH_M, 0.0])
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.add_crs(pyproj.CRS("EPSG:32632"), keep_compatibility=False)
    points = laspy.LasData(header)
    step = np.arange(400)
    points.x, points.y, points.z = EAST_M + step % 20 * 0.1, NORTH_M + step // 20 * 0.1, np.full(400, HEIGHT_M)
    points.gps_time = 4e8 + 0.01 * step
    points.write(str(file))
