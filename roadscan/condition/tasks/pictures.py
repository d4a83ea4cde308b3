"""Pictures of condition: a strip chart for each lane and kilometre, and cross-sections at two of its ruts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from roadscan.compute.array_types import Float64
from roadscan.condition.index import condition_indices
from roadscan.condition.kernels.ruts import wire_places
from roadscan.condition.lane_data import LaneData
from roadscan.condition.tasks.values import VALUES, Group, GroupTask, load_lane
from roadscan.condition.wheel_paths import WholeSections
from roadscan.core.canvas import empty_figure
from roadscan.core.extras import can_draw
from roadscan.run.keys import code_digest, key_of
from roadscan.store.digest import file_digest
from roadscan.store.manifest import Manifest, OutputRecord, recorded_table
from roadscan.store.schema import table_schema
from roadscan.store.store import Store

if TYPE_CHECKING:
    from matplotlib.axes import Axes


PICTURES: Final = "condition_pictures"
STRIP: Final = "strip"
CROSS_SECTION: Final = "cross_section"
_SURE: Final = 2.0
"""Largest σ relative to the lane's: it is several times as large where few readings lie; else it varies by a third."""
RUT_M: Final = 5.0
"""Length of the median over cross-sections: a rut is longer; a pothole is shorter than half of it."""
_DEPTHS: Final = ("rut_depth_left_mm", "rut_depth_right_mm")


@dataclass(frozen=True, eq=False)
class PictureTask:
    """A picture of a group. Sent to workers."""

    task: GroupTask
    kind: str
    """`STRIP` or `CROSS_SECTION`."""
    values: tuple[OutputRecord, ...]
    key: str

    @property
    def unit(self) -> str:
        """Its name in the manifest."""
        group = self.task.group
        return f"{group.lane.road}_{group.lane.name}_{group.number:05d}_{self.kind}.png"


def plan_pictures(tasks: Sequence[GroupTask], manifest: Manifest) -> list[PictureTask]:
    """Both pictures of each group whose values are there; none without Matplotlib."""
    if not can_draw():
        return []
    held = manifest.of(VALUES)
    code = code_digest("roadscan.condition.tasks.pictures:draw_picture")
    drawn = {name: one.drawn for name, one in condition_indices().items()}
    found = []
    for task in tasks:
        group = task.group
        values = tuple(held[u] for u in task.units if u in held)
        shape = [group.sections_m, [(r.unit, r.digest) for r in values], drawn]
        crossed = [(r.unit, r.digest) for r in group.cross_sections]
        if values:
            found.append(PictureTask(task, STRIP, values, key_of(code, "strip", shape)))
            found.append(PictureTask(task, CROSS_SECTION, values, key_of(code, "crossing", shape, crossed)))
    return found


def due_pictures(tasks: Sequence[PictureTask], manifest: Manifest) -> list[PictureTask]:
    """Return those that are missing or stale."""
    return [t for t in tasks if not manifest.is_current(PICTURES, t.unit, t.key)]


def draw_picture(one: PictureTask) -> OutputRecord:
    """Draw and write a picture (runs on a worker)."""
    store, group = one.task.store, one.task.group
    values = _values(store, one.values)
    target = f"products/{PICTURES}/{one.unit}"
    with store.scratch() as folder:
        path = folder / one.unit
        drawn = _strip(path, group, values) if one.kind == STRIP else _crossing(path, one.task, values)
        if not drawn:
            return OutputRecord(PICTURES, one.unit, one.key, "", 0, "")
        size, digest = path.stat().st_size, file_digest(path)
        store.publish(path, target)
    return OutputRecord(PICTURES, one.unit, one.key, target, size, digest)


def _values(store: Store, records: Sequence[OutputRecord]) -> pa.Table:
    schema = table_schema(VALUES).arrow()
    parts = [recorded_table(store, r).cast(schema) for r in records]
    return pa.concat_tables([schema.empty_table(), *parts])


def _strip(path: Path, group: Group, values: pa.Table) -> bool:
    rows = values.filter(pc.equal(values["extent"], "section"))
    panels = []
    for index in condition_indices().values():
        strips = [_of_quantity(rows, name) for name in index.drawn]
        known = [s for s in strips if np.isfinite(s.value).any()]
        if known:
            panels.append(known)
    span = group.sections_m[0][0], group.sections_m[-1][1]
    draw_strips(path, _title(group), panels, span)
    return True


def _of_quantity(rows: pa.Table, name: str) -> Strip:
    own = rows.filter(pc.equal(rows["quantity"], name)).sort_by("station_from_m")
    unit = own["unit"][0].as_py() if own.num_rows else ""
    return Strip(name, unit, *(own[c].to_numpy() for c in ("station_from_m", "station_to_m", "value")))


def _crossing(path: Path, task: GroupTask, values: pa.Table) -> bool:
    """Draw the cross-sections at the typical and at the deepest rut; return False where none is known."""
    lane: LaneData = load_lane(task)
    whole = WholeSections.of(lane)
    if not whole.rows.size:
        return False
    station = lane.cross_sections.station_m[whole.rows]
    depths, sigmas = (
        np.stack([_by_station(values, name, station, of) for name in _DEPTHS]) for of in ("value", "sigma")
    )
    chosen = chosen_ruts(station, depths, sigmas)
    x, crossings = lane.cross_sections.offset_m, []
    for word, (k, smooth) in chosen.items():
        height = whole.height_m[k]
        wire = np.zeros(x.size, np.int64)
        count = wire_places(x, height, wire)
        told = {
            f"{side} rut": (float(depths[n, k]), float(sigmas[n, k]), float(smooth[n]))
            for n, side in enumerate(("left", "right"))
        }
        title = f"{word} rut, station {station[k]:,.1f} m"
        crossings.append(Crossing(title, x, height, wire[:count], told))
    if crossings:
        draw_crossings(path, _title(task.group), crossings)
    return bool(crossings)


def chosen_ruts(
    station_m: npt.NDArray[np.float64], depths_mm: npt.NDArray[np.float64], sigmas_mm: npt.NDArray[np.float64]
) -> dict[str, tuple[int, npt.NDArray[np.float64]]]:
    """Return the cross-sections to show, with both depths (2,) as medians over `RUT_M`; empty without a depth.

    `typical` is where the deeper rut has its median depth, `deepest` where it is deepest. Of the cross-sections there,
    the one whose depths are nearest to the medians is taken, which leaves out potholes. None is chosen where σ is more
    than `_SURE` times that of the lane, as at the end of a drive with few readings, since noise then makes depths.

    Parameters
    ----------
    station_m : (n,) ascending.
    depths_mm, sigmas_mm : (2, n) left and right, NaN where not measured.
    """
    sure = ~(sigmas_mm > _SURE * np.nanmedian(sigmas_mm)) if np.isfinite(sigmas_mm).any() else np.isfinite(depths_mm)
    depths_mm = np.where(sure, depths_mm, np.nan)
    smooth = np.full_like(depths_mm, np.nan)
    around = [np.flatnonzero(np.abs(station_m - at) <= RUT_M / 2) for at in station_m]
    for k, near in enumerate(around):
        known = np.isfinite(depths_mm[:, near])
        if 2 * known.sum(axis=1).min() > near.size and station_m[near[-1]] - station_m[near[0]] > RUT_M / 2:
            smooth[:, k] = np.nanmedian(depths_mm[:, near], axis=1)
    deeper = smooth.max(axis=0)
    there = np.flatnonzero(np.isfinite(deeper))
    if not there.size:
        return {}
    of_median = there[np.argmin(np.abs(deeper[there] - np.median(deeper[there])))]
    found = {}
    for word, k in (("typical", of_median), ("deepest", there[np.argmax(deeper[there])])):
        away = np.abs(depths_mm[:, around[k]] - smooth[:, k, None]).max(axis=0)
        found[word] = (int(around[k][np.nanargmin(away)]), smooth[:, k])
    return found


def _by_station(values: pa.Table, name: str, station_m: npt.NDArray[Any], column: str) -> npt.NDArray[np.float64]:
    own = values.filter(pc.equal(values["quantity"], name)).sort_by("station_from_m")
    at, value = own["station_from_m"].to_numpy(), own[column].to_numpy()
    if not at.size:
        return np.full(station_m.size, np.nan)
    place = np.minimum(np.searchsorted(at, station_m - 1e-6), at.size - 1)
    return np.where(np.abs(at[place] - station_m) < 1e-3, value[place], np.nan)


def _title(group: Group) -> str:
    named = f"{group.line.name} ({group.lane.road})" if group.line.name else group.lane.road
    return f"{named}, lane {group.lane.name}, {group.lane.direction}"


_COLOURS: Final = ("#1f5fa8", "#c8501e", "#3b8a3e", "#7a4fa3")
_DOTS_PER_INCH: Final = 110  # Resolution of the pictures.


@dataclass(frozen=True, eq=False)
class Strip:
    """Values of one quantity of sections."""

    quantity: str
    unit: str
    from_m: Float64
    to_m: Float64
    value: Float64
    """Values; NaN where a section has none."""


def draw_strips(path: Path, title: str, panels: Sequence[Sequence[Strip]], span_m: tuple[float, float]) -> None:
    """Write a chart of a lane: one panel per index, its values as steps over the station."""
    figure = empty_figure(11.0, 0.9 + 1.5 * max(len(panels), 1), _DOTS_PER_INCH)
    axes = figure.subplots(max(len(panels), 1), 1, sharex=True, squeeze=False)[:, 0]
    for one, strips in zip(axes, panels, strict=False):
        _draw_panel(one, strips)
    axes[0].set_title(title, fontsize=9, loc="left")
    axes[-1].set_xlabel("station (m)", fontsize=8)
    axes[-1].set_xlim(*span_m)
    figure.savefig(path, metadata={"Software": None})


def _draw_panel(axes: Axes, strips: Sequence[Strip]) -> None:
    greatest = 0.0
    for strip, colour in zip(strips, _COLOURS, strict=False):
        x = np.column_stack([strip.from_m, strip.to_m, strip.to_m]).ravel()
        y = np.column_stack([strip.value, strip.value, np.full(strip.value.size, np.nan)]).ravel()
        axes.plot(x, y, color=colour, linewidth=1.8, label=_without_unit(strip.quantity))
        known = strip.value[np.isfinite(strip.value)]
        greatest = max(greatest, float(known.max()) if known.size else 0.0)
        lacking = np.flatnonzero(np.isnan(strip.value))
        for k in lacking.tolist():
            axes.axvspan(strip.from_m[k], strip.to_m[k], color="#eeeeee", linewidth=0)
    if greatest > 0.0 and all((s.value[np.isfinite(s.value)] >= 0.0).all() for s in strips):
        axes.set_ylim(0.0, 1.15 * greatest)
    axes.set_ylabel(strips[0].unit if strips else "", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.grid(color="#e6e6e6", linewidth=0.6)
    axes.legend(fontsize=7, loc="upper right", ncols=4, frameon=False)


def _without_unit(quantity: str) -> str:
    """Return the name of a quantity in the legend, without the unit, which the axis shows."""
    for unit in ("_m_per_km", "_percent", "_mm", "_m"):
        quantity = quantity.removesuffix(unit)
    return quantity.replace("_", " ")


@dataclass(frozen=True, eq=False)
class Crossing:
    """A cross-section to draw."""

    title: str
    """Which one it is, and where."""
    offset_m: Float64
    """(m,) from the lane's middle, positive to the right in the direction of travel."""
    height_m: Float64
    """(m,) finite."""
    wire: npt.NDArray[np.int64]
    """Indices of the points on which the wire rests."""
    told: Mapping[str, tuple[float, float, float]]
    """Depths (mm) that stand in the title, by name: of this cross-section with its σ, and the median of those around
    it."""


def draw_crossings(path: Path, title: str, crossings: Sequence[Crossing]) -> None:
    """Write a picture of cross-sections below each other, their tilt taken out, with the wire over each."""
    figure = empty_figure(9.0, 0.4 + 3.0 * len(crossings), _DOTS_PER_INCH)
    places = figure.subplots(len(crossings), 1, sharex=True, squeeze=False)[:, 0]
    levels = [_level(crossing) for crossing in crossings]
    low, high = min(float(level.min()) for level in levels), max(float(level.max()) for level in levels)
    for axes, crossing, level in zip(places, crossings, levels, strict=True):
        _draw_crossing(axes, crossing, level)
        axes.set_ylim(low - 2.0, high + 2.0)  # a common scale, so that depths can be compared
    figure.suptitle(title, fontsize=9, x=0.01, ha="left")
    places[-1].set_xlabel("offset from the lane's middle, right in the direction of travel (m)", fontsize=8)
    figure.savefig(path, metadata={"Software": None})


def _level(crossing: Crossing) -> Float64:
    """Return heights (m,) above the straight line through them (mm)."""
    x = crossing.offset_m
    tilt = np.polynomial.polynomial.polyval(x, np.polynomial.polynomial.polyfit(x, crossing.height_m, 1))
    return np.asarray(1e3 * (crossing.height_m - tilt), dtype=np.float64)


def _draw_crossing(axes: Axes, crossing: Crossing, level: Float64) -> None:
    x, wire = crossing.offset_m, crossing.wire
    axes.plot(x, level, color="#333333", linewidth=1.4, label="road")
    axes.plot(x[wire], level[wire], color=_COLOURS[1], linewidth=1.2, marker="o", markersize=2.5, label="wire")
    axes.fill_between(x, level, np.interp(x, x[wire], level[wire]), color=_COLOURS[1], alpha=0.15, linewidth=0)
    told = ", ".join(
        f"{name} {own:.1f} ± {sigma:.1f} mm (over 5 m {near:.1f} mm)"
        for name, (own, sigma, near) in crossing.told.items()
    )
    axes.set_title(f"{crossing.title}: {told}", fontsize=9, loc="left")
    axes.set_ylabel("height without its tilt (mm)", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.grid(color="#e6e6e6", linewidth=0.6)
    axes.legend(fontsize=7, frameon=False)
