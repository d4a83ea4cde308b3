"""Pictures of a street with a car as they are published: it is hidden where the simulator says that it stands."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from roadscan.cli import app
from roadscan.core.errors import ConfigError
from roadscan.privacy.hider import decoded, hider_of
from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.simulate import Scene, simulate
from roadscan.site.live import LiveSite, open_survey
from roadscan.site.material import Material, Wishes
from roadscan.site.site import Published, publish
from roadscan.store.digest import file_digest
from roadscan.survey.run import run_stages
from tests.measuring.drive import CAMERA, Drive
from tests.privacy.networks import red_detector

OFF = '[privacy]\npictures = "off" # nobody real is in simulated pictures\n'


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    """A parked car, seen by a lidar; the survey file does not speak of privacy."""
    scene = Scene.load("demo").changed(
        length_m=16.0, profilers={"on": False}, lidar={"range_max_m": 25.0}, camera=CAMERA | {"every_m": 4.0},
        passes=[{"lane": 2}], roadside={"vehicles": [{"station_m": 12.0, "offset_m": 5.0}]},
    )  # fmt: skip
    one = Drive(simulate(scene.noiseless(), tmp_path_factory.mktemp("street") / "survey").survey_file)
    text = one.survey_file.read_text().replace(OFF, "")
    assets = '\n[assets]\nkinds = ["pole"]\nexports = []\nbare_earth = false\nintensity = "raw"\n'
    one.survey_file.write_text(text + assets)
    one.run(products__make=["tile_table"], adjust__on=False)
    return one


def stated(drive: Drive, text: str) -> Session:
    """The survey with a section on privacy."""
    other = drive.survey_file.with_name("PRIVACY.toml")
    other.write_text(drive.survey_file.read_text() + text)
    return Session.open(other)


@pytest.fixture(scope="module")
def blurred(street: Drive, tmp_path_factory: pytest.TempPathFactory) -> Published:
    material = Material(stated(street, '\n[privacy]\npictures = "blur"\n'), Wishes(clouds=False))
    return publish(material, tmp_path_factory.mktemp("blurred") / "site")


def outlines(drive: Drive, file: str) -> dict[str, tuple[float, float, float, float]]:
    """Boxes in the picture of what stands there, from the truth's sizes."""
    found = {}
    for row in pq.read_table(drive.known.objects_file).to_pylist():
        along = np.radians(row["heading_deg"])
        ahead, right = np.array([np.sin(along), np.cos(along)]), np.array([np.cos(along), -np.sin(along)])
        foot = np.array([row["easting_m"], row["northing_m"]])
        corners = [
            [*(foot + a * row["length_m"] * ahead + b * row["width_m"] * right), row["height_m"] + c * row["size_up_m"]]
            for a in (-0.45, 0.45) for b in (-0.45, 0.45) for c in (0.25, 0.95)
        ]  # fmt: skip
        pixel = drive.pixels(file, np.array(corners))
        if np.isfinite(pixel).all():
            found[row["kind"]] = (*pixel.min(axis=0), *pixel.max(axis=0))
    return found


@pytest.mark.slow
def test_what_stands_there_is_hidden_in_every_picture(street: Drive, blurred: Published) -> None:
    assert not blurred.failures
    told = json.loads((blurred.folder / "pictures" / "privacy.json").read_bytes())
    assert told["sources"] == ["returns of vehicles and people"] and told["pictures"] == len(street.poses)
    assert told["total"]["vehicle"] >= 3 and told["total"]["detected"] == 0
    raw = street.survey_file.parent / "raw" / "run-1" / "camera"
    seen = set()
    for number, file in enumerate(street.poses):
        before = cv2.imread(str(raw / file)).astype(float)
        after = cv2.imread(str(blurred.folder / "pictures" / "0" / f"{number:06d}.jpg")).astype(float)
        changed = cv2.blur(np.abs(before - after).max(axis=2), (9, 9)) > 6.0
        boxes = outlines(street, file)
        for kind, (left, top, right, bottom) in boxes.items():
            if right - left < 12:
                continue
            seen.add(kind)
            own = np.s_[int(top) : int(bottom) + 1, int(left) : int(right) + 1]
            edges = cv2.Laplacian(after[own], cv2.CV_64F).std() / cv2.Laplacian(before[own], cv2.CV_64F).std()
            assert edges < 0.35, (file, kind)
            assert changed[own].mean() > 0.4, (file, kind)
        if not boxes and not any(told["hidden"][what][number] for what in ("vehicle", "person")):
            assert changed.mean() < 0.01
    assert seen == {"car"}


@pytest.mark.slow
def test_originals_stay_where_they_are(street: Drive, blurred: Published) -> None:
    raw = {file_digest(file) for file in (street.survey_file.parent / "raw").rglob("*.jpg")}
    assert raw.isdisjoint(file_digest(file) for file in blurred.folder.rglob("*") if file.is_file())
    entry = json.loads((blurred.folder / "survey.json").read_bytes())
    assert entry["privacy"] == {"pictures": "blur", "counts": "pictures/privacy.json"}
    assert entry["pictures"]["pictures"] == len(street.poses)


@pytest.mark.slow
def test_the_same_bytes_again(street: Drive, blurred: Published, tmp_path: Path) -> None:
    material = Material(stated(street, '\n[privacy]\npictures = "blur"\n'), Wishes(clouds=False))
    again = publish(material, tmp_path / "site")
    for file in sorted((blurred.folder / "pictures").rglob("*")):
        if file.is_file():
            assert file.read_bytes() == (again.folder / file.relative_to(blurred.folder)).read_bytes()
    renewed = publish(replace(material), tmp_path / "site")
    assert renewed.made == 0


@pytest.mark.slow
def test_nothing_is_published_without_a_statement(street: Drive, tmp_path: Path) -> None:
    told = CliRunner().invoke(app, ["publish", str(street.survey_file), "--out", str(tmp_path / "site"), "--no-clouds"])
    assert told.exit_code == 0 and "note: no picture is published" in told.output
    entry = json.loads((tmp_path / "site" / "survey.json").read_bytes())
    assert entry["pictures"] is None and entry["privacy"] == {"pictures": "unstated"}
    assert not (tmp_path / "site" / "pictures").exists()
    off = CliRunner().invoke(
        app, ["publish", str(street.survey_file), "--out", str(tmp_path / "off"), "--no-clouds", "--privacy", "off"]
    )
    assert off.exit_code == 0
    raw = street.survey_file.parent / "raw" / "run-1" / "camera"
    assert (tmp_path / "off" / "pictures" / "0" / "000000.jpg").read_bytes() == (raw / "000000.jpg").read_bytes()
    wrong = ["publish", str(street.survey_file), "--out", str(tmp_path / "x"), "--privacy", "perhaps"]
    assert CliRunner().invoke(app, wrong).exit_code != 0
    here = LiveSite(open_survey(street.survey_file)).document("pictures/0/000000.jpg")
    assert here is not None and here.file.read_bytes() == (raw / "000000.jpg").read_bytes()


@pytest.mark.slow
def test_what_a_network_finds_is_hidden(street: Drive, tmp_path: Path) -> None:
    one = Drive(street.copy_with_store_to(tmp_path / "survey").survey_file)
    raw = one.survey_file.parent / "raw" / "run-1" / "camera"
    file = list(one.poses)[1]
    picture = cv2.imread(str(raw / file))
    picture[300:330, 100:130] = (20, 20, 250)
    cv2.imwrite(str(raw / file), picture, [cv2.IMWRITE_JPEG_QUALITY, 98])
    red_detector(one.survey_file.parent / "red.onnx", "yolov8")
    section = '\n[privacy]\npictures = "blur"\nfrom_classes = false\n\n[privacy.detector]\nmodel = "red.onnx"\n'
    session = stated(one, section + 'output = "yolov8"\n')
    run_stages(session, [stage_named("ingest")])
    session = Session.open(one.survey_file.with_name("PRIVACY.toml"))
    made = publish(Material(session, Wishes(clouds=False)), tmp_path / "site")
    told = json.loads((made.folder / "pictures" / "privacy.json").read_bytes())
    assert told["sources"] == ["detector red.onnx"]
    assert [count > 0 for count in told["hidden"]["detected"]] == [name == file for name in one.poses]
    after = cv2.imread(str(made.folder / "pictures" / "0" / "000001.jpg")).astype(float)
    assert after[300:330, 100:130, 2].max() - after[300:330, 100:130, 2].min() > 10.0  # no square with sharp edges
    assert np.abs(np.diff(after[315, 90:140, 2])).max() < 40.0
    cut = decoded((raw / file).read_bytes())[280:350, 80:150]
    hidden_there = (hider_of(session).hide_found(cut) != cut).any(axis=2)
    assert hidden_there[20:50, 20:50].mean() > 0.5 and not hidden_there[:8].any()
    out = tmp_path / "copies"
    argued = ["export", "pictures", str(one.survey_file.with_name("PRIVACY.toml")), "--out", str(out), "--blurred"]
    copied = CliRunner().invoke(app, argued)
    assert copied.exit_code == 0, copied.output
    copy = cv2.imread(str(out / "run-1" / "camera" / file)).astype(float)
    assert np.abs(np.diff(copy[315, 90:140, 2])).max() < 40.0


def test_blurring_without_anything_that_says_where_is_refused(measured_drive: Drive, tmp_path: Path) -> None:
    material = Material(Session.open(measured_drive.survey_file), Wishes(clouds=False, privacy="blur"))
    with pytest.raises(ConfigError, match="nothing says where"):
        publish(material, tmp_path / "site")
    assert not (tmp_path / "site").exists()
