"""Differences between two states of the inventory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final, NamedTuple, TypeAlias, overload

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from roadscan.inventory.state import Assets, State
from roadscan.inventory.values import encoded_column
from roadscan.store.asset_schema import asset_kind_names
from roadscan.store.inventory_schema import GEOMETRY, asset_table

_OF_THE_EVIDENCE: Final = frozenset(
    {
        "asset_id", "object", "easting_m", "northing_m", "height_m", "sigma_horizontal_m", "sigma_height_m",
        "sigma_size_m", "probability", "returns", "passes", "first_epoch_gps_ns", "last_epoch_gps_ns", "pictures",
    }
)  # fmt: skip
"""Columns that describe the evidence alone, or follow from the geometry."""
_CHANGES: Final = {-1: "removed", -2: "added"}  # Codes of the column of a difference.
_AT_ONCE: Final = 8192
"""Differences that are turned into columns at a time."""

Ints: TypeAlias = npt.NDArray[np.int64]


class Difference(NamedTuple):
    """An asset that came or went, or one value that differs."""

    asset_id: str
    kind: str
    change: str
    """`added`, `removed` or `changed`."""
    attribute: str
    before: str | None
    """JSON; geometries as hexadecimal WKB."""
    after: str | None


class Differences(Sequence[Difference]):
    """All differences by kind, asset and attribute: stored as columns; rows are made on demand."""

    def __init__(self, parts: Iterable[_OfKind]) -> None:
        self._parts = [part for part in parts if part.asset.size]
        self._ends = np.cumsum([0, *(part.asset.size for part in self._parts)]).tolist()

    def __len__(self) -> int:
        return int(self._ends[-1])

    @overload
    def __getitem__(self, index: int) -> Difference: ...

    @overload
    def __getitem__(self, index: slice) -> list[Difference]: ...

    def __getitem__(self, index: int | slice) -> Difference | list[Difference]:
        if isinstance(index, slice):
            wanted = range(len(self))[index]
            return list(self._between(wanted.start, wanted.stop)) if wanted.step == 1 else [self[at] for at in wanted]
        at = range(len(self))[index]
        return next(self._between(at, at + 1))

    def __iter__(self) -> Iterator[Difference]:
        return self._between(0, len(self))

    def _between(self, first: int, last: int) -> Iterator[Difference]:
        for part, begin, end in zip(self._parts, self._ends, self._ends[1:], strict=False):
            for at in range(max(first, begin), min(last, end), _AT_ONCE):
                yield from part.rows(at - begin, min(at + _AT_ONCE, last, end) - begin)


def differences(before: State, after: State) -> Differences:
    """Returns all differences by kind, asset and attribute; rejected assets count as removed."""
    return Differences(
        _of_kind(kind, _shown(before.assets.get(kind), kind), _shown(after.assets.get(kind), kind))
        for kind in asset_kind_names()
    )


def _shown(assets: Assets | None, kind: str) -> pa.Table:
    if assets is None:
        return asset_table(kind).empty_table()
    return assets.rows.filter(pc.not_equal(assets.rows["status"], "rejected"))


class _OfKind(NamedTuple):
    """Differences (n,) of a kind."""

    kind: str
    ids: npt.NDArray[Any]
    """Ids of the assets of both states."""
    asset: Ints
    """Index of each difference's asset in `ids`; ascending."""
    column: Ints
    """Index of the attribute that differs, ascending within an asset; -1 for a removed asset, -2 for one that was
    added."""
    names: list[str]
    before: pa.Table
    after: pa.Table
    at_before: Ints
    """Row of each difference in the table before, where it has one."""
    at_after: Ints

    def rows(self, first: int, last: int) -> list[Difference]:
        """Returns the rows of some of the differences."""
        part = slice(first, last)
        columns, ids = self.column[part], self.ids[self.asset[part]].tolist()
        out: list[Any] = [None] * columns.size
        for column in np.unique(columns).tolist():
            own = np.flatnonzero(columns == column)
            if column < 0:
                for at in own.tolist():
                    out[at] = Difference(ids[at], self.kind, _CHANGES[column], "", None, None)
                continue
            name = self.names[column]
            was, is_ = (
                encoded_column(table[name].take(pa.array(rows[part][own])).to_pylist())
                for table, rows in ((self.before, self.at_before), (self.after, self.at_after))
            )
            for at, one, other in zip(own.tolist(), was, is_, strict=True):
                out[at] = Difference(ids[at], self.kind, "changed", name, one, other)
        return out


def _of_kind(kind: str, before: pa.Table, after: pa.Table) -> _OfKind:
    ids = [np.asarray(t["asset_id"].to_numpy(zero_copy_only=False), dtype=str) for t in (before, after)]
    both = np.union1d(*ids)
    # rows of the assets in each table, -1 where absent
    at = np.full((2, both.size), -1, np.int64)
    for number, own in enumerate(ids):
        at[number, np.searchsorted(both, own)] = np.arange(own.size)
    parts = [(np.flatnonzero(at[1] < 0), -1), (np.flatnonzero(at[0] < 0), -2)]
    held = np.flatnonzero((at >= 0).all(axis=0))
    names = sorted(set(before.column_names) - _OF_THE_EVIDENCE)
    if held.size:
        then, now = before.take(pa.array(at[0, held])), after.take(pa.array(at[1, held]))
        for column, name in enumerate(names):
            same = pc.fill_null(pc.equal(then[name], now[name]), False)
            both_null = pc.and_(pc.is_null(then[name]), pc.is_null(now[name]))
            parts.append((held[~np.asarray(pc.or_(same, both_null))], column))
    asset = np.concatenate([own for own, _ in parts])
    columns = np.repeat([column for _, column in parts], [own.size for own, _ in parts])
    order = np.argsort(asset, kind="stable")
    asset, columns = asset[order], columns[order]
    return _OfKind(kind, both, asset, columns, names, before, after, at[0, asset], at[1, asset])


def shown(difference: Difference) -> tuple[str, str]:
    """Returns both values as readable text; geometries by their first point."""
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
