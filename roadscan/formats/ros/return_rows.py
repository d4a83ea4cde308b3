"""Turns the points of messages into rows of `returns`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.formats.lidars.returns_batch import returns_batch
from roadscan.formats.ros.bag import Message
from roadscan.formats.ros.point_times import UNKNOWN_NS
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
