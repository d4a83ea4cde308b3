"""What is checked of a log's returns: the ranges of each laser, and points that stand alone."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.arrays import scatter_about
from roadscan.core.witness import Finding, Witness
from roadscan.ingest.kernels.laser_ranges import by_firing, residuals
from roadscan.ingest.log_check import LogCheck
from roadscan.ingest.reading.format import LogHeader, Rows
from roadscan.store.readings.packed_returns import PACKED, farthest_m
from roadscan.store.readings.row_groups import distances_m, sensor_xyz_m
from roadscan.store.writer import LogWriter

LASER_RANGE: Final = Witness(
    "laser_range",
    input="lidar",
    fault="One laser of a head measures ranges that are off: a damaged receiver, a wrong table of corrections.",
    asks="the two lasers next to it in elevation: where all three see a plane, 1/range is linear in the direction",
    does="up to four lasers that are off by more than 60 mm, and ten times its σ, to all sides alike, are left out and "
    "named with the offset; where these do not explain all that does not fit, they are named and used",
    told=("rejects", "findings"),
)

_TABLE: Final = "returns"
_OFF_M: Final = 0.06
"""Least reported offset (m): makers promise ±20 mm; the largest median in an HDL-32E recording is 24 mm."""
_SIGMAS: Final = 10.0  # least offset, in its σ, that is reported
_ALIKE: Final = 0.5
"""Largest deviation of the medians of all quarters of the turn, and largest scatter (1 σ), as shares of the offset."""
_LEAST: Final = 100
"""Least firings of a quarter of the turn."""
_MOST_LASERS: Final = 4  # if more lasers are off, none is left out
_EVERY: Final = 8  # one chunk in this many is examined
_MOST_CHUNKS: Final = 40
"""Most chunks that are examined: some ten million returns of a long capture."""


@dataclass
class LaserRanges(LogCheck):
    """Compares the ranges of neighbouring lasers in some chunks of one log."""

    in_sensor_frame: bool
    _chunks: int = 0
    _found: dict[int, list[tuple[Float64, npt.NDArray[np.int64], float, float]]] = field(default_factory=dict)
    """By laser and chunk: residuals (m) and quarters (n,), and what 1 m of each neighbour's range adds to them."""
    _beside: dict[int, tuple[int, int]] = field(default_factory=dict)

    def take(self, rows: Rows, refused: Sequence[npt.NDArray[np.int64]]) -> None:
        """Examine a chunk if its turn has come."""
        if rows.table != _TABLE:
            return
        self._chunks += 1
        if not self.in_sensor_frame or self._chunks % _EVERY != 1 or self._chunks > _EVERY * _MOST_CHUNKS:
            return
        batch = rows.batch
        if "laser" not in batch.schema.names or batch.column("laser").null_count:
            return
        laser = batch.column("laser").to_numpy(zero_copy_only=False).astype(np.int64)
        firing = np.cumsum(np.diff(laser, prepend=-1) <= 0)
        if laser.size < _LEAST or laser.max() > 255 or laser.size < 4 * (firing[-1] + 1):
            return
        heads = np.full((4, int(laser.max()) + 1, int(firing[-1]) + 1), np.nan)
        by_firing(laser, firing, np.array(sensor_xyz_m(batch)), heads)
        known = np.flatnonzero(np.isfinite(heads[0]).sum(axis=1) >= _LEAST)
        level = np.array([float(np.arcsin(_median(one[np.isfinite(one)]))) for one in heads[1, known]])
        known, level = known[np.argsort(level)], np.sort(level)
        last = known.size - 1
        for mid in range(known.size if last >= 2 else 0):  # the lowest and the highest have two on one side
            one, other = (1, 2) if mid == 0 else (last - 2, last - 1) if mid == last else (mid - 1, mid + 1)
            three = [mid, one, other]
            self._compare(heads, known[three].tolist(), level[three])

    def _compare(self, heads: Float64, lasers: Sequence[int], level: Float64) -> None:
        """Add one laser's residuals against two others, by firing; `level` (3,) holds their elevations (rad)."""
        mid, one, other = lasers
        span = float(np.sin(level[2] - level[1]))
        if span <= 0:
            return
        share = float(np.sin(level[2] - level[0])) / span, float(np.sin(level[0] - level[1])) / span
        firings = heads.shape[2]
        off_m, quarter, pulls = np.empty(firings), np.empty(firings, np.int64), np.empty((2, firings))
        count = residuals(heads, mid, one, other, *share, off_m, quarter, pulls)
        if not count or self._beside.setdefault(mid, (one, other)) != (one, other):
            return
        pull, other_pull = (_median(one[:count]) for one in pulls)
        self._found.setdefault(mid, []).append((off_m[:count], quarter[:count], pull, other_pull))

    def finish(self, writer: LogWriter, header: LogHeader) -> None:
        """Leave the returns of lasers with wrong ranges out of the finished table."""
        wrong, is_clear = self._wrong()
        is_out = is_clear and len(wrong) <= _MOST_LASERS
        for laser, (off_m, sigma_m, firings) in sorted(wrong.items()):
            count = writer.leave_out(_TABLE, functools.partial(_is_of, laser)) if is_out else 0
            if count:
                writer.reject("", -1, -1, count, f"the ranges of laser {laser} are {1e3 * off_m:+,.0f} mm off")
            writer.findings.append(_finding(laser, off_m, sigma_m, firings, count))

    def _wrong(self) -> tuple[dict[int, tuple[float, float, int]], bool]:
        """Return offset and σ (m) of each wrong laser and its number of firings; and whether they explain all
        residuals.

        A wrong laser pulls the residuals of those beside it, so the one that explains most of them is taken, and its
        pull off, until none is left.
        """
        lasers = sorted(k for k, parts in self._found.items() if sum(p[0].size for p in parts) >= _LEAST)
        number = {laser: k for k, laser in enumerate(lasers)}
        pulls = np.eye(len(lasers))
        residuals, quarters = [], []
        for laser in lasers:
            parts = self._found[laser]
            residuals.append(np.concatenate([p[0] for p in parts]))
            quarters.append(np.concatenate([p[1] for p in parts]))
            for side, other in enumerate(self._beside[laser]):
                if other in number:
                    pulls[number[laser], number[other]] = float(np.mean([p[2 + side] for p in parts]))
        off_m = np.array([float(np.median(one)) for one in residuals])
        wrong: dict[int, tuple[float, float, int]] = {}
        for _ in lasers:
            tried = [(*_explained(off_m, pulls[:, k]), k) for k in range(len(lasers)) if lasers[k] not in wrong]
            _, by_m, k = min(tried, default=(0.0, 0.0, 0))
            if abs(by_m) <= _OFF_M:
                break
            others = off_m[k] - by_m  # effect of other wrong lasers on its residuals
            sigma_m = _sigma_of(residuals[k] - others, quarters[k], by_m)
            if sigma_m is None:
                break
            wrong[lasers[k]] = by_m, sigma_m, residuals[k].size
            off_m = off_m - pulls[:, k] * by_m
        return wrong, bool((np.abs(off_m) <= _OFF_M).all())


def _median(values: Float64) -> float:
    """Return the median of values (n,), n > 0, none of them NaN: `numpy.median` takes twice as long for a thousand."""
    half = values.size // 2
    if values.size % 2:
        return float(np.partition(values, half)[half])
    return float(np.partition(values, (half - 1, half))[half - 1 : half + 1].mean())


def _is_of(laser: int, rows: pa.Table) -> npt.NDArray[np.bool_]:
    """Return which rows (n,) are of a laser."""
    return np.asarray(rows.column("laser").to_numpy() == laser)


def _explained(off_m: Float64, pull: Float64) -> tuple[float, float]:
    """Return the remaining sum of residuals (m) if one laser is wrong, and the offset (m) that minimises it."""
    own = np.flatnonzero(np.abs(pull) > 0)
    ratios, weights = off_m[own] / pull[own], np.abs(pull[own])
    order = np.argsort(ratios)
    middle = np.searchsorted(np.cumsum(weights[order]), weights.sum() / 2)
    by_m = float(ratios[order[min(int(middle), own.size - 1)]])
    return float(np.abs(off_m - pull * by_m).sum()), by_m


def _sigma_of(off_m: Float64, quarters: npt.NDArray[np.int64], middle_m: float) -> float | None:
    """Return σ of an offset (m); None where the quarters of the turn disagree, or the scene may cause it."""
    medians = [
        float(np.median(off_m[quarters == q])) for q in np.unique(quarters) if (quarters == q).sum() >= _LEAST
    ]  # fmt: skip
    scatter = scatter_about(off_m, middle_m)
    if len(medians) < 2 or scatter > _ALIKE * abs(middle_m):
        return None
    if any(abs(one - middle_m) > _ALIKE * abs(middle_m) for one in medians):
        return None
    sigma_m = max(float(np.std(medians, ddof=1)) / np.sqrt(len(medians)), scatter / np.sqrt(off_m.size))
    return sigma_m if abs(middle_m) > _SIGMAS * sigma_m else None


def _finding(laser: int, off_m: float, sigma_m: float, firings: int, left_out: int) -> Finding:
    done = f"its {left_out:,} returns were left out" if left_out else "it, or one beside it; all returns are used"
    return LASER_RANGE.finds(
        "",
        f"the ranges of laser {laser} are {1e3 * off_m:+,.0f} mm (σ {1e3 * sigma_m:.1f} mm) off those that the lasers "
        f"beside it measure of the same surfaces ({firings:,} firings): {done}; see to the head and its corrections",
        left_out,
    )


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
_POINTS: Final = "cloud"
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
        if rows.table != _POINTS:
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
        if not writer.rows[_POINTS]:
            return
        strays = self._strays()
        if strays.size:
            for key in strays.tolist():
                for file, record, offset in self._first[key]:
                    writer.reject(file, record, offset, 1, STRAY)
            writer.leave_out(_POINTS, lambda rows: np.isin(_cells(_places(rows)), strays))
        twice = writer.leave_out(_POINTS, _again, _has_ties)
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
