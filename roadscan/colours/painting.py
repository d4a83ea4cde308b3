"""Colours of places from many pictures, which are read one by one: the best of each place are kept."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
import numpy.typing as npt

from roadscan.colours.kernels.looks import (
    Camera,
    Depths,
    Limits,
    blend,
    keep_best,
    leave_doubtful,
    leave_moved,
    look,
    weighted_medians,
)
from roadscan.compute.array_types import Float32, Float64, Int64, UInt8
from roadscan.pictures.colours import ColourSource
from roadscan.pictures.placed import Pictures

_STEP_M: Final = 20.0
"""Distance (m) over which the turn from the map to the world is taken. The map is straight to 1 mm within 50 m: 0.02
pixels."""


def eyes_m(pictures: Pictures) -> Float64:
    """Returns easting, northing and height (n, 3) of the cameras (m)."""
    out = np.empty((len(pictures), 3))
    for number, world in enumerate(pictures.worlds):
        own = pictures.views.world == number
        if own.any():
            out[own] = pictures.map.map_from_world(world, pictures.views.eye_world_m[own])
    return out


def cameras_of(pictures: Pictures, origin_m: Float64) -> list[Camera]:
    """Returns the pictures as kernels take them; their places count from `origin_m` (3,) in the map."""
    if not len(pictures):
        return []
    views, eyes = pictures.views, eyes_m(pictures)
    return [
        Camera(eyes[n] - origin_m, _axes(pictures, n, eyes[n]), views.lens_of(n).parameters)
        for n in range(len(pictures))
    ]


def _axes(pictures: Pictures, number: int, eye_m: Float64) -> Float64:
    """Returns camera axes (3, 3) from the map: the camera's from the world's, and the world's from the map's there."""
    around = np.concatenate([eye_m + _STEP_M * np.eye(3), eye_m - _STEP_M * np.eye(3)])
    world = pictures.map.world_from_map(pictures.worlds[pictures.views.world[number]], around)
    turn = ((world[:3] - world[3:]) / (2.0 * _STEP_M)).T
    return np.ascontiguousarray(pictures.views.opencv_from_world[number] @ turn)


_RAMP: Final = 0.05
"""Share of a picture's shorter edge in which weights rise from the border."""


@dataclass(frozen=True, eq=False)
class Places:
    """Places of the map that want a colour, of one piece of it."""

    point_m: npt.NDArray[np.floating]
    """(n, 3) from the origin of all pieces."""
    normal: Float32
    """(n, 3) unit normals, NaN where unknown."""
    epoch_gps_ns: Int64
    """(n,) when they were seen; empty for places that are always there."""


@dataclass(frozen=True, eq=False)
class Looks:
    """The best looks at n places: k each."""

    colour: UInt8
    """(n, k, 3) balanced."""
    weight: Float32
    """(n, k), 0: none."""
    state: UInt8
    """(n, k) as kernels have it."""
    number: npt.NDArray[np.int32]
    """(n, k) number of the picture."""
    votes: UInt8
    """(n, 2) how many pictures saw through the place, and how many of another time show it."""

    @classmethod
    def none(cls, count: int, most: int) -> Self:
        """Returns looks at so many places before any picture was seen."""
        return cls(
            np.zeros((count, most, 3), np.uint8), np.zeros((count, most), np.float32),
            np.zeros((count, most), np.uint8), np.full((count, most), -1, np.int32), np.zeros((count, 2), np.uint8),
        )  # fmt: skip

    def medians(self) -> tuple[UInt8, UInt8]:
        """Returns weighted medians (n, 3), 0 without a look, and the number of looks (n,)."""
        colour, count = np.zeros((len(self.weight), 3), np.uint8), np.zeros(len(self.weight), np.uint8)
        weighted_medians(self.colour, self.weight, colour, count)
        return colour, count

    def sure_medians(self) -> tuple[UInt8, UInt8]:
        """Returns the same without looks at what had moved, and without colours that one look alone tells, at an edge
        of colours in its picture. It is called once.
        """
        leave_moved(self.weight, self.state, self.votes)
        colour, count = self.medians()
        leave_doubtful(self.colour, self.weight, self.state, colour, count)
        return colour, count


@dataclass(frozen=True)
class PaintRule:
    """Which looks count."""

    reach_m: float
    border_px: int
    least_angle_deg: float
    """Least angle between a ray and a surface whose normal is known."""
    moment_ns: int
    window_ns: int
    """Pictures so near in time to a place tell whether what was seen there moved."""
    most: int
    """Looks that are kept of a place."""


@dataclass(frozen=True, eq=False)
class Palette:
    """Pictures with all that their colours need."""

    pictures: Pictures
    number: Int64
    """(n,) number of each in the survey."""
    gain: Float64
    """(n, 3)."""
    weight: Float64
    """(n,)."""
    depths: Callable[[], Iterator[Depths]]
    """Yields what each of them shows, in their order."""


def paint(palette: Palette, pieces: Sequence[Places], origin_m: Float64, rule: PaintRule) -> list[Looks]:
    """Returns the best looks at the places of each piece. Each picture is read once, and one after the other."""
    found = [Looks.none(len(one.point_m), rule.most) for one in pieces]
    boxes = [_Box.of(one.point_m) for one in pieces]
    source, pictures = ColourSource(palette.pictures), palette.pictures
    cameras = cameras_of(pictures, origin_m)
    for n, (camera, depths) in enumerate(zip(cameras, palette.depths(), strict=True)):
        near = [k for k, box in enumerate(boxes) if box.away_m(camera) <= rule.reach_m]
        picture = source.picture(pictures, n) if near else None
        if picture is None:
            continue
        lens = pictures.views.lens_of(n)
        limits = Limits(
            rule.reach_m, float(rule.border_px), _RAMP * min(picture.shape[:2]),
            float(np.sin(np.radians(rule.least_angle_deg))), rule.moment_ns, float(palette.weight[n]),
            rule.window_ns,
        )  # fmt: skip
        for k in near:
            one, held = pieces[k], found[k]
            colour, weight = np.empty((len(one.point_m), 3), np.float32), np.empty(len(one.point_m), np.float32)
            state = np.empty(len(one.point_m), np.uint8)
            look(
                one.point_m, one.epoch_gps_ns, one.normal, camera, int(pictures.epochs_gps_ns[n]), depths, limits,
                lens.hidden, picture, colour, weight, state,
            )  # fmt: skip
            keep_best(
                colour, weight, state, palette.gain[n], int(palette.number[n]), held.colour, held.weight, held.state,
                held.number, held.votes,
            )  # fmt: skip
    return found


@dataclass(frozen=True, eq=False)
class _Box:
    """The box of some points."""

    low: Float64
    high: Float64

    @classmethod
    def of(cls, point_m: npt.NDArray[np.floating]) -> Self:
        if not len(point_m):
            return cls(np.full(3, np.inf), np.full(3, -np.inf))
        return cls(point_m.min(axis=0).astype(np.float64), point_m.max(axis=0).astype(np.float64))

    def away_m(self, camera: Camera) -> float:
        """Returns the distance from a camera to the box; 0 within."""
        out = np.maximum(np.maximum(self.low - camera.eye_m, camera.eye_m - self.high), 0.0)
        return float(np.sqrt((out**2).sum()))


def blended(looks: Looks) -> tuple[UInt8, npt.NDArray[np.int32]]:
    """Returns colours (n, 3), from 1, 0 without a look, and the number of the picture (n,) of most weight, −1: none.

    Where three pictures or more see a place, those that differ from the median of all are left out: something moved
    there. Of the others the best has most weight, and weights are smooth over the ground, so that seams are blended.
    """
    colour, number = np.zeros((len(looks.weight), 3), np.uint8), np.full(len(looks.weight), -1, np.int32)
    median, count = looks.medians()
    blend(looks.colour, looks.weight, looks.number, median, count, colour, number)
    return colour, number
