"""One tie: the difference of two traverses along one direction at one place, and why it does not count, if so.

Passes farther apart than the search of ties: which they are, and the shift on which larger patches agree.

A single larger patch may match at a wrong place. What counts is the shift that most patches of two passes agree on.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.adjust.places import PassReadings
from roadscan.adjust.settings import AgainSettings, TieSettings
from roadscan.compute.array_types import Bool, Float64

HEIGHT: Final = "height_tie"
SHIFT: Final = "shift_tie"
PLANE: Final = "plane_tie"

LASERS: Final = 256
"""Lasers of a sensor are numbered by bytes."""

COUNTS: Final = ""
FEW_CELLS: Final = "too few cells in common"
TOO_FAR: Final = "farther apart than the bound"
TWO_SURFACES: Final = "too few cells agree"
SCATTERED: Final = "cells scatter"
STEEP: Final = "too steep"
SAME_PASS: Final = "heads of one pass"


@dataclass(frozen=True)
class End:
    """One end of a tie: a point of the road and the pose that saw it."""

    readings: PassReadings
    pose: int
    """Row of the pose."""
    point_m: Float64
    """(3,) easting, northing, height as the recorded pose places it."""
    laser: float = math.nan
    """Laser that saw it; NaN of a sensor that has none."""


@dataclass(frozen=True)
class Tie:
    """A measurement along one direction: the second end minus the first."""

    kind: str
    ends: tuple[End, End]
    direction_level: Float64
    """(3,) unit vector, north, east, down."""
    value_m: float
    sigma_m: float
    count: int
    """Number of cells or returns used."""
    correlation: float
    """Correlation of the two images; NaN where none was compared."""
    why_not: str = COUNTS
    """Empty if it counts."""
    group: int = 0
    """Ties of one group of a place stand or fall together."""

    @property
    def counts(self) -> bool:
        """Returns whether the adjustment uses it."""
        return self.why_not == COUNTS


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
