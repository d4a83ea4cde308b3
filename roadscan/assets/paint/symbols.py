"""What a painted symbol shows: arrows by the ways that they allow, the rim of a triangle or a diamond.

Outlines are compared with drawn ones. Countries draw the same symbol slimmer or broader and with other heads, so each
is drawn in several proportions, and all are stretched to the extent of the paint along the road and across it.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator
from typing import Final

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.compute.array_types import Bool, Float64

ARROWS: Final = ("ahead", "left", "right", "ahead_left", "ahead_right")
"""Arrows by the ways that they allow."""
UNKNOWN: Final = "unknown"
_ALONG, _ACROSS = 32, 16
"""Cells of the grid in which outlines are compared."""
_FINER: Final = 4
"""Places a side of a cell that tell whether it is painted …"""
_PAINTED: Final = 0.25  # … for this share at least.
_LEAST: Final = 0.85
"""Least likeness: paint that is worn by a third and told at 5 cm reaches 0.9."""
_APART: Final = 0.04
"""The second shape is less alike than the first one by this, or nothing is told."""
_EXTENT_M: Final = 1.0
"""Least extent along the road (m): smaller paint is a fragment."""


def turned(outline: shapely.Geometry, road_rad: float) -> shapely.Geometry:
    """Returns an outline about its middle, with the road's direction (rad, anticlockwise from east) along x."""
    cos, sin = np.cos(road_rad), np.sin(road_rad)
    turn = np.array([[cos, -sin], [sin, cos]])
    middle = shapely.get_coordinates(outline.centroid)
    return shapely.transform(shapely.force_2d(outline), lambda xy: (xy - middle) @ turn)


def symbol_of(outline: shapely.Geometry) -> str:
    """Returns what an outline shows, x along the road in either direction; `unknown` where no drawing is alike.

    Left and right are those of the driver who reads the symbol: an arrow itself tells which way it is read.
    """
    x_min, _, x_max, _ = outline.bounds
    if x_max - x_min < _EXTENT_M:
        return UNKNOWN
    seen = _grid_of(outline)
    names, drawn, wide = _drawings()
    alike = np.maximum(*(_likeness(one, drawn, wide) for one in (seen, seen[::-1, ::-1])))
    of_name = {name: float(alike[names == name].max()) for name in np.unique(names).tolist()}
    (first, most), (_, second) = sorted(of_name.items(), key=lambda one: -one[1])[:2]
    return first if most >= _LEAST and most - second >= _APART else UNKNOWN


def _likeness(seen: Bool, drawn: Bool, wide: Bool) -> Float64:
    """Returns how alike (n,) a grid and drawn ones (n, 32, 16) are: the mean of two F1 of painted cells.

    One counts cells that meet or lie beside, since a cell's width takes slim lines apart; the other cells that meet,
    which tell a head from a shaft.
    """
    own, others = max(int(seen.sum()), 1), np.maximum(drawn.sum(axis=(1, 2)), 1)
    right = (seen & wide).sum(axis=(1, 2)) / own
    found = (drawn & _widened(seen)).sum(axis=(1, 2)) / others
    meet = (seen & drawn).sum(axis=(1, 2))
    return np.asarray(right * found / np.maximum(right + found, 1e-9) + meet / (own + others))


def _widened(grid: Bool) -> Bool:
    """Returns a grid with the cells beside the painted ones."""
    out = np.pad(grid, 1)
    for shift, axis in itertools.product((-1, 1), (0, 1)):
        out |= np.roll(np.pad(grid, 1), shift, axis)
    return out[1:-1, 1:-1]


def _grid_of(outline: shapely.Geometry) -> Bool:
    """Returns the cells (32, 16) of the extent along x and y that are painted for a quarter at least."""
    x_min, y_min, x_max, y_max = outline.bounds
    along, across = (
        (np.arange(cells * _FINER) + 0.5) / (cells * _FINER) * (high - low) + low
        for low, high, cells in ((x_min, x_max, _ALONG), (y_min, y_max, _ACROSS))
    )
    shapely.prepare(outline)
    inside = shapely.contains_xy(outline, *np.meshgrid(along, across, indexing="ij"))
    return np.asarray(inside.reshape(_ALONG, _FINER, _ACROSS, _FINER).mean(axis=(1, 3)) >= _PAINTED)


@functools.cache
def _drawings() -> tuple[npt.NDArray[np.str_], Bool, Bool]:
    """Returns the names (n,) of the drawings, their grids (n, 32, 16), and these with the cells beside."""
    names, outlines = zip(*_outlines(), strict=True)
    grids = np.array([_grid_of(one) for one in outlines])
    return np.array(names), grids, np.array([_widened(one) for one in grids])


def _outlines() -> Iterator[tuple[str, shapely.Geometry]]:
    """Yields outlines by name, read towards larger x, with the left of the reader at larger y."""
    for shaft, head in itertools.product((0.12, 0.2, 0.33), (0.2, 0.3, 0.4)):
        yield (
            "ahead",
            _joined(_box(0.0, 1.0 - head, 0.5 - shaft / 2, 0.5 + shaft / 2), [(1 - head, 0), (1, 0.5), (1 - head, 1)]),
        )
    turns = itertools.product((0.08, 0.13, 0.2), (0.06, 0.1), (0.35, 0.5), (0.3, 0.5), (0.6, 0.72))
    for shaft, bar, head, wide, at in turns:
        middle = min(at, 1.0 - wide / 2)
        yield from _both("left", "right", _joined(
            _box(0.0, middle, 0.0, shaft), _box(middle - bar / 2, middle + bar / 2, 0.0, 1.0 - head),
            [(middle - wide / 2, 1 - head), (middle, 1), (middle + wide / 2, 1 - head)],
        ))  # fmt: skip
    ways = itertools.product((0.08, 0.13), (0.05, 0.1), (0.4, 0.5, 0.6), (0.25, 0.35), (0.3, 0.5), (0.25, 0.35, 0.45))
    for shaft, bar, at, wide, head, broad in ways:
        middle = broad / 2
        yield from _both("ahead_left", "ahead_right", _joined(
            _box(0.0, 0.75, middle - shaft / 2, middle + shaft / 2),
            _box(at - bar / 2, at + bar / 2, middle, 1.0 - head),
            [(at - wide / 2, 1 - head), (at, 1), (at + wide / 2, 1 - head)], [(0.7, 0), (1, middle), (0.7, broad)],
        ))  # fmt: skip
    for line in (0.04, 0.08):
        yield "triangle", _rim([(1.0, 0.0), (1.0, 1.0), (0.0, 0.5)], line)
        yield "diamond", _rim([(0.0, 0.5), (0.5, 1.0), (1.0, 0.5), (0.5, 0.0)], line)


def _both(left: str, right: str, outline: shapely.Geometry) -> Iterator[tuple[str, shapely.Geometry]]:
    yield left, outline
    yield right, shapely.transform(outline, lambda xy: xy * [1.0, -1.0] + [0.0, 1.0])


def _box(x_min: float, x_max: float, y_min: float, y_max: float) -> list[tuple[float, float]]:
    return [(x_min, y_min), (x_max, y_min), (x_max, y_max), (x_min, y_max)]


def _joined(*rings: list[tuple[float, float]]) -> shapely.Geometry:
    return shapely.union_all([shapely.Polygon(ring) for ring in rings])


def _rim(corners: list[tuple[float, float]], line: float) -> shapely.Geometry:
    whole = shapely.Polygon(corners)
    return whole.difference(whole.buffer(-2.0 * line, join_style="mitre"))
