"""Unevenness, roughness index and texture against published figures and their own definitions."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import welch

from roadscan.simulate import Scene
from roadscan.simulate.noise import STEP_M, accumulated_iri, iri_m_per_km, track_offsets_m
from roadscan.simulate.surface import CELL_M, Surface, mean_profile_depth_mm, texture_field


def test_iri_of_the_world_banks_triangle(recordings: Path):
    rows = np.genfromtxt(recordings / "iri" / "worldbank_triangle.csv", delimiter=",", names=True)
    found = accumulated_iri(np.append(0.0, rows["height_mm"] * 1e-3))
    assert found.size == 120
    assert np.abs(found - rows["iri_m_per_km"]).max() <= 1e-5  # the table has five decimals


@pytest.mark.parametrize(("station", "published"), [(0, 3.277751), (1, 3.033199)])
def test_mpd_of_recorded_asphalt(recordings: Path, station: int, published: float):
    """Segments with dropouts or spikes (steeper than 6) are left out, as the authors did; their low-pass differs."""
    lines = gzip.decompress((recordings / "texture" / f"station_{station}.dat.gz").read_bytes()).decode().splitlines()
    x, z = np.array([[float(word) for word in line.split()[1:3]] for line in lines[11:]]).T
    even = np.arange(x[0], x[-1], 0.5)
    sound = np.isfinite(z)
    height = np.interp(even, x[sound], z[sound])
    steep = np.abs(np.diff(height)) > 6.0 * 0.5
    bad = (np.interp(even, x, (~sound).astype(float)) > 0.5) | np.append(steep, False) | np.append(False, steep)
    smooth = np.interp(even, even[~bad], height[~bad])
    starts = [i for i in range(0, even.size - 200, 200) if bad[i : i + 200].mean() < 0.1]
    found = [mean_profile_depth_mm(smooth[i : i + 201], 0.5) for i in starts]
    assert len(found) > 10
    assert np.mean(found) == pytest.approx(published, rel=0.08)


def scene(**road: object) -> Scene:
    return Scene().changed(length_m=1000.0, road={"grade": 0.0, **road})


def wheel_path(surface: Surface, offset: float, step: float = 0.25) -> np.ndarray:
    station = np.arange(0.0, 1000.0, step)
    easting, northing, _ = surface.place(station, np.full(station.size, offset))
    return surface.height_m(easting, northing, texture=False)


def test_roads_have_the_stated_iri():
    for wanted in (0.9, 2.5, 6.0):
        s = scene(roughness={"iri_m_per_km": wanted})
        surface = Surface(s)
        found = [
            iri_m_per_km(wheel_path(surface, s.road.lane_offset_m(n) + w), 0.25) for n in (1, 2) for w in (-0.8, 0.8)
        ]
        assert np.mean(found) == pytest.approx(wanted, rel=0.05)
        assert np.ptp(found) > 0.01 * wanted  # wheel paths differ


def test_iso_8608_spectrum():
    s = scene(roughness={"iso_class": "C"}).changed(length_m=8000.0)
    tracks = Surface(s).arrays.tracks
    n, density = welch(tracks, 1.0 / STEP_M, nperseg=8192, axis=1)
    inside = (n > 0.03) & (n < 0.8)
    ratio = density.mean(axis=0)[inside] / (256e-6 * (n[inside] / 0.1) ** -2.0)
    assert np.median(ratio) == pytest.approx(1.0, abs=0.1)
    low, high = ratio[: ratio.size // 10].mean(), ratio[-ratio.size // 10 :].mean()
    assert 0.7 < low / high < 1.4  # the slope is −2


def test_spectrum_between_the_tracks():
    """Halfway between two tracks, where interpolation takes most away, as the description of the field says."""
    s = scene(roughness={"iso_class": "C"}).changed(length_m=6000.0)
    surface = Surface(s)
    offsets = track_offsets_m(s.road)
    station = np.arange(0.0, 6000.0, STEP_M)

    def spectrum(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        lines = [surface.points_at(station, np.full(station.size, offset))[:, 2] for offset in at[3:-3]]
        n, density = welch(np.stack(lines), 1.0 / STEP_M, nperseg=4096, axis=1)
        return n, density.mean(axis=0)

    n, on_tracks = spectrum(offsets)
    ratio = spectrum((offsets[:-1] + offsets[1:]) / 2)[1] / on_tracks
    for low, high, share in ((0.2, 0.3, 0.96), (0.4, 0.6, 0.93), (0.9, 1.1, 0.87)):
        assert ratio[(n > low) & (n < high)].mean() == pytest.approx(share, abs=0.03)


def test_neighbouring_profiles_share_long_waves():
    s = scene(roughness={"iso_class": "B"}).changed(length_m=8000.0)
    tracks = Surface(s).arrays.tracks
    spectra = np.fft.rfft(tracks[:, : 2**16], axis=1)
    n = np.fft.rfftfreq(2**16, STEP_M)
    offsets = track_offsets_m(s.road)
    first, second = np.searchsorted(offsets, [-2.7, -0.1])

    def likeness(low: float, high: float) -> float:
        band = (n > low) & (n < high)
        a, b = spectra[first, band], spectra[second, band]
        return float(np.abs(np.vdot(a, b)) / np.sqrt(np.vdot(a, a).real * np.vdot(b, b).real))

    apart = offsets[second] - offsets[first]
    for low, high in ((0.02, 0.04), (0.15, 0.25)):
        assert likeness(low, high) == pytest.approx(np.exp(-5.0 * (low + high) / 2 * apart / 3.0), abs=0.12)


@pytest.mark.parametrize(("mpd", "grain"), [(0.5, 6.0), (1.2, 8.0), (2.5, 14.0)])
def test_texture_has_the_stated_depth(mpd: float, grain: float):
    field = texture_field(mpd, grain, 3).astype(np.float64) * 1e3
    both_ways = [mean_profile_depth_mm(line, CELL_M * 1e3) for line in (*field[::31], *field.T[::31])]
    assert np.mean(both_ways) == pytest.approx(mpd, rel=0.05)
    assert abs(field.mean()) < 0.01 * mpd
    skew = np.mean((field / field.std()) ** 3)
    assert skew < -0.2  # worn stones: flat tops, deep gaps
    # Periodic: the seam is no step.
    assert np.abs(field[0] - field[-1]).mean() < 1.5 * np.abs(np.diff(field, axis=0)).mean()
