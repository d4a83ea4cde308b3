"""Depths of a lidar at tie points: derivatives, surfaces and edges, and what they say of the camera's mounting."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from roadscan.adjust.adjustment import adjust
from roadscan.adjust.bundle.measurements import NearReturns, State, Surfaces, depth_rows, met_at, seen, surfaces_of
from roadscan.adjust.bundle.solve import Approached, approached, state_of
from roadscan.adjust.observations import MountingPrior, Observations
from roadscan.adjust.settings import AdjustmentSettings
from roadscan.poses.trajectory import Corrections
from tests.adjust import test_bundle
from tests.adjust.test_bundle import BORESIGHT_RAD, Block, Drive, simulated_drive

Float64 = npt.NDArray[np.float64]

LIDAR_M = np.array([-1.1, 0.05, -1.55])
"""Lever arm of the lidar, whose axes are those of the body."""
WALLS_M = (113.0, 127.0)
"""Radii of the two walls about the middle of the circle that is driven."""
MOUNTS = (
    MountingPrior("left", np.array([*[0.005] * 3, *np.radians([0.5] * 3), 0.0])),
    MountingPrior("lidar", np.array([*[0.005] * 3, *np.radians([0.02] * 3), 0.0])),
)


def _on_surfaces(rng: np.random.Generator, count: int) -> Float64:
    """Places on the road and on the walls."""
    along, up = rng.uniform(-0.05, 0.75, count), rng.uniform(0.3, 5.0, count)
    wall = rng.choice([*WALLS_M, 0.0], count)
    radius = np.where(wall > 0.0, wall, rng.uniform(WALLS_M[0] + 0.5, WALLS_M[1] - 0.5, count))
    return np.stack([radius * np.sin(along), 120.0 - radius * np.cos(along), np.where(wall > 0.0, up, 0.0)], axis=-1)


def _returns(drive: Drive, clutter: float, seed: int = 0) -> tuple[NearReturns, ...]:
    """Returns of every second picture, with 1 cm of noise; a share of the directions, in patches, ends on things before
    the surfaces, which were not there when other pictures were taken.
    """
    rng = np.random.default_rng(seed)
    down, right = np.meshgrid(np.radians(np.arange(-10.0, 24.0, 0.8)), np.radians(np.arange(-40.0, 40.0, 0.4)))
    way = np.stack([np.cos(down) * np.cos(right), np.cos(down) * np.sin(right), np.sin(down)], axis=-1)
    found = []
    for k in range(0, len(drive.true_body_m), 2):
        ray = way.reshape(-1, 3) @ drive.true_turn[k].T
        eye = drive.true_body_m[k] + drive.true_turn[k] @ LIDAR_M
        reach = np.where(ray[:, 2] < 0.0, -eye[2] / np.minimum(ray[:, 2], -1e-9), np.inf)
        flat, centre = ray[:, :2], np.array([0.0, 120.0])
        for radius in WALLS_M:
            a, b = (flat**2).sum(axis=1), flat @ (eye[:2] - centre)
            root = b**2 - a * (((eye[:2] - centre) ** 2).sum() - radius**2)
            ends = [(-b + sign * np.sqrt(np.maximum(root, 0.0))) / a for sign in (-1.0, 1.0)]
            for end in ends:
                reach = np.where((root > 0.0) & (end > 0.5), np.minimum(reach, end), reach)
        patch = rng.random((10, 12)) < clutter
        rows, columns = np.indices(down.shape)
        near = patch[rows * 10 // down.shape[0], columns * 12 // down.shape[1]].ravel()
        reach = np.where(near, 0.6 * reach, reach) + 0.01 * rng.normal(size=reach.size)
        kept = reach < 40.0
        point = LIDAR_M + (way.reshape(-1, 3) * reach[:, None])[kept]
        found.append(NearReturns(k, 1, "lidar", LIDAR_M, point.astype(np.float32)))
    return tuple(found)


@pytest.fixture
def drive(monkeypatch: pytest.MonkeyPatch) -> Drive:
    """A drive whose tie points lie on the road and on walls, without control."""
    monkeypatch.setattr(test_bundle, "_around", _on_surfaces)
    made = simulated_drive(3, block=Block(points=900))
    evidence = made.evidence
    return replace(made, evidence=replace(evidence, enters=evidence.measured.is_tie))


def _approached(drive: Drive, returns: tuple[NearReturns, ...]) -> Approached:
    evidence = replace(drive.evidence, returns=returns)
    return approached(evidence, (Observations.none(), 0), (drive.prior,), AdjustmentSettings(), MOUNTS)


def _boresight_off_deg(drive: Drive, approach: Approached) -> tuple[float, float]:
    """Error of the boresight relative to the lidar, and its stated 1 σ (degrees, the worst axis)."""
    more = [] if approach.depths is None else [approach.depths.observations]
    joined = Observations.joined([*more, approach.rows.observations])
    found = adjust(joined, (drive.prior,), AdjustmentSettings(), MOUNTS, drive.evidence.cameras)
    state = state_of(found)
    off = state.mountings[0][3:6] - state.mountings[1][3:6] - BORESIGHT_RAD
    return float(np.degrees(np.abs(off).max())), float(np.degrees(found.mountings.sigma[0, 3:6].max()))


def _surfaces(drive: Drive, clutter: float) -> tuple[Surfaces, Float64]:
    """Surfaces at tie points by the true mounting, and the true distance of each tie point from its surface."""
    true = State({}, {0: np.concatenate([np.zeros(3), BORESIGHT_RAD, [0.0]])})
    measured, numbers = drive.evidence.measured, drive.evidence.numbers
    found = surfaces_of(measured, _returns(drive, clutter), true, numbers)
    assert found is not None
    point, picture = measured.point[found.measurement], measured.picture[found.measurement]
    place = _places(drive)[point]
    body = np.einsum("nji,nj->ni", drive.true_turn[picture], place - drive.true_body_m[picture])
    return found, np.einsum("ni,ni->n", found.normal_body, body - found.point_body_m)


def _places(drive: Drive) -> Float64:
    """True places of the tie points, drawn once more, and of the control points."""
    rng = np.random.default_rng(3)
    return np.concatenate([_on_surfaces(rng, 900), drive.control_m])


def test_surfaces_hold_the_tie_points_and_none_lies_across_an_edge(drive: Drive) -> None:
    found, away = _surfaces(drive, 0.0)
    assert found.measurement.size > 1_000
    assert np.abs(away).max() < 0.05 and np.median(np.abs(away)) < 0.01
    # Things before the surfaces: a plane is on the one or on the other, never between them.
    cluttered, away = _surfaces(drive, 0.2)
    assert 100 < cluttered.measurement.size < found.measurement.size
    before = np.abs(away) > 0.05
    assert before.any()
    scaled = cluttered.point_body_m - LIDAR_M
    true = scaled / np.where(before, 0.6, 1.0)[:, None]
    ground_or_wall = np.abs(np.einsum("ni,ni->n", cluttered.normal_body, scaled))
    assert (np.abs(away)[before] > 0.2 * ground_or_wall[before]).all()
    assert np.isfinite(true).all()


def test_rows_are_the_derivatives_of_distances(drive: Drive) -> None:
    measured, numbers = drive.evidence.measured, drive.evidence.numbers
    surfaces, _ = _surfaces(drive, 0.0)
    surfaces = surfaces.at(np.arange(0, surfaces.measurement.size, 37))
    place = met_at(measured, seen(measured, State(), numbers), np.ones(measured.point.size))
    weight = np.ones(measured.point.size)
    ends = np.array([drive.prior.first_gps_ns, drive.prior.last_gps_ns])

    def value(values: Float64) -> tuple[Float64, Observations]:
        corrections = Corrections(ends, np.tile(values[:3], (2, 1)), np.tile(values[3:6], (2, 1)))
        state = State({"a": corrections}, {1: values[6:]})
        rows = depth_rows(measured, surfaces, state, numbers, (place, np.arange(len(place))), (0.03, 0.01), weight)
        return rows.value_m, rows.observations

    about = np.array([0.03, -0.02, 0.05, 6e-4, -9e-4, 3e-4, 0.01, 0.02, -0.01, 6e-4, 9e-4, -3e-4, 1e-3])
    own = value(about)[1]
    by = np.concatenate([own.partials[:, 0], own.mount_partials[:, 0]], axis=1)
    for k, step in enumerate([*[1e-4] * 3, *[1e-6] * 3, *[1e-4] * 3, *[1e-6] * 3, 1e-5]):
        one, other = (value(about + sign * step * np.eye(13)[k])[0] for sign in (1, -1))
        # A distance falls as the lidar's point moves towards the tie point. Turns about 1 mrad follow one another.
        np.testing.assert_allclose((other - one) / (2 * step), by[:, k], atol=6e-3 * np.abs(by[:, k]).max() + 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("clutter", [0.0, 0.2])
def test_the_lidar_tells_the_boresight_of_the_camera(drive: Drive, clutter: float) -> None:
    without, _ = _boresight_off_deg(drive, _approached(drive, ()))
    approach = _approached(drive, _returns(drive, clutter))
    off, sigma = _boresight_off_deg(drive, approach)
    assert without > 0.05
    assert off < 0.03 and off < 4.0 * max(sigma, 0.01)
    assert Rotation.from_rotvec(BORESIGHT_RAD).magnitude() > np.radians(0.3)
