"""Compact components of slices, against SciPy's labels of the dense raster."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from roadscan.assets.upright.slices import CELL_M, LOWEST_M, SLICE_M, WIDEST_M, slices_of, usable_above_m
from tests.assets.upright.scene import simulated


def test_components_are_those_of_the_dense_raster() -> None:
    scene, _ = simulated()
    found, above = slices_of(scene), usable_above_m(scene)
    levels, rows, columns = found.counts.shape
    flat = np.zeros((3, 3, 3), int)
    flat[1] = 1
    wanted, number = ndimage.label(found.counts > 0, structure=flat)
    sides = [(s[1].stop - s[1].start, s[2].stop - s[2].start) for s in ndimage.find_objects(wanted)]
    compact = np.array([max(side) <= round(WIDEST_M / CELL_M) for side in sides])
    assert 100 < compact.sum() == found.level.size < number
    x, y = scene.returns.x_m - found.corner_m[0], scene.returns.y_m - found.corner_m[1]
    held = (above >= LOWEST_M + 0.01) & (above < LOWEST_M + SLICE_M * levels - 0.01)
    place = [np.clip((v[held] / CELL_M).astype(int), 0, n - 1) for v, n in ((y, rows), (x, columns))]
    level = ((above[held] - LOWEST_M) / SLICE_M).astype(int)
    own = wanted[level, *place]
    numbers = np.append(-1, np.where(compact, np.cumsum(compact) - 1, -1))
    assert np.mean(found.owner[held] != numbers[own]) < 1e-3  # a height on the border of two slices
    mean = ndimage.mean(scene.returns.x_m, found.owner, np.arange(found.level.size))
    np.testing.assert_allclose(found.x_m, mean, rtol=0.0, atol=1e-9)
