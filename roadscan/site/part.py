"""A part of the site: modules of `site/parts/`, and entry points."""

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
    """Documents of one kind, and what `survey.json` says of them."""

    name: ClassVar[str]
    """Folder of its documents."""
    position: ClassVar[int]
    """Documents are written in ascending order of this: what a page asks for first comes first."""

    @abstractmethod
    def members(self, material: Material) -> Mapping[str, Any]:
        """Members of `survey.json`."""

    @abstractmethod
    def documents(self, material: Material) -> Iterator[Document]:
        """All documents; what one takes long to make is made when it is written."""

    def listed(self, material: Material) -> Iterator[Document]:
        """Documents that a server lists from the beginning; :meth:`find` knows the others."""
        return self.documents(material)

    def find(self, material: Material, path: str) -> Document | None:
        """One document by its path below `name`; for a part whose documents are too many to list them all."""
        return None


@functools.cache
def site_parts() -> tuple[SitePart, ...]:
    """All parts, in the order in which they are written."""
    known = found_kinds("site/parts/*.py", SitePart, ENTRY_POINT_GROUP)
    return tuple(sorted((kind() for kind in known.values()), key=lambda p: (p.position, p.name)))
