"""Power spectral density of the wheel paths over a section, and its class of ISO 8608.

Formulas and sources: :mod:`roadscan.condition.profiles.spectrum`. A section of 100 m is one window, so that its density
at 0.1 cycles a metre is known to a third or so; the standard deviation is that of the fitted line.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, Final

import numpy as np

from roadscan.condition.index import ConditionIndex, Quantity, Value
from roadscan.condition.lane_data import LaneData
from roadscan.condition.of_sections.wheel_paths import WheelPath, wheel_paths
from roadscan.condition.profiles.spectrum import road_class, road_spectrum
from roadscan.core.errors import ProfileError

_CM3: Final = 1e6  # Cubic centimetres in a cubic metre.


class Spectrum(ConditionIndex):
    """Spectrum of sections."""

    name: ClassVar[str] = "spectrum"
    title: ClassVar[str] = "power spectral density at 0.1 cycles a metre, its exponent and class of ISO 8608"
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("psd_left_cm3", "cm³", "Fitted spectral density of the left wheel path at 0.1 cycles a metre"),
        Quantity("psd_right_cm3", "cm³", "The same of the right wheel path"),
        Quantity("psd_worse_cm3", "cm³", "The greater of both; its remark is its class of ISO 8608, A to H"),
        Quantity("waviness_left", "1", "Exponent of the fitted density of the left wheel path"),
        Quantity("waviness_right", "1", "The same of the right wheel path"),
    )

    def values(self, lane: LaneData) -> Iterator[Value]:
        """Return the values of sections."""
        for from_m, to_m in lane.sections_m:
            paths = wheel_paths(lane, from_m, to_m)
            told = {side: _of_path(path) for side, path in paths.items()}
            for side, (c, sigma, w, sigma_w, reason) in told.items():
                share = paths[side].share
                yield Value(f"psd_{side}_cm3", "section", from_m, to_m, c, sigma, share, reason)
                yield Value(f"waviness_{side}", "section", from_m, to_m, w, sigma_w, share, reason)
            c, sigma, _, _, reason = max(told.values(), key=lambda one: np.inf if np.isnan(one[0]) else one[0])
            share = min(path.share for path in paths.values())
            said = reason or road_class(c / _CM3)
            yield Value("psd_worse_cm3", "section", from_m, to_m, c, sigma, share, said)


def _of_path(path: WheelPath) -> tuple[float, float, float, float, str]:
    """Density (cm³), its standard deviation, exponent, its standard deviation, and the reason if there is none."""
    if path.reason:
        return np.nan, np.nan, np.nan, np.nan, path.reason
    own, profile = path.inside, path.profile
    try:
        found = road_spectrum(profile.distance_m[own], path.sharpened(profile.height_m[None])[0, own])
    except ProfileError as error:
        return np.nan, np.nan, np.nan, np.nan, error.arrived
    return _CM3 * found.roughness_m3, _CM3 * found.sigma_roughness_m3, found.waviness, found.sigma_waviness, ""
