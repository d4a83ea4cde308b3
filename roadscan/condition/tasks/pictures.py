"""Pictures of condition: a strip chart for each lane and kilometre, and cross-sections at two of its ruts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from roadscan.condition.index import condition_indices
from roadscan.condition.kernels.ruts import wire_places
from roadscan.condition.lane_data import LaneData
from roadscan.condition.of_sections.whole_sections import WholeSections
from roadscan.condition.picture import Crossing, Strip, draw_crossings, draw_strips
from roadscan.condition.tasks.values import VALUES, Group, GroupTask, load_lane
from roadscan.core.extras import can_draw
from roadscan.run.code_reach import code_digest
from roadscan.run.engine.fingerprint import key_of
from roadscan.store.digest import file_digest
from roadscan.store.manifest import Manifest, OutputRecord, recorded_table
from roadscan.store.schema import table_schema
from roadscan.store.store import Store

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
