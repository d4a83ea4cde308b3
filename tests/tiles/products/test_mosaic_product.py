"""Mosaic: all cells of the survey in place, in one file or in sheets, read tile by tile."""

from __future__ import annotations

import datetime as dt
from dataclasses import replace

import numpy as np
import pytest
import rasterio

from roadscan.core.crs import MapFrame
from roadscan.core.errors import StoreError
from roadscan.core.grid import TileGrid, TileId
from roadscan.tiles.product import Output
from roadscan.tiles.products.mosaic import Mosaic, MosaicOptions
from roadscan.tiles.products.raster import cut_sheets
from tests.workshop import CellsInMemory

QUANTITIES = {
    "height": "height_robust_m",
    "intensity": "intensity_mean",
    "count": "count",
    "height_std": "height_std_m",
}


@pytest.fixture
def mosaic() -> Mosaic:
    return Mosaic()


def tiles_around(tile):
    """A bent street with a gap: 5 tiles wide, 4 high, across the sheet borders."""
    shifts = [(0, 0), (1, 0), (1, 1), (2, 1), (4, 3)]
    return [TileId(tile.column + c, tile.row + r) for c, r in shifts]


@pytest.fixture
def survey(workshop, place):
    return workshop.survey(tiles_around(place.tile), workshop.context(place.map), count=250)


def write_all(mosaic, survey, options, folder):
    outputs = mosaic.outputs(list(survey.tiles), options, survey.context)
    for output in outputs:
        path = folder / output.name
        own = [s for s in survey.summaries if s.tile in output.tiles]
        mosaic.write(output, own, survey.load_cells, options, survey.context, path)
        mosaic.check(path)
    assert sorted(p.name for p in folder.iterdir()) == sorted(o.name for o in outputs)
    return outputs


def cells_in(path, unit_m):
    """Values by (column, row) counted over the whole map, from a raster's own georeference."""
    with rasterio.open(path) as file:
        image, transform = file.read(1), file.transform
    rows, columns = np.nonzero(~np.isnan(image))
    xs, ys = transform @ (columns + 0.5, rows + 0.5)
    where = zip(np.floor(xs * unit_m / 0.5), np.floor(ys * unit_m / 0.5), strict=True)
    return {(int(c), int(r)): float(v) for (c, r), v in zip(where, image[rows, columns], strict=True)}


def expected_cells(survey, place, quantity):
    unit_m = place.height_unit_m if quantity.startswith("height") else 1.0
    return {at: float(np.float32(v)) for at, v in survey.values(QUANTITIES[quantity], unit_m).items()}


def test_small_survey_is_one_file_a_quantity(mosaic, survey, place, tmp_path):
    outputs = write_all(mosaic, survey, MosaicOptions(), tmp_path)
    assert [o.name for o in outputs] == [f"{q}.tif" for q in QUANTITIES]
    for output in outputs:
        assert set(output.tiles) == set(survey.tiles)
        with rasterio.open(tmp_path / output.name) as file:
            assert (file.width, file.height) == (100, 80)
            assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
    for quantity in QUANTITIES:
        found = cells_in(tmp_path / f"{quantity}.tif", place.unit_m)
        assert found == expected_cells(survey, place, quantity), quantity
    with rasterio.open(tmp_path / "height_std.tif") as file:
        assert file.units == (place.height_unit,) and file.descriptions == ("height standard deviation",)


def test_large_survey_is_sheets_and_an_index(mosaic, survey, place, tmp_path):
    options = MosaicOptions(sheet_m=25.0, quantities=("height", "count"))  # 2 tiles
    outputs = write_all(mosaic, survey, options, tmp_path)
    names = [o.name for o in outputs]
    sheets = sorted({(t.column // 2, t.row // 2) for t in survey.tiles})
    assert names[: len(sheets) + 1] == [*(f"height_{c}_{r}.tif" for c, r in sheets), "height.vrt"]
    for output in outputs:
        if output.name.startswith("height_"):
            column, row = (int(part) for part in output.name[7:-4].split("_"))
            assert set(output.tiles) == {t for t in survey.tiles if (t.column // 2, t.row // 2) == (column, row)}
        elif output.name.endswith(".vrt"):
            assert set(output.tiles) <= set(survey.tiles)
    for quantity in ("height", "count"):
        found = cells_in(tmp_path / f"{quantity}.vrt", place.unit_m)
        assert found == expected_cells(survey, place, quantity), quantity


def test_index_says_what_its_sheets_say(mosaic, workshop, places, tmp_path):
    northing_first = MapFrame("EPSG:31467")
    survey = workshop.survey(tiles_around(TileId(350_012, 540_033)), workshop.context(northing_first), count=50)
    write_all(mosaic, survey, MosaicOptions(sheet_m=20.0, quantities=("height_std",)), tmp_path)
    sheet = next(tmp_path.glob("*.tif"))
    with rasterio.open(tmp_path / "height_std.vrt") as index, rasterio.open(sheet) as one:
        assert index.crs == one.crs
        assert index.res == one.res
        assert index.units == one.units == ("metre",)
        assert index.descriptions == one.descriptions
        assert np.isnan(index.nodata)
        assert index.bounds.left == 3_500_120 and index.bounds.bottom == 5_400_330
    (tmp_path / "moved").mkdir()
    for file in list(tmp_path.glob("*.*")):
        file.rename(tmp_path / "moved" / file.name)
    found = cells_in(tmp_path / "moved" / "height_std.vrt", 1.0)
    assert len(found) == sum(len(t.cells) for t in survey.tiles.values())


def test_index_has_overviews_over_sheet_borders(mosaic, workshop, places, tmp_path):
    tiles = [TileId(c, 0) for c in range(-2, 12)]
    survey = workshop.survey(tiles, workshop.context(places["local"].map), count=4_000, surface=lambda x, y: 0.01 * x)
    write_all(mosaic, survey, MosaicOptions(sheet_m=40.0, quantities=("height",)), tmp_path)
    with rasterio.open(tmp_path / "height.vrt") as index:
        assert index.overviews(1) == [2, 4]
        small = index.read(1, out_shape=(1, index.height // 4, index.width // 4))
    middle_m = -20 + 2.0 * (np.arange(small.shape[1]) + 0.5)
    assert np.allclose(small, 0.01 * middle_m, atol=0.01)


@pytest.fixture
def one_survey(workshop, places):
    place = places["utm_south"]
    return workshop.survey(tiles_around(place.tile), workshop.context(place.map), count=250)


def test_each_tile_is_read_once_a_quantity(mosaic, one_survey, tmp_path):
    survey = one_survey
    write_all(mosaic, survey, MosaicOptions(), tmp_path)
    assert set(survey.loads.values()) == {4}


def test_bytes_depend_on_neither_order_nor_name(mosaic, workshop, places, tmp_path):
    place = places["us_feet"]
    files = []
    for order in (1, -1):
        survey = workshop.survey(tiles_around(place.tile)[::order], workshop.context(place.map), count=250)
        folder = tmp_path / f"folder{order}"
        folder.mkdir()
        write_all(mosaic, survey, MosaicOptions(sheet_m=20.0), folder)
        files.append({p.name: p.read_bytes() for p in folder.iterdir()})
    assert files[0] == files[1]


def test_a_sheet_depends_on_its_own_tiles_alone(mosaic, one_survey, workshop, tmp_path):
    survey, options = one_survey, MosaicOptions(sheet_m=20.0, quantities=("count",))
    output = mosaic.outputs(list(survey.tiles), options, survey.context)[0]
    own = {t: one for t, one in survey.tiles.items() if t in output.tiles}
    assert 0 < len(own) < len(survey.tiles)
    early = replace(survey.context, date=dt.date(2020, 1, 1), title="an earlier run was added")
    mosaic.write(output, survey.summaries, survey.load_cells, options, survey.context, tmp_path / "all")
    alone = workshop.survey_of(own, early)
    mosaic.write(output, alone.summaries, alone.load_cells, options, early, tmp_path / "own")
    assert (tmp_path / "all").read_bytes() == (tmp_path / "own").read_bytes()
    with rasterio.open(tmp_path / "own") as file:
        assert file.tags()["TIFFTAG_DATETIME"] == "2026:04:23 00:00:00"  # 16,909 days after 1980-01-06


def test_a_file_it_does_not_list_is_refused(mosaic, one_survey, tmp_path):
    output = Output("heights.tif", tuple(one_survey.tiles))
    with pytest.raises(StoreError, match=r"'heights.tif' is no file of this product"):
        mosaic.write(
            output, one_survey.summaries, one_survey.load_cells, MosaicOptions(), one_survey.context, tmp_path / "x"
        )


def test_empty_ground_takes_no_room(mosaic, workshop, places, tmp_path):
    far = [TileId(0, 0), TileId(90, 90)]
    near = [TileId(0, 0), TileId(1, 0)]
    sizes = []
    for name, tiles in (("far", far), ("near", near)):
        survey = workshop.survey(tiles, workshop.context(places["local"].map, cell_m=0.25))
        (tmp_path / name).mkdir()
        write_all(mosaic, survey, MosaicOptions(quantities=("height",)), tmp_path / name)
        sizes.append((tmp_path / name / "height.tif").stat().st_size)
    with rasterio.open(tmp_path / "far" / "height.tif") as file:
        assert (file.width, file.height) == (3640, 3640)  # 49 blocks of 1 MiB
    assert sizes[0] < 2 * sizes[1] + 10_000


def test_no_tiles_no_files(mosaic, workshop, places):
    assert mosaic.outputs([], MosaicOptions(), workshop.context(places["local"].map)) == []


def test_a_listed_tile_without_cells_is_an_error(mosaic, one_survey, tmp_path):
    survey = one_survey
    options = MosaicOptions(quantities=("height",))
    output = mosaic.outputs(list(survey.tiles), options, survey.context)[0]
    with pytest.raises(StoreError, match="is listed and has no cells"):
        mosaic.write(output, survey.summaries, CellsInMemory({}, {}), options, survey.context, tmp_path / "x")
    assert not list(tmp_path.iterdir())  # the scratch file is gone


# rasterio logs what GDAL says of a damaged file, which need not be text
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_damage_is_found(mosaic, one_survey, tmp_path, damage):
    write_all(mosaic, one_survey, MosaicOptions(sheet_m=20.0, quantities=("height",)), tmp_path)
    assert faults_found(mosaic, min(tmp_path.glob("*.tif")), damage) >= 20
    index, bad = (tmp_path / "height.vrt").read_text(), tmp_path / "bad"
    for broken in (index[: len(index) // 2], index.replace('xOff="0"', 'xOff="9999"'), "<VRTDataset/>", ""):
        bad.write_text(broken)
        with pytest.raises(StoreError):
            mosaic.check(bad)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_damage_is_found_between_empty_blocks(mosaic, workshop, places, tmp_path, damage):
    tiles = [TileId(0, 0), TileId(9, 4)]
    survey = workshop.survey(tiles, workshop.context(places["local"].map, cell_m=0.05), count=9_000)
    write_all(mosaic, survey, MosaicOptions(quantities=("height",)), tmp_path)
    with rasterio.open(tmp_path / "height.tif") as file:
        assert file.block_shapes == [(512, 512)] and file.shape == (1000, 2000)  # 8 blocks, 2 of them not empty
    # overviews, a quarter of the file, are decoded and not compared
    assert faults_found(mosaic, tmp_path / "height.tif", damage) >= 25


def faults_found(mosaic, good, damage):
    """How many damaged copies the check refuses; the others must hold the same pixels in the same place."""
    with rasterio.open(good) as file:
        whole, place = file.read(), file.transform
    found, bad = 0, good.with_name("bad")
    for what, content in damage(good.read_bytes()):
        bad.write_bytes(content)
        try:
            mosaic.check(bad)
        except StoreError:
            found += 1
            continue
        with rasterio.open(bad) as file:
            assert np.array_equal(file.read(), whole, equal_nan=True) and file.transform == place, what
    return found


def test_sheets_have_twenty_thousand_cells_unless_stated():
    tiles = [TileId(c, 0) for c in range(-40, 61)]
    grid = TileGrid(10.0, 0.05)
    assert [s.name for s in cut_sheets("height", tiles[:100], None, grid)] == ["height.tif"]
    names = [s.name for s in cut_sheets("height", tiles, None, grid)]
    assert names == ["height_-1_0.tif", "height_0_0.tif"]
    assert len(cut_sheets("height", tiles, None, TileGrid(10.0, 0.01))) == 6  # 200 m
    assert len(cut_sheets("height", tiles, 1_010.0, grid)) == 1
    assert len(cut_sheets("height", tiles[:3], 5.0, grid)) == 3  # never less than a tile
