"""Local features of the road, as rows of numbers by half metre: defects, patches, paint and spills."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial import Voronoi

from roadscan.compute.array_types import Float64
from roadscan.simulate.kernels.road import NODE_STEP_M
from roadscan.simulate.kernels.things import RING_FROM, RING_TO
from roadscan.simulate.noise import stream
from roadscan.simulate.scene.road import Alligator, Joints, Patch, Ravelling, Road, Slabs
from roadscan.simulate.symbols import strips

_FACE_M = 0.001
"""Width of a slab's face, seen from above (m)."""
_RAMP_M = 5.0
"""Length of the slabs that lead to the first fault and from the last one (m)."""
RECTANGLE, ELLIPSE, RING, BAND, CHECKER = 0.0, 1.0, 2.0, 3.0, 4.0
"""Kinds of painted or spilt items."""
BLACK = 15.0
"""Intensity of the black parts of painted targets."""


@dataclass(frozen=True)
class Features:
    """Rows as in :class:`roadscan.simulate.kernels.road.RoadArrays`, and the station ranges they cover (m, 2)."""

    defects: Float64
    defect_reach_m: Float64
    patches: Float64
    patch_reach_m: Float64
    items: Float64
    item_reach_m: Float64


def of_road(road: Road, seed: int, first_m: float, last_m: float, length_m: float, *, smooth: bool) -> Features:
    """Return all features between two stations; none where the surface is to be `smooth`."""
    if smooth:
        nothing = [np.zeros((0, n)) for n in (8, 2, 9, 2, 8, 2)]
        return Features(*nothing)
    again = _shifts(road.repeat_m, length_m)
    slabs = [(one, faults_of(one, seed, number)) for number, one in enumerate(road.slabs)]
    once = _table(_potholes(road) + _cracks(road) + _alligators(road, seed) + _lost_stones(road, seed), 8)
    joints = _joints(road, first_m, last_m) + [
        _gap(one, at, road) for one, (found, _) in slabs for at in found.tolist()
    ]
    defects = np.concatenate([_repeated(once, again, 3, 5, 1.0), _table(joints, 8)])
    patches = _repeated(_table([_patch(p) for p in road.patches], 9), again, 1)
    patches = np.concatenate([patches, _table([row for _, faults in slabs for row in _slabs(road, *faults)], 9)])
    spilt = _repeated(_table(_spilt(road), 8), again, 2, 6, BAND)
    items = np.concatenate([spilt, _table(_painted(road), 8)])
    return Features(defects, _defect_reach(defects), patches, _patch_reach(patches), items, _item_reach(items))


def by_node(rows: Float64, reach_m: Float64, station: Float64) -> tuple[Float64, Float64]:
    """Return rows in the order of the half metres they overlap, and each node's first and end row (n, 2)."""
    first = np.clip(np.floor((reach_m[:, 0] - station[0]) / NODE_STEP_M).astype(np.int64), 0, station.size - 1)
    last = np.clip(np.floor((reach_m[:, 1] - station[0]) / NODE_STEP_M).astype(np.int64), 0, station.size - 1)
    count = last - first + 1
    items = np.repeat(np.arange(len(rows)), count)
    nodes = np.repeat(first, count) + np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    order = np.lexsort((items, nodes))
    edges = np.searchsorted(nodes[order], np.arange(station.size + 1))
    return np.ascontiguousarray(rows[items[order]]), np.stack([edges[:-1], edges[1:]], axis=-1).astype(np.float64)


def humps(road: Road) -> tuple[Float64, Float64]:
    """Return (m, 4) speed humps, and the station ranges that they cover (m, 2)."""
    half = [h.top_m / 2 + h.ramp_m for h in road.humps]
    rows = [[h.station_m, reach, 1.0 / h.ramp_m, h.height_m] for h, reach in zip(road.humps, half, strict=True)]
    reach = [[h.station_m - reach, h.station_m + reach] for h, reach in zip(road.humps, half, strict=True)]
    return _table(rows, 4), _table(reach, 2)


def lines(road: Road) -> Float64:
    """Return (m, 8) markings along the road."""
    rows = []
    for line in road.markings:
        broken = line.dash_m > 0.0 and line.gap_m > 0.0
        period = line.dash_m + line.gap_m if broken else 0.0
        shade = road.brightness.marking if line.shade is None else line.shade
        place = [line.offset_m, line.width_m / 2, line.dash_m, period, line.start_m, line.end_m]
        rows.append([*place, line.worn, shade])
    return _table(rows, 8)


def _table(rows: list[list[float]], columns: int) -> Float64:
    return np.array(rows, dtype=np.float64).reshape(-1, columns)


def _shifts(repeat_m: float, length_m: float) -> Float64:
    """Return the station shifts by which features are repeated."""
    return repeat_m * np.arange(math.ceil(length_m / repeat_m), dtype=np.float64) if repeat_m > 0.0 else np.zeros(1)


def _repeated(rows: Float64, shifts_m: Float64, column: int, far_end: int = -1, kind: float = np.nan) -> Float64:
    """Return rows repeated at each shift: `column` has their station, `far_end` that of the other end of some kinds."""
    if not rows.size or shifts_m.size == 1:
        return rows
    again = np.repeat(rows[None], shifts_m.size, axis=0)
    again[:, :, column] += shifts_m[:, None]
    again[:, :, far_end] += np.where(rows[:, 0] == kind, shifts_m[:, None], 0.0)
    return again.reshape(-1, rows.shape[1])


# --- wear --------------------------------------------------------------------------------------------


def _potholes(road: Road) -> list[list[float]]:
    return [
        [0.0, p.depth_m, 1.0 / p.radius_m, p.station_m, p.offset_m, 0.0, 0.0, _per_m(p.wall_m)] for p in road.potholes
    ]


def _per_m(wall_m: float) -> float:
    return 1.0 / wall_m if wall_m > 0.0 else 0.0


def _cracks(road: Road) -> list[list[float]]:
    return [
        [1.0, crack.depth_m, 2.0 / crack.width_m, s0, o0, s1, o1, _per_m(crack.wall_m)]
        for crack in road.cracks
        for (s0, o0), (s1, o1) in itertools.pairwise(crack.points_m)
        if (s0, o0) != (s1, o1)
    ]


def _joints(road: Road, first_m: float, last_m: float) -> list[list[float]]:
    edge = road.paved_m
    return [
        [1.0, joints.depth_m, 2.0 / joints.width_m, station, -edge, station, edge, 0.0]
        for joints in road.joints
        for station in _joint_stations(joints, first_m, last_m)
    ]


def _joint_stations(joints: Joints, first_m: float, last_m: float) -> list[float]:
    first, last = max(first_m, joints.start_m), min(last_m, joints.end_m)
    numbers = range(
        math.ceil((first - joints.first_m) / joints.spacing_m),
        math.floor((last - joints.first_m) / joints.spacing_m) + 1,
    )
    return [joints.first_m + n * joints.spacing_m for n in numbers]


def _alligators(road: Road, seed: int) -> list[list[float]]:
    rows: list[list[float]] = []
    for number, field in enumerate(road.alligators):
        for (s0, o0), (s1, o1) in _cell_borders(field, stream(seed, number, "alligator")):
            rows.append([1.0, field.crack_depth_m, 2.0 / field.crack_width_m, s0, o0, s1, o1, 0.0])
    return rows


def _cell_borders(field: Alligator, rng: np.random.Generator) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """Return borders of random cells (Voronoi) inside the field's ellipse."""
    half = np.array([field.length_m, field.width_m]) / 2
    count = max(8, round(4 * 2.25 * half[0] * half[1] / field.cell_m**2))
    cells = Voronoi(rng.uniform(-1.5, 1.5, (count, 2)) * half)
    corners = cells.vertices
    inside = np.sum((corners / half) ** 2, axis=1) < 1.0
    middle = np.array([field.station_m, field.offset_m])
    borders = []
    for a, b in cells.ridge_vertices:
        if a >= 0 and b >= 0 and inside[a] and inside[b] and np.hypot(*(corners[a] - corners[b])) > 1e-3:
            (s0, o0), (s1, o1) = (corners[[a, b]] + middle).tolist()
            borders.append(((s0, o0), (s1, o1)))
    return borders


def _lost_stones(road: Road, seed: int) -> list[list[float]]:
    rows: list[list[float]] = []
    for number, place in enumerate(road.ravelling):
        rng = stream(seed, number, "ravelling")
        middles = _within(place, rng)
        size = rng.uniform(0.7, 1.3, len(middles))
        depth = place.depth_m * rng.uniform(0.7, 1.3, len(middles))
        per_m = 2.0 / (place.stone_m * size)
        rows += [[0.0, d, r, s, o, 0.0, 0.0, 0.0] for d, r, (s, o) in zip(depth, per_m, middles.tolist(), strict=True)]
    return rows


def _within(place: Ravelling, rng: np.random.Generator) -> Float64:
    """Return centres of lost stones (n, 2), stations and offsets, uniform over the place."""
    half = np.array([place.length_m, place.width_m]) / 2
    mean_square = 1.0 + 0.6**2 / 12  # of diameters over their mean
    count = round(place.lost_share * 4.0 * half[0] * half[1] / (math.pi * place.stone_m**2 / 4 * mean_square))
    inside = rng.uniform(-1.0, 1.0, (count, 2))
    if place.shape == "ellipse":
        inside = inside[np.sum(inside * inside, axis=1) < 1.0]
    middle: Float64 = inside * half + np.array([place.station_m, place.offset_m])
    return middle


def _patch(p: Patch) -> list[float]:
    circle = p.shape == "circle"
    half_width = (p.length_m if circle else p.width_m) / 2
    slope, edge = p.rise_m / p.length_m, 1.0 / p.edge_m
    return [float(circle), p.station_m, p.offset_m, p.length_m / 2, half_width, p.height_m, edge, p.shade, slope]


def faults_of(slabs: Slabs, seed: int, number: int) -> tuple[Float64, Float64]:
    """Return stations of the joints (n,), and their faults, positive where the slab behind is lower (n,; m)."""
    rng = stream(seed, number, "slabs")
    most = max(int((slabs.end_m - slabs.start_m) / slabs.length_m[0]), 0) + 1
    stations = slabs.start_m + np.append(0.0, np.cumsum(rng.uniform(*slabs.length_m, most)))
    faults = rng.uniform(*slabs.fault_m, stations.size) * rng.choice([-1.0, 1.0], stations.size)
    inside = stations <= slabs.end_m
    return stations[inside], faults[inside]


def _gap(slabs: Slabs, station_m: float, road: Road) -> list[float]:
    edge = road.paved_m
    return [1.0, slabs.depth_m, 2.0 / slabs.gap_m, station_m, -edge, station_m, edge, 0.0]


def _slabs(road: Road, station_m: Float64, fault_m: Float64) -> list[list[float]]:
    """Return patches over the paved width between the joints; the outermost slabs end level."""
    ends = np.concatenate([station_m[:1] - _RAMP_M, station_m, station_m[-1:] + _RAMP_M])
    near, far = np.append(0.0, -0.5 * fault_m), np.append(0.5 * fault_m, 0.0)
    middle, length = 0.5 * (ends[1:] + ends[:-1]), np.diff(ends)
    return [
        [0.0, s, 0.0, 0.5 * w, road.paved_m, 0.5 * (a + b), 1.0 / _FACE_M, road.brightness.asphalt, (b - a) / w]
        for s, w, a, b in zip(middle.tolist(), length.tolist(), near.tolist(), far.tolist(), strict=True)
    ]


def _defect_reach(rows: Float64) -> Float64:
    reach = 1.0 / rows[:, 2]
    other_end = np.where(rows[:, 0] == 1.0, rows[:, 5], rows[:, 3])
    return np.stack([np.minimum(rows[:, 3], other_end) - reach, np.maximum(rows[:, 3], other_end) + reach], axis=-1)


def _patch_reach(rows: Float64) -> Float64:
    return np.stack([rows[:, 1] - rows[:, 3], rows[:, 1] + rows[:, 3]], axis=-1)


# --- paint and spills --------------------------------------------------------------------------------


def _spilt(road: Road) -> list[list[float]]:
    """Return stains and tyre marks."""
    rows = [[ELLIPSE, s.shade, s.station_m, s.offset_m, s.length_m / 2, s.width_m / 2, 0.0, 0.0] for s in road.stains]
    rows += [
        [BAND, mark.shade, s0, o0, mark.width_m / 2, 0.0, s1, o1]
        for mark in road.tyre_marks
        for (s0, o0), (s1, o1) in itertools.pairwise(mark.points_m)
        if (s0, o0) != (s1, o1)
    ]
    return rows


def _painted(road: Road) -> list[list[float]]:
    """Return stop bars, zebra crossings, symbols and targets."""
    paint = road.brightness.marking
    rows: list[list[float]] = []
    for bar in road.stop_bars:
        middle, half = (bar.from_m + bar.to_m) / 2, abs(bar.to_m - bar.from_m) / 2
        rows.append([RECTANGLE, paint, bar.station_m, middle, bar.width_m / 2, half, bar.worn, 0.0])
    for walk in road.crosswalks:
        left, right = min(walk.from_m, walk.to_m), max(walk.from_m, walk.to_m)
        rows += [
            [RECTANGLE, paint, walk.station_m, float(offset), walk.length_m / 2, walk.stripe_m / 2, walk.worn, 0.0]
            for offset in np.arange(left + walk.stripe_m / 2, right, walk.stripe_m + walk.gap_m)
        ]
    for symbol in road.symbols:
        rows += [[RECTANGLE, paint, *place, symbol.worn, 0.0] for place in strips(symbol)]
    for target in road.targets:
        place = [target.station_m, target.offset_m]
        half = target.diameter_m / 2
        if target.style != "disc":
            rows.append([RECTANGLE, paint, *place, half, half, 0.0, 0.0])
        if target.style == "checker":
            rows.append([CHECKER, BLACK, *place, half, half, 0.0, 0.0])
            continue
        if target.style == "ring":
            rows.append([RING, BLACK, *place, RING_FROM * half, RING_TO * half, 0.0, 0.0])
            continue
        rows.append([RING, paint, *place, target.centre_m / 2, target.diameter_m / 2, 0.0, 0.0])
        if target.centre_m > 0.0:
            rows.append([RING, BLACK, *place, 0.0, target.centre_m / 2, 0.0, 0.0])
    return rows


def _item_reach(rows: Float64) -> Float64:
    half = np.where(rows[:, 0] == RING, rows[:, 5], rows[:, 4])
    other_end = np.where(rows[:, 0] == BAND, rows[:, 6], rows[:, 2])
    return np.stack([np.minimum(rows[:, 2], other_end) - half, np.maximum(rows[:, 2], other_end) + half], axis=-1)
