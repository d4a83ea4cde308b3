"""Compares values of condition with those from the true heights of a simulated survey at the same places."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.condition.index import Value, condition_indices
from roadscan.condition.lane_data import LaneData, Profile
from roadscan.condition.settings import ConditionConfig
from roadscan.condition.tasks.values import Group, GroupTask, load_lane
from roadscan.condition.tasks.work import plan_condition
from roadscan.georeference.plan.plan import plan_of
from roadscan.run.session import Session
from roadscan.tiles.tasks.wanted_products import product_context

HeightAt: TypeAlias = Callable[[Float64, Float64], Float64]
"""Function that gives true heights (n,) at eastings and northings (n,)."""


@dataclass(frozen=True)
class Compared:
    """A value, and that of the true surface."""

    road: str
    lane: str
    found: Value
    true: Value


def compared_values(session: Session, height_at: HeightAt) -> Iterator[Compared]:
    """Return all values of the store beside those of the truth; profiles and cross-sections have to be computed."""
    config = ConditionConfig.stated(session.survey)
    if config is None:
        return
    context = product_context(plan_of(session))
    for group in plan_condition(session).groups:
        task = GroupTask(session.store, config.sections(), plan_of(session).ground.grid.cell_m, context, group)
        lane = load_lane(task)
        true = true_lane(group, lane, height_at)
        for index in condition_indices().values():
            if index.needs_cracks:
                continue
            beside = {(v.quantity, v.extent, v.from_m, v.to_m): v for v in index.values(true)}
            for value in index.values(lane):
                known = beside.get((value.quantity, value.extent, value.from_m, value.to_m))
                if known is not None:
                    yield Compared(group.lane.road, group.lane.name, value, known)


def true_lane(group: Group, lane: LaneData, height_at: HeightAt) -> LaneData:
    """Return the lane with the true heights at its places."""
    profiles = {side: _true_profile(profile, height_at) for side, profile in lane.profiles.items()}
    cross = lane.cross_sections
    n, m = cross.height_m.shape
    station = np.repeat(cross.station_m, m)
    places = group.line.places(station, group.lane.offsets(station, np.tile(cross.offset_m, n)))
    height = height_at(places[:, 0], places[:, 1]).reshape(n, m) - cross.base_m[:, None]
    return replace(
        lane, profiles=profiles, cross_sections=replace(cross, height_m=height, sigma_m=np.zeros((n, m))), window_m2=0.0
    )


def _true_profile(profile: Profile, height_at: HeightAt) -> Profile:
    height = height_at(profile.place_m[:, 0], profile.place_m[:, 1])
    return replace(profile, height_m=height, sigma_m=np.zeros(height.size))
