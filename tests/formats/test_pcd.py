"""PCD against files that pypcd4 writes, in all three codings; times, units and what is not stated."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pypcd4 import Encoding, PointCloud

from roadscan.core.errors import ConfigError, FormatError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.ingest.reading.format import format_of
from tests.formats.readings import Readings, read

CODINGS = (Encoding.ASCII, Encoding.BINARY, Encoding.BINARY_COMPRESSED)
UNIX = Clock(TimeSystem.UNIX_UTC)
FREE = Clock(TimeSystem.FREE)
STAMP_NS = 1_673_400_149_711_850_138
GPS_NS = STAMP_NS - 315_964_800 * 10**9 + 18 * 10**9
CLOUD = {"unit": "metre", "epoch": "2026-05-04T09:30:00Z"}
LOCAL = {"crs": "local"}
COUNT = 500


def sweep(
    path: Path,
    coding: Encoding = Encoding.BINARY,
    time: np.ndarray | None = None,
    count: int = COUNT,
    **more: np.ndarray,
) -> dict[str, np.ndarray]:
    """Write a sweep with pypcd4; return its fields."""
    random = np.random.default_rng(3)
    fields: dict[str, np.ndarray] = {a: random.normal(0, 20, count).astype("f4") for a in "xyz"}
    fields["intensity"] = random.integers(0, 256, count, dtype="u1")
    fields |= {"time": np.linspace(0, 0.1, count, dtype="f8") if time is None else time}
    fields |= {"ring": random.integers(0, 64, count, dtype="u2")} | more
    fields["x"][7], fields["x"][8:10], fields["y"][8:10], fields["z"][8:10] = np.nan, 0, 0, 0
    types = tuple(values.dtype.type for values in fields.values())
    cloud = PointCloud.from_points([*fields.values()], tuple(fields), types)
    cloud.save(path, encoding=coding)
    return fields


def sample(coding: Encoding, folder: Path) -> Path:
    """A small sweep."""
    sweep(folder / "a.pcd", coding, count=40)
    return folder / "a.pcd"


def scan(coding: Encoding, folder: Path) -> Path:
    """A small cloud without times."""
    points = np.random.default_rng(3).normal(0, 20, (40, 3)).astype("f4")
    bright = np.arange(40, dtype="u1")
    fields, types = ("x", "y", "z", "intensity"), (np.float32, np.float32, np.float32, np.uint8)
    PointCloud.from_points([*points.T, bright], fields, types).save(folder / "a.pcd", encoding=coding)
    return folder / "a.pcd"


def read_pcd(path: Path, clock: Clock = FREE, **options: Any) -> Readings:
    return read("pcd", path, options, clock=clock)


@pytest.mark.parametrize("coding", CODINGS)
def test_each_coding_gives_what_pypcd4_wrote(coding: Encoding, tmp_path: Path) -> None:
    fields = sweep(tmp_path / "a.pcd", coding)
    assert format_of(tmp_path / "a.pcd").name == "pcd"
    found = read_pcd(tmp_path / "a.pcd")
    good = np.r_[0:7, 10:COUNT]
    digits = 1.0 if coding is Encoding.ASCII else 0.0  # pypcd4 writes ten digits as text
    np.testing.assert_allclose(found.epochs, fields["time"][good] * 1e9, atol=0.5 + digits)
    for axis in "xyz":
        np.testing.assert_allclose(found[f"{axis}_sensor_m"], fields[axis][good], rtol=1e-7 * digits)
    assert np.array_equal(found["intensity"], fields["intensity"][good].astype(int) * 257)
    assert np.array_equal(found["laser"], fields["ring"][good])
    assert found.rejects == []


def test_stamps_of_whole_nanoseconds_are_exact(tmp_path: Path) -> None:
    stamps = STAMP_NS + np.arange(COUNT, dtype="u8") * 200_001
    for coding in CODINGS:
        sweep(tmp_path / "a.pcd", coding, stamps)
        found = read_pcd(tmp_path / "a.pcd", Clock(TimeSystem.UNIX_UTC, unit="ns"))
        assert found.epochs[0] == GPS_NS
        assert np.diff(found.epochs[:5]).tolist() == [200_001] * 4


def test_sweeps_named_by_their_stamps(tmp_path: Path) -> None:
    for k in range(3):
        sweep(tmp_path / f"{STAMP_NS + k * 100_000_000}.pcd", time=np.linspace(0, 99.0, COUNT, dtype="f4"))
    assert format_of(tmp_path).name == "pcd"
    with pytest.raises(TimeSystemError, match="single precision"):
        read_pcd(tmp_path, UNIX)
    with pytest.raises(TimeSystemError, match="start anew in each file"):
        read_pcd(tmp_path, FREE)
    by_name = {"time_from": "file_name"}
    with pytest.raises(TimeSystemError, match=r"options\.time_unit.*options\.name_unit"):
        read_pcd(tmp_path, UNIX, **by_name)
    found = read_pcd(tmp_path, UNIX, **by_name, time_unit="ms", name_unit="ns")
    assert np.bincount(found["sweep"]).tolist() == [COUNT - 3] * 3
    starts = [int(found.epochs[found["sweep"] == k][0]) for k in range(3)]
    assert starts == [GPS_NS + k * 100_000_000 for k in range(3)]
    assert found.epochs[-1] == GPS_NS + 200_000_000 + 99_000_000
    assert {rows.file for rows in found.rows} == {f"{STAMP_NS + k * 100_000_000}.pcd" for k in range(3)}


def test_a_damaged_file_of_a_folder_costs_itself(tmp_path: Path) -> None:
    for k in range(3):
        sweep(tmp_path / f"{k}.pcd", time=k + np.linspace(0, 0.1, COUNT))
    (tmp_path / "1.pcd").write_bytes(b"# .PCD v0.7\nFIELDS x y\nDATA binary\n")
    found = read_pcd(tmp_path)
    assert np.unique(found["sweep"]).tolist() == [0, 2]
    assert [(r.file, r.reason[:25]) for r in found.rejects] == [("1.pcd", "the PCD header is damaged")]


@pytest.mark.parametrize("coding", CODINGS)
def test_a_file_that_is_cut_off_keeps_its_whole_points(coding: Encoding, tmp_path: Path) -> None:
    sweep(tmp_path / "a.pcd", coding)
    whole = (tmp_path / "a.pcd").read_bytes()
    (tmp_path / "a.pcd").write_bytes(whole[: len(whole) * 2 // 3])
    found = read_pcd(tmp_path / "a.pcd")
    assert any("the header claims points that the file does not hold" in r.reason for r in found.rejects)
    assert (len(found) == 0) == (coding is Encoding.BINARY_COMPRESSED)
    assert len(found) + found.rejected >= COUNT - 3


def test_intensities_whose_scale_is_not_known_are_asked_for(tmp_path: Path) -> None:
    sweep(tmp_path / "a.pcd", intensity=np.linspace(0, 2.0, COUNT, dtype="f4"))
    with pytest.raises(ConfigError, match=r"options\.intensity_range"):
        read_pcd(tmp_path / "a.pcd")
    found = read_pcd(tmp_path / "a.pcd", intensity_range=[0.0, 2.0])
    assert (found["intensity"][0], found["intensity"][-1]) == (0, 65_535)
    assert read_pcd(tmp_path / "a.pcd", intensity=False)["intensity"].max() == 0


def test_points_without_a_time_are_a_cloud(tmp_path: Path) -> None:
    random = np.random.default_rng(5)
    xyz = random.normal(0, 20, (COUNT, 3)).astype("f4")
    rgb = PointCloud.encode_rgb(np.tile(np.array([[255, 128, 1]], "u1"), (COUNT, 1)))
    cloud = PointCloud.from_points([*xyz.T, rgb.ravel()], ("x", "y", "z", "rgb"), (np.float32,) * 4)
    for coding in CODINGS[1:]:
        cloud.save(tmp_path / "a.pcd", encoding=coding)
        assert format_of(tmp_path / "a.pcd").name == "pcd_cloud"
        found = read("pcd_cloud", tmp_path / "a.pcd", CLOUD | {"shift": [100.0, 0.0, 0.0]}, **LOCAL)
        assert np.array_equal(found["x_m"], xyz[:, 0].astype(float) + 100.0)
        assert [int(found[c][0]) for c in ("red", "green", "blue")] == [65_535, 128 * 257, 257]
    for left_out in CLOUD:
        with pytest.raises(ConfigError if left_out == "unit" else TimeSystemError, match=f"options.{left_out}"):
            read("pcd_cloud", tmp_path / "a.pcd", {k: v for k, v in CLOUD.items() if k != left_out}, **LOCAL)
    with pytest.raises(FormatError, match="the points have no time"):
        read_pcd(tmp_path / "a.pcd")


def test_a_viewpoint_is_not_guessed(tmp_path: Path) -> None:
    head = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1\nHEIGHT 1\n"
    body = "VIEWPOINT 1 2 3 1 0 0 0\nPOINTS 1\nDATA ascii\n1 2 3\n"
    (tmp_path / "a.pcd").write_text(head + body)
    with pytest.raises(ConfigError, match="VIEWPOINT"):
        read("pcd_cloud", tmp_path / "a.pcd", CLOUD, **LOCAL)
    assert read("pcd_cloud", tmp_path / "a.pcd", CLOUD | {"viewpoint": "ignore"}, **LOCAL)["x_m"].tolist() == [1.0]


def test_recorded_clouds_hold_the_stated_points(recordings: Path) -> None:
    """Counts of `lidars` in the recordings' README."""
    counts = {"hesai_40p": 56_762, "hesai_xt32": 63_021, "velodyne_vlp32": 26_216}
    for name, count in counts.items():
        (path,) = (recordings / "lidars" / name).glob("*.pcd")
        assert len(read("pcd_cloud", path, CLOUD, **LOCAL)) == count


def test_padding_and_fields_of_several_values_are_passed_over(tmp_path: Path) -> None:
    """A point as PCL writes PointXYZI with SSE padding: x y z _ intensity _, and a histogram of three."""
    head = (
        "# .PCD v.7\nVERSION .7\nFIELDS x y z _ time _ histogram\nSIZE 4 4 4 1 8 1 4\nTYPE F F F U F U F\n"
        "COUNT 1 1 1 4 1 8 3\nWIDTH 2\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA binary\n"
    )
    rows = [struct.pack("<fff4xd8x3f", 1 + k, 2, 3, 10 + k, 7, 8, 9) for k in range(2)]
    (tmp_path / "a.pcd").write_bytes(head.encode() + b"".join(rows))
    found = read_pcd(tmp_path / "a.pcd")
    assert found.epochs.tolist() == [10 * 10**9, 11 * 10**9]
    assert found["x_sensor_m"].tolist() == [1.0, 2.0]
