"""Stations of a drive: each road once, also where a pass turns round, drives round, or stands."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial import cKDTree

from roadscan.assets.edges import road_edges
from roadscan.assets.edges.tracks import SAME_ROAD_M, tracks_of
from roadscan.compute.arrays import way_along

Float64 = npt.NDArray[np.float64]

STEP_M = 0.25
QUARTER = np.pi / 2.0


def driven(*parts: tuple[float, float]) -> Float64:
    """Places (n, 4) of a pass along parts of a length (m) and a radius (m; left turns positive, infinite: straight)."""
    steps = [np.full(round(length / STEP_M), length / round(length / STEP_M)) for length, _ in parts]
    bends = np.concatenate([step / radius for step, (_, radius) in zip(steps, parts, strict=True)])
    heading = 0.37 + np.cumsum(bends) - bends / 2.0
    way = np.cumsum(np.concatenate(steps)[:, None] * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    return np.column_stack([way, np.full(len(way), 102.0), np.ones(len(way))])


def length_m(drive: Float64) -> float:
    """Length of all tracks of a drive."""
    return sum(float(way_along(track.places)[-1]) for track in tracks_of(drive))


def turn(radius_m: float) -> Float64:
    """60 m there, a half turn, and 60 m back."""
    return driven((60.0, np.inf), (2.0 * QUARTER * radius_m, radius_m), (60.0, np.inf))


def block(laps: float) -> Float64:
    """Laps around a block of 62 by 42 m."""
    side = ((50.0, np.inf), (6.0 * QUARTER, 6.0), (30.0, np.inf), (6.0 * QUARTER, 6.0))
    return driven(*(side * 4)[: round(8 * laps)])


@pytest.mark.parametrize("radius_m", [1.75, 3.0])
def test_a_pass_that_drives_back_beside_itself_has_one_track(radius_m: float) -> None:
    assert length_m(turn(radius_m)) == pytest.approx(60.0 + 2.0 * QUARTER * radius_m, abs=5.0)


def test_a_loop_that_is_driven_once_and_a_half_has_the_stations_of_one_lap() -> None:
    assert length_m(block(1.5)) == pytest.approx(length_m(block(1.0)), abs=2.0)
    assert length_m(block(1.0)) == pytest.approx(160.0 + 24.0 * QUARTER, abs=2.0)


@pytest.mark.parametrize("radius_m", [4.5, 6.0])
def test_bends_and_hairpins_keep_their_stations(radius_m: float) -> None:
    """A hairpin whose legs are farther apart than the width of a road, and a right angle of the same radius."""
    assert 2.0 * radius_m > SAME_ROAD_M
    assert length_m(turn(radius_m)) == pytest.approx(120.0 + 2.0 * QUARTER * radius_m, abs=1.0)
    bend = driven((40.0, np.inf), (QUARTER * radius_m, -radius_m), (40.0, np.inf))
    assert length_m(bend) == pytest.approx(80.0 + QUARTER * radius_m, abs=1.0)


def test_a_drive_that_stands_makes_no_track() -> None:
    """It jitters by 3 cm, at the edge of a cell in which places of a drive are thinned."""
    draw, way = np.random.default_rng(2), driven((40.0, np.inf))
    still = np.repeat(way[-1:], 2000, axis=0) + np.pad(draw.normal(0.0, 0.03, (2000, 2)), ((0, 0), (0, 2)))
    on = way + np.pad(way[-1, :2], (0, 2)) * [1.0, 1.0, 0.0, 0.0]
    assert not list(tracks_of(still))
    (track,) = tracks_of(np.concatenate([way, still, on]))
    assert way_along(track.places)[-1] == pytest.approx(80.0, abs=1.0)
    assert np.abs(track.heading @ [-np.sin(0.37), np.cos(0.37)]).max() < 0.1
    slow = np.concatenate([way[:1] + share * (way[-1:] - way[:1]) for share in np.linspace(0.0, 1.0, 4000)])
    assert length_m(slow) == pytest.approx(40.0, abs=1.0)


@pytest.mark.parametrize(
    "drive", [turn(1.75), turn(3.0), block(1.5), driven((30.0, np.inf), (90.0, 9.0), (30.0, -25.0))]
)
def test_any_window_has_the_stations_of_the_whole_drive(drive: Float64) -> None:
    """Squares of 20 m, and 22 m of the drive around each: their stations are the same, wherever the drive leaves."""
    whole = np.concatenate([np.hstack([track.places, track.heading]) for track in tracks_of(drive)])
    draw, found = np.random.default_rng(5), 0
    for corner in draw.uniform(drive[:, :2].min(axis=0) - 10.0, drive[:, :2].max(axis=0) - 10.0, (30, 2)):
        within = (np.abs(drive[:, :2] - corner - 10.0) < 32.0).all(axis=1)
        parts = [np.hstack([track.places, track.heading]) for track in tracks_of(drive[within])]
        cut = np.concatenate([np.zeros((0, 4)), *parts])
        ours, others = (rows[(np.abs(rows[:, :2] - corner - 10.0) < 10.0).all(axis=1)] for rows in (cut, whole))
        assert len(ours) == len(others)
        if len(ours):
            assert cKDTree(ours).query(others)[0].max() < 1e-9
        found += len(ours)
    assert found > 100


def test_an_edge_is_the_same_in_blocks_of_any_length(monkeypatch: pytest.MonkeyPatch) -> None:
    draw = np.random.default_rng(1)
    up = draw.random((1500, 133)) < 0.002
    evidence = (240.0 * draw.random(up.shape) ** 6).astype(np.uint8)
    whole = road_edges._path(up, evidence)
    for block in (97, 700):
        monkeypatch.setattr(road_edges, "_BLOCK", block)
        cell, mean = road_edges._path(up, evidence)
        assert (cell == whole.cell).all()
        assert np.allclose(mean, whole.evidence, rtol=0.0, atol=1e-9)


def test_an_edge_bridges_holes_between_stations_that_show_it() -> None:
    """Holes of 9 m and of 11 m, a lone station, and ends; a chain of two stations that show it, and of one."""
    shown = np.repeat([0, 1, 0, 1, 0, 1, 0, 1, 0], [4, 6, 17, 6, 21, 6, 8, 1, 3]) > 0
    wanted = np.repeat([0, 1, 0, 1, 0], [4, 29, 21, 6, 12]) > 0
    lines = 0.5 * np.arange(shown.size)[:, None] * [0.6, 0.8]
    assert (road_edges._with_holes(shown, lines) == wanted).all()
    assert (road_edges._with_holes(shown[4:6], lines[:2]) == [True, True]).all()
    assert (road_edges._with_holes(shown[4:5], lines[:1]) == [False]).all()
