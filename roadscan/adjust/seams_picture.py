"""Figure of seams: the surfaces of two passes at a place, before and after the adjustment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.core.canvas import empty_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_FIRST: Final = "#d1495b"
_SECOND: Final = "#1f5fa8"
_LEAST_MM: Final = 1.0  # Least half range of the colours (mm).
_WORDS: Final = ("before", "after")


@dataclass(frozen=True)
class ShownSeam:
    """A row of the figure."""

    title: str
    passes: tuple[str, str]
    """Names of the two."""
    cell_m: float
    difference_m: Float64
    """(2, k, k) second minus first, before and after, rows along."""
    across_m: Float64
    """(k,) of the columns."""
    section_m: Float64
    """(2, 2, k) cross-sections before and after, of the first and the second."""


def draw_seams(shown: Sequence[ShownSeam], path: Path) -> None:
    """Draw a row for each place: maps of the difference in height and cross-sections, each before and after.

    Equal input gives equal bytes.
    """
    figure = empty_figure(13.0, 3.4 * len(shown), 120)
    parts = figure.subfigures(len(shown), 1, squeeze=False)
    for part, one in zip(parts.ravel(), shown, strict=True):
        part.suptitle(one.title, fontsize="medium")
        axes = part.subplots(1, 4)
        limit = max(1e3 * float(np.nanpercentile(np.abs(one.difference_m[0]), 90)), _LEAST_MM)
        for number, word in enumerate(_WORDS):
            _difference(axes[number], one, number, limit)
            axes[number].set_title(f"difference {word}", fontsize="small")
        known = 1e3 * one.section_m[np.isfinite(one.section_m)]
        span = (float(known.min()), float(known.max())) if known.size else (-1.0, 1.0)
        margin = max(0.1 * (span[1] - span[0]), 0.5)
        for number, word in enumerate(_WORDS):
            _section(axes[2 + number], one, number)
            axes[2 + number].set_ylim(span[0] - margin, span[1] + margin)
            axes[2 + number].set_title(f"cross-section {word}", fontsize="small")
    figure.savefig(path, metadata={"Software": None})


def _difference(axes: Axes, one: ShownSeam, number: int, limit_mm: float) -> None:
    half = 0.5 * len(one.across_m) * one.cell_m
    picture = axes.imshow(
        1e3 * one.difference_m[number], cmap="coolwarm", vmin=-limit_mm, vmax=limit_mm, origin="lower",
        extent=(-half, half, -half, half), interpolation="nearest",
    )  # fmt: skip
    axes.set_facecolor("white")
    axes.set_xlabel("across (m)")
    if number == 0:
        axes.set_ylabel("along (m)")
    else:
        axes.figure.colorbar(picture, ax=axes, label="mm")


def _section(axes: Axes, one: ShownSeam, number: int) -> None:
    for name, colour, values in zip(one.passes, (_FIRST, _SECOND), one.section_m[number], strict=True):
        axes.plot(one.across_m, 1e3 * values, color=colour, linewidth=1.2, label=name)
    axes.set_xlabel("across (m)")
    if number == 0:
        axes.set_ylabel("height above a plane (mm)")
        axes.legend(fontsize="small")
