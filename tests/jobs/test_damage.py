"""A store with damaged files: every command says what is wrong and what to do, and a run makes it whole again."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from roadscan.cli import app
from roadscan.jobs.status import survey_status, verify_store
from roadscan.model.errors import RoadscanError, RunError
from roadscan.model.survey import Survey
from roadscan.tables.logs import copy_path, read_log_records, record_path
from roadscan.tables.manifest import Manifest

from .conftest import Simulated, outputs


def say(*command: str | Path) -> tuple[int, str]:
    """Exit code and all words of a command; an error that is not one of ours is raised."""
    found = CliRunner().invoke(app, [str(word) for word in command])
    if isinstance(found.exception, RoadscanError):
        return 2, f"{found.output}{found.exception}"
    if found.exception is not None and not isinstance(found.exception, SystemExit):
        raise found.exception
    return found.exit_code, found.output


def test_damaged_records_are_told_in_one_go_and_mended(finished: Simulated, tmp_path: Path) -> None:
    copy = finished.copy_with_store_to(tmp_path / "survey")
    store, survey = copy.store(), Survey.load(copy.survey_file)
    copied, again = [r.key for r in read_log_records(store) if r.sensor in ("profiler_left", "lidar")][:2]
    (part,) = store.files("manifest/outputs")
    broken = [part, record_path(copied), record_path(again), copy_path(again)]
    for path in broken:
        store.write_bytes(path, store.read_bytes(path)[:-50])
    faults = verify_store(store)
    assert len(faults) == 3 and all(any(path in fault for fault in faults) for path in broken[:3])
    status = survey_status(survey, store)
    assert len(status.damaged) == 3 and not status.is_complete
    assert sorted(log["state"] for log in status.logs) == ["damaged"] * 2 + ["ingested"] * 7
    code, words = say("sql", "--survey", copy.survey_file, "SELECT count(*) FROM trajectory")
    assert code == 0 and words.count("not shown: ") == 3
    said = copy.run().reporter.lines
    notes = [line for line in said if line.startswith("note: ")]
    assert len(notes) == 3 and sum("its copy put in its place" in note for note in notes) == 1
    assert outputs(store) == outputs(finished.store())
    assert verify_store(store) == []
    assert survey_status(survey, store).is_complete
    assert len(store.files("damaged")) == 3


def test_a_log_whose_record_is_lost_is_asked_for(finished: Simulated, tmp_path: Path) -> None:
    """Where its raw log was archived, and the copy of its record is damaged as well."""
    copy = finished.copy_with_store_to(tmp_path / "survey")
    store = copy.store()
    copy.run()  # logs are known by their place
    record = next(r for r in read_log_records(store) if r.sensor == "lidar")
    for path in (record_path(record.key), copy_path(record.key)):
        store.write_bytes(path, b"{}")
    raw = copy.survey_file.parent / record.path
    raw.rename(tmp_path / "archived")
    with pytest.raises(
        RunError, match=rf"{raw.name}: the log does not exist, .*damaged/manifest/logs/.* put the log back"
    ):
        copy.run()
    (tmp_path / "archived").rename(raw)
    copy.run()
    assert Manifest(store).all() == Manifest(finished.store()).all()
