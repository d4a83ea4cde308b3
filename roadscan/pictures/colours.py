"""Colours of points of the ground from pictures, which are read one by one and cached in bounded memory."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Collection
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, UInt8
from roadscan.pictures.exposures import read_picture
from roadscan.pictures.placed import Pictures
from roadscan.pictures.views import NO_VIEW, Shown, best_views, sampled
from roadscan.store.codecs.image_files import ImageError

_KEPT_BYTES: Final = 160 << 20
"""Decoded pictures cached for the following tiles (bytes); one is cached whatever its size."""
_POINTS_AT_ONCE: Final = 1 << 18  # Points coloured at a time.


@dataclass(frozen=True)
class PointColours:
    """Colours of m points."""

    colour: UInt8
    """(m, 3) red, green, blue as the pictures have them (sRGB); 0 where no picture shows a point."""
    seen: npt.NDArray[np.bool_]
    """(m,)."""
    pictures: int
    """Number of pictures that gave a colour."""
    unreadable: tuple[str, ...]
    """Pictures that would have given a colour but cannot be read: name and reason."""


class ColourSource:
    """A source of colours for points; a colour depends only on the point and on the survey's pictures."""

    def __init__(self, pictures: Pictures) -> None:
        self._kept: OrderedDict[str, UInt8] = OrderedDict()
        self._unreadable: dict[str, str] = {}

    def colours(self, pictures: Pictures, enh_m: Float64) -> PointColours:
        """Colours of points (m, 3: easting, northing, height), from those pictures that may show one of them."""
        colour, seen = np.zeros((len(enh_m), 3), np.uint8), np.zeros(len(enh_m), np.bool_)
        unreadable: dict[int, str] = {}
        used, left = set[int](), np.arange(len(enh_m))
        while left.size:
            shown = _shown(pictures, enh_m[left], unreadable)
            again = []
            for number in np.unique(shown.view[shown.view != NO_VIEW]).tolist():
                own = np.flatnonzero(shown.view == number)
                picture = self.picture(pictures, number)
                if picture is None:
                    unreadable[number] = self._unreadable[pictures.name(number)]
                    again.append(left[own])
                    continue
                colour[left[own]], seen[left[own]] = sampled(picture, shown.pixel[own]), True
                used.add(number)
            left = np.concatenate(again) if again else left[:0]
        told = tuple(f"{pictures.name(n)}: {reason}" for n, reason in sorted(unreadable.items()))
        return PointColours(colour, seen, len(used), told)

    def reason(self, pictures: Pictures, number: int) -> str:
        """Returns why a picture could not be read; empty where it could, or was not read."""
        return self._unreadable.get(pictures.name(number), "")

    def picture(self, pictures: Pictures, number: int) -> UInt8 | None:
        """Returns a picture (height, width, 3), red first; None where it cannot be read."""
        name = pictures.name(number)
        if name in self._unreadable:
            return None
        picture = self._kept.pop(name, None)
        if picture is None:
            try:
                picture = read_picture(pictures.path(number), pictures.views.lens_of(number).size_px)
            except (ImageError, OSError) as error:
                self._unreadable[name] = str(error)
                return None
        self._kept[name] = picture
        while len(self._kept) > 1 and sum(p.nbytes for p in self._kept.values()) > _KEPT_BYTES:
            self._kept.popitem(last=False)
        return picture


def _shown(pictures: Pictures, enh_m: Float64, without: Collection[int]) -> Shown:
    """Returns the picture that shows each point best, and where."""
    parts = []
    for start in range(0, len(enh_m), _POINTS_AT_ONCE):
        part = enh_m[start : start + _POINTS_AT_ONCE]
        worlds = [world_places(pictures, world, part) for world in pictures.worlds]
        parts.append(best_views(worlds, pictures.views, pictures.rule, without))
    return Shown(np.concatenate([p.view for p in parts]), np.concatenate([p.pixel for p in parts]))


def world_places(pictures: Pictures, world: str, enh_m: Float64) -> Float64:
    """Returns points (m, 3) of the map in a world frame."""
    if len(enh_m) == 1:  # NumPy multiplies a single row in another order than several
        return world_places(pictures, world, np.repeat(enh_m, 2, axis=0))[:1]
    return np.ascontiguousarray(pictures.map.world_from_map(world, enh_m))
