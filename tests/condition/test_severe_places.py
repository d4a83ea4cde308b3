"""Potholes, kerbs, slabs and cracks that are deep, from raw logs to the products, beside the simulator's truth.

Beams have a spot and heads a camera, from which walls hide floors; 1 % of the readings are wrong and 2 % lost.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import pandas as pd
import pytest
import shapely
from typer.testing import CliRunner

from benchmarks.bench_lanes import rough_scene
from roadscan.cli import app
from roadscan.simulate import Scene, simulate, truth
from roadscan.simulate.features import faults_of
from roadscan.simulate.truth import Truth
from roadscan.store.query.sql import query
from roadscan.store.store import Store
from tests.condition.test_spacing_and_severe_places import e1926

pytestmark = pytest.mark.nightly

NOISE = {"profiler_range_m": 0.0003, "dropout": 0.02, "impulse": 0.01, "position_m": 0.0, "attitude_deg": 0.0}
STRAIGHT: dict[str, Any] = {"alignment": [{"kind": "straight", "length_m": 900.0}]}
HOLES_M = {"left": (0.05, 0.2), "right": (0.099, 0.101)}
"""Depths of potholes in the first and the second 100 m, by wheel path."""


def run(scene: Scene, folder: Path, settings: str) -> Store:
    """The store of a survey that `roadscan run` made of a scene."""
    simulate(scene, folder)
    file = folder / "SURVEY.toml"
    file.write_text(file.read_text() + settings)
    outcome = CliRunner().invoke(app, ["run", str(file), "--workers", "0"])
    assert outcome.exit_code == 0, outcome.output
    (folder / "said.txt").write_text(outcome.output)
    return Store(str(folder / "store"), "rough")


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> tuple[Store, Truth, Path]:
    folder = tmp_path_factory.mktemp("severe") / "survey"
    holes = [
        {
            "station_m": 52.3 + 97.7 * k,
            "offset_m": 1.75 + side * 0.75,
            "radius_m": 0.3,
            "depth_m": depth,
            "wall_m": 0.01,
        }
        for side, depths in zip((-1.0, 1.0), HOLES_M.values(), strict=True)
        for k, depth in enumerate(depths)
    ]
    kerb = {"station_m": 220.0, "offset_m": 1.75, "length_m": 10.0, "width_m": 3.4, "height_m": 0.15, "edge_m": 0.005}
    road = STRAIGHT | {"ruts": [], "potholes": holes, "patches": [kerb], "slabs": [{"start_m": 240.0, "end_m": 290.0}]}
    heads = {"spacing_m": 0.05, "readings": 200, "spot_along_m": 0.002, "spot_across_m": 0.002, "camera_deg": 25.0}
    passes = [{"lane": 2, "speed_m_per_s": 22.2}]
    scene = rough_scene(1.5, 297.0, seed=61, passes=passes, noise=NOISE, road=road, profilers=heads)
    return run(scene, folder, "\n[condition]\n"), truth.load(folder), folder


def profile(store: Store, known: Truth, side: str) -> tuple[pd.DataFrame, np.ndarray]:
    """The measured wheel path, and the true heights of its line each 10 mm from its first station on."""
    own = query(store, f"SELECT * FROM profiles_longitudinal WHERE path = '{side}' ORDER BY station_m").to_pandas()
    at = np.arange(own["station_m"].iloc[0], own["station_m"].iloc[-1], 0.01)
    places = (np.interp(at, own["station_m"], own[name]) for name in ("easting_m", "northing_m"))
    return own, known.surface.height_m(*places, texture=False)


def values(store: Store, index: str) -> pd.DataFrame:
    sql = f"SELECT * FROM condition_values WHERE \"index\" = '{index}' ORDER BY station_from_m"
    return query(store, sql).to_pandas()


def test_roughness_holds_potholes_within_its_sigma(street: tuple[Store, Truth, Path]) -> None:
    store, known, _ = street
    found = values(store, "iri")
    for side, depths in HOLES_M.items():
        own, height = profile(store, known, side)
        sections = found[(found["quantity"] == f"iri_{side}_m_per_km") & found["value"].notna()]
        assert len(sections) == 3  # the last one as well: what heads behind the vehicle do not reach is no gap
        for one, depth in zip(sections.to_dict("records"), (*depths, 0.15), strict=True):
            from_m, to_m = (one[f"station_{end}_m"] - own["station_m"].iloc[0] for end in ("from", "to"))
            true = e1926(height, 0.01, from_m, min(to_m, 0.01 * height.size))
            assert abs(one["value"] - true) < max(2.5 * one["sigma"], 0.02 * true)
            assert one["value"] == pytest.approx(true, rel=0.06)
            assert one["sigma"] < 0.15 * true
            assert one["value"] > 1.5 + 8.0 * depth  # none vanishes


def test_localised_roughness_lists_each_pothole(street: tuple[Store, Truth, Path], tmp_path: Path) -> None:
    store, known, _ = street
    for side in HOLES_M:
        own, _ = profile(store, known, side)
        file = tmp_path / f"{side}.csv"
        own[["station_m", "height_m"]].dropna().to_csv(file, index=False)
        outcome = CliRunner().invoke(app, ["iri", str(file), "--localised", "8", "--json"])
        rows = json.loads(outcome.stdout)["rows"]
        station, _ = known.station_offset_m(own["easting_m"].to_numpy(), own["northing_m"].to_numpy())
        ahead = own["station_m"].iloc[0] - station[0]
        for at in (52.3 + ahead, 150.0 + ahead):
            assert any(row["from_m"] < at < row["to_m"] for row in rows), (side, at, rows)


def test_a_step_is_told_where_it_is(street: tuple[Store, Truth, Path]) -> None:
    said = (street[2] / "said.txt").read_text()
    assert "the road steps by more than 0.1 m, as at a kerb, and is kept" in said


def test_all_faults_count_and_kerbs_do_not(street: tuple[Store, Truth, Path]) -> None:
    store, known, _ = street
    slabs = known.scene.road.slabs[0]
    stations, faults = faults_of(slabs, known.scene.seed, 0)
    found = values(store, "faulting")
    for side in HOLES_M:
        own, _ = profile(store, known, side)
        true_m, _ = known.station_offset_m(own["easting_m"].to_numpy(), own["northing_m"].to_numpy())
        at = np.interp(stations, true_m, own["station_m"])
        steps = found[found["quantity"] == f"step_{side}_mm"]
        near = np.abs(steps["station_from_m"].to_numpy()[:, None] - at) < 0.3
        seen = near.any(axis=0)
        assert seen[np.abs(faults) > 0.0035].all()
        error = [steps["value"].iloc[int(near[:, k].argmax())] - 1e3 * faults[k] for k in np.flatnonzero(seen)]
        sigma = [steps["sigma"].iloc[int(near[:, k].argmax())] for k in np.flatnonzero(seen)]
        assert np.mean(np.abs(error) < 2.0 * np.array(sigma)) >= 0.8 and np.abs(error).max() < 2.5
    mean = found[(found["quantity"] == "faulting_mean_mm") & (found["station_from_m"] > 150.0)]
    assert mean["value"].iloc[-1] == pytest.approx(1e3 * np.abs(faults).mean(), abs=1.0)
    assert "steps of more than 100 mm that are no joints: 2" in mean["reason"].iloc[-1]


@pytest.fixture(scope="module")
def worn(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Truth]:
    folder = tmp_path_factory.mktemp("worn") / "survey"
    kinds = ((0.004, 0.006), (0.008, 0.016), (0.012, 0.03), (0.02, 0.03))
    cracks = [
        {"points_m": points, "width_m": width, "depth_m": depth, "wall_m": wall}
        for k, (width, depth) in enumerate(kinds)
        for wall, at in ((0.0, 1.0 + 1.5 * k), (0.001, 1.75 + 1.5 * k))
        for points in (
            [(at - 0.3, 0.55 + 300.0 * wall), (at + 0.3, 0.58 + 300.0 * wall)],
            [(at, 1.5), (at + 0.03, 2.2)],
            [(at, 2.7), (at + 0.4, 3.1)],
        )
    ]
    holes = [
        {"station_m": 8.0 + 1.5 * k, "offset_m": 1.75, "radius_m": 0.3, "depth_m": depth, "wall_m": 0.01}
        for k, depth in enumerate((0.05, 0.12, 0.3))
    ]
    heads = {"spacing_m": 0.003, "readings": 1000, "spot_along_m": 0.0015, "spot_across_m": 0.0015, "camera_deg": 25.0}
    road = STRAIGHT | {"ruts": [], "potholes": holes, "cracks": cracks, "texture": {"mpd_mm": 0.7}}
    scene = rough_scene(
        2.0, 15.0, seed=62, passes=[{"lane": 2, "speed_m_per_s": 5.0}], noise=NOISE, road=road, profilers=heads
    )
    made = '\n[tiles]\ncell_m = 0.005\n[surface]\nmethod = "cells"\nsigma_m = 0.0005\n'
    run(scene, folder, made + '[products]\nmake = ["cracks", "potholes"]\n')
    return folder, truth.load(folder)


@pytest.mark.xfail(
    strict=True, reason="2 of 14 depths are 6 and 9 σ low: walls hide their bottom, readings do not show it"
)
def test_depths_of_cracks_are_right_within_their_sigma_or_empty(worn: tuple[Path, Truth]) -> None:
    folder, known = worn
    found = geopandas.read_parquet(next(folder.rglob("cracks.parquet")))
    told, empty = [], []
    for crack in known.scene.road.cracks:
        east, north, _ = known.surface.place(*np.array(crack.points_m).T)
        line = shapely.LineString(np.column_stack([east, north]))
        shared = found["line"].intersection(line.buffer(0.02)).length
        if shared.max() > 0.5 * line.length:
            row = found.loc[shared.idxmax()]
            z = (row["depth_mean_m"] - crack.depth_m) / row["sigma_depth_mean_m"]
            (empty if np.isnan(z) else told).append((crack.width_m, crack.depth_m, z))
    assert len(told) >= 10
    assert np.mean(np.abs([z for _, _, z in told]) < 2.0) >= 0.9
    assert empty and min(depth for _, depth, _ in empty) > 0.01  # shallow ones are seen whole


def test_potholes_have_their_area_depth_and_volume_within_sigma(worn: tuple[Path, Truth]) -> None:
    folder, known = worn
    found = geopandas.read_parquet(next(folder.rglob("potholes.parquet")))
    for hole in known.scene.road.potholes:
        east, north, _ = known.surface.place(hole.station_m, hole.offset_m)
        row = found[found["outline"].contains(shapely.Point(float(east), float(north)))].iloc[0]
        radius = np.linspace(0.0, hole.radius_m, 3001)
        share = np.clip((hole.radius_m - radius) / hole.wall_m, 0.0, 1.0)
        depth = hole.depth_m * share * share * (3.0 - 2.0 * share)
        area = np.pi * radius[depth >= 0.008].max() ** 2
        volume = np.trapezoid(2.0 * np.pi * radius * depth, radius)
        for name, true in (("area_m2", area), ("depth_max_m", hole.depth_m), ("volume_m3", volume)):
            assert abs(row[name] - true) < 2.5 * row[f"sigma_{name}"], name
            assert row[name] == pytest.approx(true, rel=0.08)
    assert found["hidden_m2"].max() > 0.01
