"""Decides which sensors' profiles are segmented, and what of that enters the keys of tiles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from roadscan.core.errors import ConfigError
from roadscan.core.rig import Mounting
from roadscan.core.settings.segmentation import RoadSegmentation
from roadscan.georeference.sources import ReadingSource

_LEAST_COSINE: Final = 0.5
"""Least cosine of the angles between a profile's normal and the driving direction, and between z and straight down."""


def road_of(settings: RoadSegmentation | None, sensor: str, table: str, mounting: Mounting) -> RoadSegmentation | None:
    """Return the segmentation settings for a sensor's readings of a table; None where they are not segmented.

    Raises
    ------
    ConfigError
        where the survey file names a sensor that has no profiles.
    """
    if settings is None:
        return None
    if settings.sensors is None:
        return settings if table == "scans" and looks_across(mounting) else None
    if sensor not in settings.sensors:
        return None
    if table != "scans":
        raise ConfigError(
            f"segmentation.sensors names '{sensor}', whose readings are {table}",
            expected="a sensor with profiles, rows of the table scans",
            change="take it out of the list",
        )
    return settings


def looks_across(mounting: Mounting) -> bool:
    """Return whether a sensor's profiles lie across the road and its z points down to it, each to less than 60°."""
    forward, _, down = mounting.body_from_sensor
    return abs(forward[0]) > _LEAST_COSINE and down[2] > _LEAST_COSINE


def check_road(settings: RoadSegmentation | None, sources: Sequence[ReadingSource]) -> None:
    """Raise ConfigError where the survey file requests segmentation and there is nothing to segment."""
    scans = any(source.table == "scans" for source in sources)  # none where the log of the only profiler is damaged
    if settings is None or not scans or any(source.road is not None for source in sources):
        return
    known = sorted({f"{source.sensor} ({source.table})" for source in sources})
    raise ConfigError(
        "[segmentation] finds no sensor whose profiles lie across the road: there is " + ", ".join(known),
        expected="scans of a sensor that looks down, its x along the driving direction",
        change="name sensors of scans in segmentation.sensors, or take the section out",
    )


def road_key(source: ReadingSource) -> list[object]:
    """Return the key by which tiles become stale when a source's segmentation changes; empty where it has none."""
    return [] if source.road is None else [source.road.model_dump(mode="json", exclude={"sensors"})]
