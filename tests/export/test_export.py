"""Exports of a simulated survey, read back through the readers and compared with the store and the truth."""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pyproj
import pytest
from typer.testing import CliRunner

from roadscan.cli import app
from roadscan.compute.reference_line import ReferenceLine
from roadscan.core.errors import ConfigError, FormatError, RunError
from roadscan.core.survey import Survey
from roadscan.export.export_opencrg import CrgSettings, CurvedHeights, export_opencrg, fill_holes, inner_holes
from roadscan.export.export_psi import PsiSettings, export_psi
from roadscan.georeference.plan.plan import plan_survey
from roadscan.ingest.ingest import ingest
from roadscan.ingest.reading.format import format_of
from roadscan.simulate import simulate, truth
from roadscan.store.readings.row_groups import read_groups
from roadscan.store.store import Store
from tests.formats.crg_files import read_crg
from tests.formats.psi_files import read_psi
from tests.formats.readings import read
from tests.surveys import small_scene


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Survey:
    """A simulated survey without noise, ingested."""
    scene = small_scene(length_m=24.0, profilers={"spacing_m": 0.05, "readings": 200}).noiseless()
    loaded = Survey.load(simulate(scene, tmp_path_factory.mktemp("export") / "survey").survey_file)
    ingest(loaded, store_of(loaded))
    return loaded


def store_of(survey: Survey) -> Store:
    return Store(survey.store_url, survey.config.id)


def profiler(survey: Survey) -> tuple[str, str]:
    source = next(s for s, _ in plan_survey(survey, store_of(survey)).sources if s.table == "scans")
    return source.run, source.sensor


def ingested(survey: Survey) -> pa.Table:
    """The profiles of :func:`profiler` as they lie in the store."""
    plan = plan_survey(survey, store_of(survey))
    files = [f for s, own in plan.sources if (s.run, s.sensor) == profiler(survey) for f in own]
    parts = [read_groups(plan.store, f.path, range(len(f.group_rows))) for f in files]
    return pa.concat_tables(parts).sort_by("epoch_gps_ns")


def same(one: pa.Table, other: pa.Table, column: str) -> bool:
    left, right = (t.column(column).combine_chunks().flatten().to_numpy() for t in (one, other))
    return bool(np.array_equal(left, right))


@pytest.mark.slow
def test_psi_keeps_every_reading(survey: Survey, tmp_path: Path) -> None:
    run, sensor = profiler(survey)
    made = export_psi(survey, store_of(survey), run, sensor, tmp_path / "psi", PsiSettings(5.0))
    assert [p.name for p in made.files] == sorted(p.name for p in (tmp_path / "psi").iterdir())
    assert len(made.files) >= 5
    assert [p.name for p in tmp_path.iterdir()] == ["psi"]  # no scratch folder stays behind
    assert format_of(tmp_path / "psi").name == "psi"
    log = read("psi", tmp_path / "psi")
    before = ingested(survey)
    assert log.rejects == []
    kept = np.isin(before.column("epoch_gps_ns").to_numpy(), log.epochs)
    assert kept.sum() == len(log) == len(kept) - sum("without a pose" in n for n in made.notes)
    assert np.array_equal(log.epochs, before.column("epoch_gps_ns").to_numpy())
    assert same(log.table, before, "range")
    assert same(log.table, before, "intensity")
    plan = plan_survey(survey, store_of(survey))
    stated = next(s for s, _ in plan.sources if (s.run, s.sensor) == (run, sensor)).attribute["scan_geometry"]
    assert log.attributes["scan_geometry"] == {
        k: v if isinstance(v, str) else pytest.approx(v, rel=2e-7, abs=1e-12) for k, v in stated.items()
    }


@pytest.mark.slow
def test_psi_headers_say_where_and_how_fast(survey: Survey, tmp_path: Path) -> None:
    run, sensor = profiler(survey)
    made = export_psi(survey, store_of(survey), run, sensor, tmp_path / "psi", PsiSettings(4.0))
    heads = [read_psi(p).header for p in made.files]
    assert [h.file_serial for h in heads] == list(range(len(heads)))
    scene = truth.load(survey.folder).scene
    assert np.median([h.speed for h in heads]) == pytest.approx(scene.vehicle.speed_m_per_s, rel=0.1)
    assert np.median([h.longitudinal3d for h in heads]) == pytest.approx(50.0, rel=0.05)
    assert np.diff([h.dmi for h in heads][1:-1]) == pytest.approx(4.0, abs=0.06)
    poses = pq.read_table(truth.load(survey.folder).trajectory_file(run))
    column = {c: poses.column(c).to_numpy() for c in poses.column_names}
    to_degrees = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    geod = pyproj.Geod(ellps="WGS84")
    for head in heads[1:-1]:
        k = int(np.searchsorted(column["epoch_gps_ns"], head.timestamp))
        ecef = [np.interp(head.timestamp, column["epoch_gps_ns"], column[f"{a}_world_m"]) for a in "xyz"]
        lon, lat, _ = to_degrees.transform(*ecef)
        assert geod.inv(lon, lat, head.longitude_deg, head.latitude_deg)[2] < 0.05
        ends = [to_degrees.transform(*(column[f"{a}_world_m"][j] for a in "xyz")) for j in (k - 20, k + 20)]
        course = geod.inv(ends[0][0], ends[0][1], ends[1][0], ends[1][1])[0]
        assert abs((head.heading_deg - course + 180) % 360 - 180) < 3.0


@pytest.mark.slow
def test_opencrg_equals_the_truth(survey: Survey, tmp_path: Path) -> None:
    """A node's height is the mean of its cell: within slope × cell and texture of the truth at the node."""
    run, sensor = profiler(survey)
    settings = CrgSettings(u_step_m=0.05, v_step_m=0.05)
    made = export_opencrg(survey, store_of(survey), run, sensor, tmp_path / "crg", settings)
    assert format_of(made.files[0]).name == "opencrg"
    options = {"epoch": dt.datetime(2026, 5, 4, tzinfo=dt.UTC)}
    log = read("opencrg", made.files[0], options, crs=survey.config.map.crs, height="ellipsoidal")
    assert log.rejects == []
    assert len(log) > 15_000
    grid = read_crg(made.files[0])
    assert (grid.u_step_m, len(grid.comments)) == (0.05, 5)
    assert np.array_equal(log["z_m"], (z := grid.xyz()[..., 2].ravel())[np.isfinite(z)])
    true = truth.load(survey.folder)

    def errors(rows: int, columns: int) -> np.ndarray:
        """Heights, moved by whole nodes, minus the truth at the nodes."""
        xyz = grid.xyz()
        moved = np.roll(xyz[..., 2], (rows, columns), axis=(0, 1)) - true.height_m(xyz[..., 0], xyz[..., 1])
        inside = moved[1:, 1:]
        return inside[np.isfinite(inside)]

    own = errors(0, 0)
    assert own.size > 0.95 * len(log)
    assert abs(np.median(own)) < 5e-4  # half a profile spacing on the road's grade and crown
    assert np.percentile(np.abs(own), 95) < 1.5e-3
    for rows, columns in ((1, 0), (0, 1)):
        assert np.median(np.abs(errors(rows, columns))) > 2 * np.median(np.abs(own))


def test_points_beside_a_circle_lie_in_their_cells() -> None:
    """Places with known radius and angle land in the node they were made for, whatever the hint."""
    radius, step = 30.0, 0.1
    turn = 2 * np.arcsin(step / 2 / radius)
    phi = turn * (np.arange(400) + 0.5)
    line = ReferenceLine(0.0, 0.0, phi, step)
    sums = CurvedHeights(line, -2.0, 0.25, 17)
    rows, columns = np.meshgrid(np.arange(401), np.arange(17), indexing="ij")
    angle = turn * rows.ravel() - np.pi / 2 + 0.3 * turn
    reach = radius - (-2.0 + 0.25 * columns.ravel() + 0.05)
    x, y = reach * np.cos(angle), radius + reach * np.sin(angle)
    height = (rows.ravel() * 100 + columns.ravel()).astype(np.int32)
    for hints in (rows.ravel(), np.zeros(x.size, int), np.full(x.size, 399)):
        fresh = CurvedHeights(line, -2.0, 0.25, 17)
        assert fresh.add(x, y, height, hints.astype(np.int64)) == 0
        assert (fresh.counts == 1).all()
        assert np.array_equal(fresh.sums, height.reshape(401, 17))
    assert sums.add(np.array([-1.0, 0.0]), np.array([0.0, -3.0]), height[:2], np.zeros(2, np.int64)) == 2


def test_sums_do_not_depend_on_order() -> None:
    rng = np.random.default_rng(1)
    line = ReferenceLine(10.0, 20.0, np.linspace(0.0, 1.0, 100), 0.1)
    x, y = 10 + rng.uniform(0, 8, 5000), 20 + rng.uniform(-1, 6, 5000)
    height = rng.integers(-(10**6), 10**6, 5000).astype(np.int32)
    results = []
    for order in (np.arange(5000), rng.permutation(5000)):
        sums = CurvedHeights(line, -1.0, 0.1, 21)
        for part in np.array_split(order, 7):
            sums.add(x[part], y[part], height[part], np.full(part.size, 50))
        results.append(sums.heights_m())
    assert np.array_equal(results[0], results[1], equal_nan=True)
    assert np.isfinite(results[0]).sum() > 500


def test_a_smoothed_line_follows_the_path() -> None:
    """An arc of 40 m driven with 1 cm of noise and a stop: the line keeps within millimetres of the arc."""
    rng = np.random.default_rng(2)
    angle = np.concatenate([np.linspace(0.0, 0.7, 900), np.full(500, 0.7), np.linspace(0.7, 1.4, 900)])
    path = 40.0 * np.column_stack([np.cos(angle), np.sin(angle)]) + rng.normal(0, 0.01, (2300, 2))
    line, steps = ReferenceLine.smoothed(path, 0.1, 10.0)
    radius = np.hypot(*line.vertices_m.T)
    assert np.abs(radius - 40.0).max() < 0.02
    assert np.median(np.abs(radius - 40.0)) < 0.006
    assert np.hypot(*np.diff(line.vertices_m, axis=0).T) == pytest.approx(0.1)
    near = np.hypot(*(line.vertices_m[np.clip(steps, 0, len(line.vertices_m) - 1)] - path).T)
    assert near.max() < 0.5
    assert np.array_equal(line.phi_rad, line.phi_rad.astype(np.float32))


def test_holes() -> None:
    nan = np.nan
    heights = np.array([[1.0, nan, 3.0, nan, nan, nan, 7.0, nan], [nan] * 8, [3.0] * 8])
    filled, count = fill_holes(heights, 2, 1)
    assert np.array_equal(
        filled,
        [[1, 2, 3, nan, nan, nan, 7, nan], [2, 2.5, 3, nan, nan, nan, 5, nan], [3] * 8],
        equal_nan=True,
    )  # fmt: skip
    assert count == 5
    assert inner_holes(filled) == 6
    assert inner_holes(heights) == 4 + 1


@pytest.mark.slow
def test_a_pass_of_nothing_and_wrong_names(survey: Survey, tmp_path: Path) -> None:
    run, sensor = profiler(survey)
    store = store_of(survey)
    with pytest.raises(ConfigError, match=rf"no readings of '{sensor}x' in run '{run}' .did you mean"):
        export_psi(survey, store, run, sensor + "x", tmp_path / "a")
    lidar = next(s for s, _ in plan_survey(survey, store).sources if s.table == "returns")
    with pytest.raises(ConfigError, match="is no line scanner"):
        export_psi(survey, store, lidar.run, lidar.sensor, tmp_path / "a")
    with pytest.raises(ConfigError, match="length of 0 m"):
        export_psi(survey, store, run, sensor, tmp_path / "a", PsiSettings(0.0))
    with pytest.raises(ConfigError, match="has no pass 77; expected --pass, one of"):
        export_opencrg(survey, store, run, sensor, tmp_path / "a", CrgSettings(pass_id=77))
    with pytest.raises(ConfigError, match="steps of 0 ×"):
        export_opencrg(survey, store, run, sensor, tmp_path / "a", CrgSettings(u_step_m=0.0))
    with pytest.raises(FormatError, match="encoding is XRBI"):
        export_opencrg(survey, store, run, sensor, tmp_path / "a", CrgSettings(encoding="XRBI"))
    with pytest.raises(RunError, match="no point of"):
        export_opencrg(survey, store, run, sensor, tmp_path / "a", CrgSettings(left_m=-90.0, right_m=91.0))
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    with pytest.raises(ConfigError, match="is there already"):
        export_psi(survey, store, run, sensor, tmp_path / "full")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["full"]  # nothing half-written stays


@pytest.mark.slow
def test_a_failure_leaves_nothing(survey: Survey, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = iter([None] * 2)

    def failing(*_: object, **__: object) -> Iterator[None]:
        next(calls)
        raise OSError("disk full")

    monkeypatch.setattr("roadscan.export.export_psi.write_psi", failing)
    with pytest.raises(OSError, match="disk full"):
        export_psi(survey, store_of(survey), *profiler(survey), tmp_path / "psi")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_command(survey: Survey, tmp_path: Path) -> None:
    run, sensor = profiler(survey)
    file = str(survey.folder / "SURVEY.toml")
    common = ["export", file, "--run", run, "--sensor", sensor, "--out"]
    done = CliRunner().invoke(app, [*common, str(tmp_path / "crg"), "--format", "opencrg", "--u-step", "0.1"])
    assert done.exit_code == 0, done.output
    assert "1 file in" in done.output
    done = CliRunner().invoke(app, [*common, str(tmp_path / "psi"), "--format", "psi", "--length", "10"])
    assert done.exit_code == 0, done.output
    assert len(list((tmp_path / "psi").iterdir())) >= 3
    done = CliRunner().invoke(app, [*common, str(tmp_path / "x"), "--format", "obj"])
    assert isinstance(done.exception, ConfigError)
