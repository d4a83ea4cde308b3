"""What makes a street hard: each thing by the returns that meet it, beside formulas written without the simulator."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.street_classes import class_of_kind
from roadscan.simulate.bodies import PERSON, SIGN, TRUNK, WALL
from roadscan.simulate.things import objects_table
from tests.simulate.test_simulate_things import cast, flat, place, towards, world_of

RAYS = 4_000


def point(station: float, offset: float, height: float) -> np.ndarray:
    return np.array([*place(station, offset), height])


def level(at, count: int, spread_rad: float, target) -> np.ndarray:
    """Level directions (n, 3) around that to a target."""
    way = np.asarray(target)[:2] - np.asarray(at)[:2]
    angle = math.atan2(way[0], way[1]) + np.random.default_rng(3).uniform(-spread_rad, spread_rad, count)
    return np.stack([np.sin(angle), np.cos(angle), np.zeros(count)], axis=-1)


@pytest.mark.parametrize("passing", [0.02, 0.2, 0.8])
def test_hedge_passes_the_stated_share_and_stops_the_rest_within(passing):
    hedge = {"offset_m": 5.0, "start_m": 0.0, "end_m": 30.0, "height_m": 2.0, "width_m": 0.8, "passing": passing}
    world = world_of(flat(hedges=[hedge]))
    at = point(15.0, 0.0, 1.0)
    hits = cast(world, at, level(at, RAYS, 0.05, point(15.0, 5.0, 1.0)))
    stopped = hits.object_id == 1
    assert 1.0 - stopped.mean() == pytest.approx(passing, abs=4 * math.sqrt(passing * (1 - passing) / RAYS))
    depth = hits.range_m[stopped] - 5.0
    assert depth.min() > -0.01
    assert depth.max() < 0.83
    # half of the light that is stopped is stopped before this depth
    half = -0.8 * math.log(1.0 - 0.5 * (1.0 - passing)) / -math.log(passing)
    assert np.median(depth) == pytest.approx(half, abs=0.02)


def test_foot_of_a_hedge_is_a_wall():
    hedge = {"offset_m": 5.0, "start_m": 0.0, "end_m": 30.0, "foot_wall_m": 0.5, "passing": 0.01}
    world = world_of(flat(hedges=[hedge]))
    at = point(15.0, 0.0, 0.3)
    low = cast(world, at, level(at, 100, 0.05, point(15.0, 5.0, 0.3)))
    assert (low.part == WALL).all()
    np.testing.assert_allclose(low.range_m, 4.98, atol=0.01)
    high = cast(world, point(15.0, 0.0, 1.0), level(at, 100, 0.05, point(15.0, 5.0, 1.0)))
    assert (high.part[high.object_id == 1] == 0).all()


@pytest.mark.parametrize("density", [0.2, 0.8])
@pytest.mark.parametrize("style", ["mesh", "pickets"])
def test_fence_stops_its_share(style, density):
    fence = {"offset_m": 5.0, "start_m": 0.0, "end_m": 30.0, "style": style, "density": density, "picket_m": 0.05}
    world = world_of(flat(fences=[fence]))
    at = point(15.0, 0.0, 1.0)
    way = level(at, RAYS, 0.4, point(15.0, 5.0, 1.0))
    hits = cast(world, at, way)
    assert np.mean(hits.object_id == 1) == pytest.approx(density, abs=0.03)
    if style == "pickets":  # where they are, whichever random numbers the rays have
        np.testing.assert_array_equal(hits.object_id, cast(world, at, way, key=10**7).object_id)
        met = hits.enh_m[hits.object_id == 1][:, :2] @ np.array(
            [math.sin(math.radians(33)), math.cos(math.radians(33))]
        )
        assert (np.mod(met, 0.05 / density) < 0.05 + 1e-6).all()


def test_wall_is_a_box_behind_its_face():
    world = world_of(flat(walls=[{"offset_m": -6.0, "start_m": 2.0, "end_m": 20.0, "height_m": 0.9}]))
    at = point(10.0, 0.0, 0.5)
    hits = cast(world, at, level(at, 500, 0.3, point(10.0, -6.0, 0.5)))
    assert (hits.object_id == 1).all()
    cosine = np.abs(level(at, 500, 0.3, point(10.0, -6.0, 0.5))[:, :2] @ place(0.0, 1.0))
    np.testing.assert_allclose(hits.range_m, 6.0 / cosine, atol=1e-6)
    over = cast(world, point(10.0, 0.0, 1.0), level(at, 500, 0.3, point(10.0, -6.0, 1.0)))
    assert (over.object_id != 1).all()


@pytest.mark.parametrize("lean_deg", [0.2, 20.0, 40.0])
def test_trunk_leans(lean_deg):
    tree = {"station_m": 10.0, "offset_m": 4.0, "height_m": 8.0, "trunk_m": 0.4, "crown_m": 3.0, "crown_from_m": 3.0,
            "lean_deg": lean_deg, "lean_towards_deg": 0.0, "extinction_per_m": 1.0}  # fmt: skip
    world = world_of(flat(trees=[tree]))
    up = 1.5
    target = point(10.0 + up * math.tan(math.radians(lean_deg)), 4.0, up)
    at = point(10.0 + up * math.tan(math.radians(lean_deg)), 0.0, up)
    hits = cast(world, at, towards(at, target, 0.0, 1))
    assert hits.part[0] == TRUNK
    assert hits.range_m[0] == pytest.approx(4.0 - 0.2, abs=1e-6)  # the axis leans across the beam
    below = cast(world, at, towards(at, point(10.0, 4.0, up), 0.0, 1))
    assert (below.part[0] == TRUNK) == (lean_deg < 5.0)


def test_crown_and_stems_have_parts_of_their_own():
    tree = {"station_m": 10.0, "offset_m": 4.0, "height_m": 8.0, "trunk_m": 0.5, "crown_m": 4.0, "stems": 3,
            "fork_m": 1.2, "extinction_per_m": 2.0, "bush_m": 1.0}  # fmt: skip
    world = world_of(flat(trees=[tree]))
    at = point(10.0, 0.0, 2.0)
    hits = cast(world, at, towards(at, point(10.0, 4.0, 3.0), 2.5, RAYS))
    met = hits.object_id == 1
    assert (hits.part[met] == TRUNK).sum() > 50
    assert (hits.part[met] == 0).sum() > 500
    assert hits.enh_m[met & (hits.part == TRUNK), 2].min() < 1.0


def test_windows_of_a_car_pass_mirror_and_lose_beams():
    wall = {"offset_m": 8.0, "start_m": 0.0, "end_m": 30.0, "height_m": 2.0}
    houses = {"offset_m": -9.0, "start_m": -20.0, "end_m": 60.0, "height_m": 12.0, "window_m": 0.0}
    car = {"station_m": 10.0, "offset_m": 4.0, "glass": 0.5}
    world = world_of(flat(vehicles=[car], walls=[wall], facades=[houses]))
    across = cast(world, point(9.0, 0.0, 1.2), towards(point(9.0, 0.0, 1.2), point(9.3, 3.2, 1.15), 0.1, RAYS))
    assert (across.object_id == 3).mean() > 0.1  # through both windows, on the far side
    at = point(10.0, 0.0, 1.6)
    hits = cast(world, at, towards(at, point(9.6, 3.3, 1.1), 0.25, RAYS))
    mirrored = (hits.object_id == -1) & np.isfinite(hits.range_m)
    assert mirrored.sum() > 30
    assert np.isnan(hits.range_m).sum() > 30
    assert (
        hits.enh_m[mirrored, 2].min() < -0.3
    )  # the houses, mirrored up to them by a pane that leans: below the ground
    assert (hits.part[mirrored] == 0).all()


def test_pane_seen_along_its_normal_glares_and_its_image_lies_behind_it():
    front = {"offset_m": 6.0, "start_m": 0.0, "end_m": 40.0, "glass": 1.0, "window_m": 2.4, "bay_m": 2.6}
    world = world_of(
        flat(facades=[front], walls=[{"offset_m": -6.0, "start_m": -20.0, "end_m": 60.0, "height_m": 4.0}])
    )
    at = point(20.0, 0.0, 1.5)
    ahead = level(at, RAYS, 0.03, point(20.0, 6.0, 1.5))
    hits = cast(world, at, ahead)
    glare = hits.intensity == 255.0
    assert glare.mean() > 0.8
    np.testing.assert_allclose(hits.range_m[glare], 6.0, atol=0.01)
    aside = cast(world, at, level(at, RAYS, 0.2, point(25.0, 6.0, 1.5)))
    image = (aside.object_id == -1) & np.isfinite(aside.range_m)
    assert image.mean() == pytest.approx(0.35 * 0.85, abs=0.12)  # of what frames leave
    offset = aside.enh_m[image][:, :2] @ place(0.0, 1.0)
    np.testing.assert_allclose(offset, 18.0, atol=1e-3)  # the wall 6 m on the other side, 12 m behind the pane


def test_rear_of_a_van_has_bright_plates():
    van = {"what": "van", "station_m": 10.0, "offset_m": 2.0, "form": 3, "shade": 60.0}
    world = world_of(flat(vehicles=[van]))
    at = point(0.0, 2.0, 1.5)
    hits = cast(world, at, towards(at, point(7.3, 2.0, 1.2), 1.0, RAYS))
    bright = (hits.object_id == 1) & (hits.intensity >= 255.0)
    assert bright.sum() > 200
    along = hits.enh_m[bright][:, :2] @ place(1.0, 0.0)
    assert np.ptp(along) < 0.05
    panel = hits.enh_m[bright & (hits.enh_m[:, 2] > 1.1)]
    assert np.ptp(panel[:, 2]) == pytest.approx(0.6, abs=0.1)  # one as large as a sign


@pytest.mark.parametrize("what", ["car", "van", "lorry", "bicycle", "motorcycle"])
def test_vehicles_keep_to_their_size(what):
    world = world_of(flat(vehicles=[{"what": what, "station_m": 12.0, "offset_m": 3.0}]))
    size = objects_table(world.scene, world.surface).to_pylist()[0]
    assert size["kind"] == what
    for station in (0.0, 24.0):
        at = point(station, -1.0, 2.0)
        hits = cast(world, at, towards(at, point(12.0, 3.0, 1.0), 3.0, RAYS))
        met = hits.enh_m[hits.object_id == 1]
        assert len(met) > 15
        ahead, right = met[:, :2] @ place(1.0, 0.0) - 12.0, met[:, :2] @ place(0.0, 1.0) - 3.0
        assert np.abs(ahead).max() <= size["length_m"] / 2 + 0.05
        assert np.abs(right).max() <= size["width_m"] / 2 + 0.1
        assert met[:, 2].max() <= size["size_up_m"] + 0.1


def test_rider_is_a_person_on_a_vehicle():
    from roadscan.simulate.bodies import Place
    from roadscan.simulate.kernels.things import PART
    from roadscan.simulate.vehicles import vehicle_bodies

    rows = vehicle_bodies("bicycle", (0.0, 0.0, 0.0), 0.0, (1.75, 0.6, 1.05), 90.0, 1.0, ridden=True)
    assert {0.0, float(PERSON)} == set(rows[:, PART])
    assert Place(0.0, 0.0, (1.0, 2.0, 0.0), 0.0).beside(1.0, 0.0, 0.0) == (1.0, 3.0)


@pytest.mark.parametrize(
    "what",
    ["cabinet", "bin", "litter_bin", "bench", "hydrant", "bus_shelter", "bollard", "advertising_column", "billboard",
     "letter_box", "parking_meter", "planter", "sandwich_board", "steps", "door", "balcony", "shop_sign",
     "hanging_sign"],
)  # fmt: skip
def test_furniture_is_met_where_it_stands(what):
    world = world_of(flat(furniture=[{"what": what, "station_m": 10.0, "offset_m": 5.0, "shade": 99.0}]))
    one = objects_table(world.scene, world.surface).to_pylist()[0]
    assert one["kind"] == what
    assert class_of_kind(what) in (class_of_kind("cabinet"), class_of_kind("facade"))
    at = point(6.0, 0.0, 1.7)
    hits = cast(world, at, towards(at, point(10.0, 5.0, 1.6), 1.8, RAYS))
    met = hits.enh_m[hits.object_id == 1]
    assert len(met) > 10
    away = np.hypot(*(met[:, :2] - place(10.0, 5.0)).T)
    assert away.max() < math.hypot(one["length_m"], one["width_m"]) / 2 + 0.01
    assert met[:, 2].max() < one["size_up_m"] + 0.01
    assert 99.0 in set(hits.intensity[hits.object_id == 1]) or what == "planter"


def test_cover_lies_on_a_road_that_falls():
    scene = flat(covers=[{"station_m": 8.0, "offset_m": 1.5, "height_m": 0.004, "shade": 140.0}])
    world = world_of(scene.changed(road={"cross_slope": 0.04, "grade": 0.05}))
    at = point(5.0, 0.0, 2.3)
    target = np.array([*place(8.0, 1.5), float(world.surface.height_m(*place(8.0, 1.5)))])
    hits = cast(world, at, towards(at, target, 0.5, RAYS))
    met = hits.object_id == 1
    assert met.sum() > 200
    ground = world.surface.height_m(hits.enh_m[met, 0], hits.enh_m[met, 1], texture=False)
    np.testing.assert_allclose(hits.enh_m[met, 2] - ground, 0.004, atol=0.002)
    assert set(hits.intensity[met]) == {140.0}


def test_wire_hangs_by_its_sag():
    wire = {"station_m": 0.0, "offset_m": 4.0, "to_station_m": 24.0, "to_offset_m": 4.0, "sag_m": 0.6,
            "diameter_m": 0.04}  # fmt: skip
    world = world_of(flat(wires=[wire]))
    for station in (3.0, 7.0, 13.0):  # in the middle of straight pieces
        share = station / 24.0
        height = 6.5 - 4 * 0.6 * share * (1 - share)
        at = point(station, 4.0, 1.0)
        hits = cast(world, at, np.array([[0.0, 0.0, 1.0]]))
        assert hits.object_id[0] == 1
        assert hits.enh_m[0, 2] == pytest.approx(height - 0.02, abs=0.008)


def test_grass_stops_beams_between_its_tips_and_the_soil():
    scene = flat().changed(road={"grass": {"height_m": 0.2, "from_m": 1.0, "shade": 60.0}, "verge_width_m": 6.0})
    world = world_of(scene)
    paved = scene.road.paved_m
    at = point(10.0, 0.0, 2.0)
    hits = cast(world, at, towards(at, point(10.0, paved + 2.5, 0.0), 0.3, RAYS))
    grass = (hits.enh_m[:, :2] @ place(0.0, 1.0)) > paved + 1.2
    height = hits.enh_m[grass, 2]
    assert height.min() > -0.003
    assert height.max() < 0.2
    assert 0.02 < np.std(height) < 0.1
    assert (height < 0.001).mean() > 0.1  # some reach the soil
    assert set(hits.intensity[grass]) == {60.0}
    bare = cast(world, at, towards(at, point(10.0, paved + 0.4, 0.0), 0.2, 500))
    near = (bare.enh_m[:, :2] @ place(0.0, 1.0)) < paved + 0.3
    np.testing.assert_allclose(bare.enh_m[near, 2], 0.0, atol=1e-6)


@pytest.mark.parametrize("worn", [0.2, 0.5, 0.9])
def test_worn_paint_keeps_its_share(worn):
    line = {"offset_m": 0.0, "width_m": 0.5, "worn": worn, "shade": 200.0}
    surface = world_of(flat().changed(road={"markings": [line], "brightness": {"asphalt": 70.0}})).surface
    random = np.random.default_rng(1)
    at = random.uniform(0, 60, 20_000), random.uniform(-0.24, 0.24, 20_000)
    east, north, _ = surface.place(*at)
    paint = surface.intensity(east, north) == 200.0
    assert 1.0 - paint.mean() == pytest.approx(worn, abs=0.06)


def test_terrace_keeps_its_bare_earth():
    terrace = {"station_m": 30.0, "offset_m": 9.0, "length_m": 60.0, "width_m": 6.0, "height_m": 1.5, "edge_m": 0.05}
    wall = {"offset_m": 5.9, "start_m": 5.0, "end_m": 55.0, "height_m": 1.5, "thickness_m": 0.2}
    scene = flat(walls=[wall]).changed(road={"patches": [terrace], "verge_width_m": 9.0})
    world = world_of(scene)
    at = point(30.0, 0.0, 3.0)
    hits = cast(world, at, towards(at, point(30.0, 7.5, 1.5), 1.0, RAYS))
    ground = hits.object_id == 0
    offset = hits.enh_m[:, :2] @ place(0.0, 1.0)
    np.testing.assert_allclose(hits.enh_m[ground & (offset > 6.2), 2], 1.5, atol=1e-5)
    assert (ground & (offset > 6.2)).sum() > 300
    expected = world.surface.height_m(hits.enh_m[ground, 0], hits.enh_m[ground, 1])
    np.testing.assert_allclose(hits.enh_m[ground, 2], expected, atol=1e-5)


def test_sign_is_a_plate_on_a_pole():
    world = world_of(flat(signs=[{"station_m": 10.0, "offset_m": 4.0}]))
    at = point(2.0, 3.0, 2.3)
    hits = cast(world, at, towards(at, point(10.0, 4.0, 2.5), 0.4, RAYS))
    met = hits.object_id == 1
    assert (hits.part[met & (hits.intensity > 200.0)] == SIGN).all()
    assert class_of_kind("sign") == class_of_kind("pole")
