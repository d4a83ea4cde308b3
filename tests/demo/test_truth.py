"""Readings placed by the pipeline against where the simulator's beams hit: two codes that share no geometry."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from roadscan.core.survey import Survey
from roadscan.demo.demo import summarise
from roadscan.georeference.place import EVERYWHERE
from roadscan.georeference.plan.plan import plan_survey
from roadscan.georeference.sources import Georeferencer
from roadscan.ingest.ingest import ingest
from roadscan.simulate import simulate, truth
from roadscan.store.store import Store
from tests.surveys import Simulated, small_scene


@pytest.fixture(scope="module")
def noiseless(tmp_path_factory: pytest.TempPathFactory) -> Path:
    scene = small_scene(lidar={"range_max_m": 12.0}).noiseless()
    return simulate(scene, tmp_path_factory.mktemp("noiseless") / "survey", write_hits=True).survey_file


def test_every_reading_lies_where_its_beam_hit(noiseless: Path) -> None:
    survey = Survey.load(noiseless)
    store = Store(survey.store_url, survey.config.id)
    ingest(survey, store)
    plan = plan_survey(survey, store)
    true = truth.load(noiseless.parent)
    quanta = plan.ground.grid.size_quanta
    for source, files in plan.sources:
        slices = [s for s in plan.slices() if s.source is source]
        assert len(files) == len(slices)
        placer = Georeferencer(store, plan.ground, slices)
        placed = [p for one in slices for _, p in placer.place(one, EVERYWHERE)]
        tiles = np.concatenate([p.tiles for p in placed]).astype(np.int64)
        own = np.concatenate([p.quanta for p in placed])
        found = np.column_stack([tiles * quanta + own[:, :2], own[:, 2]]) * 1e-5
        hits = pq.read_table(true.hits_file(source.run, source.sensor))
        columns = [hits.column(c).combine_chunks() for c in ("easting_m", "northing_m", "height_m")]
        flat = [c.flatten() if source.table == "scans" else c for c in columns]
        expected = np.stack([c.to_numpy(zero_copy_only=False) for c in flat], axis=-1)
        expected = expected[np.isfinite(expected).all(axis=1)]
        assert len(found) == len(expected) > 1000
        worst = np.abs(found - expected).max()
        # Rounding of the logs: range steps of 0.05 mm (profilers); 2 mm and 0.01° at 12 m (lidar).
        assert worst < (0.1e-3 if source.table == "scans" else 1.5e-3), (source.run, source.sensor, worst)


def test_surface_equals_the_truth(finished: Simulated) -> None:
    summary = summarise(finished.survey_file)
    assert summary.tiles > 10
    assert np.abs(np.median(summary.height_error_m)) < 0.003
    assert np.percentile(np.abs(summary.height_error_m), 95) < 0.03
