"""Pictures of the simulated camera, held against OpenCV's projection of known places with the true pose."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pyproj
import pytest
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from roadscan.core.errors import ConfigError
from roadscan.core.rig import Rig, Sensor
from roadscan.core.survey import ClockConfig
from roadscan.simulate import Scene, simulate, truth
from roadscan.simulate.scene import Camera
from roadscan.simulate.sensors.lens import Lens
from tests.formats.log_reading import read_log

BARREL = (-0.22, 0.05, 0.002, -0.0015, 0.004)
BOX = {"station_m": 10.0, "offset_m": 2.1, "length_m": 1.2, "width_m": 0.8, "height_m": 0.6, "shade": 240.0}
CAR = {"station_m": 17.0, "offset_m": -1.8, "speed_m_per_s": 6.0, "shade": 20.0}
YARD = (
    Scene()
    .changed(
        length_m=6.0,
        map={"azimuth_deg": 57.0},
        road={
            "markings": [],
            "targets": [
                {"station_m": 6.5, "offset_m": -1.6, "diameter_m": 0.9, "centre_m": 0.4},
                {"station_m": 7.5, "offset_m": 2.3, "diameter_m": 0.9, "centre_m": 0.4},
                {"station_m": 9.5, "offset_m": -3.0, "diameter_m": 0.9, "centre_m": 0.4},
            ],
            "crosswalks": [{"station_m": 8.5, "from_m": -0.5, "to_m": 1.0, "length_m": 2.0}],
        },
        roadside={"boxes": [BOX], "moving_cars": [CAR]},
        passes=[{"lane": 1, "speed_m_per_s": 5.0}],
        vehicle={"speed_m_per_s": 5.0},
        profilers={"on": False},
        lidar={"on": False},
        camera={
            "on": True,
            "every_m": 2.5,
            "distortion": BARREL,
            "principal_px": (470.0, 310.0),
            "jpeg_quality": 100,
            "mount": {"roll_deg": 3.0, "pitch_deg": -10.0, "heading_deg": 9.0},
        },
    )
    .noiseless()
)


@dataclass(frozen=True)
class Pictures:
    """The pictures of a survey's only run, with the true poses of the camera."""

    folder: Path
    scene: Scene
    distortion: tuple[float, ...]

    @property
    def rows(self) -> list[dict]:
        return pq.read_table(truth.load(self.folder).camera_file("run-1")).to_pylist()

    def grey(self, number: int) -> np.ndarray:
        return cv2.imread(str(self.folder / "raw/run-1/camera" / self.rows[number]["file"]), cv2.IMREAD_GRAYSCALE)

    def ground(self, station: np.ndarray, offset: np.ndarray, above: float = 0.0) -> np.ndarray:
        """Map coordinates (n, 3) at places of this straight road."""
        station, offset = np.broadcast_arrays(np.asarray(station, float), np.asarray(offset, float))
        place, azimuth = self.scene.map, math.radians(self.scene.map.azimuth_deg)
        e = place.easting_m + station * math.sin(azimuth) + offset * math.cos(azimuth)
        n = place.northing_m + station * math.cos(azimuth) - offset * math.sin(azimuth)
        return np.stack([e, n, truth.load(self.folder).height_m(e, n) + above], axis=-1)

    def pixels(self, number: int, enh: np.ndarray) -> np.ndarray:
        """Columns and rows (n, 2) of map points, by pyproj and OpenCV."""
        row = self.rows[number]
        to_ecef = pyproj.Transformer.from_crs(pyproj.CRS(self.scene.map.crs).to_3d(), "EPSG:4978", always_xy=True)
        at = np.stack(to_ecef.transform(*enh.T), axis=-1) - [row[f"{a}_world_m"] for a in "xyz"]
        sensor = Rotation.from_quat([row[f"q{a}"] for a in "xyzw"]).inv().apply(at)
        camera = self.scene.camera
        (u, v), f = camera.principal_px, camera.focal_px
        matrix = np.array([[f, 0.0, u], [0.0, f, v], [0.0, 0.0, 1.0]])
        opencv_axes = np.ascontiguousarray(sensor[:, [1, 2, 0]])  # right, down, ahead
        found, _ = cv2.projectPoints(opencv_axes, np.zeros(3), np.zeros(3), matrix, np.array(self.distortion))
        return found.reshape(-1, 2)

    def edge_px(self, number: int, enh: np.ndarray) -> np.ndarray:
        """How far (n,) the strongest edge lies from the projection of a line of map points (n + 1, 3), within 3 px."""
        line = self.pixels(number, enh)
        along = np.diff(line, axis=0)
        across = np.stack([-along[:, 1], along[:, 0]], axis=-1) / np.linalg.norm(along, axis=1, keepdims=True)
        steps = np.arange(-3.0, 3.01, 0.25)
        places = (line[:-1] + line[1:])[:, None] / 2 + steps[:, None] * across[:, None]
        profile = map_coordinates(self.grey(number).astype(float), [places[..., 1], places[..., 0]], order=1)
        slope = np.abs(np.diff(profile, axis=1))
        assert (slope.max(axis=1) > 2.0).all(), "there is no edge"
        weight = slope**2
        return weight @ (steps[:-1] + steps[1:]) / 2 / weight.sum(axis=1)


@pytest.fixture(scope="module")
def yard(tmp_path_factory: pytest.TempPathFactory) -> Pictures:
    made = simulate(YARD, tmp_path_factory.mktemp("camera") / "yard")
    return Pictures(made.folder, YARD, BARREL)


def between(first: tuple[float, float], second: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Stations and offsets of 12 places along a line."""
    share = np.linspace(0.2, 0.8, 12)
    return first[0] + share * (second[0] - first[0]), first[1] + share * (second[1] - first[1])


@pytest.mark.slow
def test_targets_appear_where_they_are_projected(yard: Pictures):
    grey = yard.grey(0)
    contours, hierarchy = cv2.findContours((grey > 130).astype(np.uint8)[250:], cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    holes = [cv2.boundingRect(c) for c, h in zip(contours, hierarchy[0], strict=True) if h[3] >= 0 and len(c) > 15]
    assert len(holes) == 3
    found = []
    for left, top, width, height in holes:
        window = np.s_[top + 250 - 2 : top + 250 + height + 2, left - 2 : left + width + 2]
        dark = np.clip(120.0 - grey[window], 0.0, None)
        rows, columns = np.indices(dark.shape)
        found.append([(dark * columns).sum() / dark.sum() + left - 2, (dark * rows).sum() / dark.sum() + top + 248])
    places = [(t.station_m, t.offset_m) for t in YARD.road.targets]
    for expected in yard.pixels(0, yard.ground(*np.array(places).T)):
        away = np.abs(np.array(found) - expected).max(axis=1)
        assert away.min() < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 1])
def test_edges_of_stripes_appear_where_they_are_projected(yard: Pictures, number: int):
    for offset in (-0.5, 0.0, 0.5, 1.0):
        edge = yard.edge_px(number, yard.ground(*between((7.5, offset), (9.5, offset))))
        assert np.abs(edge).max() < 0.6
        assert abs(edge.mean()) < 0.15


@pytest.mark.slow
def test_a_box_appears_where_it_stands(yard: Pictures):
    foot = yard.ground([BOX["station_m"]], [BOX["offset_m"]])[0]
    near, left, right = BOX["station_m"] - 0.6, BOX["offset_m"] - 0.4, BOX["offset_m"] + 0.4
    far = BOX["station_m"] + 0.6

    def top(a: tuple[float, float], b: tuple[float, float]) -> np.ndarray:
        line = yard.ground(*between(a, b))
        line[:, 2] = foot[2] + BOX["height_m"]
        return line

    for line in (top((far, left), (far, right)), top((near, left), (near, right))):
        assert np.abs(yard.edge_px(0, line)).max() < 0.6
    for corner in ((far, left), (near, right)):
        upright = np.repeat(yard.ground([corner[0]], [corner[1]]), 12, axis=0)
        upright[:, 2] = foot[2] + np.linspace(0.1, 0.5, 12)
        assert np.abs(yard.edge_px(0, upright)).max() < 0.6
    # To the right of the lane: on the right of the picture.
    assert yard.pixels(0, foot[None])[0, 0] > 480


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 2])
def test_a_moving_car_is_where_it_has_come_to(yard: Pictures, number: int):
    drive_s = (yard.rows[number]["epoch_gps_ns"] - yard.rows[0]["epoch_gps_ns"]) / 1e9
    back = CAR["station_m"] + CAR["speed_m_per_s"] * drive_s - 2.2
    left, right = CAR["offset_m"] - 0.9, CAR["offset_m"] + 0.9
    upright = np.repeat(yard.ground([back], [left]), 12, axis=0)
    upright[:, 2] = yard.ground([back + 2.2], [CAR["offset_m"]])[0, 2] + np.linspace(0.65, 0.9, 12)
    assert np.abs(yard.edge_px(number, upright)).max() < 0.6
    assert (number > 0) == (drive_s > 0.4)
    assert right - left == pytest.approx(1.8)


@pytest.mark.slow
def test_shadows_fall_away_from_the_sun(yard: Pictures):
    # The sun stands 42 degrees high, 150 degrees from north: the shadow of the box falls to the north-north-west.
    base = yard.ground([BOX["station_m"]], [BOX["offset_m"]])[0]
    way = np.radians(150.0 + 180.0 - 1.9)  # the meridian's convergence here
    flat = np.array([math.sin(way), math.cos(way), 0.0])
    tone = []
    for place in (base + 0.85 * flat, base + 1.6 * flat):  # 0.6 m high at 42 degrees: 0.67 m long
        place[2] = truth.load(yard.folder).height_m(*place[:2])
        u, v = np.rint(yard.pixels(0, place[None])[0]).astype(int)
        tone.append(float(yard.grey(0)[v, u]))
    assert tone[0] < 0.7 * tone[1]


@pytest.mark.slow
def test_the_sign_of_the_distortion_matters(yard: Pictures):
    line = yard.ground(*between((7.5, 1.0), (9.5, 1.0)))
    wrong = Pictures(yard.folder, YARD, tuple(-k for k in BARREL))
    away = np.linalg.norm(wrong.pixels(0, line) - yard.pixels(0, line), axis=1)
    assert away.max() > 4.0, "the test could not tell"


@pytest.mark.parametrize("distortion", [BARREL, (0.15, -0.02, -0.001, 0.002, 0.01), (0.0,) * 5])
def test_rays_are_opencvs_projection_turned_round(distortion: tuple[float, ...]):
    camera = Camera(distortion=distortion)
    column, row = (a.ravel() for a in np.meshgrid(np.linspace(-0.5, 959.5, 33), np.linspace(-0.5, 599.5, 21)))
    ray = Lens.of(camera).rays(column, row)
    np.testing.assert_allclose(np.linalg.norm(ray, axis=1), 1.0, atol=1e-14)
    matrix = np.array([[820.0, 0.0, 479.5], [0.0, 820.0, 299.5], [0.0, 0.0, 1.0]])
    points = np.ascontiguousarray(ray[:, [1, 2, 0]])
    found, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(distortion))
    np.testing.assert_allclose(found.reshape(-1, 2), np.stack([column, row], axis=-1), atol=1e-6)


def test_a_distortion_that_folds_the_picture_over_is_refused():
    with pytest.raises(ConfigError, match="folds the picture over"):
        Lens.of(Camera(distortion=(-1.5, 0.0, 0.0, 0.0, 0.0))).rays([0.0, 959.0], [0.0, 599.0])


@pytest.mark.slow
def test_nothing_is_sky(yard: Pictures):
    grey = yard.grey(0)
    assert grey[:40].min() > 160
    assert (np.diff(grey[:80, 100].astype(float)) >= -1.0).all(), "brighter towards the horizon"


SMALL = YARD.changed(
    length_m=11.0,
    camera={
        "every_m": 4.0,
        "width_px": 160,
        "height_px": 100,
        "focal_px": 140.0,
        "principal_px": None,
        "noise": 3.0,
        "clock": {"offset_s": -0.4, "drift_ppm": 25.0, "known": True},
    },
)


def test_stamps_are_read_as_the_true_epochs(tmp_path: Path):
    made = simulate(SMALL, tmp_path / "survey")
    (stated,) = [
        log for log in tomllib.loads(made.survey_file.read_text())["runs"][0]["logs"] if "camera" in log["path"]
    ]
    assert stated["format"] == "images"
    log = read_log(
        "images",
        made.folder / stated["path"],
        sensor=Sensor(kind="camera"),
        clock=ClockConfig.parse(stated["clock"]).clock(),
    )
    rows = pq.read_table(truth.load(made.folder).camera_file("run-1"))
    assert log.rejects == []
    assert log.table["file"].to_pylist() == rows["file"].to_pylist() == ["000000.jpg", "000001.jpg", "000002.jpg"]
    assert log.table["width_px"].to_pylist() == [160] * 3
    np.testing.assert_allclose(log.epochs, rows["epoch_gps_ns"].to_numpy(), atol=2, rtol=0)
    at = np.stack([rows[f"{a}_world_m"].to_numpy() for a in "xyz"], axis=-1)
    np.testing.assert_allclose(np.linalg.norm(np.diff(at, axis=0), axis=1), 4.0, atol=0.05)
    # The stamps themselves are wrong by what the clock is wrong.
    unix_ns = [
        int(line.split(",")[1]) for line in (log_folder(made.folder) / "stamps.csv").read_text().splitlines()[1:]
    ]
    utc = rows["epoch_gps_ns"].to_numpy() + (315_964_800 - 18) * 10**9
    np.testing.assert_allclose((unix_ns - utc) / 1e9, -0.4, atol=1e-4)


def log_folder(survey: Path) -> Path:
    return survey / "raw" / "run-1" / "camera"


@pytest.mark.slow
def test_same_scene_same_pictures_and_noise_of_the_size_stated(tmp_path: Path):
    for name in ("a", "b"):
        simulate(SMALL, tmp_path / name)
    simulate(SMALL.noiseless(), tmp_path / "clean")
    first, second, clean = (log_folder(tmp_path / name) for name in ("a", "b", "clean"))
    files = sorted(p.name for p in first.iterdir())
    assert files == ["000000.jpg", "000001.jpg", "000002.jpg", "stamps.csv"]
    for name in files:
        assert (first / name).read_bytes() == (second / name).read_bytes()
    grey = [cv2.imread(str(f / "000001.jpg"), cv2.IMREAD_GRAYSCALE).astype(float) for f in (first, clean)]
    assert np.std(grey[0] - grey[1]) == pytest.approx(3.0, rel=0.15)


def test_the_rig_file_states_the_nominal_mounting(tmp_path: Path):
    scene = SMALL.changed(camera={"mount": {"error": {"pitch_deg": 0.7, "lever_arm_body_m": (0.0, 0.02, 0.0)}}})
    made = simulate(scene, tmp_path / "survey")
    sensor = tomllib.loads(made.rig_file.read_text())["sensors"]["camera"]
    assert sensor["kind"] == "camera"
    assert sensor["boresight"]["pitch_deg"] == pytest.approx(-10.0 + 0.7)
    assert sensor["lever_arm_body_m"] == pytest.approx([0.9, -0.23, -1.15])
    interior = Rig.load(made.rig_file).sensors["camera"].interior
    assert interior is not None
    assert (interior.width_px, interior.height_px, interior.focal_px) == (160, 100, (140.0, 140.0))
    assert interior.principal_px == (79.5, 49.5)
    assert interior.distortion == BARREL
    assert Rig.load(truth.load(made.folder).rig_file).sensors["camera"].interior == interior
