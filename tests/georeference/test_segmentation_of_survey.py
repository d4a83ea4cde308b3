"""A run with [segmentation]: classes against the simulator's truth, the same cells by either way and in any blocks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from roadscan.core.errors import ConfigError
from roadscan.core.survey import Survey
from roadscan.export.classes import write_classes
from roadscan.georeference.plan.plan import plan_survey
from roadscan.georeference.road_profiles import LAS_CLASSES, NOT_ROAD, OVERLAPPING, READING_CLASSES
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Session
from roadscan.run.stage import stages
from roadscan.simulate import Scene, simulate, truth
from roadscan.store.manifest import Manifest
from roadscan.store.store import Store
from roadscan.survey.run import run_stages
from roadscan.survey.status import survey_status
from tests.surveys import Simulated, changed, outputs

CELLS = {"products__make": ["geotiff", "tile_table"]}
ON: dict[str, Any] = {"segmentation": {"turns": {}}}
SENSORS = ("profiler_left", "profiler_right", "sick")
PROFILES = 125
NAMES = [READING_CLASSES[kind] for kind in NOT_ROAD]

SCENE: dict[str, Any] = {
    "id": "street",
    "seed": 77,
    "length_m": 14.0,
    "passes": [{"lane": 2}],
    "road": {
        "alignment": [{"kind": "arc", "length_m": 14.0, "radius_m": 60.0}],
        "lanes": 2,
        "lane_width_m": 2.75,
        "verge_width_m": 6.0,
        "verge_slope": -0.02,
        "texture": {"mpd_mm": 0.8},
        "kerbs": [{"side": "left", "height_m": 0.10}, {"side": "right", "height_m": 0.14}],
        "potholes": [{"station_m": 11.0, "offset_m": 1.4, "radius_m": 0.3, "depth_m": 0.05}],
        "cracks": [{"width_m": 0.02, "depth_m": 0.02, "points_m": [[1.0, 0.8], [13.0, 1.3]]}],
    },
    "roadside": {
        "parked_cars": [{"station_m": 5.0, "offset_m": 3.6}, {"station_m": 9.0, "offset_m": -3.2}],
        "trees": [{"station_m": 3.0, "offset_m": 5.0, "every_m": 4.0, "count": 3, "height_m": 7.0}],
        "poles": [{"station_m": 1.0, "offset_m": 3.05, "every_m": 2.0, "count": 6, "height_m": 0.9}],
    },
    "vehicle": {"speed_m_per_s": 7.0},
    "lidar": {"on": False},
    "sick": {"on": True, "divergence_deg": 0.4},
    "profilers": {"spacing_m": 0.1, "readings": 1000},
    "noise": {"profiler_range_m": 0.0003, "sick_range_m": 0.006, "dropout": 0.002, "impulse": 0.0005},
}


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    """A narrow street with kerbs, cars, trees and poles; run with segmentation, without points."""
    folder = tmp_path_factory.mktemp("street") / "survey"
    survey = Simulated(simulate(Scene.parse(SCENE), folder, write_hits=True).survey_file)
    survey.run("cells", **ON, **CELLS)
    return survey


def classes_of(street: Simulated, sensor: str, **settings: Any) -> np.ndarray:
    """Class of every reading (profiles, readings), with only these settings changed."""
    survey, out = changed(Survey.load(street.survey_file), settings), street.survey_file.parent / "classes.parquet"
    write_classes(survey, street.store("cells"), "run-1", sensor, out)
    table = pq.read_table(out)
    return table.column("class").to_numpy().reshape(-1, int(table.column("reading")[-1].as_py()) + 1)


def hits_of(street: Simulated, sensor: str) -> tuple[np.ndarray, np.ndarray]:
    """Whether each beam hit the carriageway, and whether it hit anything else; what half met an edge is neither."""
    known = truth.load(street.survey_file.parent)
    table = pq.read_table(known.hits_file("run-1", sensor))

    def of(name: str) -> np.ndarray:
        flat = table.column(name).combine_chunks().flatten().to_numpy(zero_copy_only=False)
        return flat.reshape(table.num_rows, -1)

    easting, northing = of("easting_m"), of("northing_m")
    met = np.isfinite(easting)
    if "is_mixed" in table.column_names:
        met &= ~of("is_mixed")
    ground = met & (of("object_id") == 0)
    offset = np.full(met.shape, np.inf)
    offset[ground] = known.station_offset_m(easting[ground], northing[ground])[1]
    road = ground & (np.abs(offset) <= known.scene.road.paved_m)
    return road, met & ~road


@pytest.mark.slow
def test_road_is_kept_and_others_are_rejected(street: Simulated) -> None:
    others_of_all = 0
    for sensor in SENSORS:
        classes, (road, others) = classes_of(street, sensor, **ON), hits_of(street, sensor)
        kept = classes == 0
        measured = ~np.isin(classes, [1, 3, 4])
        assert kept[road & measured].mean() >= 0.99, sensor
        others &= measured
        others_of_all += others.sum()
        assert others.sum() == 0 or (~kept)[others].mean() >= 0.97, sensor
        assert set(np.unique(classes[others & ~kept])) <= set(NOT_ROAD)
    assert others_of_all > 10_000


@pytest.mark.slow
def test_every_reading_is_told_by_its_fate(street: Simulated) -> None:
    status = survey_status(Session(changed(Survey.load(street.survey_file), ON | CELLS), street.store("cells")))
    counts: dict[str, int] = dict.fromkeys(NAMES, 0)
    readings = 0
    for sensor in SENSORS:
        classes = classes_of(street, sensor, **ON)
        readings += classes.size
        for kind in NOT_ROAD:
            counts[READING_CLASSES[kind]] += int((classes == kind).sum())
    assert sum(status.readings.values()) == readings
    assert {name: status.readings.get(name, 0) for name in NAMES} == counts
    assert sum(counts.values()) > 10_000
    assert status.is_complete


@pytest.mark.slow
def test_neither_points_nor_blocks_change_a_byte(street: Simulated) -> None:
    cells = outputs(street.store("cells"))
    assert cells
    street.run("cells-1", **ON, **CELLS, tiles__block_tiles=1)
    assert outputs(street.store("cells-1")) == cells
    street.run("points", **ON, products__make=["geotiff", "tile_table", "las"], tiles__block_tiles=2)
    assert {p: b for p, b in outputs(street.store("points")).items() if not p.startswith("tiles/las/")} == cells


@pytest.mark.slow
def test_marked_points_are_those_beside_the_road(street: Simulated) -> None:
    street.run("marked", **ON, filters__keep_marked=True, products__make=["geotiff", "tile_table", "las"])
    marked, plain = street.store("marked"), street.store("cells")
    las = {p: laspy.read(marked.path(p)) for p in marked.files("tiles/las")}
    found = {int(LAS_CLASSES[kind]): 0 for kind in NOT_ROAD}
    for own in las.values():
        withheld = np.asarray(own.withheld) == 1
        for kind, count in zip(*np.unique(np.asarray(own.classification)[withheld], return_counts=True), strict=True):
            found[int(kind)] += int(count)
    everything = [classes_of(street, sensor, **ON) for sensor in SENSORS]
    expected = {int(LAS_CLASSES[k]): sum(int((c == k).sum()) for c in everything) for k in NOT_ROAD}
    assert sum(found.values()) > 10_000
    assert all(found[kind] <= expected[kind] for kind in found)  # a tile with no road has no files
    assert sum(found.values()) >= 0.5 * sum(expected.values())
    kept = sum(int((np.asarray(own.withheld) == 0).sum()) for own in las.values())
    assert kept == sum(int((c == 0).sum()) for c in everything)
    ours, theirs = outputs(marked), outputs(plain)
    assert {p: b for p, b in ours.items() if not p.startswith("tiles/las/")} == theirs


@pytest.mark.slow
def test_only_settings_of_the_segmentation_make_tiles_stale(street: Simulated) -> None:
    def keys(**settings: Any) -> tuple[int, int]:
        survey = changed(Survey.load(street.survey_file), CELLS | settings)
        status = survey_status(Session(survey, street.store("cells")))
        return status.of("tiles").stale, status.of("tiles").current

    assert keys(**ON)[0] == 0
    assert keys(**ON, tiles__block_tiles=3)[0] == 0
    assert keys(segmentation={"turns": {}, "sensors": list(SENSORS)})[0] == 0
    for other in (None, {}, {"turns": {"base_m": 2.0}}, {"turns": {}, "profiles": {"step_m": 0.02}}):
        assert keys(segmentation=other)[1] == 0
    touched_by_both = keys(segmentation={"turns": {}, "sensors": ["profiler_left", "sick"]})
    assert 0 < touched_by_both[0] < keys(segmentation=None)[0]
    plans = [
        plan_survey(changed(Survey.load(street.survey_file), settings), street.store("cells")) for settings in (ON, {})
    ]
    keys_of_readings = [[source.key for source, _ in plan.sources] for plan in plans]
    assert keys_of_readings[0] == keys_of_readings[1]  # so footprints stay current


@pytest.mark.slow
def test_what_cannot_be_segmented_is_refused(street: Simulated) -> None:
    survey = Survey.load(street.survey_file)
    with pytest.raises(ConfigError, match=r"unknown sensor 'sik'.*did you mean 'sick'"):
        changed(survey, {"segmentation": {"sensors": ["sik"]}})
    with pytest.raises(ConfigError, match=r"unknown key 'segmentation\.profile'.*did you mean 'profiles'"):
        changed(survey, {"segmentation": {"profile": {}}})
    sideways = {n: s | {"axes": "rfu"} for n, s in survey.rig.model_dump()["sensors"].items()}
    with pytest.raises(ConfigError, match="no sensor whose profiles lie across the road"):
        plan_survey(changed(survey, ON | {"rig": {"sensors": sideways}}), street.store("cells"))


def write_turn(folder: Path) -> Survey:
    """Three quarters of a circle of 5 m radius on level ground, 2 m/s; a mirror scanner 2 m above it, 12.5 Hz."""
    seconds = np.arange(0.0, 12.0, 0.02)
    heading = 2.0 * seconds / 5.0
    places = [5.0 - 5.0 * np.cos(heading), 5.0 * np.sin(heading)]
    rows = zip(1.4e9 + seconds, *places, np.degrees(heading), strict=True)
    lines = [f"{t:.2f},{e:.6f},{n:.6f},102.0,0,0,{h:.6f}" for t, e, n, h in rows]
    head = "time_s,easting_m,northing_m,height_m,roll_deg,pitch_deg,heading_deg"
    (folder / "path.csv").write_text("\n".join([head, *lines, ""]))
    angle = np.radians(75.0 - 1.5 * np.arange(101))
    ranges = np.tile(np.round(2000.0 / np.cos(angle)).astype(np.uint16), (PROFILES, 1))
    geometry = {"kind": "polar", "readings": 101, "first": angle[0], "step": -np.radians(1.5), "range_step_m": 0.001}
    geometry |= {"reading_period_ns": 5e4}
    epochs = 1_400_000_000 * 10**9 + 10**9 + np.arange(PROFILES) * 80_000_000
    lists = [
        pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), 101) for values in (ranges, ranges.astype(np.uint8))
    ]
    pq.write_table(
        pa.table({"epoch_gps_ns": epochs, "range": lists[0], "intensity": lists[1]}), folder / "scans.parquet"
    )
    path = {"path": "path.csv", "format": "trajectory_csv", "crs": "local", "clock": {"system": "gps"}}
    scans = {"path": "scans.parquet", "format": "scans", "sensor": "s", "options": {"scan_geometry": geometry}}
    values = {
        "id": "turn",
        "map": {"local": {"name": "yard"}},
        "tiles": {"cell_m": 0.5, "size_m": 5.0},
        "rig": {"sensors": {"s": {"kind": "lidar", "lever_arm_body_m": [0.5, 0.0, 0.0]}}},
        "runs": [{"id": "r", "logs": [path, scans]}],
        "segmentation": {"turns": {}},
        "products": {"make": ["geotiff"]},
    }
    return Survey.parse(values, folder=folder)


def test_what_overlaps_in_a_turn_is_left_out_in_any_blocks(tmp_path: Path) -> None:
    survey = write_turn(tmp_path)

    def run(name: str, **settings: Any) -> Store:
        store = Store(str(tmp_path / name), "turn")
        run_stages(Session(changed(survey, settings), store, Inline()), stages())
        return store

    store = run("a")
    out = tmp_path / "classes.parquet"
    counts = write_classes(survey, store, "r", "s", out)
    classes = pq.read_table(out).column("class").to_numpy().reshape(PROFILES, -1)
    across = 2.0 * np.tan(np.radians(75.0 - 1.5 * np.arange(101)))
    assert set(counts) == {"kept", "overlapping"}
    assert np.array_equal(classes == OVERLAPPING, np.tile(across > 5.0, (PROFILES, 1)))
    cells = outputs(store)
    points = run("b", tiles__block_tiles=1, products__make=["geotiff", "las"])
    assert {path: content for path, content in outputs(points).items() if not path.startswith("tiles/las/")} == cells
    manifest = Manifest(store)
    manifest.forget("tile", list(manifest.of("tile"))[::3])
    run("a")  # other tasks, with fewer poses at hand
    assert outputs(store) == cells
