"""A short piece of the simulated town street: what its lidar hits, with the noise of its ranges, and its true kerbs."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np

from roadscan.simulate import Scene
from roadscan.simulate.caster import World
from roadscan.simulate.drive import drives_of
from roadscan.simulate.lidar_model import lidar_model
from roadscan.simulate.path import Earth
from roadscan.simulate.sensors import lidar
from roadscan.simulate.surface import Surface
from tests.assets.edges.streets import Street, returns_of

HDL32E = lidar_model("HDL-32E")

Array = np.ndarray[Any, Any]


class SimulatedStreet(NamedTuple):
    """A street, and the surface that it was made of; `corner_m` is easting and northing of the returns' (0, 0)."""

    street: Street
    surface: Surface
    scene: Scene
    corner_m: Array


@functools.cache
def town_street(length_m: float = 30.0, every: int = 1, seed: int = 3302) -> SimulatedStreet:
    """Both passes over the first metres of `urban_street`; of the lidar's blocks of 128 packets one in `every`."""
    scene = Scene.load("urban_street").changed(
        length_m=length_m, seed=seed, passes=[{"lane": 2}, {"lane": 1, "direction": "backward"}],
        profilers={"spacing_m": 1.0}, sick={"on": False}, camera={"on": False},
    )  # fmt: skip
    surface, ride = Surface(scene), Surface(scene, ride=True)
    world = World(scene, surface)
    rng = np.random.default_rng(seed)
    parts: list[tuple[Array, ...]] = []
    tracks = []
    corner = np.array([scene.map.easting_m, scene.map.northing_m, 0.0])
    for drive in drives_of(scene, Earth(scene.map.crs), ride):
        start = lidar.starts_gps_ns(drive)
        count = int((drive.duration_s + 1.0) * 1e9) // HDL32E.block_ns // lidar.BLOCK_PACKETS
        for number in range(0, count, every):
            packets = number * lidar.BLOCK_PACKETS + np.arange(lidar.BLOCK_PACKETS)
            aims = lidar._aim(scene, 0.0, packets)
            block = lidar._measure_block(scene, world, drive, start + packets * HDL32E.block_ns, aims, number, number)
            epoch = block.firing_gps_ns().reshape(len(packets), -1)
            position, _ = drive.poses(block.epoch_gps_ns).sensor(scene.lidar.mount, lidar.BODY_FROM_AXES)
            sensor = drive.earth.map_from_ecef(position) - corner
            seen = np.isfinite(block.found.range_m) & (block.ranges.reshape(epoch.shape) > 0)
            hit, origin = block.found.enh_m[seen] - corner, np.repeat(sensor, seen.sum(axis=1), axis=0)
            ray = (hit - origin) / np.linalg.norm(hit - origin, axis=1, keepdims=True)
            hit = hit + scene.noise.lidar_range_m * rng.standard_normal((len(hit), 1)) * ray
            parts.append((hit, block.found.intensity[seen], epoch[seen], origin,
                          np.full(len(hit), drive.number + 1), block.found.object_id[seen]))  # fmt: skip
            tracks.append(np.append(sensor[0], drive.number + 1.0))
    hit, intensity, epoch, origin, passes, objects = (np.concatenate(column) for column in zip(*parts, strict=True))
    street = Street(returns_of(hit, intensity * 200, epoch, origin, passes), objects, np.array(tracks))
    return SimulatedStreet(street, surface, scene, corner)
