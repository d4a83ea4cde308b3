"""What goes into a log comes out of its reader, for any values; and junk between records costs no record."""

from __future__ import annotations

import csv
import io
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pyproj
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from roadscan.core.crs import MapFrame
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.ingest.reading.text_table import Reject, TextOptions, text_blocks, text_layout
from tests.formats import test_scans as scan_files
from tests.formats import test_sick_lms as telegrams
from tests.formats.log_reading import read_log
from tests.formats.readings import read
from tests.formats.sick_files import encode_scans

WEEK = 2405
WEEK_NS = WEEK * 604_800 * 10**9
ECEF = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
EXAMPLES = settings(max_examples=30, deadline=None)


@contextmanager
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_subnormal=False)


STEPS_NS = st.lists(st.integers(1, 5 * 10**9), min_size=1, max_size=30)
POSES = st.lists(
    st.tuples(numbers(-1.55, 1.55), numbers(-3.14, 3.14), numbers(-400, 8000), numbers(-3, 3), numbers(-1.5, 1.5),
              numbers(0, 6.28), numbers(-3, 3)),
    min_size=30, max_size=30,
)  # fmt: skip


@EXAMPLES
@given(start_s=numbers(0, 604_000), steps_ns=STEPS_NS, poses=POSES)
def test_sbet(start_s: float, steps_ns: list[int], poses: list[tuple[float, ...]]) -> None:
    seconds = start_s + np.cumsum(steps_ns) / 1e9
    rows = np.zeros((seconds.size, 17))
    rows[:, 0] = seconds
    for row, (latitude, longitude, height, roll, pitch, heading, wander) in zip(rows, poses, strict=False):
        row[[1, 2, 3, 7, 8, 9, 10]] = latitude, longitude, height, roll, pitch, heading, wander
    with folder() as place:
        rows.astype("<f8").tofile(place / "a.sbet")
        log = read_log("sbet", place / "a.sbet", clock=Clock(TimeSystem.GPS_WEEK, week=WEEK), crs="EPSG:4979")
    assert log.rejects == []
    np.testing.assert_allclose(log.epochs - WEEK_NS, seconds * 1e9, rtol=0, atol=200)
    latitude, longitude = rows[:, 1], rows[:, 2]
    expected = np.stack(ECEF.transform(np.degrees(longitude), np.degrees(latitude), rows[:, 3]), axis=-1)
    np.testing.assert_allclose(log.positions, expected, atol=1e-8)
    ned_from_body = Rotation.from_euler("ZYX", np.stack([rows[:, 9] - rows[:, 10], rows[:, 8], rows[:, 7]], axis=-1))
    north = np.stack([-np.sin(latitude) * np.cos(longitude), -np.sin(latitude) * np.sin(longitude), np.cos(latitude)])
    down = -np.stack([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    ecef_from_ned = np.stack([north, np.cross(down, north, axis=0), down], axis=-1).transpose(1, 0, 2)
    turned = log.attitudes.inv() * Rotation.from_matrix(ecef_from_ned) * ned_from_body
    assert turned.magnitude().max() < 1e-9


@EXAMPLES
@given(steps_ns=STEPS_NS, sigmas=st.lists(numbers(0, 10), min_size=9, max_size=9))
def test_smrmsg(steps_ns: list[int], sigmas: list[float]) -> None:
    seconds = 1000 + np.cumsum(steps_ns) / 1e9
    rows = np.column_stack([seconds, np.tile(sigmas, (seconds.size, 1))])
    with folder() as place:
        rows.astype("<f8").tofile(place / "a.out")
        log = read_log("smrmsg", place / "a.out", clock=Clock(TimeSystem.GPS_WEEK, week=WEEK))
    assert log.rejects == []
    np.testing.assert_allclose(log.epochs - WEEK_NS, seconds * 1e9, rtol=0, atol=200)
    assert np.array_equal(log.column("sigma_north_m"), rows[:, 1].astype(np.float32))
    np.testing.assert_allclose(log.column("sigma_heading_deg"), rows[:, 9] / 60, rtol=1e-6, atol=1e-40)


@EXAMPLES
@given(data=st.data(), count=st.integers(1, 8), readings=st.sampled_from([101, 181]))
def test_lms_telegrams_between_junk(data: st.DataObject, count: int, readings: int) -> None:
    """Whatever stands between telegrams, short of a telegram, none is lost and none is found twice."""
    ranges = np.random.default_rng(data.draw(st.integers(0, 99))).integers(1, 8000, (count, readings), dtype=np.uint16)
    # Eight bytes before each telegram look like stamps, and the reader asks for them.
    junk = [data.draw(st.binary(max_size=40).filter(lambda b: len(b) != 8)) for _ in range(count + 1)]
    units = [row.tobytes() for row in encode_scans(ranges, "mm")]
    with folder() as place:
        path = place / "a.log"
        path.write_bytes(junk[0] + b"".join(t + j for t, j in zip(units, junk[1:], strict=True)))
        log = read("sick_lms", path, telegrams.BY_RATE, clock=telegrams.GPS)
    assert np.array_equal(telegrams.ranges(log), ranges)


@EXAMPLES
@given(data=st.data(), profiles=st.integers(1, 40), readings=st.integers(1, 50), group=st.integers(1, 40))
def test_scans(data: st.DataObject, profiles: int, readings: int, group: int) -> None:
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    epochs = 1_462_000_000_000_000_000 + np.cumsum(rng.integers(1, 10**9, profiles))
    ranges = rng.integers(0, 65_536, (profiles, readings)).astype(np.uint16)
    bright = rng.integers(0, 256, (profiles, readings)).astype(np.uint8)
    geometry = scan_files.GEOMETRY | {"readings": readings}
    table = scan_files.profiles(
        geometry, epoch_gps_ns=epochs, range=scan_files.fixed(ranges), intensity=scan_files.fixed(bright)
    )
    with folder() as place:
        if data.draw(st.booleans()):
            pq.write_table(table, place / "a", row_group_size=group, data_page_size=data.draw(st.integers(64, 4096)))
        else:
            with pa.OSFile(str(place / "a"), "wb") as sink, pa.ipc.new_file(sink, table.schema) as writer:
                writer.write_table(table, group)
        log = read("scans", place / "a")
    assert log.rejects == []
    assert np.array_equal(log.epochs, epochs)
    assert log.table.column("range").to_pylist() == ranges.tolist()
    assert log.table.column("intensity").to_pylist() == bright.tolist()


NAMES = st.text(st.characters(categories=["L", "N", "P", "S", "Zs"], codec="utf-8"), min_size=1, max_size=12)


@EXAMPLES
@given(
    points=st.lists(
        st.tuples(NAMES, numbers(200_000, 800_000), numbers(5.2e6, 5.9e6), numbers(-100, 3000)),
        min_size=1, max_size=12, unique_by=lambda p: p[0].strip(),
    )
)  # fmt: skip
def test_control_csv(points: list[tuple[str, float, float, float]]) -> None:
    points = [p for p in points if p[0].strip() and not p[0].startswith("#")]
    sink = io.StringIO()
    writer = csv.writer(sink, lineterminator="\n")
    writer.writerow(["name", "role", "easting", "northing", "height_m"])
    writer.writerows([name, "gcp", easting, northing, height] for name, easting, northing, height in points)
    with folder() as place:
        (place / "a.csv").write_text(sink.getvalue(), encoding="utf-8", newline="")
        log = read_log(
            "control_csv", place / "a.csv", crs="EPSG:25832", height="ellipsoidal", map=MapFrame(crs="EPSG:25832")
        )
    assert log.rejects == []
    assert log.table.column("name").to_pylist() == [p[0].strip() for p in points]
    found = np.stack([log.column(c) for c in ("easting_m", "northing_m", "height_m")], axis=-1)
    np.testing.assert_allclose(found, np.array([p[1:] for p in points]).reshape(-1, 3), rtol=0, atol=1e-7)


WORDS = st.one_of(st.floats().map(repr), st.text("0123456789.,-+eExn_\"'# \r\x00aé", max_size=6), st.just(""))


@pytest.mark.slow
@settings(max_examples=120, deadline=None)
@given(rows=st.lists(st.lists(WORDS, min_size=1, max_size=4), max_size=8), end=st.sampled_from(["\n", "\r\n", ""]))
def test_a_line_of_text_is_read_or_rejected_on_its_own(rows: list[list[str]], end: str) -> None:
    """Lines in one file, and each in a file of its own: the same values, the same rejects."""
    lines = [",".join(row).rstrip("\r") for row in rows]  # at its end, a return is part of the line feed
    with folder() as place:
        together = _lines_of(place / "a.csv", lines, end)
        apart = [found for line in lines for found in _lines_of(place / "b.csv", [line], end)]
    assert together == apart


def _lines_of(path: Path, lines: list[str], end: str) -> list[Any]:
    """Values of each line's three columns, or the reason of its reject; in order of the lines."""
    path.write_bytes(b"a,b,c\n" + "\n".join(lines).encode() + end.encode())
    layout = text_layout(path, TextOptions())
    found: dict[int, Any] = {}
    for block in text_blocks(path, layout, {"a": "number", "b": "integer", "c": "text"}):
        if isinstance(block, Reject):
            found[block.record] = block.reason
            continue
        columns = [block.columns[name].to_pylist() for name in "abc"]
        for k, record in enumerate(block.records.tolist()):
            found[record] = repr([column[k] for column in columns])
    assert sorted(found) == list(range(len(found)))
    return [found[k] for k in sorted(found)]
