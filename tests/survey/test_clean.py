"""`roadscan clean` takes away what nothing needs, and nothing else: the store is whole, its products are the same."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from typer.testing import CliRunner

from roadscan.cli import app
from roadscan.core.errors import ConfigError, RunError
from roadscan.core.survey import Survey
from roadscan.ingest.ingest import ingest
from roadscan.run.session import Session
from roadscan.store.store import Store
from roadscan.survey.clean import DAMAGED, SUPERSEDED, UNRECORDED, UNUSED, remove_waste, waste_of
from roadscan.survey.status import verify_store
from tests.surveys import Simulated, outputs

EDITS = "tables/asset_commits/00000001.parquet"
OWN = "notes/of-the-user.txt"
STRAY = "tiles/las/1_1.laz"
ROWS = "tables/scans/run=run-1/sensor=profiler_left/log=0123456789abcdef/gps_bin_s=0/part-00000.parquet"
"""Rows of a log whose ingest was killed on an object store before its record was written."""
COPY = "manifest/log_copies/fedcba9876543210.json"
"""Copy of a log's record, which was not written before a kill."""
HALF = """
[[runs.logs]]
path = "raw/run-2/profiler_right.parquet"
format = "scans"
sensor = "profiler_right"
"""


@pytest.fixture
def used(finished: Simulated, tmp_path: Path) -> Simulated:
    """A survey whose store has waste of all kinds, and files that are none."""
    copy = finished.copy_with_store_to(tmp_path / "survey")
    store, text = copy.store(), copy.survey_file.read_text()
    assert HALF in text
    late = text.replace(HALF, "").replace('system = "utc_hour"', 'system = "utc_hour", offset_s = 0.25')
    copy.survey_file.write_text(late)
    ingest(Survey.load(copy.survey_file), store)
    for path in (EDITS, OWN, STRAY, ROWS, COPY, "damaged/tiles/las/2_2.laz"):
        store.write_bytes(path, b"something")
    return copy


def test_nothing_is_waste_in_a_finished_store(finished: Simulated) -> None:
    assert waste_of(Session.open(finished.survey_file)) == []
    done = CliRunner().invoke(app, ["clean", str(finished.survey_file)])
    assert "the store holds nothing that is not needed" in done.output


def test_what_nothing_needs_goes_and_all_else_stays(used: Simulated) -> None:
    store = used.store()
    waste = {kind: [one.path for one in waste_of(Session.open(used.survey_file), [kind])] for kind in
             (SUPERSEDED, DAMAGED, UNUSED, UNRECORDED)}  # fmt: skip
    assert waste[DAMAGED] == ["damaged/tiles/las/2_2.laz"]
    assert set(waste[UNRECORDED]) == {STRAY, ROWS, COPY}
    assert {path.split("/")[0] for path in waste[SUPERSEDED]} == {"superseded"}
    assert any("sensor=profiler_right" in path and "run=run-2" in path for path in waste[UNUSED])
    assert not any("run-1" in path for path in waste[UNUSED])
    before, made = set(store.files("")) | set(store.files("manifest")), outputs(store)
    listed = CliRunner().invoke(app, ["clean", str(used.survey_file), "--files"])
    assert "nothing was removed" in listed.output
    assert all(path in listed.output for own in waste.values() for path in own)
    assert set(store.files("")) | set(store.files("manifest")) == before
    done = CliRunner().invoke(app, ["clean", str(used.survey_file), "--remove"])
    assert done.exit_code == 0, done.output
    assert not any(store.exists(path) for own in waste.values() for path in own)
    assert store.exists(EDITS) and store.exists(OWN)
    assert outputs(store) == {path: content for path, content in made.items() if path != STRAY}
    store.remove(EDITS)
    assert verify_store(store) == []
    assert waste_of(Session.open(used.survey_file)) == []


@pytest.mark.parametrize("kept", [0, 1, 2, 3, 7])
def test_a_clean_that_was_killed_leaves_nothing_that_the_next_one_does_not_find(
    used: Simulated, monkeypatch: pytest.MonkeyPatch, kept: int
) -> None:
    waste, removed, remove = waste_of(Session.open(used.survey_file)), [], Store.remove

    def dying(store: Store, path: str) -> None:
        if len(removed) == kept:
            raise KeyboardInterrupt
        removed.append(path)
        remove(store, path)

    with monkeypatch.context() as killed, pytest.raises(KeyboardInterrupt):
        killed.setattr(Store, "remove", dying)
        remove_waste(Session.open(used.survey_file), waste)
    assert len(removed) == kept
    remove_waste(Session.open(used.survey_file), waste_of(Session.open(used.survey_file)))
    assert not any(used.store().exists(one.path) for one in waste)


def test_age_and_products(finished: Simulated, tmp_path: Path) -> None:
    copy = finished.copy_with_store_to(tmp_path / "survey")
    store = copy.store()
    store.write_bytes(STRAY, b"something")
    assert waste_of(Session.open(copy.survey_file), older_s=3600.0) == []
    os.utime(store.path(STRAY), (1e9, 1e9))
    assert [one.path for one in waste_of(Session.open(copy.survey_file), older_s=3600.0)] == [STRAY]
    made = outputs(store)
    done = CliRunner().invoke(app, ["clean", str(copy.survey_file), "--product", "las", "--remove"])
    assert done.exit_code == 0, done.output
    assert store.files("tiles/las") == []
    assert verify_store(store) == []
    again = CliRunner().invoke(app, ["clean", str(copy.survey_file), "--product", "las", "--remove"])
    assert again.exit_code == 0, again.output  # as after one that was killed when its records were gone
    copy.run()
    assert outputs(store) == {path: content for path, content in made.items() if path != STRAY}


def test_what_is_not_known_is_refused(used: Simulated) -> None:
    with pytest.raises(ConfigError, match="nothing is called 'rubbish'; expected superseded, damaged, unused"):
        waste_of(Session.open(used.survey_file), ["rubbish"])
    with pytest.raises(ConfigError, match="the store has no file of 'meshes'"):
        waste_of(Session.open(used.survey_file), products=["meshes"])
    used.survey_file.write_text(used.survey_file.read_text().replace("profiler_left.parquet", "gone.parquet", 1))
    with pytest.raises(RunError, match="1 log of the survey file cannot be read"):
        waste_of(Session.open(used.survey_file))
    assert waste_of(Session.open(used.survey_file), [DAMAGED])
