"""Differences between two states of the inventory."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias, overload

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from roadscan.core.crs import crs_from_text
from roadscan.core.errors import ConfigError, StoreError, nearest
from roadscan.inventory.state import Assets, State
from roadscan.inventory.values import encoded_column
from roadscan.store.asset_schema import GEOMETRY, asset_kind_names, asset_schema, asset_table
from roadscan.store.csv import write_csv

_OF_THE_EVIDENCE: Final = frozenset(
    {
        "asset_id", "object", "easting_m", "northing_m", "height_m", "sigma_horizontal_m", "sigma_height_m",
        "sigma_size_m", "probability", "returns", "passes", "first_epoch_gps_ns", "last_epoch_gps_ns", "pictures",
    }
)  # fmt: skip
"""Columns that describe the evidence alone, or follow from the geometry."""
_CHANGES: Final = {-1: "removed", -2: "added"}  # Codes of the column of a difference.
_AT_ONCE: Final = 8192
"""Differences that are turned into columns at a time."""

Ints: TypeAlias = npt.NDArray[np.int64]


class Difference(NamedTuple):
    """An asset that came or went, or one value that differs."""

    asset_id: str
    kind: str
    change: str
    """`added`, `removed` or `changed`."""
    attribute: str
    before: str | None
    """JSON; geometries as hexadecimal WKB."""
    after: str | None


class Differences(Sequence[Difference]):
    """All differences by kind, asset and attribute: stored as columns; rows are made on demand."""

    def __init__(self, parts: Iterable[_OfKind]) -> None:
        self._parts = [part for part in parts if part.asset.size]
        self._ends = np.cumsum([0, *(part.asset.size for part in self._parts)]).tolist()

    def __len__(self) -> int:
        return int(self._ends[-1])

    @overload
    def __getitem__(self, index: int) -> Difference: ...

    @overload
    def __getitem__(self, index: slice) -> list[Difference]: ...

    def __getitem__(self, index: int | slice) -> Difference | list[Difference]:
        if isinstance(index, slice):
            wanted = range(len(self))[index]
            return list(self._between(wanted.start, wanted.stop)) if wanted.step == 1 else [self[at] for at in wanted]
        at = range(len(self))[index]
        return next(self._between(at, at + 1))

    def __iter__(self) -> Iterator[Difference]:
        return self._between(0, len(self))

    def _between(self, first: int, last: int) -> Iterator[Difference]:
        for part, begin, end in zip(self._parts, self._ends, self._ends[1:], strict=False):
            for at in range(max(first, begin), min(last, end), _AT_ONCE):
                yield from part.rows(at - begin, min(at + _AT_ONCE, last, end) - begin)


def differences(before: State, after: State) -> Differences:
    """Returns all differences by kind, asset and attribute; rejected assets count as removed."""
    return Differences(
        _of_kind(kind, _shown(before.assets.get(kind), kind), _shown(after.assets.get(kind), kind))
        for kind in asset_kind_names()
    )


def _shown(assets: Assets | None, kind: str) -> pa.Table:
    if assets is None:
        return asset_table(kind).empty_table()
    return assets.rows.filter(pc.not_equal(assets.rows["status"], "rejected"))


class _OfKind(NamedTuple):
    """Differences (n,) of a kind."""

    kind: str
    ids: npt.NDArray[Any]
    """Ids of the assets of both states."""
    asset: Ints
    """Index of each difference's asset in `ids`; ascending."""
    column: Ints
    """Index of the attribute that differs, ascending within an asset; -1 for a removed asset, -2 for one that was
    added."""
    names: list[str]
    before: pa.Table
    after: pa.Table
    at_before: Ints
    """Row of each difference in the table before, where it has one."""
    at_after: Ints

    def rows(self, first: int, last: int) -> list[Difference]:
        """Returns the rows of some of the differences."""
        part = slice(first, last)
        columns, ids = self.column[part], self.ids[self.asset[part]].tolist()
        out: list[Any] = [None] * columns.size
        for column in np.unique(columns).tolist():
            own = np.flatnonzero(columns == column)
            if column < 0:
                for at in own.tolist():
                    out[at] = Difference(ids[at], self.kind, _CHANGES[column], "", None, None)
                continue
            name = self.names[column]
            was, is_ = (
                encoded_column(table[name].take(pa.array(rows[part][own])).to_pylist())
                for table, rows in ((self.before, self.at_before), (self.after, self.at_after))
            )
            for at, one, other in zip(own.tolist(), was, is_, strict=True):
                out[at] = Difference(ids[at], self.kind, "changed", name, one, other)
        return out


def _of_kind(kind: str, before: pa.Table, after: pa.Table) -> _OfKind:
    ids = [np.asarray(t["asset_id"].to_numpy(zero_copy_only=False), dtype=str) for t in (before, after)]
    both = np.union1d(*ids)
    # rows of the assets in each table, -1 where absent
    at = np.full((2, both.size), -1, np.int64)
    for number, own in enumerate(ids):
        at[number, np.searchsorted(both, own)] = np.arange(own.size)
    parts = [(np.flatnonzero(at[1] < 0), -1), (np.flatnonzero(at[0] < 0), -2)]
    held = np.flatnonzero((at >= 0).all(axis=0))
    names = sorted(set(before.column_names) - _OF_THE_EVIDENCE)
    if held.size:
        then, now = before.take(pa.array(at[0, held])), after.take(pa.array(at[1, held]))
        for column, name in enumerate(names):
            same = pc.fill_null(pc.equal(then[name], now[name]), False)
            both_null = pc.and_(pc.is_null(then[name]), pc.is_null(now[name]))
            parts.append((held[~np.asarray(pc.or_(same, both_null))], column))
    asset = np.concatenate([own for own, _ in parts])
    columns = np.repeat([column for _, column in parts], [own.size for own, _ in parts])
    order = np.argsort(asset, kind="stable")
    asset, columns = asset[order], columns[order]
    return _OfKind(kind, both, asset, columns, names, before, after, at[0, asset], at[1, asset])


def shown(difference: Difference) -> tuple[str, str]:
    """Returns both values as readable text; geometries by their first point."""
    import json

    import shapely

    def words(text: str | None) -> str:
        if text is None:
            return "–"
        value = json.loads(text)
        if difference.attribute == GEOMETRY:
            shape = shapely.from_wkb(bytes.fromhex(value))
            x, y, z = shapely.get_coordinates(shape, include_z=True)[0]
            return f"{shape.geom_type} {x:.3f} {y:.3f} {z:.3f}"
        return str(value)

    return words(difference.before), words(difference.after)


_FORMULA: Final = re.compile(r"^[=@+\-\t\r\n＝＋－＠]")
"""Texts that a spreadsheet may run, all that OWASP names (CSV Injection); a leading quote makes them text."""


def export(state: State, file: Path, form: str, crs: str | None) -> int:
    """Write a state without its rejected assets; returns the number of assets.

    Raises
    ------
    ConfigError
        where the form is unknown, or GeoJSON is asked of a local map.
    StoreError
        where the file cannot be written.
    """
    if form not in _WRITERS:
        raise ConfigError(f"--as {form}{nearest(form, _WRITERS)}", expected=", ".join(_WRITERS))
    kinds = {
        kind: state.assets[kind].rows.filter(pc.not_equal(state.assets[kind].rows["status"], "rejected"))
        for kind in asset_kind_names()
        if kind in state.assets
    }
    scratch = file.with_name(f".{os.getpid()}-{file.name}")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        _WRITERS[form](scratch, kinds, crs)
        scratch.replace(file)
    except OSError as error:
        raise StoreError(f"the file cannot be written: {error.strerror or error}", file=file) from error
    finally:
        scratch.unlink(missing_ok=True)
    return sum(rows.num_rows for rows in kinds.values())


def _gpkg(file: Path, kinds: dict[str, pa.Table], crs: str | None) -> None:
    import pyogrio

    for kind in asset_kind_names():
        schema = asset_schema(kind)
        pyogrio.write_arrow(
            kinds.get(kind, asset_table(kind).empty_table()), file, layer=schema.table, driver="GPKG", append=False,
            geometry_name=GEOMETRY, geometry_type=schema.geometry_words, crs=crs,
        )  # fmt: skip


def _geojson(file: Path, kinds: dict[str, pa.Table], crs: str | None) -> None:
    """Write all kinds in one collection, WGS 84 as RFC 7946 demands; columns keep the map's coordinates."""
    import pyogrio

    if crs is None:
        raise ConfigError(
            "the map has no CRS", expected="gpkg, csv or dxf", change="GeoJSON is in WGS 84 by its standard"
        )
    rows = _together(kinds)
    turn = _to_wgs84(crs)
    shapes = shapely.transform(_shapes(rows), turn, include_z=True)
    place = rows.schema.get_field_index(GEOMETRY)
    rows = rows.set_column(place, GEOMETRY, pa.array(shapely.to_wkb(shapes, flavor="iso"), pa.binary()))
    pyogrio.write_arrow(
        rows, file, driver="GeoJSON", append=False, geometry_name=GEOMETRY, geometry_type="Unknown", crs="EPSG:4326",
        layer_options={"RFC7946": "YES", "COORDINATE_PRECISION": "9"}, layer="assets",
    )  # fmt: skip


def _to_wgs84(crs: str) -> Callable[[Any], Any]:
    from pyproj import Transformer

    transformer = Transformer.from_crs(crs_from_text(crs).to_2d(), "EPSG:4326", always_xy=True)

    def turn(points: Any) -> Any:
        longitude, latitude = transformer.transform(points[:, 0], points[:, 1])
        return np.column_stack([longitude, latitude, points[:, 2]])

    return turn


def _csv(file: Path, kinds: dict[str, pa.Table], crs: str | None) -> None:
    """Write all kinds in one table, geometry as WKT; texts that a spreadsheet would run get a leading quote."""
    rows = _together(kinds)
    wkt = pa.array(shapely.to_wkt(_shapes(rows), rounding_precision=4), pa.string())
    rows = rows.set_column(rows.schema.get_field_index(GEOMETRY), GEOMETRY, wkt)
    for at, field in enumerate(rows.schema):
        if pa.types.is_string(field.type):
            rows = rows.set_column(
                at, field, pa.array([_harmless(v) for v in rows[field.name].to_pylist()], pa.string())
            )
    out = io.BytesIO()
    write_csv(rows, out)
    file.write_bytes(out.getvalue())


def _harmless(text: str | None) -> str | None:
    return f"'{text}" if text is not None and _FORMULA.match(text) else text


def _dxf(file: Path, kinds: dict[str, pa.Table], crs: str | None) -> None:
    """Geometries with their heights, a layer a kind."""
    import pyogrio

    layers = [asset_schema(kind).table for kind, rows in kinds.items() for _ in range(rows.num_rows)]
    shapes = _together(kinds)[GEOMETRY].to_numpy(zero_copy_only=False)
    pyogrio.raw.write(
        file, shapes, [np.array(layers, object)], ["Layer"], driver="DXF", layer="entities", crs=crs,
        geometry_type="Unknown",
    )  # fmt: skip


def _together(kinds: dict[str, pa.Table]) -> pa.Table:
    """Returns all kinds in one table with a column for the kind; columns that a kind lacks are null."""
    named = [
        rows.add_column(0, "kind", pa.array([kind] * rows.num_rows, pa.string())).replace_schema_metadata(None)
        for kind, rows in kinds.items()
    ]
    plain = [t.cast(pa.schema([f.remove_metadata() for f in t.schema])) for t in named]
    if not plain:
        return pa.table({"kind": pa.array([], pa.string()), GEOMETRY: pa.array([], pa.binary())})
    rows = pa.concat_tables(plain, promote_options="default")
    return rows.select([n for n in rows.column_names if n != GEOMETRY] + [GEOMETRY])


def _shapes(rows: pa.Table) -> Any:
    return np.asarray(shapely.from_wkb(rows[GEOMETRY].to_numpy(zero_copy_only=False)))


_WRITERS: Final[dict[str, Callable[[Path, dict[str, pa.Table], str | None], None]]] = {
    "gpkg": _gpkg, "geojson": _geojson, "csv": _csv, "dxf": _dxf,
}  # fmt: skip
