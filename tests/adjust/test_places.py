"""Places where drawn tracks meet, against where they do by construction."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from roadscan.adjust.places import Place, Track, places_of_overlap
from roadscan.adjust.settings import PlaceSettings
from roadscan.core.errors import NavigationError

SPEED = 25.0


def track(run: int, easting: np.ndarray, northing: np.ndarray, sensor: str = "p", **given: object) -> Track:
    """A track through points at a speed of 25 m/s; runs are 1,000 s apart."""
    moved = np.hypot(np.diff(easting), np.diff(northing))
    since = np.append(0.0, np.cumsum(moved)) / SPEED + 1000.0 * run
    heading = np.arctan2(np.gradient(easting), np.gradient(northing))
    reach = {"left_m": 2.0, "right_m": 2.0} | given
    return Track(run, sensor, np.rint(since * 1e9).astype(np.int64), easting, northing, np.zeros(easting.size), heading,
                 **reach)  # fmt: skip


def lane(run: int, easting: float, sensor: str = "p", *, back: bool = False, **given: object) -> Track:
    """A kilometre to the north, or back."""
    northing = np.linspace(0.0, 1000.0, 101)
    return track(run, np.full(101, easting), northing[::-1] if back else northing, sensor, **given)


def met(places: list[Place]) -> Counter[tuple[tuple[int, str], ...]]:
    return Counter(tuple((t.run, t.sensor) for t in p.traverses) for p in places)


def test_lanes_side_by_side_meet_in_the_strip_that_both_see() -> None:
    """Lanes 3.6 m apart, 4 m wide: a strip of 0.4 m about 1.8 m; a place each 10 m."""
    places = places_of_overlap([lane(0, 0.0), lane(1, 3.6)], PlaceSettings(per_km=100.0))
    assert len(places) == 101
    assert {round(p.easting_m, 6) for p in places} == {1.8}
    assert np.diff([p.northing_m for p in places]) == pytest.approx(10.0)
    assert [p.number for p in places] == list(range(101))
    middle = places[50].traverses[1]
    assert (middle.first_gps_ns + middle.last_gps_ns) / 2e9 == pytest.approx(1000.0 + 500.0 / SPEED)
    assert (middle.last_gps_ns - middle.first_gps_ns) / 1e9 * SPEED == pytest.approx(2 * (0.5 + 0.3))


def test_lanes_that_do_not_touch_have_no_place() -> None:
    assert places_of_overlap([lane(0, 0.0), lane(1, 4.5)], PlaceSettings()) == []
    assert places_of_overlap([lane(0, 0.0)], PlaceSettings()) == []
    assert places_of_overlap([], PlaceSettings()) == []


def test_the_same_lane_and_the_opposite_direction_share_places() -> None:
    places = places_of_overlap([lane(0, 0.0), lane(1, 0.3), lane(2, 0.1, back=True)], PlaceSettings(per_km=50.0))
    assert met(places) == {((0, "p"), (1, "p"), (2, "p")): 51}
    # Across a wide lane they lie here and there, for the roll.
    assert np.ptp([p.easting_m for p in places]) > 1.5
    back = places[10].traverses[2]
    assert back.first_gps_ns / 1e9 == pytest.approx(2000.0 + (1000.0 - 200.0 - 0.8) / SPEED)


def test_a_track_is_left_to_the_first_that_sees_it() -> None:
    """Of three lanes the middle one leads where it comes first: no place of the others lies in it."""
    places = places_of_overlap([lane(0, 0.0), lane(1, 3.6), lane(2, -3.6)], PlaceSettings(per_km=100.0))
    assert met(places) == {((0, "p"), (1, "p")): 101, ((0, "p"), (2, "p")): 101}


def test_a_crossing_between_two_even_leads_is_found() -> None:
    across = track(1, np.linspace(-200.0, 200.0, 41), np.full(41, 505.0))
    (place,) = places_of_overlap([lane(0, 0.0), across], PlaceSettings(per_km=50.0))
    assert abs(place.northing_m - 505.0) < 2.0
    assert abs(place.easting_m) < 2.0
    above = track(1, np.linspace(-200.0, 200.0, 41), np.full(41, 505.0))
    over = Track(1, "p", above.epoch_gps_ns, above.easting_m, above.northing_m, above.height_m + 6.0,
                 above.heading_rad, 2.0, 2.0)  # fmt: skip
    assert places_of_overlap([lane(0, 0.0), over], PlaceSettings()) == []


def test_a_loop_of_one_run_meets_itself_after_the_stated_time() -> None:
    """Two and a half times around a circle of 100 m radius: 25 s a turn."""
    angle = np.linspace(0.0, 5 * np.pi, 400)
    loop = track(0, 100.0 * np.cos(angle), 100.0 * np.sin(angle))
    places = places_of_overlap([loop], PlaceSettings(per_km=100.0, return_s=20.0))
    assert 60 < len(places) < 100
    assert {len(p.traverses) for p in places} == {2, 3}
    for place in places:
        assert np.hypot(place.easting_m, place.northing_m) == pytest.approx(100.0, abs=1.7)
    assert places_of_overlap([loop], PlaceSettings(return_s=80.0)) == []


def test_heads_of_one_run_are_for_quality_only() -> None:
    heads = [lane(0, 0.0, "left", right_m=0.2), lane(0, 0.0, "right", left_m=0.2)]
    places = places_of_overlap(heads, PlaceSettings(per_km=100.0))
    assert met(places) == {((0, "left"), (0, "right")): 101}
    assert all(p.quality_only(30.0) for p in places)
    again = places_of_overlap([*heads, lane(1, 0.0, "left", right_m=0.2)], PlaceSettings())
    assert not any(p.quality_only(30.0) for p in again)


def test_a_lidar_has_places_of_its_own_drive() -> None:
    (drive,) = [lane(0, 0.0, "lidar", left_m=10.0, right_m=10.0, ahead_m=20.0)]
    places = places_of_overlap([drive], PlaceSettings(per_km=20.0))
    assert len(places) == 21
    assert {(len(p.traverses), p.radius_m) for p in places} == {(1, 8.0)}
    seen = places[10].traverses[0]
    assert (seen.last_gps_ns - seen.first_gps_ns) / 1e9 * SPEED == pytest.approx(2 * (8.0 + 0.3 + 20.0), abs=0.1)


def test_gaps_of_a_trajectory_hold_no_place() -> None:
    one = lane(0, 0.0)
    late = one.epoch_gps_ns + np.where(np.arange(101) > 50, 10**10, 0)
    torn = Track(0, "p", late, one.easting_m, one.northing_m, one.height_m, one.heading_rad, 2.0, 2.0)
    places = places_of_overlap([lane(1, 1.0), torn], PlaceSettings(per_km=200.0))
    at = {round(p.northing_m) for p in places}
    assert at == {*range(0, 1001, 5)} - {505}


def test_tracks_that_go_back_in_time_are_refused() -> None:
    one = lane(0, 0.0)
    with pytest.raises(NavigationError, match="do not ascend"):
        Track(0, "p", one.epoch_gps_ns[::-1], one.easting_m, one.northing_m, one.height_m, one.heading_rad, 2.0, 2.0)
