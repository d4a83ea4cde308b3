"""Interior orientation from rendered chessboards, exterior from control points in simulated pictures."""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pyproj
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from roadscan.calibrate.chessboard import Board, InteriorOptions, interior_from_pictures
from roadscan.calibrate.estimator import Prior
from roadscan.calibrate.evidence import Traverse
from roadscan.calibrate.resection import Exposure, Measured, Target, project, resect, tangents
from roadscan.core.errors import ConfigError
from roadscan.core.rig import Interior, Mounting, Rig, Sensor
from roadscan.simulate import Scene, simulate, truth

BOARD = Board(columns=9, rows=6, square_m=0.03)
SIZE = (520, 390)
FOCAL, PRINCIPAL = (470.0, 474.0), (251.3, 201.8)
DISTORTION = (-0.21, 0.06, 0.0008, -0.0011, 0.0)
FINE = 2
"""Rays a pixel and side."""


class Renderer:
    """A camera of known interior orientation; its projection shares nothing with OpenCV's."""

    def bent(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        k1, k2, p1, p2, k3 = DISTORTION
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        return x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y

    @cached_property
    def rays(self) -> np.ndarray:
        """(rows, columns, 3) rays of FINE × FINE places in each pixel, whose centre is a whole number.

        Drawn at random within their part of the pixel: even steps would see edges along the rows in halves.
        """
        rng = np.random.default_rng(0)
        u, v = np.meshgrid(np.arange(SIZE[0] * FINE), np.arange(SIZE[1] * FINE))
        u, v = ((axis + rng.random(axis.shape)) / FINE - 0.5 for axis in (u, v))
        u, v = (u - PRINCIPAL[0]) / FOCAL[0], (v - PRINCIPAL[1]) / FOCAL[1]
        x, y = u.copy(), v.copy()
        for _ in range(40):
            bx, by = self.bent(x, y)
            x, y = x + (u - bx), y + (v - by)
        assert max(np.abs(self.bent(x, y)[0] - u).max(), np.abs(self.bent(x, y)[1] - v).max()) < 1e-9
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def picture(self, turn: Rotation, middle: np.ndarray, blur_px: float, noise: float, seed: int) -> np.ndarray:
        """Grey values of the board turned and with its middle at a place (right, down, ahead)."""
        to_board = turn.inv().as_matrix()
        ray, eye = self.rays @ to_board.T, -to_board @ middle
        along = -eye[2] / ray[..., 2]
        squares = (eye[:2] + along[..., None] * ray[..., :2]) / BOARD.square_m
        squares += [(BOARD.columns - 1) / 2, (BOARD.rows - 1) / 2]  # inner corners are whole numbers
        column, row = np.floor(squares).astype(int)[..., 0], np.floor(squares).astype(int)[..., 1]
        on_board = (column >= -1) & (column < BOARD.columns) & (row >= -1) & (row < BOARD.rows)
        paper = (squares > -2.0).all(axis=-1) & (squares < [BOARD.columns + 1.0, BOARD.rows + 1.0]).all(axis=-1)
        grey = np.where(on_board & ((column + row) % 2 == 0), 40.0, 215.0)
        grey = gaussian_filter(np.where(paper & (along > 0), grey, 110.0), blur_px * FINE)
        grey = grey.reshape(SIZE[1], FINE, SIZE[0], FINE).mean(axis=(1, 3))
        rng = np.random.default_rng(seed)
        return np.clip(np.rint(grey + noise * rng.standard_normal(grey.shape)), 0, 255).astype(np.uint8)


POSES = [  # turn about x, y, z (degrees), then where the board's middle lies (m)
    ((0, 0, 0), (0.0, 0.0, 0.45)), ((30, 0, 5), (-0.10, -0.05, 0.48)), ((-32, 5, -8), (0.10, 0.06, 0.50)),
    ((4, 33, 0), (0.11, -0.06, 0.46)), ((-5, -34, 12), (-0.09, 0.05, 0.50)), ((25, 24, 80), (0.05, 0.0, 0.52)),
    ((-24, 26, 20), (-0.06, 0.03, 0.40)), ((22, -25, -30), (0.02, -0.07, 0.55)), ((-10, 12, 95), (-0.14, 0.0, 0.55)),
    ((14, -10, 85), (0.16, 0.02, 0.55)),
]  # fmt: skip


@pytest.fixture(scope="module")
def pictures() -> list[tuple[str, np.ndarray]]:
    camera = Renderer()
    return [
        (f"{k:02d}.png", camera.picture(Rotation.from_euler("xyz", a, degrees=True), np.array(t), 0.6, 3.0, k))
        for k, (a, t) in enumerate(POSES)
    ]


def numbers(interior: Interior) -> tuple[np.ndarray, np.ndarray]:
    """Parameters and their σ."""
    estimate = np.array([*interior.focal_px, *interior.principal_px, *interior.distortion])
    return estimate, np.array([*interior.sigma_focal_px, *interior.sigma_principal_px, *interior.sigma_distortion])


@pytest.mark.slow
def test_the_interior_orientation_is_recovered_within_its_sigma(pictures):
    """A pixel whose centre is half a pixel off, or a tangential term of the wrong sign, is many σ."""
    report = interior_from_pictures(pictures, BOARD, date=dt.date(2026, 3, 1))
    estimate, sigma = numbers(report.interior)
    free = sigma > 0
    true = np.array([*FOCAL, *PRINCIPAL, *DISTORTION])
    assert np.abs((estimate - true)[free] / sigma[free]).max() < 3.0
    assert sigma[:4].max() < 0.8
    assert estimate[8] == sigma[8] == 0.0, "k3 is 0 in truth, and nothing in the pictures speaks for it"
    assert report.rejected == ()
    assert (report.interior.width_px, report.interior.height_px) == SIZE
    assert (report.interior.pictures, report.interior.date) == (len(POSES), dt.date(2026, 3, 1))
    assert 0.03 < report.interior.rms_px < 0.2
    all_residuals = np.concatenate([p.residual_px for p in report.used])
    assert np.sqrt((all_residuals**2).sum(axis=1).mean()) == pytest.approx(report.interior.rms_px, rel=1e-3)
    assert report.coverage == 1.0
    assert 0.7 < report.reach < 1.0
    for picture, (angles, middle) in zip(report.used, POSES, strict=True):
        normal = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()[2, 2]
        assert picture.tilt_deg == pytest.approx(np.degrees(np.arccos(normal)), abs=0.5)
        assert picture.distance_m == pytest.approx(np.linalg.norm(middle), rel=0.005)


@pytest.mark.slow
def test_pictures_are_left_out_with_reasons(pictures):
    # A board that is not flat: its picture, moved aside and bent by up to 3 px.
    column, row = np.meshgrid(np.arange(SIZE[0], dtype=np.float32), np.arange(SIZE[1], dtype=np.float32))
    bent = cv2.remap(pictures[0][1], column - 25, row + 3 * np.sin(column / 60), cv2.INTER_LINEAR, borderValue=110)
    worse = [
        ("torn.jpg", None),
        ("upright.jpg", np.zeros((SIZE[0], SIZE[1]), np.uint8)),
        ("empty.jpg", np.full((SIZE[1], SIZE[0]), 90, np.uint8)),
        ("again.jpg", np.roll(pictures[1][1], 2, axis=1)),
        ("bent.jpg", bent),
    ]
    report = interior_from_pictures([*pictures, *worse], BOARD)
    reasons = {r.name: r.reason for r in report.rejected}
    assert set(reasons) == {name for name, _ in worse}
    assert "cannot be read" in reasons["torn.jpg"]
    assert "390 × 520" in reasons["upright.jpg"]
    assert "no whole board" in reasons["empty.jpg"]
    assert reasons["again.jpg"] == "the same view as 01.png"
    assert "RMS" in reasons["bent.jpg"]
    np.testing.assert_allclose(
        numbers(report.interior)[0], numbers(interior_from_pictures(pictures, BOARD).interior)[0]
    )


@pytest.mark.slow
def test_pictures_that_tell_too_little_are_refused(pictures):
    with pytest.raises(ConfigError, match=r"3 of 3 pictures .* at least 6"):
        interior_from_pictures(pictures[:3], BOARD)
    with pytest.raises(ConfigError, match=r"same view as 01\.png"):
        interior_from_pictures([pictures[1], *((f"{k}", pictures[1][1]) for k in range(6))], BOARD)
    with pytest.raises(ConfigError, match="10 × 7 inner corners"):
        interior_from_pictures(pictures[:1], Board(columns=10, rows=7, square_m=0.03))
    with pytest.raises(ConfigError, match="no picture could be read"):
        interior_from_pictures([("a", None)], BOARD)
    few = InteriorOptions(least_pictures=4, least_coverage=0.99)
    with pytest.raises(ConfigError, match="corners of the picture"):
        interior_from_pictures(pictures[:4], BOARD, few)


@pytest.mark.slow
def test_boards_that_were_never_tilted_are_refused():
    camera = Renderer()
    turns = Rotation.from_euler("z", [[5], [25], [45], [65]], degrees=True)
    flat = [camera.picture(t, np.array([0.05 * k - 0.07, 0.02, 0.5]), 0.6, 3.0, k) for k, t in enumerate(turns)]
    few = InteriorOptions(least_pictures=4, least_coverage=0.2)
    with pytest.raises(ConfigError, match="tilted"):
        interior_from_pictures([(str(k), grey) for k, grey in enumerate(flat)], BOARD, few)


TARGETS = [
    {"station_m": s, "offset_m": d, "diameter_m": 0.8, "centre_m": 0.36}
    for s, d in ((36.0, -3.0), (36.0, 3.0), (44.0, -3.0), (44.0, 3.0), (40.0, -6.0), (40.0, 6.0))
]
YARD = Scene.load("calibration_yard").changed(
    passes=[{"route": {"station_m": 14.0, "offset_m": -1.0, "heading_deg": 4.0, "pieces": [{"length_m": 20.0}]}}],
    profilers={"on": False, "head_imus": None},
    lidar={"on": False},
    sick={"on": False},
    imu={"on": False},
    gnss={"on": False},
    encoder={"on": False},
    vehicle={"standstill_s": 0.0},
    road={"targets": TARGETS},
    roadside={"boxes": [], "facades": [], "poles": []},
    camera={
        "every_m": 6.0,
        "mount": {"error": {"lever_arm_body_m": (0.04, -0.03, 0.05), "pitch_deg": 0.9, "heading_deg": -1.1}},
    },
    noise={"control_m": 0.0},
)


@dataclass(frozen=True)
class Drive:
    """A simulated drive past the yard's targets: what is true, and the pictures."""

    folder: Path

    @cached_property
    def truth(self) -> truth.Truth:
        return truth.load(self.folder)

    @cached_property
    def rows(self) -> list[dict]:
        return pq.read_table(self.truth.camera_file("run-1")).to_pylist()

    @cached_property
    def to_world(self) -> pyproj.Transformer:
        return pyproj.Transformer.from_crs(pyproj.CRS(YARD.map.crs).to_3d(), "EPSG:4978", always_xy=True)

    @cached_property
    def targets_m(self) -> dict[str, np.ndarray]:
        """True places of the painted targets (ECEF)."""
        places = np.array([(t.station_m, t.offset_m) for t in YARD.road.targets])
        easting, northing, _ = self.truth.surface.place(places[:, 0], places[:, 1])
        height = self.truth.surface.height_m(easting, northing, texture=False)
        world = np.stack(self.to_world.transform(easting, northing, height), axis=-1)
        return {f"T{k}": p for k, p in enumerate(world)}

    @cached_property
    def level(self) -> np.ndarray:
        """World from north, east, down at the yard."""
        lon, lat, _ = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True).transform(
            *self.targets_m["T0"]
        )
        return Rotation.from_euler("ZY", [lon, -lat - 90.0], degrees=True).as_matrix()

    def pose(self, row: dict) -> tuple[np.ndarray, Rotation]:
        """True pose of the body at a picture, from the camera's and its true mounting."""
        mount = YARD.camera.mount
        boresight = Rotation.from_euler("ZYX", [mount.heading_deg, mount.pitch_deg, mount.roll_deg], degrees=True)
        camera = Rotation.from_quat([row[f"q{a}"] for a in "xyzw"])
        body = camera * boresight.inv()
        return np.array([row[f"{a}_world_m"] for a in "xyz"]) - body.apply(mount.lever_arm_body_m), body

    def pixel(self, row: dict, place: np.ndarray) -> np.ndarray | None:
        """Where a place (ECEF) appears in a picture: no code of roadscan or OpenCV takes part."""
        camera = Rotation.from_quat([row[f"q{a}"] for a in "xyzw"])
        ahead, right, down = camera.inv().apply(place - [row[f"{a}_world_m"] for a in "xyz"])
        if ahead < 1.0 or max(abs(right), abs(down)) > ahead:
            return None
        k1, k2, p1, p2, k3 = YARD.camera.distortion
        x, y = right / ahead, down / ahead
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        bent = (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        )
        found = YARD.camera.focal_px * np.array(bent) + [479.5, 299.5]
        return found if (found > 4.0).all() and (found < [955.0, 595.0]).all() else None

    def exposures(self, rng: np.random.Generator, sigma_m: float = 0.0, sigma_deg: float = 0.0) -> list[Exposure]:
        """Poses with errors, each picture its own."""
        found = []
        for k, row in enumerate(self.rows):
            position, body = self.pose(row)
            error = Traverse("run-1", k * 10**12, (sigma_m,) * 3, (np.radians(sigma_deg),) * 3, self.level, 1.0)
            position = position + sigma_m * rng.standard_normal(3)
            body = body * Rotation.from_rotvec(np.radians(sigma_deg) * rng.standard_normal(3))
            found.append(Exposure(row["file"], position, body.as_matrix(), error))
        return found

    def control(self, sigma_m: float = 0.0, rng: np.random.Generator | None = None) -> list[Target]:
        shift = np.zeros(3) if rng is None else sigma_m
        return [
            Target(name, p + shift * (0 if rng is None else rng.standard_normal(3)), sigma_m**2 * np.eye(3))
            for name, p in self.targets_m.items()
        ]

    def measured(self, rng: np.random.Generator, sigma_px: float) -> list[Measured]:
        found = []
        for row in self.rows:
            for name, place in self.targets_m.items():
                pixel = self.pixel(row, place)
                if pixel is not None:
                    u, v = pixel + sigma_px * rng.standard_normal(2)
                    found.append(Measured(row["file"], name, float(u), float(v)))
        return found

    @cached_property
    def sensor(self) -> Sensor:
        return Rig.load(self.folder / "RIG.toml").sensors["camera"]

    def error(self, mounting: Mounting) -> np.ndarray:
        """(6,) against the simulator's own mounting: m, and rotation about the body's axes (rad)."""
        rotation, lever = mounting.arrays()
        mount = YARD.camera.mount
        true = Rotation.from_euler("ZYX", [mount.heading_deg, mount.pitch_deg, mount.roll_deg], degrees=True)
        turn = (Rotation.from_matrix(rotation) * true.inv()).as_rotvec()
        return np.concatenate([lever - mount.lever_arm_body_m, turn])


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    return Drive(simulate(YARD, tmp_path_factory.mktemp("yard") / "survey").folder)


WIDE = ((0.2, 0.2, 0.2), (0.05, 0.05, 0.05))


def found_by(drive: Drive, exposures: list[Exposure], targets: list[Target], measured: list[Measured], sigma_px: float):
    prior = Prior(drive.sensor.mounting(), *WIDE)
    return resect("camera", drive.sensor.interior, prior, exposures, targets, measured, sigma_px)


@pytest.mark.slow
def test_exact_measurements_give_the_true_mounting(drive: Drive):
    rng = np.random.default_rng(1)
    measured = drive.measured(rng, 0.0)
    assert len(measured) >= 16
    assert np.abs(drive.error(drive.sensor.mounting())[3:]).max() > np.radians(0.8)
    found = found_by(drive, drive.exposures(rng), drive.control(), measured, 0.1)
    assert np.abs(drive.error(found.mounting)).max() < 2e-5
    assert found.rms_px < 0.01
    assert found.outliers == found.found.not_determined == ()


@pytest.mark.slow
def test_errors_are_as_large_as_their_covariance_says(drive: Drive):
    """Errors of poses, of control points and of measurements; 15 seeds, mean of six between its 99.9 % limits."""
    normalised = []
    for seed in range(15):
        rng = np.random.default_rng(seed)
        exposures, targets = drive.exposures(rng, 0.008, 0.02), drive.control(0.004, rng)
        found = found_by(drive, exposures, targets, drive.measured(rng, 0.3), 0.3)
        error = drive.error(found.mounting)
        normalised.append(error @ np.linalg.solve(found.found.covariance, error))
        assert found.found.sigma[:3].max() < 0.05
    low, high = chi2.ppf([0.0005, 0.9995], 6 * 15) / 15
    assert low < np.mean(normalised) < high, np.mean(normalised)


@pytest.mark.slow
def test_wrong_measurements_are_named(drive: Drive):
    rng = np.random.default_rng(2)
    measured = drive.measured(rng, 0.3)
    first = measured[0].picture
    swapped = {"T0": "T1", "T1": "T0"}
    wrong = [replace(m, point=swapped.get(m.point, m.point)) if m.picture == first else m for m in measured]
    wrong[9] = replace(wrong[9], u_px=wrong[9].u_px + 60.0)
    wrong[12] = replace(wrong[12], v_px=wrong[12].v_px - 5.0)
    found = found_by(drive, drive.exposures(rng), drive.control(), wrong, 0.3)
    named = {(r.measured.picture, r.measured.point) for r in found.outliers}
    expected = {(first, "T0"), (first, "T1")} | {(wrong[k].picture, wrong[k].point) for k in (9, 12)}
    assert named == expected
    assert np.abs(drive.error(found.mounting)[3:]).max() < np.radians(0.1)
    assert found.rms_px < 0.6


@pytest.mark.slow
def test_a_rig_file_that_knows_no_mounting(drive: Drive):
    """The rig file's axes are wrong by a right angle: one picture by itself is the start."""
    rng = np.random.default_rng(3)
    sideways = Sensor(kind="camera", lever_arm_body_m=(0.0, 0.0, 0.0), boresight={"heading_deg": 90.0}).mounting()
    found = resect(
        "camera", drive.sensor.interior, Prior(sideways, *WIDE), drive.exposures(rng), drive.control(),
        drive.measured(rng, 0.2), 0.2,
    )  # fmt: skip
    assert "by itself" in found.start
    assert "from the rig file's mounting, which was not used" in found.start
    error = drive.error(found.mounting)
    assert np.abs(error[:3]).max() < 0.05
    assert np.abs(error[3:]).max() < np.radians(0.3)


@pytest.mark.slow
def test_one_point_does_not_determine_a_mounting(drive: Drive):
    rng = np.random.default_rng(4)
    only = [m for m in drive.measured(rng, 0.2) if m.point == "T1"]
    found = found_by(drive, drive.exposures(rng), drive.control(), only, 0.2)
    assert len(only) >= 3
    assert len(found.found.not_determined) >= 2
    assert any("'camera'" in words for words in found.found.not_determined)
    assert np.abs(drive.error(found.mounting)).max() < 0.25, "what is not determined stays near the rig file's"


@pytest.mark.slow
def test_targets_measured_in_the_simulated_pictures(drive: Drive):
    """Centres of the dark discs as they appear in the pictures, by their grey values."""
    rng = np.random.default_rng(5)
    measured = []
    for row in drive.rows:
        picture = cv2.imread(str(drive.folder / "raw" / "run-1" / "camera" / row["file"]), cv2.IMREAD_GRAYSCALE)
        for name, place in drive.targets_m.items():
            expected = drive.pixel(row, place)
            if expected is None or np.linalg.norm(place - drive.pose(row)[0]) > 16.0:
                continue
            # As an operator would: the dark disc inside the white one, by its grey values.
            u, v = np.rint(expected).astype(int)
            _, label, _, _ = cv2.connectedComponentsWithStats((picture < 130).astype(np.uint8), connectivity=4)
            disc = cv2.dilate((label == label[v, u]).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
            assert 20 < disc.sum() < 2_000
            dark = np.where(disc, np.clip(180.0 - picture, 0.0, None), 0.0)
            rows, columns = np.indices(picture.shape)
            centre = (dark * columns).sum() / dark.sum(), (dark * rows).sum() / dark.sum()
            measured.append(Measured(row["file"], name, *centre))
    assert len(measured) >= 6
    found = found_by(drive, drive.exposures(rng), drive.control(), measured, 0.3)
    error = drive.error(found.mounting)
    assert found.outliers == ()
    assert found.rms_px < 0.4
    assert np.abs(error[:3]).max() < 0.02
    assert np.degrees(np.abs(error[3:]).max()) < 0.15
    assert error @ np.linalg.solve(found.found.covariance, error) < 22.5


@pytest.mark.slow
def test_measurements_that_cannot_be_used_are_refused(drive: Drive):
    rng = np.random.default_rng(6)
    measured = drive.measured(rng, 0.2)
    one = measured[0]

    def refused(words: str, *listed: Measured) -> None:
        with pytest.raises(ConfigError, match=words):
            found_by(drive, drive.exposures(rng), drive.control(), list(listed), 0.2)

    refused("no picture of the survey with a pose .did you mean '00000", *measured, replace(one, picture="00000.jpg"))
    refused("no control point of the survey", *measured, replace(one, point="T77"))
    refused(r"measured at \(960, 3\)", *measured, replace(one, u_px=960.0, v_px=3.0))
    refused("T0 is measured twice in 000000.jpg", *measured, one)
    refused("2 measurements", *measured[:2])
    elsewhere = [replace(m, u_px=float(u), v_px=float(v)) for m, u, v in zip(
        measured[:3], (10, 950, 10), (590, 590, 400), strict=True)]  # fmt: skip
    refused("agree with one mounting", *elsewhere)


@pytest.mark.slow
def test_a_distortion_without_inverse_is_refused(drive: Drive):
    rng = np.random.default_rng(7)
    folding = drive.sensor.interior.model_copy(update={"distortion": (-1.5, 0.0, 0.0, 0.0, 0.0)})
    with pytest.raises(ConfigError, match="folds the picture over"):
        resect(
            "camera", folding, Prior(drive.sensor.mounting(), *WIDE), drive.exposures(rng), drive.control(),
            [*drive.measured(rng, 0.2), Measured("000001.jpg", "T0", 5.0, 5.0)][-4:], 0.2,
        )  # fmt: skip


@pytest.mark.slow
def test_projection_in_sensor_axes(drive: Drive):
    """Against the test's own projection, and there and back."""
    row = drive.rows[1]
    camera = Rotation.from_quat([row[f"q{a}"] for a in "xyzw"])
    places = {n: p for n, p in drive.targets_m.items() if drive.pixel(row, p) is not None}
    sensor = camera.inv().apply(np.array(list(places.values())) - [row[f"{a}_world_m"] for a in "xyz"])
    pixel = project(drive.sensor.interior, sensor)
    np.testing.assert_allclose(pixel, [drive.pixel(row, p) for p in places.values()], atol=1e-6)
    np.testing.assert_allclose(tangents(drive.sensor.interior, pixel), sensor[:, 1:] / sensor[:, :1], atol=1e-8)
    assert np.isnan(project(drive.sensor.interior, np.array([[-5.0, 0.0, 0.0]]))).all()
