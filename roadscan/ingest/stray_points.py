"""Checks for points of a cloud far from all others, for points that occur twice, and for returns beyond any range."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from roadscan.compute.array_types import Bool, Int64
from roadscan.core.witness import Witness
from roadscan.ingest.log_check import LogCheck
from roadscan.ingest.reading.format import LogHeader, Rows
from roadscan.store.readings.packed_returns import PACKED, farthest_m
from roadscan.store.readings.returns import distances_m
from roadscan.store.writer import LogWriter

STRAY_POINT: Final = Witness(
    "stray_point",
    input="cloud",
    fault="Single points lie where the road is not: a wrong range, a bird, a coordinate that was written wrongly.",
    asks="the other points of the cloud, in cells of 50 m × 50 m and 100 m of height",
    does="up to three points are left out where the cell and its 26 neighbours hold no others; more are used",
    told=("rejects",),
)
POINTS_TWICE: Final = Witness(
    "points_twice",
    input="cloud",
    fault="Points stand twice in a cloud: strips or tiles that overlap were merged.",
    asks="time, place, return number and intensity of each point",
    does="a point counts once, at epochs of which every point stands twice: a coarse scale puts others in one place",
    told=("rejects",),
)

_CELL_M: Final = np.array([50.0, 50.0, 100.0])  # edges of a cell: two horizontal, one vertical (m)
_FEW: Final = 3
"""Most points of a cell without others in it or its neighbours that are strays; more are a real object."""
_LEAST_IN_CELL: Final = 100
"""A cloud with half of its points in cells of fewer is too thin to find strays: a scanner leaves more on a square metre
of road, and an airborne survey about as many in a cell."""
_MOST_STRAYS: Final = 0.01
"""If a larger share of a cloud is isolated, it is thin and has no strays."""
_BITS: Final = 21  # bits of a cell's index along each axis: three fit into 64
_HALF: Final = 1 << (_BITS - 1)  # added to indices to make them positive
STRAY: Final = "the point lies alone, over 50 m or over 100 m of height from all others of the cloud"
TWICE: Final = "the point stands twice in the cloud"
_TABLE: Final = "cloud"
_PLACE: Final = ("x_m", "y_m", "z_m")
_SAME: Final = ("epoch_gps_ns", *_PLACE, "return_number", "intensity")
"""Columns in which two equal points agree."""
_ODD: Final = np.uint64(0x9E3779B97F4A7C15)  # 2⁶⁴ / golden ratio, an odd multiplier of the hash
_MIXER: Final = np.uint64(0xBF58476D1CE4E5B9)  # a multiplier of splitmix64


@dataclass
class CloudPoints(LogCheck):
    """Checks the points of one log of a cloud."""

    _counts: dict[int, int] = field(default_factory=dict)
    """Number of points by cell."""
    _first: dict[int, list[tuple[str, int, int]]] = field(default_factory=dict)
    """File, record and byte offset of the points of cells with few."""
    _sum_m: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    _points: int = 0

    def take(self, rows: Rows, refused: Sequence[Int64]) -> None:
        """Count the points of a chunk except those `refused` (by index)."""
        if rows.table != _TABLE:
            return
        kept = np.ones(rows.batch.num_rows, dtype=bool)
        for bad in refused:
            kept[bad] = False
        own = np.flatnonzero(kept)
        if not own.size:
            return
        xyz = _places(rows.batch)[own]
        self._sum_m += xyz.sum(axis=0)
        self._points += own.size
        cells = _cells(xyz)
        keys, counts = np.unique(cells, return_counts=True)
        small = keys[counts <= _FEW]
        for key, count in zip(keys.tolist(), counts.tolist(), strict=True):
            self._counts[key] = self._counts.get(key, 0) + count
            if self._counts[key] > _FEW:
                self._first.pop(key, None)
        few = np.flatnonzero(np.isin(cells, small))
        numbers, offsets = rows.numbers[own[few]].tolist(), rows.offsets[own[few]].tolist()
        for key, number, offset in zip(cells[few].tolist(), numbers, offsets, strict=True):
            if self._counts[key] <= _FEW:
                self._first.setdefault(key, []).append((rows.file, number, offset))

    def finish(self, writer: LogWriter, header: LogHeader) -> None:
        """Leave strays and duplicate points out of the finished table; record the cloud's mean."""
        if not writer.rows[_TABLE]:
            return
        strays = self._strays()
        if strays.size:
            for key in strays.tolist():
                for file, record, offset in self._first[key]:
                    writer.reject(file, record, offset, 1, STRAY)
            writer.leave_out(_TABLE, lambda rows: np.isin(_cells(_places(rows)), strays))
        twice = writer.leave_out(_TABLE, _again, _has_ties)
        if twice:
            writer.reject("", -1, -1, twice, TWICE)
        if self._points:
            header.attributes["middle_m"] = (self._sum_m / self._points).round(3).tolist()

    def _strays(self) -> Int64:
        """Return cells whose points are left out."""
        none = np.zeros(0, dtype=np.int64)
        if not self._first:
            return none
        keys = np.array(sorted(self._counts), dtype=np.int64)
        counts = np.array([self._counts[key] for key in keys.tolist()])
        if 2 * counts[counts >= _LEAST_IN_CELL].sum() < self._points:
            return none
        asked = np.array(sorted(self._first), dtype=np.int64)
        near = np.zeros(asked.size, dtype=np.int64)
        steps = np.arange(-1, 2)
        for i, j, k in np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3).tolist():
            beside = asked + (i << 2 * _BITS) + (j << _BITS) + k
            at = np.clip(np.searchsorted(keys, beside), 0, keys.size - 1)
            near += np.where(keys[at] == beside, counts[at], 0)
        alone = asked[near <= _FEW]
        points = sum(self._counts[key] for key in alone.tolist())
        return alone if points <= _MOST_STRAYS * self._points else none


def _places(rows: pa.RecordBatch | pa.Table) -> npt.NDArray[np.float64]:
    return np.stack([np.asarray(rows.column(name)) for name in _PLACE], axis=-1).astype(np.float64)


def _cells(xyz_m: npt.NDArray[np.float64]) -> Int64:
    """Return the key (n,) of the cell of each position (n, 3); positions that are not finite share one."""
    cells = np.clip(np.nan_to_num(np.floor(xyz_m / _CELL_M)), -_HALF + 1, _HALF - 2).astype(np.int64) + _HALF
    return np.asarray((cells[:, 0] << 2 * _BITS) + (cells[:, 1] << _BITS) + cells[:, 2], dtype=np.int64)


def _has_ties(epochs_gps_ns: Int64) -> bool:
    """Return whether two rows of a file, in order of time, share an epoch."""
    return bool((np.diff(epochs_gps_ns) == 0).any())


def _again(rows: pa.Table) -> Bool:
    """Return which rows (n,) repeat an earlier row, at epochs of which every row occurs twice or more.

    Where only some of an epoch's rows are equal, they are points that a coarse scale has put in one place.
    """
    mixed = np.zeros(rows.num_rows, dtype=np.uint64)
    for name in _SAME:
        column = pc.fill_null(rows.column(name), 0).to_numpy()
        bits = column.view(np.uint64) if column.dtype.itemsize == 8 else column.astype(np.uint64)
        mixed = (mixed ^ bits) * _ODD
        mixed = (mixed ^ (mixed >> np.uint64(29))) * _MIXER
    _, first, which, counts = np.unique(mixed, return_index=True, return_inverse=True, return_counts=True)
    epochs = rows.column("epoch_gps_ns").to_numpy()
    starts = np.flatnonzero(np.diff(epochs, prepend=epochs[0] - 1))
    lengths = np.diff(starts, append=epochs.size)
    again = np.repeat(np.minimum.reduceat(counts[which], starts) > 1, lengths)
    again[first] = False
    return again


FAR_RETURNS: Final = Witness(
    "far_returns",
    input="lidar",
    fault="Returns are stated in another unit than metres, such as millimetres.",
    asks="the distance of each return from the sensor, against the reach of lidars on vehicles",
    does="the returns are used within range_max_m of the rig; their number and the farthest are named",
    told=("findings",),
)

FARTHEST_M: Final = 1_000.0
"""Lidars on vehicles measure to 300 m, few to 500 m; returns beyond this distance (m) are no measurements."""
_LEAST_SHARE: Final = 0.001
"""Share of such returns that is named: single ones are noise."""


class FarReturns(LogCheck):
    """Counts returns that are too far away while a log streams by."""

    def __init__(self) -> None:
        self._count = 0
        self._far = 0
        self._farthest_m = 0.0

    def take(self, rows: Rows, refused: Sequence[npt.NDArray[np.int64]]) -> None:
        """Take the next rows of the table `returns`."""
        table, stored = rows.stored
        if rows.table != "returns" or not stored.num_rows:
            return
        if table == PACKED and farthest_m(stored) <= FARTHEST_M:
            self._count += stored.num_rows
            return
        columns = [rows.batch.column(f"{axis}_sensor_m").to_numpy(zero_copy_only=False) for axis in "xyz"]
        if np.hypot.reduce([max(float(one.max()), -float(one.min())) for one in columns]) <= FARTHEST_M:
            self._count += rows.batch.num_rows
            return
        distance_m = np.nan_to_num(distances_m(rows.batch), nan=0.0, posinf=0.0)
        self._count += distance_m.size
        self._far += int((distance_m > FARTHEST_M).sum())
        self._farthest_m = max(self._farthest_m, float(distance_m.max()))

    def finish(self, writer: LogWriter, header: LogHeader) -> None:
        """Name what was counted."""
        if self._far > _LEAST_SHARE * self._count:
            text = (
                f"{self._far:,} of {self._count:,} returns lie more than {FARTHEST_M:,.0f} m from the sensor, the "
                f"farthest {self._farthest_m:,.0f} m: no lidar of a vehicle measures so far; check the unit"
            )
            writer.findings.append(FAR_RETURNS.finds("", text))
