"""The control points of a scene: painted targets and plates, or points along the lanes."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from roadscan.simulate.bodies import place_at
from roadscan.simulate.scene import Scene
from roadscan.simulate.surface import Surface

PAINT, PLATE = "PAINT", "PLATE"
"""Surveyor's codes: of a point on the road, and of an upright target."""


@dataclass(frozen=True)
class ControlMark:
    """A control point as it is."""

    name: str
    code: str
    role: str
    style: str
    """Of a target; empty where nothing marks the point."""
    size_m: float
    """Edge or diameter of the target."""
    enh_m: tuple[float, float, float]
    """Easting, northing, height of its middle."""


def control_marks(scene: Scene, surface: Surface) -> list[ControlMark]:
    """Return the control points: painted targets and plates, or points along both edges of the lanes, every third a
    check point.
    """
    marks = [*_painted(scene, surface), *_plates(scene, surface)]
    if marks:
        return marks
    spacing = scene.control.spacing_m
    stations = np.arange(min(spacing, scene.length_m) / 2, scene.length_m, spacing)
    offset = scene.road.half_width_m - scene.control.inset_m
    places = np.stack(np.meshgrid(stations, [-offset, offset], indexing="ij"), axis=-1).reshape(-1, 2)
    easting, northing, _ = surface.place(places[:, 0], places[:, 1])
    height = surface.height_m(easting, northing, texture=False)
    for i, (e, n, h) in enumerate(zip(easting.tolist(), northing.tolist(), height.tolist(), strict=True)):
        role = "check" if i % 3 == 2 else "gcp"
        marks.append(ControlMark(_name("", role, i), PAINT, role, "", 0.0, (e, n, h)))
    return marks


def write_true_control(marks: Sequence[ControlMark], file: Path) -> None:
    """Write the control points as they are."""
    with file.open("w", encoding="utf-8", newline="") as out:
        rows = csv.writer(out, lineterminator="\n")
        rows.writerow(["name", "code", "role", "style", "size_m", "easting_m", "northing_m", "height_m"])
        for mark in marks:
            words = [mark.name, mark.code, mark.role, mark.style, f"{mark.size_m:g}"]
            rows.writerow([*words, *(f"{value:.6f}" for value in mark.enh_m)])


def _painted(scene: Scene, surface: Surface) -> Iterator[ControlMark]:
    """Yield the painted targets."""
    targets = scene.road.targets
    places = np.array([[t.station_m, t.offset_m] for t in targets], np.float64).reshape(-1, 2)
    easting, northing, _ = surface.place(places[:, 0], places[:, 1])
    height = surface.height_m(easting, northing, texture=False)
    for i, t in enumerate(targets):
        enh = float(easting[i]), float(northing[i]), float(height[i])
        yield ControlMark(_name(t.name, t.role, i), PAINT, t.role, t.style, t.diameter_m, enh)


def _plates(scene: Scene, surface: Surface) -> Iterator[ControlMark]:
    """Yield the upright targets."""
    first, last = scene.stations_m
    listed = [
        (one, one.station_m + k * one.every_m)
        for one in scene.roadside.targets
        for k in range(one.count if one.every_m > 0.0 else 1)
        if first <= one.station_m + k * one.every_m <= last
    ]
    names = [one.name for one, _ in listed]
    for i, (one, station) in enumerate(listed):
        place = place_at(surface, station, one.offset_m)
        enh = surface.origin_enh_m + np.array(place.enh_m) + np.array([0.0, 0.0, one.height_m])
        name = f"{one.name}-{names[:i].count(one.name) + 1}" if names.count(one.name) > 1 and one.name else one.name
        number = len(scene.road.targets) + i
        middle = float(enh[0]), float(enh[1]), float(enh[2])
        yield ControlMark(_name(name, one.role, number), PLATE, one.role, one.style, one.size_m, middle)


def _name(stated: str, role: str, number: int) -> str:
    """Return the stated name, or one of role and number (from 0)."""
    return stated or f"{'C' if role == 'check' else 'G'}{number + 1:03d}"
