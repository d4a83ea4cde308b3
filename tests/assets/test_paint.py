"""Lane lines and markings: on a labelled recording, and on simulated streets that are known."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pytest
import shapely

from roadscan.assets.intensity import calibrated_scene, gains_of, intensity_sample
from roadscan.assets.kind import AssetObject, Evidence, asset_kinds
from roadscan.assets.paint.components import Component, Contrast
from roadscan.assets.paint.stripes import stripes_of
from roadscan.assets.scene import Box, Scene
from roadscan.simulate.scene import Scene as SimulatedScene
from tests.assets.simulated_streets import HALO_M, SimulatedStreet, faded, street, street_of

CELL_M = 0.1


def found(scene: Scene, kind: str) -> tuple[Evidence, list[AssetObject]]:
    one = asset_kinds()[kind]
    evidence = one.evidence(scene, one.options())
    return evidence, list(one.objects(evidence.pieces, one.options(), {}))


def f1_of_cells(scene: Scene, true: npt.NDArray[np.bool_], judged: npt.NDArray[np.bool_]) -> float:
    """F1 of cells of 0.1 m; a cell is paint where half of its returns are, in truth and as found."""
    marked = np.zeros(len(scene.returns), np.bool_)
    for kind in ("lane_line", "road_marking"):
        for some in found(scene, kind)[0].marked:
            marked[some.rows] = True
    place = np.stack([np.floor(v[judged] / CELL_M) for v in (scene.returns.x_m, scene.returns.y_m)])
    _, cell = np.unique(place, axis=1, return_inverse=True)
    count = np.bincount(cell.ravel())
    truth, detected = (np.bincount(cell.ravel(), weights=v[judged]) >= count / 2 for v in (true, marked))
    return float(2 * (truth & detected).sum() / (truth.sum() + detected.sum()))


@functools.cache
def calibrated(scene: Scene) -> Scene:
    return calibrated_scene(scene, gains_of([intensity_sample(scene)]))


def on_ground(scene: Scene) -> npt.NDArray[np.bool_]:
    return (np.abs(scene.above_ground_m) <= 0.1) & scene.tile.holds(scene.returns.x_m, scene.returns.y_m)


def along(one: SimulatedStreet, line: AssetObject) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Stations and offsets of the nodes of a line."""
    xy = shapely.get_coordinates(line.geometry) - np.array(one.scene.returns.corner_m)
    return one.station_offset_m(xy[:, 0], xy[:, 1])


def highway() -> SimulatedStreet:
    return street("highway_three_lanes", 60.0)


def bend() -> SimulatedStreet:
    """Lines of 100 m that bend with the road and rise with its superelevation."""
    return street("highway_three_lanes", 160.0, 100.0)


def town() -> SimulatedStreet:
    return street("urban_street", 100.0, 20.0)


@pytest.mark.nightly
def test_markings_of_a_long_bend() -> None:
    known = bend()
    scene = calibrated(known.scene)
    assert f1_of_cells(scene, known.on_paint, on_ground(scene)) >= 0.95  # 0.89 where lines are judged as a whole


@pytest.mark.slow
@pytest.mark.parametrize("one", [highway, pytest.param(town, marks=pytest.mark.nightly)])
def test_markings_of_simulated_streets(one: Callable[[], SimulatedStreet]) -> None:
    known = one()
    scene = calibrated(known.scene)
    assert f1_of_cells(scene, known.on_paint, on_ground(scene)) >= 0.95
    worn = faded(known, contrast=0.5, worn=0.3)
    scene = calibrated(worn.scene)
    assert f1_of_cells(scene, worn.on_paint, on_ground(scene)) >= 0.85


@pytest.mark.slow
def test_lines_of_the_highway_have_their_type_width_and_place() -> None:
    known = highway()
    lines = found(calibrated(known.scene), "lane_line")[1]
    expected = {-5.3: ("solid", 0.15), -1.8: ("dashed", 0.15), 1.8: ("dashed", 0.15), 5.3: ("solid", 0.30)}
    seen = {}
    for line in lines:
        _, offset = along(known, line)
        true = min(expected, key=lambda o: abs(o - offset.mean()))
        assert np.abs(offset - true).max() <= 0.03
        assert line.attributes["type"] == expected[true][0]
        assert abs(line.attributes["width_m"] - expected[true][1]) <= 0.01
        assert line.attributes["contrast"] > 2.0
        seen[true] = seen.get(true, 0.0) + line.attributes["length_m"]
    assert min(seen.values()) >= 30.0
    assert len(seen) == 4
    dashed = [line for line in lines if line.attributes["type"] == "dashed"]
    assert all(abs(line.attributes["dash_m"] - 3.0) <= 0.1 for line in dashed)
    assert all(abs(line.attributes["gap_m"] - 9.0) <= 0.1 for line in dashed)


@pytest.mark.slow
def test_two_lines_side_by_side_are_a_double_line() -> None:
    """The gaps between them are 10, 15 and 18 cm wide, as painted on roads, or 38 cm."""
    dashed = {"dash_m": 3.0, "gap_m": 6.0}
    markings = [
        {"offset_m": -0.10, "width_m": 0.10}, {"offset_m": 0.10, "width_m": 0.10},
        {"offset_m": -3.20, "width_m": 0.10}, {"offset_m": -3.45, "width_m": 0.10, **dashed},
        {"offset_m": 3.20, "width_m": 0.12, **dashed}, {"offset_m": 3.50, "width_m": 0.12, **dashed},
        {"offset_m": 5.00, "width_m": 0.12}, {"offset_m": 5.50, "width_m": 0.12},
    ]  # fmt: skip
    plain = SimulatedScene.load("highway_three_lanes")
    roadside = {kind: [] for kind in plain.roadside.model_dump()}
    known = street_of(plain.changed(road={"markings": markings}, roadside=roadside, passes=[{"lane": 2}]), 60.0)
    expected = {0.0: "double_solid", -3.325: "solid_dashed", 3.35: "double_dashed", 5.25: "double_solid"}
    scene, seen = calibrated(known.scene), set()
    for line in found(scene, "lane_line")[1]:
        _, offset = along(known, line)
        true = min(expected, key=lambda o: abs(o - offset.mean()))
        assert np.abs(offset - true).max() <= 0.03
        assert line.attributes["type"] == expected[true]
        assert abs(line.attributes["width_m"] - (0.10 if true < 1.0 else 0.12)) <= 0.01
        seen.add(true)
    assert len(seen) == 4
    assert {m.attributes["type"] for m in found(scene, "road_marking")[1]} <= {"raised_marker", "symbol"}


@pytest.mark.nightly
def test_markings_of_the_town_street_have_their_types() -> None:
    known = town()
    evidence = found(calibrated(known.scene), "road_marking")[1]
    types = {}
    for one in evidence:
        middle = one.geometry.centroid
        east, north = known.scene.returns.corner_m
        station, offset = known.station_offset_m(np.array([middle.x - east]), np.array([middle.y - north]))
        types[one.attributes["type"]] = (float(station[0]), float(offset[0]), one)
    station, _, walk = types["crosswalk"]
    assert abs(station - 100.0) <= 0.5
    assert abs(walk.attributes["area_m2"] - 20.0) <= 1.0
    station, offset, bar = types["stop_bar"]
    assert min(abs(station - 95.0) + abs(offset - 1.65), abs(station - 105.0) + abs(offset + 1.65)) <= 0.3
    assert abs(bar.attributes["width_m"] - 3.1) <= 0.2
    assert abs(bar.attributes["length_m"] - 0.5) <= 0.15


def test_lines_do_not_depend_on_where_tiles_are_cut() -> None:
    scene = calibrated(highway().scene)
    whole = found(scene, "lane_line")[1]
    halves = [half_of(scene, 0.0, 20.0), half_of(scene, 20.0, 40.0)]
    kind = asset_kinds()["lane_line"]
    pieces = [kind.evidence(half, kind.options()).pieces for half in halves]
    one, other = (list(kind.objects(pa.concat_tables(p), kind.options(), {})) for p in (pieces, pieces[::-1]))
    assert [line.geometry.wkb for line in one] == [line.geometry.wkb for line in other]
    assert len(one) == len(whole)
    for line, part in zip(one, whole, strict=True):
        assert line.attributes["type"] == part.attributes["type"]
        assert abs(line.attributes["width_m"] - part.attributes["width_m"]) <= 0.005
        assert shapely.hausdorff_distance(line.geometry, part.geometry) <= 0.25


def half_of(scene: Scene, x_min_m: float, x_max_m: float) -> Scene:
    """The scene of a tile that is narrower, with its halo."""
    tile = Box(x_min_m, 0.0, x_max_m, scene.tile.y_max_m)
    window = Box(x_min_m - HALO_M, -HALO_M, x_max_m + HALO_M, scene.tile.y_max_m + HALO_M)
    rows = window.holds(scene.returns.x_m, scene.returns.y_m)
    return replace(
        scene, returns=scene.returns.at(rows), tile=tile, window=window,
        above_ground_m=scene.above_ground_m[rows], classes=scene.classes[rows],
    )  # fmt: skip


def test_a_wide_patch_that_lies_askew_within_one_cut_is_no_band_and_ends() -> None:
    """Its diagonal is longer than a band in one piece may be, and no cut of the map crosses it."""
    x, y = (v.ravel() for v in np.meshgrid(np.arange(0.025, 5.0, 0.05), np.arange(0.025, 6.0, 0.05)))
    patch = np.abs(x * 0.7593 - y * 0.6508) < 0.6  # 1.2 m wide, along the diagonal
    x, y = x[patch], y[patch]
    every = np.arange(x.size)
    box = Box(0.0, 0.0, 10.0, 10.0)
    ground = Contrast(
        every, x, y, np.zeros(x.size), np.ones(x.size), np.full(x.size, 0.1), every // 50, every, box,
        np.zeros((200, 200), np.float32), np.full((200, 200), np.inf, np.float32),
    )  # fmt: skip
    whole = Component(every, x, y, every, np.ones(x.size, np.bool_), 9.0)

    class NoRoad:
        def at(self, x_m: float, y_m: float) -> float:
            return float("nan")

    assert not stripes_of(ground, whole, (0.0, 0.0), NoRoad())  # type: ignore[arg-type]
