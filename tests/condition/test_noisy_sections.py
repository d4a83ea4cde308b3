"""Cross-sections whose heights are noise, as where a drive ends and a lidar alone saw the road."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from roadscan.condition.index import Value
from roadscan.condition.indices.ruts import RutWire
from roadscan.condition.lane_data import CrossSections
from roadscan.condition.wheel_paths import noisy

STATIONS = np.arange(0.0, 100.0, 0.5)
OFFSETS = np.arange(-1.65, 1.7, 0.05)
RUT_MM = 12.0


def lane(sigma_mm: np.ndarray) -> SimpleNamespace:
    """A lane of 3.4 m with a rut of 12 mm in its right half, whose cross-sections scatter by their σ (mm)."""
    rut = -1e-3 * RUT_MM * np.clip(1.0 - ((OFFSETS - 0.85) / 0.4) ** 2, 0.0, None)
    noise = 1e-3 * sigma_mm[:, None] * np.random.default_rng(4).standard_normal((STATIONS.size, OFFSETS.size))
    sigma_m = np.broadcast_to(1e-3 * sigma_mm[:, None], noise.shape)
    c = CrossSections(STATIONS, OFFSETS, rut + noise, sigma_m, np.zeros(STATIONS.size))
    config = SimpleNamespace(least_share=0.5, cross_section_step_m=0.05, cross_section_spacing_m=0.5)
    return SimpleNamespace(cross_sections=c, config=config, width_m=3.4, sections_m=((0.0, 100.0),))


def mean_right(sigma_mm: np.ndarray) -> Value:
    values = RutWire().values(lane(sigma_mm))  # type: ignore[arg-type]
    return next(one for one in values if one.quantity == "rut_depth_mean_right_mm")


def test_a_rut_of_noise_does_not_count() -> None:
    """The profiler's readings scatter by 0.03 mm, those of the lidar beyond its way by 2.5 mm."""
    found = mean_right(np.where(STATIONS < 7.0, 2.5, 0.03))
    assert abs(found.value - RUT_MM) < 0.1 and found.sigma < 0.1
    assert found.reason.startswith("14 cross-sections are left out") and found.share == 0.93


def test_a_lane_of_one_kind_of_sensor_is_whole() -> None:
    """Whether it is a profiler's or a lidar's: σ varies along it by three."""
    wave = 1.0 + 0.8 * np.sin(STATIONS)
    for sigma_mm in (0.03 * wave, 2.5 * wave, np.full(STATIONS.size, np.nan), np.where(STATIONS < 7.0, 0.6, 0.03)):
        assert not noisy(lane(sigma_mm).cross_sections).any()
        assert mean_right(np.nan_to_num(sigma_mm, nan=0.03)).reason == ""
