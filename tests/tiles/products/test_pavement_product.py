"""Pictures of the pavement: OpenCV sees every cell's grey, GDAL finds its place, the relief is the hillshade's."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import rasterio
from pydantic import ValidationError

from roadscan.core.errors import StoreError
from roadscan.tiles.product import Tile
from roadscan.tiles.products.hillshade import HillshadeOptions, shade
from roadscan.tiles.products.pavement import IntensityOptions, PavementIntensity, PavementShaded, ShadedOptions
from roadscan.tiles.products.raster import cell_image

INTENSITY = IntensityOptions(black=10_000.0, white=50_000.0)


def made(product, options, workshop, place, folder, count=700):
    context = workshop.context(place.map)
    tile = Tile(None, workshop.tile(place.tile, context.grid, count=count).cells)
    path = folder / f"tile{product.suffix_for(options)}"
    product.write(tile, options, context, path)
    world = path.with_suffix(product.companions(options)["place"])
    assert sorted(folder.iterdir()) == sorted([path, world])
    product.check(path)
    product.check(world)
    return tile.cells, context, path


@pytest.mark.parametrize("kind", ["png", "bmp"])
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_every_cell_is_where_it_lies(workshop, place, tmp_path, kind):
    options = INTENSITY.model_copy(update={"format": kind})
    cells, context, path = made(PavementIntensity(), options, workshop, place, tmp_path)
    expected = 1.0 + 254.0 * np.clip((cells.intensity_mean - 10_000.0) / 40_000.0, 0.0, 1.0)
    edge_m = context.grid.cell_m
    east_m = place.tile.column * 10 + (cells.column + 0.5) * edge_m
    north_m = place.tile.row * 10 + (cells.row + 0.5) * edge_m
    with rasterio.open(path) as file:
        image = file.read(1)
        row, column = rasterio.transform.rowcol(file.transform, east_m / place.unit_m, north_m / place.unit_m)
        assert file.nodata == (0 if kind == "png" else None)
    assert np.abs(image[row, column] - expected).max() <= 0.5 + 1e-3
    assert np.count_nonzero(image) == len(cells)
    assert image.shape == (np.ptp(cells.row) + 1, np.ptp(cells.column) + 1)
    assert np.array_equal(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), image)


@pytest.mark.parametrize("light", [(315.0, 45.0, 1.0), (60.0, 20.0, 4.0)])
def test_relief_is_that_of_the_hillshade(workshop, places, tmp_path, light):
    azimuth, altitude, z = light
    options = ShadedOptions(azimuth_deg=azimuth, altitude_deg=altitude, z_factor=z)
    cells, context, path = made(PavementShaded(), options, workshop, places["utm_north"], tmp_path)
    heights = np.pad(cell_image(cells, cells.height_robust_m, "float64"), 1, constant_values=np.nan)
    like = HillshadeOptions(azimuth_deg=azimuth, altitude_deg=altitude, z_factor=z)
    whole = shade(heights, context.grid.cell_m, like)
    rows, columns = np.flatnonzero(whole.any(axis=1)), np.flatnonzero(whole.any(axis=0))
    expected = whole[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    found = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert np.array_equal(found == 0, expected == 0)
    assert np.abs(found.astype(int) - expected).max() <= 1


def test_north_is_up_and_light_comes_from_the_north_west(workshop, places, tmp_path):
    def facing_north_west(x_m, y_m):
        return 0.02 * (x_m % 100.0) - 0.02 * (y_m % 100.0)

    context = workshop.context(places["local"].map)
    grey = {}
    for name, sign in (("towards", 1.0), ("away", -1.0)):
        tile = workshop.tile(
            places["local"].tile, context.grid, surface=lambda x, y, s=sign: s * facing_north_west(x, y), noise_m=0.0
        )
        PavementShaded().write(Tile(None, tile.cells), ShadedOptions(z_factor=20.0), context, tmp_path / f"{name}.png")
        image = cv2.imread(str(tmp_path / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
        grey[name] = np.median(image[image > 0])
    assert grey["towards"] > 200 > 120 > grey["away"]


@pytest.mark.parametrize("kind", ["png", "bmp"])
def test_same_cells_same_bytes_and_damage_is_found(workshop, places, tmp_path, damage, kind):
    paths = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        options = ShadedOptions(format=kind)
        paths.append(made(PavementShaded(), options, workshop, places["local"], tmp_path / name)[2])
    good = paths[0].read_bytes()
    assert good == paths[1].read_bytes()
    found = 0
    for _, bad in damage(good):
        (tmp_path / f"bad.{kind}").write_bytes(bad)
        try:
            PavementShaded().check(tmp_path / f"bad.{kind}")
        except StoreError:
            found += 1
    assert found >= (43 if kind == "png" else 3)  # a bitmap has no checksum: the manifest's digest tells


def test_a_bad_world_file_is_found(tmp_path):
    for text in ("", "0.05\n0\n0\n-0.05\n1\n", "0.05\n0\n0\n0.05\n1\n2\n", "a\nb\nc\nd\ne\nf\n"):
        (tmp_path / "x.pgw").write_text(text)
        with pytest.raises(StoreError):
            PavementIntensity().check(tmp_path / "x.pgw")


def test_black_lies_below_white():
    with pytest.raises(ValidationError, match="black 65535 is not below white 65535"):
        IntensityOptions(black=65_535.0)
