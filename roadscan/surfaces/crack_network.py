"""Pieces of cracks joined to cracks: whatever hangs together, over all tiles, with its figures and its type."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from roadscan.model.distress import CrackJoining
from roadscan.surfaces.cracks import CrackPiece

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]
CrackType = Literal["longitudinal", "transverse", "diagonal", "alligator", "unknown"]

_CHORD_M = 0.1
"""Directions are those of chords about this long."""
_LEAST_SHARE = 0.6
"""What has the cross-section of a crack over less of its length is an edge or a row of pits."""
_ONE_NODE_CELLS = 4.0
"""Junctions closer than this are one: thinning makes two of a crossing."""


@dataclass(frozen=True)
class Crack:
    """A crack with all its branches."""

    kind: CrackType
    length_m: float
    """Along all branches (m)."""
    width_mean_m: float
    """At half the depth, mean over the length (m); NaN where it is nowhere known."""
    width_max_m: float
    depth_mean_m: float
    depth_max_m: float
    area_m2: float
    """Length times width (m²)."""
    covered_m2: float
    """Convex hull of its line (m²)."""
    junctions: int
    ends: int
    measured_share: float
    """Share of the length that has the cross-section of a crack."""
    polygons: int
    """Pieces of ground that it closes in."""
    azimuth_deg: float
    """Mean direction, clockwise from map north, 0 to 180 (degrees)."""
    lane_angle_deg: float
    """Between that and the lane, 0 to 90 (degrees)."""
    longitudinal_m: float
    """Length within `lane_angle_deg` of the lane's direction (m)."""
    transverse_m: float
    diagonal_m: float
    line: Any
    """shapely MultiLineString on the map (m)."""
    pieces: Int64
    """Which pieces it is made of."""


def join_cracks(
    pieces: Sequence[CrackPiece], lane_azimuth_rad: npt.ArrayLike, cell_m: float, config: CrackJoining
) -> list[Crack]:
    """Cracks of all pieces that are long and deep enough, from south to north.

    Parameters
    ----------
    pieces : of all tiles; their order does not matter but for the last bit of sums.
    lane_azimuth_rad : direction of the lane, clockwise from map north: one for all pieces or one for each (n,); NaN
        where it is not known.
    """
    if not pieces:
        return []
    azimuth = np.broadcast_to(np.asarray(lane_azimuth_rad, np.float64), (len(pieces),))
    names = sorted({node for one in pieces for node in (one.start, one.end)})
    number = {name: k for k, name in enumerate(names)}
    ends = np.array([[number[one.start], number[one.end]] for one in pieces])
    _, network = _networks(ends, len(names))
    order = np.argsort(network[ends[:, 0]], kind="stable")
    cuts = np.flatnonzero(np.diff(network[ends[order, 0]])) + 1
    found = [_crack(own, pieces, ends, azimuth, cell_m, config) for own in np.split(order, cuts)]
    return sorted((c for c in found if _is_crack(c, config)), key=lambda c: c.line.bounds[1::-1])


def _is_crack(one: Crack, config: CrackJoining) -> bool:
    long, deep = one.length_m >= config.min_length_m, one.depth_mean_m >= config.min_depth_m
    return long and deep and one.measured_share >= _LEAST_SHARE


def _networks(ends: Int64, nodes: int) -> tuple[int, Int64]:
    """Connected components of nodes."""
    joined = coo_array((np.ones(len(ends), np.int8), (ends[:, 0], ends[:, 1])), shape=(nodes, nodes))
    count, of_node = connected_components(joined, directed=False)
    return int(count), np.asarray(of_node, dtype=np.int64)


def _crack(
    own: Int64,
    pieces: Sequence[CrackPiece],
    ends: Int64,
    azimuth: Float64,
    cell_m: float,
    config: CrackJoining,
) -> Crack:
    mine = [pieces[k] for k in own.tolist()]
    length, measured = sum(p.length_m for p in mine), sum(p.measured_m for p in mine)
    width_sum, depth_sum = sum(p.width_sum_m2 for p in mine), sum(p.depth_sum_m2 for p in mine)
    line = shapely.line_merge(shapely.multilinestrings([shapely.LineString(p.line_m) for p in mine]))
    line = line if line.geom_type == "MultiLineString" else shapely.multilinestrings([line])
    covered = float(shapely.convex_hull(line).area)
    junctions, ends_free, polygons = _shape(ends[own], np.array([p.length_m for p in mine]), cell_m)
    direction, lane_angle, parts = _directions(mine, azimuth[own], config)
    return Crack(
        _kind(junctions, polygons, covered, parts, config),
        length,
        width_sum / measured if measured > 0 else math.nan,
        max(p.width_max_m for p in mine),
        depth_sum / measured if measured > 0 else math.nan,
        max(p.depth_max_m for p in mine),
        width_sum * (length / measured) if measured > 0 else math.nan,
        covered,
        junctions,
        ends_free,
        measured / length,
        polygons,
        direction,
        lane_angle,
        *parts,
        line,
        own,
    )


def _kind(
    junctions: int, polygons: int, covered_m2: float, parts: tuple[float, float, float], config: CrackJoining
) -> CrackType:
    if polygons >= config.alligator_polygons and junctions >= config.alligator_nodes_per_m2 * covered_m2:
        return "alligator"
    kinds: tuple[CrackType, ...] = ("longitudinal", "transverse", "diagonal")
    return kinds[int(np.argmax(parts))] if sum(parts) > 0.0 else "unknown"


def _shape(ends: Int64, length_m: Float64, cell_m: float) -> tuple[int, int, int]:
    """Junctions, free ends, polygons of a network."""
    nodes, local = np.unique(ends, return_inverse=True)
    local = local.reshape(ends.shape)
    polygons = len(ends) - nodes.size + 1
    degree = np.bincount(local.ravel(), minlength=nodes.size)
    short = (length_m < _ONE_NODE_CELLS * cell_m) & (degree[local] >= 3).all(axis=1)
    _, merged = _networks(local[short], nodes.size) if short.any() else (0, np.arange(nodes.size))
    kept = merged[local[~short]]
    counted = Counter(kept.ravel().tolist())
    return sum(n >= 3 for n in counted.values()), sum(n == 1 for n in counted.values()), polygons


def _directions(
    pieces: Sequence[CrackPiece], azimuth: Float64, config: CrackJoining
) -> tuple[float, float, tuple[float, float, float]]:
    """Azimuth and angle to the lane (degrees) of the whole, and lengths along, across and aslant (m)."""
    turning, to_lane, parts = 0j, 0j, np.zeros(3)
    limit = math.radians(config.lane_angle_deg)
    for one, lane in zip(pieces, azimuth.tolist(), strict=True):
        count = max(1, round(one.length_m / _CHORD_M))
        picked = one.line_m[np.unique(np.linspace(0, len(one.line_m) - 1, count + 1).round().astype(np.int64))]
        chord = np.diff(picked, axis=0)
        size = np.hypot(*chord.T)
        angle = np.arctan2(chord[:, 0], chord[:, 1])
        turning += complex((size * np.exp(2j * angle)).sum())
        to_lane += complex((size * np.exp(2j * (angle - lane))).sum())
        off = np.abs((angle - lane + np.pi / 2) % np.pi - np.pi / 2)
        along, across = off <= limit, off >= np.pi / 2 - limit
        share = size * (one.length_m / max(size.sum(), 1e-12))
        if not math.isnan(lane):
            parts += [share[along].sum(), share[across].sum(), share[~along & ~across].sum()]
    azimuth_deg = math.degrees(np.angle(turning) / 2) % 180.0
    return azimuth_deg, abs(math.degrees(np.angle(to_lane) / 2)), (float(parts[0]), float(parts[1]), float(parts[2]))
