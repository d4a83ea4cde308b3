"""A session finds what it needs once; a stage that changes something makes it look again."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from types import ModuleType

import pytest

from roadscan.footprints import footprints
from roadscan.footprints.footprints import footprints_of
from roadscan.georeference.plan import plan
from roadscan.ingest import planned_logs
from roadscan.run.session import Session
from roadscan.run.stage import stages
from roadscan.survey.run import run_stages
from roadscan.survey.status import survey_status
from roadscan.tiles.tasks import tile_plan
from roadscan.tiles.tasks.tile_plan import tiles_of
from tests.surveys import Simulated

PLANS = {
    "plan_logs": planned_logs, "plan_survey": plan, "load_ranges": footprints, "plan_tiles": tile_plan
}  # fmt: skip
"""What plans, and the module in which a session finds it."""


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often a session plans."""
    counts: Counter[str] = Counter()

    def watch(module: ModuleType, name: str) -> None:
        wrapped = getattr(module, name)

        def planned(*arguments: object, **named: object) -> object:
            counts[name] += 1
            return wrapped(*arguments, **named)

        monkeypatch.setattr(module, name, planned)

    for name, module in PLANS.items():
        watch(module, name)
    return counts


@pytest.mark.slow
def test_a_whole_run_plans_once(simulated: Simulated, tmp_path: Path, counted: Counter[str]) -> None:
    copy = simulated.copy_to(tmp_path / "survey")
    run_stages(Session.open(copy.survey_file))
    assert dict(counted) == dict.fromkeys(PLANS, 1)


def test_status_plans_once(finished: Simulated, counted: Counter[str]) -> None:
    assert survey_status(Session.open(finished.survey_file)).is_complete
    assert dict(counted) == dict.fromkeys(PLANS, 1)


def test_renewing_forgets_what_follows_and_nothing_before(finished: Simulated, counted: Counter[str]) -> None:
    session = Session.open(finished.survey_file)
    assert tiles_of(session) is tiles_of(session)
    session.forget(footprints_of)
    assert len(tiles_of(session)) > 0
    assert dict(counted) == {"plan_logs": 1, "plan_survey": 1, "load_ranges": 2, "plan_tiles": 2}


def test_stages_come_after_those_that_they_need() -> None:
    names = [stage.name for stage in stages()]
    assert [n for n in names if n != "levels"] == [
        "ingest", "navigate", "footprints", "strips", "video_frames", "picture_ties", "adjust", "tiles", "pictures",
        "surfaces", "products", "condition", "assets", "colours",
    ]  # fmt: skip
    for stage in stages():
        assert all(names.index(before) < names.index(stage.name) for before in stage.after)
