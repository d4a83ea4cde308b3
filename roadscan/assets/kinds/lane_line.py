"""Lane lines: paint along the road, joined over its gaps, with its pattern; double lines are one object."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np
import pyarrow as pa
import shapely
from pydantic import Field

from roadscan.assets.classes import MARKING
from roadscan.assets.kind import AssetKind, AssetObject, Evidence, Marked
from roadscan.assets.paint.detection import LINE_PIECES, line_pieces, paint_of, rows_of_paint, shown_pieces
from roadscan.assets.scene import Scene
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.core.strict import Strict

_TOUCHING_M: Final = 0.45
"""Ends no farther apart than this (m) belong to one band of paint."""
_ASIDE_M: Final = 0.12  # Lateral offset of ends that touch (m).
_GAP_SHARE: Final = 4.5
"""Longest gap, in lengths of the longer dash beside it …"""
_SHORT_GAP_M: Final = 4.0  # … and at least (m).
_TIGHTEST_M: Final = 25.0
"""Least radius (m) of a curve that a line follows over a gap."""
_TURN_DEG: Final = 4.0
"""1 σ of the direction of a short dash, times two (degrees)."""
_MISS_M, _MISS_PER_M = 0.12, 0.03  # Lateral offset of ends across a gap (m), and more per metre.


class Run(NamedTuple):
    """Pieces (k,) one after another, and which of them are reversed."""

    pieces: tuple[int, ...]
    turned: tuple[bool, ...]


@dataclass(frozen=True, eq=False)
class Bands:
    """Straight or bent bands (n,): their ends, and the unit vectors that point out of the band there."""

    place: Float64
    """(n, 2, 2) begin and end in the map."""
    outward: Float64
    """(n, 2, 2)"""
    length_m: Float64
    width_m: Float64


def joined(bands: Bands, longest_gap_m: float) -> list[Run]:
    """Returns bands joined one after another, each in one run; with `longest_gap_m` of 0 only those that touch.

    The nearest ends are matched first; an end is used once, and no run closes to a ring.
    """
    count = len(bands.length_m)
    partner = np.full((count, 2), -1)
    group = list(range(count))

    def root(i: int) -> int:
        while group[i] != i:
            group[i] = group[group[i]]
            i = group[i]
        return i

    for _, a, b in _candidates(bands, longest_gap_m):
        i, j = root(a // 2), root(b // 2)
        if partner[a // 2, a % 2] < 0 and partner[b // 2, b % 2] < 0 and i != j:
            partner[a // 2, a % 2], partner[b // 2, b % 2] = b, a
            group[max(i, j)] = min(i, j)
    return _runs(partner)


def _runs(partner: Int64) -> list[Run]:
    """Returns chains of bands, from the first free end of each."""
    used, out = np.zeros(len(partner), np.bool_), []
    for start in range(len(partner)):
        if used[start]:
            continue
        band, side = start, 0
        while partner[band, side] >= 0:
            band, entered = divmod(int(partner[band, side]), 2)
            side = 1 - entered
        pieces, turned = [], []
        entry = side
        while True:
            used[band] = True
            pieces.append(band)
            turned.append(entry == 1)
            following = int(partner[band, 1 - entry])
            if following < 0:
                break
            band, entry = divmod(following, 2)
        out.append(Run(tuple(pieces), tuple(turned)))
    return out


def _candidates(bands: Bands, longest_gap_m: float) -> Sequence[tuple[float, int, int]]:
    """Returns pairs of ends that may belong together, best first: cost, and both ends (2 · band + 0 or 1)."""
    from scipy.spatial import cKDTree

    if not bands.length_m.size:
        return []
    places, outward = bands.place.reshape(-1, 2), bands.outward.reshape(-1, 2)
    pairs = cKDTree(places).query_pairs(max(longest_gap_m, _TOUCHING_M), output_type="ndarray")
    pairs = pairs[pairs[:, 0] // 2 != pairs[:, 1] // 2]
    a, b = pairs[:, 0], pairs[:, 1]
    gap = places[b] - places[a]
    length = np.hypot(gap[:, 0], gap[:, 1])
    on = (outward[a] - outward[b]) / 2
    on /= np.maximum(np.hypot(on[:, 0], on[:, 1]), 1e-9)[:, None]
    forward = (gap * on).sum(axis=1)
    miss = np.abs(gap[:, 0] * on[:, 1] - gap[:, 1] * on[:, 0])
    turn = np.arccos(np.clip(-(outward[a] * outward[b]).sum(axis=1), -1.0, 1.0))
    shorter = np.minimum(bands.length_m[a // 2], bands.length_m[b // 2])
    longer = np.maximum(bands.length_m[a // 2], bands.length_m[b // 2])
    width = np.maximum(bands.width_m[a // 2], bands.width_m[b // 2])
    ratio = width / np.minimum(bands.width_m[a // 2], bands.width_m[b // 2])
    slack = np.radians(_TURN_DEG) * (1.0 + 0.5 / np.maximum(shorter, 0.1))
    touching = (length <= _TOUCHING_M) & (miss <= np.maximum(0.6 * width, _ASIDE_M)) & (turn <= 4 * slack)
    near = longest_gap_m >= length
    near &= (forward > 0) & (ratio <= 2.0) & (length <= np.maximum(_SHORT_GAP_M, _GAP_SHARE * longer))
    near &= (miss <= _MISS_M + _MISS_PER_M * length) & (turn <= slack + length / _TIGHTEST_M)
    good = np.flatnonzero(touching | near)
    cost = length + 10.0 * miss + 2.0 * (ratio - 1.0)
    return sorted((float(cost[k]), int(a[k]), int(b[k])) for k in good)


_APART_M: Final = (0.12, 0.55)
"""Distance between the middles of the two lines (m)."""
_EVEN_M: Final = 0.06  # Greatest variation of that distance (m).
_STEP_M: Final = 0.5  # Distance of the points that are compared (m).
_SHORTEST_PAIRED_M: Final = 2.0  # Shorter lines are not paired (m).
_TOGETHER: Final = 0.7  # Share of the shorter line that runs beside the longer.
_KINDS: Final = {
    ("solid", "solid"): "double_solid",
    ("dashed", "dashed"): "double_dashed",
    ("dashed", "solid"): "solid_dashed",
}


def paired(lines: Sequence[AssetObject]) -> list[AssetObject]:
    """Returns the lines, with two parallel ones made one; the longest find their partner first."""
    order = sorted(range(len(lines)), key=lambda k: (-lines[k].attributes["length_m"], lines[k].geometry.coords[0]))
    tree = shapely.STRtree([line.geometry for line in lines])
    taken: set[int] = set()
    out = []
    for k in order:
        if k in taken:
            continue
        taken.add(k)
        near = tree.query(lines[k].geometry, predicate="dwithin", distance=_APART_M[1])
        beside = [int(j) for j in sorted(near, key=order.index) if j not in taken and _beside(lines[k], lines[int(j)])]
        if not beside:
            out.append(lines[k])
            continue
        taken.add(beside[0])
        out.append(_double(lines[k], lines[beside[0]]))
    return out


def _beside(long: AssetObject, short: AssetObject) -> bool:
    """Returns True where the shorter line runs beside the longer one, at an even distance."""
    length = short.geometry.length
    if length < _SHORTEST_PAIRED_M or length < _TOGETHER * long.geometry.length or None in (_of(long), _of(short)):
        return False
    points = shapely.line_interpolate_point(short.geometry, np.arange(0.0, length, _STEP_M))
    apart = shapely.distance(points, long.geometry)
    middle = float(np.median(apart))
    return bool(_APART_M[0] <= middle <= _APART_M[1] and np.mean(np.abs(apart - middle) <= _EVEN_M) >= _TOGETHER)


def _of(line: AssetObject) -> str | None:
    kind = line.attributes["type"]
    return kind if kind in {"solid", "dashed"} else None


def _double(one: AssetObject, other: AssetObject) -> AssetObject:
    """Returns both as one line, midway between them."""
    kinds = tuple(sorted((str(_of(one)), str(_of(other)))))
    places = shapely.get_coordinates(one.geometry, include_z=True)
    nearest = shapely.line_interpolate_point(
        other.geometry, shapely.line_locate_point(other.geometry, shapely.points(places))
    )
    midway = (places + shapely.get_coordinates(nearest, include_z=True)) / 2
    a, b = one.attributes, other.attributes
    dashed = b if _of(other) == "dashed" else a
    attributes = {
        **a,
        "type": _KINDS[kinds[0], kinds[1]],
        "width_m": (a["width_m"] + b["width_m"]) / 2,
        "dash_m": dashed["dash_m"],
        "gap_m": dashed["gap_m"],
        "contrast": (a["contrast"] + b["contrast"]) / 2,
    }
    return replace(
        one,
        geometry=shapely.LineString(midway),
        sigma_horizontal_m=max(one.sigma_horizontal_m, other.sigma_horizontal_m),
        probability=max(one.probability, other.probability),
        returns=one.returns + other.returns,
        passes=max(one.passes, other.passes),
        first_epoch_gps_ns=min(one.first_epoch_gps_ns, other.first_epoch_gps_ns),
        last_epoch_gps_ns=max(one.last_epoch_gps_ns, other.last_epoch_gps_ns),
        attributes=attributes,
    )


_LONGEST_DASH_M: Final = 8.0  # Longest dash (m).
_WORN_GAP_M: Final = 2.0
"""Longest gap (m) over which a solid line continues."""
_SOLID_SHARE: Final = 0.8
"""Painted share from which dashes are a worn solid line."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """Paint without a gap."""

    line: Float64
    """(n, 3) centre line in the map: easting, northing, height."""
    pieces: tuple[int, ...]
    seen: tuple[bool, bool]
    """Whether bare ground was seen beyond its ends."""
    length_m: float
    width_m: float

    def turned(self) -> Stretch:
        """Returns the same in the other direction."""
        return Stretch(self.line[::-1], self.pieces[::-1], self.seen[::-1], self.length_m, self.width_m)


def patterned(chain: Sequence[Stretch]) -> list[tuple[str | None, list[Stretch]]]:
    """Returns stretches in sequence, split where the pattern changes; None where no pattern is known."""
    groups: list[list[list[Stretch]]] = []
    for bundle in _over_hidden_gaps(chain):
        if groups and _goes_on(groups[-1][-1], bundle):
            groups[-1].append(bundle)
        else:
            groups.append([bundle])
    return [(_kind(group), [s for bundle in group for s in bundle]) for group in groups]


def _over_hidden_gaps(chain: Sequence[Stretch]) -> list[list[Stretch]]:
    """Join stretches between which no bare ground was seen: something hid the line."""
    out = [[chain[0]]]
    for before, after in pairwise(chain):
        if before.seen[1] and after.seen[0]:
            out.append([after])
        else:
            out[-1].append(after)
    return out


def _goes_on(before: list[Stretch], after: list[Stretch]) -> bool:
    short = _reach(before) < _LONGEST_DASH_M, _reach(after) < _LONGEST_DASH_M
    gap = float(np.hypot(*(after[0].line[0, :2] - before[-1].line[-1, :2])))
    return all(short) or (not any(short) and gap <= _WORN_GAP_M)


def _reach(bundle: list[Stretch]) -> float:
    return float(np.hypot(*(bundle[-1].line[-1, :2] - bundle[0].line[0, :2])))


def _kind(group: list[list[Stretch]]) -> str | None:
    if _reach(group[0]) >= _LONGEST_DASH_M:
        return "solid"
    painted = sum(s.length_m for bundle in group for s in bundle)
    whole = float(np.hypot(*(group[-1][-1].line[-1, :2] - group[0][0].line[0, :2])))
    if len(group) == 1:
        return "dashed" if group[0][0].seen[0] and group[0][-1].seen[1] else None
    return "solid" if painted >= _SOLID_SHARE * whole else "dashed"


_SHORTEST_LINE_M: Final = 1.0
"""Isolated paint shorter than this (m) is no line."""


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Pieces (n,) of all tiles, in canonical order."""

    ends: Float64
    """(n, 2, 3) start and end: easting, northing, height."""
    seen: Bool
    """(n, 2) mask of ends with bare ground beyond."""
    table: pa.Table

    @property
    def length_m(self) -> Float64:
        """Returns the lengths (n,) of the pieces."""
        return np.asarray(np.hypot(*(self.ends[:, 1, :2] - self.ends[:, 0, :2]).T))

    def numbers(self, name: str) -> Float64:
        """Returns a column of the table (n,)."""
        return np.asarray(self.table[name].to_numpy(), np.float64)


def lane_lines(table: pa.Table, longest_gap_m: float) -> list[AssetObject]:
    """Lane lines of the pieces (:data:`~roadscan.assets.paint.detection.LINE_PIECES`), by easting and northing."""
    pieces = _sorted(table)
    if not pieces.table.num_rows:
        return []
    direction = (pieces.ends[:, 1, :2] - pieces.ends[:, 0, :2]) / np.maximum(pieces.length_m, 1e-9)[:, None]
    outward = np.stack([-direction, direction], axis=1)
    width = pieces.numbers("width_m")
    runs = joined(Bands(pieces.ends[:, :, :2], outward, pieces.length_m, width), 0.0)
    stretches = [_stretch(pieces, run) for run in runs]
    ends = np.array([[s.line[0, :2], s.line[-1, :2]] for s in stretches])
    turns = np.array(
        [[outward[r.pieces[0], int(r.turned[0])], outward[r.pieces[-1], int(not r.turned[-1])]] for r in runs]
    )
    bands = Bands(ends, turns, np.array([s.length_m for s in stretches]), np.array([s.width_m for s in stretches]))
    chains = joined(bands, longest_gap_m)
    lines = [_object(pieces, group) for chain in chains for group in patterned(_in_order(stretches, chain))]
    long = [line for line in lines if line.attributes["length_m"] >= _SHORTEST_LINE_M]
    return sorted(paired(long), key=lambda line: (line.geometry.coords[0], line.geometry.coords[-1]))


def _sorted(table: pa.Table) -> _Pieces:
    """Returns the pieces, sorted by their ends."""
    names = [f"{end}_{axis}_m" for end in ("begin", "end") for axis in ("x", "y", "height")]
    ends = np.stack([np.asarray(table[name].to_numpy(), np.float64) for name in names], axis=1).reshape(-1, 2, 3)
    seen = np.stack(
        [np.asarray(table[n].to_numpy(zero_copy_only=False), np.bool_) for n in ("begin_seen", "end_seen")], 1
    )
    order = np.lexsort(ends.reshape(-1, 6).T[::-1])
    return _Pieces(ends[order], seen[order], table.take(pa.array(order)))


def _stretch(pieces: _Pieces, run: Run) -> Stretch:
    """Returns paint without a gap: its centre line, midway between pieces that meet."""
    nodes = np.concatenate([pieces.ends[p][:: -1 if t else 1] for p, t in zip(run.pieces, run.turned, strict=True)])
    if len(run.pieces) > 1:
        inner = (nodes[1:-1:2] + nodes[2:-1:2]) / 2
        nodes = np.concatenate([nodes[:1], inner, nodes[-1:]])
    first, last = run.pieces[0], run.pieces[-1]
    seen = bool(pieces.seen[first, int(run.turned[0])]), bool(pieces.seen[last, int(not run.turned[-1])])
    numbers = list(run.pieces)
    weight = np.maximum(pieces.length_m[numbers], 1e-3)
    width = _middle(pieces.numbers("width_m")[numbers], weight)
    return Stretch(nodes, tuple(run.pieces), seen, float(np.hypot(*np.diff(nodes[:, :2], axis=0).T).sum()), width)


def _in_order(stretches: list[Stretch], chain: Run) -> list[Stretch]:
    return [
        stretches[k].turned() if turned else stretches[k] for k, turned in zip(chain.pieces, chain.turned, strict=True)
    ]


def _object(pieces: _Pieces, group: tuple[str | None, list[Stretch]]) -> AssetObject:
    """Returns a line of stretches of one pattern."""
    kind, stretches = group
    numbers = [p for s in stretches for p in s.pieces]
    weight = np.maximum(pieces.length_m[numbers], 1e-3)
    line = shapely.LineString(np.concatenate([s.line for s in stretches]))
    dashes = np.array([s.length_m for s in stretches])
    gaps = [float(np.hypot(*(b.line[0, :2] - a.line[-1, :2]))) for a, b in pairwise(stretches)]
    dashed = kind == "dashed"
    whole = dashes[[s.seen == (True, True) for s in stretches]]
    attributes = {
        "type": kind,
        "width_m": _middle(pieces.numbers("width_m")[numbers], weight),
        "dash_m": float(np.median(whole)) if dashed and whole.size else None,
        "gap_m": float(np.median(gaps)) if dashed and gaps else None,
        "colour": None,
        "contrast": 1.0 + _middle(pieces.numbers("contrast")[numbers], weight),
        "length_m": float(line.length),
    }
    return AssetObject(
        geometry=line,
        sigma_horizontal_m=_middle(pieces.numbers("sigma_across_m")[numbers], weight),
        sigma_height_m=_middle(pieces.numbers("sigma_height_m")[numbers], weight),
        probability=float(np.average(pieces.numbers("probability")[numbers], weights=weight)),
        returns=int(pieces.numbers("returns")[numbers].sum()),
        passes=len({p for k in numbers for p in pieces.table["passes"][k].as_py()}),
        first_epoch_gps_ns=min(pieces.table["first_epoch_gps_ns"][k].as_py() for k in numbers),
        last_epoch_gps_ns=max(pieces.table["last_epoch_gps_ns"][k].as_py() for k in numbers),
        attributes=attributes,
        sigma_size_m=math.sqrt(2.0) * _middle(pieces.numbers("sigma_across_m")[numbers], weight),
    )


def _middle(values: Float64, weight: Float64) -> float:
    """Returns the weighted median."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weight[order])
    return float(values[order][int(np.searchsorted(total, total[-1] / 2))])


_LONGEST_GAP_M: Final = 15.0  # Default of the setting below (m).


class LaneLineOptions(Strict):
    """Settings of `lane_line`."""

    longest_gap_m: float = Field(default=_LONGEST_GAP_M, gt=0.0, le=50.0)
    """Longest gap between two dashes of a line (m)."""


class LaneLine(AssetKind):
    """A row for each painted line: its pattern, its width, and its contrast to the surface."""

    name = "lane_line"
    title = "lane lines"
    curve = "products"
    options = LaneLineOptions
    piece_schema: ClassVar[pa.Schema] = LINE_PIECES
    sees_paint: ClassVar[bool] = True

    def evidence(self, scene: Scene, options: Any) -> Evidence:
        """Returns straight pieces of lines in the tile."""
        paint = paint_of(scene)
        marked = Marked(rows_of_paint(paint.contrast, paint.lines), MARKING)
        counts = {"dense_cells": paint.contrast.dense_cells, "rough_cells": paint.contrast.rough_cells}
        return Evidence(line_pieces(scene, paint), (marked,), counts)

    def with_pictures(self, pieces: pa.Table, shown: pa.Table) -> pa.Table:
        """Returns pieces, and those of lines that pictures alone show."""
        return pa.concat_tables([pieces, shown_pieces(shown, "line", LINE_PIECES)])

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Returns lines of the pieces of all tiles."""
        return lane_lines(pieces, options.longest_gap_m)
