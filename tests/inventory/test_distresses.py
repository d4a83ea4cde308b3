"""Distresses are kinds of the inventory: what people say of cracks and potholes survives what is found next."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import shapely

from roadscan.inventory.conflicts import conflicts_of
from roadscan.inventory.home import FaultyEditsError
from roadscan.inventory.homes.geopackage import GeoPackage
from roadscan.inventory.homes.page_edits import PageDocument
from roadscan.inventory.inventory import Inventory
from roadscan.inventory.state import State
from tests.inventory.edited_homes import InDatabase, InFile
from tests.inventory.postgres import server
from tests.inventory.streets import AUTUMN, CRS, EAST, NORTH, Everywhere, asset, found, inventory, poles

KINDS = ("crack", "pothole", "ravelling_patch")


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    pytest.importorskip("psycopg", reason="psycopg is not installed: `pip install 'roadscan[postgis]'`")
    with server() as running:
        yield running


@pytest.fixture(params=["geopackage", "postgis"])
def home(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[InFile | InDatabase]:
    """A home with all kinds that a test edits as a person would."""
    if request.param == "geopackage":
        yield InFile(tmp_path / "inventory.gpkg", CRS)
        return
    database = InDatabase(request.getfixturevalue("address"), "distress", 32632)
    yield database
    database.drop()


def crack(x: float, y: float, length_m: float = 3.0, **values: Any) -> dict[str, Any]:
    """A crack that winds along the road."""
    places = [(x + s * length_m / 6, y + (0.03 if s % 2 else 0.0), 100.0) for s in range(7)]
    figures = {"type": "longitudinal", "severity": "low", "length_m": length_m, "width_mean_m": 0.004}
    return asset("crack", *places, **{"sigma_horizontal_m": 0.01} | figures | values)


def pothole(x: float, y: float, size_m: float = 0.4, **values: Any) -> dict[str, Any]:
    corners = [(x, y), (x + size_m, y), (x + size_m, y + size_m), (x, y + size_m)]
    figures = {"severity": "moderate", "depth_max_m": 0.03, "area_m2": size_m**2}
    return asset("pothole", *[(e, n, 100.0) for e, n in corners], **{"sigma_horizontal_m": 0.01} | figures | values)


def street_of(tmp_path: Path, home: Any) -> Inventory:
    """The inventory of a street, opened anew."""
    made = inventory(tmp_path, Everywhere())
    made.home = home
    return made


def by_place(state: State, kind: str) -> list[dict[str, Any]]:
    """Rows of a kind from west to east and south to north, without those that were rejected."""
    own = state.assets.get(kind)
    rows = [] if own is None else [r for r in own.rows.to_pylist() if r["status"] != "rejected"]
    return sorted(rows, key=lambda r: (round(r["easting_m"]), r["northing_m"]))


@pytest.mark.slow
def test_edits_of_distresses_survive_reprocessing_and_a_new_epoch(home: Any, tmp_path: Path) -> None:
    street = street_of(tmp_path, home)
    shadow = crack(20.0, 0.0)
    first = [crack(0.0, 0.0), crack(0.0, 0.3), crack(10.0, 0.0), shadow, pothole(5.0, 1.0)]
    street.record(found(first, "spring", KINDS))
    street.publish()
    ids = [row["asset_id"] for row in by_place(street.state(), "crack")]
    place = {one: at for at, one in enumerate(home.shown("crack")["asset_id"].to_pylist())}
    home.edit("crack", place[ids[0]], severity="high", condition=2, comments="water comes through")
    home.edit("crack", place[ids[2]], type="transverse", length_m=4.5)
    home.delete("crack", place[ids[3]])
    drawn = shapely.Polygon([(EAST + x, NORTH + y, 100.0) for x, y in ((30, 1), (30.5, 1), (30.5, 1.4))])
    home.draw("pothole", shapely.to_wkb(drawn, flavor="iso"), comments="new")
    assert len(street.pull(who="eva").edits) == 8
    edited = street.state()
    assert street.pull().commit is None

    # Processed again: other ends, a shift of 2 cm, other numbers, and one that was whole is in two parts.
    again = [crack(0.02, 0.32, 2.9), crack(0.1, 0.02, 3.1), crack(10.0, 0.02, 2.2), crack(12.3, 0.02, 0.6),
             shadow | {"length_m": 2.9}, pothole(5.02, 1.01)]  # fmt: skip
    street.record(found(again, "spring", KINDS))
    street.publish()
    rows = {row["asset_id"]: row for row in by_place(street.state(), "crack")}
    assert set(ids[:3]) < set(rows) and ids[3] not in rows and len(rows) == 4
    assert rows[ids[1]]["northing_m"] == pytest.approx(NORTH + 0.335, abs=0.02)  # of two side by side each is itself
    own = rows[ids[0]]
    assert (own["severity"], own["condition"], own["comments"]) == ("high", 2, "water comes through")
    assert (rows[ids[2]]["type"], rows[ids[2]]["length_m"]) == ("transverse", 4.5)
    holes = by_place(street.state(), "pothole")
    assert [r["comments"] for r in holes] == [None, "new"]
    drawn_id = holes[1]["asset_id"]
    assert {(c.asset_id, c.attribute) for c in street.conflicts()} == set()  # it is as it was found before the edit
    told = {row["asset_id"]: row for row in home.shown("crack").to_pylist()}
    assert told[ids[0]]["comments"] == "water comes through" and ids[3] not in told

    # A new epoch: a crack has grown and turned, another one is sealed, and the drawn pothole is found.
    autumn = [crack(0.0, 0.0, 6.0, when=AUTUMN), crack(10.0, 0.0, 9.0, type="alligator", when=AUTUMN),
              pothole(5.0, 1.0, when=AUTUMN), pothole(30.05, 1.0, 0.45, when=AUTUMN)]  # fmt: skip
    street.record(found(autumn, "autumn", KINDS))
    street.publish()
    rows = {row["asset_id"]: row for row in by_place(street.state(), "crack")}
    assert rows[ids[1]]["status"] == "missing" and ids[3] not in rows
    assert rows[ids[2]]["type"] == "transverse"
    assert {(c.asset_id, c.attribute, c.reason) for c in street.conflicts()} == {
        (ids[2], "type", "evidence"), (ids[2], "length_m", "evidence"), (drawn_id, "geometry", "evidence"),
    }  # fmt: skip
    assert len(by_place(street.state(), "pothole")) == 2
    changed = {(c.change, c.asset_id, c.attribute) for c in street.changes().changes}
    assert ("changed", ids[0], "length_m") in changed and ("gone", ids[1], "") in changed
    assert not [c for c in street.changes().changes if c.change == "moved" and c.asset_id == ids[0]]
    differences = {(d.asset_id, d.attribute) for d in street.diff(1, 2)}
    assert {(ids[0], "severity"), (ids[0], "condition"), (ids[2], "type")} < differences
    then = street.state(2)
    assert all(then.assets[kind].rows.equals(edited.assets[kind].rows) for kind in ("crack", "pothole"))


@pytest.mark.slow
def test_a_home_of_an_older_version_gets_the_layers_of_new_kinds(home: Any, tmp_path: Path) -> None:
    everything, home.kinds = home.kinds, ("pole", "sign")
    street = street_of(tmp_path, home)
    street.record(found(poles(), "spring"))
    street.publish()
    home.edit("pole", 0, condition=3)
    home.kinds = everything
    assert len(street.pull().edits) == 1
    street.record(found([*poles(), crack(0.0, 0.0)], "spring", KINDS))
    assert street.publish().assets == 7
    home.edit("crack", 0, severity="high")
    assert len(street.pull().edits) == 1


@pytest.mark.slow
def test_values_beside_the_lists_are_named(tmp_path: Path) -> None:
    home = InFile(tmp_path / "inventory.gpkg", CRS)
    street = street_of(tmp_path, home)
    street.record(found([crack(0.0, 0.0), pothole(5.0, 1.0)], "spring", KINDS))
    street.publish()
    home.edit("crack", 0, severity="dreadful")
    home.edit("pothole", 0, depth_max_m=-0.1)
    with pytest.raises(FaultyEditsError) as caught:
        street.pull()
    told = {(fault.table, fault.reason) for fault in caught.value.faults}
    assert told == {
        ("cracks", "severity is 'dreadful', expected one of low, moderate, high"),
        ("potholes", "depth_max_m is -0.1, below 0"),
    }


def test_a_line_that_the_page_drew_is_a_crack_of_one_part(tmp_path: Path) -> None:
    street = street_of(tmp_path, GeoPackage(tmp_path / "inventory.gpkg", CRS))
    street.record(found([crack(0.0, 0.0)], "spring", KINDS))
    line = [[EAST + 50, NORTH, 100.0], [EAST + 53, NORTH + 0.2, 100.1]]
    given = {"layer": "asset_cracks", "action": "add", "attributes": {"type": "diagonal"}, "author": "eva"}
    feature = {"type": "Feature", "geometry": {"type": "LineString", "coordinates": line}, "properties": given}
    said = {"type": "FeatureCollection", "coordinates": "map_m", "survey": "s", "inventory": "street", "commit": 1}
    content = json.dumps(said | {"features": [feature]}).encode()
    pulled, outcomes = street.pull_page(PageDocument.parse("page", content, (1.0, 1.0, 1.0)))
    assert [one.outcome for one in outcomes] == ["accepted"]
    (row,) = (r for r in by_place(street.state(), "crack") if r["type"] == "diagonal")
    shape = shapely.from_wkb(row["geometry"])
    assert (shape.geom_type, shapely.get_coordinates(shape, include_z=True).tolist()) == ("MultiLineString", line)
    assert pulled.commit == 2 and conflicts_of(street.state()) == []
