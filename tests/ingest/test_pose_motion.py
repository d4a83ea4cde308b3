"""What poses say of themselves, through the command line: each fault is named with its size, and a sound drive is not.

The drive is integrated from a stated course, slope and speed with SciPy, not with roadscan's code.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.interpolate import CubicHermiteSpline, CubicSpline
from typer.testing import CliRunner

from docs.mistakes import FIRST_GPS_S
from roadscan.cli import app
from roadscan.poses.leaps import PoseTrack
from roadscan.poses.motion import PoseMotion
from tests.georeference.test_tick_clocks import write_drive, write_ticks
from tests.survey.test_mistakes import changed, said

Float64 = npt.NDArray[np.float64]
Fault = Callable[[dict[str, Float64]], object]

SPEED_M_PER_S = 10.0
SURVEY = """\
id = "drive"
map = {{ crs = "EPSG:25832" }}
[[runs]]
id = "one"
[[runs.logs]]
path = "{path}"
{stated}
"""
GRID = """\
crs = "EPSG:25832"
height = "ellipsoidal"
clock = { system = "gps" }
options = { heading = "grid" }
"""


def drive(every_s: float = 0.01, seed: int = 5, lasts_s: float = 40.0) -> dict[str, Float64]:
    """Columns of a drive over hills and through bends, with the noise of a good unit."""
    at = np.arange(0.0, lasts_s, 0.001)
    course = np.radians(45.0 + 20.0 * np.sin(2 * np.pi * at / 20.0))
    slope = 0.05 * np.cos(2 * np.pi * SPEED_M_PER_S * at / 100.0)
    level = SPEED_M_PER_S / np.sqrt(1.0 + slope**2)
    north, east, up = level * np.cos(course), level * np.sin(course), level * slope
    rows = slice(None, None, round(every_s * 1000))
    rng = np.random.default_rng(seed)
    count = at[rows].size
    ways = [CubicSpline(at, each).antiderivative()(at)[rows] for each in (east, north, up)]
    noise = 0.0005 * np.cumsum(rng.normal(0.0, 0.05, (3, count)), axis=1)
    return {
        "time_s": FIRST_GPS_S + at[rows],
        "easting_m": 500_000.0 + ways[0] + noise[0],
        "northing_m": 5_300_000.0 + ways[1] + noise[1],
        "height_m": 102.0 + ways[2] + noise[2],
        "roll_deg": 1.2 * np.sin(2 * np.pi * at[rows] / 7.0) + rng.normal(0.0, 0.003, count),
        "pitch_deg": np.degrees(np.arctan(slope))[rows] + rng.normal(0.0, 0.003, count),
        "heading_deg": np.degrees(course)[rows] + rng.normal(0.0, 0.003, count),
        "velocity_north_m_per_s": north[rows],
        "velocity_east_m_per_s": east[rows],
        "velocity_down_m_per_s": -up[rows],
    }


def told(folder: Path, columns: dict[str, Float64]) -> dict[str, str]:
    """Texts by witness of what `ingest` finds."""
    body = np.column_stack(list(columns.values()))
    np.savetxt(folder / "t.csv", body, fmt="%.9f", delimiter=",", header=",".join(columns), comments="")
    return ingested(folder, "t.csv", GRID)


def ingested(folder: Path, path: str, stated: str) -> dict[str, str]:
    """The same of any log."""
    (folder / "SURVEY.toml").write_text(SURVEY.format(path=path, stated=stated), encoding="utf-8")
    done = CliRunner().invoke(app, ["ingest", str(folder / "SURVEY.toml"), "--json"], catch_exceptions=False)
    found: list[dict[str, Any]] = json.loads(done.stdout)["findings"]
    return {one["witness"]: one["text"] for one in found}


def turned(columns: dict[str, Float64], degrees: float) -> None:
    columns["heading_deg"] = np.mod(columns["heading_deg"] + degrees, 360.0)


def exchanged(columns: dict[str, Float64], one: str, other: str) -> None:
    columns[one], columns[other] = columns[other], columns[one]


def scaled(columns: dict[str, Float64], name: str, times: float) -> None:
    columns[name] = columns[name][0] + (columns[name] - columns[name][0]) * times


def held(columns: dict[str, Float64], rows: slice, *names: str) -> None:
    for name in names:
        columns[name][rows] = columns[name][rows][0]


@pytest.mark.parametrize("seed", [5, 6])
def test_a_sound_drive_is_not_named(tmp_path: Path, seed: int) -> None:
    assert told(tmp_path, drive(seed=seed)) == {}


@pytest.mark.witness("pose_course")
@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (lambda c: turned(c, 180.0), "so that the heading or its north is wrong; all"),
        (lambda c: turned(c, 90.0), "the heading is +90.0° off the course"),
        (lambda c: turned(c, -3.0), "-3.0° off the course"),
        (lambda c: c.update(pitch_deg=-c["pitch_deg"]), "its sign is wrong"),
        (lambda c: exchanged(c, "roll_deg", "pitch_deg"), "the two are exchanged"),
    ],
)
def test_heading_and_pitch_that_are_not_the_way_are_named(tmp_path: Path, fault: Fault, words: str) -> None:
    columns = drive()
    fault(columns)
    found = told(tmp_path, columns)
    assert found.keys() == {"pose_course"} and words in found["pose_course"]


def test_a_unit_that_is_mounted_turned_is_told_from_a_wrong_heading(tmp_path: Path) -> None:
    columns = drive()
    columns["roll_deg"], columns["pitch_deg"] = -columns["pitch_deg"], columns["roll_deg"]
    turned(columns, -90.0)  # its forward axis points to the left: what was right is forward
    assert "the unit is mounted turned" in told(tmp_path, columns)["pose_course"]


@pytest.mark.witness("pose_constant")
@pytest.mark.parametrize(
    ("names", "rows", "words"),
    [
        (["height_m"], slice(None), "the height is one and the same in all 4,000 poses"),
        (["roll_deg", "pitch_deg"], slice(None), "the roll and the pitch are one and the same in all 4,000 poses"),
        (["roll_deg"], slice(1000, 1100), "the roll is one and the same in 100 poses that repeat"),
    ],
)
def test_a_value_that_never_changes_is_named(tmp_path: Path, names: list[str], rows: slice, words: str) -> None:
    columns = drive()
    held(columns, rows, *names)
    assert words in told(tmp_path, columns)["pose_constant"]


@pytest.mark.witness("pose_speed")
def test_stamps_that_run_fast_are_named_by_the_velocities(tmp_path: Path) -> None:
    columns = drive()
    scaled(columns, "time_s", 1.01)
    assert "the positions go 0.99" in told(tmp_path, columns)["pose_speed"]


@pytest.mark.witness("pose_spacing")
@pytest.mark.parametrize("has_velocities", [True, False])
@pytest.mark.parametrize(("every_s", "is_named"), [(2.0, True), (0.05, False)])
def test_poses_that_are_far_apart_are_named_with_their_error(
    tmp_path: Path, has_velocities: bool, every_s: float, is_named: bool
) -> None:
    """The error is that of a cubic with slopes through five poses, which SciPy knows from the poses in between."""
    columns, between = drive(every_s, lasts_s=200.0), drive(every_s / 2.0, lasts_s=200.0)
    if not has_velocities:
        columns = {name: each for name, each in columns.items() if not name.startswith("velocity")}
    text = told(tmp_path, columns).get("pose_spacing")
    assert (text is not None) == is_named
    if text is None:
        return
    at, missed = columns["time_s"], []
    for name in ("easting_m", "northing_m"):
        own, true = columns[name], between[name][5:-6:2]
        slopes = (own[:-4] - 8.0 * own[1:-3] + 8.0 * own[3:-1] - own[4:]) / (12.0 * every_s)
        cubic = CubicHermiteSpline(at[2:-2], own[2:-2], slopes)(between["time_s"][5:-6:2])
        missed.append(cubic - true)
    level_mm = 1e3 * np.sqrt(np.mean(missed[0] ** 2 + missed[1] ** 2))
    stated_mm = float(text.split("about ")[1].split(" mm")[0])
    assert 0.5 < stated_mm / level_mm < 2.0


@pytest.mark.witness("pose_frozen")
def test_poses_that_stand_still_while_the_vehicle_drives_are_left_out(tmp_path: Path) -> None:
    columns = drive()
    held(columns, slice(1500, 1600), *(name for name in columns if name != "time_s"))
    found = told(tmp_path, columns)
    assert "99 poses repeat the one before" in found["pose_frozen"]
    assert found.keys() <= {"pose_frozen", "rejected_share"}


@pytest.mark.witness("pose_sigma")
@pytest.mark.parametrize(
    ("sigma", "words"),
    [
        (np.zeros, "the stated σ of the position is 0 in 4,000 of 4,000 poses"),
        (lambda n: np.where(np.arange(n) < 2000, 0.004, np.nan), "2,000 of 4,000 poses have no stated σ, for 20.0 s"),
    ],
)
def test_sigma_that_is_zero_or_covers_a_part_is_named(
    tmp_path: Path, sigma: Callable[[int], Float64], words: str
) -> None:
    columns = drive()
    own = sigma(columns["time_s"].size)
    names = ("sigma_north_m", "sigma_east_m", "sigma_down_m")
    body = np.column_stack([*columns.values(), *[own] * 3])
    lines = [",".join((*columns, *names))]
    lines += [",".join("" if np.isnan(value) else f"{value:.9f}" for value in row) for row in body]
    (tmp_path / "t.csv").write_text("\n".join(lines) + "\n", encoding="ascii")
    assert words in ingested(tmp_path, "t.csv", GRID)["pose_sigma"]


def test_positions_in_radians_of_32_bits_are_named(tmp_path: Path) -> None:
    columns = drive()
    radians = np.radians(
        [48.0 + columns["northing_m"] / 111_200.0 - 47.66, 9.0 + columns["easting_m"] / 74_000.0 - 6.75]
    )
    degrees = np.degrees(radians.astype(np.float32).astype(np.float64))
    place = {"time_s": columns["time_s"], "latitude_deg": degrees[0], "longitude_deg": degrees[1]}
    body = place | {name: columns[name] for name in ("height_m", "roll_deg", "pitch_deg", "heading_deg")}
    rows = np.column_stack(list(body.values()))
    np.savetxt(tmp_path / "t.csv", rows, fmt="%.14f", delimiter=",", header=",".join(body), comments="")
    found = ingested(tmp_path, "t.csv", 'crs = "EPSG:4979"\nclock = { system = "gps" }\n')
    assert "the latitude is held in steps of 3.4e-06 °" in found["coarse_values"]


@pytest.mark.slow
@pytest.mark.witness("ticks_still")
def test_ticks_that_stand_still_are_named_and_coarse_positions_accuse_no_clock(tmp_path: Path) -> None:
    def make(where: Path) -> None:
        write_drive(where / "poses.csv")
        lines = (where / "poses.csv").read_text().splitlines()
        rows = np.array([line.split(",") for line in lines[1:]], dtype=float)
        rows[:, 1:3] = np.round(rows[:, 1:3] * 4.0) / 4.0
        body = [",".join(f"{value:.6f}" for value in row) for row in rows]
        (where / "poses.csv").write_text("\n".join([lines[0], *body]) + "\n", encoding="ascii")
        write_ticks(where / "scans.parquet")
        write_ticks(where / "right.parquet", metres=1e9)

    head = '[[runs.logs]]\npath = "scans.parquet"\n'
    second = head.replace("scans", "right") + 'sensor = "right"\n\n' + head
    sensor = 'rig.sensors.right = { kind = "profiler", lever_arm_body_m = [0.0, 1.0, 0.0] }\n\n[[runs]]'
    changed(tmp_path, (head, second), ("\n[[runs]]", sensor), make=make)
    code, text = said(tmp_path, "run", "--workers", "0")
    assert code == 0, text
    assert (
        "held in steps of 0.25 m" in text
        and "the clock of this sensor steps" not in text
        and "the clock of all" not in text
    )
    assert "right.parquet: the wheel's ticks stand still while the poses travel" in text


def test_poses_of_recorded_drives_are_not_named(recordings: Path, tmp_path: Path) -> None:
    """Cars in towns and on a highway; there the velocities are recorded as well."""
    free = 'crs = "local"\noptions = {{ axes = "flu" }}\nclock = {}\n'
    av2 = free.format('{ system = "free", unit = "ns", offset_s = 7e8 }').replace("{{", "{").replace("}}", "}")
    kitti = 'format = "pose_matrices"\n' + free.format('"unix_utc"').replace("{{", "{").replace("}}", "}")
    kitti = kitti.replace('"unix_utc"', '{ system = "unix_utc" }')
    for name, stated in (("av2_drive/city_SE3_egovehicle.feather", av2), ("kitti_drive/poses.csv", kitti)):
        (tmp_path / Path(name).stem).mkdir()
        assert ingested(tmp_path / Path(name).stem, str(recordings / name), stated) == {}
    names = ("times", "positions", "orientations", "velocities")
    at, place, turn, velocity = (np.load(recordings / f"odometer/global_pose_frame_{name}.npy") for name in names)
    none = np.zeros(at.size)
    motion = PoseMotion("EPSG:4978")
    motion.take(PoseTrack(np.round((at - at[0]) * 1e9).astype(np.int64), place, turn, none, none, False, velocity))
    assert motion.heading() is None and motion.pitch() is None and motion.scale() is None and motion.same() == []
