"""The path of each sensor in each run, and the strip of road that it saw, which show where passes can meet.

Heads of one pass where their strips meet: a test of the mounting of each head in every run.

Poses move both heads alike, so that what their heights differ by where both saw the road is theirs alone: the height,
the roll or the range scale of one of them, or the log of another one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.adjust.observations import KINDS
from roadscan.adjust.places import HEIGHT, Place, Track, places_of_overlap
from roadscan.adjust.settings import AdjustConfig, PlaceSettings
from roadscan.adjust.tasks.near import NearReader, PlacedReadings, Sources, near_files, placed_readings
from roadscan.adjust.tasks.tie_work import KnownTies, Ties, ties_of
from roadscan.compute.array_types import Float64, Int64
from roadscan.compute.arrays import scatter_about
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.witness import Finding, Witness
from roadscan.georeference.plan.plan import SurveyPlan
from roadscan.georeference.sources import Georeferencer, RawSlice, ReadingSource, geometry_of, read_rows
from roadscan.navigation.tasks.trajectories import load_recorded
from roadscan.poses.trajectory import LevelPoses, level_poses
from roadscan.run.keys import key_of
from roadscan.store.logs import DataFile

_SHARE = 2.0
"""Per cent of the readings that lie beyond either side."""
WHOLE: Final = 1.0 / (1.0 - 0.02 * _SHARE)
"""Ratio of the width of all evenly spread readings of a profile to that of the strip."""


@dataclass(frozen=True)
class Swath:
    """The area of a sensor's readings, from the body's origin, along the vehicle's heading and to its right (m)."""

    forward_m: float
    """Middle, ahead."""
    right_m: float
    """Middle, to the right."""
    half_width_m: float
    """From the middle to either side."""
    half_length_m: float
    """From the middle ahead and behind."""
    below_m: float
    """Middle, below the body's origin."""


def swath_of(points_m: Float64, poses: LevelPoses, pose: npt.NDArray[np.int64]) -> Swath:
    """Returns the strip that contains most of the points (n, 3; easting, northing, height) that poses (n,) saw."""
    away = points_m - poses.body_m[pose]
    sine, cosine = np.sin(poses.heading_rad)[pose], np.cos(poses.heading_rad)[pose]
    forward, right = away[:, 0] * sine + away[:, 1] * cosine, away[:, 0] * cosine - away[:, 1] * sine
    back, front = np.percentile(forward, [_SHARE, 100.0 - _SHARE])
    left, end = np.percentile(right, [_SHARE, 100.0 - _SHARE])
    return Swath(
        float(np.median(forward)), float(left + end) / 2, float(end - left) / 2, float(front - back) / 2,
        float(-np.median(away[:, 2])),
    )  # fmt: skip


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


_NARROW_M: Final = 0.03
"""Least overlap of the strips of two compared heads (m): a cell of 0.025 m, and some of the next."""
COMMON_M: Final = 1.5e-4
"""1 σ of the common error of all steps at a narrow seam (m): its cells are seen to their edge by one head alone, half a
cell of 0.025 m beside the other on a road that falls by 2.5 %, and less where readings are dense."""
_ODD: Final = 3.0
"""A step that differs from that of other runs by more than this many σ is reported."""
_LARGE_M: Final = 0.01
"""Steps larger than this (m) and three σ of the heads' mountings are tested for exchanged logs."""
_FALLS: Final = 3.0
"""Exchanged logs enlarge the step at least this many times."""
_TRIED: Final = 12
"""Places, spread over the run, at which that is tested."""

HEADS: Final = Witness(
    "heads_of_a_run",
    input="profiler",
    fault="The logs of two heads are exchanged, or the range scale or mounting of a head is another in one run.",
    asks="heights of heads of one pass where their strips meet, run by run, and with each log in the other's mounting",
    does="ties and control of a run whose logs are exchanged do not count; a run in which heads meet otherwise than in "
    "the others gets mountings of its own",
    told=("findings",),
)


def seams(tracks: Sequence[Track], dense: Sequence[Place], settings: PlaceSettings) -> list[Place]:
    """Returns places where heads of one pass meet in a strip that is too narrow for the other ties, `dense`."""
    known = {_pair(place) for place in dense if place.quality_only(settings.return_s)}
    found: list[Place] = []
    narrow = settings.model_copy(
        update={"per_km": settings.seams_per_km, "radius_m": settings.seam_radius_m, "least_overlap_m": _NARROW_M}
    )
    whole = [replace(t, left_m=WHOLE * t.left_m, right_m=WHOLE * t.right_m) for t in tracks if t.ahead_m == 0.0]
    for run in sorted({t.run for t in whole}):
        own = places_of_overlap([t for t in whole if t.run == run], narrow)
        found += [
            replace(one, seam=True) for one in own if one.quality_only(settings.return_s) and _pair(one) not in known
        ]
    return found


def _pair(place: Place) -> tuple[int, str, str]:
    """Returns run and sensors of heads that meet at a place."""
    return place.traverses[0].run, place.traverses[0].sensor, place.traverses[-1].sensor


@dataclass(frozen=True)
class Step:
    """Step between two heads of a run: the height of the second above the first."""

    run: str
    heads: tuple[str, str]
    step_m: float
    sigma_m: float
    places: int

    @classmethod
    def of(cls, run: str, heads: tuple[str, str], values_m: Float64) -> Step:
        """Returns the median over places."""
        middle = float(np.median(values_m))
        scatter = scatter_about(values_m, middle)
        return cls(run, heads, middle, float(np.hypot(COMMON_M, scatter / np.sqrt(values_m.size))), values_m.size)

    @property
    def told(self) -> str:
        """Returns the step in words."""
        return f"{1e3 * self.step_m:+.2f} mm (σ {1e3 * self.sigma_m:.2f} mm, {self.places} places)"


def steps_of(ties: KnownTies, return_s: float) -> list[Step]:
    """Returns a step for each pair of heads in each run, also from ties that failed a test."""
    column = ties.columns
    apart_s = np.abs(column["first_epoch_gps_ns"] - column["second_epoch_gps_ns"]) / NS_PER_S
    own = (column["kind"] == HEIGHT) & (column["first_run"] == column["second_run"]) & (apart_s < return_s)
    own &= column["first_sensor"] != column["second_sensor"]
    rows = sorted(
        (str(column["first_run"][k]), str(column["first_sensor"][k]), str(column["second_sensor"][k]), k)
        for k in np.flatnonzero(own).tolist()
    )
    return [
        Step.of(run, (one, other), ties.observations.observed_m[[k for *_, k in group]])
        for (run, one, other), group in groupby(rows, key=lambda row: row[:3])
    ]


def odd_steps(steps: Sequence[Step]) -> list[tuple[Step, Step]]:
    """Steps that differ from those of the other runs, and the usual one: the median, of two runs the smaller one."""
    found = []
    for _, group in groupby(sorted(steps, key=lambda one: (one.heads, one.run)), key=lambda one: one.heads):
        own = sorted(group, key=lambda one: (one.step_m, one.run))
        usual = own[(len(own) - 1) // 2] if len(own) > 2 else min(own, key=lambda one: abs(one.step_m))
        limit = [_ODD * float(np.hypot(one.sigma_m, usual.sigma_m)) for one in own]
        found += [(one, usual) for one, most in zip(own, limit, strict=True) if abs(one.step_m - usual.step_m) > most]
    return sorted(found, key=lambda pair: (pair[0].run, pair[0].heads))


def exchanged(plan: SurveyPlan, sources: Sources, steps: Sequence[Step]) -> list[tuple[Step, Step]]:
    """Returns pairs of heads whose logs are exchanged: their step, and the step left with exchanged mountings."""
    tried = [(one, _tried(plan, sources, one)) for one in steps if abs(one.step_m) > _LARGE_M]
    return [(one, other) for one, other in tried if other is not None]


def _tried(plan: SurveyPlan, sources: Sources, step: Step) -> Step | None:
    """Returns the step with the mountings exchanged; None where it is no smaller."""
    config, runs = AdjustConfig.of(plan.survey), runs_of(plan)
    (first, of_first), (second, of_second) = (
        next((s, files) for s, files in sources if (s.run, s.sensor) == (step.run, head)) for head in step.heads
    )
    swapped = [
        (replace(own, mountings=other.mountings, key=key_of(own.key, "mounted as", other.key)), files)
        for own, other, files in ((first, second, of_first), (second, first, of_second))
    ]
    places = seams(tracks_of(plan, swapped), [], config.places)
    places = places[:: max(1, -(-len(places) // _TRIED))]
    files = near_files(swapped, [t for place in places for t in place.traverses], runs)
    reader = NearReader(plan.store, plan.ground, files, runs)
    found = Ties.joined([ties_of(reader, place, config.ties) for place in places]).observations
    heights = found.observed_m[(found.kind == KINDS.index(HEIGHT)) & np.isfinite(found.observed_m)]
    if not heights.size:
        return None
    other = Step.of(step.run, step.heads, heights)
    vanishes = abs(other.step_m) < _LARGE_M and abs(other.step_m) * _FALLS < abs(step.step_m)
    return other if vanishes else None


def head_findings(swapped: Iterable[tuple[Step, Step]], odd: Iterable[tuple[Step, Step]]) -> list[Finding]:
    """Returns findings on heads that do not meet as they should."""
    found = [
        HEADS.finds(
            f"run '{one.run}'",
            f"the logs of {' and '.join(one.heads)} are exchanged: where the heads meet, heights differ by {one.told}, "
            f"and by {other.told} with each log in the other's mounting. Ties and control of this run do not count; "
            "exchange the two paths in the survey file",
        )
        for one, other in swapped
    ]
    return found + [
        HEADS.finds(
            f"run '{one.run}'",
            f"{one.heads[1]} lies {one.told} above {one.heads[0]} where the two meet, in run '{usual.run}' "
            f"{usual.told}: the range scale, the height or the roll of one of them is another in this run. Their "
            "mountings are estimated for this run by itself",
        )
        for one, usual in odd
    ]
