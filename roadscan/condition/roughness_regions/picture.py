"""Draws the outlines of roughness regions over the intensities of their sections."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.core.canvas import empty_figure

_DOTS_PER_INCH: Final = 110  # Resolution.
_WIDTH_IN: Final = 7.0  # Width of a section.
_OUTLINE: Final = "#d7301f"


@dataclass(frozen=True, eq=False)
class DrawnSection:
    """A section with its regions, x along the road and y to the left (m)."""

    title: str
    values: npt.NDArray[np.uint8]
    """(rows, columns) intensities from black to white, rows to the left."""
    measured: npt.NDArray[np.bool_]
    corner_m: tuple[float, float]
    cell_m: float
    outlines_m: tuple[npt.NDArray[Any], ...]
    """(k, 2) outline of each region."""


def draw_regions(path: Path, sections: Sequence[DrawnSection]) -> None:
    """Write the sections one below the other."""
    heights = [1.0 + _WIDTH_IN * one.values.shape[0] / one.values.shape[1] for one in sections]
    figure = empty_figure(_WIDTH_IN + 1.0, sum(heights), _DOTS_PER_INCH)
    axes = figure.subplots(len(sections), 1, squeeze=False, gridspec_kw={"height_ratios": heights})[:, 0]
    for one, section in zip(axes, sections, strict=True):
        rows, columns = section.values.shape
        x, y = section.corner_m
        extent = (x, x + columns * section.cell_m, y, y + rows * section.cell_m)
        shown = np.ma.masked_array(section.values, ~section.measured)
        one.set_facecolor("#dfe8f2")
        one.imshow(shown, cmap="gray", vmin=0, vmax=255, origin="lower", extent=extent, interpolation="nearest")
        for outline in section.outlines_m:
            one.plot(outline[:, 0], outline[:, 1], color=_OUTLINE, linewidth=1.4)
        one.set_title(section.title, fontsize=9, loc="left")
        one.set_xlabel("from the section's middle along the road (m)", fontsize=8)
        one.set_ylabel("to the left (m)", fontsize=8)
        one.tick_params(labelsize=7)
    figure.savefig(path, metadata={"Software": None})
