"""The recorded street `colour_and_lidar`, with pictures and sweeps, as a survey that a user would write.

It has no poses: its sweeps are registered here (GICP; Segal, Hähnel and Thrun 2009), each to those before it, with
the vehicle's motion during a turn taken out.
"""

from __future__ import annotations

import csv
import shutil
import tarfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import small_gicp
from scipy.spatial.transform import Rotation, Slerp

from benchmarks.labelled_street import survey_text

Float64 = npt.NDArray[np.float64]

PERIOD_S: Final = 0.1
"""Time of a turn of the lidar (s): frame n of a recording was taken n of these after the first."""
FIRST_UNIX_S: Final = 1317000000
"""Stamp of frame 0 (s): the recordings do not state it."""
COLOUR_SIZE_PX: Final = (1242, 375)
COLOUR_FOCAL_PX: Final = 721.5377
COLOUR_PRINCIPAL_PX: Final = (609.5593, 172.854)
RAISED_DEG: Final = 0.205
"""By how much the beams of these recordings look higher than they say (degrees): Deschaud (2018) and Dellenbach et al.
(2022) found it on other drives of this car. It puts the ground 3 cm too low at 8 m."""
_RECT_OFFSET: Final = np.array([44.85728, 0.2163791, 0.002745884])  # Last column of P_rect_02 (pixels · m, m).
_VELO_TO_CAM: Final = np.array([
    [7.533745e-03, -9.999714e-01, -6.166020e-04, -4.069766e-03],
    [1.480249e-02, 7.280733e-04, -9.998902e-01, -7.631618e-02],
    [9.998621e-01, 7.523790e-03, 1.480755e-02, -2.717806e-01],
])  # fmt: skip
_RECTIFIED: Final = np.array([
    [9.999239e-01, 9.837760e-03, -7.445048e-03],
    [-9.869795e-03, 9.999421e-01, -4.278459e-03],
    [7.402527e-03, 4.351614e-03, 9.999631e-01],
])  # fmt: skip
_BODY_FROM_VELODYNE: Final = np.diag([1.0, -1.0, -1.0])
_SENSOR_FROM_CAMERA: Final = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
_REGISTERED_WITHIN_M: Final = 50.0  # Farther returns do not help (m).
_ROUNDS: Final = 3  # Rounds in which the motion during a turn is taken out.
_KEPT: Final = 4  # Sweeps to which the next one is registered.


def camera_from_velodyne() -> tuple[Float64, Float64]:
    """Rotation (3, 3) and translation (3,) from the lidar to the rectified colour camera."""
    turn, arm = _RECTIFIED @ _VELO_TO_CAM[:, :3], _RECTIFIED @ _VELO_TO_CAM[:, 3]
    u, v, ahead = _RECT_OFFSET
    shift = np.array([
        (u - COLOUR_PRINCIPAL_PX[0] * ahead) / COLOUR_FOCAL_PX, (v - COLOUR_PRINCIPAL_PX[1] * ahead) / COLOUR_FOCAL_PX,
        ahead,
    ])  # fmt: skip
    return turn, arm + shift


def colour_and_lidar(
    recording: Path, folder: Path, sections: str, frames: Sequence[int] | None = None, *, raised: bool = False
) -> Path:
    """Write the survey of the recording below a folder; returns its survey file.

    sections : text that the survey file gets at its end.
    frames : frames whose pictures the survey has; all where left out.
    raised : with the elevations of the beams mended (`RAISED_DEG`).
    """
    sweeps = folder / "sweeps" / "velodyne_points" / "data"
    sweeps.mkdir(parents=True)
    with tarfile.open(recording / "velodyne_points.tar.xz") as archive:
        archive.extractall(folder / "sweeps", filter="data")
    numbers = sorted(int(p.stem) for p in sweeps.glob("*.bin"))
    for file in sweeps.glob("*.bin") if raised else ():
        raised_beams(np.fromfile(file, "<f4").reshape(-1, 4)).tofile(file)
    (folder / "pictures").mkdir()
    wanted = [n for n in numbers if frames is None or n in frames]
    for number in wanted:
        shutil.copyfile(recording / "image_02/data" / f"{number:010d}.png", folder / "pictures" / f"{number:010d}.png")
    poses = registered([np.fromfile(sweeps / f"{n:010d}.bin", "<f4").reshape(-1, 4) for n in numbers], numbers)
    stamp = {n: f"{FIRST_UNIX_S + n * PERIOD_S:.3f}" for n in numbers}
    _write(folder / "stamps.csv", [("frame", "unix_utc_s"), *((n, stamp[n]) for n in numbers)])
    _write(folder / "pictures.csv", [("file", "time"), *((f"{n:010d}.png", stamp[n]) for n in wanted)])
    _write_poses(folder / "poses.csv", poses, numbers)
    (folder / "rig.toml").write_text(rig(*camera_from_velodyne(), COLOUR_SIZE_PX, COLOUR_FOCAL_PX, COLOUR_PRINCIPAL_PX))
    turn = f'turn = "azimuth", period_s = {PERIOD_S}'
    (folder / "SURVEY.toml").write_text(survey_text("colour_and_lidar", 0.1, turn, "pictures") + sections)
    return folder / "SURVEY.toml"


def raised_beams(raw: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Returns (n, 4) with each beam turned upwards by `RAISED_DEG` about the level axis across it."""
    out, level = raw.copy(), np.hypot(raw[:, 0], raw[:, 1])
    cosine, sine = np.cos(np.radians(RAISED_DEG)), np.sin(np.radians(RAISED_DEG))
    out[:, :2] *= (cosine - sine * raw[:, 2] / np.maximum(level, 1e-6))[:, None]
    out[:, 2] = cosine * raw[:, 2] + sine * level
    return out


def registered(sweeps: Sequence[npt.NDArray[np.float32]], frames: Sequence[int]) -> Float64:
    """Poses (n, 4, 4) of sweeps in the frame of the first, at the instants at which the head faces ahead."""
    poses, clouds = [np.eye(4)], list[Float64]()
    step = np.eye(4)
    for number, raw in enumerate(sweeps):
        near = _near(raw)
        pose, own_step = (np.eye(4), step) if number == 0 else (poses[-1] @ step, step)
        turns = 1.0 if number == 0 else float(frames[number] - frames[number - 1])
        straight = _straightened(near, own_step, turns)
        for _ in range(_ROUNDS if number else 0):
            result = small_gicp.align(
                np.concatenate(clouds), straight, pose, downsampling_resolution=0.25, max_correspondence_distance=1.0
            )
            pose = result.T_target_source
            own_step = np.linalg.inv(poses[-1]) @ pose
            straight = _straightened(near, own_step, turns)
        if number == 1:  # the first sweep was taken as if the vehicle had stood
            clouds = [_moved(_straightened(_near(sweeps[0]), own_step, turns), np.eye(4))]
        if number:
            poses.append(pose)
            step = own_step
        clouds = [*clouds[-_KEPT + 1 :], _moved(straight, pose)]
    return np.array(poses)


def _near(raw: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    return raw[(np.linalg.norm(raw[:, :3], axis=1) < _REGISTERED_WITHIN_M)]


def _moved(points: Float64, pose: Float64) -> Float64:
    return points @ pose[:3, :3].T + pose[:3, 3]


def _straightened(raw: npt.NDArray[np.float32], step: Float64, turns: float) -> Float64:
    """Returns of a sweep (n, 3) as if all were seen when the head faced ahead; `step` is the motion in some turns."""
    points = raw[:, :3].astype(np.float64)
    share = -np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi) / turns
    turned = Rotation.from_rotvec(share[:, None] * Rotation.from_matrix(step[:3, :3]).as_rotvec())
    return np.asarray(turned.apply(points) + share[:, None] * step[:3, 3])


def _write_poses(path: Path, poses: Float64, frames: Sequence[int]) -> None:
    """Write poses at each turn, between those of the sweeps and a turn beyond."""
    at = np.array(frames, np.float64)
    turns = np.arange(at[0] - 1, at[-1] + 2)
    inner = np.clip(turns, at[0], at[-1])
    rotation = Slerp(at, Rotation.from_matrix(poses[:, :3, :3]))(inner).as_matrix()
    place = np.stack([np.interp(inner, at, poses[:, k, 3]) for k in range(3)], axis=-1)
    place[0] -= (poses[1, :3, 3] - poses[0, :3, 3]) / (at[1] - at[0])
    place[-1] += (poses[-1, :3, 3] - poses[-2, :3, 3]) / (at[-1] - at[-2])
    header = ["frame", "unix_utc_s"]
    for k in (1, 2, 3):
        header += [f"r{k}1", f"r{k}2", f"r{k}3", f"t{k}"]
    rows: list[tuple[object, ...]] = [tuple(header)]
    for turn, r, t in zip(turns, rotation, place, strict=True):
        values = np.column_stack([r, t]).ravel()
        rows.append((int(turn - turns[0]), f"{FIRST_UNIX_S + turn * PERIOD_S:.3f}", *(f"{v:.9f}" for v in values)))
    _write(path, rows)


def rig(
    turn: Float64, arm_m: Float64, size_px: tuple[int, int], focal_px: float, principal_px: tuple[float, float]
) -> str:
    """Rig file of a car with a lidar and a camera; `turn` and `arm_m` from the lidar to the camera."""
    own = _BODY_FROM_VELODYNE @ turn.T @ _SENSOR_FROM_CAMERA.T
    lever = _BODY_FROM_VELODYNE @ (-turn.T @ arm_m)
    return f"""
name = "KITTI car (2011)"
[sensors.velodyne]
kind = "lidar"
axes = "flu"
range_min_m = 2.5
[sensors.camera]
kind = "camera"
lever_arm_body_m = {lever.tolist()}
body_from_sensor = {own.tolist()}
[sensors.camera.interior]
width_px = {size_px[0]}
height_px = {size_px[1]}
focal_px = [{focal_px}, {focal_px}]
principal_px = [{principal_px[0]}, {principal_px[1]}]
"""


def _write(path: Path, rows: Sequence[Sequence[object]]) -> None:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows)
