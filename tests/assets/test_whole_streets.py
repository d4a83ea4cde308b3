"""What the stage finds on two whole simulated streets: at least what the manual says (docs/asset-figures.md)."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.asset_scores import calibration_error, figures_of
from benchmarks.asset_streets import motorway, processed, seen_by, town
from benchmarks.bed_streets import town_partly_driven_twice
from benchmarks.bench_asset_probability import HELD_OUT, judged_streets

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(3600)]
SCENES = {"town": town, "motorway": motorway}
SHARES = (
    ": recall",
    ": precision",
    "m, found",
    "m, right",
    "area found",
    "area right",
    "slabs found",
    "F1",
    "type right",
)


MISSED = {"town": {"kerb: within 0.05 m, right": 0.94}, "motorway": {}}
"""Shares that miss their bar, as the page says with the reason, and what they do not fall below."""


@pytest.mark.parametrize("name", SCENES)
def test_a_whole_street(name: str, tmp_path: Path) -> None:
    missed = {}
    for figure in figures_of(processed(SCENES[name](), tmp_path / name)):
        is_share = any(words in figure.what for words in SHARES)
        if figure.other is not None and (figure.value < figure.other if is_share else figure.value > figure.other):
            missed[figure.what] = figure.value
    assert missed.keys() == MISSED[name].keys(), missed
    assert all(missed[what] >= least for what, least in MISSED[name].items()), missed


@pytest.mark.parametrize("seed", [3, 7])
def test_bare_ground_where_passes_differ_in_height_is_not_grown_over(seed: int, tmp_path: Path) -> None:
    """Passes lie 56 and 84 mm apart; with these differences 33 m² of street 3 were landscape areas."""
    street = town_partly_driven_twice(seed)
    bare = street.changed(roadside=street.roadside.model_dump() | {"plantings": [], "trees": []})
    settings = "kinds = ['landscape_area']\nbare_earth = false\nexports = []\n"
    assert not len(processed(seen_by("VLP-16", bare), tmp_path, settings=settings).found("landscape_area"))


def test_probabilities_of_drawn_streets_hold(tmp_path: Path) -> None:
    """The curves were fitted to other streets."""
    objects = judged_streets(HELD_OUT, tmp_path)
    assert len(objects) > 150
    assert calibration_error(objects) <= 0.05  # 0.035 (docs/asset-figures.md)
