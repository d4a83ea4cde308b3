"""International roughness index of the wheel paths, mean and half-car index, localised roughness.

Of each section the golden car begins :data:`LEAD_M` before it (or where the profile begins), so that a section's
value depends on nothing farther away: what is left of the beginning after 100 m is below a millionth. Formulas and
sources: :mod:`roadscan.condition.iri`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import ClassVar, Final

import numpy as np
import numpy.typing as npt

from roadscan.condition.index import ConditionIndex, Quantity, Value
from roadscan.condition.iri import iri_of, mean_roughness_index, rolling_iri
from roadscan.condition.lane_data import LaneData, Profile
from roadscan.condition.quarter_car import RULES
from roadscan.condition.ride import ride
from roadscan.condition.segments import Segments

Float64 = npt.NDArray[np.float64]

LEAD_M: Final = 100.0
_NOISES: Final = 12
"""Profiles with added noise, from whose spread the standard deviation is told."""
_LEAST_M: Final = 20.0
"""Shorter sections have no roughness."""


class Iri(ConditionIndex):
    """Roughness of sections."""

    name: ClassVar[str] = "iri"
    title: ClassVar[str] = "international roughness index (golden car, 80 km/h) and its relatives"
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("iri_left_m_per_km", "m/km", "International roughness index of the left wheel path"),
        Quantity("iri_right_m_per_km", "m/km", "The same of the right wheel path"),
        Quantity("mri_m_per_km", "m/km", "Mean roughness index: the mean of both"),
        Quantity("hri_m_per_km", "m/km", "Half-car roughness index: IRI of the mean of both profiles"),
        Quantity("iri_local_max_m_per_km", "m/km", "Greatest rolling IRI over 7.62 m of either wheel path"),
    )
    drawn: ClassVar[tuple[str, ...]] = ("iri_left_m_per_km", "iri_right_m_per_km")
    lead_m: ClassVar[float] = LEAD_M

    def values(self, lane: LaneData) -> Iterator[Value]:
        """Values of sections."""
        for from_m, to_m in lane.sections_m:
            yield from self._section(lane, from_m, to_m)

    def _section(self, lane: LaneData, from_m: float, to_m: float) -> Iterator[Value]:
        before, after = (LEAD_M, 10.0) if lane.sign > 0 else (10.0, LEAD_M)
        found: dict[str, _Told] = {}
        parts: list[Profile] = []
        for side, profile in lane.profiles.items():
            part = bridged(profile.between(from_m - before, to_m + after), lane.config.largest_gap_m)
            found[side] = _judged(part, from_m, to_m, lane)
            parts.append(part)
            told = found[side]
            yield Value(f"iri_{side}_m_per_km", "section", from_m, to_m, told.iri, told.sigma, told.share, told.reason)
        left, right = found["left"], found["right"]
        share, reason = min(left.share, right.share), left.reason or right.reason
        mean = float(mean_roughness_index(np.array(left.iri), np.array(right.iri)))
        spread = 0.5 * float(np.hypot(left.sigma, right.sigma))
        yield Value("mri_m_per_km", "section", from_m, to_m, mean, spread, share, reason)
        half, spread = _half_car(parts, (from_m, to_m), lane) if np.isfinite(mean) else (np.nan, np.nan)
        yield Value("hri_m_per_km", "section", from_m, to_m, half, spread, share, reason)
        local = max(left, right, key=lambda told: told.local)
        known = np.isfinite(left.local) and np.isfinite(right.local)
        worst, spread = (local.local, local.sigma_local) if known else (np.nan, np.nan)
        yield Value("iri_local_max_m_per_km", "section", from_m, to_m, worst, spread, share, reason)


class _Told:
    """What the golden car says of a wheel path in a section."""

    def __init__(self, share: float, reason: str) -> None:
        self.iri = self.sigma = self.local = self.sigma_local = np.nan
        self.share, self.reason = share, reason


def bridged(profile: Profile, largest_gap_m: float) -> Profile:
    """The profile with its short gaps bridged by straight lines."""
    known = np.flatnonzero(~np.isnan(profile.height_m))
    if known.size < 2:
        return profile
    height = np.interp(profile.distance_m, profile.distance_m[known], profile.height_m[known])
    behind = np.searchsorted(known, np.arange(height.size), side="right")
    last, after = known[np.maximum(behind - 1, 0)], known[np.minimum(behind, known.size - 1)]
    wide = profile.distance_m[after] - profile.distance_m[last] > largest_gap_m + 1e-9
    outside = (behind == 0) | ((behind == known.size) & (np.arange(height.size) > known[-1]))
    gap = np.isnan(profile.height_m) & (wide | outside)
    return Profile(profile.station_m, profile.place_m, np.where(gap, np.nan, height), profile.sigma_m)


def _judged(part: Profile, from_m: float, to_m: float, lane: LaneData) -> _Told:
    inside = (part.station_m >= from_m - 1e-6) & (part.station_m <= to_m + 1e-6)
    spacing = lane.config.profile_spacing_m
    due = (to_m - from_m) / spacing
    measured = ~np.isnan(part.height_m[inside])
    share = min(1.0, float(measured.sum()) / max(due, 1.0))
    if to_m - from_m < _LEAST_M:
        return _Told(share, f"the section is {to_m - from_m:.1f} m long; roughness takes {_LEAST_M:g} m or more")
    limit = RULES.envelope_m
    if lane.cell_m > limit:
        return _Told(share, f"cells of {lane.cell_m:g} m are too coarse: {limit:g} m or less are needed")
    if measured.sum() < 0.5 * due:
        return _Told(share, f"{100 * share:.0f} % of the wheel path were measured")
    missing = (due - float(measured.sum())) * spacing
    if missing > lane.config.largest_gap_m + spacing:
        return _Told(share, f"gaps wider than {lane.config.largest_gap_m:g} m, {missing:.1f} m in all")
    tried = part.height_m + _noise(part, spacing, lane.cell_m)
    on = ride(part.distance_m, np.concatenate([part.height_m[None], tried]))
    ends = _ends(part.distance_m, part.station_m, from_m, to_m)
    rough = iri_of(on, ends).iri_m_per_km[:, 0]
    if np.isnan(rough[0]):
        return _Told(share, on.faults[0] or "a step that no road has")
    told = _Told(share, "")
    told.iri = float(rough[0])
    told.sigma = float(np.sqrt(np.mean((rough[1:] - rough[0]) ** 2)))
    rolling = rolling_iri(on)[:, inside]
    if not np.isnan(rolling).all(axis=1).any():
        most = np.nanmax(rolling, axis=1)
        told.local = float(most[0])
        told.sigma_local = float(np.sqrt(np.mean((most[1:] - most[0]) ** 2)))
    if "start" in on.notes(ends)[0][0]:
        told.reason = f"the profile begins in it: its first {RULES.start_m:g} m depend on how the car begins"
    elif on.notes(ends)[0][0]:
        told.reason = f"{on.notes(ends)[0][0]}"
    return told


def _half_car(parts: Sequence[Profile], between_m: tuple[float, float], lane: LaneData) -> tuple[float, float]:
    """IRI of the mean of two wheel paths, and its standard deviation; the noises of both are independent."""
    left, right = parts
    x, mean = 0.5 * (left.distance_m + right.distance_m), 0.5 * (left.height_m + right.height_m)
    spacing = lane.config.profile_spacing_m
    noise = _noise(left, spacing, lane.cell_m) + _noise(right, spacing, lane.cell_m, _NOISES)
    on = ride(x, np.concatenate([mean[None], mean + 0.5 * noise]))
    rough = iri_of(on, _ends(x, left.station_m, *between_m)).iri_m_per_km[:, 0]
    return float(rough[0]), float(np.sqrt(np.mean((rough[1:] - rough[0]) ** 2)))


def _ends(distance_m: Float64, station_m: Float64, from_m: float, to_m: float) -> Segments:
    """A section's ends along a path."""
    order = np.argsort(station_m, kind="stable")
    ends = np.sort(np.interp([from_m, to_m], station_m[order], distance_m[order]))
    return Segments(ends[:1], ends[1:])


def _noise(part: Profile, spacing_m: float, cell_m: float, first_stream: int = 0) -> Float64:
    """(k, n) errors as the noise of the readings makes them: those of neighbours are alike, for they share cells.

    They are drawn from counters of the place, so a section has the same ones in every run.
    """
    number = np.rint(part.station_m / spacing_m).astype(np.int64)
    low, high = int(number.min()) - 64, int(number.max()) + 65
    half = max(1, round(max(spacing_m, 1.5 * cell_m) / spacing_m))
    window = 1.0 - np.abs(np.arange(-half, half + 1)) / (half + 1.0)
    window /= np.sqrt(np.sum(window * window))
    sigma = np.where(np.isnan(part.sigma_m), 0.0, part.sigma_m)
    out = np.empty((_NOISES, number.size))
    for k in range(_NOISES):
        drawn = np.concatenate([_normal(first_stream + k, block) for block in range(low // 1024, high // 1024 + 1)])
        alike = np.convolve(drawn, window, mode="same")
        out[k] = sigma * alike[number - low // 1024 * 1024]
    return out


def _normal(stream: int, block: int) -> Float64:
    """1024 normal numbers of a block of places."""
    return np.random.Generator(np.random.Philox(key=[stream, block & 0xFFFFFFFF])).standard_normal(1024)
