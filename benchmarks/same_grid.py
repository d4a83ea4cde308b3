"""The same grid from the same points: a LAS file → cells of 20 mm, with roadscan, NumPy and PDAL."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import laspy
import numpy as np
import rasterio

from benchmarks.skilled_user import Cells, Points, to_cells
from benchmarks.timing import Figure, best_seconds
from roadscan.model.ids import TileId
from roadscan.points.cloud import TilePoints
from roadscan.tiles.cells import TileCells
from roadscan.tiles.grid import TileGrid
from roadscan.tiles.statistics import cells_of

CELL_M = 0.02
_TILE_M = 10.0
_QUANTA_PER_M = 100_000
_ORIGIN_TILE = (56_321, 593_487)
_PDAL_POINTS_PER_S = 0.5e6
"""PDAL 2.7, `writers.gdal`, LAS in, 20 million points, 20 mm cells, on another day's run of a like machine."""


def figures(folder: Path, points: int) -> Iterator[Figure]:
    """One core each."""
    file = write_points(folder / "points.las", points)
    ours: list[TileCells] = []
    theirs: list[Cells] = []
    here = points / best_seconds(lambda: ours.append(with_roadscan(file)), runs=2) / 1e6
    what = "same grid from the same points (LAS → cells of 20 mm)"
    for packed, how in ((True, "NumPy: one sort of 64-bit numbers"), (False, "NumPy: lexsort")):
        started = time.perf_counter()
        theirs.append(with_numpy(file, packed))
        yield Figure(what, here, "M/s", points / (time.perf_counter() - started) / 1e6, how)
    yield Figure(f"{what}: largest difference to NumPy (bar: 0.1)", 1e3 * difference_m(ours[-1], theirs[0]), "mm")
    yield from _pdal(folder, file, points, here, theirs[0])
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


def with_roadscan(file: Path) -> TileCells:
    """LAS → cells."""
    las = laspy.read(file)
    x, y, z = (np.ascontiguousarray(las[axis]) for axis in "XYZ")
    none, one = np.zeros(len(las), np.int64), np.ones(len(las), np.uint8)
    passes = one.astype(np.uint16)
    intensity = np.ascontiguousarray(las.intensity)
    return cells_of(TilePoints(TileId(*_ORIGIN_TILE), x, y, z, none, intensity, one, passes), TileGrid(_TILE_M, CELL_M))


def with_numpy(file: Path, packed: bool) -> Cells:
    """LAS → cells."""
    las = laspy.read(file)
    return to_cells(Points(*(np.asarray(v) for v in (las.x, las.y, las.z, las.intensity))), CELL_M, packed)


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
    what = "same grid from the same points (LAS → cells of 20 mm)"
    if program is None:
        note = "PDAL is not here: 0.5 M/s was measured with PDAL 2.7's writers.gdal elsewhere"
        yield Figure(what, here, "M/s", _PDAL_POINTS_PER_S / 1e6, note)
        return
    raster, pipeline = folder / "pdal.tif", folder / "pdal.json"
    pipeline.write_text(json.dumps(pdal_pipeline(file, raster)))
    started = time.perf_counter()
    subprocess.run([program, "pipeline", str(pipeline)], check=True, capture_output=True)
    rate = points / (time.perf_counter() - started) / 1e6
    yield Figure(what, here, "M/s", rate, "PDAL writers.gdal, mean and count")
    yield Figure(f"{what}: median difference of means to PDAL", 1e3 * _median_difference_m(raster, theirs), "mm")


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
