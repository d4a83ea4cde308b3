"""Writings that a kill cut short: what was there before stays whole for its readers, and nothing is left behind."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from roadscan.store import small_tables
from roadscan.store.small_tables import read_small, small_path, small_records, write_small
from roadscan.store.store import Store
from tests.inventory.streets import Everywhere, inventory

ROW = {"run": "*", "sensor": "profiler_left", "valid_from_gps_ns": 0, "lever_forward_m": 1.0, "lever_right_m": 0.0,
       "lever_down_m": 0.0, "qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0}  # fmt: skip


def test_a_small_table_whose_writing_is_cut_short_twice_is_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The list of digests is written first, and the table is not."""
    store = Store(str(tmp_path), "survey")
    write_small(store, "mountings", [ROW])
    before, write = read_small(store, "mountings"), store.write_bytes

    def cut_short(path: str, content: bytes, *, lasting: bool = True) -> None:
        if path == small_path("mountings"):
            raise KeyboardInterrupt
        write(path, content, lasting=lasting)

    monkeypatch.setattr(store, "write_bytes", cut_short)
    for height_m in (2.0, 3.0):
        with pytest.raises(KeyboardInterrupt):
            write_small(store, "mountings", [ROW | {"lever_down_m": height_m}])
        assert read_small(store, "mountings") == before
        assert list(small_records(store)) == [small_path("mountings")]
    monkeypatch.undo()
    write_small(store, "mountings", [ROW])
    assert read_small(store, "mountings") == before
    known = store.read_bytes(small_tables._DIGESTS)
    write_small(store, "mountings", [ROW])
    assert store.read_bytes(small_tables._DIGESTS) == known


def test_what_a_killed_writer_of_an_inventory_left_goes_with_the_next(tmp_path: Path) -> None:
    street = inventory(tmp_path, Everywhere())
    child = os.fork()
    if child == 0:
        left = street.truth.store._new_temporary()
        left.write_bytes(b"half of a commit")
        os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    staging = Path(street.truth.store.path(".staging"))
    assert any(staging.iterdir())
    with street.truth.alone():
        assert not any(staging.iterdir())
