"""Search of a painted control target in the intensities of one pass.

Places that look like the target (:mod:`candidates`) are tested by the shares of paint, outline and clear road that
it should have (:mod:`evidence`), its shape is fitted to the readings (:mod:`fit`), and the shares are tested again at
the fitted place. One place that passes is the target; two are ambiguous. Its height is that of a surface through the
readings at its centre (:mod:`heights`).

Candidates for a target: places where a grid of intensities correlates with the shape.

Mean and contrast are those of each place's surroundings, and cells without a reading do not count (Padfield 2012,
masked normalised cross-correlation). A chequered target may be turned in any way: its picture is correlated with the
second harmonic of the direction from the middle, whose phase is twice the turn.

Evidence that a place shows the shape: shares of paint, outline and clear road.

A value is paint where it lies above the middle between road and paint. Shares, and not sums of residuals, distinguish
worn paint from no paint: wear reduces each share by a part, while another thing lacks one of them altogether.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roadscan.adjust.settings import TargetSettings
from roadscan.adjust.targets.fit import ShapeFit, first_levels, fit_radius_m, fit_shape
from roadscan.adjust.targets.shapes import (
    Cells,
    Chequered,
    Disc,
    ExpectedTarget,
    Shape,
    Status,
    TargetFind,
    TargetPicture,
    TargetReadings,
    cells_of,
    height_at,
    spacing_m,
)
from roadscan.compute.array_types import Bool, Float64

_SURROUNDINGS = 1.4
"""Radius of the area that is correlated with a disc, in radii of the disc."""
_LEAST_SEEN = 0.6
"""Share of the cells under the shape that must have readings."""
_APART = 0.4
"""Candidates nearer to a likelier one than this share of the size are dropped."""


@dataclass(frozen=True)
class Candidate:
    """A place that may be the target."""

    centre_m: Float64
    """(2,) east and north."""
    turn_rad: float
    """Of a chequered target, east to north; 0 for a disc."""
    likeness: float
    """Normalised correlation."""


def candidates(cells: Cells, cell_m: float, shape: Shape, radius_m: float, least: float, most: int) -> list[Candidate]:
    """Returns places within a radius of the origin that look like the shape, the likeliest first.

    cells : means by the cells of an even grid of `cell_m` through the origin.
    """
    half = _SURROUNDINGS * shape.half_m if isinstance(shape, Disc) else shape.half_m
    reach = int(np.ceil(radius_m / cell_m)) + int(np.ceil(half / cell_m)) + 1
    value, seen = _grid(cells, cell_m, reach)
    likeness, turn = _likeness(value, seen, shape, cell_m)
    middle = (np.arange(-reach, reach) + 0.5) * cell_m
    likeness[np.hypot(middle[None], middle[:, None]) > radius_m] = 0.0
    found: list[Candidate] = []
    while len(found) < most:
        row, column = np.unravel_index(int(np.argmax(likeness)), likeness.shape)
        if likeness[row, column] < least:
            break
        centre = np.array([middle[column], middle[row]])
        found.append(Candidate(centre, float(turn[row, column]), float(likeness[row, column])))
        near = np.hypot(middle[None] - centre[0], middle[:, None] - centre[1]) < _APART * 2 * shape.half_m
        likeness[near] = 0.0
    return found


def _grid(cells: Cells, cell_m: float, reach: int) -> tuple[Float64, Float64]:
    """Returns intensities (2 reach, 2 reach) less their mean, and 1 where there are any; rows to the north."""
    index = np.floor(cells.place_m / cell_m).astype(np.int64) + reach
    inside = np.all((index >= 0) & (index < 2 * reach), axis=1)
    column, row = index[inside].T
    value, seen = np.zeros((2, 2 * reach, 2 * reach))
    seen[row, column] = 1.0
    level = cells.value[inside]
    value[row, column] = level - (level.mean() if level.size else 0.0)
    return value, seen


def _likeness(value: Float64, seen: Float64, shape: Shape, cell_m: float) -> tuple[Float64, Float64]:
    """Returns the correlation of each place's surroundings with the shape, and the turn."""
    from scipy import fft

    half = shape.half_m * (_SURROUNDINGS if isinstance(shape, Disc) else 1.0)
    steps = int(np.ceil(half / cell_m))
    axis = np.arange(-steps, steps + 1) * cell_m
    r = np.hypot(axis[None], axis[:, None])
    support = (r <= half).astype(np.float64)
    size = fft.next_fast_len(value.shape[0] + 2 * steps, real=True)
    spectra = [fft.rfft2(image, (size, size)) for image in (value, value * value, seen)]

    def summed(which: int, weights: Float64) -> Float64:
        product = spectra[which] * np.conj(fft.rfft2(weights, (size, size)))
        around = fft.irfft2(product, (size, size))
        places: Float64 = np.roll(around, (steps, steps), (0, 1))[: value.shape[0], : value.shape[1]]
        return places

    number = summed(2, support)
    enough = number > _LEAST_SEEN * support.sum()
    number = np.maximum(number, 1.0)
    total = summed(0, support)
    spread = np.sqrt(np.maximum(summed(1, support) - total * total / number, 1e-9))
    if isinstance(shape, Disc):
        white = np.clip((shape.half_m - r) / cell_m + 0.5, 0.0, 1.0)
        white -= np.clip((shape.centre_m / 2 - r) / cell_m + 0.5, 0.0, 1.0)
        under = summed(2, white)
        contrast = np.sqrt(np.maximum(summed(2, white * white) - under * under / number, 1e-9))
        alike = (summed(0, white) - total * under / number) / (spread * contrast)
        return np.where(enough, alike, 0.0), np.zeros_like(alike)
    twice = 2.0 * np.arctan2(axis[:, None], axis[None])
    cos = summed(0, support * np.cos(twice)) - total * summed(2, support * np.cos(twice)) / number
    sin = summed(0, support * np.sin(twice)) - total * summed(2, support * np.sin(twice)) / number
    alike = np.hypot(cos, sin) / (spread * np.sqrt(number / 2.0))
    return np.where(enough, alike, 0.0), 0.5 * np.arctan2(-cos, sin)


_SECTORS = 24  # Sectors around the centre in which an outline is sought.
_TOLERANCE = 0.05
"""Tolerance of an outline's place, as a share of the radius, besides half of the readings' distance."""
_LEAST_PER_SECTOR = 4  # A sector needs this many readings.
_LEAST_IN_CENTRE = 4  # The centre needs this many readings.
_WORN = 0.35
"""Weight of road within the outline against white beyond it, and share of paint that still makes a block white."""
_BLOCKS = 3
"""Number of blocks along an edge of a quadrant."""
_OF_PAINT = 0.75
"""Least ratio of the outline's share to the share of paint: where paint is not worn, the whole outline shows."""


@dataclass(frozen=True)
class Evidence:
    """Shares of the shape that are seen, 0 to 1."""

    paint: float
    """Of the area that should be white."""
    outline: float
    """Of the outline."""
    clear: float
    """Of what should not be white: around the shape, its dark centre, its dark quadrants; the least of them."""

    @property
    def score(self) -> float:
        """Returns the least share."""
        return min(self.paint, self.outline, self.clear)

    def fault(self, settings: TargetSettings, *, slack: float = 1.0) -> str:
        """Returns what is missing, "" if nothing; slack : share of the limits that suffices."""
        limits = (
            (self.paint, settings.least_paint, "of the painted area shows paint"),
            (
                self.outline,
                max(settings.least_outline, _OF_PAINT * self.paint),
                "of the outline lies where the shape has it",
            ),
            (self.clear, settings.least_clear, "of what should be unpainted is so"),
        )
        for share, least, what in limits:
            if share < slack * least:
                return f"only {share:.0%} {what}"
        return ""


def evidence(
    cells: Cells, shape: Shape, centre_m: Float64, turn_rad: float, threshold: float, slack_m: float
) -> Evidence:
    """Returns the shares of a shape with its middle at a place.

    Parameters
    ----------
    cells : intensities by place. centre_m : (2,). turn_rad : of a chequered target.
    threshold : intensity halfway between road and paint. slack_m : by which outlines may miss, besides 5 %.
    """
    away, white = cells.place_m - centre_m, cells.value > threshold
    if isinstance(shape, Disc):
        return _of_disc(away, white, shape, slack_m)
    return _of_chequered(away, white, shape, turn_rad)


def _share(which: Bool, of: Bool) -> float:
    return float(which[of].mean()) if of.any() else 0.0


def _of_disc(away: Float64, white: Bool, shape: Disc, slack_m: float) -> Evidence:
    r, half, centre = np.hypot(*away.T), shape.half_m, shape.centre_m / 2
    clear = _share(~white, (r > half + slack_m) & (r > 1.1 * half) & (r < 1.4 * half))
    inside = r < 0.75 * centre
    if inside.sum() >= _LEAST_IN_CENTRE:
        clear = min(clear, _share(~white, inside))
    paint = _share(white, (r < 0.9 * half) & (r > 1.25 * centre))
    tolerance = _TOLERANCE * half + slack_m
    azimuth = np.arctan2(away[:, 1], away[:, 0])
    sector = np.minimum(((azimuth / np.pi + 1.0) / 2.0 * _SECTORS).astype(np.int64), _SECTORS - 1)
    band = np.flatnonzero((r > max(0.5 * half, 1.1 * centre)) & (r < 1.5 * half))
    band = band[np.lexsort((r[band], sector[band]))]
    ends = np.searchsorted(sector[band], np.arange(_SECTORS + 1))
    pieces = (band[first:last] for first, last in itertools.pairwise(ends))
    good = sum(_edge_near(r[piece], white[piece], half, tolerance) for piece in pieces)
    return Evidence(paint, good / _SECTORS, clear)


def _edge_near(r: Float64, white: Bool, half_m: float, tolerance_m: float) -> bool:
    """Returns whether the radius that best separates white from other values is that of the outline; radii ascend.

    White beyond it counts more than road within it, which may be worn paint.
    """
    if r.size < _LEAST_PER_SECTOR:
        return False
    gain = np.append(0.0, np.cumsum(np.where(white, 1.0, -_WORN)))
    most = gain.max()
    best = np.flatnonzero(gain >= most - 1e-9)
    ends = np.concatenate([r[:1], r, r[-1:]])
    low, high = float(ends[best[0]]), float(ends[best[-1] + 1])
    here = low - tolerance_m <= half_m <= high + tolerance_m
    return bool(most >= _LEAST_PER_SECTOR / 2 and here and high - low < 4 * tolerance_m)


def _of_chequered(away: Float64, white: Bool, shape: Chequered, turn_rad: float) -> Evidence:
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)
    u, v = (away @ np.array([[cos, -sin], [sin, cos]]) / shape.half_m).T
    largest = np.maximum(np.abs(u), np.abs(v))
    clear = _share(~white, (largest > 1.12) & (largest < 1.4))
    inside = (largest < 0.96) & (np.minimum(np.abs(u), np.abs(v)) > 0.04)
    block = np.minimum((np.abs(np.stack([u, v])) * _BLOCKS).astype(np.int64), _BLOCKS - 1)
    quadrant = 2 * (v > 0) + (u > 0)
    number = np.where(inside, (quadrant * _BLOCKS + block[1]) * _BLOCKS + block[0], -1)[inside]
    right = (white == (u * v > 0))[inside]
    seen = np.bincount(number, minlength=4 * _BLOCKS**2)
    share = np.bincount(number, right, minlength=4 * _BLOCKS**2).reshape(4, -1) / np.maximum(seen, 1).reshape(4, -1)
    agree = share >= np.array([_WORN, 0.5, 0.5, _WORN])[:, None]
    weakest = float(agree.mean(axis=1).min())
    paint = _share(white, inside & (u * v > 0))
    return Evidence(paint, weakest, min(clear, _share(~white, inside & (u * v < 0))))


_PIXELS_PER_SIZE = 48  # Pixels across half the size of a target.
_MOST_PIXELS = 192  # Largest edge of an image (pixels).
_DARKEST, _BRIGHTEST = 1.0, 99.5
"""Percentiles of the intensity that become black and white."""


def picture_of(
    place_m: Float64, value: Float64, half_width_m: float, shape: Shape, outlines: Float64, origin_m: Float64
) -> TargetPicture:
    """Returns the image of a square around a centre, with the outline of a shape dashed in white and black.

    Parameters
    ----------
    place_m : (n, 2) of readings, from the middle (m); value : (n,) intensities.
    half_width_m : half of the square's edge.
    outlines : (k, 4) east, north (m, from the middle), turn (rad), size over the stated size, of each shape found.
    origin_m : (2,) map coordinates of the middle.
    """
    from scipy.ndimage import distance_transform_edt

    pixels = int(np.clip(round(half_width_m / shape.half_m * _PIXELS_PER_SIZE), 24, _MOST_PIXELS))
    cell = 2.0 * half_width_m / pixels
    inside = np.all(np.abs(place_m) < half_width_m, axis=1)
    column = ((place_m[inside, 0] + half_width_m) / cell).astype(np.int64).clip(0, pixels - 1)
    row = ((half_width_m - place_m[inside, 1]) / cell).astype(np.int64).clip(0, pixels - 1)
    number = row * pixels + column
    count = np.bincount(number, minlength=pixels**2).reshape(pixels, pixels)
    total = np.bincount(number, value[inside], minlength=pixels**2).reshape(pixels, pixels)
    grey = np.zeros((pixels, pixels), np.uint8)
    if inside.any():
        mean = total / np.maximum(count, 1)
        nearest = distance_transform_edt(count == 0, return_distances=False, return_indices=True)
        mean = mean[tuple(nearest)]
        low, high = np.percentile(mean, [_DARKEST, _BRIGHTEST])
        grey = np.clip(np.rint((mean - low) / max(high - low, 1e-9) * 255.0), 0, 255).astype(np.uint8)
    for outline in outlines:
        _draw(grey, _outline(shape, outline), half_width_m, cell)
    west, north = float(origin_m[0]) - half_width_m, float(origin_m[1]) + half_width_m
    return TargetPicture(grey, west, north, cell)


def _outline(shape: Shape, outline: Float64) -> Float64:
    """Returns (m, 2) points along the outline and across the middle."""
    east, north, turn, scale = outline
    half = shape.half_m * scale
    along = np.linspace(-1.0, 1.0, 8 * _PIXELS_PER_SIZE)
    cross = 0.15 * half * along
    zero = np.zeros_like(along)
    if isinstance(shape, Disc):
        around = np.stack([half * np.cos(np.pi * along), half * np.sin(np.pi * along)], axis=-1)
    else:
        sides = [(along, zero + 1), (zero + 1, -along), (-along, zero - 1), (zero - 1, along)]
        around = np.concatenate([half * np.stack(side, axis=-1) for side in sides])
    points = np.concatenate([around, np.stack([cross, zero], axis=-1), np.stack([zero, cross], axis=-1)])
    cos, sin = np.cos(turn), np.sin(turn)
    turned: Float64 = points @ np.array([[cos, sin], [-sin, cos]]) + [east, north]
    return turned


def _draw(grey: npt.NDArray[np.uint8], points: Float64, half_width_m: float, cell_m: float) -> None:
    """Set the pixels along points to white and black in turns."""
    column = np.floor((points[:, 0] + half_width_m) / cell_m).astype(np.int64)
    row = np.floor((half_width_m - points[:, 1]) / cell_m).astype(np.int64)
    inside = (column >= 0) & (row >= 0) & (column < grey.shape[1]) & (row < grey.shape[0])
    column, row = column[inside], row[inside]
    grey[row, column] = np.where((row + column) // 3 % 2 == 0, 255, 0)


_GRID_CELLS = 24
"""Cells of the search's grid along the size of a shape, where readings are dense enough."""
_FIT_CELLS = 75
"""Cells of the fit along the size."""
_LEAST_READINGS = 8
"""Least number of readings along the size: with fewer there is no outline."""
_OVERLAP = 0.9
"""Two targets are at least this share of the size apart."""
_WANDERS = 0.25
"""Farthest that a fit may end from its start, as a share of the size."""
_EASED = 0.6
"""Share of the limits that a candidate must reach before the fit."""


@dataclass(frozen=True)
class _Held:
    """A place that passes as the target."""

    fit: ShapeFit
    evidence: Evidence


def find_target(points: TargetReadings, expected: ExpectedTarget, settings: TargetSettings) -> TargetFind:
    """Returns the target near its stated place, or why it is not found."""
    return _Search(points, expected, settings).find()


class _Search:
    """Readings around the stated place, and the criteria of the search."""

    def __init__(self, points: TargetReadings, expected: ExpectedTarget, settings: TargetSettings) -> None:
        self.points, self.expected, self.settings, self.shape = points, expected, settings, expected.shape
        self.origin_m = np.array([expected.easting_m, expected.northing_m])
        place = np.stack([points.easting_m, points.northing_m], axis=-1) - self.origin_m
        near = np.hypot(*place.T) <= settings.search_radius_m + 1.2 * fit_radius_m(self.shape)
        self.place_m = place[near]
        self.value = points.intensity[near].astype(np.float64)
        self.size_m = 2.0 * self.shape.half_m

    def find(self) -> TargetFind:
        """Returns the target, or why there is none."""
        spacing = spacing_m(self.place_m, self.size_m / 4) if self.value.size else float("inf")
        if self.value.size < _LEAST_READINGS**2:
            return self._not("missed", f"{self.value.size} readings near its stated place")
        if spacing > self.size_m / _LEAST_READINGS:
            return self._not("missed", f"readings lie {spacing * 1e3:.0f} mm apart, too far for its outline")
        held, fault = self._held(spacing)
        if not held:
            return self._not("missed", fault)
        if len(held) > 1:
            away = float(np.hypot(*(held[0].fit.centre_m - held[1].fit.centre_m)))
            return self._found(held, "doubled", f"{len(held)} places look like it, {away:.2f} m apart")
        return self._found(held, *self._moved(held[0].fit))

    def _held(self, spacing: float) -> tuple[list[_Held], str]:
        """Returns places that pass, the best first, and why the likeliest one did not."""
        settings, cell = self.settings, max(1.25 * spacing, self.size_m / _GRID_CELLS)
        coarse = cells_of(self.place_m, self.value, cell)
        likely = candidates(
            coarse, cell, self.shape, settings.search_radius_m, settings.least_likeness, settings.most_candidates
        )
        held: list[_Held] = []
        faults = []
        for candidate in likely:
            if any(self._overlap(one.fit.centre_m, candidate.centre_m) for one in held):
                continue
            found, fault = self._examined(candidate, spacing, cell)
            faults.append(fault)
            if found is not None and not any(self._overlap(o.fit.centre_m, found.fit.centre_m) for o in held):
                held.append(found)
        held.sort(key=lambda one: -one.evidence.score)
        return held, faults[0] if faults else "nothing near its stated place looks like it"

    def _overlap(self, first_m: Float64, second_m: Float64) -> bool:
        """Returns whether two places are too close to be two targets."""
        return bool(np.hypot(*(first_m - second_m)) < _OVERLAP * self.size_m)

    def _examined(self, candidate: Candidate, spacing: float, cell: float) -> tuple[_Held | None, str]:
        """Returns a fitted candidate, or its fault."""
        settings, shape, fine_m = self.settings, self.shape, self.size_m / _FIT_CELLS
        fine = self._cells_around(candidate.centre_m, fine_m)
        near = fine.within(candidate.centre_m, fit_radius_m(shape))
        threshold = first_levels(near, shape, candidate.centre_m).threshold
        rough = evidence(near, shape, candidate.centre_m, candidate.turn_rad, threshold, 1.5 * cell)
        if fault := rough.fault(settings, slack=_EASED):
            return None, fault
        fit = fit_shape(fine, shape, candidate.centre_m, candidate.turn_rad, max(spacing, fine_m))
        if fit is None or self._wandered(fit, candidate):
            return None, "no shape of its kind fits the readings"
        stands_out = fit.levels.contrast / max(fit.levels.noise, 1e-9)
        if stands_out < settings.least_contrast:
            return None, f"paint stands out by {stands_out:.1f} σ of the readings"
        if abs(fit.scale - 1.0) > settings.size_tolerance:
            return None, f"the shape there is {fit.scale * self.size_m:.3f} m across"
        near = fine.within(fit.centre_m, fit_radius_m(shape))
        shown = evidence(near, shape, fit.centre_m, fit.turn_rad, fit.levels.threshold, 0.5 * spacing)
        fault = shown.fault(settings)
        return (None, fault) if fault else (_Held(fit, shown), "")

    def _cells_around(self, centre_m: Float64, cell_m: float) -> Cells:
        """Returns small cells of all that a fit from a place can need."""
        reach = fit_radius_m(self.shape) + _WANDERS * self.size_m
        near = np.all(np.abs(self.place_m - centre_m) <= reach, axis=1)
        return cells_of(self.place_m[near], self.value[near], cell_m)

    def _wandered(self, fit: ShapeFit, candidate: Candidate) -> bool:
        """Returns whether a fit left its candidate, or the searched area."""
        away = np.hypot(*(fit.centre_m - candidate.centre_m))
        return bool(away > _WANDERS * self.size_m or np.hypot(*fit.centre_m) > self.settings.search_radius_m)

    def _moved(self, fit: ShapeFit) -> tuple[Status, str]:
        expected, points, settings = self.expected, self.points, self.settings
        variance = expected.sigma_horizontal_m**2 + points.sigma_horizontal_m**2 + settings.sigma_paint_m**2
        covariance = fit.covariance_m2 + variance * np.eye(2)
        away = fit.centre_m
        sigmas = float(np.sqrt(away @ np.linalg.solve(covariance, away)))
        if sigmas <= settings.moved_sigmas:
            return "found", ""
        return "moved", f"found {np.hypot(*away):.3f} m from its stated place, {sigmas:.1f} σ"

    def _found(self, held: Sequence[_Held], status: Status, why_not: str) -> TargetFind:
        fit, shown = held[0].fit, held[0].evidence
        easting, northing = (self.origin_m + fit.centre_m).tolist()
        height = height_at(self.points, easting, northing, self.settings)
        turned = isinstance(self.shape, Chequered)
        return TargetFind(
            name=self.expected.name,
            status=status,
            why_not=why_not,
            easting_m=easting,
            northing_m=northing,
            height_m=height.height_m,
            covariance_m2=fit.covariance_m2 + self.settings.sigma_paint_m**2 * np.eye(2),
            sigma_height_m=height.sigma_m,
            count=fit.count,
            contrast=fit.levels.contrast,
            noise=fit.levels.noise,
            score=shown.score,
            diameter_m=fit.scale * self.size_m,
            azimuth_rad=-fit.turn_rad % np.pi if turned else 0.0,
            others_m=np.array([self.origin_m + one.fit.centre_m for one in held[1:]]).reshape(-1, 2),
            picture=self._picture(held),
        )

    def _not(self, status: Status, why_not: str) -> TargetFind:
        nan = float("nan")
        return TargetFind(
            name=self.expected.name, status=status, why_not=why_not, easting_m=nan, northing_m=nan, height_m=nan,
            covariance_m2=np.full((2, 2), nan), sigma_height_m=nan, count=0, contrast=nan, noise=nan, score=0.0,
            diameter_m=nan, azimuth_rad=nan, others_m=np.zeros((0, 2)), picture=self._picture([]),
        )  # fmt: skip

    def _picture(self, held: Sequence[_Held]) -> TargetPicture:
        """Returns an image of the target's surroundings; where it is missed or doubled, of the whole search."""
        wide = self.settings.search_radius_m + self.shape.reach_m
        middle, half = np.zeros(2), wide
        if len(held) == 1:
            middle, half = held[0].fit.centre_m, min(2.0 * self.shape.reach_m, wide)
        outlines = np.array([[*(o.fit.centre_m - middle), o.fit.turn_rad, o.fit.scale] for o in held])
        return picture_of(
            self.place_m - middle, self.value, half, self.shape, outlines.reshape(-1, 4), self.origin_m + middle
        )
