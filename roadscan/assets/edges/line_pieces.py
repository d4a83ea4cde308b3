"""Pieces of lines and of the areas beside them, cut at the border of a tile and joined across tiles."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import scipy.ndimage
import scipy.spatial
import shapely

from roadscan.assets.edges.find import Edge
from roadscan.assets.edges.profiles import Nodes
from roadscan.assets.edges.steps import HeightRaster
from roadscan.assets.scene import Box, Scene
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.arrays import scatter_about, way_along, without_holes

NODE_COLUMNS: Final = (
    "easting_m", "northing_m", "height_m", "step_m", "sigma_step_m", "face_m", "scatter_m", "sigma_m", "seen_low",
    "seen_high_m", "seen", "probability",
)  # fmt: skip


def line_schema(columns: Sequence[str]) -> pa.Schema:
    """Returns the columns of a piece of a line: a value a node of each of `columns`, and its returns and passes."""
    return pa.schema(
        [pa.field(name, pa.list_(pa.float64()), nullable=False) for name in columns]
        + [
            pa.field("returns", pa.int64(), nullable=False),
            pa.field("passes", pa.list_(pa.int32()), nullable=False),
            pa.field("first_epoch_gps_ns", pa.int64(), nullable=False),
            pa.field("last_epoch_gps_ns", pa.int64(), nullable=False),
            pa.field("cut_first", pa.bool_(), nullable=False),
            pa.field("cut_last", pa.bool_(), nullable=False),
        ]
    )


LINE_PIECES: Final = line_schema(NODE_COLUMNS)
"""Columns of a piece: a value a node in the direction of the line (higher side to the right), what saw it, and whether
its ends lie on the tile's border. `seen` is 1 for nodes whose step was measured; `probability` is that of a kerb."""
JOIN_M: Final = 0.5
"""Greatest distance (m) between the ends of two tiles' lines on their border."""
SAME_M: Final = 1e-3
"""Ends of two tiles' lines that lie so near (m) to one another, and to the straight way between the nodes beside them,
are the cut of one line …"""
SEGMENT_M: Final = 0.75
"""… whose nodes are no farther apart than this (m), half more than they are as a rule."""
NEAR_M: Final = 0.25
"""Returns this near to a line (m) show it."""


class Seen(NamedTuple):
    """Returns, passes and epochs that saw an object."""

    returns: int
    passes: tuple[int, ...]
    first_epoch_gps_ns: int
    last_epoch_gps_ns: int

    def with_other(self, other: Seen) -> Seen:
        """Returns the union with another one."""
        if self.returns == 0 or other.returns == 0:
            return self if other.returns == 0 else other
        return Seen(
            self.returns + other.returns, tuple(sorted({*self.passes, *other.passes})),
            min(self.first_epoch_gps_ns, other.first_epoch_gps_ns),
            max(self.last_epoch_gps_ns, other.last_epoch_gps_ns),
        )  # fmt: skip


class Line(NamedTuple):
    """A line of nodes (n, columns) in the map, and what saw it."""

    nodes: Float64
    seen_by: Seen
    names: tuple[str, ...] = NODE_COLUMNS
    """Names of the columns."""

    def column(self, name: str) -> Float64:
        """Returns a column (n,) of its nodes."""
        return np.asarray(self.nodes[:, self.names.index(name)])

    @property
    def probability(self) -> float:
        """Returns the probability that a node of it lies at a kerb: the mean, which is the share that is expected."""
        return float(np.nanmean(self.column("probability")))

    @property
    def length_m(self) -> float:
        """Returns its length in the map (m)."""
        return float(np.hypot(*np.diff(self.nodes[:, :2], axis=0).T).sum())


class CutEdge(NamedTuple):
    """A part of an edge within a tile (n, columns as `NODE_COLUMNS`), coordinates as the scene's returns."""

    nodes: Float64
    cut_first: bool
    cut_last: bool


def columns_of(edge: Edge) -> Float64:
    """Returns nodes (n, columns as `NODE_COLUMNS`) of an edge, coordinates as the scene's returns."""
    n: Nodes = edge.nodes
    return np.column_stack([
        n.x_m, n.y_m, n.top_m, n.step_m, n.sigma_step_m, n.face_m, n.scatter_m, n.sigma_m, n.seen_low, n.seen_high_m,
        edge.seen.astype(np.float64), np.full(len(edge.seen), np.nan) if edge.probability is None else edge.probability,
    ])  # fmt: skip


def cut_at(nodes: Float64, tile: Box) -> list[CutEdge]:
    """Returns parts of a line (n, columns) within a tile; ends on its border are interpolated between nodes.

    A part ends on the border also where a node lies on it: the line may go on in the next tile. A closed line, whose
    last node is its first, is not cut there.
    """
    parts: list[list[Float64]] = []
    cuts: list[list[bool]] = []
    for a, b in itertools.pairwise(nodes):
        inner = _inside(a[:2], b[:2], tile)
        if inner is None:
            continue
        t0, t1 = inner
        if t0 > 0.0 or not parts or cuts[-1][1]:
            parts.append([_between(a, b, t0)])
            cuts.append([t0 > 0.0 or _on_border(a, tile), False])
        parts[-1].append(_between(a, b, t1))
        cuts[-1][1] = t1 < 1.0 or _on_border(b, tile)
    found = [CutEdge(np.array(p), *c) for p, c in zip(parts, cuts, strict=True)]
    if len(found) > 1 and (nodes[0, :2] == nodes[-1, :2]).all() and not (found[0].cut_first or found[-1].cut_last):
        both = np.concatenate([found[-1].nodes, found[0].nodes[1:]])
        found = [CutEdge(both, found[-1].cut_first, found[0].cut_last), *found[1:-1]]
    return found


def _on_border(node: Float64, tile: Box) -> bool:
    return node[0] in {tile.x_min_m, tile.x_max_m} or node[1] in {tile.y_min_m, tile.y_max_m}


def _inside(a: Float64, b: Float64, tile: Box) -> tuple[float, float] | None:
    """Returns beginning and end, as shares, of the part of a segment in a tile (Liang and Barsky 1984)."""
    t0, t1 = 0.0, 1.0
    for axis, low, high in ((0, tile.x_min_m, tile.x_max_m), (1, tile.y_min_m, tile.y_max_m)):
        step = float(b[axis] - a[axis])
        if step == 0.0:
            if not low <= a[axis] < high:
                return None
            continue
        ends = sorted(((low - float(a[axis])) / step, (high - float(a[axis])) / step))
        t0, t1 = max(t0, ends[0]), min(t1, ends[1])
    return (t0, t1) if t0 < t1 else None


def _between(a: Float64, b: Float64, share: float) -> Float64:
    """Returns a node at a share of the way; a value that only one of both has is taken from it."""
    if share in {0.0, 1.0}:
        return a if share == 0.0 else b
    mixed = a + share * (b - a)
    return np.where(np.isnan(a), b, np.where(np.isnan(b), a, mixed))


def pieces_table(
    parts: Sequence[CutEdge], scene: Scene, raster: HeightRaster, schema: pa.Schema = LINE_PIECES
) -> pa.Table:
    """Returns rows of a schema of :func:`line_schema`: parts of lines in the map, with what saw them."""
    seen = seen_by([p.nodes[:, :2] for p in parts], scene, raster)
    in_map = []
    for part in parts:
        nodes = part.nodes.copy()
        nodes[:, :2] += scene.returns.corner_m
        in_map.append(part._replace(nodes=nodes))
    return lines_table(in_map, seen, schema)


def lines_table(parts: Sequence[CutEdge], seen: Sequence[Seen], schema: pa.Schema) -> pa.Table:
    """Returns rows of a schema of :func:`line_schema`: parts of lines, places in the map, with what saw each."""
    columns: dict[str, list[Any]] = {name: [] for name in schema.names}
    for part, one in zip(parts, seen, strict=True):
        for name, column in zip(node_names(schema), part.nodes.T, strict=True):
            columns[name].append(column)
        columns["returns"].append(one.returns)
        columns["passes"].append(list(one.passes))
        columns["first_epoch_gps_ns"].append(one.first_epoch_gps_ns)
        columns["last_epoch_gps_ns"].append(one.last_epoch_gps_ns)
        columns["cut_first"].append(part.cut_first)
        columns["cut_last"].append(part.cut_last)
    return pa.table(columns, schema=schema)


def node_names(schema: pa.Schema) -> tuple[str, ...]:
    """Returns names of the columns that have a value a node."""
    return tuple(f.name for f in schema if f.type == pa.list_(pa.float64()))


def seen_by(lines: Sequence[Float64], scene: Scene, raster: HeightRaster) -> list[Seen]:
    """What saw each of some lines (k, 2): returns of the ground within a quarter of a metre of it, each once."""
    label = np.full(raster.count.shape, -1, np.int32)
    reach = np.arange(-round(NEAR_M / raster.cell_m), round(NEAR_M / raster.cell_m) + 1)
    for number, line in enumerate(lines):
        x, y = dense(line, raster.cell_m / 2)
        row, column = raster.cells_of(
            x[:, None, None] + reach * raster.cell_m, y[:, None, None] + reach[:, None] * raster.cell_m
        )
        free = label[row, column] < 0
        label[row[free], column[free]] = number
    if not lines:
        return []
    at = np.where(raster.used, label.ravel()[raster.cell], -1)
    rows = np.flatnonzero(at >= 0)
    at = at[rows].astype(np.int64)
    return gathered(at, len(lines), scene.returns.pass_id[rows], scene.returns.epoch_gps_ns[rows])


def gathered(owner: Int64, number: int, pass_id: npt.NDArray[np.uint16], epoch_gps_ns: Int64) -> list[Seen]:
    """Returns what saw each of `number` things: returns (n,) with their owner (n,)."""
    count = np.bincount(owner, minlength=number)
    first, last = np.full(number, np.iinfo(np.int64).max), np.full(number, np.iinfo(np.int64).min)
    np.minimum.at(first, owner, epoch_gps_ns)
    np.maximum.at(last, owner, epoch_gps_ns)
    passed = int(pass_id.max(initial=0)) + 1
    pairs = np.bincount(owner * passed + pass_id, minlength=number * passed).reshape(number, passed) > 0
    found = []
    for i in range(number):
        passes = tuple(np.flatnonzero(pairs[i]).tolist())
        found.append(Seen(int(count[i]), passes, int(first[i]), int(last[i])) if count[i] else Seen(0, (), 0, 0))
    return found


def dense(line: Float64, every_m: float) -> tuple[Float64, Float64]:
    """Returns coordinates x and y (k,) of points at even distances along a line (n, 2), with both ends."""
    length = way_along(line)
    at = np.linspace(0.0, length[-1], max(int(np.ceil(length[-1] / every_m)), 1) + 1)
    return np.interp(at, length, line[:, 0]), np.interp(at, length, line[:, 1])


def dense_by_node(line: Float64, every_m: float) -> tuple[Float64, Float64]:
    """Returns the same with all nodes among the points: so they are the same for a part of the line."""
    counts = np.maximum(np.ceil(np.hypot(*np.diff(line, axis=0).T) / every_m).astype(np.int64), 1)
    at = np.concatenate([np.zeros(1), np.cumsum(np.repeat(1.0 / counts, counts))])
    at[np.append(0, np.cumsum(counts))] = np.arange(len(line))
    whole = np.arange(len(line))
    return np.interp(at, whole, line[:, 0]), np.interp(at, whole, line[:, 1])


def joined_lines(pieces: pa.Table) -> list[Line]:
    """Returns lines of the pieces of all tiles: ends on a border meet the nearest end from the other side."""
    names = node_names(pieces.schema)
    lines = [_line(row, names) for row in pieces.to_pylist()]
    cut_first, cut_last = pieces["cut_first"].to_pylist(), pieces["cut_last"].to_pylist()
    after = _partners(lines, [i for i, c in enumerate(cut_last) if c], [i for i, c in enumerate(cut_first) if c])
    begun = set(after.values())
    found: list[Line] = []
    done: set[int] = set()
    for start in [*(i for i in range(len(lines)) if i not in begun), *range(len(lines))]:
        if start in done:
            continue
        line, at = lines[start], start
        done.add(at)
        while at in after and after[at] not in done:
            at = after[at]
            done.add(at)
            line = _end_to_end(line, lines[at])
        found.append(_closed(line) if after.get(at) == start else line)
    return found


def _closed(line: Line) -> Line:
    """Returns a line whose end goes on in its beginning, closed: its first and last node are the westernmost."""
    return line._replace(nodes=closed_nodes(_end_to_end(line, line).nodes[len(line.nodes) - 1 : -1]))


def closed_nodes(nodes: Float64) -> Float64:
    """Returns the nodes (n + 1, columns) of the closed line through nodes (n, columns) from the westernmost on."""
    first = np.lexsort((nodes[:, 1], nodes[:, 0]))[0]
    return np.concatenate([nodes[first:], nodes[: first + 1]])


def _line(row: dict[str, Any], names: tuple[str, ...]) -> Line:
    nodes = np.column_stack([np.array([np.nan if v is None else v for v in row[name]]) for name in names])
    seen = Seen(row["returns"], tuple(row["passes"]), row["first_epoch_gps_ns"], row["last_epoch_gps_ns"])
    return Line(nodes, seen, names)


def _partners(lines: Sequence[Line], lasts: Sequence[int], firsts: Sequence[int]) -> dict[int, int]:
    """Returns for each line that ends on a border the one that continues it, nearest first."""
    if not lasts or not firsts:
        return {}
    ends = np.array([lines[i].nodes[-1, :2] for i in lasts])
    begins = np.array([lines[i].nodes[0, :2] for i in firsts])
    tree = scipy.spatial.cKDTree(begins)
    ranked = sorted(
        (float(np.hypot(*(ends[i] - begins[j]))), lasts[i], firsts[j])
        for i, near in enumerate(tree.query_ball_point(ends, JOIN_M))
        for j in near
        if lasts[i] != firsts[j] and _goes_on(lines[lasts[i]], lines[firsts[j]])
    )
    after: dict[int, int] = {}
    taken: set[int] = set()
    for _, i, j in ranked:
        if i not in after and j not in taken:
            after[i] = j
            taken.add(j)
    return after


def _goes_on(a: Line, b: Line) -> bool:
    """Returns whether a line goes on in another: from the same place, whatever corner is there, or straight on."""
    return _meet(a, b) or bool(_direction(a, -1) @ _direction(b, 0) > 0.7)


def _meet(a: Line, b: Line) -> bool:
    """Returns whether a line ends where the other begins."""
    return float(np.hypot(*(a.nodes[-1, :2] - b.nodes[0, :2]))) <= SAME_M


def _direction(line: Line, end: int) -> Float64:
    part = line.nodes[-4:, :2] if end else line.nodes[:4, :2]
    step = part[-1] - part[0]
    return np.asarray(step / max(float(np.hypot(*step)), 1e-9))


def _end_to_end(a: Line, b: Line) -> Line:
    """Returns both lines as one, with the nodes of the uncut line: ends that the cut put on one segment go.

    Others become one node in the middle.
    """
    ends, seen_by = [], a.seen_by.with_other(b.seen_by)
    if not _cuts_a_segment(a, b):
        both = np.stack([a.nodes[-1], b.nodes[0]])
        known = np.isfinite(both)
        middle = np.where(known, both, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        ends = [np.where(known.any(axis=0), middle, np.nan)[None]]
    return Line(np.concatenate([a.nodes[:-1], *ends, b.nodes[1:]]), seen_by, a.names)


def _cuts_a_segment(a: Line, b: Line) -> bool:
    """Returns whether the end of a line and the beginning of the next lie between neighbouring nodes of one line."""
    first, last = a.nodes[-2, :2], b.nodes[1, :2]
    way = last - first
    length = float(np.hypot(*way))
    if not 0.0 < length <= SEGMENT_M:
        return False
    aside = (np.stack([a.nodes[-1, :2], b.nodes[0, :2]]) - first) @ np.array([way[1], -way[0]]) / length
    return bool(np.abs(aside).max() <= SAME_M) and _meet(a, b)


MEDIAN_NODES: Final = 5
"""A width is the median of this many nodes, so that a pole or a tree does not end a strip."""
HOLE_NODES: Final = 14
"""Longest run of nodes without a width that is bridged within a strip: a car may stand there."""


_ROUND_M: Final = 1.0
"""A line whose ends are so near (m) goes round: a sharp corner may be left out."""


class Strip(NamedTuple):
    """A run of nodes of a line, and the width behind each."""

    line: Line
    width_m: Float64
    known: Bool
    """(n,) nodes whose width was seen."""

    @property
    def length_m(self) -> float:
        """Returns the length along the line."""
        return self.line.length_m

    def column(self, name: str) -> Float64:
        """Returns a column (n,) of its nodes."""
        return self.line.column(name)

    def mean(self, values: Float64) -> float | None:
        """Returns the mean of known values (n,); None where there is none."""
        good = self.known & np.isfinite(values)
        return float(np.median(values[good])) if good.any() else None


def strips_of(
    line: Line, usable: Bool, least_m: float, shortest_m: float, other: Bool | None = None
) -> Iterator[Strip]:
    """Yields runs of the usable nodes (n,) of a line with columns of `BESIDE_PIECES`, at least `shortest_m` long.

    least_m : least width of the surface behind the line (m). other : (n,) nodes behind which something else was seen,
    over which no hole is bridged; None: there are none.
    """
    other = np.zeros(len(usable), np.bool_) if other is None else other
    usable = usable & np.isfinite(line.column("width_m"))
    at = np.flatnonzero(usable)
    if at.size < 2:
        return
    if at[0] > 0 and _is_closed(line):
        # A closed line begins where it is usable, so that no strip ends where it began.
        rows = np.append(np.arange(at[0], len(usable)), np.arange(1, at[0] + 1))
        line, usable, other = Line(line.nodes[rows], line.seen_by, line.names), usable[rows], other[rows]
        at = np.flatnonzero(usable)
    width = line.column("width_m")
    level = scipy.ndimage.median_filter(width[at], MEDIAN_NODES, mode="nearest")
    smooth = np.interp(np.arange(len(width)), at, level)
    known = np.zeros(len(width), np.bool_)
    known[at[level >= least_m]] = True
    number, count = scipy.ndimage.label(bridged(line, known) & ~other)
    for k in range(1, count + 1):
        rows = np.flatnonzero(number == k)
        if len(rows) < 2:
            continue
        part = Line(line.nodes[rows], line.seen_by, line.names)
        if part.length_m >= shortest_m:
            yield Strip(part, smooth[rows], known[rows])


def bridged(line: Line, flags: Bool) -> Bool:
    """Returns flags (n,) of a line's nodes that are true also in holes of 7 m between true ones."""
    return without_holes(flags, HOLE_NODES, _is_closed(line))


def _is_closed(line: Line) -> bool:
    return float(np.hypot(*(line.nodes[-1, :2] - line.nodes[0, :2]))) <= _ROUND_M


def polygon_of(strip: Strip) -> shapely.Polygon | None:
    """Returns the polygon between the line and the end of the surface behind it, with heights; None if empty."""
    nodes = strip.line.nodes
    inner = nodes[:, :3]
    ux, uy = np.gradient(nodes[:, 0]), np.gradient(nodes[:, 1])
    length = np.maximum(np.hypot(ux, uy), 1e-9)
    x = nodes[:, 0] + strip.width_m * uy / length
    y = nodes[:, 1] - strip.width_m * ux / length
    height = strip.column("outer_height_m")
    return ribbon(inner, np.column_stack([x, y, np.where(np.isfinite(height), height, inner[:, 2])]))


_HOLE_M2: Final = 0.5
"""Smaller holes of a ribbon (m²) are left by rounding; a ribbon around a roundabout has a large one."""


def ribbon(inner: Float64, outer: Float64) -> shapely.Polygon | None:
    """Returns the polygon with heights between two lines (n, 3) of facing points; None where it has no area.

    It is the union of the quadrilaterals between neighbouring points, so that it does not fold at an inner corner.
    """
    corners = np.stack([inner[:-1, :2], inner[1:, :2], outer[1:, :2], outer[:-1, :2]], axis=1)
    pieces = shapely.convex_hull(shapely.multipoints(list(corners)))
    # 5 mm more, so that neighbours meet in spite of rounding
    whole = shapely.union_all(shapely.buffer(pieces, 0.005, join_style="mitre"))
    parts = [g for g in getattr(whole, "geoms", [whole]) if g.geom_type == "Polygon" and g.area > 0.0]
    if not parts:
        return None
    largest = max(parts, key=lambda g: g.area)
    holes = [ring for ring in largest.interiors if shapely.Polygon(ring).area >= _HOLE_M2]
    known = np.concatenate([inner, outer])
    tree = scipy.spatial.cKDTree(known[:, :2])
    rings = [shapely.get_coordinates(shapely.simplify(ring, 0.02)) for ring in (largest.exterior, *holes)]
    shell, *inside = (np.column_stack([ring, known[tree.query(ring)[1], 2]]) for ring in rings)
    return shapely.Polygon(shell, inside)


def running_slope(strip: Strip, over_m: float = 2.0) -> float | None:
    """Returns the greatest slope (m/m, up or down) along the middle of a strip over 2 m, of smoothed heights."""
    height = strip.column("middle_height_m")
    length = way_along(strip.line.nodes)
    good = strip.known & np.isfinite(height)
    if good.sum() < 3 or length[-1] < over_m:
        return None
    at = np.arange(0.0, length[-1], over_m / 4)
    level = scipy.ndimage.uniform_filter1d(np.interp(at, length[good], height[good]), 4, mode="nearest")
    slope = (level[4:] - level[:-4]) / over_m if len(level) > 4 else np.zeros(0)
    if not slope.size:
        return None
    return float(np.abs(slope).max())


def sigma_width_m(strip: Strip) -> float:
    """Returns the standard deviation (m) of the strip's outer edge, from differences of neighbouring widths.

    It is 15 cm at least: cells shared with a wall do not belong to the strip.
    """
    width = strip.column("width_m")[strip.known]
    if width.size < 3:
        return 0.3
    return math.hypot(0.15, scatter_about(np.diff(width), 0.0) / math.sqrt(2.0))
