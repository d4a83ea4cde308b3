"""Reports a calibration as text and as rows of the table ``mountings``."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from roadscan.calibrate.estimator import Calibrated, Calibration, Figures
from roadscan.calibrate.observability import AXES
from roadscan.calibrate.rotations import logarithm
from roadscan.core.frames import quaternion_from_rotation


def mounting_rows(
    calibration: Calibration, *, run: str, valid_from_gps_ns: int, estimated_at: str, key: str
) -> list[dict[str, Any]]:
    """Return rows of the table ``mountings``, one for each sensor (``schemas/mountings.toml``).

    Parameters
    ----------
    run : run that the mountings hold for, "*" for all.
    valid_from_gps_ns : from when on.
    estimated_at : UTC, ISO 8601.
    key : of the calibration.
    """
    method = ", ".join(kind.kind for kind in calibration.kinds)
    return [
        _row(one)
        | {
            "run": run,
            "sensor": sensor,
            "valid_from_gps_ns": valid_from_gps_ns,
            "method": method,
            "estimated_at": estimated_at,
            "calibration": key,
        }
        for sensor, one in calibration.sensors.items()
    ]


def _row(one: Calibrated) -> dict[str, Any]:
    rotation, lever_arm = one.mounting.arrays()
    sigma = one.sigma
    columns = {f"lever_{a}_m": float(v) for a, v in zip(("forward", "right", "down"), lever_arm, strict=True)}
    columns |= {f"q{a}": float(v) for a, v in zip("wxyz", quaternion_from_rotation(rotation), strict=True)}
    columns |= {f"sigma_lever_{a}_m": float(v) for a, v in zip(("forward", "right", "down"), sigma[:3], strict=True)}
    columns |= {
        f"sigma_{a}_deg": float(v) for a, v in zip(("roll", "pitch", "heading"), np.degrees(sigma[3:]), strict=True)
    }
    return columns | {
        "covariance": one.covariance.ravel().tolist(),
        "not_determined": "; ".join(one.not_determined),
    }


def report(calibration: Calibration) -> str:
    """Return the calibration as a page of text: changes, undetermined directions, residuals."""
    return "\n".join([*_sensors(calibration), "", *_undetermined(calibration), "", *_kinds(calibration)]) + "\n"


def _sensors(calibration: Calibration) -> Iterator[str]:
    for sensor, one in calibration.sensors.items():
        yield f"{sensor}"
        before, after = one.before.arrays(), one.mounting.arrays()
        change = np.r_[after[1] - before[1], logarithm(after[0] @ before[0].T)]
        for axis in range(6):
            unit, scale, digits = ("mm", 1e3, 2) if axis < 3 else ("°", 180.0 / np.pi, 4)
            of_change, sigma, prior = (scale * float(v[axis]) for v in (change, one.sigma, one.prior_sigma))
            remark = "   not determined" if prior > 0 and sigma > 0.9 * prior else ""
            yield (
                f"  {AXES[axis]:18s} {of_change:+10.{digits}f} {unit:2s}  σ {sigma:8.{digits}f}"
                f"  before: {prior:.{digits}f}{remark}"
            )
        if one.range_offset_sigma_m > 0:
            yield f"  {AXES[6]:18s} {1e3 * one.range_offset_m:+10.2f} mm  σ {1e3 * one.range_offset_sigma_m:8.2f}"


def _undetermined(calibration: Calibration) -> Iterator[str]:
    undetermined = calibration.observability.undetermined
    if not undetermined:
        yield "The evidence determines all mountings."
        return
    yield "The evidence does not determine these; they keep the values of the rig file:"
    yield from (f"  {words}" for words in undetermined)


def _kinds(calibration: Calibration) -> Iterator[str]:
    for kind in calibration.kinds:
        yield (
            f"{kind.kind}: {kind.count} observations, {kind.rejected} rejected, {kind.down_weighted} down-weighted; "
            f"counted as {kind.counted_as:.0f} independent ones, their variance times {kind.variance_factor:.3g}"
        )
        yield from (f"  {_figures(f)}" for f in calibration.figures if f.kind == kind.kind)
    if not calibration.kinds:
        yield "There is no evidence."
    if not calibration.converged:
        yield "The estimate did not settle: treat its values with care."


def _figures(one: Figures) -> str:
    if one.rms_before_m is None or one.rms_after_m is None:
        before, after, unit = one.rms_before, one.rms_after, "σ"
    else:
        before, after, unit = 1e3 * one.rms_before_m, 1e3 * one.rms_after_m, "mm"
    unusable = f", {one.unusable} unusable" if one.unusable else ""
    return f"{one.sensors}: {one.count}, RMS {before:.3g} → {after:.3g} {unit}{unusable}"
