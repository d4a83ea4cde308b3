"""Reference lines and lanes from drives and layers: known ways give known lines, offsets and directions."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from roadscan.condition import road_line
from roadscan.condition.lane_data import located
from roadscan.condition.road_line import Lane, RoadLine
from roadscan.condition.roads import Drive, StatedLine, find_roads
from roadscan.condition.settings import ConditionConfig

Float64 = npt.NDArray[np.float64]


def straight(offset_m: float, from_m: float = 0.0, to_m: float = 300.0) -> Float64:
    """A way along y at a distance to the right of it, that wanders by 50 mm."""
    way = np.arange(from_m, to_m, 0.5 if to_m > from_m else -0.5)
    return np.column_stack([offset_m + 0.05 * np.sin(way / 11.0), way])


def test_drives_there_and_back_share_a_line_and_have_lanes_of_their_own() -> None:
    drives = [Drive(1, straight(2.0)), Drive(2, straight(-1.5, 290.0, -5.0)), Drive(3, straight(2.3))]
    lines, lanes = find_roads(drives, [], ConditionConfig(reference="drive"))
    assert [line.road for line in lines] == ["road1"]
    assert lines[0].length_m == pytest.approx(299.0, abs=1.1)
    assert [(lane.name, lane.sign, lane.passes) for lane in lanes] == [("1", -1, (2,)), ("2", 1, (1, 3))]
    assert np.median(lanes[0].offset_m) == pytest.approx(-3.5, abs=0.03)
    assert np.median(lanes[1].offset_m) == pytest.approx(0.15, abs=0.03)
    assert (lanes[0].first_m, lanes[0].last_m) == (0, pytest.approx(290, abs=1))


def test_a_drive_that_turns_round_has_one_line_and_two_lanes() -> None:
    turn = np.linspace(0.0, np.pi, 40)[1:-1]
    arc = np.column_stack([-4.0 + 4.0 * np.cos(turn), 200.0 + 4.0 * np.sin(turn)])
    there, back = straight(0.0, 0.0, 200.0), straight(-8.0, 200.0, 0.0)
    lines, lanes = find_roads([Drive(1, np.vstack([there, arc, back]))], [], ConditionConfig())
    assert len(lines) == 1
    assert [lane.sign for lane in lanes] == [-1, 1]
    assert np.median(lanes[0].offset_m) == pytest.approx(-8.0, abs=0.05)


def test_names_of_passes_are_names_of_lanes_and_crossings_make_none() -> None:
    crossing = np.column_stack([np.arange(-100.0, 100.0, 0.5), np.full(400, 150.0)])
    drives = [Drive(1, straight(0.0), "outer"), Drive(2, crossing)]
    lines, lanes = find_roads(drives, [], ConditionConfig())
    assert [lane.name for lane in lanes if lane.road == "road1"] == ["outer"]
    assert {lane.road for lane in lanes} == {line.road for line in lines} and len(lines) in (2, 3)
    assert all(lane.passes == ((1,) if lane.road == "road1" else (2,)) for lane in lanes)
    assert lines[0].length_m == pytest.approx(299.0, abs=1.1)


def test_a_layer_states_lines_names_measures_and_lanes() -> None:
    config = ConditionConfig.parse({
        "reference": "layer", "layer": "line.gpkg",
        "lanes": [{"name": "R1", "offset_m": 1.8, "width_m": 3.6}, {"name": "L1", "offset_m": -1.8, "width_m": 3.6,
                                                                   "direction": "backward"}],
    })  # fmt: skip
    stated = [
        StatedLine("A9", np.array([[0.0, -50.0], [0.0, 400.0]]), "Ring road", 10.0, 10.45),
        StatedLine("B1", np.array([[900.0, 0.0], [900.0, 100.0]])),
    ]
    lines, lanes = find_roads([Drive(7, straight(1.7))], stated, config)
    assert [(line.road, line.name) for line in lines] == [("A9", "Ring road")]
    assert lines[0].measures(np.array([0.0, 450.0])).tolist() == pytest.approx([10.0, 10.45])
    assert [(lane.name, lane.sign, lane.width_from, lane.passes) for lane in lanes] == [
        ("L1", -1, "stated", ()),
        ("R1", 1, "stated", (7,)),
    ]
    assert (lanes[1].first_m, lanes[1].last_m) == (pytest.approx(50, abs=1), pytest.approx(349, abs=1))


def test_a_standing_vehicle_makes_no_road() -> None:
    noise = np.random.default_rng(0).normal(0.0, 0.01, (500, 2))
    assert find_roads([Drive(1, noise), Drive(2, np.zeros((0, 2)))], [], ConditionConfig()) == ([], [])


def test_places_and_back() -> None:
    angle = np.arange(200) / 80.0
    line = RoadLine("r", np.column_stack([80.0 * np.sin(angle), 80.0 * (np.cos(angle) - 1.0)]))
    lane = Lane("r", "1", -1, 0, np.full(200, -1.75), 3.5, "stated", ())
    station, own = np.array([60.0, 63.3, 71.0]), np.array([0.0, 1.2, -0.9])
    places = line.places(station, lane.offsets(station, own))
    found = located(line, lane, places[:, :2], 65.0)
    np.testing.assert_allclose(found[0], station, atol=1e-6)
    np.testing.assert_allclose(found[1], own, atol=1e-6)
    assert line.curvature_per_m(station) == pytest.approx(1 / 80.0, rel=1e-3)
    part = line.stretch(60.0, 72.0)
    np.testing.assert_array_equal(part.places(station, 0.0), line.places(station, 0.0))


def test_settings_that_contradict_one_another_are_refused() -> None:
    with pytest.raises(Exception, match="belong together"):
        ConditionConfig.parse({"reference": "layer"})
    with pytest.raises(Exception, match="same name"):
        ConditionConfig.parse({"lanes": [{"name": "1", "offset_m": 0.0, "width_m": 3.0}] * 2})


def test_one_place_is_handed_to_the_kernel_as_an_array_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """A view of what NumPy broadcasts warns where the kernel asks whether it may be written to."""
    handed: list[np.ndarray] = []
    monkeypatch.setattr(road_line, "place", lambda *arrays: handed.extend(arrays[2:4]))
    road_line.RoadLine("a", np.column_stack([np.arange(50.0), np.zeros(50)]), 0).places(np.array([5.0]), 0.0)
    assert [a.flags.owndata for a in handed] == [True, True]
