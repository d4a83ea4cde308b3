"""The camera's jobs: from pictures and a survey to the rig file."""

from __future__ import annotations

import csv
import datetime as dt
import shutil
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from roadscan.calibrate.chessboard import Board
from roadscan.calibrate.tasks.camera import calibrate_interior, resect_camera
from roadscan.core.errors import ConfigError, FormatError, RunError
from roadscan.core.rig import Rig
from roadscan.core.survey import Survey
from roadscan.ingest.ingest import ingest
from roadscan.simulate import Scene, simulate, truth
from roadscan.store.store import Store

BOARD = Board(columns=8, rows=5, square_m=0.04)
FOCAL, PRINCIPAL = 450.0, (330.0, 236.0)
RIG = """# the van
[sensors.camera]
kind = "camera" # front
lever_arm_body_m = [0.9, 0.0, -1.0]

[sensors.imu]
kind = "imu"
"""


def flat_picture(turn: tuple[float, float, float], middle: tuple[float, float, float]) -> np.ndarray:
    """A board of squares of 60 px, brought into the picture by its homography: no distortion."""
    squares = np.indices((BOARD.rows + 1, BOARD.columns + 1)).sum(axis=0) % 2
    sheet = cv2.copyMakeBorder(
        (squares * 170 + 45).astype(np.uint8).repeat(60, 0).repeat(60, 1),
        60,
        60,
        60,
        60,
        cv2.BORDER_CONSTANT,
        value=215,
    )
    # Sheet pixels, counted from their centres, to metres from the board's middle.
    m = BOARD.square_m / 60
    height, width = sheet.shape
    to_board = np.array([[m, 0, -m * (width - 1) / 2], [0, m, -m * (height - 1) / 2], [0, 0, 1.0]])
    rotation = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
    pose = np.column_stack([rotation[:, :2], middle])
    camera = np.array([[FOCAL, 0, PRINCIPAL[0]], [0, FOCAL, PRINCIPAL[1]], [0, 0, 1.0]])
    big = np.array([[2.0, 0, 0.5], [0, 2.0, 0.5], [0, 0, 1.0]])
    fine = cv2.warpPerspective(
        sheet, big @ camera @ pose @ to_board, (1280, 960), flags=cv2.INTER_AREA, borderValue=120
    )
    return cv2.resize(fine, (640, 480), interpolation=cv2.INTER_AREA)


@pytest.fixture
def bench(tmp_path: Path) -> Path:
    """A folder of pictures, a stray file, and a rig file beside it."""
    folder = tmp_path / "pictures"
    folder.mkdir()
    views = [
        ((0, 0, 3), (0.0, 0.0, 0.55)), ((30, 0, 8), (-0.1, -0.05, 0.6)), ((-30, 6, -8), (0.12, 0.07, 0.6)),
        ((5, 32, 4), (0.13, -0.08, 0.55)), ((-5, -32, 14), (-0.13, 0.08, 0.6)), ((24, 22, 75), (0.02, 0.0, 0.65)),
        ((-22, 24, 22), (-0.08, 0.02, 0.5)), ((20, -26, -30), (0.03, -0.06, 0.7)),
    ]  # fmt: skip
    for k, view in enumerate(views):
        cv2.imwrite(str(folder / f"{k}.png"), flat_picture(*view))
    (folder / "notes.txt").write_text("not a picture")
    (folder / "torn.jpg").write_bytes(b"\xff\xd8\xff\xe0 torn")
    (tmp_path / "RIG.toml").write_text(RIG)
    return tmp_path


@pytest.mark.slow
def test_the_interior_orientation_goes_into_the_rig_file(bench: Path):
    rig_file = bench / "RIG.toml"
    looked = calibrate_interior(bench / "pictures", BOARD, rig_file, "camera", write=False)
    assert rig_file.read_text() == RIG
    report = calibrate_interior(bench / "pictures", BOARD, rig_file, "camera", date=dt.date(2026, 3, 2))
    assert [r.name for r in report.rejected] == ["torn.jpg"]
    text = rig_file.read_text()
    assert text.startswith(RIG[: RIG.index("\n[sensors.imu]")])
    assert text.endswith('\n[sensors.imu]\nkind = "imu"\n')
    interior = Rig.load(rig_file).sensors["camera"].interior
    assert interior is not None
    assert (interior.width_px, interior.height_px, interior.date) == (640, 480, dt.date(2026, 3, 2))
    assert interior.pictures == 8
    assert interior.focal_px == pytest.approx(looked.interior.focal_px, abs=1e-4)
    assert interior.focal_px == pytest.approx((FOCAL, FOCAL), abs=1.0)
    assert interior.principal_px == pytest.approx(PRINCIPAL, abs=1.0)
    files = sorted((bench / "pictures").glob("*.png"), reverse=True)
    listed = calibrate_interior(files, BOARD, rig_file, "camera", date=dt.date(2026, 3, 2))
    assert listed.interior.focal_px == pytest.approx(interior.focal_px, abs=0.01)


def test_what_cannot_be_calibrated(bench: Path):
    rig_file = bench / "RIG.toml"
    with pytest.raises(ConfigError, match="did you mean 'camera'"):
        calibrate_interior(bench / "pictures", BOARD, rig_file, "kamera")
    with pytest.raises(ConfigError, match="is of kind imu"):
        calibrate_interior(bench / "pictures", BOARD, rig_file, "imu")
    with pytest.raises(ConfigError, match="does not exist"):
        calibrate_interior([bench / "pictures" / "nothing.png"], BOARD, rig_file, "camera")
    with pytest.raises(ConfigError, match="no pictures"):
        calibrate_interior(bench, BOARD, rig_file, "camera")
    assert rig_file.read_text() == RIG


OFF = {"on": False}
SCENE = Scene.load("calibration_yard").changed(
    passes=[{"route": {"station_m": 14.0, "offset_m": -1.0, "heading_deg": 4.0, "pieces": [{"length_m": 18.0}]}}],
    profilers=OFF | {"head_imus": None}, lidar=OFF, sick=OFF, imu=OFF, gnss=OFF, encoder=OFF,
    vehicle={"standstill_s": 0.0},
    roadside={"boxes": [], "facades": [], "poles": []},
    camera={
        "every_m": 6.0, "width_px": 320, "height_px": 200, "focal_px": 273.0,
        "distortion": (-0.12, 0.03, 0.0, 0.0, 0.0),
        "mount": {"error": {"lever_arm_body_m": (0.04, -0.03, 0.05), "pitch_deg": 0.9, "heading_deg": -1.1}},
    },
    noise={"control_m": 0.0, "position_m": 0.0, "attitude_deg": 0.0},
)  # fmt: skip


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A survey with pictures, ingested, and measurements of its points as a simulated operator makes them."""
    folder = simulate(SCENE, tmp_path_factory.mktemp("camera-job") / "survey").folder
    survey = Survey.load(folder / "SURVEY.toml")
    ingest(survey, store_of(folder))
    known = truth.load(folder)
    to_world = pyproj.Transformer.from_crs(pyproj.CRS(SCENE.map.crs).to_3d(), "EPSG:4978", always_xy=True)
    rng = np.random.default_rng(1)
    with (folder / "measured.csv").open("w", newline="") as out:
        rows = csv.writer(out)
        rows.writerow(["picture", "point", "u_px", "v_px"])
        for picture in pq.read_table(known.camera_file("run-1")).to_pylist():
            camera = Rotation.from_quat([picture[f"q{a}"] for a in "xyzw"])
            for point in csv.DictReader((folder / "control.csv").read_text().splitlines()):
                enh = [float(point[c]) for c in ("easting_m", "northing_m", "height_m")]
                place = np.array(to_world.transform(*enh)) - [picture[f"{a}_world_m"] for a in "xyz"]
                ahead, right, down = camera.inv().apply(place)
                if ahead < 2.0 or max(abs(right), abs(down)) > ahead:
                    continue
                x, y = right / ahead, down / ahead
                radial = 1 - 0.12 * (x * x + y * y) + 0.03 * (x * x + y * y) ** 2
                u, v = 273.0 * radial * np.array([x, y]) + [159.5, 99.5] + 0.1 * rng.standard_normal(2)
                if 2 < u < 317 and 2 < v < 197:
                    rows.writerow([picture["file"], point["name"], f"{u:.3f}", f"{v:.3f}"])
    return folder


def store_of(folder: Path) -> Store:
    survey = Survey.load(folder / "SURVEY.toml")
    return Store(survey.store_url, survey.config.id)


@pytest.fixture
def folder(driven: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(driven, tmp_path / "survey"))


@pytest.mark.slow
def test_resection_writes_the_mounting(folder: Path):
    survey = Survey.load(folder / "SURVEY.toml")
    before = (folder / "RIG.toml").read_text()
    dry = resect_camera(survey, store_of(folder), "camera", folder / "measured.csv", 0.1, write=False)
    assert (folder / "RIG.toml").read_text() == before
    assert dry.rig_file is None
    report = resect_camera(survey, store_of(folder), "camera", folder / "measured.csv", 0.1)
    assert report.rig_file == folder / "RIG.toml"
    camera = Rig.load(folder / "RIG.toml").sensors["camera"]
    rotation, lever = camera.mounting().arrays()
    true_rotation, true_lever = Rig.load(folder / "truth" / "RIG.toml").sensors["camera"].mounting().arrays()
    found = report.resection.found
    error = np.concatenate([lever - true_lever, Rotation.from_matrix(rotation @ true_rotation.T).as_rotvec()])
    assert error @ np.linalg.solve(found.covariance, error) < 22.5  # 99.9 % of chi-squared with 6
    assert np.degrees(np.abs(error[3:]).max()) < 0.15
    assert np.abs(found.mounting.arrays()[0] - rotation).max() < 1e-9
    assert camera.lever_arm_sigma_m == pytest.approx(found.sigma[:3], abs=1e-6)
    assert camera.boresight_sigma_deg == pytest.approx(np.degrees(found.sigma[3:]), abs=1e-6)
    other = [line for line in before.splitlines() if not line.startswith(("lever_arm_body_m", "boresight"))]
    assert [line for line in (folder / "RIG.toml").read_text().splitlines() if line in other] == other
    # The two check points were held back, and fit.
    assert {c.measured.point for c in report.checks} == {"C005", "C006"}
    assert {r.measured.point for r in report.resection.residuals} == {"G001", "G002", "G003", "G004"}
    assert max(abs(c.du_px) + abs(c.dv_px) for c in report.checks) < 1.5
    # A second time gives the same: the σ just written are not taken for knowledge of their own.
    again = resect_camera(Survey.load(folder / "SURVEY.toml"), store_of(folder), "camera", folder / "measured.csv", 0.1)
    np.testing.assert_allclose(again.resection.found.sigma, found.sigma, rtol=0.02)


@pytest.mark.slow
def test_a_rotation_that_the_rig_file_states_whole_is_written_whole(folder: Path):
    rig_file = folder / "RIG.toml"
    rotation = Rig.load(rig_file).sensors["camera"].mounting().body_from_sensor
    lines = rig_file.read_text().splitlines()
    place = next(k for k, line in enumerate(lines) if line == "[sensors.camera]")
    lines.insert(place + 1, f"body_from_sensor = {[list(row) for row in rotation]} # sheet")
    rig_file.write_text("\n".join(lines))
    report = resect_camera(
        Survey.load(folder / "SURVEY.toml"), store_of(folder), "camera", folder / "measured.csv", 0.1
    )
    assert "boresight" not in report.values
    camera = Rig.load(rig_file).sensors["camera"]
    np.testing.assert_allclose(camera.body_from_sensor, report.resection.mounting.body_from_sensor, atol=1e-11)
    assert "# sheet" in rig_file.read_text()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lines", "error", "words"),
    [
        (["picture,point,u_px", "000000.jpg,G001,3"], FormatError, "no column v_px"),
        (["picture,point,u_px,v_px", "000000.jpg,G001,3,x"], FormatError, "cannot be read"),
        (["picture,point,u_px,v_px", "000000.jpg,G001,3,"], FormatError, "record 1: a coordinate is missing"),
        (["picture,point,u_px,v_px", "00000.jpg,G001,3,4"], FormatError, "record 1: the camera has no picture"),
        (["picture,point,u_px,v_px", *["000000.jpg,G009,3,4"] * 3], ConfigError, "no control point of the survey"),
    ],
)
def test_measurements_that_do_not_fit(driven: Path, tmp_path: Path, lines: list[str], error: type, words: str):
    file = tmp_path / "m.csv"
    file.write_text("\n".join(lines) + "\n")
    with pytest.raises(error, match=words):
        resect_camera(Survey.load(driven / "SURVEY.toml"), store_of(driven), "camera", file)


@pytest.mark.slow
def test_a_camera_without_interior_orientation_or_pictures(folder: Path):
    rig_file, survey_file = folder / "RIG.toml", folder / "SURVEY.toml"
    text = rig_file.read_text()
    rig_file.write_text(text[: text.index("[sensors.camera.interior]")])
    with pytest.raises(ConfigError, match="roadscan camera interior"):
        resect_camera(Survey.load(survey_file), store_of(folder), "camera", folder / "measured.csv")
    rig_file.write_text(text + text[text.index("[sensors.camera]") :].replace("sensors.camera", "sensors.rear"))
    with pytest.raises(RunError, match="'rear' has no pictures"):
        resect_camera(Survey.load(survey_file), store_of(folder), "rear", folder / "measured.csv")
    with pytest.raises(RunError, match="not in the store"):
        resect_camera(Survey.load(survey_file), Store(str(folder / "empty"), "x"), "camera", folder / "measured.csv")
