"""A kind of assets for tests of the stage: upright posts, found as narrow columns of returns."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import shapely
from scipy import ndimage

from roadscan.assets import kind as registry
from roadscan.assets.classes import POLE
from roadscan.assets.kind import AssetKind, AssetObject, Evidence, Marked, asset_kinds
from roadscan.assets.scene import Scene
from roadscan.core.strict import Strict

CELL_M = 0.25


class PostOptions(Strict):
    """Settings of `pole`."""

    least_height_m: float = 1.5
    """Least extent of a column (m)."""


class Posts(AssetKind):
    """Columns of returns from near the ground to 1.5 m or more, with nothing around them."""

    name = "pole"
    title = "posts"
    options = PostOptions
    piece_schema = pa.schema(
        [("easting_m", pa.float64()), ("northing_m", pa.float64()), ("foot_m", pa.float64()), ("top_m", pa.float64()),
         ("returns", pa.int64()), ("first", pa.int64()), ("last", pa.int64())]
    )  # fmt: skip

    def evidence(self, scene: Scene, options: PostOptions) -> Evidence:
        r, above = scene.returns, scene.above_ground_m
        rows = np.flatnonzero((above > 0.4) & (above < 4.0))
        box = scene.window
        column = ((r.x_m[rows] - box.x_min_m) / CELL_M).astype(int)
        line = ((r.y_m[rows] - box.y_min_m) / CELL_M).astype(int)
        shape = (line.max(initial=0) + 1, column.max(initial=0) + 1)
        held = np.bincount(line * shape[1] + column, minlength=shape[0] * shape[1]).reshape(shape)
        number, count = ndimage.label(held > 0, np.ones((3, 3)))
        own = number[line, column] if rows.size else np.zeros(0, int)
        found, marked = [], []
        for one in range(1, count + 1):
            held = rows[own == one]
            x, y, z = r.x_m[held], r.y_m[held], above[held]
            wide = max(np.ptp(x), np.ptp(y))
            if held.size < 8 or wide > 0.6 or np.ptp(z) < options.least_height_m:
                continue
            place = float(np.median(x)), float(np.median(y))
            if not scene.tile.holds(*place):
                continue
            foot = float(scene.ground.height_at(*place))
            found.append(
                {"easting_m": r.corner_m[0] + place[0], "northing_m": r.corner_m[1] + place[1], "foot_m": foot,
                 "top_m": float(r.height_m[held].max()), "returns": held.size,
                 "first": int(r.epoch_gps_ns[held].min()), "last": int(r.epoch_gps_ns[held].max())}
            )  # fmt: skip
            marked.append(Marked(held, POLE))
        return Evidence(pa.Table.from_pylist(found, schema=self.piece_schema), tuple(marked))

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        for one in pieces.to_pylist():
            place = shapely.Point(one["easting_m"], one["northing_m"], one["foot_m"])
            yield AssetObject(
                place, 0.05, 0.03, 0.9, one["returns"], 1, one["first"], one["last"],
                {"asset_height_m": one["top_m"] - one["foot_m"]},
            )  # fmt: skip


@contextmanager
def only_kinds(*kinds: type[AssetKind]) -> Iterator[None]:
    """The registry with these kinds and no other."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "found_kinds", lambda *_: {one.name: one for one in kinds})
        asset_kinds.cache_clear()
        yield
    asset_kinds.cache_clear()
