"""Conflicts: of persons who did not see what others did, nobody wins without being told, and a decision ends it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pyogrio
import pytest
import shapely

from roadscan.inventory.home import FaultyEditsError
from roadscan.inventory.homes.geopackage import GeoPackage
from roadscan.inventory.inventory import Inventory
from tests.inventory import qgis_edits as person
from tests.inventory.streets import (
    CRS,
    EAST,
    NORTH,
    Everywhere,
    asset,
    file_of,
    found,
    ids_by_station,
    inventory,
    poles,
)


@pytest.fixture
def street(tmp_path: Path) -> Inventory:
    """Six poles, published."""
    made = inventory(tmp_path, Everywhere())
    made.record(found(poles()))
    made.publish()
    return made


def test_two_editors_on_two_copies(street: Inventory, tmp_path: Path) -> None:
    copy = tmp_path / "copy.gpkg"
    shutil.copy(file_of(street), copy)
    first, second, *_ = ids_by_station(street)
    person.edit(file_of(street), "poles", first, condition=3, comments="eva")
    person.edit(copy, "poles", first, condition=8)
    person.edit(copy, "poles", second, comments="max")
    street.pull(who="eva")
    done = street.pull(home=GeoPackage(copy, CRS, street.home.kinds), who="max")
    assert (street.state().row(first)["comments"], street.state().row(second)["comments"]) == ("eva", "max")
    (conflict,) = street.conflicts()
    assert (conflict.asset_id, conflict.attribute, conflict.reason) == (first, "condition", "edit")
    assert (conflict.in_force, conflict.other, conflict.who, done.conflicts) == ("3", "8", "max", 1)


@pytest.mark.slow
@pytest.mark.parametrize(("choice", "value"), [("edit", 3), ("other", 8), ("evidence", None)])
def test_a_person_settles_a_conflict_in_its_layer(
    street: Inventory, tmp_path: Path, choice: str, value: object
) -> None:
    test_two_editors_on_two_copies(street, tmp_path)
    street.publish()
    layer = pyogrio.read_dataframe(file_of(street), layer="conflicts")
    assert list(layer["attribute"]) == ["condition"]
    layer["decision"] = [choice]
    person.replace(file_of(street), "conflicts", layer)
    street.pull(who="boss")
    assert street.conflicts() == []
    held = street.state().row(layer["asset_id"][0])["condition"]
    assert held == value


@pytest.mark.slow
def test_an_edit_that_waits_waits_until_it_is_decided(street: Inventory, tmp_path: Path) -> None:
    test_two_editors_on_two_copies(street, tmp_path)  # 3 is in force, 8 waits
    third = tmp_path / "third.gpkg"
    shutil.copy(tmp_path / "copy.gpkg", third)
    street.publish()
    first = ids_by_station(street)[0]
    person.edit(third, "poles", first, condition=9)
    street.pull(home=GeoPackage(third, CRS, street.home.kinds), who="ada")
    person.edit(file_of(street), "poles", first, condition=4)
    street.pull(who="eva")
    assert sorted((c.in_force, c.other) for c in street.conflicts()) == [("4", "8"), ("4", "9")]
    street.publish()
    settle(street, ["other", "other"])
    with pytest.raises(FaultyEditsError, match="the decisions contradict one another"):
        street.pull(who="boss")
    settle(street, ["edit", None])
    street.pull(who="boss")
    assert [(c.in_force, c.other) for c in street.conflicts()] == [("4", "9")]
    street.publish()
    settle(street, ["edit"])
    person.edit(file_of(street), "poles", first, condition=6)  # neither of them
    street.pull(who="boss")
    assert street.conflicts() == []
    assert street.state().row(first)["condition"] == 6


def settle(street: Inventory, decisions: list[str | None]) -> None:
    """Decide conflicts, in the order of what waits."""
    layer = pyogrio.read_dataframe(file_of(street), layer="conflicts").sort_values("other")
    layer["decision"] = decisions
    person.replace(file_of(street), "conflicts", layer)


@pytest.mark.parametrize(("choice", "status"), [("edit", "rejected"), ("other", "found")])
def test_a_rejected_asset_that_another_edited_stays_or_comes_back(
    street: Inventory, tmp_path: Path, choice: str, status: str
) -> None:
    copy = tmp_path / "copy.gpkg"
    shutil.copy(file_of(street), copy)
    first = ids_by_station(street)[0]
    person.edit(file_of(street), "poles", first, condition=3)
    person.delete(copy, "poles", first)
    street.pull(who="eva")
    street.pull(home=GeoPackage(copy, CRS, street.home.kinds), who="max")
    street.publish()
    settle(street, [choice])
    street.pull(who="boss")
    assert street.conflicts() == []
    row = street.state().row(first)
    assert (row["status"], row["condition"]) == (status, 3)


@pytest.mark.parametrize("order", ["edited, then undone", "undone, then edited"])
def test_an_edit_of_an_asset_whose_drawing_was_undone_is_not_lost(street: Inventory, order: str) -> None:
    file = file_of(street)
    person.draw(file, "poles", shapely.Point(EAST + 70, NORTH + 4, 103.0), comments="drawn")
    drawing = street.pull(who="eva").commit
    if order == "undone, then edited":
        street.undo(drawing)
    frame = person.layer(file, "poles")
    frame.loc[frame["asset_id"].isna(), "condition"] = 4
    person.replace(file, "poles", frame)
    street.pull(who="max")
    if order == "edited, then undone":
        street.undo(drawing)
    (conflict,) = street.conflicts()
    assert (conflict.reason, conflict.attribute, conflict.in_force) == ("undone", "condition", "4")
    street.publish()
    shown = person.layer(file, "poles").set_index("asset_id").loc[conflict.asset_id]
    assert (shown["status"], shown["condition"]) == ("missing", 4)
    settle(street, ["edit"])
    street.pull()
    assert street.conflicts() == []


def test_a_drawn_asset_that_was_read_stays_the_same_when_it_is_moved_a_little_and_changed(street: Inventory) -> None:
    """Its row has no id before the next publish, and neither its place nor its values are those that were read."""
    file = file_of(street)
    person.draw(file, "poles", shapely.Point(EAST + 70, NORTH + 4, 103.0), comments="drawn")
    street.pull(who="eva")
    before = ids_by_station(street)
    frame = person.layer(file, "poles")
    drawn = frame["asset_id"].isna()
    shapes = [shapely.Point(g.x, g.y - 0.009, g.z) if d else g for g, d in zip(frame.geometry, drawn, strict=True)]
    frame = frame.set_geometry(shapes, crs=frame.crs)
    frame.loc[drawn, "condition"] = 4
    person.replace(file, "poles", frame)
    street.pull(who="eva")
    assert ids_by_station(street) == before
    row = street.state().row(before[-1])
    assert row["condition"] == 4
    assert shapely.from_wkb(row["geometry"]).y == pytest.approx(NORTH + 3.991, abs=1e-4)


def test_nothing_hangs_on_what_was_rejected(tmp_path: Path) -> None:
    street = inventory(tmp_path, Everywhere())
    rows = [*poles(2), asset("pole", (0.4, 4.0, 100.0)), asset("sign", (0.1, 4.0, 102.5))]
    street.record(found(rows))
    street.publish()
    sign, file = street.assets("sign")["asset_id"][0], file_of(street)
    false_one = street.assets("sign")["parent"][0]
    other_one = next(one for one in ids_by_station(street) if one != false_one)
    person.delete(file, "poles", other_one)
    person.edit(file, "road_signs", sign, parent=other_one)  # in one pull; neither is lost
    street.pull()
    assert [(c.asset_id, c.attribute, c.reason) for c in street.conflicts()] == [(sign, "parent", "rejected")]
    street.undo(len(street.truth.commits))
    street.publish()
    assert street.conflicts() == []
    person.delete(file, "poles", false_one)
    street.pull()
    assert street.assets("sign")["parent"].isna().all()
    street.publish()
    person.edit(file, "road_signs", sign, parent=false_one)
    with pytest.raises(FaultyEditsError, match=f"its parent '{false_one}' was rejected"):
        street.pull()
    street.publish(discard=True)
    street.record(found([*rows, asset("pole", (60.0, 4.0, 100.0))]))
    true_one = next(r["asset_id"] for r in street.assets("pole").to_dict("records") if r["easting_m"] == EAST + 0.4)
    assert street.assets("sign")["parent"].tolist() == [true_one]
