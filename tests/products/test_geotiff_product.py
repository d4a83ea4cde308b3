"""GeoTIFF of a tile: every cell where it lies on the map, in the map's units."""

from __future__ import annotations

import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import rasterio

from roadscan.model.errors import StoreError
from roadscan.model.ids import TileId
from roadscan.products import raster as raster_module
from roadscan.products.base import NoOptions, product_named
from roadscan.products.geotiff import GeoTiff
from roadscan.products.raster import overview_factors


@pytest.fixture
def geotiff() -> GeoTiff:
    return GeoTiff()


def write(geotiff, workshop, place, path, cell_m=0.5, **settings):
    context = workshop.context(place.map, cell_m)
    tile = workshop.tile(place.tile, context.grid, **settings)
    geotiff.write(tile, NoOptions(), context, path)
    return tile


def test_every_cell_is_where_it_lies(geotiff, workshop, place, tmp_path):
    path = tmp_path / "tile.tmp"
    cells = write(geotiff, workshop, place, path, count=300).cells
    assert 0 < len(cells) < 400  # some cells are empty
    east_m = place.tile.column * 10 + (cells.column + 0.5) * 0.5
    north_m = place.tile.row * 10 + (cells.row + 0.5) * 0.5
    with rasterio.open(path) as file:
        assert file.count == 4 and set(file.dtypes) == {"float32"} and np.isnan(file.nodata)
        at = np.array(list(file.sample(zip(east_m / place.unit_m, north_m / place.unit_m, strict=True))))
        image = file.read()
        size = (file.bounds.right - file.bounds.left, file.bounds.top - file.bounds.bottom)
    expected = [
        cells.height_robust_m / place.height_unit_m,
        cells.intensity_mean,
        cells.count,
        cells.height_std_m.astype(np.float64) / place.height_unit_m,
    ]
    for band, values in enumerate(expected):
        assert np.array_equal(at[:, band], np.asarray(values).astype(np.float32)), band
    assert np.count_nonzero(~np.isnan(image), axis=(1, 2)).tolist() == [len(cells)] * 4
    assert size == pytest.approx((10 / place.unit_m, 10 / place.unit_m), rel=1e-9)
    assert list(tmp_path.iterdir()) == [path]
    geotiff.check(path)


def test_bands_units_and_crs_are_stated(geotiff, workshop, place, tmp_path):
    write(geotiff, workshop, place, tmp_path / "tile")
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


def test_layout_is_cloud_optimised_with_mean_overviews(geotiff, workshop, places, tmp_path):
    path = tmp_path / "tile"
    write(geotiff, workshop, places["local"], path, cell_m=0.025, count=40_000)
    with rasterio.open(path) as file:
        assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert file.tags(ns="IMAGE_STRUCTURE")["COMPRESSION"] == raster_module.compression()
        assert file.overviews(1) == [2, 4]
        height = file.read(1).astype(np.float64)
    with rasterio.open(path, overview_level=0) as half:
        overview = half.read(1)
    four = np.stack([height[r::2, c::2] for r in (0, 1) for c in (0, 1)])
    known = ~np.isnan(four).all(axis=0)
    assert np.array_equal(known, ~np.isnan(overview))
    assert np.allclose(overview[known], np.nanmean(four[:, known], axis=0), rtol=0, atol=1e-6)


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
        geotiff.write(tile, NoOptions(), context, path)
        geotiff.check(path)
        return path.read_bytes()

    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(make, enumerate(tiles * 3)))
    assert together == [make(job) for job in enumerate(tiles * 3)]


def test_deflate_stands_in_for_zstd(geotiff, workshop, places, tmp_path, monkeypatch):
    monkeypatch.setattr(raster_module, "compression", lambda: "DEFLATE")
    cells = write(geotiff, workshop, places["utm_north"], tmp_path / "tile").cells
    geotiff.check(tmp_path / "tile")
    with rasterio.open(tmp_path / "tile") as file:
        assert file.tags(ns="IMAGE_STRUCTURE")["COMPRESSION"] == "DEFLATE"
        assert np.nansum(file.read(3)) == cells.count.sum()


# rasterio logs what GDAL says of a damaged file, which need not be text
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_damage_is_found(geotiff, workshop, places, tmp_path, damage):
    good, bad = tmp_path / "good", tmp_path / "bad"
    write(geotiff, workshop, places["utm_north"], good, cell_m=0.1, count=8_000)
    with rasterio.open(good) as file:
        whole, place = file.read(), file.transform
    found = 0
    for what, content in damage(good.read_bytes()):
        bad.write_bytes(content)
        try:
            geotiff.check(bad)
        except StoreError as error:
            assert str(bad) in str(error)
            found += 1
            continue
        with rasterio.open(bad) as file:  # a bit outside the pixels
            assert np.array_equal(file.read(), whole, equal_nan=True) and file.transform == place, what
    assert found >= 38


def test_other_rasters_are_no_product(geotiff, workshop, tmp_path):
    path = tmp_path / "foreign.tif"
    plain = {"driver": "GTiff", "width": 4, "height": 4, "dtype": "float32", "crs": "EPSG:25832"}
    place = rasterio.Affine(1, 0, 500_000, 0, -1, 5_000_000)
    with rasterio.open(path, "w", count=1, transform=place, **plain) as file:
        file.write(np.zeros((1, 4, 4), dtype=np.float32))
    with pytest.raises(StoreError, match="1 bands of float32; expected 4 of float32"):
        geotiff.check(path)
    with rasterio.open(path, "w", count=4, transform=place, **plain) as file:
        file.write(np.zeros((4, 4, 4), dtype=np.float32))
    with pytest.raises(StoreError, match="not cloud-optimised"):
        geotiff.check(path)
    with pytest.raises(StoreError):
        geotiff.check(tmp_path / "absent.tif")


def test_product_is_found_by_name():
    assert product_named("geotiff").suffix == ".tif"


@pytest.mark.skipif(shutil.which("gdalinfo") is None, reason="gdalinfo is not installed")
def test_gdalinfo_says_cog(geotiff, workshop, places, tmp_path):
    write(geotiff, workshop, places["utm_north"], tmp_path / "tile.tif")
    told = subprocess.run(["gdalinfo", tmp_path / "tile.tif"], capture_output=True, check=True, text=True)
    assert "LAYOUT=COG" in told.stdout and "Description = height" in told.stdout
