"""Roads over one another, both driven: nothing of one drive is judged by the ground of the other."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from roadscan.assets import classes
from roadscan.assets.edges.road_edges import EDGE_COLUMNS, edge_lines, station_pieces
from roadscan.assets.edges.tracks import tracks_of
from roadscan.assets.kinds.clearance import ClearanceOptions, lowest_places, overhead_cells
from roadscan.assets.make_scene import by_level, make_scene
from roadscan.assets.scene import Box, GroundModel, Returns, Scene
from roadscan.compute.arrays import way_along

Float64 = npt.NDArray[np.float64]

HALF_M = 30.0
TOP_M, UNDER_M, BEAM_M = 6.0, 5.2, 11.5
"""Heights of the upper road, of the underside of its deck and of a beam across it, above the lower road (m)."""
DECK_M = (5.5, 8.2)
"""Half width and half length of the deck (m)."""
KERB_M, STEP_M = 4.0, 0.12
"""Each road has a kerb so far beside its middle (m), so high (m)."""
SENSOR_M = 2.0
WAY = np.arange(-HALF_M, HALF_M, 0.25)
LOWER = np.column_stack([WAY, np.full(WAY.size, -2.0), np.full(WAY.size, SENSOR_M), np.full(WAY.size, 1.0)])
UPPER = np.column_stack([
    np.full(WAY.size, 2.0), WAY, np.full(WAY.size, TOP_M + SENSOR_M), np.full(WAY.size, 2.0)
])  # fmt: skip


def seen_from(points: Float64, drive: Float64, rng: np.random.Generator) -> Float64:
    """Points (n, 3) within 20 m of a drive (p, 4), with a place from where each was seen, and the pass: (n, 7)."""
    place = drive[rng.integers(0, len(drive), len(points))]
    rows = np.hypot(*(points - place[:, :3])[:, :2].T) < 20.0
    return np.hstack([points[rows], place[rows]])


def overpass(beam: bool) -> tuple[Returns, Float64]:
    """What two passes see of an overpass, 1 on the lower road to the east, 2 on the upper one to the north."""
    rng = np.random.default_rng(20261130)

    def spread(count: int, x_m: float, y_m: float, height_m: float) -> Float64:
        return np.column_stack([rng.uniform(-x_m, x_m, count), rng.uniform(-y_m, y_m, count), np.full(count, height_m)])

    ground = spread(600_000, HALF_M, HALF_M, 0.0)
    beside = np.abs(ground[:, 1]) > DECK_M[1]
    ground = ground[~beside | (np.abs(ground[:, 0]) > DECK_M[0])]
    beside = np.abs(ground[:, 1]) > DECK_M[1]
    ground[beside, 2] = np.maximum(TOP_M - (np.abs(ground[beside, 0]) - DECK_M[0]) / 1.5, 0.0)
    ground[(np.abs(ground[:, 1]) > KERB_M) & ~beside, 2] = STEP_M
    below = [ground, spread(30_000, *DECK_M, UNDER_M)]
    above = [spread(240_000, DECK_M[0], HALF_M, TOP_M)]
    above[0][np.abs(above[0][:, 0]) > KERB_M, 2] += STEP_M
    if beam:
        above.append(spread(3_000, DECK_M[0], 1.0, BEAM_M))
    rows = np.concatenate([
        seen_from(np.concatenate(below), LOWER, rng), seen_from(np.concatenate(above), UPPER, rng)
    ])  # fmt: skip
    rows[:, 2] += rng.normal(0.0, 0.01, len(rows))
    number, byte, ones = np.arange(len(rows)), np.zeros(len(rows), np.uint8), np.ones(len(rows), np.uint8)
    returns = Returns(
        (0.0, 0.0), *np.ascontiguousarray(rows[:, :3].T), np.full(len(rows), 9e3, np.float32),
        number + 10**18, rows[:, 6].astype(np.uint16), byte, byte.astype(np.uint16), ones, ones,
        *np.ascontiguousarray(rows[:, 3:6].T), ("lidar",),
    )  # fmt: skip
    return returns, np.concatenate([LOWER, UPPER])


@pytest.fixture(scope="module", params=[False, True], ids=["open", "beam"])
def scene(request: pytest.FixtureRequest) -> Scene:
    """The scene of the overpass, without and with a beam over the upper road."""
    box = Box(-HALF_M, -HALF_M, HALF_M, HALF_M)
    returns, drive = overpass(request.param)
    return make_scene(returns, box, box, drive)


def test_clearance_is_below_the_deck_and_above_the_road_of_the_drive(scene: Scene) -> None:
    found = lowest_places(overhead_cells(scene, ClearanceOptions()), 10.0)
    of_lower, of_upper = ([one for one in found if one["pass_id"] == number] for number in (1, 2))
    beam = bool((scene.returns.height_m > TOP_M + SENSOR_M).any())
    assert len(of_lower) == 1
    assert abs(of_lower[0]["clearance_m"] - UNDER_M) < 0.05  # the noise is 10 mm, and the lowest place is listed
    assert len(of_upper) == beam
    if beam:
        assert abs(of_upper[0]["clearance_m"] - (BEAM_M - TOP_M)) < 0.05
        assert abs(of_upper[0]["height_m"] - BEAM_M) < 0.05


def test_a_deck_that_is_driven_on_is_ground_and_road(scene: Scene) -> None:
    r = scene.returns
    deck = (np.abs(r.x_m) < DECK_M[0]) & (np.abs(r.y_m) < DECK_M[1])
    deck &= (np.abs(r.x_m) < KERB_M - 0.3) & (np.abs(r.y_m) < DECK_M[1] - 0.5)
    top, under, road = (scene.classes[deck & (np.abs(r.height_m - at) < 0.1)] for at in (TOP_M, UNDER_M, 0.0))
    assert (top == classes.ROAD).mean() > 0.9
    assert np.isin(top, (classes.ROAD, classes.GROUND)).mean() > 0.99
    assert (under == classes.BRIDGE_DECK).mean() > 0.95
    assert (road == classes.ROAD).mean() > 0.8


def test_road_edges_have_the_height_of_their_drive(scene: Scene) -> None:
    """Those of the deck are left out, whose ground the raster of bare earth does not hold."""
    pieces = station_pieces(scene)
    place = pieces["place"].combine_chunks().flatten().to_numpy().reshape(-1, 6)
    pass_id = pieces["pass_id"].combine_chunks().flatten().to_numpy()
    assert np.ptp(place[pass_id == 1, 0]) > 2.0 * HALF_M - 2.0
    upper = place[pass_id == 2, 1]
    assert (np.abs(upper) > DECK_M[1] - 1.0).all()
    assert min(np.ptp(upper[upper < 0.0]), np.ptp(upper[upper > 0.0])) > HALF_M - DECK_M[1] - 2.0
    lines = edge_lines(pieces)
    nodes = np.column_stack([lines[name].combine_chunks().flatten().to_numpy() for name in EDGE_COLUMNS[:3]])
    lower = np.abs(np.abs(nodes[:, 1]) - KERB_M) < 0.2
    assert np.abs(nodes[lower, 2]).max() < 0.05
    assert np.abs(nodes[~lower, 2] - TOP_M).max() < 0.05
    for sign in (-1.0, 1.0):
        assert np.ptp(nodes[lower & (sign * nodes[:, 1] > 0.0), 0]) > 2.0 * HALF_M - 3.0


def moved(drive: Float64, north_m: float = 0.0, up_m: float = 0.0, pass_id: int = 0) -> Float64:
    """A drive that runs elsewhere, of a pass with another number."""
    return np.asarray(drive + np.array([0.0, north_m, up_m, pass_id]))


def flat(height_m: float) -> GroundModel:
    """Level ground, seen everywhere."""
    cells = np.full((240, 240), height_m, np.float32)
    return GroundModel(-HALF_M, -HALF_M, 0.25, cells, np.ones(cells.shape, np.bool_))


def test_a_drive_has_the_ground_or_the_height_of_its_road() -> None:
    drives = np.concatenate([LOWER, UPPER])
    on_ground, hidden = by_level(drives, flat(0.0))
    np.testing.assert_array_equal(on_ground, LOWER)
    np.testing.assert_array_equal(hidden[:, [0, 1, 3]], UPPER[:, [0, 1, 3]])
    assert np.isnan(hidden[:, 2]).all()  # the pass is never on ground that is known
    ramp = UPPER.copy()
    ramp[:160, 2] = SENSOR_M  # more of the pass lies on the ground
    on_ground, hidden = by_level(np.concatenate([LOWER, ramp]), flat(0.0))
    assert len(on_ground) == len(LOWER) + 160
    np.testing.assert_allclose(hidden[:, 2], TOP_M)
    on_ground, hidden = by_level(drives, flat(TOP_M))
    np.testing.assert_array_equal(on_ground, UPPER)
    np.testing.assert_array_equal(hidden[:, 3], LOWER[:, 3])


def test_without_a_drive_on_the_ground_nothing_tells_of_levels() -> None:
    flown = moved(UPPER, up_m=60.0)
    on_ground, hidden = by_level(flown, flat(0.0))
    np.testing.assert_array_equal(on_ground, flown)
    assert len(hidden) == 0
    assert len(by_level(LOWER, flat(np.nan))[1]) == 0


def test_drives_over_one_another_have_their_stations_and_two_vehicles_on_a_road_have_one_track() -> None:
    def ways(*drives: Float64) -> dict[int, float]:
        found: dict[int, float] = {}
        for track in tracks_of(np.concatenate(drives)):
            found[track.pass_id] = found.get(track.pass_id, 0.0) + float(way_along(track.places)[-1])
        return found

    assert ways(LOWER, UPPER) == pytest.approx({1: 59.75, 2: 59.75})
    level = moved(UPPER, up_m=-TOP_M)
    assert ways(LOWER, level)[2] == pytest.approx(59.75 - 16.0, abs=1.5)
    lorry = moved(LOWER, 3.0, 1.8, 1)
    assert ways(LOWER, lorry) == pytest.approx({1: 59.75})
    helix = np.vstack([LOWER, UPPER]) * [1.0, 1.0, 1.0, 0.0]
    assert ways(helix)[0] == pytest.approx(2 * 59.75)
    both = np.vstack([LOWER, moved(LOWER[::-1], 2.0, TOP_M)])
    assert ways(both)[1] == pytest.approx(2 * 59.75, abs=4.0)
    assert ways(LOWER, UPPER, moved(lorry, pass_id=1)).keys() == {1, 2}
