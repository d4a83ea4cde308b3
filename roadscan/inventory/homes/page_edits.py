"""Edits made in the page of a survey, as one document: a home that presents a commit's state with them applied.

`docs/viewer.md` specifies the document. Old values are those of the commit that the page showed; what the
document says of them does not count.
"""

from __future__ import annotations

import datetime as dt
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, NamedTuple, Self

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import shapely
from pydantic import Field

from roadscan.core.errors import ConfigError
from roadscan.core.strict import Strict
from roadscan.inventory.conflicts import Conflict, value_shown
from roadscan.inventory.edits import Edit
from roadscan.inventory.home import FID, Author, Content, EditFault, Home, HomeError, Mark, Sheet
from roadscan.inventory.values import encoded, iso_wkb
from roadscan.store.asset_schema import GEOMETRY, asset_schema, asset_table, kinds_by_table

LAYER: Final = "asset_"
"""Prefix of the names of the page's layers; the table of their kind follows."""

Outcome = Literal["accepted", "same", "conflict", "asked", "refused"]


class EditProperties(Strict):
    """The content of one edit."""

    layer: str
    action: Literal["confirm", "reject", "change", "add"]
    asset_id: str | None = None
    """The asset; null if it was just drawn."""
    attributes: dict[str, bool | int | float | str | None] = Field(default_factory=dict)
    """Corrected columns, with their new values."""
    comment: str = ""
    author: str = ""
    edited_utc: dt.datetime | None = None
    confirmed: bool = False
    """True if the person confirmed that an unlikely place is right."""


class EditFeature(Strict):
    """One edit."""

    type: Literal["Feature"]
    geometry: dict[str, Any] | None = None
    """The new place as GeoJSON, in metres of the map; null where it is not changed."""
    properties: EditProperties


class EditDocument(Strict):
    """All edits of a page."""

    type: Literal["FeatureCollection"]
    coordinates: Literal["map_m"]
    survey: str
    crs: str | None = None
    software: str = ""
    inventory: str
    """Name of the inventory that the page showed."""
    commit: int = Field(ge=1)
    """The commit that it showed."""
    features: list[EditFeature]


class EditOutcome(NamedTuple):
    """The outcome of one edit of a document."""

    outcome: Outcome
    """`accepted`, `same`: the inventory says so already, `conflict`: it waits, `asked`: it is accepted once it
    is confirmed, or `refused`."""
    reason: str = ""


@dataclass(frozen=True)
class PageDocument:
    """A parsed document of edits."""

    name: str
    edits: EditDocument
    units_m: tuple[float, float, float]
    """Metres of a unit of easting, northing and height in the inventory."""

    @property
    def mark(self) -> Mark:
        """Returns the inventory and the commit that the page showed."""
        return Mark(self.edits.inventory, "", "", self.edits.commit, "")

    @classmethod
    def parse(cls, name: str, content: bytes, units_m: tuple[float, float, float]) -> PageDocument:
        """Returns the document of a file or of a page.

        Raises
        ------
        HomeError
            where it is none.
        """
        change = "take a file that the page of a survey with an inventory saved"
        try:
            values = json.loads(content)
        except ValueError as error:
            raise HomeError(f"the edits are not JSON: {error}", change=change, file=name) from error
        if not isinstance(values, dict):
            raise HomeError("the edits are not a collection of features", change=change, file=name)
        try:
            json.dumps(values, ensure_ascii=False).encode()
        except UnicodeEncodeError as error:
            raise HomeError(f"the edits hold half a character: {error}", change=change, file=name) from error
        try:
            return cls(name, EditDocument.parse(values), units_m)
        except ConfigError as error:
            raise HomeError(f"the edits cannot be read: {error}", change=change, file=name) from error

    def by(self, who: str) -> Self:
        """Returns the document with all edits made by one person, whatever it says; as it is for ""."""
        if not who:
            return self
        told = [
            one.model_copy(update={"properties": one.properties.model_copy(update={"author": who})})
            for one in self.edits.features
        ]
        return replace(self, edits=self.edits.model_copy(update={"features": told}))


class PageEdits(Home):
    """A document of edits applied to the rows that its page showed."""

    def __init__(self, document: PageDocument, shown: Mapping[str, pa.Table]) -> None:
        """Take the rows that the page showed, by kind and with `fid`."""
        self.document = document
        self.made_of = self.shown = shown
        self.records: list[tuple[str, str]] = []
        """Table and record of each edit, once it was read."""
        self._faults: list[EditFault] = []
        self._authors: dict[tuple[str, str, str], Author] = {}

    @property
    def name(self) -> str:
        """Returns the file's name, or that of the page."""
        return self.document.name

    def mark(self) -> Mark:
        """Returns the commit that the page showed."""
        return self.document.mark

    def read(self) -> Content:
        """Returns those rows after the edits; edits that cannot be applied are faults."""
        self.records, self._faults, self._authors = [], [], {}
        rows = dict(self.shown)
        by_kind: dict[str, list[EditFeature]] = {}
        for number, feature in enumerate(self.document.edits.features):
            table = feature.properties.layer.removeprefix(LAYER)
            kind = kinds_by_table().get(table)
            if kind is None:
                self.records.append((table, f"edit {number + 1}"))
                self._faults.append(EditFault(table, f"edit {number + 1}", "there is no such layer"))
                continue
            by_kind.setdefault(kind, []).append(feature)
            self.records.append((table, ""))  # its record follows
        records = {}
        for kind, features in by_kind.items():
            held = rows.get(kind, _empty(kind))
            rows[kind], records[kind] = self._edited(kind, held, features)
        for place, (table, record) in enumerate(self.records):
            if not record:
                self.records[place] = (table, records[kinds_by_table()[table]].pop(0))
        confirmed = [
            record
            for (_, record), feature in zip(self.records, self.document.edits.features, strict=True)
            if feature.properties.confirmed
        ]
        return Content(rows, authors=self._authors, faults=tuple(self._faults), confirmed=confirmed)

    def _edited(self, kind: str, rows: pa.Table, features: Sequence[EditFeature]) -> tuple[pa.Table, list[str]]:
        """Returns the rows of a kind after the edits, and the record of each edit."""
        table = asset_schema(kind).table
        place = {one: at for at, one in enumerate(rows["asset_id"].to_pylist())}
        fid = rows.num_rows
        changed: dict[str, dict[int, Any]] = {}
        drawn: list[dict[str, Any]] = []
        records = []
        for feature in features:
            given = feature.properties
            is_new = given.action == "add"
            fid += is_new
            record = f"fid {fid}" if is_new else str(given.asset_id)
            records.append(record)
            try:
                if not is_new and given.asset_id not in place:
                    raise ValueError(f"commit {self.document.edits.commit} shows no such asset")
                values = self._values(kind, feature)
            except ValueError as error:
                self._faults.append(EditFault(table, record, str(error)))
                continue
            at_utc = "" if given.edited_utc is None else given.edited_utc.isoformat(timespec="seconds")
            author = Author(given.author, at_utc.replace("+00:00", "Z"), given.comment)
            self._authors |= {(kind, record, name): author for name in values}
            if is_new:
                drawn.append({FID: fid, **values})
            else:
                for name, value in values.items():
                    changed.setdefault(name, {})[place[given.asset_id]] = value
        for name, own in changed.items():
            rows = _with_values(rows, name, own)
        if drawn:
            rows = pa.concat_tables([rows, pa.Table.from_pylist(drawn, rows.schema)])
        return rows, records

    def _values(self, kind: str, feature: EditFeature) -> dict[str, Any]:
        """Returns new values by column; ValueError where one is not of its column's type."""
        given = feature.properties
        if given.action in ("confirm", "reject"):
            return {"status": "confirmed" if given.action == "confirm" else "rejected"}
        values = {name: _value(kind, name, raw) for name, raw in given.attributes.items()}
        if feature.geometry is not None:
            values[GEOMETRY] = self._geometry(kind, feature.geometry)
        return values

    def _geometry(self, kind: str, raw: Mapping[str, Any]) -> bytes | None:
        """Returns a geometry as WKB; of a multi-part kind, a single line or area becomes its only part."""
        try:
            shape = shapely.geometry.shape(raw)
            if asset_schema(kind).geometry == f"Multi{shape.geom_type}Z":
                shape = shapely.geometry.shape({"type": f"Multi{shape.geom_type}", "coordinates": [raw["coordinates"]]})
            turned = shapely.transform(
                shape, lambda places: places / self.document.units_m[: places.shape[1]], include_z=bool(shape.has_z)
            )
        except (shapely.errors.ShapelyError, ValueError, TypeError, KeyError, AttributeError, IndexError) as error:
            raise ValueError(f"its geometry cannot be read: {error}") from error
        return iso_wkb(np.array([turned], object))[0]

    def outcomes(
        self, taken: Sequence[Edit], refused: Sequence[EditFault], waiting: Sequence[Conflict]
    ) -> list[EditOutcome]:
        """Returns the outcome of each edit, once the document was pulled.

        Parameters
        ----------
        taken, refused : what the pull accepted and refused; waiting : conflicts of the inventory afterwards.
        """
        reasons: dict[tuple[str, str], list[str]] = {}
        for fault in refused:
            reasons.setdefault((fault.table, fault.record), []).append(fault.reason)
        asked = {(fault.table, fault.record) for fault in refused if fault.is_question}
        told = []
        for feature, record in zip(self.document.edits.features, self.records, strict=True):
            if record in reasons:
                told.append(EditOutcome("asked" if record in asked else "refused", "; ".join(reasons[record])))
                continue
            own = [edit for edit in taken if self._is_of(edit, feature, record)]
            names = {edit.edit for edit in own}
            met = [c for c in waiting if c.edit in names or (c.reason == "rejected" and c.asset_id in _assets(own))]
            if met:
                told.append(EditOutcome("conflict", "; ".join(_met(one) for one in met)))
            else:
                told.append(EditOutcome("accepted" if own else "same"))
        return told

    def _is_of(self, edit: Edit, feature: EditFeature, record: tuple[str, str]) -> bool:
        if asset_schema(edit.kind).table != record[0]:
            return False
        if feature.properties.action != "add":
            return edit.asset_id == record[1]
        drawn = None if feature.geometry is None else self._geometry(edit.kind, feature.geometry)
        return edit.action == "create" and drawn is not None and edit.new == encoded(drawn)

    def write(self, content: Content, sheets: Sequence[Sheet], mark: Mark) -> None:
        """Refuse: a document contains edits only."""
        raise HomeError("a document of edits shows no state", change="publish to the survey's own home", file=self.name)

    def note(self, mark: Mark) -> None:
        """Do nothing: a document that was taken in says nothing new a second time."""


def _assets(edits: Sequence[Edit]) -> set[str]:
    return {edit.asset_id for edit in edits}


def _met(one: Conflict) -> str:
    """Returns a conflict in words."""
    if one.reason == "edit":
        return (
            f"{one.attribute}: somebody else wrote {value_shown(one, 'in_force')} meanwhile, which is in force; "
            f"{value_shown(one, 'other')} waits among the conflicts"
        )
    if one.reason == "evidence":
        return f"{one.attribute}: the newest evidence says {value_shown(one, 'other')}; the edit is in force"
    if one.reason == "rejected":
        return "somebody else rejected the asset meanwhile, or it was edited before it was rejected"
    return "the run that found the asset was undone"


def _empty(kind: str) -> pa.Table:
    return pa.schema([pa.field(FID, pa.int64()), *asset_table(kind)]).empty_table()


def _with_values(rows: pa.Table, name: str, values: Mapping[int, Any]) -> pa.Table:
    """Returns rows with other values of a column at some of their places."""
    at, places = rows.schema.get_field_index(name), sorted(values)
    mask: npt.NDArray[np.bool_] = np.zeros(rows.num_rows, np.bool_)
    mask[places] = True
    held = rows[name]
    column = pa.concat_arrays(held.chunks) if held.num_chunks else pa.array([], held.type)
    changed = pc.replace_with_mask(column, pa.array(mask), pa.array([values[one] for one in places], held.type))
    return rows.set_column(at, rows.schema.field(at), changed)


def _value(kind: str, name: str, raw: Any) -> Any:
    """Returns a value of the document in the type of its column."""
    schema = asset_table(kind)
    if name not in schema.names or name in ("asset_id", GEOMETRY):
        raise ValueError(f"there is no column '{name}' to be edited")
    wanted = schema.field(name).type
    if raw is None:
        return None
    is_number = isinstance(raw, int | float) and not isinstance(raw, bool) and abs(raw) < _MOST
    if pa.types.is_floating(wanted) and is_number:
        return float(raw)
    if pa.types.is_integer(wanted) and is_number and float(raw).is_integer():
        return int(raw)
    if pa.types.is_date(wanted) and isinstance(raw, str):
        try:
            return dt.date.fromisoformat(raw)
        except ValueError:
            raise ValueError(f"{name} is '{raw}', expected a date such as 2026-05-04") from None
    if pa.types.is_boolean(wanted) and isinstance(raw, bool):
        return raw
    if pa.types.is_string(wanted) and isinstance(raw, str):
        return raw
    raise ValueError(f"{name} is {json.dumps(raw)}, expected {_IN_WORDS.get(str(wanted), str(wanted))}")


_MOST: Final = 2**31
"""Numbers of assets are below this, even where a column could store more."""
_IN_WORDS: Final = {
    "double": "a number", "int32": "a whole number", "int64": "a whole number", "string": "a text",
    "bool": "true or false", "date32[day]": "a date such as 2026-05-04",
}  # fmt: skip
