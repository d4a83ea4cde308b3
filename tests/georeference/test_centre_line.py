"""The centre-line buffer: against distances computed apart, and independent of what else is in the layer."""

from __future__ import annotations

import numpy as np
import shapely

from roadscan.georeference.plan.road import CentreLineBuffer

BOX = (0.0, 0.0, 10.0, 10.0)


def buffer(*lines: tuple[list[list[float]], float]) -> CentreLineBuffer:
    shapes = np.array([shapely.LineString(xy) for xy, _ in lines], dtype=object)
    return CentreLineBuffer(shapes, np.array([half for _, half in lines]))


def test_each_line_has_its_own_half_width() -> None:
    kept = buffer(([[-50, 2], [50, 2]], 1.0), ([[-50, 7], [50, 7]], 2.5))
    north = np.array([0.5, 1.5, 2.9, 3.5, 4.6, 9.4, 9.6])
    assert kept.keeps(np.full(7, 5.0), north, BOX).tolist() == [False, True, True, False, True, True, False]


def test_points_are_within_the_half_width_of_a_line() -> None:
    draw = np.random.default_rng(8)
    lines = [(draw.uniform(-10, 20, (4, 2)).tolist(), float(draw.uniform(0.2, 1.5))) for _ in range(6)]
    east, north = draw.uniform(0, 10, (2, 4000))
    distance = [shapely.distance(shapely.LineString(xy), shapely.points(east, north)) - half for xy, half in lines]
    nearest = np.min(distance, axis=0)
    sure = np.abs(nearest) > 0.005  # corners are rounded by chords
    kept = buffer(*lines).keeps(east, north, BOX)
    assert 0.1 < kept.mean() < 0.95
    assert np.array_equal(kept[sure], nearest[sure] < 0)


def test_far_lines_change_nothing_and_no_line_keeps_nothing() -> None:
    east, north = np.random.default_rng(9).uniform(0, 10, (2, 500))
    near = ([[0, 5], [10, 6]], 2.0)
    alone = buffer(near).keeps(east, north, BOX)
    among = buffer(([[500, 500], [600, 600]], 30.0), near, ([[-90, -90], [-80, -80]], 3.0))
    assert np.array_equal(among.keeps(east, north, BOX), alone)
    assert not buffer(([[500, 500], [600, 600]], 30.0)).keeps(east, north, BOX).any()
    assert buffer(([[0, 5], [10, 5]], 40.0)).keeps(east, north, BOX).all()
