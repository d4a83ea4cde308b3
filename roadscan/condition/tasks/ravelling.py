"""Computes ravelled patches of groups of sections, with their outlines and a picture."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.condition.indices.ravelling import looked_through
from roadscan.condition.lane_data import SQUARE_M, LaneData, RavelledPatch, RavelledSection
from roadscan.condition.tasks.values import Group, GroupTask, load_lane
from roadscan.core.canvas import empty_figure
from roadscan.core.extras import can_draw
from roadscan.navigation.tasks.recorded_pictures import NOT_DRAWN
from roadscan.run.engine.compute import damaged_file, reason_of
from roadscan.run.keys import code_digest, key_of
from roadscan.store.digest import file_digest
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.schema import table_schema
from roadscan.tiles.products.geo_table import write_geo_table
from roadscan.tiles.tasks.tiles import TaskResult

RAVELLING: Final = "ravelling_patches"
RAVELLING_PICTURES: Final = "ravelling_pictures"
_FINE_M: Final = 0.5
"""Largest length of an outline's sides, so that it follows bends."""


@dataclass(frozen=True, eq=False)
class PatchTask:
    """A group of sections to search for patches. Sent to workers: it holds no data."""

    task: GroupTask
    key: str

    @property
    def units(self) -> tuple[str, ...]:
        """Name of the group."""
        group = self.task.group
        return (f"{group.lane.road}/{group.lane.name}/{group.number:05d}",)

    def singly(self) -> list[PatchTask]:
        """The same task."""
        return [self]


def plan_patches(tasks: Sequence[GroupTask]) -> list[PatchTask]:
    """Return a task for each group of sections."""
    code = code_digest("roadscan.condition.tasks.ravelling:patches_of_group")
    found = []
    for task in tasks:
        group = task.group
        read = [(r.unit, r.digest) for r in (*group.texture, *(group.edges or ()))]
        line, lane = group.line, group.lane
        places = [line.first_m, line.nodes_m.tolist(), lane.first_m, lane.offset_m.tolist(), lane.sign, lane.width_m]
        settings = [task.config.heights, task.config.least_share, sorted(group.beside.items())]
        found.append(PatchTask(task, key_of(code, group.sections_m, read, places, settings)))
    return found


def due_patches(tasks: Sequence[PatchTask], manifest: Manifest) -> list[PatchTask]:
    """Those that are missing or stale."""
    names = (RAVELLING, RAVELLING_PICTURES) if can_draw() else (RAVELLING,)
    return [t for t in tasks if not all(manifest.is_current(n, t.units[0], t.key) for n in names)]


def patches_of_group(one: PatchTask) -> TaskResult:
    """Compute patches and write them and the picture of a group (runs on a worker)."""
    try:
        lane = load_lane(one.task)
        found = list(zip(lane.sections_m, looked_through(lane), strict=True))
        return TaskResult.of([_write(one, found), _draw(one, lane, found)], [], set())
    except Exception as error:  # noqa: BLE001  a damaged file costs this group
        return TaskResult.of((), [(one.units[0], reason_of(error))], {damaged_file(error)})


Found = Sequence[tuple[tuple[float, float], RavelledSection]]


def _write(one: PatchTask, found: Found) -> OutputRecord:
    """Write the patches as GeoParquet; no file without any."""
    schema, task = table_schema(RAVELLING), one.task
    both = sorted(_rows(task.group, found), key=lambda row: (row[0]["station_m"], row[0]["offset_m"]))
    if not both:
        return OutputRecord(RAVELLING, one.units[0], one.key, "", 0, "")
    table = pa.Table.from_pylist([row for row, _ in both], schema.arrow())
    shapes = np.array([*(shape for _, shape in both), None], object)[:-1]
    target = f"{schema.location}/{one.units[0]}.parquet"
    with task.store.scratch() as folder:
        path = folder / "patches.parquet"
        kinds = sorted({shape.geom_type for _, shape in both})
        write_geo_table(path, table, "outline", shapes, kinds, task.context, counterclockwise=True)
        size, digest = path.stat().st_size, file_digest(path)
        task.store.publish(path, target)
    return OutputRecord(RAVELLING, one.units[0], one.key, target, size, digest)


def _rows(group: Group, found: Found) -> Iterator[tuple[dict[str, Any], shapely.Geometry]]:
    for (from_m, to_m), section in found:
        for patch in section.patches:
            shape = _on_map(group, patch)
            middle, own = shape.centroid, patch.outline.centroid
            row = {
                "road": group.lane.road,
                "lane": group.lane.name,
                "station_m": own.x,
                "offset_m": float(group.lane.offsets(np.array([own.x]), own.y)[0]),
                "section_from_m": from_m,
                "section_to_m": to_m,
                "area_m2": patch.area_m2,
                "sigma_area_m2": patch.sigma_area_m2,
                "texture_mm": patch.texture_mm,
                "background_mm": section.background_mm,
                "ratio": patch.ratio,
                "sigma_ratio": patch.sigma_ratio,
                "loss_mm": patch.loss_mm if math.isfinite(patch.loss_mm) else None,
                "contrast": patch.contrast if math.isfinite(patch.contrast) else None,
                "severity": patch.severity,
                "evidence": patch.evidence,
                "easting_m": middle.x,
                "northing_m": middle.y,
            }
            yield row, shape


def _on_map(group: Group, patch: RavelledPatch) -> shapely.Geometry:
    """Return the outline of a patch in the map CRS."""
    fine = shapely.segmentize(shapely.simplify(patch.outline, 1e-6), _FINE_M)
    xy = shapely.get_coordinates(fine)
    places = group.line.places(xy[:, 0], group.lane.offsets(xy[:, 0], xy[:, 1]))[:, :2]
    return shapely.orient_polygons(shapely.set_coordinates(fine, places))


def _draw(one: PatchTask, lane: LaneData, found: Found) -> OutputRecord:
    """Draw the sections with patches; no file without any."""
    drawn = []
    for (from_m, to_m), section in found:
        if section.patches:
            held = lane.texture.between(from_m, to_m)
            parts = [ring for p in section.patches for ring in shapely.get_parts(p.outline)]
            outlines = tuple(shapely.get_coordinates(part.exterior) for part in parts)
            title = f"{one.task.group.lane.road}, lane {one.task.group.lane.name}, station {from_m:g} to {to_m:g} m"
            corner = float(held.station_m[0]) - SQUARE_M / 2, float(held.offset_m[0]) - SQUARE_M / 2
            drawn.append(DrawnLane(title, held.texture_mm / section.background_mm, corner, SQUARE_M, outlines))
    if not drawn:
        return OutputRecord(RAVELLING_PICTURES, one.units[0], one.key, "", 0, "")
    if not can_draw():
        return OutputRecord(RAVELLING_PICTURES, one.units[0], NOT_DRAWN, "", 0, "")
    target = f"products/{RAVELLING_PICTURES}/{one.units[0].replace('/', '_')}.png"
    with one.task.store.scratch() as folder:
        path = folder / "ravelling.png"
        draw_ravelling(path, drawn)
        size, digest = path.stat().st_size, file_digest(path)
        one.task.store.publish(path, target)
    return OutputRecord(RAVELLING_PICTURES, one.units[0], one.key, target, size, digest)


_DOTS_PER_INCH: Final = 110  # Resolution.
_WIDTH_IN: Final = 11.0  # Width of the picture.
_HEIGHT_IN: Final = 1.7  # Height of a section.
_OUTLINE: Final = "#111111"
_MOST: Final = 2.5
"""Ratio of the darkest colour."""


@dataclass(frozen=True, eq=False)
class DrawnLane:
    """A section of a lane with its patches."""

    title: str
    ratio: npt.NDArray[np.float64]
    """(along, across) texture over that of the section, from left to right; NaN where unknown."""
    corner_m: tuple[float, float]
    """Station, and offset from the lane's middle, of the first square's corner."""
    square_m: float
    outlines_m: tuple[npt.NDArray[Any], ...]
    """(k, 2) stations and offsets from the lane's middle, for each patch."""


def draw_ravelling(path: Path, sections: Sequence[DrawnLane]) -> None:
    """Write the sections one below the other; travel is from left to right, left of the lane is up."""
    figure = empty_figure(_WIDTH_IN, _HEIGHT_IN * len(sections), _DOTS_PER_INCH)
    axes = figure.subplots(len(sections), 1, squeeze=False)[:, 0]
    for one, section in zip(axes, sections, strict=True):
        along, across = section.ratio.shape
        x, y = section.corner_m
        extent = (x, x + along * section.square_m, y + across * section.square_m, y)
        one.set_facecolor("#dfe8f2")
        shown = np.ma.masked_invalid(section.ratio.T)
        one.imshow(shown, cmap="YlOrRd", vmin=1.0, vmax=_MOST, extent=extent, aspect="auto", interpolation="nearest")
        for outline in section.outlines_m:
            one.plot(outline[:, 0], outline[:, 1], color=_OUTLINE, linewidth=1.1)
        one.set_title(f"{section.title}: texture over that of the section, 1 to {_MOST:g}", fontsize=8, loc="left")
        one.set_xlabel("station (m)", fontsize=7)
        one.set_ylabel("to the right (m)", fontsize=7)
        one.tick_params(labelsize=7)
    figure.savefig(path, metadata={"Software": None})
