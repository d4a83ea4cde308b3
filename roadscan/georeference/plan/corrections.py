"""The corrections in force, and digests of those that affect a span of time, by which stale tiles are found."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Self

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Int64
from roadscan.core.errors import NavigationError
from roadscan.core.gpstime import NS_PER_S
from roadscan.georeference.sources import MountingChanges, ReadingSource, change_of, load_mounting_changes
from roadscan.georeference.turns import TICK_NS, WINDOW_NS
from roadscan.navigation.tasks.trajectories import load_all_corrections
from roadscan.poses.movement import Allowance, allowance_for, largest
from roadscan.poses.trajectory import STENCIL_KNOTS, Corrections
from roadscan.store.store import Store

UInt64 = npt.NDArray[np.uint64]


@dataclass(frozen=True)
class KnownCorrections:
    """Corrections of all runs and of the mountings of all sensors, as stored in the tables."""

    by_run: Mapping[str, Corrections]
    mountings: MountingChanges = field(default_factory=dict)

    @classmethod
    def load(cls, store: Store) -> Self:
        """Read the tables. Damage is reported here, before tiles depend on it."""
        return cls(load_all_corrections(store), load_mounting_changes(store))

    def allowance(self, run: str, sensor: str) -> Allowance:
        """Return the allowance for corrections in bounds on a run's recorded poses and a sensor's stated mounting.

        Raises
        ------
        NavigationError
            where its corrections are no corrections.
        """
        own = self.by_run.get(run)
        try:
            change = change_of(self.mountings, run, sensor)
            return allowance_for(own, (0.0, 0.0) if change is None else change.largest)
        except ValueError:
            shift, turn = largest(own)
            raise NavigationError(
                f"the corrections of run '{run}' are as large as {shift:,.3g} m and {turn:.3g} rad",
                expected="corrections of recorded poses: metres and radians, small ones",
                change="remove the table `corrections`, or put a right one in its place",
            ) from None

    def digests(self, source: ReadingSource, spans_gps_ns: Int64, max_gap_s: float) -> UInt64:
        """Return a digest (n,) of the corrections that affect readings of spans (n, 2) of time; 0 where there are none.

        It combines that of the mounting and the sum of the digests of the knots in each span, and beyond it as far as
        interpolation uses them.
        """
        own = self.by_run.get(source.run)
        mounted = np.uint64(0) if source.trajectory is None else self._mounting_digest(source.run, source.sensor)
        if own is None or source.trajectory is None:
            return np.full(len(spans_gps_ns), mounted, np.uint64)
        wide = beyond_ns(source, max_gap_s)
        knots, sums = own.epochs_gps_ns, self._sums[source.run]
        first = np.searchsorted(knots, spans_gps_ns[:, 0] - wide, side="right") - 1
        last = np.searchsorted(knots, spans_gps_ns[:, 1] + wide, side="left")
        found: UInt64 = sums[np.minimum(last, knots.size - 1) + 1] - sums[np.maximum(first, 0)]
        return found + mounted

    def _mounting_digest(self, run: str, sensor: str) -> np.uint64:
        change = change_of(self.mountings, run, sensor)
        if change is None:
            return np.uint64(0)
        return np.uint64(int.from_bytes(hashlib.blake2b(change.values.tobytes(), digest_size=8).digest(), "little"))

    @cached_property
    def _sums(self) -> dict[str, UInt64]:
        """Return for each run the sums (k + 1,) of the digests of the knots before each, modulo 2⁶⁴."""
        return {run: np.append(np.uint64(0), np.cumsum(_digests(own))) for run, own in self.by_run.items()}


def beyond_ns(source: ReadingSource, max_gap_s: float) -> int:
    """Return how far beyond their epochs (ns) poses affect the readings of a source."""
    geometry = source.attribute.get("scan_geometry") or {}
    profile_s = float(geometry.get("reading_period_ns", 0.0)) * int(geometry.get("readings", 1)) / NS_PER_S
    turns = WINDOW_NS + TICK_NS if source.road is not None and source.road.turns is not None else 0
    return round((STENCIL_KNOTS * max_gap_s + profile_s) * NS_PER_S) + turns


def _digests(corrections: Corrections) -> UInt64:
    """Return a digest (k,) of each knot: its epoch and its six values."""
    columns = [corrections.epochs_gps_ns, *corrections.north_east_down_m.T, *corrections.roll_pitch_heading_rad.T]
    rows = np.column_stack([np.ascontiguousarray(column).view(np.uint64) for column in columns])
    found = b"".join(hashlib.blake2b(row.tobytes(), digest_size=8).digest() for row in rows)
    return np.frombuffer(found, np.uint64)
