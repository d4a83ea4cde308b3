"""Unevenness of the wheel paths: spectrum and straightedge.

Power spectral density of the wheel paths over a section, and its class of ISO 8608.

Formulas and sources: :mod:`roadscan.condition.profiles.unevenness`. A section of 100 m is one window, so that its
density at 0.1 cycles a metre is known to a third or so; the standard deviation is that of the fitted line.

Greatest deviation under the middle of a rolling straightedge in the wheel paths.

Formula and sources: :mod:`roadscan.condition.profiles.unevenness`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, Final

import numpy as np

from roadscan.condition.index import ConditionIndex, Quantity, Value
from roadscan.condition.lane_data import LaneData
from roadscan.condition.profiles.unevenness import LENGTHS_M, road_class, road_spectrum, straightedge_mm
from roadscan.condition.wheel_paths import WheelPath, greatest_of, spread_of, wheel_paths
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


_BEAMS: Final = {"straightedge_3m_max_mm": LENGTHS_M["3 m"], "straightedge_16ft_max_mm": LENGTHS_M["16 ft"]}


class Straightedge(ConditionIndex):
    """Rolling straightedges of 3 m and 16 ft."""

    name: ClassVar[str] = "straightedge"
    title: ClassVar[str] = "greatest deviation under rolling straightedges of 3 m and 16 ft"
    quantities: ClassVar[tuple[Quantity, ...]] = tuple(
        Quantity(name, "mm", f"Greatest deviation, without sign, under a straightedge of {length:g} m that rolls along "
                 "either wheel path")
        for name, length in _BEAMS.items()
    )  # fmt: skip
    lead_m: ClassVar[float] = 10.0

    def values(self, lane: LaneData) -> Iterator[Value]:
        """Return the values of sections."""
        for from_m, to_m in lane.sections_m:
            paths = list(wheel_paths(lane, from_m, to_m).values())
            share, reason = min(p.share for p in paths), next((p.reason for p in paths if p.reason), "")
            for name, length in _BEAMS.items():
                value, sigma = (np.nan, np.nan) if reason else max(_greatest(path, length) for path in paths)
                said = reason or ("" if np.isfinite(value) else "no place of it is measured over the whole beam")
                yield Value(name, "section", from_m, to_m, value, sigma, share, said)


def _greatest(path: WheelPath, length_m: float) -> tuple[float, float]:
    """Return the greatest deviation in the section (mm), and its standard deviation."""
    away = [np.abs(straightedge_mm(path.profile.distance_m, height, length_m))[path.inside]
            for height in path.with_noise()]  # fmt: skip
    most = greatest_of(np.array(away))
    return float(most[0]), spread_of(most)
