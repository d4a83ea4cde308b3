"""Trajectories that a survey's own GNSS, IMU and odometer give, from raw logs to products, against the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from roadscan.core.errors import RoadscanError
from roadscan.core.frames import rotation_from_quaternion
from roadscan.core.survey import Survey
from roadscan.poses.trajectory import Trajectory
from roadscan.run.session import Session
from roadscan.simulate import Scene, simulate
from roadscan.store.logs import NAVIGATION, read_log_records
from roadscan.store.query.sql import query
from roadscan.survey.status import survey_status
from tests.surveys import Simulated, changed, outputs

FEW = {"products__make": ["tile_table"]}
MEASURED = ("imu.csv", "gnss.pos", "encoder.csv")


def navigating_scene(**changes: Any) -> Scene:
    """A stop, a change of speed, one profiler pair at coarse spacing, IMU, RTK and encoder."""
    scene = Scene.load("demo").changed(
        length_m=120.0,
        profilers={"spacing_m": 0.5, "readings": 50},
        lidar={"on": False},
        imu={"on": True, "grade": "tactical"},
        gnss={"on": True},
        encoder={"on": True, "scale_error": 0.004},
        vehicle={"standstill_s": 20.0},
        road={"lead_m": 130.0},
        noise={"position_m": 0.0, "attitude_deg": 0.0},
        passes=[{"lane": 2, "stops": [{"at_m": 60.0, "duration_s": 5.0}]}],
    )
    return scene.changed(**changes) if changes else scene


def without_trajectory(survey_file: Path, *names: str) -> dict[str, Any]:
    """Runs of the survey file with only the logs of these names, and the profilers'."""
    runs = Survey.load(survey_file).config.model_dump()["runs"]
    for run in runs:
        run["logs"] = [log for log in run["logs"] if Path(log["path"]).name in {*names, "profiler_left.parquet"}]
    return {"runs": runs, **FEW}


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    folder = tmp_path_factory.mktemp("driven") / "survey"
    return Simulated(simulate(navigating_scene(), folder).survey_file)


@pytest.fixture(scope="module")
def navigated(driven: Simulated) -> Simulated:
    driven.run(**without_trajectory(driven.survey_file, *MEASURED))
    return driven


def computed(simulated: Simulated, store: str = "store") -> pa.Table:
    (record,) = [r for r in read_log_records(simulated.store(store)) if r.sensor == NAVIGATION]
    files = [simulated.store(store).path(f.path) for f in record.tables["trajectory"]]
    return pa.concat_tables([pq.read_table(f, partitioning=None) for f in files])


def errors_of(simulated: Simulated, rows: pa.Table) -> tuple[np.ndarray, np.ndarray]:
    """Errors of computed poses against the true ones: NED-free position error (n, 3) world m, and angle (n,) rad."""
    truth = pq.read_table(simulated.survey_file.parent / "truth" / "trajectory" / "run-1.parquet")
    columns = {n: truth.column(n).to_numpy() for n in truth.column_names}
    true = Trajectory.of(
        "EPSG:4978",
        columns["epoch_gps_ns"],
        np.stack([columns[f"{a}_world_m"] for a in "xyz"], axis=-1),
        np.stack([columns[q] for q in ("qw", "qx", "qy", "qz")], axis=-1),
    )
    epochs = rows.column("epoch_gps_ns").to_numpy()
    poses = true.poses(epochs)
    position = np.stack([rows.column(f"{a}_world_m").to_numpy() for a in "xyz"], axis=-1)
    turn = rotation_from_quaternion(np.stack([rows.column(q).to_numpy() for q in ("qw", "qx", "qy", "qz")], axis=-1))
    between = np.einsum("nji,njk->nik", poses.world_from_body, turn)
    angle = np.arccos(np.clip((np.trace(between, axis1=1, axis2=2) - 1) / 2, -1, 1))
    return (position - poses.position_world_m)[poses.found], angle[poses.found]


@pytest.mark.slow
def test_a_run_without_a_trajectory_log_computes_its_own(navigated: Simulated) -> None:
    rows = computed(navigated)
    error, angle = errors_of(navigated, rows)
    assert len(error) > 0.95 * rows.num_rows > 1000
    assert np.linalg.norm(error, axis=1).max() < 0.06
    assert np.degrees(np.median(angle)) < 0.1
    sigma = np.linalg.norm([rows.column(f"sigma_{a}_m").to_numpy() for a in ("north", "east", "down")], axis=0)
    assert (sigma > 0.001).all() and np.mean(np.linalg.norm(error, axis=1) < 2.5 * sigma[: len(error)]) > 0.9


@pytest.mark.slow
def test_its_points_and_products_come_out_as_of_any_trajectory(navigated: Simulated) -> None:
    store = navigated.store()
    counted = query(store, "SELECT sum(points) AS n FROM tiles").to_pylist()[0]["n"]
    profiles = query(store, "SELECT count(*) AS n FROM scans").to_pylist()[0]["n"]
    assert 0.995 * 50 * profiles < counted <= 50 * profiles  # some readings are dropouts
    assert store.read_bytes("products/navigation/run-1.png")[:8] == b"\x89PNG\r\n\x1a\n"
    kinds = {r["kind"] for r in query(store, "SELECT DISTINCT kind FROM innovations").to_pylist()}
    assert "gnss position" in kinds and "odometer" in kinds
    states = query(store, "SELECT state, axis, value, sigma FROM navigation_states ORDER BY epoch_gps_ns").to_pylist()
    scale = [s for s in states if "odometer_scale" in s["state"]][-1]
    assert scale["sigma"] < 0.001
    assert abs(scale["value"] + 0.004) < 4 * scale["sigma"]  # the wheel gives more ticks a metre than stated


@pytest.mark.slow
def test_a_second_run_computes_nothing_and_changes_nothing(navigated: Simulated) -> None:
    before = outputs(navigated.store())
    run = navigated.run(**without_trajectory(navigated.survey_file, *MEASURED))
    assert any("known" in line and NAVIGATION in line for line in run.reporter.lines)
    assert outputs(navigated.store()) == before


@pytest.mark.slow
def test_another_rig_makes_another_trajectory_and_the_old_one_is_kept_aside(navigated: Simulated) -> None:
    runs = without_trajectory(navigated.survey_file, *MEASURED)
    navigated.run("store-2", **runs)
    first = computed(navigated, "store-2")
    rig = Survey.load(navigated.survey_file).rig.model_dump()
    rig["sensors"]["gnss"]["lever_arm_body_m"] = (-0.4, 0.1, -1.7)
    navigated.run("store-2", **runs, rig=rig)
    second = computed(navigated, "store-2")
    assert not first.equals(second)
    assert navigated.store("store-2").files("superseded/tables/trajectory", ".parquet")


@pytest.mark.slow
def test_same_logs_same_bytes(navigated: Simulated) -> None:
    navigated.run("store-3", **without_trajectory(navigated.survey_file, *MEASURED))
    assert computed(navigated).equals(computed(navigated, "store-3"))


@pytest.mark.slow
def test_solve_always_prefers_the_computed_one(driven: Simulated) -> None:
    driven.run("store-4", navigation__solve="always", **FEW)
    logged = [r for r in read_log_records(driven.store("store-4")) if r.format == "sbet"]
    assert len(logged) == 1
    assert computed(driven, "store-4").equals(computed(driven)) or len(computed(driven, "store-4")) > 1000


@pytest.mark.slow
def test_an_imu_without_stated_errors_is_refused(driven: Simulated) -> None:
    rig = Survey.load(driven.survey_file).rig.model_dump()
    rig["sensors"]["imu"]["imu"] = None
    with pytest.raises(RoadscanError, match='imu = "mems"'):
        driven.run("store-5", **without_trajectory(driven.survey_file, *MEASURED), rig=rig)


@pytest.mark.slow
def test_solve_never_says_what_is_missing(driven: Simulated) -> None:
    with pytest.raises(RoadscanError, match="no trajectory"):
        driven.run("store-6", **without_trajectory(driven.survey_file, *MEASURED), navigation__solve="never")


def with_spline(**settings: Any) -> dict[str, Any]:
    """Settings of a run whose trajectory logs are smoothed."""
    return {"navigation__spline": {"on": True, **settings}, **FEW}


@pytest.mark.slow
def test_a_sound_trajectory_log_stays_as_it_is(driven: Simulated) -> None:
    driven.run("store-log", **FEW)
    driven.run("store-spline", **with_spline())
    logged, smooth = outputs(driven.store("store-log")), outputs(driven.store("store-spline"))
    assert logged == smooth
    (record,) = [r for r in read_log_records(driven.store("store-spline")) if r.sensor == NAVIGATION]
    assert (record.format, record.attributes["poses_changed"]) == ("spline", 0)


@pytest.mark.slow
def test_a_short_gap_of_a_trajectory_log_is_filled_where_that_is_wanted(navigated: Simulated, tmp_path: Path) -> None:
    copy = navigated.copy_to(tmp_path / "survey")
    (log,) = (copy.survey_file.parent / "raw" / "run-1").glob("*.sbet")
    records = np.fromfile(log, dtype="<f8").reshape(-1, 17)
    epochs = query(navigated.store(), "SELECT epoch_gps_ns AS t FROM scans ORDER BY t").column("t").to_numpy()
    begin = epochs[epochs.size // 4] * 1e-9 % 604_800
    records[(records[:, 0] < begin) | (records[:, 0] > begin + 1.5)].tofile(log)

    def fates(store: str) -> dict[str, int]:
        return survey_status(Session(Survey.load(copy.survey_file), copy.store(store))).readings

    copy.run("gap", **FEW)
    run = copy.run("filled", **with_spline(fill_gap_s=3.0))
    assert fates("gap").get("no_pose", 0) > 100
    survey = changed(Survey.load(copy.survey_file), with_spline(fill_gap_s=3.0))
    assert survey_status(Session(survey, copy.store("filled"))).readings.get("no_pose", 0) == 0
    assert any("gap (" in line and "filled in" in line for line in run.reporter.lines)
    error, _ = errors_of(copy, computed(copy, "filled"))
    assert np.linalg.norm(error, axis=1).max() < 0.15
