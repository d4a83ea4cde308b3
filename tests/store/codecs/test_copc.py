"""COPC against laspy, and against copclib where it is installed."""

from __future__ import annotations

import datetime as dt
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

from roadscan.core.crs import MapFrame
from roadscan.core.errors import StoreError
from roadscan.site.cloud_file import Cube, NodeCutter
from roadscan.store.codecs import copc
from roadscan.store.codecs.copc import CopcWriter
from roadscan.store.codecs.las import Layout
from roadscan.tiles.products.las import picked

LAYOUT = Layout(6, (), (1e-4,) * 3, MapFrame("EPSG:32632"), "publish")
OFFSETS = (690_000.0, 5_334_000.0, 500.0)


def street(n: int) -> np.ndarray:
    """Profiles across a lane that runs north-east, as records."""
    rng = np.random.default_rng(3)
    records = np.zeros(n, LAYOUT.records)
    along, across = np.arange(n) // 200 * 0.02, np.arange(n) % 200 * 0.02 - 2.0
    height = 0.02 * across + rng.normal(0.0, 0.0005, n)
    for name, value in zip(
        "XYZ", (10 + 0.6 * along - 0.8 * across, 20 + 0.8 * along + 0.6 * across, height), strict=True
    ):
        records[name] = np.rint(value / 1e-4)
    records["intensity"] = rng.integers(100, 2000, n)
    records["gps_time"] = 1e8 + np.arange(n) // 200 * 1e-3
    records["bit_fields"], records["point_source_id"] = 0x11, 1 + (np.arange(n) > n // 2)
    return records


def written(path: Path, records: np.ndarray, leaf_points: int = 2000) -> Path:
    """A file of the records in one octree."""
    low, high = (tuple(int(f(records[a])) for a in "XYZ") for f in (np.min, np.max))
    cube = Cube.around(low, high, 1e9)
    nodes = NodeCutter(cube, leaf_points).nodes(records["X"], records["Y"], records["Z"])
    with CopcWriter(path, LAYOUT, OFFSETS, dt.date(2026, 5, 4)).begin(
        cube.corner, cube.edge, {"survey": "s"}
    ) as writer:
        for node in nodes:
            writer.add([(node.key, picked(records, node.points))])
    return path


def alike(one: Any, other: Any) -> bool:
    """True for the same records in whatever order."""
    names = list(one.dtype.names)
    return bool((np.sort(one, order=names) == np.sort(other, order=names)).all())


def test_laspy_reads_every_point_once(tmp_path: Path) -> None:
    records = street(20_000)
    path = written(tmp_path / "a.copc.laz", records)
    with laspy.CopcReader.open(path) as reader:
        points = reader.query()
        assert alike(points.array, records)
        few = reader.query(level=0)
        assert 0 < len(few) < 10_000
        box = laspy.copc.Bounds(np.array([690_010.0, 5_334_020.0]), np.array([690_010.5, 5_334_020.5]))
        near = reader.query(box)
    x, y = (records[a] * 1e-4 + o for a, o in zip("XY", OFFSETS, strict=False))
    inside = (x >= 690_010.0) & (x <= 690_010.5) & (y >= 5_334_020.0) & (y <= 5_334_020.5)
    assert len(near) == inside.sum()
    with laspy.open(path) as plain:  # a reader that knows LAZ alone
        header, points = plain.header, plain.read()
        assert alike(points.points.array, records)
    assert header.point_count == 20_000
    assert header.mins[2] == records["Z"].min() * 1e-4 + 500.0
    assert header.number_of_points_by_return[0] == 20_000
    assert header.parse_crs().to_2d().to_epsg() == 32632


def test_the_same_points_give_the_same_bytes(tmp_path: Path) -> None:
    one, other = (written(tmp_path / name, street(5000)).read_bytes() for name in ("a.copc.laz", "b.copc.laz"))
    assert one == other


def test_many_nodes_are_told_in_pages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(copc, "_PAGE_NODES", 20)
    monkeypatch.setattr(copc, "_PAGE_LEVEL", 2)
    records = street(20_000)
    path = written(tmp_path / "a.copc.laz", records, leaf_points=50)
    with laspy.CopcReader.open(path) as reader:
        assert alike(reader.query().array, records)
        assert reader.copc_info.hierarchy_root_size < 32 * len(reader.root_page.entries) + 1


def test_the_record_of_the_octree_comes_first(tmp_path: Path) -> None:
    content = written(tmp_path / "a.copc.laz", street(500)).read_bytes()
    assert content[375 + 2 : 375 + 6] == b"copc"  # after the header of LAS 1.4, and the two reserved bytes of a VLR
    assert int.from_bytes(content[375 + 18 : 375 + 20], "little") == 1
    assert int.from_bytes(content[375 + 20 : 375 + 22], "little") == 160
    assert content[104] & 63 == 6


def test_copclib_reads_it_and_makes_no_smaller_file(tmp_path: Path) -> None:
    copclib = pytest.importorskip("copclib", reason="copclib is not installed: its wheels are for few Pythons")
    records = street(40_000)
    path = written(tmp_path / "a.copc.laz", records)
    reader = copclib.FileReader(str(path))
    nodes = reader.GetAllNodes()
    assert sum(node.point_count for node in nodes) == 40_000 == reader.copc_config.las_header.point_count
    assert reader.ValidateSpatialBounds()
    writer = copclib.FileWriter(str(tmp_path / "b.copc.laz"), copclib.CopcConfigWriter(reader.copc_config))
    for node in nodes:
        writer.AddNode(node.key, reader.GetPointData(node))
    writer.Close()
    assert path.stat().st_size <= 1.05 * (tmp_path / "b.copc.laz").stat().st_size


def test_points_that_copc_does_not_hold_are_refused(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="point format 6 or 7"):
        CopcWriter(
            tmp_path / "a.copc.laz", Layout(3, (), (1e-4,) * 3, MapFrame("EPSG:32632"), "p"), OFFSETS, dt.date.min
        )


def test_a_node_is_not_written_twice(tmp_path: Path) -> None:
    records = street(200)
    with (
        pytest.raises(StoreError, match="twice"),
        CopcWriter(tmp_path / "a.copc.laz", LAYOUT, OFFSETS, dt.date(2026, 5, 4)).begin((0, 0, 0), 1, {}) as writer,
    ):
        writer.add([((0, 0, 0, 0), records), ((0, 0, 0, 0), records)])
