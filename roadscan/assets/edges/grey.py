"""Road edges of returns and those between grey surfaces, which only pictures show: one edge on each side of a road."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import pyarrow as pa
import scipy.ndimage
import scipy.spatial

from roadscan.assets.edges.line_pieces import dense
from roadscan.compute.array_types import Bool, Float64

_MOVED_M: Final = 0.5
"""An edge that returns show is moved by no more than this (m)."""
_SIDEWALK_M, _FRONT_M = 3.0, 10.0
"""Verges this far behind a picture's edge (m) are the end of a sidewalk, and façades and rails this far (m)."""
_ALONG_M: Final = 0.6  # Nodes so near to one another along an edge are compared (m).
_PARALLEL: Final = 0.7  # Least cosine between the directions of two edges of one side of a road: 45°.
_EVERY_M: Final = 0.25  # Distance of the places that are compared (m).


def with_pictured(pieces: pa.Table, edges: pa.Table) -> pa.Table:
    """Returns pieces of road edges with those of pictures; of two on one side, the one nearer to the road stays.

    Kerbs stay as they are, also up to 3 m behind a picture's edge: a strip to park on lies between. A verge within half
    a metre of one is moved there.
    """
    if not edges.num_rows:
        return pieces
    rows, pictured = pieces.to_pylist(), edges.cast(pieces.schema).to_pylist()
    taken = [np.zeros(len(row["easting_m"]), np.bool_) for row in pictured]
    out: list[dict[str, Any]] = []
    for right in (False, True):
        chosen = [k for k, row in enumerate(pictured) if (row["right"][0] > 0.5) == right]
        some = [row for row in rows if (row["right"][0] > 0.5) == right]
        shown = _Shown(pictured, chosen, right)
        for row in some:
            out += _parts(row, shown.settled(row, right, taken))
    for row, gone in zip(pictured, taken, strict=True):
        out += _parts(row, ~gone)
    return pa.Table.from_pylist(out, schema=pieces.schema)


class _Shown:
    """Edges of pictures on one side of the roads."""

    def __init__(self, rows: list[dict[str, Any]], chosen: list[int], right: bool) -> None:
        parts = []
        for k in chosen:
            line = np.column_stack([rows[k]["easting_m"], rows[k]["northing_m"]])
            x, y = dense(line, _EVERY_M)
            node = scipy.spatial.cKDTree(line).query(np.column_stack([x, y]))[1]
            sigma = np.array(rows[k]["sigma_m"])[node]
            parts.append(np.column_stack([x, y, np.full(x.size, k), node, sigma, _outward(x, y, right)]))
        self._places = np.concatenate([np.zeros((0, 7)), *parts])
        self._tree = scipy.spatial.cKDTree(self._places[:, :2])

    def settled(self, row: dict[str, Any], right: bool, taken: list[Bool]) -> Bool:
        """Returns which nodes (n,) of an edge of returns stay, moves them, and marks nodes of pictures that go.

        An edge is compared with the nearest one of pictures that runs in the same direction: those of the other
        carriageway of a divided road, and of roads that cross, do not count.
        """
        x, y, sigma = (np.array(row[name]) for name in ("easting_m", "northing_m", "sigma_m"))
        kerb, barrier = (np.array(row[name]) > 0.5 for name in ("by_kerb", "by_barrier"))
        stays, out = np.ones(x.size, np.bool_), _outward(x, y, right)
        for k, near in enumerate(self._tree.query_ball_point(np.column_stack([x, y]), _FRONT_M)):
            step = np.array([x[k], y[k]]) - self._places[near, :2]
            away, along = step @ out[k], np.abs(step @ np.array([-out[k, 1], out[k, 0]]))
            kept = np.flatnonzero((along <= _ALONG_M) & (self._places[near, 5:] @ out[k] >= _PARALLEL))
            if not kept.size:
                continue
            first = kept[np.argmin(np.hypot(away[kept], along[kept]))]
            beyond, place = float(away[first]), self._places[near[first]]
            at_it = kept[np.abs(away[kept] - beyond) <= _MOVED_M]
            if -_SIDEWALK_M <= beyond <= (_SIDEWALK_M if kerb[k] else _MOVED_M):
                if abs(beyond) <= _MOVED_M and not (kerb[k] or barrier[k]):
                    x[k], y[k], sigma[k] = x[k] - beyond * out[k, 0], y[k] - beyond * out[k, 1], place[4]
                for at in at_it.tolist():
                    taken[int(self._places[near[at], 2])][int(self._places[near[at], 3])] = True
            elif beyond > 0.0 and not kerb[k] and (barrier[k] or beyond <= _SIDEWALK_M):
                stays[k] = False
        row |= {"easting_m": x.tolist(), "northing_m": y.tolist(), "sigma_m": sigma.tolist()}
        return stays


def _outward(x: Float64, y: Float64, right: bool) -> Float64:
    """Returns unit vectors (n, 2) from the road to the side of its edge, whose nodes lie in the drive's direction."""
    way = np.column_stack([np.gradient(x), np.gradient(y)]) if len(x) > 1 else np.zeros((len(x), 2))
    way /= np.maximum(np.hypot(*way.T), 1e-9)[:, None]
    return np.column_stack([way[:, 1], -way[:, 0]]) * (1.0 if right else -1.0)


def _parts(row: dict[str, Any], stays: Bool) -> list[dict[str, Any]]:
    """Returns the runs of the nodes of an edge that stay."""
    if stays.all():
        return [row]
    number, count = scipy.ndimage.label(stays)
    lists = [name for name, value in row.items() if isinstance(value, list) and name != "passes"]
    found = []
    for k in range(1, count + 1):
        at = np.flatnonzero(number == k)
        if at.size >= 2:
            first, last = int(at[0]), int(at[-1])
            cut = row["cut_first"] and first == 0, row["cut_last"] and last == stays.size - 1
            part = {name: row[name][first : last + 1] for name in lists}
            found.append(row | part | {"cut_first": cut[0], "cut_last": cut[1]})
    return found
