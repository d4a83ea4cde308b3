"""The street with an inventory that people edit: its layers come from it as those of a survey do."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

from roadscan.core.crs import MapFrame
from roadscan.inventory.homes.page_edits import PageDocument
from roadscan.site.document import json_bytes
from roadscan.site.layer import SiteLayer
from roadscan.site.layers.assets import Assets
from roadscan.site.live import Served
from roadscan.site.material import Wishes
from roadscan.site.parts import vectors
from tests.inventory.streets import EAST, NORTH, asset, found, inventory
from tests.viewer.street import EAST_M, HOSTILE, NORTH_M

POLES: Final = ((10.0, 3.0), (20.0, 3.0), (30.0, 3.0))
"""Metres from the street's beginning, and to the left of its middle."""
CRACK: Final = ((14.0, -1.0, 40.0), (14.5, -1.0, 40.0), (16.0, -1.0, 40.0))
"""The same with heights."""


class EditedSite:
    """Documents of the street, those of the poles from an inventory."""

    def __init__(self, street: Path, folder: Path) -> None:
        self._street, self._folder = street, folder
        self.inventory = inventory(folder)
        shift = EAST_M - EAST, NORTH_M - NORTH
        rows = [asset("pole", (shift[0] + x, shift[1] + y, 40.0), object=f"p{n}") for n, (x, y) in enumerate(POLES)]
        crack = asset("crack", *((shift[0] + x, shift[1] + y, z) for x, y, z in CRACK), severity="low")
        self.inventory.record(found([*rows, crack]))
        self.taken = 0

    def document(self, path: str) -> Served | None:
        """A document as it is now."""
        if path == "survey.json":
            own = [vectors.about(layer) for layer in self._layers()]
            names = [one["name"] for one in own]
            survey = json.loads((self._street / path).read_text())
            survey["layers"] = [*own, *(one for one in survey["layers"] if one["name"] not in (*names, "cracks"))]
            commit = self.inventory.state().commit
            survey["edits"] |= {"layers": names, "post": "edits", "inventory": "street", "commit": commit}
            return self._made(path, survey)
        for layer in self._layers() if path.startswith("layers/asset_") else ():
            files = dict(vectors.files_of(layer))
            if path in files:
                return self._made(path, files[path]())
        file = self._street / path
        return Served(file, path) if file.is_file() else None

    def take(self, content: bytes, _who: str = "") -> dict[str, Any]:
        """Take in edits as `roadscan view --edit` does."""
        document = PageDocument.parse("the page", content, (1.0, 1.0, 1.0))
        pulled, outcomes = self.inventory.pull_page(document, sound=True)
        self.taken += 1
        return {"commit": pulled.commit, "edits": [one._asdict() for one in outcomes]}

    def another(self, number: int, **attributes: Any) -> None:
        """What somebody else writes meanwhile, who saw commit 1."""
        given = {"layer": "asset_poles", "action": "change", "asset_id": self.id_of(number), "attributes": attributes}
        head = {"type": "FeatureCollection", "coordinates": "map_m", "survey": "s", "inventory": "street", "commit": 1}
        feature = {"type": "Feature", "geometry": None, "properties": given | {"author": HOSTILE}}
        self.take(json.dumps({**head, "features": [feature]}).encode())

    def id_of(self, number: int) -> str:
        """Id of a pole."""
        ids = {row["easting_m"]: row["asset_id"] for row in self.inventory.state().assets["pole"].rows.to_pylist()}
        return str(ids[sorted(ids)[number]])

    def _layers(self) -> list[SiteLayer]:
        state = self.inventory.state()
        material: Any = SimpleNamespace(
            inventory=("street", state), wishes=Wishes(edits="post"),
            context=SimpleNamespace(map=MapFrame(crs="EPSG:32632")), plan=SimpleNamespace(passes=()),
        )  # fmt: skip
        return list(Assets().layers(material))

    def _made(self, path: str, value: Any) -> Served:
        content = json_bytes(value)
        file = self._folder / f"{abs(hash(content))}.json"
        file.write_bytes(content)
        return Served(file, file.stem)
