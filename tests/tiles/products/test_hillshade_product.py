"""Hillshade: Horn's method against a plane worked out by hand and SciPy's Sobel, without seams."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import rasterio
from rasterio.errors import NotGeoreferencedWarning
from scipy import ndimage

from roadscan.core.errors import StoreError
from roadscan.core.grid import TileId
from roadscan.tiles.product import Tile, product_named
from roadscan.tiles.products.hillshade import Hillshade, HillshadeOptions, shade


@pytest.fixture
def hillshade() -> Hillshade:
    return Hillshade()


def write_all(hillshade, survey, options, folder):
    outputs = hillshade.outputs(list(survey.tiles), options, survey.context)
    for output in outputs:
        path = folder / output.name
        own = [s for s in survey.summaries if s.tile in output.tiles]
        hillshade.write(output, own, survey.load_cells, options, survey.context, path)
        hillshade.check(path)
    assert sorted(p.name for p in folder.iterdir()) == sorted(o.name for o in outputs)
    return outputs


def picture(path):
    with pytest.warns(NotGeoreferencedWarning), rasterio.open(path) as file:
        assert file.driver == "PNG"
        return file.read()


def plane(rise_east, rise_north, cell_m=0.5, shape=(6, 7)):
    rows, columns = np.indices(shape)
    return cell_m * (rise_east * columns - rise_north * rows)


@pytest.mark.parametrize(
    ("rise_east", "rise_north", "expected"),
    [
        # flat, light 45° high: 1 + 254 · cos 45° = 180.6
        (0.0, 0.0, 181),
        # rises 45° towards the south-east, faces the light: 1 + 254 · 1
        (np.sqrt(0.5), -np.sqrt(0.5), 255),
        # rises 45° towards the north-west, the light grazes it: 1 + 254 · 0
        (-np.sqrt(0.5), np.sqrt(0.5), 1),
        # rises 1:2 towards the east: 1 + 254 · (sin 45° + cos 45° · sin 45° · ½) / √1.25 = 218.4
        (0.5, 0.0, 218),
        # rises 1:2 towards the north: 1 + 254 · (sin 45° − cos 45° · cos 45° · ½) / √1.25 = 104.8
        (0.0, 0.5, 105),
    ],
)
def test_a_plane_has_the_shade_worked_out_by_hand(rise_east, rise_north, expected):
    heights = np.pad(plane(rise_east, rise_north), 1, constant_values=np.nan)
    grey = shade(heights, 0.5, HillshadeOptions(z_factor=1.0))
    assert grey.shape == (6, 7)
    inner_of_edges = np.ones((6, 7), dtype=bool)
    inner_of_edges[[0, 0, -1, -1], [0, -1, 0, -1]] = False  # corners lack both ends of a diagonal
    assert set(grey[inner_of_edges].tolist()) == {expected}


@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_slopes_are_sobel_over_eight_cells(kind):
    heights = np.random.default_rng(0).normal(scale=0.03, size=(400, 300)).astype(kind)
    seen = heights[::-1].astype(np.float64)  # a view from below is turned round, and no other kind of array
    light = HillshadeOptions(azimuth_deg=300.0, altitude_deg=40.0, z_factor=2.0)
    east = 2.0 * ndimage.sobel(seen, axis=1)[1:-1, 1:-1] / (8 * 0.05)
    north = -2.0 * ndimage.sobel(seen, axis=0)[1:-1, 1:-1] / (8 * 0.04)
    azimuth, altitude = np.radians(300.0), np.radians(40.0)
    flat = np.sin(azimuth) * east + np.cos(azimuth) * north
    bright = (np.sin(altitude) - np.cos(altitude) * flat) / np.sqrt(1 + east**2 + north**2)
    expected = np.rint(1 + 254 * np.maximum(bright, 0.0))
    grey = shade(heights[::-1], 0.05, light, 0.04).astype(float)
    assert np.mean(grey != expected) < 1e-4  # halves are rounded up here, and to the even grey by NumPy
    assert np.abs(grey - expected).max() <= 1


def test_light_direction_and_exaggeration_matter():
    heights = plane(0.1, 0.0)
    by_azimuth = {a: shade(heights, 0.5, HillshadeOptions(azimuth_deg=a, z_factor=1.0))[2, 2] for a in (90, 0, 270)}
    assert by_azimuth[90] < by_azimuth[0] < by_azimuth[270]  # the plane rises eastwards and faces west
    strong = shade(heights, 0.5, HillshadeOptions(azimuth_deg=270, z_factor=5.0))[2, 2]
    assert strong == shade(5 * heights, 0.5, HillshadeOptions(azimuth_deg=270, z_factor=1.0))[2, 2]


def bumpy(x, y):
    return 3.0 + 0.05 * np.sin(1.3 * x) * np.cos(0.9 * y)


def whole_image(survey, cell_m=0.5):
    """(heights, west, north) of all cells, put together by hand, with one empty cell around."""
    cells = survey.values("height_robust_m")
    columns, rows = np.array(list(cells)).T
    n = round(survey.context.grid.size_m / cell_m)
    west, south = columns.min() // n * n, rows.min() // n * n
    east, north = (columns.max() // n + 1) * n, (rows.max() // n + 1) * n
    image = np.full((north - south + 2, east - west + 2), np.nan)
    image[north - rows, columns - west + 1] = list(cells.values())
    return image


@pytest.fixture
def survey(workshop, far_apart_place):
    place = far_apart_place
    shifts = [(0, 0), (1, 0), (1, 1), (2, 1), (2, 2), (4, 3)]
    tiles = [TileId(place.tile.column + c, place.tile.row + r) for c, r in shifts]
    return workshop.survey(tiles, workshop.context(place.map), count=3_000, surface=bumpy)


def test_no_seam_at_borders_of_tiles_and_sheets(hillshade, survey, tmp_path):
    expected = shade(whole_image(survey), 0.5, HillshadeOptions())
    names = []
    for sheet_m in (1000.0, 20.0):
        folder = tmp_path / f"{sheet_m:g}"
        folder.mkdir()
        outputs = write_all(hillshade, survey, HillshadeOptions(sheet_m=sheet_m), folder)
        names.append([o.name for o in outputs])
        source = "hillshade.tif" if sheet_m == 1000 else "hillshade.vrt"
        with rasterio.open(folder / source) as file:
            assert file.dtypes == ("uint8",) and file.nodata == 0
            grey = file.read(1)
            pixel_m = file.res[0] * survey.context.map.horizontal_unit_m
        assert np.array_equal(grey, expected)
        assert pixel_m == pytest.approx(0.5, rel=1e-12)
    assert names[0] == ["hillshade.tif", "hillshade.png"]
    assert names[1][-2:] == ["hillshade.vrt", "hillshade.png"] and len(names[1]) > 4


def test_a_sheet_depends_on_the_tiles_around_it(hillshade, survey):
    options = HillshadeOptions(sheet_m=20.0)
    outputs = {o.name: o for o in hillshade.outputs(list(survey.tiles), options, survey.context)}
    first = min(survey.tiles)
    own = outputs[f"hillshade_{first.column // 2}_{first.row // 2}.tif"]
    near = {
        t
        for t in survey.tiles
        for mine in survey.tiles
        if (mine.column // 2, mine.row // 2) == (first.column // 2, first.row // 2)
        and max(abs(t.column - mine.column), abs(t.row - mine.row)) <= 1
    }
    assert set(own.tiles) == near
    assert set(outputs["hillshade.png"].tiles) == set(survey.tiles)


def test_picture_is_small_and_transparent_where_empty(hillshade, survey, tmp_path):
    options = HillshadeOptions(picture_px=40)
    write_all(hillshade, survey, options, tmp_path)
    grey, opaque = picture(tmp_path / "hillshade.png")
    heights = whole_image(survey)[1:-1, 1:-1]
    step = 3  # 100 cells on 40 pixels
    assert grey.shape == (-(-heights.shape[0] // step), -(-heights.shape[1] // step))  # no empty margin here
    coarse = np.full((grey.shape[0] + 2, grey.shape[1] + 2), np.nan)
    for r, c in np.ndindex(grey.shape):
        part = heights[r * step : (r + 1) * step, c * step : (c + 1) * step]
        if not np.isnan(part).all():
            coarse[r + 1, c + 1] = np.nanmean(part)
    expected = shade(coarse, 1.5, options)
    assert np.abs(grey.astype(int) - expected).max() <= 1  # sums in another order
    assert np.array_equal(opaque == 255, expected > 0) and set(np.unique(opaque)) == {0, 255}


def test_picture_has_no_empty_margin(hillshade, workshop, places, tmp_path):
    context = workshop.context(places["local"].map)
    points = workshop.points(TileId(-3, 4), surface=bumpy)
    strip = replace(points, y_quanta=points.y_quanta // 5 + 400_000)  # 2 m of the tile's 10 m, from 4 m on
    one = Tile(strip, workshop.cells(strip, context.grid))
    survey = workshop.survey_of({TileId(-3, 4): one}, context)
    write_all(hillshade, survey, HillshadeOptions(), tmp_path)
    assert picture(tmp_path / "hillshade.png").shape == (2, 4, 20)
    with rasterio.open(tmp_path / "hillshade.tif") as file:
        assert file.shape == (20, 20)
        assert sorted(set(np.nonzero(file.read(1))[0].tolist())) == [8, 9, 10, 11]


def test_same_cells_give_same_bytes(hillshade, survey, workshop, tmp_path):
    again = workshop.survey(list(survey.tiles)[::-1], survey.context, count=3_000, surface=bumpy)
    files = []
    for name, one in (("a", survey), ("b", again)):
        (tmp_path / name).mkdir()
        write_all(hillshade, one, HillshadeOptions(sheet_m=20.0, picture_px=50), tmp_path / name)
        files.append({p.name: p.read_bytes() for p in (tmp_path / name).iterdir()})
    assert files[0] == files[1]


# rasterio logs what GDAL says of a damaged file, which need not be text
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_damage_is_found(hillshade, survey, tmp_path, damage):
    write_all(hillshade, survey, HillshadeOptions(), tmp_path)
    bad = tmp_path / "bad"
    for good in (tmp_path / "hillshade.tif", tmp_path / "hillshade.png"):
        found = 0
        for what, content in damage(good.read_bytes()):
            bad.write_bytes(content)
            try:
                hillshade.check(bad)
            except StoreError:
                found += 1
                continue
            if good.suffix == ".png":
                assert np.array_equal(picture(bad), picture(good)), what
            else:
                with rasterio.open(bad) as file, rasterio.open(good) as whole:
                    assert np.array_equal(file.read(), whole.read()) and file.transform == whole.transform, what
        assert found >= 20, good


def test_no_tiles_no_files(hillshade, survey):
    assert hillshade.outputs([], HillshadeOptions(), survey.context) == []


def test_product_is_found_by_name():
    assert isinstance(product_named("hillshade"), Hillshade)
