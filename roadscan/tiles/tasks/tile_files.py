"""Writes the files of a tile to a scratch folder, publishes them by renaming, and records them with their key."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from roadscan.core.strict import Strict
from roadscan.run.engine.fingerprint import key_of
from roadscan.store.digest import file_digest
from roadscan.store.manifest import OutputRecord
from roadscan.store.store import Store
from roadscan.tiles.product import ProductContext, SurfaceProduct, Tile, TileFiles, TileProduct, products


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
