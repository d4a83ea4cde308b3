"""Simulates the camera: when it takes pictures, the folder of its pictures, and its true poses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from roadscan.compute.array_types import Float32, Float64, Int64
from roadscan.core.extras import cv2
from roadscan.simulate.drive import Drive
from roadscan.simulate.noise import stream
from roadscan.simulate.scene import Camera, Scene
from roadscan.simulate.scene.camera import PictureFaults
from roadscan.simulate.sensors.clock import SensorClock
from roadscan.simulate.sensors.picture import EYE, Studio, picture

STAMPS_FILE: Final = "stamps.csv"
_STAMPS: Final = pa.schema([("file", pa.string()), ("time_ns", pa.int64())])
_BACK: Final = 0.96  # share of a gain's logarithm that the next picture keeps
_MOST_LOG_GAIN: Final = 0.6
"""Largest logarithm of a gain, up or down."""
_POSE: Final = ("x_world_m", "y_world_m", "z_world_m", "qw", "qx", "qy", "qz")


def exposures_gps_ns(camera: Camera, drive: Drive) -> Int64:
    """Return epochs (n,) of a pass's pictures: one each `every_m` driven, from the first profile on."""
    return drive.epoch_gps_ns(np.arange(0.0, drive.length_m, camera.every_m))


def write_camera(
    studio: Studio, drive: Drive, clock: SensorClock, folder: Path, truth_file: Path
) -> Iterator[int]:  # fmt: skip
    """Write the pictures of one pass with their stamps, a picture a step; yields 1 for each.

    truth_file : Parquet, one row a picture: `epoch_gps_ns`, `file`, and the camera's pose in the world frame (as the
        table `poses` has it, but of the camera: x ahead along its optical axis, y right, z down); `gain` where the
        exposure changes, and `fault` where pictures went wrong.
    """
    folder.mkdir(parents=True, exist_ok=True)
    camera, scene = studio.camera, studio.world.scene
    epochs = exposures_gps_ns(camera, drive)
    names = [f"{number:06d}.jpg" for number in range(epochs.size)]
    quality = [int(cv2.IMWRITE_JPEG_QUALITY), camera.jpeg_quality]
    gains = gains_of(scene, studio.name, camera, drive, epochs.size)
    written = b""
    for number, (epoch, name) in enumerate(zip(epochs.tolist(), names, strict=True)):
        if number not in camera.faults.doubled:
            taken = _taken(studio, drive, epoch, number) * np.float32(gains[number])
            values = _exposed(scene, studio.name, camera, drive, taken, number)
            written = cv2.imencode(".jpg", values, quality)[1].tobytes()
        (folder / name).write_bytes(written)
        yield 1
    stamps = pa.table([names, clock.stamps_ns(epochs)], schema=_STAMPS)
    pa_csv.write_csv(stamps, folder / STAMPS_FILE, pa_csv.WriteOptions(quoting_style="none"))
    table = _true_poses(camera, drive, epochs, names)
    if camera.exposure is not None:
        table = table.append_column("gain", pa.array(gains))
    if camera.faults != PictureFaults():
        table = table.append_column("fault", pa.array([_fault(camera, number) for number in range(len(names))]))
    pq.write_table(table, truth_file)


def gains_of(scene: Scene, name: str, camera: Camera, drive: Drive, count: int) -> Float64:
    """Return the gains (n,) of a pass's pictures: a random walk with steps (logarithm) that returns to 0."""
    gains = np.ones(count)
    if camera.exposure is None:
        return gains
    settings, rng = camera.exposure, stream(scene.seed, drive.number, f"{name} exposure")
    moves = settings.walk * rng.standard_normal(count)
    is_step = rng.random(count) < settings.steps_per_100 / 100.0
    moves += np.where(is_step, settings.step * rng.choice([-1.0, 1.0], count), 0.0)
    level = 0.0
    for i, move in enumerate(moves.tolist()[1:], 1):
        level *= _BACK
        turned = move if abs(level + move) <= _MOST_LOG_GAIN else -move
        level = min(max(level + turned, -_MOST_LOG_GAIN), _MOST_LOG_GAIN)
        gains[i] = math.exp(level)
    return gains


def _taken(studio: Studio, drive: Drive, epoch_gps_ns: int, number: int) -> Float32:
    """Return values of an exposure before its gain and noise."""
    camera = studio.camera
    if number in camera.faults.black:
        return np.zeros((camera.height_px, camera.width_px, *((3,) if camera.colour else ())), np.float32)
    taken = picture(studio, drive, epoch_gps_ns, number)
    if camera.blur_px > 0.0:
        taken = cv2.GaussianBlur(taken, (0, 0), camera.blur_px, borderType=cv2.BORDER_REPLICATE)
    if camera.vignetting > 0.0:
        away = [np.linspace(-1.0, 1.0, n, dtype=np.float32) for n in (camera.height_px, camera.width_px)]
        squared = away[0][:, None] ** 2 + away[1][None] ** 2 * (camera.width_px / camera.height_px) ** 2
        share = 1.0 - np.float32(camera.vignetting) * squared / squared.max()
        taken = taken * share.reshape(*share.shape, *(1,) * (taken.ndim - 2))
    return taken


def _exposed(
    scene: Scene, name: str, camera: Camera, drive: Drive, taken: Float32, number: int
) -> npt.NDArray[np.uint8]:  # fmt: skip
    """Return pixel values (height, width), or (height, width, 3) with blue first, as the camera's chip gives them."""
    if camera.noise > 0.0:
        rng = stream(scene.seed, drive.number, name, number)
        taken = taken + np.float32(camera.noise) * rng.standard_normal(taken.shape, dtype=np.float32)
    values = np.clip(np.rint(taken), 0, 255).astype(np.uint8)
    return values if values.ndim == 2 else np.ascontiguousarray(values[:, :, ::-1])


def _fault(camera: Camera, number: int) -> str:
    """Return what is wrong with a picture; nothing: empty."""
    return "black" if number in camera.faults.black else "doubled" if number in camera.faults.doubled else ""


def _true_poses(camera: Camera, drive: Drive, epochs: Int64, names: list[str]) -> pa.Table:
    position, rotation = drive.poses(epochs).sensor(camera.mount, EYE)
    x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True).T
    columns = {"epoch_gps_ns": epochs, "file": names} | dict(zip(_POSE, [*position.T, w, x, y, z], strict=True))
    return pa.table({name: pa.array(values) for name, values in columns.items()})
