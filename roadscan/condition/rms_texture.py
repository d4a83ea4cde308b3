"""RMS texture: the root mean square of a texture profile about its slope, by segments of 100 mm.

As ISO 13473-2 has the root mean square deviation of a profile (public descriptions); the profile is made ready as for
the mean profile depth (:mod:`roadscan.condition.texture`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from roadscan.condition.texture import TextureSegment

Floats = npt.NDArray[np.float64]


def segment_rms_mm(height_mm: Floats) -> float:
    """Root mean square (mm) of the heights (n,) of a segment whose slope was removed."""
    return float(np.sqrt(np.mean(np.square(height_mm))))


def rms_texture_mm(segments: Sequence[TextureSegment]) -> float:
    """Root of the mean of the squares over all valid segments (mm); NaN where fewer than half are valid."""
    squares = [segment_rms_mm(one.height_mm) ** 2 for one in segments if not one.note]
    return float(np.sqrt(np.mean(squares))) if squares and 2 * len(squares) >= len(segments) else np.nan
