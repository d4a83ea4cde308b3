"""Edges of the road and ends of sidewalks where green ground begins, as pictures show it."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import pyarrow as pa
import scipy.ndimage
import scipy.spatial

from roadscan.assets.green.colours import FINE, FINE_M
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.arrays import scatter_about

_ACROSS_M: Final = 0.5
"""An edge is moved by no more than this (m): what the slope of a verge leaves open."""
_ALONG_M: Final = 0.6  # Places this near along an edge tell where it lies (m).
_LEAST: Final = 10  # Least number of such places: half of the fine cells on the way.
_SMOOTHED: Final = 5  # Nodes of the median of what an edge is moved by.
_BEGIN_M: Final = 0.15
"""A surface is followed from here behind its edge (m)."""
_LAWN_M: Final = 0.3
"""Green ground narrower than this (m) ends no sidewalk."""


class GreenGround:
    """Fine cells that are planted, those that are not, and the places between both."""

    def __init__(self, green: pa.Table) -> None:
        column, row, mask = (green[name].to_numpy() for name in ("column", "row", "mask"))
        self._first = (int(column.min()) - 1, int(row.min()) - 1) if column.size else (0, 0)
        shape = (int(row.max()) - self._first[1] + 2, int(column.max()) - self._first[0] + 2) if column.size else (1, 1)
        bits = ((mask[:, None] >> np.arange(FINE * FINE)) & 1).astype(np.int8)
        cells = np.full((*shape, FINE, FINE), -1, np.int8)
        cells[row - self._first[1], column - self._first[0]] = bits.reshape(-1, FINE, FINE)
        self._fine = cells.transpose(0, 2, 1, 3).reshape(shape[0] * FINE, shape[1] * FINE)
        sigma = np.full(shape, np.nan)
        sigma[row - self._first[1], column - self._first[0]] = green["sigma_m"].to_numpy()
        self._sigma_m = sigma
        self.edge_m, self.edge_sigma_m = self._edges()

    def _edges(self) -> tuple[Float64, Float64]:
        """Returns places (n, 2) between planted and other fine cells, and σ of each (m)."""
        places, sigmas = [], []
        for axis in (0, 1):
            first = np.moveaxis(self._fine, axis, 0)
            a, b = np.nonzero((first[:-1] >= 0) & (first[1:] >= 0) & (first[:-1] != first[1:]))
            at = (a, b) if axis == 0 else (b, a)
            shift = np.array([0.5, 1.0]) if axis == 0 else np.array([1.0, 0.5])
            places.append((np.column_stack([at[1], at[0]]) + shift) * FINE_M)
            sigmas.append(self._sigma_m[at[0] // FINE, at[1] // FINE])
        corner = np.array(self._first) * FINE * FINE_M
        return np.concatenate(places) + corner, np.concatenate(sigmas)

    def is_green(self, places_m: Float64) -> Bool:
        """Returns which places (…, 2) of the map are planted."""
        at = np.floor(places_m / FINE_M).astype(np.int64) - np.array(self._first) * FINE
        inside = ((at >= 0) & (at < np.array(self._fine.shape[::-1]))).all(axis=-1)
        column, row = (np.where(inside, at[..., k], 0) for k in (0, 1))
        return np.asarray(inside & (self._fine[row, column] == 1))


def _normals(x: Float64, y: Float64) -> Float64:
    """Returns unit vectors (n, 2) to the right of a line."""
    way = np.column_stack([np.gradient(x), np.gradient(y)])
    way /= np.maximum(np.hypot(*way.T), 1e-9)[:, None]
    return np.column_stack([way[:, 1], -way[:, 0]])


def moved_to_green(pieces: pa.Table, green: pa.Table) -> pa.Table:
    """Returns pieces of road edges whose nodes at verges lie where green ground begins, with the σ of the pictures."""
    ground, rows = GreenGround(green), pieces.to_pylist()
    if not len(ground.edge_m):
        return pieces
    tree = scipy.spatial.cKDTree(ground.edge_m)
    for row in rows:
        x, y, sigma = (np.array(row[name]) for name in ("easting_m", "northing_m", "sigma_m"))
        free = (np.array(row["by_kerb"]) <= 0.5) & (np.array(row["by_barrier"]) <= 0.5)
        if len(x) < 3 or not free.any():
            continue
        normal = _normals(x, y)
        off, own_sigma = np.full(len(x), np.nan), np.full(len(x), np.nan)
        for k in np.flatnonzero(free).tolist():
            near = np.array(tree.query_ball_point([x[k], y[k]], np.hypot(_ACROSS_M, _ALONG_M)), np.int64)
            off[k], own_sigma[k] = _offset(ground, near, np.array([x[k], y[k]]), normal[k])
        known = np.flatnonzero(np.isfinite(off))
        if known.size < 3:
            continue
        off[known] = scipy.ndimage.median_filter(off[known], _SMOOTHED, mode="nearest")
        row["easting_m"] = (x + np.nan_to_num(off) * normal[:, 0]).tolist()
        row["northing_m"] = (y + np.nan_to_num(off) * normal[:, 1]).tolist()
        row["sigma_m"] = np.where(np.isfinite(off), own_sigma, sigma).tolist()
    return pa.Table.from_pylist(rows, schema=pieces.schema)


def _offset(ground: GreenGround, near: Int64, place_m: Float64, normal: Float64) -> tuple[float, float]:
    """Returns how far to the right of a node green ground begins, and its σ (m); NaN where it is not known."""
    step = ground.edge_m[near] - place_m
    across, along = step @ normal, step @ np.array([-normal[1], normal[0]])
    held = (np.abs(across) <= _ACROSS_M) & (np.abs(along) <= _ALONG_M)
    if np.count_nonzero(held) < _LEAST:
        return np.nan, np.nan
    middle = float(np.median(across[held]))
    scatter = scatter_about(across[held], middle)
    return middle, float(np.hypot(np.mean(ground.edge_sigma_m[near[held]]), scatter))


def ended_at_green(pieces: pa.Table, green: pa.Table) -> pa.Table:
    """Returns pieces of edges whose surfaces behind them end where green ground begins."""
    ground, rows = GreenGround(green), pieces.to_pylist()
    for row in rows:
        x, y, width = (np.array(row[name]) for name in ("easting_m", "northing_m", "width_m"))
        if len(x) < 2:
            continue
        ended, known = _ended(ground, np.column_stack([x, y]), _normals(x, y), width)
        if not known.any():
            continue
        row["width_m"] = ended.tolist()
        row["ends_known"] = np.where(known, 1.0, np.array(row["ends_known"])).tolist()
        row["ends_down"] = np.where(known, 0.0, np.array(row["ends_down"])).tolist()
    return pa.Table.from_pylist(rows, schema=pieces.schema)


def _ended(ground: GreenGround, places_m: Float64, normal: Float64, width_m: Float64) -> tuple[Float64, Bool]:
    """Returns the width (n,) of surfaces up to green ground, and where that ends them."""
    most = float(np.nanmax(width_m, initial=0.0))
    at = np.arange(_BEGIN_M, most + _LAWN_M, FINE_M)
    if at.size < round(_LAWN_M / FINE_M):
        return width_m, np.zeros(len(width_m), np.bool_)
    lawn: Any = ground.is_green(places_m[:, None] + at[None, :, None] * normal[:, None])
    whole = np.lib.stride_tricks.sliding_window_view(lawn, round(_LAWN_M / FINE_M), axis=1).all(axis=2)
    first = at[np.argmax(whole, axis=1)] - FINE_M / 2
    known = np.asarray(whole.max(axis=1) & (first < width_m), np.bool_)
    return np.where(known, first, width_m), known
