"""Ties by hand (`adjust.hand_ties`): features that a person found in two passes, as additional observations.

Each end is a place on the road, seen by one pass: height, arm and attitude come from the readings there, as those of a
control point do. A tie that all other evidence contradicts is named, and does not count.
"""

from __future__ import annotations

import csv
import datetime as dt
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.adjust.adjustment import Adjustment
from roadscan.adjust.control import ControlPoint, Sighting
from roadscan.adjust.control_test import quantile
from roadscan.adjust.observations import KINDS, MOUNTED, Observations, RunPrior, mount_partials, partials
from roadscan.adjust.places import Track, Traverse, level_from_map
from roadscan.adjust.settings import AdjustConfig, HandTies
from roadscan.adjust.tasks.control_work import HAND, ControlTask, passes_of, sighting_tasks
from roadscan.adjust.tasks.mountings import Mounted
from roadscan.adjust.tasks.near import Sources
from roadscan.adjust.tasks.tie_work import KnownTies
from roadscan.adjust.tasks.tracks import runs_of
from roadscan.compute.array_types import Bool, Float64
from roadscan.core.errors import ConfigError, nearest
from roadscan.core.gpstime import NS_PER_S, gps_ns_from_utc
from roadscan.core.survey import Survey
from roadscan.core.witness import Finding, Witness
from roadscan.georeference.plan.plan import SurveyPlan

HAND_TIE: Final = Witness(
    "hand_tie",
    input="ties by hand",
    fault="A tie by hand joins things that are not the same, or a run that did not come by.",
    asks="the ways of both runs; poses, ties and control: the normalised leave-one-out residual against the quantile "
    "of adjust.control.false_alarm",
    does="the tie does not count",
    told=("findings",),
)
_KIND: Final = "hand_tie"
_PLACES: Final = ("first_easting_m", "first_northing_m", "second_easting_m", "second_northing_m")
_NEEDED: Final = ("first_run", "second_run", *_PLACES)
_KNOWN: Final = (*_NEEDED, "name", "kind", "first_time", "second_time", "sigma_m", "sigma_height_m")
_SAYS: Final = {"place": (True, False), "height": (False, True), "both": (True, True)}


@dataclass(frozen=True)
class HandEnd:
    """The place of a feature in one run."""

    run: str
    easting_m: float
    """As the recorded poses show it (map)."""
    northing_m: float
    near_gps_ns: int | None
    """Approximate time of the passage; None: the run passed once."""


@dataclass(frozen=True)
class HandTie:
    """One feature in two passes."""

    name: str
    of_place: bool
    of_height: bool
    ends: tuple[HandEnd, HandEnd]
    sigma_m: float
    sigma_height_m: float


def subject(name: str) -> str:
    """Returns the name of a tie in findings."""
    return f"hand tie '{name}'"


def hand_file(survey: Survey) -> Path | None:
    """Returns the file of ties by hand; None where the survey file names none."""
    stated = AdjustConfig.of(survey).hand_ties.path
    return None if stated is None else survey.resolve(stated)


def read_hand_ties(survey: Survey) -> list[HandTie]:
    """Returns ties by hand, in the order of their file.

    Raises
    ------
    ConfigError
        where the file is not there, lacks a column, or a row of it is none.
    """
    path = hand_file(survey)
    if path is None:
        return []
    if not path.is_file():
        raise ConfigError("there is no file of ties by hand", change="correct adjust.hand_ties.path", file=path)
    with path.open(encoding="utf-8-sig", newline="") as stream:
        rows = csv.DictReader(stream)
        names = rows.fieldnames or ()
        odd = [f"no column '{name}'" for name in _NEEDED if name not in names]
        odd += [f"a column '{name}'{nearest(name, _KNOWN)}" for name in names if name not in _KNOWN]
        if odd:
            raise ConfigError(f"the ties by hand have {odd[0]}", expected=", ".join(_KNOWN), file=path)
        runs, stated = [run.id for run in survey.config.runs], AdjustConfig.of(survey).hand_ties
        found = [_tie(row, number, runs, stated, path) for number, row in enumerate(rows, 2)]
    for number, tie in enumerate(found):
        if tie.name in [other.name for other in found[:number]]:
            raise ConfigError(
                f"two ties by hand are called '{tie.name}'", expected="a name of its own", file=path, record=number + 2
            )
    return found


def _tie(row: Mapping[str, str | None], record: int, runs: Sequence[str], stated: HandTies, path: Path) -> HandTie:
    def refused(arrived: str, expected: str) -> ConfigError:
        return ConfigError(arrived, expected=expected, file=path, record=record)

    def number(name: str, default: float = math.nan) -> float:
        text = (row.get(name) or "").strip()
        try:
            value = float(text) if text else default
        except ValueError as error:
            raise refused(f"{name} '{text}'", "metres") from error
        if not math.isfinite(value) or (name.startswith("sigma") and value <= 0.0):
            raise refused(f"{name} '{text}'", "metres, σ above 0")
        return value

    def time(name: str) -> int | None:
        text = (row.get(name) or "").strip()
        try:
            return gps_ns_from_utc(dt.datetime.fromisoformat(text)) if text else None
        except ValueError as error:
            raise refused(f"{name} '{text}'", "a time such as 2026-05-04T10:20:30Z") from error

    ends = []
    for end in ("first", "second"):
        run = (row[f"{end}_run"] or "").strip()
        if run not in runs:
            raise refused(f"a tie of the unknown run '{run}'{nearest(run, runs)}", "runs of the survey")
        ends.append(HandEnd(run, number(f"{end}_easting_m"), number(f"{end}_northing_m"), time(f"{end}_time")))
    kind = (row.get("kind") or "").strip() or stated.kind
    if kind not in _SAYS:
        raise refused(f"a tie of the kind '{kind}'{nearest(kind, list(_SAYS))}", ", ".join(_SAYS))
    name = (row.get("name") or "").strip() or f"hand tie {record - 1}"
    sigmas = number("sigma_m", stated.sigma_m), number("sigma_height_m", stated.sigma_height_m)
    return HandTie(name, *_SAYS[kind], (ends[0], ends[1]), *sigmas)


@dataclass(frozen=True)
class HandWork:
    """Ties by hand that both runs passed, and the tasks that measure at their ends."""

    ties: tuple[HandTie, ...]
    tasks: tuple[ControlTask, ...]
    """Two of each tie."""
    findings: tuple[Finding, ...]
    """On ties that cannot be used."""


def hand_work(
    plan: SurveyPlan, sources: Sources, tracks: Sequence[Track], priors: Sequence[RunPrior], first: int
) -> HandWork:
    """Returns the work on ties by hand; first : number of the first end, above those of all control points."""
    ties, seen, findings = list[HandTie](), list[tuple[ControlPoint, list[tuple[Traverse, ...]]]](), list[Finding]()
    for tie in read_hand_ties(plan.survey):
        own = [(_point(first + len(seen) + k, tie, end), _passes(plan, tracks, end)) for k, end in enumerate(tie.ends)]
        wrong = [_refused(end, found) for end, (_, found) in zip(tie.ends, own, strict=True) if len(found) != 1]
        if wrong:
            text = f"{' and '.join(wrong)}; the tie does not count"
            findings.append(HAND_TIE.finds(subject(tie.name), text, left_out=1))
            continue
        ties.append(tie)
        seen += own
    tasks = sighting_tasks(plan, sources, priors, seen, {})
    return HandWork(tuple(ties), tuple(tasks), tuple(findings))


def _point(number: int, tie: HandTie, end: HandEnd) -> ControlPoint:
    return ControlPoint(
        number, f"{tie.name}, {end.run}", HAND, "", end.easting_m, end.northing_m, math.nan, tie.sigma_m,
        tie.sigma_height_m, None,
    )  # fmt: skip


def _passes(plan: SurveyPlan, tracks: Sequence[Track], end: HandEnd) -> list[tuple[Traverse, ...]]:
    """Returns passes of the run by the place; that of the stated time, where there is one."""
    number = runs_of(plan).index(end.run)
    probe = ControlPoint(0, "", HAND, "", end.easting_m, end.northing_m, math.nan, 1.0, 1.0, None)
    found = passes_of(plan, [t for t in tracks if t.run == number], probe)
    if end.near_gps_ns is None:
        return found
    reach = 0.5 * AdjustConfig.of(plan.survey).places.return_s * NS_PER_S
    return [
        one for one in found
        if min(t.first_gps_ns for t in one) - reach <= end.near_gps_ns <= max(t.last_gps_ns for t in one) + reach
    ]  # fmt: skip


def _refused(end: HandEnd, found: Sequence[object]) -> str:
    where = f"run '{end.run}' at {end.easting_m:.3f}, {end.northing_m:.3f}"
    if not found:
        return f"{where} saw no road{'' if end.near_gps_ns is None else ' at the stated time'}"
    return f"{where} came by {len(found)} times: state first_time or second_time"


def with_hand_ties(
    ties: KnownTies, work: HandWork, sightings: Sequence[Sighting], mounted: Mounted, runs: Sequence[str]
) -> tuple[KnownTies, list[Finding]]:
    """Returns found ties together with those by hand, and findings on the latter that could not be measured."""
    seen = {one.point.number: one for one in sightings}
    parts, names, findings = list[Observations](), list[str](), list[Finding]()
    for k, tie in enumerate(work.ties):
        pair = [seen.get(task.point.number) for task in work.tasks[2 * k : 2 * k + 2]]
        first, second = pair
        unseen = [e.run for e, one in zip(tie.ends, pair, strict=True) if one is None or _is_unseen(one, tie)]
        if first is None or second is None or unseen:
            text = f"no road is seen at its place in {' and '.join(unseen)}; the tie does not count"
            findings.append(HAND_TIE.finds(subject(tie.name), text, left_out=1))
            continue
        own = _observations(tie, (first, second), mounted, runs, -1 - k)
        parts.append(own)
        names += [tie.name] * own.size
    if not parts:
        return ties, findings
    added = Observations.joined(parts)
    columns = _columns(added, names, [seen[t.point.number] for t in work.tasks], work, runs)
    known = {**ties.columns, "name": np.full(ties.observations.size, "", dtype=object)}
    joined = {name: np.concatenate([known[name], own]) for name, own in columns.items()}
    return KnownTies(Observations.joined([ties.observations, added]), joined, ties.tried), findings


def _is_unseen(one: Sighting, tie: HandTie) -> bool:
    return not np.isfinite(one.arm_body_m).all() or (tie.of_height and not np.isfinite(one.height_m))


def _observations(
    tie: HandTie, pair: tuple[Sighting, Sighting], mounted: Mounted, runs: Sequence[str], place: int
) -> Observations:
    """North and east of a place, and the height along the road's normal, which errors of the place do not change."""
    (one, other), turned = pair, pair[0].convergence_rad
    away = np.array(
        [tie.ends[1].easting_m - tie.ends[0].easting_m, tie.ends[1].northing_m - tie.ends[0].northing_m, 0.0]
    )
    directions, values, sigmas, groups = list[Float64](), list[float](), list[float](), list[int]()
    if tie.of_place:
        directions += [np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])]
        values += level_from_map(away[None], turned)[0, :2].tolist()
        sigmas, groups = [tie.sigma_m] * 2, [0, 0]
    if tie.of_height:
        rise = 0.5 * np.array([one.slope_east + other.slope_east, one.slope_north + other.slope_north])
        normal = np.array([-rise[0], -rise[1], 1.0]) / np.sqrt(1.0 + rise @ rise)
        away[2] = other.height_m - one.height_m
        directions.append(level_from_map(normal[None], turned)[0])
        values.append(float(normal @ away))
        sigmas.append(math.hypot(tie.sigma_height_m, one.sigma_height_m, other.sigma_height_m))
        groups.append(1)
    n, direction = len(values), np.array(directions)
    derivatives, mounts, signs = np.zeros((n, 2, 6)), np.zeros((n, 2, len(MOUNTED))), (1.0, -1.0)
    for side, (one, sign) in enumerate(zip(pair, signs, strict=True)):
        axes = np.broadcast_to(one.level_from_body, (n, 3, 3))
        derivatives[:, side] = sign * partials(direction, axes, np.broadcast_to(one.arm_body_m, (n, 3)))
        seat = mounted.seats(runs[one.run], one.sensor, np.full(n, one.epoch_gps_ns, np.int64))
        in_body = sign * direction @ one.level_from_body
        mounts[:, side] = mount_partials(in_body, derivatives[:, side, 3:], in_body @ one.arm_body_m, seat)[0]
    return Observations(
        np.full(n, KINDS.index(_KIND), np.uint8), np.tile(np.array([one.run for one in pair], np.int32), (n, 1)),
        np.tile(np.array([one.epoch_gps_ns for one in pair], np.int64), (n, 1)), derivatives, np.array(values),
        np.array(sigmas), np.array(groups, np.int64), np.full(n, place, np.int64),
        sensor=np.tile(np.array([mounted.number(runs[one.run], one.sensor) for one in pair], np.int32), (n, 1)),
        mount_partials=mounts,
    )  # fmt: skip


def _columns(
    added: Observations, names: Sequence[str], seen: Sequence[Sighting], work: HandWork, runs: Sequence[str]
) -> dict[str, npt.NDArray[Any]]:
    """Returns columns (n,) of the table `ties` that the adjustment uses, and names."""
    sensors = {(one.run, one.epoch_gps_ns): one.sensor for one in seen}
    at = {tie.name: tie.ends[0] for tie in work.ties}
    columns: dict[str, Any] = {
        "place": added.place, "kind": [_KIND] * added.size, "name": list(names), "why_not": [""] * added.size,
        "easting_m": np.array([at[name].easting_m for name in names]),
        "northing_m": np.array([at[name].northing_m for name in names]),
        "sigma_m": added.sigma_m, "accepted": np.ones(added.size, np.uint8),
    }  # fmt: skip
    for side, end in enumerate(("first", "second")):
        columns[f"{end}_run"] = [runs[k] for k in added.run[:, side]]
        own = zip(added.run[:, side].tolist(), added.epoch_gps_ns[:, side].tolist(), strict=True)
        columns[f"{end}_sensor"] = [sensors[key] for key in own]
    return {n: np.array(v, dtype=object) if isinstance(v, list) else v for n, v in columns.items()}


def wrong_hand_ties(
    ties: KnownTies, entering: Bool, adjusted: Adjustment, false_alarm: float
) -> tuple[list[str], list[Finding]]:
    """Returns names of ties by hand that all other evidence contradicts, and findings on them.

    Parameters
    ----------
    entering : (t,) ties that the adjustment began with.
    """
    rows = np.flatnonzero(entering)
    of_hand = np.flatnonzero(ties.observations.kind[rows] == KINDS.index(_KIND))
    if not of_hand.size:
        return [], []
    limit = quantile(false_alarm, of_hand.size)
    off = np.abs(adjusted.normalised_residual[of_hand])
    found, names = [], ties.columns["name"][rows[of_hand]]
    wrong = list(dict.fromkeys(names[off > limit].tolist()))
    for name in wrong:
        own = of_hand[names == name]
        shown = adjusted.residual_m[own] / np.clip(adjusted.redundancy[own], 1e-3, 1.0)
        worst = float(off[names == name].max())
        text = (
            f"it lies {1e3 * float(np.linalg.norm(shown)):.1f} mm from what all other evidence says ({worst:.1f} σ, "
            f"where {limit:.1f} σ are the limit); it does not count"
        )
        found.append(HAND_TIE.finds(subject(name), text, left_out=1))
    return wrong, found
