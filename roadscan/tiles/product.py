"""Defines the interface of products, and the registry that finds them.

A product is one file of a folder `products` of its feature (or one entry point of the group ``roadscan.products``) with
one subclass of :class:`TileProduct`, :class:`SurfaceProduct` or :class:`SurveyProduct`. It writes whole files to the
path it is given; keys, temporary names, checks and the manifest are done for it.
"""

from __future__ import annotations

import datetime as dt
import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Final, Literal, Protocol, Self, TypeAlias

from roadscan.core.crs import MapFrame
from roadscan.core.errors import ConfigError, nearest
from roadscan.core.grid import LanePass, TileGrid, TileId
from roadscan.core.plugins import found_kinds
from roadscan.core.strict import Strict
from roadscan.georeference.cloud import TilePoints
from roadscan.pictures.views import PictureRule
from roadscan.run.keys import key_of
from roadscan.store.digest import file_digest
from roadscan.store.manifest import OutputRecord
from roadscan.store.store import Store
from roadscan.surface.tile import SurfaceTile
from roadscan.tiles.cells import CellValues, Level, TileCells, overview_factors, pyramid_of
from roadscan.tiles.lane_direction import LaneDirections

ENTRY_POINT_GROUP: Final = "roadscan.products"
"""Entry-point group through which a third party's package adds a product."""


FINE_CELL_M: Final = 0.02
"""Below this edge, cells are those of profilers at line rate, and a network is viewed by tile or in overview."""

Cells = Literal["any", "fine", "coarse"]


class NoOptions(Strict):
    """Settings of a product without settings."""


@dataclass(frozen=True)
class ProductContext:
    """Information that products need beside their data; none of it depends on how the work was batched."""

    survey_id: str
    title: str
    map: MapFrame
    grid: TileGrid
    passes: tuple[LanePass, ...]
    date: dt.date
    """UTC date of the survey's first epoch; stands where files want a creation date."""
    surface_cell_m: tuple[float, float] | None = None
    """Edges (m), east and north, of a cell of the reconstructed surface; None for a survey without one."""


@dataclass(frozen=True)
class Tile:
    """A computed tile, as tile products receive it. Its arrays may be reused after the product is written."""

    points: TilePoints | None
    """None unless a wanted product needs points."""
    cells: TileCells
    marked: TilePoints | None = None
    """Filtered points, withheld and marked by class, where the survey keeps them (`keep_marked`)."""
    sigma_horizontal_m: float | None = None
    """Largest horizontal 1 σ of the poses of the readings, √(σ_north² + σ_east²); None where not stated."""
    sigma_height_m: float | None = None
    """Largest vertical 1 σ of the poses; None where not stated."""

    @functools.cached_property
    def overviews(self) -> list[Level]:
        """The cells in larger pixels, ascending; computed once for all products."""
        return pyramid_of(self.cells, overview_factors(self.cells.cells_per_edge))


@dataclass(frozen=True, slots=True)
class TileSummary:
    """One row of ``schemas/tiles.toml``, without the outline."""

    tile: TileId
    points: int
    cells: int
    height_min_m: float
    height_mean_m: float
    height_max_m: float
    height_std_median_m: float
    intensity_mean: float
    passes: tuple[int, ...]
    first_epoch_gps_ns: int
    last_epoch_gps_ns: int
    sigma_horizontal_m: float | None = None
    sigma_down_m: float | None = None

    @classmethod
    def without_readings(cls, tile: TileId) -> Self:
        """Return the summary of a tile that has a surface and no reading."""
        nan = math.nan
        return cls(tile, 0, 0, nan, nan, nan, nan, nan, (), 0, 0)


@dataclass(frozen=True)
class Output:
    """One file of a survey product."""

    name: str
    """File name below ``products/<product>/``."""
    tiles: tuple[TileId, ...]
    """Tiles that its content depends on; it is rewritten when one of them changes."""


class LoadCells(Protocol):
    """Loads what the store has of a tile, for products over many tiles."""

    def __call__(self, tile: TileId) -> TileCells | None:
        """Return the cells of a tile, or None where the survey has no such tile."""

    def values(self, tile: TileId, name: str) -> CellValues | None:
        """Return one column of these cells, by its name: of 5 mm cells a tenth of the time that all columns take."""

    def overview(self, tile: TileId, factor: int) -> Level | None:
        """Return the overview of a tile in pixels of `factor` squared cells, or None where the survey has no such tile.

        `factor` is one of :func:`roadscan.tiles.cells.overview_factors`.
        """

    def file(self, product: str, tile: TileId) -> bytes | None:
        """Return the content of a tile's file of a surface product that this product `reads`, or None."""

    def lanes(self) -> LaneDirections:
        """Return the directions of the lanes, for a product that `needs_lanes`."""


class TileFiles(ABC):
    """Common part of the two kinds of product with one file per tile."""

    name: ClassVar[str]
    """Name in survey files, and of its folder below ``tiles/``."""
    title: ClassVar[str]
    """One line: what it is and who reads it."""
    suffix: ClassVar[str]
    """File suffix with its dot."""
    version: ClassVar[int] = 1
    """Raised when the written bytes change."""
    options: ClassVar[type[Strict]] = NoOptions
    """Model of its settings."""
    default: ClassVar[bool] = True
    """Whether it is made where the survey file does not list products."""
    default_cells: ClassVar[Cells] = "any"
    """Made by default only with fine cells (below 2 cm) or only with coarse ones, if it is made by default."""

    def suffix_for(self, options: Strict) -> str:
        """Return the file suffix under these settings."""
        return self.suffix

    def companions(self, options: Strict) -> dict[str, str]:
        """Return small files that belong beside each file, such as a world file: suffix by name.

        They are written with the file, under its path with another suffix; the names do not
        depend on the settings.
        """
        return {}

    def check_options(self, options: Strict, context: ProductContext) -> None:
        """Raise :class:`ConfigError` where the settings do not fit the survey; called once, before any work."""
        return

    @abstractmethod
    def check(self, path: Path) -> None:
        """Raise :class:`roadscan.core.errors.StoreError` unless `path` is whole and readable."""


class TileProduct(TileFiles):
    """A product of one file per tile, written while the tile's points are in memory."""

    needs_points: ClassVar[bool] = False
    """True for a product of single points, for which readings are georeferenced one by one."""

    @abstractmethod
    def write(self, tile: Tile, options: Strict, context: ProductContext, path: Path) -> None:
        """Write the tile's file to `path` (a temporary name on a local disk)."""


class SurfaceProduct(TileFiles):
    """A product of one file per tile, written while the tile's reconstructed surface is in memory.

    It is made in the stage `surfaces`, which the section `[surface]` of the survey file turns on; without that
    section none is made by default.
    """

    def around_m(self, options: Strict, cell_m: tuple[float, float]) -> float:
        """Return how far beyond a tile the product needs heights before smoothing (m); 0 where smoothed ones suffice.

        `cell_m` are a cell's edges, east and north.
        """
        return 0.0

    def check_cells(self, options: Strict, cell_m: tuple[float, float], seen: int) -> None:
        """Raise :class:`ConfigError` where the settings do not fit the surface's cells; called once, before any work.

        `cell_m` are a cell's edges, east and north; `seen` is how many of the neighbours' a tile shows on each side.
        """
        return

    def picture_rule(self, options: Strict) -> PictureRule | None:
        """Return which of the survey's pictures give colours, for a product that needs them; called before any work."""
        return None

    def coloured_nodes(self, surface: SurfaceTile, options: Strict) -> tuple[range, range]:
        """Return rows and columns of the surface's arrays whose colours such a product gets, as `surface.colours`."""
        return range(0), range(0)

    @abstractmethod
    def write(self, surface: SurfaceTile, options: Strict, context: ProductContext, path: Path) -> None:
        """Write the tile's file to `path` (a temporary name on a local disk); some cell of the tile has a height."""


class SurveyProduct(ABC):
    """A product over many tiles, made from their cells after all tiles are done."""

    name: ClassVar[str]
    title: ClassVar[str]
    version: ClassVar[int] = 1
    options: ClassVar[type[Strict]] = NoOptions
    default: ClassVar[bool] = True
    default_cells: ClassVar[Cells] = "any"
    reads: ClassVar[tuple[str, ...]] = ()
    """Surface products from whose files it is made; they are made wherever this product is."""
    table: ClassVar[str] = ""
    """Table of ``schemas/`` that its file contains, if any."""
    needs_lanes: ClassVar[bool] = False
    """True for a product that needs the directions of the lanes."""

    def check_reads(self, options: Strict, read: Mapping[str, Strict]) -> None:
        """Raise :class:`ConfigError` where settings of the products that it `reads`, by name, do not fit this one's."""
        return

    @abstractmethod
    def outputs(self, tiles: Sequence[TileId], options: Strict, context: ProductContext) -> list[Output]:
        """Return the files to write of these tiles; none may read another."""

    @abstractmethod
    def write(
        self,
        output: Output,
        tiles: Sequence[TileSummary],
        load_cells: LoadCells,
        options: Strict,
        context: ProductContext,
        path: Path,
    ) -> None:
        """Write one file to `path` (a temporary name) in bounded memory, whatever the survey's length.

        `tiles` holds at least those of `output`, and nothing written may depend on others. Helper files are
        written beside `path`, their names start with its name, and they are removed.
        """

    @abstractmethod
    def check(self, path: Path) -> None:
        """Raise :class:`roadscan.core.errors.StoreError` unless `path` is whole and readable."""


Product: TypeAlias = TileProduct | SurfaceProduct | SurveyProduct


def is_default(product: Product, cell_m: float) -> bool:
    """Return True for a product that is made where the survey file does not list products."""
    fits = product.default_cells in ("any", "fine" if cell_m < FINE_CELL_M else "coarse")
    return product.default and fits


@functools.cache
def products() -> dict[str, Product]:
    """Return all products by name: those of this folder, and installed entry points."""
    kinds = (TileProduct, SurfaceProduct, SurveyProduct)
    return {name: kind() for name, kind in found_kinds("**/products/*.py", kinds, ENTRY_POINT_GROUP).items()}


def product_named(name: str) -> Product:
    """Return a product by name; raises an error that names the nearest known one."""
    known = products()
    if name not in known:
        raise ConfigError(f"unknown product '{name}'{nearest(name, known)}", expected="one of: " + ", ".join(known))
    return known[name]


@dataclass(frozen=True)
class WantedFiles:
    """A product of one file per tile, with its settings and the key of its inputs besides the tile's."""

    product: TileFiles
    options: Strict
    key: str

    @functools.cached_property
    def files(self) -> dict[str, str]:
        """Suffix of each file by its name in the manifest; that of the product itself is the last."""
        beside = self.product.companions(self.options)
        named = {f"{self.product.name}.{name}": suffix for name, suffix in beside.items()}
        return {**named, self.product.name: self.product.suffix_for(self.options)}


@dataclass(frozen=True)
class WantedProduct(WantedFiles):
    """A product made from the tiles' readings."""

    product: TileProduct


@dataclass(frozen=True)
class WantedSurface(WantedFiles):
    """A product made from the reconstructed surface."""

    product: SurfaceProduct


def write_product(
    wanted: WantedProduct, tile: Tile, context: ProductContext, key: str, store: Store, folder: Path
) -> list[OutputRecord]:
    """Write a product of a tile in `folder` and publish its files; `key` is the tile's."""
    write = functools.partial(wanted.product.write, tile, wanted.options, context)
    return publish_product(wanted, str(tile.cells.tile), write, key, store, folder)


def publish_product(
    wanted: WantedFiles, unit: str, write: Callable[[Path], None], key: str, store: Store, folder: Path
) -> list[OutputRecord]:
    """Let `write` make a tile's file in `folder`, and publish it with its companions; `key` is the tile's."""
    product = wanted.product
    path = folder / f"tile{product.suffix_for(wanted.options)}"
    write(path)
    own_key = key_of(key, wanted.key)
    return [
        publish_file(store, path.with_suffix(suffix), f"tiles/{product.name}/{unit}{suffix}", name, unit, own_key)
        for name, suffix in wanted.files.items()
    ]


def publish_file(
    store: Store, path: Path, target: str, product: str, unit: str, key: str, detail: str = ""
) -> OutputRecord:
    """Move a finished file into the store; return its record for the manifest."""
    size, digest = path.stat().st_size, file_digest(path)
    store.publish(path, target)
    return OutputRecord(product, unit, key, target, size, digest, detail)


def tile_file_names(names: Collection[str] | None = None) -> set[str]:
    """Return the names in the manifest of the files of tile products: of all products, or of those named."""
    return _file_names([p for p in products().values() if isinstance(p, TileProduct)], names)


def surface_file_names(names: Collection[str] | None = None) -> set[str]:
    """Return the names of the files of surface products likewise."""
    return _file_names([p for p in products().values() if isinstance(p, SurfaceProduct)], names)


def _file_names(known: Sequence[TileFiles], names: Collection[str] | None) -> set[str]:
    chosen = [p for p in known if names is None or p.name in names]
    return {file for p in chosen for file in WantedFiles(p, p.options(), "").files}
