"""The GeoPackage: edits of a person survive whatever the file goes through, and bad input leaves all as it was."""

from __future__ import annotations

import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path

import geopandas
import pandas as pd
import pyogrio
import pytest
import shapely

from roadscan.inventory.home import FaultyEditsError, HomeError
from roadscan.inventory.homes.geopackage import GeoPackage
from roadscan.inventory.inventory import Inventory
from roadscan.store.asset_schema import asset_kind_names, asset_schema
from tests.inventory import qgis_edits as person
from tests.inventory.streets import (
    AUTUMN,
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
)  # fmt: skip


@pytest.fixture
def street(tmp_path: Path) -> Inventory:
    """Six poles and a sign, published."""
    made = inventory(tmp_path, Everywhere())
    made.record(found([*poles(), asset("sign", (20.1, 4.0, 103.0), message="STOP", width_m=0.6)]))
    made.publish()
    return made


def test_table_1_is_there_with_its_attributes_and_types(tmp_path: Path) -> None:
    made = inventory(tmp_path, kinds=None)
    made.record(found(poles()))
    made.publish()
    paper = {  # paper 003, Table 1: attribute (format)
        "sidewalks": {"Width": "REAL", "Curb Height": "REAL", "Length": "REAL", "Availability of ramp": "BOOLEAN"},
        "medians": {"Width": "REAL", "Height": "REAL", "Length": "REAL"},
        "guard_rails": {"Height": "REAL", "Length": "REAL"}, "fencing": {"Height": "REAL", "Length": "REAL"},
        "lighting": {"Height": "REAL", "Type": "TEXT"}, "landscape_areas": {"Area of landscaping": "REAL"},
        "delineators": {"Height": "REAL", "Type of delineator": "TEXT"}, "lane_lines": {"Type of striping": "TEXT"},
    }  # fmt: skip
    shapes = {"sidewalks": "POLYGON", "medians": "POLYGON", "guard_rails": "LINESTRING", "fencing": "LINESTRING",
              "lighting": "POINT", "landscape_areas": "POLYGON", "delineators": "POINT",
              "lane_lines": "LINESTRING"}  # fmt: skip
    with sqlite3.connect(file_of(made)) as db:
        for table, attributes in paper.items():
            types = {name: kind for _, name, kind, *_ in db.execute(f"PRAGMA table_info({table})")}
            titles = dict(db.execute("SELECT name, column_name FROM gpkg_data_columns WHERE table_name = ?", [table]))
            for title, kind in {**attributes, "Condition": "MEDIUMINT", "Comments": "TEXT", "Asset Id": "TEXT"}.items():
                known = {t.lower().removesuffix(" of the segment"): c for t, c in titles.items()}
                assert title.lower() in known, (table, title, sorted(known))
                assert types[known[title.lower()]] == kind, (table, title)
            shape = db.execute("SELECT geometry_type_name, z FROM gpkg_geometry_columns WHERE table_name = ?", [table])
            assert shape.fetchone() == (shapes[table], 1)
        limits = db.execute("SELECT min, max FROM gpkg_data_column_constraints WHERE constraint_name = 'condition'")
        assert limits.fetchone() == (1, 10)
    assert {str(name) for name, _ in pyogrio.list_layers(file_of(made))} >= {
        asset_schema(kind).table for kind in asset_kind_names()
    }


def test_a_hand_edit_survives_reprocessing_and_a_new_epoch(street: Inventory) -> None:
    first, second, *_ = ids_by_station(street)
    person.edit(file_of(street), "poles", first, condition=3, comments="leans to the road", asset_height_m=7.5)
    person.edit(file_of(street), "poles", second, geometry=shapely.Point(EAST + 20.4, NORTH + 4.0, 101.0))
    assert street.pull(who="eva", why="walked it").commit == 2
    street.record(found([*poles(asset_height_m=5.3)], "2026-05-04"))
    street.record(found([*poles(when=AUTUMN, asset_height_m=5.3)], "autumn"))
    street.publish()
    shown = person.layer(file_of(street), "poles").set_index("asset_id")
    assert (shown.loc[first, "condition"], shown.loc[first, "comments"]) == (3, "leans to the road")
    assert shown.loc[first, "asset_height_m"] == 7.5
    assert shown.loc[second].geometry.x == EAST + 20.4
    assert pd.isna(shown.loc[second, "station_m"])  # it was measured elsewhere
    assert len(shown) == 6
    conflict = {(c.asset_id, c.attribute): c for c in street.conflicts()}
    assert conflict[first, "asset_height_m"].other == "5.3"  # it was 5.0 when eva saw it
    assert (second, "geometry") not in conflict  # the evidence says today what it said then


def test_a_second_pull_takes_nothing_and_taking_an_edit_back_is_an_edit(street: Inventory) -> None:
    first = ids_by_station(street)[0]
    person.edit(file_of(street), "poles", first, condition=3)
    assert len(street.pull().edits) == 1
    assert street.pull().commit is None
    person.edit(file_of(street), "poles", first, condition=None)
    (back,) = street.pull().edits
    assert (back.old, back.new) == ("3", "null")
    assert street.state().row(first)["condition"] is None


def test_numbers_of_features_that_are_given_again_confuse_nothing(street: Inventory) -> None:
    known = ids_by_station(street)
    frame = person.layer(file_of(street), "poles")
    kept = frame[~frame["asset_id"].isin(known[:2])]
    person.replace(file_of(street), "poles", kept.iloc[::-1])  # numbers from 1, in another order
    person.draw(file_of(street), "poles", shapely.Point(EAST + 3, NORTH - 6, 100.0), comments="new")
    done = street.pull()
    assert {(e.asset_id, e.new) for e in done.edits if e.attribute == "status"} == {
        (known[0], '"rejected"'), (known[1], '"rejected"'),
    }  # fmt: skip
    assert [e.action for e in done.edits].count("create") == 1
    assert len(done.edits) == 4
    street.publish()
    shown = person.layer(file_of(street), "poles")
    assert set(shown["asset_id"]) == {*known[2:], next(e.asset_id for e in done.edits if e.action == "create")}


def test_a_drawn_asset_keeps_its_id_while_it_is_edited_and_when_it_is_found(street: Inventory) -> None:
    place = shapely.Point(EAST + 3, NORTH - 6, 100.0)
    person.draw(file_of(street), "poles", place, comments="behind the hedge")
    drawn = next(e.asset_id for e in street.pull(who="eva").edits if e.action == "create")
    frame = person.layer(file_of(street), "poles")
    frame.loc[frame["comments"] == "behind the hedge", "condition"] = 9.0
    person.replace(file_of(street), "poles", frame)
    (edit,) = street.pull().edits
    assert (edit.asset_id, edit.attribute, edit.new) == (drawn, "condition", "9")
    street.record(found([*poles(), asset("pole", (3.1, -6.1, 100.0), asset_height_m=4.0)]))
    row = street.state().row(drawn)
    assert row["asset_height_m"] == 4.0  # the person did not say
    assert shapely.from_wkb(row["geometry"]).equals(place)  # the person said so
    assert len(street.assets("pole")) == 7


def test_a_rejected_asset_does_not_come_again(street: Inventory) -> None:
    first = ids_by_station(street)[0]
    person.delete(file_of(street), "poles", first)
    street.pull(why="it is a tree")
    street.record(found([*poles()], "2026-06-01"))
    street.publish()
    assert first not in person.ids(file_of(street), "poles")
    assert len(person.ids(file_of(street), "poles")) == 5


def test_publishing_over_changes_that_were_not_pulled_is_refused(street: Inventory) -> None:
    person.edit(file_of(street), "poles", ids_by_station(street)[0], condition=3)
    before = file_of(street).read_bytes()
    with pytest.raises(HomeError, match="1 changes that were not pulled"):
        street.publish()
    assert file_of(street).read_bytes() == before
    street.publish(discard=True)
    assert person.layer(file_of(street), "poles")["condition"].isna().all()


def test_a_pull_and_a_publication_that_die_one_after_the_other(
    street: Inventory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = file_of(street)
    person.delete(file, "poles", ids_by_station(street)[0])
    person.draw(file, "poles", shapely.Point(EAST + 70, NORTH + 4, 103.0), comments="drawn")

    def end(*_: object) -> None:
        raise KeyboardInterrupt

    note = street.home.note
    monkeypatch.setattr(street.home, "note", lambda mark: note(mark) if mark.pending else end())
    with pytest.raises(KeyboardInterrupt):
        street.pull()
    other = inventory(tmp_path, Everywhere())
    monkeypatch.setattr(other.home, "write", end)
    with pytest.raises(KeyboardInterrupt):
        other.publish()
    again = inventory(tmp_path, Everywhere())
    assert again.pull().commit is None  # the file is still told from what the pull read
    assert again.publish().assets == 7


def test_what_is_saved_while_a_publication_is_written_is_not_overwritten(
    street: Inventory, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = ids_by_station(street)[0]
    write = GeoPackage._write_layers

    def saved_meanwhile(self: GeoPackage, *given: object) -> None:
        write(self, *given)
        person.edit(self.file, "poles", first, condition=7)

    monkeypatch.setattr(GeoPackage, "_write_layers", saved_meanwhile)
    with pytest.raises(HomeError, match="it was edited in this moment"):
        street.publish()
    monkeypatch.undo()
    assert street.pull().edits[0].new == "7"


INVALID = shapely.Polygon([(EAST, NORTH, 1), (EAST + 2, NORTH + 2, 1), (EAST + 2, NORTH, 1), (EAST, NORTH + 2, 1)])


@pytest.mark.parametrize(
    ("layer", "values", "told"),
    [
        ("poles", {"condition": 11}, "condition is 11, above 10"),
        ("poles", {"comments": "=HYPERLINK(1)"}, "begins as a spreadsheet's formula does"),
        ("poles", {"comments": "+1+SUM(A1)"}, "begins as a spreadsheet's formula does"),
        ("poles", {"parent": "pole-00000000"}, "its parent 'pole-00000000' is not known"),
        ("poles", {"status": "gone"}, "status is 'gone', expected one of found, missing, confirmed, rejected"),
        ("poles", {"returns": 7}, "returns was measured and is not edited"),
        ("poles", {"geometry": shapely.Point(EAST, NORTH)}, "has no height"),
        ("poles", {"valid_to": pd.Timestamp("2020-01-01")}, "lies before valid_from 2026-05-04"),
        ("poles", {"asset_height_m": -1.0}, "asset_height_m is -1, below 0"),
        ("road_signs", {"shape": "oval"}, "shape is 'oval', expected one of rectangle"),
    ],
)  # fmt: skip
def test_a_faulty_row_is_named_and_nothing_is_taken(
    street: Inventory, layer: str, values: dict[str, object], told: str
) -> None:
    kind = {"poles": "pole", "road_signs": "sign"}[layer]
    asset_id = ids_by_station(street, kind)[0]
    person.edit(file_of(street), layer, asset_id, **values)
    if layer == "poles":
        person.edit(file_of(street), layer, ids_by_station(street)[1], condition=5)
    with pytest.raises(FaultyEditsError, match="1 rows are faulty") as error:
        street.pull()
    (fault,) = error.value.faults
    assert (fault.table, fault.record) == (layer, asset_id)
    assert told in fault.reason
    assert len(street.truth.commits) == 1
    if layer == "poles":
        done = street.pull(sound=True)
        assert [(e.asset_id, e.attribute) for e in done.edits] == [(ids_by_station(street)[1], "condition")]
        with pytest.raises(FaultyEditsError, match=r"1 rows are faulty"):
            street.pull()  # it is still there


def test_an_invalid_outline_a_copy_and_a_double_are_named(street: Inventory) -> None:
    file = file_of(street)
    sidewalks = person.layer(file, "sidewalks")
    drawn = geopandas.GeoDataFrame([{"comments": "drawn"}], geometry=[INVALID], crs=sidewalks.crs)
    pyogrio.write_dataframe(drawn, file, layer="sidewalks", driver="GPKG", append=True)
    frame = person.layer(file, "poles")
    person.replace(file, "poles", pd.concat([frame, frame.iloc[[0]]]))  # copied with its id
    person.draw(file, "poles", frame.geometry.iloc[1])
    with pytest.raises(FaultyEditsError) as error:
        street.pull()
    told = sorted((f.table, f.reason) for f in error.value.faults)
    assert told[0] == ("poles", f"it stands where {frame['asset_id'].iloc[1]} is: one of them")
    assert told[1][1].startswith("the id stands in two rows (fid 1 and 7)")
    assert told[2][1].startswith("its geometry is not valid: Self-intersection")


def test_a_deleted_column_a_deleted_layer_and_an_added_column_are_named(street: Inventory) -> None:
    file = file_of(street)
    frame = person.layer(file, "poles")
    person.replace(file, "poles", frame.drop(columns=["lean_deg"]))
    with pytest.raises(HomeError, match="the column 'lean_deg' of the layer 'poles' is missing"):
        street.pull()
    person.replace(file, "poles", frame.assign(colour="red"))
    with pytest.raises(HomeError, match="the column 'colour' of the layer 'poles' does not belong"):
        street.publish()
    street.home.file.unlink()
    frame.to_file(file, layer="trees")
    for act in (street.pull, street.publish, street.status):
        with pytest.raises(HomeError, match="the GeoPackage is that of another program"):
            act()
    assert len(street.truth.commits) == 1


def test_a_column_of_another_type_is_named(street: Inventory) -> None:
    file = file_of(street)
    frame = person.layer(file, "poles")
    person.replace(file, "poles", frame.assign(condition="good"))
    with pytest.raises(HomeError, match="the column 'condition' of the layer 'poles' is string"):
        street.pull()


def test_a_file_that_is_none_and_a_read_only_one_are_named(street: Inventory, tmp_path: Path) -> None:
    file = file_of(street)
    person.edit(file, "poles", ids_by_station(street)[0], condition=3)
    file.chmod(0o444)
    before = file.read_bytes()
    for act in (street.pull, lambda: street.publish(discard=True)):
        with pytest.raises(HomeError, match="cannot be written: it is read-only"):
            act()
    assert (file.read_bytes(), len(street.truth.commits)) == (before, 1)
    text = tmp_path / "text.gpkg"
    text.write_text("no GeoPackage")
    with pytest.raises(HomeError, match="no GeoPackage that can be read"):
        inventory(tmp_path, file="text.gpkg").publish()


def test_a_home_of_another_inventory_and_one_from_a_lost_store_are_refused(street: Inventory, tmp_path: Path) -> None:
    other = inventory(tmp_path / "other", Everywhere())
    other.name = "other"
    other.record(found(poles(2)))
    other.home = street.home
    with pytest.raises(HomeError, match="the home of the inventory 'street'"):
        other.publish(discard=True)
    other.name = "street"
    with pytest.raises(HomeError, match="published from another store"):
        other.pull()


HOLDER = """
import sqlite3, sys
held = sqlite3.connect(sys.argv[1])
held.execute("PRAGMA journal_mode = WAL")
held.execute("CREATE TABLE other (a)")
held.commit()
print("open", flush=True)
sys.stdin.read()
"""
"""What QGIS does with a GeoPackage that it shows: a log lies beside the file, with changes that are not in it yet."""


def test_a_file_that_another_program_holds_open_is_not_replaced(street: Inventory) -> None:
    file = file_of(street)
    arguments = [sys.executable, "-c", HOLDER, str(file)]
    with subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"open\n"
        with pytest.raises(HomeError, match="another program has the GeoPackage open"):
            street.publish()
        holder.communicate()
    street.publish()


def test_the_same_state_gives_the_same_bytes(street: Inventory, tmp_path: Path) -> None:
    content, mark = street.home.read(), street.home.mark()
    assert mark is not None
    files = [tmp_path / name / "inventory.gpkg" for name in ("one", "other")]
    for file in files:
        GeoPackage(file, CRS, street.home.kinds).write(content, [], mark)
    assert files[0].read_bytes() == files[1].read_bytes()


def test_gdal_reads_it_without_a_word(street: Inventory) -> None:
    if shutil.which("ogrinfo") is None:
        pytest.skip("Debian's gdal-bin is not installed: `apt-get install gdal-bin`")
    done = subprocess.run(["ogrinfo", "-so", "-al", str(file_of(street))], capture_output=True, text=True, check=True)
    assert "Warning" not in done.stderr and "ERROR" not in done.stderr, done.stderr
    assert "Layer name: poles" in done.stdout
    assert "3D Point" in done.stdout


@pytest.mark.slow
def test_gdals_validator_finds_nothing(tmp_path: Path) -> None:
    python = "/usr/bin/python3"
    python, module = "/usr/bin/python3", "osgeo_utils.samples.validate_gpkg"
    words = [python, "-c", f"import {module}"]
    if not Path(python).exists() or subprocess.run(words, capture_output=True, check=False).returncode:
        pytest.skip("Debian's python3-gdal is not installed: `apt-get install python3-gdal`")
    made = inventory(tmp_path, Everywhere(), kinds=None)
    made.record(found([*poles(), asset("sign", (20.1, 4.0, 103.0)), asset("kerb", (0, 3, 9), (9, 3, 9))]))
    made.publish()
    person.edit(file_of(made), "poles", ids_by_station(made)[0], asset_height_m=9.0)
    made.pull()
    made.record(found(poles(when=AUTUMN, asset_height_m=6.0), "autumn"))
    made.publish()  # with a conflict and changes
    done = subprocess.run([python, "-m", module, "-k", str(file_of(made))], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
