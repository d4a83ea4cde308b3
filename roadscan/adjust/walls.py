"""How much the walls lean that a lidar sees along a road: they tell a roll that no tie within one drive shows.

A stated roll of the boresight that is too large by ρ (rad) lowers what is to the right: a wall whose normal has the
component r to the right of the vehicle gets a normal that points ρ r down. Walls that stand back from the road, as
retaining walls do, are no roll: how much all walls lean away from the road is a second unknown. Where a road has walls
on one side alone, the stated σ of that unknown is that of the roll.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.adjust.places import Track
from roadscan.adjust.ties.tie import PLANE
from roadscan.compute.array_types import Float64
from roadscan.compute.arrays import scatter_about
from roadscan.core.witness import Finding, Witness

_STEEP_RAD: Final = np.radians(6.0)
"""A plane that leans less than this from the vertical may be a wall: more than any roll that is worth a run, and less
than the sides of cars and of banks."""
_ALONG: Final = np.cos(np.radians(30.0))
"""The normal of a wall along the road has this component to the side, or more. Planes that face the drive are seen at
a low angle, and few: corners, trees, cars."""
_LEAST_WALLS: Final = 20
"""With fewer, one house that leans would decide."""
_LEAST_PLACES: Final = 3
"""Walls of fewer places may be one house's."""
_LEAST_SHARE: Final = 0.5
"""Where fewer of the planes agree, they are no walls, but hedges and banks."""
_HOUSE_RAD: Final = np.radians(0.1)
"""1 σ of the lean that all walls of a street have in common: houses are built upright to some mm a metre."""
_BACK_RAD: Final = np.radians(0.3)
"""1 σ of how far all walls of a street stand back from it, without retaining walls."""
_DOUBTED: Final = 3.0
"""A lean beyond this many σ is reported."""
_ROUNDS: Final = 20  # of weights; they settle in about ten
_NEAR: Final = 2.0  # Spread of the walls' leans beyond which one loses its weight (Cauchy's function, squared).
_LEAST_SPREAD_RAD: Final = 1e-4  # of walls without any noise
_NAMES: Final = ("place", "first_epoch_gps_ns", "easting_m", "northing_m", "direction_down", "first_by_right")

WALLS: Final = Witness(
    "walls_upright",
    input="rig file",
    fault="The roll of a lidar's boresight, or of the poses of a drive, is off.",
    asks="walls beside the road that the lidar saw: they stand upright",
    does="the lean that all of them have in common is told; nothing is corrected by it",
    told=("findings",),
)


class Lean(NamedTuple):
    """The lean that the walls that one lidar saw in one run have in common."""

    run: int
    sensor: str
    walls: int
    """That agree."""
    roll_rad: float
    """By which the stated roll is too large."""
    sigma_rad: float


def leans(columns: Mapping[str, npt.NDArray[Any]], tracks: Sequence[Track], runs: Sequence[str]) -> list[Lean]:
    """Returns the leans of walls by run and lidar, where there are enough walls; columns: of ties (n,), by name."""
    within = (columns["kind"] == PLANE) & (columns["first_run"] == columns["second_run"])
    within &= columns["first_sensor"] == columns["second_sensor"]
    within &= (np.abs(columns["direction_down"]) < np.sin(_STEEP_RAD)) & (np.abs(columns["first_by_right"]) > _ALONG)
    found = []
    for track in tracks:
        own = within & (columns["first_run"] == runs[track.run]) & (columns["first_sensor"] == track.sensor)
        # All ties of a plane have its normal: the first of each counts.
        key = np.stack([columns[name][own] for name in ("place", "direction_north", "direction_down")])
        first = np.flatnonzero(own)[np.unique(key, axis=1, return_index=True)[1]]
        lean = _lean(track, {name: columns[name][first] for name in _NAMES})
        found += [] if lean is None else [lean]
    return found


def _lean(track: Track, walls: Mapping[str, npt.NDArray[Any]]) -> Lean | None:
    """Returns the lean of walls (w,) of one track; None where they are too few, or do not tell."""
    if walls["place"].size < _LEAST_WALLS or np.unique(walls["place"]).size < _LEAST_PLACES:
        return None
    at = np.searchsorted(track.epoch_gps_ns, walls["first_epoch_gps_ns"]).clip(max=track.epoch_gps_ns.size - 1)
    east, north = walls["easting_m"] - track.easting_m[at], walls["northing_m"] - track.northing_m[at]
    is_right = east * np.cos(track.heading_rad[at]) > north * np.sin(track.heading_rad[at])
    side = walls["first_by_right"]
    design = np.stack([side, np.where(is_right, side, -side)], axis=1)
    roll, sigma, agreeing = _robust(design, np.arcsin(walls["direction_down"]))
    if agreeing < max(_LEAST_SHARE * side.size, _LEAST_WALLS) or sigma > _STEEP_RAD / _DOUBTED:
        return None
    return Lean(track.run, track.sensor, agreeing, roll, float(np.hypot(sigma, _HOUSE_RAD)))


def _robust(design: Float64, observed: Float64) -> tuple[float, float, int]:
    """Returns the first unknown, its σ, and how many observations (n,) agree, by Cauchy's weights, squared.

    design : (n, 2).
    """
    values = np.zeros(2)
    for _ in range(_ROUNDS):
        residual = np.abs(observed - design @ values)
        spread = max(scatter_about(residual, 0.0), _LEAST_SPREAD_RAD)
        weight = (1.0 + (residual / (_NEAR * spread)) ** 2) ** -2.0
        prior = np.diag([0.0, (spread / _BACK_RAD) ** 2])
        inverse = np.linalg.inv(design.T @ (weight[:, None] * design) + prior)
        values = inverse @ design.T @ (weight * observed)
    return float(values[0]), float(spread * np.sqrt(inverse[0, 0])), int((residual < _DOUBTED * spread).sum())


def lean_findings(found: Sequence[Lean], runs: Sequence[str]) -> list[Finding]:
    """Returns findings on walls that lean by more than walls do."""
    return [
        WALLS.finds(
            f"{one.sensor} in run '{runs[one.run]}'",
            f"{one.walls} walls beside the road lean as if the stated roll were "
            f"{np.degrees(one.roll_rad):+.2f}° too large (σ {np.degrees(one.sigma_rad):.2f}°), that of the boresight "
            "in the rig file or that of the poses; nothing is corrected by it: calibrate the boresight, or look at the "
            "attitude of the poses",
        )
        for one in found
        if abs(one.roll_rad) > _DOUBTED * one.sigma_rad
    ]
