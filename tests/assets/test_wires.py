"""Overhead wires of a simulated street that the judge was not fitted to: place, sag, clearance, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from roadscan.assets.kernels.cubes import lines_through
from roadscan.assets.kind import AssetObject
from roadscan.assets.kinds.wire import Wire
from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box
from roadscan.simulate.scene import Scene as StreetScene
from tests.assets.streets import Street, street

SAGS_M = (0.25, 0.4, 0.25, 0.15)
"""Two spans beside the road, one conductor below the second, one across the road."""


@pytest.fixture(scope="module")
def seen() -> Street:
    along = {"offset_m": 5.6, "to_offset_m": 5.6, "diameter_m": 0.025}
    wires = [
        {"station_m": 5.0, "to_station_m": 30.0, "height_m": 6.5, "to_height_m": 6.5, "sag_m": SAGS_M[0], **along},
        {"station_m": 30.0, "to_station_m": 55.0, "height_m": 6.5, "to_height_m": 6.5, "sag_m": SAGS_M[1], **along},
        {"station_m": 30.0, "to_station_m": 55.0, "height_m": 5.9, "to_height_m": 5.9, "sag_m": SAGS_M[2], **along},
        {"station_m": 30.0, "to_station_m": 31.0, "height_m": 6.2, "to_height_m": 5.5, "sag_m": SAGS_M[3],
         "offset_m": 5.6, "to_offset_m": -9.0, "diameter_m": 0.02},
    ]  # fmt: skip
    scene = StreetScene.model_validate(
        {
            "seed": 12, "length_m": 60.0, "passes": [{"lane": 2}], "profilers": {"on": False},
            "road": {"lanes": 2, "verge_width_m": 8.0, "lead_m": 20.0}, "lidar": {"range_max_m": 50.0},
            "roadside": {
                "wires": wires,
                "poles": [{"station_m": s, "offset_m": 5.6, "height_m": 6.8} for s in (5.0, 30.0, 55.0)],
                "lamp_posts": [{"station_m": 18.0, "offset_m": -5.5}],
                "trees": [{"station_m": 45.0, "offset_m": -7.0}],
                "facades": [{"start_m": 0.0, "end_m": 60.0, "offset_m": -10.0}],
            },
            "vehicle": {"speed_m_per_s": 8.0, "standstill_s": 0.0}, "noise": {"lidar_range_m": 0.015},
        }
    )  # fmt: skip
    return street(scene)


@pytest.fixture(scope="module")
def found(seen: Street) -> list[AssetObject]:
    box = Box(-60.0, -60.0, 60.0, 60.0)
    returns = seen.returns
    scene = make_scene(returns.at(box.holds(returns.x_m, returns.y_m)), box, box, seen.drive_xyh_m)
    return list(Wire().objects(Wire().evidence(scene, None).pieces, None, {}))


@pytest.mark.slow
def test_wires_are_found_from_support_to_support_and_nothing_else_is(found: list[AssetObject], seen: Street) -> None:
    lengths = sorted(one.geometry.length for one in found)
    assert len(found) == 4
    assert lengths == pytest.approx([14.6, 25.0, 25.0, 25.0], abs=2.0)
    assert all(one.probability > 0.8 for one in found)


@pytest.mark.slow
def test_sag_and_clearance_are_those_of_the_wires(found: list[AssetObject]) -> None:
    along = [one for one in found if one.geometry.length > 20.0]
    assert sorted(one.attributes["sag_m"] for one in along) == pytest.approx(sorted(SAGS_M[:3]), abs=0.06)
    lowest = sorted(one.attributes["clearance_m"] for one in along)
    assert lowest == pytest.approx([5.65, 6.1, 6.25], abs=0.1)


@pytest.mark.slow
def test_a_wire_is_the_same_wherever_squares_are_cut(seen: Street) -> None:
    returns, wire = seen.returns, Wire()
    whole = Box(-60.0, -60.0, 60.0, 60.0)
    tables = []
    for tiles in ([whole], [Box(-60.0, -60.0, 2.0, 60.0), Box(2.0, -60.0, 60.0, 60.0)]):
        pieces = []
        for tile in tiles:
            window = Box(tile.x_min_m - 8.0, tile.y_min_m - 8.0, tile.x_max_m + 8.0, tile.y_max_m + 8.0)
            kept = returns.at(window.holds(returns.x_m, returns.y_m))
            pieces += wire.evidence(make_scene(kept, tile, window, seen.drive_xyh_m), None).pieces.to_pylist()
        tables.append({(round(p["easting_m"], 3), round(p["northing_m"], 3), p["filled"]) for p in pieces})
    assert tables[0] and len(tables[0] ^ tables[1]) <= 0.01 * len(tables[0])


def test_the_line_of_a_cube_is_that_of_the_cubes_about_it() -> None:
    along = np.arange(-6, 7) * 0.25
    line = np.column_stack([along * 0.6, along * 0.8, 0.01 * (-1.0) ** np.arange(13)])
    middle = np.concatenate([line, [[0.3, -0.3, 0.0], [0.0, 0.0, 3.0]]])
    chosen, starts, near = np.array([6]), np.array([0, 14]), np.arange(14)
    filled, beside, way = np.zeros(1, np.int64), np.zeros(1, np.int64), np.zeros((1, 3))
    lines_through(middle, chosen, starts, near, np.array([0.25, 0.5, 0.35, 0.07, 0.15, 0.6]), filled, beside, way)
    assert filled[0] == 13 and beside[0] == 1
    assert way[0] == pytest.approx([0.6, 0.8, 0.0], abs=0.03)
    assert shapely.LineString(line).length == pytest.approx(3.0, abs=0.05)
