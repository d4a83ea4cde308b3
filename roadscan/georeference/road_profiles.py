"""Profiles in which only road readings have ranges, and the classes of the other readings.

Range filter for turns (Yu and others 2007, eq. 3): readings beyond the crossing of successive profiles.

    RF(r) = keep where r · cos θ ≤ d_crit = Δs / sin Δθ, else remove

**What is meant.** Δs is the arc between successive profiles, measured along the path of the sensor, and Δθ, here, the
change of heading between them. The paper calls Δθ the scanner's angular resolution, but takes the filter from work on
scanning façades from a vehicle (Früh, Jain, Zakhor 2005, *Data processing algorithms for generating textured 3D
building façade meshes from laser scans and camera images*), whose redundancy arises where the vehicle turns: the
planes of two successive scans that differ in heading by Δθ cross at the distance Δs / sin Δθ, the radius of the turn,
on its inner side. Nearer, the profiles cover the road in the order of driving. Beyond, they cover it again, the other
way round, and where they lie around the crossing, one spot is read from many poses. On the outer side profiles fan
out: they never overlap, and all readings are kept. A resolution of the scanner would cut every profile, straight
ones too, at Δs / sin 0.5° (3.4 m at 3 cm a profile).

r · cos θ is the reading's horizontal distance from the sensor across the path.

``georeference.road_profiles`` takes heading and path over at least `base_m` of path, so that the noise of
successive headings is no turn. A vehicle that stands has no arc: it is not turning.

Crossings of successive profiles in turns of a trajectory (Yu et al. 2007, eq. 3; see ``georeference.road_profiles``).

The trajectory is sampled at whole multiples of :data:`TICK_NS`. From tick to tick, Δs is the distance of the
sensor along the body's x axis, and Δθ the rotation of the body about its z axis: the planes of two profiles
that lie across the body cross at Δs / sin Δθ beside the sensor, on the right where the vehicle turns right (and on the
left where it turns right backwards). A profile has the limits of the tick nearest to it, from the ticks around it over
`base_m` of path, at most :data:`WINDOW_NS` before and after. A vehicle that does not go half as far in that time
stands: it is not turning. Steps are summed as whole nanometres and nanoradians, so that limits have the same bits
wherever the trajectory that is at hand begins.

Profile segmentation: which readings of a profile hit the road, and why the others did not.

The three steps are those of 3.2.1 in Yu, Sukumar, Koschan, Page, Abidi 2007 (*3D reconstruction of road surfaces using
an integrated multi-sensory approach*, Optics and Lasers in Engineering 45), for profiles of a scanner that looks down
at the road. Nothing is deleted: every reading gets a class. Each profile is judged alone, in the plane and axes of the
sensor (y across, height = −z), so the result depends on nothing else. The paper says the steps in a few words; they are
read as follows.

**The datum.** The paper's scanner hung level over a level road, and its histogram is one of z. Here a road has
crossfall and a crown, the vehicle rolls, and the same road is spread over half a metre of z. Heights are counted from
the road's level in the profile: lines through nine pieces of the profile are tried, the one that most readings
agree with (within `gate_m`) is the road's, and a parabola is fitted to the readings near it.

**1. Threshold from the histogram** of these heights, bins of `bin_m`. *(i)* N is the bin with most readings. *(ii)*
N1 is searched upwards from N, towards what stands on the road: the last bin of the unbroken run of bins that each hold
at least 40 % of N's count. *(iii)* N2 likewise from N1. Runs are unbroken, so a second peak (a pavement behind
a kerb) is not reached. The threshold is the upper edge of N2, and a bin more, since where in its bin the road's level
lies is chance.

**2. Height.** Readings higher than the threshold are `above_surface`: cars, trees, walls. What lies low is kept, lest
potholes go.

**3. Scattered and grazing readings.** *Second derivative*: how far a reading stands above the line through its two
neighbours, which is the second difference free of the spacing. "Larger compared with neighboring points": more than
`scatter_factor` times the mean of the `scatter_readings` on each side, more than that many times the profile's
noise, and no less than that of the two beside it: `scattered`. Only upwards: what stands on the road scatters, and a
reading below its neighbours is a crack. *Angle*: the surface is the chord to the next reading at least `chord_m`
away; where the beam meets the chords on both sides at less than `grazing_deg`, the reading is `grazing`: beams that
half met an edge, and surfaces seen too flat. The angle is that within the profile's plane.

**4. Connection** (not in the paper, whose roads had no pavement for pedestrians within reach). A kerb of 10 cm lies
within the histogram's flank, and beyond a car there may be anything. From a reading of the road on, the surface
is followed to both sides: the next reading is on it where it lies within a tolerance of the line through the last
`window_m` (and at least `window_readings`). The tolerance is `step_m`, plus `noise_factor` times what the noise of
the ranges makes of the height at this beam's angle, plus `slope` times the gap. Three readings on the line after some
that were not close an object (`scattered`) or, below the line, a hole, which is road; where the line itself went
through a hole, readings as high above the datum as before it count as on the line. Where the line is not found again
within `bridge_m`, the carriageway ends: `off_carriageway`. It is the connected surface with most readings.

The noise of the ranges is estimated in each profile, from the median of the second differences: the same settings serve
a mirror scanner of 6 mm and a triangulation profiler of 0.3 mm. What no single profile shows is not detected: a
pavement or verge flush with the road is road, and a dropped kerb of 2 cm stays below the tolerance of a scanner with
6 mm noise that looks at it steeply.

Classes of readings: kept, or the filter that left a reading out.

The classes are those of the filters of 3.3.1 in Sairam, Nagarajan, Ornitz 2016: readings outside the scanner's
range, unrealistic heights, and what lies off the road; in addition, readings without a return or a pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Bool, Float64, Int64, UInt8, UInt16
from roadscan.compute.kernel_options import read_only
from roadscan.core.rig import Mounting, Mountings, ScanGeometry
from roadscan.core.settings.segmentation import RangeFilter, RoadSegmentation, SegmentationConfig
from roadscan.georeference.kernels.readings import (
    CLASS_KEPT,
    CLASS_NO_POSE,
    CLASS_NO_RETURN,
    CLASS_TOO_FAR,
    CLASS_TOO_HIGH,
    CLASS_TOO_LOW,
    CLASS_TOO_NEAR,
    NO_RETURN,
)
from roadscan.georeference.kernels.segmentation import (
    CLASS_ABOVE,
    CLASS_GRAZING,
    CLASS_OFF_ROAD,
    CLASS_SCATTERED,
    keep_road,
    segment_profiles,
)
from roadscan.poses.trajectory import Poses, Trajectory


def limits_of_turns(arc_m: Float64, turn_rad: Float64, settings: RangeFilter) -> Float64:
    """Return limits (n, 2) to the left and right (m), from arcs (n,), negative backwards, and heading changes (n,)."""
    limits = np.full((arc_m.size, 2), np.inf)
    turning = (np.abs(turn_rad) > 1e-9) & (arc_m != 0.0)
    critical = np.abs(arc_m) / np.sin(np.clip(np.abs(turn_rad), 1e-9, math.pi / 2))
    critical[~turning | (critical > settings.radius_max_m)] = np.inf
    left = arc_m * turn_rad < 0.0
    limits[left, 0] = critical[left]
    limits[~left, 1] = critical[~left]
    return limits


def kept_in_turns(across_m: Float64, limits_m: Float64) -> Bool:
    """Which readings (n, m) are kept, by their horizontal distance across the path (n, m), right positive (m)."""
    kept: Bool = (across_m >= -limits_m[:, :1]) & (across_m <= limits_m[:, 1:])
    return kept


TICK_NS: Final = 10_000_000  # Interval at which the trajectory is sampled.
WINDOW_NS: Final = 200 * TICK_NS
"""Limits depend on poses within this time of a profile's epoch, and half a tick."""

_WINDOW: Final = WINDOW_NS // TICK_NS
_NANO: Final = 1e-9  # Steps are summed as whole nanometres and nanoradians.


def turn_limits(
    trajectory: Trajectory, lever_arm_body_m: tuple[float, float, float], epochs_gps_ns: Int64, settings: RangeFilter
) -> Float64:
    """Return how far (n, 2) left and right of the sensor readings of profiles are kept (m); infinite outside turns.

    Parameters
    ----------
    lever_arm_body_m : of the sensor (forward, right, down).
    epochs_gps_ns : (n,) of profiles, any order.
    """
    limits = np.full((epochs_gps_ns.size, 2), np.inf)
    if epochs_gps_ns.size == 0:
        return limits
    ticks, own = np.unique((epochs_gps_ns + TICK_NS // 2) // TICK_NS, return_inverse=True)
    cuts = np.flatnonzero(np.diff(ticks) > 2 * _WINDOW) + 1
    parts = [_limits(trajectory, lever_arm_body_m, part, settings) for part in np.split(ticks, cuts)]
    return np.concatenate(parts)[own]


def _limits(
    trajectory: Trajectory, lever_arm_body_m: tuple[float, float, float], ticks: Int64, settings: RangeFilter
) -> Float64:
    """Return limits (k, 2) at ticks (k,), ascending."""
    begin = int(ticks[0]) - _WINDOW
    poses = trajectory.poses(np.arange(begin, int(ticks[-1]) + _WINDOW + 1) * TICK_NS)
    step_nm, turn_nrad = _steps(poses, lever_arm_body_m)
    path, way, heading = (_summed(steps) for steps in (np.abs(step_nm), step_nm, turn_nrad))
    at = ticks - begin
    half = round(settings.base_m / 2 / _NANO)
    piece_first, piece_last = _pieces(poses.found)
    first = np.searchsorted(path, path[at] - half, side="right") - 1
    first = np.maximum.reduce([first, at - _WINDOW, piece_first[at]])
    last = np.minimum.reduce([np.searchsorted(path, path[at] + half), at + _WINDOW, piece_last[at]])
    arc_nm, turned_nrad = way[last] - way[first], heading[last] - heading[first]
    limits = limits_of_turns(_from_nano(arc_nm), _from_nano(turned_nrad), settings)
    limits[np.abs(arc_nm) < half] = np.inf
    return limits


def _steps(poses: Poses, lever_arm_body_m: tuple[float, float, float]) -> tuple[Int64, Int64]:
    """Return steps (k − 1,) of a sensor along the body (nm) and turns to the right (nrad); 0 where a pose is missing.

    Written out by element: sums of a library may depend on how many there are.
    """
    r, p, (a, b, c) = poses.world_from_body, poses.position_world_m, lever_arm_body_m
    place = [p[:, i] + (r[:, i, 0] * a + r[:, i, 1] * b + r[:, i, 2] * c) for i in range(3)]
    step = sum((r[:-1, i, 0] * (place[i][1:] - place[i][:-1]) for i in range(3)), np.zeros(len(p) - 1))
    sine = sum((r[:-1, i, 1] * r[1:, i, 0] for i in range(3)), np.zeros(len(p) - 1))
    turn = sine * (1.0 + sine * sine / 6.0 + 0.075 * (sine * sine) ** 2)  # arcsine, to 2e-9 up to 5° in a tick
    known = poses.found[:-1] & poses.found[1:]
    return _whole(np.where(known, step, 0.0)), _whole(np.where(known, turn, 0.0))


def _whole(values: Float64) -> Int64:
    return np.rint(values / _NANO).astype(np.int64)


def _from_nano(values: Int64) -> Float64:
    return values.astype(np.float64) * _NANO


def _summed(steps: Int64) -> Int64:
    return np.concatenate([np.zeros(1, np.int64), np.cumsum(steps)])


def _pieces(found: npt.NDArray[np.bool_]) -> tuple[Int64, Int64]:
    """Return first and last tick (k,) of the unbroken piece of poses that contains each tick."""
    number = np.arange(found.size)
    breaks = ~(found[:-1] & found[1:])
    first = np.maximum.accumulate(np.where(np.concatenate([[True], breaks]), number, 0))
    last = np.minimum.accumulate(np.where(np.concatenate([breaks, [True]]), number, found.size)[::-1])[::-1]
    return first, last


def segmented(
    ranges: npt.NDArray[np.uint16],
    geometry: ScanGeometry,
    settings: SegmentationConfig,
    range_min_m: float = 0.0,
    range_max_m: float = np.inf,
) -> UInt8:
    """Return the class of every reading of profiles.

    Parameters
    ----------
    ranges : (n, m), raw, 0 no return.
    geometry : of the profiles; z points down to the road.
    range_min_m, range_max_m : limits of the sensor's ranges (m).

    Returns
    -------
    (n, m), of ``READING_CLASSES``: 0 the road; no_return, too_near, too_far; above_surface, scattered, grazing,
    off_carriageway.
    """
    rays = geometry.rays()
    origins_y, origins_z = (np.ascontiguousarray(rays[0][:, a]) for a in (1, 2))
    directions_y, directions_z = (np.ascontiguousarray(rays[1][:, a]) for a in (1, 2))
    classes = np.empty(ranges.shape, np.uint8)
    segment_profiles(
        read_only(np.ascontiguousarray(ranges)), origins_y, origins_z, directions_y, directions_z,
        (geometry.range_offset_m, geometry.range_step_m), geometry.raw_limits(range_min_m, range_max_m),
        _numbers(settings), classes,
    )  # fmt: skip
    return classes


def _numbers(s: SegmentationConfig) -> tuple[float, ...]:
    """Return the settings in the order of ``georeference.kernels.segmentation.SETTINGS``."""
    return (
        s.bin_m, s.share, s.gate_m, s.scatter_factor, float(s.scatter_readings), math.radians(s.grazing_deg),
        s.chord_m, s.step_m, s.noise_factor, s.slope, s.window_m, float(s.window_readings), s.bridge_m,
    )  # fmt: skip


KEPT: Final = CLASS_KEPT
TOO_LOW: Final = CLASS_TOO_LOW
TOO_HIGH: Final = CLASS_TOO_HIGH
OUTSIDE_PASS: Final = 7  # The reading was taken outside the passes.
OFF_CENTRE_LINE: Final = 8  # The point lies beyond the distance kept beside the centre lines.
OVERLAPPING: Final = 13
"""The reading lies beyond the crossing of successive profiles in a turn."""
NOT_ROAD: Final = (CLASS_ABOVE, CLASS_SCATTERED, CLASS_GRAZING, CLASS_OFF_ROAD, OVERLAPPING)
"""Classes of the profile segmentation and of the range filter for turns."""

READING_CLASSES: Final[dict[int, str]] = {
    CLASS_KEPT: "kept",
    CLASS_NO_RETURN: "no_return",
    CLASS_NO_POSE: "no_pose",
    CLASS_TOO_NEAR: "too_near",
    CLASS_TOO_FAR: "too_far",
    CLASS_TOO_LOW: "too_low",
    CLASS_TOO_HIGH: "too_high",
    OUTSIDE_PASS: "outside_pass",
    OFF_CENTRE_LINE: "off_centre_line",
    CLASS_ABOVE: "above_surface",
    CLASS_SCATTERED: "scattered",
    CLASS_GRAZING: "grazing",
    CLASS_OFF_ROAD: "off_carriageway",
    OVERLAPPING: "overlapping",
}
"""Name of each class of readings; the last five are those of the profile segmentation and of the range filter for
turns. Where a reading fails several tests, the first of this order counts, but that range comes before pose, and
segmentation and turns before heights."""

LAS_CLASSES: Final = np.zeros(256, dtype=np.uint8)
"""Class in LAS (ASPRS LAS 1.4 R15, table 17) of points that are kept marked, by class of the reading: 7 low noise and
18 high noise for unrealistic heights; of the classes free for users 64 too near, 65 too far, 66 off the centre line,
67 above the surface, 68 scattered, 69 grazing, 70 off the carriageway, 71 overlapping."""
# 7 low noise, 18 high noise; from 64 on free for users.
LAS_CLASSES[[CLASS_TOO_LOW, CLASS_TOO_HIGH, CLASS_TOO_NEAR, CLASS_TOO_FAR, OFF_CENTRE_LINE]] = [7, 18, 64, 65, 66]
# Free for users.
LAS_CLASSES[[CLASS_ABOVE, CLASS_SCATTERED, CLASS_GRAZING, CLASS_OFF_ROAD, OVERLAPPING]] = [67, 68, 69, 70, 71]

WITHHELD_FLAG: Final = 16
"""Bit of the column ``flags`` that tells other programs not to use a point."""


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
        """Return the profiles with 0 for each reading (n, m) that `classes` says is not road."""
        road, counts = np.array(ranges, order="C"), np.zeros(len(NOT_ROAD), np.int64)
        keep_road(classes.reshape(-1), _FIRST, road.reshape(-1), counts)
        return cls(road, classes, counts)

    def tell(self, fates: Int64) -> None:
        """Correct counts (11,) by outcome (``FATE_NAMES``): a kernel counts readings set to 0 as without return."""
        fates[NO_RETURN] -= self.counts.sum()
        fates[-len(NOT_ROAD) :] += self.counts

    def mark(self, classes: UInt8) -> None:
        """Overwrite a kernel's classes (n · m,), profile by profile, with those of the readings that were set to 0."""
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
