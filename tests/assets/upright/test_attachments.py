"""Arms of few returns, and what is no crown."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.judged_scenes import simulated
from benchmarks.labelled_returns import labelled_returns
from roadscan.assets.classes import OVERHEAD_STRUCTURE
from roadscan.assets.upright.attached import _reach
from roadscan.simulate import Scene
from tests.assets.upright.scene import objects_of


@pytest.mark.parametrize("count", [10, 12])
def test_the_end_of_an_arm_has_a_height_where_its_last_return_lies_apart(count: int) -> None:
    """The 98 % quantile lies in the gap before it: no return is 0.4 m before that place to 0.1 m beyond it."""
    along = np.append(np.linspace(0.1, 1.15, count - 1), 1.74)
    reach_m, height_m = _reach(along, np.where(along == 1.74, 5.2, 5.0))
    assert 1.55 < reach_m < 1.64
    assert height_m == 5.2


@pytest.mark.slow
def test_a_post_before_a_front_is_no_tree_where_the_sun_makes_false_returns() -> None:
    street = Scene.model_validate(
        {
            "seed": 11, "length_m": 24.0, "passes": [{"lane": 2}], "profilers": {"on": False},
            "road": {"lanes": 2, "verge_width_m": 12.0, "verge_slope": 0.02, "lead_m": 70.0},
            "roadside": {
                "facades": [{"offset_m": -8.5, "start_m": -20.0, "end_m": 50.0, "height_m": 8.0}],
                "poles": [{"station_m": 3.0, "offset_m": -8.0, "every_m": 6.0, "count": 4, "height_m": 3.5,
                           "diameter_m": 0.1}],
                "trees": [{"station_m": 15.0, "offset_m": 8.0, "height_m": 8.0, "trunk_m": 0.3}],
            },
            "vehicle": {"speed_m_per_s": 12.0, "standstill_s": 0.0},
            "lidar": {"range_max_m": 30.0, "false_returns": 0.004},
            "noise": {"lidar_range_m": 0.015, "intensity": 5.0, "dropout": 0.002},
        }
    )  # fmt: skip
    seen = labelled_returns(street)
    scene = simulated(street, "hard", 1.0, seen).scene
    assert not (scene.classes == OVERHEAD_STRUCTURE).any()  # false returns do not join a crown to what spans the road
    for kind, offset_m in (("pole", -8.0), ("tree", 8.0)):
        (found,) = (np.array([one.geometry.x, one.geometry.y]) for one in objects_of(scene, kind))
        assert abs(float(seen.surface.station_offset_m(*found[:, None])[1][0]) - offset_m) < 0.1


@pytest.mark.slow
def test_posts_under_balconies_are_no_trees() -> None:
    """What fills half of the directions above a post is no crown: it was a tree with 0.96 and more."""
    posts = [{"station_m": s, "offset_m": -7.6, "height_m": 2.6, "diameter_m": 0.1} for s in (4.0, 12.0, 20.0)]
    street = Scene.model_validate(
        {
            "seed": 12, "length_m": 24.0, "passes": [{"lane": 2}], "profilers": {"on": False},
            "road": {"lanes": 2, "verge_width_m": 12.0, "verge_slope": 0.02, "lead_m": 70.0},
            "roadside": {
                "facades": [{"offset_m": -8.5, "start_m": -20.0, "end_m": 50.0, "height_m": 8.0}],
                "poles": posts,
                "furniture": [{"what": "balcony", "station_m": one["station_m"], "offset_m": -7.9} for one in posts],
                "trees": [{"station_m": 15.0, "offset_m": 8.0, "height_m": 8.0, "trunk_m": 0.3}],
            },
            "vehicle": {"speed_m_per_s": 14.0, "standstill_s": 0.0}, "lidar": {"range_max_m": 30.0},
            "noise": {"lidar_range_m": 0.015, "intensity": 5.0, "dropout": 0.002},
        }
    )  # fmt: skip
    seen = labelled_returns(street)
    scene = simulated(street, "hard", 1.0, seen).scene

    def offsets(kind: str, least: float) -> list[float]:
        found = [one.geometry for one in objects_of(scene, kind) if one.probability >= least]
        return seen.surface.station_offset_m(np.array([p.x for p in found]), np.array([p.y for p in found]))[1].tolist()

    assert [round(o) for o in offsets("tree", 0.0) if o > 0.0] == [8]
    assert not [o for o in offsets("tree", 0.5) if o < 0.0]
    assert len([o for o in offsets("pole", 0.5) if abs(o + 7.6) < 0.3]) >= 2
