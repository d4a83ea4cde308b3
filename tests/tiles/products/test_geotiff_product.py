"""GeoTIFF of a tile: every cell where it lies on the map, in the map's units."""

from __future__ import annotations

import dataclasses
import re
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import rasterio
from rasterio.enums import Resampling

from roadscan.core.errors import StoreError
from roadscan.core.grid import TileId
from roadscan.store.codecs import cog
from roadscan.store.codecs.cog import overview_factors, raster_crs
from roadscan.tiles.product import Tile, product_named
from roadscan.tiles.products.geotiff import GeoTiff, GeoTiffOptions
from roadscan.tiles.products.raster import CellBox


@pytest.fixture
def geotiff() -> GeoTiff:
    return GeoTiff()


THREE = GeoTiffOptions()
FOUR = GeoTiffOptions(bands=("height", "intensity", "count", "height_std"))


def write(geotiff, workshop, place, path, cell_m=0.5, options=THREE, **settings):
    context = workshop.context(place.map, cell_m)
    tile = workshop.tile(place.tile, context.grid, **settings)
    geotiff.write(tile, options, context, path)
    return tile


def test_every_cell_is_where_it_lies(geotiff, workshop, place, tmp_path):
    path = tmp_path / "tile.tmp"
    cells = write(geotiff, workshop, place, path, options=FOUR, count=300).cells
    assert 0 < len(cells) < 400  # some cells are empty
    east_m = place.tile.column * 10 + (cells.column + 0.5) * 0.5
    north_m = place.tile.row * 10 + (cells.row + 0.5) * 0.5
    with rasterio.open(path) as file:
        assert file.count == 4 and set(file.dtypes) == {"float32"} and np.isnan(file.nodata)
        at = np.array(list(file.sample(zip(east_m / place.unit_m, north_m / place.unit_m, strict=True))))
        image = file.read()
        size = (file.bounds.right - file.bounds.left, file.bounds.top - file.bounds.bottom)
    expected = [
        (cells.height_robust_m / place.height_unit_m, 2.0**-15),
        (cells.intensity_mean, 1.0),
        (cells.count, 1.0),
        (cells.height_std_m.astype(np.float64) / place.height_unit_m, 2.0**-20),
    ]
    for band, (values, step) in enumerate(expected):
        assert np.abs(at[:, band] - values).max() <= step * (0.5 + 1e-6), band
        assert not np.any(at[:, band] % step), band
    assert np.count_nonzero(~np.isnan(image), axis=(1, 2)).tolist() == [len(cells)] * 4
    assert size == pytest.approx((10 / place.unit_m, 10 / place.unit_m), rel=1e-9)
    assert list(tmp_path.iterdir()) == [path]
    geotiff.check(path)


def test_bands_units_and_crs_are_stated(geotiff, workshop, place, tmp_path):
    write(geotiff, workshop, place, tmp_path / "tile", options=FOUR)
    with rasterio.open(tmp_path / "tile") as file:
        assert file.descriptions == ("height", "intensity", "count", "height standard deviation")
        assert file.units == (place.height_unit, "digital number", "points", place.height_unit)
        tags = file.tags()
        text = file.crs.to_wkt()
    assert tags["AREA_OR_POINT"] == "Area"
    assert tags["TIFFTAG_SOFTWARE"] == "roadscan 0.1"
    assert tags["TIFFTAG_DATETIME"] == "2026:04:24 00:00:00"
    assert tags["ROADSCAN_TILE"] == str(place.tile)
    if place.map.crs is None:
        assert text.startswith('LOCAL_CS["yard",UNIT["metre",1')
    else:
        assert f'AUTHORITY["EPSG","{place.map.crs[5:]}"]' in text
    assert ("VERT_CS" in text) == (place.map.vertical_crs is not None)


def test_the_sigma_of_the_poses_is_stated_where_it_is_known(geotiff, workshop, places, tmp_path):
    context = workshop.context(places["utm_north"].map, 0.5)
    tile = workshop.tile(places["utm_north"].tile, context.grid)
    names = ("ROADSCAN_SIGMA_HEIGHT_M", "ROADSCAN_SIGMA_HORIZONTAL_M")
    for sigma_height_m, sigma_horizontal_m in ((0.0123456789, 0.02), (None, 0.02), (None, None)):
        known = dataclasses.replace(tile, sigma_height_m=sigma_height_m, sigma_horizontal_m=sigma_horizontal_m)
        geotiff.write(known, THREE, context, tmp_path / "tile")
        geotiff.check(tmp_path / "tile")
        with rasterio.open(tmp_path / "tile") as file:
            stated = [file.tags().get(name) for name in names]
        for text, value in zip(stated, (sigma_height_m, sigma_horizontal_m), strict=True):
            assert text is None if value is None else float(text) == pytest.approx(value, abs=5e-7)


def test_georeference_is_what_rasterio_writes(geotiff, workshop, place, tmp_path):
    write(geotiff, workshop, place, tmp_path / "tile", cell_m=0.01)
    context = workshop.context(place.map, 0.01)
    box = CellBox.around([place.tile], context.grid)
    plain = {"driver": "GTiff", "width": box.width, "height": box.height, "count": 1, "dtype": "uint8"}
    with rasterio.open(
        tmp_path / "plain", "w", **plain, crs=raster_crs(place.map), transform=box.transform(context), sparse_ok=True
    ):
        pass
    with rasterio.open(tmp_path / "tile") as ours, rasterio.open(tmp_path / "plain") as theirs:
        assert ours.crs.to_wkt() == theirs.crs.to_wkt()
        assert (ours.transform, ours.bounds) == (theirs.transform, theirs.bounds)


def test_overviews_are_means_of_cells(geotiff, workshop, places, tmp_path):
    path = tmp_path / "tile"
    cells = write(geotiff, workshop, places["local"], path, cell_m=0.02, options=FOUR, count=5_000).cells
    with rasterio.open(path) as file:
        assert file.overviews(1) == [2, 10]
    for level, factor in enumerate((2, 10)):
        with rasterio.open(path, overview_level=level) as file:
            height, light, count, spread = file.read()
            assert file.crs is not None and np.isnan(file.nodata)
        groups = pd.DataFrame(
            {
                "row": height.shape[0] - 1 - cells.row // factor,
                "column": cells.column // factor,
                "height": cells.height_robust_m,
                "light": cells.intensity_mean.astype(float) * cells.count,
                "count": cells.count.astype(float),
                "spread": cells.height_std_m.astype(float),
            }
        ).groupby(["row", "column"])
        mean, total = groups.mean(), groups.sum()
        at = tuple(mean.index.to_frame().to_numpy().T)
        assert np.count_nonzero(~np.isnan(height)) == len(mean)
        assert np.abs(height[at] - mean["height"]).max() <= 2.0**-16 + 1e-8
        assert np.abs(light[at] - total["light"] / total["count"]).max() <= 0.51
        assert np.abs(count[at] - mean["count"]).max() <= 0.5
        assert np.abs(spread[at] - mean["spread"]).max() <= 2.0**-21 + 1e-8


def test_layout_is_cloud_optimised(geotiff, workshop, places, tmp_path):
    path = tmp_path / "tile"
    write(geotiff, workshop, places["local"], path, cell_m=0.01, count=3_000)
    with rasterio.open(path) as file:
        structure = file.tags(ns="IMAGE_STRUCTURE")
        assert structure["LAYOUT"] == "COG" and structure["COMPRESSION"] == "DEFLATE"
        assert file.block_shapes == [(512, 512)] * 3
        places = offsets(file)
        half = file.read(3, out_shape=(500, 500), resampling=Resampling.nearest)  # from the overview
    with rasterio.open(path, overview_level=0) as file:
        assert np.array_equal(half, file.read(3), equal_nan=True)
        assert max(offsets(file)) < min(places)  # overviews lie before the image


def offsets(file) -> list[int]:
    """Places of the blocks of all bands, as GDAL reads them, each with its size before it."""
    across = -(-file.width // file.block_shapes[0][1])
    names = [(b, f"{x}_{y}") for b in file.indexes for y in range(across) for x in range(across)]
    found = [(file.get_tag_item(f"BLOCK_OFFSET_{n}", "TIFF", bidx=b), b, n) for b, n in names]
    content = Path(file.name).read_bytes()
    for at, b, n in found:
        size = int(file.get_tag_item(f"BLOCK_SIZE_{n}", "TIFF", bidx=b))
        assert int.from_bytes(content[int(at) - 4 : int(at)], "little") == size
    return [int(at) for at, _, _ in found]


def test_blocks_without_cells_are_left_out(geotiff, workshop, places, tmp_path):
    context = workshop.context(places["local"].map, 0.01)
    tile = workshop.tile(places["local"].tile, context.grid, count=300)
    cells = tile.cells
    kept = (cells.column < 512) & (cells.row >= 1000 - 512)  # the north-west block
    names = ("column", "row", "count", "height_robust_m", "height_std_m", "intensity_mean")
    part = dataclasses.replace(cells, **{n: getattr(cells, n)[kept] for n in names})
    geotiff.write(Tile(None, part), THREE, context, tmp_path / "tile")
    with rasterio.open(tmp_path / "tile") as file:
        stored = [file.get_tag_item(f"BLOCK_OFFSET_{x}_{y}", "TIFF", bidx=1) for y in (0, 1) for x in (0, 1)]
        image = file.read(3)
    assert stored[0] is not None and stored[1:] == [None] * 3
    assert np.nansum(image) == part.count.sum() and np.isfinite(image).sum() == kept.sum()


def test_files_beyond_4_gb_are_big_tiff(geotiff, workshop, places, tmp_path, monkeypatch):
    monkeypatch.setattr(cog, "_CLASSIC_END", 0)
    cells = write(geotiff, workshop, places["utm_north"], tmp_path / "tile", cell_m=0.1).cells
    assert (tmp_path / "tile").read_bytes()[:4] == b"II\x2b\x00"
    geotiff.check(tmp_path / "tile")
    with rasterio.open(tmp_path / "tile") as file:
        assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert np.nansum(file.read(3)) == cells.count.sum()
        assert file.crs.to_epsg() == 25832


def test_overviews_stop_at_128_pixels():
    assert overview_factors(128, 90) == []
    assert overview_factors(200, 200) == [2]
    assert overview_factors(30, 2000) == [2, 4, 8, 16]


def test_same_cells_give_same_bytes(geotiff, workshop, place, tmp_path):
    for name in ("first.partial", "second"):
        write(geotiff, workshop, place, tmp_path / name)
    assert (tmp_path / "first.partial").read_bytes() == (tmp_path / "second").read_bytes()


def test_threads_do_not_disturb_one_another(geotiff, workshop, places, tmp_path):
    place = places["utm_north"]
    context = workshop.context(place.map, 0.1)
    tiles = [workshop.tile(TileId(place.tile.column + c, place.tile.row), context.grid) for c in range(4)]

    def make(job):
        number, tile = job
        path = tmp_path / f"{number}"
        geotiff.write(tile, THREE, context, path)
        geotiff.check(path)
        return path.read_bytes()

    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(make, enumerate(tiles * 3)))
    assert together == [make(job) for job in enumerate(tiles * 3)]


def test_damage_is_found(geotiff, workshop, places, tmp_path, damage):
    good, bad = tmp_path / "good", tmp_path / "bad"
    write(geotiff, workshop, places["utm_north"], good, cell_m=0.1, count=8_000)
    for what, content in damage(good.read_bytes()):
        bad.write_bytes(content)
        with pytest.raises(StoreError, match=re.escape(str(bad))):
            geotiff.check(bad)
            pytest.fail(what)


def test_other_rasters_are_no_product(geotiff, tmp_path):
    path = tmp_path / "foreign.tif"
    plain = {"driver": "GTiff", "width": 4, "height": 4, "dtype": "float32", "crs": "EPSG:25832"}
    place = rasterio.Affine(1, 0, 500_000, 0, -1, 5_000_000)
    with rasterio.open(path, "w", count=3, transform=place, **plain) as file:
        file.write(np.zeros((3, 4, 4), dtype=np.float32))
    with pytest.raises(StoreError, match="states no digest"):
        geotiff.check(path)
    with pytest.raises(StoreError, match="cannot be read"):
        geotiff.check(tmp_path / "absent.tif")


def test_product_is_found_by_name():
    assert product_named("geotiff").suffix == ".tif"


@pytest.mark.skipif(shutil.which("gdalinfo") is None, reason="gdalinfo is not installed")
def test_gdalinfo_says_cog(geotiff, workshop, places, tmp_path):
    write(geotiff, workshop, places["utm_north"], tmp_path / "tile.tif")
    told = subprocess.run(["gdalinfo", tmp_path / "tile.tif"], capture_output=True, check=True, text=True)
    assert "LAYOUT=COG" in told.stdout and "Description = height" in told.stdout
