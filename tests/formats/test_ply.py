"""PLY: hand-made bytes in all three codings, files of plyfile, a twin of a LAS file, damage."""

from __future__ import annotations

import gzip
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from roadscan.core.errors import ConfigError, CrsError, FormatError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.ingest.reading.format import format_of
from tests.formats.readings import read_ellipsoidal as read

plyfile = pytest.importorskip("plyfile")

NOON: dict[str, Any] = {"epoch": "2026-05-04T12:00:00Z", "unit": "metre"}
NOON_GPS_NS = 1_461_931_218_000_000_000
ADJUSTED = Clock(TimeSystem.GPS_ADJUSTED)
CODINGS = ("ascii", "binary_little_endian", "binary_big_endian")


def xyz_of(log: Any) -> np.ndarray:
    return np.stack([log[f"{a}_m"] for a in "xyz"], axis=-1)


def written(folder: Path, data: bytes | str) -> Path:
    path = folder / "scan.ply"
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return path


def head(coding: str, *lines: str) -> bytes:
    return "\n".join(["ply", f"format {coding} 1.0", *lines, "end_header", ""]).encode()


XYZ = ("property double x", "property double y", "property float z")


def small_ply(coding: str = "binary_little_endian", lists: bool = False) -> bytes:
    """A sound file of 30 points between two other elements, for damaging."""
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[coding]
    listed = ("property list uchar short extra",) if lists else ()
    top = head(
        coding, "comment made by hand", "element camera 2", "property int id", "property list uchar float view",
        "element vertex 30", *XYZ, "property uchar intensity", "property double gps_time", *listed,
        "element face 1", "property list uchar int vertex_indices",
    )  # fmt: skip
    rows = [(0.5 * k, -2.0 * k, 0.25 * k, 8 * k, 3e8 + k, [k] * (k % 3)) for k in range(30)]
    if not order:
        lines = ["1 2 0.5 0.5", "2 0"]
        lines += [
            f"{x} {y} {z} {i} {t!r}" + (f" {len(e)} {' '.join(map(str, e))}" if lists else "")
            for x, y, z, i, t, e in rows
        ]
        return top + "\n".join([*lines, "3 0 1 2", ""]).encode()
    body = struct.pack(f"{order}iBff", 1, 2, 0.5, 0.5) + struct.pack(f"{order}iB", 2, 0)
    for x, y, z, i, t, e in rows:
        body += struct.pack(f"{order}ddfBd", x, y, z, i, t)
        body += struct.pack(f"{order}B{len(e)}h", len(e), *e) if lists else b""
    return top + body + struct.pack(f"{order}B3i", 3, 0, 1, 2)


# --- known values ------------------------------------------------------------------------------------


@pytest.mark.parametrize("lists", [False, True])
@pytest.mark.parametrize("coding", CODINGS)
def test_hand_made_bytes(tmp_path: Path, coding: str, lists: bool) -> None:
    path = written(tmp_path, small_ply(coding, lists))
    assert format_of(path).name == "ply"
    log = read("ply", path, {"unit": "metre"}, crs="EPSG:25832", clock=ADJUSTED)
    k = np.arange(30)
    assert log.rejects == []
    assert np.array_equal(xyz_of(log), np.stack([0.5 * k, -2.0 * k, 0.25 * k], axis=-1))
    assert np.array_equal(log["intensity"], 8 * k * 257)
    assert np.array_equal(log.epochs, (1_300_000_000 + k) * 10**9)
    assert set(log["point_source_id"]) == {1}
    assert log.attributes["taken"] == {"intensity": "intensity", "time": "gps_time"}
    assert log.attributes["left_out"] == (["extra"] if lists else [])


def test_unit_shift_and_the_one_epoch(tmp_path: Path) -> None:
    path = written(tmp_path, head("binary_big_endian", "element vertex 1", *XYZ) + struct.pack(">ddf", 1.0, 2.0, 3.0))
    options = {"unit": "us_survey_foot", "shift": [1_000_000.0, 0.0, -1.0], "point_source_id": 9}
    log = read("ply", path, NOON | options, crs="EPSG:2227")
    assert np.allclose(xyz_of(log), np.array([[1_000_001.0, 2.0, 2.0]]) * 1200 / 3937, rtol=1e-15)
    assert (log.epochs.tolist(), log["point_source_id"].tolist()) == ([NOON_GPS_NS], [9])


def test_scales_of_intensity_and_colour(tmp_path: Path) -> None:
    lines = ["element vertex 3", *XYZ, "property float scalar_Intensity"]
    lines += [f"property float {c}" for c in ("red", "green", "blue")]
    path = written(tmp_path, head("ascii", *lines) + b"0 0 0 -10 0 0 0\n0 0 0 0 0.5 0.5 1\n0 0 0 99 1 1 1\n")
    with pytest.raises(ConfigError, match=r"whose scale the file does not say.*intensity_range"):
        read("ply", path, NOON, crs="local")
    log = read("ply", path, NOON | {"intensity_range": [-10.0, 10.0]}, crs="local")
    assert log["intensity"].tolist() == [0, 32_768, 65_535]
    assert log["red"].tolist() == [0, 32_768, 65_535]
    lines[4:] = ["property ushort intensity", "property ushort red"]  # one colour of three is none
    path = written(tmp_path, head("ascii", *lines) + b"0 0 0 65535 4\n" * 3)
    log = read("ply", path, NOON, crs="local")
    assert (log["intensity"].tolist(), log.table.column("red").null_count) == ([65_535] * 3, 3)
    assert log.attributes["left_out"] == ["red"]


@pytest.mark.parametrize("lists", [False, True])
def test_text_that_the_declared_type_cannot_hold(tmp_path: Path, lists: bool) -> None:
    lines = ["element vertex 6", *XYZ, "property uchar intensity", "property short classification"]
    lines += ["property list uchar uchar extra"] if lists else []
    words = [("255", "2"), ("300", "2"), ("-1", "2"), ("0", "70000"), ("nan", "2"), ("7", "3")]
    rows = "".join(f"0 0 {k} {i} {c}{' 0' if lists else ''}\n" for k, (i, c) in enumerate(words))
    log = read("ply", written(tmp_path, head("ascii", *lines) + rows.encode()), NOON, crs="local")
    assert log["intensity"].tolist() == [65_535, 7 * 257]
    assert log["z_m"].tolist() == [0, 5]
    assert [(r.reason, r.record, r.records) for r in log.rejects] == [
        ("intensity is outside uchar", 1, 2),
        ("intensity is outside uchar", 4, 1),
        ("classification is outside short", 3, 1),
    ]


@pytest.mark.slow
@pytest.mark.parametrize("coding", CODINGS)
def test_the_twin_of_a_las_file(tmp_path: Path, recordings: Path, coding: str) -> None:
    las = tmp_path / "strips.las"
    las.write_bytes(gzip.decompress((recordings / "formats" / "strips.las.gz").read_bytes()))
    theirs = read("las", las, clock=ADJUSTED, crs="EPSG:26910")
    columns = {
        **{a: ("f8", theirs[f"{a}_m"]) for a in "xyz"},
        "gps_time": ("f8", (theirs.epochs - 10**18) / 1e9),
        "intensity": ("u2", theirs["intensity"]),
        "scalar_Classification": ("f4", theirs["classification"]),
        "ReturnNumber": ("u1", theirs["return_number"]),
        "NumberOfReturns": ("u1", theirs["number_of_returns"]),
        "PointSourceId": ("i4", theirs["point_source_id"]),
        "UserData": ("u1", theirs["user_data"]),
        **{c: ("u2", theirs[c]) for c in ("red", "green", "blue")},
    }
    data = np.empty(len(theirs), dtype=[(n, k) for n, (k, _) in columns.items()])
    for name, (_, values) in columns.items():
        data[name] = values
    faces = np.empty(2, dtype=[("vertex_indices", "i4", (3,))])
    faces["vertex_indices"] = [[0, 1, 2], [2, 1, 0]]
    elements = [plyfile.PlyElement.describe(data, "vertex"), plyfile.PlyElement.describe(faces, "face")]
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(coding, "=")
    twin = tmp_path / "strips.ply"
    plyfile.PlyData(elements, text=coding == "ascii", byte_order=order).write(str(twin))
    log = read("ply", twin, {"unit": "metre"}, crs="EPSG:26910", clock=ADJUSTED)
    assert (len(log), log.rejects) == (14_408, [])
    # plyfile writes 18 digits, so text loses nothing either.
    assert np.array_equal(xyz_of(log), xyz_of(theirs))
    assert np.abs(log.epochs - theirs.epochs).max() < 130
    same = (
        "intensity",
        "classification",
        "return_number",
        "number_of_returns",
        "point_source_id",
        "user_data",
        "green",
    )
    for name in same:
        assert np.array_equal(log[name], theirs[name]), name


def test_coordinates_equal_plyfiles_own_reading(tmp_path: Path) -> None:
    path = written(tmp_path, small_ply("binary_big_endian", lists=True))
    own = plyfile.PlyData.read(str(path))["vertex"]
    log = read("ply", path, NOON, crs="local")
    assert np.array_equal(xyz_of(log), np.stack([own[a] for a in "xyz"], axis=-1))


# --- statements --------------------------------------------------------------------------------------


def test_what_the_survey_file_has_to_say(tmp_path: Path) -> None:
    plain = head("ascii", "element vertex 1", *XYZ) + b"1 2 3\n"
    path = written(tmp_path, plain)
    with pytest.raises(ConfigError, match="CRS of the log's positions is not stated"):
        read("ply", path, NOON)
    with pytest.raises(CrsError, match="not a projected one"):
        read("ply", path, NOON, crs="EPSG:4979")
    with pytest.raises(ConfigError, match=r"unit of its coordinates.*metre"):
        read("ply", path, {"epoch": NOON["epoch"]}, crs="local")
    with pytest.raises(TimeSystemError, match=r"the file says no time.*epoch"):
        read("ply", path, {"unit": "metre"}, crs="local")
    with pytest.raises(ConfigError, match="names 'when', which the points do not have"):
        read("ply", path, {"unit": "metre", "time_property": "when"}, crs="local")
    path = written(tmp_path, small_ply())
    with pytest.raises(TimeSystemError, match="time system is not stated"):
        read("ply", path, {"unit": "metre"}, crs="local")
    with pytest.raises(TimeSystemError, match="falls outside 1980"):
        read("ply", path, {"unit": "metre"}, crs="local", clock=Clock(TimeSystem.UNIX_UTC))


@pytest.mark.parametrize(
    ("lines", "match"),
    [
        (["element vertex 1", "property double x"], "no points with x, y and z"),
        (["element vertex 1", *XYZ, "property double x"], "two properties are called 'x'"),
        (["element vertex 1", "property quad x"], "property 'quad x'"),
        (["element vertex -1", *XYZ], "element 'vertex -1'"),
        (["element vertex 1", *XYZ, "property list float int a"], "no whole number"),
        (["property double x"], "cannot be understood"),
        (["nonsense"], "no keyword of PLY"),
    ],
)
def test_headers_that_are_none(tmp_path: Path, lines: list[str], match: str) -> None:
    with pytest.raises(FormatError, match=match):
        read("ply", written(tmp_path, head("ascii", *lines)), NOON, crs="local")


# --- damage ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("coding", CODINGS)
@pytest.mark.parametrize("lists", [False, True])
def test_cut_off(tmp_path: Path, coding: str, lists: bool) -> None:
    data = small_ply(coding, lists)
    log = read("ply", written(tmp_path, data[: len(data) - 100]), NOON, crs="local")
    assert 20 < len(log) < 30
    assert log.rejects[-1].reason == "the header claims points that the file does not hold" or coding == "ascii"
    assert len(log) + log.rejected == 30


def test_a_damaged_record_costs_itself(tmp_path: Path) -> None:
    body = b"".join(struct.pack("<ddfB", np.nan if k == 5 else k, 0, 0, 3) for k in range(9))
    top = head("binary_little_endian", "element vertex 9", *XYZ, "property uchar classification")
    log = read("ply", written(tmp_path, top + body), NOON, crs="local")
    assert [(r.record, r.offset, r.reason) for r in log.rejects] == [
        (5, len(top) + 5 * 21, "a coordinate is no number")
    ]
    assert log["classification"].tolist() == [3] * 8
    lines = [b"%d 0 0 3" % k for k in range(9)]
    lines[5] = b"5 0 zero 3"
    top = head("ascii", "element vertex 9", *XYZ, "property uchar classification")
    log = read("ply", written(tmp_path, top + b"\n".join(lines)), NOON, crs="local")
    assert [(r.record, r.offset) for r in log.rejects] == [(5, len(top) + 5 * 8)]
    assert len(log) == 8
    lines[5] = b"5 0 0 300"
    log = read("ply", written(tmp_path, top + b"\n".join(lines)), NOON, crs="local")
    assert [(r.record, r.reason) for r in log.rejects] == [(5, "classification is outside uchar")]


def test_claims_are_held_against_the_file(tmp_path: Path) -> None:
    top = head("binary_little_endian", "element vertex 4000000000000", *XYZ)
    log = read("ply", written(tmp_path, top + struct.pack("<ddf", 1, 2, 3)), NOON, crs="local")
    assert (len(log), log.rejected) == (1, 3_999_999_999_999)
    top = head("binary_little_endian", "element vertex 9", *XYZ, "property list uint double a")
    log = read("ply", written(tmp_path, top + struct.pack("<ddfI", 1, 2, 3, 2**31)), NOON, crs="local")
    assert log.reasons == {"a list is damaged: the points from here on are lost"}
    top = head("binary_little_endian", "element big 99999999999", "property double a", "element vertex 3", *XYZ)
    assert read("ply", written(tmp_path, top), NOON, crs="local").rejected == 3


@pytest.mark.slow
def test_lists_of_changing_length_take_linear_time(tmp_path: Path) -> None:
    count = 60_000
    top = head("binary_little_endian", f"element vertex {count}", "property list uchar uchar a", *XYZ)
    body = b"".join(struct.pack("<B", k % 2) + bytes(k % 2) + struct.pack("<ddf", k, 0, 0) for k in range(count))
    path = written(tmp_path, top + body)
    started = time.monotonic()
    log = read("ply", path, NOON, crs="local")
    assert time.monotonic() - started < 15.0
    assert np.array_equal(log["x_m"], np.arange(count))


@pytest.mark.parametrize("coding", CODINGS)
@pytest.mark.parametrize(("claimed", "read_", "lost"), [(0, 0, 30), (3, 3, 27), (29, 29, 1), (30, 30, 0), (31, 30, 1)])
def test_points_that_the_header_does_not_claim_are_told(
    tmp_path: Path, coding: str, claimed: int, read_: int, lost: int
) -> None:
    top = head(coding, f"element vertex {claimed}", *XYZ)
    order = "<" if "little" in coding else ">"
    rows = [f"{k} 2 3\n".encode() if coding == "ascii" else struct.pack(order + "ddf", k, 2, 3) for k in range(30)]
    log = read("ply", written(tmp_path, top + b"".join(rows)), NOON, crs="local")
    assert (len(log), log.rejected) == (read_, lost)
