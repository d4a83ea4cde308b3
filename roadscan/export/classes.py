"""Exports classes of readings: the result of each, and the filter that left it out. Nothing is deleted."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.compute.array_types import Int64, UInt8
from roadscan.core.errors import ConfigError, nearest
from roadscan.core.grid import LanePass, TileId
from roadscan.core.rig import ScanGeometry
from roadscan.core.survey import Survey
from roadscan.georeference.place import Georeferenced, passes_of
from roadscan.georeference.plan.plan import SurveyPlan, plan_survey
from roadscan.georeference.plan.road import CentreLineBuffer, load_buffer
from roadscan.georeference.road_profiles import KEPT, OFF_CENTRE_LINE, OUTSIDE_PASS, READING_CLASSES
from roadscan.georeference.sources import Georeferencer, RawSlice, geometry_of
from roadscan.store.digest import UNREADABLE
from roadscan.store.schema import table_schema
from roadscan.store.store import Store
from roadscan.tiles.tasks.tile_points import near_lines

TABLE: Final = "reading_classes"


def write_classes(
    survey: Survey,
    store: Store,
    run: str,
    sensor: str,
    out: Path,
    report: Callable[[int, int], None] = lambda _a, _b: None,
) -> dict[str, int]:
    """Write the class of every reading of a sensor in a run as Parquet (``schemas/reading_classes.toml``).

    The file appears under its name when it is whole. About a million readings are in memory at a time.

    Parameters
    ----------
    report : receives how many of the sensor's data files are done.

    Returns
    -------
    How many readings are of each class, by name.

    Raises
    ------
    ConfigError
        if the survey has no readings of that sensor in that run, or `out` is there and holds no such table.
    RunError
        if a log is not ingested.
    """
    _refuse_other_file(out)
    plan = plan_survey(survey, store)
    slices = _slices(plan, run, sensor)
    schema = table_schema(TABLE)
    names = json.dumps({str(code): name for code, name in READING_CLASSES.items()})
    arrow = schema.arrow().with_metadata({"classes": names, "survey": survey.config.id, "run": run, "sensor": sensor})
    counts = np.zeros(len(READING_CLASSES), np.int64)
    part = out.with_name(out.name + ".part")
    try:
        with pq.ParquetWriter(part, arrow, compression="zstd", compression_level=1, **_encodings()) as writer:
            for batch in _batches(plan, slices, report):
                counts += np.bincount(batch["class"], minlength=counts.size)
                writer.write_batch(pa.RecordBatch.from_pydict(batch, schema=arrow), schema.row_group_rows)
        os.replace(part, out)  # noqa: PTH105  replaces an older file on all systems
    finally:
        part.unlink(missing_ok=True)
    return {name: int(counts[code]) for code, name in READING_CLASSES.items() if counts[code]}


def _refuse_other_file(out: Path) -> None:
    """Raise :class:`ConfigError` where the file to write exists and is no older one of its kind."""
    if not out.exists():
        return
    try:
        is_older = pq.read_schema(out).names == table_schema(TABLE).arrow().names
    except UNREADABLE:
        is_older = False
    if not is_older:
        raise ConfigError(
            "the file is there already, and holds no classes of readings",
            expected="a new file, or one that this command wrote",
            change="name another --out",
            file=out,
        )


def _encodings() -> dict[str, Any]:
    # Epochs and numbers grow steadily; the class repeats.
    return {
        "use_dictionary": ["class"],
        "column_encoding": dict.fromkeys(("epoch_gps_ns", "row", "reading"), "DELTA_BINARY_PACKED"),
    }


def _slices(plan: SurveyPlan, run: str, sensor: str) -> list[RawSlice]:
    """Return the data files of a sensor in a run, in order of log and time."""
    known = {f"{source.run}/{source.sensor}" for source, _ in plan.sources}
    found = [s for s in plan.slices() if (s.source.run, s.source.sensor) == (run, sensor)]
    if not found:
        wanted = f"{run}/{sensor}"
        raise ConfigError(
            f"the survey has no readings of {wanted}{nearest(wanted, known)}",
            expected="run and sensor, one of: " + ", ".join(sorted(known)),
        )
    return sorted(found, key=lambda s: (s.source.key, s.spans[0] if s.spans else (0, 0), s.file))


def _batches(
    plan: SurveyPlan, slices: list[RawSlice], report: Callable[[int, int], None]
) -> Iterator[dict[str, npt.NDArray[Any]]]:
    """Yield the columns of the table, chunk by chunk."""
    lines = None if plan.centre_lines is None else load_buffer(plan.centre_lines, plan.ground.map)
    row = 0
    report(0, len(slices))
    for done, one in enumerate(slices, 1):
        placer = Georeferencer(plan.store, plan.ground, [one])
        geometry = geometry_of(one.source)
        passes = [p for p in plan.passes if p.run == one.source.run]
        for rows, classes, kept in placer.classified(one):
            columns = _numbered(rows, row, geometry)
            _beside(classes, columns["epoch_gps_ns"], kept, passes, lines, plan)
            yield columns | {"class": classes}
            row += rows.num_rows
        report(done, len(slices))


def _numbered(rows: pa.RecordBatch, first: int, geometry: ScanGeometry | None) -> dict[str, npt.NDArray[Any]]:
    """Return epoch, row and number of every reading of some rows."""
    epochs = rows.column("epoch_gps_ns").to_numpy()
    row = first + np.arange(rows.num_rows)
    if geometry is None:
        return {"epoch_gps_ns": epochs, "row": row, "reading": np.zeros(rows.num_rows, np.int32)}
    reading = np.tile(np.arange(geometry.readings, dtype=np.int32), rows.num_rows)
    return {
        "epoch_gps_ns": geometry.reading_epochs(np.repeat(epochs, geometry.readings), reading),
        "row": np.repeat(row, geometry.readings),
        "reading": reading,
    }


def _beside(
    classes: UInt8,
    epochs_gps_ns: Int64,
    kept: Georeferenced,
    passes: list[LanePass],
    lines: CentreLineBuffer | None,
    plan: SurveyPlan,
) -> None:
    """Mark readings (n,) outside all passes, and those of points off the centre lines that passed all other filters.

    kept : points of the readings of class `KEPT`, in their order.
    """
    placed = np.flatnonzero(classes == KEPT)
    outside = passes_of(epochs_gps_ns[placed], passes) == 0
    classes[placed[outside]] = OUTSIDE_PASS
    if lines is not None and placed.size:
        off = ~_near(kept, lines, plan) & ~outside
        classes[placed[off]] = OFF_CENTRE_LINE


def _near(points: Georeferenced, lines: CentreLineBuffer, plan: SurveyPlan) -> npt.NDArray[np.bool_]:
    """Return which points (n,) lie in the buffer, tile by tile as in products."""
    tiles, tile_of = np.unique(points.tiles, axis=0, return_inverse=True)
    order = np.argsort(tile_of, kind="stable")
    ends = np.cumsum(np.bincount(tile_of, minlength=len(tiles)))
    near = np.zeros(order.size, dtype=bool)
    for (column, row), rows in zip(tiles.tolist(), np.split(order, ends[:-1]), strict=True):
        near[rows] = near_lines(TileId(column, row), points.quanta[rows], lines, plan.ground)
    return near
