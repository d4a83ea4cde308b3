"""Draws the quality of post-processed GNSS positions: σ, kind of solution, satellites, ratio, both directions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Float64
from roadscan.core.canvas import empty_figure, save_whole
from roadscan.core.gpstime import NS_PER_S, iso_from_gps_ns
from roadscan.navigation.picture import OTHER_COLOUR, QUALITY_COLOURS

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_MOST_POINTS: Final = 20_000
"""Most points of a panel; of more, every n-th is drawn."""
_LEAST_M: Final = 1e-4
"""Smallest value of a logarithmic axis (m): positions have four decimals."""
_INK: Final = "#222222"
COLUMNS: Final = (
    "epoch_gps_ns", "quality", "satellites", "sigma_north_m", "sigma_east_m", "sigma_down_m", "ratio",
)  # fmt: skip
"""Columns of the table `gnss` that are drawn."""


@dataclass(frozen=True)
class PpkPicture:
    """Content of the picture."""

    title: str
    seconds: Float64
    """(n,) since the first position."""
    begin_gps_ns: int
    quality: npt.NDArray[np.str_]
    sigma_horizontal_m: Float64
    sigma_down_m: Float64
    satellites: Float64
    ratio: Float64
    figures: Mapping[str, Any]
    """Entry `ppk` of the log's record."""

    @classmethod
    def of(cls, title: str, rows: pa.Table, figures: Mapping[str, Any]) -> PpkPicture:
        """Return the picture of rows of the table `gnss`."""
        rows = rows.select(COLUMNS).sort_by("epoch_gps_ns")
        epochs = rows.column("epoch_gps_ns").to_numpy()
        values = {name: rows.column(name).cast(pa.float64()).to_numpy() for name in COLUMNS if name not in COLUMNS[:2]}
        begin = int(epochs[0])
        return cls(
            title, (epochs - begin) / NS_PER_S, begin, rows.column("quality").to_numpy().astype(np.str_),
            np.hypot(values["sigma_north_m"], values["sigma_east_m"]), values["sigma_down_m"], values["satellites"],
            values["ratio"], figures,
        )  # fmt: skip


def draw_ppk(path: Path, picture: PpkPicture) -> None:
    """Write the picture as one PNG, whole or not at all; the same values give the same bytes."""
    figure = empty_figure(12.0, 9.0, 110)
    figure.suptitle(f"{picture.title}\n{_summary(picture)}", fontsize=10, x=0.01, ha="left")
    sigma, satellites, ratio, apart = figure.subplots(4, 1, sharex=True, height_ratios=[1.6, 1.0, 1.0, 1.2])
    _draw_sigma(sigma, picture)
    _points(satellites, picture, picture.satellites, ".")
    satellites.set_ylim(0, max(12.0, 1.1 * float(np.nanmax(picture.satellites, initial=0.0))))
    _finish(satellites, "Satellites used", "1")
    _points(ratio, picture, np.clip(picture.ratio, 1.0, None), ".")
    ratio.axhline(picture.figures["ratio"], color=_INK, linewidth=0.8, label=f"fixed from {picture.figures['ratio']:g}")
    ratio.set_yscale("log")
    _finish(ratio, "Ratio of the ambiguity test", "1")
    _draw_apart(apart, picture)
    apart.set_xlabel(f"s since {iso_from_gps_ns(picture.begin_gps_ns)[:23].rstrip('Z')} UTC", fontsize=8)
    save_whole(figure, path)


def _summary(picture: PpkPicture) -> str:
    f = picture.figures
    share = {name: 100.0 * float((picture.quality == name).mean()) for name in QUALITY_COLOURS}
    kinds = ", ".join(f"{name} {part:.1f} %" for name, part in share.items() if part > 0)
    return (
        f"{f['positions']:,} positions of {f['epochs']:,} epochs: {kinds}. {f['mode']}, {f['direction']}. Median σ "
        f"{np.nanmedian(picture.sigma_horizontal_m):.3f} m horizontal, {np.nanmedian(picture.sigma_down_m):.3f} m "
        f"down.\nThe base is {f['baseline_km']:.1f} km away, and {f['base_from_code_m']:.1f} m from its own code "
        "solution."
    )


def _points(axes: Axes, picture: PpkPicture, values: Float64, mark: str, label: str = "") -> None:
    """Draw values in the colours of their qualities, the best on top."""
    step = max(1, -(-values.size // _MOST_POINTS))
    for name in [*reversed(QUALITY_COLOURS), *sorted(set(picture.quality.tolist()) - set(QUALITY_COLOURS))]:
        rows = np.flatnonzero(picture.quality == name)[::step]
        if rows.size:
            axes.plot(
                picture.seconds[rows], values[rows], mark, markersize=3.5, markeredgewidth=0,
                color=QUALITY_COLOURS.get(name, OTHER_COLOUR), label=f"{name}{label}",
            )  # fmt: skip


def _draw_sigma(axes: Axes, picture: PpkPicture) -> None:
    _points(axes, picture, np.maximum(picture.sigma_horizontal_m, _LEAST_M), "o", ", horizontal")
    _points(axes, picture, np.maximum(picture.sigma_down_m, _LEAST_M), "v", ", down")
    axes.set_yscale("log")
    _finish(axes, "1 σ of the position, by its kind", "m")


def _draw_apart(axes: Axes, picture: PpkPicture) -> None:
    apart = picture.figures["apart"]
    if "epochs_gps_ns" in apart:
        seconds = (np.array(apart["epochs_gps_ns"]) - picture.begin_gps_ns) / NS_PER_S
        for name, mark, colour in (("horizontal", "o", "#1f5fa8"), ("vertical", "v", "#d1495b")):
            values = np.maximum(apart[f"{name}_m"], _LEAST_M)
            axes.plot(seconds, values, mark, color=colour, markersize=3.5, markeredgewidth=0, label=name)
        axes.set_yscale("log")
    told = f"beyond 4 σ at {apart['beyond_sigma']:,} of {apart['both_fixed']:,} epochs where both are fixed"
    _finish(axes, f"Backward against forward, largest of each piece of time; {told}", "m")


def _finish(axes: Axes, title: str, unit: str) -> None:
    axes.set_title(title, fontsize=9, loc="left")
    axes.set_ylabel(unit, fontsize=8)
    axes.tick_params(labelsize=8, which="both")
    axes.grid(color="#e6e6e6", linewidth=0.6)
    axes.set_axisbelow(True)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=7, ncols=4, loc="upper right", framealpha=0.85)
