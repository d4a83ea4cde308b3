"""Clocks from shared motion over many drives: how far they err, whether σ says so, and how long a drive 1 ppm takes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.timing import Figure
from roadscan.navigation.clocks.motion import MotionFit, clock_from_motion
from roadscan.navigation.clocks.signals import driving, felt_by_encoder, felt_by_imu, turning
from tests.navigation.driven import Driven, scene_of

SEEDS = 50
SPEED_M_PER_S = 13.9
NOISE = {"attitude_deg": 0.004, "position_m": 0.006, "time_constant_s": 60.0}
CASES = (
    ("tactical", "tactical", 30.0, {}),
    ("tactical", "tactical", 70.0, {}),
    ("tactical, poses with errors", "tactical", 70.0, NOISE),
    ("tactical, poses with errors", "tactical", 290.0, NOISE),
    ("mems, poses with errors", "mems", 70.0, NOISE),
    ("mems, poses with errors", "mems", 290.0, NOISE),
    ("encoder", "", 70.0, {}),
    ("encoder, poses with errors", "", 70.0, NOISE),
    ("encoder, poses with errors", "", 290.0, NOISE),
    ("encoder, poses with errors", "", 600.0, NOISE),
)


def figures(folder: Path) -> Iterator[Figure]:
    """Errors by grade and length of the drive, against the bars (0.2 ms, 1 ppm) and against their σ (1)."""
    for name, grade, length_s, noise in CASES:
        errors = np.array([_errors(folder / "log.csv", grade, length_s, noise, seed) for seed in range(SEEDS)])
        offset_s, sigma_offset_s, drift, sigma_drift = errors.T
        what = f"{name}, {length_s:.0f} s"
        yield Figure(f"{what}: offset, RMS error", _rms(offset_s) * 1e3, "ms", 0.2, "the bar; less is better")
        yield Figure(f"{what}: drift, RMS error", _rms(drift) * 1e6, "ppm", 1.0, "the bar; less is better")
        yield Figure(f"{what}: offset, RMS error / σ", _rms(offset_s / sigma_offset_s), "", 1.0, "an honest σ")
        yield Figure(f"{what}: drift, RMS error / σ", _rms(drift / sigma_drift), "", 1.0, "an honest σ")
    yield _duration(folder)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _fit(file: Path, one: Driven, grade: str) -> MotionFit:
    trajectory = one.trajectory()
    if grade:
        motion = turning(trajectory)
        felt = felt_by_imu(one.head(file), motion.interval_s)
    else:
        motion, felt = driving(trajectory, backwards_counts_down=False), felt_by_encoder(one.encoder(file))
    return clock_from_motion(felt, motion, search_s=5.0, drift="auto", what="the sensor")


def _errors(file: Path, grade: str, length_s: float, noise: dict[str, float], seed: int) -> list[float]:
    draw = np.random.default_rng(seed)
    clock = {"offset_s": draw.uniform(-2, 2), "drift_ppm": draw.uniform(-60, 60)}
    one = Driven.of(scene_of(length_s * SPEED_M_PER_S, seed, clock, grade or "tactical", noise=noise))
    found = _fit(file, one, grade).correction
    offset, _, drift = one.errors(found, one.scene.profilers.clock)
    return [offset, found.sigma_offset_s, drift, found.sigma_drift]


def _duration(folder: Path) -> Figure:
    """Time that an estimate takes."""
    one = Driven.of(scene_of(4000.0, 1, {"offset_s": 0.5, "drift_ppm": 20.0}, noise=NOISE))
    trajectory, head = one.trajectory(), one.head(folder / "log.csv")
    started = time.perf_counter()
    motion = turning(trajectory)
    clock_from_motion(felt_by_imu(head, motion.interval_s), motion, search_s=5.0, drift="auto", what="the head")
    return Figure("estimate five minutes of 200 Hz", time.perf_counter() - started, "s", None, "")
