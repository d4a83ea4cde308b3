"""A drive with pictures alone (KITTI), as a survey that a user would write, whose poses are disturbed on purpose.

The recording is ``pictures/drive_left``: 51 grey pictures, their poses and the lens. The poses that the survey states
are those of the recording with errors that vary slowly; `roadscan run` has to take them out again.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from roadscan.core.survey import Survey
from roadscan.georeference.plan.plan import plan_without_readings
from roadscan.pictures.placed import plan_pictures
from roadscan.pictures.views import PictureRule
from roadscan.store.store import Store

Float64 = npt.NDArray[np.float64]

RECORDING: Final = "pictures/drive_left"
EVERY: Final = range(51)
"""Pictures of the recording."""
SOUND: Final = 12
"""From this picture on the recorded poses agree with the pictures to hundredths of a degree over five of them; before
it they are off by up to 0.57°, by whatever errors the poses of a survey are disturbed."""
STEP_S: Final = 0.1
"""Time from picture to picture (s)."""
FIRST_UNIX_S: Final = 1_600_000_000.0
"""Unix time of the first picture (s); the recording states none."""

_SURVEY: Final = """
id = "drive_left"
rig = "rig.toml"
store = "store"
[map.local]
name = "axes of the vehicle at the first picture"
[tiles]
cell_m = 0.2
[picture_ties]
[adjust.priors]
source = "stated"
sigma_horizontal_m = {sigma_m}
sigma_down_m = {sigma_m}
sigma_roll_pitch_deg = {sigma_deg}
sigma_heading_deg = {sigma_deg}
[[runs]]
id = "drive"
[[runs.logs]]
path = "poses.txt"
format = "pose_matrices"
crs = "local"
clock = {{ system = "unix_utc" }}
options = {{ axes = "flu", frame = "flu", times = "times.txt" }}
[[runs.logs]]
path = "pictures"
format = "images"
sensor = "left"
clock = {{ system = "unix_utc" }}
options = {{ stamps = "stamps.csv" }}
"""
_RIG: Final = """
name = "KITTI car"
[sensors.left]
kind = "camera"
axes = "frd"
lever_arm_body_m = [0.0, 0.0, 0.0]
boresight = { roll_deg = 0.0, pitch_deg = 0.0, heading_deg = 0.0 }
[sensors.left.interior]
width_px = 1226
height_px = 370
focal_px = [707.0912, 707.0912]
principal_px = [601.8873, 183.1104]
"""
VEHICLE_FROM_CAMERA: Final = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Axes forward, left, up from the camera's right, down, ahead."""


def true_poses(recording: Path) -> Float64:
    """Returns the recorded poses (n, 3, 4) in axes forward, left, up of the first picture."""
    poses = np.loadtxt(recording / "poses.txt").reshape(-1, 3, 4)
    turned = VEHICLE_FROM_CAMERA @ poses[:, :, :3] @ VEHICLE_FROM_CAMERA.T
    return np.concatenate([turned, (poses[:, :, 3] @ VEHICLE_FROM_CAMERA.T)[:, :, None]], axis=2)


def disturbed(poses: Float64, sigma_m: float, sigma_deg: float, seed: int) -> Float64:
    """Returns poses with errors of these 1 σ on each axis, that vary over 2.5 to 7 s: three waves of random phase."""
    rng = np.random.default_rng(seed)
    time_s = STEP_S * np.arange(len(poses))
    waves = np.zeros((len(poses), 6))
    for period_s in (2.5, 4.0, 7.0):
        phase, size = rng.uniform(0.0, 2.0 * np.pi, 6), rng.normal(size=6)
        waves += size * np.sin(2.0 * np.pi * time_s[:, None] / period_s + phase)
    waves *= np.sqrt(2.0 / 3.0)
    turn = Rotation.from_rotvec(np.radians(sigma_deg) * waves[:, 3:]).as_matrix()
    return np.concatenate([poses[:, :, :3] @ turn, poses[:, :, 3:] + sigma_m * waves[:, :3, None]], axis=2)


def laid_out(
    recording: Path, folder: Path, errors: tuple[float, float], seed: int, chosen: Sequence[int] = EVERY
) -> Path:
    """Write the survey of some pictures of the drive below a folder; returns its survey file.

    errors : 1 σ of the disturbed poses (m, degrees).
    """
    folder.mkdir(parents=True, exist_ok=True)
    sigma_m, sigma_deg = errors
    poses = disturbed(true_poses(recording), sigma_m, sigma_deg, seed)
    np.savetxt(folder / "poses.txt", poses.reshape(-1, 12), fmt="%.9f")
    stamps = FIRST_UNIX_S + STEP_S * np.arange(len(poses))
    np.savetxt(folder / "times.txt", stamps, fmt="%.6f")
    names = [f"{number:06d}.png" for number in chosen]
    (folder / "pictures").mkdir(exist_ok=True)
    for name in names:
        shutil.copyfile(recording / "image_l" / name, folder / "pictures" / name)
    lines = ["file,time", *(f"{name},{stamp:.6f}" for name, stamp in zip(names, stamps[list(chosen)], strict=True))]
    (folder / "pictures" / "stamps.csv").write_text("\n".join(lines) + "\n")
    (folder / "rig.toml").write_text(_RIG)
    (folder / "SURVEY.toml").write_text(_SURVEY.format(sigma_m=sigma_m, sigma_deg=sigma_deg))
    return folder / "SURVEY.toml"


def run(survey_file: Path) -> None:
    """Call ``roadscan run`` on a survey file as a user does."""
    subprocess.run([sys.executable, "-m", "roadscan", "run", str(survey_file)], check=True)


def placed(survey_file: Path) -> Float64:
    """Returns poses (n, 3, 4) of the pictures, as products place them: OpenCV's axes in the local frame."""
    survey = Survey.load(survey_file)
    store = Store(survey.store_url, survey.config.id)
    plan = plan_without_readings(survey, store)
    views = plan_pictures(plan, PictureRule((), 50.0, -90.0, 1)).views
    return np.concatenate([views.opencv_from_world.transpose(0, 2, 1), views.eye_world_m[:, :, None]], axis=2)


def over_frames(found: Float64, truth: Float64, frames: int = 5) -> tuple[Float64, Float64]:
    """Returns errors of the way (m) and of the turn (degrees) over some frames, from poses (n, 3, 4) of both."""
    ways, turns = [], []
    for first in range(len(found) - frames):
        moved, meant = (_between(poses[first], poses[first + frames]) for poses in (found, truth))
        ways.append(float(np.linalg.norm(moved[:, 3] - meant[:, 3])))
        turns.append(float(np.degrees(Rotation.from_matrix(moved[:, :3] @ meant[:, :3].T).magnitude())))
    return np.array(ways), np.array(turns)


def _between(first: Float64, second: Float64) -> Float64:
    """Returns a pose (3, 4) in the axes of another."""
    return np.column_stack([first[:, :3].T @ second[:, :3], first[:, :3].T @ (second[:, 3] - first[:, 3])])


def of_camera(poses: Float64) -> Float64:
    """Returns poses (n, 3, 4) of the vehicle as those of the camera, OpenCV's axes."""
    return np.concatenate([poses[:, :, :3] @ VEHICLE_FROM_CAMERA, poses[:, :, 3:]], axis=2)


def truth(recording: Path) -> Float64:
    """Returns the recorded poses (n, 3, 4) of the camera, OpenCV's axes, in axes forward, left, up."""
    return of_camera(true_poses(recording))
