"""Wires and covers from what ``roadscan run`` wrote with default settings, on drawn streets that no judge has seen.

Their lidars record packets: of the hard streets only those are taken, and others get such a lidar.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Final, Self

import geopandas
import numpy as np
import numpy.typing as npt
import shapely

from benchmarks.drawn_streets import street_of_covers, street_of_lookalikes
from benchmarks.hard_streets import hard_street
from benchmarks.labelled_street import run
from benchmarks.timing import Figure
from roadscan.simulate import Scene, simulate
from roadscan.simulate.bodies import place_at
from roadscan.simulate.surface import Surface
from roadscan.simulate.things import objects_table

Float64 = npt.NDArray[np.float64]

HARD: Final = (62, 64, 65, 66, 67, 68, 69, 70)
COVERED: Final = {700: "HDL-32E", 701: "OS1-128", 702: "HDL-32E", 703: "OS1-128"}
LOOKALIKES: Final = {720: "HDL-32E", 721: "OS1-128", 722: "HDL-32E", 723: "OS1-128"}
"""Seeds of hard streets, of streets with many covers and wires with their lidar, and of such with what is like them."""
_WIRE_M, _COVER_M = 0.3, 0.35
"""A span is right where half of it lies within this of a wire (m), a cover within that of one."""


@dataclass
class Counts:
    """Numbers that add up over streets."""

    def __add__(self, other: Self) -> Self:
        """The sums of both."""
        return type(self)(*(getattr(self, one.name) + getattr(other, one.name) for one in fields(self)))


@dataclass
class Score(Counts):
    """What was found on some streets: lengths in metres, numbers of covers."""

    wires_m: float = 0.0
    covered_m: float = 0.0
    """Of them, what lies beside a span that is right."""
    spans_m: float = 0.0
    right_m: float = 0.0
    covers: int = 0
    found: int = 0
    typed: int = 0
    """Of the found ones, those with their type."""
    false: int = 0


def figures(folder: Path) -> Iterator[Figure]:
    """All sorts of streets."""
    sorts: Mapping[str, Mapping[int, Scene]] = {
        "streets of covers": {seed: _recorded(street_of_covers(seed), model) for seed, model in COVERED.items()},
        "streets of what is like covers and wires": {
            seed: _recorded(street_of_lookalikes(seed), model) for seed, model in LOOKALIKES.items()
        },
        "hard streets": {seed: hard_street(seed) for seed in HARD},
    }
    for name, streets in sorts.items():
        total = sum((score(one, folder / f"{name} {seed}") for seed, one in streets.items()), Score())
        yield Figure(f"{name}: wires of {total.wires_m:.0f} m, found", total.covered_m / total.wires_m, "")
        yield Figure(f"{name}: spans of {total.spans_m:.0f} m, right", total.right_m / total.spans_m, "")
        yield Figure(f"{name}: covers and drains, found", total.found, "", total.covers, "that lie there")
        yield Figure(f"{name}: of these, with their type", total.typed, "")
        yield Figure(f"{name}: false covers", total.false, "")


def _recorded(street: Scene, model: str) -> Scene:
    return street.changed(bag={"on": False}, lidar=street.lidar.model_dump() | {"model": model})


def score(street: Scene, folder: Path) -> Score:
    """The street, simulated, run from its survey file, and held against its truth."""
    products, surface = products_of(street, folder), Surface(street)
    return _wires(street, surface, products) + _covers(street, surface, products)


def products_of(street: Scene, folder: Path) -> Path:
    """The folder of the assets of a street that is simulated and run from its survey file, with default settings."""
    file = folder / "SURVEY.toml"
    simulate(street, folder)
    file.write_text(f"{file.read_text()}\n[assets]\n")
    run(file)
    (products,) = folder.glob("store/*/products/assets")
    return products


def _wires(street: Scene, surface: Surface, products: Path) -> Score:
    wires = [_line(surface, one) for one in street.roadside.wires]
    spans = [shapely.segmentize(line, 0.5) for line in geopandas.read_parquet(products / "wires.parquet").geometry]
    places = [shapely.get_coordinates(line, include_z=True) for line in spans]
    right = [any(np.median(_apart(own, wire)) < _WIRE_M for wire in wires) for own in places]
    near = [own for own, is_right in zip(places, right, strict=True) if is_right]
    lengths = [float(shapely.length(shapely.LineString(wire))) for wire in wires]
    shares = [float(np.mean(np.min([_apart(wire, own) for own in near], axis=0) < 1.5 * _WIRE_M)) if near else 0.0
              for wire in wires]  # fmt: skip
    return Score(
        sum(lengths), sum(a * b for a, b in zip(lengths, shares, strict=True)),
        sum(one.length for one in spans), sum(one.length for one, ok in zip(spans, right, strict=True) if ok),
    )  # fmt: skip


def _line(surface: Surface, wire: object) -> Float64:
    """A wire (81, 3) on the map, its parabola between the heights of its ends above the ground."""
    one = wire.model_dump()  # type: ignore[attr-defined]
    ends = np.array([place_at(surface, one[f"{to}station_m"], one[f"{to}offset_m"]).enh_m for to in ("", "to_")])
    ends[:, 2] += one["height_m"], one["to_height_m"]
    share = np.linspace(0.0, 1.0, 81)[:, None]
    line = ends[0] + share * (ends[1] - ends[0])
    line[:, 2:] -= 4.0 * one["sag_m"] * share * (1.0 - share)
    return np.asarray(line + surface.origin_enh_m)


def _apart(places: Float64, line: Float64) -> Float64:
    """Distance (n,) of places (n, 3) to the nearest of a line's vertices, which lie half a metre apart at most (m)."""
    return np.asarray(np.linalg.norm(places[:, None] - line, axis=2).min(axis=1))


def _covers(street: Scene, surface: Surface, products: Path) -> Score:
    things = objects_table(street, surface).to_pandas()
    found = geopandas.read_parquet(products / "covers.parquet")
    used, total = set[int](), Score()
    for one in things[things.kind.isin(["cover", "drain"])].itertuples():
        away = np.hypot(found.geometry.x - one.easting_m, found.geometry.y - one.northing_m).to_numpy()
        place = int(away.argmin()) if away.size else -1
        is_found = place >= 0 and bool(away[place] < _COVER_M)
        used |= {place} if is_found else set()
        total += Score(covers=1, found=int(is_found), typed=int(is_found and found["type"].iloc[place] == one.kind))
    return total + Score(false=len(found) - len(used))
