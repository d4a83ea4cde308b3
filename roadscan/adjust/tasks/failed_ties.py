"""Pairs of runs over the same road whose ties mostly fail: reasons and likely causes."""

from __future__ import annotations

from collections import Counter
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.adjust.tasks.tie_work import KnownTies
from roadscan.adjust.ties.tie import FEW_CELLS, HEIGHT, PLANE, SAME_PASS, SCATTERED, SHIFT, STEEP, TOO_FAR, TWO_SURFACES
from roadscan.compute.array_types import Float64
from roadscan.core.witness import Finding, Witness

TIES_FAIL: Final = Witness(
    "ties_fail",
    input="trajectories, rig file",
    fault="Two passes over the same road do not see the same surface there.",
    asks="the places that both saw: whether their heights (of lidars: planes) could be compared, and whether shifts "
    "and heights that were found agree with the solution",
    does="what fails does not count; where it is more than half of ten places or more, the pair of runs is named with "
    "the reasons",
    told=("findings",),
)
_LEAST: Final = 10
"""Least number of places, or shifts, of two runs for a statement about their share."""
_MOST: Final = 0.5  # Share of failed places, or of contradicted shifts, from which they are reported.
_REFUSED: Final = "contradicted by all other evidence"
_CAUSES: Final = {
    TOO_FAR: "the height of the poses of one of them, its lever arm or its geoid is wrong",
    TWO_SURFACES: "the passes lie apart horizontally, the surface was rebuilt between them, or a boresight is wrong",
    SCATTERED: "the passes lie apart horizontally, the surface was rebuilt between them, or readings of one are rough",
    STEEP: "a boresight is wrong, or what both saw is no road",
    _REFUSED: "a boresight or a lever arm is wrong, or the surface was rebuilt in part",
}


def failed_ties(ties: KnownTies, weight: Float64) -> list[Finding]:
    """Returns findings on pairs of runs.

    Parameters
    ----------
    weight : (t,) of each tie that could be measured.
    """
    tried, found = ties.tried, list[Finding]()
    runs = np.stack([tried["first_run"], tried["second_run"]])
    counting = (tried["why_not"] != SAME_PASS) & (tried["why_not"] != FEW_CELLS)
    refused = _refused(ties, weight)
    for pair in sorted({(a, b) for a, b in runs.T.tolist() if a != b}):
        own = (runs[0] == pair[0]) & (runs[1] == pair[1]) & counting
        places = _reasons(tried, own & np.isin(tried["kind"], (HEIGHT, PLANE)), refused)
        shifts = own & (tried["kind"] == SHIFT) & (tried["accepted"] == 1)
        contradicted = _number_refused(tried, shifts, refused)
        told = list[str]()
        failed = {reason: n for reason, n in Counter(places.values()).most_common() if reason}
        if len(places) >= _LEAST and sum(failed.values()) > _MOST * len(places):
            words = ", ".join(f"{n} × {reason}" for reason, n in failed.items())
            told.append(f"of {len(places)} places that both saw, {sum(failed.values())} give no height ({words})")
        elif shifts.sum() >= _LEAST and contradicted > _MOST * shifts.sum():
            failed = {_REFUSED: contradicted}
            told.append(f"of {int(shifts.sum())} shifts that were found, {contradicted} are {_REFUSED}")
        if told:
            text = f"{told[0]}: {_CAUSES.get(next(iter(failed)), 'one of both does not see the road')}"
            found.append(TIES_FAIL.finds(f"runs '{pair[0]}' and '{pair[1]}'", text, left_out=sum(failed.values())))
    return found


def _refused(ties: KnownTies, weight: Float64) -> set[tuple[Any, ...]]:
    """Returns place, group, kind and sizes of the ties that passed their tests and do not count."""
    rows = np.flatnonzero(ties.accepted & (weight == 0.0))
    columns = ties.columns
    return {(int(columns["place"][k]), columns["kind"][k], float(columns["sigma_m"][k])) for k in rows.tolist()}


def _number_refused(tried: Any, own: npt.NDArray[np.bool_], refused: set[tuple[Any, ...]]) -> int:
    rows = np.flatnonzero(own).tolist()
    return sum((int(tried["place"][k]), tried["kind"][k], float(tried["sigma_m"][k])) in refused for k in rows)


def _reasons(tried: Any, own: npt.NDArray[np.bool_], refused: set[tuple[Any, ...]]) -> dict[int, str]:
    """Returns for each place why it gives nothing; "" where one comparison counts."""
    found: dict[int, str] = {}
    for k in np.flatnonzero(own).tolist():
        place, why = int(tried["place"][k]), str(tried["why_not"][k])
        if not why and (place, tried["kind"][k], float(tried["sigma_m"][k])) in refused:
            why = _REFUSED
        found[place] = "" if found.get(place) == "" or not why else why
    return found
