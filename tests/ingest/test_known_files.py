"""Files of makers' own formats: one sentence says what each is, and which program exports what is read."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from roadscan.ingest.inspect.file_kinds import known_file, known_files
from roadscan.ingest.reading.format import log_formats
from tests.answers import roadscan

CAPTURED = b"\xd4\xc3\xb2\xa1" + bytes(28) + b"\xe0\4\0\0" * 2 + bytes(42)  # up to the payload
# First bytes as their makers publish them
FIRST_BYTES = {
    "a.sbf": (b"$@\x1c\x35\xa7\x0f\x60\x00" + bytes(90), "Septentrio", "RINEX"),
    "span.log": (b"\xaa\x44\x12\x1c\x2a\x00" + bytes(200), "NovAtel", "novatel_ins"),
    "pos.000": (b"$GRP\x01\x00" + bytes(200), "Applanix", "SBET"),
    "cloud.bin": (b"CCB2" + bytes(90), "CloudCompare", "E57"),
    "a.osf": (b"\x2c\0\0\0\x14\0\0\0OSF!" + bytes(90), "Ouster", "pcap"),
    "at128.pcap": (CAPTURED + bytes.fromhex("eeff0403000080020004") + bytes(900), "Hesai AT128", "ROS bag"),
    "jt128.pcap": (CAPTURED + bytes.fromhex("eeff0108000080020004") + bytes(900), "Hesai JT", "ROS bag"),
    "hdl64.pcap": (CAPTURED + (b"\xff\xee" + bytes(98) + b"\xff\xdd" + bytes(98)) * 6, "HDL-64E", "velodyne-decoder"),
    "bpearl.pcap": (CAPTURED + bytes.fromhex("55aa050a5aa550a0") + bytes(23) + b"\3\4" + bytes(900), "V4", "ROS bag"),
    "rs80.pcap": (CAPTURED + bytes.fromhex("55aa055a") + bytes(76) + (b"\xfe\1" + bytes(242)) * 4, "80", "ROS bag"),
}
# Others by the endings of their names
ENDINGS = {
    "a.rxp": ("RIEGL", "RiPROCESS"), "a.rdbx": ("RIEGL", "LAS"), "a.lgs": ("Leica", "Cyclone"),
    "a.sdb": ("Leica", "CSV"),
    "a.ptx": ("Leica", "E57"), "a.tzf": ("Trimble", "RealWorks"), "a.rwp": ("Trimble", "E57"),
    "a.T02": ("Trimble", "RINEX"),
    "a.FLS": ("Faro", "SCENE"), "a.fis": ("LCMS", "Pavemetrics"), "a.geoslam": ("GeoSLAM", "LAS"),
    "a.zfs": ("Z+F", "E57"),
    "a.tps": ("Topcon", "RINEX"), "a.imr": ("Waypoint", "Inertial Explorer"),
}  # fmt: skip


def words_of(path: Path) -> str:
    done = roadscan("inspect", path)
    assert done.exit_code == 2
    return " ".join(done.stdout.split())


@pytest.mark.parametrize("name", FIRST_BYTES)
def test_first_bytes_tell(tmp_path: Path, name: str) -> None:
    content, maker, way = FIRST_BYTES[name]
    path = tmp_path / name
    path.write_bytes(content)
    said = words_of(path)
    assert maker in said and way in said and "which roadscan does not read" in said
    assert known_file(tmp_path / "without_an_ending", content) is known_file(path, content)


@pytest.mark.parametrize("name", ENDINGS)
def test_endings_tell(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(bytes(range(256)) * 4)
    maker, way = ENDINGS[name]
    said = words_of(tmp_path / name)
    assert maker in said and way in said and "which roadscan does not read" in said


def test_the_table_names_formats_that_are_read() -> None:
    endings = [suffix for one in known_files() for suffix in one.suffixes]
    assert len(set(endings)) == len(endings)
    own = {suffix for one in log_formats().values() for suffix in one.suffixes}
    assert not own & set(endings)
    named = {name for one in known_files() for group in re.findall(r"\(formats? ([\w, ]+)\)", one.way_out)
             for name in group.split(", ")}  # fmt: skip
    assert named <= set(log_formats())
