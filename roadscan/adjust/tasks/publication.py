"""The table `corrections`: from a solution to its rows; those that move no pose stay bit-identical."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import pyarrow.compute as pc

from roadscan.adjust.control import Sighting, moved_m
from roadscan.adjust.control_test import HEIGHT
from roadscan.adjust.observations import COMPONENTS, KINDS, Observations
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
from roadscan.adjust.settings import AdjustConfig
from roadscan.adjust.tasks.solution import Evidence, Solution
from roadscan.compute.array_types import Float64, Int64
from roadscan.compute.arrays import way_along
from roadscan.navigation.tasks.trajectories import CORRECTION_SIGMAS, load_all_corrections
from roadscan.poses.trajectory import Corrections, MountingChange
from roadscan.store.small_tables import read_small, small_path, write_small
from roadscan.store.store import Store

_WRITER: Final = "adjust"


def foreign_runs(store: Store) -> set[str]:
    """Returns runs whose corrections another program wrote."""
    table = read_small(store, "corrections")
    if table is None:
        return set()
    if "written_by" not in table.column_names:
        return set(table.column("run").to_pylist())
    own = pc.fill_null(pc.equal(table.column("written_by"), _WRITER), False)
    return set(table.filter(pc.invert(own)).column("run").to_pylist())


def publish(store: Store, solved: Mapping[str, Corrections], config: AdjustConfig) -> dict[str, Corrections]:
    """Update the table with a solution; returns the current corrections of its runs.

    Runs that have no solution any more lose their corrections, those of other programs stay.
    """
    before, foreign = load_all_corrections(store), foreign_runs(store)
    after = {
        run: published(before.get(run), own, config.moved_m, config.moved_arm_m)
        for run, own in solved.items()
        if run not in foreign
    }
    kept = {run: own for run, own in before.items() if run in foreign}
    if not (after or kept):
        if store.exists(small_path("corrections")):
            store.remove(small_path("corrections"))
        return after
    same = after.keys() | kept.keys() == before.keys() and all(own is before.get(run) for run, own in after.items())
    if not same:
        rows = [row for run, own in sorted(after.items()) for row in _rows(run, own, _WRITER)]
        rows += [row for run, own in sorted(kept.items()) for row in _rows(run, own, None)]
        write_small(store, "corrections", rows)
    return after


def digests_of(store: Store) -> list[str]:
    """Returns digests of the tables `corrections` and `mounting_corrections` as they are; "" without one."""
    paths = [small_path(name) for name in ("corrections", "mounting_corrections")]
    return [hashlib.blake2b(store.read_bytes(p), digest_size=8).hexdigest() if store.exists(p) else "" for p in paths]


def _rows(run: str, own: Corrections, writer: str | None) -> list[dict[str, Any]]:
    columns: dict[str, list[Any]] = {"epoch_gps_ns": own.epochs_gps_ns.tolist()}
    columns |= dict(zip(COMPONENTS[:3], own.north_east_down_m.T.tolist(), strict=True))
    columns |= dict(zip(COMPONENTS[3:], own.roll_pitch_heading_rad.T.tolist(), strict=True))
    if own.sigma is not None:
        columns |= dict(zip(CORRECTION_SIGMAS, own.sigma.T.tolist(), strict=True))
    return [{"run": run, "written_by": writer, **row} for row in _row_dicts(columns)]


_SAME_SIGMA: Final = 0.05
"""σ that differ by no more than this share are equal: evidence changes them a little with each new run."""


def published(before: Corrections | None, solved: Corrections, moved_m: float, arm_m: float) -> Corrections:
    """Corrections to publish: knots of the solution where it moves a pose by more than stated, else those before.

    Between knots corrections are linear, so nowhere do they depart from the solution by more than at a knot. Where the
    knots lie at other epochs, all are replaced. σ is always that of the solution, but for a few percent: what is
    doubted anew widens it, though no pose moves.

    Parameters
    ----------
    moved_m : shift and turn together (m).
    arm_m : a turn counts as the movement of a point so far from the body's origin (m).
    """
    if before is None or not np.array_equal(before.epochs_gps_ns, solved.epochs_gps_ns):
        return solved
    shift = np.linalg.norm(solved.north_east_down_m - before.north_east_down_m, axis=1)
    turn = np.linalg.norm(solved.roll_pitch_heading_rad - before.roll_pitch_heading_rad, axis=1)
    moved = shift + arm_m * turn > moved_m
    sigma = solved.sigma
    if sigma is not None and before.sigma is not None:
        same = np.isclose(sigma, before.sigma, rtol=_SAME_SIGMA, atol=0.0, equal_nan=True).all(axis=1)
        if not moved.any() and same.all():
            return before
        sigma = np.where((moved | ~same)[:, None], sigma, before.sigma)
    elif not moved.any() and (sigma is None) == (before.sigma is None):
        return before
    return Corrections(
        solved.epochs_gps_ns,
        np.where(moved[:, None], solved.north_east_down_m, before.north_east_down_m),
        np.where(moved[:, None], solved.roll_pitch_heading_rad, before.roll_pitch_heading_rad),
        sigma,
    )


def left_after(
    observations: Observations,
    corrections: Mapping[str, Corrections],
    runs: Sequence[str],
    mountings: Float64 | None = None,
) -> Float64:
    """Returns the residual (n,) of each observation once poses and mountings are corrected (m).

    runs are counted as in `runs`; mountings : (s, 7) what is added to those that `Observations.sensor` counts.
    """
    left = observations.observed_m.copy()
    for end in (0, 1) if mountings is not None and len(mountings) else ():
        here = np.flatnonzero(observations.sensor[:, end] >= 0)
        own = np.asarray(mountings)[observations.sensor[here, end]]
        left[here] -= np.einsum("ni,ni->n", observations.mount_partials[here, end], own)
    for number, run in enumerate(runs):
        own = corrections.get(run)
        if own is None:
            continue
        for end in (0, 1):
            here = np.flatnonzero(observations.run[:, end] == number)
            moved = np.concatenate(own.at(observations.epoch_gps_ns[here, end]), axis=1)
            left[here] -= np.einsum("ni,ni->n", observations.partials[here, end], moved)
    return left


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
    return _row_dicts(columns)


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
            rows += [{"run": evidence.runs[number], "kind": kind, **row} for row in _row_dicts(columns)]
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


def _row_dicts(columns: Mapping[str, list[Any]]) -> Rows:
    names = list(columns)
    return [dict(zip(names, row, strict=True)) for row in zip(*columns.values(), strict=True)]
