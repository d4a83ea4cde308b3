"""Lane lines: paint along the road, joined over its gaps."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar, Final

import pyarrow as pa
from pydantic import Field

from roadscan.assets.classes import MARKING
from roadscan.assets.kind import AssetKind, AssetObject, Evidence, Marked
from roadscan.assets.paint.detection import paint_of, rows_of_paint
from roadscan.assets.paint.lane_lines import lane_lines
from roadscan.assets.paint.line_pieces import LINE_PIECES, line_pieces
from roadscan.assets.scene import Scene
from roadscan.core.strict import Strict

_LONGEST_GAP_M: Final = 15.0  # Default of the setting below (m).


class LaneLineOptions(Strict):
    """Settings of `lane_line`."""

    longest_gap_m: float = Field(default=_LONGEST_GAP_M, gt=0.0, le=50.0)
    """Longest gap between two dashes of a line (m)."""


class LaneLine(AssetKind):
    """A row for each painted line: its pattern, its width, and its contrast to the surface."""

    name = "lane_line"
    title = "lane lines"
    curve = "products"
    options = LaneLineOptions
    piece_schema: ClassVar[pa.Schema] = LINE_PIECES

    def evidence(self, scene: Scene, options: Any) -> Evidence:
        """Returns straight pieces of lines in the tile."""
        paint = paint_of(scene)
        marked = Marked(rows_of_paint(paint.contrast, paint.lines), MARKING)
        counts = {"dense_cells": paint.contrast.dense_cells, "rough_cells": paint.contrast.rough_cells}
        return Evidence(line_pieces(scene, paint), (marked,), counts)

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Returns lines of the pieces of all tiles."""
        return lane_lines(pieces, options.longest_gap_m)
