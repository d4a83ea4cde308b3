"""Layer of control and check points with their residuals."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pyarrow as pa
import shapely

from roadscan.site import layer
from roadscan.site.layer import BLUE, RED, LayerKind, SiteLayer, Style, schema_columns
from roadscan.site.material import Material
from roadscan.store.readings.row_groups import read_groups

_STYLE = Style("Role", 9, by="role", values={"gcp": BLUE, "check": RED})  # marker size in pixels
_RESIDUALS_M = (-0.010, -0.003, 0.003, 0.010)
"""Limits of residuals (m): an adjusted survey reaches 3 mm; beyond 10 mm a point or a pass should be checked."""
_RESIDUAL_STYLES = [
    Style(f"Residual {title}, surveyed − measured (mm)", 9, by=column, limits=_RESIDUALS_M, shown_in=("mm", 1000.0),
          is_difference=True)
    for title, column in (("in height", "height_after_m"), ("to the east", "easting_after_m"),
                          ("to the north", "northing_after_m"))
]  # fmt: skip
_ARROWS = {
    "east": "easting_after_m", "north": "northing_after_m", "up": "height_after_m", "exaggeration": 1000,
}  # fmt: skip


class Control(LayerKind):
    """Points per run that measured them, with surveyed minus measured; before an adjustment only the points."""

    name = "control"

    def layers(self, material: Material) -> Iterator[SiteLayer]:
        """Yield one layer; none without surveyed points."""
        content = material.table("control_residuals")
        if content is not None and content.rows.num_rows:
            yield _layer(material, "control_residuals", content.rows, _ARROWS)
            return
        points = [
            read_groups(material.store, file.path, range(len(file.group_rows)))
            for record in material.plan.records
            for file in record.tables.get("control_points", ())
        ]
        if points and sum(rows.num_rows for rows in points):
            yield _layer(material, "control_points", pa.concat_tables(points), None)


def _layer(material: Material, table: str, rows: pa.Table, arrows: dict[str, Any] | None) -> SiteLayer:
    east, north = (rows.column(name).to_numpy() for name in ("easting_m", "northing_m"))
    columns = schema_columns(table, rows.column_names)
    shapes = np.asarray(shapely.points(east, north))
    return SiteLayer(
        "control", "Control and check points", "control", "point", 500, shapes, rows.to_pylist(), columns,
        [*_RESIDUAL_STYLES, _STYLE] if arrows else [_STYLE],
        key="name", label="name", arrows=arrows,
        evidence=[
            list(layer.of_passes(material, [row.get("epoch_gps_ns")], row["run"])) if row.get("run") else []
            for row in rows.to_pylist()
        ],
    )  # fmt: skip
