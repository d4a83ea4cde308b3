"""Ground control with its places in pictures: OpenDroneMap's and OpenSfM's files, against pyproj."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyproj
import pytest

from roadscan.core.crs import MapFrame
from roadscan.core.errors import ConfigError, CrsError, FormatError
from roadscan.ingest.reading.format import format_of
from tests.formats.log_reading import Log, read_log

# The form that OpenDroneMap's documentation shows (Ground Control Points)
ODM = """WGS84 UTM 32N
544256.7 5320919.9 5.1 3044.3 2622.1 IMG_0525.jpg gcp_7
544256.7 5320919.9 5.1 4193.4 1552.1 IMG_0585.jpg gcp_7
544157.7 5320899.2 5.25 2815.2 557.3 IMG_0524.jpg
544157.7 5320899.2 5.25 815.2 657.3 IMG_0525.jpg
"""
UTM32: dict[str, Any] = {"map": MapFrame(crs="EPSG:32632"), "height": "ellipsoidal"}


def places(log: Log) -> dict[str, tuple[float, float, float]]:
    return {row["name"]: (row["easting_m"], row["northing_m"], row["height_m"]) for row in log.table.to_pylist()}


def opensfm(count: int = 12) -> bytes:
    seen = [{"projection": [0.01, -0.02], "shot_id": "02.jpg"}]
    points: list[dict[str, Any]] = [
        {
            "id": str(k),
            "observations": seen,
            "position": {"latitude": 52.5, "longitude": 13.4 + 1e-4 * k, "altitude": k},
        }
        for k in range(count)
    ]
    return json.dumps({"points": points}, indent=1).encode()


def test_gcp_list(tmp_path: Path) -> None:
    path = tmp_path / "gcp_list.txt"
    path.write_text(ODM + "544157.7 5320899.2 high 1 2 IMG.jpg\n544257.7 5320919.9 5.1 1 2 IMG_0586.jpg gcp_7\n")
    assert format_of(path).name == "odm_gcp"
    log = read_log("odm_gcp", path, {"role": "gcp"}, **UTM32)
    assert places(log)["gcp_7"] == pytest.approx((544256.7, 5320919.9, 5.1), abs=1e-6)
    assert places(log)["gcp_2"] == pytest.approx((544157.7, 5320899.2, 5.25), abs=1e-6)
    assert len(places(log)) == 2
    assert [r.record for r in log.rejects] == [4, 5]
    with pytest.raises(CrsError, match="EPSG:32632"):
        read_log("odm_gcp", path, {"role": "gcp"}, **UTM32, crs="EPSG:25833")
    with pytest.raises(ConfigError, match="role"):
        read_log("odm_gcp", path, **UTM32)
    path.write_text("EPSG:4326\n9.6 48.0384 5.1 3044.3 2622.1 IMG_0525.jpg\n")
    log = read_log("odm_gcp", path, {"role": "check"}, **UTM32)
    place = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True).transform(9.6, 48.0384)
    assert places(log)["gcp_1"] == pytest.approx((*place, 5.1), abs=1e-4)


def test_heights_of_a_gcp_list_in_feet(tmp_path: Path) -> None:
    """EPSG:2263 counts in US survey feet (1200/3937 m); nothing in the file says the unit of z."""
    path = tmp_path / "gcp_list.txt"
    path.write_text("EPSG:2263\n987654.32 201234.56 33.5 100 200 a.jpg P1\n")
    stated: dict[str, Any] = {"map": MapFrame(crs="EPSG:26918"), "height": "ellipsoidal"}
    with pytest.raises(ConfigError, match="unit of heights") as error:
        read_log("odm_gcp", path, {"role": "gcp"}, **stated)
    assert next(iter(error.value.asks_for("options.height_unit"))).choices == ("m", "ft", "ft_us")
    for unit, height_m in (("m", 33.5), ("ft", 33.5 * 0.3048), ("ft_us", 33.5 * 1200 / 3937)):
        log = read_log("odm_gcp", path, {"role": "gcp", "height_unit": unit}, **stated)
        assert places(log)["P1"][2] == pytest.approx(height_m, abs=1e-4)


def test_a_height_of_nan_costs_its_point(tmp_path: Path) -> None:
    path = tmp_path / "gcp_list.txt"
    path.write_text("WGS84 UTM 32N\n691000.1 5319000.2 NaN 100 200 a.jpg P1\n691010.1 5319000.2 500.0 1 2 a.jpg P2\n")
    assert format_of(path).name == "odm_gcp"
    log = read_log("odm_gcp", path, {"role": "gcp"}, **UTM32)
    assert list(places(log)) == ["P2"]
    assert [(r.record, r.reason) for r in log.rejects] == [(0, "the height of the point is not stated (NaN)")]


def test_the_control_of_berlin(recordings: Path) -> None:
    path = recordings / "pictures" / "berlin" / "ground_control_points.json"
    assert format_of(path).name == "opensfm_gcp"
    stated: dict[str, Any] = {"map": MapFrame(crs="EPSG:32633"), "height": "ellipsoidal"}
    log = read_log("opensfm_gcp", path, {"role": "gcp"}, **stated)
    place = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32633", always_xy=True).transform(
        13.400703631118825, 52.51926834404209
    )
    assert places(log)["0"] == pytest.approx((*place, 14.946108041331172), abs=1e-4)
    assert set(places(log)) == {"0", "3"}
    assert [(r.record, r.reason) for r in log.rejects] == [(1, "the point has no position")]
    with pytest.raises(ConfigError, match="height"):
        read_log("opensfm_gcp", path, {"role": "gcp"}, map=MapFrame(crs="EPSG:32633"))


def test_what_is_no_control_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    for content, says in (("{", "JSON"), ("[]", "no list of points"), ('{"points": 3}', "no list of points")):
        path.write_text(content)
        with pytest.raises(FormatError, match=says):
            read_log("opensfm_gcp", path, {"role": "gcp"}, **UTM32)
