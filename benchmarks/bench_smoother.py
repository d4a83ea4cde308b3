"""The smoother: its speed, a real drive under masked GNSS, and 50 simulated drives against their covariances."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from benchmarks.timing import Figure
from roadscan.model.imu import ImuGrade
from roadscan.model.smoothing import SmootherConfig
from roadscan.navigation.inertial.smoother import solve
from tests.navigation.inertial_drives import (
    DRIVE_CONFIG,
    INSTANT,
    THREE_GAPS,
    Simulated,
    highway,
    recorded,
    simulated,
    urban,
)

SEEDS = 50
RECORDINGS = Path(os.environ.get("ROADSCAN_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))


def figures(_: Path) -> Iterator[Figure]:
    """Speed, outages of a real drive, odometer, consistency."""
    yield from speed()
    if RECORDINGS.is_dir():
        yield from real_drive()
        yield from odometer()
    for grade in ("tactical", "mems"):
        yield from consistency(grade)


def speed() -> Iterator[Figure]:
    for rate in (100.0, 200.0):
        made = simulated(urban(imu={"on": True, "grade": "tactical", "rate_hz": rate}))
        config = INSTANT.model_copy(update={"poses_per_s": rate})
        epochs = made.imu.epochs_gps_ns.size / _core_seconds(made, config) / 1e3
        yield Figure(
            f"filter and smoother, {rate:.0f} Hz, GNSS 5 Hz, odometer (bar: 200)", epochs, "k epochs/s of a core"
        )


def _core_seconds(made: Simulated, config: SmootherConfig) -> float:
    """Least time of a core of four calls, after one that is not counted."""
    times = []
    for _ in range(5):
        started = time.process_time()
        solve(made.imu, made.gnss, made.odometer, made.vehicle, config)
        times.append(time.process_time() - started)
    return min(times[1:])


def real_drive() -> Iterator[Figure]:
    drive = recorded(RECORDINGS)
    for name, smooth, limits in (("smoother", True, (0.25, 0.45)), ("forward filter", False, (None, None))):
        solution = solve(drive.imu, drive.masked, None, drive.vehicle, DRIVE_CONFIG, smooth=smooth)
        for arm_name, arm in (
            ("rig's lever arm", drive.vehicle.antenna_lever_arm_body_m),
            ("estimated lever arm", solution.states["antenna_lever_arm_body_m"][0][-1]),
        ):
            error, sigma, outage = drive.errors(solution, arm)
            horizontal, outside = np.hypot(error[:, 0], error[:, 1]), outage < 0
            worst = [horizontal[outage == k].max() for k in range(11)]
            which = f"drive, {name}, {arm_name}"
            against = "published forward filter"
            yield Figure(f"{which}: outage, median", float(np.median(worst)), "m", 0.46, against + _bar(limits[0]))
            yield Figure(f"{which}: outage, worst", max(worst), "m", 0.68, against + _bar(limits[1]))
            down = np.abs(error[~outside, 2])
            yield Figure(f"{which}: outage, worst height", float(down.max()), "m", 0.32, against)
            yield Figure(f"{which}: outside, horizontal", _rms(horizontal[outside]), "m", 0.053, against)
            yield Figure(f"{which}: outside, vertical", _rms(error[outside, 2]), "m", 0.011, against)
            share = float((np.abs(error[~outside]) < 2.5 * sigma[~outside]).mean() * 100)
            yield Figure(f"{which}: within 2.5 σ in outages", share, "%", 95.0, "bar")


def _bar(limit: float | None) -> str:
    return f" (bar: {limit} m)" if limit else ""


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


def odometer() -> Iterator[Figure]:
    solution = solve(*highway(RECORDINGS), SmootherConfig())
    scale, sigma = (float(a[-1]) for a in solution.states["odometer_scale"])
    yield Figure("odometer of a real car: scale", 1.0 + scale, "", 1.009, "path of the poses, ± 0.002")
    yield Figure("odometer of a real car: its σ", sigma * 1e3, "‰")


def consistency(grade: ImuGrade) -> Iterator[Figure]:
    """Normalised squared errors, mean of the seeds: 3 is right; at each epoch 95 % of such means lie in the bounds."""
    low, high = chi2.ppf([0.025, 0.975], 3 * SEEDS) / SEEDS
    variants = {
        "GNSS and IMU": ({"land_vehicle": False}, False),
        "all sensors": ({}, True),
    }
    squares: dict[str, list[np.ndarray]] = {name: [] for name in variants}
    worst: dict[str, list[float]] = {name: [] for name in (*variants, "forward")}
    for seed in range(1, SEEDS + 1):
        made = simulated(urban(grade), seed)
        for name, (changes, with_odometer) in variants.items():
            config = INSTANT.model_copy(update={"poses_per_s": 5.0, **changes})
            solution = solve(made.imu, made.gnss, made.odometer if with_odometer else None, made.vehicle, config)
            squares[name].append(made.normalised(solution))
            worst[name].append(made.worst_m(solution, *THREE_GAPS[-1]))
        config = INSTANT.model_copy(update={"poses_per_s": 5.0})
        forward = solve(made.imu, made.gnss, None, made.vehicle, config, smooth=False)
        worst["forward"].append(made.worst_m(forward, *THREE_GAPS[-1]))
    for name in variants:
        mean = np.mean(squares[name], axis=0)
        for quantity, values in zip(("position", "velocity", "attitude"), mean, strict=True):
            inside = ((values > low) & (values < high)).mean() * 100
            against = f"bounds {low:.2f} to {high:.2f}; {inside:.0f} % of epochs within"
            yield Figure(f"{grade}, {name}: normalised error², {quantity}", float(values.mean()), "", 3.0, against)
    before, after = np.array(worst["forward"]), np.array(worst["all sensors"])
    against = f"forward without odometer; ratio of a seed {np.min(before / after):.1f} or more (bar: 5)"
    yield Figure(f"{grade}: worst error in a gap of 60 s", float(after.max()), "m", float(before.max()), against)
