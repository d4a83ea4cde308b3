"""Rows of returns from packets: their batches, the gaps between views, and a clock that states its date.

The azimuths that a spinning lidar was told not to send: a gap of its view, inside which one packet a turn lies.

The blocks of that packet before and after the gap were fired a part of a turn apart, which neither its stamp nor its
length shows. A jump of the azimuth counts as the gap where other packets jump between the same azimuths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Bool, Int32, Int64
from roadscan.core.errors import Missing, TimeSystemError
from roadscan.core.gpstime import GPS_EPOCH_UNIX_S, Clock, TimeSystem, ahead_of_utc_s
from roadscan.core.witness import Witness
from roadscan.ingest.reading.format import LogSource

_AGREE_S: Final = 5.0
"""Largest difference of the clocks of sensor and computer; other time scales differ by more: GPS by 18 s, TAI by 37."""
_NEAR_S: Final = 2.0  # within this of 18 s or 37 s, the sensor's clock is proposed to be on GPS time or TAI
_STAMPED: Final = (TimeSystem.UNIX_UTC, TimeSystem.UNIX_TAI, TimeSystem.UNIX_GPS, TimeSystem.FREE)

OTHER_CLOCK: Final = Witness(
    "lidar_clock_unset",
    input="lidar",
    fault="A lidar's clock is not UTC: nothing set it, or PTP set it to TAI.",
    asks="the recording computer's clock",
    does="a log whose clock the survey file does not state is refused; the message proposes one",
    told=("error",),
)


TIME: Final = (
    "date and time in UTC where GPS sets the sensor, and whatever the master sends under PTP; a log without a stated "
    "clock is UTC where the recording computer's clock agrees"
)
"""`LogFormat.time` of such lidars."""


def clock_of(source: LogSource, system: str) -> Clock:
    """Return the clock by which rows are read, in microseconds, of the system that :func:`dated_clock` found."""
    return replace(source.any_clock or Clock(TimeSystem.UNIX_UTC), system=TimeSystem(system), unit="us")


def dated_clock(source: LogSource, stamp_s: float, ahead_s: float) -> Clock:
    """Return the stated clock, or UTC where the recording computer's clock agrees.

    Parameters
    ----------
    stamp_s : the first packet's time by the sensor's clock (s since 1970).
    ahead_s : the recording computer's clock less the sensor's (s).
    """
    stated = source.any_clock
    if stated is not None:
        if stated.system not in _STAMPED:
            raise TimeSystemError(
                f"clock.system is '{stated.system}', and the packets have date and time",
                expected=", ".join(_STAMPED),
                file=source.path,
                missing=Missing("clock", {"system": "unix_utc"}),
            )
        return stated
    if abs(ahead_s) <= _AGREE_S:
        return Clock(TimeSystem.UNIX_UTC)
    scales = ahead_of_utc_s(stamp_s + ahead_s)
    offset_s = ahead_s + scales[TimeSystem.UNIX_GPS] - GPS_EPOCH_UNIX_S
    proposed: dict[str, object] = {"system": "free", "offset_s": round(offset_s, 3)}
    for system, early_s in scales.items():
        if abs(ahead_s + early_s) < _NEAR_S:
            proposed = {"system": str(system)}
    raise TimeSystemError(
        f"the sensor's date and time are {-ahead_s:+,.3f} s from the recording computer's clock: they are not UTC, or "
        "that clock is wrong",
        expected='clock = { system = "unix_utc" } where GPS set the sensor, "unix_tai" for a PTP master on TAI, or '
        '"free" with a measured offset_s where nothing set it',
        file=source.path,
        missing=Missing("clock", proposed, is_example=proposed["system"] == "free"),
    )


Azimuths: TypeAlias = npt.NDArray[np.uint16]
Gap: TypeAlias = tuple[int, int]
"""Last azimuth before it and first one after it (0.01°)."""

TURN: Final = 36_000  # a full turn in 0.01°
_EDGE_CENTIDEG: Final = 100  # within which the azimuths beside a gap agree (0.01°)
_LEAST_JUMPS: Final = 2  # equal jumps that make a gap


def steps(azimuth: Azimuths) -> Int32:
    """Return the turn (n, blocks − 1) from block to block, 0.01°, within half a turn either way."""
    return np.asarray(np.mod(np.diff(azimuth.astype(np.int32), axis=1) + TURN // 2, TURN) - TURN // 2)


def gap_of(azimuth: Azimuths, odd: Bool) -> Gap | None:
    """Return the gap between whose azimuths most packets with one jump jump; None for fewer than two.

    Parameters
    ----------
    azimuth : (n, blocks), 0.01°.
    odd : (n, blocks − 1) steps that the head cannot have turned.
    """
    start, end = _edges(azimuth, odd)
    if start.size < _LEAST_JUMPS:
        return None
    alike = _near(start[:, None], start) & _near(end[:, None], end)
    best = int(alike.sum(axis=1).argmax())
    return (int(start[best]), int(end[best])) if alike[best].sum() >= _LEAST_JUMPS else None


def jumps(azimuth: Azimuths, odd: Bool, gap: Gap | None) -> Bool:
    """Return which packets (n,) jump elsewhere than over the gap."""
    jumping = np.asarray(odd.any(axis=1))
    if gap is not None:
        once = odd.sum(axis=1) == 1
        start, end = _edges(azimuth, odd)
        jumping[once] = ~(_near(start, np.array(gap[0])) & _near(end, np.array(gap[1])))
    return jumping


def waits_ns(azimuth: Azimuths, odd: Bool, rate: float, cycle_ns: int) -> Int64:
    """Return by how much each block (n, blocks) is later in its packet than without a gap.

    Parameters
    ----------
    rate : of the head (0.01°/ns).
    cycle_ns : time from block to block.
    """
    waits = np.zeros(azimuth.shape, dtype=np.int64)
    if odd.any() and rate:
        turned = np.mod(np.sign(rate) * np.diff(azimuth.astype(np.int64), axis=1), TURN)
        waits[:, 1:] = np.cumsum(np.where(odd, np.rint(turned / abs(rate)) - cycle_ns, 0), axis=1)
    return waits


def mean_rate(azimuth: Azimuths, epochs: Int64) -> float:
    """Return the head's rate (0.01°/ns, clockwise positive): the median over neighbouring packets, 0 where unknown."""
    passed_ns = np.diff(epochs)
    good = passed_ns > 0
    return float(np.median(steps(azimuth[:, :1].T)[0][good] / passed_ns[good])) if good.any() else 0.0


@dataclass
class Turns:
    """Numbers the turns of a head over the packets of a log, which come in pieces."""

    number: int = 0
    _azimuth: int = -1
    """Last azimuth (0.01°)."""

    def of(self, azimuth: Azimuths) -> Int32:
        """Return the turn (n, blocks) of each block: one more wherever the azimuth passes 360°, either way."""
        flat = azimuth.reshape(-1).astype(np.int32)
        before = flat[0] if self._azimuth < 0 else self._azimuth
        turns = self.number + np.cumsum(np.abs(np.diff(flat, prepend=before)) > TURN // 2)
        self.number, self._azimuth = int(turns[-1]), int(flat[-1])
        return np.asarray(turns.reshape(azimuth.shape), dtype=np.int32)


def _edges(azimuth: Azimuths, odd: Bool) -> tuple[Int32, Int32]:
    """Return the azimuths before and after the jump of each packet with one."""
    row = np.flatnonzero(odd.sum(axis=1) == 1)
    at = odd[row].argmax(axis=1)
    return azimuth[row, at].astype(np.int32), azimuth[row, at + 1].astype(np.int32)


def _near(a: Int32, b: Int32) -> Bool:
    return np.asarray(np.abs(np.mod(a - b + TURN // 2, TURN) - TURN // 2) <= _EDGE_CENTIDEG)


Numbers = npt.NDArray[Any]


def returns_batch(
    epoch_gps_ns: Numbers,
    xyz_sensor_m: Sequence[Numbers],
    intensity: Numbers,
    laser: Numbers,
    sweep: Numbers,
    pose_epoch_gps_ns: Numbers | None = None,
) -> pa.RecordBatch:
    """Return a batch of n returns from arrays (n,), of the types of the table.

    Parameters
    ----------
    xyz_sensor_m : x, y and z in the sensor's axes.
    pose_epoch_gps_ns : epochs of the poses that place them; None: a return's own.
    """
    x, y, z = (np.ascontiguousarray(one) for one in xyz_sensor_m)
    columns = {
        "epoch_gps_ns": epoch_gps_ns,
        "pose_epoch_gps_ns": epoch_gps_ns if pose_epoch_gps_ns is None else pose_epoch_gps_ns,
        "x_sensor_m": x,
        "y_sensor_m": y,
        "z_sensor_m": z,
        "intensity": intensity,
        "laser": laser,
        "sweep": sweep,
    }
    return pa.RecordBatch.from_pydict({name: pa.array(values) for name, values in columns.items()})
