"""The page over a fleet's catalogue: a map of its surveys, what is wrong with them, and figures by year."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import shapely

from roadscan.core.counted import counted
from roadscan.core.gpstime import iso_from_gps_ns
from roadscan.fleet.row import Row
from roadscan.report.blocks import COLOURS, WIDTH, Block, Drawing, Line, MapPage, Paragraph, Part, Table
from roadscan.report.page import html_page

_STATES: Final = {"finished": COLOURS[2], "unfinished": COLOURS[5], "failed": COLOURS[1], "not run": COLOURS[6]}
"""Colours of the states on the map."""
_DEGREE_M: Final = math.pi / 180 * 6_371_008.8
"""Length (m) of a degree of a great circle on a sphere of the Earth's mean radius (Moritz 2000)."""
_MOST_SURVEYS: Final = 5_000
"""Rows that the page lists: a page of more than a megabyte opens slowly, and the table holds them all."""


def fleet_page(rows: Sequence[Row]) -> str:
    """Return the page of a catalogue's rows as HTML; the same rows give the same text."""
    ordered = sorted(rows, key=lambda row: str(row.values["survey"]))
    parts = [_map(ordered), _wrong(ordered), _years(ordered), _surveys(ordered)]
    km = sum(row.values.get("driven_km") or 0.0 for row in ordered)
    lead = f"{counted(len(rows), 'survey')}, {km:,.1f} km driven. Times are UTC; σ is one standard deviation."
    shown = [part for part in parts if part.blocks]
    return html_page("Road surveys", "Road surveys", lead, shown, "the records of the surveys' stores")


def _map(rows: Sequence[Row]) -> Part:
    """Return the outlines of the surveys on a map in which a length has one scale, that of the middle latitude."""
    placed = [row for row in rows if row.place is not None and not row.place.is_empty]
    if not placed:
        return Part("map", "Where", [])
    outlines = [shapely.get_coordinates(row.place) for row in placed]
    middle = math.radians(float(np.mean([outline[:, 1].mean() for outline in outlines])))
    turned = [outline * _DEGREE_M * (math.cos(middle), 1.0) for outline in outlines]
    page = MapPage.around(np.concatenate(turned))
    lines, marks = [], []
    for row, places_m in zip(placed, turned, strict=True):
        colour, on_page = _STATES[str(row.values["state"])], page.on_page(places_m)
        lines.append(Line(" ".join(f"{x:.1f},{y:.1f}" for x, y in on_page), colour))
        x, y = on_page.mean(axis=0)
        marks.append((float(x), float(y), str(row.values["survey"]), colour))
    shown = {str(row.values["state"]) for row in placed}
    legend = [(colour, state) for state, colour in _STATES.items() if state in shown]
    caption = "Hulls of the surveys' tiles; each point names its survey."
    without = len(rows) - len(placed)
    caption += f" Without a place on the map: {counted(without, 'survey')}." if without else ""
    drawing = Drawing(WIDTH, page.height, lines, marks=marks, scale_bar=page.scale_bar, legend=legend, caption=caption)
    return Part("map", "Where", [drawing])


def _wrong(rows: Sequence[Row]) -> Part:
    """Return the surveys that need somebody: those with notes, failures or damage, or not run to the end."""
    due = [
        row.values for row in rows if row.values["notes"] or row.values["failed"] or row.values["state"] != "finished"
    ]
    if not due:
        return Part("wrong", "What is wrong", [Paragraph("Nothing: each survey's last run finished.")])
    head = ("survey", "state", "failed", "damaged", "why")
    lines = [[str(one[name]) for name in ("survey", "state", "failed", "damaged", "notes")] for one in due]
    return Part("wrong", "What is wrong", [Table(head, lines, numbers=False, most_rows=_MOST_SURVEYS)])


def _years(rows: Sequence[Row]) -> Part:
    """Return lengths and condition of the network by year; a lane counts as often as it was driven."""
    years = sorted({int(row.values["year"]) for row in rows if row.values.get("year") is not None})
    lines = []
    for year in years:
        of_year = [row.values for row in rows if row.values.get("year") == year]
        lines.append(
            [
                str(year), str(len(of_year)), _sum(of_year, "driven_km"), _sum(of_year, "lane_km"),
                _mean(of_year, "mri_m_per_km", "mri_km", ".2f"), _mean(of_year, "rut_depth_mean_mm", "lane_km", ".1f"),
                _mean(of_year, "cracked_wheel_path_percent", "lane_km", ".1f"),
            ]
        )  # fmt: skip
    head = ("year", "surveys", "km driven", "lane km", "MRI (m/km)", "rut (mm)", "cracked (%)")
    caption = "Means are weighted by length. A lane that was driven twice in a year counts twice."
    blocks: list[Block] = [Table(head, lines, caption)] if lines else []
    return Part("years", "By year", blocks)


def _surveys(rows: Sequence[Row]) -> Part:
    figures = ("km", "lane km", "σ height (mm)", "MRI (m/km)")
    head = ("survey", "title", "state", "from", "rig", *figures, "version")
    lines = [
        [
            str(one["survey"]), str(one["title"]), str(one["state"]), _day(one.get("first_epoch_gps_ns")),
            str(one["rig"]), _shown(one.get("driven_km"), ",.2f"), _shown(one.get("lane_km"), ",.2f"),
            _shown(one.get("sigma_down_m"), ".1f", 1e3), _shown(one.get("mri_m_per_km"), ".2f"),
            str(one["version"]),
        ]
        for one in (row.values for row in rows)
    ]  # fmt: skip
    table = Table(head, lines, full_table="fleet", numbers=False, most_rows=_MOST_SURVEYS)
    return Part("surveys", "All surveys", [table] if lines else [])


def _day(epoch_gps_ns: int | None) -> str:
    return "" if epoch_gps_ns is None else iso_from_gps_ns(epoch_gps_ns)[:10]


def _shown(value: float | None, form: str, factor: float = 1.0) -> str:
    return "" if value is None else f"{value * factor:{form}}"


def _sum(rows: Sequence[dict[str, Any]], name: str) -> str:
    known = [float(row[name]) for row in rows if row.get(name) is not None]
    return f"{sum(known):,.2f}" if known else ""


def _mean(rows: Sequence[dict[str, Any]], name: str, weight: str, form: str) -> str:
    known = [(row[name], row[weight]) for row in rows if row.get(name) is not None and row.get(weight)]
    total = sum(length for _, length in known)
    return f"{sum(value * length for value, length in known) / total:{form}}" if total else ""
