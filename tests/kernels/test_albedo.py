"""Noise of surfaces in pictures: its moments, its spectrum by NumPy, what pixels leave of it; the sizes of bricks."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.simulate.kernels.albedo import BRICK_M, COURSE_M, Octaves, add_bricks, add_noise, noise_at

pytestmark = pytest.mark.filterwarnings("ignore:overflow encountered")  # plain Python says it of 64 bits that wrap
SEED = np.uint64(4711)


def line(step: float, count: int) -> np.ndarray:
    return np.array([noise_at(0.37 + step * i, 2.1, -5.3, SEED) for i in range(count)])


def added(place: np.ndarray, side_m: float, wavelength_m: tuple[float, ...]) -> np.ndarray:
    across, down = np.zeros_like(place), np.zeros_like(place)
    across[:, 0], down[:, 1] = side_m, side_m
    share = np.full(len(wavelength_m), len(wavelength_m) ** -0.5)
    out = np.zeros(len(place), np.float32)
    add_noise(
        place, across, down, np.full(len(place), 0.2, np.float32), Octaves(np.array(wavelength_m), share, SEED), out
    )
    return out


def places(count: int, size_m: float = 40.0) -> np.ndarray:
    return np.random.default_rng(3).uniform(-size_m, size_m, (count, 3))


def test_noise_has_mean_0_and_deviation_1_and_the_wavelength_of_two_nodes():
    values = np.array([noise_at(*p, SEED) for p in places(6_000)])
    assert abs(values.mean()) < 0.05 and abs(values.std() - 1.0) < 0.05
    power = np.abs(np.fft.rfft(line(0.125, 4096))) ** 2
    frequency = np.fft.rfftfreq(4096, 0.125)
    assert power[frequency > 1.0].sum() < 0.03 * power.sum()


def test_noise_is_smooth_and_the_same_wherever_it_is_asked_for():
    values = line(0.01, 400)
    assert np.abs(np.diff(values)).max() < 0.1
    assert noise_at(-7.25, 3.5, 11.0, SEED) == noise_at(-7.25, 3.5, 11.0, SEED)
    assert noise_at(-7.25, 3.5, 11.0, SEED) != noise_at(-7.25, 3.5, 11.0, np.uint64(4712))


def test_octaves_add_up_to_the_contrast_and_do_not_depend_on_blocks():
    where = places(3_000)
    whole = added(where, 1e-4, (0.1, 0.2, 0.4))
    assert whole.std() == pytest.approx(0.2, rel=0.06)
    parts = np.concatenate([added(np.ascontiguousarray(p), 1e-4, (0.1, 0.2, 0.4)) for p in np.split(where, [1, 700])])
    assert np.array_equal(whole, parts)


def test_a_pixel_shows_the_mean_of_what_it_covers():
    where, side = places(300), 0.05
    grid = (np.arange(24) + 0.5) / 24 - 0.5
    fine = np.zeros(300)
    for u in grid:
        for v in grid:
            fine += added(where + side * np.array([u, v, 0.0]), 1e-6, (0.2,))
    coarse = added(where, side, (0.2,))
    assert np.std(coarse - fine / 24**2) < 0.1 * np.std(coarse)
    assert not added(where, 0.45, (0.2,)).any()


def test_bricks_repeat_with_courses_and_fade_out():
    along = np.linspace(0.0, 25.0, 5001)[:-1]

    def wall(up_m: float, side_m: float) -> np.ndarray:
        place = np.stack([along, np.full_like(along, up_m)], axis=-1)
        step = np.zeros_like(place)
        step[:, 0] = side_m
        out = np.zeros(along.size, np.float32)
        add_bricks(place, step, step[:, ::-1].copy(), 0.1, SEED, out)
        return out

    mortar = wall(20 * COURSE_M + 0.005, 1e-5)
    assert np.ptp(mortar) < 1e-6 and mortar[0] > 0.1
    bricks = wall(20 * COURSE_M + 0.04, 1e-5)
    joints = np.flatnonzero(np.diff((np.abs(bricks - mortar[0]) < 1e-6).astype(int)) == 1)
    assert np.allclose(np.diff(along[joints]), BRICK_M, atol=0.011)
    assert not wall(0.5, 0.2).any()
