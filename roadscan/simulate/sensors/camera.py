"""Simulates the camera: when it takes pictures, the folder of its pictures, and its true poses."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from roadscan.core.extras import cv2
from roadscan.simulate.caster import World
from roadscan.simulate.drive import Drive
from roadscan.simulate.noise import stream
from roadscan.simulate.scene import Scene
from roadscan.simulate.sensors.clock import SensorClock
from roadscan.simulate.sensors.colours import Tints
from roadscan.simulate.sensors.picture import EYE, picture

Int64 = npt.NDArray[np.int64]

STAMPS_FILE: Final = "stamps.csv"
_STAMPS: Final = pa.schema([("file", pa.string()), ("time_ns", pa.int64())])
_POSE: Final = ("x_world_m", "y_world_m", "z_world_m", "qw", "qx", "qy", "qz")


def exposures_gps_ns(scene: Scene, drive: Drive) -> Int64:
    """Return epochs (n,) of a pass's pictures: one each `camera.every_m` driven, from the first profile on."""
    return drive.epoch_gps_ns(np.arange(0.0, drive.length_m, scene.camera.every_m))


def write_camera(
    scene: Scene, world: World, drive: Drive, clock: SensorClock, folder: Path, truth_file: Path
) -> Iterator[int]:
    """Write the pictures of one pass with their stamps, a picture a step; yields 1 for each.

    truth_file : Parquet, one row a picture: `epoch_gps_ns`, `file`, and the camera's pose in the world frame (as the
        table `poses` has it, but of the camera: x ahead along its optical axis, y right, z down).
    """
    folder.mkdir(parents=True, exist_ok=True)
    epochs = exposures_gps_ns(scene, drive)
    names = [f"{number:06d}.jpg" for number in range(epochs.size)]
    quality = [int(cv2.IMWRITE_JPEG_QUALITY), scene.camera.jpeg_quality]
    tints = Tints(world) if scene.camera.colour else None
    for number, (epoch, name) in enumerate(zip(epochs.tolist(), names, strict=True)):
        taken = picture(world, drive, epoch, number, tints)
        _, encoded = cv2.imencode(".jpg", _exposed(scene, drive, taken, number), quality)
        (folder / name).write_bytes(encoded.tobytes())
        yield 1
    stamps = pa.table([names, clock.stamps_ns(epochs)], schema=_STAMPS)
    pa_csv.write_csv(stamps, folder / STAMPS_FILE, pa_csv.WriteOptions(quoting_style="none"))
    pq.write_table(_true_poses(scene, drive, epochs, names), truth_file)


def _exposed(scene: Scene, drive: Drive, taken: npt.NDArray[np.float32], number: int) -> npt.NDArray[np.uint8]:
    """Return pixel values (height, width), or (height, width, 3) with blue first, as the camera's chip gives them."""
    if scene.camera.noise > 0.0:
        rng = stream(scene.seed, drive.number, "camera", number)
        taken = taken + np.float32(scene.camera.noise) * rng.standard_normal(taken.shape, dtype=np.float32)
    values = np.clip(np.rint(taken), 0, 255).astype(np.uint8)
    return values if values.ndim == 2 else np.ascontiguousarray(values[:, :, ::-1])


def _true_poses(scene: Scene, drive: Drive, epochs: Int64, names: list[str]) -> pa.Table:
    position, rotation = drive.poses(epochs).sensor(scene.camera.mount, EYE)
    x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True).T
    columns = {"epoch_gps_ns": epochs, "file": names} | dict(zip(_POSE, [*position.T, w, x, y, z], strict=True))
    return pa.table({name: pa.array(values) for name, values in columns.items()})
