"""Shape of a plate from the edges in its cut-outs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.pictures.plate_outlines import SHAPES, plate_outline
from roadscan.assets.pictures.reader import CutOut
from roadscan.compute.array_types import Float64
from roadscan.core.extras import cv2

_NEAR: Final = 0.07
"""Colours are compared this far within and beyond an outline, as a share of the plate."""
_FULL_STEP: Final = 60.0
"""Difference of colours (CIE 1976 L*a*b*, 8 bits) at which an edge has full weight."""
_WEIGHT: Final = 14.0  # Weight of a mean edge in the logarithm of a shape's weight.
_FROM_RETURNS: Final = 0.7
"""Probability that the outline of the returns alone has the right shape."""
_UNKNOWN: Final = 0.02
"""Weight of shapes that nobody lists, as a share of that of the best one: no shape is certain."""
_NO_EDGE, _MOST_ODDS = 0.25, 1.5
"""Mean step of colours at which a picture says neither that a plate is there nor that there is none, and the greatest
logarithm of the odds that pictures add or take: a grey plate before a grey wall shows no edge either."""
_LEAST_PX: Final = 12.0  # Smaller cut-outs (pixels) are not used.


def shape_of(cut_outs: Sequence[CutOut], shape: str, width_m: float, height_m: float) -> tuple[str, float]:
    """Returns the shape of a plate and its probability.

    Every shape in the plate's bounding box is compared with the cut-outs. For the right one, colours differ all
    along its outline from just within to just beyond it. A shape's weight grows exponentially with the mean of these
    steps; the shape of the returns starts with 0.7. Without a cut-out of 12 pixels or more only that is reported.

    Parameters
    ----------
    cut_outs : with the corners of the plate's bounding box among their outlines: lower left, lower right, upper right,
        upper left are the first four.
    shape : as the returns have it.
    width_m, height_m : of the bounding box.
    """
    own = "rectangle" if shape == "square" else shape
    names = [n for n in SHAPES if _fits(n, width_m, height_m)]
    if own not in names:
        names.append(own)
    score = {n: np.log(_FROM_RETURNS if n == own else (1.0 - _FROM_RETURNS) / max(len(names) - 1, 1)) for n in names}
    for one in cut_outs:
        if _is_large(one):
            for name in names:
                score[name] += _WEIGHT / len(cut_outs) * _edges(one, name)
    joined: dict[str, float] = {}
    top = max(score.values())
    for name, value in score.items():
        key = name.split()[0]
        joined[key] = joined.get(key, 0.0) + float(np.exp(value - top))
    best = min(joined, key=lambda n: (-joined[n], n))
    unknown = _UNKNOWN * joined[best] if any(map(_is_large, cut_outs)) else 0.0
    probability = joined[best] / (sum(joined.values()) + unknown)
    if best == "rectangle" and shape == "square":
        best = "square"
    return best, probability


def plate_odds(cut_outs: Sequence[CutOut], shape: str) -> float:
    """Returns the logarithm of the odds that cut-outs add to those of a plate of a shape: negative ones veto it.

    Colours differ across the whole outline of a plate; where they do not, a picture sees the place and no plate there.
    """
    name = "rectangle" if shape in ("square", "other") else shape
    names = [n for n in SHAPES if n.split()[0] == name]
    seen = [max(_edges(one, n) for n in names) for one in cut_outs if _is_large(one)]
    if not seen:
        return 0.0
    return float(np.clip(_WEIGHT * (np.mean(seen) - _NO_EDGE), -_MOST_ODDS, _MOST_ODDS))


def _is_large(one: CutOut) -> bool:
    return float(np.ptp(one.outline_px, axis=0).min()) >= _LEAST_PX


def _fits(name: str, width_m: float, height_m: float) -> bool:
    """Returns whether a plate of this size may have the shape: all but rectangles are as high as wide, or nearly."""
    ratio = height_m / width_m
    if name.startswith("triangle"):
        return 0.75 <= ratio <= 1.05
    return name == "rectangle" or 0.88 <= ratio <= 1.14


def _edges(one: CutOut, name: str) -> float:
    """Returns the mean step of the colours (0 … 1) across the outline of a shape in the plate's box."""
    lab = cv2.cvtColor(one.pixels, cv2.COLOR_RGB2LAB).astype(np.float32)
    turn = cv2.getPerspectiveTransform(_BOX, one.outline_px[:4].astype(np.float32))
    outline = plate_outline(name, 1.0, 1.0)
    inner, outer = (_sampled(lab, turn, (1.0 + sign * 2.0 * _NEAR) * outline) for sign in (-1.0, 1.0))
    step = np.linalg.norm(inner - outer, axis=1)
    return float(np.mean(np.minimum(step / _FULL_STEP, 1.0)))


def _sampled(lab: npt.NDArray[np.float32], turn: Float64, plane: Float64) -> Float64:
    """Returns colours (n, 3) at points (n, 2) of the plate's box."""
    at = cv2.perspectiveTransform(plane[None].astype(np.float32), turn.astype(np.float32))[0]
    found = cv2.remap(lab, at[None, :, 0], at[None, :, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found[0], np.float64)


_BOX: Final = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]], np.float32)  # Corners of a box of 1 by 1.
