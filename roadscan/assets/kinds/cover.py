"""Covers and drains in the road: manholes' lids and grates, by their form and how bright they are."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from scipy.spatial import cKDTree

from roadscan.assets import classes
from roadscan.assets.bins import cells_of, in_bins
from roadscan.assets.judgement.judge import Judge
from roadscan.assets.kernels.spots import grow_spot
from roadscan.assets.kind import AssetKind, AssetObject, Evidence
from roadscan.assets.paint.components import Contrast
from roadscan.assets.paint.detection import paint_of
from roadscan.assets.quantiles import median
from roadscan.assets.scene import Scene, once_a_scene
from roadscan.assets.upright.pieces import Place, objects_at_places, pieces_of, schema_of
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.core.extras import cv2

_CELL_M: Final = 0.1
"""Edge of a cell in which spots are sought (m)."""
_SIDES_M: Final = (0.3, 0.5, 0.7)
"""Sides of the squares that are compared with what lies around them (m): drains are 0.3 m wide, covers up to 0.9 m."""
_GAP_M, _FRAME_M = 0.1, 0.3
"""Width of the gap between a square and the frame around it, and of that frame (m)."""
_CONTRAST: Final = 0.12
"""Least contrast of a square to its frame, bright or dark: worn iron differs from asphalt by more."""
_SIGMA: Final = 5.0
"""Least contrast in its standard deviations: of a million squares without a spot, hardly one reaches it."""
_SQUARES_APART_M: Final = 0.5
"""Of squares nearer than this (m), that with the largest contrast in standard deviations is looked at."""
_REACH_M: Final = 0.6
"""A spot's returns lie within this of its square's middle (m)."""
_FEWEST: Final = 8
"""Fewest returns of a spot: fewer show no form."""
_RING_M: Final = (0.08, 0.35)
"""From a spot's edge, where the ring about it begins and ends (m): the surface that it lies in."""
_SMOOTH_M: Final = 0.12
"""Returns within this distance (m) of one tell its surroundings: scan lines lie as far apart."""
_CORE, _BESIDE = 0.9, 0.75
"""Quantiles that tell a spot in its square, which may hold as much of the gutter, and what lies around: a drain differs
from road and gutter."""
_GROWS_M: Final = 0.25
"""A spot reaches so far (m) beyond its square, at most."""
_FARTHEST_M: Final = 15.0
"""Spots are sought up to this distance (m) from a drive."""
_RIM_M: Final = (0.02, 0.1)
"""On both sides of a spot's edge, returns between these distances tell how sharp it is (m): patches fade."""
_BUCKET_M: Final = 0.5  # Edge of the cells by which returns near a place are found (m).
_QUARTERS: Final = 4
"""Parts of a ring, each beside a part of the spot: an edge of paint is told by those that do not differ."""


@dataclass(frozen=True, eq=False)
class Spot:
    """A spot."""

    rows: Int64
    """Returns of the scene in it."""
    x_m: float
    """Its middle, from the corner of the returns; y likewise."""
    y_m: float
    length_m: float
    """Of the rectangle with the same spread; a disc's diameter is `diameter_m`."""
    width_m: float
    diameter_m: float
    heading_deg: float
    """Of its length, clockwise from north, below 180."""
    features: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Ground:
    """Returns (n,) on the ground."""

    xy_m: Float64
    """(n, 2) from the corner of the returns."""
    height_m: Float64
    value: Float64
    """Contrast, of the sign of the spots that are sought."""
    on_road: Bool

    def at(self, chosen: Int64 | Bool) -> Ground:
        """Returns some of them."""
        return Ground(self.xy_m[chosen], self.height_m[chosen], self.value[chosen], self.on_road[chosen])


_Buckets = tuple[tuple[Int64, Int64], tuple[float, float, float, int, int]]


@once_a_scene
def spots_of(scene: Scene) -> list[Spot]:
    """Returns the spots whose middle lies in the scene's tile, by their place."""
    contrast = paint_of(scene).contrast
    buckets = _bucketed(contrast)
    both = zip((1.0, -1.0), _squares(contrast), strict=True)
    found = [spot for sign, places in both for spot in _of_sign(scene, contrast, buckets, sign, places)]
    return sorted(found, key=lambda one: (one.x_m, one.y_m))


def _of_sign(scene: Scene, contrast: Contrast, buckets: _Buckets, sign: float, places: Float64) -> list[Spot]:
    """Returns the bright (1) or dark (−1) spots in some squares (n, 3)."""
    if not len(places):
        return []
    reach = places[:, 2] / 2 + _GROWS_M
    # a middle lies among its returns: what reaches no place of the tile belongs to another tile
    away, t = _to_drive(scene, places[:, :2]), scene.tile
    x, y = places[:, 0], places[:, 1]
    own = (x + reach >= t.x_min_m) & (x - reach < t.x_max_m) & (y + reach >= t.y_min_m) & (y - reach < t.y_max_m)
    own &= away <= _FARTHEST_M
    ground = Ground(
        np.column_stack([contrast.x_m, contrast.y_m]), contrast.height_m, sign * contrast.contrast,
        scene.classes[contrast.rows] == classes.ROAD,
    )  # fmt: skip
    found = []
    for (east, north, side), to_drive in zip(places[own].tolist(), away[own].tolist(), strict=True):
        near, inside = grow_spot(
            contrast.x_m, contrast.y_m, ground.value, *buckets, (east, north, side / 2),
            (_REACH_M + sum(_RING_M), _SMOOTH_M, _GAP_M, _GROWS_M, _FEWEST // 2), (_CORE, _BESIDE),
        )  # fmt: skip
        spot = _measured(ground.at(near), inside, contrast.rows[near])
        if spot is not None and bool(scene.tile.holds(spot.x_m, spot.y_m)):
            found.append(replace(spot, features={**spot.features, "sign": sign, "to_drive_m": to_drive}))
    return found


def _bucketed(contrast: Contrast) -> _Buckets:
    """Returns returns by cells of 0.5 m, and these cells, as :func:`grow_spot` takes them."""
    box = contrast.box
    rows, columns = (math.ceil(side / _BUCKET_M) for side in (box.y_max_m - box.y_min_m, box.x_max_m - box.x_min_m))
    cell = cells_of(contrast.x_m, contrast.y_m, (float(box.x_min_m), float(box.y_min_m), _BUCKET_M), (rows, columns))
    return in_bins(cell, rows * columns), (float(box.x_min_m), float(box.y_min_m), _BUCKET_M, rows, columns)


def _squares(contrast: Contrast) -> list[Float64]:
    """Returns (n, 3) x and y of the middle, and side (m), of squares brighter than around them, and of darker ones."""
    box = contrast.box
    shape = (round((box.y_max_m - box.y_min_m) / _CELL_M), round((box.x_max_m - box.x_min_m) / _CELL_M))
    column = np.clip(((contrast.x_m - box.x_min_m) / _CELL_M).astype(np.int64), 0, shape[1] - 1)
    row = np.clip(((contrast.y_m - box.y_min_m) / _CELL_M).astype(np.int64), 0, shape[0] - 1)
    cell, value = row * shape[1] + column, contrast.contrast
    sums = [np.bincount(cell, weight, shape[0] * shape[1]).reshape(shape).astype(np.float32)
            for weight in (np.ones(cell.size), value, value * value)]  # fmt: skip
    best, size = np.zeros((2, *shape), np.float32), np.zeros((2, *shape), np.float32)
    for side in _SIDES_M:
        n, s = (_summed(one, side) for one in sums[:2])
        gap, frame = side + 2 * _GAP_M, side + 2 * (_GAP_M + _FRAME_M)
        m, t, tt = (_summed(one, frame) - _summed(one, gap) for one in sums)
        known = (n >= _FEWEST) & (m >= _FEWEST)
        n, m = np.maximum(n, 1.0), np.maximum(m, 1.0)
        differs = s / n - t / m
        variance = np.maximum(tt / m - (t / m) ** 2, 1e-4)
        evidence = np.where(
            known & (np.abs(differs) >= _CONTRAST), differs / np.sqrt(variance * (1.0 / n + 1.0 / m)), 0.0
        )
        for k, own in enumerate((evidence, -evidence)):
            size[k] = np.where(own > best[k], np.float32(side), size[k])
            best[k] = np.maximum(best[k], own)
    reach = 2 * round(_SQUARES_APART_M / _CELL_M) + 1
    found = []
    for k in range(2):
        peak = (best[k] >= _SIGMA) & (best[k] >= cv2.dilate(best[k], np.ones((reach, reach), np.uint8)))
        row, column = np.nonzero(peak)
        x, y = box.x_min_m + (column + 0.5) * _CELL_M, box.y_min_m + (row + 0.5) * _CELL_M
        found.append(np.column_stack([x, y, size[k][peak]]))
    return found


def _summed(values: npt.NDArray[np.float32], side_m: float) -> npt.NDArray[np.float32]:
    """Returns the sum over the square about each cell."""
    side = 2 * round((side_m / _CELL_M - 1.0) / 2.0) + 1
    return np.asarray(cv2.boxFilter(values, cv2.CV_32F, (side, side), None, (-1, -1), False, cv2.BORDER_CONSTANT))


def _measured(near: Ground, inside: Bool, rows: Int64) -> Spot | None:
    """Returns the spot of those `inside` it, of the returns `near` it, `rows` of the scene; None where they are few."""
    if np.count_nonzero(inside) < _FEWEST:
        return None
    own = near.at(inside)
    weight = np.clip(own.value, 0.02, 1.0)
    middle = np.average(own.xy_m, axis=0, weights=weight)
    past = own.xy_m - middle
    spread = (past * weight[:, None]).T @ past / weight.sum()
    values, axes = np.linalg.eigh(spread)
    values = np.maximum(values, 1e-4)
    length, width = (float(v) for v in np.sqrt(12.0 * values[::-1]))
    diameter = float(4.0 * math.sqrt(values.mean()))
    away = np.hypot(*(near.xy_m - middle).T) - diameter / 2
    ring = near.at((away >= _RING_M[0]) & (away <= _RING_M[1]))
    if ring.value.size < _FEWEST:
        return None
    core = away <= -_RING_M[0] / 2
    differs = _by_quarter(middle, near.at(core) if np.count_nonzero(core) >= _FEWEST else own, ring)
    plane, *_ = np.linalg.lstsq(
        np.column_stack([ring.xy_m - middle, np.ones(ring.value.size)]), ring.height_m, rcond=None
    )
    rise = own.height_m - (past @ plane[:2] + plane[2])
    rough = ring.height_m - ((ring.xy_m - middle) @ plane[:2] + plane[2])
    rim = _RIM_M
    inner, outer = (near.value[(away >= a) & (away <= b)] for a, b in ((-rim[1], -rim[0]), rim))
    step = float(own.value.mean() - ring.value.mean())
    error = math.hypot(own.value.std() / math.sqrt(own.value.size), ring.value.std() / math.sqrt(ring.value.size))
    features = {
        "contrast": float(own.value.mean()), "spread": float(own.value.std()), "beside": float(ring.value.mean()),
        "beside_spread": float(ring.value.std()), "least_quarter": float(np.min(differs)),
        "quarters_spread": float(np.std(differs)),
        "evidence": step / max(error, 1e-3), "even": float(own.value.std() / max(ring.value.std(), 1e-3)),
        "sharp": float((inner.mean() - outer.mean()) / max(step, 1e-3)) if inner.size and outer.size else math.nan,
        "length_m": length, "slim": length / width, "diameter_m": diameter,
        "filled": own.value.size / max(int(np.count_nonzero(away <= 0.0)), 1),
        "density": (own.value.size / diameter**2) / (ring.value.size / (diameter + sum(_RING_M))),
        "rise_m": median(rise), "rough_m": float(np.std(rough)), "rough_inside_m": float(np.std(rise)),
        "road": float(ring.on_road.mean()), "road_inside": float(own.on_road.mean()),
    }  # fmt: skip
    along = axes[:, 1]
    heading = math.degrees(math.atan2(along[0], along[1])) % 180.0
    return Spot(rows[inside], float(middle[0]), float(middle[1]), length, width, diameter, heading, features)


def _by_quarter(middle: Float64, inside: Ground, ring: Ground) -> Float64:
    """Returns how much (4,) each quarter of a spot exceeds the part of the ring beside it; 0 where either is empty."""
    means = np.zeros((2, _QUARTERS))
    for row, own in enumerate((inside, ring)):
        turn = np.arctan2(*(own.xy_m - middle).T[::-1])
        quarter = np.clip(((turn + math.pi) / (2.0 * math.pi) * _QUARTERS).astype(np.int64), 0, _QUARTERS - 1)
        number = np.bincount(quarter, minlength=_QUARTERS)
        sums = np.bincount(quarter, own.value, _QUARTERS)
        means[row] = np.where(number, sums / np.maximum(number, 1), np.nan)
    return np.asarray(np.nan_to_num(means[0] - means[1]))


def _to_drive(scene: Scene, places: Float64) -> Float64:
    """Returns the distance (n,) of places (n, 2) to the nearest place of a drive (m); infinite without one."""
    drive = scene.drive_xyh_m[:, :2]
    return np.asarray(cKDTree(drive).query(places)[0]) if len(drive) else np.full(len(places), math.inf)


COVER, DRAIN = Judge("cover", "76fd8793f59c28e3"), Judge("drain", "fa919facd8bfe194")
"""Who is asked whether a spot is a cover or a drain, and which of these it is."""
_LEAST: Final = 0.85
"""Less probable spots are left out: of those that the fit held out, 0.73 on crowded streets, 0.96 among what is like
covers and all on plain ones are right from here on; from 0.8 on 0.55 on crowded ones."""
_LEAST_DRAIN: Final = 0.5  # More probable ones are drains.
_SPOTS_APART_M: Final = 0.4  # Spots nearer to one another (m) are one.
_PLACE_SIGMA_M: Final = 0.05  # 1 σ of the middle of a spot (m), half the distance of scan lines.
_GROUND_SIGMA_M: Final = 0.01  # 1 σ of the height of the ground there (m).
_SIZE_SIGMA_M: Final = 0.08
"""1 σ of diameters, lengths and widths (m): returns at an edge are of both."""


class Cover(AssetKind):
    """Covers and drains, from spots on the ground."""

    name = "cover"
    title = "Covers and drains"
    piece_schema = schema_of(["diameter_m", "length_m", "width_m", "heading_deg"], ["type"])

    def evidence(self, scene: Scene, options: Any) -> Evidence:
        """Returns spots that are probably a cover or a drain and whose middle lies in the tile."""
        return Evidence(pieces_of(scene, [_place(scene, *one) for one in _covers_of(scene)], self.piece_schema))

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Returns an object for each spot."""
        return objects_at_places(pieces, _SPOTS_APART_M)


@once_a_scene
def _covers_of(scene: Scene) -> list[tuple[Spot, str, float]]:
    return told_apart(spots_of(scene))


def told_apart(spots: list[Spot]) -> list[tuple[Spot, str, float]]:
    """Returns the spots that are probably a cover or a drain, each with its type and that probability."""
    told = [one.features for one in spots]
    either, drain = COVER.of_each(told).tolist(), DRAIN.of_each(told).tolist()
    types = ["drain" if p >= _LEAST_DRAIN else "cover" for p in drain]
    return [one for one in zip(spots, types, either, strict=True) if one[2] >= _LEAST]


def _place(scene: Scene, spot: Spot, kind: str, probability: float) -> Place:
    values: dict[str, float | str | None] = {"type": kind}
    if kind == "cover":
        values["diameter_m"] = spot.diameter_m
    else:
        values |= {"length_m": spot.length_m, "width_m": spot.width_m, "heading_deg": spot.heading_deg}
    ground = float(scene.ground.height_at(spot.x_m, spot.y_m))
    return Place(
        spot.x_m, spot.y_m, ground, _PLACE_SIGMA_M, _GROUND_SIGMA_M, probability, spot.rows, values, _SIZE_SIGMA_M
    )
