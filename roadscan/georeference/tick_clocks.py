"""Compares the clocks of sensors that count wheel ticks with that of the poses: a record for each sensor and run."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Final, NamedTuple

import numpy as np

from roadscan.core.gpstime import NS_PER_S, iso_from_gps_ns
from roadscan.core.witness import Finding, Witness
from roadscan.georeference.plan.plan import SurveyPlan
from roadscan.georeference.sources import ReadingSource, read_rows
from roadscan.ingest.resolution import COARSE_VALUES
from roadscan.navigation.tasks.trajectories import TrajectorySource, load_recorded
from roadscan.navigation.wheel_ticks import (
    LEAST_SAMPLES,
    SAMPLES_PER_S,
    ClockJump,
    PoseWay,
    TickVerdict,
    WheelTicks,
    judge_ticks,
)
from roadscan.run.engine.compute import Compute, cut_bundles, run_bundles
from roadscan.run.keys import code_digest, key_of
from roadscan.run.stage import StageState
from roadscan.store.logs import DataFile, LogRecord
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.store import Store

PRODUCT: Final = "tick_clocks"
"""Name in the manifest of the result for a sensor in a run; it has no file."""

TICK_CLOCK: Final = Witness(
    "tick_clock",
    input="profiler, trajectory",
    fault="The clock of a sensor or of the poses steps, or is off as a whole.",
    asks="the wheel ticks that the sensor counts, against the distance that the poses travel in the same time",
    does="all readings are used; the step, or the offset with its σ, is named, and whose clock it is where several "
    "sensors of a run say the same",
    told=("findings",),
)

TICKS_STILL: Final = Witness(
    "ticks_still",
    input="profiler",
    fault="The wheel's ticks stand still while the vehicle drives: the encoder is not connected.",
    asks="the distance that the poses travel in the same time",
    does="all readings are used, and the clock of the sensor has no witness in this run: that is named",
    told=("findings",),
)

_COLUMNS: Final = ["epoch_gps_ns", "encoder_ticks"]
_PAD_NS: Final = 25 * NS_PER_S
"""Poses are read this far beyond the readings: a clock may be off by up to 20 s."""
_STRETCH_NS: Final = 600 * NS_PER_S
"""Profiles of this length of time are compared at once, which bounds memory."""
_BUNDLE_ROWS: Final = 50_000_000
"""Least number of rows of which a task reads two columns."""
_SAME_NS: Final = NS_PER_S // 10
"""Steps of two sensors that lie closer in time count as one step of the poses."""
_SAME_SHARE: Final = 0.2
"""Two sizes that differ by a smaller share count as equal."""
_COARSE_M: Final = 1.0
"""Smaller steps along the way are attributed to the poses where their positions or stamps are coarse."""
_NAMED: Final = 3
"""Most steps that a finding names, the largest first."""


@dataclass(frozen=True)
class TickTask:
    """Profiles of a log; it holds no data."""

    unit: str
    """Its name in the manifest."""

    store: Store
    source: ReadingSource
    poses: TrajectorySource
    files: tuple[DataFile, ...]
    max_gap_s: float
    key: str

    @property
    def rows(self) -> int:
        """Number of profiles."""
        return sum(file.rows for file in self.files)


def check_tick_clocks(
    plan: SurveyPlan, manifest: Manifest, compute: Compute, report: Callable[[int, int], None]
) -> list[tuple[str, str]]:
    """Compare ticks with poses where that was not done; return what failed."""
    tasks = _tasks(plan)
    manifest.remove(manifest.beside([PRODUCT], {task.unit for task in tasks}))
    stale = [task for task in tasks if not manifest.is_current(PRODUCT, task.unit, task.key)]
    failed = run_bundles(tick_clock, stale, lambda task: task.rows, _BUNDLE_ROWS, manifest, compute, report)
    return [(task.unit, reason) for task, reason in failed]


def tick_state(plan: SurveyPlan, manifest: Manifest, workers: int) -> StageState:
    """Sensors of runs whose ticks are compared with poses, and those whose are to be."""
    tasks = _tasks(plan)
    state = StageState.of(manifest, [(PRODUCT, task.unit, task.key) for task in tasks])
    due = [task.rows for task in tasks if not manifest.is_current(PRODUCT, task.unit, task.key)]
    state.tasks = len(cut_bundles(due, _BUNDLE_ROWS, workers))
    return state


def _tasks(plan: SurveyPlan) -> list[TickTask]:
    code = code_digest("roadscan.georeference.tick_clocks:tick_clock")
    tasks: list[TickTask] = []
    logs: Counter[str] = Counter()
    for source, files in plan.sources:
        if source.table != "scans" or source.trajectory is None:
            continue
        sensor = f"{source.run}/{source.sensor}"
        logs[sensor] += 1  # of a sensor that wrote several logs in a run, the others have a number
        tasks.append(
            TickTask(
                sensor if logs[sensor] == 1 else f"{sensor}/{logs[sensor]}", plan.store, source, source.trajectory,
                tuple(sorted(files, key=lambda file: file.span or (0, 0))), plan.ground.max_gap_s,
                key_of(code, source.key, [file.digest for file in files]),
            )
        )  # fmt: skip
    return tasks


def tick_clock(task: TickTask) -> OutputRecord:
    """Compare the ticks of a sensor with the poses of a run (runs on a worker)."""
    verdicts = [
        judge_ticks(wheel, _poses(task, wheel))
        for files in _stretches(task.files)
        if (wheel := _wheel(task, files)).epochs_gps_ns.size >= LEAST_SAMPLES
    ]
    detail = {"run": task.source.run, "file": task.files[0].path, **_figures(verdicts)}
    return OutputRecord(PRODUCT, task.unit, task.key, "", 0, "", json.dumps(detail))


def _stretches(files: Sequence[DataFile]) -> Iterator[list[DataFile]]:
    """Yield groups of consecutive data files; each group begins with the last file of the group before."""
    own: list[DataFile] = []
    for file in files:
        span = file.span
        if span is None:
            continue
        if len(own) > 1 and own[0].span is not None and span[1] - own[0].span[0] > _STRETCH_NS:
            yield own
            own = own[-1:]
        own.append(file)
    if own:
        yield own


def _wheel(task: TickTask, files: Sequence[DataFile]) -> WheelTicks:
    """Return the ticks of the first profile of each period; none where a row group has no counts."""
    epochs, ticks = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    period = NS_PER_S // SAMPLES_PER_S
    for file, group in ((one, group) for one in files for group in range(len(one.group_rows))):
        rows = read_rows(task.store, task.source, file.path, [group], _COLUMNS)
        if rows.column("encoder_ticks").null_count:
            return WheelTicks(epochs[0], ticks[0])
        own = rows.column("epoch_gps_ns").to_numpy()
        kept = np.flatnonzero(np.diff(own // period, prepend=-1) > 0)
        epochs.append(own[kept])
        ticks.append(rows.column("encoder_ticks").to_numpy()[kept])
    return WheelTicks(np.concatenate(epochs), np.concatenate(ticks))


def _poses(task: TickTask, wheel: WheelTicks) -> PoseWay:
    span = int(wheel.epochs_gps_ns[0]) - _PAD_NS, int(wheel.epochs_gps_ns[-1]) + _PAD_NS
    found = load_recorded(task.store, task.poses, [span], task.max_gap_s)
    return PoseWay(found.epochs_gps_ns, found.position_world_m, found.quaternion_world_from_body)


def _figures(verdicts: Sequence[TickVerdict]) -> dict[str, object]:
    """Return the steps of all groups, each once, and the best-known offset with its σ (s)."""
    jumps = {jump.epoch_gps_ns: jump for one in verdicts for jump in one.jumps}
    offsets = [one.offset for one in verdicts if one.offset is not None and one.is_off]
    offset = min(offsets, key=lambda one: one.sigma_s, default=None)
    return {
        "jumps": [asdict(jumps[epoch]) for epoch in sorted(jumps)],
        "offset": None if offset is None else [offset.offset_s, offset.sigma_s],
        "still_m": sum(one.still_m for one in verdicts) if all(one.still_m for one in verdicts) else 0.0,
    }


# --- findings -----------------------------------------------------------------------------------------


class _Said(NamedTuple):
    """Result of the comparison for one log."""

    log: str
    jumps: tuple[ClockJump, ...]
    offset: tuple[float, float] | None
    """Offset of the clock, and its σ (s)."""
    still_m: float
    """Distance over which the ticks stand still; 0 where they count."""


def tick_findings(records: Sequence[LogRecord], manifest: Manifest) -> list[Finding]:
    """Return clocks that ticks and poses contradict: by log, or by run where all logs of several sensors agree."""
    log_of = {file.path: record.path for record in records for files in record.tables.values() for file in files}
    coarse = {
        record.run
        for record in records
        if record.tables.get("trajectory") and any(one.witness == COARSE_VALUES.name for one in record.findings)
    }
    runs: dict[str, list[_Said]] = defaultdict(list)
    for _, record in sorted(manifest.of(PRODUCT).items()):
        figures = record.figures()
        if (log := log_of.get(figures["file"])) is not None:
            jumps = tuple(ClockJump(**jump) for jump in figures["jumps"])
            if figures["run"] in coarse:
                jumps = tuple(jump for jump in jumps if abs(jump.way_m) > _COARSE_M)
            offset = figures["offset"] and (*figures["offset"],)
            runs[figures["run"]].append(_Said(log, jumps, offset, figures["still_m"]))
    found: list[Finding] = []
    for run, said in sorted(runs.items()):
        poses = next((r.path for r in records if r.run == run and r.tables.get("trajectory")), f"poses of run '{run}'")
        found += _of_run(poses, said)
    return found


def _of_run(poses: str, said: Sequence[_Said]) -> list[Finding]:
    first = said[0]
    others = said[1:]
    shared = tuple(one for one in first.jumps if others and all(_has(other.jumps, one) for other in others))
    found = [TICK_CLOCK.finds(poses, _step_words(shared, f"of all {len(said)} sensors"))] if shared else []
    offset = first.offset
    is_shared = offset is not None and bool(others) and all(_agree(offset, other.offset) for other in others)
    if is_shared and offset is not None:
        found.append(TICK_CLOCK.finds(poses, _offset_words(offset, f"of all {len(said)} sensors")))
    for one in said:
        if one.still_m:
            text = (
                f"the wheel's ticks stand still while the poses travel {one.still_m:,.0f} m: the encoder counts "
                "nothing, and the clock of this sensor has no witness in it; all readings are used"
            )
            found.append(TICKS_STILL.finds(one.log, text))
        own = tuple(jump for jump in one.jumps if not _has(shared, jump))
        if own:
            found.append(TICK_CLOCK.finds(one.log, _step_words(own, "of this sensor")))
        if one.offset is not None and not is_shared:
            found.append(TICK_CLOCK.finds(one.log, _offset_words(one.offset, "of this sensor")))
    return found


def _has(jumps: Iterable[ClockJump], one: ClockJump) -> bool:
    return any(
        abs(other.epoch_gps_ns - one.epoch_gps_ns) < _SAME_NS + abs(one.step_s) * NS_PER_S
        and abs(other.step_s - one.step_s) < _SAME_SHARE * abs(one.step_s)
        for other in jumps
    )


def _agree(one: tuple[float, float], other: tuple[float, float] | None) -> bool:
    return other is not None and abs(one[0] - other[0]) < max(3.0 * np.hypot(one[1], other[1]), 0.002)


def _step_words(jumps: Sequence[ClockJump], whose: str) -> str:
    largest = sorted(jumps, key=lambda one: -abs(one.step_s))[:_NAMED]
    words = ", ".join(
        f"by {1e3 * one.step_s:+,.1f} ms (σ {1e3 * one.sigma_s:.1f} ms) at {iso_from_gps_ns(one.epoch_gps_ns)}, where "
        f"the poses travel {abs(one.way_m):,.2f} m {'farther' if one.way_m > 0 else 'less far'} than the ticks say"
        for one in largest
    )
    more = f", and {len(jumps) - _NAMED:,} times more" if len(jumps) > _NAMED else ""
    return (
        f"the clock {whose} steps against that of the poses {words}{more}: a clock was set, or the positions step; "
        "all readings are used, and on one side of the step they lie along the road by speed times step"
    )


def _offset_words(offset: tuple[float, float], whose: str) -> str:
    return (
        f"the clock {whose} is {1e3 * offset[0]:+,.1f} ms (σ {1e3 * offset[1]:.1f} ms) off that of the poses: the "
        "speed by the wheel's ticks changes at other times than that of the poses; all readings are used, and lie "
        "along the road by speed times offset"
    )
