"""Figure of an adjustment: map and histograms of the residuals before and after."""

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


_BEFORE: Final = "#d1495b"
_AFTER: Final = "#1f5fa8"
_LEAST_MM: Final = 0.5  # Least half range of the axes (mm).


@dataclass(frozen=True)
class Residuals:
    """Differences of one kind, before and after (m), and where they were found on the map (m)."""

    title: str
    easting_m: Float64
    northing_m: Float64
    before_m: Float64
    after_m: Float64


@dataclass(frozen=True)
class AdjustmentPicture:
    """Contents of the figure."""

    title: str
    ways_m: tuple[Float64, ...]
    """(n, 2) easting and northing of each track."""
    residuals: tuple[Residuals, ...]
    """Heights of ties, of control, of check points."""


def draw_adjustment(shown: AdjustmentPicture, path: Path) -> None:
    """Draw a row for each kind: a map of residuals, and histograms before and after. Equal input gives equal bytes."""
    known = [one for one in shown.residuals if one.before_m.size]
    figure = empty_figure(11.0, 1.0 + 3.2 * max(len(known), 1), 120)
    figure.suptitle(shown.title)
    axes = figure.subplots(max(len(known), 1), 2, squeeze=False)
    for row, one in zip(axes, known, strict=False):
        _map(row[0], shown, one)
        _histogram(row[1], one)
    figure.savefig(path, metadata={"Software": None})


def _map(axes: Axes, shown: AdjustmentPicture, one: Residuals) -> None:
    every = np.concatenate([way for way in shown.ways_m if len(way)] or [np.zeros((1, 2))])
    corner = np.floor(every.min(axis=0))
    for way in shown.ways_m:
        axes.plot(*(way - corner).T, color="#bbbbbb", linewidth=0.8)
    limit = max(1e3 * float(np.percentile(np.abs(one.after_m), 98)), _LEAST_MM)
    points = axes.scatter(
        one.easting_m - corner[0], one.northing_m - corner[1], c=1e3 * one.after_m, s=14, cmap="coolwarm",
        vmin=-limit, vmax=limit,
    )  # fmt: skip
    axes.figure.colorbar(points, ax=axes, label="left (mm)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_title(one.title)
    axes.set_xlabel(f"easting − {corner[0]:.0f} m")
    axes.set_ylabel(f"northing − {corner[1]:.0f} m")


def _histogram(axes: Axes, one: Residuals) -> None:
    both = 1e3 * np.concatenate([one.before_m, one.after_m])
    limit = max(float(np.percentile(np.abs(both), 98)) * 1.1, _LEAST_MM)
    edges = np.linspace(-limit, limit, 41)
    for values, colour, word in ((one.before_m, _BEFORE, "before"), (one.after_m, _AFTER, "after")):
        rms = 1e3 * float(np.sqrt(np.mean(values**2)))
        inside = np.clip(1e3 * values, -limit, limit)
        axes.hist(inside, edges.tolist(), color=colour, alpha=0.6, label=f"{word}: RMS {rms:.2f} mm")
    axes.set_xlabel("difference (mm)")
    axes.set_ylabel(f"of {one.before_m.size:,}")
    axes.legend(fontsize="small")


_FIRST: Final = "#d1495b"
_SECOND: Final = "#1f5fa8"
_LEAST_COLOURS_MM: Final = 1.0  # Least half range of the colours (mm).
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
        limit = max(1e3 * float(np.nanpercentile(np.abs(one.difference_m[0]), 90)), _LEAST_COLOURS_MM)
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
