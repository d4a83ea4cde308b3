"""Vector layers of `site/layers/` and of entry points: their description, and the evidence for a feature."""

from __future__ import annotations

import bisect
import functools
import json
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Final, Literal

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.core.errors import RoadscanError
from roadscan.core.plugins import found_kinds
from roadscan.site.material import Material
from roadscan.site.site_pictures import cut_out_records, cut_out_url, picture_urls
from roadscan.store.schema import table_schema

ENTRY_POINT_GROUP: Final = "roadscan.site_layers"

Group = Literal["survey", "control", "condition", "distress", "assets"]
Geometry = Literal["point", "line", "polygon"]

BLUE, ORANGE, GREEN, RED, SKY, YELLOW, PURPLE, GREY = (
    "#0072b2", "#e69f00", "#009e73", "#d55e00", "#56b4e9", "#f0e442", "#cc79a7", "#9e9e9e",
)  # fmt: skip
"""Colours for any colour vision (Okabe and Ito 2008), and a grey for unknown values."""

BELOW_TO_ABOVE: Final = ("#2166ac", "#67a9cf", "#e8d44d", "#ef8a62", "#b2182b")
"""Five steps of a signed difference (ColorBrewer 2, RdBu); the middle one is visible on white and black."""

GOOD_TO_POOR: Final = ("#4575b4", "#91bfdb", "#fee090", "#fc8d59", "#d73027")
"""Five steps for any colour vision (ColorBrewer 2, RdYlBu)."""


_UNIT_IN_NAME: Final = re.compile(
    r"_(m_per_km|per_km|kg_m3|cm3_per_m2|m2_per_m|m_m2|gps_ns|mm|cm|m2|m3|cm3|m|px|deg|percent|ns|ms)$"
)
"""Units at the end of names of columns and quantities."""


_ACRONYM: Final = re.compile(r"\b(hri|iri|mpd|mri|psd|rms)\b")


def title_of(name: str, unit: str) -> str:
    """Return the title of a column or quantity without its unit, which the page shows beside the values."""
    bare = _UNIT_IN_NAME.sub("", name) if unit and unit not in ("text", "1", "number", "date") else name
    words = re.sub(r"\bsigma\b", "σ", bare.replace("_", " "))
    return _ACRONYM.sub(lambda found: found[0].upper(), words)


@dataclass(frozen=True)
class SiteColumn:
    """A column of a layer's rows."""

    name: str
    unit: str
    meaning: str
    title: str = ""
    sigma: str = ""
    """Column with its 1 σ."""
    edited: tuple[str, tuple[str, ...]] | None = None
    """Type and allowed values (none: all) of a column that people may change."""

    def stated(self) -> dict[str, Any]:
        """Return the JSON values for the page."""
        title = self.title or title_of(self.name, self.unit)
        told: dict[str, Any] = {"name": self.name, "title": title, "unit": self.unit, "meaning": self.meaning}
        told |= {"sigma": self.sigma} if self.sigma else {}
        return told if self.edited is None else told | {"edited": {"type": self.edited[0], "values": self.edited[1]}}


@dataclass(frozen=True)
class Style:
    """Colours of features: one for all, by classes of a number, or by values of a column."""

    title: str
    width_px: float
    colour: str = BLUE
    by: str = ""
    limits: tuple[float, ...] = ()
    """Limits between the classes, ascending; the colours are those of :data:`GOOD_TO_POOR`."""
    shown_in: tuple[str, float] = ("", 1.0)
    """Unit of the labels of classes, and its number in a unit of the column."""
    is_difference: bool = False
    """True for a difference with symmetric limits around zero: :data:`BELOW_TO_ABOVE`."""
    values: Mapping[str, str] = field(default_factory=dict)
    """Colour by value."""

    def stated(self) -> dict[str, Any]:
        """Return the JSON values for the page."""
        told: dict[str, Any] = {"title": self.title, "by": self.by or None, "width_px": self.width_px}
        if not self.by:
            return told | {"colour": self.colour}
        told["none"] = {"colour": GREY, "label": "not known"}
        if self.values:
            return told | {"values": [{"value": v, "colour": c, "label": v} for v, c in self.values.items()]}
        return told | {"classes": list(_classes(self))}

    def colour_of(self, row: Mapping[str, Any]) -> str:
        """Return the colour of a row, as the page computes it."""
        if not self.by:
            return self.colour
        value = row.get(self.by)
        if self.values:
            return self.values.get(str(value), GREY)
        if not isinstance(value, int | float) or math.isnan(value):
            return GREY
        kinds = list(_classes(self))
        colour: str = kinds[bisect.bisect_right(self.limits, value)]["colour"]
        return colour


def _classes(style: Style) -> Iterator[dict[str, Any]]:
    limits, (unit, factor) = style.limits, style.shown_in
    colours = BELOW_TO_ABOVE if style.is_difference else GOOD_TO_POOR
    ends: list[float | None] = [None, *limits, None]
    places = np.linspace(0, len(colours) - 1, len(limits) + 1).round().astype(int).tolist()
    for low, high, place in zip(ends[:-1], ends[1:], places, strict=True):
        least, most = (None if end is None else f"{factor * end:g}".replace("-", "−") for end in (low, high))
        if most is None:
            label = f"{least} {unit} and above" if unit else f"{least} and above"
        else:
            label = f"{f'below {most}' if least is None else f'{least} to {most}'} {unit}".strip()
        yield {"from": low, "to": high, "colour": colours[place], "label": label}


@dataclass(frozen=True)
class SiteLayer:
    """A layer with its features."""

    name: str
    """Letters, digits and ``_``, as it names a folder."""
    title: str
    group: Group
    geometry: Geometry
    order: int
    """Layers are drawn in ascending order."""
    shapes_m: npt.NDArray[Any]
    """(n,) shapely geometries on the map."""
    rows: Sequence[Mapping[str, Any]]
    """(n,) values by column."""
    columns: Sequence[SiteColumn]
    styles: Sequence[Style]
    """Styles, the default first."""
    key: str = ""
    """Column that identifies features."""
    label: str = ""
    """Column whose text is shown beside a feature."""
    visible: bool = True
    arrows: Mapping[str, Any] | None = None
    """Columns of differences shown as arrows: east, north, up (m), and their magnification."""
    evidence: Sequence[Sequence[Mapping[str, Any]]] = ()
    """(n,) evidence for each feature; may be empty."""


class LayerKind(ABC):
    """Layers of one kind; it reads small tables and records, never readings."""

    name: ClassVar[str]

    @abstractmethod
    def layers(self, material: Material) -> Iterator[SiteLayer]:
        """Yield the survey's layers of this kind."""


@functools.cache
def layer_kinds() -> tuple[LayerKind, ...]:
    """Return all kinds of layers, by name."""
    known = found_kinds("site/layers/*.py", LayerKind, ENTRY_POINT_GROUP)
    return tuple(kind() for kind in known.values())


def schema_columns(table: str, names: Sequence[str]) -> list[SiteColumn]:
    """Return columns of a stored table that a feature's row can hold; further names are added unchanged."""
    known = {c.name: c for c in table_schema(table).columns}
    return [
        SiteColumn(n, *((known[n].unit, known[n].meaning) if n in known else ("", "")), sigma=_sigma_of(n, names))
        for n in names
    ]


def _sigma_of(name: str, names: Sequence[str]) -> str:
    place = {"easting_m": "sigma_horizontal_m", "northing_m": "sigma_horizontal_m"}
    wanted = place.get(name, f"sigma_{name}")
    return wanted if wanted in names and wanted != name else ""


def table_layer(material: Material, table: str, about: SiteLayer) -> Iterator[SiteLayer]:
    """Yield a layer of all rows of a table with shapes, as `about` describes it.

    There is none where the survey has no such rows, or where the inventory shows them with its edits.
    """
    content = None if table in material.tables_in_inventory else material.table(table)
    if content is None or content.shapes_m is None or not content.rows.num_rows:
        return
    names = [f.name for f in content.rows.schema if not _is_list(f)]
    rows = content.rows.select(names).to_pylist()
    yield SiteLayer(
        about.name, about.title, about.group, about.geometry, about.order, content.shapes_m, rows,
        schema_columns(table, names), about.styles, about.key, about.label, about.visible, about.arrows,
        [list(evidence_of_row(row)) for row in rows],
    )  # fmt: skip


def described(
    name: str, title: str, group: Group, geometry: Geometry, order: int, styles: Sequence[Style], **further: Any
) -> SiteLayer:
    """Return a layer without features."""
    return SiteLayer(name, title, group, geometry, order, np.empty(0, object), (), (), styles, **further)


def line_of(places_m: npt.NDArray[np.float64]) -> Any:
    """Return a line through places (n, 2 or 3), which may be a single one."""
    return shapely.LineString(places_m if len(places_m) > 1 else np.repeat(places_m, 2, axis=0))


def evidence_of_row(row: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the tiles that a table's row names, and its place on the strips of its road."""
    for one in str(row.get("tiles") or "").split():
        yield {"title": f"tile {one}", "kind": "tile", "tile": one}
    station, road, lane = row.get("station_from_m", row.get("station_m")), row.get("road"), row.get("lane")
    if road and isinstance(station, float) and math.isfinite(station):
        title = f"strip of {road}" + (f", lane {lane}," if lane else "") + f" at {station:.2f} m"
        yield {"title": title, "kind": "station", "road": road, "lane": lane, "station_m": round(station, 3)}


def _is_list(column: Any) -> bool:
    return str(column.type).startswith(("list", "fixed_size_list"))


Told = dict[str, Any]


def of_pictures(material: Material, row: Mapping[str, Any]) -> Iterator[Told]:
    """Yield the cut-out of an asset, and the pictures of its column `pictures`, best first."""
    name = row.get("cut_out")
    cut = cut_out_records(material).get(str(name)) if name else None
    if cut is not None:
        yield {"title": "cut-out", "kind": "cut_out", "url": cut_out_url(cut)}
    pictures = _pictures_named(row.get("pictures"))
    urls = picture_urls(material) if pictures else {}
    for one in pictures:
        names = str(one.get("run")), str(one.get("camera")), str(one.get("file"))
        url, distance = urls.get(names), one.get("distance_m")
        away = f", {distance:g} m away" if isinstance(distance, int | float) else ""
        words = {"title": f"picture {' '.join(names)}{away}", "kind": "picture"}
        yield words | ({} if url is None else {"url": url})


def _pictures_named(text: Any) -> list[Mapping[str, Any]]:
    try:
        named = json.loads(text) if isinstance(text, str) else []
    except ValueError:
        return []
    return [one for one in named if isinstance(one, dict)] if isinstance(named, list) else []


def of_passes(material: Material, epochs_gps_ns: Iterable[Any], run: str | None = None) -> Iterator[Told]:
    """Yield the passes at some epochs, of one run where it is named."""
    wanted = [one for one in epochs_gps_ns if isinstance(one, int)]
    for driven in material.plan.passes if wanted else ():
        if run in (None, driven.run) and any(driven.start_gps_ns <= one < driven.end_gps_ns for one in wanted):
            yield of_pass(material, driven.pass_id)


def of_pass(material: Material, number: int) -> Told:
    """Return a pass by its number; its row in the layer of passes names its logs."""
    run = next((one.run for one in material.plan.passes if one.pass_id == number), None)
    title = f"pass {number}" + (f" of {run}" if run else "")
    return {"title": title, "kind": "row", "layer": "passes", "row": str(number)}


def of_run(material: Material, run: str) -> Iterator[Told]:
    """Return the logs of a run."""
    for record in _records(material):
        if record.run == run:
            yield {"title": f"{record.sensor}: {record.path} ({record.format}, {record.rows:,} rows)", "kind": "log"}


@functools.lru_cache(maxsize=2)
def _records(material: Material) -> tuple[Any, ...]:
    try:
        return tuple(material.plan.records)
    except RoadscanError:
        return ()
