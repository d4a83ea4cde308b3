"""Readings of an IMU in a bag (sensor_msgs/Imu)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, Final, Literal

import numpy as np
import pyarrow as pa

from roadscan.core.errors import ConfigError, Missing
from roadscan.core.imu import STANDARD_GRAVITY_M_PER_S2
from roadscan.core.strict import Strict
from roadscan.formats.motion.imu_csv import FORCE_MAX_M_PER_S2, RATE_MAX_RAD_PER_S
from roadscan.formats.ros.bag import Bag, Topic
from roadscan.formats.ros.topics import Timed, TopicFormat, TopicOptions, blocks, message_clock
from roadscan.ingest.reading.format import Item, LogHeader, LogSource, Reject
from roadscan.ingest.reading.poses import block_rows
from roadscan.ingest.reading.records import EpochReader, Sieve, options_of

_LOOKED_AT: Final = 400  # messages from whose forces the unit is checked
_LEAST_FORCE_M_PER_S2: Final = 8.0
"""Least median force of a vehicle, of which gravity is the most: less is another unit, or gravity was taken away."""
_MOST_FORCE_M_PER_S2: Final = 12.0  # greatest median force of a vehicle
_AXES: Final = ("x", "y", "z")
_ABSENT: Final = -1.0  # first element of a covariance: the quantity is not measured (sensor_msgs/Imu)


class RosImuOptions(TopicOptions):
    """Settings of `ros_imu`."""

    force_unit: Literal["m_per_s2", "g"] | None = None
    """Unit of the linear acceleration. By the definition of the message it is m/s²; some drivers (Livox) write g.
    Needed where the values of the log contradict m/s²."""


class RosImu(TopicFormat):
    """A message a sample: angular rate (rad/s) and specific force (m/s²) on the axes of the sensor's frame.

    The orientation that some drivers add is not read. The axes are those of the frame that the header names; the rig
    file places them on the vehicle. A median force that is not that of gravity is refused until its unit is stated.
    """

    name = "ros_imu"
    title = "IMU in a ROS bag (sensor_msgs/Imu)"
    yields = ("imu",)
    types = ("sensor_msgs/msg/Imu",)
    options: ClassVar[type[Strict]] = RosImuOptions
    axes_on_sensor: ClassVar[str] = "they are the axes of the frame that the messages name, printed on the case"
    usual_axes: ClassVar[Mapping[str, str]] = {"flu": "the frame is x ahead, y left, z up, as ROS advises (REP 103)"}

    def attributes(self, source: LogSource, bag: Bag, topic: Topic) -> dict[str, Any]:
        """Check sensor and unit."""
        source.need_sensor("imu")
        return {"force_unit": _unit(source, bag, topic)}

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream samples; a message without rate or force is rejected."""
        epochs = EpochReader(message_clock(source), source.path)
        scale = STANDARD_GRAVITY_M_PER_S2 if header.attributes["force_unit"] == "g" else 1.0
        with Bag.open(source.path) as bag:
            for block in blocks(self.timed(source, bag)):
                if isinstance(block, list):
                    yield from _items(block, scale, epochs)
                else:
                    yield block


def _items(block: list[Timed], scale: float, reader: EpochReader) -> Iterator[Item]:
    records = np.array([one.message.number for one in block])
    offsets = np.array([one.message.offset for one in block])
    sieve = Sieve(records.size)
    sieve.drop(
        np.array(
            [_ABSENT in (one.content.angular_velocity_covariance[0], one.content.linear_acceleration_covariance[0])
             for one in block]
        ),
        "the message says that it holds no rate or no acceleration",
    )  # fmt: skip
    epochs = reader.epochs(np.array([one.stamp_ns for one in block]), sieve, records)
    columns = {}
    for axis in _AXES:
        rate = np.array([getattr(one.content.angular_velocity, axis) for one in block])
        force = np.array([getattr(one.content.linear_acceleration, axis) for one in block]) * scale
        sieve.require(f"angular_rate_{axis}", rate, -RATE_MAX_RAD_PER_S, RATE_MAX_RAD_PER_S, "rad/s")
        sieve.require(f"specific_force_{axis}", force, -FORCE_MAX_M_PER_S2, FORCE_MAX_M_PER_S2, "m/s²")
        columns[f"angular_rate_{axis}_rad_per_s"], columns[f"specific_force_{axis}_m_per_s2"] = rate, force
    if sieve.good.any():
        good = sieve.kept
        arrays = {"epoch_gps_ns": pa.array(epochs[good])} | {k: pa.array(v[good]) for k, v in columns.items()}
        yield block_rows("imu", arrays, records[good], offsets[good])
    yield from sieve.rejects(records, offsets)


def _unit(source: LogSource, bag: Bag, topic: Topic) -> str:
    """Return the unit of the forces: as stated, or m/s² where the first messages do not contradict it."""
    stated = options_of(source, RosImuOptions).force_unit
    if stated is not None:
        return stated
    forces = []
    for item in bag.decoded(topic.name):
        if not isinstance(item, Reject):
            vector = item[1].linear_acceleration
            forces.append(math.hypot(vector.x, vector.y, vector.z))
        if len(forces) >= _LOOKED_AT:
            break
    middle = float(np.median(forces)) if forces else STANDARD_GRAVITY_M_PER_S2
    if not _LEAST_FORCE_M_PER_S2 < middle < _MOST_FORCE_M_PER_S2:
        in_g = _LEAST_FORCE_M_PER_S2 < middle * STANDARD_GRAVITY_M_PER_S2 < _MOST_FORCE_M_PER_S2
        raise ConfigError(
            f"the median acceleration is {middle:.3g}, and that of a vehicle in m/s² is 9.8"
            + ("" if in_g else ": gravity is taken away, or another unit is used"),
            expected="specific force in m/s², as sensor_msgs/Imu defines it",
            change="" if in_g else "let the driver write the accelerometer's raw readings",
            file=source.path,
            missing=Missing("options.force_unit", "g" if in_g else None, ("m_per_s2", "g")),
        )
    return "m_per_s2"
