"""Standing and moving objects beside the road of a scene, and the simple bodies of which they consist."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import pyarrow as pa

from roadscan.compute.array_types import Float64
from roadscan.simulate.bodies import (
    BURIED_M,
    MADE,
    PIECE_M,
    SIGN,
    TRUNK,
    WALL,
    Assembly,
    Place,
    along,
    body_row,
    ground_at,
    place_at,
    points_on,
    post,
    rod_row,
    walls,
)
from roadscan.simulate.kernels import things as body
from roadscan.simulate.kernels.road import STATION
from roadscan.simulate.scene import Scene
from roadscan.simulate.scene.roadside import (
    Barrier,
    Box,
    Cover,
    Facade,
    Fence,
    Furniture,
    Guardrail,
    Hedge,
    LampPost,
    MovingCar,
    Overhead,
    ParkedCar,
    Person,
    Planting,
    Pole,
    Sign,
    Signal,
    Standing,
    TargetPlate,
    Tree,
    Vehicle,
    Wall,
    Wire,
)
from roadscan.simulate.surface import Surface
from roadscan.simulate.vehicles import SIZES_M, vehicle_bodies

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
_STYLES: Final = {"disc": body.DISC_STYLE, "ring": body.RING_STYLE, "checker": body.CHECKER_STYLE}
_PLATE_BACK: Final = 60.0  # intensity of the back of a control target
_ARM_M: Final = 0.12  # thickness of an arm
_LAMP_M: Final = (0.5, 0.25, 0.12)  # width, length and height of a lamp
_WHEEL_M: Final = (0.62, 0.20, 0.60)  # length, width and greatest height of a wheel
_CLEARANCE_SHARE, _BODY_SHARE, _CABIN_SHARE, _CABIN_BACK = 0.14, 0.62, 0.55, 0.06  # of height or length
_FENCE_POST_RADIUS_M: Final = 0.04  # of posts of fences
_WALL_BURIED_M: Final = 1.5
"""Depth to which walls reach below the ground at their road side (m): behind them it may lie lower."""
_WIRE_PIECES: Final = 12
"""Straight pieces of a wire: over 20 m with a sag of 0.5 m they leave its parabola by 4 mm."""
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
    """(n, 19), see :mod:`roadscan.simulate.kernels.things`."""
    speed_m_per_s: float = 0.0


def objects_of(scene: Scene, surface: Surface) -> list[Object]:
    """Return all standing objects beside the road, in the order of the scene, numbered from 1."""
    return [_object(i + 1, *described, surface) for i, described in enumerate(_standing(scene))]


def moving_objects(scene: Scene, surface: Surface) -> list[Object]:
    """Return the moving cars at the first profile of their first pass; numbers continue those of standing objects."""
    first = sum(1 for _ in _standing(scene)) + 1
    out = []
    for i, car in enumerate(scene.roadside.moving_cars):
        place = place_at(surface, car.station_m, car.offset_m)
        turned = place.heading_rad + (math.pi if car.speed_m_per_s < 0 else 0.0)
        bodies = _moving_bodies(car, place.enh_m, turned)
        size = (car.length_m, car.width_m, car.height_m)
        kind = "moving_car" if car.what == "plain" else f"moving_{car.what}"
        out.append(
            Object(
                first + i, kind, car.station_m, car.offset_m, place.enh_m, size, turned, car.shade, bodies,
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
        ("planting", side.plantings), ("", side.vehicles), ("person", side.persons), ("wall", side.walls),
        ("hedge", side.hedges), ("", side.furniture), ("", side.covers), ("wire", side.wires),
        ("target", side.targets),
    )  # fmt: skip
    for kind, described in kinds:
        for one in described:
            on_road = _on_road(one, *scene.stations_m)
            for station in _stations(on_road, *scene.stations_m):
                yield getattr(one, "what", kind), on_road, station


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


# --- bodies ------------------------------------------------------------------------------------------


def car_bodies(
    foot: tuple[float, float, float],
    heading_rad: float,
    length_m: float,
    width_m: float,
    height_m: float,
    shade: float,
    wheel_feet: Sequence[float] | None,
) -> Float64:
    """Return bodies (6, 19) of a car: body, cabin, four wheels.

    wheel_feet : height of the ground under each wheel (m); that under the car's middle where left out.
    """
    place = Place(0.0, 0.0, foot, heading_rad)
    z = foot[2]
    middle = (foot[0], foot[1])
    low, waist = z + _CLEARANCE_SHARE * height_m, z + _BODY_SHARE * height_m
    back = place.beside(-_CABIN_BACK * length_m, 0.0, heading_rad)
    cabin = (_CABIN_SHARE * length_m / 2, 0.45 * width_m)
    rows = [
        body_row(body.BOX, middle, heading_rad, (length_m / 2, width_m / 2), (low, waist), shade),
        body_row(body.BOX, back, heading_rad, cabin, (waist, z + height_m), shade),
    ]
    wheel = (_WHEEL_M[0] / 2, _WHEEL_M[1] / 2)
    top = z + min(_WHEEL_M[2], _BODY_SHARE * height_m)
    for i, (ahead, right) in enumerate(wheel_places(length_m, width_m)):
        foot_m = z if wheel_feet is None else wheel_feet[i]
        at = place.beside(ahead, right, heading_rad)
        rows.append(body_row(body.BOX, at, heading_rad, wheel, (foot_m - 0.05, top), _RUBBER))
    return np.stack(rows)


def wheel_places(length_m: float, width_m: float) -> list[tuple[float, float]]:
    """Return the middle of each wheel: ahead and to the right of the car's middle (m)."""
    right = width_m / 2 - _WHEEL_M[1] / 2 + 0.01
    return [(a * 0.31 * length_m, b * right) for a in (1.0, -1.0) for b in (-1.0, 1.0)]


# --- objects -----------------------------------------------------------------------------------------


def _object(number: int, kind: str, one: Standing | Barrier, station_m: float, surface: Surface) -> Object:
    """Return the object of a description at one of its stations."""
    place = place_at(surface, station_m, one.offset_m)
    size, turned, bodies = _made(one, place, surface)
    shade = one.shade  # type: ignore[union-attr]  # every concrete description has one
    heading = place.heading_rad + turned
    return Object(number, kind, station_m, one.offset_m, place.enh_m, size, heading, shade, bodies)


@functools.singledispatch
def _made(one: object, place: Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    """Return size (length, width, height), heading past the road's (rad) and bodies (n, 19) of an object."""
    raise TypeError(f"nothing stands for {type(one).__name__}")


@_made.register
def _(one: Sign, place: Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    z = place.enh_m[2]
    height = one.width_m * _HEIGHT_SHARE[one.shape] if one.shape in _HEIGHT_SHARE else one.height_m
    low, high = z + one.clearance_m, z + one.clearance_m + height
    side = 1.0 if one.faces == "forward" else -1.0
    at = place.beside(side * _PLATE_BEFORE_POST_M, 0.0, place.heading_rad)
    kind = _PLATES[one.shape]
    behind = place.beside(side * (_PLATE_BEFORE_POST_M - _PLATE_M), 0.0, place.heading_rad)
    face, back = (
        body_row(kind, middle, place.heading_rad + math.pi / 2, (one.width_m / 2, 0.0), (low, high), shade)
        for middle, shade in ((at, one.shade), (behind, one.back_shade))
    )
    face[body.PART] = back[body.PART] = SIGN
    pole = post(place.enh_m[:2], z, high, _POST_RADIUS_M, 120.0)
    return (one.width_m, 2 * _PLATE_BEFORE_POST_M, high - z), math.pi / 2, np.stack([face, back, pole])


@_made.register
def _(one: TargetPlate, place: Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    middle = place.enh_m[2] + one.height_m
    away = {"forward": 0.0, "backward": math.pi, "road": math.copysign(math.pi / 2, -one.offset_m)}[one.faces]
    facing = place.heading_rad + away + math.radians(one.turned_deg)
    half, low_high = (one.size_m / 2, 0.0), (middle - one.size_m / 2, middle + one.size_m / 2)
    # its length runs to the left as seen from before, so that both sides differ
    face = body_row(body.PLATE, place.enh_m[:2], facing + math.pi / 2, half, low_high, one.shade)
    face[body.WINDOW] = _STYLES[one.style]
    behind = place.beside(-_PLATE_M, 0.0, facing)
    back = body_row(body.WALL, behind, facing + math.pi / 2, half, low_high, _PLATE_BACK)
    rows = [face, back]
    if one.post:
        at = place.beside(-_PLATE_BEFORE_POST_M, 0.0, facing)
        rows.append(post(at, place.enh_m[2], middle + one.size_m / 2, _POST_RADIUS_M, 120.0))
    size = (one.size_m, 2 * _PLATE_BEFORE_POST_M, one.height_m + one.size_m / 2)
    return size, facing + math.pi / 2 - place.heading_rad, np.stack(rows)


@_made.register
def _(one: Pole, place: Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    z = place.enh_m[2]
    row = post(place.enh_m[:2], z, z + one.height_m, one.diameter_m / 2, one.shade)
    return (one.diameter_m, one.diameter_m, one.height_m), 0.0, row[None]


@_made.register
def _(one: LampPost, place: Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    z = place.enh_m[2]
    top = z + one.height_m
    inwards = -1.0 if one.offset_m > 0.0 else 1.0
    rows = [post(place.enh_m[:2], z, top, one.diameter_m / 2, one.shade)]
    if one.arm_m > 0.0:
        lamp = (_LAMP_M[1] / 2, _LAMP_M[0] / 2)
        for side in (inwards, -inwards)[: 1 + one.is_double]:
            rows.append(_arm(place, side * one.arm_m, top, one.shade))
            end = place.beside(0.0, side * one.arm_m, place.heading_rad)
            rows.append(body_row(body.BOX, end, place.heading_rad, lamp, (top - _LAMP_M[2], top), one.shade))
    return (one.diameter_m, 2 * one.arm_m + _LAMP_M[0], one.height_m), 0.0, np.stack(rows)


def _arm(place: Place, right_m: float, top: float, shade: float) -> Float64:
    """Return an arm from a post to the right (negative: to the left) of the road's direction."""
    middle = place.beside(0.0, right_m / 2, place.heading_rad)
    return body_row(body.BOX, middle, place.heading_rad, (_ARM_M / 2, abs(right_m) / 2), (top - _ARM_M, top), shade)


@_made.register
def _(one: Signal, place: Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    z = place.enh_m[2]
    top, radius = z + one.height_m, one.diameter_m / 2
    width, depth, tall = one.head_m
    rows = [post(place.enh_m[:2], z, top, radius, one.shade)]
    right = 0.0
    if one.arm_m > 0.0:
        right = -one.arm_m if one.offset_m > 0.0 else one.arm_m
        rows.append(_arm(place, right, top, one.shade))
    side = 1.0 if one.faces == "forward" else -1.0
    before = _ARM_M / 2 if one.arm_m > 0.0 else radius
    head = place.beside(side * (before + 0.02 + depth / 2), right, place.heading_rad)
    rows.append(body_row(body.BOX, head, place.heading_rad, (depth / 2, width / 2), (top - tall, top), one.head_shade))
    return (one.diameter_m, max(one.arm_m, width), one.height_m), 0.0, np.stack(rows)


@_made.register
def _(one: Overhead, place: Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    turned = math.radians(one.heading_deg)
    low = place.enh_m[2] + one.clearance_m
    half = (one.length_m / 2, one.width_m / 2)
    slab = body_row(
        body.BOX, place.enh_m[:2], place.heading_rad + turned, half, (low, low + one.thickness_m), one.shade
    )  # fmt: skip
    return (one.length_m, one.width_m, one.clearance_m + one.thickness_m), turned, slab[None]


@_made.register
def _(one: Planting, place: Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    rows_along, rows_across = (max(round(m / one.tuft_m), 1) for m in (one.length_m, one.width_m))
    ahead = (np.arange(rows_along) + 0.5) / rows_along * one.length_m - one.length_m / 2
    right = (np.arange(rows_across) + 0.5) / rows_across * one.width_m - one.width_m / 2
    stations, offsets = (v.ravel() for v in np.meshgrid(place.station_m + ahead, one.offset_m + right))
    at, feet = points_on(surface, stations, offsets)
    # the golden ratio's multiples are spread evenly: tufts of all heights are everywhere
    tall = one.height_m * (0.5 + 0.5 * np.mod(np.arange(feet.size) * 0.6180339887, 1.0))
    radius = 0.6 * one.tuft_m
    tufts = [
        body_row(body.ELLIPSOID, (e, n), 0.0, (radius, 0.0), (z - h, z + h), one.shade, one.density)
        for (e, n), z, h in zip(at.tolist(), feet.tolist(), tall.tolist(), strict=True)
    ]
    return (one.length_m, one.width_m, one.height_m), 0.0, np.stack(tufts)


@_made.register
def _(one: Tree, place: Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    foot = max(0.3 * one.height_m, one.height_m - 1.4 * one.crown_m) if one.crown_from_m is None else one.crown_from_m
    size = (one.crown_m, one.crown_m, one.height_m)
    shade = 0.8 * one.shade if one.trunk_shade is None else one.trunk_shade
    if one.lean_deg or one.stems > 1 or one.extinction_per_m or one.bush_m:
        return size, 0.0, _grown_tree(one, place, foot, shade)
    z, at = place.enh_m[2], place.enh_m[:2]
    low, high = z + foot, z + one.height_m
    trunk = post(at, z, (low + high) / 2, one.trunk_m / 2, shade)
    trunk[body.PART] = TRUNK
    crown = body_row(body.ELLIPSOID, at, 0.0, (one.crown_m / 2, 0.0), (low, high), one.shade, one.density)
    return size, 0.0, np.stack([trunk, crown])


def _grown_tree(one: Tree, place: Place, foot_m: float, shade: float) -> Float64:
    """Return bodies (n, 19) of a tree that leans, is forked, or has a crown that beams enter."""
    tree = Assembly(place, place.heading_rad + math.radians(one.lean_towards_deg))
    lean = math.tan(math.radians(one.lean_deg))
    top, radius = (foot_m + one.height_m) / 2, one.trunk_m / 2
    fork = min(one.fork_m, 0.8 * top) if one.stems > 1 else top
    if fork > 0.0:
        tree.rod((-BURIED_M * lean, 0.0, -BURIED_M), (fork * lean, 0.0, fork), radius, shade, TRUNK)
    for number in range(one.stems if one.stems > 1 else 0):
        around = 2.0 * math.pi * number / one.stems + 0.4
        away = 0.3 * (top - fork) + 0.4 * radius
        end = (top * lean + away * math.cos(around), away * math.sin(around), top)
        tree.rod((fork * lean, 0.0, fork or -BURIED_M), end, radius / math.sqrt(one.stems), shade, TRUNK)
    if one.extinction_per_m > 0.0:
        tree.ball(top * lean, 0.0, (foot_m, one.height_m), one.crown_m / 2, one.shade, one.extinction_per_m)
    else:
        tree.ball(top * lean, 0.0, (foot_m, one.height_m), one.crown_m / 2, one.shade)
        tree.rows[-1][body.DENSITY] = one.density
    if one.bush_m > 0.0:
        tall = 0.45 * one.bush_m
        tree.ball(0.0, 0.0, (-tall, tall), one.bush_m / 2, one.shade, max(one.extinction_per_m, 3.0))
    return tree.bodies


@_made.register
def _(one: ParkedCar, place: Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    turned = math.radians(one.heading_deg)
    heading = place.heading_rad + turned
    feet = [
        ground_at(surface, *place.beside(ahead, right, heading))
        for ahead, right in wheel_places(one.length_m, one.width_m)
    ]
    size = (one.length_m, one.width_m, one.height_m)
    return size, turned, car_bodies(place.enh_m, heading, *size, one.shade, feet)


@_made.register
def _(one: Box, place: Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    turned = math.radians(one.heading_deg)
    heading = place.heading_rad + turned
    half = (one.length_m / 2, one.width_m / 2)
    corners = [
        ground_at(surface, *place.beside(a * half[0], b * half[1], heading)) for a in (-1.0, 1.0) for b in (-1.0, 1.0)
    ]
    top = place.enh_m[2] + one.height_m
    low = min([*corners, place.enh_m[2]]) - BURIED_M
    size = (one.length_m, one.width_m, one.height_m)
    return (
        size,
        turned,
        body_row(body.BOX, place.enh_m[:2], heading, half, (low, max(top, low + 0.001)), one.shade)[None],
    )


@_made.register
def _(one: Guardrail, place: Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    points, ground = along(surface, one, PIECE_M)
    rail = walls(points, ground + one.height_m - one.rail_m, ground + one.height_m, one.shade, 0.0)
    # The posts are behind the rail, away from the road.
    behind = _RAIL_POST_RADIUS_M + 0.02 if one.offset_m > 0.0 else -_RAIL_POST_RADIUS_M - 0.02
    count = math.floor((one.end_m - one.start_m) / one.post_every_m + 1e-9) + 1
    stations = one.start_m + one.post_every_m * np.arange(count, dtype=np.float64)
    at, feet = points_on(surface, stations, np.full(count, one.offset_m + behind))
    posts = [
        post((e, n), z, z + one.height_m - 0.02, _RAIL_POST_RADIUS_M, one.shade)
        for (e, n), z in zip(at.tolist(), feet.tolist(), strict=True)
    ]
    return (one.end_m - one.start_m, 2 * abs(behind), one.height_m), 0.0, np.concatenate([rail, np.stack(posts)])


@_made.register
def _(one: Fence, place: Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    points, ground = along(surface, one, PIECE_M)
    density = one.density if one.style == "mesh" else 1.0
    rows = walls(points, ground, ground + one.height_m, one.shade, BURIED_M, density)
    if one.style == "pickets":
        rows[:, body.KIND] = body.PICKETS
        rows[:, body.ALONG] = np.append(0.0, np.cumsum(2 * rows[:-1, body.HALF_LENGTH]))
        rows[:, [body.BAY, body.WINDOW]] = one.picket_m / one.density, one.picket_m
    if one.post_every_m > 0.0:
        rows = np.concatenate([rows, _posts(one, surface)])
    return (one.end_m - one.start_m, 0.0, one.height_m), 0.0, rows


def _posts(one: Fence, surface: Surface) -> Float64:
    """Return the posts (n, 19) of a fence, behind it."""
    count = math.floor((one.end_m - one.start_m) / one.post_every_m + 1e-9) + 1
    stations = one.start_m + one.post_every_m * np.arange(count, dtype=np.float64)
    behind = math.copysign(_FENCE_POST_RADIUS_M + 0.01, one.offset_m)
    at, feet = points_on(surface, stations, np.full(count, one.offset_m + behind))
    return np.stack(
        [
            post((e, n), z, z + one.height_m + 0.05, _FENCE_POST_RADIUS_M, one.shade)
            for (e, n), z in zip(at.tolist(), feet.tolist(), strict=True)
        ]
    )


@_made.register
def _(one: Wall, place: Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    rows = _row_of_boxes(one, surface, one.thickness_m, one.height_m, one.shade)
    return (one.end_m - one.start_m, one.thickness_m, one.height_m), 0.0, rows


def _row_of_boxes(one: Wall | Hedge, surface: Surface, thick_m: float, high_m: float, shade: float) -> Float64:
    """Return boxes (n, 19) that follow the road, each as high above the lowest ground of its road side."""
    points, ground = along(surface, one, PIECE_M)
    away = math.copysign(thick_m / 2, one.offset_m)
    rows = walls(points, ground, ground, shade, 0.0)
    rows[:, body.KIND], rows[:, body.HALF_WIDTH] = body.BOX, thick_m / 2
    rows[:, body.EASTING] += away * rows[:, body.COSINE]
    rows[:, body.NORTHING] -= away * rows[:, body.SINE]
    low, high = np.minimum(ground[:-1], ground[1:]), np.maximum(ground[:-1], ground[1:])
    rows[:, body.LOW] = rows[:, body.LOW_END] = low - _WALL_BURIED_M
    rows[:, body.HIGH] = rows[:, body.HIGH_END] = high + high_m
    return rows


@_made.register
def _(one: Hedge, place: Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    rows = _row_of_boxes(one, surface, one.width_m, one.height_m, one.shade)
    if one.ragged_m > 0.0:
        number = np.arange(len(rows))
        # multiples of two irrational numbers are spread evenly
        rows[:, body.HIGH] += one.ragged_m * (np.mod(number * 0.6180339887, 1.0) - 0.5)
        rows[:, body.HALF_WIDTH] += 0.3 * one.ragged_m * (np.mod(number * 0.7548776662, 1.0) - 0.5)
        rows[:, body.HIGH_END] = rows[:, body.HIGH]
    rows[:, body.KIND], rows[:, body.DENSITY] = body.VOLUME, -math.log(one.passing) / one.width_m
    if one.foot_wall_m > 0.0:
        foot = _row_of_boxes(one, surface, one.width_m, one.foot_wall_m, 130.0)
        foot[:, body.HALF_WIDTH] += 0.02
        foot[:, body.PART] = WALL
        rows = np.concatenate([rows, foot])
    return (one.end_m - one.start_m, one.width_m, one.height_m), 0.0, rows


@_made.register
def _(one: Vehicle, place: Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    turned = math.radians(one.heading_deg)
    size = one.size_m or SIZES_M[one.what]
    heading = place.heading_rad + turned
    return size, turned, vehicle_bodies(one.what, place.enh_m, heading, size, one.shade, one.glass, seed=one.form)


@_made.register
def _(one: Person, place: Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    turned = math.radians(one.heading_deg)
    size = (*SIZES_M["person"][:2], one.height_m)
    return size, turned, vehicle_bodies(
        "person", place.enh_m, place.heading_rad + turned, size, one.shade, 1.0, seed=one.form
    )  # fmt: skip


@_made.register
def _(one: Furniture, place: Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    turned = math.radians(one.heading_deg) + (0.0 if one.offset_m > 0.0 else math.pi)
    made = Assembly(place, place.heading_rad + turned)
    MADE[one.what](made, one.scale, one.shade)
    return made.extent_m, turned, made.bodies


@_made.register
def _(one: Cover, place: Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    half = (one.length_m / 2, one.width_m / 2)
    ends = [place.beside(a * half[0], b * half[1], place.heading_rad) for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    front, rear, right, left = (ground_at(surface, *at) - place.enh_m[2] for at in ends)
    lid = Assembly(place, place.heading_rad)
    middle = max(0.0, (front + rear) / 2, (right + left) / 2) + one.height_m
    lid.slope((-half[0], half[0]), (-half[1], half[1]), (middle, front - rear, right - left), one.shade,
              lid=one.what == "cover")  # fmt: skip
    return (one.length_m, one.width_m, one.height_m), 0.0, lid.bodies


@_made.register
def _(one: Wire, place: Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    end = place_at(surface, one.to_station_m, one.to_offset_m)
    share = np.linspace(0.0, 1.0, _WIRE_PIECES + 1)
    first = np.array([*place.enh_m[:2], place.enh_m[2] + one.height_m])
    last = np.array([*end.enh_m[:2], end.enh_m[2] + one.to_height_m])
    points = first + share[:, None] * (last - first)
    points[:, 2] -= 4.0 * one.sag_m * share * (1.0 - share)
    rows = [rod_row(tuple(a), tuple(b), one.diameter_m / 2, one.shade)
            for a, b in zip(points[:-1].tolist(), points[1:].tolist(), strict=True)]  # fmt: skip
    across = last - first
    turned = math.atan2(across[0], across[1]) - place.heading_rad
    return (float(np.hypot(across[0], across[1])), one.diameter_m, one.height_m), turned, np.stack(rows)


@_made.register
def _(one: Facade, place: Place, surface: Surface) -> tuple[tuple[float, float, float], float, Float64]:
    points, ground = along(surface, one, PIECE_M)
    front = walls(points, ground, ground + one.height_m, one.shade, BURIED_M)
    if one.window_m > 0.0:
        front[:, body.ALONG] = np.append(0.0, np.cumsum(2 * front[:-1, body.HALF_LENGTH]))
        front[:, [body.BAY, body.WINDOW, body.STOREY]] = one.bay_m, one.window_m, one.storey_m
    away = math.copysign(one.depth_m, one.offset_m)
    parts = [front]
    if one.glass > 0.0:
        front[:, body.KIND], front[:, body.DENSITY] = body.GLAZED, one.glass
        rooms = one.model_copy(update={"offset_m": one.offset_m + math.copysign(one.room_m, one.offset_m)})
        behind, _ = along(surface, rooms, PIECE_M)
        parts.append(walls(behind, ground, ground + one.height_m, 110.0, BURIED_M))
    for i, station in ((0, one.start_m), (-1, one.end_m)):
        pieces = math.ceil(one.depth_m / PIECE_M)
        across = one.offset_m + away / pieces * np.arange(pieces + 1, dtype=np.float64)
        ends, _ = points_on(surface, np.full(across.size, station), np.asarray(across, np.float64), heights=False)
        level = np.full(across.size, ground[i])
        parts.append(walls(ends, level, level + one.height_m, one.shade, 10.0 * BURIED_M))
    return (one.end_m - one.start_m, one.depth_m, one.height_m), 0.0, np.concatenate(parts)


# --- what moves --------------------------------------------------------------------------------------


def mover_bodies(
    car: MovingCar, surface: Surface, begin_s: float, end_s: float
) -> tuple[Float64, Float64] | None:  # fmt: skip
    """Return bodies (6, 19) of a moving car at the beginning of a time slot, and its velocity (3,) within it.

    begin_s, end_s : since the pass's first profile. None where the car has left the road.
    """
    stations = car.station_m + car.speed_m_per_s * np.array([begin_s, end_s])
    nodes = surface.arrays.nodes
    if stations.min() < nodes[0, STATION] or stations.max() > nodes[-1, STATION]:
        return None
    at, feet = points_on(surface, stations, np.full(2, car.offset_m))
    _, _, headings = surface.place(np.array([stations.mean()]), np.array([car.offset_m]))
    heading = float(headings[0]) + (math.pi if car.speed_m_per_s < 0 else 0.0)
    foot = (float(at[0, 0]), float(at[0, 1]), float(feet[0]))
    return _moving_bodies(car, foot, heading), np.append(at[1] - at[0], feet[1] - feet[0]) / (end_s - begin_s)


def _moving_bodies(car: MovingCar, foot: tuple[float, float, float], heading_rad: float) -> Float64:
    """Return bodies (n, 19) of what moves, at a place."""
    size = (car.length_m, car.width_m, car.height_m)
    if car.what == "plain":
        return car_bodies(foot, heading_rad, *size, car.shade, None)
    return vehicle_bodies(car.what, foot, heading_rad, size, car.shade, car.glass, ridden=True, seed=car.form)
