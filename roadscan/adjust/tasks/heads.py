"""Heads of one pass where their strips meet: a test of the mounting of each head in every run.

Poses move both heads alike, so that what their heights differ by where both saw the road is theirs alone: the height,
the roll or the range scale of one of them, or the log of another one.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Final

import numpy as np

from roadscan.adjust.observations import KINDS
from roadscan.adjust.places import Place, Track, places_of_overlap
from roadscan.adjust.settings import AdjustConfig
from roadscan.adjust.swath import WHOLE
from roadscan.adjust.tasks.near import NearReader, Sources, near_files
from roadscan.adjust.tasks.tie_work import KnownTies, ties_of
from roadscan.adjust.tasks.tracks import runs_of, tracks_of
from roadscan.adjust.tie_settings import PlaceSettings
from roadscan.adjust.ties.at_place import Ties
from roadscan.adjust.ties.tie import HEIGHT
from roadscan.compute.array_types import Float64
from roadscan.compute.robust import scatter_about
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.witness import Finding, Witness
from roadscan.georeference.plan.plan import SurveyPlan
from roadscan.run.engine.fingerprint import key_of

_NARROW_M: Final = 0.03
"""Least overlap of the strips of two compared heads (m): a cell of 0.025 m, and some of the next."""
COMMON_M: Final = 1.5e-4
"""1 σ of the common error of all steps at a narrow seam (m): its cells are seen to their edge by one head alone, half a
cell of 0.025 m beside the other on a road that falls by 2.5 %, and less where readings are dense."""
_ODD: Final = 3.0
"""A step that differs from that of other runs by more than this many σ is reported."""
_LARGE_M: Final = 0.01
"""Steps larger than this (m) and three σ of the heads' mountings are tested for exchanged logs."""
_FALLS: Final = 3.0
"""Exchanged logs enlarge the step at least this many times."""
_TRIED: Final = 12
"""Places, spread over the run, at which that is tested."""

HEADS: Final = Witness(
    "heads_of_a_run",
    input="profiler",
    fault="The logs of two heads are exchanged, or the range scale or mounting of a head is another in one run.",
    asks="heights of heads of one pass where their strips meet, run by run, and with each log in the other's mounting",
    does="ties and control of a run whose logs are exchanged do not count; a run in which heads meet otherwise than in "
    "the others gets mountings of its own",
    told=("findings",),
)


def seams(tracks: Sequence[Track], dense: Sequence[Place], settings: PlaceSettings) -> list[Place]:
    """Returns places where heads of one pass meet in a strip that is too narrow for the other ties, `dense`."""
    known = {_pair(place) for place in dense if place.quality_only(settings.return_s)}
    found: list[Place] = []
    narrow = settings.model_copy(
        update={"per_km": settings.seams_per_km, "radius_m": settings.seam_radius_m, "least_overlap_m": _NARROW_M}
    )
    whole = [replace(t, left_m=WHOLE * t.left_m, right_m=WHOLE * t.right_m) for t in tracks if t.ahead_m == 0.0]
    for run in sorted({t.run for t in whole}):
        own = places_of_overlap([t for t in whole if t.run == run], narrow)
        found += [
            replace(one, seam=True) for one in own if one.quality_only(settings.return_s) and _pair(one) not in known
        ]
    return found


def _pair(place: Place) -> tuple[int, str, str]:
    """Returns run and sensors of heads that meet at a place."""
    return place.traverses[0].run, place.traverses[0].sensor, place.traverses[-1].sensor


@dataclass(frozen=True)
class Step:
    """Step between two heads of a run: the height of the second above the first."""

    run: str
    heads: tuple[str, str]
    step_m: float
    sigma_m: float
    places: int

    @classmethod
    def of(cls, run: str, heads: tuple[str, str], values_m: Float64) -> Step:
        """Returns the median over places."""
        middle = float(np.median(values_m))
        scatter = scatter_about(values_m, middle)
        return cls(run, heads, middle, float(np.hypot(COMMON_M, scatter / np.sqrt(values_m.size))), values_m.size)

    @property
    def told(self) -> str:
        """Returns the step in words."""
        return f"{1e3 * self.step_m:+.2f} mm (σ {1e3 * self.sigma_m:.2f} mm, {self.places} places)"


def steps_of(ties: KnownTies, return_s: float) -> list[Step]:
    """Returns a step for each pair of heads in each run, also from ties that failed a test."""
    column = ties.columns
    apart_s = np.abs(column["first_epoch_gps_ns"] - column["second_epoch_gps_ns"]) / NS_PER_S
    own = (column["kind"] == HEIGHT) & (column["first_run"] == column["second_run"]) & (apart_s < return_s)
    own &= column["first_sensor"] != column["second_sensor"]
    rows = sorted(
        (str(column["first_run"][k]), str(column["first_sensor"][k]), str(column["second_sensor"][k]), k)
        for k in np.flatnonzero(own).tolist()
    )
    return [
        Step.of(run, (one, other), ties.observations.observed_m[[k for *_, k in group]])
        for (run, one, other), group in groupby(rows, key=lambda row: row[:3])
    ]


def odd_steps(steps: Sequence[Step]) -> list[tuple[Step, Step]]:
    """Steps that differ from those of the other runs, and the usual one: the median, of two runs the smaller one."""
    found = []
    for _, group in groupby(sorted(steps, key=lambda one: (one.heads, one.run)), key=lambda one: one.heads):
        own = sorted(group, key=lambda one: (one.step_m, one.run))
        usual = own[(len(own) - 1) // 2] if len(own) > 2 else min(own, key=lambda one: abs(one.step_m))
        limit = [_ODD * float(np.hypot(one.sigma_m, usual.sigma_m)) for one in own]
        found += [(one, usual) for one, most in zip(own, limit, strict=True) if abs(one.step_m - usual.step_m) > most]
    return sorted(found, key=lambda pair: (pair[0].run, pair[0].heads))


def exchanged(plan: SurveyPlan, sources: Sources, steps: Sequence[Step]) -> list[tuple[Step, Step]]:
    """Returns pairs of heads whose logs are exchanged: their step, and the step left with exchanged mountings."""
    tried = [(one, _tried(plan, sources, one)) for one in steps if abs(one.step_m) > _LARGE_M]
    return [(one, other) for one, other in tried if other is not None]


def _tried(plan: SurveyPlan, sources: Sources, step: Step) -> Step | None:
    """Returns the step with the mountings exchanged; None where it is no smaller."""
    config, runs = AdjustConfig.of(plan.survey), runs_of(plan)
    (first, of_first), (second, of_second) = (
        next((s, files) for s, files in sources if (s.run, s.sensor) == (step.run, head)) for head in step.heads
    )
    swapped = [
        (replace(own, mountings=other.mountings, key=key_of(own.key, "mounted as", other.key)), files)
        for own, other, files in ((first, second, of_first), (second, first, of_second))
    ]
    places = seams(tracks_of(plan, swapped), [], config.places)
    places = places[:: max(1, -(-len(places) // _TRIED))]
    files = near_files(swapped, [t for place in places for t in place.traverses], runs)
    reader = NearReader(plan.store, plan.ground, files, runs)
    found = Ties.joined([ties_of(reader, place, config.ties) for place in places]).observations
    heights = found.observed_m[(found.kind == KINDS.index(HEIGHT)) & np.isfinite(found.observed_m)]
    if not heights.size:
        return None
    other = Step.of(step.run, step.heads, heights)
    vanishes = abs(other.step_m) < _LARGE_M and abs(other.step_m) * _FALLS < abs(step.step_m)
    return other if vanishes else None


def head_findings(swapped: Iterable[tuple[Step, Step]], odd: Iterable[tuple[Step, Step]]) -> list[Finding]:
    """Returns findings on heads that do not meet as they should."""
    found = [
        HEADS.finds(
            f"run '{one.run}'",
            f"the logs of {' and '.join(one.heads)} are exchanged: where the heads meet, heights differ by {one.told}, "
            f"and by {other.told} with each log in the other's mounting. Ties and control of this run do not count; "
            "exchange the two paths in the survey file",
        )
        for one, other in swapped
    ]
    return found + [
        HEADS.finds(
            f"run '{one.run}'",
            f"{one.heads[1]} lies {one.told} above {one.heads[0]} where the two meet, in run '{usual.run}' "
            f"{usual.told}: the range scale, the height or the roll of one of them is another in this run. Their "
            "mountings are estimated for this run by itself",
        )
        for one, usual in odd
    ]
