"""Profiles without what is no road, for tests."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

UInt8 = npt.NDArray[np.uint8]


def road_only(ranges: npt.NDArray[np.uint16], classes: UInt8) -> npt.NDArray[Any]:
    """Raw ranges (n, m) with 0, no return, in place of readings that did not hit the road."""
    return np.where(classes == 0, ranges, np.uint16(0))
