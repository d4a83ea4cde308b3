"""The inventory with 100,000 assets: publication, pull of 1,000 edits, difference of two dates, identity.

Where ROADSCAN_POSTGIS names a database, the same in its schema `bench_inventory`, which is dropped at the end.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyogrio
import shapely

from benchmarks.timing import Figure
from roadscan.inventory.found_distresses import Unknown
from roadscan.inventory.home import Home
from roadscan.inventory.homes.geopackage import GeoPackage
from roadscan.inventory.inventory import Inventory
from roadscan.inventory.of_survey import ADDRESS
from roadscan.inventory.recording import Found, Rules
from roadscan.store.asset_schema import asset_schema
from roadscan.store.asset_truth import AssetTruth
from roadscan.store.store import Store

COUNTS = {"pole": 40_000, "sign": 20_000, "tree": 15_000, "kerb": 10_000, "lane_line": 10_000, "sidewalk": 5_000}
EDITS = 1_000
CRS = "EPSG:32632"
EPOCH_GPS_NS = 1_461_749_400_000_000_000
YEAR_NS = 365 * 86_400_000_000_000
NODES = 10


def figures(folder: Path) -> Iterator[Figure]:
    """Two epochs, of which 1,000 values are edited between."""
    truth = AssetTruth(Store(str(folder / "store"), "bench"))
    home = GeoPackage(folder / "inventory.gpkg", CRS)
    inventory = Inventory(truth, home, "bench", Rules(Unknown()), crs=CRS)
    first, _ = _timed(lambda: inventory.record(found(0)))
    yield Figure("100,000 assets: taken in, all new", first, "s")
    seconds, _ = _timed(inventory.publish)
    yield Figure("GeoPackage: publish", seconds, "s", 15.0, "the bar")
    edit(home)
    seconds, pulled = _timed(lambda: inventory.pull(who="bench"))
    assert len(pulled.edits) == EDITS
    yield Figure("GeoPackage: pull of 1,000 edits", seconds, "s", 5.0, "the bar")
    seconds, found_differences = _timed(lambda: inventory.diff(1, 2))
    assert len(found_differences) == EDITS
    yield Figure("difference of two dates, 1,000 edits between", seconds, "s", 2.0, "the bar")
    again, _ = _timed(lambda: inventory.record(found(1)))
    yield Figure("100,000 assets: taken in, a year later", again, "s")
    seconds, _ = _timed(inventory.publish)
    yield Figure("GeoPackage: publish over the old one", seconds, "s", 15.0, "the bar")
    seconds, found_differences = _timed(lambda: inventory.diff(2, 3))
    yield Figure(f"difference of two dates, {len(found_differences):,} values differ", seconds, "s", 2.0, "the bar")
    seconds, _ = _timed(lambda: sum(d.change == "changed" for d in found_differences))
    yield Figure("all of these values read one by one", seconds, "s")
    if ADDRESS in os.environ:
        yield from postgis(inventory, os.environ[ADDRESS])


def postgis(inventory: Inventory, address: str) -> Iterator[Figure]:
    """The same state into a database."""
    import psycopg

    from roadscan.inventory.homes.postgis import PostGis

    home: Home = PostGis(address, "bench_inventory", 32632)
    inventory.home = home
    seconds, _ = _timed(inventory.publish)
    yield Figure("PostGIS: publish", seconds, "s", 20.0, "the bar")
    statement = "UPDATE bench_inventory.poles SET condition = 5 WHERE fid <= 1000"
    with psycopg.connect(address) as connection:
        connection.execute(statement)
    seconds, pulled = _timed(lambda: inventory.pull(who="bench"))
    assert pulled.edits
    yield Figure(f"PostGIS: pull of {len(pulled.edits):,} edits", seconds, "s")
    with psycopg.connect(address) as connection:
        connection.execute("DROP SCHEMA bench_inventory CASCADE")


def _timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds by the clock, and the result; the processor's share is printed, as other programs may be at work."""
    started, busy = time.perf_counter(), time.process_time()
    result = work()
    seconds, busy = time.perf_counter() - started, time.process_time() - busy
    print(f"{'':40}{busy:.2f} s of the next line's time is this process's own processor time")
    return seconds, result


def edit(home: GeoPackage) -> None:
    """Give 1,000 poles another condition, as a person would: through OGR."""
    frame = pyogrio.read_dataframe(home.file, layer="poles", fid_as_index=True)
    frame["condition"] = pd.array(np.where(np.arange(len(frame)) < EDITS, 3, pd.NA), dtype="Int32")
    pyogrio.write_dataframe(
        frame, home.file, layer="poles", driver="GPKG", append=False, geometry_type="Point Z",
        layer_options={"GEOMETRY_NAME": "geom"},
    )  # fmt: skip


def found(year: int) -> Found:
    """Assets along 400 km of road; their places differ by σ from year to year."""
    return Found(
        {kind: table(kind, count, year) for kind, count in COUNTS.items()}, f"year-{year}", "bench", f"y{year}"
    )


def table(kind: str, count: int, year: int) -> pa.Table:
    """Assets of a kind."""
    random = np.random.default_rng([year, count])
    place = np.column_stack([np.arange(count) * (400_000.0 / count), np.full(count, 5.0 + len(kind))])
    place += np.array([400_000.0, 5_300_000.0]) + random.normal(0, 0.02, (count, 2))
    height = 100.0 + 5.0 * np.sin(place[:, 0] / 500.0)
    shapes = _shapes(asset_schema(kind).geometry, place, height)
    values: dict[str, Any] = {
        "object": [f"{kind}-{year}-{n}" for n in range(count)], "easting_m": place[:, 0], "northing_m": place[:, 1],
        "height_m": height, "sigma_horizontal_m": np.full(count, 0.02), "sigma_height_m": np.full(count, 0.02),
        "probability": np.full(count, 0.9), "returns": np.full(count, 300), "passes": np.full(count, 2),
        "first_epoch_gps_ns": np.full(count, EPOCH_GPS_NS + year * YEAR_NS),
        "last_epoch_gps_ns": np.full(count, EPOCH_GPS_NS + year * YEAR_NS), "geometry": shapely.to_wkb(shapes),
    }  # fmt: skip
    sizes = np.random.default_rng(count).uniform(0.5, 2.0, count)
    values |= {c.name: sizes + random.normal(0, 0.01, count) for c in asset_schema(kind).own if c.unit == "m"}
    schema = asset_schema(kind).arrow()
    return pa.table([pa.array(values[f.name], f.type) if f.name in values else pa.nulls(count, f.type) for f in schema],
                    schema=schema)  # fmt: skip


def _shapes(geometry: str, place: Any, height: Any) -> Any:
    if geometry == "PointZ":
        return shapely.points(np.column_stack([place, height]))
    along = np.linspace(0.0, 30.0, NODES)
    if geometry == "LineStringZ":
        return shapely.linestrings([[(x + d, y, z) for d in along] for (x, y), z in zip(place, height, strict=True)])
    return shapely.polygons([
        [(x, y, z), (x + 30, y, z), (x + 30, y + 2, z), (x, y + 2, z), (x, y, z)]
        for (x, y), z in zip(place, height, strict=True)
    ])  # fmt: skip
