"""Layers of the roads: reference lines, lanes, surfaces, sections by condition, patches, regions."""

from __future__ import annotations

from collections.abc import Iterator

from roadscan.site.layer import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    LayerKind,
    SiteLayer,
    Style,
    described,
    table_layer,
)
from roadscan.site.material import Material

_ROUGHNESS = Style("MRI (m/km)", 6, by="mri_m_per_km", limits=(1.0, 1.5, 2.7, 4.0))  # limits: see `_STYLES`
_RUTS_MM = (2.5, 5.1, 10.2, 15.0)  # limits: see `_STYLES`
_STYLES = (
    _ROUGHNESS,
    Style("Rut depth left (mm)", 6, by="rut_depth_mean_left_mm", limits=_RUTS_MM),
    Style("Rut depth right (mm)", 6, by="rut_depth_mean_right_mm", limits=_RUTS_MM),
    Style("Cracked wheel path (%)", 6, by="cracked_wheel_path_percent", limits=(1.0, 5.0, 20.0, 40.0)),
    Style("Faulting (mm)", 6, by="faulting_mean_mm", limits=(1.0, 2.5, 3.8, 6.0)),
    Style("Cross-slope (%)", 6, by="cross_slope_mean_percent", limits=(-4.0, -1.0, 1.0, 4.0)),
    Style("Ravelled (%)", 6, by="ravelled_percent", limits=(0.1, 2.0, 10.0, 20.0)),
    Style("Mean profile depth (mm)", 6, by="mpd_mean_mm", limits=(0.4, 0.6, 0.8, 1.2)),
)
"""Limits of good, fair and poor for IRI, rutting, cracking and faulting are those of 23 CFR 490.313 (IRI 95 and 170
in/mi, rutting 0.20 and 0.40 in, cracking 5 and 20 %, faulting 0.10 and 0.15 in); the others only divide the colours."""

# Lines of 6 pixels.
_BY_TILE = (_ROUGHNESS, Style("Rut depth (mm)", 6, by="rut_depth_mean_mm", limits=_RUTS_MM))


class Condition(LayerKind):
    """Results of the stage `condition`."""

    name = "condition"

    def layers(self, material: Material) -> Iterator[SiteLayer]:
        """Yield a layer for each table that the survey has."""
        for table, about in (
            ("reference_lines", described("reference_lines", "Reference lines", "survey", "line", 210,
                [Style("one colour", 1, PURPLE)], key="road", visible=False)),
            ("lanes", described("lanes", "Lanes", "survey", "line", 220, [Style("one colour", 2, SKY)], visible=False)),
            ("condition_sections", described("condition_sections", "Condition by section", "condition", "line", 300,
                _STYLES)),
            ("condition_tiles", described("condition_tiles", "Condition by tile", "condition", "polygon", 290, _BY_TILE,
                visible=False)),
            ("road_surface", described("road_surface", "Road surface inside its edges", "survey", "polygon", 205,
                [Style("one colour", 1, SKY)], visible=False)),
            ("roughness_regions", described("roughness_regions", "Roughness regions", "condition", "polygon", 310,
                [Style("one colour", 1, BLUE)], visible=False)),
            ("ravelling_patches", described("ravelling_patches", "Ravelled patches", "condition", "polygon", 311,
                [Style("Texture over that of the section", 1, by="ratio", limits=(1.2, 1.4, 2.0, 3.0))],
                visible=False)),
        ):  # fmt: skip
            yield from table_layer(material, table, about)


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
