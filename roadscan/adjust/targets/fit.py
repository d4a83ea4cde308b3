"""Centre of a target by a fit of its shape to the intensities, and how well it is known.

Unknown are the centre, the size, the blur of the edges (footprint of a reading, distance between readings, ragged
paint), the turn of a chequered target, and the intensities of road and paint, the road's with a slope. Residuals count
by Tukey's biweight, so that worn paint and neighbouring markings have no weight. At an edge, readings that do not
average over their surroundings show paint or road and nothing between; the scale of residuals grows there with the
model's slope.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.adjust.targets.cells import Cells
from roadscan.adjust.targets.shapes import Disc, Shape
from roadscan.kernels.adjust import target_shapes as kernels
from roadscan.kernels.adjust.target_shapes import BLUR, DARK, EAST, LEVEL, NORTH, PAINT, SIZE, TURN, UNKNOWNS

Float64 = npt.NDArray[np.float64]

SECTORS: Final = 36
"""Residuals of one sector around the centre are taken to be of one piece of paint."""
_SURROUNDINGS: Final = {"disc": 1.5, "chequered": 1.7}
"""Radius of what is fitted, in radii or edges of a quadrant."""
_CUT: Final = 4.685
_EDGE: Final = 0.7
_MAD_TO_SIGMA: Final = 1.4826
_EVEN: Final = 0.03
"""Where the model's slope times the blur is a smaller part of the contrast, a place is even."""
_SIGMA_LOG_SIZE: Final = 0.05
_SIGMA_LOG_BLUR: Final = 0.5
_ROUGH_ROUNDS, _ROUNDS = 6, 25
_DONE_M: Final = 2e-6
_LEAST_NOISE: Final = 0.3
"""Least scale of residuals, as intensities are whole numbers."""


@dataclass(frozen=True)
class ShapeFit:
    """A shape as it fits."""

    state: Float64
    """(10,) unknowns, `kernels/adjust/target_shapes.py`."""
    covariance_m2: Float64
    """(2, 2) of the centre."""
    noise: float
    """1 σ of values in even places, units of the intensity."""
    count: int
    """Readings with weight."""

    @property
    def centre_m(self) -> Float64:
        """(2,) east and north."""
        return self.state[[EAST, NORTH]]

    @property
    def scale(self) -> float:
        """Size over the stated size."""
        return float(np.exp(self.state[SIZE]))

    @property
    def threshold(self) -> float:
        """Intensity halfway between road and paint."""
        return float(self.state[LEVEL] + 0.5 * self.state[PAINT])


def fit_radius_m(shape: Shape) -> float:
    """Cells within this of the centre are fitted (m)."""
    return shape.half_m * _SURROUNDINGS["disc" if isinstance(shape, Disc) else "chequered"]


def drawn(shape: Shape) -> kernels.Drawn:
    """The shape as kernels have it."""
    if isinstance(shape, Disc):
        return kernels.Drawn(kernels.DISC, shape.half_m, shape.centre_m / 2)
    return kernels.Drawn(kernels.CHEQUERED, shape.half_m, 0.0)


def fit_shape(cells: Cells, shape: Shape, centre_m: Float64, turn_rad: float, spacing_m: float) -> ShapeFit | None:
    """The shape that fits best, from a start within a tenth of its size; None where there is no such.

    Parameters
    ----------
    cells : intensities by place. centre_m : (2,) start. turn_rad : of a chequered target, within 15°.
    spacing_m : mean distance between readings.
    """
    near = cells.within(centre_m, fit_radius_m(shape))
    if near.value.size < 3 * UNKNOWNS:
        return None
    fit = _Fit(near, shape, centre_m, turn_rad, spacing_m)
    return fit.solved()


class _Fit:
    """One fit: what stays the same from round to round."""

    def __init__(self, cells: Cells, shape: Shape, centre_m: Float64, turn_rad: float, spacing_m: float) -> None:
        self.cells, self.drawn, self.reach_m = cells, drawn(shape), shape.half_m
        away = cells.place_m - centre_m
        azimuth = np.arctan2(away[:, 1], away[:, 0])
        self.group = np.minimum(((azimuth / np.pi + 1.0) / 2.0 * SECTORS).astype(np.int64), SECTORS - 1)
        n = cells.value.size
        self.out = kernels.Fitted(
            np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros((SECTORS, UNKNOWNS)), np.zeros(n), np.zeros(n), np.zeros(n)
        )
        self.least_blur_m = 0.2 * spacing_m
        self.start = self._start(centre_m, turn_rad, max(spacing_m, 0.1 * shape.half_m))
        self.active = np.ones(UNKNOWNS, bool)
        if isinstance(shape, Disc):
            self.active[TURN] = False
            self.active[DARK] = shape.centre_m > 2.0 * spacing_m
        else:
            self.active[DARK] = shape.quadrants == 4
        self.prior = np.zeros(UNKNOWNS)
        self.prior[SIZE], self.prior[BLUR] = _SIGMA_LOG_SIZE**-2, _SIGMA_LOG_BLUR**-2
        self.expected_blur = np.log(max(0.4 * spacing_m, self.least_blur_m))

    def _start(self, centre_m: Float64, turn_rad: float, blur_m: float) -> Float64:
        state = np.zeros(UNKNOWNS)
        state[[EAST, NORTH]], state[TURN], state[BLUR] = centre_m, turn_rad, np.log(blur_m)
        layers = np.zeros((self.cells.value.size, 2))
        kernels.draw_layers(self.cells.place_m, self.drawn, state, layers)
        bare = layers.sum(axis=1) < 0.05
        white, dark = (layers[:, 0] > 0.9) & (layers[:, 1] < 0.1), layers[:, 1] > 0.9
        if self.drawn.kind == kernels.CHEQUERED:
            white, dark = layers[:, 0] > 0.9, layers[:, 1] > 0.9
        for which, parts in ((LEVEL, bare), (PAINT, white), (DARK, dark)):
            state[which] = np.median(self.cells.value[parts]) if parts.any() else 0.0
        state[PAINT] -= state[LEVEL]
        state[DARK] -= state[LEVEL] + (state[PAINT] if self.drawn.kind == kernels.DISC else 0.0)
        return state

    def solved(self) -> ShapeFit | None:
        """Rounds with the scale of a quarter of the contrast first, then with that of the residuals."""
        state = self.start.copy()
        if state[PAINT] <= 0.0:
            return None
        state = np.where(self.active, state, 0.0)
        noise = 0.25 * state[PAINT]
        for turn in range(_ROUGH_ROUNDS + _ROUNDS):
            self._equations(state, noise)
            if turn >= _ROUGH_ROUNDS:
                noise = self._noise(state)
                self._equations(state, noise)
            step = self._step(state)
            if step is None:
                return None
            state = state + step
            state[BLUR] = max(state[BLUR], np.log(self.least_blur_m))
            if turn > _ROUGH_ROUNDS + 1 and np.hypot(*step[[EAST, NORTH]]) < _DONE_M:
                break
        return self._finished(state, noise)

    def _equations(self, state: Float64, noise: float) -> None:
        robust = kernels.Robust(noise, _EDGE, _CUT)
        kernels.fit_equations(self.cells.place_m, self.cells.value, self.group, self.drawn, state, robust, self.out)

    def _noise(self, state: Float64) -> float:
        even = self.out.edge < _EVEN * abs(state[PAINT])
        left = np.abs(self.out.residual[even])
        return max(_MAD_TO_SIGMA * float(np.median(left)) if left.size else 0.0, _LEAST_NOISE)

    def _normal(self) -> Float64:
        normal = self.out.normal + np.diag(self.prior)
        normal[~self.active], normal[:, ~self.active] = 0.0, 0.0
        normal[~self.active, ~self.active] = 1.0
        return normal

    def _step(self, state: Float64) -> Float64 | None:
        right = self.out.scores.sum(axis=0)
        right[SIZE] -= self.prior[SIZE] * state[SIZE]
        right[BLUR] -= self.prior[BLUR] * (state[BLUR] - self.expected_blur)
        try:
            step: Float64 = np.linalg.solve(self._normal(), np.where(self.active, right, 0.0))
        except np.linalg.LinAlgError:
            return None
        if not np.all(np.isfinite(step)):
            return None
        most = {EAST: 0.1 * self.reach_m, NORTH: 0.1 * self.reach_m, SIZE: 0.1, BLUR: 0.7, TURN: 0.1}
        share = min(1.0, *(limit / max(abs(step[which]), 1e-300) for which, limit in most.items()))
        return share * step

    def _finished(self, state: Float64, noise: float) -> ShapeFit | None:
        self._equations(state, noise)
        inverse = np.linalg.pinv(self._normal())
        meat = self.out.scores.T @ self.out.scores
        groups = np.unique(self.group).size
        if groups <= UNKNOWNS or not np.isfinite(state).all():
            return None
        covariance = inverse @ meat @ inverse * groups / (groups - 5)
        count = int(self.cells.count[self.out.weight > 0.0].sum())
        return ShapeFit(state, covariance[:2, :2], noise, count)
