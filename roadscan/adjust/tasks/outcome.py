"""Tables and pictures of an adjustment, recorded in the manifest, and pairs of runs whose ties mostly fail."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.adjust.bundle.outcome import CameraResiduals, draw_residuals
from roadscan.adjust.observations import KINDS
from roadscan.adjust.places import (
    FEW_CELLS,
    HEIGHT,
    PLANE,
    SAME_PASS,
    SCATTERED,
    SHIFT,
    STEEP,
    TOO_FAR,
    TWO_SURFACES,
    PassReadings,
    Patch,
    Place,
    Traverse,
    map_from_level,
    patch_of,
)
from roadscan.adjust.quality import AdjustmentPicture, ShownSeam, draw_adjustment, draw_seams
from roadscan.adjust.settings import TieSettings
from roadscan.adjust.tasks.near import Circle, NearReader
from roadscan.adjust.tasks.publication import Held, Rows
from roadscan.adjust.tasks.solution import Evidence, Solution
from roadscan.adjust.tasks.tie_work import DIAGONAL, KnownTies, TieTask
from roadscan.compute.array_types import Float64
from roadscan.core.extras import can_draw
from roadscan.core.witness import Finding, Witness
from roadscan.georeference.sources import MountingChanges, change_of
from roadscan.navigation.tasks.recorded_pictures import NOT_DRAWN, keep_file
from roadscan.poses.trajectory import Corrections, MountingChange, Seat
from roadscan.run.engine.compute import Compute, reason_of
from roadscan.run.keys import key_of
from roadscan.store.codecs.image_files import write_png
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.schema import table_schema
from roadscan.store.small_tables import parquet_bytes
from roadscan.store.store import Store

ADJUSTMENT: Final = "adjustment"
SOLUTION: Final = "solution"
"""Name and unit in the manifest of the solution, which has no separate file."""
TABLES: Final = (
    "tie_residuals", "control_residuals", "relative_accuracy", "absolute_accuracy", "accuracy_by_distance",
    "picture_residuals", "picture_control", "depth_residuals", "edge_boresights",
)  # fmt: skip
"""Tables of the outcome; each is a product of the manifest with one unit."""
PICTURES: Final = "adjustment_picture"
FOLDER: Final = "products/adjustment"
_WHOLE: Final = "all"
SEAMS: Final = "seams"
"""Unit of the picture of seams."""
_FILES: Final = {_WHOLE: "adjustment", SEAMS: "seams"}


def known_lines(manifest: Manifest) -> list[str]:
    """Returns the lines of the last solution."""
    record = manifest.get(ADJUSTMENT, SOLUTION)
    return [] if record is None else list(record.figures()["lines"])


def known_findings(manifest: Manifest) -> list[Finding]:
    """Returns the findings of the last solution."""
    record = manifest.get(ADJUSTMENT, SOLUTION)
    return [] if record is None else [Finding.of(one) for one in record.figures()["findings"]]


def keep_tables(store: Store, manifest: Manifest, key: str, tables: Mapping[str, Rows]) -> None:
    """Write the tables of an outcome; those without a row are removed."""
    for name in TABLES:
        rows, schema = tables.get(name, []), table_schema(name)
        if not rows:
            manifest.remove(list(manifest.of(name).values()))
            continue
        table = pa.Table.from_pylist(rows, schema=schema.arrow()).sort_by([(c, "ascending") for c in schema.sort])
        content, target = parquet_bytes(table, schema), f"{schema.location}/part-00000.parquet"
        store.write_bytes(target, content, lasting=False)
        manifest.add([OutputRecord(name, _WHOLE, key, target, len(content), bytes_digest(content))])


def keep_pictures(
    store: Store,
    manifest: Manifest,
    key: str,
    shown: tuple[AdjustmentPicture, Sequence[ShownSeam], Sequence[CameraResiduals]],
    sightings: Sequence[Mapping[str, Any]],
) -> None:
    """Draw the outcome, seams, residuals of cameras, and each target as each pass saw it; remove those of no target.

    Without Matplotlib there are only those of targets.
    """
    outcome, seams, cameras = shown
    targets = {_target_name(row): row for row in sightings if row["picture"]}
    figures = {_WHOLE: partial(draw_adjustment, outcome)} | ({SEAMS: partial(draw_seams, seams)} if seams else {})
    figures |= {f"camera-{one.camera}": partial(draw_residuals, one) for one in cameras}
    manifest.remove(manifest.beside([PICTURES], {*figures, *targets}))
    for name, draw in figures.items():
        if not can_draw():
            manifest.add([OutputRecord(PICTURES, name, NOT_DRAWN, "", 0, "")])
        elif not manifest.is_current(PICTURES, name, key):
            keep_file(store, manifest, (PICTURES, name), key, f"{FOLDER}/{_FILES.get(name, name)}.png", draw)
    for name, row in targets.items():
        own = key_of(row["picture"], row["picture_columns"], row["status"])
        if not manifest.is_current(PICTURES, name, own):
            write = partial(_write_target, row)
            keep_file(store, manifest, (PICTURES, name), own, f"{FOLDER}/targets/{name}.png", write)


def _target_name(row: Mapping[str, Any]) -> str:
    """Returns number of the point, run and GPS second: names of points may contain characters that no file name may."""
    return f"{row['point']:05d}-{row['run']}-{row['epoch_gps_ns'] // 1_000_000_000}"


def _write_target(row: Mapping[str, Any], path: Path) -> None:
    grey = np.array(row["picture"], np.uint8).reshape(-1, row["picture_columns"])
    texts = {"Title": f"{row['name']} in {row['run']}: {row['status']}".encode("latin-1", "replace").decode("latin-1")}
    write_png(path, np.maximum(grey, 1), row["picture_cell_m"], texts, smooth=True)


TIES_FAIL: Final = Witness(
    "ties_fail",
    input="trajectories, rig file",
    fault="Two passes over the same road do not see the same surface there.",
    asks="the places that both saw: whether their heights (of lidars: planes) could be compared, and whether shifts "
    "and heights that were found agree with the solution",
    does="what fails does not count; where it is more than half of ten places or more, the pair of runs is named with "
    "the reasons",
    told=("findings",),
)
_LEAST: Final = 10
"""Least number of places, or shifts, of two runs for a statement about their share."""
_MOST: Final = 0.5  # Share of failed places, or of contradicted shifts, from which they are reported.
_REFUSED: Final = "contradicted by all other evidence"
_CAUSES: Final = {
    TOO_FAR: "the height of the poses of one of them, its lever arm or its geoid is wrong",
    TWO_SURFACES: "the passes lie apart horizontally, the surface was rebuilt between them, or a boresight is wrong",
    SCATTERED: "the passes lie apart horizontally, the surface was rebuilt between them, or readings of one are rough",
    STEEP: "a boresight is wrong, or what both saw is no road",
    _REFUSED: "a boresight or a lever arm is wrong, or the surface was rebuilt in part",
}


def failed_ties(ties: KnownTies, weight: Float64) -> list[Finding]:
    """Returns findings on pairs of runs.

    Parameters
    ----------
    weight : (t,) of each tie that could be measured.
    """
    tried, found = ties.tried, list[Finding]()
    runs = np.stack([tried["first_run"], tried["second_run"]])
    counting = (tried["why_not"] != SAME_PASS) & (tried["why_not"] != FEW_CELLS)
    refused = _refused(ties, weight)
    for pair in sorted({(a, b) for a, b in runs.T.tolist() if a != b}):
        own = (runs[0] == pair[0]) & (runs[1] == pair[1]) & counting
        places = _reasons(tried, own & np.isin(tried["kind"], (HEIGHT, PLANE)), refused)
        shifts = own & (tried["kind"] == SHIFT) & (tried["accepted"] == 1)
        contradicted = _number_refused(tried, shifts, refused)
        told = list[str]()
        failed = {reason: n for reason, n in Counter(places.values()).most_common() if reason}
        if len(places) >= _LEAST and sum(failed.values()) > _MOST * len(places):
            words = ", ".join(f"{n} × {reason}" for reason, n in failed.items())
            told.append(f"of {len(places)} places that both saw, {sum(failed.values())} give no height ({words})")
        elif shifts.sum() >= _LEAST and contradicted > _MOST * shifts.sum():
            failed = {_REFUSED: contradicted}
            told.append(f"of {int(shifts.sum())} shifts that were found, {contradicted} are {_REFUSED}")
        if told:
            text = f"{told[0]}: {_CAUSES.get(next(iter(failed)), 'one of both does not see the road')}"
            found.append(TIES_FAIL.finds(f"runs '{pair[0]}' and '{pair[1]}'", text, left_out=sum(failed.values())))
    return found


def _refused(ties: KnownTies, weight: Float64) -> set[tuple[Any, ...]]:
    """Returns place, group, kind and sizes of the ties that passed their tests and do not count."""
    rows = np.flatnonzero(ties.accepted & (weight == 0.0))
    columns = ties.columns
    return {(int(columns["place"][k]), columns["kind"][k], float(columns["sigma_m"][k])) for k in rows.tolist()}


def _number_refused(tried: Any, own: npt.NDArray[np.bool_], refused: set[tuple[Any, ...]]) -> int:
    rows = np.flatnonzero(own).tolist()
    return sum((int(tried["place"][k]), tried["kind"][k], float(tried["sigma_m"][k])) in refused for k in rows)


def _reasons(tried: Any, own: npt.NDArray[np.bool_], refused: set[tuple[Any, ...]]) -> dict[int, str]:
    """Returns for each place why it gives nothing; "" where one comparison counts."""
    found: dict[int, str] = {}
    for k in np.flatnonzero(own).tolist():
        place, why = int(tried["place"][k]), str(tried["why_not"][k])
        if not why and (place, tried["kind"][k], float(tried["sigma_m"][k])) in refused:
            why = _REFUSED
        found[place] = "" if found.get(place) == "" or not why else why
    return found


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
    return change, evidence.mounted.seats(run, end.sensor, end.first_gps_ns)


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
