"""A recorded city street for the tests of kerbs, with the city's polygons."""

from __future__ import annotations

import csv
import functools
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from roadscan.assets.scene import Returns

Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Street:
    """Returns, their labels (where there are any), and the drive (p, 4)."""

    returns: Returns
    labels: Array
    drive: Array


def returns_of(xyz: Array, intensity: Array, epoch: Array, sensor: Array, passes: Array | None = None) -> Returns:
    """Returns with what the finders of edges look at, in the order of place."""
    n = len(xyz)
    one = np.ones(n, np.uint8)
    return Returns(
        (0.0, 0.0), xyz[:, 0].copy(), xyz[:, 1].copy(), xyz[:, 2].copy(), intensity.astype(np.float32),
        epoch.astype(np.int64), (np.zeros(n) if passes is None else passes).astype(np.uint16), np.zeros(n, np.uint8),
        np.zeros(n, np.uint16), one, one, sensor[:, 0].copy(), sensor[:, 1].copy(), sensor[:, 2].copy(), ("lidar",),
    )  # fmt: skip


@functools.cache
def amsterdam_street(folder: Path, tile: str = "2293_9698") -> tuple[Street, dict[str, list[shapely.Polygon]]]:
    """A tile of 50 m of a city's cloud, which has no drive, and the city's polygons by name, from the tile's corner."""
    import laspy

    column, row = (int(v) for v in tile.split("_"))
    corner = np.array([column * 50.0, row * 50.0, 0.0])
    with laspy.open(io.BytesIO((folder / "pointcloud" / f"{tile}.laz").read_bytes())) as reader:
        las = reader.read()
    xyz = np.column_stack([las.x, las.y, las.z]) - corner
    sensor = np.full((len(xyz), 3), np.nan)
    epoch = np.asarray(las.gps_time) * 1e9
    street = Street(returns_of(xyz, np.asarray(las.intensity), epoch, sensor), np.zeros(len(xyz)), np.zeros((0, 4)))
    polygons: dict[str, list[shapely.Polygon]] = {}
    csv.field_size_limit(10**8)
    with (folder / "bgt" / f"{tile}.csv").open() as stream:
        for line in list(csv.reader(stream))[1:]:
            ring = np.array(json.loads(line[1])) - corner[:2]
            polygons.setdefault(line[0], []).append(shapely.Polygon(ring))
    return street, polygons
