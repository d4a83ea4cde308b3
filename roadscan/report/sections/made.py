"""Report section on the survey's files, with a small picture of each raster and each picture."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from PIL import Image

from roadscan.adjust.tasks.outcome import PICTURES as ADJUSTMENT_PICTURES
from roadscan.compute.array_types import UInt8
from roadscan.condition.tasks.pictures import PICTURES as CONDITION_PICTURES
from roadscan.condition.tasks.ravelling import RAVELLING_PICTURES
from roadscan.condition.tasks.roughness_regions import REGION_PICTURES
from roadscan.core.errors import DamagedError
from roadscan.report.blocks import Block, Paragraph, Picture, Table
from roadscan.report.section import Material, Section
from roadscan.run.session import Session
from roadscan.store.digest import digest_holds
from roadscan.store.manifest import OutputRecord, read_recorded
from roadscan.store.store import MADE_AGAIN, Store
from roadscan.tiles.product import products

_EDGE: Final = 900
"""Longer edge of a small picture (pixels)."""
_MOST_BYTES: Final = 512_000_000
"""Largest file (bytes) that is compared with its record before a small picture is made of it, or fetched for one."""
_MOST_OF_A_PRODUCT: Final = 4  # small pictures of a product
_SHOWN_ELSEWHERE: Final = (ADJUSTMENT_PICTURES, CONDITION_PICTURES, RAVELLING_PICTURES, REGION_PICTURES)
_SUFFIXES: Final = (".tif", ".png", ".jpg")


class Made(Section):
    """Products: number, size and place of their files, with small pictures."""

    name = "products"
    title = "Products"
    position = 900

    def blocks(self, material: Material) -> Iterator[Block]:
        """Yield a row per product, then small pictures of the first rasters and pictures of each survey product."""
        from rasterio.errors import RasterioError

        session = material.session
        files = {name: one for name, one in material.summary.files.items() if name != "report"}
        if not files:
            return
        root = session.store.root.rstrip("/") + "/"
        rows = [
            (name, f"{one.files:,}", _size(one.bytes), one.folder.removeprefix(root)) for name, one in files.items()
        ]
        yield Table(("product", "files", "size", "folder"), rows, numbers=False)
        for record in _shown(session):
            try:
                small = _small_picture(session.store, record)
            except (RasterioError, DamagedError, OSError, ValueError) as error:
                told = f"{record.path} could not be read for a small picture: {error}"
                material.faults.append(told)
                yield Paragraph(told, is_warning=True)
                continue
            if small is not None:
                yield Picture(small, f"{_title(record.product)}: {record.path}")


def _size(count: int) -> str:
    return f"{count / 1e6:,.1f} MB" if count >= 1_000_000 else f"{count / 1e3:,.1f} kB"


def _title(product: str) -> str:
    """Return the title of a product; its name where it is of a package that is not installed."""
    kind = products().get(product)
    return product if kind is None else kind.title


def _shown(session: Session) -> Iterator[OutputRecord]:
    """Yield the first rasters and pictures of each product over many tiles, by path."""
    counts: Counter[str] = Counter()
    stems: set[str] = set()
    for record in sorted(session.manifest.all(), key=lambda r: r.path):
        is_picture = record.path.startswith("products/") and record.path.endswith(_SUFFIXES)
        if not is_picture or record.product in _SHOWN_ELSEWHERE:
            continue
        stem = record.path.rsplit(".", 1)[0]
        if stem in stems:
            continue  # the same picture in another format
        stems.add(stem)
        counts[record.product] += 1
        if counts[record.product] <= _MOST_OF_A_PRODUCT:
            yield record


def _small_picture(store: Store, record: OutputRecord) -> bytes | None:
    from rasterio.io import MemoryFile

    if record.bytes > _MOST_BYTES and not store.is_folder:
        return None
    if not record.path.endswith(".tif"):
        picture = Image.open(io.BytesIO(read_recorded(store, record)))
        picture.thumbnail((_EDGE, _EDGE))
        return _png(picture)
    if store.is_folder:
        path = store.path(record.path)
        if record.digest and record.bytes <= _MOST_BYTES and not digest_holds(Path(path), record.digest):
            raise DamagedError("the file is not as it was recorded", change=MADE_AGAIN, file=path)
        return _png(_reduced(path))
    with MemoryFile(read_recorded(store, record)) as held:
        return _png(_reduced(held.name))


def _reduced(path: str) -> Image.Image:
    import rasterio
    from rasterio.enums import Resampling

    with rasterio.open(path) as file:
        share = min(1.0, _EDGE / max(file.width, file.height))
        shape = (max(1, round(file.height * share)), max(1, round(file.width * share)))
        bands = file.read(
            indexes=[1, 2, 3] if file.count >= 3 else [1], out_shape=shape, masked=True, resampling=Resampling.average
        )
    grey = np.stack([_stretched(band) for band in bands], axis=-1)
    return Image.fromarray(grey if grey.shape[-1] == 3 else grey[:, :, 0])


def _png(picture: Image.Image) -> bytes:
    stream = io.BytesIO()
    picture.save(stream, "PNG")  # the best packing takes four times as long and saves 1 % of the bytes
    return stream.getvalue()


def _stretched(band: Any) -> UInt8:
    """Return 8-bit values; other numbers are stretched from their 2nd to their 98th percentile. White: no value."""
    values = np.ma.filled(band.astype(np.float64), np.nan)
    there = values[np.isfinite(values)]
    if band.dtype != np.uint8 and there.size:
        low, high = np.percentile(there, [2, 98])
        values = np.clip((values - low) / max(high - low, 1e-9), 0, 1) * 255
    return np.nan_to_num(values, nan=255.0).round().astype(np.uint8)
