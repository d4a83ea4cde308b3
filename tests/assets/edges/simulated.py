"""A short piece of the simulated town street: what its lidar hits, with the noise of its ranges, and its true kerbs."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np

from roadscan.simulate import Scene
from roadscan.simulate.caster import World
from roadscan.simulate.drive import drives_of
from roadscan.simulate.earth import Earth
from roadscan.simulate.sensors.lidar import measure
from roadscan.simulate.surface import Surface
from tests.assets.edges.streets import Street, returns_of

Array = np.ndarray[Any, Any]


class SimulatedStreet(NamedTuple):
    """A street from the corner (0, 0), and the surface that it was made of; `corner_m` is easting, northing of (0, 0)."""

    street: Street
    surface: Surface
    scene: Scene
    corner_m: Array


@functools.cache
def town_street(length_m: float = 44.0, thinned: int = 1, seed: int = 3302) -> SimulatedStreet:
    """Both passes over the first metres of `urban_street`; `thinned` keeps every so manieth block of packets."""
    scene = Scene.load("urban_street").changed(
        length_m=length_m, seed=seed, passes=[{"lane": 2}, {"lane": 1, "direction": "backward"}],
        profilers={"spacing_m": 1.0}, sick={"on": False}, camera={"on": False},
    )  # fmt: skip
    surface, ride = Surface(scene), Surface(scene, ride=True)
    drives = drives_of(scene, Earth(scene.map.crs), ride)
    world = World(scene, surface)
    rng = np.random.default_rng(seed)
    parts: list[tuple[Array, ...]] = []
    tracks = []
    corner = np.array([scene.map.easting_m, scene.map.northing_m, 0.0])
    for drive in drives:
        for number, block in enumerate(measure(scene, world, drive)):
            if number % thinned:
                continue
            epoch = block.firing_gps_ns().reshape(len(block.epoch_gps_ns), -1)
            sensor = _sensor(scene, drive, world, block.epoch_gps_ns) - corner
            seen = np.isfinite(block.found.range_m) & (block.ranges.reshape(epoch.shape) > 0)
            hit = block.found.enh_m[seen] - corner
            origin = np.repeat(sensor, seen.sum(axis=1), axis=0)
            ray = (hit - origin) / np.linalg.norm(hit - origin, axis=1, keepdims=True)
            hit = hit + scene.noise.lidar_range_m * rng.standard_normal((len(hit), 1)) * ray
            parts.append((hit, block.found.intensity[seen], epoch[seen], origin,
                          np.full(len(hit), drive.number), block.found.object_id[seen]))  # fmt: skip
            tracks.append(np.column_stack([sensor[:1], [[float(drive.number)]]]))
    hit, intensity, epoch, origin, passes, objects = (np.concatenate(column) for column in zip(*parts, strict=True))
    street = Street(returns_of(hit, intensity * 200, epoch, origin, passes), objects, np.concatenate(tracks))
    return SimulatedStreet(street, surface, scene, corner)


def _sensor(scene: Scene, drive: Any, world: World, epoch: Array) -> Array:
    """Map coordinates (p, 3) of the lidar at epochs (p,)."""
    from roadscan.simulate.sensors.lidar import BODY_FROM_AXES

    position, _ = drive.poses(epoch).sensor(scene.lidar.mount, BODY_FROM_AXES)
    return np.asarray(drive.earth.map_from_ecef(position))
