"""SICK LMS 2xx: published telegrams, hand-made bytes, stamps, turns of the mirror, damage."""

from __future__ import annotations

import struct
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from roadscan.core.errors import ConfigError, FormatError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.core.rig import ScanGeometry
from roadscan.formats.scanners.sick_telegrams import Checksums, checksum, find_telegrams, read_pieces
from roadscan.ingest.reading.format import format_named, format_of
from tests.formats.readings import Readings, read
from tests.formats.sick_files import encode_scans, encode_telegram, write_telegrams

GPS = Clock(TimeSystem.GPS)
GPS_NS = Clock(TimeSystem.GPS, unit="ns")
BY_RATE = {"first_stamp_s": 1_400_000_000.25, "scans_per_s": 75.0}
FIRST_NS = 1_400_000_000_250_000_000
TURN_NS = 13_333_333

# A telegram that a scanner sent: 361 values in mm over 180°, as the driver of DTU's robot control software replays it.
RECORDED = bytes.fromhex("""
0280d602b06941cb08cb08c208c208c308ba08b908b0089e0889086208440821081308f807e907e907e207e707e807e507f007e807e807ea07e3
07e307e507d007c207b807c3074407320720071f07170701072b0755075f075707430758071508b808c208ab084408ed07a7075e071c07d40686
068206cb0611091b0924092d09360936093f093f09d5083408f3070708050815081d081a082b081508160815080908fb07d8070208ec07c7077f
079007a11275123710200fe90ea50e650e300efc0dcb0d9b0d720d3e0d110de00cb30c930c670c420c250c3d0c3e0c060cec0bd90bf60bf20b0a
0c170c320c430c5e0c790c6d0c510c3c0c300c310c3f0c750ccc0c0f0d1c0d890dd60d0a0cc60bc90dd30dcf0dbe0da30d930d870d100d6e0d92
0da50dac0dac0da90d730d6c0d600d630d5c0d4d0d450d360d1c0d130dd60cd50c180d1c0d160d1c0df10ce90ce20cdc0ce50cd20ccd0ce60cd2
0cd80cd00cdb0cd70ce10cd50cd70cdc0cdb0cd90ce40ce40ce60ce20ce80ce80cec0cfb0ced0cf10cf60cfd0c030d070d0a0d1d0d1e0d270d36
0d440d3c0d370d410d4a0d540d620d5b0d620d770d760a710a830a820a810a800a810a820a720a920a980db10cbc0c260c890b200b3d0ba80baf
0bb40bc00bc60bd00bda0be20be80bed0bf80b0a0c030c0f0c350c410c390c280cf20bb70b5a0ecf0d920bb90845084308ab08260b4f0b830b30
0c7f0d3711680f700b410b7a22652263225822492243223e2233222c2225221d22152215221822072205220022ff21fd21f821f121e321e021d9
21d221d721cb21d021da21cf21cf21d021cb21ca21c221c221b921b921b421b021af219e2197219821a421a1219c21c221c321bf21bf21c121b4
21b821bf21c321bd21c821ca21c021d021d121c521ca21d121f02132222f222b222f222a222f222f224f225d225e2270228622b522cc221c233c
054805d4212f23fe22c0222b233c053a053305330528051e051b23b122d7221805106447
""")

# Requests and answers whose CRC stands in drivers and in the maker's own listing.
PUBLISHED = [
    "02 00 02 00 20 24 34 08",  # send all values continuously
    "02 00 02 00 20 25 35 08",  # stop that
    "02 00 01 00 31 15 12",  # status
    "02 00 02 00 30 01 31 18",  # one scan
    "02 00 02 00 20 42 52 08",  # 9,600 Bd
    "02 00 02 00 20 48 58 08",  # 500,000 Bd
    "02 00 05 00 3B B4 00 32 00 3B 1F",  # 180°, 0.5°
    "02 00 05 00 3B 64 00 64 00 1D 0F",  # 100°, 1°
    "02 80 03 00 A0 00 10 16 0A",  # accepted
]


def scans(count: int, readings: int = 181, seed: int = 0) -> np.ndarray:
    """(count, readings) millimetres, none of them a code."""
    return np.random.default_rng(seed).integers(1, 8000, (count, readings), dtype=np.uint16)


def log(path: Path, *parts: bytes | np.ndarray) -> Path:
    path.write_bytes(b"".join(p if isinstance(p, bytes) else p.tobytes() for p in parts))
    return path


def ranges(found: Readings) -> np.ndarray:
    size = found.attributes["scan_geometry"]["readings"]
    return found.table.column("range").combine_chunks().flatten().to_numpy().reshape(-1, size)


def intensities(found: Readings) -> np.ndarray:
    size = found.attributes["scan_geometry"]["readings"]
    return found.table.column("intensity").combine_chunks().flatten().to_numpy().reshape(-1, size)


def read_lms(path: Path, options: dict[str, Any] | None = None, clock: Clock = GPS) -> Readings:
    assert format_of(path).name == "sick_lms"
    return read("sick_lms", path, BY_RATE if options is None else options, clock=clock)


# --- bytes that others published --------------------------------------------------------------------


@pytest.mark.parametrize("text", PUBLISHED)
def test_checksums_as_published(text: str) -> None:
    telegram = bytes.fromhex(text)
    assert checksum(telegram[:-2]) == int.from_bytes(telegram[-2:], "little")
    assert encode_telegram(telegram[4:-2], telegram[1]) == telegram


def test_a_telegram_that_a_scanner_sent(tmp_path: Path) -> None:
    """Its values pass from the far wall (0x227A) to 0x021B9 …: 14 bits of range, the 16 m mode."""
    assert len(RECORDED) == 732
    assert checksum(RECORDED[:-2]) == 0x4764
    path = log(tmp_path / "a.log", RECORDED)
    with pytest.raises(ConfigError, match=r"a value is 0x227A: .*options\.range_bits: 13 .* 14 \(16 m\)"):
        read_lms(path)
    found = read_lms(path, BY_RATE | {"range_bits": 14})
    assert found.rejects == []
    geometry = ScanGeometry.parse(found.attributes["scan_geometry"])
    assert (geometry.readings, geometry.range_step_m) == (361, 0.001)
    first, second = ranges(found)
    expected = struct.unpack_from("<361H", RECORDED, 7)
    assert (first[:4:2].tolist(), second[1:4:2].tolist()) == ([0x8CB, 0x8C2], [0x8CB, 0x8C2])
    assert np.array_equal(first + second, expected)
    assert not first[1::2].any()
    assert not second[::2].any()
    # Two turns of the mirror: the second half-degree readings came 13.33 ms later.
    assert (found.epochs - FIRST_NS).tolist() == [0, TURN_NS]
    again = encode_scans(np.array([expected], dtype=np.uint16), "mm", status=0x10)
    assert again.tobytes() == RECORDED


# --- hand-made bytes --------------------------------------------------------------------------------


def test_a_telegram_by_hand(tmp_path: Path) -> None:
    """Five values in cm over a field of 4°; the codes of the listing's page 124 are no ranges."""
    values = [100, 8182, 8183, 8190, 8191]
    path = log(tmp_path / "a.log", encode_telegram(struct.pack("<BH5HB", 0xB0, 5, *values, 0x10)))
    found = read_lms(path, BY_RATE | {"field_deg": 4.0})
    assert ranges(found).tolist() == [[100, 8182, 0, 0, 0]]
    geometry = ScanGeometry.parse(found.attributes["scan_geometry"])
    assert geometry.range_step_m == 0.01
    assert geometry.reading_period_ns == pytest.approx(1e9 / 75 / 360)
    _, directions = geometry.rays()
    # First reading towards y, middle reading along z.
    assert directions[0] == pytest.approx([0, np.sin(np.radians(2)), np.cos(np.radians(2))])
    assert directions[2] == pytest.approx([0, 0, 1])
    assert found.epochs.tolist() == [FIRST_NS]


@pytest.mark.parametrize(("bits", "mask", "codes"), [(13, 0x1FFF, 8183), (14, 0x3FFF, 16375), (15, 0x7FFF, 32759),
                                                      (16, 0xFFFF, 65527)])  # fmt: skip
def test_flag_bits_and_codes_by_measuring_mode(tmp_path: Path, bits: int, mask: int, codes: int) -> None:
    values = np.array([[0x0123, 0xE123, 0x4567, codes - 1, codes, mask, 1]], dtype=np.uint16)
    path = log(tmp_path / "a.log", encode_scans(values, "mm"))
    found = read_lms(path, BY_RATE | {"range_bits": bits, "field_deg": 6.0})
    kept = values & mask
    assert ranges(found).tolist() == np.where(kept >= codes, 0, kept).tolist()


def test_remission_becomes_intensity(tmp_path: Path) -> None:
    values, bright = scans(3), np.random.default_rng(1).integers(0, 256, (3, 181), dtype=np.uint8)
    values[0, 7] = 8191
    found = read_lms(log(tmp_path / "a.log", encode_scans(values, "cm", remission=bright)))
    assert np.array_equal(ranges(found), np.where(values == 8191, 0, values))
    assert np.array_equal(intensities(found), np.where(values == 8191, 0, bright))


def test_remission_of_a_part_of_the_scan(tmp_path: Path) -> None:
    values = scans(1)[0].tolist()
    payload = struct.pack("<BH181HHHH", 0xC4, 181, *values, 3, 11, 13) + bytes([7, 8, 9, 0x10])
    found = read_lms(log(tmp_path / "a.log", encode_telegram(payload)))
    assert ranges(found).tolist() == [values]
    assert intensities(found)[0, 9:14].tolist() == [0, 7, 8, 9, 0]


def test_a_part_of_the_values(tmp_path: Path) -> None:
    """0xB7: values 91 to 93, counted from 1; the field has to be stated."""
    path = log(tmp_path / "a.log", encode_telegram(struct.pack("<BHHH3HB", 0xB7, 91, 93, 3, 5, 6, 7, 0x10)))
    with pytest.raises(ConfigError, match=r"3 readings of telegrams 0xB7.*options\.field_deg"):
        read_lms(path)
    found = read_lms(path, BY_RATE | {"field_deg": 180.0, "resolution_deg": 1.0})
    assert ranges(found)[0, 89:94].tolist() == [0, 5, 6, 7, 0]
    from_one = log(tmp_path / "b.log", encode_telegram(struct.pack("<BHHH3HB", 0xB7, 1, 3, 3, 5, 6, 7, 0x10)))
    found = read_lms(from_one, BY_RATE | {"field_deg": 180.0, "resolution_deg": 1.0})
    assert ranges(found)[0, :4].tolist() == [5, 6, 7, 0]


def test_a_scan_counter_before_the_status(tmp_path: Path) -> None:
    values = scans(1)[0].tolist()
    path = log(tmp_path / "a.log", encode_telegram(struct.pack("<BH181HBB", 0xB0, 181, *values, 77, 0x10)))
    assert ranges(read_lms(path)).tolist() == [values]


# --- turns of the mirror ----------------------------------------------------------------------------


@pytest.mark.parametrize(("readings", "turns", "field"), [(181, 1, 180), (361, 2, 180), (101, 1, 100), (201, 2, 100),
                                                           (401, 4, 100), (721, 4, 180)])  # fmt: skip
def test_each_turn_is_a_row(tmp_path: Path, readings: int, turns: int, field: int) -> None:
    values = scans(5, readings)
    path = log(tmp_path / "a.log", encode_scans(values, "mm"))
    found = read_lms(path, {"first_stamp_s": 1_400_000_000.25, "scans_per_s": 75.0 / turns})
    rows = ranges(found).reshape(5, turns, readings)
    for turn in range(turns):
        assert np.array_equal(rows[:, turn, turn::turns], values[:, turn::turns])
        assert (np.delete(rows[:, turn], np.s_[turn::turns], axis=1) == 0).all()
    assert np.abs(found.epochs - FIRST_NS - np.arange(5 * turns) * (1e9 / 75)).max() <= turns
    geometry = ScanGeometry.parse(found.attributes["scan_geometry"])
    assert np.degrees(geometry.first) == pytest.approx(field / 2)
    assert np.degrees(geometry.step) == pytest.approx(-field / (readings - 1))
    # Half a turn of the mirror for 180°.
    assert geometry.reading_period_ns * (readings - 1) == pytest.approx(1e9 / 75 * field / 360)


def test_a_variant_that_measures_half_degrees_in_one_turn(tmp_path: Path) -> None:
    values = scans(2)
    path = log(tmp_path / "a.log", encode_scans(values, "mm"))
    found = read_lms(path, BY_RATE | {"field_deg": 90.0, "turns": 1})
    assert np.array_equal(ranges(found), values)
    assert np.degrees(found.attributes["scan_geometry"]["first"]) == pytest.approx(45)
    assert np.degrees(found.attributes["scan_geometry"]["step"]) == pytest.approx(-0.5)


def test_partial_scans_lie_where_their_angle_says(tmp_path: Path) -> None:
    """Turns of a scan at 0.5°, each in a telegram of its own, told by bits 11 to 13 of the count word."""
    whole, half = scans(1, 181), scans(1, 180, seed=1)
    path = log(tmp_path / "a.log", *[t for _ in range(3) for t in (encode_scans(whole, "mm", quarter=0),
                                                                     encode_scans(half, "mm", quarter=2))])  # fmt: skip
    assert path.read_bytes()[5:7] == (181 | 1 << 14 | 1 << 13).to_bytes(2, "little")
    found = read_lms(path)
    assert found.rejects == []
    rows = ranges(found)[np.argsort(found.epochs)]
    assert rows.shape == (6, 361)
    assert np.array_equal(rows[::2, ::2], np.repeat(whole, 3, axis=0))
    assert np.array_equal(rows[1::2, 1::2], np.repeat(half, 3, axis=0))
    assert not rows[::2, 1::2].any()
    assert np.abs(np.diff(np.sort(found.epochs)) - TURN_NS).max() <= 1


# --- stamps -----------------------------------------------------------------------------------------


def test_stamped_telegrams_round_trip(tmp_path: Path) -> None:
    values = scans(2000)
    stamps = 1_400_000_000_000_000_000 + np.arange(2000) * 13_333_333 + np.arange(2000) % 7
    path = tmp_path / "a.log"
    write_telegrams(path, encode_scans(values, "mm"), stamps)
    found = read_lms(path, {"stamped": True}, GPS_NS)
    assert found.rejects == []
    assert np.array_equal(ranges(found), values)
    assert np.array_equal(found.epochs, stamps)
    with pytest.raises(ConfigError, match=r"8 bytes stand before each telegram.*options\.stamped = true"):
        read_lms(path, BY_RATE)
    bare = log(tmp_path / "b.log", encode_scans(values, "mm"))
    with pytest.raises(ConfigError, match=r"without a byte between.*options\.first_stamp_s"):
        read_lms(bare, {"stamped": True}, GPS_NS)


def test_stamps_beside_the_log(tmp_path: Path) -> None:
    values = scans(4)
    path = log(tmp_path / "a.log", encode_scans(values, "mm"))
    (tmp_path / "a.csv").write_text("n, stamp\n0,1400000000.25\n1,1400000000.50\n2,1400000001\n3,1400000002.125\n")
    found = read_lms(path, {"stamps": "a.csv"})
    assert (found.epochs - FIRST_NS).tolist() == [0, 250_000_000, 750_000_000, 1_875_000_000]
    options = format_named("sick_lms").options.parse({"stamps": "a.csv"})
    assert format_named("sick_lms").companions(path, options) == [tmp_path / "a.csv"]
    with pytest.raises(ConfigError, match="no column 'stmp' \\(did you mean 'stamp'"):
        read_lms(path, {"stamps": "a.csv", "stamp_column": "stmp"})
    (tmp_path / "a.csv").write_text("stamp\n1400000000.25\n1400000000.50\n1400000001\n")
    with pytest.raises(FormatError, match=r"3 stamps for 4 scans.*options\.offset_column"):
        read_lms(path, {"stamps": "a.csv"})
    (tmp_path / "a.csv").write_text("stamp\n1400000000.25\nfive\n")
    with pytest.raises(FormatError, match=r"record 1: 'five' holds no stamp"):
        read_lms(path, {"stamps": "a.csv"})


def test_stamps_by_offset_cannot_slip(tmp_path: Path) -> None:
    telegrams = encode_scans(scans(6), "mm")
    size = telegrams.shape[1]
    path = log(tmp_path / "a.log", telegrams[:2], telegrams[3:])  # the third scan never was written
    lines = [f"{size * k},{1_400_000_000 + k}" for k in (4, 3, 1, 0)]
    (tmp_path / "a.csv").write_text("\n".join(["at,stamp", *lines]))
    found = read_lms(path, {"stamps": "a.csv", "offset_column": "at"})
    assert np.array_equal(found.epochs // 10**9 - 1_400_000_000, [0, 1, 3, 4])
    assert [(r.record, r.offset, r.records, r.reason) for r in found.rejects] == [
        (2, 2 * size, 1, "the telegram has no stamp")
    ]


def test_time_has_to_be_stated(tmp_path: Path) -> None:
    path = log(tmp_path / "a.log", encode_scans(scans(2), "mm"))
    with pytest.raises(ConfigError, match=r"hold no time.*options\.stamps.*options\.first_stamp_s.*options\.stamped"):
        read_lms(path, {})
    with pytest.raises(ConfigError, match=r"state no source of it; expected one of"):
        read_lms(path, {})
    with pytest.raises(ConfigError, match=r"state two sources of it \(stamped, first_stamp_s, scans_per_s\)"):
        read_lms(path, BY_RATE | {"stamped": True})
    with pytest.raises(ConfigError, match=r"two sources of it \(stamps, stamped\)"):
        read_lms(path, {"stamps": "a.csv", "stamped": True})
    with pytest.raises(ConfigError, match=r"three sources of it \(stamps, stamped, first_stamp_s, scans_per_s\)"):
        read_lms(path, BY_RATE | {"stamps": "a.csv", "stamped": True})
    with pytest.raises(ConfigError, match="belong together"):
        read_lms(path, {"first_stamp_s": 0.0})
    with pytest.raises(TimeSystemError, match="time system is not stated"):
        read("sick_lms", path, BY_RATE)
    with pytest.raises(TimeSystemError, match="1980"):
        read_lms(path, BY_RATE, Clock(TimeSystem.UNIX_UTC, offset_s=-2e9))
    with pytest.raises(ConfigError, match=r"a field of 180° at 0\.5°, and scans of 181 readings; expected 361"):
        read_lms(path, BY_RATE | {"field_deg": 180.0, "resolution_deg": 0.5})


def test_a_file_without_telegrams_is_given_up_early(tmp_path: Path) -> None:
    path = tmp_path / "a.log"
    telegrams = encode_scans(scans(2), "mm").tobytes()
    path.write_bytes(bytes(15 << 20) + telegrams)
    assert len(read("sick_lms", path, BY_RATE, clock=GPS)) == 2
    with path.open("wb") as stream:
        stream.truncate(20 << 20)
        stream.seek(0, 2)
        stream.write(telegrams)
    with pytest.raises(FormatError, match="first 16 MB hold no telegram with measured values"):
        read("sick_lms", path, BY_RATE, clock=GPS)


# --- damage -----------------------------------------------------------------------------------------


def test_a_damaged_telegram_costs_itself(tmp_path: Path) -> None:
    values = scans(50)
    telegrams = encode_scans(values, "mm")
    size = telegrams.shape[1]
    damaged = bytearray(telegrams.tobytes())
    damaged[10 * size + 100] ^= 0x40
    found = read_lms(log(tmp_path / "a.log", bytes(damaged)))
    assert np.array_equal(ranges(found), np.delete(values, 10, axis=0))
    (reject,) = found.rejects
    assert (reject.record, reject.offset, reject.records) == (10, 10 * size, 1)
    assert reject.reason == f"{size} bytes are no telegram with a valid CRC"
    # The scans behind it keep their time.
    assert np.abs(found.epochs - FIRST_NS - np.delete(np.arange(50), 10) * (1e9 / 75)).max() <= 1


def test_lost_and_added_bytes(tmp_path: Path) -> None:
    telegrams = encode_scans(scans(30), "mm")
    size, data = telegrams.shape[1], telegrams.tobytes()
    cut = data[5 : 10 * size + 7] + data[10 * size + 9 : 20 * size] + b"noise" * 3 + data[20 * size : 29 * size + 50]
    found = read_lms(log(tmp_path / "a.log", cut))
    where = [(r.record, r.offset, r.records) for r in found.rejects]
    assert where == [
        (0, 0, 1),  # begins in the middle of a telegram
        (10, 10 * size - 5, 1),  # two bytes lost
        (20, 20 * size - 7, 1),  # 15 bytes too many
        (30, 29 * size + 8, 1),  # breaks off
    ]
    assert len(found) == 27
    assert np.array_equal(ranges(found)[0], telegrams[1, 7:-3].view("<u2"))


@pytest.mark.parametrize("stamped", [False, True])
def test_a_stretch_over_several_pieces_is_one(tmp_path: Path, stamped: bool) -> None:
    telegrams = encode_scans(scans(10), "mm")
    stamps = FIRST_NS + np.arange(10) * TURN_NS
    heads = stamps.astype("<i8")[:, None].view(np.uint8) if stamped else np.zeros((10, 0), np.uint8)
    rows = np.concatenate([heads, telegrams], axis=1)
    noise = np.random.default_rng(5).integers(0, 256, 5 << 19, dtype=np.uint8).tobytes()
    path = log(tmp_path / "a.log", rows[:4], noise, rows[4:])
    found = read_lms(path, {"stamped": True} if stamped else BY_RATE, GPS_NS if stamped else GPS)
    assert len(found) == 10
    (reject,) = found.rejects
    assert (reject.offset, reject.records) == (4 * rows.shape[1], round(len(noise) / telegrams.shape[1]))
    if stamped:
        assert np.array_equal(found.epochs, stamps)


def test_what_is_no_scan_is_listed_and_what_a_host_says_is_not(tmp_path: Path) -> None:
    telegrams = encode_scans(scans(4), "mm")
    host, answer = bytes.fromhex(PUBLISHED[0]), bytes.fromhex(PUBLISHED[-1])
    mean = encode_telegram(struct.pack("<BBH181HB", 0xB6, 5, 181, *range(181), 0x10))
    subrange_mean = encode_telegram(struct.pack("<BBHHH3HB", 0xBF, 5, 1, 3, 3, 1, 2, 3, 0x10))
    wrong_unit = encode_scans(scans(1), "cm")
    other_count = encode_scans(scans(1, 101), "mm")
    bad = bytearray(telegrams[0, 4:-2].tobytes())
    bad[1] ^= 1
    short = encode_telegram(bytes(bad))
    doubtful = [encode_scans(scans(1), "mm", status=s) for s in (0x13, 0x50)]
    path = log(tmp_path / "a.log", host, b"\x06", answer, telegrams[:2], b"\x15", mean, subrange_mean, wrong_unit,
               other_count, short, *doubtful, b"\x06", telegrams[2:])  # fmt: skip
    found = read_lms(path)
    assert len(found) == 4
    assert [(r.record, r.reason) for r in sorted(found.rejects, key=lambda r: r.record)] == [
        (1, "telegram 0xA0: no measured values"),
        (4, "telegram 0xB6: means over several scans"),
        (5, "telegram 0xBF: means over several scans"),
        (6, "the values are not in mm, as the log's first are"),
        (7, "101 values do not fit the field of the log's first scans"),
        (8, "the telegram's counts do not agree with its length"),
        (9, "the scanner reports an error"),
        (10, "the scanner calls the values implausible"),
    ]
    # Scans that are lost count for the rate, answers do not.
    assert np.rint((found.epochs - FIRST_NS) * 75e-9).tolist() == [0, 1, 9, 10]


def test_a_stamp_that_is_damaged_costs_its_telegram(tmp_path: Path) -> None:
    stamps = FIRST_NS + np.arange(20) * TURN_NS
    stamps[7] ^= 1 << 50
    path = tmp_path / "a.log"
    write_telegrams(path, encode_scans(scans(20), "mm"), stamps)
    found = read_lms(path, {"stamped": True}, GPS_NS)
    assert len(found) == 19
    assert [r.record for r in found.rejects] == [7]
    assert "leaps" in found.rejects[0].reason


def test_no_scan_is_no_log(tmp_path: Path) -> None:
    for data in (b"", b"\x02\x80", RECORDED[:-1], bytes.fromhex(PUBLISHED[0]), b"\x02" * 5000):
        path = log(tmp_path / "a.log", data)
        assert not format_named("sick_lms").sniff(path)
        with pytest.raises(FormatError, match="no telegram with measured values"):
            read("sick_lms", path, BY_RATE, clock=GPS)
    assert not format_named("sick_lms").sniff(tmp_path)
    with pytest.raises(FormatError, match="1024 readings"):
        encode_scans(np.zeros((1, 1024), np.uint16), "mm")


# --- the search itself ------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [30, 5_000, 1 << 20])
def test_checksums_of_all_pieces(size: int) -> None:
    draw = np.random.default_rng(3)
    data = draw.integers(0, 256, size, dtype=np.uint8)
    starts = draw.integers(0, size - 10, 200)
    starts[0] = 0
    ends = np.minimum(starts + draw.integers(1, 1500, 200), data.size)
    found = Checksums(data).of(starts, ends)
    assert found.tolist() == [checksum(data[a:b].tobytes()) for a, b in zip(starts, ends, strict=True)]


def test_pieces_find_what_one_look_finds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    draw = np.random.default_rng(4)
    parts = []
    for k in range(60):
        parts += [encode_scans(scans(1, int(draw.integers(1, 200)), seed=k), "mm").tobytes(),
                  draw.integers(0, 4, int(draw.integers(0, 40)), dtype=np.uint8).tobytes()]  # fmt: skip
    path = log(tmp_path / "a.log", *parts)
    starts, ends, _ = find_telegrams(np.fromfile(path, dtype=np.uint8), is_end=True)
    assert starts.size >= 60
    for size in (7, 100, 1000):
        monkeypatch.setattr("roadscan.formats.scanners.sick_telegrams._PIECE_BYTES", size)
        pieces = list(read_pieces(path))
        assert np.array_equal(np.concatenate([p.offset + p.starts for p in pieces]), starts)
        assert np.array_equal(np.concatenate([p.offset + p.ends for p in pieces]), ends)


@pytest.mark.parametrize("unit", [bytes([2, 0x80, 0xDC, 5]), b"\x02\x80", encode_telegram(b"\xb0"), b"\x02" * 7])
def test_hostile_bytes_take_linear_time(tmp_path: Path, unit: bytes) -> None:
    """Headers that claim 1,500 bytes every four bytes: as fast as sound ones (about 0.05 s for 1 MB)."""
    path = log(tmp_path / "a.log", encode_scans(scans(1), "mm"), unit * ((2 << 20) // len(unit)))
    begin = time.monotonic()
    found = read_lms(path)
    assert time.monotonic() - begin < 5
    assert len(found) == 1
    assert found.rejects


def sample(path: Path, *, stamped: bool = False) -> Path:
    """A small sound log."""
    write_telegrams(path, encode_scans(scans(6), "mm"), FIRST_NS + np.arange(6) * TURN_NS if stamped else None)
    return path
