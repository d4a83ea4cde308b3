"""Pictures of the road's condition: a strip chart of a lane, and a cross-section below its wire."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from roadscan.core.canvas import empty_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Float64 = npt.NDArray[np.float64]

_COLOURS: Final = ("#1f5fa8", "#c8501e", "#3b8a3e", "#7a4fa3")
_DOTS_PER_INCH: Final = 110  # Resolution of the pictures.


@dataclass(frozen=True, eq=False)
class Strip:
    """Values of one quantity of sections."""

    quantity: str
    unit: str
    from_m: Float64
    to_m: Float64
    value: Float64
    """Values; NaN where a section has none."""


def draw_strips(path: Path, title: str, panels: Sequence[Sequence[Strip]], span_m: tuple[float, float]) -> None:
    """Write a chart of a lane: one panel per index, its values as steps over the station."""
    figure = empty_figure(11.0, 0.9 + 1.5 * max(len(panels), 1), _DOTS_PER_INCH)
    axes = figure.subplots(max(len(panels), 1), 1, sharex=True, squeeze=False)[:, 0]
    for one, strips in zip(axes, panels, strict=False):
        _draw_panel(one, strips)
    axes[0].set_title(title, fontsize=9, loc="left")
    axes[-1].set_xlabel("station (m)", fontsize=8)
    axes[-1].set_xlim(*span_m)
    figure.savefig(path, metadata={"Software": None})


def _draw_panel(axes: Axes, strips: Sequence[Strip]) -> None:
    greatest = 0.0
    for strip, colour in zip(strips, _COLOURS, strict=False):
        x = np.column_stack([strip.from_m, strip.to_m, strip.to_m]).ravel()
        y = np.column_stack([strip.value, strip.value, np.full(strip.value.size, np.nan)]).ravel()
        axes.plot(x, y, color=colour, linewidth=1.8, label=_without_unit(strip.quantity))
        known = strip.value[np.isfinite(strip.value)]
        greatest = max(greatest, float(known.max()) if known.size else 0.0)
        lacking = np.flatnonzero(np.isnan(strip.value))
        for k in lacking.tolist():
            axes.axvspan(strip.from_m[k], strip.to_m[k], color="#eeeeee", linewidth=0)
    if greatest > 0.0 and all((s.value[np.isfinite(s.value)] >= 0.0).all() for s in strips):
        axes.set_ylim(0.0, 1.15 * greatest)
    axes.set_ylabel(strips[0].unit if strips else "", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.grid(color="#e6e6e6", linewidth=0.6)
    axes.legend(fontsize=7, loc="upper right", ncols=4, frameon=False)


def _without_unit(quantity: str) -> str:
    """Return the name of a quantity in the legend, without the unit, which the axis shows."""
    for unit in ("_m_per_km", "_percent", "_mm", "_m"):
        quantity = quantity.removesuffix(unit)
    return quantity.replace("_", " ")


@dataclass(frozen=True, eq=False)
class Crossing:
    """A cross-section to draw."""

    title: str
    """Which one it is, and where."""
    offset_m: Float64
    """(m,) from the lane's middle, positive to the right in the direction of travel."""
    height_m: Float64
    """(m,) finite."""
    wire: npt.NDArray[np.int64]
    """Indices of the points on which the wire rests."""
    told: Mapping[str, tuple[float, float, float]]
    """Depths (mm) that stand in the title, by name: of this cross-section with its σ, and the median of those around
    it."""


def draw_crossings(path: Path, title: str, crossings: Sequence[Crossing]) -> None:
    """Write a picture of cross-sections below each other, their tilt taken out, with the wire over each."""
    figure = empty_figure(9.0, 0.4 + 3.0 * len(crossings), _DOTS_PER_INCH)
    places = figure.subplots(len(crossings), 1, sharex=True, squeeze=False)[:, 0]
    levels = [_level(crossing) for crossing in crossings]
    low, high = min(float(level.min()) for level in levels), max(float(level.max()) for level in levels)
    for axes, crossing, level in zip(places, crossings, levels, strict=True):
        _draw_crossing(axes, crossing, level)
        axes.set_ylim(low - 2.0, high + 2.0)  # a common scale, so that depths can be compared
    figure.suptitle(title, fontsize=9, x=0.01, ha="left")
    places[-1].set_xlabel("offset from the lane's middle, right in the direction of travel (m)", fontsize=8)
    figure.savefig(path, metadata={"Software": None})


def _level(crossing: Crossing) -> Float64:
    """Return heights (m,) above the straight line through them (mm)."""
    x = crossing.offset_m
    tilt = np.polynomial.polynomial.polyval(x, np.polynomial.polynomial.polyfit(x, crossing.height_m, 1))
    return np.asarray(1e3 * (crossing.height_m - tilt), dtype=np.float64)


def _draw_crossing(axes: Axes, crossing: Crossing, level: Float64) -> None:
    x, wire = crossing.offset_m, crossing.wire
    axes.plot(x, level, color="#333333", linewidth=1.4, label="road")
    axes.plot(x[wire], level[wire], color=_COLOURS[1], linewidth=1.2, marker="o", markersize=2.5, label="wire")
    axes.fill_between(x, level, np.interp(x, x[wire], level[wire]), color=_COLOURS[1], alpha=0.15, linewidth=0)
    told = ", ".join(
        f"{name} {own:.1f} ± {sigma:.1f} mm (over 5 m {near:.1f} mm)"
        for name, (own, sigma, near) in crossing.told.items()
    )
    axes.set_title(f"{crossing.title}: {told}", fontsize=9, loc="left")
    axes.set_ylabel("height without its tilt (mm)", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.grid(color="#e6e6e6", linewidth=0.6)
    axes.legend(fontsize=7, frameon=False)
