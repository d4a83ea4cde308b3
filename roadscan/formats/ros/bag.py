"""Opens a bag of ROS 1 or ROS 2, lists its topics, and yields the messages of one.

A bag is a file of ROS 1 (`.bag`), a file of ROS 2 (`.db3`, `.mcap`), or a folder of such files with or without its
`metadata.yaml`. A bag that was cut off, or was never closed, gives what its whole chunks hold.

Definitions of message types that bags do not hold themselves, and what reads messages by a definition.

Bags of ROS 1, MCAP files, and SQLite files since ROS 2 Iron hold the definitions of their messages, which count. For
older SQLite files, those of ROS 2 itself come from the package rosbags, and those of lidar makers' drivers stand here.
"""

from __future__ import annotations

import functools
import re
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Final, NamedTuple, Self

from roadscan.core.errors import FormatError, nearest
from roadscan.core.extras import needed
from roadscan.core.gpstime import NS_PER_S
from roadscan.formats.lidars.pcap import Datagram
from roadscan.formats.ros.containers.mcap_file import MAGIC as MCAP
from roadscan.formats.ros.containers.mcap_file import McapFile
from roadscan.formats.ros.containers.ros1_file import OLDER as ROS1
from roadscan.formats.ros.containers.ros1_file import Ros1File
from roadscan.formats.ros.containers.sqlite_file import MAGIC as SQLITE
from roadscan.formats.ros.containers.sqlite_file import SqliteFile
from roadscan.formats.ros.storage import ZSTD, Connection, Container, MessageSpan, unpack_file, unpacked
from roadscan.ingest.reading.format import Reject

WHAT: Final = "a ROS bag"  # as the error of a missing package names it

_LIVOX_POINT: Final = """uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""
_LIVOX_MESSAGE: Final = """std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
CustomPoint[] points
"""
_SHIPPED: Final = {
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data\n",
    "velodyne_msgs/msg/VelodyneScan": "std_msgs/Header header\nVelodynePacket[] packets\n",
    "pandar_msgs/msg/PandarPacket": "builtin_interfaces/Time stamp\nuint8[1500] data\nuint32 size\n",
    "pandar_msgs/msg/PandarScan": "std_msgs/Header header\nPandarPacket[] packets\n",
    "nebula_msgs/msg/NebulaPacket": "builtin_interfaces/Time stamp\nuint8[] data\n",
    "nebula_msgs/msg/NebulaPackets": "std_msgs/Header header\nNebulaPacket[] packets\n",
    "rslidar_msg/msg/RslidarPacket": "std_msgs/Header header\nuint8 is_difop\nuint8 is_frame_begin\nuint8[] data\n",
    "rslidar_msgs/msg/rslidarPacket": "builtin_interfaces/Time stamp\nuint8[1248] data\n",
    "rslidar_msgs/msg/rslidarScan": "std_msgs/Header header\nrslidarPacket[] packets\n",
    "ouster_ros/msg/PacketMsg": "uint8[] buf\n",
    "ouster_msgs/msg/PacketMsg": "uint8[] buf\n",
    "ouster_sensor_msgs/msg/PacketMsg": "uint8[] buf\n",
    "livox_ros_driver/msg/CustomPoint": _LIVOX_POINT,
    "livox_ros_driver/msg/CustomMsg": _LIVOX_MESSAGE,
    "livox_ros_driver2/msg/CustomPoint": _LIVOX_POINT,
    "livox_ros_driver2/msg/CustomMsg": _LIVOX_MESSAGE,
    "livox_interfaces/msg/CustomPoint": _LIVOX_POINT,
    "livox_interfaces/msg/CustomMsg": _LIVOX_MESSAGE,
    "nmea_msgs/msg/Sentence": "std_msgs/Header header\nstring sentence\n",
}
"""Definitions from the public repositories of the drivers, as these publish them for ROS 2."""

_TYPE: Final = re.compile(r"([A-Za-z]\w*)/(?:msg/)?([A-Za-z]\w*)", re.ASCII)
_RULE: Final = "=" * 80 + "\n"  # divides the definitions of a text

Decode = Callable[[bytes | memoryview], Any]
"""Reads a serialised message; raises anything where the bytes are no such message."""


def type_name(recorded: str) -> str:
    """`package/msg/Name` of a type as a bag names it (ROS 1 leaves `msg` out); as recorded where it is no such name."""
    match = _TYPE.fullmatch(recorded)
    return f"{match[1]}/msg/{match[2]}" if match else recorded


def decoder(name: str, encoding: str, definition: str, language: str = "msg") -> Decode:
    """What reads messages of a type.

    Raises
    ------
    FormatError
        where neither the bag nor roadscan knows the type, or its serialisation is another than those of ROS.
    ConfigError
        where the package rosbags is not installed.
    """
    if encoding not in {"cdr", "ros1"}:
        raise FormatError(f"its messages are serialised as '{encoding}'", expected="those of ROS: ros1 or cdr")
    store = _store(name, definition, language)
    read = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr
    return functools.partial(read, typename=name)


@functools.lru_cache(maxsize=64)
def _store(name: str, definition: str, language: str) -> Any:
    """The types that a message needs; a text of a bag becomes code in rosbags, so its name has to be a plain one."""
    typesys = needed("rosbags.typesys", WHAT)
    if not _TYPE.fullmatch(name):
        raise FormatError(f"'{name}' is no name of a message type")
    try:
        if not definition:
            return _known_store(name)
        store = typesys.get_typestore(typesys.Stores.EMPTY)
        store.register(_parsed(typesys, name, definition, language))
        store.get_msgdef(name)
    except Exception as error:  # whatever a damaged definition raises
        raise FormatError(f"the definition of {name} cannot be read", change="record the topic again") from error
    return store


def _parsed(typesys: Any, name: str, definition: str, language: str) -> dict[str, Any]:
    if language == "msg" and not definition.startswith(_RULE + "IDL: "):
        return dict(typesys.get_types_from_msg(definition, name))
    found: dict[str, Any] = {}
    for part in definition.split(_RULE)[1:] or ["\n" + definition]:
        found |= typesys.get_types_from_idl(part.split("\n", 1)[1])
    return found


@functools.cache
def _ros2_store() -> Any:
    typesys = needed("rosbags.typesys", WHAT)
    store = typesys.get_typestore(typesys.Stores.LATEST)
    for name, text in _SHIPPED.items():
        store.register(typesys.get_types_from_msg(text, name))
    return store


def _known_store(name: str) -> Any:
    store = _ros2_store()
    if name not in store.fielddefs:
        raise FormatError(f"neither the bag nor roadscan holds the definition of {name}")
    return store


METADATA: Final = "metadata.yaml"

_CONTAINERS: Final[tuple[tuple[bytes, type[Container]], ...]] = (
    (ROS1, Ros1File),
    (MCAP, McapFile),
    (SQLITE, SqliteFile),
)
_SUFFIXES: Final = (".db3", ".mcap")  # endings of the files that make a bag of ROS 2
_PACKED: Final = (".zstd", ".zst")  # endings of files that ROS 2's recorder compressed as a whole
_LISTED: Final = re.compile(r"^  relative_file_paths:\n((?: +- .*\n?)*)", re.MULTILINE)
_COUNTED: Final = re.compile(r"^  message_count: (\d{1,15})$", re.MULTILINE)
_DIGITS: Final = re.compile(r"\d+")
_TABLES: Final = (b"topics", b"messages")  # tables by which a database of a bag is known
_SNIFFED: Final = 16_384  # bytes of a file's start that are searched for them


class Message(NamedTuple):
    """A message as the bag holds it."""

    number: int
    """Number in its topic, from 0."""
    offset: int
    """Byte of the file at which it, or its chunk, starts; −1 where the file has no such place."""
    receive_ns: int
    """Time at which the recording computer received it (POSIX ns by its clock)."""
    data: bytes | memoryview
    """Its content, serialised."""
    file: str = ""
    """File of a folder; '' for a bag of one file."""


@dataclass
class Topic:
    """A topic of a bag."""

    name: str
    type: str
    """`package/msg/Name`, of ROS 1 as of ROS 2."""
    encoding: str
    """How its messages are serialised: `ros1` or `cdr`."""
    definition: str = ""
    definition_language: str = "msg"
    span: MessageSpan | None = None
    """Number of its messages, and their first and last receive stamp (POSIX ns); None where it has none."""

    @property
    def count(self) -> int:
        """Number of messages."""
        return 0 if self.span is None else self.span.count

    @property
    def rate_hz(self) -> float | None:
        """Messages a second by the receive stamps; None for fewer than two."""
        if self.span is None or self.span.count < 2 or self.span.last_ns <= self.span.first_ns:
            return None
        return (self.span.count - 1) * NS_PER_S / (self.span.last_ns - self.span.first_ns)

    def decoder(self) -> Decode:
        """What reads its messages; raises FormatError where nothing can."""
        return decoder(self.type, self.encoding, self.definition, self.definition_language)


@dataclass
class Bag:
    """An open bag; to be closed, as it may have unpacked files into a temporary folder."""

    path: Path
    files: list[tuple[str, Container]] = field(default_factory=list)
    """The files in their order, each with its name in the folder ('' for a bag of one file)."""
    topics: dict[str, Topic] = field(default_factory=dict)
    faults: list[Reject] = field(default_factory=list)
    """What is damaged of the bag as a whole, such as an end that is missing."""
    _unread: list[FormatError] = field(default_factory=list)
    """Why files of the folder are left out."""
    _scratch: tempfile.TemporaryDirectory[str] | None = None

    @classmethod
    def open(cls, path: Path) -> Bag:
        """Open a bag; a list of its topics costs reading its index, or its records' heads where it has none.

        Raises
        ------
        FormatError
            if it is no bag, or nothing of it can be read.
        """
        bag = cls(path)
        try:
            for file in bag_files(path):
                bag._take(file, file.name if path.is_dir() else "")
            if not bag.files and bag._unread:
                raise bag._unread[0]
            bag._find_missing()
        except OSError as error:
            bag.close()
            raise FormatError(f"the bag cannot be read: {error.strerror or error}", file=path) from error
        except FormatError:
            bag.close()
            raise
        if not bag.files:
            raise FormatError("the folder holds no file of a bag", expected=".db3 or .mcap", file=path)
        return bag

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Remove what was unpacked."""
        if self._scratch is not None:
            self._scratch.cleanup()
            self._scratch = None

    def topic(self, name: str) -> Topic:
        """A topic by name; an error that lists the bag's topics where it has none of that name."""
        if name not in self.topics:
            listed = ", ".join(sorted(self.topics)) or "none"
            raise FormatError(
                f"the bag has no topic '{name}'{nearest(name, self.topics)}",
                expected=f"one of: {listed}",
                file=self.path,
            )
        return self.topics[name]

    def messages(self, topic: str) -> Iterator[Message | Reject]:
        """Yield the messages of a topic in the order of the bag, not deserialised, and a reject for what is damaged."""
        wanted, number, lost = self.topic(topic), 0, 0
        yield from self.faults
        for name, container in self.files:
            ids = {
                c.id for c in container.connections.values() if c.topic == topic and type_name(c.type) == wanted.type
            }
            for item in container.messages(ids) if ids else ():
                if isinstance(item, Reject):
                    lost += item.records
                    yield replace(item, record=number, file=name)
                    continue
                data = item.data
                if wanted.encoding == "cdr" and data[:4] == ZSTD:  # messages that were compressed one by one
                    try:
                        data = unpacked(data, "zstd")
                    except ValueError as error:
                        yield Reject(f"the compressed message is damaged: {error}", number, item.offset, 1, name)
                        number += 1
                        continue
                yield Message(number, item.offset, item.receive_ns, data, name)
                number += 1
        if number + lost < wanted.count:
            missing = wanted.count - number - lost
            yield Reject("the bag's index counts more messages than there are", number, -1, missing)

    def decoded(self, topic: str, decode: Decode | None = None) -> Iterator[tuple[Message, Any] | Reject]:
        """Yield each message of a topic with its content (fields as attributes, arrays of numbers as NumPy arrays).

        decode : reads a message in place of the topic's definition.
        """
        decode = decode or self.topic(topic).decoder()
        for message in self.messages(topic):
            if isinstance(message, Reject):
                yield message
                continue
            try:
                content = decode(message.data)
            except Exception:  # noqa: BLE001 — generated code that meets damaged bytes raises whatever comes
                yield Reject("the message does not fit its definition", message.number, message.offset, 1, message.file)
                continue
            yield message, content

    def _take(self, file: Path, name: str) -> None:
        """Open one file of the bag."""
        if file.suffix in _PACKED:
            if self._scratch is None:
                self._scratch = tempfile.TemporaryDirectory(prefix="roadscan-bag-")
            plain = Path(self._scratch.name) / file.stem
            fault = unpack_file(file, plain)
            if fault:
                self.faults.append(Reject(fault, file=name))
            file = plain
        try:
            container = _container(file)
        except FormatError as error:
            if not name:
                raise
            self._unread.append(error)
            self.faults.append(Reject(f"nothing of {name} is read: {error.arrived}", file=name))
            return
        self.files.append((name, container))
        for connection in container.connections.values():
            self._join(connection)

    def _join(self, connection: Connection) -> None:
        kind = type_name(connection.type)
        topic = self.topics.setdefault(
            connection.topic,
            Topic(
                connection.topic,
                kind,
                connection.encoding,
                connection.definition,
                connection.definition_language,
            ),
        )
        if topic.type != kind:
            self.faults.append(Reject(f"the topic {topic.name} is of two types: {topic.type} is read, {kind} is not"))
        elif connection.span is not None:
            topic.span = connection.span.joined(topic.span)

    def _find_missing(self) -> None:
        """Note files that the folder's metadata name, and messages that they count, and that are not there."""
        metadata = self.path / METADATA
        if not metadata.is_file():
            return
        text = metadata.read_text(encoding="utf-8", errors="replace")
        listed, stated = _LISTED.search(text), _COUNTED.search(text)
        lost = (int(stated[1]) if stated else 0) - sum(topic.count for topic in self.topics.values())
        if lost > 0:
            self.faults.append(Reject(f"{METADATA} counts more messages than the files hold", -1, -1, lost, METADATA))
        for line in listed[1].splitlines() if listed else ():
            name = Path(line.strip().removeprefix("- ").strip("\"'")).name
            if not any((self.path / name).with_name(name + end).is_file() for end in ("", *_PACKED)):
                self.faults.append(Reject(f"{METADATA} names {name}, which is not there", file=METADATA))


def is_bag(path: Path) -> bool:
    """Whether a file or folder is a bag, by its content."""
    if path.is_dir():
        return any(_is_part(file) for file in bag_files(path))
    return _is_part(path)


def bag_files(path: Path) -> list[Path]:
    """Files of a bag in the order in which they were written."""
    if not path.is_dir():
        return [path]
    whole = (path / METADATA).is_file()
    found = [p for p in path.iterdir() if p.is_file() and _plain(p).suffix in _SUFFIXES]
    if not whole and len({_DIGITS.sub("#", _plain(p).name) for p in found}) > 1:
        return []  # separate bags, in one folder
    return sorted(found, key=lambda p: [int(number) for number in _DIGITS.findall(_plain(p).stem)])


def _plain(file: Path) -> Path:
    """Return the name of a file without the ending of a compression."""
    return file.with_suffix("") if file.suffix in _PACKED else file


def packets(bag: Bag, topic: str) -> Iterator[Datagram | Reject]:
    """Yield the packets of a lidar that a topic of raw packets holds, in their order.

    A packet's time is the stamp that the driver gave it, and where it gave none, that of its message: by the recording
    computer's clock in either case, or the sensor's where the driver was so configured. Sender and port are not known.
    """
    number = 0
    for item in bag.decoded(topic):
        if isinstance(item, Reject):
            yield item
            continue
        message, content = item
        for payload, stamp_ns in _payloads(content, message.receive_ns):
            yield Datagram(number, message.offset, stamp_ns, "", 0, payload)
            number += 1


def stamp_ns(stamp: Any) -> int:
    """A stamp of ROS (`sec`, `nanosec`) in nanoseconds."""
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def _payloads(content: Any, receive_ns: int) -> Iterator[tuple[bytes, int]]:
    """Yield the packets of a message, each with its time (POSIX ns)."""
    if hasattr(content, "buf"):
        yield content.buf.tobytes(), receive_ns
        return
    if hasattr(content, "data"):
        yield content.data.tobytes(), stamp_ns(content.header.stamp) or receive_ns
        return
    for packet in content.packets:
        own_ns = stamp_ns(packet.stamp) if hasattr(packet, "stamp") else 0
        size = int(packet.size) if hasattr(packet, "size") else None
        yield packet.data[:size].tobytes(), own_ns or receive_ns


def _is_part(file: Path) -> bool:
    """Whether a file is one of a bag; a compressed one by its name alone."""
    if file.suffix in _PACKED:
        return _plain(file).suffix in _SUFFIXES
    try:
        with file.open("rb") as stream:
            start = stream.read(_SNIFFED)
    except OSError:
        return False
    return start.startswith((ROS1, MCAP)) or (start.startswith(SQLITE) and all(table in start for table in _TABLES))


def _container(file: Path) -> Container:
    with file.open("rb") as stream:
        start = stream.read(len(SQLITE))
    for magic, kind in _CONTAINERS:
        if start.startswith(magic):
            return kind(file)
    raise FormatError("the file is no part of a bag", expected="ROS 1 (.bag), ROS 2 (.db3) or MCAP (.mcap)", file=file)
