"""UBX against the NMEA sentences that the same receiver wrote between its messages, and damaged frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyproj
import pytest

from roadscan.formats.motion.ubx import HEADER, SOLUTION
from roadscan.ingest.reading.format import format_of
from tests.formats.log_reading import Log, read_log

FLAGS_AT = 6 + 21
VALID_AT = 6 + 11
FLAGS3_AT = 6 + 78


@pytest.fixture
def recording(faults: Path) -> bytes:
    return (faults / "ublox_ubx_nmea_mixed.log").read_bytes()


def read(folder: Path, content: bytes) -> Log:
    path = folder / "log.ubx"
    path.write_bytes(content)
    return read_log("ubx", path, crs="EPSG:4979")


def sealed(frame: bytearray) -> bytes:
    """A frame with its checksum as u-blox defines it (RFC 1145)."""
    first = second = 0
    for byte in frame[2:-2]:
        first = (first + byte) % 256
        second = (second + first) % 256
    frame[-2:] = bytes([first, second])
    return bytes(frame)


def sample(count: int = 20) -> bytes:
    """Solutions of a drive north at 1 Hz, fixed."""
    frames = np.zeros(count, SOLUTION)
    for name, value in {
        "sync": np.void(HEADER), "year": 2026, "month": 5, "day": 4, "hour": 9, "minute": 30,
        "second": np.arange(count), "valid": 7, "fix": 3, "flags": 0b1000_0011, "satellites": 17,
        "longitude": 150_000_000, "latitude": 498_000_000 + 1000 * np.arange(count), "height_mm": 250_000,
        "sigma_horizontal_mm": 14, "sigma_vertical_mm": 20,
    }.items():  # fmt: skip
        frames[name] = value
    return b"".join(sealed(bytearray(one.tobytes())) for one in frames)


def changed(content: bytes, at: int, value: int, *, checksum: bool = True) -> bytes:
    """A byte of the first NAV-PVT changed."""
    start = content.index(HEADER)
    frame = bytearray(content[start : start + SOLUTION.itemsize])
    frame[at] = value
    return content[:start] + (sealed(frame) if checksum else bytes(frame)) + content[start + SOLUTION.itemsize :]


def test_solutions_are_those_of_the_sentences_beside_them(tmp_path: Path, recording: bytes, faults: Path) -> None:
    """GGA: 53°27.03557' N, 2°14.42234' W, 65.4 m over the geoid, 48.5 m of undulation, 5 satellites, 10:41:13."""
    assert format_of(faults / "ublox_ubx_nmea_mixed.log").name == "ubx"
    log = read(tmp_path, recording)
    to_degrees = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    lon, lat, height = to_degrees.transform(*log.positions.T)
    np.testing.assert_allclose(lat, [53 + 27.03557 / 60, 53 + 27.03556 / 60], atol=2e-7)
    np.testing.assert_allclose(lon, [-(2 + 14.42234 / 60), -(2 + 14.42166 / 60)], atol=2e-7)
    np.testing.assert_allclose(height, [65.4 + 48.5, 65.2 + 48.5], atol=0.06)
    assert log.column("satellites").tolist() == [5, 5]
    assert log.table.column("quality").to_pylist() == ["single", "single"]
    # 2021-03-07 10:41:13 UTC is 18 s less in UTC than in GPS time; the receiver's clock is within a millisecond.
    utc_s = (log.epochs / 1e9 + 315_964_800 - 18) - 1_615_075_200
    np.testing.assert_allclose(utc_s, [10 * 3600 + 41 * 60 + 13, 10 * 3600 + 41 * 60 + 14], atol=1e-3)
    assert log.attributes["not_read"] == "NMEA sentences between the UBX messages"
    assert log.rejects == []


def test_damaged_and_undated_solutions_are_rejected(tmp_path: Path, recording: bytes) -> None:
    for content, reason in (
        (changed(recording, 40, 7, checksum=False), "checksum"),
        (changed(recording, VALID_AT, 0b001), "date and time"),
        (changed(recording, FLAGS3_AT, 1), "invalidLlh"),
    ):
        log = read(tmp_path, content)
        assert len(log.epochs) == 1
        assert [reason in one.reason and one.record == 0 for one in log.rejects] == [True]


@pytest.mark.parametrize(
    ("flags", "quality"), [(0b0000_0011, "dgps"), (0b0100_0011, "float"), (0b1000_0011, "fixed"), (0, "none")]
)
def test_kinds_of_solutions(tmp_path: Path, recording: bytes, flags: int, quality: str) -> None:
    log = read(tmp_path, changed(recording, FLAGS_AT, flags))
    assert log.table.column("quality").to_pylist() == [quality, "single"]


def test_frames_are_found_across_blocks(
    tmp_path: Path, recording: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    whole = read(tmp_path, recording)
    for size in (1, 99, 100, 101, 517):
        monkeypatch.setattr("roadscan.formats.motion.ubx._BLOCK_BYTES", size)
        assert read(tmp_path, recording).table.equals(whole.table)


@pytest.mark.parametrize(
    ("sentence", "name"),
    [
        (b"$GNGGA,,,,,,0,00,99.99,,,,,,*56\r\n", "ubx"),  # a receiver that writes NMEA without a fix
        (b"$GPGGA,092750.000,5321.6802,N,00630.3372,W,1,8,1.03,61.7,M,55.2,M,,*76\r\n", "nmea"),
    ],
)
def test_sentences_without_a_position_leave_the_log_to_ubx(tmp_path: Path, sentence: bytes, name: str) -> None:
    frames = sample()
    size = SOLUTION.itemsize
    path = tmp_path / "mixed.ubx"
    path.write_bytes(b"".join(frames[k : k + size] + sentence for k in range(0, len(frames), size)))
    assert format_of(path).name == name
