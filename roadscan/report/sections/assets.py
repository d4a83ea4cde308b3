"""Report section on assets by kind, with a map, and a table for each kind."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.assets.files.layers import Layer
from roadscan.assets.files.thumbnails import (
    drawn_from_above,
    drawn_from_side,
    fitted,
    read_classified,
    read_cut_out,
    sheet,
)
from roadscan.assets.settings import AssetsConfig
from roadscan.assets.tasks.evidence import CLASSIFIED
from roadscan.assets.tasks.picture_work import CUT_OUTS
from roadscan.assets.tasks.plan import asset_grid
from roadscan.assets.tasks.tables import TABLES, read_layer
from roadscan.compute.array_types import Float64
from roadscan.core.extras import is_installed
from roadscan.georeference.plan.plan import plan_of
from roadscan.privacy.settings import publishes_as_they_are
from roadscan.report.blocks import COLOURS, WIDTH, Block, Drawing, Line, MapPage, Picture, Table
from roadscan.report.section import Material, Section
from roadscan.run.session import Session
from roadscan.store.asset_schema import AssetSchema, asset_schema, asset_tables
from roadscan.store.manifest import read_recorded
from roadscan.tiles.tasks.wanted_products import product_context

MOST: Final = 4
"""Thumbnails of a kind."""
_TRIED: Final = 12  # assets that are tried, the most probable first
_KEPT_SQUARES: Final = 4  # squares whose points stay in memory
_HEIGHT_M: Final = 3.0  # assumed height of an asset without one (m)
_ABOVE_PLATE_M: Final = 1.0  # height above a plate's place that is shown (m)


class Thumbnails:
    """Draws thumbnails of a survey's assets; points of a square are read once for neighbouring assets.

    A report is handed on: cut-outs of pictures stand in it only where `privacy.pictures` is off.
    """

    def __init__(self, session: Session) -> None:
        config = AssetsConfig.stated(session.survey)
        self._session = session
        self._grid = None if config is None else asset_grid(session.survey, config)
        shown = session.manifest.of(CUT_OUTS).values() if publishes_as_they_are(session.survey) else ()
        self._cut_outs = {r.path: r for r in shown}
        self._points = {unit: r for unit, r in session.manifest.of(CLASSIFIED).items() if r.path}
        self._read: OrderedDict[str, tuple[Any, Any, Any]] = OrderedDict()

    def of(self, layer: Layer) -> bytes | None:
        """Return a sheet of a kind's most probable assets, cut-outs before points; None where nothing shows them."""
        rows = layer.rows
        cut = [name is not None for name in rows["cut_out"].to_pylist()] if "cut_out" in rows.schema.names else []
        has_cut = np.array(cut or [False] * rows.num_rows)
        order = np.lexsort((rows["object"].to_numpy(), -rows["probability"].to_numpy(), ~has_cut))[:_TRIED]
        near = sorted(order.tolist(), key=lambda n: (not has_cut[n], self._square(rows, n), n))
        found: list[npt.NDArray[np.uint8]] = []
        for number in near:
            one = self._one(layer, number)
            if one is not None:
                found.append(one)
            if len(found) == MOST:
                break
        return sheet(found) if found else None

    def _one(self, layer: Layer, number: int) -> npt.NDArray[np.uint8] | None:
        """Return the cut-out of an asset, or its points."""
        row = {name: layer.rows[name][number].as_py() for name in layer.rows.schema.names}
        record = self._cut_outs.get(row.get("cut_out") or "")
        if record is not None:
            picture = read_cut_out(read_recorded(self._session.store, record))
            if picture is not None:
                return fitted(picture)
        points = self._points_of(self._square(layer.rows, number))
        if points is None:
            return None
        if layer.geometry != "PointZ":
            return drawn_from_above(points, layer.shapes_m[number])
        above = row.get("clearance_m")
        foot = row["height_m"] - (above + (row.get("plate_height_m") or 0.0) / 2 if above is not None else 0.0)
        height = row.get("asset_height_m") or (_HEIGHT_M if above is None else row["height_m"] - foot + _ABOVE_PLATE_M)
        return drawn_from_side(points, (row["easting_m"], row["northing_m"], foot), height)

    def _square(self, rows: Any, number: int) -> str:
        if self._grid is None:
            return ""
        return str(self._grid.squares.tile_at(rows["easting_m"][number].as_py(), rows["northing_m"][number].as_py()))

    def _points_of(self, square: str) -> tuple[Any, Any, Any] | None:
        """Return the classified points of a square, if there are any."""
        record = self._points.get(square)
        if record is None:
            return None
        if square not in self._read:
            with self._session.store.scratch() as folder:
                path = Path(folder) / "points.laz"
                path.write_bytes(read_recorded(self._session.store, record))
                self._read[square] = read_classified(path)
        self._read.move_to_end(square)
        while len(self._read) > _KEPT_SQUARES:
            self._read.popitem(last=False)
        return self._read[square]


_CROSS: Final = 3.0  # half the stroke of a cross, in units of the drawing
_MOST_LINES: Final = 6000  # lines of the map
_SEEN: Final = "some of the most probable ones, in pictures or as returns in the colours of their classes"


class Assets(Section):
    """Objects on, beside and over the road."""

    name = "assets"
    title = "Assets"
    position = 600

    def blocks(self, material: Material) -> Iterator[Block]:
        """Yield a row per kind; a map; the assets of each kind that was found, and pictures of some."""
        layers = _layers(material)
        if not layers:
            return
        yield Table(("kind", "found", "median σ (m)", "mean probability", "length (m)", "area (m²)"), [
            _summed(schema, layer) for schema, layer in layers
        ], "Found assets by kind; σ is horizontal")  # fmt: skip
        held = [(schema, layer) for schema, layer in layers if layer.rows.num_rows]
        if held:
            yield _drawing(held)
        thumbnails = Thumbnails(material.session)
        for schema, layer in held:
            some = thumbnails.of(layer) if is_installed("cv2") else None
            if some is not None:
                yield Picture(some, f"{schema.title}: {_SEEN}")
            shown = ["road", "station_m", "offset_m", *(c.name for c in schema.own if not c.is_evidence), "probability"]
            head = [next(c.title for c in schema.columns if c.name == name) for name in shown]
            rows = [[_words(row[name]) for name in shown] for row in layer.rows.select(shown).to_pylist()]
            yield Table(head, rows, schema.meaning, schema.table)


def _layers(material: Material) -> list[tuple[AssetSchema, Layer]]:
    session = material.session
    tables = asset_tables()
    held = {unit.removesuffix(".parquet"): r for unit, r in session.manifest.of(TABLES).items()}
    if not held.keys() & tables.keys():
        return []
    context = product_context(plan_of(session))
    found = [(asset_schema(kind), held[name]) for name, kind in tables.items() if name in held]
    return [(schema, read_layer(schema, record, session.store, context)) for schema, record in found]


def _summed(schema: AssetSchema, layer: Layer) -> tuple[str, ...]:
    rows = layer.rows
    if not rows.num_rows:
        return (schema.title, "0", "–", "–", "–", "–")
    sums = [_words(_sum(rows, name)) for name in ("length_m", "area_m2")]
    sigma = float(np.median(rows["sigma_horizontal_m"].to_numpy()))
    return (
        schema.title, f"{rows.num_rows:,}", f"{sigma:.3f}", f"{np.mean(rows['probability'].to_numpy()):.2f}", *sums
    )  # fmt: skip


def _sum(rows: pa.Table, name: str) -> float | None:
    if name not in rows.schema.names:
        return None
    return float(np.nansum(rows[name].to_numpy(zero_copy_only=False).astype(np.float64)))


def _words(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:,.2f}" if isinstance(value, float) else str(value)


def _drawing(held: Sequence[tuple[AssetSchema, Layer]]) -> Drawing:
    """Return all assets on the map, one colour per kind."""
    page = MapPage.around(np.concatenate([shapely.get_coordinates(layer.shapes_m) for _, layer in held]))
    lines: list[Line] = []
    legend: list[tuple[str, str]] = []
    for (schema, layer), colour in zip(held, cycle(COLOURS), strict=False):
        legend.append((colour, schema.title))
        for shape in layer.shapes_m:
            place = page.on_page(shapely.get_coordinates(shape))
            lines += [Line(points, colour) for points in _points(place)]
    shown = "" if len(lines) <= _MOST_LINES else f" The map shows {_MOST_LINES:,} lines of {len(lines):,}."
    return Drawing(
        WIDTH, page.height, lines[:_MOST_LINES], scale_bar=page.scale_bar, legend=legend,
        caption=f"Assets in the coordinates of the map; points are crosses.{shown}",
    )  # fmt: skip


def _points(place: Float64) -> Iterator[str]:
    """Yield a line, or the two strokes of a cross, as SVG writes them."""
    if len(place) == 1:
        (x, y), c = place[0].tolist(), _CROSS
        yield f"{x - c:.1f},{y:.1f} {x + c:.1f},{y:.1f}"
        yield f"{x:.1f},{y - c:.1f} {x:.1f},{y + c:.1f}"
    else:
        yield " ".join(f"{x:.1f},{y:.1f}" for x, y in place.tolist())
