"""GNSS and accuracy logs beside the rest of a survey: ingested, and nothing else changes."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import pytest

from roadscan.core.survey import Survey
from roadscan.ingest.ingest import ingest
from roadscan.ingest.planned_logs import plan_logs
from roadscan.run.session import Session
from roadscan.simulate import Scene
from roadscan.store.logs import read_log_records
from roadscan.store.query.sql import query
from roadscan.store.store import Store
from roadscan.survey.status import survey_status, verify_store
from tests.formats.nmea_files import Fix, write_nmea
from tests.surveys import Simulated, outputs

POS = (
    "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)\n"
    "%  GPST  latitude(deg) longitude(deg) height(m) Q ns\n"
)


def write_pos(path: Path, seconds: range) -> Path:
    lines = (f"2026/05/04 09:30:{s:02d}.000 48.0 11.0 500.0 {1 + s % 2} 12\n" for s in seconds)
    path.write_text(POS + "".join(lines) + "2026/05/04 damage\n")
    return path


def gnss_survey(folder: Path, *logs: dict[str, Any]) -> Survey:
    values = {
        "id": "gnss",
        "map": {"crs": "EPSG:25832"},
        "runs": [{"id": "drive", "logs": list(logs)}],
    }
    return Survey.parse(values, folder=folder)


@pytest.mark.slow
def test_gnss_logs_leave_a_run_as_it_is(finished: Simulated, tmp_path: Path) -> None:
    survey = Survey.load(finished.survey_file)
    runs = survey.config.model_dump()["runs"]
    path = write_pos(tmp_path / "rover.pos", range(17, 27))  # the drive lasts from 17 s to 19 s
    runs[0]["logs"].append({"path": path, "crs": "EPSG:4979"})
    run = finished.run("store-gnss", runs=runs)
    store = finished.store("store-gnss")
    before, after = outputs(finished.store()), outputs(store)
    assert sorted(before) == sorted(after)
    assert [p for p in before if before[p] != after[p]] == []
    rows = query(store, "SELECT quality, count(*) AS n FROM gnss GROUP BY quality ORDER BY quality").to_pylist()
    assert rows == [{"quality": "fixed", "n": 5}, {"quality": "float", "n": 5}]
    status = survey_status(Session(run.survey, store))
    assert status.is_complete
    (log,) = [log for log in status.logs if log["format"] == "rtklib_pos"]
    assert (log["sensor"], log["rows"], log["rejected"], log["state"]) == ("gnss", 10, 1, "ingested")
    assert verify_store(store) == []


def test_a_survey_of_gnss_alone(tmp_path: Path) -> None:
    write_pos(tmp_path / "rover.pos", range(10))
    start = 1_461_922_218_000_000_000
    write_nmea(tmp_path / "rover.nmea", [Fix(start + i * 10**9, 48.0, 11.0, 450.0, 46.0) for i in range(5)])
    (tmp_path / "accuracy.out").write_bytes(
        b"".join(struct.pack("<10d", 1000.0 + i, *[0.01] * 6, *[1.0] * 3) for i in range(4))
    )
    logs: list[dict[str, Any]] = [{"path": f, "crs": "EPSG:4979"} for f in ("rover.pos", "rover.nmea")]
    logs.append({"path": "accuracy.out", "clock": {"system": "gps_week_seconds", "week": 2417}})
    survey = gnss_survey(tmp_path, *logs)
    store = Store(str(tmp_path / "store"), "gnss")
    results = ingest(survey, store)
    assert sorted((r.record.sensor, r.record.rows) for r in results) == [
        ("gnss", 5),
        ("gnss", 10),
        ("trajectory_accuracy", 4),
    ]
    assert all(not r.fresh for r in ingest(survey, store))
    spans = query(store, "SELECT count(*) AS n FROM gnss_between(0, 9000000000000000000)").to_pylist()
    assert spans == [{"n": 15}]
    status = survey_status(Session(survey, store))
    assert {log["state"] for log in status.logs} == {"ingested"}
    assert "nothing to place" in status.places_nothing
    assert status.is_complete


def test_a_log_without_a_row(tmp_path: Path) -> None:
    """It yields nothing at all: no rows, no rejects, no error, and the store stays readable."""
    (tmp_path / "a.nmea").write_text("$GPGSV,1,1,00*79\r\n")
    log = {
        "path": "a.nmea",
        "format": "nmea",
        "crs": "EPSG:4979",
        "clock": {"system": "unix_utc", "date": "2026-05-04"},
    }
    survey, store = gnss_survey(tmp_path, log), Store(str(tmp_path / "store"), "gnss")
    (result,) = ingest(survey, store)
    assert (result.record.rows, result.record.rejected) == (0, 0)
    assert len(read_log_records(store)) == 1
    assert survey_status(Session(survey, store)).logs[0]["state"] == "ingested"


def test_a_changed_accuracy_file_makes_the_trajectory_new(tmp_path: Path) -> None:
    poses = b"".join(struct.pack("<17d", 1000.0 + i, 0.84, 0.19, 500.0, *[0.1] * 13) for i in range(4))
    (tmp_path / "a.sbet").write_bytes(poses)
    log = {
        "path": "a.sbet",
        "crs": "EPSG:4979",
        "clock": {"system": "gps_week_seconds", "week": 2417},
        "options": {"accuracy": "accuracy.out"},
    }
    survey, store = gnss_survey(tmp_path, log), Store(str(tmp_path / "store"), "gnss")
    keys = []
    for sigma in (0.01, 0.02):
        accuracy = b"".join(struct.pack("<10d", 1000.0 + i, *[sigma] * 6, *[60.0] * 3) for i in range(4))
        (tmp_path / "accuracy.out").write_bytes(accuracy + b"\x01" * (8 if sigma == 0.02 else 0))
        (result,) = ingest(survey, store)
        keys.append(result.record.key)
        statement = "SELECT DISTINCT sigma_north_m AS s, sigma_roll_deg AS r FROM trajectory"
        rows = query(store, statement, [result.record.key]).to_pylist()
        assert rows == [{"s": pytest.approx(sigma), "r": 1.0}]
    assert keys[0] != keys[1]
    assert query(store, "SELECT file, record FROM rejects").to_pylist() == [{"file": "accuracy.out", "record": 4}]
    assert len(plan_logs(survey, store)[0]) == 1


def test_stated_errors_of_poses_reach_the_tiles(simulated: Simulated) -> None:
    """Those of recorded poses; an adjustment makes them smaller (tests/adjust/test_adjust.py)."""
    sigma = Scene.load("demo").noise.position_m
    recorded = simulated.run("store-recorded", adjust__on=False, products__make=["tile_table"])
    rows = query(recorded.store, "SELECT sigma_horizontal_m, sigma_down_m FROM tiles").to_pylist()
    assert rows
    for row in rows:
        assert row["sigma_horizontal_m"] == pytest.approx(sigma * 2**0.5, rel=0.02)
        assert row["sigma_down_m"] == pytest.approx(sigma, rel=0.02)
