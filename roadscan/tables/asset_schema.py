"""Schemas of the tables of assets, read from ``schemas/assets/``: one file a kind, and the columns that all have."""

from __future__ import annotations

import functools
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias

import pyarrow as pa

from roadscan.model.errors import SchemaError, nearest
from roadscan.tables.schema import schema_folders

GeometryType: TypeAlias = Literal["PointZ", "LineStringZ", "PolygonZ"]

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
"""Folder of the tables, relative to the survey's root: a file a table."""
_INVENTORY: Final = "inventory"


@dataclass(frozen=True)
class AssetColumn:
    """One column of a table of assets."""

    name: str
    type: str
    unit: str
    title: str
    """What people call it: the label in forms and reports."""
    meaning: str
    frame: str = ""
    nullable: bool = False
    min: float | None = None
    max: float | None = None
    values: tuple[str, ...] = ()
    is_evidence: bool = False
    """It tells of what was seen, not of the asset: people do not change it, and its changes are none of the asset."""

    def field(self) -> pa.Field:
        """The column as Arrow has it, with unit, frame and meaning as metadata."""
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
    own: tuple[AssetColumn, ...]
    common: tuple[AssetColumn, ...]

    @property
    def columns(self) -> tuple[AssetColumn, ...]:
        """Common columns, then those of the kind; the geometry, WKB with heights, stands after them as `geometry`."""
        return (*self.common, *self.own)

    def arrow(self) -> pa.Schema:
        """Arrow schema of the found assets of the kind."""
        geometry = pa.field("geometry", pa.binary(), nullable=False, metadata={"meaning": f"WKB, {self.geometry}"})
        return pa.schema([c.field() for c in self.columns] + [geometry])


def asset_kind_names() -> list[str]:
    """Names of all kinds of assets."""
    return sorted(set(_files()) - {_COMMON, _INVENTORY})


@functools.cache
def _files() -> dict[str, Path]:
    """Schema files by name of their kind: roadscan's own, and those of packages that add kinds."""
    folders = [folder / "assets" for folder in reversed(schema_folders())]
    return {file.stem: file for folder in folders for file in sorted(folder.glob("*.toml"))}


@functools.cache
def asset_tables() -> dict[str, str]:
    """Kind of assets by the name of its table, in the order of these."""
    return dict(sorted((asset_schema(kind).table, kind) for kind in asset_kind_names()))


@functools.cache
def asset_schema(kind: str) -> AssetSchema:
    """Schema of a kind of assets.

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
        own=_columns(raw), common=_columns(_read(_COMMON)),
    )  # fmt: skip


@functools.cache
def inventory_columns() -> tuple[AssetColumn, ...]:
    """Columns that the inventory adds to the table of each kind."""
    return _columns(_read(_INVENTORY))


def _read(name: str) -> dict[str, Any]:
    with _files()[name].open("rb") as stream:
        return tomllib.load(stream)


def _columns(raw: dict[str, Any]) -> tuple[AssetColumn, ...]:
    return tuple(AssetColumn(**{**c, "values": tuple(c.get("values", ()))}) for c in raw.get("columns", ()))
