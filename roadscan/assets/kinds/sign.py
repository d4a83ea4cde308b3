"""Road signs and boards: bright plates, upright, 5 feet above the ground or more (Lin et al. 2016, 4.1.2).

What might be a plate is found in two ways: bright returns that lie together, and returns on thin upright elements that
belong to no large surface. Whether it is one is judged by its features (:mod:`roadscan.assets.upright.plate_outlines`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final

import numpy as np
import pyarrow as pa
from pydantic import Field

from roadscan.assets import classes
from roadscan.assets.judgement.judge import Judge
from roadscan.assets.kind import AssetKind, AssetObject, Evidence, KindOptions, Marked, object_names
from roadscan.assets.quantiles import median, quantiles
from roadscan.assets.scene import Scene, once_a_scene
from roadscan.assets.upright.brightness import brightness
from roadscan.assets.upright.pieces import Place, objects_at_places, pieces_of, schema_of
from roadscan.assets.upright.plate_beams import beams_of, sight_at
from roadscan.assets.upright.plate_outlines import Outline, PlaneOfPlate, Spot, features_of, outline_of
from roadscan.assets.upright.regions import on_thin, regions_of
from roadscan.assets.upright.shafts import shafts_of
from roadscan.assets.upright.slices import places_of, touching, usable
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.arrays import SIGMA_OF_MAD

_VOXEL_M: Final = 0.2  # Edge of a voxel (m).
_THICK_M: Final = 0.06  # Greatest distance of a plate's returns from its plane (m).
_SEARCHED_ABOVE_M: Final = 1.0  # Bright returns are sought above this height (m).
_BESIDE_M: Final = 0.7
"""Returns this far beyond a cluster (m) show the size of its plate."""
_LEAST_BRIGHT: Final = 8  # Least number of bright returns of a plate.
_FOOT_M, _BAND_M, _BEHIND_M = 0.3, 0.3, 0.15
"""Below a plate, bands of this height are searched, from this height above the ground, this far before and behind its
plane (m)."""
_ITSELF: Final = 0.7
"""A shaft of which a plate contains this share is that plate."""
_BACK_TO_BACK_M: Final = 0.04
"""Two plates on one post are at least this far apart (m); the two sides of one plate are not."""
_ENOUGH_BRIGHT: Final = 60
"""Number of bright returns that suffice for the outline, …"""
_MOST_BRIGHT: Final = 0.85
"""… where they make this share of those on its plane."""
_BOARD_M: Final = 0.04
"""Boards, which are larger than signs, are plane within this (m), poses of several passes included."""
_POST_M: Final = 0.15
"""Levels of a plate narrower than this (m), or than an eighth of the widest, are its post."""
_POST_GOES_ON_M: Final = 0.6
"""A post shows within this distance beyond the plate (m), …"""
_LEAST_OF_POST: Final = 3
"""… by so many returns or more, …"""
_POST_RIM_M: Final = 0.02
"""… and returns so near to one of these, besides the spot, may be its own (m)."""
_MOST_OF_POST: Final = 0.6
"""Where more of the plate's returns than this share stand over what goes on beyond it, that is no post."""
_RIM_SHARE: Final = 0.7
"""Beside returns of full brightness those of this share of it belong to a plate: spots at its rim, dark symbols."""
_LOOKED_AT: Final = 0.85
"""Plates of this share of the least size are still looked at; the side of a post that shows 2 σ less is none."""
_SAME_PLATE: Final = 0.3
"""Of candidates that share so many of their returns the most probable one is kept."""
_SPOT_SHARE: Final = 0.25
"""1 σ of where within its spot the middle of a beam lies that a plate just stops, as a share of half the spot."""
_USUAL_HALF_RAD: Final = math.radians(0.17 / 2.0)
"""Half the angle of a beam whose width is not known (rad): that of common spinning lidars."""
_PASSED: Final = 0.67
"""A plate stands where no line passes. Where more than this share of the lines at its middle end far behind it, what
they met has moved; one that was put up between two passes is met by about half of them."""
JUDGE: Final = Judge("sign", "82d20c25ece54bb4")


class SignOptions(KindOptions):
    """What counts as a sign."""

    intensity_ratio: float = Field(default=2.0, gt=1.0)
    """Least light of a bright return, as a multiple of the median of upright things at its range."""
    least_height_m: float = Field(default=1.524, ge=0.0)
    """Least height of the plate's middle above the ground (m): 5 feet."""
    greatest_height_m: float = Field(default=9.0, gt=1.0)
    """Greatest height of the plate's middle above the ground (m)."""
    least_size_m: float = Field(default=0.4, gt=0.05)
    """Least width and height of a plate (m); plates of 0.85 of it are still looked at."""
    greatest_size_m: float = Field(default=1.6, gt=0.1)
    """Greatest width and height of a sign (m)."""
    greatest_board_m: float = Field(default=12.0, gt=0.1)
    """Greatest width of a board, which is larger than a sign and has to be plane within 3 cm (m)."""
    greatest_tilt_deg: float = Field(default=20.0, ge=0.0, le=90.0)
    """Greatest angle of a plate from upright (degrees)."""


@dataclass(frozen=True, eq=False)
class Plate:
    """A measured plate."""

    rows: Int64
    middle_m: tuple[float, float, float]
    """x and y from the corner of the returns, height."""
    outline: Outline
    facing_deg: float
    tilt_deg: float
    clearance_m: float
    features: Mapping[str, float]
    probability: float = math.nan
    """NaN: not yet judged."""


@once_a_scene
def plates_of(scene: Scene, options: SignOptions) -> list[Plate]:
    """Returns plates of which the scene's tile may contain a part, by their place."""
    found = candidates_of(scene, options)
    if not found:
        return []
    features = {name: np.array([one.features[name] for one in found]) for name in found[0].features}
    stated = JUDGE.probability(features).tolist()
    taken, kept = np.zeros(len(scene.returns), np.bool_), []
    for one, p in sorted(zip(found, stated, strict=True), key=lambda pair: (-pair[1], pair[0].middle_m)):
        if taken[one.rows].mean() < _SAME_PLATE:
            kept.append(replace(one, probability=p))
            taken[one.rows] = True
    return sorted(kept, key=lambda plate: plate.middle_m)


def candidates_of(scene: Scene, options: SignOptions) -> list[Plate]:
    """Returns what might be plates, by their place; they are not yet judged, and some may be one and the same."""
    bright, sure = (_bright(scene, share * options.intensity_ratio) for share in (_RIM_SHARE, 1.0))
    free = ~_in_large_planes(scene, options.greatest_board_m)
    found = _plates(scene, np.flatnonzero(bright & free), bright, options)
    found = [one for one in found if sure[one.rows].sum() >= _LEAST_BRIGHT]
    thin = on_thin(scene) & free & (scene.above_ground_m > _SEARCHED_ABOVE_M)
    found += _plates(scene, np.flatnonzero(thin), bright, options)
    found = sorted((p for p in found if not _on_thick_shaft(scene, p)), key=lambda p: p.middle_m)
    return _with_sight(scene, found)


def _with_sight(scene: Scene, found: list[Plate]) -> list[Plate]:
    """Returns plates with the features of the sight lines at them, without those through which most lines pass.

    So the sides of vehicles that drive beside the rig are no plates, from however many places they were seen.
    """
    if not found:
        return []
    lie = [(p.middle_m, _unit_vectors(p.facing_deg, p.tilt_deg), p.outline) for p in found]
    table = np.array([[*middle, *axes, shape.width_m / 2, shape.height_m / 2] for middle, axes, shape in lie])
    sight = sight_at(scene, table)
    passed = sight.pop("passed")
    return [replace(p, features={**p.features, **{name: float(values[k]) for name, values in sight.items()}})
            for k, p in enumerate(found) if not passed[k] > _PASSED]  # fmt: skip


def _unit_vectors(facing_deg: float, tilt_deg: float) -> Float64:
    """Returns the unit vectors along the normal and to the right (6,) of a plate."""
    facing, tilt = math.radians(facing_deg), math.radians(tilt_deg)
    flat = np.array([math.sin(facing), math.cos(facing)])
    return np.array([*(math.cos(tilt) * flat), math.sin(tilt), -flat[1], flat[0], 0.0])


def _plates(scene: Scene, rows: Int64, bright: Bool, options: SignOptions) -> list[Plate]:
    """Returns plates of clusters of rows."""
    clusters = [side for cluster in _clusters(scene, rows) for side in _sides(scene, cluster)]
    found = (_plate(scene, cluster, bright, options) for cluster in clusters)
    return [one for one in found if one is not None]


def _on_thick_shaft(scene: Scene, plate: Plate) -> bool:
    """Returns whether a plate is no wider than the trunk or mast behind it: then it is its bark or paint."""
    for shaft in shafts_of(scene):
        x, y = shaft.axis.at(plate.middle_m[2])
        away = math.hypot(float(x) - plate.middle_m[0], float(y) - plate.middle_m[1])
        wider = plate.outline.width_m >= 3.0 * shaft.axis.radius_m
        if away < shaft.axis.radius_m + 0.15 and not wider and np.isin(shaft.rows, plate.rows).mean() < _ITSELF:
            return True
    return False


def _bright(scene: Scene, ratio: float) -> Bool:
    """Returns a mask (n,) of returns more than a metre above the ground, of this brightness or more."""
    return usable(scene) & (scene.above_ground_m > _SEARCHED_ABOVE_M) & (brightness(scene) >= ratio)


def _in_large_planes(scene: Scene, longest_m: float) -> Bool:
    """Returns a mask (n,) of returns on upright surfaces that are too long for a plate, or that reach the ground."""
    out = np.zeros(len(scene.returns), np.bool_)
    for region in regions_of(scene):
        if region.length_m > longest_m or (region.length_m > 2.5 and region.low_above_m < 1.0):
            out[region.rows] = True
    return out


def _clusters(scene: Scene, rows: Int64) -> list[Int64]:
    """Returns clusters of rows in voxels of 0.2 m that touch, also at corners, by their first row."""
    if rows.size == 0:
        return []
    returns, window = scene.returns, scene.window
    cells = np.column_stack(
        [
            np.floor((returns.x_m[rows] - window.x_min_m) / _VOXEL_M),
            np.floor((returns.y_m[rows] - window.y_min_m) / _VOXEL_M),
            np.floor(scene.above_ground_m[rows] / _VOXEL_M),
        ]
    ).astype(np.int64)
    span = cells.max(axis=0) + 3
    flat = (cells[:, 0] + 1) + span[0] * ((cells[:, 1] + 1) + span[1] * (cells[:, 2] + 1))
    voxels, owner = np.unique(flat, return_inverse=True)
    steps = [
        i + span[0] * (j + span[1] * k)
        for k in (-1, 0, 1)
        for j in (-1, 0, 1)
        for i in (-1, 0, 1)
        if (k, j, i) > (0, 0, 0)
    ]
    label = touching(voxels, steps)
    order = np.argsort(label[owner], kind="stable")
    parts = np.split(rows[order], np.flatnonzero(np.diff(label[owner][order])) + 1)
    return [np.sort(p) for p in parts if p.size >= _LEAST_BRIGHT]


def _plane(xyh: Float64) -> tuple[Float64, Float64, float]:
    """Returns middle, unit normal and root mean square residual of points (n, 3), outliers left out twice."""
    kept = np.ones(len(xyh), np.bool_)
    for _ in range(3):
        middle = xyh[kept].mean(axis=0)
        _, _, axes = np.linalg.svd(xyh[kept] - middle, full_matrices=False)
        away = np.abs((xyh - middle) @ axes[2])
        limit = max(3.0 * SIGMA_OF_MAD * median(away[kept]), 0.02)
        kept = away <= limit
        if kept.sum() < 5:
            kept[:] = True
    return middle, axes[2], float(np.sqrt(np.mean(away[kept] ** 2)))


def _sides(scene: Scene, cluster: Int64) -> list[Int64]:
    """Returns a cluster, or its two sides: two plates back to back, each seen from its front."""
    returns = scene.returns
    xyh = np.column_stack([returns.x_m[cluster], returns.y_m[cluster], returns.height_m[cluster]])
    middle, normal, _ = _plane(xyh)
    front = _in_front(scene, cluster, middle, normal)
    if min(front.sum(), (~front).sum()) < _LEAST_BRIGHT:
        return [cluster]
    past = (xyh - middle) @ normal
    apart = median(past[front]) - median(past[~front])
    return [cluster[front], cluster[~front]] if apart > _BACK_TO_BACK_M else [cluster]


def _plate(scene: Scene, cluster: Int64, bright: Bool, options: SignOptions) -> Plate | None:
    """Returns the plate of a cluster of bright returns; None where it is none."""
    returns = scene.returns
    xyh = np.column_stack([returns.x_m[cluster], returns.y_m[cluster], returns.height_m[cluster]])
    spread = np.ptp(xyh, axis=0)
    reach = 0.5 * math.hypot(spread[0], spread[1]) + _BESIDE_M
    if not scene.tile.comes_near(xyh[:, :2], reach):
        return None
    if math.hypot(spread[0], spread[1]) > options.greatest_board_m or spread[2] > options.greatest_board_m:
        return None
    middle, normal, residual = _plane(xyh)
    tilt = math.degrees(math.asin(min(abs(float(normal[2])), 1.0)))
    if tilt > options.greatest_tilt_deg:
        return None
    seen = np.array([np.median(returns.sensor_x_m[cluster]), np.median(returns.sensor_y_m[cluster])])
    normal = normal if float(normal[:2] @ (seen - middle[:2])) > 0.0 else -normal
    near = places_of(scene).within(float(middle[0]), float(middle[1]), reach)
    inside, _ = _on_plane(scene, near, middle, normal, xyh)
    wide = _wide(scene, np.union1d(cluster, inside), middle, normal)
    whole = np.column_stack([returns.x_m[wide], returns.y_m[wide], returns.height_m[wide]])
    inside, about = _on_plane(scene, near, middle, normal, whole)
    inside = inside[_in_front(scene, inside, middle, normal) | ~bright[inside]]
    rows = np.union1d(cluster, inside)
    wide = _wide(scene, rows, middle, normal)
    lit, facing = wide[bright[wide]], _in_front(scene, wide, middle, normal).sum()
    edge = lit if lit.size >= max(_ENOUGH_BRIGHT, _MOST_BRIGHT * facing) else wide
    right, up = _axes(normal)
    placed = np.column_stack([returns.x_m[edge], returns.y_m[edge], returns.height_m[edge]]) - middle
    outline = outline_of(np.column_stack([placed @ right, placed @ up]))
    place = middle + outline.middle[0] * right + outline.middle[1] * up
    ground = float(scene.ground.height_at(place[0], place[1]))
    above = float(place[2]) - ground
    if not _has_size(outline, options) or not options.least_height_m <= above <= options.greatest_height_m:
        return None
    large = max(outline.width_m, outline.height_m) > options.greatest_size_m
    if large and residual > _BOARD_M:
        return None
    if _stands(scene, near, (place, normal), outline, ground):
        return None
    beams = beams_of(scene, _without_post(scene, edge, PlaneOfPlate(rows, near, middle, normal, right, up)), rows,
                     middle, (right, up))  # fmt: skip
    outline = outline_of(np.column_stack([placed @ right, placed @ up]), beams, _spot(scene, edge))
    if min(outline.width_m, outline.height_m) + 2.0 * outline.sigma_m < _LOOKED_AT * options.least_size_m:
        return None
    place = middle + outline.middle[0] * right + outline.middle[1] * up
    above = float(place[2]) - ground
    plane = PlaneOfPlate(rows, near, place, normal, right, up)
    features = features_of(scene, plane, outline, beams, residual, about, above)
    azimuth = math.degrees(math.atan2(float(normal[0]), float(normal[1]))) % 360.0
    lean = math.degrees(math.asin(max(-1.0, min(1.0, float(normal[2])))))
    clearance = above - outline.height_m / 2
    return Plate(rows, tuple(map(float, place)), outline, azimuth, lean, clearance, features)  # type: ignore[arg-type]


def _without_post(scene: Scene, edge: Int64, plane: PlaneOfPlate) -> Int64:
    """Returns the returns that tell the outline, without those of a post just below or above the plate.

    A post lies in the columns that go on beyond the plate. What these hold beyond the outermost return beside them is
    its own.
    """
    u, v, _ = plane.placed(scene, edge)
    own_u, own_v, away = plane.placed(scene, plane.near)
    reach = _spot(scene, edge)
    reach_m = reach.half_m + reach.doubt_m + _POST_RIM_M
    kept = np.ones(edge.size, np.bool_)
    for side in (-1.0, 1.0):
        end = float((side * v).max())
        going_on = (side * own_v > end) & (side * own_v < end + _POST_GOES_ON_M) & (away < _BEHIND_M)
        columns = np.sort(own_u[going_on & (own_u > u.min()) & (own_u < u.max())])
        if columns.size < _LEAST_OF_POST:
            continue
        at = np.searchsorted(columns, u)
        left, right = columns[np.maximum(at - 1, 0)], columns[np.minimum(at, columns.size - 1)]
        on_post = np.minimum(np.abs(u - left), np.abs(u - right)) < reach_m
        if on_post.mean() < _MOST_OF_POST:
            kept &= ~(on_post & (side * v > float((side * v[~on_post]).max())))
    return edge[kept]


def _spot(scene: Scene, rows: Int64) -> Spot:
    """Returns the spot of the beams that met some rows."""
    range_m = float(np.median(scene.returns.ranges_m(rows)))
    half_rad = float(np.median(scene.returns.half_beam_rad(rows)))
    if math.isnan(half_rad):
        return Spot(0.0, range_m * _USUAL_HALF_RAD)
    return Spot(range_m * math.tan(half_rad), _SPOT_SHARE * range_m * math.tan(half_rad))


def _in_front(scene: Scene, rows: Int64, middle: Float64, normal: Float64) -> Bool:
    """Returns a mask of the returns seen from the front of a plane."""
    returns = scene.returns
    sensor = np.column_stack([returns.sensor_x_m[rows], returns.sensor_y_m[rows]]) - middle[:2]
    front: Bool = ~(sensor @ normal[:2] < 0.0)
    return front


def _axes(normal: Float64) -> tuple[Float64, Float64]:
    """Returns the axes right, seen from the front, and up, in a plane of a unit normal."""
    right = np.array([-normal[1], normal[0], 0.0])
    right /= np.hypot(right[0], right[1])
    return right, np.cross(normal, right)


def _on_plane(scene: Scene, near: Int64, middle: Float64, normal: Float64, cluster: Float64) -> tuple[Int64, float]:
    """Returns the returns on the plane within the box of the cluster, and the share of those just outside it."""
    returns = scene.returns
    past = np.column_stack([returns.x_m[near], returns.y_m[near], returns.height_m[near]]) - middle
    right, up = _axes(normal)
    u, v, away = past @ right, past @ up, np.abs(past @ normal)
    cu, cv = (cluster - middle) @ right, (cluster - middle) @ up
    box = [quantiles(c, [0.01, 0.99]) for c in (cu, cv)]

    def within(margin: float) -> Bool:
        (a, b), (c, d) = box
        return (u > a - margin) & (u < b + margin) & (v > c - margin) & (v < d + margin) & (away < _THICK_M)

    inside, outer = within(0.1), within(0.5)
    n = int(inside.sum())
    beside = int((outer & ~inside & (np.abs(u) > 0.15)).sum())
    return near[inside], beside / max(n + beside, 1)


def _stands(scene: Scene, near: Int64, plane: tuple[Float64, Float64], outline: Outline, ground_m: float) -> bool:
    """Whether the plane continues to the ground, about as wide: then it is an end of a pier, a wall or a box."""
    returns, (middle, normal) = scene.returns, plane
    past = np.column_stack([returns.x_m[near], returns.y_m[near], returns.height_m[near]]) - middle
    right, _ = _axes(normal)
    u, away, half = past @ right, np.abs(past[:, :2] @ normal[:2]), outline.width_m / 2
    low, high = ground_m + _FOOT_M, float(middle[2]) - outline.height_m / 2 - 0.1
    below = (away < _BEHIND_M) & (np.abs(u) < half + 0.1) & (returns.height_m[near] > low)
    below &= returns.height_m[near] < high
    band = np.floor((returns.height_m[near][below] - low) / _BAND_M).astype(np.int64)
    widths = [float(np.ptp(u[below][band == k])) for k in np.unique(band).tolist() if (band == k).sum() >= 3]
    wide = sum(w > 0.6 * outline.width_m for w in widths)
    return wide >= max(2.0, 0.6 * len(widths), 0.3 * (high - low) / _BAND_M)


def _wide(scene: Scene, rows: Int64, middle: Float64, normal: Float64) -> Int64:
    """Returns a mask of rows at the heights where the plate is wide, which excludes its post."""
    returns = scene.returns
    past = np.column_stack([returns.x_m[rows], returns.y_m[rows], returns.height_m[rows]]) - middle
    right, up = _axes(normal)
    u, level = past @ right, np.floor((past @ up) / 0.1).astype(np.int64)
    widths = {k: float(np.ptp(u[level == k])) for k in np.unique(level).tolist()}
    widest = max(widths.values())
    least = min(max(_POST_M, 0.12 * widest), 0.4 * widest)
    kept: Int64 = rows[np.array([widths[k] >= least for k in level.tolist()])]
    return kept


def _has_size(outline: Outline, options: SignOptions) -> bool:
    least = _LOOKED_AT * options.least_size_m
    small, large = sorted((outline.width_m, outline.height_m))
    return least <= small and large <= options.greatest_board_m


_LEAST = 0.5  # Least probability of a plate.
_APART_M = 0.3  # Plates nearer to one another (m) are one.
_BESIDE_POST_M = 0.4
"""Distance of a plate's middle before the axis of its post (m); the two posts of a board stand within its width."""
_BELOW_M = 0.3
"""A post reaches to the plate's lower edge, or appears to end this far below it (m)."""


class Sign(AssetKind):
    """Plates, from bright returns; the place is the middle of the plate."""

    name = "sign"
    title = "Road Signs/Boards"
    curve = "products"
    options = SignOptions
    after: ClassVar[Sequence[str]] = ("pole", "lighting", "signal")
    piece_schema = schema_of(
        ["width_m", "plate_height_m", "clearance_m", "facing_deg", "tilt_deg"], ["message", "type", "shape", "colour"]
    )

    def evidence(self, scene: Scene, options: SignOptions) -> Evidence:
        """Returns plates whose middle lies in the tile."""
        found = [p for p in plates_of(scene, options) if p.probability >= _LEAST]
        pieces = pieces_of(scene, [_place(p) for p in found], self.piece_schema)
        return Evidence(pieces, tuple(Marked(p.rows, classes.SIGN) for p in found))

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Yields an object for each plate, with the post that carries it."""
        posts = [(kind, one) for kind in self.after for one in others.get(kind, ())]
        for sign in objects_at_places(pieces, _APART_M):
            yield replace(sign, attributes={**sign.attributes, "post": _post_of(sign, posts)})


def _post_of(sign: AssetObject, posts: Iterable[tuple[str, AssetObject]]) -> str | None:
    """Returns the name of the nearest post at a sign; None where none stands at it."""
    plate, values = sign.geometry, sign.attributes
    near: list[tuple[float, str]] = []
    for kind, post in posts:
        foot = post.geometry
        away = math.hypot(foot.x - plate.x, foot.y - plate.y)
        lean = math.tan(math.radians(post.attributes.get("lean_deg") or 0.0)) * (plate.z - foot.z)
        reaches = (post.attributes.get("asset_height_m") or 0.0) >= values["clearance_m"] - _BELOW_M
        if reaches and away <= max(_BESIDE_POST_M, values["width_m"] / 2) + lean:
            near.append((away, object_names(kind, np.array([[foot.x, foot.y]]))[0]))
    return min(near, default=(0.0, None))[1]


def _place(plate: Plate) -> Place:
    sigma = max(0.01, plate.outline.misfit_m / 3.0)
    values: dict[str, float | str | None] = {
        "width_m": plate.outline.width_m, "plate_height_m": plate.outline.height_m, "shape": plate.outline.shape,
        "clearance_m": max(plate.clearance_m, 0.0), "facing_deg": plate.facing_deg, "tilt_deg": plate.tilt_deg,
    }  # fmt: skip
    return Place(*plate.middle_m, sigma, sigma, plate.probability, plate.rows, values, plate.outline.sigma_m)
