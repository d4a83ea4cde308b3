"""Strips: values along each lane by station, coarse and in pieces for long lanes, and cross-sections."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from roadscan.compute.array_types import Float64
from roadscan.condition.index import condition_indices
from roadscan.run.keys import code_digest, key_of
from roadscan.site.document import Ask, Document, SitePart, json_bytes
from roadscan.site.layer import title_of
from roadscan.site.material import Material
from roadscan.store.manifest import OutputRecord, recorded_table

_SERIES: Final = ("station_from_m", "station_to_m", "value", "sigma", "share", "reason")
_TOLD: Final = ("from_m", "to_m", "value", "sigma", "share", "reason")
_DIGITS: Final = {"sigma": 4, "share": 4}
"""Significant digits of values that qualify others; other values are written in full."""
_CODE: Final = "roadscan.site.parts.strips"

_WHOLE_M: Final = 300.0
"""Longest lane whose file has all values."""
_BINS: Final = 300
"""Bins in the file of a longer lane, in place of more than twice as many values."""
_BEYOND_M: Final = 1.0
"""Margin of the last piece beyond the lane's end, where a section may end."""
_PARTS: Final = 4
"""Pieces of a longer lane's values for each file of the table, which covers about a kilometre."""


@dataclass(frozen=True, eq=False)
class Lane:
    """A lane with the files of its values."""

    number: int
    material: Material
    """Its survey."""
    row: Mapping[str, Any]
    """Row of the table `lanes`."""
    station_m: Float64
    """(n,) stations of the centre line's vertices."""
    middle_m: Float64
    """(n, 2) easting and northing."""
    values: tuple[OutputRecord, ...]
    cross_sections: tuple[OutputRecord, ...]

    @property
    def url(self) -> str:
        """Path of its strip."""
        return f"strips/{self.number}.json"

    @property
    def survey(self) -> str:
        """Id of its survey."""
        return self.material.context.survey_id

    @property
    def is_long(self) -> bool:
        """True where its file has bins, and pieces of it the values."""
        return float(self.station_m[-1] - self.station_m[0]) > _WHOLE_M

    @functools.cached_property
    def groups(self) -> dict[str, tuple[OutputRecord, ...]]:
        """Records of its values by the common name of files of one stretch, in the order of the stretches."""
        found: dict[str, tuple[OutputRecord, ...]] = {}
        for record in sorted(self.values, key=lambda r: r.path.rsplit("/", 1)[-1]):
            name = record.path.rsplit("/", 1)[-1].removesuffix(".parquet")
            found[name] = (*found.get(name, ()), record)
        return found

    @functools.cached_property
    def pieces(self) -> list[dict[str, Any]]:
        """Pieces of its values; none where its file has them."""
        if not self.is_long:
            return []
        begins = {name: min(_first_station(self, one) for one in own) for name, own in self.groups.items()}
        begins = {name: begin for name, begin in begins.items() if np.isfinite(begin)}
        ends = [*list(begins.values())[1:], float(self.station_m[-1]) + _BEYOND_M]
        cut = {
            name: np.linspace(begins[name], end, _PARTS + 1).tolist() for name, end in zip(begins, ends, strict=True)
        }
        return [
            {"from_m": edges[part], "to_m": edges[part + 1], "url": _piece_url(self, name, part)}
            for name, edges in cut.items()
            for part in range(_PARTS)
        ]

    def key(self, records: Sequence[OutputRecord]) -> str:
        """Return a hash of some of its files, and of the lane."""
        return self.material.key(records, self.survey, self.number, self.row, self.middle_m.tolist())

    def direction_deg(self, station_m: float) -> float:
        """Return the direction of travel at a station, clockwise from map north (degrees)."""
        at = int(np.clip(np.searchsorted(self.station_m, station_m, side="right") - 1, 0, self.station_m.size - 2))
        east, north = (self.middle_m[at + 1] - self.middle_m[at]).tolist()
        turned = 180.0 if self.row["direction"] == "backward" else 0.0
        return round((float(np.degrees(np.arctan2(east, north))) + turned) % 360.0, 4)


class Strips(SitePart):
    """All lanes of the survey's roads."""

    name = "strips"
    position = 200

    def members(self, material: Material) -> Mapping[str, Any]:
        """Return the path of the index."""
        lanes = lanes_of(material)
        return {"strips": {"url": "strips/index.json", "lanes": len(lanes)} if lanes else None}

    def documents(self, material: Material) -> Iterator[Document]:
        """Yield the index, a file per lane, pieces of a long one, and its cross-sections by the files of the table."""
        lanes = lanes_of(material)
        if not lanes:
            return
        own = key_of([lane.key([*lane.values, *lane.cross_sections]) for lane in lanes], _quantities())
        yield _later("strips/index.json", own, lambda: {"lanes": [_about(lane) for lane in lanes], **_quantities()})
        for lane in lanes:
            yield _later(lane.url, lane.key(lane.values), _strip(lane))
            for name in lane.groups if lane.is_long else ():
                for part in range(_PARTS):
                    yield _later(_piece_url(lane, name, part), lane.key(lane.values), _piece(lane, name, part))
            for place, record in enumerate(lane.cross_sections):
                yield _later(_crossing_url(lane, place), lane.key([record]), _crossings(lane, record))


def _later(path: str, key: str, make: Any) -> Document:
    """Return a document whose tables are read when it is written."""

    def write(file: Path, _ask: Ask) -> None:
        file.write_bytes(json_bytes(make()))

    return Document(path, key_of(code_digest(_CODE), key), write)


@functools.lru_cache(maxsize=2)
def lanes_of(material: Material) -> tuple[Lane, ...]:
    """Return lanes with any values, in the table's order; those in a requested box, and of surveys shown over it."""
    found: list[Lane] = []
    for one in (material, *material.others):
        found += _lanes(one, len(found))
    return tuple(found)


def _lanes(material: Material, first: int) -> list[Lane]:
    """Return the lanes of one survey, numbered from `first`."""
    held = material.table("lanes")
    if held is None or held.shapes_m is None:
        return []
    values, crossings = material.records("condition_values"), material.records("cross_sections")
    near = None if material.wishes.near is None else shapely.box(*material.wishes.near)
    found: list[Lane] = []
    names = [f.name for f in held.rows.schema if not pa.types.is_list(f.type)]
    for row, shape in zip(held.rows.select(names).to_pylist(), held.shapes_m, strict=True):
        middle = shapely.get_coordinates(shape)
        if near is not None and not shape.intersects(near):
            continue
        stations = np.linspace(row["station_from_m"], row["station_to_m"], len(middle))
        own = f"{row['road']}/{row['lane']}"
        of_lane = tuple(r for r in values if r.path.rsplit("/", 1)[0].endswith(f"/{own}"))
        crossed = tuple(r for r in crossings if r.path.rsplit("/", 1)[0].endswith(f"/{own}"))
        if len(middle) > 1 and of_lane:
            found.append(Lane(first + len(found), material, row, stations, middle, of_lane, crossed))
    return found


def _about(lane: Lane) -> dict[str, Any]:
    spans = []
    for place, record in enumerate(lane.cross_sections):
        stations = _column(lane, record, "station_m")
        if stations.size:
            ends = {"from_m": float(stations.min()), "to_m": float(stations.max())}
            spans.append({**ends, "url": _crossing_url(lane, place)})
    low, high = lane.middle_m.min(axis=0), lane.middle_m.max(axis=0)
    return {
        "lane_id": lane.number, "survey": lane.survey, "road": lane.row["road"], "name": None,
        "lane": lane.row["lane"], "direction": lane.row["direction"], "bounds_m": np.round([*low, *high], 2),
        "station_m": [float(lane.station_m[0]), float(lane.station_m[-1])], "url": lane.url, "pieces": lane.pieces,
        "cross_sections": spans,
    }  # fmt: skip


def _first_station(lane: Lane, record: OutputRecord) -> float:
    """Return the least station of a file of values; infinite where it has none."""
    return float(_column(lane, record, "station_from_m").min(initial=np.inf))


def _column(lane: Lane, record: OutputRecord, name: str) -> npt.NDArray[Any]:
    store = lane.material.store
    column: npt.NDArray[Any] = recorded_table(store, record, [name])[name].to_numpy()
    return column


def _piece_url(lane: Lane, name: str, part: int) -> str:
    return f"strips/{lane.number}/{name}_{part}.json"


def _crossing_url(lane: Lane, place: int) -> str:
    return f"strips/{lane.number}_{place}.json"


def _quantities() -> dict[str, Any]:
    known = condition_indices().values()
    quantities = [
        {"name": q.name, "title": title_of(q.name, q.unit), "unit": q.unit, "meaning": q.meaning}
        for index in known
        for q in index.quantities
    ]
    return {"quantities": quantities, "panels": [{"title": i.title, "quantities": i.drawn} for i in known if i.drawn]}


def _strip(lane: Lane) -> Any:
    def make() -> dict[str, Any]:
        held = lane.material.rows_of(lane.values)
        series = [] if held is None else list(_series(held.rows))
        if lane.is_long:
            series = [_binned(one, lane.station_m) if len(one["value"]) > 2 * _BINS else one for one in series]
        east, north = (np.round(lane.middle_m[:, k], 4) for k in (0, 1))
        line = {"station_m": lane.station_m, "easting_m": east, "northing_m": north}
        return {
            "lane_id": lane.number, "survey": lane.survey, "road": lane.row["road"],
            "lane": lane.row["lane"], "direction": lane.row["direction"], "line": line, "series": series,
        }  # fmt: skip

    return make


def _series(rows: pa.Table) -> Iterator[dict[str, Any]]:
    """Yield the values of each quantity of sections and of cross-sections, by station."""
    ordered = rows.sort_by([(n, "ascending") for n in ("quantity", "extent", "station_from_m", "station_to_m")])
    kinds = ordered.select(["quantity", "extent"]).group_by(["quantity", "extent"], use_threads=False).aggregate([])
    for kind in sorted(kinds.to_pylist(), key=lambda k: (k["quantity"], k["extent"])):
        both = pc.and_(pc.equal(ordered["quantity"], kind["quantity"]), pc.equal(ordered["extent"], kind["extent"]))
        own = ordered.filter(both)
        columns = {told: own.column(name).to_pylist() for name, told in zip(_SERIES, _TOLD, strict=True)}
        yield {**kind, **columns, **{told: [_short(v, n) for v in columns[told]] for told, n in _DIGITS.items()}}


def _binned(series: Mapping[str, Any], station_m: Float64) -> dict[str, Any]:
    """Return a series with bins of equal width along a lane: mean and range of the values centred in each."""
    edges = np.linspace(float(station_m[0]), float(station_m[-1]), _BINS + 1)
    value = np.array(series["value"], np.float64)
    known = np.flatnonzero(np.isfinite(value))
    middle = (np.array(series["from_m"], np.float64) + np.array(series["to_m"], np.float64)) / 2
    bins = np.clip(np.searchsorted(edges, middle, side="right") - 1, 0, _BINS - 1)
    count = np.bincount(bins[known], minlength=_BINS)
    low, high = np.full(_BINS, np.inf), np.full(_BINS, -np.inf)
    np.minimum.at(low, bins[known], value[known])
    np.maximum.at(high, bins[known], value[known])
    mean = np.bincount(bins[known], value[known], _BINS) / np.maximum(count, 1)
    reasons = dict(zip(bins[::-1].tolist(), series["reason"][::-1], strict=True))
    told = {name: [_short(v, 6) if n else None for v, n in zip(of, count, strict=True)] for name, of in
            (("value", mean), ("low", low), ("high", high))}  # fmt: skip
    none: list[None] = [None] * _BINS
    return {
        "quantity": series["quantity"], "extent": series["extent"], "from_m": np.round(edges[:-1], 3),
        "to_m": np.round(edges[1:], 3), **told, "sigma": none, "share": none,
        "reason": [None if n else reasons.get(k) for k, n in enumerate(count.tolist())],
    }  # fmt: skip


def _piece(lane: Lane, name: str, part: int) -> Any:
    def make() -> dict[str, Any]:
        empty = {"from_m": np.inf, "to_m": np.inf}
        own = next((one for one in lane.pieces if one["url"] == _piece_url(lane, name, part)), empty)
        held = lane.material.rows_of(lane.groups[name])
        if held is None:
            return {"lane_id": lane.number, "from_m": own["from_m"], "to_m": own["to_m"], "series": []}
        begin = held.rows.column("station_from_m")
        rows = held.rows.filter(pc.and_(pc.greater_equal(begin, own["from_m"]), pc.less(begin, own["to_m"])))
        return {"lane_id": lane.number, "from_m": own["from_m"], "to_m": own["to_m"], "series": list(_series(rows))}

    return make


def _short(value: float | None, digits: int) -> float | None:
    return None if value is None else float(f"{value:.{digits}g}")


def _crossings(lane: Lane, record: OutputRecord) -> Any:
    def make() -> dict[str, Any]:
        held = lane.material.rows_of([record])
        rows: Sequence[Mapping[str, Any]] = [] if held is None else held.rows.to_pylist()
        stations = [row["station_m"] for row in rows]
        sections = [_crossing(lane, row) for row in rows]
        ends = {"from_m": min(stations, default=0.0), "to_m": max(stations, default=0.0)}
        return {"lane_id": lane.number, **ends, "sections": sections}

    return make


def _crossing(lane: Lane, row: Mapping[str, Any]) -> dict[str, Any]:
    told = {name: row[name] for name in ("station_m", "easting_m", "northing_m", "first_m", "step_m", "height_m")}
    relative_mm = np.round(1000.0 * np.array(row["relative_height_m"], np.float64), 3)
    return {**told, "direction_deg": lane.direction_deg(row["station_m"]), "relative_height_mm": relative_mm}
