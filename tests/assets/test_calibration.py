"""Curves of probabilities: what they have to be by definition; how well they hold is for whole streets to tell."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.asset_scores import Judged
from benchmarks.bench_asset_probability import fitted, of_evidence
from roadscan.assets.kind import AssetKind, asset_kinds
from roadscan.assets.probabilities import CURVES, Curve, curve_named


def test_each_kind_has_a_curve_and_others_none() -> None:
    assert {kind.curve for kind in asset_kinds().values()} - {""} == set(CURVES)  # what is judged needs none
    assert AssetKind.curve == ""
    assert curve_named("").stated(0.7) == pytest.approx(0.7)


@pytest.mark.parametrize("group", CURVES)
def test_more_evidence_is_never_less_probable(group: str) -> None:
    evidence = np.linspace(0.01, 0.99, 99)
    stated = np.array([CURVES[group].stated(p) for p in evidence])
    assert (np.diff(stated) > 0.0).all() and stated[0] > 0.0 and stated[-1] < 1.0
    np.testing.assert_allclose([of_evidence(CURVES[group], p) for p in stated], evidence, atol=1e-6)


def test_the_fit_finds_the_curve_that_objects_were_drawn_from() -> None:
    """2,000 walls whose evidence claims too much: right are as many as the curve says."""
    random, true, now = np.random.default_rng(5), Curve(-0.8, 0.5), CURVES["surfaces"]
    evidence = random.uniform(0.5, 0.999, 2000)
    right = random.random(2000) < [true.stated(p) for p in evidence]
    objects = [Judged("wall", now.stated(p), bool(r)) for p, r in zip(evidence, right, strict=True)]
    found = fitted(objects)
    assert found["surfaces"].offset == pytest.approx(true.offset, abs=0.25)
    assert found["surfaces"].slope == pytest.approx(true.slope, abs=0.1)
    # nothing speaks for other groups: they stay as their evidence has it
    assert found["areas"] == pytest.approx((0.0, 1.0), abs=1e-6)
