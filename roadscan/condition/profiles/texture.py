"""Prepares texture profiles for their indices, in the steps of ISO 13473-1:2019.

Dropouts are bridged, samples averaged over 0.5 mm, spikes replaced, waves shorter than 2.4 mm filtered out, and the
profile is cut into segments of 100 mm whose slope is removed. The standard's text was not at hand. The steps, their
order and their limits are those of the public package captif-slp (Waka Kotahi NZ Transport Agency), which follows it
for stationary profilers: a Butterworth low-pass of second order, run forwards and backwards. Compliance is not claimed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import Field

from roadscan.compute.array_types import Float64
from roadscan.compute.arrays import SIGMA_OF_MAD, runs_of
from roadscan.condition.profiles.profiles import heights_of, stations_of
from roadscan.core.errors import ProfileError
from roadscan.core.strict import Strict

SEGMENT_MM = 100.0
"""Length of a segment (mm)."""
HIGHEST_STEP_MM = 20.0
"""Largest step between the heights on both sides of a place: no texture is so deep (mm)."""
_LEVEL_MM = 20.0
"""Length on each side of a place over which medians are compared: longer than stones and narrow cracks (mm)."""
_LEAST_STEP_MM = 1.0
"""Least step: a lower one changes the depth of its segment by less than half of this (mm)."""
_STEP_SIGMAS = 6.0
"""A step exceeds this many standard deviations of the medians' differences due to texture."""
COARSEST = 1.01
"""Largest spacing of samples over that of the resampled profile."""


class TextureSettings(Strict):
    """How a texture profile is made ready."""

    resampled_mm: float = Field(default=0.5, ge=0.1, le=1.0)
    """Samples are averaged over so much (mm)."""
    spike_ratio: float = Field(default=6.0, gt=0.0)
    """A step of the resampled profile that is higher than so many times its length is a spike."""
    shortest_wave_mm: float = Field(default=2.4, gt=0.0)
    """Cut-off wavelength of the low-pass (mm)."""
    most_dropouts: float = Field(default=0.1, ge=0.0, le=1.0)
    """A segment with more than this share of dropouts is not valid."""
    most_spikes: float = Field(default=0.05, ge=0.0, le=1.0)
    """A segment with more than this share of spikes is not valid."""


class TextureSegment(NamedTuple):
    """A segment of a texture profile, its slope removed."""

    from_m: float
    """Its beginning (m)."""
    to_m: float
    """Its end (m)."""
    height_mm: Float64
    """(n,) heights above the best straight line (mm)."""
    dropout_share: float
    """Share of it without a reading."""
    spike_share: float
    """Share of its resampled heights that are spikes."""
    note: str
    """Why it is not valid: `dropouts`, `spikes`, `jump`; empty for a valid one."""


def texture_segments(
    x_m: npt.ArrayLike,
    height_m: npt.ArrayLike,
    settings: TextureSettings | None = None,
    *,
    from_m: float | None = None,
    to_m: float | None = None,
) -> list[TextureSegment]:
    """Cut a profile into segments of 100 mm, from a station on; a rest of less than 90 mm is left out.

    Parameters
    ----------
    x_m : (n,) stations, ascending (m).
    height_m : (n,) heights, positive upwards; NaN where there is none (m).
    from_m : where the first segment begins, by default at the first sample (m). What lies before is left out.
    to_m : what lies at this station and behind is left out (m).

    Raises
    ------
    ProfileError
        where the stations do not ascend, the spacing is too coarse, no height is there, the profile is shorter than a
        segment, or its heights are no texture.
    """
    chosen = settings or TextureSettings()
    x = stations_of(x_m)
    height_mm = 1e3 * heights_of(height_m, x.size)[0]
    origin_m = float(x[0]) if from_m is None else from_m
    wanted = (x >= origin_m - 1e-9) & (x < (np.inf if to_m is None else to_m))
    if wanted.sum() < 2:
        raise ProfileError(f"{wanted.sum()} samples between {from_m} and {to_m} m", expected="a texture profile")
    # Millimetres as recorded, to the nanometre: this removes the rounding of metres.
    along_mm, height_mm = np.round(1e3 * x[wanted], 6) - np.round(1e3 * origin_m, 6), height_mm[wanted]
    _check(along_mm, height_mm, chosen)
    place_mm, resampled_mm, read = _resample(along_mm, _bridged(along_mm, height_mm), chosen.resampled_mm)
    spike = _spikes(resampled_mm, chosen)
    resampled_mm = _bridged(place_mm, np.where(spike, np.nan, resampled_mm))
    jump = _jumps(resampled_mm, chosen)
    smooth_mm = _low_passed(resampled_mm, chosen)
    own, samples = _segment_of(along_mm), _segment_of(place_mm)
    dropout = ~np.isfinite(height_mm)
    found = []
    for k in range(int(samples[-1]) + 1):
        there, raw = samples == k, own == k
        if there.sum() < 0.9 * SEGMENT_MM / chosen.resampled_mm:
            continue
        dropouts = max(float(dropout[raw].mean()) if raw.any() else 1.0, 1.0 - float(read[there].mean()))
        spikes = float(spike[there].mean())
        faults = {
            "dropouts": dropouts > chosen.most_dropouts,
            "spikes": spikes > chosen.most_spikes,
            "jump": bool(jump[there].any()),
        }
        line = np.polyfit(place_mm[there], smooth_mm[there], 1)
        found.append(
            TextureSegment(
                float(origin_m + 1e-3 * SEGMENT_MM * k),
                float(origin_m + 1e-3 * min(SEGMENT_MM * (k + 1), along_mm[-1])),
                smooth_mm[there] - np.polyval(line, place_mm[there]),
                dropouts,
                spikes,
                ", ".join(word for word, said in faults.items() if said),
            )
        )
    return found


def _check(along_mm: Float64, height_mm: Float64, settings: TextureSettings) -> None:
    there = np.isfinite(height_mm)
    if there.sum() < 2:
        raise ProfileError(f"{there.sum()} of {height_mm.size} samples have a height", expected="a texture profile")
    usual = float(np.median(np.diff(along_mm)))
    if usual > COARSEST * settings.resampled_mm:
        raise ProfileError(
            f"a sample each {usual:.4g} mm",
            expected=f"one each {settings.resampled_mm:g} mm or closer",
            change="texture cannot be had of this profile, or its stations are in another unit"
            + ("" if usual > COARSEST else "; with resampled_mm = 1 it can"),
        )
    if along_mm[-1] < 0.9 * SEGMENT_MM:
        raise ProfileError(f"{along_mm[-1]:.4g} mm long", expected=f"{SEGMENT_MM:g} mm or longer")
    step = np.abs(np.diff(height_mm[there]))
    if np.median(step) > HIGHEST_STEP_MM:
        raise ProfileError(
            f"heights change by {np.median(step):.3g} mm from sample to sample in the middle of all places",
            expected="texture, in metres",
            change="see to the unit: they may be millimetres given as metres",
        )


def _bridged(place_mm: Float64, height_mm: Float64) -> Float64:
    """Fill dropouts linearly; beyond the first and last reading with these."""
    there = np.isfinite(height_mm)
    if there.all():
        return height_mm
    if not there.any():
        raise ProfileError("every resampled height is a spike", expected="a texture profile")
    return np.asarray(np.interp(place_mm, place_mm[there], height_mm[there]), np.float64)


def _resample(along_mm: Float64, height_mm: Float64, step_mm: float) -> tuple[Float64, Float64, npt.NDArray[np.bool_]]:
    """Return means over (k·step, (k+1)·step], placed at its end; and whether any sample lies there, else bridged."""
    # A sample on a border is assigned by its binary value, as in captif-slp: 1e-5 mm of MPD depend on it.
    last = np.maximum(np.ceil(along_mm / step_mm), 1.0).astype(np.int64)
    count = np.bincount(last)[1:]
    total = np.bincount(last, weights=height_mm)[1:]
    place_mm: Float64 = np.asarray(step_mm * np.arange(1, count.size + 1), np.float64)
    mean = np.full(count.size, np.nan)
    mean[count > 0] = total[count > 0] / count[count > 0]
    return place_mm, _bridged(place_mm, mean), count > 0


def _spikes(height_mm: Float64, settings: TextureSettings) -> npt.NDArray[np.bool_]:
    """Return samples on both sides of a step that is too steep."""
    steep = np.abs(np.diff(height_mm)) >= settings.spike_ratio * settings.resampled_mm
    spike = np.zeros(height_mm.size, np.bool_)
    spike[1:] |= steep
    spike[:-1] |= steep
    return spike


def _jumps(height_mm: Float64, settings: TextureSettings) -> npt.NDArray[np.bool_]:
    """Return samples at which the profile steps to another level.

    The medians of the heights on both sides are compared. Their differences scatter by the texture; a step is one that
    stands out, and lies where the means on both sides differ most.
    """
    from scipy.ndimage import median_filter, uniform_filter1d

    size, samples = max(round(_LEVEL_MM / settings.resampled_mm), 1), height_mm.size
    jump = np.zeros(samples, np.bool_)
    if samples <= 2 * size:
        return jump

    def rises(smooth_mm: Float64) -> Float64:
        """Return differences between the stretch from a sample on and the stretch that ends before it."""
        middle = size // 2
        behind, before = smooth_mm[size + middle :], smooth_mm[middle:]
        return behind[: samples - 2 * size + 1] - before[: samples - 2 * size + 1]

    levels = rises(median_filter(height_mm, size, mode="nearest"))
    levels = np.abs(levels - np.median(levels))  # without the slope of the road
    limit = max(_LEAST_STEP_MM, _STEP_SIGMAS * SIGMA_OF_MAD * float(np.median(levels)))
    high = levels > min(limit, HIGHEST_STEP_MM)
    means = np.abs(rises(uniform_filter1d(height_mm, size, mode="nearest")))
    for a, b in runs_of(high).tolist():
        at = size + a + int(np.argmax(means[a:b]))
        jump[at - 1 : at + 1] = True
    return jump


def _low_passed(height_mm: Float64, settings: TextureSettings) -> Float64:
    from scipy.signal import butter, sosfiltfilt

    cut_off = 2.0 * settings.resampled_mm / settings.shortest_wave_mm
    if cut_off >= 1.0:
        return height_mm  # the low-pass would change nothing
    return np.asarray(sosfiltfilt(butter(2, cut_off, output="sos"), height_mm), np.float64)


def _segment_of(place_mm: Float64) -> npt.NDArray[np.int64]:
    """Return the number of each place's segment; a place on a border belongs to the segment before it."""
    return np.asarray(np.maximum(np.ceil(np.round(place_mm / SEGMENT_MM, 9)) - 1, 0), np.int64)


def segment_rms_mm(height_mm: Float64) -> float:
    """Return the root mean square (mm) of the heights (n,) of a segment whose slope was removed."""
    return float(np.sqrt(np.mean(np.square(height_mm))))


def rms_texture_mm(segments: Sequence[TextureSegment]) -> float:
    """Return the root of the mean of squares over all valid segments (mm); NaN where fewer than half are valid."""
    squares = [segment_rms_mm(one.height_mm) ** 2 for one in segments if not one.note]
    return float(np.sqrt(np.mean(squares))) if squares and 2 * len(squares) >= len(segments) else np.nan
