"""The map of cells in which rays search for the road and for bodies."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int64
from roadscan.simulate.kernels import ground as kernels
from roadscan.simulate.kernels import things as body
from roadscan.simulate.kernels.ground import CELL_M, SAMPLE_M, TILE_CELLS, TILE_M, Cells
from roadscan.simulate.kernels.road import STATION
from roadscan.simulate.scene import Road
from roadscan.simulate.surface import Surface

_CHUNK_SAMPLES: Final = 640
"""Stations that are examined at a time."""
_IN_TILE: Final = TILE_CELLS * TILE_CELLS


def cells_of(road: Road, surface: Surface, bodies: Float64) -> Cells:
    """Return the map of a road and of the bodies (n, 19) beside it."""
    extent = _extents(bodies)
    corner, tiles = _tiles(road, surface, extent)
    count = int(tiles.max()) + 1
    top = np.full(count, -np.inf)
    index, body_of = _covered(extent, corner, tiles)
    np.maximum.at(top, index // _IN_TILE, np.maximum(bodies[:, body.HIGH], bodies[:, body.HIGH_END])[body_of] + 0.01)
    order = np.lexsort((body_of, index))
    cells = Cells(
        corner=corner,
        tiles=tiles,
        top=top,
        plane=np.zeros((count * _IN_TILE, 5), np.float32),
        flags=np.zeros(count * _IN_TILE, np.uint8),
        node=np.zeros(count * _IN_TILE, np.int32),
        first=np.searchsorted(index[order], np.arange(count * _IN_TILE + 1)).astype(np.int32),
        members=body_of[order].astype(np.int32),
    )
    _bound(road, surface, cells)
    return cells


def _bound(road: Road, surface: Surface, cells: Cells) -> None:
    """Bound the whole road, piece by piece."""
    nodes = surface.arrays.nodes
    first, last = nodes[0, STATION], nodes[-1, STATION]
    # The narrowest feature across the road needs a few samples over its width.
    widths = [rut.width_m / 8 for rut in road.ruts] + [road.crown_rounding_m / 2, SAMPLE_M]
    across = math.ceil(2 * road.edge_m / max(min(widths), 0.02))
    offset = road.edge_m * (2.0 * np.arange(-1, across + 2, dtype=np.float64) / across - 1.0)
    places = round((last - first) / SAMPLE_M)
    plain = np.empty((_CHUNK_SAMPLES + 2, offset.size))
    for begin in range(0, places + 1, _CHUNK_SAMPLES):
        number = np.arange(begin - 1, min(begin + _CHUNK_SAMPLES, places + 1) + 1, dtype=np.float64)
        kernels.bound_cells(surface.arrays, cells, first + SAMPLE_M * number, offset, plain)


def _extents(bodies: Float64) -> Float64:
    """Return the least and greatest easting and northing (n, 4) of bodies."""
    half_length, half_width = bodies[:, body.HALF_LENGTH], bodies[:, body.HALF_WIDTH]
    is_round = np.isin(bodies[:, body.KIND], (body.CYLINDER, body.ELLIPSOID, body.BUSH))
    sine, cosine = np.abs(bodies[:, body.SINE]), np.abs(bodies[:, body.COSINE])
    # The flat ends of a leaning rod reach out to all sides by its radius at most.
    ends = np.where(bodies[:, body.KIND] == body.ROD, half_width, 0.0)
    east = np.where(is_round, half_length, sine * half_length + np.maximum(cosine * half_width, ends)) + 0.01
    north = np.where(is_round, half_length, cosine * half_length + np.maximum(sine * half_width, ends)) + 0.01
    e, n = bodies[:, body.EASTING], bodies[:, body.NORTHING]
    return np.stack([e - east, n - north, e + east, n + north], axis=-1)


def _tiles(road: Road, surface: Surface, extent: Float64) -> tuple[Float64, npt.NDArray[np.int32]]:
    """Return the corner (2,) of the map, and the number of each tile with road or a body."""
    nodes = surface.arrays.nodes
    offset = np.linspace(-road.edge_m, road.edge_m, math.ceil(2 * road.edge_m / CELL_M) + 1)
    places = []
    for first in range(0, nodes.shape[0], 4096):
        e, n, _ = surface.place(nodes[first : first + 4096, STATION][:, None], offset)
        points = np.stack([e.ravel() - surface.origin_enh_m[0], n.ravel() - surface.origin_enh_m[1]], axis=-1)
        # A sample's neighbours are less than a metre away.
        spread = [points + np.array(move) for move in ((-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0))]
        places.append(np.unique(np.floor(np.concatenate(spread) / TILE_M).astype(np.int64), axis=0))
    i, j, _ = _squares(extent, np.zeros(2), TILE_M)
    places.append(np.stack([i, j], axis=-1))
    used = np.unique(np.concatenate(places), axis=0)
    low, high = used.min(axis=0), used.max(axis=0)
    tiles = np.full((high - low + 1)[::-1], -1, np.int32)
    tiles[used[:, 1] - low[1], used[:, 0] - low[0]] = np.arange(len(used))
    return low * TILE_M, tiles


def _covered(extent: Float64, corner: Float64, tiles: npt.NDArray[np.int32]) -> tuple[Int64, Int64]:
    """Return the cells that bodies overlap, and the body of each."""
    i, j, body_of = _squares(extent, corner, CELL_M)
    tile = tiles[j // TILE_CELLS, i // TILE_CELLS].astype(np.int64)
    return (tile * TILE_CELLS + j % TILE_CELLS) * TILE_CELLS + i % TILE_CELLS, body_of


def _squares(extent: Float64, corner: Float64, size_m: float) -> tuple[Int64, Int64, Int64]:
    """Return column and row of the squares of a grid that bodies overlap, and the body of each."""
    low = np.floor((extent[:, :2] - corner) / size_m).astype(np.int64)
    high = np.floor((extent[:, 2:] - corner) / size_m).astype(np.int64)
    size = high - low + 1
    count = size[:, 0] * size[:, 1]
    body_of = np.repeat(np.arange(len(extent)), count)
    number = np.arange(body_of.size) - np.repeat(np.cumsum(count) - count, count)
    return low[body_of, 0] + number % size[body_of, 0], low[body_of, 1] + number // size[body_of, 0], body_of
