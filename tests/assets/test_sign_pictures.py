"""Signs found in returns and read in pictures: a simulated street with a sign of each shape and colour."""

from __future__ import annotations

import json
from pathlib import Path

import geopandas
import numpy as np
import pytest

import roadscan
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.simulate import Scene, simulate, truth
from roadscan.store.store import Store
from roadscan.survey.run import run_stages
from tests.surveys import Lines, changed

SIGNS = [
    {"station_m": 12.0, "offset_m": 5.0, "shape": "octagon", "width_m": 0.75, "colour": "red", "rim": "white",
     "text": "STOP"},
    {"station_m": 18.0, "offset_m": -5.0, "shape": "round", "width_m": 0.6, "colour": "blue"},
    {"station_m": 22.0, "offset_m": 5.0, "shape": "triangle", "width_m": 0.9, "colour": "white", "rim": "red"},
    {"station_m": 27.0, "offset_m": -5.2, "shape": "diamond", "width_m": 0.75, "colour": "yellow"},
    {"station_m": 31.0, "offset_m": 5.0, "shape": "rectangle", "width_m": 0.6, "height_m": 0.9, "text": "50"},
    {"station_m": 35.0, "offset_m": -5.0, "shape": "rectangle", "width_m": 1.4, "height_m": 0.6, "colour": "green",
     "text": "ZURICH"},
    {"station_m": 39.0, "offset_m": 5.2, "shape": "round", "width_m": 0.6, "rim": "red", "text": "30"},
    {"station_m": 43.0, "offset_m": -5.0, "shape": "rectangle", "width_m": 1.0, "height_m": 0.5, "colour": "brown",
     "text": "PARK"},
]  # fmt: skip
COLOURS = ["red", "blue", "red", "yellow", "white", "green", "red", "brown"]
SCENE = Scene.load("demo").changed(
    length_m=50.0, passes=[{"lane": 2, "direction": "forward"}], profilers={"on": False},
    lidar={"range_max_m": 30.0}, vehicle={"speed_m_per_s": 8.0},
    road={"markings": [{"offset_m": 0.0, "width_m": 0.12, "colour": "yellow"}, {"offset_m": 3.2, "width_m": 0.12},
                       {"offset_m": -3.2, "width_m": 0.12}]},
    roadside={"signs": SIGNS, "facades": [{"offset_m": -9.0, "start_m": -5.0, "end_m": 14.0, "height_m": 9.0}],
              "trees": [{"station_m": 26.0, "offset_m": 8.0, "height_m": 7.0}],
              "parked_cars": [{"station_m": 6.0, "offset_m": 4.4}]},
    camera={"on": True, "colour": True, "every_m": 3.0,
            "mount": {"lever_arm_body_m": [0.9, -0.25, -1.15], "pitch_deg": -2.0}},
)  # fmt: skip


@pytest.mark.nightly
@pytest.mark.timeout(1800)
def test_signs_of_a_street_are_found_named_and_read(tmp_path: Path) -> None:
    file = simulate(SCENE, tmp_path / "survey").survey_file
    assets = {"kinds": ["sign", "lane_line"], "classified": False, "bare_earth": False}
    survey = changed(roadscan.open_survey(file).survey, {"assets": assets})
    own = Session(survey, Store(str(tmp_path / "store"), survey.config.id), Inline(), None, Lines())
    run_stages(own, [stage_named(name) for name in ("ingest", "navigate", "footprints", "assets")])
    known = truth.load(tmp_path / "survey")
    place = np.array([known.surface.place(np.array([s["station_m"]]), s["offset_m"])[:2] for s in SIGNS])[:, :, 0]
    table = geopandas.read_parquet(own.store.path("products/assets/road_signs.parquet"))
    away = np.hypot(*(table[["easting_m", "northing_m"]].to_numpy()[:, None] - place).transpose(2, 0, 1))
    assert len(table) == len(SIGNS) and away.min(axis=0).max() < 0.06
    signs = table.iloc[away.argmin(axis=0)].reset_index(drop=True)
    assert signs["colour"].tolist() == COLOURS
    assert signs["shape"].tolist() == [s["shape"] for s in SIGNS]
    assert signs["plate_height_m"].to_numpy() == pytest.approx(
        [0.75, 0.6, 0.9 * 0.866, 0.75, 0.9, 0.6, 0.6, 0.5], abs=0.05
    )
    assert signs["type"][0] in ("vienna:B2a mutcd:R1-1", "unknown") and signs["type"][6] in ("vienna:C14-30", "unknown")
    assert (signs["type"][[1, 2, 3, 4, 5, 7]] == "unknown").all()
    assert all(1 <= len(json.loads(named)) <= 3 for named in signs["pictures"])
    lines = geopandas.read_parquet(own.store.path("products/assets/lane_lines.parquet"))
    long = lines[lines["length_m"] > 30.0]
    assert sorted(long["colour"]) == ["white", "white", "yellow"]
