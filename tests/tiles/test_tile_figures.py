"""Records of many tiles at once: the same reasons and figures as one by one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from roadscan.core.grid import TileId
from roadscan.georeference.reading_counts import LogCounts
from roadscan.run.keys import key_of, keys_beside
from roadscan.store.manifest import CHANGED, DAMAGED, MISSING, Manifest, OutputRecord
from roadscan.store.store import Store
from roadscan.tiles.tasks.tile_figures import summary_of, tile_figures
from roadscan.tiles.tasks.tile_plan import TILE

TILES = 300


def figures(points: int) -> str:
    told = {
        "points": points, "cells": 3, "overlapped_cells": 0, "height_min_m": 1.0, "height_mean_m": 2.0,
        "height_max_m": 3.0, "height_std_median_m": 0.1, "intensity_mean": 9.0, "passes": [1, 2],
        "first_epoch_gps_ns": 5, "last_epoch_gps_ns": 9, "sigma_horizontal_m": None, "sigma_down_m": 0.2,
        "fates": {"abc": {"kept": points}, "def": {"no_return": 1}},
    }  # fmt: skip
    return json.dumps(told if points else {"points": 0})


@pytest.fixture
def manifest(tmp_path: Path) -> Manifest:
    store = Store(str(tmp_path), "s")
    made = Manifest(store)
    records = []
    for number in range(TILES):
        unit, path = f"{number}_-7", f"tiles/cells/{number}_-7.parquet" if number % 10 else ""
        if path:
            store.write_bytes(path, b"cells", lasting=False)
        records.append(OutputRecord(TILE, unit, f"k{number}", path, 5 if path else 0, "d", figures(number % 10)))
    made.add(records)
    made.add([OutputRecord("other", "x", "k", "", 0, "")])
    store.write_bytes("tiles/cells/11_-7.parquet", b"cell", lasting=False)
    store.remove("tiles/cells/12_-7.parquet")
    made.doubt([records[13]])
    return made


def test_reasons_are_those_of_one_by_one(manifest: Manifest) -> None:
    units = [f"{number}_-7" for number in range(TILES + 2)]
    keys = [f"k{number}" if number != 14 else "another" for number in range(TILES + 2)]
    found = manifest.reasons(TILE, units, keys)
    assert found == {u: why for u, k in zip(units, keys, strict=True) if (why := manifest.why_due(TILE, u, k))}
    assert {u: found[u] for u in ("11_-7", "12_-7", "13_-7", "14_-7", "300_-7")} == {
        "11_-7": DAMAGED, "12_-7": DAMAGED, "13_-7": DAMAGED, "14_-7": CHANGED, "300_-7": MISSING,
    }  # fmt: skip
    assert len(found) == 6


def test_figures_are_those_of_one_by_one_until_a_record_changes(manifest: Manifest) -> None:
    found, records = tile_figures(manifest), manifest.of(TILE).values()
    assert found.counts.by_log() == LogCounts(records).by_log()
    assert found.summaries == {s.tile: s for r in records if (s := summary_of(r)) is not None}
    assert found.contents.keys() == {TileId.parse(r.unit) for r in records if r.path}
    assert tile_figures(manifest) is found
    manifest.add([next(r for r in records if r.unit == "21_-7")._replace(digest="e")])
    again = tile_figures(manifest)
    assert {t for t in found.contents if again.contents[t] != found.contents[t]} == {TileId(21, -7)}


def test_keys_beside_are_the_same_keys() -> None:
    keys = [key_of(number) for number in range(5)]
    assert keys_beside(keys, key_of("ä")) == [key_of(key, key_of("ä")) for key in keys]
    assert keys_beside(keys, 'ä"') == [key_of(key, 'ä"') for key in keys]
