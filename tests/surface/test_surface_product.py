"""Products of the reconstructed surface, opened by other programs: rasterio, trimesh, plyfile, Pillow."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import plyfile
import pytest
import rasterio
import trimesh
from PIL import Image
from rasterio.enums import Resampling

from roadscan.core.errors import ConfigError, StoreError
from roadscan.core.grid import TileGrid, TileId
from roadscan.store.codecs.mesh import write_glb
from roadscan.surface.products.surface_mesh import mesh_of
from roadscan.surface.regions import INTERPOLATED, MEASURED
from roadscan.surface.tile import EMPTY, GridWindow, SurfaceTile
from roadscan.tiles.product import ProductContext, product_named
from tests.workshop import Place, Workshop

GRID = TileGrid(10.0, 0.05)
NAMES = ("surface", "surface_mesh", "surface_pictures")


def height_m(easting_m: np.ndarray, northing_m: np.ndarray) -> np.ndarray:
    """A crowned road with a sharp joint."""
    return 412.3 + 0.02 * np.sin(easting_m) + 0.03 * np.mod(northing_m, 7.0) - 0.01 * (np.mod(easting_m, 4.0) < 2.0)


def surface(tile: TileId, cell_m: tuple[float, float] = (0.05, 0.05), seed: int = 0) -> SurfaceTile:
    """A tile's surface with noise before smoothing, with a hole, and with nothing in its western third."""
    halo = int(np.ceil(1.0 / min(cell_m) - 1e-9))
    window = GridWindow.over(GRID.bounds(tile), *cell_m).grown(halo)
    easting, northing = np.meshgrid(*window.nodes_m())
    true = height_m(easting, northing)
    raw = true + np.random.default_rng(seed).normal(0.0, 0.003, true.shape)
    box = GRID.bounds(tile)
    nothing = (easting < box.easting_min_m + 3.0) | (
        np.hypot(easting - box.easting_min_m - 6.0, northing % 10.0 - 5.0) < 0.4
    )
    origin = np.where(nothing, EMPTY, np.where((northing / cell_m[1]).astype(int) % 2, MEASURED, INTERPOLATED))
    light = np.where(nothing, np.nan, 257.0 * (100.0 + 50.0 * np.sin(northing)))  # as of a sensor of 8 bits
    raw[nothing] = true[nothing] = np.nan
    return SurfaceTile(tile, window, halo, raw, true, origin.astype(np.uint8), light.astype(np.float32), 0.003)


def written(name: str, one: SurfaceTile, context: ProductContext, folder: Path, **options: object) -> Path:
    product = product_named(name)
    settings = product.options.parse(options)
    path = folder / f"tile{product.suffix_for(settings)}"
    product.write(one, settings, context, path)
    product.check(path)
    return path


@pytest.mark.parametrize("cell_m", [(0.05, 0.05), (0.03, 0.07)])
def test_raster(far_apart_place: Place, workshop: Workshop, tmp_path: Path, cell_m: tuple[float, float]) -> None:
    place, one = far_apart_place, surface(far_apart_place.tile, cell_m)
    context = workshop.context(place.map, 0.05)
    bands = ("height", "raw_height", "origin", "intensity")
    path = written("surface", one, context, tmp_path, bands=bands)
    easting, northing = (axis[one.halo : -one.halo] for axis in one.window.nodes_m())
    with rasterio.open(path) as raster:
        assert raster.descriptions[:2] == ("height", "height before smoothing")
        assert raster.units[0] == place.height_unit
        assert (raster.height, raster.width) == (northing.size, easting.size)
        x, y = raster.xy(0, 0)
        assert (x * place.unit_m, y * place.unit_m) == pytest.approx((easting[0], northing[-1]), abs=1e-6)
        x, y = raster.xy(raster.height - 1, raster.width - 1)
        assert (x * place.unit_m, y * place.unit_m) == pytest.approx((easting[-1], northing[0]), abs=1e-6)
        found = raster.read().astype(np.float64)
        for band, values in zip(found, (one.height_m, one.raw_m), strict=False):
            expected = values[one.inner][::-1] / place.height_unit_m
            assert np.array_equal(np.isnan(band), np.isnan(expected))
            assert np.nanmax(np.abs(band - expected)) <= 2**-16 + 1e-4  # half a step, and float32 at 1,350 feet
        origin = one.origin[one.inner][::-1]
        assert np.array_equal(np.nan_to_num(found[2]), origin)
        assert np.nanmax(np.abs(found[3] - one.intensity[one.inner][::-1])) <= 0.5
        factors = raster.overviews(1)
        assert factors[0] == 4
        if cell_m == (0.05, 0.05):
            small = raster.read(1, out_shape=(50, 50), resampling=Resampling.nearest)
            with np.errstate(all="ignore"), pytest.warns(RuntimeWarning, match="empty"):
                means = np.nanmean(found[0].reshape(50, 4, 50, 4), axis=(1, 3))
            assert np.array_equal(np.isnan(small), np.isnan(means)) and np.nanmax(np.abs(small - means)) < 2e-4


def test_mesh_in_two_formats(workshop: Workshop, tmp_path: Path, places: dict[str, Place]) -> None:
    place = places["utm_north"]
    one, context = surface(place.tile), workshop.context(place.map, 0.05)
    scene = trimesh.load(written("surface_mesh", one, context, tmp_path, spacing_m=0.1))
    (glb,) = scene.geometry.values()
    ply = plyfile.PlyData.read(written("surface_mesh", one, context, tmp_path, spacing_m=0.1, format="ply"))
    x, y, z = (ply["vertex"][axis].astype(float) for axis in "xyz")
    assert np.array_equal(np.stack([x, z, -y], axis=-1), glb.vertices)
    assert np.array_equal(np.stack(ply["face"]["vertex_indices"]), glb.faces)
    assert np.array_equal(ply["vertex"]["red"], glb.visual.vertex_attributes["color"][:, 0])

    stated = dict(c.split(" ", 1) for c in ply.comments)
    origin = json.loads(stated["origin_m"])
    assert stated["crs"] == '"EPSG:25832"'
    box = GRID.bounds(place.tile)
    assert (origin[0], origin[1]) == (box.easting_min_m, box.northing_min_m)
    assert np.abs(z + origin[2] - height_m(x + origin[0], y + origin[1])).max() < 1e-5
    grey = np.rint(np.clip(100.0 + 50.0 * np.sin(y + origin[1]), 0, 255))
    assert np.abs(ply["vertex"]["red"] - grey).max() <= 1
    normals = np.cross(*np.diff(np.stack([x, y, z], axis=-1)[glb.faces], axis=1).transpose(1, 0, 2))
    assert (normals[:, 2] > 0).all()
    seen = 7.0 * 10.0 - np.pi * 0.4**2
    assert normals[:, 2].sum() / 2 == pytest.approx(seen, rel=0.02)


def test_meshes_of_neighbours_touch(workshop: Workshop, tmp_path: Path, places: dict[str, Place]) -> None:
    place = places["utm_north"]
    context = workshop.context(place.map, 0.05)
    edges = []
    for tile, side in ((place.tile, max), (TileId(place.tile.column, place.tile.row + 1), min)):
        ply = plyfile.PlyData.read(
            written("surface_mesh", surface(tile), context, tmp_path, spacing_m=0.15, format="ply")
        )
        origin = json.loads(dict(c.split(" ", 1) for c in ply.comments)["origin_m"])
        x, y, z = (ply["vertex"][axis].astype(float) + shift for axis, shift in zip("xyz", origin, strict=True))
        row = np.abs(y - side(y)) < 1e-3
        edges.append(np.round(np.stack([x, y, z], axis=-1)[row], 4))
    assert edges[0].shape[0] > 40
    assert np.allclose(edges[0], edges[1], atol=2e-4)


def test_a_crack_keeps_its_diagonal() -> None:
    height = np.array([[0.0, 1.0], [1.0, 0.0]])
    mesh = mesh_of(np.arange(2.0), np.arange(2.0), height, np.zeros((2, 2), np.uint8))
    shared = set(mesh.triangles[0]) & set(mesh.triangles[1])
    assert {tuple(mesh.vertices_m[v]) for v in shared} in ({(0, 0, 0), (1, 1, 0)}, {(1, 0, 1), (0, 1, 1)})
    assert len(mesh.triangles) == 2
    three = mesh_of(np.arange(2.0), np.arange(2.0), np.array([[0.0, np.nan], [1.0, 0.0]]), np.zeros((2, 2), np.uint8))
    assert len(three.triangles) == 1 and len(three.vertices_m) == 3


def test_an_empty_mesh_is_a_sound_file(tmp_path: Path) -> None:
    nothing = mesh_of(np.arange(3.0), np.arange(3.0), np.full((3, 3), np.nan), np.zeros((3, 3), np.uint8))
    write_glb(tmp_path / "none.glb", nothing, {}, "test")
    product_named("surface_mesh").check(tmp_path / "none.glb")
    length = struct.unpack_from("<I", (tmp_path / "none.glb").read_bytes(), 12)[0]
    assert json.loads((tmp_path / "none.glb").read_bytes()[20 : 20 + length])["scenes"] == [{}]


@pytest.mark.parametrize("cell_m", [(0.05, 0.05), (0.05, 0.15)])
def test_picture(workshop: Workshop, tmp_path: Path, places: dict[str, Place], cell_m: tuple[float, float]) -> None:
    place = places["utm_north"]
    one = surface(place.tile, cell_m)
    path = written("surface_pictures", one, workshop.context(place.map, 0.05), tmp_path, z_factor=1.0)
    with Image.open(path) as picture:
        grey = np.asarray(picture)
        assert picture.info["transparency"] == 0
    columns = np.flatnonzero((one.origin[one.inner] != EMPTY).any(axis=0)).size
    rows = one.origin[one.inner].shape[0]
    scale = round(cell_m[1] / cell_m[0])
    assert grey.shape == (rows * scale, 2 * columns + 16)
    before, after = grey[:, :columns], grey[:, columns + 16 :]
    assert np.array_equal(before == 0, after == 0)
    level = (before > 0)[:, 1:] & (before > 0)[:, :-1]
    steps = [np.median(np.abs(np.diff(half.astype(int), axis=1))[level]) for half in (before, after)]
    assert steps[0] >= 2 and steps[1] == 0  # noise is gone
    # Brightness of a matt plane: the cosine between its normal and the light, at the middle of a smooth part.
    north = one.window.nodes_m()[1][one.halo : -one.halo][::-1]
    east = one.window.nodes_m()[0][one.halo : -one.halo][-columns:]
    row, column = rows // 3, int(np.argmin(np.abs(np.mod(east, 4.0) - 1.0)))
    slope = np.array([0.02 * np.cos(east[column]), 0.03])
    assert np.mod(north[row], 7.0) > 0.2
    light = np.array([-np.sqrt(0.5), np.sqrt(0.5)]) * np.sqrt(0.5)
    bright = (np.sqrt(0.5) - slope @ light) / np.sqrt(1 + slope @ slope)
    assert after[row * scale, column] == pytest.approx(1 + 254 * bright, abs=1.5)


@pytest.mark.parametrize("name", NAMES)
def test_same_surface_same_bytes_and_damage_is_found(
    workshop: Workshop, tmp_path: Path, places: dict[str, Place], name: str,
    damage: Callable[[bytes], list[tuple[str, bytes]]],
) -> None:  # fmt: skip
    place = places["utm_north"]
    context, one = workshop.context(place.map, 0.05), surface(place.tile)
    for options in ({"format": "glb"}, {"format": "ply"}) if name == "surface_mesh" else ({},):
        path = written(name, one, context, tmp_path, **options)
        good = path.read_bytes()
        assert written(name, one, context, tmp_path, **options).read_bytes() == good
        missed = 0
        for what, bad in damage(good):
            path.write_bytes(bad)
            try:
                product_named(name).check(path)
                missed += 1
                assert what.startswith("bit")
            except StoreError:
                pass
        assert missed <= 1, "a bit of a header may be free"


def test_options_are_checked() -> None:
    with pytest.raises(ConfigError, match="black"):
        product_named("surface_mesh").options.parse({"black": 9.0, "white": 3.0})
    with pytest.raises(ConfigError, match="spacing_m"):
        product_named("surface_mesh").options.parse({"spacing_m": 2.0})
