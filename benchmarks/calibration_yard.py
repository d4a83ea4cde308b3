"""The simulated calibration yard as arrays: short drives in four directions, mountings unknown."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from benchmarks.bench_calibration import head_runs
from roadscan.calibrate.evidence import Orientation, Traverse
from roadscan.calibrate.stop_and_go import find_orientation
from roadscan.calibrate.surfaces.planes import Pieces, Readings
from roadscan.calibrate.unknowns import Prior, mounting_of
from roadscan.core.rig import IMU_GRADES, Mounting, Rig
from roadscan.poses.trajectory import Trajectory
from roadscan.simulate import Scene, simulate
from roadscan.simulate.caster import World, ray_key
from roadscan.simulate.drive import Drive, drives_of
from roadscan.simulate.lidar_model import lidar_model
from roadscan.simulate.noise import GaussMarkov, stream
from roadscan.simulate.path import Earth
from roadscan.simulate.scene import Mount
from roadscan.simulate.sensors import lidar, profiler
from roadscan.simulate.surface import Surface
from roadscan.simulate.things import objects_of

HDL32E = lidar_model("HDL-32E")

Float64 = npt.NDArray[np.float64]

CENTRE = (40.0, 0.0)
"""Station and offset of the calibration object."""
_BEHIND_M = 2.3
"""The heads follow the IMU reference point by this."""
_ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_OFF = {"on": False}
HEADINGS_DEG = (0.0, 180.0, 90.0, 270.0)
"""There and back, along and across."""
LIDAR_HEADINGS_DEG = (0.0, 0.0, 180.0, 90.0, 270.0)
"""A loop, back-through, right angles."""
_POSES_PER_S = 200
_OTHER_DRIVES = 10_000
"""Runs of one number draw the same errors from one seed."""
_EVERY = 6


@dataclass(frozen=True)
class Yard:
    """What a calibration gets, and the truth."""

    scene: Scene
    readings: list[Readings]
    pieces: Pieces
    traverses: dict[int, Traverse]
    priors: dict[str, Prior]
    true: dict[str, tuple[Float64, Float64]]
    """body_from_sensor (3, 3) and lever arm (3,) by sensor."""


def mounting_error(found: Mounting, true: tuple[Float64, Float64]) -> Float64:
    """(6,) found − true: lever arm (m), small rotation about body axes (rad)."""
    rotation, lever = found.arrays()
    return np.concatenate([lever - true[1], Rotation.from_matrix(rotation @ true[0].T).as_rotvec()])


def profiler_yard(
    seed: int,
    drives: int,
    position_m: float,
    attitude_deg: float,
    time_constant_s: float = 60.0,
    piece_s: float = 0.1,
    length_m: float = 5.5,
) -> Yard:
    """Drives of both heads over the object, one after another at 0°, 180°, 90°, 270°, …; starting 1° and 5 cm off.

    Profiles each 2.5 mm with a reading each 2.9 mm; four bowls of 0.25 m beside the wheel tracks give the ranges a
    depth, without which pitch and the forward lever arm are one.
    """
    scene = profiler_scene(seed, drives, length_m, position_m, attitude_deg, time_constant_s)
    readings = _readings(scene)
    pieces = Pieces.of_seconds(piece_s)
    tilt, place = math.radians(max(attitude_deg, 1e-4)), max(position_m, 1e-5)
    traverses = pieces.traverses(readings, _ENU_FROM_NED, (place,) * 3, (tilt, tilt, 2 * tilt), time_constant_s)
    mounts = {"profiler_left": scene.profilers.left, "profiler_right": scene.profilers.right}
    priors = {
        name: Prior(mounting_of(*_arrays(m.nominal())), (0.05,) * 3, (math.radians(1.0),) * 3, 0.0, (0.0, 0.0, 1.0))
        for name, m in mounts.items()
    }
    return Yard(scene, readings, pieces, traverses, priors, {name: _arrays(m) for name, m in mounts.items()})


def profiler_scene(
    seed: int, drives: int, length_m: float, position_m: float, attitude_deg: float, time_constant_s: float
) -> Scene:
    """The shipped yard with short routes, bowls, and mountings that are 1° and 5 cm off about and along each axis."""
    rng = np.random.default_rng(seed)
    passes = [_route(HEADINGS_DEG[k % 4], length_m, _BEHIND_M, rng) for k in range(drives)]
    bowls = [
        {"station_m": CENTRE[0] + a * 1.45, "offset_m": CENTRE[1] + b * 1.45, "radius_m": 0.55, "depth_m": 0.25}
        for a in (-1, 1)
        for b in (-1, 1)
    ]
    heads = {side: {"error": _error(rng)} for side in ("left", "right")}
    noise = {"position_m": position_m, "attitude_deg": attitude_deg, "time_constant_s": time_constant_s}
    return Scene.load("calibration_yard").changed(
        seed=seed, passes=passes, vehicle={"standstill_s": 0.0}, road={"potholes": bowls}, noise=noise,
        profilers={"spacing_m": 0.0025, "readings": 700, "head_imus": None, **heads},
        lidar=_OFF, sick=_OFF, camera=_OFF, imu=_OFF, gnss=_OFF,
    )  # fmt: skip


def _route(heading: float, length_m: float, ahead_m: float, rng: np.random.Generator) -> dict[str, object]:
    """Straight on, with its middle so far beyond the object."""
    c, s = math.cos(math.radians(heading)), math.sin(math.radians(heading))
    start, side = ahead_m - length_m / 2, rng.uniform(-0.2, 0.2)
    route = {
        "station_m": CENTRE[0] + start * c - side * s,
        "offset_m": CENTRE[1] + start * s + side * c,
        "heading_deg": heading,
        "pieces": [{"length_m": length_m}],
    }
    return {"route": route}


def _error(rng: np.random.Generator) -> dict[str, object]:
    lever, (roll, pitch, heading) = 0.05 * rng.choice([-1.0, 1.0], 3), rng.choice([-1.0, 1.0], 3).tolist()
    return {"lever_arm_body_m": lever.tolist(), "roll_deg": roll, "pitch_deg": pitch, "heading_deg": heading}


def _arrays(mount: Mount) -> tuple[Float64, Float64]:
    angles = [mount.heading_deg, mount.pitch_deg, mount.roll_deg]
    return Rotation.from_euler("ZYX", angles, degrees=True).as_matrix(), np.array(mount.lever_arm_body_m)


def head_orientations(yard: Yard, folder: Path, rounds: int = 3) -> list[Orientation]:
    """Stop and go with the IMUs in the heads: the same mountings and errors of trajectories, in the shipped runs.

    Loops, back-through and right angle, so many rounds of them, each run with a standstill before and after it. They
    are drives of their own, whose trajectories err independently of those over the object.
    """
    shipped = Scene.load("calibration_yard")
    passes = rounds * [one.model_dump() for one in shipped.passes]
    heads = {side: {"error": getattr(yard.scene.profilers, side).error.model_dump()} for side in ("left", "right")}
    noise = yard.scene.noise
    scene = shipped.changed(
        seed=_OTHER_DRIVES + yard.scene.seed, passes=passes, profilers={"spacing_m": 2.0, "readings": 2, **heads},
        road={"texture": None}, noise={k: getattr(noise, k) for k in ("position_m", "attitude_deg", "time_constant_s")},
        lidar=_OFF, sick=_OFF, camera=_OFF, imu=_OFF, gnss=_OFF, encoder=_OFF,
    )  # fmt: skip
    made = simulate(scene, folder).folder
    sensors = Rig.load(made / "RIG.toml").sensors
    found = []
    for name in yard.priors:
        runs = head_runs(made, f"{name}_imu", len(scene.passes), math.radians(noise.attitude_deg))
        nominal = sensors[f"{name}_imu"].mounting()
        one = find_orientation(runs, nominal, (0.05, 0.05, 0.05), IMU_GRADES["tactical"])
        found.append(one.evidence(name, sensors[name].mounting(), nominal))
    return found


def lidar_yard(
    seed: int,
    position_m: float,
    attitude_deg: float,
    time_constant_s: float = 60.0,
    piece_s: float = 1.0,
    length_m: float = 30.0,
    even_to_m: float = 30.0,
    headings_deg: Sequence[float] = LIDAR_HEADINGS_DEG,
) -> Yard:
    """Drives of the lidar past façade, poles and object; nearer returns thinned to the density at that range."""
    rng = np.random.default_rng(seed)
    noise = {"position_m": position_m, "attitude_deg": attitude_deg, "time_constant_s": time_constant_s}
    scene = Scene.load("calibration_yard").changed(
        seed=seed, passes=[_route(h, length_m, 0.0, rng) for h in headings_deg],
        vehicle={"standstill_s": 0.0, "speed_m_per_s": 10.0}, road={"texture": None}, noise=noise,
        lidar={"range_max_m": 45.0, "mount": {"error": _error(rng)}},
        profilers=_OFF, sick=_OFF, camera=_OFF, imu=_OFF, gnss=_OFF,
    )  # fmt: skip
    readings = _returns(scene, even_to_m, rng)
    pieces = Pieces.of_seconds(piece_s)
    tilt, place = math.radians(max(attitude_deg, 1e-4)), max(position_m, 1e-5)
    traverses = pieces.traverses(readings, _ENU_FROM_NED, (place,) * 3, (tilt, tilt, 2 * tilt), time_constant_s)
    nominal, true = (
        (rotation @ lidar.BODY_FROM_AXES, lever)
        for rotation, lever in (_arrays(scene.lidar.mount.nominal()), _arrays(scene.lidar.mount))
    )
    prior = Prior(mounting_of(*nominal), (0.05,) * 3, (math.radians(1.0),) * 3)
    return Yard(scene, readings, pieces, traverses, {"lidar": prior}, {"lidar": true})


def _returns(scene: Scene, even_to_m: float, rng: np.random.Generator) -> list[Readings]:
    earth = Earth(scene.map.crs)
    surface, ride = Surface(scene), Surface(scene, ride=True)
    world = World(scene, surface)
    origin, enu = _local_frame(scene, surface, earth)
    beams = HDL32E
    elevation = np.radians(beams.elevation_deg)
    found = []
    for drive in drives_of(scene, earth, ride):
        points, epochs = [], []
        for block in _some_packets(scene, world, drive):
            kept = np.square(HDL32E.figures.range_step_m / even_to_m * block.ranges)
            seen = (block.ranges > 0) & (rng.random(block.ranges.shape) < kept)
            laser, azimuth = np.nonzero(seen)[2], np.radians(block.azimuth_deg[seen])
            ranges = HDL32E.figures.range_step_m * block.ranges[seen]
            flat = ranges * np.cos(elevation[laser])
            up = ranges * np.sin(elevation[laser]) + beams.rise_m[laser]
            points.append(np.stack([flat * np.cos(azimuth), -flat * np.sin(azimuth), up], axis=-1))
            epochs.append(block.firing_gps_ns()[seen])
        at, pose = np.unique(np.concatenate(epochs), return_inverse=True)
        poses = stated_trajectory(scene, drive, origin, enu).poses(at)
        kept = poses.found[pose]
        number = np.cumsum(poses.found) - 1
        found.append(
            Readings(
                "lidar", f"run-{drive.number + 1}", np.concatenate(points)[kept], number[pose[kept]].astype(np.int32),
                at[poses.found], poses.position_world_m[poses.found], poses.world_from_body[poses.found],
            )
        )  # fmt: skip
    return found


def _some_packets(scene: Scene, world: World, drive: Drive) -> Iterator[lidar.Packets]:
    """One block of packets in `_EVERY`, 71 ms of each 0.42 s: casting all beams would take most of the time."""
    span_ns = drive.recorded_span_gps_ns[1] - lidar.starts_gps_ns(drive)
    blocks = int(span_ns // (lidar.BLOCK_PACKETS * HDL32E.block_ns))
    for block in range(0, blocks, _EVERY):
        numbers = block * lidar.BLOCK_PACKETS + np.arange(lidar.BLOCK_PACKETS)
        epochs = lidar.starts_gps_ns(drive) + numbers * HDL32E.block_ns
        key = ray_key(scene, drive, "lidar") + int(numbers[0]) * HDL32E.figures.cycles * HDL32E.lasers
        yield lidar._measure_block(scene, world, drive, epochs, lidar._aim(scene, 0.0, numbers), key, block)


def _local_frame(scene: Scene, surface: Surface, earth: Earth) -> tuple[Float64, Rotation]:
    """Origin (ECEF) at the calibration object, and east-north-up from ECEF there."""
    easting, northing, _ = surface.place(np.array([CENTRE[0]]), np.array([CENTRE[1]]))
    origin = earth.ecef_from_map(np.array([[easting[0], northing[0], scene.map.height_m]]))[0]
    return origin, Rotation.from_matrix(_ENU_FROM_NED) * earth.ecef_from_level(origin[None])[0].inv()


def _readings(scene: Scene) -> list[Readings]:
    earth = Earth(scene.map.crs)
    surface, ride = Surface(scene), Surface(scene, ride=True)
    things = objects_of(scene, surface)
    origin, enu = _local_frame(scene, surface, earth)
    found = []
    for drive in drives_of(scene, earth, ride):
        trajectory = stated_trajectory(scene, drive, origin, enu)
        for head in profiler.heads(scene.profilers):
            blocks = list(profiler.measure(scene, surface, drive, head, things))
            epochs = np.concatenate([b.epoch_gps_ns for b in blocks])
            ranges = np.concatenate([b.ranges for b in blocks])
            profile, reading = np.nonzero(ranges)
            first, step = head.first_step_m
            settings = scene.profilers
            points = np.zeros((profile.size, 3))
            points[:, 1] = first + step * reading
            points[:, 2] = settings.range_offset_m + settings.range_step_m * ranges[profile, reading]
            poses = trajectory.poses(epochs, strict=True)
            found.append(
                Readings(
                    head.name, f"run-{drive.number + 1}", points, profile.astype(np.int32), epochs,
                    poses.position_world_m, poses.world_from_body,
                )
            )  # fmt: skip
    return found


def stated_trajectory(scene: Scene, drive: Drive, origin_ecef_m: Float64, enu_from_ecef: Rotation) -> Trajectory:
    """Poses of a drive with the scene's Gauss–Markov errors, east-north-up about an origin."""
    first, last = drive.recorded_span_gps_ns
    step = 10**9 // _POSES_PER_S
    epochs = np.arange(first // step * step, last + step, step)
    here = drive.poses(epochs)
    noise = scene.noise
    tilt = math.radians(noise.attitude_deg)
    sigma = np.array([noise.position_m] * 3 + [tilt, tilt, 2 * tilt])
    process = GaussMarkov(
        stream(scene.seed, drive.number, "trajectory"), sigma, noise.time_constant_s, 1.0 / _POSES_PER_S
    )
    errors = process.take(epochs.size)
    level = drive.earth.ecef_from_level(here.position_ecef_m)
    angles = (level.inv() * here.ecef_from_body).as_euler("ZYX") + errors[:, :2:-1]
    position = here.position_ecef_m + level.apply(errors[:, :3])
    attitude = enu_from_ecef * level * Rotation.from_euler("ZYX", angles)
    quaternion = attitude.as_quat(scalar_first=True)
    return Trajectory.of("local", epochs, enu_from_ecef.apply(position - origin_ecef_m), quaternion)
