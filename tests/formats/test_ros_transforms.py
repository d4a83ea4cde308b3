"""Mountings by the static transforms of bags: only whole, unambiguous ones, of frames on the vehicle."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from roadscan.ingest.reading.format import Contents, Part, format_named
from tests.formats.ros_files import NS, header, write_bag

_T0 = 1_700_000_000 * NS


def _transform(parent: str, child: str, x: float, w: float = 1.0) -> dict[str, Any]:
    turn = {"w": w, "x": 0.0, "y": 0.0, "z": 0.0}
    moved = {"translation": {"x": x, "y": 0.0, "z": 0.0}, "rotation": turn}
    return {"header": header(_T0, parent), "child_frame_id": child, "transform": moved}


def _bag(path: Path, tree: list[dict[str, Any]], frames: tuple[str, ...], kind: str = "sqlite") -> Path:
    topics: dict[str, Any] = {"/tf_static": ("tf2_msgs/msg/TFMessage", [(_T0, {"transforms": tree})])}
    for frame in frames:
        rows = [(_T0 + k * NS // 10, {"header": header(_T0 + k * NS // 10, frame)}) for k in range(50)]
        topics[f"/{frame}"] = "sensor_msgs/msg/Imu", rows
    return write_bag(path, kind, topics)


def _contents(bag: Path) -> tuple[Contents, dict[str, Part]]:
    found = format_named("ros_imu").contents(bag)
    assert found is not None
    return found, {part.frame: part for part in found.parts if part.frame}


def _lever(part: Part) -> float:
    return float(part.mounting["lever_arm_body_m"][0])


def _counts_more(folder: Path) -> None:
    file = folder / "metadata.yaml"
    file.write_text(file.read_text().replace("\n  message_count: 51", "\n  message_count: 59"))
    assert "\n  message_count: 59" in file.read_text()


def _names_a_missing_file(folder: Path) -> None:
    file = folder / "metadata.yaml"
    file.write_text(file.read_text().replace("  relative_file_paths:\n", "  relative_file_paths:\n  - gone_7.db3\n"))
    assert "gone_7" in file.read_text()


def _cut_off(folder: Path) -> None:
    file = next(folder.glob("*.db3"))
    file.write_bytes(file.read_bytes()[:-4_096])


def _begins_with_an_empty_file(folder: Path) -> None:
    next(folder.glob("*.db3")).rename(folder / "bag_1.db3")
    (folder / "bag_0.db3").touch()


@pytest.mark.parametrize("harm", [_counts_more, _names_a_missing_file, _cut_off, _begins_with_an_empty_file])
def test_a_fault_of_a_bag_leaves_frames_and_mountings(harm: Any, tmp_path: Path) -> None:
    folder = _bag(tmp_path / "bag", [_transform("base_link", "imu", 1.5)], ("imu",))
    harm(folder)
    found, parts = _contents(folder)
    assert found.faults
    assert (parts["imu"].parent, _lever(parts["imu"])) == ("base_link", 1.5)


def test_transforms_that_contradict_themselves_are_named_and_not_used(tmp_path: Path) -> None:
    tree = [
        _transform("a", "b", 1.0),
        _transform("b", "a", 1.0),
        _transform("b", "ring", 1.0),
        _transform("self", "self", 1.0),
        _transform("base_link", "nan", np.nan),
        _transform("nan", "above_nan", 1.0),
        _transform("base_link", "unturned", 1.0, w=0.0),
        _transform("base_link", "twice", 1.0),
        _transform("base_link", "twice", 1.1),
        _transform("base_link", "again", 1.0),
        _transform("base_link", "again", 1.0),
    ]
    frames = ("ring", "self", "nan", "above_nan", "unturned", "twice", "again")
    found, parts = _contents(_bag(tmp_path / "bag", tree, frames, "mcap"))
    assert [name for name, part in parts.items() if part.mounting] == ["again"]
    assert _lever(parts["again"]) == 1.0
    assert set(found.faults) == {
        "the static transforms go round: b on a on b",
        "the static transforms go round: self on self",
        "the static transform of nan on base_link is not finite, or its quaternion is not of length 1",
        "the static transform of unturned on base_link is not finite, or its quaternion is not of length 1",
        "the static transforms place the frame twice in two ways",
    }
    assert parts["above_nan"].unmounted.startswith("the static transform of nan on base_link is not finite")
    assert parts["ring"].unmounted == "the static transforms go round: b on a on b"


def test_only_frames_on_the_vehicle_have_mountings(tmp_path: Path) -> None:
    tree = [
        _transform("map", "base_footprint", 100.0),
        _transform("base_footprint", "base_link", 0.3),
        _transform("base_link", "lidar", 1.0),
        _transform("os_sensor", "os_imu", 0.01),
    ]
    _, parts = _contents(_bag(tmp_path / "bag", tree, ("map", "base_footprint", "base_link", "lidar", "os_imu", "x")))
    assert {name: part.parent for name, part in parts.items() if part.mounting} == {"lidar": "base_link"}
    assert _lever(parts["lidar"]) == 1.0
    for above in ("map", "base_footprint"):
        assert parts[above].unmounted.startswith(f"base_link stands on the frame {above}")
    assert parts["os_imu"].unmounted == "the static transforms do not place the frame os_imu on base_link"
    assert not parts["base_link"].unmounted
    assert not parts["x"].unmounted
    shutil.rmtree(tmp_path / "bag")
    _, parts = _contents(_bag(tmp_path / "foot", [_transform("base_footprint", "lidar", 1.2)], ("lidar",)))
    assert (parts["lidar"].parent, _lever(parts["lidar"])) == ("base_footprint", 1.2)
