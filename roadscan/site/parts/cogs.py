"""Rasters of the survey as cloud-optimised GeoTIFFs for other programs, as the survey's products made them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from roadscan.site.document import Ask, Document
from roadscan.site.material import Material
from roadscan.site.part import SitePart
from roadscan.store.manifest import OutputRecord, read_recorded

_PRODUCTS: Final = ("hillshade", "kilometre", "mosaic", "surface_hillshade", "surface_mosaic")


class Cogs(SitePart):
    """Sheets and the indices that join them; the page does not read them."""

    name = "cogs"
    position = 500

    def members(self, material: Material) -> Mapping[str, Any]:
        """Return the paths of all files."""
        return {"cogs": [cog_url(record) for record in cog_records(material)]}

    def documents(self, material: Material) -> Iterator[Document]:
        """Yield a copy of each file."""
        for record in cog_records(material):
            yield Document(cog_url(record), record.digest, _copied(material, record))


def cog_records(material: Material) -> list[OutputRecord]:
    """Return records of the files, by path; none for a part of a survey."""
    if material.wishes.near is not None:
        return []
    found = [r for name in _PRODUCTS for r in material.session.manifest.of(name).values()]
    return sorted((r for r in found if r.path.endswith((".tif", ".vrt"))), key=lambda r: r.path)


def cog_url(record: OutputRecord) -> str:
    """Return the path of a file in the site."""
    return f"cogs/{record.product}/{record.path.rsplit('/', 1)[-1]}"


def _copied(material: Material, record: OutputRecord) -> Any:
    def write(path: Path, _ask: Ask) -> None:
        path.write_bytes(read_recorded(material.store, record))

    return write
