"""Matching of newly found objects with known assets: one to one, by kind, place, σ and size.

Three rounds, each with the leftovers of the last: at the place of the evidence; at the place that a person gave; and
farther away, if the known asset should have been seen at its place and was not: then it was moved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.compute.array_types import Float64, Int64
from roadscan.inventory.settings import Matching
from roadscan.store.asset_schema import GEOMETRY, asset_schema
from roadscan.store.digest import bytes_digest

_SIGMAS: Final = 4.0
"""Gate of a match, in σ of the difference of two positions."""
_SAMPLES: Final = 16
"""Sample points along a line or outline, by which its overlap with another is measured."""
_LEAST_SHARE: Final = 0.35
"""Least overlap, averaged over both directions, at which two lines or outlines are one asset."""
_SIDE_WEIGHT: Final = 0.5
"""Cost of a lateral offset as large as the gate: of two parallel lines the nearer one matches."""
_SIZE_WEIGHT: Final = 0.5
"""Cost of entirely different sizes, where 1 is a distance at the gate."""
_SIZE_OF_MOVED: Final = 0.25
"""Greatest mean relative difference of sizes between a moved asset and itself."""
_DIGITS: Final = "0123456789abcdefghjkmnpqrstvwxyz"  # Crockford's alphabet: no i, l, o, u


class Pairs(NamedTuple):
    """Candidates: rows of known and found assets, and the cost of matching them (0 to 1)."""

    known: Int64
    found: Int64
    cost: Float64


@dataclass(frozen=True, eq=False)
class Known:
    """Known assets of a kind, by ascending id."""

    evidence: pa.Table
    rows: pa.Table
    """With edits applied."""
    is_visible: npt.NDArray[np.bool_]
    """Mask (n,) of the assets that the newest survey should have seen at their places."""


def matched(kind: str, known: Known, found: pa.Table, settings: Matching, unit_m: float = 1.0) -> Int64:
    """Returns for each found object the row of the known asset that it matches, -1 for none.

    Parameters
    ----------
    found : rows of the kind's table of found assets, in an order that depends on the objects alone.
    unit_m : metres of a unit of the map.
    """
    result = np.full(found.num_rows, -1, dtype=np.int64)
    if not (found.num_rows and known.rows.num_rows):
        return result
    there = _shapes(found, unit_m)
    is_point = asset_schema(kind).geometry == "PointZ"
    sizes = _sizes(kind, known.evidence), _sizes(kind, found)
    for table in (known.evidence, known.rows):
        here = _shapes(table, unit_m)
        free_known, free_found = _free(result, known.rows.num_rows)
        free_known = free_known[~shapely.is_missing(here[free_known])]
        if not (free_known.size and free_found.size):
            continue
        ends = here[free_known], there[free_found]
        sigma = _sigmas(known.evidence)[free_known], _sigmas(found)[free_found]
        if is_point:
            pairs = _near_points(*ends, *sigma, settings.distance_m)
        else:
            least_m = min(asset_schema(kind).known_within_m or settings.distance_m, settings.distance_m)
            pairs = _overlapping(*ends, *sigma, (least_m, settings.distance_m))
        pairs = Pairs(free_known[pairs.known], free_found[pairs.found], pairs.cost)
        cost = pairs.cost + _SIZE_WEIGHT * _size_difference(*sizes, pairs)
        _assign(pairs._replace(cost=cost), result)
    if is_point:
        _find_moved(known, there, sizes, settings, unit_m, result)
    return result


def _find_moved(
    known: Known,
    there: npt.NDArray[Any],
    sizes: tuple[Float64, Float64],
    settings: Matching,
    unit_m: float,
    result: Int64,
) -> None:
    """Match an asset with the nearest object of about its size if it should have been seen at its place but was not."""
    free_known, free_found = _free(result, known.rows.num_rows)
    here = _shapes(known.evidence, unit_m)
    free_known = free_known[known.is_visible[free_known] & ~shapely.is_missing(here[free_known])]
    if not (free_known.size and free_found.size):
        return
    a, b = here[free_known], there[free_found]
    left, right = shapely.STRtree(b).query(a, predicate="dwithin", distance=settings.moved_m)
    pairs = Pairs(free_known[left], free_found[right], shapely.distance(a[left], b[right]) / settings.moved_m)
    difference = _size_difference(*sizes, pairs)
    keep = difference <= _SIZE_OF_MOVED
    _assign(Pairs(pairs.known[keep], pairs.found[keep], (pairs.cost + difference)[keep]), result)


def _free(result: Int64, known: int) -> tuple[Int64, Int64]:
    taken = np.zeros(known, dtype=bool)
    taken[result[result >= 0]] = True
    return np.flatnonzero(~taken), np.flatnonzero(result < 0)


def _shapes(table: pa.Table, unit_m: float) -> npt.NDArray[Any]:
    shapes = np.asarray(shapely.from_wkb(table[GEOMETRY].to_numpy(zero_copy_only=False)))
    return shapes if unit_m == 1.0 else np.asarray(shapely.transform(shapes, lambda xy: xy * unit_m))


def _sigmas(table: pa.Table) -> Float64:
    """Returns σ (n, 2), horizontal and in height; 0 where it is not known."""
    columns = [
        np.asarray(table[name].to_numpy(zero_copy_only=False), dtype=float)
        for name in ("sigma_horizontal_m", "sigma_height_m")
    ]
    return np.asarray(np.nan_to_num(np.column_stack(columns)), dtype=float)


def _near_points(a: npt.NDArray[Any], b: npt.NDArray[Any], sigma_a: Float64, sigma_b: Float64, least_m: float) -> Pairs:
    widest = max(least_m, _SIGMAS * float(np.hypot(sigma_a.max(), sigma_b.max())))
    left, right = shapely.STRtree(b).query(a, predicate="dwithin", distance=widest)
    gate = np.maximum(least_m, _SIGMAS * np.hypot(sigma_a[left], sigma_b[right]))
    rise = np.abs(shapely.get_z(a[left]) - shapely.get_z(b[right]))
    ratio = np.hypot(shapely.distance(a[left], b[right]) / gate[:, 0], np.nan_to_num(rise) / gate[:, 1])
    keep = ratio <= 1.0
    return Pairs(left[keep], right[keep], ratio[keep])


def _overlapping(
    a: npt.NDArray[Any], b: npt.NDArray[Any], sigma_a: Float64, sigma_b: Float64, limits_m: tuple[float, float]
) -> Pairs:
    """Returns lines and outlines that overlap, within four σ clipped to `limits_m`."""
    lines_a, lines_b = outlines(a), outlines(b)
    widest = np.clip(_SIGMAS * np.hypot(sigma_a[:, 0], sigma_b[:, 0].max()), *limits_m)
    left, right = shapely.STRtree(lines_b).query(lines_a, predicate="dwithin", distance=widest)
    gate = np.clip(_SIGMAS * np.hypot(sigma_a[left, 0], sigma_b[right, 0]), *limits_m)
    ways = (lines_a[left], lines_b[right], gate), (lines_b[right], lines_a[left], gate)
    share, nearness = (0.5 * (one + other) for one, other in zip(*(_along(*way) for way in ways), strict=True))
    keep = share >= _LEAST_SHARE
    return Pairs(left[keep], right[keep], (1.0 - share + _SIDE_WEIGHT * (1.0 - nearness))[keep])


def outlines(shapes: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Returns lines unchanged, of polygons the outer ring; of façades that is the ground line, there and back."""
    flat = shapely.force_2d(shapes)
    rings = shapely.get_exterior_ring(flat)
    lines: npt.NDArray[Any] = np.where(shapely.is_missing(rings), flat, rings)
    several = shapely.get_type_id(flat) == shapely.GeometryType.MULTIPOLYGON
    lines[several] = shapely.boundary(flat[several])
    return lines


def points_along(lines: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Returns (n, 16) evenly spaced points along lines; several parts follow one another."""
    if not len(lines):
        return np.empty((0, _SAMPLES), object)
    parts, number = shapely.get_parts(lines, return_index=True)
    places, part = shapely.get_coordinates(parts, return_index=True)
    step = np.where(np.diff(part) == 0, np.hypot(*np.diff(places, axis=0).T), 0.0)
    length = np.concatenate([[0.0], np.cumsum(step)])
    ends = np.searchsorted(number[part], np.arange(len(lines)), "right") - 1
    first = np.concatenate([[0.0], length[ends][:-1]])
    share = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    at = first[:, np.newaxis] + (length[ends] - first)[:, np.newaxis] * share
    return np.asarray(shapely.points(*(np.interp(at, length, column) for column in places.T)))


def _along(a: npt.NDArray[Any], b: npt.NDArray[Any], within_m: Float64) -> tuple[Float64, Float64]:
    """Returns the share of points along `a` within a distance of `b`, and their closeness: 1 on it, 0 that far away."""
    ratio = shapely.distance(points_along(a), b[:, np.newaxis]) / within_m[:, np.newaxis]
    return (ratio <= 1.0).sum(axis=1) / _SAMPLES, np.maximum(1.0 - ratio, 0.0).sum(axis=1) / _SAMPLES


def _sizes(kind: str, table: pa.Table) -> Float64:
    """Returns the sizes (n, m) of the assets in all their columns of unit m; NaN where not known."""
    names = [c.name for c in asset_schema(kind).own if c.unit == "m"]
    columns = [np.asarray(table[name].to_numpy(zero_copy_only=False), dtype=float) for name in names]
    return np.column_stack(columns) if columns else np.empty((table.num_rows, 0))


def _size_difference(known: Float64, found: Float64, pairs: Pairs) -> Float64:
    """Returns the mean relative difference of the lengths that both have, 0 to 1; 0 where they share none."""
    a, b = known[pairs.known], found[pairs.found]
    relative = np.minimum(np.abs(a - b) / np.maximum(np.maximum(np.abs(a), np.abs(b)), 0.1), 1.0)
    count = np.isfinite(relative).sum(axis=1)
    return np.asarray(np.nansum(relative, axis=1) / np.maximum(count, 1), dtype=float)


def _assign(pairs: Pairs, result: Int64) -> None:
    """Choose pairs, one to one: as many as possible, with the least sum of costs."""
    import scipy.sparse

    if not pairs.known.size:
        return
    known, a = np.unique(pairs.known, return_inverse=True)
    found, b = np.unique(pairs.found, return_inverse=True)
    graph = scipy.sparse.coo_matrix((np.ones(a.size), (a, b + known.size)), shape=(known.size + found.size,) * 2)
    _, label = scipy.sparse.csgraph.connected_components(graph, directed=False)
    order = np.argsort(label[a], kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(label[a][order])) + 1):
        if rows.size == 1:
            result[pairs.found[rows[0]]] = pairs.known[rows[0]]
        else:
            _assign_together(Pairs(pairs.known[rows], pairs.found[rows], pairs.cost[rows]), result)


def _assign_together(pairs: Pairs, result: Int64) -> None:
    from scipy.optimize import linear_sum_assignment

    known, a = np.unique(pairs.known, return_inverse=True)
    found, b = np.unique(pairs.found, return_inverse=True)
    no_pair = 4.0 * min(known.size, found.size)
    cost = np.full((known.size, found.size), no_pair)
    cost[a, b] = pairs.cost
    for i, j in zip(*linear_sum_assignment(cost), strict=True):
        if cost[i, j] < no_pair:
            result[found[j]] = known[i]


def new_ids(kind: str, names: Sequence[str], taken: frozenset[str] | set[str]) -> list[str]:
    """Returns ids of new assets: the kind and eight letters and digits from a digest of their first finding.

    `taken` are the existing ids; a name whose id exists already gets a counter.
    """
    used = set(taken)
    ids = []
    for name in names:
        number = 0
        while (one := _id(kind, name, number)) in used:
            number += 1
        used.add(one)
        ids.append(one)
    return ids


def _id(kind: str, name: str, number: int) -> str:
    digest = int(bytes_digest(f"{kind}/{name}/{number}".encode()).rpartition(":")[2], 16)
    return f"{kind}-" + "".join(_DIGITS[digest >> 5 * at & 31] for at in range(8))
