"""Plates as cameras see them: listed faces and plates of no listed type, tilted, blurred, in any light, as cut-outs.

The boxes of cut-outs are as wrong as those of the pipeline: shifted and scaled by some per cent.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from benchmarks import sign_pen as draw
from benchmarks.sign_faces import FACES, TRIANGLE, Face, Style, drawn, style_of
from benchmarks.sign_pen import Pen, circle, shape_points
from roadscan.assets.pictures.reader import CutOut

UInt8 = npt.NDArray[np.uint8]
Float64 = npt.NDArray[np.float64]
Drawing = tuple[UInt8, UInt8]
Rng = np.random.Generator

SIZES_PX: Final = (12.0, 16.0, 24.0, 40.0, 64.0, 100.0)
"""Edges of the classes of sizes: the shorter side of a plate in a picture (pixels)."""
_SUPER: Final = 2  # pixels are rendered at twice their number
_LETTERS: Final = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
_GREY: Final = 0.15  # share of grey pictures


def face_drawing(face: Face, rng: Rng) -> Drawing:
    """A listed face in a style by chance."""
    return face.drawn(style_of(rng))


def _random_words(rng: Rng, low: int = 2, high: int = 9) -> str:
    return "".join(rng.choice(list(_LETTERS)) for _ in range(int(rng.integers(low, high))))


def _blob(pen: Pen, ink: Any, rng: Rng) -> None:
    """A pictogram by chance: polygons, strokes, discs."""
    for _ in range(int(rng.integers(1, 5))):
        kind = rng.integers(0, 4)
        if kind == 0:
            angle = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 8))))
            pen.poly(
                rng.normal(0, 0.25, 2) + np.column_stack([np.cos(angle), np.sin(angle)]) * rng.uniform(0.2, 0.8), ink
            )
        elif kind == 1:
            pen.line(rng.uniform(-0.9, 0.9, (int(rng.integers(2, 5)), 2)), rng.uniform(0.1, 0.3), ink)
        elif kind == 2:
            pen.disc(*rng.normal(0, 0.35, 2).tolist(), rng.uniform(0.1, 0.5), ink)
        else:
            pen.line(circle(*rng.normal(0, 0.2, 2).tolist(), rng.uniform(0.3, 0.7), *rng.uniform(0, 360, 2).tolist()),
                     rng.uniform(0.1, 0.25), ink)  # fmt: skip


def _unlisted_pictogram(pen: Pen, ink: Any, rng: Rng) -> None:
    """A pictogram that the list lacks: by chance, of letters, or a listed one turned by a quarter or upside down."""
    kind = rng.integers(0, 4)
    if kind == 0:
        pen.text(_random_words(rng, 1, 4), (-0.8, -0.6, 0.8, 0.6), ink, rng.uniform(0.14, 0.24))
    elif kind == 1:
        value = rng.choice(
            ["5", "7", "8", "15", "25", "35", "45", "10", "140", "3.5T", "2.8", "7.5", "12T", "55", "6", "3.8M"]
        )
        pen.text(str(value), (-0.85, -0.55, 0.85, 0.55), ink, 0.2)
    else:
        _blob(pen, ink, rng)


def _signlike(rng: Rng) -> Drawing:
    """A ground of a listed kind with a pictogram that is not listed."""
    style = style_of(rng)
    c = style.palette
    shape = str(
        rng.choice(["triangle", "round", "round", "diamond", "rectangle", "octagon", "triangle down", "pentagon"])
    )
    aspect = TRIANGLE if shape.startswith("triangle") else float(rng.uniform(0.6, 1.9)) if shape == "rectangle" else 1.0
    names = list(c)
    typical = {"triangle": ("red", "white"), "round": ("red", "white"), "diamond": ("black", "yellow"),
               "rectangle": ("white", "blue"), "octagon": ("white", "red"), "triangle down": ("red", "white"),
               "pentagon": ("black", "yellow")}[shape]  # fmt: skip
    if shape == "round" and rng.random() < 0.45:
        typical = ("white", "blue")
    rim, ground = typical if rng.random() < 0.75 else tuple(rng.choice(names, 2).tolist())
    ink = c["black" if ground in ("white", "yellow", "orange") else "white"]

    def paint(pen: Pen, colours: Any, own: Style) -> None:
        pen.picture[:] = c[rim]
        pen.poly(shape_points(shape, aspect, 0.16 * style.rim if rim == "red" else 0.06), c[ground])
        low = {"triangle": 0.24, "triangle down": -0.24}.get(shape, 0.0)
        if shape in ("round", "triangle down") or rng.random() < 0.92:  # without one, these are listed
            _unlisted_pictogram(pen.at(0, low, 0.41 if shape.startswith("tri") else 0.6), ink, rng)
        if shape == "round" and rim == "red" and rng.random() < 0.3:
            pen.line([(-0.6, -0.6), (0.6, 0.6)], 0.13, c["red"])

    return drawn(shape, aspect, paint, style)


def _board(rng: Rng) -> Drawing:
    """A board with lines of text, and arrows at times: directions, supplements, adverts, names of streets."""
    style = style_of(rng)
    c, aspect = style.palette, float(np.exp(rng.uniform(np.log(0.6), np.log(4.0))))
    ground = str(rng.choice(["white", "blue", "green", "yellow", "brown", "white", "orange", "red", "black"]))
    ink = c["black" if ground in ("white", "yellow", "orange") else "white"]

    def paint(pen: Pen, colours: Any, own: Style) -> None:
        pen.picture[:] = c[ground]
        if rng.random() < 0.6:
            pen.line(shape_points("rectangle", aspect, 0.07), 0.05, ink, True)
        lines = int(rng.integers(1, 4))
        for k in range(lines):
            y = -0.85 + 1.7 * k / lines
            x0 = -0.85 * aspect * rng.uniform(0.6, 1.0)
            words = _random_words(rng) if rng.random() < 0.7 else str(rng.integers(1, 999))
            pen.text(words, (x0, y + 0.08, min(0.85 * aspect, x0 + 0.35 * len(words)), y + 1.5 / lines), ink, 0.16)
        if rng.random() < 0.25:
            a, t = rng.uniform(0, 2 * np.pi), np.array([0.5 * aspect, 0.0])
            way = np.array([np.cos(a), np.sin(a)]) * 0.5
            pen.arrow(np.array([t - way, t + way]), 0.2, ink)

    return drawn("rectangle", aspect, paint, style)


def _plain(rng: Rng) -> Drawing:
    """A plain plate, with a rim at times."""
    style = style_of(rng)
    names = list(style.palette)
    shape = str(rng.choice(["rectangle", "round", "triangle", "diamond", "octagon", "rectangle"]))
    ground, rim = (style.palette[str(n)] for n in rng.choice(names, 2, replace=False))
    if shape == "round" and tuple(style.palette["white"]) == tuple(ground):
        shape = "rectangle"  # a white disc with a red rim is listed
    if shape == "diamond":
        rim = ground
    aspect = TRIANGLE if shape == "triangle" else float(rng.uniform(0.5, 2.5)) if shape == "rectangle" else 1.0

    def paint(pen: Pen, colours: Any, own: Style) -> None:
        pen.picture[:] = rim if rng.random() < 0.6 else ground
        pen.poly(shape_points(shape, aspect, rng.uniform(0.05, 0.2)), ground)

    return drawn(shape, aspect, paint, style)


def _back(rng: Rng) -> Drawing:
    """The back of a plate: grey, with post and clamps."""
    style = style_of(rng)
    shape = str(rng.choice(["rectangle", "round", "triangle", "octagon", "diamond", "triangle down"]))
    aspect = TRIANGLE if shape.startswith("triangle") else 1.0
    level = int(rng.integers(70, 190))

    def paint(pen: Pen, colours: Any, own: Style) -> None:
        pen.picture[:] = (level, level, level + 3)
        for y in rng.uniform(-0.7, 0.7, int(rng.integers(0, 3))):
            pen.bar(-0.4, y, 0.4, y + 0.12, (level - 30,) * 3)
        if rng.random() < 0.7:
            w = rng.uniform(0.05, 0.13)
            pen.bar(-w, -0.8, w, 1.0, (int(np.clip(level + rng.integers(-50, 50), 0, 255)),) * 3)

    return drawn(shape, aspect, paint, style)


def _altered(rng: Rng) -> Drawing:
    """A listed face upside down or in other colours, which only pictures with colours tell."""
    coloured = [one for one in FACES if {"red", "blue", "yellow", "orange"} & set(one.colours)]
    face = coloured[int(rng.integers(len(coloured)))]
    picture, outline = face_drawing(face, rng)
    if rng.random() < 0.5 and face.shape in ("triangle", "octagon", "pentagon") and "C2" not in face.code:
        return picture[::-1, ::-1].copy(), outline[::-1, ::-1].copy()
    order = [[2, 0, 1], [1, 2, 0]][int(rng.integers(2))]
    return picture[:, :, order].copy(), outline


def _scenery(rng: Rng) -> Drawing:
    """No plate: windows, rears of cars, leaves, walls."""
    h, w = 144, int(144 * rng.uniform(0.5, 2.5))
    picture = background(rng, h, w)
    pen = Pen(picture)
    kind = rng.integers(0, 3)
    if kind == 0:
        frame = int(rng.integers(60, 250))
        pane = rng.integers(10, 120, 3)
        pen.picture[:] = frame
        nx, ny = int(rng.integers(1, 4)), int(rng.integers(1, 4))
        a = w / h
        for i in range(nx):
            for k in range(ny):
                x0, y0 = -a * 0.9 + i * 1.8 * a / nx, -0.9 + k * 1.8 / ny
                pen.bar(x0, y0, x0 + 1.8 * a / nx - 0.1, y0 + 1.8 / ny - 0.1, pane + rng.integers(-8, 40))
    elif kind == 1:
        draw.car(pen.at(0, 0, rng.uniform(0.8, 1.3)), rng.integers(0, 255, 3).tolist())
        pen.bar(-0.3, 0.2, 0.3, 0.36, (230, 230, 225))
    return picture, np.full((h, w), 255, np.uint8)


def _symbols(rng: Rng) -> Drawing:
    """Signs of sets that the list lacks: a service on blue, a zone, a detour, a chevron board. Held out."""
    style = style_of(rng)
    c = style.palette
    kind = int(rng.integers(0, 6))
    shape, aspect = ("rectangle", 1.0) if kind in (0, 1, 3) else ("rectangle", 3.0) if kind == 2 else ("round", 1.0)
    if kind == 5:
        shape, aspect = "triangle", TRIANGLE

    def paint(pen: Pen, colours: Any, own: Style) -> None:
        if kind == 0:  # a service: a pump, a cup, a cross, a bed on white in blue
            pen.picture[:] = c["blue"]
            pen.bar(-0.62, -0.62, 0.62, 0.62, c["white"])
            which = rng.integers(0, 3)
            if which == 0:
                pen.bar(-0.12, -0.5, 0.12, 0.5, c["red"])
                pen.bar(-0.5, -0.12, 0.5, 0.12, c["red"])
            elif which == 1:
                pen.bar(-0.35, -0.45, 0.1, 0.5, c["black"])
                pen.line([(0.1, 0.2), (0.35, 0.2), (0.35, -0.3), (0.2, -0.45)], 0.08, c["black"])
            else:
                pen.line([(-0.45, 0.4), (-0.45, -0.3)], 0.1, c["black"])
                pen.bar(-0.45, 0.0, 0.45, 0.2, c["black"])
        elif kind == 1:  # a zone: a prohibition on a white board with words below
            pen.picture[:] = c["white"]
            pen.line(circle(0, -0.25, 0.55), 0.16, c["red"], True)
            pen.text(str(rng.choice(["20", "30", "10"])), (-0.3, -0.45, 0.3, -0.05), c["black"], 0.2)
            pen.text("ZONE", (-0.55, 0.5, 0.55, 0.85), c["black"], 0.18)
        elif kind == 2:  # a board of chevrons
            pen.picture[:] = c["white"]
            s = 1 if rng.random() < 0.5 else -1
            for x in (-2.2, -1.0, 0.2, 1.4):
                chevron = [(x, -0.9), (x + 0.5, -0.9), (x + 1.1, 0), (x + 0.5, 0.9), (x, 0.9), (x + 0.6, 0)]
                pen.at(0, 0, 1.0, s < 0).poly(chevron, c["red"])
        elif kind == 3:  # a cross in a circle, a wheelchair
            pen.picture[:] = c["white"] if rng.random() < 0.5 else c["green"]
            pen.line(circle(-0.1, 0.3, 0.4, -60, 200), 0.12, c["blue"])
            pen.line([(-0.2, -0.6), (-0.15, 0.1), (0.3, 0.1), (0.5, 0.6)], 0.16, c["blue"])
            pen.disc(-0.2, -0.75, 0.15, c["blue"])
        elif kind == 4:  # limits of weight, width, height; a horn, a motorcycle
            pen.picture[:] = c["red"]
            pen.disc(0, 0, 0.8, c["white"])
            if rng.random() < 0.5:
                pen.text(str(rng.choice(["2.1M", "9.5T", "4.0M", "18T"])), (-0.6, -0.25, 0.6, 0.25), c["black"], 0.2)
                for s in (-1, 1):
                    pen.poly([(-0.2, 0.75 * s), (0.2, 0.75 * s), (0.0, 0.45 * s)], c["black"])
            else:
                pen.poly([(-0.6, -0.1), (-0.2, -0.1), (0.5, -0.4), (0.5, 0.4), (-0.2, 0.1), (-0.6, 0.1)], c["black"])
        else:  # an aircraft, a wind bag, a car that falls into water
            pen.picture[:] = c["red"]
            pen.poly(shape_points("triangle", TRIANGLE, 0.2), c["white"])
            p = pen.at(0, 0.24, 0.42)
            if rng.random() < 0.5:
                p.line([(-0.8, 0.5), (0.8, -0.5)], 0.16, c["black"])
                p.poly([(0.1, -0.1), (-0.6, -0.6), (-0.4, -0.65), (0.5, -0.3)], c["black"])
                p.poly([(0.1, -0.1), (0.3, 0.7), (0.45, 0.6), (0.4, -0.25)], c["black"])
            else:
                draw.car_from_side(p.at(0.1, -0.2, 0.7), c["black"])
                for y in (0.5, 0.8):
                    p.line([(-0.9, y), (-0.5, y - 0.12), (-0.1, y), (0.3, y - 0.12), (0.8, y)], 0.12, c["black"])

    return drawn(shape, aspect, paint, style)


def _mixed(rng: Rng) -> Drawing:
    """A pictogram of the list on a ground that never bears it, or two of them on any."""
    style = style_of(rng)
    c = style.palette
    shape, rim, ground, strange = (
        ("triangle", "red", "white", (draw.truck, draw.car, draw.car_from_side)),
        ("round", "red", "white", (draw.cow, draw.deer, draw.train, draw.gate, draw.walkers, draw.worker)),
        ("round", "white", "blue", (draw.car, draw.truck, draw.cow, draw.deer, draw.train, draw.car_from_side)),
        ("diamond", "black", "yellow", (draw.truck, draw.cow, draw.train, draw.car_from_side, draw.gate, draw.walkers)),
        ("rectangle", "white", "blue", (draw.truck, draw.cow, draw.train, draw.bicycle, draw.deer, draw.gate)),
    )[int(rng.integers(5))]
    every = (draw.truck, draw.cow, draw.train, draw.bicycle, draw.deer, draw.gate, draw.figure, draw.car_from_side)
    aspect = TRIANGLE if shape == "triangle" else 1.0
    ink = c["white" if ground == "blue" else "black"]

    def paint(pen: Pen, colours: Any, own: Style) -> None:
        pen.picture[:] = c[rim]
        pen.poly(shape_points(shape, aspect, 0.2 * style.rim if rim == "red" else 0.06), c[ground])
        inner = pen.at(0, 0.24 if shape == "triangle" else 0.0, (0.41 if shape == "triangle" else 0.62) * style.scale)
        if rng.random() < 0.55:
            strange[int(rng.integers(len(strange)))](inner.at(0, 0, 1.0, bool(rng.random() < 0.5)), ink)
        else:
            first, second = rng.choice(len(every), 2, replace=False).tolist()
            way = np.array([0.0, 0.45]) if rng.random() < 0.5 else np.array([0.45, 0.0])
            every[first](inner.at(*(-way).tolist(), 0.5, bool(rng.random() < 0.5)), ink)
            every[second](inner.at(*way.tolist(), 0.5), ink)
        for y in (0.75, 0.95) if rng.random() < 0.2 else ():
            inner.line([(-0.9, y), (-0.5, y - 0.12), (-0.1, y), (0.3, y - 0.12), (0.8, y)], 0.12, ink)

    return drawn(shape, aspect, paint, style)


UNLISTED: Final[dict[str, Callable[[Rng], Drawing]]] = {
    "signlike": _signlike, "board": _board, "plain": _plain, "back": _back, "altered": _altered, "scenery": _scenery,
}  # fmt: skip
"""Families of plates of no listed type that the fit sees."""
HELD_OUT: Final[dict[str, Callable[[Rng], Drawing]]] = {"symbols": _symbols}
"""Families that only the threshold and the figures see."""
MORE: Final[dict[str, Callable[[Rng], Drawing]]] = {"mixed": _mixed}
"""Families that only the fit sees."""


def background(rng: Rng, h: int, w: int) -> UInt8:
    """What is behind a plate (h, w, 3): sky, leaves, walls, by chance."""
    kind = rng.integers(0, 4)
    base = np.array([[150, 180, 220], [60, 80, 40], [150, 140, 125], [70, 70, 72]])[kind] * rng.uniform(0.4, 1.3)
    grain = max(2, int(rng.integers(2, 14)))
    coarse = rng.normal(0, [6, 35, 20, 25][kind], (h // grain + 2, w // grain + 2, 1)) + rng.normal(0, 6, 3) + base
    out = cv2.resize(coarse.astype(np.float32), (w, h), interpolation=cv2.INTER_LINEAR)
    if rng.random() < 0.3:  # an edge: roof before sky, a wall's end
        a, b = rng.normal(0, 1, 2)
        yy, xx = np.mgrid[:h, :w]
        out[(a * (xx - w / 2) + b * (yy - h / 2)) > rng.normal(0, w / 4)] += rng.normal(0, 60)
    return np.clip(out, 0, 255).astype(np.uint8)


def seen(drawing: Drawing, size_px: float, rng: Rng, light: Rng | None = None) -> CutOut:
    """A drawing as a camera sees it, `size_px` for the shorter side of its box.

    light : where given, what several pictures of one plate share: dirt, cast, shadow.
    """
    shared = rng if light is None else light
    picture, outline = _worn(drawing, shared)
    h0, w0 = picture.shape[:2]
    height = size_px * max(1.0, h0 / w0) * _SUPER
    width = height * w0 / h0
    scale = height / h0
    small = cv2.resize(picture, None, fx=max(scale, 8 / w0), fy=max(scale, 8 / h0), interpolation=cv2.INTER_AREA)
    mask = cv2.resize(outline, (small.shape[1], small.shape[0]), interpolation=cv2.INTER_AREA)
    corners = _corners(width, height, rng)
    margin = np.maximum(0.28 * np.ptp(corners, axis=0), 7.0 * _SUPER)
    corners += margin - corners.min(axis=0)
    w, h = (int(np.ceil(v / _SUPER)) * _SUPER for v in corners.max(axis=0) + margin)
    sh, sw = small.shape[:2]
    box = np.array([[0, sh], [sw, sh], [sw, 0], [0, 0]], np.float32) - np.float32(0.5)
    turn = cv2.getPerspectiveTransform(box, (corners - 0.5).astype(np.float32))
    flat = cv2.warpPerspective(small, turn, (w, h), borderMode=cv2.BORDER_REPLICATE).astype(np.float32)
    share = cv2.warpPerspective(mask, turn, (w, h)).astype(np.float32)[:, :, None] / 255.0
    scene = background(rng, h, w).astype(np.float32)
    if rng.random() < 0.6:
        post = int(corners[:, 0].mean() + rng.normal(0, 1))
        half = max(1, int(0.04 * width))
        scene[int(corners[:, 1].mean()) :, max(post - half, 0) : post + half] = rng.uniform(60, 190)
    both = scene * (1 - share) + flat * share
    if rng.random() < 0.12:
        _cover(both, corners, rng)
    pixels = _exposed(both, rng, shared)
    return CutOut(pixels, _boxed(corners / _SUPER - 0.5, rng), 0.01, bool((np.ptp(pixels, axis=2) == 0).all()))


def _worn(drawing: Drawing, rng: Rng) -> Drawing:
    """A plate with dirt, stickers or a shadow on it."""
    picture, outline = drawing[0].astype(np.float32), drawing[1]
    h, w = outline.shape
    if rng.random() < 0.25:
        spots = cv2.resize(rng.random((6, 6), np.float32), (w, h), interpolation=cv2.INTER_CUBIC)
        share = (np.clip((spots - rng.uniform(0.5, 0.8)) * 3, 0, 1) * rng.uniform(0.2, 0.7))[:, :, None]
        picture = picture * (1 - share) + np.array([90, 80, 65]) * rng.uniform(0.6, 1.4) * share
    if rng.random() < 0.3:
        a, b = rng.normal(0, 1, 2)
        yy, xx = np.mgrid[:h, :w]
        side = a * (xx - w / 2) + b * (yy - h / 2)
        if rng.random() < 0.5:  # leaves
            side = cv2.resize(rng.normal(0, 1, (5, 5)).astype(np.float32), (w, h), interpolation=cv2.INTER_CUBIC) * 30
        picture[side > rng.normal(0, 0.2 * w)] *= rng.uniform(0.35, 0.75)
    if rng.random() < 0.05:
        x, y, s = rng.integers(0, w), rng.integers(0, h), int(rng.integers(5, 22))
        picture[max(y - s, 0) : y + s, max(x - s, 0) : x + s] = rng.uniform(0, 255, 3)
    return np.clip(picture, 0, 255).astype(np.uint8), outline


def _corners(width: float, height: float, rng: Rng) -> Float64:
    """Corners (4, 2: lower left, lower right, upper right, upper left) of a turned box in a picture (pixels)."""
    yaw, tilt, roll = np.deg2rad([rng.normal(0, 22), rng.normal(0, 6), rng.normal(0, 3)])
    yaw = np.clip(yaw, -1.0, 1.0)
    flat = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * [width / 2, height / 2]
    flat = flat @ np.array([[np.cos(roll), np.sin(roll)], [-np.sin(roll), np.cos(roll)]])
    x, y, z = flat[:, 0] * np.cos(yaw), flat[:, 1] * np.cos(tilt), flat[:, 0] * np.sin(yaw) + flat[:, 1] * np.sin(tilt)
    away = rng.uniform(8.0, 40.0) * height
    return np.column_stack([x, y]) * (away / (away + z))[:, None]


def _boxed(corners: Float64, rng: Rng) -> Float64:
    """Corners as the pipeline would have them: shifted, scaled, sheared."""
    middle, size = corners.mean(axis=0), np.ptp(corners, axis=0)
    scale = 1.0 + rng.normal(0, 0.05, 2)
    return np.asarray(middle + (corners - middle) * scale + rng.normal(0, 0.035, 2) * size + rng.normal(0, 0.35, 2)
                      + rng.normal(0, 0.01, (4, 2)) * size)  # fmt: skip


def _cover(picture: npt.NDArray[np.float32], corners: Float64, rng: Rng) -> None:
    """A branch or a post before a part of the plate."""
    low, size = corners.min(axis=0), np.ptp(corners, axis=0)
    colour = np.array([[50, 70, 30], [90, 90, 92]][int(rng.integers(2))]) * rng.uniform(0.5, 1.3)
    if rng.random() < 0.5:
        x = int(low[0] + rng.uniform(0, 1) * size[0])
        picture[:, x : x + max(1, int(0.08 * size[0]))] = colour
        return
    for _ in range(int(rng.integers(3, 9))):
        side = rng.choice([0.05, 0.95])
        aside = np.array([side * size[0] + rng.normal(0, 0.1) * size[0], rng.uniform(0, 1) * size[1]])
        at = (low + aside).astype(int).tolist()
        cv2.circle(
            picture, at, max(1, int(rng.uniform(0.03, 0.1) * size[0])), (colour + rng.normal(0, 15, 3)).tolist(), -1
        )


def _exposed(picture: npt.NDArray[np.float32], rng: Rng, light: Rng) -> UInt8:
    """Light, lens, sensor and JPEG."""
    cast = 1.0 + light.normal(0, 0.07, 3)
    gain, gamma, haze = np.exp(rng.normal(-0.15, 0.35)), np.exp(rng.normal(0, 0.2)), max(0.0, light.normal(0, 0.12))
    levels = 255.0 * np.power(np.arange(256) / 255.0, gamma)[:, None] * cast * gain
    levels = np.minimum(levels * (1 - haze) + 170.0 * haze, 300.0).astype(np.float32)
    out = cv2.LUT(np.clip(picture, 0, 255).astype(np.uint8), levels[None])
    blur = abs(rng.normal(0, 0.55)) * _SUPER
    if blur > 0.3:
        out = cv2.GaussianBlur(out, (0, 0), blur)
    if rng.random() < 0.2:
        length = int(rng.integers(2, 6))
        out = cv2.blur(out, (length, 1) if rng.random() < 0.8 else (1, length))
    out = cv2.resize(out, None, fx=1 / _SUPER, fy=1 / _SUPER, interpolation=cv2.INTER_AREA)
    noise = np.float32(abs(rng.normal(0, 4)))
    if rng.random() < _GREY:
        out[:] = (out @ np.array([0.3, 0.59, 0.11], np.float32))[:, :, None]
        out += noise * rng.standard_normal(out.shape[:2], np.float32)[:, :, None]
    else:
        out += noise * rng.standard_normal(out.shape, np.float32)
    pixels = np.clip(np.rint(out), 0, 255).astype(np.uint8)
    if rng.random() < 0.6:
        _, coded = cv2.imencode(".jpg", pixels[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(45, 96))])
        pixels = cv2.imdecode(coded, cv2.IMREAD_COLOR)[:, :, ::-1].copy()
    return pixels


def size_by_chance(rng: Rng) -> float:
    """A size (pixels), its logarithm even."""
    return float(np.exp(rng.uniform(np.log(SIZES_PX[0]), np.log(SIZES_PX[-1]))))
