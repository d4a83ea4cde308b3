"""Report section on the inventory of assets, its conflicts, and changes since the last survey."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Final

import numpy as np
import shapely

from roadscan.inventory.changes import EpochChanges
from roadscan.inventory.inventory import Inventory
from roadscan.inventory.of_survey import truth_of
from roadscan.report.blocks import Block, Drawing, Paragraph, Table
from roadscan.report.section import Material, Section
from roadscan.store.asset_schema import asset_schema

_STATUS: Final = ("found", "missing", "confirmed", "rejected")
_COLOURS: Final = {"appeared": "#2ca02c", "gone": "#d62728", "moved": "#1f77b4", "changed": "#ff7f0e"}
_WIDTH: Final = 900.0  # width of the map, in its units
_MARGIN: Final = 20.0  # margin of the map
_MOST_MARKS: Final = 400  # changes that the map shows


class InventorySection(Section):
    """How many assets there are of each kind, and what changed on the road."""

    name = "inventory"
    title = "Inventory of assets"
    position = 650

    def blocks(self, material: Material) -> Iterator[Block]:
        """Yield counts by kind and status; conflicts; changes between the last two epochs with a map."""
        inventory = truth_of(material.session)
        if not inventory.truth.commits:
            return
        state = inventory.state()
        rows = []
        for kind, assets in state.assets.items():
            counts = Counter(assets.rows["status"].to_pylist())
            rows.append((asset_schema(kind).title, *(f"{counts[name]:,}" for name in _STATUS)))
        yield Table(("kind", *_STATUS), rows, f"Assets as of commit {state.commit}")
        yield from _conflicts(inventory)
        changes = inventory.changes()
        if changes is not None:
            yield from _changes(changes)


def _conflicts(inventory: Inventory) -> Iterator[Block]:
    found = inventory.conflicts()
    if found:
        rows = [
            (c.asset_id, c.attribute, c.reason, "–" if c.sigmas is None else f"{c.sigmas:.1f}", c.who) for c in found
        ]
        yield Paragraph(
            "People and evidence, or two persons, disagree on these values. Each keeps the value of the first edit "
            "until somebody decides.",
            is_warning=True,
        )
        yield Table(("asset", "attribute", "against", "σ", "edited by"), rows, "Conflicts", numbers=False)


def _changes(changes: EpochChanges) -> Iterator[Block]:
    counts = Counter(c.change for c in changes.changes)
    told = ", ".join(f"{counts[name]:,} {name}" for name in _COLOURS)
    unseen = f" {changes.unseen:,} assets were not seen and may not have been in sight." if changes.unseen else ""
    yield Paragraph(f"From {changes.before} to {changes.after}: {told}.{unseen}")
    if not changes.changes:
        return
    rows = [
        (
            c.change, c.asset_id, c.attribute, c.before or "–", c.after or "–",
            "–" if c.significance is None else f"{c.significance:.1f}",
            "–" if c.distance_m is None else f"{c.distance_m:.2f}",
        )
        for c in changes.changes
    ]  # fmt: skip
    yield Table(
        ("change", "asset", "attribute", "before", "after", "σ", "by m"), rows, "Changes of the road", numbers=False
    )
    yield _map(changes)


def _map(changes: EpochChanges) -> Drawing:
    """Return a map of the changes, north up."""
    shown = changes.changes[:_MOST_MARKS]
    points = np.array([shapely.get_coordinates(shapely.from_wkb(c.geometry))[0] for c in shown])
    low, extent = points.min(axis=0), np.maximum(np.ptp(points, axis=0), 1.0)
    scale = (_WIDTH - 2 * _MARGIN) / max(extent[0], extent[1])
    height = extent[1] * scale + 2 * _MARGIN
    marks = []
    for change, (x, y) in zip(shown, points, strict=True):
        left, top = _MARGIN + (x - low[0]) * scale, height - _MARGIN - (y - low[1]) * scale
        marks.append((float(left), float(top), "", _COLOURS[change.change]))
    bar_m = 10.0 ** np.floor(np.log10(max(extent) / 2))
    return Drawing(
        _WIDTH, float(height), (), marks=marks, scale_bar=(float(bar_m * scale), f"{bar_m:g} m"),
        legend=[(colour, name) for name, colour in _COLOURS.items()], caption="Changes of the road on the map",
    )  # fmt: skip
