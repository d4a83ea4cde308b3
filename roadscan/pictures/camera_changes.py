"""What an adjustment adds to a camera's lens, clock and row time (table `camera_corrections`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.camera import Interior
from roadscan.core.gpstime import NS_PER_S
from roadscan.pictures.lens import PARAMETERS
from roadscan.store.small_tables import read_small
from roadscan.store.store import Store

TABLE: Final = "camera_corrections"
COLUMNS: Final = (*PARAMETERS, "clock_s", "line_time_s")
"""Columns of the table, in the order of the values."""


JOINT_TABLE: Final = "camera_covariances"
JOINT: Final = 21
"""Errors of a picture that are known jointly: 6 of its pose, 6 of the mounting, 9 of the lens (`PARAMETERS`)."""


_POSE: Final = slice(0, 6)
"""Errors of the pose among those of a picture: each epoch has its own."""
_REST: Final = slice(6, JOINT)
"""Errors of mounting and lens among them: all pictures of a camera share these."""


@dataclass(frozen=True, eq=False)
class JointCovariances:
    """What an adjustment found of the errors of a camera's pictures in a run, at k epochs."""

    epochs_gps_ns: Int64
    """(k,)"""
    covariance: Float64
    """(k, 21, 21)"""
    later: tuple[Float64, ...] = ()
    """(k) of arrays (l, 6, 6): the pose (rows) with those of the next epochs (columns)."""

    def at(self, epochs_gps_ns: Int64) -> Float64:
        """Returns covariances (n, 21, 21); they change linearly in between."""
        before, share = self._place(epochs_gps_ns)
        after, part = np.minimum(before + 1, self.epochs_gps_ns.size - 1), share[:, None, None]
        return np.asarray((1.0 - part) * self.covariance[before] + part * self.covariance[after])

    def between(self, first_gps_ns: int, second_gps_ns: int, fading_s: float) -> Float64 | None:
        """Returns the covariance (6, 6) of the pose at one epoch (rows) with that at another; None where none is told.

        Errors change from epoch to epoch as a process with independent steps does, so that the covariance of a pose
        with itself is that of :meth:`at`. Beyond the last epoch that is told, what is not due to mounting and lens
        fades with a time constant.
        """
        if first_gps_ns > second_gps_ns:
            found = self.between(second_gps_ns, first_gps_ns, fading_s)
            return None if found is None else found.T
        if not self.later:
            return None
        places, shares = self._place(np.array([first_gps_ns, second_gps_ns]))
        (a, b), (s, t) = places.tolist(), shares.tolist()
        reach = a + min(len(self.later[a]), len(self.later[min(a + 1, len(self.later) - 1)]) + 1)
        if b + (t > 0.0) <= reach:
            found = sum(
                one * other * self._knots(a + i, b + j)
                for i, one in ((0, 1.0 - s), (1, s)) if one
                for j, other in ((0, 1.0 - t), (1, t)) if other
            )  # fmt: skip
            if a == b and s > 0.0:
                step = self._knots(a, a) + self._knots(a + 1, a + 1) - self._knots(a, a + 1) - self._knots(a + 1, a)
                found = found + (min(s, t) - s * t) * step
            return np.asarray(found)
        last = int(self.epochs_gps_ns[reach])
        near = self.between(first_gps_ns, last, fading_s)
        one, middle, other = self.at(np.array([first_gps_ns, last, second_gps_ns]))
        by_rest = one[_POSE, _REST] @ np.linalg.pinv(one[_REST, _REST], hermitian=True)
        fade = np.exp(-(second_gps_ns - last) / NS_PER_S / fading_s)
        return np.asarray(by_rest @ other[_REST, _POSE] + fade * (near - by_rest @ middle[_REST, _POSE]))

    def _place(self, epochs_gps_ns: Int64) -> tuple[Int64, Float64]:
        """Returns the number of the epoch before each (n,), and the share of the way to the next one, 0 to 1."""
        since, known = ((e - self.epochs_gps_ns[0]).astype(np.float64) for e in (epochs_gps_ns, self.epochs_gps_ns))
        at = np.interp(since, known, np.arange(known.size, dtype=np.float64))
        before = np.minimum(at.astype(np.int64), known.size - 1)
        return before, at - before

    def _knots(self, a: int, b: int) -> Float64:
        """Returns the covariance (6, 6) of the poses at two of the epochs."""
        if a > b:
            return self._knots(b, a).T
        return self.covariance[a, _POSE, _POSE] if a == b else self.later[a][b - a - 1]


def load_joint_covariances(store: Store, run: str, sensor: str) -> JointCovariances | None:
    """Returns what an adjustment found for a camera in a run; None without."""
    table = read_small(store, JOINT_TABLE)
    rows = [] if table is None else [r for r in table.to_pylist() if (r["run"], r["sensor"]) == (run, sensor)]
    if not rows:
        return None
    upper = np.triu_indices(JOINT)
    found = np.zeros((len(rows), JOINT, JOINT))
    found[:, upper[0], upper[1]] = found[:, upper[1], upper[0]] = [row["covariance"] for row in rows]
    told = all(row.get("later") is not None for row in rows)
    later = tuple(np.array(row["later"]).reshape(-1, 6, 6) for row in rows) if told else ()
    return JointCovariances(np.array([row["epoch_gps_ns"] for row in rows], np.int64), found, later)


def load_camera_changes(store: Store) -> Mapping[str, Float64]:
    """Returns what is added to the cameras (11,), `COLUMNS`, by sensor."""
    table = read_small(store, TABLE)
    rows = [] if table is None else table.to_pylist()
    return {row["sensor"]: np.array([float(row[name]) for name in COLUMNS]) for row in rows}


def changed(interior: Interior, change: Float64 | None) -> Interior:
    """Returns an interior orientation with a change (11,) of its lens; clock and row time are applied to epochs."""
    if change is None or not np.any(change):
        return interior
    stated = [*interior.focal_px, *interior.principal_px, *interior.distortion]
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = (np.array(stated) + change[: len(PARAMETERS)]).tolist()
    update = {"focal_px": (fx, fy), "principal_px": (cx, cy), "distortion": (k1, k2, p1, p2, k3)}
    return interior.model_copy(update=update)


def row_ns(interior: Interior, change: Float64 | None) -> float:
    """Returns the time (ns) from the exposure of a row to that of the row below; 0 of a global shutter."""
    found = 0.0 if change is None else float(change[COLUMNS.index("line_time_s")])
    return 1e3 * interior.line_time_us + found * NS_PER_S


def clock_ns(change: Float64 | None) -> int:
    """Returns what is added to the stamps of a camera's pictures (ns)."""
    return 0 if change is None else round(float(change[COLUMNS.index("clock_s")]) * NS_PER_S)
