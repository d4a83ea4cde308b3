"""How well the products of a labelled street meet its labels, a measure a function.

Labels are SemanticKITTI's. What those who labelled did not judge counts neither for nor against an object.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import geopandas
import numpy as np
import numpy.typing as npt
import shapely
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from benchmarks.asset_scores import Judged
from benchmarks.labelled_street import LabelledStreet
from roadscan.assets import classes

Float64 = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

ROAD, PARKING, SIDEWALK, MARKING, TERRAIN = 40, 44, 48, 60, 72
CAR, BUILDING, FENCE, STRUCTURE, VEGETATION, TRUNK, POLE, SIGN = 10, 50, 51, 52, 70, 71, 80, 81
GROUND: Final = (ROAD, PARKING, SIDEWALK, MARKING, TERRAIN)
NOT_JUDGED: Final = (0, 1, 20, 99, 254, 255)
ON_GROUND: Final = (classes.GROUND, classes.ROAD, classes.KERB, classes.MARKING, classes.SIDEWALK)
UPRIGHT_KINDS: Final = ("pole", "lighting", "signal", "tree")
_CLUSTER_M: Final = 0.5
"""Returns of a label nearer than this belong to one thing (m)."""
LEAST: Final = {POLE: 30, TRUNK: 60, SIGN: 100}
"""Returns of a thing that has to be found, by its label."""
_NEAR_M: Final = 0.5
"""An object is the thing whose axis it lies so near to (m)."""
_AROUND_M: Final = 0.3
"""Returns so near to an object's axis tell what it is (m)."""
_EDGE_CELL_M: Final = 0.2
_HIGH_M: Final = 0.05
"""Least step of a kerb that is judged (m); labels say nothing of lower ones."""
_EDGE_NEAR_M: Final = 0.3
_PAINT_CELL_M: Final = 0.1
_PAINT_HALF_M: Final = 40.0
"""Paint is judged this far about the first pose (m)."""


class Found(NamedTuple):
    """Shares of what is there that was found, and of what was found that is there."""

    recall: float
    precision: float
    wanted: int
    judged: int


def ground_iou(street: LabelledStreet) -> float:
    """Intersection over union of the returns on the ground."""
    judged = ~np.isin(street.point_labels, NOT_JUDGED)
    found, true = np.isin(street.classes, ON_GROUND) & judged, np.isin(street.point_labels, GROUND) & judged
    return float((found & true).sum() / (found | true).sum())


def share_of_class(street: LabelledStreet, label: int, *codes: int) -> float:
    """Share of the returns of a label that products give one of some classes."""
    return float(np.isin(street.classes[street.point_labels == label], codes).mean())


def iou_of_class(street: LabelledStreet, labels: tuple[int, ...], *codes: int) -> float:
    """Intersection over union of some labels and some classes."""
    judged = ~np.isin(street.point_labels, NOT_JUDGED)
    found, true = np.isin(street.classes, codes) & judged, np.isin(street.point_labels, labels) & judged
    return float((found & true).sum() / max(int((found | true).sum()), 1))


def things(places_m: Float64, labels: npt.NDArray[np.uint8], label: int) -> list[npt.NDArray[np.int64]]:
    """Rows of the labelled returns (n, 3) of each thing with enough of them."""
    rows = np.flatnonzero(labels == label)
    if not rows.size:
        return []
    tree = cKDTree(places_m[rows])
    near = tree.sparse_distance_matrix(tree, _CLUSTER_M, output_type="coo_matrix")
    _, number = connected_components(near, directed=False)
    held = np.bincount(number) >= LEAST[label]
    return [rows[number == k] for k in np.flatnonzero(held)]


def poles_and_trunks(street: LabelledStreet) -> Found:
    """Poles and trunks that have an object of their own, and objects that stand at one (or at a sign's post)."""
    wanted = [_axis(street, rows) for label in (POLE, TRUNK) for rows in things(street.places_m, street.labels, label)]
    objects = street.objects(*UPRIGHT_KINDS)
    places = objects[["easting_m", "northing_m"]].to_numpy(float) if len(objects) else np.zeros((0, 2))
    found = sum(1 for _ in _pairs(np.array(wanted).reshape(-1, 2), places, _NEAR_M))
    right = [one.is_right for one in judged_uprights(street)]
    return Found(found / max(len(wanted), 1), float(np.mean(right)) if right else 1.0, len(wanted), len(right))


def missed(street: LabelledStreet) -> list[tuple[str, float, float, int]]:
    """Label, place and returns of poles and trunks without an object."""
    objects = street.objects(*UPRIGHT_KINDS)
    places = objects[["easting_m", "northing_m"]].to_numpy(float)
    out = []
    for name, label in (("pole", POLE), ("trunk", TRUNK)):
        rows = things(street.places_m, street.labels, label)
        axes = np.array([_axis(street, one) for one in rows]).reshape(-1, 2)
        held = {i for i, _ in _pairs(axes, places, _NEAR_M)}
        out += [(name, *axes[k].round(2), one.size) for k, one in enumerate(rows) if k not in held]
    return out


def judged_uprights(street: LabelledStreet, *, by_type: bool = False) -> Iterator[Judged]:
    """Objects that stand upright, but for those at which hardly anything was judged.

    by_type : a tree is right at a trunk alone, all else at a pole or a sign's post.
    """
    for kind in UPRIGHT_KINDS:
        for one in street.objects(kind).itertuples():
            seen = _labels_about(street, one.easting_m, one.northing_m, one.height_m)
            if np.isin(seen, NOT_JUDGED).mean() > 0.4:
                continue
            right = np.isin(seen, (POLE, TRUNK, SIGN)).mean() > 0.3
            if by_type:
                right &= bool((np.mean(seen == TRUNK) > np.isin(seen, (POLE, SIGN)).mean()) == (kind == "tree"))
            yield Judged(kind, float(one.probability), float(right))


def _labels_about(street: LabelledStreet, x_m: float, y_m: float, foot_m: float) -> npt.NDArray[np.uint8]:
    """Labels of the returns about an axis, from 0.3 m to 2.5 m above its foot."""
    near = np.hypot(street.places_m[:, 0] - x_m, street.places_m[:, 1] - y_m) < _AROUND_M
    near &= (street.places_m[:, 2] > foot_m + 0.3) & (street.places_m[:, 2] < foot_m + 2.5)
    return street.labels[near] if near.any() else np.zeros(1, np.uint8)


def _axis(street: LabelledStreet, rows: npt.NDArray[np.int64]) -> Float64:
    """Place (2,) of a thing: the middle of the lower half of its returns."""
    own = street.places_m[rows]
    low = own[own[:, 2] <= np.median(own[:, 2])]
    return np.asarray(np.median(low[:, :2], axis=0))


def _pairs(wanted: Float64, places: Float64, reach_m: float) -> Iterator[tuple[int, int]]:
    """Nearest pairs within reach, each once."""
    if not len(wanted) or not len(places):
        return
    away = np.hypot(*(wanted[:, None] - places[None]).transpose(2, 0, 1))
    order = np.argsort(away, axis=None, kind="stable")
    used_w, used_p = set(), set()
    for i, j in zip(*np.unravel_index(order, away.shape), strict=True):
        if away[i, j] > reach_m:
            return
        if i not in used_w and j not in used_p:
            used_w.add(i)
            used_p.add(j)
            yield int(i), int(j)


def signs(street: LabelledStreet) -> tuple[int, int, int]:
    """Strong signs that were found, strong signs, and judged objects that are no sign."""
    table, wanted = street.objects("sign"), things(street.places_m, street.labels, SIGN)
    found = 0
    for rows in wanted:
        middle = street.places_m[rows].mean(axis=0)
        found += any(np.linalg.norm(np.array([s.easting_m, s.northing_m, s.height_m]) - middle) < _NEAR_M
                     for s in table.itertuples())  # fmt: skip
    false = 0
    for one in table.itertuples():
        place = np.array([one.easting_m, one.northing_m, one.height_m])
        half = 0.5 * max(one.width_m, one.plate_height_m)
        seen = street.labels[np.linalg.norm(street.places_m - place, axis=1) < half]
        false += bool(seen.size and np.isin(seen, NOT_JUDGED).mean() <= 0.5 and (seen == SIGN).mean() < 0.3)
    return found, len(wanted), false


class LabelledEdges(NamedTuple):
    """Middles (m, 2) between neighbouring cells of road and sidewalk, and the step there (m)."""

    places: Float64
    step_m: Float64


def labelled_edges(
    places_m: Float64, labels: npt.NDArray[np.uint8], beyond: tuple[int, ...] = (SIDEWALK,)
) -> LabelledEdges:
    """Edges of returns (n, 3), at most one cell wide, between cells of 0.2 m of road and of what lies beyond it."""
    road, walk = np.isin(labels, (ROAD, PARKING, MARKING)), np.isin(labels, beyond)
    keep = road | walk
    places = places_m[keep]
    cells, inverse = np.unique(np.floor(places[:, :2] / _EDGE_CELL_M).astype(int), axis=0, return_inverse=True)
    count = np.bincount(inverse.ravel())
    height = np.bincount(inverse.ravel(), places[:, 2]) / count
    is_walk = np.bincount(inverse.ravel(), walk[keep]) > count / 2
    middle = (cells + 0.5) * _EDGE_CELL_M
    walks, roads = cKDTree(middle[is_walk]), cKDTree(middle[~is_walk])
    near, at = walks.query(middle[~is_walk], distance_upper_bound=2.3 * _EDGE_CELL_M)
    found = np.isfinite(near)
    edge = (middle[~is_walk][found] + middle[is_walk][at[found]]) / 2
    around = [tree.query_ball_point(edge, 0.5) for tree in (walks, roads)]
    levels = [height[is_walk], height[~is_walk]]
    step = [np.median(levels[0][a]) - np.median(levels[1][b]) for a, b in zip(*around, strict=True)]
    return LabelledEdges(edge, np.array(step))


def kerbs(street: LabelledStreet, beyond: tuple[int, ...] = (SIDEWALK,)) -> Found:
    """Labelled edges of the road of 5 cm or more that have a kerb, and kerbs of 5 cm or more at such an edge.

    beyond : labels of what lies on the other side of these edges.

    Judged is the part of the street 40 m behind, 60 m ahead of and 30 m beside the first pose.
    """
    table, edges = street.objects("kerb"), labelled_edges(street.places_m, street.labels, beyond)
    part = shapely.box(-40.0, -30.0, 60.0, 30.0)
    inside = shapely.contains_xy(part, edges.places)
    wanted = edges.places[inside & (edges.step_m >= _HIGH_M)]
    found = points_along([one.intersection(part) for one in table.geometry]) if len(table) else np.zeros((0, 2))
    high = [one.intersection(part) for one in table.geometry[table.step_m >= _HIGH_M]] if len(table) else []
    marked = points_along(high)
    return Found(share_within(wanted, found), share_within(marked, edges.places), len(wanted), len(marked))


def points_along(lines: list[Any], every_m: float = 0.1) -> Float64:
    """Points (m, 2) along lines, at even distances."""
    parts = [np.zeros((0, 2))]
    for line in shapely.get_parts(lines):
        at = np.arange(every_m / 2, line.length, every_m)
        parts.append(shapely.get_coordinates(shapely.line_interpolate_point(shapely.force_2d(line), at)))
    return np.concatenate(parts)


def share_within(points: Float64, others: Float64, reach_m: float = _EDGE_NEAR_M) -> float:
    """Share of points (m, 2) that have one of the others (k, 2) within reach; NaN of none."""
    if not len(points):
        return float("nan")
    return float(np.mean(cKDTree(others).query(points)[0] <= reach_m)) if len(others) else 0.0


def markings_f1(street: LabelledStreet) -> float:
    """F1 of cells of 0.1 m; a cell is paint where half of its returns are, as labelled and as found."""
    near = (np.abs(street.points_m[:, :2]) <= _PAINT_HALF_M).all(axis=1)
    near &= ~np.isin(street.point_labels, NOT_JUDGED)
    place = np.floor(street.points_m[near, :2] / _PAINT_CELL_M)
    _, cell = np.unique(place, axis=0, return_inverse=True)
    count = np.bincount(cell.ravel())
    marked = [street.point_labels[near] == MARKING, street.classes[near] == classes.MARKING]
    true, found = (np.bincount(cell.ravel(), weights=m) >= count / 2 for m in marked)
    return float(2 * (true & found).sum() / max(int(true.sum() + found.sum()), 1))


def judged_objects(street: LabelledStreet) -> list[Judged]:
    """All objects that labels can judge: what stands upright, signs, kerbs, façades, fences and walls, paint."""
    out = list(judged_uprights(street, by_type=True))  # their probability is that of their type, too
    edges = labelled_edges(street.places_m, street.labels, (SIDEWALK, TERRAIN)).places
    out += [
        Judged("kerb", one.probability, share_within(points_along([one.geometry]), edges))
        for one in street.objects("kerb").itertuples()
        if one.step_m >= _HIGH_M
    ]
    wanted = {"facade": (BUILDING,), "fence": (FENCE,), "wall": (FENCE, BUILDING, STRUCTURE),
              **dict.fromkeys(("barrier", "guardrail"), (FENCE, STRUCTURE))}  # fmt: skip
    for kind, labels in wanted.items():
        for one in street.objects(kind).itertuples():
            share = _share_along(street, one.geometry, labels)
            if share is not None:
                out.append(Judged(kind, one.probability, float(share > 0.5)))
    for one in street.objects("sign").itertuples():
        place = np.array([one.easting_m, one.northing_m, one.height_m])
        half = 0.5 * max(one.width_m, one.plate_height_m)
        seen = street.labels[np.linalg.norm(street.places_m - place, axis=1) < half]
        if seen.size and np.isin(seen, NOT_JUDGED).mean() <= 0.5:
            out.append(Judged("sign", one.probability, float((seen == SIGN).mean() >= 0.3)))
    for kind in ("lane_line", "road_marking"):
        for one in street.objects(kind).itertuples():
            share = _share_on_paint(street, one.geometry)
            if share is not None:
                out.append(Judged(kind, one.probability, float(share > 0.3)))
    return out


def _share_along(street: LabelledStreet, line: Any, labels: tuple[int, ...]) -> float | None:
    """Share of the judged returns beside a line, above the ground, that have one of some labels."""
    path = line if line.geom_type.endswith("LineString") else line.boundary  # a façade is an area
    points = points_along([path], 0.5)
    rows = cKDTree(street.places_m[:, :2]).query_ball_point(points, 0.3)
    seen = street.labels[np.unique(np.concatenate([np.array(r, int) for r in rows]))] if len(rows) else np.zeros(0)
    seen = seen[~np.isin(seen, (*NOT_JUDGED, *GROUND))]
    return float(np.isin(seen, labels).mean()) if seen.size >= 10 else None


def _share_on_paint(street: LabelledStreet, shape: Any) -> float | None:
    area = shapely.force_2d(shape).buffer(0.06)
    west, south, east, north = area.bounds
    near = (street.places_m[:, 0] >= west) & (street.places_m[:, 0] <= east)
    near &= (street.places_m[:, 1] >= south) & (street.places_m[:, 1] <= north)
    rows = np.flatnonzero(near & ~np.isin(street.labels, NOT_JUDGED))
    rows = rows[shapely.contains_xy(area, street.places_m[rows, :2])]
    return float((street.labels[rows] == MARKING).mean()) if rows.size >= 5 else None


def apart_in_sigmas(one: LabelledStreet, other: LabelledStreet) -> dict[str, float]:
    """RMS of the differences over their σ between what two halves of a recording saw of the same things.

    `place` is that of upright things, east and north; `size` their diameters; `kerb` the heights of kerbs.
    """
    first, second = (half.objects(*UPRIGHT_KINDS, "sign") for half in (one, other))
    places = [t[["easting_m", "northing_m"]].to_numpy(float) for t in (first, second)]
    apart, sizes = [], []
    for i, j in _pairs(*places, _NEAR_M):
        a, b = first.iloc[i], second.iloc[j]
        sigma = np.hypot(a.sigma_horizontal_m, b.sigma_horizontal_m)
        apart += list((places[0][i] - places[1][j]) / sigma)
        if a.kind == b.kind == "pole":
            sizes.append((a.diameter_m - b.diameter_m) / np.hypot(a.sigma_size_m, b.sigma_size_m))
    steps = list(_kerb_differences(one.objects("kerb"), other.objects("kerb")))
    return {
        name: float(np.sqrt(np.nanmean(np.square(values)))) if len(values) else float("nan")
        for name, values in (("place", apart), ("size", sizes), ("kerb height", steps))
    }


def _kerb_differences(first: geopandas.GeoDataFrame, second: geopandas.GeoDataFrame) -> Iterator[float]:
    """Differences of the heights of kerbs that run within 0.2 m of one another for most of their way."""
    for a in first.itertuples():
        for b in second.itertuples():
            ring = b.geometry.buffer(0.2)
            if a.geometry.intersection(ring).length > 0.6 * min(a.geometry.length, b.geometry.length):
                yield (a.step_m - b.step_m) / float(np.hypot(a.sigma_size_m, b.sigma_size_m))
