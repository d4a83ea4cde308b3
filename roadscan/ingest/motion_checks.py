"""Checks for a log whose poses contradict one another, and for a scanner that repeats its profiles."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.core.counted import counted
from roadscan.core.gpstime import NS_PER_S, iso_from_gps_ns
from roadscan.core.witness import Finding, Witness
from roadscan.ingest.log_check import LogCheck
from roadscan.ingest.pose_checks import POSES, PoseRecords, pose_track
from roadscan.ingest.reading.format import LogHeader, Rows
from roadscan.poses.motion import PoseMotion, Same
from roadscan.store.writer import LogWriter

POSE_COURSE: Final = Witness(
    "pose_course",
    input="trajectory",
    fault="Heading or pitch is turned, of the wrong sign, zero, or exchanged with roll; axes or north are wrong.",
    asks="the course over ground where the vehicle drives straight, and the slope of its path: a vehicle drives along "
    "its body's forward axis",
    does="the difference is named with its size; all poses are used, since a unit may be mounted turned",
    told=("findings",),
)
POSE_CONSTANT: Final = Witness(
    "pose_constant",
    input="trajectory",
    fault="Height or an angle is one and the same while the vehicle drives: a column was not exported, or stood still.",
    asks="the values themselves: those of an instrument change from pose to pose",
    does="the value is named with its span; all poses are used",
    told=("findings",),
)
POSE_SPEED: Final = Witness(
    "pose_speed",
    input="trajectory",
    fault="Stamps run too fast or too slow, or positions are scaled.",
    asks="the velocities that the log states, times the time between its stamps",
    does="the ratio is named; all poses are used, since nothing shows which of them is right",
    told=("findings",),
)
POSE_SPACING: Final = Witness(
    "pose_spacing",
    input="trajectory",
    fault="Poses are too far apart for the path between them.",
    asks="the stated velocities at both ends, or else poses that are left out and found again from the others",
    does="the error in the middle between two poses is named where it exceeds the stated σ; all poses are used",
    told=("findings",),
)
POSE_SIGMA: Final = Witness(
    "pose_sigma",
    input="trajectory",
    fault="The σ of the poses is 0, or covers a part of the drive only.",
    asks="the stated σ of all poses of the log",
    does="the poses are used; their number, and the longest span without a σ, are named",
    told=("findings",),
)

_BLOCK: Final = 50_000
"""Poses that are examined together."""
_LEAST_BETWEEN_M: Final = 0.005
"""Least error between poses (m) that is reported: smaller ones are below the accuracy of a trajectory."""
_POINTING: Final = 0.8
"""Below this ratio, velocities differ less in size than in direction, by 37° or more."""
_LEAST_BARE_S: Final = 2.0
"""Least span without σ (s) that is reported: files of σ, one a second, may start and end a second beside the poses."""
_SIGMAS: Final = ("sigma_north_m", "sigma_east_m", "sigma_down_m")
_NONE: Final = np.zeros(0, np.int64)  # no epochs without a fix


@dataclass(frozen=True)
class MotionCheck(LogCheck):
    """Checks whether the poses of a log contradict each other."""

    records: PoseRecords

    def finish(self, writer: LogWriter, header: LogHeader) -> None:
        """Report contradictions; all poses are kept."""
        world = str(header.attributes.get("world_frame"))
        motion, sigma = PoseMotion(world), _Stated()
        for rows in writer.tables(POSES):
            for start in range(0, rows.num_rows, _BLOCK):
                block = rows.slice(start, _BLOCK)
                motion.take(pose_track(block, world, _NONE, self.records.velocities))
                sigma.take(block)
        writer.findings += _course(motion)
        writer.findings += _constant(motion.same())
        writer.findings += [*_speed(motion), *_spacing(motion), *sigma.findings()]


def _course(motion: PoseMotion) -> Iterator[Finding]:
    """Yield findings on heading against course, and pitch against slope."""
    if (heading := motion.heading()) is not None:
        why = "the heading, its north or the axes of the log are wrong, or the unit is mounted turned"
        if heading.is_mounted is not None:
            why = "the body's forward axis rises with the road, so that the heading or its north is wrong"
        if heading.is_mounted:
            why = (
                "another axis rises with the road, so that the unit is mounted turned, or the axes of the log are wrong"
            )
        mounted = (
            "" if heading.is_mounted is False else ", which is right where all mountings are stated along its axes"
        )
        yield POSE_COURSE.finds(
            "",
            f"the heading is {np.degrees(heading.off_rad):+.1f}° off the course over ground (median of "
            f"{heading.way_m:,.0f} m of straight driving, scatter {np.degrees(heading.scatter_rad):.1f}°), and a "
            f"vehicle drives along its body's forward axis: {why}{mounted}; all poses are used, and a reading 5 m away "
            f"lies up to {10 * abs(np.sin(heading.off_rad / 2)):.2f} m off",
        )
    if (pitch := motion.pitch()) is not None:
        why = "its sign is wrong" if pitch.followed < -0.5 else "one of pitch and height is wrong"
        if pitch.roll_followed:
            why = f"roll does ({pitch.roll_followed:+.2f} times): the two are exchanged"
        yield POSE_COURSE.finds(
            "",
            f"the pitch does not follow the slope of the path: it changes by {pitch.followed:+.2f} (σ "
            f"{pitch.sigma:.2f}) times the slope, which varies by {np.degrees(pitch.slope_rad):.2f}° over "
            f"{pitch.way_m:,.0f} m, and that of a vehicle by 1; {why}; all poses are used",
        )


def _constant(same: Sequence[Same]) -> Iterator[Finding]:
    """Yield findings on values that do not change, grouped by span."""
    spans: dict[tuple[int, int, int], list[Same]] = {}
    for one in same:
        spans.setdefault((one.first_gps_ns, one.last_gps_ns, one.poses), []).append(one)
    for each in spans.values():
        one = each[0]
        values = [f"the {x.value}" for x in each]
        names = " and ".join([", ".join(values[:-1]), values[-1]] if len(values) > 1 else values)
        verb = "is" if len(each) == 1 else "are"
        where = (
            f"in all {one.poses:,} poses"
            if one.everywhere
            else f"in {counted(one.poses, 'pose')} that repeat, the most from {iso_from_gps_ns(one.first_gps_ns)} to "
            f"{iso_from_gps_ns(one.last_gps_ns)}"
        )
        yield POSE_CONSTANT.finds(
            "",
            f"{names} {verb} one and the same {where}, while the vehicle drives {one.way_m:,.0f} m: no instrument "
            "gives that, a column was not exported or stood still; all poses are used",
        )


def _speed(motion: PoseMotion) -> Iterator[Finding]:
    if (scale := motion.scale()) is None:
        return
    if not np.isfinite(scale.ratio):
        text = f"the stated velocities are 0, and the positions go {scale.way_m:,.0f} m; all poses are used"
    elif scale.ratio < _POINTING:
        text = (
            f"the stated velocities point elsewhere than the positions go: along them these go {scale.ratio:.2f} times "
            f"as far ({scale.way_m:,.0f} m): axes or signs of the velocities are wrong; all poses are used"
        )
    else:
        text = (
            f"the positions go {scale.ratio:.4f} times as far as the stated velocities say ({scale.way_m:,.0f} m): the "
            "stamps run too fast or too slow, or positions or velocities are scaled; which is wrong nothing shows, and "
            "all poses are used"
        )
    yield POSE_SPEED.finds("", text)


def _spacing(motion: PoseMotion) -> Iterator[Finding]:
    found = motion.between()
    if found is None or float(np.hypot(*found.error_m)) < max(found.sigma_m, _LEAST_BETWEEN_M):
        return
    stated = f"stated σ {1e3 * found.sigma_m:.1f} mm" if found.sigma_m else "no σ is stated"
    yield POSE_SPACING.finds(
        "",
        f"the poses are {found.step_s:.3g} s apart, and the path in the middle between two of them is uncertain by "
        f"about {1e3 * found.error_m[0]:.0f} mm horizontally and {1e3 * found.error_m[1]:.0f} mm in height (1 σ; "
        f"{stated}), which no σ of the products contains; export more poses a second",
    )


@dataclass
class _Stated:
    """Finds which poses of a log state a σ."""

    poses: int = 0
    bare: int = 0
    zero: int = 0
    longest: tuple[int, int] = (0, 0)
    """Epochs of the longest span without σ."""
    open_from: int | None = field(default=None)
    """Epoch since which no σ was stated."""

    def take(self, rows: pa.Table) -> None:
        """Examine a block of poses."""
        epochs = rows.column("epoch_gps_ns").to_numpy()
        values = np.stack([rows.column(name).to_numpy(zero_copy_only=False) for name in _SIGMAS], axis=-1)
        bare: npt.NDArray[np.bool_] = np.asarray(np.isnan(values.astype(np.float64)).any(axis=1))
        self.poses += epochs.size
        self.bare += int(bare.sum())
        self.zero += int((values == 0).all(axis=1).sum())
        for at in np.flatnonzero(np.diff(bare.astype(np.int8), prepend=int(self.open_from is not None))).tolist():
            if bare[at]:
                self.open_from = int(epochs[at])
            elif self.open_from is not None:
                self._close(int(epochs[at]))
        if self.open_from is not None and epochs.size:
            self._keep(self.open_from, int(epochs[-1]))

    def findings(self) -> Iterator[Finding]:
        """Yield findings on zeros, and on spans without σ in a log that states some."""
        if self.zero:
            yield POSE_SIGMA.finds(
                "",
                f"the stated σ of the position is 0 in {self.zero:,} of {counted(self.poses, 'pose')}, which no "
                "instrument reaches: the σ of what is made of them is too small; all poses are used",
            )
        span_s = (self.longest[1] - self.longest[0]) / NS_PER_S
        if 0 < self.bare < self.poses and span_s > _LEAST_BARE_S:
            first, last = (iso_from_gps_ns(one) for one in self.longest)
            yield POSE_SIGMA.finds(
                "",
                f"{self.bare:,} of {counted(self.poses, 'pose')} have no stated σ, for {span_s:,.1f} s from {first} to "
                f"{last} at the longest, and the others have one: there, defaults are used; all poses are used",
            )

    def _close(self, epoch: int) -> None:
        if self.open_from is not None:
            self._keep(self.open_from, epoch)
        self.open_from = None

    def _keep(self, first: int, last: int) -> None:
        if last - first > self.longest[1] - self.longest[0]:
            self.longest = first, last


REPEATED_PROFILES: Final = Witness(
    "repeated_profiles",
    input="profiler",
    fault="The scanner is stuck, or sends a buffer again: the vehicle moves on, and the profile does not.",
    asks="the profile before: no two differ by nothing, since each reading has noise of its own",
    does="the profiles are used; their number and the time of the first are named",
    told=("findings",),
)

LEAST_REPEATS: Final = 3
"""Consecutive repeats from which they are no coincidence: a coarse scanner at a standstill repeats some."""
_SAMPLED: Final = 8
"""Readings of a profile that are compared first: most profiles differ in one of them."""


class RepeatedProfiles(LogCheck):
    """Counts repeated profiles of a log while it streams, in file order."""

    def __init__(self) -> None:
        self._last: npt.NDArray[np.generic] | None = None
        self._in_row = 0
        self._repeats = 0
        self._first_gps_ns = 0
        self._began_gps_ns = 0

    def take(self, rows: Rows, refused: Sequence[npt.NDArray[np.int64]]) -> None:
        """Take the next rows of the table `scans`."""
        if rows.table != "scans":
            return
        batch = rows.batch
        column = batch.column("range")
        if not batch.num_rows or not pa.types.is_fixed_size_list(column.type):
            return
        ranges = column.flatten().to_numpy(zero_copy_only=False).reshape(batch.num_rows, -1)
        epochs = batch.column("epoch_gps_ns").to_numpy(zero_copy_only=False)
        before = ranges[:1] if self._last is None else self._last[None]
        same = _equal_rows(np.concatenate([before, ranges[:-1]]), ranges)
        same[0] &= self._last is not None
        for row in np.flatnonzero(same | np.concatenate([[self._in_row > 0], same[:-1]])):
            self._count(bool(same[row]), int(epochs[row]))
        self._last = ranges[-1].copy()

    def finish(self, writer: LogWriter, header: LogHeader) -> None:
        """Report how many profiles repeat."""
        self._count(repeats=False, epoch_gps_ns=0)
        if not self._repeats:
            return
        text = (
            f"{counted(self._repeats, 'profile')} equal the one before, reading by reading, for the first time at "
            f"{iso_from_gps_ns(self._first_gps_ns)}: the scanner was stuck, or a buffer was sent again; they are used, "
            "and show the road where it was not measured"
        )
        writer.findings.append(REPEATED_PROFILES.finds("", text))

    def _count(self, repeats: bool, epoch_gps_ns: int) -> None:
        if repeats:
            self._began_gps_ns = self._began_gps_ns if self._in_row else epoch_gps_ns
            self._in_row += 1
            return
        if self._in_row >= LEAST_REPEATS:
            self._first_gps_ns = self._first_gps_ns or self._began_gps_ns
            self._repeats += self._in_row
        self._in_row = 0


def _equal_rows(before: npt.NDArray[np.generic], after: npt.NDArray[np.generic]) -> npt.NDArray[np.bool_]:
    """Return which rows (n,) of two arrays (n, k) are equal and not all of one value."""
    columns = np.linspace(0, after.shape[1] - 1, _SAMPLED).astype(int)
    same: npt.NDArray[np.bool_] = (before[:, columns] == after[:, columns]).all(axis=1)
    rows = np.flatnonzero(same)
    same[rows] = (before[rows] == after[rows]).all(axis=1) & (after[rows] != after[rows, :1]).any(axis=1)
    return same
