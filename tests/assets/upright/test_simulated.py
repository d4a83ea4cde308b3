"""Upright things of a simulated street, seen once by a spinning lidar, against the truth."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest

from roadscan.assets.kind import AssetObject, asset_kinds, object_names
from roadscan.assets.upright.standing import TYPES, features_of_types, standing_of, uprights_of
from tests.assets.upright.scene import objects_of, simulated

SHAFTS = ("pole", "lamp_post", "tree", "sign", "signal")


def placed(one: AssetObject) -> np.ndarray:
    """Place of a point from the corner of the scene's returns."""
    scene, _ = simulated()
    return np.array([one.geometry.x, one.geometry.y]) - scene.returns.corner_m


def nearest(one: AssetObject, kinds: tuple[str, ...]) -> tuple[pd.Series, float]:
    """The thing of the truth that stands nearest to an object, and how far off."""
    _, truth = simulated()
    some = truth[truth.kind.isin(kinds)]
    away = np.hypot(*(some[["x", "y"]].to_numpy() - placed(one)).T)
    return some.iloc[int(np.argmin(away))], float(away.min())


def test_each_shaft_is_found_where_it_stands_as_what_it_is() -> None:
    scene, _truth = simulated()
    wanted = {"pole": 5, "lighting": 2, "tree": 2, "delineator": 2, "signal": 2}
    for kind, number in wanted.items():
        found = objects_of(scene, kind)
        assert len(found) == number, kind
        for one in found:
            thing, away = nearest(one, SHAFTS)
            assert away < 0.03, (kind, thing.kind)
            assert abs(one.geometry.z - thing.height_m) < 0.08
            assert one.probability > 0.6 and one.returns > 50 and one.passes == 1
    lamps = {lamp.attributes["type"]: lamp.attributes["arm_m"] for lamp in objects_of(scene, "lighting")}
    for lamp in objects_of(scene, "lighting"):
        assert lamp.attributes["lamp_height_m"] == pytest.approx(6.0 - 0.1, abs=0.1)
    assert lamps["arm"] == pytest.approx(4.5, abs=0.3) and lamps["double_arm"] == pytest.approx(1.8, abs=0.3)
    assert {nearest(o, SHAFTS)[0].kind for o in objects_of(scene, "tree")} == {"tree"}


def test_heads_on_posts_and_on_arms_are_signals() -> None:
    for one in objects_of(simulated()[0], "signal"):
        thing, _ = nearest(one, SHAFTS)
        assert thing.kind == "signal"
        reach = one.attributes["arm_m"]
        assert reach is None if thing.size_up_m < 5.0 else reach == pytest.approx(2.2, abs=0.3)


@pytest.mark.parametrize("kind", ["pole", "lighting"])
def test_diameters_and_heights_of_poles(kind: str) -> None:
    scene, _ = simulated()
    for one in objects_of(scene, kind):
        thing, _ = nearest(one, ("pole", "lamp_post", "sign", "signal"))
        wide = {"sign": 0.06, "lamp_post": 0.16}.get(thing.kind, thing.width_m)
        assert abs(one.attributes["diameter_m"] - wide) < 0.02
        assert abs(one.attributes["asset_height_m"] - thing.size_up_m) < 0.1
        assert one.attributes["lean_deg"] < 0.5


def test_trees_have_their_height_and_crown() -> None:
    scene, _ = simulated()
    for tree in objects_of(scene, "tree"):
        assert abs(tree.attributes["asset_height_m"] - 8.0) < 0.3
        assert abs(tree.attributes["crown_diameter_m"] - 4.5) < 0.6
        assert abs(tree.attributes["trunk_diameter_m"] - 0.3) < 0.02


def test_signs_have_place_size_shape_and_facing() -> None:
    scene, _truth = simulated()
    signs = objects_of(scene, "sign")
    assert len(signs) == 2
    for sign in signs:
        thing, _ = nearest(sign, ("sign",))
        # The plate stands 4 cm before its post, towards traffic that comes from behind; its length is its width.
        facing = math.radians(thing.heading_deg + 90.0)
        middle = np.array([thing.x + 0.04 * math.sin(facing), thing.y + 0.04 * math.cos(facing)])
        assert np.hypot(*(placed(sign) - middle)) < 0.03
        assert abs((sign.attributes["facing_deg"] - math.degrees(facing) + 180.0) % 360.0 - 180.0) < 5.0
        tall = thing.size_up_m - 2.2
        assert abs(sign.attributes["width_m"] - thing.length_m) < 0.05
        assert abs(sign.attributes["plate_height_m"] - tall) < 0.05
        assert abs(sign.geometry.z - (thing.height_m + 2.2 + tall / 2)) < 0.03
        assert abs(sign.attributes["clearance_m"] - 2.2) < 0.06
    assert {s.attributes["shape"] for s in signs} == {"round", "rectangle"}


def test_lines_have_their_length_place_and_height() -> None:
    scene, truth = simulated()
    wanted = {"guardrail": (18.0, 0.75), "fence": (24.0, 1.5), "wall": (10.0, 1.9)}
    for kind, (length, height) in wanted.items():
        (one,) = objects_of(scene, kind)
        assert abs(one.attributes["length_m"] - length) < 0.05 * length, kind
        assert abs(one.attributes["asset_height_m"] - height) < 0.1, kind
    assert objects_of(scene, "barrier") == []
    (fence,) = objects_of(scene, "fence")
    station = np.array(fence.geometry.coords)[:, :2] - scene.returns.corner_m
    thing = truth[truth.kind == "fence"].iloc[0]
    way = np.array([math.sin(math.radians(thing.heading_deg)), math.cos(math.radians(thing.heading_deg))])
    past = station - thing[["x", "y"]].to_numpy(np.float64)
    assert np.abs(past @ [way[1], -way[0]]).max() < 0.05


def test_facades_have_their_outline() -> None:
    scene, truth = simulated()
    front = max(objects_of(scene, "facade"), key=lambda o: o.attributes["area_m2"])
    thing = truth[truth.kind == "facade"].iloc[0]
    assert abs(front.attributes["length_m"] - thing.length_m) < 0.05 * thing.length_m
    assert abs(front.attributes["asset_height_m"] - thing.size_up_m) < 0.5
    facing = thing.heading_deg + 90.0
    assert abs((front.attributes["facing_deg"] - facing + 180.0) % 360.0 - 180.0) < 1.0
    ring = np.array(front.geometry.exterior.coords)
    assert front.geometry.has_z and np.ptp(ring[:, 2]) > 6.0


def test_clearance_under_the_arm_of_a_lamp() -> None:
    scene, truth = simulated()
    lamp = truth[truth.kind == "lamp_post"].iloc[0]
    (one,) = objects_of(scene, "clearance")
    assert abs(one.geometry.z - (lamp.height_m + lamp.size_up_m - 0.12)) < 0.03
    ground = float(scene.ground.height_at(*placed(one)))
    assert one.attributes["clearance_m"] == pytest.approx(one.geometry.z - ground, abs=1e-6)
    assert one.attributes["type"] == "structure"


def test_the_probability_of_a_shaft_is_that_of_standing_and_of_its_type() -> None:
    """The judges of the types are asked, the most probable one names the shaft, and all types share what stands."""
    scene, _ = simulated()
    standing = standing_of(scene)
    features = features_of_types(scene, standing)
    stated = {kind: judge.probability(features) for kind, judge in TYPES.items()}
    found = uprights_of(scene)
    assert len(found) == len(standing.shafts) > 10
    for k, one in enumerate(found):
        share = {kind: float(values[k]) for kind, values in stated.items()}
        assert one.kind == max(share, key=share.__getitem__)
        expected = float(standing.probability[k]) * share[one.kind] / sum(share.values())
        assert one.probability == pytest.approx(expected, rel=1e-12)
        assert one.probability < float(standing.probability[k])


def test_signs_name_the_post_that_carries_them() -> None:
    scene, _ = simulated()
    sign, poles = asset_kinds()["sign"], objects_of(scene, "pole")
    pieces = sign.evidence(scene, sign.options()).pieces
    places = np.array([[p.geometry.x, p.geometry.y] for p in poles])
    names = dict(zip(object_names("pole", places), poles, strict=True))
    found = list(sign.objects(pieces, sign.options(), {"pole": poles}))
    assert len(found) == 2
    carrying = [names[one.attributes["post"]] for one in found]
    for one, post in zip(found, carrying, strict=True):
        assert nearest(post, ("pole", "sign"))[0].kind == "sign"
        assert math.hypot(post.geometry.x - one.geometry.x, post.geometry.y - one.geometry.y) < 0.1
    others = [p for p in poles if not any(p is post for post in carrying)]
    alone = sign.objects(pieces, sign.options(), {"pole": others})
    assert [one.attributes["post"] for one in alone] == [None, None]
