"""Parquet files that bear a digest of all their bytes in their footer, and are refused where it does not hold.

The checksums of pages protect values. Nothing in the format protects the footer: one flipped bit there renames a
column, and the file reads as another table. Any reader of Parquet opens a sealed file, and takes the seal for metadata.
"""

from __future__ import annotations

import io
import re
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.store.digest import bytes_digest

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
