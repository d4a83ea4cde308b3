"""What stands and moves beside the road: met where independent formulas say, by all beams and by no other."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cache
from itertools import islice

import numpy as np
import pytest

from roadscan.simulate.caster import SLOT_NS, Hits, Pattern, World
from roadscan.simulate.drive import Drive
from roadscan.simulate.lidar_model import lidar_model
from roadscan.simulate.path import Earth
from roadscan.simulate.scene import Mount, Scene
from roadscan.simulate.sensors.lidar import BODY_FROM_AXES, measure
from roadscan.simulate.surface import Surface
from roadscan.simulate.things import objects_of, objects_table
from tests.simulate import solids

AZIMUTH = math.radians(33.0)
AHEAD = np.array([math.sin(AZIMUTH), math.cos(AZIMUTH)])
RIGHT = np.array([math.cos(AZIMUTH), -math.sin(AZIMUTH)])
LEVEL = {"cross_slope": 0.0, "grade": 0.0, "verge_slope": 0.0}
FRAME = {"crs": "local", "easting_m": 0.0, "northing_m": 0.0, "height_m": 0.0, "azimuth_deg": 33.0}
BARE = {"profilers": {"on": False}, "lidar": {"on": False}}
HERE = Mount(lever_arm_body_m=(0.0, 0.0, 0.0))


@dataclass
class Tripod:
    """A sensor that stands still in a local frame: x east, y north, z up. It takes the place of a drive."""

    at: tuple[float, float, float]
    number: int = 0
    start_gps_ns: int = 1_400_000_000 * 10**9
    earth: Earth = field(default_factory=lambda: Earth("local"))

    def poses(self, epochs: np.ndarray) -> Tripod:
        self.count = epochs.size
        return self

    def sensor(self, mount: Mount, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.tile(np.array(self.at), (self.count, 1)), np.tile(np.eye(3), (self.count, 1, 1))


def flat(**roadside) -> Scene:
    return Scene().changed(length_m=60.0, map=FRAME, road=LEVEL, roadside=roadside, **BARE)


def place(station: float, offset: float) -> np.ndarray:
    return station * AHEAD + offset * RIGHT


def cast(world: World, at, direction: np.ndarray, *, key=1, wide_deg=0.0, beside=None, steps=1) -> Hits:
    """Rays (n, 3) from a tripod, all at one time."""
    tripod = Tripod(tuple(at))
    n = len(direction)
    limits = (0.0, 80.0)
    pattern = Pattern(np.zeros((n, 3)), np.zeros(n, np.int64), np.zeros(n), wide_deg, limits, beside, (steps, 1))
    begin = tripod.start_gps_ns
    interval = np.array([[[begin, begin + 1_000]]])
    found = world.cast(tripod, HERE, np.eye(3), interval, np.ascontiguousarray(direction[None]), pattern, key)
    return Hits(
        *(getattr(found, name)[0] for name in ("range_m", "enh_m", "intensity", "object_id", "is_mixed", "part"))
    )


def world_of(scene: Scene) -> World:
    return World(scene, Surface(scene))


def towards(at, target, spread: float, count: int, seed: int = 5) -> np.ndarray:
    """Directions (n, 3) from a place to points around another."""
    points = np.asarray(target) + np.random.default_rng(seed).uniform(-spread, spread, (count, 3))
    way = points - np.asarray(at)
    return way / np.linalg.norm(way, axis=1, keepdims=True)


def expected(at, direction: np.ndarray, found: list, reach: float = 80.0, edge_m: float = 10.5):
    """Range and object of each ray, of solids given as (object, function of origin and direction) and level ground."""
    ranges, ids = [], []
    for d in direction:
        best, number = reach, -1
        if d[2] < 0:
            r = -at[2] / d[2]
            ground = np.asarray(at[:2]) + r * d[:2]
            if r < best and abs(ground @ RIGHT) <= edge_m and -45.0 <= ground @ AHEAD <= 105.0:
                best, number = r, 0
        for object_id, meets in found:
            r = meets(np.asarray(at, float), d)
            if r < best:
                best, number = r, object_id
        ranges.append(best if number >= 0 else np.nan)
        ids.append(number)
    return np.array(ranges), np.array(ids)


def check(world: World, at, direction: np.ndarray, found: list, least: int) -> None:
    hits = cast(world, at, direction)
    ranges, ids = expected(at, direction, found)
    np.testing.assert_array_equal(hits.object_id, ids)
    np.testing.assert_allclose(hits.range_m, ranges, atol=2e-6)
    seen = np.isfinite(ranges)
    np.testing.assert_allclose(hits.enh_m[seen], (np.asarray(at) + ranges[:, None] * direction)[seen], atol=2e-6)
    assert (ids > 0).sum() > least


def test_box_turned_on_the_road():
    box = {"station_m": 12.0, "offset_m": -1.5, "length_m": 1.6, "width_m": 0.7, "height_m": 0.5, "heading_deg": 25.0}
    at = (*place(4.0, 1.0), 1.8)
    middle = place(12.0, -1.5)
    check(
        world_of(flat(boxes=[box])),
        at,
        towards(at, [*middle, 0.3], 1.2, 3000),
        [(1, lambda o, d: solids.box(o, d, middle, 1.6, 0.7, -0.3, 0.5, AZIMUTH + math.radians(25.0)))],
        400,
    )


def test_pole_seen_from_the_side_and_from_above():
    pole = {"station_m": 8.0, "offset_m": 3.0, "height_m": 1.4, "diameter_m": 0.5}
    middle = place(8.0, 3.0)
    for at in ((*place(2.0, 2.0), 0.7), (*place(8.3, 2.5), 4.0)):
        check(
            world_of(flat(poles=[pole])),
            at,
            towards(at, [*middle, 0.8], 0.7, 2000),
            [(1, lambda o, d: solids.cylinder(o, d, middle, 0.25, -0.3, 1.4))],
            300,
        )


@pytest.mark.slow
def test_signs_round_and_square():
    signs = [
        {"station_m": 10.0, "offset_m": 5.0, "width_m": 0.8, "height_m": 0.5, "clearance_m": 1.5},
        {"station_m": 10.0, "offset_m": 7.0, "width_m": 0.8, "shape": "round", "clearance_m": 1.5, "faces": "forward"},
    ]
    square, around = place(9.96, 5.0), place(10.04, 7.0)
    normal = np.array([*AHEAD, 0.0])
    solid = [
        (1, lambda o, d: solids.quad(o, d, square - 0.4 * RIGHT, square + 0.4 * RIGHT, 1.5, 2.0)),
        (1, lambda o, d: solids.cylinder(o, d, place(10.0, 5.0), 0.03, -0.3, 2.0)),
        (2, lambda o, d: solids.disc(o, d, np.array([*around, 1.9]), 0.4, normal)),
        (2, lambda o, d: solids.cylinder(o, d, place(10.0, 7.0), 0.03, -0.3, 2.3)),
    ]
    for at in ((*place(2.0, 4.0), 1.2), (*place(20.0, 3.0), 2.5)):
        check(world_of(flat(signs=signs)), at, towards(at, [*place(10.0, 6.0), 1.7], 1.3, 3000), solid, 200)


@pytest.mark.slow
def test_tree_without_gaps_lamp_post_and_guardrail():
    scene = flat(
        lamp_posts=[{"station_m": 15.0, "offset_m": 6.0, "height_m": 5.0, "arm_m": 1.5}],
        trees=[{"station_m": 20.0, "offset_m": -6.0, "height_m": 7.0, "trunk_m": 0.4, "crown_m": 4.0, "density": 1.0}],
        guardrails=[{"offset_m": 5.0, "start_m": 5.0, "end_m": 25.0}],
    )
    lamp, tree = place(15.0, 6.0), place(20.0, -6.0)
    rail = [(3, lambda o, d: solids.quad(o, d, place(5.0, 5.0), place(25.0, 5.0), 0.44, 0.75))]
    posts = [
        (3, lambda o, d, s=s: solids.cylinder(o, d, place(s, 5.07), 0.05, -0.3, 0.73)) for s in np.arange(5.0, 25.1, 2)
    ]
    solid = [
        (1, lambda o, d: solids.cylinder(o, d, lamp, 0.08, -0.3, 5.0)),
        (1, lambda o, d: solids.box(o, d, place(15.0, 5.25), 0.12, 1.5, 4.88, 5.0, AZIMUTH)),
        (1, lambda o, d: solids.box(o, d, place(15.0, 4.5), 0.25, 0.5, 4.88, 5.0, AZIMUTH)),
        (2, lambda o, d: solids.cylinder(o, d, tree, 0.2, -0.3, 4.55)),
        (2, lambda o, d: min(solids.ellipsoid(o, d, tree, 2.0, 2.1, 7.0), default=np.inf)),
        *rail,
        *posts,
    ]
    world = world_of(scene)
    at = (*place(3.0, 0.0), 1.9)
    for middle, spread in (([*lamp, 2.5], 3.0), ([*tree, 3.5], 3.5), ([*place(14.0, 5.0), 0.5], 4.0)):
        check(world, at, towards(at, middle, spread, 600), solid, 20)


def test_parked_car_is_body_cabin_and_wheels():
    car = {"station_m": 14.0, "offset_m": 3.0, "heading_deg": 180.0}
    at = (*place(5.0, -1.0), 2.0)
    heading = AZIMUTH + math.pi
    back = place(14.0 + 0.06 * 4.4, 3.0)  # behind the middle of a car that looks the other way
    solid = [
        (1, lambda o, d: solids.box(o, d, place(14.0, 3.0), 4.4, 1.8, 0.21, 0.93, heading)),
        (1, lambda o, d: solids.box(o, d, back, 2.42, 1.62, 0.93, 1.5, heading)),
    ]
    for ahead in (-1.364, 1.364):
        for right in (-0.81, 0.81):
            middle = place(14.0 + ahead, 3.0 + right)
            solid.append((1, lambda o, d, m=middle: solids.box(o, d, m, 0.62, 0.2, -0.05, 0.6, heading)))
    check(world_of(flat(parked_cars=[car])), at, towards(at, [*place(14.0, 3.0), 0.7], 2.5, 2500), solid, 500)


@pytest.mark.slow
def test_gaps_let_the_stated_share_through():
    world = world_of(flat(fences=[{"offset_m": 5.0, "start_m": 0.0, "end_m": 30.0, "height_m": 3.0, "density": 0.4}]))
    at = (*place(15.0, 0.0), 1.5)
    way = towards(at, [*place(15.0, 5.0), 1.5], 1.0, 20_000)
    first = cast(world, at, way).object_id == 1
    assert first.mean() == pytest.approx(0.4, abs=4 * math.sqrt(0.24 / 20_000))
    # The same beams again are stopped again, others are not the same ones.
    np.testing.assert_array_equal(cast(world, at, way).object_id == 1, first)
    other = cast(world, at, way, key=10**9).object_id == 1
    assert (first & other).mean() == pytest.approx(0.16, abs=0.02)

    tree = {"station_m": 15.0, "offset_m": 6.0, "height_m": 8.0, "crown_m": 5.0, "density": 0.7, "trunk_m": 0.03}
    world = world_of(flat(trees=[tree]))
    at = (*place(15.0, -3.0), 5.0)
    way = towards(at, [*place(15.0, 6.0), 4.7], 1.0, 20_000)
    hits = cast(world, at, way)
    middle = place(15.0, 6.0)
    both = [solids.ellipsoid(np.array(at), d, middle, 2.5, 2.4, 8.0) for d in way]
    near, far = (np.array([b[i] for b in both]) for i in (0, 1))
    is_near, is_far = np.abs(hits.range_m - near) < 1e-5, np.abs(hits.range_m - far) < 1e-5
    assert is_near.mean() == pytest.approx(0.7, abs=0.015)
    assert is_far.mean() == pytest.approx(0.3 * 0.7, abs=0.015)


def test_windows_mirror_beams_away():
    scene = flat(facades=[{"offset_m": 9.0, "start_m": 0.0, "end_m": 32.0, "height_m": 9.0}])
    at = (*place(14.0, 0.0), 4.0)
    rng = np.random.default_rng(2)
    along, up = rng.uniform(1.0, 31.0, 5000), rng.uniform(0.1, 8.9, 5000)
    points = np.column_stack([along[:, None] * AHEAD + 9.0 * RIGHT, up])
    away = np.linalg.norm(points - at, axis=1)
    hits = cast(world_of(scene), at, (points - at) / away[:, None])
    assert (hits.object_id == 1).all()
    # Windows of 1.2 m in the middle of bays of 3.2 m and storeys of 3 m.
    glass = (np.abs(along % 3.2 - 1.6) < 0.6) & (np.abs(up % 3.0 - 1.5) < 0.6)
    np.testing.assert_array_equal(np.isnan(hits.range_m), glass)
    np.testing.assert_allclose(hits.range_m[~glass], away[~glass], atol=1e-6)
    assert (hits.intensity[~glass] == 140.0).all()


def test_moving_car_moves_in_its_passes_only():
    car = {"station_m": 20.0, "offset_m": -1.75, "speed_m_per_s": 10.0, "passes": [2]}
    scene = flat(moving_cars=[car]).changed(passes=[{"lane": 2}, {"lane": 2}])
    world = world_of(scene)
    at = (*place(0.0, -1.75), 0.6)
    way = np.array([[*AHEAD, 0.0]])
    assert cast(world, at, way).object_id[0] == -1
    pattern = Pattern(np.zeros((1, 3)), np.zeros(1, np.int64), np.zeros(1), 0.0, (0.0, 80.0))
    tripod = Tripod(at, number=1)
    for time_s in (-0.31, 0.0, 0.05, 0.7123, 2.5):
        begin = tripod.start_gps_ns + round(time_s * 1e9)
        interval = np.array([[[begin, begin + 1_000]]])
        found = world.cast(tripod, HERE, np.eye(3), interval, way[None], pattern, 1)
        assert found.object_id[0, 0] == 1
        # Its rear is half of 4.4 m behind its middle.
        assert found.range_m[0, 0] == pytest.approx(20.0 + 10.0 * time_s - 2.2, abs=1e-5)


def test_kerb_faces_are_met_at_their_true_place():
    road = LEVEL | {"kerbs": [{"side": "right", "height_m": 0.12, "face_m": 0.02}], "lanes": 2}
    scene = flat().changed(road=road)
    world = world_of(scene)
    rng = np.random.default_rng(8)
    # The last one sits behind the kerb and does not see its face.
    for at, least in (((*place(20.0, 0.0), 0.5), 100), ((*place(20.0, 2.8), 2.0), 100), ((*place(20.0, 8.0), 0.6), 0)):
        points = rng.uniform([12.0, 3.45, -0.01], [28.0, 3.56, 0.14], (1500, 3))
        way = np.array([[*place(s, o), z] for s, o, z in points]) - at
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        hits = cast(world, at, way)

        def gap(p: np.ndarray) -> np.ndarray:
            x = np.clip((p[..., :2] @ RIGHT - 3.5) / 0.02, 0.0, 1.0)
            return p[..., 2] - 0.12 * x * x * (3.0 - 2.0 * x)

        seen = hits.object_id == 0
        assert seen.mean() > 0.9
        assert np.abs(gap(hits.enh_m[seen])).max() < 2e-7
        on_face = np.abs(hits.enh_m[seen][:, :2] @ RIGHT - 3.51) < 0.009
        assert on_face.sum() > least if least else on_face.sum() == 0
        for d, r in zip(way[seen][::5], hits.range_m[seen][::5], strict=True):
            before = np.arange(0.0, r - 0.001, 0.001)[:, None]
            assert gap(np.asarray(at) + before * d).min() > -1e-5


URBAN = {
    "length_m": 60.0,
    "passes": [{"lane": 2}],
    "profilers": {"on": False},
    "lidar": {"range_max_m": 25.0, "mount": {"lever_arm_body_m": [-1.7, 0.1, -0.6], "pitch_deg": 6.0}},
    "road": {
        "alignment": [
            {"kind": "straight", "length_m": 20.0},
            {"kind": "spiral", "length_m": 15.0},
            {"kind": "arc", "length_m": 40.0, "radius_m": 40.0},
        ],
        "lanes": 2,
        "shoulder_width_m": 2.0,
        "verge_width_m": 5.0,
        "kerbs": [{"side": "left"}, {"side": "right", "ramps": [{"station_m": 20.0}]}],
        "grades": [{"station_m": 25.0, "grade": -0.08, "curve_m": 12.0}],
        "humps": [{"station_m": 12.0, "height_m": 0.1, "ramp_m": 1.2}],
        "roughness": {"iso_class": "D"},
        "ruts": [{"offset_m": 2.5, "depth_m": 0.02}],
        "potholes": [{"station_m": 30.0, "offset_m": 1.0, "radius_m": 0.4, "depth_m": 0.08}],
        "alligators": [{"station_m": 10.0, "offset_m": 2.0}],
        "joints": [{"spacing_m": 5.0}],
        "patches": [{"station_m": 15.0, "offset_m": -1.0, "height_m": 0.02, "edge_m": 0.01}],
    },
    "roadside": {
        "signs": [{"station_m": 5.0, "offset_m": 6.5, "every_m": 9.0, "count": 6}],
        "poles": [{"station_m": 0.0, "offset_m": 6.0, "every_m": 4.0, "count": 15}],
        "trees": [{"station_m": 2.0, "offset_m": -8.0, "every_m": 11.0, "count": 5, "density": 1.0}],
        "parked_cars": [{"station_m": 3.0, "offset_m": 4.4, "every_m": 8.0, "count": 7}],
        "moving_cars": [{"station_m": 16.0, "offset_m": -1.7, "speed_m_per_s": -11.0}],
        "guardrails": [{"offset_m": -6.0, "start_m": 10.0, "end_m": 40.0}],
        "facades": [{"offset_m": 9.8, "start_m": -10.0, "end_m": 40.0, "window_m": 0.0}],
        "boxes": [{"station_m": 8.0, "offset_m": 1.7, "length_m": 0.4, "width_m": 0.3, "height_m": 0.25}],
    },
}


@cache
def urban() -> tuple[Scene, World, Drive]:
    scene = Scene().changed(**URBAN)
    surface = Surface(scene)
    drive = Drive(scene, 0, Earth(scene.map.crs), Surface(scene, ride=True))
    return scene, World(scene, surface), drive


def nearest_body(rows: np.ndarray, o: np.ndarray, d: np.ndarray) -> float:
    """Nearest body of all in the way of a ray, each asked by itself."""
    best = np.inf
    highest, lowest = np.maximum(rows[:, 8], rows[:, 10]), np.minimum(rows[:, 7], rows[:, 9]) - rows[:, 11]
    reach = np.linalg.norm([rows[:, 5], np.maximum(rows[:, 6], rows[:, 5]), (highest - lowest) / 2], axis=0)
    middle = np.column_stack([rows[:, 1:3], (highest + lowest) / 2]) - o
    aside = np.linalg.norm(np.cross(middle, d / np.linalg.norm(d)), axis=1)
    for b in rows[aside <= reach + 0.01]:
        kind, centre, heading, half = b[0], b[1:3], math.atan2(b[3], b[4]), b[5]
        if kind == 0.0:
            r = solids.box(o, d, centre, 2 * half, 2 * b[6], b[7], b[8], heading)
        elif kind == 1.0:
            r = solids.cylinder(o, d, centre, half, b[7], b[8])
        elif kind == 2.0:
            r = min(solids.ellipsoid(o, d, centre, half, b[7], b[8]), default=np.inf)
        else:  # walls on a slope: the lower edge by their skirt is enough, the upper edge is checked below
            ends = [centre - half * b[3:5], centre + half * b[3:5]]
            r = solids.quad(o, d, *ends, min(b[7], b[9]) - b[11], max(b[8], b[10]))
            if np.isfinite(r):
                at = o + r * d
                share = ((at[:2] - centre) @ b[3:5] / half + 1) / 2
                low = b[7] + share * (b[9] - b[7]) - b[11]
                r = r if low <= at[2] <= b[8] + share * (b[10] - b[8]) else np.inf
        best = min(best, r)
    return best


def over_ground(surface: Surface, way: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Heights above the ground (NaN: there is none) on the parabola through begin, middle and end of a ray."""
    t = share[:, None]
    path = way[0] + t * ((4 * way[1] - 3 * way[0] - way[2]) + t * 2 * (way[0] - 2 * way[1] + way[2]))
    return path[:, 2] - surface.height_m(path[:, 0], path[:, 1], texture=False)


@pytest.mark.slow
def test_every_hit_is_the_first_thing_in_the_way():
    """500 rays of a lidar, each walked in steps of a millimetre over the road, and past every body on its own."""
    scene, world, drive = urban()
    surface, beams = world.surface, lidar_model("HDL-32E")
    rng = np.random.default_rng(4)
    rows = world.arrays.bodies
    counted = {"road": 0, "body": 0, "nothing": 0}
    for block in islice(measure(scene, world, drive), 4, 23, 9):
        epochs = block.firing_gps_ns().reshape(block.found.range_m.shape)
        azimuth = np.radians(block.azimuth_deg).reshape(epochs.shape)
        for p, i in zip(rng.integers(0, len(epochs), 190), rng.integers(0, 384, 190), strict=True):
            elevation = math.radians(beams.elevation_deg[i % 32])
            flat_part = math.cos(elevation)
            d = [flat_part * math.cos(azimuth[p, i]), -flat_part * math.sin(azimuth[p, i]), math.sin(elevation)]
            o, turn = drive.poses(epochs[p, i][None]).sensor(scene.lidar.mount, BODY_FROM_AXES)
            o = o[0] + turn[0] @ [0.0, 0.0, beams.rise_m[i % 32]]
            found, number_met = block.found.range_m[p, i], block.found.object_id[p, i]
            end = found if number_met >= 0 else scene.lidar.range_max_m
            # In the map a ray is a parabola, as good as straight over 25 m.
            way = drive.earth.map_from_ecef(o + np.array([0.0, end / 2, end])[:, None] * (turn[0] @ d))
            gap = over_ground(surface, way, np.arange(0.0, end - 0.002, 0.05) / end)
            near = np.flatnonzero(np.nan_to_num(gap, nan=0.0) < 0.3) * 0.05
            fine = (near[:, None] + np.arange(-0.05, 0.05, 0.001)).ravel()
            gap = over_ground(surface, way, fine[(fine > 0.0) & (fine < end - 0.002)] / end)
            assert np.nanmin(gap, initial=1.0) > -2e-5
            origin, chord = way[0] - surface.origin_enh_m, (way[2] - way[0]) / end
            body = nearest_body(rows, origin, chord)
            if number_met > 0 and number_met <= len(world.objects):
                assert found == pytest.approx(body, abs=1e-4)
                counted["body"] += 1
            elif number_met >= 0:
                assert body > found - 1e-4
                hit = block.found.enh_m[p, i]
                np.testing.assert_allclose(hit, way[2], atol=1e-5)
                if number_met == 0:
                    assert abs(hit[2] - surface.height_m(hit[0], hit[1], texture=False)) < 1e-6
                    counted["road"] += 1
            else:
                assert body > end - 1e-4 or np.isnan(gap).any()
                counted["nothing"] += 1
    assert sum(counted.values()) >= 500
    assert min(counted.values()) > 40, counted


@pytest.mark.slow
def test_blocks_change_nothing(monkeypatch: pytest.MonkeyPatch):
    scene, _, drive = urban()
    scene = scene.changed(
        lidar={"divergence_deg": 0.1}, roadside={"fences": [{"offset_m": -7.0, "start_m": 0.0, "end_m": 40.0}]}
    )
    world = world_of(scene)

    def whole() -> tuple[np.ndarray, ...]:
        blocks = []
        for block in measure(scene, world, drive):
            blocks.append((block.ranges, block.found.object_id, block.found.is_mixed))
            if sum(len(b[0]) for b in blocks) >= 600:
                break
        return tuple(np.concatenate(column)[:600] for column in zip(*blocks, strict=True))

    first = whole()
    monkeypatch.setattr("roadscan.simulate.sensors.lidar.BLOCK_PACKETS", 40)
    for a, b in zip(first, whole(), strict=True):
        np.testing.assert_array_equal(a, b)
    assert first[1].max() > len(world.objects)  # the moving car was seen
    assert first[2].any()
    assert SLOT_NS > 40 * 552_960  # so the slots of time are not the blocks


def test_wide_beams_mix_at_edges():
    """A box before a wall: where a beam touches both, the receiver sees something between, or the stronger one."""
    box = {"station_m": 10.0, "offset_m": 0.0, "length_m": 0.5, "width_m": 1.0, "height_m": 1.5}
    for gap_m, between in ((0.7, True), (6.0, False)):
        wall = {"station_m": 10.25 + gap_m, "offset_m": 0.0, "length_m": 1.0, "width_m": 9.0, "height_m": 4.0}
        world = world_of(flat(boxes=[box, wall]))
        at = (*place(0.0, 0.0), 1.0)
        aside = np.linspace(0.3, 0.7, 801)
        way = np.array([[*place(9.75, a), 1.0] for a in aside]) - at
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        thin, wide = cast(world, at, way), cast(world, at, way, wide_deg=0.4)
        assert not thin.is_mixed.any()
        # Half of the width is 0.2 degrees, 34 mm at 9.76 m.
        touches = np.abs(aside - 0.5) < 0.033
        assert not wide.is_mixed[np.abs(aside - 0.5) > 0.036].any()
        plain = ~wide.is_mixed
        np.testing.assert_array_equal(wide.range_m[plain], thin.range_m[plain])
        ahead = (wide.enh_m[:, :2] @ AHEAD)[wide.is_mixed]
        if between:
            assert wide.is_mixed[touches].all()
            assert ((ahead > 9.76) & (ahead < 9.74 + gap_m)).all()
        else:
            # The stronger group alone: never anything in the air between box and wall.
            ahead = wide.enh_m[:, :2] @ AHEAD
            assert ((np.abs(ahead - 9.75) < 0.03) | (np.abs(ahead - 9.75 - gap_m) < 0.03)).all()


@pytest.mark.parametrize(("step_deg", "steps"), [(0.3, 1), (0.02, 11)])
def test_neighbours_tell_where_edges_are(step_deg: float, steps: int):
    """Rays that know their neighbours look for edges less often, and find the same ones."""
    boxes = [
        {"station_m": 10.0, "offset_m": -1.0, "length_m": 0.5, "width_m": 1.0, "height_m": 1.5},
        {"station_m": 11.0, "offset_m": 0.0, "length_m": 0.5, "width_m": 9.0, "height_m": 4.0},
    ]
    poles = [{"station_m": 9.5, "offset_m": 1.5, "height_m": 3.0, "diameter_m": 0.3}]
    world = world_of(flat(boxes=boxes, poles=poles))
    angle = AZIMUTH + np.radians(np.arange(-40.0, 40.0, step_deg))
    way = np.column_stack([np.sin(angle), np.cos(angle), np.zeros(angle.size)])
    number = np.arange(angle.size)
    after = np.where(number + 1 < angle.size, number + 1, -1)
    sides = np.column_stack([after, number - 1, np.full((angle.size, 2), -1)])
    at = (*place(0.0, 0.0), 1.0)
    blind = cast(world, at, way, wide_deg=0.4)
    known = cast(world, at, way, wide_deg=0.4, beside=sides, steps=steps)
    np.testing.assert_array_equal(known.is_mixed, blind.is_mixed)
    np.testing.assert_array_equal(known.object_id, blind.object_id)
    np.testing.assert_allclose(known.range_m, blind.range_m, rtol=1e-14)  # sums in another order
    assert 1 <= known.is_mixed.sum() < 0.5 * angle.size
    if steps > 1:  # fine enough to see each edge: none is farther than half of the width from a mixed ray
        thin = cast(world, at, way)
        is_edge = (np.diff(thin.object_id) != 0) | (np.abs(np.diff(thin.range_m)) > 0.05)
        away = np.abs(np.flatnonzero(known.is_mixed)[:, None] - np.flatnonzero(is_edge) - 0.5).min(axis=1)
        assert away.max() <= steps
        assert known.is_mixed.mean() < 0.06


def test_long_spots_on_smooth_ground_mix_nothing():
    """At a low angle a beam lights metres of ground at a time: one surface still, and the middle tells the range."""
    world = world_of(flat())
    at = (*place(0.0, 0.0), 2.0)
    down = np.radians(np.linspace(2.5, 12.0, 400))
    way = np.column_stack([np.cos(down)[:, None] * AHEAD, -np.sin(down)])
    thin, wide = cast(world, at, way), cast(world, at, way, wide_deg=0.4)
    near, far = 2.0 / np.sin(down[0] + np.radians(0.2)), 2.0 / np.sin(down[0] - np.radians(0.2))
    assert far - near > 5.0
    assert not wide.is_mixed.any()
    assert (wide.object_id == 0).all()
    np.testing.assert_array_equal(wide.range_m, thin.range_m)
    # With a box on it there are two surfaces.
    box = {"station_m": 25.0, "offset_m": 0.0, "length_m": 0.5, "width_m": 3.0, "height_m": 0.5}
    wide = cast(world_of(flat(boxes=[box])), at, way, wide_deg=0.4)
    assert 0 < wide.is_mixed.sum() < 40


def test_objects_stand_on_the_true_surface():
    scene, world, _ = urban()
    table = objects_table(scene, world.surface).to_pydict()
    assert table["object_id"] == list(range(1, len(world.objects) + 2))
    assert table["kind"].count("pole") == 15
    assert (table["kind"][-1], table["speed_m_per_s"][-1]) == ("moving_car", -11.0)
    height = world.surface.height_m(table["easting_m"], table["northing_m"], texture=False)
    known = np.isfinite(height)
    assert known.sum() > 30
    np.testing.assert_allclose(np.array(table["height_m"])[known], height[known], atol=1e-9)
    station, offset = world.surface.station_offset_m(table["easting_m"], table["northing_m"])
    np.testing.assert_allclose(station, table["station_m"], atol=1e-6)
    np.testing.assert_allclose(offset, table["offset_m"], atol=1e-6)
    # A box of 0.25 m is that high above the ground at its middle.
    box = next(o for o in objects_of(scene, world.surface) if o.kind == "box")
    assert box.bodies[0, 8] - box.enh_m[2] == pytest.approx(0.25, abs=1e-12)


def test_guardrail_follows_a_curve():
    _, world, _ = urban()
    rail = next(o for o in world.objects if o.kind == "guardrail")
    walls = rail.bodies[rail.bodies[:, 0] == 3.0]
    assert (2 * walls[:, 5]).max() <= 2.0 * 1.16  # to the left of a right turn of 40 m it is longer than its stations
    for side in (-1.0, 1.0):
        ends = walls[:, 1:3] + side * walls[:, 5:6] * walls[:, 3:5]
        e, n = (ends + world.surface.origin_enh_m[:2]).T
        _, offset = world.surface.station_offset_m(e, n)
        np.testing.assert_allclose(offset, -6.0, atol=1e-6)
        upper = walls[:, 8] if side < 0 else walls[:, 10]
        ground = world.surface.height_m(e, n, texture=False) - world.surface.origin_enh_m[2]
        np.testing.assert_allclose(upper - ground, 0.75, atol=1e-9)
