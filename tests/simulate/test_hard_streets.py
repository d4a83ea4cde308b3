"""Hard streets: the same for a seed, valid for many, and their returns in memory with the labels of what they met."""

from __future__ import annotations

from dataclasses import fields
from functools import cache

import numpy as np
import pytest

from benchmarks.hard_streets import KINDS, SCANNERS, hard_street
from benchmarks.labelled_returns import CLASSES, LabelledReturns, labelled_returns
from benchmarks.street_classes import CLASS_OF_KIND
from roadscan.simulate.bodies import class_number
from roadscan.simulate.lidar_model import lidar_model
from roadscan.simulate.sensors.lidar import laser_errors
from roadscan.simulate.trajectory import PoseErrors

SEED = 6
SHORT = {"length_m": 5.0, "lidar": {"model": "VLP-16", "range_max_m": 20.0}, "bag": {"on": True}}


def short(seed: int = SEED):
    scene = hard_street(seed)
    return scene.changed(passes=[one.model_dump() for one in scene.passes[:1]], **SHORT)


@cache
def seen(*, exact: bool = False) -> LabelledReturns:
    return labelled_returns(short().noiseless() if exact else short())


def test_seeds_give_the_same_scene_and_all_kinds():
    scenes = [hard_street(seed) for seed in range(24)]
    assert [s.model_dump() for s in scenes[:3]] == [hard_street(seed).model_dump() for seed in range(3)]
    assert {s.title.split(",")[0] for s in scenes} == set(KINDS)
    assert {s.lidar.model for s in scenes} == set(SCANNERS)
    for scene in scenes:
        assert 40.0 <= scene.length_m <= 60.0
        assert scene.lidar.divergence_deg == "data sheet"
        assert scene.noise.pass_step_m > 0.0


@pytest.mark.slow
def test_places_without_errors_are_those_met():
    street = seen(exact=True)
    known = street.object_id >= 0
    returns = street.returns
    place = np.stack([returns.x_m, returns.y_m, returns.height_m], axis=-1)
    np.testing.assert_allclose(place[known], street.true_xyh_m[known], atol=0.0012)  # half a unit of 2 mm, and float32
    np.testing.assert_allclose(
        returns.range_m[known],
        np.linalg.norm(street.true_xyh_m[known] - _sensor(street)[known], axis=1),
        atol=0.0012,
    )


def _sensor(street: LabelledReturns) -> np.ndarray:
    r = street.returns
    return np.stack([r.sensor_x_m, r.sensor_y_m, r.sensor_height_m], axis=-1)


@pytest.mark.slow
def test_stated_poses_move_the_whole_pass():
    street = seen()
    sharp = (street.object_id >= 0) & ~street.is_mixed
    returns = street.returns
    off = np.stack([returns.x_m, returns.y_m, returns.height_m], axis=-1) - street.true_xyh_m
    assert 0.003 < np.linalg.norm(np.median(off[sharp], axis=0)) < 0.25
    assert 0.0 < street.is_mixed.mean() < 0.3


@pytest.mark.slow
def test_lasers_are_those_of_the_model_and_zero_on_request():
    street = seen()
    assert set(street.returns.laser) == set(range(lidar_model("VLP-16").lasers))
    assert not labelled_returns(short(), laser_numbers=False).returns.laser.any()


@pytest.mark.slow
def test_same_seed_same_returns():
    first, again = seen(), labelled_returns(short())
    for one in fields(first.returns):
        a, b = getattr(first.returns, one.name), getattr(again.returns, one.name)
        assert a.tobytes() == b.tobytes() if isinstance(a, np.ndarray) else a == b
    np.testing.assert_array_equal(first.class_id, again.class_id)
    np.testing.assert_array_equal(first.object_id, again.object_id)


def test_labels_say_where_returns_lie():
    street = seen(exact=True)
    road = short().road
    ground = street.object_id == 0
    xy = street.true_xyh_m[ground].astype(float)
    corner = street.returns.corner_m
    _, offset = street.surface.station_offset_m(xy[:, 0] + corner[0], xy[:, 1] + corner[1])
    of = street.class_id[ground]
    away = np.abs(offset)
    for name, low, high in (
        ("road", 0.0, road.half_width_m), ("parking", road.half_width_m, road.paved_m),
        ("kerb", road.paved_m, road.paved_m + 0.15), ("terrain", road.paved_m, np.inf),
    ):  # fmt: skip
        inside = away[of == class_number(name)]
        if inside.size:
            assert inside.min() >= low - 1e-3
            assert inside.max() <= high + 1e-3
    table = street.objects.set_index("object_id")["kind"]
    for number in np.unique(street.object_id[street.object_id > 0]):
        assert street.kinds[street.kind[street.object_id == number][0]] == table[number]
    assert (street.class_id[street.object_id < 0] == class_number("noise")).all()


@pytest.mark.parametrize("name", sorted(set(CLASS_OF_KIND.values())))
def test_classes_of_kinds_are_classes(name):
    assert name in CLASSES


@pytest.mark.slow
def test_lasers_are_off_for_good_and_dark_things_are_lost():
    exact = short().noiseless()
    scene = exact.changed(lidar={"laser_range_m": 0.02, "dark_m": 25.0, "false_returns": 0.003})
    street, whole = labelled_returns(scene), seen(exact=True)
    met = street.object_id >= 0
    true_m = np.linalg.norm(street.true_xyh_m - _sensor(street), axis=1)
    off = street.returns.range_m - true_m
    known, _ = laser_errors(scene, 16)
    for laser in range(16):
        np.testing.assert_allclose(off[met & (street.returns.laser == laser)], known[laser], atol=0.002)
    assert np.isnan(true_m).sum() > 20  # false returns
    dark, bright = (
        [np.mean((one.returns.intensity < 257 * 20) == low) * len(one.returns) for one in (street, whole)]
        for low in (True, False)
    )
    assert dark[0] / dark[1] < bright[0] / bright[1] <= 1.01


def test_stated_poses_step_between_passes_and_within():
    scene = hard_street(SEED).changed(
        noise={"position_m": 0.0, "attitude_deg": 0.0, "pass_step_m": 0.05, "step_m": 0.03, "steps_per_minute": 30.0}
    )
    taken = [PoseErrors(scene, number).take(60 * scene.trajectory.poses_per_s)[0] for number in range(8)]
    first = np.array([one[0] for one in taken])
    assert 0.02 < first.std() < 0.1
    steps = [np.diff(one, axis=0) for one in taken]
    count = np.mean([(one != 0.0).any(axis=1).sum() for one in steps])
    assert count == pytest.approx(30.0, abs=8.0)
    sizes = np.concatenate([one[(one != 0.0).any(axis=1)].ravel() for one in steps])
    assert sizes.std() == pytest.approx(0.03, rel=0.15)
