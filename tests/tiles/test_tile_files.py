"""Files of a tile product and those that belong beside them."""

from __future__ import annotations

from pathlib import Path

from roadscan.core.strict import Strict
from roadscan.store.manifest import Manifest
from roadscan.store.store import Store
from roadscan.tiles.product import Tile, TileProduct, WantedProduct, tile_file_names, write_product
from roadscan.tiles.products.pavement import IntensityOptions, PavementIntensity


class Pair(TileProduct):
    """A file and a note beside it."""

    name, title, suffix = "pair", "", ".txt"

    def companions(self, options: Strict) -> dict[str, str]:
        return {"note": ".md"}

    def write(self, tile, options, context, path):
        path.write_text("own")
        path.with_suffix(".md").write_text("beside")

    def check(self, path):
        return


class Place:
    """Enough of a tile's cells to name its files."""

    tile = "7_8"


def test_a_file_and_what_belongs_beside_it(tmp_path: Path) -> None:
    store, options = Store(str(tmp_path), "s"), Pair.options()
    wanted = WantedProduct(Pair(), options, "settings")
    with store.scratch() as folder:
        records = write_product(wanted, Tile(None, Place()), None, "key", store, folder)
        assert not any(folder.iterdir())
    assert [(r.product, r.unit, r.path) for r in records] == [
        ("pair.note", "7_8", "tiles/pair/7_8.md"),
        ("pair", "7_8", "tiles/pair/7_8.txt"),  # last: it stands for all
    ]
    assert len({r.key for r in records}) == 1
    assert [store.read_bytes(r.path) for r in records] == [b"beside", b"own"]


def test_another_format_takes_the_old_files_away(tmp_path: Path) -> None:
    store, product = Store(str(tmp_path), "s"), PavementIntensity()
    manifest = Manifest(store)
    for kind in ("png", "bmp"):
        wanted = WantedProduct(product, IntensityOptions(format=kind), kind)
        assert set(wanted.files) == {"pavement_intensity", "pavement_intensity.place"}
        for name, suffix in wanted.files.items():
            store.write_bytes(f"tiles/pavement_intensity/7_8{suffix}", kind.encode())
            record = {"product": name, "unit": "7_8", "path": f"tiles/pavement_intensity/7_8{suffix}"}
            manifest.add([_record(record)])
    manifest.settle()
    assert [Path(f).name for f in store.files("tiles")] == ["7_8.bmp", "7_8.bpw"]


def _record(named):
    from roadscan.store.manifest import OutputRecord

    return OutputRecord(**named, key="k", bytes=3, digest="")


def test_names_in_the_manifest() -> None:
    assert {"las", "geotiff", "pavement_shaded", "pavement_shaded.place"} <= tile_file_names()
    assert tile_file_names({"pavement_shaded"}) == {"pavement_shaded", "pavement_shaded.place"}
    assert "mosaic" not in tile_file_names()
