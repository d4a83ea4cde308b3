"""Fixes, NMEA sentences, inertial readings and poses in the bags of ROS."""

from __future__ import annotations

import itertools
import math
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Final, Literal

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Float64
from roadscan.core.crs import LOCAL_WORLD, crs_from_text
from roadscan.core.errors import ConfigError, Missing, RoadscanError
from roadscan.core.frames import ENU_FROM_NED, quaternion_from_rotation
from roadscan.core.rig import STANDARD_GRAVITY_M_PER_S2
from roadscan.core.strict import Strict
from roadscan.formats.motion.imu_csv import FORCE_MAX_M_PER_S2, RATE_MAX_RAD_PER_S
from roadscan.formats.motion.nmea import Nmea, NmeaOptions
from roadscan.formats.ros.bag import Bag, Topic
from roadscan.formats.ros.topics import Timed, TopicFormat, TopicOptions, blocks, message_clock
from roadscan.ingest.reading.format import Item, LogHeader, LogSource, Reject
from roadscan.ingest.reading.gnss import NO_POSITION, QUALITIES, UNKNOWN_QUALITY, GnssReader, RawSolutions
from roadscan.ingest.reading.poses import (
    GeodeticPlacement,
    North,
    Placement,
    PoseReader,
    RawPoses,
    WorldPlacement,
    block_rows,
    body_quaternion,
    level_placement,
    quaternion_product,
    unit_quaternions,
)
from roadscan.ingest.reading.records import EpochReader, Sieve, options_of

_NO_FIX: Final = -1  # status of sensor_msgs/NavSatStatus
_FIX: Final = 0  # without augmentation
_SBAS: Final = 1  # with augmentation from satellites
_GBAS: Final = 2  # with augmentation from the ground
_UNKNOWN: Final = -2  # status since ROS 2 Kilted: not yet known
_NO_COVARIANCE: Final = 0  # kinds of covariances in sensor_msgs/NavSatFix
_WHOLE_COVARIANCE: Final = 3  # COVARIANCE_TYPE_KNOWN


class RosGnssOptions(TopicOptions):
    """Settings of `ros_gnss`."""

    altitude: Literal["ellipsoidal", "orthometric"] = "ellipsoidal"
    """What the altitude counts from. By the definition of the message it is the ellipsoid; state orthometric, with
    height = "orthometric" and geoid, for a driver that writes heights above the sea."""
    gbas: Literal["fixed", "float", "dgps"] = "dgps"
    """What the driver means by the status GBAS_FIX: most drivers write it for RTK, fixed or float. The σ of the message
    counts in any case."""


class RosGnss(TopicFormat):
    """A message a solution: latitude, longitude (degrees), altitude, status, and the covariance east, north, up.

    The datum is the receiver's or its corrections': state it as crs. σ are the roots of the covariance's diagonal where
    its type is not "unknown"; covariances are taken where the type is "known".
    """

    name = "ros_gnss"
    title = "GNSS positions in a ROS bag (sensor_msgs/NavSatFix)"
    yields = ("gnss",)
    types = ("sensor_msgs/msg/NavSatFix",)
    options: ClassVar[type[Strict]] = RosGnssOptions

    def attributes(self, source: LogSource, bag: Bag, topic: Topic) -> dict[str, Any]:
        """Check CRS and heights."""
        return {"world_frame": _placement(source).world}

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream solutions."""
        epochs, reader = EpochReader(message_clock(source), source.path), GnssReader(source, _placement(source))
        gbas = options_of(source, RosGnssOptions).gbas
        with Bag.open(source.path) as bag:
            for block in blocks(self.timed(source, bag)):
                if isinstance(block, list):
                    sieve = Sieve(len(block))
                    yield from reader.items(_solutions(block, gbas, epochs, sieve), sieve)
                else:
                    yield block


def _placement(source: LogSource) -> GeodeticPlacement:
    altitude = options_of(source, RosGnssOptions).altitude
    by = "the definition of NavSatFix" if altitude == "ellipsoidal" else "options.altitude"
    way_out = 'options.altitude = "orthometric" if the driver writes heights above the sea'
    height = source.need_height(altitude, by, way_out if altitude == "ellipsoidal" else "")
    return GeodeticPlacement(source.need_crs(), height, source.geoid, source.path)


def _solutions(block: list[Timed], gbas: str, epochs: EpochReader, sieve: Sieve) -> RawSolutions:
    records = np.array([one.message.number for one in block])
    degrees = np.array([[one.content.longitude, one.content.latitude] for one in block]).T
    return RawSolutions(
        records=records,
        offsets=np.array([one.message.offset for one in block]),
        epochs=epochs.epochs(np.array([one.stamp_ns for one in block]), sieve, records),
        position=np.stack([*np.radians(degrees), np.array([one.content.altitude for one in block])]),
        quality=_quality(block, gbas, sieve),
        columns=_columns(block),
    )


def _quality(block: list[Timed], gbas: str, sieve: Sieve) -> npt.NDArray[np.int64]:
    """Return (n,) indices of `QUALITIES`."""
    known = {_NO_FIX: "none", _UNKNOWN: "none", _FIX: "single", _SBAS: "sbas", _GBAS: gbas}
    index = {status: QUALITIES.index(name) for status, name in known.items()}
    quality = np.array([index.get(int(one.content.status.status), UNKNOWN_QUALITY) for one in block])
    sieve.drop(quality == UNKNOWN_QUALITY, "the status is none of sensor_msgs/NavSatStatus")
    without = np.array([np.isnan([one.content.latitude, one.content.longitude]).any() for one in block])
    return np.where(without, NO_POSITION, quality)


def _columns(block: list[Timed]) -> dict[str, npt.NDArray[np.float64]]:
    """Return σ and covariances (n,) north, east, down; NaN where the message does not state them."""
    covariance = np.array([one.content.position_covariance for one in block])  # rows east, north, up
    kind = np.array([one.content.position_covariance_type for one in block])
    diagonal = np.where(kind[:, None] == _NO_COVARIANCE, np.nan, covariance[:, [4, 0, 8]])
    with np.errstate(invalid="ignore"):
        sigmas = np.sqrt(diagonal).T
    beside = np.where(kind[:, None] == _WHOLE_COVARIANCE, covariance[:, [1, 5, 2]] * [1.0, -1.0, -1.0] + 0.0, np.nan).T
    names = (
        "sigma_north_m",
        "sigma_east_m",
        "sigma_down_m",
        "covariance_ne_m2",
        "covariance_nd_m2",
        "covariance_ed_m2",
    )
    return dict(zip(names, (*sigmas, *beside), strict=True))


_SENTENCES: Final = "nmea_msgs/msg/Sentence"
_STRINGS: Final = "std_msgs/msg/String"
_LOOKED_AT: Final = 50  # messages of strings among which a sentence has to be


class RosNmeaOptions(NmeaOptions):
    """Settings of `ros_nmea`: those of `nmea`, and the topic."""

    topic: str | None = None
    """Topic that is read, such as "/nmea_sentence". Needed where the bag has several of sentences."""


class RosNmea(TopicFormat):
    """A message a sentence. The time is that of the sentences themselves: UTC, with the date of RMC or ZDA.

    The stamps of the messages are not used. A record is a sentence, in the order of the bag.
    """

    name = "ros_nmea"
    title = "NMEA sentences in a ROS bag (nmea_msgs/Sentence, std_msgs/String)"
    yields = ("gnss",)
    types = (_SENTENCES, _STRINGS)
    time = "UTC by its nature, with the date of RMC or ZDA"
    options: ClassVar[type[Strict]] = RosNmeaOptions

    def reads(self, bag: Bag, topic: Topic) -> bool:
        """Return whether a topic has NMEA sentences: one of strings has, where one of its first is a sentence."""
        if not super().reads(bag, topic) or topic.type == _SENTENCES:
            return super().reads(bag, topic)
        first = itertools.islice(bag.decoded(topic.name), _LOOKED_AT)
        return any(isinstance(one, tuple) and _text(one[1]).lstrip().startswith("$G") for one in first)

    def header(self, source: LogSource) -> LogHeader:
        """Check clock, CRS and heights, as for a log of sentences."""
        with self._sentences(source) as (log, topic):
            return LogHeader({"topic": topic, **Nmea().header(log).attributes})

    def attributes(self, source: LogSource, bag: Bag, topic: Topic) -> dict[str, Any]:
        """See :meth:`header`."""
        return {}

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream solutions."""
        with self._sentences(source) as (log, _):
            yield from Nmea().read(log, header)

    @contextmanager
    def _sentences(self, source: LogSource) -> Iterator[tuple[LogSource, str]]:
        """Give the log as a file of sentences, which is removed afterwards; errors name the bag."""
        stated = options_of(source, RosNmeaOptions)
        options = NmeaOptions.parse(stated.model_dump(exclude={"topic"}, exclude_unset=True), file=source.path)
        with tempfile.TemporaryDirectory(prefix="roadscan-nmea-") as folder, Bag.open(source.path) as bag:
            file, topic = Path(folder) / "sentences.nmea", self.topic(bag, source)
            with file.open("w", encoding="utf-8", errors="replace") as out:
                for item in bag.decoded(topic.name):
                    out.write("\n" if isinstance(item, Reject) else f"{_text(item[1]).strip()}\n")
            try:
                yield replace(source, path=file, options=options), topic.name
            except RoadscanError as error:
                raise error.at(source.path, error.record) from error


def _text(content: Any) -> str:
    return str(content.sentence if hasattr(content, "sentence") else content.data)


_FORCES_LOOKED_AT: Final = 400  # messages from whose forces the unit is checked
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
        if len(forces) >= _FORCES_LOOKED_AT:
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


_NED_FROM_ENU: Final = quaternion_from_rotation(ENU_FROM_NED.T)
_SIGMAS: Final = {"sigma_east_m": 0, "sigma_north_m": 7, "sigma_down_m": 14}
"""Places of the variances of x, y, z in a row-major 6 × 6 covariance."""


class RosPosesOptions(TopicOptions):
    """Settings of `ros_poses`."""

    axes: str | None = None
    """Where x, y, z of the posed frame (an Odometry's child frame) point on the vehicle, such as flu, as ROS advises
    for base_link (REP 103), or frd. Has to be stated."""
    heading: North | None = None
    """For a projected crs: whether the frame's y axis, from which headings follow, is grid north (`grid`) or true north
    at each pose (`true`)."""


class RosPoses(TopicFormat):
    """A message a pose: position (m) and quaternion of the posed frame in the frame that the header names.

    That frame is local (``crs = "local"``), geocentric, or a projection with x east, y north, z up (UTM, as SLAM with
    RTK writes it). The posed frame becomes the body; `axes` says where its axes point. σ of the position come from the
    covariance where it is not zero throughout, which is ROS's word for unknown; a geocentric frame leaves them out.
    """

    name = "ros_poses"
    title = "Poses in a ROS bag (nav_msgs/Odometry, geometry_msgs/PoseStamped, PoseWithCovarianceStamped)"
    yields = ("trajectory",)
    types = (
        "nav_msgs/msg/Odometry",
        "geometry_msgs/msg/PoseStamped",
        "geometry_msgs/msg/PoseWithCovarianceStamped",
    )
    options: ClassVar[type[Strict]] = RosPosesOptions

    def attributes(self, source: LogSource, bag: Bag, topic: Topic) -> dict[str, Any]:
        """Check CRS, heights and axes; an Odometry names its child frame."""
        options = options_of(source, RosPosesOptions)
        placement = _odometry_placement(source)
        body_quaternion(options.axes, source.path)
        first = next((one[1] for one in bag.decoded(topic.name) if isinstance(one, tuple)), None)
        child = getattr(first, "child_frame_id", "")
        return {"world_frame": placement.world, "axes": options.axes} | ({"child_frame_id": child} if child else {})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream poses; a message that holds none is rejected."""
        placement = _odometry_placement(source)
        reader = PoseReader(source, message_clock(source), placement)
        body = body_quaternion(options_of(source, RosPosesOptions).axes, source.path)
        with Bag.open(source.path) as bag:
            for block in blocks(self.timed(source, bag)):
                if isinstance(block, list):
                    sieve = Sieve(len(block))
                    yield from reader.items(_poses(block, placement, body, sieve), sieve)
                else:
                    yield block


def _odometry_placement(source: LogSource) -> Placement:
    crs = source.need_crs(LOCAL_WORLD)
    if crs != LOCAL_WORLD and crs_from_text(crs).is_projected:
        return level_placement(source, options_of(source, RosPosesOptions).heading)
    return WorldPlacement(crs, source.path)


def _poses(block: list[Timed], placement: Placement, body: Float64, sieve: Sieve) -> RawPoses:
    poses = [_pose(one.content) for one in block]
    places = np.array([[p.position.x, p.position.y, p.position.z] for p, _ in poses]).T
    turns = np.array([[p.orientation.w, p.orientation.x, p.orientation.y, p.orientation.z] for p, _ in poses]).T
    attitude = quaternion_product(unit_quaternions(turns, sieve), body)
    cartesian = isinstance(placement, WorldPlacement)
    return RawPoses(
        records=np.array([one.message.number for one in block]),
        offsets=np.array([one.message.offset for one in block]),
        stamps=np.array([one.stamp_ns for one in block]),
        position=places,
        attitude=attitude if cartesian else quaternion_product(_NED_FROM_ENU, attitude),
        sigmas={} if cartesian and placement.world != LOCAL_WORLD else _sigmas([c for _, c in poses]),
    )


def _pose(content: Any) -> tuple[Any, Any]:
    """Return pose and covariance (36,) of a message; None for one without."""
    pose = content.pose
    return (pose.pose, pose.covariance) if hasattr(pose, "covariance") else (pose, None)


def _sigmas(covariances: list[Any]) -> dict[str, Float64]:
    """Return σ (n,) of the position, NaN where the covariance is unknown; nothing for messages without one."""
    if any(one is None for one in covariances):
        return {}
    known = np.array(covariances)
    known[(known == 0.0).all(axis=1)] = np.nan
    with np.errstate(invalid="ignore"):
        return {name: np.sqrt(known[:, place]) for name, place in _SIGMAS.items()}
