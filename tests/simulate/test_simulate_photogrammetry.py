"""Simulated pictures as photogrammetry needs them, with their truth: held against OpenCV's SIFT and projection."""

from __future__ import annotations

import csv
import json
import tomllib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pyproj
import pytest
from scipy.spatial.transform import Rotation, Slerp

from roadscan.core.errors import ConfigError
from roadscan.simulate import Scene, simulate, truth

SMALL = {"width_px": 640, "height_px": 400, "focal_px": 490.0, "principal_px": (322.0, 198.2), "jpeg_quality": 98}
STREET = Scene.load("street_with_cameras")
PLATES = [
    {"station_m": 9.0, "offset_m": 4.0, "height_m": 1.4, "size_m": 0.8, "style": "checker", "name": "P1"},
    {
        "station_m": 15.0,
        "offset_m": -4.0,
        "height_m": 2.0,
        "size_m": 1.2,
        "style": "ring",
        "name": "P2",
        "role": "check",
    },
    {"station_m": 12.0, "offset_m": -5.2, "height_m": 1.2, "size_m": 0.8, "style": "disc", "turned_deg": 30.0},
]
TARGETS = [
    {"station_m": 7.5, "offset_m": 0.4, "diameter_m": 0.9, "style": "checker", "name": "T1"},
    {"station_m": 8.0, "offset_m": 3.0, "diameter_m": 0.9, "style": "ring", "role": "check"},
]
YARD = STREET.changed(
    length_m=3.0,
    road={"targets": TARGETS, "markings": [], "patches": [], "cracks": [], "stains": [], "tyre_marks": []},
    roadside={"targets": PLATES, "trees": [], "signs": [], "parked_cars": [], "moving_cars": []},
    lidar={"on": False},
    camera=SMALL | {"every_m": 1.5},
)


@dataclass(frozen=True)
class Survey:
    """A simulated survey's only run, and its cameras as the truth tells them."""

    folder: Path

    def rows(self, camera: str = "camera") -> list[dict]:
        return pq.read_table(truth.load(self.folder).camera_file("run-1", camera)).to_pylist()

    def picture(self, number: int, camera: str = "camera") -> np.ndarray:
        name = self.folder / "raw/run-1" / camera / self.rows(camera)[number]["file"]
        return cv2.imread(str(name), cv2.IMREAD_GRAYSCALE)

    def told(self, camera: str = "camera") -> dict:
        return json.loads(truth.load(self.folder).cameras_file.read_text())[camera]

    def lens(self, camera: str = "camera") -> tuple[np.ndarray, np.ndarray]:
        told = self.told(camera)
        u, v = told["principal_px"]
        return np.array([[told["focal_px"], 0, u], [0, told["focal_px"], v], [0, 0, 1.0]]), np.array(told["distortion"])

    def marks(self) -> dict[str, dict]:
        """Control points as they are, with ECEF coordinates by pyproj."""
        scene = truth.load(self.folder).scene
        to_ecef = pyproj.Transformer.from_crs(pyproj.CRS(scene.map.crs).to_3d(), "EPSG:4978", always_xy=True)
        with truth.load(self.folder).control_file.open() as stream:
            rows = list(csv.DictReader(stream))
        for row in rows:
            row["ecef"] = np.array(to_ecef.transform(*(float(row[k]) for k in ("easting_m", "northing_m", "height_m"))))
        return {row["name"]: row for row in rows}

    def pose(self, number: int, camera: str = "camera") -> tuple[np.ndarray, np.ndarray]:
        """OpenCV's rotation (3, 3) from the world, and the camera's place (3,)."""
        row = self.rows(camera)[number]
        sensor = Rotation.from_quat([row[f"q{a}"] for a in "xyzw"]).as_matrix()
        return sensor[:, [1, 2, 0]].T, np.array([row[f"{a}_world_m"] for a in "xyz"])

    def pixel(self, number: int, ecef: np.ndarray, camera: str = "camera") -> np.ndarray:
        rotation, at = self.pose(number, camera)
        return self.project(rotation, at, ecef, camera)

    def project(self, rotation: np.ndarray, at: np.ndarray, ecef: np.ndarray, camera: str = "camera") -> np.ndarray:
        point = rotation @ (ecef - at)
        assert point[2] > 0.0
        return cv2.projectPoints(point[None], np.zeros(3), np.zeros(3), *self.lens(camera))[0].ravel()


def saddle(picture: np.ndarray, near: np.ndarray) -> np.ndarray:
    """The corner of a chequered target by OpenCV."""
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    return cv2.cornerSubPix(picture, near.reshape(1, 1, 2).astype(np.float32), (4, 4), (-1, -1), stop).ravel()


def ring_middle(picture: np.ndarray, near: np.ndarray) -> np.ndarray:
    """The middle of the ellipse around the white disc in a ring, by thresholds and OpenCV's fit of its outline."""
    reach = 14
    column, row = np.rint(near).astype(int)
    window = picture[row - reach : row + reach + 1, column - reach : column + reach + 1]
    bright = cv2.resize(window, None, fx=8, fy=8, interpolation=cv2.INTER_CUBIC)
    _, binary = cv2.threshold(bright, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    outlines, _ = cv2.findContours(binary, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    middle = (np.array(bright.shape[::-1]) - 1) / 2
    inside = [o for o in outlines if len(o) > 30 and cv2.pointPolygonTest(o, middle.tolist(), False) > 0]
    smallest = min(inside, key=cv2.contourArea)
    (x, y), _, _ = cv2.fitEllipse(smallest)
    return np.array([(x + 0.5) / 8 - 0.5 + column - reach, (y + 0.5) / 8 - 0.5 + row - reach])


@pytest.fixture(scope="module")
def yard(tmp_path_factory: pytest.TempPathFactory) -> Survey:
    return Survey(simulate(YARD, tmp_path_factory.mktemp("photogrammetry") / "yard").folder)


@pytest.mark.slow
def test_matches_of_sift_agree_with_the_true_poses(yard: Survey):
    finder, matcher = cv2.SIFT_create(3000), cv2.BFMatcher()
    matrix, distortion = yard.lens()
    found = [finder.detectAndCompute(yard.picture(i), None) for i in (0, 1)]
    pairs = matcher.knnMatch(found[0][1], found[1][1], k=2)
    good = [a for a, b in pairs if a.distance < 0.8 * b.distance]
    places = [
        np.array([found[0][0][m.queryIdx].pt for m in good]),
        np.array([found[1][0][m.trainIdx].pt for m in good]),
    ]
    poses = [yard.pose(i) for i in (0, 1)]
    origin = poses[0][1]
    moved = [-rotation @ (at - origin) for rotation, at in poses]
    straight = [cv2.undistortPoints(p[:, None], matrix, distortion)[:, 0].T for p in places]
    projections = [np.column_stack([rotation, t]) for (rotation, _), t in zip(poses, moved, strict=True)]
    point = cv2.triangulatePoints(*projections, *straight)
    point = (point[:3] / point[3]).T
    away = []
    for (rotation, _), t, place in zip(poses, moved, places, strict=True):
        seen = cv2.projectPoints(point, cv2.Rodrigues(rotation)[0], t, matrix, distortion)[0][:, 0]
        away.append(np.linalg.norm(seen - place, axis=1))
    error = np.max(away, axis=0)
    assert (error < 1.5).sum() > 180
    assert np.median(error) < 0.3


@pytest.mark.slow
def test_targets_lie_where_true_poses_place_them(yard: Survey):
    marks = yard.marks()
    assert set(marks) == {"T1", "C002", "P1", "P2", "G005"}
    for name, middle in (("T1", saddle), ("P1", saddle), ("P2", ring_middle)):
        for number in (0, 1):
            expected = yard.pixel(number, marks[name]["ecef"])
            assert np.abs(middle(yard.picture(number), expected) - expected).max() < 0.3


@pytest.mark.slow
def test_the_survey_states_all_targets_with_its_errors(yard: Survey):
    with (yard.folder / "control.csv").open() as stream:
        stated = {row["name"]: row for row in csv.DictReader(stream)}
    marks = yard.marks()
    assert {name: (row["code"], row["role"]) for name, row in stated.items()} == {
        "T1": ("PAINT", "gcp"), "C002": ("PAINT", "check"), "P1": ("PLATE", "gcp"), "P2": ("PLATE", "check"),
        "G005": ("PLATE", "gcp"),
    }  # fmt: skip
    away = [
        [float(stated[name][k]) - float(marks[name][k]) for k in ("easting_m", "northing_m", "height_m")]
        for name in marks
    ]
    assert 0.0 < np.abs(away).max() < 5 * YARD.noise.control_m


@pytest.mark.slow
def test_the_rig_file_states_lens_and_mounting_with_their_errors(yard: Survey):
    rig, camera = tomllib.loads((yard.folder / "RIG.toml").read_text())["sensors"]["camera"], YARD.camera
    assert rig["interior"]["focal_px"] == [492.0, 492.0]
    assert np.allclose(rig["interior"]["principal_px"], [323.0, 197.4])
    assert np.isclose(rig["boresight"]["pitch_deg"], camera.mount.pitch_deg + camera.mount.error.pitch_deg)
    true = tomllib.loads((yard.folder / "truth/RIG.toml").read_text())["sensors"]["camera"]
    assert true["interior"]["focal_px"] == [490.0, 490.0] and true["boresight"]["pitch_deg"] == camera.mount.pitch_deg


@pytest.mark.slow
def test_brightness_is_fixed_to_the_surface_and_only_pictures_see_it(tmp_path: Path):
    even = YARD.changed(albedo={"road": None, "verge": None, "beside": None})
    lidar = {"on": True, "range_max_m": 6.0}
    logs = []
    for name, scene in (("rough", YARD), ("even", even)):
        made = simulate(scene.changed(length_m=1.0, lidar=lidar, camera={"every_m": 5.0}), tmp_path / name)
        logs.append([(made.folder / "raw/run-1" / f).read_bytes() for f in ("lidar.pcap", "camera/000000.jpg")])
    assert logs[0][0] == logs[1][0]
    assert logs[0][1] != logs[1][1]


@pytest.mark.slow
def test_a_moving_car_takes_its_brightness_along(tmp_path: Path):
    """A car that drives ahead at the camera's own speed looks the same in each picture; the road under it does not."""
    car = {"station_m": 8.0, "offset_m": 1.625, "speed_m_per_s": 10.0, "shade": 150.0}
    still = {"speed_variation": 0.0, "wander_m": 0.0, "heave_m": 0.0, "sway_deg": 0.0}
    scene = YARD.changed(
        length_m=9.0, road={"targets": [], "roughness": None, "waves": []}, vehicle=still,
        roadside={"moving_cars": [car], "facades": [], "targets": [], "walls": [], "fences": [], "lamp_posts": []},
        albedo={"beside": {"smooth": 0.3}}, camera={"every_m": 4.0},
    ).noiseless()  # fmt: skip
    survey = Survey(simulate(scene, tmp_path / "car").folder)
    first, second = (survey.picture(i).astype(float) for i in (0, 1))
    rear, road = np.s_[150:185, 300:350], np.s_[330:390, 100:540]
    assert first[rear].std() > 8.0 and first[road].std() > 8.0
    assert np.corrcoef(first[rear].ravel(), second[rear].ravel())[0, 1] > 0.9
    assert abs(np.corrcoef(first[road].ravel(), second[road].ravel())[0, 1]) < 0.5


@pytest.mark.slow
def test_rows_of_a_rolling_shutter_are_exposed_one_after_another(tmp_path: Path):
    fast = {"speed_m_per_s": 27.8}
    passes, camera = [{"lane": 2, **fast}], {"line_time_us": 60.0, "stamped_row": "last"}
    survey = Survey(simulate(YARD.changed(passes=passes, vehicle=fast, camera=camera), tmp_path / "fast").folder)
    told, mark = survey.told(), survey.marks()["T1"]["ecef"]
    body = pq.read_table(truth.load(survey.folder).trajectory_file("run-1")).to_pandas()
    turns = Slerp(body["epoch_gps_ns"], Rotation.from_quat(body[["qx", "qy", "qz", "qw"]]))
    mount = told["mount"]
    angles = [mount[f"{k}_deg"] for k in ("heading", "pitch", "roll")]
    row = survey.rows()[0]
    expected = survey.pixel(0, mark)
    for _ in range(5):
        epoch = row["epoch_gps_ns"] + (expected[1] - told["stamped_row_px"]) * told["line_time_us"] * 1e3
        turned = turns(epoch)
        at = np.array([np.interp(epoch, body["epoch_gps_ns"], body[f"{a}_world_m"]) for a in "xyz"])
        sensor = (turned * Rotation.from_euler("ZYX", angles, degrees=True)).as_matrix()
        expected = survey.project(sensor[:, [1, 2, 0]].T, at + turned.apply(mount["lever_arm_body_m"]), mark)
    assert np.linalg.norm(expected - survey.pixel(0, mark)) > 2.0, "the shutter hardly matters"
    assert np.abs(saddle(survey.picture(0), expected) - expected).max() < 0.3


def test_exposure_faults_and_a_second_camera(tmp_path: Path):
    small = {"width_px": 160, "height_px": 100, "focal_px": 120.0, "principal_px": None}
    camera = small | {"every_m": 0.5, "exposure": {"walk": 0.0, "step": 0.4, "steps_per_100": 60.0}}
    camera |= {"faults": {"black": [2], "doubled": [4]}, "noise": 1.0}
    back = {
        "name": "camera_back",
        "every_m": 1.5,
        "mount": {"lever_arm_body_m": (-1.5, 0.0, -1.1), "heading_deg": 180.0},
    }
    scene = YARD.changed(camera=camera, further_cameras=[small | back])
    survey = Survey(simulate(scene, tmp_path / "faults").folder)
    rows = survey.rows()
    assert [row["fault"] for row in rows][:6] == ["", "", "black", "", "doubled", ""]
    pictures = [survey.picture(i) for i in range(6)]
    assert pictures[2].max() < 10 and np.array_equal(pictures[3], pictures[4])
    usual = [0, 1, 3, 5]
    level = np.array([np.median(pictures[i][60:]) / rows[i]["gain"] for i in usual])
    assert np.ptp([rows[i]["gain"] for i in usual]) > 0.2 and np.ptp(level) / level.mean() < 0.15
    assert len(survey.rows("camera_back")) == 3 and survey.picture(0, "camera_back").shape == (100, 160)
    ahead = survey.pose(0)[0][2] @ survey.pose(0, "camera_back")[0][2]
    assert ahead < -0.9
    rig = tomllib.loads((survey.folder / "RIG.toml").read_text())["sensors"]
    assert rig["camera_back"]["interior"]["focal_px"] == [120.0, 120.0]


def test_an_outage_drifts_and_says_so(tmp_path: Path):
    """Errors of the stated positions by pyproj against the truth, over what the accuracy file states."""
    outage = {"start_s": 0.5, "duration_s": 4.0, "position_m": 2.0}
    scene = YARD.changed(length_m=50.0, road={"targets": TARGETS}, camera={"on": False}, noise={"outages": [outage]})
    errors = []
    for seed in range(8):
        made = simulate(scene.changed(seed=seed), tmp_path / str(seed))
        poses = np.fromfile(made.folder / "raw/run-1/trajectory.sbet", "<f8").reshape(-1, 17)
        to_ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
        stated = np.stack(to_ecef.transform(*np.degrees(poses[:, [2, 1]].T), poses[:, 3]), axis=-1)
        true = pq.read_table(truth.load(made.folder).trajectory_file("run-1")).to_pandas()
        away = stated - true[[f"{a}_world_m" for a in "xyz"]].to_numpy()
        since = (true["epoch_gps_ns"].to_numpy() - 1e9 * scene.start.timestamp() + 315964800e9 - 18e9) * 1e-9
        errors.append(np.abs(away).max(axis=1)[[int(np.abs(since - t).argmin()) for t in (-0.5, 2.5, 4.7)]])
        accuracy = np.fromfile(made.folder / "raw/run-1/trajectory.smrmsg", "<f8").reshape(-1, 10)
        assert accuracy[:, 1].min() < 0.2 and 1.8 < accuracy[:, 1].max() < 2.1
    before, within, after = np.array(errors).T
    assert before.max() < 0.5 and after.max() < 0.5
    assert 1.0 < np.median(within) < 5.0


def test_what_cannot_be_is_refused():
    with pytest.raises(ConfigError, match="picture 0"):
        YARD.changed(camera={"faults": {"doubled": [0]}})
    with pytest.raises(ConfigError, match="one name"):
        YARD.changed(further_cameras=[{"name": "camera_left"}, {"name": "camera_left"}])
    with pytest.raises(ConfigError, match="finer"):
        YARD.changed(albedo={"road": {"finest_m": 0.5, "coarsest_m": 0.1}})
