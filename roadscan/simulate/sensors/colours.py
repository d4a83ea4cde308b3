"""Colours in pictures: shares of red, green and blue for each object, and the faces of signs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float32, Float64
from roadscan.core.errors import ConfigError
from roadscan.core.extras import cv2
from roadscan.simulate.caster import Hits, World
from roadscan.simulate.kernels import things as body
from roadscan.simulate.scene.roadside import Sign
from roadscan.simulate.things import described_signs

SKY: Final = np.array([0.86, 0.95, 1.06], np.float32)  # shares of red, green and blue
SIGN_COLOURS: Final = {
    "white": (1.0, 1.0, 1.0), "red": (0.78, 0.08, 0.11), "blue": (0.06, 0.24, 0.66), "yellow": (0.98, 0.78, 0.08),
    "green": (0.04, 0.46, 0.24), "brown": (0.42, 0.24, 0.12), "orange": (0.96, 0.46, 0.06), "black": (0.07, 0.07, 0.07),
}  # fmt: skip
_LIGHT: Final = ("white", "yellow", "orange")
_PAINT: Final = {"white": (1.0, 1.0, 1.0), "yellow": (1.0, 0.76, 0.20)}  # shares of red, green and blue
_PAINT_FROM: Final = 150.0
"""Least shade of paint on the road."""
_KINDS: Final = {
    "tree": (0.55, 0.85, 0.42), "facade": (1.0, 0.93, 0.80), "fence": (0.95, 0.82, 0.66), "box": (0.95, 0.95, 1.0),
    "planting": (0.50, 0.86, 0.40), "signal": (0.85, 0.88, 0.85), "overhead": (1.0, 0.98, 0.95),
}  # fmt: skip
_CARS: Final = ((1.0, 1.0, 1.0), (0.95, 0.45, 0.40), (0.50, 0.62, 0.95), (0.85, 0.86, 0.90), (0.55, 0.60, 0.58))  # RGB
_ASPHALT: Final = (1.0, 0.99, 0.97)  # shares of red, green and blue
_FACE_PX: Final = 256  # pixels of a face's edge
_ON_FACE_M: Final = 0.01  # margin around a face or a marking
_SHADE_WITHIN: Final = 1.0  # largest difference from a face's shade
_RIM: Final = 0.13
"""Width of a rim as a share of the plate."""


@dataclass(frozen=True, eq=False)
class _Face:
    """A sign's face."""

    middle_m: Float64
    """Easting, northing, height, from the map's origin."""
    right: Float64
    """(2,) unit vector to the right as seen from the front."""
    half_m: tuple[float, float]
    shade: float
    """Shade that distinguishes the face from back and post."""
    tint: Float32
    """(256, 256, 3), the upper row first."""


class Tints:
    """Shares of red, green and blue of all objects in a world."""

    def __init__(self, world: World) -> None:
        self._world = world
        count = 1 + max([o.id for o in [*world.objects, *world.moving]], default=0)
        self._of_object = np.ones((count, 3), np.float32)
        self._of_object[0] = _ASPHALT
        for one in [*world.objects, *world.moving]:
            if one.kind in {"parked_car", "moving_car"}:
                self._of_object[one.id] = _CARS[one.id % len(_CARS)]
            else:
                self._of_object[one.id] = _KINDS.get(one.kind, (1.0, 1.0, 1.0))
        self._faces = {
            number: _face(sign, world.objects[number - 1].bodies[0]) for number, sign in described_signs(world.scene)
        }
        self._stripes = [m for m in world.scene.road.markings if m.colour != "white"]

    def of(self, hits: Hits) -> Float32:
        """Return shares (n, 3) for the n rays of the first group; those of the sky for rays without a hit."""
        number, place = hits.object_id[0], hits.enh_m[0]
        out = np.where((number >= 0)[:, None], self._of_object[np.maximum(number, 0)], SKY)
        for face_number, face in self._faces.items():
            rows = np.flatnonzero(number == face_number)
            if rows.size:
                out[rows] = _on_face(face, place[rows] - self._world.surface.origin_enh_m, hits.intensity[0][rows])
        if self._stripes:
            rows = np.flatnonzero((number == 0) & (np.nan_to_num(hits.intensity[0]) >= _PAINT_FROM))
            if rows.size:
                out[rows] = self._on_road(place[rows], out[rows])
        return out.astype(np.float32)

    def _on_road(self, place_m: Float64, tint: Float32) -> Float32:
        """Apply shares to painted places (n, 3)."""
        station, offset = self._world.surface.station_offset_m(place_m[:, 0], place_m[:, 1])
        for one in self._stripes:
            near = np.abs(offset - one.offset_m) <= one.width_m / 2 + _ON_FACE_M
            tint[near & (station >= one.start_m) & (station <= one.end_m)] = _PAINT[one.colour]
        return tint


def _face(sign: Sign, plate: Float64) -> _Face:
    """Return the face of a sign whose plate is the body (18,)."""
    middle = np.array([plate[body.EASTING], plate[body.NORTHING], (plate[body.LOW] + plate[body.HIGH]) / 2])
    along = np.array([plate[body.SINE], plate[body.COSINE]])
    right = along if sign.faces == "backward" else -along
    half = float(plate[body.HALF_LENGTH]), float(plate[body.HIGH] - plate[body.LOW]) / 2
    return _Face(middle, right, half, sign.shade, _painted(sign))


def _on_face(face: _Face, place_m: Float64, shade: Float64) -> Float32:
    """Return shares (n, 3) at places of a sign with shades (n,): of its face on the front, 1 elsewhere."""
    past = place_m - face.middle_m
    along = past[:, :2] @ face.right
    u = (along / face.half_m[0] + 1.0) / 2 * _FACE_PX - 0.5
    v = (1.0 - past[:, 2] / face.half_m[1]) / 2 * _FACE_PX - 0.5
    inside = (np.abs(along) <= face.half_m[0] + _ON_FACE_M) & (np.abs(past[:, 2]) <= face.half_m[1] + _ON_FACE_M)
    shown = cv2.remap(
        face.tint, u[None].astype(np.float32), v[None].astype(np.float32), cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )[0]  # fmt: skip
    is_face = inside & (np.abs(shade - face.shade) < _SHADE_WITHIN)
    return np.where(is_face[:, None], shown, np.float32(1.0))


def _painted(sign: Sign) -> Float32:
    """Return a face (256, 256, 3): its picture, or its colour, its rim, its text."""
    if sign.face:
        shown = cv2.imread(sign.face, cv2.IMREAD_COLOR)
        if shown is None:
            raise ConfigError(f"the face {sign.face} of a sign cannot be read", expected="a picture", file=sign.face)
        shown = cv2.resize(shown[:, :, ::-1], (_FACE_PX, _FACE_PX), interpolation=cv2.INTER_AREA)
        return np.asarray(shown, np.float32) / np.float32(255.0)
    face = np.empty((_FACE_PX, _FACE_PX, 3), np.uint8)
    face[:] = _eight_bits(sign.colour)
    if sign.rim is not None:
        inner = np.zeros((_FACE_PX, _FACE_PX), np.uint8)
        cv2.fillPoly(inner, [np.rint(_outline(sign.shape, 1.0 - 2.0 * _RIM)).astype(np.int32)], 1)
        face[inner == 0] = _eight_bits(sign.rim)
    if sign.text:
        _write(face, sign.text, _eight_bits("black" if sign.colour in _LIGHT else "white"))
    return np.asarray(face, np.float32) / np.float32(255.0)


def _eight_bits(colour: str) -> tuple[int, int, int]:
    red, green, blue = (round(255 * share) for share in SIGN_COLOURS[colour])
    return red, green, blue


def _outline(shape: str, scale: float) -> Float64:
    """Return pixels (k, 2) of the outline of a shape on a face, scaled about its middle."""
    if shape == "triangle":
        middle, unit = np.array([0.5, 2.0 / 3.0]), np.array([[0.0, 1.0], [1.0, 1.0], [0.5, 0.0]])
    else:
        middle = np.array([0.5, 0.5])
        count, first = {"round": (64, 0.0), "octagon": (8, 22.5), "diamond": (4, 0.0)}.get(shape, (4, 45.0))
        angle = np.deg2rad(first + 360.0 / count * np.arange(count))
        reach = {"octagon": 0.5 / np.cos(np.pi / 8), "rectangle": np.sqrt(0.5)}.get(shape, 0.5)
        unit = 0.5 + reach * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray((middle + scale * (unit - middle)) * _FACE_PX)


def _write(face: npt.NDArray[np.uint8], text: str, ink: tuple[int, int, int]) -> None:
    """Draw text in the middle of a face, as large as fits into 80 % of its width."""
    font, thick = cv2.FONT_HERSHEY_DUPLEX, 6
    (width, height), _ = cv2.getTextSize(text, font, 1.0, thick)
    scale = min(0.72 * _FACE_PX / width, 0.4 * _FACE_PX / height)
    (width, height), _ = cv2.getTextSize(text, font, scale, thick)
    at = ((_FACE_PX - width) // 2, (_FACE_PX + height) // 2)
    cv2.putText(face, text, at, font, scale, ink, thick, cv2.LINE_AA)
