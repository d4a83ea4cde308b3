"""A document of the site: its path, its key, and how it is written."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeAlias

from roadscan.run.engine.fingerprint import key_of

_ESCAPED: Final = {ord(one): f"\\u{ord(one):04x}" for one in "<>&"}
"""Characters that could end the page element around a document."""

EXACT_INTEGER: Final = 2**53
"""Limit of exact integers in JavaScript."""


Ask: TypeAlias = Callable[[str], Path]
"""Returns another document of the site by its path; it is made first if necessary, and is no file if that failed."""


@dataclass(frozen=True)
class Document:
    """A file of the site."""

    path: str
    """Path in the site; only letters, digits, ``_``, ``-`` and ``.``."""
    key: str
    """Hash of everything that determines it."""
    write: Callable[[Path, Ask], None]
    """Writes it to a path; may request other documents."""


def json_document(path: str, value: Any) -> Document:
    """Return a document with a value as JSON."""
    content = json_bytes(value)

    def write(file: Path, _ask: Ask) -> None:
        file.write_bytes(content)

    return Document(path, key_of(content.decode("ascii")), write)


def json_bytes(value: Any) -> bytes:
    """Return a value as ASCII JSON without characters that could begin or end an element of a page."""
    text = json.dumps(plain(value), ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.translate(_ESCAPED).encode("ascii")


def plain(value: Any) -> Any:
    """Return a value for JSON: NaN is null, an integer that JavaScript cannot represent is text."""
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
