"""Mutated files: a reader may reject records or refuse the file, and does nothing else."""

from __future__ import annotations

import gzip
import random
import struct
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import pyarrow as pa
import pyarrow.feather
import pyarrow.parquet
import pytest
import shapely

from roadscan.model.crs import MapFrame
from roadscan.model.errors import RoadscanError
from roadscan.model.gpstime import Clock, TimeSystem
from roadscan.sensors.base import format_of, log_formats
from tests.sensors.log_reading import read_log

GPS = Clock(TimeSystem.GPS)
UTM32 = MapFrame(crs="EPSG:25832")
MUTANTS = 200


def _lines(names: str, *lines: str) -> bytes:
    return "\n".join([names, *lines, ""]).encode()


def sbet() -> bytes:
    return b"".join(struct.pack("<17d", 1000.0 + i, 0.9, 0.2, 100.0, *[0.1] * 13) for i in range(6))


def trajectory_csv() -> bytes:
    names = "time_s,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg,sigma_north_m"
    return _lines(names, *(f"14000000{i:02d}.5,50.0,10.0,100,1,2,3,0.02" for i in range(6)))


def trajectory_csv_packed() -> bytes:
    return gzip.compress(trajectory_csv())


def pose_matrices() -> bytes:
    names = "time_s,r11,r12,r13,t1,r21,r22,r23,t2,r31,r32,r33,t3"
    return _lines(names, *(f"14000000{i:02d},1,0,0,{i},0,1,0,2,0,0,1,3" for i in range(6)))


def quaternion_table() -> pa.Table:
    zero = np.zeros(6)
    columns = dict.fromkeys(("qx", "qy", "qz", "tx", "ty", "tz"), zero)
    return pa.table({"time_s": 1.4e9 + np.arange(6), "qw": zero + 1, **columns})


def pose_quaternions() -> bytes:
    return b"".join(b"14000000%02d 1 2 3 0 0 0 1\n" % i for i in range(6))


def pose_feather() -> bytes:
    sink = pa.BufferOutputStream()
    pa.feather.write_feather(quaternion_table(), sink, compression="uncompressed")
    return bytes(sink.getvalue())


def pose_parquet() -> bytes:
    sink = pa.BufferOutputStream()
    pa.parquet.write_table(quaternion_table(), sink)
    return bytes(sink.getvalue())


def pospac() -> bytes:
    names = "GPSTime,easting,northing,altitude,vel_east,vel_north,vel_up,roll,pitch,heading,wz,wy,wx"
    return _lines(names, *(f"16281848865{i:02d},571600.5,5539000.5,150,0,0,0,0.1,0.2,0.3,0,0,0" for i in range(6)))


def control_csv() -> bytes:
    return _lines(
        "name,code,role,easting,northing,height_m", *(f'"P{i}",X,gcp,571600.{i},5539000.5,300' for i in range(6))
    )


def control_layer(folder: Path, suffix: str) -> bytes:
    shapes = shapely.points(np.array([[10.0, 50.0, 300.0]] * 3))
    frame = geopandas.GeoDataFrame({"name": list("ABC"), "role": "gcp"}, geometry=shapes, crs="EPSG:4326")
    path = folder / f"seed{suffix}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        frame.to_file(path)
    return path.read_bytes()


WEEK = Clock(TimeSystem.GPS_WEEK, week=2405)
CASES: dict[str, tuple[str, Callable[[], bytes], dict[str, Any], dict[str, Any]]] = {
    "a.sbet": ("sbet", sbet, {}, {"clock": WEEK, "crs": "EPSG:4979"}),
    "a.csv": ("trajectory_csv", trajectory_csv, {}, {"clock": GPS, "crs": "EPSG:4979"}),
    "a.csv.gz": ("trajectory_csv", trajectory_csv_packed, {}, {"clock": GPS, "crs": "EPSG:4979"}),
    "b.csv": ("pose_matrices", pose_matrices, {"axes": "flu"}, {"clock": GPS, "crs": "local"}),
    "c.txt": ("pose_quaternions", pose_quaternions, {"axes": "flu"}, {"clock": GPS, "crs": "local"}),
    "c.feather": ("pose_quaternions", pose_feather, {"axes": "flu"}, {"clock": GPS, "crs": "local"}),
    "c.parquet": ("pose_quaternions", pose_parquet, {"axes": "flu"}, {"clock": GPS, "crs": "local"}),
    "d.csv": ("pospac", pospac, {"axes": "flu"}, {"clock": Clock(TimeSystem.GPS, unit="ms"), "crs": "EPSG:25832"}),
    "e.csv": ("control_csv", control_csv, {}, {"crs": "EPSG:25832", "map": UTM32}),
}


def mutated(data: bytes, rng: random.Random) -> bytes:
    """One to four changes: bytes overwritten, cut out, doubled or put in, or the end cut off."""
    out = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(out) + 1)
        span = rng.choice([1, 1, 2, 8, 40])
        match rng.randrange(6):
            case 0:
                out[at : at + span] = rng.randbytes(span)
            case 1:
                del out[at : at + span]
            case 2:
                out[at:at] = out[at : at + span]
            case 3:
                out[at:at] = rng.choice(
                    [b",", b"\n", b'"', b"\x00", b"nan", b"-", b"e999", b"1e308", b"\xff", b"#", b"\r"]
                )
            case 4:
                out[at : at + 1] = bytes([rng.randrange(256)])
            case 5:
                del out[at:]
    return bytes(out)


def survives(name: str, path: Path, options: dict[str, Any], stated: dict[str, Any]) -> int | None:
    """Rows and rejects of a mutant (what stays must fit the schema), or None where it is refused."""
    for log_format in log_formats().values():
        if log_format.yields in {("trajectory",), ("control_points",)}:
            log_format.sniff(path)
    try:
        log = read_log(name, path, options, **stated)
    except RoadscanError as error:
        assert str(error)
        return None
    return log.table.num_rows + sum(r.records for r in log.rejects)


@pytest.mark.parametrize("file", CASES)
def test_mutants(tmp_path: Path, file: str) -> None:
    name, make, options, stated = CASES[file]
    data = make()
    path = tmp_path / file
    path.write_bytes(data)
    assert format_of(path).name == name  # and of no other format
    assert survives(name, path, options, stated) == 6
    rng = random.Random(f"roadscan {file}")
    outcomes = []
    for _ in range(MUTANTS):
        path.write_bytes(mutated(data, rng))
        outcomes.append(survives(name, path, options, stated))
    assert any(o is not None for o in outcomes), "every mutant was refused as a whole"


@pytest.mark.parametrize("suffix", [".geojson", ".gpkg"])
def test_mutated_layers(tmp_path: Path, suffix: str) -> None:
    data = control_layer(tmp_path, suffix)
    rng = random.Random(f"roadscan {suffix}")
    stated: dict[str, Any] = {"crs": "EPSG:4979", "map": MapFrame(crs="EPSG:32632")}
    outcomes = []
    for i in range(MUTANTS // 2):
        path = tmp_path / f"{i}{suffix}"  # GDAL remembers files by name
        path.write_bytes(mutated(data, rng))
        outcomes.append(survives("control_vector", path, {}, stated))
        path.unlink()
    assert any(o is not None for o in outcomes)
