"""Scenes of a stretch of a simulated street for tests of paint, and which of its returns lie on paint."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box, Returns, Scene
from roadscan.simulate.caster import World, ray_key
from roadscan.simulate.drive import Drive, drives_of
from roadscan.simulate.lidar_model import lidar_model
from roadscan.simulate.noise import stream
from roadscan.simulate.path import Earth
from roadscan.simulate.scene import Scene as SimulatedScene
from roadscan.simulate.sensors import lidar
from roadscan.simulate.surface import Surface

HDL32E = lidar_model("HDL-32E")

Float64 = npt.NDArray[np.float64]

HALO_M = 8.0
_TALL = ("facades", "fences", "trees", "lamp_posts", "guardrails", "signs", "poles")
_PAINT_FROM = 150.0
"""Digital numbers of the simulator: paint is 190, a kerb 135."""


@dataclass(frozen=True, eq=False)
class SimulatedStreet:
    """A tile of a street with its halo."""

    scene: Scene
    on_paint: npt.NDArray[np.bool_]
    """(n,) which returns hit paint."""
    surface: Surface

    def station_offset_m(self, x_m: Float64, y_m: Float64) -> tuple[Float64, Float64]:
        """Station and offset of points (n,) that count from the corner of the scene's returns."""
        east, north = self.scene.returns.corner_m
        return self.surface.station_offset_m(east + np.asarray(x_m), north + np.asarray(y_m))


@functools.cache
def street(name: str, station_m: float, tile_m: float = 40.0, *, whole: bool = False) -> SimulatedStreet:
    """The tile around a station of a scene of the simulator, as the lidar saw it in the first pass.

    Unless it is wanted whole, the pass makes no stop, and what stands beside the road is left out but for cars: that
    takes seconds in place of minutes.
    """
    scene = SimulatedScene.load(name)
    if not whole:
        roadside = scene.roadside.model_copy(update={kind: [] for kind in _TALL})
        first = scene.passes[0].model_copy(update={"stops": []})
        scene = scene.model_copy(update={"roadside": roadside, "passes": [first]})
    return street_of(scene, station_m, tile_m)


def street_of(scene: SimulatedScene, station_m: float, tile_m: float = 40.0) -> SimulatedStreet:
    """The tile around a station of a scene, as the lidar saw it in the first pass."""
    surface, earth = Surface(scene), Earth(scene.map.crs)
    easting, northing, _ = surface.place(np.array([station_m]), np.array([0.0]))
    corner = tuple(5.0 * round(float(v[0] - tile_m / 2) / 5.0) for v in (easting, northing))
    world = World(scene, surface)
    drive = drives_of(scene, earth, Surface(scene, ride=True))[0]
    tile = Box(0.0, 0.0, tile_m, tile_m)
    window = Box(-HALO_M, -HALO_M, tile_m + HALO_M, tile_m + HALO_M)
    arrays = _seen(
        scene, world, drive, (station_m - tile_m / 2 - HALO_M, station_m + tile_m / 2 + HALO_M), window, corner
    )
    on_paint = surface.intensity(arrays.pop("hit_e"), arrays.pop("hit_n")) > _PAINT_FROM
    on_paint &= arrays.pop("object_id") == 0
    returns = Returns(corner_m=(corner[0], corner[1]), sensors=("lidar",), **arrays)
    return SimulatedStreet(make_scene(returns, tile, window, _drives(returns)), on_paint, surface)


def faded(street: SimulatedStreet, contrast: float, worn: float) -> SimulatedStreet:
    """The street with paint of a share of its contrast, of which a share is worn off in flakes of some centimetres."""
    returns = street.scene.returns
    flakes = _flakes(returns.corner_m[0] + returns.x_m, returns.corner_m[1] + returns.y_m)
    bare = street.on_paint & (flakes < np.quantile(flakes[street.on_paint], worn))
    paint = street.on_paint & ~bare
    full = lidar.REFLECTIVITY * 120.0
    less = np.where(bare, full, np.where(paint, (1.0 - contrast) * full, 0.0))
    intensity = np.maximum(np.rint(returns.intensity - less), 1.0).astype(np.float32)
    return replace(street, scene=replace(street.scene, returns=replace(returns, intensity=intensity)), on_paint=paint)


def _seen(
    scene: SimulatedScene,
    world: World,
    drive: Drive,
    span_m: tuple[float, float],
    window: Box,
    corner: tuple[float, ...],
) -> dict[str, npt.NDArray[np.generic]]:
    """Columns of the returns of a pass within the window."""
    first = lidar.starts_gps_ns(drive)
    group = lidar.GROUP_PACKETS
    count = group * math.ceil((drive.duration_s + lidar.RUN_UP_S) * 1e9 / (group * HDL32E.block_ns))
    start_deg = float(stream(scene.seed, drive.number, "lidar head").integers(0, 36_000)) / 100.0
    key = ray_key(scene, drive, "lidar")
    parts = []
    for block, packet in enumerate(range(0, count, lidar.BLOCK_PACKETS)):
        numbers = np.arange(packet, min(packet + lidar.BLOCK_PACKETS, count))
        epochs = first + numbers * HDL32E.block_ns
        stations = drive.station_m(epochs[[0, -1]])
        if max(stations) < span_m[0] or min(stations) > span_m[1]:
            continue
        aims = lidar._aim(scene, start_deg, numbers)
        found = lidar._measure_block(
            scene, world, drive, epochs, aims, key + packet * HDL32E.figures.cycles * HDL32E.lasers, block
        )
        parts.append(_columns(scene, drive, found, window, corner))
    return {k: np.concatenate([p[k] for p in parts]) for k in parts[0]}


def _columns(
    scene: SimulatedScene, drive: Drive, packets: lidar.Packets, window: Box, corner: tuple[float, ...]
) -> dict[str, npt.NDArray[np.generic]]:
    seen = (packets.ranges > 0).reshape(len(packets.epoch_gps_ns), -1)
    epoch = packets.firing_gps_ns().reshape(seen.shape)
    at, _ = drive.poses(packets.epoch_gps_ns).sensor(scene.lidar.mount, lidar.BODY_FROM_AXES)
    sensor = np.repeat(drive.earth.map_from_ecef(at)[:, None], seen.shape[1], axis=1)[seen]
    hit = packets.found.enh_m[seen]
    share = packets.ranges.reshape(seen.shape)[seen] * HDL32E.figures.range_step_m / packets.found.range_m[seen]
    place = sensor + (hit - sensor) * share[:, None]
    x, y = place[:, 0] - corner[0], place[:, 1] - corner[1]
    inside = window.holds(x, y)
    n = int(inside.sum())
    laser = np.broadcast_to(np.arange(HDL32E.lasers), packets.ranges.shape).reshape(seen.shape)[seen]
    return {
        "x_m": x[inside], "y_m": y[inside], "height_m": place[inside, 2],
        "intensity": packets.intensity.reshape(seen.shape)[seen][inside].astype(np.float32),
        "epoch_gps_ns": epoch[seen][inside],
        "pass_id": np.full(n, drive.number + 1, np.uint16),
        "sensor": np.zeros(n, np.uint8),
        "laser": laser[inside].astype(np.uint16),
        "return_number": np.ones(n, np.uint8), "number_of_returns": np.ones(n, np.uint8),
        "sensor_x_m": sensor[inside, 0] - corner[0], "sensor_y_m": sensor[inside, 1] - corner[1],
        "sensor_height_m": sensor[inside, 2],
        "hit_e": hit[inside, 0], "hit_n": hit[inside, 1],
        "object_id": packets.found.object_id.reshape(seen.shape)[seen][inside],
    }  # fmt: skip


def _drives(returns: Returns) -> Float64:
    """Where the sensor was, every metre or so (p, 4)."""
    order = np.argsort(returns.epoch_gps_ns, kind="stable")
    _, first = np.unique(returns.epoch_gps_ns[order] // 50_000_000, return_index=True)
    rows = order[first]
    columns = (returns.sensor_x_m, returns.sensor_y_m, returns.sensor_height_m, returns.pass_id)
    return np.stack([c[rows].astype(np.float64) for c in columns], axis=1)


def _flakes(easting_m: Float64, northing_m: Float64, size_m: float = 0.08) -> Float64:
    """A smooth field (n,) of random numbers that belong to places: bilinear between the nodes of a lattice."""
    u, v = easting_m / size_m, northing_m / size_m
    i, j = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
    fu, fv = u - i, v - j

    def at(a: npt.NDArray[np.int64], b: npt.NDArray[np.int64]) -> Float64:
        mixed = a.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= b.astype(np.uint64) * np.uint64(0xC2B2AE3D27D4EB4F)
        mixed ^= mixed >> np.uint64(29)
        mixed *= np.uint64(0xBF58476D1CE4E5B9)
        return (mixed >> np.uint64(40)).astype(np.float64) / float(1 << 24)

    south = at(i, j) * (1 - fu) + at(i + 1, j) * fu
    north = at(i, j + 1) * (1 - fu) + at(i + 1, j + 1) * fu
    return np.asarray(south * (1 - fv) + north * fv)
