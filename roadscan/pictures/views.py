"""Views of pictures: which picture shows a point best, and where in it."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Bool, Float64, Int64, UInt8
from roadscan.pictures.kernels.lens import (
    AROUND,
    HEIGHT,
    WIDTH,
    sample,
    take_better,
)
from roadscan.pictures.lens import Lens

__all__ = ["AROUND", "HEIGHT", "NO_VIEW", "WIDTH", "Lens", "PictureRule", "Shown", "Sights", "Views",
           "best_views", "sampled", "sights"]  # fmt: skip

NO_VIEW: Final = -1  # Number that stands for no picture.
_LEAST_TURNED: Final = float(np.sin(np.radians(10.0)))
"""Least cosine between the ray and the direction in which a front faces."""


@dataclass(frozen=True)
class PictureRule:
    """Rule for the pictures that may give a point its colour."""

    cameras: tuple[str, ...]
    """Names in the rig; empty: all of them."""
    reach_m: float
    """Farthest distance from camera to point."""
    least_angle_deg: float
    """Least angle between the ray and the horizon at the camera, downwards."""
    border_px: int
    """Width (pixels) of the picture's border that is not used; at least 1."""

    def limits(self) -> Float64:
        """Returns the limits as the kernel takes them."""
        return np.array([self.reach_m**2, np.sin(np.radians(self.least_angle_deg)), float(self.border_px)])


@dataclass(frozen=True)
class Views:
    """Poses of n pictures, in the order in which equals are preferred."""

    eye_world_m: Float64
    """(n, 3) projection centres."""
    opencv_from_world: Float64
    """(n, 3, 3) camera axes (x right, y down, z ahead) from world."""
    up_world: Float64
    """(n, 3) upwards at the camera."""
    world: Int64
    """(n,) number of the world frame."""
    lens: Int64
    """(n,) number of the lens."""
    lenses: tuple[Lens, ...]
    row_motion: Float64 = field(default_factory=lambda: np.zeros((0, 6)))
    """(n, 6) way (m) and turn (rad) of the camera from row to row, along its axes; (0, 6) where no shutter rolls. Poses
    are those of the middle row."""

    def __len__(self) -> int:
        """Returns the number of pictures."""
        return len(self.lens)

    def lens_of(self, number: int) -> Lens:
        """Returns the lens of a picture, with the motion of the camera during it."""
        lens = self.lenses[int(self.lens[number])]
        return lens.moving(self.row_motion[number]) if len(self.row_motion) and self.row_motion[number].any() else lens

    def picked(self, index: Int64) -> Views:
        """Returns a subset."""
        return Views(
            self.eye_world_m[index], self.opencv_from_world[index], self.up_world[index], self.world[index],
            self.lens[index], self.lenses, self.row_motion[index] if len(self.row_motion) else self.row_motion,
        )  # fmt: skip


@dataclass(frozen=True)
class Shown:
    """The picture that gives each of m points its colour, and the position in it."""

    view: npt.NDArray[np.int32]
    """(m,) number of the picture; NO_VIEW where none shows the point."""
    pixel: Float64
    """(m, 2) u, v from the centre of the upper left pixel."""


def best_views(
    point_world_m: Sequence[Float64], views: Views, rule: PictureRule, without: Collection[int] = ()
) -> Shown:
    """Returns the picture with the finest resolution (distance over focal length) of those that may show a point.

    Parameters
    ----------
    point_world_m : (m, 3) the points in each of the world frames to which the views refer.
    without : numbers of pictures that cannot be read.
    """
    count, limits = len(point_world_m[0]) if point_world_m else 0, rule.limits()
    best, chosen = np.full(count, np.inf), np.full(count, NO_VIEW, np.int32)
    pixel = np.full((count, 2), np.nan)
    for number in range(len(views)):
        if number in without:
            continue
        lens = views.lens_of(number)
        take_better(
            point_world_m[views.world[number]], views.eye_world_m[number], views.opencv_from_world[number],
            views.up_world[number], lens.parameters, limits, lens.hidden, number, best, chosen, pixel,
        )  # fmt: skip
    return Shown(chosen, pixel)


@dataclass(frozen=True, eq=False)
class Sights:
    """Pictures that may show objects: n pairs, object by object, the one with the finest resolution first."""

    item: Int64
    """(n,) number of the object."""
    view: Int64
    """(n,) number of the picture."""
    pixel: Float64
    """(n, 2) u, v of the object's first place, from the centre of the upper left pixel."""
    distance_m: Float64
    """(n,) from the camera to that place."""
    resolution_m: Float64
    """(n,) size of a pixel there, across the ray (m)."""

    def __len__(self) -> int:
        """Returns the number of pairs."""
        return len(self.item)

    def at(self, rows: Int64 | Bool) -> Sights:
        """Returns a subset."""
        return Sights(
            self.item[rows], self.view[rows], self.pixel[rows], self.distance_m[rows], self.resolution_m[rows]
        )


def sights(
    places_world_m: Sequence[Float64],
    facing_world: Sequence[Float64],
    views: Views,
    rule: PictureRule,
    near: Iterable[tuple[int, Int64]],
) -> Sights:
    """Returns the pictures that show objects, each object's best first.

    A picture shows an object where all its places lie in it, within the rule's reach, and where its front is turned
    to the camera by 10 degrees or more. Best is what spans the least of the object with a pixel: distance over focal
    length, over the cosine of the angle between ray and front; of equals the earlier picture. Occlusion by other
    objects is not checked.

    Parameters
    ----------
    places_world_m : (m, k, 3) places of the objects in each of the world frames that the views count.
    facing_world : (m, 3) unit vectors in which their fronts face, likewise; NaN where an object has no front.
    near : pictures, and the objects that each may show.
    """
    found: list[tuple[Int64, Int64, Float64, Float64, Float64, Float64]] = []
    limits = rule.limits()
    for number, items in near:
        if not items.size:
            continue
        world, lens = int(views.world[number]), views.lens_of(number)
        places = places_world_m[world][items]
        count = places.shape[0] * places.shape[1]
        best, chosen, pixel = np.full(count, np.inf), np.full(count, NO_VIEW, np.int32), np.full((count, 2), np.nan)
        take_better(
            np.ascontiguousarray(places.reshape(-1, 3)), views.eye_world_m[number], views.opencv_from_world[number],
            views.up_world[number], lens.parameters, limits, lens.hidden, 0, best, chosen, pixel,
        )  # fmt: skip
        ray = views.eye_world_m[number] - places[:, 0]
        distance = np.sqrt(np.einsum("ij,ij->i", ray, ray))
        turned = np.einsum("ij,ij->i", ray, facing_world[world][items]) / np.maximum(distance, 1e-9)
        turned = np.where(np.isnan(turned), 1.0, turned)
        kept = (chosen.reshape(places.shape[:2]) != NO_VIEW).all(axis=1) & (turned >= _LEAST_TURNED)
        resolution = distance[kept] / float(np.sqrt(np.prod(lens.parameters[:2])))
        first = pixel.reshape(*places.shape[:2], 2)[kept, 0]
        view = np.full(len(first), number, np.int64)
        found.append((items[kept], view, first, distance[kept], resolution, resolution / turned[kept]))
    if not found:
        none, empty = np.zeros(0, np.int64), np.zeros(0)
        return Sights(none, none, np.zeros((0, 2)), empty, empty)
    item, view, first, distance, resolution, span = (np.concatenate(c) for c in zip(*found, strict=True))
    return Sights(item, view, first, distance, resolution).at(np.lexsort((view, span, item)))


def sampled(picture: UInt8, pixel: Float64) -> UInt8:
    """Returns colours (m, 3) at positions (m, 2: u, v) of a picture (height, width, 3), bilinear."""
    colour = np.empty((len(pixel), 3), np.uint8)
    sample(picture, np.ascontiguousarray(pixel), colour)
    return colour
