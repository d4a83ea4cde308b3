"""Checks of rows that people changed: each fault names its table, row and reason."""

from __future__ import annotations

import datetime as dt
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.inventory.comparing import Change, Changes
from roadscan.inventory.home import EditFault
from roadscan.inventory.questions import questions_of
from roadscan.inventory.state import State
from roadscan.store.asset_schema import AssetColumn, asset_schema
from roadscan.store.inventory_schema import GEOMETRY, asset_columns, editable_columns

_FORMULA: Final = re.compile(r"^[=@\t\r\n＝＋－＠]|^[+-](?![\s\d.,])|^[+-].*(\w\(|\||![$A-Za-z])", re.DOTALL)
"""Texts that a spreadsheet would run on opening: calls and links to others, but not `+1` or `- leans`."""
_CONTROL: Final = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f]")
"""Control characters, which no text contains and at which some homes truncate a text."""
_SAME_PLACE_M: Final = 0.05  # New points nearer than this (m) to an asset of their kind are duplicates.
_AROUND_M: Final = 100.0  # Radius (m) within which other assets show the usual height.
_LEAST_HEIGHT_M: Final = 2.0  # Height 0 is a fault where assets around stand higher or lower than this (m).


def faults_of(changes: Changes, state: State, unit_m: float = 1.0, confirmed: Collection[str] = ()) -> list[EditFault]:
    """Returns the faults of all changes, those found by the comparison first; then the questions.

    Parameters
    ----------
    state : the inventory that the changes are to be taken into.
    unit_m : metres of a unit of its map.
    confirmed : records, and layers with deletions, that a person confirmed; `all` stands for each.
    """
    found = list(changes.faults)
    drawn = {change.asset_id for change in changes.drawn}
    kinds = state.kind_of | {change.asset_id: change.kind for change in changes.drawn}
    for change in (*changes.drawn, *changes.changed):
        reason = _fault(change, kinds, state, is_new=change.asset_id in drawn)
        if reason is not None:
            found.append(EditFault(asset_schema(change.kind).table, change.record, reason))
    found += _doubles(changes, state, unit_m)
    found += _at_zero(changes, state, unit_m)
    found += _circles(changes, state)
    found += _spans(changes, state)
    faulty = {(fault.table, fault.record) for fault in found}
    asked = questions_of(changes, state) if "all" not in confirmed else ()
    found += [one for one in asked if one.record not in confirmed and (one.table, one.record) not in faulty]
    return found


def _fault(change: Change, kinds: Mapping[str, str], state: State, *, is_new: bool) -> str | None:
    if change.attribute == GEOMETRY:
        return _geometry_fault(change.kind, change.new)
    if change.attribute not in editable_columns(change.kind):
        return None if is_new else f"{change.attribute} was measured and is not edited: give it back {change.old!r}"
    if change.attribute == "parent":
        return _parent_fault(change, kinds, state)
    column = next(c for c in asset_columns(change.kind) if c.name == change.attribute)
    return _value_fault(column, change.new)


def _geometry_fault(kind: str, content: bytes | None) -> str | None:
    wanted = asset_schema(kind).geometry.removesuffix("Z")
    if content is None:
        return "it has no geometry"
    try:
        shape = shapely.from_wkb(content)
    except shapely.errors.ShapelyError as error:
        return f"its geometry cannot be read: {error}"
    if shape.is_empty:
        return "its geometry is empty"
    if shape.geom_type != wanted:
        return f"its geometry is a {shape.geom_type}, where a {wanted} is expected"
    coordinates = shapely.get_coordinates(shape, include_z=True)
    if not np.isfinite(coordinates[:, :2]).all():
        return "its geometry has a coordinate that is no number"
    if not shape.has_z or not np.isfinite(coordinates[:, 2]).all():
        return "its geometry has no height: give each point its Z"
    if kind != "facade" and not shape.is_valid:  # a façade stands upright
        return f"its geometry is not valid: {shapely.is_valid_reason(shape)}"
    return None


def _value_fault(column: AssetColumn, value: Any) -> str | None:
    if value is None:
        return "status is empty" if column.name == "status" else None
    if column.values and value not in column.values:
        return f"{column.name} is '{value}', expected one of {', '.join(column.values)}"
    if column.min is not None and value < column.min:
        return f"{column.name} is {value:g}, below {column.min:g}"
    if column.max is not None and value > column.max:
        return f"{column.name} is {value:g}, above {column.max:g}"
    if isinstance(value, float) and not np.isfinite(value):
        return f"{column.name} is no finite number"
    if isinstance(value, str) and (odd := _CONTROL.search(value)):
        return f"{column.name} holds the control character {odd[0]!r}: remove it"
    if isinstance(value, str) and _FORMULA.match(value):
        return f"{column.name} begins as a spreadsheet's formula does ({value[:20]!r}): write it otherwise"
    return None


def _parent_fault(change: Change, kinds: Mapping[str, str], state: State) -> str | None:
    if change.new is None:
        return None
    kind = kinds.get(change.new)
    row = None if kind is None else state.row(change.new)
    allowed = asset_schema(change.kind).parents
    if kind is None:
        return f"its parent '{change.new}' is not known"
    if row is not None and row["status"] == "rejected":
        return f"its parent '{change.new}' was rejected"
    if kind not in allowed:
        return f"its parent '{change.new}' is a {kind}, expected {' or '.join(allowed) or 'none'}"
    return None


def _doubles(changes: Changes, state: State, unit_m: float) -> Iterator[EditFault]:
    """Yields faults for new points on an asset of their kind, and for new shapes that equal an existing one."""
    for change in changes.drawn:
        assets = state.assets.get(change.kind)
        if assets is None or not assets.ids.size or _geometry_fault(change.kind, change.new) is not None:
            continue
        shape = shapely.from_wkb(change.new)
        if shape.geom_type == "Point":
            away = shapely.distance(assets.shapes, shape) * unit_m
        else:
            equal = shapely.equals(assets.shapes, shape)
            away = np.where(equal, 0.0, np.inf)
        near = np.flatnonzero((away <= _SAME_PLACE_M) & (assets.ids != change.asset_id))
        if near.size:
            other = str(assets.ids[near[0]])
            yield EditFault(asset_schema(change.kind).table, change.record, f"it stands where {other} is: one of them")


def _at_zero(changes: Changes, state: State, unit_m: float) -> Iterator[EditFault]:
    """Yields faults for shapes at height 0, which programs write where none is set, among assets at other heights."""
    for change in (*changes.drawn, *changes.changed):
        if change.attribute != GEOMETRY or _geometry_fault(change.kind, change.new) is not None:
            continue
        points = shapely.get_coordinates(shapely.from_wkb(change.new), include_z=True)
        if points[:, 2].any():
            continue
        around = _heights_around(state, points[0, :2] * unit_m)
        if around.size and abs(float(np.median(around))) > _LEAST_HEIGHT_M:
            reason = f"its height is 0, and assets around it stand at {np.median(around):.1f}: give each point its Z"
            yield EditFault(asset_schema(change.kind).table, change.record, reason)


def _heights_around(state: State, place_m: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Returns heights (n,) of the assets within 100 m of a place (m)."""
    found = [np.empty(0)]
    for assets in state.assets.values():
        x, y, z = (
            np.asarray(assets.rows[name].to_numpy(zero_copy_only=False), dtype=float)
            for name in ("easting_m", "northing_m", "height_m")
        )
        found.append(z[(np.hypot(x - place_m[0], y - place_m[1]) <= _AROUND_M) & np.isfinite(z)])
    return np.concatenate(found)


def _circles(changes: Changes, state: State) -> Iterator[EditFault]:
    """Yields faults for assets to which a chain of their parents leads back."""
    given = {c.asset_id: c for c in changes.changed if c.attribute == "parent" and c.new is not None}
    if not given:
        return
    parents = {
        str(one): parent
        for assets in state.assets.values()
        for one, parent in zip(assets.ids, assets.rows["parent"].to_pylist(), strict=True)
    } | {one: change.new for one, change in given.items()}
    for one, change in given.items():
        seen, at = {one}, change.new
        while at is not None and at not in seen:
            seen.add(at)
            at = parents.get(at)
        if at == one:
            yield EditFault(asset_schema(change.kind).table, change.record, "it would be its own parent")


def _spans(changes: Changes, state: State) -> Iterator[EditFault]:
    dates: dict[str, dict[str, Change]] = {}
    for change in changes.changed:
        if change.attribute in ("valid_from", "valid_to"):
            dates.setdefault(change.asset_id, {})[change.attribute] = change
    for one, own in dates.items():
        row: Mapping[str, Any] = state.row(one) or {}
        value: Callable[[str], dt.date | None] = lambda name: own[name].new if name in own else row.get(name)  # noqa: B023, E731
        start, end = value("valid_from"), value("valid_to")
        if start is not None and end is not None and end < start:
            change = next(iter(own.values()))
            reason = f"valid_to {end} lies before valid_from {start}"
            yield EditFault(asset_schema(change.kind).table, change.record, reason)
