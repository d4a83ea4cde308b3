"""Pictures of a survey as evidence of the adjustment: tie points and control points, and what they show of cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from roadscan.adjust.bundle.measurements import Measurements, Numbers
from roadscan.adjust.bundle.solve import PictureEvidence
from roadscan.adjust.control import ControlPoint
from roadscan.adjust.observations import CameraPrior
from roadscan.adjust.settings import AdjustConfig, CameraPriors
from roadscan.adjust.tasks.edge_scores import (
    RETURNS,
    SCORES,
    DepthTask,
    EdgeTask,
    depth_tasks,
    edge_tasks,
    load_boresights,
    load_returns,
    write_returns,
    write_scores,
)
from roadscan.adjust.tasks.mountings import Mounted, adjusted_cameras, asks_pictures, camera_sigma
from roadscan.compute.array_types import Float64, Int64
from roadscan.core.counted import listed
from roadscan.core.grid import of_run
from roadscan.georeference.plan.plan import SurveyPlan, mountings_of, trajectory_source
from roadscan.georeference.sources import load_mountings, road_key
from roadscan.navigation.tasks.trajectories import load_clocks
from roadscan.pictures.exposures import Exposures, camera_pictures, exposures_of
from roadscan.pictures.points import TABLE, measured_points
from roadscan.pictures.ties.tracks import ALL, TRACKS
from roadscan.store.manifest import Manifest, OutputRecord, recorded_table
from roadscan.store.store import Store

AskedOfPictures = DepthTask | EdgeTask
Collect = Callable[[str, Callable[[Any], OutputRecord], Sequence[AskedOfPictures]], None]
"""Updates the files of a product: its name, the function that writes one, and the tasks."""
_NAMED: Final = 5  # Names that a note lists.
_START_PX: Final = 0.5
"""1 σ of a tie point (px) until its residuals show it."""
_BLUNT_PX: Final = 8.0
"""Diameter (px) from which on the place of a feature is the less certain the larger it is, by the simulator's truth: σ
is 0.19 px below 6 px, 0.26 at 8, 0.46 at 15, 0.62 at 30."""
_BESIDE_NS: Final = 1_000_000_000
"""Time (ns) before the first picture and after the last one that corrections reach: clocks and rows are off by less."""


def exposure_epochs(plan: SurveyPlan) -> dict[str, Int64]:
    """Returns the epochs (e,), ascending, of the pictures of each run; none where pictures take no part."""
    found: dict[str, list[Int64]] = {}
    for name in adjusted_cameras(plan.survey):
        for taken in camera_pictures(plan, name):
            found.setdefault(taken.record.run, []).append(taken.epochs_gps_ns)
    epochs = {run: np.unique(np.concatenate(parts)) for run, parts in found.items()}
    return {run: own for run, own in epochs.items() if own.size}


def exposure_span(epochs_gps_ns: Int64) -> tuple[int, int]:
    """Returns first and last epoch (GPS ns) that corrections of pictures reach."""
    return int(epochs_gps_ns[0]) - _BESIDE_NS, int(epochs_gps_ns[-1]) + _BESIDE_NS


def pictures_key(plan: SurveyPlan, manifest: Manifest) -> list[Any]:
    """Returns what the evidence of pictures depends on, for the key of the solution. It reads no pose."""
    if not asks_pictures(plan.survey):
        return []
    tracks, cameras = manifest.get(TRACKS, ALL), adjusted_cameras(plan.survey)
    clocks, mountings = load_clocks(plan.store), load_mountings(plan.store)
    logs = list[list[Any]]()
    for record in plan.records:
        if record.tables.get("images") and record.sensor in cameras:
            posed = [file.digest for file in trajectory_source(record.run, plan.records).files]
            seat = mountings_of(record.run, record.sensor, cameras[record.sensor].mounting(), mountings)
            logs.append([record.key, posed, repr(of_run(clocks, record.run, record.sensor)), repr(seat)])
        elif record.tables.get(TABLE):
            logs.append([record.key, record.run, record.sensor])
    stated = [[name, one.model_dump(mode="json")] for name, one in cameras.items()]
    logs += [[s.key, *road_key(s), [f.digest for f in files]] for s, files in plan.sources if s.table == "returns"]
    return ["" if tracks is None else tracks.digest, plan.ground.max_gap_s, stated, logs]


def pictures_of(
    plan: SurveyPlan, manifest: Manifest, runs: Sequence[str], mounted: Mounted, points: Sequence[ControlPoint],
    collect: Collect,
) -> PictureEvidence | None:  # fmt: skip
    """Returns the evidence of a survey's pictures; None where they take no part, or show nothing.

    Parameters
    ----------
    runs : by which observations number them.
    mounted : the mountings that are estimated.
    points : control points of the survey.
    collect : updates what tasks write.
    """
    if not asks_pictures(plan.survey):
        return None
    exposures, notes = exposures_of(plan)
    sensors = sorted({camera.sensor for camera in exposures.cameras})
    priors = AdjustConfig.of(plan.survey).cameras
    cameras = tuple(CameraPrior(one, camera_sigma(plan.survey.rig.sensors[one], priors)[1]) for one in sensors)
    seats, keys = [("*", camera.sensor) for camera in exposures.cameras], [one.key for one in mounted.priors]
    numbers = Numbers(
        np.array([runs.index(camera.run) for camera in exposures.cameras], np.int32),
        np.array([keys.index(one) if one in keys else -1 for one in seats], np.int32),
        np.array([sensors.index(camera.sensor) for camera in exposures.cameras], np.int32),
    )
    index = {_named(exposures, k): k for k in range(len(exposures))}
    logs = [camera.log for camera in exposures.cameras]
    of_logs = {(logs[c], str(f)): k for k, (c, f) in enumerate(zip(exposures.camera, exposures.file, strict=True))}
    tracks = _tracks(plan.store, manifest, of_logs)
    control, number, more = _control(plan, priors, index, points)
    notes = (*notes, *more)
    tied = int(tracks.point.max(initial=-1)) + 1
    whole = _joined(tracks, control, tied)
    if not whole.point.size:
        return None
    surveyed = [points[k] for k in number.tolist()]
    place = _world(plan, exposures, surveyed)
    sigma = np.array([[p.sigma_horizontal_m, p.sigma_height_m] for p in surveyed]).reshape(-1, 2)
    measured = Measurements(
        exposures, whole.picture, whole.pixel, whole.sigma_px, whole.point,
        np.concatenate([np.full((tied, 3), np.nan), place]), np.concatenate([np.full((tied, 2), np.nan), sigma]),
    )  # fmt: skip
    is_check = np.array([False] * tied + [p.role != "gcp" for p in surveyed], bool)
    tasks = depth_tasks(
        plan, exposures, (tracks.picture, tracks.pixel), priors,
        lambda sensor: float(camera_sigma(plan.survey.rig.sensors[sensor], priors)[0][3:6].max()),
    )  # fmt: skip
    collect(RETURNS, write_returns, tasks)
    returns = load_returns(manifest, tasks, mounted, plan)
    compared = edge_tasks(plan, exposures, priors)
    collect(SCORES, write_scores, compared)
    edges = load_boresights(manifest, compared, mounted, numbers, plan, priors)
    named = np.concatenate([np.full(tied, -1), [p.number for p in surveyed]]).astype(np.int64)
    return PictureEvidence(
        measured, numbers, cameras, named, ~is_check[measured.point], priors.sigma_shared_px, notes, returns,
        (priors.sigma_depth_m, priors.sigma_shared_depth_m), edges,
    )  # fmt: skip


def _named(exposures: Exposures, number: int) -> tuple[str, str, str]:
    camera = exposures.cameras[exposures.camera[number]]
    return camera.run, camera.sensor, str(exposures.file[number])


class _Part(NamedTuple):
    """Measurements of some points."""

    picture: Int64
    """(m,) number of the picture."""
    pixel: Float64
    """(m, 2)"""
    sigma_px: Float64
    """(m,)"""
    point: Int64
    """(m,) number of the point, from 0."""


def _joined(tracks: _Part, control: _Part, tied: int) -> _Part:
    """Returns tie points, then control points."""
    return _Part(
        np.concatenate([tracks.picture, control.picture]), np.concatenate([tracks.pixel, control.pixel]),
        np.concatenate([tracks.sigma_px, control.sigma_px]), np.concatenate([tracks.point, control.point + tied]),
    )  # fmt: skip


def _tracks(store: Store, manifest: Manifest, index: dict[tuple[str, str], int]) -> _Part:
    """Returns the measurements of tie points; `index` numbers pictures by log and file."""
    record = manifest.get(TRACKS, ALL)
    if record is None or not record.path:
        return _Part(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.int64))
    rows = recorded_table(store, record)
    names = zip(*(rows.column(c).to_pylist() for c in ("log", "file")), strict=True)
    picture = np.array([index.get(one, -1) for one in names], np.int64)
    here = picture >= 0
    pixel = np.stack([rows.column(c).to_numpy() for c in ("u_px", "v_px")], axis=-1).astype(np.float64)
    number = np.unique(rows.column("track").to_numpy()[here], return_inverse=True)[1].astype(np.int64)
    size = rows.column("size_px").to_numpy().astype(np.float64)[here]
    return _Part(picture[here], pixel[here], _START_PX * np.hypot(1.0, size / _BLUNT_PX), number)


def _control(
    plan: SurveyPlan, priors: CameraPriors, index: dict[tuple[str, str, str], int], points: Sequence[ControlPoint]
) -> tuple[_Part, Int64, list[str]]:
    """Returns measurements of control points, the control point of each point, and notes on those left out."""
    found = measured_points(plan.store, plan.records, plan.survey.rig)
    known = {one.name: k for k, one in enumerate(points) if not one.is_of_line}
    unknown, unplaced = set[str](), set[str]()
    picture, point, values = list[int](), list[int](), list[tuple[float, float, float]]()
    for row in found.rows.to_pylist():
        at = index.get((row["run"], row["sensor"], row["picture"]))
        if row["point"] not in known:
            unknown.add(row["point"])
        elif at is None:
            unplaced.add(row["picture"])
        else:
            picture.append(at)
            point.append(known[row["point"]])
            values.append((row["u_px"], row["v_px"], row["sigma_px"] or priors.sigma_control_px))
    number, own = np.unique(np.array(point, np.int64), return_inverse=True)
    notes = [*found.notes]
    notes += [f"no control point is called {listed(sorted(unknown), _NAMED)}: not used"] if unknown else []
    notes += [f"no pose for {listed(sorted(unplaced), _NAMED)}: points in it are not used"] if unplaced else []
    measured = np.array(values, np.float64).reshape(-1, 3)
    part = _Part(np.array(picture, np.int64), measured[:, :2], measured[:, 2], own.astype(np.int64))
    return part, number.astype(np.int64), notes


def _world(plan: SurveyPlan, exposures: Exposures, points: Sequence[ControlPoint]) -> Float64:
    """Returns places (p, 3) of control points in the world frame of the poses."""
    if not points:
        return np.zeros((0, 3))
    enh = np.array([[p.easting_m, p.northing_m, p.height_m] for p in points])
    return plan.ground.map.world_from_map(exposures.cameras[0].world, enh)
