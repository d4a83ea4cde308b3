"""Profile segmentation: which readings of a profile hit the road, and why the others did not.

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
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import UInt8
from roadscan.compute.kernel_options import read_only
from roadscan.core.scan_geometry import ScanGeometry
from roadscan.core.settings.segmentation import SegmentationConfig
from roadscan.georeference.kernels.segmentation import segment_profiles


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
    """Return the settings in the order of ``georeference.kernels.carriageway.SETTINGS``."""
    return (
        s.bin_m, s.share, s.gate_m, s.scatter_factor, float(s.scatter_readings), math.radians(s.grazing_deg),
        s.chord_m, s.step_m, s.noise_factor, s.slope, s.window_m, float(s.window_readings), s.bridge_m,
    )  # fmt: skip
