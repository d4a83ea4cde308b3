"""Wheel paths of a section for indices of roughness: with a lead, bridged gaps, and simulated noise.

A height is a mean over a window, which dampens short waves, and it contains noise, which adds roughness. The waves are
restored by van Cittert's iteration (twice), and the power of the noise alone is subtracted from that of an index
(:func:`without_noise`).

Where neighbouring heights differ as at a wall, the place of the wall between them is unknown. In the simulations it is
drawn at random: half a sample on each side of a pothole is some per cent of its share in the roughness.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Bool, Float64
from roadscan.condition.lane_data import CrossSections, LaneData, Profile
from roadscan.condition.profiles.profiles import RULES
from roadscan.condition.profiles.ride import Segments

LEAD_M: Final = 100.0
"""A quarter car starts this far before a section, or where the profile begins."""
NOISES: Final = 12
"""Number of profiles with added noise, whose spread gives a standard deviation."""
MOST_NOISE: Final = 0.75
"""Largest share of noise in the power of an index."""
_SIGMA_NOISE: Final = 0.3
"""Standard deviation (share) of the noise's power: that of heights comes from some nine cells each."""
_ROUNDS: Final = 2  # Iterations of sharpening.
_MARGIN: Final = 64
"""Places beside a profile whose noise may affect it."""
_WANDER_STREAM: Final = 1000
"""First stream of random numbers of the poses' wander; streams of noise are below."""
_HIDDEN_PER_M: Final = 0.5
"""Hidden length behind a wall per metre of its height: heads view at angles of up to 27 degrees (m/m)."""
_MOST_HIDDEN_M: Final = 0.15  # Largest hidden length.
_POOR_TIMES: Final = 10.0
"""A stretch whose σ is this many times the median is not measured: lidars reach beyond the profilers at both ends
of a drive, with σ of millimetres that would count as roughness."""
_WALL_STREAM: Final = 2000  # First stream of random numbers of walls.
_WALL_SLOPE: Final = 0.3
"""A step between neighbours above this share of the spacing is a wall: no road is so steep."""
LEAST_M: Final = 20.0
"""Shorter sections (and shorter than stated) have no roughness: lanes begin and end in them."""


@dataclass(frozen=True, eq=False)
class WheelPath:
    """A wheel path along a section and before it."""

    profile: Profile
    """With its short gaps bridged; σ of the heights at walls is not known."""
    ends: Segments
    """The section's ends along the path."""
    inside: npt.NDArray[np.bool_]
    """(n,) True for heights in the section."""
    share: float
    """Measured share of the section."""
    reason: str
    """Reason why it has no roughness; empty where it has one."""
    spacing_m: float
    cell_m: float
    window_m2: float
    """Variance of the window along the road over which a height is a mean."""
    wander_m2_per_m: float = 0.0
    """Variance of the random walk of the poses' heights per metre, common to both wheel paths."""
    walls: tuple[slice, ...] = ()
    """From the last height before each wall to the first behind it."""

    def with_noise(self, first_stream: int = 0) -> Float64:
        """Return (1 + 12, n) heights, and the same with noise and wander added; NaN where the noise is unknown."""
        height, errors = self.profile.height_m[None], noise(self.profile, self.spacing_m, self.cell_m, first_stream)
        return np.concatenate([height, height + errors + self.wander() + self.moved_walls(first_stream)])

    def moved_walls(self, first_stream: int = 0) -> Float64:
        """Return (12, n) changes of the heights (m) by drawing the place of each wall between its two heights."""
        added = np.zeros((NOISES, self.profile.height_m.size))
        if not self.walls:
            return added
        from scipy.special import ndtr

        share = ndtr(_drawn(_WALL_STREAM + first_stream, _numbers(self.profile, self.spacing_m), 0))
        for wall in self.walls:
            height = self.profile.height_m[wall]
            steps, rise = height.size - 1, height[-1] - height[0]
            for row, at in zip(added, steps * share[:, wall.start], strict=True):
                last = min(int(at), steps - 1)  # the wall stands behind this height, in steps
                beyond = at - last - 0.5
                moved = np.where(np.arange(height.size) <= last, height[0], height[-1])
                moved[last + (beyond > 0.0)] -= rise * beyond  # interpolation puts the wall in the middle
                row[wall] += moved - height
        return added

    def wander(self) -> Float64:
        """Return (12, n) random walks of the poses' heights, the same in both wheel paths and in every run."""
        drawn = _drawn(_WANDER_STREAM, _numbers(self.profile, self.spacing_m), 0)
        return np.cumsum(math.sqrt(self.wander_m2_per_m * self.spacing_m) * drawn, axis=1)

    def tried(self, first_stream: int = 0) -> Float64:
        """Return (2 + 2 · 12, n) sharpened heights: measured, with one round less, with all errors; and noise alone."""
        noisy = self.with_noise(first_stream)
        alone = noise(self.profile, self.spacing_m, self.cell_m, first_stream)
        once = self.sharpened(noisy[:1], _ROUNDS - 1)
        sharp = self.sharpened(np.concatenate([noisy, alone]))
        return np.concatenate([sharp[:1], once, sharp[1:]])

    def sharpened(self, height_m: Float64, rounds: int = _ROUNDS) -> Float64:
        """Return (k, n) heights with the short waves restored that their window took; unchanged beside gaps."""
        if not self.window_m2:
            return height_m
        import scipy.ndimage

        at, window = _window(max(math.sqrt(6.0 * self.window_m2), 1.5 * self.spacing_m), self.spacing_m)
        window /= window.sum()
        scale = self.window_m2 / float(np.sum(window * at * at))
        sharp, taken = height_m.copy(), height_m
        for _ in range(rounds):
            smooth = scipy.ndimage.correlate1d(taken, window, mode="nearest")
            taken = np.nan_to_num(scale * (taken - smooth))
            sharp += taken
        return sharp


def wheel_paths(lane: LaneData, from_m: float, to_m: float) -> dict[str, WheelPath]:
    """Return both wheel paths of a section, by side."""
    before, after = (LEAD_M, 10.0) if lane.sign > 0 else (10.0, LEAD_M)
    spacing = lane.config.profile_spacing_m
    found = {}
    for side, whole in lane.profiles.items():
        measured = _well_measured(whole.between(from_m - before, to_m + after), lane.config.largest_gap_m)
        part = bridged(measured, lane.config.largest_gap_m)
        walls = walls_of(measured.height_m, part.height_m, spacing)
        sigma = part.sigma_m.copy()
        for wall in walls:
            sigma[wall] = np.nan
        part = replace(part, sigma_m=sigma)
        inside = (part.station_m >= from_m - 1e-6) & (part.station_m <= to_m + 1e-6)
        share, reason = _judged(part, inside, (from_m, to_m), lane)
        ends = _ends(part, from_m, to_m) if not reason else Segments(np.zeros(0), np.zeros(0))
        found[side] = WheelPath(part, ends, inside, share, reason, spacing, lane.cell_m, lane.window_m2,
                                lane.wander_m2_per_m, walls)  # fmt: skip
    return found


def _well_measured(part: Profile, gap_m: float) -> Profile:
    """Remove both ends of the profile where σ is far larger than in most of it, as where a lidar alone reached.

    Short parts between such stretches are left out as well. Inside the profile all heights stay, since those on the
    walls of a pothole have a large σ too.
    """
    known = np.flatnonzero(np.isfinite(part.sigma_m))
    if known.size < 2:
        return part
    import scipy.ndimage

    sigma = np.interp(part.distance_m, part.distance_m[known], part.sigma_m[known])
    size = 2 * math.ceil(gap_m / float(np.median(np.diff(part.distance_m)))) + 1
    usual = scipy.ndimage.median_filter(sigma, size, mode="nearest")
    poor = np.pad(usual > _POOR_TIMES * float(np.median(sigma)), size, constant_values=True)
    good = np.flatnonzero(~scipy.ndimage.binary_closing(poor, np.ones(size, np.bool_))[size:-size])
    if not good.size:
        return part
    place = np.arange(part.height_m.size)
    beyond = (place < good[0]) | (place > good[-1])
    height, sigma = (np.where(beyond, np.nan, one) for one in (part.height_m, part.sigma_m))
    return replace(part, height_m=height, sigma_m=sigma)


def walls_of(measured_m: Float64, height_m: Float64, spacing_m: float) -> tuple[slice, ...]:
    """Return the runs of heights that rise or fall as steeply as a wall, each in one direction.

    A wall may hide the floor at its foot from the sensor, up to half a metre per metre of height: heights there are
    those of the ground beyond, so the wall may stand that much farther out.

    measured_m, height_m : (n,) heights with their gaps, and with these bridged; NaN where there is none (m).
    """
    known = np.flatnonzero(~np.isnan(measured_m))
    rise = np.diff(measured_m[known])
    bridged_over = ~np.isnan(np.append(height_m, np.nan)[known[:-1] + 1])
    steep = np.where(bridged_over & (np.abs(rise) > _WALL_SLOPE * spacing_m), np.sign(rise), 0.0)
    begins = np.flatnonzero((steep != 0.0) & (steep != np.append(0.0, steep[:-1])))
    ends = np.flatnonzero((steep != 0.0) & (steep != np.append(steep[1:], 0.0)))
    found = []
    for a, b in zip(known[begins].tolist(), known[ends + 1].tolist(), strict=True):
        climb = float(measured_m[b] - measured_m[a])
        hidden = int(min(_HIDDEN_PER_M * abs(climb), _MOST_HIDDEN_M) / spacing_m)
        first, last = (a, b + hidden) if climb > 0.0 else (a - hidden, b)
        beyond = measured_m[max(first, 0) : last + 1]
        clear = first >= 0 and last < measured_m.size and not np.isnan(beyond[: a - first]).any()
        clear = clear and not np.isnan(measured_m[b : last + 1]).any()
        found.append(slice(first, last + 1) if clear else slice(a, b + 1))
    return tuple(found)


def greatest_of(rows: Float64) -> Float64:
    """Return (k,) greatest known value of each row; NaN where none is known."""
    return np.array([np.nanmax(one) if np.isfinite(one).any() else np.nan for one in rows])


def spread_of(tried: Float64) -> float:
    """Return the standard deviation of a value (1 + draws,), of which the first is without noise."""
    return float(np.sqrt(np.mean((tried[1:] - tried[0]) ** 2)))


class Cleared(NamedTuple):
    """A value without the contribution of noise."""

    value: float
    """NaN where noise makes more than three quarters of its power."""
    sigma: float
    reason: str
    drawn: Float64 = np.zeros(0)
    """(12,) values with errors added, less their mean."""
    rest: float = 0.0
    """Part of `sigma` besides the spread of these."""


def without_noise(tried: Float64) -> Cleared:
    """Return an index of roughness (26,) of :meth:`WheelPath.tried`, less the power of the noise alone."""
    value, once, noisy, alone = tried[0], tried[1], tried[2 : 2 + NOISES], tried[2 + NOISES :]
    if not np.isfinite(alone).all():
        return Cleared(float(value), np.nan, "")
    power = float(np.mean(alone**2))
    if power > MOST_NOISE * value**2:
        share = 100.0 * min(power / value**2, 1.0)
        return Cleared(np.nan, np.nan, f"noise of the heights makes {share:.0f} % of it")
    clear = math.sqrt(value**2 - power)
    if not clear:
        return Cleared(0.0, 0.0, "")
    drawn = (noisy - noisy.mean()) * float(value) / clear
    rest = math.hypot(_SIGMA_NOISE * power / clear, float(value - once))
    return Cleared(clear, math.hypot(float(np.std(drawn, ddof=1)), rest), "", drawn, rest)


def bridged(profile: Profile, largest_gap_m: float) -> Profile:
    """Return the profile with short gaps bridged by straight lines."""
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


def _judged(
    part: Profile, inside: npt.NDArray[np.bool_], between_m: tuple[float, float], lane: LaneData
) -> tuple[float, str]:
    """Return the measured share of a section, and the reason why it can have no roughness."""
    length, spacing, limit = between_m[1] - between_m[0], lane.config.profile_spacing_m, RULES.envelope_m
    due, measured = length / spacing, float(np.count_nonzero(~np.isnan(part.height_m[inside])))
    share = min(1.0, measured / max(due, 1.0))
    least = min(LEAST_M, lane.config.section_m)
    if length < least - 1e-6:
        return share, f"the section is {length:.1f} m long; roughness takes {least:g} m or more"
    if lane.cell_m > limit:
        return share, f"cells of {lane.cell_m:g} m are too coarse: {limit:g} m or less are needed"
    if measured < 0.5 * due:
        return share, f"{100 * share:.0f} % of the wheel path were measured"
    missing = (due - measured) * spacing - _beyond_ends(part, inside, between_m)
    if missing > lane.config.largest_gap_m + spacing:
        return share, f"gaps wider than {lane.config.largest_gap_m:g} m, {missing:.1f} m in all"
    return share, ""


def _beyond_ends(part: Profile, inside: npt.NDArray[np.bool_], between_m: tuple[float, float]) -> float:
    """Return the length of a section (m) before the first height of the lane or behind the last one."""
    known = ~np.isnan(part.height_m)
    station = part.station_m[known & inside]
    outside = part.station_m[known & ~inside]
    before = station.min() - between_m[0] if not (outside < station.min()).any() else 0.0
    behind = between_m[1] - station.max() if not (outside > station.max()).any() else 0.0
    return float(before + behind)


def _ends(part: Profile, from_m: float, to_m: float) -> Segments:
    order = np.argsort(part.station_m, kind="stable")
    ends = np.sort(np.interp([from_m, to_m], part.station_m[order], part.distance_m[order]))
    return Segments(ends[:1], ends[1:])


def noise(part: Profile, spacing_m: float, cell_m: float, first_stream: int = 0) -> Float64:
    """Return (k, n) simulated errors from the noise of the readings; neighbours share cells and so errors.

    They are drawn from counters of the place, so a section has the same ones in every run.
    """
    _, window = _window(max(spacing_m, 1.5 * cell_m), spacing_m)
    window /= np.sqrt(np.sum(window * window))
    return np.asarray(part.known_sigma_m * _drawn(first_stream, _numbers(part, spacing_m), _MARGIN, window))


def _numbers(part: Profile, spacing_m: float) -> npt.NDArray[np.int64]:
    """Return (n,) number of each place along the road."""
    return np.rint(part.station_m / spacing_m).astype(np.int64)


def _drawn(first_stream: int, number: npt.NDArray[np.int64], margin: int, window: Float64 | None = None) -> Float64:
    """Return (12, n) normal numbers of places, each stream smoothed by a window no wider than the margin."""
    low, high = int(number.min()) - margin, int(number.max()) + margin + 1
    out = np.empty((NOISES, number.size))
    for k in range(NOISES):
        drawn = np.concatenate([_normal(first_stream + k, block) for block in range(low // 1024, high // 1024 + 1)])
        alike = drawn if window is None else np.convolve(drawn, window, mode="same")
        out[k] = alike[number - low // 1024 * 1024]
    return out


def _window(half_m: float, spacing_m: float) -> tuple[Float64, Float64]:
    """Return places of a window (m), and their weights, which fall linearly to its ends."""
    reach = max(math.ceil(half_m / spacing_m - 1e-9) - 1, 0)
    at = spacing_m * np.arange(-reach, reach + 1, dtype=np.float64)
    return at, 1.0 - np.abs(at) / half_m


def _normal(stream: int, block: int) -> Float64:
    """Return 1024 normal numbers of a block of places."""
    return np.random.Generator(np.random.Philox(key=[stream, block & 0xFFFFFFFF])).standard_normal(1024)


_NOISIER: Final = 10.0
"""Factor on the lane's σ that shows readings of another kind of sensor; within one kind σ varies two- or threefold."""
_NOISY_M: Final = 1e-3
"""Below this σ, noise adds less to a depth than a rut has: the depth under a wire is some three σ too large."""


def noisy(c: CrossSections) -> Bool:
    """Return (n,) True where σ of a cross-section's heights is over ten times that of the lane and over 1 mm.

    So it is where a drive ends, and a lidar alone saw the road from afar: noise makes depths and texture there.
    """
    sigma = _sigma_of(c.sigma_m)
    known = np.isfinite(sigma)
    usual = float(np.median(sigma[known])) if known.any() else np.inf
    return np.nan_to_num(sigma) > max(_NOISIER * usual, _NOISY_M)


def _sigma_of(sigma_m: Float64) -> Float64:
    """Return (n,) medians of rows; NaN where none is known."""
    rows = (row[~np.isnan(row)] for row in sigma_m)
    return np.array([np.median(own) if own.size else np.nan for own in rows], np.float64)


@dataclass(frozen=True, eq=False)
class WholeSections:
    """Cross-sections of which enough was measured; missing heights are bridged by straight lines."""

    rows: npt.NDArray[np.int64]
    """(k,) their indices among the lane's cross-sections."""
    height_m: Float64
    """(k, m)"""
    sigma_m: Float64
    """(k,) median standard deviation of a height; NaN where not known."""
    noisy: Bool
    """(n,) True for the lane's cross-sections that are left out for their noise (:func:`noisy`)."""

    @classmethod
    def of(cls, lane: LaneData) -> WholeSections:
        """Return the sections that are not noisy, measured by `least_share`, and known in both outer tenths."""
        c = lane.cross_sections
        known = ~np.isnan(c.height_m)
        m = c.offset_m.size
        tenth = max(m // 10, 1)
        ends = known[:, :tenth].any(axis=1) & known[:, -tenth:].any(axis=1)
        left_out = noisy(c)
        rows = np.flatnonzero((c.share >= lane.config.least_share) & ends & ~left_out)
        height = np.empty((rows.size, m))
        for k, row in enumerate(rows.tolist()):
            height[k] = np.interp(c.offset_m, c.offset_m[known[row]], c.height_m[row, known[row]])
        return cls(rows, height, _sigma_of(c.sigma_m[rows]), left_out)

    def spread(self, values: Float64, count: int) -> Float64:
        """Expand (count,) values to all cross-sections of the lane: NaN where too little was measured."""
        out = np.full(count, np.nan)
        out[self.rows] = values
        return out
