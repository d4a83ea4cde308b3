"""Pose matrices: the KITTI drive, hand-made poses, damage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from roadscan.core.errors import ConfigError, CrsError, FormatError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.ingest.reading.format import format_of
from tests.formats.log_reading import read_log

NAMES = "frame,unix_utc_s,r11,r12,r13,t1,r21,r22,r23,t2,r31,r32,r33,t3"
CLOCK = Clock(TimeSystem.UNIX_UTC)
FLU_FROM_BODY = Rotation.from_euler("x", 180, degrees=True)


def line(i: int, rotation: Rotation | np.ndarray, translation: tuple[float, ...] = (1.0, 2.0, 3.0)) -> str:
    matrix = rotation.as_matrix() if isinstance(rotation, Rotation) else rotation
    numbers = np.column_stack([matrix, translation]).ravel().tolist()
    return ",".join(map(str, [i, 1.5e9 + i, *numbers]))


def test_the_kitti_drive(recordings: Path) -> None:
    path = recordings / "kitti_drive" / "poses.csv"
    assert format_of(path).name == "pose_matrices"
    log = read_log("pose_matrices", path, {"axes": "flu"}, clock=CLOCK, crs="local")
    assert log.rejects == []
    given = np.genfromtxt(path, delimiter=",", skip_header=1)
    np.testing.assert_array_equal(log.positions, given[:, [5, 9, 13]])
    flu = Rotation.from_matrix(given[:, [2, 3, 4, 6, 7, 8, 10, 11, 12]].reshape(-1, 3, 3))
    assert ((log.attitudes * FLU_FROM_BODY.inv()).inv() * flu).magnitude().max() < 1e-7
    # The car drives 69.4 m forward: along the body's x axis.
    step = np.diff(log.positions, axis=0)
    assert np.linalg.norm(step, axis=1).sum() == pytest.approx(69.4, abs=0.1)
    forward = log.attitudes[:-1].inv().apply(step).sum(axis=0)
    assert np.degrees(np.arccos(forward[0] / np.linalg.norm(forward))) < 2
    # 26 September 2011: GPS was 15 s ahead of UTC; stamps are stated to 10 ms.
    assert log.epochs[0] == pytest.approx((1317042272.349 - 315964800 + 15) * 1e9, abs=500)


@pytest.mark.parametrize("axes", ["frd", "flu", "rfu", "bru"])
def test_axes(tmp_path: Path, axes: str) -> None:
    """Forward, right and down of the vehicle point the same way, whatever the maker calls x, y, z."""
    vehicle = {"f": [1, 0, 0], "b": [-1, 0, 0], "r": [0, 1, 0], "l": [0, -1, 0], "d": [0, 0, 1], "u": [0, 0, -1]}
    world_from_body = Rotation.from_rotvec([0.3, -0.4, 2.0])
    body_from_sensor = np.array([vehicle[letter] for letter in axes], dtype=float).T
    path = tmp_path / "a.csv"
    path.write_text(NAMES + "\n" + line(0, world_from_body.as_matrix() @ body_from_sensor))
    log = read_log("pose_matrices", path, {"axes": axes}, clock=CLOCK, crs="local")
    assert (log.attitudes[0] * world_from_body.inv()).magnitude() < 1e-12
    assert log.positions.tolist() == [[1.0, 2.0, 3.0]]


def test_damage(tmp_path: Path) -> None:
    turn = Rotation.from_rotvec([0.1, 0.2, 0.3])
    lines = [line(i, turn) for i in range(8)]
    lines[1] = line(1, turn.as_matrix() * 1.01)
    lines[2] = line(2, turn.as_matrix() @ np.diag([1.0, 1.0, -1.0]))
    lines[3] = line(3, turn, (np.inf, 0.0, 0.0))
    lines[4] = lines[4].rsplit(",", 3)[0]
    lines[5] = line(5, np.zeros((3, 3)))
    lines[6] = line(6, turn.as_matrix() * 1e300)
    path = tmp_path / "a.csv"
    path.write_text("\n".join([NAMES, *lines]))
    log = read_log("pose_matrices", path, {"axes": "frd"}, clock=CLOCK, crs="local")
    assert log.table.num_rows == 2
    reasons = {}
    for reject in log.rejects:
        reasons |= {reject.record + i: reject.reason for i in range(reject.records)}
        assert path.read_text()[reject.offset :].startswith(lines[reject.record])
    assert {k: v.split(" (")[0] for k, v in reasons.items()} == {
        1: "matrix is no rotation",
        2: "matrix mirrors",
        3: "x is missing or not a number",
        4: "11 fields, expected 14",
        5: "matrix is no rotation",
        6: "matrix is no rotation",
    }


@pytest.mark.parametrize(
    ("names", "options", "stated", "error", "says"),
    [
        (NAMES, {}, {"clock": CLOCK, "crs": "local"}, ConfigError, "axes of the poses are not stated"),
        (NAMES, {"axes": "flu"}, {"crs": "local"}, TimeSystemError, "time system is not stated"),
        (NAMES, {"axes": "flu"}, {"clock": CLOCK}, ConfigError, "CRS of the log's positions"),
        (NAMES, {"axes": "flu"}, {"clock": CLOCK, "crs": "EPSG:25832"}, CrsError, "Cartesian"),
        (NAMES, {"axes": "flu", "stamp": "utc"}, {"clock": CLOCK, "crs": "local"}, ConfigError, "column 'utc'"),
        (NAMES.replace("unix_utc_s", "t"), {"axes": "flu"}, {"clock": CLOCK, "crs": "local"}, FormatError, "no column"),
        (NAMES.replace("r33", "r3"), {"axes": "flu"}, {"clock": CLOCK, "crs": "local"}, FormatError, "no column 'r33'"),
        (NAMES.replace("_utc_s", "_ns"), {"axes": "flu", "stamp": "unix_ns"}, {"clock": CLOCK, "crs": "local"},
         TimeSystemError, "in ns by its name"),
    ],
)  # fmt: skip
def test_nothing_is_guessed(tmp_path: Path, names: str, options: dict, stated: dict, error: type, says: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(names + "\n" + line(0, Rotation.identity()))
    with pytest.raises(error, match=says):
        read_log("pose_matrices", path, options, **stated)


def test_kitti_odometry(tmp_path: Path, recordings: Path) -> None:
    """Poses in the frame of the first picture, stamps in a file beside: the car drives 59.860 m along its x axis."""
    given = np.loadtxt(recordings / "pictures" / "drive_left" / "poses.txt")
    (tmp_path / "07.txt").write_bytes((recordings / "pictures" / "drive_left" / "poses.txt").read_bytes())
    path = tmp_path / "07.txt"
    assert format_of(path).name == "pose_matrices"
    stated = {"clock": Clock(TimeSystem.GPS), "crs": "local"}
    options = {"axes": "rdf", "frame": "rdf"}
    with pytest.raises(FormatError, match="no file of stamps"):
        read_log("pose_matrices", path, options, **stated)
    stamps = 1.4e9 + 0.1 * np.arange(len(given))
    lines = [f"{stamp:.10e}" if k == 3 else f"{stamp:.6f}" for k, stamp in enumerate(stamps)]
    (tmp_path / "times.txt").write_text("\n".join([*lines[:-1], ""]))
    with pytest.raises(ConfigError, match="frame"):
        read_log("pose_matrices", path, {"axes": "rdf"}, **stated)
    log = read_log("pose_matrices", path, options, **stated)
    assert [(r.record, r.reason) for r in log.rejects] == [
        (len(given) - 1, "the file of stamps ends before this line"),
    ]  # fmt: skip
    np.testing.assert_allclose(np.diff(log.epochs), 1e8, atol=1e6)
    np.testing.assert_array_equal(log.positions, np.stack([given[:, 11], -given[:, 3], -given[:, 7]], axis=1)[:-1])
    step = np.diff(log.positions, axis=0)
    forward = log.attitudes[:-1].inv().apply(step)
    assert np.degrees(np.arctan2(np.hypot(forward[:, 1], forward[:, 2]), forward[:, 0])).max() < 3
    assert (log.attitudes[0] * FLU_FROM_BODY.inv()).magnitude() < 1e-6  # forward, left, up at the first picture
