"""The road's height against its description, by formulas written again here."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad

from roadscan.core.errors import ConfigError
from roadscan.simulate.features import faults_of
from roadscan.simulate.scene import Scene, shipped_scenes
from roadscan.simulate.scene.road import Crack, Element, Marking, Patch, Pothole, Rut, Slabs, Wave
from roadscan.simulate.surface import Surface

FLAT = Scene().changed(road={"cross_slope": 0.0, "grade": 0.0, "verge_slope": 0.0})


def height_at(surface: Surface, station, offset):
    easting, northing, _ = surface.place(station, offset)
    return surface.height_m(easting, northing) - surface.origin_enh_m[2]


def test_crown_grade_and_verge():
    surface = Surface(Scene().changed(road={"grade": 0.02, "cross_slope": 0.025, "verge_slope": 0.07}))
    station = np.array([0.0, 10.0, 33.3, 80.0])
    for offset in (-3.0, -1.0, 0.5, 2.0):
        np.testing.assert_allclose(height_at(surface, station, offset), 0.02 * station - 0.025 * abs(offset), atol=1e-9)
    # At the crown itself the rounding of 0.2 m takes off half of what the slope would lose over it.
    assert height_at(surface, 5.0, 0.0) == pytest.approx(0.1 - 0.025 * 0.1, abs=1e-9)
    for offset in (-8.0, 6.5):
        fall = 0.025 * 3.5 + 0.07 * (abs(offset) - 3.5)
        np.testing.assert_allclose(height_at(surface, station, offset), 0.02 * station - fall, atol=1e-9)


def test_rut_pothole_and_crack_have_their_depths():
    surface = Surface(
        FLAT.changed(
            road={
                "ruts": [Rut(offset_m=1.0, width_m=0.8, depth_m=0.012)],
                "potholes": [Pothole(station_m=20.0, offset_m=-1.5, radius_m=0.3, depth_m=0.05)],
                "cracks": [Crack(points_m=[(40.0, -2.0), (44.0, -1.0)], width_m=0.01, depth_m=0.02)],
            }
        )
    )
    assert height_at(surface, 63.0, 1.0) == pytest.approx(-0.012, abs=1e-9)
    assert height_at(surface, 63.0, 1.4) == pytest.approx(0.0, abs=1e-9)
    assert height_at(surface, 63.0, 1.2) == pytest.approx(-0.012 * 0.75**3, abs=1e-9)
    assert height_at(surface, 20.0, -1.5) == pytest.approx(-0.05, abs=1e-9)
    assert height_at(surface, 20.15, -1.5) == pytest.approx(-0.05 * (1 - 0.5**4) ** 2, abs=1e-8)
    assert height_at(surface, 20.3, -1.5) == pytest.approx(0.0, abs=1e-9)
    assert height_at(surface, 42.0, -1.5) == pytest.approx(-0.02, abs=1e-9)
    across = np.array([1.0, -4.0]) / math.hypot(1.0, 4.0)  # at right angles to the crack, in station and offset
    for distance, depth in ((0.0025, 0.02 * 0.75**2), (-0.0025, 0.02 * 0.75**2), (0.0051, 0.0)):
        station, offset = np.array([42.0, -1.5]) + distance * across
        assert height_at(surface, station, offset) == pytest.approx(-depth, abs=1e-7)


def test_potholes_and_cracks_with_steep_walls():
    hole = Pothole(station_m=20.0, offset_m=-1.5, radius_m=0.3, depth_m=0.3, wall_m=0.01)
    slot = Crack(points_m=[(40.0, -2.0), (40.0, 2.0)], width_m=0.006, depth_m=0.02, wall_m=0.001)
    surface = Surface(FLAT.changed(road={"potholes": [hole], "cracks": [slot]}))
    np.testing.assert_allclose(height_at(surface, 20.0 + np.array([0.0, 0.289]), -1.5), -0.3, atol=1e-9)
    np.testing.assert_allclose(height_at(surface, 20.0 + np.array([0.295, 0.301]), -1.5), [-0.15, 0.0], atol=1e-8)
    np.testing.assert_allclose(height_at(surface, 40.0 + np.array([0.0, 0.0019]), 1.0), -0.02, atol=1e-9)
    np.testing.assert_allclose(height_at(surface, 40.0 + np.array([0.0025, 0.0031]), 1.0), [-0.01, 0.0], atol=1e-8)


def test_slabs_stand_a_fault_apart_and_add_nothing_up():
    slabs = Slabs(start_m=30.0, end_m=90.0, length_m=(4.0, 6.0), fault_m=(0.002, 0.015))
    surface = Surface(FLAT.changed(road={"slabs": [slabs]}))
    stations, faults = faults_of(slabs, FLAT.seed, 0)
    assert ((np.diff(stations) >= 4.0) & (np.diff(stations) <= 6.0)).all() and stations[-1] > 84.0
    assert ((np.abs(faults) >= 0.002) & (np.abs(faults) <= 0.015)).all() and len(set(np.sign(faults))) == 2
    for offset in (-3.4, 0.0, 3.4):
        approach, departure = (height_at(surface, stations + away, offset) for away in (-0.006, 0.006))
        np.testing.assert_allclose(approach - departure, faults, atol=4e-5)  # slabs lean by some millimetres a metre
        np.testing.assert_allclose(approach + departure, 0.0, atol=4e-5)
    np.testing.assert_allclose(height_at(surface, stations, 1.0), -0.02, atol=1e-9)


def test_a_patch_leans():
    patch = Patch(station_m=40.0, offset_m=0.0, length_m=10.0, width_m=7.0, height_m=0.1, rise_m=0.04, edge_m=0.005)
    surface = Surface(FLAT.changed(road={"patches": [patch]}))
    station = np.array([34.9, 35.01, 40.0, 44.99, 45.1])
    np.testing.assert_allclose(height_at(surface, station, 1.0), [0.0, 0.08004, 0.1, 0.11996, 0.0], atol=1e-9)


def test_defects_repeat():
    hole = Pothole(station_m=20.0, offset_m=0.5, radius_m=0.2, depth_m=0.03)
    crack = Crack(points_m=[(5.0, -1.0), (6.0, -1.0)], depth_m=0.01)
    surface = Surface(FLAT.changed(length_m=160.0, road={"potholes": [hole], "cracks": [crack], "repeat_m": 50.0}))
    np.testing.assert_allclose(height_at(surface, np.array([20.0, 70.0, 120.0]), 0.5), -0.03, atol=1e-9)
    np.testing.assert_allclose(height_at(surface, np.array([5.5, 55.5, 155.5]), -1.0), -0.01, atol=1e-9)
    assert height_at(surface, 45.0, 0.5) == pytest.approx(0.0, abs=1e-9)


def test_profile_is_the_sum_of_its_waves():
    waves = [Wave(wavelength_m=2.0, amplitude_m=0.001, phase_deg=40.0), Wave(wavelength_m=23.0, amplitude_m=0.03)]
    surface = Surface(FLAT.changed(road={"waves": waves}))
    station = np.linspace(-20.0, 110.0, 997)
    expected = 0.001 * np.sin(2 * np.pi * station / 2.0 + np.radians(40.0)) + 0.03 * np.sin(2 * np.pi * station / 23.0)
    np.testing.assert_allclose(height_at(surface, station, 1.0), expected, atol=1e-6)


@pytest.mark.parametrize("ride", [False, True])
@pytest.mark.parametrize(("top", "ramp"), [(0.0, 0.8), (1.1, 0.8), (2.0, 1.2), (0.0, 3.0)])
def test_humps_are_exact_between_the_nodes(ride: bool, top: float, ramp: float):
    hump = {"station_m": 12.37, "height_m": 0.1, "top_m": top, "ramp_m": ramp}
    surface = Surface(FLAT.changed(road={"humps": [hump]}), ride=ride)
    station = np.append(12.37, np.linspace(5.0, 20.0, 1501))
    x = np.clip((top / 2 + ramp - np.abs(station - 12.37)) / ramp, 0.0, 1.0)
    np.testing.assert_allclose(height_at(surface, station, 1.0), 0.1 * (10 * x**3 - 15 * x**4 + 6 * x**5), atol=1e-9)
    assert height_at(surface, 12.37, -2.0) == pytest.approx(0.1, abs=1e-9)


@pytest.mark.parametrize(("middle", "length", "slope"), [(30.17, 3.5, 0.8), (30.0, 5.0, 1.0), (30.49, 0.5, 0.5)])
def test_dropped_kerbs_are_low_over_their_length(middle: float, length: float, slope: float):
    ramp = {"station_m": middle, "length_m": length, "transition_m": slope, "height_m": 0.02}
    surface = Surface(FLAT.changed(road={"kerbs": [{"side": "right", "height_m": 0.12, "ramps": [ramp]}]}))
    low = np.linspace(middle - length / 2, middle + length / 2, 301)
    np.testing.assert_allclose(height_at(surface, low, 3.7), 0.02, atol=1e-9)
    # Half a metre for the low part's end, and half for the slope's.
    away = length / 2 + slope + 1.0
    np.testing.assert_allclose(height_at(surface, np.array([middle - away, middle + away]), 3.7), 0.12, atol=1e-9)


def test_alignment_is_the_integral_of_its_curvature():
    pieces = [
        Element(kind="straight", length_m=10.0),
        Element(kind="spiral", length_m=20.0),
        Element(kind="arc", length_m=30.0, radius_m=40.0),
        Element(kind="spiral", length_m=20.0),
    ]
    surface = Surface(Scene().changed(length_m=80.0, map={"azimuth_deg": 10.0}, road={"alignment": pieces}))

    def turned(s: float) -> float:  # of a clothoid of 20 m into and out of a radius of 40 m, written out by hand
        spiral = min(max(s - 10.0, 0.0), 20.0) ** 2 / 1600.0
        arc = min(max(s - 30.0, 0.0), 30.0) / 40.0
        rest = min(max(s - 60.0, 0.0), 20.0)
        return spiral + arc + rest / 40.0 - rest**2 / 1600.0

    for s in (7.0, 25.0, 30.0, 47.3, 71.0, 80.0):
        breaks = [b for b in (10.0, 30.0, 60.0) if b < s]
        east = quad(lambda x: math.sin(math.radians(10.0) + turned(x)), 0.0, s, points=breaks, epsabs=1e-12)[0]
        north = quad(lambda x: math.cos(math.radians(10.0) + turned(x)), 0.0, s, points=breaks, epsabs=1e-12)[0]
        easting, northing, heading = surface.place(s, 0.0)
        np.testing.assert_allclose([easting - 691_000.0, northing - 5_335_000.0], [east, north], atol=2e-5)
        assert heading == pytest.approx(math.radians(10.0) + turned(s), abs=1e-6)
    # On the arc, the inside edge runs 1 / radius shorter for each metre of offset.
    e, n, _ = surface.place(np.array([35.0, 36.0]), 3.0)
    assert math.hypot(e[1] - e[0], n[1] - n[0]) == pytest.approx(37.0 * 2 * math.sin(1 / 80.0), abs=1e-6)


def test_station_and_offset_come_back():
    surface = Surface(Scene.load("demo"))
    rng = np.random.default_rng(3)
    station, offset = rng.uniform(-40.0, 220.0, 2000), rng.uniform(-8.4, 8.4, 2000)
    easting, northing, _ = surface.place(station, offset)
    again = surface.station_offset_m(easting, northing)
    np.testing.assert_allclose(again, [station, offset], atol=2e-9)


def test_no_height_beside_the_verge_and_beyond_the_ends():
    scene = Scene()
    surface = Surface(scene)
    easting, northing, _ = surface.place(np.array([10.0, 10.0, 10.0]), np.array([10.4, 10.6, -10.6]))
    assert list(np.isnan(surface.height_m(easting, northing))) == [False, True, True]
    easting, northing, _ = surface.place(np.array([-44.9, -45.2, 145.2]), 0.0)
    assert list(np.isnan(surface.height_m(easting, northing))) == [False, True, True]


def test_intensity_tells_markings_and_defects():
    scene = Scene().changed(
        road={
            "markings": [Marking(offset_m=0.0, width_m=0.1, dash_m=3.0, gap_m=6.0), Marking(offset_m=3.2)],
            "potholes": [Pothole(station_m=20.0, offset_m=1.0, radius_m=0.2, depth_m=0.02)],
            "brightness": {"asphalt": 60.0, "marking": 200.0, "defect": 30.0, "verge": 90.0},
        }
    )
    surface = Surface(scene)
    places = [(1.0, 0.0), (4.0, 0.0), (4.0, 3.2), (20.0, 1.1), (7.0, 2.0), (7.0, 5.0), (10.0, 0.04), (-1.0, 0.0)]
    easting, northing, _ = surface.place(*np.array(places).T)
    assert list(surface.intensity(easting, northing)) == [200.0, 60.0, 200.0, 30.0, 60.0, 90.0, 200.0, 60.0]


def test_scenes_that_cannot_be():
    for change, words in (
        ({"passes": [{"lane": 3}]}, "lane 3 of a road with 2"),
        ({"road": {"alignment": [{"kind": "arc", "length_m": 5.0}]}}, "an arc needs radius_m"),
        ({"road": {"alignment": [{"kind": "arc", "length_m": 5.0, "radius_m": 5.0}]}}, "tighter than 20 m"),
        ({"vehicle": {"speed_m_per_s": 45.0}}, "lead_m"),
        ({"lidar": {"turns_per_second": 10.0}}, "did you mean 'turns_per_s'"),
    ):
        with pytest.raises(ConfigError, match=words):
            Scene().changed(**change)
    with pytest.raises(ConfigError, match="did you mean 'demo'"):
        Scene.load("demos")


def test_changed_merges_and_shipped_scenes_load():
    assert "demo" in shipped_scenes()
    demo = Scene.load("demo")
    other = demo.changed(length_m=20.0, lidar={"on": False})
    assert (other.length_m, other.lidar.on) == (20.0, False)
    assert other.lidar.range_max_m == demo.lidar.range_max_m
    assert other.road == demo.road
    assert demo.noiseless().noise.lidar_range_m == 0.0
