"""Places that people gave and that are asked about before they are in force: far moves, and odd heights."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.inventory.comparing import Changes
from roadscan.inventory.home import EditFault
from roadscan.inventory.state import State
from roadscan.model.witness import Witness
from roadscan.tables.asset_schema import asset_schema
from roadscan.tables.inventory_schema import GEOMETRY

PLACES_OF_EDITS: Final = Witness(
    name="places_of_edits",
    input="inventory edits",
    fault="A person put an asset kilometres away, swapped its axes, or gave it a height of another system.",
    asks="the former place of the asset, and the places and heights of the assets around it",
    does="the edit is not taken in until the person confirms it: `pull --confirm ID`, or *It is right* in the page",
    told=("error",),
)
_MOVED_M: Final = 100.0
"""Farther than any sensor of a survey sees: the evidence of an asset does not lie where it was moved to."""
_DRAWN_M: Final = 1000.0
"""Roads of a survey hang together; a place as far from all known assets was not driven past."""
_AROUND_M: Final = 100.0
_RISE_M: Final = 10.0
"""From the foot of a mast to the sign on its gantry, or from a road to the one on the bridge over it."""
_SLOPE: Final = 0.15
"""Of the steepest public roads, from one asset to the next."""
_FACADE_RISE_M: Final = 100.0
"""Height of the tallest façades along a road."""


def questions_of(changes: Changes, state: State) -> Iterator[EditFault]:
    """Places of changes that are possible and unlikely, against the inventory that they are to be taken into."""
    given = [one for one in (*changes.drawn, *changes.changed) if one.attribute == GEOMETRY and one.new is not None]
    if not given:
        return
    known_m, units_m = _known_places(state), state.units_m
    for change in given:
        try:
            shape = shapely.from_wkb(change.new)
        except shapely.errors.ShapelyError:
            continue  # a fault, which is named as one
        places = shapely.get_coordinates(shape, include_z=True) * (units_m[0], *units_m)
        if not places.size or not np.isfinite(places).all():
            continue  # so is this
        former = None if change.old is None else shapely.from_wkb(change.old)
        reason = _far(places, former, known_m, units_m[0]) or _other_height(change.kind, places, known_m)
        if reason is not None:
            yield EditFault(asset_schema(change.kind).table, change.record, reason, is_question=True)


def _known_places(state: State) -> npt.NDArray[np.float64]:
    """Reference points (n, 3) of all assets (m)."""
    names = ("easting_m", "northing_m", "height_m")
    parts = [
        np.column_stack([np.asarray(own.rows[n].to_numpy(zero_copy_only=False), dtype=np.float64) for n in names])
        for own in state.assets.values()
    ]
    places = np.concatenate([np.empty((0, 3)), *parts])
    known: npt.NDArray[np.float64] = places[np.isfinite(places).all(axis=1)]
    return known


def _far(places: npt.NDArray[np.float64], former: Any, known_m: npt.NDArray[np.float64], unit_m: float) -> str | None:
    if former is not None:
        most, what = _MOVED_M, "its former place"
        away = _distances(places, former, unit_m)
        swapped = _distances(places[:, [1, 0, 2]], former, unit_m)
    elif len(known_m):
        most, what = _DRAWN_M, "all known assets"
        away, swapped = (_to_nearest(one, known_m) for one in (places, places[:, [1, 0, 2]]))
    else:
        return None
    farthest = float(away.max())
    if farthest <= most:
        return None
    hint = "; easting and northing seem to be swapped" if float(swapped.max()) <= most else ""
    return f"it lies {_length(farthest)} from {what}, more than {most:g} m{hint}"


def _distances(places: npt.NDArray[np.float64], former: Any, unit_m: float) -> npt.NDArray[np.float64]:
    found: npt.NDArray[np.float64] = shapely.distance(shapely.points(places[:, :2] / unit_m), former) * unit_m
    return found


def _to_nearest(places: npt.NDArray[np.float64], known: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Distance (m) from each of few places to the nearest known one."""
    return np.array([np.hypot(known[:, 0] - x, known[:, 1] - y).min() for x, y, _ in places])


def _other_height(kind: str, places: npt.NDArray[np.float64], known_m: npt.NDArray[np.float64]) -> str | None:
    """Why the heights of a shape are like those of no asset around it, itself included; None where they are.

    Where no asset stands near, the nearest one is asked.
    """
    if not len(known_m):
        return None
    rise_m = _FACADE_RISE_M if kind == "facade" else _RISE_M
    for place, above in ((places[places[:, 2].argmin()], _RISE_M), (places[places[:, 2].argmax()], rise_m)):
        away = np.hypot(known_m[:, 0] - place[0], known_m[:, 1] - place[1])
        around = away <= max(_AROUND_M, float(away.min()))
        heights = known_m[around, 2]
        allowed = np.where(place[2] > heights, above, _RISE_M) + _SLOPE * away[around]
        if (np.abs(place[2] - heights) > allowed).all():
            low, high = float(heights.min()), float(heights.max())
            stand = f"at {low:.1f} m" if high - low < 0.05 else f"from {low:.1f} m to {high:.1f} m"
            return f"its height is {place[2]:.1f} m, and the assets around it stand {stand}"
    return None


def _length(value_m: float) -> str:
    return f"{value_m:.0f} m" if value_m < 1000.0 else f"{value_m / 1000.0:,.1f} km"
