"""Kinds of faults: what one draw of each does to the files of a survey.

Sizes are drawn on a logarithmic scale, from what hides in the noise to what nobody overlooks.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

Random = np.random.Generator
Float64 = npt.NDArray[np.float64]

EARTH_M_PER_RAD: Final = 6.371e6
SBET_COLUMNS: Final = 17
SMRMSG_COLUMNS: Final = 10
PCAP_HEADER_BYTES: Final = 24
RECORD_HEADER_BYTES: Final = 16
DATA_PACKET_BYTES: Final = 1248
"""Ethernet frame of a data packet of a Velodyne."""
STAMP_AT: Final = 42 + 1200
"""Where the stamp (u32, µs past the hour) stands in such a frame."""
RUNS: Final = ("run-1", "run-2")
HEADS: Final = ("profiler_left", "profiler_right")


@dataclass(frozen=True)
class FaultKind:
    """One kind of fault."""

    name: str
    draw: Callable[[Random, Path], str]
    """Change the files of the survey in a folder; returns what was done, in words with sizes."""
    witnesses: frozenset[str]
    """Those that name it for what it is; none: any does. `rejected` is a reason of rejects, `failed` a unit that could
    not be made, `error` the message that ended the run."""


def _log_uniform(random: Random, least: float, most: float) -> float:
    """A size between two bounds, each decade as likely as another."""
    return float(np.exp(random.uniform(np.log(least), np.log(most))))


def _sign(random: Random) -> float:
    return 1.0 if random.random() < 0.5 else -1.0


def _run(random: Random) -> str:
    return RUNS[int(random.integers(len(RUNS)))]


def _head(random: Random) -> str:
    return HEADS[int(random.integers(len(HEADS)))]


# --- trajectory -------------------------------------------------------------------------------------


def _poses(folder: Path, run: str) -> tuple[Path, Float64]:
    path = folder / "raw" / run / "trajectory.sbet"
    return path, np.fromfile(path).reshape(-1, SBET_COLUMNS)


def _shift(poses: Float64, rows: slice, axis: int, size_m: float) -> None:
    """Move poses north (0), east (1) or up (2)."""
    latitude = poses[rows, 1].copy()
    if axis == 0:
        poses[rows, 1] += size_m / EARTH_M_PER_RAD
    elif axis == 1:
        poses[rows, 2] += size_m / (EARTH_M_PER_RAD * np.cos(latitude))
    else:
        poses[rows, 3] += size_m


_AXES: Final = ("north", "east", "up")
_ANGLES: Final = ("roll", "pitch", "heading")


def pose_spike(random: Random, folder: Path) -> str:
    """One to twenty poses are elsewhere."""
    path, poses = _poses(folder, run := _run(random))
    first, count = int(random.integers(len(poses) - 20)), int(random.integers(1, 21))
    axis, size_m = int(random.integers(3)), _sign(random) * _log_uniform(random, 0.05, 1e4)
    _shift(poses, slice(first, first + count), axis, size_m)
    poses.tofile(path)
    return f"{count} poses of {run} from {first} on lie {size_m:.3f} m {_AXES[axis]}"


def pose_step(random: Random, folder: Path) -> str:
    """From a pose on, all are elsewhere."""
    path, poses = _poses(folder, run := _run(random))
    first = int(random.uniform(0.1, 0.9) * len(poses))
    axis, size_m = int(random.integers(3)), _sign(random) * _log_uniform(random, 0.02, 100.0)
    _shift(poses, slice(first, None), axis, size_m)
    poses.tofile(path)
    return f"all poses of {run} from {first} on lie {size_m:.3f} m {_AXES[axis]}"


def attitude_spike(random: Random, folder: Path) -> str:
    """One to twenty poses are turned."""
    path, poses = _poses(folder, run := _run(random))
    first, count = int(random.integers(len(poses) - 20)), int(random.integers(1, 21))
    axis, size_deg = int(random.integers(3)), _sign(random) * _log_uniform(random, 0.05, 170.0)
    poses[first : first + count, 7 + axis] += np.radians(size_deg)
    poses.tofile(path)
    return (
        f"{count} poses of {run} from {first} on are turned by {size_deg:.3f}° in {('roll', 'pitch', 'heading')[axis]}"
    )


def attitude_sign(random: Random, folder: Path) -> str:
    """Roll or pitch of a run has the other sign."""
    path, poses = _poses(folder, run := _run(random))
    axis = int(random.integers(2))
    poses[:, 7 + axis] *= -1.0
    poses.tofile(path)
    return f"{_ANGLES[axis]} of {run} has the other sign"


def attitude_late(random: Random, folder: Path) -> str:
    """Roll and pitch of a run are those of another time."""
    path, poses = _poses(folder, run := _run(random))
    size_s = _sign(random) * _log_uniform(random, 0.01, 0.5)
    for axis in (0, 1):
        poses[:, 7 + axis] = np.interp(poses[:, 0] - size_s, poses[:, 0], poses[:, 7 + axis])
    poses.tofile(path)
    return f"roll and pitch of {run} are {size_s:+.4f} s late"


def null_pose(random: Random, folder: Path) -> str:
    """A pose at latitude 0, longitude 0, height 0."""
    path, poses = _poses(folder, run := _run(random))
    first = int(random.integers(len(poses)))
    poses[first, 1:4] = 0.0
    poses.tofile(path)
    return f"pose {first} of {run} lies at 0, 0, 0"


def trajectory_late(random: Random, folder: Path) -> str:
    """All stamps of the poses are off."""
    path, poses = _poses(folder, run := _run(random))
    size_s = _sign(random) * _log_uniform(random, 0.005, 20.0)
    poses[:, 0] += size_s
    poses.tofile(path)
    return f"stamps of the poses of {run} are {size_s:+.4f} s off"


def trajectory_clock_step(random: Random, folder: Path) -> str:
    """From a pose on, stamps are off."""
    path, poses = _poses(folder, run := _run(random))
    first, size_s = int(random.uniform(0.1, 0.9) * len(poses)), _sign(random) * _log_uniform(random, 0.02, 20.0)
    poses[first:, 0] += size_s
    poses.tofile(path)
    return f"stamps of the poses of {run} from {first} on are {size_s:+.4f} s off"


def pose_gap(random: Random, folder: Path) -> str:
    """Poses are missing."""
    path, poses = _poses(folder, run := _run(random))
    count = int(_log_uniform(random, 5, 800))
    first = int(random.integers(10, len(poses) - count - 10))
    np.delete(poses, slice(first, first + count), axis=0).tofile(path)
    return f"{count} poses of {run} from {first} on are missing"


def poses_twice(random: Random, folder: Path) -> str:
    """A piece of the trajectory stands in it twice."""
    path, poses = _poses(folder, run := _run(random))
    first, count = int(random.integers(len(poses) - 400)), int(random.integers(20, 400))
    np.concatenate([poses, poses[first : first + count]]).tofile(path)
    return f"{count} poses of {run} from {first} on stand twice"


def stated_sigma(random: Random, folder: Path) -> str:
    """The σ that the log states are too small or too large."""
    path = folder / "raw" / (run := _run(random)) / "trajectory.smrmsg"
    accuracy, factor = np.fromfile(path).reshape(-1, SMRMSG_COLUMNS), _log_uniform(random, 0.05, 20.0)
    accuracy[:, 1:] *= factor
    accuracy.tofile(path)
    return f"stated σ of {run} times {factor:.3f}"


# --- profiler ---------------------------------------------------------------------------------------


def _scans(folder: Path, run: str, head: str) -> tuple[Path, pa.Table]:
    path = folder / "raw" / run / f"{head}.parquet"
    return path, pq.read_table(path)


def _with(table: pa.Table, name: str, values: npt.NDArray[np.generic]) -> pa.Table:
    kind = table.schema.field(name)
    flat = pa.array(values.ravel())
    column = pa.FixedSizeListArray.from_arrays(flat, values.shape[1]) if values.ndim == 2 else flat
    return table.set_column(table.schema.get_field_index(name), kind, column.cast(kind.type))


def _ranges(table: pa.Table) -> npt.NDArray[np.uint16]:
    column = table.column("range").combine_chunks()
    return column.flatten().to_numpy(zero_copy_only=False).reshape(len(table), -1).copy()


def profiler_late(random: Random, folder: Path) -> str:
    """The clock of a head is off, as a whole or from a profile on."""
    path, table = _scans(folder, run := _run(random), head := _head(random))
    epochs = table.column("epoch_gps_ns").to_numpy().copy()
    first = int(random.uniform(0.1, 0.9) * len(epochs)) if random.random() < 0.5 else 0
    size_s = _sign(random) * _log_uniform(random, 0.002, 20.0)
    epochs[first:] += round(size_s * 1e9)
    pq.write_table(_with(table, "epoch_gps_ns", epochs), path)
    return f"{head} of {run} is {size_s:+.4f} s off from profile {first} on"


def profiler_clock_stands(random: Random, folder: Path) -> str:
    """Stamps of a piece of a head's profiles are all the same."""
    path, table = _scans(folder, run := _run(random), head := _head(random))
    epochs = table.column("epoch_gps_ns").to_numpy().copy()
    first, count = int(random.uniform(0.0, 0.7) * len(epochs)), int(random.uniform(0.02, 0.25) * len(epochs))
    epochs[first : first + count] = epochs[first]
    pq.write_table(_with(table, "epoch_gps_ns", epochs), path)
    return f"{count} profiles of {head} of {run} from {first} on carry one stamp"


def profiler_scale(random: Random, folder: Path) -> str:
    """All ranges of a head are too long or too short."""
    path, table = _scans(folder, run := _run(random), head := _head(random))
    raw, factor = _ranges(table), 1.0 + _sign(random) * _log_uniform(random, 0.0005, 0.2)
    good = raw > 0
    raw[good] = np.clip(raw[good] * factor, 1, 65_535).astype(np.uint16)
    pq.write_table(_with(table, "range", raw), path)
    return f"raw ranges of {head} of {run} times {factor:.5f}"


def profiler_wrong_readings(random: Random, folder: Path) -> str:
    """A share of a head's readings is anywhere."""
    path, table = _scans(folder, run := _run(random), head := _head(random))
    raw, share = _ranges(table), _log_uniform(random, 0.001, 0.3)
    wrong = random.random(raw.shape) < share
    raw[wrong] = random.integers(1, 65_535, int(wrong.sum()), dtype=np.uint16)
    pq.write_table(_with(table, "range", raw), path)
    return f"{share:.2%} of the readings of {head} of {run} are anywhere"


def profiles_mirrored(random: Random, folder: Path) -> str:
    """The readings of each profile of a head run from right to left."""
    path, table = _scans(folder, run := _run(random), head := _head(random))
    ranges = _ranges(table)
    pq.write_table(_with(table, "range", ranges[:, ::-1]), path)
    return f"profiles of {head} of {run} are mirrored"


def profiler_stuck(random: Random, folder: Path) -> str:
    """A head repeats one profile over a piece of the drive."""
    path, table = _scans(folder, run := _run(random), head := _head(random))
    raw = _ranges(table)
    first, count = int(random.uniform(0.0, 0.8) * len(raw)), int(_log_uniform(random, 10, 0.2 * len(raw)))
    raw[first : first + count] = raw[first]
    pq.write_table(_with(table, "range", raw), path)
    return f"{head} of {run} repeats profile {first} {count} times"


def profiler_twice(random: Random, folder: Path) -> str:
    """A piece of a head's log stands in it twice."""
    path, table = _scans(folder, run := _run(random), head := _head(random))
    first, count = int(random.uniform(0.0, 0.7) * len(table)), int(random.uniform(0.05, 0.25) * len(table))
    pq.write_table(pa.concat_tables([table, table.slice(first, count)]), path)
    return f"{count} profiles of {head} of {run} from {first} on stand twice"


def heads_exchanged(random: Random, folder: Path) -> str:
    """The logs of the two heads are exchanged."""
    run = _run(random)
    left, right = (folder / "raw" / run / f"{head}.parquet" for head in HEADS)
    content = left.read_bytes()
    left.write_bytes(right.read_bytes())
    right.write_bytes(content)
    return f"logs of the two heads of {run} are exchanged"


# --- lidar ------------------------------------------------------------------------------------------


def _frames(content: bytes) -> list[tuple[int, int]]:
    """Begin and length of each record of a capture, with its header."""
    found, at = [], PCAP_HEADER_BYTES
    while at + RECORD_HEADER_BYTES <= len(content):
        size = RECORD_HEADER_BYTES + int.from_bytes(content[at + 8 : at + 12], "little")
        found.append((at, size))
        at += size
    return found


def _capture(folder: Path, run: str) -> tuple[Path, bytearray, list[tuple[int, int]]]:
    path = folder / "raw" / run / "lidar.pcap"
    content = bytearray(path.read_bytes())
    return path, content, _frames(bytes(content))


def lidar_clock_step(random: Random, folder: Path) -> str:
    """The stamps of a capture step, as a whole or from a packet on."""
    path, content, frames = _capture(folder, run := _run(random))
    first = int(random.uniform(0.1, 0.9) * len(frames)) if random.random() < 0.7 else 0
    size_s = _sign(random) * _log_uniform(random, 0.005, 100.0)
    for at, size in frames[first:]:
        if size == RECORD_HEADER_BYTES + DATA_PACKET_BYTES:
            place = at + RECORD_HEADER_BYTES + STAMP_AT
            stamp = int.from_bytes(content[place : place + 4], "little") + round(size_s * 1e6)
            content[place : place + 4] = (stamp % 3_600_000_000).to_bytes(4, "little")
    path.write_bytes(bytes(content))
    return f"stamps of the lidar of {run} are {size_s:+.4f} s off from packet {first} on"


def lidar_packets_twice(random: Random, folder: Path) -> str:
    """A piece of a capture stands in it twice, one packet after the other."""
    path, content, frames = _capture(folder, run := _run(random))
    first, count = int(random.uniform(0.0, 0.7) * len(frames)), int(random.uniform(0.05, 0.25) * len(frames))
    parts = [bytes(content[:PCAP_HEADER_BYTES])]
    for k, (at, size) in enumerate(frames):
        parts += [bytes(content[at : at + size])] * (2 if first <= k < first + count else 1)
    path.write_bytes(b"".join(parts))
    return f"{count} packets of the lidar of {run} from {first} on stand twice"


def lidar_cut_off(random: Random, folder: Path) -> str:
    """A capture ends in the middle of a packet."""
    path, content, _ = _capture(folder, run := _run(random))
    length = int(random.uniform(0.3, 0.95) * len(content))
    path.write_bytes(bytes(content[:length]))
    return f"the capture of {run} ends after {length:,} of {len(content):,} bytes"


# --- control ----------------------------------------------------------------------------------------


def _control(folder: Path) -> tuple[Path, pd.DataFrame]:
    path = folder / "control.csv"
    return path, pd.read_csv(path)


def _write_control(path: Path, table: pd.DataFrame) -> None:
    table.to_csv(path, index=False, float_format="%.4f")


def control_point(random: Random, folder: Path) -> str:
    """One control point is surveyed wrong."""
    path, table = _control(folder)
    row = int(random.integers(len(table)))
    column = ("easting_m", "northing_m", "height_m")[int(random.integers(3))]
    size_m = _sign(random) * _log_uniform(random, 0.02, 50.0)
    table.loc[row, column] += size_m
    _write_control(path, table)
    return f"{column} of {table.name[row]} is {size_m:+.3f} m off"


def control_datum(random: Random, folder: Path) -> str:
    """All control is wrong by the same."""
    path, table = _control(folder)
    column = ("easting_m", "northing_m", "height_m")[int(random.integers(3))]
    size_m = _sign(random) * _log_uniform(random, 0.02, 50.0)
    table[column] += size_m
    _write_control(path, table)
    return f"{column} of all control is {size_m:+.3f} m off"


def control_exchanged(random: Random, folder: Path) -> str:
    """The names and heights of two points are exchanged."""
    path, table = _control(folder)
    one, other = (int(k) for k in random.choice(len(table), 2, replace=False))
    table.loc[[one, other], "height_m"] = table.loc[[other, one], "height_m"].to_numpy()
    _write_control(path, table)
    return f"heights of {table.name[one]} and {table.name[other]} are exchanged"


# --- survey and rig ---------------------------------------------------------------------------------


def _edit(path: Path, pattern: str, replacement: Callable[[re.Match[str]], str], number: int = 0) -> None:
    text = path.read_text(encoding="utf-8")
    found = list(re.finditer(pattern, text))[number]
    path.write_bytes((text[: found.start()] + replacement(found) + text[found.end() :]).encode())


_SENSORS: Final = ("profiler_left", "profiler_right", "lidar")


def lever_arm(random: Random, folder: Path) -> str:
    """A component of a lever arm is wrong."""
    number, axis = int(random.integers(3)), int(random.integers(3))
    size_m = _sign(random) * _log_uniform(random, 0.005, 3.0)

    def moved(found: re.Match[str]) -> str:
        arm = [float(v) for v in found[1].split(",")]
        arm[axis] += size_m
        return f"lever_arm_body_m = [{', '.join(f'{v:.4f}' for v in arm)}]"

    _edit(folder / "RIG.toml", r"lever_arm_body_m = \[(.*?)\]", moved, number)
    return f"lever arm of {_SENSORS[number]} is {size_m:+.3f} m off in {'xyz'[axis]}"


def boresight(random: Random, folder: Path) -> str:
    """An angle of a boresight is wrong."""
    number, angle = int(random.integers(3)), _ANGLES[int(random.integers(3))]
    size_deg = _sign(random) * _log_uniform(random, 0.01, 20.0)

    def turned(found: re.Match[str]) -> str:
        return f"{angle}_deg = {float(found[1]) + size_deg:.4f}"

    _edit(folder / "RIG.toml", rf"{angle}_deg = (-?[0-9.]+)", turned, number)
    return f"boresight of {_SENSORS[number]} is {size_deg:+.3f}° off in {angle}"


def axes_flipped(random: Random, folder: Path) -> str:
    """The axes of a sensor are stated wrong."""
    number = int(random.integers(3))
    axes = str(random.choice(["flu", "frd", "blu", "rfu", "luf"]))
    _edit(folder / "RIG.toml", r'axes = "(\w+)"', lambda _: f'axes = "{axes}"', number)
    return f'axes of {_SENSORS[number]} are stated as "{axes}"'


def wrong_date(random: Random, folder: Path) -> str:
    """The date of a lidar's log, or the GPS week of a trajectory, is stated wrong."""
    if random.random() < 0.5:
        _edit(folder / "SURVEY.toml", r"date = 2026-05-04", lambda _: "date = 2026-05-05", int(random.integers(2)))
        return "date of a lidar is stated a day late"
    _edit(folder / "SURVEY.toml", r"week = 2417", lambda _: "week = 2416", int(random.integers(2)))
    return "GPS week of a trajectory is stated a week early"


def wrong_system(random: Random, folder: Path) -> str:
    """The time system of a trajectory, or the CRS of the control, is stated wrong."""
    number = int(random.integers(3))
    if number == 2:
        crs = str(random.choice(["EPSG:25833", "EPSG:31468", "EPSG:3857"]))
        _edit(folder / "SURVEY.toml", r'path = "control.csv"\ncrs = "EPSG:32632"',
              lambda _: f'path = "control.csv"\ncrs = "{crs}"')  # fmt: skip
        return f"CRS of the control is stated as {crs}"
    _edit(
        folder / "SURVEY.toml", r'\{ system = "gps_week_seconds", week = 2417 \}',
        lambda _: '{ system = "unix_utc" }', number,
    )  # fmt: skip
    return f"time system of the poses of {RUNS[number]} is stated as unix_utc"


def bytes_flipped(random: Random, folder: Path) -> str:
    """Some bytes of a log are others."""
    logs = sorted((folder / "raw").rglob("*.*"))
    path = logs[int(random.integers(len(logs)))]
    content, count = bytearray(path.read_bytes()), int(_log_uniform(random, 1, 200))
    for at in random.integers(len(content), size=count):
        content[at] ^= int(random.integers(1, 256))
    path.write_bytes(bytes(content))
    return f"{count} bytes of {path.relative_to(folder)} are others"


def same_log_twice(random: Random, folder: Path) -> str:
    """The second run names the log of the first."""
    head = _head(random)
    _edit(folder / "SURVEY.toml", rf"raw/run-2/{head}.parquet", lambda _: f"raw/run-1/{head}.parquet")
    return f"run-2 names the log {head} of run-1"


_ANYTHING: Final = ""
_RIGHT: Final = {
    pose_spike: "pose_leap pose_step",
    pose_step: "pose_step pose_leap tick_clock",
    attitude_spike: "pose_leap pose_step",
    attitude_sign: "attitude_seen",
    attitude_late: "attitude_seen",
    null_pose: "pose_leap gnss_no_fix",
    trajectory_late: "tick_clock along_travel attitude_seen no_pose failed error",
    trajectory_clock_step: "pose_stamps tick_clock pose_step pose_leap along_travel time_goes_back no_pose",
    pose_gap: "no_pose",
    poses_twice: "time_goes_back rows_twice",
    stated_sigma: "stated_sigma",
    profiler_late: "tick_clock along_travel attitude_seen no_pose",
    profiler_clock_stands: "one_stamp",
    profiler_scale: "mounting heads_of_a_run readings_agree sees_road",
    profiler_wrong_readings: "readings_agree",
    profiles_mirrored: "attitude_seen readings_agree heads_of_a_run sees_road",
    profiler_stuck: "repeated_profiles",
    profiler_twice: "time_goes_back rows_twice",
    heads_exchanged: "heads_of_a_run mounting readings_agree sees_road",
    lidar_clock_step: "lidar_clock_step lidar_gprmc along_travel no_pose error failed",
    lidar_packets_twice: "lidar_packets_twice rejected",
    lidar_cut_off: "rejected",
    control_point: "control_point control_target control_place",
    control_datum: "control_datum control_place control_target",
    control_exchanged: "control_point",
    lever_arm: "mounting heads_of_a_run readings_agree sees_road along_travel",
    boresight: "mounting heads_of_a_run readings_agree sees_road along_travel",
    axes_flipped: "attitude_seen sees_road readings_agree failed error",
    wrong_date: "no_pose lidar_gprmc failed error",
    wrong_system: "no_pose control_place failed error",
    bytes_flipped: _ANYTHING,
    same_log_twice: "same_content",
}

KINDS: Final = tuple(FaultKind(draw.__name__, draw, frozenset(right.split())) for draw, right in _RIGHT.items())
