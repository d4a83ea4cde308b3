"""Streets with assets as the stage `assets` writes them, and inventories of them in a folder."""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import shapely

from roadscan.core.gpstime import gps_ns_from_utc
from roadscan.inventory.found_distresses import Unknown, Visibility
from roadscan.inventory.homes.geopackage import GeoPackage
from roadscan.inventory.inventory import Inventory
from roadscan.inventory.recording import Found, Rules
from roadscan.inventory.settings import Matching
from roadscan.store.asset_schema import asset_schema
from roadscan.store.asset_truth import AssetTruth
from roadscan.store.digest import bytes_digest
from roadscan.store.store import Store

CRS = "EPSG:32632"
EAST, NORTH = 691_000.0, 5_334_000.0
SPRING = dt.datetime(2026, 5, 4, 9, 30, tzinfo=dt.UTC)
AUTUMN = dt.datetime(2026, 10, 5, 9, 30, tzinfo=dt.UTC)


class Everywhere:
    """Every place was in sight of so many passes, but those near hidden ones."""

    def __init__(self, passes: int = 2, hidden: Iterable[tuple[float, float]] = ()) -> None:
        self.passes = passes
        self.hidden = list(hidden)

    def expected_passes(self, kind: str, places_m: Any) -> Any:
        out = np.full(len(places_m), self.passes, dtype=np.int64)
        for x, y in self.hidden:
            out[np.hypot(places_m[:, 0] - EAST - x, places_m[:, 1] - NORTH - y) < 0.5] = 0
        return out


def asset(kind: str, *places: tuple[float, float, float], when: dt.datetime = SPRING, **values: Any) -> dict[str, Any]:
    """A found asset at places from the corner of the street (m): one of a point, several of a line or outline."""
    points = [(EAST + x, NORTH + y, z) for x, y, z in places]
    geometry = asset_schema(kind).geometry
    shape = {"PointZ": lambda: shapely.Point(points[0]), "LineStringZ": lambda: shapely.LineString(points),
             "PolygonZ": lambda: shapely.Polygon(points), "MultiLineStringZ": lambda: shapely.MultiLineString([points]),
             "MultiPolygonZ": lambda: shapely.MultiPolygon([shapely.Polygon(points)])}[geometry]()  # fmt: skip
    row: dict[str, Any] = {c.name: None for c in asset_schema(kind).columns}
    first = gps_ns_from_utc(when)
    row |= {
        "object": f"{kind}-{bytes_digest(repr(points).encode())[-10:]}", "easting_m": points[0][0],
        "northing_m": points[0][1], "height_m": points[0][2], "sigma_horizontal_m": 0.02, "sigma_height_m": 0.02,
        "probability": 0.95, "returns": 250, "passes": 2, "first_epoch_gps_ns": first,
        "last_epoch_gps_ns": first + 60_000_000_000, "road": "main", "station_m": places[0][0],
        "offset_m": places[0][1], "geometry": shapely.to_wkb(shape),
    }  # fmt: skip
    return {"kind": kind, **row, **values}


def found(
    rows: Sequence[Mapping[str, Any]], epoch: str | None = None, kinds: Iterable[str] = ("pole", "sign")
) -> Found:
    """What a run found, as it hands it on."""
    tables = {}
    for kind in {*kinds, *(r["kind"] for r in rows)}:
        own = [{k: v for k, v in r.items() if k != "kind"} for r in rows if r["kind"] == kind]
        tables[kind] = pa.Table.from_pylist(own, asset_schema(kind).arrow())
    return Found(tables, bytes_digest(repr(sorted(map(repr, rows))).encode()), "street", epoch)


def poles(count: int = 6, step_m: float = 20.0, when: dt.datetime = SPRING, **values: Any) -> list[dict[str, Any]]:
    """Poles along the road."""
    return [
        asset(
            "pole",
            (step_m * n, 4.0, 100.0 + n),
            when=when,
            **{"asset_height_m": 5.0 + 0.1 * n, "diameter_m": 0.1} | values,
        )
        for n in range(count)
    ]


def inventory(
    folder: Path,
    visibility: Visibility | None = None,
    file: str = "inventory.gpkg",
    kinds: Sequence[str] | None = ("pole", "sign", "sidewalk"),
) -> Inventory:
    """The inventory of a folder with layers of some kinds, opened anew, as by another program."""
    truth = AssetTruth(Store(str(folder / "store"), "street"))
    rules = Rules(visibility or Unknown(), Matching())
    return Inventory(truth, GeoPackage(folder / file, CRS, kinds), "street", rules, crs=CRS)


def file_of(street: Inventory) -> Path:
    """The GeoPackage of a street."""
    assert isinstance(street.home, GeoPackage)
    return street.home.file


def ids_by_station(street: Inventory, kind: str = "pole") -> list[str]:
    """Ids along the road."""
    return list(street.assets(kind).sort_values("station_m")["asset_id"])
