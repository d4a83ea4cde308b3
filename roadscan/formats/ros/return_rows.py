"""Turns the points of messages into rows of `returns`, and finds how a cloud states the time of each point.

Finds how a cloud states the time of each point, from the size of the numbers and their span against the rate.

Drivers write it under many names, in seconds to nanoseconds, from the header's stamp or from 1970. Neighbouring units
differ a thousandfold: one of them alone makes a sweep last about as long as from one message to the next, or falls into
our time. Where the numbers leave several, or none, nothing is assumed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import Missing, TimeSystemError
from roadscan.core.gpstime import NS_PER_S, SCALES, TAI_MINUS_GPS_S, UNIT_NS, ahead_of_utc_s
from roadscan.formats.lidars.packet_returns import returns_batch
from roadscan.formats.ros.bag import Message
from roadscan.formats.ros.topics import message_clock
from roadscan.ingest.reading.format import Item, LogSource, Rows
from roadscan.ingest.reading.records import EpochReader, Sieve

INTENSITY_MAX: Final = 65_535  # brightest value of the column `intensity`

_CHUNK: Final = 1 << 18  # points of a chunk
_FARTHEST_M: Final = 10_000.0  # farther positions count as damage
_LATEST_NS: Final = 10_000_000_000  # points measured longer before or after the message's stamp count as damage
_LASERS: Final = 255  # greatest number of a laser

Numbers = npt.NDArray[Any]


class ReturnRows:
    """Converts the points of a topic, message by message; records count points over the whole topic."""

    def __init__(self, source: LogSource, *, compensated: bool) -> None:
        self._clock = message_clock(source)
        self._epochs = EpochReader(self._clock, source.path)
        self._rate = 1.0 + self._clock.drift_ppm * 1e-6
        self._compensated = compensated
        self._before = 0

    def items(
        self,
        message: Message,
        stamp_ns: int,
        xyz: Sequence[Numbers],
        offsets_ns: npt.NDArray[np.int64] | None,
        intensity: Numbers | None,
        laser: Numbers | None,
    ) -> Iterator[Item]:
        """Yield the rows of a message's returns, and rejects.

        Parameters
        ----------
        stamp_ns : the message's stamp by the log's clock.
        xyz : three arrays (n,) in the sensor's axes (m).
        offsets_ns : (n,) time of each point after the stamp; None where all are of the stamp.
        intensity, laser : (n,) or None.
        """
        sieve = Sieve(1)
        epoch = int(self._epochs.epochs(np.array([stamp_ns]), sieve, np.array([message.number]))[0])
        for reject in sieve.rejects(np.array([message.number]), np.array([message.offset])):
            yield replace(reject, file=message.file)
        count = len(xyz[0])
        for first in range(0, count if sieve.good.all() else 0, _CHUNK):
            part = slice(first, first + _CHUNK)
            columns = [None if one is None else one[part] for one in (*xyz, offsets_ns, intensity, laser)]
            yield from self._chunk(message, epoch, columns, self._before + first)
        self._before += count

    def _chunk(self, message: Message, epoch: int, columns: Sequence[Numbers | None], first: int) -> Iterator[Item]:
        x, y, z = (np.ascontiguousarray(one, np.float32) for one in columns[:3])
        offsets, intensity, laser = columns[3:]
        with np.errstate(invalid="ignore", over="ignore"):
            farthest = np.maximum(np.maximum(np.abs(x), np.abs(y)), np.abs(z))  # NaN where one of them is
            returned = farthest > 0.0  # neither 0, 0, 0 nor NaN
        kept: npt.NDArray[np.int64] | slice = slice(None) if returned.all() else np.flatnonzero(returned)
        records = first + (np.arange(x.size) if isinstance(kept, slice) else kept)
        sieve = Sieve(records.size)
        if not farthest.max(initial=0.0) <= _FARTHEST_M:  # also where one is no number
            sieve.drop(farthest[kept] > _FARTHEST_M, "the position is beyond 10 km")
        late = None if offsets is None else offsets[kept]
        if late is not None and late.size and (late.min() < -_LATEST_NS or late.max() > _LATEST_NS):
            sieve.drop(late == UNKNOWN_NS, "its time is no number")
            sieve.drop(np.abs(late) > _LATEST_NS, "its time is more than 10 s from its message's")
        ring = None if laser is None else laser[kept]
        if ring is not None and ring.size and not 0 <= ring.min() <= ring.max() <= _LASERS:
            sieve.drop(~((ring >= 0) & (ring <= _LASERS)), "the laser's number is outside 0 to 255")
        if not sieve.good.all():
            for reject in sieve.rejects(records, np.full(records.size, message.offset)):
                yield replace(reject, file=message.file)
            good = np.flatnonzero(sieve.good)
            kept = good if isinstance(kept, slice) else kept[good]
            records = records[good]
            late, ring = (None if one is None else one[good] for one in (late, ring))
        if records.size:
            yield self._rows(message, epoch, (x[kept], y[kept], z[kept]), late, _bright(intensity, kept), ring, records)

    def _rows(
        self, message: Message, epoch: int, xyz: Sequence[Numbers], late: Numbers | None, intensity: Numbers | None,
        laser: Numbers | None, records: npt.NDArray[np.int64],
    ) -> Rows:  # fmt: skip
        count = records.size
        stamps = np.full(count, epoch, dtype=np.int64)
        epochs = (
            stamps
            if late is None
            else stamps + (late if self._rate == 1.0 else np.rint(late * self._rate).astype(np.int64))
        )
        batch = returns_batch(
            epochs,
            xyz,
            np.zeros(count, np.uint16) if intensity is None else intensity,
            np.zeros(count, np.uint8) if laser is None else laser.astype(np.uint8),
            np.full(count, message.number, dtype=np.int32),
            stamps if self._compensated else epochs,
        )
        unbroken = int(records[-1] - records[0]) == count - 1
        return Rows(
            "returns", batch, message.file, int(records[0]), message.offset, records=None if unbroken else records
        )


def _bright(intensity: Numbers | None, kept: npt.NDArray[np.int64] | slice) -> Numbers | None:
    """Return intensities as 16 bits; what is not a number is dark."""
    if intensity is None:
        return None
    values = intensity[kept]
    if values.dtype.kind == "u" and values.dtype.itemsize <= 2:
        return values.astype(np.uint16)
    if values.dtype.kind == "f":
        if values.size and values.min() >= 0 and values.max() <= INTENSITY_MAX:
            return np.rint(values).astype(np.uint16)
        values = np.nan_to_num(values)
    return np.asarray(np.rint(np.clip(values, 0, INTENSITY_MAX)), dtype=np.uint16)


FIELDS: Final = ("t", "time", "timestamp", "time_stamp", "offset_time", "timestamps", "point_time", "time_offset")
"""Names by which a field with times of points is known."""
Origin = Literal["header", "epoch"]

UNKNOWN_NS: Final = np.int64(1 << 62)
"""Offset (ns) of a point without a time."""
_NEAR_NS: Final = 2 * NS_PER_S  # times from 1970 lie so near to the header's stamp (ns), if one clock wrote both
_SWEEP_NS: Final = (5_000_000, 2 * NS_PER_S)
"""Range of a sweep's duration (ns) where the rate of the messages is not known: 200 Hz to 0.5 Hz."""
_SHARE: Final = (0.2, 1.6)  # span of a sweep's times to the interval of messages; part of a turn may be empty
_MOST_AHEAD_S: Final = 9.5
"""Points that are farther from their header (s) would all be rejected: it is asked how far the clocks are apart."""
_OUR_TIME_S: Final = (4.75e8, 2.524e9)  # seconds from 1970 or 1980 of dates from 1985 to 2060


@dataclass(frozen=True)
class Sample:
    """Times of the points of one message."""

    header_ns: int
    least: float
    """Least time as the field states it."""
    most: float


@dataclass(frozen=True)
class PointTimes:
    """How the times of points are written."""

    field: str
    unit: str
    """s, ms, us or ns."""
    origin: Origin
    """What they count from: the message's stamp, or the origin of the clock."""
    ahead_ns: int = 0
    """How far the clock of the points is ahead of that of the stamps, where they count from its origin."""

    def offsets_ns(self, values: npt.NDArray[np.generic], stamp_ns: int) -> npt.NDArray[np.int64]:
        """Return times (n,) relative to a stamp (ns), rounded to ns; `UNKNOWN_NS` for what is no number."""
        scale = UNIT_NS[self.unit]
        stamp_ns += self.ahead_ns
        if values.dtype.kind in "iu":
            whole: npt.NDArray[np.int64] = values.astype(np.int64)
            if scale != 1:
                whole *= scale
            return whole - stamp_ns if self.origin == "epoch" else whole
        # Whole units first: a double holds the difference of two near times better than either of them in ns.
        units, rest_ns = divmod(stamp_ns, scale) if self.origin == "epoch" else (0, 0)
        late_ns = np.rint((values.astype(np.float64) - units) * scale)
        if (known := np.isfinite(late_ns)).all():
            return late_ns.astype(np.int64) - rest_ns
        return np.where(known, np.where(known, late_ns, 0.0).astype(np.int64) - rest_ns, UNKNOWN_NS)


def found(
    field: str, samples: Sequence[Sample], unit: str | None, origin: Origin | None, ahead_s: float, file: Path
) -> PointTimes:
    """Return how the times of a field are written: as stated, else as the numbers alone can mean it.

    Parameters
    ----------
    samples : of the first messages, in their order.
    ahead_s : how far the clock of the points is ahead of that of the headers.

    Raises
    ------
    TimeSystemError
        where the numbers fit none, or several.
    """
    fitting = [
        (u, o)
        for o in ("header", "epoch")
        for u in UNIT_NS
        if unit in {None, u} and origin in {None, o} and (_fits(samples, UNIT_NS[u], o) or (unit and origin))
    ]
    if len(fitting) == 1:
        times = PointTimes(
            field, fitting[0][0], "epoch" if fitting[0][1] == "epoch" else "header", round(ahead_s * NS_PER_S)
        )
        _check_ahead(times, samples, file)
        return times
    least, most = min(s.least for s in samples), max(s.most for s in samples)
    means = " and ".join(f"{u} from the {'header' if o == 'header' else 'origin of the clock'}" for u, o in fitting)
    questions = {"options.time_unit": tuple(UNIT_NS), "options.time_from": ("header", "epoch")}
    asked = [Missing(key, choices=choices) for key, choices in questions.items()]
    raise TimeSystemError(
        f"the times of the points (field '{field}', {least:.10g} to {most:.10g}) can be {means or 'of no usual unit'}",
        expected="options.time_unit (s, ms, us, ns) and options.time_from (header, epoch), by the driver's manual",
        file=file,
        missing=[asked],
    )


def _check_ahead(times: PointTimes, samples: Sequence[Sample], file: Path) -> None:
    """Refuse times from the origin of a clock that is seconds off that of the headers."""
    if times.origin != "epoch":
        return
    scale = UNIT_NS[times.unit]
    ahead_s = float(np.median([0.5 * (s.least + s.most) * scale - s.header_ns for s in samples])) / NS_PER_S
    left_s = ahead_s - times.ahead_ns / NS_PER_S
    if abs(left_s) < _MOST_AHEAD_S:
        return
    scales = ahead_of_utc_s(samples[0].header_ns / NS_PER_S).items()
    known = {scale_s: f"as {SCALES[system]} is ahead of UTC" for system, scale_s in scales}
    known[TAI_MINUS_GPS_S] = "as TAI is ahead of GPS time"
    why = known.get(round(abs(ahead_s)), "which is no difference of two time scales")
    raise TimeSystemError(
        f"the points' own times ('{times.field}') are {ahead_s:+.1f} s ahead of the headers' stamps, {why}",
        expected="options.time_ahead_s, which is taken off the points' times",
        file=file,
        missing=Missing("options.time_ahead_s", float(round(ahead_s))),
    )


def _fits(samples: Sequence[Sample], scale: int, origin: str) -> bool:
    """Whether times of that unit and origin make sense of the first messages."""
    spans = np.array([(s.most - s.least) * scale for s in samples])
    headers = np.array([s.header_ns for s in samples])
    steps = np.diff(headers)
    period_ns = float(np.median(steps)) if steps.size and (steps > 0).all() else 0.0
    low, high = (period_ns * share for share in _SHARE) if period_ns else _SWEEP_NS
    if not low <= float(np.median(spans)) <= high:
        return False
    ends = np.array([(s.least * scale, s.most * scale) for s in samples])
    if origin == "header":
        return bool((np.abs(ends) <= 2 * max(high, _SWEEP_NS[0])).all())
    near = np.abs(ends - headers[:, None]) <= _NEAR_NS
    seconds = ends / NS_PER_S
    return bool(near.all() or ((seconds > _OUR_TIME_S[0]) & (seconds < _OUR_TIME_S[1])).all())
