"""Drives: the way of one place on the vehicle, whatever sensors record meanwhile and however squares are cut."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from roadscan.assets.tasks.load_returns import load_squares
from roadscan.assets.tasks.plan import AssetPlan, plan_assets
from roadscan.core.survey import Survey
from roadscan.footprints.footprints import footprints_of
from roadscan.georeference.plan.plan import plan_of
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.store.store import Store
from roadscan.survey.run import run_stages
from tests.surveys import changed

FIRST_NS = 1_400_000_000 * 10**9
LENGTH_M, SPEED, UP_M = 200.0, 10.0, 2.0
SILENT_S = (5.0, 15.0)
"""The first sensor records nothing between: over 100 m, in which squares of 20 m see none of its returns."""
ARM_M = 1.0
"""The sensors are mounted so far to the left and to the right of the way of the body."""
_RIG = 'name = "rig"\n' + "".join(
    f'[sensors.{name}]\nkind = "lidar"\naxes = "flu"\nlever_arm_body_m = [0.0, {right}, 0.0]\n'
    for name, right in (("left", -ARM_M), ("right", ARM_M))
)
_SURVEY = """
id = "drives"
rig = "rig.toml"
store = "store"

[map.local]
name = "local"

[tiles]
cell_m = 0.2
size_m = 10.0

[assets.ground]
largest_object_m = 4.0

[[runs]]
id = "run"

[[runs.logs]]
path = "poses.csv"
format = "pose_matrices"
crs = "local"
clock = { system = "gps", unit = "s" }
options = { axes = "flu" }
""" + "".join(
    f'\n[[runs.logs]]\npath = "{name}.parquet"\nformat = "returns_table"\nsensor = "{name}"\n'
    for name in ("left", "right")
)


def returns_of(second: np.ndarray) -> pa.Table:
    """A return on the road to the left of the sensor, and one to its right, at each moment (s)."""
    place = np.tile([[0.0, 3.0, -UP_M], [0.0, -3.0, -UP_M]], (second.size, 1))
    epochs = FIRST_NS + np.rint(np.repeat(second, 2) * 1e9).astype(np.int64)
    names = ("x_sensor_m", "y_sensor_m", "z_sensor_m")
    return pa.table({
        "epoch_gps_ns": epochs, **dict(zip(names, place.T, strict=True)),
        "intensity": np.full(epochs.size, 9000, np.uint16), "laser": np.tile([0, 1], second.size).astype(np.uint8),
    })  # fmt: skip


@pytest.fixture(scope="module")
def survey_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The survey of a straight way to the east, with two lidars, of which the left one is silent for 100 m."""
    folder = tmp_path_factory.mktemp("drives")
    second = np.arange(0.0, LENGTH_M / SPEED, 0.01)
    rows = [f"{FIRST_NS / 1e9 + t:.6f},1,0,0,{SPEED * t:.6f},0,1,0,5.0,0,0,1,{UP_M}" for t in second.tolist()]
    names = "r11,r12,r13,t1,r21,r22,r23,t2,r31,r32,r33,t3"
    (folder / "poses.csv").write_text("\n".join([f"time_s,{names}", *rows]))
    spoke = (second < SILENT_S[0]) | (second >= SILENT_S[1])
    pq.write_table(returns_of(second[spoke]), folder / "left.parquet")
    pq.write_table(returns_of(second), folder / "right.parquet")
    (folder / "rig.toml").write_text(_RIG)
    (folder / "SURVEY.toml").write_text(_SURVEY)
    return folder / "SURVEY.toml"


def plan_with(file: Path, **changes: object) -> AssetPlan:
    """The plan of the survey with some settings changed, each in a store of its own."""
    survey = changed(Survey.load(file), changes)
    store = Store(str(file.parent / f"store-{len(list(file.parent.iterdir()))}"), survey.config.id)
    session = Session(survey, store, Inline())
    run_stages(session, [stage_named("ingest"), stage_named("footprints")])
    return plan_assets(plan_of(session), footprints_of(session))


def drives_of(plan: AssetPlan) -> np.ndarray:
    """Places (p, 4) of the drives in all squares, each in its own square, searched one by one in one task each."""
    found = [np.zeros((0, 4))]
    for square in plan.keys:
        for one in load_squares(plan.load((square,))):
            own = plan.grid.own_box(square).holds(*one.drive_xyh_m[:, :2].T)
            found.append(one.drive_xyh_m[own] + [*one.returns.corner_m, 0.0, 0.0])
    places = np.concatenate(found)
    return places[np.argsort(places[:, 0])]


@pytest.mark.parametrize("tile_m", [20.0, 80.0, 400.0])
def test_a_gap_of_one_sensor_neither_interrupts_nor_moves_the_drive(survey_file: Path, tile_m: float) -> None:
    drive = drives_of(plan_with(survey_file, assets__tile_m=tile_m))
    assert drive[0, 0] < 1.0
    assert drive[-1, 0] > LENGTH_M - 1.0
    assert np.diff(drive[:, 0]).max() <= 0.5 + 1e-6  # the way of one tick
    np.testing.assert_allclose(drive[:, 1], 5.0 + ARM_M, atol=2e-3)  # of the left sensor, also while it is silent
    np.testing.assert_allclose(drive[:, 2], UP_M, atol=2e-3)
    assert np.unique(drive[:, 3]).size == 1


def test_a_square_is_searched_again_where_the_sensor_of_the_drive_is_mounted_anew(survey_file: Path) -> None:
    lever = {"rig__sensors__left__lever_arm_body_m": (0.0, -ARM_M - 0.1, 0.0)}
    before, after = (plan_with(survey_file, assets__tile_m=20.0, **one) for one in ({}, lever))
    assert set(before.keys) == set(after.keys)
    assert all(before.keys[square] != after.keys[square] for square in before.keys)
