"""Street furniture on a simulated street that no judge was fitted to: types, places and sizes, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.assets.kinds.street_furniture import JUDGES, StreetFurniture, compact_things
from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box
from roadscan.simulate.scene import Scene as StreetScene
from roadscan.simulate.things import objects_table
from tests.assets.streets import Street, street

KINDS = ("cabinet", "bin", "bench", "hydrant", "bus_shelter", "planter", "parking_meter", "sandwich_board")
"""The last three are not sought."""
TYPES = (*JUDGES, "none")


@pytest.fixture(scope="module")
def made() -> StreetScene:
    things = [
        {"what": what, "station_m": 10.0 + 6.0 * k, "offset_m": side * 5.2, "heading_deg": 0.0 if side > 0 else 180.0}
        for k, what in enumerate(KINDS) for side in (-1.0, 1.0)
    ]  # fmt: skip
    return StreetScene.model_validate(
        {
            "seed": 9, "length_m": 64.0, "passes": [{"lane": 2}], "roadside": {"furniture": things},
            "road": {"lanes": 2, "verge_width_m": 8.0, "lead_m": 20.0}, "profilers": {"on": False},
            "vehicle": {"speed_m_per_s": 8.0, "standstill_s": 0.0}, "lidar": {"range_max_m": 40.0},
            "noise": {"lidar_range_m": 0.015, "intensity": 5.0, "dropout": 0.002},
        }
    )  # fmt: skip


@pytest.fixture(scope="module")
def seen(made: StreetScene) -> Street:
    return street(made)


@pytest.mark.slow
def test_furniture_is_found_with_its_type_and_size_and_nothing_else_is(made: StreetScene, seen: Street) -> None:
    returns = seen.returns
    box = Box(-60.0, -60.0, 60.0, 60.0)
    scene = make_scene(returns.at(box.holds(returns.x_m, returns.y_m)), box, box, seen.drive_xyh_m)
    found = StreetFurniture().evidence(scene, None).pieces.to_pylist()
    table = objects_table(made, seen.surface).to_pandas()
    wanted = [row for row in table.itertuples() if row.kind in JUDGES]
    used, right = set(), 0
    for row in wanted:
        near = [k for k, one in enumerate(found)
                if np.hypot(one["easting_m"] - row.easting_m, one["northing_m"] - row.northing_m) < 0.7]  # fmt: skip
        used.update(near)
        right += any(found[k]["type"] == row.kind for k in near)
        for k in near:
            assert abs(found[k]["asset_height_m"] - row.size_up_m) < 0.15
    assert right >= 0.8 * len(wanted)
    assert len(found) - len(used) <= 1


@pytest.mark.slow
def test_things_and_their_features_turn_with_the_street(seen: Street) -> None:
    returns = seen.returns
    box = Box(-60.0, -60.0, 60.0, 60.0)
    rows = np.flatnonzero(box.holds(returns.x_m, returns.y_m))
    own = returns.at(rows)
    drive = seen.drive_xyh_m
    from dataclasses import replace

    turned = replace(
        own, x_m=-own.y_m, y_m=own.x_m, sensor_x_m=-own.sensor_y_m, sensor_y_m=own.sensor_x_m
    )  # a quarter to the left
    first = compact_things(make_scene(own, box, box, drive))
    ways = np.column_stack([-drive[:, 1], drive[:, 0], drive[:, 2:]])
    second = compact_things(make_scene(turned, box, box, ways))
    places = np.array([[one.x_m, one.y_m] for one in second])
    same = 0
    for one in first:
        away = np.hypot(*(places - [-one.y_m, one.x_m]).T)
        other = second[int(away.argmin())]
        same += away.min() < 0.1 and abs(other.height_m - one.height_m) < 0.05
    assert same >= 0.9 * len(first) > 5
