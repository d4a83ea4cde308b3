"""Range filter: what it keeps of profiles on a turn does not cross, as Shapely sees it."""

from __future__ import annotations

import numpy as np
import shapely

from roadscan.core.settings.segmentation import RangeFilter
from roadscan.georeference.road_profiles import kept_in_turns, limits_of_turns

REACH_M, RADIUS_M = 8.0, 6.0


def drive(turn: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Path (n,), heading (n,) and places (n, 2): 10 m straight, a turn of 120° (`turn` 1 to the right), straight."""
    path = np.arange(0.0, 10.0 + RADIUS_M * 2.0944 + 10.0, 0.05)
    heading = 3.0 + turn * np.clip(path - 10.0, 0.0, RADIUS_M * 2.0944) / RADIUS_M
    places = np.cumsum(0.05 * np.stack([np.sin(heading), np.cos(heading)], axis=-1), axis=0)
    return path, np.angle(np.exp(1j * heading)), places


def crossing_limits(path_m: np.ndarray, heading_rad: np.ndarray) -> np.ndarray:
    """Limits (n, 2), with path and change of heading taken over the default base around each profile."""
    settings, turned = RangeFilter(), np.unwrap(heading_rad)
    first = np.maximum(np.searchsorted(path_m, path_m - settings.base_m / 2, side="right") - 1, 0)
    last = np.minimum(np.searchsorted(path_m, path_m + settings.base_m / 2, side="left"), path_m.size - 1)
    return limits_of_turns(path_m[last] - path_m[first], turned[last] - turned[first], settings)


def lines(heading: np.ndarray, places: np.ndarray, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The kept pieces of the profiles on the ground."""
    across = np.stack([np.cos(heading), -np.sin(heading)], axis=-1)
    ends = np.stack([places - left[:, None] * across, places + right[:, None] * across], axis=1)
    return shapely.linestrings(ends)


def test_kept_readings_of_neighbouring_profiles_do_not_cross() -> None:
    for turn in (-1, 1):
        path, heading, places = drive(turn)
        limits = np.minimum(crossing_limits(path, heading), REACH_M)
        inner, outer = (1, 0) if turn > 0 else (0, 1)
        middle = slice(240, 400)  # in the turn, away from its ends
        assert np.allclose(limits[middle, inner], RADIUS_M, rtol=0.01)
        assert (limits[:, outer] == REACH_M).all()
        assert (limits[:150] == REACH_M).all()
        whole = lines(heading, places, np.full(path.size, REACH_M), np.full(path.size, REACH_M))
        kept = lines(heading, places, 0.98 * limits[:, 0], 0.98 * limits[:, 1])
        assert shapely.crosses(whole[middle][:-1], whole[middle][1:]).all()
        assert not shapely.crosses(kept[middle][:-1], kept[middle][1:]).any()


def test_noise_of_headings_and_standing_are_no_turns() -> None:
    path = np.concatenate([np.arange(0.0, 10.0, 0.05), np.full(200, 10.0), np.arange(10.0, 20.0, 0.05)])
    heading = np.radians(np.random.default_rng(1).normal(0.0, 0.05, path.size))
    limits = crossing_limits(path, heading)
    across = np.linspace(-REACH_M, REACH_M, 11) + np.zeros((path.size, 1))
    assert kept_in_turns(across, limits).all()
