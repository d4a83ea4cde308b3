"""Control that is wrong, through the pipeline: what is named, what the road and its σ are worth all the same.

One drive of 80 m past points without targets, and three drives past painted ones. Wrong values are written into
`control.csv`; check points keep theirs, and say how far the road is off.
"""

from __future__ import annotations

import csv
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from roadscan.core.survey import Survey
from roadscan.core.witness import Finding
from roadscan.georeference.plan.plan import plan_of
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Session
from roadscan.run.stage import findings_of, stage_named
from roadscan.simulate import Scene, simulate
from roadscan.store.query.sql import query
from roadscan.store.small_tables import read_small, small_path
from roadscan.survey.run import run_stages
from tests.drawing import drawn
from tests.surveys import Lines, Simulated, changed

OFF = {"on": False}
STAGES = ("ingest", "navigate", "footprints", "adjust")
ROLES = ("gcp", "check", "gcp", "gcp", "check", "gcp", "gcp", "check", "gcp")
NAMES = ("G001", "G003", "G004", "G006", "G007", "G009")
Points = dict[str, dict[str, str]]


def scene(passes: list[dict[str, object]], seed: int = 1) -> Scene:
    targets = [
        {"station_m": 8.0 + 8.0 * k, "offset_m": 0.6 + 2.6 * (k % 2), "role": role} for k, role in enumerate(ROLES)
    ]
    return Scene.load("reference_site").changed(
        road={"targets": targets}, length_m=80.0, lidar=OFF, imu=OFF, gnss=OFF, encoder=OFF, camera=OFF, seed=seed,
        profilers={"spacing_m": 0.05, "readings": 200, "head_imus": None}, passes=passes,
        noise={"position_m": 0.015, "attitude_deg": 0.004, "time_constant_s": 120.0, "control_m": 0.001},
        vehicle={"standstill_s": 0.0}, roadside={"poles": [], "trees": []},
    )  # fmt: skip


@pytest.fixture(scope="module")
def one_drive(tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    return Simulated(simulate(scene([{"lane": 2}]), tmp_path_factory.mktemp("one") / "survey").survey_file)


@pytest.fixture(scope="module")
def three_drives(tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    passes: list[dict[str, object]] = [{"lane": 2}, {"lane": 2, "offset_m": -0.6}, {"lane": 2, "offset_m": 0.4}]
    return Simulated(simulate(scene(passes), tmp_path_factory.mktemp("three") / "survey").survey_file)


class Outcome:
    """What an adjustment with changed control said and made."""

    def __init__(self, session: Session, store: Any) -> None:
        records = list(plan_of(session).records)
        self.findings: list[Finding] = list(
            findings_of(session.survey, records, session.manifest, [stage_named("adjust")])
        )
        self.lines = session.reporter.lines  # type: ignore[attr-defined]
        self.store = store

    def of(self, witness: str) -> list[Finding]:
        return [one for one in self.findings if one.witness == witness]

    def rows(self, statement: str) -> list[dict[str, Any]]:
        return query(self.store, statement).to_pylist()

    def off_m(self) -> np.ndarray:
        """Surface minus survey at the check points, each in each pass."""
        found = self.rows("SELECT height_after_m FROM control_residuals WHERE role = 'check'")
        return -np.array([row["height_after_m"] for row in found])

    def datum_m(self) -> float:
        """1 σ of the datum of heights, as the poses confirm it; 0 where the control is so far off that none is used."""
        where = "WHERE points = 'datum' AND component = 'height'"
        return sum(float(row["rmse_m"]) for row in self.rows(f"SELECT rmse_m FROM absolute_accuracy {where}"))

    def sigma_m(self) -> float:
        """Published 1 σ of heights; that of the logs where nothing is corrected."""
        table = read_small(self.store, "corrections")
        return 0.015 if table is None else float(np.median(table.column("sigma_down_m").to_numpy()))


def outcome(raw: Simulated, folder: Path, change: Callable[[Points], None], **settings: object) -> Outcome:
    """Run the stages up to the adjustment on a copy with other control points; the store stays from one to the next."""
    if not folder.exists():
        raw.copy_to(folder)
    shutil.copyfile(raw.survey_file.parent / "control.csv", folder / "control.csv")
    file = folder / "control.csv"
    with file.open(newline="") as stream:
        points = {row["name"]: row for row in csv.DictReader(stream)}
    change(points)
    with file.open("w", newline="") as stream:
        out = csv.DictWriter(stream, list(next(iter(points.values()))))
        out.writeheader()
        out.writerows(points.values())
    one = Simulated(folder / raw.survey_file.name)
    survey = changed(Survey.load(one.survey_file), {"products__make": ["tile_table"], **settings})
    session = Session(survey, one.store(), Inline(), None, Lines())
    run_stages(session, [stage_named(name) for name in STAGES])
    return Outcome(session, one.store())


def moved(points: Points, names: tuple[str, ...], column: str, by_m: float) -> None:
    for name in names:
        points[name][column] = f"{float(points[name][column]) + by_m:.4f}"


def higher(by_m: float, *names: str) -> Callable[[Points], None]:
    return lambda points: moved(points, names or NAMES, "height_m", by_m)


def test_right_control_is_not_doubted(one_drive: Simulated, tmp_path: Path) -> None:
    found = outcome(one_drive, tmp_path / "survey", lambda _: None)
    assert found.findings == []
    assert np.abs(found.off_m()).max() < 0.006
    assert found.sigma_m() < 0.004
    assert [line for line in found.lines if "control against the poses as a whole" in line]
    assert [line for line in found.lines if "solution settled after" in line]


@pytest.mark.slow
@pytest.mark.parametrize("wrong_m", [0.05, -0.1, 1.0])
def test_a_wrong_height_that_one_drive_alone_saw_is_named_and_spoils_no_figure(
    one_drive: Simulated, tmp_path: Path, wrong_m: float
) -> None:
    right = left_out(outcome(one_drive, tmp_path / "survey", lambda _: None))
    found = outcome(one_drive, tmp_path / "survey", higher(wrong_m, "G006"), adjust__control={"largest_m": 2.0})
    assert [(one.subject, one.left_out) for one in found.of("control_point")] == [("G006", 1)]
    assert len(found.findings) == 1
    assert (right["count"], left_out(found)["count"]) == (6, 5)
    assert left_out(found)["rmse_m"] < 2.0 * right["rmse_m"]
    assert found.rows("SELECT name FROM control_residuals WHERE weight_height = 0") == [{"name": "G006"}]
    assert np.abs(found.off_m()).max() < 0.006


def left_out(found: Outcome) -> dict[str, Any]:
    """Each GCP against all else: the printed figure."""
    where = "WHERE points = 'left_out' AND component = 'height'"
    return found.rows(f"SELECT count, rmse_m FROM absolute_accuracy {where}")[0]


@pytest.mark.slow
@pytest.mark.witness("control_datum")
@pytest.mark.parametrize("offset_m", [-0.1, 0.3])
def test_control_off_as_a_whole_is_named_and_the_error_stays_within_sigma(
    three_drives: Simulated, tmp_path: Path, offset_m: float
) -> None:
    found = outcome(three_drives, tmp_path / "survey", higher(offset_m))
    told = found.of("control_datum")
    assert [(one.subject, one.left_out) for one in told] == [("control", 6)]
    stated_mm = float(told[0].text.split(" lie ")[1].split(" mm")[0])
    assert stated_mm == pytest.approx(1e3 * offset_m, abs=3 * 9.0)
    assert "The poses are followed" in told[0].text
    assert not found.of("control_point")
    assert np.abs(found.off_m()).max() < 3.0 * found.sigma_m()
    assert 0.005 < found.sigma_m() < 0.015
    # Who trusts the control follows it, and reads its offset in σ.
    followed = outcome(three_drives, tmp_path / "survey", higher(offset_m), adjust__control={"datum_offset": "follow"})
    assert np.mean(followed.off_m()) == pytest.approx(offset_m, abs=0.01)
    assert followed.sigma_m() == pytest.approx(abs(offset_m), rel=0.3)
    assert [one.left_out for one in followed.of("control_datum")] == [0]


@pytest.mark.slow
def test_an_offset_that_poses_cannot_tell_is_within_the_sigma_of_the_datum(
    one_drive: Simulated, tmp_path: Path
) -> None:
    """20 mm are absorbed: σ of the tiles is against the control, and what it leaves open is published beside it."""
    right = outcome(one_drive, tmp_path / "survey", lambda _: None)
    assert 0.012 < right.datum_m() < 0.05  # one drive knows its mean height to its σ of 15 mm
    found = outcome(one_drive, tmp_path / "survey", higher(-0.02))
    assert not found.of("control_datum") and np.abs(found.off_m()).max() > 0.015
    assert np.abs(found.off_m()).max() < 3.0 * np.hypot(found.sigma_m(), found.datum_m())


@pytest.mark.nightly
@pytest.mark.parametrize("drives", ["one_drive", "three_drives"])
def test_an_offset_of_the_control_is_within_sigma_or_named(
    request: pytest.FixtureRequest, tmp_path: Path, drives: str
) -> None:
    """From 20 mm to 0.6 m, up and down: by the σ of heights, and by that of the datum where poses cannot show it."""
    raw = request.getfixturevalue(drives)
    for offset_m in (0.02, 0.05, 0.1, 0.2, 0.3, 0.45, 0.6):
        for sign in (-1.0, 1.0):
            found = outcome(raw, tmp_path / "survey", higher(sign * offset_m))
            within = np.abs(found.off_m()).max() < 3.0 * np.hypot(found.sigma_m(), found.datum_m())
            assert within, (drives, sign * offset_m)
            assert not found.of("control_point")
            if offset_m > 0.15:
                assert np.abs(found.off_m()).max() < 0.045


@pytest.mark.slow
def test_the_order_of_runs_in_the_survey_file_changes_no_bit(three_drives: Simulated, tmp_path: Path) -> None:
    """Corrections, tables and pictures of two orders of the same runs."""
    made = []
    for name, step in (("first", 1), ("second", -1)):
        copy = three_drives.copy_to(tmp_path / name)
        config = changed(Survey.load(copy.survey_file), {"products__make": ["tile_table"]})
        turned = config.config.model_copy(update={"runs": config.config.runs[::step]})
        session = Session(Survey(turned, config.rig, config.folder), copy.store(), Inline(), None, Lines())
        with drawn():
            run_stages(session, [stage_named(stage) for stage in (*STAGES, "tiles")])
        folders = ("products/adjustment", "tables/control_residuals", "tables/tie_residuals", "tiles")
        paths = [path for folder in folders for path in copy.store().files(folder)]
        made.append({path: copy.store().read_bytes(path) for path in [*paths, small_path("corrections")]})
    assert made[0].keys() == made[1].keys()
    assert [path for path in made[0] if made[0][path] != made[1][path]] == []


@pytest.mark.slow
@pytest.mark.witness("run_not_held")
def test_a_run_that_no_control_and_no_tie_holds_is_named(tmp_path: Path) -> None:
    """Two drives in one lane and one in a lane that their strips do not reach; control lies in the one lane."""
    passes: list[dict[str, object]] = [{"lane": 2}, {"lane": 2, "offset_m": 0.4}, {"lane": 1, "offset_m": -3.0}]
    raw = Simulated(simulate(scene(passes), tmp_path / "raw").survey_file)
    found = outcome(raw, tmp_path / "survey", lambda _: None)
    assert [one.subject for one in found.of("run_not_held")] == ["run 'run-3'"]


@pytest.mark.slow
@pytest.mark.witness("helmert_turn")
def test_a_turn_that_control_along_one_line_leaves_open_is_told_with_sigma(
    three_drives: Simulated, tmp_path: Path
) -> None:
    targets = {"shape": "circle", "size_m": 0.30, "centre_m": 0.06}
    found = outcome(three_drives, tmp_path / "survey", lambda _: None, adjust__mode="helmert", adjust__targets=targets)
    assert [one.subject for one in found.of("helmert_turn")] == ["adjust"]
    # σ of the poses and of the transformation to the side of the vehicle together.
    assert found.sigma_m() > np.hypot(0.015, 0.015)


@pytest.mark.slow
@pytest.mark.witness("stated_sigma")
def test_a_sigma_that_is_stated_ten_times_too_small_is_found(three_drives: Simulated, tmp_path: Path) -> None:
    priors = {"source": "stated", "sigma_down_m": 0.0015}
    found = outcome(three_drives, tmp_path / "survey", lambda _: None, adjust__priors=priors)
    (told,) = found.of("stated_sigma")
    assert "the stated σ of the poses, height is " in told.text
    assert float(told.text.split(" is ")[1].split(" times")[0]) == pytest.approx(10.0, rel=0.4)
    assert np.sqrt(np.mean(found.off_m() ** 2)) < 2.0 * np.hypot(found.sigma_m(), 0.001)
    assert len(found.findings) == 1


@pytest.mark.slow
@pytest.mark.witness("solution_settled")
def test_a_solution_that_did_not_settle_is_told(three_drives: Simulated, tmp_path: Path) -> None:
    one_round = {"max_rounds": 1, "estimate_variance_components": True}
    found = outcome(three_drives, tmp_path / "survey", lambda _: None, adjust__solver=one_round)
    assert [one.subject for one in found.of("solution_settled")] == ["adjust"]
