"""Arrow without pandas, which it imports before its first array (0.1 s), for commands that make no frame.

Arrow asks once whether pandas is installed. Who makes a frame of a table imports it all the same
(:meth:`pyarrow.Table.to_pandas` asks again); only arrays of pandas' own columns would be taken for any others.
"""

from __future__ import annotations

import sys
from typing import Any


class _Hidden:
    """Finds no pandas."""

    def find_spec(self, name: str, *_: Any) -> None:
        """Raise an error for pandas; other modules are found elsewhere."""
        if name == "pandas":
            raise ModuleNotFoundError(name=name)


def arrow_alone() -> None:
    """Let Arrow ask for pandas while it is hidden, unless it is loaded already."""
    if "pandas" in sys.modules:
        return
    import pyarrow as pa

    hidden: Any = _Hidden()
    sys.meta_path.insert(0, hidden)
    try:
        pa.array([0])
    finally:
        sys.meta_path.remove(hidden)
