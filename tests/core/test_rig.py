"""The rig file: axes, boresights, mountings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from roadscan.core.errors import ConfigError
from roadscan.core.rig import Boresight, Rig, Sensor

RIG = """
name = "van"

[sensors.left]
kind = "profiler"
lever_arm_body_m = [-1.2, -0.45, 0.30]
boresight = { roll_deg = 0.4, pitch_deg = -1.1, heading_deg = 2.5 }

[sensors.top]
kind = "lidar"
axes = "flu"
lever_arm_body_m = [0.8, 0.0, -1.1]
range_min_m = 1.5
range_max_m = 60

[sensors.camera]
kind = "camera"
body_from_sensor = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
"""


def test_a_rig_file(tmp_path: Path) -> None:
    file = tmp_path / "RIG.toml"
    file.write_text(RIG)
    rig = Rig.load(file)
    assert sorted(rig.sensors) == ["camera", "left", "top"]
    rotation, lever = rig.sensors["top"].mounting().arrays()
    np.testing.assert_array_equal(lever, [0.8, 0.0, -1.1])
    # A return 10 m ahead, 2 m to the left and 1 m up is 2 m to the left (y negative), 1 m up (z negative).
    np.testing.assert_array_equal(rotation @ [10, 2, 1], [10, -2, -1])
    # A camera's optical axis looks ahead, its x to the right, its y down.
    np.testing.assert_array_equal(rig.sensors["camera"].mounting().arrays()[0] @ [1, 2, 9], [9, 1, 2])


SMALL = st.floats(-20, 20)


@given(roll=SMALL, pitch=SMALL, heading=SMALL, axes=st.sampled_from(["frd", "flu", "rfu", "bru"]))
@settings(max_examples=60, deadline=None)
def test_boresight_turns_after_the_axes(roll: float, pitch: float, heading: float, axes: str) -> None:
    boresight = {"roll_deg": roll, "pitch_deg": pitch, "heading_deg": heading}
    sensor = Sensor.parse({"kind": "lidar", "axes": axes, "boresight": boresight})
    nominal = Sensor.parse({"kind": "lidar", "axes": axes}).mounting().arrays()[0]
    # Z-Y-X: about x first, then the fixed y, then the fixed z.
    turn = Rotation.from_euler("xyz", [roll, pitch, heading], degrees=True).as_matrix()
    np.testing.assert_allclose(sensor.mounting().arrays()[0], turn @ nominal, atol=1e-14)


@pytest.mark.parametrize(
    ("boresight", "forward_right_down"),
    [
        ({"roll_deg": 90}, [(1, 0, 0), (0, 0, 1), (0, -1, 0)]),  # positive lowers the right side
        ({"pitch_deg": 90}, [(0, 0, -1), (0, 1, 0), (1, 0, 0)]),  # positive raises the front
        ({"heading_deg": 90}, [(0, 1, 0), (-1, 0, 0), (0, 0, 1)]),  # positive turns clockwise from above
    ],
)
def test_boresight_directions_as_the_manual_words_them(
    boresight: dict[str, float], forward_right_down: list[tuple[int, int, int]]
) -> None:
    rotation = Sensor.parse({"kind": "lidar", "boresight": boresight}).mounting().arrays()[0]
    np.testing.assert_allclose(rotation.T, forward_right_down, atol=1e-15)


@pytest.mark.parametrize(
    ("sensor", "words"),
    [
        ({"kind": "lidr"}, "'kind' .got 'lidr'.*expected one of: profiler, lidar.*did you mean 'lidar'"),
        ({}, "key 'kind' is missing"),
        ({"kind": "lidar", "axes": "fru"}, "axes 'fru' are no right-handed set of directions, expected one of frd, "),
        ({"kind": "lidar", "range_min_m": 5, "range_max_m": 5}, "range_max_m 5 is not above range_min_m 5"),
        ({"kind": "lidar", "body_from_sensor": [[1, 0, 0], [0, 1, 0]]}, "not a 3 × 3 rotation"),
        ({"kind": "lidar", "body_from_sensor": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]}, "orthonormal"),
        ({"kind": "lidar", "body_from_sensor": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "mirrors"),
        (
            {"kind": "lidar", "lever_arm_m": [0, 0, 0]},
            r"unknown key 'lever_arm_m' \(did you mean 'lever_arm_body_m'\?\)",
        ),
    ],
)
def test_sensors_that_make_no_sense(sensor: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        Sensor.parse(sensor)


def test_what_a_log_knows_holds_where_the_rig_states_nothing() -> None:
    known = {"axes": "urf", "lever_arm_body_m": [0.3, 0.0, 0.0], "boresight": {"heading_deg": 180.0}}
    bare = Sensor(kind="profiler", range_max_m=30.0).mounted_as(known)
    assert (bare.axes, bare.lever_arm_body_m, bare.boresight.heading_deg) == ("urf", (0.3, 0.0, 0.0), 180.0)
    assert bare.range_max_m == 30.0
    own = Sensor(kind="profiler", axes="frd", lever_arm_body_m=(1.0, 0.0, 0.0), boresight=Boresight())
    assert own.mounted_as(known) is own
    turned = Sensor(kind="profiler", body_from_sensor=((1, 0, 0), (0, 1, 0), (0, 0, 1)))
    assert turned.mounted_as(known).mounting().body_from_sensor == ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    assert turned.mounted_as(known).lever_arm_body_m == (0.3, 0.0, 0.0)


def test_the_width_of_a_beam_is_stated_or_follows_from_the_model() -> None:
    def width(**stated: object) -> float | None:
        return Sensor.parse({"kind": "lidar", **stated}).beam_divergence_deg()

    assert width() is None and width(model="own build") is None
    assert width(model="Velodyne HDL-32E") == width(model="hdl_32e") == 0.17
    assert width(model="Ouster OS1-128") == 0.18 and width(model="Ouster OS1-64") == 0.13
    assert width(model="Velodyne HDL-32E", divergence_deg=0.0) == 0.0
