"""Kilometre sheets: what GDAL reads is the mean of the cells, on every sheet, index and overview."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import rasterio

from roadscan.core.errors import StoreError
from roadscan.core.grid import TileId
from roadscan.tiles.cells import pyramid_of
from roadscan.tiles.product import Output
from roadscan.tiles.products.hillshade import shade
from roadscan.tiles.products.kilometre import Kilometre, KilometreOptions

CELL_M = 0.25  # 40 cells along a tile's edge: overviews of 2, 8 and 40 cells
PIXEL = 2


class Overviews:
    """Overviews of a small survey in memory; nobody may ask for its cells."""

    def __init__(self, survey):
        self.survey, self.loads = survey, []

    def overview(self, tile, factor):
        self.loads.append(tile)
        one = self.survey.tiles.get(tile)
        return None if one is None else pyramid_of(one.cells, (factor,))[0]


@pytest.fixture
def kilometre() -> Kilometre:
    return Kilometre()


def options(**settings) -> KilometreOptions:
    return KilometreOptions(**{"pixels_m": (PIXEL * CELL_M,), "views": ("height",), **settings})


def survey_at(workshop, place, offsets=((0, 0), (1, 0), (1, 1), (3, 2)), count=900):
    first = place.tile
    tiles = [TileId(first.column + c, first.row + r) for c, r in offsets]
    return workshop.survey(tiles, workshop.context(place.map, CELL_M), count=count)


def write_all(kilometre, survey, settings, folder):
    found = Overviews(survey)
    outputs = kilometre.outputs(list(survey.tiles), settings, survey.context)
    for output in outputs:
        own = [s for s in survey.summaries if s.tile in output.tiles]
        kilometre.write(output, own, found, settings, survey.context, folder / output.name)
        kilometre.check(folder / output.name)
    assert sorted(p.name for p in folder.iterdir()) == sorted(o.name for o in outputs)
    return outputs, found


def means(survey, view, unit_m=1.0):
    """Mean of the cells of each pixel by (column, row) over the whole map, by pandas."""
    parts = []
    for tile, one in survey.tiles.items():
        cells, edge = one.cells, survey.context.grid.cells_per_edge
        parts.append(
            pd.DataFrame(
                {
                    "column": (tile.column * edge + cells.column.astype(int)) // PIXEL,
                    "row": (tile.row * edge + cells.row.astype(int)) // PIXEL,
                    "height": cells.height_robust_m / unit_m,
                    "light": cells.intensity_mean.astype(float) * cells.count,
                    "count": cells.count,
                }
            )
        )
    groups = pd.concat(parts).groupby(["column", "row"])
    return groups["height"].mean() if view == "height" else groups["light"].sum() / groups["count"].sum()


def pixels_in(path, unit_m):
    with rasterio.open(path) as file:
        image = file.read(1)
        row, column = np.nonzero(~np.isnan(image))
        east, north = file.transform * np.array([column + 0.5, row + 0.5])
    size = PIXEL * CELL_M
    at = zip(np.floor(east * unit_m / size).astype(int), np.floor(north * unit_m / size).astype(int), strict=True)
    return dict(zip(at, image[row, column], strict=True))


@pytest.mark.parametrize("sheet_m", [1000.0, 20.0])
@pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")
def test_pixels_are_means_of_cells(kilometre, workshop, far_apart_place, tmp_path, sheet_m):
    place = far_apart_place
    survey = survey_at(workshop, place)
    settings = options(views=("height", "intensity"), sheet_m=sheet_m)
    outputs, _ = write_all(kilometre, survey, settings, tmp_path)
    names = [o.name for o in outputs]
    assert ("height_500mm.tif" in names) == (sheet_m == 1000.0)
    assert ("height_500mm.vrt" in names) == (sheet_m == 20.0)
    for view, unit_m in (("height", place.height_unit_m), ("intensity", 1.0)):
        expected = means(survey, view, unit_m)
        found = pixels_in(tmp_path / f"{view}_500mm.{'tif' if sheet_m == 1000.0 else 'vrt'}", place.unit_m)
        assert set(found) == set(expected.index)
        assert [found[k] for k in expected.index] == pytest.approx(expected.to_numpy(), rel=1e-6, abs=1e-6)


def test_files_say_what_they_are(kilometre, workshop, places, tmp_path):
    place = places["us_feet_heights_too"]
    write_all(kilometre, survey_at(workshop, place), options(views=("height", "shaded")), tmp_path)
    with rasterio.open(tmp_path / "height_500mm.tif") as file:
        assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG" and np.isnan(file.nodata)
        assert (file.descriptions, file.units, file.dtypes) == (("height",), ("US survey foot",), ("float32",))
        assert file.tags()["ROADSCAN_SURVEY"] == "yard-7" and file.tags()["AREA_OR_POINT"] == "Area"
        assert file.crs == rasterio.crs.CRS.from_wkt(place.map.wkt())
        assert file.res == pytest.approx((0.5 / place.unit_m, 0.5 / place.unit_m), rel=1e-12)
    with rasterio.open(tmp_path / "shaded_500mm.tif") as file:
        assert (file.descriptions, file.nodata, file.dtypes) == (("hillshade",), 0.0, ("uint8",))


def test_overviews_are_means_of_what_is_below(kilometre, workshop, places, tmp_path):
    settings = options(pixels_m=(CELL_M * 2,), views=("height", "shaded"))
    far = ((0, 0), (1, 0), (26, 1), (27, 30))  # over 512 pixels: blocks straddle tiles
    write_all(kilometre, survey_at(workshop, places["local"], far, count=600), settings, tmp_path)
    for view in settings.views:
        path = tmp_path / f"{view}_500mm.tif"
        with rasterio.open(path) as file:
            below, levels = file.read(1).astype(float), len(file.overviews(1))
            empty = 0 if view == "shaded" else np.nan
        assert levels == 3
        for level in range(levels):
            with rasterio.open(path, overview_level=level) as file:
                found = file.read(1)
            padded = np.pad(below, [(0, n % 2) for n in below.shape], constant_values=empty)
            parts = np.stack([padded[i::2, j::2] for i in (0, 1) for j in (0, 1)])
            parts = np.where(parts == empty, np.nan, parts)
            known = ~np.isnan(parts).all(axis=0)
            expected = np.full(known.shape, float(empty))
            expected[known] = np.nanmean(parts[:, known], axis=0)
            if view == "shaded":
                assert np.array_equal(found, np.rint(expected))
            else:
                assert np.array_equal(found, expected.astype(np.float32), equal_nan=True)
            below = found.astype(float)


def test_relief_has_no_seam(kilometre, workshop, places, tmp_path):
    block = [(c, r) for c in range(3) for r in range(3) if (c, r) != (2, 0)]
    survey = survey_at(workshop, places["local"], block, count=1_500)
    images = []
    for name, sheet_m in (("one", 1000.0), ("cut", 10.0)):
        (tmp_path / name).mkdir()
        settings = options(views=("shaded", "height"), sheet_m=sheet_m)
        outputs, found = write_all(kilometre, survey, settings, tmp_path / name)
        kind = "tif" if name == "one" else "vrt"
        with rasterio.open(tmp_path / name / f"shaded_500mm.{kind}") as file:
            images.append(file.read(1))
        with rasterio.open(tmp_path / name / f"height_500mm.{kind}") as file:
            heights = file.read(1).astype(float)
        if name == "one":
            assert len(found.loads) == 2 * len(block)  # once a file
    assert np.array_equal(*images)
    expected = shade(np.pad(heights, 1, constant_values=np.nan), PIXEL * CELL_M, settings)
    assert np.array_equal(expected == 0, images[0] == 0)
    assert np.abs(expected.astype(int) - images[0]).max() <= 1  # float32 heights
    first = survey_at(workshop, places["local"]).context  # a sheet depends on the tiles around it
    tile = places["local"].tile
    sheet = next(o for o in outputs if o.name == f"shaded_500mm_{tile.column}_{tile.row}.tif")
    assert len(sheet.tiles) == 4 and first.grid == survey.context.grid


def test_pixels_are_the_nearest_overview(kilometre, workshop, places):
    survey = survey_at(workshop, places["local"])

    def stems(*pixels_m):
        return {o.name for o in kilometre.outputs(list(survey.tiles), options(pixels_m=pixels_m), survey.context)}

    assert stems(0.04, 0.16) == {"height_500mm.tif"}  # the smallest there is
    assert stems(1.5, 30.0) == {"height_2000mm.tif", "height_10000mm.tif"}


def test_empty_ground_takes_no_room_and_order_does_not_matter(kilometre, workshop, places, tmp_path):
    sizes = {}
    for name, offsets in (("near", ((0, 0), (1, 0))), ("far", ((0, 0), (90, 90))), ("raf", ((90, 90), (0, 0)))):
        (tmp_path / name).mkdir()
        write_all(kilometre, survey_at(workshop, places["local"], offsets), options(), tmp_path / name)
        sizes[name] = (tmp_path / name / "height_500mm.tif").read_bytes()
    assert len(sizes["far"]) < len(sizes["near"]) + 40_000  # 3.3 million pixels
    assert sizes["far"] == sizes["raf"]


def test_damage_is_found(kilometre, workshop, places, tmp_path, damage):
    survey = survey_at(workshop, places["local"], ((0, 0), (2, 0)), count=200)
    write_all(kilometre, survey, options(sheet_m=10.0), tmp_path)
    good, index = min(tmp_path.glob("*.tif")), (tmp_path / "height_500mm.vrt").read_text()
    for what, bad in damage(good.read_bytes()):
        (tmp_path / "bad").write_bytes(bad)
        with pytest.raises(StoreError):
            kilometre.check(tmp_path / "bad")
            pytest.fail(what)
    for broken in (index[: len(index) // 2], "<VRTDataset/>", ""):
        (tmp_path / "bad").write_text(broken)
        with pytest.raises(StoreError):
            kilometre.check(tmp_path / "bad")


def test_what_it_does_not_know_is_refused(kilometre, workshop, places, tmp_path):
    survey = survey_at(workshop, places["local"])
    tiles = tuple(survey.tiles)
    with pytest.raises(StoreError, match=r"'heights\.tif' is no file of this product"):
        kilometre.write(
            Output("heights.tif", tiles), survey.summaries, Overviews(survey), options(), survey.context, tmp_path / "x"
        )
    output = kilometre.outputs(list(survey.tiles), options(), survey.context)[0]
    gone = Overviews(workshop.survey_of({}, survey.context))
    with pytest.raises(StoreError, match="is listed and has no cells"):
        kilometre.write(output, survey.summaries, gone, options(), survey.context, tmp_path / "x")
    assert list(tmp_path.iterdir()) == []
    assert kilometre.outputs([], options(), survey.context) == []
