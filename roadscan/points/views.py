"""Pictures as they look at points: which of them shows a point best, and where in it."""

from __future__ import annotations

import functools
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np
import numpy.typing as npt

from roadscan.kernels.surface.picture_colours import HEIGHT, WIDTH, sample, take_better
from roadscan.model.camera import Interior

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]
UInt8 = npt.NDArray[np.uint8]

__all__ = ["HEIGHT", "NO_VIEW", "WIDTH", "Lens", "PictureRule", "Shown", "Views", "best_views", "sampled", "seen_in"]

NO_VIEW: Final = -1


@dataclass(frozen=True)
class PictureRule:
    """Which pictures may give a point its colour."""

    cameras: tuple[str, ...]
    """Names in the rig; all of them where empty."""
    reach_m: float
    """Farthest distance from camera to point."""
    least_angle_deg: float
    """Least angle between the ray and the horizon at the camera, downwards."""
    border_px: int
    """Pixels along the picture's border that give none; at least 1."""

    def limits(self) -> Float64:
        """As the kernel takes them."""
        return np.array([self.reach_m**2, np.sin(np.radians(self.least_angle_deg)), float(self.border_px)])


@dataclass(frozen=True)
class Lens:
    """Interior orientation of a camera, and what its pictures show of its own vehicle."""

    parameters: Float64
    """(12,) as the kernel takes them."""
    own_vehicle_px: tuple[tuple[tuple[float, float], ...], ...] = ()
    """Polygons of pixels (u, v) that show the own vehicle."""

    @classmethod
    def of(cls, interior: Interior, own_vehicle_px: tuple[tuple[tuple[float, float], ...], ...] = ()) -> Self:
        """From the rig's values."""
        k1, k2, p1, p2, k3 = interior.distortion
        size = float(interior.width_px), float(interior.height_px)
        lens = [*interior.focal_px, *interior.principal_px, k1, k2, p1, p2, k3, _fold(k1, k2, k3), *size]
        return cls(np.array(lens), own_vehicle_px)

    @functools.cached_property
    def hidden(self) -> Bool:
        """(height, width) pixels that show the own vehicle; (0, 0) where none does. Drawn where it is needed."""
        if not self.own_vehicle_px:
            return np.zeros((0, 0), np.bool_)
        drawn = np.zeros((round(self.parameters[HEIGHT]), round(self.parameters[WIDTH])), np.uint8)
        for polygon in self.own_vehicle_px:
            cv2.fillPoly(drawn, [np.rint(polygon).astype(np.int32)], 1)
        return drawn.astype(np.bool_)


def _fold(k1: float, k2: float, k3: float) -> float:
    """Square of the tangent at which the distorted radius stops to grow: beyond it the model shows things twice."""
    roots = np.polynomial.Polynomial([1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3]).trim().roots()
    real = roots[np.abs(roots.imag) < 1e-9].real
    return float(min(real[real > 0.0], default=np.inf))


@dataclass(frozen=True)
class Views:
    """Where n pictures were taken from and how, in the order in which equals are preferred."""

    eye_world_m: Float64
    """(n, 3) projection centres."""
    opencv_from_world: Float64
    """(n, 3, 3) camera axes (x right, y down, z ahead) from world."""
    up_world: Float64
    """(n, 3) upwards at the camera."""
    world: Int64
    """(n,) number of the world frame that these are in."""
    lens: Int64
    """(n,) number of the lens."""
    lenses: tuple[Lens, ...]

    def __len__(self) -> int:
        """Pictures."""
        return len(self.lens)

    def picked(self, index: Int64) -> Views:
        """Some of them."""
        return Views(
            self.eye_world_m[index], self.opencv_from_world[index], self.up_world[index], self.world[index],
            self.lens[index], self.lenses,
        )  # fmt: skip


@dataclass(frozen=True)
class Shown:
    """Which picture gives each of m points its colour, and where."""

    view: npt.NDArray[np.int32]
    """(m,) number of the picture; NO_VIEW where none shows the point."""
    pixel: Float64
    """(m, 2) u, v from the centre of the upper left pixel."""


def best_views(
    point_world_m: Sequence[Float64], views: Views, rule: PictureRule, without: Collection[int] = ()
) -> Shown:
    """The picture with the finest resolution (distance over focal length) of those that may show a point.

    Parameters
    ----------
    point_world_m : (m, 3) the points in each of the world frames that the views count.
    without : numbers of pictures that cannot be read.
    """
    count, limits = len(point_world_m[0]) if point_world_m else 0, rule.limits()
    best, chosen = np.full(count, np.inf), np.full(count, NO_VIEW, np.int32)
    pixel = np.full((count, 2), np.nan)
    for number in range(len(views)):
        if number in without:
            continue
        lens = views.lenses[views.lens[number]]
        take_better(
            point_world_m[views.world[number]], views.eye_world_m[number], views.opencv_from_world[number],
            views.up_world[number], lens.parameters, limits, lens.hidden, number, best, chosen, pixel,
        )  # fmt: skip
    return Shown(chosen, pixel)


@dataclass(frozen=True)
class Seen:
    """A picture that may show a place."""

    view: int
    """Number of the picture."""
    pixel: tuple[float, float]
    """u, v from the centre of the upper left pixel."""
    distance_m: float
    resolution_m: float
    """What a pixel spans there, across the ray (m)."""


def seen_in(point_world_m: Sequence[Float64], views: Views, rule: PictureRule) -> list[Seen]:
    """The pictures that may show one place, that with the finest resolution first.

    Whether something stands between is not looked at.

    Parameters
    ----------
    point_world_m : (3,) the place in each of the world frames that the views count.
    """
    found: list[Seen] = []
    for number in range(len(views)):
        place = point_world_m[views.world[number]].reshape(1, 3)
        alone = views.picked(np.array([number]))
        shown = best_views([place] * len(point_world_m), alone, rule)
        if shown.view[0] == NO_VIEW:
            continue
        distance = float(np.linalg.norm(place[0] - views.eye_world_m[number]))
        focal_px = float(np.sqrt(np.prod(views.lenses[views.lens[number]].parameters[:2])))
        u, v = shown.pixel[0].tolist()
        found.append(Seen(number, (u, v), distance, distance / focal_px))
    return sorted(found, key=lambda one: (one.resolution_m, one.view))


def sampled(picture: UInt8, pixel: Float64) -> UInt8:
    """Colours (m, 3) at places (m, 2: u, v) of a picture (height, width, 3), bilinear."""
    colour = np.empty((len(pixel), 3), np.uint8)
    sample(picture, np.ascontiguousarray(pixel), colour)
    return colour
