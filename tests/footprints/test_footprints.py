"""Footprints of a run against every reading placed, and what is loaded of them."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from roadscan.core.errors import StoreError
from roadscan.core.survey import Survey
from roadscan.footprints.footprints import PRODUCT, FootprintRanges, join_footprints, load_ranges
from roadscan.footprints.reach import opened, touched_tiles
from roadscan.georeference.place import Window
from roadscan.georeference.plan.plan import SurveyPlan, plan_survey
from roadscan.georeference.sources import Georeferencer
from roadscan.store.manifest import Manifest
from roadscan.store.store import Store
from tests.surveys import Simulated


@pytest.fixture(scope="module")
def indexed(finished: Simulated) -> tuple[SurveyPlan, Manifest]:
    store = finished.store()
    return plan_survey(Survey.load(finished.survey_file), store), Manifest(store)


def pairs_of(f: FootprintRanges) -> np.ndarray:
    """(n, 4) slice, row group, column and row of the tile, for each pair of row group and tile."""
    counts = f.last_group - f.first_group + 1
    rows = np.repeat(np.arange(counts.size), counts)
    group = f.first_group[rows] + np.arange(rows.size) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.column_stack([f.slice_index[rows], group, f.tile_column[rows], f.tile_row[rows]])


def test_footprints_hold_every_reading(indexed) -> None:
    plan, manifest = indexed
    found = load_ranges(plan, manifest)
    pairs = pairs_of(found)
    known = set(map(tuple, pairs.tolist()))
    assert len(known) == len(pairs) > found.readings.size
    placed = set()
    for number, one in enumerate(found.slices):
        placer = Georeferencer(plan.store, plan.ground, [one])
        for group in one.groups:
            tiles, _ = placer.touched(one, group)
            placed |= {(number, group, c, r) for c, r in np.unique(tiles, axis=0).tolist()}
    assert {s.source.table for s in found.slices} == {"scans", "returns"}
    assert not placed - known
    assert len(known) < 1.6 * len(placed)


def test_ranges_span_the_epochs_of_their_groups(indexed) -> None:
    plan, manifest = indexed
    found = load_ranges(plan, manifest)
    assert found.readings.min() >= 1
    for number, one in enumerate(found.slices):
        rows = found.slice_index == number
        file = pq.ParquetFile(plan.store.path(one.file))
        epochs = [file.read_row_group(k, ["epoch_gps_ns"]).column(0).to_numpy() for k in range(file.num_row_groups)]
        spans = np.array(one.source.spans([(e.min(), e.max()) for e in epochs]))
        assert (spans[found.first_group[rows], 0] == found.first_epoch_gps_ns[rows]).all()
        assert (spans[found.last_group[rows], 1] == found.last_epoch_gps_ns[rows]).all()


def test_only_some_files_or_tiles_are_loaded(indexed, monkeypatch: pytest.MonkeyPatch) -> None:
    plan, manifest = indexed
    whole = load_ranges(plan, manifest)
    column, row = int(np.median(whole.tile_column)), int(np.median(whole.tile_row))
    near = load_ranges(plan, manifest, window=Window(column, row, column + 2, row + 1))
    inside = (whole.tile_column >= column) & (whole.tile_column < column + 2) & (whole.tile_row == row)
    assert inside.any()
    assert set(map(tuple, pairs_of(near).tolist())) == {
        p for p in map(tuple, pairs_of(whole).tolist()) if column <= p[2] < column + 2 and p[3] == row
    }
    file = whole.slices[-1].file
    own = load_ranges(plan, manifest, files={file})
    assert (own.slice_index == len(whole.slices) - 1).all()
    assert own.readings.sum() == whole.readings[whole.slice_index == len(whole.slices) - 1].sum()
    opened: list[str] = []
    monkeypatch.setattr(Store, "read_bytes", lambda _, path: opened.append(path))
    assert load_ranges(plan, manifest, window=Window(0, 0, 1, 1)).readings.size == 0
    assert not opened


@pytest.mark.parametrize("table", ["scans", "returns"])
def test_files_without_spans_of_ranges_or_statistics_are_bounded_too(indexed, table: str, tmp_path: Path) -> None:
    plan, _ = indexed
    one = next(s for s in plan.slices() if s.source.table == table)
    store = Store(str(tmp_path), "bare")
    for file in one.source.trajectory.files:
        store.write_bytes(file.path, plan.store.read_bytes(file.path))
    rows = pq.read_table(plan.store.local_copy(one.file, tmp_path), partitioning=None)
    rows = rows.drop_columns([c for c in ("range_low", "range_high") if c in rows.column_names])
    written = tmp_path / "bare.parquet"
    pq.write_table(rows, written, row_group_size=first_group_rows(plan, one.file), write_statistics=False)
    store.write_bytes(one.file, written.read_bytes())
    with opened(store, one) as file:
        bare = touched_tiles(store, plan.ground, one, file)
    assert not bare.unbounded.any()
    pairs = set(zip(bare.group.tolist(), bare.column.tolist(), bare.row.tolist(), strict=True))
    placer = Georeferencer(plan.store, plan.ground, [one])
    for group in one.groups:
        tiles, _ = placer.touched(one, group)
        assert {(group, c, r) for c, r in np.unique(tiles, axis=0).tolist()} <= pairs


def first_group_rows(plan: SurveyPlan, path: str) -> int:
    return next(f.group_rows[0] for _, files in plan.sources for f in files if f.path == path)


def test_a_survey_without_footprints_says_so(indexed, tmp_path: Path) -> None:
    plan, _ = indexed
    with pytest.raises(StoreError, match="no footprints"):
        load_ranges(plan, Manifest(Store(str(tmp_path), "new")))


def test_footprints_of_all_come_from_one_file(indexed, monkeypatch: pytest.MonkeyPatch) -> None:
    """It holds what the files of all data files hold, and is left aside where one of them is another now."""
    plan, manifest = indexed
    join_footprints(plan, manifest)
    singly = load_ranges(plan, manifest, files={f.path for _, files in plan.sources for f in files})
    read, opened = Store.read_bytes, list[str]()
    monkeypatch.setattr(Store, "read_bytes", lambda store, path: opened.append(path) or read(store, path))
    whole = load_ranges(plan, manifest)
    assert opened == ["manifest/joined/footprints.parquet"]
    assert pairs_of(whole).tolist() == pairs_of(singly).tolist()
    assert whole.readings.tolist() == singly.readings.tolist()
    other = copy.copy(manifest)
    first = next(iter(manifest.of(PRODUCT).values()))
    other._rows = {**manifest._rows, PRODUCT: {**manifest._rows[PRODUCT], first.unit: (*first._replace(digest=""),)}}
    opened.clear()
    load_ranges(plan, other)
    assert len(opened) == len(whole.slices) and "manifest/joined/footprints.parquet" not in opened
