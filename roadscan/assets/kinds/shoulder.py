"""Shoulders: paved strips between the outermost lane line and the edge of the carriageway."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import scipy.ndimage
import shapely
from pydantic import Field

from roadscan.assets.edges.line_pieces import dense, ribbon
from roadscan.assets.edges.road_edges import FARTHEST_M, places_across
from roadscan.assets.kind import AssetKind, AssetObject, Evidence, KindOptions
from roadscan.assets.scene import Scene
from roadscan.compute.array_types import Float64
from roadscan.compute.arrays import way_along, without_holes

STATION_M = 1.0  # Distance of stations along an edge (m).
GAP_NODES = 6
"""Longest run of nodes between two dashes of a line that is bridged."""


class ShoulderOptions(KindOptions):
    """Settings of shoulders."""

    least_width_m: float = Field(default=0.5, gt=0.0)
    """Narrower strips are left out (m)."""
    greatest_width_m: float = Field(default=5.0, gt=0.0)
    """Lines farther from the edge than this bound no shoulder (m)."""
    least_length_m: float = Field(default=10.0, gt=0.0)
    """Shorter ones are left out (m)."""


class Shoulder(AssetKind):
    """Shoulders: polygons between road edges and the lane lines nearest to them. They need no returns."""

    name: ClassVar[str] = "shoulder"
    title: ClassVar[str] = "shoulders: paved strips beyond the outer lane line"
    curve: ClassVar[str] = "products"
    """It is the product of the stated probabilities of its edge and of its line."""
    options: ClassVar[type[KindOptions]] = ShoulderOptions
    after: ClassVar[Sequence[str]] = ("lane_line", "road_edge")
    reach_m: ClassVar[float] = FARTHEST_M
    """An edge is sought from the drive, this far away at the most."""
    piece_schema: ClassVar[pa.Schema] = pa.schema(
        [pa.field(name, pa.float64(), nullable=False) for name in ("easting_m", "northing_m")]
    )

    def evidence(self, scene: Scene, options: Any) -> Evidence:
        """Returns one place in the tile where a road edge could lie: a mark that there may be a shoulder."""
        places = places_across(scene)
        marks = places[scene.tile.holds(*places.T)][:1] + scene.returns.corner_m
        return Evidence(pa.table([marks[:, 0], marks[:, 1]], schema=self.piece_schema))

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Yields a shoulder for each run of a road edge with a lane line inside it."""
        settings: ShoulderOptions = options
        lines = others.get("lane_line", ())
        if not lines:
            return
        tree = shapely.STRtree([shapely.force_2d(line.geometry) for line in lines])
        for edge in others.get("road_edge", ()):
            if edge.attributes.get("side") in {"left", "right"}:
                yield from _beside(edge, lines, tree, settings)


def _beside(
    edge: AssetObject, lines: Sequence[AssetObject], tree: shapely.STRtree, settings: ShoulderOptions
) -> Iterable[AssetObject]:
    """Yields shoulders along one edge."""
    inner, width, line_of = _widths(edge, lines, tree, settings.greatest_width_m)
    outer = _even(edge)
    good = np.isfinite(width)
    at = np.flatnonzero(good)
    if at.size < 2:
        return
    filled = np.column_stack([np.interp(np.arange(len(width)), at, inner[at, i]) for i in range(3)])
    level = np.interp(np.arange(len(width)), at, scipy.ndimage.median_filter(width[at], 5, mode="nearest"))
    wide = good & (level >= settings.least_width_m)
    number, count = scipy.ndimage.label(without_holes(wide, GAP_NODES))
    for k in range(1, count + 1):
        rows = np.flatnonzero(number == k)
        if len(rows) < 2 or (len(rows) - 1) * STATION_M < settings.least_length_m:
            continue
        polygon = ribbon(outer[rows], filled[rows])
        if polygon is None:
            continue
        fall = (filled[rows, 2] - outer[rows, 2]) / np.maximum(level[rows], 1e-6)
        touched = [lines[i] for i in sorted(set(line_of[rows][good[rows]].tolist()))]
        yield AssetObject(
            geometry=polygon,
            sigma_horizontal_m=edge.sigma_horizontal_m,
            sigma_height_m=edge.sigma_height_m,
            probability=edge.probability * max(one.probability for one in touched),
            returns=edge.returns,
            passes=edge.passes,
            first_epoch_gps_ns=edge.first_epoch_gps_ns,
            last_epoch_gps_ns=edge.last_epoch_gps_ns,
            attributes={
                "width_m": float(np.mean(level[rows])),
                "length_m": (len(rows) - 1) * STATION_M,
                "cross_slope": float(np.median(fall[good[rows]])),
            },
            sigma_size_m=math.hypot(edge.sigma_horizontal_m, max(one.sigma_horizontal_m for one in touched)),
        )


def _even(edge: AssetObject) -> Float64:
    """Returns points (n, 3) of an edge, about one a metre."""
    nodes = shapely.get_coordinates(edge.geometry, include_z=True)
    x, y = dense(nodes[:, :2], STATION_M)
    length = way_along(nodes)
    return np.column_stack([x, y, np.interp(np.linspace(0.0, length[-1], len(x)), length, nodes[:, 2])])


def _widths(
    edge: AssetObject, lines: Sequence[AssetObject], tree: shapely.STRtree, reach_m: float
) -> tuple[Float64, Float64, npt.NDArray[np.int64]]:
    """Nearest points (n, 3) of lane lines straight inside an edge's points, their distances, and lines' numbers."""
    outer = _even(edge)
    heading = np.gradient(outer[:, :2], axis=0)
    heading /= np.maximum(np.hypot(*heading.T), 1e-9)[:, None]
    inward = np.column_stack([-heading[:, 1], heading[:, 0]])
    if edge.attributes["side"] == "left":
        inward = -inward
    point, width = np.full((len(outer), 3), np.nan), np.full(len(outer), np.nan)
    line_of = np.full(len(outer), -1, np.int64)
    for i, (start, way) in enumerate(zip(outer[:, :2], inward, strict=True)):
        ray = shapely.LineString([start + 0.15 * way, start + reach_m * way])
        for j in sorted(tree.query(ray, predicate="intersects").tolist()):
            for x, y in shapely.get_coordinates(shapely.intersection(ray, shapely.force_2d(lines[j].geometry))):
                distance = float(np.hypot(x - start[0], y - start[1]))
                if np.isnan(width[i]) or distance < width[i]:
                    nodes = shapely.get_coordinates(lines[j].geometry, include_z=True)
                    nearest = int(np.argmin(np.hypot(nodes[:, 0] - x, nodes[:, 1] - y)))
                    width[i], line_of[i], point[i] = distance, j, (x, y, nodes[nearest, 2])
    return point, width, line_of
