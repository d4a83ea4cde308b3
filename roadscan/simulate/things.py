"""Standing and moving objects beside the road of a scene, and the simple bodies of which they consist."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.simulate.kernels import things as body
from roadscan.simulate.kernels.road import STATION
from roadscan.simulate.scene import Scene
from roadscan.simulate.scene.roadside import (
    Barrier,
    Box,
    Facade,
    Fence,
    Guardrail,
    LampPost,
    MovingCar,
    Overhead,
    ParkedCar,
    Planting,
    Pole,
    Sign,
    Signal,
    Standing,
    Tree,
)
from roadscan.simulate.surface import Surface

Float64 = npt.NDArray[np.float64]

PIECE_M: Final = 2.0
"""Barriers follow the road in straight pieces no longer than this (m)."""
BURIED_M: Final = 0.3
"""Depth below the ground to which objects extend, so that no beam passes beneath them (m)."""
_POST_RADIUS_M: Final = 0.03  # of posts of signs
_RAIL_POST_RADIUS_M: Final = 0.05  # of posts of guardrails
_PLATE_BEFORE_POST_M: Final = 0.04  # from a post's middle to a sign's face
_PLATE_M: Final = 1e-6
"""Distance from a sign's face to its back (m): two thin bodies, of which a beam meets the one on its side."""
_PLATES: Final = {
    "rectangle": body.WALL, "round": body.DISC, "triangle": body.TRIANGLE, "octagon": body.OCTAGON,
    "diamond": body.DIAMOND,
}  # fmt: skip
_HEIGHT_SHARE: Final = {"round": 1.0, "triangle": math.sqrt(3.0) / 2.0, "octagon": 1.0, "diamond": 1.0}  # of width
_ARM_M: Final = 0.12  # thickness of an arm
_LAMP_M: Final = (0.5, 0.25, 0.12)  # width, length and height of a lamp
_WHEEL_M: Final = (0.62, 0.20, 0.60)  # length, width and greatest height of a wheel
_CLEARANCE_SHARE, _BODY_SHARE, _CABIN_SHARE, _CABIN_BACK = 0.14, 0.62, 0.55, 0.06  # of height or length
_RUBBER: Final = 30.0  # intensity of tyres


@dataclass(frozen=True)
class Object:
    """One object of the truth."""

    id: int
    """Number from 1."""
    kind: str
    station_m: float
    offset_m: float
    enh_m: tuple[float, float, float]
    """Foot, from the scene's origin: easting, northing, height of the ground (m)."""
    size_m: tuple[float, float, float]
    """Length along its heading, width, height."""
    heading_rad: float
    """Grid heading of its length."""
    intensity: float
    bodies: Float64 = field(repr=False)
    """(n, 18), see :mod:`roadscan.simulate.kernels.things`."""
    speed_m_per_s: float = 0.0


def objects_of(scene: Scene, surface: Surface) -> list[Object]:
    """Return all standing objects beside the road, in the order of the scene, numbered from 1."""
    return [_object(i + 1, *described, surface) for i, described in enumerate(_standing(scene))]


def moving_objects(scene: Scene, surface: Surface) -> list[Object]:
    """Return the moving cars at the first profile of their first pass; numbers continue those of standing objects."""
    first = sum(1 for _ in _standing(scene)) + 1
    out = []
    for i, car in enumerate(scene.roadside.moving_cars):
        place = _place(surface, car.station_m, car.offset_m)
        turned = place.heading_rad + (math.pi if car.speed_m_per_s < 0 else 0.0)
        bodies = car_bodies(place.enh_m, turned, car.length_m, car.width_m, car.height_m, car.shade, None)
        size = (car.length_m, car.width_m, car.height_m)
        out.append(
            Object(
                first + i, "moving_car", car.station_m, car.offset_m, place.enh_m, size, turned, car.shade, bodies,
                car.speed_m_per_s,
            )
        )  # fmt: skip
    return out


def objects_table(scene: Scene, surface: Surface) -> pa.Table:
    """Return all objects of a scene as a table for the truth.

    Columns: object_id, kind, station_m, offset_m, easting_m, northing_m, height_m (of the foot), length_m, width_m,
    size_up_m, heading_deg (of its length, clockwise from grid north), intensity, speed_m_per_s (along the road; what
    moves is stated where it is at the first profile of each pass in which it drives).
    """
    first, last = scene.stations_m
    found = objects_of(scene, surface)
    found += [o for o in moving_objects(scene, surface) if first <= o.station_m <= last]
    places = np.array([o.enh_m for o in found], dtype=np.float64).reshape(-1, 3) + surface.origin_enh_m
    sizes = np.array([o.size_m for o in found], dtype=np.float64).reshape(-1, 3)
    heading = np.degrees(np.mod([o.heading_rad for o in found], 2 * math.pi))
    return pa.table(
        {
            "object_id": pa.array([o.id for o in found], pa.int32()),
            "kind": pa.array([o.kind for o in found], pa.string()),
            "station_m": pa.array([o.station_m for o in found], pa.float64()),
            "offset_m": pa.array([o.offset_m for o in found], pa.float64()),
            "easting_m": places[:, 0],
            "northing_m": places[:, 1],
            "height_m": places[:, 2],
            "length_m": sizes[:, 0],
            "width_m": sizes[:, 1],
            "size_up_m": sizes[:, 2],
            "heading_deg": pa.array(heading, pa.float64()),
            "intensity": pa.array([o.intensity for o in found], pa.float64()),
            "speed_m_per_s": pa.array([o.speed_m_per_s for o in found], pa.float64()),
        }
    )


def _standing(scene: Scene) -> Iterator[tuple[str, Standing | Barrier, float]]:
    """Yield kind, description and station of every standing object."""
    side = scene.roadside
    kinds: tuple[tuple[str, Sequence[Standing | Barrier]], ...] = (
        ("sign", side.signs), ("pole", side.poles), ("lamp_post", side.lamp_posts), ("tree", side.trees),
        ("parked_car", side.parked_cars), ("guardrail", side.guardrails), ("fence", side.fences),
        ("facade", side.facades), ("box", side.boxes), ("signal", side.signals), ("overhead", side.overheads),
        ("planting", side.plantings),
    )  # fmt: skip
    for kind, described in kinds:
        for one in described:
            on_road = _on_road(one, *scene.stations_m)
            for station in _stations(on_road, *scene.stations_m):
                yield kind, on_road, station


def described_signs(scene: Scene) -> list[tuple[int, Sign]]:
    """Return numbers and descriptions of the standing signs."""
    numbered = enumerate(_standing(scene), 1)
    return [(number, one) for number, (_, one, _) in numbered if isinstance(one, Sign)]


def _on_road(one: Standing | Barrier, first_m: float, last_m: float) -> Standing | Barrier:
    """Return the description, with a barrier limited to the road."""
    if not isinstance(one, Barrier) or first_m <= one.start_m <= one.end_m <= last_m:
        return one
    return one.model_copy(update={"start_m": max(one.start_m, first_m), "end_m": min(one.end_m, last_m)})


def _stations(one: Standing | Barrier, first_m: float, last_m: float) -> list[float]:
    """Return the stations of a description's objects that are on the road."""
    if isinstance(one, Barrier):
        return [one.start_m] if one.start_m < one.end_m else []
    count = one.count if one.every_m > 0.0 else 1
    stations = [one.station_m + n * one.every_m for n in range(count)]
    return [s for s in stations if first_m <= s <= last_m]


@dataclass(frozen=True)
class _Place:
    """A place on the ground."""

    station_m: float
    offset_m: float
    enh_m: tuple[float, float, float]
    """From the scene's origin."""
    heading_rad: float
    """Of the road."""

    def beside(self, ahead_m: float, right_m: float, heading_rad: float) -> tuple[float, float]:
        """Return easting and northing of a point ahead and to the right along a heading."""
        s, c = math.sin(heading_rad), math.cos(heading_rad)
        return self.enh_m[0] + ahead_m * s + right_m * c, self.enh_m[1] + ahead_m * c - right_m * s


def _place(surface: Surface, station_m: float, offset_m: float) -> _Place:
    e, n, heading = surface.place(station_m, offset_m)
    origin = surface.origin_enh_m
    e0, n0 = float(e) - float(origin[0]), float(n) - float(origin[1])
    return _Place(station_m, offset_m, (e0, n0, _ground(surface, e0, n0)), float(heading))


def _ground(surface: Surface, easting: float, northing: float) -> float:
    """Return the height of the ground at a place from the origin (m), extended beside the surface as the verge is."""
    e, n = easting + surface.origin_enh_m[0], northing + surface.origin_enh_m[1]
    height = float(surface.height_m(e, n, texture=False))
    if math.isnan(height):
        station, offset = surface.station_offset_m(e, n)
        height = float(surface.points_at(np.atleast_1d(station), np.atleast_1d(offset))[0, 2])
    return height - float(surface.origin_enh_m[2])


# --- bodies ------------------------------------------------------------------------------------------


def _body(
    kind: float,
    place: tuple[float, float],
    heading_rad: float,
    half: tuple[float, float],
    low_high: tuple[float, float],
    shade: float,
    density: float = 1.0,
) -> Float64:
    """Return a body's row (18,)."""
    row = np.zeros(body.BODY_COLUMNS)
    row[body.KIND] = kind
    row[[body.EASTING, body.NORTHING]] = place
    row[[body.SINE, body.COSINE]] = math.sin(heading_rad), math.cos(heading_rad)
    row[[body.HALF_LENGTH, body.HALF_WIDTH]] = half
    row[[body.LOW, body.HIGH]] = row[[body.LOW_END, body.HIGH_END]] = low_high
    row[[body.INTENSITY, body.DENSITY]] = shade, density
    return row


def _post(place: tuple[float, float], low: float, high: float, radius: float, shade: float) -> Float64:
    return _body(body.CYLINDER, place, 0.0, (radius, 0.0), (low - BURIED_M, high), shade)


def _walls(points: Float64, low: Float64, high: Float64, shade: float, skirt: float, density: float = 1.0) -> Float64:
    """Return walls (n, 18) between points (n + 1, 2), with heights (n + 1,) of their lower and upper edge."""
    rows = np.zeros((len(points) - 1, body.BODY_COLUMNS))
    run = np.diff(points, axis=0)
    length = np.hypot(run[:, 0], run[:, 1])
    rows[:, body.KIND] = body.WALL
    rows[:, [body.EASTING, body.NORTHING]] = (points[:-1] + points[1:]) / 2
    rows[:, [body.SINE, body.COSINE]] = run / length[:, None]
    rows[:, body.HALF_LENGTH] = length / 2
    rows[:, body.LOW], rows[:, body.LOW_END] = low[:-1], low[1:]
    rows[:, body.HIGH], rows[:, body.HIGH_END] = high[:-1], high[1:]
    rows[:, body.SKIRT] = skirt
    rows[:, body.INTENSITY], rows[:, body.DENSITY] = shade, density
    return rows


def car_bodies(
    foot: tuple[float, float, float],
    heading_rad: float,
    length_m: float,
    width_m: float,
    height_m: float,
    shade: float,
    wheel_feet: Sequence[float] | None,
) -> Float64:
    """Return bodies (6, 18) of a car: body, cabin, four wheels.

    wheel_feet : height of the ground under each wheel (m); that under the car's middle where left out.
    """
    place = _Place(0.0, 0.0, foot, heading_rad)
    z = foot[2]
    middle = (foot[0], foot[1])
    low, waist = z + _CLEARANCE_SHARE * height_m, z + _BODY_SHARE * height_m
    back = place.beside(-_CABIN_BACK * length_m, 0.0, heading_rad)
    cabin = (_CABIN_SHARE * length_m / 2, 0.45 * width_m)
    rows = [
        _body(body.BOX, middle, heading_rad, (length_m / 2, width_m / 2), (low, waist), shade),
        _body(body.BOX, back, heading_rad, cabin, (waist, z + height_m), shade),
    ]
    wheel = (_WHEEL_M[0] / 2, _WHEEL_M[1] / 2)
    top = z + min(_WHEEL_M[2], _BODY_SHARE * height_m)
    for i, (ahead, right) in enumerate(wheel_places(length_m, width_m)):
        foot_m = z if wheel_feet is None else wheel_feet[i]
        at = place.beside(ahead, right, heading_rad)
        rows.append(_body(body.BOX, at, heading_rad, wheel, (foot_m - 0.05, top), _RUBBER))
    return np.stack(rows)


def wheel_places(length_m: float, width_m: float) -> list[tuple[float, float]]:
    """Return the middle of each wheel: ahead and to the right of the car's middle (m)."""
    right = width_m / 2 - _WHEEL_M[1] / 2 + 0.01
    return [(a * 0.31 * length_m, b * right) for a in (1.0, -1.0) for b in (-1.0, 1.0)]


# --- objects -----------------------------------------------------------------------------------------


def _object(number: int, kind: str, one: Standing | Barrier, station_m: float, surface: Surface) -> Object:
    """Return the object of a description at one of its stations."""
    place = _place(surface, station_m, one.offset_m)
    size, turned, bodies = _made(one, place, surface)
    shade = one.shade  # type: ignore[union-attr]  # every concrete description has one
    heading = place.heading_rad + turned
    return Object(number, kind, station_m, one.offset_m, place.enh_m, size, heading, shade, bodies)


@functools.singledispatch
def _made(one: object, place: _Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    """Return size (length, width, height), heading past the road's (rad) and bodies (n, 18) of an object."""
    raise TypeError(f"nothing stands for {type(one).__name__}")


@_made.register
def _(one: Sign, place: _Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    z = place.enh_m[2]
    height = one.width_m * _HEIGHT_SHARE[one.shape] if one.shape in _HEIGHT_SHARE else one.height_m
    low, high = z + one.clearance_m, z + one.clearance_m + height
    side = 1.0 if one.faces == "forward" else -1.0
    at = place.beside(side * _PLATE_BEFORE_POST_M, 0.0, place.heading_rad)
    kind = _PLATES[one.shape]
    behind = place.beside(side * (_PLATE_BEFORE_POST_M - _PLATE_M), 0.0, place.heading_rad)
    face, back = (
        _body(kind, middle, place.heading_rad + math.pi / 2, (one.width_m / 2, 0.0), (low, high), shade)
        for middle, shade in ((at, one.shade), (behind, one.back_shade))
    )
    post = _post(place.enh_m[:2], z, high, _POST_RADIUS_M, 120.0)
    return (one.width_m, 2 * _PLATE_BEFORE_POST_M, high - z), math.pi / 2, np.stack([face, back, post])


@_made.register
def _(one: Pole, place: _Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    z = place.enh_m[2]
    post = _post(place.enh_m[:2], z, z + one.height_m, one.diameter_m / 2, one.shade)
    return (one.diameter_m, one.diameter_m, one.height_m), 0.0, post[None]


@_made.register
def _(one: LampPost, place: _Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    z = place.enh_m[2]
    top = z + one.height_m
    inwards = -1.0 if one.offset_m > 0.0 else 1.0
    rows = [_post(place.enh_m[:2], z, top, one.diameter_m / 2, one.shade)]
    if one.arm_m > 0.0:
        lamp = (_LAMP_M[1] / 2, _LAMP_M[0] / 2)
        for side in (inwards, -inwards)[: 1 + one.is_double]:
            rows.append(_arm(place, side * one.arm_m, top, one.shade))
            end = place.beside(0.0, side * one.arm_m, place.heading_rad)
            rows.append(_body(body.BOX, end, place.heading_rad, lamp, (top - _LAMP_M[2], top), one.shade))
    return (one.diameter_m, 2 * one.arm_m + _LAMP_M[0], one.height_m), 0.0, np.stack(rows)


def _arm(place: _Place, right_m: float, top: float, shade: float) -> Float64:
    """Return an arm from a post to the right (negative: to the left) of the road's direction."""
    middle = place.beside(0.0, right_m / 2, place.heading_rad)
    return _body(body.BOX, middle, place.heading_rad, (_ARM_M / 2, abs(right_m) / 2), (top - _ARM_M, top), shade)


@_made.register
def _(one: Signal, place: _Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    z = place.enh_m[2]
    top, radius = z + one.height_m, one.diameter_m / 2
    width, depth, tall = one.head_m
    rows = [_post(place.enh_m[:2], z, top, radius, one.shade)]
    right = 0.0
    if one.arm_m > 0.0:
        right = -one.arm_m if one.offset_m > 0.0 else one.arm_m
        rows.append(_arm(place, right, top, one.shade))
    side = 1.0 if one.faces == "forward" else -1.0
    before = _ARM_M / 2 if one.arm_m > 0.0 else radius
    head = place.beside(side * (before + 0.02 + depth / 2), right, place.heading_rad)
    rows.append(_body(body.BOX, head, place.heading_rad, (depth / 2, width / 2), (top - tall, top), one.head_shade))
    return (one.diameter_m, max(one.arm_m, width), one.height_m), 0.0, np.stack(rows)


@_made.register
def _(one: Overhead, place: _Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    turned = math.radians(one.heading_deg)
    low = place.enh_m[2] + one.clearance_m
    half = (one.length_m / 2, one.width_m / 2)
    slab = _body(
        body.BOX, place.enh_m[:2], place.heading_rad + turned, half, (low, low + one.thickness_m), one.shade
    )  # fmt: skip
    return (one.length_m, one.width_m, one.clearance_m + one.thickness_m), turned, slab[None]


@_made.register
def _(one: Planting, place: _Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    rows_along, rows_across = (max(round(m / one.tuft_m), 1) for m in (one.length_m, one.width_m))
    ahead = (np.arange(rows_along) + 0.5) / rows_along * one.length_m - one.length_m / 2
    right = (np.arange(rows_across) + 0.5) / rows_across * one.width_m - one.width_m / 2
    stations, offsets = (v.ravel() for v in np.meshgrid(place.station_m + ahead, one.offset_m + right))
    at, feet = _points(surface, stations, offsets)
    # the golden ratio's multiples are spread evenly: tufts of all heights are everywhere
    tall = one.height_m * (0.5 + 0.5 * np.mod(np.arange(feet.size) * 0.6180339887, 1.0))
    radius = 0.6 * one.tuft_m
    tufts = [
        _body(body.ELLIPSOID, (e, n), 0.0, (radius, 0.0), (z - h, z + h), one.shade, one.density)
        for (e, n), z, h in zip(at.tolist(), feet.tolist(), tall.tolist(), strict=True)
    ]
    return (one.length_m, one.width_m, one.height_m), 0.0, np.stack(tufts)


@_made.register
def _(one: Tree, place: _Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    z, at = place.enh_m[2], place.enh_m[:2]
    low, high = z + max(0.3 * one.height_m, one.height_m - 1.4 * one.crown_m), z + one.height_m
    trunk = _post(at, z, (low + high) / 2, one.trunk_m / 2, 0.8 * one.shade)
    crown = _body(body.ELLIPSOID, at, 0.0, (one.crown_m / 2, 0.0), (low, high), one.shade, one.density)
    return (one.crown_m, one.crown_m, one.height_m), 0.0, np.stack([trunk, crown])


@_made.register
def _(one: ParkedCar, place: _Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    turned = math.radians(one.heading_deg)
    heading = place.heading_rad + turned
    feet = [
        _ground(surface, *place.beside(ahead, right, heading))
        for ahead, right in wheel_places(one.length_m, one.width_m)
    ]
    size = (one.length_m, one.width_m, one.height_m)
    return size, turned, car_bodies(place.enh_m, heading, *size, one.shade, feet)


@_made.register
def _(one: Box, place: _Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    turned = math.radians(one.heading_deg)
    heading = place.heading_rad + turned
    half = (one.length_m / 2, one.width_m / 2)
    corners = [
        _ground(surface, *place.beside(a * half[0], b * half[1], heading)) for a in (-1.0, 1.0) for b in (-1.0, 1.0)
    ]
    top = place.enh_m[2] + one.height_m
    low = min([*corners, place.enh_m[2]]) - BURIED_M
    size = (one.length_m, one.width_m, one.height_m)
    return size, turned, _body(body.BOX, place.enh_m[:2], heading, half, (low, max(top, low + 0.001)), one.shade)[None]


@_made.register
def _(one: Guardrail, place: _Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    points, ground = _along(surface, one, PIECE_M)
    rail = _walls(points, ground + one.height_m - one.rail_m, ground + one.height_m, one.shade, 0.0)
    # The posts are behind the rail, away from the road.
    behind = _RAIL_POST_RADIUS_M + 0.02 if one.offset_m > 0.0 else -_RAIL_POST_RADIUS_M - 0.02
    count = math.floor((one.end_m - one.start_m) / one.post_every_m + 1e-9) + 1
    stations = one.start_m + one.post_every_m * np.arange(count, dtype=np.float64)
    at, feet = _points(surface, stations, np.full(count, one.offset_m + behind))
    posts = [
        _post((e, n), z, z + one.height_m - 0.02, _RAIL_POST_RADIUS_M, one.shade)
        for (e, n), z in zip(at.tolist(), feet.tolist(), strict=True)
    ]
    return (one.end_m - one.start_m, 2 * abs(behind), one.height_m), 0.0, np.concatenate([rail, np.stack(posts)])


@_made.register
def _(one: Fence, place: _Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    points, ground = _along(surface, one, PIECE_M)
    walls = _walls(points, ground, ground + one.height_m, one.shade, BURIED_M, one.density)
    return (one.end_m - one.start_m, 0.0, one.height_m), 0.0, walls


@_made.register
def _(one: Facade, place: _Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    points, ground = _along(surface, one, PIECE_M)
    front = _walls(points, ground, ground + one.height_m, one.shade, BURIED_M)
    if one.window_m > 0.0:
        front[:, body.ALONG] = np.append(0.0, np.cumsum(2 * front[:-1, body.HALF_LENGTH]))
        front[:, [body.BAY, body.WINDOW, body.STOREY]] = one.bay_m, one.window_m, one.storey_m
    away = math.copysign(one.depth_m, one.offset_m)
    parts = [front]
    for i, station in ((0, one.start_m), (-1, one.end_m)):
        pieces = math.ceil(one.depth_m / PIECE_M)
        across = one.offset_m + away / pieces * np.arange(pieces + 1, dtype=np.float64)
        ends, _ = _points(surface, np.full(across.size, station), np.asarray(across, np.float64), heights=False)
        level = np.full(across.size, ground[i])
        parts.append(_walls(ends, level, level + one.height_m, one.shade, 10.0 * BURIED_M))
    return (one.end_m - one.start_m, one.depth_m, one.height_m), 0.0, np.concatenate(parts)


def _along(surface: Surface, one: Barrier, piece_m: float) -> tuple[Float64, Float64]:
    """Return points (n, 2) along the road and the ground there (n,), from the origin."""
    count = math.ceil((one.end_m - one.start_m) / piece_m - 1e-9)
    stations: Float64 = np.linspace(one.start_m, one.end_m, count + 1)
    return _points(surface, stations, np.full(count + 1, one.offset_m))


def _points(
    surface: Surface, stations: Float64, offsets: Float64, *, heights: bool = True
) -> tuple[Float64, Float64]:  # fmt: skip
    """Return points (n, 2) and the ground there (n,), from the origin."""
    e, n, _ = surface.place(stations, offsets)
    at = np.stack([e, n], axis=-1) - surface.origin_enh_m[:2]
    if not heights:
        return at, np.zeros(len(at))
    on_surface = surface.height_m(e, n, texture=False)
    beside = surface.points_at(np.asarray(stations, np.float64), np.asarray(offsets, np.float64))[:, 2]
    return at, np.where(np.isnan(on_surface), beside, on_surface) - surface.origin_enh_m[2]


# --- what moves --------------------------------------------------------------------------------------


def mover_bodies(
    car: MovingCar, surface: Surface, begin_s: float, end_s: float
) -> tuple[Float64, Float64] | None:  # fmt: skip
    """Return bodies (6, 18) of a moving car at the beginning of a time slot, and its velocity (3,) within it.

    begin_s, end_s : since the pass's first profile. None where the car has left the road.
    """
    stations = car.station_m + car.speed_m_per_s * np.array([begin_s, end_s])
    nodes = surface.arrays.nodes
    if stations.min() < nodes[0, STATION] or stations.max() > nodes[-1, STATION]:
        return None
    at, feet = _points(surface, stations, np.full(2, car.offset_m))
    _, _, headings = surface.place(np.array([stations.mean()]), np.array([car.offset_m]))
    heading = float(headings[0]) + (math.pi if car.speed_m_per_s < 0 else 0.0)
    foot = (float(at[0, 0]), float(at[0, 1]), float(feet[0]))
    bodies = car_bodies(foot, heading, car.length_m, car.width_m, car.height_m, car.shade, None)
    return bodies, np.append(at[1] - at[0], feet[1] - feet[0]) / (end_s - begin_s)
