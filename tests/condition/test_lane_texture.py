"""Texture of lanes, patches that have lost stones and painted lines, against the road that readings were made of."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
import pytest
import shapely

from roadscan.compute.edges import painted_line, without_lines
from roadscan.condition.kernels.lane_texture import FIGURES, INTENSITY, SHARE, TEXTURE, texture_of_squares
from roadscan.condition.kernels.sampling import MOST_CELLS, Cells, CellTable, gather, mean_intensities
from roadscan.condition.lane_data import RavelledSection, TextureSquares, lane_lines, texture_squares
from roadscan.condition.on_lane.ravelling import lane_levels, ravelled_section
from roadscan.condition.profiles.tables import mean_profile_depth
from roadscan.condition.profiles.texture import texture_segments
from tests.condition.lane_cells import LaneOfCells

TEXTURE_OF = {"mpd_mm": 1.0}
PATCH = {"station_m": 7.0, "offset_m": 0.1, "length_m": 2.0, "width_m": 1.0}
TRUE = shapely.affinity.scale(shapely.Point(7.0, 0.1).buffer(1.0, 64), 1.0, 0.5)


def looked_through(road: LaneOfCells, cell_m: float = 0.005, readings: int = 1) -> RavelledSection:
    """The patches of a road."""
    squares = texture_squares(road.table(cell_m, readings), road.line, road.lane, (4.0, 10.0))
    return ravelled_section(squares, np.ones(squares.texture_mm.shape, bool))


@pytest.mark.parametrize(
    ("lost", "depth_m", "severity", "least", "cell_m"),
    [
        (0.3, 0.006, "high", 0.8, 0.01),
        pytest.param(0.06, 0.005, "low", 0.6, 0.005, marks=pytest.mark.nightly),
        pytest.param(0.2, 0.005, "moderate", 0.8, 0.005, marks=pytest.mark.nightly),
        pytest.param(0.4, 0.006, "high", 0.8, 0.005, marks=pytest.mark.nightly),
    ],
)
def test_a_place_that_has_lost_stones_is_found(
    lost: float, depth_m: float, severity: str, least: float, cell_m: float
) -> None:
    place = PATCH | {"lost_share": lost, "depth_m": depth_m}
    found = looked_through(LaneOfCells(texture=TEXTURE_OF, ravelling=[place]), cell_m)
    (patch,) = found.patches
    assert patch.outline.intersection(TRUE).area / patch.outline.union(TRUE).area >= least
    assert abs(patch.area_m2 - TRUE.area) <= min(2.0 * patch.sigma_area_m2, 0.25 * TRUE.area)
    assert patch.severity == severity
    assert patch.evidence == "texture and intensity"
    assert patch.contrast < 0.0
    assert patch.sigma_ratio < 0.1 * patch.ratio
    # A hole's mean depth is 8/15 of its greatest; those that overlap are one, and cells at their rims hold some of it.
    assert patch.loss_mm == pytest.approx(8 / 15 * 1e3 * depth_m * lost, rel=0.35)


NO_STONES_LOST: dict[str, Any] = {
    "stains": [{"station_m": 5.5, "offset_m": 0.4, "length_m": 1.5, "width_m": 0.8, "shade": 25.0}],
    "cracks": [{"points_m": [[4.0, -0.8], [9.0, 0.7]], "width_m": 0.008, "depth_m": 0.01}],
    "potholes": [{"station_m": 5.0, "offset_m": -0.4, "radius_m": 0.3, "depth_m": 0.04}],
    "ruts": [{"offset_m": 0.5, "width_m": 0.8, "depth_m": 0.025}],
    "patches": [{"station_m": 8.5, "offset_m": -0.4, "length_m": 1.5, "width_m": 0.8, "height_m": -0.008}],
}
"""A dark place, a crack, a hole, a rut and a sunk patch."""


@pytest.mark.parametrize(
    ("texture", "road", "cell_m"),
    [
        (TEXTURE_OF, NO_STONES_LOST, 0.01),
        pytest.param(TEXTURE_OF, NO_STONES_LOST, 0.005, marks=pytest.mark.nightly),
        pytest.param({"mpd_mm": 2.0, "grain_mm": 14.0}, {}, 0.005, marks=pytest.mark.nightly),
    ],
    ids=["other damage", "other damage, fine cells", "another texture"],
)
def test_nothing_is_found_where_no_stones_are_lost(
    texture: dict[str, float], road: dict[str, Any], cell_m: float
) -> None:
    found = looked_through(LaneOfCells(texture=texture, **road), cell_m)
    assert found.reason == ""
    assert found.share > 0.9
    assert found.patches == ()


@pytest.mark.slow
def test_where_most_has_lost_stones_the_lane_says_what_is_sound() -> None:
    """Stones are lost from border to border but for 0.6 m in the middle, along a section of 6 m: 70 % of it."""
    both = [PATCH | {"offset_m": o, "length_m": 12.0, "width_m": 0.7, "lost_share": 0.3, "depth_m": 0.006}
            for o in (-0.75, 0.65)]  # fmt: skip
    worn, sound, other = (
        texture_squares(road.table(0.01, 1), road.line, road.lane, (4.0, 10.0))
        for road in (
            LaneOfCells(texture=TEXTURE_OF, ravelling=both),
            LaneOfCells(texture=TEXTURE_OF),
            LaneOfCells(texture={"mpd_mm": 2.0, "grain_mm": 14.0}),
        )
    )
    inside = np.ones(worn.texture_mm.shape, bool)
    levels = lane_levels([(worn, inside), (sound, inside), (other, inside)])
    assert np.exp(levels[False].middle) == pytest.approx(np.median(sound.texture_mm), rel=0.01)
    found = ravelled_section(worn, inside, levels)
    known = {"sound": np.abs(worn.offset_m + 0.05) < 0.25, "worn": (np.abs(worn.offset_m + 0.05) > 0.5)}
    patches = shapely.union_all([patch.outline for patch in found.patches])
    for kind, columns in known.items():
        share = np.mean(
            [[patches.intersects(shapely.Point(s, o)) for o in worn.offset_m[columns]] for s in worn.station_m]
        )
        assert share >= 0.8 if kind == "worn" else share <= 0.1, kind
    assert all(patch.severity == "high" for patch in found.patches)
    assert ravelled_section(worn, inside).patches == ()  # by itself it is its own measure
    assert ravelled_section(sound, inside, levels).patches == ()
    # Coarser from border to border: another surface, or stones lost all over. It is told, and not measured.
    coarser = ravelled_section(other, inside, levels)
    assert coarser.patches == ()
    assert "times that of the lane" in coarser.remark
    half = TextureSquares(worn.station_m, worn.offset_m, *(
        np.where((worn.station_m < 5.5)[:, None], a, b)
        for a, b in ((getattr(sound, f.name), getattr(other, f.name)) for f in fields(sound)[2:])
    ))  # fmt: skip
    assert ravelled_section(half, inside, levels).patches == ()  # the other surface begins within the section


def test_coarse_cells_show_it_by_the_scatter_within_them() -> None:
    found = looked_through(LaneOfCells(texture=TEXTURE_OF, ravelling=[PATCH | {"lost_share": 0.3}]), 0.05, 64)
    (patch,) = found.patches
    assert patch.outline.intersection(TRUE).area / patch.outline.union(TRUE).area >= 0.6
    assert np.isnan(patch.loss_mm)


@pytest.mark.parametrize(
    ("texture", "cell_m", "readings", "share"),
    [
        ({"mpd_mm": 1.0}, 0.005, 4, 0.95),
        pytest.param({"mpd_mm": 0.6, "grain_mm": 14.0}, 0.005, 4, 1.0, marks=pytest.mark.nightly),
        pytest.param({"mpd_mm": 1.0}, 0.005, 1, 0.84, marks=pytest.mark.nightly),
        pytest.param({"mpd_mm": 1.0}, 0.01, 9, 0.8, marks=pytest.mark.nightly),
    ],
)
def test_mean_profile_depth_from_cells(texture: dict[str, float], cell_m: float, readings: int, share: float) -> None:
    road = LaneOfCells(width_m=0.8, texture=texture)
    table = road.table(cell_m, readings, (5.9, 8.3), noise_m=0.0)
    squares = texture_squares(table, road.line, road.lane, (6.0, 8.2))
    x = np.arange(6.0, 8.2, 0.0005)
    own = [road.surface.height_m(*road.surface.place(x, np.full(x.size, o))[:2]) for o in (-0.3, 0.0, 0.3)]
    true = np.mean([mean_profile_depth(texture_segments(x, height)).mpd_mm for height in own])
    assert np.nanmean(squares.mpd_mm) / true == pytest.approx(share, abs=0.05)
    rms = 1e3 * np.std([height - np.poly1d(np.polyfit(x, height, 3))(x) for height in own])
    assert np.nanmean(squares.texture_mm) == pytest.approx(rms, rel=0.15)


def test_figures_of_squares_and_windows_are_those_of_their_cells() -> None:
    """A tile of 20 × 20 cells: heights of two levels about a slope, intensities that rise to the east."""
    n, cell = 20, 0.01
    row, column = (a.ravel() for a in np.divmod(np.arange(n * n), n))
    height = 0.05 * cell * column + 0.001 * np.where((row + column) % 2, 1.0, -1.0)
    table = CellTable(
        np.zeros((1, 1), np.int32), np.zeros(2, np.int64), (n * np.arange(n + 1))[None].astype(np.int64),
        column.astype(np.int32), height, np.full(n * n, 3e-6, np.float32), np.full(n * n, 4, np.float32),
        column.astype(np.float32), np.ones(n * n, np.float32), np.full(2, cell), np.full(2, n, np.int64),
    )  # fmt: skip
    out, place = np.empty((1, FIGURES)), np.array([[0.1, 0.1, 1.0, 0.0]])
    texture_of_squares(table, place, 0.2, out)
    # Four readings: their variance is that about the mean, whose own was that over four; the slope is taken off.
    within = (3e-6 / 3 - (0.05 * cell) ** 2 / 12) * 0.75
    assert out[0, TEXTURE] == pytest.approx(np.sqrt(1e-6 * 25 / 22 + within), rel=0.01)
    assert out[0, SHARE] == pytest.approx(1.0)
    assert out[0, INTENSITY] == pytest.approx(9.5)
    room = Cells(*np.empty((6, MOST_CELLS)), np.empty(MOST_CELLS, np.int64))
    assert gather(table, place[0], 0.05, 0.05, 1, room) == 100
    assert sorted(room.at[:100]) == np.flatnonzero((abs(row - 9.5) < 5) & (abs(column - 9.5) < 5)).tolist()
    mean = np.empty(2)
    mean_intensities(table, np.array([[0.055, 0.1, 1.0, 0.0], [9.0, 9.0, 1.0, 0.0]]), 0.025, 0.05, mean)
    assert mean[0] == pytest.approx(5.0)
    assert np.isnan(mean[1])


def test_lines_beside_a_lane_are_where_they_are_painted() -> None:
    painted = [{"offset_m": -1.15, "width_m": 0.12}, {"offset_m": 0.95, "width_m": 0.15, "dash_m": 2.0, "gap_m": 2.0}]
    road = LaneOfCells(texture=TEXTURE_OF, markings=painted)
    seen = lane_lines(road.table(0.02, 1, beside_m=1.5), road.line, road.lane, (4.0, 10.0))
    left, right = (np.array([one == side for one in seen.side], bool) for side in ("left", "right"))
    assert seen.own_m[left] == pytest.approx(np.full(12, -1.15), abs=0.01)
    assert seen.width_m[left] == pytest.approx(np.full(12, 0.12), abs=0.03)
    assert 4 <= right.sum() <= 9
    assert seen.own_m[right] == pytest.approx(np.full(right.sum(), 0.95), abs=0.01)
    bare = LaneOfCells(texture=TEXTURE_OF)
    assert not lane_lines(bare.table(0.02, 1, beside_m=1.5), bare.line, bare.lane, (4.0, 10.0)).side


def test_of_two_lines_the_inner_one_is_that_of_the_lane() -> None:
    away = np.arange(0.5, 3.0, 0.025)
    grey = 70.0 + 100.0 * ((np.abs(away - 1.7) < 0.06) | (np.abs(away - 1.95) < 0.06))
    found = painted_line(grey, without_lines(grey[None], 0.025)[0], away)
    assert found is not None
    assert found.middle_m == pytest.approx(1.7, abs=0.01)
    assert painted_line(np.full(away.size, 70.0), np.full(away.size, 70.0), away) is None


@pytest.mark.slow
def test_a_rut_that_deepens_does_not_change_the_texture() -> None:
    """Cells of 50 mm: the slope of a rut's sides scatters their readings, and is no texture."""
    found = {}
    for depth_m in (0.0, 0.012, 0.025, 0.031):
        ruts = [{"offset_m": 0.0, "width_m": 0.8, "depth_m": depth_m}] if depth_m else []
        road = LaneOfCells(texture=TEXTURE_OF, ruts=ruts)
        squares = texture_squares(road.table(0.05, 25), road.line, road.lane, (4.0, 10.0))
        inside = np.abs(squares.offset_m) < 0.35
        found[depth_m] = float(np.nanmean(squares.texture_mm[:, inside]))
    assert found[0.012] == pytest.approx(found[0.0], rel=0.04)
    assert found[0.025] == pytest.approx(found[0.0], rel=0.1)  # 5 % is the stated σ
    assert found[0.031] == pytest.approx(found[0.025], rel=0.07)
