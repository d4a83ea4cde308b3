"""Errors that ties of a lidar have in common: how they are numbered, and what the adjustment found of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.adjust.adjustment import CommonErrors
from roadscan.adjust.observations import COMMON, MOUNTED
from roadscan.adjust.tasks.mountings import CHANCE, DETERMINED, Mounted
from roadscan.adjust.ties.tie import LASERS
from roadscan.core.witness import Finding, Witness

LASER_RANGES: Final = Witness(
    "laser_ranges_of_ties",
    input="lidar",
    fault="The ranges of one laser are longer or shorter for good than those of the others.",
    asks="planes that several lasers of the lidar saw, in one drive and in several",
    does="its error is estimated for the adjustment, readings stay as they are; one that is off by more than the σ of "
    "`sigma_laser_m` allows is named",
    told=("findings",),
)
SEEMING_ROLL: Final = Witness(
    "seeming_roll",
    input="rig file",
    fault="The ties of one drive fit best with a lasting roll: poses, mounting or ranges of the lidar are off.",
    asks="planes that the lidar saw again within the same drive",
    does="the roll moves no pose and no reading; one beyond the σ of `sigma_seeming_roll_deg` is named",
    told=("findings",),
)


def common_errors(
    column: Mapping[str, npt.NDArray[Any]],
    run: npt.NDArray[np.int32],
    partials: Sequence[npt.NDArray[np.float64]],
    mounted: Mounted,
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float64]]:
    """Returns numbers (n, 3) of the errors that ties have in common, and derivatives by these.

    A number tells sensor and laser, or comes after all of these and tells the run.

    Parameters
    ----------
    run : (n, 2) of each end.
    partials : by the mounting (n, 2, 7), and by a range (n, 2), of each end.
    """
    laser_sigma_m, roll_sigma_rad = mounted.common_sigma
    sensors = mounted.sensors
    number = np.full((len(run), len(COMMON)), -1, np.int32)
    for k, end in enumerate(("first", "second")):
        of_sensor = np.searchsorted(sensors, column[f"{end}_sensor"].astype(str))
        laser = column[f"{end}_laser"].astype(np.float64)
        seen = np.isfinite(laser)
        number[seen, k] = LASERS * of_sensor[seen] + laser[seen].astype(np.int32)
    within = (number[:, 1] >= 0) & (run[:, 0] == run[:, 1])
    number[within, 2] = LASERS * len(sensors) + run[within, 0]
    by_mounting, by_range = partials
    by_roll = by_mounting[:, :, MOUNTED.index("roll_rad")].sum(axis=1)
    found = np.column_stack([laser_sigma_m * by_range, roll_sigma_rad * by_roll])
    return np.where(found != 0.0, number, -1), found


def lidar_error_lines(found: CommonErrors, runs: Sequence[str], mounted: Mounted) -> list[str]:
    """Returns a line on the lasers of each sensor, and one on the roll of each drive, as far as ties determine them."""
    laser_m, roll_deg = mounted.common_sigma[0], np.degrees(mounted.common_sigma[1])
    sensors, first_run = mounted.sensors, LASERS * len(mounted.sensors)
    known, lines = found.sigma < DETERMINED, list[str]()
    for k, sensor in enumerate(sensors):
        own = known & (found.number // LASERS == k)
        if own.any():
            error = 1e3 * laser_m * found.error[own]
            most = int(np.abs(error).argmax())
            lines.append(
                f"ranges of {int(own.sum())} lasers of '{sensor}' against each other: "
                f"{np.sqrt((error**2).mean()):.1f} mm RMS, "
                f"the most {error[most]:+.1f} mm (laser {int(found.number[own][most]) % LASERS})"
            )
    own = known & (found.number >= first_run)
    for number, error, sigma in zip(found.number[own], found.error[own], found.sigma[own], strict=True):
        run = runs[int(number) - first_run]
        lines.append(
            f"roll that the ties within run '{run}' seem to show, which moves no pose: {roll_deg * error:+.3f}° "
            f"(σ {roll_deg * sigma:.3f}°)"
        )
    return lines


def lidar_error_findings(found: CommonErrors, runs: Sequence[str], mounted: Mounted) -> list[Finding]:
    """Returns findings on errors that are larger than their stated σ allows.

    Were that σ right, an estimate would have the variance by which the ties lower that of the prior.
    """
    from scipy.special import ndtri

    laser_m, roll_deg = mounted.common_sigma[0], np.degrees(mounted.common_sigma[1])
    sensors, first_run = mounted.sensors, LASERS * len(mounted.sensors)
    shown, known = np.sqrt(np.maximum(1.0 - found.sigma**2, 0.0)), found.sigma < DETERMINED
    limit = -ndtri(0.5 * CHANCE / max(int(known.sum()), 1))
    off = known & (np.abs(found.error) > limit * shown)
    said = []
    for number, error, sigma in zip(found.number[off], found.error[off], found.sigma[off], strict=True):
        sensor, laser = divmod(int(number), LASERS)
        if number < first_run:
            said.append(
                LASER_RANGES.finds(
                    sensors[sensor],
                    f"ranges of laser {laser} are off by {1e3 * laser_m * error:+.1f} mm "
                    f"(σ {1e3 * laser_m * sigma:.1f} mm) against those of the others, where "
                    f"{1e3 * laser_m:.0f} mm are stated (sigma_laser_m); its returns are used as they are: look at "
                    "the sensor's calibration file",
                )
            )
        else:
            said.append(
                SEEMING_ROLL.finds(
                    f"run '{runs[int(number) - first_run]}'",
                    f"its lidar sees planes again as if all were rolled by {roll_deg * error:+.2f}° (σ "
                    f"{roll_deg * sigma:.2f}°), where {roll_deg:.2f}° are stated (sigma_seeming_roll_deg); nothing is "
                    "corrected by it: check the mounting in the rig file, the poses, and the calibration of "
                    "the lidar",
                )
            )
    return said
