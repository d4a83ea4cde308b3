"""Profiles in which only road readings have ranges, and the classes of the other readings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Int64, UInt8, UInt16
from roadscan.core.rig import Mounting, Mountings
from roadscan.core.scan_geometry import ScanGeometry
from roadscan.core.settings.segmentation import RangeFilter, RoadSegmentation
from roadscan.georeference.classes import KEPT, NOT_ROAD, OVERLAPPING
from roadscan.georeference.kernels.carriageway import keep_road
from roadscan.georeference.kernels.readings import NO_RETURN
from roadscan.georeference.range_filter import kept_in_turns
from roadscan.georeference.segmentation import segmented
from roadscan.georeference.turns import turn_limits
from roadscan.poses.trajectory import Trajectory

_FIRST: Final = min(NOT_ROAD)


@dataclass(frozen=True)
class RoadProfiles:
    """Profiles whose readings off the road are set to 0."""

    ranges: UInt16
    """(n, m) raw; 0, no return, for readings that did not hit the road."""
    classes: UInt8
    """(n, m) classes; readings of ``NOT_ROAD`` are set to 0, those of the others depend on filters and map."""
    counts: Int64
    """(5,) readings set to 0 by class, in the order of ``NOT_ROAD``."""

    @classmethod
    def of(cls, ranges: UInt16, classes: UInt8) -> RoadProfiles:
        """Set the readings (n, m) to 0 that `classes` names."""
        road, counts = np.array(ranges, order="C"), np.zeros(len(NOT_ROAD), np.int64)
        keep_road(classes.reshape(-1), _FIRST, road.reshape(-1), counts)
        return cls(road, classes, counts)

    def tell(self, fates: Int64) -> None:
        """Correct counts (11,) by outcome (``FATE_NAMES``): a kernel counts readings set to 0 as without return."""
        fates[NO_RETURN] -= self.counts.sum()
        fates[-len(NOT_ROAD) :] += self.counts

    def mark(self, classes: UInt8) -> None:
        """Write the classes of readings set to 0 into the classes (n · m,) that a kernel wrote, by profile."""
        own = self.classes.reshape(-1)
        np.copyto(classes, own, where=own >= _FIRST)


@dataclass(frozen=True)
class RoadFinder:
    """Finder of the road in the profiles of one sensor in one run. A profile is judged by its ranges and the poses
    around its epoch, so the result does not depend on other profiles.
    """

    settings: RoadSegmentation
    trajectory: Trajectory
    """Trajectory, extending ``turns.WINDOW_NS`` around the profiles where the range filter is on."""
    mountings: Mountings
    range_min_m: float
    range_max_m: float

    def profiles(self, epochs_gps_ns: Int64, ranges: UInt16, geometry: ScanGeometry) -> RoadProfiles:
        """Segment profiles with epochs (n,) of their first readings and raw ranges (n, m).

        Where there is no pose at that epoch, a profile is left alone.
        """
        posed = self.trajectory.poses(epochs_gps_ns).found
        if posed.all():
            classes = self._segmented(ranges, geometry)
        else:
            classes = np.zeros(ranges.shape, np.uint8)
            classes[posed] = self._segmented(ranges[posed], geometry)
        if self.settings.turns is not None:
            for rows, mounting in self.mountings.pieces(epochs_gps_ns):
                self._mark_turns(
                    self.settings.turns, epochs_gps_ns[rows], ranges[rows], geometry, mounting, classes[rows]
                )
        return RoadProfiles.of(ranges, classes)

    def _segmented(self, ranges: UInt16, geometry: ScanGeometry) -> UInt8:
        return segmented(ranges, geometry, self.settings.profiles, self.range_min_m, self.range_max_m)

    def _mark_turns(
        self,
        settings: RangeFilter,
        epochs_gps_ns: Int64,
        ranges: UInt16,
        geometry: ScanGeometry,
        mounting: Mounting,
        classes: UInt8,
    ) -> None:
        """Mark, in the classes (n, m), road readings beyond the crossing of successive profiles."""
        limits = turn_limits(self.trajectory, mounting.lever_arm_body_m, epochs_gps_ns, settings)
        turning = np.flatnonzero(np.isfinite(limits).any(axis=1))
        if turning.size == 0:
            return
        own = classes[turning]
        beyond = ~kept_in_turns(_across_m(ranges[turning], geometry, mounting), limits[turning])
        own[(own == KEPT) & beyond] = OVERLAPPING
        classes[turning] = own


def _across_m(ranges: UInt16, geometry: ScanGeometry, mounting: Mounting) -> npt.NDArray[np.float64]:
    """Return the distances (n, m) of readings from the sensor across the body, right positive (m)."""
    origins, directions = geometry.rays()
    right = np.array(mounting.body_from_sensor[1])
    distance = geometry.range_offset_m + geometry.range_step_m * ranges
    start = origins[:, 1] * right[1] + origins[:, 2] * right[2]
    across: npt.NDArray[np.float64] = start + distance * (directions[:, 1] * right[1] + directions[:, 2] * right[2])
    return across
