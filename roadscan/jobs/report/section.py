"""What a section of the report is, and which there are: modules of `jobs/report/sections/`, and entry points."""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import ClassVar, Final

from roadscan.jobs.report.blocks import Block
from roadscan.jobs.session import Session
from roadscan.plugins import found_kinds

ENTRY_POINT_GROUP: Final = "roadscan.report_sections"


class Section(ABC):
    """A section of the report. It reads small tables, records and pictures of the store, never readings."""

    name: ClassVar[str]
    """Its anchor in the page."""
    title: ClassVar[str]
    """Its heading."""
    position: ClassVar[int]
    """Sections stand in ascending order of this number: recorded 100, navigation 200, adjustment 300, surfaces 400,
    condition 500, assets 600, products 900."""

    @abstractmethod
    def blocks(self, session: Session) -> Iterator[Block]:
        """What the section shows; nothing where the survey has nothing of its kind: it is left out then."""


@functools.cache
def sections() -> tuple[Section, ...]:
    """All sections, in the order of the page."""
    known = found_kinds("roadscan.jobs.report.sections", Section, ENTRY_POINT_GROUP)
    return tuple(sorted((kind() for kind in known.values()), key=lambda s: (s.position, s.name)))
