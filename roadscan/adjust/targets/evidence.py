"""Evidence that a place shows the shape: shares of paint, outline and clear road.

A value is paint where it lies above the middle between road and paint. Shares, and not sums of residuals, distinguish
worn paint from no paint: wear reduces each share by a part, while another thing lacks one of them altogether.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from roadscan.adjust.targets.settings import TargetSettings
from roadscan.adjust.targets.shapes import Cells, Chequered, Disc, Shape
from roadscan.compute.array_types import Bool, Float64

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
