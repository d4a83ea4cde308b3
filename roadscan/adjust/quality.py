"""Figures of accuracy: absolute, leave-one-out, relative between passes; and their picture before and after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from roadscan.adjust.adjustment import ControlErrors
from roadscan.compute.array_types import Float64, Int64
from roadscan.core.canvas import empty_figure
from roadscan.core.errors import ConfigError

if TYPE_CHECKING:
    from matplotlib.axes import Axes


NSSDA_VERTICAL: Final = 1.9600
"""Ratio of the 95 % quantile of normal errors to the RMSE (FGDC-STD-007.3-1998, 3.2.1 and appendix 3-A)."""
NSSDA_HORIZONTAL: Final = 1.7308
"""The same for a length in the plane whose two components are equally accurate (ibid.)."""
NSSDA_CHECK_POINTS: Final = 20
"""Least number of check points for a statement of NSSDA (ibid., 3.2.2)."""
ASPRS_CHECK_POINTS: Final = 30
"""With fewer check points there is no statement after ASPRS (2023, 7.12); the figures are computed all the same."""
DISTANCES_M: Final = (0.0, 25.0, 50.0, 100.0, 200.0, 400.0, 800.0, 1600.0, float("inf"))
"""Bounds of the classes of distance to the nearest ground control."""
_DOWN: Final = 2  # Index of the component down.


@dataclass(frozen=True)
class VerticalAccuracy:
    """Accuracy of heights (m)."""

    count: int
    mean: float
    mean_absolute: float
    standard_deviation: float
    """About the mean, n − 1."""
    rmse: float
    largest: float
    """Largest absolute error."""
    nssda_95: float
    """Accuracy_z of NSSDA: 1.9600 RMSE_z."""
    asprs_rmse: float
    """RMSE_V of ASPRS (2023): with the σ of the check points' survey."""


@dataclass(frozen=True)
class HorizontalAccuracy:
    """Accuracy of places in the plane (m)."""

    count: int
    mean_north: float
    mean_east: float
    mean_absolute: float
    """Mean length of the errors."""
    rmse_north: float
    rmse_east: float
    rmse_r: float
    """√(RMSE_north² + RMSE_east²)."""
    nssda_95: float
    """Accuracy_r of NSSDA: 1.7308 RMSE_r."""
    asprs_rmse: float
    """RMSE_H of ASPRS (2023): with the σ of the check points' survey."""


def vertical_accuracy(
    error_m: Float64, survey_sigma_m: npt.ArrayLike = 0.0, point: Int64 | None = None
) -> VerticalAccuracy:
    """Returns the accuracy of heights.

    Parameters
    ----------
    error_m : (n,) surface minus survey; NaN where there is none.
    survey_sigma_m : 1 σ of the check points' heights, one value or (n,).
    point : (n,) number of the point of each error, where passes saw a point several times: it counts once, with the
        mean of its errors, of their sizes and of their squares.

    Raises
    ------
    ConfigError
        where there is no error at all.

    Notes
    -----
    ASPRS Positional Accuracy Standards, edition 2 (2023): RMSE_V = √(RMSE_V1² + RMSE_V2²), of the fit to the check
    points and of their survey.
    """
    there = np.asarray(np.isfinite(error_m), dtype=bool)
    error, survey = _there(error_m, there), np.broadcast_to(survey_sigma_m, error_m.shape)[there]
    count, share = _shares(error.shape[0], None if point is None else point[there])
    rmse, mean = _rms(error, share), float(share @ error)
    spread = max(rmse**2 - mean**2, 0.0)
    deviation = float(np.sqrt(spread * count / (count - 1))) if count > 1 else float("nan")
    return VerticalAccuracy(
        count, mean, float(share @ np.abs(error)), deviation, rmse,
        float(np.abs(error).max()), NSSDA_VERTICAL * rmse, float(np.hypot(rmse, _rms(survey, share))),
    )  # fmt: skip


def horizontal_accuracy(
    error_m: Float64, survey_sigma_m: npt.ArrayLike = 0.0, point: Int64 | None = None
) -> HorizontalAccuracy:
    """Returns the accuracy of places in the plane.

    Parameters
    ----------
    error_m : (n, 2) north and east, surface minus survey; NaN where there is none.
    survey_sigma_m : 1 σ of each coordinate of the check points' survey, one value, (n, 1) or (n, 2).
    point : as of :func:`vertical_accuracy`.

    Raises
    ------
    ConfigError
        where there is no error at all.

    Notes
    -----
    Accuracy_r of NSSDA holds for RMSE_north = RMSE_east; where the smaller is above 0.6 of the larger it errs by
    little (FGDC-STD-007.3-1998, appendix 3-A, case 2). RMSE_H of ASPRS (2023) is composed as RMSE_V.
    """
    there = np.asarray(np.isfinite(error_m).all(axis=1), dtype=bool)
    error, survey = _there(error_m, there), np.broadcast_to(survey_sigma_m, error_m.shape)[there]
    count, share = _shares(len(error), None if point is None else point[there])
    north, east = _rms(error[:, 0], share), _rms(error[:, 1], share)
    of_survey = float(np.hypot(_rms(survey[:, 0], share), _rms(survey[:, 1], share)))
    rmse_r = float(np.hypot(north, east))
    return HorizontalAccuracy(
        count, float(share @ error[:, 0]), float(share @ error[:, 1]), float(share @ np.hypot(*error.T)),
        north, east, rmse_r, NSSDA_HORIZONTAL * rmse_r, float(np.hypot(rmse_r, of_survey)),
    )  # fmt: skip


@dataclass(frozen=True)
class LeaveOneOut:
    """Survey of each control point against the adjustment without it; accuracy None where not observed."""

    vertical: VerticalAccuracy | None
    horizontal: HorizontalAccuracy | None
    normalised: Float64
    """(c, 3) north, east, down over their σ: standard normal where all is as stated; NaN where not observed."""


def leave_one_out(control: ControlErrors) -> LeaveOneOut:
    """Returns the accuracy by leaving out one control coordinate at a time, all from the same adjustment.

    Surveys that were found wrong are left out of the figures, not of `normalised`.
    """
    kept = np.where(control.weight > 0.0, control.left_out_m, np.nan)
    # Down is the height's negative; errors are surface minus survey.
    upright, level = kept[:, _DOWN], -kept[:, :_DOWN]
    return LeaveOneOut(
        vertical_accuracy(upright) if np.isfinite(upright).any() else None,
        horizontal_accuracy(level) if np.isfinite(level).all(axis=1).any() else None,
        control.left_out_m / np.where(control.left_out_sigma_m > 0.0, control.left_out_sigma_m, np.nan),
    )


@dataclass(frozen=True)
class Sections:
    """Figures of s sections of a road."""

    first_station_m: Float64
    """(s,) station of the beginning of each section."""
    count: Int64
    """(s,) number of differences; no section is empty."""
    rms_before_m: Float64
    """(s,) of the differences between passes before the adjustment."""
    rms_after_m: Float64
    """(s,) after it."""


def relative_accuracy(station_m: Float64, before_m: Float64, after_m: Float64, length_m: float = 100.0) -> Sections:
    """Returns how well passes agree, by section of the road.

    Parameters
    ----------
    station_m : (n,) where each difference was found, along the road.
    before_m, after_m : (n,) difference of two passes before and after the adjustment; where some were withheld from
        it, those are the better test.
    length_m : of a section.
    """
    number = np.floor(station_m / length_m).astype(np.int64)
    sections, own = np.unique(number, return_inverse=True)
    count = np.bincount(own, minlength=sections.size)
    before, after = (np.sqrt(np.bincount(own, v**2, minlength=sections.size) / count) for v in (before_m, after_m))
    first = sections.astype(np.float64) * length_m
    return Sections(first, count.astype(np.int64), before.astype(np.float64), after.astype(np.float64))


@dataclass(frozen=True)
class DistanceClass:
    """Accuracy of heights at points in one class of distance from ground control."""

    from_m: float
    to_m: float
    """Infinite in the last class."""
    mean_distance_m: float
    accuracy: VerticalAccuracy


def accuracy_by_distance(distance_m: Float64, error_m: Float64, point: Int64 | None = None) -> list[DistanceClass]:
    """Returns the error of heights by distance to ground control, for each class with a point.

    Parameters
    ----------
    distance_m : (n,) along the road to the nearest ground control that counts; NaN where there is none.
    error_m : (n,) surface minus survey; NaN where there is none.
    point : as of :func:`vertical_accuracy`.
    """
    known = np.isfinite(distance_m) & np.isfinite(error_m)
    number = np.searchsorted(np.array(DISTANCES_M), distance_m, side="right") - 1
    found = []
    for k in np.unique(number[known]).tolist():
        own = known & (number == k)
        mean = float(distance_m[own].mean())
        accuracy = vertical_accuracy(error_m[own], point=None if point is None else point[own])
        found.append(DistanceClass(DISTANCES_M[k], DISTANCES_M[k + 1], mean, accuracy))
    return found


def nearest_m(station_m: Float64, point: Int64, control_m: Float64, control: Int64) -> Float64:
    """Distance (n,) of points at stations to the nearest of other control points, all of one run (m), or NaN.

    point : (n,) number of each; control_m, control : stations and numbers (c,) of the control; no point is its own.
    """
    away = np.abs(station_m[:, None] - control_m)
    away = np.where(point[:, None] == control, np.inf, away).min(axis=1, initial=np.inf)
    return np.where(np.isfinite(away), away, np.nan)


def _there(error_m: Float64, there: npt.NDArray[np.bool_]) -> Float64:
    if not there.any():
        raise ConfigError("no check point has an error", expected="at least one with a height or a place")
    return error_m[there]


def _shares(size: int, point: Int64 | None) -> tuple[int, Float64]:
    """Returns the number of points, and the weight (n,) of each error in their mean: all points count alike."""
    if point is None:
        return size, np.full(size, 1.0 / size)
    _, own, seen = np.unique(point, return_inverse=True, return_counts=True)
    return seen.size, 1.0 / (seen.size * seen[own.ravel()])


def _rms(values: Float64, share: Float64) -> float:
    return float(np.sqrt(share @ values**2))


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
