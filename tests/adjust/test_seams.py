"""What is seen of a seam: two passes over a drawn road, moved, and moved back by their corrections."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.adjust.settings import TieSettings
from roadscan.adjust.tasks.outcome import moved, seam_view
from roadscan.poses.trajectory import Corrections
from tests.adjust.drawn_patches import PLACE, Seen, edge_line, readings
from tests.adjust.test_ties import moved as moved_in_full

SETTINGS = TieSettings()


def constant(correction: np.ndarray) -> Corrections:
    """The same correction at all times."""
    epochs = np.array([-(10**13), 10**13], np.int64)
    return Corrections(epochs, np.tile(correction[:3], (2, 1)), np.tile(correction[3:], (2, 1)))


def test_readings_move_as_the_whole_turn_moves_them() -> None:
    one = readings(edge_line, 0, Seen(), np.random.default_rng(1))
    correction = np.array([0.011, -0.008, 0.02, 0.0004, -0.0003, 0.0002])
    linear, whole = moved(one, constant(correction)), moved_in_full(one, correction)
    for name in ("easting_m", "northing_m", "height_m"):
        np.testing.assert_allclose(getattr(linear, name), getattr(whole, name), atol=1e-6)
    assert moved(one, None) is one


def test_the_step_is_there_before_and_gone_after() -> None:
    rng = np.random.default_rng(2)
    one = readings(edge_line, 0, Seen(noise_m=0.0002), rng)
    other = readings(edge_line, 1, Seen(lift_m=0.012, noise_m=0.0002), rng)
    view = seam_view(PLACE, (one, other), (None, constant(np.array([0.0, 0.0, 0.012, 0.0, 0.0, 0.0]))), SETTINGS)
    assert view is not None
    before, after = view.median_m
    assert before == pytest.approx(0.012, abs=1e-4)
    assert after == pytest.approx(0.0, abs=1e-4)
    step = np.nanmean(view.section_m[:, 1] - view.section_m[:, 0], axis=1)
    np.testing.assert_allclose(step, [0.012, 0.0], atol=2e-4)
    np.testing.assert_array_equal(view.section_m[0, 0], view.section_m[1, 0])


def test_passes_that_share_no_cell_make_no_view() -> None:
    rng = np.random.default_rng(3)
    one, other = (readings(edge_line, run, Seen(), rng) for run in (0, 1))
    away = constant(np.array([100.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert seam_view(PLACE, (one, other), (None, away), SETTINGS) is None
