"""Mountings of the sensors in an adjustment: what is known of them before it, and what it adds to them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.adjust.adjustment import MountingErrors
from roadscan.adjust.process import MountingPrior
from roadscan.jobs.adjust.near import Sources
from roadscan.jobs.plan.plan import SurveyPlan
from roadscan.jobs.readings import MOUNTING_COLUMNS
from roadscan.model.rig import Mountings
from roadscan.model.settings.adjust import AdjustConfig
from roadscan.model.witness import Finding, Witness
from roadscan.navigation.mounting_change import MountingChange
from roadscan.tables.held import held_path, read_held, write_held
from roadscan.tables.store import Store

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

TABLE: Final = "mounting_corrections"
_NAMES: Final = (
    "lever arm forward", "lever arm to the right", "lever arm down",
    "boresight roll", "boresight pitch", "boresight heading",
)  # fmt: skip
DOUBTED: Final = 3.0
"""A mounting that is off by more than so many σ of what was stated is named."""
_CALIBRATED_SIGMAS: Final = (
    "sigma_lever_forward_m", "sigma_lever_right_m", "sigma_lever_down_m",
    "sigma_roll_deg", "sigma_pitch_deg", "sigma_heading_deg",
)  # fmt: skip

MOUNTING: Final = Witness(
    "mounting",
    input="rig file",
    fault="The mounting of a sensor is not what the rig file or the calibration states.",
    asks="passes side by side, heads of one pass and ground control, all in one adjustment",
    does="the mounting is estimated with its stated σ as prior, and readings are placed with it; one that is off by "
    "more than three σ of what was stated is named",
    told=("findings",),
)


@dataclass(frozen=True)
class Mounted:
    """Mountings of the sensors that the adjustment may ask about."""

    priors: tuple[MountingPrior, ...]
    """By name; none where mountings are not estimated."""
    stated: Mapping[tuple[str, str], Mountings]
    """By run and sensor."""

    def number(self, sensor: str) -> int:
        """Place of a sensor in `priors`, −1: not estimated."""
        names = [one.sensor for one in self.priors]
        return names.index(sensor) if sensor in names else -1

    def lever_m(self, run: str, sensor: str, epochs_gps_ns: Int64) -> Float64:
        """Stated lever arms (n, 3) at epochs."""
        own = self.stated[run, sensor]
        levers = np.array([one.lever_arm_body_m for one in own.mountings])
        return levers[np.searchsorted(np.array(own.since_gps_ns[1:], np.int64), epochs_gps_ns, side="right")]


def mounted_of(plan: SurveyPlan, sources: Sources, *, foreign: bool) -> Mounted:
    """Mountings of the sources that are adjusted.

    foreign : another program corrected the poses of a run, with the mountings as they are stated.
    """
    config = plan.survey.config.adjust
    stated = {(source.run, source.sensor): source.mountings for source, _ in sources}
    if foreign or config.mode != "joint":
        return Mounted((), stated)
    calibrated = calibrated_sigma(plan.store)
    priors = []
    # A run that is held is right as it is, and so are the mountings that place its readings.
    held = {sensor for run, sensor in stated if run in config.fixed}
    for sensor in sorted({sensor for _, sensor in stated} - held):
        sigma = _sigma(plan, config, sensor, calibrated.get(sensor))
        if (sigma > 0.0).any():
            priors.append(MountingPrior(sensor, sigma))
    return Mounted(tuple(priors), stated)


def _sigma(plan: SurveyPlan, config: AdjustConfig, sensor: str, calibrated: Float64 | None) -> Float64:
    """1 σ (6,) of a mounting: of its calibration, else of the rig file, else of the settings; 0 where these are 0."""
    own = config.mountings
    assumed = np.array(
        [
            own.sigma_forward_m, own.sigma_right_m, own.sigma_down_m,
            *np.radians([own.sigma_roll_deg, own.sigma_pitch_deg, own.sigma_heading_deg]),
        ]
    )  # fmt: skip
    known = plan.survey.rig.sensors.get(sensor)
    levers = None if known is None else known.lever_arm_sigma_m
    angles = None if known is None else known.boresight_sigma_deg
    stated = np.full(6, np.nan)
    if levers is not None:
        stated[:3] = levers
    if angles is not None:
        stated[3:] = np.radians(angles)
    if calibrated is not None:
        stated = np.where(np.isfinite(calibrated), calibrated, stated)
    return np.where(assumed > 0.0, np.where(np.isfinite(stated), stated, assumed), 0.0)


def calibrated_sigma(store: Store) -> dict[str, Float64]:
    """1 σ (6,) of calibrated mountings by sensor, the largest of all runs and times; NaN where not stated."""
    table = read_held(store, "mountings")
    found: dict[str, Float64] = {}
    for row in [] if table is None else table.to_pylist():
        values = [np.nan if row.get(name) is None else float(row[name]) for name in _CALIBRATED_SIGMAS]
        sigma = np.array([*values[:3], *np.radians(values[3:])])
        found[row["sensor"]] = np.fmax(found.get(row["sensor"], np.full(6, np.nan)), sigma)
    return found


def held_values(mounted: Mounted, changes: Mapping[str, MountingChange]) -> Float64:
    """(s, 6) what is added now to the mountings of the sensors that `mounted` counts."""
    own = [changes[one.sensor].values if one.sensor in changes else np.zeros(6) for one in mounted.priors]
    return np.array(own).reshape(-1, 6)


def publish_mountings(store: Store, found: MountingErrors | None, config: AdjustConfig) -> dict[str, MountingChange]:
    """Bring the table up to date; what moves a point by no more than `adjust.moved_m` stays as it was, to the bit."""
    table = read_held(store, TABLE)
    before = {row["sensor"]: row for row in ([] if table is None else table.to_pylist())}
    after: dict[str, dict[str, Any]] = {}
    if found is not None:
        for k, sensor in enumerate(found.sensors):
            if found.error[k].any():
                known = before.get(sensor)
                after[sensor] = known if known and _stays(known, found.error[k], config) else _row(found, k)
    if after != before:
        write_held(store, TABLE, [after[sensor] for sensor in sorted(after)])
    if not after and store.exists(held_path(TABLE)):
        store.remove(held_path(TABLE))
    return {sensor: MountingChange.of(_values(row)) for sensor, row in after.items()}


def _values(row: Mapping[str, Any]) -> Float64:
    return np.array([row[name] for name in MOUNTING_COLUMNS])


def _stays(row: Mapping[str, Any], error: Float64, config: AdjustConfig) -> bool:
    away = error - _values(row)
    return bool(np.linalg.norm(away[:3]) + config.moved_arm_m * np.linalg.norm(away[3:]) <= config.moved_m)


def _row(found: MountingErrors, k: int) -> dict[str, Any]:
    columns = {"": found.error[k], "sigma_": found.sigma[k], "prior_sigma_": found.prior_sigma[k]}
    numbers = {
        f"{prefix}{name}": float(value)
        for prefix, values in columns.items()
        for name, value in zip(MOUNTING_COLUMNS, values, strict=True)
    }
    return {"sensor": found.sensors[k], **numbers}


def disproved(found: MountingErrors) -> npt.NDArray[np.bool_]:
    """Components (s, 6) whose stated σ is contradicted.

    Were it right, the estimate would have the variance by which evidence lowers that of the prior.
    """
    shown = np.sqrt(np.maximum(found.prior_sigma**2 - found.sigma**2, 0.0))
    error = np.abs(found.error)
    return np.asarray((error > found.prior_sigma) & (error > DOUBTED * shown))


def contradicted(found: MountingErrors) -> npt.NDArray[np.bool_]:
    """Sensors (s,) of which evidence alone, without the prior, contradicts the stated mounting in a component."""
    prior, own = found.prior_sigma, np.minimum(found.sigma, found.prior_sigma)
    shown = (prior > 0.0) & (own < prior)
    precision = 1.0 / np.where(shown, own, 1.0) ** 2 - 1.0 / np.where(shown, prior, 2.0) ** 2
    # The prior holds an estimate back by the share of its precision.
    away = np.abs(found.error) * (1.0 + 1.0 / (precision * np.where(shown, prior, 2.0) ** 2)) * np.sqrt(precision)
    return np.asarray((shown & (away > DOUBTED)).any(axis=1))


def mounting_findings(found: MountingErrors | None) -> list[Finding]:
    """Mountings that are off by more than was stated."""
    said: list[Finding] = []
    if found is None:
        return said
    for k, sensor in enumerate(found.sensors):
        prior, error = found.prior_sigma[k], found.error[k]
        off = np.flatnonzero(disproved(found)[k])
        if off.size:
            words = [f"{_NAMES[c]} {_told(error[c], c, signed=True)} (σ {_told(found.sigma[k, c], c)}, "
                     f"stated σ {_told(prior[c], c)})" for c in off.tolist()]  # fmt: skip
            said.append(
                MOUNTING.finds(
                    sensor,
                    f"passes and control contradict the stated mounting: {', '.join(words)} have to be added to it; "
                    "readings are placed with the estimated mounting, correct the rig file or calibrate it anew",
                )
            )
    return said


def mounting_lines(found: MountingErrors | None) -> list[str]:
    """What the adjustment says of the mountings, a line a sensor."""
    lines: list[str] = []
    if found is None:
        return lines
    for k, sensor in enumerate(found.sensors):
        prior, sigma = found.prior_sigma[k], found.sigma[k]
        known = np.flatnonzero((prior > 0.0) & (sigma < _KNOWN * prior)).tolist()
        unknown = np.flatnonzero((prior > 0.0) & (sigma >= _KNOWN * prior)).tolist()
        words = [f"{_NAMES[c]} {_told(found.error[k, c], c, signed=True)} (σ {_told(sigma[c], c)})" for c in known]
        words += [f"{', '.join(_NAMES[c] for c in unknown)} not determined"] if unknown else []
        lines.append(f"mounting of {sensor}: {'; '.join(words)}")
    return lines


_KNOWN: Final = 0.7
"""A component whose σ fell below this share of the stated one is determined: half of its variance is gone."""


def _told(value: float, component: int, *, signed: bool = False) -> str:
    sign = "+" if signed else ""
    return f"{1e3 * value:{sign}.1f} mm" if component < 3 else f"{np.degrees(value):{sign}.4f}°"


def numbers_of(mounted: Mounted, sensors: Sequence[str]) -> npt.NDArray[np.int32]:
    """Number (n,) of each sensor among the priors, −1: not estimated."""
    known = {one.sensor: k for k, one in enumerate(mounted.priors)}
    return np.array([known.get(sensor, -1) for sensor in sensors], np.int32)
