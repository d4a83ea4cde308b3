"""Height ties: distance of the surface of one traverse above that of another, along the normal of the road.

A road falls to its side, so passes that lie a centimetre beside each other differ in height by a quarter of a
millimetre at 2.5 %. So what is tied is the distance along the surface's normal (point to plane; Chen and Medioni 1992),
and the adjustment knows of the fall through the direction of the tie.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.adjust.patches import Patch, level_from_map, map_from_axes
from roadscan.adjust.tie_settings import TieSettings
from roadscan.adjust.ties.tie import COUNTS, FEW_CELLS, HEIGHT, SCATTERED, STEEP, TOO_FAR, TWO_SURFACES, End, Tie
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.robust import scatter_about

_BLOCKS: Final = 6
"""Blocks along an edge whose means give the σ of a mean over the patch."""
_LEAST_BLOCKS: Final = 6  # From this many filled blocks on, the scatter of their means gives σ.
_UNEVEN: Final = 2.0
"""Slope hidden from the fitted plane by a step of unevenness, in RMS of the unevenness over the patch's edge."""


@dataclass(frozen=True)
class _Difference:
    """Height differences of two patches in the cells that both saw and that agree."""

    used: Bool
    """(k, k)"""
    share: float
    """Of the common cells."""
    scatter_m: float
    mean_m: float
    """Second − first."""
    sigma_m: float


def height_tie(first: Patch, second: Patch, settings: TieSettings) -> Tie:
    """Returns the tie of two patches of one place with equal cells; the direction is the normal, upwards.

    A tie that fails its tests states why: too few common cells, farther apart than the bound, too few cells that
    agree, differences that scatter, a surface that is too steep.
    """
    away = second.height_m - first.height_m
    common = np.isfinite(away)
    if int(common.sum()) < settings.least_cells:
        return _refused(first, second, FEW_CELLS, int(common.sum()))
    found = _difference(away, common, settings)
    mean = np.where(found.used, 0.5 * (first.height_m + second.height_m), np.nan)
    plane, uneven_m = _plane(first, mean, found.used)
    lift = 1.0 / math.sqrt(1.0 + plane[1] ** 2 + plane[2] ** 2)
    extent = len(mean) * first.cell_m
    aligned = _UNEVEN * uneven_m / extent * settings.misplaced_m
    sigma = lift * math.sqrt(found.sigma_m**2 + aligned**2 + settings.sigma_floor_m**2)
    ends = _ends(first, second, found.used)
    place, readings = first.place, first.readings
    up = map_from_axes(place, -plane[1:2], -plane[2:3], np.ones(1)) - [place.easting_m, place.northing_m, 0.0]
    direction = level_from_map(up * lift, readings.convergence_rad)[0]
    return Tie(
        HEIGHT, ends, direction, lift * found.mean_m, sigma, int(found.used.sum()), math.nan,
        _why_not(found, math.hypot(plane[1], plane[2]), settings),
    )  # fmt: skip


def _difference(away: Float64, common: Bool, settings: TieSettings) -> _Difference:
    """Robust mean of height differences, with a σ from the means of blocks, which shows correlated cells."""
    values = away[common]
    middle = float(np.median(values))
    scatter = scatter_about(values, middle)
    limit = settings.outlying * max(scatter, settings.sigma_floor_m)
    used = common & (np.abs(np.where(common, away, np.inf) - middle) <= limit)
    mean = float(away[used].mean())
    sums = np.bincount(_blocks(used), away[used] - mean, _BLOCKS**2)
    count = np.bincount(_blocks(used), minlength=_BLOCKS**2)
    filled, number = int((count > 0).sum()), int(used.sum())
    if filled >= _LEAST_BLOCKS:
        sigma = math.sqrt(float(sums @ sums) * filled / (filled - 1)) / number
    else:
        # The cells of a block count as one.
        sigma = scatter / math.sqrt(max(filled, 1))
    return _Difference(used, number / int(common.sum()), scatter, mean, sigma)


def _blocks(used: Bool) -> Int64:
    """Returns the block of each used cell."""
    row, column = np.nonzero(used)
    edge = len(used)
    return np.asarray(row * _BLOCKS // edge * _BLOCKS + column * _BLOCKS // edge)


def _plane(patch: Patch, height_m: Float64, used: Bool) -> tuple[Float64, float]:
    """Level and slopes (3,) along and across of a plane through heights, and its residuals' RMS by blocks (m)."""
    row, column = np.nonzero(used)
    along, across = patch.middle_m[row], patch.middle_m[column]
    design = np.stack([np.ones(row.size), along, across], axis=-1)
    level = height_m[used].mean()
    plane, *_ = np.linalg.lstsq(design, height_m[used] - level, rcond=None)
    left = height_m[used] - level - design @ plane
    count = np.bincount(_blocks(used), minlength=_BLOCKS**2)
    mean = np.bincount(_blocks(used), left, _BLOCKS**2)[count > 0] / count[count > 0]
    plane[0] += level
    return plane, float(np.sqrt(np.mean(mean**2)))


def _ends(first: Patch, second: Patch, used: Bool) -> tuple[End, End]:
    """Returns the middle of the used cells, as each traverse sees it."""
    row, column = np.nonzero(used)
    along, across = first.middle_m[row].mean(keepdims=True), first.middle_m[column].mean(keepdims=True)
    one, other = (
        End(p.readings, p.pose, map_from_axes(first.place, along, across, p.height_m[used].mean(keepdims=True))[0])
        for p in (first, second)
    )
    return one, other


def _why_not(found: _Difference, slope: float, settings: TieSettings) -> str:
    tests = (
        (abs(found.mean_m) > settings.most_apart_m, TOO_FAR),
        (int(found.used.sum()) < settings.least_cells, FEW_CELLS),
        (found.share < settings.least_share, TWO_SURFACES),
        (found.scatter_m > settings.most_scatter_m, SCATTERED),
        (slope > settings.steepest, STEEP),
    )
    return next((why for failed, why in tests if failed), COUNTS)


def _refused(first: Patch, second: Patch, why_not: str, count: int) -> Tie:
    """Returns a tie without a measurement."""
    nowhere = np.array([first.place.easting_m, first.place.northing_m, math.nan])
    one, other = (End(p.readings, p.pose, nowhere) for p in (first, second))
    return Tie(HEIGHT, (one, other), np.array([0.0, 0.0, -1.0]), math.nan, math.inf, count, math.nan, why_not)
