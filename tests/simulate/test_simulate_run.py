"""Same scene, same bytes, in bounded memory, and never over somebody's files."""

from __future__ import annotations

import hashlib
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from roadscan.core.errors import ConfigError, FormatError
from roadscan.simulate import Scene, simulate, trajectory, truth
from roadscan.simulate.drive import Drive
from roadscan.simulate.path import Earth
from roadscan.simulate.sensors import profiler
from roadscan.simulate.surface import Surface

TINY = Scene.load("demo").changed(
    length_m=20.0,
    passes=[{"lane": 2}],
    profilers={"spacing_m": 0.05, "readings": 200},
    lidar={"on": False},
)


def hashes(folder: Path) -> dict[str, str]:
    files = (f for f in sorted(folder.rglob("*")) if f.is_file())
    return {str(f.relative_to(folder)): hashlib.sha256(f.read_bytes()).hexdigest() for f in files}


@pytest.mark.slow
def test_same_seed_same_bytes(tmp_path: Path):
    scene = TINY.changed(length_m=4.0, lidar={"on": True}, passes=[{"lane": 2}, {"lane": 1, "direction": "backward"}])
    simulate(scene, tmp_path / "a", write_hits=True)
    simulate(scene, tmp_path / "b", write_hits=True)
    first = hashes(tmp_path / "a")
    assert len(first) == 8 + 2 * (5 + 1 + 3)
    assert first == hashes(tmp_path / "b")
    # Again into the same folder: the same files.
    simulate(scene, tmp_path / "a", write_hits=True)
    assert hashes(tmp_path / "a") == first


def test_another_seed_makes_other_bytes(tmp_path: Path):
    simulate(TINY, tmp_path / "a")
    simulate(TINY.changed(seed=2), tmp_path / "b")
    a, b = hashes(tmp_path / "a"), hashes(tmp_path / "b")
    for name in ("raw/run-1/trajectory.sbet", "raw/run-1/profiler_left.parquet", "control.csv"):
        assert a[name] != b[name]


def test_chunks_change_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    simulate(TINY, tmp_path / "a")
    monkeypatch.setattr(trajectory, "CHUNK_POSES", 100)
    simulate(TINY, tmp_path / "b")
    for name in ("trajectory.sbet", "profiler_left.parquet"):
        a, b = ((tmp_path / folder / "raw" / "run-1" / name).read_bytes() for folder in "ab")
        assert a == b
    whole = _ranges(TINY)
    monkeypatch.setattr(profiler, "BLOCK_PROFILES", 37)
    assert _ranges(TINY) == whole


def _ranges(scene: Scene) -> bytes:
    surface = Surface(scene)
    drive = Drive(scene, 0, Earth(scene.map.crs), Surface(scene, ride=True))
    head = profiler.heads(scene.profilers)[1]
    return b"".join(block.ranges.tobytes() for block in profiler.measure(scene, surface, drive, head))


STREET = Scene().changed(
    length_m=25.0,
    map={"crs": "local", "azimuth_deg": 33.0},
    road={"cross_slope": 0.0, "grade": 0.0, "verge_slope": 0.0, "brightness": {"asphalt": 70.6}},
    vehicle={"heave_m": 0.0, "sway_deg": 0.0, "speed_m_per_s": 10.0},
    profilers={"spacing_m": 0.05, "readings": 120, "left": {"lever_arm_body_m": [-2.35, -0.98, -1.08]}},
)
CAR = {"station_m": 20.0, "offset_m": -0.6, "speed_m_per_s": -10.0, "height_m": 0.8}


def _left_profiles(scene: Scene) -> list[np.ndarray]:
    """Epochs since the start (s), station and offset of each hit, its object, intensity and range of the left head."""
    surface = Surface(scene)
    drive = Drive(scene, 0, Earth(scene.map.crs), Surface(scene, ride=True))
    head = profiler.heads(scene.profilers)[0]
    blocks = list(profiler.measure(scene, surface, drive, head, with_hits=True))
    time_s = (np.concatenate([b.epoch_gps_ns for b in blocks]) - drive.start_gps_ns) * 1e-9
    hits = np.concatenate([b.hits for b in blocks])
    lost = np.isnan(hits[:, :, 0])
    station, offset = surface.station_offset_m(
        *np.where(lost, surface.origin_enh_m[:2, None, None], hits.T[:2].swapaxes(1, 2))
    )
    station, offset = (np.where(lost, np.nan, one) for one in (station, offset))
    rest = (np.concatenate([getattr(b, name) for b in blocks]) for name in ("object_id", "intensity", "ranges"))
    return [np.broadcast_to(time_s[:, None], station.shape), station, offset, *rest]


def test_moving_cars_block_profiler_beams(monkeypatch: pytest.MonkeyPatch):
    """The beams are upright: what is under each is the car (4.4 m by 1.8 m) as it stands at the profile's epoch."""
    found = _left_profiles(STREET.changed(roadside={"moving_cars": [CAR]}))
    time_s, station, offset, object_id, intensity, _ = found
    away = np.maximum(np.abs(station - (20.0 - 10.0 * time_s)) - 2.2, np.abs(offset + 0.6) - 0.91)
    assert (object_id == 1).sum() > 1000
    assert away[object_id == 1].max() < 1e-6  # wheels stand out by a centimetre
    side = np.maximum(np.abs(station - (20.0 - 10.0 * time_s)) - 2.2, np.abs(offset + 0.6) - 0.9)
    assert side[object_id == 0].min() > -1e-6
    assert set(intensity[(object_id == 0) & (np.abs(offset) < 3.4)].tolist()) == {71}  # 70.6, rounded
    assert {170, 71} <= set(intensity.ravel().tolist())
    # Blocks of profiles change nothing.
    monkeypatch.setattr(profiler, "BLOCK_PROFILES", 37)
    for a, b in zip(found, _left_profiles(STREET.changed(roadside={"moving_cars": [CAR]})), strict=True):
        np.testing.assert_array_equal(a, b)
    # Nor is it there in a pass that it does not drive in.
    empty = _left_profiles(STREET.changed(roadside={"moving_cars": [CAR | {"passes": [2]}]}))
    assert (empty[3] == 0).all()


@pytest.mark.slow
def test_walls_hide_floors_from_a_heads_camera_and_spots_average():
    """Slots of 6 mm, 20 mm deep: the camera looks along a longitudinal one, and over the edge of a transverse one."""
    along = {"points_m": [(8.0, -1.0), (12.0, -1.0)], "width_m": 0.006, "depth_m": 0.02, "wall_m": 0.0005}
    across = along | {"points_m": [(15.0, -2.0), (15.0, 0.0)]}
    spot = {"spacing_m": 0.001, "readings": 121, "width_m": 0.12, "spot_along_m": 0.001, "spot_across_m": 0.001}
    heads = {**spot, "camera_deg": 25.0, "left": {"lever_arm_body_m": [-2.35, -1.0, -1.08]}}
    street = STREET.changed(length_m=20.0, vehicle={"speed_m_per_s": 2.0}, passes=[{"lane": 2, "offset_m": -1.75}])
    street = street.changed(road={"cracks": [along, across]}, profilers=heads)

    def depth_mm(scene: Scene) -> list[np.ndarray]:
        _, station, offset, _, _, raw = _left_profiles(scene)
        usual = np.median(raw)
        depth = np.where(raw > 0, scene.profilers.range_step_m * 1e3 * (raw - usual), np.nan)
        in_along = (np.abs(offset + 1.0) < 0.001) & (np.abs(station - 10.0) < 1.5)
        whole = np.flatnonzero((raw > 0).all(axis=1))  # profiles between which those with lost readings lie
        at = np.interp(np.arange(len(raw)), whole, station[whole].mean(axis=1))
        in_across, beside = np.abs(at - 15.0) < 0.002, np.abs(at - 13.5) < 1.0
        return [depth[in_along], depth[in_across], raw[beside]]

    inside, hidden, ground = depth_mm(street)
    assert inside.size > 1000 and np.median(inside) == pytest.approx(20.0, abs=0.2)
    assert np.isnan(hidden).mean() > 0.9 and ground.shape[1] == 121 and (ground > 0).all()
    _, seen, _ = depth_mm(street.changed(profilers={"camera_deg": 0.0}))
    assert np.isfinite(seen).all() and np.median(seen) == pytest.approx(20.0, abs=0.2)
    # A spot of twice the slot's width sees half of it: the mean of floor and ground.
    wide, _, _ = depth_mm(street.changed(profilers={"spot_along_m": 0.001, "spot_across_m": 0.012}))
    assert 6.0 < np.median(wide[np.isfinite(wide)]) < 13.0


def test_row_groups_and_encoding(tmp_path: Path):
    import pyarrow.parquet as pq

    survey = simulate(TINY.changed(length_m=40.0, passes=[{"lane": 1}]), tmp_path / "survey")
    profiles = survey.profiles // 2
    assert profiles == pytest.approx(40.0 / 0.05 + 1, abs=8)  # the lane is a little longer or shorter than the line
    log = pq.ParquetFile(tmp_path / "survey" / "raw" / "run-1" / "profiler_left.parquet")
    assert [log.metadata.row_group(i).num_rows for i in range(log.num_row_groups)] == [512, profiles - 512]
    assert survey.readings == 2 * profiles * 200
    column = log.metadata.row_group(0).column(1)
    assert column.path_in_schema == "range.list.element"
    assert "DELTA_BINARY_PACKED" in column.encodings
    assert not column.has_dictionary_page
    assert column.total_compressed_size < 0.6 * 2 * 512 * 200


@pytest.mark.slow
def test_memory_does_not_grow_with_the_road(tmp_path: Path):
    peaks = []
    for length in (500.0, 2_000.0):
        scene = TINY.changed(length_m=length, profilers={"spacing_m": 0.5, "readings": 400})
        tracemalloc.start()
        simulate(scene, tmp_path / f"{length:.0f}")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0] + 8e6, [f"{p / 1e6:.1f} MB" for p in peaks]


def test_refuses_what_is_not_its_own(tmp_path: Path):
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "dear.txt").write_text("…")
    with pytest.raises(ConfigError, match="not empty and holds no simulated survey"):
        simulate(TINY, tmp_path / "letters")
    simulate(TINY, tmp_path / "survey")
    with pytest.raises(ConfigError, match="survey of another scene"):
        simulate(TINY.changed(seed=99), tmp_path / "survey")
    with pytest.raises(FormatError, match="there is no truth here"):
        truth.load(tmp_path / "letters")
    with pytest.raises(ConfigError, match="not known to PROJ"):
        simulate(TINY.changed(map={"crs": "EPSG:1"}), tmp_path / "nowhere")


def test_progress_names_each_log(tmp_path: Path):
    seen: list[str] = []
    simulate(TINY, tmp_path / "survey", progress=seen.append)
    logs = ("trajectory.sbet", "trajectory.smrmsg", "profiler_left.parquet", "profiler_right.parquet")
    assert set(seen) == {f"run-1/{log}" for log in logs}
    assert len(seen) == 4


def test_truth_is_the_scene_itself(tmp_path: Path):
    survey = simulate(TINY, tmp_path / "survey")
    known = truth.load(survey.folder)
    assert known.scene == TINY
    assert truth.load(survey.truth_folder).scene == TINY
