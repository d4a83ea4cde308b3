"""Classes of readings: one for every reading, in its order; filtered points kept in the LAS files, marked."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import geopandas
import laspy
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely
from typer.testing import CliRunner

from roadscan.cli import app
from roadscan.core.errors import ConfigError
from roadscan.core.survey import Survey
from roadscan.export.classes import write_classes
from roadscan.georeference.road_profiles import LAS_CLASSES, READING_CLASSES
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Session
from roadscan.run.stage import stages
from roadscan.store.store import Store
from roadscan.survey.run import run_stages
from tests.surveys import outputs

PROFILES, READINGS = 60, 40
START = 1_400_000_000 * 10**9
FIRST_IN_PASS = 11
SPECIAL = {
    (25, 3): (0, "no_return"),
    (26, 3): (400, "too_near"),
    (27, 4): (4600, "too_far"),
    (28, 5): (2600, "too_low"),
    (29, 6): (1500, "too_high"),
    (5, 6): (400, "too_near"),
}
"""Range (mm) and class of single readings by profile and number."""


def write_logs(folder: Path) -> None:
    """A level drive of 1 m/s to the north, 2 m above ground at 100 m: a profiler that looks down, and a lidar."""
    seconds = np.arange(-1.0, 8.0, 0.1)
    rows = [f"{1_400_000_000 + s:.1f},0,{s},102.0,0,0,0" for s in seconds]
    names = "time_s,easting_m,northing_m,height_m,roll_deg,pitch_deg,heading_deg"
    (folder / "path.csv").write_text("\n".join([names, *rows, ""]))
    ranges = np.full((PROFILES, READINGS), 2000, np.uint16)
    for (row, reading), value in SPECIAL.items():
        ranges[row, reading] = value[0]
    intensity = np.full((PROFILES, READINGS), 7, np.uint8)
    epochs = START + np.arange(PROFILES) * 10**8
    epochs[-1] += 60 * 10**9  # far behind the trajectory
    arrays = [pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), READINGS) for values in (ranges, intensity)]
    pq.write_table(
        pa.table({"epoch_gps_ns": epochs, "range": arrays[0], "intensity": arrays[1]}), folder / "scans.parquet"
    )


def survey_of(folder: Path, store: str = "store", **filters: Any) -> Survey:
    geometry = {"kind": "cartesian", "readings": READINGS, "first": -1.95, "step": 0.1, "range_step_m": 0.001}
    values = {
        "id": "classes",
        "store": store,
        "map": {"local": {"name": "yard"}},
        "tiles": {"cell_m": 0.5},
        "rig": {
            "sensors": {
                "profiler": {"kind": "profiler", "range_min_m": 0.5, "range_max_m": 4.5, "lever_arm_body_m": [0, 0, 0]}
            }
        },
        "passes": [{"id": 1, "run": "r", "start": "2024-05-17T16:53:03.050Z"}],
        "runs": [
            {
                "id": "r",
                "logs": [
                    {"path": "path.csv", "format": "trajectory_csv", "crs": "local", "clock": {"system": "gps"}},
                    {
                        "path": "scans.parquet",
                        "format": "scans",
                        "sensor": "profiler",
                        "options": {"scan_geometry": geometry},
                    },
                ],
            }
        ],
        "filters": {"height_min_m": 99.5, "above_body_max_m": -1.6} | filters,
    }
    return Survey.parse(values, folder=folder)


def run(survey: Survey) -> Store:
    store = Store(survey.store_url, "classes")
    run_stages(Session(survey, store, Inline()), stages())
    return store


def expected() -> np.ndarray:
    """Class of every reading by hand, (PROFILES, READINGS)."""
    codes = {name: code for code, name in READING_CLASSES.items()}
    out = np.zeros((PROFILES, READINGS), int)
    out[:FIRST_IN_PASS] = codes["outside_pass"]
    out[-1] = codes["no_pose"]
    for where, (_, name) in SPECIAL.items():
        out[where] = codes[name]
    return out


def write_line(folder: Path) -> None:
    line = shapely.LineString([[0, -50], [0, 50]])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a layer without a CRS may be of little use
        geopandas.GeoDataFrame({"width": [1.2]}, geometry=[line]).to_file(folder / "line.gpkg")


LINE = {
    "centre_line": "line.gpkg",
    "centre_line_crs": "local",
    "centre_line_width": "width",
    "centre_line_margin_m": 0.4,
}


def test_every_reading_has_its_class(tmp_path: Path) -> None:
    write_logs(tmp_path)
    survey = survey_of(tmp_path)
    store = run(survey)
    out = tmp_path / "classes.parquet"
    counts = write_classes(survey, store, "r", "profiler", out)
    table = pq.read_table(out)
    found = table.column("class").to_numpy().reshape(PROFILES, READINGS)
    assert np.array_equal(found, expected())
    assert counts == {n: int((expected() == c).sum()) for c, n in READING_CLASSES.items() if (expected() == c).any()}
    assert np.array_equal(table.column("reading").to_numpy(), np.tile(np.arange(READINGS), PROFILES))
    assert np.array_equal(table.column("row").to_numpy(), np.repeat(np.arange(PROFILES), READINGS))
    assert table.column("epoch_gps_ns")[READINGS].as_py() == START + 10**8
    assert json.loads(table.schema.metadata[b"classes"])["8"] == "off_centre_line"
    assert [p.name for p in tmp_path.glob("*.part")] == []

    write_line(tmp_path)
    cut = survey_of(tmp_path, "store", **LINE)
    write_classes(cut, store, "r", "profiler", out)
    off = pq.read_table(out).column("class").to_numpy().reshape(PROFILES, READINGS)
    beside = np.abs(-1.95 + 0.1 * np.arange(READINGS)) > 1.0
    assert np.array_equal(off, np.where((expected() == 0) & beside, 8, expected()))


def test_what_is_kept_is_what_the_las_files_hold(tmp_path: Path) -> None:
    write_logs(tmp_path)
    store = run(survey_of(tmp_path))
    points = sum(laspy.read(store.path(p)).header.point_count for p in store.files("tiles/las"))
    assert points == int((expected() == 0).sum())


def test_filtered_points_are_kept_marked(tmp_path: Path) -> None:
    write_logs(tmp_path)
    write_line(tmp_path)
    plain, marked = run(survey_of(tmp_path, "a", **LINE)), run(survey_of(tmp_path, "b", **LINE, keep_marked=True))
    ours, theirs = outputs(plain), outputs(marked)
    assert set(ours) == set(theirs)
    differing = {path for path in ours if ours[path] != theirs[path]}
    assert differing
    assert all(path.startswith("tiles/las/") for path in differing)  # cells, rasters and pictures do not know them
    seen: dict[int, int] = {}
    for path in marked.files("tiles/las"):
        own, before = laspy.read(marked.path(path)), laspy.read(plain.path(path))
        kept = np.asarray(own.withheld) == 0
        for name in ("X", "Y", "Z", "gps_time", "intensity", "classification", "point_source_id"):
            assert np.array_equal(np.asarray(own[name])[kept], np.asarray(before[name])), name
        for kind, count in zip(*np.unique(np.asarray(own.classification)[~kept], return_counts=True), strict=True):
            seen[int(kind)] = seen.get(int(kind), 0) + int(count)
        facts = json.loads(next(v for v in own.header.vlrs if v.user_id == "roadscan").record_data)
        assert facts["points_of_tile"] == int(kept.sum())
        assert facts["marked_points"] == int((~kept).sum())
    beside = np.abs(-1.95 + 0.1 * np.arange(READINGS)) > 1.0
    off = int(((expected() == 0) & beside).sum())
    assert seen == {7: 1, 18: 1, 64: 1, 65: 1, 66: off}
    heights = np.concatenate([laspy.read(marked.path(p)).z for p in marked.files("tiles/las")])
    assert np.sort(np.unique(heights.round(3))).tolist() == [97.4, 99.4, 100.0, 100.5, 101.6]


def test_marked_files_do_not_depend_on_blocks(tmp_path: Path) -> None:
    write_logs(tmp_path)
    write_line(tmp_path)
    survey = survey_of(tmp_path, "a", **LINE, keep_marked=True)
    values = survey.config.model_dump() | {"store": "b"}
    values["tiles"]["block_tiles"] = 1
    values["rig"] = survey.rig.model_dump()
    assert outputs(run(survey)) == outputs(run(Survey.parse(values, folder=tmp_path)))


def test_clouds_have_classes_of_height_only(tmp_path: Path) -> None:
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = [0.001] * 3
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    las = laspy.LasData(header)
    las.x, las.y, las.z = np.full(4, 5.0), np.full(4, 5.0), np.array([50.0, 10.0, 90.0, 51.0])
    las.gps_time, las.classification, las.synthetic = np.arange(4.0) + 2e8, np.full(4, 2), np.full(4, 1)
    las.write(tmp_path / "a.las")
    values = {
        "id": "classes",
        "map": {"local": {"name": "yard"}},
        "tiles": {"cell_m": 0.5},
        "runs": [{"id": "r", "logs": [{"path": "a.las", "format": "las", "crs": "local"}]}],
        "filters": {"height_min_m": 40.0, "height_max_m": 60.0, "keep_marked": True, "above_body_max_m": -100.0},
    }
    survey = Survey.parse(values, folder=tmp_path)
    store = run(survey)
    assert write_classes(survey, store, "r", "cloud", tmp_path / "c.parquet") == {
        "kept": 2,
        "too_low": 1,
        "too_high": 1,
    }
    assert pq.read_table(tmp_path / "c.parquet").column("class").to_pylist() == [0, 5, 6, 0]
    (path,) = store.files("tiles/las")
    own = laspy.read(store.path(path))
    assert np.asarray(own.classification).tolist() == [2, 2, 7, 18]
    assert np.asarray(own.withheld).tolist() == [0, 0, 1, 1]
    assert np.asarray(own.synthetic).tolist() == [1, 1, 1, 1]


def test_las_classes_are_those_of_the_standard() -> None:
    codes = {name: code for code, name in READING_CLASSES.items()}
    assert (LAS_CLASSES[codes["too_low"]], LAS_CLASSES[codes["too_high"]]) == (7, 18)
    assert all(LAS_CLASSES[codes[name]] >= 64 for name in ("too_near", "too_far", "off_centre_line"))


def test_the_command(tmp_path: Path) -> None:
    write_logs(tmp_path)
    survey = survey_of(tmp_path)
    run(survey)
    with pytest.raises(ConfigError, match=r"no readings of r/profile.*did you mean 'r/profiler'"):
        write_classes(survey, Store(survey.store_url, "classes"), "r", "profile", tmp_path / "x.parquet")
    assert "--sensor" in CliRunner().invoke(app, ["classes", "--help"]).output
