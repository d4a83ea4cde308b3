"""Schemas of the tables of assets and distresses from ``schemas/assets/``: a file per kind, common columns."""

from __future__ import annotations

import functools
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias

import pyarrow as pa

from roadscan.core.errors import SchemaError, nearest
from roadscan.store.schema import schema_folders, table_schema

GeometryType: TypeAlias = Literal["PointZ", "LineStringZ", "PolygonZ", "MultiLineStringZ", "MultiPolygonZ"]

_TYPES: Final = {
    "bool": pa.bool_(),
    "date": pa.date32(),
    "float64": pa.float64(),
    "int32": pa.int32(),
    "int64": pa.int64(),
    "string": pa.string(),
}
_COMMON: Final = "common"
ASSET_FOLDER: Final = "products/assets"
"""Folder of the tables, relative to the survey's root: one file per table."""
_INVENTORY: Final = "inventory"


@dataclass(frozen=True)
class AssetColumn:
    """One column of a table of assets."""

    name: str
    type: str
    unit: str
    title: str
    """Label in forms and reports."""
    meaning: str
    frame: str = ""
    nullable: bool = False
    min: float | None = None
    max: float | None = None
    values: tuple[str, ...] = ()
    is_evidence: bool = False
    """It describes the evidence, not the asset: people do not change it, and its changes are not the asset's."""
    sigma_share: float = 0.0
    """1 σ of a measured value as a share of it, where that exceeds what follows from σ of the position."""
    class_of: str = ""
    """Column whose value selects from `values`: the first one whose limit in `up_to` is not exceeded."""
    up_to: tuple[float, ...] = ()
    """Limits of all values but the last, ascending."""

    def field(self) -> pa.Field:
        """Return the Arrow field of the column, with unit, frame and meaning as metadata."""
        metadata = {"unit": self.unit, "frame": self.frame, "meaning": self.meaning}
        return pa.field(self.name, _TYPES[self.type], nullable=self.nullable, metadata=metadata)


@dataclass(frozen=True)
class AssetSchema:
    """The table of a kind of assets."""

    kind: str
    table: str
    """Name of the table and of the layer."""
    title: str
    geometry: GeometryType
    meaning: str
    parents: tuple[str, ...]
    """Kinds that it may stand on or hang from."""
    found_in: str
    """Table of the store with the findings of a kind of distress; empty for kinds of the stage `assets`."""
    known_within_m: float | None
    """Distance within which outlines are one object if four σ are less; None: that of the inventory's settings."""
    own: tuple[AssetColumn, ...]
    common: tuple[AssetColumn, ...]

    @property
    def geometry_words(self) -> str:
        """Return the geometry type in the notation of GeoParquet and GDAL, such as ``Point Z``."""
        return f"{self.geometry.removesuffix('Z')} Z"

    @property
    def columns(self) -> tuple[AssetColumn, ...]:
        """Return the common columns, then those of the kind; `geometry` (WKB with heights) follows them."""
        return (*self.common, *self.own)

    def arrow(self) -> pa.Schema:
        """Return the Arrow schema of the found assets of the kind."""
        geometry = pa.field("geometry", pa.binary(), nullable=False, metadata={"meaning": f"WKB, {self.geometry}"})
        return pa.schema([c.field() for c in self.columns] + [geometry])


def asset_kind_names() -> list[str]:
    """Return the names of all kinds: those that the stage `assets` finds, then distresses of the pavement."""
    return sorted(set(_files()) - {_COMMON, _INVENTORY}, key=lambda name: ("found_in" in _read(name), name))


@functools.cache
def _files() -> dict[str, Path]:
    """Return the schema files by name of their kind: roadscan's, and those of packages that add kinds."""
    folders = [folder / "assets" for folder in reversed(schema_folders())]
    return {file.stem: file for folder in folders for file in sorted(folder.glob("*.toml"))}


@functools.cache
def asset_tables() -> dict[str, str]:
    """Return the kind of each table that the stage `assets` fills, by table name, in the order of the kinds."""
    schemas = [asset_schema(kind) for kind in asset_kind_names()]
    return dict(sorted((one.table, one.kind) for one in schemas if not one.found_in))


@functools.cache
def asset_schema(kind: str) -> AssetSchema:
    """Return the schema of a kind of assets.

    Raises
    ------
    SchemaError
        for an unknown kind.
    """
    names = asset_kind_names()
    if kind not in names:
        raise SchemaError(f"there is no kind of assets '{kind}'{nearest(kind, names)}", expected=", ".join(names))
    raw = _read(kind)
    return AssetSchema(
        kind, raw["table"], raw["title"], raw["geometry"], raw["meaning"], tuple(raw["parents"]),
        found_in=raw.get("found_in", ""), known_within_m=raw.get("known_within_m"),
        own=_columns(raw), common=_columns(_read(_COMMON)),
    )  # fmt: skip


@functools.cache
def inventory_columns() -> tuple[AssetColumn, ...]:
    """Return the columns that the inventory adds to the table of each kind."""
    return _columns(_read(_INVENTORY))


def _read(name: str) -> dict[str, Any]:
    return _parsed(_files()[name])


@functools.cache
def _parsed(file: Path) -> dict[str, Any]:
    with file.open("rb") as stream:
        return tomllib.load(stream)


def _columns(raw: dict[str, Any]) -> tuple[AssetColumn, ...]:
    lists = ("values", "up_to")
    return tuple(
        AssetColumn(**c | {name: tuple(c[name]) for name in lists if name in c}) for c in raw.get("columns", ())
    )


GEOMETRY: Final = "geometry"

EDITED_BY_PEOPLE: Final = frozenset(
    {"status", "condition", "comments", "parent", "valid_from", "valid_to", "road", "station_m", "offset_m", "lane"}
)
"""Columns of all kinds that people may change, beside the kind's specific columns and the geometry."""


@functools.cache
def kinds_by_table() -> dict[str, str]:
    """Return the kind of each table by name."""
    return {asset_schema(kind).table: kind for kind in asset_kind_names()}


@functools.cache
def asset_columns(kind: str) -> tuple[AssetColumn, ...]:
    """Return the columns of a kind's table without the geometry: the inventory's, the kind's, the common ones."""
    schema = asset_schema(kind)
    return (*inventory_columns(), *schema.own, *schema.common)


@functools.cache
def editable_columns(kind: str) -> frozenset[str]:
    """Return the columns of a kind that people may change, without the geometry and those about its evidence."""
    return EDITED_BY_PEOPLE | {c.name for c in asset_schema(kind).own if not c.is_evidence}


@functools.cache
def asset_table(kind: str) -> pa.Schema:
    """Return the Arrow schema of a kind's inventory table; all columns may be null, the geometry (WKB) is last."""
    fields = [c.field().with_nullable(True) for c in asset_columns(kind)]
    return pa.schema([*fields, pa.field(GEOMETRY, pa.binary())])


@functools.cache
def evidence_table() -> pa.Schema:
    """Return the Arrow schema of the table `assets_found`: its specific columns and those of all kinds."""
    fields = {field.name: field for field in table_schema("assets_found").arrow()}
    for kind in asset_kind_names():
        for field in asset_table(kind):
            fields.setdefault(field.name, field.remove_metadata())
    return pa.schema([fields.pop("commit"), *fields.values()])
