"""Files of a tile: written to a scratch folder, published by rename, listed with their key."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from roadscan.jobs.fingerprint import key_of
from roadscan.model.strict import Strict
from roadscan.products.base import ProductContext, Tile, TileProduct, products
from roadscan.tables.manifest import OutputRecord
from roadscan.tables.store import Store, file_digest


@dataclass(frozen=True)
class WantedProduct:
    """A tile product with its settings and the key of its inputs beside the tile's own."""

    product: TileProduct
    options: Strict
    key: str

    @property
    def files(self) -> dict[str, str]:
        """Suffix of each file by its name in the manifest; the product's own file is the last."""
        beside = self.product.companions(self.options)
        named = {f"{self.product.name}.{name}": suffix for name, suffix in beside.items()}
        return {**named, self.product.name: self.product.suffix_for(self.options)}


def write_product(
    wanted: WantedProduct, tile: Tile, context: ProductContext, key: str, store: Store, folder: Path
) -> list[OutputRecord]:
    """Write a product of a tile in `folder` and publish its files; `key` is the tile's."""
    unit, product = str(tile.cells.tile), wanted.product
    path = folder / f"tile{wanted.product.suffix_for(wanted.options)}"
    product.write(tile, wanted.options, context, path)
    own_key = key_of(key, wanted.key)
    return [
        publish_file(store, path.with_suffix(suffix), f"tiles/{product.name}/{unit}{suffix}", name, unit, own_key)
        for name, suffix in wanted.files.items()
    ]


def publish_file(
    store: Store, path: Path, target: str, product: str, unit: str, key: str, detail: str = ""
) -> OutputRecord:
    """Move a finished file into the store; returns its record for the manifest."""
    size, digest = path.stat().st_size, file_digest(path)
    store.publish(path, target)
    return OutputRecord(product, unit, key, target, size, digest, detail)


def tile_file_names(names: Collection[str] | None = None) -> set[str]:
    """Names in the manifest of the files of tile products: of all there are, or of those named."""
    found = products()
    known = {n: p for n, p in found.items() if isinstance(p, TileProduct) and (names is None or n in names)}
    return {file for p in known.values() for file in WantedProduct(p, p.options(), "").files}
