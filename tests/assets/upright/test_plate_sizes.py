"""Sizes of plates that a spinning lidar drives past at 90 km/h, against the simulator's truth."""

from __future__ import annotations

import math

import numpy as np

from roadscan.assets.returns import Returns
from roadscan.assets.upright.line_ends import misses_beside
from roadscan.assets.upright.outlines import outline_of
from roadscan.simulate.scene import Scene as StreetScene
from roadscan.simulate.things import objects_table
from tests.assets.streets import street

SIGNS = (
    ("rectangle", 3.2, 2.2, 9.0),
    ("rectangle", 0.8, 0.6, -6.5),
    ("round", 0.9, 0.9, 7.0),
    ("diamond", 1.0, 1.0, 8.0),
    ("triangle", 1.0, math.sqrt(0.75), -9.0),
    ("rectangle", 2.0, 1.4, 11.0),
)


def test_plates_that_few_scan_lines_cross_have_their_size() -> None:
    made = StreetScene.model_validate(
        {
            "seed": 5, "length_m": 40.0, "passes": [{"lane": 2}],
            "roadside": {"signs": [
                {"station_m": 6.0 + 6.3 * k, "offset_m": o, "shape": s, "width_m": w, "height_m": h}
                for k, (s, w, h, o) in enumerate(SIGNS)
            ]},
            "road": {"lanes": 2, "verge_width_m": 12.0, "lead_m": 70.0},
            "vehicle": {"speed_m_per_s": 25.0, "standstill_s": 0.0}, "profilers": {"on": False},
            "lidar": {"range_max_m": 30.0}, "noise": {"lidar_range_m": 0.015, "dropout": 0.002},
        }
    )  # fmt: skip
    seen = street(made)
    table = objects_table(made, seen.surface).to_pandas()
    table["x"] = table.easting_m - seen.returns.corner_m[0]
    table["y"] = table.northing_m - seen.returns.corner_m[1]
    for thing in table[table.kind == "sign"].itertuples():
        shape, width, height, _ = min(SIGNS, key=lambda sign: abs(sign[3] - thing.offset_m))
        heading = math.radians(thing.heading_deg + 90.0)
        off = places_from(seen.returns, thing.x, thing.y) @ [math.sin(heading), math.cos(heading)]
        is_face = (seen.object_id == thing.object_id) & ~seen.mixed & (off > 0.0)
        own = np.flatnonzero(is_face & (seen.returns.height_m > thing.height_m + 2.2 - 0.02))  # below stands the post
        along = np.column_stack([seen.returns.x_m[own] - thing.x, seen.returns.y_m[own] - thing.y])
        flat = np.column_stack([along @ [-math.cos(heading), math.sin(heading)], seen.returns.height_m[own]])
        found, bare = outline_of(flat, misses_beside(seen.returns, own, flat)), outline_of(flat)
        assert found.shape == shape
        error, before = (max(abs(o.width_m - width), abs(o.height_m - height)) for o in (found, bare))
        assert error < 0.03 and error < 4.0 * found.sigma_m + 0.005, (shape, width, error, found.sigma_m)
        assert math.hypot(found.middle[0], found.middle[1] - (thing.height_m + 2.2 + height / 2)) < 0.02
        if width > 2.0:  # the returns alone leave out a part of the gaps between lines
            assert error < 0.5 * before


def places_from(returns: Returns, x_m: float, y_m: float) -> np.ndarray:
    """Places (n, 2) of the sensor from a thing."""
    return np.column_stack([returns.sensor_x_m - x_m, returns.sensor_y_m - y_m])
