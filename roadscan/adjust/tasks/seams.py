"""Seams, the surfaces of two passes at one place before and after the adjustment, and which of them are drawn."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from roadscan.adjust.observations import KINDS
from roadscan.adjust.patches import PassReadings, Patch, map_from_level, patch_of
from roadscan.adjust.places import Place, Traverse
from roadscan.adjust.seams_picture import ShownSeam
from roadscan.adjust.tasks.figures import Held
from roadscan.adjust.tasks.near import Circle, NearReader
from roadscan.adjust.tasks.solution import Evidence, Solution
from roadscan.adjust.tasks.tie_work import DIAGONAL, TieTask
from roadscan.adjust.tie_settings import TieSettings
from roadscan.adjust.ties.tie import HEIGHT
from roadscan.compute.array_types import Float64
from roadscan.georeference.sources import MountingChanges, change_of
from roadscan.poses.movement import MountingChange, Seat
from roadscan.poses.trajectory import Corrections
from roadscan.run.engine.compute import Compute, reason_of

_CHOSEN: Final = ("the worst seam before", "a typical seam")


@dataclass(frozen=True)
class SeamTask:
    """A place and the two passes that are compared there."""

    chosen: str
    """Why it was chosen."""
    ties: TieTask
    place: Place
    ends: tuple[Traverse, Traverse]
    corrections: tuple[Corrections | None, Corrections | None]
    mountings: tuple[tuple[MountingChange, Seat] | None, tuple[MountingChange, Seat] | None]
    """Correction of the mounting of each sensor, and its lever arm."""


def shown_seams(
    tasks: Sequence[TieTask],
    evidence: Evidence,
    solution: Solution,
    held: tuple[Held, MountingChanges],
    compute: Compute,
) -> tuple[list[ShownSeam], list[str]]:
    """Returns the chosen seams, and why one is missing where its readings could not be read.

    held : current corrections of runs, and of mountings.
    """
    wanted = list(seam_tasks(tasks, evidence, solution, *held))
    found: dict[str, ShownSeam] = {}
    notes: list[str] = []
    for done in compute.map(view_seam, wanted):
        if done.error is not None:
            notes.append(f"{done.task.chosen}, place {done.task.place.number}, is not drawn: {reason_of(done.error)}")
        elif done.result is not None:
            found[done.task.chosen] = _shown(done.task, done.result)
    return [found[name] for name in _CHOSEN if name in found], notes


def seam_tasks(
    tasks: Sequence[TieTask],
    evidence: Evidence,
    solution: Solution,
    held: Held,
    changes: MountingChanges,
) -> Iterator[SeamTask]:
    """Yields the height tie that differed most of those that count, and the one of median size."""
    observations, columns = evidence.ties.observations, evidence.ties.columns
    counting = (observations.kind == KINDS.index(HEIGHT)) & (solution.tie_weight > 0.0)
    rows = np.flatnonzero(counting)
    order = rows[np.lexsort((rows, observations.place[rows], np.abs(observations.observed_m[rows])))]
    chosen = dict.fromkeys([int(order[-1]), int(order[(order.size - 1) // 2])]) if order.size else {}
    places = {place.number: (task, place) for task in tasks for place in task.places}
    for name, row in zip(_CHOSEN, chosen, strict=False):
        task, place = places[int(observations.place[row])]
        ends = [
            next(
                t for t in place.traverses
                if t.run == observations.run[row, end] and t.sensor == columns[f"{word}_sensor"][row]
                and t.first_gps_ns <= observations.epoch_gps_ns[row, end] <= t.last_gps_ns
            )
            for end, word in enumerate(("first", "second"))
        ]  # fmt: skip
        first, second = (held.get(evidence.runs[one.run]) for one in ends)
        one, other = (_mounting(evidence, end, changes) for end in ends)
        yield SeamTask(name, task, place, (ends[0], ends[1]), (first, second), (one, other))


def _mounting(evidence: Evidence, end: Traverse, changes: MountingChanges) -> tuple[MountingChange, Seat] | None:
    run = evidence.runs[end.run]
    change = change_of(changes, run, end.sensor)
    if change is None:
        return None
    return change, evidence.mounted.seat(run, end.sensor, end.first_gps_ns)


def view_seam(task: SeamTask) -> SeamView | None:
    """Read both passes near the place and compare them (runs on a worker)."""
    place = task.place
    reader = NearReader(task.ties.store, task.ties.ground, task.ties.files, task.ties.runs)
    circle = Circle(place.easting_m, place.northing_m, DIAGONAL * place.radius_m)
    readings = reader.of(task.ends[0], circle), reader.of(task.ends[1], circle)
    return seam_view(place, readings, task.corrections, task.ties.settings, task.mountings)


def _shown(task: SeamTask, view: SeamView) -> ShownSeam:
    runs = [task.ties.runs[one.run] for one in task.ends]
    names = runs if runs[0] != runs[1] else [f"{runs[0]}, {word}" for word in ("first", "then")]
    before, after = (f"{1e3 * value:+.2f} mm" for value in view.median_m)
    title = (
        f"{task.chosen}: place {task.place.number} at {task.place.easting_m:,.1f}, {task.place.northing_m:,.1f}; "
        f"{names[1]} minus {names[0]}: median {before} before, {after} after"
    )
    return ShownSeam(title, (names[0], names[1]), view.cell_m, view.difference_m, view.across_m, view.section_m)


_SECTION: Final = 0.2
"""Share of the patch, about its middle, whose rows are averaged to a cross-section."""


@dataclass(frozen=True)
class SeamView:
    """Two passes at a place, before and after."""

    cell_m: float
    difference_m: Float64
    """(2, k, k) height of the second pass minus that of the first, before and after; rows along, columns across, NaN in
    cells that one of them did not see."""
    across_m: Float64
    """(k,) middles of the columns, positive to the right."""
    section_m: Float64
    """(2, 2, k) cross-sections, before and after, of the first and the second pass, above one plane; NaN as above."""

    @property
    def median_m(self) -> tuple[float, float]:
        """Returns the median difference before and after."""
        before, after = (float(np.nanmedian(d)) for d in self.difference_m)
        return before, after


def seam_view(
    place: Place,
    readings: tuple[PassReadings, PassReadings],
    corrections: tuple[Corrections | None, Corrections | None],
    settings: TieSettings,
    mountings: tuple[tuple[MountingChange, Seat] | None, tuple[MountingChange, Seat] | None] = (None, None),
) -> SeamView | None:
    """Returns both passes at a place, without and with their corrections; None where they have no cell in common."""
    states = [readings, tuple(moved(*one) for one in zip(readings, corrections, mountings, strict=True))]
    patches = [[patch_of(place, r, settings.cell_m, settings.least_readings) for r in pair] for pair in states]
    known = [[p for p in pair if p is not None] for pair in patches]
    if any(len(pair) < 2 for pair in known):
        return None
    difference = np.stack([second.height_m - first.height_m for first, second in known])
    if not np.isfinite(difference).any(axis=(1, 2)).all():
        return None
    plane = _plane(known[1])
    sections = np.array([[_section(p.height_m - plane) for p in pair] for pair in known])
    return SeamView(settings.cell_m, difference, known[0][0].middle_m, sections)


def moved(
    readings: PassReadings, corrections: Corrections | None, mounting: tuple[MountingChange, Seat] | None = None
) -> PassReadings:
    """Returns the readings of a traverse with corrected poses; corrections are small, so turns are linear.

    mounting : change of that of the sensor, with lever arm and beams.
    """
    if (corrections is None and mounting is None) or not readings.pose.size:
        return readings
    points = np.stack([readings.easting_m, readings.northing_m, readings.height_m], axis=-1)
    pose = readings.pose.astype(np.int64)
    arm, level = readings.arm_body_m(points, pose), np.zeros(points.shape)
    if corrections is not None:
        shift, turn = corrections.at(readings.epoch_gps_ns)
        swung = np.cross(turn[pose], arm)
        level = level + shift[pose] + np.einsum("nij,nj->ni", readings.level_from_body[pose], swung)
    if mounting is not None:
        level = level + mounting[0].moves_level(readings.level_from_body[pose], arm, mounting[1])
    there = points + map_from_level(level, readings.convergence_rad)
    easting, northing, height = (np.ascontiguousarray(there[:, k]) for k in range(3))
    return replace(readings, easting_m=easting, northing_m=northing, height_m=height)


def _plane(pair: list[Patch]) -> Float64:
    """Returns the plane (k, k) through the cells of two passes."""
    middle = pair[0].middle_m
    row, column = np.nonzero(np.isfinite(np.stack([p.height_m for p in pair])).any(axis=0))
    height = np.nanmean(np.stack([p.height_m[row, column] for p in pair]), axis=0)
    design = np.stack([np.ones(row.size), middle[row], middle[column]], axis=-1)
    level = float(height.mean())
    plane, *_ = np.linalg.lstsq(design, height - level, rcond=None)
    return np.asarray(level + plane[0] + plane[1] * middle[:, None] + plane[2] * middle)


def _section(height_m: Float64) -> Float64:
    """Returns the mean (k,) over the rows about the middle; NaN in columns that were not seen there."""
    edge = len(height_m)
    half = max(round(0.5 * _SECTION * edge), 1)
    rows = height_m[edge // 2 - half : edge // 2 + half]
    count = np.isfinite(rows).sum(axis=0)
    return np.where(count > 0, np.nansum(rows, axis=0) / np.maximum(count, 1), np.nan)
