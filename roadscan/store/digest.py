"""Digests of files and of their bytes, small JSON files that bear one, and the error that damage becomes.

Sealed Parquet files bear a digest of all their bytes in their footer, and are refused where it does not hold. The
checksums of pages protect values. Nothing in the format protects the footer: one flipped bit there renames a column,
and the file reads as another table. Any reader of Parquet opens a sealed file, and takes the seal for metadata.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq
from blake3 import blake3

from roadscan.core.errors import DamagedError, RoadscanError, StoreError, may_pass

UNREADABLE: Final = (
    pa.ArrowException, OSError, ValueError, KeyError, TypeError, AttributeError, IndexError, OverflowError, MemoryError,
)  # fmt: skip
"""Errors of Arrow, and of Python where it meets what a footer says: a name that is no UTF-8 (UnicodeDecodeError), a
statistic that is missing, a size that no memory holds."""

ROWS_CHANGE: Final = "`roadscan verify` names damaged files; remove the log's record to ingest it again"
"""What to do about a file of ingested rows."""

_ANSWERS: Final = "see to the network and the store, and run again: what is there stays"
"""What to do where a place does not answer."""


@contextmanager
def damage_named(arrived: str, file: str, change: str, record: str | None = None) -> Iterator[None]:
    """Raise :func:`unread` for whatever a reader of Parquet raises; roadscan's errors pass.

    arrived : what cannot be done, in words; the reader's reason is added.
    file, record : where.
    change : what to do about damage.
    """
    try:
        yield
    except RoadscanError:
        raise
    except UNREADABLE as error:
        raise unread(arrived, error, file, change, record) from error


def unread(arrived: str, error: Exception, file: str, change: str, record: str | None = None) -> StoreError:
    """Return a DamagedError, or a StoreError where the place did not answer: then the file may be whole."""
    reason = str(error) or type(error).__name__
    if passing := may_pass(error):
        return StoreError(f"{arrived}: {passing} ({reason})", change=_ANSWERS, file=file, record=record)
    return DamagedError(f"{arrived} ({reason})", change=change, file=file, record=record)


_CHUNK: Final = 1 << 18  # fits into a core's cache between reading and hashing (bytes)
_ALGORITHM: Final = "blake3:"


def file_digest(path: Path) -> str:
    """Return the BLAKE3-128 of a file's bytes: ``blake3:`` and 32 hexadecimal digits."""
    with path.open("rb", buffering=0) as stream:
        return stream_digest(stream)


def stream_digest(stream: Any) -> str:
    """Return the same digest for the rest of an open binary stream."""
    return f"{_ALGORITHM}{_hashed(stream, blake3()).digest(length=16).hex()}"


def bytes_digest(content: bytes) -> str:
    """Return the same digest for a file's future bytes."""
    return f"{_ALGORITHM}{blake3(content).digest(length=16).hex()}"


def digest_holds(path: Path, digest: str) -> bool:
    """Return True if a file still has the content of `digest`.

    A digest without a prefix is BLAKE2b-128, as stores of older versions hold them: such files stay sound.
    """
    if ":" in digest:
        return file_digest(path) == digest
    with path.open("rb", buffering=0) as stream:
        return bool(_hashed(stream, hashlib.blake2b(digest_size=16)).hexdigest() == digest)


def bytes_hold(content: bytes, digest: str) -> bool:
    """Return the same for a file's content."""
    if ":" in digest:
        return bytes_digest(content) == digest
    return hashlib.blake2b(content, digest_size=16).hexdigest() == digest


def _hashed(stream: Any, state: Any) -> Any:
    # Read, not mapped: an unreadable sector then raises OSError, instead of a signal that ends the process.
    buffer = bytearray(_CHUNK)
    view = memoryview(buffer)
    while count := stream.readinto(buffer):
        state.update(view[:count])
    return state


_SEAL: Final = b',\n "checksum": "%b"'
_END: Final = b"\n}"


def checked_json(values: Mapping[str, Any]) -> bytes:
    """Return a non-empty object as JSON with its checksum."""
    return _sealed(json.dumps(values, indent=1, sort_keys=True).encode())


def parse_checked(content: bytes) -> dict[str, Any]:
    """Return the object without its checksum (files of older versions have none); raise ValueError for damage."""
    mark, _, _ = _SEAL.partition(b"%b")
    start = content.rfind(mark)
    text = content if start < 0 else content[:start] + _END
    if start >= 0 and content != _sealed(text):
        raise ValueError("its checksum differs")
    values = json.loads(text)
    if not isinstance(values, dict):
        raise ValueError("it holds no object")
    return values


def _sealed(text: bytes) -> bytes:
    return text.removesuffix(_END) + _SEAL % bytes_digest(text).encode() + _END


_KEY: Final = "roadscan:digest"
_BLANK: Final = "0" * len(bytes_digest(b""))
"""Stands in the place of the digest while that is taken."""
_HEAD_BYTES: Final = 2
"""Between the key and its value: type and length of a text in Thrift's compact protocol."""
_NAMELESS: Final = re.compile(rb"\x18%c.{%d}\x18%cblake3:[0-9a-f]{32}" % (len(_KEY), len(_KEY), len(_BLANK)), re.DOTALL)
"""An entry of a footer as long as the seal's, and with a digest in it: texts of Thrift's compact protocol."""
_TAIL_BYTES: Final = 1 << 20
"""How far from the end of a file it is sought (bytes): entries stand at the end of a footer."""


def sealed_parquet(table: pa.Table, **settings: Any) -> bytes:
    """Return a table as the content of a sealed file; equal rows and settings give equal bytes.

    settings : of :func:`pyarrow.parquet.write_table`.
    """
    rows = settings.pop("row_group_size", None)
    out = io.BytesIO()
    table = without_seal(table)
    with pq.ParquetWriter(out, table.schema, write_page_checksum=True, **settings) as writer:
        writer.write_table(table, row_group_size=rows)
        writer.add_key_value_metadata({_KEY: _BLANK})
    content = out.getvalue()
    place = _place(content)
    if content[place] != _BLANK.encode():
        raise AssertionError("this version of Arrow writes metadata in another form")
    return _with(content, place, bytes_digest(content))


def bears_seal(content: bytes) -> bool:
    """Return whether a file bears a seal, which may hold or not."""
    return bool(_place(content).start >= 0)


def check_seal(content: bytes) -> None:
    """Raise ValueError where a file bears a seal that does not hold, or whose name is damaged; others pass."""
    place = _place(content)
    if place.start < 0:
        if _NAMELESS.search(content, max(len(content) - _TAIL_BYTES, 0)):
            raise ValueError("the name of its digest is damaged")
        return
    stated = content[place]
    if bytes_digest(_with(content, place, _BLANK)).encode() != stated:
        raise ValueError("its digest differs from the one that it states")


def without_seal(table: pa.Table) -> pa.Table:
    """Return a table as it was before it was written as a sealed file."""
    told = {name: value for name, value in (table.schema.metadata or {}).items() if name != _KEY.encode()}
    return table.replace_schema_metadata(told or None)


def _place(content: bytes) -> slice:
    """Return where the digest of a file stands; a negative beginning where it bears none."""
    key = content.rfind(_KEY.encode())  # not from where the footer's length says, which may be damaged itself
    start = key + len(_KEY) + _HEAD_BYTES
    return slice(-1, -1) if key < 0 else slice(start, start + len(_BLANK))


def _with(content: bytes, place: slice, digest: str) -> bytes:
    return b"".join([content[: place.start], digest.encode(), content[place.stop :]])
