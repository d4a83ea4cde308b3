"""A document of the site: where it lies, what it depends on, and how it is written."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeAlias

from roadscan.run.engine.fingerprint import key_of

_ESCAPED: Final = {ord(one): f"\\u{ord(one):04x}" for one in "<>&"}
"""Within a page these could end the element that a document stands in."""

EXACT_INTEGER: Final = 2**53
"""JavaScript's numbers tell whole numbers apart up to this."""


Ask: TypeAlias = Callable[[str], Path]
"""Where another document of the site lies, by its path; it is made before where that is due."""


@dataclass(frozen=True)
class Document:
    """A file of the site."""

    path: str
    """Relative to the site; letters, digits, ``_``, ``-`` and ``.`` alone."""
    key: str
    """Hash of all that shapes it."""
    write: Callable[[Path, Ask], None]
    """Writes it to a path; it may ask for other documents."""


def json_document(path: str, value: Any) -> Document:
    """A document that holds a value as JSON."""
    content = json_bytes(value)

    def write(file: Path, _ask: Ask) -> None:
        file.write_bytes(content)

    return Document(path, key_of(content.decode("ascii")), write)


def json_bytes(value: Any) -> bytes:
    """A value as JSON in ASCII, in which no text can end or begin an element of a page."""
    text = json.dumps(plain(value), ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.translate(_ESCAPED).encode("ascii")


def plain(value: Any) -> Any:
    """A value as JSON knows it: what is not a number is null, a whole number that JavaScript cannot hold is text."""
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, Mapping):
        return {str(name): plain(one) for name, one in value.items()}
    if isinstance(value, Sequence):
        return [plain(one) for one in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, int):
        return value if abs(value) < EXACT_INTEGER else str(value)
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value)
