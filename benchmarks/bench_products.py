"""A tile's files from its cells: ns of one core a cell, beside rasterio, pandas and pyarrow as they come.

The tile is 10 m with cells of 5 mm, two fifths of them under a lane that crosses it. Times are those of the thread, so
that other work on the machine disturbs them less.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import rasterio
from rasterio.enums import Resampling
from scipy.ndimage import gaussian_filter

from benchmarks.timing import Figure, thread_seconds
from roadscan.core.crs import MapFrame
from roadscan.core.grid import TileGrid, TileId
from roadscan.store.codecs.cog import raster_crs, raster_settings
from roadscan.tiles.cells import TileCells, overview_factors, pyramid_of, write_cells, write_overviews
from roadscan.tiles.product import ProductContext, Tile
from roadscan.tiles.products.geotiff import GeoTiff, GeoTiffOptions
from roadscan.tiles.products.raster import CellBox, cell_image

READINGS_A_CELL = 25
EDGE = 2000


def figures(folder: Path) -> Iterator[Figure]:
    """Pyramid, GeoTIFF, tables; then the cost of small tiles."""
    cells, context, path = lane(EDGE), context_of(EDGE), folder / "file"
    factors = overview_factors(EDGE)
    levels = pyramid_of(cells, factors)

    def figure(what: str, ours: Callable[[], object], other: Callable[[], object], against: str) -> Figure:
        theirs = 1e9 * thread_seconds(other) / len(cells)
        size = path.stat().st_size / len(cells) if path.is_file() else 0.0
        value = 1e9 * thread_seconds(ours) / len(cells)
        sizes = f"; bytes a cell: {path.stat().st_size / len(cells):.2f}, {size:.2f}" if size else ""
        return Figure(what, value, "ns/cell", theirs, against + sizes)

    yield figure(
        f"pyramid by {', '.join(map(str, factors))}",
        lambda: pyramid_of(cells, factors),
        lambda: pandas_pixels(cells, factors),
        "pandas groupby",
    )
    product, options = GeoTiff(), GeoTiffOptions()
    for name, overviews in (("with overviews", True), ("without overviews", False)):
        yield figure(
            "geotiff: 3 bands, overviews, digest",
            lambda: product.write(Tile(None, cells), options, context, path),
            lambda overviews=overviews: plain_geotiff(cells, context, path, overviews),
            f"rasterio {name}",
        )
    for columns in ("surface", "full"):
        write_cells(path, cells, columns)
        rows = pq.read_table(path)
        yield figure(
            f"table of cells, {columns}",
            lambda columns=columns: write_cells(path, cells, columns),
            lambda rows=rows: pq.write_table(rows, path, compression="zstd"),
            "pyarrow's defaults with zstd",
        )
    write_overviews(path, levels)
    rows = pq.read_table(path)
    yield figure(
        "table of overviews",
        lambda: write_overviews(path, levels),
        lambda: pq.write_table(rows, path, compression="zstd"),
        "pyarrow's defaults with zstd",
    )
    small, context = lane(200), context_of(200)
    yield Figure(
        f"geotiff of {len(small)} cells in 200 × 200",
        1e3 * thread_seconds(lambda: product.write(Tile(None, small), options, context, path), 20),
        "ms",
        1e3 * thread_seconds(lambda: plain_geotiff(small, context, path, True), 20),
        "rasterio with overviews",
    )


def context_of(edge: int) -> ProductContext:
    grid = TileGrid(10.0, 10.0 / edge)
    return ProductContext("bench", "", MapFrame("EPSG:25832"), grid, (), dt.date(2026, 4, 24))


def lane(edge: int) -> TileCells:
    """Cells of asphalt (0.8 mm of texture) under a lane along the diagonal, one in a hundred without a point."""
    rng = np.random.default_rng(1)
    row, column = np.indices((edge, edge)).reshape(2, -1)
    under = (np.abs(column - row) < (1 - np.sqrt(0.6)) * edge) & (rng.random(edge * edge) > 0.01)
    row, column = row[under], column[under]
    texture = gaussian_filter(rng.normal(size=(edge, edge)), 1.5)[row, column]
    texture /= texture.std()
    n = row.size
    count = rng.poisson(READINGS_A_CELL, n).clip(1).astype(np.uint32)
    height = 287.3 + 0.02 * column / edge + 8e-4 * texture + rng.normal(0, 1e-4, n)
    height = np.rint(height * 1e5 * count) / count * 1e-5
    light = np.rint((90 + 15 * texture + rng.normal(0, 3, n)).clip(1, 255) * count) / count
    ones = np.ones(n, np.uint16)
    return TileCells(
        TileId(55_321, 602_011), edge, column.astype(np.uint16), row.astype(np.uint16), count,
        height, height, height - 5e-4, height + 5e-4, rng.uniform(1e-4, 3e-4, n).astype(np.float32),
        light.astype(np.float32), ones, np.arange(n + 1, dtype=np.int32), ones,
    )  # fmt: skip


def pandas_pixels(cells: TileCells, factors: tuple[int, ...]) -> None:
    frame = pd.DataFrame({"count": cells.count, "height": cells.height_robust_m, "light": cells.intensity_mean})
    frame["light"] *= frame["count"]
    for factor in factors:
        pixel = (cells.row // factor).astype(np.int64) * (cells.cells_per_edge // factor) + cells.column // factor
        frame.groupby(pixel).agg({"count": ["sum", "size"], "height": "mean", "light": "sum"})


def plain_geotiff(cells: TileCells, context: ProductContext, path: Path, overviews: bool) -> None:
    """The three bands as a user of rasterio writes them, the same bands, rounding and compression."""
    box = CellBox.around([cells.tile], context.grid)
    images = [
        cell_image(cells, values, "float32")
        for values in (np.rint(cells.height_robust_m * 2**15) / 2**15, np.rint(cells.intensity_mean), cells.count)
    ]
    layout = {"tiled": True, "blockxsize": 512, "blockysize": 512, "interleave": "band", "sparse_ok": True}
    profile = {"driver": "GTiff", "width": box.width, "height": box.height, "count": 3, "dtype": "float32"}
    place = {"crs": raster_crs(context.map), "transform": box.transform(context), "nodata": np.nan}
    with raster_settings():
        with rasterio.open(path, "w", **profile, **layout, **place, compress="zstd", zstd_level=1, predictor=3) as file:
            for band, image in enumerate(images, start=1):
                file.write(image, band)
        if overviews:
            with rasterio.open(path, "r+") as file:
                file.build_overviews(overview_factors(cells.cells_per_edge), Resampling.average)
