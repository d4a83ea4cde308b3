"""What differs between two states of the inventory."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from roadscan.inventory.state import Assets, State
from roadscan.inventory.values import encoded
from roadscan.tables.asset_schema import asset_kind_names
from roadscan.tables.inventory_schema import GEOMETRY, asset_table

_OF_THE_EVIDENCE: Final = frozenset(
    {
        "asset_id", "object", "easting_m", "northing_m", "height_m", "sigma_horizontal_m", "sigma_height_m",
        "probability", "returns", "passes", "first_epoch_gps_ns", "last_epoch_gps_ns",
    }
)  # fmt: skip
"""Columns that tell of the evidence alone, or what the geometry tells."""


class Difference(NamedTuple):
    """An asset, or one value of it, that differs."""

    asset_id: str
    kind: str
    change: str
    """`added`, `removed` or `changed`."""
    attribute: str
    before: str | None
    """JSON; geometries as hexadecimal WKB."""
    after: str | None


def differences(before: State, after: State) -> list[Difference]:
    """All that differs, by kind, asset and attribute; rejected assets count as removed."""
    found: list[Difference] = []
    for kind in asset_kind_names():
        one, other = _shown(before.assets.get(kind), kind), _shown(after.assets.get(kind), kind)
        found += sorted(_of_kind(kind, one, other))
    return found


def _shown(assets: Assets | None, kind: str) -> pa.Table:
    if assets is None:
        return asset_table(kind).empty_table()
    return assets.rows.filter(pc.not_equal(assets.rows["status"], "rejected"))


def _of_kind(kind: str, before: pa.Table, after: pa.Table) -> Iterator[Difference]:
    ids = [np.asarray(t["asset_id"].to_numpy(zero_copy_only=False), dtype=str) for t in (before, after)]
    _, at_before, at_after = np.intersect1d(ids[0], ids[1], assume_unique=True, return_indices=True)
    for change, own, held in (("removed", ids[0], at_before), ("added", ids[1], at_after)):
        for at in np.setdiff1d(np.arange(own.size), held):
            yield Difference(str(own[at]), kind, change, "", None, None)
    if not at_before.size:
        return
    then, now = before.take(pa.array(at_before)), after.take(pa.array(at_after))
    for name in then.column_names:
        if name in _OF_THE_EVIDENCE:
            continue
        same = pc.fill_null(pc.equal(then[name], now[name]), False)
        both_null = pc.and_(pc.is_null(then[name]), pc.is_null(now[name]))
        places = pa.array(np.flatnonzero(~np.asarray(pc.or_(same, both_null))))
        differing = [t.take(places).to_pylist() for t in (then["asset_id"], then[name], now[name])]
        for one, was, is_ in zip(*differing, strict=True):
            yield Difference(one, kind, "changed", name, _text(was), _text(is_))


def _text(value: Any) -> str | None:
    return None if value is None else encoded(value)


def shown(difference: Difference) -> tuple[str, str]:
    """Both values as people read them; geometries by their first point."""
    import json

    import shapely

    def words(text: str | None) -> str:
        if text is None:
            return "–"
        value = json.loads(text)
        if difference.attribute == GEOMETRY:
            shape = shapely.from_wkb(bytes.fromhex(value))
            x, y, z = shapely.get_coordinates(shape, include_z=True)[0]
            return f"{shape.geom_type} {x:.3f} {y:.3f} {z:.3f}"
        return str(value)

    return words(difference.before), words(difference.after)
