"""The container of ROS 2's recorder with SQLite: a table of topics and a table of messages."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator, Set
from contextlib import closing
from pathlib import Path
from typing import Final

from roadscan.formats.ros.storage import Connection, Container, MessageSpan, Raw, RawItem
from roadscan.ingest.reading.format import Reject

MAGIC: Final = b"SQLite format 3\0"

_MOST_SKIPS: Final = 40  # after damage, reading goes on 1, 2, 4 … 2^40 messages farther


class SqliteFile(Container):
    """A `.db3` file."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        stated, size, self._cut_page = _end(path)
        try:
            with closing(self._connect()) as base:
                self._find_topics(base)
                self._find_spans(base)
        except sqlite3.Error as error:
            raise self.damaged(f"the database cannot be read: {error}") from error
        if stated > size:
            self.faults.append(Reject(f"the file is cut off: {size:,} of {stated:,} bytes are there"))
        log = path.with_name(path.name + "-wal")
        if log.is_file() and log.stat().st_size:
            self.faults.append(
                Reject(f"its last messages stand in {log.name}: sqlite3 {path.name} 'PRAGMA wal_checkpoint'")
            )

    def messages(self, wanted: Set[int]) -> Iterator[RawItem]:
        """Yield the messages of some topics in the order in which they were written."""
        yield from self.faults
        last, skip, limit = -1, 0, -1
        marks = ",".join("?" * len(wanted))
        query = (
            "SELECT id, topic_id, timestamp, data FROM messages "
            f"WHERE topic_id IN ({marks}) AND id > ? ORDER BY id LIMIT ?"
        )
        with closing(self._connect()) as base:
            while skip <= _MOST_SKIPS:
                try:
                    begun = last
                    for number, topic, stamp, data in base.execute(query, (*sorted(wanted), last, limit)):
                        last, skip = number, 0
                        if self._cut_page and isinstance(data, bytes) and self._reaches_beyond(data):
                            yield Reject("the file ends inside this message")
                        elif isinstance(stamp, int) and isinstance(data, bytes):
                            yield Raw(topic, -1, stamp, data)
                        else:
                            yield Reject("the row is no message")
                    if limit < 0 or last == begun:
                        return
                    limit = -1
                except sqlite3.Error as error:
                    if limit < 0:  # Python's sqlite3 seeks the next row before it gives one: ask for that one alone
                        limit = 1
                        continue
                    limit = -1
                    if not skip:
                        yield Reject(f"the database is damaged after message {last}: {error}")
                    last, skip = last + (1 << skip), skip + 1

    def _reaches_beyond(self, data: bytes) -> bool:
        """Return whether zeros behind the file's end may be part of a message: it holds what is there of the last page,
        or begins at its end.
        """
        return self._cut_page in data or self._cut_page.endswith(data.rstrip(b"\0"))

    def _connect(self) -> sqlite3.Connection:
        base = sqlite3.connect(f"{self.path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)
        base.execute("PRAGMA writable_schema = ON")  # without it, SQLite refuses a file that is cut off
        base.text_factory = lambda text: text.decode(errors="replace")
        return base

    def _find_topics(self, base: sqlite3.Connection) -> None:
        for number, name, kind, encoding in base.execute("SELECT id, name, type, serialization_format FROM topics"):
            if isinstance(number, int):
                self.connections[number] = Connection(number, str(name), str(kind), str(encoding))
        try:
            texts = base.execute("SELECT topic_type, encoding, encoded_message_definition FROM message_definitions")
            known = {name: (str(text), "idl" if "idl" in str(language) else "msg") for name, language, text in texts}
        except sqlite3.Error:
            return  # recorders before ROS 2 Iron write no such table
        for connection in self.connections.values():
            connection.definition, connection.definition_language = known.get(connection.type, ("", "msg"))

    def _find_spans(self, base: sqlite3.Connection) -> None:
        query = "SELECT topic_id, count(*), min(timestamp), max(timestamp) FROM messages GROUP BY topic_id"
        try:
            for number, count, first, last in base.execute(query):
                if number in self.connections and isinstance(first, int) and isinstance(last, int):
                    self.connections[number].span = MessageSpan(count, first, last)
        except sqlite3.Error:
            for item in self.messages(self.connections.keys()):
                if isinstance(item, Raw) and item.connection in self.connections:
                    connection = self.connections[item.connection]
                    connection.span = MessageSpan(1, item.receive_ns, item.receive_ns).joined(connection.span)


def _end(path: Path) -> tuple[int, int, bytes]:
    """Return the size that a database's header states (0 where it states none), its real size, and what is there of a
    page that is cut off: SQLite fills such a page with zeros (SQLite's file format, 1.3 and 1.6).
    """
    size = path.stat().st_size
    with path.open("rb") as stream:
        head = stream.read(100)
        if len(head) < 100 or head[24:28] != head[92:96]:  # written by a version that does not keep the size
            return 0, size, b""
        page, pages = struct.unpack_from(">H", head, 16)[0], struct.unpack_from(">I", head, 28)[0]
        page = max(65_536 if page == 1 else page, 512)
        stream.seek(size - size % page)
        return page * pages, size, stream.read(page)[4:].rstrip(b"\0")  # behind the number of the next page
