"""Roughness regions through the pipeline, on a simulated road with dark patches."""

from __future__ import annotations

from pathlib import Path

import geopandas
import numpy as np
import pytest
import shapely

from benchmarks.bench_lanes import RoughSurvey, rough_scene, run
from roadscan.jobs.condition import roughness_regions
from roadscan.jobs.condition.work import plan_condition
from roadscan.jobs.session import Session
from roadscan.jobs.stage import stage_named
from roadscan.tables.sql import query

LEAD_M = 10.0
"""The reference line begins before the road's station 0."""
PATCHES = [(22.0, 1.2, 2.0, 1.0), (43.0, 2.4, 1.0, 0.8), (30.5, 1.75, 1.5, 1.2)]
"""Station and offset of the middles, length and width; the last lies on the border of two sections."""
SETTINGS = {"cell_m": 0.08, "least_density_per_m2": 25.0}


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory: pytest.TempPathFactory) -> RoughSurvey:
    patches = [
        {"station_m": s, "offset_m": o, "length_m": a, "width_m": b, "height_m": -0.006, "shade": 30.0}
        for s, o, a, b in PATCHES
    ]
    scene = rough_scene(
        2.0, 60.0, passes=[{"lane": 2, "speed_m_per_s": 22.2}], road={"patches": patches},
        profilers={"spacing_m": 0.04, "readings": 400},
    )  # fmt: skip
    made = RoughSurvey.made(scene, tmp_path_factory.mktemp("regions") / "survey")
    run(opened(made))
    return made


def opened(made: RoughSurvey) -> Session:
    return made.session("store", section_m=50.0, roughness_regions=SETTINGS)


def read(session: Session) -> geopandas.GeoDataFrame:
    import pandas as pd

    files = [r.path for r in session.manifest.of("roughness_regions").values() if r.path]
    parts = [geopandas.read_parquet(Path(str(session.store.root)) / f) for f in sorted(files)]
    return geopandas.GeoDataFrame(pd.concat(parts, ignore_index=True))


def test_patches_are_in_the_table(surveyed: RoughSurvey) -> None:
    session = opened(surveyed)
    assert session.manifest.of("roughness_regions")
    table = read(session)
    assert table.crs.to_epsg() == 32632
    print(table.drop(columns="outline").T.to_string())
