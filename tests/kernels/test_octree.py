"""Nodes of an octree against sets and dictionaries of plain Python."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.tiles.kernels.octree import (
    BITS,
    NODE_COLUMNS,
    SPAN_BITS,
    Shape,
    Steps,
    Tables,
    cut_cell,
    parts_of_edge,
)


def cut(steps: Steps, top: int, leaf_points: int) -> tuple[list[tuple[int, ...]], np.ndarray, Tables]:
    """Nodes of one cell, the order of the points, and the kernel's memory."""
    n = steps.x.size
    size = 1 << 3 * SPAN_BITS
    tables = Tables(np.full(size, -1, np.int32), np.empty(size, np.int64), np.empty(n, np.int32))
    order = np.arange(n, dtype=np.int32)
    rows = np.empty((n + top + 1, NODE_COLUMNS), np.int64)
    found = cut_cell(steps, order, 0, n, Shape(top, leaf_points), tables, rows)
    return [tuple(row) for row in rows[:found].tolist()], order, tables


def places(n: int, top: int) -> Steps:
    """Points on a rough surface in the last cell of the level `top`."""
    rng = np.random.default_rng(5)
    edge = 1 << (BITS - top)
    x, y = rng.integers(0, edge, (2, n))
    z = np.abs(rng.normal(edge / 3, edge / 1000, n)).astype(np.int64)
    return Steps(*((v + (1 << BITS) - edge).astype(np.int32) for v in (x, y, z)))


@pytest.mark.parametrize("top", [0, 3])
def test_every_point_lies_in_one_node_and_in_its_cube(top: int) -> None:
    steps = places(3000, top)
    nodes, order, tables = cut(steps, top, 300)
    assert sorted(order.tolist()) == list(range(3000))
    assert sum(node[5] for node in nodes) == 3000
    assert len({node[:4] for node in nodes}) == len(nodes)
    assert (tables.best == -1).all()
    for level, x, y, z, first, count in nodes:
        own = order[first : first + count]
        shift = BITS - level
        assert {(steps.x[p] >> shift, steps.y[p] >> shift, steps.z[p] >> shift) for p in own} <= {(x, y, z)}


def test_a_cut_node_holds_the_point_nearest_to_the_middle_of_each_voxel() -> None:
    steps = places(2000, 0)
    nodes, order, _ = cut(steps, 0, 100)
    level, _, _, _, first, count = nodes[0]
    assert level == 0
    size = 1 << (BITS - SPAN_BITS)
    nearest: dict[tuple[int, int, int], tuple[int, int]] = {}
    for number in range(2000):
        place = [int(axis[number]) for axis in steps]
        off = sum((2 * (v % size) + 1 - size) ** 2 for v in place)
        voxel = (place[0] // size, place[1] // size, place[2] // size)
        nearest[voxel] = min(nearest.get(voxel, (off, number)), (off, number))
    assert order[first : first + count].tolist() == sorted(number for _, number in nearest.values())


def test_points_at_one_place_end_in_one_leaf() -> None:
    one = np.full(50, 7, np.int32)
    nodes, order, _ = cut(Steps(one, one, one), 0, 10)
    assert sorted(order.tolist()) == list(range(50))
    assert nodes[-1][5] == 50 - (len(nodes) - 1)  # each level keeps one, the last one the rest


def test_parts_of_an_edge_are_those_of_whole_numbers() -> None:
    values = np.array([-5, -4, 0, 100, 994, 995], np.int32)
    expected = [min(((int(v) + 5) << BITS) // 1000, (1 << BITS) - 1) for v in values]
    assert parts_of_edge(values, -5, 1000).tolist() == expected
