"""A curved road grid's reference line: equal steps along given headings, and the ground at its sides.

The line and its sides are those of OpenCRG (ASAM OpenCRG 1.2, and its MATLAB and C tools): vertices follow one
another by ``step · (cos φ, sin φ)``; a place (u, v) lies v to the left of the line. At a vertex "left" is
perpendicular to the chord between its two neighbours, stretched so that the sides of two steps meet (a mitre).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final, Self

import numpy as np
import scipy

from roadscan.compute.array_types import Float64, Int64
from roadscan.compute.arrays import smoothed_knots, way_along
from roadscan.compute.kernels.curved_grid import thin_path
from roadscan.core.errors import NavigationError

KNOT_M: Final = 0.25
"""Spacing of the knots along a path is at least this, so that a standing vehicle's noise adds no distance."""
LEAST_KNOTS: Final = 5  # With fewer knots a path is too short for a line.


@dataclass(frozen=True, eq=False)
class ReferenceLine:
    """A line of vertices in equal steps; headings count anticlockwise from x."""

    x_start_m: float
    y_start_m: float
    phi_rad: Float64
    """(n − 1,) heading of each step."""
    step_m: float

    @classmethod
    def smoothed(cls, path_m: Float64, step_m: float, smoothing_m: float) -> tuple[Self, Int64]:
        """Fit a line to a driven path.

        The path is cut into knots of equal distance, smoothed by local parabolas over `smoothing_m` (Savitzky and
        Golay 1964), joined by a cubic spline and followed in steps. Its headings are rounded to 32 bits, as a file
        keeps them.

        Parameters
        ----------
        path_m : (k, 2) positions in the order of travel.

        Returns
        -------
        The line, and (k,) the step beside which each position of the path lies.

        Raises
        ------
        NavigationError
            if the path is too short.
        """
        kept = np.zeros(len(path_m), dtype=bool)
        thin_path(path_m, KNOT_M, kept)
        path = path_m[kept]
        along = way_along(path)
        count = int(along[-1] / KNOT_M) + 1
        if count < LEAST_KNOTS or along[-1] < 2 * step_m:
            raise NavigationError(
                f"the path is {along[-1]:.2f} m long",
                expected=f"at least {max(LEAST_KNOTS * KNOT_M, 2 * step_m):g} m",
                change="choose another pass",
            )
        at, knots = smoothed_knots(path, KNOT_M, smoothing_m)
        way = way_along(knots)
        stations = step_m * np.arange(int(way[-1] / step_m) + 1)
        steps = np.diff(scipy.interpolate.CubicSpline(way, knots)(stations), axis=0)
        phi = np.arctan2(steps[:, 1], steps[:, 0]).astype(np.float32).astype(np.float64)
        own = along[np.cumsum(kept) - 1]
        return cls(float(knots[0, 0]), float(knots[0, 1]), phi, step_m), (np.interp(own, at, way) / step_m).astype(
            np.int64
        )

    @cached_property
    def vertices_m(self) -> Float64:
        """(n, 2) positions of the vertices."""
        return vertices((self.x_start_m, self.y_start_m), self.phi_rad, self.step_m)

    @cached_property
    def left(self) -> Float64:
        """(n, 2) mitred normals to the left at the vertices."""
        return mitred_normals(self.vertices_m)


def vertices(start_m: tuple[float, float], phi_rad: Float64, step_m: float) -> Float64:
    """Return the (n, 2) vertices of a line of n − 1 steps along the headings `phi_rad`."""
    steps = step_m * np.column_stack([np.cos(phi_rad), np.sin(phi_rad)])
    out: Float64 = np.vstack([np.zeros((1, 2)), np.cumsum(steps, axis=0)]) + np.array(start_m)
    return out


def mitred_normals(vertices_m: Float64) -> Float64:
    """Return (n, 2) normals to the left at the vertices (n, 2), n ≥ 2, of length 1 projected on their step's normal.

    At a vertex inside the line the direction is perpendicular to the chord between its neighbours (OpenCRG's
    crg_eval_uv2xy); the length is that of the step which begins there.
    """
    steps = np.diff(vertices_m, axis=0)
    flat = _left(steps)
    out = np.vstack([flat, flat[-1:]])
    if len(steps) > 1:
        chord = _left(vertices_m[2:] - vertices_m[:-2])
        out[1:-1] = chord / np.sum(chord * flat[1:], axis=1, keepdims=True)
    return out


def _left(vectors: Float64) -> Float64:
    """Return (n, 2) unit vectors, a quarter turn to the left of `vectors` (n, 2)."""
    turned = np.column_stack([-vectors[:, 1], vectors[:, 0]])
    unit: Float64 = turned / np.hypot(turned[:, 0], turned[:, 1])[:, None]
    return unit
