"""Faults of concrete joints, of kerbs that are crossed and of bridge joints, from raw logs to the table of values."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from benchmarks.bench_lanes import rough_scene
from roadscan.cli import app
from roadscan.simulate import simulate
from roadscan.store.query.sql import query
from roadscan.store.store import Store

SLAB_M = 5.0
FAULTS_MM = (6.0, 0.0, -1.5, 2.0, -4.0, 1.0)
"""Of the joints at stations 40, 45 … in the direction of travel; then they begin again."""
BEGIN_M, END_M, LAST_M = 40.0, 115.0, 130.0
BEFORE_M = 10.0
"""The drive begins so far before station 0 of the scene: stations of the reference line count from there."""


def faults_mm() -> np.ndarray:
    """Faults of all joints, as slabs of the simulated road stand."""
    faults = np.resize(FAULTS_MM, round((END_M - BEGIN_M) / SLAB_M))
    return np.append(faults, -faults.sum())  # behind the last slab lies the road itself


@pytest.fixture(scope="module")
def slabs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A road of slabs that stand at different heights, with 1 % wrong and 2 % lost readings."""
    folder = tmp_path_factory.mktemp("slabs") / "survey"
    height = -np.cumsum(faults_mm()[:-1])  # a positive fault: the departure slab is lower
    patches = [
        {"station_m": BEGIN_M + SLAB_M * (k + 0.5), "offset_m": 1.75, "length_m": SLAB_M, "width_m": 3.6,
         "height_m": 1e-3 * float(one), "edge_m": 0.01}
        for k, one in enumerate(height)
        if one
    ]  # fmt: skip
    noise = {"profiler_range_m": 0.0003, "dropout": 0.02, "impulse": 0.01, "position_m": 0.0}
    scene = rough_scene(
        0.8, LAST_M, passes=[{"lane": 2, "speed_m_per_s": 22.2}], noise=noise, seed=5,
        road={"patches": patches, "ruts": [], "alignment": [{"kind": "straight", "length_m": 200.0}]},
        profilers={"spacing_m": 0.05, "readings": 200},
    )  # fmt: skip
    simulate(scene, folder)
    return folder


def values(folder: Path, **condition: float) -> pd.DataFrame:
    """Values of the index `faulting` of a run with these settings."""
    file = folder / "SURVEY.toml"
    plain = file.read_text().split("[condition]")[0]
    settings = "".join(f"{name} = {value}\n" for name, value in condition.items())
    file.write_text(f"{plain}[condition]\n{settings}")
    outcome = CliRunner().invoke(app, ["run", str(file)])
    assert outcome.exit_code == 0, outcome.output
    store = Store(str(folder / "store"), "rough")
    return query(
        store, "SELECT * FROM condition_values WHERE \"index\" = 'faulting' ORDER BY station_from_m"
    ).to_pandas()


@pytest.mark.slow
def test_every_joint_of_the_spacing_counts_in_the_mean_with_its_sign(slabs: Path) -> None:
    """Faults of LTPP's sign: positive where the approach slab is higher."""
    found = values(slabs, joint_spacing_m=SLAB_M, section_m=200.0)
    for side in ("left", "right"):
        one = found[found["quantity"] == f"step_{side}_mm"]
        first = one["station_from_m"][one["value"] > 4.0].iloc[0]
        own = one[(one["station_from_m"] > first - 1.0) & (one["station_from_m"] < first + END_M - BEGIN_M + 1.0)]
        assert len(own) == faults_mm().size
        error = own["value"].to_numpy() - faults_mm()
        assert np.abs(error).max() < 1.0
        assert np.median(np.abs(error)) < 0.4
        assert (np.abs(error) < 4.0 * own["sigma"].to_numpy() + 0.5).all()  # the road between joints is not even
    (mean,) = found[found["quantity"] == "faulting_mean_mm"].to_dict("records")
    (joints,) = found[found["quantity"] == "joints"].to_dict("records")
    # Before and behind the faulted slabs the joints of the spacing are level, but for the road's unevenness.
    level = joints["value"] - faults_mm().size
    assert mean["value"] == pytest.approx(np.abs(faults_mm()).sum() / (faults_mm().size + level), abs=0.5)
    assert joints["value"] >= 24 and "by spacing" in joints["reason"]


@pytest.mark.slow
def test_without_a_spacing_only_steps_are_joints_and_this_is_told(slabs: Path) -> None:
    found = values(slabs, section_m=200.0)
    steps = found[found["quantity"] == "step_left_mm"]["value"].to_numpy()
    assert (np.abs(steps) >= 3.0).all()
    large = faults_mm()[np.abs(faults_mm()) > 3.0]
    assert np.sign(steps).tolist() == np.sign(large).tolist()
    (joints,) = found[found["quantity"] == "joints"].to_dict("records")
    assert joints["reason"] == f"joints are known: {len(large)} by steps; those with less than 3 mm are not found"
