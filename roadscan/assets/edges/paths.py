"""Edges as paths: places linked to chains whose evidence adds up over many metres."""

from __future__ import annotations

import itertools
import math
from typing import Final, NamedTuple

import numpy as np

from roadscan.assets.bins import in_bins
from roadscan.assets.edges.steps import Places
from roadscan.assets.kernels.edge_links import MAX_LINKS, best_ways, find_links, trace
from roadscan.compute.array_types import Float64, Int64

FREE_M: Final = 0.3
"""Distance of consecutive places (m) that is no gap."""


class PathSettings(NamedTuple):
    """How places become paths. One setting for all data."""

    memory_m: float = 6.0
    """Evidence counts over about this length to each side: e^(−x / memory)."""
    chance: float = 2.5
    """Evidence (σ) of a place that chance gives as well: it is taken off."""
    most: float = 8.0
    """Evidence (σ) of one place counts up to this, so that no single place makes a path."""
    near_m: float = 0.5
    far_m: float = 1.6
    """Distances of the next place; a far one is taken where none is near."""
    bend_deg: float = 32.0
    """Greatest bend from place to place."""
    gap_cost: float = 1.0
    """Evidence that a metre without a place costs (σ)."""
    bend_cost: float = 12.0
    begin: float = 5.0
    """Least evidence (σ · m) of a path through its strongest place."""
    go_on: float = 3.0
    """Least evidence (σ · m) of a path through any of its places."""
    beside_m: float = 0.25
    """A path leaves no second one within this distance."""
    gutter_m: float = 0.65
    """The other side of a gutter this wide belongs to its kerb."""


DEFAULT: Final = PathSettings()


class Chain(NamedTuple):
    """A chain of places, in their direction."""

    places: Places
    evidence: float
    """Evidence (σ · m) of the places that belong to it alone."""


def paths_of(places: Places, settings: PathSettings = DEFAULT) -> list[Chain]:
    """Returns paths through places, the strongest first.

    Each place has links to those that may follow it; the best way on from every place and to it is found by dynamic
    programming, with evidence that fades with distance. From the strongest place on the best ways are followed.
    """
    n = len(places.x_m)
    if n < 2:
        return []
    place = np.ascontiguousarray(np.column_stack(places[:4]))
    quality = np.minimum(places.evidence, settings.most) - settings.chance
    links, lengths, gains = np.full((n, MAX_LINKS), -1, np.int64), np.zeros((n, MAX_LINKS)), np.zeros((n, MAX_LINKS))
    order, starts, bins = _bins(places, settings.near_m)
    limits = (FREE_M, math.cos(math.radians(settings.bend_deg)), settings.gap_cost, settings.bend_cost)
    reach = (settings.near_m, settings.far_m)
    find_links(place, quality, order, starts, bins, reach, limits, links, lengths, gains)
    ahead, behind = np.zeros(n), np.zeros(n)
    following, preceding = np.full(n, -1, np.int64), np.full(n, -1, np.int64)
    rounds = round(20.0 * settings.memory_m)
    best_ways(links, lengths, gains, settings.memory_m, rounds, ahead, following, behind, preceding)
    total = ahead + behind
    ranked = np.lexsort((np.arange(n), -total))
    chain, owner = np.zeros((n, 2), np.int64), np.full(n, -1, np.int64)
    following_limits = (settings.begin, settings.go_on, settings.beside_m, settings.gutter_m)
    number, length = trace(
        place, total, following, preceding, ranked, order, starts, bins, following_limits, chain, owner
    )
    ends = np.searchsorted(chain[:length, 0], np.arange(number + 1))
    found = (chain[a:b, 1] for a, b in itertools.pairwise(ends))
    chains = (Chain(places.at(rows), _own_evidence(place[rows], quality[rows], settings)) for rows in found)
    return sorted((c for c in chains if c.evidence >= settings.begin), key=lambda c: -c.evidence)


def _own_evidence(place: Float64, quality: Float64, settings: PathSettings) -> float:
    """Evidence (σ · m) of the places that belong to a chain alone, not to a stronger one that it leads to."""
    length = np.hypot(*np.diff(place[:, :2], axis=0).T)
    free = np.minimum(length, FREE_M)
    return float(np.sum(free * 0.5 * (quality[1:] + quality[:-1]) - (length - free) * settings.gap_cost))


def _bins(places: Places, size_m: float) -> tuple[Int64, Int64, tuple[float, float, float, float, float]]:
    x_min, y_min = float(places.x_m.min()) - 1e-6, float(places.y_m.min()) - 1e-6
    column, row = ((places.x_m - x_min) / size_m).astype(np.int64), ((places.y_m - y_min) / size_m).astype(np.int64)
    columns, rows = int(column.max()) + 1, int(row.max()) + 1
    number = row * columns + column
    starts, order = in_bins(number, rows * columns)
    return order, starts, (x_min, y_min, size_m, float(rows), float(columns))
