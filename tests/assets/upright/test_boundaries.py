"""Fences, walls and rails beside one another, each of which is told by how many beams pass it."""

from __future__ import annotations

import functools

import numpy as np
import shapely

from roadscan.assets.kind import AssetObject, asset_kinds
from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box, Scene
from roadscan.assets.upright.kernels.stretches import count_about
from roadscan.assets.upright.surfaces import without_short
from roadscan.simulate.scene import Scene as StreetScene
from tests.assets.streets import street

ROADSIDE = {
    "fences": [{"offset_m": 8.0, "start_m": 2.0, "end_m": 24.0, "height_m": 1.5, "density": 0.8}],
    "guardrails": [{"offset_m": -6.5, "start_m": -4.0, "end_m": 30.0}],
    "walls": [{"offset_m": -7.6, "start_m": 2.0, "end_m": 24.0, "height_m": 1.6}],
    "hedges": [{"offset_m": 11.0, "start_m": 2.0, "end_m": 24.0, "height_m": 2.2}],
}


@functools.cache
def scene() -> Scene:
    """A dense fence before a hedge on the right, a wall behind a guard rail on the left."""
    made = StreetScene.model_validate(
        {
            "seed": 12, "length_m": 26.0, "passes": [{"lane": 2}], "roadside": ROADSIDE,
            "road": {"lanes": 2, "verge_width_m": 12.0, "lead_m": 70.0},
            "vehicle": {"speed_m_per_s": 12.0, "standstill_s": 0.0}, "profilers": {"on": False},
            "lidar": {"range_max_m": 30.0}, "noise": {"lidar_range_m": 0.015, "intensity": 5.0, "dropout": 0.002},
        }
    )  # fmt: skip
    seen = street(made)
    r = seen.returns
    box = Box(*(np.floor([r.x_m.min(), r.y_m.min()]) - 1.0), *(np.ceil([r.x_m.max(), r.y_m.max()]) + 1.0))
    return make_scene(r, box, box, seen.drive_xyh_m)


def objects(kind: str) -> list[AssetObject]:
    one = asset_kinds()[kind]
    return list(one.objects(one.evidence(scene(), one.options()).pieces, one.options(), {}))


def length_m(kind: str) -> float:
    return sum(shapely.length(one.geometry) for one in objects(kind))


def test_a_fence_that_a_fifth_of_the_beams_passes_is_a_fence() -> None:
    assert 0.9 * 22.0 < length_m("fence") < 1.1 * 22.0


def test_a_wall_behind_a_guard_rail_is_found() -> None:
    assert 0.9 * 22.0 < length_m("wall") < 1.1 * 22.0
    assert length_m("guardrail") > 0.9 * 28.0 and length_m("barrier") == 0.0


def test_runs_shorter_than_a_gate_between_two_of_one_kind_have_theirs() -> None:
    code, length = np.array([1, 1, 2, 1, 3, 3, 1, 2]), np.ones(8)
    assert without_short(code, length).tolist() == [1, 1, 1, 1, 3, 3, 1, 2]


def test_returns_about_an_upright_rectangle() -> None:
    """On it, before it, behind it and above it, as NumPy counts them."""
    draw = np.random.default_rng(5)
    x, y, height = draw.uniform(0.0, 6.0, (3, 4000))
    cell = np.floor(y).astype(int) * 6 + np.floor(x).astype(int)
    order = np.argsort(cell, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=36))])
    x, y, height = x[order], y[order], height[order]
    unit = np.array([0.8, 0.6])
    first, last = np.array([1.0, 1.0]), np.array([1.0, 1.0]) + 3.0 * unit
    segments = np.array([[*first, *last, 1.0, 2.5, 1.0], [*first, *last, np.nan, np.nan, 1.0]])
    counts = np.zeros((2, 5))
    count_about(x, y, height, starts, np.array([0.0, 0.0, 1.0, 6.0, 6.0]), segments, (0.15, 0.7, 0.15, 2.0), counts)
    along = (x - 1.0) * unit[0] + (y - 1.0) * unit[1]
    beside = unit[0] * (y - 1.0) - unit[1] * (x - 1.0)
    inside, off = (along >= 0.0) & (along < 3.0), np.abs(beside)
    between, over = inside & (height >= 1.0) & (height <= 2.5), inside & (height >= 2.65) & (height <= 4.5)
    beyond = between & (off > 0.15) & (off <= 0.7)
    wanted = [between & (off <= 0.15), beyond & (beside > 0.0), beyond & (beside < 0.0), over & (off <= 0.7)]
    assert counts[0, :4].tolist() == [np.count_nonzero(one) for one in wanted]
    assert np.isclose(counts[0, 4], off[wanted[0]].sum()) and not counts[1].any()
