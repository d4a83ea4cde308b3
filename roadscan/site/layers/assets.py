"""Layers of the inventory, one per kind, or of the assets of the newest run where there is no inventory."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import cycle
from typing import Any, Final

import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from roadscan.inventory.homes.page_edits import LAYER
from roadscan.site import layer
from roadscan.site.layer import (
    BLUE,
    GOOD_TO_POOR,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    Geometry,
    LayerKind,
    SiteColumn,
    SiteLayer,
    Style,
    evidence_of_row,
)
from roadscan.site.material import Material
from roadscan.store.asset_schema import (
    GEOMETRY,
    AssetColumn,
    AssetSchema,
    asset_columns,
    asset_kind_names,
    asset_schema,
    editable_columns,
)

FOLDER: Final = "products/assets"
GEOMETRY_OF: Final[dict[str, Geometry]] = {
    "PointZ": "point", "LineStringZ": "line", "MultiLineStringZ": "line", "PolygonZ": "polygon",
    "MultiPolygonZ": "polygon",
}  # fmt: skip
"""Layer geometry by geometry of a schema."""
_WIDTH_PX: Final = {"point": 9, "line": 3, "polygon": 2}  # line widths and marker sizes
_COLOURS: Final = (BLUE, ORANGE, GREEN, RED, SKY, PURPLE)
_GRADES: Final = (GOOD_TO_POOR[0], GOOD_TO_POOR[2], GOOD_TO_POOR[4])  # colours of severities
_STATES: Final = {"found": BLUE, "confirmed": GREEN, "missing": RED, "rejected": GREY}

_Rows = tuple[pa.Table, npt.NDArray[Any]]


class Assets(LayerKind):
    """Objects beside, on and over the road, and distresses of the pavement of an inventory."""

    name = "assets"

    def layers(self, material: Material) -> Iterator[SiteLayer]:
        """Yield a layer for each kind with any object."""
        is_inventory = material.inventory is not None
        for place, (kind, colour) in enumerate(zip(asset_kind_names(), cycle(_COLOURS), strict=False)):
            content = _of_inventory(material, kind) if is_inventory else _found(material, kind)
            if content is not None and content[0].num_rows:
                order = (400 if asset_schema(kind).found_in else 600) + place
                yield _layer(material, kind, content, order, colour)


def _found(material: Material, kind: str) -> _Rows | None:
    """Return the rows of the newest run, whose tables are below `products/assets`."""
    path = f"{FOLDER}/{asset_schema(kind).table}.parquet"
    content = material.rows_of([r for r in material.session.manifest.all() if r.path == path])
    return None if content is None or content.shapes_m is None else (content.rows, content.shapes_m)


def _of_inventory(material: Material, kind: str) -> _Rows | None:
    """Return the rows of the inventory today, without those that people rejected; shapes in metres."""
    shown = material.inventory
    assets = None if shown is None else shown[1].assets.get(kind)
    if assets is None:
        return None
    keep = pc.not_equal(assets.rows["status"], "rejected")
    frame = material.context.map
    units_m = [frame.horizontal_unit_m, frame.horizontal_unit_m, frame.vertical_unit_m]
    shapes = assets.shapes[keep.to_numpy()]
    if units_m != [1.0, 1.0, 1.0]:
        shapes = shapely.transform(shapes, lambda places: places * units_m, include_z=True)
    return assets.rows.filter(keep).drop_columns([GEOMETRY]), shapes


def _layer(material: Material, kind: str, content: _Rows, order: int, colour: str) -> SiteLayer:
    schema, (rows, shapes_m) = asset_schema(kind), content
    is_inventory, geometry = "asset_id" in rows.column_names, GEOMETRY_OF[schema.geometry]
    columns = {c.name: c for c in (asset_columns(kind) if is_inventory else schema.columns)}
    names = [n for n in rows.column_names if n in columns]
    edited = editable_columns(kind) if is_inventory and material.wishes.edits else frozenset()
    width_px = 2 if schema.found_in else _WIDTH_PX[geometry]
    styles = list(_styles(schema, width_px)) or [Style("one colour", width_px, colour)]
    if is_inventory:
        styles.append(Style("Status", width_px, by="status", values=_STATES))
    return SiteLayer(
        f"{LAYER}{schema.table}", schema.title, "distress" if schema.found_in else "assets", geometry, order, shapes_m,
        rows.select(names).to_pylist(),
        [site_column(columns[n], names, is_edited=n in edited) for n in names], styles,
        key="asset_id" if is_inventory else "object",
        evidence=[_evidence(material, row) for row in rows.to_pylist()],
    )  # fmt: skip


def _evidence(material: Material, row: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the evidence for an asset: pictures, the passes of its first and last return, its place on the strips."""
    epochs = (row.get("first_epoch_gps_ns"), row.get("last_epoch_gps_ns"))
    return [*layer.of_pictures(material, row), *layer.of_passes(material, epochs), *evidence_of_row(row)]


def _styles(schema: AssetSchema, width_px: float) -> Iterator[Style]:
    """Yield styles of a distress: by its type and severity, and by the figures behind its severity."""
    for column in schema.own if schema.found_in else ():
        if column.values:
            colours = _GRADES if column.name == "severity" else _COLOURS
            yield Style(column.title, width_px, by=column.name, values=dict(zip(column.values, colours, strict=False)))
        if column.class_of:
            figure = next(c for c in schema.own if c.name == column.class_of)
            yield Style(f"{figure.title} ({figure.unit})", width_px, by=figure.name, limits=column.up_to)


def site_column(column: AssetColumn, names: Sequence[str], *, is_edited: bool) -> SiteColumn:
    """Return a column of assets for the page, with the one of `names` that is its 1 σ."""
    sigma = {"easting_m": "sigma_horizontal_m", "northing_m": "sigma_horizontal_m"}.get(
        column.name, f"sigma_{column.name}"
    )
    edited = (column.type, column.values) if is_edited else None
    return SiteColumn(column.name, column.unit, column.meaning, column.title, sigma if sigma in names else "", edited)
