"""Bounds the tiles that the readings of a row group may touch, from poses and reach, without georeferencing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int64, UInt16
from roadscan.compute.kernel_options import read_only
from roadscan.core.grid import QUANTA_PER_M
from roadscan.core.rig import Mounting, Mountings, ScanGeometry
from roadscan.georeference.charts import Charts, georeference_of
from roadscan.georeference.kernels.reach import SpannedProfiles, reach_of_profiles, reach_of_returns
from roadscan.georeference.kernels.readings import Georeference, Limits
from roadscan.georeference.kernels.tile_set import block_ranges
from roadscan.poses.trajectory import NO_CORRECTION, Allowance, Trajectory

PIECE_M: Final = 1.0
"""Profiles are cut into pieces of about this width at their farthest reading."""
LOOSE_SPAN_M: Final = 5.0
"""If ranges within a profile of a rotating beam differ by more, one range span would cover too many tiles."""
BLOCK_READINGS: Final = 6
"""Number of readings of such a profile that share a range span."""


@dataclass(frozen=True)
class Touched:
    """Tiles that row groups may touch: one row for each (group, tile) pair; arrays are (n,)."""

    group: Int64
    """Index of the group among the requested ones."""
    column: Int64
    row: Int64
    readings: Int64
    """Approximate number of the group's readings in the tile."""
    unbounded: npt.NDArray[np.bool_]
    """(g,) True for groups that may touch too many tiles to list; they have no rows."""


@dataclass(frozen=True)
class RangeSpans:
    """Least and greatest raw range of each profile, by block of readings; 0 without any."""

    low: UInt16
    """(n, blocks)."""
    high: UInt16
    block_readings: int
    """Readings of a block; the last may have fewer."""

    @classmethod
    def of_profiles(cls, low: UInt16, high: UInt16, geometry: ScanGeometry) -> RangeSpans:
        """Build from range spans of whole profiles (n,)."""
        return cls(low[:, None], high[:, None], geometry.readings)

    @classmethod
    def unknown(cls, profiles: int, geometry: ScanGeometry) -> RangeSpans:
        """Build spans for profiles that may contain any range."""
        low = np.ones((profiles, 1), np.uint16)
        return cls(low, np.full_like(low, 65535), geometry.readings)

    @classmethod
    def of_ranges(cls, ranges: UInt16) -> RangeSpans:
        """Build from raw ranges (n, m), as closely as :data:`BLOCK_READINGS` allows."""
        low, high = block_ranges(np.ascontiguousarray(ranges), BLOCK_READINGS)
        return cls(low, high, BLOCK_READINGS)

    def whole(self, geometry: ScanGeometry) -> RangeSpans:
        """Return the spans of whole profiles."""
        known = np.where(self.high > 0, self.low, 65_535).min(axis=1)
        high = self.high.max(axis=1)
        return RangeSpans.of_profiles(np.where(high > 0, known, 0).astype(np.uint16), high, geometry)


@dataclass(frozen=True)
class Reach:
    """Bounds on the readings of one sensor in one run."""

    trajectory: Trajectory
    charts: Charts
    mountings: Mountings
    range_min_m: float
    range_max_m: float
    tile_quanta: int
    allowance: Allowance = NO_CORRECTION
    """Later corrections of the poses for all of which the tiles are valid."""

    def is_loose(self, spans: RangeSpans, geometry: ScanGeometry) -> bool:
        """Return True where spans of whole profiles would cover far more tiles than the readings touch."""
        if geometry.kind != "polar" or spans.block_readings < geometry.readings or not spans.high.any():
            return False
        known = spans.high > 0
        far = np.minimum(geometry.range_offset_m + geometry.range_step_m * spans.high[known], self.range_max_m)
        near = np.maximum(geometry.range_offset_m + geometry.range_step_m * spans.low[known], self.range_min_m)
        return bool((far - near).max() > LOOSE_SPAN_M)

    def profiles(self, epochs: Int64, spans: RangeSpans, starts: Int64, geometry: ScanGeometry) -> Touched:
        """Return the tiles of row groups of the table ``scans``.

        Parameters
        ----------
        epochs : (n,) int64, GPS ns, on time.
        starts : (g + 1,) int64, first profile of each group, and the end.
        """
        low, high = spans.low, spans.high
        if (np.diff(epochs) < 0).any():
            group = np.repeat(np.arange(starts.size - 1), np.diff(starts))
            order = np.lexsort((epochs, group))
            epochs, low, high = epochs[order], low[order], high[order]
        low, high = read_only(low), read_only(high)
        scale = (float(geometry.range_offset_m), float(geometry.range_step_m))
        period_ns, pieces = float(geometry.reading_period_ns), self._pieces(spans, geometry)
        profiles = SpannedProfiles(read_only(epochs), low, high, starts, pieces, scale, period_ns)
        parts = [
            reach_of_profiles(
                profiles._replace(starts=np.clip(starts, rows.start, rows.stop)),
                self._georeference(mounting),
                self._moved,
                self._tile_m,
            )
            for rows, mounting in self.mountings.pieces(epochs)
        ]
        return _under_each(parts, starts.size - 1)

    def returns(self, spans_gps_ns: Int64, boxes_m: Float64, readings: Int64) -> Touched:
        """Return the tiles of row groups of the table ``returns``.

        Parameters
        ----------
        spans_gps_ns : (g, 2) int64, first and last epoch, on time, of the poses that place each group.
        boxes_m : (g, 3, 2), least and greatest sensor coordinate along each axis; infinite where not known.
        readings : (g,) int64, returns of each group.
        """
        starts = np.array([0, *self.mountings.since_gps_ns[1:]], dtype=np.int64)
        ends = np.append(starts[1:] - 1, np.iinfo(np.int64).max)
        parts = [
            reach_of_returns(
                np.column_stack([np.maximum(spans_gps_ns[:, 0], since), np.minimum(spans_gps_ns[:, 1], until)]),
                boxes_m, readings, self._georeference(mounting), self._moved, self._tile_m,
            )
            for since, until, mounting in zip(starts, ends, self.mountings.mountings, strict=True)
        ]  # fmt: skip
        return _under_each(parts, readings.size)

    def _georeference(self, mounting: Mounting) -> Georeference:
        limits = Limits(float(self.range_min_m), float(self.range_max_m), -np.inf, np.inf, -np.inf, np.inf)
        return georeference_of(mounting, self.trajectory, self.charts, limits)

    @property
    def _moved(self) -> tuple[float, float]:
        """Return how far readings move: the shift of a pose (m), and its turn per metre from the body's origin."""
        shift = self.allowance.moved_m(0.0)
        return shift, self.allowance.moved_m(1.0) - shift

    @property
    def _tile_m(self) -> float:
        return self.tile_quanta / QUANTA_PER_M

    def _pieces(self, spans: RangeSpans, geometry: ScanGeometry) -> Float64:
        farthest = geometry.range_offset_m + geometry.range_step_m * float(spans.high.max(initial=0))
        width = abs(geometry.step) * (1.0 if geometry.kind == "cartesian" else max(min(farthest, self.range_max_m), 0))
        size = max(min(int(PIECE_M / max(width, 1e-9)), geometry.readings), 1)
        return profile_pieces(geometry, min(size, spans.block_readings), spans.block_readings)


def profile_pieces(geometry: ScanGeometry, size: int, block: int) -> Float64:
    """Return the pieces (p, 9) of a profile, of `size` readings at most, each in one block of `block` readings.

    Columns as ``georeference.kernels.reach.SpannedProfiles`` states them.
    """
    edges = range(0, geometry.readings, block)
    first = np.concatenate([np.arange(a, min(a + block, geometry.readings), size) for a in edges])
    last = np.append(first[1:], geometry.readings) - 1
    middle = geometry.first + geometry.step * 0.5 * (first + last)
    half = np.abs(geometry.step) * 0.5 * (last - first)
    zero, one = np.zeros(first.size), np.ones(first.size)
    if geometry.kind == "cartesian":
        shape = (zero, one, middle, half, zero, one)
    else:
        shape = (np.sin(middle), np.cos(middle), zero, zero, np.sin(half), np.cos(half))
    return np.column_stack([first, last, *shape, first // block])


def joined(parts: Sequence[Touched]) -> Touched:
    """Join the tiles of different groups; a group that is unbounded in one part is listed by another."""
    if not parts:
        none = np.zeros(0, np.int64)
        return Touched(none, none, none, none, np.zeros(0, dtype=bool))
    group, column, row, readings = (
        np.concatenate([getattr(p, name) for p in parts]) for name in ("group", "column", "row", "readings")
    )
    return Touched(group, column, row, readings, np.zeros(0, dtype=bool))


def _under_each(parts: list[tuple[Any, ...]], groups: int) -> Touched:
    """Merge the tiles under several mountings, each pair once."""
    unbounded = np.zeros(groups, dtype=bool)
    for part in parts:
        unbounded |= part[2]
    tiles = np.concatenate([np.zeros((0, 3), np.int64), *(p[0] for p in parts)])
    readings = np.concatenate([np.zeros(0, np.int64), *(p[1] for p in parts)])
    if len(parts) > 1:
        tiles, where = np.unique(tiles, axis=0, return_inverse=True)
        readings = np.bincount(where.ravel(), readings, len(tiles)).astype(np.int64)
    keep = ~unbounded[tiles[:, 0]]
    group, column, row = tiles[keep].T
    return Touched(group, column, row, readings[keep], unbounded)
