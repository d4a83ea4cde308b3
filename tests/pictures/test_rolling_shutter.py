"""A rolling shutter at 100 km/h: the adjustment and the views of a simulated survey, held against true points."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation, Slerp

from roadscan.adjust.tasks.outcome import ADJUSTMENT, SOLUTION
from roadscan.core.survey import Survey
from roadscan.georeference.plan.plan import plan_without_readings
from roadscan.pictures.kernels.lens import take_better
from roadscan.pictures.lens import eye_shifts_m, pixels_of, rays_of
from roadscan.pictures.placed import Pictures, plan_pictures
from roadscan.pictures.views import PictureRule
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Reporter, Session
from roadscan.run.stage import stages
from roadscan.simulate import Scene, simulate, truth
from roadscan.store.manifest import Manifest
from roadscan.store.store import Store
from roadscan.survey.run import run_stages
from tests.simulate.test_simulate_photogrammetry import STREET
from tests.simulate.test_simulate_photogrammetry import Survey as Simulated

FAST = {"speed_m_per_s": 27.8}
LINE_US = 40.0
FLAT = [(8.0, -1.3, "gcp"), (16.0, 2.4, "check"), (22.0, -2.4, "check"), (26.0, 0.9, "gcp"), (34.0, -1.2, "gcp")]
UPRIGHT = [(14.0, 5.4, 1.6, "check"), (28.0, -5.2, 1.9, "gcp"), (36.0, 5.4, 2.2, "check"), (40.0, -5.4, 1.5, "gcp")]
NO_ERROR = {"lever_arm_body_m": [0.0] * 3, "roll_deg": 0.0, "pitch_deg": 0.0, "heading_deg": 0.0}
SCENE = STREET.changed(
    length_m=28.0, passes=[{"lane": 2, **FAST}], vehicle=FAST, lidar={"on": False},
    road={
        "targets": [
            {"station_m": s, "offset_m": o, "diameter_m": 0.6, "name": f"T{k}", "role": r}
            for k, (s, o, r) in enumerate(FLAT)
        ]
    },
    roadside={
        "targets": [
            {"station_m": s, "offset_m": o, "height_m": h, "size_m": 0.8, "name": f"P{k}", "role": r}
            for k, (s, o, h, r) in enumerate(UPRIGHT)
        ],
        "trees": [], "moving_cars": [],
    },
    camera={
        "width_px": 640, "height_px": 400, "focal_px": 490.0, "principal_px": (322.0, 198.2), "every_m": 2.0,
        "line_time_us": LINE_US, "stamped_row": "middle", "lens_error": {"focal_px": 0.0, "principal_px": (0.0, 0.0)},
        "mount": {"error": NO_ERROR},
    },
)  # fmt: skip
NOISE_PX = 0.05
FARTHEST_M = 30.0


def _true_pixels(survey: Simulated) -> pd.DataFrame:
    """Where each picture shows each control point: by the simulator's true trajectory, at the time of the row."""
    told, body = survey.told(), pq.read_table(truth.load(survey.folder).trajectory_file("run-1")).to_pandas()
    first_ns, origin = body.epoch_gps_ns.iloc[0], body[[f"{a}_world_m" for a in "xyz"]].iloc[0].to_numpy()
    time_s = 1e-9 * (body.epoch_gps_ns - first_ns).to_numpy()
    way = body[[f"{a}_world_m" for a in "xyz"]].to_numpy() - origin
    turns = Slerp(time_s, Rotation.from_quat(body[["qx", "qy", "qz", "qw"]]))
    seat = Rotation.from_euler("ZYX", [told["mount"][f"{k}_deg"] for k in ("heading", "pitch", "roll")], degrees=True)
    found = []
    for row in survey.rows():
        for name, mark in survey.marks().items():
            pixel = np.array([0.0, told["stamped_row_px"]])
            for _ in range(9):
                late_s = 1e-6 * (pixel[1] - told["stamped_row_px"]) * told["line_time_us"]
                at_s = 1e-9 * (row["epoch_gps_ns"] - first_ns) + late_s
                turned = turns(np.clip(at_s, time_s[0], time_s[-1]))
                place = origin + np.array([np.interp(at_s, time_s, own) for own in way.T])
                rotation = (turned * seat).as_matrix()[:, [1, 2, 0]].T
                eye = place + turned.apply(told["mount"]["lever_arm_body_m"])
                ahead = rotation @ (mark["ecef"] - eye)
                if not (1.5 < ahead[2] < FARTHEST_M and np.abs(ahead[:2] / ahead[2]).max() < 0.8):
                    break
                pixel = survey.project(rotation, eye, mark["ecef"])
            else:
                if (pixel > 3.0).all() and (pixel < [told["width_px"] - 4, told["height_px"] - 4]).all():
                    found.append((row["file"], name, *pixel))
    return pd.DataFrame(found, columns=["picture", "point", "u_px", "v_px"])


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The survey with control measured in its pictures."""
    return _surveyed(SCENE, tmp_path_factory.mktemp("rolling") / "street")


def _surveyed(scene: Scene, where: Path) -> Path:
    folder = simulate(scene, where).folder
    rows = _true_pixels(Simulated(folder))
    rows[["u_px", "v_px"]] += NOISE_PX * np.random.default_rng(0).normal(size=(len(rows), 2))
    rows.to_csv(folder / "measured.csv", index=False)
    file = folder / "SURVEY.toml"
    log = '[[runs.logs]]\npath = "measured.csv"\nformat = "picture_points_csv"\nsensor = "camera"\n\n[picture_ties]\n\n'
    file.write_text(file.read_text().replace("[[passes]]", log + "[[passes]]", 1))
    assert tomllib.loads((folder / "RIG.toml").read_text())["sensors"]["camera"]["interior"]["line_time_us"] == LINE_US
    return folder


def _left_px(folder: Path) -> np.ndarray:
    """Residuals of check points (n,) after `roadscan run`."""
    survey = Survey.load(folder / "SURVEY.toml")
    run_stages(Session(survey, Store(survey.store_url, survey.config.id), Inline(), None, Reporter()), stages())
    rows = pq.read_table(next(folder.glob("store/*/tables/picture_residuals/*.parquet"))).to_pandas()
    check = rows[rows.point.notna() & rows.weight.isna()]
    return np.hypot(check.after_u_px, check.after_v_px).to_numpy()


def _placed(folder: Path) -> Pictures:
    survey = Survey.load(folder / "SURVEY.toml")
    plan = plan_without_readings(survey, Store(survey.store_url, survey.config.id))
    return plan_pictures(plan, PictureRule((), 50.0, -90.0, 1))


@pytest.mark.slow
def test_check_points_and_views_fit_by_their_rows(street: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(street, tmp_path / "right")
    left = _left_px(folder)
    assert left.size >= 15 and np.sqrt(np.mean(left**2)) < 1.0
    pictures, marks = _placed(folder), Simulated(folder).marks()
    away, still, passed = [], [], []
    for row in pd.read_csv(folder / "measured.csv").itertuples():
        number, views = pictures.files.index(row.picture), pictures.views
        eye, turn, lens = views.eye_world_m[number], views.opencv_from_world[number], views.lens_of(number)
        in_camera, seen = (turn @ (marks[row.point]["ecef"] - eye))[None], np.array([[row.u_px, row.v_px]])
        away.append(float(np.linalg.norm(pixels_of(lens, in_camera) - seen)))
        still.append(float(np.linalg.norm(pixels_of(views.lenses[0], in_camera) - seen)))
        best, chosen, pixel = np.full(1, np.inf), np.full(1, -1, np.int32), np.full((1, 2), np.nan)
        limits, none = np.array([1e4, -1.0, 0.0]), np.zeros((0, 0), bool)
        up = views.up_world[number]
        take_better(in_camera @ turn + eye, eye, turn, up, lens.parameters, limits, none, 0, best, chosen, pixel)
        np.testing.assert_allclose(pixel, pixels_of(lens, in_camera), atol=0.01)
        # And back: the ray of the pixel, from where the camera was at its row.
        way = in_camera - eye_shifts_m(lens, pixel)
        passed.append(float(np.linalg.norm(np.cross(way, rays_of(lens, pixel)))))
    rms_px, still_px = (float(np.sqrt(np.mean(np.square(own)))) for own in (away, still))
    assert rms_px < 0.5 < 1.5 < still_px
    assert max(passed) < 1e-3


@pytest.mark.slow
def test_a_row_time_that_is_wrong_is_estimated(street: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(street, tmp_path / "wrong")
    rig = (folder / "RIG.toml").read_text()
    wrong = f"line_time_us = {1.1 * LINE_US}\nsigma_line_time_us = {0.1 * LINE_US}"
    (folder / "RIG.toml").write_text(rig.replace(f"line_time_us = {LINE_US}", wrong))
    left = _left_px(folder)
    assert np.sqrt(np.mean(left**2)) < 1.0


@pytest.mark.slow
def test_a_focal_length_that_is_3_percent_wrong_is_told(street: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(street, tmp_path / "lens")
    rig, stated = (folder / "RIG.toml").read_text(), "focal_px = [490.0, 490.0]"
    assert stated in rig
    (folder / "RIG.toml").write_text(rig.replace(stated, f"focal_px = [{1.03 * 490.0}, {1.03 * 490.0}]"))
    _left_px(folder)
    record = Manifest(Store(Survey.load(folder / "SURVEY.toml").store_url, "street_with_cameras")).get(
        ADJUSTMENT, SOLUTION
    )
    assert record is not None
    found = [one["text"] for one in record.figures()["findings"] if one["witness"] == "picture_lens"]
    assert len(found) == 1 and "focal length -1" in found[0]


@pytest.mark.nightly
def test_traffic_that_fills_half_of_the_pictures_is_judged(tmp_path: Path) -> None:
    """A lorry ahead and one beside it, nearly as fast as the survey vehicle: they look as if they stood far away."""
    lorry = {"length_m": 8.0, "width_m": 2.5, "height_m": 3.2}
    cars = [
        {"station_m": 8.0, "offset_m": 1.6, "speed_m_per_s": 27.0, **lorry},
        {"station_m": 10.0, "offset_m": -1.6, "speed_m_per_s": 29.0, **lorry},
    ]
    left = _left_px(_surveyed(SCENE.changed(roadside={"moving_cars": cars}), tmp_path / "traffic"))
    assert np.sqrt(np.mean(left**2)) < 1.0
