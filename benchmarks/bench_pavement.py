"""What is made of a tile's 5 mm cells for people: pavement model, pictures, and sheets of a kilometre.

All figures are seconds of the thread's own processor time over cells, so that other programs on the machine weigh
less. The road is 4 m wide, inclined, with noise, loose stones (10 % of the cells) and cracks (5 %).
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import rasterio
from scipy.ndimage import gaussian_filter

from benchmarks.timing import Figure, thread_seconds
from roadscan.core.crs import MapFrame
from roadscan.core.grid import TileGrid, TileId
from roadscan.store.codecs.cog import Band, raster_settings
from roadscan.tiles.cells import Level, TileCells
from roadscan.tiles.product import ProductContext, Tile, TileSummary
from roadscan.tiles.products.hillshade import HillshadeOptions, shade
from roadscan.tiles.products.kilometre import Kilometre, KilometreOptions
from roadscan.tiles.products.model_las import ModelLas, ModelLasFine, decimate
from roadscan.tiles.products.pavement import IntensityOptions, PavementIntensity, PavementShaded, ShadedOptions
from roadscan.tiles.products.raster import CellBox, SparseRaster, paste_tile

EDGE, WIDTH, CELL_M = 2000, 800, 0.005
CONTEXT = ProductContext("bench", "", MapFrame("EPSG:25832"), TileGrid(10.0, CELL_M), (), dt.date(2026, 4, 24))
TILE = TileId(55_321, 602_011)


def figures(folder: Path) -> Iterator[Figure]:
    """Cost a cell of each product of a tile, and seconds a sheet with a kilometre of road."""
    yield from _models(_cells(stones=True), folder)
    yield from _pictures(_cells(stones=False), folder)
    yield from _sheets(folder)


def _models(cells: TileCells, folder: Path) -> Iterator[Figure]:
    tile = Tile(None, cells)
    for product, spacing_mm, bar in ((ModelLas(), 100, 25), (ModelLasFine(), 20, 60)):
        options = product.options()
        side = round(spacing_mm / 5)
        own = thread_seconds(lambda side=side: decimate(cells, side, CELL_M))
        yield Figure(
            f"model {spacing_mm} mm, heights alone", _per_cell(own, cells), "ns/cell",
            _per_cell(thread_seconds(lambda side=side: _by_numpy(cells, side), 1), cells),
            "NumPy: the same rule, all squares at once",
        )  # fmt: skip
        path = folder / "model.laz"
        whole = thread_seconds(lambda p=product, o=options, f=path: p.write(tile, o, CONTEXT, f))
        yield Figure(f"model {spacing_mm} mm, written as LAZ (bar: {bar})", _per_cell(whole, cells), "ns/cell")
        yield Figure(f"model {spacing_mm} mm, file", path.stat().st_size / len(cells), "B/cell")


def _pictures(cells: TileCells, folder: Path) -> Iterator[Figure]:
    tile, total = Tile(None, cells), 0.0
    for product, make in ((PavementIntensity(), IntensityOptions), (PavementShaded(), ShadedOptions)):
        for kind in ("png", "bmp"):
            path, options = folder / f"picture.{kind}", make(format=kind)
            spent = thread_seconds(lambda p=product, o=options, f=path: p.write(tile, o, CONTEXT, f))
            total += spent if kind == "png" else 0.0
            hand = thread_seconds(lambda p=product, f=path: _picture_by_hand(cells, p.name, f), 1)
            yield Figure(
                f"{product.name}, {kind}", _per_cell(spent, cells), "ns/cell", _per_cell(hand, cells),
                "NumPy and cv2.imwrite",
            )  # fmt: skip
            yield Figure(f"{product.name}, {kind} file", path.stat().st_size / len(cells), "B/cell")
    yield Figure("both pictures as PNG (bar: 40)", _per_cell(total, cells), "ns/cell")


def _sheets(folder: Path) -> Iterator[Figure]:
    road = _Road()
    product, options = Kilometre(), KilometreOptions()
    outputs = [
        o
        for o in product.outputs([s.tile for s in road.summaries], options, CONTEXT)
        if o.name.endswith("553_6020.tif")
    ]
    total = 0.0
    for output in outputs:
        path = folder / output.name
        spent = thread_seconds(lambda o=output, p=path: product.write(o, road.summaries, road, options, CONTEXT, p), 2)
        total += spent
        hand, against = None, ""
        if output.name.startswith("height_40mm"):
            hand = thread_seconds(lambda o=output: road.by_gdal(o.tiles, folder / "gdal.tif"), 1)
            against = "GDAL: sparse GeoTIFF, its overviews, its COG driver"
        yield Figure(f"sheet {output.name.rsplit('_', 2)[0]}, 1.1 km of road", spent, "s", hand, against)
    yield Figure("all sheets of 1.1 km of road", total, "s")


class _Road:
    """Overviews of a road that crosses a kilometre sheet aslant, as a store gives them."""

    def __init__(self) -> None:
        self.levels: dict[tuple[TileId, int], Level] = {}
        for row in range(602_000, 602_050):
            for column in range(55_298 + 2 * (row - 602_000), 55_304 + 2 * (row - 602_000)):
                for factor in (8, 40):
                    level = _level(TileId(column, row), factor)
                    if len(level):
                        self.levels[TileId(column, row), factor] = level
        tiles = sorted({tile for tile, _ in self.levels})
        self.summaries = [TileSummary(t, 1, 1, 90.0, 95.0, 160.0, 0.0, 0.0, (1,), 10**18, 10**18) for t in tiles]

    def __call__(self, tile: TileId) -> TileCells | None:
        raise NotImplementedError

    def overview(self, tile: TileId, factor: int) -> Level | None:
        return self.levels.get((tile, factor))

    def by_gdal(self, tiles: tuple[TileId, ...], path: Path) -> None:
        context = ProductContext("bench", "", CONTEXT.map, TileGrid(10.0, 8 * CELL_M), (), CONTEXT.date)
        raster = SparseRaster(CellBox.around(tiles, context.grid), Band("height", ""), "float32", np.nan, context)
        with raster_settings(), raster.cog(path) as canvas:
            for tile in tiles:
                level = self.levels.get((tile, 8))
                image = np.full((250, 250), np.nan, np.float32)
                if level is not None:
                    image[249 - level.row.astype(int), level.column] = level.height_m
                paste_tile(canvas, raster.box, tile, image)
        with rasterio.open(path) as found:
            assert found.overviews(1)


def _level(tile: TileId, factor: int) -> Level:
    edge = EDGE // factor
    row, column = np.indices((edge, edge))
    east = tile.column * 10 + (column + 0.5) * factor * CELL_M - 553_000
    north = tile.row * 10 + (row + 0.5) * factor * CELL_M - 6_020_000
    on = np.abs(east - 2 * north) < 4.5  # 4 m across
    row, column, east, north = row[on], column[on], east[on], north[on]
    ones = np.ones(row.size, np.uint32)
    height = 100 + 0.02 * east + 0.02 * np.sin(north) + np.random.default_rng(tile.row).normal(0, 2e-4, row.size)
    return Level(factor, column.astype(np.uint16), row.astype(np.uint16), ones, ones, height, (east % 255).astype("f4"))


def _cells(stones: bool) -> TileCells:
    rng = np.random.default_rng(0)
    row, column = (a.ravel() for a in np.indices((EDGE, WIDTH)))
    waves = gaussian_filter(rng.normal(0, 1, (EDGE, WIDTH)), 2) * 3e-3
    height = 100 + 0.025 * column * CELL_M - 0.06 * row * CELL_M + waves.ravel() + rng.normal(0, 2e-4, row.size)
    if stones:
        lot = rng.random(row.size)
        height[lot < 0.10] += 0.008
        height[lot > 0.95] -= 0.015
    light = 120 + 40 * gaussian_filter(rng.normal(0, 1, (EDGE, WIDTH)), 3).ravel() + rng.normal(0, 6, row.size)
    n, ones = row.size, np.ones(row.size, np.uint16)
    return TileCells(
        TILE, EDGE, (column + 600).astype(np.uint16), row.astype(np.uint16), np.full(n, 25, np.uint32),
        height, height, height, height, np.zeros(n, np.float32), light.astype(np.float32),
        ones, np.arange(n + 1, dtype=np.int32), ones,
    )  # fmt: skip


def _by_numpy(cells: TileCells, side: int) -> np.ndarray:
    image = np.empty((EDGE, WIDTH))
    image[cells.row, cells.column - 600] = cells.height_robust_m
    patch = 20
    blocks = image.reshape(EDGE // patch, patch, WIDTH // patch, patch).transpose(0, 2, 1, 3)
    lag = patch // 2
    east = np.median((blocks[..., lag:] - blocks[..., :-lag]).reshape(*blocks.shape[:2], -1), axis=-1) / lag
    north = np.median((blocks[..., lag:, :] - blocks[..., :-lag, :]).reshape(*blocks.shape[:2], -1), axis=-1) / lag
    per = patch // side
    east, north = (np.repeat(np.repeat(a, per, 0), per, 1)[..., None, None] for a in (east, north))
    y, x = np.indices((side, side)) - (side - 1) / 2
    squares = image.reshape(EDGE // side, side, WIDTH // side, side).transpose(0, 2, 1, 3)
    flat = (squares - east * x - north * y).reshape(*squares.shape[:2], -1)
    off = np.abs(flat - np.median(flat, axis=-1, keepdims=True))
    reach = np.maximum(3 * 1.4826 * np.median(off, axis=-1, keepdims=True), 0.001)
    return np.where(off <= reach, flat, np.nan).mean(axis=-1, where=off <= reach)


def _picture_by_hand(cells: TileCells, name: str, path: Path) -> None:
    if name == "pavement_shaded":
        heights = np.full((EDGE + 2, WIDTH + 2), np.nan)
        heights[EDGE - cells.row.astype(int), cells.column - 599] = cells.height_robust_m
        picture = shade(heights, CELL_M, HillshadeOptions(z_factor=1.0))
    else:
        picture = np.zeros((EDGE, WIDTH), np.uint8)
        picture[EDGE - 1 - cells.row.astype(int), cells.column - 600] = np.clip(cells.intensity_mean, 1, 255)
    cv2.imwrite(str(path), picture)


def _per_cell(seconds: float, cells: TileCells) -> float:
    return seconds * 1e9 / len(cells)
