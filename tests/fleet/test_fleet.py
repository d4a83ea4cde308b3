"""The catalogue of a fleet, and questions to all of its surveys: two roads in two years, on two maps."""

from __future__ import annotations

import csv
import io
import json
import shutil
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import duckdb
import fsspec
import geopandas
import numpy as np
import pandas as pd
import pyproj
import pytest
import rasterio
import shapely
from typer.testing import CliRunner, Result

from benchmarks.bench_lanes import rough_scene
from roadscan.cli import app
from roadscan.core.errors import RoadscanError, StoreError
from roadscan.core.survey import Survey
from roadscan.fleet.ask import ask_fleet
from roadscan.fleet.catalogue import make_catalogue
from roadscan.simulate import simulate
from roadscan.store.query.sql import query
from roadscan.store.store import Store

ROADS = {
    "north-2025": (1.0, "2025-06-03T08:00:00Z", {"crs": "EPSG:25832", "easting_m": 566000.0, "northing_m": 5933000.0}),
    "south-2026": (3.0, "2026-06-09T08:00:00Z", {"crs": "EPSG:32633", "easting_m": 391000.0, "northing_m": 5820000.0}),
}
"""Roughness that the road has (IRI, m/km), when it was driven, and its map."""
LANES = """
[adjust]
on = false

[condition]
section_m = 25.0

[[condition.lanes]]
name = "2"
offset_m = 0.0
width_m = 3.5
"""
SBET = np.dtype([("time", "<f8"), ("lat", "<f8"), ("lon", "<f8"), ("alt", "<f8"), ("more", "<f8", 13)])
YEARLY = """SELECT f.year, round(sum(s.station_to_m - s.station_from_m) / 1000, 3) AS lane_km,
sum(s.mri_m_per_km * (s.station_to_m - s.station_from_m)) / sum(s.station_to_m - s.station_from_m) AS mri
FROM condition_sections s JOIN fleet f USING (survey) WHERE s.mri_m_per_km IS NOT NULL
GROUP BY f.year ORDER BY f.year"""


def cli(*words: str) -> Result:
    return CliRunner().invoke(app, list(words))


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with both surveys, each run by the command from its raw logs, and its catalogue."""
    folder = tmp_path_factory.mktemp("fleet")
    for name, (iri, start, place) in ROADS.items():
        scene = rough_scene(
            iri, 60.0, id=name, start=start, map=place, passes=[{"lane": 2, "speed_m_per_s": 16.7}],
            profilers={"spacing_m": 0.05, "readings": 200},
        )  # fmt: skip
        file = simulate(scene, folder / name).survey_file
        file.write_text(file.read_text() + LANES)
        done = cli("run", str(file), "--workers", "0")
        assert done.exit_code == 0, (done.output, done.exception)
    assert cli("fleet", str(folder)).exit_code == 0
    return folder


def root(fleet: Path, survey: str) -> Path:
    return fleet / survey / "store" / f"survey={survey}"


def rows(fleet: Path) -> pd.DataFrame:
    return pd.read_parquet(fleet / "fleet" / "surveys.parquet").set_index("survey")


@pytest.mark.slow
def test_a_row_says_where_when_and_how_well(fleet: Path) -> None:
    """Against the raw trajectory, the GeoTIFFs of the tiles and the section table, each read by another library."""
    table = rows(fleet)
    assert list(table.index) == list(ROADS) and set(table["state"]) == {"finished"} and set(table["notes"]) == {""}
    outlines = geopandas.read_parquet(fleet / "fleet" / "surveys.parquet").set_index("survey")
    for name, (iri, start, place) in ROADS.items():
        row = table.loc[name]
        assert (row["year"], row["map_crs"]) == (int(start[:4]), place["crs"])
        (sbet,) = (fleet / name / "raw").rglob("*.sbet")
        poses = np.fromfile(sbet, SBET)
        way_km = pyproj.Geod(ellps="GRS80").line_length(*np.degrees([poses["lon"], poses["lat"]])) / 1e3
        assert row["driven_km"] == pytest.approx(way_km, rel=2e-3)
        corners = []
        for tif in (root(fleet, name) / "tiles" / "geotiff").glob("*.tif"):
            with rasterio.open(tif) as opened:
                corners += list(shapely.box(*opened.bounds).exterior.coords)
        hull = shapely.convex_hull(shapely.multipoints(corners))
        told = geopandas.GeoSeries([outlines.loc[name, "geometry"]], crs=outlines.crs).to_crs(place["crs"]).iloc[0]
        assert told.symmetric_difference(hull).area < 1e-3 * hull.area
        sections = geopandas.read_parquet(root(fleet, name) / "products/condition_sections/condition_sections.parquet")
        length = sections["station_to_m"] - sections["station_from_m"]
        measured = sections["mri_m_per_km"].notna()
        mri = np.average(sections["mri_m_per_km"][measured], weights=length[measured])
        assert row["mri_m_per_km"] == pytest.approx(mri) and row["lane_km"] == pytest.approx(length.sum() / 1e3)
        assert mri == pytest.approx(iri, rel=0.6)
        tiles = geopandas.read_parquet(root(fleet, name) / "products/tile_table/tiles.parquet")
        assert row["sigma_down_m"] == pytest.approx(tiles["sigma_down_m"].median())
        assert row["area_m2"] == pytest.approx(tiles["area_m2"].sum())
    assert table["mri_m_per_km"]["south-2026"] > 1.5 * table["mri_m_per_km"]["north-2025"]


@pytest.mark.slow
def test_a_networks_yearly_condition_is_one_query(fleet: Path) -> None:
    asked = cli("sql", "--fleet", str(fleet), "--json", YEARLY)
    assert asked.exit_code == 0, asked.output
    found = {row["year"]: row for row in json.loads(asked.stdout)}
    told = rows(fleet).set_index("year")
    for year, row in found.items():
        assert row["mri"] == pytest.approx(told["mri_m_per_km"][year])
        assert row["lane_km"] == pytest.approx(told["mri_km"][year], abs=1e-3)
    assert list(found) == [2025, 2026]


@pytest.mark.slow
@pytest.mark.parametrize(
    "table", ["scans", "trajectory", "tiles", "condition_sections", "cells", "run_history", "outputs"]
)
def test_a_table_has_the_rows_of_all_surveys(fleet: Path, table: str) -> None:
    """As each survey alone has them; `tiles` and `condition_sections` hold geometries on two maps."""
    alone = {}
    for name in ROADS:
        survey = Survey.load(fleet / name / "SURVEY.toml")
        store = Store(survey.store_url, survey.config.id)
        alone[name] = query(store, f"SELECT count(*) AS n FROM {table}").column("n")[0].as_py()
    statement = f"SELECT survey, count(*) AS n FROM (SELECT * FROM {table}) GROUP BY survey ORDER BY survey"
    assert {row["survey"]: row["n"] for row in ask_fleet(str(fleet), statement).to_pylist()} == alone


@pytest.mark.slow
def test_a_span_of_time_opens_the_files_of_its_survey(fleet: Path) -> None:
    (ends,) = ask_fleet(
        str(fleet), "SELECT min(epoch_gps_ns) AS a, max(epoch_gps_ns) AS b FROM scans WHERE survey LIKE 'south%'"
    ).to_pylist()
    found = ask_fleet(str(fleet), f"SELECT DISTINCT survey FROM scans_between({ends['a']}, {ends['b']})")
    assert found.column("survey").to_pylist() == ["south-2026"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "statement",
    [
        "SELECT * FROM read_text('/etc/passwd')",
        "SELECT * FROM read_text('store://survey=other/secret.txt')",
        "SELECT * FROM read_text('store://survey=north-2025/../../../south-2026/SURVEY.toml')",
        "COPY (SELECT 1) TO 'store://survey=north-2025/x.csv'",
        "COPY (SELECT 1) TO '/tmp/roadscan-fleet.csv'",
        "SET enable_external_access = true",
        "INSTALL spatial",
    ],
)
def test_a_statement_stays_within_the_stores(fleet: Path, statement: str) -> None:
    with pytest.raises(RoadscanError, match="refused"):
        ask_fleet(str(fleet), statement)
    assert not Path("/tmp/roadscan-fleet.csv").exists() and not (root(fleet, "north-2025") / "x.csv").exists()


@pytest.mark.slow
def test_other_programs_open_the_catalogue(fleet: Path) -> None:
    """Spark is not at hand: of the types that Parquet has, plain ones alone are in the file, which all readers know."""
    file = fleet / "fleet" / "surveys.parquet"
    plain = duckdb.sql(f"SELECT survey, year, mri_m_per_km FROM '{file}' ORDER BY year").fetchall()
    table = rows(fleet)
    assert plain == [(name, row["year"], row["mri_m_per_km"]) for name, row in table.sort_values("year").iterrows()]
    kinds = duckdb.sql(f"SELECT DISTINCT type FROM parquet_schema('{file}') WHERE type IS NOT NULL").fetchall()
    assert {kind for (kind,) in kinds} == {"BYTE_ARRAY", "INT32", "INT64", "DOUBLE"}
    pystac = pytest.importorskip("pystac", reason="pystac is not installed")
    collection = pystac.Collection.from_file(str(fleet / "fleet" / "collection.json"))
    collection.validate()
    items = {item.id: item for item in collection.get_items()}
    assert set(items) == set(ROADS)
    for name, item in items.items():
        item.validate()
        assert item.common_metadata.start_datetime.isoformat()[:10] == ROADS[name][1][:10]


class Tables(HTMLParser):
    """Rows of the tables of a page, as lists of texts, by the section that they stand in."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.of: dict[str, list[list[str]]] = {}
        self._section = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "section":
            self._section = dict(attrs)["id"] or ""
        elif tag == "tr":
            self.of.setdefault(self._section, []).append([])
        elif tag in ("td", "th"):
            self.of[self._section][-1].append("")

    def handle_data(self, data: str) -> None:
        if self.of.get(self._section) and self.of[self._section][-1] and data.strip():
            self.of[self._section][-1][-1] += data


@pytest.mark.slow
def test_the_page_says_the_same_as_the_catalogue(fleet: Path, tmp_path: Path) -> None:
    told = Tables((fleet / "fleet/index.html").read_text()).of
    asked = list(csv.DictReader(io.StringIO(cli("sql", "--fleet", str(fleet), "--csv", YEARLY).output)))
    assert all(len(row) == len(rows[0]) for rows in told.values() for row in rows)  # a cell a column
    assert [(row[0], row[1]) for row in told["years"][1:]] == [("2025", "1"), ("2026", "1")]
    for row, one in zip(told["years"][1:], asked, strict=True):
        assert float(row[4]) == pytest.approx(float(one["mri"]), abs=0.006)
    assert [row[:3:2] for row in told["surveys"][1:]] == [[name, "finished"] for name in sorted(ROADS)]
    assert "wrong" not in told
    copy = tmp_path / "fleet"
    shutil.copytree(fleet, copy)
    shutil.rmtree(root(copy, "south-2026"))
    (copy / "broken").mkdir()
    (copy / "broken/SURVEY.toml").write_text('id = "<b>"\n[map]\n[[runs]]\n')
    assert cli("fleet", str(copy)).exit_code == 1
    page = (copy / "fleet/index.html").read_text()
    wrong = {row[0]: row for row in Tables(page).of["wrong"][1:]}
    assert wrong["south-2026"][1] == "not run" and len(wrong) == 2 and "<b>" not in page


@pytest.mark.slow
def test_only_what_changed_is_made_anew(fleet: Path, tmp_path: Path) -> None:
    folder = tmp_path / "fleet"
    shutil.copytree(fleet, folder)
    make_catalogue(str(folder))
    file = folder / "fleet" / "surveys.parquet"
    before = file.read_bytes(), file.stat().st_mtime_ns
    assert make_catalogue(str(folder)).made == 0
    assert (file.read_bytes(), file.stat().st_mtime_ns) == before
    assert cli("run", str(folder / "south-2026" / "SURVEY.toml"), "--workers", "0").exit_code == 0
    assert make_catalogue(str(folder)).made == 1
    shutil.rmtree(folder / "north-2025")
    gone = make_catalogue(str(folder))
    assert gone.made == 0 and gone.table.column("survey").to_pylist() == ["south-2026"]
    assert [one.name for one in (folder / "fleet" / "items").iterdir()] == ["south-2026.json"]
    flipped = bytearray(file.read_bytes())
    flipped[flipped.rindex(b"sigma_down_m")] ^= 1
    file.write_bytes(flipped)
    with pytest.raises(StoreError, match="catalogue is damaged"):
        ask_fleet(str(folder), "SELECT * FROM fleet")
    assert make_catalogue(str(folder)).made == 1


@pytest.mark.slow
def test_what_is_wrong_with_a_survey_is_said(fleet: Path, tmp_path: Path) -> None:
    folder = tmp_path / "fleet"
    shutil.copytree(fleet, folder, ignore=shutil.ignore_patterns("fleet"))
    shutil.copytree(folder / "north-2025", folder / "twin")
    (folder / "broken").mkdir()
    (folder / "broken" / "SURVEY.toml").write_text('id = "broken"\n[map]\ncrs = "EPSG:1"\n[[runs]]\nid = "one"\n')
    (trajectory,) = (root(folder, "south-2026") / "tables" / "trajectory").rglob("*.parquet")
    trajectory.write_bytes(bytes(trajectory.stat().st_size))
    made = cli("fleet", str(folder), "--json")
    assert made.exit_code == 1
    told = {row["survey_file"]: row for row in json.loads(made.stdout)["surveys"]}
    assert len(told) == 4 and "key 'logs' of run 'one' is missing" in told["broken/SURVEY.toml"]["notes"]
    for name in ("north-2025/SURVEY.toml", "twin/SURVEY.toml"):
        assert "2 surveys have the id 'north-2025'" in told[name]["notes"]
    south = told["south-2026/SURVEY.toml"]
    assert (south["damaged"], south["driven_km"]) == (1, None) and trajectory.name in south["notes"]
    assert south["mri_m_per_km"] == pytest.approx(rows(fleet)["mri_m_per_km"]["south-2026"])
    asked = cli("sql", "--fleet", str(folder), "--json", "SELECT DISTINCT survey FROM scans")
    assert asked.exit_code == 1 and json.loads(asked.stdout) == [{"survey": "south-2026"}]
    assert asked.stderr.count("is not shown") == 3 and "table 'trajectory' cannot be opened" in asked.stderr
    unknown = cli("sql", "--fleet", str(folder), "SELECT * FROM poles")
    assert "no survey of 1 has the table 'poles'" in str(unknown.exception)


@pytest.mark.slow
def test_stores_without_survey_files_in_a_bucket(fleet: Path) -> None:
    bucket = fsspec.filesystem("memory")
    try:
        for name in ROADS:
            bucket.put(str(root(fleet, name)), f"/roads/{name[:5]}/survey={name}", recursive=True)
        made = make_catalogue("memory://roads")
        table = made.table.to_pandas().set_index("survey")
        there = rows(fleet)
        for column in ("driven_km", "mri_m_per_km", "sigma_down_m", "lane_km", "state", "sensors", "year"):
            assert list(table[column]) == list(there[column]), column
        assert set(table["survey_file"]) == {""} and make_catalogue("memory://roads").made == 0
        written = pd.read_parquet(io.BytesIO(bucket.cat("/roads/fleet/surveys.parquet")))
        assert list(written["survey"]) == list(ROADS)
        asked: list[dict[str, Any]] = ask_fleet("memory://roads", YEARLY).to_pylist()
        assert asked == ask_fleet(str(fleet), YEARLY).to_pylist()
    finally:
        bucket.rm("/roads", recursive=True)


def test_a_folder_that_is_not_there() -> None:
    refused = cli("fleet", "/nowhere")
    assert refused.exit_code != 0 and "there is no such folder" in str(refused.exception)
