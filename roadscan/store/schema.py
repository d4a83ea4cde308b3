"""Table schemas, read from ``schemas/``: the only place a column is defined."""

from __future__ import annotations

import functools
import tomllib
from dataclasses import dataclass
from importlib import resources
from importlib.metadata import entry_points
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from roadscan.core.errors import SchemaError, nearest

_TYPES: Final[dict[str, pa.DataType]] = {
    "int32": pa.int32(),
    "int64": pa.int64(),
    "uint8": pa.uint8(),
    "uint16": pa.uint16(),
    "uint32": pa.uint32(),
    "float32": pa.float32(),
    "float64": pa.float64(),
    "string": pa.string(),
}


ENTRY_POINT_GROUP: Final = "roadscan.schemas"
"""Entry points of packages that add tables: each names a package whose folder has the schema files."""


@dataclass(frozen=True)
class Column:
    """One column, as in `schemas/`."""

    name: str
    type: str
    unit: str
    meaning: str
    frame: str = ""
    nullable: bool = False
    variable: bool = False
    """A list whose length differs from row to row."""
    min: float | None = None
    max: float | None = None
    values: tuple[str, ...] = ()
    encoding: str = ""
    """Parquet encoding, where one measured better than the usual one of the type."""

    @property
    def is_list(self) -> bool:
        """Return True for a list of numbers per row."""
        return self.type.startswith("list<")

    def arrow_type(self, list_size: int | None) -> pa.DataType:
        """Return the Arrow type; fixed-size lists take their length from the log."""
        if not self.is_list:
            return _TYPES[self.type]
        inner = pa.field("element", _TYPES[self.type[5:-1]], nullable=False)
        if self.variable:
            return pa.list_(inner)
        if list_size is None:
            raise SchemaError(f"column '{self.name}' is a fixed-size list", expected="the number of readings a row")
        return pa.list_(inner, list_size)


@dataclass(frozen=True)
class TableSchema:
    """One table: its columns, order and partitioning."""

    name: str
    meaning: str
    columns: tuple[Column, ...]
    sort: tuple[str, ...]
    row_group_rows: int
    partition_s: int | None = None
    """Length of a partition of GPS time (s); None for tables that are not partitioned."""
    compression: str = "zstd"
    """Parquet codec of all columns."""
    holds: str = ""
    """Table whose rows its files hold in another form; empty for its own."""
    location: str | None = None
    """Folder of its Parquet files, relative to the survey's root; None for rows of logs, whose records name them."""

    @property
    def rows_of(self) -> str:
        """Return the table whose rows its files hold."""
        return self.holds or self.name

    def arrow(self, list_size: int | None = None) -> pa.Schema:
        """Return the Arrow schema, with unit, frame and meaning as field metadata."""
        if list_size not in self._made:
            fields = [
                pa.field(
                    c.name,
                    c.arrow_type(list_size),
                    nullable=c.nullable,
                    metadata={"unit": c.unit, "frame": c.frame, "meaning": c.meaning},
                )
                for c in self.columns
            ]
            self._made[list_size] = pa.schema(fields)
        return self._made[list_size]

    @functools.cached_property
    def _made(self) -> dict[int | None, pa.Schema]:
        """Return the Arrow schemas made so far, by size of lists: each row group that is read asks for one."""
        return {}

    def column(self, name: str) -> Column:
        """Return a column by name."""
        for one in self.columns:
            if one.name == name:
                return one
        names = [c.name for c in self.columns]
        raise SchemaError(f"table '{self.name}' has no column '{name}'{nearest(name, names)}")

    def conform(self, batch: pa.RecordBatch, list_size: int | None = None) -> pa.RecordBatch:
        """Return a batch with the schema's columns, order and types.

        Missing nullable columns become nulls. A missing required column, a column the schema
        does not know, or a type that cannot be cast without loss raises :class:`SchemaError`.
        """
        target = self.arrow(list_size)
        unknown = [n for n in batch.schema.names if n not in target.names]
        if unknown:
            raise SchemaError(
                f"column '{unknown[0]}' does not belong to table '{self.name}'{nearest(unknown[0], target.names)}",
                expected=", ".join(target.names),
            )
        if self.holds:  # what turns its rows into those of the other table comes with the batch
            target = target.with_metadata(batch.schema.metadata)
        arrays: list[pa.Array] = []
        for field in target:
            if field.name not in batch.schema.names:
                if not field.nullable:
                    raise SchemaError(f"table '{self.name}' needs the column '{field.name}' ({field.type})")
                arrays.append(pa.nulls(batch.num_rows, field.type))
                continue
            given = batch.column(field.name)
            try:
                arrays.append(given if given.type == field.type else given.cast(field.type))
            except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
                raise SchemaError(
                    f"column '{field.name}' of table '{self.name}' is {given.type}",
                    expected=str(field.type),
                    change=str(error).splitlines()[0],
                ) from error
        return pa.RecordBatch.from_arrays(arrays, schema=target)

    def faults(self, batch: pa.RecordBatch) -> list[tuple[npt.NDArray[np.int64], str]]:
        """Return the rows of a conforming batch that violate a column's rule: (row numbers, reason) per rule."""
        found: list[tuple[npt.NDArray[np.int64], str]] = []
        seen = np.zeros(batch.num_rows, dtype=bool)
        for c in self.columns:
            column = batch.column(c.name)
            for mask, reason in () if _is_sound(c, column) else _broken(c, column):
                fresh = mask & ~seen
                if fresh.any():
                    found.append((np.flatnonzero(fresh), reason))
                    seen |= fresh
        return found


def _is_sound(column: Column, array: pa.Array) -> bool:
    """Return True where the least and the greatest number of a column show that none breaks a rule."""
    if array.null_count or column.values or column.is_list or column.type == "string":
        return False
    if not len(array) or (column.min is None and column.max is None and not column.type.startswith("float")):
        return True
    values = array.to_numpy()
    low, high = values.min(), values.max()
    above, below = column.min is None or low >= column.min, column.max is None or high <= column.max
    return bool(np.isfinite(low) and np.isfinite(high) and above and below)


def _broken(column: Column, array: pa.Array) -> list[tuple[npt.NDArray[np.bool_], str]]:
    out: list[tuple[npt.NDArray[np.bool_], str]] = []
    missing = np.asarray(array.is_null())
    if not column.nullable and missing.any():
        out.append((missing, f"{column.name} is missing"))
    if column.values:
        known = np.asarray(pc.is_in(array, value_set=pa.array(column.values)))
        out.append((~known & ~missing, f"{column.name} is not one of {', '.join(column.values)}"))
    if column.is_list or column.type == "string":
        return out
    values = array.fill_null(0).to_numpy(zero_copy_only=False)
    if values.dtype.kind == "f":
        odd = ~np.isfinite(values)
        if odd.any():
            out.append((odd, f"{column.name} is not a finite number"))
    if column.min is not None:
        out.append(((values < column.min) & ~missing, f"{column.name} is below {column.min:g}"))
    if column.max is not None:
        out.append(((values > column.max) & ~missing, f"{column.name} is above {column.max:g}"))
    return out


def schema_folder() -> Path:
    """Return the folder of the schema files: inside the installed package, or beside it in a checkout."""
    installed = Path(str(resources.files("roadscan"))) / "schemas"
    return installed if installed.is_dir() else installed.parent.parent / "schemas"


def schema_folders() -> list[Path]:
    """Return that folder, and the schema folders of packages that add tables."""
    return [schema_folder(), *(Path(str(resources.files(e.value))) for e in entry_points(group=ENTRY_POINT_GROUP))]


def schema_names() -> list[str]:
    """Return the names of all tables."""
    return sorted(_schema_files())


@functools.cache
def _schema_files() -> dict[str, Path]:
    """Return the schema files by table name: roadscan's, and those of packages that add tables."""
    found: dict[str, Path] = {}
    for file in (file for folder in schema_folders() for file in sorted(folder.glob("*.toml"))):
        if file.stem in found:
            raise SchemaError(f"table '{file.stem}' is there twice: {found[file.stem]} and {file}")
        found[file.stem] = file
    return found


def table_locations() -> dict[str, str]:
    """Return the folder in the store of each table that a run makes.

    Reads no column: parsing all of them takes a tenth of a second.
    """
    found = {}
    for name in schema_names():
        head = _schema_files()[name].read_text(encoding="utf-8").partition("[[columns]]")[0]
        if "location" in (raw := tomllib.loads(head)):
            found[name] = str(raw["location"])
    return found


@functools.cache
def table_schema(name: str) -> TableSchema:
    """Return the schema of a table by name."""
    file = _schema_files().get(name)
    if file is None:
        raise SchemaError(f"there is no table '{name}'{nearest(name, schema_names())}")
    with file.open("rb") as stream:
        raw = tomllib.load(stream)
    columns = tuple(Column(**{**c, "values": tuple(c.get("values", ()))}) for c in raw["columns"])
    return TableSchema(
        name=name,
        meaning=raw["meaning"],
        columns=columns,
        sort=tuple(raw["sort"]),
        row_group_rows=raw["row_group_rows"],
        partition_s=raw.get("partition_s"),
        compression=raw.get("compression", "zstd"),
        holds=raw.get("holds", ""),
        location=raw.get("location"),
    )
