"""Road markings that are no lane lines: stop bars, crosswalks, arrows, symbols."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar

import pyarrow as pa

from roadscan.assets.classes import MARKING
from roadscan.assets.kind import AssetKind, AssetObject, Evidence, Marked
from roadscan.assets.paint.detection import paint_of, rows_of_paint
from roadscan.assets.paint.markings import markings
from roadscan.assets.paint.patch_pieces import PATCH_PIECES, patch_pieces
from roadscan.assets.scene import Scene


class RoadMarking(AssetKind):
    """A row for each marking: what it is, its size, and its contrast to the surface."""

    name = "road_marking"
    title = "road markings"
    piece_schema: ClassVar[pa.Schema] = PATCH_PIECES

    def evidence(self, scene: Scene, options: Any) -> Evidence:
        """Polygons of markings in the tile."""
        paint = paint_of(scene)
        return Evidence(patch_pieces(scene, paint), (Marked(rows_of_paint(paint.contrast, paint.patches), MARKING),))

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Markings of the pieces of all tiles."""
        return markings(pieces)
