"""Bodies of street furniture, of parts of house fronts, and of covers in the road."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from roadscan.simulate.bodies import BURIED_M, Assembly

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
