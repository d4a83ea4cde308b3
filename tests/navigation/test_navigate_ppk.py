"""A run whose receiver recorded raw observations: post-processed, then smoothed with the IMU, against the truth."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from roadscan.core.survey import Survey
from roadscan.simulate import simulate
from roadscan.store.query.sql import query
from tests.formats.gnss_observations import Sky, navigation, observe, rinex2
from tests.navigation.test_navigate import computed, errors_of, navigating_scene, without_trajectory
from tests.surveys import Simulated

pytestmark = pytest.mark.skipif(
    shutil.which("rnx2rtkp") is None, reason="RTKLIB is not on PATH: apt-get install rtklib"
)

BASE_AWAY_M = 400.0
"""On the level of the rover: the simulated troposphere does not change with height."""
RATE_HZ = 5


def antenna_path(survey_file: Path) -> tuple[np.ndarray, np.ndarray]:
    """True epochs (GPS s) and geocentric positions of the antenna."""
    truth = pq.read_table(survey_file.parent / "truth" / "trajectory" / "run-1.parquet").to_pandas()
    w, x, y, z = (truth[q].to_numpy() for q in ("qw", "qx", "qy", "qz"))
    a, b, c = Survey.load(survey_file).rig.sensors["gnss"].lever_arm_body_m
    turned = [
        (1 - 2 * (y * y + z * z)) * a + 2 * (x * y - w * z) * b + 2 * (x * z + w * y) * c,
        2 * (x * y + w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z - w * x) * c,
        2 * (x * z - w * y) * a + 2 * (y * z + w * x) * b + (1 - 2 * (x * x + y * y)) * c,
    ]
    places = truth[["x_world_m", "y_world_m", "z_world_m"]].to_numpy() + np.stack(turned, axis=-1)
    return truth["epoch_gps_ns"].to_numpy() / 1e9, places


def write_raw(folder: Path, seconds: np.ndarray, places: np.ndarray) -> dict[str, Any]:
    """Observations of rover and base, and orbits; the settings that say where the base is."""
    first = int(np.ceil(seconds[0]))
    sky = Sky(first // 604_800, first % 604_800)
    times = np.arange(0.0, np.floor(seconds[-1]) - first, 1.0 / RATE_HZ)

    def rover(t: float) -> np.ndarray:
        return np.array([np.interp(first + t, seconds, places[:, k]) for k in range(3)])

    east = np.cross([0.0, 0.0, 1.0], places[0])
    mark = places[0] + BASE_AWAY_M * east / np.linalg.norm(east)
    (folder / "rover.obs").write_text(rinex2(observe(rover, times, 1, sky), places[0], sky=sky))
    (folder / "base.obs").write_text(rinex2(observe(lambda t: mark, times[::RATE_HZ], 2, sky), mark, sky=sky))
    (folder / "brdc.nav").write_text(navigation(sky))
    position = dict(zip(("x_m", "y_m", "z_m"), mark.tolist(), strict=True))
    base = {"files": ["raw/base.obs"], "crs": "EPSG:4978", "epoch": 2026.0, "antenna_height_m": 0.0, **position}
    return {"base": base, "navigation": ["raw/brdc.nav"]}


@pytest.mark.slow
def test_raw_observations_become_a_trajectory(tmp_path: Path) -> None:
    simulated = Simulated(simulate(navigating_scene(), tmp_path / "survey").survey_file)
    raw = simulated.survey_file.parent / "raw"
    ppk = write_raw(raw, *antenna_path(simulated.survey_file))
    settings = without_trajectory(simulated.survey_file, "imu.csv", "encoder.csv")
    settings["runs"][0]["logs"].append({"path": "raw/rover.obs", "format": "ppk", "sensor": "gnss"})
    session = simulated.run(**settings, navigation__ppk=ppk)
    kinds = query(simulated.store(), "SELECT DISTINCT quality FROM gnss").to_pylist()
    assert kinds == [{"quality": "fixed"}]
    error, angle = errors_of(simulated, computed(simulated))
    assert np.linalg.norm(error, axis=1).max() < 0.06 and np.degrees(np.median(angle)) < 0.1
    again = simulated.run(**settings, navigation__ppk=ppk)
    assert any(line.startswith("known: run-1/gnss") for line in again.reporter.lines)  # type: ignore[attr-defined]
    assert any(line.startswith("read: run-1/gnss") for line in session.reporter.lines)  # type: ignore[attr-defined]
