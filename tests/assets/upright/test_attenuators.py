"""Attenuators are boxes at the end of what they shield, and of nothing else."""

from __future__ import annotations

import pyarrow as pa
import pytest
import shapely

from roadscan.assets.kind import AssetObject, asset_kinds
from roadscan.assets.kinds.attenuator import PIECE_SCHEMA


def line(*xy: tuple[float, float]) -> AssetObject:
    return AssetObject(shapely.LineString([(x, y, 400.0) for x, y in xy]), 0.01, 0.01, 0.9, 100, 1, 0, 1)


@pytest.mark.parametrize(
    ("lines", "number"),
    [([], 0), ([line((0, 0), (3, 0))], 0), ([line((0, 0), (30, 0))], 1), ([line((0, 9), (30, 9))], 0)],
)
def test_a_box_counts_at_the_end_of_a_line(lines: list[AssetObject], number: int) -> None:
    ring = [[30.5, -0.4], [34.5, -0.4], [34.5, 0.4], [30.5, 0.4], [30.5, -0.4]]
    row = {
        "ring": ring, "ground_m": 400.0, "asset_height_m": 0.8, "length_m": 4.0, "width_m": 0.8, "returns": 500,
        "passes": [1], "first_epoch_gps_ns": 0, "last_epoch_gps_ns": 1,
    }  # fmt: skip
    kind = asset_kinds()["attenuator"]
    found = list(kind.objects(pa.Table.from_pylist([row], schema=PIECE_SCHEMA), kind.options(), {"guardrail": lines}))
    assert len(found) == number
    assert all(o.geometry.has_z and o.attributes["length_m"] == 4.0 and o.probability > 0.5 for o in found)
