"""How far colours lie from where they belong: in orthophotos, and in coloured clouds."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import cv2
import laspy
import numpy as np
import numpy.typing as npt
import rasterio
from scipy.ndimage import gaussian_filter, map_coordinates

from roadscan.simulate.truth import Truth

Float64 = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]

_SOUGHT_M: Final = 0.10  # Shifts are sought within this (m).
_WINDOW_M: Final = 0.30  # Half of the window around a corner (m).
_LEAST_CORRELATION: Final = 0.6  # Windows that correlate less show something else.


def grey_of(path: Path) -> tuple[Float32, rasterio.Affine]:
    """Grey values (rows, columns) of a raster with red, green and blue, NaN where it has none, and its transform."""
    with rasterio.open(path) as raster:
        red, green, blue, number = raster.read()
        grey = 0.299 * red.astype(np.float32) + 0.587 * green + 0.114 * blue
        return np.where(number > 0, grey, np.nan).astype(np.float32), raster.transform


def shift_px(shown: Float32, expected: Float32) -> tuple[float, float, float]:
    """Shift (columns, rows) of a picture against a smaller one with the same middle, and their correlation."""
    scores = cv2.matchTemplate(shown.astype(np.float32), expected.astype(np.float32), cv2.TM_CCOEFF_NORMED)
    _, best, _, (column, row) = cv2.minMaxLoc(scores)
    if not (0 < row < scores.shape[0] - 1 and 0 < column < scores.shape[1] - 1):
        return np.nan, np.nan, best
    x, y = (_peak(line) for line in (scores[row, column - 1 : column + 2], scores[row - 1 : row + 2, column]))
    return column + x - (scores.shape[1] - 1) / 2, row + y - (scores.shape[0] - 1) / 2, best


def _peak(line: Float32) -> float:
    low, middle, high = (float(v) for v in line)
    bend = low - 2.0 * middle + high
    return 0.0 if bend >= 0.0 else 0.5 * (low - high) / bend


def painted_corners(known: Truth, box: tuple[float, float, float, float]) -> Float64:
    """Easting and northing (n, 2) of the ends of dashes in a box (west, south, east, north)."""
    east, north = np.meshgrid(np.arange(box[0], box[2], 0.02), np.arange(box[1], box[3], 0.02))
    station, offset = known.station_offset_m(east, north)
    found = []
    for one in known.scene.road.markings:
        if one.dash_m is None or one.gap_m is None:
            continue
        period = one.dash_m + one.gap_m
        start = one.start_m if np.isfinite(one.start_m) else 0.0
        for number in range(-5, 100):
            for end in (start + number * period, start + number * period + one.dash_m):
                away = np.hypot(station - end, offset - one.offset_m)
                at = np.unravel_index(np.nanargmin(away), away.shape)
                if away[at] < 0.02:
                    found.append((east[at], north[at]))
    return np.array(found)


def corner_shifts_m(orthophoto: Path, known: Truth) -> Float64:
    """How far (n, 2: east, north; m) the ends of painted dashes lie from the truth in an orthophoto."""
    grey, place = grey_of(orthophoto)
    cell = place.a
    rows, columns = np.nonzero(~np.isnan(grey))
    west, north = place * (columns.min(), rows.min())
    east, south = place * (columns.max(), rows.max())
    wide, narrow = round((_WINDOW_M + _SOUGHT_M) / cell), round(_WINDOW_M / cell)
    found = []
    for at in painted_corners(known, (west, south, east, north)):
        column, row = (int(v) for v in ~place * tuple(at))
        window = grey[row - wide : row + wide + 1, column - wide : column + wide + 1]
        if window.shape != (2 * wide + 1,) * 2 or np.isnan(window).any():
            continue
        steps = np.arange(-narrow, narrow + 1)
        x, y = place * tuple(np.array(np.meshgrid(column + steps + 0.5, row + steps + 0.5)))
        expected = gaussian_filter(known.intensity(x, y), 0.7).astype(np.float32)
        right, down, same = shift_px(window, expected)
        if same >= _LEAST_CORRELATION and not np.isnan(right):
            found.append((right * cell, -down * cell))
    return np.array(found).reshape(-1, 2)


def intensity_shifts_m(
    orthophoto: Path, points: list[Path], *, half_m: float = 0.8, step_m: float = 0.01
) -> Float64:
    """How far (n, 2: east, north; m) paint in an orthophoto lies from where lidar returns are bright.

    Windows of `half_m` to each side lie around bright returns of the road; each shift maximises the correlation of the
    returns' intensities with the orthophoto's grey values, blurred as a beam blurs them.
    """
    grey, place = grey_of(orthophoto)
    known = ~np.isnan(grey)
    weight = gaussian_filter(known.astype(np.float32), 0.03 / place.a)
    blurred = gaussian_filter(np.where(known, grey, 0.0), 0.03 / place.a) / np.maximum(weight, 1e-3)
    parts = [laspy.read(p) for p in points]
    xy = np.concatenate([np.column_stack([p.x, p.y]) for p in parts])
    light = np.concatenate([np.asarray(p.intensity, np.float64) for p in parts])
    coloured = np.concatenate([np.asarray(p["pictures"]) for p in parts]) > 0
    column, row = ~place * tuple(xy.T)
    inside = coloured & (column > 1) & (row > 1) & (column < grey.shape[1] - 1) & (row < grey.shape[0] - 1)
    inside[inside] &= known[row[inside].astype(int), column[inside].astype(int)]
    xy, light = xy[inside], light[inside]
    found = []
    for middle in _bright_places(xy, light, half_m):
        near = (np.abs(xy - middle) < half_m).all(axis=1)
        shift = _best_shift(xy[near], light[near], blurred, place, step_m)
        if shift is not None:
            found.append(shift)
    return np.array(found).reshape(-1, 2)


def _bright_places(xy: Float64, light: Float64, half_m: float) -> list[Float64]:
    """Middles of squares in which one to five in ten returns are far brighter than the rest."""
    cell = np.floor(xy / (2.0 * half_m)).astype(int)
    places = []
    for one in np.unique(cell, axis=0):
        own = light[(cell == one).all(axis=1)]
        if own.size < 60:
            continue
        usual = np.median(own)
        bright = np.mean(own > usual + 4.0 * 1.4826 * np.median(np.abs(own - usual)))
        if 0.04 <= bright <= 0.5:
            places.append((one + 0.5) * 2.0 * half_m)
    return places


def _best_shift(
    xy: Float64, light: Float64, grey: Float32, place: rasterio.Affine, step_m: float
) -> tuple[float, float] | None:
    """Shift (east, north; m) of the picture against the returns; None where it is not told in both directions."""
    steps = np.arange(-_SOUGHT_M * 2, _SOUGHT_M * 2 + step_m / 2, step_m)
    light = np.minimum(light, np.percentile(light, 95))
    scores = np.empty((steps.size, steps.size))
    for i, north in enumerate(steps):
        for j, east in enumerate(steps):
            column, row = ~place * (xy[:, 0] + east, xy[:, 1] + north)
            values = map_coordinates(grey, [row - 0.5, column - 0.5], order=1, mode="nearest")
            scores[i, j] = np.corrcoef(values, light)[0, 1]
    i, j = np.unravel_index(np.argmax(scores), scores.shape)
    if scores[i, j] < _LEAST_CORRELATION or not (0 < i < steps.size - 1 and 0 < j < steps.size - 1):
        return None
    # A line alone does not tell how far along it things lie.
    along = scores[i, j] - min(scores[i].max(initial=-1.0, where=np.abs(steps - steps[j]) > 0.08),
                               1.0), scores[i, j] - scores[:, j].max(initial=-1.0, where=np.abs(steps - steps[i]) > 0.08)  # fmt: skip
    if min(along) < 0.02:
        return None
    x, y = _peak(scores[i, j - 1 : j + 2]), _peak(scores[i - 1 : i + 2, j])
    return float(steps[j] + x * step_m), float(steps[i] + y * step_m)
