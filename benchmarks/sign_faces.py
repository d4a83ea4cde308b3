"""Faces of the common signs of the Vienna Convention (1968, annex 1) and of the MUTCD (2009): one list, drawn by code.

Codes are `vienna:` with the section's letter and number, or `mutcd:`; what a set does not number itself (left and right
of one sign, the value of a limit) follows a dash. A face that both sets show alike has both codes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from benchmarks import sign_pen as draw
from benchmarks.sign_pen import Pen, circle, shape_points

UInt8 = npt.NDArray[np.uint8]
Rgb = tuple[int, int, int]

HEIGHT_PX: Final = 144
"""Height of a drawn face (pixels), before it is seen by a camera."""
PALETTE: Final[dict[str, Rgb]] = {
    "white": (238, 238, 238), "red": (196, 28, 40), "blue": (10, 80, 160), "yellow": (248, 198, 20),
    "black": (24, 24, 26), "green": (0, 110, 70), "orange": (242, 130, 20), "grey": (140, 144, 146),
    "brown": (110, 62, 32),
}  # fmt: skip
TRIANGLE: Final = 2 / 3**0.5  # width over height


@dataclass(frozen=True)
class Style:
    """What differs between signs of one type: makers, countries, years."""

    palette: dict[str, Rgb] = field(default_factory=lambda: dict(PALETTE))
    bold: float = 1.0
    scale: float = 1.0
    shift: tuple[float, float] = (0.0, 0.0)
    rim: float = 1.0
    rounds: int = 2
    yellow_ground: bool = False
    """Warnings and prohibitions on yellow, as in Sweden, Finland, Poland."""
    thin_edge: bool = True


def style_of(rng: np.random.Generator) -> Style:
    """A style by chance."""
    fade = rng.uniform(0.0, 0.35) if rng.random() < 0.3 else rng.uniform(0.0, 0.08)
    palette = {}
    for name, rgb in PALETTE.items():
        own = np.array(rgb) * rng.uniform(0.85, 1.08) + rng.normal(0.0, 9.0, 3)
        palette[name] = tuple(np.clip(own * (1 - fade) + fade * 170, 0, 255).astype(int).tolist())
    return Style(palette, rng.uniform(0.82, 1.25), rng.uniform(0.88, 1.12), tuple(rng.normal(0.0, 0.025, 2).tolist()),
                 rng.uniform(0.75, 1.3), int(rng.integers(1, 4)), rng.random() < 0.13, rng.random() < 0.6)  # fmt: skip


Drawn = Callable[[Pen, dict[str, Rgb], Style], None]


@dataclass(frozen=True)
class Face:
    """A type of sign."""

    code: str
    name: str
    shape: str
    colours: tuple[str, ...]
    draw: Drawn
    aspect: float = 1.0
    """Width over height of its box."""

    def drawn(self, style: Style) -> tuple[UInt8, UInt8]:
        """The face (h, w, 3) and its outline (h, w), 255 within."""
        return drawn(self.shape, self.aspect, self.draw, style)


def drawn(shape: str, aspect: float, paint: Drawn, style: Style) -> tuple[UInt8, UInt8]:
    """A face (h, w, 3) and its outline (h, w), 255 within."""
    picture = np.zeros((HEIGHT_PX, max(8, round(HEIGHT_PX * aspect)), 3), np.uint8)
    outline = picture.copy()
    paint(Pen(picture, bold=style.bold, rounds=style.rounds), style.palette, style)
    Pen(outline).poly(_cornered(shape, aspect), (255, 255, 255))
    return picture, outline[:, :, 0]


def _cornered(shape: str, aspect: float) -> Any:
    """Outline with corners rounded a little."""
    points = shape_points(shape, aspect)
    if shape in ("round", "octagon", "cross"):
        return points
    before, after = np.roll(points, 1, axis=0), np.roll(points, -1, axis=0)
    cut = 0.07
    return np.stack([points + cut * (before - points), points + 0.02 * (before + after - 2 * points),
                     points + cut * (after - points)], axis=1).reshape(-1, 2)  # fmt: skip


def _inner(pen: Pen, style: Style, x: float, y: float, scale: float) -> Pen:
    return pen.at(x + style.shift[0], y + style.shift[1], scale * style.scale)


def _shape(pen: Pen, shape: str, aspect: float, rings: Sequence[tuple[float, Rgb]]) -> None:
    pen.picture[:] = rings[0][1]
    for inset, colour in rings:
        pen.poly(shape_points(shape, aspect, inset), colour)


def _warning(picto: Callable[..., None], pen: Pen, c: dict[str, Rgb], style: Style) -> None:
    ground = c["yellow"] if style.yellow_ground else c["white"]
    edge = [(0.0, c["white"])] if style.thin_edge else []
    _shape(pen, "triangle", TRIANGLE, [*edge, (0.04 if edge else 0.0, c["red"]), (0.20 * style.rim, ground)])
    picto(_inner(pen, style, 0.0, 0.24, 0.41), c, ground)


def _prohibition(picto: Callable[..., None] | None, slash: str, pen: Pen, c: dict[str, Rgb], style: Style) -> None:
    ground = c["yellow"] if style.yellow_ground else c["white"]
    edge = [(0.0, c["white"])] if style.thin_edge else []
    _shape(pen, "round", 1.0, [*edge, (0.03 if edge else 0.0, c["red"]), (0.22 * style.rim, ground)])
    if picto is not None:
        picto(_inner(pen, style, 0.0, 0.0, 0.62), c, ground)
    if slash:
        d = 0.58
        pen.line([(-d, -d), (d, d)] if slash == "\\" else [(d, -d), (-d, d)], 0.13, c["red"])


def _ended(picto: Callable[..., None] | None, pen: Pen, c: dict[str, Rgb], style: Style) -> None:
    edge = c["black"] if style.thin_edge else c["grey"]
    _shape(pen, "round", 1.0, [(0.0, c["white"]), (0.02, edge), (0.07, c["white"])])
    if picto is not None:
        picto(_inner(pen, style, 0.0, 0.0, 0.62), c | {"black": c["grey"], "red": c["grey"]}, c["white"])
    if style.rim > 1.1:
        pen.line([(0.68, -0.68), (-0.68, 0.68)], 0.2, c["black"])
        return
    for k in (-0.2, -0.1, 0.0, 0.1, 0.2):
        pen.line([(0.66 + k / 2, -0.66 + k / 2), (-0.66 + k / 2, 0.66 + k / 2)], 0.045, c["black"])


def _mandatory(picto: Callable[..., None], pen: Pen, c: dict[str, Rgb], style: Style) -> None:
    _shape(pen, "round", 1.0, [(0.0, c["white"]), (0.04 if style.thin_edge else 0.0, c["blue"])])
    picto(_inner(pen, style, 0.0, 0.0, 0.66), c | {"black": c["white"]}, c["blue"])


def _panel(picto: Callable[..., None], ground: str, ink: str, edge: str, aspect: float, inner: float,
           pen: Pen, c: dict[str, Rgb], style: Style) -> None:  # fmt: skip
    _shape(pen, "rectangle", aspect, [(0.0, c[ground]), (0.05, c[edge]), (0.05 + 0.05 * style.rim, c[ground])])
    picto(_inner(pen, style, 0.0, 0.0, inner), c | {"black": c[ink]}, c[ground])


def _diamond(picto: Callable[..., None], ground: str, pen: Pen, c: dict[str, Rgb], style: Style) -> None:
    _shape(pen, "diamond", 1.0, [(0.0, c[ground]), (0.04, c["black"]), (0.04 + 0.045 * style.rim, c[ground])])
    picto(_inner(pen, style, 0.0, 0.0, 0.55), c, c[ground])


def _ink(shape: Callable[..., None], mirror: bool = False, turned: bool = False, **k: Any) -> Callable[..., None]:
    """A pictogram in black."""
    return lambda pen, c, ground: shape(pen.at(0, 0, 1.0, mirror), c["black"], **k)


def _lines(*lines: tuple[tuple[float, float], ...], width: float = 0.24, heads: Sequence[int] = ()) -> Any:
    """A pictogram of strokes; those of the numbers `heads` are arrows."""

    def picto(pen: Pen, c: dict[str, Rgb], ground: Rgb) -> None:
        for k, one in enumerate(lines):
            (pen.arrow if k in heads else pen.line)(one, width, c["black"])

    return picto


def _words(*lines: str, box: tuple[float, float, float, float] = (-0.9, -0.9, 0.9, 0.9), gap: float = 0.2,
           weight: float = 0.18) -> Any:  # fmt: skip
    """A pictogram of lines of text, one below the other."""

    def picto(pen: Pen, c: dict[str, Rgb], ground: Rgb) -> None:
        x0, y0, x1, y1 = box
        step = (y1 - y0 + gap) / len(lines)
        most = max(map(len, lines))
        for k, words in enumerate(lines):
            half = (x1 - x0) / 2 * (0.45 + 0.55 * len(words) / most)
            middle = (x0 + x1) / 2
            pen.text(
                words, (middle - half, y0 + k * step, middle + half, y0 + (k + 1) * step - gap), c["black"], weight
            )

    return picto


def _number(value: int) -> Any:
    w = 0.78 if value < 100 else 1.0
    return _words(str(value), box=(-w, -0.62, w, 0.62), weight=0.2)


def _cars(red: bool, is_truck: bool = False) -> Any:
    def picto(pen: Pen, c: dict[str, Rgb], ground: Rgb) -> None:
        left, right = (pen.at(x, 0.0, 0.62) for x in (-0.47, 0.5))
        if is_truck:
            for one, colour in ((left, c["red"] if red else c["black"]), (right, c["black"])):
                big = colour is not c["black"] or one is left
                one.bar(-0.6, -0.9 if big else -0.5, 0.6, 0.5, colour)
                one.bar(-0.55, 0.5, -0.2, 0.75, colour)
                one.bar(0.2, 0.5, 0.55, 0.75, colour)
            return
        for one, colour in ((left, c["red"]), (right, c["black"])):
            draw.car(one, colour)
            draw.windows_of_car(one, ground)

    return picto


def _side_by_side(left: Callable[..., None], right: Callable[..., None]) -> Any:
    def picto(pen: Pen, c: dict[str, Rgb], ground: Rgb) -> None:
        left(pen.at(-0.45, 0.0, 0.55), c, ground)
        right(pen.at(0.45, 0.0, 0.55), c, ground)

    return picto


def _vehicle(shape: Callable[..., None]) -> Any:
    def picto(pen: Pen, c: dict[str, Rgb], ground: Rgb) -> None:
        shape(pen, c["black"])

    return picto


def _with_ground(shape: Callable[..., None]) -> Any:
    return lambda pen, c, ground: shape(pen, c["black"], ground)


def _signal(box: bool) -> Any:
    return lambda pen, c, ground: draw.lights(pen, c, c["black"] if box else None)


def _exclamation(pen: Pen, c: dict[str, Rgb], ground: Rgb) -> None:
    pen.poly([(-0.2, -0.95), (0.2, -0.95), (0.11, 0.35), (-0.11, 0.35)], c["black"])
    pen.disc(0, 0.72, 0.2, c["black"])


def _stop(pen: Pen, c: dict[str, Rgb], style: Style) -> None:
    _shape(pen, "octagon", 1.0, [(0.0, c["white"]), (0.05 * style.rim, c["red"])])
    pen.text("STOP", (-0.8 * style.scale, -0.36, 0.8 * style.scale, 0.36), c["white"], 0.18)


def _give_way(words: str, pen: Pen, c: dict[str, Rgb], style: Style) -> None:
    ground = c["yellow"] if style.yellow_ground and not words else c["white"]
    _shape(
        pen,
        "triangle down",
        TRIANGLE,
        [(0.0, c["white"]), (0.03, c["red"]), ((0.3 if words else 0.2) * style.rim, ground)],
    )
    if words:
        pen.text(words, (-0.36, -0.62, 0.36, -0.36), c["red"], 0.2)


def _no_entry(words: bool, pen: Pen, c: dict[str, Rgb], style: Style) -> None:
    if words:
        pen.picture[:] = c["white"]
        pen.disc(0, 0, 0.92, c["red"])
        pen.text("DO NOT", (-0.55, -0.62, 0.55, -0.32), c["white"])
        pen.text("ENTER", (-0.5, 0.32, 0.5, 0.62), c["white"])
        pen.bar(-0.7, -0.14, 0.7, 0.14, c["white"])
        return
    _shape(pen, "round", 1.0, [(0.0, c["white"]), (0.03 if style.thin_edge else 0.0, c["red"])])
    h = 0.17 * style.rim
    pen.bar(-0.72, -h, 0.72, h, c["white"])


def _closed(pen: Pen, c: dict[str, Rgb], style: Style) -> None:
    _prohibition(None, "", pen, c, style)


def _priority(ended: bool, pen: Pen, c: dict[str, Rgb], style: Style) -> None:
    _shape(pen, "diamond", 1.0, [(0.0, c["white"]), (0.24 * style.rim, c["yellow"])])
    if not style.thin_edge:
        pen.line(shape_points("diamond", 1.0, 0.03), 0.035, c["black"], True)
    if ended:
        for k in (-0.12, -0.04, 0.04, 0.12):
            pen.line([(0.42 + k, -0.42 + k), (-0.42 + k, 0.42 + k)], 0.035, c["black"])


def _no_stopping(lines: int, pen: Pen, c: dict[str, Rgb], style: Style) -> None:
    _shape(
        pen,
        "round",
        1.0,
        [(0.0, c["white"] if style.thin_edge else c["red"]), (0.03, c["red"]), (0.2 * style.rim, c["blue"])],
    )
    pen.line([(-0.6, -0.6), (0.6, 0.6)], 0.17 * style.rim, c["red"])
    if lines == 2:
        pen.line([(0.6, -0.6), (-0.6, 0.6)], 0.17 * style.rim, c["red"])


def _us_prohibition(picto: Callable[..., None], pen: Pen, c: dict[str, Rgb], style: Style) -> None:
    _shape(pen, "rectangle", 1.0, [(0.0, c["white"]), (0.03, c["black"]), (0.07, c["white"])])
    picto(_inner(pen, style, 0.0, 0.0, 0.5), c, c["white"])
    pen.line(circle(0, 0, 0.74), 0.15 * style.rim, c["red"], True)
    pen.line([(-0.5, -0.5), (0.5, 0.5)], 0.14 * style.rim, c["red"])


def _one_way(right: bool, pen: Pen, c: dict[str, Rgb], style: Style) -> None:
    pen.picture[:] = c["black"]
    p = pen.at(0, 0, 1.0, not right)
    p.poly([(-2.8, -0.55), (1.6, -0.55), (1.6, -0.9), (2.85, 0), (1.6, 0.9), (1.6, 0.55), (-2.8, 0.55)], c["white"])
    x = 0.25 if right else -0.25
    pen.text("ONE WAY", (-1.9 - x * 1.6, -0.33, 1.9 - x * 1.6, 0.33), c["black"])


def _speed_limit(value: int, pen: Pen, c: dict[str, Rgb], style: Style) -> None:
    _shape(pen, "rectangle", 0.8, [(0.0, c["white"]), (0.03, c["black"]), (0.03 + 0.035 * style.rim, c["white"])])
    pen.text("SPEED", (-0.55, -0.84, 0.55, -0.55), c["black"])
    pen.text("LIMIT", (-0.5, -0.42, 0.5, -0.13), c["black"])
    s = style.scale
    pen.text(str(value), (-0.55 * s, 0.44 - 0.38 * s, 0.55 * s, 0.44 + 0.38 * s), c["black"], 0.2)


def _rail(pen: Pen, c: dict[str, Rgb], style: Style) -> None:
    _shape(pen, "round", 1.0, [(0.0, c["yellow"]), (0.04, c["black"]), (0.1, c["yellow"])])
    for s in (-1, 1):
        pen.line([(-0.62 * s, -0.62), (0.62 * s, 0.62)], 0.17, c["black"])
        pen.text("R", (-0.17 + 0.58 * s, -0.2, 0.17 + 0.58 * s, 0.2), c["black"], 0.2)


def _crossbuck(american: bool, pen: Pen, c: dict[str, Rgb], style: Style) -> None:
    pen.picture[:] = c["white"] if american else c["red"]
    if not american:
        if style.bold > 1.05:  # red ends, white middle, as in Germany
            pen.poly(shape_points("cross", 1.0, 0.03) * 0.62, c["white"])
        else:
            pen.poly(shape_points("cross", 1.0, 0.09), c["white"])
        return
    for s in (-1, 1):
        pen.line([(-0.75, -0.75 * s), (0.75, 0.75 * s)], 0.1, c["black"])


def _school(pen: Pen, c: dict[str, Rgb], style: Style) -> None:
    ground = c["yellow"] if style.bold > 1.0 else (190, 225, 30)
    _shape(pen, "pentagon", 1.0, [(0.0, ground), (0.04, c["black"]), (0.09, ground)])
    draw.figure(_inner(pen, style, -0.32, 0.2, 0.6), c["black"])
    draw.figure(_inner(pen, style, 0.35, 0.3, 0.5), c["black"])


def _chevron(right: bool, pen: Pen, c: dict[str, Rgb], style: Style) -> None:
    pen.picture[:] = c["yellow"]
    p = pen.at(0, 0, 1.0, not right)
    p.poly([(-0.55, -0.9), (-0.1, -0.9), (0.6, 0), (-0.1, 0.9), (-0.55, 0.9), (0.1, 0)], c["black"])


def _keep(right: bool, pen: Pen, c: dict[str, Rgb], style: Style) -> None:
    _shape(pen, "rectangle", 0.8, [(0.0, c["white"]), (0.03, c["black"]), (0.07, c["white"])])
    p = _inner(pen, style, 0, 0, 0.85).at(0, 0, 1.0, not right)
    p.poly([(-0.45, 0.15), (-0.25, 0.15), (-0.2, 0.9), (-0.5, 0.9)], c["black"])
    p.arrow([(-0.35, -0.95), (-0.3, -0.4), (0.15, 0.2), (0.2, 0.9)], 0.17, c["black"], 2.6)


def _crossing_panel(pen: Pen, c: dict[str, Rgb], style: Style) -> None:
    _shape(pen, "rectangle", 1.0, [(0.0, c["white"]), (0.03, c["blue"])])
    pen.poly(np.array([[0, -0.82], [0.86, 0.72], [-0.86, 0.72]]) * style.scale**0.5, c["white"])
    draw.crossing(_inner(pen, style, 0.0, 0.25, 0.47), c["black"])


def _dead_end(pen: Pen, c: dict[str, Rgb], ground: Rgb) -> None:
    pen.line([(0.0, 0.95), (0.0, -0.3)], 0.34, c["black"])
    pen.bar(-0.62, -0.8, 0.62, -0.38, c["red"])


def _barred(picto: Callable[..., None]) -> Any:
    def one(pen: Pen, c: dict[str, Rgb], ground: Rgb) -> None:
        picto(pen, c, ground)
        pen.line([(1.0, -1.0), (-1.0, 1.0)], 0.2, c["red"])

    return one


def _town(pen: Pen, c: dict[str, Rgb], ground: Rgb) -> None:
    pen.poly([(-1.2, 0.8), (-1.2, -0.1), (-0.9, -0.5), (-0.6, -0.1), (-0.6, -0.4), (-0.1, -0.4), (-0.1, 0.0),
              (0.2, 0.0), (0.4, -0.9), (0.6, 0.0), (1.2, 0.0), (1.2, 0.8)], c["black"])  # fmt: skip


def _living_street(pen: Pen, c: dict[str, Rgb], ground: Rgb) -> None:
    draw.figure(pen.at(-0.7, 0.0, 0.75), c["black"])
    draw.figure(pen.at(-0.05, 0.35, 0.45), c["black"])
    pen.poly([(0.35, 0.1), (0.35, -0.5), (0.75, -0.9), (1.15, -0.5), (1.15, 0.1)], c["black"])
    draw.car_from_side(pen.at(0.7, 0.55, 0.5), c["black"])


def _slope(pen: Pen, c: dict[str, Rgb], ground: Rgb) -> None:
    pen.poly([(-0.95, -0.2), (-0.95, 0.7), (0.95, 0.7)], c["black"])
    pen.text("12", (-0.1, -0.65, 0.6, -0.05), c["black"])


def _rocks(pen: Pen, c: dict[str, Rgb], ground: Rgb) -> None:
    pen.poly([(0.95, -0.95), (0.95, 0.9), (0.1, 0.9), (0.35, 0.3), (0.5, -0.3), (0.6, -0.95)], c["black"])
    for x, y, r in ((-0.1, -0.2, 0.18), (-0.4, 0.2, 0.16), (-0.2, 0.7, 0.2), (-0.65, 0.75, 0.14)):
        pen.disc(x, y, r, c["black"])


def _bumps(count: int) -> Any:
    def picto(pen: Pen, c: dict[str, Rgb], ground: Rgb) -> None:
        pen.bar(-0.95, 0.35, 0.95, 0.6, c["black"])
        for x in (-0.42, 0.42) if count == 2 else (0.0,):
            pen.poly(circle(x, 0.36, 0.4 if count == 2 else 0.55, 180, 360), c["black"])

    return picto


def _queue(pen: Pen, c: dict[str, Rgb], ground: Rgb) -> None:
    for y, s in ((0.6, 0.5), (-0.05, 0.42), (-0.6, 0.34)):
        draw.car(pen.at(0, y, s), c["black"])
        pen.at(0, y, s).bar(-0.6, 0.1, 0.6, 0.28, c["red"])


def _minor_road(pen: Pen, c: dict[str, Rgb], ground: Rgb) -> None:
    if pen.bold > 1.0:  # a broad arrow without shoulders, as in Germany
        pen.poly([(-0.38, 0.95), (-0.38, -0.5), (0.0, -0.95), (0.38, -0.5), (0.38, 0.95), (0.0, 0.7)], c["black"])
        pen.line([(-0.85, 0.2), (0.85, 0.2)], 0.16, c["black"])
        return
    pen.arrow([(0.0, 0.95), (0.0, -0.95)], 0.36, c["black"], 2.0)
    pen.line([(-0.7, 0.2), (0.7, 0.2)], 0.16, c["black"])


def _oncoming(mine: str, other: str) -> Any:
    def picto(pen: Pen, c: dict[str, Rgb], ground: Rgb) -> None:
        pen.arrow([(-0.42, -0.85), (-0.42, 0.85)], 0.22, c[other])
        pen.arrow([(0.42, 0.85), (0.42, -0.85)], 0.26, c[mine])

    return picto


def _stop_ahead(pen: Pen, c: dict[str, Rgb], ground: Rgb) -> None:
    pen.arrow([(0, -0.35), (0, -1.1)], 0.2, c["black"])
    angle = np.deg2rad(22.5 + 45.0 * np.arange(8))
    pen.poly(np.column_stack([np.cos(angle), np.sin(angle)]) * 0.62 + [0, 0.45], c["red"])


def _yield_ahead(pen: Pen, c: dict[str, Rgb], ground: Rgb) -> None:
    pen.arrow([(0, -0.3), (0, -1.1)], 0.2, c["black"])
    pen.poly([(-0.65, -0.15), (0.65, -0.15), (0, 0.98)], c["red"])
    pen.poly([(-0.33, 0.04), (0.33, 0.04), (0, 0.62)], c["white"])


def _merge(pen: Pen, c: dict[str, Rgb], ground: Rgb) -> None:
    pen.arrow([(-0.15, 0.95), (-0.15, -0.95)], 0.26, c["black"])
    pen.line([(0.5, 0.9), (0.45, 0.45), (-0.1, 0.0)], 0.2, c["black"])


def _large_arrow(right: bool, pen: Pen, c: dict[str, Rgb], style: Style) -> None:
    _shape(pen, "rectangle", 2.0, [(0.0, c["yellow"]), (0.05, c["black"]), (0.1, c["yellow"])])
    pen.at(0, 0, 1.0, not right).arrow([(-1.6, 0), (1.6, 0)], 0.4, c["black"])


def _wrong_way(pen: Pen, c: dict[str, Rgb], style: Style) -> None:
    _shape(pen, "rectangle", 1.5, [(0.0, c["white"]), (0.05, c["red"])])
    _words("WRONG", "WAY", box=(-1.2, -0.7, 1.2, 0.7))(pen, c | {"black": c["white"]}, c["red"])


def _faces() -> list[Face]:
    w, r, b, k, y = "white", "red", "blue", "black", "yellow"
    up = ((0.0, 0.95), (0.0, -0.95))
    out: list[Face] = []

    def warn(code: str, name: str, picto: Any) -> None:
        out.append(Face(f"vienna:{code}", name, "triangle", (w, r, k), partial(_warning, picto), TRIANGLE))

    def ban(code: str, name: str, picto: Any, slash: str = "") -> None:
        out.append(Face(f"vienna:{code}", name, "round", (w, r, k), partial(_prohibition, picto, slash)))

    def must(code: str, name: str, picto: Any) -> None:
        out.append(Face(f"vienna:{code}", name, "round", (b, w), partial(_mandatory, picto)))

    def panel(code: str, name: str, picto: Any, ground: str = b, ink: str = w, edge: str = w, aspect: float = 1.0,
              inner: float = 0.68) -> None:  # fmt: skip
        shape = "square" if aspect == 1.0 else "rectangle"
        out.append(
            Face(code, name, shape, (ground, ink), partial(_panel, picto, ground, ink, edge, aspect, inner), aspect)
        )

    def caution(code: str, name: str, picto: Any, ground: str = y) -> None:
        out.append(Face(f"mutcd:{code}", name, "diamond", (ground, k), partial(_diamond, picto, ground)))

    def other(code: str, name: str, shape: str, colours: tuple[str, ...], paint: Drawn, aspect: float = 1.0) -> None:
        out.append(Face(code, name, shape, colours, paint, aspect))

    other("vienna:B2a mutcd:R1-1", "stop", "octagon", (r, w), _stop)
    other("vienna:B1", "give way", "triangle down", (w, r), partial(_give_way, ""), TRIANGLE)
    other("vienna:B3", "priority road", "diamond", (y, w), partial(_priority, False))
    other("vienna:B4", "end of priority", "diamond", (y, w, k), partial(_priority, True))
    ban("B5", "priority for oncoming traffic", _oncoming("red", "black"))
    panel("vienna:B6", "priority over oncoming traffic", _oncoming("white", "red"))
    both = (("left", False, "a"), ("right", True, "b"))
    for side, mirror, letter in both:
        warn(f"A1{letter}", f"bend to the {side}", _ink(draw.turn_left, mirror))
    for side, mirror, letter in (("left", False, "c"), ("right", True, "d")):
        warn(f"A1{letter}", f"double bend, the first to the {side}", _ink(draw.double_bend, mirror))
    warn("A2", "dangerous descent", _slope)
    warn("A4", "carriageway narrows", _ink(draw.narrows))
    warn("A7a", "uneven road", _bumps(2))
    warn("A7b", "hump", _bumps(1))
    warn("A9", "slippery road", _ink(draw.slippery))
    warn("A11", "falling rocks", _rocks)
    warn("A12", "pedestrian crossing ahead", _vehicle(draw.crossing))
    warn("A13", "children", _vehicle(draw.walkers))
    warn("A14", "cyclists", _vehicle(draw.bicycle))
    warn("A15a", "domestic animals", _vehicle(draw.cow))
    warn("A15b", "wild animals", _vehicle(draw.deer))
    warn("A16", "road works", _vehicle(draw.worker))
    warn("A17", "light signals", _signal(False))
    warn(
        "A18",
        "crossroads, priority to the right",
        _lines(((-0.7, -0.7), (0.7, 0.7)), ((0.7, -0.7), (-0.7, 0.7)), width=0.3),
    )
    warn("A19", "crossing with a minor road", _minor_road)
    warn("A22", "roundabout ahead", _ink(draw.roundabout))
    warn("A23", "two-way traffic", _ink(draw.two_ways))
    warn("A24", "congestion", _queue)
    warn("A25", "level crossing with gates", _vehicle(draw.gate))
    warn("A26", "level crossing without gates", _vehicle(draw.train))
    warn("A32", "other danger", _exclamation)
    other("vienna:A28", "level crossing, cross", "cross", (w, r), partial(_crossbuck, False))
    other("vienna:C1", "no entry", "round", (r, w), partial(_no_entry, False))
    other("vienna:C2", "closed to all vehicles", "round", (w, r), _closed)
    ban("C3a", "no motor vehicles", lambda p, c, g: (draw.car(p, c["black"]), draw.windows_of_car(p, g))[0])
    ban("C3c", "no cycles", _vehicle(draw.bicycle))
    ban("C3e", "no goods vehicles", _vehicle(draw.truck))
    ban("C3i", "no pedestrians", _vehicle(draw.figure))
    for side, mirror, letter in both:
        ban(f"C11{letter}", f"no {side} turn", _ink(draw.turn_left, mirror, sharp=True), "/" if mirror else "\\")
    ban("C12", "no U-turn", _ink(draw.u_turn), "\\")
    ban("C13aa", "no overtaking", _cars(True))
    ban("C13ba", "no overtaking by goods vehicles", _cars(True, True))
    for value in range(20, 140, 10):
        ban(f"C14-{value}", f"speed limit {value}", _number(value))
    other("vienna:C17a", "end of all prohibitions", "round", (w, k), partial(_ended, None))
    for value in (30, 50, 60, 70, 80, 100):
        other(f"vienna:C17b-{value}", f"end of speed limit {value}", "round", (w, k), partial(_ended, _number(value)))
    other("vienna:C17c", "end of no overtaking", "round", (w, k), partial(_ended, _cars(True)))
    other("vienna:C18", "no parking", "round", (b, r), partial(_no_stopping, 1))
    other("vienna:C19", "no stopping", "round", (b, r), partial(_no_stopping, 2))
    must("D1a-straight", "straight on", _lines(up, heads=(0,), width=0.3))
    for side, s in (("left", -1), ("right", 1)):
        must(f"D1a-{side}", f"turn {side}", _lines(((-0.95 * s, 0.0), (0.95 * s, 0.0)), heads=(0,), width=0.3))
        must(f"D1a-{side}-ahead", f"turn {side} ahead",
             _lines(((-0.4 * s, 0.9), (-0.4 * s, -0.25), (0.75 * s, -0.25)), heads=(0,), width=0.27))  # fmt: skip
        ahead, aside = ((-0.25 * s, 0.9), (-0.25 * s, -0.95)), ((-0.25 * s, 0.3), (0.8 * s, 0.3))
        must(f"D1a-straight-{side}", f"straight on or {side}", _lines(ahead, aside, heads=(0, 1)))
        must(f"D2-{side}", f"pass on the {side}", _lines(((-0.65 * s, -0.65), (0.7 * s, 0.7)), heads=(0,), width=0.3))
    must("D3", "roundabout", _ink(draw.roundabout, radius=0.68))
    must("D4", "cycle path", _vehicle(draw.bicycle))
    must("D5", "footpath", _vehicle(draw.figure))
    must("D11", "foot and cycle path",
         lambda p, c, g: (draw.figure(p.at(0, -0.42, 0.5), c["black"]), p.bar(-1, 0.08, 1, 0.16, c["black"]),
                          draw.bicycle(p.at(0, 0.52, 0.55), c["black"]))[0])  # fmt: skip
    panel("vienna:E3", "one way", _lines(up, heads=(0,), width=0.34))
    for side, s in (("left", -1), ("right", 1)):
        panel(f"vienna:E3-{side}", f"one way to the {side}",
              _lines(((-1.5 * s, 0.0), (1.7 * s, 0.0)), heads=(0,), width=0.4), aspect=2.2, inner=1.0)  # fmt: skip
    panel("vienna:E5a", "motorway", _with_ground(draw.road_ahead))
    panel("vienna:E5b", "end of motorway", _barred(_with_ground(draw.road_ahead)))
    panel(
        "vienna:E6a", "road for motor vehicles", lambda p, c, g: (draw.car(p, c["black"]), draw.windows_of_car(p, g))[0]
    )
    panel("vienna:E6b", "end of road for motor vehicles",
          _barred(lambda p, c, g: (draw.car(p, c["black"]), draw.windows_of_car(p, g))[0]))  # fmt: skip
    panel("vienna:E7", "built-up area", _town, w, k, k, 1.6, 0.9)
    other("vienna:E12a", "pedestrian crossing", "square", (b, w, k), _crossing_panel)
    panel("vienna:E14a", "parking", _words("P", box=(-0.5, -0.85, 0.55, 0.85), weight=0.22), inner=0.85)
    panel("vienna:E15", "bus stop", _with_ground(draw.bus))
    panel("vienna:E17a", "living street", _living_street, aspect=1.4, inner=0.95)
    panel("vienna:E13", "hospital", _words("H", box=(-0.6, -0.8, 0.6, 0.8), weight=0.2))
    panel("vienna:G13", "dead end", _dead_end)

    other("mutcd:R1-2", "yield", "triangle down", (w, r), partial(_give_way, "YIELD"), TRIANGLE)
    for value in range(15, 85, 5):
        other(f"mutcd:R2-1-{value}", f"speed limit {value} mph", "rectangle", (w, k), partial(_speed_limit, value), 0.8)
    other(
        "mutcd:R3-1",
        "no right turn",
        "square",
        (w, r, k),
        partial(_us_prohibition, _ink(draw.turn_left, True, sharp=True)),
    )
    other("mutcd:R3-2", "no left turn", "square", (w, r, k), partial(_us_prohibition, _ink(draw.turn_left, sharp=True)))
    other("mutcd:R3-4", "no U-turn", "square", (w, r, k), partial(_us_prohibition, _ink(draw.u_turn)))
    panel("mutcd:R4-1", "do not pass", _words("DO", "NOT", "PASS", box=(-0.7, -0.85, 0.7, 0.85)), w, k, k, 0.8, 0.9)
    other("mutcd:R4-7", "keep right", "rectangle", (w, k), partial(_keep, True), 0.8)
    other("mutcd:R4-8", "keep left", "rectangle", (w, k), partial(_keep, False), 0.8)
    other("mutcd:R5-1", "do not enter", "square", (r, w), partial(_no_entry, True))
    other("mutcd:R5-1a", "wrong way", "rectangle", (r, w), _wrong_way, 1.5)
    for side, right in (("left", False), ("right", True)):
        other(f"mutcd:R6-1-{side}", f"one way to the {side}", "rectangle", (k, w), partial(_one_way, right), 3.0)
    other("mutcd:R8-3", "no parking", "square", (w, r, k),
          partial(_us_prohibition, _words("P", box=(-0.55, -0.9, 0.6, 0.9), weight=0.22)))  # fmt: skip
    other("mutcd:R15-1", "railroad crossing, cross", "cross", (w, k), partial(_crossbuck, True))
    for side, mirror in (("left", False), ("right", True)):
        s = -1 if mirror else 1
        caution(f"W1-1-{side}", f"sharp turn to the {side}", _ink(draw.turn_left, mirror, sharp=True))
        caution(f"W1-2-{side}", f"curve to the {side}", _ink(draw.turn_left, mirror))
        caution(f"W1-3-{side}", f"reverse turn, the first to the {side}", _ink(draw.double_bend, mirror, sharp=True))
        caution(f"W1-4-{side}", f"reverse curve, the first to the {side}", _ink(draw.double_bend, mirror))
        other(f"mutcd:W1-6-{side}", f"arrow to the {side}", "rectangle", (y, k), partial(_large_arrow, mirror), 2.0)
        other(f"mutcd:W1-8-{side}", f"chevron to the {side}", "rectangle", (y, k), partial(_chevron, mirror), 0.8)
        caution(f"W2-2-{side}", f"side road on the {side}",
                _lines(((0.0, 0.95), (0.0, -0.95)), ((0.0, 0.0), (-0.8 * s, 0.0)), width=0.3))  # fmt: skip
    caution("W2-1", "crossroads", _lines(up, ((-0.95, 0.0), (0.95, 0.0)), width=0.3))
    caution("W2-4", "T intersection", _lines(((0.0, 0.95), (0.0, -0.45)), ((-0.85, -0.45), (0.85, -0.45)), width=0.3))
    caution("W2-6", "circular intersection", _ink(draw.roundabout))
    caution("W3-1", "stop ahead", _stop_ahead)
    caution("W3-2", "yield ahead", _yield_ahead)
    caution("W3-3", "signal ahead", _signal(True))
    caution("W4-1", "merge", _merge)
    caution("W6-3", "two-way traffic", _ink(draw.two_ways))
    caution("W7-1", "hill", _slope)
    caution("W8-5", "slippery", _ink(draw.slippery))
    other("mutcd:W10-1", "railroad ahead", "round", (y, k), _rail)
    caution("W11-1", "bicycles", _vehicle(draw.bicycle))
    caution("W11-2", "pedestrians", _vehicle(draw.figure))
    caution("W11-3", "deer", _vehicle(draw.deer))
    caution("W14-1", "dead end", _words("DEAD", "END"))
    caution("W14-2", "no outlet", _words("NO", "OUTLET"))
    caution("W20-1", "road work ahead", _words("ROAD", "WORK", "AHEAD", box=(-0.95, -0.95, 0.95, 0.95)), "orange")
    caution("W21-1", "workers", _vehicle(draw.worker), "orange")
    other("mutcd:S1-1", "school", "pentagon", (y, k), _school)
    return out


FACES: Final = tuple(_faces())
"""The list."""
