"""Range edges of lidars against edges of pictures: each task covers a picture and a lidar."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pyarrow as pa

from roadscan.adjust.bundle.edge_boresight import EdgeBoresight, Sighted, boresight_of
from roadscan.adjust.bundle.measurements import Numbers
from roadscan.adjust.bundle.range_edges import OTHERS, TURNS_DEG, EdgeScores, scores_of
from roadscan.adjust.bundle.settings import CameraPriors
from roadscan.adjust.tasks.camera_priors import camera_sigma
from roadscan.adjust.tasks.mountings import DOUBTED, Mounted
from roadscan.adjust.tasks.near import NearFile
from roadscan.adjust.tasks.tie_depths import chosen_pictures, lidars_of, readings_about
from roadscan.core.counted import counted
from roadscan.core.witness import Finding, Witness
from roadscan.georeference.plan.plan import SurveyPlan
from roadscan.georeference.plan.road import road_key
from roadscan.georeference.sources import MapSettings
from roadscan.pictures.exposures import Exposures
from roadscan.pictures.files import read_picture
from roadscan.run.code_reach import code_digest
from roadscan.run.engine.fingerprint import key_of
from roadscan.store.codecs.image_files import ImageError
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import Manifest, OutputRecord, recorded_table
from roadscan.store.schema import table_schema
from roadscan.store.store import Store
from roadscan.store.writer import parquet_bytes

SCORES: Final = "edge_scores"
"""Table, and product of its files in the manifest."""
BORESIGHTS: Final = "edge_boresights"
_MOMENT_NS: Final = 50_000_000
"""Returns so long before and after a picture (ns) are of its moment: one turn of a lidar at 10 Hz."""
_MOST_PICTURES: Final = 60
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
    for number in chosen_pictures(exposures, usable, _EVERY_M, _MOST_PICTURES).tolist():
        own = exposures.at(np.array([number]))
        camera, epoch = own.cameras[int(own.camera[0])], int(own.epoch_gps_ns[0])
        span = [(epoch - _MOMENT_NS, epoch + _MOMENT_NS)]
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
        now = np.abs(epochs_gps_ns - own.epoch_gps_ns[0]) <= _MOMENT_NS
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
        scores = [one for task in own for one in _loaded(manifest, task, plan.store)]
        found.append(boresight_of(sighted, scores, float(np.radians(priors.sigma_shared_edge_deg))))
    return tuple(found)


def _loaded(manifest: Manifest, task: EdgeTask, store: Store) -> list[EdgeScores]:
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
