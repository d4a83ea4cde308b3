"""Report section on assets by kind, with a map, and a table for each kind."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import cycle
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.assets.files.layers import Layer
from roadscan.assets.tasks.tables import TABLES, read_layer
from roadscan.core.extras import is_installed
from roadscan.georeference.plan.plan import plan_of
from roadscan.report.asset_thumbnails import Thumbnails
from roadscan.report.blocks import COLOURS, WIDTH, Block, Drawing, Line, MapPage, Picture, Table
from roadscan.report.section import Material, Section
from roadscan.store.asset_schema import AssetSchema, asset_schema, asset_tables
from roadscan.tiles.tasks.wanted_products import product_context

_CROSS: Final = 3.0  # half the stroke of a cross, in units of the drawing
_MOST_LINES: Final = 6000  # lines of the map
_SEEN: Final = "some of the most probable ones, in pictures or as returns in the colours of their classes"

Float64 = npt.NDArray[np.float64]


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
