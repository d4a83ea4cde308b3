"""Record batches of Arrow IPC files (Feather), held against the list in the file's footer.

Arrow reads what the footer lists. A damaged or truncated list would leave out readings without a word.
"""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa

_FIRST_MESSAGE = 8
"""Byte behind the file's mark."""


def unlisted_batches(path: Path, listed: int) -> int:
    """How many record batches stand in the file beyond the `listed` ones of its footer; bodies are not read."""
    found = 0
    with pa.memory_map(str(path)) as stream:
        stream.seek(_FIRST_MESSAGE)
        try:
            reader = pa.ipc.MessageReader.open_stream(stream)
            while True:
                found += reader.read_next_message().type == "record batch"
        except (StopIteration, pa.ArrowException, OSError, ValueError):  # the end, or damage
            return max(0, found - listed)


def unlisted_reason(count: int) -> str:
    """Reason of the reject for them."""
    return f"{count} record batches stand in the file, but not in its footer"
