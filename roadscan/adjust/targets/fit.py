"""Centre of a target, with its covariance, from a fit of its shape to the intensities.

Each intensity becomes a label from 0, the road around, to 1, paint. The shape gives the chance of paint at each place;
its centre, size and turn are those under which the labels are likeliest. Paint may be worn off, and there may be some
beside the shape; both chances are estimated from the labels. So missing paint has little weight, and paint outside the
shape has much: a worn edge does not pull the centre away from it. The chance changes from paint to road
over a blur that is wide at first, so that the search converges, and at last as wide as the distance of readings.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from roadscan.adjust.kernels import target_shapes as kernels
from roadscan.adjust.kernels.target_shapes import EAST, NORTH, SIZE, TURN, UNKNOWNS
from roadscan.adjust.targets.shapes import Cells, Disc, Shape
from roadscan.compute.array_types import Float64
from roadscan.compute.arrays import scatter_about

_SECTORS: Final = 36
"""Sectors around the centre; labels of one sector are one piece of evidence."""
_ALIKE: Final = 3
"""Sectors nearer than this many share their wear."""
_SURROUNDINGS: Final = 1.5
"""Radius of the fitted area, in radii of a disc or half diagonals of a square."""
_LAST_BLUR: Final = 0.15
"""Last blur, as a share of the distance between cells: the narrower, the less a worn edge shifts the centre."""
_CURVATURE_BLUR: Final = 0.4
"""Blur for the curvature of the likelihood; with a narrower one, chance positions of few readings would show."""
_PARTED: Final = 1.2  # Radius, in half sizes, of the cells from which paint and road are separated.
_STAGES: Final = 5  # Stages of the fit, each with a narrower blur.
_ROUNDS: Final = 12  # Steps of Fisher scoring, at most.
_DONE_M: Final = 1e-6  # Steps below this end the fit (m).
_LEAST_CELLS: Final = 60  # With fewer cells there is no fit.
_LEAST_CHANCE: Final = 0.02  # Least chance of worn paint, and of paint beside the shape.
_MOST_LOST: Final = 0.6  # Greatest chance of worn paint.
_MOST_STRAY: Final = 0.2  # Greatest chance of paint beside the shape.
_SIGMA_LOG_SIZE: Final = 0.05
"""1 σ of a target's size, as a share of the stated one."""
_SAME_SIZE: Final = 0.03
"""A target that differs from the stated size by less (share) has that size, and its whole outline fixes its centre."""
_SIGMA_SAME_SIZE: Final = 0.003
"""1 σ of such a size: 1 %, where ten labels count as one, since paint wears off in patches. Without it, a patch
that is lost at the edge makes the target smaller and moves its centre."""


@dataclass(frozen=True)
class ShapeFit:
    """A fitted shape; coordinates are from the caller's centre."""

    centre_m: Float64
    """(2,) east and north."""
    covariance_m2: Float64
    """(2, 2) of the centre."""
    scale: float
    """Size over the stated size, from the labels alone."""
    turn_rad: float
    """Of a chequered target, east to north."""
    levels: Levels
    count: int
    """Readings that were looked at."""


class Levels(NamedTuple):
    """Intensity levels of a place."""

    road: float
    contrast: float
    """Paint above the road."""
    noise: float
    """1 σ of single values of the road."""

    @property
    def threshold(self) -> float:
        """Returns the value halfway between road and paint."""
        return self.road + 0.5 * self.contrast


def fit_radius_m(shape: Shape) -> float:
    """Returns the radius around the centre of the cells that are fitted (m)."""
    return shape.reach_m * _SURROUNDINGS


def first_levels(cells: Cells, shape: Shape, centre_m: Float64) -> Levels:
    """Returns levels where a shape may be: values are split so that both parts are most even (Otsu 1979).

    Paint makes up a third to two thirds of the values; if it were less, the noise would be split.
    """
    value = np.sort(cells.within(centre_m, _PARTED * shape.half_m).value)
    if value.size < 2:
        return Levels(0.0, 0.0, 0.0)
    below = np.arange(1, value.size)
    total = np.cumsum(value)
    low, high = total[:-1] / below, (total[-1] - total[:-1]) / (value.size - below)
    best = int(np.argmax(below * (value.size - below) * (high - low) ** 2)) + 1
    return _levels(value[:best], value[best:])


def _levels(road: Float64, paint: Float64) -> Levels:
    level = float(np.median(road))
    noise = scatter_about(road, level)
    return Levels(level, float(np.median(paint)) - level, noise)


def fit_shape(cells: Cells, shape: Shape, centre_m: Float64, turn_rad: float, spacing_m: float) -> ShapeFit | None:
    """Returns the most likely shape, from a start within a tenth of its size; None where there is none.

    Parameters
    ----------
    cells : intensities by place. centre_m : (2,) start. turn_rad : of a chequered target, within 15°.
    spacing_m : mean distance between cells.
    """
    near = cells.within(centre_m, fit_radius_m(shape))
    if near.value.size < _LEAST_CELLS:
        return None
    fit = _Fit(near, shape, centre_m)
    state = np.array([*centre_m, 0.0, turn_rad])
    levels = first_levels(near, shape, centre_m)
    last = _LAST_BLUR * spacing_m
    for blur in np.geomspace(max(2 * last, 0.1 * shape.half_m), last, _STAGES):
        levels = fit.labelled(state, levels)
        if levels.contrast <= 0.0:
            return None
        state = fit.likeliest(state, float(blur))
    free_scale = float(np.exp(state[SIZE]))
    if abs(state[SIZE]) < _SAME_SIZE:
        fit.sigma_log_size = _SIGMA_SAME_SIZE
        state = fit.likeliest(state, last)
    covariance = fit.covariance(state, _CURVATURE_BLUR * spacing_m)
    if covariance is None or not np.all(np.isfinite(covariance)):
        return None
    turn = float(state[TURN])
    return ShapeFit(state[[EAST, NORTH]], covariance, free_scale, turn, levels, int(near.count.sum()))


class _Fit:
    """One fit: the labels, and what stays constant over the rounds."""

    def __init__(self, cells: Cells, shape: Shape, centre_m: Float64) -> None:
        self.cells, self.shape = cells, shape
        if isinstance(shape, Disc):
            self.drawn = kernels.Drawn(kernels.DISC, shape.half_m, shape.centre_m / 2)
        else:
            self.drawn = kernels.Drawn(kernels.CHEQUERED, shape.half_m, 0.0)
        away = cells.place_m - centre_m
        azimuth = np.arctan2(away[:, 1], away[:, 0])
        self.group = np.minimum(((azimuth / np.pi + 1.0) / 2.0 * _SECTORS).astype(np.int64), _SECTORS - 1)
        self.active = np.array([True, True, True, not isinstance(shape, Disc)])
        self.label = np.zeros(cells.value.size)
        self.sigma_log_size = _SIGMA_LOG_SIZE
        self.chances = (_LEAST_CHANCE, _LEAST_CHANCE)
        self.out = kernels.Fitted(np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros((_SECTORS, UNKNOWNS)))

    def labelled(self, state: Float64, levels: Levels) -> Levels:
        """Set the labels, and the chances of worn and stray paint, from the levels within and beside the shape."""
        white = np.zeros(self.cells.value.size)
        kernels.draw_white(self.cells.place_m, self.drawn, state, 0.05 * self.shape.half_m, white)
        away = np.hypot(*(self.cells.place_m - state[[EAST, NORTH]]).T)
        inside, beside = white > 0.95, (white < 0.05) & (away > self.shape.half_m)
        value, bright = self.cells.value, self.cells.value > levels.threshold
        if (inside & bright).any() and (beside & ~bright).any():
            levels = _levels(value[beside & ~bright], value[inside & bright])
        self.label = np.clip((value - levels.road) / max(levels.contrast, 1e-9), 0.0, 1.0)
        lost = float(1.0 - self.label[inside].mean()) if inside.any() else _MOST_LOST
        stray = float(self.label[beside].mean()) if beside.any() else _MOST_STRAY
        self.chances = (
            float(np.clip(lost, _LEAST_CHANCE, _MOST_LOST)),
            float(np.clip(stray, _LEAST_CHANCE, _MOST_STRAY)),
        )
        return levels

    def likeliest(self, state: Float64, blur_m: float) -> Float64:
        """Returns the most likely state from a start, by Fisher scoring with steps halved until they help."""
        likelihood, step = self._step(state, blur_m)
        for _ in range(_ROUNDS):
            for _ in range(6):
                tried = state + step
                after, following = self._step(tried, blur_m)
                if after >= likelihood:
                    break
                step = 0.5 * step
            else:
                return state
            moved = float(np.hypot(step[EAST], step[NORTH]))
            state, likelihood, step = tried, after, following
            if moved < _DONE_M:
                break
        return state

    def _score(self, state: Float64, blur_m: float) -> tuple[float, Float64]:
        """Returns the log-likelihood with the prior of the size, and its derivatives (4,)."""
        paint = kernels.Paint(blur_m, *self.chances)
        likelihood = kernels.fit_equations(
            self.cells.place_m, self.label, self.group, self.drawn, state, paint, self.out
        )
        right: Float64 = self.out.scores.sum(axis=0)
        right[SIZE] -= state[SIZE] / self.sigma_log_size**2
        return float(likelihood) - 0.5 * (state[SIZE] / self.sigma_log_size) ** 2, right

    def _step(self, state: Float64, blur_m: float) -> tuple[float, Float64]:
        likelihood, right = self._score(state, blur_m)
        normal = self.out.normal[np.ix_(self.active, self.active)].copy()
        normal[SIZE, SIZE] += self.sigma_log_size**-2
        step = np.zeros(UNKNOWNS)
        step[self.active] = np.linalg.lstsq(normal, right[self.active], rcond=None)[0]
        reach = 0.1 * self.shape.half_m
        limits = np.array([reach, reach, 0.1, 0.1])
        limited: Float64 = step * min(1.0, float(np.min(limits / np.maximum(np.abs(step), 1e-300))))
        return likelihood, limited

    def covariance(self, state: Float64, blur_m: float) -> Float64 | None:
        """Covariance (2, 2) of the centre: the sandwich of Huber (1967), scores summed by neighbouring sectors.

        Wear reaches over sectors, so the products of scores of neighbours count with Bartlett's weights (Newey and
        West 1987), around the circle.
        """
        self._score(state, blur_m)
        scores = self.out.scores[:, self.active].copy()
        meat = np.zeros((scores.shape[1], scores.shape[1]))
        for lag in range(1 - _ALIKE, _ALIKE):
            meat += (1.0 - abs(lag) / _ALIKE) * scores.T @ np.roll(scores, lag, axis=0)
        curvature = self._curvature(state, blur_m)
        if np.linalg.eigvalsh(curvature).min() <= 0.0:
            return None
        inverse = np.linalg.inv(curvature)
        pieces = _SECTORS / _ALIKE
        covariance: Float64 = (inverse @ meat @ inverse)[:2, :2] * pieces / (pieces - len(curvature))
        return 0.5 * (covariance + covariance.T)

    def _curvature(self, state: Float64, blur_m: float) -> Float64:
        """Second derivatives of the log-likelihood, negative, from the scores a third of a blur to both sides."""
        active = np.flatnonzero(self.active)
        steps = np.full(UNKNOWNS, blur_m / 3)
        steps[SIZE:] /= self.shape.half_m
        columns = []
        for which in active:
            change = np.zeros(UNKNOWNS)
            change[which] = steps[which]
            before, after = self._score(state - change, blur_m)[1], self._score(state + change, blur_m)[1]
            columns.append((before - after)[active] / (2.0 * steps[which]))
        found = np.array(columns)
        symmetric: Float64 = 0.5 * (found + found.T)
        return symmetric
