"""Sizes and middles of signs of all shapes, against the simulator's truth."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from roadscan.assets.kinds.sign import SignOptions, plates_of
from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box
from roadscan.simulate.scene import Scene as StreetScene
from roadscan.simulate.things import objects_table
from tests.assets.streets import street

SIGNS = (
    ("rectangle", 3.2, 2.2, 9.0), ("rectangle", 0.6, 0.9, -6.0), ("round", 0.7, 0.7, 6.0), ("octagon", 0.9, 0.9, -9.0),
    ("diamond", 0.8, 0.8, 7.5), ("triangle", 0.9, 0.9, -7.0),
)  # fmt: skip
"""Shape, width, height and offset (m)."""
TALL = {"triangle": math.sqrt(3.0) / 2.0}


SWEEP_NS = 100_000_000  # The lidar turns ten times a second.


@pytest.mark.slow
@pytest.mark.parametrize("stamps", ["firings", "sweeps"])
def test_sizes_of_signs_of_all_shapes_at_eighty_km_h(stamps: str) -> None:
    signs = [
        {"station_m": 16.0 + 3.0 * k, "offset_m": offset, "shape": shape, "width_m": wide, "height_m": tall}
        for k, (shape, wide, tall, offset) in enumerate(SIGNS)
    ]
    made = StreetScene.model_validate(
        {
            "seed": 4, "length_m": 32.0, "passes": [{"lane": 2}], "roadside": {"signs": signs},
            "road": {"lanes": 2, "verge_width_m": 12.0, "lead_m": 70.0}, "profilers": {"on": False},
            "vehicle": {"speed_m_per_s": 22.0, "standstill_s": 0.0}, "lidar": {"range_max_m": 30.0},
            "noise": {"lidar_range_m": 0.015, "intensity": 5.0, "dropout": 0.002},
        }
    )  # fmt: skip
    seen = street(made)
    returns = seen.returns
    if stamps == "sweeps":  # one stamp for all returns of a sweep, as readers of compensated sweeps give them
        returns = replace(returns, epoch_gps_ns=returns.epoch_gps_ns // SWEEP_NS * SWEEP_NS)
        returns = returns.at(np.lexsort((returns.height_m, returns.laser, returns.epoch_gps_ns)))
    box = Box(-60.0, -60.0, 60.0, 60.0)
    scene = make_scene(returns.at(box.holds(returns.x_m, returns.y_m)), box, box, seen.drive_xyh_m)
    plates = [p for p in plates_of(scene, SignOptions()) if p.probability >= 0.5]
    table = objects_table(made, seen.surface).to_pandas()
    things = table[table.kind == "sign"].sort_values("station_m").itertuples()
    assert len(plates) == len(SIGNS)
    for (shape, wide, tall, _), thing in zip(SIGNS, things, strict=True):
        # The plate stands 4 cm before its post, towards traffic that comes from behind.
        facing, high = math.radians(thing.heading_deg + 90.0), TALL.get(shape, 1.0) * tall
        x, y = thing.easting_m - returns.corner_m[0], thing.northing_m - returns.corner_m[1]
        middle = (x + 0.04 * math.sin(facing), y + 0.04 * math.cos(facing), thing.height_m + 2.2 + high / 2)
        found = min(plates, key=lambda p: math.dist(p.middle_m, middle))
        assert found.outline.shape == shape
        assert math.dist(found.middle_m, middle) < 0.03
        assert np.abs([found.outline.width_m - wide, found.outline.height_m - high]).max() < 0.05
