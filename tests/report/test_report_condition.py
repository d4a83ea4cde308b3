"""The report of a small survey as a road engineer reads it: what is shown, where, with which σ; what is not made."""

from __future__ import annotations

import json
import re
import shutil
from html import unescape
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from roadscan.condition.tasks.pictures import chosen_ruts
from roadscan.report.blocks import Paragraph, Table
from roadscan.report.page import report_page
from roadscan.report.sections.adjustment import agreement
from roadscan.run.session import Session
from roadscan.simulate import Scene, simulate
from roadscan.store.digest import bytes_digest, sealed_parquet
from roadscan.store.manifest import Manifest
from tests.answers import roadscan

NOT_MEASURED = "mpd_mean_mm: no section has a value; cells have 50 mm; a mean profile depth takes 10 mm or less."


@pytest.fixture(scope="module")
def survey_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """30 m of the demo's road in cells of 50 mm, both lanes driven once, with control points; run once."""
    scene = Scene.load("demo").changed(
        length_m=30.0, profilers={"spacing_m": 0.1, "readings": 200}, lidar={"range_max_m": 4.0}
    )
    file = simulate(scene, tmp_path_factory.mktemp("report") / "survey").survey_file
    with file.open("a") as stream:
        stream.write('\n[condition]\nsection_m = 10.0\n[tiles]\ncell_m = 0.05\n[products]\nmake = ["hillshade"]\n')
    done = roadscan("run", file, "--workers", "0")
    assert done.exit_code == 0, done.output
    return file


def page_of(survey_file: Path) -> str:
    """The page's text, with its table cells apart; pictures left out."""
    (path,) = survey_file.parent.glob("store/*/report/report.html")
    page = re.sub(r'"data:image[^"]*"', '""', path.read_text(encoding="utf-8"))
    return unescape(page)


@pytest.mark.slow
def test_captions_say_what_is_shown(survey_file: Path) -> None:
    captions = re.findall(r"<figcaption>(.*?)</figcaption>", page_of(survey_file), re.DOTALL)
    crossings = [one for one in captions if "typical and at its deepest rut" in one]
    assert len(crossings) == 2
    assert {one.split(",")[1].strip() for one in crossings} == {"lane 1", "lane 2"}
    assert [one for one in captions if re.search(r"_\d{5}_", one)] == []
    assert sum("shaded relief" in one for one in captions) == 1  # the same picture as TIFF and PNG is shown once


@pytest.mark.slow
def test_tables_of_condition_fit_the_page(survey_file: Path) -> None:
    """Means stand with σ; remarks have numbers, and a column without a value is named below in place of dashes."""
    page = page_of(survey_file)
    (section,) = re.findall(r'<section id="condition">.*?</section>', page, re.DOTALL)
    heads = [re.findall(r"<th[^>]*>(.*?)</th>", head) for head in re.findall(r"<thead>.*?</thead>", section)]
    assert [len(head) <= 9 for head in heads] == [True] * len(heads)
    assert "rut left (mm)" in heads[0]
    assert re.search(r"<td>\d+\.\d ± \d+\.\d</td>", section)
    assert not any("MPD (mm)" in head for head in heads)
    assert "In no section: MPD (mm). Cells have 50 mm; a mean profile depth takes 10 mm or less." in section
    assert "crack_alligator_m" not in section


@pytest.mark.slow
@pytest.mark.witness("condition_not_measured")
def test_what_condition_does_not_make_is_said(survey_file: Path) -> None:
    told = json.loads(roadscan("run", survey_file, "--workers", "0", "--json").stdout)
    texts = [one["text"] for one in told["findings"] if one["witness"] == "condition_not_measured"]
    assert NOT_MEASURED in texts
    assert [one for one in texts if "crack" in one] == []  # the survey does not ask for the product
    assert NOT_MEASURED in roadscan("status", survey_file).output.replace("\n", " ").replace("  ", " ")


@pytest.mark.slow
def test_few_check_points_make_no_statement(survey_file: Path) -> None:
    page = page_of(survey_file)
    (path,) = survey_file.parent.glob("store/*/tables/absolute_accuracy/*.parquet")
    counts = pq.read_table(path, columns=["count"])["count"].to_pylist()
    assert max(counts) < 20
    assert "95 % (NSSDA)" not in page
    assert "95 % within" not in page
    assert "NSSDA takes 20 at least, ASPRS (2023) 30" in page


@pytest.mark.slow
def test_residuals_that_contradict_their_sigma_are_named(survey_file: Path, tmp_path: Path) -> None:
    """The same survey, with residuals of its control points as those of poses that err by 50 mm."""
    copy = tmp_path / "survey"
    shutil.copytree(survey_file.parent, copy)
    said = "A height after the adjustment contradicts its σ"
    assert said not in page_of(survey_file)
    store = Session.open(copy / survey_file.name).store
    with store.lock():
        manifest = Manifest(store)
        (record,) = (one for one in manifest.all() if "tables/control_residuals/" in one.path)
        rows = store.read_table(record.path)
        number = rows.column_names.index("height_after_m")
        field = rows.schema.field(number)
        rows = rows.set_column(number, field, pa.array([0.05] * rows.num_rows, field.type))
        content = sealed_parquet(rows)
        store.write_bytes(record.path, content)
        manifest.add([record._replace(bytes=len(content), digest=bytes_digest(content))])
    assert said in report_page(Session.open(copy / survey_file.name))


def test_passes_that_differ_by_more_than_their_ties_err_are_named() -> None:
    """Shifts of 9 mm beside a σ of 2 mm, which a reader would take for the passes' agreement."""
    rows = [
        {"kind": kind, "accepted": 1, "before_m": 0.012, "after_m": after, "sigma_m": 0.002}
        for kind, after in (("shift", 0.009), ("height_tie", 0.003))
    ]
    table, *said = agreement(rows)
    assert isinstance(table, Table)
    assert ("shift", "1", "12.00", "9.00", "2.00") in table.rows
    (warning,) = said
    assert isinstance(warning, Paragraph)
    assert "differ by 9.00 mm in the shifts, 4 times their σ of 2.00 mm" in warning.text
    _, said_of_many = agreement([one | {"sigma_m": 0.0043} for one in rows[:1] * 20])
    assert isinstance(said_of_many, Paragraph) and not said_of_many.is_warning
    assert "the shifts differ by 9.00 mm, 2.1 times their σ of 4.30 mm" in said_of_many.text


def ruts() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """80 m: a left rut of 8 mm that is 14 mm deep from 50 to 60 m, a pothole of 45 mm at 20 m, few readings at 75 m."""
    station = np.arange(0.0, 80.0, 0.5)
    depths = np.full((2, station.size), 5.0)
    depths[0] = np.where((station > 50) & (station < 60), 14.0, 8.0) + 0.01 * station
    depths[0, np.abs(station - 20.0) < 0.8] = 45.0
    sigmas = np.where(station > 75, 6.0, 1.0) * np.ones((2, 1))
    depths[:, station > 75] = 30.0
    return station, depths, sigmas


def test_no_pothole_and_no_noise_is_shown_as_a_rut() -> None:
    station, depths, sigmas = ruts()
    chosen = chosen_ruts(station, depths, sigmas)
    at = {word: float(station[k]) for word, (k, _) in chosen.items()}
    assert 50 < at["deepest"] < 60
    assert chosen["deepest"][1].tolist() == pytest.approx([14.55, 5.0], abs=0.1)
    assert abs(depths[0, chosen["typical"][0]] - 8.4) < 0.2
    assert chosen_ruts(station, np.full_like(depths, np.nan), sigmas) == {}


def finding_of(witness: str, folder: Path, **changes: object) -> str:
    """The text of the one finding of a witness, of 8 m of the demo road with changes, asked for lane lines alone."""
    scene = Scene.load("demo").changed(
        length_m=8.0, passes=[{"lane": 2}], profilers={"on": False}, lidar={"range_max_m": 12.0}, **changes
    )
    file = simulate(scene, folder / "survey").survey_file
    with file.open("a") as stream:
        stream.write('\n[assets]\nkinds = ["lane_line"]\n[tiles]\ncell_m = 0.2\n[products]\nmake = []\n')
    done = roadscan("run", file, "--workers", "0", "--json")
    assert done.exit_code == 0, done.output
    (text,) = (one["text"] for one in json.loads(done.stdout)["findings"] if one["witness"] == witness)
    return str(text)


@pytest.mark.slow
@pytest.mark.witness("rough_readings")
def test_paint_that_is_not_sought_is_said(tmp_path: Path) -> None:
    """A lidar that errs by 200 mm hides the paint; that no lane line is found is no proof that there is none."""
    said = finding_of("rough_readings", tmp_path, noise={"lidar_range_m": 0.2})
    assert re.match(r"Paint was not sought on \d+% of the ground", said)
    assert "more than 30 mm" in said


@pytest.mark.slow
@pytest.mark.witness("constant_intensity")
def test_a_lidar_without_intensities_is_named(tmp_path: Path) -> None:
    """A road of one brightness, seen without noise, is like a driver that writes one number for all returns."""
    road = Scene.load("demo").road.model_dump() | {
        "brightness": dict.fromkeys(("asphalt", "shoulder", "verge", "kerb", "marking"), 80.0), "texture": None,
        "markings": [], "patches": [], "stains": [], "tyre_marks": [], "cracks": [], "potholes": [], "symbols": [],
    }  # fmt: skip
    said = finding_of("constant_intensity", tmp_path, road=road, noise={"intensity": 0.0}, roadside={})
    assert re.match(r"The intensity of all returns of \S+ on the ground, in all runs, is \d+", said)
