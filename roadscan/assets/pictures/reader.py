"""The contract of a reader of an asset's pictures, and the registry that finds readers.

A reader is a subclass of :class:`PictureReader` in a file of `roadscan/assets/pictures/readers/` (or an entry point of
the group ``roadscan.asset_picture_readers``) that has the name of a kind of assets. A
kind without one still gets the pictures that show it best.
"""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np

from roadscan.assets.kind import AssetObject, reference_point
from roadscan.compute.array_types import Float64, UInt8
from roadscan.core.plugins import found_kinds

ENTRY_POINT_GROUP: Final = "roadscan.asset_picture_readers"
_EYE_LEVEL_M: Final = 2.0  # The sight of a tall object is no higher than this above its foot (m).


@dataclass(frozen=True, eq=False)
class Sight:
    """What a picture must show of an object. Coordinates are easting, northing and height of the map (m)."""

    places_m: Float64
    """(k, 3) places that must all lie in the picture; the pixel of the first is reported."""
    facing: Float64 | None = None
    """(3,) unit vector in which its front faces: pictures of its back do not show it; None where it has no front."""


@dataclass(frozen=True, eq=False)
class CutOut:
    """The part of a picture around an object."""

    pixels: UInt8
    """(h, w, 3) red, green, blue."""
    outline_px: Float64
    """(k, 2) the outline in it: u to the right, v downwards, from the centre of the upper left pixel."""
    resolution_m: float
    """Size of a pixel at the object (m)."""
    is_grey: bool
    """Whether the picture has no colours."""


@dataclass(frozen=True, eq=False)
class ColourPlaces:
    """Places of an object whose colours are used, and places beside it for comparison; (n, 3), (m, 3)."""

    own_m: Float64
    beside_m: Float64


class Recognition(ABC):
    """Reader of the content of cut-outs. Without recognisers both methods return None."""

    @abstractmethod
    def text(self, cut_out: CutOut) -> tuple[str, float] | None:
        """Returns the text on it and the probability that it is read right."""

    @abstractmethod
    def label(self, cut_outs: Sequence[CutOut]) -> tuple[str, float | None] | None:
        """Returns its type, in the words of a model, and its probability, from all its cut-outs; `unknown` has none."""


class PictureReader:
    """Reader of the pictures of a kind. All of it is a pure function of the objects and the pictures."""

    name: ClassVar[str]
    """Name of the kind."""

    def sight(self, one: AssetObject) -> Sight:
        """Returns what pictures must show of an object; by default :func:`usual_sight`."""
        return usual_sight(one)


class CutOutReader(PictureReader, ABC):
    """A reader of cut-outs of the best pictures."""

    @abstractmethod
    def outline_m(self, one: AssetObject) -> Float64 | None:
        """Returns the outline (k, 3) of an object on the map (m); None for one that is not cut out."""

    @abstractmethod
    def read(self, one: AssetObject, cut_outs: Sequence[CutOut], recognition: Recognition) -> Mapping[str, Any]:
        """Returns the kind's columns that the cut-outs of an object give, the one with the best view first."""


class ColourReader(PictureReader, ABC):
    """A reader of colours of places."""

    @abstractmethod
    def places(self, one: AssetObject) -> ColourPlaces:
        """Returns places whose colours are wanted."""

    @abstractmethod
    def read(self, own: UInt8, beside: UInt8) -> Mapping[str, Any]:
        """Returns the kind's columns that colours (n, 3) of an object and (m, 3) beside it give.

        Places that no picture shows are left out; there may be none.
        """


@functools.cache
def picture_readers() -> dict[str, CutOutReader | ColourReader]:
    """Returns all readers by their kind."""
    found = found_kinds("assets/pictures/readers/*.py", PictureReader, ENTRY_POINT_GROUP)
    return {name: kind() for name, kind in found.items()}


def sight_of(kind: str, one: AssetObject) -> Sight:
    """Returns what pictures must show of an object: as the reader of its kind says, else its reference point."""
    reader = picture_readers().get(kind)
    return usual_sight(one) if reader is None else reader.sight(one)


def usual_sight(one: AssetObject) -> Sight:
    """Returns the reference point of an object; of a point object its middle, but no more than 2 m above the foot.

    Parked cars hide the feet of posts and trees.
    """
    easting, northing, height = reference_point(one.geometry)
    if one.geometry.geom_type == "Point":
        height += min((one.attributes.get("asset_height_m") or 0.0) / 2, _EYE_LEVEL_M)
    return Sight(np.array([(easting, northing, height)]))
