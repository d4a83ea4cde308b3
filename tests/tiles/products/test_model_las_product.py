"""The pavement model: even points that laspy finds where the squares lie."""

from __future__ import annotations

import dataclasses
import json

import laspy
import numpy as np
import pytest

from roadscan.core.errors import ConfigError, StoreError
from roadscan.tiles.product import Tile, is_default, product_named
from roadscan.tiles.products.las import Las, LasOptions
from roadscan.tiles.products.model_las import ModelLas, ModelLasFine, ModelLasFineOptions, ModelLasOptions, decimate

CELL_M = 0.25
OPTIONS = ModelLasOptions(spacing_m=1.0)


@pytest.fixture
def model() -> ModelLas:
    return ModelLas()


def tile_on(place, workshop, count=4_000):
    context = workshop.context(place.map, CELL_M)
    full = workshop.tile(place.tile, context.grid, count=count)
    return Tile(None, full.cells), context


@pytest.mark.slow
@pytest.mark.parametrize("compress", [True, False])
def test_laspy_finds_a_point_at_the_centre_of_each_square(model, workshop, place, tmp_path, compress):
    tile, context = tile_on(place, workshop, count=900)
    options = OPTIONS.model_copy(update={"compress": compress})
    path = tmp_path / "tile.tmp"
    model.write(tile, options, context, path)
    model.check(path)
    file = laspy.read(path)
    squares = decimate(tile.cells, 4, CELL_M)
    assert len(file) == len(squares) <= 100
    easting_m = place.tile.column * 10 + squares.column.astype(int) + 0.5
    northing_m = place.tile.row * 10 + squares.row.astype(int) + 0.5
    assert np.abs(np.asarray(file.x) * place.unit_m - easting_m).max() <= 0.5e-4 + 2e-9
    assert np.abs(np.asarray(file.y) * place.unit_m - northing_m).max() <= 0.5e-4 + 2e-9
    assert np.abs(np.asarray(file.z) * place.height_unit_m - squares.height_m).max() <= 0.5e-4 + 2e-9
    assert np.array_equal(file.intensity, np.rint(squares.intensity))
    assert np.array_equal(file["cells"], squares.cells) and np.array_equal(file["points"], squares.points)
    assert set(file.classification) == {1} and not file.gps_time.any() and not file.point_source_id.any()
    assert np.all(np.asarray(file.return_number) == 1) and np.all(np.asarray(file.number_of_returns) == 1)
    assert np.array_equal(np.asarray(file.withheld) == 1, (squares.cells < 4) | ~squares.sloped)
    stated = file.header.vlrs.get("ExtraBytesVlr")[0].extra_bytes_structs
    assert [(one.min[0], one.max[0]) for one in stated] == [
        (file[name].min(), file[name].max()) for name in ("cells", "points")
    ]
    assert list(tmp_path.iterdir()) == [path]


def test_place_on_earth_is_that_of_the_point_files(model, workshop, place, tmp_path):
    tile, context = tile_on(place, workshop)
    model.write(tile, OPTIONS, context, tmp_path / "model")
    points = workshop.tile(place.tile, context.grid, count=50)
    Las().write(points, LasOptions(), context, tmp_path / "points")
    one, other = laspy.read(tmp_path / "model").header, laspy.read(tmp_path / "points").header
    assert one.vlrs[0].string == other.vlrs[0].string and one.version == other.version
    assert np.array_equal(one.scales, other.scales) and np.array_equal(one.offsets, other.offsets)
    facts = json.loads(next(v for v in one.vlrs if v.user_id == "roadscan").record_data)
    assert facts["tile"] == str(place.tile) and facts["spacing_m"] == 1.0


def test_squares_hardly_covered_are_withheld(model, workshop, places, tmp_path):
    tile, context = tile_on(places["local"], workshop)
    keep = (tile.cells.column >= 4) | ((tile.cells.row % 4 == 0) & (tile.cells.column < 3))  # 3 of 16 in the west
    part = {
        name: getattr(tile.cells, name)[keep]
        for name in ("column", "row", "count", "height_robust_m", "intensity_mean")
    }
    model.write(Tile(None, dataclasses.replace(tile.cells, **part)), OPTIONS, context, tmp_path / "tile")
    file = laspy.read(tmp_path / "tile")
    west = np.asarray(file.x) < places["local"].tile.column * 10 + 1
    assert 0 < west.sum() < len(file) and np.array_equal(np.asarray(file.withheld) == 1, west)


def test_same_cells_same_bytes_and_damage_is_found(model, workshop, places, tmp_path, damage):
    tile, context = tile_on(places["utm_north"], workshop)
    for name in ("a", "b"):
        model.write(tile, OPTIONS, context, tmp_path / name)
    good = (tmp_path / "a").read_bytes()
    assert good == (tmp_path / "b").read_bytes()
    found = 0
    for _, bad in damage(good):
        (tmp_path / "bad").write_bytes(bad)
        try:
            model.check(tmp_path / "bad")
        except StoreError:
            found += 1
    assert found >= 15


def test_a_spacing_of_no_whole_cells_is_refused(model, workshop, places):
    context = workshop.context(places["local"].map, CELL_M)
    model.check_options(OPTIONS, context)
    with pytest.raises(ConfigError, match=r"model_las\.spacing_m = 0\.1"):
        model.check_options(ModelLasOptions(), context)
    with pytest.raises(ConfigError, match=r"model_las_fine\.spacing_m = 0\.02"):
        ModelLasFine().check_options(ModelLasFineOptions(), context)


def test_made_by_default_of_fine_cells_alone():
    assert is_default(product_named("model_las"), 0.005) and not is_default(product_named("model_las"), 0.05)
    for name in ("las", "mosaic", "hillshade"):
        assert is_default(product_named(name), 0.05) and not is_default(product_named(name), 0.005)
    for name in ("geotiff", "tile_table"):
        assert is_default(product_named(name), 0.05) and is_default(product_named(name), 0.005)
    for name in ("model_las_fine", "pavement_intensity", "pavement_shaded"):
        assert not is_default(product_named(name), 0.005)
