"""A street of profiles as COPC: points a second from the points of tiles to the file, and size beside copclib's."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.timing import Figure
from roadscan.core.crs import MapFrame
from roadscan.core.grid import QUANTA_PER_M, TileGrid, TileId
from roadscan.georeference.cloud import TilePoints
from roadscan.site.cloud_file import PointSpool, write_cloud
from roadscan.tiles.products.las import Lattice

TILES, POINTS = 12, 500_000
GRID = TileGrid(10.0, 0.005)
ACROSS = 2000


def figures(folder: Path) -> Iterator[Figure]:
    """Points a second, by the clock on the wall and by processor time; bytes a point."""
    lattice = Lattice(MapFrame("EPSG:32632"), GRID, (690_000.0, 5_334_000.0, 500.0))
    for _ in range(2):  # the first one compiles
        spool = PointSpool(folder / "points", lattice)
        began = time.perf_counter()
        spool.fill(_tiles())
        filled = time.perf_counter()
        processor = time.process_time()
        write_cloud(folder / "a.copc.laz", spool, lattice, {})
        wall_s, processor_s = time.perf_counter() - filled, time.process_time() - processor
    count = TILES * POINTS
    size = (folder / "a.copc.laz").stat().st_size
    yield Figure("COPC: octree and file, points a second by the clock", count / wall_s, "/s", 2e6, "two cores")
    yield Figure("COPC: the same by processor time of one core", count / processor_s, "/s")
    yield Figure("COPC: points of tiles into squares on the disk", count / (filled - began), "/s")
    other = _of_copclib(folder)
    yield Figure("COPC: bytes a point", size / count, "B", None if other is None else other / count, "copclib")


def _tiles() -> Iterator[TilePoints]:
    """Profiles across a lane that crosses tiles on the slant, with noise of half a millimetre."""
    rng = np.random.default_rng(1)
    edge = int(GRID.size_m * QUANTA_PER_M)
    for number in range(TILES):
        along = np.repeat(np.linspace(0, 0.6, POINTS // ACROSS), ACROSS) * edge
        across = np.tile(np.linspace(0, 0.4, ACROSS), POINTS // ACROSS) * edge
        height = 55_000_000 + 0.02 * across + rng.normal(0.0, 50.0, POINTS)
        epoch = 1_461_922_220_000_000_000 + number * 10**9 + np.repeat(np.arange(POINTS // ACROSS), ACROSS) * 35_714
        yield TilePoints(
            TileId(69_000 + number, 533_400), (along + 0.3 * across).astype(np.int32),
            (across + 0.3 * along).astype(np.int32), height.astype(np.int32), epoch.astype(np.int64),
            rng.normal(1000.0, 60.0, POINTS).clip(0, 65_535).astype(np.uint16), np.ones(POINTS, np.uint8),
            np.ones(POINTS, np.uint16),
        )  # fmt: skip


def _of_copclib(folder: Path) -> int | None:
    """Bytes of the same nodes as copclib writes them; None where it is not installed."""
    try:
        import copclib
    except ImportError:
        return None
    reader = copclib.FileReader(str(folder / "a.copc.laz"))
    writer = copclib.FileWriter(str(folder / "b.copc.laz"), copclib.CopcConfigWriter(reader.copc_config))
    for node in reader.GetAllNodes():
        writer.AddNode(node.key, reader.GetPointData(node))
    writer.Close()
    return (folder / "b.copc.laz").stat().st_size
