"""Three photographs of a telephone and surveyed points in them (berlin): oriented by `roadscan run`, residuals told."""

from __future__ import annotations

import datetime as dt
import json
import math
import shutil
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from benchmarks import picture_drive
from tests.real_data.conftest import Place

NAMES = ("01", "02", "03")
FOCAL_PX = 35.0 / 36.0 * 3264
"""By the 35 mm of the pictures' EXIF."""
COMPASS_DEG = -31.0
"""By which the compass is off: the surveyed point 0 stands in the middle of picture 02, and on the map 31° more to the
left than the compass says."""
HEIGHT_M = 2.0
"""Height of the telephone in the system of the surveyed points, which stand 13 and 15 m high on a building."""
POSES = "time,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg"
SIGMA = "sigma_north_m,sigma_east_m,sigma_down_m,sigma_roll_deg,sigma_pitch_deg,sigma_heading_deg"
RIG = f"""
name = "telephone"
[sensors.phone]
kind = "camera"
axes = "frd"
lever_arm_body_m = [0.0, 0.0, 0.0]
boresight = {{ roll_deg = 0.0, pitch_deg = 0.0, heading_deg = 0.0 }}
lever_arm_sigma_m = [0.001, 0.001, 0.001]
boresight_sigma_deg = [0.01, 0.01, 0.01]
[sensors.phone.interior]
width_px = 3264
height_px = 2448
focal_px = [{FOCAL_PX}, {FOCAL_PX}]
principal_px = [1631.5, 1223.5]
sigma_focal_px = [60.0, 60.0]
sigma_distortion = [0.05, 0.0, 0.0, 0.0, 0.0]
"""
SURVEY = """
id = "berlin"
rig = "rig.toml"
store = "store"
[map]
crs = "EPSG:32633"
height = "ellipsoidal"
[navigation]
max_gap_s = 60.0
[picture_ties]
[adjust.priors]
source = "sigma"
[[runs]]
id = "walk"
[[runs.logs]]
path = "poses.csv"
format = "trajectory_csv"
crs = "EPSG:4979"
clock = { system = "unix_utc" }
[[runs.logs]]
path = "images"
format = "images"
sensor = "phone"
clock = { system = "unix_utc" }
options = { stamps = "stamps.csv" }
[[runs.logs]]
path = "points.json"
format = "opensfm_picture_points"
sensor = "phone"
options = { pictures = "images" }
[[control]]
path = "points.json"
height = "ellipsoidal"
crs = "EPSG:4979"
options = { role = "gcp" }
"""


def _survey(recording: Path, folder: Path) -> Path:
    """The survey: positions to 5 m, tilt and compass as the telephone wrote them into the pictures."""
    (folder / "images").mkdir()
    shutil.copyfile(recording / "ground_control_points.json", folder / "points.json")
    poses, stamps = [f"{POSES},{SIGMA}"], ["file,time"]
    for name in NAMES:
        shutil.copyfile(recording / f"images/{name}.jpg", folder / f"images/{name}.jpg")
        with Image.open(folder / f"images/{name}.jpg") as image:
            told = json.loads(image.getexif()[270])
        taken = dt.datetime.strptime(told["MAPCaptureTime"] + "000+0200", "%Y_%m_%d_%H_%M_%S_%f%z").timestamp()
        down = [told["MAPAccelerometerVector"][axis] for axis in "xyz"]
        roll, pitch = (math.degrees(math.atan2(own, down[0])) for own in down[1:])
        heading = told["MAPCompassHeading"]["TrueHeading"] + COMPASS_DEG
        place = f"{told['MAPLatitude']},{told['MAPLongitude']},{HEIGHT_M}"
        poses.append(f"{taken:.3f},{place},{roll:.2f},{pitch:.2f},{heading:.2f},5,5,3,3,3,8")
        stamps.append(f"{name}.jpg,{taken:.3f}")
    for name, lines in (("poses.csv", poses), ("images/stamps.csv", stamps), ("rig.toml", [RIG]), ("S.toml", [SURVEY])):
        (folder / name).write_text("\n".join(lines) + "\n")
    return folder / "S.toml"


def _turn_of_opencv(recording: Path) -> np.ndarray:
    """Axes of the third camera from those of the second, by SIFT and OpenCV's essential matrix."""
    keys, words = [], []
    for name in NAMES[1:]:
        grey = cv2.imread(str(recording / f"images/{name}.jpg"), cv2.IMREAD_GRAYSCALE)
        found, own = cv2.SIFT_create(4000).detectAndCompute(cv2.resize(grey, None, fx=0.5, fy=0.5), None)
        keys.append(np.array([key.pt for key in found]) * 2.0 + 0.5)
        words.append(own)
    pairs = [a for a, b in cv2.BFMatcher().knnMatch(*words, k=2) if a.distance < 0.75 * b.distance]
    one, other = keys[0][[m.queryIdx for m in pairs]], keys[1][[m.trainIdx for m in pairs]]
    matrix = np.array([[FOCAL_PX, 0, 1631.5], [0, FOCAL_PX, 1223.5], [0, 0, 1]])
    essential, kept = cv2.findEssentialMat(one, other, matrix, method=cv2.RANSAC, prob=0.9999, threshold=2.0)
    return cv2.recoverPose(essential, one, other, matrix, mask=kept)[1]


@pytest.mark.slow
def test_three_photographs_are_oriented_by_two_surveyed_points(place: Place, tmp_path: Path) -> None:
    recording = place.recordings / "pictures/berlin"
    file = _survey(recording, tmp_path)
    said = "\n".join(place.run(file))
    # The point without a position costs nothing but itself.
    assert "1 × the point has no position" in said and "no control point is called 1: not used" in said
    assert "3 of 3 pictures take part" in said
    assert "1 control point in pictures: RMS in space" in said
    rows = pq.read_table(next(place.products(file).glob("tables/picture_residuals/*.parquet"))).to_pandas()
    control = rows[rows.point.notna()]
    assert sorted(zip(control.point, control.file, strict=True)) == [("0", "02.jpg"), ("0", "03.jpg"), ("3", "02.jpg")]
    before, after = (np.hypot(control[f"{word}_u_px"], control[f"{word}_v_px"]) for word in ("before", "after"))
    assert before.max() > 100.0 and after.max() < 8.0
    found = picture_drive.placed(file)
    turned = found[2, :, :3].T @ found[1, :, :3]
    # 2.1°: OpenCV has no control and believes the focal length.
    assert np.degrees(Rotation.from_matrix(turned @ _turn_of_opencv(recording).T).magnitude()) < 3.0
