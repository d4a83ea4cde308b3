"""The adjustment of a survey, from raw readings to the table `corrections` and its accuracy."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np

from roadscan.adjust.bundle.outcome import residuals_of
from roadscan.adjust.control import NAMED, ControlPoint, Sighting
from roadscan.adjust.observations import RunPrior
from roadscan.adjust.places import Place, Track, places_of_overlap
from roadscan.adjust.quality import NSSDA_CHECK_POINTS, AdjustmentPicture, Residuals
from roadscan.adjust.settings import AdjustConfig, PlaceSettings
from roadscan.adjust.tasks.cameras import (
    AskedOfPictures,
    camera_findings,
    picture_findings,
    picture_lines,
    picture_rows,
    pictures_key,
    pictures_of,
    publish_cameras,
)
from roadscan.adjust.tasks.control_work import (
    SIGHTINGS,
    ControlTask,
    control_points,
    control_tasks,
    lines_line,
    load_sightings,
    sight_control,
)
from roadscan.adjust.tasks.doubts import CONTROL, CONTROL_PLACE, CORRECTED_ELSEWHERE, target_findings
from roadscan.adjust.tasks.edge_scores import RETURNS, SCORES
from roadscan.adjust.tasks.hand_ties import HandWork, hand_file, hand_work, with_hand_ties
from roadscan.adjust.tasks.mountings import (
    Mounted,
    asks_pictures,
    calibrated_sigma,
    held_values,
    mounted_of,
    mounting_findings,
    mounting_lines,
    publish_mountings,
)
from roadscan.adjust.tasks.near import Sources
from roadscan.adjust.tasks.outcome import (
    ADJUSTMENT,
    PICTURES,
    SOLUTION,
    TABLES,
    failed_ties,
    keep_pictures,
    keep_tables,
    shown_seams,
)
from roadscan.adjust.tasks.publication import (
    Held,
    Rows,
    accuracy_rows,
    control_rows,
    digests_of,
    distance_rows,
    foreign_runs,
    of_points,
    publish,
    relative_rows,
    tie_rows,
)
from roadscan.adjust.tasks.solution import Evidence, Solution, priors_of, solve
from roadscan.adjust.tasks.tie_work import (
    TIES,
    KnownTies,
    TieTask,
    collect_ties,
    lidar_error_findings,
    lidar_error_lines,
    load_ties,
    tie_tasks,
)
from roadscan.adjust.tasks.ties_again import Again, first_ties, settled
from roadscan.adjust.tasks.tracks import (
    COMMON_M,
    adjusted_sources,
    exchanged,
    head_findings,
    odd_steps,
    runs_of,
    seams,
    steps_of,
    tracks_of,
)
from roadscan.adjust.ties.plane import lean_findings, leans
from roadscan.compute.array_types import Float64
from roadscan.core.counted import counted as count_of
from roadscan.core.counted import listed
from roadscan.core.extras import can_draw
from roadscan.core.witness import Finding
from roadscan.georeference.plan.plan import SurveyPlan, poses_plan_of
from roadscan.georeference.sources import road_key
from roadscan.navigation.tasks.recorded_pictures import NOT_DRAWN
from roadscan.poses.trajectory import largest
from roadscan.run.engine.compute import run_bundles
from roadscan.run.keys import code_digest, key_of
from roadscan.run.session import Session
from roadscan.store.digest import file_digest
from roadscan.store.manifest import CHANGED, DAMAGED, MISSING, Manifest, OutputRecord

_BUNDLE_BYTES: Final = 20_000_000.0
"""Approximate compressed bytes that a task reads."""
_BUNDLE_POINTS: Final = 8  # Control points of a task.
_LANE_BESIDE_M: Final = 8.0
"""A control point this near to a track (m) may lie on a lane beside it that nobody drove, and is no fault."""


@dataclass(frozen=True)
class Work:
    """Evidence to be collected."""

    tracks: tuple[Track, ...]
    ties: tuple[TieTask, ...]
    control: tuple[ControlTask, ...]
    points: tuple[ControlPoint, ...]
    """Control points of the survey."""
    hand: HandWork
    """Ties by hand."""
    of_pictures: frozenset[int] = frozenset()
    """Numbers of control points that pictures alone can see: plates on walls and posts."""

    @property
    def own_points(self) -> list[ControlPoint]:
        """Returns the points that passes may see: neither of a surveyed line nor of pictures alone."""
        return [point for point in self.points if not point.is_of_line and point.number not in self.of_pictures]


class Seen(NamedTuple):
    """What the passes saw of control points and at ties by hand."""

    evidence: Evidence
    rows: list[dict[str, Any]]
    """Sightings of control points as rows of their table."""
    unmeasured: list[Finding]
    """Findings on ties by hand."""


def solution_key(plan: SurveyPlan, manifest: Manifest) -> str:
    """Hash of all that the solution depends on: settings, code, readings, poses, control. It reads no reading."""
    config = AdjustConfig.of(plan.survey)
    picked = None if config.targets.picked is None else plan.survey.resolve(config.targets.picked)
    by_hand = [None if f is None or not f.is_file() else file_digest(f) for f in (picked, hand_file(plan.survey))]
    sources = [
        [s.key, *road_key(s), s.trajectory is not None, [f.digest for f in files]]
        for s, files in adjusted_sources(plan)
    ]
    beside = [
        [r.key, [f.digest for f in r.tables.get(table, ())]]
        for r in plan.records
        for table in ("control_points", "control_lines", "trajectory_accuracy")
        if r.tables.get(table)
    ]
    return key_of(
        code_digest(f"{__name__}:adjust_survey"), config.model_dump(mode="json"), runs_of(plan), sources, beside,
        [
            [name, s.lever_arm_sigma_m, s.boresight_sigma_deg, s.range_scale_sigma]
            for name, s in sorted(plan.survey.rig.sensors.items())
        ],
        sorted((name, sigma.tolist()) for name, sigma in calibrated_sigma(plan.store).items()),
        by_hand, sorted(foreign_runs(plan.store)), *pictures_key(plan, manifest),
    )  # fmt: skip


def is_current(plan: SurveyPlan, manifest: Manifest) -> bool:
    """True where nothing has changed since the last solution, and what it made is there."""
    return not why_due(plan, manifest)


def why_due(plan: SurveyPlan, manifest: Manifest) -> str:
    """Why the solution is due; empty where it is current."""
    record = manifest.get(ADJUSTMENT, SOLUTION)
    if not AdjustConfig.of(plan.survey).on:
        return "" if record is None else "switched off"
    if record is None or record.key != solution_key(plan, manifest):
        return MISSING if record is None else CHANGED
    parts = [r for name in (TIES, SIGHTINGS, RETURNS, SCORES, *TABLES, PICTURES) for r in manifest.of(name).values()]
    whole = all(manifest.is_current(r.product, r.unit, r.key) and _is_drawn(r) for r in parts)
    return "" if whole and record.figures()["table"] == digests_of(plan.store) else DAMAGED


def _is_drawn(record: OutputRecord) -> bool:
    """False of a picture that was left out for want of Matplotlib, which is there by now."""
    return record.key != NOT_DRAWN or not can_draw()


def withdraw(session: Session) -> None:
    """Remove the stage's products: the recorded poses are used."""
    manifest, plan = session.manifest, poses_plan_of(session)
    manifest.remove(
        [r for name in (TIES, SIGHTINGS, RETURNS, SCORES, *TABLES, PICTURES) for r in manifest.of(name).values()]
    )
    publish(session.store, {}, AdjustConfig.of(plan.survey))
    publish_mountings(session.store, None, AdjustConfig.of(plan.survey))
    publish_cameras(session.store, None)
    manifest.forget(ADJUSTMENT, [SOLUTION])


class _Collector:
    """Updates the evidence, round by round."""

    def __init__(self, session: Session, sources: Sources, priors: tuple[RunPrior, ...], mounted: Mounted) -> None:
        self.session, self.sources, self.priors, self.mounted = session, sources, priors, mounted
        self.runs = runs_of(poses_plan_of(session))
        self.work = plan_work(poses_plan_of(session), sources, priors)
        self.lacks = False
        """Whether some of the evidence failed."""
        self._seams = {place.number for task in self.work.ties for place in task.places if place.seam}
        self.of_heads, self._useless = self._heads()
        """Findings on heads that do not meet as they should."""
        plan = poses_plan_of(session)
        self._pictures = pictures_of(plan, session.manifest, self.runs, self.mounted, self.work.points, self._collect)
        tools = self.observe, self.load
        self.again = first_ties(plan, sources, self.work.ties, self.work.control, tools)

    def observe(self, tasks: Sequence[TieTask]) -> None:
        """Update ties."""
        self.lacks |= _collect_ties(self.session, tasks)

    def _collect(self, product: str, function: Callable[[Any], OutputRecord], tasks: Sequence[AskedOfPictures]) -> None:
        """Update what lidars say of pictures."""
        manifest = self.session.manifest
        due = [t for t in tasks if not manifest.is_current(product, t.unit, t.key)]
        ended = run_bundles(
            function, due, lambda t: sum(f.bytes for f in t.files), _BUNDLE_BYTES, manifest, self.session.compute,
            self.session.bar("lidar in pictures"),
        )  # fmt: skip
        self.session.failed("adjust", [(task.unit, reason) for task, reason in ended])
        self.lacks |= bool(ended)
        manifest.remove(manifest.beside([product], {t.unit for t in tasks}))

    def load(self, tasks: Sequence[TieTask]) -> KnownTies:
        """Returns ties that are up to date."""
        return self._loaded(tasks).of_seams(self._seams, COMMON_M)

    def _loaded(self, tasks: Sequence[TieTask]) -> KnownTies:
        return load_ties(self.session.store, self.session.manifest, tasks, self.runs, self.mounted)

    def _heads(self) -> tuple[list[Finding], frozenset[int]]:
        """Returns findings on heads of one pass where they meet, and runs whose heads are exchanged.

        A run in which heads meet otherwise than in the others gets separate mountings.
        """
        self.observe(self.work.ties)
        steps = steps_of(
            self._loaded(self.work.ties), AdjustConfig.of(poses_plan_of(self.session).survey).ties.return_s
        )
        swapped = exchanged(poses_plan_of(self.session), self.sources, steps)
        useless = {one.run for one, _ in swapped}
        odd = odd_steps([one for one in steps if one.run not in useless])
        if self.mounted.priors and odd:
            self.mounted = self.mounted.apart((one.run, head) for one, _ in odd for head in one.heads)
        return head_findings(swapped, odd), frozenset(map(self.runs.index, useless))

    def evidence(self, again: Again) -> Seen:
        """Returns all evidence, with what passes see of control points and at ends of ties by hand."""
        store, manifest, hand = self.session.store, self.session.manifest, self.work.hand
        self.lacks |= _collect_sightings(self.session, [*again.control, *hand.tasks])
        points, rows = load_sightings(store, manifest, again.control)
        ends, _ = load_sightings(store, manifest, hand.tasks)
        joined, unmeasured = with_hand_ties(again.ties, hand, ends, self.mounted, self.runs)
        wide = self.again.misplaced
        priors = tuple(p.widened(wide[p.run]) if p.run in wide else p for p in self.priors)
        evidence = Evidence(
            self.runs, priors, joined, tuple(points), self.mounted, self._useless, self._pictures, self.work.points,
            again.leans(self.work.tracks, self.runs),
        )  # fmt: skip
        return Seen(evidence, rows, unmeasured)

    def solve(self, again: Again) -> Solution:
        """Returns corrections of all runs."""
        return solve(poses_plan_of(self.session), self.evidence(again).evidence)


def adjust_survey(session: Session) -> None:
    """Collect what evidence is missing, solve, and publish the corrections, tables and pictures."""
    plan, manifest, config = poses_plan_of(session), session.manifest, AdjustConfig.of(poses_plan_of(session).survey)
    key = solution_key(plan, manifest)
    foreign = foreign_runs(session.store)
    sources = [pair for pair in adjusted_sources(plan) if pair[0].run not in foreign]
    mounted = mounted_of(plan, sources, foreign=bool(foreign))
    collector = _Collector(session, sources, priors_of(plan, sources, runs_of(plan)), mounted)
    work, again = collector.work, collector.again
    seen = collector.evidence(again)
    doubts = [
        CORRECTED_ELSEWHERE.finds(f"run '{run}'", "its poses were corrected by another program: they are not adjusted")
        for run in sorted(foreign)
    ]
    doubts += [*collector.of_heads, *again.findings, *work.hand.findings, *seen.unmeasured]
    evidence = seen.evidence
    pictured = evidence.pictures is not None and config.mode == "joint"
    if not (pictured or evidence.ties.accepted.any() or any(one.point.role == "gcp" for one in evidence.sightings)):
        lines = [f"nothing to adjust: {_no_ties(work)}, {_seen(work, evidence.sightings)}"]
        if asks_pictures(plan.survey):
            of_mode = f"; pictures take part in mode 'joint' alone, not in '{config.mode}'"
            lines[0] += of_mode if config.mode != "joint" else ", no tie point in pictures"
        held: Held = publish(session.store, {}, config)
        publish_mountings(session.store, None, config)
        publish_cameras(session.store, None)
        manifest.remove([r for name in (*TABLES, PICTURES) for r in manifest.of(name).values()])
        _forget_others(manifest, again, work)
        said = lines, [*doubts, *_of_points(work, evidence.sightings)]
        _keep(session, key, {}, said, failed=collector.lacks)
        return
    tools = collector.observe, collector.load, collector.solve
    again, solution, unsettled = settled(plan, sources, again, tools)
    seen = collector.evidence(again)
    evidence = seen.evidence
    _forget_others(manifest, again, work)
    held = publish(session.store, solution.corrections, config)
    changes = publish_mountings(session.store, solution.mountings, config)
    publish_cameras(session.store, solution.cameras)
    tables = _tables(evidence, solution, held, held_values(collector.mounted, changes), work.tracks)
    keep_tables(session.store, manifest, key, tables)
    shown, not_drawn = shown_seams(again.every, evidence, solution, (held, changes), session.compute)
    filmed = [] if solution.pictures is None else list(residuals_of(solution.pictures))
    keep_pictures(session.store, manifest, key, (_picture(plan, work, tables), shown, filmed), seen.rows)
    lines = [*_lines(work, again, evidence, solution, held, tables), *mounting_lines(solution.mountings), *not_drawn]
    doubts += lean_findings(leans(again.ties.columns, work.tracks, evidence.runs), evidence.runs)
    if solution.common is not None:
        lines += lidar_error_lines(solution.common, evidence.runs, collector.mounted)
        doubts += lidar_error_findings(solution.common, evidence.runs, collector.mounted)
    lines += picture_lines(solution.pictures, solution.cameras, solution.free)
    if config.mode in ("joint", "vertical"):
        doubts += failed_ties(evidence.ties, solution.tie_weight)
    doubts += [*solution.findings, *unsettled, *mounting_findings(solution.mountings)]
    doubts += [*picture_findings(solution.pictures), *camera_findings(solution.free)]
    doubts += _of_points(work, evidence.sightings)
    _keep(session, key, held, (lines, doubts), failed=collector.lacks)


def _tables(
    evidence: Evidence, solution: Solution, held: Held, added: Float64, tracks: Sequence[Track]
) -> dict[str, Rows]:
    """Returns rows of the tables of the outcome; added : (s, 6) corrections of the mountings."""
    points = control_rows(evidence, solution, held, added)
    return {
        "tie_residuals": tie_rows(evidence, solution, held, added),
        "control_residuals": points,
        "relative_accuracy": relative_rows(evidence, tracks, held, added),
        "absolute_accuracy": accuracy_rows(points, evidence, solution),
        "accuracy_by_distance": distance_rows(of_points(points, evidence), evidence, solution, tracks),
        **picture_rows(solution.pictures),
    }


def plan_work(plan: SurveyPlan, sources: Sources, priors: Sequence[RunPrior]) -> Work:
    """Returns tasks for the places where passes overlap and for the control points that they pass."""
    tracks = tracks_of(plan, sources)
    config = AdjustConfig.of(plan.survey)
    places = _places(tracks, config.places)
    points = control_points(plan)
    ties = tie_tasks(plan, sources, places, runs_of(plan), config.ties)
    control = control_tasks(plan, sources, tracks, points, priors)
    hand = hand_work(plan, sources, tracks, priors, len(points))
    plates = frozenset(one.number for one in points if config.targets.of_code(one.code).shape == "pictures")
    return Work(tuple(tracks), tuple(ties), tuple(control), tuple(points), hand, plates)


def _places(tracks: Sequence[Track], settings: PlaceSettings) -> list[Place]:
    """Returns places of dense sensors, those of lidars, which are larger, and the seams of heads, numbered through."""
    dense = places_of_overlap([t for t in tracks if t.ahead_m == 0.0], settings)
    ahead = settings.model_copy(update={"per_km": settings.lidar_per_km})
    sparse = places_of_overlap([t for t in tracks if t.ahead_m > 0.0], ahead)
    found = [*dense, *sparse, *seams(tracks, dense, settings)]
    return [replace(place, number=number) for number, place in enumerate(found)]


def _collect_ties(session: Session, tasks: Sequence[TieTask]) -> bool:
    """Update ties; returns True where some failed."""
    manifest = session.manifest
    due = [t for t in tasks if not manifest.is_current(TIES, t.unit, t.key)]
    ended = run_bundles(
        collect_ties, due, lambda t: t.bytes, _BUNDLE_BYTES, manifest, session.compute, session.bar("ties")
    )
    failed = [(task.unit, reason) for task, reason in ended]
    session.failed("adjust", failed)
    return bool(failed)


def _collect_sightings(session: Session, tasks: Sequence[ControlTask]) -> bool:
    """Update sightings of control points and of ends of ties by hand; returns True where some failed."""
    manifest = session.manifest
    due = [t for t in tasks if not manifest.is_current(SIGHTINGS, t.unit, t.key)]
    if not due:
        return False
    ended = run_bundles(
        sight_control, due, lambda _: 1, _BUNDLE_POINTS, manifest, session.compute, session.bar("control points")
    )
    failed = [(f"{task.unit} ({task.point.name})", reason) for task, reason in ended]
    session.failed("adjust", failed)
    return bool(failed)


def _forget_others(manifest: Manifest, again: Again, work: Work) -> None:
    """Remove evidence that is no longer needed."""
    manifest.remove(manifest.beside([TIES], {t.unit for t in again.every}))
    manifest.remove(manifest.beside([SIGHTINGS], {t.unit for t in (*again.control, *work.hand.tasks)}))


def _keep(session: Session, key: str, held: Held, said: tuple[list[str], list[Finding]], *, failed: bool) -> None:
    """Record the solution and its findings; one that lacks evidence is repeated by the next run."""
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
    """Returns why no tie counts."""
    places = sum(len(task.places) for task in work.ties)
    if not work.tracks:
        return "no readings with poses (points of a cloud are placed already)"
    return (
        f"no tie that counts at {places:,} places of overlap" if places else "no place where passes with poses overlap"
    )


def _seen(work: Work, sightings: Sequence[Sighting]) -> str:
    if not work.own_points:
        return "no control point"
    seen = len({one.point.number for one in sightings if one.status != "unseen" and not one.point.is_of_line})
    return f"{seen} of {len(work.own_points)} control points seen"


def _of_points(work: Work, sightings: Sequence[Sighting]) -> list[Finding]:
    """Returns findings on points that no pass saw, and on targets that are not as they should be."""
    found: list[Finding] = []
    points = work.own_points
    if points and not any(not task.point.is_of_line for task in work.control):
        text = f"not one of the {len(points)} control points lies where a pass drove: check crs of their [[control]]"
        found.append(CONTROL_PLACE.finds(CONTROL, text, left_out=len(points)))
    elif beside := _beside(work, sightings):
        text = (
            f"{len(beside)} of {len(points)} control points lie where no pass saw the road: {listed(beside, NAMED)}; "
            "they are of another stretch, or in another CRS"
        )
        found.append(CONTROL_PLACE.finds(CONTROL, text, left_out=len(beside)))
    return found + target_findings(sightings)


def _beside(work: Work, sightings: Sequence[Sighting]) -> list[str]:
    """Returns points that no pass saw, but for those of a lane beside the track, and their distance from the track."""
    seen = {one.point.number for one in sightings if one.status != "unseen"}
    unseen = [one for one in work.own_points if one.number not in seen]
    ways = np.concatenate([np.zeros((0, 2)), *(np.stack([t.easting_m, t.northing_m], axis=-1) for t in work.tracks)])
    away_m = [float(np.hypot(*(ways - [one.easting_m, one.northing_m]).T).min()) for one in unseen]
    return [
        f"{one.name} ({far:,.1f} m from the nearest track)"
        for one, far in zip(unseen, away_m, strict=True)
        if far > _LANE_BESIDE_M
    ]


def _lines(
    work: Work, again: Again, evidence: Evidence, solution: Solution, held: Held, tables: dict[str, Rows]
) -> list[str]:  # fmt: skip
    places, counted = sum(len(t.places) for t in work.ties), int((solution.tie_weight > 0).sum())
    lines = [
        f"{places:,} places of overlap with {evidence.ties.observations.size:,} ties, {counted:,} of which count; "
        f"{_seen(work, evidence.sightings)}"
    ]
    lines += [line for line in (lines_line(evidence.sightings), again.line()) if line]
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
    """Returns the accuracy after NSSDA, or that there are too few points for it."""
    if count < NSSDA_CHECK_POINTS:
        return f"of {count_of(count, 'point')} (NSSDA takes {NSSDA_CHECK_POINTS} at least)"
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
