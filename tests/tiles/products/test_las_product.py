"""LAS and LAZ: what went in comes out of laspy, and of the bytes themselves."""

from __future__ import annotations

import datetime as dt
import gzip
import json
import shutil
import struct
import subprocess
from dataclasses import replace
from fractions import Fraction

import laspy
import numpy as np
import pandas as pd
import pyproj
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from roadscan.core.crs import MapFrame
from roadscan.core.errors import ConfigError, StoreError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.core.grid import TileGrid, TileId
from roadscan.georeference.cloud import TilePoints
from roadscan.tiles.product import Tile, product_named
from roadscan.tiles.products.las import Las, LasOptions, adjusted_gps_s, thin_out

GPS_EPOCH = dt.datetime(1980, 1, 6, tzinfo=dt.UTC)


@pytest.fixture
def las() -> Las:
    return Las()


def write(las, workshop, place, path, options=None, **settings):
    context = workshop.context(place.map)
    tile = workshop.tile(place.tile, context.grid, **settings)
    las.write(tile, options or LasOptions(), context, path)
    return tile.points


def facts_of(file):
    return json.loads(next(v for v in file.header.vlrs if v.user_id == "roadscan").record_data)


@pytest.mark.parametrize("compress", [True, False])
def test_laspy_reads_what_was_written(las, workshop, place, tmp_path, compress):
    path = tmp_path / "tile.tmp"
    points = write(las, workshop, place, path, LasOptions(compress=compress))
    file = laspy.read(path)

    assert len(file) == len(points)
    easting_m = (place.tile.column * 10 * 10**5 + points.x_quanta.astype(np.int64)) / 1e5
    northing_m = (place.tile.row * 10 * 10**5 + points.y_quanta.astype(np.int64)) / 1e5
    errors = [
        np.abs(np.asarray(file.x) * place.unit_m - easting_m).max(),
        np.abs(np.asarray(file.y) * place.unit_m - northing_m).max(),
        np.abs(np.asarray(file.z) * place.height_unit_m - points.height_quanta / 1e5).max(),
    ]
    assert max(errors) <= 0.5e-4 + 2e-9
    assert list(facts_of(file)["rounding_error_max_m"].values()) == pytest.approx(errors, abs=2e-9)

    assert np.array_equal(file.intensity, points.intensity)
    assert np.array_equal(file.classification, points.classification)
    assert np.array_equal(file.point_source_id, points.pass_id)
    assert np.all(np.asarray(file.return_number) == 1) and np.all(np.asarray(file.number_of_returns) == 1)
    assert np.array_equal(file.header.mins, [file.x.min(), file.y.min(), file.z.min()])
    assert list(tmp_path.iterdir()) == [path]
    las.check(path)


def test_time_is_adjusted_standard_gps_time(las, workshop, places, tmp_path):
    points = write(las, workshop, places["utm_north"], tmp_path / "tile")
    file = laspy.read(tmp_path / "tile")
    moment = GPS_EPOCH + dt.timedelta(seconds=1e9 + float(file.gps_time[0]))
    expected = GPS_EPOCH + dt.timedelta(microseconds=int(points.epoch_gps_ns[0]) // 1000)
    assert abs(moment - expected) <= dt.timedelta(microseconds=1)
    off_ns = [
        abs(Fraction(float(t)) * 10**9 - (int(e) - 10**18))
        for t, e in zip(file.gps_time, points.epoch_gps_ns, strict=True)
    ]
    assert facts_of(file)["gps_time_step_ns"] == 59.605  # 2**-24 s, the step of doubles from 2**28 to 2**29
    assert 25 < max(off_ns) <= 59.605 / 2


@given(st.integers(0, 2**61))
@example(999_999_999_760_996_700)  # the last second before the moment that it is counted from
def test_adjusted_time_is_the_nearest_double(epoch_gps_ns):
    stored = adjusted_gps_s(np.array([epoch_gps_ns]))[0]
    exact = Fraction(epoch_gps_ns - 10**18, 10**9)
    assert abs(Fraction(stored) - exact) <= abs(Fraction(float(exact)) - exact) * Fraction(1001, 1000)


def test_crs_is_the_maps(las, workshop, place, tmp_path):
    write(las, workshop, place, tmp_path / "tile")
    header = laspy.read(tmp_path / "tile").header
    crs = header.parse_crs()
    text = header.vlrs.get("WktCoordinateSystemVlr")[0].string
    if place.map.crs is None:
        assert text.startswith('LOCAL_CS["yard"')
        assert crs.is_engineering
    else:
        horizontal = crs.sub_crs_list[0] if crs.is_compound else crs.to_2d()
        if not crs.is_compound:  # ellipsoidal heights: a third axis, in the horizontal unit
            assert crs.axis_info[2].unit_conversion_factor == pytest.approx(place.unit_m, abs=1e-12)
        assert horizontal.to_epsg() == int(place.map.crs.split(":")[1])
        assert text.startswith(("PROJCS[", "COMPD_CS["))
    assert crs.is_compound == (place.map.vertical_crs is not None)
    if crs.is_compound:
        assert crs.sub_crs_list[1].to_epsg() == 6360


def test_header_bytes_after_the_standard(las, workshop, places, tmp_path):
    """Offsets of the public header block: ASPRS LAS 1.4 R15, table 3."""
    path = tmp_path / "tile"
    points = write(las, workshop, places["utm_south"], path, LasOptions(compress=False))
    raw = path.read_bytes()
    assert raw[:4] == b"LASF"
    assert struct.unpack_from("<H", raw, 6) == (0b10001,)  # standard GPS time, WKT
    assert raw[8:24] == bytes(16)  # project GUID
    assert raw[24:26] == bytes([1, 4])
    assert raw[58:90].rstrip(b"\0") == b"roadscan 0.1"
    assert struct.unpack_from("<HH", raw, 90) == (114, 2026)  # 24 April
    assert raw[104] == 6
    assert struct.unpack_from("<H", raw, 105) == (30,)
    assert raw[107:131] == bytes(24)  # legacy counts
    assert struct.unpack_from("<Q", raw, 247) == (len(points),)
    assert struct.unpack_from("<15Q", raw, 255) == (len(points), *[0] * 14)
    offset_to_points = struct.unpack_from("<I", raw, 96)[0]
    assert len(raw) == offset_to_points + 30 * len(points)


def test_coordinates_of_neighbours_share_one_lattice(las, workshop, places, tmp_path):
    place = places["us_feet"]
    headers = []
    for shift in (0, 1):
        moved = replace(place, tile=TileId(place.tile.column + shift, place.tile.row))
        write(las, workshop, moved, tmp_path / "tile")
        headers.append(laspy.read(tmp_path / "tile").header)
    assert np.array_equal(headers[0].scales, [0.0002, 0.0002, 0.0002])  # next finer step below 0.1 mm in feet
    assert np.array_equal(headers[0].scales, headers[1].scales)
    steps = (headers[1].offsets - headers[0].offsets) / headers[0].scales
    assert np.allclose(steps, np.rint(steps), atol=1e-6)
    assert headers[1].offsets[0] != headers[0].offsets[0]


def recorded_extras(count):
    rng = np.random.default_rng(3)
    returns = rng.integers(1, 6, count).astype(np.uint8)
    return {
        "return_number": np.minimum(returns, rng.integers(1, 6, count)).astype(np.uint8),
        "number_of_returns": returns,
        "scan_angle_deg": (rng.integers(-15_000, 15_000, count) * 0.006).astype(np.float32),
        "flags": rng.integers(0, 64, count).astype(np.uint8),
        "user_data": rng.integers(0, 256, count).astype(np.uint8),
        "point_source_id": rng.integers(0, 65_536, count).astype(np.uint16),
    }


@pytest.mark.parametrize("coloured", [False, True])
def test_recorded_extras_come_back(las, workshop, places, tmp_path, coloured):
    place = places["utm_north"]
    context = workshop.context(place.map)
    tile = workshop.tile(place.tile, context.grid)
    extra = recorded_extras(len(tile.points))
    if coloured:
        colours = np.random.default_rng(4).integers(0, 65_536, (3, len(tile.points))).astype(np.uint16)
        extra |= dict(zip(("red", "green", "blue"), colours, strict=True))
    path = tmp_path / "tile"
    las.write(replace(tile, points=replace(tile.points, extra=extra)), LasOptions(), context, path)
    las.check(path)

    file = laspy.read(path)
    assert file.header.point_format.id == (7 if coloured else 6)
    for name in ("return_number", "number_of_returns", "user_data", *(["red", "green", "blue"] if coloured else [])):
        assert np.array_equal(file[name], extra[name]), name
    assert np.abs(np.asarray(file.scan_angle) * 0.006 - extra["scan_angle_deg"]).max() < 1e-5
    flags = (
        np.asarray(file.scan_direction_flag) * 1
        + np.asarray(file.edge_of_flight_line) * 2
        + np.asarray(file.synthetic) * 4
        + np.asarray(file.key_point) * 8
        + np.asarray(file.withheld) * 16
        + np.asarray(file.overlap) * 32
    )
    assert np.array_equal(flags, extra["flags"])
    assert np.array_equal(file["recorded_source_id"], extra["point_source_id"])
    assert np.array_equal(file.point_source_id, tile.points.pass_id)


def test_a_vendors_recorded_cloud_loses_nothing(las, workshop, recordings, tmp_path):
    with gzip.open(recordings / "formats" / "strips.las.gz") as stream:
        source = laspy.read(stream)
    unit_m = 0.3048  # the file's own unit does not matter here: its numbers are taken as international feet
    x, y, z = (np.asarray(v) * unit_m for v in (source.x, source.y, source.z))
    grid = TileGrid(size_m=10_000.0, cell_m=5.0)
    tile = grid.tile_at(float(x.min()), float(y.min()))
    assert tile == grid.tile_at(float(x.max()), float(y.max()))
    west, south = tile.column * grid.size_m, tile.row * grid.size_m
    points = TilePoints(
        tile=tile,
        x_quanta=np.rint((x - west) * 1e5).astype(np.int32),
        y_quanta=np.rint((y - south) * 1e5).astype(np.int32),
        height_quanta=np.rint(z * 1e5).astype(np.int32),
        epoch_gps_ns=Clock(TimeSystem.GPS_ADJUSTED).to_epoch_gps_ns(np.asarray(source.gps_time)),
        intensity=np.asarray(source.intensity),
        classification=np.asarray(source.classification).astype(np.uint8),
        pass_id=np.ones(len(source), dtype=np.uint16),
        extra={
            "return_number": np.asarray(source.return_number),
            "number_of_returns": np.asarray(source.number_of_returns),
            "scan_angle_deg": np.asarray(source.scan_angle_rank).astype(np.float32),
            "user_data": np.asarray(source.user_data),
            "point_source_id": np.asarray(source.point_source_id),
        },
    )
    context = replace(workshop.context(MapFrame(None, local_name="strips")), grid=grid)
    path = tmp_path / "strips"
    las.write(Tile(points, workshop.cells(points, grid)), LasOptions(scale_m=1e-5), context, path)
    file = laspy.read(path)
    assert len(file) == 14_408
    for name in ("intensity", "return_number", "number_of_returns", "user_data", "classification", "gps_time"):
        assert np.array_equal(file[name], source[name]), name
    assert np.array_equal(file["recorded_source_id"], source.point_source_id)
    assert np.array_equal(np.rint(np.asarray(file.scan_angle) * 0.006), source.scan_angle_rank)
    for name, given_m in zip("xyz", (x, y, z), strict=True):
        assert np.abs(np.asarray(file[name]) - given_m).max() <= 0.5e-5 + 2e-9


@pytest.mark.parametrize("compress", [True, False])
def test_same_points_give_same_bytes(las, workshop, place, tmp_path, compress):
    options = LasOptions(compress=compress)
    for name in ("first.partial", "second"):
        write(las, workshop, place, tmp_path / name, options)
    assert (tmp_path / "first.partial").read_bytes() == (tmp_path / "second").read_bytes()


def thinned_by_pandas(points, spacing_m):
    edge = round(spacing_m * 1e5)
    frame = pd.DataFrame({"column": points.x_quanta // edge, "row": points.y_quanta // edge})
    frame["height"] = points.height_quanta
    kept = []
    for _, group in frame.groupby(["row", "column"]):
        ordered = sorted(group["height"])
        kept.append(group.index[group["height"] == ordered[(len(ordered) - 1) // 2]].min())
    return sorted(kept)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.5, 1.0, 2.5, 10.0]), st.integers(1, 300))
def test_thinning_keeps_the_lower_median_of_each_square(seed, spacing_m, count):
    rng = np.random.default_rng(seed)
    points = TilePoints(
        tile=TileId(-1, 0),
        x_quanta=rng.integers(0, 1_000_000, count).astype(np.int32),
        y_quanta=rng.integers(0, 1_000_000, count).astype(np.int32),
        height_quanta=rng.integers(-4, 4, count).astype(np.int32),  # many ties
        epoch_gps_ns=np.arange(count),
        intensity=np.arange(count).astype(np.uint16),
        classification=np.ones(count, dtype=np.uint8),
        pass_id=np.ones(count, dtype=np.uint16),
        extra={"user_data": np.arange(count).astype(np.uint8)},
    )
    thin = thin_out(points, spacing_m, TileGrid(10.0, 0.5))
    kept = thinned_by_pandas(points, spacing_m)
    assert thin.epoch_gps_ns.tolist() == kept
    for name in ("x_quanta", "y_quanta", "height_quanta", "intensity", "classification", "pass_id"):
        assert np.array_equal(getattr(thin, name), getattr(points, name)[kept])
    assert np.array_equal(thin.extra["user_data"], points.extra["user_data"][kept])


def test_thinning_reports_neither_a_crack_nor_loose_stones(workshop, places):
    grid = TileGrid(10.0, 0.05)
    points = workshop.points(places["utm_north"].tile, count=60_000, surface=lambda x, y: 0 * x, noise_m=0.0005)
    crack = np.mod(points.x_quanta, 10_000) < 3_000  # 30 mm wide, 40 mm deep, in every 100 mm square
    stones = ~crack & (np.random.default_rng(0).random(len(points)) < 0.1)
    height = points.height_quanta - 4_000 * crack + 1_500 * stones
    thin = thin_out(replace(points, height_quanta=height.astype(np.int32)), 0.5, grid)
    assert len(thin) == 400
    assert np.abs(thin.height_quanta).max() < 200  # 2 mm


def test_spacing_must_divide_the_tile(las, workshop, places, tmp_path):
    context = workshop.context(places["local"].map)
    with pytest.raises(ConfigError, match=r"las.spacing_m = 0.3.*divides the tile's edge of 10 m"):
        las.check_options(LasOptions(spacing_m=0.3), context)
    las.check_options(LasOptions(spacing_m=0.1), context)
    points = write(las, workshop, places["local"], tmp_path / "tile", LasOptions(spacing_m=1.0))
    file = laspy.read(tmp_path / "tile")
    assert len(file) == 100 and facts_of(file)["points_of_tile"] == len(points)
    assert facts_of(file)["spacing_m"] == 1.0
    las.check(tmp_path / "tile")


@pytest.mark.parametrize("compress", [True, False])
def test_damage_is_found(las, workshop, places, tmp_path, damage, compress):
    good, bad = tmp_path / "good", tmp_path / "bad"
    write(las, workshop, places["utm_north"], good, LasOptions(compress=compress), count=5_000)
    whole, found = laspy.read(good), 0
    for what, content in damage(good.read_bytes()):
        bad.write_bytes(content)
        try:
            las.check(bad)
        except StoreError as error:
            assert str(bad) in str(error)
            found += 1
            continue
        file = laspy.read(bad)  # a bit that carries nothing
        assert np.array_equal(file.points.array, whole.points.array), what
        assert np.array_equal(file.header.offsets, whole.header.offsets), what
    assert found >= 38


def test_a_foreign_las_is_no_product(las, tmp_path):
    laspy.LasData(laspy.LasHeader(version="1.4", point_format=6)).write(tmp_path / "foreign.las")
    with pytest.raises(StoreError, match="no CRS or no record of roadscan"):
        las.check(tmp_path / "foreign.las")
    with pytest.raises(StoreError):
        las.check(tmp_path / "absent.las")


def test_product_is_found_by_name_and_names_its_suffix():
    product = product_named("las")
    assert product.suffix_for(LasOptions()) == ".laz"
    assert product.suffix_for(LasOptions(compress=False)) == ".las"


@pytest.mark.skipif(shutil.which("pdal") is None, reason="pdal is not installed")
def test_pdal_reads_it(las, workshop, places, tmp_path):
    points = write(las, workshop, places["utm_north"], tmp_path / "tile.laz")
    told = subprocess.run(["pdal", "info", "--summary", tmp_path / "tile.laz"], capture_output=True, check=True)
    assert json.loads(told.stdout)["summary"]["num_points"] == len(points)


def test_wkt_is_ogc_wkt_1(las, workshop, places, tmp_path):
    write(las, workshop, places["us_feet_heights_too"], tmp_path / "tile")
    text = laspy.read(tmp_path / "tile").header.vlrs.get("WktCoordinateSystemVlr")[0].string
    assert pyproj.CRS.from_wkt(text).axis_info[0].unit_name == "US survey foot"
    assert 'VERT_CS["NAVD88 height (ftUS)"' in text and "PROJCRS" not in text
