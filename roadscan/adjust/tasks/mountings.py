"""Mountings of the sensors in an adjustment: their priors, and the corrections that it adds."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.adjust.adjustment import MountingErrors
from roadscan.adjust.control_test import APART
from roadscan.adjust.observations import CAMERA, MOUNTED, TURNS, MountingPrior
from roadscan.adjust.settings import AdjustConfig, CameraPriors
from roadscan.adjust.tasks.near import Sources
from roadscan.adjust.unknowns import sharing
from roadscan.compute.array_types import Float64, Int64
from roadscan.core.rig import Mountings, Sensor
from roadscan.core.survey import Survey
from roadscan.core.witness import Finding, Witness
from roadscan.georeference.plan.plan import SurveyPlan
from roadscan.georeference.sources import (
    MOUNTING_COLUMNS,
    MOUNTING_SIGMAS,
    MountingChanges,
    key_of_row,
    mounting_change_of,
)
from roadscan.pictures.settings import PictureTiesConfig
from roadscan.poses.trajectory import MountingChange, Seat
from roadscan.store.small_tables import read_small, small_path, write_small
from roadscan.store.store import Store


def asks_pictures(survey: Survey) -> bool:
    """Returns whether pictures take part in the adjustment."""
    return survey.has(PictureTiesConfig.table) and PictureTiesConfig.of(survey).on


def adjusted_cameras(survey: Survey) -> dict[str, Sensor]:
    """Returns the cameras whose pictures take part, by name: those with an interior orientation."""
    sensors = sorted(survey.rig.sensors.items()) if asks_pictures(survey) else ()
    return {name: one for name, one in sensors if one.kind == "camera" and one.interior is not None}


def camera_sigma(camera: Sensor, own: CameraPriors) -> tuple[Float64, Float64]:
    """Returns 1 σ (7,) of a camera's mounting, `MOUNTED`, and (11,) of its lens and clock, `CAMERA`."""
    lever = camera.lever_arm_sigma_m or (own.sigma_lever_m,) * 3
    boresight = camera.boresight_sigma_deg or (own.sigma_boresight_deg,) * 3
    mounted = np.array([*lever, *np.radians(boresight), 0.0])
    interior = camera.interior
    if interior is None:
        return mounted, np.zeros(len(CAMERA))
    focal = interior.sigma_focal_px or tuple(own.sigma_focal * f for f in interior.focal_px)
    principal = interior.sigma_principal_px or tuple(own.sigma_principal * f for f in interior.focal_px)
    bent = interior.sigma_distortion or (own.sigma_k1, 0.0, 0.0, 0.0, 0.0)
    if interior.model == "equirectangular":
        focal, principal, bent = (0.0, 0.0), (0.0, 0.0), (0.0,) * 5
    line = interior.sigma_line_time_us
    line = (own.sigma_line_time_us if interior.line_time_us else 0.0) if line is None else line
    return mounted, np.array([*focal, *principal, *bent, own.sigma_clock_s, 1e-6 * line])


TABLE: Final = "mounting_corrections"
_NAMES: Final = (
    "lever arm forward", "lever arm to the right", "lever arm down",
    "boresight roll", "boresight pitch", "boresight heading", "range scale",
)  # fmt: skip
DOUBTED: Final = 3.0
"""A mounting that is off by more than this many stated σ is reported."""
CHANCE: Final = 0.0027
"""Chance of a test of what is stated: that of 3 σ."""
DETERMINED: Final = 0.7
"""A component whose σ fell below this share of the stated one is determined: its variance is halved."""
_MOST_WRONG: Final = 3
"""If more sensors are wrong at once, all are estimated instead of searching which."""
_FREE: Final = 100.0
"""Prior of a free error in the test, in stated σ."""

MOUNTING: Final = Witness(
    "mounting",
    input="rig file",
    fault="The mounting of a sensor, or the scale of its ranges, is not what the rig file or the calibration states.",
    asks="passes side by side, heads of one pass, planes that a lidar saw from before and from behind, and ground "
    "control, all in one adjustment",
    does="mounting and scale are estimated with their stated σ as prior, and readings are placed with them; one that "
    "is off by more than three σ of what was stated is named",
    told=("findings",),
)


@dataclass(frozen=True)
class Mounted:
    """Mountings of the sensors that the adjustment may estimate."""

    priors: tuple[MountingPrior, ...]
    """By name; none where mountings are not estimated."""
    stated: Mapping[tuple[str, str], Mountings]
    """By run and sensor."""
    parallel: frozenset[tuple[str, str]]
    """Run and sensor of heads whose beams are all parallel to their z axis."""
    cameras: frozenset[str] = frozenset()
    """Names of cameras: pictures show their mounting whether or not it contradicts what was stated."""
    common_sigma: tuple[float, float] = (0.0, 0.0)
    """1 σ of how far the ranges of single lasers are off (m), and of a roll that ties of a drive seem to show (rad)."""

    @property
    def sensors(self) -> list[str]:
        """Returns the names of all sensors, sorted."""
        return sorted({sensor for _, sensor in self.stated})

    def number(self, run: str, sensor: str) -> int:
        """Returns the index of a run's sensor in `priors`, −1: not estimated."""
        keys = [one.key for one in self.priors]
        return next((keys.index(key) for key in ((run, sensor), ("*", sensor)) if key in keys), -1)

    def apart(self, heads: Iterable[tuple[str, str]]) -> Mounted:
        """Same, with separate mountings for some sensors (run, name) whose heights contradict the common one."""
        known = {one.sensor: one for one in self.priors}
        own = [replace(known[sensor], run=run) for run, sensor in sorted(set(heads)) if sensor in known]
        return replace(self, priors=(*self.priors, *own))

    def seats(self, run: str, sensor: str, epochs_gps_ns: Int64 | int) -> Seat:
        """Returns stated lever arms and directions of the beams, (n, 3) at epochs, (3,) at one."""
        return Seat.of(self.stated[run, sensor], epochs_gps_ns, parallel=(run, sensor) in self.parallel)


def mounted_of(plan: SurveyPlan, sources: Sources, *, foreign: bool) -> Mounted:
    """Returns mountings of the sources that are adjusted.

    foreign : another program corrected the poses of a run, with the mountings as they are stated.
    """
    config = AdjustConfig.of(plan.survey)
    stated = {(source.run, source.sensor): source.mountings for source, _ in sources}
    parallel = frozenset((source.run, source.sensor) for source, _ in sources if source.has_parallel_beams)
    if foreign or config.mode != "joint":
        return Mounted((), stated, parallel, common_sigma=config.mountings.common_sigma)
    calibrated = calibrated_sigma(plan.store)
    priors = []
    # A fixed run is right as it is, and so are the mountings of its sensors.
    held = {sensor for run, sensor in stated if run in config.fixed}
    for sensor in sorted({sensor for _, sensor in stated} - held):
        sigma = _sigma(plan, config, sensor, calibrated.get(sensor))
        if (sigma > 0.0).any():
            priors.append(MountingPrior(sensor, sigma))
    cameras = [
        MountingPrior(name, camera_sigma(one, config.cameras)[0]) for name, one in adjusted_cameras(plan.survey).items()
    ]
    filmed = frozenset(one.sensor for one in cameras)
    return Mounted((*priors, *cameras), stated, parallel, filmed, config.mountings.common_sigma)


def _sigma(plan: SurveyPlan, config: AdjustConfig, sensor: str, calibrated: Float64 | None) -> Float64:
    """1 σ (7,) of a mounting: of its calibration, else of the rig file, else of the settings; 0 where these are 0."""
    own = config.mountings
    assumed = np.array(
        [
            own.sigma_forward_m, own.sigma_right_m, own.sigma_down_m,
            *np.radians([own.sigma_roll_deg, own.sigma_pitch_deg, own.sigma_heading_deg]), own.sigma_range_scale,
        ]
    )  # fmt: skip
    known = plan.survey.rig.sensors.get(sensor)
    levers = None if known is None else known.lever_arm_sigma_m
    angles = None if known is None else known.boresight_sigma_deg
    stated = np.full(len(MOUNTED), np.nan)
    if known is not None and known.range_scale_sigma is not None:
        stated[6] = known.range_scale_sigma
    if levers is not None:
        stated[:3] = levers
    if angles is not None:
        stated[3:6] = np.radians(angles)
    if calibrated is not None:
        stated = np.where(np.isfinite(calibrated), calibrated, stated)
    return np.where(assumed > 0.0, np.where(np.isfinite(stated), stated, assumed), 0.0)


def calibrated_sigma(store: Store) -> dict[str, Float64]:
    """Returns 1 σ (7,) of calibrated mountings by sensor, the largest of all runs and times; NaN where not stated."""
    table = read_small(store, "mountings")
    found: dict[str, Float64] = {}
    for row in [] if table is None else table.to_pylist():
        values = [np.nan if row.get(name) is None else float(row[name]) for name in MOUNTING_SIGMAS]
        sigma = np.array([*values[:3], *np.radians(values[3:]), np.nan])
        found[row["sensor"]] = np.fmax(found.get(row["sensor"], np.full(sigma.size, np.nan)), sigma)
    return found


def held_values(mounted: Mounted, changes: MountingChanges) -> Float64:
    """Returns the current corrections (s, 7) of the mountings that `mounted` numbers."""
    own = [changes[one.key].values if one.key in changes else np.zeros(len(MOUNTED)) for one in mounted.priors]
    return np.array(own).reshape(-1, len(MOUNTED))


def publish_mountings(store: Store, found: MountingErrors | None, config: AdjustConfig) -> MountingChanges:
    """Update the table; corrections that move a point by no more than `adjust.moved_m` stay bit-identical."""
    table = read_small(store, TABLE)
    before = {key_of_row(row): row for row in ([] if table is None else table.to_pylist())}
    after: dict[tuple[str, str], dict[str, Any]] = {}
    if found is not None:
        for k, sensor in enumerate(found.sensors):
            if found.error[k].any():
                known = before.get(sensor)
                after[sensor] = known if known and _stays(known, found.error[k], config) else _row(found, k)
    if after != before:
        write_small(store, TABLE, [after[sensor] for sensor in sorted(after)])
    if not after and store.exists(small_path(TABLE)):
        store.remove(small_path(TABLE))
    return {sensor: MountingChange.of(_values(row)) for sensor, row in after.items()}


def _values(row: Mapping[str, Any]) -> Float64:
    return mounting_change_of(row).values


def _stays(row: Mapping[str, Any], error: Float64, config: AdjustConfig) -> bool:
    return MountingChange.of(error - _values(row)).moved_m(config.moved_arm_m) <= config.moved_m


def _row(found: MountingErrors, k: int) -> dict[str, Any]:
    columns = {"": found.error[k], "sigma_": found.sigma[k], "prior_sigma_": found.prior_sigma[k]}
    numbers = {
        f"{prefix}{name}": float(value)
        for prefix, values in columns.items()
        for name, value in zip(MOUNTING_COLUMNS, values, strict=True)
    }
    return dict(zip(("run", "sensor"), found.sensors[k], strict=True)) | numbers


def disproved(found: MountingErrors) -> npt.NDArray[np.bool_]:
    """Returns a mask (s, 7) of the components whose stated σ is contradicted.

    Were it right, the estimate would have the variance by which evidence lowers that of the prior.
    """
    shown = np.sqrt(np.maximum(found.prior_sigma**2 - found.sigma**2, 0.0))
    error = np.abs(found.error)
    return np.asarray((error > found.prior_sigma) & (error > DOUBTED * shown))


@dataclass(frozen=True)
class _Told:
    """Normal equations of the mountings from evidence alone, without the priors, in units of the prior σ.

    The height error common to all sensors is eliminated.
    """

    matrix: Float64
    """(m, m)"""
    right: Float64
    """(m,) right-hand side: matrix · errors = right."""
    sensor: Int64
    """(m,) of each unknown."""
    component: Int64

    @classmethod
    def of(cls, found: MountingErrors) -> _Told:
        """Returns the equations from an adjustment that estimated all mountings."""
        from scipy.linalg import null_space

        sensor, component = np.nonzero(found.prior_sigma > 0.0)
        prior = found.prior_sigma[sensor, component]
        rows = sensor * found.prior_sigma.shape[1] + component
        unit = found.covariance[np.ix_(rows, rows)] / np.outer(prior, prior)
        down = np.where(component == MOUNTED.index("down_m"), 1.0 / prior, 0.0)
        groups = sharing([run for run, _ in found.sensors], found.prior_sigma)
        common = np.array([np.where(np.isin(sensor, own), down, 0.0) for own in groups])
        free = null_space(common) if groups else np.eye(prior.size)
        precision = np.linalg.inv(free.T @ (0.5 * (unit + unit.T)) @ free)
        right = free @ (precision @ (free.T @ (found.error[sensor, component] / prior)))
        return cls(free @ (precision - np.eye(len(precision))) @ free.T, right, sensor, component)

    def explained(self, rows: Int64, prior: float = 1.0) -> tuple[float, float]:
        """How much the weighted squares fall where some errors are free within so many prior σ, and the fall to be
        that is to be expected by chance: the number of errors that the evidence determines.
        """
        own = self.matrix[np.ix_(rows, rows)]
        solved = np.linalg.solve(own + np.eye(rows.size) / prior**2, np.column_stack([self.right[rows], own]))
        return float(self.right[rows] @ solved[:, 0]), float(np.trace(solved[:, 1:]))


def contradicted(found: MountingErrors) -> npt.NDArray[np.bool_]:
    """Returns sensors (s,) whose stated mountings evidence contradicts: the fewest that explain all of it.

    Where two explain it equally well, both are among them. Components that evidence
    does not distinguish, as the height of a head and its range scale, contradict together.
    """
    from scipy.special import chdtri

    count = len(found.sensors)
    none = np.zeros(count, bool)
    if not (found.prior_sigma > 0.0).any():
        return none
    told = _Told.of(found)
    fall, determined = told.explained(np.arange(told.sensor.size))
    for size in range(min(count, _MOST_WRONG) + 1):
        holding = []
        for chosen in combinations(range(count), size):
            own, known = told.explained(np.flatnonzero(np.isin(told.sensor, chosen)))
            if fall - own <= chdtri(max(determined - known, 1.0), CHANCE):
                holding.append((own, chosen))
        if holding:
            best = max(holding)[0]
            return np.isin(np.arange(count), [k for own, chosen in holding if best - own < APART for k in chosen])
    return ~none


@dataclass(frozen=True)
class Cause:
    """One error of one mounting that would explain the contradiction of the stated ones."""

    sensor: tuple[str, str]
    """Run and name."""
    component: int
    error: float
    sigma: float


def causes(found: MountingErrors) -> tuple[Cause, ...]:
    """Single errors of which each explains all that contradicts the stated mountings, and none much better than the
    others; none where it takes several of them.
    """
    from scipy.special import chdtri

    if not contradicted(found).any():
        return ()
    told = _Told.of(found)
    fall, determined = told.explained(np.arange(told.sensor.size), _FREE)
    each = [told.explained(np.array([k]), _FREE)[0] for k in range(told.sensor.size)]
    enough = fall - chdtri(max(determined - 1.0, 1.0), CHANCE)
    named = []
    for k, (sensor, component) in enumerate(zip(told.sensor.tolist(), told.component.tolist(), strict=True)):
        if each[k] >= enough and max(each) - each[k] < APART:
            prior, precision = found.prior_sigma[sensor, component], told.matrix[k, k]
            named.append(
                Cause(found.sensors[sensor], component, prior * told.right[k] / precision, prior / np.sqrt(precision))
            )
    return tuple(named)


def rolls_in_words(rolls: Sequence[Cause]) -> str:
    """Returns rolls of sensors that would explain a shift of the control as well; "" without any."""
    words = [
        f"a boresight roll of {_called(one.sensor)} that is off by {_text(-one.error, one.component, signed=True)} "
        f"(σ {_text(one.sigma, one.component)})"
        for one in rolls
    ]
    return " and ".join(words)


def cause_line(found: Sequence[Cause]) -> str:
    """Returns what may be wrong with a mounting, where several errors would explain the same; "" for less than two."""
    if len(found) < 2:
        return ""
    words = [
        f"{_NAMES[one.component]} of {_called(one.sensor)} {_text(one.error, one.component, signed=True)}"
        for one in found
    ]
    return (
        f"heads, passes and control do not agree with the stated mountings, and do not tell which of these is off: "
        f"{', or '.join(words)}; the adjustment shares it among them as their σ allow"
    )


def mounting_findings(found: MountingErrors | None) -> list[Finding]:
    """Returns findings on mountings that are off by more than was stated."""
    said: list[Finding] = []
    if found is None:
        return said
    for k, sensor in enumerate(found.sensors):
        prior, error = found.prior_sigma[k], found.error[k]
        off = np.flatnonzero(disproved(found)[k])
        if off.size:
            words = [f"{_NAMES[c]} {_text(error[c], c, signed=True)} (σ {_text(found.sigma[k, c], c)}, "
                     f"stated σ {_text(prior[c], c)})" for c in off.tolist()]  # fmt: skip
            like = (
                " (attitudes of all poses that are turned by as much look the same)"
                if np.isin(off, list(TURNS.values())).any()
                else ""
            )
            said.append(
                MOUNTING.finds(
                    _called(sensor),
                    f"passes and control contradict the stated mounting: {', '.join(words)} have to be added to it"
                    f"{like}; readings are placed with the estimated mounting, correct the rig file or calibrate it "
                    "anew",
                )
            )
    return said


def mounting_lines(found: MountingErrors | None) -> list[str]:
    """Returns a line for each sensor on the estimate of its mounting."""
    lines: list[str] = []
    if found is None:
        return lines
    for k, sensor in enumerate(found.sensors):
        prior, sigma = found.prior_sigma[k], found.sigma[k]
        determined = (sigma < DETERMINED * prior) | disproved(found)[k]
        known = np.flatnonzero((prior > 0.0) & determined).tolist()
        unknown = np.flatnonzero((prior > 0.0) & ~determined).tolist()
        words = [f"{_NAMES[c]} {_text(found.error[k, c], c, signed=True)} (σ {_text(sigma[c], c)})" for c in known]
        words += [f"{', '.join(_NAMES[c] for c in unknown)} not determined"] if unknown else []
        lines.append(f"mounting of {_called(sensor)}: {'; '.join(words)}")
    return lines


def _called(sensor: tuple[str, str]) -> str:
    run, name = sensor
    return name if run == "*" else f"{name} in run '{run}'"


def _text(value: float, component: int, *, signed: bool = False) -> str:
    sign = "+" if signed else ""
    if component == MOUNTED.index("range_scale"):
        return f"{1e2 * value:{sign}.3f} %"
    return f"{1e3 * value:{sign}.1f} mm" if component < 3 else f"{np.degrees(value):{sign}.4f}°"
