"""Cloud-optimised GeoTIFFs: GDAL reads the pixels that were given, overviews are means, and damage is told."""

from __future__ import annotations

import datetime as dt
import warnings
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine

from roadscan.core.crs import MapFrame
from roadscan.core.errors import StoreError
from roadscan.store.codecs.cog import (
    About,
    Band,
    check_cog,
    dense_image,
    overview_factors,
    sparse_image,
    write_cog,
    write_sparse_cog,
)

RNG = np.random.default_rng(5)
PLACE = Affine(0.5, 0.0, 691_000.0, 0.0, -0.5, 5_335_000.0)


def about(*bands: str) -> About:
    return About(MapFrame("EPSG:25832"), PLACE, tuple(Band(b, "metre") for b in bands), dt.date(2026, 4, 24), ())


def read(path: Path, level: int | None = None) -> np.ndarray:
    check_cog(path)
    with rasterio.open(path, **({} if level is None else {"overview_level": level})) as file:
        assert file.crs.to_epsg() == 25832 and (level is not None or file.transform == PLACE)
        pixels: np.ndarray = file.read()
    return pixels


def floats(count: int) -> list[np.ndarray]:
    """Measured values, and any bits that are no NaN."""
    wild = RNG.integers(0, 0x7F80_0000, count).astype(np.uint32).view(np.float32)
    return [RNG.normal(100, 1, count).astype(np.float32), wild]


@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 0.97, 1.0])
@pytest.mark.parametrize("size", [48, 530])
def test_cells_come_back_to_the_bit(tmp_path: Path, share: float, size: int) -> None:
    there = RNG.random((size, size)) < share
    there[RNG.integers(size), RNG.integers(size)] = True
    row, column = np.nonzero(there)
    bands = floats(row.size)
    step = 2.0**-149  # every float is a multiple of it
    image = sparse_image(
        size, column.astype(np.uint16), row.astype(np.uint16), [(v.astype(np.float64), 1.0, step) for v in bands]
    )
    write_cog(tmp_path / "a.tif", [image], about("a", "b"))
    expected = np.full((2, size, size), np.nan, np.float32)
    expected[:, row, column] = bands
    assert read(tmp_path / "a.tif").tobytes() == expected[:, ::-1].tobytes()
    with rasterio.open(tmp_path / "a.tif") as file:
        predictor = file.tags(ns="IMAGE_STRUCTURE").get("PREDICTOR")
        empty = [file.get_tag_item("BLOCK_OFFSET_0_0", "TIFF", bidx=1) is None]
        assert file.block_shapes[0] == (min(size, 512), min(size, 512))
    assert predictor == "3"
    assert any(empty) or there[-512:, :512].any()


def test_dense_images_come_back_to_the_bit(tmp_path: Path) -> None:
    bands = [values.reshape(300, 700) for values in floats(210_000)]
    bands[0][10:290, 20:] = np.nan
    write_cog(tmp_path / "a.tif", [dense_image(bands), dense_image([b[::4, ::4] for b in bands])], about("a", "b"))
    assert read(tmp_path / "a.tif").tobytes() == np.stack(bands).tobytes()
    assert np.array_equal(read(tmp_path / "a.tif", 0), np.stack(bands)[:, ::4, ::4], equal_nan=True)


@pytest.mark.parametrize("dtype", ["float32", "uint8"])
def test_pieces_and_the_means_above_them(tmp_path: Path, dtype: str) -> None:
    height, width = 1100, 2301
    whole = np.full((height, width), np.nan if dtype == "float32" else 0, dtype)
    places = [(0, 0, 700, 300), (700, 0, 5, 300), (1500, 1000, 801, 100), (2300, 999, 1, 1)]  # across blocks
    pieces = []
    for left, top, columns, rows in places:
        values = RNG.integers(1, 256, (rows, columns)).astype(dtype)
        values[RNG.random(values.shape) < 0.3] = whole[0, -1]
        whole[top : top + rows, left : left + columns] = values
        pieces.append((left, top, values))
    for name, order in (("a.tif", 1), ("b.tif", -1)):
        write_sparse_cog(tmp_path / name, (width, height), dtype, pieces[::order], places[::order], about("shade"))
    assert (tmp_path / "a.tif").read_bytes() == (tmp_path / "b.tif").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.tif", "b.tif"]
    assert read(tmp_path / "a.tif")[0].tobytes() == whole.tobytes()
    below = whole.astype(float)
    below[below == 0] = np.nan
    for level in range(len(overview_factors(width, height))):
        padded = np.pad(below, [(0, n % 2) for n in below.shape], constant_values=np.nan)
        parts = np.stack([padded[i::2, j::2] for i in (0, 1) for j in (0, 1)])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            below = np.nanmean(parts, axis=0)
        found = read(tmp_path / "a.tif", level)[0].astype(float)
        if dtype == "uint8":
            found[found == 0] = np.nan
            below = np.rint(below)
        assert np.allclose(found, below, rtol=1e-6, equal_nan=True)
        below = found


def test_damage_is_told(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    write_cog(path, [dense_image([RNG.normal(0, 1, (40, 40)).astype(np.float32)])], about("a"))
    good = path.read_bytes()
    for at in range(0, len(good), 97):
        path.write_bytes(good[:at] + bytes([good[at] ^ 4]) + good[at + 1 :])
        with pytest.raises(StoreError):
            check_cog(path)
    path.write_bytes(good[:-1])
    with pytest.raises(StoreError):
        check_cog(path)
