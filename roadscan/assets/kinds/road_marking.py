"""Road markings that are no lane lines: stop bars, crosswalks, arrows, symbols."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Final

import numpy as np
import pyarrow as pa

from roadscan.assets.classes import MARKING
from roadscan.assets.kind import AssetKind, AssetObject, Evidence, Marked
from roadscan.assets.paint.detection import Patch, paint_of, rows_of_paint
from roadscan.assets.paint.markings import markings
from roadscan.assets.paint.patch_pieces import PATCH_PIECES, patch_pieces
from roadscan.assets.scene import Scene
from roadscan.assets.upright.places import places_of

_LARGE_M2: Final = 0.5  # Larger patches are not tested for a post (m²).
_STANDS_M: Final = (0.3, 1.5)  # Heights above the ground (m) between which a post is seen.
_LEAST_STANDING: Final = 5  # Least number of returns of a post.


def _at_foot(scene: Scene, patch: Patch) -> bool:
    """Returns whether a small patch is the foot of a post: something stands on it."""
    if patch.shape.area > _LARGE_M2:
        return False
    west, south, east, north = patch.shape.bounds
    reach = math.hypot(east - west, north - south) / 2
    rows = places_of(scene).within((west + east) / 2, (south + north) / 2, reach)
    above = scene.above_ground_m[rows]
    return int(np.count_nonzero((above > _STANDS_M[0]) & (above < _STANDS_M[1]))) >= _LEAST_STANDING


class RoadMarking(AssetKind):
    """A row for each marking: what it is, its size, and its contrast to the surface."""

    name = "road_marking"
    title = "road markings"
    curve = "products"
    piece_schema: ClassVar[pa.Schema] = PATCH_PIECES

    def evidence(self, scene: Scene, options: Any) -> Evidence:
        """Returns polygons of markings in the tile."""
        paint = paint_of(scene)
        paint = replace(paint, patches=tuple(p for p in paint.patches if not _at_foot(scene, p)))
        return Evidence(patch_pieces(scene, paint), (Marked(rows_of_paint(paint.contrast, paint.patches), MARKING),))

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Returns markings of the pieces of all tiles."""
        return markings(pieces)
