"""E57: hand-made bytes, files of libE57Format, a twin of a LAS file, damage."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from roadscan.core.errors import ConfigError, CrsError, FormatError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.formats.clouds.e57_file import page_checksums, unpacked
from roadscan.ingest.reading.format import format_of
from tests.formats.e57_files import (
    PAGE,
    Column,
    ScanSpec,
    crc32c,
    double,
    e57,
    integer,
    limits,
    physical,
    pose,
    single,
    small_e57,
    start,
)
from tests.formats.readings import read_ellipsoidal as read

pye57 = pytest.importorskip("pye57")

NOON = {"epoch": "2026-05-04T12:00:00Z"}
NOON_GPS_NS = 1_461_931_218_000_000_000
"""2026-05-04 12:00 UTC: 16,920 days and a half after 1980-01-06, 18 leap seconds."""


def xyz_of(log: Any) -> np.ndarray:
    return np.stack([log[f"{a}_m"] for a in "xyz"], axis=-1)


def triple(count: int) -> list[Column]:
    return [double(f"cartesian{a}", [float(10 * k + v) for v in range(count)]) for k, a in enumerate("XYZ")]


def written(folder: Path, data: bytes) -> Path:
    path = folder / "scan.e57"
    path.write_bytes(data)
    return path


# --- known values ------------------------------------------------------------------------------------


def test_hand_made_bytes(tmp_path: Path) -> None:
    path = written(tmp_path, small_e57())
    assert format_of(path).name == "e57"
    log = read("e57", path, crs="EPSG:25832")
    assert [(r.record, r.records, r.reason) for r in log.rejects] == [(7, 1, "the scanner marks the point as invalid")]
    assert len(log) == 639
    k = np.delete(np.arange(400), 7)
    # The pose turns x to y, y to z, z to x (a third of a turn about the diagonal) and moves by 1, 2, 3.
    assert np.allclose(log["x_m"][:399], 2.0 + 1.0)
    assert np.allclose(log["y_m"][:399], 0.5 * k + 2.0)
    assert np.allclose(log["z_m"][:399], (k - 200) * 0.001 + 5.0 + 3.0)
    assert np.array_equal(log.epochs[:399], 1_400_000_000_000_000_000 + k * 15_625_000)
    assert set(log.epochs[399:]) == {1_400_000_060_000_000_000}
    assert np.array_equal(log["intensity"][:399], np.floor(k % 1000 / 999 * 65_535 + 0.5))
    assert np.array_equal(log["point_source_id"], np.repeat([1, 2], [399, 240]))
    assert set(log["classification"]) == {1}
    reds = log.table.column("red")
    assert reds.null_count == 240
    assert np.array_equal(reds[:399].to_numpy(), k % 256 * 257)
    assert [scan["points"] for scan in log.attributes["scans"]] == [400, 240]


def test_spherical_coordinates_and_colour_limits(tmp_path: Path) -> None:
    columns = [
        double("sphericalRange", [2.0, 2.0, 4.0]),
        double("sphericalAzimuth", [0.0, np.pi / 2, 0.0]),
        double("sphericalElevation", [0.0, 0.0, np.pi / 6]),
        *[single(f"color{c}", [0.0, 0.5, 1.0]) for c in ("Red", "Green", "Blue")],
        integer("returnIndex", [0, 0, 1], 0, 1),
        integer("returnCount", [1, 1, 2], 1, 2),
    ]
    names = {f"color{c}": (0.0, 1.0) for c in ("Red", "Green", "Blue")}
    path = written(tmp_path, e57(ScanSpec(columns, limits("colorLimits", **names))))
    log = read("e57", path, NOON, crs="local")
    assert np.allclose(xyz_of(log), [[2, 0, 0], [0, 2, 0], [4 * np.cos(np.pi / 6), 0, 2]])
    assert log["green"].tolist() == [0, 32_768, 65_535]
    assert (log["return_number"].tolist(), log["number_of_returns"].tolist()) == ([1, 1, 2], [1, 1, 2])
    assert set(log.epochs) == {NOON_GPS_NS}


@pytest.mark.parametrize("size", [0, 1, 37, 1020])
def test_checksums(size: int) -> None:
    assert crc32c(bytes(32)) == 0x8A9136AA  # RFC 3720, B.4
    pages = np.random.default_rng(size).integers(0, 256, (3, 2 * size), dtype=np.uint8)
    assert page_checksums(pages).tolist() == [crc32c(page.tobytes()) for page in pages]


@settings(max_examples=60, deadline=None)
@given(bits=st.integers(1, 64), shift=st.integers(0, 7), seed=st.integers(0, 2**32 - 1))
def test_any_width_is_unpacked(bits: int, shift: int, seed: int) -> None:
    values = [int(v) % 2**bits for v in np.random.default_rng(seed).integers(0, 2**63, 23)]
    number = sum(v << (shift + k * bits) for k, v in enumerate(values))
    data = number.to_bytes((shift + 23 * bits + 7) // 8, "little")
    assert unpacked(data, shift, bits, 23).tolist() == values


def test_a_field_of_all_64_bits(tmp_path: Path) -> None:
    values = [-(2**63), -1, 2**63 - 1]
    raw = integer("intensity", values, -(2**63), 2**63 - 1)
    path = written(tmp_path, e57(ScanSpec([*triple(3), raw])))
    log = read("e57", path, NOON | {"intensity_range": [-1.0, 1.0]}, crs="local")
    assert log["intensity"].tolist() == [0, 0, 65_535]


# --- files of libE57Format ---------------------------------------------------------------------------


def test_scans_of_pye57_equal_its_own_reading(tmp_path: Path) -> None:
    draw = np.random.default_rng(3)
    n = 30_000
    path = tmp_path / "two.e57"
    turns = Rotation.random(2, random_state=5).as_quat(scalar_first=True)
    shifts = np.array([[100.0, -20.0, 3.0], [691_000.0, 5_335_000.0, 500.0]])
    file = pye57.E57(str(path), mode="w")
    for turn, shift in zip(turns, shifts, strict=True):
        data = {f"cartesian{a}": draw.normal(0, 30, n) for a in "XYZ"}
        data["intensity"] = draw.integers(0, 2048, n).astype(float)
        data |= {f"color{c}": draw.integers(0, 256, n).astype(np.uint8) for c in ("Red", "Green", "Blue")}
        data |= {"rowIndex": np.arange(n) // 100, "columnIndex": np.arange(n) % 100}
        file.write_scan_raw(data, rotation=turn, translation=shift)
    file.close()
    log = read("e57", path, NOON, crs="EPSG:25832")
    assert log.rejects == []
    for number in range(2):
        own = pye57.E57(str(path)).read_scan(number, intensity=True, colors=True, ignore_missing_fields=True)
        rows = log["point_source_id"] == number + 1
        theirs = np.stack([own[f"cartesian{a}"] for a in "XYZ"], axis=-1)
        assert np.abs(xyz_of(log)[rows] - theirs).max() < 2e-9
        assert np.array_equal(log["blue"][rows], 257 * own["colorBlue"].astype(np.uint16))
        low, high = own["intensity"].min(), own["intensity"].max()
        expected = np.floor((own["intensity"] - low) / (high - low) * 65_535 + 0.5)
        assert np.abs(log["intensity"][rows] - expected).max() <= 1


def write_with_library(path: Path, names: dict[str, Any], data: dict[str, np.ndarray], at: float) -> None:
    """One scan through libE57Format, with the fields `names` (kind and limits) as doubles or scaled integers."""
    lib = pye57.libe57
    file = lib.ImageFile(str(path), "w")
    root, scan, prototype, when = file.root(), *(lib.StructureNode(file) for _ in range(3))
    root.set("formatName", lib.StringNode(file, "ASTM E57 3D Imaging Data File"))
    root.set("guid", lib.StringNode(file, "{0}"))
    root.set("versionMajor", lib.IntegerNode(file, 1))
    root.set("versionMinor", lib.IntegerNode(file, 0))
    scans = lib.VectorNode(file, True)
    root.set("data3D", scans)
    when.set("dateTimeValue", lib.FloatNode(file, at))
    when.set("isAtomicClockReferenced", lib.IntegerNode(file, 1))
    scan.set("acquisitionStart", when)
    for name, scaled in names.items():
        node = lib.FloatNode(file, 0.0) if scaled is None else lib.ScaledIntegerNode(file, *scaled)
        prototype.set(name, node)
    points = lib.CompressedVectorNode(file, prototype, lib.VectorNode(file, True))
    scan.set("points", points)
    scans.append(scan)
    buffers = lib.VectorSourceDestBuffer()
    size = next(iter(data.values())).size
    own = {name: np.ascontiguousarray(values, np.float64) for name, values in data.items()}  # outlive the writer
    for name, values in own.items():
        buffers.append(lib.SourceDestBuffer(file, name, values, size, True, True))
    writer = points.writer(buffers)
    writer.write(size)
    writer.close()
    file.close()


def test_the_twin_of_a_las_file(tmp_path: Path, recordings: Path) -> None:
    las = tmp_path / "strips.las"
    las.write_bytes(gzip.decompress((recordings / "formats" / "strips.las.gz").read_bytes()))
    theirs = read("las", las, clock=Clock(TimeSystem.GPS_ADJUSTED), crs="EPSG:26910")
    xyz, first = xyz_of(theirs), theirs.epochs.min()
    scale_and_offset = np.array(struct.unpack_from("<6d", las.read_bytes(), 131)).reshape(2, 3)
    names: dict[str, Any] = {
        f"cartesian{a}": (0, -(2**31), 2**31 - 1, *scale_and_offset[:, k].tolist()) for k, a in enumerate("XYZ")
    } | {"timeStamp": None, "intensity": (0, 0, 65_535, 1.0, 0.0)}  # fmt: skip
    data = {f"cartesian{a}": xyz[:, k] for k, a in enumerate("XYZ")}
    data |= {"timeStamp": (theirs.epochs - first) / 1e9, "intensity": theirs["intensity"].astype(float)}
    twin = tmp_path / "strips.e57"
    write_with_library(twin, names, data, first / 1e9)
    log = read("e57", twin, crs="EPSG:26910")
    assert (len(log), log.rejects) == (14_408, [])
    assert np.abs(xyz_of(log) - xyz).max() < 1e-9
    assert np.array_equal(log["intensity"], theirs["intensity"])
    assert np.abs(log.epochs - theirs.epochs).max() < 300  # a double holds GPS seconds to 0.24 µs


# --- statements --------------------------------------------------------------------------------------


def test_what_the_survey_file_has_to_say(tmp_path: Path) -> None:
    path = written(tmp_path, e57(ScanSpec([*triple(5), single("intensity", [0.5] * 5)])))
    with pytest.raises(ConfigError, match="CRS of the log's positions is not stated"):
        read("e57", path, NOON)
    with pytest.raises(CrsError, match="not a projected one"):
        read("e57", path, NOON, crs="EPSG:4979")
    with pytest.raises(TimeSystemError, match=r"does not say when it was started.*epoch"):
        read("e57", path, crs="local")
    with pytest.raises(TimeSystemError, match="no time zone"):
        read("e57", path, {"epoch": "2026-05-04T12:00:00"}, crs="local")
    with pytest.raises(ConfigError, match=r"no limits of its intensities.*intensity_range"):
        read("e57", path, NOON, crs="local")
    with pytest.raises(ConfigError, match="lower and a higher limit"):
        read("e57", path, NOON | {"intensity_range": [1.0, 1.0]}, crs="local")
    assert set(read("e57", path, NOON | {"intensity_range": [0.0, 1.0]}, crs="local")["intensity"]) == {32_768}
    assert set(read("e57", path, NOON | {"intensity": False}, crs="local")["intensity"]) == {0}


def test_a_clock_corrects_the_scanners_start(tmp_path: Path) -> None:
    path = written(tmp_path, e57(ScanSpec(triple(3), start(1.4e9))))
    with pytest.raises(TimeSystemError, match="seconds of gps"):
        read("e57", path, crs="local", clock=Clock(TimeSystem.UNIX_UTC))
    log = read("e57", path, crs="local", clock=Clock(TimeSystem.GPS, offset_s=-0.5))
    assert set(log.epochs) == {1_399_999_999_500_000_000}
    assert set(read("e57", path, NOON, crs="local").epochs) == {NOON_GPS_NS}


def test_the_files_own_crs_has_to_agree(tmp_path: Path) -> None:
    import pyproj

    wkt = pyproj.CRS("EPSG:25832").to_wkt("WKT1_GDAL").replace('"', "&quot;")
    root = f'<coordinateMetadata type="String">{wkt}</coordinateMetadata>'
    path = written(tmp_path, e57(ScanSpec(triple(3)), root=root))
    assert len(read("e57", path, NOON, crs="EPSG:25832")) == 3
    with pytest.raises(CrsError, match="the file says ETRS89 / UTM zone 32N"):
        read("e57", path, NOON, crs="EPSG:25833")
    assert len(read("e57", path, NOON | {"ignore_file_crs": True}, crs="EPSG:25833")) == 3


# --- damage ------------------------------------------------------------------------------------------


def test_a_damaged_page_costs_its_points(tmp_path: Path) -> None:
    count = 2000
    scan = ScanSpec([*triple(count), integer("rowIndex", list(range(count)), 0, count)], per_packet=400)
    data = bytearray(e57(scan, ScanSpec(triple(9))))
    # The page in the middle of the third packet, which begins in another page.
    page = (physical(scan.lengths[2]) // PAGE + 4) * PAGE
    data[page + 500] ^= 1
    log = read("e57", written(tmp_path, bytes(data)), NOON, crs="local")
    (reject,) = log.rejects
    assert (reject.reason, reject.offset) == ("the checksum of its page is wrong", page)
    # The page lies within the packet's y values: 1,020 bytes of doubles touch 128 or 129 points of the packet.
    begin = scan.lengths[2] + 6 + 2 * 4 + 8 * 400
    first = 800 + (page // PAGE * 1020 - begin) // 8
    assert (reject.record, reject.records) == (first, 128 + (page // PAGE * 1020 - begin) % 8 // 4)
    kept = np.delete(np.arange(count), np.arange(reject.record, reject.record + reject.records))
    assert np.array_equal(log["x_m"], np.concatenate([kept, np.arange(9)]))
    assert np.array_equal(log["z_m"][: kept.size], kept + 20.0)


def test_a_damaged_packet_head_costs_the_rest_of_its_scan(tmp_path: Path) -> None:
    scan = ScanSpec(triple(2000), per_packet=400)
    data = bytearray(e57(scan, ScanSpec(triple(9))))
    data[physical(scan.lengths[3]) + 4] ^= 1
    log = read("e57", written(tmp_path, bytes(data)), NOON, crs="local")
    lost = [r for r in log.rejects if "packet" in r.reason]
    assert [(r.record, r.records) for r in lost] == [(1200, 800)]
    assert (log["point_source_id"] == 2).sum() == 9


def test_wrong_checksums_can_be_passed_over(tmp_path: Path) -> None:
    data = bytearray(e57(ScanSpec(triple(50))))
    for page in range(0, len(data), PAGE):
        data[page + 1020 : page + 1024] = bytes(4)
    path = written(tmp_path, bytes(data))
    with pytest.raises(FormatError, match=r"wrong checksum.*check_pages"):
        read("e57", path, NOON, crs="local")
    assert len(read("e57", path, NOON | {"check_pages": False}, crs="local")) == 50


def test_claims_are_held_against_the_file(tmp_path: Path) -> None:
    path = written(tmp_path, e57(ScanSpec(triple(50), claimed=2**63)))
    log = read("e57", path, NOON, crs="local")
    assert len(log) == 50
    assert [(r.record, r.reason) for r in log.rejects] == [(50, "the file holds fewer points than its XML claims")]
    nothing = [integer(f"cartesian{a}", [4] * 9, 4, 4) for a in "XYZ"]
    path = written(tmp_path, e57(ScanSpec(nothing, claimed=2**40)))
    assert read("e57", path, NOON, crs="local").reasons == {
        "scan 'scan 1' cannot be read: its points have no coordinates"
    }


def test_a_value_outside_its_fields_limits_is_rejected(tmp_path: Path) -> None:
    wrong = integer("cartesianZ", [3, 7, 5], 3, 5, 'scale="0.1" offset="0"')  # 7 − 3 = 4 fits no 2 bits but 3
    wrong.bits, wrong.values = 2, [3, 6, 5]
    path = written(tmp_path, e57(ScanSpec([*triple(3)[:2], wrong])))
    log = read("e57", path, NOON, crs="local")
    assert [(r.record, r.reason) for r in log.rejects] == [(1, "cartesianZ is outside the limits that the file states")]


def test_cut_off(tmp_path: Path) -> None:
    data = small_e57()
    with pytest.raises(FormatError, match="fetch it again"):
        read("e57", written(tmp_path, data[: len(data) - PAGE]), crs="local")
    with pytest.raises(FormatError, match="not E57"):
        read("e57", written(tmp_path, data[:20]), crs="local")


@pytest.mark.parametrize(
    ("xml", "match"),
    [
        (b"<!DOCTYPE a>", "document type"),
        (b"<a/>", "holds 'a'"),
        (b"<a", "cannot be read"),
    ],
)
def test_foreign_xml(tmp_path: Path, xml: bytes, match: str) -> None:
    from tests.formats.e57_files import paged

    head = struct.pack("<8sIIQQQQ", b"ASTM-E57", 1, 0, PAGE, 48, len(xml), PAGE)
    with pytest.raises(FormatError, match=match):
        read("e57", written(tmp_path, paged(head + xml)), NOON, crs="local")


def test_a_scan_that_cannot_be_understood_costs_itself(tmp_path: Path) -> None:
    path = written(tmp_path, e57(ScanSpec(triple(5), pose(2, 0, 0, 0, 1, 1, 1)), ScanSpec(triple(7))))
    log = read("e57", path, NOON, crs="local")
    assert [(r.records, r.reason) for r in log.rejects] == [
        (5, "scan 'scan 1' cannot be read: its pose is no rotation and translation")
    ]
    assert len(log) == 7


@pytest.mark.parametrize("bits", [3, 13, 20, 33])
def test_numbers_go_on_over_the_packets_of_the_library(tmp_path: Path, bits: int) -> None:
    """Widths that fill no bytes, in files of many packets."""
    count = 120_000
    draw = np.random.default_rng(bits)
    data = {f"cartesian{a}": draw.integers(0, 2**bits, count) * 0.5 for a in "XYZ"}
    names: dict[str, Any] = dict.fromkeys(data, (0, 0, 2**bits - 1, 0.5, 0.0))
    path = tmp_path / "wide.e57"
    write_with_library(path, names, data, 1.4e9)
    log = read("e57", path, crs="local")
    assert log.rejects == []
    assert np.array_equal(xyz_of(log), np.stack(list(data.values()), axis=-1))


@pytest.mark.parametrize(("claimed", "rejected"), [(24, 1), (160, 1), (240, 0), (250, 10)])
def test_points_that_the_xml_does_not_claim_are_told(tmp_path: Path, claimed: int, rejected: int) -> None:
    scan = ScanSpec(triple(240), claimed=claimed)
    log = read("e57", written(tmp_path, e57(scan)), NOON, crs="local")
    assert len(log) == min(claimed, 240)
    assert log.rejected == rejected


def test_a_signalling_nan_costs_its_point(tmp_path: Path) -> None:
    scan = ScanSpec([*triple(8), single("timeStamp", [k / 4 for k in range(8)])], start(1.4e9))
    data = e57(scan)
    good = struct.pack("<f", 1.25)
    at = data.index(struct.pack("<f", 1.0) + good) + 4
    path = written(tmp_path, data[:at] + b"\x01\x00\x80\x7f" + data[at + 4 :])
    log = read("e57", path, {"check_pages": False}, crs="local")
    assert [r.record for r in log.rejects] == [5]
    assert len(log) == 7
