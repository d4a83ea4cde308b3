"""Classes of readings, against the same tests by NumPy on an independent placing."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
from scipy.spatial.transform import Rotation

from roadscan.core.rig import ScanGeometry
from roadscan.georeference.place import EVERYWHERE, Window
from roadscan.georeference.road_profiles import READING_CLASSES
from tests.georeference.test_place import metres, placement, returns, scene

N = 4000
LIMITS = {"height_min_m": 512.0, "height_max_m": 530.0, "above_body_min_m": -7.0, "above_body_max_m": 6.0}
RANGES = {"range_min_m": 3.0, "range_max_m": 16.0}
CODES = {name: code for code, name in READING_CLASSES.items()}
FATE_OF = {"kept": 0, "no_pose": 1, "too_near": 2, "too_far": 2, "too_low": 3, "too_high": 3, "no_return": 5}
BODY_IN_SENSOR = np.linalg.solve(
    Rotation.from_euler("ZYX", [3.0, -12.0, 1.5], degrees=True).as_matrix() @ np.diag([1.0, -1, -1]), [1.7, -0.6, 2.1]
)
"""The IMU reference point, seen from the sensor of `scene`."""


def by_hand(on_map, times_s: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    """Class of each return, name by name: range, pose, heights."""
    distance = np.linalg.norm(xyz.astype(np.float64), axis=1)
    height = on_map(times_s, xyz.astype(np.float64))[:, 2]
    above = height - on_map(times_s, np.tile(BODY_IN_SENSOR, (len(xyz), 1)))[:, 2]
    cases = [
        (distance < RANGES["range_min_m"], "too_near"),
        (distance > RANGES["range_max_m"], "too_far"),
        ((times_s < 0) | (times_s >= 3.9), "no_pose"),
        ((height < LIMITS["height_min_m"]) | (above < LIMITS["above_body_min_m"]), "too_low"),
        ((height > LIMITS["height_max_m"]) | (above > LIMITS["above_body_max_m"]), "too_high"),
    ]
    return np.select([c for c, _ in cases], [CODES[n] for _, n in cases], CODES["kept"])


def test_classes_of_returns() -> None:
    path, frame, on_map = scene("utm north", 40.0, 3.0, -2.0)
    draw = np.random.default_rng(4)
    times_s = draw.uniform(-0.3, 4.2, N)
    xyz = draw.uniform(-11, 11, (N, 3)).astype(np.float32)
    batch, place = returns(times_s, xyz), placement(path, frame, **LIMITS, **RANGES)
    found = place.classes(batch, None)
    expected = by_hand(on_map, times_s, xyz)
    assert set(expected) == {CODES[n] for n in FATE_OF} - {CODES["no_return"]}
    assert np.array_equal(found, expected)
    fates = place.returns(batch, EVERYWHERE).fates
    sums = np.bincount([FATE_OF[READING_CLASSES[c]] for c in found], minlength=fates.size)
    assert np.array_equal(sums, fates)


def test_marked_returns_lie_where_they_would_without_limits() -> None:
    path, frame, _ = scene("utm north", 40.0, 3.0, -2.0)
    draw = np.random.default_rng(5)
    batch = returns(draw.uniform(-0.3, 4.2, N), draw.uniform(-11, 11, (N, 3)))
    limited, free = placement(path, frame, **LIMITS, **RANGES), placement(path, frame)
    marked, plain, every = (
        limited.returns(batch, EVERYWHERE, marked=True),
        limited.returns(batch, EVERYWHERE),
        free.returns(batch, EVERYWHERE),
    )
    assert np.array_equal(metres(marked), metres(every))
    assert np.array_equal(metres(marked)[marked.classes == 0], metres(plain))
    assert plain.classes is None
    assert np.array_equal(marked.fates, plain.fates)
    tile = Window(*plain.tiles[0].tolist(), *(plain.tiles[0] + 1).tolist())
    part = limited.returns(batch, tile, marked=True)
    own = (marked.tiles == plain.tiles[0]).all(axis=1)
    assert np.array_equal(part.classes, marked.classes[own])
    assert np.array_equal(limited.touched(batch, None, marked=True)[0], every.tiles)


def test_classes_of_profiles_with_a_turning_mirror() -> None:
    path, frame, on_map = scene("utm north", 40.0, 0.0, 0.0)
    geometry = ScanGeometry(kind="polar", readings=60, first=-1.5, step=0.05, range_step_m=0.001, reading_period_ns=1e5)
    draw = np.random.default_rng(6)
    raw = draw.integers(1000, 20_000, (50, 60)).astype(np.uint16)
    raw[draw.random(raw.shape) < 0.1] = 0
    times_s = np.linspace(-0.2, 4.1, 50)
    batch = pa.RecordBatch.from_pydict(
        {
            "epoch_gps_ns": np.round(times_s * 1e9).astype(np.int64) + 10**18,
            "range": pa.FixedSizeListArray.from_arrays(pa.array(raw.ravel()), 60),
            "intensity": pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(raw.size, np.uint8)), 60),
        }
    )
    place = placement(path, frame, **LIMITS, **RANGES)
    found = place.classes(batch, geometry)
    beam = np.tile(geometry.rays()[1], (50, 1)) * (raw.ravel() * 0.001)[:, None]
    when = np.repeat(times_s, 60) + np.tile(np.arange(60) * 1e-4, 50)
    expected = np.where(raw.ravel() == 0, CODES["no_return"], by_hand(on_map, when, beam))
    assert np.array_equal(found, expected)
    marked = place.profiles(batch, geometry, EVERYWHERE, marked=True)
    placed = np.isin(found, [CODES[n] for n in ("kept", "too_low", "too_high", "too_near", "too_far")])
    posed = (when >= 0) & (when < 3.9)
    assert np.array_equal(marked.classes, found[placed & posed])
