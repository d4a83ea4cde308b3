"""Tables and pictures of an adjustment, recorded in the manifest, and pairs of runs whose ties mostly fail."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.adjust.bundle.picture import CameraResiduals, draw_residuals
from roadscan.adjust.picture import AdjustmentPicture, draw_adjustment
from roadscan.adjust.seams_picture import ShownSeam, draw_seams
from roadscan.adjust.tasks.figures import Rows
from roadscan.adjust.tasks.tie_work import KnownTies
from roadscan.adjust.ties.tie import FEW_CELLS, HEIGHT, PLANE, SAME_PASS, SCATTERED, SHIFT, STEEP, TOO_FAR, TWO_SURFACES
from roadscan.compute.array_types import Float64
from roadscan.core.extras import can_draw
from roadscan.core.witness import Finding, Witness
from roadscan.navigation.tasks.recorded_pictures import NOT_DRAWN, keep_file
from roadscan.run.engine.fingerprint import key_of
from roadscan.store.codecs.grey_picture import write_png
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.schema import table_schema
from roadscan.store.store import Store
from roadscan.store.writer import parquet_bytes

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
