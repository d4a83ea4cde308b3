"""Horizontal ties: shift of the relief or the paint of one traverse against that of another.

Registration of two images: the best correlation, its uniqueness, and the shift with its σ.

The shift is that of least squares on the images (Lucas and Kanade 1981), with the slopes of both. Its covariance is
made of two sums: the information, from products of one image's slopes with the other's, to which noise in the slopes
adds nothing, and the scatter of the scores (slope times residual) of blocks of cells, which counts whatever the noise
is, whether cells are correlated, and where it is larger (White 1980, clustered).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from roadscan.adjust.kernels.places import Laid, Splat, correlate, lay_upon, splat
from roadscan.adjust.places import SHIFT, End, Patch, Tie, level_from_map, map_from_axes
from roadscan.adjust.settings import TieSettings
from roadscan.compute.array_types import Float64, Int64

BLUR_CELLS: Final = 1.2
"""σ (cells) of the Gaussian that smooths images: else interpolation between cells would damp their noise and draw
shifts to half cells."""
_FILLED: Final = 0.3
"""A cell is seen if it has this share of the usual weight."""
_DEEPEST_M: Final = 0.05
"""Readings farther than this from the height of their cell (m) are not road."""
_EDGE_CELLS: Final = 3  # Edge of the square of cells around one that must all be seen.
_LEAST_CELLS: Final = 64  # An image with fewer cells is empty.
_FEW: Final = 2000
"""Readings on either side of the middle from which the spacing of readings is measured."""


@dataclass(frozen=True)
class Picture:
    """Relief (m) or intensity (standard deviations of the picture) of a patch."""

    value: Float64
    """(k, k; along, across) NaN where nothing was seen."""
    sampling_m2: Float64
    """(2, 2; along, across) variance of the position of an edge that runs along the grid of the readings."""


def pictures_of(patch: Patch, cell_m: float) -> tuple[Picture, Picture]:
    """Returns relief and intensity of a patch in cells of `cell_m`."""
    edge = max(round(2.0 * patch.place.radius_m / cell_m), 8)
    half, inside = 0.5 * edge * cell_m, patch.inside
    sums = Splat._make(np.zeros((edge, edge)) for _ in range(3))
    level = float(np.nanmedian(patch.height_m)) if patch.seen.any() else 0.0
    splat(
        inside.along_m + half, inside.across_m + half, inside.height_m, inside.intensity, inside.number,
        patch.height_m.ravel(), _DEEPEST_M, level, cell_m, sums,
    )  # fmt: skip
    relief, paint = _without_slow(sums.mass, (sums.height, sums.intensity))
    if np.isfinite(paint).any():
        paint = paint / max(float(np.nanstd(paint)), 1e-9)
    sampling = _sampling(patch)
    return Picture(relief, sampling), Picture(paint, sampling)


def _sampling(patch: Patch) -> Float64:
    """Returns the variance (2, 2) of an edge's position between readings: spacing² / 12, along a profile and beside it.

    An edge that runs along the grid is displaced by the same part of a step over its whole length, which no
    residual shows.
    """
    inside = patch.inside
    each = float(patch.seen.sum()) * patch.cell_m**2 / max(inside.pose.size, 1)
    few = slice(max(inside.pose.size // 2 - _FEW, 0), inside.pose.size // 2 + _FEW)
    along, across, pose = inside.along_m[few], inside.across_m[few], inside.pose[few]
    pair = np.diff(pose) == 0
    step = np.stack([np.diff(along)[pair], np.diff(across)[pair]], axis=-1)
    length = np.hypot(step[:, 0], step[:, 1])
    usual = float(np.median(length)) if length.size else math.sqrt(each)
    # Neighbours in a profile are closer than random neighbours.
    on_line = (length > 0.5 * usual) & (length < 2.0 * usual)
    if 2 * int(pair.sum()) < pair.size or usual <= 0.0 or not on_line.any() or usual**2 > 4.0 * each:
        return np.eye(2) * each / 12.0
    unit = np.linalg.eigh(step[on_line].T @ step[on_line])[1][:, 1]
    line = np.outer(unit, unit)
    return np.asarray((usual**2 * line + (each / usual) ** 2 * (np.eye(2) - line)) / 12.0)


def _without_slow(mass: Float64, totals: Sequence[Float64]) -> list[Float64]:
    """Returns smoothed values of cells minus a surface of the second degree; NaN where nothing was seen.

    A running mean would be one-sided at the rims, and its error would be the same in all images, as if nothing had
    moved.
    """
    from scipy.ndimage import gaussian_filter, minimum_filter

    pictures = [np.full(mass.shape, np.nan) for _ in totals]
    if not mass.any():
        return pictures
    fine_mass = gaussian_filter(mass, BLUR_CELLS, mode="constant", truncate=3.0)
    seen = minimum_filter(fine_mass > _FILLED * np.median(mass[mass > 0]), _EDGE_CELLS, mode="constant")
    row, column = np.nonzero(seen)
    if row.size < _LEAST_CELLS:
        return pictures
    x, y = row / (0.5 * len(mass)) - 1.0, column / (0.5 * len(mass)) - 1.0
    design = np.stack([np.ones(row.size), x, y, x * x, x * y, y * y])
    normal = design @ design.T
    for picture, total in zip(pictures, totals, strict=True):
        value = gaussian_filter(total, BLUR_CELLS, mode="constant", truncate=3.0)[seen] / fine_mass[seen]
        picture[seen] = value - np.linalg.lstsq(normal, design @ value, rcond=1e-12)[0] @ design
    return pictures


DISAGREE: Final = "relief and paint disagree"
_DISAGREE_SIGMA: Final = 5.0  # Relief and paint contradict one another from this many σ on.


KINDS_OF_PICTURES: Final = 2
"""Number of kinds: relief and paint."""


@dataclass
class Pictures:
    """Images of the patches of a place, each made on first use."""

    patches: list[Patch]
    settings: TieSettings
    _made: dict[int, tuple[Picture, Picture]] = field(default_factory=dict)

    def of(self, number: int) -> tuple[Picture, Picture]:
        """Returns relief and paint of a patch."""
        if number not in self._made:
            self._made[number] = pictures_of(self.patches[number], self.settings.shift_cell_m)
        return self._made[number]


def shift_ties(pictures: Pictures, first: int, second: int) -> list[Tie]:
    """Returns the ties of two patches of one place: up to two directions of the relief, and up to two of the paint.

    Where an image makes no tie, one row states why.
    """
    settings = pictures.settings
    pairs = zip(pictures.of(first), pictures.of(second), strict=True)
    shifts = [shift_of(one, other, settings) for one, other in pairs]
    relief, paint = shifts
    if not relief.why_not and not paint.why_not and disagree(relief, paint, _DISAGREE_SIGMA):
        shifts = [replace(s, why_not=DISAGREE) for s in shifts]
    ends = pictures.patches[first], pictures.patches[second]
    return [tie for group, shift in enumerate(shifts) for tie in _ties(*ends, shift, group + 1)]


def _ties(first: Patch, second: Patch, shift: Shift, group: int) -> list[Tie]:
    """Returns a tie for each direction that is known, or one that states why there is none."""
    place = first.place
    felt = shift.felt_m
    there = felt + np.nan_to_num(shift.value_m)
    heights = float(np.nanmedian(first.height_m)), float(np.nanmedian(second.height_m))
    ends = (
        End(first.readings, first.pose, map_from_axes(place, felt[:1], felt[1:], np.array(heights[:1]))[0]),
        End(second.readings, second.pose, map_from_axes(place, there[:1], there[1:], np.array(heights[1:]))[0]),
    )
    if not len(shift.directions):
        flat = np.array([1.0, 0.0, 0.0])
        return [Tie(SHIFT, ends, flat, math.nan, math.inf, shift.count, shift.correlation, shift.why_not, group)]
    out = []
    for unit, sigma in zip(shift.directions, shift.sigma_m, strict=True):
        on_map = map_from_axes(place, unit[:1], unit[1:], np.zeros(1)) - [place.easting_m, place.northing_m, 0.0]
        direction = level_from_map(on_map, first.readings.convergence_rad)[0]
        value = float(unit @ shift.value_m)
        out.append(
            Tie(SHIFT, ends, direction, value, float(sigma), shift.count, shift.correlation, shift.why_not, group)
        )
    return out


UNLIKE: Final = "pictures are not alike"
AT_EDGE: Final = "best shift at the edge of the search"
AMBIGUOUS: Final = "another shift fits as well"
FEATURELESS: Final = "no direction is known well enough"

_SAMPLES: Final = 2500
"""Approximate number of cells of the first image that are correlated."""
_STEP: Final = 2
"""Step of the search (cells): the images are smooth over more than that."""
_LEAST_SHARE: Final = 0.25  # Shifts with a smaller share of the cells in common are not correlated.
_LOBE_CELLS: Final = 4.0
"""Correlations within this distance (cells) of the best one, along the known directions, belong to its peak."""
_LEFT_OVER: Final = 2.0
"""A rival shift fails if it leaves this many times the variance that the best shift leaves."""
_ROUNDS: Final = 12  # Iterations of least squares, at most.
_DONE_CELLS: Final = 0.01  # Steps below this (cells) end the iteration.
_COARSE: Final = 3
"""Stride of the cells used (rows and columns) until a step is short."""
_NEAR_CELLS: Final = 0.05  # Steps above this (cells) use the coarse stride.
_ASTRAY_CELLS: Final = 4.0  # A shift farther than this from its start (cells) has diverged.
_HUBER: Final = 3.0  # Huber's limit for residuals (σ).
_BLOCK_CELLS: Final = 8  # Edge of the blocks whose scores are summed (cells).
_INDEPENDENT: Final = 4.0 * math.pi * (BLUR_CELLS**2 + 1.0 / 6.0)
"""Number of cells that count as one independent value: area under the correlation of smoothed noise (bilinear too)."""
_SHARP: Final = 9
"""Exponent of cos² 2θ: an edge that leaves the axes by some degrees crosses the readings' grid at many positions."""
_PRIOR_BLOCKS: Final = 4.0
"""Weight of the noise of the whole image beside the scatter of the blocks, in blocks."""


@dataclass(frozen=True)
class Shift:
    """The shift of the second image against the first."""

    value_m: Float64
    """(2,) along, across: position in the second image of a place of the first."""
    directions: Float64
    """(d,) unit vectors (along, across), d = 0, 1 or 2, in which it is known; components of it are independent."""
    sigma_m: Float64
    """(d,) 1 σ."""
    felt_m: Float64
    """(2,) along, across, from the middle of the image: weighted mean of the slopes that determine it."""
    correlation: float
    count: int
    """Cells in common."""
    why_not: str = ""
    """Test that it failed; empty if it passed."""


@dataclass(frozen=True)
class _Equations:
    """Sums at one shift; components in the order (row, column), cells."""

    step: Float64
    """(2,) to the solution."""
    common: Float64
    """(2, 2) information of slopes common to both images."""
    mean: Float64
    """(2, 2) information of the mean slopes."""
    score: Float64
    """(n, 2) of cells: slope times residual."""
    cell: Int64
    """(2, n) row and column of each."""
    expected: Float64
    """(2, 2) covariance of the sum of scores if the noise were the same everywhere."""
    felt: Float64
    """(2,) row and column."""
    aligned: float
    """Share, 0 to 1, of the slopes aligned with the axes of the place, beyond that of any texture."""
    correlation: float

    @property
    def scores(self) -> Float64:
        """Returns the covariance (2, 2) of the sum of scores: that of blocks, averaged with the expected one."""
        row, column = self.cell // _BLOCK_CELLS
        _, number = np.unique(row * 4096 + column, return_inverse=True)
        sums = np.stack([np.bincount(number, self.score[:, k]) for k in (0, 1)], axis=-1)
        squares = np.einsum("bi,bi->b", sums, sums)
        blocks = float(squares.sum() ** 2 / max(float(squares @ squares), 1e-300))
        return np.asarray((blocks * sums.T @ sums + _PRIOR_BLOCKS * self.expected) / (blocks + _PRIOR_BLOCKS))


def shift_of(one: Picture, other: Picture, settings: TieSettings) -> Shift:
    """Returns the shift between two images of one place in cells of `settings.shift_cell_m`."""
    first, second = one.value, other.value
    reach = int(settings.search_m / settings.shift_cell_m) // _STEP
    shifts = _STEP * np.arange(-reach, reach + 1)
    every = max(1, math.ceil(len(first) / math.sqrt(_SAMPLES)))
    least = int(_LEAST_SHARE * min(int(np.isfinite(picture).sum()) for picture in (first, second)) / every**2)
    likeness = np.empty((shifts.size, shifts.size))
    correlate(first, second, every, shifts, shifts, least, likeness)
    if not np.isfinite(likeness).any():
        return _nothing(UNLIKE, math.nan)
    row, column = np.unravel_index(int(np.nanargmax(likeness)), likeness.shape)
    best = float(likeness[row, column])
    if best < settings.least_correlation:
        return _nothing(UNLIKE, best)
    start = np.array([shifts[row], shifts[column]], dtype=np.float64)
    found = _refined(first, second, start)
    if found is None:
        return _nothing(FEATURELESS, best)
    place, sums = found
    shift = _known(place, sums, one.sampling_m2 + other.sampling_m2, len(first), settings)
    return shift if shift.why_not else _tested(likeness, shifts, start, shift, settings)


def _refined(first: Float64, second: Float64, start: Float64) -> tuple[Float64, _Equations] | None:
    """Least-squares shift (row, column; cells) near a start and the sums there; None where there is none."""
    place, edge = start.copy(), len(first)
    laid = Laid(np.empty((edge, edge)), np.empty((edge, edge, 2)), np.empty((edge, edge, 2)))
    found, coarse = None, True
    for turn in range(_ROUNDS):
        lay_upon(first, second, float(place[0]), float(place[1]), laid)
        sums = _equations(first, laid, _COARSE if coarse else 1)
        if sums is None:
            return None
        # A direction without information does not move.
        place = place + np.clip(sums.step, -1.0, 1.0)
        if np.abs(place - start).max() > _ASTRAY_CELLS:
            return None
        # In a direction that is hardly known the iteration need not converge.
        moved = math.sqrt(float(sums.step @ sums.mean @ sums.step) / max(float(np.trace(sums.mean)), 1e-300))
        if not coarse:
            found = place, sums
            if moved < _DONE_CELLS:
                break
        coarse = coarse and moved > _NEAR_CELLS and turn < _ROUNDS // 2
    return found


def _equations(first: Float64, laid: Laid, every: int) -> _Equations | None:
    """Returns sums over each `every`-th cell that both saw.

    Contrast and a surface of the second degree between the images are eliminated: each image lacks a surface
    that was fitted to what its traverse saw, and the two saw different parts of a rut.
    """
    row, column = (every * index for index in np.nonzero(np.isfinite(laid.left[::every, ::every])))
    if row.size < 64:
        return None
    left = laid.left[row, column]
    own, other = laid.first_slope[row, column][:, ::-1], laid.second_slope[row, column][:, ::-1]
    there = first[row, column] - left
    half = 0.5 * len(first)
    x, y = row / half - 1.0, column / half - 1.0
    nuisance = np.stack([np.ones(row.size), x, y, x * x, x * y, y * y, there], axis=-1)
    left, weight, sigma = _weighed(nuisance, left)
    weighted = nuisance * weight[:, None]
    stacked = np.concatenate([own, other], axis=1)
    part = np.linalg.lstsq(weighted.T @ nuisance, weighted.T @ stacked, rcond=1e-12)[0]
    slopes = stacked - nuisance @ part
    own, other = slopes[:, :2], slopes[:, 2:]
    mean_slope = 0.5 * (own + other)
    mean = (mean_slope * weight[:, None]).T @ mean_slope
    common = (own * weight[:, None]).T @ other
    score = mean_slope * (weight * left)[:, None]
    values, vectors = np.linalg.eigh(mean)
    known = values > 1e-4 * max(values[1], 1e-300)
    step = vectors[:, known] @ ((vectors[:, known].T @ score.sum(axis=0)) / values[known])
    energy = np.einsum("ni,ni->n", mean_slope, mean_slope)
    felt = np.array([energy @ row, energy @ column]) / max(energy.sum(), 1e-300)
    # cos 4θ = cos² 2θ − sin² 2θ; its odd power is sharp, and 0 in the mean over all directions.
    double = np.stack([mean_slope[:, 0] ** 2 - mean_slope[:, 1] ** 2, 2.0 * mean_slope[:, 0] * mean_slope[:, 1]])
    along_axes = (double[0] ** 2 - double[1] ** 2) / np.maximum(energy, 1e-300) ** 2
    aligned = float(np.clip((energy * along_axes**_SHARP).sum() / max(energy.sum(), 1e-300), 0.0, 1.0))
    a, b = first[row, column], there
    a, b = a - a.mean(), b - b.mean()
    correlation = float(a @ b / max(math.sqrt(float(a @ a) * float(b @ b)), 1e-300))
    expected = sigma**2 * _INDEPENDENT * mean
    return _Equations(
        step, 0.5 * (common + common.T), mean, score, np.stack([row, column]), expected, felt, aligned, correlation
    )


def _weighed(nuisance: Float64, left: Float64) -> tuple[Float64, Float64, float]:
    """Returns residuals without contrast and surface; Huber's weights (n,); 1 σ of the residuals."""
    weight = np.ones(left.size)
    for _ in range(2):
        weighted = nuisance * weight[:, None]
        left = left - nuisance @ np.linalg.lstsq(weighted.T @ nuisance, weighted.T @ left, rcond=1e-12)[0]
        sigma = math.sqrt(float(weight @ left**2) / float(weight.sum()))
        weight = np.minimum(1.0, _HUBER * sigma / np.maximum(np.abs(left), 1e-300))
    return left, weight, sigma


def _known(place: Float64, sums: _Equations, sampling_m2: Float64, edge: int, settings: TieSettings) -> Shift:
    """Returns the shift in metres, and the directions in which it is known."""
    cell = settings.shift_cell_m
    directions, sigma = _directions(sums, settings.coherence)
    common = sums.aligned * np.einsum("di,ij,dj->d", directions, sampling_m2, directions)
    sigma = np.sqrt((sigma * cell) ** 2 + common + settings.shift_floor_m**2)
    good = sigma <= settings.most_shift_sigma_m
    felt = (sums.felt + 0.5 - 0.5 * edge) * cell
    why = "" if good.any() else FEATURELESS
    return Shift(place * cell, directions[good], sigma[good], felt, sums.correlation, len(sums.score), why)


def _directions(sums: _Equations, coherence: float) -> tuple[Float64, Float64]:
    """Returns unit vectors (d, 2) of independent components of the shift and their σ (d,), cells.

    With information `common` and scores of covariance S, the shift's error is common⁻¹ · score. Where one direction
    has more noise than slopes in common, only the component along the other one remains.
    """
    values, scores = np.linalg.eigvalsh(sums.mean), sums.scores
    if values[1] <= 0.0:
        return np.zeros((0, 2)), np.zeros(0)
    steady = sums.mean + 1e-9 * values[1] * np.eye(2)
    lower = np.linalg.inv(np.linalg.cholesky(steady))
    share, turn = np.linalg.eigh(lower @ sums.common @ lower.T)
    kept = (lower.T @ turn)[:, (share >= coherence)]
    if kept.shape[1] == 2:
        inverse = np.linalg.inv(sums.common)
        variance, vectors = np.linalg.eigh(inverse @ scores @ inverse)
        return vectors.T, np.sqrt(np.maximum(variance, 0.0))
    along = sums.common @ kept
    length = np.linalg.norm(along, axis=0)
    variance = np.einsum("id,ij,jd->d", kept, scores, kept)
    return (along / length).T, np.sqrt(np.maximum(variance, 0.0)) / length


def _tested(likeness: Float64, shifts: Int64, start: Float64, shift: Shift, settings: TieSettings) -> Shift:
    """Returns a shift that lies inside the search, in the directions in which no other one fits as well."""
    if (np.abs(shift.directions @ (shift.value_m / settings.shift_cell_m)) > shifts[-1] - _STEP).any():
        return replace(shift, why_not=AT_EDGE)
    if np.abs(start).max() >= shifts[-1] and len(shift.directions) == 2:
        return replace(shift, why_not=AT_EDGE)
    best = float(np.nanmax(likeness))
    # A rival leaves little more unexplained than the best shift does.
    least = max(settings.rival_share * best, math.sqrt(max(1.0 - _LEFT_OVER * (1.0 - best**2), 0.0)))
    single = np.ones(len(shift.directions), bool)
    for r, c in zip(*(n.tolist() for n in np.nonzero(np.nan_to_num(likeness, nan=-1.0) >= least)), strict=True):
        if _is_summit(likeness, r, c):
            single &= np.abs(shift.directions @ (np.array([shifts[r], shifts[c]]) - start)) <= _LOBE_CELLS
    if not single.any():
        return replace(shift, why_not=AMBIGUOUS)
    return replace(shift, directions=shift.directions[single], sigma_m=shift.sigma_m[single])


def _is_summit(likeness: Float64, row: int, column: int) -> bool:
    """Returns whether no neighbour correlates better."""
    around = likeness[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
    return bool(likeness[row, column] >= np.nanmax(around))


def _nothing(why_not: str, correlation: float) -> Shift:
    return Shift(np.full(2, np.nan), np.zeros((0, 2)), np.zeros(0), np.zeros(2), correlation, 0, why_not)


def disagree(one: Shift, other: Shift, limit: float) -> bool:
    """Returns whether two shifts of one pair differ by more than `limit` σ in a direction that both know."""
    for (u, s), (v, t) in itertools.product(
        zip(one.directions, one.sigma_m, strict=True), zip(other.directions, other.sigma_m, strict=True)
    ):
        if abs(float(u @ v)) > 0.9 and abs(float(u @ (one.value_m - other.value_m))) > limit * math.hypot(s, t):
            return True
    return False
