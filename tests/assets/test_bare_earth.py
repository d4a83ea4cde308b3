"""Bare earth against labels by hand and against the surface that a street was made from."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from roadscan.assets import classes
from roadscan.assets.ground.bare_earth import ground_returns
from roadscan.assets.ground.dense import undersides
from roadscan.assets.ground.surface import Grid, Place, filled, is_dense, opened
from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box
from roadscan.assets.settings import GroundSettings
from roadscan.simulate import Scene as Street
from tests.assets.airborne import airborne
from tests.assets.edges.streets import returns_of
from tests.assets.isprs import SAMPLES, isprs_sample
from tests.assets.isprs_run import classified
from tests.assets.scenes import GROUND_LABELS, NOT_JUDGED, semantic_kitti_returns
from tests.assets.streets import street

NO_DRIVE = np.zeros((0, 4))


def total_errors(recordings: Path, method: str) -> dict[str, float]:
    """Share of wrong returns of each sample of the filter test (%), with the settings that every survey has."""
    found = {}
    for sample in SAMPLES:
        points, on_ground = isprs_sample(recordings, sample)
        window = Box(0.0, 0.0, *(np.floor(points[:, :2].max(axis=0)) + 1.0).tolist())
        place = Place(airborne(points), window, GroundSettings.parse({"method": method}))
        assert not is_dense(place)
        found[sample] = 100.0 * float(np.mean(ground_returns(place).on_ground != on_ground))
    return found


@pytest.mark.slow
def test_airborne_samples_of_the_filter_test(recordings: Path) -> None:
    # A plain simple morphological filter has 4.0 % in the mean, each sample left out of the choice of its setting.
    wrong = total_errors(recordings, "morphological")
    assert np.mean(list(wrong.values())) <= 3.7
    assert max(wrong.values()) <= 8.5


def test_squares_with_the_halo_of_the_filter_find_what_the_whole_sample_does(recordings: Path) -> None:
    points, on_ground = isprs_sample(recordings, "41")
    x, y = points[:, :2].T
    settings = GroundSettings()
    reach, edge = settings.depends_on_m, 40.0
    found = np.zeros(len(points), np.bool_)
    for east in np.arange(-17.0, x.max(), edge):
        for north in np.arange(-11.0, y.max(), edge):
            own = Box(east, north, east + edge, north + edge).holds(x, y)
            window = Box(east - reach, north - reach, east + edge + reach, north + edge + reach)
            near = window.holds(x, y)
            found[own] = ground_returns(Place(airborne(points[near]), window, settings)).on_ground[own[near]]
    whole = Box(0.0, 0.0, np.floor(x.max()) + 1.0, np.floor(y.max()) + 1.0)
    at_once = ground_returns(Place(airborne(points), whole, settings)).on_ground
    assert np.mean(found != at_once) <= 0.01  # with a halo of 8 m: 0.07
    assert np.mean(found != on_ground) <= 0.035


@pytest.mark.nightly
@pytest.mark.timeout(7200)
def test_the_samples_through_the_command_line(recordings: Path, tmp_path: Path) -> None:
    wrong = []
    for sample in SAMPLES:
        points, on_ground = isprs_sample(recordings, sample)
        folder = tmp_path / sample
        folder.mkdir()
        found = np.isin(classified(points, folder), (classes.GROUND, classes.ROAD))
        wrong.append(100.0 * float(np.mean(found != on_ground)))
    assert np.mean(wrong) <= 3.7


def terraces(draw: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3), one a square metre, on four terraces of 30 m by 4 m with houses, a hedge and a bridge over a cut,
    and which of them lie on the ground.
    """
    x, y = draw.uniform(0.0, 120.0, (2, 14_400))
    ground = 4.0 * np.floor(x / 30.0) + 0.05 * y
    cut = np.abs(y - 60.0) < 8.0
    ground[cut] -= 6.0
    above = np.zeros(x.size)
    for east, north in ((8.0, 20.0), (40.0, 90.0), (69.0, 25.0), (98.0, 95.0)):
        above[(np.abs(x - east - 6.0) < 6.0) & (np.abs(y - north) < 8.0)] = 6.0
    above[(np.abs(y - 40.0) < 0.8) & (x > 62.0)] = 1.5
    deck = cut & (np.abs(x - 75.0) < 3.0)
    above[deck] = 6.0
    return np.column_stack([x, y, ground + above + draw.normal(0.0, 0.05, x.size)]), above == 0.0


def test_terraces_are_ground_and_houses_on_them_and_a_bridge_are_not() -> None:
    points, on_ground = terraces(np.random.default_rng(37))
    found = ground_returns(Place(airborne(points), Box(0.0, 0.0, 120.0, 120.0), GroundSettings())).on_ground
    assert np.mean(found[on_ground]) >= 0.977  # without the crests of breaks: 0.974
    assert np.mean(found[~on_ground]) <= 0.05


def iou(found: np.ndarray, true: np.ndarray, labels: np.ndarray) -> float:
    judged = ~np.isin(labels, NOT_JUDGED)
    return float((found & true & judged).sum() / ((found | true) & judged).sum())


def test_planes_by_name() -> None:
    returns, labels, _ = semantic_kitti_returns()
    window = Box(-30.0, -30.0, 30.0, 30.0)
    inside = window.holds(returns.x_m, returns.y_m)
    place = Place(returns.at(inside), window, GroundSettings(method="planes"))
    ground, labels = ground_returns(place).on_ground, labels[inside]
    assert iou(ground, np.isin(labels, GROUND_LABELS), labels) >= 0.8
    assert ground[labels == 40].mean() >= 0.97
    # Draws come from a square's place: what else is in the window changes nothing in it.
    square = Box(0.0, -10.0, 10.0, 0.0)
    wider = Box(-2.0, -12.0, 12.0, 2.0)
    near = wider.holds(place.returns.x_m, place.returns.y_m)
    alone = ground_returns(Place(place.returns.at(near), wider, GroundSettings(method="planes"))).on_ground
    inner = square.holds(place.returns.x_m[near], place.returns.y_m[near])
    assert inner.sum() > 10_000
    assert np.array_equal(alone[inner], ground[near][inner])


@pytest.mark.slow
def test_a_simulated_street_has_its_own_surface_again() -> None:
    scene = Street.load("urban_street").changed(
        length_m=6.0,
        passes=[{"lane": 2}],
        profilers={"on": False},
        sick={"on": False},
        camera={"on": False},
        lidar={"divergence_deg": 0.0},
    )
    seen = street(scene)
    window = Box(-20.0, -24.0, 16.0, 16.0)
    inside = window.holds(seen.returns.x_m, seen.returns.y_m)
    found = make_scene(seen.returns.at(inside), window, window, seen.drive_xyh_m)
    ground = found.ground
    rows, columns = ground.height_m.shape
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    easting = seen.returns.corner_m[0] + ground.x_min_m + (x + 0.5) * ground.cell_m
    northing = seen.returns.corner_m[1] + ground.y_min_m + (y + 0.5) * ground.cell_m
    shifts = [(a, b) for a in (-0.08, 0.0, 0.08) for b in (-0.08, 0.0, 0.08)]
    true = np.mean([seen.surface.height_m(easting + a, northing + b) for a, b in shifts], axis=0)
    station, offset = seen.surface.station_offset_m(easting, northing)
    near = (station > -5.0) & (station < 10.0) & ground.seen & np.isfinite(true)
    road, beside = near & (np.abs(offset) < 3.25), near & (np.abs(offset) > 5.0) & (np.abs(offset) < 8.5)
    wrong = ground.height_m - true
    assert road.sum() > 1000 and beside.sum() > 500
    assert np.sqrt(np.mean(wrong[road] ** 2)) <= 0.008
    assert np.sqrt(np.mean(wrong[beside] ** 2)) <= 0.015
    assert ground.sigma_m is not None
    z = wrong[road] / ground.sigma_m[road]
    assert 0.5 < np.sqrt(np.mean(z**2)) < 2.0
    hit = seen.object_id[inside]
    cars = [o.id for o in seen.world.objects if o.kind == "parked_car"]
    at_car = np.isin(hit, cars) & (np.hypot(found.returns.x_m, found.returns.y_m) < 15.0)
    left = ~np.isin(found.classes[at_car], (classes.VEHICLE, classes.GROUND, classes.ROAD, classes.LOW_NOISE))
    assert at_car.sum() > 5000
    assert left.mean() <= 0.08  # one side of each is seen


@pytest.mark.parametrize("slope", [0.2, 0.5, 0.7])
def test_hillsides_and_banks_are_ground(slope: float) -> None:
    draw = np.random.default_rng(0)
    x, y = draw.uniform(0.0, 40.0, (2, 100_000))
    window = Box(0.0, 0.0, 40.0, 40.0)
    for height in (slope * x, slope * np.clip(x - 24.0, 0.0, 10.0)):
        points = np.column_stack([x, y, height + draw.normal(0.0, 0.01, x.size)])
        scene = make_scene(airborne(points), window, window, NO_DRIVE)
        assert (scene.classes == classes.GROUND).mean() >= 0.995


def test_holes_are_filled_by_a_membrane() -> None:
    y, x = np.mgrid[0:60, 0:80].astype(np.float32)
    harmonic = 0.002 * (x * x - y * y) + 0.05 * x
    known = np.ones(x.shape, np.bool_)
    known[20:45, 30:60] = False
    grid = Grid(0.0, 0.0, 1.0, 60, 80)
    wrong = np.abs(filled(np.where(known, harmonic, 0.0).astype(np.float32), known, grid) - harmonic)
    assert wrong[known].max() == 0.0
    assert wrong.max() < 0.01 * np.ptp(harmonic[20:45, 30:60])


def test_holes_are_filled_alike_in_any_part_of_the_map() -> None:
    draw = np.random.default_rng(5)
    y, x = np.mgrid[0:320, 0:320]
    height = (0.02 * x + np.sin(0.05 * y) + draw.normal(0.0, 0.05, x.shape)).astype(np.float32)
    known = (draw.random(x.shape) < 0.02) & (np.hypot(x - 150, y - 170) > 25)  # one hole is 25 m wide
    found = filled(height, known, Grid(0.0, 0.0, 0.5, 320, 320))
    for first in (24, 36, 61):  # parts whose corners lie anywhere, also between cells of coarser levels
        part = (slice(first, 290), slice(first + 7, 300))
        grid = Grid(0.5 * (first + 7), 0.5 * first, 0.5, 290 - first, 293 - first)
        apart = np.abs(filled(height[part], known[part].copy(), grid) - found[part])
        assert apart[90:-90, 90:-90].max() < 1e-6


def test_without_returns_nothing_is_known() -> None:
    window = Box(0.0, 0.0, 10.0, 10.0)
    scene = make_scene(airborne(np.zeros((0, 3))), window, window, NO_DRIVE)
    assert len(scene.returns) == 0
    assert np.isnan(scene.ground.height_m).all() and not scene.ground.seen.any()


@pytest.mark.parametrize("method", ["morphological", "planes"])
def test_one_return_is_a_scene(method: str) -> None:
    window = Box(0.0, 0.0, 10.0, 10.0)
    settings = GroundSettings.parse({"method": method})
    scene = make_scene(airborne(np.array([[5.0, 5.0, 3.0]])), window, window, NO_DRIVE, settings)
    assert scene.classes.shape == (1,)


@pytest.mark.parametrize("radius", [1, 4, 11, 40])
def test_an_opening_is_that_of_opencv(radius: int) -> None:
    """The same heights to the bit, also by a disk that is larger than the surface."""
    surface = np.random.default_rng(radius).normal(size=(33, 47)).astype(np.float32)
    away = np.arange(-radius, radius + 1)
    disk = (away[:, None] ** 2 + away**2 <= radius * radius).astype(np.uint8)
    assert (opened(surface, radius) == cv2.dilate(cv2.erode(surface, disk), disk)).all()


def test_the_lower_face_of_a_deck_is_no_ground_and_a_bank_is() -> None:
    """A sensor 2 m above the road sees a deck 5.3 m above it from below, and a bank of 1 : 2 as high from above."""
    grid = Grid(0.0, 0.0, 0.5, 40, 60)
    x, y = np.meshgrid(*grid.middles_m)
    is_deck = (y > 10.0) & (x > 12.0)
    height = np.where(is_deck, 5.3, np.where(y > 10.0, 0.0, 0.5 * np.maximum(x - 6.0, 0.0)))
    sensor = np.tile([0.0, 10.0, 2.0], (x.size, 1))
    seen = returns_of(np.stack([x, y, height], axis=-1).reshape(-1, 3), np.ones(x.size), np.arange(x.size), sensor)
    lowest = height.astype(np.float32)
    found = undersides(seen, grid, lowest, lowest)
    assert found[(y > 12.0) & (x > 14.0)].all()
    assert not found[(y < 8.5) | (x < 10.5)].any()
