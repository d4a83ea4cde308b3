"""RTKLIB .pos: a real drive, lines in each of RTKLIB's forms, damage."""

from __future__ import annotations

import datetime as dt
import gzip
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from roadscan.core.crs import Geoid
from roadscan.core.errors import ConfigError, CrsError, FormatError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem, gps_ns_from_utc
from roadscan.ingest.reading.format import format_named, format_of
from tests.formats.log_reading import Log, read_log, source_of

ECEF = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
STATED: dict[str, Any] = {"crs": "EPSG:4979"}
FORM = "% (lat/lon/height=WGS84/{},Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)"
COLUMNS = "latitude(deg) longitude(deg)  height(m)   Q  ns"
SIGMAS = "sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio"
VELOCITY = "vn(m/s)    ve(m/s)    vu(m/s)      sdvn     sdve     sdvu    sdvne    sdveu    sdvun"
LEVEL = "0.0123 0.0110 0.0300 -0.0050 0.0040 -0.0070 0.25 12.3"
SPEED = "1.50000 -2.50000 0.12500 0.02000 0.03000 0.04000 0.00100 0.00200 0.00300"
GPST_0 = (dt.datetime(2024, 6, 18, 16, 47, 43) - dt.datetime(1980, 1, 6)) // dt.timedelta(seconds=1) * 10**9


def write(path: Path, columns: str, *lines: str, above: tuple[str, ...] = ()) -> Path:
    head = ["% program   : RTKLIB ver.2.4.3 b34", *above, "%", columns]
    path.write_text("\r\n".join([*head, *lines, ""]))
    return path


def pos(path: Path, *lines: str, time: str = "GPST", above: tuple[str, ...] = ()) -> Path:
    return write(path, f"%  {time}  {COLUMNS} {SIGMAS}", *lines, above=above)


def sample() -> bytes:
    """A small valid file."""
    lines = (f"2024/06/18 16:47:{i:02d}.500 50.00000000{i} 10.0 120.5000 1 12 {LEVEL}" for i in range(6))
    return "\n".join([FORM.format("ellipsoidal"), f"%  GPST  {COLUMNS} {SIGMAS}", *lines, ""]).encode()


def only(log: Log) -> dict[str, Any]:
    assert log.rejects == []
    (row,) = log.table.to_pylist()
    return row


def position(row: dict[str, Any]) -> np.ndarray:
    return np.array([row[f"{a}_world_m"] for a in "xyz"])


def ecef(longitude: float, latitude: float, height: float) -> np.ndarray:
    return np.array(ECEF.transform(longitude, latitude, height))


# --- a real drive ------------------------------------------------------------------------------------


def test_a_real_drive(recordings: Path) -> None:
    path = recordings / "drive" / "gnss_rtk.pos.gz"
    assert format_of(path).name == "rtklib_pos"
    log = read_log("rtklib_pos", path, **STATED)
    assert log.attributes == {"world_frame": "EPSG:4978", "solution": "lat/lon/height", "time": "GPST"}
    assert log.rejects == []

    with gzip.open(path, "rt") as stream:
        words = [line.split() for line in stream if not line.startswith("%")]
    assert log.table.num_rows == len(words) == 2197
    start = dt.datetime(1980, 1, 6)
    for i in (0, 1, 777, -1):
        moment = dt.datetime.strptime(" ".join(words[i][:2]), "%Y/%m/%d %H:%M:%S.%f")
        assert log.epochs[i] == (moment - start) // dt.timedelta(microseconds=1) * 1000
    values = np.array([w[2:] for w in words], dtype=float)
    expected = np.stack(ECEF.transform(values[:, 1], values[:, 0], values[:, 2]), axis=-1)
    np.testing.assert_allclose(log.positions, expected, atol=1e-8)
    assert (log.epochs[-1] - log.epochs[0]) / 1e9 == pytest.approx(549, abs=0.5)
    path_m = np.linalg.norm(np.diff(log.positions, axis=0), axis=1).sum()
    assert path_m == pytest.approx(4050, abs=15)

    quality = log.table.column("quality").to_pylist()
    assert (quality.count("fixed"), quality.count("float")) == (2189, 8)
    np.testing.assert_array_equal(log.column("satellites"), values[:, 4])
    np.testing.assert_allclose(log.column("sigma_north_m"), values[:, 5], rtol=1e-6)
    np.testing.assert_allclose(log.column("sigma_down_m"), values[:, 7], rtol=1e-6)
    np.testing.assert_allclose(log.column("velocity_north_m_per_s"), values[:, 13])
    np.testing.assert_allclose(log.column("velocity_east_m_per_s"), values[:, 14])
    np.testing.assert_allclose(log.column("velocity_down_m_per_s"), -values[:, 15])
    np.testing.assert_allclose(log.column("sigma_velocity_east_m_per_s"), values[:, 17], rtol=1e-6)
    # Positions and velocities are of one motion.
    moved = np.linalg.norm(np.diff(log.positions, axis=0), axis=1) / (np.diff(log.epochs) / 1e9)
    speed = np.linalg.norm([log.column(f"velocity_{a}_m_per_s") for a in ("north", "east", "down")], axis=0)
    assert np.median(np.abs(moved - (speed[1:] + speed[:-1]) / 2)) < 0.05


# --- RTKLIB's forms ----------------------------------------------------------------------------------


def test_covariances_of_signed_roots(tmp_path: Path) -> None:
    columns = f"%  GPST  {COLUMNS} {SIGMAS} {VELOCITY}"
    line = f"2024/06/18 16:47:43.125  -33.241210525 -115.951228361 -66.0251 4 9 {LEVEL} {SPEED}"
    row = only(read_log("rtklib_pos", write(tmp_path / "a.pos", columns, line), **STATED))
    assert row["epoch_gps_ns"] == GPST_0 + 125_000_000
    np.testing.assert_allclose(position(row), ecef(-115.951228361, -33.241210525, -66.0251), atol=1e-8)
    assert (row["quality"], row["satellites"]) == ("dgps", 9)
    assert [row[f"sigma_{a}_m"] for a in ("north", "east", "down")] == pytest.approx([0.0123, 0.0110, 0.03])
    # cov(n,e) = sdne², cov(n,d) = −cov(u,n), cov(e,d) = −cov(e,u)
    assert [row[f"covariance_{c}_m2"] for c in ("ne", "nd", "ed")] == pytest.approx([-25e-6, 49e-6, -16e-6])
    assert [row[f"velocity_{a}_m_per_s"] for a in ("north", "east", "down")] == [1.5, -2.5, -0.125]
    assert [row[f"sigma_velocity_{a}_m_per_s"] for a in ("north", "east", "down")] == pytest.approx([0.02, 0.03, 0.04])
    assert (row["age_s"], row["ratio"]) == (0.25, pytest.approx(12.3))
    assert row["hdop"] is row["heading_deg"] is row["undulation_m"] is None


@pytest.mark.parametrize(
    ("q", "quality"),
    [(1, "fixed"), (2, "float"), (3, "sbas"), (4, "dgps"), (5, "single"), (6, "ppp"), (7, "dead_reckoning")],
)
def test_quality(tmp_path: Path, q: int, quality: str) -> None:
    path = write(tmp_path / "a.pos", f"%  GPST  {COLUMNS}", f"2024/06/18 16:47:43.000 50.0 10.0 100.0 {q} 9")
    assert only(read_log("rtklib_pos", path, **STATED))["quality"] == quality


LINE = "16:47:43.000 50.0 10.0 100.0 1 9 " + LEVEL


@pytest.mark.parametrize(
    ("time", "stamp", "epoch"),
    [
        ("GPST", "2024/06/18 16:47:43.000", GPST_0),
        ("UTC ", "2024/06/18 16:47:43.000", gps_ns_from_utc(dt.datetime(2024, 6, 18, 16, 47, 43, tzinfo=dt.UTC))),
        ("UTC ", "2024/06/18 16:47:25.000", GPST_0),  # 18 leap seconds
        ("JST ", "2024/06/19 01:47:25.000", GPST_0),
        ("GPST", "2319 233263.000", GPST_0),  # week and second as RTKLIB's header of the same instant has them
        ("UTC ", "2319 233245.000", GPST_0),
    ],
)
def test_time_systems(tmp_path: Path, time: str, stamp: str, epoch: int) -> None:
    path = pos(tmp_path / "a.pos", f"{stamp} 50.0 10.0 100.0 1 9 {LEVEL}", time=time)
    assert only(read_log("rtklib_pos", path, **STATED))["epoch_gps_ns"] == epoch
    offset = Clock(TimeSystem.UNIX_GPS if time == "GPST" else TimeSystem.UNIX_UTC, offset_s=0.5)
    assert only(read_log("rtklib_pos", path, clock=offset, **STATED))["epoch_gps_ns"] == epoch + 500_000_000


def test_degrees_minutes_seconds(tmp_path: Path) -> None:
    """The sign stands before the degrees, also before none; the last column's name is RTKLIB's slip."""
    columns = "%  GPST  latitude(d'\") longitude(d'\") height(m) Q ns " + SIGMAS.replace("sdun", "sdue")
    line = f"2024/06/18 16:47:43.000  -0 30 36.00000  -115 57 04.42210  100.0000 1 9 {LEVEL}"
    row = only(read_log("rtklib_pos", write(tmp_path / "a.pos", columns, line), **STATED))
    expected = ecef(-(115 + 57 / 60 + 4.4221 / 3600), -0.51, 100.0)
    np.testing.assert_allclose(position(row), expected, atol=1e-8)
    assert [row[f"covariance_{c}_m2"] for c in ("ne", "nd", "ed")] == pytest.approx([-25e-6, 49e-6, -16e-6])


@pytest.mark.parametrize("separator", [",", ";", "\t", "  "])
@pytest.mark.parametrize("stamp", ["2024/06/18 16:47:43.000", "2319 233263.000"])
def test_separators(tmp_path: Path, separator: str, stamp: str) -> None:
    names = ["%  GPST      ", *f"{COLUMNS} {SIGMAS}".split()]
    if stamp.startswith("2319"):
        stamp = stamp.replace(" ", separator)
    line = separator.join([stamp, *f" 50.0  10.0  100.0   1   9 {LEVEL}".split()])
    row = only(read_log("rtklib_pos", write(tmp_path / "a.pos", separator.join(names), line), **STATED))
    assert row["epoch_gps_ns"] == GPST_0
    np.testing.assert_allclose(position(row), ecef(10.0, 50.0, 100.0), atol=1e-8)
    assert row["ratio"] == pytest.approx(12.3)


def ned_rotation(longitude: float, latitude: float) -> np.ndarray:
    """ECEF from north-east-down, from SciPy."""
    return Rotation.from_euler("ZY", [longitude, -latitude - 90], degrees=True).as_matrix()


XYZ = (
    "%  GPST  x-ecef(m) y-ecef(m) z-ecef(m) Q ns sdx(m) sdy(m) sdz(m) sdxy(m) sdyz(m) sdzx(m) age(s) ratio "
    "vx(m/s) vy(m/s) vz(m/s) sdvx sdvy sdvz sdvxy sdvyz sdvzx"
)


@pytest.mark.parametrize("crs", ["EPSG:4978", "EPSG:4979"])
def test_geocentric_solutions(tmp_path: Path, crs: str) -> None:
    """Errors and velocity are turned into the local level."""
    longitude, latitude = 10.0, 50.0
    rotation = ned_rotation(longitude, latitude)
    level = np.array([[4e-4, 1e-4, -5e-5], [1e-4, 3e-4, 2e-5], [-5e-5, 2e-5, 9e-4]])
    velocity = np.array([3.0, -4.0, 0.5])
    matrix = rotation @ level @ rotation.T
    roots = [matrix[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0))]
    words = [f"{np.sign(c) * np.sqrt(abs(c)):.9f}" for c in roots]
    xyz = ecef(longitude, latitude, 100.0)
    line = ["2024/06/18 16:47:43.000", *map(repr, xyz.tolist()), "1", "9", *words, "0.0", "0.0"]
    line += [*map(repr, (rotation @ velocity).tolist()), *words]
    row = only(read_log("rtklib_pos", write(tmp_path / "a.pos", XYZ, " ".join(line)), crs=crs))
    np.testing.assert_allclose(position(row), xyz, atol=1e-8)
    sigmas = [row[f"sigma_{a}_m"] for a in ("north", "east", "down")]
    assert sigmas == pytest.approx([0.02, np.sqrt(3e-4), 0.03], rel=1e-4)
    assert [row[f"covariance_{c}_m2"] for c in ("ne", "nd", "ed")] == pytest.approx([1e-4, -5e-5, 2e-5], abs=1e-8)
    assert [row[f"velocity_{a}_m_per_s"] for a in ("north", "east", "down")] == pytest.approx(velocity.tolist())
    assert row["sigma_velocity_down_m_per_s"] == pytest.approx(0.03, rel=1e-4)


BASELINE = "%  GPST  e-baseline(m) n-baseline(m) u-baseline(m) Q ns sde(m) sdn(m) sdu(m) sden(m) sdnu(m) sdue(m)"
BASELINE_LINE = "2024/06/18 16:47:43.000 300.0 400.0 -20.0 2 9 0.0110 0.0123 0.0300 -0.0050 -0.0070 0.0040"


def test_baselines(tmp_path: Path) -> None:
    above = ("% ref pos   : 50.000000000   10.000000000   100.0000",)
    path = write(tmp_path / "a.pos", BASELINE, BASELINE_LINE, above=above)
    row = only(read_log("rtklib_pos", path, **STATED))
    expected = ecef(10.0, 50.0, 100.0) + ned_rotation(10.0, 50.0) @ [400.0, 300.0, 20.0]
    np.testing.assert_allclose(position(row), expected, atol=1e-7)
    assert [row[f"sigma_{a}_m"] for a in ("north", "east", "down")] == pytest.approx([0.0123, 0.0110, 0.03])
    assert [row[f"covariance_{c}_m2"] for c in ("ne", "nd", "ed")] == pytest.approx([-25e-6, 49e-6, -16e-6])
    base = {"latitude_deg": 50.0, "longitude_deg": 10.0, "height_m": 200.0}
    higher = only(read_log("rtklib_pos", path, {"base": base}, **STATED))
    lifted = position(higher) - position(row)
    np.testing.assert_allclose(lifted, ned_rotation(10.0, 50.0) @ [0, 0, -100.0], atol=1e-7)


def test_baselines_without_a_base(tmp_path: Path) -> None:
    path = write(tmp_path / "a.pos", BASELINE, BASELINE_LINE)
    with pytest.raises(ConfigError, match="does not say where the base station stands"):
        format_named("rtklib_pos").header(source_of("rtklib_pos", path, **STATED))
    log = read_log("rtklib_pos", path, crs="local")
    assert log.attributes["world_frame"] == "local"
    np.testing.assert_array_equal(log.positions, [[300.0, 400.0, -20.0]])


def test_geodetic_heights(tmp_path: Path) -> None:
    """They need the geoid that RTKLIB used; a grid of 40 m stands for it."""
    path = pos(tmp_path / "a.pos", f"2024/06/18 {LINE}", above=(FORM.format("geodetic"),))
    header = format_named("rtklib_pos").header
    for stated in ({}, {"height": "orthometric"}):
        with pytest.raises(CrsError, match="header says geodetic heights"):
            header(source_of("rtklib_pos", path, **STATED, **stated))
    grid = flat_geoid(tmp_path / "flat.gtx", 40.0)
    row = only(read_log("rtklib_pos", path, **STATED, height="orthometric", geoid=Geoid.found(str(grid))))
    np.testing.assert_allclose(position(row), ecef(10.0, 50.0, 140.0), atol=1e-6)


def flat_geoid(path: Path, undulation_m: float) -> Path:
    """A GTX grid (NOAA): 20° by 20° about 50° N, 10° E, one value everywhere."""
    head = np.array([40.0, 0.0, 10.0, 10.0], dtype=">f8").tobytes() + np.array([3, 3], dtype=">i4").tobytes()
    path.write_bytes(head + np.full(9, undulation_m, dtype=">f4").tobytes())
    return path


@pytest.mark.parametrize(
    ("time", "form", "stated", "error", "says"),
    [
        ("GPST", "ellipsoidal", {}, ConfigError, "CRS of the log's positions is not stated"),
        ("GPST", "ellipsoidal", {"crs": "local"}, ConfigError, "positions are latitude and longitude"),
        ("GPST", "ellipsoidal", {"crs": "EPSG:25832"}, CrsError, "no geographic CRS"),
        (
            "GPST",
            "ellipsoidal",
            STATED | {"height": "orthometric"},
            CrsError,
            "are ellipsoidal by the log's header",
        ),
        ("GPST", "", STATED | {"height": "orthometric"}, CrsError, "no geoid is named"),
        ("GPST", "ellipsoidal", STATED | {"clock": Clock(TimeSystem.UNIX_UTC)}, TimeSystemError, "times are GPST"),
        ("UTC ", "ellipsoidal", STATED | {"clock": Clock(TimeSystem.UNIX_GPS)}, TimeSystemError, "times are UTC"),
        ("BDT ", "ellipsoidal", STATED, TimeSystemError, "time system 'BDT'"),
    ],
)
def test_what_contradicts_the_header(
    tmp_path: Path, time: str, form: str, stated: dict, error: type, says: str
) -> None:
    above = (FORM.format(form),) if form else ()
    path = pos(tmp_path / "a.pos", f"2024/06/18 {LINE}", time=time, above=above)
    with pytest.raises(error, match=says):
        format_named("rtklib_pos").header(source_of("rtklib_pos", path, **stated))


def test_the_datum_tokyo(tmp_path: Path) -> None:
    form = FORM.format("ellipsoidal").replace("WGS84", "Tokyo")
    path = pos(tmp_path / "a.pos", f"2024/06/18 {LINE}", above=(form,))
    with pytest.raises(CrsError, match="says the datum Tokyo, the crs is 'EPSG:4979'"):
        format_named("rtklib_pos").header(source_of("rtklib_pos", path, **STATED))
    header = format_named("rtklib_pos").header(source_of("rtklib_pos", path, crs="EPSG:4301"))
    assert header.attributes["world_frame"] != "EPSG:4978"


@pytest.mark.parametrize(
    ("columns", "line", "says"),
    [
        ("% nothing", f"2024/06/18 {LINE}", "no header line names the columns"),
        (f"%  GPST  {COLUMNS}", f"2024/06/18 {LINE}", "no line has the 5 fields"),
        (f"%  GPST  {COLUMNS} Q", f"2024/06/18 {LINE}", "two columns of the header have one name"),
        ("%  GPST  latitude(deg) longitude(deg) Q ns", f"2024/06/18 {LINE}", "names no column 'height'"),
        (f"%  GPST  {COLUMNS} {SIGMAS}", "", "no line has the 13 fields"),
    ],
)
def test_headers_that_do_not_fit(tmp_path: Path, columns: str, line: str, says: str) -> None:
    with pytest.raises(FormatError, match=says):
        read_log("rtklib_pos", write(tmp_path / "a.pos", columns, line), **STATED)


# --- damage ------------------------------------------------------------------------------------------


def test_each_damaged_line_costs_itself(tmp_path: Path) -> None:
    def line(second: int, latitude: str = "50.0", q: str = "1", ns: str = "9", sdn: str = "0.0123") -> str:
        return f"2024/06/18 16:47:{second:02d}.000 {latitude} 10.0 100.0 {q} {ns} {LEVEL.replace('0.0123', sdn)}"

    lines = [line(i) for i in range(12)]
    lines[1] = line(1, latitude="95.0")
    lines[2] = line(2, latitude="5x.0")
    lines[3] = lines[3].replace("2024/06", "2024/66")
    lines[5] = line(5, q="9")
    lines[6] = line(6, ns="-1")
    lines[7] = line(7, sdn="-1e200")
    lines[8] = lines[8][:40]
    lines[9] = lines[9].replace("16:47", "18:47")
    path = pos(tmp_path / "a.pos", *lines)
    log = read_log("rtklib_pos", path, **STATED)
    text = path.read_bytes()
    starts = [text.index(one.encode()) for one in lines]
    assert {(r.record, r.offset): r.reason for r in log.rejects} == {
        (1, starts[1]): "latitude is outside -1.5708 to 1.5708 rad",
        (2, starts[2]): "latitude '5x.0' is not a number",
        (3, starts[3]): "time is not of the form yyyy/mm/dd hh:mm:ss.sss",
        (5, starts[5]): "Q is not one of 1, 2, 3, 4, 5, 6, 7",
        (6, starts[6]): "number of satellites is not a whole number from 0 to 255",
        (7, starts[7]): "sdn is beyond 1e+06",
        (8, starts[8]): "5 fields, expected 15",
        (9, starts[9]): "time stamp leaps out of the log's order by over 10 s and back",
    }
    first = GPST_0 - 43 * 10**9
    assert log.epochs.tolist() == [first + i * 10**9 for i in (0, 4, 10, 11)]


def test_a_truncated_packed_file(recordings: Path, tmp_path: Path) -> None:
    whole = (recordings / "drive" / "gnss_rtk.pos.gz").read_bytes()
    path = tmp_path / "a.pos.gz"
    path.write_bytes(whole[: len(whole) // 2])
    log = read_log("rtklib_pos", path, **STATED)
    assert 500 < log.table.num_rows < 2197
    assert any("damaged from here on" in r.reason for r in log.rejects)


def test_sniffing(tmp_path: Path, recordings: Path) -> None:
    is_pos = format_named("rtklib_pos").sniff
    path = tmp_path / "a.pos"
    path.write_bytes(sample())
    assert format_of(path).name == "rtklib_pos"
    assert not is_pos(tmp_path)
    assert not is_pos(tmp_path / "absent")
    others = [p for p in recordings.rglob("*") if p.is_file() and ".pos" not in p.name]
    assert [p for p in others if is_pos(p)] == []


def test_lines_that_end_in_returns_alone_do_not_vanish(tmp_path: Path) -> None:
    path = tmp_path / "a.pos"
    path.write_bytes(sample().replace(b"\n", b"\r"))
    log = read_log("rtklib_pos", path, **STATED)
    assert log.table.num_rows == 0
    assert len(log.rejects) == 1
