"""Edits that people made in the page of a survey: what becomes of each, and that nobody's edit is lost."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import shapely

import roadscan
from roadscan.inventory.home import FaultyEditsError, HomeError
from roadscan.inventory.homes.page_edits import EditOutcome, PageDocument
from roadscan.inventory.inventory import Inventory
from tests.inventory.streets import EAST, NORTH, asset, found, inventory, poles
from tests.inventory.test_doubtful_edits import run, survey_file

__all__ = ["survey_file"]


@pytest.fixture
def street(tmp_path: Path) -> Inventory:
    """Six poles and a sign, taken in as commit 1."""
    one = inventory(tmp_path)
    one.record(found([*poles(), asset("sign", (20.1, 4.0, 103.0), message="STOP")]))
    return one


def edit(action: str, asset_id: str | None = None, layer: str = "asset_poles", **said: Any) -> dict[str, Any]:
    """An edit as the page writes it."""
    geometry = said.pop("geometry", None)
    about = {"layer": layer, "action": action, "asset_id": asset_id, "attributes": said.pop("attributes", {}), **said}
    properties = {"comment": "", "author": "eva", "edited_utc": "2026-11-23T10:00:00.000Z"} | about
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def document(*edits: dict[str, Any], unit_m: float = 1.0, **said: Any) -> PageDocument:
    """A document of edits on commit 1."""
    head = {"type": "FeatureCollection", "coordinates": "map_m", "survey": "street", "inventory": "street", "commit": 1}
    content = json.dumps({**head, "features": edits, **said}).encode()
    return PageDocument.parse("edits.geojson", content, (unit_m, unit_m, unit_m))


def pole(street: Inventory, number: int = 0) -> str:
    return str(street.state().assets["pole"].ids[number])


def outcomes(told: list[EditOutcome]) -> list[str]:
    return [one.outcome for one in told]


def test_each_action_is_an_edit_of_its_author(street: Inventory) -> None:
    first, second, third, fourth = (pole(street, n) for n in range(4))
    place = {"type": "Point", "coordinates": [EAST + 7.25, NORTH + 4.5, 100.125]}
    pulled, told = street.pull_page(
        document(
            edit("change", first, attributes={"condition": 4, "asset_height_m": 6}, comment="bent"),
            edit("confirm", second), edit("reject", third), edit("change", fourth, geometry=place),
            edit("add", geometry={"type": "Point", "coordinates": [EAST + 55, NORTH - 4, 101.5]}, author=""),
        ),
        who="max",
    )  # fmt: skip
    assert (pulled.commit, outcomes(told), pulled.refused) == (2, ["accepted"] * 5, ())
    state = street.state()
    row = state.row(first)
    assert row is not None and (row["condition"], row["asset_height_m"]) == (4, 6.0)
    rows = {row["asset_id"]: row for row in state.assets["pole"].rows.to_pylist()}
    assert (rows[second]["status"], rows[third]["status"]) == ("confirmed", "rejected")
    assert shapely.from_wkb(rows[fourth]["geometry"]).equals(shapely.Point(place["coordinates"]))
    (drawn,) = rows.keys() - set(street.state(1).assets["pole"].ids)
    assert shapely.from_wkb(rows[drawn]["geometry"]).z == 101.5
    assert {(e.asset_id, e.who) for e in pulled.edits} == {
        *((one, "eva") for one in (first, second, third, fourth)), (drawn, "max"),
    }  # fmt: skip
    assert [(e.who, e.why) for e in street.history(first) if e.attribute == "condition"] == [("eva", "bent")]


def test_the_same_document_says_nothing_new_a_second_time(street: Inventory) -> None:
    drawn = {"type": "LineString", "coordinates": [[EAST, NORTH, 1.0], [EAST + 1, NORTH, 1.0]]}
    given = document(
        edit("confirm", pole(street)), edit("add", layer="asset_guardrails", geometry=drawn),
        edit("add", geometry={"type": "Point", "coordinates": [EAST + 55, NORTH - 4, 101.5]}),
    )  # fmt: skip
    first, _ = street.pull_page(given, sound=True)
    pulled, told = street.pull_page(given, sound=True)
    assert first.commit == 2
    assert (pulled.commit, pulled.edits) == (None, ())
    assert {"accepted", "conflict"}.isdisjoint(outcomes(told))


def test_an_edit_that_another_person_did_not_see_waits(street: Inventory) -> None:
    one = pole(street)
    street.pull_page(document(edit("change", one, attributes={"condition": 4})), who="max")
    _, told = street.pull_page(document(edit("change", one, attributes={"condition": 9, "comments": "new"})))
    assert told[0].outcome == "conflict"
    assert "4" in told[0].reason and "9" in told[0].reason
    row = street.state().row(one)
    assert row is not None and (row["condition"], row["comments"]) == (4, "new")
    assert [(c.attribute, c.reason) for c in street.conflicts()] == [("condition", "edit")]
    # Who has seen what was in force overwrites it.
    _, told = street.pull_page(document(edit("change", one, attributes={"condition": 9}), commit=2))
    row = street.state().row(one)
    assert outcomes(told) == ["accepted"] and row is not None and row["condition"] == 9


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (edit("change", "P", attributes={"condition": 11}), "condition is 11, above 10"),
        (edit("change", "P", attributes={"condition": "bad"}), 'condition is "bad", expected a whole number'),
        (edit("change", "P", attributes={"condition": 2.5}), "condition is 2.5, expected a whole number"),
        (edit("change", "P", attributes={"returns": 5}), "returns was measured"),
        (edit("change", "P", attributes={"colour": "red"}), "there is no column 'colour'"),
        (edit("change", "P", attributes={"asset_id": "pole-1"}), "there is no column 'asset_id'"),
        (edit("change", "P", attributes={"valid_to": "tomorrow"}), "expected a date"),
        (edit("change", "P", attributes={"comments": "=1+1"}), "spreadsheet"),
        (edit("change", "P", attributes={"comments": "-1+cmd|' /C calc'!A0"}), "spreadsheet"),
        (edit("change", "P", attributes={"comments": "bent\0"}), "control character"),
        (edit("change", "P", attributes={"condition": 1e30}), "condition is 1e+30, expected a whole number"),
        (edit("change", "P", attributes={"diameter_m": 10**400}), "expected a number"),
        (edit("change", "P", geometry={"type": "Point", "coordinates": [EAST, NORTH]}), "no height"),
        (edit("change", "P", geometry={"type": "Point", "coordinates": "here"}), "cannot be read"),
        (edit("change", "P", geometry={"type": "Blob"}), "cannot be read"),
        (edit("confirm", "pole-00000000"), "commit 1 shows no such asset"),
        (edit("confirm", None), "commit 1 shows no such asset"),
        (edit("confirm", "P", layer="asset_dragons"), "no such layer"),
        (edit("add"), "no geometry"),
    ],
)
def test_a_faulty_edit_is_refused_and_the_others_count(street: Inventory, bad: dict[str, Any], reason: str) -> None:
    if bad["properties"]["asset_id"] == "P":
        bad = bad | {"properties": bad["properties"] | {"asset_id": pole(street)}}
    given = document(edit("confirm", pole(street, 1)), bad, edit("confirm", pole(street, 2)))
    with pytest.raises(FaultyEditsError, match="nothing was taken in"):
        street.pull_page(given)
    assert street.state().commit == 1
    pulled, told = street.pull_page(given, sound=True)
    assert outcomes(told) == ["accepted", "refused", "accepted"]
    assert reason in told[1].reason
    assert len(pulled.edits) == 2


def test_coordinates_of_the_page_are_metres(street: Inventory) -> None:
    foot_m = 0.3048
    place = {"type": "Point", "coordinates": [EAST * foot_m, NORTH * foot_m, 100.0 * foot_m]}
    street.pull_page(document(edit("change", pole(street), geometry=place), unit_m=foot_m))
    row = street.state().row(pole(street))
    assert row is not None
    shape = shapely.from_wkb(row["geometry"])
    assert (shape.x, shape.y, shape.z) == pytest.approx((EAST, NORTH, 100.0), abs=1e-6)


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ({"inventory": "lane"}, "it is the home of the inventory 'lane'"),
        ({"commit": 7}, "the page showed commit 7, and the inventory has 1"),
        ({"commit": 0}, "1 or more"),
        ({"coordinates": "lon_lat"}, "map_m"),
        ({"features": {}}, "a list"),
        ({"script": 1}, "unknown key"),
    ],
)
def test_a_document_that_is_none_of_this_inventory(street: Inventory, said: dict[str, Any], told: str) -> None:
    with pytest.raises(HomeError, match=told):
        street.pull_page(document(edit("confirm", pole(street)), **said))


@pytest.mark.parametrize(
    "content", [b"", b"\xff\xfe", b"[1]", b"{", b'{"type": "FeatureCollection"}', b'{"a": "\\ud800"}']
)
def test_what_is_no_document(content: bytes) -> None:
    with pytest.raises(HomeError, match="edits"):
        PageDocument.parse("edits.geojson", content, (1.0, 1.0, 1.0))


def test_an_unlikely_place_is_asked_about_and_taken_in_once_it_is_confirmed(street: Inventory) -> None:
    first = pole(street)
    far = {"type": "Point", "coordinates": [EAST + 5000.0, NORTH, 100.0]}
    pulled, told = street.pull_page(document(edit("change", first, geometry=far)), sound=True)
    assert (pulled.commit, outcomes(told)) == (None, ["asked"])
    assert told[0].reason.endswith("km from its former place, more than 100 m")
    pulled, told = street.pull_page(document(edit("change", first, geometry=far, confirmed=True)))
    assert (pulled.commit, outcomes(told)) == (2, ["accepted"])


@pytest.mark.witness("clock_of_edits")
def test_an_edit_of_a_computer_whose_clock_is_wrong_is_dated_by_the_pull(survey_file: Path) -> None:
    run("publish", survey_file)
    survey = roadscan.open_survey(survey_file)
    one = str(survey.inventory.state().assets["pole"].ids[0])
    head = {"type": "FeatureCollection", "coordinates": "map_m", "survey": "street", "inventory": "street", "commit": 1}
    made = edit("confirm", one, edited_utc="1999-01-01T00:00:00Z")
    file = survey_file.parent / "edits.geojson"
    file.write_text(json.dumps({**head, "features": [made]}))
    told = run("pull", survey_file, "--home", file)
    assert "doubtful: eva: it is dated 1999-01-01T00:00:00Z" in told and "the clock of that computer is wrong" in told
    (event,) = [e for e in roadscan.open_survey(survey_file).inventory.history(one) if e.who == "eva"]
    assert not event.at.startswith("1999")
