"""A lidar's clock that steps inside a capture, through the command line: no reading lies where it was not measured."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer
from typer.testing import CliRunner

from roadscan.cli import app
from roadscan.door import open_survey
from tests.formats.test_velodyne_clock import NO_PPS, Packets, heard, piece
from tests.formats.test_velodyne_pcap import HDL_32E_ELEVATIONS, capture, data_packet, drive, frame, turning


def survey_of(folder: Path, faults: Path, packets: Packets | None = None) -> Path:
    """The survey of the wrong input, with its capture or another: 1 m/s north from 09:00:00 UTC on."""
    shutil.copytree(faults / "lidar_clock_step", folder, copy_function=shutil.copyfile)
    folder.chmod(0o755)
    if packets is not None:
        capture(folder / "l.pcap", packets)
    return folder / "SURVEY.toml"


def northing_m(file: Path) -> np.ndarray:
    """From where the drive began to each point of the tiles' clouds."""
    survey = open_survey(file)
    _, start_m = Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True).transform(9.0, 48.0)
    points = [survey.points(tile)["northing_m"] for tile in survey.table("tiles").tile]
    return np.concatenate(points) - start_m


@pytest.mark.slow
@pytest.mark.witness("lidar_clock_step")
@pytest.mark.parametrize("case", ["restart", "lock_midway"])
def test_readings_of_a_clock_that_stepped_are_left_out_and_named(tmp_path: Path, faults: Path, case: str) -> None:
    midway = piece(600.0, 40.0) + heard(600.1, 40.1, NO_PPS, "V") + heard(600.2, 600.2) + piece(600.2, 600.2)
    file = survey_of(tmp_path / "s", faults, None if case == "restart" else midway)
    done = CliRunner().invoke(app, ["run", str(file), "--workers", "0"])
    assert done.exit_code == 0, done.output
    assert "its 100 data packets were left out" in " ".join(done.output.split())
    assert len(open_survey(file).table("returns")) == 100 * 384
    north_m = northing_m(file)
    assert north_m.size
    assert north_m.min() >= 594.0
    assert north_m.max() <= 607.0


@pytest.mark.witness("lidar_heads_mixed")
def test_two_heads_under_one_address_are_refused(tmp_path: Path) -> None:
    """A second head a quarter of a turn on, its packets half a packet later; the same packets twice are one head."""
    one = drive(60)
    at = [(time + 276_000, 1_000_000 + round(k * 553)) for k, (time, _) in enumerate(one)]
    other = [(t, frame(data_packet(s + 276, turning(9_000 + round(k * 199.2))))) for k, (t, s) in enumerate(at)]
    capture(tmp_path / "two.pcap", sorted(one + other))
    capture(tmp_path / "one.pcap", sorted(one + one))
    said = {
        name: CliRunner().invoke(app, ["inspect", str(tmp_path / name), "--clock", "utc_hour,date=2026-05-04"])
        for name in ("one.pcap", "two.pcap")
    }
    words = {name: " ".join(done.output.split()) for name, done in said.items()}
    assert "two heads sent to port 2368 from one address" in words["two.pcap"]
    assert "two heads" not in words["one.pcap"] and "23,040" in words["one.pcap"]


def over_a_plane(off_m: dict[int, float]) -> Packets:
    """A turn and more of an HDL-32E 2 m above a plane; ranges of some lasers are off, all have a noise of 10 mm."""
    rng, elevations = np.random.default_rng(0), np.radians(HDL_32E_ELEVATIONS)
    packets = []
    for k, (time, _) in enumerate(drive(240, 600e6)):
        level = elevations[np.array([k // 2 if k % 2 == 0 else 16 + k // 2 for k in range(32)])]
        ranges = np.where(level < -0.05, -2.0 / np.sin(np.minimum(level, -0.01)), 0.0)
        ranges = ranges + np.array([off_m.get(laser, 0.0) for laser in range(32)]) + rng.normal(0, 0.01, (12, 32))
        units = np.where(level < -0.05, np.round(ranges / 0.002), 0).astype(int)
        stamp_us = 600_000_000 + round(k * 552.96)
        packets.append((time, frame(data_packet(stamp_us, turning(round(k * 199.2)), units))))
    return packets + heard(600.2, 600.2)


@pytest.mark.witness("laser_range")
@pytest.mark.parametrize("off_m", [{}, {10: 0.2}])
def test_a_laser_that_the_others_contradict_is_left_out(tmp_path: Path, faults: Path, off_m: dict[int, float]) -> None:
    file = survey_of(tmp_path / "s", faults, over_a_plane(off_m))
    done = CliRunner().invoke(app, ["ingest", str(file), "--workers", "0"])
    assert done.exit_code == 0, done.output
    lasers = open_survey(file).table("returns")["laser"].to_numpy()
    assert lasers.size > 40_000 and (10 in lasers) == (not off_m)
    said = " ".join(done.output.split())
    assert set(re.findall(r"the ranges of laser (\d+) are \+20\d mm", said)) == set(map(str, off_m))
    assert said.count("the ranges of laser") == said.count("the ranges of laser 10 ")
