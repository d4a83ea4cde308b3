"""Arrows, symbols and raised markers from what ``roadscan run`` wrote with default settings, on drawn streets.

Streets 730 and 731 were looked at when the drawings were made; 740 to 743 are only scored.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import geopandas
import numpy as np

from benchmarks.bench_wires_covers import Counts, products_of
from benchmarks.drawn_streets import street_of_symbols
from benchmarks.timing import Figure
from roadscan.simulate import Scene
from roadscan.simulate.surface import Surface

LOOKED_AT: Final = {730: "HDL-32E", 731: "OS1-128"}
SCORED: Final = {740: "HDL-32E", 741: "VLP-16", 742: "HDL-32E", 743: "OS1-128"}
"""Seeds of streets with their lidar."""
_SYMBOL_M, _MARKER_M = 1.2, 0.2
"""A symbol is found where the middle of a marking lies within this of its own (m), a raised marker likewise."""


@dataclass
class Score(Counts):
    """Numbers of things on some streets."""

    symbols: int = 0
    found: int = 0
    right: int = 0
    wrong: int = 0
    """Of the found ones, those that are named right, and those that get another's name."""
    named_elsewhere: int = 0
    """Names where no symbol lies."""
    markers: int = 0
    markers_found: int = 0
    markers_false: int = 0
    lines_in_lanes: int = 0
    """Lane lines over a symbol, where none is painted."""


def figures(folder: Path) -> Iterator[Figure]:
    """Both groups of streets."""
    groups: Mapping[str, Mapping[int, str]] = {"looked at": LOOKED_AT, "only scored": SCORED}
    for name, streets in groups.items():
        total = Score()
        for seed, model in streets.items():
            street = seen_by(street_of_symbols(seed), model)
            total += scored(street, products_of(street, folder / f"symbols {seed}"))
        yield Figure(f"{name}: symbols, found", total.found, "", total.symbols, "that lie there")
        yield Figure(f"{name}: of these, named right", total.right, "")
        yield Figure(f"{name}: of these, named wrong", total.wrong, "")
        yield Figure(f"{name}: names where no symbol lies", total.named_elsewhere, "")
        yield Figure(f"{name}: lane lines over symbols", total.lines_in_lanes, "")
        yield Figure(f"{name}: raised markers, found", total.markers_found, "", total.markers, "that stand there")
        yield Figure(f"{name}: false raised markers", total.markers_false, "")


def seen_by(street: Scene, model: str) -> Scene:
    """The street with this lidar, whose poses are exact."""
    in_bag = model == "VLP-16"  # its packets are recorded in a bag
    bag = {"on": in_bag, "trajectory": in_bag}
    return street.changed(bag=bag, lidar=street.lidar.model_dump() | {"model": model})


def scored(street: Scene, products: Path) -> Score:
    """The products of a street, held against its truth."""
    surface, road = Surface(street), street.road
    found = geopandas.read_parquet(products / "road_markings.parquet")
    bounds = found.geometry.bounds
    middle_m = (bounds.minx + bounds.maxx).to_numpy() / 2, (bounds.miny + bounds.maxy).to_numpy() / 2
    station, offset = surface.station_offset_m(*middle_m)
    kinds, shows = found["type"].to_numpy(object), found["symbol"].fillna("unknown").to_numpy(object)
    is_marker = kinds == "raised_marker"
    out, used = Score(), set[int]()
    for one in road.symbols:
        away = np.where(is_marker, np.inf, np.hypot(station - one.station_m, offset - one.offset_m))
        place = int(away.argmin()) if away.size else -1
        out += Score(symbols=1)
        if place >= 0 and away[place] < _SYMBOL_M:
            used.add(place)
            named = shows[place] != "unknown"
            out += Score(found=1, right=int(shows[place] == one.shape), wrong=int(named and shows[place] != one.shape))
    named = [place for place, name in enumerate(shows.tolist()) if name != "unknown"]
    out += Score(named_elsewhere=len(set(named) - used))
    places = np.array([[p.station_m, p.offset_m] for p in road.patches])
    own = np.column_stack([station, offset])[is_marker]
    apart = np.hypot(*(places[:, None] - own).transpose(2, 0, 1)) < _MARKER_M
    out += Score(markers=len(places), markers_found=int(apart.any(axis=1).sum()),
                 markers_false=int((~apart.any(axis=0)).sum()))  # fmt: skip
    lines = geopandas.read_parquet(products / "lane_lines.parquet")
    painted = np.array([m.offset_m for m in road.markings])
    for line in lines.geometry:
        x, y, *_ = np.array(line.coords).T
        at = float(surface.station_offset_m(x, y)[1].mean())
        out += Score(lines_in_lanes=int(np.abs(painted - at).min() > 0.3))
    return out
