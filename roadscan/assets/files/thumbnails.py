"""Thumbnails of assets: cut-outs of pictures, or returns drawn from the side or from above; a sheet of them a kind."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.assets import classes
from roadscan.compute.array_types import Float64, UInt8
from roadscan.core.extras import cv2

EDGE_PX: Final = 220  # Edge of a thumbnail (pixels).
_GAP_PX: Final = 6  # Gap between thumbnails (pixels).
_BACK: Final = (24, 26, 32)  # Colour of the background (RGB).
_OUTLINE: Final = (255, 210, 60)  # Colour of an outline (RGB).
_COLOURS: Final = {
    classes.GROUND: (150, 120, 84), classes.ROAD: (120, 124, 132), classes.LOW_VEGETATION: (96, 150, 78),
    classes.MEDIUM_VEGETATION: (80, 160, 70), classes.HIGH_VEGETATION: (60, 150, 60), classes.BUILDING: (206, 140, 110),
    classes.POLE: (240, 220, 120), classes.SIGN: (240, 90, 80), classes.KERB: (250, 160, 60),
    classes.BARRIER: (120, 190, 240), classes.MARKING: (255, 255, 255), classes.VEHICLE: (150, 130, 210),
    classes.FENCE: (190, 160, 240), classes.SIDEWALK: (190, 170, 150), classes.BRIDGE_DECK: (140, 200, 200),
    classes.OVERHEAD_STRUCTURE: (110, 170, 180),
}  # fmt: skip
_OTHER: Final = (170, 176, 186)  # Colour of classes without one of their own (RGB).
_LEAST_M: Final = 2.0  # Least half width of the drawn square (m).
_AROUND: Final = 1.3  # Ratio of the drawn square to the asset.
_DEEP_M: Final = 1.5
"""Depth (m) before and behind an asset of the returns drawn from the side."""
_FEWEST: Final = 20  # With fewer returns there is no drawing.


def read_classified(path: Path) -> tuple[Float64, UInt8, npt.NDArray[np.uint16]]:
    """Places (n, 3: easting, northing, height), classes (n,) and intensities (n,) of a file of classified points."""
    import laspy

    points: Any = laspy.read(path)
    return np.asarray(points.xyz, np.float64), np.asarray(points.classification, np.uint8), np.asarray(points.intensity)


def drawn_from_side(points: tuple[Float64, UInt8, Any], place_m: Sequence[float], height_m: float) -> UInt8 | None:
    """Image (220, 220, 3) of the returns around an upright asset, from the south or west, whichever shows more.

    None where there are too few.

    Parameters
    ----------
    place_m : easting, northing and height of its foot.
    height_m : how high above that is looked.
    """
    xyz, codes, intensity = points
    past = xyz - np.asarray(place_m)
    reach = max(_LEAST_M, 0.6 * height_m)
    shown = []
    for across, deep in ((0, 1), (1, 0)):
        near = (np.abs(past[:, deep]) <= _DEEP_M) & (np.abs(past[:, across]) <= reach)
        near &= (past[:, 2] >= -0.15 * reach) & (past[:, 2] <= 1.85 * reach)
        flat = np.column_stack([past[near, across], past[near, 2] - 0.85 * reach])
        shown.append((int(near.sum()), flat, codes[near], intensity[near]))
    count, flat, own, light = max(shown, key=lambda one: one[0])
    return None if count < _FEWEST else _dots(flat, own, light, reach)


def drawn_from_above(points: tuple[Float64, UInt8, Any], shape: shapely.Geometry) -> UInt8 | None:
    """Image (220, 220, 3) of the returns about a line or an area with its outline, north up; None if too few."""
    xyz, codes, intensity = points
    west, south, east, north = shape.bounds
    middle = np.array([(west + east) / 2, (south + north) / 2])
    if shape.geom_type == "LineString":
        at = shape.interpolate(0.5, normalized=True)
        middle = np.array([at.x, at.y])
    reach = min(max(_LEAST_M, _AROUND * max(east - west, north - south) / 2), 8.0)
    past = xyz[:, :2] - middle
    near = (np.abs(past) <= reach).all(axis=1)
    if np.count_nonzero(near) < _FEWEST:
        return None
    picture = _dots(past[near], codes[near], intensity[near], reach)
    lines = [shape.exterior] if shape.geom_type == "Polygon" else [shape]
    for line in lines:
        at_px = (shapely.get_coordinates(line) - middle) * [1.0, -1.0] / reach * EDGE_PX / 2 + EDGE_PX / 2
        cv2.polylines(picture, [np.rint(at_px * 16).astype(np.int32)], False, _OUTLINE, 1, cv2.LINE_AA, 4)
    return picture


def fitted(picture: UInt8) -> UInt8:
    """Returns a cut-out (h, w, 3) scaled to fit into a thumbnail (220, 220, 3)."""
    scale = EDGE_PX / max(picture.shape[:2])
    size = max(round(picture.shape[1] * scale), 1), max(round(picture.shape[0] * scale), 1)
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC)
    out = np.full((EDGE_PX, EDGE_PX, 3), _BACK, np.uint8)
    top, left = (EDGE_PX - small.shape[0]) // 2, (EDGE_PX - small.shape[1]) // 2
    out[top : top + small.shape[0], left : left + small.shape[1]] = small
    return out


def read_cut_out(content: bytes) -> UInt8 | None:
    """Returns pixels (h, w, 3), red first, of a cut-out; None where it cannot be read."""
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    return None if picture is None else np.ascontiguousarray(picture[:, :, ::-1])


def sheet(thumbnails: Sequence[UInt8]) -> bytes:
    """Returns thumbnails side by side, as PNG."""
    gap = np.full((EDGE_PX, _GAP_PX, 3), 255, np.uint8)
    parts = [part for one in thumbnails for part in (gap, one)][1:]
    _, encoded = cv2.imencode(".png", np.ascontiguousarray(np.hstack(parts)[:, :, ::-1]))
    return encoded.tobytes()


def _dots(flat: Float64, codes: UInt8, intensity: npt.NDArray[Any], reach_m: float) -> UInt8:
    """Returns an image of returns (n, 2) within `reach_m` of the middle, by intensity and class."""
    out = np.full((EDGE_PX, EDGE_PX, 3), _BACK, np.uint8)
    table = np.array([_COLOURS.get(code, _OTHER) for code in range(256)], np.float64)
    light = intensity.astype(np.float64)
    level = np.clip(light / max(float(np.quantile(light, 0.9)), 1.0), 0.0, 1.0)
    colour = (table[codes] * (0.55 + 0.45 * level)[:, None]).astype(np.uint8)
    column, row = (
        np.clip((v / reach_m + 1.0) / 2 * EDGE_PX, 0, EDGE_PX - 1).astype(int) for v in (flat[:, 0], -flat[:, 1])
    )
    order = np.argsort(level, kind="stable")
    out[row[order], column[order]] = colour[order]
    return cv2.dilate(out, np.ones((2, 2), np.uint8)) if len(flat) < EDGE_PX * EDGE_PX / 8 else out
