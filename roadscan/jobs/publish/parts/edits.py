"""Edits: which layers people may edit, and where their edits go."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

from roadscan.inventory.homes.page_edits import LAYER
from roadscan.jobs.publish.document import Document
from roadscan.jobs.publish.material import Material
from roadscan.jobs.publish.part import SitePart
from roadscan.jobs.publish.parts.vectors import site_layers
from roadscan.model.errors import DamagedError

POST: Final = "edits"
"""Where a server takes edits."""


class Edits(SitePart):
    """The layers of the inventory, where edits are wished for and the survey has one."""

    name = "edits"
    position = 150

    def members(self, material: Material) -> Mapping[str, Any]:
        """The layers, the commit that they show, and where edits are sent; null where nothing is to be edited."""
        return {"edits": _about(material)}

    def documents(self, material: Material) -> Iterator[Document]:
        """None: what is edited lies in the layers."""
        return iter(())


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
    return {"layers": layers, "post": post, "inventory": name, "commit": state.commit}
