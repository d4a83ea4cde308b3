"""LAS and LAZ: real strips decoded apart from the reader, times that disagree, CRS and units, damage."""

from __future__ import annotations

import datetime as dt
import gzip
import struct
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyproj
import pytest
from laspy.vlrs.known import WktCoordinateSystemVlr

from roadscan.core.crs import Geoid
from roadscan.core.errors import ConfigError, CrsError, FormatError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.ingest.reading.format import SourceDefaults, format_named, format_of
from tests.formats.readings import read_ellipsoidal as read

ADJUSTED = Clock(TimeSystem.GPS_ADJUSTED)
UTM = "EPSG:25832"
N = 3000
START = 3.0e8
"""Adjusted seconds of the first hand-made point."""

FORMAT_3 = np.dtype(
    [
        ("xyz", "<i4", 3), ("intensity", "<u2"), ("returns", "u1"), ("class", "u1"), ("angle", "i1"),
        ("user", "u1"), ("source", "<u2"), ("time", "<f8"), ("rgb", "<u2", 3),
    ]
)  # fmt: skip
"""Point data record format 3 (ASPRS LAS 1.4 R15, table 10)."""


def cloud(
    path: Path,
    *,
    version: str = "1.4",
    point_format: int = 7,
    crs: str | None = UTM,
    adjusted: bool = True,
    times: np.ndarray | None = None,
    n: int = N,
    **fields: Any,
) -> Path:
    """A cloud as a vendor writes it; LAZ by the name's ending."""
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales, header.offsets = np.array([0.001, 0.002, 0.0005]), np.array([500_000.0, 5_000_000.0, 100.0])
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType(int(adjusted))
    if crs is not None:
        header.add_crs(pyproj.CRS(crs))
    draw = np.random.default_rng(5)
    data = laspy.LasData(header)
    data.points = laspy.ScaleAwarePointRecord.zeros(n, header=header)
    data.X, data.Y, data.Z = (draw.integers(-(2**30), 2**30, n) for _ in range(3))
    if "gps_time" in header.point_format.dimension_names:
        data.gps_time = START + 0.001 * np.arange(n) if times is None else times
    for name, values in fields.items():
        setattr(data, name, values)
    data.write(str(path))
    return path


@pytest.fixture
def strips(recordings: Path, tmp_path: Path) -> Path:
    path = tmp_path / "strips.las"
    path.write_bytes(gzip.decompress((recordings / "formats" / "strips.las.gz").read_bytes()))
    return path


# --- nothing lost -----------------------------------------------------------------------------------


def test_real_strips_come_back_to_the_bit(strips: Path) -> None:
    assert format_of(strips).name == "las"
    log = read("las", strips, clock=ADJUSTED, crs="EPSG:26910")
    raw = strips.read_bytes()
    offset, count = struct.unpack_from("<I", raw, 96)[0], struct.unpack_from("<I", raw, 107)[0]
    scale, shift = np.array(struct.unpack_from("<3d", raw, 131)), np.array(struct.unpack_from("<3d", raw, 155))
    points = np.frombuffer(raw, FORMAT_3, count, offset)
    assert (len(log), log.rejects, count) == (14_408, [], 14_408)
    for k, axis in enumerate("xyz"):
        assert np.array_equal(log[f"{axis}_m"], points["xyz"][:, k] * scale[k] + shift[k])
    assert np.array_equal(log["intensity"], points["intensity"])
    assert np.array_equal(log["return_number"], points["returns"] & 7)
    assert np.array_equal(log["number_of_returns"], points["returns"] >> 3 & 7)
    assert np.array_equal(log["flags"], (points["returns"] >> 6) | (points["class"] >> 5) << 2)
    assert np.array_equal(log["classification"], points["class"] & 31)
    assert np.array_equal(log["scan_angle_deg"], points["angle"])
    assert np.array_equal(log["user_data"], points["user"])
    assert np.array_equal(log["point_source_id"], points["source"])
    assert np.array_equal(log["red"], points["rgb"][:, 0])
    assert np.array_equal(log["blue"], points["rgb"][:, 2])
    # Adjusted standard GPS time is GPS seconds minus 1e9; a double holds it to 30 ns.
    assert np.abs(log.epochs - (points["time"] * 1e9).astype(np.int64) - 10**18).max() < 40
    assert set(log["point_source_id"].tolist()) == {54, 55, 56, 58}


def test_real_strips_equal_laspys_own_reading(strips: Path) -> None:
    log = read("las", strips, clock=ADJUSTED, crs="local")
    own = laspy.read(strips)
    for axis in "xyz":
        assert np.array_equal(log[f"{axis}_m"], np.array(own[axis]))


@pytest.mark.parametrize("ending", ["las", "laz"])
@pytest.mark.parametrize(("version", "point_format"), [("1.2", 1), ("1.2", 3), ("1.4", 6), ("1.4", 7), ("1.4", 8)])
def test_all_columns_of_both_generations(tmp_path: Path, ending: str, version: str, point_format: int) -> None:
    new = point_format >= 6
    k = np.arange(N)
    fields: dict[str, Any] = {
        "intensity": k,
        "classification": k % (256 if new else 32),
        "return_number": k % (16 if new else 8),
        "number_of_returns": (k + 1) % (16 if new else 8),
        "user_data": k % 256,
        "point_source_id": k,
        "scan_direction_flag": k % 2,
        "edge_of_flight_line": k // 2 % 2,
        "synthetic": k // 4 % 2,
        "key_point": k // 8 % 2,
        "withheld": k // 16 % 2,
    }
    fields |= {"scan_angle": k * 10 - 15_000, "overlap": k // 32 % 2} if new else {"scan_angle_rank": k % 181 - 90}
    colours = {"red": k, "green": k + 1, "blue": k + 2} if point_format in {3, 7, 8} else {}
    path = cloud(
        tmp_path / f"a.{ending}",
        version=version,
        point_format=point_format,
        crs=None if not new else UTM,
        **fields,
        **colours,
    )
    log = read("las", path, {"keep_marked": True}, crs=UTM)
    assert log.rejects == []
    assert np.array_equal(log["flags"], k % (64 if new else 32))
    angle = (k * 10 - 15_000) * 0.006 if new else k % 181 - 90
    assert np.abs(log["scan_angle_deg"] - angle).max() < 1e-4
    for name in ("intensity", "classification", "return_number", "number_of_returns", "user_data", "point_source_id"):
        assert np.array_equal(log[name], fields[name])
    for name, values in colours.items():
        assert np.array_equal(log[name], values)
    if not colours:
        assert log.table.column("red").null_count == N
    assert log.attributes["left_out"] == (["scanner_channel"] if new else []) or point_format == 8
    assert ("nir" in log.attributes["left_out"]) == (point_format == 8)
    first = log.rows[0]
    assert (first.first_offset >= 0) == (ending == "las")


# --- time -------------------------------------------------------------------------------------------


def test_bit_and_stamps_that_disagree_are_refused_with_a_proposal(strips: Path) -> None:
    """Bit 0 says seconds of the week, the stamps are 159,214,261 s: adjusted time of 2016-09-29."""
    with pytest.raises(TimeSystemError, match=r'week, and stamps.*2016-09-29.*clock = \{ system = "gps_adjusted" \}'):
        read("las", strips, crs=UTM)
    with pytest.raises(TimeSystemError, match="'gps_week_seconds', and stamps"):
        read("las", strips, crs=UTM, clock=Clock(TimeSystem.GPS_WEEK, week=1916))


def test_week_seconds_under_the_adjusted_bit_are_refused(tmp_path: Path) -> None:
    path = cloud(tmp_path / "a.las", times=np.linspace(100_000.0, 100_100.0, N))
    with pytest.raises(TimeSystemError, match="like seconds of a week"):
        read("las", path)
    log = read("las", path, clock=Clock(TimeSystem.GPS_WEEK, week=2400))
    assert log.epochs[0] == (2400 * 604_800 + 100_000) * 10**9


def test_the_week_of_all_logs_completes_seconds_of_the_week_alone(tmp_path: Path) -> None:
    week = Clock(TimeSystem.GPS_WEEK, week=2400)
    defaults = SourceDefaults(clock=Clock(TimeSystem.GPS), week=week)
    weekly = cloud(tmp_path / "a.las", adjusted=False, times=np.linspace(100_000.0, 100_100.0, N))
    assert read("las", weekly, defaults=defaults).epochs[0] == (2400 * 604_800 + 100_000) * 10**9
    adjusted = cloud(tmp_path / "b.las")
    assert np.array_equal(read("las", adjusted, defaults=defaults).epochs, read("las", adjusted).epochs)


def test_week_seconds_need_the_week(tmp_path: Path) -> None:
    path = cloud(tmp_path / "a.las", adjusted=False, times=np.linspace(100_000.0, 100_100.0, N))
    with pytest.raises(TimeSystemError, match=r"week is not known.*gps_week_seconds"):
        read("las", path)
    with pytest.raises(TimeSystemError, match="week is not known"):
        read("las", path, clock=Clock(TimeSystem.GPS_WEEK))
    log = read("las", path, clock=Clock(TimeSystem.GPS_WEEK, date=dt.date(2026, 1, 5)))
    # 2026-01-04 is a Sunday, 2,400 weeks after 1980-01-06.
    assert log.epochs[0] == (2400 * 604_800 + 100_000) * 10**9


def test_points_over_a_weeks_end_need_no_order(tmp_path: Path) -> None:
    times = np.where(np.arange(N) % 2, 604_790.0, 5.0) + 0.001 * np.arange(N)
    times[0] = 604_700.0
    path = cloud(tmp_path / "a.las", adjusted=False, times=times)
    log = read("las", path, clock=Clock(TimeSystem.GPS_WEEK, week=2400))
    seconds = log.epochs / 1e9 - 2400 * 604_800
    assert np.abs(seconds - np.where(times < 300_000, times + 604_800, times)).max() < 1e-6


def test_clouds_without_times_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TimeSystemError, match="0 throughout"):
        read("las", cloud(tmp_path / "a.las", times=np.zeros(N), adjusted=False))
    with pytest.raises(FormatError, match="point format 2 has no gps_time"):
        read("las", cloud(tmp_path / "b.las", version="1.2", point_format=2, crs=None), crs=UTM)


def test_points_are_held_against_the_trajectory(tmp_path: Path) -> None:
    path = cloud(tmp_path / "a.laz")
    begin = round((START + 1e9) * 1e9)
    log = read("las", path, trajectory_span_gps_ns=(begin + 2_000_000_000, begin + 10**10))
    # 3 s of points, a second of tolerance before the span's begin.
    assert len(log) == 2000
    assert [(r.record, r.records) for r in log.rejects] == [(0, 1000)]
    with pytest.raises(TimeSystemError, match=r"all 3,000 points.*outside the run's trajectory: 2021-03-17T07:06:22Z"):
        read("las", path, trajectory_span_gps_ns=(begin - 10**12, begin - 10**11))


def test_scattered_points_outside_are_one_reject(tmp_path: Path) -> None:
    times = START + np.where(np.arange(N) % 3, 0.0, 5000.0)
    path = cloud(tmp_path / "a.las", times=times)
    begin = round((START + 1e9) * 1e9)
    log = read("las", path, trajectory_span_gps_ns=(begin, begin + 10**9))
    assert (len(log), log.rejected, len(log.rejects)) == (2000, 1000, 1)


def test_an_impossible_time_costs_its_point(tmp_path: Path) -> None:
    times = START + 0.001 * np.arange(N)
    times[[5, 6, 9]] = np.nan, 1e18, -9e9
    log = read("las", cloud(tmp_path / "a.las", times=times))
    assert {(r.record, r.records) for r in log.rejects} == {(5, 2), (9, 1)}
    assert len(log) == N - 3


# --- CRS and units ----------------------------------------------------------------------------------


def test_the_files_own_crs(tmp_path: Path) -> None:
    assert read("las", cloud(tmp_path / "wkt.las")).attributes["crs"] == UTM
    geotiff = cloud(tmp_path / "keys.las", version="1.2", point_format=1)
    assert read("las", geotiff).attributes["crs"] == UTM
    stated = read("las", geotiff, crs=UTM, height="orthometric", geoid=Geoid.found("g.tif"))
    assert stated.attributes["geoid"] == "g.tif"


def test_a_missing_crs_is_asked_for(tmp_path: Path) -> None:
    path = cloud(tmp_path / "a.las", crs=None)
    with pytest.raises(CrsError, match=r'crs = "EPSG:…"'):
        read("las", path)
    assert read("las", path, crs="local").attributes["crs"] == "local"


def test_two_crs_are_refused(tmp_path: Path) -> None:
    path = cloud(tmp_path / "a.las")
    for other in ("EPSG:25833", "local"):
        with pytest.raises(CrsError, match=f"points are in {other}, the file says EPSG:25832"):
            read("las", path, crs=other)
    log = read("las", path, {"ignore_file_crs": True}, crs="EPSG:25833")
    assert log.attributes["crs"] == "EPSG:25833"
    assert read("las", path, crs="EPSG:25832").attributes["crs"] == UTM


def test_wkt_and_keys_of_two_places_are_refused(tmp_path: Path) -> None:
    """A stale WKT beside the keys of the zone next to it: 447 km at 52° north."""
    path = cloud(tmp_path / "keys.las", version="1.2", point_format=1)
    own = laspy.read(path)
    own.header.vlrs.append(WktCoordinateSystemVlr(pyproj.CRS("EPSG:25831").to_wkt("WKT1_GDAL")))
    own.write(tmp_path / "both.las")
    with pytest.raises(CrsError, match=r"two CRS: its WKT says .*31N.*keys .*32N.*km apart"):
        read("las", tmp_path / "both.las")


def test_depths_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CrsError, match="counts depths, downward"):
        read("las", cloud(tmp_path / "a.las", crs="EPSG:25832+5715"))  # MSL depth


def test_feet_become_metres(tmp_path: Path) -> None:
    path = cloud(tmp_path / "a.las", crs="EPSG:2263")  # New York Long Island, US survey feet
    with pytest.raises(CrsError, match=r"options\.vertical_unit"):
        read("las", path)
    log = read("las", path, {"vertical_unit": "foot"})
    own = laspy.read(path)
    assert np.allclose(log["x_m"], np.array(own.x) * (1200 / 3937), rtol=1e-14, atol=0)
    assert np.array_equal(log["z_m"], np.array(own.z) * 0.3048)


def test_heights_by_the_files_vertical_crs(tmp_path: Path) -> None:
    path = cloud(tmp_path / "a.las", crs="EPSG:2263+6360")  # NAVD88 height, US survey feet
    with pytest.raises(CrsError, match=r'heights are orthometric.*height = "orthometric"'):
        read("las", path)
    log = read("las", path, height=None)
    assert log.attributes["height"] == "orthometric"
    log = read("las", path, height="orthometric")
    assert log.attributes["vertical_unit_m"] == pytest.approx(1200 / 3937)
    assert (log.attributes["crs"], log.attributes["height"]) == ("EPSG:2263", "orthometric")
    with pytest.raises(ConfigError, match="vertical_unit is 'metre'"):
        read("las", path, {"vertical_unit": "metre"}, height="orthometric")
    stated = cloud(tmp_path / "b.las", crs="EPSG:2263")
    assert read("las", stated, crs="EPSG:2263+6360", height="orthometric").attributes["crs"] == "EPSG:2263"


def test_degrees_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CrsError, match="not a projected one"):
        read("las", cloud(tmp_path / "a.las", crs="EPSG:4326"))


# --- damage -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("point_format", [3, 7])
def test_a_damaged_laz_chunk_costs_itself(tmp_path: Path, point_format: int) -> None:
    n = 180_000  # four chunks of 50,000
    version = "1.4" if point_format == 7 else "1.2"
    path = cloud(tmp_path / "a.laz", version=version, point_format=point_format, n=n)
    data = bytearray(path.read_bytes())
    offset = struct.unpack_from("<I", data, 96)[0]
    chunk = (len(data) - offset) // 3.6
    at = int(offset + 1.5 * chunk)
    data[at : at + 40_000] = b"\xff" * 40_000
    path.write_bytes(data)
    begin = round((START + 1e9) * 1e9)
    log = read("las", path, trajectory_span_gps_ns=(begin, begin + 10**12))
    assert len(log) + log.rejected == n
    assert len(log) >= 130_000
    outside = np.setdiff1d(np.arange(n), np.arange(50_000, 100_000))
    kept = np.rint((log.epochs - begin) / 1e6).astype(int)
    assert np.isin(outside, kept).all()


def test_a_file_cut_off_keeps_what_it_holds(tmp_path: Path) -> None:
    path = cloud(tmp_path / "a.las", crs=None)
    record = struct.unpack_from("<H", path.read_bytes(), 105)[0]
    path.write_bytes(path.read_bytes()[: -100 * record + 7])
    log = read("las", path, crs=UTM)
    assert (len(log), log.rejected) == (N - 100, 100)


def test_counts_that_claim_too_much(tmp_path: Path) -> None:
    path = cloud(tmp_path / "a.las")
    data = bytearray(path.read_bytes())
    struct.pack_into("<Q", data, 247, 2**60)
    path.write_bytes(data)
    log = read("las", path)
    assert (len(log), log.rejected) == (N, 2**60 - N)
    struct.pack_into("<I", data, 100, 2**32 - 1)
    path.write_bytes(data)
    with pytest.raises(FormatError, match="claims 4,294,967,295 variable-length records"):
        read("las", path)


def test_a_laz_file_without_its_table_is_refused(tmp_path: Path) -> None:
    path = cloud(tmp_path / "a.laz")
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(FormatError, match="table of LAZ chunks is missing or damaged"):
        read("las", path)


def test_other_files_are_not_las(tmp_path: Path) -> None:
    (tmp_path / "a.las").write_bytes(b"LAS?")
    assert not format_named("las").sniff(tmp_path / "a.las")
    assert not format_named("las").sniff(tmp_path)
    with pytest.raises(FormatError, match="not LAS"):
        read("las", tmp_path / "a.las")


@pytest.mark.parametrize(("name", "point_format"), [("a.las", 3), ("a.las", 7), ("a.laz", 7)])
@pytest.mark.parametrize("claimed", [6, 399, 400, 401, 2**32 - 1, 2**62, 2**64 - 1])
def test_points_that_the_header_does_not_claim_are_told(
    tmp_path: Path, name: str, point_format: int, claimed: int
) -> None:
    """A LAZ chunk of point formats 0–5 does not say how many points it holds: there the loss cannot be seen."""
    path = cloud(tmp_path / name, version="1.4" if point_format == 7 else "1.2", point_format=point_format, n=400)
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, 107, min(claimed, 2**32 - 1))
    if point_format == 7:
        struct.pack_into("<Q", data, 247, claimed)
    else:
        claimed = min(claimed, 2**32 - 1)  # LAS 1.2 counts no further
    path.write_bytes(data)
    log = read("las", path, clock=ADJUSTED)
    assert len(log) == min(claimed, 400)
    assert log.rejected == abs(min(claimed, 2**62) - 400)


@pytest.mark.parametrize("name", ["a.las", "a.laz"])
@pytest.mark.parametrize("point_format", [3, 7])
def test_a_header_that_claims_no_point(tmp_path: Path, name: str, point_format: int) -> None:
    version = "1.4" if point_format == 7 else "1.2"
    empty = cloud(tmp_path / f"empty_{name}", version=version, point_format=point_format, n=0)
    log = read("las", empty, clock=ADJUSTED)
    assert (len(log), log.rejects) == (0, [])
    path = cloud(tmp_path / name, version=version, point_format=point_format, n=400)
    data = bytearray(path.read_bytes())
    data[107:111] = bytes(4)
    if point_format == 7:
        data[247:255] = bytes(8)
    path.write_bytes(data)
    log = read("las", path, clock=ADJUSTED)
    assert len(log) == 0
    assert [r.reason for r in log.rejects] == ["the file holds points that the header does not claim"]
