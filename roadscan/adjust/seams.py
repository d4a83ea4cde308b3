"""Seam: the surfaces of two passes at one place, as recorded and as corrected."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from roadscan.adjust.patches import PassReadings, Patch, map_from_level, patch_of
from roadscan.adjust.places import Place
from roadscan.adjust.tie_settings import TieSettings
from roadscan.compute.array_types import Float64
from roadscan.poses.mounting_change import MountingChange, Seat
from roadscan.poses.trajectory import Corrections

_SECTION: Final = 0.2
"""Share of the patch, about its middle, whose rows are averaged to a cross-section."""


@dataclass(frozen=True)
class SeamView:
    """Two passes at a place, before and after."""

    cell_m: float
    difference_m: Float64
    """(2, k, k) height of the second pass minus that of the first, before and after; rows along, columns across, NaN in
    cells that one of them did not see."""
    across_m: Float64
    """(k,) middles of the columns, positive to the right."""
    section_m: Float64
    """(2, 2, k) cross-sections, before and after, of the first and the second pass, above one plane; NaN as above."""

    @property
    def median_m(self) -> tuple[float, float]:
        """Returns the median difference before and after."""
        before, after = (float(np.nanmedian(d)) for d in self.difference_m)
        return before, after


def seam_view(
    place: Place,
    readings: tuple[PassReadings, PassReadings],
    corrections: tuple[Corrections | None, Corrections | None],
    settings: TieSettings,
    mountings: tuple[tuple[MountingChange, Seat] | None, tuple[MountingChange, Seat] | None] = (None, None),
) -> SeamView | None:
    """Returns both passes at a place, without and with their corrections; None where they have no cell in common."""
    states = [readings, tuple(moved(*one) for one in zip(readings, corrections, mountings, strict=True))]
    patches = [[patch_of(place, r, settings.cell_m, settings.least_readings) for r in pair] for pair in states]
    known = [[p for p in pair if p is not None] for pair in patches]
    if any(len(pair) < 2 for pair in known):
        return None
    difference = np.stack([second.height_m - first.height_m for first, second in known])
    if not np.isfinite(difference).any(axis=(1, 2)).all():
        return None
    plane = _plane(known[1])
    sections = np.array([[_section(p.height_m - plane) for p in pair] for pair in known])
    return SeamView(settings.cell_m, difference, known[0][0].middle_m, sections)


def moved(
    readings: PassReadings, corrections: Corrections | None, mounting: tuple[MountingChange, Seat] | None = None
) -> PassReadings:
    """Returns the readings of a traverse with corrected poses; corrections are small, so turns are linear.

    mounting : change of that of the sensor, with lever arm and beams.
    """
    if (corrections is None and mounting is None) or not readings.pose.size:
        return readings
    points = np.stack([readings.easting_m, readings.northing_m, readings.height_m], axis=-1)
    pose = readings.pose.astype(np.int64)
    arm, level = readings.arm_body_m(points, pose), np.zeros(points.shape)
    if corrections is not None:
        shift, turn = corrections.at(readings.epoch_gps_ns)
        swung = np.cross(turn[pose], arm)
        level = level + shift[pose] + np.einsum("nij,nj->ni", readings.level_from_body[pose], swung)
    if mounting is not None:
        level = level + mounting[0].moves_level(readings.level_from_body[pose], arm, mounting[1])
    there = points + map_from_level(level, readings.convergence_rad)
    easting, northing, height = (np.ascontiguousarray(there[:, k]) for k in range(3))
    return replace(readings, easting_m=easting, northing_m=northing, height_m=height)


def _plane(pair: list[Patch]) -> Float64:
    """Returns the plane (k, k) through the cells of two passes."""
    middle = pair[0].middle_m
    row, column = np.nonzero(np.isfinite(np.stack([p.height_m for p in pair])).any(axis=0))
    height = np.nanmean(np.stack([p.height_m[row, column] for p in pair]), axis=0)
    design = np.stack([np.ones(row.size), middle[row], middle[column]], axis=-1)
    level = float(height.mean())
    plane, *_ = np.linalg.lstsq(design, height - level, rcond=None)
    return np.asarray(level + plane[0] + plane[1] * middle[:, None] + plane[2] * middle)


def _section(height_m: Float64) -> Float64:
    """Returns the mean (k,) over the rows about the middle; NaN in columns that were not seen there."""
    edge = len(height_m)
    half = max(round(0.5 * _SECTION * edge), 1)
    rows = height_m[edge // 2 - half : edge // 2 + half]
    count = np.isfinite(rows).sum(axis=0)
    return np.where(count > 0, np.nansum(rows, axis=0) / np.maximum(count, 1), np.nan)
