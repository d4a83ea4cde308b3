"""The stage `assets` of a street: the same bytes by one process, by two workers, and after runs that were killed."""

from __future__ import annotations

import random
import subprocess
import sys
from pathlib import Path

import pytest

from roadscan.run.engine.compute_on import embedded
from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.simulate import Scene, simulate
from roadscan.store.store import Store
from roadscan.survey.status import verify_store
from tests.conftest import REPOSITORY
from tests.surveys import Simulated

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(1800)]
KILLS = 5
LONGEST_S = 20.0
"""Processor time after which a run is killed."""
SCENE = Scene.load("urban_street").changed(
    length_m=16.0, road={"lead_m": 90.0}, passes=[{"lane": 2}],
    lidar={"range_max_m": 20.0}, vehicle={"speed_m_per_s": 14.0},
    **{key: {"on": False} for key in ("profilers", "sick", "camera", "imu", "gnss", "encoder")},
    roadside={"signals": [{"station_m": 9.0, "offset_m": 5.8}], "moving_cars": []},
)  # fmt: skip


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    """16 m of the town street, run once in this process."""
    file = simulate(SCENE, tmp_path_factory.mktemp("street") / "survey").survey_file
    with file.open("a") as stream:
        stream.write("\n[adjust]\non = false\n\n[assets]\ntile_m = 20.0\n")
    made = Simulated(file)
    made.run()
    return made


def asset_files(store: Store) -> dict[str, bytes]:
    """All that the stage made."""
    return {path: store.read_bytes(path) for folder in stage_named("assets").folders() for path in store.files(folder)}


def test_two_workers_change_no_bit(street: Simulated) -> None:
    with embedded(2) as cluster:
        run: Session = street.run("store-two", cluster)
    assert not run.failures
    whole = asset_files(street.store())
    assert {name.rpartition(".")[2] for name in whole} >= {"parquet", "gpkg", "geojson", "dxf", "laz", "tif"}
    assert asset_files(street.store("store-two")) == whole


def test_killed_runs_change_no_bit(street: Simulated, tmp_path: Path) -> None:
    copy = street.copy_to(tmp_path / "survey")
    command = [sys.executable, "-m", "tests.survey.killed_run", "run", str(copy.survey_file), "--workers", "0"]
    chance, kills = random.Random(23), 0
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=REPOSITORY) as runs:
        assert runs.stdin is not None and runs.stdout is not None
        while kills < KILLS:
            print(chance.uniform(2.0, LONGEST_S), file=runs.stdin, flush=True)
            if (ended := runs.stdout.readline().strip()) == "killed":
                kills += 1
                continue
            assert ended == "0"
            copy.store().remove("manifest/outputs")  # finished too soon: begin again, to be killed so many times in all
        print(1e9, file=runs.stdin, flush=True)
        assert runs.stdout.readline().strip() == "0"
        runs.stdin.close()
    assert asset_files(copy.store()) == asset_files(street.store())
    assert verify_store(copy.store()) == []
