"""Covers and drains of a simulated street that no judge was fitted to: types, places, sizes, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.assets.kinds.cover import Cover
from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box
from roadscan.simulate.scene import Scene as StreetScene
from roadscan.simulate.things import objects_table
from tests.assets.streets import Street, street

PLACES = [("cover", 12.0, 1.6, 0.62, 60.0), ("cover", 20.0, -1.2, 0.7, 160.0), ("cover", 28.0, 2.4, 0.6, 45.0),
          ("cover", 40.0, 0.8, 0.75, 170.0), ("drain", 16.0, 3.15, 0.5, 30.0),
          ("drain", 34.0, 3.15, 0.5, 25.0)]  # fmt: skip
"""Type, station, offset, length and shade."""


@pytest.fixture(scope="module")
def made() -> StreetScene:
    covers = [
        {"what": what, "station_m": at, "offset_m": off, "length_m": size, "shade": shade,
         "width_m": size if what == "cover" else 0.3}
        for what, at, off, size, shade in PLACES
    ]  # fmt: skip
    return StreetScene.model_validate(
        {
            "seed": 14, "length_m": 52.0, "passes": [{"lane": 2}], "profilers": {"on": False},
            "road": {"lanes": 2, "verge_width_m": 8.0, "lead_m": 20.0}, "lidar": {"range_max_m": 40.0},
            "roadside": {
                "covers": covers,
                "parked_cars": [{"station_m": 24.0, "offset_m": -4.5}],
                "poles": [{"station_m": 30.0, "offset_m": 5.0}],
            },
            "vehicle": {"speed_m_per_s": 8.0, "standstill_s": 0.0},
            "noise": {"lidar_range_m": 0.015, "intensity": 5.0, "dropout": 0.002},
        }
    )  # fmt: skip


@pytest.fixture(scope="module")
def seen(made: StreetScene) -> Street:
    return street(made)


@pytest.mark.slow
def test_covers_and_drains_are_found_with_their_type_and_size(made: StreetScene, seen: Street) -> None:
    box, returns = Box(-60.0, -60.0, 60.0, 60.0), seen.returns
    scene = make_scene(returns.at(box.holds(returns.x_m, returns.y_m)), box, box, seen.drive_xyh_m)
    kind = Cover()
    found = list(kind.objects(kind.evidence(scene, None).pieces, None, {}))
    right, used = 0, set()
    for row in objects_table(made, seen.surface).to_pandas().itertuples():
        if row.kind in {"cover", "drain"}:
            away = [np.hypot(one.geometry.x - row.easting_m, one.geometry.y - row.northing_m) for one in found]
            near = [k for k, d in enumerate(away) if d < 0.15]
            used.update(near)
            assert near
            for k in (k for k in near if found[k].attributes["type"] == row.kind):
                right += 1
                size = found[k].attributes["diameter_m" if row.kind == "cover" else "length_m"]
                assert size == pytest.approx(row.length_m, abs=0.15)
    assert right >= 5
    assert len(found) - len(used) <= 1
