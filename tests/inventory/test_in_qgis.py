"""QGIS itself opens the inventory: layers, styles, forms and value lists; what is edited there is what a pull takes.

Debian's QGIS has a Python of its own, in which `in_qgis.py` does what these tests ask for.
"""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import shapely
from affine import Affine
from PIL import Image

from roadscan.inventory.home import CHOICES, FaultyEditsError, HomeError
from roadscan.inventory.homes.postgis import PostGis
from roadscan.inventory.inventory import Inventory
from roadscan.inventory.qgis import Raster
from roadscan.store.asset_schema import asset_columns, asset_kind_names, asset_schema, editable_columns
from tests.inventory.postgres import server
from tests.inventory.streets import AUTUMN, CRS, EAST, NORTH, Everywhere, asset, found, inventory, poles

PYTHON = "/usr/bin/python3"
PROGRAM = Path(__file__).with_name("in_qgis.py")
KINDS = {asset_schema(kind).title: kind for kind in asset_kind_names()}
pytestmark = [pytest.mark.nightly, pytest.mark.timeout(600)]


def has_qgis() -> bool:
    words = [PYTHON, "-c", "import qgis.core"]
    return Path(PYTHON).exists() and subprocess.run(words, capture_output=True, check=False).returncode == 0


@pytest.fixture(scope="module", autouse=True)
def _qgis() -> None:
    if not has_qgis():
        pytest.skip("QGIS is not installed: `apt-get install python3-qgis qgis-providers`")


@pytest.fixture
def street(tmp_path: Path) -> Inventory:
    """Assets of a point, a line and an area in two epochs, one edit that the second contradicts, and a hillshade."""
    made = inventory(tmp_path, Everywhere(), kinds=None)
    made.rasters = lambda folder: [Raster("hillshade", "hillshade.tif")]
    shade = np.tile(np.arange(100, 250, dtype=np.uint8), (40, 1))
    place = Affine(1.0, 0.0, EAST - 10, 0.0, -1.0, NORTH + 15)
    with rasterio.open(
        tmp_path / "hillshade.tif", "w", driver="GTiff", width=150, height=40, count=1, dtype="uint8", crs=CRS,
        transform=place,
    ) as file:  # fmt: skip
        file.write(shade, 1)
    made.record(found(things(6)))
    made.publish()
    qgis(
        made, "edit", steps=[{"do": "change", "layer": "Pole", "asset": ids(made)[4], "values": {"asset_height_m": 9}}]
    )
    made.pull(who="max")
    made.record(found(things(5, when=AUTUMN, asset_height_m=6.0), "autumn"))
    made.publish()
    return made


def things(count: int, **values: Any) -> list[dict[str, Any]]:
    walk = asset("sidewalk", (0, 5, 100), (120, 5, 100), (120, 8, 100), (0, 8, 100))
    kerb = asset("kerb", (0, 3, 100), (120, 3, 100))
    sign = asset("sign", (50.0, -4.0, 103.0), message="STOP", width_m=0.6)
    return [*poles(count, **values), walk, kerb, sign]


def ids(street: Inventory, kind: str = "pole") -> list[str]:
    return list(street.assets(kind).sort_values("station_m")["asset_id"])


@contextmanager
def opened(street: Inventory, do: str, **task: Any) -> Iterator[dict[str, Any]]:
    """What QGIS makes of the project of an inventory, which it has open until the block ends."""
    project = street.home.project_file
    assert project is not None
    folder = project.parent / "qgis"  # where it keeps its own settings
    folder.mkdir(exist_ok=True, mode=0o700)
    complaints = folder / "complaints"
    with (
        complaints.open("w") as stream,
        subprocess.Popen(
            [PYTHON, str(PROGRAM)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stream, text=True,
            env={"PATH": os.defpath, "HOME": str(folder), "XDG_RUNTIME_DIR": str(folder), "PGUSER": "admin"},
        ) as program,
    ):  # fmt: skip
        assert program.stdin is not None and program.stdout is not None
        print(json.dumps({"do": do, "project": str(project), **task}), file=program.stdin, flush=True)
        line = next((one for one in program.stdout if one.startswith("{")), None)
        assert line is not None, complaints.read_text()
        answer: dict[str, Any] = json.loads(line)
        assert answer.pop("messages") == []
        yield answer
        program.stdin.close()
    told = complaints.read_text().lower()
    assert "warning" not in told and "error" not in told, told


def qgis(street: Inventory, do: str, **task: Any) -> dict[str, Any]:
    """The same when QGIS has closed it again."""
    with opened(street, do, **task) as answer:
        return answer


def test_all_layers_styles_forms_and_value_lists_are_there(street: Inventory) -> None:
    told = qgis(street, "look")
    assert (told["crs"], told["title"]) == (CRS, "Inventory street")
    layers = told["layers"]
    assert layers.keys() == {*KINDS, "Conflicts", "Changes", "hillshade"} == set(told["order"])
    assert all(layer["valid"] and layer["crs"] == CRS for layer in layers.values())
    assert told["order"][:2] == ["Conflicts", "Changes"] and told["order"][-1] == "hillshade"
    shown = {"Pole": 6, "Kerb": 1, "Sidewalk": 1, "Road Signs/Boards": 1, "Conflicts": 1, "Changes": 6}
    assert {name: layers[name]["features"] for name in shown} == shown
    for title, kind in KINDS.items():
        check_form(layers[title], kind)
    decision = layers["Conflicts"]["fields"]["decision"]
    assert (decision["widget"], decision["values"], decision["locked"]) == ("ValueMap", ["", *CHOICES], False)
    assert layers["Conflicts"]["fields"]["edit"]["locked"] and layers["Conflicts"]["renderer_alone"] == []
    assert [value for value, *_ in layers["Changes"]["renderer_alone"]] == ["appeared", "gone", "moved", "changed"]


def check_form(layer: dict[str, Any], kind: str) -> None:
    """A layer as the project shows it, and as its file does alone."""
    assert [(v, o) for v, _, o in layer["renderer"]] == [
        ("found", 1.0), ("confirmed", 1.0), ("missing", 0.45), ("rejected", 0.15),
    ]  # fmt: skip
    assert layer["renderer"] == layer["renderer_alone"] and layer["fields"] == layer["fields_alone"]
    assert layer["tabs"] == [asset_schema(kind).title, "Measured"]
    assert layer["fields"].keys() == {"fid", *(c.name for c in asset_columns(kind))}
    for column in asset_columns(kind):
        field = layer["fields"][column.name]
        assert field["locked"] == (column.name not in editable_columns(kind)), (kind, column.name)
        assert field["title"].startswith(column.title)
        if column.values and not field["locked"]:
            assert field["values"] == [""] * column.nullable + list(column.values)
        assert bool(field["rule"]) == bool(column.values or column.min is not None or column.max is not None)
    assert (layer["fields"]["condition"]["widget"], layer["fields"]["condition"]["range"]) == ("Range", [1, 10])
    assert layer["fields"]["status"]["default"] == "'confirmed'"


def test_a_pull_takes_exactly_what_was_edited_in_qgis(street: Inventory) -> None:
    first, second, third, _, fifth, *_ = ids(street)
    sign = ids(street, "sign")[0]
    moved, drawn = shapely.Point(EAST + 20.4, NORTH + 4.0, 101.5), shapely.Point(EAST + 3, NORTH - 6, 100.25)
    line = shapely.LineString([(EAST + 5, NORTH - 3, 100.0), (EAST + 25, NORTH - 3, 100.5)])
    steps = [
        {"do": "change", "layer": "Pole", "asset": first, "values": {"condition": 4, "comments": "leans, é 'x'"}},
        {"do": "change", "layer": "Pole", "asset": second, "wkt": moved.wkt},
        {"do": "delete", "layer": "Pole", "asset": third},
        {"do": "draw", "layer": "Pole", "wkt": drawn.wkt, "values": {"asset_height_m": 4.5}},
        {"do": "draw", "layer": "Kerb", "wkt": line.wkt},
        {"do": "change", "layer": "Road Signs/Boards", "asset": sign, "values": {"shape": "octagon"}},
        {"do": "change", "layer": "Conflicts", "asset": fifth, "values": {"decision": "evidence"}},
    ]
    assert qgis(street, "edit", steps=steps)["broken"] == [[]] * len(steps)
    done = street.pull(who="eva")
    new = {e.kind: e.asset_id for e in done.edits if e.action == "create"}
    assert {(e.asset_id, e.attribute, e.action, e.new) for e in done.edits} == {
        (first, "condition", "set", "4"), (first, "comments", "set", '"leans, é \'x\'"'),
        (second, "geometry", "set", told(moved)), (third, "status", "set", '"rejected"'),
        (new["pole"], "geometry", "create", told(drawn)), (new["pole"], "status", "set", '"confirmed"'),
        (new["pole"], "asset_height_m", "set", "4.5"), (new["kerb"], "geometry", "create", told(line)),
        (new["kerb"], "status", "set", '"confirmed"'), (sign, "shape", "set", '"octagon"'),
        (fifth, "asset_height_m", "withdraw", "6.0"),
    }  # fmt: skip
    assert street.pull().commit is None
    street.publish()
    assert qgis(street, "look")["layers"]["Pole"]["features"] == 6
    assert street.conflicts() == [] and street.pull().commit is None


def told(shape: Any) -> str:
    return f'"{shapely.to_wkb(shape, flavor="iso", byte_order=1).hex()}"'


def test_what_the_form_refuses_a_pull_names(street: Inventory) -> None:
    first, second, *_ = ids(street)
    steps = [
        {"do": "change", "layer": "Pole", "asset": first, "values": {"condition": 11, "lean_deg": 91.0}},
        {"do": "change", "layer": "Pole", "asset": second, "values": {"status": "gone"}},
        {"do": "draw", "layer": "Pole", "wkt": f"POINT Z({EAST + 3} {NORTH - 6} 0)"},  # as QGIS draws
    ]
    assert qgis(street, "edit", steps=steps)["broken"] == [["condition", "lean_deg"], ["status"], []]
    with pytest.raises(FaultyEditsError) as error:
        street.pull()
    assert sorted(f.reason.partition(":")[0] for f in error.value.faults) == [
        "condition is 11, above 10", "its height is 0, and assets around it stand at 102.0", "lean_deg is 91, above 90",
        "status is 'gone', expected one of found, missing, confirmed, rejected",
    ]  # fmt: skip


def test_while_qgis_has_the_file_open_a_pull_works_and_a_publication_is_told(street: Inventory) -> None:
    step = {"do": "change", "layer": "Pole", "asset": ids(street)[0], "values": {"condition": 4}}
    with opened(street, "edit", steps=[step]):
        assert [(e.attribute, e.new) for e in street.pull().edits] == [("condition", "4")]
        with pytest.raises(HomeError, match="another program has the GeoPackage open"):
            street.publish()
    street.publish()
    assert street.pull().commit is None


def test_the_map_shows_each_kind_over_the_hillshade(street: Inventory, tmp_path: Path) -> None:
    file = tmp_path / "map.png"
    assert qgis(street, "draw", file=str(file), around=["Pole", "Sidewalk", "Road Signs/Boards"])["errors"] == []
    picture = np.asarray(Image.open(file).convert("RGB")).reshape(-1, 3)
    layers = qgis(street, "look")["layers"]
    for title in ("Pole", "Kerb", "Road Signs/Boards"):
        colour = layers[title]["renderer"][0][1]
        wanted = [int(colour[at : at + 2], 16) for at in (1, 3, 5)]
        assert (picture == wanted).all(axis=1).sum() > 20, title
    gone = next(colour for change, colour, _ in layers["Changes"]["renderer"] if change == "gone")
    assert (picture == [int(gone[at : at + 2], 16) for at in (1, 3, 5)]).all(axis=1).sum() > 20
    assert (np.ptp(picture, axis=1) == 0).sum() > 100_000  # the hillshade's greys
    assert len(np.unique(picture[np.ptp(picture, axis=1) == 0], axis=0)) > 50


def test_the_project_on_postgis_opens_and_is_edited(tmp_path: Path) -> None:
    pytest.importorskip("psycopg")
    with server() as address:
        made = inventory(tmp_path, Everywhere())
        made.home = PostGis(address, "street", 32632, project=tmp_path / "inventory-postgis.qgs")
        made.record(found(things(6)))
        made.publish()
        layers = qgis(made, "look")["layers"]
        assert layers.keys() == {*KINDS, "Conflicts", "Changes"}
        assert all(layer["valid"] and layer["crs"] == CRS for layer in layers.values())
        assert layers["Pole"]["features"] == 6 and layers["Pole"]["fields"]["condition"]["range"] == [1, 10]
        first, second, third, *_ = ids(made)
        moved = shapely.Point(EAST + 20.4, NORTH + 4.0, 101.5)
        steps = [
            {"do": "change", "layer": "Pole", "asset": first, "values": {"condition": 4}},
            {"do": "change", "layer": "Pole", "asset": second, "wkt": moved.wkt},
            {"do": "delete", "layer": "Pole", "asset": third},
            {"do": "draw", "layer": "Pole", "wkt": f"POINT Z({EAST + 3} {NORTH - 6} 100.25)"},
        ]
        assert qgis(made, "edit", steps=steps)["broken"] == [[]] * len(steps)
        done = made.pull()
        new = next(e.asset_id for e in done.edits if e.action == "create")
        assert {(e.asset_id, e.attribute, e.who) for e in done.edits} == {
            (first, "condition", "admin"), (second, "geometry", "admin"), (third, "status", "admin"),
            (new, "geometry", "admin"), (new, "status", "admin"),
        }  # fmt: skip
