"""GPX: a track of a hand-held receiver, and points that others write, against pyproj."""

from __future__ import annotations

import datetime as dt
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pyproj
import pytest

from roadscan.core.errors import ConfigError, CrsError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem, gps_ns_from_utc
from roadscan.ingest.reading.format import format_of
from tests.formats.log_reading import Log, read_log

POINT = '<trkpt lat="{lat:.9f}" lon="13.7"><ele>211.5</ele><time>2026-05-04T09:30:{k:02d}.250Z</time><fix>dgps</fix><sat>9</sat></trkpt>'  # noqa: E501
HEAD = '<?xml version="1.0"?>\n<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>\n'


def track(count: int = 12) -> str:
    points = [POINT.format(lat=45.27 + 1e-5 * k, k=k) for k in range(count)]
    return HEAD + "\n".join(points) + "\n</trkseg></trk></gpx>\n"


def read(folder: Path, text: str, **stated: object) -> Log:
    path = folder / "a.gpx"
    path.write_text(text)
    assert format_of(path).name == "gpx"
    return read_log("gpx", path, **{"height": "ellipsoidal"} | stated)


def test_the_track_of_a_receiver(faults: Path) -> None:
    path = faults / "track.gpx"
    assert format_of(path).name == "gpx"
    log = read_log("gpx", path, {"quality": "single"}, height="ellipsoidal")
    points = list(ET.parse(path).iter("{http://www.topografix.com/GPX/1/1}trkpt"))
    assert log.table.num_rows == len(points) == 104 and log.rejects == []
    space = "{http://www.topografix.com/GPX/1/1}"
    degrees = [(float(p.get("lat", "")), float(p.get("lon", "")), float(p.findtext(space + "ele", ""))) for p in points]
    places = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978").transform(*np.transpose(degrees))
    np.testing.assert_allclose(log.positions, np.transpose(places), atol=1e-6)
    times = [gps_ns_from_utc(dt.datetime.fromisoformat(p.findtext(space + "time", ""))) for p in points]
    assert log.epochs.tolist() == times
    assert set(log.table["quality"].to_pylist()) == {"single"}


def test_what_points_state_and_what_they_lack(tmp_path: Path) -> None:
    lines = track(6).splitlines()
    lines[3] = lines[3].replace("<ele>211.5</ele>", "")
    lines[4] = lines[4].replace("Z</time>", "</time>").replace("<fix>dgps", "<fix>none")  # UTC without saying so
    lines[5] = lines[5].replace("<time>", "<tame>")
    lines[6] = lines[6].replace('lat="45.270040000"', 'lat="north"')
    log = read(tmp_path, "\n".join(lines))
    assert log.table["quality"].to_pylist() == ["dgps", "none", "dgps"]
    assert {r.record for r in log.rejects} == {1, 3, 4}
    assert log.column("satellites").tolist() == [9, 9, 9]
    assert log.epochs[0] == gps_ns_from_utc(dt.datetime(2026, 5, 4, 9, 30, 0, 250_000, tzinfo=dt.UTC))
    assert log.epochs[1] - log.epochs[0] == 2 * 10**9


def test_points_across_pieces_and_a_file_cut_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = read(tmp_path, track())
    for size in (60, 150, 1000):
        monkeypatch.setattr("roadscan.ingest.reading.text_table.BLOCK_BYTES", size)
        assert read(tmp_path, track()).table.equals(whole.table)
    log = read(tmp_path, track()[:-130])
    assert (log.table.num_rows, log.rejects[0].reason) == (11, "the file ends inside a track point")


def test_nothing_is_guessed(tmp_path: Path) -> None:
    plain = track().replace("<fix>dgps</fix>", "")
    with pytest.raises(ConfigError, match=r"quality.*single"):
        read(tmp_path, plain)
    with pytest.raises(ConfigError, match="kind of the log's heights"):
        read(tmp_path, track(), height=None)
    with pytest.raises(CrsError, match="geoid"):
        read(tmp_path, track(), height="orthometric")
    with pytest.raises(TimeSystemError, match="UTC"):
        read(tmp_path, track(), clock=Clock(TimeSystem.GPS))


def test_points_in_comments_are_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = read(tmp_path, track())
    lines = track().splitlines()
    away = lines[4].replace("45.27", "49.27")
    for start, end in (("<!-- ", " -->"), ("<desc><![CDATA[", "]]></desc>")):
        text = "\n".join([*lines[:2], f"{start}{away}\n{away}{end}", *lines[2:5], f"{start}{away}{end}", *lines[5:]])
        for size in (7, 60, 1 << 20):
            monkeypatch.setattr("roadscan.ingest.reading.text_table.BLOCK_BYTES", size)
            log = read(tmp_path, text)
            assert log.table.equals(plain.table) and not log.rejects
    log = read(tmp_path, "\n".join([*lines[:6], "<!--", *lines[6:]]))
    assert (log.table.num_rows, log.rejects[0].reason) == (4, "the file ends inside a comment or CDATA section")


def test_names_with_a_prefix(tmp_path: Path) -> None:
    """Only elements of GPX's own namespace count: an extension may have a time of its own."""
    text = track().replace("xmlns=", "xmlns:g=").replace("<ele>", "<e:time>1999-01-01T00:00:00Z</e:time><ele>")
    for name in ("gpx", "trk", "trkseg", "trkpt", "ele", "time", "fix", "sat"):
        text = text.replace(f"<{name} ", f"<g:{name} ").replace(f"<{name}>", f"<g:{name}>")
        text = text.replace(f"</{name}>", f"</g:{name}>")
    assert read(tmp_path, text).table.equals(read(tmp_path, track()).table)
