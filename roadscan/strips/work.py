"""Strips of a survey: some stretches of each run, seen by its sensors and by those of other runs; one record each."""

from __future__ import annotations

import itertools
import json
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Final

import numpy as np

from roadscan.adjust.settings import AdjustConfig
from roadscan.adjust.tasks.near import PlacedReadings, placed_readings
from roadscan.compute.arrays import scatter_about, way_along
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.grid import TileId
from roadscan.footprints.footprints import PRODUCT as FOOTPRINTS
from roadscan.footprints.footprints import footprints_of
from roadscan.georeference.plan.plan import SurveyPlan, plan_of
from roadscan.georeference.sources import (
    READING_COLUMNS,
    Georeferencer,
    MapSettings,
    RawSlice,
    geometry_of,
    read_rows,
    road_key,
)
from roadscan.navigation.tasks.trajectories import TrajectorySource, load_recorded, median_pose_sigma
from roadscan.poses.trajectory import Trajectory, level_poses
from roadscan.run.engine.compute import run_bundles
from roadscan.run.keys import code_digest, key_of
from roadscan.run.session import Session
from roadscan.store.logs import DataFile
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.store import Store
from roadscan.strips.strip import HALF_WIDTH_M, Lag, Strip, Way, lag_of
from roadscan.strips.tilt import Sway, Tilt, tilts_of
from roadscan.tiles.tasks.tile_plan import tiles_of

PRODUCT: Final = "strips"
"""Name in the manifest of a stretch's comparisons; there is no file."""
_STRETCHES: Final = 6
"""Stretches of a run, at most, spread over its time."""
_LEAST_NS: Final = 4 * NS_PER_S
"""A shorter run has one stretch (ns)."""
_LONGEST_NS: Final = 30 * NS_PER_S  # A stretch lasts no longer than this (ns).
_LENGTH_M: Final = 100.0  # A stretch is no longer than this (m).
_LEAST_LENGTH_M: Final = 20.0  # A shorter way is not compared (m).
_PAD_NS: Final = NS_PER_S
"""Readings are taken this long (ns) before and after the stretch: a sensor looks ahead, or its clock is off."""
_STEP_NS: Final = 20_000_000
"""Approximate spacing of the way's poses (ns)."""
_OTHER_RUNS: Final = 3
"""Later runs that are compared on a stretch, at most."""
_PROFILES_PER_M: Final = 20.0  # Profiles of a profiler on a stretch are thinned to about this many a metre.
_READINGS: Final = 400_000
"""Readings of a sensor on a stretch, at most."""
_BESIDE: Final = (-1, 0, 1)  # Offsets of a tile's neighbours, in columns and rows.
_LEAST_CELLS: Final = 50
"""With fewer cells in common two sensors are not compared."""


@dataclass(frozen=True)
class StripTask:
    """One stretch of a run, and the row groups that may have seen it; it carries no data."""

    store: Store
    ground: MapSettings
    run: str
    number: int
    poses: TrajectorySource
    sigma_m: tuple[float, float]
    """Usual 1 σ of the run's poses, horizontal and down."""
    first_gps_ns: int
    last_gps_ns: int
    slices: tuple[RawSlice, ...]
    """Row groups of the run's sensors, then of those of later runs."""
    rows: tuple[int, ...]
    """Number of rows in each of them."""
    key: str

    @property
    def unit(self) -> str:
        """Returns its name in the manifest."""
        return f"{self.run}/{self.number}"


def compare_strips(session: Session, manifest: Manifest) -> list[tuple[str, str]]:
    """Compare the sensors on some stretches of each run where that was not done; returns what failed."""
    tasks = strip_tasks(session, manifest)
    manifest.remove(manifest.beside([PRODUCT], {task.unit for task in tasks}))
    stale = [task for task in tasks if not manifest.is_current(PRODUCT, task.unit, task.key)]
    failed = run_bundles(
        compare_strip, stale, lambda _: 1.0, 1.0, manifest, session.compute, session.bar("strips of road")
    )
    return [(f"strip {task.unit}", reason) for task, reason in failed]


def strip_tasks(session: Session, manifest: Manifest) -> list[StripTask]:
    """A task for each stretch that is compared; reads the poses of these stretches, and no readings."""
    return list(_tasks(session)) if manifest.of(FOOTPRINTS) else []


def _tasks(session: Session) -> Iterator[StripTask]:
    plan, code = plan_of(session), code_digest(f"{__name__}:compare_strip")
    files = {one.path: one for _, own in plan.sources for one in own}
    by_run: dict[str, list[RawSlice]] = defaultdict(list)
    trajectories: dict[str, TrajectorySource] = {}
    for one in plan.slices():
        if one.source.trajectory is not None and one.spans:
            by_run[one.source.run].append(one)
            trajectories[one.source.run] = one.source.trajectory
    runs = sorted(by_run)
    for place, run in enumerate(runs):
        own, poses = by_run[run], trajectories[run]
        sigma_m = _sigma(plan, poses)
        for number, (first, last) in enumerate(_stretches(own)):
            recorded = load_recorded(plan.store, poses, [(first, last)], plan.ground.max_gap_s)
            way = _way(recorded, plan.ground, (first, last))
            if way is None:
                continue
            pad = first - _PAD_NS, last + _PAD_NS
            slices = [near for one in own if (near := _within(one, files[one.file], pad))]
            slices += _others(session, way, runs[place + 1 :])
            seen = [[s.source.key, *road_key(s.source), files[s.file].digest, list(s.groups)] for s in slices]
            rows = tuple(int(np.array(files[s.file].group_rows)[list(s.groups)].sum()) for s in slices)
            key = key_of(code, plan.ground.max_gap_s, sigma_m, first, last, seen)
            yield StripTask(plan.store, plan.ground, run, number, poses, sigma_m, first, last, tuple(slices), rows, key)


def _sigma(plan: SurveyPlan, poses: TrajectorySource) -> tuple[float, float]:
    """Returns the usual 1 σ (m) of a run's poses, horizontal and down, from its logs, else the adjustment's priors."""
    assumed = AdjustConfig.of(plan.survey).priors
    north, east, down, *_ = median_pose_sigma(plan.store, plan.records, poses).tolist()
    horizontal = float(np.hypot(north, east))
    return (
        horizontal if np.isfinite(horizontal) else float(np.sqrt(2.0)) * assumed.sigma_horizontal_m,
        down if np.isfinite(down) else assumed.sigma_down_m,
    )


def _stretches(own: Sequence[RawSlice]) -> list[tuple[int, int]]:
    """Returns time spans (GPS ns) spread over those of a run's readings; the ways may be shorter."""
    ends: dict[str, list[int]] = defaultdict(list)
    for one in own:
        ends[one.source.sensor] += [epoch for span in one.spans for epoch in span]
    first, last = (int(np.median([of(epochs) for epochs in ends.values()])) for of in (min, max))
    count = int(np.clip((last - first) // _LEAST_NS, 1, _STRETCHES))
    begins = first + (last - first) * np.arange(count) // count
    length = min((last - first) // count, _LONGEST_NS)
    return [(int(begin), int(begin) + length) for begin in begins]


def _way(recorded: Trajectory, ground: MapSettings, span: tuple[int, int]) -> Way | None:
    """Returns the way within a time span, or its beginning; None where the vehicle stands or there are no poses.

    It goes through recorded poses, so that `status`, which asks for it, loads no kernel.
    """
    epochs, apart = recorded.epochs_gps_ns, np.diff(recorded.epochs_gps_ns) > ground.max_gap_s * NS_PER_S
    knots = np.flatnonzero((epochs >= span[0]) & (epochs <= span[1]))
    thin = knots[np.unique(epochs[knots] // _STEP_NS, return_index=True)[1]]
    if thin.size < 2:
        return None
    thin = thin[~np.append(apart, apart[-1])[thin]]
    body = ground.map.map_from_world(recorded.world, recorded.position_world_m[thin])
    station = way_along(body)
    kept = station <= _LENGTH_M
    return Way.of(body[kept], epochs[thin][kept]) if min(station[-1], _LENGTH_M) >= _LEAST_LENGTH_M else None


def _within(one: RawSlice, file: DataFile, span: tuple[int, int]) -> RawSlice | None:
    """Returns the row groups of a data file with readings of a time span; None if there are none."""
    if not any(first <= span[1] and last >= span[0] for first, last in one.spans):
        return None
    own = one.source.spans(file.group_spans)
    near = [g for g, (first, last) in enumerate(own) if first <= span[1] and last >= span[0]]
    return RawSlice(one.source, one.file, near, tuple(own[g] for g in near), 0) if near else None


def _others(session: Session, way: Way, runs: Sequence[str]) -> list[RawSlice]:
    """Returns row groups of some runs that may touch the tiles along a way."""
    if not runs:
        return []
    tiles, size_m = tiles_of(session), session.survey.config.tiles.size_m
    corners = np.floor(np.stack([way.easting_m, way.northing_m], axis=-1) / size_m).astype(np.int64)
    around = {TileId(c + i, r + k) for c, r in np.unique(corners, axis=0).tolist() for i in _BESIDE for k in _BESIDE}
    runs_of_groups = tiles.groups.runs(tiles.held(around))
    cuts = np.flatnonzero(np.diff(runs_of_groups.slice, prepend=-1)).tolist()
    found: list[RawSlice] = []
    for start, end in itertools.pairwise([*cuts, runs_of_groups.slice.size]):
        whole = footprints_of(session).slices[int(runs_of_groups.source[start])]
        if whole.source.run in runs and whole.source.trajectory is not None:
            first, last = runs_of_groups.first_epoch_gps_ns[start:end], runs_of_groups.last_epoch_gps_ns[start:end]
            spans = tuple(zip(first.tolist(), last.tolist(), strict=True))
            found.append(RawSlice(whole.source, whole.file, tiles.groups.groups(runs_of_groups, start, end), spans, 0))
    chosen = list(dict.fromkeys(one.source.run for one in found))[:_OTHER_RUNS]
    return [one for one in found if one.source.run in chosen]


# --- on a worker --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SeenBy:
    """Figures of what one sensor of one run saw of a stretch."""

    run: str
    sensor: str
    is_profiler: bool
    file: str
    epoch_gps_ns: int
    """Median epoch of its readings within the strip, 0 without any."""
    given: int
    """Readings that were examined."""
    placed: int
    """Those that have a return, a pose and a range within the limits."""
    beside: int
    """Those that lie within the strip, at any height."""
    readings: int
    """Those of them at heights where a road can be."""
    own_lane: int
    astray: int
    below_m: float | None
    level_share: float
    way: int
    """+1: the run drove along the way, −1: against it."""
    tilts: tuple[Tilt, ...]
    """How its readings confirm the angles of the stretch's poses; of the run that drove the stretch alone."""


@dataclass(frozen=True)
class Pair:
    """Comparison of two sensors on a stretch that both saw; numbers count the sensors."""

    first: int
    second: int
    cells: int
    away_m: float
    """Median height of the second above the first."""
    spread_m: float
    """Robust standard deviation about it."""
    lags: tuple[Lag, ...]
    """How far the second lies ahead along the way, its σ (m), and the likeness, of heights and of intensities."""


def compare_strip(task: StripTask) -> OutputRecord:
    """Returns the comparison of the sensors that saw a stretch."""
    pad = task.first_gps_ns - _PAD_NS, task.last_gps_ns + _PAD_NS
    recorded = load_recorded(task.store, task.poses, [pad], task.ground.max_gap_s)
    way = _way(recorded, task.ground, (task.first_gps_ns, task.last_gps_ns))
    seen: list[tuple[SeenBy, Strip]] = []
    if way is not None:
        placer = Georeferencer(task.store, task.ground, task.slices, recorded=True)
        epochs = recorded.epochs_gps_ns
        sway = Sway.of(level_poses(recorded, task.ground.map, epochs[(epochs >= pad[0]) & (epochs <= pad[1])]))
        order = sorted(task.slices, key=lambda one: (one.source.run != task.run, one.source.run, one.source.sensor))
        for _, slices in itertools.groupby(order, lambda one: (one.source.run, one.source.sensor)):
            seen.append(_seen_by(task, placer, way, sway, list(slices)))
    pairs = [
        _pair(j, k, one[1], other[1])
        for (j, one), (k, other) in itertools.combinations(enumerate(seen), 2)
        if task.run in (one[0].run, other[0].run)
    ]
    figures = {
        "run": task.run,
        "sigma_m": task.sigma_m,
        "speed_m_per_s": 0.0 if way is None else way.length_m * NS_PER_S / (task.last_gps_ns - task.first_gps_ns),
        "sensors": [asdict(one) for one, _ in seen],
        "pairs": [asdict(pair) for pair in pairs if pair is not None],
    }
    return OutputRecord(PRODUCT, task.unit, task.key, "", 0, "", json.dumps(figures))


def _seen_by(
    task: StripTask, placer: Georeferencer, way: Way, sway: Sway, slices: Sequence[RawSlice]
) -> tuple[SeenBy, Strip]:
    source = slices[0].source
    given, parts = 0, list[PlacedReadings]()
    for count, part in _placed(task, placer, way, slices):
        given += count
        parts.append(part)
    found = PlacedReadings.joined(parts)
    every = np.arange(0, len(found.points_m), max(1, -(-len(found.points_m) // _READINGS)))
    points, epochs = found.points_m[every], found.epoch_gps_ns[found.row[every]]
    strip, direction, middle = way.strip(points, found.intensity[every], epochs), 1, 0
    near, vertex = way.near(points, HALF_WIDTH_M)
    if near.any():
        middle = int(np.median(epochs[near]))
        with_way = float(((epochs[near] - middle) * (vertex[near] - vertex[near].mean())).sum()) >= 0.0
        direction = 1 if source.run == task.run or with_way else -1
    below = float(strip.below_m) if np.isfinite(strip.below_m) else None
    tilts = tuple(tilts_of(points, epochs, sway)) if source.run == task.run else ()
    return SeenBy(
        source.run, source.sensor, source.table == "scans", slices[0].file, middle, given, len(found.points_m),
        int(near.sum()), strip.readings, strip.own_lane, strip.astray, below, strip.level_share, direction, tilts,
    ), strip  # fmt: skip


def _placed(
    task: StripTask, placer: Georeferencer, way: Way, slices: Sequence[RawSlice]
) -> Iterator[tuple[int, PlacedReadings]]:  # fmt: skip
    """Yields thinned readings of the row groups, and their number before thinning."""
    geometry = geometry_of(slices[0].source)
    rows = sum(rows for one, rows in zip(task.slices, task.rows, strict=True) if one in slices)
    wanted = _READINGS if geometry is None else _PROFILES_PER_M * way.length_m
    step = max(1, int(rows / wanted))
    for one in slices:
        placement = placer.placement(one.source)
        for group in one.groups:
            rows_of = read_rows(task.store, one.source, one.file, [group], READING_COLUMNS[one.source.table])
            batch = rows_of.combine_chunks().to_batches()[0]
            batch = batch.take(np.arange(0, batch.num_rows, step))
            yield (
                batch.num_rows * (1 if geometry is None else geometry.readings),
                placed_readings(batch, geometry_of(one.source), placement),
            )


def _pair(j: int, k: int, one: Strip, other: Strip) -> Pair | None:
    away = (other.height_m - one.height_m).ravel()
    away = away[np.isfinite(away)]
    if away.size < _LEAST_CELLS:
        return None
    middle = float(np.median(away))
    lags = (lag_of(one.height_m, other.height_m), lag_of(one.intensity, other.intensity))
    spread = scatter_about(away, middle)
    return Pair(j, k, int(away.size), middle, spread, tuple(lag for lag in lags if lag is not None))
