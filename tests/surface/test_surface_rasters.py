"""`surface_mosaic` and `surface_hillshade`: every pixel of the tiles' surfaces, and light on them, over all borders."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import rasterio
from typer.testing import CliRunner

from roadscan.arrays import write_profiles, write_trajectory
from roadscan.cli import app
from roadscan.store.codecs.cog import without_place_warning

SURVEY = """
id = "road"
map = {{ crs = "EPSG:25832" }}
rig.sensors.profiler = {{ kind = "profiler", lever_arm_body_m = [0.0, 0.0, 0.0] }}
tiles = {{ cell_m = 0.04 }}
surface = {surface}

[[runs]]
id = "drive"
logs = [{{ path = "poses.parquet" }}, {{ path = "scans.parquet", sensor = "profiler" }}]

[products]
make = ["surface_mosaic", "surface_hillshade"]
options.surface = {{ bands = ["origin", "height"] }}
options.surface_mosaic = {{ bands = ["height", "origin"], sheet_m = {sheet_m} }}
options.surface_hillshade = {{ sheet_m = {sheet_m}, picture_px = 200 }}
"""


def write_logs(folder: Path) -> None:
    """12 m to the north-east over the corner of four tiles: a road with a rut, a bump and a hole without readings."""
    along = np.arange(0, 121) / 10
    eastwards = (along - 6.0) * np.sqrt(0.5)
    poses = pd.DataFrame({"epoch_gps_ns": 1_461_922_218_000_000_000 + np.arange(121) * 10_000_000})
    poses = poses.assign(easting_m=500_000 + eastwards, northing_m=5_300_000 + eastwards, height_m=302.0)
    poses = poses.assign(roll_deg=0.0, pitch_deg=0.0, heading_deg=45.0)
    write_trajectory(poses, folder / "poses.parquet", "EPSG:25832", heading="grid")
    across = np.linspace(-1.5, 1.5, 151)
    at = np.arange(1.0, 11.0, 0.02)
    epochs = 1_461_922_218_000_000_000 + np.rint(at * 1e8).astype(np.int64)
    heights = -2.0 - 0.02 * np.exp(-(((across - 0.5) / 0.2) ** 2)) + 0.05 * np.exp(-((at[:, None] - 6.0) ** 2))
    heights[np.hypot(at[:, None] - 6.3, across) < 0.5] = np.nan
    write_profiles(folder / "scans.parquet", epochs, heights, across)


def opened(folder: Path, stem: str) -> tuple[np.ndarray, rasterio.Affine, float]:
    """Pixels of a product's raster, by its index where it is cut into sheets."""
    path = folder / f"{stem}.vrt"
    with rasterio.open(path if path.exists() else folder / f"{stem}.tif") as raster:
        assert raster.crs == "EPSG:25832"
        assert raster.overviews(1) or max(raster.shape) <= 128
        return raster.read(1), raster.transform, raster.nodata


def pixel(place: rasterio.Affine, easting: float, northing: float) -> tuple[float, float]:
    """Column and row of a place of a raster that is north up."""
    return (easting - place.c) / place.a, (northing - place.f) / place.e


def shaded(heights: np.ndarray, cell: tuple[float, float]) -> np.ndarray:
    """Horn's hillshade (light from 315°, 45° high, heights three times) where all nine heights are known."""
    a, b, c = heights[:-2, :-2], heights[:-2, 1:-1], heights[:-2, 2:]
    d, f = heights[1:-1, :-2], heights[1:-1, 2:]
    g, h, i = heights[2:, :-2], heights[2:, 1:-1], heights[2:, 2:]
    east = 3 * ((c + 2 * f + i) - (a + 2 * d + g)) / (8 * cell[0])
    north = 3 * ((a + 2 * b + c) - (g + 2 * h + i)) / (8 * cell[1])
    light = np.array([-0.5, 0.5, np.sqrt(0.5)])  # towards the north-west, 45° up
    normal = np.stack([-east, -north, np.ones_like(east)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.rint(1 + 254 * np.maximum(normal @ light, 0))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("surface", "sheet_m", "cell"),
    [
        ('{ method = "cells", sigma_m = 0.002 }', 100, (0.04, 0.04)),
        (
            '{ method = "points", sigma_m = 0.002, fill_m = 0.0, max_gap_m = 0.2, cell_m = [0.03, 0.04] }',
            10,
            (0.03, 0.04),
        ),
    ],
    ids=["one sheet", "four sheets of cells that divide no tile"],
)
def test_pixels_are_those_of_the_tiles(tmp_path: Path, surface: str, sheet_m: int, cell: tuple[float, float]) -> None:
    write_logs(tmp_path)
    survey = tmp_path / "SURVEY.toml"
    survey.write_text(SURVEY.format(surface=surface, sheet_m=sheet_m))
    outcome = CliRunner().invoke(app, ["run", str(survey), "--workers", "0"])
    assert outcome.exit_code == 0, outcome.output
    root = tmp_path / "store" / "survey=road"
    mosaic, shade = root / "products" / "surface_mosaic", root / "products" / "surface_hillshade"
    assert len(list(mosaic.glob("height*.tif"))) == (1 if sheet_m == 100 else 4)

    heights, place, nodata = opened(mosaic, "height")
    origin = opened(mosaic, "origin")[0]
    assert (place.a, -place.e) == cell
    assert np.isnan(nodata)
    left = np.ones(heights.shape, dtype=bool)
    tiles = list((root / "tiles" / "surface").glob("*.tif"))
    assert len(tiles) == 4
    for file in tiles:
        with rasterio.open(file) as tile:
            column, row = pixel(place, tile.transform.c, tile.transform.f)
            assert abs(column - round(column)) + abs(row - round(row)) < 1e-6
            own = slice(round(row), round(row) + tile.height), slice(round(column), round(column) + tile.width)
            assert tile.read(2).tobytes() == heights[own].tobytes()
            assert tile.read(1).tobytes() == origin[own].tobytes()
            assert left[own].all()
            left[own] = False
    assert np.isnan(heights[left]).all()
    known = ~np.isnan(heights)
    assert known.sum() * cell[0] * cell[1] == pytest.approx(3.0 * 10.0 - np.pi * 0.25, rel=0.03)
    # The hole without readings stays a hole: 5.5 to 6.5 m along, that is at the corner of the four tiles.
    column, row = pixel(place, 500_000 + 0.3 * np.sqrt(0.5), 5_300_000 + 0.3 * np.sqrt(0.5))
    assert not known[int(row), int(column)]

    grey, shade_place, empty = opened(shade, "hillshade")
    assert (shade_place, empty) == (place, 0)
    assert np.array_equal(grey > 0, known)
    expected = shaded(heights.astype(np.float64), cell)
    whole = ~np.isnan(expected)
    assert whole.sum() > 0.9 * known.sum()
    assert np.abs(grey[1:-1, 1:-1] - expected)[whole].max() <= 1
    with without_place_warning(), rasterio.open(shade / "hillshade.png") as picture:
        assert 70 < max(picture.shape) <= 200
        assert abs(picture.width - picture.height) <= 8  # the road runs to the north-east, pixels are nearly square
        assert set(np.unique(picture.read(2))) == {0, 255}

    made = {file: file.read_bytes() for folder in (mosaic, shade) for file in folder.iterdir()}
    for file in made:
        file.write_bytes(made[file][: len(made[file]) // 2])
    assert CliRunner().invoke(app, ["verify", str(survey)]).exit_code == 1
    assert CliRunner().invoke(app, ["run", str(survey), "--workers", "0"]).exit_code == 0
    assert {file: file.read_bytes() for file in made} == made


def test_a_band_that_the_surface_lacks_is_told_before_a_log_is_read(tmp_path: Path) -> None:
    survey = tmp_path / "SURVEY.toml"
    text = SURVEY.format(surface='{ method = "cells", sigma_m = 0.002 }', sheet_m=100)
    survey.write_text(text.replace('"height", "origin"]', '"height", "intensity"]'))
    outcome = CliRunner().invoke(app, ["run", str(survey), "--workers", "0"])
    assert 'add "intensity" to products.options.surface.bands' in str(outcome.exception)
    assert not (tmp_path / "store" / "survey=road" / "tables").exists()


def test_a_survey_without_a_surface_is_told_which_product_asks_for_one(tmp_path: Path) -> None:
    survey = tmp_path / "SURVEY.toml"
    text = SURVEY.format(surface="", sheet_m=100).replace("surface = \n", "")
    survey.write_text(text)
    outcome = CliRunner().invoke(app, ["run", str(survey), "--workers", "0"])
    assert "the product 'surface_mosaic' is made of the reconstructed surface" in str(outcome.exception)
