"""Edits: which layers people may edit, and where their edits go."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

from roadscan.core.errors import DamagedError
from roadscan.inventory.homes.page_edits import LAYER
from roadscan.site.document import Document, SitePart, json_document
from roadscan.site.layers.assets import GEOMETRY_OF, site_column
from roadscan.site.material import Material
from roadscan.site.parts.vectors import site_layers
from roadscan.site.site_pictures import placed_pictures
from roadscan.store.asset_schema import asset_columns, asset_kind_names, asset_schema, editable_columns

POST: Final = "edits"
"""Path at which a server takes edits."""
FORMS: Final = "edits/forms.json"
"""The columns that people fill in, by layer."""


class Edits(SitePart):
    """The layers of the inventory, where edits are requested and the survey has one."""

    name = "edits"
    position = 150

    def members(self, material: Material) -> Mapping[str, Any]:
        """Return the layers, their commit, and the address for edits; null where nothing is to be edited."""
        return {"edits": _about(material)}

    def documents(self, material: Material) -> Iterator[Document]:
        """Yield the forms of all kinds; the edited objects are in the layers."""
        if _about(material) is not None:
            yield json_document(FORMS, forms())


def kinds() -> list[dict[str, str]]:
    """Return all kinds of assets by title: the layer of each, and its geometry."""
    known = [asset_schema(kind) for kind in asset_kind_names()]
    told = [
        {"layer": f"{LAYER}{one.table}", "title": one.title, "geometry": GEOMETRY_OF[one.geometry]} for one in known
    ]
    return sorted(told, key=lambda one: one["title"])


def forms() -> dict[str, Any]:
    """Return the columns of each kind that people fill in for a new object, its specific ones first."""
    columns = {}
    for kind in asset_kind_names():
        schema, edited = asset_schema(kind), editable_columns(kind)
        order = [*schema.own, *(c for c in asset_columns(kind) if c not in schema.own)]
        columns[f"{LAYER}{schema.table}"] = [
            site_column(c, (), is_edited=True).stated() for c in order if c.name in edited
        ]
    return {"columns": columns}


def _about(material: Material) -> dict[str, Any] | None:
    if not material.wishes.edits:
        return None
    try:
        shown = material.inventory
    except DamagedError:
        return None
    if shown is None:
        return None
    name, state = shown
    layers = [layer.name for layer in site_layers(material)[0] if layer.name.startswith(LAYER)]
    post = POST if material.wishes.edits == "post" else None
    about = {"layers": layers, "kinds": kinds(), "forms": FORMS, "post": post}
    return about | {"inventory": name, "commit": state.commit}


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
