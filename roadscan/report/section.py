"""Sections of the report: their base class, and all of them: modules of `report/sections/`, and entry points."""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar, Final

import pyarrow.compute as pc

from roadscan.core.plugins import found_kinds
from roadscan.ingest.planned_logs import logs_of
from roadscan.navigation.tasks.navigate import known_keys
from roadscan.report.blocks import Block
from roadscan.report.summary import SurveySummary, survey_summary
from roadscan.run.session import Session
from roadscan.store.logs import LogRecord, read_log_records
from roadscan.store.manifest import OutputRecord, read_recorded
from roadscan.store.records import rows_of

ENTRY_POINT_GROUP: Final = "roadscan.report_sections"


@dataclass(frozen=True)
class Material:
    """The data of a survey for sections; shared results are computed once."""

    session: Session
    faults: list[str] = field(default_factory=list)
    """What sections left out because a file is damaged, in words."""

    @cached_property
    def summary(self) -> SurveySummary:
        """Figures of the whole survey."""
        return survey_summary(self.session.survey, self.session.store)

    @cached_property
    def records(self) -> dict[str, LogRecord]:
        """All sound records of logs by key."""
        return {record.key: record for record in read_log_records(self.session.store, damaged=[])}

    @cached_property
    def logs(self) -> list[LogRecord]:
        """Records of the survey file's logs and of the trajectories computed from them."""
        listed = set(known_keys(self.session.survey, self.session.store, logs_of(self.session)))
        return [record for key, record in self.records.items() if key in listed]

    @cached_property
    def _recorded(self) -> dict[str, OutputRecord]:
        """Records of pictures by path."""
        table = self.session.manifest.table()
        pictures = table.filter(pc.ends_with(table.column("path"), ".png"))
        return {row[3]: OutputRecord._make(row) for row in rows_of(pictures)}

    def picture(self, path: str) -> bytes:
        """Return a picture of the store, verified against its record.

        Raises
        ------
        DamagedError
            It is not as it was recorded.
        """
        record = self._recorded.get(path)
        return self.session.store.read_bytes(path) if record is None else read_recorded(self.session.store, record)


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
    def blocks(self, material: Material) -> Iterator[Block]:
        """Yield the blocks of the section; none where the survey has nothing of its kind, so that it is left out."""


@functools.cache
def sections() -> tuple[Section, ...]:
    """Return all sections, in the order of the page."""
    known = found_kinds("report/sections/*.py", Section, ENTRY_POINT_GROUP)
    return tuple(sorted((kind() for kind in known.values()), key=lambda s: (s.position, s.name)))
