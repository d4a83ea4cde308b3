"""The catalogue of a fleet: GeoParquet with a row a survey, and the same as STAC, made anew where it changed."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import shapely

from roadscan.core.errors import DamagedError
from roadscan.core.gpstime import iso_from_gps_ns
from roadscan.fleet.members import Found, surveys_in
from roadscan.fleet.row import Row, row_key, row_of
from roadscan.store.digest import bears_seal, check_seal, sealed_parquet, without_seal
from roadscan.store.schema import table_schema
from roadscan.store.store import opened_url, put_file

TABLE: Final = "fleet"
FOLDER: Final = "fleet"
"""Folder of the catalogue, within that of the surveys."""
_FILE: Final = "surveys.parquet"
_PAGE: Final = "index.html"
_STAC: Final = "1.1.0"


@dataclass(frozen=True)
class Catalogue:
    """A catalogue that was just made."""

    table: pa.Table
    file: str
    """Its file, or URL."""
    made: int
    """Rows that were made anew; the others are as they were."""
    unplaced: list[str]
    """Surveys that are no item of the STAC catalogue, for want of a place on the Earth or of an epoch."""


def make_catalogue(place: str) -> Catalogue:
    """Make the catalogue of a folder or bucket, and write it there.

    Raises
    ------
    ConfigError
        There is no such folder.
    StoreError
        It cannot be written.
    """
    from roadscan.fleet.row import fleet_page  # A question to a fleet draws no page.

    fs, base = opened_url(place)
    base = f"{base.rstrip('/')}/{FOLDER}"
    before = _rows_before(fs, f"{base}/{_FILE}")
    found = surveys_in(place)
    rows, made = [], 0
    for one in found:
        notes = doubled(found, one)
        kept = before.get(row_key(one, notes))
        made += kept is None
        rows.append(row_of(one, notes) if kept is None else kept)
    table = _table_of(rows)
    put_file(fs, f"{base}/{_FILE}", sealed_parquet(table, compression="zstd", version="2.6"))
    items = {str(row.values["survey"]): _item(row) for row in rows if _has_place(row)}
    for name, item in items.items():
        put_file(fs, f"{base}/items/{name}.json", _json(item))
    put_file(fs, f"{base}/collection.json", _json(_collection(rows, sorted(items))))
    put_file(fs, f"{base}/{_PAGE}", fleet_page(rows).encode())
    for path in fs.glob(f"{base}/items/*.json"):
        if path.rsplit("/", 1)[1].removesuffix(".json") not in items:
            fs.rm_file(path)
    return Catalogue(table, f"{base}/{_FILE}", made, [r.values["survey"] for r in rows if not _has_place(r)])


def read_catalogue(place: str) -> pa.Table | None:
    """Return the catalogue of a folder or bucket, None where there is none.

    Raises
    ------
    DamagedError
        Its bytes are not as they were written.
    """
    fs, base = opened_url(place)
    return _read(fs, f"{base.rstrip('/')}/{FOLDER}/{_FILE}")


def doubled(found: list[Found], one: Found) -> list[str]:
    """Return a note where other surveys have the same id: a query over all surveys cannot tell their rows apart."""
    same = Counter(other.id for other in found if other.store is not None)
    if one.store is None or same[one.id] < 2:
        return []
    others = [other.file or str(other.store and other.store.root) for other in found if other.id == one.id]
    return [f"{same[one.id]} surveys have the id '{one.id}': {', '.join(others)}"]


def _read(fs: Any, path: str) -> pa.Table | None:
    if not fs.exists(path):
        return None
    content = bytes(fs.cat_file(path))
    change = "remove it, and make the catalogue again with `roadscan fleet`"
    try:
        if not bears_seal(content):
            raise ValueError("it bears no seal")
        check_seal(content)
        return without_seal(pq.ParquetFile(pa.BufferReader(content)).read(use_threads=False))
    except (pa.ArrowException, OSError, ValueError) as error:
        raise DamagedError(f"the catalogue is damaged: {error}", change=change, file=path) from error


def _rows_before(fs: Any, path: str) -> dict[str, Row]:
    """Return the rows that the catalogue has by now, by their keys; none where it is damaged: all are made again."""
    try:
        table = _read(fs, path)
    except DamagedError:
        return {}
    if table is None:
        return {}
    rows = {}
    for values in table.to_pylist():
        geometry = values.pop("geometry", None)
        rows[str(values["key"])] = Row(values, None if geometry is None else shapely.from_wkb(geometry))
    return rows


def _table_of(rows: list[Row]) -> pa.Table:
    """Return the rows as GeoParquet 1.1, in longitude and latitude."""
    schema = table_schema(TABLE)
    ordered = sorted(rows, key=lambda row: [row.values[name] for name in schema.sort])
    full = [{c.name: row.values.get(c.name) for c in schema.columns} for row in ordered]
    table = pa.Table.from_pylist(full, schema.arrow())
    places = np.array([row.place for row in ordered], dtype=object)
    table = table.append_column("geometry", pa.array(shapely.to_wkb(places), pa.binary()))
    column: dict[str, Any] = {
        "encoding": "WKB",
        "geometry_types": ["Polygon"],
        "orientation": "counterclockwise",
    }  # without a CRS it is longitude and latitude in WGS 84
    if any(place is not None for place in places):
        column["bbox"] = [float(v) for v in shapely.total_bounds(places)]
    about = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": column}}
    return table.replace_schema_metadata({"geo": json.dumps(about, sort_keys=True)})


def _has_place(row: Row) -> bool:
    return row.place is not None and row.values.get("first_epoch_gps_ns") is not None


def _item(row: Row) -> dict[str, Any]:
    values, place = row.values, row.place
    bounds = [] if place is None else [round(v, 8) for v in place.bounds]
    columns = ("state", "version", "rig", "driven_km", "lane_km", "mri_m_per_km", "sigma_down_m", "sigma_horizontal_m")
    links = [{"rel": rel, "href": "../collection.json", "type": "application/json"} for rel in _UP]
    return {
        "type": "Feature", "stac_version": _STAC, "stac_extensions": [], "id": values["survey"],
        "geometry": json.loads(shapely.to_geojson(place)), "bbox": bounds,
        "properties": {
            "title": values["title"] or values["survey"], "datetime": None,
            "start_datetime": _instant(values["first_epoch_gps_ns"]),
            "end_datetime": _instant(values["last_epoch_gps_ns"]),
            **{f"roadscan:{name}": values.get(name) for name in columns},
        },
        "collection": _ID, "links": links,
        "assets": {"store": {"href": values["store"], "title": "Store of the survey", "roles": ["data"]}},
    }  # fmt: skip


_ID: Final = "roadscan-fleet"
_UP: Final = ("root", "parent", "collection")


def _collection(rows: list[Row], names: list[str]) -> dict[str, Any]:
    placed = [row for row in rows if _has_place(row)]
    boxes = [row.place.bounds for row in placed if row.place is not None]
    whole = [f([b[i] for b in boxes]) for i, f in enumerate((min, min, max, max))] if boxes else [-180, -90, 180, 90]
    spans = [[_instant(row.values[f"{end}_epoch_gps_ns"]) for end in ("first", "last")] for row in placed]
    first, last = (min(s[0] for s in spans), max(s[1] for s in spans)) if spans else (None, None)
    links = [{"rel": "root", "href": "./collection.json", "type": "application/json"}]
    links += [{"rel": "item", "href": f"./items/{name}.json", "type": "application/geo+json"} for name in names]
    return {
        "type": "Collection", "stac_version": _STAC, "stac_extensions": [], "id": _ID, "title": "Road surveys",
        "description": "Road surveys of a fleet, one item each.", "license": "other",
        "extent": {"spatial": {"bbox": [whole]}, "temporal": {"interval": [[first, last]]}},
        "links": links,
        "assets": {
            "surveys": {
                "href": f"./{_FILE}", "type": "application/vnd.apache.parquet", "roles": ["metadata"],
                "title": "The same as GeoParquet",
            }
        },
    }  # fmt: skip


def _instant(epoch_gps_ns: int) -> str:
    return iso_from_gps_ns(epoch_gps_ns)


def _json(value: Any) -> bytes:
    return (json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()
