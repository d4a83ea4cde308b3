"""Findings of an adjustment: on control points, on runs, on stated σ and on the solution itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from roadscan.adjust.control import NAMED, Sighting, WrongPoint, swapped
from roadscan.adjust.control_test import COMPONENTS, HEIGHT, PLACE, AppliedOffset, ControlVerdict, PlaneShift
from roadscan.adjust.observations import RunPrior
from roadscan.adjust.unknowns import FixedRun
from roadscan.compute.array_types import Float64, Int64
from roadscan.core.counted import listed
from roadscan.core.witness import Finding, Witness

CONTROL: Final = "control"
"""Subject of what concerns many points."""

CONTROL_POINT: Final = Witness(
    "control_point",
    input="control points",
    fault="The surveyed height or place of a point is wrong, or two points are exchanged.",
    asks="poses, ties and all other points: the normalised leave-one-out residual of the point against the quantile of "
    "adjust.control.false_alarm",
    does="its height, or its place, does not count, in the adjustment and in the printed RMSE; where two points "
    "contradict each other and nothing tells which is wrong, neither counts",
    told=("findings",),
)
CONTROL_DATUM: Final = Witness(
    "control_datum",
    input="control points",
    fault="All control is off together: another datum, geoid, CRS or antenna height.",
    asks="the poses, whose σ and correlation time say how well they know the mean height and place of a drive; where "
    "heights alone are compared, the slopes of the road",
    does="control that is off by more than adjust.control.largest_m is not used; for less, adjust.control.datum_offset "
    "says whether it is followed, with an σ that holds the offset, or whether the offset is estimated",
    told=("findings",),
)
CONTROL_PLACE: Final = Witness(
    "control_place",
    input="control points",
    fault="A point lies where no pass drove: it is of another stretch, or in another CRS.",
    asks="the way of each sensor and the strip of road that it sees",
    does="it is not used",
    told=("findings",),
)
CONTROL_TARGET: Final = Witness(
    "control_target",
    input="control points",
    fault="The painted target is not there, is there twice, or lies elsewhere than surveyed.",
    asks="the intensities of each pass that saw the road there",
    does="a target that lies elsewhere is measured where it lies; of one that is there twice nothing is used; where "
    "none is found, the height at the surveyed place is used",
    told=("findings",),
)
CORRECTED_ELSEWHERE: Final = Witness(
    "corrected_elsewhere",
    input="corrections",
    fault="The poses of a run were corrected by another program.",
    asks="the column written_by of the table corrections",
    does="the run is not adjusted, and its corrections stay",
    told=("findings",),
)
RUN_NOT_HELD: Final = Witness(
    "run_not_held",
    input="runs",
    fault="Nothing holds a run: it has no control that counts, and no tie joins it to a run that has.",
    asks="ties that count, as links between runs, and control that counts",
    does="its poses keep their errors, and its σ is that of the poses",
    told=("findings",),
)
SOLUTION_SETTLED: Final = Witness(
    "solution_settled",
    input="adjustment",
    fault="Observations contradict one another so that no set of weights holds.",
    asks="the change of the weights in the last round",
    does="the solution of the last round is published",
    told=("findings",),
)
STATED_SIGMA: Final = Witness(
    "stated_sigma",
    input="trajectories, control points",
    fault="A stated σ of poses or of observations is much too small.",
    asks="residuals against their σ: variance factors of each kind of observation, of each component of the poses, and "
    "of the poses of each run",
    does="variance factors are estimated, and weights and published σ follow them",
    told=("findings",),
)
HELMERT_TURN: Final = Witness(
    "helmert_turn",
    input="control points",
    fault="The points of a Helmert transformation lie along a line, and do not determine its turn about it.",
    asks="σ of the transformation at the edges of the road, against that of the poses",
    does="the transformation is applied, and the published σ holds that of its turn",
    told=("findings",),
)

_UNDERSTATED: Final = 3.0
"""Variance factor from which a stated σ is reported as too small: 1.7 times."""
_OPEN_M: Final = 1.0
"""An offset of larger σ (m) is not known: that along surveyed lines, which do not bind along them."""
_WORDS: Final = {
    "height_tie": "heights of one pass against another",
    "shift_tie": "shifts of one pass against another",
    "plane_tie": "distances of planes of two passes",
    "head_tie": "heights of one head against another of the same pass",
    "hand_tie": "ties by hand",
    "control_height": "heights measured at control points",
    "control_position": "places measured at control points",
    "picture_tie": "tie points in pictures",
    "picture_control": "control points in pictures",
    "picture_depth": "distances of tie points in pictures from surfaces of the lidar",
    "control_survey": "the survey of the control points",
    "north_m": "the poses, north",
    "east_m": "the poses, east",
    "down_m": "the poses, height",
    "roll_rad": "the poses, roll",
    "pitch_rad": "the poses, pitch",
    "heading_rad": "the poses, heading",
}


def wrong_points(wrong: Sequence[WrongPoint]) -> list[Finding]:
    """Returns findings on points that all other evidence contradicts, and on pairs whose heights look exchanged."""
    found = [CONTROL_POINT.finds(one.name, one.in_words(), left_out=1 + len(one.alternatives)) for one in wrong]
    return found + exchanged(wrong)


def exchanged(points: Sequence[WrongPoint]) -> list[Finding]:
    """Returns findings on pairs of points whose heights look exchanged."""
    return [
        CONTROL_POINT.finds(CONTROL, f"the heights of {one} and {other} look exchanged")
        for one, other in swapped(points)
    ]


def far_points(far: Mapping[str, float]) -> list[Finding]:
    """Returns findings on points far above or below the road."""
    return [
        CONTROL_POINT.finds(
            name,
            f"its surveyed height lies {away:+.3f} m from the road that was measured; it is in another height datum or "
            "CRS, or under a bridge, and is not used",
            left_out=1,
        )
        for name, away in sorted(far.items())
    ]


def offset_findings(verdict: ControlVerdict, applied: AppliedOffset, points: int) -> list[Finding]:
    """Returns findings on control with a common offset, of no more than `largest_m`."""
    found = []
    for name in verdict.doubted:
        sigmas, sigma_m = verdict.offset.sigmas(name), verdict.offset.sigma_m(name)
        text = (
            f"the {name}s of the control lie {_offset(verdict, name)} from where the poses put them, all together "
            f"({sigmas:.1f} σ: the poses know it to {1e3 * sigma_m:.1f} mm); the datum of the control, or that of the "
            "poses, is wrong. "
        )
        if name in applied.refused:
            text += f"No {name} of the control is used"
        elif name in applied.estimated:
            text += (
                "The poses are followed: the offset is estimated, control gives the shape alone, and σ holds the "
                f"{1e3 * sigma_m:.1f} mm"
            )
        else:
            text += "The control is followed, and σ holds the offset"
        unused = points if name in (*applied.refused, *applied.estimated) else 0
        found.append(CONTROL_DATUM.finds(CONTROL, f"{text} (adjust.control.datum_offset)", left_out=unused))
    return found


def shift_findings(shift: PlaneShift, instead: str = "") -> list[Finding]:
    """Returns findings on control whose heights show that it lies elsewhere in the plane; instead : what else would."""
    if not shift.sigmas:
        return []
    north, east = 1e3 * shift.shift_m
    sigma = 1e3 * np.sqrt(np.diag(shift.covariance_m2))
    also = f"; {instead} would explain them as well, and nothing tells which it is" if instead else ""
    return [
        CONTROL_DATUM.finds(
            CONTROL, f"heights on slopes tell that the control lies {north:+.0f} mm north (σ {sigma[0]:.0f} mm) and "
            f"{east:+.0f} mm east (σ {sigma[1]:.0f} mm) of the road that it was surveyed on ({shift.sigmas:.1f} σ); "
            f"its heights are compared there, and σ holds what is not known of the shift{also}",
        )
    ]  # fmt: skip


def run_findings(runs: Sequence[str], factors: Float64) -> list[Finding]:
    """Returns findings on runs whose poses are worse than their σ; factors : (runs, 6) of the stated variances."""
    found = []
    for run, own in zip(runs, factors, strict=True):
        words = [
            f"{name} is {np.sqrt(own[k]):.1f} times too small"
            for name, k in (("position", 0), ("attitude", 3))
            if own[k] > 1.0
        ]
        if words:
            found.append(
                STATED_SIGMA.finds(
                    f"run '{run}'", f"by ties and control, the stated σ of the {' and of the '.join(words)}; the poses "
                    "of this run count with the larger one",
                )
            )  # fmt: skip
    return found


def offset_line(verdict: ControlVerdict, applied: AppliedOffset) -> str:
    """Returns how well control and poses agree as a whole, and the least detectable offset; "" without control."""
    known = datum_figures(verdict, applied)
    parts = [
        f"{_offset(verdict, name)} ± {1e3 * verdict.offset.sigma_m(name):.1f} mm in {name} (an offset is found four "
        f"times of five from {1e3 * verdict.detectable_m[name]:.0f} mm on; σ of the tiles is against the control, of "
        f"which the poses confirm the datum to {1e3 * known[name][1]:.0f} mm)"
        for name in (HEIGHT, PLACE)
        if name in known and verdict.offset.sigma_m(name) < _OPEN_M
    ]
    return f"control against the poses as a whole: {', '.join(parts)}" if parts else ""


def datum_figures(verdict: ControlVerdict, applied: AppliedOffset) -> dict[str, tuple[float, float]]:
    """Returns poses minus control as a whole (m; of a place its length), and 1 σ (m) of the datum, by known component.

    The mean square of an offset that nobody knew before is the sum of the squares of its size and of the poses' σ.
    Where the poses are followed, or the control is not used, 1 σ is that of the poses alone.
    """
    found = {}
    for name, axes in COMPONENTS.items():
        sigma = verdict.offset.sigma_m(name)
        if np.isfinite(sigma):
            offset = verdict.offset.offset_m[list(axes)]
            size = float(offset[0]) if name == HEIGHT else float(np.hypot(*offset))
            by_poses = name in (*applied.estimated, *applied.refused)
            found[name] = size, sigma if by_poses else float(np.hypot(size, sigma))
    return found


def _offset(verdict: ControlVerdict, component: str) -> str:
    north, east, down = verdict.offset.offset_m * 1e3
    return f"{-down:+.1f} mm" if component == HEIGHT else f"{north:+.1f} mm north and {east:+.1f} mm east"


def power_line(verdict: ControlVerdict, sigma_m: Sequence[float]) -> str:
    """Returns the least detectable error of a single point's height; "" without control."""
    known = np.array([s for s in sigma_m if np.isfinite(s)])
    if not known.size or not np.isfinite(verdict.limit_point):
        return ""
    middle, largest = (1e3 * float(s) * (verdict.limit_point + 0.8416) for s in (np.median(known), known.max()))
    return (
        f"a wrong height of one GCP is named from {verdict.limit_point:.1f} σ on: four times of five where it is "
        f"{middle:.0f} mm (at the point that is known worst {largest:.0f} mm)"
    )


def not_held(runs: Sequence[str], moving: Sequence[int], links: Int64, held: set[int]) -> list[Finding]:
    """Returns findings on runs that neither control nor ties to a run with control determine.

    Parameters
    ----------
    moving : numbers of the runs that are adjusted.
    links : (n, 2) pairs of runs that ties join.
    held : runs with control that counts.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    size = len(runs)
    graph = coo_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(size, size))
    group = connected_components(graph, directed=False)[1]
    good = {int(group[k]) for k in held}
    if not good:
        # Without any control the largest group of runs is the reference.
        sizes = [(-int(sum(group[k] == g for k in moving)), int(g)) for g in np.unique(group[list(moving)])]
        if len(sizes) < 2 or not len(links):
            return []
        good = {min(sizes)[1]}
    found = []
    for k in moving:
        if int(group[k]) not in good:
            others = [runs[j] for j in moving if j != k and group[j] == group[k]]
            tied = "no tie holds it"
            if others:
                tied = f"it is tied to {listed(others, NAMED)} alone, which no control holds either"
            told = "no control point that counts lies on its way, and " if held else ""
            found.append(
                RUN_NOT_HELD.finds(
                    f"run '{runs[k]}'", f"{told}{tied}: its poses keep the errors that all of them have in common"
                )
            )
    return found


def solver_findings(factors: Mapping[str, float], rounds: int, *, settled: bool) -> list[Finding]:
    """Returns findings on the solution and on stated σ."""
    found = []
    if not settled:
        found.append(
            SOLUTION_SETTLED.finds(
                "adjust", f"weights still changed after {rounds} rounds: observations contradict one another, and the "
                "solution of the last round is published",
            )
        )  # fmt: skip
    for name, factor in factors.items():
        if factor > _UNDERSTATED:
            found.append(
                STATED_SIGMA.finds(
                    "adjust", f"the stated σ of {_WORDS[name]} is {np.sqrt(factor):.1f} times too small (variance "
                    f"factor {factor:.1f}); weights and published σ are those of the larger one",
                )
            )  # fmt: skip
    return found


def solver_line(factors: Mapping[str, float], rounds: int, *, settled: bool) -> str:
    """Returns whether the solution settled, and the variance factors that are not 1."""
    told = [f"{_WORDS[name]} {factor:.2f}" for name, factor in factors.items() if factor != 1.0]
    end = f"settled after {rounds} rounds" if settled else f"not settled after {rounds} rounds"
    return f"solution {end}; variance factors: {', '.join(told) if told else 'as stated'}"


def time_line(stated: Sequence[RunPrior], used: Sequence[RunPrior]) -> str:
    """Returns correlation times that replaced those of the settings, '' where none did."""
    words = []
    for name, component in (("position", 0), ("attitude", 3)):
        pairs = {(a.taus_s[component], b.taus_s[component]) for a, b in zip(stated, used, strict=True)}
        changed = sorted(pair for pair in pairs if pair[0] != pair[1])
        words += [f"of {name} over {b:g} s in place of {a:g} s (adjust.priors.{name}_time_s)" for a, b in changed]
    return f"errors of the poses vary faster than assumed: {', '.join(words)}; their σ is as stated" if words else ""


def target_findings(sightings: Sequence[Sighting]) -> list[Finding]:
    """Returns findings on targets that are not as they should be."""
    found = []
    for status, words in (
        ("missed", "targets were not found, and the height at the surveyed place is used"),
        ("doubled", "targets are there more than once, and nothing of them is used"),
        ("moved", "targets lie elsewhere than surveyed, and are measured where they lie"),
    ):
        own = [one for one in sightings if one.status == status and not one.point.is_of_line]
        if own:
            told = [f"{one.point.name} in {one.sensor}: {one.why_not}" for one in own]
            unused = len(own) if status == "doubled" else 0
            found.append(CONTROL_TARGET.finds(CONTROL, f"{len(own)} {words}: {listed(told, NAMED)}", left_out=unused))
    return found


FIXED_RUN: Final = Witness(
    "fixed_run",
    input="runs",
    fault="A run that is held fixed does not lie where its σ says.",
    asks="ties to other runs and control: the corrections that the run would have if it were not held, against the σ "
    "of its poses and the quantile of adjust.control.false_alarm",
    does="it is held all the same, other runs are adjusted to it, and their σ hold what contradicts it",
    told=("findings",),
)
_AXIS_WORDS: Final = {
    "north_m": "to the north", "east_m": "to the east", "down_m": "down", "roll_rad": "of roll",
    "pitch_rad": "of pitch", "heading_rad": "of heading",
}  # fmt: skip


def fixed_findings(fixed: Sequence[FixedRun], false_alarm: float) -> list[Finding]:
    """Returns findings on runs that are fixed though other evidence contradicts them."""
    found = []
    for one in fixed:
        off = one.contradicted(false_alarm)
        if off:
            told = ", ".join(
                f"{_size(name, error)} {_AXIS_WORDS[name]} ({sigmas:.1f} σ)" for name, error, sigmas in off
            )
            text = (
                f"it is held fixed, and other evidence puts its poses up to {told} from where they were recorded; "
                "other runs are adjusted to it, and their σ hold the difference"
            )
            found.append(FIXED_RUN.finds(f"run '{one.run}'", text))
    return found


def _size(component: str, value: float) -> str:
    return f"{1e3 * value:+.1f} mm" if component.endswith("_m") else f"{np.degrees(value):+.4f}°"


def fixed_line(fixed: Sequence[FixedRun]) -> str:
    """Returns which runs are fixed; "" where none is."""
    names = ", ".join(one.run for one in fixed)
    return f"held fixed, with poses as they were recorded: {names}" if fixed else ""
