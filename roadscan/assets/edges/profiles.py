"""Edges as chains of places: paths of the best evidence, and at even nodes the step's place, height and face."""

from __future__ import annotations

import itertools
import math
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.linalg
import scipy.ndimage
import scipy.spatial

from roadscan.assets.bins import cells_of, in_bins
from roadscan.assets.edges.steps import LEAST_STEP_M, HeightRaster, Places
from roadscan.assets.kernels import step_profiles as kernel
from roadscan.assets.kernels.edge_links import MAX_LINKS, best_ways, find_links, trace
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.arrays import runs_of, way_along

FREE_M: Final = 0.3
"""Distance of consecutive places (m) that is no gap."""


REACH_M: Final = 18.5
"""What lies farther from a square (m) does not change its kerbs: evidence along 10 m, the reach of a step and a node,
and along 5 m the means of probabilities, holes and the shortest length."""


class PathSettings(NamedTuple):
    """How places become paths. One setting for all data."""

    memory_m: float = 6.0
    """Evidence counts over about this length to each side: e^(−x / memory)."""
    chance: float = 2.5
    """Evidence (σ) of a place that chance gives as well: it is taken off."""
    most: float = 8.0
    """Evidence (σ) of one place counts up to this, so that no single place makes a path."""
    near_m: float = 0.5
    far_m: float = 1.6
    """Distances of the next place; a far one is taken where none is near."""
    bend_deg: float = 32.0
    """Greatest bend from place to place."""
    gap_cost: float = 1.0
    """Evidence that a metre without a place costs (σ)."""
    bend_cost: float = 12.0
    begin: float = 5.0
    """Least evidence (σ · m) of a path through its strongest place."""
    go_on: float = 3.0
    """Least evidence (σ · m) of a path through any of its places."""
    way_m: float = 10.0
    """The next place of a path is that of the best way of this length: with the reach of a step, 3.3 m, it stays within
    the halo of a square."""
    beside_m: float = 0.25
    """A path leaves no second one within this distance."""
    gutter_m: float = 0.65
    """The other side of a gutter this wide belongs to its kerb."""


DEFAULT: Final = PathSettings()


class Chain(NamedTuple):
    """A chain of places, in their direction."""

    places: Places
    gains: Float64
    """Evidence (σ · m) from each place to the next."""
    closed: bool = False
    """Whether the first place follows the last one; the first is the westernmost, wherever a scene found it."""

    @property
    def evidence(self) -> float:
        """Returns the evidence (σ · m) of the places that belong to it alone."""
        return float(self.gains.sum())


def paths_of(places: Places, settings: PathSettings = DEFAULT) -> list[Chain]:
    """Returns paths through places, the strongest first.

    Each place has links to those that may follow it; the best way on from every place and to it is found by dynamic
    programming, with evidence that fades with distance. From the strongest place on the best ways are followed.
    """
    n = len(places.x_m)
    if n < 2:
        return []
    place = np.ascontiguousarray(np.column_stack(places[:4]))
    quality = np.minimum(places.evidence, settings.most) - settings.chance
    links, lengths, gains = np.full((n, MAX_LINKS), -1, np.int64), np.zeros((n, MAX_LINKS)), np.zeros((n, MAX_LINKS))
    order, starts, bins = _bins(places, settings.near_m)
    limits = (FREE_M, math.cos(math.radians(settings.bend_deg)), settings.gap_cost, settings.bend_cost)
    reach = (settings.near_m, settings.far_m)
    find_links(place, quality, order, starts, bins, reach, limits, links, lengths, gains)
    ahead, behind = np.zeros(n), np.zeros(n)
    following, preceding = np.full(n, -1, np.int64), np.full(n, -1, np.int64)
    rounds = round(20.0 * settings.memory_m)
    near = (settings.go_on, settings.way_m)
    best_ways(links, lengths, gains, settings.memory_m, rounds, near, ahead, following, behind, preceding)
    total = ahead + behind
    ranked = np.lexsort((np.arange(n), -total))
    chain, owner = np.zeros((n, 2), np.int64), np.full(n, -1, np.int64)
    following_limits = (settings.begin, settings.go_on, settings.beside_m, settings.gutter_m)
    number, length = trace(
        place, total, following, preceding, ranked, order, starts, bins, following_limits, chain, owner
    )
    ends = np.searchsorted(chain[:length, 0], np.arange(number + 1))
    found = (chain[a:b, 1] for a, b in itertools.pairwise(ends))
    chains = (
        Chain(places.at(rows), _gains(place[ways], quality[ways], settings), closed)
        for chain in found
        for rows, closed in _opened(chain, following, place, settings.beside_m)
        for ways in (np.append(rows, rows[:1]) if closed else rows,)
    )
    return sorted((c for c in chains if c.evidence >= settings.begin), key=lambda c: -c.evidence)


def _opened(rows: Int64, following: Int64, place: Float64, beside_m: float) -> list[tuple[Int64, bool]]:
    """Returns the places of the lines that a chain is made of, and whether each is closed.

    A chain whose last place leads back to one of its places goes round from there. Those before lead into the round,
    as far as they do not lie beside it.
    """
    again = np.flatnonzero(rows == following[rows[-1]])
    if not again.size:
        return [(rows, False)]
    ring, before = rows[again[0] :], rows[: again[0]]
    ring = np.roll(ring, -np.lexsort((place[ring, 1], place[ring, 0]))[0])
    beside = scipy.spatial.cKDTree(place[ring, :2]).query(place[before, :2])[0] <= beside_m
    before = before[: np.argmax(beside)] if beside.any() else before
    return [(ring, True), (before, False)] if len(before) >= 2 else [(ring, True)]


def _gains(place: Float64, quality: Float64, settings: PathSettings) -> Float64:
    """Returns the evidence (σ · m) from each place of a chain to the next; what a stronger chain has does not count."""
    length = np.hypot(*np.diff(place[:, :2], axis=0).T)
    free = np.minimum(length, FREE_M)
    return np.asarray(free * 0.5 * (quality[1:] + quality[:-1]) - (length - free) * settings.gap_cost)


def _bins(places: Places, size_m: float) -> tuple[Int64, Int64, tuple[float, float, float, float, float]]:
    x_min, y_min = (size_m * math.floor(float(v.min()) / size_m) for v in (places.x_m, places.y_m))
    column, row = ((places.x_m - x_min) / size_m).astype(np.int64), ((places.y_m - y_min) / size_m).astype(np.int64)
    columns, rows = int(column.max()) + 1, int(row.max()) + 1
    number = row * columns + column
    starts, order = in_bins(number, rows * columns)
    return order, starts, (x_min, y_min, size_m, float(rows), float(columns))


NODE_M: Final = 0.5
"""Distance of nodes along an edge (m)."""
_LATTICE_M: Final = 6.0
"""Edge of the lattice whose crossings are nodes (m)."""
ALONG_M: Final = 0.5
"""Half the length of a node's window (m): neighbours share half of their heights."""
SEARCH: Final = (0.2, 0.02, 0.24, 0.35)
"""Farthest offset from the chain, least and greatest face, depth of a side (m)."""
PRIOR: Final = (0.05, 0.015)
"""Standard deviation of a side's slope about the ground's (m/m), and of a height (m)."""
ROUNDS: Final = 2  # Times that the line is moved to the steps and smoothed.
STIFFNESS: Final = 4.0
"""Weight of a bend against that of a place."""
BEND_M: Final = 0.04
"""A bend of this size (second difference of nodes, m) has half weight."""
AWAY_M: Final = 0.04
"""A node this far off its line (m) has half weight."""
PLACE_BLUR_M: Final = 0.02
"""Standard deviation of the place of a return, across an edge (m): it makes a face look wider."""
_BIN_M: Final = 0.5  # Edge of the bins of heights (m).


class Heights(NamedTuple):
    """Heights of the ground, sorted by bins of half a metre for the kernel."""

    x_m: Float64
    y_m: Float64
    height_m: Float64
    starts: Int64
    """First height of each bin, and the end of the last."""
    bins: tuple[float, float, float, float, float]
    """Corner of the first bin, edge of a bin (m), rows and columns."""


class Nodes(NamedTuple):
    """Nodes of an edge, in its direction; the higher side lies to the right."""

    x_m: Float64
    """Of the middle of the step's face."""
    y_m: Float64
    top_m: Float64
    """Height of the upper edge."""
    heading_x: Float64
    heading_y: Float64
    step_m: Float64
    sigma_step_m: Float64
    """NaN where no step is measurable."""
    face_m: Float64
    """Width of the face, seen from above."""
    scatter_m: Float64
    """Scatter of both sides about their lines, strip by strip."""
    returns: Float64
    seen_low: Float64
    """Seen share of the lower side, up to the farthest height of at most 1.2 m."""
    seen_high_m: Float64
    """Seen width of the higher side, of at most 1.2 m."""
    sigma_m: Float64
    """Of the place, across the edge."""
    covered: Float64
    """Share of the window along the edge that was seen on both sides."""

    def at(self, rows: npt.NDArray[np.int64] | Bool | slice) -> Nodes:
        """Returns the nodes at `rows`."""
        return Nodes(*(column[rows] for column in self))


def sorted_heights(x_m: Float64, y_m: Float64, height_m: Float64) -> Heights:
    """Returns heights (n,) at places (n,), sorted by bins of half a metre; equal bins keep their order."""
    if x_m.size == 0:
        return Heights(x_m, y_m, height_m, np.zeros(2, np.int64), (0.0, 0.0, _BIN_M, 1.0, 1.0))
    x_min, y_min = _BIN_M * np.floor(x_m.min() / _BIN_M), _BIN_M * np.floor(y_m.min() / _BIN_M)
    columns, rows = int((x_m.max() - x_min) / _BIN_M) + 1, int((y_m.max() - y_min) / _BIN_M) + 1
    number = cells_of(x_m, y_m, (float(x_min), float(y_min), _BIN_M), (rows, columns))
    starts, order = in_bins(number, rows * columns)
    bins = (float(x_min), float(y_min), _BIN_M, float(rows), float(columns))
    return Heights(x_m[order], y_m[order], height_m[order], starts, bins)


_LAPS: Final = 3
"""A closed line is followed so often: in the second lap nothing depends on where it begins."""


def chain_line(chain: Chain) -> tuple[Float64, int]:
    """Returns points (k, 2) at even distances along a chain of places, and how many are a lap.

    That is 0 of an open chain. Of a closed one there are three laps, and the first point once more.
    """
    places = np.column_stack(chain.places[:2])
    if not chain.closed:
        return even_nodes(places, NODE_M), 0
    line = even_nodes(np.concatenate([places] * _LAPS + [places[:1]]), NODE_M)
    middle = len(line) // 2
    same = np.flatnonzero(np.hypot(*(line[middle + 1 :] - line[middle]).T) < 1e-6)
    if same.size:
        return line, int(same[0]) + 1
    # No lattice fixes the points of so small a line: they count from its westernmost place.
    way = way_along(line)
    at = np.linspace(way[-1] / _LAPS, 2.0 * way[-1] / _LAPS, max(round(way[-1] / _LAPS / NODE_M), 3), endpoint=False)
    lap = np.column_stack([np.interp(at, way, line[:, k]) for k in range(2)])
    return np.concatenate([lap] * _LAPS + [lap[:1]]), len(lap)


def runs_along(flags: Bool, lap: int) -> list[Int64]:
    """Returns the rows of runs of true flags (n,) along a line; lap : as :func:`chain_line` has it.

    Of a closed line they are rows of the second lap, or all rows where that is one run.
    """
    if not lap:
        return [np.arange(first, end) for first, end in runs_of(flags)]
    second = flags[lap : 2 * lap]
    if second.all():
        return [np.arange(len(flags))]
    runs = (np.arange(first, end) for first, end in runs_of(np.tile(second, 3)) if lap <= first < 2 * lap)
    return [lap + rows % lap for rows in runs]


def places_along(line: Float64, chain: Chain) -> tuple[Bool, Float64]:
    """Returns which points (n, 2) along a chain lie at one of its places, not in a gap, and the evidence (σ · m) of
    the places about each.
    """
    places = np.column_stack(chain.places[:2])
    away, nearest = scipy.spatial.cKDTree(places).query(line)
    total = np.append(0.0, np.cumsum(chain.gains))
    at = total[nearest]
    if chain.closed:
        at = np.unwrap(at, period=total[-1])
    middles = 0.5 * (at[1:] + at[:-1])
    ends = (at[:1], at[-1:]) if chain.closed else (total[:1], total[-1:])
    return away <= FREE_M, np.diff(np.concatenate([ends[0], middles, ends[1]]))


def nodes_of(
    line: Float64, heights: Heights, raster: HeightRaster, slopes: tuple[Float64, Float64], shown: Bool | None = None
) -> Nodes:
    """Returns nodes of a line (k, 2), each with the step that its surroundings show; the higher side is the right one.

    The line is moved to the steps and smoothed twice, since steps are measured best where it runs along the edge.
    slopes : of the ground at large, see :meth:`HeightRaster.slopes`. shown : (k,) points that may show the edge; the
    others, and those without a step, hardly bend the line: a chain may leave the edge where the edge is hidden.
    """
    shown = np.ones(len(line), np.bool_) if shown is None else shown
    for _ in range(ROUNDS):
        ux, uy = headings(line[:, 0], line[:, 1])
        out, level = _fitted(line, (ux, uy), heights, raster, slopes)
        known = shown & np.isfinite(out[:, kernel.SIGMA_STEP]) & (out[:, kernel.STEP] >= LEAST_STEP_M)
        offset = smooth_offsets(out[:, kernel.OFFSET] - 0.5 * out[:, kernel.FACE], known)
        moved = np.column_stack([line[:, 0] + offset * uy, line[:, 1] - offset * ux])
        line = smooth_line(moved, np.where(known, out[:, kernel.COVERED] + 0.05, 0.02))
    face = np.sqrt(np.maximum(out[:, kernel.FACE] ** 2 - 12.0 * PLACE_BLUR_M**2, 0.0))
    ux, uy = headings(line[:, 0], line[:, 1])
    return Nodes(
        line[:, 0], line[:, 1], level + out[:, kernel.TOP], ux, uy, out[:, kernel.STEP], out[:, kernel.SIGMA_STEP],
        face, out[:, kernel.SCATTER], out[:, kernel.RETURNS], out[:, kernel.SEEN_LOW], out[:, kernel.SEEN_HIGH],
        out[:, kernel.SIGMA_OFFSET], out[:, kernel.COVERED],
    )  # fmt: skip


def _fitted(
    line: Float64,
    heading: tuple[Float64, Float64],
    heights: Heights,
    raster: HeightRaster,
    slopes: tuple[Float64, Float64],
) -> tuple[Float64, Float64]:
    """Returns steps (n, RESULTS) at the nodes of a line, and the heights (n,) from which they count."""
    ux, uy = heading
    row, column = raster.cells_of(line[:, 0], line[:, 1])
    gx, gy = slopes[0][row, column], slopes[1][row, column]
    level = _level(raster, row, column)
    node = np.ascontiguousarray(np.column_stack([line, ux, uy, level, gx * ux + gy * uy, gx * uy - gy * ux]))
    out = np.empty((len(line), kernel.RESULTS))
    kernel.fit_nodes(node, *heights, ALONG_M, SEARCH, PRIOR, out)
    return out, level


def smooth_line(points: Float64, weight: Float64) -> Float64:
    """Returns points (n, 2) of a smooth line near points (n, 2) with weights (n,).

    The sum of squared distances and of squared second differences is least; points that lie far off, and bends, count
    less each time that it is solved, so that a wrong node is left aside and a corner stays one.
    """
    n = len(points)
    if n < 4:
        return points
    line = points
    second = np.zeros(n - 2)
    away = np.zeros(n)
    for _ in range(4):
        stiff = STIFFNESS / (1.0 + (second / BEND_M) ** 2)
        banded = np.zeros((3, n))
        banded[0] = weight / (1.0 + (away / AWAY_M) ** 2)
        right = banded[0][:, None] * points
        for i, (a, b) in enumerate(((0, 1.0), (1, -2.0), (2, 1.0))):
            banded[0, a : n - 2 + a] += stiff * b * b
            for j, c in ((1, -2.0), (2, 1.0)):
                if j > i:
                    banded[j - i, a : n - 2 + a] += stiff * b * c
        line = scipy.linalg.solveh_banded(banded, right, lower=True)
        second = np.hypot(*(line[2:] - 2.0 * line[1:-1] + line[:-2]).T)
        away = np.hypot(*(line - points).T)
    return np.asarray(line)


def even_nodes(places: Float64, distance_m: float) -> Float64:
    """Returns points (k, 2) at about even distances along places (n, 2), which are smoothed over 0.6 m first.

    Nodes lie where the line crosses a lattice of the map, and evenly between: wherever a square lets it begin.
    """
    path = stops(places, 0.1, _LATTICE_M)
    if len(path) >= 3:
        # Mirrored about the end points, which so stay fixed.
        more = min(len(path) - 1, 12)
        before, behind = 2.0 * path[:1] - path[more:0:-1], 2.0 * path[-1:] - path[-2 : -2 - more : -1]
        path = scipy.ndimage.gaussian_filter1d(np.concatenate([before, path, behind]), 3.0, axis=0)[more:-more]
    return stops(path, distance_m, _LATTICE_M)


def stops(places: Float64, distance_m: float, lattice_m: float) -> Float64:
    """Returns points (k, …) along places (n, …), x and y first: both ends, crossings of a lattice of the map, even ones
    between.
    """
    length, fixed = way_along(places), []
    for at in places.T[:2] / lattice_m:
        cell = np.floor(at)
        k = np.flatnonzero(np.diff(cell))
        share = (np.maximum(cell[k], cell[k + 1]) - at[k]) / (at[k + 1] - at[k])
        fixed.append(length[k] + share * (length[k + 1] - length[k]))
    found = np.sort(np.concatenate(fixed))
    found = found[np.diff(found, prepend=-np.inf) > distance_m]
    inner = found[(found > 0.5 * distance_m) & (found < length[-1] - 0.5 * distance_m)]
    ends = np.concatenate([[0.0], inner, length[-1:]])
    counts = np.maximum(np.rint(np.diff(ends) / distance_m).astype(np.int64), 1)
    parts = [np.linspace(*part, n, endpoint=False) for part, n in zip(itertools.pairwise(ends), counts, strict=True)]
    stops = np.concatenate([*parts, ends[-1:]])
    return np.column_stack([np.interp(stops, length, places[:, i]) for i in range(places.shape[1])])


def headings(x_m: Float64, y_m: Float64) -> tuple[Float64, Float64]:
    """Returns unit vectors (n,) along a line of two points or more, at its points."""
    ex, ey = np.gradient(x_m), np.gradient(y_m)
    length = np.maximum(np.hypot(ex, ey), 1e-9)
    return ex / length, ey / length


def smooth_offsets(offset_m: Float64, known: Bool) -> Float64:
    """Returns offsets (n,) of nodes, the median of three known neighbours, and 0 far from known ones."""
    if not known.any():
        return np.zeros_like(offset_m)
    at = np.flatnonzero(known)
    found = offset_m[at]
    middle = scipy.ndimage.median_filter(found, 3, mode="nearest")
    return np.asarray(np.interp(np.arange(len(offset_m)), at, middle))


def _level(raster: HeightRaster, row: Int64, column: Int64) -> Float64:
    """Height (n,) near cells: the mean of those known within 0.3 m, so that the kernel's sums stay small."""
    rows, columns = raster.count.shape
    step = np.arange(-3, 4)
    r = np.clip(row[:, None, None] + step[:, None], 0, rows - 1)
    c = np.clip(column[:, None, None] + step, 0, columns - 1)
    near, known = raster.height_m[r, c], raster.count[r, c] > 0
    number = known.sum(axis=(1, 2))
    total = np.where(known, near, 0.0).sum(axis=(1, 2))
    return np.asarray(np.where(number > 0, total / np.maximum(number, 1), raster.level_m))
