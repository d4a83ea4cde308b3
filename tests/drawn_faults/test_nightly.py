"""Fifty faults drawn into the demo's logs: how many change a figure beyond its σ, and nothing is said."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.drawn_faults.__main__ import show
from tests.drawn_faults.trial import trials

COUNT = 50
SEED = 1
MOST_SILENT = 0.12
"""Share of silent faults: 3 of the first 25 of this seed were, when it was measured. Zero is the aim: it only falls."""


@pytest.mark.nightly
@pytest.mark.timeout(7_200)
def test_faults_are_named_or_change_nothing(tmp_path: Path) -> None:
    """Each fault is named, or changes no product by more than its σ allows."""
    silent = [f"{one.kind}: {one.words}: {one.changed}" for one in show(trials(tmp_path, COUNT, SEED)) if one.is_silent]
    assert len(silent) <= MOST_SILENT * COUNT, "\n".join(silent)
