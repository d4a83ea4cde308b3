"""Pictures from which a survey's ground can take its colours: their poses, and those that a tile may need."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.crs import MapFrame
from roadscan.core.errors import ConfigError, RunError, nearest
from roadscan.core.frames import SENSOR_FROM_OPENCV
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.grid import Bounds
from roadscan.core.rig import Mountings, Rig, Sensor
from roadscan.georeference.plan.plan import SurveyPlan, mountings_of, trajectory_source
from roadscan.georeference.sources import change_of, load_mounting_changes, load_mountings
from roadscan.navigation.tasks.recorded_pictures import TakenPictures
from roadscan.navigation.tasks.trajectories import TrajectorySource, load_trajectory
from roadscan.pictures.exposures import camera_pictures, folder_of
from roadscan.pictures.lens import Lens, changed, clock_ns, load_camera_changes, row_ns
from roadscan.pictures.views import PictureRule, Views
from roadscan.poses.trajectory import Poses, world_from_ned

_PIECE_NS: Final = 600 * NS_PER_S
"""Poses of this long (ns) are loaded at once."""
_CURVED: Final = 1.01
"""Margin for the change of the map's scale, which is far smaller within a picture's reach."""
_WITHOUT: Final = 'set colours = "intensity" in the settings of the product'


@dataclass(frozen=True)
class PictureLog:
    """A log of pictures."""

    key: str
    run: str
    sensor: str
    folder: Path


@dataclass(frozen=True)
class Pictures:
    """n pictures with their poses, in order of time. Sent to workers: it carries no image."""

    rule: PictureRule
    map: MapFrame
    worlds: tuple[str, ...]
    """World frames to which the views refer by number."""
    views: Views
    place_m: Float64
    """(n, 2) easting and northing of the cameras."""
    reach_m: Float64
    """(n,) reach of the rule on the map."""
    logs: tuple[PictureLog, ...]
    log: Int64
    """(n,) number of each picture's log."""
    epochs_gps_ns: Int64
    """(n,) when they were taken."""
    files: tuple[str, ...]
    """(n,) relative to the log's folder."""
    lens_key: str
    """Hash of the lenses and of what they hide."""
    notes: tuple[str, ...] = ()
    """Notes on pictures that are left out, and why."""

    def __len__(self) -> int:
        """Returns the number of pictures."""
        return len(self.files)

    def path(self, number: int) -> Path:
        """Returns the file of a picture."""
        return Path(self.logs[self.log[number]].folder, self.files[number])

    def name(self, number: int) -> str:
        """Returns the name of a picture in messages."""
        log = self.logs[self.log[number]]
        return f"{log.run}/{log.sensor}/{self.files[number]}"

    def near(self, *boxes: Bounds) -> Pictures:
        """Returns those that may show a point in one of some boxes of the map, in the same order."""
        return self._picked(self.numbers_near(*boxes))

    def numbers_near(self, *boxes: Bounds) -> Int64:
        """Returns the numbers (k,) of those that may show a point in one of some boxes of the map, ascending."""
        if not len(self) or not boxes:
            return np.zeros(0, np.int64)
        own = np.array([[b.easting_min_m, b.northing_min_m, b.easting_max_m, b.northing_max_m] for b in boxes])
        widest = float(self.reach_m.max())
        wide = shapely.box(*(own + widest * np.array([-1.0, -1.0, 1.0, 1.0])).T)
        box, picture = self._places.query(wide)
        beyond = np.maximum(own[box, :2] - self.place_m[picture], self.place_m[picture] - own[box, 2:])
        far = np.hypot(*np.maximum(beyond, 0.0).T)
        return np.unique(picture[far <= self.reach_m[picture]])

    def chosen(self, numbers: Int64) -> Pictures:
        """Returns those of some numbers (k,), in their order."""
        return self._picked(numbers)

    def key(self) -> str:
        """Returns a hash of all that colours from these pictures depend on, except the rule."""
        digest = hashlib.blake2b(self.lens_key.encode(), digest_size=8)
        views = self.views
        for values in (views.eye_world_m, views.opencv_from_world, views.up_world, views.lens, views.row_motion):
            digest.update(np.ascontiguousarray(values).tobytes())
        for number, file in enumerate(self.files):
            digest.update(f"{self.worlds[views.world[number]]}\0{self.logs[self.log[number]].key}\0{file}\n".encode())
        return digest.hexdigest()

    @functools.cached_property
    def _places(self) -> Any:
        return shapely.STRtree(shapely.points(self.place_m))

    def _picked(self, index: Int64) -> Pictures:
        return replace(
            self, views=self.views.picked(index), place_m=self.place_m[index], reach_m=self.reach_m[index],
            log=self.log[index], epochs_gps_ns=self.epochs_gps_ns[index],
            files=tuple(self.files[i] for i in index.tolist()), notes=(),
        )  # fmt: skip


def check_pictures(plan: SurveyPlan, rule: PictureRule) -> None:
    """Raise where the survey has no pictures from which the rule could take colours; reads no pose and no picture."""
    for camera, taken in _camera_logs(plan, rule):
        _fits(camera, taken)


def check_folders(plan: SurveyPlan, rule: PictureRule) -> None:
    """Raise where the files of pictures are missing: the tables contain their times only."""
    for _, taken in _camera_logs(plan, rule):
        folder = folder_of(plan, taken)
        if not folder.exists():
            raise ConfigError(
                f"the pictures of {taken.record.run}/{taken.record.sensor} are not where the survey file says",
                expected="the log as it was ingested",
                change=f"bring it back, or {_WITHOUT}",
                file=folder,
            )


def plan_pictures(plan: SurveyPlan, rule: PictureRule) -> Pictures:
    """Returns the survey's pictures with their poses.

    Raises
    ------
    ConfigError
        where no camera of the rig fits the rule, or one has no interior orientation that fits its pictures.
    RunError
        where no picture is in the store, or none has a pose.
    """
    placed: list[_Placed] = []
    notes: list[str] = []
    for camera, taken in _camera_logs(plan, rule):
        placed.append(_placed(plan, camera, taken, rule))
        notes += placed[-1].notes
    if not any(one.files for one in placed):
        raise RunError(
            "none of the pictures has a pose: " + "; ".join(notes),
            expected="pictures taken while the trajectory runs",
            change="check the clock of the camera's log",
        )
    cameras = sorted({(one.log.sensor, one.camera) for one in placed}, key=lambda c: c[0])
    lenses = {name: number for number, (name, _) in enumerate(cameras)}
    worlds = tuple(sorted({one.world for one in placed}))
    epoch = np.concatenate([one.epochs_gps_ns for one in placed])
    log = np.repeat(np.arange(len(placed)), [one.epochs_gps_ns.size for one in placed])
    files = [name for one in placed for name in one.files]
    order = np.array(sorted(range(epoch.size), key=lambda i: (epoch[i], *placed[log[i]].names, files[i])), np.int64)
    counted = [(worlds.index(one.world), lenses[one.log.sensor]) for one in placed]
    views = Views(
        np.concatenate([one.eye_world_m for one in placed]), np.concatenate([one.opencv_from_world for one in placed]),
        np.concatenate([one.up_world for one in placed]), np.array([w for w, _ in counted])[log],
        np.array([k for _, k in counted])[log], tuple(_lens(camera) for _, camera in cameras),
        np.concatenate([one.row_motion for one in placed]),
    )  # fmt: skip
    return Pictures(
        rule, plan.ground.map, worlds, views.picked(order),
        np.concatenate([one.place_m for one in placed])[order], np.concatenate([one.reach_m for one in placed])[order],
        tuple(one.log for one in placed), log[order], epoch[order], tuple(files[i] for i in order.tolist()),
        _lens_key(cameras), tuple(notes),
    )  # fmt: skip


@dataclass(frozen=True)
class _Placed:
    """Pictures of a log that have a pose."""

    log: PictureLog
    camera: Sensor
    world: str
    epochs_gps_ns: Int64
    files: tuple[str, ...]
    eye_world_m: Float64
    opencv_from_world: Float64
    up_world: Float64
    row_motion: Float64
    place_m: Float64
    reach_m: Float64
    notes: tuple[str, ...]

    @property
    def names(self) -> tuple[str, str]:
        """Returns the keys that order pictures of one epoch."""
        return self.log.run, self.log.sensor


def _camera_logs(plan: SurveyPlan, rule: PictureRule) -> list[tuple[Sensor, TakenPictures]]:
    """Returns logs of pictures with their cameras."""
    changes = load_camera_changes(plan.store)
    cameras = [(name, _changed(one, changes.get(name))) for name, one in rule_cameras(plan.survey.rig, rule)]
    found = [(c, taken) for name, c in cameras for taken in camera_pictures(plan, name)]
    usable = [(c, taken) for c, taken in found if taken.files]
    if not usable:
        names = ", ".join(name for name, _ in cameras)
        raise RunError(
            f"the cameras ({names}) have no pictures in the store",
            expected="a log of pictures (images): a folder of files with their stamps, or a video",
            change=f"list it in the survey file, or {_WITHOUT}",
        )
    return usable


def _changed(camera: Sensor, change: Float64 | None) -> Sensor:
    """Returns a camera with the lens that an adjustment found."""
    if camera.interior is None:
        return camera
    return camera.model_copy(update={"interior": changed(camera.interior, change)})


def rule_cameras(rig: Rig, rule: PictureRule) -> list[tuple[str, Sensor]]:
    """Returns cameras of a rig that a rule uses; each has an interior orientation. ConfigError where there are none."""
    known = {name: sensor for name, sensor in rig.sensors.items() if sensor.kind == "camera"}
    for name in rule.cameras:
        if name not in known:
            raise ConfigError(
                f"the rig has no camera '{name}'{nearest(name, known)}", expected=", ".join(known) or "one with cameras"
            )
    asked = {name: known[name] for name in rule.cameras or known}
    if not asked:
        raise ConfigError(
            "colours of cameras are asked for, and the rig has no camera",
            change=f"add it to the rig file, or {_WITHOUT}",
        )
    oriented = [(name, sensor) for name, sensor in asked.items() if sensor.interior is not None]
    if not oriented or (rule.cameras and len(oriented) < len(asked)):
        blind = next(name for name, sensor in asked.items() if sensor.interior is None)
        raise ConfigError(
            f"the camera '{blind}' has no interior orientation in the rig file",
            expected=f"[sensors.{blind}.interior]",
            change="find it from chessboard pictures: `roadscan camera interior`",
        )
    return oriented


def _lens(camera: Sensor) -> Lens:
    if camera.interior is None:
        raise ConfigError("a camera has no interior orientation")
    return Lens.of(camera.interior, camera.own_vehicle_px)


def _lens_key(cameras: Sequence[tuple[str, Sensor]]) -> str:
    stated = [(c.interior.model_dump(mode="json") if c.interior else None, c.own_vehicle_px) for _, c in cameras]
    return hashlib.blake2b(repr(stated).encode(), digest_size=8).hexdigest()


def _placed(plan: SurveyPlan, camera: Sensor, taken: TakenPictures, rule: PictureRule) -> _Placed:
    """Returns poses of a log's pictures; those without one, or of another size than the lens is for, are left out."""
    record = taken.record
    log = PictureLog(record.key, record.run, record.sensor, folder_of(plan, taken))
    source = trajectory_source(record.run, plan.records)
    mountings = mountings_of(record.run, record.sensor, camera.mounting(), load_mountings(plan.store))
    change = change_of(load_mounting_changes(plan.store), record.run, record.sensor)
    mountings = mountings if change is None else change.applied(mountings, parallel=False)
    order = np.argsort(taken.epochs_gps_ns, kind="stable")
    fits = order[_fits(camera, taken)[order]]
    filmed = load_camera_changes(plan.store).get(record.sensor)
    epochs = taken.epochs_gps_ns[fits] + clock_ns(filmed)
    found, eye, turn = _eyes_at(plan, source, epochs, mountings)
    motion = _row_motion(plan, camera, (source, epochs, mountings), filmed)
    eye, turn, motion, kept = eye[found], turn[found], motion[found], fits[found]
    place, reach = _reach(plan.ground.map, source.world, eye, rule.reach_m)
    names = tuple(taken.files[i] for i in kept.tolist())
    up = -world_from_ned(source.world, eye)[:, :, 2]
    notes = _notes(log, camera, order.size - fits.size, fits.size - kept.size)
    return _Placed(
        log, camera, source.world, taken.epochs_gps_ns[kept], names, eye, turn, up, motion, place, reach, notes
    )


def _fits(camera: Sensor, taken: TakenPictures) -> npt.NDArray[np.bool_]:
    """Mask (n,) of pictures of the size for which the interior orientation holds; raises where there are none."""
    if camera.interior is None:
        raise ConfigError("a camera has no interior orientation")
    size = camera.interior.width_px, camera.interior.height_px
    fits: npt.NDArray[np.bool_] = ((taken.size_px == 0) | (taken.size_px == size)).all(axis=1)
    if fits.size and not fits.any():
        width, height = taken.size_px[0].tolist()
        raise ConfigError(
            f"the pictures of '{taken.record.sensor}' have {width} × {height} pixels, and its interior orientation "
            f"holds for {size[0]} × {size[1]}",
            expected="pictures as the camera was calibrated with: not scaled, not turned",
            file=taken.record.path,
        )
    return fits


def _poses(plan: SurveyPlan, source: TrajectorySource, epochs_gps_ns: Int64) -> Iterator[Poses]:
    """Yields poses of the body, piece by piece, at epochs (n,) in order."""
    pieces = epochs_gps_ns // _PIECE_NS
    for part in np.split(epochs_gps_ns, np.flatnonzero(np.diff(pieces)) + 1):
        span = (int(part[0]), int(part[-1]))
        yield load_trajectory(plan.store, source, [span], plan.ground.max_gap_s).poses(part)


def _eyes_at(
    plan: SurveyPlan, source: TrajectorySource, epochs_gps_ns: Int64, mountings: Mountings
) -> tuple[npt.NDArray[np.bool_], Float64, Float64]:
    """Returns whether there is a pose at epochs (n,) in order, projection centres (n, 3), and rotations (n, 3, 3)."""
    poses = list(_poses(plan, source, epochs_gps_ns))
    found = np.concatenate([p.found for p in poses]) if poses else np.zeros(0, np.bool_)
    eye, turn = (np.concatenate(a) for a in zip(*(_eyes(p, mountings) for p in poses), strict=True))
    return found, eye, turn


def _row_motion(
    plan: SurveyPlan, camera: Sensor, exposed: tuple[TrajectorySource, Int64, Mountings], change: Float64 | None
) -> Float64:
    """Returns way (m) and turn (rad) of a camera (n, 6) from row to row, along its axes: the mean of a picture; 0 where
    a pose at its first or last row is missing, and without a rolling shutter.

    exposed : trajectory, epochs (n,) of the middle rows, and mountings.
    """
    from scipy.spatial.transform import Rotation

    source, epochs, mountings = exposed
    motion = np.zeros((epochs.size, 6))
    if camera.interior is None or not (each_ns := row_ns(camera.interior, change)):
        return motion
    rows = max(camera.interior.height_px - 1, 1)
    half = round(0.5 * rows * each_ns)
    (first, here, last) = (_eyes_at(plan, source, epochs + k * half, mountings) for k in (-1, 0, 1))
    known = first[0] & here[0] & last[0]
    motion[known, :3] = np.einsum("nij,nj->ni", here[2][known], last[1][known] - first[1][known]) / rows
    # Axes from the world turn against the camera.
    turned = first[2][known] @ last[2][known].transpose(0, 2, 1)
    motion[known, 3:] = Rotation.from_matrix(turned).as_rotvec() / rows
    return motion


def _eyes(poses: Poses, mountings: Mountings) -> tuple[Float64, Float64]:
    """Returns projection centres (n, 3) in the world frame, and rotations (n, 3, 3) from it to the camera's axes."""
    eye, turn = np.empty_like(poses.position_world_m), np.empty_like(poses.world_from_body)
    for part, mounting in mountings.pieces(poses.epochs_gps_ns):
        rotation, lever = mounting.arrays()
        body = poses.world_from_body[part]
        eye[part] = poses.position_world_m[part] + (
            body[:, :, 0] * lever[0] + body[:, :, 1] * lever[1] + body[:, :, 2] * lever[2]
        )
        turn[part] = (rotation @ SENSOR_FROM_OPENCV).T @ body.transpose(0, 2, 1)
    return eye, turn


def _reach(frame: MapFrame, world: str, eye_m: Float64, reach_m: float) -> tuple[Float64, Float64]:
    """Returns easting and northing (n, 2) of cameras, and the length (n,) of a distance around them on the map."""
    axes = world_from_ned(world, eye_m)
    places = [frame.map_from_world(world, eye_m + reach_m * axes[:, :, k])[:, :2] for k in (0, 1)]
    middle = frame.map_from_world(world, eye_m)[:, :2]
    return middle, _CURVED * np.maximum(*(np.hypot(*(p - middle).T) for p in places))


def _notes(log: PictureLog, camera: Sensor, misfits: int, unplaced: int) -> tuple[str, ...]:
    name = f"{log.run}/{log.sensor}"
    notes = []
    if misfits:
        size = "" if camera.interior is None else f"{camera.interior.width_px} × {camera.interior.height_px}"
        notes.append(f"{name}: {misfits:,} pictures are not of the {size} pixels that its interior orientation is for")
    if unplaced:
        notes.append(f"{name}: {unplaced:,} pictures were taken where the trajectory has no pose")
    return tuple(notes)
