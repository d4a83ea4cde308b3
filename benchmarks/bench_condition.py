"""Indices of one profile: samples a second of a core, beside a loop over NumPy's matrices as it is usually written."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.linalg import expm

from benchmarks.timing import Figure, thread_seconds
from roadscan.condition.quarter_car import GOLDEN_CAR, RULES, SPEED_M_PER_S
from roadscan.condition.ride import ride
from roadscan.condition.spectrum import road_spectrum
from roadscan.condition.straightedge import straightedge_mm
from roadscan.condition.texture import texture_segments
from roadscan.kernels.condition.quarter_car import roll

SAMPLES = 1_000_000
PLAIN_SAMPLES = 20_000


def figures(_: Path) -> Iterator[Figure]:
    """IRI at three spacings, then the other indices."""
    rng = np.random.default_rng(0)
    h = np.cumsum(rng.normal(0.0, 3e-4, SAMPLES))
    stations = {
        "a sample each 25 mm": 0.025 * np.arange(SAMPLES),
        "a sample each 250 mm": 0.25 * np.arange(SAMPLES),
        "10 to 40 mm, at random": np.cumsum(rng.uniform(0.01, 0.04, SAMPLES)),
    }
    plain = PLAIN_SAMPLES / thread_seconds(lambda: plain_iri(h[:PLAIN_SAMPLES], 0.25), 3) / 1e6
    for name, x in stations.items():
        yield Figure(
            f"IRI, {name}", kernel_rate(x, h[None]), "M samples/s", plain, "a loop over NumPy's 4 × 4 matrices"
        )
    x = stations["a sample each 25 mm"]
    eight = np.repeat(h[None, : SAMPLES // 8], 8, axis=0)
    yield Figure("IRI, eight profiles at once", kernel_rate(x[: SAMPLES // 8], eight), "M samples/s")
    yield rate("IRI with its checks", lambda: ride(x, h))
    yield rate("spectrum", lambda: road_spectrum(x, h))
    yield rate("straightedge of 3 m", lambda: straightedge_mm(x, h, 3.0))
    fine = 5e-5 * np.arange(SAMPLES)
    yield rate("texture, a sample each 50 µm", lambda: texture_segments(fine, 1e-3 * rng.normal(size=SAMPLES)))


def kernel_rate(x: np.ndarray, heights: np.ndarray) -> float:
    """Million samples a second of the kernel alone."""
    response, measured = np.empty(heights.shape), np.empty(heights.shape)
    seconds = thread_seconds(lambda: roll(x, heights, GOLDEN_CAR, RULES, False, response, measured), 9)
    return heights.size / seconds / 1e6


def rate(what: str, function: object) -> Figure:
    """Million samples a second of a whole function."""
    assert callable(function)
    return Figure(what, SAMPLES / thread_seconds(function, 3) / 1e6, "M samples/s")


def plain_iri(h: np.ndarray, step: float) -> float:
    """IRI (m/km) with a transition matrix and a product of it for each sample."""
    k1, k2, c, mu = 653.0, 63.3, 6.0, 0.15
    motion = np.array([[0, 1, 0, 0], [-k2, -c, k2, c], [0, 0, 0, 1], [k2 / mu, c / mu, -(k1 + k2) / mu, -c / mu]])
    transition = expm(motion * step / SPEED_M_PER_S)
    push = np.linalg.solve(motion, (transition - np.eye(4)) @ np.array([0.0, 0.0, 0.0, k1 / mu]))
    slope = np.diff(h) / step
    start = (h[round(11 / step)] - h[0]) / 11.0
    state, total = np.array([start, 0.0, start, 0.0]), 0.0
    for s in slope:
        state = transition @ state + push * s
        total += abs(state[2] - state[0])
    return 1e3 * total / slope.size
