"""The path of each sensor in each run, and the strip of road that it saw, which show where passes can meet."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from roadscan.adjust.places import Track
from roadscan.adjust.swath import Swath, swath_of
from roadscan.adjust.tasks.near import PlacedReadings, Sources, placed_readings
from roadscan.compute.array_types import Int64
from roadscan.georeference.plan.plan import SurveyPlan
from roadscan.georeference.sources import Georeferencer, RawSlice, ReadingSource, geometry_of, read_rows
from roadscan.navigation.tasks.trajectories import load_recorded
from roadscan.poses.level import LevelPoses, level_poses
from roadscan.store.logs import DataFile

_STEP_NS: Final = 50_000_000  # Spacing of a track's poses (ns).
_SAMPLES: Final = 6
"""Row groups of a sensor from which its reach is measured."""
_SAMPLE_ROWS: Final = 64  # Profiles of such a row group that are used.
_SAMPLE_RETURNS: Final = 20_000  # Lidar returns of such a row group that are used.
_LIDAR_REACH_M: Final = 12.0
"""Reach of a lidar for ties (m): farther off, returns are sparse."""


def adjusted_sources(plan: SurveyPlan) -> list[tuple[ReadingSource, tuple[DataFile, ...]]]:
    """Returns readings that recorded poses georeference, by run and sensor.

    Of a run with profiles, which are dense, only these: returns of a lidar are for rigs that have nothing else.
    """
    order = {run: number for number, run in enumerate(runs_of(plan))}
    own = [(s, files) for s, files in plan.sources if s.trajectory is not None and any(f.group_spans for f in files)]
    dense = {s.run for s, _ in own if s.table == "scans"}
    own = [(s, files) for s, files in own if s.table == "scans" or s.run not in dense]
    return sorted(own, key=lambda pair: (order[pair[0].run], pair[0].sensor, pair[0].key))


def runs_of(plan: SurveyPlan) -> tuple[str, ...]:
    """Returns runs by name, whatever their order in the survey file; an adjustment numbers them so."""
    return tuple(sorted(run.id for run in plan.survey.config.runs))


def span_of(source: ReadingSource, files: Sequence[DataFile]) -> tuple[int, int]:
    """Returns first and last epoch (GPS ns) of a source."""
    spans = source.spans([f.span for f in files if f.span is not None])
    return min(a for a, _ in spans), max(b for _, b in spans)


def tracks_of(plan: SurveyPlan, sources: Sources) -> list[Track]:
    """Returns a track for each source that saw anything, in the order of `sources`."""
    runs = runs_of(plan)
    return [
        track
        for run in dict.fromkeys(s.run for s, _ in sources)
        for track in _of_run(plan, runs.index(run), [one for one in sources if one[0].run == run])
    ]


def _of_run(plan: SurveyPlan, number: int, own: Sources) -> Iterator[Track]:
    spans = [span_of(source, files) for source, files in own]
    trajectory = own[0][0].trajectory
    if trajectory is None:
        return
    whole = (min(a for a, _ in spans), max(b for _, b in spans))
    recorded = load_recorded(plan.store, trajectory, [whole], plan.ground.max_gap_s)
    if recorded.epochs_gps_ns.size < 2:
        return
    knots = recorded.epochs_gps_ns
    thin = knots[np.unique(knots // _STEP_NS, return_index=True)[1]]
    poses = level_poses(recorded, plan.ground.map, thin)
    for (source, files), (first, last) in zip(own, spans, strict=True):
        swath = _swath(plan, source, files)
        near = np.flatnonzero((poses.epoch_gps_ns >= first - _STEP_NS) & (poses.epoch_gps_ns <= last + _STEP_NS))
        if swath is not None and near.size > 1:
            yield _track(number, source, swath, poses, near)


def _track(number: int, source: ReadingSource, swath: Swath, poses: LevelPoses, rows: Int64) -> Track:
    heading = poses.heading_rad[rows]
    sine, cosine = np.sin(heading), np.cos(heading)
    body = poses.body_m[rows]
    is_lidar = source.table == "returns"
    forward, right = (0.0, 0.0) if is_lidar else (swath.forward_m, swath.right_m)
    half = min(swath.half_width_m, _LIDAR_REACH_M) if is_lidar else swath.half_width_m
    return Track(
        number, source.sensor, poses.epoch_gps_ns[rows], body[:, 0] + forward * sine + right * cosine,
        body[:, 1] + forward * cosine - right * sine, body[:, 2] - swath.below_m, heading, half, half,
        min(swath.half_length_m, _LIDAR_REACH_M) if is_lidar else 0.0,
    )  # fmt: skip


def _swath(plan: SurveyPlan, source: ReadingSource, files: Sequence[DataFile]) -> Swath | None:
    """Returns the strip that some row groups of a source show, spread over its time; None where they are empty."""
    groups = [(file, group) for file in files for group in range(len(file.group_rows))]
    chosen = sorted({round(k) for k in np.linspace(0, len(groups) - 1, min(_SAMPLES, len(groups)))})
    slices = [
        RawSlice(source, file.path, [group], source.spans([file.group_spans[group]]), 0)
        for file, group in (groups[k] for k in chosen)
    ]
    placement = Georeferencer(plan.store, plan.ground, slices, recorded=True).placement(source)
    parts: list[PlacedReadings] = []
    for own in slices:
        batch = read_rows(plan.store, source, own.file, own.groups).combine_chunks().to_batches()[0]
        most = _SAMPLE_ROWS if source.table == "scans" else _SAMPLE_RETURNS
        parts.append(placed_readings(batch.take(_spread(batch.num_rows, most)), geometry_of(source), placement))
    found = PlacedReadings.joined(parts)
    every = _spread(len(found.points_m), _SAMPLE_RETURNS)
    points, when = found.points_m[every], found.epoch_gps_ns[found.row[every]]
    epochs, pose = np.unique(when, return_inverse=True)
    poses = level_poses(placement.trajectory, plan.ground.map, epochs)
    has_pose = np.isin(epochs, poses.epoch_gps_ns)
    keep = has_pose[pose]
    if not keep.any():
        return None
    return swath_of(points[keep], poses, (np.cumsum(has_pose) - 1)[pose[keep]])


def _spread(count: int, most: int) -> Int64:
    """Returns about so many numbers below `count`, evenly spread."""
    return np.arange(0, count, max(1, -(-count // most)))
