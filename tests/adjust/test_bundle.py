"""Pictures in the adjustment: 60 pictures of places of known truth, with poses, mounting and lens that are off."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from roadscan.adjust.adjustment import Adjustment, adjust
from roadscan.adjust.bundle.measurements import Measurements, Numbers, State, met_at, residuals_px, rows_of, seen
from roadscan.adjust.bundle.outcome import FreeCameras, free_cameras
from roadscan.adjust.bundle.solve import Approached, PictureEvidence, approached, state_of
from roadscan.adjust.observations import CAMERA, CameraPrior, GaussMarkov, MountingPrior, Observations, RunPrior
from roadscan.adjust.settings import AdjustmentSettings
from roadscan.core.crs import LOCAL_WORLD
from roadscan.core.frames import ENU_FROM_NED
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.rig import Interior, Sensor
from roadscan.pictures.exposures import Camera, Exposures
from roadscan.pictures.lens import Lens, pixels_of
from roadscan.poses.trajectory import Corrections

Float64 = npt.NDArray[np.float64]

LENS = Interior(
    width_px=1024, height_px=640, focal_px=(784.0, 784.0), principal_px=(512.0, 320.0),
    distortion=(-0.11, 0.024, 0.0004, -0.0003, 0.0),
)  # fmt: skip
RIG = Sensor(kind="camera", axes="frd", interior=LENS)
OPENCV = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Forward, right, down from OpenCV's axes."""
FIRST_NS, STEP_NS = 1_400_000_000 * NS_PER_S, 100_000_000
NOISE_PX = 0.25
TAU_S = 10.0
"""Correlation time of the errors of the poses."""
BORESIGHT_RAD = np.radians([0.12, -0.2, 0.22])
"""By which the camera is turned beyond its stated mounting, about the axes of the body: 0.32° in all."""
LEVER_M = np.array([1.2, -0.15, -1.1])


@dataclass(frozen=True)
class Drive:
    """A drive of 60 pictures, 1 m apart, on a curve."""

    evidence: PictureEvidence
    prior: RunPrior
    true_body_m: Float64
    true_turn: Float64
    control_m: Float64


def _path(count: int, late_s: float = 0.0) -> tuple[Float64, Float64]:
    """Places (n, 3), east-north-up, and attitudes (n, 3, 3) of the body, frd, on a circle of 120 m, at 10 m/s."""
    along = (np.arange(count, dtype=np.float64) + 10.0 * late_s) / 120.0
    place = np.stack([120.0 * np.sin(along), 120.0 * (1.0 - np.cos(along)), 1.6 + 0.02 * np.sin(3 * along)], axis=-1)
    heading = np.pi / 2 - along  # clockwise from north
    roll, pitch = 0.01 * np.sin(7.0 * along), 0.008 * np.cos(5.0 * along)
    turned = Rotation.from_euler("ZYX", np.stack([heading, pitch, roll], axis=-1)).as_matrix()
    return place, ENU_FROM_NED @ turned


@dataclass(frozen=True)
class Block:
    """What a drive has."""

    pictures: int = 60
    points: int = 400
    tau_s: float = TAU_S
    pose_sigma: tuple[float, ...] = (*[0.1] * 3, *np.radians([0.2] * 3).tolist())
    """East, north, up (m), roll, pitch, heading (rad)."""
    boresight_rad: tuple[float, ...] = tuple(BORESIGHT_RAD.tolist())


def simulated_drive(
    seed: int, false: float = 0.0, lens_error: Float64 | None = None, late_s: float = 0.0, survey_m: float = 0.0,
    block: Block = Block(),
) -> Drive:  # fmt: skip
    rng = np.random.default_rng(seed)
    n = block.pictures
    body, turned = _path(n)
    stated_body, stated_turned = _path(n, late_s)
    stated_axes = Rotation.from_euler("y", -12, degrees=True).as_matrix() @ OPENCV
    axes = Rotation.from_rotvec(block.boresight_rad).as_matrix() @ stated_axes
    points = np.concatenate([_around(rng, block.points), body[5::11] + turned[5::11] @ np.array([6.0, 2.0, 1.6])])
    control = len(points) - len(body[5::11])
    lens = LENS if lens_error is None else LENS.model_copy(update={"focal_px": (784.0 + lens_error[0],) * 2})
    picture, pixel, point = _measured(body, turned, axes, points, lens)
    pixel = pixel + NOISE_PX * rng.normal(size=pixel.shape)
    wrong = (rng.random(picture.size) < false) & (point < control)
    pixel[wrong] += rng.normal(size=(int(wrong.sum()), 2)) * [25.0, 8.0]
    keep = np.exp(-0.1 / block.tau_s)
    error = [rng.normal(size=6)]
    for _ in range(n - 1):
        error.append(keep * error[-1] + np.sqrt(1.0 - keep**2) * rng.normal(size=6))
    shift, turn = np.split(np.array(block.pose_sigma) * np.array(error), 2, axis=1)
    recorded = stated_turned @ Rotation.from_rotvec(turn).as_matrix()
    exposures = Exposures(
        (Camera("a", "left", "key", Path(), RIG, LENS, LOCAL_WORLD),), np.zeros(n, np.int64),
        FIRST_NS + STEP_NS * np.arange(n), np.array([f"{k}.png" for k in range(n)], dtype=object), stated_body + shift,
        recorded, np.gradient(stated_body, 0.1, axis=0), _rates(recorded), ENU_FROM_NED.T @ recorded,
        np.tile(LEVER_M, (n, 1)), np.tile(stated_axes, (n, 1, 1)),
    )  # fmt: skip
    surveyed = np.where((np.arange(len(points)) < control)[:, None], np.nan, points)
    surveyed += survey_m * np.random.default_rng([seed, 1]).normal(size=points.shape)
    measured = Measurements(
        exposures, picture, pixel, np.where(point < control, 0.5, NOISE_PX), point, surveyed,
        np.where(np.isnan(surveyed[:, :2]), np.nan, 0.005),
    )  # fmt: skip
    number = np.where(np.arange(len(points)) < control, -1, np.arange(len(points)) - control)
    enters = np.ones(point.size, bool)
    enters[np.isin(number[point], [1, 3])] = False  # check points
    sigma = np.zeros(len(CAMERA))
    sigma[:2], sigma[4] = 1.6, 0.002
    numbers = Numbers(*(np.zeros(1, np.int32) for _ in range(3)))
    evidence = PictureEvidence(measured, numbers, (CameraPrior("left", sigma),), number, enters, 0.0)
    processes = tuple(GaussMarkov(s, block.tau_s) for s in block.pose_sigma)
    prior = RunPrior("a", FIRST_NS - NS_PER_S, FIRST_NS + STEP_NS * n + NS_PER_S, processes)  # type: ignore[arg-type]
    return Drive(evidence, prior, body, turned, points[control:])


def _rates(turned: Float64) -> Float64:
    """Turning rates (n, 3) along the axes of the body (rad/s)."""
    steps = Rotation.from_matrix(turned[:-1].transpose(0, 2, 1) @ turned[1:]).as_rotvec() / 0.1
    return np.concatenate([steps, steps[-1:]])


def _around(rng: np.random.Generator, count: int) -> Float64:
    """Places beside the circle: road, walls, and what stands in front of them."""
    along, side = rng.uniform(-0.05, 0.75, count), rng.uniform(-9.0, 9.0, count)
    up = np.where(np.abs(side) > 6.0, rng.uniform(0.0, 7.0, count), rng.uniform(-0.05, 0.3, count))
    radius = 120.0 + side
    return np.stack([radius * np.sin(along), 120.0 - radius * np.cos(along), up], axis=-1)


def _measured(
    body: Float64, turned: Float64, axes: Float64, points: Float64, lens: Interior
) -> tuple[npt.NDArray[np.int64], Float64, npt.NDArray[np.int64]]:
    """Pixels of the points that each picture sees within 30 m."""
    pictures, pixels, numbers = [], [], []
    for k in range(len(body)):
        camera = (points - body[k] - turned[k] @ LEVER_M) @ (turned[k] @ axes)
        pixel = pixels_of(Lens.of(lens), np.where(camera[:, 2:] > 2.0, camera, np.nan))
        inside = (pixel > 5.0).all(axis=1) & (pixel < [1018.0, 634.0]).all(axis=1) & (camera[:, 2] < 30.0)
        pictures.append(np.full(int(inside.sum()), k))
        pixels.append(pixel[inside])
        numbers.append(np.flatnonzero(inside))
    picture, pixel, number = np.concatenate(pictures), np.concatenate(pixels), np.concatenate(numbers)
    kept = np.bincount(number, minlength=len(points))[number] >= 2
    return picture[kept].astype(np.int64), pixel[kept], number[kept].astype(np.int64)


MOUNTS = (MountingPrior("left", np.array([*[0.005] * 3, *np.radians([0.5] * 3), 0.0])),)


def _solved(drive: Drive) -> tuple[Adjustment, PictureEvidence]:
    found = _approached(drive)
    cameras = drive.evidence.cameras
    return adjust(found.rows.observations, (drive.prior,), AdjustmentSettings(), MOUNTS, cameras), found.pictures


def _approached(drive: Drive) -> Approached:
    return approached(drive.evidence, (Observations.none(), 0), (drive.prior,), AdjustmentSettings(), MOUNTS)


def _free(drive: Drive) -> FreeCameras:
    approach = _approached(drive)
    found = adjust(approach.rows.observations, (drive.prior,), AdjustmentSettings(), MOUNTS, drive.evidence.cameras)
    free = free_cameras(approach, found, AdjustmentSettings(), MOUNTS)
    assert free is not None
    return free


def _body_after(drive: Drive, state: State) -> tuple[Float64, Float64]:
    """Adjusted places and attitudes of the body at each exposure."""
    exposures = drive.evidence.measured.exposures
    shift, turn = state.corrections["a"].at(exposures.epoch_gps_ns)
    return (
        exposures.body_world_m + shift @ ENU_FROM_NED.T,
        exposures.world_from_body @ Rotation.from_rotvec(turn).as_matrix(),
    )


def test_rows_are_the_derivatives_of_residuals() -> None:
    drive = simulated_drive(0)
    measured, numbers = drive.evidence.measured, drive.evidence.numbers
    ends = np.array([drive.prior.first_gps_ns, drive.prior.last_gps_ns])
    place = met_at(measured, seen(measured, State(), numbers), np.ones(measured.point.size))

    def state(values: Float64) -> State:
        corrections = Corrections(ends, np.tile(values[:3], (2, 1)), np.tile(values[3:6], (2, 1)))
        return State({"a": corrections}, {0: np.append(values[6:12], 0.0)}, {0: values[12:]})

    about = np.concatenate([[0.03, -0.02, 0.05], [0.002, -0.003, 0.001], [0.01] * 3, [0.003] * 3, [1.0, -1.0, 2.0, 1.0],
                            [0.01, 0.01, 1e-3, 1e-3, 0.01, 2e-3, 1e-5]])  # fmt: skip
    first = np.arange(len(place))
    rows = rows_of(measured, seen(measured, state(about), numbers), numbers, place, first)
    own = rows.observations
    by = np.concatenate([own.partials[:, 0], own.mount_partials[:, 0, :6], own.camera_partials], axis=1)
    steps = [*[1e-4] * 3, *[1e-6] * 3] * 2 + [1e-2] * 4 + [1e-4] * 2 + [1e-5] * 2 + [1e-4, 1e-5, 1e-7]
    for k, step in enumerate(steps):
        ends_px = [
            residuals_px(measured, seen(measured, state(about + sign * step * np.eye(len(about))[k]), numbers), place)
            for sign in (1, -1)
        ]
        change = (ends_px[0] - ends_px[1])[rows.measurement[::2]].ravel() / rows.px_per_m / (2 * step)
        # A turn that follows another one of 3 mrad turns about axes that differ by as much.
        np.testing.assert_allclose(change, by[:, k], atol=6e-3 * np.abs(by[:, k]).max() + 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("false", [0.0, 0.3])
def test_poses_boresight_and_lens_come_back(false: float) -> None:
    drive = simulated_drive(3, false, np.array([1.5]))
    found, _ = _solved(drive)
    state = state_of(found)
    body, turned = _body_after(drive, state)
    assert np.abs(body - drive.true_body_m).max() < 0.03
    # Over 20 m, which is what a picture sees.
    way = np.linalg.norm((body[20:] - body[:-20]) - (drive.true_body_m[20:] - drive.true_body_m[:-20]), axis=1)
    assert np.median(way) < 0.01 and way.max() < 0.025
    looks = Rotation.from_matrix(turned.transpose(0, 2, 1) @ drive.true_turn)
    # The attitude of the camera is what is determined: that of the body and the boresight share a constant.
    whole = Rotation.from_rotvec(state.mountings[0][3:6]).inv() * looks * Rotation.from_rotvec(BORESIGHT_RAD)
    assert np.degrees(whole.magnitude()).max() < 0.08
    assert abs(state.cameras[0][0] - 1.5) < 3.0 * found.cameras.sigma[0, 0]


@pytest.mark.slow
def test_stated_sigma_holds_and_residuals_are_those_of_the_noise() -> None:
    errors = []
    for seed in range(4):
        drive = simulated_drive(seed + 10)
        found, pictures = _solved(drive)
        body, _ = _body_after(drive, state_of(found))
        sigma = found.sigma[0]
        epochs = drive.evidence.measured.exposures.epoch_gps_ns
        own = np.stack([np.interp(epochs, found.epochs_gps_ns[0], sigma[:, k]) for k in range(3)], axis=-1)
        errors.append(((body - drive.true_body_m) @ ENU_FROM_NED / own)[::10])
        tie = pictures.measured.is_tie
        assert np.median(pictures.measured.sigma_px[tie]) == pytest.approx(NOISE_PX, rel=0.1)
    # σ holds a common offset of the control as well, which these draws do not have.
    assert 0.4 < np.sqrt(np.mean(np.concatenate(errors) ** 2)) < 1.5


@pytest.mark.slow
def test_attitude_and_boresight_are_known_together_far_better_than_each() -> None:
    """The camera's attitude by the joint covariance: errors over σ; and its σ over those of independent errors."""
    normalised, shares = [], []
    for seed in range(20, 28):
        drive = simulated_drive(seed, survey_m=0.005)
        found, _ = _solved(drive)
        state = state_of(found)
        _, turned = _body_after(drive, state)
        (joint,) = found.cameras.joint
        assert (joint.run, joint.sensor) == ("a", "left")
        assert (np.diff(joint.epochs_gps_ns)[:-1] >= NS_PER_S / 2).all()  # and the last one at which there is a picture
        sums = joint.covariance[:, 3:6, 3:6] + joint.covariance[:, 9:12, 9:12]
        alone = np.einsum("kii->ki", sums).copy()
        sums += joint.covariance[:, 3:6, 9:12] + joint.covariance[:, 9:12, 3:6]
        variance = np.einsum("kii->ki", sums)
        pictures = np.rint((joint.epochs_gps_ns - FIRST_NS) / STEP_NS).astype(int)
        inside = (pictures >= 0) & (pictures < len(turned))
        off = Rotation.from_matrix(drive.true_turn.transpose(0, 2, 1) @ turned)[pictures[inside]].as_rotvec()
        off += state.mountings[0][3:6] - BORESIGHT_RAD
        normalised.append(off / np.sqrt(variance[inside]))
        shares.append(np.sqrt(variance / alone))
        seated = np.einsum("kii->ki", joint.covariance)[0, 6:12] / found.mountings.sigma[0, :6] ** 2
        assert np.abs(seated[[0, 1, 3, 4, 5]] - 1.0).max() < 1e-9  # the height of a single sensor is the poses' own
    assert 0.7 < np.sqrt(np.mean(np.concatenate(normalised) ** 2)) < 1.4
    assert np.median(np.concatenate(shares)) < 0.2


@pytest.mark.slow
def test_the_order_of_measurements_changes_no_bit() -> None:
    drive = simulated_drive(5)
    order = np.random.default_rng(0).permutation(drive.evidence.measured.point.size)
    other = replace(drive.evidence, measured=drive.evidence.measured.at(order), enters=drive.evidence.enters[order])
    one, two = _solved(drive)[0], _solved(replace(drive, evidence=other))[0]
    np.testing.assert_allclose(one.values[0], two.values[0], atol=1e-9)


@pytest.mark.slow
def test_a_right_camera_is_not_told_to_be_wrong() -> None:
    for seed in range(3):
        free = _free(simulated_drive(seed))
        assert [free.off(0, name)[0] for name in ("focal_x_px", "focal_y_px", "k1", "clock_s")] == [0.0] * 4


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.1, 0.03, -0.03])
def test_a_focal_length_that_is_wrong_is_found(share: float) -> None:
    error, sigma = _free(simulated_drive(3, lens_error=np.array([share * 784.0]))).off(0, "focal_x_px")
    assert abs(error - share * 784.0) < 4.0 * sigma and sigma < 0.01 * 784.0


@pytest.mark.slow
@pytest.mark.parametrize("late_s", [0.1, -0.1])
def test_stamps_of_the_pictures_beside_are_found(late_s: float) -> None:
    error, sigma = _free(simulated_drive(3, late_s=late_s)).off(0, "clock_s")
    # Steps as long as a picture are not linear: the size is right to a third.
    assert error == pytest.approx(-late_s, rel=0.33) and sigma < 0.01
