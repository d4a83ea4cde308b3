"""A pen for plates of road signs: polygons, strokes and text in units of half the plate's height, and pictograms.

All of it is drawn by this code; nothing is taken from files or fonts of others: letters are strokes of a table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

UInt8 = npt.NDArray[np.uint8]
Float64 = npt.NDArray[np.float64]
Point = tuple[float, float]

_SUB: Final = 4  # fractional bits of OpenCV's coordinates
INRADIUS: Final = {"triangle": 2 / 3, "triangle down": 2 / 3, "diamond": 0.5**0.5}
"""Radius of the circle within a shape, in halves of its height; 1 for the others."""


@dataclass(frozen=True, eq=False)
class Pen:
    """A pen on a picture (h, w, 3). (0, 0) is the middle, x to the right, y downwards, 1 is `scale` · h / 2 pixels."""

    picture: UInt8
    x: float = 0.0
    y: float = 0.0
    scale: float = 1.0
    mirror: float = 1.0
    bold: float = 1.0
    rounds: int = 2
    """How often the corners of letters are cut."""

    def at(self, x: float, y: float, scale: float = 1.0, mirror: bool = False) -> Pen:
        """A pen whose middle, unit and direction of x are others."""
        return replace(
            self, x=self.x + self.scale * self.mirror * x, y=self.y + self.scale * y, scale=self.scale * scale,
            mirror=-self.mirror if mirror else self.mirror,
        )  # fmt: skip

    def pixels(self, points: Sequence[Point] | Float64) -> npt.NDArray[np.int32]:
        """OpenCV's points (k, 2) of points."""
        height, width = self.picture.shape[:2]
        p = np.asarray(points, np.float64) * self.scale * [self.mirror, 1.0] + [self.x, self.y]
        return np.rint((p * height / 2 + [width / 2 - 0.5, height / 2 - 0.5]) * (1 << _SUB)).astype(np.int32)

    def poly(self, points: Sequence[Point] | Float64, colour: Sequence[int]) -> None:
        """Fill a polygon."""
        cv2.fillPoly(self.picture, [self.pixels(points)], list(map(int, colour)), cv2.LINE_AA, _SUB)

    def line(
        self, points: Sequence[Point] | Float64, width: float, colour: Sequence[int], closed: bool = False
    ) -> None:
        """Draw a stroke."""
        thick = max(1, round(width * self.bold * self.scale * self.picture.shape[0] / 2))
        cv2.polylines(self.picture, [self.pixels(points)], closed, list(map(int, colour)), thick, cv2.LINE_AA, _SUB)

    def disc(self, x: float, y: float, radius: float, colour: Sequence[int]) -> None:
        """Fill a disc."""
        self.poly(circle(x, y, radius), colour)

    def bar(self, x0: float, y0: float, x1: float, y1: float, colour: Sequence[int]) -> None:
        """Fill an upright rectangle."""
        self.poly([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], colour)

    def arrow(self, points: Sequence[Point] | Float64, width: float, colour: Sequence[int], head: float = 2.4) -> None:
        """Draw a stroke with a head at its end, whose width is `head` times that of the stroke."""
        p = np.asarray(points, np.float64)
        way = (p[-1] - p[-2]) / max(float(np.linalg.norm(p[-1] - p[-2])), 1e-9)
        across, size = np.array([-way[1], way[0]]), head * width * self.bold
        neck = p[-1] - way * size * 0.8
        self.line(np.vstack([p[:-1], neck + way * 0.1 * size]), width, colour)
        self.poly(np.array([p[-1], neck + across * size / 2, neck - across * size / 2]), colour)

    def text(
        self, words: str, box: tuple[float, float, float, float], colour: Sequence[int], weight: float = 0.17
    ) -> None:
        """Write a line that fills a box (x0, y0, x1, y1); `weight` is the width of a stroke in heights of the box."""
        lines = [stroke + np.array([at, 0.0]) for at, strokes in _set(words, self.rounds) for stroke in strokes]
        if not lines:
            return
        every = np.concatenate(lines)
        low, high = every.min(axis=0), np.maximum(every.max(axis=0), every.min(axis=0) + 1e-6)
        thick = weight * (box[3] - box[1])
        first = np.array([box[0], box[1]]) + thick / 2
        size = np.maximum(np.array([box[2], box[3]]) - thick / 2 - first, 1e-3)
        for one in lines:
            self.line(first + (one - [low[0], 0.0]) / [high[0] - low[0], 6.0] * size, thick, colour)


_GLYPHS: Final = {
    "0": "~10 30 41 45 36 16 05 01 10", "1": "11 30 36", "2": "~01 10 30 41 42 33 06|06 46",
    "3": "~01 10 30 41 42 33 23|~23 33 44 45 36 16 05", "4": "20 04 44|32 36",
    "5": "40 10 03|~03 12 32 43 45 36 16 05", "6": "~41 30 10 01 05 16 36 45 44 33 13 04", "7": "00 40 16",
    "8": "~10 30 41 42 33 13 02 01 10|~13 33 44 45 36 16 05 04 13", "9": "~05 16 36 45 41 30 10 01 02 13 33 42",
    "A": "06 20 46|14 34", "B": "00 06|~00 30 41 42 33 03|~33 44 45 36 06", "C": "~41 30 10 01 05 16 36 45",
    "D": "00 06|~00 30 41 45 36 06", "E": "40 00 06 46|03 33", "F": "40 00 06|03 33",
    "G": "~41 30 10 01 05 16 36 45 43|43 23", "H": "00 06|40 46|03 43", "I": "20 26", "J": "~40 45 36 16 05",
    "K": "00 06|40 03 46", "L": "00 06 46", "M": "06 00 23 40 46", "N": "06 00 46 40",
    "O": "~10 30 41 45 36 16 05 01 10", "P": "06 00|~00 30 41 42 33 03", "Q": "~10 30 41 45 36 16 05 01 10|34 46",
    "R": "06 00|~00 30 41 42 33 03|23 46", "S": "~41 30 10 01 02 13 33 44 45 36 16 05", "T": "00 40|20 26",
    "U": "~00 05 16 36 45 40", "V": "00 26 40", "W": "00 16 22 36 40", "X": "00 46|40 06", "Y": "00 23 40|23 26",
    "Z": "00 40 06 46", "-": "03 43", "/": "40 06", ".": "15 16", "+": "13 33|22 24", "!": "10 14|15 16",
}  # fmt: skip
"""Strokes of letters on a grid 4 wide and 6 high: pairs of digits are x and y; those after ~ are rounded."""


def _set(words: str, rounds: int) -> list[tuple[float, list[Float64]]]:
    """Strokes of letters, each with its place along the line."""
    out, at = [], 0.0
    for letter in words:
        if letter == " ":
            at += 2.6
            continue
        strokes = []
        for part in _GLYPHS[letter].split("|"):
            points = np.array([[int(pair[0]), int(pair[1])] for pair in part.strip("~").split()], np.float64)
            strokes.append(_rounded(points, rounds) if part.startswith("~") else points)
        low, high = (f([f(s[:, 0]) for s in strokes]) for f in (min, max))
        out.append((at - low, strokes))
        at += high - low + 1.9
    return out


def _rounded(points: Float64, rounds: int) -> Float64:
    """Points with their corners cut (Chaikin 1974); the ends stay, those of a closed line are cut as well."""
    closed = bool((points[0] == points[-1]).all())
    for _ in range(rounds):
        cut = np.stack([0.75 * points[:-1] + 0.25 * points[1:], 0.25 * points[:-1] + 0.75 * points[1:]], axis=1)
        cut = cut.reshape(-1, 2)
        points = np.vstack([cut, cut[:1]]) if closed else np.vstack([points[:1], cut, points[-1:]])
    return points


def circle(x: float, y: float, radius: float, first_deg: float = 0.0, last_deg: float = 360.0) -> Float64:
    """Points (k, 2) of an arc; angles from x towards y."""
    angle = np.deg2rad(np.linspace(first_deg, last_deg, 40))
    return np.column_stack([x + radius * np.cos(angle), y + radius * np.sin(angle)])


def shape_points(shape: str, aspect: float, inset: float = 0.0) -> Float64:
    """Corners (k, 2) of a plate's shape, `inset` within its edge."""
    if shape in ("rectangle", "square"):
        w, h = aspect - inset, 1.0 - inset
        return np.array([[-w, -h], [w, -h], [w, h], [-w, h]])
    if shape == "cross":
        w = 0.26 - inset
        arm = np.array(
            [
                [-w, -1.2 + inset],
                [w, -1.2 + inset],
                [w, -w],
                [1.2 - inset, -w],
                [1.2 - inset, w],
                [w, w],
                [w, 1.2 - inset],
                [-w, 1.2 - inset],
                [-w, w],
                [-1.2 + inset, w],
                [-1.2 + inset, -w],
                [-w, -w],
            ]
        )
        return np.asarray(arm @ np.array([[1.0, 1.0], [-1.0, 1.0]]) * 0.5**0.5 * [aspect, 1.0] * 0.97)
    corners = {
        "round": circle(0, 0, 1.0), "diamond": np.array([[0, -1.0], [1, 0], [0, 1], [-1, 0]]),
        "octagon": circle(0, 0, 1.0)[:0], "pentagon": np.array([[0, -1.0], [1, 0.0], [1, 1], [-1, 1], [-1, 0.0]]),
        "triangle": np.array([[0, -1.0], [1, 1], [-1, 1]]), "triangle down": np.array([[0, 1.0], [-1, -1], [1, -1]]),
    }[shape]  # fmt: skip
    if shape == "octagon":
        angle = np.deg2rad(22.5 + 45.0 * np.arange(8))
        corners = np.column_stack([np.cos(angle), np.sin(angle)]) / np.cos(np.pi / 8)
    middle = np.array([0.0, {"triangle": 1 / 3, "triangle down": -1 / 3, "pentagon": 0.1}.get(shape, 0.0)])
    grown = 1.0 - inset / INRADIUS.get(shape, 0.9 if shape == "pentagon" else 1.0)
    return np.asarray((middle + grown * (corners - middle)) * [aspect, 1.0])


def figure(pen: Pen, ink: Sequence[int], stride: float = 0.35) -> None:
    """A walking person, 2 units high."""
    pen.disc(0.05, -0.78, 0.19, ink)
    pen.line([(0.0, -0.42), (-0.02, 0.1)], 0.34, ink)
    pen.line([(-0.02, 0.1), (stride * 0.7, 0.5), (stride, 0.95)], 0.2, ink)
    pen.line([(-0.04, 0.1), (-stride * 0.6, 0.55), (-stride * 1.4, 0.9)], 0.2, ink)
    pen.line([(0.0, -0.45), (0.35, -0.15), (0.5, 0.05)], 0.13, ink)
    pen.line([(0.0, -0.45), (-0.35, -0.2), (-0.42, 0.1)], 0.13, ink)


def walkers(pen: Pen, ink: Sequence[int]) -> None:
    """Two children who run."""
    figure(pen.at(-0.45, -0.08, 0.9), ink, 0.5)
    figure(pen.at(0.5, 0.12, 0.75), ink, 0.5)


def crossing(pen: Pen, ink: Sequence[int]) -> None:
    """A person on stripes."""
    figure(pen.at(0.0, -0.18, 0.78, True), ink)
    for k in range(5):
        x = -0.8 + 0.36 * k
        pen.poly([(x, 0.95), (x + 0.07, 0.62), (x + 0.23, 0.62), (x + 0.2, 0.95)], ink)


def bicycle(pen: Pen, ink: Sequence[int]) -> None:
    """A bicycle."""
    for x in (-0.58, 0.58):
        pen.line(circle(x, 0.25, 0.36), 0.09, ink, True)
    pen.line([(-0.58, 0.25), (-0.25, -0.3), (0.4, -0.3), (0.0, 0.25), (-0.58, 0.25)], 0.09, ink)
    pen.line([(0.0, 0.25), (-0.3, -0.45)], 0.09, ink)
    pen.line([(0.58, 0.25), (0.38, -0.5), (0.58, -0.55)], 0.09, ink)
    pen.line([(-0.45, -0.46), (-0.15, -0.46)], 0.1, ink)


def worker(pen: Pen, ink: Sequence[int]) -> None:
    """A person with a shovel before a heap."""
    pen.disc(-0.15, -0.75, 0.17, ink)
    pen.line([(-0.2, -0.45), (-0.4, 0.1)], 0.32, ink)
    pen.line([(-0.4, 0.1), (-0.1, 0.45), (-0.25, 0.92)], 0.2, ink)
    pen.line([(-0.42, 0.1), (-0.62, 0.5), (-0.85, 0.9)], 0.2, ink)
    pen.line([(-0.15, -0.4), (0.15, -0.05)], 0.14, ink)
    pen.line([(-0.45, -0.25), (0.55, 0.5)], 0.09, ink)
    pen.poly([(0.15, 0.95), (0.5, 0.45), (0.65, 0.45), (1.0, 0.95)], ink)


def car(pen: Pen, ink: Sequence[int]) -> None:
    """A car from behind."""
    pen.poly([(-0.55, -0.1), (-0.38, -0.62), (0.38, -0.62), (0.55, -0.1), (0.72, 0.05), (0.72, 0.45), (-0.72, 0.45),
              (-0.72, 0.05)], ink)  # fmt: skip
    for x in (-0.5, 0.5):
        pen.bar(x - 0.14, 0.4, x + 0.14, 0.72, ink)


def windows_of_car(pen: Pen, ground: Sequence[int]) -> None:
    """The rear window of :func:`car`."""
    pen.poly([(-0.38, -0.12), (-0.28, -0.48), (0.28, -0.48), (0.38, -0.12)], ground)


def car_from_side(pen: Pen, ink: Sequence[int]) -> None:
    """A car from its side."""
    pen.poly([(-0.95, 0.25), (-0.95, -0.05), (-0.6, -0.12), (-0.35, -0.45), (0.35, -0.45), (0.6, -0.1), (0.95, 0.0),
              (0.95, 0.25)], ink)  # fmt: skip
    for x in (-0.5, 0.5):
        pen.disc(x, 0.28, 0.2, ink)


def truck(pen: Pen, ink: Sequence[int]) -> None:
    """A truck from its side."""
    pen.bar(-0.9, -0.5, 0.35, 0.3, ink)
    pen.poly([(0.42, 0.3), (0.42, -0.28), (0.72, -0.28), (0.92, 0.02), (0.92, 0.3)], ink)
    for x in (-0.6, -0.25, 0.65):
        pen.disc(x, 0.36, 0.18, ink)


def deer(pen: Pen, ink: Sequence[int]) -> None:
    """A deer that jumps."""
    pen.poly([(-0.75, 0.2), (-0.55, -0.1), (0.2, -0.25), (0.45, -0.6), (0.75, -0.62), (0.85, -0.48), (0.6, -0.4),
              (0.45, 0.05), (0.1, 0.22), (-0.45, 0.2), (-0.7, 0.4)], ink)  # fmt: skip
    for points in ([(-0.6, 0.15), (-0.85, 0.55), (-0.95, 0.9)], [(-0.5, 0.15), (-0.6, 0.6), (-0.55, 0.9)],
                   [(0.3, 0.1), (0.65, 0.25), (0.6, 0.6)], [(0.2, 0.1), (0.45, 0.4), (0.4, 0.75)],
                   [(0.5, -0.6), (0.35, -0.95), (0.1, -0.95)], [(0.55, -0.6), (0.65, -0.98)]):  # fmt: skip
        pen.line(points, 0.1, ink)


def cow(pen: Pen, ink: Sequence[int]) -> None:
    """A cow."""
    pen.poly([(-0.7, -0.35), (0.45, -0.4), (0.7, -0.55), (0.98, -0.4), (0.9, -0.15), (0.65, -0.15), (0.5, 0.25),
              (-0.7, 0.25)], ink)  # fmt: skip
    for x in (-0.62, -0.42, 0.22, 0.42):
        pen.line([(x, 0.2), (x, 0.75)], 0.13, ink)
    pen.line([(-0.7, -0.3), (-0.88, 0.25)], 0.07, ink)


def lights(pen: Pen, palette: dict[str, tuple[int, int, int]], box: Sequence[int] | None) -> None:
    """Three lights of a signal."""
    if box is not None:
        pen.bar(-0.35, -0.95, 0.35, 0.95, box)
    for y, name in ((-0.6, "red"), (0.0, "yellow"), (0.6, "green")):
        pen.disc(0, y, 0.24, palette[name])


def turn_left(pen: Pen, ink: Sequence[int], width: float = 0.24, sharp: bool = False) -> None:
    """An arrow with a bend to the left."""
    if sharp:
        pen.arrow([(0.4, 0.9), (0.4, -0.25), (-0.75, -0.25)], width, ink)
    else:
        pen.arrow([(0.3, 0.95), (0.3, 0.4), (0.22, 0.1), (0.0, -0.2), (-0.45, -0.75)], width, ink)


def double_bend(pen: Pen, ink: Sequence[int], width: float = 0.22, sharp: bool = False) -> None:
    """An arrow with two bends, the first to the left."""
    if sharp:
        pen.arrow([(0.4, 0.95), (0.4, 0.2), (-0.35, 0.2), (-0.35, -0.9)], width, ink)
    else:
        pen.arrow([(0.25, 0.95), (0.25, 0.5), (-0.25, 0.15), (-0.28, -0.1), (0.1, -0.45), (0.15, -0.95)], width, ink)


def u_turn(pen: Pen, ink: Sequence[int], width: float = 0.24) -> None:
    """An arrow that turns back to the left."""
    pen.arrow([(0.45, 0.9), *circle(0.0, -0.25, 0.45, 0, -180).tolist(), (-0.45, 0.65)], width, ink)


def roundabout(pen: Pen, ink: Sequence[int], radius: float = 0.58, width: float = 0.2) -> None:
    """Three arrows in a circle."""
    for first in (0.0, 120.0, 240.0):
        points = circle(0, 0, radius, first + 100, first)
        pen.arrow(points[np.r_[0:40:4, 39]], width, ink, 2.3)


def slippery(pen: Pen, ink: Sequence[int]) -> None:
    """A car that skids."""
    car(pen.at(0.0, -0.35, 0.68), ink)
    for x in (-0.3, 0.3):
        pen.line([(x, 0.25), (x + 0.14, 0.42), (x - 0.14, 0.65), (x + 0.1, 0.9)], 0.11, ink)


def train(pen: Pen, ink: Sequence[int]) -> None:
    """A steam engine."""
    pen.bar(-0.85, -0.15, 0.6, 0.35, ink)
    pen.bar(0.25, -0.6, 0.85, 0.35, ink)
    pen.bar(-0.65, -0.55, -0.45, -0.1, ink)
    for x in (-0.55, -0.05, 0.5):
        pen.disc(x, 0.45, 0.22, ink)


def gate(pen: Pen, ink: Sequence[int]) -> None:
    """A fence of a level crossing."""
    for y in (-0.2, 0.3):
        pen.line([(-0.85, y), (0.85, y)], 0.17, ink)
    for x in (-0.65, -0.22, 0.22, 0.65):
        pen.line([(x, -0.55), (x, 0.65)], 0.17, ink)


def two_ways(pen: Pen, ink: Sequence[int], width: float = 0.24) -> None:
    """An arrow down beside one up."""
    pen.arrow([(-0.38, -0.85), (-0.38, 0.85)], width, ink)
    pen.arrow([(0.38, 0.85), (0.38, -0.85)], width, ink)


def narrows(pen: Pen, ink: Sequence[int]) -> None:
    """A road that narrows on both sides."""
    pen.line([(-0.6, 0.9), (-0.6, 0.35), (-0.22, -0.2), (-0.22, -0.9)], 0.2, ink)
    pen.line([(0.6, 0.9), (0.6, 0.35), (0.22, -0.2), (0.22, -0.9)], 0.2, ink)


def road_ahead(pen: Pen, ink: Sequence[int], ground: Sequence[int]) -> None:
    """A motorway under a bridge."""
    pen.poly([(-0.8, 0.95), (-0.18, -0.9), (0.18, -0.9), (0.8, 0.95)], ink)
    pen.line([(0.0, 0.95), (0.0, -0.9)], 0.09, ground)
    pen.bar(-0.95, -0.32, 0.95, -0.1, ground)
    pen.bar(-0.95, -0.5, 0.95, -0.28, ink)


def bus(pen: Pen, ink: Sequence[int], ground: Sequence[int]) -> None:
    """A bus from its side."""
    pen.bar(-0.9, -0.5, 0.9, 0.35, ink)
    for x in (-0.68, -0.25, 0.2, 0.62):
        pen.bar(x - 0.14, -0.36, x + 0.16, -0.05, ground)
    for x in (-0.5, 0.5):
        pen.disc(x, 0.4, 0.18, ink)
