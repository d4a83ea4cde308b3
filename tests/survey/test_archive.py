"""Raw logs in an archive: the bytes that were ingested, in a folder and in an object store; and back."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest
from typer.testing import CliRunner, Result

from roadscan.cli import app
from roadscan.survey.archive import LIST
from tests.object_store import ObjectStore, served
from tests.surveys import Simulated


@pytest.fixture(scope="module")
def objects() -> Iterator[ObjectStore]:
    with served() as store:
        yield store


@pytest.fixture
def copy(finished: Simulated, tmp_path: Path) -> Simulated:
    return finished.copy_with_store_to(tmp_path / "survey")


@pytest.fixture(params=["folder", "s3"])
def to(request: pytest.FixtureRequest, tmp_path: Path, objects: ObjectStore) -> str:
    return str(tmp_path / "archive") if request.param == "folder" else f"{objects.url}/archive-{tmp_path.name}"


def archive(copy: Simulated, to: str, *options: str) -> Result:
    return CliRunner().invoke(app, ["archive", str(copy.survey_file), "--to", to, *options])


def raw_of(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("raw/**/*")) if p.is_file()}


@pytest.mark.slow
def test_logs_go_and_come_back(copy: Simulated, to: str) -> None:
    folder = copy.survey_file.parent
    raw = raw_of(folder)
    first = archive(copy, to)
    assert first.exit_code == 0, first.output
    assert "copied and read back" in first.output and "not ingested" not in first.output
    again = archive(copy, to)
    assert "copied" not in again.output and " there" in again.output
    assert archive(copy, to, "--check").exit_code == 0
    shutil.rmtree(folder / "raw")
    assert copy.run().raw_bytes_read == 0  # what was ingested needs no raw log
    back = archive(copy, to, "--restore")
    assert back.exit_code == 0, back.output
    named = {name: content for name, content in raw.items() if (folder / name).exists()}
    assert raw_of(folder) == named
    assert {name for name in raw if name.endswith((".pcap", ".sbet", ".parquet", ".smrmsg"))} <= named.keys()


def test_a_flipped_bit_a_lost_file_and_a_damaged_list_are_named(copy: Simulated, to: str) -> None:
    archive(copy, to)
    fs, base = fsspec.core.url_to_fs(to)
    place = f"{base}/raw/run-1/lidar.pcap"
    content = bytearray(fs.cat_file(place))
    content[1000] ^= 1
    fs.pipe_file(place, bytes(content))
    fs.rm_file(f"{base}/raw/run-2/lidar.pcap")
    checked = archive(copy, to, "--check")
    assert checked.exit_code == 1
    assert "raw/run-1/lidar.pcap: its bytes are others" in checked.output
    assert "raw/run-2/lidar.pcap: it is not there" in checked.output
    (copy.survey_file.parent / "raw/run-1/lidar.pcap").unlink()
    restored = archive(copy, to, "--restore")
    assert restored.exit_code == 1
    assert "nothing was restored of it" in restored.output
    assert not (copy.survey_file.parent / "raw/run-1/lidar.pcap").exists()
    fs.pipe_file(f"{base}/{LIST}", fs.cat_file(f"{base}/{LIST}").replace(b"lidar", b"radar"))
    assert "the archive's list is damaged" in str(archive(copy, to, "--check").exception)


def test_a_log_that_is_another_than_was_ingested_is_named(copy: Simulated, tmp_path: Path) -> None:
    """Its size and time are those that are known, and its bytes are not: a disk that rots."""
    log = copy.survey_file.parent / "raw/run-1/lidar.pcap"
    stat = log.stat()
    content = bytearray(log.read_bytes())
    content[5000] ^= 4
    log.write_bytes(bytes(content))
    os.utime(log, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    copy.run()
    os.utime(log, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    done = archive(copy, str(tmp_path / "archive"))
    assert done.exit_code == 1, done.output
    assert "raw/run-1/lidar.pcap: its bytes are others than those that were ingested" in done.output
    assert not (tmp_path / "archive/raw/run-1/lidar.pcap").exists()
