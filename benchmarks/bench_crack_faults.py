"""Cracks where cells hide them or logs feign them: level floors, empty cells, lines along the grid, faults of profiles.

Cells of 5 mm as in ``bench_cracks``. Faults of a road without a crack: a profile that lies lower, two neighbouring ones
that do, and one that was repeated while the vehicle stood; patches of 1.6 m, profiles 1 mm apart.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import shapely

from benchmarks.bench_cracks import BENT, CLEAN, FEW, MANY, SEEDS, Faults, Seen, scores, seen
from benchmarks.timing import Figure
from roadscan.distress.crack_network import Crack, join_cracks
from roadscan.distress.cracks import crack_pieces
from roadscan.distress.settings import CrackDetection, CrackJoining
from roadscan.surface.heights import LowestReadings
from roadscan.surface.settings import SurfaceSmoothing
from roadscan.surface.smoothing import smooth_surface

CELL_M = 0.005
SLOTS_M = ((0.003, 0.005), (0.005, 0.003), (0.005, 0.008), (0.010, 0.005), (0.010, 0.010), (0.015, 0.010))
HIDDEN_M = ((0.005, 0.003), (0.005, 0.008))
STRAIGHT = {
    "along": [(10.0, 1.0025), (11.0, 1.0025)],
    "a cell in 1.2 m off": [(10.0, 1.0025), (11.0, 1.0067)],
    "across": [(10.5025, 0.5), (10.5025, 1.5)],
}
"""Midway between two borders of cells, or nearly so."""
REPEATS = 300
Float64 = npt.NDArray[np.float64]


def figures(_: Path) -> Iterator[Figure]:
    """Floors, empty cells, lines along the grid, faults."""
    for faults in (CLEAN, MANY, FEW):
        for width_m, depth_m in SLOTS_M:
            ones = [seen({}, CELL_M, (1.0, 1.0), s, faults=faults, change=_slot(width_m, depth_m)) for s in SEEDS[:2]]
            yield from _figures(f"level floor{faults.name}, {_size(width_m, depth_m)}", ones, depth_m, BENT)
    for faults in (CLEAN, MANY, FEW):
        for width_m, depth_m in HIDDEN_M:
            ones = [_cracked(BENT, width_m, depth_m, s, faults, _emptied(s)) for s in SEEDS]
            yield from _figures(f"30 % empty cells{faults.name}, {_size(width_m, depth_m)}", ones, depth_m, BENT)
    for name, line in STRAIGHT.items():
        for width_m, depth_m in HIDDEN_M:
            ones = [_cracked([line], width_m, depth_m, 1, CLEAN, None)]
            yield from _figures(f"{name} the grid, {_size(width_m, depth_m)}", ones, depth_m, [line])
    yield from _feigned()


def _feigned() -> Iterator[Figure]:
    for faults in (CLEAN, MANY):
        for what, lower_m, profiles in (("a profile", 0.002, 1), ("a profile", 0.005, 1), ("two profiles", 0.002, 2)):
            one = seen({}, CELL_M, (1.6, 1.6), 1, faults=faults, change=_low(lower_m, profiles))
            name = f"no crack, {what} {lower_m * 1e3:g} mm lower{faults.name}"
            yield Figure(name, len(_found(one)), "cracks", len(_found(one, lowest_alone=True)), "with lowest_alone")
        one = _stood(seen({}, CELL_M, (1.6, 1.6), 1, faults=faults), faults)
        name = f"no crack, a profile {REPEATS} times{faults.name}"
        yield Figure(name, len(_found(one)), "cracks", len(_found(one, lowest_alone=True)), "with lowest_alone")


def _found(one: Seen, lowest_alone: bool = False) -> list[Crack]:
    pieces = crack_pieces(one.window, CrackDetection(lowest_alone=lowest_alone))
    return join_cracks(pieces, 0.0, CELL_M, CrackJoining())


def _figures(
    what: str, ones: Sequence[Seen], depth_m: float, lines: Sequence[Sequence[tuple[float, float]]]
) -> Iterator[Figure]:
    every = [(_found(one), one.on_map(lines)) for one in ones]
    recall = [scores(found, truth, CELL_M)[1] for found, truth in every]
    sums = np.sum([(c.depth_mean_m * c.length_m, c.length_m) for found, _ in every for c in found], axis=0)
    yield Figure(f"{what}: recall", float(np.mean(recall)), "", None, f"least {min(recall):.2f}")
    yield Figure(f"{what}: mean depth", 1e3 * sums[0] / sums[1], "mm", depth_m * 1e3, "truth (bar: 10 %)")


def _cracked(
    lines: Sequence[Sequence[tuple[float, float]]],
    width_m: float,
    depth_m: float,
    seed: int,
    faults: Faults,
    change: Callable[[Float64, Float64, Float64], Float64] | None,
) -> Seen:
    cracks = [{"points_m": line, "width_m": width_m, "depth_m": depth_m} for line in lines]
    return seen({"cracks": cracks}, CELL_M, (1.0, 1.0), seed, faults=faults, change=change)


def _slot(width_m: float, depth_m: float) -> Callable[[Float64, Float64, Float64], Float64]:
    lines = shapely.MultiLineString([[(o, s) for s, o in one] for one in BENT])
    shapely.prepare(lines)
    return lambda east, north, z: z - depth_m * shapely.dwithin(lines, shapely.points(east, north), 0.5 * width_m)


def _emptied(seed: int) -> Callable[[Float64, Float64, Float64], Float64]:
    rng = np.random.default_rng(seed)

    def change(_: Float64, __: Float64, z: Float64) -> Float64:
        empty = rng.random((z.shape[0] // 5, z.shape[1] // 5)) < 0.3
        return np.where(np.kron(empty, np.ones((5, 5))) > 0, np.nan, z)

    return change


def _low(lower_m: float, profiles: int) -> Callable[[Float64, Float64, Float64], Float64]:
    def change(_: Float64, north: Float64, z: Float64) -> Float64:
        number = np.rint((north[:, 0] - 10.0) / 0.001 - 0.5).astype(int)
        return z - lower_m * ((number >= 700) & (number < 700 + profiles))[:, None]

    return change


def _stood(one: Seen, faults: Faults) -> Seen:
    """The same with one profile many times, in a row of cells."""
    rng, w = np.random.default_rng(2), one.window
    assert w.lowest is not None
    row = w.raw_m.shape[0] // 2
    again = w.raw_m[row] + rng.normal(0.0, faults.sigma_m, (5 * REPEATS, w.raw_m.shape[1]))
    again += np.where(rng.random(again.shape) < faults.impulses, rng.uniform(-0.03, 0.03, again.shape), 0.0)
    raw, drop, count = w.raw_m.copy(), w.lowest.drop_m.copy(), w.lowest.count.copy()
    raw[row] = np.median(again, axis=0)
    drop[row] = raw[row] - again.min(axis=0)
    count[row] += 5 * REPEATS
    smooth = smooth_surface(raw, SurfaceSmoothing(sigma_m=faults.sigma_m))
    return replace(one, window=replace(w, raw_m=raw, height_m=smooth, lowest=LowestReadings(drop, count)))


def _size(width_m: float, depth_m: float) -> str:
    return f"{width_m * 1e3:g} × {depth_m * 1e3:g} mm"
