"""The Velodyne capture: every return is kept or counted as rejected, and the hour is stated, not guessed."""

from __future__ import annotations

import datetime as dt
import struct

import numpy as np
import pytest

from roadscan.core.errors import RunError
from roadscan.core.gpstime import gps_ns_from_utc
from roadscan.store.query.sql import query
from tests.real_data.conftest import Place

PCAP_HEAD, RECORD_HEAD, UDP_HEAD, BLOCK = 24, 16, 42, 100


def recorded_returns(capture: bytes) -> np.ndarray:
    """Return slots (packets, lasers) that hold a distance: 12 blocks of 32 lasers a packet (manual 63-9113)."""
    counts = []
    at = PCAP_HEAD
    while at < len(capture):
        (size,) = struct.unpack_from("<I", capture, at + 8)
        payload = capture[at + RECORD_HEAD + UDP_HEAD : at + RECORD_HEAD + size]
        blocks = np.frombuffer(payload[: 12 * BLOCK], np.uint8).reshape(12, BLOCK)[:, 4:].reshape(12, 32, 3)
        counts.append(((blocks[..., 0].astype(int) | blocks[..., 1].astype(int) << 8) > 0).sum(axis=0))
        at += RECORD_HEAD + size
    return np.array(counts)


def test_all_returns_are_kept(place: Place) -> None:
    survey_file = place.folder / "hdl32e.toml"
    place.run(survey_file, "ingest")
    recorded = recorded_returns((place.recordings / "velodyne" / "hdl32e.pcap").read_bytes())
    (log,) = place.records(survey_file)
    assert log.rows + log.rejected == recorded.sum() == 146_705
    found = query(
        place.store(survey_file),
        "SELECT laser, count(*) AS returns, min(epoch_gps_ns) AS first, max(epoch_gps_ns) AS last "
        "FROM returns GROUP BY laser ORDER BY laser",
    ).to_pandas()
    by_laser = np.zeros(32, dtype=int)
    by_laser[found.laser] = found.returns
    assert by_laser.tolist() == recorded.sum(axis=0).tolist()
    # The first packet's stamp is 835,374,683 µs past the hour; the last packet's is 0.275927 s later.
    start = gps_ns_from_utc(dt.datetime(2011, 10, 28, 2, 13, 55, 374_683, tzinfo=dt.UTC))
    assert 0 <= found["first"].min() - start < 50_000
    assert 0 <= found["last"].max() - start - 275_927_000 < 600_000


def test_a_damaged_packet_is_counted(place: Place) -> None:
    capture = bytearray((place.recordings / "velodyne" / "hdl32e.pcap").read_bytes())
    recorded = recorded_returns(bytes(capture))
    packet = PCAP_HEAD + 100 * (RECORD_HEAD + 1248)
    capture[packet + RECORD_HEAD + UDP_HEAD] ^= 0xFF
    (place.unpacked / "damaged.pcap").write_bytes(capture)
    changed = {"recordings/velodyne/hdl32e.pcap": "unpacked/damaged.pcap", 'id = "hdl32e"': 'id = "damaged"'}
    survey_file = place.file("hdl32e.toml", changed, "damaged.toml")
    place.run(survey_file, "ingest")
    (log,) = place.records(survey_file)
    assert log.rows == recorded.sum() - recorded[100].sum()
    (reject,) = query(place.store(survey_file), "SELECT record, records, reason FROM rejects").to_pylist()
    assert (reject["record"], reject["records"]) == (100, 1)


def test_the_hour_is_not_guessed(place: Place) -> None:
    changed = {"options = { hour = 2 }": "", 'id = "hdl32e"': 'id = "no-hour"'}
    survey_file = place.file("hdl32e.toml", changed, "no-hour.toml")
    with pytest.raises(RunError, match=r"hdl32e\.pcap: the hour is not known.*options\.hour"):
        place.run(survey_file, "ingest")
    assert place.records(survey_file) == []
