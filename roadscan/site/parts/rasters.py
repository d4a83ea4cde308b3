"""Rasters: height, hillshade, intensity and the pavement in levels, as square pictures in the survey's map."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from roadscan.core.strict import Strict
from roadscan.run.keys import code_digest, key_of
from roadscan.site.document import Ask, Document, SitePart, json_bytes
from roadscan.site.material import Material
from roadscan.site.site_rasters import (
    COARSER,
    HEIGHT_STEP_M,
    PAVEMENT,
    RASTERS,
    Place,
    Pyramid,
    Raster,
    Scales,
    TileWindows,
    coarser_picture,
    write_picture,
)
from roadscan.store.manifest import OutputRecord, read_recorded
from roadscan.tiles.products.pavement import IntensityOptions
from roadscan.tiles.tasks.wanted_products import wanted_products

_CODE: Final = ("roadscan.site.site_rasters", "roadscan.tiles.mosaics.products:StoredTiles")
_PATH: Final = re.compile(r"rasters/(\w+)/(\d+)/(-?\d+)_(-?\d+)\.png")
_ABOUT: Final[dict[Raster, dict[str, Any]]] = {
    "height": {
        "title": "Height", "unit": "m", "encoding": "rgb24", "colours": "viridis", "order": 10, "visible": False,
    },
    "hillshade": {
        "title": "Hillshade", "unit": "", "encoding": "grey8", "colours": "grey", "order": 20, "visible": True,
    },
    "intensity": {
        "title": "Intensity", "unit": "counts", "encoding": "grey8", "colours": "grey", "order": 30, "visible": False,
    },
    "pavement_intensity": {
        "title": "Pavement: brightness", "unit": "counts", "encoding": "grey8", "colours": "grey", "order": 40,
        "visible": False,
    },
    "pavement_shaded": {
        "title": "Pavement: slanting light", "unit": "", "encoding": "grey8", "colours": "grey", "order": 50,
        "visible": False,
    },
}  # fmt: skip


class Rasters(SitePart):
    """Rasters with common levels and pictures."""

    name = "rasters"
    position = 300

    def members(self, material: Material) -> Mapping[str, Any]:
        """Return the levels, and what the numbers of each raster mean."""
        images = images_of(material)
        if not images.levels:
            return {"raster_grid": None, "rasters": []}
        return {
            "raster_grid": {"tile_px": images.pyramid.tile_px, "levels": [images.about(k) for k in images.levels]},
            "rasters": [images.told(raster) for raster in images.rasters],
        }

    def documents(self, material: Material) -> Iterator[Document]:
        """Yield lists of the existing pictures, level by level, then all pictures, those of one place together."""
        yield from self.listed(material)
        images = images_of(material)
        for level in images.levels:
            for column, row in images.pyramid.places(level).tolist():
                for raster in images.rasters:
                    yield images.document(raster, Place(level, column, row))

    def listed(self, material: Material) -> Iterator[Document]:
        """Yield lists of the existing pictures, level by level."""
        images = images_of(material)
        for number, level in enumerate(images.levels):
            yield images.list_of(number, level)

    def find(self, material: Material, path: str) -> Document | None:
        """Return a picture by its path."""
        found, images = _PATH.fullmatch(path), images_of(material)
        if found is None or int(found[2]) >= len(images.levels):
            return None
        place = Place(images.levels[int(found[2])], int(found[3]), int(found[4]))
        named = next((raster for raster in images.rasters if raster == found[1]), None)
        return images.document(named, place) if named is not None and images.pyramid.holds(place) else None


@dataclass(frozen=True, eq=False)
class Images:
    """Pictures of a survey's rasters."""

    material: Material

    @cached_property
    def pyramid(self) -> Pyramid:
        """Levels over the survey's tiles."""
        return Pyramid(self.material.context.grid, tuple(self.material.tiles))

    @cached_property
    def levels(self) -> tuple[int, ...]:
        """Levels of the pyramid that the site has, where they are numbered from 0."""
        finest = self.material.wishes.finest_pixel_m
        known = range(len(self.pyramid.factors)) if self.material.tiles else range(0)
        always = self.pyramid.stored_levels - 1 if self.material.tiles else 0  # coarser levels are made from it
        return tuple(k for k in known if k >= always or self.pyramid.pixel_m(k) >= finest - 1e-12)

    @cached_property
    def settings(self) -> Mapping[Raster, Strict]:
        """Settings of the products of the pavement that the survey makes."""
        made = {product.name: options for product, options in wanted_products(self.material.session.survey)}
        return {raster: made[raster] for raster in PAVEMENT if raster in made}

    @property
    def rasters(self) -> tuple[Raster, ...]:
        """All rasters of the survey."""
        return (*RASTERS, *self.settings)

    @cached_property
    def scales(self) -> Scales:
        """Meaning of the numbers."""
        return Scales.of(self.material.summaries.values())

    @cached_property
    def _windows(self) -> TileWindows:
        return TileWindows(self.pyramid, self.material.cells())

    def about(self, level: int) -> dict[str, Any]:
        """Return a level's JSON values for the page."""
        places = self.pyramid.places(level)
        low, high = places.min(axis=0).tolist(), places.max(axis=0).tolist()
        pixel_m, number = self.pyramid.pixel_m(level), self.levels.index(level)
        return {
            "level": number, "pixel_m": pixel_m, "tile_m": pixel_m * self.pyramid.tile_px,
            "columns": [low[0], high[0]], "rows": [low[1], high[1]], "count": len(places),
            "tiles": f"rasters/tiles_{number}.json",
        }  # fmt: skip

    def told(self, raster: Raster) -> dict[str, Any]:
        """Return a raster's JSON values for the page."""
        held = self.material.summaries.values()
        ends = min(s.height_min_m for s in held), max(s.height_max_m for s in held)
        scale: dict[Raster, tuple[float, float, float, float]] = {
            "height": (self.scales.height_offset_m, HEIGHT_STEP_M, *ends),
            "intensity": (0.0, self.scales.intensity_step, 0.0, 255 * self.scales.intensity_step),
        }
        settings = self.settings.get(raster)
        if isinstance(settings, IntensityOptions):  # grey 1 is black, 255 white
            step = (settings.white - settings.black) / 254
            scale[raster] = settings.black - step, step, settings.black, settings.white
        named = dict(zip(("offset", "step", "from", "to"), scale.get(raster, (0, 1, 1, 255)), strict=True))
        return {"name": raster, **_ABOUT[raster], **named, "url": f"rasters/{raster}/{{level}}/{{column}}_{{row}}.png"}

    def list_of(self, number: int, level: int) -> Document:
        """Return a list of a level's pictures."""

        def write(path: Path, _ask: Ask) -> None:
            path.write_bytes(json_bytes({"level": number, "rows": self.pyramid.runs(level)}))

        shape = [self.pyramid.tile_px, self.pyramid.factors[level], self.pyramid.grid.size_m, self.pyramid.grid.cell_m]
        return Document(
            f"rasters/tiles_{number}.json", key_of(code_digest(*_CODE), number, shape, self._tiles_key), write
        )

    @cached_property
    def _tiles_key(self) -> str:
        return key_of(self.pyramid.tiles)

    def document(self, raster: Raster, place: Place) -> Document:
        """Return a picture."""
        number = self.levels.index(place.level)
        path = f"rasters/{raster}/{number}/{place.column}_{place.row}.png"
        return Document(path, self._key(raster, place), lambda file, ask: self._write(file, ask, raster, place))

    def _write(self, path: Path, ask: Ask, raster: Raster, place: Place) -> None:
        if place.level < self.pyramid.stored_levels:
            window = self._windows.window(place)
            pixel_m, settings = self.pyramid.pixel_m(place.level), self.settings.get(raster)
            write_picture(path, raster, window, pixel_m, self.scales, settings)
            return

        def below(finer: Place) -> Path | None:
            file = ask(self.document(raster, finer).path) if self.pyramid.holds(finer) else None
            return file if file is not None and file.is_file() else None  # a picture that failed leaves a hole

        coarser_picture(path, raster, below, place, self.pyramid.tile_px)

    def _key(self, raster: Raster, place: Place) -> str:
        """Return a hash of a picture's tiles and of its settings."""
        tiles = self.material.tiles
        if place.level < self.pyramid.stored_levels:
            parts: Any = [tiles[t].digest for t in self.pyramid.tiles_in(place.level, place)]
        else:
            steps = range(COARSER)
            west, south = COARSER * place.column, COARSER * place.row
            below = [Place(place.level - 1, west + c, south + r) for r in steps for c in steps]
            parts = [self._held_key(raster, one) for one in below if self.pyramid.holds(one)]
        settings = self.settings.get(raster)
        stated = None if settings is None else settings.model_dump(mode="json")
        return key_of(code_digest(*_CODE), raster, place, parts, self.scales, self.pyramid.pixel_m(place.level), stated)

    @functools.lru_cache(maxsize=200_000)  # noqa: B019  as above
    def _held_key(self, raster: Raster, place: Place) -> str:
        return self._key(raster, place)


@functools.lru_cache(maxsize=2)
def images_of(material: Material) -> Images:
    """Return the pictures of a survey; the same object for the same material."""
    return Images(material)


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
