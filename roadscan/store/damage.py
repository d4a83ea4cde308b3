"""What readers of Parquet raise of a damaged file, and the one error that it becomes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

import pyarrow as pa

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
