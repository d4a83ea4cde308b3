"""Bodies of things beside the road and of street furniture, as rows of numbers for the kernels, and their classes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.simulate.kernels import things as body
from roadscan.simulate.scene.roadside import Barrier
from roadscan.simulate.surface import Surface

PIECE_M: Final = 2.0
"""Barriers follow the road in straight pieces no longer than this (m)."""
BURIED_M: Final = 0.3
"""Depth below the ground to which objects extend, so that no beam passes beneath them (m)."""


@dataclass(frozen=True)
class Place:
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


def place_at(surface: Surface, station_m: float, offset_m: float) -> Place:
    """Return the place on the ground at a station and an offset."""
    e, n, heading = surface.place(station_m, offset_m)
    origin = surface.origin_enh_m
    e0, n0 = float(e) - float(origin[0]), float(n) - float(origin[1])
    return Place(station_m, offset_m, (e0, n0, ground_at(surface, e0, n0)), float(heading))


def ground_at(surface: Surface, easting: float, northing: float) -> float:
    """Return the height of the ground at a place from the origin (m), extended beside the surface as the verge is."""
    e, n = easting + surface.origin_enh_m[0], northing + surface.origin_enh_m[1]
    height = float(surface.height_m(e, n, texture=False))
    if math.isnan(height):
        station, offset = surface.station_offset_m(e, n)
        height = float(surface.points_at(np.atleast_1d(station), np.atleast_1d(offset))[0, 2])
    return height - float(surface.origin_enh_m[2])


def body_row(
    kind: float,
    place: tuple[float, float],
    heading_rad: float,
    half: tuple[float, float],
    low_high: tuple[float, float],
    shade: float,
    density: float = 1.0,
) -> Float64:
    """Return a body's row (19,)."""
    row = np.zeros(body.BODY_COLUMNS)
    row[body.KIND] = kind
    row[[body.EASTING, body.NORTHING]] = place
    row[[body.SINE, body.COSINE]] = math.sin(heading_rad), math.cos(heading_rad)
    row[[body.HALF_LENGTH, body.HALF_WIDTH]] = half
    row[[body.LOW, body.HIGH]] = row[[body.LOW_END, body.HIGH_END]] = low_high
    row[[body.INTENSITY, body.DENSITY]] = shade, density
    return row


def post(place: tuple[float, float], low: float, high: float, radius: float, shade: float) -> Float64:
    """Return the row (19,) of an upright cylinder that reaches into the ground."""
    return body_row(body.CYLINDER, place, 0.0, (radius, 0.0), (low - BURIED_M, high), shade)


def walls(points: Float64, low: Float64, high: Float64, shade: float, skirt: float, density: float = 1.0) -> Float64:
    """Return walls (n, 19) between points (n + 1, 2), with heights (n + 1,) of their lower and upper edge."""
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


def along(surface: Surface, one: Barrier, piece_m: float) -> tuple[Float64, Float64]:
    """Return points (n, 2) along the road and the ground there (n,), from the origin."""
    count = math.ceil((one.end_m - one.start_m) / piece_m - 1e-9)
    stations: Float64 = np.linspace(one.start_m, one.end_m, count + 1)
    return points_on(surface, stations, np.full(count + 1, one.offset_m))


def points_on(
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


@dataclass
class Assembly:
    """Bodies of one thing, in its axes: ahead along its heading, right, up from its foot (m)."""

    place: Place
    heading_rad: float
    rows: list[Float64] = field(default_factory=list)

    @property
    def bodies(self) -> Float64:
        """Return all bodies (n, 19)."""
        return np.stack(self.rows)

    @property
    def extent_m(self) -> tuple[float, float, float]:
        """Return length and width of the smallest rectangle around its foot that holds it, and its height (m)."""
        rows = self.bodies
        east, north = rows[:, body.EASTING] - self.place.enh_m[0], rows[:, body.NORTHING] - self.place.enh_m[1]
        sine, cosine = math.sin(self.heading_rad), math.cos(self.heading_rad)
        half, wide = rows[:, body.HALF_LENGTH], rows[:, body.HALF_WIDTH]
        is_round = np.isin(rows[:, body.KIND], (body.CYLINDER, body.ELLIPSOID, body.BUSH))
        along = np.abs(rows[:, body.SINE] * sine + rows[:, body.COSINE] * cosine)
        across = np.abs(rows[:, body.COSINE] * sine - rows[:, body.SINE] * cosine)
        ahead = np.abs(east * sine + north * cosine) + np.where(is_round, half, along * half + across * wide)
        right = np.abs(east * cosine - north * sine) + np.where(is_round, half, across * half + along * wide)
        up = float(rows[:, [body.HIGH, body.HIGH_END]].max()) - self.place.enh_m[2]
        return 2.0 * float(ahead.max()), 2.0 * float(right.max()), up

    def _add(self, row: Float64, part: int) -> None:
        row[body.PART] = part
        self.rows.append(row)

    def box(
        self,
        ahead: float,
        right: float,
        up: tuple[float, float],
        size: tuple[float, float],
        shade: float,
        part: int = 0,
    ) -> None:
        """Add a box around a place, from one height to another; size: along and across."""
        at, z = self.place.beside(ahead, right, self.heading_rad), self.place.enh_m[2]
        half = (size[0] / 2, size[1] / 2)
        self._add(body_row(body.BOX, at, self.heading_rad, half, (z + up[0], z + up[1]), shade), part)

    def post(
        self, ahead: float, right: float, up: tuple[float, float], radius: float, shade: float, part: int = 0
    ) -> None:
        """Add an upright cylinder."""
        at, z = self.place.beside(ahead, right, self.heading_rad), self.place.enh_m[2]
        self._add(body_row(body.CYLINDER, at, 0.0, (radius, 0.0), (z + up[0], z + up[1]), shade), part)

    def ball(
        self, ahead: float, right: float, up: tuple[float, float], radius: float, shade: float,
        per_m: float = 0.0, part: int = 0,
    ) -> None:  # fmt: skip
        """Add an ellipsoid: solid, or porous with an extinction (1/m)."""
        at, z = self.place.beside(ahead, right, self.heading_rad), self.place.enh_m[2]
        kind, density = (body.BUSH, per_m) if per_m > 0.0 else (body.ELLIPSOID, 1.0)
        self._add(body_row(kind, at, 0.0, (radius, 0.0), (z + up[0], z + up[1]), shade, density), part)

    def rod(
        self, start: tuple[float, float, float], end: tuple[float, float, float], radius: float, shade: float,
        part: int = 0,
    ) -> None:  # fmt: skip
        """Add a cylinder around the line between two places (ahead, right, up)."""
        first, last = (self.place.beside(p[0], p[1], self.heading_rad) for p in (start, end))
        z = self.place.enh_m[2]
        self._add(rod_row((*first, z + start[2]), (*last, z + end[2]), radius, shade), part)

    def plate(
        self, ahead: float, right: float, up: tuple[float, float], width: float, shade: float, *,
        turned_rad: float = math.pi / 2, density: float = 1.0, glass: bool = False,
    ) -> None:  # fmt: skip
        """Add an upright thin rectangle, across the heading unless it is turned; `density`: share of beams it stops."""
        at, z = self.place.beside(ahead, right, self.heading_rad), self.place.enh_m[2]
        kind = body.GLAZED if glass else body.WALL
        half, heights = (width / 2, 0.0), (z + up[0], z + up[1])
        self._add(body_row(kind, at, self.heading_rad + turned_rad, half, heights, shade, density), 0)

    def slope(
        self, ahead: tuple[float, float], right: tuple[float, float], up: tuple[float, float, float], shade: float, *,
        density: float = 1.0, glass: bool = False, lid: bool = False,
    ) -> None:  # fmt: skip
        """Add a leaning rectangle (or the ellipse in it) between two places ahead and two to the right.

        up : height of its middle, rise from its rear to its front edge, rise from left to right (m).
        """
        middle = self.place.beside((ahead[0] + ahead[1]) / 2, (right[0] + right[1]) / 2, self.heading_rad)
        length, width = ahead[1] - ahead[0], right[1] - right[0]
        z = self.place.enh_m[2] + up[0]
        kind = body.LID if lid else body.SLOPE
        row = body_row(kind, middle, self.heading_rad, (length / 2, width / 2), (z, z), shade, density)
        row[body.ALONG], row[body.STOREY] = up[1] / length, up[2] / width
        row[[body.HIGH, body.HIGH_END]] = z + (abs(up[1]) + abs(up[2])) / 2
        row[body.WINDOW] = float(glass)
        self._add(row, 0)


def rod_row(
    start: tuple[float, float, float], end: tuple[float, float, float], radius: float, shade: float
) -> Float64:  # fmt: skip
    """Return the row (19,) of a cylinder around the line between two points (easting, northing, height)."""
    if math.hypot(end[0] - start[0], end[1] - start[1]) < 1e-6:
        end = (end[0] + 1e-6, end[1], end[2])
    heading = math.atan2(end[0] - start[0], end[1] - start[1])
    half = math.hypot(end[0] - start[0], end[1] - start[1]) / 2
    middle = ((start[0] + end[0]) / 2, (start[1] + end[1]) / 2)
    row = body_row(body.ROD, middle, heading, (half, radius), (start[2], end[2]), shade)
    row[body.LOW], row[body.LOW_END] = start[2], end[2]
    row[[body.HIGH, body.HIGH_END]] = max(start[2], end[2]) + radius
    return row


CLASSES: Final = (
    "noise", "road", "parking", "sidewalk", "terrain", "kerb", "marking", "building", "wall", "fence", "hedge",
    "vegetation", "trunk", "pole", "sign", "signal", "vehicle", "person", "furniture", "wire",
)  # fmt: skip
"""Names of the classes, by number. Noise: on no object (drops, mirrored beams, false returns); sidewalk: paved verge;
terrain: verge that is not paved; kerb: its face and top; furniture: all smaller things that stand in a street."""


def class_number(name: str) -> int:
    """Return the number of a class."""
    return CLASSES.index(name)


TRUNK: Final = class_number("trunk")
SIGN: Final = class_number("sign")
WALL: Final = class_number("wall")
POLE: Final = class_number("pole")
VEGETATION: Final = class_number("vegetation")
PERSON: Final = class_number("person")


_BELOW: Final = -BURIED_M


def _cabinet(one: Assembly, scale: float, shade: float) -> None:
    one.box(0.0, 0.0, (_BELOW, 0.1), (1.06 * scale, 0.42), 130.0)
    one.box(0.0, 0.0, (0.1, 1.25 * scale), (1.0 * scale, 0.36), shade)
    one.box(0.0, 0.0, (1.25 * scale, 1.25 * scale + 0.04), (1.08 * scale, 0.44), shade)


def _bin(one: Assembly, scale: float, shade: float) -> None:
    one.box(0.0, 0.0, (0.05, 0.95 * scale), (0.55 * scale, 0.5 * scale), shade)
    one.slope((-0.3 * scale, 0.3 * scale), (-0.28 * scale, 0.28 * scale), (scale, 0.1 * scale, 0.0), shade)
    one.rod((-0.28 * scale, -0.25 * scale, 0.1), (-0.28 * scale, 0.25 * scale, 0.1), 0.1, 30.0)


def _litter_bin(one: Assembly, scale: float, shade: float) -> None:
    one.post(0.0, 0.0, (_BELOW, 0.35), 0.04, 90.0)
    one.post(0.0, 0.0, (0.35, 0.95 * scale), 0.2 * scale, shade)


def _bench(one: Assembly, scale: float, shade: float) -> None:
    half = 0.8 * scale
    one.box(0.0, 0.0, (0.40, 0.46), (2 * half, 0.45), shade)
    one.slope((-half, half), (0.2, 0.32), (0.68, 0.0, 0.4), shade)
    for ahead in (-0.8 * half, 0.8 * half):
        one.box(ahead, 0.0, (_BELOW, 0.4), (0.06, 0.4), 80.0)


def _hydrant(one: Assembly, scale: float, shade: float) -> None:
    one.post(0.0, 0.0, (_BELOW, 0.62 * scale), 0.11, shade)
    one.ball(0.0, 0.0, (0.5 * scale, 0.76 * scale), 0.12, shade)
    one.rod((0.0, -0.2, 0.45 * scale), (0.0, 0.2, 0.45 * scale), 0.06, shade)
    one.rod((0.0, 0.0, 0.4 * scale), (-0.2, 0.0, 0.4 * scale), 0.08, shade)


def _bus_shelter(one: Assembly, scale: float, shade: float) -> None:
    half, deep = 1.9 * scale, 0.7
    one.box(0.0, 0.0, (2.3, 2.4), (2 * half, 2 * deep + 0.2), shade)
    for ahead in (-half + 0.05, half - 0.05):
        for right in (-deep, deep):
            one.post(ahead, right, (_BELOW, 2.3), 0.04, 110.0)
    one.plate(0.0, deep, (0.25, 2.2), 2 * half - 0.2, 60.0, turned_rad=0.0, density=0.35, glass=True)
    one.plate(-half + 0.1, 0.0, (0.25, 2.2), 2 * deep - 0.1, 60.0, density=0.35, glass=True)
    one.plate(half - 0.1, 0.0, (0.4, 2.1), 1.25, 215.0)
    one.box(0.0, 0.35, (0.42, 0.47), (0.7 * half, 0.3), 90.0)


def _bollard(one: Assembly, scale: float, shade: float) -> None:
    one.post(0.0, 0.0, (_BELOW, 0.9 * scale), 0.06 * scale, shade)
    one.post(0.0, 0.0, (0.72 * scale, 0.8 * scale), 0.065 * scale, 230.0)


def _advertising_column(one: Assembly, scale: float, shade: float) -> None:
    one.post(0.0, 0.0, (_BELOW, 2.9 * scale), 0.62 * scale, shade)
    one.ball(0.0, 0.0, (2.5 * scale, 3.4 * scale), 0.72 * scale, 100.0)


def _billboard(one: Assembly, scale: float, shade: float) -> None:
    for right in (-0.9 * scale, 0.9 * scale):
        one.post(0.0, right, (_BELOW, 2.8), 0.06, 100.0)
    one.box(0.0, 0.0, (0.9, 2.8), (0.12, 2.7 * scale), shade)


def _letter_box(one: Assembly, scale: float, shade: float) -> None:
    one.post(0.0, 0.0, (_BELOW, 0.9), 0.04, 90.0)
    one.box(0.0, 0.0, (0.85, 1.4), (0.35 * scale, 0.45 * scale), shade)


def _parking_meter(one: Assembly, scale: float, shade: float) -> None:
    one.post(0.0, 0.0, (_BELOW, 1.2), 0.05, 90.0)
    one.box(0.0, 0.0, (1.1, 1.7), (0.22 * scale, 0.3 * scale), shade)


def _planter(one: Assembly, scale: float, shade: float) -> None:
    one.box(0.0, 0.0, (_BELOW, 0.5 * scale), (1.1 * scale, 0.7 * scale), shade)
    one.ball(0.0, 0.0, (0.2 * scale, 1.1 * scale), 0.5 * scale, 95.0, per_m=4.0)


def _sandwich_board(one: Assembly, scale: float, shade: float) -> None:
    tall, half = 0.95 * scale, 0.3 * scale
    one.slope((-0.25, -0.02), (-half, half), (tall / 2, tall, 0.0), shade)
    one.slope((0.02, 0.25), (-half, half), (tall / 2, -tall, 0.0), shade)


def _stairs(one: Assembly, scale: float, shade: float) -> None:
    for number in range(3):
        one.box(0.0, 0.15 * number, (_BELOW, 0.17 * (number + 1)), (1.3 * scale, 0.9 - 0.3 * number), shade)


def _door(one: Assembly, scale: float, shade: float) -> None:
    one.box(0.0, 0.0, (_BELOW, 2.15), (1.0 * scale, 0.06), shade)
    for ahead in (-0.54 * scale, 0.54 * scale):
        one.box(ahead, -0.05, (_BELOW, 2.25), (0.08, 0.16), 175.0)


def _balcony(one: Assembly, scale: float, shade: float) -> None:
    one.box(0.0, 0.0, (3.0, 3.15), (2.6 * scale, 1.2), shade)
    for ahead in (-1.3 * scale, 1.3 * scale):
        one.plate(ahead, 0.0, (3.15, 4.1), 1.2, 120.0, density=0.4)
    one.plate(0.0, -0.6, (3.15, 4.1), 2.6 * scale, 120.0, turned_rad=0.0, density=0.4)


def _shop_sign(one: Assembly, scale: float, shade: float) -> None:
    one.box(0.0, 0.0, (2.6, 3.15), (1.8 * scale, 0.06), shade)


def _hanging_sign(one: Assembly, scale: float, shade: float) -> None:
    one.box(0.0, 0.0, (2.5, 3.0 + 0.3 * scale), (0.06, 0.7 * scale), shade)


MADE: Final[dict[str, Callable[[Assembly, float, float], None]]] = {
    "cabinet": _cabinet, "bin": _bin, "litter_bin": _litter_bin, "bench": _bench, "hydrant": _hydrant,
    "bus_shelter": _bus_shelter, "bollard": _bollard, "advertising_column": _advertising_column,
    "billboard": _billboard, "letter_box": _letter_box, "parking_meter": _parking_meter, "planter": _planter,
    "sandwich_board": _sandwich_board, "steps": _stairs, "door": _door, "balcony": _balcony, "shop_sign": _shop_sign,
    "hanging_sign": _hanging_sign,
}  # fmt: skip
"""Adds the bodies of a kind: an assembly whose right is away from the road, a scale, and an intensity."""
