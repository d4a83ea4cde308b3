"""Finds ravelled patches of a lane: squares with a coarser texture than undamaged ones around them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np
import scipy.ndimage
import shapely

from roadscan.compute.array_types import Bool, Float64
from roadscan.compute.arrays import SIGMA_OF_MAD, scatter_about
from roadscan.condition.lane_data import SQUARE_M, RavelledPatch, RavelledSection, TextureSquares

LEAST_RATIO: Final = 1.15
"""Least ratio of a square's texture to its section's; it also exceeds it by :data:`_SIGMAS` of the section's spread."""
_SIGMAS: Final = 5.0  # Least excess of a coarse square's texture.
LEAST_AREA_M2: Final = 0.12  # Least area of a patch.
LEAST_SQUARES: Final = 250
"""Least number of squares that determine the texture of a section."""
_SHARED: Final = 0.5
"""Squares measured by several drives to a larger share are compared with one another only, since drives differ."""
_DIFFERS: Final = 3.0
"""Intensities differ where a patch's median is off by this many standard deviations of its section's squares."""
SEVERITIES: Final = {"low": 1.4, "moderate": 2.0, "high": math.inf}
"""Largest ratio of a patch's texture to its section's, by severity. The limits are roadscan's choice."""
_LANE_SHARE: Final = 0.25
"""The lane's texture is this quantile of its sections'."""
_SOUND_SHARE: Final = 0.2
"""A row across the lane is partly undamaged where at least this share of its squares is like the lane."""
_SOUND_ROWS: Final = 0.5
"""Least share of such rows in a section that has lost stones and is not of another surface."""
_CROSS: Final = scipy.ndimage.generate_binary_structure(2, 1)  # Neighbours by edges.
_SQUARE: Final = scipy.ndimage.generate_binary_structure(2, 2)  # Also by corners.


class Level(NamedTuple):
    """Texture of squares, as its logarithm (of mm)."""

    middle: float
    limit: float
    """A square is coarse where it exceeds the middle by more."""


def lane_levels(sections: Sequence[tuple[TextureSquares, Bool]]) -> dict[bool, Level]:
    """Lane's texture: the lower quartile of that of its sections, for squares of one drive and of several."""
    found: dict[bool, list[Level]] = {False: [], True: []}
    for squares, inside in sections:
        texture, kinds = _by_kind(squares, inside)
        for shared, own in kinds.items():
            found[shared].append(_level(texture[own]))
    return {shared: sorted(levels)[int(_LANE_SHARE * (len(levels) - 1))] for shared, levels in found.items() if levels}


def ravelled_section(
    squares: TextureSquares, inside: Bool, lane: Mapping[bool, Level] = MappingProxyType({})
) -> RavelledSection:
    """Return the patches of a section whose squares (n, m) are given.

    The logarithm of a square's texture is compared with the median of its section and the spread of its lower half,
    which patches do not widen. Where more than half of a section has lost stones, that median is of lost stones: so
    where it is coarser than the lane, and half of the rows across the lane contain some squares that are like the lane,
    squares are compared with the lane. Where rows are coarser from border to border, the surface seems to be another
    one: squares are compared with the section's median, and a remark says so.
    A patch ends halfway between its texture and that of undamaged squares, and with its section.

    inside : (n, m) squares that lie on the road; lane : of :func:`lane_levels`.
    """
    texture, kinds = _by_kind(squares, inside)
    excess, judged, limits = (np.full(texture.shape, one) for one in (np.nan, 0.0, np.inf))
    remark = ""
    for shared, own in kinds.items():
        level, usual = _level(texture[own]), lane.get(shared)
        if usual is not None and level.middle - usual.middle > usual.limit:
            if _mixed(texture, own, usual):
                level = usual
            else:
                ratio = math.exp(level.middle - usual.middle)
                remark = f"its texture is {ratio:.1f} times that of the lane: another surface, or stones lost all over"
        excess[own], judged[own], limits[own] = texture[own] - level.middle, 1.0, level.limit
    known = judged > 0.0
    all_m2, measured_m2 = SQUARE_M**2 * float(inside.sum()), SQUARE_M**2 * float(known.sum())
    share = measured_m2 / all_m2 if all_m2 else 0.0
    if not known.any():
        told = int(np.isfinite(texture).sum())
        return RavelledSection((), 0.0, 0.0, math.nan, f"the texture of {told} squares is known")
    background = math.exp(float(np.median((texture - excess)[known])))
    patches = tuple(_patches(squares, excess, known, limits))
    return RavelledSection(patches, measured_m2, share, background, "", remark)


def _by_kind(squares: TextureSquares, inside: Bool) -> tuple[Float64, dict[bool, Bool]]:
    """Return logarithms of texture (n, m), NaN where unknown, and squares of one drive and of several, where enough."""
    with np.errstate(invalid="ignore", divide="ignore"):
        texture = np.log(squares.texture_mm)
    texture[~(np.isfinite(texture) & inside)] = np.nan
    several = np.nan_to_num(squares.passes_share) > _SHARED
    kinds = {shared: np.isfinite(texture) & (several == shared) for shared in (False, True)}
    return texture, {shared: own for shared, own in kinds.items() if own.sum() >= LEAST_SQUARES}


def _level(texture: Float64) -> Level:
    middle = float(np.median(texture))
    below = float(np.median(middle - texture[texture <= middle]))
    return Level(middle, max(math.log(LEAST_RATIO), _SIGMAS * SIGMA_OF_MAD * below))


def _mixed(texture: Float64, own: Bool, lane: Level) -> bool:
    """Return whether half of the rows across the lane contain squares that are like the lane."""
    rows = own.any(axis=1)
    alike = own & (np.nan_to_num(texture, nan=np.inf) < lane.middle + 0.5 * lane.limit)
    share = alike[rows].sum(axis=1) / own[rows].sum(axis=1)
    return bool(np.mean(share >= _SOUND_SHARE) >= _SOUND_ROWS)


def _patches(squares: TextureSquares, excess: Float64, judged: Bool, limits: Float64) -> Iterator[RavelledPatch]:
    coarse = judged & (np.nan_to_num(excess, nan=-np.inf) > limits)
    # Holes of one square are closed; patches one square wide are dropped.
    coarse |= scipy.ndimage.binary_closing(np.pad(coarse, 1), _CROSS)[1:-1, 1:-1] & judged
    label, count = scipy.ndimage.label(scipy.ndimage.binary_opening(coarse, np.ones((2, 2))), _SQUARE)
    sound = judged & ~scipy.ndimage.binary_dilation(coarse, _SQUARE)
    sound = sound if sound.any() else judged & ~coarse
    for number in range(1, count + 1):
        core = label == number
        half = 0.5 * float(np.median(excess[core]))
        wide = scipy.ndimage.binary_dilation(core, _SQUARE) & judged
        own = wide & (excess > half) & ((label == number) | (label == 0))
        if own.sum() * SQUARE_M**2 >= LEAST_AREA_M2:
            yield _measured(squares, excess, own, sound)


def _measured(squares: TextureSquares, excess: Float64, own: Bool, sound: Bool) -> RavelledPatch:
    count = int(own.sum())
    border = int((own & ~scipy.ndimage.binary_erosion(own, _CROSS)).sum())
    ratio = math.exp(float(np.median(excess[own])))
    spread = scatter_about(excess[own], float(np.median(excess[own])))
    lost = [float(np.nanmedian(v)) if np.isfinite(v).any() else math.nan
            for v in (squares.loss_mm[own], squares.loss_mm[sound])]  # fmt: skip
    contrast, differs = _contrast(squares.intensity, own, sound)
    row, column = np.nonzero(own)
    station, offset, h = squares.station_m[row], squares.offset_m[column], 0.5 * SQUARE_M
    outline = shapely.union_all(shapely.box(station - h, offset - h, station + h, offset + h), grid_size=1e-6)
    return RavelledPatch(
        outline=outline,
        area_m2=count * SQUARE_M**2,
        sigma_area_m2=SQUARE_M**2 * border / math.sqrt(12.0),
        texture_mm=float(np.median(squares.texture_mm[own])),
        ratio=ratio,
        sigma_ratio=ratio * spread * math.sqrt(math.pi / 2.0 / count),
        loss_mm=lost[0] - lost[1],
        contrast=contrast,
        severity=next(name for name, most in SEVERITIES.items() if ratio <= most),
        evidence="texture and intensity" if differs else "texture",
    )


def _contrast(intensity: Float64, own: Bool, sound: Bool) -> tuple[float, bool]:
    """Return the contrast of a patch's intensity, and whether it differs from that of the section."""
    inside, around = intensity[own & np.isfinite(intensity)], intensity[sound & np.isfinite(intensity)]
    if not inside.size or not around.size or np.median(around) <= 0.0:
        return math.nan, False
    level = float(np.median(around))
    off = float(np.median(inside)) - level
    spread = scatter_about(around, level)
    return off / level, abs(off) > max(_DIFFERS * spread, 0.01 * level)
