"""A short simulated street with a thing of each upright kind, as one pass of a spinning lidar sees it."""

from __future__ import annotations

import functools

import numpy as np
import pandas as pd

from roadscan.assets.kind import AssetObject, asset_kinds
from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box, Scene
from roadscan.simulate.scene import Scene as StreetScene
from roadscan.simulate.things import objects_table
from tests.assets.streets import street

ROADSIDE = {
    "facades": [{"offset_m": -12.0, "start_m": 14.0, "end_m": 40.0, "height_m": 8.0}],
    "guardrails": [{"offset_m": -6.5, "start_m": -4.0, "end_m": 14.0}],
    "fences": [{"offset_m": 11.0, "start_m": -2.0, "end_m": 22.0, "height_m": 1.5}],
    "boxes": [{"station_m": 31.0, "offset_m": 9.5, "length_m": 10.0, "width_m": 0.3, "height_m": 1.9}],
    "trees": [{"station_m": 5.0, "offset_m": 8.0, "every_m": 15.0, "count": 2, "height_m": 8.0, "trunk_m": 0.3}],
    "lamp_posts": [
        {"station_m": 12.0, "offset_m": 6.2, "height_m": 6.0, "arm_m": 4.5},
        {"station_m": 34.0, "offset_m": 6.2, "height_m": 6.0, "arm_m": 1.8, "is_double": True},
    ],
    "signals": [
        {"station_m": 30.0, "offset_m": 6.0},
        {"station_m": 34.0, "offset_m": -6.6, "height_m": 5.8, "arm_m": 2.2, "diameter_m": 0.18},
    ],
    "poles": [
        {"station_m": 20.0, "offset_m": -7.5, "every_m": 8.0, "count": 2, "height_m": 4.0, "diameter_m": 0.10},
        {"station_m": 24.0, "offset_m": -8.0, "height_m": 5.0, "diameter_m": 0.25},
        {"station_m": 8.0, "offset_m": -9.0, "every_m": 4.0, "count": 2, "height_m": 1.0, "diameter_m": 0.12},
    ],
    "signs": [
        {"station_m": 26.0, "offset_m": 6.0, "shape": "rectangle", "width_m": 0.9, "height_m": 0.6},
        {"station_m": 16.0, "offset_m": -6.6, "shape": "round"},
    ],
}


@functools.cache
def simulated() -> tuple[Scene, pd.DataFrame]:
    """The scene, and what stands in it: the truth's table with x, y from the corner of the returns."""
    made = StreetScene.model_validate(
        {
            "seed": 11, "length_m": 36.0, "passes": [{"lane": 2}], "roadside": ROADSIDE,
            "road": {"lanes": 2, "verge_width_m": 12.0, "verge_slope": 0.02, "lead_m": 70.0},
            "vehicle": {"speed_m_per_s": 16.0, "standstill_s": 0.0}, "profilers": {"on": False},
            "lidar": {"range_max_m": 30.0}, "noise": {"lidar_range_m": 0.015, "intensity": 5.0, "dropout": 0.002},
        }
    )  # fmt: skip
    seen = street(made)
    table = objects_table(made, seen.surface).to_pandas()
    returns = seen.returns
    table["x"], table["y"] = table.easting_m - returns.corner_m[0], table.northing_m - returns.corner_m[1]
    low, high = np.floor(table[["x", "y"]].min() / 10 - 1) * 10, np.ceil(table[["x", "y"]].max() / 10 + 1) * 10
    box = Box(float(low.x), float(low.y), float(high.x), float(high.y))
    inside = box.holds(returns.x_m, returns.y_m)
    return make_scene(returns.at(inside), box, box, seen.drive_xyh_m), table


def objects_of(scene: Scene, kind: str) -> list[AssetObject]:
    """Objects of a kind in one scene."""
    one = asset_kinds()[kind]
    return list(one.objects(one.evidence(scene, one.options()).pieces, one.options(), {}))
