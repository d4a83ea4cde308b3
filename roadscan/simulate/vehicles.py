"""Bodies of vehicles and people: with windows that pass and mirror beams, bright plates, lights and stripes."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Final

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.simulate.bodies import PERSON, Assembly, Place

SIZES_M: Final = {
    "car": (4.4, 1.8, 1.5), "van": (5.4, 2.0, 2.4), "lorry": (8.5, 2.5, 3.6), "bicycle": (1.75, 0.6, 1.05),
    "motorcycle": (2.1, 0.8, 1.15), "person": (0.35, 0.5, 1.75),
}  # fmt: skip
"""Length, width and height of each kind where a scene leaves them out (m)."""
_RUBBER, _DARK, _SKIN, _RETRO = 25.0, 35.0, 90.0, 255.0  # intensities
_PLATE_M: Final = (0.52, 0.11)  # width and height of a number plate
_BEFORE_M: Final = 0.012  # from a body's outside to what is fixed to it


def vehicle_bodies(
    what: str, foot: tuple[float, float, float], heading_rad: float, size_m: tuple[float, float, float], shade: float,
    glass: float, *, ridden: bool = False, seed: int = 0,
) -> Float64:  # fmt: skip
    """Return bodies (n, 19) of a vehicle or a person.

    size_m : length, width, height. glass : share of beams that the windows stop. ridden : a cycle with its rider.
    seed : which of its forms it has; the count of bodies depends on it.
    """
    one = Assembly(Place(0.0, 0.0, foot, heading_rad), heading_rad)
    _MADE[what](one, size_m, shade, glass, ridden, seed)
    return one.bodies


def _wheels(one: Assembly, length: float, width: float, places: tuple[float, ...], radius: float) -> None:
    for ahead in places:
        for side in (-1.0, 1.0):
            one.box(ahead * length, side * (width / 2 - 0.09), (-0.05, 2 * radius), (1.8 * radius, 0.2), _RUBBER)


def _rear(one: Assembly, length: float, width: float, up: float, *, tall: float = 0.2) -> None:
    """Add number plates, rear lights and head lights; `up`: height of the lights."""
    for side, lamp in ((-1.0, _RETRO), (1.0, 150.0)):
        ahead = side * (length / 2 + _BEFORE_M)
        one.plate(ahead, 0.0, (0.42, 0.42 + _PLATE_M[1]), _PLATE_M[0], _RETRO)
        for right in (-0.38, 0.38):
            one.plate(ahead, right * width, (up - tall, up), 0.12 * width, lamp)


def _cabin(
    one: Assembly, front: tuple[float, float], back: tuple[float, float], width: float, up: tuple[float, float],
    shade: float, glass: float,
) -> None:  # fmt: skip
    """Add roof, panes, pillars and seats of a cabin.

    front, back : places ahead of the roof's end and of the pane's foot; up : heights of the waist and of the roof.
    """
    low, high = up
    rise, inner = high - low, 0.42 * width
    one.box((front[0] + back[0]) / 2, 0.0, (high - 0.05, high), (front[0] - back[0], 2 * inner), shade)
    middle = (low + high) / 2
    one.slope((front[0], front[1]), (-inner, inner), (middle, -rise, 0.0), _DARK, density=glass, glass=True)
    one.slope((back[1], back[0]), (-inner, inner), (middle, rise, 0.0), _DARK, density=glass, glass=True)
    for side in (-1.0, 1.0):
        across = (inner, width / 2) if side > 0.0 else (-width / 2, -inner)
        one.slope((back[0], front[0]), across, (middle, 0.0, -side * rise), _DARK, density=glass, glass=True)
        for top, foot in ((front[0], front[1]), (back[0], back[1]), ((front[0] + back[0]) / 2,) * 2):
            one.rod((foot, side * 0.49 * width, low), (top, side * inner, high - 0.02), 0.035, shade)
    for ahead in (0.7, 0.2):
        seat = back[0] + ahead * (front[0] - back[0])
        one.box(seat, 0.0, (low - 0.1, low + 0.55 * rise), (0.12, 1.5 * inner), 40.0)


def _car(one: Assembly, size: tuple[float, float, float], shade: float, glass: float, ridden: bool, seed: int) -> None:
    length, width, height = size
    waist = (0.58 + 0.02 * (seed % 4)) * height
    one.box(0.0, 0.0, (0.14 * height, waist), (length, width), shade)
    hatch = 0.30 + 0.05 * (seed % 3)
    front, back = (0.12 * length, 0.24 * length), (-hatch * length, -min(hatch + 0.08, 0.48) * length)
    _cabin(one, front, back, width, (waist, height), shade, glass)
    _wheels(one, length, width, (0.31, -0.31), 0.31)
    _rear(one, length, width, waist - 0.08)


def _van(one: Assembly, size: tuple[float, float, float], shade: float, glass: float, ridden: bool, seed: int) -> None:
    length, width, height = size
    rear = -length / 2
    waist, cab = 0.48 * height, 0.22 * length
    one.box((rear + cab) / 2, 0.0, (0.2, height), (cab - rear, width), shade)
    one.box((cab + length / 2) / 2, 0.0, (0.2, waist), (length / 2 - cab, width), shade)
    one.slope((cab, 0.42 * length), (-0.46 * width, 0.46 * width), ((waist + height) / 2, waist - height, 0.0), _DARK,
              density=glass, glass=True)  # fmt: skip
    _wheels(one, length, width, (0.32, -0.32), 0.33)
    _rear(one, length, width, 0.55 * height, tall=0.45)
    ahead = rear - 2 * _BEFORE_M
    if seed % 3 == 0:  # a bright panel between the doors' frames: as large and flat as a sign
        one.plate(ahead, 0.0, (0.45 * height, 0.45 * height + 0.6), 0.9 + 0.1 * (seed % 5), _RETRO)
    elif seed % 3 == 1:
        for right in (-0.24, 0.24):
            one.plate(ahead, right * width, (0.55 * height, 0.85 * height), 0.36 * width, _DARK,
                      density=glass, glass=True)  # fmt: skip


def _lorry(
    one: Assembly, size: tuple[float, float, float], shade: float, glass: float, ridden: bool, seed: int
) -> None:  # fmt: skip
    length, width, height = size
    rear, cab = -length / 2, length / 2 - 1.7
    one.box((rear + cab - 0.4) / 2, 0.0, (1.0, height), (cab - 0.4 - rear, width), shade)
    one.box(0.0, 0.0, (0.6, 1.0), (length - 0.5, 0.9), _DARK)
    one.box((cab + length / 2) / 2, 0.0, (0.5, 0.8 * height), (1.7, 0.96 * width), 0.8 * shade + 20.0)
    one.plate(length / 2 + _BEFORE_M, 0.0, (1.6, 2.5), 0.85 * width, _DARK, density=glass, glass=True)
    _wheels(one, length, width, (0.34, -0.2, -0.34), 0.48)
    _rear(one, length, width, 1.0)
    ahead = rear - 2 * _BEFORE_M
    for right in (-0.27, 0.27):
        one.plate(ahead, right * width, (1.15, 1.4), 0.42 * width, _RETRO)
    if seed % 2:
        one.plate(ahead, 0.2 * width, (1.8, 2.2), 0.4, _RETRO)
    for side in (-1.0, 1.0):  # outline stripes
        one.plate((rear + cab) / 2, side * (width / 2 + _BEFORE_M), (1.15, 1.2), cab - rear - 1.0, 230.0,
                  turned_rad=0.0)  # fmt: skip


def _ring(one: Assembly, ahead: float, radius: float) -> None:
    """Add a wheel of eight straight pieces."""
    corners = [(ahead + radius * math.cos(a), 0.0, radius + radius * math.sin(a))
               for a in np.linspace(0.0, 2 * math.pi, 9)]  # fmt: skip
    for first, last in itertools.pairwise(corners):
        one.rod(first, last, 0.02, _RUBBER)


def _bicycle(
    one: Assembly, size: tuple[float, float, float], shade: float, glass: float, ridden: bool, seed: int
) -> None:  # fmt: skip
    length, _, height = size
    wheel = 0.19 * length
    axle, hub = length / 2 - wheel, 0.32 * length
    for ahead in (axle, -axle):
        _ring(one, ahead, wheel)
    seat, bars, pedals = (-0.18 * length, 0.0, 0.9 * height), (0.2 * length, 0.0, height), (-0.05 * length, 0.0, 0.3)
    for start, end in (
        (seat, pedals), (pedals, bars), (seat, (0.19 * length, 0.0, 0.85 * height)), (bars, (axle, 0.0, wheel)),
        (pedals, (-axle, 0.0, wheel)), ((bars[0], -0.28, height), (bars[0], 0.28, height)),
    ):  # fmt: skip
        one.rod(start, end, 0.02, shade)
    one.plate(-hub - 0.12, 0.0, (0.55, 0.62), 0.06, _RETRO)
    if ridden:
        _rider(one, -0.1 * length, 0.85 * height)


def _motorcycle(
    one: Assembly, size: tuple[float, float, float], shade: float, glass: float, ridden: bool, seed: int
) -> None:  # fmt: skip
    length, width, height = size
    for ahead in (0.34, -0.34):
        one.box(ahead * length, 0.0, (0.0, 0.62), (0.5, 0.13), _RUBBER)
    one.box(0.0, 0.0, (0.3, 0.75 * height), (0.5 * length, 0.28), shade)
    one.box(-0.22 * length, 0.0, (0.6 * height, 0.7 * height), (0.35 * length, 0.26), 45.0)
    one.rod((0.34 * length, 0.0, 0.3), (0.22 * length, 0.0, height), 0.04, 140.0)
    one.rod((0.22 * length, -width / 2, height), (0.22 * length, width / 2, height), 0.02, 60.0)
    one.plate(-length / 2, 0.0, (0.5, 0.65), 0.2, _RETRO)
    if ridden:
        _rider(one, -0.1 * length, 0.65 * height)


def _rider(one: Assembly, ahead: float, seat: float) -> None:
    """Add a person who sits."""
    one.rod((ahead, 0.0, seat), (ahead + 0.15, 0.0, seat + 0.55), 0.17, 110.0, PERSON)
    one.ball(ahead + 0.2, 0.0, (seat + 0.6, seat + 0.85), 0.11, _SKIN, part=PERSON)
    for side in (-1.0, 1.0):
        one.rod((ahead, 0.12 * side, seat), (ahead + 0.35, 0.14 * side, seat - 0.1), 0.08, 50.0, PERSON)
        one.rod((ahead + 0.35, 0.14 * side, seat - 0.1), (ahead + 0.2, 0.14 * side, 0.25), 0.06, 50.0, PERSON)
        one.rod((ahead + 0.12, 0.2 * side, seat + 0.5), (ahead + 0.5, 0.22 * side, seat + 0.25), 0.05, 110.0, PERSON)


def _person(
    one: Assembly, size: tuple[float, float, float], shade: float, glass: float, ridden: bool, seed: int
) -> None:  # fmt: skip
    _, width, height = size
    hip, neck, stride = 0.5 * height, 0.84 * height, 0.12 * (seed % 4)
    for side in (-1.0, 1.0):
        one.rod((side * stride, 0.1 * side, 0.0), (0.0, 0.09 * side, hip), 0.075, 0.6 * shade)
        hand = (-0.8 * side * stride, 0.46 * side * width, 0.46 * height)
        one.rod(hand, (0.0, 0.4 * side * width, neck - 0.05), 0.05, shade)
    one.rod((0.0, 0.0, hip - 0.05), (0.0, 0.0, neck), 0.16, shade)
    one.ball(0.0, 0.0, (neck, height), 0.11, _SKIN)
    if seed % 5 == 1:
        one.box(-0.25, 0.0, (0.55 * height, 0.8 * height), (0.2, 0.3), _DARK)


_MADE: Final[dict[str, Callable[[Assembly, tuple[float, float, float], float, float, bool, int], None]]] = {
    "car": _car, "van": _van, "lorry": _lorry, "bicycle": _bicycle, "motorcycle": _motorcycle, "person": _person,
}  # fmt: skip
