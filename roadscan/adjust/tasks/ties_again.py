"""Ties that are measured again after the solution moved the passes, and larger patches before the first solution.

Poses of two passes may lie decimetres apart. Then the compared patches are not one place of the road: shifts are not
found, and heights are those of neighbouring spots. So places are measured again where the solution puts them until no
place moves by more than a share of its patch. Where too few match to begin with, larger patches are sought first. A
single larger patch may match at a wrong place: what counts is the shift that most patches of two passes agree on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.adjust.adjustment import MountingErrors
from roadscan.adjust.observations import MOUNTED
from roadscan.adjust.places import HEIGHT, SHIFT, Place, Shift, Track, Traverse
from roadscan.adjust.settings import AdjustConfig, AgainSettings, TieSettings
from roadscan.adjust.tasks.control_work import ControlTask, sighting_tasks
from roadscan.adjust.tasks.near import Sources
from roadscan.adjust.tasks.solution import Solution, priors_of
from roadscan.adjust.tasks.tie_work import KnownTies, TieTask, tie_tasks
from roadscan.adjust.tasks.tracks import runs_of
from roadscan.adjust.ties.plane import Lean, leans
from roadscan.compute.array_types import Bool, Float64
from roadscan.core.counted import counted
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.witness import Finding, Witness
from roadscan.georeference.plan.plan import SurveyPlan
from roadscan.georeference.sources import MountingChanges, change_of
from roadscan.poses.trajectory import Corrections, MountingChange

_STILL: Final[Shift] = (0.0, 0.0, 0.0)  # No shift (m).
_UNCHANGED: Final = MountingChange.of(np.zeros(len(MOUNTED)))
_REMOUNTED_M: Final = 0.01
"""A mounting is off by much where it moves a point so far (m) that lies `adjust.moved_arm_m` away: returns of a lidar
from before and from behind a place then lie farther apart than their noise, and a height is not the mean of both."""
_CHANGE_STEPS: Final = (0.001, 0.0001, 0.0001)
"""Steps to which a lever arm (m), a turn (rad) and a scale are rounded, for the same reason as shifts."""
_STEP_M: Final = 0.001
"""Step to which shifts are rounded (m), so that smaller changes of a solution keep the evidence."""


TIES_SETTLED: Final = Witness(
    "ties_settled",
    input="ties",
    fault="Ties that are observed where the solution says move the solution again, and again.",
    asks="how far the last solution moves each place since it was observed",
    does="the last solution is published",
    told=("findings",),
)

RUNS_APART: Final = Witness(
    "runs_apart",
    input="trajectories",
    fault="The poses of a pass lie decimetres from those of other passes over the same road.",
    asks="larger patches of the road, each 100 m: the shift that most of them agree on",
    does="ties are observed again where the solution puts the passes; σ of a run that most others contradict, or of "
    "both where nothing tells which is wrong, is taken to be as large as the shift",
    told=("findings",),
)
_APART: Final = 4.0
"""Two passes this many σ apart contradict their σ: one of 16,000 does by chance."""

Observe = Callable[[Sequence[TieTask]], None]
"""Function that updates the ties of some tasks."""
Load = Callable[[Sequence[TieTask]], KnownTies]
"""Function that returns ties of tasks that are up to date."""


@dataclass(frozen=True)
class Again:
    """Tasks of all rounds, and the shifts with which places were measured last."""

    tasks: tuple[TieTask, ...]
    """Tasks of all rounds, in order."""
    ties: KnownTies
    """Ties that count, with larger patches where these are needed."""
    larger: tuple[TieTask, ...] = ()
    """Tasks of larger patches."""
    control: tuple[ControlTask, ...] = ()
    """Tasks of control points, of all rounds."""
    far: KnownTies | None = None
    """Ties of the larger patches."""
    shifts: Mapping[int, tuple[Shift, ...]] = field(default_factory=dict)
    """Shifts of the traverses of each place that was measured again, by its number."""
    counts: tuple[int, ...] = ()
    """Number of places that were measured again, for each round."""
    changes: MountingChanges = field(default_factory=dict)
    """Changes of mountings with which ties and control points were measured last."""
    misplaced: Mapping[str, Float64] = field(default_factory=dict)
    """Runs that lie so far (3,; m) from others that their σ exclude it."""
    findings: tuple[Finding, ...] = ()
    """Findings on these."""

    def leans(self, tracks: Sequence[Track], runs: Sequence[str]) -> tuple[Lean, ...]:
        """Returns the leans of walls by run and lidar, in the stated mountings."""
        found = []
        for one in leans(self.ties.columns, tracks, runs):
            change = change_of(self.changes, runs[one.run], one.sensor)
            # A roll that was added to the mounting has straightened the walls by as much.
            found.append(one if change is None else one._replace(roll_rad=one.roll_rad - change.turn_rad[0]))
        return tuple(found)

    @property
    def every(self) -> tuple[TieTask, ...]:
        """Returns all tasks."""
        return (*self.tasks, *self.larger)

    def places(self) -> list[Place]:
        """Returns each place, as it was measured first."""
        return [place for task in self.tasks if task.round == 0 for place in task.places]

    def line(self) -> str:
        """Returns the rounds in words; "" where nothing was measured again."""
        told = f"ties observed again where the solution puts the passes: {', then '.join(map(str, self.counts))} places"
        told += ", with the mountings that were found, and so is control" if self.changes else ""
        return told if self.counts else ""


Solve = Callable[[Again], Solution]
"""Function that returns the solution of ties and of sightings of control points, whose tasks it updates first."""


def first_ties(
    plan: SurveyPlan,
    sources: Sources,
    tasks: Sequence[TieTask],
    control: Sequence[ControlTask],
    tools: tuple[Observe, Load],
) -> Again:
    """Returns ties in the recorded poses, and of larger patches where these agree that passes lie elsewhere."""
    observe, load = tools
    observe(tasks)
    ties = load(tasks)
    larger = _larger_patches(plan, sources, tasks, ties)
    if not larger:
        return Again(tuple(tasks), ties, control=tuple(control))
    observe(larger)
    far = load(larger)
    kept, apart = _agreed(far, ties, AdjustConfig.of(plan.survey), _sigmas(plan, sources))
    wrong_m, findings = _contradicted(plan, sources, ties, apart)
    # Matches of passes that lie apart are not of one place of the road.
    joined = ties.refused(_of_pairs(ties, apart)).with_more(far, kept)
    return Again(tuple(tasks), joined, tuple(larger), tuple(control), far, misplaced=wrong_m, findings=tuple(findings))


def settled(
    plan: SurveyPlan, sources: Sources, again: Again, tools: tuple[Observe, Load, Solve]
) -> tuple[Again, Solution, list[Finding]]:
    """Returns the solution that agrees with the positions of its ties, and what was measured for it."""
    config, (observe, load, solve) = AdjustConfig.of(plan.survey), tools
    solution = solve(again)
    tied, findings = config.mode in ("joint", "vertical"), list[Finding]()
    while tied and config.again.rounds:
        changes = _changed(solution.mountings, again, config)
        more, shifts, largest_m = _places_again(plan, sources, again, solution.corrections, changes)
        if not more:
            break
        if len(again.counts) == config.again.rounds:
            turned = "" if changes is again.changes else ", and mountings,"
            text = (
                f"the solution still moves passes against one another by up to {1e3 * largest_m:.0f} mm{turned} at "
                f"{len(shifts)} places after ties were observed again {counted(config.again.rounds, 'time')} "
                "(adjust.again.rounds)"
            )
            findings.append(TIES_SETTLED.finds("adjust", text))
            break
        observe(more)
        tasks = (*again.tasks, *more)
        ties = load(tasks)
        joined = ties if again.far is None else _still_needed(plan, sources, ties, again.far)
        control = _points_again(plan, sources, again, solution.corrections, changes)
        again = replace(
            again, tasks=tasks, ties=joined, shifts={**again.shifts, **shifts}, counts=(*again.counts, len(shifts)),
            control=control, changes=changes,
        )  # fmt: skip
        solution = solve(again)
    return again, solution, findings


def _changed(found: MountingErrors | None, again: Again, config: AdjustConfig) -> MountingChanges:
    """Returns changes of the mountings with which ties and control are to be measured: those of the last measurement
    where no sensor is moved by much since then.
    """
    changes = {} if found is None else {sensor: one.rounded(_CHANGE_STEPS) for sensor, one in found.changes.items()}
    for sensor in {*changes, *again.changes}:
        now, before = (own.get(sensor, _UNCHANGED).values for own in (changes, again.changes))
        if MountingChange.of(now - before).moved_m(config.moved_arm_m) > _REMOUNTED_M:
            return changes
    return again.changes


def _larger_patches(plan: SurveyPlan, sources: Sources, tasks: Sequence[TieTask], ties: KnownTies) -> list[TieTask]:
    """Returns tasks for larger patches of all pairs of runs that share places; numbering of their places continues."""
    config, runs = AdjustConfig.of(plan.survey), runs_of(plan)
    known = {place.number: place for task in tasks for place in task.places}
    first, found = 1 + max(known, default=-1), list[Place]()
    sought = config.again.rounds and config.mode in ("joint", "vertical")
    for pair, numbers in places_of_pairs(ties.tried).items() if sought else ():
        places = [known[number] for number in numbers if known[number].radius_m == config.places.radius_m]
        for place in _spread(places, config):
            own = _of_pair(place, (runs.index(pair[0]), runs.index(pair[1])))
            if len(own) == 2:
                reach_m = config.again.radius_m + config.again.search_m
                wide = tuple(_widened(t, reach_m / (place.radius_m + config.places.margin_m), config) for t in own)
                found.append(replace(place, number=first + len(found), radius_m=config.again.radius_m, traverses=wide))
    return tie_tasks(plan, sources, found, runs, _larger(config)) if found else []


def _larger(config: AdjustConfig) -> TieSettings:
    """Returns settings for larger patches: coarser, farther apart, with σ of centimetres."""
    own = config.again
    return config.ties.model_copy(update={
        "cell_m": own.cell_m, "shift_cell_m": own.cell_m, "search_m": own.search_m, "most_apart_m": own.search_m,
        "misplaced_m": own.search_m, "most_scatter_m": own.cell_m, "most_shift_sigma_m": own.cell_m,
        "shift_floor_m": own.cell_m / 4, "sigma_floor_m": own.cell_m / 40,
    })  # fmt: skip


def _spread(places: Sequence[Place], config: AdjustConfig) -> list[Place]:
    """Returns some of the places, about evenly along the road."""
    wanted = max(config.again.least, round(len(places) * 1000.0 / config.places.per_km / config.again.each_m))
    rows = np.unique(np.linspace(0, len(places) - 1, min(wanted, len(places))).round().astype(np.int64))
    return [places[k] for k in rows.tolist()]


def _of_pair(place: Place, runs: tuple[int, int]) -> list[Traverse]:
    """Returns a traverse of each of two runs; the first and the last one of a run that passes again."""
    first = next((t for t in place.traverses if t.run == runs[0]), None)
    last = next((t for t in reversed(place.traverses) if t.run == runs[1]), None)
    return [] if first is None or last is None or first is last else [first, last]


def _widened(traverse: Traverse, times: float, config: AdjustConfig) -> Traverse:
    """Returns the same over so many times its length, and no longer than a place may take."""
    middle = (traverse.first_gps_ns + traverse.last_gps_ns) // 2
    half = 0.5 * min(times * (traverse.last_gps_ns - traverse.first_gps_ns), config.places.longest_s * NS_PER_S)
    return replace(traverse, first_gps_ns=middle - round(half), last_gps_ns=middle + round(half))


def _contradicted(
    plan: SurveyPlan, sources: Sources, ties: KnownTies, apart: Mapping[tuple[str, str], Float64]
) -> tuple[dict[str, Float64], list[Finding]]:
    """Returns runs that lie farther from others than their σ allow, by how much (3,), and findings on them."""
    runs, config = runs_of(plan), AdjustConfig.of(plan.survey)
    sigma = _sigmas(plan, sources)
    found = misplaced(runs, places_of_pairs(ties.tried).keys() - apart.keys(), apart, config.fixed)
    wrong, said = dict[str, Float64](), dict[tuple[str, ...], list[str]]()
    for pair, shift in sorted(apart.items()):
        ratio = np.abs(shift) / np.hypot(*(np.maximum(sigma[run], 1e-6) for run in pair))
        own = tuple(run for run in pair if run in found)
        if ratio.max() <= _APART or not own:
            continue
        for run in own:
            # A position that is off in one component is not to be trusted in the others.
            wrong[run] = np.full(3, max(float(found[run].max()), *wrong.get(run, np.zeros(3))))
        other, (north, east, down) = (pair[0], shift) if own[-1] == pair[1] else (pair[1], -shift)
        said.setdefault(own, []).append(
            f"{north:+.2f} m north, {east:+.2f} m east and {-down:+.2f} m up from {other} ({ratio.max():.0f} σ)"
        )
    return wrong, [_apart_finding(own, told) for own, told in said.items()]


def _apart_finding(runs: tuple[str, ...], told: Sequence[str]) -> Finding:
    doubt = "" if len(runs) == 1 else "; nothing tells which of both is wrong"
    text = (
        f"where the road matches, it lies {', '.join(told)}{doubt}. σ of {' and '.join(runs)} is taken to be as large, "
        "and ties are observed again where the solution puts the passes"
    )
    return RUNS_APART.finds(f"run '{runs[-1]}'", text)


def _sigmas(plan: SurveyPlan, sources: Sources) -> dict[str, Float64]:
    """Returns the usual 1 σ (3,) of the recorded positions of each run, north, east, down."""
    return {one.run: one.sigmas[:3] for one in priors_of(plan, sources, runs_of(plan))}


def _still_needed(plan: SurveyPlan, sources: Sources, ties: KnownTies, larger: KnownTies) -> KnownTies:
    """Returns the ties, and those of larger patches of pairs of runs that still do not match."""
    kept, apart = _agreed(larger, ties, AdjustConfig.of(plan.survey), _sigmas(plan, sources))
    return ties.with_more(larger, kept & _of_pairs(larger, [p for p in apart if not is_matched(ties.tried, p)]))


def _agreed(
    larger: KnownTies, ties: KnownTies, config: AdjustConfig, sigmas: Mapping[str, Float64]
) -> tuple[Bool, dict[tuple[str, str], Float64]]:
    """Returns a mask (n,) of the ties of larger patches that count, and by pair of runs their agreed shift."""
    tried, kept, apart = larger.tried, np.zeros(larger.observations.size, np.bool_), dict[tuple[str, str], Float64]()
    measured = np.isfinite(tried["value_m"].astype(np.float64)) & np.isfinite(tried["sigma_m"].astype(np.float64))
    for pair in places_of_pairs(tried):
        rows = np.flatnonzero((tried["first_run"] == pair[0]) & (tried["second_run"] == pair[1]) & measured)
        up_m = _APART * float(np.hypot(*(sigmas[run][2] for run in pair)))
        own = {name: values[rows] for name, values in tried.items()}
        of_pair = (ties.tried["first_run"] == pair[0]) & (ties.tried["second_run"] == pair[1])
        near = {name: values[of_pair] for name, values in ties.tried.items()}
        fits, shift = agreeing(own, near, config.again, config.ties, up_m)
        kept[np.searchsorted(np.flatnonzero(measured), rows[fits])] = True
        if fits.any():
            apart[pair] = shift
    return kept, apart


def _of_pairs(ties: KnownTies, pairs: Iterable[tuple[str, str]]) -> Bool:
    """Returns ties (n,) of some pairs of runs."""
    own = np.zeros(ties.observations.size, np.bool_)
    for first, second in pairs:
        own |= (ties.columns["first_run"] == first) & (ties.columns["second_run"] == second)
    return own


def _places_again(
    plan: SurveyPlan,
    sources: Sources,
    again: Again,
    corrections: Mapping[str, Corrections],
    changes: MountingChanges,
) -> tuple[list[TieTask], dict[int, tuple[Shift, ...]], float]:
    """Returns tasks for the places that a solution moves by too much since they were measured, or for all places where
    mountings changed; their shifts, and the largest move (m).
    """
    config, runs = AdjustConfig.of(plan.survey), runs_of(plan)
    chosen, shifts, largest_m = list[Place](), dict[int, tuple[Shift, ...]](), 0.0
    for place in again.places():
        own = tuple(_shift(corrections.get(runs[t.run]), t) for t in place.traverses)
        before = again.shifts.get(place.number, (_STILL,) * len(own))
        moved = np.array(own) - np.array(before)
        # Only the part along the patch counts: readings beside it are not compared, and those far above are refused.
        aside_m, above_m = _extent(moved[:, :2]), float(np.ptp(moved[:, 2]))
        far = aside_m > config.again.share * 2.0 * place.radius_m or above_m > 0.5 * config.ties.most_apart_m
        if far or changes is not again.changes:
            largest_m = max(largest_m, aside_m, above_m)
            reach_m = float(np.hypot(*np.array(own)[:, :2].T).max())
            times = 1.0 + reach_m / (place.radius_m + config.places.margin_m)
            chosen.append(replace(place, traverses=tuple(_widened(t, times, config) for t in place.traverses)))
            shifts[place.number] = own
    moves = [shifts[place.number] for place in chosen]
    number = len(again.counts) + 1
    return tie_tasks(plan, sources, chosen, runs, config.ties, (number, moves, changes)), shifts, largest_m


def _points_again(
    plan: SurveyPlan,
    sources: Sources,
    again: Again,
    corrections: Mapping[str, Corrections],
    changes: MountingChanges,
) -> tuple[ControlTask, ...]:
    """Returns tasks of control points, with those of points whose passes a solution moves by too much, and of all
    points where mountings changed.
    """
    config, runs = AdjustConfig.of(plan.survey), runs_of(plan)
    least_m, seen, moves = config.again.share * 2.0 * config.places.radius_m, [], []
    last = {task.point.number: task for task in again.control}
    for task in (one for one in again.control if one.round == 0):
        own = tuple(_shift(corrections.get(runs[one[0].run]), one[0]) for one in task.passes)
        before = last[task.point.number].shifts_m or (_STILL,) * len(own)
        moved_m = float(np.hypot(*(np.array(own)[:, :2] - np.array(before)[:, :2]).T).max())
        if changes is not again.changes or moved_m > least_m:
            times = 1.0 + float(np.hypot(*np.array(own)[:, :2].T).max()) / config.targets.search_m
            seen.append((task.point, [tuple(_widened(t, times, config) for t in one) for one in task.passes]))
            moves.append(own)
    priors, number = priors_of(plan, sources, runs), len(again.counts) + 1
    picked = {(runs[one[0].run], task.point.name): place for task in again.control for one, place in zip(
        task.passes, task.picked, strict=True) if place is not None}  # fmt: skip
    return (*again.control, *sighting_tasks(plan, sources, priors, seen, picked, (number, moves, changes)))


def _shift(corrections: Corrections | None, traverse: Traverse) -> Shift:
    if corrections is None:
        return _STILL
    middle = np.array([(traverse.first_gps_ns + traverse.last_gps_ns) // 2], np.int64)
    north, east, down = (_STEP_M * np.round(corrections.at(middle)[0][0] / _STEP_M)).tolist()
    return north, east, down


def _extent(moved: npt.NDArray[np.float64]) -> float:
    """Returns the largest distance between two of some points (n, 2)."""
    return float(np.hypot(*(moved[:, None] - moved[None]).T).max())


Column = Mapping[str, npt.NDArray[Any]]

_LEAST: Final = 3
"""Least number of patches that must agree: two agree by chance."""
_MOST: Final = 0.5
"""Share of the heights of two passes, and of the patches, that is most of them."""
_SIGMAS: Final = 3.0  # Differences within this many σ agree.
_ALIKE_M: Final = 0.02
"""Greatest difference of ties that agree, besides their σ (m): poses drift by this much, and chance matches by more."""
_ALONG: Final = 0.5
"""Cosine from which a direction shows a shift."""


def places_of_pairs(tried: Column) -> dict[tuple[str, str], list[int]]:
    """Returns places that two runs share, or two drives of one run, by the names of both."""
    heights = (tried["kind"] == HEIGHT) & ~_of_one_pass(tried)
    pairs = sorted(set(zip(tried["first_run"][heights].tolist(), tried["second_run"][heights].tolist(), strict=True)))
    return {
        (a, b): np.unique(tried["place"][heights & (tried["first_run"] == a) & (tried["second_run"] == b)]).tolist()
        for a, b in pairs
    }


def is_matched(tried: Column, pair: tuple[str, str]) -> bool:
    """Returns whether the heights of most places that two runs share could be compared."""
    own = (tried["first_run"] == pair[0]) & (tried["second_run"] == pair[1]) & ~_of_one_pass(tried)
    heights = tried["accepted"][own & (tried["kind"] == HEIGHT)]
    return bool(heights.size and (heights == 1).mean() >= _MOST)


def _of_one_pass(tried: Column) -> Bool:
    """Returns a mask of comparisons of heads that passed together."""
    same = tried["first_run"] == tried["second_run"]
    apart = np.abs(tried["first_epoch_gps_ns"] - tried["second_epoch_gps_ns"])
    return np.asarray(same & (apart < 30_000_000_000))


def agreeing(
    tried: Column, near: Column, settings: AgainSettings, fine: TieSettings, most_up_m: float
) -> tuple[Bool, Float64]:
    """Returns a mask (n,) of the larger patches that agree on a shift which ties did not find, and that shift (3,).

    The shift is the second run's place minus the first one's: north, east, down (m).

    Parameters
    ----------
    near : ties of the same runs. Where passes lie apart, these match at odd places; if they agree on another shift,
        the larger patches are wrong, because of marks that repeat.
    most_up_m : passes that lie farther above one another than this contradict the σ of their poses.
    """
    counts = tried["accepted"] == 1
    shift = np.zeros(3)
    kept = _agreeing_shifts(tried, counts & (tried["kind"] == SHIFT), settings.alike_m)
    if kept.any():
        shift[:2] = _solved(tried, np.flatnonzero(kept))
        # Relief that contradicts paint counts as well: one of the two matched at a wrong place.
        every = (tried["kind"] == SHIFT) & np.isfinite(tried["value_m"])
        if not _is_supported(tried, kept, every, shift[:2]) or _is_contradicted(near, shift[:2], settings.alike_m):
            kept[:], shift[:2] = False, 0.0
    heights = np.flatnonzero(counts & (tried["kind"] == HEIGHT))
    level = float(np.median(tried["value_m"][heights])) if heights.size >= _LEAST else 0.0
    alike = np.zeros(counts.size, np.bool_)
    alike[heights] = np.abs(tried["value_m"][heights] - level) <= settings.alike_m
    if alike.sum() > _MOST * heights.size:
        shift[2] = -level
    is_far = np.hypot(*shift[:2]) > fine.search_m or abs(shift[2]) > max(most_up_m, settings.alike_m)
    return ((kept | alike), shift) if is_far else (np.zeros(counts.size, np.bool_), np.zeros(3))


def misplaced(runs: Sequence[str], close: Iterable[tuple[str, str]], far: Mapping[tuple[str, str], Float64],
              held: Sequence[str]) -> dict[str, Float64]:  # fmt: skip
    """Returns how far (3,) runs lie from those with which most agree, by name; all of them where none are most.

    Parameters
    ----------
    close : pairs of runs that match. far : shifts of pairs that do not.
    held : runs that are right in any case.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    number = {run: k for k, run in enumerate(runs)}
    pairs = np.array([(number[a], number[b]) for a, b in close], np.int64).reshape(-1, 2)
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(runs), len(runs)))
    group = connected_components(graph, directed=False)[1]
    in_far = sorted({run for pair in far for run in pair})
    sizes = {g: int((group == g).sum()) for g in {int(group[number[run]]) for run in in_far}}
    right = {int(group[number[run]]) for run in held}
    if not right & sizes.keys():
        most = max(sizes.values(), default=0)
        right = {g for g, size in sizes.items() if size == most}
        right = right if len(right) == 1 else set()
    found: dict[str, Float64] = {}
    for pair, shift in far.items():
        for run in pair:
            if int(group[number[run]]) not in right and run not in held:
                found[run] = np.maximum(found.get(run, np.zeros(3)), np.abs(shift))
    return found


def _is_supported(tried: Column, kept: Bool, every: Bool, shift: Float64) -> bool:
    """Returns whether enough places show the shift along itself: most of a road shows only the shift across."""
    length = float(np.hypot(*shift))
    along = np.abs(_directions(tried, np.arange(kept.size)) @ shift) > _ALONG * length
    support, against = (np.unique(tried["place"][own & along]) for own in (kept, every & ~kept))
    return support.size >= _LEAST and support.size > np.setdiff1d(against, support).size


def _is_contradicted(near: Column, shift: Float64, alike_m: float) -> bool:
    """Returns whether ties agree on another shift along the same direction."""
    rows = np.flatnonzero((near["accepted"] == 1) & (near["kind"] == SHIFT))
    directions = _directions(near, rows)
    along = directions @ shift / max(float(np.hypot(*shift)), 1e-9)
    rows, along = rows[np.abs(along) > _ALONG], along[np.abs(along) > _ALONG]
    if np.unique(near["place"][rows]).size < _LEAST:
        return False
    values = near["value_m"][rows] * np.sign(along)
    level = float(np.median(values))
    agree = np.abs(values - level) <= _ALIKE_M + _SIGMAS * near["sigma_m"][rows]
    elsewhere = np.abs(values - np.abs(along) * float(np.hypot(*shift))) > alike_m
    return bool((agree & elsewhere).sum() > _MOST * rows.size)


def _agreeing_shifts(tried: Column, own: Bool, alike_m: float) -> Bool:
    """Returns rows of the places that agree on one shift, none where those are few, or fewer than half of all."""
    places = tried["place"]
    numbers, best = np.unique(places[own]), np.zeros(own.size, np.bool_)
    for number in numbers:
        rows = np.flatnonzero(own & (places == number))
        if np.linalg.matrix_rank(_directions(tried, rows), tol=0.5) < 2:
            continue
        shift = _solved(tried, rows)
        away = np.abs(tried["value_m"] - _directions(tried, np.arange(own.size)) @ shift)
        fits = own & (away <= alike_m + _SIGMAS * np.where(own, tried["sigma_m"], 0.0))
        if np.unique(places[fits]).size > np.unique(places[best]).size:
            best = fits
    count = np.unique(places[best]).size
    return best if count >= _LEAST and count > _MOST * numbers.size else np.zeros(own.size, np.bool_)


def _directions(tried: Column, rows: npt.NDArray[np.int64]) -> Float64:
    return np.stack([tried["direction_north"][rows], tried["direction_east"][rows]], axis=-1)


def _solved(tried: Column, rows: npt.NDArray[np.int64]) -> Float64:
    """Returns the shift (2,) north, east of rows that all agree."""
    sigma = tried["sigma_m"][rows]
    design = _directions(tried, rows) / sigma[:, None]
    return np.asarray(np.linalg.lstsq(design, tried["value_m"][rows] / sigma, rcond=None)[0])
