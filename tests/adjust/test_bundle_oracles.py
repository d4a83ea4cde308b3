"""Pictures in the adjustment against other programs: COLMAP's cameras, and GTSAM's solution of the same block.

GTSAM has a pose for each picture, free but for its prior, a place for each point and the lens; roadscan has corrections
of the run's poses in time, and no unknown place. With correlation times far below the time from picture to picture the
two are the same problem: the same pixels, weights, and σ of poses, control and lens.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from roadscan.adjust.adjustment import Adjustment, adjust
from roadscan.adjust.bundle.measurements import Rows, met_at, seen
from roadscan.adjust.bundle.solve import PictureEvidence, approached, state_of
from roadscan.adjust.observations import CAMERA, CameraPrior, MountingPrior, Observations
from roadscan.adjust.settings import AdjustmentSettings
from roadscan.core.frames import ENU_FROM_NED
from roadscan.core.rig import Interior
from roadscan.pictures.lens import Lens, pixels_of
from tests.adjust.test_bundle import LENS, Block, Drive, simulated_drive

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

WHERE = "of the extra dev: pip install pycolmap gtsam"
PICTURES = 12
SEEDS = (1, 2, 3)
MOUNT_SIGMA = np.array([0.02, 0.015, 0.0, *np.radians([0.2, 0.15, 0.2]), 0.0])
"""The height of a single sensor is that of the poses, so it is not estimated."""
MOUNTED = [0, 1, 3, 4, 5]
POSE_SIGMA = np.array([0.10, 0.10, 0.15, *np.radians([0.2, 0.15, 0.3])])
"""North, east, down (m); roll, pitch, heading (rad)."""
LENS_SIGMA = {"focal_x_px": 1.6, "focal_y_px": 1.6, "centre_x_px": 0.8, "centre_y_px": 0.8, "k1": 0.002}
HELD = 1e-7
"""σ of what GTSAM is to hold where roadscan does not estimate it: skew and the other terms of the distortion."""
HELD_M = 1e-4
"""The same of the height of the camera: far below the σ that it has."""
GTSAM_LENS = ("focal_x_px", "focal_y_px", "skew", "centre_x_px", "centre_y_px", "k1", "k2", "p1", "p2")


@pytest.mark.parametrize(
    ("model", "distortion"),
    [("PINHOLE", (0.0,) * 5), ("OPENCV", (-0.11, 0.024, 4e-4, -3e-4, 0.0)),
     ("FULL_OPENCV", (-0.21, 0.06, 0.0015, -0.002, -0.01))],
)  # fmt: skip
def test_points_fall_where_colmap_projects_them(
    model: str, distortion: tuple[float, float, float, float, float]
) -> None:
    colmap = pytest.importorskip("pycolmap", reason=WHERE)
    lens = Interior(width_px=1024, height_px=640, focal_px=(784.0, 781.0), principal_px=(515.2, 317.1),
                    distortion=distortion)  # fmt: skip
    numbers = {"PINHOLE": 0, "OPENCV": 4, "FULL_OPENCV": 5}[model]
    bent = [*distortion[:numbers], *([0.0] * 3 if model == "FULL_OPENCV" else [])]
    camera = colmap.Camera(model=model, width=1024, height=640, params=[784.0, 781.0, 515.2, 317.1, *bent])
    point = np.random.default_rng(0).uniform((-4.0, -2.0, 6.0), (4.0, 2.0, 30.0), (200, 3))
    np.testing.assert_allclose(pixels_of(Lens.of(lens), point), camera.img_from_cam(point), atol=1e-9)


def key(letter: str, number: int = 0) -> int:
    """GTSAM's name of an unknown: x a pose, p a point, m the mounting, l the lens."""
    import gtsam

    return int(gtsam.symbol(letter, number))


@dataclass(frozen=True)
class Solved:
    """Both solutions of one block of `PICTURES` pictures."""

    drive: Drive
    pictures: PictureEvidence
    rows: Rows
    ours: Adjustment
    place_m: Float64
    """(p, 3) of roadscan, where the rays of its solution meet."""
    values: Any
    marginals: Any

    def covariance(self, name: int) -> Float64:
        """GTSAM's covariance of an unknown."""
        return np.asarray(self.marginals.marginalCovariance(name))

    def pose_errors(self) -> tuple[Float64, Float64]:
        """GTSAM's corrections (k, 6) of the poses, and their σ, in roadscan's axes: north, east, down, body."""
        exposures, moved, sigma = self.pictures.measured.exposures, [], []
        for k in range(len(exposures)):
            found, covariance = self.values.atPose3(key("x", k)), self.covariance(key("x", k))
            turned = found.rotation().matrix()
            axes = ENU_FROM_NED.T @ turned
            shift = ENU_FROM_NED.T @ (found.translation() - exposures.body_world_m[k])
            turn = Rotation.from_matrix(exposures.world_from_body[k].T @ turned).as_rotvec()
            moved.append([*shift, *turn])
            sigma.append([*np.diag(axes @ covariance[3:, 3:] @ axes.T), *np.diag(covariance)[:3]])
        return np.array(moved), np.sqrt(sigma)

    def mounting_errors(self) -> tuple[Float64, Float64]:
        """GTSAM's corrections of lever arm (forward, right) and boresight, axes of the body, and their σ."""
        exposures, found = self.pictures.measured.exposures, self.values.atPose3(key("m"))
        covariance, axes = self.covariance(key("m")), found.rotation().matrix()
        turn = Rotation.from_matrix(axes @ exposures.body_from_opencv[0].T).as_rotvec()
        shift = found.translation() - exposures.lever_body_m[0]
        variance = [np.diag(axes @ covariance[own, own] @ axes.T) for own in (slice(3, 6), slice(3))]
        return np.concatenate([shift, turn])[MOUNTED], np.sqrt(np.concatenate(variance))[MOUNTED]

    def joint_covariance(self, pictures: list[int]) -> tuple[Float64, list[Int64]]:
        """GTSAM's covariance of some poses in roadscan's axes, and the rows of each."""
        names = [key("x", k) for k in pictures]
        found, turn = self.marginals.jointMarginalCovariance(names), []
        for name in names:
            axes = ENU_FROM_NED.T @ self.values.atPose3(name).rotation().matrix()
            turn.append(np.block([[np.zeros((3, 3)), axes], [np.eye(3), np.zeros((3, 3))]]))
        whole = np.block([[a @ found.at(i, j) @ b.T for j, b in zip(names, turn, strict=True)]
                          for i, a in zip(names, turn, strict=True)])  # fmt: skip
        return whole, [6 * k + np.arange(6) for k in range(len(names))]

    def lens_errors(self) -> tuple[Float64, Float64]:
        """GTSAM's corrections of what `LENS_SIGMA` names, and their σ."""
        found = self.values.atCal3DS2(key("l")).vector()
        stated = np.array([*LENS.focal_px, 0.0, *LENS.principal_px, *LENS.distortion[:4]])
        own = [GTSAM_LENS.index(name) for name in LENS_SIGMA]
        return (found - stated)[own], np.sqrt(np.diag(self.covariance(key("l"))))[own]


@cache
def solved(seed: int) -> Solved:
    """Solve a block of a dozen pictures, whose poses err independently of one another, twice."""
    drive = simulated_drive(
        seed, survey_m=0.005,
        block=Block(PICTURES, 160, 1e-3, tuple(POSE_SIGMA.tolist()), tuple(np.radians([0.1, -0.15, 0.12]).tolist())),
    )  # fmt: skip
    sigma = np.array([LENS_SIGMA.get(name, 0.0) for name in CAMERA])
    evidence = replace(drive.evidence, cameras=(CameraPrior("left", sigma),))
    drive, settings = replace(drive, evidence=evidence), AdjustmentSettings()
    mounts = (MountingPrior("left", MOUNT_SIGMA),)
    found = approached(evidence, (Observations.none(), 0), (drive.prior,), settings, mounts)
    ours = adjust(found.rows.observations, (drive.prior,), settings, mounts, evidence.cameras)
    assert set(ours.variance_factors.values()) == {1.0}
    measured = found.pictures.measured
    place = met_at(measured, seen(measured, state_of(ours), evidence.numbers), found.weight)
    return Solved(drive, found.pictures, found.rows, ours, place, *by_gtsam(drive, found.pictures, found.rows, place))


def by_gtsam(drive: Drive, pictures: PictureEvidence, rows: Rows, start_m: Float64) -> tuple[Any, Any]:
    """GTSAM's solution and its covariances, from the recorded poses, the stated mounting and lens on."""
    pytest.importorskip("gtsam", reason=WHERE)
    import gtsam as g
    from gtsam_unstable import ProjectionFactorPPPCCal3DS2 as Sight

    exposures, graph, values = pictures.measured.exposures, g.NonlinearFactorGraph(), g.Values()
    # GTSAM's errors are a turn and a shift along the axes of what they move.
    for k in range(len(exposures)):
        axes = exposures.world_from_body[k].T @ ENU_FROM_NED
        own = block_diag(np.diag(POSE_SIGMA[3:] ** 2), axes @ np.diag(POSE_SIGMA[:3] ** 2) @ axes.T)
        body = g.Pose3(g.Rot3(exposures.world_from_body[k]), exposures.body_world_m[k])
        graph.add(g.PriorFactorPose3(key("x", k), body, g.noiseModel.Gaussian.Covariance(own)))
        values.insert(key("x", k), body)
    axes = exposures.body_from_opencv[0].T
    sigma = np.where(MOUNT_SIGMA > 0.0, MOUNT_SIGMA, HELD_M)
    own = block_diag(*(axes @ np.diag(sigma[part] ** 2) @ axes.T for part in (slice(3, 6), slice(3))))
    mounted = g.Pose3(g.Rot3(exposures.body_from_opencv[0]), exposures.lever_body_m[0])
    graph.add(g.PriorFactorPose3(key("m"), mounted, g.noiseModel.Gaussian.Covariance(own)))
    values.insert(key("m"), mounted)
    lens = g.Cal3DS2(np.array([*LENS.focal_px, 0.0, *LENS.principal_px, *LENS.distortion[:4]]))
    sigma = np.array([LENS_SIGMA.get(name, HELD) for name in GTSAM_LENS])
    graph.add(g.PriorFactorCal3DS2(key("l"), lens, g.noiseModel.Diagonal.Sigmas(sigma)))
    values.insert(key("l"), lens)
    measured, sigma_px = pictures.measured, (rows.observations.sigma_m * rows.px_per_m).reshape(-1, 2)
    for m, two in zip(rows.measurement[::2].tolist(), sigma_px, strict=True):
        point, noise = int(measured.point[m]), g.noiseModel.Diagonal.Sigmas(two)
        keys = (key("x", int(measured.picture[m])), key("m"), key("p", point), key("l"))
        graph.add(Sight(measured.pixel[m], noise, *keys))
        if not values.exists(key("p", point)):
            values.insert(key("p", point), start_m[point])
            if np.isfinite(measured.surveyed_world_m[point]).all():
                flat, height = measured.survey_sigma_m[point]
                noise = g.noiseModel.Diagonal.Sigmas(np.array([flat, flat, height]))
                graph.add(g.PriorFactorPoint3(key("p", point), measured.surveyed_world_m[point], noise))
    settings = g.LevenbergMarquardtParams()
    settings.setRelativeErrorTol(1e-12)
    settings.setAbsoluteErrorTol(1e-12)
    found = g.LevenbergMarquardtOptimizer(graph, values, settings).optimize()
    return found, g.Marginals(graph, found)


def test_poses_mounting_and_lens_are_those_of_gtsam() -> None:
    """Estimates to a twentieth of σ, σ to a hundredth."""
    for seed in SEEDS:
        block = solved(seed)
        exposures, ours = block.pictures.measured.exposures, block.ours
        at = np.searchsorted(ours.epochs_gps_ns[0], exposures.epoch_gps_ns)
        assert (ours.epochs_gps_ns[0][at] == exposures.epoch_gps_ns).all()
        shift, turn = np.split(ours.values[0][at], 2, axis=1)
        sigma = np.sqrt(np.einsum("kii->ki", ours.covariance[0][at]))
        moved, theirs = block.pose_errors()
        np.testing.assert_allclose(np.hstack([shift, turn]) / theirs, moved / theirs, atol=0.05)
        np.testing.assert_allclose(sigma / theirs, 1.0, atol=0.01)
        errors, theirs = block.mounting_errors()
        np.testing.assert_allclose(ours.mountings.error[0, MOUNTED] / theirs, errors / theirs, atol=0.05)
        np.testing.assert_allclose(ours.mountings.sigma[0, MOUNTED] / theirs, 1.0, atol=0.01)
        errors, theirs = block.lens_errors()
        columns = [CAMERA.index(name) for name in LENS_SIGMA]
        np.testing.assert_allclose(ours.cameras.error[0, columns] / theirs, errors / theirs, atol=0.05)
        np.testing.assert_allclose(ours.cameras.sigma[0, columns] / theirs, 1.0, atol=0.01)


def test_points_lie_where_gtsam_has_them() -> None:
    """Rays that meet at a narrow angle are not linear in their σ: the distance counts where its σ is below a tenth."""
    for seed in SEEDS:
        block = solved(seed)
        away = []
        for number in np.unique(block.pictures.measured.point[block.rows.measurement]).tolist():
            place, covariance = block.values.atPoint3(key("p", number)), block.covariance(key("p", number))
            eye = block.values.atPose3(key("x", 0)).translation()
            if np.sqrt(np.trace(covariance)) < 0.1 * np.linalg.norm(place - eye):
                off = block.place_m[number] - place
                away.append(np.sqrt(off @ np.linalg.solve(covariance, off) / 3.0))
        assert len(away) > 40
        assert np.median(away) < 0.05 and np.max(away) < 0.3


def test_errors_of_two_poses_hang_together_as_gtsam_says() -> None:
    """What places measured in two pictures rest on: each pose's covariance, and those with the ones after it."""
    for seed in SEEDS:
        block = solved(seed)
        (joint,) = block.ours.cameras.joint
        epochs = block.pictures.measured.exposures.epoch_gps_ns
        at = [int(np.flatnonzero(epochs == one)[0]) for one in joint.epochs_gps_ns]
        assert len(at) > 2 and [len(one) for one in joint.later] == list(range(len(at)))[::-1]
        for k in range(len(at)):
            expected, order = block.joint_covariance(at[k:])
            size = np.sqrt(np.diag(expected))
            own = expected[np.ix_(order[0], order[0])]
            np.testing.assert_allclose(joint.covariance[k, :6, :6] / np.outer(*[size[order[0]]] * 2),
                                       own / np.outer(*[size[order[0]]] * 2), atol=0.02)  # fmt: skip
            for j, later in enumerate(joint.later[k]):
                scale = np.outer(size[order[0]], size[order[j + 1]])
                found = expected[np.ix_(order[0], order[j + 1])]
                np.testing.assert_allclose(later / scale, found / scale, atol=0.02)
                assert np.abs(found / scale).max() > 0.5  # there is something to agree on
