"""Gains of the intensity: those that were put in, and a recording with lane boundaries that others drew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyarrow as pa

from roadscan.assets.intensity import (
    GAINS_SCHEMA,
    IntensitySample,
    calibrated_scene,
    constant_intensities,
    gains_of,
    intensity_sample,
)
from roadscan.store.schema import table_schema
from tests.assets.av2_street import av2_scene, boundaries, ratio

LASERS = 8


def sample(seed: int, key: float, paint: float = 0.0) -> tuple[IntensitySample, np.ndarray]:
    """Places seen by several lasers from several ranges, with gains that are known."""
    rng = np.random.default_rng(seed)
    place = np.repeat(np.arange(600), 4)
    laser = rng.integers(0, LASERS, place.size)
    range_m = rng.uniform(4.0, 40.0, place.size)
    gain = 1.0 + 0.15 * np.arange(LASERS)
    reflectance = rng.uniform(5.0, 60.0, 600)[place] * np.where(rng.random(place.size) < paint, 4.0, 1.0)
    true = reflectance * gain[laser] * np.exp(-range_m / 40.0)
    intensity = np.rint(true * rng.normal(1.0, 0.1, place.size))
    incidence = np.degrees(np.arccos(np.clip(2.0 / range_m, 0.0, 1.0)))
    returns = np.full(place.size, 3)
    found = IntensitySample(
        (key, 0.0), ("lidar",), place, np.zeros_like(place), laser, range_m, incidence, intensity, returns, 1.0
    )
    return found, gain


def test_gains_of_lasers_and_the_fall_with_range_are_found() -> None:
    found, gain = sample(1, 0.0, paint=0.05)
    table = gains_of([found])
    rows = table.to_pandas()
    laser = rows[rows.term == "laser"].sort_values("node").gain.to_numpy()
    np.testing.assert_allclose(laser * gain / (laser * gain).mean(), 1.0, atol=0.05)
    at = {(r.term, r.node): r.gain for r in rows.itertuples()}
    fall = at["range", 10.0] / at["range", 32.0] * at["incidence", 79.0] / at["incidence", 85.0]
    assert abs(fall / np.exp((10.0 - 32.0) / 40.0) - 1.0) < 0.2


def test_what_the_range_of_its_ground_could_explain_is_no_gain_of_a_laser_alone() -> None:
    """Each laser sees the ground at its own range, between which the light falls to a fifth; one is twice as bright."""
    rng = np.random.default_rng(4)
    place, laser = np.repeat(np.arange(900), 4), np.tile(np.arange(12), 300)
    range_m = 4.0 * 1.2**laser * rng.normal(1.0, 0.02, place.size)
    true = rng.uniform(20.0, 60.0, 900)[place] * (1.0 + (laser == 7)) * (range_m / 4.0) ** -0.8
    found = IntensitySample(
        (0.0, 0.0), ("lidar",), place, np.zeros_like(place), laser, range_m,
        np.degrees(np.arccos(1.8 / range_m)), true * rng.normal(1.0, 0.1, place.size), np.full(place.size, 3), 0.01,
    )  # fmt: skip
    rows = gains_of([found]).to_pandas()
    alone = rows[rows.term == "laser alone"].sort_values("node").gain.to_numpy()
    assert abs(alone[7] / np.median(np.delete(alone, 7)) / 0.5 - 1.0) < 0.2
    assert np.delete(alone, 7).max() / np.delete(alone, 7).min() < 1.4  # 3.5 of the light that came back


def test_gains_are_the_same_for_any_order_of_the_samples_and_fit_their_table() -> None:
    samples = [sample(k, 10.0 * k)[0] for k in range(3)]
    one, other = gains_of(samples), gains_of(samples[::-1])
    assert one.equals(other)
    schema = table_schema("intensity_gains")
    assert [c.name for c in schema.columns] == GAINS_SCHEMA.names
    assert schema.faults(schema.conform(one.to_batches()[0])) == []


def test_a_sensor_with_one_intensity_for_all_returns_is_named() -> None:
    found, _ = sample(3, 0.0)
    even = replace(found, sensors=("even",), intensity=np.full(found.place.size, 17.0))
    assert constant_intensities([found, even, replace(even, key=(1.0, 0.0))]) == {"even": 17.0}
    one_other = even.intensity.copy()
    one_other[5] = 0.0
    assert constant_intensities([replace(even, intensity=one_other)]) == {"even": 17.0}
    other = replace(even, intensity=np.full(found.place.size, 18.0))
    assert constant_intensities([even, other]) == {}
    few = replace(even, **{name: getattr(even, name)[:50] for name in ("place", "sensor", "laser", "intensity")})
    assert constant_intensities([few]) == {}


def test_no_samples_no_gains() -> None:
    assert gains_of([]).num_rows == 0


def test_raw_intensity_is_kept_and_an_unknown_sensor_has_gain_one() -> None:
    scene = av2_scene()
    table = gains_of([intensity_sample(scene)])
    only = table.filter(pa.compute.equal(table["sensor"], "up_lidar"))
    after = calibrated_scene(scene, only).returns
    assert after.calibrated
    assert not scene.returns.calibrated
    down = scene.returns.sensor == 1
    np.testing.assert_array_equal(after.intensity[down], scene.returns.intensity[down])
    assert (after.intensity[~down] != scene.returns.intensity[~down]).any()


def test_paint_stands_out_of_a_recorded_road_after_calibration_and_bare_boundaries_do_not() -> None:
    scene = av2_scene()
    painted, bare = boundaries()
    after = calibrated_scene(scene, gains_of([intensity_sample(scene)]))
    assert ratio(after, painted) >= 1.6  # 1.77; 1.59 as recorded
    assert 0.9 <= ratio(after, bare, away_from=painted) <= 1.1
    flat = replace(after, returns=replace(after.returns, intensity=np.ones_like(after.returns.intensity)))
    assert ratio(flat, painted) == 1.0
