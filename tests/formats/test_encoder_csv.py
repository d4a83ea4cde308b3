"""Wheel encoders as CSV: counters that roll over, several wheels, units, damage; a recorded drive."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roadscan.core.errors import ConfigError, FormatError, RoadscanError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.core.rig import Rig, Sensor
from roadscan.ingest.reading.format import format_of
from tests.formats.log_reading import GPS_SECONDS, Log, read_log

ENCODER = Sensor(kind="encoder")
STATED: dict[str, Any] = {"clock": GPS_SECONDS, "sensor": ENCODER}
TOTAL: dict[str, Any] = {"record": "total"}


def sample(records: int = 6) -> bytes:
    """A small valid log (read with `TOTAL`)."""
    lines = [f"{1_400_000_000 + i}.5,{7 * i},{3.5 * i},{3.6 * i}" for i in range(records)]
    return "\n".join(["time_s,ticks,distance_m,speed_km_per_h", *lines, ""]).encode()


def write(path: Path, *lines: str) -> Path:
    path.write_text("\n".join([*lines, ""]), encoding="utf-8")
    return path


def log_of(path: Path, names: str, values: list[Any], options: dict[str, Any], **stated: Any) -> Log:
    lines = [f"{1_400_000_000 + i},{value}" for i, value in enumerate(values)]
    return read_log("encoder_csv", write(path, "time_s," + names, *lines), options, **(STATED | stated))


def wheel(log: Log, name: str, column: str) -> list[Any]:
    return [row[column] for row in log.table.to_pylist() if row["wheel"] == name]


def test_one_wheel(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(sample())
    assert format_of(path).name == "encoder_csv"
    log = read_log("encoder_csv", path, TOTAL, **STATED)
    assert log.rejects == []
    assert log.epochs.tolist() == [(1_400_000_000 + i) * 10**9 + 500_000_000 for i in range(6)]
    assert log.column("ticks").tolist() == [7 * i for i in range(6)]
    np.testing.assert_allclose(log.column("distance_m"), 3.5 * np.arange(6))
    np.testing.assert_allclose(log.column("speed_m_per_s"), np.arange(6), rtol=1e-15)
    assert set(log.column("wheel")) == {""}


@pytest.mark.parametrize(("bits", "first"), [(16, 65_530), (32, 4_294_967_290)])
def test_counters_roll_over_both_ways(tmp_path: Path, bits: int, first: int) -> None:
    turn = 2**bits
    counts = [first, first + 5, 4, 14, 2, first, first - 10]  # over zero, and back over it
    log = log_of(tmp_path / "a.csv", "ticks", counts, TOTAL | {"counter_bits": bits})
    expected = [first, first + 5, turn + 4, turn + 14, turn + 2, first, first - 10]
    assert log.column("ticks").tolist() == expected
    signed = [(c + turn // 2) % turn - turn // 2 for c in counts]  # the same counter read as a signed number
    again = log_of(tmp_path / "a.csv", "ticks", signed, TOTAL | {"counter_bits": bits})
    assert np.diff(again.column("ticks")).tolist() == np.diff(expected).tolist()
    plain = log_of(tmp_path / "a.csv", "ticks", counts, TOTAL)
    assert plain.column("ticks").tolist() == counts


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(-9_000, 9_000), min_size=1, max_size=60), st.integers(0, 65_535))
def test_unrolled_counters_equal_the_way(
    tmp_path_factory: pytest.TempPathFactory, steps: list[int], start: int
) -> None:
    truth = start + np.cumsum([0, *steps])
    log = log_of(
        tmp_path_factory.mktemp("e") / "a.csv", "ticks", (truth % 65_536).tolist(), TOTAL | {"counter_bits": 16}
    )
    np.testing.assert_array_equal(log.column("ticks"), truth)


def test_counters_are_unrolled_across_blocks(tmp_path: Path) -> None:
    truth = 1_000 * np.arange(90_000)  # over 1 MB of text, 1,373 roll-overs
    lines = [f"{1_400_000_000 + 0.01 * i:.2f},{c}" for i, c in enumerate((truth % 65_536).tolist())]
    path = write(tmp_path / "a.csv", "time_s,ticks", *lines)
    assert path.stat().st_size > 1 << 20
    log = read_log("encoder_csv", path, TOTAL | {"counter_bits": 16}, **STATED)
    assert len(log.rows) > 1
    np.testing.assert_array_equal(log.column("ticks"), truth)


def test_a_damaged_count_does_not_shift_the_later_ones(tmp_path: Path) -> None:
    counts = [100, 200, 300, 33_100, 500, 600]
    log = log_of(tmp_path / "a.csv", "ticks", counts, TOTAL | {"counter_bits": 16})
    assert log.column("ticks").tolist() == [100, 200, 300, 500, 600]
    assert [(r.record, r.reason) for r in log.rejects] == [(3, "the counter leaps and comes back")]
    log = log_of(tmp_path / "a.csv", "ticks", counts[:4], TOTAL | {"counter_bits": 16})
    assert [r.record for r in log.rejects] == [3]  # the last one, of which it cannot be known


def test_increments_add_up(tmp_path: Path) -> None:
    log = log_of(tmp_path / "a.csv", "ticks,odometer_cm", ["3,10", "4,20", "-2,-5"], {"record": "increment"})
    assert log.column("ticks").tolist() == [3, 7, 5]
    np.testing.assert_allclose(log.column("distance_m"), [0.1, 0.3, 0.25])


def test_directions(tmp_path: Path) -> None:
    forwards = {"column": "gear", "forwards": ["D", "N"], "backwards": ["R"]}
    values = ["3,5,D", "4,6,N", "2,1,R", "1,1,?"]
    options = {"record": "increment", "direction": forwards}
    log = log_of(tmp_path / "a.csv", "ticks,speed_m_per_s,gear", values, options)
    assert log.column("ticks").tolist() == [3, 7, 5]
    assert log.column("speed_m_per_s").tolist() == [5, 6, -1]
    assert [(r.record, r.reason) for r in log.rejects] == [(3, "the direction is neither forwards nor backwards")]
    turned = log_of(tmp_path / "a.csv", "ticks,speed_m_per_s,gear", values, options | {"counts_backwards": True})
    assert turned.column("ticks").tolist() == [-3, -7, -5]
    with pytest.raises(ConfigError, match="running total has its direction in itself"):
        log_of(tmp_path / "a.csv", "ticks,gear", ["3,D"], TOTAL | {"direction": forwards})


def test_wheels_in_columns(tmp_path: Path) -> None:
    path = write(
        tmp_path / "a.csv",
        "time_s,speed_front_left_km_per_h,rear_right_speed_mph,ticks_rl,brake",
        "1400000000,36,10,100,0",
        "1400000001,72,20,90,0",
    )
    assert format_of(path).name == "encoder_csv"
    log = read_log("encoder_csv", path, TOTAL | {"counts_backwards": ["rl"]}, **STATED)
    np.testing.assert_allclose(wheel(log, "front_left", "speed_m_per_s"), [10, 20])
    np.testing.assert_allclose(wheel(log, "rear_right", "speed_m_per_s"), [4.4704, 8.9408])
    assert wheel(log, "rl", "ticks") == [-100, -90]
    assert wheel(log, "rl", "speed_m_per_s") == [None, None]


def test_the_vehicle_beside_its_wheels(tmp_path: Path) -> None:
    log = log_of(tmp_path / "a.csv", "speed_m_per_s,speed_fl_m_per_s", ["3,4"], {})
    assert {row["wheel"]: row["speed_m_per_s"] for row in log.table.to_pylist()} == {"": 3, "fl": 4}
    stated = {"columns": {"speed": {"name": "speed_fl_m_per_s"}}}
    log = log_of(tmp_path / "a.csv", "speed_m_per_s,speed_fl_m_per_s", ["3,4"], stated)
    assert {row["wheel"]: row["speed_m_per_s"] for row in log.table.to_pylist()} == {"": 4}


def test_a_count_beyond_the_counter_is_damage(tmp_path: Path) -> None:
    log = log_of(tmp_path / "a.csv", "ticks", [1, 70_000, 2], TOTAL | {"counter_bits": 16})
    assert log.column("ticks").tolist() == [1, 2]
    assert [(r.record, r.reason) for r in log.rejects] == [(1, "ticks are more than a counter of 16 bits can show")]


def test_wheels_in_rows(tmp_path: Path) -> None:
    lines = [f"{1_400_000_000 + i // 2},{'LR'[i % 2]},{(65_500 + 20 * i * (i % 2 + 1)) % 65_536}" for i in range(8)]
    path = write(tmp_path / "a.csv", "time_s,wheel,ticks", *lines)
    assert format_of(path).name == "encoder_csv"
    log = read_log("encoder_csv", path, TOTAL | {"counter_bits": 16}, **STATED)
    assert wheel(log, "L", "ticks") == [65_500, 65_540, 65_580, 65_620]
    assert wheel(log, "R", "ticks") == [4, 84, 164, 244]  # a total begins with the first count


def test_a_log_does_not_have_a_thousand_wheels(tmp_path: Path) -> None:
    lines = [f"1400000000,w{i},{i}" for i in range(1_000)]
    log = read_log("encoder_csv", write(tmp_path / "a.csv", "time_s,wheel,ticks", *lines), TOTAL, **STATED)
    assert log.table.num_rows == 64
    assert sum(r.records for r in log.rejects) == 936


@pytest.mark.parametrize(
    ("names", "options", "stated", "error", "message"),
    [
        ("time_s,ticks", {}, STATED, ConfigError, "whether they run on.*total.*increment"),
        ("time_s,distance_m", {}, STATED, ConfigError, "whether they run on"),
        ("time_s,speed", {}, STATED, FormatError, "'speed' says no unit.*km_per_h, .*mph"),
        ("time_s,brake", {}, STATED, FormatError, "no column holds ticks, distance or speed"),
        ("time_s,brake", {"columns": {"pace": {"name": "brake"}}}, STATED, ConfigError, "unknown quantity 'pace'"),
        ("time_s,v", {"columns": {"speed": {"name": "v", "unit": "knots"}}}, STATED, ConfigError, "'knots'.*m_per_s"),
        ("time_s,v", {"wheels": {"fl": {}}}, STATED, ConfigError, "wheels.fl names no column"),
        ("time_s,v", {"wheels": {"fl": {"pace": {"name": "v"}}}}, STATED, ConfigError, "unknown quantity 'pace'"),
        ("time_s,ticks", {"record": "increment", "counter_bits": 16}, STATED, ConfigError, "do not roll over"),
        ("time_s,ticks_fl", TOTAL | {"counts_backwards": ["fr"]}, STATED, ConfigError, "unknown wheel 'fr'.*fl"),
        ("time_s,ticks", TOTAL, {"clock": GPS_SECONDS}, ConfigError, "names no sensor"),
        ("time_s,ticks", TOTAL, STATED | {"sensor": Sensor(kind="imu")}, ConfigError, "kind imu.*kind encoder"),
        ("time_s,ticks", TOTAL, {"sensor": ENCODER}, TimeSystemError, "time system is not stated"),
        ("time_s,ticks", TOTAL, STATED | {"clock": Clock(TimeSystem.GPS, unit="us")}, TimeSystemError, "by its name"),
    ],
)
def test_what_is_not_stated_is_asked_for(
    tmp_path: Path,
    names: str,
    options: dict[str, Any],
    stated: dict[str, Any],
    error: type[RoadscanError],
    message: str,
) -> None:
    path = write(tmp_path / "a.csv", names, "1400000000,1")
    with pytest.raises(error, match=message):
        read_log("encoder_csv", path, options, **stated)


def test_a_damaged_record_costs_itself(tmp_path: Path) -> None:
    lines = sample(8).decode().splitlines()
    lines[3] = lines[3].replace(",14,", ",1x4,")  # record 2
    lines[5] = lines[5].replace(",28,", ",28.5,")  # record 4: half a tick
    lines[6] = lines[6].replace(",35,", ",,")  # record 5: no ticks, but a distance
    lines[7] = lines[7].rsplit(",", 1)[0] + ",9000"  # record 6: faster than any road vehicle
    path = write(tmp_path / "a.csv", *lines)
    log = read_log("encoder_csv", path, TOTAL, **STATED)
    assert wheel(log, "", "ticks") == [0, 7, 21, None, 49]
    starts = np.cumsum([0, *(len(line) + 1 for line in lines)])
    assert {(r.record, r.offset) for r in log.rejects} == {(k, starts[k + 1]) for k in (2, 4, 6)}
    assert {r.record: r.reason for r in log.rejects}[4] == "ticks are no whole number"
    cut = tmp_path / "cut.csv"
    cut.write_bytes(sample(8)[:-12])  # inside the last line's fields
    log = read_log("encoder_csv", cut, TOTAL, **STATED)
    assert [r.record for r in log.rejects] == [7]
    assert log.table.num_rows == 7


def test_the_worth_of_a_tick_stands_in_the_rig_file() -> None:
    rig = Rig.parse({"sensors": {"wheel": {"kind": "encoder", "metres_per_tick": 0.0021}}})
    assert rig.sensors["wheel"].metres_per_tick == 0.0021
    with pytest.raises(ConfigError, match="metres_per_tick"):
        Rig.parse({"sensors": {"wheel": {"kind": "encoder", "metres_per_tick": 0}}})


def test_the_recorded_drive(recordings: Path, tmp_path: Path) -> None:
    folder = recordings / "odometer"
    stamps = np.load(folder / "CAN_wheel_speed_t.npy")
    speeds = np.load(folder / "CAN_wheel_speed_value.npy")
    poses = np.load(folder / "global_pose_frame_times.npy")
    positions = np.load(folder / "global_pose_frame_positions.npy")
    gps = np.load(folder / "global_pose_frame_gps_times.npy")
    offset_s = float(gps[0, 0] * 604_800 + gps[0, 1] - poses[0])  # the logger's counter against GPS time
    path = tmp_path / "wheels.csv"
    names = ["fl", "fr", "rl", "rr"]
    header = ",".join(["time_s", *(f"speed_{name}_m_per_s" for name in names)])
    np.savetxt(path, np.column_stack([stamps, speeds]), "%.9f", ",", header=header, comments="")
    assert format_of(path).name == "encoder_csv"
    log = read_log("encoder_csv", path, clock=Clock(TimeSystem.FREE, offset_s=offset_s), sensor=ENCODER)
    assert log.rejects == []
    assert log.table.num_rows == 4 * 4_974
    of_wheels = [log.table.filter(np.asarray(log.column("wheel") == name)) for name in names]
    ways = []
    for table in of_wheels:
        seconds = (table["epoch_gps_ns"].to_numpy() - round(offset_s * 1e9)) / 1e9
        speed = table["speed_m_per_s"].to_numpy()
        inside = (seconds >= poses[0]) & (seconds <= poses[-1])
        ways.append(np.trapezoid(speed[inside], seconds[inside]))
    path_m = np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()
    assert path_m == pytest.approx(1_011.8, abs=0.1)
    assert np.mean(ways) == pytest.approx(1_002.8, abs=0.2)
    assert path_m / np.mean(ways) == pytest.approx(1.009, abs=0.002)


@pytest.mark.parametrize(
    ("unit", "whole", "decimals"),
    [
        ("s", 1_400_000_000, [(50, "050.0", 50_000_000_000), (900, "900.5", 900_500_000_000)]),
        ("ms", 1_400_000_000_000, [(50, "050.25", 50_250_000), (900, "900.5", 900_500_000)]),
        ("us", 1_400_000_000_000_000, [(50, "050.0", 50_000), (900, "900.5", 900_500)]),
    ],
)
def test_stamps_may_be_whole_first_and_decimal_later(
    tmp_path: Path, unit: str, whole: int, decimals: list[tuple[int, str, int]]
) -> None:
    step_ns = {"s": 10**9, "ms": 10**6, "us": 10**3}[unit]
    lines = [f"{whole + i},{i}" for i in range(30)]
    lines += [f"{str(whole)[:-3]}{word},{ticks}" for ticks, word, _ in decimals]
    path = write(tmp_path / "a.csv", f"time_{unit},ticks", *lines)
    clock = Clock(TimeSystem.GPS, unit=unit)
    log = read_log("encoder_csv", path, TOTAL, clock=clock, sensor=ENCODER)
    assert log.rejects == []
    expected = [(whole + i) * step_ns for i in range(30)] + [whole * step_ns + after for *_, after in decimals]
    assert log.epochs.tolist() == expected


def test_whole_nanoseconds_stay_exact(tmp_path: Path) -> None:
    stamps = [1_400_000_000_123_456_789 + 1_000_000_001 * i for i in range(5)]  # beyond the digits of a float64
    path = write(tmp_path / "a.csv", "time_ns,ticks", *(f"{stamp},{i}" for i, stamp in enumerate(stamps)))
    log = read_log("encoder_csv", path, TOTAL, clock=Clock(TimeSystem.GPS, unit="ns"), sensor=ENCODER)
    assert log.epochs.tolist() == stamps
