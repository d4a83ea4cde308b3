"""Row groups by tile against sets of numbers; tasks as they travel."""

from __future__ import annotations

import dataclasses
import itertools
import pickle
from types import SimpleNamespace

import numpy as np
import pytest

from roadscan.core.survey import Survey
from roadscan.footprints.footprints import FootprintRanges
from roadscan.footprints.row_groups import GroupsByTile
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Session
from roadscan.store.manifest import OutputRecord
from roadscan.tiles.stage import plan_tile_work
from roadscan.tiles.tasks.tiles import TaskResult
from tests.surveys import Simulated

TILES = 12


def random_footprints(seed: int) -> tuple[FootprintRanges, np.ndarray, np.ndarray]:
    """Tiles that ranges of row groups of four files touch, with the order by tile and where each tile's rows begin."""
    random = np.random.default_rng(seed)
    sizes = random.integers(1, 30, 4)
    rows = []
    for tile in range(TILES):
        for index, size in enumerate(sizes):
            touching = np.flatnonzero(random.random(size) < random.choice([0.0, 0.2, 0.8]))
            for run in np.split(touching, np.flatnonzero(np.diff(touching) != 1) + 1):
                rows += [(tile, index, run[0], run[-1])] if run.size else []
    tile, index, first, last = np.array(random.permutation(rows)).T
    slices = tuple(SimpleNamespace(groups=range(size)) for size in sizes)
    epochs = 1000 * index + first, 1000 * index + last
    found = FootprintRanges(0 * tile, tile, index, first, last, last - first + 1, *epochs, slices)  # type: ignore[arg-type]
    order = np.lexsort((first, index, tile))
    return found, order, np.searchsorted(tile[order], np.arange(TILES + 1))


@pytest.mark.parametrize("seed", range(8))
def test_what_a_task_needs_and_tells(seed: int) -> None:
    footprints, order, starts = random_footprints(seed)
    f = footprints
    needed: dict[int, set[tuple[int, int]]] = {tile: set() for tile in range(TILES)}
    for tile, index, first, last in zip(f.tile_row, f.slice_index, f.first_group, f.last_group, strict=True):
        needed[int(tile)] |= {(int(index), group) for group in range(first, last + 1)}
    by_tile = GroupsByTile(footprints, order, starts)
    tiles = np.random.default_rng(seed).permutation(TILES)[:5]
    runs = by_tile.runs(tiles)
    cuts = np.flatnonzero(np.diff(runs.slice, prepend=-1)).tolist()
    sources = [int(s) for s in runs.source[cuts]]
    groups = [by_tile.groups(runs, a, b) for a, b in itertools.pairwise([*cuts, runs.slice.size])]
    held = [(s, g) for s, own in zip(sources, groups, strict=True) for g in own]
    assert held == sorted(set().union(*(needed[int(t)] for t in tiles)))
    assert sources == sorted(set(sources))
    ends = zip(runs.first_epoch_gps_ns, runs.last_epoch_gps_ns, runs.source, runs.begin, runs.end, strict=True)
    assert sum(b - a + 1 for a, b, *_ in ends) == len(held)

    found: dict[int, set[tuple[int, int]]] = {int(t): set() for t in tiles}
    for place, number, first, end in by_tile.touched(runs, tiles).tolist():
        found[int(tiles[place])] |= {(sources[number], groups[number][k]) for k in range(first, end)}
    assert found == {int(t): needed[int(t)] for t in tiles}

    owner = {g: min(t for t in range(TILES) if g in needed[t]) for g in set().union(*needed.values())}
    told: dict[tuple[int, int], int] = {}
    for number, first, end, place in by_tile.owned(runs, tiles).tolist():
        for k in range(first, end):
            assert told.setdefault((sources[number], groups[number][k]), int(tiles[place])) == int(tiles[place])
    assert told == {g: t for g, t in owner.items() if t in tiles}


def test_a_task_arrives_as_it_was_sent_and_carries_no_epochs_of_row_groups(finished: Simulated) -> None:
    run = Session(Survey.load(finished.survey_file), finished.store(), Inline())
    planned = plan_tile_work(run).planned
    tiles = list(planned.tiles)
    for task in [*planned.tasks(tiles), *planned.singly(tiles[:2])]:
        arrived = pickle.loads(pickle.dumps(task))
        assert arrived.block == task.block
        assert arrived.touches == task.touches
        assert list(arrived.owned) == list(task.owned)
        assert arrived.slices == task.slices
        assert all(len(s.spans) < len(s.groups) or len(s.groups) == 1 for s in task.slices)
    whole = planned.tasks(tiles)[0].slices[0]
    long = dataclasses.replace(whole, groups=range(100_000))
    assert len(pickle.dumps(long)) < len(pickle.dumps(whole)) + 20


@pytest.mark.parametrize("count", [0, 1, 3])
def test_results_arrive_as_they_were_sent(count: int) -> None:
    records = [OutputRecord("tile", f"{k}_7", f"key{k}", f"tiles/cells/{k}_7.parquet", k, "d") for k in range(count)]
    arrived = pickle.loads(pickle.dumps(TaskResult.of(records, [("9_9", "damaged")])))
    assert [tuple(row.values()) for row in arrived.records.table().to_pylist()] == records
    assert arrived.records.rows == count
    assert arrived.failures == (("9_9", "damaged"),)
