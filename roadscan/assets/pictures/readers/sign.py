"""Signs in pictures: colour, shape, text and type of the plate from cut-outs of the best views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from roadscan.assets.calibration import Curve
from roadscan.assets.kind import AssetObject
from roadscan.assets.object_table import reference_point
from roadscan.assets.pictures.colour_classes import colour_of
from roadscan.assets.pictures.plate_outlines import on_plate, plate_axes, plate_outline
from roadscan.assets.pictures.plate_shapes import plate_odds, shape_of
from roadscan.assets.pictures.reader import CutOut, CutOutReader, Recognition, Sight
from roadscan.compute.array_types import Float64

_MOST: Final = 0.999  # Greatest probability that is stated.
_BOX: Final = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])  # Corners of a plate of 1 by 1: right, up.


class SignReader(CutOutReader):
    """Reader of signs: the outline of a plate follows from its middle, size, shape, facing and tilt."""

    name = "sign"

    def sight(self, one: AssetObject) -> Sight:
        """Returns the middle and the corners of the plate, from the front."""
        middle, (facing_deg, tilt_deg) = np.array(reference_point(one.geometry)), _turn(one)
        if one.attributes.get("facing_deg") is None:
            return Sight(np.repeat(middle[None], 5, axis=0))
        corners = on_plate(_BOX * _size(one), middle, facing_deg, tilt_deg)
        return Sight(np.vstack([middle, corners]), plate_axes(facing_deg, tilt_deg)[2])

    def outline_m(self, one: AssetObject) -> Float64 | None:
        """Returns corners of the bounding box, then the outline of the shape; None for a plate of unknown facing."""
        if one.attributes.get("facing_deg") is None or not _size(one).all():
            return None
        middle, turn = np.array(reference_point(one.geometry)), _turn(one)
        shape = plate_outline(one.attributes.get("shape") or "rectangle", *_size(one).tolist())
        return np.vstack([on_plate(_BOX * _size(one), middle, *turn), on_plate(shape, middle, *turn)])

    def read(self, one: AssetObject, cut_outs: Sequence[CutOut], recognition: Recognition) -> Mapping[str, Any]:
        """Returns columns colour, shape, message and type, each with its probability where it is known, and that of the
        plate itself: a picture that sees the place confirms it or not.
        """
        told: dict[str, Any] = {}
        shape, probability = shape_of(cut_outs, one.attributes.get("shape") or "other", *_size(one).tolist())
        told |= {"shape": shape, "shape_probability": probability}
        confirmed = Curve(plate_odds(cut_outs, shape), 1.0).stated(one.probability)
        told["probability"] = min(confirmed, _MOST)
        colour = colour_of([_within_shape(c) for c in cut_outs])
        if colour is not None:
            told |= {"colour": colour[0], "colour_probability": colour[1]}
        read = [r for r in map(recognition.text, cut_outs) if r is not None]
        if read:
            words, probability = max(read, key=lambda r: r[1])
            told |= {"message": words, "message_probability": probability}
        kind = recognition.label(cut_outs)
        if kind is not None:
            told |= {"type": kind[0], "type_probability": kind[1]}
        return told


def _within_shape(one: CutOut) -> CutOut:
    """Returns a cut-out with the outline of the shape alone."""
    return CutOut(one.pixels, one.outline_px[4:], one.resolution_m, one.is_grey)


def _size(one: AssetObject) -> Float64:
    """Returns width and height (m); 0 where they are not known."""
    return np.array([one.attributes.get("width_m") or 0.0, one.attributes.get("plate_height_m") or 0.0])


def _turn(one: AssetObject) -> tuple[float, float]:
    """Returns facing and tilt (degrees)."""
    return one.attributes.get("facing_deg") or 0.0, one.attributes.get("tilt_deg") or 0.0
