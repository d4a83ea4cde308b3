"""SBET: a real file, hand-made bytes, damage."""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from roadscan.core.errors import ConfigError, CrsError, FormatError, TimeSystemError
from roadscan.core.gpstime import WEEK_S, Clock, TimeSystem
from roadscan.formats.trajectories import sbet
from roadscan.ingest.reading.format import format_named, format_of
from tests.formats.log_reading import read_log, source_of

WEEK = 2405
CLOCK = Clock(TimeSystem.GPS_WEEK, week=WEEK)
STATED: dict[str, Any] = {"clock": CLOCK, "crs": "EPSG:4979"}
ECEF = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)


def record(
    time: float, latitude_deg: float = 50.0, *, heading: float = 0.3, wander: float = 0.0, **fields: float
) -> list[float]:
    values = {"height": 120.0, "roll": 0.01, "pitch": -0.02, "longitude_deg": 10.0} | fields
    longitude, latitude = math.radians(values["longitude_deg"]), math.radians(latitude_deg)
    position = [time, latitude, longitude, values["height"]]
    return [*position, 5.0, 6.0, 0.1, values["roll"], values["pitch"], heading, wander, *[0.1] * 6]


def write(path: Path, records: list[list[float]], tail: bytes = b"") -> Path:
    path.write_bytes(b"".join(struct.pack("<17d", *r) for r in records) + tail)
    return path


# Time, latitude, longitude, height, roll, pitch, platform heading, wander angle of the file's two records
# as PDAL's own test of it lists them (SbetReaderTest.cpp, testRead).
PUBLISHED = np.array(
    [
        [1.516310028360710e05, 5.680211852972264e-01, -2.041654392303940e00, 1.077152953296560e02],
        [-2.813407149321339e-02, -2.429905393889139e-02, 3.046773230278662e00, -2.198414736922658e-02],
        [1.516310078318641e05, 5.680211834722869e-01, -2.041654392034053e00, 1.077151424357507e02],
        [-2.813856631423094e-02, -2.425215669392169e-02, 3.047131105236811e00, -2.198416007932108e-02],
    ]
).reshape(2, 8)


def test_two_real_points(recordings: Path) -> None:
    path = recordings / "formats" / "two_points.sbet"
    assert format_of(path).name == "sbet"
    log = read_log("sbet", path, clock=Clock(TimeSystem.GPS_WEEK, week=1500), crs="EPSG:4979")
    assert log.attributes == {"world_frame": "EPSG:4978"}
    assert log.rejects == []
    for i, (time, latitude, longitude, height, roll, pitch, heading, wander) in enumerate(PUBLISHED):
        expected = ECEF.transform(math.degrees(longitude), math.degrees(latitude), height)
        np.testing.assert_allclose(log.positions[i], expected, atol=1e-8)
        assert log.epochs[i] == pytest.approx((1500 * WEEK_S + time) * 1e9, abs=500)
        ned = Rotation.from_euler("ZYX", [heading - wander, pitch, roll])
        ecef_from_ned = Rotation.from_euler("ZY", [longitude, -latitude - math.pi / 2])
        assert (log.attitudes[i] * (ecef_from_ned * ned).inv()).magnitude() < 1e-12


def test_velocities_of_two_real_points_are_those_of_their_positions(recordings: Path) -> None:
    """Along the axes of the wander frame as the recording has them; the points lie 5 ms apart."""
    log = read_log(
        "sbet", recordings / "formats" / "two_points.sbet", clock=Clock(TimeSystem.GPS_WEEK, week=1500), crs="EPSG:4979"
    )
    (rows,) = log.rows
    assert rows.velocity_level_m_per_s is not None
    stated = rows.velocity_level_m_per_s.astype(np.float64).mean(axis=0)
    time, latitude, longitude = PUBLISHED[:, 0], PUBLISHED[:, 1], PUBLISHED[:, 2]
    level = Rotation.from_euler("ZY", [longitude[0], -latitude[0] - math.pi / 2])
    moved = level.inv().apply(log.positions[1] - log.positions[0]) / (time[1] - time[0])
    np.testing.assert_allclose(stated, moved, atol=0.03)


def test_true_heading_is_platform_heading_less_wander_angle(tmp_path: Path) -> None:
    path = write(tmp_path / "a.sbet", [record(100.0, heading=1.0, wander=0.4), record(101.0, heading=0.6, wander=0.0)])
    turned, straight = read_log("sbet", path, **STATED).attitudes
    assert (turned * straight.inv()).magnitude() < 1e-12


def test_a_week_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sbet, "CHUNK_RECORDS", 3)  # the week ends inside a chunk, and between chunks
    times = [WEEK_S - 1.5 + 0.5 * i for i in range(12)]
    path = write(tmp_path / "a.sbet", [record(t % WEEK_S) for t in times])
    log = read_log("sbet", path, **STATED)
    np.testing.assert_array_equal(log.epochs, [int((WEEK * WEEK_S + t) * 1e9) for t in times])
    counted_on = write(tmp_path / "b.sbet", [record(t) for t in times])
    np.testing.assert_array_equal(read_log("sbet", counted_on, **STATED).epochs, log.epochs)


def test_other_time_systems(tmp_path: Path) -> None:
    path = write(tmp_path / "a.sbet", [record(1.4e9)])
    assert read_log("sbet", path, clock=Clock(TimeSystem.GPS), crs="EPSG:4979").epochs.tolist() == [
        1_400_000_000 * 10**9
    ]
    with pytest.raises(TimeSystemError, match=r"a\.sbet, record 0: .* is not seconds of the GPS week"):
        read_log("sbet", path, **STATED)


def test_each_damaged_record_costs_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sbet, "CHUNK_RECORDS", 8)
    records = [record(1000.0 + i) for i in range(30)]
    records[3] = record(1003.0, 95.0)
    records[4] = record(1004.0, 96.0)
    records[9] = record(math.nan)
    records[12] = record(1012.0, longitude_deg=1e9)
    records[13] = record(1013.0, height=math.inf)
    records[14] = record(1014.0, roll=math.nan)
    records[20] = record(1020.0, heading=math.inf, wander=math.inf)
    records[25] = record(400_000.0)  # a plausible second of the week, but not between its neighbours
    path = write(tmp_path / "a.sbet", records, tail=b"\x01" * 100)
    log = read_log("sbet", path, **STATED)
    rejects = {r.record: (r.records, r.offset, r.reason) for r in log.rejects}
    assert rejects == {
        3: (2, 3 * 136, "latitude is outside -1.5708 to 1.5708 rad"),
        9: (1, 9 * 136, "time stamp is missing or not a number"),
        12: (1, 12 * 136, "longitude is outside -6.28319 to 6.28319 rad"),
        13: (1, 13 * 136, "height is missing or not a number"),
        14: (1, 14 * 136, "roll is missing or not a number"),
        20: (1, 20 * 136, "heading is missing or not a number"),
        25: (1, 25 * 136, "time stamp leaps out of the log's order by over 10 s and back"),
        30: (1, 30 * 136, "the file ends inside a record: 100 bytes of 136"),
    }
    good = [i for i in range(30) if i not in (3, 4, 9, 12, 13, 14, 20, 25)]
    np.testing.assert_array_equal(log.epochs, [(WEEK * WEEK_S + 1000 + i) * 10**9 for i in good])
    first = log.rows[0]
    assert (first.first_record, first.first_offset, first.record_bytes) == (0, 0, 0)  # broken by rejects
    last = log.rows[-1]
    assert last.first_record == 24


def test_rows_without_gaps_know_their_offsets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sbet, "CHUNK_RECORDS", 10)
    path = write(tmp_path / "a.sbet", [record(1000.0 + i) for i in range(25)])
    rows = read_log("sbet", path, **STATED).rows
    assert [(r.first_record, r.first_offset, r.record_bytes) for r in rows] == [
        (0, 0, 136),
        (10, 1360, 136),
        (20, 2720, 136),
    ]


@pytest.mark.parametrize(
    ("stated", "error", "says"),
    [
        ({"crs": "EPSG:4979"}, TimeSystemError, "time system is not stated"),
        ({"crs": "EPSG:4979", "clock": Clock(TimeSystem.GPS_WEEK)}, TimeSystemError, "the week is not known"),
        ({"clock": CLOCK}, ConfigError, "CRS of the log's positions is not stated"),
        ({"clock": CLOCK, "crs": "local"}, ConfigError, "SBET positions are latitude and longitude"),
        ({"clock": CLOCK, "crs": "EPSG:25832"}, CrsError, "no geographic CRS"),
    ],
)
def test_what_the_file_does_not_say_is_asked_for(tmp_path: Path, stated: dict, error: type, says: str) -> None:
    path = write(tmp_path / "a.sbet", [record(100.0)])
    with pytest.raises(error, match=says):
        format_named("sbet").header(source_of("sbet", path, **stated))


def test_a_file_without_a_record(tmp_path: Path) -> None:
    path = write(tmp_path / "a.sbet", [], tail=b"\x00" * 50)
    with pytest.raises(FormatError, match="the file has 50 bytes"):
        read_log("sbet", path, **STATED)


def test_sniffing(tmp_path: Path, recordings: Path) -> None:
    is_sbet = format_named("sbet").sniff
    assert is_sbet(write(tmp_path / "a", [record(100.0 + i) for i in range(3)], tail=b"cut"))
    assert not is_sbet(write(tmp_path / "b", [[0.0] * 17] * 3))
    assert not is_sbet(write(tmp_path / "c", [record(100.0), record(99.0)]))
    assert not is_sbet(tmp_path)
    assert not is_sbet(tmp_path / "absent")
    others = [p for p in recordings.rglob("*") if p.is_file() and p.suffix != ".sbet"]
    assert [p for p in others if is_sbet(p)] == []


@pytest.mark.parametrize("time", [math.inf, -math.inf, math.nan, 1e308])
def test_sniffing_impossible_times(tmp_path: Path, time: float) -> None:
    (tmp_path / "a.out").write_bytes(struct.pack("<34d", *([time] + [0.1] * 16), *([-time] + [0.1] * 16)))
    assert not format_named("sbet").sniff(tmp_path / "a.out")
