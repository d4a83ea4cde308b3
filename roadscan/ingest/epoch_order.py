"""Checks the epochs of a log in file order: time that goes back, repeated rows, jumps relative to the log's rate.

Tables are sorted by time. A clock that starts anew, or a log appended to itself, would be sorted into what came before.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from roadscan.compute.array_types import Bool, Int64
from roadscan.core.counted import counted
from roadscan.core.errors import TimeSystemError
from roadscan.core.gpstime import NS_PER_S, iso_from_gps_ns
from roadscan.core.witness import Finding, Witness
from roadscan.ingest.log_check import LogCheck, Refused, epochs_in
from roadscan.ingest.reading.format import LogHeader, Rows
from roadscan.ingest.reading.records import LEAP_NS
from roadscan.store.logs import DataFile, Fault, LogRecord
from roadscan.store.writer import LogWriter

TIME_GOES_BACK: Final = Witness(
    "time_goes_back",
    input="any log with a stamp a row",
    fault="Time goes back within a log: its clock starts anew or is set, logs were appended to one another, rows "
    "arrived late.",
    asks="each stamp against those of the rows before it, in the order of the file",
    does="rows that go back to a time which the log holds already are left out, and so are leaps out of the log's "
    "order and back; rows that fill a gap, or lie before the first, are used and named; the count of a free clock "
    "never goes back, so what follows is left out",
    told=("rejects", "findings"),
)
ROWS_TWICE: Final = Witness(
    "rows_twice",
    input="any log with a stamp a row",
    fault="A row stands twice, one after the other.",
    asks="neighbouring rows of one stamp, column by column",
    does="the second is left out",
    told=("rejects",),
)
TIME_JUMPS: Final = Witness(
    "time_jumps",
    input="imu",
    fault="The clock of an IMU is set forward within a log, or readings are missing.",
    asks="steps between stamps, against the log's own rate",
    does="the readings are used, and the jump is named",
    told=("findings",),
)

_ORDERED: Final = ("scans", "imu", "encoder", "gnss", "trajectory", "trajectory_accuracy", "images")
"""Tables whose rows are written in the order in which they are measured."""
_EVEN: Final = ("imu",)
"""Tables whose sensors measure at a constant rate without pauses."""
_GAP_PERIODS: Final = 1.5  # steps longer than this many usual periods are gaps
_JUMP_NS: Final = NS_PER_S
_JUMP_PERIODS: Final = 20  # steps longer than this many usual periods are jumps, if also longer than `_JUMP_NS`
_MOST_GAPS: Final = 200_000
"""Most gaps of a log that are remembered; the oldest are dropped."""
_MOST_LEAPS: Final = 100
"""A chunk with more backward steps has several streams and is not searched for leaps."""
_FOR_RATE: Final = 64  # first epochs from which the log's rate is estimated
_RATE_QUANTILE: Final = 0.1
"""Quantile of the first steps that is taken as the period, because rows may be lost or late among them."""

BACK: Final = "the stamp goes back to a time that the log holds already"
RESTART: Final = "the count of the clock goes back: it started anew"
LEAP: Final = "the stamps leap out of the log's order and come back"
TWICE: Final = "the row stands twice, one after the other"


@dataclass
class _Series:
    """Rows of one table of one file, in file order."""

    free: bool
    """The clock counts from an unknown instant and cannot go back."""
    even: bool
    rows: int = 0
    back: int = 0
    """How often time goes back."""
    farthest_ns: int = 0
    """Largest step back (ns)."""
    first_record: int = -1
    first_ns: int = 0
    """Record and epoch at which time first goes back."""
    refused: int = 0
    moved: int = 0
    """Rows behind a backward step that are used."""
    jumps: list[tuple[int, int, int]] = field(default_factory=list)
    """Record after a forward jump, its epoch and its length (ns)."""
    _start_ns: int = 0
    _top_ns: int | None = None
    _usual_ns: int = 0
    _sample: list[int] = field(default_factory=list)
    """First epochs."""
    _gaps: list[tuple[int, int]] = field(default_factory=list)
    """Intervals without a row (first and last epoch); between all rows until the rate is known."""
    _last: pa.RecordBatch | None = None

    def take(self, epochs: Int64, batch: pa.RecordBatch, first_record: int) -> list[tuple[Int64, str]]:
        """Return the rows (by index) of a batch that are left out, with reasons; `epochs` (n,), n > 0."""
        self.rows += epochs.size
        series = np.concatenate([[epochs[0] if self._top_ns is None else self._top_ns], epochs])
        if self._top_ns is None:
            self._start_ns = int(epochs[0])
        steps = np.diff(series)
        self._learn(epochs)
        out: list[tuple[Int64, str]] = []
        twice = self._twice(batch, epochs)
        if twice.size:
            out.append((twice, TWICE))
        last_ns = self._top_ns if self._last is None else self._last.column("epoch_gps_ns")[0].as_py()
        if (steps >= 0).all() and (last_ns == self._top_ns or steps[0] > 0):
            self._note(series, steps, first_record)
        else:
            out += self._backward(epochs, first_record, twice)
        self._last = batch.slice(batch.num_rows - 1, 1)
        return out

    def _learn(self, epochs: Int64) -> None:
        """Estimate the log's rate from its first rows, in whatever order they come."""
        if len(self._sample) >= _FOR_RATE:
            return
        self._sample += epochs[: _FOR_RATE - len(self._sample)].tolist()
        steps = np.diff(np.sort(np.array(self._sample, dtype=np.int64)))
        steps = steps[steps > 0]
        if len(self._sample) >= _FOR_RATE and steps.size:
            self._usual_ns = int(np.quantile(steps, _RATE_QUANTILE))

    @property
    def backward(self) -> str:
        """Return in words how time goes back, and what was done with the rows."""
        used = f", and {self.moved:,} at times of which it holds no other row are used" if self.moved else ""
        return (
            f"time goes back {_times(self.back)}, by {self.farthest_ns / NS_PER_S:.3f} s at the most, first at record "
            f"{self.first_record:,} (to {iso_from_gps_ns(self.first_ns)}): {self.refused:,} rows were left out{used}; "
            "a clock started anew or was set, logs were appended to one another, or rows came late"
        )

    @property
    def forward(self) -> str:
        """Return in words how time jumps forward."""
        record, epoch, length = max(self.jumps, key=lambda one: one[2])
        return (
            f"time jumps forward {_times(len(self.jumps))}, by {length / NS_PER_S:.3f} s at the most (record "
            f"{record:,}, {iso_from_gps_ns(epoch)}): readings are missing, or the clock was set; all rows are used"
        )

    def _backward(self, epochs: Int64, first_record: int, twice: Int64) -> list[tuple[Int64, str]]:
        """Return the rows of a batch in which time goes back, with reasons."""
        leaping = self._leaping(epochs)
        steady = np.flatnonzero(~leaping)
        before = self._top_ns if self._top_ns is not None else int(epochs[steady[0]])
        highest = np.maximum.accumulate(np.concatenate([[before], epochs[steady]]))
        behind = highest[:-1] - epochs[steady]
        last_ns = before if self._last is None else int(self._last.column("epoch_gps_ns")[0].as_py())
        is_late = (behind > 0) | ((behind == 0) & (np.diff(epochs[steady], prepend=last_ns) > 0))
        going = epochs[steady][~is_late]
        self._note(np.concatenate([[before], going]), np.diff(going, prepend=before), -1)
        late = steady[is_late]
        if late.size:
            fresh = np.flatnonzero(np.diff(late, prepend=-2) > 1)
            self.back += int(fresh.size)
            self.farthest_ns = max(self.farthest_ns, int(behind.max()))
            if self.first_record < 0:
                self.first_record, self.first_ns = first_record + int(late[0]), int(epochs[late[0]])
        usable = self._fit(epochs[late])
        refused = np.setdiff1d(late[~usable], twice)
        self.moved += int(np.setdiff1d(late[usable], twice).size)
        self.refused += int(refused.size)
        out = [(np.flatnonzero(leaping), LEAP)] if leaping.any() else []
        return [*out, (refused, RESTART if self.free else BACK)] if refused.size else out

    def _leaping(self, epochs: Int64) -> Bool:
        """Return which rows (n,) have stamps that jump forward and return to where the log's rate leads."""
        leaping = np.zeros(epochs.size, dtype=bool)
        returns = np.flatnonzero(np.diff(epochs) < 0)
        if not self._usual_ns or returns.size > _MOST_LEAPS:
            return leaping
        for at in returns.tolist():
            back = at + 1
            steady = np.flatnonzero(~leaping[:back] & (epochs[:back] <= epochs[back]))
            start = int(steady[-1]) + 1 if steady.size else 0
            from_ns = int(epochs[start - 1]) if start else self._top_ns
            if from_ns is None or from_ns > epochs[back] or start == back:
                continue
            due_ns = (back - start + 1) * self._usual_ns
            went_ns, leapt_ns = int(epochs[back]) - from_ns, int(epochs[start]) - from_ns
            if leapt_ns > LEAP_NS and went_ns < 2 * due_ns + self._jump_ns and went_ns * 4 > due_ns:
                leaping[start:back] = True
        return leaping

    @property
    def _jump_ns(self) -> int:
        return max(_JUMP_NS, _JUMP_PERIODS * self._usual_ns)

    def _fit(self, epochs: Int64) -> Bool:
        """Return which epochs (n,) lie in a gap of the log or before its first row."""
        early = (epochs < self._start_ns) & (not self.free)
        if not self._gaps:
            return early
        starts, ends = np.array(self._gaps, dtype=np.int64).T
        gap = np.searchsorted(starts, epochs) - 1
        return np.asarray(early | ((gap >= 0) & (epochs < ends[gap])))

    def _note(self, series: Int64, steps: Int64, first_record: int) -> None:
        """Record the steps of rows in order; `first_record` is −1 where record numbers are not consecutive."""
        self._top_ns = int(series[-1])
        wide = np.flatnonzero(steps > _GAP_PERIODS * self._usual_ns)
        self._gaps += zip(series[wide].tolist(), series[wide + 1].tolist(), strict=True)
        del self._gaps[:-_MOST_GAPS]
        if self.even and first_record >= 0 and self._usual_ns:
            far = wide[steps[wide] > self._jump_ns]
            self.jumps += [(first_record + int(k), int(series[k + 1]), int(steps[k])) for k in far]

    def _twice(self, batch: pa.RecordBatch, epochs: Int64) -> Int64:
        """Return the rows that equal the row before them."""
        same = np.flatnonzero(np.diff(epochs) == 0) + 1
        joint = batch
        if self._last is not None and self._top_ns == epochs[0] and self._last.schema.equals(batch.schema):
            joint = pa.concat_batches([self._last, batch])
            same = np.concatenate([[0], same]) + 1
        if not same.size:
            return same
        later, earlier = joint.take(pa.array(same)), joint.take(pa.array(same - 1))
        equal = np.ones(same.size, dtype=bool)
        for a, b in zip(later.columns, earlier.columns, strict=True):
            equal &= _equal(a, b)
        return np.asarray(same[equal] - (joint.num_rows - batch.num_rows), dtype=np.int64)


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count:,} times"


def _equal(a: pa.Array, b: pa.Array) -> Bool:
    """Return whether values (n,) are equal; missing values equal each other."""
    if pa.types.is_nested(a.type):
        return _equal_lists(a, b)
    same = pc.fill_null(pc.equal(a, b), False)
    missing = pc.and_(pc.is_null(a, nan_is_null=True), pc.is_null(b, nan_is_null=True))
    return np.asarray(pc.or_(same, missing).to_numpy(zero_copy_only=False), dtype=bool)


def _equal_lists(a: pa.Array, b: pa.Array) -> Bool:
    """Return whether lists of numbers are equal; lists of varying length or with missing numbers count as different."""
    lengths = {*pc.unique(pc.list_value_length(a)).to_pylist(), *pc.unique(pc.list_value_length(b)).to_pylist()}
    if len(lengths) > 1 or None in lengths:
        return np.zeros(len(a), dtype=bool)
    left, right = (one.flatten().to_numpy(zero_copy_only=False).reshape(len(a), -1) for one in (a, b))
    return np.asarray((left == right).all(axis=1))


@dataclass
class _Returns:
    """Chunks of returns; within a chunk they are in no order of time."""

    _top_ns: int | None = None
    _back: int = 0
    _farthest_ns: int = 0

    def take(self, batch: pa.RecordBatch) -> None:
        """Compare a chunk with the chunks before it."""
        ends = pc.min_max(batch.column("epoch_gps_ns")).as_py() if "epoch_gps_ns" in batch.schema.names else {}
        last_ns = ends.get("max")
        if last_ns is None:
            return
        if self._top_ns is not None and last_ns < self._top_ns - _JUMP_NS:
            self._back += 1
            self._farthest_ns = max(self._farthest_ns, self._top_ns - last_ns)
        self._top_ns = max(last_ns, self._top_ns or last_ns)

    def findings(self) -> Iterator[Finding]:
        """Yield a finding where whole chunks precede others that were recorded earlier."""
        if self._back:
            yield TIME_GOES_BACK.finds(
                "",
                f"its returns lie up to {self._farthest_ns / NS_PER_S:.3f} s before others that precede them in the "
                f"file ({self._back:,} chunks): parts were joined in another order, or a clock was set; all are used",
            )


@dataclass
class EpochOrder(LogCheck):
    """Checks the epochs of one log, table by table, in the order of its files."""

    free: bool
    """The log's clock counts from an unknown instant."""
    _series: dict[tuple[str, str, str], _Series] = field(default_factory=dict)
    _returns: _Returns = field(default_factory=_Returns)

    def refused(self, rows: Rows) -> list[tuple[Int64, str]]:
        """Return the rows of a chunk (by index) that are left out, with reasons."""
        _, batch = rows.stored
        if rows.table == "returns" and batch.num_rows:
            self._returns.take(batch)
        epochs = epochs_in(rows, _ORDERED)
        if epochs is None:
            return []
        wheel = str(batch.column("wheel")[0]) if "wheel" in batch.schema.names else ""
        key = (rows.table, rows.file, wheel)
        series = self._series.setdefault(key, _Series(self.free, rows.table in _EVEN))
        return series.take(epochs, batch, rows.first_record)

    def finish(self, writer: LogWriter, header: LogHeader) -> None:
        """Report what is doubtful about the log's time."""
        writer.findings += self._findings()

    def _findings(self) -> Iterator[Finding]:
        yield from self._returns.findings()
        for (table, file, wheel), series in self._series.items():
            where = "".join([f" of {file}" if file else "", f" of wheel {wheel}" if wheel else ""])
            if series.back:
                yield TIME_GOES_BACK.finds("", f"in its {table}{where} {series.backward}", series.refused)
            if series.jumps:
                yield TIME_JUMPS.finds("", f"in its {table}{where} {series.forward}")


STAMPED: Final = ("scans", "imu", "encoder", "gnss")
"""Tables in which each row has a time. Returns of one sweep may share theirs."""


ONE_STAMP: Final = Witness(
    "one_stamp",
    input="any log with a stamp a row",
    fault="The clock that stamps the rows stands still: all that they measured lies on one line.",
    asks="the stamps of neighbouring rows",
    does="rows after the first of a stretch of ten or more of one stamp are left out; a log of which that is more than "
    "half fails",
    told=("error", "rejects", "findings"),
)

VERSION: Final = 1
"""Raised when other rows are left out, so that logs with one stamp per row are read again."""
LEAST_ROWS: Final = 10
"""Consecutive rows with one stamp from which it is no rounding that a survey can use."""
STANDS: Final = "the clock stands: the row has the stamp of the rows before it"


class StandingClock(LogCheck):
    """Leaves out rows whose clock stood still, except the first of each run of equal stamps."""

    def __init__(self) -> None:
        self._before: dict[tuple[str, str], tuple[int, int]] = {}
        """Epoch of the last row of a table and file, and how many rows before it had that epoch."""

    def refused(self, rows: Rows) -> list[Refused]:
        """Return the rows of a chunk (by index) that are left out."""
        epochs = epochs_in(rows, STAMPED)
        if epochs is None:
            return []
        epoch, before = self._before.get((rows.table, rows.file), (int(epochs[0]), 0))
        starts = np.flatnonzero(np.diff(epochs, prepend=epoch - 1))  # the first row follows none
        lengths = np.diff(starts, append=epochs.size)
        carried = np.zeros(starts.size, np.int64)
        carried[0] = before if epochs[0] == epoch else 0
        stands = np.repeat(lengths + carried >= LEAST_ROWS, lengths)
        stands[starts[carried == 0]] = False
        self._before[rows.table, rows.file] = int(epochs[-1]), int(lengths[-1] + carried[-1])
        return [(np.flatnonzero(stands), STANDS)] if stands.any() else []


def one_stamp_logs(records: Sequence[LogRecord]) -> list[Fault]:
    """Return a fault for logs of which most rows have the stamp of their neighbours."""
    return [_fault(r, table) for r in records for table in STAMPED if r.tables.get(table) and _stands(r, table)]


def one_stamp_findings(records: Sequence[LogRecord]) -> list[Finding]:
    """Return findings for logs of which some rows were left out because their clock stood still."""
    return [
        ONE_STAMP.finds(
            r.path,
            f"{counted(left_out, 'row')} of {r.rows + left_out:,} carry the stamp of those before, and would lie "
            "on one line; they are left out: see to what stamps them",
            left_out,
        )
        for r in records
        if (left_out := r.reject_reasons.get(STANDS, 0))
    ]


def _stands(record: LogRecord, table: str) -> bool:
    """Return whether the clock stood for most left-out rows, or (in a first look) for all remaining ones."""
    return record.reject_reasons.get(STANDS, 0) > record.rows or _all_stand(record.tables.get(table, ()))


def _all_stand(files: Sequence[DataFile]) -> bool:
    """Return whether each row group of several rows has one stamp, and there is one; single rows are ignored."""
    groups = 0
    for file in files:
        several, (first, last) = np.array(file.group_rows) > 1, np.array(file.group_spans).T
        if (first != last)[several].any():
            return False
        groups += int(several.sum())
    return groups > 0


def _fault(record: LogRecord, table: str) -> Fault:
    (first, _), count = record.span(table) or (0, 0), record.rows + record.reject_reasons.get(STANDS, 0)
    reason = TimeSystemError(
        f"its {count:,} {table} carry one stamp for many rows ({iso_from_gps_ns(first)} at first), so they would lie "
        "on one line",
        expected="a time of its own for each",
        change="see to what stamps them: a clock that stands still, or stamps that were rounded",
    )
    return Fault((record.key,), record.path, str(reason))
