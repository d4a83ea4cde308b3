"""The smoother: its speed, a real drive and simulated walks under masked GNSS, 50 simulated drives and their σ."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from benchmarks.timing import Figure
from roadscan.core.rig import ImuGrade
from roadscan.core.settings.navigation import SmootherConfig
from roadscan.navigation.inertial.adaptive import solve_adaptively
from roadscan.navigation.inertial.readings import Solution
from roadscan.navigation.inertial.smoother import solve
from roadscan.navigation.tasks.solve_trajectory import figures_of
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
from tests.navigation.walks import WALKER, Walked, walked

SEEDS = 50
WALKS = 12
RECORDINGS = Path(os.environ.get("ROADSCAN_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))


def figures(_: Path) -> Iterator[Figure]:
    """Speed, outages of a real drive, odometer, walks, consistency."""
    yield from speed()
    if RECORDINGS.is_dir():
        yield from real_drive()
        yield from odometer()
    yield from walks()
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
        measuring = made.imu.epochs_gps_ns.size / _core_seconds(made, config, solve_adaptively) / 1e3
        yield Figure(f"with its noise measured before, {rate:.0f} Hz", measuring, "k epochs/s of a core")


def _core_seconds(made: Simulated, config: SmootherConfig, call: Callable[..., object] = solve) -> float:
    """Least time of a core of four calls, after one that is not counted."""
    times = []
    for _ in range(5):
        started = time.process_time()
        call(made.imu, made.gnss, made.odometer, made.vehicle, config)
        times.append(time.process_time() - started)
    return min(times[1:])


def real_drive() -> Iterator[Figure]:
    drive = recorded(RECORDINGS)
    measured = solve_adaptively(drive.imu, drive.masked, None, drive.vehicle, DRIVE_CONFIG).solution
    forward = solve(drive.imu, drive.masked, None, drive.vehicle, DRIVE_CONFIG, smooth=False)
    for name, solution, limits in (("smoother", measured, (0.25, 0.45)), ("forward filter", forward, (None, None))):
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
            for axis, columns in (("horizontal", slice(0, 2)), ("vertical", slice(2, 3))):
                ratio = _rms(error[~outside, columns]) / _rms(sigma[~outside, columns])
                yield Figure(f"{which}: {axis} error over σ in outages", ratio, "", 1.0, "bar: 0.5 to 1.5")


def _bar(limit: float | None) -> str:
    return f" (bar: {limit} m)" if limit else ""


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


def walks() -> Iterator[Figure]:
    """A rig that a person carries, through four outages of 10 s, with the settings of a vehicle."""
    for factor in (1.0, 3.0):
        for name, call in (("noise measured", _adapted), ("noise as stated", _stated)):
            found = np.array([call(walked(seed, sigma_factor=factor)) for seed in range(1, WALKS + 1)])
            which = f"{WALKS} walks, GNSS errs by {factor:g} σ, {name}"
            for column, axis in enumerate(("horizontal", "vertical")):
                error, sigma = (np.sqrt((found[:, column + k] ** 2).mean()) for k in (0, 2))
                yield Figure(f"{which}: {axis} RMS in outages", float(error), "m")
                against = f"bar: 0.5 to 1.5; single walks {_span(found[:, column] / found[:, column + 2])}"
                yield Figure(f"{which}: {axis} error over σ", float(error / sigma), "", 1.0, against)
            yield Figure(f"{which}: outliers of GNSS", float(100 * found[:, 4].mean()), "%", 5.0, "bar")


def _adapted(walk: Walked) -> tuple[float, ...]:
    return _told(walk, solve_adaptively(walk.imu, walk.masked, None, walk.vehicle, WALKER).solution)


def _stated(walk: Walked) -> tuple[float, ...]:
    return _told(walk, solve(walk.imu, walk.masked, None, walk.vehicle, WALKER))


def _told(walk: Walked, solution: Solution) -> tuple[float, ...]:
    """RMS of errors and of σ in the outages, horizontal and vertical each, and the share of outliers of GNSS."""
    horizontal, down, over, under = walk.ratios(solution)
    share = next(one.outliers for one in figures_of(solution) if one.kind == "gnss")
    return horizontal, down, horizontal / over, down / under, share


def _span(values: np.ndarray) -> str:
    return f"{values.min():.2f} to {values.max():.2f}"


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
