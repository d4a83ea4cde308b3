"""Leaves out poses and GNSS positions that no vehicle can have taken, and reports steps of them.

This needs all rows of the log in order of time: readers stream, and a pose is only seen to be wrong by
those that follow it. No row is changed; one that is left out is a reject of its record. Velocities that a log states
are kept until then, and stored in no table.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.counted import counted
from roadscan.core.crs import LOCAL_WORLD
from roadscan.core.gpstime import NS_PER_S, iso_from_gps_ns
from roadscan.core.witness import Finding, Witness
from roadscan.ingest.log_check import LogCheck
from roadscan.ingest.place_checks import NO_FIX, without_fix
from roadscan.ingest.reading.format import LogHeader, Rows
from roadscan.ingest.reading.gnss import ned_from_ecef
from roadscan.poses.leaps import Leaps, PoseTrack, Stall, Step, find_leaps
from roadscan.poses.motion import frozen
from roadscan.store.writer import LogWriter

VERSION: Final = 3
"""Raised when other poses are left out, so that logs of trajectories and of GNSS are read again."""

POSE_LEAP: Final = Witness(
    "pose_leap",
    input="trajectory",
    fault="Some poses lie elsewhere or are turned: a false fix, a pose at latitude 0, longitude 0.",
    asks="the poses before and after, the stated velocities and σ, and the speed, acceleration and turning of which a "
    "vehicle is able",
    does="a pose that all of them exclude is left out; those about it bridge the gap up to navigation.max_gap_s",
    told=("rejects", "findings"),
)
POSE_FROZEN: Final = Witness(
    "pose_frozen",
    input="trajectory",
    fault="Poses stand still while the vehicle drives: the last one is written again and again.",
    asks="the poses before and after those that repeat to the bit, and the way that the vehicle drives meanwhile",
    does="poses that repeat are left out; those about them bridge the gap up to navigation.max_gap_s",
    told=("rejects", "findings"),
)
POSE_STEP: Final = Witness(
    "pose_step",
    input="trajectory",
    fault="Positions or angles step to another level and go on there, as where a fix is lost or found again.",
    asks="the motion before and after, the stated velocities and σ, and the acceleration and turning of which a "
    "vehicle is able",
    does="the step is named with its size and σ; all poses are used, since nothing shows which side is right",
    told=("findings",),
)
GNSS_LEAP: Final = Witness(
    "gnss_leap",
    input="gnss, imu, encoder",
    fault="GNSS positions leap: a false fix of the ambiguities, a reflected signal.",
    asks="the positions before and after, the stated velocities and σ, and the speed and acceleration of which a "
    "vehicle is able",
    does="positions that leap away and back are left out; a step after which they go on is named, and all are used",
    told=("rejects", "findings"),
)
POSE_STAMPS: Final = Witness(
    "pose_stamps",
    input="trajectory",
    fault="The clock of the poses is set forward within a log: a gap in time across which the vehicle hardly moves.",
    asks="the speeds before and after the gap, and the shortest way on which a vehicle brakes and drives off again",
    does="the jump is named with its size; all poses are used, since nothing shows which side is right",
    told=("findings",),
)

POSES, FIXES = "trajectory", "gnss"
"""Tables whose positions are checked."""
_NOUN: Final = {POSES: "pose", FIXES: "GNSS position"}
_GNSS_VELOCITY: Final = ("velocity_north_m_per_s", "velocity_east_m_per_s", "velocity_down_m_per_s")
_BLOCK: Final = 100_000
"""Most poses that are examined together: each takes about 500 bytes while links between poses are judged."""
_BESIDE: Final = 4_000
"""Poses of the blocks before and after that are examined together with those of a block."""
_NO_FIX_SHARE: Final = 0.5
"""If more poses lie at latitude 0, longitude 0, it is the place of the survey (a simulated one)."""
_NAMED: Final = 3
"""Largest steps that are listed."""

_ELSEWHERE: Final = "the position leaps away from the ones before and after it, as no vehicle moves"
_FROZEN: Final = "position and attitude repeat those of the pose before to the bit, while the vehicle drives on"
_TURNED: Final = "the attitude leaps away from the poses before and after it, as no vehicle turns"


@dataclass
class PoseRecords(LogCheck):
    """The records of a log's poses or GNSS positions, and the velocities that the log states."""

    _parts: list[tuple[str, Int64, Int64, Int64]] = field(default_factory=list)
    _velocities: list[npt.NDArray[np.float32]] = field(default_factory=list)

    def take(self, item: Rows, refused: Sequence[Int64]) -> None:
        """Store epochs, records and velocities of rows with positions, except the refused ones."""
        if item.table not in _NOUN or not item.batch.num_rows:
            return
        count = item.batch.num_rows
        kept = np.ones(count, dtype=bool)
        for rows in refused:
            kept[rows] = False
        epochs = item.batch.column("epoch_gps_ns").to_numpy()
        self._parts.append((item.file, epochs[kept], item.numbers[kept], item.offsets[kept]))
        if item.velocity_level_m_per_s is not None:
            self._velocities.append(item.velocity_level_m_per_s[kept])

    def finish(self, writer: LogWriter, header: LogHeader) -> None:
        """Leave out the positions that no vehicle can have taken."""
        for table in _NOUN:
            if writer.rows[table]:
                check_poses(writer, table, str(header.attributes["world_frame"]), self)
                writer.finish()

    @cached_property
    def velocities(self) -> tuple[Int64, npt.NDArray[np.float32]] | None:
        """Epochs, ascending, and velocities (n, 3) north, east, down of a log of which each row states one; once it is
        read.
        """
        epochs = np.concatenate([np.zeros(0, np.int64), *(own for _, own, _, _ in self._parts)])
        velocities = np.concatenate([np.zeros((0, 3), np.float32), *self._velocities])
        if not epochs.size or len(velocities) != epochs.size:
            return None
        order = np.argsort(epochs, kind="stable")
        return epochs[order], velocities[order]

    def of(self, epochs: Int64) -> Iterator[tuple[str, int, int, int]]:
        """Yield file, record, offset and epoch of each pose with one of these epochs, in the order of the log."""
        for file, own, records, offsets in self._parts:
            for k in np.flatnonzero(np.isin(own, epochs)).tolist():
                yield file, int(records[k]), int(offsets[k]), int(own[k])


def check_poses(writer: LogWriter, table: str, world: str, records: PoseRecords) -> None:
    """Leave positions that no vehicle can have taken out of a finished log; they become rejects and findings.

    Parameters
    ----------
    table : `POSES` or `FIXES`.
    """
    found = _Found(table)
    no_fix = _without_fix(writer, world) if table == POSES else np.zeros(0, np.int64)
    reading = _Reading(world, no_fix, records.velocities)
    for epochs, leaps, stuck in _judged(writer, table, reading):
        found.add(epochs, leaps)
        found.reasons |= dict.fromkeys(stuck.tolist(), _FROZEN)
    out = np.union1d(no_fix, np.array(sorted(found.reasons), dtype=np.int64))
    told = list(records.of(out))
    for file, record, offset, epoch in told:
        writer.reject(file, record, offset, 1, found.reasons.get(epoch, NO_FIX))
    if out.size:
        writer.leave_out(table, lambda rows: np.isin(rows.column("epoch_gps_ns").to_numpy(), out))
    writer.findings += found.findings(told)


@dataclass
class _Found:
    """Faults of a log's poses, or GNSS positions, over all of its files."""

    table: str
    reasons: dict[int, str] = field(default_factory=dict)
    """Epoch (GPS ns) of each pose to leave out, and why."""
    largest: dict[str, tuple[float, int]] = field(default_factory=dict)
    """Size (m, rad) and epoch of the largest leap, by reason."""
    steps: list[tuple[int, Step]] = field(default_factory=list)
    covered: list[tuple[int, Step]] = field(default_factory=list)
    stalls: list[tuple[int, Stall]] = field(default_factory=list)

    def add(self, epochs: Int64, leaps: Leaps) -> None:
        """Add the faults of a file."""
        for mask, size, reason in (
            (leaps.position, leaps.shift_m, _ELSEWHERE),
            (leaps.attitude, leaps.turn_rad, _TURNED),
        ):
            for k in np.flatnonzero(mask).tolist():
                self.reasons[int(epochs[k])] = reason
                self.largest[reason] = max(self.largest.get(reason, (0.0, 0)), (float(size[k]), int(epochs[k])))
        self.steps += [(int(epochs[one.after]), one) for one in leaps.steps]
        self.covered += [(int(epochs[one.after]), one) for one in leaps.covered]
        self.stalls += [(int(epochs[one.after]), one) for one in leaps.stalls]

    def findings(self, told: Sequence[tuple[str, int, int, int]]) -> list[Finding]:
        """Return one finding for the poses that were left out, and one for each kind of steps."""
        found: list[Finding] = []
        record_of = {epoch: record for _, record, _, epoch in told}
        for reason, (size, epoch) in sorted(self.largest.items()):
            count = sum(self.reasons[one] == reason for *_, one in told)
            is_place = reason == _ELSEWHERE
            who = self._counted(count, *(("lies", "lie") if is_place else ("is turned", "are turned")))
            by = f"{size:,.2f} m" if is_place else f"{np.degrees(size):.2f}°"
            text = (
                f"{who} up to {by} off the motion of the {_NOUN[self.table]}s before and after, the worst at "
                f"{iso_from_gps_ns(epoch)} (record {record_of[epoch]:,}); left out"
            )
            if self.table == FIXES:
                found.append(GNSS_LEAP.finds("", text, count))
                continue
            text += ", and bridged by the others where these are within navigation.max_gap_s"
            found.append(POSE_LEAP.finds("", text, count))
        if stuck := [(epoch, record) for _, record, _, epoch in told if self.reasons.get(epoch) == _FROZEN]:
            text = (
                f"{self._counted(len(stuck), 'repeats', 'repeat')} the one before to the bit in position and attitude, "
                f"while the vehicle drives on, the first at {iso_from_gps_ns(stuck[0][0])} (record {stuck[0][1]:,}); "
                "left out, and bridged by the others where these are within navigation.max_gap_s"
            )
            found.append(POSE_FROZEN.finds("", text, len(stuck)))
        if no_fix := len(told) - sum(one in self.reasons for *_, one in told):
            first = next(record for _, record, _, epoch in told if epoch not in self.reasons)
            who = self._counted(no_fix, "lies", "lie")
            text = f"{who} at latitude 0, longitude 0, the first in record {first:,}: there was no fix; left out"
            found.append(POSE_LEAP.finds("", text, no_fix))
        if self.steps:
            end = f"and go on there; which side is right nothing shows, and all {_NOUN[self.table]}s are used"
            step = POSE_STEP if self.table == POSES else GNSS_LEAP
            found.append(step.finds("", f"{_step_words(self.steps, _NOUN[self.table])}, {end}"))
        if self.covered and self.table == POSES:  # GNSS leaps within its σ wherever signals are reflected
            end = "which a vehicle does not do, and the stated σ allows; all poses are used"
            found.append(POSE_STEP.finds("", f"{_step_words(self.covered, _NOUN[self.table])}, {end}"))
        if self.stalls:
            found.append(POSE_STAMPS.finds("", _stall_words(self.stalls)))
        return found

    def _counted(self, count: int, one: str, many: str) -> str:
        """Return the number of poses or positions in words, with the verb."""
        return f"{counted(count, _NOUN[self.table])} {one if count == 1 else many}"


def _step_words(steps: Sequence[tuple[int, Step]], noun: str) -> str:
    """Return in words how often poses or positions step, and the largest steps."""
    largest = sorted(steps, key=lambda one: (-one[1].shift_m, -one[1].turn_rad, one[0]))[:_NAMED]
    words = ", ".join(f"by {_size_words(one)} at {iso_from_gps_ns(epoch)}" for epoch, one in largest)
    if len(steps) == 1:
        return f"the {noun}s step {words}"
    more = f", and {len(steps) - _NAMED:,} times more" if len(steps) > _NAMED else ""
    return f"the {noun}s step {len(steps):,} times: {words}{more}"


def _stall_words(stalls: Sequence[tuple[int, Stall]]) -> str:
    """Return in words how far the stamps jump, at the largest gap."""
    epoch, one = max(stalls, key=lambda stall: stall[1].gap_s)
    more = f", and {counted(len(stalls) - 1, 'time')} more" if len(stalls) > 1 else ""
    jump_s = one.gap_s - one.way_m / one.speed_m_per_s
    return (
        f"the stamps jump forward by about {jump_s:.3f} s at {iso_from_gps_ns(epoch)}{more}: the vehicle drives "
        f"{one.speed_m_per_s:.1f} m/s before and after, and moves {one.way_m:.2f} m in the {one.gap_s:.3f} s between, "
        f"where it needs {one.least_m:.1f} m to brake and drive off; a clock was set, which side is right nothing "
        "shows, and all poses are used"
    )


def _size_words(step: Step) -> str:
    size = f"{step.shift_m:,.2f} m" if step.shift_m else f"{np.degrees(step.turn_rad):.2f}°"
    return size + (f" (stated σ {step.sigma_m:.2f} m)" if step.sigma_m and step.shift_m else "")


def _without_fix(writer: LogWriter, world: str) -> Int64:
    """Return epochs of poses at latitude 0, longitude 0, or at the centre of the Earth."""
    if world == LOCAL_WORLD:
        return np.zeros(0, np.int64)
    found, total = list[Int64](), 0
    for rows in writer.tables(POSES, ["epoch_gps_ns", "x_world_m", "y_world_m", "z_world_m"]):
        position = np.stack([rows.column(f"{axis}_world_m").to_numpy() for axis in "xyz"], axis=-1)
        found.append(rows.column("epoch_gps_ns").to_numpy()[without_fix(position)])
        total += rows.num_rows
    epochs = np.concatenate([np.zeros(0, np.int64), *found])
    return epochs if epochs.size <= _NO_FIX_SHARE * total else np.zeros(0, np.int64)


class _Reading(NamedTuple):
    """How rows are converted to a track."""

    world: str
    no_fix: Int64
    """Epochs of poses without a position."""
    velocities: tuple[Int64, npt.NDArray[np.float32]] | None
    """Epochs and velocities of the log's rows, for a trajectory that states them."""


def _judged(writer: LogWriter, table: str, reading: _Reading) -> Iterator[tuple[Int64, Leaps, Int64]]:
    """Yield the result of :func:`_judge` for each block of poses, with the poses of the blocks before and after it."""
    window: list[pa.Table] = []
    for rows in itertools.chain(_blocks(writer, table), [None]):
        if len(window) > 0:
            before = [one.slice(max(one.num_rows - _BESIDE, 0)) for one in window[:-1]]
            after = [] if rows is None else [rows.slice(0, _BESIDE)]
            yield _judge(window[-1], pa.concat_tables([*before, window[-1], *after]), reading)
        window = [*window[-1:], *([] if rows is None else [rows])]


def _blocks(writer: LogWriter, table: str) -> Iterator[pa.Table]:
    """Yield the rows of each file of a table, in blocks of nearly the same size."""
    for rows in writer.tables(table):
        count = -(-rows.num_rows // _BLOCK)
        ends = [rows.num_rows * k // count for k in range(count + 1)]
        yield from (rows.slice(first, end - first) for first, end in itertools.pairwise(ends))


def _judge(own: pa.Table, rows: pa.Table, reading: _Reading) -> tuple[Int64, Leaps, Int64]:
    """Return epochs and leaps of the poses of a table, and epochs of frozen ones, given the poses around it."""
    first, last = (int(own.column("epoch_gps_ns")[k].as_py()) for k in (0, -1))
    track = pose_track(rows, *reading)
    still = frozen(track) if "qw" in rows.column_names else np.zeros(track.epochs_gps_ns.size, bool)
    stuck = track.epochs_gps_ns[still]
    track = track.of(~still)
    found, epochs = find_leaps(track), track.epochs_gps_ns
    inside = (epochs >= first) & (epochs <= last)
    steps, covered = (
        tuple(one for one in each if inside[one.after]) for each in (found.steps, found.covered)
    )  # fmt: skip
    stalls = tuple(one for one in found.stalls if inside[one.after])
    leaps = Leaps(
        found.position & inside, found.attitude & inside, found.shift_m, found.turn_rad, steps, covered, stalls
    )
    return epochs, leaps, stuck[(stuck >= first) & (stuck <= last)]


def pose_track(
    rows: pa.Table, world: str, no_fix: Int64, velocities: tuple[Int64, npt.NDArray[np.float32]] | None = None
) -> PoseTrack:
    """Return the positions of rows of `POSES` or `FIXES`, the first of each epoch, without those that have no fix.

    GNSS has no attitude: it is taken to be one and the same.
    """
    epochs = rows.column("epoch_gps_ns").to_numpy()
    placed = np.isfinite(rows.column("x_world_m").to_numpy(zero_copy_only=False))
    order = np.argsort(epochs, kind="stable")
    order = order[placed[order] & ~np.isin(epochs[order], no_fix)]
    own = order[np.diff(epochs[order], prepend=np.int64(-1)) > 0]

    def columns(*names: str) -> Float64:
        values = [rows.column(name).to_numpy(zero_copy_only=False) for name in names]
        found: Float64 = np.stack(values, axis=-1).astype(np.float64)[own]
        return found

    position, is_local = columns("x_world_m", "y_world_m", "z_world_m"), world == LOCAL_WORLD
    quaternion, sigma_rad, level = np.tile([1.0, 0.0, 0.0, 0.0], (own.size, 1)), np.zeros(own.size), None
    if "qw" in rows.column_names:
        quaternion = columns("qw", "qx", "qy", "qz")
        length = np.linalg.norm(quaternion, axis=1, keepdims=True)
        quaternion = quaternion / np.where(length > 0, length, 1.0)
        angles = np.nan_to_num(columns("sigma_roll_deg", "sigma_pitch_deg", "sigma_heading_deg"))
        sigma_rad = np.radians(np.linalg.norm(angles, axis=1))
        if velocities is not None:
            level = velocities[1][np.searchsorted(velocities[0], epochs[own])].astype(np.float64)
    elif set(_GNSS_VELOCITY) <= set(rows.column_names):
        level = columns(*_GNSS_VELOCITY)
    sigma_m = np.linalg.norm(np.nan_to_num(columns("sigma_north_m", "sigma_east_m", "sigma_down_m")), axis=1)
    velocity = None
    if level is not None and np.isfinite(level[:, 0]).any():
        velocity = _world_velocities(world, epochs[own], position, level)
    return PoseTrack(epochs[own], position, quaternion, sigma_m, sigma_rad, is_local, velocity)


def _world_velocities(world: str, epochs: Int64, position: Float64, level: Float64) -> Float64:
    """Return velocities (n, 3) in a world frame from north, east, down; a missing down is taken from the positions."""
    north, east = level[:, 0], level[:, 1]
    if world == LOCAL_WORLD:
        from_level = np.broadcast_to([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]], (len(level), 3, 3))
    else:
        from_level = ned_from_ecef(world, position.T).transpose(0, 2, 1)
    down = level[:, 2]
    if len(level) > 1 and np.isnan(down).any():
        rise = np.gradient(position, epochs / NS_PER_S - epochs[0] / NS_PER_S, axis=0)
        down = np.where(np.isnan(down), np.einsum("ij,ij->i", rise, from_level[:, :, 2]), down)
    found: Float64 = np.einsum("ijk,ik->ij", from_level, np.stack([north, east, down], axis=-1))
    return found
