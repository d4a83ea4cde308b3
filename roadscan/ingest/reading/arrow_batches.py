"""Reads record batches of mapped Arrow IPC files (Feather), and checks them against the list in the file's footer.

Arrow reads what the footer lists. A damaged or truncated list would silently leave out readings.
"""

from __future__ import annotations

import itertools
import mmap
from pathlib import Path

import pyarrow as pa

_FIRST_MESSAGE = 8
"""Byte of the first message, after the file's magic number."""
_MESSAGES = 16
"""Messages that are read before their pages are released."""


class MappedBatches:
    """Record batches of a file as views of its mapped pages: nothing is copied, whatever the size of a batch.

    Parameters
    ----------
    fields : numbers of the columns that are wanted; all where left out.

    Raises
    ------
    pa.ArrowException, OSError, ValueError
        where the file is no whole Arrow IPC file.
    """

    def __init__(self, path: Path, fields: list[int] | None = None) -> None:
        self._pages = _mapped(path)
        chosen = pa.ipc.IpcReadOptions(included_fields=fields)
        self.reader = pa.ipc.open_file(pa.BufferReader(pa.py_buffer(self._pages)), options=chosen)

    def release(self) -> None:
        """Release the pages read so far; views stay valid, because a page is mapped again when it is accessed."""
        _give_back(self._pages)


def unlisted_batches(path: Path, listed: int) -> int:
    """Return how many record batches of the file its footer does not list, beyond `listed`; bodies are not read."""
    found = 0
    try:
        pages = _mapped(path)
        stream = pa.BufferReader(pa.py_buffer(pages))
        stream.seek(_FIRST_MESSAGE)
        reader = pa.ipc.MessageReader.open_stream(stream)
        for number in itertools.count():
            found += reader.read_next_message().type == "record batch"
            if number % _MESSAGES == 0:
                _give_back(pages)
    except (StopIteration, pa.ArrowException, OSError, ValueError):  # the end, or damage
        pass
    return max(0, found - listed)


def _mapped(path: Path) -> mmap.mmap:
    with path.open("rb") as stream:
        return mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)


def _give_back(pages: mmap.mmap) -> None:
    """Release the pages touched so far: else the process would seem to occupy all of the log that it has read."""
    if hasattr(mmap, "MADV_DONTNEED"):
        pages.madvise(mmap.MADV_DONTNEED)


def unlisted_reason(count: int) -> str:
    """Return the reason of the reject for them."""
    return f"{count} record batches stand in the file, but not in its footer"
