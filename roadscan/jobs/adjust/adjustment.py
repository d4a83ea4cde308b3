"""The adjustment of a survey, from raw readings to the table `corrections` and what it is worth."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Final

import numpy as np

from roadscan.adjust.control import ControlPoint, Sighting
from roadscan.adjust.control_faults import listed
from roadscan.adjust.places import Place, Track, places_of_overlap
from roadscan.adjust.process import RunPrior
from roadscan.adjust.quality import NSSDA_CHECK_POINTS
from roadscan.code_reach import code_digest
from roadscan.jobs.adjust.control_work import (
    SIGHTINGS,
    ControlTask,
    control_points,
    control_tasks,
    load_sightings,
    sight_control,
)
from roadscan.jobs.adjust.doubts import CONTROL, CONTROL_PLACE, CORRECTED_ELSEWHERE, target_findings
from roadscan.jobs.adjust.figures import Held, Rows, accuracy_rows, control_rows, distance_rows, relative_rows, tie_rows
from roadscan.jobs.adjust.mountings import (
    calibrated_sigma,
    held_values,
    mounted_of,
    mounting_findings,
    mounting_lines,
    publish_mountings,
)
from roadscan.jobs.adjust.near import Sources
from roadscan.jobs.adjust.outcome import ADJUSTMENT, PICTURES, SOLUTION, TABLES, keep_pictures, keep_tables
from roadscan.jobs.adjust.publication import digests_of, foreign_runs, publish
from roadscan.jobs.adjust.seams import shown_seams
from roadscan.jobs.adjust.solution import Evidence, Solution, priors_of, solve
from roadscan.jobs.adjust.tie_work import TIES, TieTask, collect_ties, load_ties, tie_tasks
from roadscan.jobs.adjust.tracks import adjusted_sources, runs_of, tracks_of
from roadscan.jobs.engine.bundles import run_bundles
from roadscan.jobs.engine.fingerprint import key_of
from roadscan.jobs.plan.plan import SurveyPlan
from roadscan.jobs.plan.road import road_key
from roadscan.jobs.session import Session
from roadscan.model.settings.tie_settings import PlaceSettings
from roadscan.model.witness import Finding
from roadscan.navigation.movement import largest
from roadscan.products.pictures.adjustment import AdjustmentPicture, Residuals
from roadscan.tables.manifest import Manifest, OutputRecord
from roadscan.tables.store import file_digest

_BUNDLE_BYTES: Final = 20_000_000.0
"""Compressed bytes that a task reads, about."""
_BUNDLE_POINTS: Final = 8


@dataclass(frozen=True)
class Work:
    """Evidence that is to be collected."""

    tracks: tuple[Track, ...]
    ties: tuple[TieTask, ...]
    control: tuple[ControlTask, ...]
    points: tuple[ControlPoint, ...]
    """Control points of the survey."""


def solution_key(plan: SurveyPlan) -> str:
    """Hash of all that the solution depends on: settings, code, readings, poses, control. No reading is read for it."""
    config = plan.survey.config.adjust
    picked = None if config.targets.picked is None else plan.survey.resolve(config.targets.picked)
    sources = [
        [s.key, *road_key(s), s.trajectory is not None, [f.digest for f in files]]
        for s, files in adjusted_sources(plan)
    ]
    beside = [
        [r.key, [f.digest for f in r.tables.get(table, ())]]
        for r in plan.records
        for table in ("control_points", "trajectory_accuracy")
        if r.tables.get(table)
    ]
    return key_of(
        code_digest(f"{__name__}:adjust_survey"), config.model_dump(mode="json"), runs_of(plan), sources, beside,
        [[name, s.lever_arm_sigma_m, s.boresight_sigma_deg] for name, s in sorted(plan.survey.rig.sensors.items())],
        sorted((name, sigma.tolist()) for name, sigma in calibrated_sigma(plan.store).items()),
        None if picked is None or not picked.is_file() else file_digest(picked), sorted(foreign_runs(plan.store)),
    )  # fmt: skip


def is_current(plan: SurveyPlan, manifest: Manifest) -> bool:
    """True where nothing has changed since the last solution, and what it made is there."""
    record = manifest.get(ADJUSTMENT, SOLUTION)
    if not plan.survey.config.adjust.on:
        return record is None
    if record is None or record.key != solution_key(plan):
        return False
    parts = [r for name in (TIES, SIGHTINGS, *TABLES, PICTURES) for r in manifest.of(name).values()]
    whole = all(manifest.is_current(r.product, r.unit, r.key) for r in parts)
    return whole and record.figures()["table"] == digests_of(plan.store)


def withdraw(session: Session) -> None:
    """Take away what the stage made: the poses hold as they were recorded."""
    manifest, plan = session.manifest, session.plan
    manifest.remove([r for name in (TIES, SIGHTINGS, *TABLES, PICTURES) for r in manifest.of(name).values()])
    publish(session.store, {}, plan.survey.config.adjust)
    publish_mountings(session.store, None, plan.survey.config.adjust)
    manifest.forget(ADJUSTMENT, [SOLUTION])


def adjust_survey(session: Session) -> None:
    """Collect what evidence is missing, solve, and publish the corrections, tables and pictures."""
    plan, manifest = session.plan, session.manifest
    key = solution_key(plan)
    foreign = foreign_runs(session.store)
    sources = [pair for pair in adjusted_sources(plan) if pair[0].run not in foreign]
    runs = runs_of(plan)
    priors = priors_of(plan, sources, runs)
    work = plan_work(plan, sources, priors)
    failed = _collect(session, work)
    mounted = mounted_of(plan, sources, foreign=bool(foreign))
    ties = load_ties(session.store, manifest, [t.unit for t in work.ties], runs, mounted)
    sightings, pictures = load_sightings(session.store, manifest, work.control)
    evidence = Evidence(runs, priors, ties, tuple(sightings), mounted)
    doubts = [
        CORRECTED_ELSEWHERE.finds(f"run '{run}'", "its poses were corrected by another program: they are not adjusted")
        for run in sorted(foreign)
    ]
    if not (ties.accepted.any() or any(one.point.role == "gcp" for one in sightings)):
        lines = [f"nothing to adjust: {_no_ties(work)}, {_seen(work, sightings)}"]
        held: Held = publish(session.store, {}, plan.survey.config.adjust)
        publish_mountings(session.store, None, plan.survey.config.adjust)
        manifest.remove([r for name in (*TABLES, PICTURES) for r in manifest.of(name).values()])
        _keep(session, key, {}, (lines, [*doubts, *_of_points(work, sightings)]), failed)
        return
    solution = solve(plan, evidence)
    held = publish(session.store, solution.corrections, plan.survey.config.adjust)
    changes = publish_mountings(session.store, solution.mountings, plan.survey.config.adjust)
    added = held_values(mounted, changes)
    points = control_rows(evidence, solution, held, added)
    tables = {
        "tie_residuals": tie_rows(evidence, solution, held, added),
        "control_residuals": points,
        "relative_accuracy": relative_rows(evidence, work.tracks, held, added),
        "absolute_accuracy": accuracy_rows(points, evidence, solution),
        "accuracy_by_distance": distance_rows(points, evidence, solution, work.tracks),
    }
    keep_tables(session.store, manifest, key, tables)
    seams, not_drawn = shown_seams(work.ties, evidence, solution, (held, changes), session.compute)
    keep_pictures(session.store, manifest, key, (_picture(plan, work, tables), seams), pictures)
    lines = [*_lines(work, evidence, solution, held, tables), *mounting_lines(solution.mountings), *not_drawn]
    doubts += [*solution.findings, *mounting_findings(solution.mountings), *_of_points(work, sightings)]
    _keep(session, key, held, (lines, doubts), failed)


def plan_work(plan: SurveyPlan, sources: Sources, priors: Sequence[RunPrior]) -> Work:
    """Where passes overlap and where they come by control points: tasks for both."""
    tracks = tracks_of(plan, sources)
    config = plan.survey.config.adjust
    places = _places(tracks, config.places)
    points = control_points(plan)
    ties = tie_tasks(plan, sources, places, runs_of(plan))
    control = control_tasks(plan, sources, tracks, points, priors)
    return Work(tuple(tracks), tuple(ties), tuple(control), tuple(points))


def _places(tracks: Sequence[Track], settings: PlaceSettings) -> list[Place]:
    """Places of dense sensors, then those of lidars, which are larger: they are numbered through."""
    dense = places_of_overlap([t for t in tracks if t.ahead_m == 0.0], settings)
    ahead = settings.model_copy(update={"per_km": settings.lidar_per_km})
    sparse = places_of_overlap([t for t in tracks if t.ahead_m > 0.0], ahead)
    return [*dense, *(replace(place, number=len(dense) + place.number) for place in sparse)]


def _collect(session: Session, work: Work) -> bool:
    """Bring the evidence up to date; True where some of it failed."""
    manifest, bar = session.manifest, session.bar
    manifest.remove(manifest.beside([TIES], {t.unit for t in work.ties}))
    manifest.remove(manifest.beside([SIGHTINGS], {t.unit for t in work.control}))
    ties = [t for t in work.ties if not manifest.is_current(TIES, t.unit, t.key)]
    control = [t for t in work.control if not manifest.is_current(SIGHTINGS, t.unit, t.key)]
    found = [
        (task.unit, reason)
        for task, reason in run_bundles(
            collect_ties, ties, lambda t: t.bytes, _BUNDLE_BYTES, manifest, session.compute, bar("ties")
        )
    ]
    found += [
        (f"{task.unit} ({task.point.name})", reason)
        for task, reason in run_bundles(
            sight_control, control, lambda _: 1, _BUNDLE_POINTS, manifest, session.compute, bar("control points")
        )
    ]
    session.failed("adjust", found)
    return bool(found)


def _keep(session: Session, key: str, held: Held, said: tuple[list[str], list[Finding]], failed: bool) -> None:
    """Record the solution and say what it found; one that lacks evidence is made anew by the next run."""
    lines, doubts = said
    detail = {
        "runs": sorted(held), "table": digests_of(session.store), "lines": lines,
        "findings": [asdict(one) for one in doubts],
    }  # fmt: skip
    own = key if not failed else key_of(key, "failed")
    session.manifest.add([OutputRecord(ADJUSTMENT, SOLUTION, own, "", 0, "", json.dumps(detail))])
    for line in lines:
        session.reporter.line(f"adjust: {line}")


def _no_ties(work: Work) -> str:
    """Why no tie counts."""
    places = sum(len(task.places) for task in work.ties)
    if not work.tracks:
        return "no readings with poses (points of a cloud are placed already)"
    return (
        f"no tie that counts at {places:,} places of overlap" if places else "no place where passes with poses overlap"
    )


def _seen(work: Work, sightings: Sequence[Sighting]) -> str:
    if not work.points:
        return "no control point"
    seen = len({one.point.number for one in sightings if one.status != "unseen"})
    return f"{seen} of {len(work.points)} control points seen"


def _of_points(work: Work, sightings: Sequence[Sighting]) -> list[Finding]:
    """Findings on points that no pass saw, and on targets that are not as they should be."""
    found: list[Finding] = []
    if work.points and not work.control:
        text = (
            f"not one of the {len(work.points)} control points lies where a pass drove: check crs of their [[control]]"
        )
        found.append(CONTROL_PLACE.finds(CONTROL, text, left_out=len(work.points)))
    elif beside := _beside(work, sightings):
        text = (
            f"{len(beside)} of {len(work.points)} control points lie where no pass saw the road: {listed(beside)}; "
            "they are of another stretch, or in another CRS"
        )
        found.append(CONTROL_PLACE.finds(CONTROL, text, left_out=len(beside)))
    return found + target_findings(sightings)


def _beside(work: Work, sightings: Sequence[Sighting]) -> list[str]:
    """Points that no pass saw, and how far they lie from where the nearest sensor went."""
    seen = {one.point.number for one in sightings if one.status != "unseen"}
    unseen = [one for one in work.points if one.number not in seen]
    ways = np.concatenate([np.zeros((0, 2)), *(np.stack([t.easting_m, t.northing_m], axis=-1) for t in work.tracks)])
    return [
        f"{one.name} ({np.hypot(*(ways - [one.easting_m, one.northing_m]).T).min():,.1f} m from the nearest track)"
        for one in unseen
    ]


def _lines(
    work: Work, evidence: Evidence, solution: Solution, held: Held, tables: dict[str, Rows]
) -> list[str]:  # fmt: skip
    places, counted = sum(len(t.places) for t in work.ties), int((solution.tie_weight > 0).sum())
    lines = [
        f"{places:,} places of overlap with {evidence.ties.observations.size:,} ties, {counted:,} of which count; "
        f"{_seen(work, evidence.sightings)}"
    ]
    if held:
        moved = {run: largest(own) for run, own in held.items()}
        down = max(float(np.abs(own.north_east_down_m[:, 2]).max()) for own in held.values())
        across = max(shift for shift, _ in moved.values())
        lines.append(
            f"{len(held)} runs corrected by up to {across * 1e3:.1f} mm horizontally, {down * 1e3:.1f} mm in height"
        )
    heights = [row for row in tables["tie_residuals"] if row["kind"] == "height_tie" and row["accepted"]]
    if heights:
        before, after = (_rms([row[f"{word}_m"] for row in heights]) for word in ("before", "after"))
        lines.append(f"pass against pass in height: RMS {before * 1e3:.2f} mm before, {after * 1e3:.2f} mm after")
    by = {(r["points"], r["component"], r["poses"]): r for r in tables["absolute_accuracy"]}
    for component in ("height", "horizontal"):
        was, now = (by.get(("check", component, poses)) for poses in ("recorded", "adjusted"))
        if was and now:
            lines.append(
                f"check points, {component}: RMSE {was['rmse_m'] * 1e3:.2f} mm before, {now['rmse_m'] * 1e3:.2f} mm "
                f"after, {_statement(now['count'], now['nssda_95_m'])}"
            )
    left = by.get(("left_out", "height", "adjusted"))
    if left:
        lines.append(f"each GCP against all other evidence, height: RMSE {left['rmse_m'] * 1e3:.2f} mm")
    return [*lines, *solution.lines]


def _statement(count: int, nssda_95_m: float) -> str:
    """Accuracy after NSSDA, or that there are too few points for it."""
    if count < NSSDA_CHECK_POINTS:
        return f"of {count} points (NSSDA takes {NSSDA_CHECK_POINTS} at least)"
    return f"95 % within {nssda_95_m * 1e3:.2f} mm (NSSDA, {count} points)"


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _picture(plan: SurveyPlan, work: Work, tables: dict[str, Rows]) -> AdjustmentPicture:
    ways = tuple(np.stack([t.easting_m, t.northing_m], axis=-1) for t in work.tracks)
    ties = [row for row in tables["tie_residuals"] if row["kind"] == "height_tie" and row["accepted"]]
    parts = [_residuals("ties, height", ties, "")]
    for role, title in (("gcp", "ground control, height"), ("check", "check points, height")):
        own = [r for r in tables["control_residuals"] if r["role"] == role and r["height_before_m"] is not None]
        parts.append(_residuals(title, own, "height_"))
    return AdjustmentPicture(plan.survey.config.id, ways, tuple(parts))


def _residuals(title: str, rows: Rows, prefix: str) -> Residuals:
    columns = [np.array([row[name] for row in rows], np.float64) for name in (
        "easting_m", "northing_m", f"{prefix}before_m", f"{prefix}after_m",
    )]  # fmt: skip
    return Residuals(title, *columns)
