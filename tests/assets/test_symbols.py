"""Symbols on lanes: the simulator's outlines, drawn apart from the stage's own, and as a lidar sees them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import shapely

from roadscan.assets.paint.symbols import UNKNOWN, symbol_of
from roadscan.simulate.scene import Scene
from roadscan.simulate.scene.road import Symbol
from roadscan.simulate.symbols import outline_of
from tests.assets.simulated_streets import street_of
from tests.assets.test_paint import along, calibrated, found

NAMED = ("ahead", "left", "right", "ahead_left", "ahead_right", "triangle", "diamond")
WIDTH_M = {"ahead": 0.75, "diamond": 1.2, "bicycle": 1.4}


def on_the_map(symbol: Symbol) -> shapely.Geometry:
    """The outline with x along the road and y to the left."""
    return shapely.transform(outline_of(symbol), lambda xy: xy * [1.0, -1.0])


def drawn(random: np.random.Generator, shape: str) -> Symbol:
    """A symbol in some proportions, that some driver reads."""
    length = float(random.uniform(2.5, 5.0))
    head = length * random.uniform(0.2, 0.35) if shape == "ahead" else random.uniform(0.4, 0.8)
    return Symbol.model_validate(
        {
            "station_m": 0.0, "offset_m": 0.0, "shape": shape, "length_m": length, "head_m": float(head),
            "width_m": WIDTH_M.get(shape, 1.5) * float(random.uniform(0.8, 1.3)),
            "line_m": float(random.uniform(0.12, 0.25)), "facing": str(random.choice(["forward", "backward"])),
        }
    )  # fmt: skip


@pytest.mark.parametrize("shape", NAMED)
def test_symbols_of_all_proportions_are_named_and_none_gets_anothers_name(shape: str) -> None:
    random = np.random.default_rng(7)
    names = [symbol_of(on_the_map(drawn(random, shape))) for _ in range(20)]
    assert set(names) <= {shape, UNKNOWN}
    assert names.count(shape) >= 14  # A branch in the middle leaves open which end is the head: 15.


@pytest.mark.parametrize(
    "outline",
    [
        shapely.box(0.0, 0.0, 4.0, 0.5),
        shapely.Point(0.0, 0.0).buffer(0.8),
        shapely.Point(0.0, 0.0).buffer(0.8).difference(shapely.Point(0.0, 0.0).buffer(0.6)),
        shapely.box(0.0, 0.0, 3.0, 0.3).union(shapely.box(1.35, 0.0, 1.65, 1.5)),
        shapely.box(0.0, 0.0, 3.0, 1.5).difference(shapely.box(0.15, 0.15, 2.85, 1.35)),
        shapely.Polygon([(0.0, 0.0), (0.4, 0.2), (0.0, 0.4)]),
        on_the_map(Symbol(station_m=0.0, offset_m=0.0, shape="bicycle", length_m=2.4, width_m=1.4)),
    ],
    ids=["bar", "disc", "ring", "T", "frame", "fragment", "bicycle"],
)
def test_other_paint_is_unknown(outline: shapely.Geometry) -> None:
    assert symbol_of(outline) == UNKNOWN


@pytest.mark.slow
def test_symbols_that_a_lidar_sees_are_no_lane_lines() -> None:
    plain = Scene.load("highway_three_lanes")
    shapes = ("ahead", "left", "ahead_right", "triangle", "diamond")
    painted: list[dict[str, Any]] = [
        {"station_m": 44.0 + 8.0 * k, "offset_m": 0.0, "shape": shape, "length_m": 4.0, "line_m": 0.2, "worn": 0.1,
         "width_m": 1.2 * WIDTH_M.get(shape, 1.5), "facing": "backward" if k % 2 else "forward"}
        for k, shape in enumerate(shapes)
    ]  # fmt: skip
    roadside = {kind: [] for kind in plain.roadside.model_dump()}
    known = street_of(plain.changed(road={"symbols": painted}, roadside=roadside, passes=[{"lane": 2}]), 60.0)
    scene = calibrated(known.scene)
    names, kinds = {}, set()
    for one in found(scene, "road_marking")[1]:
        station, offset = along(known, one)
        if abs(offset.mean()) < 1.0 and one.attributes["symbol"] not in (None, UNKNOWN):
            middle = (station.min() + station.max()) / 2
            names[min(painted, key=lambda p: abs(p["station_m"] - middle))["shape"]] = one.attributes["symbol"]
            kinds.add(one.attributes["type"])
    assert names.items() <= {(shape, shape) for shape in shapes}
    assert len(names) >= len(shapes) - 1
    assert kinds == {"arrow", "symbol"}
    assert all(abs(along(known, line)[1].mean()) > 1.0 for line in found(scene, "lane_line")[1])
