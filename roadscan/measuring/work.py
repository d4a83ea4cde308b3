"""What is to be done for the layer of pictures: files by camera and run, with the keys of what they depend on."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.core.grid import Bounds
from roadscan.georeference.plan.plan import SurveyPlan, pictures_plan_of
from roadscan.measuring.ground import Ground
from roadscan.measuring.layer import ListedPictures, PictureRows, Unplaced, listed_pictures
from roadscan.measuring.measure import survey_ground
from roadscan.measuring.poses import PicturePoses
from roadscan.measuring.settings import PicturesConfig
from roadscan.run.keys import code_digest, key_of
from roadscan.run.session import Session, found_once
from roadscan.tiles.tasks.wanted_products import product_context

_IN_A_FILE: Final = 2000
"""Pictures of a file at most: 20,000 pictures of a day make ten files."""
_PLAIN: Final = re.compile(r"[^A-Za-z0-9_-]+")


@found_once
def all_pictures(session: Session) -> ListedPictures:
    """Return all pictures of a survey's cameras."""
    return listed_pictures(pictures_plan_of(session))


def row_tasks(session: Session) -> list[PictureRows]:
    """Return the files that there should be, in order of their names."""
    plan, listed, ground = pictures_plan_of(session), all_pictures(session), survey_ground(session)
    reach_m = PicturesConfig.of(session.survey).footprint_reach_m
    code, context = code_digest("roadscan.measuring.layer:write_rows"), product_context(plan)
    tasks: list[PictureRows] = []
    for poses in listed.placed:
        logs = tuple(_path_of(plan, log.key) for log in poses.pictures.logs)
        above_m = plan.survey.rig.sensors[poses.pictures.logs[0].sensor].above_road_m
        for log_number in range(len(logs)):
            own = np.flatnonzero(poses.pictures.log == log_number)
            for part, start in enumerate(range(0, own.size, _IN_A_FILE)):
                picked = picked_poses(poses, own[start : start + _IN_A_FILE])
                near = _near(ground, picked, reach_m)
                log = poses.pictures.logs[log_number]
                unit = f"{_PLAIN.sub('-', log.run)}_{_PLAIN.sub('-', log.sensor)}_{log.key[:6]}_{part:03d}.parquet"
                digests = [(str(t), near.cells[t].digest) for t in sorted(near.cells, key=str)]
                known = [picked.root.tobytes().hex(), picked.told, picked.pictures.epochs_gps_ns.tobytes().hex()]
                key = key_of(code, unit, picked.pictures.key(), known, digests, reach_m, logs, plan.ground.map,
                             above_m)  # fmt: skip
                tasks.append(PictureRows(session.store, context, unit, key, picked, near, (), logs, reach_m, above_m))
    for names, own_unplaced in _by_log(listed.unplaced).items():
        unit = f"{_PLAIN.sub('-', '_'.join(names))}_without_pose.parquet"
        key = key_of(code, unit, [repr(one) for one in own_unplaced], plan.ground.map)
        tasks.append(PictureRows(session.store, context, unit, key, None, None, own_unplaced, (), reach_m, None))
    return sorted(tasks, key=lambda task: task.unit)


def picked_poses(poses: PicturePoses, index: npt.NDArray[np.int64]) -> PicturePoses:
    """Return the poses of some pictures, each told alone: without what an adjustment found of two of them."""
    pictures = poses.pictures
    some = replace(
        pictures, views=pictures.views.picked(index), place_m=pictures.place_m[index],
        reach_m=pictures.reach_m[index], log=pictures.log[index], epochs_gps_ns=pictures.epochs_gps_ns[index],
        files=tuple(pictures.files[k] for k in index.tolist()),
    )  # fmt: skip
    return PicturePoses(
        some, poses.place_m[index], poses.geographic[index], poses.camera_from_map[index], poses.map_from_ned[index],
        poses.ned_from_camera[index], poses.influence[index], poses.sigma[index], poses.lens_sigma[index],
        poses.root[index], tuple(poses.told[k] for k in index.tolist()), poses.correlation_s, {},
    )  # fmt: skip


def _near(ground: Ground, poses: PicturePoses, reach_m: float) -> Ground:
    """Return the tiles of the ground within reach of some pictures."""
    reach = 1.5 * reach_m  # rays are followed so far, as `footprint` does
    tiles = set()
    for east, north in np.unique(np.round(poses.place_m[:, :2], -1), axis=0).tolist():
        box = Bounds(east - reach - 10.0, north - reach - 10.0, east + reach + 10.0, north + reach + 10.0)
        tiles |= set(ground.tiles_in(box))
    cells = {tile: ground.cells[tile] for tile in tiles}
    return Ground.from_records(
        ground.store, ground.grid, cells, {t: ground.overviews[t] for t in tiles if t in ground.overviews}
    )


def _by_log(unplaced: Sequence[Unplaced]) -> dict[tuple[str, str, str], tuple[Unplaced, ...]]:
    found: dict[tuple[str, str, str], tuple[Unplaced, ...]] = {}
    for one in unplaced:
        names = one.run, one.camera, one.log
        found[names] = (*found.get(names, ()), one)
    return found


def _path_of(plan: SurveyPlan, key: str) -> str:
    return next(record.path for record in plan.records if record.key == key)
