"""Simulated streets as a spinning lidar sees them, with their truth, for tests of what stands upright."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.assets.returns import Returns
from roadscan.simulate.caster import World
from roadscan.simulate.drive import drives_of
from roadscan.simulate.earth import Earth
from roadscan.simulate.scene import Scene as Street
from roadscan.simulate.sensors.lidar import BODY_FROM_AXES, GROUP_PACKETS, RANGE_STEP_M, measure
from roadscan.simulate.surface import Surface
from roadscan.simulate.things import objects_table

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Seen:
    """What a lidar saw of a simulated street, and what stands there."""

    returns: Returns
    object_id: npt.NDArray[np.int32]
    """(n,) object of each return; 0: the ground."""
    drive: Float64
    """(p, 4) the drives."""
    objects: pa.Table
    surface: Surface


def seen_street(street: Street) -> Seen:
    """Returns of all passes of a street, with the noise of its scene, and its objects."""
    earth = Earth(street.map.crs)
    surface, ride = Surface(street), Surface(street, ride=True)
    world = World(street, surface)
    columns: list[tuple[npt.NDArray[np.generic], ...]] = []
    drives = []
    corner = np.floor(surface.origin_enh_m[:2] / 10.0) * 10.0
    for drive in drives_of(street, earth, ride):
        for block in measure(street, world, drive):
            seen = (block.ranges > 0).ravel()
            epochs = block.firing_gps_ns().ravel()
            knots = np.append(block.epoch_gps_ns, epochs[-1])
            ecef, _ = drive.poses(knots).sensor(street.lidar.mount, BODY_FROM_AXES)
            enh = earth.map_from_ecef(ecef)
            at = np.stack([np.interp(epochs, knots, enh[:, i]) for i in range(3)], axis=-1)[seen]
            found = block.found
            scale = block.ranges.ravel()[seen] * RANGE_STEP_M / found.range_m.ravel()[seen]
            hit = at + (found.enh_m.reshape(-1, 3)[seen] - at) * scale[:, None]
            laser = np.broadcast_to(np.arange(32, dtype=np.uint16), block.ranges.shape).ravel()[seen]
            n = len(hit)
            columns.append(
                (hit, at, block.intensity.ravel()[seen], epochs[seen], laser, found.object_id.ravel()[seen],
                 np.full(n, drive.number + 1, np.uint16))
            )  # fmt: skip
            drives.append(np.append(enh[:-1:GROUP_PACKETS], np.full((len(enh[:-1:GROUP_PACKETS]), 1), drive.number + 1), 1))
    hit, at, intensity, epoch, laser, number, passes = (np.concatenate(c) for c in zip(*columns, strict=True))
    drive_xyh = np.concatenate(drives)
    drive_xyh[:, :2] -= corner
    ones = np.ones(len(hit), np.uint8)
    returns = Returns(
        (float(corner[0]), float(corner[1])), hit[:, 0] - corner[0], hit[:, 1] - corner[1], hit[:, 2].copy(),
        intensity.astype(np.float32), epoch, passes, 0 * ones, laser, ones, ones,
        at[:, 0] - corner[0], at[:, 1] - corner[1], at[:, 2].copy(), ("lidar",),
    )  # fmt: skip
    return Seen(returns, number, drive_xyh, objects_table(street, surface), surface)
