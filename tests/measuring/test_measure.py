"""Places of pixels, against the simulator's true poses and heights, projected by OpenCV and PROJ."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pyproj
import pytest
from typer.testing import CliRunner

import roadscan as rs
from roadscan.cli import app
from roadscan.core.errors import ConfigError
from roadscan.core.rig import Interior
from roadscan.core.survey import Survey
from roadscan.georeference.sources import MOUNTING_COLUMNS
from roadscan.measuring.kernels.march import BELOW, NO_GROUND, first_hits
from roadscan.measuring.measure import length_of, measure, meet
from roadscan.pictures.lens import COLUMNS, Lens, pixels_of, rays_of
from roadscan.run.session import Session
from roadscan.site.where import pictures_of_place
from roadscan.store.small_tables import write_small
from roadscan.store.store import Store
from tests.measuring.drive import MATRIX, Drive
from tests.surveys import changed

POSE_SIGMA = np.array([0.03, 0.02, 0.04, 8e-4, 6e-4, 1.5e-3])
LEVER_SIGMA, TURN_SIGMA_DEG = np.array([0.02, 0.015, 0.01]), (0.05, 0.04, 0.06)
LENS_SIGMA = np.array([1.5, 1.5, 1.0, 1.2, 0.004, 0.004, 2e-4, 2e-4, 0.002])
ALL_SIGMA = np.array([*POSE_SIGMA, *LEVER_SIGMA, *np.radians(TURN_SIGMA_DEG), *LENS_SIGMA])
PLACE_SIGMA = np.array([0.01, 0.01, 0.02])


def session(drive: Drive) -> Session:
    return Session.open(drive.survey_file)


def test_pixel_to_map_to_pixel_closes(measured_drive: Drive) -> None:
    u, v = np.meshgrid(np.linspace(10, 630, 9), np.linspace(30, 395, 9))
    pixels, own = np.column_stack([u.ravel(), v.ravel()]), session(measured_drive)
    worst, count = 0.0, 0
    for file in measured_drive.poses:
        places = [one for one in measure(own, file, pixels).places if not one.reason]
        back = measured_drive.pixels(file, np.array([one.place_m for one in places]))
        away = np.linalg.norm(back - [(one.u_px, one.v_px) for one in places], axis=1)
        worst, count = max(worst, float(np.nanmax(away))), count + len(places)
    assert count > 100 and worst < 0.05


def test_painted_corners_lie_where_they_are(measured_drive: Drive) -> None:
    own, corners = session(measured_drive), measured_drive.corners()
    errors = []
    for file in measured_drive.poses:
        pixel = measured_drive.pixels(file, corners)
        distance = np.linalg.norm(measured_drive.seen(file, corners), axis=1)
        seen = np.flatnonzero(np.isfinite(pixel).all(axis=1) & (distance < 11.0))
        for place, one in zip(corners[seen], measure(own, file, pixel[seen]).places, strict=True):
            assert not one.reason
            errors.append((np.hypot(*(one.place_m - place)[:2]), one.distance_m))
    horizontal, distance = np.array(errors).T
    assert len(errors) > 80 and distance.max() > 10.0
    assert np.sqrt(np.mean(horizontal**2)) < 0.005 and np.quantile(horizontal, 0.95) < 0.01


def disturbed(drive: Drive, rng: np.random.Generator, adjusted: bool) -> Session:
    """The survey with another mounting and lens, and with corrections of its poses that are wrong, each by its σ.

    adjusted : tables of an adjustment make mounting and lens wrong, at the expense of the poses as in a real one; the
    rig file states σ that are much larger.
    """
    survey = Survey.load(drive.survey_file)
    camera = survey.rig.sensors["camera"]
    rotation, lever = camera.mounting().arrays()
    alike = joint_correlation() if adjusted else np.eye(21)
    errors = ALL_SIGMA * rng.multivariate_normal(np.zeros(21), alike, method="cholesky")
    values, shift, turn, bend = np.split(errors, [6, 9, 12])
    about = np.array([[0, -turn[2], turn[1]], [turn[2], 0, -turn[0]], [-turn[1], turn[0], 0]])
    u, _, w = np.linalg.svd((np.eye(3) + about) @ rotation)
    interior = camera.interior
    lens = np.array([*interior.focal_px, *interior.principal_px, *interior.distortion]) + bend
    larger = 5.0 if adjusted else 1.0
    sigma = larger * LENS_SIGMA
    own = "rig__sensors__camera__"
    changes = {
        own + "lever_arm_sigma_m": tuple((larger * LEVER_SIGMA).tolist()),
        own + "boresight_sigma_deg": tuple((larger * np.array(TURN_SIGMA_DEG)).tolist()),
        own + "interior__sigma_focal_px": tuple(sigma[:2].tolist()),
        own + "interior__sigma_principal_px": tuple(sigma[2:4].tolist()),
        own + "interior__sigma_distortion": tuple(sigma[4:].tolist()),
    }
    store = drive.store()
    if adjusted:
        write_adjusted(store, np.concatenate([shift, turn]), bend)
        whole = alike * np.outer(ALL_SIGMA, ALL_SIGMA)
        known: dict[str, object] = {
            "run": "run-1",
            "sensor": "camera",
            "covariance": whole[np.triu_indices(21)].tolist(),
        }
        epochs = sorted(p["epoch_gps_ns"] for p in drive.poses.values())[::3]
        # One error of the poses for the whole drive: each hangs together with the next ones as with itself.
        later = [whole[:6, :6].ravel().tolist() * (len(epochs) - 1 - k) for k in range(len(epochs))]
        rows = [known | {"epoch_gps_ns": e, "later": one} for e, one in zip(epochs, later, strict=True)]
        write_small(store, "camera_covariances", rows)
    else:
        changes |= {
            own + "body_from_sensor": tuple(map(tuple, (u @ w).tolist())),
            own + "lever_arm_body_m": tuple((lever + shift).tolist()),
            own + "interior__focal_px": tuple(lens[:2].tolist()),
            own + "interior__principal_px": tuple(lens[2:4].tolist()),
            own + "interior__distortion": tuple(lens[4:].tolist()),
        }
    held = []
    for epoch in (min(p["epoch_gps_ns"] for p in drive.poses.values()) - 10**9,
                  max(p["epoch_gps_ns"] for p in drive.poses.values()) + 10**9):  # fmt: skip
        row: dict[str, object] = {"run": "run-1", "epoch_gps_ns": epoch}
        names = ("north_m", "east_m", "down_m", "roll_rad", "pitch_rad", "heading_rad")
        row |= dict(zip(names, values.tolist(), strict=True))
        row |= {f"sigma_{n}": s for n, s in zip(names, POSE_SIGMA.tolist(), strict=True)}
        held.append(row)
    write_small(store, "corrections", held)
    return Session(changed(survey, changes), store)


def joint_correlation() -> np.ndarray:
    """Attitude against boresight and position against lever arm, as pictures tell their sums; focal lengths alike."""
    found = np.eye(21)
    for one, other, value in ((0, 7, 0.8), (1, 6, 0.7), (2, 8, -0.95), (3, 9, -0.97), (4, 10, -0.97), (5, 11, -0.98),
                              (12, 13, 0.9), (14, 16, 0.3)):  # fmt: skip
        found[one, other] = found[other, one] = value
    return found


def write_adjusted(store: Store, mounting: np.ndarray, lens: np.ndarray) -> None:
    """What an adjustment leaves, with the errors given: the σ after it, and larger ones before."""
    held = {
        "mounting_corrections": (MOUNTING_COLUMNS, [*mounting, 0.0], [*LEVER_SIGMA, *np.radians(TURN_SIGMA_DEG), 0.0]),
        "camera_corrections": (COLUMNS, [*lens, 0.0, 0.0], [*LENS_SIGMA, 0.0, 0.0]),
    }
    for table, (names, values, sigma) in held.items():
        row: dict[str, object] = {"sensor": "camera"} | ({"run": "*"} if table.startswith("mounting") else {})
        for name, value, after in zip(names, values, sigma, strict=True):
            row |= {name: float(value), f"sigma_{name}": float(after), f"prior_sigma_{name}": 5.0 * float(after)}
        write_small(store, table, [row])


@pytest.mark.slow
@pytest.mark.parametrize("adjusted", [False, True], ids=["as the rig file states", "as an adjustment found"])
def test_stated_sigma_is_right_where_poses_mounting_and_lens_are_disturbed(
    measured_drive: Drive, tmp_path: Path, adjusted: bool
) -> None:
    drive = Drive(measured_drive.copy_with_store_to(tmp_path / "survey").survey_file)
    rms, squares, lengths, stereo, pixels = scored(drive, np.random.default_rng(38), 60, adjusted)
    assert (rms[:2] > 0.8).all() and (rms[:2] < 1.25).all()
    assert 0.8 < squares < 1.25 and 0.8 < lengths < 1.25 and 0.8 < stereo < 1.25 and 0.8 < pixels < 1.25


def scored(drive: Drive, rng: np.random.Generator, draws: int, adjusted: bool) -> tuple[np.ndarray, ...]:
    """Errors over their σ, RMS: by axis, of both horizontal ones, of lengths, of stereo, of predicted pixels."""
    files, corners = list(drive.poses)[:4], drive.corners()
    normalised, squares, lengths, stereo, predicted = [], [], [], [], []
    for _ in range(draws):
        own = disturbed(drive, rng, adjusted)
        for file in files[:3:2]:
            pixel = drive.pixels(file, corners)
            distance = np.linalg.norm(drive.seen(file, corners), axis=1)
            near = np.flatnonzero(np.isfinite(pixel).all(axis=1) & (distance < 11.0))
            seen = rng.choice(near, 3, replace=False)
            noisy = pixel[seen] + rng.normal(0.0, 0.5, (3, 2))
            found = measure(own, file, noisy)
            assert found.assumed == ""
            for place, one in zip(corners[seen], found.places, strict=True):
                error = one.place_m - place
                normalised.append(error / one.sigma_m)
                squares.append(error[:2] @ np.linalg.solve(one.covariance_m2[:2, :2], error[:2]) / 2)
            length, sigma = length_of(found.places)
            lengths.append((length - np.linalg.norm(np.diff(corners[seen], axis=0), axis=1).sum()) / sigma)
        pair = [drive.pixels(file, corners) for file in files[:2]]
        both = np.flatnonzero(np.isfinite(np.hstack(pair)).all(axis=1))
        one = int(rng.choice(both))
        pixels = tuple(p[one] + rng.normal(0.0, 0.5, 2) for p in pair)
        place, _ = meet(own, (files[0], files[1]), pixels)
        error = place.place_m - corners[one]
        stereo.append(error @ np.linalg.solve(place.covariance_m2, error) / 3)
        surveyed = rng.normal(corners[one], PLACE_SIGMA)
        for view in pictures_of_place(own, *surveyed, sigma_m=PLACE_SIGMA):
            if view.file.name in files[:2]:
                miss = np.array([view.u_px, view.v_px]) - pair[files.index(view.file.name)][one]
                predicted += (miss / [view.sigma_u_px, view.sigma_v_px]).tolist()
    assert len(predicted) > draws
    rms = np.sqrt(np.mean(np.array(normalised) ** 2, axis=0))
    return rms, *(np.sqrt(np.mean(a)) for a in (squares, np.square(lengths), stereo, np.square(predicted)))


def test_two_pictures_measure_what_stands_above_the_ground(measured_drive: Drive) -> None:
    first, second = list(measured_drive.poses)[:2]
    above = measured_drive.corners() + np.array([0.0, 0.0, 0.9])
    both = np.isfinite(np.hstack([measured_drive.pixels(file, above) for file in (first, second)])).all(axis=1)
    away = np.where(both, np.linalg.norm(measured_drive.seen(second, above), axis=1), np.inf)
    place = above[np.argmin(away)]
    pixels = [measured_drive.pixels(file, place)[0] for file in (first, second)]
    survey = rs.open_survey(measured_drive.survey_file)
    found = survey.met(first, pixels[0], second, pixels[1])
    assert np.abs(found[["easting_m", "northing_m", "height_m"]].to_numpy(float) - place).max() < 1e-4
    assert found["gap_m"] < 1e-4 and found["warning"] == ""
    radial = pixels[1] - MATRIX[:2, 2]  # pixels move so from picture to picture, as the camera drives ahead
    across = np.array([-radial[1], radial[0]]) / np.linalg.norm(radial)
    apart = survey.met(first, pixels[0], second, pixels[1] + 12.0 * across)
    assert "may not show the same thing" in apart["warning"]
    with pytest.raises(ConfigError, match="of one picture"):
        survey.met(first, pixels[0], first, pixels[1])
    with pytest.raises(ConfigError, match="do not meet"):
        survey.met(first, (10.0, 300.0), second, (630.0, 300.0))


def test_what_has_no_place_says_why(measured_drive: Drive) -> None:
    survey, file = rs.open_survey(measured_drive.survey_file), next(iter(measured_drive.poses))
    sky = survey.measured(file, [(320.0, 3.0)])
    assert "no surveyed ground within 60 m" in sky["reason"][0] and np.isnan(sky["easting_m"][0])
    with pytest.raises(ConfigError, match="outside run-1/camera/"):
        survey.measured(file, [(700.0, 3.0)])
    with pytest.raises(ConfigError, match="no picture with a pose is called"):
        survey.measured("0000xx.jpg", [(3.0, 3.0)])


def test_the_own_vehicle_is_no_ground(measured_drive: Drive) -> None:
    bonnet = ((100.0, 300.0), (540.0, 300.0), (540.0, 399.0), (100.0, 399.0))
    survey = changed(Survey.load(measured_drive.survey_file), {"rig__sensors__camera__own_vehicle_px": [bonnet]})
    file = next(iter(measured_drive.poses))
    on, beside = measure(Session(survey, measured_drive.store()), file, [(320.0, 350.0), (50.0, 350.0)]).places
    assert "own vehicle" in on.reason and not beside.reason


LENSES = (
    Interior(width_px=640, height_px=400, focal_px=(410.0, 405.0), principal_px=(322.0, 195.0),
             distortion=(-0.21, 0.06, 0.0015, -0.002, -0.01)),
    Interior(model="equirectangular", width_px=1600, height_px=800),
)  # fmt: skip


@pytest.mark.parametrize("interior", LENSES, ids=("perspective", "around"))
def test_rays_lead_back_to_their_pixels(interior: Interior) -> None:
    rng = np.random.default_rng(7)
    lens = Lens.of(interior)
    pixel = rng.uniform([0.0, 0.0], [interior.width_px - 1.0, interior.height_px - 1.0], (300, 2))
    ray = rays_of(lens, pixel)
    assert np.abs(np.linalg.norm(ray, axis=1) - 1.0).max() < 1e-12
    if interior.model == "perspective":
        (fx, fy), (cx, cy) = interior.focal_px, interior.principal_px
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        back = cv2.projectPoints(7.0 * ray, np.zeros(3), np.zeros(3), matrix, np.array(interior.distortion))[0]
        back = back.reshape(-1, 2)
    else:  # spherical trigonometry: the middle looks ahead, a quarter of the width is a right angle to the right
        longitude = (pixel[:, 0] - 799.5) * 360.0 / 1600.0
        assert np.allclose(np.degrees(np.arctan2(ray[:, 0], ray[:, 2])), longitude, atol=1e-9)
        assert np.allclose(np.degrees(np.arcsin(ray[:, 1])), (pixel[:, 1] - 399.5) * 180.0 / 800.0, atol=1e-9)
        back = pixel
    assert np.abs(back - pixel).max() < 1e-6 and np.abs(pixels_of(lens, 5.0 * ray) - pixel).max() < 1e-6


def test_the_first_ground_hides_what_is_behind() -> None:
    """A hill of 3 m with a valley behind it: rays meet its front; one into unknown ground below says so."""
    heights = np.zeros((40, 200))
    heights[:, 60:80] = 3.0
    heights[:, 150:] = np.nan
    corner, eye = np.array([0.0, -4.0]), np.array([1.0, 0.0, 2.0])
    way = np.array([[1.0, 0.0, -0.05], [1.0, 0.0, -0.5], [1.0, 0.0, 0.08], [1.0, 0.0, 0.3]])
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    found = np.empty(4)
    first_hits(heights, corner, 0.2, eye, way, np.array([60.0, 1.0, 0.1]), found)
    assert found[0] == pytest.approx(11.0 * np.hypot(1.0, 0.05), abs=0.15)
    assert found[1] == pytest.approx(np.hypot(4.0, 2.0), abs=0.01)
    assert found[2] == pytest.approx(11.0 * np.hypot(1.0, 0.08), abs=0.15)
    assert found[3] == NO_GROUND
    hole = np.zeros((40, 200))
    hole[:, 20:60] = np.nan  # the ray goes below the ground within the hole
    first_hits(hole, corner, 0.2, eye, way[1:2].copy(), np.array([60.0, 1.0, 0.1]), found)
    assert found[0] == BELOW


def test_a_line_in_a_picture_is_a_line_on_the_map(measured_drive: Drive, tmp_path: Path) -> None:
    file = list(measured_drive.poses)[1]
    corners = measured_drive.corners()
    pixel = measured_drive.pixels(file, corners)
    seen = np.flatnonzero(np.isfinite(pixel).all(axis=1))[:3]
    out = tmp_path / "line.geojson"
    pixels = [text for u, v in pixel[seen].tolist() for text in ("--pixel", f"{u},{v}")]
    told = CliRunner().invoke(
        app, ["where", "--survey", str(measured_drive.survey_file), "--picture", file, *pixels, "--out", str(out)]
    )
    assert told.exit_code == 0, told.output
    assert "3 of 3 places" in told.output and "mounting without σ" in told.output
    (feature,) = json.loads(out.read_text())["features"]
    back = pyproj.Transformer.from_crs("OGC:CRS84", measured_drive.known.scene.map.crs, always_xy=True)
    line = np.array(feature["geometry"]["coordinates"])
    places = np.column_stack([*back.transform(line[:, 0], line[:, 1]), line[:, 2]])
    assert np.abs(places - corners[seen]).max() < 0.02
    assert [v["sigma_easting_m"] > 0 for v in feature["properties"]["vertices"]] == [True] * 3
    wrong = CliRunner().invoke(app, ["where", "1", "2", "--survey", str(measured_drive.survey_file), "--pixel", "1,2"])
    assert wrong.exit_code != 0
