"""GNSS positions as CSV: names and units as programs write them, times, kinds of solutions, damage."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest

from roadscan.core.errors import ConfigError, FormatError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.ingest.reading.format import format_of
from tests.formats.log_reading import Log, read_ellipsoidal

GPS = Clock(TimeSystem.GPS)
FIRST_GPS_NS = 1_430_384_418 * 10**9  # 2025-05-04T09:00:00 UTC
PLACES = np.array([[7.3 + 1e-4 * i, 50.1 + 2e-4 * i, 160.0 + i] for i in range(5)])
ECEF = np.stack(pyproj.Transformer.from_crs(4979, 4978, always_xy=True).transform(*PLACES.T), axis=1)


def table(folder: Path, names: str, row: str, *, encoding: str = "utf-8", end: str = "\n") -> Path:
    """A file whose rows are `row` with {lon}, {lat}, {h} and {i}."""
    rows = [row.format(i=i, lon=f"{lon:.9f}", lat=f"{lat:.9f}", h=f"{h:.3f}") for i, (lon, lat, h) in enumerate(PLACES)]
    path = folder / "positions.csv"
    path.write_bytes(end.join([names, *rows, ""]).encode(encoding))
    return path


def read(path: Path, options: dict[str, Any] | None = None, **stated: Any) -> Log:
    return read_ellipsoidal("gnss_csv", path, {"quality": "fixed"} | (options or {}), **({"crs": "EPSG:4979"} | stated))


@pytest.mark.parametrize(
    ("names", "row", "how"),
    [
        ("time,latitude_deg,longitude_deg,height_m", "2025-05-04T09:00:0{i}Z,{lat},{lon},{h}", {}),
        ("UTCDate,UTCTime,Latitude(deg),Longitude(deg),H-Ell(m)", "2025-05-04,09:00:0{i}.00,{lat},{lon},{h}", {}),
        ("# remark\n\ntime;lat;lon;Alt [m]", "2025-05-04T09:00:0{i}Z;{lat};{lon};{h}", {"end": "\r\n"}),
        ("Time\tLongitude (°)\tLatitude (°)\tElevation (m)", "2025-05-04T09:00:0{i}Z\t{lon}\t{lat}\t{h}", {}),
        ('"timestamp","LATITUDE","LONGITUDE","ALTITUDE"', '"2025-05-04T09:00:0{i}Z","{lat}","{lon}","{h}"', {}),
        ("time,lat,lon,alt", "2025-05-04T09:00:0{i}Z,{lat},{lon},{h}", {"encoding": "utf-16", "end": "\r"}),
    ],
)
def test_names_as_programs_write_them(tmp_path: Path, names: str, row: str, how: dict[str, Any]) -> None:
    path = table(tmp_path, names, row, **how)
    assert format_of(path).name == "gnss_csv"
    log = read(path)
    np.testing.assert_allclose(log.positions, ECEF, atol=1e-3)
    np.testing.assert_array_equal(log.epochs, FIRST_GPS_NS + np.arange(5) * 10**9)
    assert set(log.column("quality")) == {"fixed"}


def test_decimal_commas_and_a_grid(tmp_path: Path) -> None:
    grid = np.stack(pyproj.Transformer.from_crs(4979, 25832, always_xy=True).transform(*PLACES.T), axis=1)
    rows = [f"{i},5;{e:.4f};{n:.4f};{h:.3f}".replace(".", ",") for i, (e, n, h) in enumerate(grid)]
    path = tmp_path / "grid.csv"
    path.write_text("\n".join(["time_s;easting_m;northing_m;height_m", *rows]))
    log = read(path, crs="EPSG:25832", clock=GPS)
    np.testing.assert_allclose(log.positions, ECEF, atol=2e-3)
    assert log.epochs[1] == 1_500_000_000


def test_quality_satellites_and_sigmas(tmp_path: Path) -> None:
    names = "time_s,latitude_deg,longitude_deg,height_m,quality,satellites,sigma_north (mm),sigma_east_m,sigma_height_m"
    path = table(tmp_path, names, "{i},{lat},{lon},{h},Fix,1{i},12,0.013,0.02")
    text = path.read_text().replace("Fix,11", "FLOAT,11").replace("Fix,12", "wavy,12").replace("Fix,13", "none,13")
    path.write_text(text)
    log = read(path, {"quality": None}, clock=GPS)
    assert log.column("quality").tolist() == ["fixed", "float", "none", "fixed"]
    assert [r.reason for r in log.rejects] == ["the kind of the solution is unknown"]
    assert log.column("satellites").tolist() == [10, 11, 13, 14]
    np.testing.assert_allclose(log.column("sigma_north_m"), 0.012)
    np.testing.assert_allclose(log.column("sigma_down_m"), 0.02)
    assert np.isnan(log.positions[2]).all()


def test_what_is_not_said_is_asked_for(tmp_path: Path) -> None:
    plain = table(tmp_path, "time,lat,lon,alt", "{i},{lat},{lon},{h}")
    with pytest.raises(TimeSystemError, match="time system is not stated"):
        read(plain)
    with pytest.raises(ConfigError, match="what kind of solution"):
        read(plain, {"quality": None}, clock=GPS)
    with pytest.raises(FormatError, match="heights' column") as raised:
        read(plain, crs="EPSG:4258", clock=GPS)
    assert raised.value.asks_for("options.height_unit")
    log = read(plain, {"height_unit": "m"}, crs="EPSG:4326", clock=GPS)
    np.testing.assert_allclose(log.positions, ECEF, atol=1e-3)


def test_other_tables_are_not_taken(tmp_path: Path) -> None:
    for names, other in (
        ("time_s,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg", "trajectory_csv"),
        ("name,latitude,longitude,height", "control_csv"),
    ):
        path = table(tmp_path, names, ",".join(["1", "{lat}", "{lon}", "{h}", "1", "2", "3"][: names.count(",") + 1]))
        assert format_of(path).name == other
