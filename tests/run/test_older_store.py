"""A store that an older version made: nothing ingested is lost, and products are current or made again.

`tests/stores/version-0.1.tar.xz` was made by version 0.1 before its kernels had rooms: a simulated street of 4 m with
profilers and a lidar, run whole. Its raw logs are archived: what the store holds is all there is.
"""

from __future__ import annotations

import shutil
import tarfile
from pathlib import Path

import pytest
from typer.testing import CliRunner

from roadscan import __version__
from roadscan.cli import app
from roadscan.core.errors import StoreError
from roadscan.ingest.reading.format import log_formats
from roadscan.run.session import Session
from roadscan.store.digest import checked_json
from roadscan.store.query.sql import query
from roadscan.store.written_by import VERSION_FILE
from roadscan.survey.status import survey_status, verify_store
from tests.surveys import Simulated

OLD = Path(__file__).resolve().parents[1] / "stores" / "version-0.1.tar.xz"
ROWS = {"scans": (164, 80328896), "trajectory": (580, 350080502)}
"""Rows, and sum of their epochs modulo 1,000,003: as version 0.1 counted them."""
TILES = (4, 9830)
"""Tiles, and points in them."""


@pytest.fixture(scope="module")
def survey_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("older")
    with tarfile.open(OLD) as archive:
        archive.extraction_filter = getattr(tarfile, "data_filter", None)  # from Python 3.11.4
        archive.extractall(folder)
    return folder / "SURVEY.toml"


@pytest.mark.parametrize("versions_later", [0, 2])
def test_rows_of_archived_logs_stay(
    survey_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, versions_later: int
) -> None:
    """Where the raw logs are gone, what an earlier reader and earlier checks left of them stays."""
    for one in log_formats().values():
        monkeypatch.setattr(type(one), "version", one.version + versions_later)
    copy = tmp_path / "survey"
    shutil.copytree(survey_file.parent, copy)
    survey_status(Session.open(copy / "SURVEY.toml"))  # learns the bytes of the logs, as any command does
    shutil.rmtree(copy / "raw")
    if versions_later:
        (copy / "control.csv").unlink()
    state = survey_status(Session.open(copy / "SURVEY.toml"))
    assert {log["state"] for log in state.logs} == {"ingested"}


@pytest.mark.slow
def test_an_older_store_is_read_and_made_again(survey_file: Path) -> None:
    session = Session.open(survey_file)
    faults = verify_store(session.store)
    assert all("was made by an older version" in fault and "next run makes it again" in fault for fault in faults), (
        faults
    )
    state = survey_status(Session.open(survey_file))
    # Neither poses nor clocks that stand were checked then: logs of these are read again.
    waiting = {log["path"] for log in state.logs if log["state"] == "waiting"}
    names = ("trajectory.sbet", "profiler_left.parquet", "profiler_right.parquet")
    assert waiting == {f"raw/{run}/{name}" for run in ("run-1", "run-2") for name in names}
    assert {log["state"] for log in state.logs if log["path"] not in waiting} == {"ingested"}
    done = CliRunner().invoke(app, ["run", str(survey_file), "--workers", "0"])
    assert done.exit_code == 0, done.output
    assert f"the store was written by an older version, this is roadscan {__version__}; to be made anew" in done.output
    assert "as far as is known before: 6 of ingest" in done.output
    assert session.store.last_version() == __version__
    assert survey_status(Session.open(survey_file)).is_complete
    assert verify_store(session.store) == []
    for table, expected in ROWS.items():
        found = query(session.store, f"SELECT count(*) AS rows, sum(epoch_gps_ns % 1000003) AS epochs FROM {table}")
        assert tuple(found.to_pylist()[0].values()) == expected
    tiles = query(session.store, "SELECT count(*) AS tiles, sum(points) AS points FROM tiles").to_pylist()[0]
    assert tuple(tiles.values()) == TILES


@pytest.mark.slow
def test_a_newer_store_is_refused_by_name(finished: Simulated, tmp_path: Path) -> None:
    """Before long work, by each command that writes; what only looks says it too."""
    copy = finished.copy_with_store_to(tmp_path / "survey")
    copy.store().write_bytes(VERSION_FILE, checked_json({"roadscan": "9.1.0"}))
    for command in ("run", "verify", "report"):
        refused = CliRunner().invoke(app, [command, str(copy.survey_file)])
        assert isinstance(refused.exception, StoreError)
        assert f"roadscan 9.1.0 wrote to this store, and this is roadscan {__version__}" in str(refused.exception)
    assert "roadscan 9.1.0 wrote to this store" in survey_status(Session.open(copy.survey_file)).would_fail[0]
    copy.store().write_bytes(VERSION_FILE, b"{}")
    assert [VERSION_FILE in fault for fault in verify_store(copy.store())] == [True]
    done = CliRunner().invoke(app, ["run", str(copy.survey_file), "--workers", "0"])
    assert done.exit_code == 0 and f"{VERSION_FILE} is damaged and is written anew" in done.output
    assert verify_store(copy.store()) == []
