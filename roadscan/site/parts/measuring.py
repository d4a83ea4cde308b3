"""Measuring in pictures: the server's paths for it. A published site has no server, and so none of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

from roadscan.site.document import Document
from roadscan.site.material import Material
from roadscan.site.part import SitePart
from roadscan.site.site_pictures import placed_pictures

MEASURE: Final = "measure"
"""Path at which a server gives places of pixels."""
CONTROL: Final = "control"
"""Path at which a server takes control points that are clicked in pictures."""


class Measuring(SitePart):
    """What a page may ask the server about its pictures."""

    name = "measuring"
    position = 650

    def members(self, material: Material) -> Mapping[str, Any]:
        """Return the paths; null where no server answers, or there are no pictures."""
        if not material.wishes.stays_here or placed_pictures(material) is None:
            return {"measuring": None}
        takes = material.wishes.edits == "post" and has_control(material)
        return {"measuring": {"measure": MEASURE, "control": CONTROL if takes else None}}

    def documents(self, material: Material) -> Iterator[Document]:
        """Yield nothing: all of it is asked for."""
        yield from ()


def has_control(material: Material) -> bool:
    """Return True where the survey has control points and pictures that may see them."""
    has_points = any(record.tables.get("control_points") for record in material.plan.records)
    return has_points and placed_pictures(material) is not None
