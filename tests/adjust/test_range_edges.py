"""Range edges against edges of pictures: the boresight comes back, with the σ that it has, or they say why not.

Pictures and returns are cast here, ray by ray, onto boxes on a road; nothing of the library is used for that.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools

import numpy as np
import numpy.typing as npt
import pytest
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial.transform import Rotation

from roadscan.adjust.adjustment import adjust
from roadscan.adjust.bundle.edge_boresight import (
    OTHERS,
    EdgeBoresight,
    EdgeScores,
    Sighted,
    boresight_of,
    edge_observations,
    scores_of,
    widened,
)
from roadscan.adjust.bundle.solve import approached
from roadscan.adjust.kernels.range_edges import continued, scores_of_turns
from roadscan.adjust.observations import CameraPrior, GaussMarkov, MountingPrior, Observations, RunPrior
from roadscan.adjust.settings import AdjustmentSettings
from roadscan.adjust.tasks.edge_scores import boresight_findings
from roadscan.core.rig import Interior
from roadscan.pictures.lens import Lens
from tests.adjust.test_bundle import BORESIGHT_RAD, Block, simulated_drive

Float64 = npt.NDArray[np.float64]

AXES = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Body (forward, right, down) from the camera (right, down, ahead)."""
CAMERA_M, LIDAR_M = np.array([0.4, -0.1, 0.2]), np.array([0.0, 0.1, 0.0])
SIZE, FOCAL = (440, 190), 290.0
LENS = Lens.of(Interior(width_px=SIZE[0], height_px=SIZE[1], focal_px=(FOCAL, FOCAL), principal_px=(219.5, 80.0)))
OFF_DEG = np.array([0.9, -1.1, 1.3])
"""By which the camera is turned from how it is stated."""
ROAD_M, WALL_M = 1.7, 45.0
SHARED_RAD = np.radians(0.05)


def _hits(eye: Float64, ray: Float64, boxes: Float64) -> tuple[Float64, npt.NDArray[np.int64]]:
    """Distances (n,) along rays (n, 3) and what they meet: boxes (b, 2, 3), then road and wall."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (boxes[None] - eye) / ray[:, None, None, :]
        first, last = ends.min(axis=2).max(axis=2), ends.max(axis=2).min(axis=2)
        near = np.where((first < last) & (first > 0.0), first, np.inf)
        road = np.where(ray[:, 2] > 0.0, (ROAD_M - eye[2]) / ray[:, 2], np.inf)
        wall = np.where(ray[:, 0] > 0.0, (WALL_M - eye[0]) / ray[:, 0], np.inf)
    every = np.column_stack([near, road, wall])
    return every.min(axis=1), every.argmin(axis=1)


@functools.cache
def _scene(seed: int) -> tuple[Float64, npt.NDArray[np.uint8]]:
    """Returns of a lidar with 48 lasers (n, 3), body axes, and the picture of the camera that is turned."""
    rng = np.random.default_rng(seed)
    middle = np.column_stack([rng.uniform(7.0, 28.0, 14), rng.uniform(-9.0, 9.0, 14), np.zeros(14)])
    half = rng.uniform([0.3, 0.2, 0.4], [1.6, 1.2, 1.2], (14, 3))
    boxes = np.stack([middle - half, middle + half], axis=1)
    boxes[:, 1, 2] = ROAD_M
    down, right = np.meshgrid(np.radians(np.linspace(-6.0, 16.0, 48)), np.radians(np.arange(-42.0, 42.0, 0.2)))
    ray = np.stack([np.cos(down) * np.cos(right), np.cos(down) * np.sin(right), np.sin(down)], axis=-1).reshape(-1, 3)
    away, _ = _hits(LIDAR_M, ray, boxes)
    returns = LIDAR_M + ray * (away + rng.normal(0.0, 0.01, away.size))[:, None]
    turned = Rotation.from_rotvec(OFF_DEG, degrees=True).as_matrix() @ AXES
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    seen = np.stack([(u - 219.5) / FOCAL, (v - 80.0) / FOCAL, np.ones(u.shape)], axis=-1).reshape(-1, 3) @ turned.T
    _, what = _hits(CAMERA_M, seen, boxes)
    grey = np.append(rng.uniform(30.0, 220.0, 14), [110.0, 160.0])[what] + rng.normal(0.0, 4.0, what.size)
    return returns, np.clip(grey, 0, 255).astype(np.uint8).reshape(SIZE[::-1])


def _scores(seeds: range, lever: Float64 = CAMERA_M, pictures_of: int = 0) -> list[EdgeScores]:
    """Scores of scenes; `pictures_of` : pictures are those of scenes so many later."""
    return [
        scores_of(_scene(seed)[0], LIDAR_M, (lever, AXES), _scene(seed + pictures_of)[1], LENS) for seed in seeds
    ]  # fmt: skip


def _sighted(stated_deg: float = 0.5) -> Sighted:
    return Sighted("camera", "lidar", 0, 1, 0, AXES, np.full(3, np.radians(stated_deg)))


@pytest.fixture(scope="module")
def found() -> EdgeBoresight:
    """What eight scenes say."""
    return boresight_of(_sighted(), _scores(range(8)), SHARED_RAD)


@pytest.mark.slow
@pytest.mark.parametrize("first", [100, 200])
def test_the_boresight_comes_back_within_its_sigma(first: int) -> None:
    own = boresight_of(_sighted(), _scores(range(first, first + 8)), SHARED_RAD)
    left = np.degrees(own.turn) - OFF_DEG
    assert not own.why_not
    assert (np.abs(left) < 2.5 * np.degrees(own.sigma)).all()
    assert (np.abs(left) < 0.15).all()
    assert (np.degrees(own.sigma) < 0.15).all()


@pytest.mark.slow
def test_edges_of_another_scene_say_nothing() -> None:
    own = boresight_of(_sighted(), _scores(range(8), pictures_of=50), SHARED_RAD)
    assert own.why_not
    assert edge_observations([own]).size == 0


def test_few_pictures_say_nothing() -> None:
    assert "too few" in boresight_of(_sighted(), _scores(range(3)), SHARED_RAD).why_not


@pytest.mark.slow
def test_a_lever_arm_that_is_off_turns_the_boresight_as_told(found: EdgeBoresight) -> None:
    shift = np.array([0.0, 0.08, -0.06])
    moved = boresight_of(_sighted(), _scores(range(8), CAMERA_M - shift), SHARED_RAD)
    told = found.by_others[:, :3] @ shift
    assert np.abs(np.degrees(told)).max() > 0.2
    assert np.abs(np.degrees(moved.turn - found.turn - told)).max() < 0.1


@pytest.mark.slow
def test_the_adjustment_takes_what_edges_say(found: EdgeBoresight) -> None:
    mountings = (
        MountingPrior("camera", np.array([*[0.001] * 3, *np.radians([0.5] * 3), 0.0])),
        MountingPrior("lidar", np.array([*[0.001] * 3, *np.radians([0.001] * 3), 0.0])),
    )
    cameras = (CameraPrior("camera", np.zeros(11)),)
    runs = (RunPrior("run", 0, 1_000_000_000, (GaussMarkov(0.01, 60.0),) * 6),)
    solved = adjust(edge_observations([found]), runs, AdjustmentSettings(), mountings, cameras)
    left = np.degrees(solved.mountings.error[0, 3:6]) - OFF_DEG
    assert (np.abs(left) < 0.15).all()
    sigma = solved.mountings.sigma[0, 3:6]
    assert sigma == pytest.approx(found.sigma, rel=0.1)


@pytest.mark.slow
def test_an_assumed_sigma_does_not_hold_a_boresight_back(found: EdgeBoresight) -> None:
    stated = (MountingPrior("camera", np.array([*[0.02] * 3, *np.radians([0.5, 0.0, 2.0]), 0.0])),)
    assert widened(stated, [found]) == stated
    assumed = dataclasses.replace(found, of=dataclasses.replace(found.of, is_assumed=True))
    wider = widened(stated, [assumed])[0].sigma
    turn = np.abs(np.degrees(found.turn))
    assert np.degrees(wider[3:6]) == pytest.approx([turn[0], 0.0, 2.0])  # what is not estimated stays so
    assert (wider[:3] == 0.02).all()


@pytest.mark.slow
@pytest.mark.parametrize("drift", [0.0, 0.012])
def test_tie_points_that_bend_the_lever_arm_with_the_boresight_count_less(drift: float) -> None:
    """Recorded places drift sideways by a share of the way: tie points take that for a heading of the camera."""
    sigma = (*[0.02] * 3, *np.radians([0.01] * 3).tolist())
    drive = simulated_drive(5, block=Block(tau_s=120.0, pose_sigma=sigma))
    own = drive.evidence.measured
    aside = drift * np.arange(len(own.exposures))[:, None] * own.exposures.world_from_body[:, :, 1]
    exposures = dataclasses.replace(own.exposures, body_world_m=own.exposures.body_world_m + aside)
    moved = np.zeros((3, OTHERS))
    moved[2, 1] = np.radians(-7.0)  # a lever arm to the right looks like a turn to the left, as of things 8 m away
    sighted = Sighted("left", "lidar", 0, -1, -1, AXES, np.radians([0.5] * 3))
    # The axes of their covariance are none of the body, so that each of the three rows tells a part alone.
    mixed = Rotation.from_rotvec([0.6, 0.6, 0.6]).as_matrix()
    covariance = (mixed * np.radians([0.05, 0.06, 0.07]) ** 2) @ mixed.T
    edges = EdgeBoresight(sighted, 9, 9_000, BORESIGHT_RAD, covariance, moved, "")
    evidence = dataclasses.replace(
        drive.evidence, measured=dataclasses.replace(own, exposures=exposures), enters=own.is_tie, edges=(edges,)
    )
    mounts, beside = (
        (MountingPrior("left", np.array([*[0.02] * 3, *np.radians([0.5] * 3), 0.0])),),
        edge_observations([edges]),
    )
    way = approached(evidence, (beside, 0), (drive.prior,), AdjustmentSettings(), mounts)
    assert (way.against_edges > 3.0) == (drift > 0.0)
    joined = Observations.joined([beside, way.rows.observations])
    solved = adjust(joined, (drive.prior,), AdjustmentSettings(), mounts, evidence.cameras).mountings
    off, known = np.degrees(solved.error[0, 3:6] - BORESIGHT_RAD), np.degrees(solved.sigma[0, 3:6])
    assert (np.abs(off) < 2.5 * known).all() and np.abs(off).max() < 0.15


@pytest.mark.slow
@pytest.mark.witness("picture_edges")
def test_a_boresight_that_edges_contradict_is_told(found: EdgeBoresight) -> None:
    assert boresight_findings([found]) == []
    exact = EdgeBoresight(_sighted(0.1), *[getattr(found, name) for name in (
        "pictures", "edges", "turn", "covariance", "by_others", "why_not",
    )])  # fmt: skip
    (said,) = boresight_findings([exact])
    assert said.subject == "camera"
    assert f"heading {np.degrees(found.turn[2]):+.3f}°" in said.text


def test_a_plane_goes_on_with_its_inverse_depth_and_an_edge_does_not() -> None:
    """A row of returns on a plane, of which the last is nearer."""
    tangent = np.column_stack([np.arange(5) * 0.1, np.zeros(5)])
    inverse = 0.1 + 0.2 * tangent[:, 0]
    inverse[4] = 0.5
    starts, beside = np.array([0, 1, 3, 5, 7, 8]), np.array([1, 0, 2, 1, 3, 2, 4, 3])
    first, second = np.array([1, 2, 3, 0]), np.array([2, 3, 4, 1])
    found = continued(starts, beside, tangent, inverse, first, second)
    np.testing.assert_allclose(found[:3], 0.1 + 0.2 * tangent[2:5, 0])
    assert found[3] == inverse[0]  # nothing lies on its other side: it goes on as it is


def test_scores_are_those_of_linear_interpolation() -> None:
    """SciPy interpolates the same responses at the places to which each turn moves the edges."""
    rng = np.random.default_rng(8)
    response = rng.uniform(size=(2, 20, 30)).astype(np.float32)
    place, slope = rng.uniform([-2.0, -2.0], [32.0, 22.0], (60, 2)), rng.normal(0.0, 3.0, (60, 2, 3))
    direction, weight = rng.integers(0, 2, 60), rng.uniform(size=60)
    turns = (np.array([-0.1, 0.0, 0.1]), np.array([0.0, 0.2]), np.array([-0.3]))
    found = np.empty((3, 2, 1))
    scores_of_turns(place, slope, direction, weight, response, turns, found)
    images = [RegularGridInterpolator((np.arange(20), np.arange(30)), one, bounds_error=False, fill_value=0.0)
              for one in response.astype(np.float64)]  # fmt: skip
    for at, turn in zip(np.ndindex(found.shape), itertools.product(*turns), strict=True):
        column, row = (place + slope @ np.array(turn)).T
        values = np.choose(direction, [image(np.column_stack([row, column])) for image in images])
        assert found[at] == pytest.approx(weight @ values, rel=1e-6)
