"""Range edges of lidars against edges of pictures: each task covers a picture and a lidar."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.adjust.bundle.edge_boresight import (
    OTHERS,
    TURNS_DEG,
    EdgeBoresight,
    EdgeScores,
    Sighted,
    boresight_of,
    scores_of,
)
from roadscan.adjust.bundle.measurements import NearReturns, Numbers
from roadscan.adjust.settings import CameraPriors
from roadscan.adjust.tasks.mountings import DOUBTED, Mounted, camera_sigma
from roadscan.adjust.tasks.near import NearFile, placed_readings
from roadscan.compute.array_types import Float64, Int64
from roadscan.core.counted import counted
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.witness import Finding, Witness
from roadscan.georeference.plan.plan import SurveyPlan
from roadscan.georeference.sources import Georeferencer, MapSettings, ReadingSource, geometry_of, read_rows, road_key
from roadscan.pictures.exposures import Exposures, read_picture
from roadscan.pictures.lens import pixels_of
from roadscan.run.keys import code_digest, key_of
from roadscan.store.codecs.image_files import ImageError
from roadscan.store.digest import bytes_digest
from roadscan.store.logs import DataFile
from roadscan.store.manifest import Manifest, OutputRecord, recorded_table
from roadscan.store.schema import table_schema
from roadscan.store.small_tables import parquet_bytes
from roadscan.store.store import Store

RETURNS: Final = "tie_returns"
"""Table, and product of its files in the manifest."""
_BATCH_NS: Final = 4 * NS_PER_S
"""Pictures of this long (ns) are one task: their returns lie in the same row groups."""
_MOMENT_NS: Final = 60_000_000
"""Returns so long before and after a picture (ns) are of its moment: a turn of a lidar at 10 Hz takes 100 ms."""
_MOST_PICTURES: Final = 2_000
"""Pictures of a survey that get depths, at most: their returns lie in memory while the adjustment is solved."""
_MOST_POINTS: Final = 80
"""Tie points of a picture that get a depth, at most."""
_BESIDE_PX: Final = 16.0
"""Returns so near to a tie point in the picture (px) are kept, and beyond it three σ of the boresight."""


@dataclass(frozen=True)
class DepthTask:
    """Some pictures of a camera, and the row groups of a lidar of their moments. It carries no returns."""

    store: Store
    ground: MapSettings
    exposures: Exposures
    pixels: tuple[Float64, ...]
    """(m, 2) tie points of each picture."""
    near_px: float
    reach_m: float
    files: tuple[NearFile, ...]
    numbers: tuple[int, ...]
    """Of the pictures among all exposures."""
    lidar: str
    unit: str
    key: str


def depth_tasks(
    plan: SurveyPlan, exposures: Exposures, tied: tuple[Int64, Float64], priors: CameraPriors,
    boresight_sigma: Callable[[str], float],
) -> list[DepthTask]:  # fmt: skip
    """Returns a task for each camera, lidar and some seconds.

    Parameters
    ----------
    tied : picture (m,) and pixel (m, 2) of each measurement of a tie point.
    boresight_sigma : 1 σ (rad) of the boresight of a camera.
    """
    if not priors.depths:
        return []
    picture, pixel = tied
    order = np.argsort(picture, kind="stable")
    starts = np.searchsorted(picture[order], np.arange(len(exposures) + 1))
    chosen = chosen_pictures(exposures, np.diff(starts) > 0, priors.depth_every_m, _MOST_PICTURES)
    lidars = lidars_of(plan)
    batch = exposures.epoch_gps_ns[chosen] // _BATCH_NS
    cuts = np.flatnonzero((np.diff(batch) != 0) | (np.diff(exposures.camera[chosen]) != 0)) + 1
    code, tasks = code_digest(f"{__name__}:write_returns"), []
    for rows in np.split(chosen, cuts) if chosen.size else []:
        own = exposures.at(rows)
        camera = own.cameras[int(own.camera[0])]
        pixels = tuple(_spread(pixel[order[starts[k] : starts[k + 1]]]) for k in rows.tolist())
        spans = [(int(t) - _MOMENT_NS, int(t) + _MOMENT_NS) for t in own.epoch_gps_ns]
        near_px = _BESIDE_PX + 3.0 * boresight_sigma(camera.sensor) * float(camera.lens.parameters[:2].max())
        for (run, lidar), own_files in lidars.items():
            near = [NearFile.of(source, file, spans) for source, file in own_files] if run == camera.run else []
            there = tuple(one for one in near if one is not None)
            if not there:
                continue
            posed = (own.body_world_m, own.world_from_body, own.lever_body_m, own.body_from_opencv)
            shaping = [v.round(6).tobytes().hex() for v in (*posed, *pixels)]
            key = key_of(
                code, [one.key(road_key(one.source)) for one in there], own.epoch_gps_ns.tolist(), own.file.tolist(),
                shaping, camera.lens.parameters.tolist(), near_px, priors.depth_reach_m,
            )  # fmt: skip
            unit = key_of(camera.run, camera.sensor, camera.log, lidar, int(own.epoch_gps_ns[0] // _BATCH_NS))
            tasks.append(
                DepthTask(
                    plan.store, plan.ground, own, pixels, near_px, priors.depth_reach_m, there,
                    tuple(rows.tolist()), lidar, unit, key,
                )
            )  # fmt: skip
    return tasks


def lidars_of(plan: SurveyPlan) -> dict[tuple[str, str], list[tuple[ReadingSource, DataFile]]]:
    """Returns the files of lidars by run and sensor."""
    lidars: dict[tuple[str, str], list[tuple[ReadingSource, DataFile]]] = {}
    for source, files in sorted(plan.sources, key=lambda pair: (pair[0].run, pair[0].sensor, pair[0].key)):
        if source.table == "returns" and source.trajectory is not None:
            lidars.setdefault((source.run, source.sensor), []).extend((source, f) for f in files if f.group_spans)
    return lidars


def chosen_pictures(exposures: Exposures, usable: npt.NDArray[np.bool_], every_m: float, most: int) -> Int64:
    """Returns numbers of usable pictures that lie some way apart, by camera and time; `most` of them."""
    found = []
    for camera in range(len(exposures.cameras)):
        rows = np.flatnonzero((exposures.camera == camera) & usable)
        rows = rows[np.argsort(exposures.epoch_gps_ns[rows], kind="stable")]
        way = np.linalg.norm(np.diff(exposures.eye_world_m[rows], axis=0), axis=1)
        along = np.concatenate([np.zeros(min(rows.size, 1)), np.cumsum(way)])
        found.append(rows[np.unique(np.floor(along / every_m), return_index=True)[1]])
    chosen = np.concatenate([np.zeros(0, np.int64), *found])
    return chosen[:: max(1, -(-chosen.size // most))]


def _spread(pixel: Float64) -> Float64:
    """Returns some of the pixels (m, 2), evenly by their tie points."""
    return pixel[:: max(1, -(-len(pixel) // _MOST_POINTS))]


def write_returns(task: DepthTask) -> OutputRecord:
    """Find the returns about the tie points of pictures and write them (runs on a worker)."""
    count = len(task.exposures)
    parts: list[list[Float64]] = [[] for _ in range(count)]
    for points_m, epochs_gps_ns in readings_about(task.store, task.ground, task.files):
        for k in range(count):
            parts[k].append(_near(task, k, points_m, epochs_gps_ns))
    points = [np.concatenate([np.zeros((0, 3)), *own]) for own in parts]
    names = np.repeat(task.exposures.file.astype(str), [len(own) for own in points])
    joined = np.concatenate(points)
    schema = table_schema(RETURNS)
    columns = [pa.array(names.tolist(), pa.string()), *(pa.array(column, pa.float32()) for column in joined.T)]
    content = parquet_bytes(pa.Table.from_arrays(columns, schema=schema.arrow()), schema)
    target = f"{schema.location}/{task.unit}.parquet"
    task.store.write_bytes(target, content, lasting=False)
    return OutputRecord(RETURNS, task.unit, task.key, target, len(content), bytes_digest(content))


def readings_about(store: Store, ground: MapSettings, files: Sequence[NearFile]) -> Iterator[tuple[Float64, Int64]]:
    """Yields returns (n, 3) of row groups in the map by the recorded poses, with their epochs (n,)."""
    placer = Georeferencer(store, ground, [one.slice for one in files], recorded=True)
    for file in files:
        for group in file.groups:
            rows = read_rows(store, file.source, file.path, [group]).combine_chunks()
            for batch in rows.to_batches():
                placed = placed_readings(batch, geometry_of(file.source), placer.placement(file.source))
                yield placed.points_m, placed.epoch_gps_ns[placed.row]


def _near(task: DepthTask, k: int, points_m: Float64, epochs_gps_ns: Int64) -> Float64:
    """Returns the returns (n, 3) of a picture's moment near its tie points, in the axes of the body."""
    from scipy.spatial import cKDTree

    own = task.exposures
    camera = own.cameras[int(own.camera[k])]
    now = np.flatnonzero(np.abs(epochs_gps_ns - own.epoch_gps_ns[k]) <= _MOMENT_NS)
    if not now.size:
        return np.zeros((0, 3))
    world = task.ground.map.world_from_map(camera.world, points_m[now])
    body = (world - own.body_world_m[k]) @ own.world_from_body[k]
    seen = (body - own.lever_body_m[k]) @ own.body_from_opencv[k]
    near = np.flatnonzero((seen[:, 2] > 0.5) & (np.einsum("ni,ni->n", seen, seen) < task.reach_m**2))
    pixel = pixels_of(camera.lens, seen[near])
    near, pixel = near[np.isfinite(pixel).all(axis=1)], pixel[np.isfinite(pixel).all(axis=1)]
    away, _ = cKDTree(task.pixels[k]).query(pixel, distance_upper_bound=task.near_px)
    return np.asarray(body[near[np.isfinite(away)]])


def load_returns(
    manifest: Manifest, tasks: Sequence[DepthTask], mounted: Mounted, plan: SurveyPlan
) -> tuple[NearReturns, ...]:
    """Returns what the tasks found, picture by picture."""
    return tuple(one for task in tasks for one in _loaded(manifest, task, mounted, plan))


def _loaded(manifest: Manifest, task: DepthTask, mounted: Mounted, plan: SurveyPlan) -> Iterator[NearReturns]:
    record = manifest.get(RETURNS, task.unit)
    if record is None or not record.path:
        return
    rows = recorded_table(plan.store, record)
    point = np.stack([rows.column(c).to_numpy() for c in ("forward_m", "right_m", "down_m")], axis=-1)
    names = np.array(rows.column("file").to_pylist(), dtype=object)
    run = task.files[0].source.run
    for k, number in enumerate(task.numbers):
        stated = task.files[0].source.mountings.pieces(task.exposures.epoch_gps_ns[k : k + 1])
        lever = np.array(next(mounting.lever_arm_body_m for _, mounting in stated), np.float64)
        own = point[names == str(task.exposures.file[k])]
        yield NearReturns(number, mounted.number(run, task.lidar), task.lidar, lever, own)


SCORES: Final = "edge_scores"
"""Table, and product of its files in the manifest."""
BORESIGHTS: Final = "edge_boresights"
_COMPARED_MOMENT_NS: Final = 50_000_000
"""Returns so long before and after a picture (ns) are of its moment: one turn of a lidar at 10 Hz."""
_MOST_COMPARED: Final = 60
"""Pictures that are compared, at most, spread over the survey: some dozen tell the boresight to what all edges have in
common."""
_EVERY_M: Final = 0.25
"""Pictures of a camera that far apart (m) are compared: one that stands sees the same again."""
_SIZES: Final = tuple(own.size for own in TURNS_DEG)
_AXES: Final = ("roll", "pitch", "heading")
PICTURE_EDGES: Final = Witness(
    "picture_edges",
    input="rig file",
    fault="The boresight of a camera, or of a lidar, is not what the rig file states.",
    asks="edges of range in the returns of a lidar at the moment of a picture: they lie on edges of the picture",
    does="what they say of the boresight is an observation of the adjustment; it is told where it is off by more than "
    "three σ",
    told=("findings",),
)


@dataclass(frozen=True)
class EdgeTask:
    """A picture, and the row groups of a lidar of its moment. It carries neither pixels nor returns."""

    store: Store
    ground: MapSettings
    exposure: Exposures
    """The picture alone."""
    files: tuple[NearFile, ...]
    lidar: str
    lidar_body_m: tuple[float, float, float]
    reach_m: float
    unit: str
    key: str


def edge_tasks(plan: SurveyPlan, exposures: Exposures, priors: CameraPriors) -> list[EdgeTask]:
    """Returns a task for each picture that is compared with a lidar, by camera and time."""
    if not priors.edges:
        return []
    around = np.array([camera.lens.is_around for camera in exposures.cameras], bool)
    usable = ~around[exposures.camera] if around.size else np.zeros(0, bool)
    lidars, code, tasks = lidars_of(plan), code_digest(f"{__name__}:write_scores"), []
    for number in chosen_pictures(exposures, usable, _EVERY_M, _MOST_COMPARED).tolist():
        own = exposures.at(np.array([number]))
        camera, epoch = own.cameras[int(own.camera[0])], int(own.epoch_gps_ns[0])
        span = [(epoch - _COMPARED_MOMENT_NS, epoch + _COMPARED_MOMENT_NS)]
        for (run, lidar), files in lidars.items():
            near = [NearFile.of(source, file, span) for source, file in files] if run == camera.run else []
            there = tuple(one for one in near if one is not None)
            if not there:
                continue
            seat = next(iter(there[0].source.mountings.pieces(own.epoch_gps_ns)))[1].lever_arm_body_m
            posed = (own.body_world_m, own.world_from_body, own.lever_body_m, own.body_from_opencv)
            unit = key_of(camera.run, camera.sensor, camera.log, lidar, str(own.file[0]))
            key = key_of(
                code, camera.log, unit, [one.key(road_key(one.source)) for one in there], epoch, list(seat),
                [v.round(6).tobytes().hex() for v in posed], camera.lens.parameters.tolist(), camera.lens.size_px,
                camera.rig.own_vehicle_px, priors.depth_reach_m,
            )  # fmt: skip
            x, y, z = (float(v) for v in seat)
            tasks.append(
                EdgeTask(plan.store, plan.ground, own, there, lidar, (x, y, z), priors.depth_reach_m, unit, key)
            )
    return tasks


def write_scores(task: EdgeTask) -> OutputRecord:
    """Compare a picture with the returns of its moment and write the scores (runs on a worker)."""
    own = task.exposure
    camera = own.cameras[int(own.camera[0])]
    parts = [np.zeros((0, 3))]
    for points_m, epochs_gps_ns in readings_about(task.store, task.ground, task.files):
        now = np.abs(epochs_gps_ns - own.epoch_gps_ns[0]) <= _COMPARED_MOMENT_NS
        world = task.ground.map.world_from_map(camera.world, points_m[now])
        body = (world - own.body_world_m[0]) @ own.world_from_body[0]
        seen = (body - own.lever_body_m[0]) @ own.body_from_opencv[0]
        parts.append(body[(seen[:, 2] > 0.0) & (np.einsum("ni,ni->n", seen, seen) < task.reach_m**2)])
    try:
        picture = read_picture(own.path(0), camera.lens.size_px, grey=True)
    except (ImageError, OSError):
        found = EdgeScores(0, np.zeros(_SIZES), np.zeros((3, 3)), np.zeros((3, OTHERS)))
    else:
        seat = own.lever_body_m[0], own.body_from_opencv[0]
        found = scores_of(np.concatenate(parts), np.array(task.lidar_body_m), seat, picture, camera.lens)
    schema = table_schema(SCORES)
    row = {
        "run": camera.run, "sensor": camera.sensor, "file": str(own.file[0]), "lidar": task.lidar,
        "edges": found.edges, "score": found.score.ravel().tolist(), "normal": found.normal.ravel().tolist(),
        "by_others": found.by_others.ravel().tolist(),
    }  # fmt: skip
    content = parquet_bytes(pa.Table.from_pylist([row], schema=schema.arrow()), schema)
    target = f"{schema.location}/{task.unit}.parquet"
    task.store.write_bytes(target, content, lasting=False)
    return OutputRecord(SCORES, task.unit, task.key, target, len(content), bytes_digest(content))


def load_boresights(
    manifest: Manifest, tasks: Sequence[EdgeTask], mounted: Mounted, numbers: Numbers, plan: SurveyPlan,
    priors: CameraPriors,
) -> tuple[EdgeBoresight, ...]:  # fmt: skip
    """Returns what edges say of the boresight of each camera and lidar."""
    pairs: dict[tuple[str, str, int, int], list[EdgeTask]] = {}
    for task in tasks:
        camera = task.exposure.cameras[int(task.exposure.camera[0])]
        seat = int(numbers.sensor[int(task.exposure.camera[0])])
        pairs.setdefault((camera.sensor, task.lidar, seat, mounted.number(camera.run, task.lidar)), []).append(task)
    found = []
    for (camera_name, lidar, seat, lidar_seat), own in sorted(pairs.items()):
        own.sort(key=lambda task: int(task.exposure.epoch_gps_ns[0]))
        exposure = own[0].exposure
        sigma = camera_sigma(plan.survey.rig.sensors[camera_name], priors)[0][3:6]
        sighted = Sighted(
            camera_name, lidar, seat, lidar_seat, int(numbers.camera[int(exposure.camera[0])]),
            exposure.body_from_opencv[0], sigma, plan.survey.rig.sensors[camera_name].boresight_sigma_deg is None,
        )  # fmt: skip
        scores = [one for task in own for one in _stored_scores(manifest, task, plan.store)]
        found.append(boresight_of(sighted, scores, float(np.radians(priors.sigma_shared_edge_deg))))
    return tuple(found)


def _stored_scores(manifest: Manifest, task: EdgeTask, store: Store) -> list[EdgeScores]:
    record = manifest.get(SCORES, task.unit)
    if record is None or not record.path:
        return []
    shapes = {"score": _SIZES, "normal": (3, 3), "by_others": (3, OTHERS)}
    return [
        EdgeScores(row["edges"], *(np.array(row[name], np.float64).reshape(shape) for name, shape in shapes.items()))
        for row in recorded_table(store, record).to_pylist()
    ]


def boresight_rows(found: Sequence[EdgeBoresight]) -> list[dict[str, Any]]:
    """Returns rows of the table of boresights."""
    rows = list[dict[str, Any]]()
    for one in found:
        told = bool(one.edges) and bool(one.covariance.any())
        row: dict[str, Any] = {
            "sensor": one.of.camera, "lidar": one.of.lidar, "pictures": one.pictures, "edges": one.edges,
            "used": int(one.counts), "why_not": one.why_not or None,
        }  # fmt: skip
        for k, axis in enumerate(_AXES):
            row[f"{axis}_deg"] = float(np.degrees(one.turn[k])) if told else None
            row[f"sigma_{axis}_deg"] = float(np.degrees(one.sigma[k])) if told else None
        rows.append(row)
    return rows


def boresight_lines(found: Sequence[EdgeBoresight]) -> list[str]:
    """Returns what edges say, in words."""
    lines = []
    for one in found:
        what = f"edges of {one.of.lidar} in {counted(one.pictures, 'picture')} of {one.of.camera}"
        if one.why_not:
            lines.append(f"{what} say nothing of the boresight: {one.why_not}")
        else:
            lines.append(f"{what}, {one.edges:,} in all: boresight {_angles(one)}")
    return lines


def boresight_findings(found: Sequence[EdgeBoresight]) -> list[Finding]:
    """Returns a finding where edges contradict what is stated of a boresight."""
    said = []
    for one in found:
        stated = one.of.stated_sigma_rad
        if not one.why_not and (np.abs(one.turn) > DOUBTED * np.hypot(stated, one.sigma)).any():
            within = ", ".join(f"{s:.2g}" for s in np.degrees(stated))
            where = f"edges of {one.of.lidar} lie on those of {counted(one.pictures, 'picture')}"
            text = (
                f"{where} if the camera is turned by {_angles(one)}; its boresight is stated to {within}°. Correct the "
                "rig file, or calibrate the camera anew"
            )
            said.append(PICTURE_EDGES.finds(one.of.camera, text))
    return said


def _angles(one: EdgeBoresight) -> str:
    angles = zip(_AXES, np.degrees(one.turn), np.degrees(one.sigma), strict=True)
    return ", ".join(f"{axis} {turn:+.3f}° (σ {sigma:.3f}°)" for axis, turn, sigma in angles)
