"""Colours in pictures: shares of red, green and blue for each object, and the faces of signs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float32, Float64, Int32, Int64
from roadscan.core.errors import ConfigError
from roadscan.core.extras import cv2
from roadscan.simulate.caster import SLOT_NS, Hits, World
from roadscan.simulate.kernels import albedo as kernels
from roadscan.simulate.kernels import things as body
from roadscan.simulate.kernels.rays import Movers
from roadscan.simulate.noise import stream
from roadscan.simulate.scene.camera import Albedo
from roadscan.simulate.scene.roadside import Sign
from roadscan.simulate.things import described_signs

SKY: Final = np.array([0.86, 0.95, 1.06], np.float32)  # shares of red, green and blue
SIGN_COLOURS: Final = {
    "white": (1.0, 1.0, 1.0), "red": (0.78, 0.08, 0.11), "blue": (0.06, 0.24, 0.66), "yellow": (0.98, 0.78, 0.08),
    "green": (0.04, 0.46, 0.24), "brown": (0.42, 0.24, 0.12), "orange": (0.96, 0.46, 0.06), "black": (0.07, 0.07, 0.07),
}  # fmt: skip
_LIGHT: Final = ("white", "yellow", "orange")
_PAINT: Final = {
    "white": (1.0, 1.0, 1.0),
    "yellow": (1.0, 0.76, 0.20),
    "green": (0.10, 0.58, 0.36),
}  # shares of red, green and blue
_PAINT_FROM: Final = 150.0
"""Least shade of paint on the road."""
_KINDS: Final = {
    "tree": (0.55, 0.85, 0.42), "facade": (1.0, 0.93, 0.80), "fence": (0.95, 0.82, 0.66), "box": (0.95, 0.95, 1.0),
    "planting": (0.50, 0.86, 0.40), "signal": (0.85, 0.88, 0.85), "overhead": (1.0, 0.98, 0.95),
}  # fmt: skip
_CARS: Final = ((1.0, 1.0, 1.0), (0.95, 0.45, 0.40), (0.50, 0.62, 0.95), (0.85, 0.86, 0.90), (0.55, 0.60, 0.58))  # RGB
_ASPHALT: Final = (1.0, 0.99, 0.97)  # shares of red, green and blue
_GRASS: Final = ((0.76, 1.0, 0.50), (1.0, 0.96, 0.66))  # fresh and dry: shares of red, green and blue
_DRY_M: Final = (1.7, 0.6)
"""Wavelengths of what is dry in a lawn (m)."""
_DRY_FROM: Final = 1.1
"""Sum of the waves from which grass is rather dry than fresh: an eighth of a lawn."""
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
        grass = world.scene.road.grass
        self._grass_m = np.inf if grass is None else world.scene.road.paved_m + grass.from_m

    def of(self, hits: Hits) -> Float32:
        """Return shares (n, 3) for the n rays of the first group; those of the sky for rays without a hit."""
        number, place = hits.object_id[0], hits.enh_m[0]
        out = np.where((number >= 0)[:, None], self._of_object[np.maximum(number, 0)], SKY)
        for face_number, face in self._faces.items():
            rows = np.flatnonzero(number == face_number)
            if rows.size:
                out[rows] = _on_face(face, place[rows] - self._world.surface.origin_enh_m, hits.intensity[0][rows])
        if np.isfinite(self._grass_m):
            rows = np.flatnonzero(number == 0)
            _, offset = self._world.surface.station_offset_m(place[rows, 0], place[rows, 1])
            rows = rows[np.abs(offset) > self._grass_m]
            out[rows] = _grass(place[rows])
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


def _grass(place_m: Float64) -> Float64:
    """Return shares (n, 3) of a lawn at places (n, 3): fresh, and dry in patches."""
    dry = np.zeros(len(place_m))
    for number, wave in enumerate(_DRY_M):
        turn = 0.7 + 1.9 * number
        along = place_m[:, 0] * np.cos(turn) + place_m[:, 1] * np.sin(turn)
        across = place_m[:, 1] * np.cos(turn) - place_m[:, 0] * np.sin(turn)
        dry += np.sin(2 * np.pi * along / wave) * np.cos(2 * np.pi * across / (1.3 * wave))
    share = np.clip(0.5 + 2.0 * (dry - _DRY_FROM), 0.0, 1.0)[:, None]
    fresh, brown = np.array(_GRASS)
    return np.asarray(fresh + share * (brown - fresh))


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


_LEAVES: Final = frozenset({"tree", "planting", "hedge"})  # kinds of objects with leaves
_ROUGH: Final = frozenset({"facade", "wall", "fence", "gate", "box", "steps", "planter", "balcony", "shelter"})
"""Kinds of objects that are rough; all others are smooth, but for leaves."""
_BRICKS: Final = frozenset({"facade", "wall"})  # kinds of objects that may be of bricks
_PAINT_SHARE: Final = 0.4  # contrast of paint as a share of that of the pavement under it
_DARKEST: Final = 0.15
"""Least factor of brightness."""


@dataclass(frozen=True)
class Seen:
    """What n pixels see."""

    place_m: Float64
    """(n, 3) easting, northing, height from the scene's origin; NaN: nothing."""
    across_m: Float64
    """(n, 3) from there to what the next pixel of the row sees."""
    down_m: Float64
    """(n, 3) from there to what the next pixel of the column sees."""
    object_id: Int32
    """(n,)"""
    body: Int32
    """(n,) see :class:`roadscan.simulate.caster.Hits`."""
    shade: Float32
    """(n,) intensity."""
    epoch_gps_ns: Int64
    """(n,) when each was seen."""
    movers: Movers
    """What moved."""
    slots_from_gps_ns: int
    """Epoch of the movers' first slot."""


class Albedos:
    """Random brightness of all surfaces of a world."""

    def __init__(self, world: World) -> None:
        self._world = world
        scene = world.scene
        self._paved, self._verge, self._beside = scene.albedo.road, scene.albedo.verge, scene.albedo.beside
        self._seed = np.uint64(stream(scene.seed, 0, "albedo").integers(0, 2**62))
        known = [*world.objects, *world.moving]
        count = 1 + max([o.id for o in known], default=0)
        self._contrast = np.zeros(count, np.float32)
        self._bricks = np.zeros(count, np.bool_)
        if self._beside is not None:
            for one in known:
                self._contrast[one.id] = self._contrast_of(one.kind.removeprefix("moving_"))
                self._bricks[one.id] = one.kind in _BRICKS and self._beside.bricks > 0.0
        shades = scene.road.brightness
        grass = () if scene.road.grass is None else (scene.road.grass.shade,)
        self._paint = np.float32(shades.marking)
        self._verges = np.array([shades.verge, shades.kerb, *grass], np.float32)

    @property
    def on(self) -> bool:
        """Whether any surface has a random brightness."""
        return any(one is not None for one in (self._paved, self._verge, self._beside))

    def factors(self, seen: Seen) -> Float32:
        """Return factors (n,) of the brightness of what pixels see; 1 on the mean."""
        change = np.zeros(len(seen.shade), np.float32)
        ground = seen.object_id == 0
        is_verge = ground & np.isin(seen.shade, self._verges)
        painted = np.where(seen.shade >= self._paint, np.float32(_PAINT_SHARE), np.float32(1.0))
        for settings, rows in ((self._paved, ground & ~is_verge), (self._verge, is_verge)):
            if settings is not None:
                contrast = np.float32(settings.contrast) * painted
                self._add(settings, np.flatnonzero(rows), contrast, seen, change)
        if self._beside is not None:
            rows = np.flatnonzero((seen.object_id > 0) & np.isfinite(seen.place_m[:, 0]))
            contrast = self._contrast[np.maximum(seen.object_id, 0)]
            self._add(self._beside, rows, contrast, seen, change)
            if self._beside.bricks > 0.0:
                self._lay_bricks(rows[self._bricks[seen.object_id[rows]]], seen, change)
        return np.asarray(np.maximum(np.float32(1.0) + change, np.float32(_DARKEST)))

    def _contrast_of(self, kind: str) -> float:
        """Return the contrast of a kind of objects."""
        if self._beside is None:
            return 0.0
        if kind in _LEAVES:
            return self._beside.leaves
        return self._beside.contrast if kind in _ROUGH else self._beside.smooth

    def _add(self, settings: Albedo, rows: Int64, contrast: Float32, seen: Seen, change: Float32) -> None:
        """Add the noise of one material to rows of the change (n,)."""
        if not rows.size:
            return
        place, across, down = (np.ascontiguousarray(a[rows]) for a in (seen.place_m, seen.across_m, seen.down_m))
        self._onto_movers(rows, seen, place)
        out = np.zeros(rows.size, np.float32)
        kernels.add_noise(place, across, down, contrast[rows], octaves_of(settings, self._seed), out)
        change[rows] += out

    def _onto_movers(self, rows: Int64, seen: Seen, place_m: Float64) -> None:
        """Replace places (n, 3) on moving bodies by places that move with them: ahead, right and up of the body."""
        still = len(self._world.arrays.bodies)
        moving = np.flatnonzero(seen.body[rows] >= still)
        if not moving.size:
            return
        past_s = (seen.epoch_gps_ns[rows[moving]] - seen.slots_from_gps_ns) * 1e-9
        slot = np.clip((past_s / (SLOT_NS * 1e-9)).astype(np.int64), 0, len(seen.movers.bodies) - 1)
        number = seen.body[rows[moving]] - still
        bodies, velocity = seen.movers.bodies[slot, number], seen.movers.velocity[slot, number]
        moved = velocity * (past_s - slot * SLOT_NS * 1e-9)[:, None]
        x = place_m[moving, 0] - bodies[:, body.EASTING] - moved[:, 0]
        y = place_m[moving, 1] - bodies[:, body.NORTHING] - moved[:, 1]
        sine, cosine = bodies[:, body.SINE], bodies[:, body.COSINE]
        up = place_m[moving, 2] - bodies[:, body.LOW] - moved[:, 2]
        # each body has its own piece of the noise
        place_m[moving] = np.stack([x * sine + y * cosine, x * cosine - y * sine + 8.0 * number, up], axis=-1)

    def _lay_bricks(self, rows: Int64, seen: Seen, change: Float32) -> None:
        """Add bricks to rows of the change (n,) that see standing walls."""
        if self._beside is None or not rows.size:
            return
        bodies = self._world.arrays.bodies[seen.body[rows]]
        sine, cosine = bodies[:, body.SINE], bodies[:, body.COSINE]

        def on_wall(vectors: Float64) -> Float64:
            along = vectors[:, 0] * sine + vectors[:, 1] * cosine
            return np.ascontiguousarray(np.stack([along, vectors[:, 2]], axis=-1))

        past = seen.place_m[rows] - np.stack(
            [bodies[:, body.EASTING], bodies[:, body.NORTHING], np.zeros(rows.size)], axis=-1
        )
        wall = on_wall(past)
        wall[:, 0] += bodies[:, body.HALF_LENGTH] + bodies[:, body.ALONG]
        out = np.zeros(rows.size, np.float32)
        across, down = on_wall(seen.across_m[rows]), on_wall(seen.down_m[rows])
        kernels.add_bricks(wall, across, down, self._beside.bricks, self._seed, out)
        change[rows] += out


def octaves_of(settings: Albedo, seed: np.uint64) -> kernels.Octaves:
    """Return the octaves of a material, the finest first."""
    count = 1 + int(np.floor(np.log2(settings.coarsest_m / settings.finest_m) + 1e-9))
    share = settings.growth ** np.arange(count, dtype=np.float64)
    return kernels.Octaves(
        settings.finest_m * 2.0 ** np.arange(count, dtype=np.float64), share / float(np.linalg.norm(share)), seed
    )
