"""Finds samples of a profile that are not road, and the step to which its heights are rounded."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from roadscan.compute.array_types import Bool, Float64
from roadscan.compute.arrays import scatter_about
from roadscan.core.witness import Finding, Witness

PROFILE_SAMPLES: Final = Witness(
    name="profile_samples",
    input="profile file",
    fault="The sensor was stuck, so that one height repeats itself; or single samples stand alone, as spikes do.",
    asks="the samples around: how much heights change over as many samples elsewhere, and whether both neighbours of a "
    "sample agree without it",
    does="repeated heights and spikes are left out; `iri` and `mpd` name them, and their segments have notes",
    told=("findings",),
)
PROFILE_STEPS: Final = Witness(
    name="profile_steps",
    input="profile file",
    fault="Heights are rounded so that their steps are roughness, or texture.",
    asks="the index of the same heights with as much rounding again",
    does="the index is given, with the note `coarse` and how much of it is rounding, and IRI with class 3",
    told=("findings",),
)

_LEAST_REPEATED: Final = 10
"""Least number of samples over which heights are seen to change."""
_STEPS_CHANGED: Final = 10.0
"""Elsewhere, heights change by this many steps over a third as many samples, in the median."""
_TIMES: Final = 3
"""Ratio of these numbers: the top of a wave is flat for some samples, not for three times those of its flanks."""
_LEAST_OTHERS: Final = 100
"""Least number of other samples that show how heights change; a drawn check profile of lines has fewer."""
_CLOSE_M: Final = 0.1
"""Largest spacing at which a single sample is narrower than any pothole (m)."""
_SPIKE_M: Final = 0.015
"""Least height of a spike: joints and stones are lower; a tyre bridges what is as narrow (m)."""
_SPIKE_SLOPE: Final = 0.3
"""Least slope up and down again, from sample to sample."""
_SPIKE_SIGMAS: Final = 10.0  # Least height of a spike, in usual scatters.
_AGREE: Final = 0.5
"""Largest difference of a spike's neighbours, as a share of its height."""
_ON_STEP: Final = 0.02
"""Share of a step by which heights may deviate from one: they were converted, and written with few digits."""
_BENDS: Final = 30
"""Least number of places in which rounded heights bend by a step; a drawn check profile has few corners."""
NOTABLE: Final = 0.05
"""Share of an index from which on rounding is reported."""


class SoundHeights(NamedTuple):
    """Heights of a profile without samples that are not road."""

    height_m: Float64
    """(n,) heights; NaN where nothing was measured or a sample is left out."""
    stuck: Bool
    """(n,) True for samples that repeat a height."""
    spike: Bool
    """(n,) True for spikes."""
    step_m: float
    """Step to which the heights are rounded; 0 where they are not."""

    def rounded_again(self) -> Float64:
        """Return (2, n) heights with simulated errors of as much rounding, within half a step up and down (m).

        In the first, errors of samples are independent, as where a road changes by more than a step a sample; in the
        second, successive samples of one rounded height share an error, as where it changes by less.
        """
        shared = np.concatenate([[0], np.cumsum(np.diff(self.height_m) != 0.0)])
        drawn = self.step_m * np.random.default_rng(1).uniform(-0.5, 0.5, shared.size)
        return np.asarray(self.height_m + np.stack([drawn, drawn[shared]]), np.float64)

    def findings(self, x_m: Float64, whose: str) -> list[Finding]:
        """Return what was left out; `x_m` (n,) stations (m), `whose` names the profile."""
        found = []
        if self.stuck.any():
            at = x_m[self.stuck]
            text = (
                f"{at.size:,} samples from {at[0]:.5g} m to {at[-1]:.5g} m repeat the height before them, as those of "
            )
            found.append((text + "a sensor that is stuck do", at.size))
        if self.spike.any():
            at = x_m[self.spike]
            text = (
                f"{at.size:,} of its samples are spikes, far off both of their neighbours: the first at {at[0]:.5g} m"
            )
            found.append((text, at.size))
        return [PROFILE_SAMPLES.finds(whose, f"{text}. They are left out.", count) for text, count in found]


def sound_heights(x_m: Float64, height_m: Float64, *, spikes: bool = True) -> SoundHeights:
    """Return heights of a profile without repeated ones and without spikes.

    A height counts as repeated where a run of samples has it, and heights elsewhere change by ten steps over a third of
    that length. Where most of the others lie on straight lines, as in a drawn check profile, none does.
    A spike is one sample that rises or falls by more than 15 mm and by ten times the usual scatter, steeper than 0.3,
    between neighbours that agree; it is sought where samples lie within 0.1 m.

    Parameters
    ----------
    x_m : (n,) stations, ascending (m).
    height_m : (n,) heights; NaN where there is none (m).
    spikes : whether spikes are sought.
    """
    known = np.flatnonzero(np.isfinite(height_m))
    h, step_m = height_m[known], _step(height_m[known])
    stuck, spike = np.zeros(height_m.size, np.bool_), np.zeros(height_m.size, np.bool_)
    stuck[known] = _repeated(h, step_m)
    if spikes:
        spike[known] = _alone(x_m[known], h)
    told_m = step_m if _jumps_about(h[~stuck[known]], step_m) else 0.0
    return SoundHeights(np.where(stuck | spike, np.nan, height_m), stuck, spike, told_m)


def too_high_by(index: Float64, again: Float64) -> Float64:
    """Return the excess of an index (segments,) due to rounding, from that of heights rounded again (2, segments).

    Errors of rounding are not those of the road, so that their squares add up; of the two ways to err, the worse one.
    """
    return np.asarray(index - np.sqrt(np.maximum(2.0 * index**2 - np.max(again, axis=0) ** 2, 0.0)))


def _step(h: Float64) -> float:
    """Return the step on which all heights lie; 0 for none."""
    values = np.unique(np.round(h, 9))
    if values.size < 3:
        return 0.0
    least = float(np.diff(values).min())
    span = float(values[-1] - values[0])
    step = span / round(span / least)
    off = (values - values[0]) / step
    return step if bool((np.abs(off - np.rint(off)) < _ON_STEP).all()) else 0.0


def _jumps_about(h: Float64, step_m: float) -> bool:
    """Return whether heights jump between steps as rounded ones do; drawn lines have steps by themselves."""
    bend = np.abs(h[2:] - 2.0 * h[1:-1] + h[:-2])
    return int(np.count_nonzero(bend > 0.5 * step_m)) >= _BENDS


def _repeated(h: Float64, step_m: float) -> Bool:
    """Return samples after the first of a run of equal heights that is too long for this road."""
    out = np.zeros(h.size, np.bool_)
    changes = np.flatnonzero(np.diff(h) != 0.0)
    first, behind = np.concatenate([[0], changes + 1]), np.concatenate([changes + 1, [h.size]])
    longest = int((behind - first).max(initial=0))
    count = _LEAST_REPEATED
    if _TIMES * count > longest:
        return out
    windows = np.lib.stride_tricks.sliding_window_view(h, count)
    high, low = windows.max(axis=1), windows.min(axis=1)
    while _TIMES * count <= longest:
        ranges = high - low
        ranges = ranges[ranges > 0.0]
        if ranges.size and np.median(ranges) >= _STEPS_CHANGED * step_m:
            break
        high, low = np.maximum(high[:-count], high[count:]), np.minimum(low[:-count], low[count:])
        count *= 2
    else:
        return out
    for begin, end in zip(first.tolist(), behind.tolist(), strict=True):
        out[begin + 1 : end] = end - begin >= _TIMES * count
    return out if _is_measured(h[~out], count // 2, step_m) else np.zeros(h.size, np.bool_)


def _is_measured(h: Float64, lag: int, step_m: float) -> bool:
    """Return whether heights bend in most places, as those of a road do."""
    if h.size < max(_LEAST_OTHERS, 2 * lag + 1):
        return False
    bend = np.abs(h[2 * lag :] - 2.0 * h[lag:-lag] + h[: -2 * lag])
    return bool(np.mean(bend > max(0.5 * step_m, 1e-9)) > 0.5)


def _alone(x_m: Float64, h: Float64) -> Bool:
    """Return samples that are spikes: higher or lower than both neighbours."""
    if h.size < _LEAST_OTHERS:
        return np.zeros(h.size, np.bool_)
    wide = np.maximum(np.diff(x_m)[:-1], np.diff(x_m)[1:])
    wide = np.concatenate([wide[:1], wide, wide[-1:]])
    off = np.abs(h[1:-1] - 0.5 * (h[:-2] + h[2:]))
    usual = scatter_about(off, 0.0)
    # The first and last sample have neighbours on one side only: the two beside them.
    off = np.concatenate([[abs(h[0] - h[1])], off, [abs(h[-1] - h[-2])]])
    apart = np.concatenate([[abs(h[1] - h[2])], np.abs(h[2:] - h[:-2]), [abs(h[-2] - h[-3])]])
    high = off > np.maximum(max(_SPIKE_M, _SPIKE_SIGMAS * usual), _SPIKE_SLOPE * wide)
    return high & (wide <= _CLOSE_M + 1e-9) & (apart <= _AGREE * off)
