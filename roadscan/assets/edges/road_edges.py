"""Edges of the carriageway on both sides of a drive.

A square tells what lies across the stations in it, and which kerbs. What depends on the way along a drive, the place of
its edges, follows from the stations of all squares together: so it does not depend on how squares are cut.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import scipy.ndimage
import scipy.spatial
import shapely

from roadscan.assets.edges.beside import beside_of
from roadscan.assets.edges.find import free_edges
from roadscan.assets.edges.line_pieces import (
    NODE_COLUMNS,
    SAME_M,
    CutEdge,
    Seen,
    closed_nodes,
    columns_of,
    cut_at,
    dense,
    gathered,
    line_schema,
    lines_table,
)
from roadscan.assets.edges.once import FEWEST, FoundEdge, each_once
from roadscan.assets.edges.profiles import smooth_line
from roadscan.assets.edges.steps import CELL_M, raster_of
from roadscan.assets.edges.tracks import STATION_M, Parted, Track, bridged, tracks_of, unbroken
from roadscan.assets.scene import Scene, once_a_scene
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.arrays import way_along
from roadscan.compute.edges import EdgePath, counted, evidence_across, moved_cells, path_along

NEAREST_M: Final = 0.8  # Edges are sought from this distance to the drive (m) …
FARTHEST_M: Final = 14.0
"""… to this distance (m)."""
_WITHIN_M: Final = 7.0
"""Edges this far along the drive (m) tell where one lies."""
_ROUND_M: Final = 3.0
"""A line whose end lies this near (m) to its beginning is closed: the outer edge of a roundabout ends that near."""
_KERB: Final = 6.0  # Evidence of a cell at a kerb.
_BARRIER: Final = 3.0  # Evidence of a cell where something stands.
_LEAST: Final = 0.6  # Least evidence of an edge at a station.
_HOLE_M: Final = 10.0  # A longer hole of an edge (m) is none of it: evidence of a station is its mean over that.
_AT_KERB_M: Final = 0.4  # An edge so near to its kerb (m) lies on it.
_INSIDE_M: Final = (0.45, 0.95)
"""The height of an edge follows from the road this far inside it (m, from and to)."""
_BEHIND: Final = 3  # Cells where something stands; what is behind more of them belongs to no road.
_SIGMA_M: Final = 0.008  # 1 σ of the height of a cell (m).
_NEAR: Final = np.arange(-2, 3)
"""Cells about an edge's place that tell what it is, and whose returns saw it."""
_BETWEEN: Final = 81
"""Places between two drives, 0.1 m apart at the most, at which it is asked whether something stands there."""
_BLOCK: Final = 20_000
"""Stations (10 km) whose edge is sought at once …"""
_AROUND: Final = 60
"""… with so many more (30 m) to both sides: the way of 7 m and the mean over 10 m end before."""
_STEPS: Final = 40.0  # Evidence is stored in these parts of a σ: it is 6 σ at the most.
EDGE_COLUMNS: Final = (*NODE_COLUMNS, "by_surface", "by_kerb", "by_barrier", "right", "evidence")
EDGE_LINES: Final = line_schema(EDGE_COLUMNS)
"""Columns of a piece of a road edge."""
_OFFSETS: Final = np.arange(NEAREST_M, FARTHEST_M, CELL_M)
_LISTS: Final = {
    "place": (pa.float64(), (6,)), "level_m": (pa.float64(), ()), "pass_id": (pa.int32(), ()),
    "evidence": (pa.uint8(), (2, _OFFSETS.size)), "stands": (pa.uint8(), (2, _OFFSETS.size)),
    "level_mm": (pa.int16(), (2, _OFFSETS.size)), "returns": (pa.uint8(), (2, _OFFSETS.size)),
    "driven": (pa.uint8(), (2,)),
    "passes": (pa.list_(pa.int32()), ()), "first_epoch_gps_ns": (pa.int64(), ()), "last_epoch_gps_ns": (pa.int64(), ()),
    "kerbs": (pa.float64(), (4,)),
}  # fmt: skip
STATION_PIECES: Final = pa.schema(
    [pa.field(name, pa.list_(kind), nullable=False) for name, (kind, _) in _LISTS.items()]
)
"""Columns of what a square tells, one row. Of each of its stations: easting and northing, unit vector of the heading,
and easting and northing of the next one; the height of the road and the pass; across the drive to its left and to its
right the evidence of an edge without that of kerbs, whether something stands there, the height that an edge has there
above that of the road (mm), and returns of the ground; how many cells it is to the farthest other drive there, 0 where
there is none; passes and epochs of those returns. Kerbs: segments, the higher side to
their right, from easting and northing to easting and northing."""


class _Stations(NamedTuple):
    """What the stations (n,) of a scene, or of all squares, tell; columns as those of `STATION_PIECES`."""

    place: Float64
    level_m: Float64
    pass_id: npt.NDArray[np.int32]
    evidence: npt.NDArray[np.uint8]
    stands: npt.NDArray[np.uint8]
    level_mm: npt.NDArray[np.int16]
    returns: npt.NDArray[np.uint8]
    driven: npt.NDArray[np.uint8]
    passes: list[list[int]]
    first_epoch_gps_ns: Int64
    last_epoch_gps_ns: Int64


def station_pieces(scene: Scene) -> pa.Table:
    """Returns rows of `STATION_PIECES`: what a square's returns tell of road edges."""
    found = _stations_of(scene)
    if found is None:
        return STATION_PIECES.empty_table()
    # Stations lie on the border of squares, where each must find the same one of them in one square.
    chosen = np.flatnonzero(scene.tile.holds(*found.place[:, :2].round(6).T) & found.returns.any(axis=(1, 2)))
    kerbs = [part.nodes[:, :2] for edge in free_edges(scene) for part in cut_at(columns_of(edge), scene.tile)]
    if not chosen.size and not kerbs:
        return STATION_PIECES.empty_table()
    corner = np.array(scene.returns.corner_m)
    columns: dict[str, Any] = {
        name: [values[k] for k in chosen.tolist()] if isinstance(values, list) else values[chosen].ravel()
        for name, values in found._asdict().items()
    }
    columns["place"] = (found.place[chosen] + [*corner, 0.0, 0.0, *corner]).ravel()
    segments = [np.hstack([line[:-1] + corner, line[1:] + corner]) for line in kerbs]
    columns["kerbs"] = np.concatenate([np.zeros((0, 4)), *segments]).ravel()
    return pa.table({name: [columns[name]] for name in STATION_PIECES.names}, STATION_PIECES)


@once_a_scene
def _stations_of(scene: Scene) -> _Stations | None:
    """Returns the same of all stations of a scene, places as its returns; None where there is none."""
    tracks = _tracks_in(scene)
    if not tracks:
        return None
    place = np.concatenate(
        [np.hstack([t.places, t.heading, np.vstack([t.places[1:], [[np.nan] * 2]])]) for t in tracks]
    )
    sides = [np.concatenate(one) for one in zip(*(_across(track, scene) for track in tracks), strict=True)]
    evidence, stands, level, returns, driven = sides
    level[~np.isfinite(level).any(axis=(1, 2))] = 0.0  # such a station has no returns
    road = np.nanmedian(level, axis=(1, 2))
    seen = _seen_across(place, scene)
    above = np.clip(np.nan_to_num(1e3 * (level - road[:, None, None])), -32_000, 32_000)
    return _Stations(
        place, road, np.repeat([t.pass_id for t in tracks], [len(t.places) for t in tracks]).astype(np.int32),
        np.rint(_STEPS * evidence).astype(np.uint8), stands.astype(np.uint8), np.rint(above).astype(np.int16),
        np.minimum(returns, 255).astype(np.uint8), driven.astype(np.uint8), [list(one.passes) for one in seen],
        np.array([one.first_epoch_gps_ns for one in seen]), np.array([one.last_epoch_gps_ns for one in seen]),
    )  # fmt: skip


@once_a_scene
def _tracks_in(scene: Scene) -> list[Track]:
    """Returns the stations of a scene that road edges are sought from; none where it has no ground."""
    return list(tracks_of(scene.drive_xyh_m, _parted_in(scene))) if (raster_of(scene).count > 0).any() else []


def _parted_in(scene: Scene) -> Parted:
    """Returns what tells whether a kerb, or something that stands, lies between two places of drives of a scene."""
    raster, blocked = raster_of(scene), beside_of(scene).blocked
    kerbs = shapely.STRtree([shapely.LineString(columns_of(edge)[:, :2]) for edge in free_edges(scene)])

    def parted(places: Float64, others: Float64) -> Bool:
        ways = shapely.linestrings(np.stack([places, others], axis=1))
        found = np.zeros(len(places), np.bool_)
        found[kerbs.query(ways, predicate="intersects")[0]] = True
        share = np.linspace(0.0, 1.0, _BETWEEN)[:, None]
        x, y = (places[:, k] + share * (others - places)[:, k] for k in (0, 1))
        return np.asarray(found | blocked[raster.cells_of(x, y)].any(axis=0))

    return parted


@once_a_scene
def _driven_in(scene: Scene) -> Bool:
    """Returns a mask of the cells of a scene's raster that a drive led through, and of those around them."""
    raster, drive = raster_of(scene), scene.drive_xyh_m
    driven = np.zeros(raster.count.shape, np.bool_)
    for number in np.unique(drive[:, 3]):
        for part in unbroken(drive[drive[:, 3] == number, :2]):
            x, y = dense(part, raster.cell_m)
            inside = scene.extent.holds(x, y)
            driven[raster.cells_of(x[inside], y[inside])] = True
    return np.asarray(scipy.ndimage.binary_dilation(driven, np.ones((3, 3))))


def _across(track: Track, scene: Scene) -> tuple[Float64, Bool, Float64, Int64, Int64]:
    """Returns evidence without kerbs, whether something stands, the height of an edge, and returns (n, 2, offsets).

    The last is how many cells it is to the farthest other drive (n, 2).
    """
    raster, beside = raster_of(scene), beside_of(scene)
    sides = []
    for sign in (-1.0, 1.0):
        out = sign * _right_of(track.heading)

        def at(offset: Float64, along: float = 0.0, out: Float64 = out) -> tuple[Int64, Int64, Bool]:
            x, y = (
                track.places[:, k, None] + offset * out[:, k, None] + along * track.heading[:, k, None] for k in (0, 1)
            )
            row, column = raster.cells_of(x, y)
            inside = (x >= raster.x_min_m) & (x < raster.x_min_m + raster.count.shape[1] * raster.cell_m)
            inside &= (y >= raster.y_min_m) & (y < raster.y_min_m + raster.count.shape[0] * raster.cell_m)
            return row, column, inside

        def height(offset: Float64) -> Float64:
            row, column, inside = at(offset)
            return np.where(inside, beside.height_m[row, column], np.nan)

        row, column, inside = at(_OFFSETS)
        here, stands = height(_OFFSETS), beside.blocked[row, column] & inside
        behind = np.cumsum(stands, axis=1) > _BEHIND
        step, bend = evidence_across(
            np.where(behind, np.nan, here), np.full(here.shape, _SIGMA_M), (STATION_M, raster.cell_m)
        )
        evidence = counted(np.fmax(np.abs(step), np.abs(bend)))
        evidence = np.maximum(evidence, np.where(stands & ~behind, _BARRIER, 0.0))
        near, far = (height(_OFFSETS - away) for away in _INSIDE_M)
        level = near + (near - far) * _INSIDE_M[0] / (_INSIDE_M[1] - _INSIDE_M[0])
        ground = scene.ground.height_at(*(track.places[:, k, None] + _OFFSETS * out[:, k, None] for k in (0, 1)))
        for other in (near, here, ground):
            level = np.where(np.isfinite(level), level, other)
        counts = [np.where(i, raster.count[r, c], 0) for r, c, i in (at(_OFFSETS, raster.cell_m * k) for k in _NEAR)]
        driven = (np.arange(1, _OFFSETS.size + 1) * (_driven_in(scene)[row, column] & inside)).max(axis=1)
        sides.append((evidence, stands, level, np.sum(counts, axis=0), driven))
    return tuple(np.stack(both, axis=1) for both in zip(*sides, strict=True))  # type: ignore[return-value]


def places_across(scene: Scene) -> Float64:
    """Returns places (n, 2) each metre across the stations of a scene: a road edge lies near some of them."""
    offset = np.arange(-FARTHEST_M, FARTHEST_M + 0.5, 1.0)[:, None]
    some = [t.places[:, None] + offset * _right_of(t.heading)[:, None] for t in _tracks_in(scene)]
    return np.concatenate([np.zeros((0, 2)), *(one.reshape(-1, 2) for one in some)])


def _right_of(heading: Float64) -> Float64:
    return np.column_stack([heading[:, 1], -heading[:, 0]])


def _seen_across(place: Float64, scene: Scene) -> list[Seen]:
    """Returns the returns of the ground across each station (n, columns of `place`), with their passes and epochs."""
    raster, returns = raster_of(scene), scene.returns
    label = np.full(raster.count.shape, -1, np.int32)
    offset = np.concatenate([-_OFFSETS[::-1], _OFFSETS])
    out = _right_of(place[:, 2:4])
    for k in _NEAR:
        x, y = (
            place[:, i, None] + offset * out[:, i, None] + k * raster.cell_m * place[:, 2 + i, None] for i in (0, 1)
        )
        row, column = raster.cells_of(x, y)
        label[row, column] = np.arange(len(place))[:, None]
    owner = np.where(raster.used & (raster.cell >= 0), label.ravel()[raster.cell], -1)
    rows = np.flatnonzero(owner >= 0)
    return gathered(owner[rows].astype(np.int64), len(place), returns.pass_id[rows], returns.epoch_gps_ns[rows])


def edge_lines(pieces: pa.Table) -> pa.Table:
    """Returns rows of `EDGE_LINES`: the road edges of the stations and kerbs of all squares, along the drives."""
    rows: list[tuple[Float64, Seen]] = []
    if pieces.num_rows:
        columns = {name: _stacked(pieces, name) for name in _LISTS}
        kerbs = columns.pop("kerbs")
        stations = _Stations(**columns)
        segments = shapely.STRtree(shapely.linestrings(kerbs.reshape(-1, 2, 2)))
        found = []
        for chain in _chains(stations):
            some = _Stations._make(
                [column[k] for k in chain.tolist()] if isinstance(column, list) else column[chain]
                for column in stations
            )
            for right in (False, True):
                found += [e._replace(rows=chain[e.rows]) for e in _one_side(some, right, kerbs, segments)]
        rows = [_with_seen(edge, stations) for edge in each_once(found)]
    return lines_table([CutEdge(nodes, False, False) for nodes, _ in rows], [seen for _, seen in rows], EDGE_LINES)


def _with_seen(edge: FoundEdge, stations: _Stations) -> tuple[Float64, Seen]:
    """Returns the nodes of an edge, closed where it leads round, and what saw it."""
    lap = _lap(edge.nodes[:, :2])
    nodes = closed_nodes(edge.nodes[:lap]) if lap else edge.nodes
    passes = sorted({one for k in edge.rows.tolist() for one in stations.passes[k]})
    return nodes, Seen(
        int(edge.returns.sum()), tuple(passes), int(stations.first_epoch_gps_ns[edge.rows].min()),
        int(stations.last_epoch_gps_ns[edge.rows].max()),
    )  # fmt: skip


def _stacked(pieces: pa.Table, name: str) -> Any:
    """Returns the values (n, …) of a column for the stations, or kerbs, of all squares."""
    kind, shape = _LISTS[name]
    values = pieces[name].combine_chunks().flatten()
    return values.to_pylist() if pa.types.is_list(kind) else values.to_numpy(zero_copy_only=False).reshape(-1, *shape)


def _chains(stations: _Stations) -> Iterator[Int64]:
    """Yields the rows of stations that follow one another, whatever squares hold them."""
    # Stations of other passes lie a kilometre away each.
    aside = 1e3 * stations.pass_id[:, None]
    tree = scipy.spatial.cKDTree(np.hstack([stations.place[:, :2], aside]))
    goes_on = np.flatnonzero(np.isfinite(stations.place[:, 4]))
    away, at = tree.query(np.hstack([stations.place[:, 4:], aside])[goes_on], distance_upper_bound=SAME_M)
    after = np.full(len(stations.place), -1)
    after[goes_on[np.isfinite(away)]] = at[np.isfinite(away)]
    first = np.ones(after.size, np.bool_)
    first[after[after >= 0]] = False
    follows, done = after.tolist(), np.zeros(after.size, np.bool_)
    for start in np.flatnonzero(first).tolist():
        chain, k = [], start
        while k >= 0 and not done[k]:
            done[k] = True
            chain.append(k)
            k = follows[k]
        yield np.array(chain, np.int64)


def _one_side(some: _Stations, right: bool, kerbs: Float64, segments: shapely.STRtree) -> Iterator[FoundEdge]:
    """Yields one side's edges along a chain of stations, with the columns `EDGE_COLUMNS`."""
    out = _right_of(some.place[:, 2:4]) * (1.0 if right else -1.0)
    side = int(right)
    up = _kerbs_across(some.place[:, :2], out, kerbs, segments)
    hidden = _behind_parting((up | (some.stands[:, side] > 0)), some.driven[:, side])
    evidence = np.where(hidden, 0, some.evidence[:, side]).astype(np.uint8)
    up &= ~hidden
    found = _path(up, evidence)
    near = np.clip(found.cell[:, None] + _NEAR, 0, _OFFSETS.size - 1)
    by_kerb, by_barrier = (
        scipy.ndimage.median_filter(np.take_along_axis(shown, near, axis=1).any(axis=1).astype(np.float64), 5)
        for shown in (up, some.stands[:, side] > 0)
    )
    lines = some.place[:, :2] + _OFFSETS[found.cell, None] * out
    returns = np.take_along_axis(some.returns[:, side], near, axis=1).sum(axis=1)
    shown = np.where(up, _KERB, evidence)[np.arange(len(up)), found.cell] > 0.0
    good = (found.evidence.round(6) >= _LEAST) & _with_holes(shown, lines)
    for rows in _runs(good, found.cell, moved_cells(CELL_M)):
        line = _snapped(smooth_line(lines[rows], np.ones(len(rows))), by_kerb[rows] > 0.5, segments)
        offset = ((line - some.place[rows, :2]) * out[rows]).sum(axis=1)
        cell = np.clip(np.rint((offset - NEAREST_M) / CELL_M).astype(np.int64), 0, _OFFSETS.size - 1)
        nodes = np.zeros((len(rows), len(EDGE_COLUMNS)))
        nodes[:, 3:5] = np.nan
        nodes[:, :2] = line
        nodes[:, 2] = some.level_m[rows] + 1e-3 * some.level_mm[rows, side, cell]
        nodes[:, EDGE_COLUMNS.index("sigma_m")] = np.where(by_kerb[rows] > 0.5, 0.02, 0.15)
        nodes[:, EDGE_COLUMNS.index("seen")] = 1.0
        nodes[:, -4:] = np.column_stack(
            [by_kerb[rows], by_barrier[rows], np.full(len(rows), float(right)), found.evidence[rows]]
        )
        yield FoundEdge(nodes, rows, returns[rows], out[rows], offset)


def _behind_parting(shows: Bool, driven: npt.NDArray[np.uint8]) -> Bool:
    """Returns a mask (n, offsets) of what lies behind a kerb, or something that stands, that parts two drives.

    shows : (n, offsets) where such a thing is; driven : (n,) cells to another drive. Nothing behind is an edge of a
    station's road. It parts them over five stations or more; between its posts as well.
    """
    parts = shows & (np.arange(shows.shape[1]) < driven[:, None])
    seen = np.flatnonzero(parts.any(axis=1))
    if not seen.size:
        return parts
    cell = np.interp(np.arange(len(parts)), seen, parts[seen].argmax(axis=1))
    whole = scipy.ndimage.binary_opening(bridged(np.isin(np.arange(len(parts)), seen)), np.ones(FEWEST))
    return np.asarray(whole[:, None] & (np.arange(parts.shape[1]) > cell[:, None] + _BEHIND))


def _path(up: Bool, evidence: npt.NDArray[np.uint8]) -> EdgePath:
    """Returns the edge along stations (n,), block after block, so that a long drive needs little memory.

    up : (n, offsets) cells at a kerb; evidence : (n, offsets) of the others, in parts of a σ.
    """
    found = []
    for first in range(0, len(up), _BLOCK):
        begin = max(first - _AROUND, 0)
        rows, kept = slice(begin, first + _BLOCK + _AROUND), slice(first - begin, first - begin + _BLOCK)
        part = np.where(up[rows], _KERB, evidence[rows] / _STEPS)
        path = path_along(part, (STATION_M, CELL_M), within_m=_WITHIN_M)
        found.append((path.cell[kept], path.evidence[kept]))
    return EdgePath(*map(np.concatenate, zip(*found, strict=True)))


def _lap(line: Float64) -> int:
    """Returns how many nodes of a line (n, 2) lead round to its beginning; 0 where it does not lead there."""
    from_first, first, last = line - line[0], line[FEWEST - 1] - line[0], line[-1] - line[-FEWEST]
    near = np.hypot(*from_first.T) <= _ROUND_M
    if not near[-1] or first @ last <= 0.0:
        return 0
    before = np.flatnonzero(~near | (from_first @ first < 0.0))
    return int(before[-1]) + 1 if before.size else 0


def _kerbs_across(places: Float64, out: Float64, kerbs: Float64, segments: shapely.STRtree) -> Bool:
    """Returns a mask (n, offsets) of the cells where a kerb that rises outward crosses the way across a station."""
    up = np.zeros((len(places), _OFFSETS.size + 1), np.bool_)
    ways = shapely.linestrings(np.stack([places + NEAREST_M * out, places + FARTHEST_M * out], axis=1))
    at, kerb = segments.query(ways, predicate="intersects")
    way = kerbs[kerb, 2:] - kerbs[kerb, :2]
    way /= np.maximum(np.hypot(*way.T), 1e-9)[:, None]
    # Sine of the angle from the way across to the kerb, which is also how far it rises outward.
    rises = out[at, 1] * -way[:, 0] + out[at, 0] * way[:, 1]
    outward = rises > 0.5
    at, way, begin = at[outward], way[outward], kerbs[kerb[outward], :2] - places[at[outward]]
    offset = (begin[:, 0] * way[:, 1] - begin[:, 1] * way[:, 0]) / rises[outward]
    cell = np.clip(np.floor((offset - NEAREST_M) / CELL_M).astype(np.int64), 0, _OFFSETS.size - 1)
    up[at, cell] = up[at, cell + 1] = True
    return up[:, :-1]


def _with_holes(shown: Bool, lines: Float64) -> Bool:
    """Returns a mask (n,) of the stations that show an edge, and of holes between them: an edge does not end in one.

    lines : (n, 2) its places. So an edge does not go on over bare asphalt where a drive turns, however short its way.
    """
    beside = scipy.ndimage.convolve1d(shown.astype(np.float64), np.ones(FEWEST), mode="constant")
    at = np.flatnonzero(shown & (beside > 1.5))  # a lone one is chance
    after = np.searchsorted(at, np.arange(len(shown)))
    ends = way_along(lines)[at]
    narrow = np.concatenate([[False], np.diff(ends) <= _HOLE_M, [False]])
    return np.asarray(np.isin(np.arange(len(shown)), at) | narrow[after])


def _runs(good: Bool, cell: Int64, moved: int) -> Iterator[Int64]:
    """Yields the rows of five stations or more in a run; where another edge is nearer to the best, a run ends."""
    begins = np.append(True, np.abs(np.diff(cell)) > moved) | ~good
    for rows in np.split(np.arange(good.size), np.flatnonzero(begins)[1:]):
        kept = rows[good[rows]]
        if len(kept) >= FEWEST:
            yield kept


def _snapped(line: Float64, at_kerb: Bool, kerbs: shapely.STRtree) -> Float64:
    """Returns points (n, 2) of a line, those at a kerb moved onto it."""
    moved, rows = line.copy(), np.flatnonzero(at_kerb)
    near, at = kerbs.query_nearest(shapely.points(line[rows]), max_distance=_AT_KERB_M, all_matches=False)
    ways = shapely.shortest_line(shapely.points(line[rows[near]]), kerbs.geometries[at])
    moved[rows[near]] = shapely.get_coordinates(ways).reshape(-1, 2, 2)[:, 1]
    return moved
