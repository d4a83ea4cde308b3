"""The inventory through the command line, Python, QGIS's files, and files for other programs."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import geopandas
import pandas as pd
import pyarrow.parquet as pq
import pyogrio
import pytest
import shapely
from typer.testing import CliRunner

import roadscan
from roadscan.cli import app
from roadscan.core.errors import ConfigError, DamagedError, StoreError
from roadscan.inventory.conflicts import pictures_of
from roadscan.inventory.of_survey import FOUND
from roadscan.inventory.state import state_at
from roadscan.report.section import Material, sections
from roadscan.store.asset_schema import asset_columns, asset_kind_names, asset_schema
from roadscan.store.asset_truth import AssetTruth
from roadscan.store.digest import bytes_digest, sealed_parquet
from roadscan.store.store import Store
from tests.inventory import qgis_edits as person
from tests.inventory.streets import AUTUMN, EAST, NORTH, Everywhere, asset, found, inventory, poles

SURVEY = """
id = "street"
rig = {}
[map]
crs = "EPSG:32632"
[[runs]]
id = "drive"
logs = [{ path = "drive.csv" }]
[inventory]
epoch = "2026-spring"
"""


@pytest.fixture
def survey_file(tmp_path: Path) -> Path:
    """A survey whose stage `assets` has run."""
    file = tmp_path / "SURVEY.toml"
    file.write_text(SURVEY)
    write_found(file, [*poles(), asset("sign", (20.1, 4.0, 103.0), message="STOP")])
    return file


def write_found(survey_file: Path, rows: list[dict[str, object]]) -> None:
    folder = survey_file.parent / "store" / "survey=street" / FOUND
    folder.mkdir(parents=True, exist_ok=True)
    for kind, table in found(rows).tables.items():
        pq.write_table(table, folder / f"{asset_schema(kind).table}.parquet")


def run(*words: object, code: int = 0) -> str:
    done = CliRunner().invoke(app, ["inventory", *map(str, words)])
    assert done.exit_code == code, done.output or done.exception
    return done.output


@pytest.mark.slow
def test_the_commands_from_publication_to_export(survey_file: Path, tmp_path: Path) -> None:
    assert "7 assets as of commit 1" in run("publish", survey_file)
    file = tmp_path / "inventory.gpkg"
    one = person.ids(file, "poles")[0]
    person.edit(file, "poles", one, condition=4, comments="bent")
    assert "2 changes to pull" in run("status", survey_file)
    assert "commit 2: 2 values of 1 assets" in run("pull", survey_file, "--who", "eva", "--why", "walked")
    assert "nothing new" in run("pull", survey_file)
    write_found(survey_file, poles(asset_height_m=5.5))
    told = run("publish", survey_file)
    assert "commit 3: found in epoch 2026-spring" in told
    assert person.layer(file, "poles").set_index("asset_id").loc[one, "condition"] == 4
    history = run("history", one, "--survey", survey_file)
    assert "eva" in history and "walked" in history and "bent" in history
    assert "changed" in run("diff", "1", "2", "--survey", survey_file)
    assert "undoes commit 2" in run("undo", "2", "--survey", survey_file)
    assert "4 " in run("log", survey_file)
    commits = json.loads(run("log", survey_file, "--json"))
    assert [(c["number"], c["kind"]) for c in commits][1::2] == [(2, "edits"), (4, "undo")]
    assert (commits[1]["who"], commits[1]["why"], commits[3]["undoes"]) == ("eva", "walked", 2)
    edits = [e for e in json.loads(run("history", one, "--survey", survey_file, "--json")) if e["commit"] == 2]
    assert {(e["attribute"], json.loads(e["new"])) for e in edits} == {("condition", 4), ("comments", "bent")}
    differences = json.loads(run("diff", "1", "2", "--survey", survey_file, "--json"))
    assert {(d["asset_id"], d["attribute"], d["after"]) for d in differences} >= {(one, "condition", "4")}
    assert "nothing to compare" in run("changes", "--survey", survey_file)
    assert "as of commit 1" in run("status", survey_file, "--as-of", "1")
    for form in ("gpkg", "geojson", "csv", "dxf"):
        assert "7 assets" in run("export", survey_file, "--out", tmp_path / f"out.{form}", "--as", form)
    wrong = CliRunner().invoke(app, ["inventory", "export", str(survey_file), "--out", "x", "--as", "shp"])
    assert isinstance(wrong.exception, ConfigError)


@pytest.mark.slow
def test_python_says_the_same(survey_file: Path) -> None:
    survey = roadscan.open_survey(survey_file)
    inventory = survey.inventory
    assert inventory.publish().assets == 7
    frame = inventory.assets("pole")
    assert isinstance(frame, geopandas.GeoDataFrame)
    assert (len(frame), frame.crs.to_epsg()) == (6, 32632)
    assert inventory.status().assets["pole"] == {"found": 6}
    rows = survey.sql("SELECT kind, count(*) FROM assets_found GROUP BY kind ORDER BY kind").fetchall()
    assert rows == [("pole", 6), ("sign", 1)]
    with pytest.raises(ConfigError, match="there is no asset 'pole-00'"):
        inventory.history("pole-00")


def test_files_for_others_hold_what_the_inventory_holds(tmp_path: Path) -> None:
    street = inventory(tmp_path, Everywhere())
    street.record(
        found([*poles(), asset("sign", (20.1, 4.0, 103.0), message="=1+1"), asset("kerb", (0, 3, 9), (9, 3, 9))])
    )
    for form in ("geojson", "csv", "dxf", "gpkg"):
        assert street.export(tmp_path / f"o.{form}", form) == 8
    features = json.loads((tmp_path / "o.geojson").read_text())["features"]
    pole = next(f for f in features if f["properties"]["kind"] == "pole" and f["properties"]["station_m"] == 20.0)
    back = geopandas.GeoSeries([shapely.Point(pole["geometry"]["coordinates"][:2])], crs=4326).to_crs(32632)[0]
    assert back.distance(shapely.Point(EAST + 20, NORTH + 4)) < 0.002
    with (tmp_path / "o.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert next(r["message"] for r in rows if r["kind"] == "sign") == "'=1+1"  # a text, nothing that is run
    assert all(shapely.from_wkt(r["geometry"]).has_z for r in rows)
    drawing = pyogrio.read_dataframe(tmp_path / "o.dxf")
    assert drawing["Layer"].value_counts().to_dict() == {"poles": 6, "road_signs": 1, "kerbs": 1}
    assert drawing.geometry.iloc[0].has_z
    with pytest.raises(StoreError, match="cannot be written"):
        street.export(Path("/proc/none/o.csv"), "csv")


def test_the_project_of_qgis_has_a_form_for_every_column(tmp_path: Path) -> None:
    street = inventory(tmp_path, Everywhere())
    street.record(found(poles()))
    street.publish()
    root = ElementTree.parse(tmp_path / "inventory.qgs").getroot()
    layers = {layer.findtext("layername"): layer for layer in root.iter("maplayer")}
    assert root.tag == "qgis" and root.findtext("projectCrs/spatialrefsys/authid") == "EPSG:32632"
    in_tree = {node.get("id") for node in root.iter("layer-tree-layer")}
    assert {layer.findtext("id") for layer in layers.values()} == in_tree
    for kind in asset_kind_names():
        schema = asset_schema(kind)
        layer = layers[schema.title]
        assert layer.findtext("datasource") == f"./inventory.gpkg|layername={schema.table}"
        names = [c.name for c in asset_columns(kind)]
        for path in (
            "fieldConfiguration/field",
            "editable/field",
            "constraints/constraint",
            "constraintExpressions/constraint",
        ):
            assert [f.get("name") or f.get("field") for f in layer.findall(path)] == names, path
        shown = {f.get("name") for f in layer.iter("attributeEditorField")}
        assert shown == set(names)
    sign = layers["Road Signs/Boards"]
    shapes = sign.find("fieldConfiguration/field[@name='shape']/editWidget[@type='ValueMap']")
    assert [o.get("value") for o in shapes.iter("Option") if o.get("type") == "QString"][1:] == list(
        next(c for c in asset_columns("sign") if c.name == "shape").values
    )
    limits = sign.find("constraintExpressions/constraint[@field='condition']").get("exp")
    assert limits == '"condition" IS NULL OR ("condition" >= 1 AND "condition" <= 10)'
    locked = {f.get("name") for f in sign.findall("editable/field") if f.get("editable") == "0"}
    assert {"asset_id", "returns", "object", "sigma_height_m"} <= locked and "message" not in locked
    styles = pyogrio.read_dataframe(tmp_path / "inventory.gpkg", layer="layer_styles")
    for text in styles["styleQML"]:
        assert ElementTree.fromstring(text.split("\n", 1)[1]).find("renderer-v2") is not None
    before = (tmp_path / "inventory.qgs").read_bytes()
    (tmp_path / "inventory.qgs").write_text("mine")
    street.publish()
    assert (tmp_path / "inventory.qgs").read_text() == "mine" and before


HOLDER = """
import sys, time
from roadscan.store.asset_truth import AssetTruth
from roadscan.store.store import Store
with AssetTruth(Store(sys.argv[1], "street")).alone():
    print("held", flush=True)
    sys.stdin.read()
"""


def test_two_writers_at_once_wait_or_are_told(tmp_path: Path) -> None:
    truth = AssetTruth(Store(str(tmp_path), "street"))
    words = [sys.executable, "-c", HOLDER, str(tmp_path)]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None and other.stdout.readline() == b"held\n"
        with pytest.raises(StoreError, match="another program is writing the inventory"), truth.alone(wait_s=0.2):
            pass
        other.kill()  # as kill -9: the system lets go of what it held
    with truth.alone(wait_s=5.0):
        pass


def test_a_last_commit_that_its_killed_writer_did_not_count_is_missed_when_it_goes(tmp_path: Path) -> None:
    street = inventory(tmp_path, Everywhere())
    head = Path(street.truth.store.path("inventory/head.json"))
    street.record(found(poles()))
    before = head.read_bytes()
    street.record(found(poles(5, when=AUTUMN)))
    whole = head.read_bytes()
    head.write_bytes(before)  # as a kill between both leaves it
    with street.truth.alone():
        pass
    assert head.read_bytes() == whole
    next(Path(street.truth.store.path("tables/asset_commits")).glob("*2.parquet")).unlink()
    with pytest.raises(DamagedError, match="commit 2 of the inventory is missing"):
        inventory(tmp_path).state()


def test_damage_of_the_truth_is_named(tmp_path: Path) -> None:
    street = inventory(tmp_path, Everywhere())
    street.record(found(poles()))
    street.record(found(poles(5, when=AUTUMN)))
    file = Path(street.truth.store.path(street.truth.commits[0].file))
    content = file.read_bytes()
    file.write_bytes(content[:-20] + b"x" * 20)
    with pytest.raises(DamagedError, match="rows of commit 1 of the inventory are not those that were written"):
        inventory(tmp_path).state(1)
    file.write_bytes(content)
    next(Path(street.truth.store.path("tables/asset_commits")).glob("*1.parquet")).unlink()
    with pytest.raises(DamagedError, match="commit 1 of the inventory is missing"):
        inventory(tmp_path).state()


@pytest.mark.slow
def test_verify_names_each_damaged_file_of_the_inventory(survey_file: Path) -> None:
    survey = roadscan.open_survey(survey_file)
    survey.inventory.publish()
    person.edit(
        survey_file.parent / "inventory.gpkg", "poles", survey.inventory.assets("pole")["asset_id"][0], condition=3
    )
    survey.inventory.pull()
    survey.inventory.undo(2)
    assert not [one for one in survey.verify() if "inventory" in one]
    truth = survey.inventory.truth
    rows = Path(truth.store.path(truth.commits[0].file))
    rows.write_bytes(rows.read_bytes()[:-9] + bytes(9))
    second = next(Path(truth.store.path("tables/asset_commits")).glob("*2.parquet"))
    second.unlink()
    kept = min(Path(truth.store.path("inventory/published")).glob("*.parquet"))
    kept.write_bytes(b"PAR1")
    faults = "\n".join(roadscan.open_survey(survey_file).verify())
    assert str(rows) in faults and "rows of commit 1 of the inventory are not those that were written" in faults
    assert "asset_commits/00000002.parquet: commit 2 of the inventory is missing" in faults
    assert str(kept) in faults
    told = CliRunner().invoke(app, ["verify", str(survey_file)])
    assert told.exit_code == 1 and "3 files are not whole" in told.output


def test_a_renamed_column_of_what_was_published_is_no_edit(survey_file: Path) -> None:
    survey = roadscan.open_survey(survey_file)
    survey.inventory.publish()
    [kept] = Path(survey.inventory.truth.store.path("inventory/published")).glob("*.parquet")
    content = kept.read_bytes()
    assert content.count(b"status") >= 1
    kept.write_bytes(content.replace(b"status", b"statur"))
    assert any(str(kept) in one for one in survey.verify())
    commits = len(survey.inventory.truth.commits)
    with pytest.raises(DamagedError, match="its digest differs"):
        survey.inventory.pull()
    assert len(survey.inventory.truth.commits) == commits


def test_rows_of_an_older_version_lack_columns_and_hold_for_all_that(tmp_path: Path) -> None:
    street = inventory(tmp_path, Everywhere())
    street.record(found(poles()))
    commit = street.truth.commits[0]
    content = sealed_parquet(street.truth.rows(commit).drop_columns(["probability", "message"]), compression="zstd")
    street.truth.store.write_bytes(commit.file, content)
    street.truth._commits = (replace(commit, digest=bytes_digest(content)),)
    assert state_at(street.truth).assets["pole"].rows["probability"].null_count == 6


def test_a_conflict_names_the_pictures_of_its_asset() -> None:
    told = [{"file": "front/0007.jpg", "camera": "front"}, {"file": "rear/0003.jpg", "camera": "rear"}]
    assert pictures_of({"pictures": json.dumps(told)}) == "front/0007.jpg\nrear/0003.jpg"
    assert pictures_of({"pictures": None}) is pictures_of({}) is None


@pytest.mark.slow
def test_two_surveys_share_an_inventory(tmp_path: Path) -> None:
    ids = []
    for name, when in (("spring", None), ("autumn", AUTUMN)):
        folder = tmp_path / name
        folder.mkdir()
        text = SURVEY.replace(
            'epoch = "2026-spring"', f'epoch = "{name}"\nstore = "../shared"\nname = "town"\nhome = "../town.gpkg"'
        )
        (folder / "SURVEY.toml").write_text(text)
        write_found(folder / "SURVEY.toml", poles() if when is None else poles(when=when))
        roadscan.open_survey(folder / "SURVEY.toml").inventory.publish()
        ids.append(person.ids(tmp_path / "town.gpkg", "poles"))
    assert ids[0] == ids[1]
    shown = person.layer(tmp_path / "town.gpkg", "poles")
    assert set(shown["source"]) == {"autumn"} and pd.to_datetime(shown["valid_from"]).dt.month.eq(5).all()


@pytest.mark.slow
def test_the_report_tells_of_assets_conflicts_and_changes(survey_file: Path) -> None:
    survey = roadscan.open_survey(survey_file)
    section = next(one for one in sections() if one.name == "inventory")
    assert list(section.blocks(Material(survey.session))) == []
    survey.inventory.publish()
    first = person.ids(survey_file.parent / "inventory.gpkg", "poles")[0]
    person.edit(survey_file.parent / "inventory.gpkg", "poles", first, asset_height_m=9.0)
    survey.inventory.pull(who="<eva>")
    survey_file.write_text(SURVEY.replace("2026-spring", "2026-autumn"))
    later = roadscan.open_survey(survey_file)
    street = [*poles(when=AUTUMN, asset_height_m=6.0), asset("pole", (200, 4, 100), when=AUTUMN)]
    later.inventory.record(found(street, "2026-autumn"))
    blocks = list(section.blocks(Material(later.session)))
    counts, warning, conflicts, told, changes, drawing = blocks
    assert ("Pole", "7", "0", "0", "0") in counts.rows
    assert warning.is_warning and conflicts.rows[0][:3] == (first, "asset_height_m", "evidence")
    assert told.text.startswith("From 2026-spring to 2026-autumn: 1 appeared, 0 gone, 0 moved, 6 changed.")
    assert len(changes.rows) == len(drawing.marks) == 7
    page = later.report()
    assert "&lt;eva&gt;" in page and "<eva>" not in page
