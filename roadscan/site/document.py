"""A document of the site: its path, its key, and how it is written."""

from __future__ import annotations

import functools
import json
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final, TypeAlias

from roadscan.core.plugins import found_kinds
from roadscan.run.keys import key_of
from roadscan.site.material import Material

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


ENTRY_POINT_GROUP: Final = "roadscan.site_parts"


class SitePart(ABC):
    """Documents of one kind, and their entries in `survey.json`."""

    name: ClassVar[str]
    """Folder of its documents."""
    position: ClassVar[int]
    """Documents are written in ascending order of this, those that a page requests first before others."""

    @abstractmethod
    def members(self, material: Material) -> Mapping[str, Any]:
        """Return members of `survey.json`."""

    @abstractmethod
    def documents(self, material: Material) -> Iterator[Document]:
        """Yield all documents; expensive content is made when a document is written."""

    def listed(self, material: Material) -> Iterator[Document]:
        """Yield the documents that a server lists at its start; :meth:`find` knows the others."""
        return self.documents(material)

    def find(self, material: Material, path: str) -> Document | None:
        """Return one document by its path below `name`; for a part with too many documents to list."""
        return None


@functools.cache
def site_parts() -> tuple[SitePart, ...]:
    """Return all parts, in the order in which they are written."""
    known = found_kinds("site/parts/*.py", SitePart, ENTRY_POINT_GROUP)
    return tuple(sorted((kind() for kind in known.values()), key=lambda p: (p.position, p.name)))
