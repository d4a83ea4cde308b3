"""Returns of a simulated lidar on a simulated street, made in memory, with the object that each one hit."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.assets.scene import Returns
from roadscan.simulate import Scene
from roadscan.simulate.caster import World
from roadscan.simulate.drive import drives_of
from roadscan.simulate.path import Earth
from roadscan.simulate.sensors.lidar import BODY_FROM_AXES, measure
from roadscan.simulate.surface import Surface


class Street(NamedTuple):
    """What a lidar saw of a simulated street."""

    returns: Returns
    """From the map's place in the scene."""
    object_id: npt.NDArray[np.int32]
    """(n,) what each return hit: 0 for the road and its verges."""
    mixed: npt.NDArray[np.bool_]
    """(n,) ranges that are mixtures."""
    drive_xyh_m: npt.NDArray[np.float64]
    """(p, 4) the sensor each tenth of a second, and the pass."""
    surface: Surface
    world: World


def street(scene: Scene) -> Street:
    """Every recorded return of a scene's passes, placed with the true poses and the noise of the ranges."""
    earth, surface = Earth(scene.map.crs), Surface(scene)
    world = World(scene, surface)
    corner = surface.origin_enh_m[:2]
    columns: list[list[npt.NDArray[Any]]] = []
    drives = []
    for drive in drives_of(scene, earth, Surface(scene, ride=True)):
        for block in measure(scene, world, drive):
            seen = block.ranges > 0
            flat = seen.reshape(len(seen), -1)
            epoch = block.firing_gps_ns()[seen]
            packet = block.epoch_gps_ns + np.arange(2)[:, None] * 600_000
            ends = earth.map_from_ecef(drive.poses(packet.ravel()).sensor(scene.lidar.mount, BODY_FROM_AXES)[0])
            first, last = ends.reshape(2, -1, 3)
            row = np.nonzero(seen)[0]
            share = ((epoch - block.epoch_gps_ns[row]) / 600_000)[:, None]
            sensor = first[row] + share * (last[row] - first[row])
            hit = block.found.enh_m[flat]
            scale = block.ranges[seen] * block.model.figures.range_step_m / block.found.range_m[flat]
            place = sensor + (hit - sensor) * scale[:, None]
            laser = np.broadcast_to(np.arange(32, dtype=np.uint16), seen.shape)[seen]
            number = np.full(len(epoch), drive.number + 1, np.uint16)
            columns.append(
                [
                    epoch,
                    place,
                    sensor,
                    block.intensity[seen],
                    laser,
                    number,
                    block.found.object_id[flat],
                    block.found.is_mixed[flat],
                ]
            )
        epochs = np.unique(np.concatenate([c[0][::2000] for c in columns if c[5][0] == drive.number + 1]))
        at = earth.map_from_ecef(drive.poses(epochs).sensor(scene.lidar.mount, BODY_FROM_AXES)[0])
        drives.append(np.column_stack([at - [*corner, 0.0], np.full(len(at), drive.number + 1.0)]))
    epoch, place, sensor, light, laser, number, owner, mixed = (np.concatenate(c) for c in zip(*columns, strict=True))
    ones = np.ones(len(epoch), np.uint8)
    returns = Returns(
        corner_m=(float(corner[0]), float(corner[1])),
        x_m=place[:, 0] - corner[0],
        y_m=place[:, 1] - corner[1],
        height_m=place[:, 2].copy(),
        intensity=light.astype(np.float32) * 257.0,
        epoch_gps_ns=epoch,
        pass_id=number,
        sensor=np.zeros(len(epoch), np.uint8),
        laser=laser,
        return_number=ones,
        number_of_returns=ones,
        sensor_x_m=sensor[:, 0] - corner[0],
        sensor_y_m=sensor[:, 1] - corner[1],
        sensor_height_m=sensor[:, 2].copy(),
        sensors=("hdl32e",),
    )
    return Street(returns, owner, mixed, np.concatenate(drives), surface, world)
