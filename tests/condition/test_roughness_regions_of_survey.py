"""Roughness regions through the pipeline, on a simulated road with dark patches."""

from __future__ import annotations

import shutil
from pathlib import Path

import geopandas
import numpy as np
import pandas as pd
import pytest
import shapely

from benchmarks.bench_lanes import RoughSurvey, rough_scene, run
from roadscan.condition.tasks import roughness_regions
from roadscan.condition.tasks.work import plan_condition
from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.store.query.sql import query

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
    files = [r.path for r in session.manifest.of("roughness_regions").values() if r.path]
    parts = [geopandas.read_parquet(Path(str(session.store.root)) / f) for f in sorted(files)]
    return geopandas.GeoDataFrame(pd.concat(parts, ignore_index=True))


@pytest.mark.slow
def test_regions_are_the_patches_that_were_laid(surveyed: RoughSurvey) -> None:
    """The last patch lies on the border of two sections, which cut it in two."""
    session = opened(surveyed)
    table = read(session)
    assert table.crs.to_epsg() == 32632
    true = [shapely.box(s + LEAD_M - a / 2, o - b / 2, s + LEAD_M + a / 2, o + b / 2) for s, o, a, b in PATCHES]
    assert table["station_m"].tolist() == pytest.approx([32.0, 39.88, 40.62, 53.0], abs=0.08)
    assert table["offset_m"].tolist() == pytest.approx([1.2, 1.75, 1.75, 2.4], abs=0.05)
    areas = table["area_m2"].to_numpy()
    laid = [true[0].area, true[2].area, true[1].area]
    assert [areas[0], areas[1] + areas[2], areas[3]] == pytest.approx(laid, rel=0.1)
    assert (table["contrast"] > 0.4).all()
    assert np.allclose(table.geometry.area, areas, rtol=1e-9)


@pytest.mark.slow
def test_tables_and_picture(surveyed: RoughSurvey) -> None:
    session = opened(surveyed)
    sections = query(session.store, "SELECT * FROM roughness_sections ORDER BY station_from_m").to_pandas()
    assert sections["regions"].sum() == 4
    assert (sections["least_density_per_m2"] == SETTINGS["least_density_per_m2"]).all()
    measured = sections[sections["measured_m2"] > 1.0]
    assert (measured["dim_below"] < measured["bright_above"]).all()
    assert query(session.store, "SELECT count(*) FROM roughness_regions WHERE contrast > 0.4")[0][0].as_py() == 4
    pictures = [r.path for r in session.manifest.of("roughness_pictures").values() if r.path]
    assert len(pictures) == 1
    assert stage_named("condition").state(session).stale == 0


@pytest.mark.slow
def test_the_pieces_change_no_bit_and_settings_make_them_due(
    surveyed: RoughSurvey, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = tmp_path / "survey"
    shutil.copytree(surveyed.file.parent, copy)
    session = opened(RoughSurvey(copy / surveyed.file.name))
    before = read(session)
    other = RoughSurvey(copy / surveyed.file.name).session(
        "store", section_m=50.0, roughness_regions={**SETTINGS, "least_contrast": 0.9}
    )
    assert len(plan_condition(other).due_pieces) == len(plan_condition(session).pieces) == 1
    monkeypatch.setattr(roughness_regions, "_PIECE_SECTIONS", 2)
    assert len(plan_condition(session).due_pieces) > 1
    stage_named("condition").run(session)
    assert session.failures == []
    after = read(session).sort_values("station_m", ignore_index=True)
    assert after.to_wkb().equals(before.to_wkb())
    bare = RoughSurvey(copy / surveyed.file.name).session("store", section_m=50.0)
    stage_named("condition").run(bare)
    assert not bare.manifest.of("roughness_regions")
