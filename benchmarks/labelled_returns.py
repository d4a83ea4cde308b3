"""Returns of a simulated street in memory, as the readers give them, with the object and the class of each.

A training script calls, once a seed:

    from benchmarks.hard_streets import hard_street
    from benchmarks.labelled_returns import CLASSES, labelled_returns

    street = labelled_returns(hard_street(seed))
    street.returns       # roadscan.assets.scene.Returns (n): place, intensity, laser, epoch, pass, sensor's place
    street.class_id      # (n,) number of the semantic class of each return, an index of CLASSES
    street.object_id     # (n,) the object of the truth that it met; 0: the ground, -1: noise
    street.kind          # (n,) kind of that object, an index of street.kinds
    street.objects       # the truth's table of objects; street.surface: heights of the bare earth

Places have the errors of the stated poses, of ranges, lasers and widths of beams; labels are those of the true hit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pandas as pd

from benchmarks.street_classes import class_of_kind, find_paint, kerb_heights
from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box, Returns
from roadscan.assets.scene import Scene as AssetScene
from roadscan.simulate import Scene
from roadscan.simulate.bodies import CLASSES, class_number
from roadscan.simulate.caster import World
from roadscan.simulate.drive import Drive, Poses, drives_of
from roadscan.simulate.kernels.road import KERB_TOP_M
from roadscan.simulate.path import Earth, LocalMap
from roadscan.simulate.sensors.lidar import BODY_FROM_AXES, Packets, beam_width_deg, measure
from roadscan.simulate.surface import Surface
from roadscan.simulate.things import objects_table
from roadscan.simulate.trajectory import PoseErrors, first_gps_ns, stated_poses

__all__ = ["CLASSES", "LabelledReturns", "labelled_returns"]

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

_DRIVE_STEP: Final = 2_000
"""Returns from one place of the sensor in `drive_xyh_m` to the next, at least."""
_AROUND_M, _STEP_M = 40.0, 10.0
"""Margin around a drive, and the step of the corners of its square (m)."""
_REACH_M: Final = 150.0
"""Distance from the middle of a street within which its map is one quadratic polynomial (m): good to 1 µm."""


@dataclass(frozen=True, eq=False)
class LabelledReturns:
    """What a lidar recorded of a simulated street, in the order of time, and what each return met."""

    returns: Returns
    """(n,) from the scene's place on the map."""
    object_id: npt.NDArray[np.int32]
    """(n,) object of the truth; 0: the ground, −1: none."""
    kind: npt.NDArray[np.int16]
    """(n,) index of `kinds`."""
    class_id: npt.NDArray[np.uint8]
    """(n,) index of :data:`CLASSES`."""
    is_mixed: npt.NDArray[np.bool_]
    """(n,) whether the range is a mixture of several things'."""
    true_xyh_m: npt.NDArray[np.float32]
    """(n, 3) what the beam met, from the same corner; NaN of false returns."""
    kinds: tuple[str, ...]
    """Kinds of objects; the first two are `none` and `ground`."""
    objects: pd.DataFrame
    """The truth's objects."""
    drive_xyh_m: Float64
    """(p, 4) place of the sensor on its way, and the pass."""
    surface: Surface
    world: World


def labelled_returns(scene: Scene, *, laser_numbers: bool = True) -> LabelledReturns:
    """Return every recorded return of a scene's passes, placed with the stated poses, with its labels.

    laser_numbers : False: all 0, as from clouds without them (a KITTI sweep, a PCD without rings).
    """
    earth, surface = Earth(scene.map.crs), Surface(scene)
    world = World(scene, surface)
    parts = [_of_pass(scene, world, drive) for drive in drives_of(scene, earth, Surface(scene, ride=True))]
    columns = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
    label = {name: columns.pop(name) for name in ("object_id", "part", "is_mixed", "met")}
    if not laser_numbers:
        columns["laser"] = np.zeros_like(columns["laser"])
    corner = surface.origin_enh_m[:2]
    returns = Returns(
        corner_m=(float(corner[0]), float(corner[1])),
        sensors=(scene.lidar.model.lower().replace("-", ""),),
        divergence_deg=(beam_width_deg(scene),),
        **columns,
    )
    kinds, kind = _kinds(world, label["object_id"])
    return LabelledReturns(
        returns, label["object_id"], kind, _classes(scene, surface, kinds, kind, label), label["is_mixed"],
        (label["met"] - [*corner, 0.0]).astype(np.float32), kinds, objects_table(scene, surface).to_pandas(),
        _ways(returns), surface, world,
    )  # fmt: skip


def scene_about(seen: LabelledReturns, rows: npt.NDArray[np.int64]) -> tuple[AssetScene, npt.NDArray[np.int64]]:
    """The scene of some returns of a street, of the square about where they were seen from, and the rows in it."""
    own = seen.returns.at(rows)
    way = np.column_stack([own.sensor_x_m, own.sensor_y_m])
    corners = np.concatenate([np.floor((way.min(axis=0) - _AROUND_M) / _STEP_M),
                              np.ceil((way.max(axis=0) + _AROUND_M) / _STEP_M)]) * _STEP_M  # fmt: skip
    box = Box(*corners.tolist())
    kept = np.flatnonzero(box.holds(own.x_m, own.y_m))
    drive = seen.drive_xyh_m
    passed = ((drive[:, :2] > way.min(axis=0) - 1.0) & (drive[:, :2] < way.max(axis=0) + 1.0)).all(axis=1)
    return make_scene(own.at(kept), box, box, drive[passed]), rows[kept]


# --- places ------------------------------------------------------------------------------------------


def _of_pass(scene: Scene, world: World, drive: Drive) -> dict[str, npt.NDArray[Any]]:
    """Return columns of one pass, those of :class:`Returns` and of the labels."""
    surface = world.surface
    middle = drive.poses(np.array([np.mean(drive.recorded_span_gps_ns)]).astype(np.int64)).position_ecef_m[0]
    local = LocalMap.around(drive.earth, middle, surface.origin_enh_m, _REACH_M)
    stated = _Stated(scene, drive)
    blocks = [_of_block(scene, drive, block, stated, local) for block in measure(scene, world, drive)]
    columns = {name: np.concatenate([b[name] for b in blocks]) for name in blocks[0]}
    count = len(columns["x_m"])
    for name in ("height_m", "sensor_height_m"):
        columns[name] += surface.origin_enh_m[2]
    ones = np.ones(count, np.uint8)
    return columns | {
        "pass_id": np.full(count, drive.number + 1, np.uint16), "sensor": np.zeros(count, np.uint8),
        "return_number": ones, "number_of_returns": ones,
    }  # fmt: skip


class _Stated:
    """The stated poses of a pass: true ones with the errors of the scene's noise, as its trajectory's log has them."""

    def __init__(self, scene: Scene, drive: Drive) -> None:
        step = round(1e9 / scene.trajectory.poses_per_s)
        first = first_gps_ns(scene, drive)
        self._epochs = np.arange(first, drive.recorded_span_gps_ns[1] + step, step)
        self._errors = PoseErrors(scene, drive.number).take(self._epochs.size)
        self._drive = drive

    def poses(self, epoch_gps_ns: Int64) -> Poses:
        """Return stated poses at epochs (n,): errors are linear between the poses of the log."""
        here = self._drive.poses(epoch_gps_ns)
        position, attitude = (
            np.stack([np.interp(epoch_gps_ns, self._epochs, column) for column in one.T], axis=-1)
            for one in self._errors
        )
        at, turned = stated_poses(self._drive, here, position, attitude)
        return Poses(at, turned)


def _of_block(
    scene: Scene, drive: Drive, block: Packets, stated: _Stated, local: LocalMap
) -> dict[str, npt.NDArray[Any]]:
    """Return columns of a block's returns; heights count from the origin."""
    seen = block.ranges > 0
    packet, cycle, laser = np.nonzero(seen)
    model = block.model
    ends = np.stack([block.epoch_gps_ns, block.epoch_gps_ns + model.block_ns], axis=-1)
    at, rotation = stated.poses(ends.ravel()).sensor(scene.lidar.mount, BODY_FROM_AXES)
    origin = local.enu_from_ecef(at).reshape(-1, 2, 3)
    turned = (local.ecef_from_enu.T @ rotation).reshape(-1, 2, 3, 3)
    epoch = block.firing_gps_ns()[seen]
    share = ((epoch - block.epoch_gps_ns[packet]) / model.block_ns)[:, None]
    elevation, azimuth = np.radians(block.elevation_deg[seen]), np.radians(block.azimuth_deg[seen])
    flat, range_m = np.cos(elevation), block.ranges[seen] * model.figures.range_step_m
    own = range_m[:, None] * np.stack([flat * np.cos(azimuth), -flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
    own[:, 2] += model.rise_m[laser]
    first = np.einsum("nij,nj->ni", turned[packet, 0], own) + origin[packet, 0]
    last = np.einsum("nij,nj->ni", turned[packet, 1], own) + origin[packet, 1]
    place = _bent(local, first + share * (last - first))
    sensor = _bent(local, origin[packet, 0] + share * (origin[packet, 1] - origin[packet, 0]))
    rows = packet, cycle * model.lasers + laser
    found = block.found
    return {
        "x_m": place[:, 0], "y_m": place[:, 1], "height_m": place[:, 2],
        "intensity": block.intensity[seen].astype(np.float32) * np.float32(257.0), "epoch_gps_ns": epoch,
        "laser": laser.astype(np.uint16), "sensor_x_m": sensor[:, 0], "sensor_y_m": sensor[:, 1],
        "sensor_height_m": sensor[:, 2], "object_id": found.object_id[rows], "part": found.part[rows],
        "is_mixed": found.is_mixed[rows], "met": found.enh_m[rows],
    }  # fmt: skip


def _bent(local: LocalMap, enu_m: Float64) -> Float64:
    """Return map coordinates (n, 3) of places east, north and up of an anchor, from the scene's origin."""
    x, y, z = enu_m.T
    powers = np.stack([np.ones_like(x), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z])
    return np.asarray((local.bases @ powers).T)


def _ways(returns: Returns) -> Float64:
    """Return places of the sensor (p, 4) every so many returns of each pass."""
    columns = (returns.sensor_x_m, returns.sensor_y_m, returns.sensor_height_m, returns.pass_id)
    return np.stack([c[::_DRIVE_STEP].astype(np.float64) for c in columns], axis=-1)


# --- labels ------------------------------------------------------------------------------------------


def _kinds(world: World, object_id: npt.NDArray[np.int32]) -> tuple[tuple[str, ...], npt.NDArray[np.int16]]:
    """Return the kinds of a world, and that of each return (n,)."""
    objects = [*world.objects, *world.moving]
    kinds = ("none", "ground", *sorted({o.kind for o in objects}))
    number = np.array([1, *(kinds.index(o.kind) for o in objects), 0], np.int16)
    return kinds, number[object_id]


def _classes(
    scene: Scene, surface: Surface, kinds: tuple[str, ...], kind: npt.NDArray[np.int16],
    label: dict[str, npt.NDArray[Any]],
) -> npt.NDArray[np.uint8]:  # fmt: skip
    """Return the class of each return (n,): of the body met, else of its object's kind, else of the place."""
    of_kind = np.array([0, 0, *(class_of_kind(name) for name in kinds[2:])], np.uint8)
    out = np.where(label["part"] > 0, label["part"].astype(np.uint8), of_kind[kind])
    ground = label["object_id"] == 0
    out[ground] = ground_classes(scene, surface, label["met"][ground, 0], label["met"][ground, 1])
    return np.asarray(out)


def ground_classes(
    scene: Scene, surface: Surface, easting_m: Float64, northing_m: Float64
) -> npt.NDArray[np.uint8]:  # fmt: skip
    """Return the class (n,) of places on the ground: by the road's cross-section, and by its paint.

    The paved strip beside the lanes is for parking where a kerb is beyond it.
    """
    road = scene.road
    station, offset = surface.station_offset_m(easting_m, northing_m)
    away, kerb_m = np.abs(offset), np.empty(offset.size)
    kerb_heights(surface.arrays, station, offset, kerb_m)
    beyond = away - road.paved_m
    walk_m = np.inf if road.grass is None and road.kerbs else 0.0 if road.grass is None else road.grass.from_m
    out = np.full(offset.size, class_number("road"), np.uint8)
    out[(away > road.half_width_m) & (kerb_m > 0.0)] = class_number("parking")
    out[beyond > 0.0] = class_number("sidewalk")
    out[beyond > walk_m] = class_number("terrain")
    out[(beyond > 0.0) & (beyond <= KERB_TOP_M) & (kerb_m > 0.0)] = class_number("kerb")
    paint = np.empty(offset.size, np.bool_)
    find_paint(surface.arrays, station, offset, paint)
    out[paint & (beyond <= 0.0)] = class_number("marking")
    return out
