"""Painted lines and kerbs near their surveyed place, in drawn readings whose place is known."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.adjust.settings import TargetSettings
from roadscan.adjust.targets.fit import find_line
from roadscan.adjust.targets.shapes import SurveyedLine, TargetReadings

SETTINGS = TargetSettings(search_radius_m=0.5)
AZIMUTH = 0.7


def readings(kind: str, aside_m: float, seed: int, second_m: float | None = None) -> TargetReadings:
    """Readings each 5 mm across and 20 mm along; the line lies so far to the right of its surveyed place."""
    rng = np.random.default_rng(seed)
    along, across = (a.ravel() for a in np.meshgrid(np.arange(-0.8, 0.8, 0.02), np.arange(-1.2, 1.2, 0.005)))
    along, across = (a + rng.normal(0.0, 0.002, a.size) for a in (along, across))
    grey, height = rng.normal(60.0, 6.0, along.size), rng.normal(100.0 - 0.02 * across, 0.001)
    if kind == "paint":
        for middle in (aside_m, *([] if second_m is None else [second_m])):
            grey[np.abs(across - middle) <= 0.075] += 100.0
    else:
        height += 0.12 * np.clip((across - aside_m) / 0.02 + 0.5, 0.0, 1.0)
    sine, cosine = np.sin(AZIMUTH), np.cos(AZIMUTH)
    east, north = along * sine + across * cosine, along * cosine - across * sine
    return TargetReadings(east, north, height, np.clip(grey, 0, 255), 0.3)


@pytest.mark.parametrize("kind", ["paint", "kerb"])
@pytest.mark.parametrize("aside_m", [0.0, 0.31, -0.42])
def test_a_line_is_found_where_it_lies_with_its_sigma(kind: str, aside_m: float) -> None:
    line, normal = SurveyedLine(kind, "edge", AZIMUTH), np.array([np.cos(AZIMUTH), -np.sin(AZIMUTH)])  # type: ignore[arg-type]
    for seed in range(3):
        found = find_line(readings(kind, aside_m, seed), 0.0, 0.0, line, SETTINGS)
        assert found.status == "found"
        sigma = float(np.sqrt(normal @ found.covariance_m2 @ normal))
        assert abs(float(normal @ found.place_m) - aside_m) < 3.0 * sigma
        assert sigma < 0.01
        top = 100.0 - 0.02 * aside_m + (0.12 if kind == "kerb" else 0.0)
        assert abs(found.height.height_m - top) < 0.004


@pytest.mark.parametrize("kind", ["paint", "kerb"])
def test_a_line_that_is_not_there_is_not_found(kind: str) -> None:
    line = SurveyedLine(kind, "edge", AZIMUTH)  # type: ignore[arg-type]
    assert find_line(readings("kerb" if kind == "paint" else "paint", 0.1, 1), 0.0, 0.0, line, SETTINGS).status == (
        "missed"
    )
    assert find_line(readings(kind, 0.9, 1), 0.0, 0.0, line, SETTINGS).status == "missed"


def test_two_painted_lines_are_told_as_such() -> None:
    line = SurveyedLine("paint", "edge", AZIMUTH)
    assert find_line(readings("paint", 0.1, 1, -0.2), 0.0, 0.0, line, SETTINGS).status == "doubled"
