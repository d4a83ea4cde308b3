"""Layers of cracks and potholes."""

from __future__ import annotations

from collections.abc import Iterator

from roadscan.site.layer import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    RED,
    LayerKind,
    SiteLayer,
    Style,
    described,
    table_layer,
)
from roadscan.site.material import Material

_TYPES = {"longitudinal": BLUE, "transverse": ORANGE, "diagonal": GREEN, "alligator": RED, "unknown": GREY}


class Distress(LayerKind):
    """The survey's cracks and potholes."""

    name = "distress"

    def layers(self, material: Material) -> Iterator[SiteLayer]:
        """Yield a layer for each product that was made."""
        cracks = [
            Style("Type", 2, by="type", values=_TYPES),
            Style("Mean width (m)", 2, by="width_mean_m", limits=(0.003, 0.006, 0.013, 0.019)),
        ]
        potholes = [Style("Greatest depth (m)", 2, by="depth_max_m", limits=(0.013, 0.025, 0.05, 0.1))]
        yield from table_layer(
            material, "cracks", described("cracks", "Cracks", "distress", "line", 400, cracks, key="crack")
        )
        yield from table_layer(
            material, "potholes", described("potholes", "Potholes", "distress", "polygon", 410, potholes, key="pothole")
        )
