"""Adaptive regularised smoothing: speed beside SciPy, and patches with known cracks beside raw cells and a median."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.ndimage import median_filter
from scipy.sparse.linalg import cg, spsolve

from benchmarks.timing import Figure, thread_seconds
from roadscan.surface.settings import SurfaceSmoothing
from roadscan.surface.smoothing import Smoothing, smooth_surface, steps
from tests.surface.patches import (
    CLASSES_M,
    PROFILER_1,
    PROFILER_2,
    PROFILER_5,
    SICK,
    Patch,
    Sensor,
    across,
    cracked,
    depth_bias,
    measured,
    median_9,
    rms_m,
    width_change_cells,
)
from tests.surface.test_smoothing import PRINTED

EDGE = 1000
SEEDS = (3, 4, 5)


def figures(_: Path) -> Iterator[Figure]:
    """Speed, then quality by sensor and crack."""
    yield from speed()
    for sensor in (PROFILER_5, PROFILER_2, PROFILER_1, SICK):
        for width_m, depth_m in CLASSES_M:
            yield from quality(sensor, f"{width_m * 1e3:.0f} × {depth_m * 1e3:.0f} mm", ((width_m, depth_m),))
        yield from quality(sensor, "all cracks", CLASSES_M)
    yield from quality(SICK, "20 × 30 mm across the road", None)
    for width_m, depth_m in (*CLASSES_M[1:], (0.01, 0.03), (0.02, 0.02)):
        yield from known_line(width_m, depth_m)


def known_line(width_m: float, depth_m: float) -> Iterator[Figure]:
    """How deep cells of a SICK are where a crack is known to run, beside what is left of it after smoothing.

    A mean over known cells, impulses left out.
    """
    ways: dict[str, Callable[[int], Patch]] = {
        "along": lambda seed: cracked(SICK, 150, ((width_m, depth_m),), seed),
        "across": lambda seed: across(SICK, 150, width_m, depth_m, seed),
    }
    for name, way in ways.items():
        patches = [way(seed) for seed in SEEDS]
        seen = [np.where(p.impulse, np.nan, p.measured_m) for p in patches]
        known = float(np.mean([depth_bias(p, height) for p, height in zip(patches, seen, strict=True)]))
        smooth = [smooth_surface(p.measured_m, SurfaceSmoothing(sigma_m=SICK.sigma_m)) for p in patches]
        left = float(np.mean([depth_bias(p, height) for p, height in zip(patches, smooth, strict=True)]))
        what = f"SICK, {width_m * 1e3:.0f} × {depth_m * 1e3:.0f} mm {name} the road: depth bias of a known line"
        yield Figure(what, 100 * known, "%", 100 * left, "after smoothing")


def speed() -> Iterator[Figure]:
    config = SurfaceSmoothing()
    rng = np.random.default_rng(1)
    height = 560.0 + rng.normal(0.0, 0.0005, (EDGE, EDGE))
    height[:, 400:404] -= 0.01
    height[rng.random(height.shape) < 0.05] = np.nan
    cells = height.size
    whole = thread_seconds(lambda: smooth_surface(height, config))
    median = thread_seconds(lambda: median_filter(height, 9), 1)
    against = "scipy.ndimage.median_filter 9 × 9 alone, which knows no holes"
    yield Figure("smoothing, all of it", cells / whole / 1e6, "M cells/s of a core", cells / median / 1e6, against)
    height = height[:400, 200:600]
    cells = height.size
    of = Smoothing.of(height, config)
    own = thread_seconds(of.minimum)
    started = time.thread_time()
    hessian, aim, start = system(of)
    built = time.thread_time() - started
    solved = thread_seconds(lambda: cg(hessian, aim, x0=start, rtol=0.0, atol=_left(hessian, aim, start, config)), 1)
    against = f"scipy.sparse.linalg.cg, matrix ready (it takes {built:.0f} s more)"
    yield Figure(f"minimisation, {steps(config)} steps", cells / own / 1e6, "M cells/s", cells / solved / 1e6, against)
    small = Smoothing.of(height[:100, 150:250], config)
    hessian, aim, start = system(small)
    started = time.thread_time()
    exact = spsolve(hessian.tocsc(), aim).reshape(100, 100)
    direct = time.thread_time() - started
    own = thread_seconds(small.minimum)
    against = "scipy.sparse.linalg.spsolve, matrix ready"
    yield Figure("minimisation, 100 × 100", 1e4 / own / 1e6, "M cells/s", 1e4 / direct / 1e6, against)
    off = np.nanmax(np.abs(small.minimum() - 560.0 - exact))
    yield Figure("minimisation, greatest distance from the direct solver", float(off * 1e6), "µm")


def _left(hessian: sparse.csr_array, aim: np.ndarray, start: np.ndarray, config: SurfaceSmoothing) -> float:
    """Residual at which as much of the distance is left as after our steps."""
    return config.tolerance * float(np.linalg.norm(hessian @ start - aim))


def system(of: Smoothing) -> tuple[sparse.csr_array, np.ndarray, np.ndarray]:
    """The normal equations of the same energy (heights above 560 m), from the filters as printed; and the start."""
    rows, columns = of.chosen.shape
    number = np.arange(rows * columns).reshape(rows, columns)
    measured = ~np.isnan(of.height_m)
    values, row, column = [], [], []
    for k, printed in enumerate(PRINTED, start=1):
        for (a, b), weight in np.ndenumerate(printed):
            i, j = np.nonzero(of.chosen == k)
            y, x = i + a - 2, j + b - 2
            inside = (y >= 0) & (y < rows) & (x >= 0) & (x < columns) & (weight < 0)
            i, j, y, x = i[inside], j[inside], y[inside], x[inside]
            there = measured[y, x]
            at, to = number[i[there], j[there]], number[y[there], x[there]]
            for to_cell, share in ((to, weight), (at, -weight)):
                values.append(np.full(at.size, share))
                row.append(at)
                column.append(to_cell)
    shape = (number.size, number.size)
    filters = sparse.coo_array((np.concatenate(values), (np.concatenate(row), np.concatenate(column))), shape).tocsr()
    k = of.config.median_weight
    pull = (of.weight + k * measured + ~measured).ravel()
    aim = (of.weight * np.nan_to_num(of.height_m - 560.0) + k * np.nan_to_num(of.median_m - 560.0)).ravel()
    return sparse.diags_array(pull) + of.config.curvature_weight * (filters.T @ filters), aim, aim / pull


def quality(sensor: Sensor, cracks: str, classes: tuple[tuple[float, float], ...] | None) -> Iterator[Figure]:
    """Mean of three samplings of a patch: errors, depth and width of the cracks."""
    config = SurfaceSmoothing(sigma_m=sensor.sigma_m)
    many = classes is not None and len(classes) > 1
    cells = 300 if many else 160
    one = across(sensor, cells, 0.02, 0.03) if classes is None else cracked(sensor, cells, classes)
    patches = [measured(sensor, one.truth_m, one.crack_m, seed) for seed in SEEDS]
    found = [_figures_of(patch, config) for patch in patches]
    rms, raw, plain, median, bias, raw_bias, median_bias, width = np.mean(found, axis=0)
    what = f"{sensor.name}, {cracks}"
    text = f"raw cells ({plain * 1e3:.2f} without impulses); 9 × 9 median {median * 1e3:.3f} (bars: 3, 1.5)"
    yield Figure(f"{what}: RMS error", rms * 1e3, "mm", raw * 1e3, text)
    text = f"raw cells; 9 × 9 median {median_bias * 100:.0f} % (bar: 10)"
    yield Figure(f"{what}: depth bias", bias * 100, "%", raw_bias * 100, text)
    if not many:
        yield Figure(f"{what}: width less the true one", width, "cells", None, "bar: 2")


def _figures_of(patch: Patch, config: SurfaceSmoothing) -> tuple[float, ...]:
    smooth, median = smooth_surface(patch.measured_m, config), median_9(patch.measured_m)
    raw = patch.measured_m
    return (
        *(rms_m(patch, smooth), rms_m(patch, raw), rms_m(patch, raw, ~patch.impulse), rms_m(patch, median)),
        *(depth_bias(patch, smooth), depth_bias(patch, raw), depth_bias(patch, median)),
        width_change_cells(patch, smooth),
    )
