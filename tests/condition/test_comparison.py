"""Sections of two surveys and their changes, against SciPy's normal distribution and lines drawn by hand."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from scipy.stats import norm

from roadscan.condition.tasks.compare import change_of, matched_sections


def line(x0: float, x1: float, y: float = 0.0) -> shapely.LineString:
    return shapely.LineString([(x0, y), ((x0 + x1) / 2, y), (x1, y)])


def test_sections_are_matched_by_place_lane_and_direction() -> None:
    earlier = np.array([line(0, 100), line(100, 200), line(0, 100, 3.5), line(100, 0, 0.2)])
    later = np.array(
        [line(101, 200, 0.3), line(0, 100, 3.4), line(100, 0), line(4, 104, -0.5), line(30, 130), line(900, 950)]
    )
    pairs, alone = matched_sections(earlier, later)
    assert [(p.later, p.earlier) for p in pairs] == [(0, 1), (1, 2), (2, 3), (3, 0)]
    assert pairs[3].share == pytest.approx(0.96) and pairs[0].share == pytest.approx(0.99)
    assert alone.tolist() == [4, 5]  # 70 m of 100 in common; nothing near
    assert matched_sections(earlier[:0], later)[1].size == later.size


@pytest.mark.parametrize(("before", "after", "sigma"), [(2.0, 2.3, 0.1), (2.0, 1.5, 0.2), (2.0, 2.01, 0.05)])
def test_a_change_is_judged_by_both_errors(before: float, after: float, sigma: float) -> None:
    found = change_of(before, after, sigma, 2 * sigma)
    z = (after - before) / (sigma * 5**0.5)
    assert found.p_value == pytest.approx(2 * norm.sf(abs(z)), rel=1e-9)
    told = "no change shown" if found.p_value >= 0.05 else ("larger" if z > 0 else "smaller")
    assert found.verdict == told


def test_without_sigma_or_value_nothing_is_judged() -> None:
    assert change_of(1.0, 2.0, float("nan"), 0.1).verdict == "not judged"
    assert change_of(float("nan"), 2.0, 0.1, 0.1).verdict == "not judged"
    assert change_of(1.0, 2.0, 0.0, 0.0).verdict == "not judged"


def test_unchanged_sections_are_told_as_changed_once_in_twenty() -> None:
    rng = np.random.default_rng(7)
    told = [change_of(a, b, 0.1, 0.1).verdict for a, b in rng.normal(2.0, 0.1, (4000, 2))]
    assert 0.04 < sum(v in ("larger", "smaller") for v in told) / 4000 < 0.06
