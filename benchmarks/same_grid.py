"""The same grid from the same points: a LAS file → cells of 20 mm, with roadscan, NumPy and PDAL."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import numpy.typing as npt
import rasterio

from benchmarks.skilled_user import Cells, Points, to_cells
from benchmarks.timing import Figure, best_seconds
from roadscan.core.grid import TileGrid, TileId
from roadscan.georeference.cloud import TilePoints
from roadscan.tiles.accumulator import cells_of
from roadscan.tiles.cells import TileCells

CELL_M = 0.02
_TILE_M = 10.0
_QUANTA_PER_M = 100_000
_ORIGIN_TILE = (56_321, 593_487)
_WHAT = "same grid from the same points (LAS → cells of 20 mm)"
_COLUMNS = (("X", np.int32), ("Y", np.int32), ("Z", np.int32), ("intensity", np.uint16))
_PIECE = 1 << 15
"""Points that are brought into columns together: their records stay in the second cache meanwhile."""
_PDAL_POINTS_PER_S = 0.5e6
"""PDAL 2.7, `writers.gdal`, LAS in, 20 million points, 20 mm cells, on another day's run of a like machine."""


def figures(folder: Path, points: int) -> Iterator[Figure]:
    """One core each; then two tiles at once, one a core."""
    file = write_points(folder / "points.las", points)
    ours: list[TileCells] = []
    theirs: list[Cells] = []
    here = points / best_seconds(lambda: ours.append(with_roadscan(file)), runs=2) / 1e6
    for packed, how in ((True, "NumPy: one sort of 64-bit numbers"), (False, "NumPy: lexsort")):
        started = time.perf_counter()
        theirs.append(with_numpy(file, packed))
        yield Figure(_WHAT, here, "M/s", points / (time.perf_counter() - started) / 1e6, how)
    yield Figure(f"{_WHAT}: largest difference to NumPy (bar: 0.1)", 1e3 * difference_m(ours[-1], theirs[0]), "mm")
    yield from _pdal(folder, file, points, here, theirs[0])
    with ThreadPoolExecutor(2) as cores:
        both_s = best_seconds(lambda: list(cores.map(with_roadscan, (file, file))), runs=2)
    yield Figure(f"{_WHAT}, two tiles at once", 2 * points / both_s / 1e6, "M/s", here, "one tile, one core")
    file.unlink()


def write_points(file: Path, points: int) -> Path:
    """A LAS file of one tile's points in the order of profiles, rough by a millimetre, a hundredth loose stones."""
    rng = np.random.default_rng(17)
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 1 / _QUANTA_PER_M), np.array([*(_TILE_M * t for t in _ORIGIN_TILE), 0.0])
    las = laspy.LasData(header)
    size = round(_TILE_M * _QUANTA_PER_M)
    las.X = rng.integers(0, size, points, dtype=np.int32)
    las.Y = np.sort(rng.integers(0, size, points, dtype=np.int32))
    heights = rng.normal(8_700_000, 100, points)
    heights[rng.random(points) < 0.01] += 1_000
    las.Z = np.round(heights).astype(np.int32)
    las.intensity = rng.integers(0, 255, points).astype(np.uint16)
    las.write(file)
    return file


def read_columns(file: Path) -> tuple[npt.NDArray[Any], ...]:
    """X, Y, Z and intensity of a LAS file, (n,) each, as they are stored."""
    with laspy.open(file) as reader:
        head = reader.header
    records = np.memmap(file, head.point_format.dtype(), "r", head.offset_to_point_data, head.point_count)
    columns = tuple(np.empty(head.point_count, kind) for _, kind in _COLUMNS)
    for start in range(0, head.point_count, _PIECE):
        piece = records[start : start + _PIECE]
        for (name, _), column in zip(_COLUMNS, columns, strict=True):
            column[start : start + _PIECE] = piece[name]
    return columns


def with_roadscan(file: Path) -> TileCells:
    """LAS → cells."""
    x, y, z, intensity = read_columns(file)
    none, one = np.zeros(x.size, np.int64), np.ones(x.size, np.uint8)
    passes = one.astype(np.uint16)
    return cells_of(TilePoints(TileId(*_ORIGIN_TILE), x, y, z, none, intensity, one, passes), TileGrid(_TILE_M, CELL_M))


def with_numpy(file: Path, packed: bool) -> Cells:
    """LAS → cells."""
    x, y, z, intensity = read_columns(file)
    east, north = ((_TILE_M * tile + v / _QUANTA_PER_M) for tile, v in zip(_ORIGIN_TILE, (x, y), strict=True))
    return to_cells(Points(east, north, z / _QUANTA_PER_M, intensity), CELL_M, packed)


def difference_m(ours: TileCells, theirs: Cells) -> float:
    """Largest difference of the robust heights; the cells have to be the same, with the same points."""
    edge = round(_TILE_M / CELL_M)
    same = (
        np.array_equal(theirs.column - edge * ours.tile.column, ours.column)
        and np.array_equal(theirs.row - edge * ours.tile.row, ours.row)
        and np.array_equal(theirs.count, ours.count)
    )
    if not same:
        raise RuntimeError("roadscan and NumPy do not find the same cells")
    return float(np.abs(ours.height_robust_m - theirs.height_robust_m).max())


def _pdal(folder: Path, file: Path, points: int, here: float, theirs: Cells) -> Iterator[Figure]:
    program = os.environ.get("PDAL") or shutil.which("pdal")
    if program is None:
        note = "PDAL is not here: 0.5 M/s was measured with PDAL 2.7's writers.gdal elsewhere"
        yield Figure(_WHAT, here, "M/s", _PDAL_POINTS_PER_S / 1e6, note)
        return
    raster, pipeline = folder / "pdal.tif", folder / "pdal.json"
    pipeline.write_text(json.dumps(pdal_pipeline(file, raster)))
    started = time.perf_counter()
    subprocess.run([program, "pipeline", str(pipeline)], check=True, capture_output=True)
    rate = points / (time.perf_counter() - started) / 1e6
    yield Figure(_WHAT, here, "M/s", rate, "PDAL writers.gdal, mean and count")
    yield Figure(f"{_WHAT}: median difference of means to PDAL", 1e3 * _median_difference_m(raster, theirs), "mm")


def pdal_pipeline(file: Path, raster: Path) -> list[dict[str, object]]:
    """The pipeline: `binmode` counts only points inside a cell, so that its cells are ours."""
    edge = round(_TILE_M / CELL_M)
    return [
        {"type": "readers.las", "filename": str(file)},
        {
            "type": "writers.gdal", "filename": str(raster), "resolution": CELL_M, "binmode": True,
            "output_type": "mean,count", "data_type": "double", "origin_x": _TILE_M * _ORIGIN_TILE[0],
            "origin_y": _TILE_M * _ORIGIN_TILE[1], "width": edge, "height": edge,
        },
    ]  # fmt: skip


def _median_difference_m(raster: Path, theirs: Cells) -> float:
    """Median over the cells: a point on an edge may count for either side."""
    edge = round(_TILE_M / CELL_M)
    with rasterio.open(raster) as image:
        mean = image.read(1)
    row, column = theirs.row - edge * _ORIGIN_TILE[1], theirs.column - edge * _ORIGIN_TILE[0]
    return float(np.median(np.abs(mean[edge - 1 - row, column] - theirs.height_mean_m)))
