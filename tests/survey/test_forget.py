"""Pictures that must go: files, copies in archives, rows and products; and what stays as a record of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner, Result

from roadscan.cli import app
from roadscan.core.errors import ConfigError, DamagedError
from roadscan.core.gpstime import iso_from_gps_ns
from roadscan.survey.archive import Archive
from roadscan.survey.forgotten import FORGOTTEN, forgotten_pictures
from tests.measuring.drive import Drive


def cli(*words: str) -> Result:
    return CliRunner().invoke(app, list(words))


@pytest.fixture
def drive(measured_drive: Drive, tmp_path: Path) -> Drive:
    return Drive(measured_drive.copy_with_store_to(tmp_path / "survey").survey_file)


def pictures(drive: Drive) -> dict[str, Path]:
    return {path.name: path for path in sorted(drive.survey_file.parent.rglob("*.jpg"))}


def names_in(drive: Drive, name: str) -> list[str]:
    """Files of the store that hold the name of a picture, as text or in a Parquet table."""
    root = Path(drive.store().path(""))
    found = []
    for path in sorted(one for one in root.rglob("*") if one.is_file()):
        text = str(pq.read_table(path).to_pydict()) if path.suffix == ".parquet" else path.read_text(errors="replace")
        if name in text:
            found.append(path.relative_to(root).as_posix())
    return found


@pytest.mark.slow
def test_named_pictures_go_for_ever(drive: Drive, tmp_path: Path) -> None:
    survey, archive = str(drive.survey_file), str(tmp_path / "archive")
    assert cli("archive", survey, "--to", archive).exit_code == 0
    before = pictures(drive)
    gone = list(before)[2:4]
    names = [word for one in gone for word in ("--picture", f"run-1/camera/{one}")]
    listed = cli("forget", survey, *names)
    assert listed.exit_code == 0 and "2 pictures: nothing was removed" in listed.output and pictures(drive) == before
    done = cli("forget", survey, *names, "--why", "asked by a resident", "--archive", archive, "--remove")
    assert done.exit_code == 0 and "2 pictures removed, and 2 of their copies in archives" in done.output, done.output
    assert set(before) - set(pictures(drive)) == set(gone)
    assert not [path for path in Path(archive).rglob("*.jpg") if path.name in gone]
    assert cli("archive", survey, "--to", archive, "--check").exit_code == 0
    assert [(Path(one.path).name, one.why) for one in forgotten_pictures(drive.store())] == [
        (name, "asked by a resident") for name in gone
    ]
    ran = cli("run", survey, "--workers", "0")
    assert ran.exit_code == 0, ran.output
    rows = cli("sql", "SELECT count(*) AS n FROM images", "--survey", survey, "--json")
    assert json.loads(rows.stdout) == [{"n": len(before) - 2}]
    assert cli("clean", survey, "--remove").exit_code == 0
    for name in gone:
        kept = names_in(drive, name)
        assert FORGOTTEN in kept and all(path.startswith(("manifest/", "tables/rejects")) for path in kept), kept


@pytest.mark.parametrize("stops_at", [Archive, Path])
def test_a_command_that_is_stopped_is_called_again(
    drive: Drive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stops_at: type
) -> None:
    """It stops behind the removal of the first copy, or of the first file: then lists name what is gone."""
    survey, archive = str(drive.survey_file), str(tmp_path / "archive")
    assert cli("archive", survey, "--to", archive).exit_code == 0
    gone = list(pictures(drive))[2:4]
    (copy,) = Path(archive).rglob(gone[0])
    (half := copy.with_name(f".{gone[0]}.part")).write_bytes(copy.read_bytes()[:2000])  # of a copy that was stopped
    words = [word for one in gone for word in ("--picture", f"run-1/camera/{one}")]
    command = ("forget", survey, *words, "--archive", archive, "--remove")
    name = "remove" if stops_at is Archive else "unlink"
    work = getattr(stops_at, name)

    def stopped(one: Any, *args: Any, **more: Any) -> None:
        work(one, *args, **more)
        if stops_at is Archive or one.suffix == ".jpg":
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(stops_at, name, stopped)
        assert cli(*command).exit_code != 0
    told = cli("verify", survey)
    left = [name for name in gone if name in pictures(drive)]
    assert left and told.exit_code == 1
    assert all(f"{name}: it is among the forgotten pictures and is still there" in told.output for name in left)
    done = cli(*command)
    assert done.exit_code == 0, (done.output, done.exception)
    assert not set(gone) & set(pictures(drive))
    assert not [path for path in Path(archive).rglob("*.jpg") if path.name in gone] and not half.exists()
    assert cli("archive", survey, "--to", archive, "--check").exit_code == 0


def test_a_span_of_time_goes(drive: Drive) -> None:
    survey = str(drive.survey_file)
    epochs = {name: int(row["epoch_gps_ns"]) for name, row in drive.poses.items()}
    ordered = sorted(epochs, key=lambda name: epochs[name])
    first, last = (iso_from_gps_ns(epochs[name] + shift) for name, shift in ((ordered[1], -1000), (ordered[3], 1000)))
    done = cli("forget", survey, "--camera", "run-1/camera", "--span", f"{first}/{last}", "--remove")
    assert done.exit_code == 0, done.output
    assert set(ordered) - set(pictures(drive)) == set(ordered[1:4])


def test_an_archive_gives_none_of_them_back(drive: Drive, tmp_path: Path) -> None:
    survey, archive = str(drive.survey_file), str(tmp_path / "archive")
    assert cli("archive", survey, "--to", archive).exit_code == 0
    name = next(iter(pictures(drive)))
    assert cli("forget", survey, "--picture", f"run-1/camera/{name}", "--remove").exit_code == 0
    for command in ("--restore", "--check"):
        told = cli("archive", survey, "--to", archive, command)
        assert told.exit_code == 1 and "among the forgotten pictures" in told.output
    assert name not in pictures(drive)
    assert cli("forget", survey, "--archive", archive, "--remove").exit_code == 0  # those that went before
    assert cli("archive", survey, "--to", archive, "--check").exit_code == 0


def test_what_is_no_picture_is_refused(drive: Drive) -> None:
    survey = str(drive.survey_file)
    before = pictures(drive)
    for words, told in (
        (("--picture", "run-1/camera/stamps.csv"), "there is no picture"),
        (("--picture", "run-1/camera/../../SURVEY.toml"), "there is no picture"),
        (("--camera", "run-1/other"), "one of run-1/camera"),
        (("--span", "2026-05-04T09:30:00Z", "--list", "/dev/null"), "no picture is named"),
        (("--span", "2026-05-04T09:30:00Z", "--picture", f"run-1/camera/{next(iter(before))}"), "and --camera"),
        ((), "no picture is named"),
    ):
        result = cli("forget", survey, *words, "--remove")
        assert isinstance(result.exception, ConfigError) and told in str(result.exception)
    assert pictures(drive) == before


def test_a_damaged_record_is_told(drive: Drive) -> None:
    survey = str(drive.survey_file)
    assert cli("forget", survey, "--picture", f"run-1/camera/{next(iter(pictures(drive)))}", "--remove").exit_code == 0
    record = Path(drive.store().path(FORGOTTEN))
    record.write_bytes(record.read_bytes().replace(b"run-1", b"run-2", 1))
    verified = cli("verify", survey)
    assert verified.exit_code == 1 and "the record of forgotten pictures is damaged" in verified.output
    refused = cli("forget", survey, "--picture", f"run-1/camera/{next(iter(pictures(drive)))}", "--remove")
    assert isinstance(refused.exception, DamagedError)
