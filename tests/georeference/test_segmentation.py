"""Profile segmentation against profiles of a known street, cast by NumPy, and its histogram against NumPy's."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.core.rig import ScanGeometry
from roadscan.core.settings.segmentation import SegmentationConfig
from roadscan.georeference.kernels.segmentation import height_threshold
from roadscan.georeference.road_profiles import LAS_CLASSES, READING_CLASSES, segmented
from tests.georeference.road_profiles import road_only

CODES = {name: code for code, name in READING_CLASSES.items()}
SICK = ScanGeometry(kind="polar", readings=361, first=np.pi / 2, step=-np.radians(0.5), range_step_m=0.001)
HEAD = ScanGeometry(
    kind="cartesian", readings=1000, first=-1.02, step=2.04 / 999, range_offset_m=0.8, range_step_m=5e-5
)
ROAD, PAVEMENT, CAR, TREE = range(4)


def street(kerb_m: float, kerb_height_m: float) -> list[tuple[tuple[float, float], tuple[float, float], int]]:
    """Walls of a street's cross-section: from, to (y right, up; m), what it is. The road falls from a crown at −1."""
    edge, far = kerb_m, -5.0
    low, left = -0.03 * (edge + 1.0), 0.03 * (far + 1.0)
    return [
        ((far, left), (-1.0, 0.0), ROAD),
        ((-1.0, 0.0), (1.0, -0.06), ROAD),
        ((1.0, -0.06), (1.15, -0.10), ROAD),  # a pothole
        ((1.15, -0.10), (1.3, -0.068), ROAD),
        ((1.3, -0.069), (edge, low), ROAD),
        ((edge, low), (edge + 0.02, low + kerb_height_m), PAVEMENT),
        ((edge + 0.02, low + kerb_height_m), (edge + 6.0, low + kerb_height_m + 0.12), PAVEMENT),
        ((far, left), (far - 0.02, left + 0.12), PAVEMENT),
        ((far - 0.02, left + 0.12), (far - 4.0, left + 0.2), PAVEMENT),
        ((-4.2, -0.09), (-4.2, 1.4), CAR),
        ((-4.2, 1.4), (-2.4, 1.4), CAR),
        ((-2.4, 1.4), (-2.4, -0.04), CAR),
        ((edge + 1.0, low), (edge + 1.0, 6.0), TREE),
    ]


def cast(walls, geometry: ScanGeometry, above_m: float, aside_m: float, tilt_rad: float) -> tuple[np.ndarray, ...]:
    """Exact range (m) and first wall hit of each ray of a sensor that hangs over the street and leans."""
    origins, directions = geometry.rays()
    turn = np.array([[np.cos(tilt_rad), -np.sin(tilt_rad)], [np.sin(tilt_rad), np.cos(tilt_rad)]])
    start = origins[:, 1:] * [1.0, -1.0] @ turn.T + [aside_m, above_m]
    way = directions[:, 1:] * [1.0, -1.0] @ turn.T
    found, kind = np.full(len(start), np.inf), np.full(len(start), -1)
    for a, b, what in walls:
        wall = np.subtract(b, a)
        cross = way[:, 0] * wall[1] - way[:, 1] * wall[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            to = np.subtract(a, start)
            distance = (to[:, 0] * wall[1] - to[:, 1] * wall[0]) / cross
            share = (to[:, 0] * way[:, 1] - to[:, 1] * way[:, 0]) / cross
        hit = (distance > 0.0) & (share >= 0.0) & (share <= 1.0) & (distance < found)
        found[hit], kind[hit] = distance[hit], what
    return found, kind


def raw_of(range_m: np.ndarray, geometry: ScanGeometry) -> np.ndarray:
    """Raw values; 0 where there is nothing, or too far for 16 bits."""
    value = np.round((range_m - geometry.range_offset_m) / geometry.range_step_m)
    return np.where((value > 0) & (value < 65_535), np.nan_to_num(value, posinf=0), 0).astype(np.uint16)


def profiles(geometry: ScanGeometry, noise_m: float, kerb_m: float, kerb_height_m: float = 0.12, count: int = 60):
    """Profiles of a vehicle that sways, with 1 % dropouts, and what each reading hit."""
    draw = np.random.default_rng(8)
    walls = street(kerb_m, kerb_height_m)
    ranges, kinds = [], []
    above = 2.2 if geometry.kind == "polar" else 2.0
    for _ in range(count):
        exact, kind = cast(walls, geometry, above, draw.uniform(0.2, 0.5), draw.normal(0.0, 0.01))
        raw = raw_of(exact + draw.normal(0.0, noise_m, exact.size), geometry)
        raw[draw.random(raw.size) < 0.01] = 0
        ranges.append(raw)
        kinds.append(np.where(raw == 0, -1, kind))
    return np.array(ranges), np.array(kinds)


@pytest.mark.slow
@pytest.mark.parametrize(("geometry", "noise_m", "kerb_m"), [(SICK, 0.006, 2.6), (HEAD, 0.0003, 0.9)])
def test_road_is_kept_and_others_are_rejected(geometry: ScanGeometry, noise_m: float, kerb_m: float) -> None:
    ranges, kinds = profiles(geometry, noise_m, kerb_m)
    classes = segmented(ranges, geometry, SegmentationConfig())
    road, others = kinds == ROAD, kinds > ROAD
    assert others.sum() > 0.1 * road.sum()
    assert (classes[road] == 0).mean() >= 0.99
    assert (classes[others] != 0).mean() >= 0.97
    assert np.array_equal(classes == CODES["no_return"], ranges == 0)
    if geometry is SICK:
        assert (classes[kinds == CAR] == CODES["above_surface"]).mean() > 0.8
        assert (classes[kinds == PAVEMENT] != CODES["grazing"]).all()
    kept = road_only(ranges, classes)
    assert np.array_equal(kept > 0, classes == 0)
    assert np.array_equal(kept[classes == 0], ranges[classes == 0])


def test_a_dropped_kerb_is_told_where_ranges_are_good() -> None:
    ranges, kinds = profiles(HEAD, 0.0003, 0.9, kerb_height_m=0.02, count=20)
    classes = segmented(ranges, HEAD, SegmentationConfig())
    assert (classes[kinds == PAVEMENT] == CODES["off_carriageway"]).mean() > 0.95


def test_profiles_are_judged_alone() -> None:
    ranges, _ = profiles(SICK, 0.006, 2.6, count=12)
    together = segmented(ranges, SICK, SegmentationConfig())
    order = np.random.default_rng(1).permutation(len(ranges))
    alone = np.concatenate([segmented(ranges[k : k + 1], SICK, SegmentationConfig()) for k in order])
    assert np.array_equal(alone, together[order])


def test_what_stands_out_of_the_road_is_scattered_and_cracks_are_road() -> None:
    exact, _ = cast(street(9.0, 0.1), HEAD, 2.0, 3.0, 0.0)  # all road
    draw = np.random.default_rng(2)
    range_m = exact + draw.normal(0.0, 0.0003, exact.size)
    up, crack = [200, 450, 700], [300, 301, 302, 600, 601]
    range_m[up] -= 0.012
    range_m[crack] += 0.02
    classes = segmented(raw_of(range_m, HEAD)[None], HEAD, SegmentationConfig())[0]
    assert (classes[up] == CODES["scattered"]).all()
    assert (classes[crack] == 0).all()
    assert (classes == 0).mean() > 0.99


def test_beams_along_a_surface_are_grazing() -> None:
    # The road falls away at an edge 1.2 m aside, along a beam but for 4°: below the limit of 6°, above that of 1°.
    down = np.arctan2(2.2, 1.2) - np.radians(4.0)
    walls = [((-1.5, 0.0), (1.2, 0.0), ROAD), ((1.2, 0.0), (31.2, -30.0 * np.tan(down)), PAVEMENT)]
    exact, kind = cast(walls, SICK, 2.2, 0.0, 0.0)
    raw = raw_of(np.where(exact < 12.0, exact, np.inf), SICK)
    slope = (kind == PAVEMENT) & (raw > 0)
    assert slope.sum() >= 5
    grazing = [
        segmented(raw[None], SICK, SegmentationConfig(grazing_deg=limit))[0] == CODES["grazing"] for limit in (6.0, 1.0)
    ]
    assert grazing[0][slope].mean() > 0.7
    assert not grazing[1].any()
    assert not grazing[0][kind == ROAD].any()


def test_range_limits_and_empty_profiles() -> None:
    ranges, _ = profiles(SICK, 0.006, 2.6, count=4)
    ranges[2] = 0
    ranges[3, 10:] = 0
    classes = segmented(ranges, SICK, SegmentationConfig(), 1.5, 3.0)
    metres = ranges * 0.001
    assert np.array_equal(classes == CODES["too_near"], (ranges > 0) & (metres < 1.5))
    assert np.array_equal(classes == CODES["too_far"], metres > 3.0)
    assert (classes[2] == CODES["no_return"]).all()
    assert (classes[3] != 0).all()


def test_threshold_is_that_of_numpy_s_histogram() -> None:
    draw = np.random.default_rng(3)
    for _ in range(20):
        road = draw.normal(draw.uniform(-0.01, 0.01), draw.uniform(0.003, 0.03), 400)
        heights = np.concatenate([road, draw.normal(0.3, 0.01, 150), draw.uniform(-0.9, 0.9, 40)])
        width = draw.uniform(0.01, 0.05)
        bins = int(2.0 / width) | 1
        counts, edges = np.histogram(heights, bins, (-width * bins / 2, width * bins / 2))
        n = int(np.argmax(counts))
        n1 = n
        while counts[n1 + 1] >= 0.4 * counts[n]:
            n1 += 1
        n2 = n1
        while counts[n2 + 1] >= 0.4 * counts[n1]:
            n2 += 1
        found = height_threshold(heights, width, 0.4, np.empty(bins, np.int32))
        assert found == pytest.approx(edges[n2 + 1] + width, abs=1e-9)


def test_classes_of_las_are_distinct() -> None:
    own = [LAS_CLASSES[CODES[n]] for n in ("above_surface", "scattered", "grazing", "off_carriageway", "overlapping")]
    assert len({*own, 0, 1, 2, 7, 18, 64, 65, 66}) == len(own) + 8
    assert min(own) >= 64
