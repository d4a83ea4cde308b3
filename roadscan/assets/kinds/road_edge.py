"""Road edges: the edges of the carriageway on both sides of the drives."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import pyarrow as pa
import shapely
from pydantic import Field

from roadscan.assets.edges.grey import with_pictured
from roadscan.assets.edges.line_pieces import Line, joined_lines
from roadscan.assets.edges.profiles import REACH_M
from roadscan.assets.edges.road_edges import STATION_PIECES, edge_lines, station_pieces
from roadscan.assets.green.edges import moved_to_green
from roadscan.assets.kind import AssetKind, AssetObject, Evidence
from roadscan.assets.scene import Scene
from roadscan.core.strict import Strict


class RoadEdgeOptions(Strict):
    """Settings of road edges."""

    least_length_m: float = Field(default=3.0, ge=1.0)
    """Shorter ones are left out (m)."""


class RoadEdge(AssetKind):
    """Road edges: lines in the direction of the drive, by what makes the edge."""

    name: ClassVar[str] = "road_edge"
    title: ClassVar[str] = "edges of the carriageway: kerbs, verges, barriers"
    curve: ClassVar[str] = "edges"
    options: ClassVar[type[Strict]] = RoadEdgeOptions
    reach_m: ClassVar[float] = REACH_M
    """A square tells of the stations in it, across which an edge is sought 14 m far, and of its kerbs."""
    piece_schema: ClassVar[pa.Schema] = STATION_PIECES

    def evidence(self, scene: Scene, options: Any) -> Evidence:
        """Returns what lies across the drives within the scene's tile, and the kerbs there."""
        return Evidence(station_pieces(scene))

    def joined(self, pieces: pa.Table) -> pa.Table:
        """Returns the edges along the drives."""
        return edge_lines(pieces)

    sees_green: ClassVar[bool] = True

    def with_pictures(self, pieces: pa.Table, shown: pa.Table) -> pa.Table:
        """Returns pieces whose verges begin where pictures show it."""
        return moved_to_green(pieces, shown)

    sees_grey_edges: ClassVar[bool] = True

    def with_grey_edges(self, pieces: pa.Table, edges: pa.Table) -> pa.Table:
        """Returns pieces with the edges that pictures show where returns show none."""
        return with_pictured(pieces, edges)

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Yields lines joined across tiles, an edge for each run of one type."""
        settings: RoadEdgeOptions = options
        for right in (False, True):
            side = [i for i, row in enumerate(pieces["right"].to_pylist()) if (row[0] > 0.5) == right]
            for line in joined_lines(pieces.take(pa.array(side, pa.int64()))):
                yield from _edges(line, right, settings.least_length_m)


def _edges(line: Line, right: bool, least_m: float) -> Iterable[AssetObject]:
    kerb, barrier = line.column("by_kerb") > 0.5, line.column("by_barrier") > 0.5
    other = np.where(line.column("by_surface") > 0.5, "surface", "verge")
    types = np.where(kerb, "kerb", np.where(barrier, "barrier", other)).tolist()
    runs = [(str(name), len(list(run))) for name, run in itertools.groupby(types)]
    merged: list[tuple[str, int]] = []
    for name, length in runs:
        short = length < 7 and merged
        if merged and (short or merged[-1][0] == name):
            merged[-1] = (merged[-1][0], merged[-1][1] + length)
        else:
            merged.append((name, length))
    begin = 0
    for name, length in merged:
        part = Line(line.nodes[begin : begin + length + 1], line.seen_by, line.names)
        begin += length
        if len(part.nodes) < 2 or part.length_m < least_m:
            continue
        evidence = float(np.mean(part.column("evidence")))
        yield AssetObject(
            geometry=shapely.LineString(part.nodes[:, :3]),
            sigma_horizontal_m=float(np.median(part.column("sigma_m"))),
            sigma_height_m=0.02,
            probability=float(np.clip(1.0 / (1.0 + math.exp(-(evidence - 0.4))), 0.05, 0.98)),
            returns=round(line.seen_by.returns * len(part.nodes) / len(line.nodes)),
            passes=len(line.seen_by.passes),
            first_epoch_gps_ns=line.seen_by.first_epoch_gps_ns,
            last_epoch_gps_ns=line.seen_by.last_epoch_gps_ns,
            attributes={"side": "right" if right else "left", "type": name, "length_m": part.length_m},
        )
