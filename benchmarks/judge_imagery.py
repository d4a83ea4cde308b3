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
_TOLD: Final = 0.05  # Least fall of the correlation over 8 cm in a direction in which a shift is told.
_LEAST_CORRELATION: Final = 0.6  # Windows that correlate less show something else.


def grey_of(path: Path) -> tuple[Float32, rasterio.Affine]:
    """Grey values (rows, columns) of a raster with red, green and blue, NaN where it has none, and its transform."""
    with rasterio.open(path) as raster:
        red, green, blue, number = raster.read()
        grey = 0.299 * red.astype(np.float32) + 0.587 * green + 0.114 * blue
        return np.where(number > 0, grey, np.nan).astype(np.float32), raster.transform


def pixels_of(place: rasterio.Affine, easting_m: npt.ArrayLike, northing_m: npt.ArrayLike) -> tuple[Float64, Float64]:
    """Column and row (n,) of places in a raster that is north up."""
    column, row = (np.asarray(easting_m) - place.c) / place.a, (np.asarray(northing_m) - place.f) / place.e
    return column, row


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
    (west, east), (south, north) = (
        sorted((first + step * low, first + step * high))
        for first, step, low, high in (
            (place.c, place.a, columns.min(), columns.max()), (place.f, place.e, rows.min(), rows.max())
        )
    )  # fmt: skip
    wide, narrow = round((_WINDOW_M + _SOUGHT_M) / cell), round(_WINDOW_M / cell)
    found = []
    for at in painted_corners(known, (west, south, east, north)):
        column, row = (int(v) for v in pixels_of(place, at[0], at[1]))
        window = grey[row - wide : row + wide + 1, column - wide : column + wide + 1]
        if window.shape != (2 * wide + 1,) * 2 or np.isnan(window).any():
            continue
        steps = np.arange(-narrow, narrow + 1)
        across, along = np.meshgrid(column + steps + 0.5, row + steps + 0.5)
        x, y = place.c + place.a * across, place.f + place.e * along
        expected = gaussian_filter(known.intensity(x, y), 0.7).astype(np.float32)
        right, down, same = shift_px(window, expected)
        if same >= _LEAST_CORRELATION and not np.isnan(right):
            found.append((right * cell, -down * cell))
    return np.array(found).reshape(-1, 2)


def intensity_shifts_m(orthophoto: Path, points: list[Path], *, half_m: float = 0.8, step_m: float = 0.01) -> Float64:
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
    column, row = pixels_of(place, *xy.T)
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
    """Middles of windows, half a window apart, in which some returns are far brighter than the rest."""
    places = []
    low, high = xy.min(axis=0), xy.max(axis=0)
    for north in np.arange(low[1], high[1], half_m):
        for east in np.arange(low[0], high[0], half_m):
            own = light[(np.abs(xy - (east, north)) < half_m).all(axis=1)]
            if own.size < 100:
                continue
            usual = np.median(own)
            bright = own > usual + max(4.0 * 1.4826 * np.median(np.abs(own - usual)), 0.5 * usual)
            if bright.sum() >= 12 and bright.mean() <= 0.4:
                places.append(np.array([east, north]))
    return places


def _best_shift(
    xy: Float64, light: Float64, grey: Float32, place: rasterio.Affine, step_m: float
) -> tuple[float, float] | None:
    """Shift (east, north; m) of the picture against the returns; NaN along a line, which does not tell it.

    None where nothing agrees.
    """
    steps = np.arange(-2.0 * _SOUGHT_M, 2.0 * _SOUGHT_M + step_m / 2, step_m)
    light = np.minimum(light, np.percentile(light, 97))
    scores = np.empty((steps.size, steps.size))
    for i, north in enumerate(steps):
        for j, east in enumerate(steps):
            column, row = pixels_of(place, xy[:, 0] + east, xy[:, 1] + north)
            values = map_coordinates(grey, [row - 0.5, column - 0.5], order=1, mode="nearest")
            scores[i, j] = np.corrcoef(values, light)[0, 1]
    i, j = np.unravel_index(np.argmax(scores), scores.shape)
    if scores[i, j] < _LEAST_CORRELATION or not (0 < i < steps.size - 1 and 0 < j < steps.size - 1):
        return None
    away = round(0.08 / step_m)
    east_told = scores[i, j] - max(scores[i, max(j - away, 0)], scores[i, min(j + away, steps.size - 1)])
    north_told = scores[i, j] - max(scores[max(i - away, 0), j], scores[min(i + away, steps.size - 1), j])
    x, y = _peak(scores[i, j - 1 : j + 2]), _peak(scores[i - 1 : i + 2, j])
    return (
        float(steps[j] + x * step_m) if east_told >= _TOLD else np.nan,
        float(steps[i] + y * step_m) if north_told >= _TOLD else np.nan,
    )


_TILE_PX: Final = 32  # Edge of the windows of a picture (pixels) in which colours of a cloud are sought.
_AWAY_PX: Final = 5  # Shifts are sought within this (pixels).


def edge_shifts_px(pixel: Float64, light: Float64, picture: npt.NDArray[np.uint8]) -> Float64:
    """How far (n, 2: right, down; pixels) edges of a cloud's grey values lie from those of a picture.

    Windows of a picture that hold 60 points or more and differ by 12 grey values or more are moved until they agree
    best with the points.

    Parameters
    ----------
    pixel : (m, 2) where points that the picture shows are in it.
    light : (m,) their grey values in the cloud.
    picture : (height, width) grey.
    """
    smooth = gaussian_filter(picture.astype(np.float64), 0.7)
    window = np.floor(pixel / _TILE_PX).astype(int)
    steps = np.arange(-_AWAY_PX, _AWAY_PX + 0.25, 0.5)
    found = []
    for one in np.unique(window, axis=0):
        rows = np.flatnonzero((window == one).all(axis=1))
        if rows.size < 60 or light[rows].std() < 12.0:
            continue
        u, v = pixel[rows].T
        scores = np.empty((steps.size, steps.size))
        for i, down in enumerate(steps):
            for j, right in enumerate(steps):
                values = map_coordinates(smooth, [v + down, u + right], order=1, mode="nearest")
                scores[i, j] = np.corrcoef(values, light[rows])[0, 1]
        i, j = np.unravel_index(np.nanargmax(scores), scores.shape)
        if scores[i, j] < _LEAST_CORRELATION or not (0 < i < steps.size - 1 and 0 < j < steps.size - 1):
            continue
        away = round(2.0 / 0.5)
        told_x = scores[i, j] - max(scores[i, max(j - away, 0)], scores[i, min(j + away, steps.size - 1)]) >= _TOLD
        told_y = scores[i, j] - max(scores[max(i - away, 0), j], scores[min(i + away, steps.size - 1), j]) >= _TOLD
        x, y = _peak(scores[i, j - 1 : j + 2]), _peak(scores[i - 1 : i + 2, j])
        found.append((steps[j] + 0.5 * x if told_x else np.nan, steps[i] + 0.5 * y if told_y else np.nan))
    return np.array(found).reshape(-1, 2)
