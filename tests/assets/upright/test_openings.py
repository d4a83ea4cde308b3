"""What lets sight lines through everywhere is a fence; a front with doors, and a handrail, are none."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from roadscan.assets import classes
from roadscan.assets.kinds.surfaces import parts_of
from roadscan.assets.scene import Box, GroundModel, Returns, Scene
from roadscan.assets.upright.lines import chain_of
from roadscan.assets.upright.panels import panels_of

Float64 = npt.NDArray[np.float64]
_LONG_M = 12.0


def scene_of(stops: Callable[[Float64, Float64, Float64], npt.NDArray[np.bool_]]) -> Scene:
    """Rays from a drive 6 m beside a plane that stops some, by place, height and a random number, and a wall behind."""
    rng = np.random.default_rng(37)
    n = 60_000
    sensor = np.stack([rng.uniform(0.0, _LONG_M, n), np.full(n, -6.0), np.full(n, 1.8)])
    aim = np.stack([rng.uniform(0.0, _LONG_M, n), np.zeros(n), rng.uniform(0.15, 1.75, n)])
    way = aim - sensor
    stopped = stops(aim[0], aim[2], rng.uniform(size=n))
    depth = np.where(stopped, 1.0, 1.5)  # the wall behind stands at y = 3 m
    on_ground = np.minimum(depth, -sensor[2] / np.minimum(way[2], -1e-9))
    place = sensor + way * on_ground
    place[1] += rng.normal(0.0, 0.01, n)
    returns = Returns(
        corner_m=(0.0, 0.0), x_m=place[0], y_m=place[1], height_m=place[2], intensity=np.ones(n, np.float32),
        epoch_gps_ns=np.arange(n), pass_id=np.ones(n, np.uint16), sensor=np.zeros(n, np.uint8),
        laser=np.zeros(n, np.uint16), return_number=np.ones(n, np.uint8), number_of_returns=np.ones(n, np.uint8),
        sensor_x_m=sensor[0], sensor_y_m=sensor[1], sensor_height_m=sensor[2], sensors=("lidar",),
    )  # fmt: skip
    box, shape = Box(-12.0, -12.0, 24.0, 12.0), (96, 144)
    ground = GroundModel(box.x_min_m, box.y_min_m, 0.25, np.zeros(shape, np.float32), np.ones(shape, np.bool_))
    codes = np.where(place[2] < 0.05, classes.GROUND, classes.UNCLASSIFIED).astype(np.uint8)
    drive = np.column_stack([np.linspace(0.0, _LONG_M, 20), np.full(20, -6.0), np.full(20, 1.8), np.ones(20)])
    return Scene(returns, box, box, ground, place[2].astype(np.float32), codes, drive)


@pytest.mark.parametrize(
    ("stops", "is_fence"),
    [
        (lambda x, h, u: (h < 1.3) & (u < 0.4), True),  # a mesh that lets 60 % through
        (lambda x, h, u: (h < 1.3) & (u < 0.8), True),  # one that lets 20 % through
        (lambda x, h, u: (h < 1.3) & ((x % 1.0) > 0.2), False),  # as many pass, at an opening of 0.2 m in each metre
        (lambda x, h, u: (h > 0.75) & (h < 1.3) & (u < 0.4), False),  # nothing stands below 0.75 m
    ],
)
def test_what_lets_lines_through_everywhere_is_a_fence(
    stops: Callable[[Float64, Float64, Float64], npt.NDArray[np.bool_]], is_fence: bool
) -> None:
    scene = scene_of(stops)
    chains = [chain_of(p) for p in panels_of(scene) if abs(float(p.xy_m[:, 1].mean())) < 0.1]
    assert chains
    long = max(chains, key=lambda c: c.length_m)
    assert long.length_m > 0.9 * _LONG_M
    assert ([name for name, _, _ in parts_of(long)] == ["fence"]) == is_fence
