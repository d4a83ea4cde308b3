"""Fits of control to the readings of one pass: the centre of a target, and how far a surveyed line lies aside.

Each intensity about a target becomes a label from 0, the road around, to 1, paint. The shape gives the chance of
paint at each place; its centre, size and turn are those under which the labels are likeliest. Paint may be worn off,
and there may be some beside the shape; both chances are estimated from the labels. So missing paint has little
weight, and paint outside the shape has much: a worn edge does not pull the centre away from it. The chance changes
from paint to road over a blur that is wide at first, so that the search converges, and at last as wide as the
distance of readings.

A line is found slice by slice: paint by its brightness, a kerb by the step of its face.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

import numpy as np

from roadscan.adjust.kernels import target_shapes as kernels
from roadscan.adjust.kernels.target_shapes import EAST, NORTH, SIZE, TURN, UNKNOWNS
from roadscan.adjust.settings import TargetSettings
from roadscan.adjust.targets.shapes import Cells, Disc, HeightFind, Shape, SurveyedLine, TargetReadings, height_at
from roadscan.compute.array_types import Bool, Float64
from roadscan.compute.arrays import scatter_about
from roadscan.compute.edges import LINE_M, painted_line, without_lines

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


_SLICES: Final = 8
"""Slices along the line that are measured separately: their scatter gives the σ of their mean."""
_LEAST: Final = 4  # With fewer slices the line is not found.
_CELL_M: Final = 0.02
"""Width of a cell across the line (m): four readings of a profiler, and a sixth of the narrowest line."""
_ALONG_M: Final = 10.0
"""1 σ of the place along the line (m): far more than errors of poses, so that it has no effect."""
_STRAY_M: Final = 0.03
"""Slices farther than this from the line through all of them (m) show something else."""
_DOUBLED_M: Final = 0.05
"""Lines farther apart than this (m) are two."""
_SIGMA_PAINT_M: Final = 0.003  # 1 σ by which the paint's middle misses the surveyed line (m).
_SIGMA_KERB_M: Final = 0.005
"""1 σ by which the face of a kerb misses the surveyed line (m): batter of the face."""
_STEP_M: Final = 0.04
"""Least step of a kerb (m)."""
_BESIDE_M: Final = (0.03, 0.15)
"""Heights at these distances (m) from the face, on either side, are those of the top and of the foot."""


@dataclass(frozen=True)
class LineFind:
    """A surveyed line near one of its points, as one pass shows it."""

    status: Literal["found", "missed", "doubled"]
    why_not: str
    place_m: Float64
    """(2,) easting and northing of the line abreast of the point; NaN where it was not found."""
    covariance_m2: Float64
    """(2, 2)"""
    height: HeightFind
    """Of the paint, or of the top of the kerb; without height where the line was not found."""
    count: int
    contrast: float
    """Of paint: share of the road's brightness; of a kerb: height of its face (m)."""


def find_line(
    readings: TargetReadings, easting_m: float, northing_m: float, line: SurveyedLine, settings: TargetSettings
) -> LineFind:
    """Returns the line where it crosses the normal of its surveyed point, within `search_radius_m` of it."""
    sine, cosine = np.sin(line.azimuth_rad), np.cos(line.azimuth_rad)
    east, north = readings.easting_m - easting_m, readings.northing_m - northing_m
    along, across = east * sine + north * cosine, east * cosine - north * sine
    reach_m = settings.search_radius_m + LINE_M
    near = (np.abs(along) <= line.half_m) & (np.abs(across) <= reach_m) & np.isfinite(readings.height_m)
    if int(near.sum()) < _SLICES * 10:
        return _missed(f"{int(near.sum())} readings near it")
    number = np.clip(((along + line.half_m) / (2.0 * line.half_m) * _SLICES).astype(np.int64), 0, _SLICES - 1)
    places, heights, contrasts = np.full(_SLICES, np.nan), np.full(_SLICES, np.nan), np.full(_SLICES, np.nan)
    for k in range(_SLICES):
        own = near & (number == k)
        values = readings.intensity[own].astype(np.float64) if line.kind == "paint" else readings.height_m[own]
        profile, at = _profile(values, across[own], reach_m)
        found = _paint(profile, at) if line.kind == "paint" else _kerb(profile, at)
        if found == "doubled":
            return _missed("two lines lie there", "doubled")
        if not isinstance(found, str) and abs(found[0]) <= settings.search_radius_m:
            places[k], heights[k], contrasts[k] = found
    return _joined(readings, (easting_m, northing_m), line, places, (heights, contrasts), settings)


def _joined(
    readings: TargetReadings,
    at: tuple[float, float],
    line: SurveyedLine,
    places: Float64,
    more: tuple[Float64, Float64],
    settings: TargetSettings,
) -> LineFind:
    """Returns the line through the slices that show it."""
    middle = ((np.arange(_SLICES) + 0.5) / _SLICES - 0.5) * 2.0 * line.half_m
    seen = np.isfinite(places)
    if seen.sum() < _LEAST:
        return _missed("nothing near its stated place looks like it")
    seen &= np.abs(places - np.median(places[seen])) <= _STRAY_M + np.abs(middle)
    design = np.stack([np.ones(_SLICES), middle], axis=-1)
    for _ in range(2):
        if seen.sum() < _LEAST:
            return _missed("what is seen near it is no line")
        fit = np.linalg.lstsq(design[seen], places[seen], rcond=None)[0]
        left = places - design @ fit
        seen &= np.abs(left) <= _STRAY_M
    if seen.sum() < _LEAST:
        return _missed("what is seen near it is no line")
    count = int(seen.sum())
    floor = _SIGMA_PAINT_M if line.kind == "paint" else _SIGMA_KERB_M
    scatter = float(np.sqrt(left[seen] @ left[seen] / max(count - 2, 1)))
    sigma = float(np.hypot(scatter / np.sqrt(count), floor))
    sine, cosine = np.sin(line.azimuth_rad), np.cos(line.azimuth_rad)
    normal, way = np.array([cosine, -sine]), np.array([sine, cosine])
    place = np.array(at) + float(fit[0]) * normal
    covariance = sigma**2 * np.outer(normal, normal) + _ALONG_M**2 * np.outer(way, way)
    heights, contrasts = (values[seen] for values in more)
    if line.kind == "paint":
        height = height_at(readings, float(place[0]), float(place[1]), settings)
    else:
        top = float(np.median(heights))
        spread = scatter_about(heights, top)
        height = HeightFind(
            top, float(np.hypot(spread / np.sqrt(count), _SIGMA_PAINT_M)), 0.0, 0.0, count, 1.0, ""
        )  # fmt: skip
    return LineFind("found", "", place, covariance, height, count, float(np.median(contrasts)))


def _missed(why_not: str, status: Literal["missed", "doubled"] = "missed") -> LineFind:
    nan = float("nan")
    none = HeightFind(nan, nan, nan, nan, 0, 0.0, why_not)
    return LineFind(status, why_not, np.full(2, nan), np.full((2, 2), nan), none, 0, nan)


def _profile(values: Float64, across_m: Float64, reach_m: float) -> tuple[Float64, Float64]:
    """Returns the median of the values in cells across, NaN where there are none, and the middles of the cells."""
    cells = round(2.0 * reach_m / _CELL_M)
    number = np.clip(((across_m + reach_m) / _CELL_M).astype(np.int64), 0, cells - 1)
    order = np.lexsort((values, number))
    sorted_numbers, sorted_values = number[order], values[order]
    first, count = np.searchsorted(sorted_numbers, np.arange(cells)), np.bincount(number, minlength=cells)
    profile, there = np.full(cells, np.nan), count > 0
    profile[there] = 0.5 * (
        sorted_values[first[there] + (count[there] - 1) // 2] + sorted_values[first[there] + count[there] // 2]
    )
    return profile, np.asarray((np.arange(cells) + 0.5) * _CELL_M - reach_m)


def _paint(grey: Float64, at_m: Float64) -> tuple[float, float, float] | str:
    """Returns place, no height, and contrast of the one painted line of a profile; why there is none."""
    known = np.isfinite(grey)
    if known.sum() < 10:
        return "missed"
    first, last = np.flatnonzero(known)[[0, -1]]
    at = at_m[first : last + 1]
    filled = np.interp(at, at_m[known], grey[known])
    surface = without_lines(filled[None], _CELL_M)[0]
    lines = [painted_line(filled, surface, at), painted_line(filled[::-1], surface[::-1], -at[::-1])]
    left, right = lines
    if left is None or right is None:
        return "missed"
    if abs(left.middle_m + right.middle_m) > _DOUBLED_M:
        return "doubled"
    return 0.5 * (left.middle_m - right.middle_m), float("nan"), left.contrast


def _kerb(height: Float64, at_m: Float64) -> tuple[float, float, float] | str:
    """Place of the face, height of the top and height of the face of a profile's one kerb; why there is none."""
    known = np.isfinite(height)
    if known.sum() < 10:
        return "missed"
    low, high = (_beside(height, known, side) for side in (-1, 1))
    step = np.nan_to_num(high - low)
    face = int(np.abs(step).argmax())
    size = abs(float(step[face]))
    if size < _STEP_M:
        return "missed"
    middle = 0.5 * float(low[face] + high[face])
    rising = (height - middle) * np.sign(step[face])
    near = known & (np.abs(at_m - at_m[face]) <= _BESIDE_M[1])
    below, above = at_m[near & (rising < 0.0)], at_m[near & (rising >= 0.0)]
    if not below.size or not above.size:
        return "missed"
    ends = (below.max(), above.min()) if step[face] > 0.0 else (below.min(), above.max())
    i, j = (int(np.abs(at_m - end).argmin()) for end in ends)
    share = (middle - height[i]) / (height[j] - height[i]) if height[j] != height[i] else 0.5
    place = float(at_m[i] + np.clip(share, 0.0, 1.0) * (at_m[j] - at_m[i]))
    return place, float(max(low[face], high[face])), size


def _beside(height: Float64, known: Bool, side: int) -> Float64:
    """Returns the median height beside each cell on one side; NaN with too few heights."""
    first, last = (round(metres / _CELL_M) for metres in _BESIDE_M)
    steps = np.arange(first, last + 1) * side
    rows = np.arange(height.size)[:, None] + steps
    inside = (rows >= 0) & (rows < height.size)
    values = np.where(inside, height[np.clip(rows, 0, height.size - 1)], np.nan)
    enough = np.isfinite(values).sum(axis=1) >= 2
    found = np.full(height.size, np.nan)
    found[enough] = np.nanmedian(values[enough], axis=1)
    return found
