"""Draws ravelling: the ratio of the squares' texture to that of their section, with the outlines of patches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.core.canvas import empty_figure

_DOTS_PER_INCH: Final = 110  # Resolution.
_WIDTH_IN: Final = 11.0  # Width of the picture.
_HEIGHT_IN: Final = 1.7  # Height of a section.
_OUTLINE: Final = "#111111"
_MOST: Final = 2.5
"""Ratio of the darkest colour."""


@dataclass(frozen=True, eq=False)
class DrawnLane:
    """A section of a lane with its patches."""

    title: str
    ratio: npt.NDArray[np.float64]
    """(along, across) texture over that of the section, from left to right; NaN where unknown."""
    corner_m: tuple[float, float]
    """Station, and offset from the lane's middle, of the first square's corner."""
    square_m: float
    outlines_m: tuple[npt.NDArray[Any], ...]
    """(k, 2) stations and offsets from the lane's middle, for each patch."""


def draw_ravelling(path: Path, sections: Sequence[DrawnLane]) -> None:
    """Write the sections one below the other; travel is from left to right, left of the lane is up."""
    figure = empty_figure(_WIDTH_IN, _HEIGHT_IN * len(sections), _DOTS_PER_INCH)
    axes = figure.subplots(len(sections), 1, squeeze=False)[:, 0]
    for one, section in zip(axes, sections, strict=True):
        along, across = section.ratio.shape
        x, y = section.corner_m
        extent = (x, x + along * section.square_m, y + across * section.square_m, y)
        one.set_facecolor("#dfe8f2")
        shown = np.ma.masked_invalid(section.ratio.T)
        one.imshow(shown, cmap="YlOrRd", vmin=1.0, vmax=_MOST, extent=extent, aspect="auto", interpolation="nearest")
        for outline in section.outlines_m:
            one.plot(outline[:, 0], outline[:, 1], color=_OUTLINE, linewidth=1.1)
        one.set_title(f"{section.title}: texture over that of the section, 1 to {_MOST:g}", fontsize=8, loc="left")
        one.set_xlabel("station (m)", fontsize=7)
        one.set_ylabel("to the right (m)", fontsize=7)
        one.tick_params(labelsize=7)
    figure.savefig(path, metadata={"Software": None})
