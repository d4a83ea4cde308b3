"""The recorded drive through a town, with the road users that others framed in it."""

from __future__ import annotations

import tarfile
from typing import Final

import numpy as np
import numpy.typing as npt
import small_gicp

from roadscan.assets.scene import Returns
from tests.assets.scenes import joined, recordings_folder, velodyne_returns

IMU_TO_VELODYNE: Final = np.array(
    [
        [9.999976e-01, 7.553071e-04, -2.035826e-03, -0.8086759],
        [-7.854027e-04, 9.998898e-01, -1.482298e-02, 0.3195559],
        [2.024406e-03, 1.482454e-02, 9.998881e-01, -0.7997231],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
CARS: Final = ("Car", "Van", "Truck", "Tram", "Misc")
OTHER, CAR, PERSON = 0, 1, 2
_SCANS: Final = 52


def kitti_drive_returns(
    scans: slice = slice(None),
) -> tuple[Returns, npt.NDArray[np.uint8], npt.NDArray[np.int32], npt.NDArray[np.float64]]:
    """Returns of some of the scans in the local frame, what frames hold them (0 none, 1 car, 2 person or cyclist), the
    object's number (-1 none), and the drive (p, 4).

    The recording's own poses differ in height by decimetres over seconds, so scans are registered to those before.
    """
    folder = recordings_folder() / "kitti_drive"
    poses = np.loadtxt(folder / "poses.csv", delimiter=",", skiprows=1)
    boxes = np.genfromtxt(folder / "boxes.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    to_imu = np.linalg.inv(IMU_TO_VELODYNE)
    parts, kinds, objects, drive = [], [], [], []
    registration = Registration()
    with tarfile.open(folder / "velodyne_points.tar.xz") as archive:
        wanted = range(_SCANS)[scans]
        for number_of_scan, member in enumerate(m for m in archive if m.name.endswith(".bin")):
            if number_of_scan > max(wanted):
                break
            if number_of_scan not in wanted:
                continue
            frame = int(member.name[-14:-4])
            stream = archive.extractfile(member)
            assert stream is not None
            content = stream.read()
            row = poses[poses[:, 0] == frame][0].copy()
            raw = np.frombuffer(content, "<f4").reshape(-1, 4)
            recorded = np.vstack([row[2:14].reshape(3, 4), [0, 0, 0, 1]]) @ to_imu
            whole = registration.add(recorded, raw[:, :3].astype(np.float64))
            row[2:14] = whole[:3].ravel()
            parts.append(velodyne_returns(content, row))
            drive.append([*whole[:3, 3], 1.0])
            kind, number = framed(raw, boxes[boxes["frame"] == frame])
            kinds.append(kind)
            objects.append(number)
    return joined(parts), np.concatenate(kinds), np.concatenate(objects), np.array(drive)


class Registration:
    """Poses of successive scans, each registered to the five before it (GICP)."""

    def __init__(self) -> None:
        self._clouds: list[npt.NDArray[np.float64]] = []
        self._correction = np.eye(4)

    def add(self, recorded: npt.NDArray[np.float64], points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Pose (4, 4) of the next scan, whose recorded pose and points (n, 3) are given."""
        near = points[np.linalg.norm(points, axis=1) < 40.0]
        pose = self._correction @ recorded
        if self._clouds:
            target = np.concatenate(self._clouds)
            pose = small_gicp.align(
                target, near, pose, downsampling_resolution=0.3, max_correspondence_distance=0.7
            ).T_target_source
            self._correction = pose @ np.linalg.inv(recorded)
        self._clouds = [*self._clouds[-4:], near @ pose[:3, :3].T + pose[:3, 3]]
        return np.asarray(pose)


def framed(
    raw: npt.NDArray[np.float32], boxes: npt.NDArray[np.void], margin_m: float = 0.0
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.int32]]:
    """What frames of a scan hold its returns, and the numbers of the objects.

    The file's columns of width and height are those of height and width: so read, all frames stand on the ground 1.6 m
    below the scanner, and people are 1.7 m tall and 0.8 m wide.
    """
    kind, number = np.zeros(len(raw), np.uint8), np.full(len(raw), -1, np.int32)
    for box in boxes:
        x, y, z = raw[:, 0] - box["x_velo_m"], raw[:, 1] - box["y_velo_m"], raw[:, 2] - box["z_velo_m"]
        cos, sin = np.cos(box["yaw_velo_rad"]), np.sin(box["yaw_velo_rad"])
        along, across = cos * x + sin * y, cos * y - sin * x
        inside = (np.abs(along) <= box["length_m"] / 2 + margin_m) & (np.abs(across) <= box["height_m"] / 2 + margin_m)
        inside &= np.abs(z) <= box["width_m"] / 2
        kind[inside] = CAR if box["type"] in CARS else PERSON
        number[inside] = box["object"]
    return kind, number
