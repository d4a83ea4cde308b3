"""Seams that are drawn: the place where two passes differed most before the adjustment, and a typical one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.adjust.observations import KINDS
from roadscan.adjust.places import Place, Traverse
from roadscan.adjust.seams import SeamView, seam_view
from roadscan.adjust.seams_picture import ShownSeam
from roadscan.adjust.tasks.figures import Held
from roadscan.adjust.tasks.near import Circle, NearReader
from roadscan.adjust.tasks.solution import Evidence, Solution
from roadscan.adjust.tasks.tie_work import DIAGONAL, TieTask
from roadscan.adjust.ties.tie import HEIGHT
from roadscan.georeference.sources import MountingChanges, change_of
from roadscan.poses.mounting_change import MountingChange, Seat
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
