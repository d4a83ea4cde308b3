"""NovAtel's ASCII messages: lines that its documentation prints, with their CRC, against pyproj."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from roadscan.core.errors import TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.ingest.reading.format import format_of
from tests.formats.log_reading import Log, read_log

# NovAtel, OEM7 documentation: pages INSPVAX, INSPVAS, BESTPOS, and, of an older manual, a log of an INS that aligns
INSPVAX = "#INSPVAXA,USB1,0,65.5,FINESTEERING,2209,490782.000,02000020,46eb,16809;INS_SOLUTION_GOOD,INS_PPP,51.15043710672,-114.03067871892,1097.3598,-17.0001,-0.0016,0.0002,0.0029,-0.308665944,0.297893298,157.960833016,0.1816,0.1816,0.1808,0.0018,0.0018,0.0016,0.0292,0.0292,0.0582,13000045,0*a74644a2"  # noqa: E501
INSPVAS = "%INSPVASA,2209,490712.000;2209,490712.000000000,51.15043713712,-114.03067872932,1080.3580,0.0014,-0.0007,0.0015,-0.293782412,0.302470613,157.989827209,INS_SOLUTION_GOOD*a87ab88b"  # noqa: E501
INSPVA = "#INSPVAA,USB1,0,67.5,FINESTEERING,2209,490558.000,02000020,18bc,16809;2209,490558.000000000,51.15043714042,-114.03067871718,1080.3548,0.0051,-0.0014,-0.0012,-0.296402993,0.311887972,157.992156267,INS_SOLUTION_GOOD*cc698020"  # noqa: E501
BESTPOS = '#BESTPOSA,USB1,0,51.5,FINESTEERING,2404,603797.000,03000800,cdba,18018;SOL_COMPUTED,NARROW_INT,51.07899643518,-114.13251416136,1114.2977,-16.6000,WGS84,0.0079,0.0056,0.0141,"3920",1.000,0.000,34,31,31,30,00,21,7f,37*a5cec5c7'  # noqa: E501
# A pose between two milliseconds, whose header is rounded
BETWEEN = "#INSPVAA,COM1,0,31.0,FINESTEERING,1264,144088.000,02040000,5615,1541;1264,144088.002284950,51.116827527,-114.037738908,401.191547167,354.846489850,108.429407241,-10.837482850,1.116219952,-3.476059035,7.372686190,INS_ALIGNMENT_COMPLETE*a2913d36"  # noqa: E501
WEEK_NS = 604_800 * 10**9


def crc32(text: bytes) -> int:
    """The function that the manual prints, bit by bit."""
    crc = 0
    for byte in text:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xEDB88320 if crc & 1 else crc >> 1
    return crc


def sealed(message: str) -> str:
    """A message with the CRC of its content."""
    body = message.rsplit("*", 1)[0]
    return f"{body}*{crc32(body[1:].encode()):08x}"


def drive(line: str, stamp: str, count: int = 12) -> bytes:
    """One message a second."""
    week, seconds = stamp.split(",")
    times = (f"{week},{float(seconds) + k:.3f}" for k in range(count))
    return "".join(sealed(line.replace(stamp, time)) + "\r\n" for time in times).encode()


def read(folder: Path, name: str, content: str | bytes, **stated: object) -> Log:
    path = folder / "span.log"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    assert format_of(path).name == name
    return read_log(name, path, crs="EPSG:4979", **stated)


def test_the_three_messages_of_one_place_agree(tmp_path: Path) -> None:
    place = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978").transform(51.15043710672, -114.03067871892, 1080.3597)
    for line, seconds, heading in ((INSPVAX, 490_782, 157.960833016), (INSPVA, 490_558, 157.992156267)):
        log = read(tmp_path, "novatel_ins", line + "\r\n")
        assert log.epochs[0] == 2209 * WEEK_NS + seconds * 10**9
        np.testing.assert_allclose(log.positions[0], place, atol=0.01)
        ned = Rotation.from_euler("ZY", [-114.03067871892, -51.15043710672 - 90], degrees=True).inv() * log.attitudes[0]
        assert ned.as_euler("ZYX", degrees=True)[0] % 360 == pytest.approx(heading, abs=1e-6)
    short = read(tmp_path, "novatel_ins", INSPVAS + "\r\n")
    np.testing.assert_allclose(short.positions[0], place, atol=0.01)
    assert short.table["sigma_north_m"].null_count == 1
    log = read(tmp_path, "novatel_ins", INSPVAX + "\r\n")
    np.testing.assert_allclose(log.positions[0], place, atol=1e-4)
    assert log.column("sigma_heading_deg")[0] == pytest.approx(0.0582)
    np.testing.assert_allclose(log.rows[0].velocity_level_m_per_s[0], [-0.0016, 0.0002, -0.0029], atol=1e-6)


def test_the_time_is_that_of_the_pose(tmp_path: Path) -> None:
    log = read(tmp_path, "novatel_ins", BETWEEN + "\r\n")
    assert log.epochs.tolist() == [1264 * WEEK_NS + 144_088_002_284_950]


def test_bestpos(tmp_path: Path) -> None:
    log = read(tmp_path, "novatel_bestpos", BESTPOS + "\n" + BESTPOS.replace("NARROW_INT", "NARROW_FLOAT") + "\n")
    place = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978").transform(51.07899643518, -114.13251416136, 1097.6977)
    np.testing.assert_allclose(log.positions, [place], atol=1e-4)
    assert log.table["quality"].to_pylist() == ["fixed"]
    assert [log.column(name)[0] for name in ("satellites", "sigma_north_m", "age_s")] == pytest.approx([31, 0.0079, 1])
    assert [(r.record, r.reason) for r in log.rejects] == [(1, "the CRC-32 of the message is wrong")]


def test_what_is_no_pose_is_rejected(tmp_path: Path) -> None:
    aligning = sealed(INSPVAX.replace("INS_SOLUTION_GOOD", "INS_ALIGNING"))
    coarse = sealed(INSPVAX.replace("FINESTEERING", "COARSE"))
    lines = ["$GPGGA,junk*00", INSPVAX, aligning, coarse, INSPVAX.replace("51.15", "51.25"), INSPVAX[:90]]
    content = "\r\n".join(lines)
    log = read(tmp_path, "novatel_ins", content)
    assert log.epochs.size == 1
    assert {r.record: r.reason for r in log.rejects} == {
        2: "no solution yet: INS_ALIGNING",
        3: "the receiver did not know its time well yet: COARSE",
        4: "the CRC-32 of the message is wrong",
        5: "the line holds no sound message",
    }


def test_the_message_that_a_log_holds_most_often_is_read(tmp_path: Path) -> None:
    content = drive(INSPVA, "2209,490558.000") + INSPVAX.encode() + b"\n" + BESTPOS.encode() + b"\n"
    log = read(tmp_path, "novatel_ins", content)
    assert log.epochs.size == 12 and log.attributes["read"] == "INSPVAA"
    assert log.attributes["not_read"] == "INSPVAXA, BESTPOSA"
    stated = read_log("novatel_ins", tmp_path / "span.log", {"message": "INSPVAXA"}, crs="EPSG:4979")
    assert stated.epochs.size == 1
    with pytest.raises(TimeSystemError, match="GPS time"):
        read(tmp_path, "novatel_ins", content, clock=Clock(TimeSystem.UNIX_UTC))
