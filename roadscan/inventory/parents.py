"""Parents of assets: the nearest asset of the kinds on which the schema lets an asset stand or hang."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.store.asset_schema import asset_schema

_REACH_M: Final = 1.0
"""Greatest horizontal distance (m) of a point or line to its parent."""


class Placed(NamedTuple):
    """Assets of a kind with their places, in metres of the map."""

    ids: npt.NDArray[Any]
    shapes: npt.NDArray[Any]

    def without(self, ids: Sequence[str]) -> Placed:
        """Returns the same without some of them."""
        keep = ~np.isin(self.ids, ids)
        return Placed(self.ids[keep], self.shapes[keep])


def parents_of(kind: str, placed: Mapping[str, Placed]) -> list[str | None]:
    """Returns the id of the parent of each asset of a kind, None where none is within 1 m of it.

    The kind that the schema names first wins, then the nearest asset, then the lower id.
    with the lower id.
    """
    children = placed[kind]
    found: list[str | None] = [None] * len(children.ids)
    if not len(children.ids):
        return found
    points = shapely.force_2d(children.shapes)
    for name in asset_schema(kind).parents:
        parents = placed.get(name)
        open_rows = np.array([at for at, one in enumerate(found) if one is None], dtype=np.int64)
        if parents is None or not len(parents.ids) or not open_rows.size:
            continue
        there = shapely.force_2d(parents.shapes)
        left, right = shapely.STRtree(there).query(points[open_rows], predicate="dwithin", distance=_REACH_M)
        distance = shapely.distance(points[open_rows][left], there[right])
        order = np.lexsort((parents.ids[right], distance, left))
        first = np.flatnonzero(np.diff(left[order], prepend=-1))
        for at in order[first]:
            found[int(open_rows[left[at]])] = str(parents.ids[right[at]])
    return found
