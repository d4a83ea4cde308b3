"""Commands that are killed, on a folder and on an object store: some draws each night, others than in the night before.

`ROADSCAN_KILLS` says how many draws of each; ``python -m tests.kills`` makes chosen ones, and goes on with a campaign.
"""

from __future__ import annotations

import datetime as dt
import os
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.kills.states import Place
from tests.kills.steps import guest, prepare
from tests.kills.trial import draws
from tests.object_store import served

COUNT = int(os.environ.get("ROADSCAN_KILLS", "100"))
"""Draws of a night on each of the two, with two or three kills each."""


@pytest.mark.nightly
@pytest.mark.timeout(0)
@pytest.mark.parametrize("has_bucket", [False, True], ids=["folder", "s3"])
def test_killed_commands_leave_nothing_half_done_and_the_same_bytes(tmp_path: Path, has_bucket: bool) -> None:
    seed = dt.date.today().toordinal()
    with ExitStack() as stack:
        if has_bucket:
            stack.enter_context(served())
        place = Place(tmp_path / "work", tmp_path / "pool", has_bucket)
        runs = stack.enter_context(guest(place.work, tmp_path / "said.log"))
        drawn = list(draws(place, prepare(place, runs, lambda _: None), runs, seed, range(COUNT)))
    assert [f"seed {seed}: {one.line()}" for one in drawn if one.faults] == []
    assert sum(len(one.kills) for one in drawn) > COUNT  # most commands were killed indeed
