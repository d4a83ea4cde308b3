"""Checks of rows that people changed: each fault names its table, row and reason."""

from __future__ import annotations

import datetime as dt
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.core.witness import Witness
from roadscan.inventory.comparing import SAME_PLACE_M, Change, Changes
from roadscan.inventory.home import EditFault
from roadscan.inventory.state import State
from roadscan.store.asset_schema import GEOMETRY, AssetColumn, asset_columns, asset_schema, editable_columns

PLACES_OF_EDITS: Final = Witness(
    name="places_of_edits",
    input="inventory edits",
    fault="A person put an asset kilometres away, swapped its axes, or gave it a height of another system.",
    asks="the former place of the asset, and the places and heights of the assets around it",
    does="the edit is not taken in until the person confirms it: `pull --confirm ID`, or *It is right* in the page",
    told=("error",),
)
DELETED_LAYER: Final = Witness(
    name="deleted_layer",
    input="inventory edits",
    fault="A layer was emptied, or holds what was selected alone: each row that is missing would say that it is gone.",
    asks="how many of the layer's assets are missing: over half of it and 3, or over a tenth and 20",
    does="no deletion of the layer is taken in until the person confirms it: `pull --confirm LAYER`",
    told=("error",),
)
SIZES_OF_EDITS: Final = Witness(
    name="sizes_of_edits",
    input="inventory edits",
    fault="A length or height that a person gave is in another unit, or a digit was lost or doubled.",
    asks="what was found and its σ, the former value, the largest one of the kind, and whether several values of the "
    "column differ by the factor of one unit",
    does="the edit is not taken in until the person confirms it: `pull --confirm ID`, or *It is right* in the page",
    told=("error",),
)
_MOST_AND: Final = ((0.5, 3), (0.1, 20))
"""Shares of a layer, and numbers of assets, from which deletions are questioned: persons delete one by one."""
_TIMES: Final = 2.5
"""Ratio of sizes that is questioned: below the least factor between confused units (2.54 cm are an inch)."""
_SIZE_M: Final = 0.5
"""Smaller differences of sizes (m) are everyday corrections: a kerb, a diameter, the height of a bush."""
_SIGMAS: Final = 5.0  # Sizes within this many σ of what was found are not questioned.
_UNIT_FACTORS: Final = {  # new value over former one: the unit that the new value is in
    3.28084: "feet",
    0.3048: "metres out of feet",
    39.3701: "inches",
    100.0: "centimetres",
    1000.0: "millimetres",
    0.01: "metres out of centimetres",
    0.001: "metres out of millimetres",
}
_SAME_FACTOR: Final = 0.01
"""Relative tolerance of a factor between units: values have few digits."""
_SEVERAL: Final = 3  # Values of a kind from which a unit or a usual size is derived.
_MOVED_M: Final = 100.0
"""Moves farther than this (m) are questioned: no sensor of a survey sees as far."""
_DRAWN_M: Final = 1000.0
"""A place farther than this (m) from all known assets is questioned: roads of a survey are connected."""
_AROUND_M: Final = 100.0  # Radius (m) within which other assets show the usual height.
_RISE_M: Final = 10.0
"""Allowed rise (m): from the foot of a mast to the sign on its gantry, or from a road to one on the bridge over it."""
_SLOPE: Final = 0.15
"""Slope of the steepest public roads (m/m), from one asset to the next."""
_FACADE_RISE_M: Final = 100.0
"""Height of the tallest façades along a road (m)."""


def questions_of(changes: Changes, state: State) -> Iterator[EditFault]:
    """Yields possible but unlikely changes, compared with the inventory that they are to be taken into."""
    yield from _emptied(changes, state)
    yield from _sizes(changes, state)
    yield from _places(changes, state)


def _emptied(changes: Changes, state: State) -> Iterator[EditFault]:
    """Yields questions for layers of which all or many rows are missing; their record is the name of the layer."""
    for kind, count in Counter(kind for kind, one in changes.deleted if _stands(state, one)).items():
        held = sum(_stands(state, one) for one in changes.before[kind]["asset_id"].to_pylist())
        if any(count > share * held and count >= least for share, least in _MOST_AND):
            table = asset_schema(kind).table
            reason = f"{count} of the {held} assets of the layer are missing, which would say that they are gone"
            yield EditFault(table, table, reason, is_question=True)


def _stands(state: State, asset_id: str) -> bool:
    row = state.row(asset_id)
    return row is not None and row["status"] != "rejected"


def _sizes(changes: Changes, state: State) -> Iterator[EditFault]:
    """Yields questions for lengths and heights that are unlike what was found."""
    drawn = {change.asset_id for change in changes.drawn}
    reshaped = drawn | {change.asset_id for change in changes.changed if change.attribute == GEOMETRY}
    given = [
        change
        for change in changes.changed
        if change.attribute in _lengths(change.kind)
        and isinstance(change.new, float)
        and np.isfinite(change.new)
        and not (change.attribute == "length_m" and change.asset_id in reshaped)
    ]
    units = {id(change): _unit_between(change) for change in given}
    alike = Counter((change.kind, change.attribute, units[id(change)]) for change in given)
    for change in given:
        unit = units[id(change)]
        several = alike[change.kind, change.attribute, unit]
        reason = _other_size(change, state, is_new=change.asset_id in drawn)
        if unit and several >= _SEVERAL:
            reason = f"{change.attribute} is {change.new:g} and was {change.old:g}, as {several} values are: {unit}?"
        if reason is not None:
            yield EditFault(asset_schema(change.kind).table, change.record, reason, is_question=True)


def _lengths(kind: str) -> Collection[str]:
    """Returns the columns of a kind that are sizes in metres and that people may change."""
    own = {column.name for column in asset_schema(kind).own if column.unit == "m" and column.type == "float64"}
    return own & editable_columns(kind)


def _unit_between(change: Change) -> str:
    """Returns the unit whose factor lies between the former value and the new one; "" for none."""
    if not change.old or not change.new:
        return ""
    ratio = change.new / change.old
    return next((unit for factor, unit in _UNIT_FACTORS.items() if abs(ratio / factor - 1.0) < _SAME_FACTOR), "")


def _other_size(change: Change, state: State, *, is_new: bool) -> str | None:
    """Returns why a size is unlike the found and the former one; for a new asset, unlike all of its kind."""
    if is_new:
        assets = state.assets.get(change.kind)
        known = [] if assets is None else assets.rows[change.attribute].drop_null().to_pylist()
        if len(known) < _SEVERAL or change.new <= max(_TIMES * max(known), max(known) + _SIZE_M):
            return None
        return f"{change.attribute} is {change.new:g}, and the largest one of its kind is {max(known):g}"
    row = state.row(change.asset_id, evidence=True) or {}
    found = row.get(change.attribute)
    sigma_m = max(row.get("sigma_size_m") or 0.0, row.get("sigma_height_m") or 0.0)
    stood = [value for value in (found, change.old) if value is not None]
    if not stood or any(_is_like(change.new, value, sigma_m) for value in stood):
        return None
    words = f"{found:.3g} ± {sigma_m:.2g} was found" if found is not None else f"it was {change.old:.3g}"
    return f"{change.attribute} is {change.new:g}, and {words}"


def _is_like(new: float, value: float, sigma_m: float) -> bool:
    near = abs(new - value) <= max(_SIZE_M, _SIGMAS * sigma_m)
    return near or value / _TIMES <= new <= value * _TIMES


def _places(changes: Changes, state: State) -> Iterator[EditFault]:
    given = [one for one in (*changes.drawn, *changes.changed) if one.attribute == GEOMETRY and one.new is not None]
    if not given:
        return
    known_m, units_m = _known_places(state), state.units_m
    for change in given:
        try:
            shape = shapely.from_wkb(change.new)
        except shapely.errors.ShapelyError:
            continue  # a fault, which is reported as one
        places = shapely.get_coordinates(shape, include_z=True) * (units_m[0], *units_m)
        if not places.size or not np.isfinite(places).all():
            continue  # a fault as well
        former = None if change.old is None else shapely.from_wkb(change.old)
        reason = _far(places, former, known_m, units_m[0]) or _other_height(change.kind, places, known_m)
        if reason is not None:
            yield EditFault(asset_schema(change.kind).table, change.record, reason, is_question=True)


def _known_places(state: State) -> npt.NDArray[np.float64]:
    """Returns reference points (n, 3) of all assets (m)."""
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
    """Returns the distance (m) from each of a few places to the nearest known one."""
    return np.array([np.hypot(known[:, 0] - x, known[:, 1] - y).min() for x, y, _ in places])


def _other_height(kind: str, places: npt.NDArray[np.float64], known_m: npt.NDArray[np.float64]) -> str | None:
    """Returns why the heights of a shape are like those of no asset around it, itself included; None where they are.

    Where no asset stands near, the nearest one is compared.
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


_FORMULA: Final = re.compile(r"^[=@\t\r\n＝＋－＠]|^[+-](?![\s\d.,])|^[+-].*(\w\(|\||![$A-Za-z])", re.DOTALL)
"""Texts that a spreadsheet would run on opening: calls and links to others, but not `+1` or `- leans`."""
_CONTROL: Final = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f]")
"""Control characters, which no text contains and at which some homes truncate a text."""
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
        near = np.flatnonzero((away <= SAME_PLACE_M) & (assets.ids != change.asset_id))
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
