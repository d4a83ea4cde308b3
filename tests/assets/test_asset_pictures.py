"""Pictures of assets on a simulated street with coloured signs, against OpenCV's projection with the true poses."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import geopandas
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

import roadscan
from roadscan.assets.tasks.picture_work import CUT_OUTS, SEEN
from roadscan.core.errors import ConfigError
from roadscan.report.blocks import Picture
from roadscan.report.section import Material
from roadscan.report.sections.assets import Assets as AssetsSection
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.simulate import Scene, simulate, truth
from roadscan.simulate.path import Earth
from roadscan.site.layer import of_pictures as evidence_of_pictures
from roadscan.site.material import Material as SiteMaterial
from roadscan.site.parts.pictures import Pictures
from roadscan.site.parts.vectors import site_layers
from roadscan.store.asset_schema import editable_columns
from roadscan.store.store import Store
from roadscan.survey.run import run_stages
from tests.assets.known_assets import KnownLines, KnownSigns, true_lines, true_signs
from tests.assets.posts import only_kinds
from tests.surveys import Lines, Simulated, changed

SIGNS = [
    {"station_m": 11.0, "offset_m": 4.2, "shape": "octagon", "width_m": 0.75, "colour": "red", "rim": "white"},
    {"station_m": 12.5, "offset_m": -3.4, "shape": "round", "width_m": 0.6, "colour": "blue"},
    {"station_m": 14.0, "offset_m": 4.2, "shape": "triangle", "width_m": 0.9, "rim": "red"},
    {"station_m": 17.0, "offset_m": -2.9, "shape": "diamond", "width_m": 0.75, "colour": "yellow"},
    {"station_m": 17.0, "offset_m": 4.4, "shape": "rectangle", "height_m": 0.9, "colour": "white"},
    {"station_m": 13.5, "offset_m": -2.9, "shape": "rectangle", "colour": "green", "faces": "forward"},
    {"station_m": 12.0, "offset_m": 5.5, "shape": "rectangle", "colour": "brown", "clearance_m": 0.6},
]  # fmt: skip
COLOURS = ["red", "blue", "red", "yellow", "white"]
BACK, BEHIND_VAN = 5, 6
FOCAL, SIZE = 350.0, (400, 250)
CAMERA = {"on": True, "colour": True, "every_m": 3.0, "width_px": SIZE[0], "height_px": SIZE[1], "focal_px": FOCAL,
          "noise": 1.0, "mount": {"lever_arm_body_m": [0.9, -0.25, -1.15], "pitch_deg": -2.0}}  # fmt: skip
SCENE = (
    Scene.load("demo")
    .changed(
        length_m=14.0, passes=[{"lane": 2, "direction": "forward"}], profilers={"on": False}, camera=CAMERA,
        lidar={"range_max_m": 9.0}, vehicle={"speed_m_per_s": 16.0},
        road={"markings": [{"offset_m": 0.0, "width_m": 0.15, "colour": "yellow"}, {"offset_m": 3.4, "width_m": 0.15}]},
        roadside={"signs": SIGNS, "boxes": [
            {"station_m": 7.0, "offset_m": 4.3, "length_m": 4.0, "width_m": 1.0, "height_m": 3.0}]},
    )
    .noiseless()
)  # fmt: skip


def session(street: Simulated, block_returns: int = 6_000_000, **pictures: object) -> Session:
    assets = {
        "tile_m": 10.0,
        "intensity": "raw",
        "max_block_returns": block_returns,
        "pictures": pictures,
    }
    survey = changed(
        roadscan.open_survey(street.survey_file).survey, {"assets": assets, "tiles__size_m": 10.0, "adjust__on": False}
    )
    return Session(survey, Store(str(street.survey_file.parent / "store"), survey.config.id), Inline(), None, Lines())


def run(of: Session, *stages: str) -> Session:
    run_stages(of, [stage_named(name) for name in stages or ("ingest", "navigate", "footprints", "assets")])
    return of


def lines_of(of: Session) -> list[str]:
    assert isinstance(of.reporter, Lines)
    return of.reporter.lines


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Simulated]:
    made = Simulated(simulate(SCENE, tmp_path_factory.mktemp("street") / "survey").survey_file)
    KnownSigns.assets = true_signs(made.survey_file.parent)
    KnownLines.assets = true_lines(made.survey_file.parent)
    with only_kinds(KnownSigns, KnownLines):
        run(session(made))
        yield made


def signs_of(of: Session) -> pd.DataFrame:
    """Table of the signs in the order of the scene."""
    table = geopandas.read_parquet(of.store.path("products/assets/road_signs.parquet"))
    true = np.array([shape.coords[0][:2] for shape, _ in KnownSigns.assets])
    own = [int(np.hypot(*(table[["easting_m", "northing_m"]].to_numpy() - p).T).argmin()) for p in true]
    return table.iloc[own].reset_index(drop=True)


def projected(folder: Path, place: np.ndarray) -> dict[str, tuple[float, float, float, float]]:
    """u, v, distance, and cosine to the road's direction of a place of the map, by picture that holds it."""
    known = truth.load(folder)
    world = Earth(known.scene.map.crs).ecef_from_map(place.reshape(1, 3))[0]
    matrix = np.array([[FOCAL, 0, (SIZE[0] - 1) / 2], [0, FOCAL, (SIZE[1] - 1) / 2], [0, 0, 1.0]])
    found = {}
    for pose in pq.read_table(known.camera_file("run-1")).to_pylist():
        turn = Rotation.from_quat([pose[q] for q in ("qx", "qy", "qz", "qw")])
        opencv = turn.inv().apply(world - [pose[f"{a}_world_m"] for a in "xyz"])[[1, 2, 0]]
        if opencv[2] > 0.5:
            ((u, v),) = cv2.projectPoints(opencv.reshape(1, 3), np.zeros(3), np.zeros(3), matrix, np.zeros(5))[0][0]
            if 30.0 <= u <= SIZE[0] - 30 and 30.0 <= v <= SIZE[1] - 30:
                distance = float(np.linalg.norm(opencv))
                found[Path(pose["file"]).name] = (float(u), float(v), distance, opencv[2] / distance)
    return found


@pytest.mark.slow
def test_the_best_pictures_are_those_that_a_projection_gives(street: Simulated) -> None:
    signs = signs_of(session(street))
    for number in range(5):
        named = json.loads(signs["pictures"][number])
        shape, _ = KnownSigns.assets[number]
        expected = projected(street.survey_file.parent, np.array(shape.coords[0]))
        best = sorted(expected, key=lambda f: expected[f][2] / expected[f][3])
        assert 1 <= len(named) <= 3
        assert {one["file"] for one in named} <= set(best[: len(named) + 1])
        assert [one["distance_m"] for one in named] == sorted(one["distance_m"] for one in named)
        for one in named:
            u, v, distance, _ = expected[one["file"]]
            assert np.hypot(one["u_px"] - u, one["v_px"] - v) < 1.0
            assert one["distance_m"] == pytest.approx(distance, abs=0.02)
            assert (one["run"], one["camera"]) == ("run-1", "camera")


@pytest.mark.slow
def test_a_sign_from_behind_or_behind_a_van_has_no_picture(street: Simulated) -> None:
    signs = signs_of(session(street))
    assert projected(street.survey_file.parent, np.array(KnownSigns.assets[BACK][0].coords[0]))
    assert pd.isna(signs["pictures"][BACK]) and pd.isna(signs["cut_out"][BACK])
    shape, _ = KnownSigns.assets[BEHIND_VAN]
    in_pictures = projected(street.survey_file.parent, np.array(shape.coords[0]))
    assert len(in_pictures) >= 2 and pd.isna(signs["pictures"][BEHIND_VAN])


@pytest.mark.slow
def test_colours_and_shapes_are_those_of_the_faces(street: Simulated) -> None:
    signs = signs_of(session(street))
    assert signs["colour"].tolist()[:5] == COLOURS
    assert signs["shape"].tolist()[:5] == [one["shape"] for one in SIGNS[:5]]
    assert (signs["colour_probability"][:5] > 0.6).all() and (signs["shape_probability"][:5] > 0.6).all()
    assert signs["message"].isna().all()
    assert (signs["type"][:5] == "unknown").all() and signs["type"][5:].isna().all()  # nothing is drawn on them


@pytest.mark.slow
def test_cut_outs_show_the_plate_in_their_middle(street: Simulated) -> None:
    own = session(street)
    signs = signs_of(own)
    for number, name in enumerate(signs["cut_out"][:5]):
        picture = cv2.imread(own.store.path(name))
        height, width = picture.shape[:2]
        middle = picture[int(0.45 * height) : int(0.55 * height) + 1, int(0.45 * width) : int(0.55 * width) + 1]
        blue, green, red = middle.reshape(-1, 3).mean(axis=0)
        expected = {"red": red > 1.5 * blue, "blue": blue > 1.5 * red, "yellow": min(red, green) > 1.5 * blue}
        assert expected.get(str(SIGNS[number].get("colour")), True)
        assert name.endswith(f"{signs['object'][number]}_1.jpg")


@pytest.mark.slow
def test_lines_have_the_colour_of_their_paint(street: Simulated) -> None:
    table = geopandas.read_parquet(session(street).store.path("products/assets/lane_lines.parquet"))
    aside = [table.geometry.distance(line).idxmin() for line, _ in KnownLines.assets]
    assert table["colour"][aside].tolist() == ["yellow", "white"]
    assert (table["colour_probability"] > 0.8).all()
    assert table["pictures"].notna().all()


@pytest.mark.slow
def test_a_second_run_does_nothing_and_what_is_gone_is_made_again(street: Simulated, tmp_path: Path) -> None:
    folder = tmp_path / "survey"
    shutil.copytree(street.survey_file.parent, folder)
    own = session(Simulated(folder / street.survey_file.name))
    before = {p: own.store.read_bytes(p) for p in own.store.files("products/asset_pictures")}
    records = {r.unit: r.key for r in own.manifest.of(SEEN).values()}
    lost = next(iter(own.manifest.of(CUT_OUTS).values()))
    Path(own.store.path(lost.path)).unlink()
    run(own, "assets")
    assert {r.unit: r.key for r in own.manifest.of(SEEN).values()} == records
    assert {p: own.store.read_bytes(p) for p in own.store.files("products/asset_pictures")} == before
    off = run(session(Simulated(folder / street.survey_file.name), on=False), "assets")
    assert not off.store.files("products/asset_pictures")
    assert signs_of(off)["pictures"].isna().all() and signs_of(off)["colour"].isna().all()
    singly = run(session(Simulated(folder / street.survey_file.name), 1), "assets")
    assert {p: singly.store.read_bytes(p) for p in singly.store.files("products/asset_pictures")} == before


def test_people_do_not_edit_what_tells_of_the_evidence() -> None:
    assert {"colour", "message", "type", "shape"} <= editable_columns("sign")
    assert not {"cut_out", "colour_probability", "pictures"} & editable_columns("sign")


@pytest.mark.slow
def test_a_picture_that_cannot_be_read_is_named_and_the_next_is_taken(street: Simulated, tmp_path: Path) -> None:
    folder = tmp_path / "survey"
    shutil.copytree(street.survey_file.parent, folder)
    one = Simulated(folder / street.survey_file.name)
    first = json.loads(signs_of(session(one))["pictures"][0])[0]["file"]
    bad = next((folder / "raw").rglob(first))
    known, content = bad.stat(), bad.read_bytes()
    bad.write_bytes(content[:500] + bytes(len(content) - 500))
    os.utime(bad, ns=(known.st_atime_ns, known.st_mtime_ns))
    own = run(session(one, margin=0.3), "assets")
    assert any("pictures cannot be read" in line and first in line for line in lines_of(own))
    assert signs_of(own)["colour"][0] == "red"


@pytest.mark.slow
def test_thumbnails_of_the_report_are_the_cut_outs(street: Simulated) -> None:
    blocks = list(AssetsSection().blocks(Material(session(street))))
    pictures = [block for block in blocks if isinstance(block, Picture)]
    assert len(pictures) == 2  # signs from pictures, lines from returns
    for one in pictures:
        drawn = cv2.imdecode(np.frombuffer(one.content, np.uint8), cv2.IMREAD_COLOR)
        assert drawn.shape[0] == 220 and drawn.std() > 5.0


@pytest.mark.slow
def test_a_site_leads_from_a_sign_to_its_pictures_its_cut_out_and_its_pass(street: Simulated, tmp_path: Path) -> None:
    of = session(street)
    site = SiteMaterial(of)
    documents = {one.path: one for one in Pictures().documents(site)}
    layer = next(one for one in site_layers(site)[0] if one.name == "asset_road_signs")
    shown = 0
    for row, evidence in zip(layer.rows, layer.evidence, strict=True):
        own = [one for one in evidence if one["kind"] in ("picture", "cut_out")]
        named = [street.survey_file.parent / "raw/run-1/camera" / Path(one["file"]).name
                 for one in json.loads(row["pictures"] or "[]")]  # fmt: skip
        cut = [Path(of.store.path(row["cut_out"]))] if row["cut_out"] else []
        assert len(own) == len(cut) + len(named)
        for one, file in zip(own, [*cut, *named], strict=True):
            documents[one["url"]].write(tmp_path / "one.jpg", Path)
            assert (tmp_path / "one.jpg").read_bytes() == file.read_bytes()
        assert {"kind": "row", "layer": "passes", "row": "1", "title": "pass 1 of run-1"} in evidence
        shown += bool(cut and named)
    assert shown >= 5
    for text in ("{", "[1]", '{"run": 1}', None, 7):
        assert list(evidence_of_pictures(site, {"pictures": text})) == []
    (unknown,) = evidence_of_pictures(site, {"pictures": '[{"run": "<b>", "camera": "c", "file": "../x"}]'})
    assert unknown == {"title": "picture <b> c ../x", "kind": "picture"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pictures", "words"),
    [({"cameras": ["eye"]}, "the rig has no camera 'eye'"), ({"recogniser": "none.onnx"}, "recogniser")],
)
def test_wrong_settings_are_told_before_anything_is_done(
    street: Simulated, pictures: dict[str, object], words: str
) -> None:
    own = session(street, **pictures)
    (error,) = stage_named("assets").check(own.survey)
    assert isinstance(error, ConfigError) and words in str(error)
