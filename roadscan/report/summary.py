"""Summary of a survey's store after a run: counts of readings, tiles, area, σ, overlap, rejects, failures, files.

All of it comes from the manifest and the records of logs; no reading and no cell is read.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from roadscan.adjust.tasks.outcome import known_lines
from roadscan.core.errors import StoreError
from roadscan.core.survey import Survey
from roadscan.core.witness import Finding
from roadscan.footprints.footprints import PRODUCT as FOOTPRINTS
from roadscan.navigation.tasks.navigate import known_keys
from roadscan.run.stage import findings_of
from roadscan.store.logs import LogRecord, read_log_records
from roadscan.store.manifest import Manifest, OutputRecord, read_failures
from roadscan.store.store import Store
from roadscan.tiles.tasks.tile_figures import reading_counts
from roadscan.tiles.tasks.tile_plan import TILE


@dataclass(frozen=True)
class LogSummary:
    """The logs of the survey file that are in the store."""

    logs: int
    rows: int
    """Rows of all their tables."""
    rejected: int
    """Records that could not be used; the table `rejects` lists each."""
    reject_reasons: dict[str, int]
    """The same by reason, the most frequent first."""


@dataclass(frozen=True)
class TilesSummary:
    """Figures over all tiles."""

    looked_at: int
    """Tiles that a reading may have touched."""
    with_readings: int
    """Those of them with a reading; the others have no file."""
    cells: int
    """Cells with a reading."""
    area_m2: float
    """Area of the cells with a reading."""
    overlap_area_m2: float | None
    """Area of the cells that two or more passes measured; None where a tile's record does not say it."""
    sigma_horizontal_m: Spread | None
    """Largest horizontal 1 σ of the poses that placed a tile's readings; None where no trajectory states it."""
    sigma_down_m: Spread | None
    """The same of the height."""
    sigma_cells_m: Spread | None
    """Standard deviation of the heights in a cell, the median of each tile."""


@dataclass(frozen=True)
class Spread:
    """A figure over tiles."""

    median: float
    largest: float


@dataclass(frozen=True)
class ProductFiles:
    """Files of a product."""

    files: int
    bytes: int
    folder: str
    """The folder that contains them all."""


@dataclass(frozen=True)
class SurveySummary:
    """Contents of a survey's store."""

    survey: str
    store: str
    """Its folder or URL."""
    logs: LogSummary
    readings: dict[str, int]
    """Number of readings by result (`kept`, `range`, …); empty before the tiles are made."""
    tiles: TilesSummary | None
    """None before the tiles are made."""
    adjustment: list[str]
    """Results of the adjustment of the poses, in words; empty where nothing was adjusted."""
    findings: list[Finding]
    """Findings of the witnesses: what was left out, and what is doubtful."""
    files: dict[str, ProductFiles]
    """Files by product."""
    failures: list[dict[str, str]]
    """What failed in the last run: stage, unit, reason."""

    def as_json(self) -> dict[str, Any]:
        """Return the summary as JSON values; lengths in metres, areas in square metres."""
        return dataclasses.asdict(self)


def survey_summary(survey: Survey, store: Store) -> SurveySummary:
    """Summarise the manifest and the log records; damaged ones are skipped (`roadscan verify` reports them)."""
    damaged: list[StoreError] = []
    manifest = Manifest(store, damaged)
    listed = set(known_keys(survey, store))
    logs = [record for record in read_log_records(store, damaged=damaged) if record.key in listed]
    tiles = list(manifest.of(TILE).values())
    return SurveySummary(
        survey=survey.config.id,
        store=store.root,
        logs=_logs(logs),
        readings=reading_counts(manifest).of_all(),
        tiles=_tiles(tiles, survey.config.tiles.cell_m) if tiles else None,
        adjustment=known_lines(manifest),
        findings=findings_of(survey, logs, manifest),
        files=_files(manifest.table(), store),
        failures=read_failures(store),
    )


def _logs(records: Sequence[LogRecord]) -> LogSummary:
    reasons: Counter[str] = Counter()
    for record in records:
        reasons.update(record.reject_reasons)
    return LogSummary(
        len(records), sum(r.rows for r in records), sum(r.rejected for r in records), dict(reasons.most_common())
    )


def _tiles(records: Sequence[OutputRecord], cell_m: float) -> TilesSummary:
    held = [record.figures() for record in records if record.path]
    cells = sum(figures["cells"] for figures in held)
    overlapped = [figures.get("overlapped_cells") for figures in held]
    known = [count for count in overlapped if count is not None]
    return TilesSummary(
        looked_at=len(records),
        with_readings=len(held),
        cells=cells,
        area_m2=cells * cell_m**2,
        overlap_area_m2=sum(known) * cell_m**2 if len(known) == len(held) else None,
        sigma_horizontal_m=_spread(figures.get("sigma_horizontal_m") for figures in held),
        sigma_down_m=_spread(figures.get("sigma_down_m") for figures in held),
        sigma_cells_m=_spread(figures.get("height_std_median_m") for figures in held),
    )


def _spread(values: Iterable[float | None]) -> Spread | None:
    known = [value for value in values if value is not None]
    return Spread(float(np.median(known)), max(known)) if known else None


def _files(outputs: pa.Table, store: Store) -> dict[str, ProductFiles]:
    """Return files by product; those beside a product's own (``las.world``) belong to it."""
    there = outputs.filter(pc.not_equal(outputs.column("path"), ""))
    found: dict[str, list[int]] = {}
    folders: dict[str, PurePosixPath] = {}
    columns = (there.column(name).to_pylist() for name in ("product", "path", "bytes"))
    for product, path, size in zip(*columns, strict=True):
        name = "cells" if product == TILE else product.split(".")[0]
        if name == FOOTPRINTS:
            continue
        found.setdefault(name, []).append(size)
        own = PurePosixPath(path).parent
        folders[name] = _common(folders.get(name, own), own)
    return {
        name: ProductFiles(len(sizes), sum(sizes), store.path(str(folders[name])))
        for name, sizes in sorted(found.items())
    }


def _common(one: PurePosixPath, other: PurePosixPath) -> PurePosixPath:
    while one != other and one not in other.parents:
        one = one.parent
    return one
