"""Draws a run's navigation: path, σ, residuals, innovations, and the other estimated states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.canvas import empty_figure, save_whole
from roadscan.core.crs import LOCAL_WORLD, geodetic_from_world
from roadscan.core.frames import ENU_FROM_NED, ecef_from_ned, rotation_from_quaternion
from roadscan.core.gpstime import NS_PER_S, iso_from_gps_ns
from roadscan.core.rig import STANDARD_GRAVITY_M_PER_S2
from roadscan.navigation.inertial.readings import GnssSolutions, Innovations, Solution

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Flags = npt.NDArray[np.bool_]

OUTAGE_S: Final = 2.0
"""GNSS is out where there is no position for longer than this, and than two and a half times the usual interval."""
_MOST_POINTS: Final = 6000
"""Most points of a line."""
_INK, _GREY, _SHADE = "#222222", "#9a9a9a", "#f3d9c9"
_AXIS_COLOURS: Final = ("#1f5fa8", "#d1495b", "#3d8b40")
QUALITY_COLOURS: Final = {
    "fixed": "#3d8b40", "float": "#e0a100", "ppp": "#2a9d8f", "dgps": "#d17b0f", "sbas": "#b0652f",
    "pps": "#7a5195", "single": "#d1495b",
}  # fmt: skip
OTHER_COLOUR: Final = "#7b2d8b"
_DOWN, _REFUSED = "#e07a00", "#c1121f"


@dataclass(frozen=True)
class NavigationPicture:
    """Content of the picture."""

    title: str
    """Run, and other names."""
    solution: Solution
    gnss: GnssSolutions
    """Solutions of the run, on GPS time."""
    antenna_lever_arm_body_m: Float64
    """(3,) from the IMU reference point, forward, right, down."""


@dataclass(frozen=True)
class _Axis:
    """Time axis of all panels."""

    begin_gps_ns: int
    end_gps_ns: int
    outages_s: list[tuple[float, float]]

    def seconds(self, epochs_gps_ns: Int64) -> Float64:
        since: Float64 = (epochs_gps_ns - self.begin_gps_ns).astype(np.float64) / NS_PER_S
        return since


@dataclass(frozen=True)
class _Residuals:
    """Antenna position of the solution less that of GNSS, at the epochs of GNSS."""

    seconds: Float64
    ned_m: Float64
    """(k, 3)"""
    quality: npt.NDArray[np.str_]


def draw_navigation(path: Path, picture: NavigationPicture) -> None:
    """Write the quality of a run's navigation as one PNG; the same values give the same bytes.

    The file appears whole: it is written beside its place under another name, and renamed.
    """
    axis = _axis(picture)
    residuals = _residuals(picture, axis)
    figure = empty_figure(15.0, 13.5, 110)
    grid = figure.add_gridspec(5, 2, width_ratios=[1.0, 1.35])
    figure.suptitle(f"{picture.title}\n{_summary(picture, residuals, axis)}", fontsize=10, x=0.01, ha="left")
    _draw_path(figure.add_subplot(grid[0:2, 0]), picture, axis)
    _draw_spread(figure.add_subplot(grid[2, 0]), residuals)
    _draw_states(figure.add_subplot(grid[3, 0]), picture.solution, axis, "gyro_bias")
    _draw_states(figure.add_subplot(grid[4, 0]), picture.solution, axis, "accel_bias")
    panels = [figure.add_subplot(grid[k, 1]) for k in range(5)]
    _draw_position_sigma(panels[0], picture.solution, axis)
    _draw_attitude_sigma(panels[1], picture.solution, axis)
    _draw_residuals(panels[2], residuals, axis)
    _draw_innovations(panels[3], picture.solution.innovations, axis)
    _draw_odometer(panels[4], picture.solution, axis)
    save_whole(figure, path)


def _axis(picture: NavigationPicture) -> _Axis:
    s, g = picture.solution, picture.gnss
    begin, end = int(s.epochs_gps_ns[0]), int(s.epochs_gps_ns[-1])
    placed = g.epochs_gps_ns[np.isfinite(g.position_world_m[:, 0])]
    placed = placed[(placed >= begin) & (placed <= end)]
    usual = float(np.median(np.diff(placed))) / NS_PER_S if placed.size > 1 else OUTAGE_S
    edges = np.concatenate([[begin], placed, [end]])
    gaps = np.flatnonzero(np.diff(edges) > max(OUTAGE_S, 2.5 * usual) * NS_PER_S)
    outages = [((edges[k] - begin) / NS_PER_S, (edges[k + 1] - begin) / NS_PER_S) for k in gaps]
    return _Axis(begin, end, outages)


def _residuals(picture: NavigationPicture, axis: _Axis) -> _Residuals:
    s, g = picture.solution, picture.gnss
    placed = np.isfinite(g.position_world_m[:, 0])
    inside = (g.epochs_gps_ns >= axis.begin_gps_ns) & (g.epochs_gps_ns <= axis.end_gps_ns)
    rows = np.flatnonzero(placed & inside & _covered(s, g.epochs_gps_ns))
    rotation = rotation_from_quaternion(s.quaternion_world_from_body)
    antenna = s.position_world_m + rotation @ _antenna_arm(picture)
    here, there = (_seconds(e, axis.begin_gps_ns) for e in (g.epochs_gps_ns[rows], s.epochs_gps_ns))
    origin = antenna[0]
    at = np.stack([np.interp(here, there, antenna[:, k] - origin[k]) for k in range(3)], axis=-1)
    world = at - (g.position_world_m[rows] - origin)
    return _Residuals(here, world @ _ned_from_world(s.world, origin).T, g.quality[rows])


def _antenna_arm(picture: NavigationPicture) -> Float64:
    """Return the lever arm that the smoother estimated, or the stated one."""
    found = picture.solution.states.get("antenna_lever_arm_body_m")
    if found is None or len(found[0]) == 0:
        return picture.antenna_lever_arm_body_m
    return np.asarray(found[0][-1], dtype=np.float64)


def _covered(solution: Solution, epochs: Int64) -> Flags:
    """Return epochs (m,) that lie in an unbroken piece of the solution."""
    if not solution.pieces:
        return np.ones(epochs.size, dtype=bool)
    inside: Flags = np.any([(epochs >= a) & (epochs <= b) for a, b in solution.pieces], axis=0)
    return inside


def _seconds(epochs: Int64, begin: int) -> Float64:
    since: Float64 = (epochs - begin).astype(np.float64) / NS_PER_S
    return since


def _ned_from_world(world: str, position: Float64) -> Float64:
    if world == LOCAL_WORLD:
        return ENU_FROM_NED.T
    longitude, latitude, _ = geodetic_from_world(world, position[None])[0]
    return ecef_from_ned(np.radians(latitude), np.radians(longitude)).T


def _summary(picture: NavigationPicture, residuals: _Residuals, axis: _Axis) -> str:
    s = picture.solution
    sigma = np.sqrt(np.einsum("nii->ni", s.covariance_position_ned_m2))
    horizontal = np.hypot(sigma[:, 0], sigma[:, 1])
    steps = np.linalg.norm(np.diff(s.position_world_m, axis=0), axis=1)
    out_s = sum(b - a for a, b in axis.outages_s)
    parts = [
        f"{iso_from_gps_ns(axis.begin_gps_ns)[:19]} UTC, {(axis.end_gps_ns - axis.begin_gps_ns) / NS_PER_S:.0f} s, "
        f"{steps.sum() / 1000:.2f} km",
        f"σ horizontal {np.median(horizontal):.3f} m median, {horizontal.max():.3f} m worst; down "
        f"{np.median(sigma[:, 2]):.3f} / {sigma[:, 2].max():.3f} m; heading "
        f"{np.degrees(np.median(s.sigma_rph_rad[:, 2])):.3f}° / {np.degrees(s.sigma_rph_rad[:, 2].max()):.3f}°",
        f"{len(axis.outages_s)} outage{'s' if len(axis.outages_s) != 1 else ''}, {out_s:.0f} s without GNSS, "
        f"the longest {max((b - a for a, b in axis.outages_s), default=0.0):.0f} s",
    ]
    if residuals.seconds.size:
        flat = np.hypot(residuals.ned_m[:, 0], residuals.ned_m[:, 1])
        rms = np.sqrt((flat**2).mean()), np.sqrt((residuals.ned_m[:, 2] ** 2).mean())
        parts.append(f"smoothed − GNSS: RMS {rms[0]:.3f} m horizontal, {rms[1]:.3f} m down")
    if s.innovations is not None and s.innovations.weight.size:
        w = s.innovations.weight
        parts.append(f"{w.size} updates, {int(((w > 0) & (w < 1)).sum())} down-weighted, {int((w == 0).sum())} refused")
    return "   ".join(parts[:2]) + "\n" + "   ".join(parts[2:])


def _draw_path(axes: Axes, picture: NavigationPicture, axis: _Axis) -> None:
    s, g = picture.solution, picture.gnss
    origin = s.position_world_m[0]
    turn = _ned_from_world(s.world, origin)
    thin = _thinned(s.epochs_gps_ns.size)
    ned = (s.position_world_m[thin] - origin) @ turn.T
    axes.plot(ned[:, 1], ned[:, 0], color=_INK, linewidth=0.8, label="smoothed", zorder=2)
    seconds = axis.seconds(s.epochs_gps_ns[thin])
    dark = np.zeros(seconds.size, dtype=bool)
    for a, b in axis.outages_s:
        dark |= (seconds >= a) & (seconds <= b)
    pieces = [ned[k : k + 2, 1::-1] for k in np.flatnonzero(dark[:-1] & dark[1:])]
    if pieces:
        from matplotlib.collections import LineCollection  # slow to import

        axes.add_collection(LineCollection(pieces, colors=_REFUSED, linewidths=2.4, zorder=3, label="GNSS out"))
    placed = np.isfinite(g.position_world_m[:, 0])
    for name in _qualities(g.quality[placed]):
        rows = np.flatnonzero(placed & (g.quality == name))
        rows = rows[_thinned(rows.size)]
        there = (g.position_world_m[rows] - origin) @ turn.T
        axes.plot(
            there[:, 1], there[:, 0], ".", color=_colour(name), markersize=4, zorder=1, label=f"GNSS {name}",
            alpha=0.7, markeredgewidth=0,
        )  # fmt: skip
    axes.plot(0.0, 0.0, "^", color=_INK, markersize=8, zorder=4, label="begin")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("east of the begin (m)", fontsize=8)
    axes.set_ylabel("north of the begin (m)", fontsize=8)
    _finish(axes, "Path and quality of GNSS")


def _draw_position_sigma(axes: Axes, s: Solution, axis: _Axis) -> None:
    thin = _thinned(s.epochs_gps_ns.size)
    sigma = np.sqrt(np.einsum("nii->ni", s.covariance_position_ned_m2[thin]))
    _lines(axes, axis.seconds(s.epochs_gps_ns[thin]), sigma, ("north", "east", "down"))
    _logarithmic(axes, sigma)
    _over_time(axes, axis, "1 σ of the position (m)", "Position, with GNSS outages shaded", utc=True)


def _draw_attitude_sigma(axes: Axes, s: Solution, axis: _Axis) -> None:
    thin = _thinned(s.epochs_gps_ns.size)
    sigma = np.degrees(s.sigma_rph_rad[thin])
    _lines(axes, axis.seconds(s.epochs_gps_ns[thin]), sigma, ("roll", "pitch", "heading"))
    _logarithmic(axes, sigma)
    _over_time(axes, axis, "1 σ (°)", "Attitude")


def _draw_residuals(axes: Axes, r: _Residuals, axis: _Axis) -> None:
    if r.seconds.size:
        high = 1.15 * max(float(np.quantile(np.abs(r.ned_m), 0.995)), 0.005)
        for name in _qualities(r.quality):
            rows = r.quality == name
            for k, mark in enumerate(("o", "s", "v")):
                axes.plot(
                    r.seconds[rows], np.clip(r.ned_m[rows, k], -high, high), mark, color=_AXIS_COLOURS[k],
                    markersize=2.6, markeredgewidth=0.6 if name != "fixed" else 0.0,
                    markeredgecolor=_colour(name) if name != "fixed" else None,
                    label=f"{'NED'[k]} ({name})",
                )  # fmt: skip
        axes.set_ylim(-1.05 * high, 1.05 * high)
    axes.axhline(0.0, color=_INK, linewidth=0.6)
    _over_time(
        axes, axis, "smoothed − GNSS (m)", "Residuals of GNSS positions (beyond the axis: at its edge)", columns=3
    )


def _draw_spread(axes: Axes, r: _Residuals) -> None:
    """Draw the cumulative distribution of the residuals' sizes, by quality."""
    for name in _qualities(r.quality):
        rows = r.quality == name
        for values, style, label in (
            (np.hypot(r.ned_m[rows, 0], r.ned_m[rows, 1]), "-", "horizontal"),
            (np.abs(r.ned_m[rows, 2]), ":", "down"),
        ):
            part = np.arange(1, values.size + 1) / values.size
            rms = float(np.sqrt((values**2).mean()))
            text = f"{name}, {label}: {values.size}, RMS {rms:.3f} m"
            axes.plot(np.maximum(np.sort(values), 1e-4), 100 * part, style, color=_colour(name), label=text)
    axes.set_xscale("log")
    axes.set_xlabel("|smoothed − GNSS| (m)", fontsize=8)
    axes.set_ylabel("share below (%)", fontsize=8)
    _finish(axes, "Residuals of GNSS positions by quality")


def _draw_innovations(axes: Axes, found: Innovations | None, axis: _Axis) -> None:
    if found is not None and found.weight.size:
        size = np.sqrt(np.maximum(found.normalised, 1e-6))
        seconds = axis.seconds(found.epochs_gps_ns)
        kinds = list(dict.fromkeys(found.kind.tolist()))
        for k, kind in enumerate(kinds):
            full = np.flatnonzero((found.kind == kind) & (found.weight >= 1.0))
            full = full[_thinned(full.size)]
            axes.plot(seconds[full], size[full], ".", markersize=2.5, color=f"C{k}", label=kind, alpha=0.6)
        for rows, colour, mark, label in (
            ((found.weight > 0) & (found.weight < 1), _DOWN, "x", "down-weighted"),
            (found.weight <= 0, _REFUSED, "X", "refused"),
        ):
            if rows.any():
                axes.plot(seconds[rows], size[rows], mark, color=colour, markersize=5, label=f"{label}: {rows.sum()}")
        axes.set_yscale("log")
        high = 10.0 ** (np.log10(max(float(size.max()), 2.0)) * 1.35 + 0.3)
        axes.set_ylim(0.01, high)
    axes.axhline(1.0, color=_INK, linewidth=0.6)
    _over_time(axes, axis, "|innovation| / its σ", "Innovations: measured against predicted", columns=4)


def _draw_states(axes: Axes, s: Solution, axis: _Axis, name: str) -> None:
    """Draw a bias of the IMU's three axes with its 1 σ as a band, in the units of data sheets."""
    key = next((k for k in s.states if k.startswith(name)), None)
    scale, unit, title = {
        "gyro_bias": (np.degrees(1.0) * 3600.0, "°/h", "Bias of the gyroscopes"),
        "accel_bias": (1000.0 / STANDARD_GRAVITY_M_PER_S2, "mg", "Bias of the accelerometers"),
    }[name]
    if key is not None:
        value, sigma = (scale * x.reshape(len(x), -1) for x in s.states[key])
        seconds = axis.seconds(s.state_epochs_gps_ns)
        for k in range(value.shape[1]):
            colour = _AXIS_COLOURS[k % 3]
            axes.fill_between(
                seconds, value[:, k] - sigma[:, k], value[:, k] + sigma[:, k], color=colour, alpha=0.2, linewidth=0
            )
            axes.plot(seconds, value[:, k], color=colour, linewidth=1.0, label=f"IMU {'xyz'[k]}")
    _over_time(axes, axis, f"{unit}, band: 1 σ", title)


def _draw_odometer(axes: Axes, s: Solution, axis: _Axis) -> None:
    """Draw the scale of the odometer with its σ; without one, the speed."""
    key = next((k for k in s.states if k.startswith("odometer_scale")), None)
    if key is None:
        thin = _thinned(s.epochs_gps_ns.size)
        speed = np.linalg.norm(s.velocity_ned_m_per_s[thin], axis=1)
        axes.plot(axis.seconds(s.epochs_gps_ns[thin]), speed, color=_AXIS_COLOURS[0], linewidth=0.9, label="speed")
        _over_time(axes, axis, "m/s", "Speed (the run has no odometer)")
        return
    value, sigma = (x.reshape(-1) for x in s.states[key])
    seconds = axis.seconds(s.state_epochs_gps_ns)
    axes.fill_between(seconds, value - sigma, value + sigma, color=_AXIS_COLOURS[0], alpha=0.2, linewidth=0)
    text = f"at the end {value[-1]:.5f} ± {sigma[-1]:.5f}"
    axes.plot(seconds, value, color=_AXIS_COLOURS[0], linewidth=1.0, label=text)
    _over_time(axes, axis, "1, band: 1 σ", "Scale of the odometer")


def _lines(axes: Axes, seconds: Float64, values: Float64, names: Sequence[str]) -> None:
    for k, name in enumerate(names):
        label = f"{name}: median {np.median(values[:, k]):.3g}, worst {values[:, k].max():.3g}"
        axes.plot(seconds, values[:, k], color=_AXIS_COLOURS[k], linewidth=0.9, label=label)


def _logarithmic(axes: Axes, values: Float64) -> None:
    """Set a logarithmic axis with room for the legend above."""
    axes.set_yscale("log")
    known = values[np.isfinite(values) & (values > 0)]
    if known.size:
        low, high = float(known.min()) / 1.3, float(known.max()) * 1.3
        axes.set_ylim(low, high * (high / low) ** 0.25)


def _over_time(axes: Axes, axis: _Axis, unit: str, title: str, *, columns: int = 3, utc: bool = False) -> None:
    for a, b in axis.outages_s:
        axes.axvspan(a, b, color=_SHADE, zorder=0, linewidth=0)
    axes.set_xlim(0.0, (axis.end_gps_ns - axis.begin_gps_ns) / NS_PER_S)
    axes.set_xlabel(f"s since {iso_from_gps_ns(axis.begin_gps_ns)[:23].rstrip('Z')} UTC", fontsize=8)
    axes.set_ylabel(unit, fontsize=8)
    _finish(axes, title, columns)
    if utc:
        above = axes.secondary_xaxis("top")
        above.xaxis.set_major_formatter(lambda s, _: _clock(axis.begin_gps_ns, s))
        above.tick_params(labelsize=7)
        above.set_xlabel("UTC", fontsize=7)


def _clock(begin_gps_ns: int, seconds: float) -> str:
    return iso_from_gps_ns(begin_gps_ns + round(seconds * NS_PER_S))[11:19]


def _finish(axes: Axes, title: str, columns: int = 1) -> None:
    axes.set_title(title, fontsize=9, loc="left")
    axes.tick_params(labelsize=8, which="both")
    axes.grid(color="#e6e6e6", linewidth=0.6)
    axes.set_axisbelow(True)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=7, ncols=columns, loc="best", framealpha=0.85)


def _qualities(quality: npt.NDArray[np.str_]) -> list[str]:
    """Return the kinds of solution, the best first."""
    kinds = set(quality.tolist())
    known = [name for name in QUALITY_COLOURS if name in kinds]
    return known + sorted(kinds - set(known))


def _colour(quality: str) -> str:
    return QUALITY_COLOURS.get(quality, OTHER_COLOUR)


def _thinned(count: int) -> Int64:
    """Return the rows that are drawn of this many."""
    return (
        np.unique(np.linspace(0, count - 1, min(count, _MOST_POINTS)).astype(np.int64))
        if count
        else np.zeros(0, np.int64)
    )
