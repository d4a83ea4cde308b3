"""Kerbs and vehicles on eight hard streets that no judge was fitted to, in memory, with the judges in force.

By these figures it is decided whether a judge that was fitted anew stays (docs/asset-judges.md).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from benchmarks.edge_scenes import LOWEST_M, simulated_kerbs
from benchmarks.hard_streets import hard_street
from benchmarks.judged_scenes import PERSON, UNKNOWN, VEHICLE, JudgedScene, simulated
from benchmarks.labelled_returns import LabelledReturns, labelled_returns
from benchmarks.street_classes import kerb_heights
from benchmarks.street_scores import points_along, share_within
from benchmarks.timing import Figure
from roadscan.assets import classes
from roadscan.assets.edges.steps import raster_of
from roadscan.assets.kinds.kerb import Kerb, KerbOptions
from roadscan.simulate import Scene as Street

UNSEEN: Final = range(900, 908)
"""Seeds of the streets."""
_NEAR_M, _SEEN_M, _EVERY_M = 0.25, 0.2, 0.1
"""A kerb is found that has a line so near; it is judged where a return of the ground is so near; points so far apart
(m)."""
_HIGH_M: Final = 0.3  # Returns higher above bare earth (m) count for or against vehicles.


class Counts(NamedTuple):
    """Of one street, or of several."""

    kerb: float
    """Places of kerbs that returns show."""
    kerb_found: float
    line: float
    """Places of lines named kerb."""
    line_right: float
    vehicle: float
    """Returns of vehicles."""
    vehicle_found: float
    named: float
    """Returns classed as vehicles."""


def figures(folder: Path) -> Iterator[Figure]:
    """Recall, precision and F1 of kerbs by length, and of vehicles by returns."""
    yield from of_counts(Counts(*np.sum([counts_of(hard_street(seed)) for seed in UNSEEN], axis=0)))


def of_counts(c: Counts) -> Iterator[Figure]:
    """Figures of counts."""
    for what, wanted, found, named, right in (
        ("kerbs", c.kerb, c.kerb_found, c.line, c.line_right),
        ("vehicles", c.vehicle, c.vehicle_found, c.named, c.vehicle_found),
    ):
        recall, precision = found / max(wanted, 1.0), right / max(named, 1.0)
        yield Figure(f"{what}: recall", recall, "")
        yield Figure(f"{what}: precision", precision, "")
        yield Figure(f"{what}: F1", 2.0 * recall * precision / max(recall + precision, 1e-9), "")


def counts_of(settings: Street) -> Counts:
    """The counts of a street."""
    seen = labelled_returns(settings)
    return counts_of_scene(simulated(settings, "hard", 1.0, seen), settings, seen)


def counts_of_scene(one: JudgedScene, settings: Street, seen: LabelledReturns) -> Counts:
    """The counts of a scene that was made of a street."""
    return Counts(*_kerbs(one, settings, seen), *_vehicles(one))


def _kerbs(one: JudgedScene, settings: Street, seen: LabelledReturns) -> tuple[float, float, float, float]:
    """Places of kerbs and those found, places of lines and those that are right."""
    scene, corner = one.scene, one.scene.returns.corner_m
    kind, options = Kerb(), KerbOptions()
    found = points_along([k.geometry for k in kind.objects(kind.evidence(scene, options).pieces, options, {})])
    found -= found.size and np.array(corner)
    right, weight = simulated_kerbs(seen.surface, settings, corner)(*found.T)
    wanted = _places(settings, seen)
    used = raster_of(scene).used
    ground = cKDTree(np.column_stack([scene.returns.x_m[used], scene.returns.y_m[used]]))
    wanted = wanted[ground.query(wanted)[0] <= _SEEN_M] if len(wanted) else wanted
    share = share_within(wanted, found, _NEAR_M) if len(wanted) else 0.0
    return len(wanted), share * len(wanted), float(weight.sum()), float(weight[right].sum())


def _places(settings: Street, seen: LabelledReturns) -> npt.NDArray[np.float64]:
    """Places (m, 2) along the kerbs of a street, from the corner of its returns."""
    station = np.arange(0.0, settings.length_m, _EVERY_M)
    out = []
    for side in (-1.0, 1.0):
        offset, height = np.full(station.size, side * (settings.road.paved_m + 0.02)), np.zeros(station.size)
        kerb_heights(seen.surface.arrays, station, offset, height)
        east, north, _ = seen.surface.place(station, offset)
        out.append(np.column_stack([east, north])[height >= LOWEST_M])
    return np.concatenate(out) - np.array(seen.returns.corner_m)


def _vehicles(one: JudgedScene) -> tuple[float, float, float]:
    """Returns of vehicles, those found, and all that are named so; people may be named either."""
    high = (one.scene.above_ground_m > _HIGH_M) & ~np.isin(one.what, (UNKNOWN, PERSON))
    true, named = high & (one.what == VEHICLE), high & (one.scene.classes == classes.VEHICLE)
    return float(true.sum()), float((true & named).sum()), float(named.sum())
