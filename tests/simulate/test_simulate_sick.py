"""The line scanner's log, read through the public door, against the places that its beams met."""

from __future__ import annotations

import datetime as dt
import tomllib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from roadscan.core.errors import ConfigError
from roadscan.core.gpstime import Clock, TimeSystem, gps_ns_from_utc
from roadscan.core.rig import ScanGeometry
from roadscan.ingest.reading.format import Reject, format_named
from roadscan.simulate import Scene, simulate, truth
from roadscan.simulate.run import SimulatedSurvey
from roadscan.simulate.sensors.sick import telegrams
from tests.formats.log_reading import Log, source_of
from tests.simulate.chain import WEEK_NS, Chain

SCENE = (
    Scene.load("demo")
    .noiseless()
    .changed(
        length_m=8.0,
        passes=[{"lane": 2}],
        profilers={"on": False},
        lidar={"on": False},
        sick={"on": True, "range_max_m": 12.0},
        roadside={"facades": [{"offset_m": 7.0, "start_m": -10.0, "end_m": 20.0}]},
    )
)
PLACES = ("easting_m", "northing_m", "height_m", "range_m")


def simulated(folder: Path, **sick: object) -> SimulatedSurvey:
    return simulate(SCENE.changed(sick=sick), folder / "survey", write_hits=True)


def stated(survey: SimulatedSurvey) -> dict:
    logs = tomllib.loads(survey.survey_file.read_text())["runs"][0]["logs"]
    return next(log for log in logs if log["format"] == "sick_lms")


def log_of(survey: SimulatedSurvey) -> Log:
    """The log, read as the survey file says."""
    log = stated(survey)
    clock = dict(log["clock"])
    clock = Clock(TimeSystem(clock.pop("system")), **clock)
    source = source_of("sick_lms", survey.folder / log["path"], log["options"], clock=clock)
    reader = format_named("sick_lms")
    header = reader.header(source)
    items = list(reader.read(source, header))
    rows = [item for item in items if not isinstance(item, Reject)]
    rejects = [item for item in items if isinstance(item, Reject)]
    return Log(header.attributes, pa.Table.from_batches([item.batch for item in rows]), rows, rejects)


def hits_of(survey: SimulatedSurvey) -> dict[str, np.ndarray]:
    table = pq.read_table(truth.load(survey.folder).hits_file("run-1", "sick"))
    out = {"epoch_gps_ns": table["epoch_gps_ns"].to_numpy()}
    for name in (*PLACES, "object_id", "is_mixed"):
        column = table[name].combine_chunks()
        out[name] = np.asarray(column.flatten()).reshape(len(column), -1)
    return out


def ranges_of(log: Log) -> np.ndarray:
    column = log.table["range"].combine_chunks()
    return np.asarray(column.flatten()).reshape(len(column), -1)


@pytest.mark.parametrize(
    ("settings", "readings", "turns"),
    [
        ({}, 361, 1),
        ({"resolution_deg": 1.0, "scans_per_s": 40.0, "range_max_m": 8.0}, 181, 1),
        ({"interlaced": True, "scans_per_s": 37.5, "range_max_m": 30.0}, 361, 2),
    ],
)
def test_the_log_is_read_as_it_was_measured(tmp_path: Path, settings: dict, readings: int, turns: int):
    survey = simulated(tmp_path, **settings)
    log, hits = log_of(survey), hits_of(survey)
    assert not log.rejects
    np.testing.assert_array_equal(log.epochs, hits["epoch_gps_ns"])
    ranges = ranges_of(log)
    assert ranges.shape == hits["range_m"].shape
    assert ranges.shape[1] == readings
    seen = ranges > 0
    np.testing.assert_array_equal(seen, np.isfinite(hits["range_m"]))
    assert np.abs(ranges[seen] / 1000.0 - hits["range_m"][seen]).max() < 0.000501
    assert 0.25 < seen.mean() * turns < 0.95
    assert set(hits["object_id"][seen]) == {0, 1}
    assert (hits["object_id"][~seen] == -1).all()
    if turns == 2:  # a reading is measured in one turn only
        assert not (seen[0::2] & seen[1::2]).any()
        assert set(np.diff(log.epochs)[0::2]) == {13_333_333}

    # From the stated angles, times and mountings, by SciPy and pyproj, to where the simulator's beams met something.
    geometry = ScanGeometry.model_validate(log.attributes["scan_geometry"])
    origins, directions = geometry.rays()
    row, reading = np.nonzero(seen)
    sensor = tomllib.loads(survey.rig_file.read_text())["sensors"]["sick"]
    chain = Chain(survey.folder / "raw" / "run-1" / "trajectory.sbet", "EPSG:32632")
    epochs = log.epochs[row] + reading * geometry.reading_period_ns
    points = origins[reading] + hits["range_m"][row, reading][:, None] * directions[reading]
    ground = chain.to_ground((epochs % WEEK_NS) / 1e9, sensor, points)
    expected = np.stack([hits[name][row, reading] for name in PLACES[:3]], axis=-1)
    assert np.abs(ground - expected).max() < 2e-5

    known = truth.load(survey.folder)
    on_road = hits["object_id"] == 0
    height = known.surface.height_m(hits["easting_m"][on_road], hits["northing_m"][on_road], texture=False)
    assert np.abs(height - hits["height_m"][on_road]).max() < 1e-6
    _, offset = known.station_offset_m(hits["easting_m"][~on_road & seen], hits["northing_m"][~on_road & seen])
    assert offset.min() > 6.99
    # Readings run from right to left.
    _, aside = known.station_offset_m(hits["easting_m"][on_road], hits["northing_m"][on_road])
    middle = np.nonzero(on_road)[1]
    assert np.corrcoef(middle, aside)[0, 1] < -0.9


def test_telegram_by_hand():
    row = telegrams(np.arange(1, 362, dtype=np.uint16)[None])[0].tobytes()
    assert row[:7] == bytes.fromhex("0280d602b06941")  # 726 bytes of data; 361 values, millimetres
    assert row[7:11] == bytes.fromhex("01000200")
    assert row[-3] == 0x10
    assert len(row) == 4 + 726 + 2
    # The listing's own loop: uCrc16 <<= 1 (with 0x8005 where the highest bit goes out), ^= byte | byte before << 8.
    crc, before = 0, 0
    for byte in row[:-2]:
        crc = ((crc & 0x7FFF) << 1) ^ (0x8005 if crc & 0x8000 else 0)
        crc ^= byte | before << 8
        before = byte
    assert int.from_bytes(row[-2:], "little") == crc


def test_a_wrong_clock_is_in_the_stamps(tmp_path: Path):
    wrong = {"offset_s": -0.5, "drift_ppm": 100.0}
    survey = simulated(tmp_path, clock=wrong)
    hits = hits_of(survey)
    shown = log_of(survey).epochs
    start = gps_ns_from_utc(dt.datetime(2026, 5, 4, 9, 30, tzinfo=dt.UTC))
    expected = -0.5e9 + 100e-6 * (hits["epoch_gps_ns"] - start)
    assert np.abs(shown - hits["epoch_gps_ns"] - expected).max() <= 1.0
    # Where the survey file states the correction, the epochs come out right.
    known = simulate(SCENE.changed(sick={"clock": wrong | {"known": True}}), tmp_path / "known", write_hits=True)
    assert np.abs(log_of(known).epochs - hits_of(known)["epoch_gps_ns"]).max() < 1_000


def test_noise_dropouts_and_wide_beams(tmp_path: Path):
    noisy = SCENE.changed(noise={"sick_range_m": 0.01, "dropout": 0.1}, sick={"divergence_deg": 0.5})
    survey = simulate(noisy, tmp_path / "survey", write_hits=True)
    ranges, hits = ranges_of(log_of(survey)), hits_of(survey)
    seen = ranges > 0
    off = ranges[seen] / 1000.0 - hits["range_m"][seen]
    assert off.std() == pytest.approx(0.01, rel=0.05)
    plain = hits_of(simulated(tmp_path / "plain"))
    kept = np.isfinite(plain["range_m"])
    assert seen[kept].mean() == pytest.approx(0.9, abs=0.02)
    assert 0.0 < hits["is_mixed"].mean() < 0.03
    same = seen & kept & ~hits["is_mixed"]
    np.testing.assert_array_equal(hits["range_m"][same], plain["range_m"][same])
    again = simulate(noisy, tmp_path / "again")
    for name in ("sick.lms", "sick_stamps.csv"):
        files = [done.folder / "raw" / "run-1" / name for done in (survey, again)]
        assert files[0].read_bytes() == files[1].read_bytes()


def test_settings_that_cannot_be():
    with pytest.raises(ConfigError, match="interlaced scans are scans of 0"):
        Scene().changed(sick={"interlaced": True})
    with pytest.raises(ConfigError, match="range_max_m"):
        Scene().changed(sick={"range_max_m": 60.0})
