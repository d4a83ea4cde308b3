"""Every reader: records and bytes a second, beside the library that one would otherwise call.

A reader checks each record, brings it to SI units, GPS time and the world frame, and yields table rows; most of the
libraries only parse. A last group brings logs to partitioned Parquet, fingerprint included. `ROADSCAN_PARTS` names the
parts: "formats" (each reader), "scans" (a line-rate pair of profilers, :mod:`benchmarks.line_rate_ingest`).
"""

from __future__ import annotations

import contextlib
import functools
import io
import json
import os
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import geopandas
import laspy
import numpy as np
import numpy.typing as npt
import pandas as pd
import PIL.Image
import pyarrow as pa
import pyarrow.feather
import pyarrow.parquet as pq
import shapely

from benchmarks.lidar_logs import LIDAR_LOGS
from benchmarks.line_rate_ingest import line_rate_figures
from benchmarks.timing import Figure, best_seconds
from roadscan.core.crs import MapFrame
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.core.rig import Sensor
from roadscan.core.survey import Survey
from roadscan.formats.clouds.opencrg_file import CurvedRegularGrid, write_crg
from roadscan.formats.motion.ubx import HEADER, SOLUTION
from roadscan.formats.scanners.psi_container import PsiContainer, PsiHeader, write_psi
from roadscan.ingest.ingest import ingest
from roadscan.ingest.reading.format import LogSource, Reject, format_named, log_formats
from roadscan.store.store import Store
from tests.formats.nmea_files import Fix, sentences
from tests.formats.sick_files import encode_scans

SBET_BAR = 5.0
"""Million records a second."""
HDL_32E_BAR = 40.0
"""Times real time."""
HDL_32E_S = 40.0
T0 = 1_400_000_000
GPS = Clock(TimeSystem.GPS)
WEEK = Clock(TimeSystem.GPS_WEEK, week=2405)
Float64 = np.ndarray[Any, np.dtype[np.float64]]


@dataclass(frozen=True)
class Log:
    """A log to be read."""

    format: str
    what: str
    path: Path
    options: dict[str, Any] = field(default_factory=dict)
    stated: dict[str, Any] = field(default_factory=dict)
    records: int | None = None
    """Records, where they are not the rows."""
    other: Callable[[], int] | None = None
    """Reads (a part of) the same with another library; returns its records."""
    against: str = ""
    bar: float | None = None
    """Million records a second."""
    survey: str = ""
    """Its other lines in a survey file, where it is brought to Parquet too."""
    ingest_bar: float | None = None
    """Million records a second of a core's time, from the log to Parquet."""


def figures(folder: Path) -> Iterator[Figure]:
    """Reading, then ingest."""
    parts = os.environ.get("ROADSCAN_PARTS", "formats scans").split()
    if "formats" in parts:
        yield from format_figures(folder)
    if "scans" in parts:
        place = folder / "pair"
        place.mkdir()
        yield from line_rate_figures(place)


def format_figures(folder: Path) -> Iterator[Figure]:
    """Every format."""
    made = makers()
    missing = set(log_formats()) - {name.split(" ", 1)[0] for name in made}
    assert not missing, f"no benchmark for {missing}"
    for name, make in made.items():
        place = folder / name.replace(" ", "_")
        place.mkdir()
        log = make(place)
        took = seconds(log)
        yield read_figure(log, took)
        if name == "velodyne_pcap":
            yield Figure(f"velodyne_pcap HDL-32E: times real time (bar: {HDL_32E_BAR:g})", HDL_32E_S / took, "x")
        if log.survey:
            yield from ingest_figures(log, place)


def read_figure(log: Log, took: float) -> Figure:
    """Million records a second, with MB/s in the text."""
    records = log.records or count(log)
    size = sum(f.stat().st_size for f in format_named(log.format).files(log.path)) / 1e6
    bar = f" (bar: {log.bar:g})" if log.bar else ""
    what = f"{log.format} {log.what}".strip() + f": {size:,.0f} MB at {size / took:,.0f} MB/s{bar}"
    if log.other is None:
        return Figure(what, records / took / 1e6, "M/s")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        started = time.perf_counter()
        theirs = log.other()
        rate = theirs / (time.perf_counter() - started)
    return Figure(what, records / took / 1e6, "M/s", rate / 1e6, log.against)


def count(log: Log) -> int:
    """Rows of a log; a reject would falsify the figure."""
    log_format = format_named(log.format)
    source = LogSource(log.path, log_format.options.parse(log.options), **log.stated)
    rows = 0
    for item in log_format.read(source, log_format.header(source)):
        assert not isinstance(item, Reject), f"{log.format}: {item}"
        rows += item.batch.num_rows if item.table == log_format.yields[0] else 0
    return rows


def seconds(log: Log) -> float:
    """Shorter of two readings, after one that is not counted."""
    return best_seconds(lambda: count(log), runs=2)


# --- ingest -----------------------------------------------------------------------------------------


def ingest_figures(log: Log, folder: Path) -> Iterator[Figure]:
    """From the raw log to tables: fingerprint, reading, partitions, Parquet."""
    lines = [
        'id = "bench"', 'store = "store"', "[map]", 'crs = "EPSG:25832"', "[rig.sensors.lidar]", 'kind = "lidar"',
        "[rig.sensors.head]", 'kind = "profiler"', "[[runs]]", 'id = "run"', "[[runs.logs]]",
        f'path = "{log.path.name}"', f'format = "{log.format}"', log.survey,
    ]  # fmt: skip
    (folder / "SURVEY.toml").write_text("\n".join(lines))
    survey = Survey.load(folder / "SURVEY.toml")
    times, cores = [], []
    for name in ("once", "again"):  # the first loads what a process loads once
        started, worked = time.perf_counter(), time.process_time()
        (result,) = ingest(survey, Store(str(folder / name), "bench"))
        times.append(time.perf_counter() - started)
        cores.append(time.process_time() - worked)
    took, rows = min(times), log.records or result.record.rows
    size = sum(f.stat().st_size for f in format_named(log.format).files(log.path)) / 1e6
    what, bar = f"{log.format} {log.what}".strip(), f" (bar: {log.ingest_bar:g})" if log.ingest_bar else ""
    yield Figure(f"{what} → Parquet: {size:,.0f} MB at {size / took:,.0f} MB/s", rows / took / 1e6, "M/s")
    yield Figure(f"{what} → Parquet, by a core's time{bar}", rows / min(cores) / 1e6, "M/s")
    if log.format == "velodyne_pcap" and log.what.startswith("HDL-32E"):
        yield Figure("velodyne_pcap HDL-32E → Parquet: times real time", HDL_32E_S / took, "x")


# --- logs -------------------------------------------------------------------------------------------


def makers() -> dict[str, Callable[[Path], Log]]:
    """Makers of logs, by format and form."""
    return {
        "sbet": sbet, "smrmsg": smrmsg, "trajectory_csv": trajectory_csv, "trajectory_table": trajectory_table,
        "returns_table": returns_table, "pose_matrices": pose_matrices,
        "pose_quaternions csv": pose_quaternions, "pose_quaternions parquet": pose_parquet, "pospac": pospac,
        "rtklib_pos": rtklib_pos, "nmea": nmea, "ubx": ubx, "imu_csv": imu_csv, "encoder_csv": encoder_csv,
        "control_csv": control_csv, "control_vector": control_vector, "control_lines": control_lines,
        "road_lines": road_lines,
        "velodyne_pcap": velodyne_pcap, "sick_lms": sick_lms, "carmen": carmen, "kitti": kitti, "argoverse": argoverse,
        "scans": scans, "psi": psi, "psi zip": functools.partial(psi, codec="zip"),
        "las": functools.partial(las, name="a.las"), "las laz": functools.partial(las, name="a.laz"), "e57": e57,
        "ply": ply, "ply ascii": functools.partial(ply, text=True), "opencrg": opencrg, "images": images,
        **{name: functools.partial(lidar_log, name=name) for name in LIDAR_LOGS},
    }  # fmt: skip


UNTIMED = frozenset({
    "gnss_csv", "gpx", "grafnav", "hesai_scans", "inertial_explorer", "novatel_bestpos", "novatel_ins",
    "odm_gcp", "odm_picture_points", "opensfm_gcp", "opensfm_picture_points",
    "ouster_bag", "ouster_bag_imu", "ouster_imu", "pcd", "pcd_cloud",
    "picture_points_csv", "pospac_text", "ppk", "qinertia", "ros_gnss", "ros_imu", "ros_livox", "ros_nmea", "ros_poses",
    "robosense_pcap", "robosense_scans", "velodyne_scans",
})  # fmt: skip
"""Formats that have no maker of logs here yet."""


def moving(n: int) -> tuple[Float64, Float64, Float64]:
    """Stamp after the first (s), and a smooth course: metres east and north, (n,)."""
    t = np.arange(n) * 0.005
    return t, 15 * t, 50 * np.sin(t / 60)


def columns_csv(path: Path, columns: dict[str, Float64]) -> Path:
    """A CSV file."""
    pd.DataFrame(columns).to_csv(path, index=False)
    return path


def with_pandas(path: Path, **how: Any) -> Callable[[], int]:
    return lambda: len(pd.read_csv(path, **how))


def sbet(folder: Path) -> Log:
    n = 1_500_000
    t, east, north = moving(n)
    rows = np.full((n, 17), 0.01)
    rows[:, 0] = 100_000 + t
    rows[:, 1], rows[:, 2], rows[:, 3] = 0.87 + north / 6.37e6, 0.17 + east / 4e6, 150 + np.sin(t)
    rows[:, 9] = 1.5 + 0.01 * np.sin(t)
    path = folder / "a.sbet"
    rows.astype("<f8").tofile(path)
    other = lambda: len(np.fromfile(path, "<f8").reshape(-1, 17).T.copy().T)  # noqa: E731
    stated = {"clock": WEEK, "crs": "EPSG:4979"}
    return Log(
        "sbet",
        "",
        path,
        {},
        stated,
        other=other,
        against="numpy.fromfile, turned",
        bar=SBET_BAR,
        survey='crs = "EPSG:4979"\nclock = { system = "gps_week_seconds", week = 2405 }',
    )


def smrmsg(folder: Path) -> Log:
    n = 1_500_000
    rows = np.full((n, 10), 0.02)
    rows[:, 0] = 100_000 + np.arange(n) * 0.005
    path = folder / "a.out"
    rows.astype("<f8").tofile(path)
    other = lambda: len(np.fromfile(path, "<f8").reshape(-1, 10).T.copy().T)  # noqa: E731
    return Log("smrmsg", "", path, {}, {"clock": WEEK}, other=other, against="numpy.fromfile, turned")


def courses(n: int) -> dict[str, Float64]:
    """Columns of a trajectory with attitude."""
    t, east, north = moving(n)
    return {
        "time_s": T0 + t, "latitude_deg": 50 + north / 111e3, "longitude_deg": 10 + east / 71e3,
        "height_m": 100 + 0 * t, "roll_deg": np.sin(t), "pitch_deg": np.cos(t), "heading_deg": 90 + np.sin(t),
        "sigma_north_m": 0.02 + 0 * t,
    }  # fmt: skip


def trajectory_csv(folder: Path) -> Log:
    path = columns_csv(folder / "a.csv", courses(300_000))
    stated = {"clock": GPS, "crs": "EPSG:4979"}
    return Log("trajectory_csv", "", path, {}, stated, other=with_pandas(path), against="pandas.read_csv")


def columns_parquet(path: Path, columns: dict[str, npt.NDArray[Any]]) -> tuple[Path, Callable[[], int]]:
    """A Parquet file, and its reading by Arrow alone."""
    pq.write_table(pa.table(columns), path)
    return path, lambda: pq.read_table(path).num_rows


def trajectory_table(folder: Path) -> Log:
    path, other = columns_parquet(folder / "a.parquet", courses(1_000_000))
    stated = {"clock": GPS, "crs": "EPSG:4979"}
    return Log("trajectory_table", "", path, {}, stated, other=other, against="pyarrow.parquet.read_table")


def returns_table(folder: Path) -> Log:
    n = 5_000_000
    t = np.arange(n)
    columns: dict[str, npt.NDArray[Any]] = {
        "epoch_gps_ns": 1_461_900_018 * 10**9 + 1_400 * t,
        "x_sensor_m": 20.0 * np.cos(t / 700), "y_sensor_m": 20.0 * np.sin(t / 700),
        "z_sensor_m": -2.0 + 0.01 * (t % 32),
        "intensity": (t % 4096).astype(np.uint16), "laser": (t % 32).astype(np.uint8),
    }  # fmt: skip
    path, other = columns_parquet(folder / "a.parquet", columns)
    return Log("returns_table", "", path, {}, {}, other=other, against="pyarrow.parquet.read_table")


def pose_matrices(folder: Path) -> Log:
    t, east, north = moving(200_000)
    c, s, zero = np.cos(t / 60), np.sin(t / 60), 0 * t
    columns = {
        "time_s": T0 + t, "r11": c, "r12": -s, "r13": zero, "t1": east, "r21": s, "r22": c, "r23": zero, "t2": north,
        "r31": zero, "r32": zero, "r33": zero + 1, "t3": zero,
    }  # fmt: skip
    path = columns_csv(folder / "a.csv", columns)
    stated = {"clock": GPS, "crs": "local"}
    return Log("pose_matrices", "", path, {"axes": "flu"}, stated, other=with_pandas(path), against="pandas.read_csv")


def quaternions(n: int) -> dict[str, Float64]:
    t, east, north = moving(n)
    zero = 0 * t
    return {
        "time_s": T0 + t, "tx": east, "ty": north, "tz": zero, "qx": zero, "qy": zero, "qz": np.sin(t / 120),
        "qw": np.cos(t / 120),
    }  # fmt: skip


def pose_quaternions(folder: Path) -> Log:
    path = columns_csv(folder / "a.csv", quaternions(300_000))
    stated = {"clock": GPS, "crs": "local"}
    other = with_pandas(path)
    return Log("pose_quaternions", "CSV", path, {"axes": "flu"}, stated, other=other, against="pandas.read_csv")


def pose_parquet(folder: Path) -> Log:
    path, other = columns_parquet(folder / "a.parquet", quaternions(1_000_000))
    stated = {"clock": GPS, "crs": "local"}
    against = "pyarrow.parquet.read_table"
    return Log(
        "pose_quaternions",
        "Parquet",
        path,
        {"axes": "flu"},
        stated,
        other=other,
        against=against,
        survey='sensor = "head"',
    )


def pospac(folder: Path) -> Log:
    t, east, north = moving(200_000)
    zero = 0 * t
    names = [
        "easting",
        "northing",
        "altitude",
        "vel_east",
        "vel_north",
        "vel_up",
        "roll",
        "pitch",
        "heading",
        "wz",
        "wy",
        "wx",
    ]
    values = [
        571_600 + east,
        5_539_000 + north,
        zero + 150,
        *[zero] * 3,
        np.sin(t) / 9,
        np.cos(t) / 9,
        zero,
        *[zero] * 3,
    ]
    path = columns_csv(folder / "a.csv", {"GPSTime": T0 + t} | dict(zip(names, values, strict=True)))
    stated = {"clock": GPS, "crs": "EPSG:25832", "height": "ellipsoidal"}
    return Log("pospac", "", path, {"axes": "flu"}, stated, other=with_pandas(path), against="pandas.read_csv")


def rtklib_pos(folder: Path) -> Log:
    n = 100_000
    times = pd.Timestamp("2024-06-18") + pd.to_timedelta(np.arange(n) * 0.2, unit="s")
    lines = [
        f"{time} {50 + 1e-7 * k:.9f} {10 + 1e-7 * k:.9f} 120.5000 1 12 "
        "0.0123 0.0110 0.0300 -0.0050 0.0040 -0.0070 0.25 12.3"
        for k, time in enumerate(times.strftime("%Y/%m/%d %H:%M:%S.%f").str.slice(stop=-3))
    ]
    head = (
        "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)\n"
        "%  GPST  latitude(deg) longitude(deg)  height(m)   Q  ns  sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m)"
        " age(s)  ratio\n"
    )
    path = folder / "a.pos"
    path.write_text(head + "\n".join(lines) + "\n")
    other = with_pandas(path, sep=r"\s+", comment="%", header=None)
    return Log("rtklib_pos", "", path, {}, {"crs": "EPSG:4979"}, other=other, against="pandas.read_csv")


def nmea(folder: Path) -> Log:
    import pynmea2

    n, start = 60_000, 1_461_900_018 * 10**9
    fixes = (Fix(start + k * 10**8, 50 + 1e-7 * k, 10 + 1e-7 * k, 100.0, 45.0, "fixed", 12, 0.7) for k in range(n))
    path = folder / "a.nmea"
    path.write_text("".join(map(sentences, fixes)))
    some = path.read_text().splitlines()[:20_000]
    other = lambda: len([pynmea2.parse(line) for line in some]) // 2  # noqa: E731
    return Log("nmea", "epochs", path, {}, {"crs": "EPSG:4979"}, n, other, "pynmea2.parse")


def ubx(folder: Path) -> Log:
    n = 100_000
    frames = np.zeros(n, SOLUTION)
    content = frames.view(np.uint8).reshape(n, SOLUTION.itemsize)
    content[:, :6] = np.frombuffer(HEADER, np.uint8)
    tenths = np.arange(n)
    frames["year"], frames["month"], frames["day"] = 2026, 5, 4
    frames["hour"], frames["minute"] = 6 + tenths // 36_000, tenths // 600 % 60
    frames["second"], frames["nano"] = tenths // 10 % 60, 100_000_000 * (tenths % 10)
    frames["valid"], frames["fix"], frames["flags"], frames["satellites"] = 3, 3, 1, 12
    frames["latitude"], frames["longitude"], frames["height_mm"] = 500_000_000 + tenths, 100_000_000 + tenths, 100_000
    covered = content[:, 2:-2].astype(np.int64)
    frames["checksum"][:, 0] = covered.sum(axis=1) % 256
    frames["checksum"][:, 1] = covered @ np.arange(covered.shape[1], 0, -1) % 256
    path = folder / "a.ubx"
    path.write_bytes(frames.tobytes())
    return Log("ubx", "epochs", path, {}, {"crs": "EPSG:4979"}, n)


def imu_csv(folder: Path) -> Log:
    t, _, _ = moving(300_000)
    columns = {"time_s": T0 + t} | {f"gyro_{a}_deg_s": np.sin(t + k) for k, a in enumerate("xyz")}
    columns |= {f"acc_{a}_g": np.cos(t + k) for k, a in enumerate("xyz")}
    path = columns_csv(folder / "a.csv", columns)
    stated = {"clock": GPS, "sensor": Sensor(kind="imu")}
    return Log("imu_csv", "", path, {}, stated, other=with_pandas(path), against="pandas.read_csv")


def encoder_csv(folder: Path) -> Log:
    t, east, _ = moving(500_000)
    path = columns_csv(folder / "a.csv", {"time_s": T0 + t, "ticks": np.rint(east / 0.002).astype(np.int64)})
    stated = {"clock": GPS, "sensor": Sensor(kind="encoder")}
    return Log("encoder_csv", "", path, {"record": "total"}, stated, other=with_pandas(path), against="pandas.read_csv")


def control_csv(folder: Path) -> Log:
    n = 100_000
    columns = {
        "name": np.char.add("P", np.arange(n).astype(str)), "role": np.full(n, "gcp"),
        "easting": 571_600 + np.arange(n) * 0.1, "northing": 5_539_000 + np.arange(n) * 0.1,
        "height_m": np.full(n, 300.0),
    }  # fmt: skip
    path = columns_csv(folder / "a.csv", columns)
    stated = {"crs": "EPSG:25832", "height": "ellipsoidal", "map": MapFrame(crs="EPSG:25832")}
    return Log("control_csv", "", path, {}, stated, other=with_pandas(path), against="pandas.read_csv")


def control_lines(folder: Path) -> Log:
    n = 100_000
    columns = {
        "line": np.char.add("L", (np.arange(n) // 100).astype(str)), "kind": np.full(n, "kerb"),
        "role": np.full(n, "gcp"), "easting": 571_600 + np.arange(n) * 0.1, "northing": 5_539_000 + np.arange(n) * 0.1,
        "height_m": np.full(n, 300.0),
    }  # fmt: skip
    path = columns_csv(folder / "a.csv", columns)
    stated = {"crs": "EPSG:25832", "height": "ellipsoidal", "map": MapFrame(crs="EPSG:25832")}
    return Log("control_lines", "", path, {}, stated, other=with_pandas(path), against="pandas.read_csv")


def control_vector(folder: Path) -> Log:
    n = 30_000
    k = np.arange(n)
    points = shapely.points(np.stack([571_600 + k * 0.1, 5_539_000 + k * 0.1, np.full(n, 300.0)], axis=-1))
    frame = geopandas.GeoDataFrame({"name": np.char.add("P", k.astype(str)), "role": "gcp"}, geometry=points, crs=25832)
    path = folder / "a.gpkg"
    _quietly(frame.to_file, path)
    stated = {"crs": "EPSG:25832", "height": "ellipsoidal", "map": MapFrame(crs="EPSG:25832")}
    other = lambda: len(geopandas.read_file(path))  # noqa: E731
    return Log("control_vector", "GeoPackage", path, {}, stated, other=other, against="geopandas.read_file")


def road_lines(folder: Path) -> Log:
    n = 20_000
    x = -80.5 + np.arange(n) * 2e-5
    vertices = np.stack([np.stack([x + 1e-5 * j, 25.5 + 1e-5 * j + 0 * x], axis=-1) for j in range(8)], axis=1)
    columns = {"LINEARID": np.arange(n).astype(str), "FULLNAME": "Main St", "RTTYP": "M", "MTFCC": "S1400"}
    frame = geopandas.GeoDataFrame(columns, geometry=shapely.linestrings(vertices), crs=4269)
    path = folder / "a.gpkg"
    _quietly(frame.to_file, path)
    other = lambda: len(geopandas.read_file(path))  # noqa: E731
    stated = {"map": MapFrame(crs="EPSG:26917")}
    return Log("road_lines", "GeoPackage", path, {}, stated, other=other, against="geopandas.read_file")


def _quietly(call: Callable[..., object], *args: Any) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        call(*args)


def velodyne_pcap(folder: Path) -> Log:
    """`HDL_32E_S` seconds of an HDL-32E at 10 turns a second: 12 firings of 32 lasers a packet."""
    import velodyne_decoder

    n = int(HDL_32E_S * 1e6 / 552.96)
    rng = np.random.default_rng(0)
    block = np.dtype([("flag", "<u2"), ("azimuth", "<u2"), ("returns", [("far", "<u2"), ("bright", "u1")], 32)])
    packet = np.dtype([
        ("s", "<u4"), ("us", "<u4"), ("held", "<u4"), ("sent", "<u4"), ("net", "u1", 42), ("blocks", block, 12),
        ("stamp", "<u4"), ("mode", "u1"), ("product", "u1"),
    ])  # fmt: skip
    data = np.zeros(n, packet)
    stamp = np.rint(1e6 + np.arange(n) * 552.96)
    posix_us = 1_777_885_200 * 10**6 + stamp  # 2026-05-04 09:00
    data["s"], data["us"] = posix_us // 1e6, posix_us % 1e6
    data["held"] = data["sent"] = 1248
    data["net"] = np.frombuffer(_UDP, np.uint8)
    data["stamp"], data["mode"], data["product"] = stamp, 0x37, 0x21
    blocks = data["blocks"]
    blocks["flag"] = 0xEEFF
    blocks["azimuth"] = np.rint((np.arange(n * 12) * 16.6) % 36_000).reshape(n, 12) % 36_000
    blocks["returns"]["far"] = rng.integers(500, 30_000, (n, 12, 32)) * (rng.random((n, 12, 32)) < 0.85)
    blocks["returns"]["bright"] = rng.integers(0, 256, (n, 12, 32))
    path = folder / "a.pcap"
    with path.open("wb") as sink:
        sink.write(np.array([0xA1B2C3D4], "<u4").tobytes() + np.array([2, 4], "<u2").tobytes())
        sink.write(np.array([0, 0, 65_535, 1], "<u4").tobytes())
        sink.write(data.tobytes())

    def other() -> int:
        config = velodyne_decoder.Config(model=velodyne_decoder.Model.HDL32E, min_range=0, max_range=200)
        scans = velodyne_decoder.read_pcap(str(path), config)
        return sum(len(points) for _, points in scans)

    date = pd.Timestamp("2026-05-04").date()
    stated = {"clock": Clock(TimeSystem.UTC_HOUR, date=date)}
    return Log(
        "velodyne_pcap", "HDL-32E, returns", path, {"hour": 9}, stated, other=other, against="velodyne_decoder",
        survey='sensor = "lidar"\nclock = { system = "utc_hour", date = 2026-05-04 }\noptions = { hour = 9 }',
    )  # fmt: skip


def lidar_log(folder: Path, name: str) -> Log:
    """A log of :mod:`benchmarks.lidar_logs`."""
    kind, what, make, bar = LIDAR_LOGS[name]
    made = make(folder)
    values = ", ".join(f"{k} = {json.dumps(v) if isinstance(v, str | int) else v}" for k, v in made.options.items())
    clock = ", ".join(f"{k} = {json.dumps(v) if isinstance(v, str | int) else v}" for k, v in made.clock.items())
    stated = {
        "clock": Clock(**made.clock | {"system": TimeSystem(made.clock["system"])}),
        "sensor": Sensor(kind="lidar"),
    }
    survey = f'sensor = "lidar"\nclock = {{ {clock} }}\noptions = {{ {values} }}'
    return Log(kind, what, made.path, made.options, stated, survey=survey, ingest_bar=bar)


_UDP = bytes.fromhex("ffffffffffff6076880000000800450004d20001000040110000c0a801c9ffffffff01bb094004be0000")


def sick_lms(folder: Path) -> Log:
    n = 40_000
    ranges = np.random.default_rng(0).integers(1, 8000, (n, 181), dtype=np.uint16)
    path = folder / "a.log"
    path.write_bytes(encode_scans(ranges, "mm").tobytes())
    options = {"first_stamp_s": float(T0), "scans_per_s": 75.0}
    return Log("sick_lms", "scans", path, options, {"clock": GPS})


def carmen(folder: Path) -> Log:
    rng = np.random.default_rng(0)
    some = [" ".join(f"{v:.2f}" for v in row) for row in rng.uniform(1, 30, (500, 180))]
    path = folder / "a.clf"
    with path.open("w") as sink:
        for k in range(20_000):
            t = T0 + k / 5
            sink.write(f"FLASER 180 {some[k % 500]} {k} 2 0.5 {k} 2 0.5 {t:.2f} host {t:.2f}\n")

    def other() -> int:
        with path.open() as stream:
            return len([[float(word) for word in line.split()[2:188]] for line in stream])

    return Log("carmen", "scans", path, {}, {"clock": GPS}, other=other, against="Python, split and float")


def kitti(folder: Path) -> Log:
    rng = np.random.default_rng(0)
    log = folder / "drive"
    data = log / "velodyne_points" / "data"
    data.mkdir(parents=True)
    points = rng.uniform(-40, 40, (120_000, 4)).astype("<f4")
    points[:, 3] = rng.random(120_000)
    stamps = pd.Timestamp("2011-09-26 13:02:25") + pd.to_timedelta(np.arange(20) * 100, unit="ms")
    for k in range(20):
        (points + np.float32([0.01 * k, 0, 0, 0])).tofile(data / f"{k:010d}.bin")
    (data.parent / "timestamps.txt").write_text("\n".join(stamps.strftime("%Y-%m-%d %H:%M:%S.%f000")) + "\n")
    other = lambda: sum(len(np.fromfile(p, "<f4").reshape(-1, 4)) for p in sorted(data.iterdir()))  # noqa: E731
    return Log("kitti", "points", log, other=other, against="numpy.fromfile")


def argoverse(folder: Path) -> Log:
    rng = np.random.default_rng(0)
    n, first = 95_000, 315_966_265_259_836_000
    log = folder / "sensors" / "lidar"
    log.mkdir(parents=True)
    columns = {a: rng.uniform(-80, 80, n).astype(np.float16) for a in "xyz"}
    columns |= {
        "intensity": rng.integers(0, 256, n).astype(np.uint8),
        "laser_number": rng.integers(0, 64, n).astype(np.uint8),
    }
    columns["offset_ns"] = np.sort(rng.integers(0, 10**8, n)).astype(np.int32)
    for k in range(20):
        pyarrow.feather.write_feather(pa.table(columns), str(log / f"{first + k * 10**8}.feather"))
    other = lambda: sum(pyarrow.feather.read_table(str(p)).num_rows for p in sorted(log.iterdir()))  # noqa: E731
    stated = {"clock": Clock(TimeSystem.UNIX_GPS, unit="ns")}
    return Log("argoverse", "returns", log, {}, stated, other=other, against="pyarrow.feather.read_table")


def scans(folder: Path) -> Log:
    """4,000 readings a profile: a smooth surface with noise, as a profiler sees it."""
    n, readings = 8_000, 4_000
    rng = np.random.default_rng(0)
    surface = (20_000 + 2_000 * np.sin(np.arange(readings) / 500)).astype(np.uint16)
    ranges = (surface + rng.integers(-20, 20, (n, readings))).astype(np.uint16)
    bright = rng.integers(80, 160, (n, readings)).astype(np.uint8)
    geometry = {"kind": "cartesian", "readings": readings, "first": -2.0, "step": 0.001, "range_offset_m": 1.5,
                "range_step_m": 0.0001}  # fmt: skip
    table = pa.table({
        "epoch_gps_ns": np.arange(n) * 35_714 + 1_462_000_000_000_000_000,
        "range": pa.FixedSizeListArray.from_arrays(pa.array(ranges.ravel()), readings),
        "intensity": pa.FixedSizeListArray.from_arrays(pa.array(bright.ravel()), readings),
    }).replace_schema_metadata({"roadscan.scan_geometry": json.dumps(geometry)})  # fmt: skip
    path = folder / "a.parquet"
    pq.write_table(table, path, row_group_size=1000, use_dictionary=False)
    other = lambda: pq.read_table(path).num_rows * readings  # noqa: E731
    against = "pyarrow.parquet.read_table"
    return Log("scans", "readings", path, records=n * readings, other=other, against=against, survey='sensor = "head"')


def psi(folder: Path, codec: Any = "raw") -> Log:
    rows, columns = 4_000, 4_000
    rng = np.random.default_rng(0)
    ranges = (20_000 + rng.integers(-20, 20, (rows, columns))).astype(np.uint16)
    header = PsiHeader(
        longitudinal2d=5.0, transverse2d=1.0, longitudinal3d=5.0, transverse3d=1.0, vertical3d=0.0625,
        reference_range=1500.0, speed=72.0, timestamp=1_777_887_000_250,
    )  # fmt: skip
    container = PsiContainer(header, rng.integers(80, 160, (rows, columns)).astype(np.uint8), ranges)
    path = folder / "a.psi"
    write_psi(container, path, codec2d=codec, codec3d=codec)
    options = {
        "length_unit": "mm",
        "values": "range",
        "first_row": "start",
        "first_column": "left",
        "speed_unit": "km/h",
    }
    stated = {"clock": Clock(TimeSystem.UNIX_UTC, unit="ms")}
    what = "raw (mapped), readings" if codec == "raw" else "zipped, readings"
    return Log("psi", what, path, options, stated, rows * columns)


def las(folder: Path, name: str) -> Log:
    n = 2_000_000 if name.endswith("s") else 1_000_000
    rng = np.random.default_rng(0)
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 0.001), np.array([500_000.0, 5_000_000.0, 100.0])
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.add_crs(_crs())
    data = laspy.LasData(header)
    data.points = laspy.ScaleAwarePointRecord.zeros(n, header=header)
    data.X, data.Y, data.Z = (np.cumsum(rng.integers(-50, 50, n)) for _ in range(3))
    data.intensity, data.gps_time = rng.integers(0, 65_536, n), 3e8 + np.arange(n) * 1e-6
    path = folder / name
    data.write(str(path))
    other = lambda: len(laspy.read(path).points)  # noqa: E731
    stated = {"clock": Clock(TimeSystem.GPS_ADJUSTED)}
    return Log("las", name[2:].upper() + ", points", path, {}, stated, other=other, against="laspy.read")


def _crs() -> Any:
    import pyproj

    return pyproj.CRS("EPSG:25832")


def e57(folder: Path) -> Log:
    import pye57

    n = 1_000_000
    rng = np.random.default_rng(0)
    path = folder / "a.e57"
    columns = {f"cartesian{a}": rng.uniform(-50, 50, n) for a in "XYZ"} | {"intensity": rng.random(n)}
    file = pye57.E57(str(path), mode="w")
    file.write_scan_raw(columns, name="scan")
    file.close()

    def other() -> int:
        opened = pye57.E57(str(path))
        read = len(opened.read_scan_raw(0)["cartesianX"])
        opened.close()
        return read

    options = {"epoch": "2026-05-04T12:00:00Z"}
    return Log("e57", "points", path, options, {"crs": "local"}, other=other, against="pye57")


def ply(folder: Path, *, text: bool = False) -> Log:
    import plyfile

    n = 200_000 if text else 2_000_000
    rng = np.random.default_rng(0)
    rows = np.zeros(n, [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("intensity", "u1")])
    for axis in "xyz":
        rows[axis] = np.round(rng.uniform(-50, 50, n), 4)
    rows["intensity"] = rng.integers(0, 256, n)
    path = folder / "a.ply"
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")], text=text).write(str(path))
    other = lambda: len(plyfile.PlyData.read(str(path))["vertex"])  # noqa: E731
    options = {"unit": "metre", "epoch": "2026-05-04T12:00:00Z"}
    what = "text, points" if text else "binary, points"
    return Log("ply", what, path, options, {"crs": "local"}, other=other, against="plyfile")


def opencrg(folder: Path) -> Log:
    rows, columns = 20_000, 401
    z = np.random.default_rng(0).uniform(-0.01, 0.01, (rows, columns))
    path = folder / "a.crg"
    write_crg(CurvedRegularGrid(0.01 * np.arange(columns), z, 0.01, phi_rad=np.full(rows - 1, 0.1)), path, "KRBI")
    other = lambda: np.fromfile(path, ">f4").astype(np.float64).size  # noqa: E731
    options = {"epoch": "2026-05-04T12:00:00Z"}
    return Log("opencrg", "points", path, options, {"crs": "local"}, other=other, against="numpy.fromfile")


def images(folder: Path) -> Log:
    n = 300
    sink = io.BytesIO()
    noise = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    PIL.Image.fromarray(noise).save(sink, format="JPEG", quality=80)
    log = folder / "cam"
    log.mkdir()
    for k in range(n):
        (log / f"img_{k:04d}.jpg").write_bytes(sink.getvalue())
    (log / "stamps.csv").write_text("file,time_s\n" + "".join(f"img_{k:04d}.jpg,{T0 + k}.25\n" for k in range(n)))

    def other() -> int:
        for path in sorted(log.glob("*.jpg")):
            with PIL.Image.open(path) as image, contextlib.suppress(OSError):
                image.load()
        return n

    stated = {"clock": GPS, "sensor": Sensor(kind="camera")}
    return Log("images", "JPEG", log, {"stamps": "stamps.csv"}, stated, other=other, against="Pillow, decoded")
