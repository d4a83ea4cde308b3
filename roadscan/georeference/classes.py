"""Classes of readings: kept, or the filter that left a reading out.

The classes are those of the filters of 3.3.1 in Sairam, Nagarajan, Ornitz 2016: readings outside the scanner's
range, unrealistic heights, and what lies off the road; in addition, readings without a return or a pose.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from roadscan.georeference.kernels.carriageway import CLASS_OFF_ROAD, CLASS_SCATTERED
from roadscan.georeference.kernels.readings import (
    CLASS_KEPT,
    CLASS_NO_POSE,
    CLASS_NO_RETURN,
    CLASS_TOO_FAR,
    CLASS_TOO_HIGH,
    CLASS_TOO_LOW,
    CLASS_TOO_NEAR,
)
from roadscan.georeference.kernels.segmentation import CLASS_ABOVE, CLASS_GRAZING

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
