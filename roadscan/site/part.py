"""Parts of the site: their base class, and all of them: modules of `site/parts/`, and entry points."""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, Final

from roadscan.core.plugins import found_kinds
from roadscan.site.document import Document
from roadscan.site.material import Material

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
