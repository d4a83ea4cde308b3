"""Edits of a home that are not what they say: each is named through the command line, and changes no figure unasked."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
from pathlib import Path

import geopandas
import pyogrio
import pytest
import shapely
from typer.testing import CliRunner

import roadscan
from roadscan.cli import app
from roadscan.store.asset_schema import asset_schema
from tests.inventory import qgis_edits as person
from tests.inventory.streets import EAST, NORTH, asset, poles
from tests.inventory.test_doors import SURVEY, write_found

FIRST = shapely.Point(EAST, NORTH + 4.0, 100.0)


@pytest.fixture
def survey_file(tmp_path: Path) -> Path:
    """A survey whose six poles and sign are published."""
    file = tmp_path / "SURVEY.toml"
    file.write_text(SURVEY)
    write_found(file, [*poles(), asset("sign", (20.1, 4.0, 103.0), message="STOP")])
    assert "7 assets" in run("publish", file)
    return file


def run(*words: object, code: int = 0) -> str:
    done = CliRunner().invoke(app, ["inventory", *map(str, words)])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        assert code, done.exception
        return " ".join(str(done.exception).split())
    assert done.exit_code == code, done.output
    return done.output


def home(survey_file: Path) -> Path:
    return survey_file.parent / "inventory.gpkg"


def place(survey_file: Path, asset_id: str) -> shapely.Point:
    frame = roadscan.open_survey(survey_file).inventory.assets("pole").set_index("asset_id")
    return frame.loc[asset_id].geometry


def ids(survey_file: Path) -> list[str]:
    return list(roadscan.open_survey(survey_file).inventory.assets("pole").sort_values("station_m")["asset_id"])


def exported(survey_file: Path, crs: object, *, states_it: object = None) -> None:
    """Export the layer of poles to another CRS, as QGIS does: heights of a CRS of two axes stay as they are."""
    frame = person.layer(home(survey_file), "poles").to_crs(crs)
    frame = frame.set_crs(states_it, allow_override=True) if states_it is not None else frame
    person.replace(home(survey_file), "poles", frame)


@pytest.mark.slow
@pytest.mark.witness("crs_of_edits")
def test_a_layer_in_another_crs_is_brought_into_the_map(survey_file: Path) -> None:
    one, *_ = ids(survey_file)
    for number, crs in enumerate(["EPSG:4326", "EPSG:32633", "EPSG:3857"]):
        there = shapely.Point(EAST + 0.5 + number, NORTH + 4.0, 100.0)
        exported(survey_file, "EPSG:32632")
        person.edit(home(survey_file), "poles", one, geometry=there)
        exported(survey_file, crs)
        assert "1 values of 1 assets" in run("pull", survey_file)  # the others are where they were
        assert place(survey_file, one).distance(there) < 1e-6
    assert "nothing new" in run("pull", survey_file)
    run("publish", survey_file)
    assert person.layer(home(survey_file), "poles").crs.to_epsg() == 32632


def test_a_layer_whose_way_into_the_map_is_not_known_exactly_is_refused(survey_file: Path) -> None:
    exported(survey_file, "EPSG:31468")  # Bessel 1841: PROJ has the way to WGS 84 within 1 m to 5 m
    told = run("pull", survey_file, code=1)
    assert "the layer 'poles' is in EPSG:31468" in told and "m only" in told
    assert "export the layer in the map's CRS" in told


def test_a_layer_without_a_crs_and_one_with_other_heights_are_refused(survey_file: Path) -> None:
    frame = person.layer(home(survey_file), "poles")
    with pytest.warns(UserWarning, match="'crs' was not provided"):
        person.replace(home(survey_file), "poles", frame.set_crs(None, allow_override=True))
    assert "the layer 'poles' states no CRS" in run("pull", survey_file, code=1)
    person.replace(home(survey_file), "poles", frame.set_crs("EPSG:32632+5783", allow_override=True))  # DHHN92
    told = run("pull", survey_file, code=1)
    assert "the heights of the layer 'poles' are those of" in told and "ellipsoidal heights of the map" in told


@pytest.mark.witness("places_of_edits")
def test_a_layer_that_states_the_maps_crs_and_lies_elsewhere_is_asked_about(survey_file: Path) -> None:
    exported(survey_file, "EPSG:32633", states_it="EPSG:32632")
    told = run("pull", survey_file, code=1)
    assert "is this right?" in told and "km from its former place, more than 100 m" in told
    assert len(roadscan.open_survey(survey_file).inventory.truth.commits) == 1


UNLIKELY = [
    (shapely.Point(EAST + 3000.0, NORTH, 100.0), "it lies 3.0 km from its former place, more than 100 m"),
    (shapely.Point(NORTH + 4.0, EAST, 100.0), "easting and northing seem to be swapped"),
    (shapely.Point(EAST, NORTH + 4.0, 146.2), "its height is 146.2 m, and the assets around it stand from 100.0 m"),
]


@pytest.mark.slow
def test_an_unlikely_place_is_in_force_once_it_is_confirmed(survey_file: Path) -> None:
    one, second, *_ = ids(survey_file)
    for number, (moved, told) in enumerate(UNLIKELY):
        person.edit(home(survey_file), "poles", one, geometry=moved)
        likely = shapely.Point(EAST + 22.0 + number, NORTH + 4.0, 102.0)
        person.edit(home(survey_file), "poles", second, geometry=likely)
        answer = run("pull", survey_file, code=1)
        assert told in answer and f"--confirm '{one}'" in answer and second not in answer
        assert "asked: poles" in run("pull", survey_file, "--sound", code=1)
        assert place(survey_file, one).equals(FIRST) and place(survey_file, second).equals(likely)
    assert "1 values of 1 assets" in run("pull", survey_file, "--confirm", one)
    assert place(survey_file, one).equals(moved)


@pytest.mark.slow
def test_a_drawn_asset_far_from_all_others_is_asked_about(survey_file: Path) -> None:
    person.draw(home(survey_file), "poles", shapely.Point(EAST + 9000.0, NORTH, 100.0))
    told = run("pull", survey_file, code=1)
    assert "it lies 8.9 km from all known assets, more than 1000 m" in told and "--confirm 'fid 7'" in told
    assert "assets" in run("pull", survey_file, "--confirm", "all")


def emptied(survey_file: Path, keep: int) -> None:
    """Rows of the layer of poles but the first ones are gone, as in a selection that was exported."""
    person.replace(home(survey_file), "poles", person.layer(home(survey_file), "poles").iloc[:keep])


@pytest.mark.slow
@pytest.mark.witness("deleted_layer")
@pytest.mark.parametrize("keep", [0, 1])
def test_a_layer_that_was_emptied_is_asked_about(survey_file: Path, keep: int) -> None:
    one = ids(survey_file)[0]
    person.edit(home(survey_file), "poles", one, condition=3)
    emptied(survey_file, keep)
    told = run("pull", survey_file, code=1)
    assert f"is this right? poles, poles: {6 - keep} of the 6 assets of the layer are missing" in told
    assert "--confirm 'poles'" in told
    assert len(roadscan.open_survey(survey_file).inventory.truth.commits) == 1
    run("pull", survey_file, "--sound", code=1)  # takes in what is left alone
    assert set(roadscan.open_survey(survey_file).inventory.assets("pole")["status"]) == {"found"}
    run("pull", survey_file, "--confirm", "poles")
    states = roadscan.open_survey(survey_file).inventory.assets("pole")["status"]
    assert list(states).count("rejected") == 6 - keep


def test_assets_that_a_person_deletes_one_by_one_are_not_asked_about(survey_file: Path) -> None:
    for one in ids(survey_file)[:3]:
        person.delete(home(survey_file), "poles", one)
    signs = asset_schema("sign").table
    person.delete(home(survey_file), signs, person.ids(home(survey_file), signs)[0])
    assert "4 values of 4 assets" in run("pull", survey_file)


@pytest.mark.slow
@pytest.mark.witness("sizes_of_edits")
def test_a_size_unlike_what_was_found_is_asked_about(survey_file: Path) -> None:
    one, second, *others = ids(survey_file)
    person.edit(home(survey_file), "poles", one, asset_height_m=310.0)
    person.edit(home(survey_file), "poles", second, asset_height_m=6.2)
    told = run("pull", survey_file, code=1)
    assert f"poles, {one}: asset_height_m is 310, and 5 ± 0.02 was found" in told and second not in told
    assert "2 values of 2 assets" in run("pull", survey_file, "--confirm", one)
    person.edit(home(survey_file), "poles", one, asset_height_m=311.0)  # near what was confirmed
    assert "1 values of 1 assets" in run("pull", survey_file)
    for number, other in enumerate(others, 2):
        person.edit(home(survey_file), "poles", other, asset_height_m=(5.0 + 0.1 * number) * 3.28084)
    told = run("pull", survey_file, code=1)
    assert told.count("as 4 values are: feet?") == 4, told
    assert "asset_height_m is 17.0604 and was 5.2" in told
    person.draw(home(survey_file), "poles", shapely.Point(EAST + 33.0, NORTH + 4.0, 102.0), asset_height_m=900.0)
    assert "asset_height_m is 900, and the largest one of its kind is 311" in run("pull", survey_file, code=1)
    assert "assets" in run("pull", survey_file, "--confirm", "all")


def stored(file: Path, layer: str, asset_id: str, column: str, value: object) -> None:
    """Write a value as SQLite takes it, without the checks of OGR; triggers of the spatial index do not concern it."""
    with sqlite3.connect(file) as db:
        triggers = db.execute("SELECT name, sql FROM sqlite_master WHERE type = 'trigger' AND tbl_name = ?", [layer])
        known = triggers.fetchall()
        for name, _ in known:
            db.execute(f'DROP TRIGGER "{name}"')
        db.execute(f'UPDATE "{layer}" SET "{column}" = ? WHERE asset_id = ?', [value, asset_id])
        for _, sql in known:
            db.execute(sql)


CELLS = [
    ("asset_height_m", "abc", "asset_height_m is the text 'abc', expected a number"),
    ("asset_height_m", "3,7", "asset_height_m is the text '3,7', expected a number"),
    ("asset_height_m", "", "asset_height_m is an empty text, expected a number"),
    ("condition", 3.7, "condition is 3.7, expected a whole number"),
    ("condition", 2**40, "condition is 1099511627776, expected a whole number"),
    ("valid_to", "31.12.2027", "valid_to is the text '31.12.2027', expected a date such as 2026-05-04"),
    ("valid_to", "2027-02-30", "valid_to is the text '2027-02-30', expected a date"),
    ("valid_to", 46000, "valid_to is 46000, expected a date"),
    ("comments", b"\x00\x01", "comments is 2 bytes, expected a text"),
]


@pytest.mark.slow
@pytest.mark.witness("stored_values")
def test_a_cell_that_is_not_of_its_column_is_named(survey_file: Path) -> None:
    write_found(
        survey_file,
        [*poles(10), asset("sidewalk", (0, 0, 100), (9, 0, 100), (9, 2, 100))],
    )
    run("publish", survey_file)
    *odd, sound = ids(survey_file)
    walk = person.ids(home(survey_file), "sidewalks")[0]
    flag = next(c.name for c in asset_schema("sidewalk").columns if c.type == "bool")
    for one, (column, value, _) in zip(odd, CELLS, strict=True):
        stored(home(survey_file), "poles", one, column, value)
    stored(home(survey_file), "sidewalks", walk, flag, "yes")
    stored(home(survey_file), "poles", sound, "comments", "leans")
    answer = run("pull", survey_file, code=1)
    for one, (_, _, told) in zip(odd, CELLS, strict=True):
        assert f"poles, {one}: {told}" in answer
    assert f"sidewalks, {walk}: {flag} is the text 'yes', expected true or false" in answer
    assert sound not in answer
    assert "were not pulled" in run("publish", survey_file, code=1)
    assert "1 values of 1 assets" in run("pull", survey_file, "--sound", code=1)
    frame = roadscan.open_survey(survey_file).inventory.assets("pole").set_index("asset_id")
    assert frame.loc[sound, "comments"] == "leans"
    assert frame["asset_height_m"].min() == 5.0
    assert frame["condition"].isna().all() and frame["valid_to"].isna().all()


@pytest.mark.slow
def test_a_number_as_geopandas_writes_it_is_no_fault(survey_file: Path) -> None:
    one = ids(survey_file)[0]
    person.edit(home(survey_file), "poles", one, condition=3.0)  # with NaN beside it: a column of floats
    assert "1 values" in run("pull", survey_file)
    person.edit(home(survey_file), "poles", one, condition=3.7)
    assert f"poles, {one}: condition is 3.7, expected a whole number" in run("pull", survey_file, code=1)


@pytest.mark.slow
def test_what_people_added_to_the_file_outlives_publications(survey_file: Path) -> None:
    file, one = home(survey_file), ids(survey_file)[0]
    hives = geopandas.GeoDataFrame({"species": ["oak", "lime"]}, geometry=[FIRST, FIRST], crs=32632)
    hives.to_file(file, layer="beehives", driver="GPKG")
    pyogrio.write_dataframe(hives.to_crs(31468), file, layer="old_beehives", driver="GPKG", append=True)
    with sqlite3.connect(file) as db:
        db.execute("CREATE TABLE photos (id INTEGER PRIMARY KEY, asset_id TEXT, content BLOB)")
        db.execute("INSERT INTO gpkg_contents (table_name, data_type, identifier) VALUES ('photos', 'attributes', 'p')")
        db.execute("INSERT INTO photos VALUES (41, ?, ?)", [one, b"\xff\xd8\xff"])
        db.execute("CREATE INDEX photos_of ON photos (asset_id)")
        db.execute("CREATE VIEW high_poles AS SELECT * FROM poles WHERE asset_height_m > 5.3")
        db.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier) VALUES ('high_poles', 'attributes', 'h')"
        )
        db.execute("UPDATE layer_styles SET styleQML = 'mine', update_time = '2027-01-01T00:00:00.000Z' "
                   "WHERE f_table_name = 'poles'")  # fmt: skip
        db.execute("INSERT INTO layer_styles (f_table_name, styleName, styleQML, useAsDefault, owner) "
                   "VALUES ('beehives', 'leafy', 'theirs', 1, 'eva')")  # fmt: skip
    for epoch in range(2):
        write_found(survey_file, [*poles(asset_height_m=6.0 + epoch), asset("sign", (20.1, 4.0, 103.0))])
        run("publish", survey_file)
    layers = {str(name) for name, _ in pyogrio.list_layers(file)}
    assert {"beehives", "old_beehives", "photos", "high_poles", "poles"} <= layers
    kept = pyogrio.read_dataframe(file, layer="beehives")
    assert list(kept["species"]) == ["oak", "lime"] and kept.crs.to_epsg() == 32632
    assert kept.geometry.iloc[0].equals(FIRST)
    assert pyogrio.read_dataframe(file, layer="old_beehives").crs.to_epsg() == 31468
    assert len(pyogrio.read_dataframe(file, layer="high_poles")) == 6
    box = (EAST - 1, NORTH, EAST + 1, NORTH + 9)
    assert len(pyogrio.read_dataframe(file, layer="beehives", bbox=box)) == 2  # its spatial index is whole
    pyogrio.write_dataframe(hives, file, layer="beehives", driver="GPKG", append=True)
    assert len(pyogrio.read_dataframe(file, layer="beehives", bbox=box)) == 4  # and is kept up
    with sqlite3.connect(file) as db:
        assert db.execute("SELECT * FROM photos").fetchall() == [(41, one, b"\xff\xd8\xff")]
        styles = dict(db.execute("SELECT f_table_name, styleQML FROM layer_styles WHERE useAsDefault"))
        assert (styles["poles"], styles["beehives"]) == ("mine", "theirs") and styles["road_signs"].startswith(
            "<!DOCTYPE"
        )
        assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert db.execute("SELECT count(*) FROM sqlite_master WHERE name = 'photos_of'").fetchone() == (1,)
        assert db.execute("SELECT feature_count FROM gpkg_ogr_contents WHERE table_name = 'beehives'").fetchone() == (
            4,
        )


LOCKED = """
import sqlite3, sys
held = sqlite3.connect(sys.argv[1], isolation_level=None)
held.execute("BEGIN " + sys.argv[2])
held.execute("CREATE TABLE other (a)")
print("open", flush=True)
sys.stdin.read()
"""


@pytest.mark.slow
@pytest.mark.parametrize("lock", ["IMMEDIATE", "EXCLUSIVE"])
def test_a_locked_file_is_said_to_be_locked_and_by_whom(survey_file: Path, lock: str) -> None:
    person.edit(home(survey_file), "poles", ids(survey_file)[0], condition=3)
    before = home(survey_file).read_bytes()
    words = [sys.executable, "-c", LOCKED, str(home(survey_file)), lock]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None and holder.stdout.readline() == b"open\n"
        told = run("pull", survey_file, code=1) + run("publish", survey_file, "--discard", code=1)
        holder.communicate()
    assert told.count("another program has the GeoPackage open (database is locked)") == 2
    assert told.count(f"(process {holder.pid})") == 2 and "close it" in told
    assert "no GeoPackage" not in told
    assert home(survey_file).read_bytes() == before
    assert "1 values" in run("pull", survey_file)


def rejected_and_edited(survey_file: Path) -> str:
    """A pole that eva edits and max, who does not see that, deletes."""
    one, copy = ids(survey_file)[0], survey_file.parent / "copy.gpkg"
    copy.write_bytes(home(survey_file).read_bytes())
    person.edit(home(survey_file), "poles", one, condition=3)
    person.delete(copy, "poles", one)
    run("pull", survey_file, "--who", "eva")
    run("pull", survey_file, "--home", copy, "--who", "max")
    run("publish", survey_file)
    return one


def decide(survey_file: Path, choice: str) -> None:
    layer = pyogrio.read_dataframe(home(survey_file), layer="conflicts")
    layer["decision"] = choice
    person.replace(home(survey_file), "conflicts", layer)


@pytest.mark.slow
def test_a_rejected_asset_comes_back_and_nothing_jams(survey_file: Path) -> None:
    one = rejected_and_edited(survey_file)
    decide(survey_file, "other")
    assert "1 changes to pull" in run("status", survey_file)
    assert "1 values" in run("pull", survey_file)
    assert " 0 changes to pull" in run("status", survey_file)
    assert "nothing new" in run("pull", survey_file)
    assert "7 assets" in run("publish", survey_file)
    assert person.layer(home(survey_file), "poles").set_index("asset_id").loc[one, "condition"] == 3


@pytest.mark.slow
def test_a_rejected_parent_comes_back_by_other(survey_file: Path) -> None:
    one, *_ = ids(survey_file)
    sign = person.ids(home(survey_file), "road_signs")[0]
    person.delete(home(survey_file), "poles", one)
    person.edit(home(survey_file), "road_signs", sign, parent=one)
    run("pull", survey_file)
    run("publish", survey_file)
    decide(survey_file, "other")
    assert "1 values" in run("pull", survey_file)
    assert "7 assets" in run("publish", survey_file)
    inventory = roadscan.open_survey(survey_file).inventory
    assert inventory.conflicts() == [] and list(inventory.assets("sign")["parent"]) == [one]


@pytest.mark.slow
def test_a_decision_that_chooses_nothing_is_a_named_row(survey_file: Path) -> None:
    one = ids(survey_file)[0]
    person.edit(home(survey_file), "poles", one, asset_height_m=9.0)
    run("pull", survey_file)
    write_found(survey_file, [*poles(asset_height_m=6.0), asset("sign", (20.1, 4.0, 103.0), message="STOP")])
    run("publish", survey_file)
    decide(survey_file, "other")  # against evidence: there is no other edit
    assert "1 changes to pull" in run("status", survey_file)
    told = run("pull", survey_file, code=1)
    assert f"conflicts, {one}, asset_height_m: the decision is 'other', and no other edit waits" in told
    decide(survey_file, "evidence")
    assert "1 values" in run("pull", survey_file)


@pytest.mark.slow
def test_an_old_copy_begins_from_what_it_showed(survey_file: Path) -> None:
    one, copy = ids(survey_file)[0], survey_file.parent / "old.gpkg"
    copy.write_bytes(home(survey_file).read_bytes())
    person.edit(home(survey_file), "poles", one, condition=3)
    run("pull", survey_file, "--who", "eva")
    write_found(survey_file, [*poles(asset_height_m=5.4), asset("sign", (20.1, 4.0, 103.0), message="STOP")])
    run("publish", survey_file)
    person.edit(copy, "poles", one, comments="leans")
    told = run("pull", survey_file, "--home", copy, "--who", "max")
    assert "1 values of 1 assets" in told  # not what has changed since
    row = roadscan.open_survey(survey_file).inventory.assets("pole").set_index("asset_id").loc[one]
    assert (row["condition"], row["comments"], row["asset_height_m"]) == (3, "leans", 5.4)


def test_a_geometry_that_is_none_or_another_one_is_named(survey_file: Path) -> None:
    frame = person.layer(home(survey_file), "poles")
    shapes = [None, FIRST.buffer(1.0), *frame.geometry.iloc[2:]]
    person.replace(home(survey_file), "poles", frame.set_geometry(shapes, crs=frame.crs), "Unknown")
    told = run("pull", survey_file, code=1)
    assert "it has no geometry" in told and "its geometry is a Polygon, where a Point is expected" in told


def test_an_asset_that_was_put_into_another_layer_is_named(survey_file: Path) -> None:
    one = ids(survey_file)[0]
    person.draw(home(survey_file), "road_signs", FIRST, asset_id=one)
    assert f"road_signs, {one}: the id belongs to the layer poles" in run("pull", survey_file, code=1)
