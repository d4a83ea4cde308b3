"""Poses in a bag: nav_msgs/Odometry, geometry_msgs/PoseStamped and PoseWithCovarianceStamped."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar, Final

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.core.crs import LOCAL_WORLD, crs_from_text
from roadscan.core.frames import ENU_FROM_NED, quaternion_from_rotation
from roadscan.core.strict import Strict
from roadscan.formats.ros.bag import Bag, Topic
from roadscan.formats.ros.topics import Timed, TopicFormat, TopicOptions, blocks, message_clock
from roadscan.ingest.reading.format import Item, LogHeader, LogSource
from roadscan.ingest.reading.poses import (
    North,
    Placement,
    PoseReader,
    RawPoses,
    WorldPlacement,
    body_quaternion,
    level_placement,
    quaternion_product,
    unit_quaternions,
)
from roadscan.ingest.reading.records import Sieve, options_of

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
        placement = _placement(source)
        body_quaternion(options.axes, source.path)
        first = next((one[1] for one in bag.decoded(topic.name) if isinstance(one, tuple)), None)
        child = getattr(first, "child_frame_id", "")
        return {"world_frame": placement.world, "axes": options.axes} | ({"child_frame_id": child} if child else {})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream poses; a message that holds none is rejected."""
        placement = _placement(source)
        reader = PoseReader(source, message_clock(source), placement)
        body = body_quaternion(options_of(source, RosPosesOptions).axes, source.path)
        with Bag.open(source.path) as bag:
            for block in blocks(self.timed(source, bag)):
                if isinstance(block, list):
                    sieve = Sieve(len(block))
                    yield from reader.items(_poses(block, placement, body, sieve), sieve)
                else:
                    yield block


def _placement(source: LogSource) -> Placement:
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
