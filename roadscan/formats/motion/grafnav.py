"""Positions that NovAtel's Waypoint GrafNav, or Inertial Explorer, exports as text without attitude."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import ClassVar, Final, get_args

import numpy as np

from roadscan.core.crs import crs_from_text
from roadscan.core.errors import ConfigError, Missing
from roadscan.core.strict import Strict
from roadscan.formats.trajectories.inertial_explorer import InertialExplorer
from roadscan.formats.trajectories.office_text import OfficeTrajectory, Preamble, position_of, stamps_of
from roadscan.ingest.reading.format import Item, LogHeader, LogSource, Reject
from roadscan.ingest.reading.gnss import NO_POSITION, QUALITIES, GnssReader, RawSolutions, StatedQuality
from roadscan.ingest.reading.poses import North
from roadscan.ingest.reading.records import EpochReader, Sieve, options_of
from roadscan.ingest.reading.text_table import text_blocks

_QUALITIES: Final = {1: "fixed", 2: "float", 3: "float", 4: "float", 5: "dgps", 6: "single"}
"""Quality by the column Q (Waypoint 8.90 user manual, "Quality Number": 1 fixed integer … 6 coarse acquisition)."""


class GrafNavOptions(Strict):
    """Settings of `grafnav`."""

    quality: StatedQuality | None = None
    """Kind of the solutions, where no column Q says it."""


class GrafNav(OfficeTrajectory):
    """A preamble, a line of names, a line of units, a line a position; columns and times as in `inertial_explorer`.

    Q is the kind of the solution: 1 fixed, 2 to 4 float, 5 dgps, 6 single. Exports with roll, pitch and heading are
    trajectories (`inertial_explorer`).
    """

    name = "grafnav"
    title = "Waypoint GrafNav export (text): positions without attitude, σ and quality in columns of any order"
    yields = ("gnss",)
    time = InertialExplorer.time
    options = GrafNavOptions
    attitude: ClassVar[tuple[str, ...]] = ()
    vocabulary: ClassVar[Mapping[str, str]] = {**InertialExplorer.vocabulary, "q": "quality"}

    def preamble(self, lines: Sequence[str]) -> Preamble | None:
        """Return what stands above the first position, as that of Inertial Explorer's exports."""
        return InertialExplorer().preamble(lines)

    def sniff(self, path: Path) -> bool:
        """True if the preamble is Waypoint's and names positions, and no attitude."""
        return super().sniff(path) and not InertialExplorer().sniff(path)

    def north(self, source: LogSource) -> North | None:
        """Return grid north on a grid: positions have no heading."""
        crs = source.need_crs()
        return "grid" if crs != "local" and crs_from_text(crs).is_projected else None

    def header(self, source: LogSource) -> LogHeader:
        """Check columns, clock, CRS, heights and the kind of the solutions."""
        header = super().header(source)
        if "quality" not in header.attributes["columns"] and options_of(source, GrafNavOptions).quality is None:
            raise ConfigError(
                "no column Q says what kind of solution the positions are",
                expected="options.quality",
                file=source.path,
                missing=Missing("options.quality", choices=get_args(StatedQuality)),
            )
        return header

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream positions; a line that cannot be read is rejected."""
        plan = self.plan(source)
        reader = GnssReader(source, plan.placement)
        epochs = EpochReader(plan.clock, source.path)
        codes = np.array([QUALITIES.index(_QUALITIES.get(k, "none")) for k in range(max(_QUALITIES) + 1)])
        stated = options_of(source, GrafNavOptions).quality
        for block in text_blocks(source.path, plan.layout, plan.kinds):
            if isinstance(block, Reject):
                yield block
                continue
            sieve = Sieve(block.records.size)
            stamps = epochs.epochs(stamps_of(block, plan, sieve), sieve, block.records)
            position, sigmas = position_of(block, plan, sieve)
            if "quality" in plan.columns:
                said = block.number(plan.columns["quality"].words[0])
                known = np.isin(said, list(_QUALITIES))
                sieve.drop(~known, "the kind of the solution (Q) is unknown")
                quality = np.where(known, codes[np.where(known, said, 0).astype(np.int64)], NO_POSITION)
            else:
                quality = np.full(block.records.size, QUALITIES.index(stated or "none"))
            columns = {name: values for name, values in sigmas.items() if name.endswith("_m")}
            yield from reader.items(
                RawSolutions(block.records, block.offsets, stamps, position, quality.astype(np.int64), columns), sieve
            )
