"""Mean profile depth against the figures of the recordings' authors, and texture of profiles known by hand."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import detrend

from roadscan.condition.profiles.ride import segments_of
from roadscan.condition.profiles.tables import mean_profile_depth, mean_profile_depths, mpd, segment_depth_mm
from roadscan.condition.profiles.texture import TextureSettings, rms_texture_mm, segment_rms_mm, texture_segments
from roadscan.core.errors import ProfileError

PLATE_MM, MARGIN_MM = 30.0, 2.0
"""The recordings' authors: what is higher is one of the steel plates at both ends; so much more is cut off."""


def recorded(file: Path) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Stations and heights (mm) of a recording, and where its plates end and begin (mm), as its authors find them."""
    with gzip.open(file, "rt") as stream:
        rows = np.loadtxt(stream, skiprows=11, usecols=(1, 2), delimiter="\t")
    x, height = rows[np.argsort(rows[:, 0], kind="stable")].T
    seen = np.maximum.accumulate(np.where(np.isfinite(height), np.arange(x.size), 0))  # the last reading before
    change = 1 + np.flatnonzero(np.diff(height[seen] > PLATE_MM))
    middle = (x.size + 1) // 2
    return x, height, x[change[change < middle][-1]] + MARGIN_MM, x[change[change >= middle][0]] - MARGIN_MM


@pytest.mark.parametrize(
    ("station", "mpd_mm", "stdev_mm", "valid"),
    [(0, 3.2777511138235296, 0.8530880184893223, 17), (1, 3.0331992396875003, 0.44966725032778604, 16)],
)
def test_the_figures_of_captif(recordings: Path, station: int, mpd_mm: float, stdev_mm: float, valid: int) -> None:
    """Two stations of the CAPTIF profilometer, with the figures of its authors' own tests."""
    x, height, first, last = recorded(recordings / "texture" / f"station_{station}.dat.gz")
    parts = texture_segments(1e-3 * x, 1e-3 * height, from_m=1e-3 * first, to_m=1e-3 * last)
    found = mean_profile_depth(parts)
    assert found.mpd_mm == pytest.approx(mpd_mm, abs=1e-5)
    assert found.stdev_mm == pytest.approx(stdev_mm, abs=1e-5)
    assert found.valid == valid
    assert rms_texture_mm(parts) == pytest.approx(
        np.sqrt(np.mean([np.mean(detrend(one.height_mm) ** 2) for one in parts if not one.note])), rel=1e-9
    )


def rough(length_m: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A texture profile of half a millimetre, waves of 8 to 40 mm."""
    x = np.arange(0.0, length_m, 1e-4)
    rng = np.random.default_rng(seed)
    waves = rng.uniform(0.008, 0.04, 20)
    h = sum(np.sin(2 * np.pi * x / wave + rng.uniform(0, 6)) for wave in waves)
    return x, 5e-4 * np.asarray(h) / np.std(h)


def test_depth_of_a_sawtooth_by_hand() -> None:
    """Two teeth a segment, of 3 and 5 mm over a floor that is 0 elsewhere."""
    height = np.zeros(200)
    height[40], height[150] = 3.0, 5.0
    assert segment_depth_mm(height) == pytest.approx(4.0 - 8.0 / 200)
    assert segment_rms_mm(np.array([3.0, -4.0])) == pytest.approx(np.sqrt(12.5))


def test_a_wave_keeps_its_depth_and_loses_its_slope() -> None:
    """Amplitude 1 mm, 20 mm long, on a grade of 5 %: depth 1 mm, RMS √½ mm, but for what the low-pass takes."""
    x = np.arange(0.0, 2.0, 1e-4)
    parts = texture_segments(x, 1e-3 * np.cos(2 * np.pi * x / 0.02) + 0.05 * x)
    found = mean_profile_depth(parts)
    assert found.valid == found.segments == 20
    gain = 1 / (1 + (np.tan(np.pi * 0.5 / 20) / np.tan(np.pi * 0.5 / 2.4)) ** 4)  # bilinear Butterworth, both ways
    assert found.mpd_mm == pytest.approx(gain, rel=0.02)
    assert rms_texture_mm(parts) == pytest.approx(gain / np.sqrt(2), rel=0.01)


def test_spikes_dropouts_and_jumps_cost_their_segments() -> None:
    x, h = rough(1.0)
    clean = mean_profile_depth(texture_segments(x, h))
    bad = h.copy()
    bad[1500:1505] += 0.02  # a spike over one resampled sample
    bad[3000:3200] = np.nan  # a fifth of the fourth segment
    bad[5500:] += 1.0
    parts = texture_segments(x, bad)
    assert [one.note for one in parts] == ["", "", "", "dropouts", "", "jump", "", "", "", ""]
    assert parts[1].spike_share > 0.0 and parts[3].dropout_share == pytest.approx(0.2, abs=0.002)
    found = mean_profile_depth(parts)
    assert (found.valid, found.segments) == (8, 10)
    assert found.mpd_mm == pytest.approx(clean.mpd_mm, rel=0.05)
    many = h.copy()
    many[::40] += 0.03
    assert {one.note for one in texture_segments(x, many)} == {"spikes"}
    assert np.isnan(mean_profile_depth(texture_segments(x, many)).mpd_mm)


def test_rows_that_are_missing_count_as_dropouts() -> None:
    x, h = rough(0.5)
    there = (x < 0.12) | (x > 0.16)
    parts = texture_segments(x[there], h[there])
    assert parts[1].dropout_share == pytest.approx(0.4, abs=0.02) and parts[1].note == "dropouts"


def test_segments_without_any_row_count_as_well() -> None:
    x = np.arange(0.0, 1.0, 0.0005)
    height = 0.001 * np.sin(2 * np.pi * x / 0.02)
    gap = (x > 0.1) & (x < 0.4)
    whole, half = mpd(x[~gap], height[~gap], segment_m=0.5).itertuples()
    assert (whole.valid_segments, whole.segments, whole.note) == (2, 5, "dropouts 3")
    assert np.isnan(whole.mpd_mm) and half.segments == 5 and half.mpd_mm > 0.5


def test_the_station_of_the_profile_does_not_matter() -> None:
    x, h = rough(1.0)
    here, far = texture_segments(x, h), texture_segments(x + 12_345.0, h + 560.0)
    assert [one.from_m + 12_345.0 for one in here] == pytest.approx([one.from_m for one in far])
    assert mean_profile_depth(far).mpd_mm == pytest.approx(mean_profile_depth(here).mpd_mm, abs=1e-3)


def test_stretches() -> None:
    x, h = rough(1.0)
    parts = texture_segments(x, h)
    found = mean_profile_depths(parts, segments_of(x[0], x[-1], 0.3))
    assert [one.segments for one in found] == [3, 3, 3, 1]
    assert found[1].mpd_mm == pytest.approx(np.mean([segment_depth_mm(one.height_mm) for one in parts[3:6]]))


def test_what_is_no_texture_is_refused() -> None:
    x, h = rough(0.5)
    with pytest.raises(ProfileError, match="a sample each 1 mm"):
        texture_segments(x[::10], h[::10])
    assert len(texture_segments(x[::10], h[::10], TextureSettings(resampled_mm=1.0))) == 5
    with pytest.raises(ProfileError, match="50 mm long"):
        texture_segments(x[:501], h[:501])
    with pytest.raises(ProfileError, match="0 of"):
        texture_segments(x, np.full(x.size, np.nan))
    with pytest.raises(ProfileError, match="millimetres"):
        texture_segments(x, 1e3 * np.random.default_rng(1).normal(0, 1, x.size))
    with pytest.raises(ProfileError, match="0 samples between"):
        texture_segments(x, h, from_m=3.0)
