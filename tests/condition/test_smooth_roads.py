"""Roughness of smooth and rough roads of whose readings 1 % are wrong and 2 % lost, from raw logs to the section table.

True values come from the simulator's true surface along the profiles, by the sample program of ASTM E1926.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from benchmarks.bench_lanes import rough_scene
from roadscan.cli import app
from roadscan.simulate import simulate, truth
from roadscan.store.query.sql import query
from roadscan.store.store import Store
from tests.condition.test_spacing_and_severe_places import e1926

LENGTH_M = 230.0


def sections(folder: Path, iri_m_per_km: float, seed: int, **scene: object) -> pd.DataFrame:
    """The section table beside the true roughness, of a survey that `roadscan run` made."""
    noise = {"profiler_range_m": 0.0003, "dropout": 0.02, "impulse": 0.01}
    settings: dict[str, object] = {
        "seed": seed, "passes": [{"lane": 2, "speed_m_per_s": 22.2}], "noise": noise | {"position_m": 0.0},
        "profilers": {"spacing_m": 0.05, "readings": 200},
    }  # fmt: skip
    simulate(rough_scene(iri_m_per_km, LENGTH_M, **(settings | scene)), folder)
    file = folder / "SURVEY.toml"
    file.write_text(file.read_text() + "\n[condition]\n")
    outcome = CliRunner().invoke(app, ["run", str(file)])
    assert outcome.exit_code == 0, outcome.output
    store = Store(str(folder / "store"), "rough")
    found = query(store, "SELECT * FROM condition_sections ORDER BY station_from_m").to_pandas()
    found = found[found["mri_m_per_km"].notna() & (found["station_to_m"] - found["station_from_m"] > 80.0)]
    known = truth.load(folder)
    heights = query(store, "SELECT * FROM profiles_longitudinal ORDER BY station_m").to_pandas()
    true = {}
    for side in ("left", "right"):
        own = heights[heights["path"] == side]
        height = known.surface.height_m(own["easting_m"].to_numpy(), own["northing_m"].to_numpy(), texture=False)
        first = float(own["station_m"].iloc[0])
        true[side] = [
            e1926(height, 0.05, a - first, b - first)
            for a, b in zip(found["station_from_m"], found["station_to_m"], strict=True)
        ]
    found["true_m_per_km"] = np.mean([true["left"], true["right"]], axis=0)
    return found


def errors_within_the_bar(found: pd.DataFrame) -> None:
    """MRI within 2 % or 0.03 m/km, and within its σ; a ride number with it."""
    error = (found["mri_m_per_km"] - found["true_m_per_km"]).abs()
    assert len(found) >= 2
    assert (error <= np.maximum(0.02 * found["true_m_per_km"], 0.03)).all()
    assert (error <= 3.0 * found["sigma_mri_m_per_km"]).all()
    assert (found["sigma_mri_m_per_km"] <= 0.03).all()
    assert found["ride_number"].notna().all()
    assert (found["sigma_ride_number"] < 0.4).all()


@pytest.mark.slow
def test_a_smooth_road_with_wrong_and_lost_readings(tmp_path: Path) -> None:
    errors_within_the_bar(sections(tmp_path / "survey", 0.8, 31))


@pytest.mark.nightly
@pytest.mark.parametrize("seed", [41, 42])
@pytest.mark.parametrize("iri_m_per_km", [0.9, 1.8, 3.3])
def test_other_roads_with_wrong_and_lost_readings(iri_m_per_km: float, seed: int, tmp_path: Path) -> None:
    """Levels and seeds that nothing was tuned on."""
    errors_within_the_bar(sections(tmp_path / "survey", iri_m_per_km, seed))
