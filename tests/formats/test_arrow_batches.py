"""Arrow IPC files whose footer lists fewer record batches than the file holds."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pytest

from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.ingest.reading.column_table import unlisted_batches
from tests.formats import test_pose_quaternions
from tests.formats.log_reading import read_log
from tests.formats.readings import read
from tests.formats.test_scans import profiles, write_arrow, write_compressed


def with_shorter_footer(path: Path) -> int:
    """Damage the footer until Arrow sees fewer batches, at least one; how many it sees."""
    data = path.read_bytes()
    whole = pa.ipc.open_file(pa.BufferReader(data)).num_record_batches
    size = int.from_bytes(data[-10:-6], "little")
    for at in range(len(data) - 10 - size, len(data) - 10):
        if data[at] != whole:
            continue
        broken = data[:at] + bytes([whole - 1]) + data[at + 1 :]
        try:
            found = pa.ipc.open_file(pa.BufferReader(broken)).num_record_batches
        except (pa.ArrowException, OSError):
            continue
        if found == whole - 1:
            path.write_bytes(broken)
            return found
    raise AssertionError("the footer's list was not found")


def test_counting(tmp_path: Path) -> None:
    path = tmp_path / "a.arrow"
    write_arrow(profiles(), path)  # 200 profiles, 50 a batch
    assert [unlisted_batches(path, listed) for listed in (0, 3, 4, 5)] == [4, 1, 0, 0]
    data = path.read_bytes()
    for cut in range(0, len(data), 97):
        path.write_bytes(data[:cut])
        assert 0 <= unlisted_batches(path, 0) <= 4


@pytest.mark.parametrize("write", [write_arrow, write_compressed])
def test_scans(tmp_path: Path, write: object) -> None:
    path = tmp_path / "a.arrow"
    write(profiles(), path)  # type: ignore[operator]
    assert with_shorter_footer(path) == 3
    log = read("scans", path)
    assert len(log) == 150
    assert [r.reason for r in log.rejects] == ["1 record batches stand in the file, but not in its footer"]


def test_poses(tmp_path: Path) -> None:
    path = tmp_path / "a.feather"
    table = test_pose_quaternions.poses()
    with pa.OSFile(str(path), "wb") as sink, pa.ipc.new_file(sink, table.schema) as writer:
        for k in range(3):
            writer.write_table(table.slice(k, 1))
    with_shorter_footer(path)
    log = read_log("pose_quaternions", path, {"axes": "flu"}, clock=Clock(TimeSystem.GPS, unit="ns"), crs="local")
    assert log.table.num_rows == 2
    assert "1 record batches" in log.rejects[0].reason
