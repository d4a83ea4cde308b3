"""What readers of Parquet raise of a damaged file, and the one error that it becomes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

import pyarrow as pa

from roadscan.core.errors import DamagedError, RoadscanError

UNREADABLE: Final = (
    pa.ArrowException, OSError, ValueError, KeyError, TypeError, AttributeError, IndexError, OverflowError, MemoryError,
)  # fmt: skip
"""Errors of Arrow, and of Python where it meets what a footer says: a name that is no UTF-8 (UnicodeDecodeError), a
statistic that is missing, a size that no memory holds."""

ROWS_CHANGE: Final = "`roadscan verify` names damaged files; remove the log's record to ingest it again"
"""What to do about a file of ingested rows."""


@contextmanager
def damage_named(arrived: str, file: str, change: str, record: str | None = None) -> Iterator[None]:
    """Raise a DamagedError for whatever a reader of Parquet raises of a damaged file; roadscan's own errors pass.

    arrived : what cannot be done, in words; the reader's own reason is added.
    file, record : where.
    change : what to do about it.
    """
    try:
        yield
    except RoadscanError:
        raise
    except UNREADABLE as error:
        reason = str(error) or type(error).__name__
        raise DamagedError(f"{arrived} ({reason})", change=change, file=file, record=record) from error
