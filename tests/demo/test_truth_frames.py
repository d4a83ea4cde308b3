"""Every reading of every sensor lies where the simulator's beam hit, in four frames and all attitudes.

A circle on a slope of 12 % gives headings through 360° and slopes of ± 12 % along and across, the suspension rolls by
± 5°; lever arms are metres and boresights degrees. The logs round ranges: what they round, along the beam, is known
from the exact range in the truth and taken out, so that the bar is that of the geometry. The sensors' true poses come
from the truth by SciPy.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pyproj
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from roadscan.core.survey import Survey
from roadscan.georeference.place import EVERYWHERE
from roadscan.georeference.plan.plan import SurveyPlan, plan_survey
from roadscan.georeference.sources import Georeferencer
from roadscan.ingest.ingest import ingest
from roadscan.simulate import Scene, simulate, truth
from roadscan.store.store import Store

FRAMES = {
    "UTM north": ("EPSG:32632", 691_000.0, 5_335_000.0, 560.0),
    "UTM south": ("EPSG:32756", 331_300.0, 6_241_900.0, 27.0),
    "state plane in US feet": ("EPSG:2229", 1_969_000.0, 563_000.0, 92.0),
    "local": ("local", 120.0, -340.0, 3.0),
}
BARS_M = {"profiler_left": 0.1e-3, "profiler_right": 0.1e-3, "sick": 0.1e-3, "lidar": 0.2e-3}
AXES = {"lidar": np.diag([1.0, -1.0, -1.0])}


def hillside(crs: str, easting: float, northing: float, height: float) -> Scene:
    """A whole circle on a hillside, driven fast: a spinning lidar measures 0.7 million returns a second."""
    pieces = [{"length_m": 4.0}, {"length_m": 2 * np.pi * 10.0, "radius_m": 10.0}, {"length_m": 4.0}]
    circle = {"station_m": 50.0, "offset_m": -25.0, "heading_deg": 90.0, "pieces": pieces}
    return Scene().changed(
        id="hillside",
        length_m=110.0,
        seed=13,
        map={"crs": crs, "easting_m": easting, "northing_m": northing, "height_m": height, "azimuth_deg": 33.0},
        road={
            "alignment": [{"kind": "straight", "length_m": 300.0}], "lanes": 2, "lane_width_m": 50.0, "lead_m": 30.0,
            "verge_width_m": 20.0, "verge_slope": 0.03, "cross_slope": 0.0, "crown_rounding_m": 5.0, "grade": 0.12,
            "cross_slopes": [{"station_m": 0.0, "left": 0.03, "right": -0.03}],
        },
        passes=[{"route": circle}],
        vehicle={"speed_m_per_s": 40.0, "speed_variation": 0.0, "sway_deg": 5.0, "heave_m": 0.02},
        profilers={
            "spacing_m": 0.4, "readings": 120,
            "left": {"lever_arm_body_m": (-3.4, -1.8, -1.1), "roll_deg": 3.0, "pitch_deg": -2.5, "heading_deg": 6.0},
            "right": {"lever_arm_body_m": (2.9, 1.6, -1.2), "roll_deg": -4.0, "pitch_deg": 3.5, "heading_deg": -8.0},
        },
        lidar={
            "on": True, "on_azimuth_grid": True, "range_max_m": 40.0,
            "mount": {"lever_arm_body_m": (1.5, -1.1, -2.0), "roll_deg": -3.0, "pitch_deg": 21.0, "heading_deg": 112.0},
        },
        sick={
            "on": True, "scans_per_s": 25.0,
            "mount": {"lever_arm_body_m": (-2.2, 0.4, -1.6), "roll_deg": 4.0, "pitch_deg": 9.0, "heading_deg": -5.0},
        },
        trajectory={"poses_per_s": 200},
    )  # fmt: skip


@pytest.fixture(scope="module", params=list(FRAMES))
def planned(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Survey, SurveyPlan]:
    scene = hillside(*FRAMES[request.param]).noiseless()
    folder = tmp_path_factory.mktemp("hillside")
    survey = Survey.load(simulate(scene, folder / "survey", write_hits=True).survey_file)
    store = Store(survey.store_url, survey.config.id)
    ingest(survey, store)
    return survey, plan_survey(survey, store)


@pytest.mark.slow
def test_the_drive_is_as_hard_as_claimed(planned: tuple[Survey, SurveyPlan]) -> None:
    survey, _ = planned
    _, position, attitude = true_poses(survey.folder, "run-1")
    level = level_axes(survey, position)
    heading, pitch, roll = (level.inv() * attitude).as_euler("ZYX", degrees=True).T
    assert np.histogram(heading, bins=36, range=(-180, 180))[0].min() > 5
    assert pitch.min() < -9.0 and pitch.max() > 9.0  # ± 12 % is ± 6.8°, the rest is the suspension
    assert roll.min() < -9.0 and roll.max() > 9.0


@pytest.mark.slow
@pytest.mark.parametrize("sensor", list(BARS_M))
def test_every_reading_lies_where_its_beam_hit(planned: tuple[Survey, SurveyPlan], sensor: str) -> None:
    survey, plan = planned
    true = truth.load(survey.folder)
    sources = [s for s, _ in plan.sources if s.sensor == sensor]
    assert len(sources) == 1
    for source in sources:
        found, step = placed(survey, plan, source, sensor)
        hits = read_hits(true.hits_file(source.run, sensor))
        assert len(found) == len(hits["range_m"]) > 5_000
        expected = np.stack([hits["easting_m"], hits["northing_m"], hits["height_m"]], axis=-1)
        rounding = np.rint(hits["range_m"] / step) * step - hits["range_m"]
        if sensor.startswith("profiler"):
            offset = true.scene.profilers.range_offset_m
            rounding = np.rint((hits["range_m"] - offset) / step) * step + offset - hits["range_m"]
        along = beam_directions(survey, true.scene, source.run, sensor, hits, expected)
        errors = found - (expected + along * rounding[:, None])
        assert np.abs(rounding).max() <= step / 2 + 1e-9
        worst = np.linalg.norm(errors, axis=1).max()
        assert worst < BARS_M[sensor], f"{source.run} {sensor}: {worst * 1e3:.4f} mm"


def placed(survey: Survey, plan: SurveyPlan, source: object, sensor: str) -> tuple[np.ndarray, float]:
    """Points (n, 3) of a source in the order of its log, in metres of the map, and the step of its ranges."""
    quanta = plan.ground.grid.size_quanta
    slices = [s for s in plan.slices() if s.source is source]
    placer = Georeferencer(Store(survey.store_url, survey.config.id), plan.ground, slices)
    parts = [p for one in slices for _, p in placer.place(one, EVERYWHERE)]
    tiles = np.concatenate([p.tiles for p in parts]).astype(np.int64)
    own = np.concatenate([p.quanta for p in parts])
    geometry = dict(source.attributes).get("scan_geometry", {})  # type: ignore[attr-defined]
    points = np.column_stack([tiles * quanta + own[:, :2], own[:, 2]]) * 1e-5
    return points, geometry.get("range_step_m", 0.002)


def read_hits(file: Path) -> dict[str, np.ndarray]:
    """Hits of recorded readings, flat, in the log's order."""
    table = pq.read_table(file)
    flat = {}
    for name in ("easting_m", "northing_m", "height_m", "range_m"):
        column = table.column(name).combine_chunks()
        lists = hasattr(column, "flatten") and str(column.type).startswith(("fixed_size_list", "list"))
        values = column.flatten() if lists else column
        flat[name] = values.to_numpy(zero_copy_only=False)
    each = flat["range_m"].size // max(table.num_rows, 1)
    flat["epoch_gps_ns"] = np.repeat(table.column("epoch_gps_ns").to_numpy(), each)
    if each == 361:  # the mirror turns by half a degree from reading to reading, at 75 turns a second
        flat["epoch_gps_ns"] += np.tile(np.rint(np.arange(361) * 0.5 / 360.0 / 75.0 * 1e9).astype(np.int64), len(table))
    kept = np.isfinite(flat["range_m"])
    return {name: values[kept] for name, values in flat.items()}


def true_poses(folder: Path, run: str) -> tuple[np.ndarray, np.ndarray, Rotation]:
    rows = pq.read_table(truth.load(folder).trajectory_file(run)).to_pandas()
    position = rows[["x_world_m", "y_world_m", "z_world_m"]].to_numpy()
    return rows.epoch_gps_ns.to_numpy(), position, Rotation.from_quat(rows[["qx", "qy", "qz", "qw"]].to_numpy())


def level_axes(survey: Survey, position: np.ndarray) -> Rotation:
    """World from north-east-down."""
    if survey.config.map.crs is None:
        return Rotation.from_matrix([[[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]] * len(position))
    to_degrees = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    lon, lat = np.radians(np.stack(to_degrees.transform(*position.T)[:2]))
    north = np.stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)], axis=-1)
    east = np.stack([-np.sin(lon), np.cos(lon), np.zeros_like(lon)], axis=-1)
    return Rotation.from_matrix(np.stack([north, east, np.cross(north, east)], axis=-1))


def beam_directions(
    survey: Survey, scene: Scene, run: str, sensor: str, hits: dict[str, np.ndarray], enh: np.ndarray
) -> np.ndarray:
    """Unit vectors (n, 3) of the map along each beam: for a profiler its z axis, else from the origin to the hit."""
    epochs, position, attitude = true_poses(survey.folder, run)
    seconds = (epochs - epochs[0]) * 1e-9
    at = (hits["epoch_gps_ns"] - epochs[0]) * 1e-9
    some = np.unique(at)
    mount = {"lidar": scene.lidar.mount, "sick": scene.sick.mount,
             "profiler_left": scene.profilers.left, "profiler_right": scene.profilers.right}[sensor]  # fmt: skip
    body = RotationSpline(seconds, attitude)(some)
    origin = CubicSpline(seconds, position)(some) + body.apply(mount.lever_arm_body_m)
    turn = Rotation.from_euler("ZYX", [mount.heading_deg, mount.pitch_deg, mount.roll_deg], degrees=True)
    down = body.apply(turn.apply(AXES.get(sensor, np.eye(3)) @ [0.0, 0.0, 1.0]))
    index = np.searchsorted(some, at)
    near, ahead = (to_map(survey, p)[index] for p in (origin, origin + down))
    beams = ahead - near if sensor.startswith("profiler") else enh - near
    return beams / np.linalg.norm(beams, axis=1, keepdims=True)


def to_map(survey: Survey, world: np.ndarray) -> np.ndarray:
    """Map coordinates (n, 3) in metres."""
    crs = survey.config.map.crs
    if crs is None:
        return world
    projected = pyproj.CRS(crs).to_3d()
    unit = projected.axis_info[0].unit_conversion_factor
    e, n, h = pyproj.Transformer.from_crs("EPSG:4978", projected, always_xy=True).transform(*world.T)
    return np.stack([np.asarray(e) * unit, np.asarray(n) * unit, h], axis=-1)
