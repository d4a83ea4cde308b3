"""Heights of empty cells from those around: a membrane (Laplace's equation), solved from coarse to fine."""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import inlined, kernel

SWEEPS = 8
"""Sweeps of relaxation: with a level for each size of holes, the membrane is wrong by less than a hundredth of the fall
across a hole."""


@kernel
def halved(z, known, odd, coarse, coarse_known):
    """Compute the mean height of the known cells of each two by two.

    z : (rows, columns) float32; known : (rows, columns) bool. odd : (2,) 1 where the first row, the first column, is the
    second of its two by two, else 0. coarse, coarse_known : (⌈(rows + odd)/2⌉, ⌈(columns + odd)/2⌉), out.
    """
    rows, columns = z.shape
    for i in range(coarse.shape[0]):
        for j in range(coarse.shape[1]):
            total, count = 0.0, 0
            for a in range(max(2 * i - odd[0], 0), min(2 * i + 2 - odd[0], rows)):
                for b in range(max(2 * j - odd[1], 0), min(2 * j + 2 - odd[1], columns)):
                    if known[a, b]:
                        total += z[a, b]
                        count += 1
            coarse_known[i, j] = count > 0
            coarse[i, j] = total / count if count > 0 else 0.0


@kernel
def begin(coarse, known, odd, z):
    """Fill the unknown cells of z from the coarse level, bilinear between the middles of its cells.

    coarse : float32, whole; known : (rows, columns) bool; odd : as :func:`halved` has them; z : (rows, columns) float32.
    """
    m, n = coarse.shape
    for i in range(z.shape[0]):
        a, upper = divmod(i + odd[0], 2)
        a2 = min(max(a + (1 if upper else -1), 0), m - 1)
        for j in range(z.shape[1]):
            if not known[i, j]:
                b, right = divmod(j + odd[1], 2)
                b2 = min(max(b + (1 if right else -1), 0), n - 1)
                near = 0.75 * coarse[a, b] + 0.25 * coarse[a, b2]
                far = 0.75 * coarse[a2, b] + 0.25 * coarse[a2, b2]
                z[i, j] = 0.75 * near + 0.25 * far


@kernel
def relax(z, known):
    """Replace each unknown cell by the mean of its four neighbours, row by row, eight times over (Gauss–Seidel).

    A mean waits for that of the cell to its west. So the eight sweeps go over the raster together, each two rows behind
    the one before: it finds there what that left, and the processor works on eight means at once.
    z : (rows, columns) float32, changed; known : (rows, columns) bool. The slope across the grid's edge is zero.
    """
    rows = z.shape[0]
    for front in range(rows + 2 * SWEEPS - 2):
        if 2 * SWEEPS - 2 < front < rows - 1:
            _relax_eight(z, known, front)
        else:
            for sweep in range(SWEEPS):
                _relax_row(z, known, front - 2 * sweep)


@inlined
def _relax_row(z, known, i):
    """Replace the unknown cells of a row, where the raster has it."""
    rows, columns = z.shape
    if 0 <= i < rows:
        south, north = max(i - 1, 0), min(i + 1, rows - 1)
        for j in range(columns):
            if not known[i, j]:
                west, east = max(j - 1, 0), min(j + 1, columns - 1)
                z[i, j] = 0.25 * (z[south, j] + z[north, j] + z[i, west] + z[i, east])


@inlined
def _relax_eight(z, known, front):
    """Replace the unknown cells of eight rows, each two south of the one before, none at an edge of the raster."""
    columns = z.shape[1]
    for j in range(columns):
        west, east = max(j - 1, 0), min(j + 1, columns - 1)
        for sweep in range(SWEEPS):
            i = front - 2 * sweep
            mean = np.float32(0.25) * (z[i - 1, j] + z[i + 1, j] + z[i, west] + z[i, east])
            z[i, j] = z[i, j] if known[i, j] else mean
