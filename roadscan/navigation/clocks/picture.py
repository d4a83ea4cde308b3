"""Draws a clock's residuals: pairs of stamps or windows of motion less the estimate."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from roadscan.core.canvas import empty_figure
from roadscan.core.gpstime import NS_PER_S, iso_from_gps_ns
from roadscan.ingest.clock_correction import ClockCorrection, Residuals

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_UNITS: Final = ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs"), (1e-9, "ns"))  # Factor and name of each unit of time.
_BLUE, _GREY, _BAND = "#1f5fa8", "#9a9a9a", "#cfe0f2"
_NORMALISED: Final = 5.0
"""Widest normalised residual in the histogram."""


@dataclass(frozen=True)
class ClockPicture:
    """Content of the picture."""

    title: str
    method: str
    correction: ClockCorrection
    residuals: Residuals


def draw_clock(path: Path, picture: ClockPicture) -> None:
    """Write a PNG with the residuals over time, and their distribution compared with that of their σ."""
    figure = empty_figure(10.0, 4.4, 120)
    over_time, spread = figure.subplots(1, 2, width_ratios=[3.2, 1.0])
    figure.suptitle(f"{picture.title}\n{_summary(picture)}", fontsize=9, x=0.01, ha="left")
    _draw_over_time(over_time, picture)
    _draw_spread(spread, picture.residuals)
    figure.savefig(path, format="png", metadata={"Software": None})


def _draw_over_time(axes: Axes, picture: ClockPicture) -> None:
    r, c = picture.residuals, picture.correction
    origin = int(r.epochs_gps_ns.min())
    since = (r.epochs_gps_ns - origin).astype(np.float64) / NS_PER_S
    scale, unit = _unit(r)
    # Poor windows have long error bars: the axis covers those of the windows with weight.
    high = float(np.max((np.abs(r.residual_s) + r.sigma_s)[r.used], initial=3.0 * c.sigma_offset_s)) / scale * 1.15
    margin = max(0.02 * float(np.ptp(since)), 0.5)
    left, right = float(since.min()) - margin, float(since.max()) + margin
    along = np.linspace(left, right, 200)
    band = c.sigma_s(origin + np.rint(along * NS_PER_S).astype(np.int64)) / scale
    axes.fill_between(along, -band, band, color=_BAND, zorder=0, label="1 σ of the estimate")
    axes.axhline(0.0, color="black", linewidth=0.7)
    for chosen, colour, label in ((~r.used, _GREY, "left out"), (r.used, _BLUE, "used")):
        if chosen.any():
            shown = np.clip(r.residual_s[chosen] / scale, -0.97 * high, 0.97 * high)
            axes.errorbar(
                since[chosen], shown, np.minimum(r.sigma_s[chosen] / scale, 2 * high), fmt="o", color=colour,
                markersize=3.5, elinewidth=0.7, label=label,
            )  # fmt: skip
    for at, value in zip(since, r.residual_s / scale, strict=True):
        if abs(value) > high:  # written as text beyond the axis
            side = "left" if at < (left + right) / 2 else "right"
            axes.text(at, np.copysign(0.9 * high, value), f" {value:+.4g} {unit} ", fontsize=7, color=_GREY, ha=side)
    late = _is_late(r)
    axes.set_ylim(-0.1 * high if late else -high, high)
    axes.set_xlim(left, right)
    begin = iso_from_gps_ns(origin) if origin > NS_PER_S * 86_400 * 365 else "the first stamp"
    axes.set_xlabel(f"s since {begin}, by the uncorrected clock", fontsize=8)
    axes.set_ylabel(f"residual, observed − fitted ({unit})", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.grid(color="#e6e6e6", linewidth=0.6)
    axes.legend(fontsize=7, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False)


def _draw_spread(axes: Axes, r: Residuals) -> None:
    normalised = np.clip((r.residual_s / r.sigma_s)[r.used], -_NORMALISED, _NORMALISED)
    late = _is_late(r)
    least = 0.0 if late else -_NORMALISED
    edges = np.linspace(least, _NORMALISED, 11 if late else 21)
    axes.hist(normalised, edges.tolist(), orientation="horizontal", color=_BLUE, alpha=0.8)
    at = np.linspace(least, _NORMALISED, 201)
    density = np.exp(-at) if late else np.exp(-(at**2) / 2) / np.sqrt(2 * np.pi)
    axes.plot(normalised.size * (edges[1] - edges[0]) * density, at, color="black", linewidth=0.9)
    axes.set_ylim(-0.1 * _NORMALISED if late else -_NORMALISED, _NORMALISED)
    axes.set_xlabel("how many; line: as σ promise", fontsize=8)
    axes.set_ylabel("residual / σ", fontsize=8)
    axes.tick_params(labelsize=8)


def _is_late(r: Residuals) -> bool:
    """Return True for delays, which are never negative: those of arrivals at a host."""
    return bool(r.used.sum() > 2 and (r.residual_s >= 0.0).all())


def _unit(r: Residuals) -> tuple[float, str]:
    size = float(np.median((np.abs(r.residual_s) + r.sigma_s)[r.used])) if r.used.any() else 1.0
    return next(((scale, unit) for scale, unit in _UNITS if size >= scale), _UNITS[-1])


def _summary(picture: ClockPicture) -> str:
    c, r = picture.correction, picture.residuals
    return (
        f"{picture.method}: offset {c.offset_s:+.6f} s ± {c.sigma_offset_s * 1e3:.3g} ms, "
        f"drift {c.drift * 1e6:+.3f} ± {c.sigma_drift * 1e6:.3g} ppm, RMS {r.rms_s * 1e3:.3g} ms, "
        f"{int(r.used.sum())} used, {int((~r.used).sum())} left out"
    )
