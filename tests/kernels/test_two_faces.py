"""Faces of a thing that was seen from both sides, in voxels that hold both: against the faces that were drawn."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from roadscan.assets.kernels.two_faces import ask_for_faces, gather_faces, part_faces
from roadscan.assets.kernels.upright_voxels import gather_moments, thin_elements

Float64 = npt.NDArray[np.float64]
LIMITS, SIDE_M, TURN = np.array([6.0, 0.12, 0.06, 0.35]), 0.25, np.cos(np.radians(20.0))
MIDDLE = np.array([6.1, 5.9])


def wall(turn_rad: float, thick_m: float, counts: tuple[int, int]) -> tuple[Float64, Float64, Float64]:
    """Returns of both faces of a wall 8 m long, 12 mm of scatter; the sensors that saw them; the unit vector across."""
    draw = np.random.default_rng(7)
    along, across = np.array([np.cos(turn_rad), np.sin(turn_rad)]), np.array([-np.sin(turn_rad), np.cos(turn_rad)])
    sign = np.repeat([1.0, -1.0], counts)
    t = draw.uniform(-4.0, 4.0, sign.size)
    d = sign * thick_m / 2 + draw.normal(0.0, 0.012, sign.size)
    place = MIDDLE + t[:, None] * along + d[:, None] * across
    sensor = MIDDLE + draw.uniform(-30.0, 30.0, sign.size)[:, None] * along + 4.0 * sign[:, None] * across
    return place, sensor, across


def parted(place: Float64, sensor: Float64) -> tuple[Float64, npt.NDArray[np.int32], npt.NDArray[np.int32], int]:
    """Elements, those of second faces, that of each return, and how many there were before."""
    (x, y), (sx, sy) = place.T.copy(), sensor.T.copy()
    index = np.full((1, 48, 48), -1, np.int32)
    moments, voxel = np.empty((len(x), 10)), np.empty(len(x), np.int32)
    above, corner = np.full(len(x), 0.2, np.float32), np.zeros(3)
    found = gather_moments(x, y, above, corner, np.array([SIDE_M, 0.5]), index, moments, voxel)
    elements, second = np.zeros((2 * found, 6)), np.full(found, -1, np.int32)
    before = thin_elements(index, moments, SIDE_M, LIMITS, elements)
    asked, normals = np.zeros(found, np.bool_), np.full((found, 2), np.nan)
    number = ask_for_faces(index, moments, SIDE_M, elements, asked, normals)
    assert number == asked.sum() and np.isfinite(normals[asked]).all()
    faces, face = np.zeros((2 * found, 6)), np.empty(len(x), np.int8)
    gather_faces(x, y, sx, sy, voxel, normals, corner, SIDE_M, moments, faces, face)
    told = np.isfinite(normals[:, 0])
    np.testing.assert_allclose((faces[::2] + faces[1::2])[told], moments[:found, :6][told], atol=1e-9)
    count = part_faces(index, asked, normals, faces, SIDE_M, LIMITS, TURN, elements, second)
    assert sorted(second[second >= 0].tolist()) == list(range(found, count))
    on_second = (face > 0) & (second[voxel] >= 0)
    voxel[on_second] = second[voxel[on_second]]
    return elements[:count], second, voxel, before


@pytest.mark.parametrize("thick_m", [0.2, 0.3, 0.4])
@pytest.mark.parametrize("turn_rad", [0.0, 0.3, 0.8, 1.5, 2.4])
def test_both_faces_of_a_wall_are_elements_where_they_are(turn_rad: float, thick_m: float) -> None:
    """A voxel and those beside it hold both. Those at the ends of the wall hold little, and are not looked at."""
    place, sensor, across = wall(turn_rad, thick_m, (3000, 3000))
    elements, _, element, _ = parted(place, sensor)
    along = np.array([across[1], -across[0]])
    thin = (elements[:, 0] > 0.0) & (np.abs((elements[:, 1:3] - MIDDLE) @ along) <= 3.5)
    d = (elements[:, 1:3] - MIDDLE) @ across
    assert np.abs(np.abs(d[thin]) - thick_m / 2).max() <= 0.03
    assert np.abs(elements[thin, 3:5] @ across).max() <= 0.1
    some = np.abs((place - MIDDLE) @ along) <= 3.2
    there = thin[element[some]]
    assert there.mean() >= 0.85
    assert np.mean(((place[some] - MIDDLE) @ across * d[element[some]])[there] > 0.0) >= 0.98


def test_a_face_stays_that_few_lines_from_the_other_side_hit_elsewhere() -> None:
    place, sensor, across = wall(0.5, 0.3, (3000, 12))
    elements, *_ = parted(place, sensor)
    d = (elements[elements[:, 0] > 0.0, 1:3] - MIDDLE) @ across
    assert d.size >= 30
    assert np.abs(d - 0.15).max() <= 0.03


def test_what_was_seen_from_one_side_alone_stays_as_it_is() -> None:
    place, sensor, across = wall(0.5, 0.3, (3000, 3000))
    sensor -= np.minimum((sensor - MIDDLE) @ across, 0.0)[:, None] * 2.0 * across
    elements, second, _, before = parted(place, sensor)
    assert (second < 0).all() and len(elements) == second.size
    assert (elements[:, 0] > 0.0).sum() == before


def test_leaves_that_were_seen_from_both_sides_are_no_faces() -> None:
    draw = np.random.default_rng(8)
    place = MIDDLE + draw.uniform(-1.0, 1.0, (6000, 2)) * [4.0, 0.4]
    sensor = MIDDLE + np.column_stack([draw.uniform(-30.0, 30.0, 6000), draw.choice([-4.0, 4.0], 6000)])
    elements, *_ = parted(place, sensor)
    assert (elements[:, 0] > 0.0).sum() <= 2
