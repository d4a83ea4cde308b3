"""Positions of a GNSS receiver in a bag (sensor_msgs/NavSatFix)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar, Final, Literal

import numpy as np
import numpy.typing as npt

from roadscan.core.strict import Strict
from roadscan.formats.ros.bag import Bag, Topic
from roadscan.formats.ros.topics import Timed, TopicFormat, TopicOptions, blocks, message_clock
from roadscan.ingest.reading.format import Item, LogHeader, LogSource
from roadscan.ingest.reading.gnss import NO_POSITION, QUALITIES, UNKNOWN_QUALITY, GnssReader, RawSolutions
from roadscan.ingest.reading.poses import GeodeticPlacement
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
