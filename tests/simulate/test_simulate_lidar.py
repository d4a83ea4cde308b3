"""The lidar's capture, decoded by another program."""

from __future__ import annotations

import datetime as dt
import struct
import tomllib
from itertools import islice
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import velodyne_decoder as vd

from roadscan.core.gpstime import gps_ns_from_utc, utc_from_gps_ns
from roadscan.simulate import Scene, simulate, truth
from roadscan.simulate.caster import World
from roadscan.simulate.drive import Drive
from roadscan.simulate.lidar_model import lidar_model
from roadscan.simulate.path import Earth
from roadscan.simulate.run import SimulatedSurvey
from roadscan.simulate.sensors.lidar import measure
from roadscan.simulate.surface import Surface
from tests.simulate.chain import WEEK_NS, Chain

# Starts 0.9 s before the full hour, so that stamps roll over on the way.
SCENE = Scene.load("demo").changed(
    start="2026-05-04T09:59:59.100000Z",
    length_m=13.5,
    passes=[{"lane": 2}],
    profilers={"on": False},
)


@pytest.fixture(scope="module")
def on_grid(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSurvey:
    scene = SCENE.noiseless().changed(lidar={"on_azimuth_grid": True})
    return simulate(scene, tmp_path_factory.mktemp("lidar") / "survey", write_hits=True)


def decode(folder: Path) -> np.ndarray:
    """Every return of the capture: x, y, z, intensity, seconds since 1970 (UTC), ring; in the order fired."""
    config = vd.Config(model=vd.Model.HDL32E, min_range=0.0)
    rows = []
    for stamp, points in vd.read_pcap(str(folder / "raw" / "run-1" / "lidar.pcap"), config):
        rows.append(
            np.column_stack(
                [points[:, :4].astype(float), points[:, 4].astype(float) + (stamp.device - 1.7778e9), points[:, 6]]
            )
        )
    out = np.concatenate(rows)
    return out[np.isfinite(out[:, 0])]


def true_hits(survey: SimulatedSurvey) -> dict[str, np.ndarray]:
    table = pq.read_table(truth.load(survey.folder).hits_file("run-1", "lidar"))
    return {name: table[name].to_numpy() for name in table.column_names}


def in_sensor(hits: dict[str, np.ndarray]) -> np.ndarray:
    """Sensor coordinates of exact ranges and azimuths by the maker's formula: x forward, y left, z up."""
    calibration = {
        int(line): (float(angle), float(rise))
        for line, angle, rise in _laser_rows(vd.Calibration.default_calibs[vd.Model.HDL32E].to_string())
    }
    angle, rise = np.array([calibration[int(laser)] for laser in hits["laser"]]).T
    azimuth = np.radians(hits["azimuth_deg"])
    flat = hits["range_m"] * np.cos(angle)
    up = hits["range_m"] * np.sin(angle) + rise
    return np.stack([flat * np.cos(azimuth), -flat * np.sin(azimuth), up], axis=-1)


def _laser_rows(text: str) -> list[tuple[str, str, str]]:
    values = {"laser_id": [], "vert_correction": [], "vert_offset_correction": []}
    for line in text.splitlines():
        key, _, value = line.strip(" -").partition(": ")
        if key in values:
            values[key].append(value)
    return list(zip(*values.values(), strict=True))


def test_beams_are_the_decoders():
    rows = _laser_rows(vd.Calibration.default_calibs[vd.Model.HDL32E].to_string())
    beams = lidar_model("HDL-32E")
    np.testing.assert_allclose(np.radians(beams.elevation_deg), [float(r[1]) for r in rows], atol=1e-7)
    np.testing.assert_allclose(beams.rise_m, [float(r[2]) for r in rows], atol=1e-8)


@pytest.mark.slow
def test_decoded_returns_are_the_hits(on_grid: SimulatedSurvey):
    decoded, hits = decode(on_grid.folder), true_hits(on_grid)
    assert len(decoded) == hits["range_m"].size == on_grid.returns > 50_000
    # What is left is the rounding of ranges to 2 mm, and of each firing's azimuth to 0.01° by this decoder.
    error = np.linalg.norm(decoded[:, :3] - in_sensor(hits), axis=1)
    assert (error - np.radians(0.0051) * hits["range_m"]).max() < 0.00101
    # Stamps are rounded to 1 µs; 315,964,800 s lie between the epochs of Unix and GPS time, 18 s are leap seconds.
    utc_s = (hits["epoch_gps_ns"] + (315_964_800 - 18 - 1_777_800_000) * 10**9) / 1e9
    assert np.abs(decoded[:, 4] - utc_s).max() < 1e-6


def test_continuous_azimuths_are_rounded_only(tmp_path: Path):
    survey = simulate(SCENE.noiseless().changed(length_m=5.0), tmp_path / "survey", write_hits=True)
    decoded, hits = decode(survey.folder), true_hits(survey)
    assert len(decoded) == hits["range_m"].size > 20_000
    # 0.01 degrees at 12 m, and the range's millimetre.
    assert np.linalg.norm(decoded[:, :3] - in_sensor(hits), axis=1).max() < 0.003


@pytest.mark.slow
def test_hits_lie_on_the_surface(on_grid: SimulatedSurvey):
    hits, known = true_hits(on_grid), truth.load(on_grid.folder)
    height = known.height_m(hits["easting_m"], hits["northing_m"])
    assert np.abs(height - hits["height_m"]).max() < 1e-6
    assert not hits["object_id"].any()
    assert not hits["is_mixed"].any()
    assert hits["range_m"].max() <= SCENE.lidar.range_max_m
    assert hits["range_m"].min() > 0.9
    _, offset = known.station_offset_m(hits["easting_m"], hits["northing_m"])
    assert offset.min() < -5.0
    assert offset.max() > 6.0


@pytest.mark.slow
def test_hits_come_back_through_the_trajectory(on_grid: SimulatedSurvey):
    hits = true_hits(on_grid)
    sensor = tomllib.loads(on_grid.rig_file.read_text())["sensors"]["lidar"]
    chain = Chain(on_grid.folder / "raw" / "run-1" / "trajectory.sbet", "EPSG:32632")
    some = slice(None, None, 7)
    seconds = (hits["epoch_gps_ns"][some] % WEEK_NS) / 1e9
    ground = chain.to_ground(seconds, sensor, in_sensor(hits)[some])
    expected = np.stack([hits[c][some] for c in ("easting_m", "northing_m", "height_m")], axis=-1)
    assert np.abs(ground - expected).max() < 2e-5


def test_no_beam_passes_through_a_wall():
    """Seen at a low angle, the near rim of a pothole hides its near floor."""
    hole = {"station_m": 4.0, "offset_m": 1.75, "radius_m": 0.8, "depth_m": 0.3}
    scene = SCENE.noiseless().changed(
        length_m=10.0, passes=[{"lane": 1}], road={"potholes": [hole], "cracks": [], "ruts": []}
    )
    surface = Surface(scene)
    drive = Drive(scene, 0, Earth(scene.map.crs), Surface(scene, ride=True))
    checked = 0
    for block in measure(scene, World(scene, surface), drive):
        seen = np.isfinite(block.found.range_m)
        points = block.found.enh_m[seen]
        station, offset = surface.station_offset_m(points[:, 0], points[:, 1])
        inside = np.hypot(station - 4.0, offset - 1.75) < 0.75
        if not inside.any():
            continue
        epochs = block.firing_gps_ns().reshape(seen.shape)[seen][inside]
        laser = np.broadcast_to(np.tile(np.arange(32), 12), seen.shape)[seen][inside]
        origins, rotations = drive.poses(epochs).sensor(scene.lidar.mount, np.diag([1.0, -1.0, -1.0]))
        origins += rotations[:, :, 2] * lidar_model("HDL-32E").rise_m[laser, None]
        for origin, hit in zip(drive.earth.map_from_ecef(origins)[::5], points[inside][::5], strict=True):
            way = origin + np.linspace(0.0, 0.999, 400)[:, None] * (hit - origin)
            over = way[:, 2] - surface.height_m(way[:, 0], way[:, 1])
            assert over[np.isfinite(over)].min() > -1e-5  # the map bends by 8 µm over 10 m
            checked += 1
    assert checked > 200


def test_a_wrong_clock_shifts_stamps_and_sentences(tmp_path: Path):
    wrong = {"offset_s": 1.25, "drift_ppm": 200.0}
    scene = SCENE.noiseless().changed(lidar={"on_azimuth_grid": True, "clock": wrong})
    survey = simulate(scene, tmp_path / "survey", write_hits=True)
    decoded, hits = decode(survey.folder), true_hits(survey)
    start = gps_ns_from_utc(scene.start)
    utc_s = (hits["epoch_gps_ns"] + (315_964_800 - 18 - 1_777_800_000) * 10**9) / 1e9
    shift = 1.25 + 200e-6 * (hits["epoch_gps_ns"] - start) / 1e9
    # The capture's own time is right, and it tells the hour: the decoder adds the stamp to it.
    assert np.abs(decoded[:, 4] - utc_s - shift).max() < 2e-6
    raw = (survey.folder / "raw" / "run-1" / "lidar.pcap").read_bytes()
    sentences = [part[:13] for part in raw.split(b"$GPRMC,")[1:]]
    # The pass starts at 09:59:58.8, and the clock shows a second and a quarter more.
    assert sentences == [b"100000.00,A,4", b"100001.00,A,4"]


@pytest.mark.slow
def test_packets_cross_objects_and_edges(tmp_path: Path):
    """Hits tell the object; what is not mixed lies where the beam's middle met it."""
    side = {"boxes": [{"station_m": 6.0, "offset_m": -1.0, "length_m": 1.0, "width_m": 1.0, "height_m": 1.0}]}
    quiet = SCENE.noiseless().changed(length_m=5.0, roadside=side)
    thin = true_hits(simulate(quiet, tmp_path / "thin", write_hits=True))
    wide = true_hits(simulate(quiet.changed(lidar={"divergence_deg": 0.2}), tmp_path / "wide", write_hits=True))
    assert set(thin["object_id"]) == {0, 1}
    assert not thin["is_mixed"].any()
    assert 0.0 < wide["is_mixed"].mean() < 0.02
    true_ranges = dict(zip(zip(thin["epoch_gps_ns"], thin["laser"], strict=True), thin["range_m"], strict=True))
    plain = ~wide["is_mixed"]
    firings = zip(wide["epoch_gps_ns"][plain], wide["laser"][plain], strict=True)
    np.testing.assert_array_equal(wide["range_m"][plain], [true_ranges[firing] for firing in firings])
    table = pq.read_table(truth.load(tmp_path / "thin").objects_file).to_pydict()
    assert (table["object_id"], table["kind"], table["station_m"]) == ([1], ["box"], [6.0])
    on_box = thin["object_id"] == 1
    assert on_box.sum() > 300
    assert thin["height_m"][on_box].max() <= table["height_m"][0] + 1.0 + 1e-6


@pytest.mark.slow
def test_wide_beams_mix_beside_edges_only():
    """A mixed firing has another object, or nothing, beside it; and what is not mixed is what thin beams meet."""
    side = {
        "boxes": [{"station_m": 3.0, "offset_m": -1.0, "length_m": 1.0, "width_m": 1.0, "height_m": 1.0}],
        "facades": [{"offset_m": 7.0, "start_m": -10.0, "end_m": 20.0}],
    }
    quiet = SCENE.noiseless().changed(length_m=3.0, roadside=side)
    surface = Surface(quiet)
    world = World(quiet, surface)
    drive = Drive(quiet, 0, Earth(quiet.map.crs), Surface(quiet, ride=True))

    def found(divergence_deg: float) -> tuple[np.ndarray, ...]:
        scene = quiet.changed(lidar={"divergence_deg": divergence_deg})
        hits = [block.found for block in islice(measure(scene, world, drive), 6)]
        ranges, ids, is_mixed = (
            np.concatenate([getattr(h, n) for h in hits]) for n in ("range_m", "object_id", "is_mixed")
        )
        return ranges, np.where(np.isnan(ranges), -1, ids), is_mixed

    thin, wide = found(0.0), found(0.15)
    assert not thin[2].any()
    is_mixed = wide[2]
    for before, now in zip(thin[:2], wide[:2], strict=True):
        np.testing.assert_array_equal(now[~is_mixed], before[~is_mixed])
    assert 0.001 < is_mixed[np.isfinite(wide[0])].mean() < 0.03
    order = np.argsort(lidar_model("HDL-32E").elevation_deg)
    grid = thin[1].reshape(-1, 32)[:, order]
    padded = np.pad(grid, 1, constant_values=-2)
    around = [padded[2:, 1:-1], padded[:-2, 1:-1], padded[1:-1, 2:], padded[1:-1, :-2]]
    at_edge = np.any([grid != one for one in around], axis=0)
    assert at_edge[is_mixed.reshape(-1, 32)[:, order]].all()


@pytest.mark.slow
def test_packets_by_hand(on_grid: SimulatedSurvey):
    raw = (on_grid.folder / "raw" / "run-1" / "lidar.pcap").read_bytes()
    assert struct.unpack_from("<IHHiIII", raw) == (0xA1B2C3D4, 2, 4, 0, 0, 262_144, 1)
    at, data, positions, clock = 24, [], [], []
    while at < len(raw):
        seconds, micros, stored, sent = struct.unpack_from("<IIII", raw, at)
        frame = raw[at + 16 : at + 16 + stored]
        at += 16 + stored
        assert stored == sent == len(frame)
        assert frame[12:14] == b"\x08\x00"
        ip = struct.unpack(">10H", frame[14:34])
        assert sum(ip) % 0xFFFF == 0  # checksum of RFC 791
        assert ip[1] == stored - 14
        port, length = struct.unpack(">HH", frame[36:40])
        assert length == stored - 34
        clock.append(seconds + micros * 1e-6)
        (data if port == 2368 else positions).append(frame[42:])
        assert (port, len(frame) - 42) in ((2368, 1206), (8308, 512))
    assert np.all(np.diff(clock) >= 0)
    stamps = np.array([struct.unpack_from("<I", p, 1200)[0] for p in data])
    first = gps_ns_from_utc(dt.datetime(2026, 5, 4, 9, 59, 59, 100_000, tzinfo=dt.UTC)) - 300_000_000
    of_hour = utc_from_gps_ns(first)
    assert stamps[0] == (of_hour.minute * 60 + of_hour.second) * 1_000_000 + of_hour.microsecond
    steps = np.diff(stamps)
    assert sorted(set(steps)) == [552 - 3_600_000_000, 552, 553] or sorted(set(steps)) == [
        553 - 3_600_000_000,
        552,
        553,
    ]
    assert {p[1204:] for p in data} == {b"\x37\x21"}
    flags = {struct.unpack_from("<H", p, 100 * b)[0] for p in data for b in range(12)}
    assert flags == {0xEEFF}

    seen = [vd.TelemetryPacket(list(p)) for p in positions]
    assert len(seen) == 3
    assert [t.nmea_time for t in seen][1:] == [dt.datetime(2026, 5, 4, 9, 59, 59), dt.datetime(2026, 5, 4, 10, 0, 0)]
    lon, lat, _ = seen[0].gps_position
    assert (lon, lat) == pytest.approx((11.57, 48.14), abs=0.02)
    assert seen[2].usec_since_toh == 120_000


def test_turn_rate(tmp_path: Path):
    survey = simulate(SCENE.noiseless().changed(lidar={"turns_per_s": 20.0}), tmp_path / "survey", write_hits=True)
    hits = true_hits(survey)
    seconds = (hits["epoch_gps_ns"] - hits["epoch_gps_ns"][0]) / 1e9
    turned = np.unwrap(hits["azimuth_deg"], period=360.0)
    # Unwrapping misses turns where the road is out of sight for half a turn; the rate within one does not.
    rate = np.median(np.diff(turned)[np.diff(seconds) > 0] / np.diff(seconds)[np.diff(seconds) > 0])
    assert rate == pytest.approx(20.0 * 360.0, rel=1e-3)
