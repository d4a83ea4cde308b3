"""Fences, guard rails and walls in products of hard streets, metre by metre: found, and what is named so elsewhere.

Each street is run by ``roadscan run`` with default settings. A metre counts where 15 returns or more show it, and most
returns at its place are its own. The streets of `SCORED` were never looked at; those of `SEEN` were while limits
of upright surfaces were set. Judges are fitted to other seeds.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import geopandas
import numpy as np
import numpy.typing as npt
import shapely

from benchmarks.hard_streets import hard_street
from benchmarks.judged_scenes import in_window
from benchmarks.labelled_returns import labelled_returns
from benchmarks.labelled_street import classified_points, run
from benchmarks.settings import bench_folder
from benchmarks.street_scores import ON_GROUND
from benchmarks.timing import Figure
from roadscan.assets import classes
from roadscan.assets.scene import Returns
from roadscan.run.session import Session
from roadscan.simulate import Scene as Street
from roadscan.simulate import simulate
from roadscan.simulate.surface import Surface
from roadscan.store.asset_schema import asset_tables
from roadscan.store.store import Store

Float64 = npt.NDArray[np.float64]

SEEN: Final = (*range(800, 809), 811, 813, 819, 822, 840, 841, 843, 844, 845, 847, 849, 853, 856, 857, 859)
SCORED: Final = (851, 855, 862, 863, 865, 866, 870, 874, 879, 889)
"""Seeds of hard streets; the latter are the next two of each scanner with 20 m of fences."""
_JUDGED: Final = ("fence", "gate", "wall", "guardrail")
_SOLID: Final = ("wall", "barrier", "facade")
_LEAST: Final = 15  # Returns of a metre that is judged.
_BESIDE_M, _BEFORE_M, _STEP_M = 0.35, 0.6, 0.5
"""A line is found that lies so far beside a place and so far before or beyond it; lines are points so far apart (m)."""
_LOWEST_M: Final = 0.3  # Returns higher above the road's foot there (m) show a fence; walls are judged from 0.55 m on.


def figures(folder: Path) -> Iterator[Figure]:
    """Shares of the length, of the streets that were looked at and of those that were only scored."""
    for name, seeds in (("looked at", SEEN), ("only scored", SCORED)):
        own, total = bench_folder(folder), defaultdict[str, float](float)
        for seed in seeds:
            for what, metres in metres_of(hard_street(seed), own / f"hard-{seed}").items():
                total[what] += metres
        for kind, words in (("fence", "fences"), ("guardrail", "guard rails")):
            yield Figure(f"{name}: {total[kind]:.0f} m of {words}, found", _of(total, f"{kind} found", kind), "")
            yield Figure(f"{name}: {total[f'{kind} named']:.0f} m named {kind}, right",
                         _of(total, f"{kind} right", f"{kind} named"), "")  # fmt: skip
        yield Figure(f"{name}: {total['solid']:.0f} m of walls and panels, found solid",
                     _of(total, "solid found", "solid"), "")  # fmt: skip
        yield Figure(f"{name}: {total['fence']:.0f} m of fences, classed as vehicles for the most part",
                     _of(total, "fence lost", "fence"), "")  # fmt: skip


def _of(total: dict[str, float], part: str, of: str) -> float:
    return total[part] / total[of] if total[of] else math.nan


def metres_of(street: Street, folder: Path) -> dict[str, float]:
    """Metres of fences, guard rails and what is solid, found as such; named so, right; fences classed as vehicles."""
    seen = labelled_returns(street)
    inside, _, station, offset = in_window(seen, street)
    store, surface = _run_of(street, folder), seen.surface
    lines = {kind: _places(store, surface, kind) for kind in ("fence", "guardrail", *_SOLID)}
    points, of_class = _standing(store, surface)
    own = np.isin(seen.kind[inside], [i for i, k in enumerate(seen.kinds) if k in _JUDGED])
    side, above = street.roadside, seen.returns.height_m[inside] - surface.height_m(*_map_of(seen.returns.at(inside)))
    true = {
        "fence": [f for f in side.fences if f.style != "panels"],
        "guardrail": side.guardrails,
        "solid": [*(f for f in side.fences if f.style == "panels"), *(w for w in side.walls if w.height_m >= 0.55)],
    }
    out = defaultdict[str, float](float)
    every = [
        (kind, one.offset_m, metre)
        for kind, things in true.items()
        for one in things
        for metre in np.arange(max(one.start_m, 0.0) + 0.5, min(one.end_m, street.length_m))
    ]
    for kind, offset_m, metre in every:
        band = (np.abs(station - metre) < 0.5) & (np.abs(offset - offset_m) < _LOWEST_M) & (above > _LOWEST_M)
        if own[band].sum() < max(_LEAST, 0.5 * band.sum()):
            continue
        out[kind] += 1
        out[f"{kind} found"] += any(_near(lines[n], metre, offset_m) for n in (_SOLID if kind == "solid" else (kind,)))
        if kind == "fence":
            beside = (np.abs(points[0] - metre) < 0.5) & (np.abs(points[1] - offset_m) < _LOWEST_M)
            out["fence lost"] += bool(beside.any()) and (of_class[beside] == classes.VEHICLE).mean() > 0.5
    for kind in ("fence", "guardrail"):
        for at, beside in lines[kind].T:
            if 0.0 <= at <= street.length_m:
                out[f"{kind} named"] += _STEP_M
                out[f"{kind} right"] += _STEP_M * any(
                    abs(beside - f.offset_m) < _BESIDE_M and f.start_m - _BEFORE_M <= at <= f.end_m + _BEFORE_M
                    for f in true[kind]
                )
    return out


def _map_of(returns: Returns) -> tuple[Float64, Float64]:
    east, north = returns.corner_m
    return east + returns.x_m, north + returns.y_m


def _run_of(street: Street, folder: Path) -> Store:
    """The store of a street that is simulated into a folder and run by default, where that was not done before."""
    file = folder / "SURVEY.toml"
    if not file.exists():
        simulate(street, folder)
        file.write_text(f"{file.read_text()}\n[assets]\n")
    run(file)
    return Session.open(file).store


def _places(store: Store, surface: Surface, name: str) -> Float64:
    """Stations and offsets (2, n) along the lines of a kind."""
    table = next(table for table, kind in asset_tables().items() if kind == name)
    parts = [np.zeros((2, 0))]
    if store.exists(file := f"products/assets/{table}.parquet"):
        for one in geopandas.read_parquet(store.path(file)).geometry:
            flat = shapely.force_2d(one)
            line = flat if "Line" in flat.geom_type else flat.exterior
            at = shapely.line_interpolate_point(line, np.arange(_STEP_M / 2, line.length, _STEP_M))
            parts.append(np.stack(surface.station_offset_m(*shapely.get_coordinates(at).T.copy())))
    return np.concatenate(parts, axis=1)


def _standing(store: Store, surface: Surface) -> tuple[Float64, npt.NDArray[np.uint8]]:
    """Stations and offsets (2, n) of classified points that do not lie on the ground, and their classes."""
    points, code = classified_points(store)
    stands = ~np.isin(code, (*ON_GROUND, classes.LOW_NOISE))
    return np.stack(surface.station_offset_m(*points[stands, :2].T)), code[stands]


def _near(places: Float64, station_m: float, offset_m: float) -> bool:
    beside = np.abs(places - np.array([[station_m], [offset_m]]))
    return bool(((beside[0] < _BEFORE_M) & (beside[1] < _BESIDE_M)).any())
