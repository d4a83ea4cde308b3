"""Measuring in recorded pictures (SemanticKITTI 00): the road's returns of a sweep, found again from their pixels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from roadscan.measuring.measure import measure
from roadscan.run.session import Session
from tests.viewer.recorded_street import recorded_street

pytestmark = pytest.mark.nightly

ROAD = 40  # Label of SemanticKITTI.
PICTURE = 3


def test_returns_of_the_road_are_found_again_from_their_pixels(recordings: Path, tmp_path: Path) -> None:
    street = recorded_street(recordings / "semantic_kitti_00", tmp_path)
    road = street.places[street.labels == ROAD]
    ahead, pixel = street.depth_m(road, PICTURE), street.pixel(road, PICTURE)
    seen = (ahead > 5.0) & (ahead < 15.0) & (pixel >= 5.0).all(axis=1) & (pixel[:, 0] < 1230.0) & (pixel[:, 1] < 370.0)
    chosen = np.random.default_rng(3).choice(np.flatnonzero(seen), 300, replace=False)
    session = Session.open(street.site.parent / "SURVEY.toml")
    found = measure(session, f"{PICTURE:06d}.png", pixel[chosen]).places
    kept = np.array([not one.reason for one in found])
    assert kept.mean() > 0.95
    places = np.array([one.place_m for one in found])[kept]
    error = places - road[chosen][kept]
    away = np.hypot(*error[:, :2].T)
    # Cells are 0.2 m wide, and a ray meets the road at 6 to 20°.
    assert np.median(away) < 0.06 and np.quantile(away, 0.95) < 0.25 and np.median(np.abs(error[:, 2])) < 0.02
