"""Street furniture: cabinets, bins, benches, hydrants and bus shelters."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import scipy.ndimage
from scipy.spatial import cKDTree

from roadscan.assets import classes
from roadscan.assets.bins import in_bins
from roadscan.assets.judgement.judge import Judge
from roadscan.assets.kind import AssetKind, AssetObject, Evidence, Marked
from roadscan.assets.quantiles import quantiles
from roadscan.assets.scene import Scene, once_a_scene
from roadscan.assets.upright.brightness import brightness
from roadscan.assets.upright.pieces import Place, objects_at_places, pieces_of, schema_of
from roadscan.assets.upright.regions import regions_of
from roadscan.assets.upright.slices import usable
from roadscan.compute.array_types import Float64, Int64

_CELL_M: Final = 0.15  # Edge of a cell, seen from above (m): things that stand farther apart are two.
_LOWEST_M: Final = 0.08
"""Returns from this height above the ground (m): below lie grass, kerbs and the noise of the ground."""
_HIGHEST_M: Final = 4.5
"""Returns up to this height (m): what goes on above stands too high for furniture."""
_TOP_M: Final = 3.6  # Greatest height of a thing (m): advertising columns are this high.
_FOOT_M: Final = 0.7  # Greatest height of the lowest return of a thing (m): parked cars hide feet.
_LONGEST_M: Final = 5.5  # Greatest extent seen from above (m): that of a bus shelter.
_LEAST_RETURNS: Final = 15  # Fewer returns show no form.
_FRONT_M: Final = 4.5
"""Upright surfaces longer than this (m), walls and fronts of houses, join nothing that stands at their foot."""
_VOXEL_M: Final = 0.25  # Edge of the cubes in which the form of a surface is measured (m).
_LEAST_OF_VOXEL: Final = 5  # Least number of returns of a cube whose form counts.
_TRIMMED: Final = 0.02
"""Share of the returns beyond each end of an extent."""
_WALL_M: Final = 3.0  # Surfaces farther off than this (m) do not matter.
_LEVELS_M: Final = (0.35, 0.6, 0.9, 1.3, 1.9, 2.6)
"""Heights above the ground (m) between which the shares of the returns are features: seats, lids, roofs."""


@dataclass(frozen=True, eq=False)
class Compact:
    """A compact thing."""

    rows: Int64
    x_m: float
    """Middle of its extent, from the corner of the returns; y likewise."""
    y_m: float
    length_m: float
    width_m: float
    height_m: float
    """Above the ground."""
    heading_deg: float
    """Of its length, clockwise from north, below 180."""
    features: Mapping[str, float]


@once_a_scene
def compact_things(scene: Scene) -> list[Compact]:
    """Returns the compact things whose middle lies in a scene's tile, by their place."""
    rows, label, count = _labelled(scene)
    if not count:
        return []
    form = _forms(scene, rows)
    starts, order = in_bins(label, count)
    found = [_measured(scene, rows[own], form[own]) for k in range(count)
             if (own := order[starts[k] : starts[k + 1]]).size >= _LEAST_RETURNS]  # fmt: skip
    return sorted((one for one in found if one is not None), key=lambda one: (one.x_m, one.y_m))


def _labelled(scene: Scene) -> tuple[Int64, npt.NDArray[np.int32], int]:
    """Returns rows (n,) that stand on the ground, the number of the component of each, and the number of components."""
    returns, window = scene.returns, scene.window
    above = scene.above_ground_m
    stands = usable(scene) | (scene.classes == classes.VEHICLE)  # who tells vehicles takes some bins for small ones
    held = stands & (above > _LOWEST_M) & (above < _HIGHEST_M)
    for region in regions_of(scene):
        if region.length_m > _FRONT_M:
            held[region.rows] = False
    rows = np.flatnonzero(held)
    column = np.floor((returns.x_m[rows] - window.x_min_m) / _CELL_M).astype(np.int64)
    row = np.floor((returns.y_m[rows] - window.y_min_m) / _CELL_M).astype(np.int64)
    shape = tuple(math.ceil((b - a) / _CELL_M) + 1 for a, b in ((window.y_min_m, window.y_max_m),
                                                                (window.x_min_m, window.x_max_m)))  # fmt: skip
    filled = np.zeros(shape, np.bool_)
    filled[row, column] = True
    label, count = scipy.ndimage.label(filled, np.ones((3, 3)))
    return rows, (label[row, column] - 1).astype(np.int32), int(count)


def _forms(scene: Scene, rows: Int64) -> Float64:
    """Returns (n, 4) how line-like, plane-like and scattered the returns about each are, and how level; NaN of few.

    From the eigenvalues of the returns in its cube (Demantké et al. 2011, eq. 1); level: of a plane's normal, upwards.
    """
    r = scene.returns
    xyh = np.column_stack([r.x_m[rows], r.y_m[rows], r.height_m[rows]])
    cell = np.floor(xyh / _VOXEL_M).astype(np.int64)
    cell -= cell.min(axis=0)
    span = cell.max(axis=0) + 1
    _, own = np.unique((cell[:, 2] * span[1] + cell[:, 1]) * span[0] + cell[:, 0], return_inverse=True)
    number = np.bincount(own)
    middle = np.column_stack([np.bincount(own, xyh[:, k]) for k in range(3)]) / number[:, None]
    past = xyh - middle[own]
    spread = np.empty((number.size, 3, 3))
    for i in range(3):
        for j in range(i + 1):
            spread[:, i, j] = spread[:, j, i] = np.bincount(own, past[:, i] * past[:, j]) / number
    values, axes = np.linalg.eigh(spread)
    sigma = np.sqrt(np.maximum(values, 0.0))
    most = np.maximum(sigma[:, 2], 1e-6)
    form = np.column_stack([(sigma[:, 2] - sigma[:, 1]) / most, (sigma[:, 1] - sigma[:, 0]) / most,
                            sigma[:, 0] / most, np.abs(axes[:, 2, 0])])  # fmt: skip
    form[number < _LEAST_OF_VOXEL] = np.nan
    return np.asarray(form[own])


def _measured(scene: Scene, rows: Int64, form: Float64) -> Compact | None:
    """Returns a thing; None where it has not the size of any, or stands elsewhere."""
    returns, above = scene.returns, scene.above_ground_m[rows]
    xy = np.column_stack([returns.x_m[rows], returns.y_m[rows]])
    longest = float(np.ptp(xy, axis=0).max())
    if longest > _LONGEST_M or above.max() > _TOP_M or not scene.tile.comes_near(xy, longest):
        return None
    low, high = np.quantile(above, [_TRIMMED, 1.0 - _TRIMMED])
    if low > _FOOT_M:
        return None
    way = _narrowest(xy)
    turned = xy @ np.column_stack([way, [-way[1], way[0]]])
    ends = np.array([quantiles(one, [_TRIMMED, 1.0 - _TRIMMED]) for one in turned.T]).T
    length, width = (float(v) for v in ends[1] - ends[0])
    x, y = (float(v) for v in np.column_stack([way, [-way[1], way[0]]]) @ ends.mean(axis=0))
    if not bool(scene.tile.holds(x, y)):
        return None
    shares = np.histogram(above, [-np.inf, *_LEVELS_M, np.inf])[0] / rows.size
    u, v = (turned - ends.mean(axis=0)).T
    away = np.hypot(u, v)
    cells = np.unique(np.floor(turned / _CELL_M).astype(np.int64), axis=0)
    box = max(length, _CELL_M) * max(width, _CELL_M)
    light = brightness(scene)[rows]
    on_top = above > high - 0.15
    line, plane, scatter, level = (float(np.nanmean(c)) if np.isfinite(c).any() else math.nan for c in form.T)
    flat = form[:, 1] > 0.5
    features = {
        "returns": math.log(rows.size), "range_m": float(np.median(returns.ranges_m(rows))),
        "length_m": length, "width_m": width, "low_m": float(low), "high_m": float(high),
        **{f"share_{k}": float(s) for k, s in enumerate(shares)},
        "filled": len(cells) * _CELL_M**2 / box, "round": float(away.std() / max(away.mean(), 0.01)),
        "at_rim": float(np.mean((np.abs(u) > 0.35 * length) | (np.abs(v) > 0.35 * width))),
        "top_length_m": float(np.ptp(u[on_top])), "top_width_m": float(np.ptp(v[on_top])),
        "bottom_length_m": float(np.ptp(u[above < low + 0.2])), "bottom_width_m": float(np.ptp(v[above < low + 0.2])),
        "line": line, "plane": plane, "scatter": scatter, "level": level,
        "level_planes": float(np.mean(flat & (form[:, 3] > 0.9))),
        "upright_planes": float(np.mean(flat & (form[:, 3] < 0.3))),
        "light": float(np.median(light)), "light_spread": float(np.std(light)),
        "green": float(np.isin(scene.classes[rows], classes.VEGETATION).mean()),
        "vehicle": float(np.mean(scene.classes[rows] == classes.VEHICLE)),
        "drive_m": _to_drive(scene, x, y), "wall_m": _to_wall(scene, x, y),
    }  # fmt: skip
    heading = math.degrees(math.atan2(way[0], way[1])) % 180.0
    return Compact(rows, x, y, length, width, float(high), heading, features)


def _narrowest(xy: Float64) -> Float64:
    """Returns the unit vector (2,) along which the smallest rectangle about places (n, 2) is long."""
    angle = np.arange(0.0, math.pi, math.pi / 36)
    ways = np.column_stack([np.cos(angle), np.sin(angle)])
    extent = np.ptp(np.quantile(xy @ ways.T, [_TRIMMED, 1.0 - _TRIMMED], axis=0), axis=0)
    across = np.roll(extent, 18)
    best = int(np.argmin(np.round(extent * across, 4)))
    best = best if extent[best] >= across[best] else (best + 18) % 36
    return np.asarray(ways[best])


def _to_drive(scene: Scene, x_m: float, y_m: float) -> float:
    """Returns the distance from a place to the nearest drive (m); NaN where none is known."""
    tree = _tree_of_drives(scene)
    return math.nan if tree is None else float(tree.query([x_m, y_m])[0])


@once_a_scene
def _tree_of_drives(scene: Scene) -> cKDTree | None:
    return cKDTree(scene.drive_xyh_m[:, :2]) if len(scene.drive_xyh_m) else None


def _to_wall(scene: Scene, x_m: float, y_m: float) -> float:
    """Returns the distance from a place to the nearest long upright surface (m), at most 3."""
    away = [r.distance_m(x_m, y_m, 0.5) for r in regions_of(scene) if r.length_m > _FRONT_M]
    return min([_WALL_M, *away])


JUDGES: Final = {
    "cabinet": Judge("cabinet", "f29535a576659f13"),
    "bin": Judge("bin", "ed8aba39493cdb10"),
    "bench": Judge("bench", "3d81bf431eefd225"),
    "hydrant": Judge("hydrant", "dd52d58273b44ab2"),
    "bus_shelter": Judge("bus_shelter", "aa20f2c467b5fd5f"),
}
"""Who is asked whether a compact thing is of a type."""
_LEAST: Final = 0.5
"""Less probable things are left out."""
_APART_M: Final = 0.5  # Things nearer to one another (m) are one.
_GROUND_SIGMA_M: Final = 0.03  # 1 σ of the height of the ground at a foot (m).
_EDGE_SIGMA_M: Final = 0.05
"""1 σ of where the end of a thing lies beyond its outermost returns (m): a third of the cells that part things."""
_SIZE_SIGMA_M: Final = 0.14
"""1 σ of lengths and widths (m): that of 18 things on three streets that the judges had not seen."""


class StreetFurniture(AssetKind):
    """Street furniture, from compact things."""

    name = "street_furniture"
    title = "Street furniture"
    piece_schema = schema_of(["asset_height_m", "length_m", "width_m", "heading_deg"], ["type"])

    def evidence(self, scene: Scene, options: Any) -> Evidence:
        """Returns what is probably furniture and whose middle lies in the tile."""
        told = _furniture_of(scene)
        pieces = pieces_of(scene, [_place(scene, *one) for one in told], self.piece_schema)
        return Evidence(pieces, tuple(Marked(thing.rows, classes.FURNITURE) for thing, _, _ in told))

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Returns an object for each thing."""
        return objects_at_places(pieces, _APART_M)


@once_a_scene
def _furniture_of(scene: Scene) -> list[tuple[Compact, str, float]]:
    return told_apart(compact_things(scene))


def told_apart(things: list[Compact]) -> list[tuple[Compact, str, float]]:
    """Returns the things that are probably furniture, each with its most probable type and that probability."""
    features = [one.features for one in things]
    stated = np.column_stack([judge.of_each(features) for judge in JUDGES.values()])
    best, types = stated.argmax(axis=1).tolist(), list(JUDGES)
    told = [(one, types[k], float(p[k])) for one, k, p in zip(things, best, stated, strict=True)]
    return [one for one in told if one[2] >= _LEAST]


def _place(scene: Scene, thing: Compact, kind: str, probability: float) -> Place:
    ground = float(scene.ground.height_at(thing.x_m, thing.y_m))
    values: dict[str, float | str | None] = {
        "asset_height_m": thing.height_m, "length_m": thing.length_m, "width_m": thing.width_m,
        "heading_deg": thing.heading_deg, "type": kind,
    }  # fmt: skip
    return Place(
        thing.x_m, thing.y_m, ground, _EDGE_SIGMA_M, _GROUND_SIGMA_M, probability, thing.rows, values,
        _SIZE_SIGMA_M,
    )  # fmt: skip
