"""Clocks through the survey file: pairs applied at ingest, motion estimated into the tables, nothing done twice."""

from __future__ import annotations

import datetime as dt
import re
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roadscan.core.clock_evidence import MotionEvidence
from roadscan.core.errors import ConfigError, FormatError, RoadscanError, RunError
from roadscan.core.gpstime import gps_ns_from_utc
from roadscan.core.survey import LogConfig, Survey
from roadscan.ingest.clock_pairs import log_pairs
from roadscan.ingest.ingest import ingest, survey_records
from roadscan.navigation.tasks.clocks import estimate_clocks, load_clocks
from roadscan.run.session import Session
from roadscan.simulate import Scene, simulate
from roadscan.store.logs import write_log_record
from roadscan.store.query.sql import query
from roadscan.store.store import Store
from roadscan.survey.status import survey_status, verify_store
from tests.drawing import drawn
from tests.surveys import changed

S = 10**9
HEADS = {"offset_s": -0.7312, "drift_ppm": 23.0}
WHEEL = {"offset_s": 1.234, "drift_ppm": -8.0}


@pytest.fixture(scope="module", autouse=True)
def drawn_pictures() -> Iterator[None]:
    with drawn():
        yield


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> tuple[Survey, Store]:
    """A short drive with wrong clocks of the heads and of the encoder, ingested."""
    scene = Scene.parse(
        {
            "id": "clocks",
            "length_m": 600.0,
            "road": {"alignment": [{"kind": "straight", "length_m": 700.0}]},
            "profilers": {"spacing_m": 2.0, "readings": 20, "head_imus": "tactical", "clock": HEADS},
            "encoder": {"on": True, "clock": WHEEL, "side_m": 0.78},
            "imu": {"on": True},
            "lidar": {"on": False},
        }
    )
    file = simulate(scene, tmp_path_factory.mktemp("clocks") / "survey").survey_file
    file.write_text(
        file.read_text()
        + """
[[clocks]]
sensor = "profiler_left_imu"
also = ["profiler_left", "profiler_right"]

[[clocks]]
sensor = "profiler_right_imu"
against = "imu"

[[clocks]]
sensor = "encoder"
"""
    )
    survey = Survey.load(file)
    store = Store(survey.store_url, survey.config.id)
    ingest(survey, store)
    return survey, store


def start_gps_ns() -> int:
    return gps_ns_from_utc(dt.datetime(2026, 5, 4, 9, 30, tzinfo=dt.UTC))


def true_epochs(shown: np.ndarray, clock: dict[str, float]) -> np.ndarray:
    """GPS ns (n,) at which a simulated clock shows `shown`."""
    elapsed = (shown - start_gps_ns()) / S
    return start_gps_ns() + (elapsed - clock["offset_s"]) / (1.0 + clock["drift_ppm"] * 1e-6) * S


def test_clocks_of_a_survey(driven: tuple[Survey, Store]) -> None:
    survey, store = driven
    said: list[str] = []
    found = estimate_clocks(survey, store, said.append)
    clocks = load_clocks(store)
    heads = ["profiler_left", "profiler_left_imu", "profiler_right", "profiler_right_imu"]
    assert sorted(s for _, s in clocks) == ["encoder", *heads]
    assert len(found) == 5
    for sensor in [*heads, "encoder"]:
        clock, limit_ms = (WHEEL, 0.2) if sensor == "encoder" else (HEADS, 0.2)
        one = clocks[("run-1", sensor)]
        shown = np.linspace(one.first_gps_ns, one.last_gps_ns, 9).astype(np.int64)
        error_ms = (one.applied(shown) - true_epochs(shown, clock)) / 1e6
        assert np.abs(error_ms).max() < limit_ms, sensor
        assert np.abs(error_ms / one.sigma_s(shown) / 1e3).max() < 4.0
    assert clocks[("run-1", "profiler_left")] == clocks[("run-1", "profiler_left_imu")]
    assert sum(line.startswith("estimated: ") for line in said) == 3


def test_the_tables_in_sql_and_the_picture(driven: tuple[Survey, Store]) -> None:
    survey, store = driven
    estimate_clocks(survey, store)
    rows = query(store, "SELECT * FROM clocks WHERE sensor = 'profiler_left_imu'").to_pylist()
    assert [r["method"] for r in rows] == ["motion against trajectory"]
    left = query(
        store,
        "SELECT sum(weight) AS w, count(*) AS n, sum(used) AS u FROM clock_residuals GROUP BY sensor ORDER BY sensor",
    ).to_pylist()
    assert len(left) == 3  # those that share a clock are not repeated
    assert [r["w"] for r in left] == pytest.approx([1.0] * 3)
    assert rows[0]["residuals"] + rows[0]["refused"] == left[1]["n"]
    assert rows[0]["residuals"] == left[1]["u"]
    pictures = store.files("products/clocks", ".png")
    assert [Path(p).name for p in pictures] == [
        "run-1_encoder.png", "run-1_profiler_left_imu.png", "run-1_profiler_right_imu.png",
    ]  # fmt: skip
    image = cv2.imdecode(np.frombuffer(store.read_bytes(pictures[0]), np.uint8), cv2.IMREAD_COLOR)
    assert image.shape[1] == 1200
    assert (image != 255).any(axis=2).mean() > 0.02


def test_a_picture_that_is_gone_or_damaged_is_seen_and_drawn_again(driven: tuple[Survey, Store]) -> None:
    """From the table: no clock is estimated for it."""
    survey, store = driven
    estimate_clocks(survey, store)
    paths = store.files("products/clocks", ".png")
    before = {path: store.read_bytes(path) for path in paths}
    store.remove(paths[0])
    store.write_bytes(paths[1], before[paths[1]][::-1])
    faults = verify_store(store)
    assert [any(path in fault for fault in faults) for path in paths] == [True, True, False]
    said: list[str] = []
    estimate_clocks(survey, store, said.append)
    assert all(line.startswith("known: ") for line in said)
    assert {path: store.read_bytes(path) for path in store.files("products/clocks", ".png")} == before
    assert verify_store(store) == []
    lines = survey_status(Session(survey, store)).of("navigate").lines
    assert sum(line.startswith("clock of run-1/") for line in lines) == 5
    assert any(line.startswith("clock of run-1/encoder: ") and line.endswith("run-1_encoder.png") for line in lines)


def test_nothing_is_done_twice(driven: tuple[Survey, Store]) -> None:
    survey, store = driven
    estimate_clocks(survey, store)
    before = {p: store.read_bytes(p) for p in store.files("tables/clocks")}
    stamps = {p: Path(store.path(p)).stat().st_mtime_ns for p in store.files("products/clocks")}
    said: list[str] = []
    estimate_clocks(survey, store, said.append)
    assert all(line.startswith("known: ") for line in said)
    assert {p: store.read_bytes(p) for p in before} == before
    assert {p: Path(store.path(p)).stat().st_mtime_ns for p in stamps} == stamps
    # Another setting: that clock alone is estimated again; one no longer listed leaves the table.
    other = changed(survey, {"clocks": [{"sensor": "encoder", "search_s": 4.0}]})
    said.clear()
    estimate_clocks(other, store, said.append)
    assert [line.split(":")[0] for line in said] == ["estimated"]
    assert sorted(load_clocks(store)) == [("run-1", "encoder")]


def test_one_that_fails_leaves_the_others(driven: tuple[Survey, Store]) -> None:
    survey, store = driven
    entries = [{"sensor": "encoder"}, {"sensor": "profiler_left_imu", "search_s": 0.3}]
    with pytest.raises(RunError, match=r"1 clocks could not be estimated.*run 'run-1', sensor 'profiler_left_imu'"):
        estimate_clocks(changed(survey, {"clocks": entries}), store)
    assert sorted(load_clocks(store)) == [("run-1", "encoder")]


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({"sensor": "profiler_left"}, "of kind profiler.*name the IMU inside it"),
        ({"sensor": "encodr"}, r"unknown sensor 'encodr' \(did you mean 'encoder'"),
        ({"sensor": "encoder", "runs": ["run-9"]}, "unknown run 'run-9'"),
        ({"sensor": "encoder", "against": "imu"}, "encoder 'encoder' against an IMU"),
        ({"sensor": "imu", "against": "encoder"}, "of kind encoder"),
    ],
)
def test_what_cannot_be_is_refused(driven: tuple[Survey, Store], entry: dict[str, Any], words: str) -> None:
    survey, store = driven
    with pytest.raises(ConfigError, match=words):
        estimate_clocks(changed(survey, {"clocks": [entry]}), store)


def test_a_trajectory_with_the_same_clock_in_it_is_refused(driven: tuple[Survey, Store]) -> None:
    survey, store = driven
    records = {r.sensor: r for r in survey_records(survey, store)}
    solved = replace(
        records["trajectory"], key="solved", sensor="navigation", attributes={"logs": [records["imu"].key]}
    )
    write_log_record(store, solved)
    stated = changed(survey, {"clocks": [{"sensor": "imu"}]})
    runs = stated.config.model_dump()["runs"]
    runs[0]["logs"] = [log for log in runs[0]["logs"] if log["sensor"] is not None]
    with pytest.raises(ConfigError, match="computed with the log of 'imu'"):
        estimate_clocks(changed(stated, {"runs": runs}), store)


def test_a_survey_without_clocks_gets_no_tables(driven: tuple[Survey, Store], tmp_path: Path) -> None:
    log = wheel_log(tmp_path, start_gps_ns() // 1000 + np.arange(10) * 1_000_000)
    survey, store = pair_survey(tmp_path, log | {"clock": {"system": "gps", "unit": "us"}})
    ingest(survey, store)
    assert estimate_clocks(survey, store) == []
    assert store.files("tables/clocks") == []


def test_a_delay_of_the_sensor_is_not_one_of_its_clock(driven: tuple[Survey, Store]) -> None:
    survey, store = driven
    entry = {"sensor": "profiler_left_imu", "also": ["profiler_left"]}
    estimate_clocks(changed(survey, {"clocks": [entry]}), store)
    plain = load_clocks(store)
    estimate_clocks(changed(survey, {"clocks": [entry | {"delay_s": 0.0025}]}), store)
    delayed = load_clocks(store)
    for sensor in ("profiler_left", "profiler_left_imu"):
        shift = delayed[("run-1", sensor)].offset_s - plain[("run-1", sensor)].offset_s
        assert shift == pytest.approx(0.0025, abs=1e-9)  # stamps are late by it, so the clock is less ahead


# --- the page -----------------------------------------------------------------------------------------

ROOT = Path(__file__).resolve().parent.parent.parent


def test_what_the_page_states_can_be_stated() -> None:
    blocks = re.findall(r"```toml\n(.*?)```", (ROOT / "docs" / "clocks.md").read_text(), re.DOTALL)
    parsed = [tomllib.loads(block) for block in blocks]
    logs = [LogConfig.parse({"path": "a"} | one) for one in parsed if "clock" in one]
    entries = [MotionEvidence.parse(entry) for one in parsed for entry in one.get("clocks", [])]
    assert [log.clock is not None and log.clock.pairs is not None for log in logs] == [True, True]
    example = tomllib.loads((ROOT / "docs" / "examples" / "clocks-survey.toml").read_text())["clocks"]
    assert [e.sensor for e in entries] == [e["sensor"] for e in example]
    scene = Scene.load(ROOT / "docs" / "examples" / "clocks.toml")
    assert (scene.profilers.clock.offset_s, scene.encoder.clock.offset_s) == (-0.7312, 1.234)


# --- pairs --------------------------------------------------------------------------------------------


def pair_survey(folder: Path, log: dict[str, Any]) -> tuple[Survey, Store]:
    values = {
        "id": "pairs",
        "rig": {"sensors": {"camera": {"kind": "camera"}, "wheel": {"kind": "encoder", "metres_per_tick": 0.001}}},
        "map": {"crs": "EPSG:25832"},
        "runs": [{"id": "drive", "logs": [log]}],
    }
    survey = Survey.parse(values, folder=folder)
    return survey, Store(survey.store_url, "pairs")


def epochs_of(store: Store, table: str) -> np.ndarray:
    files = store.files(f"tables/{table}", ".parquet")
    return np.sort(np.concatenate([pq.read_table(store.path(f))["epoch_gps_ns"].to_numpy() for f in files]))


def wheel_log(folder: Path, stamps: np.ndarray) -> dict[str, Any]:
    lines = ["time_us,ticks", *(f"{t},{k * 100}" for k, t in enumerate(stamps.tolist()))]
    (folder / "wheel.csv").write_text("\n".join(lines) + "\n")
    return {"path": "wheel.csv", "format": "encoder_csv", "sensor": "wheel", "options": {"record": "total"}}


def test_a_free_counter_is_ingested_by_pairs(tmp_path: Path) -> None:
    """A counter of microseconds, 40 ppm fast, compared with a receiver's screen five times; one misread by a second."""
    true = start_gps_ns() + np.arange(0, 3600, 10) * S
    count = 5_000_000 + np.rint((true - start_gps_ns()) / 1000 * (1 + 40e-6)).astype(np.int64)
    at = np.array([30, 100, 180, 250, 330])
    seconds = (true[at] / S) % 604_800
    seconds[2] += 1.0
    typed = [{"stamp": int(count[k]), "time": float(t)} for k, t in zip(at, seconds, strict=True)]
    log = wheel_log(tmp_path, count)
    log["clock"] = {
        "system": "free",
        "unit": "us",
        "pairs": {"typed": typed, "system": "gps_week_seconds", "week": 2417, "sigma_s": 0.001, "drift": "estimate"},
    }
    survey, store = pair_survey(tmp_path, log)
    ingest(survey, store)
    assert np.abs(epochs_of(store, "encoder") - true).max() < 3_000
    estimate_clocks(survey, store)
    (row,) = query(store, "SELECT * FROM clocks").to_pylist()
    assert (row["method"], row["applied"], row["residuals"], row["refused"]) == ("pairs", "ingest", 4, 1)
    assert row["drift_ppm"] == pytest.approx(-40.0, abs=0.01)
    left = query(store, "SELECT residual_s, used FROM clock_residuals ORDER BY epoch_gps_ns").to_pylist()
    assert [r["used"] for r in left] == [1, 1, 0, 1, 1]
    assert left[2]["residual_s"] == pytest.approx(1.0, abs=1e-3)
    assert load_clocks(store) == {}  # applied already: nothing is corrected twice
    assert store.exists("products/clocks/drive_wheel_pairs.png")


def test_host_arrivals_from_a_table(tmp_path: Path) -> None:
    """Records are never early at the host; its clock is UTC. One line is damaged, and costs itself."""
    draw = np.random.default_rng(4)
    true = start_gps_ns() + np.arange(0, 600_000, 100) * 1_000_000
    count = 1_000_000 + np.rint((true - start_gps_ns()) / 1000 * (1 - 25e-6)).astype(np.int64)
    late = 0.0008 + draw.exponential(0.003, true.size) + np.where(draw.random(true.size) < 0.03, 0.1, 0.0)
    host = true - 18 * S + 315_964_800 * S + np.rint(late * S).astype(np.int64)
    lines = ["stamp;time", *(f"{c};{h // S}.{h % S:09d}" for c, h in zip(count.tolist(), host.tolist(), strict=True))]
    lines[17] = "1234;yesterday"
    (tmp_path / "arrivals.csv").write_text("\n".join(lines))
    log = wheel_log(tmp_path, count)
    pairs = {"table": "arrivals.csv", "system": "unix_utc", "sigma_s": 1e-5, "arrivals": True}
    log["clock"] = {"system": "free", "unit": "us", "pairs": pairs | {"least_latency_s": 0.0008}}
    survey, store = pair_survey(tmp_path, log)
    ingest(survey, store)
    assert np.abs(epochs_of(store, "encoder") - true).max() < 0.05e6
    said: list[str] = []
    estimate_clocks(survey, store, said.append)
    assert any("arrivals.csv, record 17" in line and line.startswith("left out") for line in said)
    # Without the least latency the epochs are late by it, and the run says so.
    log["clock"] = {"system": "free", "unit": "us", "pairs": pairs}
    survey, store = pair_survey(tmp_path, log)
    ingest(survey, store)
    assert np.median(epochs_of(store, "encoder") - true) == pytest.approx(0.8e6, abs=0.05e6)
    said.clear()
    estimate_clocks(survey, store, said.append)
    assert any("no least_latency_s is stated" in line for line in said)


def test_a_changed_pair_reads_the_log_again(tmp_path: Path) -> None:
    log = wheel_log(tmp_path, np.arange(10) * 1_000_000)
    for moment in ("2026-05-04T09:30:00Z", "2026-05-04T09:30:01.5Z"):
        pair = {"stamp": 2_000_000, "time": moment}
        log["clock"] = {"system": "free", "unit": "us", "pairs": {"typed": [pair], "sigma_s": 0.1}}
        survey, store = pair_survey(tmp_path, log)
        (result,) = ingest(survey, store)
        assert result.fresh
        first = gps_ns_from_utc(dt.datetime.fromisoformat(moment)) - 2 * S
        assert np.abs(epochs_of(store, "encoder") - first - np.arange(10) * S).max() < 300  # a double of 1.4e9 s


def test_video_by_a_photographed_screen(tmp_path: Path) -> None:
    """The rule of the paper (Sensors 2016, 16, 367, 3.2.2): first frame = end − duration, frame k at k / fps, and the
    offset between the camera's time of a picture of the GPS screen and the GPS week and second on it.
    """
    fps, count = 29.97, 60
    writer = cv2.VideoWriter(str(tmp_path / "drive.avi"), cv2.VideoWriter_fourcc(*"MJPG"), fps, (96, 64))
    for k in range(count):
        writer.write(np.random.default_rng(k).integers(0, 255, (64, 96, 3), dtype=np.uint8))
    writer.release()
    # The camera's clock is 24.58 s slow: its photograph of 09:00:10.00 shows GPS week 2417, 120,652.58 s.
    photograph = {"stamp": "2026-05-04T09:00:10.00", "time": 120_652.58}
    log = {
        "path": "drive.avi",
        "sensor": "camera",
        "clock": {
            "system": "unix_utc",
            "pairs": {"typed": [photograph], "system": "gps_week_seconds", "week": 2417, "sigma_s": 0.05},
        },
        "options": {"end": "2026-05-04T09:31:00.4"},
    }
    survey, store = pair_survey(tmp_path, log)
    ingest(survey, store)
    # 09:00:10 UTC is second 9 h 0 min 28 s of Monday on GPS time: the offset is 120,652.58 − 118,828 s … by hand:
    monday = 86_400 + 9 * 3600 + 10 + 18
    offset = 120_652.58 - monday
    end = gps_ns_from_utc(dt.datetime(2026, 5, 4, 9, 31, 0, 400_000, tzinfo=dt.UTC)) / S
    expected = end + offset - count / fps + np.arange(count) / fps
    assert np.abs(epochs_of(store, "images") / S - expected).max() < 1e-6
    estimate_clocks(survey, store)
    (row,) = query(store, "SELECT * FROM clocks").to_pylist()
    assert row["offset_s"] == pytest.approx(offset, abs=1e-6)
    assert (row["sensor"], row["sigma_offset_s"], row["residuals"]) == ("camera", pytest.approx(0.05), 1)


@pytest.mark.parametrize(
    ("clock", "words"),
    [
        ({"system": "free", "pairs": {"sigma_s": 1.0}}, "either typed.*or table"),
        ({"system": "free", "offset_s": 1.0, "pairs": {"sigma_s": 1.0, "table": "a.csv"}}, "not both"),
        ({"system": "utc_hour", "pairs": {"sigma_s": 1.0, "table": "a.csv"}}, "past the hour cannot be paired"),
        (
            {"system": "free", "pairs": {"sigma_s": 1.0, "typed": [{"stamp": 1, "time": 2.0}]}},
            "state system of the pairs",
        ),
        (
            {"system": "free", "pairs": {"sigma_s": 1.0, "typed": [{"stamp": 1, "time": "2026-05-04T09:30:00"}]}},
            "without a zone",
        ),
        (
            {"system": "free", "pairs": {"sigma_s": 1.0, "typed": [{"stamp": "noon", "time": "2026-05-04T09:30:00Z"}]}},
            "stamp 'noon' of a pair does not fit",
        ),
        (
            {
                "system": "free",
                "pairs": {
                    "sigma_s": 1.0,
                    "system": "gps_week_seconds",
                    "week": 369,
                    "typed": [{"stamp": 1, "time": 5.0}],
                },
            },
            "week 369 began on 1987.*2417",
        ),
        ({"system": "free", "pairs": {"sigma_s": 1.0, "table": "none.csv"}}, "cannot be opened"),
        ({"system": "free", "pairs": {"sigma_s": 1.0, "table": "wheel.csv"}}, "no column 'stamp'"),
    ],
)
def test_pairs_that_cannot_be_are_refused(tmp_path: Path, clock: dict[str, Any], words: str) -> None:
    log = wheel_log(tmp_path, np.arange(5)) | {"clock": clock}
    with pytest.raises(RoadscanError, match=words) as refused:
        ingest(*pair_survey(tmp_path, log))
    assert isinstance(refused.value, ConfigError | FormatError | RunError)


@given(damage=st.lists(st.tuples(st.integers(0, 400), st.binary(min_size=1, max_size=3)), min_size=1, max_size=6))
@settings(max_examples=80, deadline=None)
def test_damaged_tables_of_pairs_never_crash(tmp_path_factory: pytest.TempPathFactory, damage: list[Any]) -> None:
    folder = tmp_path_factory.mktemp("damage")
    rows = [f"{1000 + 7 * k},2026-05-04T09:30:{k:02d}.5Z,0.01" for k in range(12)]
    content = bytearray("\n".join(["stamp,time,sigma_s", *rows]).encode())
    for at, inserted in damage:
        content[at : at + len(inserted)] = inserted
    (folder / "pairs.csv").write_bytes(bytes(content))
    log = {"path": "a", "clock": {"system": "free", "pairs": {"sigma_s": 0.1, "table": "pairs.csv"}}}
    survey, _ = pair_survey(folder, log)
    try:
        found = log_pairs(survey, survey.config.runs[0].logs[0])
    except RoadscanError:
        return
    assert found is not None
    assert np.isfinite([found.fit.offset_s, found.fit.drift]).all()
