"""SMRMSG: a real file against its text twin, hand-made bytes, damage, and σ carried with SBET poses."""

from __future__ import annotations

import gzip
import math
import struct
from pathlib import Path

import numpy as np
import pytest

from roadscan.core.errors import FormatError, TimeSystemError
from roadscan.core.gpstime import WEEK_S, Clock, TimeSystem
from roadscan.ingest.reading import text_table
from roadscan.ingest.reading.format import format_named, format_of
from tests.formats.log_reading import Log, read_log, source_of

WEEK = 2405
CLOCK = Clock(TimeSystem.GPS_WEEK, week=WEEK)
COLUMNS = (
    "sigma_north_m",
    "sigma_east_m",
    "sigma_down_m",
    "sigma_velocity_north_m_per_s",
    "sigma_velocity_east_m_per_s",
    "sigma_velocity_down_m_per_s",
    "sigma_roll_deg",
    "sigma_pitch_deg",
    "sigma_heading_deg",
)


def record(time: float, **fields: float) -> list[float]:
    """Sigmas of 0.01 … 0.06 in metres, 6, 12 and 30 arc minutes."""
    values = {"north": 0.01, "east": 0.02, "down": 0.03, "vn": 0.04, "ve": 0.05, "vd": 0.06}
    values |= {"roll": 6.0, "pitch": 12.0, "heading": 30.0}
    return [time, *(values | fields).values()]


def packed(records: list[list[float]]) -> bytes:
    return b"".join(struct.pack("<10d", *r) for r in records)


def write(path: Path, records: list[list[float]], tail: bytes = b"") -> Path:
    path.write_bytes(packed(records) + tail)
    return path


def sample() -> bytes:
    """A small valid file."""
    return packed([record(1000.0 + i) for i in range(6)])


def sbet(path: Path, times: list[float]) -> Path:
    path.write_bytes(b"".join(struct.pack("<17d", t, 0.9, 0.2, 100.0, *[0.1] * 13) for t in times))
    return path


def sbet_with(path: Path, accuracy: str) -> Log:
    return read_log("sbet", path, {"accuracy": accuracy}, clock=CLOCK, crs="EPSG:4979")


def seconds(log: Log) -> list[float]:
    return ((log.epochs - WEEK * WEEK_S * 10**9) / 1e9).tolist()


def test_the_real_file_equals_its_text_twin(recordings: Path, tmp_path: Path) -> None:
    packed_path = recordings / "formats" / "accuracy.smrmsg.gz"
    with gzip.open(recordings / "formats" / "accuracy.smrmsg.txt.gz", "rt") as stream:
        twin = np.loadtxt(stream, delimiter=",", skiprows=1)
    assert twin.shape == (21_902, 10)
    assert format_of(packed_path).name == "smrmsg"
    plain_path = tmp_path / "accuracy.smrmsg"
    plain_path.write_bytes(gzip.decompress(packed_path.read_bytes()))
    assert format_of(plain_path).name == "smrmsg"
    log, plain = (read_log("smrmsg", path, clock=CLOCK) for path in (packed_path, plain_path))
    assert log.table.equals(plain.table)
    assert log.rejects == []
    assert log.table.num_rows == 21_902
    np.testing.assert_allclose(seconds(log), twin[:, 0], rtol=0, atol=0.6e-6)  # the text's six decimals
    for i, name in enumerate(COLUMNS, 1):
        minutes = 60.0 if name.endswith("_deg") else 1.0
        np.testing.assert_allclose(log.column(name) * minutes, twin[:, i], rtol=1.5e-7, atol=0.51e-6)


def test_arc_minutes_become_degrees(tmp_path: Path) -> None:
    log = read_log("smrmsg", write(tmp_path / "a.out", [record(100.5)]), clock=CLOCK)
    row = log.table.to_pylist()[0]
    assert row.pop("epoch_gps_ns") == WEEK * WEEK_S * 10**9 + 100_500_000_000
    assert row == pytest.approx(dict(zip(COLUMNS, [0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.1, 0.2, 0.5], strict=True)))


def test_a_week_ends(tmp_path: Path) -> None:
    path = write(tmp_path / "a.out", [record((WEEK_S - 1.5 + 0.5 * i) % WEEK_S) for i in range(6)])
    assert seconds(read_log("smrmsg", path, clock=CLOCK)) == [WEEK_S - 1.5 + 0.5 * i for i in range(6)]


def damaged() -> list[list[float]]:
    records = [record(1000.0 + i) for i in range(20)]
    records[3] = record(math.nan)
    records[7] = record(1007.0, north=-0.1)
    records[8] = record(1008.0, north=1e300)
    records[9] = record(1009.0, heading=math.inf)
    records[12] = record(5000.0)
    return records


def test_each_damaged_record_costs_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(text_table, "BLOCK_BYTES", 200)  # pieces end inside records
    log = read_log("smrmsg", write(tmp_path / "a.out", damaged(), tail=b"\x01" * 30), clock=CLOCK)
    assert {(r.record, r.records, r.offset): r.reason for r in log.rejects} == {
        (3, 1, 240): "time stamp is missing or not a number",
        (7, 2, 560): "sigma_north_m is no σ: not within 0 to 1e+06",
        (9, 1, 720): "sigma_heading_deg is missing or not a number",
        (12, 1, 960): "time stamp leaps out of the log's order by over 10 s and back",
        (20, 1, 1600): "the file ends inside a record: 30 bytes of 80",
    }
    assert seconds(log) == [1000.0 + i for i in range(20) if i not in (3, 7, 8, 9, 12)]


def test_a_packed_file_that_breaks_off(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    records = [record(1000.0 + i, north=float(rng.uniform(0.01, 0.1))) for i in range(500)]
    path = tmp_path / "a.out.gz"
    whole = gzip.compress(packed(records))
    path.write_bytes(whole[: len(whole) // 2])
    log = read_log("smrmsg", path, clock=CLOCK)
    assert 0 < log.table.num_rows < 500
    (reject,) = log.rejects
    assert reject.record == log.table.num_rows
    assert reject.offset == 80 * log.table.num_rows
    assert "damaged from here on" in reject.reason


@pytest.mark.parametrize(
    ("clock", "says"),
    [
        (None, "time system is not stated"),
        (Clock(TimeSystem.GPS_WEEK), "the week is not known"),
    ],
)
def test_the_clock_is_asked_for(tmp_path: Path, clock: Clock | None, says: str) -> None:
    path = write(tmp_path / "a.out", [record(100.0)])
    with pytest.raises(TimeSystemError, match=says):
        format_named("smrmsg").header(source_of("smrmsg", path, clock=clock))


def test_a_clock_that_fits_nothing(tmp_path: Path) -> None:
    path = write(tmp_path / "a.out", [record(1.4e9)])
    with pytest.raises(TimeSystemError, match=r"a\.out, record 0: .* is not seconds of the GPS week"):
        read_log("smrmsg", path, clock=CLOCK)


def test_a_file_without_a_record(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"a\.out: the file has 50 bytes"):
        read_log("smrmsg", write(tmp_path / "a.out", [], tail=b"\x00" * 50), clock=CLOCK)


def test_sniffing(tmp_path: Path, recordings: Path) -> None:
    is_smrmsg = format_named("smrmsg").sniff
    assert is_smrmsg(write(tmp_path / "a", [record(100.0 + i) for i in range(3)], tail=b"cut"))
    assert not is_smrmsg(write(tmp_path / "b", [[0.0] * 10] * 3))
    assert not is_smrmsg(write(tmp_path / "c", [record(100.0), record(99.0)]))
    assert not is_smrmsg(sbet(tmp_path / "d", [100.0 + i for i in range(20)]))
    assert not is_smrmsg(tmp_path)
    assert not is_smrmsg(tmp_path / "absent")
    others = [p for p in recordings.rglob("*") if p.is_file() and ".smrmsg" not in p.name]
    assert [p for p in others if is_smrmsg(p)] == []


# --- carried with the poses of an SBET file ----------------------------------------------------------


def test_sigmas_are_linear_in_time_and_end_with_the_file(tmp_path: Path) -> None:
    write(tmp_path / "acc.out", [record(1001.0, north=0.1, heading=6.0), record(1002.0, north=0.3, heading=60.0)])
    poses = sbet(tmp_path / "a.sbet", [1000.0 + 0.25 * i for i in range(13)])
    log = sbet_with(poses, "acc.out")
    assert log.rejects == []
    north, heading = log.table.column("sigma_north_m").to_pylist(), log.table.column("sigma_heading_deg").to_pylist()
    assert north[:4] == north[9:] == heading[:4] == heading[9:] == [None] * 4
    assert north[4:9] == pytest.approx([0.1, 0.15, 0.2, 0.25, 0.3])
    assert heading[4:9] == pytest.approx([0.1, 0.325, 0.55, 0.775, 1.0])
    assert log.table.column("sigma_pitch_deg").to_pylist()[5] == pytest.approx(0.2)
    bare = read_log("sbet", poses, clock=CLOCK, crs="EPSG:4979")
    assert bare.table.column("sigma_north_m").null_count == 13
    np.testing.assert_array_equal(bare.positions, log.positions)


def test_sigmas_that_are_all_wrong_are_named_as_such(tmp_path: Path) -> None:
    """Not their times, which fit."""
    write(tmp_path / "acc.out", [record(1001.0, north=-0.1), record(1002.0, north=-0.3)])
    with pytest.raises(FormatError, match=r"acc\.out: no record of it is sound: .*sigma_north_m"):
        sbet_with(sbet(tmp_path / "a.sbet", [1000.0 + 0.25 * i for i in range(13)]), "acc.out")


@pytest.mark.parametrize("start", [WEEK_S - 30.0, WEEK_S - 20.0, WEEK_S - 1.0, WEEK_S + 5.0])
def test_either_file_may_start_in_the_other_week(tmp_path: Path, start: float) -> None:
    """The stated week is the poses' first; the accuracy file may begin before or after the week's end."""
    poses = [WEEK_S - 20.0 + i for i in range(40)]
    write(tmp_path / "acc.out", [record((start + i) % WEEK_S, north=0.01 + 0.001 * i) for i in range(60)])
    log = sbet_with(sbet(tmp_path / "a.sbet", [t % WEEK_S for t in poses]), "acc.out")
    expected = [0.01 + 0.001 * (t - start) if t >= start else None for t in poses]
    assert log.table.column("sigma_north_m").to_pylist() == [
        None if e is None else pytest.approx(e, rel=1e-5) for e in expected
    ]


def test_many_blocks_side_by_side(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Interpolation does not depend on how either file is cut into blocks."""
    rng = np.random.default_rng(2)
    known = 1000 + (np.arange(300) + rng.uniform(-0.2, 0.2, 300)) / 3
    sigma = rng.uniform(0.01, 0.1, 300)
    write(tmp_path / "acc.out", [record(t, east=s) for t, s in zip(known, sigma, strict=True)])
    times = np.sort(rng.uniform(990, 1110, 2000))
    poses = sbet(tmp_path / "a.sbet", times.tolist())
    monkeypatch.setattr(text_table, "BLOCK_BYTES", 800)
    monkeypatch.setattr("roadscan.formats.trajectories.sbet.CHUNK_RECORDS", 64)
    log = sbet_with(poses, "acc.out")
    expected = np.interp(times, known, sigma, left=np.nan, right=np.nan)
    np.testing.assert_allclose(log.table.column("sigma_east_m").to_numpy(), expected, rtol=1e-5)


@pytest.mark.parametrize("block", [1 << 20, 200])
def test_no_sigma_is_made_up_in_a_gap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block: int) -> None:
    """One record that is lost is bridged; two or more are not, and poses on the records about the gap keep theirs."""
    monkeypatch.setattr(text_table, "BLOCK_BYTES", block)
    times = [95.0, 96.0, 98.0, 99.0, 200.0, 201.0, 204.0, 205.0]
    write(tmp_path / "acc.out", [record(t, north=0.001 * t) for t in times])
    poses = [97.0, 98.5, 99.0, 99.01, 150.0, 199.99, 200.0, 200.5, 201.0, 202.5, 204.0, 204.5, 206.0]
    log = sbet_with(sbet(tmp_path / "a.sbet", poses), "acc.out")
    unknown = {99.01, 150.0, 199.99, 202.5, 206.0}
    assert log.table.column("sigma_north_m").to_pylist() == [
        None if t in unknown else pytest.approx(0.001 * t, rel=1e-6) for t in poses
    ]
    assert log.table.column("sigma_heading_deg").null_count == len(unknown)


def test_damaged_accuracy_records_are_listed_with_their_file(tmp_path: Path) -> None:
    (tmp_path / "processed").mkdir()
    write(tmp_path / "processed" / "acc.out", damaged(), tail=b"\x01" * 30)
    log = sbet_with(sbet(tmp_path / "a.sbet", [1000.0, 1001.0]), "processed/acc.out")
    assert log.table.column("sigma_north_m").null_count == 0
    assert {r.file for r in log.rejects} == {"processed/acc.out"}
    assert sorted(r.record for r in log.rejects) == [3, 7, 9, 12, 20]


def test_the_accuracy_file_is_part_of_the_fingerprint(tmp_path: Path) -> None:
    log_format = format_named("sbet")
    options = log_format.options.parse({"accuracy": "acc.out"})
    assert log_format.companions(tmp_path / "a.sbet", options) == [tmp_path / "acc.out"]
    assert log_format.companions(tmp_path / "a.sbet", log_format.options.parse({})) == []


def test_wrong_accuracy_files(tmp_path: Path) -> None:
    poses = sbet(tmp_path / "a.sbet", [1000.0 + i for i in range(5)])
    with pytest.raises(FormatError, match=r"absent\.out: the accuracy file does not exist"):
        format_named("sbet").header(source_of("sbet", poses, {"accuracy": "absent.out"}, clock=CLOCK, crs="EPSG:4979"))
    write(tmp_path / "later.out", [record(2000.0 + i) for i in range(5)])
    with pytest.raises(FormatError, match=r"later\.out: no record lies within the time of the trajectory's 5 poses"):
        sbet_with(poses, "later.out")
    write(tmp_path / "empty.out", [])
    with pytest.raises(FormatError, match=r"empty\.out: the file has 0 bytes"):
        sbet_with(poses, "empty.out")


@pytest.mark.parametrize("time", [math.inf, -math.inf, math.nan, 1e308])
def test_sniffing_impossible_times(tmp_path: Path, time: float) -> None:
    (tmp_path / "a.out").write_bytes(struct.pack("<20d", *([time] + [0.1] * 9), *([-time] + [0.1] * 9)))
    assert not format_named("smrmsg").sniff(tmp_path / "a.out")


def test_a_signalling_nan_costs_its_record_without_a_warning(tmp_path: Path) -> None:
    data = bytearray(sample())
    data[160:168] = bytes.fromhex("010000000000f07f")  # arithmetic on it is 'invalid', unlike on a quiet NaN
    (tmp_path / "a.out").write_bytes(data)
    log = read_log("smrmsg", tmp_path / "a.out", clock=CLOCK)
    assert [(r.record, r.reason) for r in log.rejects] == [(2, "time stamp is missing or not a number")]
    assert seconds(log) == [1000.0, 1001.0, 1003.0, 1004.0, 1005.0]
