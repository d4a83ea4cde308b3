"""Spans of row groups: they are held and stored as small as the docs say, and read back as they were."""

from __future__ import annotations

import pickle

import numpy as np

from roadscan.store.codecs.group_spans import GroupSpans
from roadscan.store.logs import DataFile, data_file

GROUPS = 100_000


def drive() -> tuple[tuple[int, int], ...]:
    """Row groups of 4.6 ms, with a jitter of a third of a microsecond."""
    rng = np.random.default_rng(5)
    first = 1_454_644_800_000_000_000 + np.cumsum(rng.normal(4_571_428, 300, GROUPS).astype(np.int64))
    last = first + rng.normal(4_500_000, 300, GROUPS).astype(np.int64)
    return tuple(zip(first.tolist(), last.tolist(), strict=True))


def test_a_drive_takes_few_bytes_and_comes_back() -> None:
    pairs = drive()
    file = DataFile("tables/scans/a.parquet", 64 * GROUPS, 9, "blake3:0", (64,) * (GROUPS - 1) + (3,), pairs)
    told = file.as_json()
    assert told["group_rows"] == [[GROUPS - 1, 64], [1, 3]]
    assert len(told["group_spans"]) < 5 * GROUPS
    assert len(pickle.dumps(file)) < 5 * GROUPS
    assert data_file(told) == file == pickle.loads(pickle.dumps(file))
    assert file.group_rows == (64,) * (GROUPS - 1) + (3,) and len(file.group_rows) == GROUPS
    assert (file.group_rows[-1], file.group_rows[-2], file.group_rows[-2:]) == (3, 64, (64, 3))
    assert np.array(file.group_rows).tolist() == list(file.group_rows)
    assert file.group_spans == pairs and pairs == file.group_spans
    assert file.span == (pairs[0][0], max(last for _, last in pairs))
    assert file.group_spans[-1] == pairs[-1] and file.group_spans[5:7] == pairs[5:7]
    assert np.array(file.group_spans).tolist() == [list(pair) for pair in pairs]


def test_what_older_versions_wrote_is_read() -> None:
    raw = {"path": "a", "rows": 5, "bytes": 9, "digest": "", "group_rows": [3, 2], "group_spans": [[1, 4], [5, 9]]}
    assert data_file(raw) == DataFile("a", 5, 9, "", (3, 2), ((1, 4), (5, 9)))
    none = data_file(raw | {"group_rows": [], "group_spans": []})
    assert none.span is None and not none.group_rows and np.array(none.group_rows).size == 0
    assert GroupSpans.of_text(GroupSpans().text()) == ()
