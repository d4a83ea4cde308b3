"""Point clouds of a bag (sensor_msgs/PointCloud2), of any layout of their fields."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Literal

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import ConfigError, FormatError, Missing, TimeSystemError
from roadscan.core.gpstime import NS_PER_S, UNIT_NS
from roadscan.core.strict import Strict
from roadscan.core.witness import Finding, Witness
from roadscan.formats.ros.bag import Bag, Topic, stamp_ns
from roadscan.formats.ros.return_rows import (
    FIELDS,
    INTENSITY_MAX,
    UNKNOWN_NS,
    Origin,
    PointTimes,
    ReturnRows,
    Sample,
    found,
)
from roadscan.formats.ros.topics import Timed, TopicFormat, TopicOptions
from roadscan.ingest.reading.format import Item, LogHeader, LogSource, Reject
from roadscan.ingest.reading.records import AXES, INTENSITIES, LASERS, field_named, options_of

_TYPES: Final = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Number types of sensor_msgs/PointField by its constants."""
_COARSEST_NS: Final = 1_000_000
"""Coarsest step of the points' times (ns): 0.02 m at 72 km/h."""
_LOOKED_AT: Final = 8  # messages from which units are found
_REASONS: Final = 4  # why messages are refused that an error names at most
_MAP_FRAMES: Final = re.compile(
    r"(map|odom|world|earth|utm|enu|ned|ecef)([_\d].*)?|local_(enu|ned|origin|map)|camera_init|global", re.IGNORECASE
)
"""Frames that are not of a sensor: a cloud in one of them was placed by another program already. REP 105, and the names
of LOAM and its heirs (camera_init), robot_pose_ekf (odom_combined), Autoware and MAVROS (map_ned, local_origin)."""


class RosPointsOptions(TopicOptions):
    """Settings of `ros_points`."""

    time_field: str | None = None
    """Field with the time of each point. Found by itself under the usual names: t, time, timestamp, time_stamp,
    offset_time."""
    time_unit: Literal["s", "ms", "us", "ns"] | None = None
    """Unit of that field; needed where the numbers leave it open."""
    time_from: Origin | None = None
    """What that field counts from: the message's stamp (`header`), or the origin of the clock (`epoch`); needed
    where the numbers leave it open."""
    time_ahead_s: float = 0.0
    """Seconds by which the points' times are ahead of the headers' stamps, where both count from the origin of a
    clock: 18 (since 2017) where the points are on GPS time and the headers on UTC, 37 where they are on TAI."""
    untimed: Literal["stamp"] | None = None
    """For clouds without a time of each point: "stamp" gives every point that of its message. It is right where the
    cloud was compensated for motion to that instant, and smears it otherwise. Has to be stated."""
    compensated: bool = False
    """True where the driver has moved all points to where the sensor saw them at the message's stamp."""
    intensity_field: str | None = None
    """Field with the intensity. Found by itself as intensity, reflectivity or signal, in this order."""
    intensity_full: float | None = None
    """Value of that field that becomes 65,535. Where left out, whole numbers stay as recorded, and fractions between 0
    and 1 are scaled by 65,535; needed for other fractions."""
    laser_field: str | None = None
    """Field with the laser's number. Found by itself as ring, channel, line or laser_id; 0 without one."""


class RosPoints(TopicFormat):
    """A message a sweep (or a part of one): points with any fields, of which x, y, z (m) are needed.

    Points whose position is not a number, or 0, 0, 0, are no returns and are left out. Big-endian clouds, rows of
    organised clouds with gaps between them, and unknown fields are read. Unit and origin of the points' times are
    stated, or follow from the numbers where these leave one alone: times within 2 s of the header's stamp count from
    the origin of its clock, and a sweep lasts about as long as from one message to the next.
    """

    name = "ros_points"
    title = "Point clouds in a ROS bag (sensor_msgs/PointCloud2)"
    yields = ("returns",)
    types = ("sensor_msgs/msg/PointCloud2",)
    options: ClassVar[type[Strict]] = RosPointsOptions
    axes_on_sensor: ClassVar[str] = "they are those of the frame that the messages name, by the driver's manual"
    usual_axes: ClassVar[Mapping[str, str]] = {"flu": "the frame is x ahead, y left, z up, as ROS advises (REP 103)"}

    def attributes(self, source: LogSource, bag: Bag, topic: Topic) -> dict[str, Any]:
        """Find fields, units and the time of points in the first messages."""
        source.need_sensor("lidar")
        plan = _plan(source, bag, topic)
        times = plan.times
        said = {} if times is None else {"time_field": times.field, "time_unit": times.unit, "time_from": times.origin}
        return {"frame": "sensor", "fields": list(plan.fields), "intensity_full": plan.intensity_full} | said

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream message by message; one that is no cloud, or of other fields than the first, is rejected."""
        options = options_of(source, RosPointsOptions)
        with Bag.open(source.path) as bag:
            plan = _plan(source, bag, self.topic(bag, source))
            rows, watch = ReturnRows(source, compensated=options.compensated), CloudWatch()
            for item in self.timed(source, bag):
                if not isinstance(item, Timed):
                    yield item
                    continue
                message = item.message
                try:
                    cloud = _cloud(item.content)
                    plan.check(cloud)
                except ValueError as error:
                    yield Reject(str(error), message.number, message.offset, 1, message.file)
                    continue
                offsets_ns = None
                if plan.times is not None:
                    own_ns = item.stamp_ns if options.stamps == "header" else stamp_ns(item.content.header.stamp)
                    offsets_ns = plan.times.offsets_ns(cloud[plan.times.field], own_ns)
                    if plan.times.origin == "epoch":
                        watch.times(offsets_ns)
                if plan.brightness is not None and plan.intensity_full is None:
                    watch.intensity(cloud[plan.brightness])
                yield from rows.items(
                    message, item.stamp_ns, [cloud[axis] for axis in AXES], offsets_ns,
                    plan.intensity(cloud), None if plan.laser is None else cloud[plan.laser],
                )  # fmt: skip
            yield from watch.findings()


@dataclass(frozen=True)
class _Plan:
    """How the clouds of a topic are read."""

    fields: tuple[str, ...]
    times: PointTimes | None
    laser: str | None
    brightness: str | None
    intensity_full: float | None

    def check(self, cloud: npt.NDArray[np.void]) -> None:
        """Raise ValueError where a field that is read is missing."""
        names = cloud.dtype.names or ()
        wanted = (*AXES, self.laser, self.brightness, None if self.times is None else self.times.field)
        missing = [name for name in wanted if name is not None and name not in names]
        if missing:
            raise ValueError(f"the cloud has no field '{missing[0]}', as the first one has")

    def intensity(self, cloud: npt.NDArray[np.void]) -> npt.NDArray[np.generic] | None:
        """Return the intensity (n,), 65,535 for the brightest."""
        if self.brightness is None:
            return None
        values = cloud[self.brightness]
        if self.intensity_full is None or self.intensity_full == INTENSITY_MAX:
            return np.asarray(values)
        return np.asarray(values * values.dtype.type(INTENSITY_MAX / self.intensity_full))


def _plan(source: LogSource, bag: Bag, topic: Topic) -> _Plan:
    """Find fields and units in the first messages with points."""
    options = options_of(source, RosPointsOptions)
    refused: list[str] = []
    first = list(itertools.islice(_first_clouds(bag, topic, refused), _LOOKED_AT))
    if not first:
        why = f": {'; '.join(refused)}" if refused else ""
        raise FormatError(f"the topic {topic.name} holds no cloud with points{why}", file=source.path)
    content, cloud = first[0]
    frame = str(content.header.frame_id).strip("/").split("/")[-1]
    if _MAP_FRAMES.fullmatch(frame):
        raise FormatError(
            f"the clouds of {topic.name} are in the frame '{frame}': another program has placed them already",
            expected="clouds in the frame of the sensor",
            change="name the topic that the lidar's driver writes",
            file=source.path,
        )
    names = cloud.dtype.names or ()
    first = [one for one in first if one[1].dtype.names == names]  # others are rejected when they are read
    if missing := [axis for axis in AXES if axis not in names]:
        raise FormatError(f"the clouds have no field '{missing[0]}'", expected="x, y, z in metres", file=source.path)
    if whole := [axis for axis in AXES if cloud.dtype[axis].kind in "iu"]:
        raise FormatError(
            f"the field '{whole[0]}' holds whole numbers ({cloud.dtype[whole[0]]}) of a unit that no message states",
            expected="x, y, z in metres, as floating-point numbers (REP 103)",
            change="let the driver publish metres",
            file=source.path,
        )
    brightness = field_named(options.intensity_field, "intensity_field", INTENSITIES, names, source.path)
    full = options.intensity_full
    if brightness is not None and full is None:
        full = _full(np.concatenate([one[brightness].astype(np.float64) for _, one in first]), brightness, source)
    return _Plan(
        fields=names,
        times=_times(options, first, names, source),
        laser=field_named(options.laser_field, "laser_field", LASERS, names, source.path),
        brightness=brightness,
        intensity_full=full,
    )


def _first_clouds(bag: Bag, topic: Topic, refused: list[str]) -> Iterator[tuple[Any, npt.NDArray[np.void]]]:
    """Yield the first messages with points; `refused` takes why others before them cannot be read."""
    for item in bag.decoded(topic.name):
        try:
            if isinstance(item, Reject):
                raise ValueError(item.reason)
            cloud = _cloud(item[1])
        except ValueError as error:
            if str(error) not in refused and len(refused) < _REASONS:
                refused.append(str(error))
            continue
        if cloud.size:
            yield item[1], cloud


def _times(
    options: RosPointsOptions, first: list[tuple[Any, npt.NDArray[np.void]]], names: tuple[str, ...], source: LogSource
) -> PointTimes | None:
    """Return how the points' times are written; None where options say that there are none."""
    name = field_named(options.time_field, "time_field", FIELDS, names, source.path)
    if name is None or (options.untimed is not None and options.time_field is None):
        if options.untimed is None:
            raise ConfigError(
                "the clouds state no time of each point, among their fields " + ", ".join(names),
                expected="options.time_field, or options.untimed",
                change='"stamp" gives each point the time of its message, which smears a sweep not compensated '
                "for motion: 0.1 s at 50 km/h are 1.4 m",
                file=source.path,
                missing=[Missing("options.untimed", "stamp"), Missing("options.time_field", choices=names)],
            )
        return None
    samples = []
    for content, cloud in first:
        place = np.abs([cloud[axis] for axis in AXES]).max(axis=0)
        values = cloud[name].astype(np.float64)[place > 0.0]  # what is no return may have any time
        values = values[np.isfinite(values)]
        if values.size:
            samples.append(Sample(stamp_ns(content.header.stamp), float(values.min()), float(values.max())))
    if not samples:
        raise FormatError(f"the field '{name}' holds no number", file=source.path)
    times = found(name, samples, options.time_unit, options.time_from, options.time_ahead_s, source.path)
    kind = first[0][1].dtype[name]
    step_ns = float(np.spacing(kind.type(abs(samples[0].most)))) * UNIT_NS[times.unit] if kind.kind == "f" else 0.0
    if step_ns > _COARSEST_NS:
        raise TimeSystemError(
            f"the field '{name}' ({kind.name}) states times to {step_ns / NS_PER_S:.3g} s only: so large a number has "
            "no finer steps",
            expected='options.untimed = "stamp", or clouds whose driver counts from the header\'s stamp',
            file=source.path,
            missing=Missing("options.untimed", "stamp"),
        )
    return times


def _full(values: npt.NDArray[np.float64], name: str, source: LogSource) -> float | None:
    """Return the value that becomes 65,535; None where values are whole numbers, which stay as recorded."""
    values = values[np.isfinite(values)]
    if not values.size or (values == np.rint(values)).all():
        return None
    if values.min() >= 0.0 and values.max() <= 1.0:
        return 1.0
    raise ConfigError(
        f"the field '{name}' holds fractions from {values.min():.4g} to {values.max():.4g}, and what its brightest "
        "value is does not follow from them",
        expected="options.intensity_full, by the driver's manual",
        file=source.path,
        missing=Missing("options.intensity_full", choices=(255.0, 100.0, float(INTENSITY_MAX))),
    )


def _cloud(content: Any) -> npt.NDArray[np.void]:
    """Return the points of a message (n,) by the names of their fields, without copying them.

    Raises
    ------
    ValueError
        where the message contradicts itself.
    """
    width, height, step = int(content.width), int(content.height), int(content.point_step)
    known = [f for f in content.fields if f.datatype in _TYPES and f.count <= 1 and f.name.strip("_ ")]  # _ is padding
    order = ">" if content.is_bigendian else "<"
    names = [str(f.name) for f in known]
    places = [int(f.offset) for f in known]
    kinds = [np.dtype(order + _TYPES[f.datatype]) for f in known]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"two fields of the cloud have the name '{twice}'")
    if any(place + kind.itemsize > step for place, kind in zip(places, kinds, strict=True)):
        raise ValueError("a field reaches beyond its point")
    if not width * height:
        return np.empty(0, np.dtype([("x", "f4")]))
    points = np.dtype({"names": names, "formats": kinds, "offsets": places, "itemsize": step})
    data = content.data
    row = int(content.row_step) if height > 1 else width * step
    if row in {0, data.size} and data.size == height * width * step:  # drivers that state no row, or all of them as one
        row = width * step
    if row < width * step or data.size < (height - 1) * row + width * step:
        raise ValueError("the cloud holds fewer bytes than its points need")
    if row == width * step:
        return np.frombuffer(data, points, count=width * height)
    rows = np.lib.stride_tricks.as_strided(data, (height, width * step), (row, 1), writeable=False)
    return np.ascontiguousarray(rows).view(points).ravel()


CLOUDS_OF_A_BAG: Final = Witness(
    "clouds_of_a_bag",
    input="clouds of a ROS bag",
    fault="The clock of the points' own times is not that of the headers, or intensities change their unit on the way.",
    asks="the middle of each sweep's own times against the header's stamp; each intensity against what the first "
    "messages hold",
    does="the points' own times are used; intensities are rounded and cut off at 65,535; both are named",
    told=("findings",),
)

_FAR_NS: Final = 300_000_000
"""Distance of a sweep's middle from its header (ns) that is named: drivers stamp the beginning or the end of a sweep,
which lasts a tenth of a second, or the moment of publication soon after."""
_STEP_NS: Final = 50_000_000  # change of that distance from one message to the next that is named (ns)


class CloudWatch:
    """Counts over the messages of a topic."""

    def __init__(self) -> None:
        self._middle_ns: list[int] = []
        self._rounded = 0
        self._bright = 0

    def times(self, offsets_ns: npt.NDArray[np.int64]) -> None:
        """Take the times (n,) of a message's points after its stamp, which count from the origin of the clock."""
        if offsets_ns.size and offsets_ns.max() == UNKNOWN_NS:
            offsets_ns = offsets_ns[offsets_ns != UNKNOWN_NS]
        if offsets_ns.size:
            self._middle_ns.append((int(offsets_ns.min()) + int(offsets_ns.max())) // 2)

    def intensity(self, values: npt.NDArray[np.generic]) -> None:
        """Take the intensities (n,) of a message, which are stored as whole numbers up to 65,535."""
        numbers: Any = values
        if numbers.dtype.kind == "f" and (odd := numbers[numbers != np.rint(numbers)]).size:
            self._rounded += int(np.count_nonzero(~np.isnan(odd)))
        if numbers.dtype.itemsize > 2:
            self._bright += int(np.count_nonzero(numbers > INTENSITY_MAX))

    def findings(self) -> Iterator[Finding]:
        """Yield what is doubtful, at the end of the topic."""
        if self._middle_ns:
            middle = np.array(self._middle_ns)
            usual = int(np.median(middle))
            steps = np.abs(np.diff(middle))
            if abs(usual) > _FAR_NS:
                yield CLOUDS_OF_A_BAG.finds(
                    "",
                    f"the points' own times lie {usual / NS_PER_S:+.3f} s from the headers' stamps (middle of a sweep, "
                    "median of the messages): one of the two clocks is off; the points' own times are used",
                )
            if steps.size and steps.max() > _STEP_NS:
                yield CLOUDS_OF_A_BAG.finds(
                    "",
                    f"the points' own times step {np.count_nonzero(steps > _STEP_NS)} times against the headers' "
                    f"stamps, by {steps.max() / NS_PER_S:.3f} s at the most; the points' own times are used",
                )
        if self._rounded:
            yield CLOUDS_OF_A_BAG.finds(
                "",
                f"{self._rounded:,} intensities are fractions, where the first messages hold whole numbers: they are "
                "rounded; options.intensity_full says which value is the brightest",
                self._rounded,
            )
        if self._bright:
            yield CLOUDS_OF_A_BAG.finds(
                "",
                f"{self._bright:,} intensities are brighter than {INTENSITY_MAX:,} and are cut off; "
                "options.intensity_full says which value is the brightest",
                self._bright,
            )
