"""Surfaces seen from several drives: patches of known shift, planes of a known yard, the simulated calibration yard."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.ndimage import fourier_gaussian, fourier_shift
from scipy.spatial.transform import Rotation

from benchmarks.bench_surfaces import overlap_mm, solved
from benchmarks.calibration_yard import mounting_error, profiler_yard
from roadscan.calibrate.estimator import calibrate
from roadscan.calibrate.kernels.surface_patches import MOMENTS, UNKNOWNS, Matches, match_patches
from roadscan.calibrate.surfaces.heights import HeightTies, rows_of
from roadscan.calibrate.surfaces.planes import Pieces, PlaneTies, Readings
from roadscan.calibrate.unknowns import Prior, mounting_of
from roadscan.core.errors import NavigationError
from roadscan.core.settings.calibration import CalibrationSettings

CELL_M = 0.005
ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def smooth(noise: np.ndarray, cells: float) -> np.ndarray:
    """A field smoothed with a Gaussian, periodic, of unit variance."""
    field = np.fft.ifft2(fourier_gaussian(np.fft.fft2(noise), cells)).real
    return field / field.std()


def matched(first: np.ndarray, second: np.ndarray, size: int = 48):
    """Shifts, matrices and counts of all patches of two images."""
    r = np.arange(8, first.shape[0] - size - 8, size, dtype=np.int32)
    corner = np.stack(np.meshgrid(r, r, indexing="ij"), -1).reshape(-1, 2)
    n = len(corner)
    shift, crossed, mean = np.zeros((n, 3)), np.zeros((n, UNKNOWNS, UNKNOWNS)), np.zeros((n, UNKNOWNS, UNKNOWNS))
    spread, count, felt = np.zeros(n), np.zeros(n, np.int32), np.zeros((n, MOMENTS))
    found = Matches(shift, crossed, mean, spread, count, felt)
    match_patches(first, second, CELL_M, corner, size, 1, 20, 100, found)
    return shift, crossed, mean, spread, count


def images(shift_m: tuple[float, float], noise: float, relief: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Two images of one field, the second moved by (dx, dy), each with smoothed noise of its own."""
    rng = np.random.default_rng(5)
    field = relief * 4e-4 * smooth(rng.standard_normal((512, 512)), 3.0)
    cells = (shift_m[1] / CELL_M, shift_m[0] / CELL_M)
    moved = np.fft.ifft2(fourier_shift(np.fft.fft2(field), cells)).real + 0.003
    return tuple(a + noise * smooth(rng.standard_normal(field.shape), 1.5) for a in (field, moved))


@pytest.mark.slow
def test_patches_find_a_fourier_shift_and_their_sigma_is_honest():
    true = np.array([0.0013, -0.0021, 0.003])
    shift, crossed, mean, spread, count = matched(*images((true[0], true[1]), 3e-5))
    assert (count > 0).all()
    independent = 4.0 * math.pi * 1.5**2  # white noise under a Gaussian of 1.5 cells
    upright, level = rows_of(crossed, mean, spread * independent, 0.4, 1e-12)
    assert np.abs(np.median(shift, axis=0) - true).max() < 5e-5
    away = shift - true
    for rows in (upright, level):
        z = np.einsum("nki,ni->nk", rows, away)
        assert 0.75 < np.sqrt(np.mean(z**2)) < 1.25


def test_noise_alone_ties_heights_and_nothing_else():
    shift, crossed, mean, spread, _ = matched(*images((0.0, 0.0), 1e-4, relief=0.0))
    upright, level = rows_of(crossed, mean, spread * 4.0 * math.pi * 1.5**2, 0.4, 1e-12)
    assert np.mean((level != 0).any(axis=(1, 2))) < 0.05
    z = np.einsum("nki,ni->nk", upright, shift - [0.0, 0.0, 0.003])
    assert 0.7 < np.sqrt(np.mean(z**2)) < 1.3


def drive(name: str, start_s: float, heading: float, rng: np.random.Generator, true: tuple[np.ndarray, np.ndarray]):
    """Readings of beams in all directions from a drive through a yard with two walls, ranges with 10 mm noise."""
    t = np.arange(0.0, 3.0, 0.01)
    along = np.array([math.sin(heading), math.cos(heading), 0.0])
    position = 5.0 * (t[:, None] - 1.5) * along + [0.0, 0.0, 1.5]
    sway = np.radians(0.3) * np.stack([np.sin(5 * t), np.cos(4 * t), 0 * t], -1)
    body = np.array([Rotation.from_euler("ZYX", [heading, 0, 0]).as_matrix()])
    rotation = ENU_FROM_NED @ body @ Rotation.from_rotvec(sway).as_matrix()
    pose = np.repeat(np.arange(t.size), 300).astype(np.int32)
    azimuth, elevation = rng.uniform(0, 2 * np.pi, pose.size), rng.uniform(-0.6, 0.6, pose.size)
    flat = np.cos(elevation)
    beam = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], -1)
    origin = position[pose] + rotation[pose] @ true[1]
    ray = np.einsum("nij,nj->ni", rotation[pose] @ true[0], beam)
    ranges = np.full(pose.size, np.inf)
    for normal, distance in (((0, 0, 1.0), 0.0), ((0, 1.0, 0), 12.0), ((1.0, 0, 0), 14.0)):
        with np.errstate(divide="ignore"):
            hit = (distance - origin @ np.array(normal)) / (ray @ np.array(normal))
        ranges = np.where((hit > 1.0) & (hit < ranges), hit, ranges)
    place = origin + ranges[:, None] * ray
    good = (ranges < 40.0) & (place[:, 2] < 8.0)
    points = (ranges + 0.01 * rng.standard_normal(pose.size))[:, None] * beam
    epochs = round(start_s * 1e9) + (t * 1e9).astype(np.int64)
    return Readings("lidar", name, points[good], pose[good], epochs, position, rotation)


@pytest.mark.slow
def test_planes_of_a_yard_give_the_mounting_and_say_what_they_do_not():
    rng = np.random.default_rng(3)
    rotation = Rotation.from_euler("ZYX", [3.0, 12.0, 1.0], degrees=True).as_matrix()
    true = rotation, np.array([-1.7, 0.1, -1.3])
    readings = [drive(f"run-{k}", 100.0 * k, k * math.pi / 2, rng, true) for k in range(4)]
    off = Rotation.from_euler("ZYX", [0.8, -0.9, 1.0], degrees=True).as_matrix()
    prior = Prior(mounting_of(off @ rotation, true[1] + [0.05, -0.05, 0.05]), (0.05,) * 3, (math.radians(1.0),) * 3)
    pieces = Pieces.of_seconds(0.5)
    traverses = pieces.traverses(readings, ENU_FROM_NED, (1e-4,) * 3, (1e-6,) * 3, 60.0)
    found = calibrate({"lidar": prior}, PlaneTies(readings, pieces, traverses), traverses, CalibrationSettings())
    one = found.sensors["lidar"]
    away = mounting_error(one.mounting, true)
    assert np.abs(away[3:]).max() < np.radians(0.003)
    assert np.abs(away[:2]).max() < 0.003
    assert np.abs(away / one.sigma).max() < 4.0
    # The ground is level: heights of drives tell nothing of the vertical lever arm but through the body's sway.
    assert one.sigma[2] > 3 * one.sigma[:2].max()


@pytest.mark.slow
def test_profilers_of_the_simulated_yard():
    yard = profiler_yard(seed=3, drives=3, position_m=0.0, attitude_deg=0.0, length_m=3.5)
    found = solved(yard)
    assert found.converged
    for name, one in found.sensors.items():
        before, away = (mounting_error(m, yard.true[name]) for m in (one.before, one.mounting))
        assert np.abs(before[3:]).max() > np.radians(0.2)
        assert np.abs(away[3:]).max() < np.radians(0.003)
        assert np.abs(away[:3]).max() < 0.003
        assert np.abs(away / one.sigma).max() < 4.0
    assert overlap_mm(yard, found) < 0.3


def test_readings_that_do_not_fit_are_refused():
    with pytest.raises(NavigationError, match="one for each of the poses' rows"):
        Readings("a", "run-1", np.zeros((3, 3)), np.zeros(2, np.int32), np.zeros(1, np.int64), np.zeros((1, 3)),
                 np.eye(3)[None])  # fmt: skip
    with pytest.raises(NavigationError, match="name the poses"):
        Readings("a", "run-1", np.zeros((1, 3)), np.ones(1, np.int32), np.zeros(1, np.int64), np.zeros((1, 3)),
                 np.eye(3)[None])  # fmt: skip


def test_drives_at_one_time_and_drives_apart_are_refused():
    def at(run: str, epoch: int, east: float) -> Readings:
        points = np.stack([np.zeros(50), np.linspace(-1, 1, 50), np.ones(50)], -1)
        return Readings("a", run, points, np.zeros(50, np.int32), np.array([epoch]), np.array([[east, 0.0, 1.0]]),
                        ENU_FROM_NED[None])  # fmt: skip

    pieces = Pieces.of_seconds(1.0)
    with pytest.raises(NavigationError, match="overlap in time"):
        pieces.traverses([at("run-1", 0, 0.0), at("run-2", 5, 0.0)], ENU_FROM_NED, (1.0,) * 3, (1.0,) * 3, 60.0)
    readings = [at("run-1", 0, 0.0), at("run-2", 10**10, 50.0)]
    traverses = pieces.traverses(readings, ENU_FROM_NED, (1.0,) * 3, (1.0,) * 3, 60.0)
    prior = Prior(mounting_of(np.eye(3), np.zeros(3)), (0.05,) * 3, (0.02,) * 3)
    with pytest.raises(NavigationError, match="seen twice"):
        calibrate({"a": prior}, HeightTies(readings, pieces, traverses), traverses, CalibrationSettings())
