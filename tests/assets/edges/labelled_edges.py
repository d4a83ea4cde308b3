"""Edges between road and sidewalk as hand labels draw them, and how well found lines meet edges that are known."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import shapely
from scipy.spatial import cKDTree

from roadscan.assets.returns import Returns

Array = np.ndarray[Any, Any]
ROAD_SIDE, SIDEWALK = (40, 44, 60), 48
CELL_M = 0.2
AROUND_M = 0.5


class LabelledEdges(NamedTuple):
    """Middles (m, 2) between neighbouring cells of road and sidewalk, and the step there (m)."""

    places: Array
    step_m: Array


def labelled_edges(r: Returns, labels: Array, beyond: tuple[int, ...] = (SIDEWALK,)) -> LabelledEdges:
    """Edges at most one cell wide between cells of 0.2 m of road (40, 44, 60) and such of sidewalk (48).

    beyond : other labels that may lie beyond the edge.
    """
    road, walk = np.isin(labels, ROAD_SIDE), np.isin(labels, beyond)
    keep = road | walk
    cell = np.column_stack([np.floor(r.x_m[keep] / CELL_M), np.floor(r.y_m[keep] / CELL_M)]).astype(int)
    cells, inverse = np.unique(cell, axis=0, return_inverse=True)
    walks = np.bincount(inverse.ravel(), walk[keep])
    count = np.bincount(inverse.ravel())
    height = np.bincount(inverse.ravel(), r.height_m[keep]) / count
    is_walk = walks > count / 2
    middle = (cells + 0.5) * CELL_M
    walk_tree, road_tree = cKDTree(middle[is_walk]), cKDTree(middle[~is_walk])
    near, at = walk_tree.query(middle[~is_walk], distance_upper_bound=2.3 * CELL_M)
    found = np.isfinite(near)
    places = (middle[~is_walk][found] + middle[is_walk][at[found]]) / 2
    around = [tree.query_ball_point(places, AROUND_M) for tree in (walk_tree, road_tree)]
    levels = [height[is_walk], height[~is_walk]]
    step = [np.median(levels[0][a]) - np.median(levels[1][b]) for a, b in zip(*around, strict=True)]
    return LabelledEdges(places, np.array(step))


def points_along(lines: list[Array], every_m: float = 0.1) -> Array:
    """Points (m, 2) along lines, at even distances."""
    parts = [np.zeros((0, 2))]
    for line in lines:
        whole = shapely.LineString(line[:, :2])
        at = np.arange(every_m / 2, whole.length, every_m)
        parts.append(shapely.get_coordinates(shapely.line_interpolate_point(whole, at)))
    return np.concatenate(parts)


def share_within(points: Array, others: Array, distance_m: float) -> float:
    """Share of points (m, 2) that have one of the others (k, 2) within a distance."""
    return float(np.mean(cKDTree(others).query(points)[0] <= distance_m))
