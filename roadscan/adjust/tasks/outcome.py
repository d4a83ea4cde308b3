"""Tables and pictures of an adjustment: written as a whole, recorded in the manifest with its key."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from roadscan.adjust.bundle.picture import CameraResiduals, draw_residuals
from roadscan.adjust.picture import AdjustmentPicture, draw_adjustment
from roadscan.adjust.seams_picture import ShownSeam, draw_seams
from roadscan.adjust.tasks.figures import Rows
from roadscan.core.extras import can_draw
from roadscan.core.witness import Finding
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
