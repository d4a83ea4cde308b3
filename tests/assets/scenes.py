"""Scenes of recorded streets for tests of assets, with what others labelled in them."""

from __future__ import annotations

import functools
import os
import tarfile
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box, Returns, Scene
from roadscan.core.gpstime import GPS_EPOCH_UNIX_S, leap_seconds_at_unix

REPOSITORY = Path(__file__).resolve().parents[2]
GROUND_LABELS = (40, 44, 48, 60, 72)
NOT_JUDGED = (0, 1, 20, 99, 254, 255)
SWEEP_S = 0.1


def recordings_folder() -> Path:
    """Folder of the real recordings; the test is skipped where it is absent."""
    folder = Path(os.environ.get("ROADSCAN_DATA", REPOSITORY.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no recordings at {folder}: set ROADSCAN_DATA to their folder")
    return folder


@functools.cache
def semantic_kitti_scene(half_m: float = 80.0) -> tuple[Scene, npt.NDArray[np.uint8]]:
    """The street of eight labelled sweeps in the frame of sweep 0, and the label (n,) of each of the scene's returns.

    The scene is a square about the first pose; the drive is all poses of the recording.
    """
    returns, labels, drive = semantic_kitti_returns()
    window = Box(-half_m, -half_m, half_m, half_m)
    inside = window.holds(returns.x_m, returns.y_m)
    return make_scene(returns.at(inside), window, window, drive), labels[inside]


@functools.cache
def semantic_kitti_returns() -> tuple[Returns, npt.NDArray[np.uint8], npt.NDArray[np.float64]]:
    """Returns of the eight sweeps (x forward, y left, height up; frame of sweep 0), labels (n,), drive (p, 4)."""
    folder = recordings_folder() / "semantic_kitti_00"
    poses = np.loadtxt(folder / "poses.csv", delimiter=",", skiprows=1)
    parts, labels = [], []
    with tarfile.open(folder / "sweeps.tar.xz") as archive:
        held = {m.name: extract.read() for m in archive if (extract := archive.extractfile(m)) is not None}
    for pose in poses:
        name = f"{int(pose[0]):010d}"
        if f"labels/{name}.label" not in held:
            continue
        parts.append(velodyne_returns(held[f"velodyne_points/data/{name}.bin"], pose))
        labels.append(np.frombuffer(held[f"labels/{name}.label"], np.uint8))
    drive = np.column_stack([poses[:, [5, 9, 13]], np.ones(len(poses))])
    return joined(parts), np.concatenate(labels), drive


def velodyne_returns(content: bytes, pose: npt.NDArray[np.float64]) -> Returns:
    """Returns of a sweep of an HDL-64E in KITTI's binary form.

    pose : frame, Unix UTC seconds, then the rows of the 3 × 4 matrix from the sensor to the map.
    """
    raw = np.frombuffer(content, "<f4").reshape(-1, 4).astype(np.float64)
    matrix = pose[2:14].reshape(3, 4)
    x, y, height = matrix[:, :3] @ raw[:, :3].T + matrix[:, 3:]
    n = len(raw)
    turn = np.arctan2(raw[:, 1], raw[:, 0]) / (2 * np.pi) % 1.0
    unix_s = pose[1]
    start_ns = round((unix_s - GPS_EPOCH_UNIX_S + int(leap_seconds_at_unix(unix_s))) * 1e9)
    return Returns(
        corner_m=(0.0, 0.0),
        x_m=x,
        y_m=y,
        height_m=height,
        intensity=(raw[:, 3] * 65535.0).astype(np.float32),
        epoch_gps_ns=start_ns + (turn * SWEEP_S * 1e9).astype(np.int64),
        pass_id=np.ones(n, np.uint16),
        sensor=np.zeros(n, np.uint8),
        laser=hdl64_laser(raw[:, :3]),
        return_number=np.ones(n, np.uint8),
        number_of_returns=np.ones(n, np.uint8),
        sensor_x_m=np.full(n, matrix[0, 3]),
        sensor_y_m=np.full(n, matrix[1, 3]),
        sensor_height_m=np.full(n, matrix[2, 3]),
        sensors=("hdl64e",),
    )


def hdl64_laser(xyz: npt.NDArray[np.float64]) -> npt.NDArray[np.uint16]:
    """Number (n,) of the laser: the file lists laser after laser, each over a turn that begins straight ahead."""
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    begins = (azimuth[:-1] < 0) & (azimuth[:-1] > -0.6) & (azimuth[1:] >= 0) & (azimuth[1:] < 0.6)
    return np.concatenate([[0], np.cumsum(begins)]).astype(np.uint16)


def joined(parts: list[Returns]) -> Returns:
    """Returns of all parts, one after another; all count from the corner of the first."""
    arrays = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name, value in vars(parts[0]).items()
        if isinstance(value, np.ndarray)
    }
    return Returns(corner_m=parts[0].corner_m, sensors=parts[0].sensors, calibrated=parts[0].calibrated, **arrays)
