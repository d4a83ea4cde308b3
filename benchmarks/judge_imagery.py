"""How far colours lie from where they belong: in orthophotos, and in coloured clouds."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import cv2
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
_SOUGHT_RECORDED_M: Final = 0.3  # Shifts of a recording are sought within this (m).
_BIN_M: Final = 0.04  # Width of the bins of returns (m): the spot of a beam at 8 m.
_BLUR_M: Final = 0.02  # 1 σ of the spot of a beam (m).
_LEAST_RETURNS: Final = 6  # Fewest returns of a bin whose median counts.


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


def paint_shift_m(photo: Path, returns: Float64, box: tuple[float, float, float, float], axis: int) -> Float64:
    """How far (m) paint in an orthophoto lies along an axis (0: east, 1: north) from where returns show it.

    Single returns scatter more than paint and asphalt differ. So the grey values and the logarithms of the calibrated
    intensities of a box are stacked to one profile along the axis each, and these are shifted until they agree best.
    Returns the shift of all returns, their correlation there, and 1 σ of the shift from that of eight parts in time;
    NaN where the profiles do not agree.

    Parameters
    ----------
    returns : (n, 4) easting, northing, calibrated intensity, time (s).
    box : west, south, east, north; paint crosses it at a right angle to the axis.
    """
    grey, place = grey_of(photo)
    column, row = pixels_of(place, [box[0], box[2]], [box[3], box[1]])
    shown = grey[round(row[0]) : round(row[1]), round(column[0]) : round(column[1])]
    shown = shown if axis == 0 else shown[::-1].T
    known = np.isfinite(shown).mean(axis=0) >= 0.5
    profile = np.full(shown.shape[1], np.nan)
    profile[known] = np.nanmean(shown[:, known], axis=0)
    at = box[axis] + place.a * (np.arange(profile.size) + 0.5)
    profile = gaussian_filter(profile, _BLUR_M / place.a)
    inside = (returns[:, :2] >= box[:2]).all(axis=1) & (returns[:, :2] < box[2:]).all(axis=1)
    own = returns[inside]
    parts = np.array_split(own[np.argsort(own[:, 3], kind="stable")], 8)
    whole, *each = (_best_shift(one[:, axis], one[:, 2], at, profile) for one in (own, *parts))
    if whole[1] < _LEAST_CORRELATION:
        return np.array([np.nan, whole[1], np.nan])
    return np.array([*whole, np.nanstd([one[0] for one in each], ddof=1) / np.sqrt(len(each))])


def _best_shift(place_m: Float64, light: Float64, at_m: Float64, profile: Float64) -> tuple[float, float]:
    """Shift (m) of a profile against the medians of returns by bins, and the correlation there."""
    step = round(_BIN_M / (at_m[1] - at_m[0]))
    edges = at_m[0] + _BIN_M * np.arange(int((at_m[-1] - at_m[0]) / _BIN_M) + 1)
    which = np.digitize(place_m, edges) - 1
    told = [k for k in range(len(edges) - 1) if np.count_nonzero(which == k) >= _LEAST_RETURNS]
    middle = np.array([edges[k] + 0.5 * _BIN_M for k in told])
    bright = np.array([np.median(np.log(np.maximum(light[which == k], 1.0))) for k in told])
    shifts = np.arange(-_SOUGHT_RECORDED_M, _SOUGHT_RECORDED_M + 0.005, 0.01)
    scores = np.full(shifts.size, -1.0)
    smooth = np.convolve(profile, np.full(step, 1.0 / step), "same")
    for k, shift in enumerate(shifts):
        values = np.interp(middle + shift, at_m, smooth, np.nan, np.nan)
        both = np.isfinite(values)
        if both.sum() >= 0.6 * len(told) and both.sum() > 8:
            scores[k] = np.corrcoef(_level(values[both], middle[both]), _level(bright[both], middle[both]))[0, 1]
    best = int(np.argmax(scores))
    if not 0 < best < shifts.size - 1:
        return np.nan, -1.0
    return float(shifts[best] + 0.01 * _peak(scores[best - 1 : best + 2])), float(scores[best])


def _level(values: Float64, at: Float64) -> Float64:
    """Values less the straight line through them: light falls with range, and asphalt is worn in tracks."""
    return np.asarray(values - np.polyval(np.polyfit(at, values, 1), at))


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
