"""A published site: documents as docs/viewer.md says, places as the survey's, the same bytes for the same store."""

from __future__ import annotations

import base64
import io
import json
import random
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import geopandas
import laspy
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pyproj
import pytest
import shapely
from PIL import Image
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from roadscan.cli import app
from roadscan.core.errors import ConfigError
from roadscan.core.survey import Survey
from roadscan.georeference.plan.plan import plan_of
from roadscan.inventory.of_survey import truth_of
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Session
from roadscan.run.stage import stages
from roadscan.simulate import simulate, truth
from roadscan.site import web_part
from roadscan.site.document import json_bytes
from roadscan.site.doors import EditDoor
from roadscan.site.layer import BELOW_TO_ABOVE, title_of
from roadscan.site.live import LiveSite, open_survey
from roadscan.site.material import Material, Wishes, box_from_text, box_of_road
from roadscan.site.parts import strips, vectors
from roadscan.site.parts.edits import Edits
from roadscan.site.parts.rasters import images_of
from roadscan.site.parts.strips import Strips
from roadscan.site.parts.vectors import Features
from roadscan.site.report_copy import REPORT
from roadscan.site.single import write_single
from roadscan.site.site import KEYS, Published, entry, publish
from roadscan.site.site_rasters import Place, Raster, coarser_picture
from roadscan.site.thumbnail import thumbnail
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import OutputRecord
from roadscan.survey.run import run_stages
from roadscan.tiles.cells import read_cells
from roadscan.tiles.products.geo_table import write_geo_table
from roadscan.tiles.tasks.tile_plan import TILE
from tests.drawing import drawn
from tests.inventory.streets import EAST, NORTH, asset, found
from tests.surveys import Lines, Simulated, small_scene

PAGE = Path(__file__).resolve().parents[2] / "docs" / "viewer.md"
SINGLE = "<!doctype html><html><head><title>s</title></head><body><!--roadscan-data--><p id=a></p></body></html>"
SAFE = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_./-]*")


def opened(survey_file: Path) -> Session:
    """A session on a survey."""
    return Session(Survey.load(survey_file), Simulated(survey_file).store(), Inline(), None, Lines())


@pytest.fixture(scope="module")
def survey_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """14 m of a road with a camera and the condition of its lanes, run once."""
    scene = small_scene(
        noise={"position_m": 0.0, "attitude_deg": 0.0},
        camera={"on": True, "every_m": 5.0, "width_px": 64, "height_px": 64, "mount": {"pitch_deg": -28.0}},
    )
    file = simulate(scene, tmp_path_factory.mktemp("site") / "survey").survey_file
    with file.open("a") as survey:
        survey.write("\n[condition]\nsection_m = 10\n")
        names = ("las", "hillshade", "mosaic", "tile_table", "pavement_intensity", "pavement_shaded")
        survey.write(f"\n[products]\nmake = {json.dumps(names)}\n")
        survey.write("\n[products.options.pavement_intensity]\nblack = 2000\nwhite = 30000\n")
        survey.write("\n[products.options.pavement_shaded]\naltitude_deg = 30\n")
    run_stages(opened(file), stages())
    return file


@pytest.fixture(scope="module")
def published(survey_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Published:
    """Its site."""
    return publish(Material(opened(survey_file)), tmp_path_factory.mktemp("out") / "site")


def read(published: Published, path: str) -> Any:
    """A document of the site."""
    return json.loads((published.folder / path).read_bytes())


def members(value: Any) -> Iterator[str]:
    """All names of members of a document."""
    if isinstance(value, dict):
        for name, one in value.items():
            yield name
            yield from members(one)
    elif isinstance(value, list):
        for one in value:
            yield from members(one)


def urls(value: Any) -> Iterator[str]:
    """All paths that a document names."""
    if isinstance(value, dict):
        for name, one in value.items():
            if name in ("url", "tiles", "collection", "items", "points") and isinstance(one, str):
                yield one
            yield from urls(one)
    elif isinstance(value, list):
        for one in value:
            yield from urls(one)


@pytest.mark.slow
def test_every_document_that_is_named_is_there_and_every_member_is_told(published: Published) -> None:
    assert not published.failures
    entry = read(published, "survey.json")
    assert entry["left_out"] == []
    names = {"survey.json"} | {part["url"] for layer in entry["layers"] for part in layer["parts"]}
    names |= {entry[part]["url"] for part in ("clouds", "strips", "pictures")}
    names |= {level["tiles"] for level in entry["raster_grid"]["levels"]} | set(entry["catalog"].values())
    page = PAGE.read_text()
    for name in sorted(n for n in names if n.endswith(".json") and not n.startswith("catalog/")):
        document = read(published, name)
        for url in urls(document) if not name.startswith("layers/") and name != "survey.json" else ():
            names.add(url)
        told = {m for m in members(document) if not name.startswith("layers/")}
        missing = {m for m in told - {"type"} if not re.search(rf"`{m}`|\b{m}\b", page)}
        assert not missing, (name, missing)
    files = {f.relative_to(published.folder).as_posix() for f in published.folder.rglob("*") if f.is_file()}
    assert {name for name in names if name not in files} == set()
    assert all(SAFE.fullmatch(name) for name in files)
    for level in entry["raster_grid"]["levels"]:
        rows = read(published, level["tiles"])["rows"]
        there = {f"{c}_{row}.png" for row, runs in rows for a, b in runs for c in range(a, b + 1)}
        assert len(there) == level["count"]
        for raster in entry["rasters"]:
            folder = published.folder / "rasters" / raster["name"] / str(level["level"])
            assert {f.name for f in folder.iterdir()} == there


@pytest.mark.slow
def test_heights_read_back_are_those_of_the_cells(survey_file: Path, published: Published) -> None:
    session, entry = opened(survey_file), read(published, "survey.json")
    grid, level = plan_of(session).ground.grid, entry["raster_grid"]["levels"][0]
    height = next(r for r in entry["rasters"] if r["name"] == "height")
    assert level["pixel_m"] == grid.cell_m
    compared = 0
    for record in [r for r in session.manifest.of(TILE).values() if r.path][:3]:
        cells = read_cells(session.store, record, grid.cells_per_edge)
        box = grid.bounds(cells.tile)
        for k in range(0, len(cells), max(1, len(cells) // 40)):
            easting = box.easting_min_m + (cells.column[k] + 0.5) * grid.cell_m
            northing = box.northing_min_m + (cells.row[k] + 0.5) * grid.cell_m
            column, row = int(easting // level["tile_m"]), int(northing // level["tile_m"])
            path = height["url"].format(level=0, column=column, row=row)
            picture = np.asarray(Image.open(published.folder / path))
            x = int((easting - column * level["tile_m"]) / level["pixel_m"])
            y = int(((row + 1) * level["tile_m"] - northing) / level["pixel_m"])
            red, green, blue, opacity = picture[y, x].tolist()
            assert opacity == 255
            value_m = height["offset"] + height["step"] * (65536 * red + 256 * green + blue)
            assert value_m == pytest.approx(cells.height_robust_m[k], abs=0.51 * height["step"])
            compared += 1
    assert compared > 60


def heights_of(published: Published, level: int) -> dict[tuple[int, int], int]:
    """Numbers that stand for heights, by column and row of the pixel on the map."""
    entry = read(published, "survey.json")
    height = next(r for r in entry["rasters"] if r["name"] == "height")
    edge, found = entry["raster_grid"]["tile_px"], {}
    for row, runs in read(published, entry["raster_grid"]["levels"][level]["tiles"])["rows"]:
        for column in (c for a, b in runs for c in range(a, b + 1)):
            path = height["url"].format(level=level, column=column, row=row)
            picture = np.asarray(Image.open(published.folder / path)).astype(np.int64)
            number = 65536 * picture[..., 0] + 256 * picture[..., 1] + picture[..., 2]
            for y, x in np.argwhere(picture[..., 3] > 0).tolist():
                found[column * edge + x, (row + 1) * edge - 1 - y] = int(number[y, x])
    return found


@pytest.mark.slow
def test_pixels_of_the_next_level_are_means_of_the_finest(published: Published) -> None:
    levels = read(published, "survey.json")["raster_grid"]["levels"]
    factor = round(levels[1]["pixel_m"] / levels[0]["pixel_m"])
    own: dict[tuple[int, int], list[int]] = {}
    for (column, row), number in heights_of(published, 0).items():
        own.setdefault((column // factor, row // factor), []).append(number)
    coarse = heights_of(published, 1)
    assert coarse.keys() == own.keys() and len(coarse) > 100
    assert max(abs(number - np.mean(own[place])) for place, number in coarse.items()) <= 1.01


@pytest.mark.parametrize("raster", ["height", "intensity"])
def test_a_coarser_picture_is_the_mean_of_four_by_four_known_pixels(raster: Raster, tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    edge, place = 8, Place(3, -2, 5)
    bands = 4 if raster == "height" else 2
    held: dict[Place, Path] = {}
    whole = np.zeros((4 * edge, 4 * edge, bands), np.uint8)
    for right, up in ((0, 0), (3, 1), (2, 3)):
        picture = rng.integers(0, 256, (edge, edge, bands)).astype(np.uint8)
        picture[..., -1] = np.where(rng.random((edge, edge)) < 0.6, 255, 0)
        finer = Place(2, 4 * place.column + right, 4 * place.row + up)
        held[finer] = tmp_path / f"{right}{up}.png"
        Image.fromarray(picture).save(held[finer])
        top = (3 - up) * edge
        whole[top : top + edge, right * edge : (right + 1) * edge] = picture
    coarser_picture(tmp_path / "out.png", raster, held.get, place, edge)
    out = np.asarray(Image.open(tmp_path / "out.png")).astype(int)
    for y in range(edge):
        for x in range(edge):
            block = whole[4 * y : 4 * y + 4, 4 * x : 4 * x + 4].reshape(-1, bands).astype(int)
            known = block[block[:, -1] > 0]
            assert out[y, x, -1] == (255 if len(known) else 0)
            if len(known):
                weights = [65536, 256, 1] if bands == 4 else [1]
                assert out[y, x, :-1] @ weights == round(float(np.mean(known[:, :-1] @ weights)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pavement_intensity", "pavement_shaded"])
def test_the_pavement_on_the_map_is_that_of_its_pictures(name: str, survey_file: Path, published: Published) -> None:
    """Pixel by pixel the product's own file, without the cells along the tile's border, where neighbours differ."""
    session, entry = opened(survey_file), read(published, "survey.json")
    raster = next(one for one in entry["rasters"] if one["name"] == name)
    level, compared = entry["raster_grid"]["levels"][0], 0
    for record in [r for r in session.manifest.of(name).values() if r.path.endswith(".png")][:3]:
        own = np.asarray(Image.open(io.BytesIO(session.store.read_bytes(record.path))))
        place = session.store.read_bytes(record.path.replace(".png", ".pgw")).decode().split()
        west, north = float(place[4]), float(place[5])  # the middle of the upper left pixel
        for y, x in np.argwhere(own > 0)[::11].tolist():
            easting, northing = west + x * level["pixel_m"], north - y * level["pixel_m"]
            if min(easting % 10.0, northing % 10.0, -easting % 10.0, -northing % 10.0) < 2 * level["pixel_m"]:
                continue
            column, row = int(easting // level["tile_m"]), int(northing // level["tile_m"])
            picture = np.asarray(Image.open(published.folder / raster["url"].format(level=0, column=column, row=row)))
            at = (
                int(((row + 1) * level["tile_m"] - northing) / level["pixel_m"]),
                int((easting - column * level["tile_m"]) / level["pixel_m"]),
            )
            assert abs(int(picture[at][0]) - int(own[y, x])) <= (0 if name == "pavement_intensity" else 1)
            compared += 1
    assert compared > 50
    if name == "pavement_intensity":
        assert raster["offset"] + raster["step"] == pytest.approx(2000.0)
        assert raster["offset"] + 255 * raster["step"] == pytest.approx(30000.0)


@pytest.mark.slow
def test_a_long_lane_has_bins_and_pieces(
    survey_file: Path, published: Published, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(strips, "_WHOLE_M", 5.0)
    monkeypatch.setattr(strips, "_BINS", 4)
    documents = {d.path: d for d in Strips().documents(Material(opened(survey_file)))}

    def written(path: str) -> Any:
        documents[path].write(tmp_path / "one.json", Path)
        return json.loads((tmp_path / "one.json").read_bytes())

    binned = 0
    for lane in written("strips/index.json")["lanes"]:
        whole = {(s["quantity"], s["extent"]): s for s in read(published, lane["url"])["series"]}
        coarse = {(s["quantity"], s["extent"]): s for s in written(lane["url"])["series"]}
        assert coarse.keys() == whole.keys()
        pieces = [written(piece["url"]) for piece in lane["pieces"]]
        assert [p["from_m"] for p in pieces[1:]] == [p["to_m"] for p in pieces[:-1]]
        for name, own in whole.items():
            held = [s for p in pieces for s in p["series"] if (s["quantity"], s["extent"]) == name]
            for column in ("from_m", "to_m", "value", "sigma", "reason"):
                assert [one for part in held for one in part[column]] == own[column]
            bins = coarse[name]
            if "low" not in bins:
                assert bins == own and len(own["value"]) <= 8
                continue
            middle = (np.array(own["from_m"]) + own["to_m"]) / 2
            value, binned = np.array(own["value"], float), binned + 1
            for k, (a, b) in enumerate(zip(bins["from_m"], bins["to_m"], strict=True)):
                inside = value[(middle >= a) & ((middle < b) | (k == 3)) & ~np.isnan(value)]
                told = [bins[n][k] for n in ("low", "value", "high")]
                expected = [inside.min(), inside.mean(), inside.max()] if inside.size else [None] * 3
                assert told == (pytest.approx(expected, rel=1e-5) if inside.size else expected)
    assert binned > 3


@pytest.mark.slow
def test_evidence_names_what_the_site_holds(published: Published) -> None:
    entry = read(published, "survey.json")
    features = {
        layer["name"]: [f for part in layer["parts"] for f in read(published, part["url"])["features"]]
        for layer in entry["layers"]
    }
    passes = {str(one["properties"]["pass"]) for one in features["passes"]}
    logs = [one["title"] for feature in features["passes"] for one in feature["evidence"]]
    assert any("camera: " in title for title in logs) and len(set(logs)) > 3
    shown = {one["row"] for feature in features["tiles"] for one in feature.get("evidence", ())}
    assert shown == passes
    index = read(published, "strips/index.json")
    lanes = {(lane["road"], lane["lane"]) for lane in index["lanes"]}
    for feature in features["condition_sections"]:
        (station,) = feature["evidence"]
        assert (station["road"], station["lane"]) in lanes
        assert station["station_m"] == pytest.approx(feature["properties"]["station_from_m"], abs=1e-3)


@pytest.mark.slow
def test_a_cloud_holds_every_point_of_the_survey_once(survey_file: Path, published: Published) -> None:
    session, index = opened(survey_file), read(published, "clouds/index.json")
    places, passes = [], []
    for sheet in index["sheets"]:
        with laspy.CopcReader.open(published.folder / sheet["url"]) as reader:
            points = reader.query()
        assert len(points) == sheet["points"]
        west, south, low, east, north, high = sheet["bounds_m"]
        xyz = np.stack([points.x, points.y, points.z], axis=-1)
        assert (xyz >= [west, south, low - 1e-4]).all() and (xyz <= [east, north, high + 1e-4]).all()
        places.append(xyz)
        passes.append(points.point_source_id)
    held = sum(r.figures()["points"] for r in session.manifest.of(TILE).values() if r.path)
    assert index["points"] == held == sum(map(len, places))
    assert set(np.concatenate(passes).tolist()) == {one["pass"] for one in index["passes"]}
    path = next(r.path for r in session.manifest.of("las").values() if r.path)
    las = laspy.read(io.BytesIO(session.store.read_bytes(path)))
    wanted = {tuple(one) for one in np.round(np.stack([las.x, las.y, las.z, las.gps_time], axis=-1), 4).tolist()}
    assert len(wanted) > 100
    whole = np.round(np.concatenate(places), 4)
    assert {one[:3] for one in wanted} <= set(map(tuple, whole.tolist()))


@pytest.mark.slow
def test_strips_hold_the_values_of_the_tables(survey_file: Path, published: Published) -> None:
    session, index = opened(survey_file), read(published, "strips/index.json")
    assert {lane["lane"] for lane in index["lanes"]} == {"1", "2"}
    for lane in index["lanes"]:
        strip = read(published, lane["url"])
        assert strip["line"]["station_m"] == sorted(strip["line"]["station_m"])
        records = [r for r in session.manifest.all() if f"/rut_wire/{lane['road']}/{lane['lane']}/" in r.path]
        rows = [row for r in records for row in session.store.read_table(r.path).to_pylist()]
        series = {(s["quantity"], s["extent"]): s for s in strip["series"]}
        own = series["rut_depth_left_mm", "cross_section"]
        expected = sorted(
            (r["station_from_m"], r["value"]) for r in rows
            if (r["quantity"], r["extent"]) == ("rut_depth_left_mm", "cross_section")
        )  # fmt: skip
        assert expected and [one for one, _ in expected] == own["from_m"]
        known = [(a, b) for (_, a), b in zip(expected, own["value"], strict=True) if b is not None]
        assert all(a == b for a, b in known) and known
        for part in lane["cross_sections"]:
            for section in read(published, part["url"])["sections"]:
                assert part["from_m"] <= section["station_m"] <= part["to_m"]
                assert 0.0 <= section["direction_deg"] < 360.0
    crossing = next(r for r in session.manifest.all() if r.product == "cross_sections" and r.path)
    row = session.store.read_table(crossing.path).to_pylist()[0]
    told = [s for lane in index["lanes"] for p in lane["cross_sections"] for s in read(published, p["url"])["sections"]]
    same = next(s for s in told if s["easting_m"] == row["easting_m"] and s["northing_m"] == row["northing_m"])
    heights = [None if v is None else same["height_m"] + v / 1000 for v in same["relative_height_mm"]]
    for height, true in zip(heights, row["relative_height_m"], strict=True):
        assert (height is None) == np.isnan(true)
        assert height is None or height == pytest.approx(row["height_m"] + true, abs=1e-5)


@pytest.mark.slow
def test_the_direction_of_travel_is_that_of_the_drive(published: Published) -> None:
    """The truth drives lane 2 forward and lane 1 backward; the passes say so."""
    index = read(published, "strips/index.json")
    turned = {}
    for lane in index["lanes"]:
        line = read(published, lane["url"])["line"]
        east, north = (line[a][-1] - line[a][0] for a in ("easting_m", "northing_m"))
        along = np.degrees(np.arctan2(east, north)) % 360.0
        section = read(published, lane["cross_sections"][0]["url"])["sections"][0]
        turned[lane["direction"]] = (section["direction_deg"] - along + 180.0) % 360.0 - 180.0
    assert abs(turned["forward"]) < 5.0
    assert abs(abs(turned["backward"]) - 180.0) < 5.0


@pytest.mark.slow
def test_points_stand_in_pictures_where_the_true_camera_sees_them(survey_file: Path, published: Published) -> None:
    known = truth.load(survey_file.parent)
    to_world = pyproj.Transformer.from_crs(pyproj.CRS("EPSG:32632").to_3d(), "EPSG:4978", always_xy=True)
    index = read(published, "pictures/index.json")
    assert {c["run"] for c in index["cameras"]} == {"run-1", "run-2"}
    worst, seen = 0.0, 0
    for part in index["parts"]:
        poses = read(published, part["url"])
        for k in range(poses["pictures"]):
            camera = index["cameras"][poses["camera"][k]]
            name = poses["name"][k].rsplit("/", 1)[-1]
            true = next(r for r in pq.read_table(known.camera_file(camera["run"])).to_pylist() if r["file"] == name)
            assert abs(int(poses["epoch_gps_ns"][k]) - true["epoch_gps_ns"]) < 1000
            raw = survey_file.parent / "raw" / camera["run"] / "camera" / name
            assert (published.folder / poses["url"][k]).read_bytes() == raw.read_bytes()
            eye_m = np.array([poses[n][k] for n in ("easting_m", "northing_m", "height_m")])
            turn = Rotation.from_quat([true[q] for q in ("qx", "qy", "qz", "qw")]).as_matrix()
            ahead_m = eye_m + np.array([[6.0, 4.0, -2.0], [-6.0, -4.0, -2.0], [5.0, 5.0, -2.5], [-5.0, -3.0, -2.5]])
            world = np.stack(to_world.transform(*ahead_m.T), axis=-1)
            body = (world - [true[f"{a}_world_m"] for a in "xyz"]) @ turn  # x ahead, y right, z down
            matrix = np.array(poses["camera_from_map"][k]).reshape(3, 3)
            for one, own in zip(body, (ahead_m - eye_m) @ matrix.T, strict=True):
                if one[0] > 0.5:
                    wanted, found = one[1:] / one[0], own[:2] / own[2]
                    worst = max(worst, float(np.abs(wanted - found).max()) * camera["focal_px"][0])
                    seen += 1
    assert seen > 5
    assert worst < 0.5  # pixels


@pytest.mark.slow
def test_the_same_survey_gives_the_same_bytes_and_nothing_is_made_twice(
    survey_file: Path, published: Published, tmp_path: Path
) -> None:
    other = publish(Material(opened(survey_file)), tmp_path / "site")
    files = {f.relative_to(published.folder): f.read_bytes() for f in published.folder.rglob("*") if f.is_file()}
    assert {f.relative_to(other.folder): f.read_bytes() for f in other.folder.rglob("*") if f.is_file()} == files
    again = publish(Material(opened(survey_file)), tmp_path / "site")
    assert (again.made, again.files, again.bytes) == (0, other.files, other.bytes)
    assert [f.name for f in tmp_path.iterdir()] == ["site"]


@pytest.mark.slow
def test_a_damaged_file_of_a_site_is_named_and_made_again(
    survey_file: Path, published: Published, tmp_path: Path
) -> None:
    site = tmp_path / "site"
    shutil.copytree(published.folder, site)
    files = sorted(f for f in site.rglob("*") if f.is_file() and f.name != KEYS and f.stat().st_size)
    flipped, cut, gone, one, other = random.Random(1).sample(files, 5)
    sound = {f: f.read_bytes() for f in files}
    flipped.write_bytes(bytes([sound[flipped][0] ^ 1]) + sound[flipped][1:])
    cut.write_bytes(sound[cut][:-1])
    gone.unlink()
    one.write_bytes(sound[other])
    other.write_bytes(sound[one])
    again = publish(Material(opened(survey_file)), site)
    assert again.damaged == tuple(sorted(f.relative_to(site).as_posix() for f in (flipped, cut, gone, one, other)))
    assert {f: f.read_bytes() for f in files} == sound
    keys = site / KEYS
    keys.write_bytes(keys.read_bytes().replace(b"blake3", b"blake7", 1))
    with pytest.raises(ConfigError, match=r"keys\.json is damaged"):
        publish(Material(opened(survey_file)), site)


@pytest.mark.slow
def test_a_damaged_tile_costs_its_pictures_and_leaves_a_hole_in_coarser_ones(
    survey_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("roadscan.site.site_rasters._COARSEST_PICTURES", 0)
    file = tmp_path / "survey" / survey_file.name
    shutil.copytree(survey_file.parent, file.parent)
    store = opened(file).store
    at = sorted(store.files("tiles/overviews"))[0]
    sound = store.read_bytes(at)
    store.write_bytes(at, sound[:-1])
    site, wishes = tmp_path / "site", Wishes(clouds=False, pictures=False)
    damaged = publish(Material(opened(file), wishes), site)
    told = dict(damaged.failures)
    lost = {path for path, reason in told.items() if " bytes of " in reason}
    holed = {path for path, reason in told.items() if "was made without" in reason}
    assert lost and holed and lost | holed == set(told)
    assert not any((site / path).exists() for path in lost) and all((site / path).is_file() for path in holed)
    store.write_bytes(at, sound)
    whole = publish(Material(opened(file), wishes), site)
    assert not whole.failures and whole.made == len(told)
    fresh = publish(Material(opened(file), wishes), tmp_path / "fresh")
    files = {f.relative_to(fresh.folder): f.read_bytes() for f in fresh.folder.rglob("*") if f.is_file()}
    again = {f.relative_to(site): f.read_bytes() for f in site.rglob("*") if f.is_file()}
    assert [str(f) for f in sorted({*files, *again}) if files.get(f) != again.get(f)] == []


@pytest.mark.slow
def test_a_folder_of_something_else_is_left_alone(survey_file: Path, tmp_path: Path) -> None:
    (tmp_path / "letters.txt").write_text("dear")
    done = CliRunner().invoke(app, ["publish", str(survey_file), "--out", str(tmp_path)])
    assert done.exit_code != 0 and isinstance(done.exception, ConfigError)
    assert "holds no site" in str(done.exception)
    assert [f.name for f in tmp_path.iterdir()] == ["letters.txt"]


@pytest.mark.slow
def test_part_of_a_survey(survey_file: Path, published: Published, tmp_path: Path) -> None:
    west, south, east, north = read(published, "survey.json")["extent_m"]
    wishes = Wishes(clouds=False, pictures=False, finest_pixel_m=0.15, near=(west, south, west + 5.0, north))
    part = publish(Material(opened(survey_file), wishes), tmp_path / "site")
    entry = read(part, "survey.json")
    assert entry["clouds"] is None and entry["pictures"] is None and entry["cogs"] == []
    assert entry["extent_m"][2] < east and entry["extent_m"][0] == west
    assert entry["raster_grid"]["levels"][0]["pixel_m"] >= 0.15 or len(entry["raster_grid"]["levels"]) == 1
    assert not (part.folder / "clouds").exists()


@pytest.mark.slow
def test_strips_of_another_survey_stand_beside_those_of_this_one(
    survey_file: Path, published: Published, tmp_path: Path
) -> None:
    copy = Simulated(survey_file).copy_with_store_to(tmp_path / "survey")
    text = copy.survey_file.read_text()
    copy.survey_file.write_text(text.replace('id = "demo"', 'id = "later"', 1))
    (copy.survey_file.parent / "store" / "survey=demo").rename(copy.survey_file.parent / "store" / "survey=later")
    later = Session.open(copy.survey_file)
    both = {d.path: d for d in Strips().documents(Material(opened(survey_file), over=(later,)))}
    both["strips/index.json"].write(tmp_path / "index.json", Path)
    lanes = json.loads((tmp_path / "index.json").read_bytes())["lanes"]
    assert [(lane["survey"], lane["lane_id"]) for lane in lanes] == [
        ("demo", 0), ("demo", 1), ("later", 2), ("later", 3),
    ]  # fmt: skip
    both["strips/2.json"].write(tmp_path / "2.json", Path)
    assert json.loads((tmp_path / "2.json").read_bytes())["series"] == read(published, "strips/0.json")["series"]
    with pytest.raises(ConfigError, match="twice"):
        _ = Material(later, over=(later,)).others


@pytest.mark.slow
def test_a_road_is_its_line_and_what_lies_beside_it(survey_file: Path, published: Published) -> None:
    material = Material(opened(survey_file))
    layer = next(one for one in read(published, "survey.json")["layers"] if one["name"] == "reference_lines")
    grown = [v + d for v, d in zip(layer["parts"][0]["bounds_m"], (-20, -20, 20, 20), strict=True)]
    assert box_of_road(material, "road1") == pytest.approx(grown, abs=1e-4)
    with pytest.raises(ConfigError, match="there is no road 'road2'"):
        box_of_road(material, "road2")


@pytest.mark.parametrize("text", ["1,2,3", "1,2,a,4", "5,0,1,2", "0,0,nan,1", ""])
def test_a_box_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="the box"):
        box_from_text(text)


@pytest.mark.slow
def test_layers_open_in_other_programs(survey_file: Path, published: Published, tmp_path: Path) -> None:
    session, entry = opened(survey_file), read(published, "survey.json")
    assert len(entry["features"]) == len(entry["layers"]) > 3
    collection = read(published, "catalog/collection.json")
    for layer, path in zip(entry["layers"], entry["features"], strict=True):
        assert collection["assets"][layer["name"]]["href"] == f"../{path}"
        table = geopandas.read_file(published.folder / path)
        shown = {f["id"]: f for part in layer["parts"] for f in read(published, part["url"])["features"]}
        names = [column["name"] for column in layer["columns"]]
        assert len(table) == len(shown) and set(table.columns) == {*names, "geometry"}
        assert table.crs == pyproj.CRS(plan_of(session).ground.map.crs)
        places = [shapely.geometry.shape(f["geometry"]) for f in shown.values()]
        nearest = [min(one.hausdorff_distance(place) for place in places) for one in table.geometry]
        assert max(nearest) <= 1e-5  # the page's documents state 10 µm
        for name in names:
            told = sorted(str(f["properties"][name]) for f in shown.values())
            numbers = [f["properties"][name] for f in shown.values()]
            if all(isinstance(one, float) for one in numbers):
                assert sorted(table[name]) == pytest.approx(sorted(numbers))
            elif all(isinstance(one, str) and not name.endswith("_gps_ns") for one in numbers):
                assert sorted(table[name]) == told
    again = next(d for d in Features().documents(Material(session)) if d.path == "features/tiles.fgb")
    again.write(tmp_path / "again.fgb", Path)
    assert (tmp_path / "again.fgb").read_bytes() == (published.folder / "features/tiles.fgb").read_bytes()


@pytest.mark.slow
def test_the_catalogue_is_stac(survey_file: Path, published: Published) -> None:
    pystac = pytest.importorskip("pystac", reason="pystac is not installed")
    collection = pystac.Collection.from_file(str(published.folder / "catalog" / "collection.json"))
    items = list(collection.get_items())
    assert collection.id == "demo" and len(items) == len(read(published, "clouds/index.json")["sheets"])
    for item in items:
        for one in item.assets.values():
            assert Path(one.get_absolute_href()).is_file()
        assert item.get_collection() is collection
        item.stac_extensions.clear()  # their schemas lie on the network, those of the core in the library
        item.validate()
    collection.validate()
    table = geopandas.read_parquet(published.folder / "catalog" / "items.parquet")
    assert sorted(table["id"]) == sorted(item.id for item in items)
    assert table.crs.to_epsg() in (4326, None) or table.crs.to_string() == "OGC:CRS84"
    west, south, east, north = read(published, "survey.json")["extent_m"]
    placed = table.to_crs("EPSG:32632").total_bounds
    assert placed == pytest.approx([west, south, east, north], abs=0.01)


@pytest.mark.slow
def test_pictures_are_stac_items(survey_file: Path, published: Published) -> None:
    pystac = pytest.importorskip("pystac", reason="pystac is not installed")
    told = read(published, "survey.json")["picture_items"]
    collection = pystac.Collection.from_file(str(published.folder / told))
    items = list(collection.get_items())
    known = truth.load(survey_file.parent)
    runs = [(run, pq.read_table(known.camera_file(run)).to_pylist()) for run in ("run-1", "run-2")]
    poses = [(run, pose) for run, rows in runs for pose in rows]
    assert len(items) == len(poses) == 6
    to_map = pyproj.Transformer.from_crs("OGC:CRS84", "EPSG:32632", always_xy=True)
    for item, (run, pose) in zip(items, poses, strict=True):
        assert item.properties["title"] == f"{run}/camera/{pose['file']}"
        picture = Path(item.assets["picture"].get_absolute_href())
        assert picture.is_file() and picture.suffix == ".jpg"
        eye = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:32632", always_xy=True).transform(
            *(pose[f"{a}_world_m"] for a in "xyz")
        )
        own = [item.properties[f"roadscan:{n}_m"] for n in ("easting", "northing")]
        assert np.allclose(own, eye[:2], atol=0.02)
        seen = shapely.transform(shapely.geometry.shape(item.geometry), lambda c: np.stack(to_map.transform(*c.T), -1))
        assert seen.geom_type == "Polygon" and 0.5 < seen.distance(shapely.Point(own)) < 6.0
        item.stac_extensions.clear()
        item.validate()
    collection.validate()


@pytest.mark.slow
def test_the_virtual_point_cloud_names_the_sheets(published: Published) -> None:
    virtual, index = read(published, "catalog/points.vpc"), read(published, "clouds/index.json")
    assert sum(f["properties"]["pc:count"] for f in virtual["features"]) == index["points"]
    for feature in virtual["features"]:
        file = published.folder / "catalog" / feature["assets"]["data"]["href"]
        with laspy.open(file) as reader:
            box = feature["properties"]["proj:bbox"]
            assert (reader.header.mins >= np.array(box[:3]) - 1e-4).all()
            assert (reader.header.maxs <= np.array(box[3:]) + 1e-4).all()
        assert pyproj.CRS.from_wkt(feature["properties"]["proj:wkt2"]).to_epsg() == 32632


class Scripts(HTMLParser):
    """What stands in a page's scripts, by path, and how many elements of each kind there are."""

    def __init__(self, page: str) -> None:
        super().__init__(convert_charrefs=False)
        self.held: dict[str, str] = {}
        self.kinds: list[str] = []
        self._path: str | None = None
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.kinds.append(tag)
        self._path = dict(attrs).get("data-path") if tag == "script" else None

    def handle_data(self, data: str) -> None:
        if self._path is not None:
            self.held[self._path] = self.held.get(self._path, "") + data

    def handle_endtag(self, tag: str) -> None:
        self._path = None


@pytest.fixture
def with_page(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A web part of a few bytes."""
    folder = tmp_path / "dist"
    (folder / "app").mkdir(parents=True)
    (folder / "index.html").write_text("<!doctype html>")
    (folder / "app" / "app.js").write_text("1;")
    (folder / "single.html").write_text(SINGLE)
    monkeypatch.setattr(web_part, "web_folder", lambda: folder)
    return folder


@pytest.mark.slow
def test_a_single_file_holds_all(survey_file: Path, published: Published, with_page: Path, tmp_path: Path) -> None:
    made = write_single(Material(opened(survey_file)), tmp_path / "street.html")
    page = Scripts((tmp_path / "street.html").read_text())
    assert made.left_out == () and made.bytes == (tmp_path / "street.html").stat().st_size
    assert {kind for kind in page.kinds if kind != "script"} == {"html", "head", "title", "body", "p"}
    for path, text in page.held.items():
        file = published.folder / path
        if path.endswith(".json"):
            content, true = json.loads(text), json.loads(file.read_bytes())
            assert content == ({**true, "report": None} if path == "survey.json" else true)
        else:
            assert base64.b64decode(text, validate=True) == file.read_bytes()
    known = {path for path in read(published, KEYS)["keys"] if not path.startswith("app/")}  # without a built page
    assert known - set(page.held) <= {
        f.relative_to(published.folder).as_posix()
        for f in published.folder.rglob("*")
        if f.suffix in (".parquet", ".vpc", ".tif", ".vrt", ".fgb", ".html")
    }


@pytest.mark.slow
def test_a_single_file_has_a_limit(survey_file: Path, with_page: Path, tmp_path: Path) -> None:
    material = Material(opened(survey_file), Wishes(clouds=False))
    whole = write_single(material, tmp_path / "whole.html").bytes
    limit_mb = 0.8 * whole / 1e6
    small = write_single(material, tmp_path / "street.html", limit_mb)
    assert small.bytes <= 1e6 * limit_mb and small.left_out[0] == "pictures of cameras"
    with pytest.raises(ConfigError, match="even without"):
        write_single(material, tmp_path / "none.html", 1e-3)
    assert not (tmp_path / "none.html").exists()


@pytest.mark.slow
def test_without_the_page_the_data_are_published_and_it_is_said(
    survey_file: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(web_part, "web_folder", lambda: None)
    done = CliRunner().invoke(app, ["publish", str(survey_file), "--out", str(tmp_path / "site"), "--no-clouds"])
    assert done.exit_code == 0, done.output
    assert "make viewer" in done.output and (tmp_path / "site" / "survey.json").is_file()
    done = CliRunner().invoke(app, ["publish", str(survey_file), "--single", str(tmp_path / "one.html")])
    assert isinstance(done.exception, ConfigError) and "make viewer" in str(done.exception)


@pytest.mark.slow
def test_hostile_names_are_data(survey_file: Path, with_page: Path, tmp_path: Path) -> None:
    nasty = "</script><script>alert(1)</script><!--<img src=x onerror=alert(2)>\u2028'\"&"
    copy = Simulated(survey_file).copy_with_store_to(tmp_path / "survey")
    text = copy.survey_file.read_text().splitlines()
    text = [f"title = {json.dumps(nasty)}" if line.startswith("title") else line for line in text]
    copy.survey_file.write_text("\n".join(text))
    wishes = Wishes(clouds=False, pictures=False)
    write_single(Material(opened(copy.survey_file), wishes), tmp_path / "street.html")
    page = Scripts((tmp_path / "street.html").read_text())
    assert {kind for kind in page.kinds if kind != "script"} == {"html", "head", "title", "body", "p"}
    assert page.kinds.count("script") == len(page.held)
    assert json.loads(page.held["survey.json"])["title"] == nasty


def test_ten_thousand_texts_come_back_and_end_no_element() -> None:
    rng = random.Random(7)
    pieces = [
        "<script>",
        "</script>",
        "<!--",
        "-->",
        "]]>",
        "\\",
        '"',
        "'",
        "&lt;",
        "\u2028",
        "\x00",
        "😀",
        "</",
    ]

    def text() -> str:
        count = rng.randrange(30)
        return "".join(
            rng.choice(pieces) if rng.random() < 0.4 else chr(rng.randrange(1, 0xD800)) for _ in range(count)
        )

    texts = [text() for _ in range(10_000)]
    content = json_bytes(texts)
    assert not set(content) & set(b"<>&")
    assert content.isascii()
    assert json.loads(content) == texts
    page = Scripts(f'<p></p><script type="application/json" data-path="x">{content.decode()}</script><p></p>')
    assert page.kinds == ["p", "script", "p"] and json.loads(page.held["x"]) == texts


def test_what_json_has_no_word_for_is_null_and_long_numbers_are_text() -> None:
    told = json.loads(
        json_bytes({"a": np.float64("nan"), "b": [np.inf, 1.5], "c": 2**60, "d": np.arange(2), "e": None})
    )
    assert told == {"a": None, "b": [None, 1.5], "c": str(2**60), "d": [0, 1], "e": None}


@pytest.mark.slow
def test_a_large_layer_is_cut_into_sheets(survey_file: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(vectors, "_MOST_VERTICES", 10)
    material = Material(opened(survey_file))
    documents = {d.path: d for d in vectors.Vectors().documents(material) if d.path.startswith("layers/tiles/")}
    layer = next(one for one in vectors.Vectors().members(material)["layers"] if one["name"] == "tiles")
    coarse = documents.pop(layer["overview"])
    assert {part["url"] for part in layer["parts"]} == set(documents)
    assert "whole" not in "".join(documents)
    assert sum(part["features"] for part in layer["parts"]) == layer["features"]
    # Who looks from far away gets all features with what colours them, and nothing else.
    coarse.write(tmp_path / "coarse.json", Path)
    features = json.loads((tmp_path / "coarse.json").read_text())["features"]
    assert [one["properties"] for one in features] == [{"state": "done"}] * layer["features"]


@pytest.mark.slow
def test_a_report_that_is_lost_is_told(survey_file: Path, tmp_path: Path) -> None:
    copy = tmp_path / "survey"
    shutil.copytree(survey_file.parent, copy)
    session = opened(copy / survey_file.name)
    assert not publish(Material(session), tmp_path / "site").left_out
    record = session.manifest.get(REPORT, REPORT)
    assert record is not None
    session.store.remove(record.path)
    (told,) = publish(Material(opened(copy / survey_file.name)), tmp_path / "site").left_out
    assert "report.html is missing: `roadscan report` writes it again" in told


@pytest.mark.slow
def test_the_inventory_is_shown_and_edited(survey_file: Path, tmp_path: Path) -> None:
    """What `roadscan view --edit` does: the page's edits are in the site at once, and the page's layers in metres."""
    copy = tmp_path / "survey"
    shutil.copytree(survey_file.parent, copy)
    edited = copy / survey_file.name
    with pytest.raises(ConfigError, match="inventory is empty"):
        Material(opened(edited), Wishes(edits="post")).check_edits()
    session = opened(edited)
    west, south, _, _ = Material(session).extent_m or (0.0,) * 4
    held = truth_of(session)
    held.record(found([asset("pole", (west - EAST + 3.0, south - NORTH + 2.0, 50.0), asset_height_m=5.0)]))
    site = LiveSite(open_survey(edited, edited=True))
    served = site.document("survey.json")
    assert served is not None
    survey = json.loads(served.file.read_bytes())
    (layer,) = (one for one in survey["layers"] if one["name"] == "asset_poles")
    kinds = survey["edits"].pop("kinds")
    assert survey["edits"] == {
        "layers": ["asset_poles"], "forms": "edits/forms.json", "post": "edits",
        "inventory": session.survey.config.id, "commit": 1,
    }  # fmt: skip
    assert {"layer": "asset_trees", "title": "Tree", "geometry": "point"} in kinds
    forms = site.document("edits/forms.json")
    assert forms is not None
    assert {one["layer"] for one in kinds} == set(json.loads(forms.file.read_bytes())["columns"])
    columns = {one["name"]: one.get("edited") for one in layer["columns"]}
    assert columns["condition"] == {"type": "int32", "values": []} and columns["returns"] is None
    assert "rejected" in columns["status"]["values"]
    (pole,) = features_of(site, layer)
    assert pole["geometry"]["coordinates"] == [west + 3.0, south + 2.0, 50.0]
    properties = {"layer": "asset_poles", "action": "change", "asset_id": pole["properties"]["asset_id"]}
    properties["author"] = "mallory"
    document = {
        "type": "FeatureCollection", "coordinates": "map_m", "survey": "s", "inventory": session.survey.config.id,
        "commit": 1,
        "features": [
            {"type": "Feature", "geometry": None, "properties": properties | {"attributes": {"condition": 3}}}
        ],
    }  # fmt: skip
    told = EditDoor(lambda: opened(edited)).take(json.dumps(document).encode(), "ann@example.org")
    # The author is whom the proxy told, whatever the document says.
    assert truth_of(opened(edited)).truth.commits[-1].who == "ann@example.org"
    assert (told["commit"], told["edits"]) == (2, [{"outcome": "accepted", "reason": ""}])
    assert served != site.document("survey.json")  # a page that begins anew sees it
    (pole,) = features_of(site, layer)
    assert pole["properties"]["condition"] == 3
    # The same from a file that a published site saved, by the command line; and without edits a site offers none.
    file = tmp_path / "edits.geojson"
    file.write_text(
        json.dumps(document).replace('"condition": 3', '"condition": 5').replace('"commit": 1', '"commit": 2')
    )
    done = CliRunner().invoke(app, ["inventory", "pull", str(edited), "--home", str(file), "--who", "max"])
    assert done.exit_code == 0 and "commit 3: 1 values of 1 assets" in done.output
    assert Material(opened(edited)).inventory is not None
    assert entry_of(Material(opened(edited)))["edits"] is None
    assert entry_of(Material(opened(edited), Wishes(edits="file")))["edits"]["post"] is None


def features_of(site: LiveSite, layer: dict[str, Any]) -> list[dict[str, Any]]:
    served = site.document(layer["parts"][0]["url"])
    assert served is not None
    features: list[dict[str, Any]] = json.loads(served.file.read_bytes())["features"]
    return features


def entry_of(material: Material) -> dict[str, Any]:
    """What the parts of a site tell of it."""
    return dict(Edits().members(material))


@pytest.mark.slow
def test_heights_of_a_table_are_metres_once(survey_file: Path, tmp_path: Path) -> None:
    """GeoParquet is in the CRS's own units: feet of a map in feet become metres, and no further."""
    copy = tmp_path / "survey"
    shutil.copytree(survey_file.parent, copy)
    material: Any = Material(opened(copy / survey_file.name))
    feet: Any = SimpleNamespace(map=SimpleNamespace(crs=None, horizontal_unit_m=0.3, vertical_unit_m=0.3))
    place = np.array([shapely.Point(30.0, 60.0, 90.0)], object)
    write_geo_table(tmp_path / "t.parquet", pa.table({"a": [1]}), "geometry", place, ["Point Z"], feet)
    content = (tmp_path / "t.parquet").read_bytes()
    material.store.write_bytes("products/t.parquet", content)
    material.__dict__["context"] = feet
    held = material.rows_of([OutputRecord("t", "t", "k", "products/t.parquet", len(content), bytes_digest(content))])
    assert shapely.get_coordinates(held.shapes_m, include_z=True) == pytest.approx(np.array([[30.0, 60.0, 90.0]]))


@pytest.mark.slow
@drawn()
def test_a_thumbnail_shows_the_map(survey_file: Path, tmp_path: Path) -> None:
    material = Material(opened(survey_file))
    west, south, east, north = material.extent_m or (0.0,) * 4
    wide = np.asarray(Image.open(io.BytesIO(thumbnail(material, (west, south, east, north), (300, 200)))))
    assert wide.shape == (200, 300, 3)
    pixels = wide.reshape(-1, 3).astype(int)
    apart = [np.abs(pixels - one).max(axis=1).min() for one in ((213, 94, 0), (0, 114, 178))]
    assert min(apart) <= 60, apart  # a run of the layer of passes, whose thin line is smoothed
    residuals = {tuple(int(one[k : k + 2], 16) for k in (1, 3, 5)) for one in BELOW_TO_ABOVE}
    assert residuals & set(map(tuple, pixels.tolist()))  # a control point
    # The hillshade lies where the finest picture has it: its middle, pixel by pixel.
    images = images_of(material)
    pixel_m = images.pyramid.pixel_m(0)
    place = Place(0, *images.pyramid.places(0)[len(images.pyramid.places(0)) // 2].tolist())
    tile_m = pixel_m * images.pyramid.tile_px
    made = tmp_path / "finest.png"
    images.document("hillshade", place).write(made, Path)
    finest = np.asarray(Image.open(made))
    shade = thumbnail(
        replace(material, wishes=Wishes(near=None)), (place.column * tile_m, place.row * tile_m,
        (place.column + 1) * tile_m, (place.row + 1) * tile_m), (images.pyramid.tile_px,) * 2,
    )  # fmt: skip
    same = np.asarray(Image.open(io.BytesIO(shade)))[..., 0] == finest[..., 0]
    assert same[finest[..., 1] > 0].mean() > 0.8  # the others lie under lines


@pytest.mark.slow
def test_a_survey_without_tiles_is_shown_where_its_layers_are(survey_file: Path) -> None:
    material = Material(opened(survey_file))
    material.__dict__["tiles"] = {}
    entry_of_all: dict[str, Any] = {}

    class Kept:
        def write_bytes(self, content: bytes) -> None:
            entry_of_all.update(json.loads(content))

    kept: Any = Kept()
    entry(material).write(kept, Path)
    west, south, east, north = entry_of_all["extent_m"]
    places = [p["bounds_m"] for layer in entry_of_all["layers"] for p in layer["parts"]]
    assert places and entry_of_all["clouds"] is None and entry_of_all["lon_lat"] is not None
    for box in places:
        assert west <= box[0] and south <= box[1] and box[2] <= east and box[3] <= north


def test_titles_leave_units_to_the_page() -> None:
    """The page puts the unit beside each value: "Crown mean mm mm" says it twice."""
    wanted = {
        ("crown_mean_mm", "mm"): "crown mean", ("cross_slope_mean_percent", "%"): "cross slope mean",
        ("mri_m_per_km", "m/km"): "MRI", ("sigma_size_m", "m"): "σ size", ("epoch_gps_ns", "ns"): "epoch",
        ("ravelling_loss_cm3_per_m2", "cm³/m²"): "ravelling loss", ("joints", "number"): "joints",
    }  # fmt: skip
    assert {one: title_of(*one) for one in wanted} == wanted
