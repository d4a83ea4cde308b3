"""Checks each laser of a spinning lidar: its ranges have to agree with those of the lasers above and below it."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Float64
from roadscan.compute.robust import scatter_about
from roadscan.core.witness import Finding, Witness
from roadscan.ingest.kernels.laser_ranges import by_firing, residuals
from roadscan.ingest.log_check import LogCheck
from roadscan.ingest.reading.format import LogHeader, Rows
from roadscan.store.readings.returns import sensor_xyz_m
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
