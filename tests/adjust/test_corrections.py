"""Clocks and mountings that were estimated are small tables: readings are placed by them without a second ingest."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from roadscan.core.errors import DamagedError
from roadscan.core.frames import quaternion_from_rotation
from roadscan.core.survey import Survey
from roadscan.georeference.plan.plan import plan_survey
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Session
from roadscan.run.stage import stages
from roadscan.simulate import simulate
from roadscan.store.query.sql import query
from roadscan.store.schema import table_schema
from roadscan.store.small_tables import read_small, small_path, write_small
from roadscan.store.store import Store
from roadscan.survey.run import run_stages
from tests.surveys import Simulated, changed, outputs, small_scene

SHORT = {"length_m": 12.0, "lidar": {"on": False}, "passes": [{"lane": 2}]}
PRODUCTS = {"products__make": ["las", "tile_table"]}


@pytest.fixture(scope="module")
def right(tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    made = Simulated(simulate(small_scene(**SHORT), tmp_path_factory.mktemp("right") / "survey").survey_file)
    made.run(**PRODUCTS)
    return made


def clock_row(sensor: str, offset_s: float, drift_ppm: float, reference_gps_ns: int) -> dict[str, Any]:
    zero = dict.fromkeys(("sigma_offset_s", "sigma_drift_ppm", "correlation", "rms_s"), 0.0)
    none = dict.fromkeys(("residuals", "refused", "first_gps_ns", "last_gps_ns"), 0)
    return {
        **zero, **none, "run": "*", "sensor": sensor, "applied": "epochs", "offset_s": offset_s,
        "drift_ppm": drift_ppm, "reference_gps_ns": reference_gps_ns, "method": "pairs", "estimated_at": "",
        "estimate": "",
    }  # fmt: skip


@pytest.mark.slow
def test_an_estimated_clock_puts_readings_where_a_right_one_does(right: Simulated, tmp_path: Path) -> None:
    late = {"offset_s": 0.5, "drift_ppm": 40.0}
    scene = small_scene(**SHORT).changed(profilers={"clock": late})
    wrong = Simulated(simulate(scene, tmp_path / "survey").survey_file)
    wrong.run(**PRODUCTS)
    before, expected = outputs(wrong.store()), outputs(right.store())
    assert before.keys() != expected.keys() or before != expected
    rows = query(
        right.store(), "SELECT min(epoch_gps_ns) AS first FROM scans WHERE sensor = 'profiler_left'"
    ).to_pylist()
    start = rows[0]["first"]
    # stamp = true + 0.5 s + 40 ppm · (true − start): what has to be added to a stamp.
    drift = -40.0 / (1.0 + 40e-6)
    reference = start + 500_000_000
    table = [clock_row(s, -0.5, drift, reference) for s in ("profiler_left", "profiler_right")]
    write_small(wrong.store(), "clocks", table)
    # The stage `navigate` would take the rows away: the survey file names no evidence for them.
    survey = changed(Survey.load(wrong.survey_file), PRODUCTS)
    run_stages(Session(survey, wrong.store(), Inline()), [s for s in stages() if s.name != "navigate"])
    totals = [
        query(one.store(), "SELECT sum(points) AS n, avg(height_mean_m) AS h, min(first_epoch_gps_ns) AS a FROM tiles")
        for one in (wrong, right)
    ]
    mended, truth = (t.to_pylist()[0] for t in totals)
    assert mended["n"] == truth["n"]
    assert abs(mended["a"] - truth["a"]) < 2_000
    assert mended["h"] == pytest.approx(truth["h"], abs=2e-5)


def test_a_calibrated_mounting_holds_from_its_epoch_on(right: Simulated) -> None:
    store = right.store()
    rig = Survey.load(right.survey_file).rig
    span = query(store, "SELECT min(epoch_gps_ns) AS a, max(epoch_gps_ns) AS b FROM scans").to_pylist()[0]
    middle = (span["a"] + span["b"]) // 2
    rotation, lever = rig.sensors["profiler_left"].mounting().arrays()
    q = quaternion_from_rotation(rotation)
    row = {
        "run": "*", "sensor": "profiler_left", "valid_from_gps_ns": middle, "lever_forward_m": lever[0],
        "lever_right_m": lever[1], "lever_down_m": lever[2] - 0.25,
        **dict(zip(("qw", "qx", "qy", "qz"), q, strict=True)),
    }  # fmt: skip
    before = heights(right)
    write_small(store, "mountings", [row])
    try:
        run = right.run(**PRODUCTS)
        after = heights(right)
    finally:
        store.remove(small_path("mountings"))
    assert run.raw_bytes_read > 0
    times, low = np.concatenate(list(before.values())).T
    high = np.concatenate(list(after.values()))[:, 1]
    adjusted_s = middle / 1e9 - 1e9
    assert np.abs(high - low)[times < adjusted_s].max() < 1e-3
    raised = np.round((high - low)[times >= adjusted_s], 2)
    assert set(raised.tolist()) == {0.0, 0.25}  # the other head stays
    assert abs(np.mean(raised > 0) - 0.5) < 0.1


def heights(simulated: Simulated) -> dict[str, np.ndarray]:
    """Adjusted GPS time (s) and height (m) of the points of each LAS file, in their canonical order."""
    found = {}
    for path in simulated.store().files("tiles/las", ".laz"):
        cloud = laspy.read(simulated.store().path(path))
        found[path] = np.stack([cloud.gps_time, cloud.z], axis=-1)
    return found


def damaged(content: bytes, damage: str) -> bytes:
    sink = pa.BufferOutputStream()
    pq.write_table(pa.table({"name": ["x"]}), sink)
    place = content.index(b"run-1")  # within a page: what only its checksum tells
    return {
        "cut": content[: len(content) // 2],
        "empty": b"",
        "flipped": content[:place] + b"s" + content[place + 1 :],
        "other": sink.getvalue().to_pybytes(),
    }[damage]


MENDED_BY = {
    "clocks": "`roadscan clocks`",
    "clock_residuals": "`roadscan clocks`",
    "mountings": "`roadscan calibrate`",
    "corrections": "compute it again",
}


@pytest.mark.parametrize("damage", ["cut", "empty", "flipped", "other"])
@pytest.mark.parametrize("name", sorted(MENDED_BY))
def test_a_damaged_table_says_what_mends_it(tmp_path: Path, name: str, damage: str) -> None:
    store, path = Store(str(tmp_path), "s"), small_path(name)
    values = {"string": "run-1", "int64": 0, "float64": 0.5, "uint8": 1, "int32": 1}
    write_small(store, name, [{c.name: values.get(c.type) for c in table_schema(name).columns}])
    store.write_bytes(path, damaged(store.read_bytes(path), damage))
    with pytest.raises(DamagedError) as raised:
        read_small(store, name)
    assert MENDED_BY[name] in raised.value.change and "`roadscan verify`" not in str(raised.value)
    assert raised.value.file == store.path(path)


@pytest.mark.parametrize("name", ["mountings", "corrections"])
def test_a_run_does_not_go_on_without_a_damaged_table(right: Simulated, name: str) -> None:
    """Without it, readings would be placed elsewhere."""
    store = right.run(**PRODUCTS).store
    before = outputs(store)
    store.write_bytes(small_path(name), b"PAR1 and no more")
    try:
        for _ in range(2):
            with pytest.raises(DamagedError, match=f"{name}/part-00000.parquet: the file is damaged"):
                right.run(**PRODUCTS)
        assert outputs(store) == before
    finally:
        store.remove(small_path(name))
    assert right.run(**PRODUCTS).raw_bytes_read == 0


def test_damaged_clocks_are_estimated_anew(right: Simulated) -> None:
    store = right.store()
    store.write_bytes(small_path("clocks"), b"PAR1 and no more")
    with pytest.raises(DamagedError, match="`roadscan clocks`"):
        plan_survey(Survey.load(right.survey_file), store)
    said = right.run(**PRODUCTS).reporter.lines
    assert [line for line in said if line.startswith("note: the table `clocks` is damaged")]
    assert store.read_bytes("damaged/" + small_path("clocks")) == b"PAR1 and no more"
