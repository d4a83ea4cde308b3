"""Traffic signals and double lamps of a simulated street, against what stands there."""

from __future__ import annotations

import functools

import numpy as np

from roadscan.assets import classes
from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box, Scene
from roadscan.simulate.scene import Scene as StreetScene
from tests.assets.streets import street
from tests.assets.upright.scene import objects_of

ROADSIDE = {
    "signals": [
        {"station_m": 10.0, "offset_m": 5.0},
        {"station_m": 18.0, "offset_m": -5.5, "height_m": 5.8, "arm_m": 3.0, "diameter_m": 0.18, "faces": "forward"},
    ],
    "lamp_posts": [{"station_m": 14.0, "offset_m": 6.0, "height_m": 6.0, "arm_m": 1.8, "is_double": True}],
    "poles": [{"station_m": 6.0, "offset_m": -5.0, "height_m": 3.4, "diameter_m": 0.12}],
    "signs": [{"station_m": 22.0, "offset_m": 5.2}],
}


@functools.cache
def scene() -> tuple[Scene, np.ndarray]:
    """The street as one pass sees it, and the feet of its signals (k, 2) in the order of the scene."""
    made = StreetScene.model_validate(
        {
            "seed": 5, "length_m": 24.0, "passes": [{"lane": 2}], "roadside": ROADSIDE,
            "road": {"lanes": 2, "verge_width_m": 8.0, "lead_m": 70.0},
            "vehicle": {"speed_m_per_s": 16.0, "standstill_s": 0.0}, "profilers": {"on": False},
            "lidar": {"range_max_m": 30.0}, "noise": {"lidar_range_m": 0.015, "intensity": 5.0, "dropout": 0.002},
        }
    )  # fmt: skip
    seen = street(made)
    returns = seen.returns
    low = np.floor(min(returns.x_m.min(), returns.y_m.min()) / 10.0) * 10.0
    high = np.ceil(max(returns.x_m.max(), returns.y_m.max()) / 10.0) * 10.0
    window = Box(low, low, high, high)
    feet = [seen.surface.place(s["station_m"], s["offset_m"])[:2] for s in ROADSIDE["signals"]]
    return make_scene(returns, window, window, seen.drive_xyh_m), np.array(feet, np.float64)


def test_heads_on_posts_and_on_arms_are_signals() -> None:
    made, feet = scene()
    found = objects_of(made, "signal")
    assert len(found) == len(feet)
    for foot, arm_m in zip(feet, (None, 3.0), strict=True):
        (one,) = [o for o in found if np.hypot(o.geometry.x - foot[0], o.geometry.y - foot[1]) < 0.05]
        reach = one.attributes["arm_m"]
        assert reach is None if arm_m is None else abs(reach - arm_m) < 0.3
    assert len(objects_of(made, "pole")) == 2  # the plain one, and the sign's


def test_a_lamp_post_with_two_arms() -> None:
    (lamp,) = objects_of(scene()[0], "lighting")
    assert lamp.attributes["type"] == "double_arm"
    assert abs(lamp.attributes["arm_m"] - 1.8) < 0.4


def test_what_hangs_over_the_lanes_is_an_overhead_structure_and_no_building() -> None:
    made, _ = scene()
    high = made.above_ground_m > 4.0
    assert not (made.classes[high] == classes.BUILDING).any()
