"""Rows of an adjustment's tables: its evidence and its accuracy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from roadscan.adjust.control.control import Sighting, moved_m
from roadscan.adjust.control.control_test import HEIGHT
from roadscan.adjust.observations import KINDS
from roadscan.adjust.places import Track
from roadscan.adjust.quality import (
    DistanceClass,
    HorizontalAccuracy,
    VerticalAccuracy,
    accuracy_by_distance,
    horizontal_accuracy,
    nearest_m,
    relative_accuracy,
    vertical_accuracy,
)
from roadscan.adjust.tasks.publication import left_after
from roadscan.adjust.tasks.solution import Evidence, Solution
from roadscan.compute.array_types import Float64, Int64
from roadscan.compute.ways import way_along
from roadscan.poses.movement import MountingChange
from roadscan.poses.trajectory import Corrections

Rows = list[dict[str, Any]]
Held = Mapping[str, Corrections]
_AT_THEIR_PLACE: Final = ("found", "picked")
"""A check point whose target lies elsewhere than surveyed does not show the poses' error in the plane."""


def tie_rows(evidence: Evidence, solution: Solution, held: Held, mounted: Float64) -> Rows:
    """Returns rows of the table `tie_residuals`; mounted : (s, 7) corrections of the mountings."""
    ties = evidence.ties
    after = left_after(ties.observations, held, evidence.runs, mounted)
    names = ("place", "kind", "first_run", "second_run", "easting_m", "northing_m", "accepted", "sigma_m")
    columns = {name: np.asarray(ties.columns[name]).tolist() for name in names}
    columns |= {"before_m": ties.observations.observed_m.tolist(), "after_m": after.tolist()}
    columns["weight"] = solution.tie_weight.tolist()
    return _rows(columns)


def relative_rows(evidence: Evidence, tracks: Sequence[Track], held: Held, mounted: Float64) -> Rows:
    """Returns rows of the table `relative_accuracy`: ties that passed their tests, by section of the first end's run.

    Ties by hand, which are few, are not of them.
    """
    ties = evidence.ties
    own = ties.accepted & (ties.observations.kind != KINDS.index("hand_tie"))
    observations = ties.observations.chosen(own)
    after = left_after(observations, held, evidence.runs, mounted)
    kinds = np.asarray(ties.columns["kind"])[own]
    rows: Rows = []
    for number in np.unique(observations.run[:, 0]).tolist():
        track = next(t for t in tracks if t.run == number)
        at = _station_m(track, observations.epoch_gps_ns[:, 0])
        for kind in sorted(set(kinds.tolist())):
            here = (observations.run[:, 0] == number) & (kinds == kind)
            if not here.any():
                continue
            sections = relative_accuracy(at[here], observations.observed_m[here], after[here])
            columns = {
                "first_station_m": sections.first_station_m.tolist(),
                "count": sections.count.tolist(),
                "rms_before_m": sections.rms_before_m.tolist(),
                "rms_after_m": sections.rms_after_m.tolist(),
            }
            rows += [{"run": evidence.runs[number], "kind": kind, **row} for row in _rows(columns)]
    return rows


def _station_m(track: Track, epochs_gps_ns: Int64) -> Float64:
    """Returns the stations (n,) of a run along its path at some epochs."""
    station = way_along(np.stack([track.easting_m, track.northing_m], axis=-1))
    since = (epochs_gps_ns - track.epoch_gps_ns[0]).astype(np.float64)
    return np.asarray(np.interp(since, (track.epoch_gps_ns - track.epoch_gps_ns[0]).astype(np.float64), station))


def distance_rows(rows: Rows, evidence: Evidence, solution: Solution, tracks: Sequence[Track]) -> Rows:
    """Returns rows of the table `accuracy_by_distance`, from rows of `control_residuals`.

    A check point counts once, with the mean of what the passes say of it. Where all runs are adjusted together, a
    control point that is left out counts once, in the first run that saw it.
    """
    seen = [row for row in rows if row["height_before_m"] is not None]
    tracked = {track.run: track for track in reversed(tracks)}
    found: dict[str, list[tuple[float, float, float]]] = {"check": [], "left_out": []}
    counted: dict[tuple[int, int], int] = {}
    for number, run in enumerate(evidence.runs):
        own = [row for row in seen if row["run"] == run]
        if not own or number not in tracked:
            continue
        points = np.array([row["point"] for row in own], np.int64)
        station = _station_m(tracked[number], np.array([row["epoch_gps_ns"] for row in own], np.int64))
        control = np.array([(row.get("weight_height") or 0.0) > 0.0 for row in own], bool)
        away = nearest_m(station, points, station[control], points[control]).tolist()
        for row, distance_m in zip(own, away, strict=True):
            if row["role"] == "check":
                found["check"].append((distance_m, -row["height_after_m"], row["point"]))
                continue
            key = (row["point"], -1 if (row["point"], -1) in solution.points else number)
            left = row.get("left_out_height_m")
            if left is not None and (row.get("weight_height") or 0.0) > 0.0 and key not in counted:
                counted[key] = len(counted)
                found["left_out"].append((distance_m, -left, counted[key]))
    return [
        {
            "points": points, "from_m": one.from_m, "to_m": one.to_m if np.isfinite(one.to_m) else None,
            "count": one.accuracy.count, "mean_distance_m": one.mean_distance_m, "mean_m": one.accuracy.mean,
            "mean_absolute_m": one.accuracy.mean_absolute, "rmse_m": one.accuracy.rmse,
        }
        for points, rows_of in found.items()
        for one in _by_distance(np.array(rows_of).reshape(-1, 3))
    ]  # fmt: skip


def _by_distance(rows: Float64) -> list[DistanceClass]:
    """Returns classes of rows (n, 3): distance, error, number of the point."""
    return accuracy_by_distance(rows[:, 0], rows[:, 1], rows[:, 2].astype(np.int64))


def control_rows(evidence: Evidence, solution: Solution, held: Held, mounted: Float64) -> Rows:
    """Returns rows of the table `control_residuals`; mounted : (s, 7) corrections of the mountings."""
    return [_control_row(one, evidence, solution, held, mounted) for one in evidence.sightings]


def of_points(rows: Rows, evidence: Evidence) -> Rows:
    """Returns rows of `control_residuals` of points, without those of surveyed lines."""
    return [row for row, one in zip(rows, evidence.sightings, strict=True) if not one.point.is_of_line]


def _control_row(
    one: Sighting, evidence: Evidence, solution: Solution, held: Held, mounted: Float64
) -> dict[str, Any]:  # fmt: skip
    point, run = one.point, evidence.runs[one.run]
    seen_by = evidence.seen_by(one)
    mounting = None if seen_by.number < 0 else (MountingChange.of(mounted[seen_by.number]), seen_by.seat)
    moved = moved_m(one, held.get(run), mounting)
    height = point.height_m - one.height_m
    east, north = point.easting_m - one.easting_m, point.northing_m - one.northing_m
    own = solution.point(point.number, one.run) if point.role == "gcp" else None
    numbers: dict[str, float] = {
        "height_before_m": height,
        "height_after_m": height - moved[2],
        "sigma_height_m": float(np.hypot(one.sigma_height_m, point.sigma_height_m)),
        "easting_before_m": east,
        "easting_after_m": east - moved[0],
        "northing_before_m": north,
        "northing_after_m": north - moved[1],
        "sigma_horizontal_m": float(np.hypot(np.sqrt(np.trace(one.covariance_m2) / 2), point.sigma_horizontal_m)),
    }
    if own is not None:
        numbers |= {
            "weight_height": own.weight_height,
            "weight_horizontal": own.weight_horizontal,
            "left_out_height_m": own.left_out_height_m,
            "left_out_sigma_m": float(own.left_out_sigma_m[2]),
        }
    refused = (
        []
        if own is None
        else [w for w, x in (("height", own.weight_height), ("place", own.weight_horizontal)) if x == 0.0]
    )
    named: dict[str, Any] = {
        "point": point.number, "name": point.name, "role": point.role, "run": run, "epoch_gps_ns": one.epoch_gps_ns,
        "easting_m": point.easting_m, "northing_m": point.northing_m, "status": one.status,
        "why_not": one.why_not or (f"all else contradicts its {' and its '.join(refused)}" if refused else ""),
    }  # fmt: skip
    return named | {name: float(value) if np.isfinite(value) else None for name, value in numbers.items()}


def accuracy_rows(rows: Rows, evidence: Evidence, solution: Solution) -> Rows:
    """Returns rows of the table `absolute_accuracy`, from rows of `control_residuals`."""
    found: Rows = []
    checks = [(row, one) for row, one in zip(rows, evidence.sightings, strict=True)
              if row["role"] == "check" and not one.point.is_of_line]  # fmt: skip
    for poses, word in (("recorded", "before"), ("adjusted", "after")):
        upright = [
            (-row[f"height_{word}_m"], one.point.sigma_height_m, row["point"])
            for row, one in checks
            if row[f"height_{word}_m"] is not None
        ]
        if upright:
            errors, sigmas, points = np.array(upright).T
            found.append(_accuracy("check", "height", poses, vertical_accuracy(errors, sigmas, points)))
        level = [
            (-row[f"northing_{word}_m"], -row[f"easting_{word}_m"], one.point.sigma_horizontal_m, row["point"])
            for row, one in checks
            if row["status"] in _AT_THEIR_PLACE
        ]
        if level:
            places = np.array(level)
            accuracy = horizontal_accuracy(places[:, :2], places[:, 2:3], places[:, 3])
            found.append(_accuracy("check", "horizontal", poses, accuracy))
    left = solution.left_out
    if left is not None and left.vertical is not None:
        found.append(_accuracy("left_out", "height", "adjusted", left.vertical))
    if left is not None and left.horizontal is not None:
        found.append(_accuracy("left_out", "horizontal", "adjusted", left.horizontal))
    control = {one.point.number for one in evidence.sightings if one.point.role == "gcp" and not one.point.is_of_line}
    for name, (away, sigma) in solution.datum.items():
        found.append(
            {
                "points": "datum", "component": "height" if name == HEIGHT else "horizontal", "poses": "adjusted",
                "count": len(control),
                "mean_m": away, "mean_absolute_m": abs(away), "rmse_m": sigma, "largest_m": None, "nssda_95_m": None,
                "asprs_rmse_m": None,
            }
        )  # fmt: skip
    return found


def _accuracy(
    points: str, component: str, poses: str, figures: VerticalAccuracy | HorizontalAccuracy
) -> dict[str, Any]:  # fmt: skip
    named = {"points": points, "component": component, "poses": poses, "count": figures.count}
    if isinstance(figures, VerticalAccuracy):
        own = {"mean_m": figures.mean, "rmse_m": figures.rmse, "largest_m": figures.largest}
    else:
        own = {"mean_m": float(np.hypot(figures.mean_north, figures.mean_east)), "rmse_m": figures.rmse_r}
    return {
        **named, **own, "mean_absolute_m": figures.mean_absolute, "nssda_95_m": figures.nssda_95,
        "asprs_rmse_m": figures.asprs_rmse,
    }  # fmt: skip


def _rows(columns: Mapping[str, list[Any]]) -> Rows:
    names = list(columns)
    return [dict(zip(names, row, strict=True)) for row in zip(*columns.values(), strict=True)]
