"""Kernels of the comparison of lasers: a plane that all see, a laser that is off, what cannot be compared."""

from __future__ import annotations

import numpy as np

from roadscan.ingest.kernels.laser_ranges import by_firing, residuals

ELEVATIONS = np.radians([-20.0, -18.0, -15.0])


def over_a_plane(firings: int = 400) -> np.ndarray:
    """Ranges, sines of elevation, cosines and sines of azimuth of three lasers 2 m above a plane: (4, 3, firings)."""
    azimuth = np.linspace(-np.pi, np.pi, firings, endpoint=False) + 1e-3
    far, rise, ahead, left = np.zeros((4, 3, firings))
    far[:], rise[:] = (-2.0 / np.sin(ELEVATIONS))[:, None], np.sin(ELEVATIONS)[:, None]
    ahead[:], left[:] = np.cos(azimuth), np.sin(azimuth)
    return np.array([far, rise, ahead, left])


def test_returns_are_laid_out_by_laser_and_firing() -> None:
    truth = over_a_plane()
    firing, laser = (one.ravel() for one in np.indices((400, 3)))
    far, rise, ahead, left = truth[:, laser, firing]
    level = np.sqrt(1 - rise**2)
    xyz = far * np.array([level * ahead, level * left, rise])
    xyz[:, 7], xyz[0, 8] = 0.0, np.nan
    found = np.full((4, 3, 400), np.nan)
    by_firing(laser, firing, xyz, found)
    truth[:, laser[7:9], firing[7:9]] = np.nan
    np.testing.assert_allclose(found, truth, rtol=1e-12)


def test_the_middle_laser_of_a_plane_is_told_by_the_two_beside_it() -> None:
    heads = over_a_plane()
    heads[0, 1] += 0.2  # the laser is off
    heads[0, 0, 5] = np.nan
    heads[0, 2, 6] = 0.5 * heads[0, 0, 6]  # not of one surface
    heads[2:, 2, 7] = -heads[3, 2, 7], heads[2, 2, 7]  # to another side
    heads[0, :, 8] = 0.1  # too near
    heads[0, 1, 9] += 1.0
    span = np.sin(ELEVATIONS[2] - ELEVATIONS[0])
    share = np.sin(ELEVATIONS[2] - ELEVATIONS[1]) / span, np.sin(ELEVATIONS[1] - ELEVATIONS[0]) / span
    off_m, quarter, pulls = np.empty(400), np.empty(400, np.int64), np.empty((2, 400))
    count = residuals(heads, 1, 0, 2, *share, off_m, quarter, pulls)
    assert count == 395
    np.testing.assert_allclose(off_m[:count], 0.2, atol=1e-9)
    left_out = [5, 6, 7, 8, 9]
    azimuth = np.arctan2(heads[3, 1], heads[2, 1])
    np.testing.assert_array_equal(
        quarter[:count], np.delete(np.floor((azimuth + np.pi) / (np.pi / 2)), left_out).astype(int)
    )
    for side, laser in enumerate((0, 2)):  # what a metre of a neighbour's range adds, by a small step of it
        step = 1e-6
        moved = heads.copy()
        moved[0, laser] += step
        after, rest = np.empty(400), (np.empty(400, np.int64), np.empty((2, 400)))
        assert residuals(moved, 1, 0, 2, *share, after, *rest) == count
        np.testing.assert_allclose((after - off_m)[:count] / step, pulls[side, :count], atol=1e-4)
