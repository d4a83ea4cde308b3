"""Pieces of upright surfaces and their chains, outlines of façades, and the returns that belong to them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import pyarrow as pa

from roadscan.assets.kernels.columns import mark_strip
from roadscan.assets.quantiles import median
from roadscan.assets.scene import Box, Scene
from roadscan.assets.upright.panels import STRETCH_M, Panel
from roadscan.assets.upright.pieces import seen_by
from roadscan.assets.upright.slices import places_of
from roadscan.compute.array_types import Float64, Int64
from roadscan.compute.arrays import SIGMA_OF_MAD

COUNTS: Final = ("returns", "stopped", "passed", "under", "foot", "columns", "open_columns", "leaves")
STRETCHES: Final = ("ground_m", "low_m", "high_m", "top_m", "bulk_m", "length_m", *COUNTS, "open_top")
PIECE_SCHEMA: Final = pa.schema(
    [("x_m", pa.list_(pa.float64())), ("y_m", pa.list_(pa.float64()))]
    + [(name, pa.list_(pa.float64())) for name in STRETCHES]
    + [
        ("across_m", pa.float64()), ("sensor_x_m", pa.float64()), ("sensor_y_m", pa.float64()),
        ("seen", pa.int64()), ("passes", pa.list_(pa.int32())),
        ("first_epoch_gps_ns", pa.int64()), ("last_epoch_gps_ns", pa.int64()),
    ]
)  # fmt: skip
"""A row a piece: ends of its stretches in the map, then values of each stretch."""

_JOIN_M: Final = 1.5  # Greatest distance between the ends of two pieces that join (m).
_JOIN_TURN: Final = math.cos(math.radians(25.0))  # Cosine of the greatest angle between them.
_JOIN_BESIDE_M: Final = 0.35  # Greatest lateral offset between them (m).
_JOIN_LEVEL_M: Final = 0.15
"""Low surfaces join where they start at one height above the ground, within this (m): rail and solid end do not …"""
_LOW_M: Final = 1.2
"""… and low ones are up to this height (m)."""
_SPARSER: Final = 1.0 / 3.0  # Below a free one stands so much less than above.
_TELLING: Final = 5.0
"""Lines that would have been stopped, so many that by chance all pass in 0.7 % of the cases."""
_LONGEST_STRETCH_M: Final = 1.5 * STRETCH_M  # No stretch is longer (m): their number is rounded.
_SHORTEST_M: Final = 0.02  # Shorter pieces and gaps are left out (m).


@dataclass(frozen=True, eq=False)
class Chain:
    """Pieces joined along a line, values as those of a piece."""

    xy_m: Float64
    """(k + 1, 2) in the map."""
    values: dict[str, Float64]
    """(k,) of each stretch, names of :data:`STRETCHES`; a gap between pieces is a stretch without returns."""
    across_m: float
    sensor_xy_m: tuple[float, float]
    seen: int
    passes: frozenset[int]
    epochs_gps_ns: tuple[int, int]

    @property
    def length_m(self) -> float:
        """Returns its length from end to end, along it."""
        return float(self.values["length_m"].sum())

    def median(self, name: str) -> float:
        """Returns the median of a height above the ground, over the stretches that are known; NaN where none is."""
        above = self.values[name] - self.values["ground_m"]
        return median(above[np.isfinite(above)]) if np.isfinite(above).any() else math.nan

    def sigma_median_m(self, name: str) -> float:
        """Returns 1 σ (m) of that median, from its scatter over the stretches."""
        above = self.values[name] - self.values["ground_m"]
        above = above[np.isfinite(above)]
        return float(1.2533 * SIGMA_OF_MAD * median(np.abs(above - median(above))) / math.sqrt(above.size))

    @property
    def passing(self) -> float:
        """Returns the share of the sight lines at it that pass through."""
        passed, stopped = float(self.values["passed"].sum()), float(self.values["stopped"].sum())
        return passed / max(passed + stopped, 1.0)

    def part(self, first: int, last: int) -> Chain:
        """Returns the chain of its stretches from the first to before the last."""
        values = {name: value[first:last] for name, value in self.values.items()}
        share = float(values["returns"].sum()) / max(float(self.values["returns"].sum()), 1.0)
        return replace(self, xy_m=self.xy_m[first : last + 1], values=values, seen=round(share * self.seen))

    @property
    def leaves(self) -> float:
        """Returns the share of its returns that are classed as vegetation."""
        return float(self.values["leaves"].sum()) / max(float(self.values["returns"].sum()), 1.0)

    @property
    def free_below(self) -> bool:
        """Returns whether sight lines pass below it that it would have stopped, a third as dense as it is above."""
        under, foot = float(self.values["under"].sum()), float(self.values["foot"].sum())
        dense = 1.0 - self.passing
        return under * dense >= _TELLING and foot < _SPARSER * dense * (under + foot)

    @property
    def covered(self) -> float:
        """Returns the share of its length with returns."""
        shown = np.isfinite(self.values["high_m"])
        return float(self.values["length_m"] @ shown) / max(self.length_m, 1e-9)


def pieces_of_panels(scene: Scene, panels: list[Panel]) -> pa.Table:
    """Returns pieces of panels inside the scene's tile; ends at its border lie on it."""
    rows = [_row(scene, panel, part) for panel in panels for part in _inside(panel, scene.tile)]
    return pa.Table.from_pylist(rows, schema=PIECE_SCHEMA)


def _inside(panel: Panel, tile: Box) -> list[list[tuple[int, float, float]]]:
    """Returns runs of stretches inside the tile: number of a stretch, and the shares at which it enters and leaves."""
    runs: list[list[tuple[int, float, float]]] = [[]]
    for k in range(panel.returns.size):
        enters, leaves = _clip(panel.xy_m[k], panel.xy_m[k + 1], tile)
        if leaves <= enters:
            runs.append([])
            continue
        if enters > 0.0:
            runs.append([])
        runs[-1].append((k, enters, leaves))
        if leaves < 1.0:
            runs.append([])
    return [run for run in runs if run]


def _clip(start: Float64, end: Float64, tile: Box) -> tuple[float, float]:
    """Shares of a segment between which it lies in the tile (Liang and Barsky 1984); 1, 0 where it does not."""
    enters, leaves = 0.0, 1.0
    for axis, low, high in ((0, tile.x_min_m, tile.x_max_m), (1, tile.y_min_m, tile.y_max_m)):
        way = float(end[axis] - start[axis])
        if way == 0.0:
            if not low <= float(start[axis]) < high:
                return 1.0, 0.0
            continue
        first, second = sorted(((low - float(start[axis])) / way, (high - float(start[axis])) / way))
        enters, leaves = max(enters, first), min(leaves, second)
    return enters, leaves


def _row(scene: Scene, panel: Panel, run: list[tuple[int, float, float]]) -> dict[str, Any]:
    east, north = scene.returns.corner_m
    points = [panel.xy_m[k] + a * (panel.xy_m[k + 1] - panel.xy_m[k]) for k, a, _ in run]
    last, _, share = run[-1]
    points.append(panel.xy_m[last] + share * (panel.xy_m[last + 1] - panel.xy_m[last]))
    xy = np.array(points)
    numbers, shares = np.array([k for k, _, _ in run]), np.array([b - a for _, a, b in run])
    rows = panel.rows[np.isin(panel.stretch, numbers)]
    seen = (
        seen_by(scene, rows)
        if rows.size
        else {"returns": 0, "passes": [], "first_epoch_gps_ns": None, "last_epoch_gps_ns": None}
    )
    counts = {name: getattr(panel, name)[numbers] * shares for name in COUNTS}
    heights = {name: getattr(panel, name)[numbers] for name in ("ground_m", "low_m", "high_m", "top_m", "bulk_m")}
    return {
        "x_m": (east + xy[:, 0]).tolist(), "y_m": (north + xy[:, 1]).tolist(),
        **{name: value.tolist() for name, value in (counts | heights).items()},
        "open_top": panel.open_top[numbers].astype(float).tolist(),
        "length_m": np.hypot(*np.diff(xy, axis=0).T).tolist(),
        "across_m": panel.across_m, "sensor_x_m": east + panel.seen_from_m[0],
        "sensor_y_m": north + panel.seen_from_m[1], "seen": seen.pop("returns"), **seen,
    }  # fmt: skip


def chains_of(pieces: pa.Table) -> list[Chain]:
    """Returns chains of pieces whose ends meet, by the place of their first point; empty pieces are left out.

    Ends meet that are at most 1.5 m apart, where one continues the other in direction and line. Of several the
    nearest pair is joined first, so the chains do not depend on the order of the pieces.
    """
    parts = [_part(row) for row in pieces.to_pylist() if sum(row["length_m"]) > _SHORTEST_M]
    parts.sort(key=lambda p: (p.xy_m[0].tolist(), p.xy_m[-1].tolist()))
    following = _matched(parts)
    chains, used = [], set[int]()
    for start in range(len(parts)):
        if start in used:
            continue
        first, reverse = _first_of(start, following)
        run = _walk(first, reverse, following)
        used.update(i for i, _ in run)
        chains.append(_linked([_reversed(parts[i]) if back else parts[i] for i, back in run]))
    return sorted(chains, key=lambda c: (c.xy_m[0].tolist(), c.xy_m[-1].tolist()))


def _part(row: dict[str, Any]) -> Chain:
    values = {name: np.array(row[name], np.float64) for name in STRETCHES}
    return Chain(
        np.column_stack([row["x_m"], row["y_m"]]), values, row["across_m"],
        (row["sensor_x_m"], row["sensor_y_m"]), row["seen"], frozenset(row["passes"]),
        (row["first_epoch_gps_ns"] or 0, row["last_epoch_gps_ns"] or 0),
    )  # fmt: skip


def chain_of(panel: Panel) -> Chain:
    """Returns the chain of a whole panel, without the passes and epochs of its returns."""
    values = {name: getattr(panel, name).astype(np.float64) for name in STRETCHES if name != "length_m"}
    values["length_m"] = np.hypot(*np.diff(panel.xy_m, axis=0).T)
    return Chain(panel.xy_m, values, panel.across_m, panel.seen_from_m, panel.rows.size, frozenset(), (0, 0))


def _reversed(part: Chain) -> Chain:
    values = {name: value[::-1] for name, value in part.values.items()}
    return Chain(
        part.xy_m[::-1], values, part.across_m, part.sensor_xy_m, part.seen, part.passes,
        part.epochs_gps_ns,
    )  # fmt: skip


def _matched(parts: list[Chain]) -> dict[tuple[int, int], tuple[int, int]]:
    """Returns the end (0 or 1) and the piece to which each end is joined."""
    ends = np.array([p.xy_m[[0, -1]] for p in parts]).reshape(-1, 2)
    outwards = np.array([[_way(p.xy_m[::-1]), _way(p.xy_m)] for p in parts]).reshape(-1, 2)
    levels = [_level(p) for p in parts]
    cells: dict[tuple[int, int], list[int]] = {}
    for i, (x, y) in enumerate(ends.tolist()):
        cells.setdefault((int(x // _JOIN_M), int(y // _JOIN_M)), []).append(i)
    pairs = []
    for (cx, cy), here in cells.items():
        near = [j for a in (-1, 0, 1) for b in (-1, 0, 1) for j in cells.get((cx + a, cy + b), ())]
        for i in here:
            for j in near:
                if i // 2 < j // 2:
                    gap = ends[j] - ends[i]
                    apart = float(np.hypot(*gap))
                    beside = abs(float(outwards[i][0] * gap[1] - outwards[i][1] * gap[0]))
                    straight = -float(outwards[i] @ outwards[j]) >= _JOIN_TURN
                    alike = abs(levels[i // 2] - levels[j // 2]) <= _JOIN_LEVEL_M
                    if (
                        alike
                        and apart <= _JOIN_M
                        and straight
                        and beside <= _JOIN_BESIDE_M
                        and float(outwards[i] @ gap) > -0.5
                    ):
                        pairs.append((apart, i, j))
    joined: dict[tuple[int, int], tuple[int, int]] = {}
    for _, i, j in sorted(pairs):
        a, b = (i // 2, i % 2), (j // 2, j % 2)
        if a not in joined and b not in joined:
            joined[a], joined[b] = b, a
    return joined


def _level(part: Chain) -> float:
    """Height above the ground at which the bulk of a low surface starts; 0 of high ones, which join anyway."""
    bulk, top = part.median("bulk_m"), part.median("high_m")
    return bulk if np.isfinite(bulk) and top <= _LOW_M else 0.0


def _way(xy: Float64) -> Float64:
    """Returns the direction (2,) in which a line ends, over its last 3 m."""
    past = np.hypot(*(xy[:-1] - xy[-1]).T)
    back = int(np.argmax(past <= 3.0)) if (past <= 3.0).any() else len(xy) - 2
    way = xy[-1] - xy[back]
    out: Float64 = way / max(float(np.hypot(*way)), 1e-9)
    return out


def _first_of(start: int, following: dict[tuple[int, int], tuple[int, int]]) -> tuple[int, bool]:
    """Returns the first piece of a piece's chain, and whether that one is reversed."""
    piece, end = start, 0
    while (piece, end) in following:
        piece, other = following[(piece, end)]
        end = 1 - other
        if piece == start:
            break
    return piece, end == 1


def _walk(piece: int, back: bool, following: dict[tuple[int, int], tuple[int, int]]) -> list[tuple[int, bool]]:
    """Returns pieces of a chain from its first one on, each with whether it is reversed."""
    run = [(piece, back)]
    while (end := (run[-1][0], 0 if run[-1][1] else 1)) in following:
        piece, other = following[end]
        if piece == run[0][0]:
            break
        run.append((piece, other == 1))
    return run


def _linked(parts: list[Chain]) -> Chain:
    """Returns one chain of pieces in their order."""
    xy, values = [parts[0].xy_m], {name: [value] for name, value in parts[0].values.items()}
    for part in parts[1:]:
        gap = float(np.hypot(*(part.xy_m[0] - xy[-1][-1])))
        if gap > _SHORTEST_M:
            xy.append(part.xy_m)
            empty = dict.fromkeys(STRETCHES, 0.0) | {
                "length_m": gap,
                "low_m": np.nan,
                "high_m": np.nan,
                "top_m": np.nan,
                "bulk_m": np.nan,
            }
            empty["ground_m"] = float((values["ground_m"][-1][-1] + part.values["ground_m"][0]) / 2)
            for name in STRETCHES:
                values[name].append(np.array([empty[name]]))
            tail = part.values
        else:
            joint = _as_one({n: v[-1][-1] for n, v in values.items()}, {n: v[0] for n, v in part.values.items()})
            tail = part.values if joint is None else {n: v[1:] for n, v in part.values.items()}
            if joint is not None:
                xy[-1] = xy[-1][:-1]
                for name in STRETCHES:
                    values[name][-1] = np.append(values[name][-1][:-1], joint[name])
            xy.append(part.xy_m[1:])
        for name in STRETCHES:
            if tail[name].size:
                values[name].append(tail[name])
    weights = np.array([max(p.seen, 1) for p in parts], np.float64)
    weights /= weights.sum()
    epochs = [p.epochs_gps_ns for p in parts if p.seen]
    return Chain(
        np.concatenate(xy), {name: np.concatenate(v) for name, v in values.items()},
        float(weights @ [p.across_m for p in parts]),
        (float(weights @ [p.sensor_xy_m[0] for p in parts]), float(weights @ [p.sensor_xy_m[1] for p in parts])),
        sum(p.seen for p in parts), frozenset().union(*(p.passes for p in parts)),
        (min((e for e, _ in epochs), default=0), max((e for _, e in epochs), default=0)),
    )  # fmt: skip


def _as_one(one: dict[str, float], other: dict[str, float]) -> dict[str, float] | None:
    """Returns the stretch that the border of a square cut in two; None where the ends are two stretches."""
    if one["length_m"] + other["length_m"] > _LONGEST_STRETCH_M or bool(one["returns"]) != bool(other["returns"]):
        return None
    longer = one if one["length_m"] >= other["length_m"] else other
    return longer | {name: one[name] + other[name] for name in (*COUNTS, "length_m")}


_BEFORE_M, _BEHIND_M = 0.4, 1.5
"""Balconies stand before the plane of a façade, windows and doors behind it, this far at the most (m)."""


def outline(chain: Chain) -> Float64:
    """Returns the ring (n, 3) of a façade: its lower edge, then its upper edge back; gaps are filled from beside."""
    low, high = _filled(chain.values["low_m"]), _filled(chain.values["high_m"])
    xy = np.repeat(chain.xy_m, 2, axis=0)[1:-1]
    lower, upper = np.column_stack([xy, np.repeat(low, 2)]), np.column_stack([xy, np.repeat(high, 2)])
    ring = np.concatenate([lower, upper[::-1], lower[:1]])
    keep = np.append(True, np.abs(np.diff(ring, axis=0)).max(axis=1) > 1e-6)
    out: Float64 = ring[keep]
    return out


def _filled(values: Float64) -> Float64:
    known = np.isfinite(values)
    return np.interp(np.arange(values.size), np.flatnonzero(known), values[known])


def beside(scene: Scene, rows: Int64, before_m: float = _BEFORE_M, behind_m: float = _BEHIND_M) -> Int64:
    """Returns the returns of a surface (`rows`), and those close before and behind it, by default a façade's."""
    returns = scene.returns
    xy = np.column_stack([returns.x_m[rows], returns.y_m[rows]])
    middle = xy.mean(axis=0)
    some = xy[:: max(1, len(xy) // 20_000)] - middle
    _, _, axes = np.linalg.svd(some, full_matrices=False)
    along, normal = axes[0], axes[1]
    seen = np.array([returns.sensor_x_m[rows].mean(), returns.sensor_y_m[rows].mean()]) - middle
    normal = normal if float(normal @ seen) > 0.0 else -normal
    begin, end = float((some @ along).min()) - 0.3, float((some @ along).max()) + 0.3
    places, inside = places_of(scene), np.zeros(len(returns), np.bool_)
    inside[rows] = True
    box = np.array([begin, end, -behind_m, before_m])
    mark_strip(places.x_m, places.y_m, places.rows, middle, np.stack([along, normal]), box, inside)
    return np.flatnonzero(inside)
