"""Fifty faults drawn into the demo's logs: how many change a figure beyond its σ, and nothing is said."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.drawn_faults.__main__ import show
from tests.drawn_faults.trial import trials

COUNT = 50
SEED = 1
MOST_SILENT = 0.02
"""Share of silent faults: 1 of 50 of this seed was (a lidar turned by 2.6° in heading), 0 of 50 of seed 2. Zero is the
aim: it only falls."""
MOST_OTHERWISE = 0.04
"""Share of faults for which something else was blamed alone: 1 of 50 of this seed, 1 of 50 of seed 2. It only falls."""


@pytest.mark.nightly
@pytest.mark.timeout(7_200)
def test_faults_are_named_or_change_nothing(tmp_path: Path) -> None:
    """Each fault is named, or changes no product by more than its σ allows."""
    found = show(trials(tmp_path, COUNT, SEED))
    silent = [f"{one.kind}: {one.words}: {one.changed}" for one in found if one.is_silent]
    otherwise = [f"{one.kind}: {one.words}: {one.named}" for one in found if one.is_named_otherwise]
    assert len(silent) <= MOST_SILENT * COUNT, "\n".join(silent)
    assert len(otherwise) <= MOST_OTHERWISE * COUNT, "\n".join(otherwise)
